"""What ``iterate`` and ``fit`` are for every learner that streams: steps until it is finished, and their record."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from erl_torch import checks
from erl_torch.experience.experience import EXPERIENCE, Experience
from erl_torch.solution import Solution


class NonFiniteError(ArithmeticError):
    """A table left the positive finite numbers. ``step`` counts u updates; ``cause`` names tuple and values."""

    def __init__(self, step: int, cause: str) -> None:
        super().__init__(step, cause)
        self.step, self.cause = step, cause

    def __str__(self) -> str:
        return f"step {self.step}: {self.cause}"


def epochs(learner: Any, transitions: Experience, n_states: int, n_actions: int, state: Any = None) -> Iterator[Any]:
    """The states of ``learner`` after each epoch, from ``state`` on, until it is finished.

    Raises what its ``step`` raises.
    """
    checks.instance("transitions", transitions, Experience, EXPERIENCE)
    stream = learner.prepare(transitions, n_states, n_actions)
    state = learner.init(n_states, n_actions) if state is None else state
    while not learner.finished(state):
        state = learner.step(state, stream)
        yield state


def columns(rows: Sequence[Mapping[str, Any]]) -> dict[str, np.ndarray]:
    """Rows of numbers (or arrays) with the same names, as one array a name."""
    return {name: np.array([row[name] for row in rows]) for name in (rows[0] if rows else ())}


def run_to_end(learner: Any, transitions: Experience, n_states: int, n_actions: int) -> Solution:
    """The solution of the last good state of ``learner.iterate``, with one ``metrics()`` of history for each."""
    state = learner.init(n_states, n_actions)
    history: list[dict[str, float]] = []
    failure: NonFiniteError | None = None
    try:
        for state in learner.iterate(transitions, n_states, n_actions):
            history.append(state.metrics())
    except NonFiniteError as error:
        failure = error
    solution: Solution = learner.solution(state, history, failure)
    return solution
