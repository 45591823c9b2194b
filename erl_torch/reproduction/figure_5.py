"""Figure 5: Algorithm S1 on the windy cliff, replicas of the published run; and other learners on the same data."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from erl_torch import AlgorithmS1, CertaintyEquivalence, EfficientS1, collect, iterate_biasing
from erl_torch.envs.windy_cliff import WindyCliffEnv
from erl_torch.learners import DifferentialSoftQ
from erl_torch.pictures import COLOURS
from erl_torch.reproduction.artifact import (
    ORACLE,
    PICTURE,
    Artifact,
    Comparison,
    Output,
    Results,
    Units,
    compared,
    compared_samples,
)
from erl_torch.solvers.optimum import measure, solve_optimum
from erl_torch.solvers.policy import objective, reward_per_step

BETA, HORIZON = 10.0, 1000
N_EPOCHS, N_BIAS = 15, 6
SETTINGS = {
    "beta": BETA, "n_episodes": 500, "episode_length": 1000, "lr_u": 0.005, "lr_psi": 0.1,
    "n_epochs": N_EPOCHS, "n_bias": N_BIAS,
}  # fmt: skip
REPLICAS = {"quick": 4, "full": 40}
# Ends of the published curves, read off the plot, and half a unit of the last digit read; iteration 5 is not plotted.
PUBLISHED = [(-1.29, 5e-3), (-0.985, 5e-4), (-0.957, 5e-4), (-0.966, 5e-4), (-0.966, 5e-4)]
PUBLISHED_REPLICAS = 5  # the default of the authors' plotting function
PUBLISHED_PRIOR, PUBLISHED_OPTIMAL = -1.626, -0.956
# max |V - V*| after each exact iteration, and half a unit of the last digit
EXACT_VALUE_ERRORS = [(0.31, 5e-3), (0.085, 5e-4), (0.015, 5e-4), (7.7e-4, 5e-6), (2.2e-6, 5e-8), (2e-11, 5e-12)]
# Our learner, its loss g* - J as a mean over STREAMS streams of the same length, and half a unit of the last digit.
STREAMS = 6
GAPS = {
    "s1": ("Algorithm S1", 2.4e-3, 5e-5),
    "sample_mean": ("S1 with sample-mean psi", 9.7e-4, 5e-6),
    "sample_mean_expected": ("S1 with sample-mean psi, expected backup", 1.55e-5, 5e-8),
    "certainty_equivalence": ("certainty equivalence", 1.5e-5, 5e-7),
    "soft_q": ("average-reward soft Q, one pass", 1.5e-4, 5e-6),
}
EFFICIENT = "improved learner"
QUANTILES = (0.1, 0.9)


def units(scale: str, seed: int) -> Units:
    return {f"replica{i:03d}": {**SETTINGS, "seed": seed + i} for i in range(REPLICAS[scale])}


def work(
    beta: float, n_episodes: int, episode_length: int, lr_u: float, lr_psi: float, n_epochs: int, n_bias: int, seed: int
) -> dict[str, Any]:
    """One stream: Algorithm S1 and the improved learner after each epoch, and the end of others.

    ``reward`` and ``objective`` are [n_bias, n_epochs], of S1's policies; ``efficient_*`` are [passes].
    """
    mdp = WindyCliffEnv().mdp
    optimum = solve_optimum(mdp, beta)
    prior = np.full_like(mdp.reward, 1 / mdp.n_actions)
    data = collect(mdp, n_episodes, episode_length, seed)
    sizes = mdp.n_states, mdp.n_actions

    def worth(policy: np.ndarray) -> tuple[float, float]:
        return reward_per_step(mdp, policy, HORIZON), objective(mdp, policy, prior, beta)

    learner = AlgorithmS1(
        beta, lr_u, lr_psi=lr_psi, n_epochs=n_epochs, n_bias=n_bias, rho_init="carry", self_loop="old"
    )
    states = list(learner.iterate(data, *sizes))
    curves = np.array([worth(state.policy.numpy()) for state in states])
    result: dict[str, Any] = {
        "reward": curves[:, 0].reshape(n_bias, n_epochs),
        "objective": curves[:, 1].reshape(n_bias, n_epochs),
        "theta": np.array([state.theta for state in states]).reshape(n_bias, n_epochs)[:, -1],
    }
    improved = np.array([worth(state.policy.numpy()) for state in EfficientS1(beta).iterate(data, *sizes)])
    result |= {"efficient_reward": improved[:, 0], "efficient_objective": improved[:, 1]}
    others: dict[str, Any] = {
        "sample_mean": EfficientS1.published(beta, sample_mean_psi=True, warm_start=True),
        "sample_mean_expected": EfficientS1.published(
            beta, sample_mean_psi=True, expected_backup=True, warm_start=True
        ),
        "certainty_equivalence": CertaintyEquivalence(beta),
        "soft_q": DifferentialSoftQ(beta=beta, power=0.6, n_epochs=1),
    }
    result["s1_gap"] = measure(mdp, optimum, learner.solution(states[-1]), beta)["gap"]
    for name, other in others.items():
        solution = other.fit(data, *sizes)
        result[f"{name}_gap"] = measure(mdp, optimum, solution, beta)["gap"]
        if name == "certainty_equivalence":
            result["ce_reward"], result["ce_objective"] = worth(solution.policy.numpy())
    return result


def references() -> dict[str, Any]:
    """Exact values: optimum, prior, and the policies of exact biasing iterations."""
    mdp = WindyCliffEnv().mdp
    optimum = solve_optimum(mdp, BETA)
    prior = np.full_like(mdp.reward, 1 / mdp.n_actions)
    states = list(iterate_biasing(mdp, BETA, max_steps=N_BIAS + 2))
    end = states[-1].value
    # V is known up to a constant: both with mean 0.
    errors = [float(np.abs((v := state.value - end) - v.mean()).max()) for state in states[:N_BIAS]]
    return {
        "theta": optimum.theta,
        "optimal": reward_per_step(mdp, optimum.policy, HORIZON),
        "optimal_rate": float(optimum.stationary @ (optimum.policy * mdp.reward).sum(1)),
        "prior": reward_per_step(mdp, prior, HORIZON),
        "prior_objective": objective(mdp, prior, prior, BETA),
        "iterations": [reward_per_step(mdp, state.policy, HORIZON) for state in states[:N_BIAS]],
        "iteration_rates": [objective(mdp, state.policy, state.policy, BETA) for state in states[:N_BIAS]],
        "value_errors": errors,
    }


def assemble(results: Results, scale: str) -> Output:
    exact = references()
    reward, j = (np.array([r[name] for r in results.values()]) for name in ("reward", "objective"))  # [R, bias, epochs]
    ends = reward[:, :, -1]
    rows = [
        {"learner": "s1", "bias_iteration": k, "epoch": epoch + 1, **_statistics(reward[:, k, epoch], j[:, k, epoch])}
        for k in range(reward.shape[1]) for epoch in range(reward.shape[2])
    ]  # fmt: skip
    improved_reward, improved_j = (_improved(results, name) for name in ("reward", "objective"))
    rows += [
        {"learner": "s1_efficient", "bias_iteration": "", "epoch": epoch + 1,
         **_statistics(improved_reward[:, epoch], improved_j[:, epoch])}
        for epoch in range(improved_j.shape[1])
    ]  # fmt: skip
    by_counting = (np.array([r[name] for r in results.values()]) for name in ("ce_reward", "ce_objective"))
    rows.append({"learner": "certainty_equivalence", "bias_iteration": "", "epoch": "", **_statistics(*by_counting)})
    comparisons = _comparisons(results, ends, exact)
    reading = [
        "rho is carried from one biasing iteration to the next and a self-loop reads the old u, as the authors' script "
        "has it (the listing resets rho); alpha_rho = alpha/15.",
        f"Lines are means over {len(results)} replicas (streams of experience), bands their 10 to 90 % quantiles.",
        "The published ends are read off the plot, to half a unit of the digits given; the lines of the prior and of "
        "the optimal policy, known exactly, were read to that. The paper does not say how many replicas its means are "
        f"of: {PUBLISHED_REPLICAS}, the default of the authors' plotting function.",
        "Reward per step is the exact expectation over 1000 steps from S. It may lie above that of the optimal policy, "
        "which maximises J = reward rate - KL/beta.",
        "With sample-mean psi and expected backup, ours carries u and theta over to the next iteration; the reference "
        "carries rho alone.",
    ]
    data = {
        "exact": exact,
        "ends": {"mean": ends.mean(0).tolist(), "min": ends.min(0).tolist(), "max": ends.max(0).tolist()},
        "final_theta": [float(r["theta"][-1]) for r in results.values()],
        "gaps": {name: [float(r[f"{name}_gap"]) for r in results.values()] for name in GAPS},
    }
    return Output(rows, comparisons, _figure(results, reward, j, exact), reading, data)


def _statistics(reward: np.ndarray, j: np.ndarray) -> dict[str, float]:
    """Mean, extremes and quantiles over replicas [R]."""
    return {
        f"{name}_{what}": float(find(values))
        for name, values in (("reward_per_step", reward), ("objective", j))
        for what, find in (
            ("mean", np.mean), ("min", np.min), ("max", np.max),
            ("q10", lambda x: np.quantile(x, QUANTILES[0])), ("q90", lambda x: np.quantile(x, QUANTILES[1])),
        )
    }  # fmt: skip


def _improved(results: Results, name: str) -> np.ndarray:
    """[R, passes] of the improved learner; where a run ended early, certified, its last policy is repeated."""
    curves = [r[f"efficient_{name}"] for r in results.values()]
    longest = max(map(len, curves))
    return np.array([np.pad(curve, (0, longest - len(curve)), "edge") for curve in curves])


def _comparisons(results: Results, ends: np.ndarray, exact: dict[str, Any]) -> list[Comparison]:
    names = ["optimistic, #0", *(f"#{k}" for k in range(1, 5))]
    comparisons = [
        compared_samples(f"end of {name}", published, ends[:, k], PUBLISHED_REPLICAS, digit, len(PUBLISHED), PICTURE)
        for k, (name, (published, digit)) in enumerate(zip(names, PUBLISHED, strict=True))
    ]
    comparisons += [
        compared("prior policy", PUBLISHED_PRIOR, exact["prior"], 5e-4, PICTURE),
        compared("optimal policy", PUBLISHED_OPTIMAL, exact["optimal"], 5e-4, PICTURE),
        compared("theta*", 1.0101363366, exact["theta"], 5e-11, ORACLE),
        compared("optimal, 1000 steps", -0.9559251, exact["optimal"], 5e-8, ORACLE),
        compared("optimal, stationary", -0.955595, exact["optimal_rate"], 5e-7, ORACLE),
        compared("prior, 1000 steps", -1.6263453, exact["prior"], 5e-8, ORACLE),
        compared("exact iteration 0, 1000 steps", -1.3221561, exact["iterations"][0], 5e-8, ORACLE),
        compared("exact iteration 1, stationary", -0.94197, exact["iteration_rates"][1], 5e-6, ORACLE),
    ]
    comparisons += [
        compared(f"exact iteration {k}: error of V", wanted, ours, digit, ORACLE)
        for k, ((wanted, digit), ours) in enumerate(zip(EXACT_VALUE_ERRORS, exact["value_errors"], strict=True))
    ]
    theta = np.array([r["theta"][-1] for r in results.values()])
    comparisons.append(
        compared_samples("theta of the last iteration", 1.0161, theta, STREAMS, 5e-5, len(GAPS) + 1, ORACLE)
    )
    for name, (title, gap, digit) in GAPS.items():
        ours = np.array([float(r[f"{name}_gap"]) for r in results.values()])
        comparisons.append(compared_samples(f"loss g* - J: {title}", gap, ours, STREAMS, digit, len(GAPS) + 1, ORACLE))
    return comparisons


def _figure(results: Results, reward: np.ndarray, j: np.ndarray, exact: dict[str, Any]) -> Figure:
    figure = Figure(figsize=(11, 8.8))
    figure.text(0.06, 0.967, "Figure 5: Algorithm S1 on the windy cliff (beta 10)", fontsize=12, weight="bold")
    figure.text(
        0.06, 0.945, f"{len(results)} replicas of 500,000 tuples under the uniform prior, replayed in order; steps "
        ".005, .005/15, .1; 15 epochs an iteration. Lines: means; bands: 10 to 90 % of replicas",
        fontsize=8, color="#555555",
    )  # fmt: skip
    ce_reward = float(np.mean([r["ce_reward"] for r in results.values()]))
    ce_objective = float(np.mean([r["ce_objective"] for r in results.values()]))
    places = [(0.075, 0.55), (0.575, 0.55), (0.075, 0.075), (0.575, 0.075)]
    whole, near, value, gap = (figure.add_axes((x, y, 0.4, 0.35)) for x, y in places)
    for axes in (whole, near):
        _curves(axes, reward, range(5))
        axes.axhline(exact["optimal"], color="black", linestyle="--", linewidth=1.2, label="optimal policy")
        axes.axhline(ce_reward, color="#7b3294", linestyle="-.", linewidth=1, label="certainty equivalence")
        axes.axhline(exact["prior"], color="#888888", linestyle=":", linewidth=1.2, label="prior policy")
        for k, (published, _) in enumerate(PUBLISHED):
            axes.plot(15.6, published, "<", color=COLOURS[k], markersize=6, clip_on=False)
        axes.set_ylabel("mean reward a step (1000 steps)", fontsize=9)
    whole.set_title("reward; triangles at the right: published ends, read off", fontsize=10)
    whole.set_ylim(-1.67, -0.9)
    whole.legend(fontsize=7.5, ncols=2, loc=(0.33, 0.15))
    near.set_title("the same, near the optimum", fontsize=10)
    near.set_ylim(-1.03, -0.93)
    _curves(value, j, range(1, N_BIAS))
    value.axhline(-exact["theta"], color="black", linestyle="--", linewidth=1.2, label="optimum, -theta*")
    value.axhline(ce_objective, color="#7b3294", linestyle="-.", linewidth=1, label="certainty equivalence")
    value.set_ylim(-1.13, -1.0)
    value.set_ylabel("J = reward rate - KL/beta", fontsize=9)
    value.set_title(f"objective, which is what is maximised (#0 ends at {j[:, 0, -1].mean():.3f})", fontsize=10)
    value.legend(fontsize=7.5, ncols=2, loc="lower right")
    for axes in (whole, near, value):
        axes.set_xlabel("epoch of the biasing iteration", fontsize=9)
        axes.set_xlim(1, 15.6)
        axes.set_xticks(range(1, 16, 2))
    _gaps(gap, results, j, -exact["theta"])
    for axes in (whole, near, value, gap):
        axes.tick_params(labelsize=8)
    return figure


def _curves(axes: Axes, values: np.ndarray, iterations: range) -> None:
    """Mean and band of values [replicas, iterations, epochs]."""
    epochs = np.arange(1, values.shape[2] + 1)
    for k in iterations:
        low, high = np.quantile(values[:, k], QUANTILES, axis=0)
        axes.fill_between(epochs, low, high, color=COLOURS[k], alpha=0.15, linewidth=0)
        name = "#0 (optimistic)" if k == 0 else f"#{k}"
        axes.plot(epochs, values[:, k].mean(0), color=COLOURS[k], linewidth=1.6, label=name)


def _gaps(axes: Axes, results: Results, j: np.ndarray, g_star: float) -> None:
    """Loss against passes over the data, of S1 and of the improved learner."""
    for values, colour, name in (
        (j.reshape(len(j), -1), COLOURS[0], "Algorithm S1, as published"),
        (_improved(results, "objective"), COLOURS[2], f"{EFFICIENT} (s1_efficient)"),
    ):
        loss = np.maximum(g_star - values, 1e-12)
        passes = np.arange(1, loss.shape[1] + 1)
        low, high = np.quantile(loss, QUANTILES, axis=0)
        axes.fill_between(passes, low, high, color=colour, alpha=0.15, linewidth=0)
        axes.plot(passes, np.median(loss, axis=0), color=colour, linewidth=1.6, label=name)
    limit = float(np.median([r["certainty_equivalence_gap"] for r in results.values()]))
    axes.axhline(limit, color="#7b3294", linestyle="-.", linewidth=1, label="certainty equivalence")
    axes.set_yscale("log")
    axes.set_ylim(3e-6, 30)
    axes.set_xlim(1, j[0].size)
    axes.set_xlabel("passes over the 500,000 tuples", fontsize=9)
    axes.set_ylabel("loss g* - J, reward a step (median)", fontsize=9)
    axes.set_title("an extra: the improved learner on the same streams", fontsize=10)
    axes.legend(fontsize=7.5, loc="upper right")


ARTIFACT = Artifact("figure_5", "Algorithm S1 on the windy cliff", units, work, assemble)
