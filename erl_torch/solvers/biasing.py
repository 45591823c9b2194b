"""Biasing iterations: the paper's Algorithm 1, exact.

With psi = exp(-beta V), one iteration computes the dominant right eigenvector y of

    M_V(s, s') = sum_a prior(a|s) exp(beta (r(s,a) + E V - V(s))) p(s'|s,a)

(the tilted, biased matrix summed over actions, [S, S]) and sets V += log(y)/beta. Its root exp(beta G(V)) never rises
from one iteration to the next, G(V) >= -theta*, and near the solution the error squares. In the iteration's own
optimal dynamics the transition probabilities are p(s'|s,a) y(s') / <y>: once they are p, V solves the problem.

Iteration 0 has V = 0, that is no bias: its policy is the optimistic one. ``k`` is the 0-based index of the first
iteration with KL(optimal dynamics || p) < 1e-6 in every (s,a). That is the number of bias updates, as Table S1 counts;
Table S2 counts eigen-solves, k + 1.

Another target (equations 23-25 of the paper). If the dynamics known before, ``mdp.transition``, are not those to be
solved for, the biased dynamics are p b ~ target psi. The old dynamics cancel: they enter iteration 0 alone, which
solves the old problem, and whose value is the start of the new one.

At another optimism than 0 (docs/theory.md, 9) C V = (1/kappa) log sum_s' p exp(kappa V(s')), kappa = optimism beta,
stands for E V, and the dynamics in mind q_V(s'|s,a) = p exp(kappa (V(s') - C V)) for p:

    M_V(s, s') = sum_a prior(a|s) exp(beta (r(s,a) + C V - V(s))) q_V(s'|s,a)

Iteration 0 is the same for every optimism. G(V) >= -theta* and falls up to optimism 1, where iteration 0 ends;
above 1 it is the other way round, G(V) <= -theta* and rises. q_V stays in logarithms: no transition is lost.
``k`` is then the first iteration with KL(optimal dynamics || q_V) < 1e-6: the dynamics in mind are consistent
with the value that they lead to.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from erl_torch import checks
from erl_torch.checks import InputError
from erl_torch.mdp.tabular import TabularMDP, check_prior
from erl_torch.solution import Solution, Status
from erl_torch.solvers import kernels
from erl_torch.solvers.certificates import soft_backup
from erl_torch.solvers.eigenpair import solve_log_perron
from erl_torch.solvers.newton import NewtonPattern
from erl_torch.solvers.problem import BellmanProblem
from erl_torch.solvers.result import bias, ended, explain_classes, reducible_solution
from erl_torch.solvers.soft_bellman import polish

KL_TOLERANCE = 1e-6
RTOL = 1e-13  # spread of the bounds on an eigenvalue
MAX_NEWTON_STEPS = 60
PATIENCE = 5  # iterations without an eigenvector in which KL stays the same and the bounds do not halve


@dataclass(frozen=True, eq=False)
class BiasingState:
    """One biasing iteration, on the problem's states."""

    k: int  # 0-based
    log_psi: np.ndarray  # [n], behind this iteration's biases; 0 in iteration 0
    reward_bias: np.ndarray  # delta, [n, A], reward
    # -G(V), at most theta*, above optimism 1 at least theta*; the middle of bounds on it where status is not CONVERGED
    theta: float
    policy: np.ndarray  # [n, A], optimal in the biased problem
    kl: np.ndarray  # KL(optimal dynamics || q_V of the target dynamics, which at optimism 0 are they), [n, A], nats
    value: np.ndarray  # [n], after the update: V + log(y)/beta
    theta_bounds: tuple[float, float]  # on theta*, the best of all iterations so far
    status: Status  # of the eigenpair
    newton_steps: int


