"""Soft policy iteration on the average-reward soft Bellman equation V + g = TV, g = -theta* (``problem.py``).

T is convex and monotone and its derivative is the chain of the policy pi_V, so Newton's step, one Poisson equation of
that chain, is soft policy iteration: J never falls, and the error squares near the solution.

Far from the solution the chain of pi_V may have sets that are all but closed, which double precision cannot tell from
closed ones. So the solver begins with a short horizon and lets it grow. With lambda = 1 - 1/horizon

    V + g = (1/beta) log sum_a prior exp(beta (r + lambda E V)),    V(ref) = 0

is the discounted problem in relative form, where Newton's matrix I - lambda K is well conditioned whatever the chain.
Each horizon starts from the value of the one before. Every V also carries a certificate of the undiscounted problem.
As soon as that shows that the solution is near, undiscounted steps finish; where they fail, the horizon grows on.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from erl_torch import checks
from erl_torch.mdp.tabular import TabularMDP, check_policy, check_prior
from erl_torch.solution import Solution
from erl_torch.solvers.certificates import soft_backup
from erl_torch.solvers.chains import RegenerativeLU, SingularChainError
from erl_torch.solvers.problem import BellmanProblem
from erl_torch.solvers.result import Sized, ended, policy_gap, reducible_solution

FIRST_HORIZON = 300.0  # steps
GROWTH = 100.0
LAST_HORIZON = 1e13
POLISHING_STEPS = 5
FIRST_RESIDUAL = 0.1  # relative to the reward range, at which the horizon grows; lower after each undiscounted try
UNDISCOUNTED_WIDTH = 0.3  # of the undiscounted bounds, relative to the reward range, at which discounting may end


@dataclass(frozen=True, eq=False)
class BellmanState:
    """A value and the bounds that it proves."""

    step: int  # linear systems solved
    horizon: float  # infinite once undiscounted
    value: np.ndarray  # [n], reward
    gain: np.ndarray  # TV - V, [n]
    policy: np.ndarray  # pi_V, [n, A]
    theta_bounds: tuple[float, float]  # on theta* of the undiscounted problem, by this value alone

    @property
    def width(self) -> float:
        return self.theta_bounds[1] - self.theta_bounds[0]


def solve_soft_bellman(
    mdp: TabularMDP, beta: float, prior_policy: ArrayLike | None = None, tol: float = 1e-10, max_steps: int = 200
) -> Solution:
    """The optimal entropy-regularised policy of ``mdp``, with two-sided bounds on theta*.

    Args:
        mdp: the problem, on the states that its start leads to.
        beta: inverse temperature, 1/reward, > 0.
        prior_policy: [S, A], 0 where an action is not to be taken; None is uniform over the actions of each state.
        tol: width of the bounds at which to stop, relative to max(|theta|, mean |r| that the policy meets in the long
            run) or, where that is less, the range of the rewards.
        max_steps: linear systems at most.

    Returns:
        A Solution with ``value``, ``theta_bounds`` and ``gap``. Status REDUCIBLE where the states that the start
        leads to do not form one recurrent class (the message names them), STAGNATED where rounding or a nearly
        closed set of states ends progress above ``tol`` (the bounds hold all the same). States that the start does
        not lead to keep the prior policy.

    Raises:
        InputError: beta, prior or tol out of range.
    """
    problem = BellmanProblem.of(mdp, beta, prior_policy)
    prior = check_prior("prior_policy", prior_policy, mdp.n_states, mdp.n_actions, mdp.allowed)
    return solve_problem(problem, mdp, prior, tol, max_steps)


def solve_problem(
    problem: BellmanProblem, mdp: Sized, prior_policy: ArrayLike | None = None, tol: float = 1e-10, max_steps: int = 200
) -> Solution:
    """As ``solve_soft_bellman``, for a problem on some states of ``mdp``, whose sizes alone count."""
    checks.positive("tol", tol)
    checks.at_least("max_steps", max_steps, 1)
    ref = problem.regeneration_state()
    if ref is None:
        return reducible_solution(mdp, problem, prior_policy)
    best = state = None
    lower, upper = -np.inf, np.inf
    for state in iterate_soft_bellman(problem, ref, tol, max_steps):
        lower, upper = max(lower, state.theta_bounds[0]), min(upper, state.theta_bounds[1])
        if best is None or state.width < best.width:
            best = state
    assert state is not None
    assert best is not None
    return ended(mdp, problem, best.value, (lower, upper), tol, state.step, max_steps, prior_policy)


def certify(
    solution: Solution,
    mdp: TabularMDP,
    beta: float,
    prior_policy: ArrayLike | None = None,
    best: Solution | None = None,
) -> Solution:
    """``solution``, however it was learnt, with the ``theta_bounds`` of ``mdp`` and the ``gap`` of its own policy.

    The bounds are those of ``best``, the ``solve_soft_bellman`` of the model; None solves the model now. The gap is the
    upper bound on g* less the lower bound on J(policy) from the start (``certificates.objective``).
    """
    checks.instance("solution", solution, Solution, "a Solution")
    if best is not None:
        checks.instance("best", best, Solution, "a Solution")
    problem = BellmanProblem.of(mdp, beta, prior_policy)
    bounds = (best or solve_soft_bellman(mdp, beta, prior_policy)).theta_bounds
    assert bounds is not None
    policy = check_policy("policy", solution.policy, mdp.n_states, mdp.n_actions, mdp.allowed)[problem.states]
    return replace(solution, theta_bounds=bounds, gap=policy_gap(problem, policy, bounds), beta=beta)


def iterate_soft_bellman(problem: BellmanProblem, ref: int, tol: float, max_steps: int) -> Iterator[BellmanState]:
    """Yield a state after each Newton step, until its bounds are as narrow as ``tol`` asks or progress ends."""

    def done(state: BellmanState) -> bool:
        return problem.is_narrow(state.theta_bounds, tol, state.policy)

    state = _state(problem, np.zeros(problem.n_states), 0, 0.0)
    yield state
    horizon, residual, home = FIRST_HORIZON, FIRST_RESIDUAL, ref
    while not done(state) and state.step < max_steps and horizon <= LAST_HORIZON:
        discount = 1 - 1 / horizon
        for once in range(50):
            backed_up, policy = soft_backup(problem.action_value(discount * state.value), problem.prior, problem.beta)
            error = backed_up - state.value
            if state.step >= max_steps or (once and np.ptp(error) <= residual * problem.reward_range):
                break
            lu = RegenerativeLU(problem.chain(policy), home, discount, problem.elimination)
            state = _state(problem, state.value + lu.poisson(error, refine=False)[1], state.step + 1, horizon)
            # Within the horizon the process spends most time here: it comes back to this state.
            ref = int(np.argmax(lu.stationary()))
            yield state
            if done(state):
                return
        if state.width < UNDISCOUNTED_WIDTH * problem.reward_range or horizon > 1e6:
            best, steps = state, state.step
            for new in _undiscounted(problem, state, ref, done, max_steps):
                yield new
                steps = new.step
                best = new if new.width < best.width else best
            state = replace(best, step=steps)
            residual *= 0.1
        horizon *= GROWTH


def polish(
    problem: BellmanProblem, value: np.ndarray, bounds: tuple[float, float], tol: float
) -> tuple[np.ndarray, tuple[float, float]]:
    """(value [n], bounds on theta*) after Newton steps from a value whose rounding keeps ``bounds`` apart."""
    ref = problem.regeneration_state()
    state = _state(problem, value, 0, np.inf)
    if ref is None or problem.is_narrow(bounds, tol, state.policy):
        return value, bounds

    def done(state: BellmanState) -> bool:
        return problem.is_narrow(state.theta_bounds, tol, state.policy)

    best, (lower, upper) = state, bounds
    for new in _undiscounted(problem, state, ref, done, POLISHING_STEPS):
        lower, upper = max(lower, new.theta_bounds[0]), min(upper, new.theta_bounds[1])
        best = new if new.width < best.width else best
    return best.value, (lower, upper)


def _undiscounted(
    problem: BellmanProblem, state: BellmanState, ref: int, done: Callable[[BellmanState], bool], max_steps: int
) -> Iterator[BellmanState]:
    """Newton steps from ``state`` until its bounds are ``done``, or have not halved in three steps."""
    widths = [state.width]
    lu: RegenerativeLU | None = None
    while not done(state) and state.step < max_steps:
        if len(widths) > 3 and min(widths[-3:]) > 0.5 * min(widths[:-3]):
            return
        new = _newton(problem, state, lu) if lu else None
        # Keep the factors of an earlier step while they still gain two digits.
        if new is None or not new.width < 0.01 * state.width:
            try:
                lu = problem.regeneration(state.policy, ref)
            except SingularChainError:
                return
            ref = lu.ref
            new = _newton(problem, state, lu)
        if not np.isfinite(new.width):
            return
        state = new
        widths.append(state.width)
        yield state


def _newton(problem: BellmanProblem, state: BellmanState, lu: RegenerativeLU) -> BellmanState:
    value = state.value + lu.poisson(state.gain)[1]
    return _state(problem, value - value[lu.ref], state.step + 1, np.inf)


def _state(problem: BellmanProblem, value: np.ndarray, step: int, horizon: float) -> BellmanState:
    gains = problem.gains(value)
    return BellmanState(step, horizon, value, gains.gain, gains.policy, gains.theta_bounds)
