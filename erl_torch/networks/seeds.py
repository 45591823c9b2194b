"""One learner of networks with many seeds: each has the bits of its own run."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from erl_torch.networks.learner import NetworkLearner, NetworkSolution, NetworkState, solution_of
from erl_torch.networks.live import Live
from erl_torch.networks.problem import BoxProblem
from erl_torch.networks.replay import Recorded


@dataclass(frozen=True, eq=False)
class SeedsState:
    """A state per seed."""

    each: tuple[NetworkState, ...]

    def metrics(self) -> Mapping[str, np.ndarray]:
        return {name: np.array([one.figures[name] for one in self.each]) for name in self.each[0].figures}


@dataclass(frozen=True, eq=False)
class Seeds:
    """``learner``, one for each of ``seeds``.

    Args:
        learner: their settings.
        seeds: whole numbers >= 0.
        threads: at work at once; no result depends on it.
    """

    learner: NetworkLearner
    seeds: tuple[int, ...]
    threads: int = 1

    unit: ClassVar[str] = "steps"
    needs_model: ClassVar[bool] = False

    @property
    def states(self) -> tuple[type, ...]:
        return (SeedsState, *self.learner.states)

    def start(self, problem: BoxProblem) -> SeedsState:
        return SeedsState(tuple(self.learner.init(problem, seed) for seed in self.seeds))

    def run(
        self, problem: BoxProblem, experience: Sequence[Live | Recorded], state: SeedsState | None = None
    ) -> Iterator[SeedsState]:
        """Yield the states after each epoch, from ``state`` on."""
        if state is None:
            state = SeedsState(tuple(self.learner.begin(problem, one) for one in experience))
        lives = [one if isinstance(one, Live) else None for one in experience]
        with ThreadPoolExecutor(self.threads) as pool:
            while self.position(state) < self.learner.n_steps:
                tasks = [
                    pool.submit(self.learner.epoch, problem, one, live)
                    for one, live in zip(state.each, lives, strict=True)
                ]
                state = SeedsState(tuple(task.result() for task in tasks))
                yield state

    def solution(
        self, state: SeedsState, history: Sequence[Mapping[str, Any]] = (), failure: BaseException | None = None
    ) -> NetworkSolution:
        """What ``state`` stands for."""
        return solution_of(self.learner, state.each, failure)

    def position(self, state: SeedsState) -> int:
        """Steps of each so far."""
        return self.learner.position(state.each[0])

    def work(self, state: SeedsState) -> int:
        return len(self.seeds) * self.position(state)

    def total(self, experience: object = None) -> int:
        return len(self.seeds) * self.learner.n_steps

    def milestone(self, state: SeedsState) -> str:
        return self.learner.milestone(state.each[0])

    def progress(self, state: SeedsState) -> str:
        return f"theta {np.mean(state.metrics()['theta']):.4f}"
