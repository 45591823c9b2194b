"""Estimate the finite MDP of a control task, by exhaustive sampling.

For every cell and action, ``n_samples`` states uniform in the cell take one step each. p(s'|s,a) is the share of them
that lands in s', r(s,a) their mean instant reward. From all rewards the largest r(s,a) is then subtracted. No state
restarts or absorbs.

Random numbers are NumPy's, one child of the SeedSequence per chunk of (cell, action) rows, so that the model depends
on the seed but not on the number of workers. Estimates are kept in the folder $ERL_TORCH_CACHE, or erl_torch in
$XDG_CACHE_HOME or ~/.cache, under the hash of all settings that determine them.
"""

from __future__ import annotations

import hashlib
import json
import os
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp
import torch
from tqdm import tqdm

from erl_torch import checks
from erl_torch.envs import kernels
from erl_torch.envs.control import ControlTask, control_task
from erl_torch.envs.discretise import UniformBins
from erl_torch.files import read_npz, write_npz
from erl_torch.mdp.tabular import TabularMDP

FORMAT = 2  # of the cache; raise it whenever the same settings give another model, so that no old one is used
CHUNK = 32_000  # samples at once: they fit a core's cache, and torch starts no threads for fewer than 32,768
ROW_BYTES = 100  # of one cell and action, with a transition or two
MOST_SAMPLES = 1_000_000  # of one row; a chunk holds at least one row
STARTS = ("reset", "uniform")


class EstimatedModel(NamedTuple):
    """An MDP and its ``reward_shift``: ``mdp.reward + reward_shift`` is the mean of the sampled instant rewards."""

    mdp: TabularMDP
    reward_shift: float


def estimate_mdp(
    task: str | ControlTask,
    bins: int | Sequence[int] | None = None,
    low: Sequence[float] | None = None,
    high: Sequence[float] | None = None,
    actions: Sequence[float] | None = None,
    n_samples: int = 500,
    seed: int = 0,
    start: str = "reset",
    device: str = "cpu",
    workers: int | None = None,
    cache: bool = True,
    report: Callable[[int], object] | None = None,
    progress: bool = False,
) -> EstimatedModel:
    """Estimate the model of a control task.

    Args:
        task: "pendulum", "mountain_car", "cart_pole", "acrobot", or a task of one's own.
        bins: number of bins, or one per variable; None is the task's own, as for ``low``, ``high`` and ``actions``.
        low, high: bounds of the bins, one number per variable.
        actions: values of the actions (torques), where the original lets one choose.
        n_samples: samples of each (cell, action), 1 to 1,000,000.
        seed: a whole number >= 0.
        start: the first state is drawn as in the original ("reset", exact probabilities), or is any cell ("uniform").
        device: torch device that the dynamics run on. Models of two kinds of device may differ by rounding.
        workers: threads; None is one per core. The model does not depend on it.
        cache: read and write the disk cache.
        report: called with the number of samples done, now and then, by the calling thread.
        progress: show a bar, on a terminal, if the work takes longer than two seconds.

    Raises:
        InputError: a setting out of range.
    """
    task = control_task(task)
    space = task.uniform_bins(bins, low, high)
    values = task.action_values(actions)
    checks.at_least("n_samples", n_samples, 1)
    if n_samples > MOST_SAMPLES:
        raise checks.InputError("n_samples", n_samples, f"at most {MOST_SAMPLES}")
    checks.at_least("seed", seed, 0)
    checks.one_of("start", start, STARTS)
    checks.device("device", device)
    checks.flag("cache", cache)
    checks.flag("progress", progress)
    if workers is None:
        workers = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    checks.workers("workers", workers)
    job = _Job(task, space, values, int(n_samples), int(seed), torch.device(device))
    checks.memory("bins", list(space.bins), ROW_BYTES * job.n_rows, f"a model of {job.n_rows:,} cells and actions")
    counts = job.cached() if cache else None
    if counts is None:
        total, hidden = job.n_rows * job.n_samples, None if progress else True
        with tqdm(total=total, desc=task.name, unit="step", unit_scale=True, delay=2, disable=hidden) as bar:

            def done(n: int) -> None:
                bar.update(n - bar.n)
                if report is not None:
                    report(n)

            counts = job.run(int(workers), done)
        if cache:
            job.keep(counts)
    return job.model(counts, start)


class _Counts(NamedTuple):
    indptr: np.ndarray  # [S*A + 1] int64
    indices: np.ndarray  # [nnz] int32
    counts: np.ndarray  # [nnz] int32
    reward: np.ndarray  # [S*A] mean instant reward


