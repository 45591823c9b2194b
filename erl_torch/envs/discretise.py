"""Uniform bins, which turn real vectors into whole numbers, and any Gymnasium environment with them.

Dimension i of [low_i, high_i] is cut into bins_i equal parts, numbered from 0; values outside fall into the end bins.
Cell number, little-endian: sum_i x_i prod(bins[:i]).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike

from erl_torch import checks
from erl_torch.checks import InputError

Array = TypeVar("Array")  # np.ndarray or torch.Tensor


@dataclass(frozen=True)
class UniformBins:
    """The cells of a box.

    Args:
        bins, low, high: one entry per dimension.

    Raises:
        InputError: lengths that differ, bins < 1, or bounds that are not finite and ascending.
    """

    bins: tuple[int, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]

    def __post_init__(self) -> None:
        if not len(self.bins) == len(self.low) == len(self.high) > 0:
            lengths = f"{len(self.bins)}, {len(self.low)} and {len(self.high)} entries"
            raise InputError("bins, low, high", lengths, "of one length, one entry per dimension")
        for i, (n, low, high) in enumerate(zip(self.bins, self.low, self.high, strict=True)):
            checks.at_least(f"bins[{i}]", n, 1)
            checks.finite(f"low[{i}]", low)
            checks.finite(f"high[{i}]", high)
            if not low < high:
                raise InputError(f"high[{i}]", high, f"above low[{i}]={low}")
        object.__setattr__(self, "bins", tuple(map(int, self.bins)))
        if self.n_cells >= 2**31:
            raise InputError("bins", list(self.bins), "fewer than 2**31 cells in all")

    @property
    def n_cells(self) -> int:
        return math.prod(self.bins)

    def cells(self, x: Array) -> Array:
        """Cell numbers [N], int64, of points [N, d], array or tensor. Raises InputError for NaN or a wrong shape."""
        points: Any = x
        if points.ndim != 2 or points.shape[1] != len(self.bins):
            raise InputError("points", f"array of shape {tuple(points.shape)}", f"of shape [N, {len(self.bins)}]")
        cell: Any = 0.0
        stride = 1.0
        for i, (n, low, high) in enumerate(zip(self.bins, self.low, self.high, strict=True)):
            place = points[:, i] - low
            place *= n / (high - low)
            place = place.clip(0, n - 1)
            place = np.floor(place) if isinstance(place, np.ndarray) else place.floor_()
            place *= stride
            place += cell
            cell = place
            stride *= n
        if (cell != cell).any():
            raise InputError("points", "nan", "numbers")
        whole: Any = cell.astype(np.int64) if isinstance(cell, np.ndarray) else cell.long()
        return whole  # type: ignore[no-any-return]

    def corners(self, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner of cells [N], each [N, d]."""
        place = np.stack(np.unravel_index(cells, self.bins, order="F"), axis=-1)  # [N, d]
        low, width = np.array(self.low), self.widths
        return low + place * width, low + (place + 1) * width

    @property
    def widths(self) -> np.ndarray:
        """[d] sides of a cell."""
        return np.asarray((np.array(self.high) - np.array(self.low)) / np.array(self.bins))

    def box_distribution(self, low: Sequence[float], high: Sequence[float]) -> np.ndarray:
        """Probability of each cell, [n_cells], under the uniform distribution on the box [low, high].

        Where low and high are equal, that dimension is a point.
        """
        p = np.ones(1)
        for n, first, last, a, b in zip(self.bins, self.low, self.high, low, high, strict=True):
            if a == b:
                marginal = np.zeros(n)
                marginal[UniformBins((n,), (first,), (last,)).cells(np.array([[a]]))] = 1
            else:
                inner = np.linspace(first, last, n + 1)[1:-1]
                marginal = np.diff(np.clip((inner - a) / (b - a), 0, 1), prepend=0, append=1)
            p = np.outer(marginal, p).ravel()
        return p