def solve_biasing(
    mdp: TabularMDP,
    beta: float,
    prior_policy: ArrayLike | None = None,
    target: TabularMDP | None = None,
    tol: float = 1e-10,
    max_steps: int = 200,
    stop: str = "certificate",
    *,
    optimism: float = 0.0,
) -> Solution:
    """Algorithm 1 with certificates; ``optimism``: 1 optimistic (control as inference), 0 right, negative robust.

    Args:
        mdp: the problem; with ``target``, the model known before.
        beta, prior_policy: as in ``solve_soft_bellman``.
        target: the MDP to be solved, if it is not ``mdp`` itself; of the same shape.
        tol: width of the bounds on theta* at which to stop, as in ``solve_soft_bellman``.
        max_steps: biasing iterations at most.
        stop: "certificate", or "kl": at iteration k already (status STOPPED, unless the bounds are narrow by then).
        optimism: as in ``solve_soft_bellman``. Convergence is proven from 0 to 1; beyond, it is measured.

    Returns:
        A Solution with ``k`` (None if the KL test had not held by then) and the certificate of the last value. Where
        rounding alone keeps the bounds apart, a few Newton steps improve that value first. Status REDUCIBLE, and no
        theta, where the states that the start leads to are not one class (with ``target``, in one of the two MDPs): the
        eigenvector needs that. ``solve_soft_bellman`` needs less; the message says where it serves. Status
        NO_SINGLE_RATE below optimism 0 where the bounds stay apart; they hold for every start.

    Raises:
        InputError: an argument out of range, or a target of another shape.
    """
    checks.one_of("stop", stop, ("certificate", "kl"))
    checks.positive("tol", tol)
    problem, source = _problems(mdp, beta, prior_policy, target, optimism)
    prior_policy = check_prior("prior_policy", prior_policy, mdp.n_states, mdp.n_actions, mdp.allowed)
    message = _no_eigenvector(problem, source)
    if message:
        solution = reducible_solution(target or mdp, problem, prior_policy)
        if problem.regeneration_state() is not None:
            message += ". Soft policy iteration needs one closed set only"
            message += "" if source is None else ", of target's"
        return replace(solution, message=message)
    k: int | None = None
    state: BiasingState | None = None
    for state in iterate_biasing(mdp, beta, prior_policy, target, max_steps, optimism=optimism):
        if k is None and state.kl.max() < KL_TOLERANCE:
            k = state.k
        if problem.is_narrow(state.theta_bounds, tol, state.policy) or (stop == "kl" and k is not None):
            break
    assert state is not None
    if stop == "kl" and k is not None:
        solution = ended(
            target or mdp, problem, state.value, state.theta_bounds, tol, k + 1, max_steps, prior_policy, k
        )
        if solution.status is not Status.CONVERGED:
            solution = replace(
                solution, status=Status.STOPPED, message="at the first iteration with KL < 1e-6, as asked for"
            )
        return solution
    value, bounds = state.value, state.theta_bounds
    if state.k + 1 < max_steps:
        value, bounds = polish(problem, value, bounds, tol)
    return ended(target or mdp, problem, value, bounds, tol, state.k + 1, max_steps, prior_policy, k)


def iterate_biasing(
    mdp: TabularMDP,
    beta: float,
    prior_policy: ArrayLike | None = None,
    target: TabularMDP | None = None,
    max_steps: int = 200,
    *,
    optimism: float = 0.0,
) -> Iterator[BiasingState]:
    """Yield every biasing iteration, until ``max_steps``, or until rounding ends progress; ``optimism``: 1 optimistic
    (control as inference), 0 right, negative robust.

    Args:
        mdp, beta, prior_policy, target, optimism: as in ``solve_biasing``.
        max_steps: biasing iterations at most.

    Raises:
        InputError: an argument out of range, a target of another shape, or an MDP (``mdp`` or ``target``) whose start
            leads to states that are not one class.
    """
    problem, source = _problems(mdp, beta, prior_policy, target, optimism)
    checks.at_least("max_steps", max_steps, 1)
    message, ref = _no_eigenvector(problem, source), problem.regeneration_state()
    if message or ref is None:
        raise InputError("mdp", message, "one class of states, for an eigenvector")
    return _iterate(problem, ref, source, max_steps)


def _iterate(
    problem: BellmanProblem, ref: int, source: BellmanProblem | None, max_steps: int
) -> Iterator[BiasingState]:
    """``source``: the problem of iteration 0; None where it is ``problem``."""
    beta = problem.beta
    pattern = NewtonPattern.of(problem)
    source_pattern = pattern if source is None else NewtonPattern.of(source)
    value = np.zeros(problem.n_states)
    lower, upper = -np.inf, np.inf
    shift_before = width = np.inf
    lost, kl_before = 0, np.full(problem.reward.size, np.inf)
    for k in range(max_steps):
        at, at_pattern = (source or problem, source_pattern) if k == 0 else (problem, pattern)
        log_q = _log_dynamics(at, value)
        h, bounds, status, newton_steps = _eigenvector(at, value, log_q, at_pattern, ref)
        log_psi = -beta * value
        # The policy and the dynamics that are optimal in the biased problem.
        log_mean, kl, tilted = at.tilt(h) if at.kappa == 0 else _tilted_again(at, log_q, h)
        q = at.action_value(value) + log_mean.reshape(at.reward.shape) / beta
        policy = soft_backup(q, at.prior, beta)[1]
        if at is not problem:
            kl = _kl_to(problem, at, tilted)
        new = value + h / beta
        new -= new[ref]
        if np.isfinite(new).all():
            value = new
        elif k:  # the eigenvector is not finite: the value before is the last
            return
        gains = problem.gains(value)
        lower, upper = max(lower, gains.theta_bounds[0]), min(upper, gains.theta_bounds[1])
        yield BiasingState(
            k=k,
            log_psi=log_psi,
            reward_bias=bias(problem, log_psi),
            theta=-0.5 * sum(bounds) / beta,
            policy=policy,
            kl=kl.reshape(at.reward.shape),
            value=value,
            theta_bounds=(lower, upper),
            status=status,
            newton_steps=newton_steps,
        )
        shift = float(np.ptp(h))
        if shift <= 1e-13 * (1 + np.abs(beta * value).max()) and shift >= 0.5 * shift_before:
            return
        shift_before = shift
        # No eigenvector, and dynamics that no longer change: the value runs away by the same step in each iteration.
        lost += 1
        moved = not np.allclose(kl, kl_before, rtol=KL_TOLERANCE, atol=KL_TOLERANCE)
        if status is Status.CONVERGED or moved or upper - lower < 0.5 * width:
            lost, width = 0, upper - lower
        kl_before = kl
        if lost == PATIENCE:
            return


