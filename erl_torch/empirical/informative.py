"""Which sample next: a behaviour policy that narrows the interval of theta fastest.

The variance of theta's estimate is a sum over pairs, sum_sa c(s,a)/n(s,a) with
c = d*(s,a)^2 Var(x) (docs/theory.md, 4): ``Estimate.variance * Estimate.visits``. Of n further tuples, a policy with
shares of time x(s,a) leaves

    f(x) = sum_sa c(s,a) / (n(s,a) + n x(s,a)),

which is convex in x, and the shares that policies have are a polytope. So the best of them is found by the steps of
Frank and Wolfe: the gradient is a table of rewards, and the policy with the largest mean of these is that of a soft
Bellman problem with little temperature. The best step between both is found by bisection.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from erl_torch import checks
from erl_torch.checks import InputError
from erl_torch.empirical.counts import EmpiricalMDP, empirical_mdp
from erl_torch.empirical.uncertainty import theta_uncertainty
from erl_torch.experience.collect import Source as Origin
from erl_torch.experience.collect import collect
from erl_torch.experience.sources import Report, Source
from erl_torch.experience.transitions import Transitions, join
from erl_torch.mdp.masks import ActionMasks
from erl_torch.mdp.tabular import check_prior
from erl_torch.problem import Problem
from erl_torch.rng import streams
from erl_torch.solvers.chains import SingularChainError, long_run
from erl_torch.solvers.problem import BellmanProblem
from erl_torch.solvers.soft_bellman import solve_problem

STEPS = 20  # of Frank and Wolfe
SHARPNESS = 300.0  # beta times the range of the gradient: the policy takes the best action but for e**-300 of the worst
LEAST_GAIN = 1e-3  # of f, of a step
BISECTIONS = 30
SHARE: tuple[Callable[[float], bool], str] = (lambda x: 0 <= x <= 1, "a number in [0, 1]")


def informative_policy(
    model: EmpiricalMDP,
    beta: float,
    n_more: int,
    prior_policy: np.ndarray | None = None,
    *,
    optimism: float = 0.0,
    explore: float = 0.3,
) -> np.ndarray:
    """The behaviour policy [S, A] whose ``n_more`` tuples narrow the interval of theta most, to first order.

    Args:
        model: what is known so far.
        beta, prior_policy, optimism: of the problem, as in ``theta_uncertainty``.
        n_more: tuples to come, >= 1.
        explore: in [0, 1], share of the prior in each state, for what was never met. It is mixed in afterwards: the
            design does not know of it.

    Returns:
        The policy; the prior in states that the data do not know, and everywhere where they give no interval.

    Raises:
        InputError: an argument out of range.
    """
    checks.instance("model", model, EmpiricalMDP, "an EmpiricalMDP, as of empirical_mdp")
    n_more = checks.at_least("n_more", n_more, 1)
    explore = checks.number("explore", explore, *SHARE)
    prior = check_prior("prior_policy", prior_policy, model.n_states, model.n_actions)
    estimate = theta_uncertainty(model, beta, prior_policy, optimism=optimism)
    if estimate.variance is None or estimate.visits is None or not np.isfinite(estimate.variance).all():
        return prior
    empirical = model.problem(beta, prior_policy)
    problem, states = empirical.problem, empirical.problem.states
    visits = estimate.visits[states].astype(np.float64)
    there = (problem.prior > 0) & (visits > 0)
    weight = np.where(there, estimate.variance[states] * visits, 0.0)
    try:
        share = _design(problem, weight, np.where(there, visits, 1.0), float(n_more))
    except SingularChainError:
        return prior
    of_state = share.sum(1, keepdims=True)
    policy = prior.copy()
    best = np.divide(share, of_state, out=problem.prior.copy(), where=of_state > 0)
    policy[states] = (1 - explore) * best + explore * prior[states]
    return np.asarray(policy / policy.sum(1, keepdims=True))


def _design(problem: BellmanProblem, weight: np.ndarray, visits: np.ndarray, n: float) -> np.ndarray:
    """Shares of time [n, A] that make sum weight/(visits + n share) small. Raises SingularChainError."""
    share = _shares(problem, problem.prior)

    def left(x: np.ndarray) -> float:
        return float((weight / (visits + n * x)).sum())

    for _ in range(STEPS):
        gradient = weight * n / (visits + n * share) ** 2
        top = float(gradient.max())
        if not top > 0:
            break
        linear = replace(problem, reward=gradient / top, beta=SHARPNESS, optimism=0.0)
        solution = solve_problem(linear, _Sizes(problem), tol=1e-4)
        towards = _shares(problem, solution.policy.numpy()[problem.states]) - share
        step = _line_search(weight, visits + n * share, n * towards)
        gain = left(share) - left(share + step * towards)
        share = np.maximum(share + step * towards, 0.0)
        if gain < LEAST_GAIN * left(share):
            break
    return share


@dataclass(frozen=True)
class _Sizes:
    """Those that solutions of ``problem`` are spread over."""

    problem: BellmanProblem

    @property
    def n_actions(self) -> int:
        return self.problem.n_actions

    @property
    def n_states(self) -> int:
        return int(self.problem.states.max()) + 1


def _line_search(weight: np.ndarray, at: np.ndarray, change: np.ndarray) -> float:
    """The step in [0, 1] with the least sum weight/(at + step change), by bisection of its slope."""
    low, high = 0.0, 1.0
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        slope = -float((weight * change / (at + middle * change) ** 2).sum())
        low, high = (middle, high) if slope < 0 else (low, middle)
    return low


def _shares(problem: BellmanProblem, policy: np.ndarray) -> np.ndarray:
    """Long-run shares of time [n, A] of a policy."""
    of_state = long_run(problem.chain(policy), problem.start).of_state
    return np.asarray(of_state[:, None] * policy)


def collect_informative(
    source: Origin,
    n_episodes: int,
    episode_length: int,
    beta: float,
    seed: int = 0,
    prior_policy: np.ndarray | None = None,
    *,
    optimism: float = 0.0,
    rounds: int = 10,
    explore: float = 0.3,
    report: Callable[[int], object] | None = None,
    masks: ActionMasks | None = None,
) -> Transitions:
    """``collect``, where the prior acts in the first of ``rounds`` equal parts, and then the policy that narrows the
    interval of theta most (``informative_policy``), found anew before each part.

    Args:
        source, n_episodes, episode_length, seed, prior_policy, report, masks: as of ``collect``.
        beta, optimism: of the problem whose theta is to be known.
        rounds: whole number >= 1; at most ``n_episodes``.
        explore: share of the prior in each state.

    Raises:
        InputError: as ``collect``.
    """
    n_episodes = checks.at_least("n_episodes", n_episodes, 1)
    rounds = min(checks.at_least("rounds", rounds, 1), n_episodes)
    explore = checks.number("explore", explore, *SHARE)
    checks.optimism("optimism", optimism, checks.temperature("beta", beta))
    drawn = streams(seed)
    parts: list[Transitions] = []
    done = 0
    behaviour: np.ndarray | None = None
    for k in range(rounds):
        here = n_episodes * (k + 1) // rounds - n_episodes * k // rounds
        part = collect(source, here, episode_length, drawn, behaviour, prior_policy, masks=masks)
        parts.append(part)
        done += len(part)
        if report is not None:
            report(done)
        if k + 1 < rounds:
            # Sizes: those of the tables, whatever was met so far.
            behaviour = _next_policy(parts, source, beta, len(part), prior_policy, optimism, explore)
    return join(parts)


def _next_policy(
    parts: list[Transitions],
    source: Origin,
    beta: float,
    n_more: int,
    prior_policy: np.ndarray | None,
    optimism: float,
    explore: float,
) -> np.ndarray | None:
    from erl_torch.envs.encoded import encoded
    from erl_torch.mdp.from_gymnasium import sizes

    model = empirical_mdp(join(parts), *sizes(encoded(source)))
    try:
        return informative_policy(model, beta, n_more, prior_policy, optimism=optimism, explore=explore)
    except InputError:  # nothing that is met comes back yet
        return None


@dataclass(frozen=True, eq=False)
class Informative(Source):
    """Collect tuples by the policy that narrows the interval of theta most.

    Args:
        beta: inverse temperature of the problem, 1/reward, > 0.
        optimism: 1 optimistic (control as inference), 0 right, negative robust.
        n_episodes, episode_length, rounds: whole numbers >= 1.
        explore: in [0, 1], share of the prior in each state.

    Raises:
        InputError: an argument out of its range.
    """

    designed_for: ClassVar[tuple[str, ...]] = ("beta", "optimism")

    beta: float
    optimism: float = 0.0
    n_episodes: int = 500
    episode_length: int = 1000
    rounds: int = 10
    explore: float = 0.3

    def __post_init__(self) -> None:
        checks.optimism("optimism", self.optimism, checks.temperature("beta", self.beta))
        for name in ("n_episodes", "episode_length", "rounds"):
            checks.at_least(name, getattr(self, name), 1)
        checks.number("explore", self.explore, *SHARE)

    @property
    def n_tuples(self) -> int:
        return self.n_episodes * self.episode_length

    def __call__(self, problem: Problem, seed: int, report: Report) -> Transitions:
        if problem.source is None:
            raise InputError("experience", type(self).__name__, "recorded: there is no environment to collect from")
        return collect_informative(
            problem.source,
            self.n_episodes,
            self.episode_length,
            self.beta,
            seed,
            problem.prior,
            optimism=self.optimism,
            rounds=self.rounds,
            explore=self.explore,
            report=report,
            masks=problem.masks,
        )