class Discretise(gym.Wrapper[np.int64, np.int64, Any, Any], gym.utils.RecordConstructorArgs):
    """An environment with a 1-D Box of observations, and Discrete or 1-D Box actions, as Discrete and Discrete.

    Args:
        env: the environment.
        bins: number of bins, or a list with one number per dimension.
        low, high: bounds of the bins, a number or one per dimension; None takes those of the observation space.
        actions: for Box actions only: a list of values (or vectors), or the number of equally spaced values in each
            dimension.
        features: maps the observation to the variables that are binned; needs lists ``low`` and ``high``.

    Raises:
        InputError: spaces of other kinds, bounds that are not finite, Box actions without ``actions``.
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        bins: int | Sequence[int],
        low: float | Sequence[float] | None = None,
        high: float | Sequence[float] | None = None,
        actions: int | Sequence[float] | Sequence[Sequence[float]] | None = None,
        features: Callable[[np.ndarray], np.ndarray] | None = None,
    ) -> None:
        gym.utils.RecordConstructorArgs.__init__(
            self, bins=bins, low=low, high=high, actions=actions, features=features
        )
        super().__init__(env)
        space = env.observation_space
        if not isinstance(space, gym.spaces.Box) or len(space.shape) != 1:
            raise InputError("observation_space", space, "a one-dimensional Box to be cut into bins")
        if features is None:
            dimensions = space.shape[0]
            # The largest number of the dtype stands for "no bound".
            bounded = np.isfinite(space.low) & np.isfinite(space.high)
            if space.dtype is not None and space.dtype.kind == "f":
                bounded &= np.maximum(abs(space.low), abs(space.high)) < np.finfo(space.dtype).max
            low = _bounds("low", low, space.low, bounded)
            high = _bounds("high", high, space.high, bounded)
        else:
            if not (isinstance(low, Sequence) and isinstance(high, Sequence)):
                raise InputError("low, high", f"{low}, {high}", "lists, one entry per variable that features gives")
            dimensions = len(low)
        self.features = features
        sizes = _each("bins", bins, dimensions)
        self.bins = UniformBins(tuple(sizes), tuple(map(float, low)), tuple(map(float, high)))
        self.actions = _action_table(env.action_space, actions)
        self.observation_space = gym.spaces.Discrete(self.bins.n_cells)
        self.action_space = gym.spaces.Discrete(len(self.actions))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.int64, dict[str, Any]]:
        observation, info = self.env.reset(seed=seed, options=options)
        return self._cell(observation), info

    def step(self, action: np.int64) -> tuple[np.int64, float, bool, bool, dict[str, Any]]:
        if not self.action_space.contains(action):
            raise InputError("action", action, f"a whole number in [0, {len(self.actions)})")
        observation, reward, terminated, truncated, info = self.env.step(self.actions[int(action)])
        return self._cell(observation), float(reward), terminated, truncated, info

    def _cell(self, observation: ArrayLike) -> np.int64:
        x = np.asarray(observation) if self.features is None else self.features(np.asarray(observation))
        cell: np.int64 = self.bins.cells(np.asarray(x, np.float64)[None])[0]
        return cell


def _each(key: str, value: object, dimensions: int) -> list[Any]:
    """``value``, a number or a list, as a list with one entry per dimension."""
    if value is None:
        raise InputError(key, value, "given: a number, or one per dimension")
    if checks.is_number(value):
        return [value] * dimensions
    values = list(checks.sequence(key, value))
    if len(values) != dimensions:
        raise InputError(key, values, f"a number or {dimensions} numbers, one per dimension")
    return values


def _bounds(key: str, value: object, own: np.ndarray, bounded: np.ndarray) -> list[Any]:
    """``value`` as a list; where it is None, the space's ``own`` bounds, which must all be ``bounded``."""
    if value is not None:
        return _each(key, value, len(own))
    if not bounded.all():
        i = int(np.argmin(bounded))
        allowed = f"finite: dimension {i} of the observation space has no bounds of its own, so give low and high"
        raise InputError(f"{key}[{i}]", own[i], allowed)
    return own.tolist()  # type: ignore[no-any-return]


def _action_table(space: gym.Space[Any], actions: object) -> np.ndarray:
    """[A] whole numbers or [A, d] vectors, as the environment takes them."""
    if isinstance(space, gym.spaces.Discrete):
        if actions is not None:
            raise InputError("actions", actions, "left out, as the actions are Discrete already")
        return np.arange(space.start, space.start + space.n)
    if not isinstance(space, gym.spaces.Box) or len(space.shape) != 1:
        raise InputError("action_space", space, "Discrete or a one-dimensional Box")
    if actions is None:
        raise InputError("actions", actions, f"a list of values in {space}, or how many equally spaced ones")
    if checks.is_number(actions):
        checks.at_least("actions", actions, 2)
        if not space.is_bounded():
            raise InputError("actions", actions, f"a list of values, as {space} has no bounds to divide")
        axes = np.linspace(space.low, space.high, int(actions)).T  # [d, n]
        table = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))
    else:
        try:
            table = np.array(actions, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise InputError("actions", actions, "a list of values or of vectors") from error
        table = table[:, None] if table.ndim == 1 else table
    table = table.astype(space.dtype)
    if table.ndim != 2 or not len(table) or not all(space.contains(row) for row in table):
        raise InputError("actions", actions, f"a list of values in {space}, or how many equally spaced ones")
    return table
