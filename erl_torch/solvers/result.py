"""From a value to a Solution with its certificate."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
import torch

from erl_torch.chains import RegenerativeLU, SingularChainError
from erl_torch.evaluation import kl_per_state
from erl_torch.mdp import check_policy
from erl_torch.solution import Solution, Status
from erl_torch.solvers.problem import Problem, soft_backup, theta_bounds


class Sized(Protocol):
    """An MDP as far as its answer is concerned."""

    @property
    def n_states(self) -> int: ...

    @property
    def n_actions(self) -> int: ...


def exact_solution(
    mdp: Sized,
    problem: Problem,
    value: np.ndarray,
    status: Status,
    n_steps: int,
    bounds: tuple[float, float],
    prior_policy: Any = None,
    message: str = "",
    k: int | None = None,
) -> Solution:
    """The solution that ``value`` [n] (on the problem's states) stands for; theta is the middle of the bounds."""
    beta = problem.beta
    q = problem.action_value(value)
    backed_up, policy = soft_backup(q, problem.prior, beta)
    theta = 0.5 * (bounds[0] + bounds[1])
    # J(pi_V) is not below the lower end that V itself proves; the bounds may come from another V.
    gap = theta_bounds(value, backed_up, problem.reward)[1] - bounds[0]
    # log u = beta V + log(pi/prior), so Q = log(u)/beta = V + q - TV.
    action_value = value[:, None] + q - backed_up[:, None]
    shift = max(action_value.max(), value.max())
    action_value, value = action_value - shift, value - shift
    log_psi = -beta * value
    reward_bias = bias(problem, log_psi)
    delta = float(reward_bias.max())
    with np.errstate(over="ignore", under="ignore"):
        u, psi = np.exp(beta * action_value), np.exp(log_psi)
        rho = float(np.exp(-beta * (theta + delta)))
    prior = check_policy("prior_policy", prior_policy, mdp.n_states, mdp.n_actions)
    return Solution(
        policy=spread(problem, policy, prior),
        u=spread(problem, u, np.ones_like(prior)),
        psi=spread(problem, psi, np.ones(mdp.n_states)),
        rho=rho,
        theta=theta,
        reward_bias=spread(problem, reward_bias, np.zeros_like(prior)),
        reward_bias_max=delta,
        n_steps=n_steps,
        status=status,
        message=message,
        beta=beta,
        value=spread(problem, value, np.zeros(mdp.n_states)),
        action_value=spread(problem, action_value, np.zeros_like(prior)),
        theta_bounds=bounds,
        gap=gap,
        k=k,
    )


def bias(problem: Problem, log_psi: np.ndarray) -> np.ndarray:
    """delta(s,a) = (log <psi> - <log psi>)/beta of equation (9), [n, A], reward."""
    delta = np.maximum(problem.tilt(log_psi)[0] - problem.transition @ log_psi, 0.0) / problem.beta
    return np.asarray(delta.reshape(problem.reward.shape))


def policy_gap(problem: Problem, policy: np.ndarray, bounds: tuple[float, float]) -> float | None:
    """Upper bound on g* - J(policy), reward a step; None where the policy's chain is not one class."""
    ref = problem.regeneration_state()
    if ref is None:
        return None
    reward = (policy * problem.reward).sum(1) - kl_per_state(policy, problem.prior) / problem.beta
    try:
        gain, _ = RegenerativeLU.adapted(problem.chain(policy), ref).poisson(reward)
    except SingularChainError:
        return None
    slack = 16 * np.finfo(np.float64).eps * (abs(gain) + np.abs(problem.reward).max())
    return float(max(-bounds[0] - gain, 0.0) + slack)


def reducible_solution(mdp: Sized, problem: Problem, prior_policy: Any) -> Solution:
    """The best policy and bounds that V = 0 proves, and a message that names the classes."""
    value = np.zeros(problem.n_states)
    backed_up, _ = soft_backup(problem.action_value(value), problem.prior, problem.beta)
    bounds = theta_bounds(value, backed_up, problem.reward)
    message = explain_classes(problem)
    return exact_solution(mdp, problem, value, Status.REDUCIBLE, 0, bounds, prior_policy, message)


def how_it_ended(
    problem: Problem, bounds: tuple[float, float], tol: float, steps: int, max_steps: int
) -> tuple[Status, str]:
    """(status, message) of an iteration that has stopped with these bounds on theta*."""
    if bounds[1] - bounds[0] <= tol * problem.reward_range:
        return Status.CONVERGED, ""
    if steps >= max_steps:
        return Status.STEP_LIMIT, ""
    if len(problem.classes[1]) > 1:
        return Status.REDUCIBLE, explain_classes(problem)
    return Status.STAGNATED, ""


def explain_classes(problem: Problem) -> str:
    """Why the states that the start leads to are no single recurrent class, and what to do."""
    label, closed = problem.classes

    def name(c: int) -> str:
        inside = problem.states[label == c]
        return f"{inside[:5].tolist()}{'...' if len(inside) > 5 else ''}"

    ends = [name(c) for c in np.flatnonzero(closed)[:5]]
    if closed.sum() > 1:
        return (
            f"{closed.sum()} closed sets of states, {', '.join(ends)}: let the process restart from them, "
            "or solve each apart"
        )
    others = [name(c) for c in np.flatnonzero(~closed)[:5]]
    return (
        f"once in the closed set {ends[0]}, the process never returns to {', '.join(others)}: let it restart, "
        "or solve those states apart (they may be better off never to leave)"
    )


def spread(problem: Problem, table: np.ndarray, elsewhere: np.ndarray) -> torch.Tensor:
    """A table on the problem's states as one on all states."""
    full = elsewhere.copy()
    full[problem.states] = table
    return torch.from_numpy(full)
