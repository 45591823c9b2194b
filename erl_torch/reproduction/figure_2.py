"""Figure 2: a random windy maze; the policy of biasing iterations becomes that of soft policy iteration."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from erl_torch import iterate_biasing
from erl_torch.envs.grid_pictures import draw_grid, share_bar
from erl_torch.envs.mazes import random_maze
from erl_torch.pictures import COLOURS
from erl_torch.reproduction.artifact import (
    NOT_REPRODUCED,
    REPRODUCED,
    STATED,
    Artifact,
    Comparison,
    Output,
    Results,
    Units,
)
from erl_torch.solvers.optimum import solve_optimum
from erl_torch.solvers.policy import induced_distribution, kl_per_state

SIZE, TRAPS, WIND_LEVEL, BETA = 10, 10, 2.0, 30.0
HORIZON = 1000
ITERATIONS = 12
MAZES = {"quick": 5, "full": 100}
FLOOR = 1e-17  # of the logarithmic axis
ROUNDING = 1e-9  # nats: KL to the ground truth that counts as none


def units(scale: str, seed: int) -> Units:
    return {f"maze{i:03d}": {"maze_seed": seed + i} for i in range(MAZES[scale])}


def work(maze_seed: int) -> dict[str, Any]:
    mdp = random_maze(SIZE, TRAPS, wind_level=WIND_LEVEL, seed=maze_seed).mdp()
    optimum = solve_optimum(mdp, BETA)  # soft policy iteration
    kl, policy = [], optimum.policy
    for state in iterate_biasing(mdp, BETA, max_steps=ITERATIONS):
        # All states of a maze can be reached from its start.
        kl.append(np.maximum(kl_per_state(state.policy, optimum.policy), 0.0))
        policy = state.policy
    kl += kl[-1:] * (ITERATIONS - len(kl))  # ended by rounding
    return {"policy": policy, "distribution": induced_distribution(mdp, policy, HORIZON), "kl": np.array(kl)}


def assemble(results: Results, scale: str) -> Output:
    first = next(iter(results))
    kl = np.array([result["kl"] for result in results.values()])  # [mazes, iterations, S]
    worst, mean = kl.max(2), kl.mean(2)
    rows = [
        {"maze": name, "bias_iteration": k, "mean_kl": mean[i, k], "max_kl": worst[i, k]}
        for i, name in enumerate(results) for k in range(kl.shape[1])
    ]  # fmt: skip
    end = float(worst[:, -1].max())
    verdict = REPRODUCED if end < ROUNDING else NOT_REPRODUCED
    comparisons = [
        Comparison(
            "KL of the policy to ground truth at the end", "vanishes",
            f"at most {end:.1e} in {len(results)} mazes", verdict, STATED, ROUNDING,
        )
    ]  # fmt: skip
    maze_seed = int(first.removeprefix("maze"))
    reading = [
        "The authors' own maze is not known: a maze of the same law, drawn by this package's generator, is shown, and "
        f"{len(results)} of them are measured.",
        "Ground truth is soft policy iteration on the average-reward soft Bellman equation; KL(policy of the biasing "
        "iteration || ground truth) in nats, over all states.",
        "10 traps (not a density), no trap within one tile of S and G; trap -2; one first wind angle from [0, 2 pi].",
    ]
    return Output(rows, comparisons, _figure(results[first], maze_seed, worst, mean), reading)


def _figure(result: dict[str, np.ndarray], maze_seed: int, worst: np.ndarray, mean: np.ndarray) -> Figure:
    grid = random_maze(SIZE, TRAPS, wind_level=WIND_LEVEL, seed=maze_seed)
    figure = Figure(figsize=(9.8, 8.6))
    figure.text(0.03, 0.967, f"Figure 2: a random windy maze (beta {BETA:g})", fontsize=12, weight="bold")
    figure.text(
        0.03, 0.945, f"{SIZE} x {SIZE} tiles, {TRAPS} traps H at -2, wind Beta({WIND_LEVEL:g}, 2) (grey arrows); "
        f"policy in blue, share of time over {HORIZON} steps in orange", fontsize=8, color="#555555",
    )  # fmt: skip
    panels: list[tuple[str, dict[str, Any]]] = [
        (f"maze {maze_seed} and its wind", {}),
        ("optimal policy", {"policy": result["policy"], "wind": False}),
        ("induced distribution", {"distribution": result["distribution"], "wind": False}),
    ]
    for i, (title, content) in enumerate(panels):
        axes = figure.add_axes((0.03 + 0.47 * (i % 2), 0.49 - 0.47 * (i // 2), 0.42, 0.41))
        draw_grid(axes, grid, **content)
        axes.set_title(title, fontsize=10)
    top = float(result["distribution"].max())
    share_bar(figure, (0.455, 0.08, 0.01, 0.3), top)
    axes = figure.add_axes((0.595, 0.075, 0.36, 0.345))
    k = np.arange(worst.shape[1])
    for values, colour, name in ((worst, COLOURS[1], "largest of all states"), (mean, COLOURS[0], "mean over states")):
        low, high = (np.maximum(values.min(0), FLOOR), np.maximum(values.max(0), FLOOR))
        axes.fill_between(k, low, high, color=colour, alpha=0.15, linewidth=0)
        axes.plot(k, np.maximum(values[0], FLOOR), "o-", color=colour, markersize=3, label=name)
    axes.set_yscale("log")
    axes.set_xlabel("biasing iteration", fontsize=9)
    axes.set_ylabel("KL(policy || ground truth), nats", fontsize=9)
    axes.set_title(f"KL of the policy to ground truth\n(lines: this maze, bands: {len(worst)} mazes)", fontsize=10)
    axes.tick_params(labelsize=8)
    axes.legend(fontsize=8)
    return figure


ARTIFACT = Artifact("figure_2", "random maze of size 10 at beta 30", units, work, assemble)
