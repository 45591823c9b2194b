"""Tuples with observations of numbers: ``Steps``, and ``Replay``, the ones to learn from so far."""

from __future__ import annotations

import os
import zlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from erl_torch import checks
from erl_torch.checks import InputError
from erl_torch.files import read_npz, write_npz
from erl_torch.networks.problem import BoxProblem

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

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write an npz file of the five columns."""
        return write_npz(path, {name: getattr(self, name) for name in COLUMNS})

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Steps:
        """What ``save`` wrote, or an npz file with columns of these names. Raises InputError, of ``path``."""
        found = read_npz(path)
        lacking = [name for name in COLUMNS if name not in found]
        if lacking:
            raise InputError("path", path, f"an npz file with {', '.join(COLUMNS)}: it lacks {', '.join(lacking)}")
        try:
            return cls(*(found[name] for name in COLUMNS))
        except InputError as error:
            raise InputError(f"path={path}: {error.key}", error.value, error.allowed) from error

    def checksum(self) -> int:
        """Of all columns, in [0, 2**32)."""
        running = 0
        for name in COLUMNS:
            running = zlib.crc32(np.ascontiguousarray(getattr(self, name)).tobytes(), running)
        return running

    def check(self, problem: BoxProblem) -> None:
        """Raise InputError for tuples that are none of ``problem``."""
        if self.observation.shape[1] != problem.n_observation:
            allowed = f"of {problem.n_observation} numbers, as those of {problem.name}"
            raise InputError("observation", f"{self.observation.shape[1]} numbers", allowed)
        if problem.n_actions:
            wrong = self.action.ndim > 1 or self.action.dtype.kind not in "iu"
            allowed = f"whole numbers in [0, {problem.n_actions}), as {problem.name} has them"
            if wrong or not ((self.action >= 0) & (self.action < problem.n_actions)).all():
                raise InputError("action", "others", allowed)
        elif self.action.shape[1:] != (len(problem.low),):
            raise InputError(
                "action", f"of shape {self.action.shape}", f"[N, {len(problem.low)}], as {problem.name} has"
            )
        elif not self._inside(problem):
            raise InputError("action", "others", f"inside the box of {problem.name}")

    def _inside(self, problem: BoxProblem) -> bool:
        low, high = np.array(problem.low, np.float32), np.array(problem.high, np.float32)
        return bool(((self.action >= low) & (self.action <= high)).all())


@dataclass(frozen=True, eq=False)
class Recorded:
    """Tuples to learn from, with the seed of networks and minibatches."""

    steps: Steps
    seed: int = 0


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
