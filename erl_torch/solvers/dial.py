"""The dynamics that a solution at some optimism has in mind, and what a turn of the dial does to theta.

At optimism lambda, with kappa = lambda beta and C V(s,a) = (1/kappa) log sum_s' p exp(kappa V(s')), the agent takes its
decisions as if successors came from

    q*(s'|s,a) = p(s'|s,a) exp(kappa (V(s') - C V(s,a)))

the dynamics that it hopes for (lambda > 0) or fears (lambda < 0), at a price of KL(q* || p)/kappa. theta never rises
with optimism; its derivatives are long-run means over (pi*, q*) (docs/theory.md, 9).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike

from erl_torch import checks
from erl_torch.checks import InputError
from erl_torch.mdp.tabular import TabularMDP
from erl_torch.solution import Solution, Status
from erl_torch.solvers.certificates import soft_backup
from erl_torch.solvers.chains import long_run
from erl_torch.solvers.policy import kl_per_state
from erl_torch.solvers.problem import BellmanProblem

SERIES_BELOW = 0.1  # |log(q/p)|, where q log(q/p) - q + p cancels


class DynamicsInMind(NamedTuple):
    """The dynamics that an agent hopes for or fears."""

    mdp: TabularMDP  # q* with the rewards and the start of the problem
    kl: np.ndarray  # KL(q*(.|s,a) || p(.|s,a)), [S, A], nats; 0 at optimism 0
    kl_per_step: float  # its mean in the long run of the solution's policy in q*, nats a step


class Slope(NamedTuple):
    """Derivatives of theta*, reward per step."""

    optimism: float  # at fixed beta; never above 0
    beta: float  # at fixed optimism


class _Solved(NamedTuple):
    """A value of a problem, with what it implies."""

    problem: BellmanProblem
    policy: np.ndarray  # pi_V, [n, A]
    dynamics: np.ndarray  # q_V, CSR data
    price: np.ndarray  # KL(q_V || p)/kappa^2, [n, A]; at optimism 0 its limit, Var_p(V)/2
    share: np.ndarray  # long-run shares of time in (pi_V, q_V), [n]


def dynamics_in_mind(solution: Solution, mdp: TabularMDP, prior_policy: ArrayLike | None = None) -> DynamicsInMind:
    """The dynamics behind ``solution``: hoped for above optimism 0, ``mdp`` itself at 0, feared below.

    Args:
        solution: of ``mdp``, with a beta; at its ``optimism``.
        mdp, prior_policy: as they were solved.

    Returns:
        A DynamicsInMind. States that the start does not lead to, and pairs with prior 0, keep their rows. A transition
        whose chance is below double precision is left out.

    Raises:
        InputError: a solution of other sizes, without beta, or without a single rate, or a prior out of range.
    """
    solved = _solved(solution, mdp, prior_policy)
    problem, p = solved.problem, mdp.transition
    inside = np.zeros(mdp.reward.shape, bool)
    inside[problem.states] = problem.prior > 0
    data = p.data.copy()
    # The states are closed under transitions and in order, so that the entries are, too.
    data[np.repeat(inside.reshape(-1), np.diff(p.indptr))] = solved.dynamics
    q = TabularMDP(sp.csr_array((data, p.indices, p.indptr), shape=p.shape), mdp.reward, mdp.start, allowed=mdp.allowed)
    kl = np.zeros(mdp.reward.shape)
    kl[problem.states] = problem.kappa**2 * solved.price
    return DynamicsInMind(q, kl, problem.kappa**2 * _mean(solved))


def slope(solution: Solution, mdp: TabularMDP, prior_policy: ArrayLike | None = None) -> Slope:
    """The derivatives of theta* with optimism and with beta, from a solution at one value of both.

    Exact for the exact solution, without solving anything again: at optimism 0, too. Arguments and errors as those of
    ``dynamics_in_mind``.
    """
    solved = _solved(solution, mdp, prior_policy)
    problem, price = solved.problem, _mean(solved)
    surprise = float(solved.share @ kl_per_state(solved.policy, problem.prior))
    # KL(q* || p)/lambda = lambda beta^2 price
    return Slope(-problem.beta * price, -surprise / problem.beta**2 - problem.optimism * price)


def _solved(solution: Solution, mdp: TabularMDP, prior_policy: ArrayLike | None) -> _Solved:
    checks.instance("solution", solution, Solution, "a Solution")
    checks.instance("mdp", mdp, TabularMDP, "a TabularMDP")
    if tuple(solution.policy.shape) != mdp.reward.shape:
        raise InputError(
            "solution", f"of shape {tuple(solution.policy.shape)}", f"of the shape of mdp, {mdp.reward.shape}"
        )
    if solution.beta is None:
        raise InputError("solution", None, "one with a beta")
    if solution.status in (Status.REDUCIBLE, Status.NO_SINGLE_RATE):
        raise InputError("solution", solution.status.name, "one with a single rate for all starts")
    problem = BellmanProblem.of(mdp, solution.beta, prior_policy, solution.optimism)
    value = -solution.log_psi.detach().cpu().numpy()[problem.states] / problem.beta
    if not np.isfinite(value).all():
        raise InputError(
            "solution", "log psi that is not finite", "a finite value in every state that the start leads to"
        )
    policy = soft_backup(problem.action_value(value), problem.prior, problem.beta)[1]
    dynamics = problem.tilt(problem.kappa * value)[2] if problem.kappa else problem.transition.data
    share = long_run(problem.chain(policy, dynamics), problem.start).of_state
    return _Solved(problem, policy, dynamics, price(problem, value, dynamics), share)


def price(problem: BellmanProblem, value: np.ndarray, dynamics: np.ndarray) -> np.ndarray:
    """d C V / d kappa = KL(q_V || p)/kappa^2, [n, A], for ``dynamics`` q_V (CSR data).

    A sum of terms that are not negative: no digit is lost as kappa tends to 0.
    """
    p, kappa = problem.transition, problem.kappa
    rows = np.repeat(np.arange(p.shape[0]), np.diff(p.indptr))
    above = value[p.indices] - problem.certainty_equivalent(value)[rows]
    z = kappa * above  # log(q/p)
    near = np.clip(z, -SERIES_BELOW, SERIES_BELOW)
    # ((z - 1) exp(z) + 1)/z^2 = sum_k z^k/(k! (k + 2))
    series, term = np.zeros_like(z), np.ones_like(z)
    for k in range(12):
        series += term / (k + 2)
        term *= near / (k + 1)
    terms = p.data * above**2 * series
    far = np.abs(z) > SERIES_BELOW
    terms[far] = (dynamics[far] * z[far] - dynamics[far] + p.data[far]) / kappa**2
    return np.bincount(rows, terms, p.shape[0]).reshape(problem.reward.shape)


def _mean(solved: _Solved) -> float:
    """Of the price, in the long run."""
    return float(solved.share @ (solved.policy * solved.price).sum(1))
