"""The exact optimum as what learnt policies are measured against."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from erl_torch.checks import InputError
from erl_torch.mdp.tabular import TabularMDP, check_policy
from erl_torch.solution import Solution, Status
from erl_torch.solvers import solve_soft_bellman
from erl_torch.solvers.policy import kl_per_state, policy_chain, stationary_distribution


class Optimum(NamedTuple):
    """The exact solution that policies are measured against."""

    theta: float  # reward a step
    policy: np.ndarray  # [S, A]
    log_policy: np.ndarray  # [S, A], finite also where the policy underflows
    stationary: np.ndarray  # [S], of that policy


def optimum(mdp: TabularMDP, beta: float, prior_policy: Any = None) -> Optimum:
    """The exact solution. Raises InputError unless the solver has proven it."""
    solution = solve_soft_bellman(mdp, beta, prior_policy)
    if solution.status is not Status.CONVERGED:
        raise InputError(
            "model",
            solution.status.name.lower(),
            f"one with an exact solution ({solution.message or solution.status.value})",
        )
    assert solution.theta is not None
    assert solution.action_value is not None
    assert solution.value is not None
    prior = check_policy("prior_policy", prior_policy, mdp.n_states, mdp.n_actions)
    policy = solution.policy.numpy()
    log_policy = np.log(prior) + beta * (solution.action_value - solution.value[:, None]).numpy()
    return Optimum(
        solution.theta, policy, log_policy, stationary_distribution(policy_chain(mdp, policy).transition, mdp.start)
    )


def measure(mdp: TabularMDP, best: Optimum, solution: Solution, beta: float) -> dict[str, float]:
    """gap, kl, kl_states, theta_error and n_steps of one solution."""
    policy = solution.policy.detach().cpu().numpy()
    own = stationary_distribution(policy_chain(mdp, policy).transition, mdp.start)
    with np.errstate(divide="ignore", invalid="ignore"):
        loss = np.where(policy > 0, policy * (np.log(policy) - best.log_policy), 0.0).sum(1)
    kl = kl_per_state(best.policy, policy)
    return {
        "gap": max(_mean(own, loss), 0.0) / beta,
        "kl": _mean(best.stationary, kl),
        "kl_states": float(kl.mean()),
        "theta_error": np.nan if solution.theta is None else abs(solution.theta - best.theta),
        "n_steps": float(solution.n_steps),
    }


def _mean(weight: np.ndarray, values: np.ndarray) -> float:
    used = weight > 0  # 0 * inf is nothing here
    return float(weight[used] @ values[used])
