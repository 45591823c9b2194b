"""Figure 4: the action "up" breaks, and the new solution is computed from the old one.

"up" still works with probability 1e-4, as in the published figure, or .01, as in the authors' later script.
"""

from __future__ import annotations

from typing import Any

from matplotlib.figure import Figure

from erl_torch import solve_biasing, solve_soft_bellman
from erl_torch.envs.grid_pictures import draw_grid, share_bar
from erl_torch.envs.shift import dynamics_shift
from erl_torch.reproduction.artifact import ORACLE, Artifact, Comparison, Output, Results, Units, compared
from erl_torch.solvers.policy import induced_distribution, reward_per_step

HORIZON = 1000
TOP = 0.4  # share of time of the full colour
# 1000-step returns: of the old policy after the shift, and of the new one
RETURNS = {"1e-4": (-1000.00, -946.76), "0.01": (-997.14, -947.14)}
ORIGINAL = -756.59


def units(scale: str, seed: int) -> Units:
    return {f"up-{name}": {"beta": 15.0, "up_success": float(name)} for name in RETURNS}


def work(beta: float, up_success: float) -> dict[str, Any]:
    before, after = (grid.mdp() for grid in dynamics_shift(up_success))
    old = solve_soft_bellman(before, beta).policy.numpy()
    # Iteration 0 solves the old problem: the old solution is the start.
    solution = solve_biasing(before, beta, target=after)
    new = solution.policy.numpy()
    cases = {"original": (before, old), "old_after": (after, old), "new": (after, new)}
    assert solution.theta_bounds is not None
    result: dict[str, Any] = {"theta_bounds": solution.theta_bounds, "n_iterations": solution.n_steps, "k": solution.k}
    for name, (mdp, policy) in cases.items():
        result[f"{name}_policy"] = policy
        result[f"{name}_return"] = HORIZON * reward_per_step(mdp, policy, HORIZON)
        result[f"{name}_distribution"] = induced_distribution(mdp, policy, HORIZON)
    return result


def assemble(results: Results, scale: str) -> Output:
    comparisons: list[Comparison] = []
    rows: list[dict[str, Any]] = []
    titles = {
        "original": "before the shift",
        "old_after": "old policy after it",
        "new": "new policy after it",
    }
    figure = Figure(figsize=(8.6, 6.9))
    figure.text(0.03, 0.965, 'Figure 4: the action "up" breaks (beta 15)', fontsize=12, weight="bold")
    figure.text(
        0.03, 0.938, "share of time over 1000 steps from S (orange), policy (blue), wind (grey); "
        "up works with .99 before, with the probability on the left after", fontsize=8, color="#555555",
    )  # fmt: skip
    for i, chance in enumerate(RETURNS):
        result = results[f"up-{chance}"]
        wanted = dict(zip(titles, (ORIGINAL, *RETURNS[chance]), strict=True))
        grids = dynamics_shift(float(chance))
        for j, (name, title) in enumerate(titles.items()):
            value = float(result[f"{name}_return"])
            if i == 0 or name != "original":
                label = "return of the original policy" if name == "original" else f"{title}, up {chance}"
                comparisons.append(compared(label, wanted[name], value, 0.005, ORACLE))
            rows.extend(
                {
                    "up_success": float(chance), "case": name, "return_1000_steps": value, "row": s // 4, "col": s % 4,
                    "tile": grids.before.tiles[s], "share_of_time": result[f"{name}_distribution"][s],
                    **dict(zip(grids.before.action_names, result[f"{name}_policy"][s].tolist(), strict=True)),
                }
                for s in range(16)
            )  # fmt: skip
            axes = figure.add_axes((0.06 + 0.288 * j, 0.5 - 0.46 * i, 0.27, 0.36))
            grid = grids.before if name == "original" else grids.after
            draw_grid(axes, grid, result[f"{name}_policy"], result[f"{name}_distribution"], TOP)
            axes.set_title(f"{title}\nreturn {value:.2f}", fontsize=9.5)
        figure.text(0.022, 0.68 - 0.46 * i, f"up works with {chance}", rotation=90, va="center", fontsize=10)
    share_bar(figure, (0.925, 0.12, 0.012, 0.66), TOP, extend="max")
    reading = [
        '"up" succeeds with probability 1e-4 after the shift (the script of May 2022, which made the published '
        "figure); .01, as the script of June 2023 has it, stands beside it.",
        "Returns are exact expectations over 1000 steps from S, undiscounted.",
    ]
    data = {
        name: {"theta_bounds": own["theta_bounds"].tolist(), "iterations": int(own["n_iterations"]), "k": int(own["k"])}
        for name, own in results.items()
    }
    return Output(rows, comparisons, figure, reading, {"solutions": data})


ARTIFACT = Artifact("figure_4", "dynamics shift at beta 15", units, work, assemble)
