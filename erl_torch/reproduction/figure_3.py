"""Figure 3: the policies of every biasing iteration, played in the original continuous environments."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from erl_torch.envs.control import control_task
from erl_torch.pictures import COLOURS
from erl_torch.reproduction.artifact import PICTURE, Artifact, Comparison, Output, Results, judged
from erl_torch.reproduction.control import EPISODE_LENGTH, EPISODES, TASKS, work
from erl_torch.reproduction.table_s2 import published_units, samples

WINDOW = 5  # iterations of the moving average
RISE = 0.5  # of the normalised curve, end over start: "the policies become better"


def moving_average(values: np.ndarray, window: int = WINDOW) -> np.ndarray:
    """[K]: mean of the last ``window`` values, of fewer at the beginning."""
    total = np.cumsum(values)
    total[window:] -= total[:-window].copy()
    return np.asarray(total / np.minimum(np.arange(1, len(values) + 1), window))


def normalised(values: np.ndarray) -> np.ndarray:
    """Least value 0, largest 1."""
    return np.asarray((values - values.min()) / (np.ptp(values) or 1.0))


def assemble(results: Results, scale: str) -> Output:
    rows: list[dict[str, Any]] = []
    comparisons: list[Comparison] = []
    figure = Figure(figsize=(9.6, 5.6))
    figure.text(0.05, 0.955, "Figure 3: return in the original environments", fontsize=12, weight="bold")
    about = (
        f"policy of every biasing iteration of models of {samples(scale)} samples of each (s,a); {EPISODES} episodes of"
        f" at most {EPISODE_LENGTH} steps: mean (points),\nits moving average over {WINDOW} iterations (line), "
        "quartiles (band)"
    )
    figure.text(0.05, 0.9, about, fontsize=8, color="#555555")
    together = figure.add_axes((0.7, 0.11, 0.28, 0.68))
    for i, (task, title) in enumerate(TASKS.items()):
        returns = results[f"{task}-as_published"]["returns"]
        mean = returns.mean(1)
        smooth = moving_average(mean)
        scaled = normalised(smooth)
        k = np.arange(len(mean))
        rows.extend(
            {
                "environment": title, "bias_iteration": j, "mean_return": mean[j],
                "standard_error": returns[j].std(ddof=1) / np.sqrt(returns.shape[1]),
                "moving_average": smooth[j], "normalised": scaled[j],
            }
            for j in k.tolist()
        )  # fmt: skip
        rises = scaled[-1] - scaled[0]
        note = f"moving average from {smooth[0]:.1f} to {smooth[-1]:.1f}"
        comparisons.append(
            Comparison(f"{title}: normalised return", "rises", f"from {scaled[0]:.2f} to {scaled[-1]:.2f}",
                       judged(bool(rises >= RISE), PICTURE), PICTURE, note=note)
        )  # fmt: skip
        axes = figure.add_axes((0.065 + 0.315 * (i % 2), 0.54 - 0.43 * (i // 2), 0.245, 0.29))
        low, high = np.quantile(returns, [0.25, 0.75], axis=1)
        axes.fill_between(k, low, high, color=COLOURS[i], alpha=0.2, linewidth=0)
        axes.plot(k, mean, ".", color=COLOURS[i], markersize=4)
        axes.plot(k, smooth, color=COLOURS[i], linewidth=1.8)
        axes.set_title(f"{title}, beta {control_task(task).beta:g}", fontsize=9)
        axes.set_ylabel("return", fontsize=8)
        axes.set_xlabel("biasing iteration", fontsize=8)
        axes.tick_params(labelsize=7)
        together.plot(k, scaled, color=COLOURS[i], linewidth=1.8, label=title)
    together.set_title("moving averages, min-max normalised\n(as published)", fontsize=9)
    together.set_xlabel("biasing iteration", fontsize=8)
    together.set_ylabel("normalised return", fontsize=8)
    together.tick_params(labelsize=7)
    together.legend(fontsize=8, loc="lower right")
    reading = [
        "Iterations are counted from 0, the problem without bias. The published curves are min-max normalised and give "
        "no numbers: what is held against them is that the return rises, from the first iteration to the last by at "
        "least half of its range.",
        f"The moving average is over the last {WINDOW} iterations, fewer at the beginning.",
        "Returns are the original's own rewards; an episode ends where the original ends it, or after 500 steps.",
    ]
    return Output(rows, comparisons, figure, reading)


ARTIFACT = Artifact(
    "figure_3", "returns of every biasing iteration in the original environments", published_units, work, assemble,
    version=2, units_of="table_s2",
)  # fmt: skip
