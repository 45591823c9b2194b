"""The contract of learners: ``Learner`` and ``State``; ``StreamLearner`` does what is the same for all that stream."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar, Generic, Protocol, TypeVar

import numpy as np
import torch
from typing_extensions import TypeVar as Defaulting

from erl_torch import checks
from erl_torch.experience.experience import EXPERIENCE, Experience, check_unweighted, permitted
from erl_torch.log.quantities import Quantity
from erl_torch.mdp.tabular import check_policy, uniform
from erl_torch.problem import Policy, Problem
from erl_torch.solution import Solution, Status

Table = torch.Tensor | np.ndarray | None
Metric = float | np.ndarray  # of one learner; [R] of replicas


WITH_WEIGHTS = "but CertaintyEquivalence and EfficientS1 have"


class NonFiniteError(ArithmeticError):
    """A table left the positive finite numbers. ``step`` counts u updates; ``cause`` names tuple and values."""

    def __init__(self, step: int, cause: str) -> None:
        super().__init__(step, cause)
        self.step, self.cause = step, cause

    def __str__(self) -> str:
        return f"step {self.step}: {self.cause}"


class State(Protocol):
    """What a learner knows after an epoch: a value, never changed in place."""

    def metrics(self) -> Mapping[str, Metric]:
        """What is logged, by name (docs/logging.md): the same names in every state of a run."""


class TabularState(State, Protocol):
    """The state of one learner of tables."""

    @property
    def policy(self) -> Policy:
        """The policy that it stands for."""

    @property
    def theta(self) -> float | None:
        """theta, reward a step; None where none is estimated."""

    @property
    def reward_bias(self) -> torch.Tensor | None:
        """delta of eq. (9), reward, [S, A]; None of a learner that has none."""

    def metrics(self) -> Mapping[str, float]: ...


class StreamState(TabularState, Protocol):
    """The state of a learner that streams tuples."""

    @property
    def epoch(self) -> int:
        """Passes over the stream, since the start or since the present biasing iteration began."""

    @property
    def n_tuples(self) -> int:
        """Tuples streamed since the start."""


S = TypeVar("S", bound=State)
T = TypeVar("T", bound=StreamState)
E = TypeVar("E", contravariant=True)  # kind of experience
A = TypeVar("A", covariant=True)  # kind of solution
P = Defaulting("P", contravariant=True, default=Problem)  # kind of problem
Prepared = TypeVar("Prepared")


class Learner(Protocol[S, E, A, P]):
    """What a run asks of a learner: a frozen dataclass whose fields are its settings, checked when it is made."""

    unit: ClassVar[str]  # what ``position`` counts: "tuples", or "iterations" of a solver
    needs_model: ClassVar[bool]  # it solves ``problem.mdp``, and learns nothing from experience

    @property
    def states(self) -> tuple[type, ...]:
        """Classes that its states are made of: what a checkpoint of it may hold."""

    def start(self, problem: P) -> S:
        """The state before anything is learnt: its policy is the prior. Raises InputError for a prior of other sizes,
        or a problem that it cannot learn or solve."""

    def run(self, problem: P, experience: E | None, state: S | None = None) -> Iterator[S]:
        """Yield the state after each epoch, from ``state`` on, until the learner is finished.

        Raises:
            InputError: a problem or experience that it cannot learn from.
            NonFiniteError: numbers that left double precision; the state yielded last is still good.
        """

    def position(self, state: S) -> int:
        """Where the records of ``state`` stand: tuples streamed so far, or iterations."""

    def work(self, state: S) -> int:
        """What is done so far, for the progress bar and the rate."""

    def total(self, experience: E | None) -> int | None:
        """What ``work`` comes to at most; None where nothing tells."""

    def milestone(self, state: S) -> str:
        """What has come to its end with ``state``, in words; "" in between. Milestones are always recorded."""

    def progress(self, state: S) -> str:
        """Where ``state`` stands, for the progress bar."""

    def solution(self, state: S, history: Sequence[Mapping[str, Any]] = (), failure: BaseException | None = None) -> A:
        """What ``state`` stands for.

        Args:
            state: of this learner.
            history: ``metrics()`` of the states up to ``state``.
            failure: what ended the run before the learner was finished.
        """


class TabularLearner(Learner[S, Experience, Solution], Protocol[S]):
    """One learner of tables. For those that stream tuples, ``StreamLearner`` has most of it."""

    quantities: ClassVar[tuple[Quantity, ...]]  # what it logs beside those of erl_torch.log.quantities

    @property
    def beta(self) -> float:
        """Inverse temperature, 1/reward."""

    @property
    def optimism(self) -> float:
        """Of the problem that it is held against: 1 optimistic (control as inference), 0 right, negative robust."""

    @property
    def reward_noise(self) -> str:
        """How rewards that vary for the same (s,a) count in that problem: by their "mean", or "joint" with s'."""

    @property
    def prior_policy(self) -> Table:
        """[S, A], 0 where a state does not have the action; None is uniform."""

    @property
    def averages_exp_reward(self) -> bool:
        """Whether noise in r counts as reward."""

    @property
    def assumed_optimism(self) -> float | None:
        """Of the dynamics, of a learner that has no choice in it, where that is not 0: of U-learning 1."""

    @property
    def drawn_from_prior(self) -> str:
        """The column that must be draws from the prior policy: "a", "a_next" or ""."""

    def init(self, n_states: int, n_actions: int) -> S:
        """``start``, of these sizes."""


