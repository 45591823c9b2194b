"""The average-reward soft Bellman equation V + g = TV, g = -theta* (``problem.py``), solved by Newton's method.

T is monotone, and from optimism 0 up convex; its derivative is the chain of the policy pi_V, in the dynamics q_V. So
Newton's step is soft policy iteration, at optimism 0, where J never falls, and of agent and dynamics together above.
The error squares near the solution. ``horizons.py`` has the steps.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from erl_torch import checks
from erl_torch.checks import InputError
from erl_torch.mdp.tabular import TabularMDP, check_policy, check_prior
from erl_torch.solution import Solution
from erl_torch.solvers.horizons import Backup, BellmanState, iterate, undiscounted
from erl_torch.solvers.nested import objective
from erl_torch.solvers.problem import BellmanProblem
from erl_torch.solvers.result import Sized, ended, policy_gap, reducible_solution

POLISHING_STEPS = 5


def solve_soft_bellman(
    mdp: TabularMDP,
    beta: float,
    prior_policy: ArrayLike | None = None,
    tol: float = 1e-10,
    max_steps: int = 200,
    *,
    optimism: float = 0.0,
) -> Solution:
    """The optimal entropy-regularised policy of ``mdp`` and two-sided bounds on theta*, for an agent that is right
    about the dynamics (optimism 0), optimistic (above; 1 is control as inference) or robust (negative).

    Args:
        mdp: the problem, on the states that its start leads to.
        beta: inverse temperature, 1/reward, > 0.
        prior_policy: [S, A], 0 where an action is not to be taken; None is uniform over the actions of each state.
        tol: width of the bounds at which to stop, relative to max(|theta|, mean |r| that the policy meets in the long
            run) or, where that is less, the range of the rewards.
        max_steps: linear systems at most.
        optimism: any number; r(s,a) counts as it is, E V becomes (1/kappa) log E exp(kappa V), kappa = optimism * beta.

    Returns:
        A Solution with ``value``, ``theta_bounds`` and ``gap``. Status REDUCIBLE where the states that the start
        leads to do not form one recurrent class (the message names them), NO_SINGLE_RATE below optimism 0 where the
        bounds do not close: there the optimal rate may depend on the start, and they hold for each. STAGNATED where
        rounding or a nearly closed set of states ends progress above ``tol`` (the bounds hold all the same). States
        that the start does not lead to keep the prior policy.

    Raises:
        InputError: beta, prior, tol or optimism out of range.
    """
    problem = BellmanProblem.of(mdp, beta, prior_policy, optimism)
    prior = check_prior("prior_policy", prior_policy, mdp.n_states, mdp.n_actions, mdp.allowed)
    return solve_problem(problem, mdp, prior, tol, max_steps)


@np.errstate(over="ignore", invalid="ignore")  # a value beyond double precision has infinite bounds
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
    bounds = lower, upper
    if problem.kappa < 0 and not problem.is_narrow(bounds, tol, best.policy):
        bounds = _both_sides(problem, best, bounds, tol)
    return ended(mdp, problem, best.value, bounds, tol, state.step, max_steps, prior_policy)


def _both_sides(
    problem: BellmanProblem, state: BellmanState, bounds: tuple[float, float], tol: float
) -> tuple[float, float]:
    """``bounds`` on theta*, below optimism 0, with what the policy of ``state`` is worth in the dynamics that it fears,
    and the best that can be had in the dynamics that ``state`` fears; from every start, as ``bounds`` are."""
    everywhere = np.full(problem.n_states, 1 / problem.n_states)
    parts = (problem.transition, problem.reward, problem.prior, problem.beta, state.policy, everywhere)
    worth = objective(*parts, optimism=problem.optimism).low
    best = polish(problem.feared(state.value), state.value, (-np.inf, np.inf), tol)[1][0]
    return max(bounds[0], best), min(bounds[1], -worth)


def certify(
    solution: Solution,
    mdp: TabularMDP,
    beta: float,
    prior_policy: ArrayLike | None = None,
    best: Solution | None = None,
    *,
    optimism: float | None = None,
) -> Solution:
    """``solution``, however it was learnt, with the ``theta_bounds`` of ``mdp`` and the ``gap`` of its own policy.

    optimism: 1 optimistic (control as inference), 0 right, negative robust; None: that of ``solution``.

    The bounds are what the values of ``best``, the ``solve_soft_bellman`` of the model, prove of this problem, whatever
    they are of; None solves the model now. The gap is the upper bound on g* less the lower bound on J(policy) from the
    start (``nested.objective``).

    Raises:
        InputError: as ``solve_soft_bellman``, or a ``best`` without values, or of another beta, optimism or size, or
            whose bounds are not of this problem.
    """
    checks.instance("solution", solution, Solution, "a Solution")
    if best is not None:
        checks.instance("best", best, Solution, "a Solution")
    optimism = solution.optimism if optimism is None else optimism
    problem = BellmanProblem.of(mdp, beta, prior_policy, optimism)
    if best is not None and (best.beta, best.optimism) != (problem.beta, problem.optimism):
        told, asked = (
            f"beta {x:g}, optimism {y:g}" for x, y in ((best.beta or np.nan, best.optimism), (beta, optimism))
        )
        raise InputError("best", f"of {told}", f"of {asked}")
    if best is None:
        bounds = solve_soft_bellman(mdp, beta, prior_policy, optimism=optimism).theta_bounds
        assert bounds is not None
    else:
        bounds = _proven_by(best, problem, mdp.n_states)
    return with_bounds(solution, problem, bounds, mdp)


def _proven_by(best: Solution, problem: BellmanProblem, n_states: int) -> tuple[float, float]:
    """The bounds on theta* of ``problem`` that one backup of the values of ``best`` proves. Raises InputError."""
    if best.value is None or best.theta_bounds is None:
        raise InputError("best", "solution without values and theta_bounds", "one of solve_soft_bellman, with them")
    if len(best.value) != n_states:
        raise InputError("best", f"of {len(best.value)} states", f"of the model, with {n_states}")
    lower, upper = problem.gains(best.value.numpy()[problem.states]).theta_bounds
    if not (lower <= best.theta_bounds[1] and best.theta_bounds[0] <= upper):
        told = " to ".join(f"{x:.6g}" for x in best.theta_bounds)
        raise InputError("best", f"theta* from {told}", f"of this model: its values prove {lower:.6g} to {upper:.6g}")
    return lower, upper


def with_bounds(solution: Solution, problem: BellmanProblem, bounds: tuple[float, float], mdp: TabularMDP) -> Solution:
    """``certify``, with bounds that are those of ``problem``, the one of ``mdp``."""
    policy = check_policy("policy", solution.policy, mdp.n_states, mdp.n_actions, mdp.allowed)[problem.states]
    return replace(
        solution,
        theta_bounds=bounds,
        gap=policy_gap(problem, policy, bounds),
        beta=problem.beta,
        optimism=problem.optimism,
    )


def iterate_soft_bellman(problem: BellmanProblem, ref: int, tol: float, max_steps: int) -> Iterator[BellmanState]:
    """Yield a state after each Newton step, until its bounds are as narrow as ``tol`` asks or progress ends."""
    return iterate(Backup(problem), ref, _narrow(problem, tol), max_steps)


def polish(
    problem: BellmanProblem, value: np.ndarray, bounds: tuple[float, float], tol: float
) -> tuple[np.ndarray, tuple[float, float]]:
    """(value [n], bounds on theta*) after Newton steps from a value whose rounding keeps ``bounds`` apart."""
    ref, backup = problem.regeneration_state(), Backup(problem)
    state = backup.state(value, 0, np.inf)
    if ref is None or problem.is_narrow(bounds, tol, state.policy):
        return value, bounds
    best, (lower, upper) = state, bounds
    for new in undiscounted(backup, state, ref, _narrow(problem, tol), POLISHING_STEPS):
        lower, upper = max(lower, new.theta_bounds[0]), min(upper, new.theta_bounds[1])
        best = new if new.width < best.width else best
    return best.value, (lower, upper)


def _narrow(problem: BellmanProblem, tol: float) -> Callable[[BellmanState], bool]:
    return lambda state: problem.is_narrow(state.theta_bounds, tol, state.policy)
