"""Count the biasing iterations of random mazes, with exact eigenvectors, and as the authors' script does: with power
iterations that may not have converged."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from erl_torch.envs.mazes import random_mazes
from erl_torch.mdp.tabular import TabularMDP
from erl_torch.reproduction import kernels
from erl_torch.solvers.biasing import KL_TOLERANCE, solve_biasing
from erl_torch.solvers.problem import BellmanProblem

POWER_TOLERANCE = 1e-8  # move of log u / beta and log v / beta in one step
POWER_STEPS = 1000  # of one eigenvector, at most, in the script that made Table S1
MAX_ITERATIONS = 200


class Count(NamedTuple):
    k: int  # as in ``solve_biasing``; the last iteration where the test never held
    n_capped: int  # of the k + 1 eigenvectors, those cut off at the cap


def count_by_power_iteration(
    mdp: TabularMDP, beta: float, power_steps: int = POWER_STEPS, tolerance: float = POWER_TOLERANCE
) -> Count:
    """Count by Algorithm 1 with plain power iterations, each begun from ones and ended by the authors' rule or cap.

    Args:
        mdp: every state reachable from its start.
        beta: 1/reward.
        power_steps: the cap.
        tolerance: of the last move of log u / beta and log v / beta, reward.
    """
    problem = BellmanProblem.of(mdp, beta)
    p, reward = problem.transition, problem.reward.ravel()
    log_psi = np.zeros(problem.n_states)
    n_capped = 0
    for k in range(MAX_ITERATIONS):
        log_mean, _, biased = problem.tilt(log_psi)  # the biased dynamics
        biased_reward = reward + (log_mean - p @ log_psi) / beta
        biased_reward -= biased_reward.max()
        chi, _, converged = kernels.capped_power(
            p.indptr, p.indices, biased, beta * biased_reward, beta, tolerance, power_steps
        )
        n_capped += not converged
        if not (np.isfinite(chi).all() and chi.min() > 0):
            break  # all that follows is NaN, which passes no test
        log_chi = np.log(chi)
        if problem.tilt(log_chi + log_psi)[1].max() < KL_TOLERANCE:
            return Count(k, n_capped)
        log_psi = -log_chi
    return Count(MAX_ITERATIONS - 1, n_capped)


def count_cell(
    size: int, density: float, wind_level: float, beta: float, n: int, n_power: int, seed: int
) -> dict[str, Any]:
    """Counts of ``n`` random mazes of ``seed`` by exact eigenvectors, and of the first ``n_power`` by power iteration.

    Returns k [n]; power_k, power_capped [n_power].
    """
    grids = random_mazes(n, size, None, density, wind_level, seed)
    k = np.empty(n, np.int16)
    power_k, power_capped = np.empty(n_power, np.int16), np.empty(n_power, np.int16)
    for i, grid in enumerate(grids):
        mdp = grid.mdp()
        solution = solve_biasing(mdp, beta, max_steps=MAX_ITERATIONS, stop="kl")
        if solution.k is None:
            raise ArithmeticError(f"maze {i} of seed {seed}: {solution.status.name}, {solution.message}")
        k[i] = solution.k
        if i < n_power:
            power_k[i], power_capped[i] = count_by_power_iteration(mdp, beta)
    return {"k": k, "power_k": power_k, "power_capped": power_capped}