CONTRACT = tuple(
    dict.fromkeys(
        name
        for kind in (Learner, TabularLearner)
        for name in {**vars(kind), **kind.__annotations__}
        if not name.startswith("_")
    )
)
"""Names of all that a learner of tables has."""


class StreamLearner(ABC, Generic[T, Prepared]):
    """A learner that streams tuples in epochs: a subclass has ``init``, ``prepare``, ``step``, ``finished`` and
    ``solution``."""

    unit: ClassVar[str] = "tuples"
    needs_model: ClassVar[bool] = False
    states: ClassVar[tuple[type, ...]] = ()
    quantities: ClassVar[tuple[Quantity, ...]] = ()
    stream_bytes: ClassVar[int] = 40  # memory of a tuple in ``prepare``d experience
    takes_weights: ClassVar[bool] = False  # weights of tuples count; elsewhere they are an error

    beta: float
    optimism: float = 0.0
    reward_noise: str = "mean"
    assumed_optimism: ClassVar[float | None] = None
    prior_policy: Table

    @property
    def averages_exp_reward(self) -> bool:
        return False

    @property
    def drawn_from_prior(self) -> str:
        return ""

    @property
    def passes(self) -> int:
        """Over the experience, at most."""
        return 1

    @abstractmethod
    def init(self, n_states: int, n_actions: int) -> T:
        """The state before any tuple: its policy is the prior. Raises InputError for a prior of other sizes."""

    @abstractmethod
    def prepare(self, transitions: Experience, n_states: int, n_actions: int) -> Prepared:
        """What is the same in every epoch, found once. Raises InputError for tuples out of range."""

    @abstractmethod
    def step(self, state: T, stream: Prepared) -> T:
        """The state after one more epoch. Pure: ``state`` is left as it is. Raises NonFiniteError."""

    @abstractmethod
    def finished(self, state: T) -> bool:
        """Whether no epoch follows."""

    @abstractmethod
    def solution(
        self, state: T, history: Sequence[Mapping[str, float]] = (), failure: BaseException | None = None
    ) -> Solution:
        """What ``state`` stands for; ``history`` holds one ``metrics()`` per epoch, ``failure`` is what ended it."""

    def fit(self, transitions: Experience, n_states: int, n_actions: int) -> Solution:
        """Run to the end and return the solution.

        A run that leaves the finite numbers ends with ``Status.NON_FINITE``, the tables of the last good epoch and a
        message with step and cause.

        Raises:
            InputError: a state or action out of range, or a prior policy of the wrong shape.
        """
        state = self.init(n_states, n_actions)
        history: list[Mapping[str, float]] = []
        failure: NonFiniteError | None = None
        try:
            for new in self.iterate(transitions, n_states, n_actions):
                check_numbers(new.n_tuples, new.theta, new.policy)
                state = new
                history.append(state.metrics())
        except NonFiniteError as error:
            failure = error
        return self.solution(state, history, failure)

    def iterate(self, transitions: Experience, n_states: int, n_actions: int, state: T | None = None) -> Iterator[T]:
        """Yield the state after each epoch, from ``state`` on, until it is ``finished``.

        The caller may log it, save it, or stop. Raises what ``prepare`` and ``step`` raise; the state yielded last is
        then still good.
        """
        checks.instance("transitions", transitions, Experience, EXPERIENCE)
        self.check_weights(transitions)
        stream = self.prepare(self.permitted(transitions, n_states, n_actions), n_states, n_actions)
        state = self.init(n_states, n_actions) if state is None else state
        while not self.finished(state):
            state = self.step(state, stream)
            yield state

    def check_weights(self, transitions: Experience) -> None:
        """Raise InputError where the tuples have weights that would count for nothing."""
        if not self.takes_weights:
            check_unweighted("transitions", transitions, f"{type(self).__name__} has no weights, {WITH_WEIGHTS}")

    def permitted(self, transitions: Experience, n_states: int, n_actions: int) -> Experience:
        """The tuples of actions that there are, those with a prior above 0: what is learnt from."""
        prior = check_policy("prior_policy", self.prior_policy, n_states, n_actions)
        return permitted(transitions, prior, self.drawn_from_prior == "a_next")

    def start(self, problem: Problem) -> T:
        """``init``, with the sizes of ``problem``, and the actions that its states have."""
        learner: StreamLearner[T, Prepared] = with_prior(self, problem.allowed)
        return learner.init(problem.n_states, problem.n_actions)

    def run(self, problem: Problem, experience: Experience | None, state: T | None = None) -> Iterator[T]:
        """``iterate``, with the sizes of ``problem``, and the actions that its states have."""
        assert experience is not None
        learner: StreamLearner[T, Prepared] = with_prior(self, problem.allowed)
        return learner.iterate(experience, problem.n_states, problem.n_actions, state)

    def position(self, state: T) -> int:
        """Tuples streamed so far."""
        return state.n_tuples

    def work(self, state: T) -> int:
        """Tuples streamed so far."""
        return state.n_tuples

    def total(self, experience: Experience | None) -> int | None:
        """Tuples to stream, at most."""
        return None if experience is None else self.passes * len(experience)

    def milestone(self, state: T) -> str:
        """``last pass`` once ``finished``."""
        return "last pass" if self.finished(state) else ""

    def progress(self, state: T) -> str:
        """Epoch and theta."""
        return f"epoch {state.epoch}" + ("" if state.theta is None else f" theta {state.theta:.4f}")

    def ended(self, state: T, failure: BaseException | None) -> Status:
        """NON_FINITE, STOPPED or COMPLETED."""
        if isinstance(failure, NonFiniteError):
            return Status.NON_FINITE
        return Status.COMPLETED if self.finished(state) else Status.STOPPED


