"""The optimum of a known model, and how far a solution is from it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from erl_torch.checks import InputError
from erl_torch.mdp.tabular import TabularMDP, check_policy
from erl_torch.solution import Solution, Status
from erl_torch.solvers import solve_soft_bellman
from erl_torch.solvers.policy import kl_per_state, objective, policy_chain, stationary_distribution


class Optimum(NamedTuple):
    """The proven solution of a model, which other solutions are measured against."""

    theta: float  # reward per step
    policy: np.ndarray  # [S, A]
    log_policy: np.ndarray  # [S, A], -inf where the prior is 0; finite also where the policy underflows
    stationary: np.ndarray  # [S], of that policy


def solve_optimum(
    mdp: TabularMDP, beta: float, prior_policy: ArrayLike | None = None, *, optimism: float = 0.0
) -> Optimum:
    """The optimum of ``mdp``; optimism as in ``solve_soft_bellman``: 1 optimistic (control as inference), 0 right,
    negative robust. Raises InputError unless the solver has proven it."""
    solution = solve_soft_bellman(mdp, beta, prior_policy, optimism=optimism)
    if solution.status is not Status.CONVERGED:
        raise InputError(
            "model",
            solution.status.name.lower(),
            f"one with an exact solution ({solution.message or solution.status.value})",
        )
    assert solution.theta is not None
    assert solution.action_value is not None
    assert solution.value is not None
    prior = check_policy("prior_policy", prior_policy, mdp.n_states, mdp.n_actions, mdp.allowed)
    policy = solution.policy.numpy()
    with np.errstate(divide="ignore"):
        log_policy = np.log(prior) + beta * (solution.action_value - solution.value[:, None]).numpy()
    return Optimum(
        solution.theta, policy, log_policy, stationary_distribution(policy_chain(mdp, policy).transition, mdp.start)
    )


def measure(
    mdp: TabularMDP,
    optimum: Optimum,
    solution: Solution,
    beta: float,
    prior_policy: ArrayLike | None = None,
    *,
    optimism: float = 0.0,
) -> dict[str, float]:
    """How far ``solution`` is from ``optimum``; long runs are those of the model.

    Args:
        prior_policy: [S, A], of the optimum; None is uniform. It counts where optimism is not 0 only.
        optimism: that of the optimum; 1 optimistic (control as inference), 0 right, negative robust.

    Returns:
        gap, g* - J(policy), reward per step; kl, KL(optimal policy || policy), nats, averaged over the long run of the
        optimal policy; kl_states, the same averaged over states; theta_error, reward per step, NaN where the solution
        has no theta; n_steps.
    """
    policy = solution.policy.detach().cpu().numpy()
    own = stationary_distribution(policy_chain(mdp, policy).transition, mdp.start)
    with np.errstate(divide="ignore", invalid="ignore"):
        loss = np.where(policy > 0, policy * (np.log(policy) - optimum.log_policy), 0.0).sum(1)
    kl = kl_per_state(optimum.policy, policy)
    gap = max(_mean(own, loss), 0.0) / beta
    if optimism != 0.0:  # the identity behind that holds at 0
        prior = check_policy("prior_policy", prior_policy, mdp.n_states, mdp.n_actions, mdp.allowed)
        gap = max(-optimum.theta - objective(mdp, policy, prior, beta, optimism=optimism), 0.0)
    return {
        "gap": gap,
        "kl": _mean(optimum.stationary, kl),
        "kl_states": float(kl.mean()),
        "theta_error": np.nan if solution.theta is None else abs(solution.theta - optimum.theta),
        "n_steps": float(solution.n_steps),
    }


def _mean(weight: np.ndarray, values: np.ndarray) -> float:
    used = weight > 0  # 0 * inf is nothing here
    return float(weight[used] @ values[used])
