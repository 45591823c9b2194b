"""Figure 1: the windy cliff at beta 50, where the policy of the plain eigenvector relies on a wind that never blows."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse as sp
from matplotlib.figure import Figure

from erl_torch import perron, solve_soft_bellman
from erl_torch.envs.grid_pictures import draw_grid, share_bar
from erl_torch.envs.windy_cliff import WindyCliffEnv
from erl_torch.mdp.tabular import TabularMDP
from erl_torch.reproduction.artifact import (
    NOT_REPRODUCED,
    ORACLE,
    REPRODUCED,
    STATED,
    Artifact,
    Comparison,
    Output,
    Results,
    Units,
    compared,
    judged,
)
from erl_torch.solvers.policy import induced_distribution, policy_chain, reward_per_step, stationary_distribution

HORIZON = 1000
THETA = 0.9395271537
REWARD_RATE = -0.914773
OPTIMISTIC_THETA = 0.8366259
BY_ROW = [[0, 0.0852, 0.0403], [0, 0.0994, 0.1311], [0, 0.0994, 0.1847], [0, 0.0011, 0.1852], [0, 0.0863, 0.0872]]
TOP = 0.3  # share of time of the full colour
CASES = {"optimistic": "optimistic (no bias)", "optimal": "optimal (biased)"}


def units(scale: str, seed: int) -> Units:
    return {"cliff": {"beta": 50.0}}


def eigen_problem(mdp: TabularMDP, beta: float, log_psi: np.ndarray) -> dict[str, Any]:
    """Equation (4), uniform prior: both eigenvectors of the [S*A, S*A] tilted matrix under the biases of psi.

    Returns theta (the maximum of the reward biases is not subtracted), the policy [S, A] and the distribution [S] of
    u v: the long run of that policy in the biased dynamics.
    """
    p, n_actions = mdp.transition, mdp.n_actions
    psi = np.exp(log_psi - log_psi.max())
    mean_psi, mean_log_psi = p @ psi, p @ np.log(psi)
    biased = sp.diags_array(1 / mean_psi) @ p @ sp.diags_array(psi)  # equation (8)
    reward = mdp.reward.ravel() + (np.log(mean_psi) - mean_log_psi) / beta  # equation (9)
    # exp(beta r) alone leaves double precision nowhere here, but a common factor costs nothing.
    weight = np.exp(beta * (reward - reward.max()))
    spread = np.full((1, n_actions), 1.0 / n_actions)
    tilted = sp.csr_array(sp.kron(sp.diags_array(weight) @ biased, spread))
    u, v = perron(tilted), perron(tilted.T)
    log_share = (u.log_vector + v.log_vector).numpy()
    share = np.exp(log_share - log_share.max()).reshape(-1, n_actions)
    table = u.vector.numpy().reshape(-1, n_actions)
    return {
        "theta": -u.log_root / beta - float(reward.max()),
        "policy": table / table.sum(1, keepdims=True),
        "estimated": share.sum(1) / share.sum(),
    }


def work(beta: float) -> dict[str, Any]:
    mdp = WindyCliffEnv().mdp
    optimum = solve_soft_bellman(mdp, beta)
    assert optimum.value is not None
    result: dict[str, Any] = {"theta": optimum.theta}
    for case, log_psi in {"optimistic": np.zeros(mdp.n_states), "optimal": -beta * optimum.value.numpy()}.items():
        problem = eigen_problem(mdp, beta, log_psi)
        policy = problem["policy"]
        chain = policy_chain(mdp, policy)
        stationary = stationary_distribution(chain.transition, mdp.start)
        result |= {f"{case}_{name}": value for name, value in problem.items()}
        result[f"{case}_true"] = induced_distribution(mdp, policy, HORIZON)
        result[f"{case}_stationary"] = stationary
        result[f"{case}_reward_rate"] = stationary @ chain.reward
        result[f"{case}_reward_per_step"] = reward_per_step(mdp, policy, HORIZON)
    return result


def assemble(results: Results, scale: str) -> Output:
    cliff = results["cliff"]
    grid = WindyCliffEnv().grid
    ours = cliff["optimal_stationary"].reshape(grid.shape)
    apart = np.abs(ours - BY_ROW).max(1)
    gap = {case: _distance(cliff[f"{case}_estimated"], cliff[f"{case}_true"]) for case in CASES}
    told_apart = REPRODUCED if gap["optimal"] < 0.01 < 0.1 < gap["optimistic"] else NOT_REPRODUCED
    comparisons = [
        Comparison(
            "u v is the true distribution", "optimal only",
            f"off by {gap['optimal']:.1%} (optimal), {gap['optimistic']:.1%} (optimistic)", told_apart, STATED,
        ),
        compared("theta*", THETA, float(cliff["theta"]), 5e-11, ORACLE),
        compared("theta of the optimistic problem", OPTIMISTIC_THETA, float(cliff["optimistic_theta"]), 5e-8, ORACLE),
        compared("reward rate of the optimal policy", REWARD_RATE, float(cliff["optimal_reward_rate"]), 5e-7, ORACLE),
        *(
            Comparison(
                f"stationary distribution, row {i}", given, ours[i].round(4).tolist(),
                judged(bool(apart[i] <= 5e-5), ORACLE), ORACLE, 5e-5,
            )
            for i, given in enumerate(BY_ROW)
        ),
    ]  # fmt: skip
    rows = [
        {
            "row": s // 3, "col": s % 3, "tile": grid.tiles[s],
            **{
                f"{case}_{what}": cliff[f"{case}_{what}"][s] for case in CASES
                for what in ("estimated", "true", "stationary")
            },
            **{
                f"{case}_{action}": p for case in CASES
                for action, p in zip(grid.action_names, cliff[f"{case}_policy"][s].tolist(), strict=True)
            },
        }
        for s in range(grid.tiles.size)
    ]  # fmt: skip
    reading = [
        "Estimated: the product of the two eigenvectors of the tilted matrix, summed over actions. True: share of time "
        f"over {HORIZON} steps from S in the original dynamics.",
        'The percentages are total variation distances; "optimal only" holds where that is below 1 % for the optimal '
        "policy and above 10 % for the optimistic one.",
    ]
    data = {
        case: {
            "reward_per_step_1000": float(cliff[f"{case}_reward_per_step"]), "theta": float(cliff[f"{case}_theta"]),
            "distance_of_estimated_from_true": gap[case],
        }
        for case in CASES
    }  # fmt: skip
    return Output(rows, comparisons, _figure(cliff, gap), reading, data)


def _distance(p: np.ndarray, q: np.ndarray) -> float:
    return float(0.5 * np.abs(p - q).sum())


def _figure(cliff: dict[str, np.ndarray], gap: dict[str, float]) -> Figure:
    grid = WindyCliffEnv().grid
    figure = Figure(figsize=(9.4, 8.2))
    figure.text(0.03, 0.97, "Figure 1: the windy cliff (beta 50)", fontsize=12, weight="bold")
    figure.text(
        0.03, 0.947, "wind .7 at 3 pi/4: .35 left, .35 down, .30 none (grey arrows), on F tiles; trap H -5; policy in "
        "blue; share of time in orange", fontsize=8, color="#555555",
    )  # fmt: skip
    axes = figure.add_axes((0.03, 0.265, 0.21, 0.36))
    draw_grid(axes, grid)
    axes.set_title("tiles and wind", fontsize=9.5)
    for i, (case, title) in enumerate(CASES.items()):
        bottom = 0.5 - 0.47 * i
        panels = {
            f"{title}:\npolicy": None,
            "estimated share of time,\nu v": "estimated",
            "true share of time,\n1000 steps": "true",
        }
        for j, (head, what) in enumerate(panels.items()):
            axes = figure.add_axes((0.25 + 0.222 * j, bottom, 0.21, 0.36))
            if what is None:
                draw_grid(axes, grid, cliff[f"{case}_policy"])
            else:
                share = cliff[f"{case}_{what}"]
                draw_grid(axes, grid, distribution=share, top=TOP, wind=False)
                for s in np.flatnonzero(share > 0.005):
                    colour = "white" if grid.tiles[s] == "H" else "black"
                    axes.text(s % 3 + 0.44, s // 3 + 0.4, f"{share[s]:.3f}", fontsize=7, ha="right", color=colour)
            below = {
                "estimated": f"off by {gap[case]:.1%} (total variation)",
                "true": f"reward a step {cliff[f'{case}_reward_per_step']:.4f}",
            }.get(what or "", "")
            axes.text(1, 4.62, below, fontsize=8, ha="center", va="top")
            axes.set_title(head, fontsize=9.5)
    share_bar(figure, (0.925, 0.12, 0.012, 0.66), TOP, extend="max")
    return figure


ARTIFACT = Artifact("figure_1", "windy cliff at beta 50: optimistic and optimal", units, work, assemble)
