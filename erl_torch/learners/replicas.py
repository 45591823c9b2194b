r"""Many learners of one kind at once: seeds, and temperatures and step sizes side by side.

    replicas = Replicas.of(AlgorithmS1(), n_replicas=200)
    replicas = Replicas.of(AlgorithmS1(), beta=[2.0, 5.0, 10.0], lr_u=[0.005, 0.005, 0.01])

Each replica is one of ``learners``, and comes out as if it had run alone, bit for bit, whatever the number of threads
and the size of the blocks. Where the experience comes from:

    Transitions              one stream that all replicas learn from
    [Transitions, ...]       one recorded stream per replica
    Simulation(mdp, seeds)   one stream per replica, of its seed: the tuples that ``collect`` gives for it. They are
                             kept where they fit (``keep``), else sampled again in every pass, in memory that does
                             not grow.

Published Algorithm S1 runs with its replicas interleaved in one compiled loop (``erl_torch.learners.s1.lanes``), or in
torch operations on a device (``erl_torch.learners.s1.device``); all other learners with one replica per thread.

A replica that leaves the finite numbers stays at its last good epoch, named in ``failures``; the others go on.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, ClassVar, Protocol

import numpy as np
import torch

from erl_torch import checks
from erl_torch.checks import InputError
from erl_torch.experience.experience import permitted
from erl_torch.experience.simulation import ReplicaExperience, Simulation, fits, longest, streams_of, tuples_of
from erl_torch.experience.transitions import Transitions
from erl_torch.files import read_npz, write_npz
from erl_torch.learners.learner import NonFiniteError, StreamLearner, StreamState, check_numbers, columns, with_prior
from erl_torch.learners.s1.algorithm import AlgorithmS1
from erl_torch.learners.s1.lanes import LanesState, can_interleave, interleave
from erl_torch.learners.together import Together, check_learner
from erl_torch.mdp.tabular import check_policy
from erl_torch.problem import Problem
from erl_torch.solution import LABELS, Solution


class ReplicaState(Protocol):
    """What all replicas know after an epoch: a value, never changed in place."""

    @property
    def n_tuples(self) -> int:
        """Tuples that each replica has streamed so far, those that stopped early excepted."""

    @property
    def work(self) -> int:
        """Tuples that all replicas have streamed so far, together."""

    @property
    def failures(self) -> Mapping[int, NonFiniteError]:
        """Replicas that left the finite numbers, at their last good epoch since."""

    @property
    def policy(self) -> torch.Tensor:
        """[R, S, A]."""

    def replica(self, r: int) -> StreamState:
        """The state of one replica, as its own learner would have it."""

    def epochs(self, r: int, n: int) -> int:
        """The good epochs of one replica, where the run has made ``n``."""

    def milestone(self, learners: Sequence[StreamLearner[Any, Any]]) -> str:
        """The milestone of the replicas that reached one in the last epoch; "" if none did."""

    def metrics(self) -> dict[str, np.ndarray]:
        """``metrics()`` of every replica, [R] each."""


@dataclass(frozen=True, eq=False)
class ReplicaSolution:
    """The solutions of all replicas: tables with a leading axis [R]; ``[r]`` is the Solution of one."""

    solutions: tuple[Solution, ...]
    failures: Mapping[int, NonFiniteError] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.solutions)

    def __getitem__(self, r: int) -> Solution:
        return self.solutions[r]

    def __getattr__(self, name: str) -> Any:  # as the attribute of ``Solution`` that it names
        if name not in {f.name for f in fields(Solution)}:
            raise AttributeError(name)
        values = [getattr(solution, name) for solution in self.solutions]
        if name in LABELS:  # which all share
            return values[0]
        if isinstance(values[0], torch.Tensor):
            return torch.stack(values)
        if isinstance(values[0], float):
            return torch.tensor(values, dtype=torch.float64)
        return values

    def save(self, path: str | os.PathLike[str], more: Mapping[str, np.ndarray] | None = None) -> Path:
        """Write all solutions to one npz file: the arrays of ``Solution.save`` with a leading axis [R], and ``more``.

        Histories stay out: they end where their replica did. Labels, which all share, are there once.
        """
        rows = [solution.arrays(history=False) for solution in self.solutions]
        shared = {name: rows[0].pop(name) for name in LABELS if name in rows[0]}
        names = {name for row in rows for name in row}
        whole = {name: np.stack([row[name] for row in rows]) for name in sorted(names) if all(name in r for r in rows)}
        return write_npz(path, whole | shared | dict(more or {}))

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> ReplicaSolution:
        """Read what ``save`` wrote. Raises InputError naming the file."""
        arrays = read_npz(path)
        shared = {name: arrays[name] for name in LABELS if name in arrays}
        known = [f.name for f in fields(Solution) if f.name in arrays and f.name not in shared]
        if "policy" not in known:
            raise InputError("path", path, "the solutions of replicas as ReplicaSolution.save writes them")
        n = {len(arrays[name]) if arrays[name].ndim else -1 for name in known}
        if len(n) > 1 or -1 in n:
            raise InputError("path", path, "the solutions of replicas, as many rows in every array")
        rows = ({name: arrays[name][r] for name in known} | shared for r in range(n.pop()))
        return cls(tuple(Solution.of_arrays(row, path) for row in rows))


@dataclass(frozen=True, eq=False)
class Replicas(Together):
    """Learners of one kind that run together; see the module's docstring.

    Args:
        learners: one a replica, of one class and with one prior policy.
        threads: at work at once; None is one a core. No result depends on it.
        block: replicas interleaved in one loop; None suits the size of the tables. No result depends on it.
        layout: "lanes" (the replicas of a pair side by side), "tables" (each replica's table in one piece), or "auto".
        backend: of Algorithm S1: "compiled", "torch", or "auto": torch where the learners' device is not the CPU.

    Raises:
        InputError: an argument out of its range.
    """

    unit: ClassVar[str] = "tuples"
    needs_model: ClassVar[bool] = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.backend == "torch" and not isinstance(self.learners[0], AlgorithmS1):
            raise InputError("backend", "torch", "compiled or auto: only AlgorithmS1 has torch operations")

    @classmethod
    def of(
        cls,
        learner: Any,  # a StreamLearner that is a dataclass: no type says both
        n_replicas: int | None = None,
        *,
        threads: int | None = None,
        block: int | None = None,
        layout: str = "auto",
        backend: str = "auto",
        **vectors: Iterable[float],
    ) -> Replicas:
        """``learner`` times ``n_replicas``; ``vectors`` give some of its arguments one value per replica, [R]."""
        check_learner("learner", learner)
        n_replicas = None if n_replicas is None else checks.at_least("n_replicas", n_replicas, 1)
        names = {f.name for f in fields(learner)}
        columns = {name: checks.sequence(name, values) for name, values in vectors.items()}
        for name, column in columns.items():
            if name not in names:
                raise InputError(name, column, f"left out: the arguments of the learner are {', '.join(sorted(names))}")
            n_replicas = len(column) if n_replicas is None else n_replicas
            if len(column) != n_replicas:
                raise InputError(name, f"{len(column)} values", f"one for each of {n_replicas} replicas")
        if n_replicas is None:
            raise InputError("n_replicas", None, "given, or a vector of values")
        own = [{name: _number(column[r]) for name, column in columns.items()} for r in range(n_replicas)]
        return cls(tuple(replace(learner, **values) for values in own), threads, block, layout, backend)

    def fit(self, experience: ReplicaExperience, n_states: int, n_actions: int) -> ReplicaSolution:
        """Run all to the end. Raises InputError: what the learners raise, or streams that are not one a replica."""
        history: list[dict[str, np.ndarray]] = []
        state: ReplicaState | None = None
        for state in self.iterate(experience, n_states, n_actions):
            history.append(state.metrics())
        assert state is not None
        return self.solution(state, history)

    def iterate(
        self,
        experience: ReplicaExperience,
        n_states: int,
        n_actions: int,
        state: Any = None,  # of the engine that runs
    ) -> Iterator[ReplicaState]:
        """Yield the state of all replicas after each epoch, from ``state`` on, until the last is done or has failed."""
        if isinstance(experience, Simulation):
            self = with_prior(self, experience.mdp.allowed)
        self.check(experience, n_states, n_actions)
        experience = self.permitted(experience, n_states, n_actions)
        run = interleave if can_interleave(self, experience) else each
        return run(self, experience, n_states, n_actions, state)

    @property
    def states(self) -> tuple[type, ...]:
        """Classes that the state of all is made of."""
        return (EachState, LanesState, *self.learners[0].states)

    def start(self, problem: Problem) -> EachState:
        """The state of all before any tuple. Raises InputError as each learner does."""
        states: list[StreamState] = []
        before: list[object] = []
        for learner in self.learners:
            settings = [getattr(learner, field.name) for field in fields(learner)]  # type: ignore[arg-type]
            # A state is a value: neighbours of the same settings share theirs.
            same = states and all(one is other for one, other in zip(settings, before, strict=True))
            states.append(states[-1] if same else learner.start(problem))
            before = settings
        return EachState(tuple(states), {}, made=(0,) * len(states))

    def run(
        self, problem: Problem, experience: ReplicaExperience | None, state: ReplicaState | None = None
    ) -> Iterator[ReplicaState]:
        """``iterate``, with the sizes of ``problem``, and the actions that its states have."""
        assert experience is not None
        replicas: Replicas = with_prior(self, problem.allowed)
        return replicas.iterate(experience, problem.n_states, problem.n_actions, state)

    def position(self, state: ReplicaState) -> int:
        """Tuples that each replica has streamed so far."""
        return state.n_tuples

    def work(self, state: ReplicaState) -> int:
        """Tuples that all replicas have streamed so far, together."""
        return state.work

    def total(self, experience: ReplicaExperience | None) -> int | None:
        """Tuples to stream, at most, in all replicas together."""
        if experience is None:
            return None
        return longest(experience) * sum(learner.passes for learner in self.learners)

    def milestone(self, state: ReplicaState) -> str:
        """That of the replicas that reached one in the last epoch; of several, the furthest's."""
        return state.milestone(self.learners)

    def progress(self, state: ReplicaState) -> str:
        """Nothing: the bar counts the tuples of all."""
        return ""

    def solution(
        self,
        state: ReplicaState,
        history: Sequence[Mapping[str, np.ndarray]] = (),
        failure: BaseException | None = None,
    ) -> ReplicaSolution:
        """The solutions that ``state`` stands for; ``failure`` is what ended all of them."""
        solutions = []
        for r, learner in enumerate(self.learners):
            made = history[: state.epochs(r, len(history))]
            rows = [{name: values[r].item() for name, values in row.items()} for row in made]
            solutions.append(learner.solution(state.replica(r), rows, state.failures.get(r, failure)))
        return ReplicaSolution(tuple(solutions), state.failures)

    def permitted(
        self, experience: ReplicaExperience, n_states: int, n_actions: int, told: Callable[[str], None] | None = None
    ) -> ReplicaExperience:
        """The tuples of actions that there are, those with a prior above 0, as ``experience.permitted``; of a
        simulation these are all."""
        prior = self.prior_policy(n_states, n_actions)
        if isinstance(experience, Simulation) or (prior > 0).all():
            return experience
        next_actions = any(learner.drawn_from_prior == "a_next" for learner in self.learners)
        kept: dict[int, Any] = {}
        for data in streams_of(experience):
            if id(data) not in kept:
                kept[id(data)] = permitted(data, prior, next_actions, told)
        return kept[id(experience)] if isinstance(experience, Transitions) else [kept[id(data)] for data in experience]

    def check(self, experience: ReplicaExperience, n_states: int, n_actions: int) -> None:
        """Raise InputError unless ``experience`` is what the replicas can learn from."""
        prior = self.prior_policy(n_states, n_actions)
        if isinstance(experience, Transitions):
            self.learners[0].check_weights(experience)
            return
        if hasattr(experience, "chunks"):
            raise InputError("experience", "a recording in files", "in memory: recording.load()")
        streams = experience.seeds if isinstance(experience, Simulation) else experience
        if len(streams) != len(self):
            raise InputError("experience", f"{len(streams)} streams", f"one, or one for each of {len(self)} replicas")
        if not isinstance(experience, Simulation):
            for data in experience:
                self.learners[0].check_weights(data)
        if isinstance(experience, Simulation) and experience.mdp.reward.shape != (n_states, n_actions):
            shape = experience.mdp.reward.shape
            raise InputError("experience", f"an MDP of shape {shape}", f"of shape {(n_states, n_actions)}")
        if isinstance(experience, Simulation):
            check_policy("prior_policy", prior, n_states, n_actions, experience.mdp.allowed)
            if experience.behaviour_policy is not None:
                check_policy("behaviour_policy", experience.behaviour_policy, n_states, n_actions, prior > 0)


def _number(value: np.ndarray | float) -> object:
    """A plain number of a NumPy or torch scalar."""
    return value.item() if np.ndim(value) == 0 and hasattr(value, "item") else value


# -- one replica per thread -------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class EachState:
    """States of learners that run beside each other."""

    states: tuple[StreamState, ...]
    failures: Mapping[int, NonFiniteError]
    stepped: tuple[int, ...] = ()  # the replicas that this epoch was of
    made: tuple[int, ...] = ()  # epochs, of each replica

    @property
    def n_tuples(self) -> int:
        return max(int(state.n_tuples) for state in self.states)

    @property
    def work(self) -> int:
        return sum(int(state.n_tuples) for state in self.states)

    @property
    def policy(self) -> torch.Tensor:
        return torch.stack([state.policy for state in self.states])

    def replica(self, r: int) -> StreamState:
        return self.states[r]

    def epochs(self, r: int, n: int) -> int:
        return self.made[r]

    def milestone(self, learners: Sequence[StreamLearner[Any, Any]]) -> str:
        ended = [r for r in self.stepped if r not in self.failures and learners[r].milestone(self.states[r])]
        furthest = max(ended, key=lambda r: self.states[r].n_tuples, default=None)
        return "" if furthest is None else learners[furthest].milestone(self.states[furthest])

    def metrics(self) -> dict[str, np.ndarray]:
        return columns([state.metrics() for state in self.states])


def each(
    replicas: Replicas, experience: ReplicaExperience, n_states: int, n_actions: int, state: EachState | None = None
) -> Iterator[EachState]:
    """``Replicas.iterate`` of any learner that streams. Prepared streams are held where they fit, else made again."""
    learners, prior = replicas.learners, replicas.prior_policy(n_states, n_actions)
    held: list[Any] = [None] * len(replicas)
    hold = fits(experience, len(replicas), learners[0].stream_bytes)
    states = list(state.states) if state else [learner.init(n_states, n_actions) for learner in learners]
    failures = dict(state.failures) if state else {}
    made = list(state.made) if state else [0] * len(learners)

    def go_on(r: int) -> StreamState | NonFiniteError:
        try:
            stream = held[r]
            if stream is None:
                stream = learners[r].prepare(tuples_of(experience, r, prior), n_states, n_actions)
                held[r] = stream if hold else None
            after: StreamState = learners[r].step(states[r], stream)
            check_numbers(after.n_tuples, after.theta, after.policy)
            return after
        except NonFiniteError as error:
            return error

    with ThreadPoolExecutor(replicas.workers) as pool:
        while live := [r for r in range(len(replicas)) if r not in failures and not learners[r].finished(states[r])]:
            for r, after in zip(live, pool.map(go_on, live), strict=True):
                if isinstance(after, NonFiniteError):
                    failures[r] = after
                else:
                    states[r] = after
                    made[r] += 1
            yield EachState(tuple(states), dict(failures), tuple(live), tuple(made))
