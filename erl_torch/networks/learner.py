"""Average-reward learners with networks, for Discrete actions: ``DeepS1`` and ``AverageSoftQ``.

Both have the fixed point of the tables' problem, Q = r + E V(s'), V = (1/beta) log sum_a pi0 exp(beta Q) - g, by the
squared loss, whose minimum is a mean: nothing is clipped, and no loss is Huber's, whose minimum is none (theory page,
11). ``DeepS1`` fits r + V(s') with a lagged V, and V by a network of its own, as S1 has <log psi> beside psi;
``AverageSoftQ`` (average-reward soft Q-learning, ASQL) has V from the lagged Q. Where the truth is known they are a
draw.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import torch

from erl_torch import checks
from erl_torch.checks import InputError
from erl_torch.learners.learner import NonFiniteError
from erl_torch.networks import autograd, kernels
from erl_torch.networks.layout import Layout, mlp
from erl_torch.networks.live import Exploration, Live, Walk
from erl_torch.networks.policy import ActorPolicy, NetworkPolicy
from erl_torch.networks.problem import BoxProblem
from erl_torch.networks.replay import COLUMNS, Recorded, Replay, Steps
from erl_torch.solution import Status

LIMIT = 3.0  # the slope of the exponential loss is capped at exp(LIMIT)
COMPILED_WIDTH = 256  # widest hidden layer that the compiled path takes by itself
PATHS = ("auto", "compiled", "autograd")
ENDS = ("restart", "episodic")


@dataclass(frozen=True, eq=False)
class NetworkState:
    """What one learner of one seed knows: a value.

    Args:
        weights, lagged, m, v: float32 vectors (``erl_torch.networks.kernels``).
        numbers: [N_NUMBERS] float64, as there.
        random: state of the generator of minibatches.
        replay: the tuples so far.
        walk: where the environment is; None of recorded tuples.
        figures: what is logged, by name.
    """

    weights: torch.Tensor
    lagged: torch.Tensor
    m: torch.Tensor
    v: torch.Tensor
    numbers: np.ndarray
    random: np.ndarray
    replay: Replay
    walk: Walk | None
    figures: dict[str, float]

    @property
    def n_updates(self) -> int:
        return int(self.numbers[kernels.UPDATES])

    @property
    def theta(self) -> float:
        """Minus the regularised reward a step, as estimated over the minibatches of the last epoch."""
        return self.figures["theta"]

    def metrics(self) -> Mapping[str, float]:
        return self.figures


@dataclass(frozen=True, eq=False)
class NetworkSolution:
    """What learners of networks have come to.

    Args:
        status: COMPLETED, STOPPED or NON_FINITE.
        message: what ended it before.
        theta: [K], minus the regularised reward a step, as the networks of each seed estimate it.
        states: of each seed.
        n_steps: of the environment, of each; of recorded tuples updates.
    """

    status: Status
    message: str
    theta: np.ndarray
    states: tuple[NetworkState, ...]
    n_steps: int


@dataclass(frozen=True, eq=False, kw_only=True)
class NetworkLearner:
    """What both learners share; frozen settings, checked when it is made.

    Args:
        beta: inverse temperature, 1/reward, > 0.
        optimism: 0 right; 1 the optimistic agent of control as inference; negative robust. Not 0: for demonstrations,
            as the slope of its loss is capped.
        n_steps: of the environment, or updates on recorded tuples, >= 1.
        epoch_steps: of them between states, >= 1.
        hidden: widths of the hidden layers.
        lr, lr_end_fraction: Adam's rate, which falls on a line to that fraction of it.
        tau: share of the way that the lagged copy goes in an update, in (0, 1].
        g_rate: the same of the reward rate g, in (0, 1].
        batch: tuples of an update, >= 1.
        updates_per_step: >= 1; the first one comes when a batch is stored.
        replay_size: tuples kept; None is all.
        explore_start, explore_end, explore_fraction, explore_hold: ``Exploration``.
        on_termination: "restart": an end leads to where the next episode begins, the average-reward problem;
            "episodic": an end is worth 0 and there is no rate, the undiscounted problem of one episode.
        train_time_limit: steps of an episode while it learns; None is the environment's own limit, 0 is none.
        reward_scale: factor of rewards in the networks, > 0; beta, theta and penalties are of the rewards as they are.
        support_penalty: weight of staying near the recorded actions (conservative Q-learning's form), reward, >= 0.
        path: "compiled" (two hidden layers, CPU), "autograd" (any), or "auto".
        device: of torch, where updates are made; compiled ones on the CPU.

    Raises:
        InputError: an argument out of its range.
    """

    beta: float = 10.0
    optimism: float = 0.0
    n_steps: int = 60_000
    epoch_steps: int = 5000
    hidden: tuple[int, ...] = (64, 64)
    lr: float = 1e-3
    lr_end_fraction: float = 0.02
    tau: float = 0.01
    g_rate: float = 0.01
    batch: int = 64
    updates_per_step: int = 1
    replay_size: int | None = None
    explore_start: float = 1.0
    explore_end: float = 0.1
    explore_fraction: float = 0.5
    explore_hold: float = 1.0
    on_termination: str = "restart"
    train_time_limit: int | None = None
    reward_scale: float = 1.0
    support_penalty: float = 0.0
    path: str = "auto"
    device: str = "cpu"

    unit: ClassVar[str] = "steps"
    needs_model: ClassVar[bool] = False
    separate: ClassVar[bool]  # whether V has a network of its own

    def __post_init__(self) -> None:
        checks.temperature("beta", self.beta)
        checks.optimism("optimism", self.optimism, self.beta)
        for key in ("n_steps", "epoch_steps", "batch", "updates_per_step"):
            checks.at_least(key, getattr(self, key), 1)
        hidden = checks.sequence("hidden", self.hidden)
        for width in hidden:
            checks.at_least("hidden", width, 1)
        if not hidden:
            raise InputError("hidden", "[]", "at least one width, as [64,64]")
        object.__setattr__(self, "hidden", tuple(map(int, hidden)))
        for key in ("lr", "reward_scale"):
            checks.positive(key, getattr(self, key))
        for key in ("tau", "g_rate"):
            checks.step_size(key, getattr(self, key))
        if self.replay_size is not None:
            checks.at_least("replay_size", self.replay_size, self.batch)
        if self.train_time_limit is not None:
            checks.at_least("train_time_limit", self.train_time_limit, 0)
        share = "a number in [0, 1]"
        for key in ("explore_start", "explore_end", "lr_end_fraction"):
            checks.number(key, getattr(self, key), lambda x: 0 <= x <= 1, share)
        checks.number("explore_fraction", self.explore_fraction, lambda x: 0 < x <= 1, "a number in (0, 1]")
        checks.number("explore_hold", self.explore_hold, lambda x: 1 <= x < math.inf, "a number >= 1")
        checks.number("support_penalty", self.support_penalty, lambda x: 0 <= x < math.inf, "a number >= 0")
        checks.one_of("on_termination", self.on_termination, ENDS)
        checks.one_of("path", self.path, PATHS)
        checks.device("device", self.device)
        if self.path == "compiled" and (len(hidden) != 2 or self.device != "cpu"):
            raise InputError("path", self.path, "autograd or auto, for other than two hidden layers, or off the CPU")

    @property
    def states(self) -> tuple[type, ...]:
        return (NetworkState, Walk, Replay)

    # -- networks -------------------------------------------------------------------------------------

    @property
    def scaled_beta(self) -> float:
        """In the units of the networks."""
        return self.beta / self.reward_scale

    def policy(self, problem: BoxProblem, state: NetworkState) -> NetworkPolicy | ActorPolicy:
        """What ``state`` has learnt."""
        return self._policy(problem, state.weights)

    def _policy(self, problem: BoxProblem, weights: torch.Tensor) -> NetworkPolicy:
        q, _ = self.layouts(problem)
        return NetworkPolicy(q, weights[: q.size], self.scaled_beta)

    @property
    def compiled(self) -> bool:
        """Whether updates are made by compiled loops."""
        small = len(self.hidden) == 2 and max(self.hidden) <= COMPILED_WIDTH and self.device == "cpu"
        return self.path == "compiled" or (self.path == "auto" and small)

    def layouts(self, problem: BoxProblem) -> tuple[Layout, Layout | None]:
        """Of Q and of V; None without a network of V."""
        q = mlp(problem.n_observation, self.hidden, problem.n_actions)
        return q, mlp(problem.n_observation, self.hidden, 1) if self.separate else None

    def check(self, problem: BoxProblem) -> None:
        """Raise InputError for a problem that it cannot learn."""
        if not problem.n_actions:
            allowed = "deep_s1 or asac, for actions in a box (in Python ActorCriticS1 or AverageActorCritic)"
            raise InputError("learner", type(self).__name__, allowed)

    def _start(self, problem: BoxProblem, rng: np.random.Generator) -> tuple[np.ndarray, slice]:
        """(weights, which of them the lagged copy is of)."""
        q, v = self.layouts(problem)
        own = q.start(rng, zero_output=self.separate)
        if v is None:
            return own, slice(0, q.size)
        return np.concatenate([own, v.start(rng, zero_output=True)]), slice(q.size, None)

    def init(
        self, problem: BoxProblem, seed: int, replay: Replay | None = None, walk: Walk | None = None
    ) -> NetworkState:
        """The state of ``seed`` before the first update."""
        self.check(problem)
        rng, draws = (np.random.default_rng(one) for one in np.random.SeedSequence([seed, 1]).spawn(2))
        start, copied = self._start(problem, rng)
        weights = torch.from_numpy(start)
        random = np.array([int(draws.integers(2**63))], np.uint64).view(np.int64)
        figures = dict.fromkeys(self.names(replay is None), math.nan)
        if replay is None:
            replay = Replay.empty(problem.n_observation, len(problem.low), self.replay_size or self.n_steps)
        zero = torch.zeros_like(weights)
        return NetworkState(
            weights, weights[copied].clone(), zero, zero.clone(), np.zeros(kernels.N_NUMBERS), random, replay, walk,
            figures,
        )  # fmt: skip

    def names(self, live: bool) -> tuple[str, ...]:
        """Of its ``metrics()``; ``live``: of an environment that it steps."""
        band = ("residual_lower", "residual_upper") if self.separate else ()
        own = ("exploration", "episode_return") if live else ()
        return ("theta", "g", "loss", "kl", *band, *own)

    # -- epochs ---------------------------------------------------------------------------------------

    def epoch(self, problem: BoxProblem, state: NetworkState, live: Live | None) -> NetworkState:
        """The state after ``epoch_steps`` more steps, or what is left; ``state`` is left as it is.

        Raises:
            NonFiniteError: weights that left the finite numbers.
            InputError: as ``Live.collect``.
        """
        n = min(self.epoch_steps, self.n_steps - self.position(state))
        weights, lagged, m, v = (x.clone() for x in (state.weights, state.lagged, state.m, state.v))
        numbers, random = state.numbers.copy(), state.random.copy()
        numbers[kernels.THETA_SUM :] = 0.0
        walk, replay = state.walk, state.replay
        if live is None:
            self._updates(problem, replay, weights, lagged, m, v, numbers, random, self.n_steps)(replay.n, n)
        else:
            assert walk is not None
            replay = replay.with_room(n)
            n_total = self.n_steps * self.updates_per_step
            learn = self._updates(problem, replay, weights, lagged, m, v, numbers, random, n_total)
            schedule = Exploration(self.explore_start, self.explore_end, self.explore_fraction, self.explore_hold)
            walk, replay = live.collect(
                walk, replay, n, self.n_steps, schedule, self._chooser(problem, weights),
                lambda stored: learn(stored, self.updates_per_step) if stored >= self.batch else None,
                self.reward_scale, problem.time_limit if self.train_time_limit is None else self.train_time_limit,
            )  # fmt: skip
        if not (torch.isfinite(weights).all() and math.isfinite(numbers[kernels.G])):
            raise NonFiniteError(self.position(state), f"weights left the finite numbers within {n} steps")
        new = NetworkState(weights, lagged, m, v, numbers, random, replay, walk, {})
        return replace(new, figures=self._figures(problem, new, n))

    def _updates(
        self, problem: BoxProblem, replay: Replay, weights: torch.Tensor, lagged: torch.Tensor, m: torch.Tensor,
        v: torch.Tensor, numbers: np.ndarray, random: np.ndarray, n_total: int,
    ) -> Any:  # fmt: skip
        """(tuples stored, updates) -> None, in place."""
        log_prior = _log_prior(problem)
        beta = float(self.scaled_beta)
        kappa = float(self.optimism * beta)
        penalty = float(self.support_penalty * self.reward_scale)
        episodic = self.on_termination == "episodic"
        lr_end = self.lr * self.lr_end_fraction
        if self.compiled:
            arrays = [x.numpy() for x in (weights, lagged, m, v)]
            fixed = [getattr(replay, name) for name in COLUMNS]
            draws = random.view(np.uint64)
            tail = (
                *self.hidden, self.batch, self.separate, beta, kappa, log_prior, float(self.lr), lr_end, n_total,
                float(self.tau), float(self.g_rate), penalty, episodic, LIMIT,
            )  # fmt: skip

            def compiled(stored: int, n: int) -> None:
                kernels.advance(*arrays, numbers, draws, *fixed, stored, n, *tail)

            return compiled
        q, value = self.layouts(problem)
        columns = tuple(torch.from_numpy(getattr(replay, name)) for name in COLUMNS)
        prior = torch.from_numpy(log_prior)
        draws = random.view(np.uint64)

        def plain(stored: int, n: int) -> None:
            autograd.advance(
                q, value, weights, lagged, m, v, numbers, draws, columns, stored, n, self.batch, beta, kappa, prior,
                self.lr, lr_end, n_total, self.tau, self.g_rate, penalty, episodic, LIMIT,
            )  # fmt: skip

        return plain

    def _chooser(self, problem: BoxProblem, weights: torch.Tensor) -> Any:
        """(observation [1, d], uniform numbers) -> action, of the weights as they are when it is called."""
        q, _ = self.layouts(problem)
        if self.compiled:
            vector = weights.numpy()[: q.size]
            h1, h2 = self.hidden
            beta = float(self.scaled_beta)
            log_prior = _log_prior(problem)
            return lambda observation, uniform: kernels.act(vector, h1, h2, log_prior, beta, observation, uniform[0])
        policy = self._policy(problem, weights)
        return lambda observation, uniform: policy.draw(observation, uniform[None])[0][0]

    def _figures(self, problem: BoxProblem, state: NetworkState, n: int) -> dict[str, float]:
        """What is logged of ``state``, whose last epoch had ``n`` steps."""
        numbers, scale = state.numbers, self.reward_scale
        count = numbers[kernels.SUMMED]

        def mean(place: int) -> float:
            return float(numbers[place] / count) if count else math.nan

        replay = state.replay
        recent = np.arange(replay.at - min(n, replay.n), replay.at) % len(replay.reward)
        kl, residual = self._told(problem, state.weights, replay.observation[recent])
        found = {
            "theta": mean(kernels.THETA_SUM) / scale,
            "g": float(numbers[kernels.G]) / scale,
            "loss": mean(kernels.LOSS_SUM) / scale**2,
            "kl": float(kl.mean()),
        }
        if residual is not None:
            low, high = np.quantile(residual / scale, [0.05, 0.95])
            found |= {"residual_lower": float(low), "residual_upper": float(high)}
        if state.walk is not None:
            schedule = Exploration(self.explore_start, self.explore_end, self.explore_fraction, self.explore_hold)
            returns = state.walk.returns
            found["exploration"] = schedule.share(state.walk.n_steps, self.n_steps)
            found["episode_return"] = float(np.mean(returns)) if returns else math.nan
        return found

    def _told(
        self, problem: BoxProblem, weights: torch.Tensor, observation: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """(KL to the prior, soft Q - V or None without a network of V), [N], at observations [N, d]."""
        policy, (_, v_layout) = self._policy(problem, weights), self.layouts(problem)
        kl = policy.draw(observation, np.zeros((len(observation), 1)))[1]
        if v_layout is None:
            return kl, None
        soft = torch.logsumexp(policy.beta * policy.action_values(observation).double(), 1) - math.log(
            problem.n_actions
        )
        value = v_layout.output(weights[policy.layout.size :], torch.from_numpy(observation))[:, 0]
        return kl, (soft / policy.beta - value.double()).numpy()

    # -- the contract ---------------------------------------------------------------------------------

    def start(self, problem: BoxProblem) -> NetworkState:
        """The state of seed 0 of ``problem``, without an environment."""
        return self.init(problem, 0)

    def begin(self, problem: BoxProblem, experience: Live | Recorded | Steps) -> NetworkState:
        """The state before anything is learnt from ``experience``; of ``Steps`` alone the seed is 0."""
        if isinstance(experience, Live):
            return self.init(problem, experience.seed, None, experience.start())
        recorded = experience if isinstance(experience, Recorded) else Recorded(experience)
        recorded.steps.check(problem)
        scaled = replace(recorded.steps, reward=recorded.steps.reward * np.float32(self.reward_scale))
        return self.init(problem, recorded.seed, Replay.of(scaled))

    def run(
        self, problem: BoxProblem, experience: Live | Recorded | Steps, state: NetworkState | None = None
    ) -> Iterator[NetworkState]:
        """Yield the state after each epoch, from ``state`` on, until ``n_steps``."""
        state = self.begin(problem, experience) if state is None else state
        live = experience if isinstance(experience, Live) else None
        while self.position(state) < self.n_steps:
            state = self.epoch(problem, state, live)
            yield state

    def solution(
        self, state: NetworkState, history: Sequence[Mapping[str, Any]] = (), failure: BaseException | None = None
    ) -> NetworkSolution:
        """What ``state`` stands for."""
        return solution_of(self, (state,), failure)

    def position(self, state: NetworkState) -> int:
        """Steps so far; of recorded tuples updates."""
        return state.n_updates if state.walk is None else state.walk.n_steps

    def work(self, state: NetworkState) -> int:
        return self.position(state)

    def total(self, experience: object = None) -> int:
        return self.n_steps

    def milestone(self, state: NetworkState) -> str:
        """``last step`` at the end."""
        return "last step" if self.position(state) >= self.n_steps else ""

    def progress(self, state: NetworkState) -> str:
        """Theta, and the returns of episodes."""
        text = f"theta {state.theta:.4f}"
        earned = state.figures.get("episode_return", math.nan)
        return text if math.isnan(earned) else f"{text} return {earned:.4g}"


@dataclass(frozen=True, eq=False, kw_only=True)
class DeepS1(NetworkLearner):
    """S1 with networks (S1-V): one for Q, which fits r + V(s') of a lagged V, and one for V."""

    separate: ClassVar[bool] = True


@dataclass(frozen=True, eq=False, kw_only=True)
class AverageSoftQ(NetworkLearner):
    """Average-reward soft Q-learning (ASQL): one network, which fits r - g + V(s') of its lagged copy."""

    separate: ClassVar[bool] = False


def solution_of(
    learner: NetworkLearner, states: tuple[NetworkState, ...], failure: BaseException | None
) -> NetworkSolution:
    """What one learner for each of several seeds has come to; ``failure`` is what ended the run."""
    n = learner.position(states[0])
    lost = isinstance(failure, NonFiniteError)
    status = Status.NON_FINITE if lost else Status.COMPLETED if n >= learner.n_steps else Status.STOPPED
    said = "" if failure is None else str(failure) if lost else f"{type(failure).__name__}: {failure}"
    return NetworkSolution(status, said, np.array([one.theta for one in states]), states, n)


def _log_prior(problem: BoxProblem) -> np.ndarray:
    return np.full(problem.n_actions, -math.log(problem.n_actions))
