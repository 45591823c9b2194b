"""A learnt policy: probabilities of actions at observations; a file of it without pickle."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save

from erl_torch.checks import InputError
from erl_torch.files import write_bytes
from erl_torch.networks.layout import Layout

KEY = "erl_torch"  # of the metadata of a file
Probabilities = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True, eq=False)
class NetworkPolicy:
    """pi(a|s) ~ exp(beta Q(s, a)), the prior uniform.

    Args:
        layout: of the network of Q.
        weights: [size] float32.
        beta: inverse temperature, in the units of Q.
    """

    layout: Layout
    weights: torch.Tensor
    beta: float

    def action_values(self, observation: np.ndarray) -> torch.Tensor:
        """Q, [N, A] float32, at observations [N, d]."""
        return self.layout.output(self.weights, torch.from_numpy(np.ascontiguousarray(observation, np.float32)))

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Probabilities [N, A], float64, at observations [N, d]."""
        return torch.softmax(self.beta * self.action_values(observation).double(), 1).numpy()

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write a safetensors file: a weight and a bias for each layer, ``beta`` in its metadata."""
        layers: dict[str, torch.Tensor] = {}
        for i, (weight, bias) in enumerate(self.layout.layers(self.weights)):
            layers |= {f"layer{i}.weight": weight.T.contiguous(), f"layer{i}.bias": bias.contiguous()}
        told = {"policy": "softmax(beta * Q)", "beta": float(self.beta), "widths": self.layout.widths}
        return write_bytes(path, save(layers, {KEY: json.dumps(told)}))  # of several keys the order is by chance


def load_policy(path: str | os.PathLike[str]) -> NetworkPolicy:
    """What ``save`` wrote. Raises InputError for another file."""
    try:
        with safe_open(str(path), "pt") as file:
            told = json.loads((file.metadata() or {})[KEY])
            layout = Layout(tuple(map(int, told["widths"])))
            parts = []
            for i in range(len(layout.widths) - 1):
                parts += [file.get_tensor(f"layer{i}.weight").T.reshape(-1), file.get_tensor(f"layer{i}.bias")]
            weights = torch.cat(parts)
            if len(weights) != layout.size:
                raise ValueError(f"{len(weights)} weights, not {layout.size}")
            return NetworkPolicy(layout, weights, float(told["beta"]))
    except (OSError, SafetensorError, KeyError, ValueError, TypeError) as error:
        raise InputError("path", path, f"a policy that erl_torch saved ({error})") from error


def uniform(n_actions: int) -> Probabilities:
    """The prior."""
    return lambda observation: np.full((len(observation), n_actions), 1.0 / n_actions)
