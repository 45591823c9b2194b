"""A learnt policy: probabilities of actions at observations; a file of it without pickle."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from scipy.special import ndtri

from erl_torch.checks import InputError
from erl_torch.files import write_bytes
from erl_torch.networks.layout import Layout

KEY = "erl_torch"  # of the metadata of a file
Probabilities = Callable[[np.ndarray], np.ndarray]


class Acting(Protocol):
    """What acts: a learnt policy, or the prior."""

    def draw(self, observation: np.ndarray, uniform: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(actions, their KL to the prior or an unbiased estimate of it [N], nats) at observations [N, d].

        ``uniform``: [N, max(1, k)] in [0, 1), of which nothing else is drawn; actions of a box are [N, k].
        """

    def best(self, observation: np.ndarray) -> np.ndarray:
        """The most probable actions; of a box the ones in the middle of the policy."""


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

    def draw(self, observation: np.ndarray, uniform: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """As of ``Acting``; the KL is exact."""
        p = self(observation)
        with np.errstate(divide="ignore", invalid="ignore"):
            kl = np.where(p > 0, p * np.log(p * p.shape[1]), 0.0).sum(1)
        return np.minimum((np.cumsum(p, 1) <= uniform[:, :1]).sum(1), p.shape[1] - 1), kl

    def best(self, observation: np.ndarray) -> np.ndarray:
        """As of ``Acting``."""
        return np.asarray(self(observation).argmax(1))

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write a safetensors file: a weight and a bias for each layer, ``beta`` in its metadata."""
        told = {"policy": "softmax(beta * Q)", "beta": float(self.beta), "widths": self.layout.widths}
        return _write(path, self.layout, self.weights, told)


@dataclass(frozen=True, eq=False)
class ActorPolicy:
    """A normal distribution squashed into a box: centre + half tanh(mean + sd noise), the prior uniform in the box.

    Args:
        layout: of the actor: its output is mean [k] and the measure of log sd [k], -5 + 3.5 (tanh + 1).
        weights: [size] float32.
        low, high: [k], the box.
    """

    layout: Layout
    weights: torch.Tensor
    low: tuple[float, ...]
    high: tuple[float, ...]

    def _shape(self, observation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean and log sd before the squashing, [N, k]."""
        out = self.layout.output(self.weights, torch.from_numpy(np.ascontiguousarray(observation, np.float32)))
        mean, measure = out.double().numpy().reshape(len(observation), 2, -1).transpose(1, 0, 2)
        return mean, -5.0 + 3.5 * (np.tanh(measure) + 1.0)

    def _in_box(self, squashed: np.ndarray) -> np.ndarray:
        low, high = np.array(self.low), np.array(self.high)
        return np.asarray(np.clip((low + high) / 2 + (high - low) / 2 * squashed, low, high), np.float32)

    def draw(self, observation: np.ndarray, uniform: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """As of ``Acting``; the KL is log pi/prior at the actions drawn."""
        mean, log_sd = self._shape(observation)
        noise = ndtri(np.clip(uniform, 1e-12, 1 - 1e-12))
        before = mean + np.exp(log_sd) * noise
        slope = 2 * (np.log(2) - np.abs(before) - np.log1p(np.exp(-2 * np.abs(before))))
        density = -0.5 * noise**2 - log_sd - 0.5 * np.log(2 * np.pi) - slope
        return self._in_box(np.tanh(before)), (density + np.log(2)).sum(1)

    def best(self, observation: np.ndarray) -> np.ndarray:
        """As of ``Acting``."""
        return self._in_box(np.tanh(self._shape(observation)[0]))

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write a safetensors file: a weight and a bias for each layer, the box in its metadata."""
        told = {"policy": "actor", "low": self.low, "high": self.high, "widths": self.layout.widths}
        return _write(path, self.layout, self.weights, told)


@dataclass(frozen=True)
class Prior:
    """The uniform policy, of ``n_actions``, or in a box."""

    n_actions: int
    low: tuple[float, ...] = ()
    high: tuple[float, ...] = ()

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Probabilities [N, A]."""
        return np.full((len(observation), self.n_actions), 1.0 / self.n_actions)

    def draw(self, observation: np.ndarray, uniform: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """As of ``Acting``."""
        nothing = np.zeros(len(observation))
        if not self.low:
            return np.minimum((uniform[:, 0] * self.n_actions).astype(np.int64), self.n_actions - 1), nothing
        low, high = np.array(self.low), np.array(self.high)
        return np.asarray(low + uniform * (high - low), np.float32), nothing

    def best(self, observation: np.ndarray) -> np.ndarray:
        """As of ``Acting``: the first action, or the middle of the box."""
        if not self.low:
            return np.zeros(len(observation), np.int64)
        return np.tile((np.array(self.low) + np.array(self.high)) / 2, (len(observation), 1)).astype(np.float32)


def _write(path: str | os.PathLike[str], layout: Layout, weights: torch.Tensor, told: Mapping[str, Any]) -> Path:
    layers: dict[str, torch.Tensor] = {}
    for i, (weight, bias) in enumerate(layout.layers(weights)):
        layers |= {f"layer{i}.weight": weight.T.contiguous(), f"layer{i}.bias": bias.contiguous()}
    return write_bytes(path, save(layers, {KEY: json.dumps(told)}))  # of several keys the order is by chance


def load_policy(path: str | os.PathLike[str]) -> NetworkPolicy | ActorPolicy:
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
            if told["policy"] == "actor":
                return ActorPolicy(layout, weights, tuple(map(float, told["low"])), tuple(map(float, told["high"])))
            return NetworkPolicy(layout, weights, float(told["beta"]))
    except (OSError, SafetensorError, KeyError, ValueError, TypeError) as error:
        raise InputError("path", path, f"a policy that erl_torch saved ({error})") from error
