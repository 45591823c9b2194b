"""Figure S1: the distribution of the counts of Table S1, by size, wind level, beta and trap density."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from erl_torch.pictures import COLOURS
from erl_torch.reproduction.artifact import (
    NOT_REPRODUCED,
    REPRODUCED,
    STATED,
    Artifact,
    Comparison,
    Output,
    Results,
)
from erl_torch.reproduction.mazes import count_cell
from erl_torch.reproduction.table_s1 import BETAS, CELLS, DENSITIES, MAZES, SIZES, WIND_LEVELS, Cell, units

DROPPED_FROM = 50  # counts that the figure leaves out
SMOOTH = 0.3  # iterations, width of the kernel of the violins
MOST = (2, 6)  # "most of the mazes required between 2 and 6"


def assemble(results: Results, scale: str) -> Output:
    counts = {cell: results[cell.name]["k"].astype(int) for cell in CELLS}
    rows = [
        {**cell._asdict(), "k": value, "mazes": number}
        for cell, k in counts.items()
        for value, number in zip(*(x.tolist() for x in np.unique(k, return_counts=True)), strict=True)
    ]
    return Output(rows, _comparisons(counts), _figure(counts, scale), _reading(counts))


def _comparisons(counts: dict[Cell, np.ndarray]) -> list[Comparison]:
    def mean(**keys: float) -> float:
        chosen = [k for cell, k in counts.items() if keys.items() <= cell._asdict().items()]
        return float(np.concatenate(chosen).mean())

    def comparison(statement: str, ours: str, holds: bool) -> Comparison:
        return Comparison(statement, "in words", ours, REPRODUCED if holds else NOT_REPRODUCED, STATED)

    every = np.concatenate(list(counts.values()))
    share = np.mean((every >= MOST[0]) & (every <= MOST[1]))
    by_beta = [mean(beta=beta) for beta in BETAS]
    hot = [mean(beta=2.0, size=size, density=density) for size in SIZES for density in DENSITIES]
    easy, hard = mean(beta=50.0, wind_level=1.0, density=0.10), mean(beta=50.0, wind_level=4.0, density=0.25)
    return [
        comparison("most mazes take 2 to 6 iterations", f"{100 * share:.1f} %", bool(share > 0.5)),
        comparison(
            "more iterations at higher beta", "means " + " ".join(f"{m:.2f}" for m in by_beta),
            by_beta == sorted(by_beta),
        ),
        comparison(
            "at the lowest beta, size and density hardly matter", f"means {min(hot):.2f} to {max(hot):.2f}",
            max(hot) - min(hot) < 0.5,
        ),
        comparison(
            "more with strong wind and many traps (beta 50)", f"mean {hard:.2f} against {easy:.2f}", hard > easy + 0.5
        ),
    ]  # fmt: skip


def _reading(counts: dict[Cell, np.ndarray]) -> list[str]:
    dropped = sum(int((k >= DROPPED_FROM).sum()) for k in counts.values())
    return [
        f"Counts of {DROPPED_FROM} and more are left out, as in the paper: with converged eigenvectors {dropped}.",
        'The published figure has no numbers of its own: what its caption says is held against ours. "Hardly" is '
        'taken as means that differ by less than half an iteration, "more" as at least half an iteration.',
    ]


def _figure(counts: dict[Cell, np.ndarray], scale: str) -> Figure:
    figure = Figure(figsize=(11.5, 8.4))
    figure.text(0.055, 0.965, "Figure S1: biasing iterations of random windy mazes", fontsize=12, weight="bold")
    figure.text(
        0.055, 0.942, f"{MAZES[scale]} mazes a violin (smoothed over {SMOOTH} iterations), eigenvectors converged; "
        "bar: mean, thin line: least to largest", fontsize=8, color="#555555",
    )  # fmt: skip
    kept = {cell: k[k < DROPPED_FROM] for cell, k in counts.items()}
    top = max(int(k.max()) for k in kept.values())
    colours = [COLOURS[4], COLOURS[0], COLOURS[5], COLOURS[1]]
    for i, size in enumerate(SIZES):
        for j, level in enumerate(WIND_LEVELS):
            axes = figure.add_axes((0.055 + 0.315 * j, 0.655 - 0.29 * i, 0.3, 0.245))
            for d, density in enumerate(DENSITIES):
                k = [kept[Cell(size, density, level, beta)] for beta in BETAS]
                at = np.arange(len(BETAS)) + (d - 1.5) * 0.2
                _violins(axes, k, at, colours[d])
            axes.set_ylim(0, top + 1)
            axes.set_xlim(-0.5, len(BETAS) - 0.5)
            axes.set_xticks(range(len(BETAS)), [f"{beta:g}" for beta in BETAS] if i == 2 else [])
            axes.tick_params(labelsize=8, labelleft=j == 0)
            axes.grid(axis="y", color="#e4e4e4", linewidth=0.7)
            axes.set_axisbelow(True)
            if i == 0:
                axes.set_title(f"wind level {level:g}: strength ~ Beta({level:g}, 2)", fontsize=9.5)
            if i == 2:
                axes.set_xlabel("beta, 1/reward", fontsize=9)
            if j == 0:
                axes.set_ylabel(f"size {size}\nk, iterations", fontsize=9)
    figure.legend(
        [Patch(color=colour) for colour in colours], [f"{density:.2f}" for density in DENSITIES],
        title="trap density (traps for each row length)", loc="upper right", bbox_to_anchor=(0.985, 0.995), ncols=4,
        fontsize=8, title_fontsize=8, frameon=False,
    )  # fmt: skip
    return figure


def _violins(axes: Axes, samples: list[np.ndarray], at: np.ndarray, colour: str) -> None:
    """Violins of whole numbers: half-widths are shares of the mazes, smoothed over SMOOTH."""
    for k, x in zip(samples, at, strict=True):
        y = np.linspace(k.min() - 0.9, k.max() + 0.9, 30 * int(np.ptp(k) + 2))
        density = np.exp(-0.5 * ((y[:, None] - k) / SMOOTH) ** 2).sum(1)
        axes.fill_betweenx(
            y, x - 0.09 * density / density.max(), x + 0.09 * density / density.max(), color=colour, linewidth=0
        )
        axes.plot([x, x], [k.min(), k.max()], color="#333333", linewidth=0.5)
        axes.plot([x - 0.06, x + 0.06], [k.mean()] * 2, color="#111111", linewidth=1.2)


ARTIFACT = Artifact("figure_s1", "spread of Table S1's counts", units, count_cell, assemble, units_of="table_s1")
