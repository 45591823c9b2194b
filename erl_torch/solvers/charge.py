"""The smallest charge at which failures are as rare as asked for.

Every failing end costs c >= 0. With F(s,a) the probability that a step fails and g(c) the largest rate of
r - c F - KL/beta, g is convex in c, and g'(c) = -f(c), f the failing rate of the optimum: so f never rises, and the
smallest charge is c* = min {c >= 0: f(c) <= target}, by bisection. It is the Lagrange multiplier of "the largest
regularised rate, subject to a failing rate of at most target".

A target that no policy meets is said: the largest rate of -F, with any beta' > 0, is within log(1/min prior)/beta' of
that without KL, and ``solve_soft_bellman`` proves bounds on it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from erl_torch import checks
from erl_torch.checks import InputError
from erl_torch.mdp.tabular import TabularMDP
from erl_torch.solution import Solution, Status
from erl_torch.solvers.chains import long_run, policy_chain
from erl_torch.solvers.soft_bellman import solve_soft_bellman

LARGEST = 1e12  # charge tried, in units of the largest |r| or 1/beta
SHARP = 1e3  # how much smaller than the target the slack of its feasibility is


class Charge(NamedTuple):
    """The smallest charge, and the solution of the problem that it makes."""

    charge: float  # c >= 0, reward; the rewards of failing steps are less by it
    failing_rate: float  # of the optimum, failures a step, but for rounding
    mdp: TabularMDP  # with the rewards r - c F
    solution: Solution


def smallest_charge(
    mdp: TabularMDP,
    failing: ArrayLike,
    beta: float,
    target: float,
    prior_policy: ArrayLike | None = None,
    tol: float = 1e-9,
) -> Charge:
    """The smallest charge for each failure at which the optimal policy fails at a rate of at most ``target``.

    Exact but for rounding, and ``tol``, where ``mdp`` is the model; where it is counted from a log, of the counts (no
    bound on the failing rate in the real process is claimed). ``-charge`` is the ``end_reward`` of ``tabular_mdp``.

    Args:
        mdp: the process, in which an end leads to a start (on_end="restart").
        failing: [S, A], the probability that a step ends in failure (``model_ends``, ``chance_of_pairs``).
        beta: inverse temperature, 1/reward, > 0.
        target: failures a step, in (0, 1).
        prior_policy: [S, A]; None is uniform.
        tol: relative, of the charge.

    Returns:
        A Charge; 0 where the optimum without a charge already keeps to the target.

    Raises:
        InputError: an argument out of range, a problem without an exact solution, or a target that no policy meets (the
            message has the least failing rate).
    """
    checks.instance("mdp", mdp, TabularMDP, "a TabularMDP")
    beta = checks.temperature("beta", beta)
    target = checks.number("target", target, lambda x: 0 < x < 1, "a number in (0, 1), failures a step")
    checks.positive("tol", tol)
    f = checks.array("failing", failing, mdp.reward.shape, checks.NOT_NEGATIVE)

    def at(charge: float) -> Charge:
        charged = TabularMDP(mdp.transition, mdp.reward - charge * f, mdp.start, allowed=mdp.allowed)
        best = solve_soft_bellman(charged, beta, prior_policy)
        if best.status not in (Status.CONVERGED, Status.STAGNATED):
            allowed = f"one with an exact solution ({best.message or best.status.value})"
            raise InputError("mdp", best.status.name.lower(), allowed)
        return Charge(charge, failing_rate(charged, best.policy.numpy(), f), charged, best)

    low, high = 0.0, at(0.0)
    if high.failing_rate <= target:
        return high
    _check_feasible(mdp, f, target, prior_policy)
    unit = max(float(np.abs(mdp.reward).max()), 1 / beta)
    charge = unit
    while (high := at(charge)).failing_rate > target:
        low, charge = charge, 4 * charge
        if charge > LARGEST * unit:
            allowed = f"larger: with a charge of {low:g} failures are still at a rate of {high.failing_rate:.6g} a step"
            raise InputError("target", target, allowed)
    while high.charge - low > tol * high.charge:
        middle = at(0.5 * (low + high.charge))
        if not low < middle.charge < high.charge:
            break
        if middle.failing_rate <= target:
            high = middle
        else:
            low = middle.charge
    return high


def failing_rate(mdp: TabularMDP, policy: np.ndarray, failing: np.ndarray) -> float:
    """Failures a step in the long run of ``policy`` [S, A], ``failing`` [S, A] the probability of one."""
    share = long_run(policy_chain(mdp.transition, policy), mdp.start).of_state
    return float(share @ (policy * failing).sum(1))


def _check_feasible(mdp: TabularMDP, failing: np.ndarray, target: float, prior_policy: ArrayLike | None) -> None:
    """Raise InputError where no policy fails at a rate of ``target`` or less."""
    prior = np.full(mdp.reward.shape, 1 / mdp.n_actions) if prior_policy is None else np.asarray(prior_policy)
    surprise = max(float(-np.log(prior[prior > 0].min())), 1e-3)
    sharp = SHARP * surprise / target
    fails = TabularMDP(mdp.transition, -failing, mdp.start, allowed=mdp.allowed)
    least = solve_soft_bellman(fails, sharp, prior_policy)
    assert least.theta_bounds is not None
    low = least.theta_bounds[0] - surprise / sharp
    if low > target:
        raise InputError("target", target, f"at least {low:.6g}: every policy fails at that rate, or a larger one")
