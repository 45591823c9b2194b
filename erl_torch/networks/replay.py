"""Tuples with observations of numbers: ``Steps``, and ``Replay``, the ones to learn from so far."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from erl_torch import checks
from erl_torch.checks import InputError

COLUMNS = ("observation", "action", "reward", "following", "ended")


@dataclass(frozen=True, eq=False)
class Steps:
    """Tuples in memory.

    Args:
        observation: [N, d] float32.
        action: [N] int32, or [N, k] float32 of continuous ones.
        reward: [N] float32.
        following: [N, d] float32: the next observation; where an episode ended, that with which the next one began.
        ended: [N] bool: whether the step terminated an episode.

    Raises:
        InputError: columns of different lengths, or numbers that are not finite.
    """

    observation: np.ndarray
    action: np.ndarray
    reward: np.ndarray
    following: np.ndarray
    ended: np.ndarray

    def __post_init__(self) -> None:
        first = checks.array("observation", self.observation, ("N", "d"), checks.FINITE)
        n, d = first.shape
        columns = {
            "observation": first.astype(np.float32),
            "reward": checks.array("reward", self.reward, (n,), checks.FINITE).astype(np.float32),
            "following": checks.array("following", self.following, (n, d), checks.FINITE).astype(np.float32),
            "ended": np.ascontiguousarray(np.asarray(self.ended, bool)),
        }
        action = np.asarray(self.action)
        if action.ndim == 1 and action.dtype.kind in "iu":
            columns["action"] = np.ascontiguousarray(action.astype(np.int32))
        else:
            columns["action"] = checks.array("action", action, (n, "k"), checks.FINITE).astype(np.float32)
        for name, column in columns.items():
            if len(column) != n:
                raise InputError(name, f"array of length {len(column)}", f"of length {n}, as observation")
            if not np.isfinite(column).all():
                raise InputError(name, "a number beyond float32", "numbers of single precision")
            object.__setattr__(self, name, column)

    def __len__(self) -> int:
        return len(self.reward)


@dataclass(frozen=True, eq=False)
class Replay:
    """The first ``n`` of the rows are tuples, in the order in which they came; from ``capacity`` on the oldest go.

    A value: rows once written stay, as long as there is room; a ring is copied before it is written to again.
    """

    observation: np.ndarray
    action: np.ndarray
    reward: np.ndarray
    following: np.ndarray
    ended: np.ndarray
    n: int = 0
    at: int = 0  # where the next one goes
    capacity: int = 0

    @classmethod
    def empty(cls, n_observation: int, n_action: int, capacity: int) -> Replay:
        """Without a tuple; ``n_action`` is 0 of discrete actions, else their numbers."""
        rows = min(capacity, 1024)
        action = np.zeros((rows, n_action), np.float32) if n_action else np.zeros(rows, np.int32)
        wide = np.zeros((rows, n_observation), np.float32)
        return cls(wide, action, np.zeros(rows, np.float32), wide.copy(), np.zeros(rows, bool), 0, 0, capacity)

    @classmethod
    def of(cls, steps: Steps) -> Replay:
        """All of ``steps``."""
        n = len(steps)
        return cls(steps.observation, steps.action, steps.reward, steps.following, steps.ended, n, n, n)

    def with_room(self, more: int) -> Replay:
        """The same tuples, with room for ``more``, which the caller writes from ``at`` on, around the end."""
        rows = len(self.reward)
        if self.n + more <= rows:
            return self
        if rows == self.capacity:
            return self._copied(rows)
        return self._copied(min(self.capacity, max(2 * rows, self.n + more)))

    def _copied(self, rows: int) -> Replay:
        columns: dict[str, Any] = {}
        for name in COLUMNS:
            old = getattr(self, name)
            columns[name] = np.zeros((rows, *old.shape[1:]), old.dtype)
            columns[name][: self.n] = old[: self.n]
        return replace(self, at=self.n if self.n < rows else self.at % rows, **columns)
