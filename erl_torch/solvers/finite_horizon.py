"""The finite-horizon neighbour of the average-reward problem: V_H given, and backwards V_t = T V_{t+1} with

    TV(s) = (1/beta) log sum_a prior(a|s) exp(beta (r(s,a) + E_{s'|s,a} V(s'))).

Bounds. T is monotone. So from low <= V_{t+1} <= high follows T low <= V_t <= T high, and the ends of the rounding of
each backup (``certificate_kernels.gain_rows``) are carried along, one backward pass for each end.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import ArrayLike

from erl_torch import checks
from erl_torch.mdp.tabular import TabularMDP
from erl_torch.solution import Status
from erl_torch.solvers.certificates import policy_gains, soft_backup
from erl_torch.solvers.values import ValueSolution, down, start_bounds, up, whole_problem


def solve_finite_horizon(
    mdp: TabularMDP,
    beta: float,
    horizon: int,
    prior_policy: ArrayLike | None = None,
    last_value: ArrayLike | None = None,
) -> ValueSolution:
    """The policy, a table for each step, with the largest sum of ``horizon`` rewards less KL/beta, with bounds.

    As the horizon grows, V_0 - V_1 nears the average reward -theta of ``solve_soft_bellman``, where the chain of its
    policy is aperiodic.

    Args:
        mdp: the problem.
        beta: inverse temperature, 1/reward, > 0.
        horizon: steps, whole number >= 1.
        prior_policy: [S, A]; None is uniform.
        last_value: [S], reward, what the state after the last step is worth; None is 0.

    Returns:
        A ValueSolution with ``policy`` and ``action_value`` [horizon, S, A] and ``value`` and its bounds
        [horizon + 1, S]; ``gap`` is of the first step. Status CONVERGED: a backward pass has no other end.

    Raises:
        InputError: beta, horizon, prior or last value out of range, or tables that do not fit the memory.
    """
    problem = whole_problem(mdp, beta, prior_policy)
    horizon = checks.at_least("horizon", horizon, 1)
    n, n_actions = problem.n_states, problem.n_actions
    checks.memory("horizon", horizon, 8 * (horizon + 1) * n * (2 * n_actions + 4), f"tables of {horizon:,} steps")
    value = np.empty((horizon + 1, n))
    low, high, policy, q = (np.empty(s) for s in (value.shape, value.shape, *2 * [(horizon, n, n_actions)]))
    last = np.zeros(n) if last_value is None else checks.array("last_value", last_value, (n,), checks.FINITE)
    value[-1] = low[-1] = high[-1] = worth = last
    parts = (problem.transition, problem.reward, problem.prior, problem.beta)
    for t in range(horizon - 1, -1, -1):
        q[t] = problem.action_value(value[t + 1])
        value[t], policy[t] = soft_backup(q[t], problem.prior, problem.beta)
        low[t] = down(low[t + 1] + problem.gains(low[t + 1]).low)
        high[t] = up(high[t + 1] + problem.gains(high[t + 1]).high)
        worth = down(worth + policy_gains(*parts, policy[t], worth)[0])
    return ValueSolution(
        policy=torch.from_numpy(policy),
        value=torch.from_numpy(value),
        action_value=torch.from_numpy(np.where(problem.prior > 0, q, -np.inf)),
        value_low=torch.from_numpy(low),
        value_high=torch.from_numpy(high),
        start_bounds=start_bounds(problem.start, low[0], high[0]),
        gap=float(np.nextafter((high[0] - worth).max(), np.inf)),
        beta=problem.beta,
        n_steps=horizon,
        status=Status.CONVERGED,
    )