def _problems(
    mdp: TabularMDP, beta: float, prior_policy: ArrayLike | None, target: TabularMDP | None, optimism: float
) -> tuple[BellmanProblem, BellmanProblem | None]:
    """(the problem to be solved, the problem known before; None where they are the same)."""
    source = BellmanProblem.of(mdp, beta, prior_policy, optimism)
    if target is None:
        return source, None
    checks.instance("target", target, TabularMDP, "a TabularMDP")
    if target.reward.shape != mdp.reward.shape:
        raise InputError("target", f"MDP of shape {target.reward.shape}", f"of the shape of mdp, {mdp.reward.shape}")
    problem = BellmanProblem.of(target, beta, prior_policy, optimism)
    if not np.array_equal(target.allowed, mdp.allowed):
        raise InputError("target", "MDP", "one whose states have the same actions as those of mdp")
    if not np.array_equal(problem.states, source.states):
        raise InputError("target", "MDP", "one whose start leads to the same states as that of mdp")
    return problem, source


def _no_eigenvector(problem: BellmanProblem, source: BellmanProblem | None) -> str:
    """Why one of the two has no eigenvector that is positive everywhere; empty where both have."""
    if len(problem.classes[1]) > 1:
        return explain_classes(problem)
    if source is not None and len(source.classes[1]) > 1:
        return f"known before, beside target: {explain_classes(source)}"
    return ""


def _log_dynamics(problem: BellmanProblem, value: np.ndarray) -> np.ndarray:
    """log q_V as CSR data; log p at optimism 0."""
    p = problem.transition
    log_p = np.log(p.data)
    if problem.kappa == 0:
        return np.asarray(log_p)
    tilt = problem.kappa * value
    log_mean = problem.tilt(tilt)[0]
    return np.asarray(log_p + (tilt[p.indices] - np.repeat(log_mean, np.diff(p.indptr))))


def _tilted_again(
    problem: BellmanProblem, log_q: np.ndarray, h: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """As ``problem.tilt(h)``, of the dynamics exp(log_q) in place of p."""
    p = problem.transition
    length = np.diff(p.indptr)
    filled, rows = length > 0, np.repeat(np.cumsum(length > 0) - 1, length)
    first = p.indptr[:-1][filled]
    at = h[p.indices]
    weight = log_q + at
    top = np.maximum.reduceat(weight, first)
    tilted = np.exp(weight - top[rows])
    total = np.add.reduceat(tilted, first)
    tilted /= total[rows]
    log_mean, kl = np.zeros(len(length)), np.zeros(len(length))
    mean = top + np.log(total)
    log_mean[filled] = mean
    kl[filled] = np.maximum(np.add.reduceat(tilted * (at - mean[rows]), first), 0.0)
    return log_mean, kl, tilted


def _eigenvector(
    problem: BellmanProblem, value: np.ndarray, log_q: np.ndarray, pattern: NewtonPattern | None, ref: int
) -> tuple[np.ndarray, tuple[float, float], Status, int]:
    """Right eigenvector of M_V as its logarithm, with bounds on beta G(V); ``log_q``: log q_V as CSR data."""
    with np.errstate(divide="ignore"):  # of pairs that there are not, which have no entries
        log_prior = np.log(problem.prior)
    log_weight = problem.beta * (problem.action_value(value) - value[:, None]) + log_prior
    if pattern is not None:
        eigenvector = pattern.eigenvector(log_weight, log_q, ref, RTOL, MAX_NEWTON_STEPS)
        if eigenvector is not None:
            h, bounds, steps = eigenvector
            return h, bounds, Status.CONVERGED, steps

    ptr, ind, slot = problem.pattern
    log_m, p = np.empty(len(ind)), problem.transition
    kernels.merge_log_weights(p.indptr, log_q, log_weight, slot, ptr, log_m)
    start = np.zeros(problem.n_states)
    terms = int(np.diff(ptr).max()) + problem.n_actions
    return solve_log_perron(ptr, ind, log_m, start, RTOL, MAX_NEWTON_STEPS, terms, elimination=problem.elimination)


def _kl_to(problem: BellmanProblem, at: BellmanProblem, tilted: np.ndarray) -> np.ndarray:
    """KL(optimal dynamics || dynamics of ``problem``), [n*A]; infinite where these lack a transition."""
    p = at.transition
    rows = np.repeat(np.arange(p.shape[0]), np.diff(p.indptr))
    wanted = np.asarray(problem.transition[rows, p.indices]).ravel()
    with np.errstate(divide="ignore", invalid="ignore"):
        terms = np.where(tilted > 0, tilted * np.log(tilted / wanted), 0.0)
    kl, filled = np.zeros(p.shape[0]), np.diff(p.indptr) > 0
    kl[filled] = np.add.reduceat(terms, p.indptr[:-1][filled])
    return kl