@dataclass(frozen=True)
class _Job:
    """The settings that determine an estimate."""

    task: ControlTask
    space: UniformBins
    actions: tuple[float, ...]
    n_samples: int
    seed: int
    device: torch.device

    @property
    def n_rows(self) -> int:
        return self.space.n_cells * len(self.actions)

    def run(self, workers: int, report: Callable[[int], object]) -> _Counts:
        """Sample every row, ``workers`` chunks at a time."""
        step = max(1, CHUNK // self.n_samples)
        chunks = [(i, b, min(b + step, self.n_rows)) for i, b in enumerate(range(0, self.n_rows, step))]
        sampled = []
        with ThreadPoolExecutor(workers) as pool:
            try:
                for rows, (_, _, end) in zip(pool.map(lambda c: self._sample(*c), chunks), chunks, strict=True):
                    sampled.append(rows)
                    report(end * self.n_samples)
            finally:
                pool.shutdown(cancel_futures=True)
        length, indices, counts, reward = (np.concatenate(column) for column in zip(*sampled, strict=True))
        return _Counts(np.concatenate([[0], np.cumsum(length)]), indices, counts, reward)

    def _sample(self, chunk: int, begin: int, end: int) -> tuple[np.ndarray, ...]:
        """(length [R], indices, counts, mean reward [R]) of rows ``begin`` to ``end``."""
        rng = np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(chunk,)))
        cell, action = np.divmod(np.arange(begin, end), len(self.actions))
        lower = self._tensor(self.space.corners(cell)[0].T.copy())  # [d, R]
        width = self._tensor(self.space.widths)  # [d]
        state = self._tensor(rng.random((*lower.shape, self.n_samples)))  # [d, R, n]
        state.mul_(width[:, None, None]).add_(lower[:, :, None])
        value = self._tensor(np.array(self.actions)[action]).repeat_interleave(self.n_samples)
        state = state.flatten(1).T  # [N, d]
        step = self.task.step(state, value)
        reward = self.task.instant_reward(state, step).cpu().numpy().reshape(-1, self.n_samples).mean(1)
        cells = self.space.cells(self.task.variables(step.state)).reshape(-1, self.n_samples)
        return *kernels.count_rows(cells.cpu().numpy(), self.space.n_cells), reward

    def _tensor(self, array: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(array).to(self.device)

    def model(self, sampled: _Counts, start: str) -> EstimatedModel:
        shape = (self.n_rows, self.space.n_cells)
        transition = sp.csr_array((sampled.counts / self.n_samples, sampled.indices, sampled.indptr), shape=shape)
        shift = float(sampled.reward.max())
        reward = sampled.reward.reshape(self.space.n_cells, -1) - shift
        first = self.space.box_distribution(self.task.reset_low, self.task.reset_high) if start == "reset" else None
        return EstimatedModel(TabularMDP(transition, reward, first), shift)  # type: ignore[arg-type]

    @cached_property
    def key(self) -> str:
        """All settings of the estimate, as JSON."""
        space = self.space
        settings = {
            "format": FORMAT,
            "task": self.task.name,
            "bins": space.bins,
            "low": space.low,
            "high": space.high,
            "actions": self.actions,
            "n_samples": self.n_samples,
            "seed": self.seed,
            "device": self.device.type,
        }
        return json.dumps(settings)

    @property
    def path(self) -> Path:
        digest = hashlib.sha256(self.key.encode()).hexdigest()[:16]
        return cache_folder() / f"{self.task.name}-{digest}.npz"

    def cached(self) -> _Counts | None:
        """The counts in the cache; None where it has none. A damaged or foreign file gives a warning."""
        if not self.path.exists():
            return None
        try:
            arrays: dict[str, Any] = read_npz(self.path)
            sampled = _Counts(*(arrays[name] for name in _Counts._fields))
            if arrays["key"].item() != self.key or not self._plausible(sampled):
                raise ValueError("it is of other settings, or its arrays do not fit together")
            return sampled
        except (KeyError, ValueError) as error:
            warnings.warn(f"estimating {self.task.name} anew, as {self.path} is unusable: {error}", stacklevel=3)
            return None

    def _plausible(self, sampled: _Counts) -> bool:
        indptr, indices, counts, reward = sampled
        return (
            [x.dtype.kind for x in sampled] == ["i", "i", "i", "f"]
            and [x.ndim for x in sampled] == [1] * 4
            and len(indptr) == self.n_rows + 1 == len(reward) + 1
            and indptr[0] == 0
            and len(indices) == len(counts) == indptr[-1]
            and bool((np.diff(indptr) > 0).all())
            and bool((indices >= 0).all() and (indices < self.space.n_cells).all() and (counts > 0).all())
            and bool((np.add.reduceat(counts.astype(np.int64), indptr[:-1]) == self.n_samples).all())
            and bool(np.isfinite(reward).all())
        )

    def keep(self, sampled: _Counts) -> None:
        """Write the cache file; where that fails, warn."""
        try:
            write_npz(self.path, {"key": self.key, **sampled._asdict()})
        except OSError as error:
            warnings.warn(f"the estimate of {self.task.name} is not kept on disk: {error}", stacklevel=3)


def cache_folder() -> Path:
    """The folder of the cache."""
    own = os.environ.get("ERL_TORCH_CACHE")
    if own:
        return Path(own)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "erl_torch"