def with_prior(learner: Any, allowed: np.ndarray) -> Any:  # of any class
    """``learner`` (or replicas of one), whose default prior is uniform over the actions of ``allowed`` [S, A] bool."""
    one = learner.learners[0] if hasattr(learner, "learners") else learner
    if allowed.all() or one.prior_policy is not None:
        return learner
    return _of_prior(learner, uniform(allowed))


def as_told(learner: Any, problem: Problem) -> tuple[Any, Problem]:
    """``learner`` (or replicas of one) and ``problem``, their prior on the actions that the environment has told while
    it was stepped; the shares of those that are left stay."""
    if problem.masks is None or problem.masks.allowed.all():
        return learner, problem
    if hasattr(learner, "learners"):
        learner.prior_policy(problem.n_states, problem.n_actions)  # the one of all
    kept = problem.prior * problem.allowed
    prior = kept / kept.sum(1, keepdims=True)
    return _of_prior(learner, prior), replace(problem, prior=prior)


def _of_prior(learner: Any, prior: np.ndarray) -> Any:
    if hasattr(learner, "learners"):
        return replace(learner, learners=tuple(replace(one, prior_policy=prior) for one in learner.learners))
    return replace(learner, prior_policy=prior)


def check_numbers(position: int, theta: float | None, policy: Policy | None = None) -> None:
    """Raise NonFiniteError where theta or the policy (None: not looked at) of one learner is no longer of numbers."""
    if theta is not None and not np.isfinite(theta):
        raise NonFiniteError(position, f"theta is {theta}")
    if policy is not None and not torch.isfinite(policy).all():
        raise NonFiniteError(position, "the policy has probabilities that are no numbers")


def message(failure: BaseException | None) -> str:
    """What a solution says of ``failure``: a run that was stopped has nothing to say."""
    return str(failure) if isinstance(failure, NonFiniteError) else ""


def columns(rows: Sequence[Mapping[str, Any]]) -> dict[str, np.ndarray]:
    """Rows of numbers (or arrays) with the same names, as one array per name."""
    return {name: np.array([row[name] for row in rows]) for name in (rows[0] if rows else ())}
