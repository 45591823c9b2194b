"""A multilayer perceptron as one flat vector: where its weights stand, how they begin, what it gives."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch


@dataclass(frozen=True)
class Layout:
    """Rectified linear units in the hidden layers, none at the output.

    Args:
        widths: of observation, hidden layers and output, at least two numbers >= 1.
    """

    widths: tuple[int, ...]

    @property
    def size(self) -> int:
        """Numbers in the vector: of each layer W [n_in, n_out], row by row, then b [n_out]."""
        return sum((n + 1) * m for n, m in self._pairs())

    def _pairs(self) -> Iterator[tuple[int, int]]:
        return zip(self.widths[:-1], self.widths[1:], strict=True)

    def layers(self, vector: torch.Tensor) -> list[tuple[torch.Tensor, torch.Tensor]]:
        """(W, b) of each layer, views of ``vector`` [..., size]; leading dimensions stay."""
        found, at = [], 0
        for n, m in self._pairs():
            weight = vector[..., at : at + n * m].reshape(*vector.shape[:-1], n, m)
            found.append((weight, vector[..., at + n * m : at + (n + 1) * m]))
            at += (n + 1) * m
        return found

    def start(self, rng: np.random.Generator, zero_output: bool = False) -> np.ndarray:
        """Where learning begins, [size] float32: uniform within 1/sqrt(n_in), as torch.nn.Linear; with ``zero_output``
        the last layer is 0."""
        parts = []
        pairs = list(self._pairs())
        for i, (n, m) in enumerate(pairs):
            scale = 0.0 if zero_output and i == len(pairs) - 1 else 1 / math.sqrt(n)
            parts.append(rng.uniform(-scale, scale, (n + 1) * m))
        return np.concatenate(parts).astype(np.float32)

    def output(self, vector: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
        """The output [..., B, n_out] at the observations x [..., B, n_in]."""
        layers = self.layers(vector)
        for i, (weight, bias) in enumerate(layers):
            x = x @ weight + bias.unsqueeze(-2)
            if i < len(layers) - 1:
                x = torch.relu(x)
        return x


def mlp(n_in: int, hidden: Sequence[int], n_out: int) -> Layout:
    """The layout of a network with these hidden layers."""
    return Layout((n_in, *hidden, n_out))
