"""Draw pictures as uint8 arrays [height, width, 3], without pyplot and without a display."""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from erl_torch.labels import NUMBERS, Names

DPI = 100
MAX_PX = 400  # TensorBoard's image cards are about this wide
# Those of Okabe and Ito, which any colour vision tells apart, and three more.
COLOURS = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#222222", "#7b3294", "#8c6d31", "#9a9a9a"]
MARKERS = "os^"
LETTERS = 24  # of a label, at most
MOST_ROWS, MOST_COLUMNS = 30, 12  # of a table whose rows or columns are named


def table_picture(
    table: np.ndarray, title: str, label: str, max_px: int = MAX_PX, names: Names = NUMBERS
) -> np.ndarray:
    """Any [S, A] table as shades: one row per state, one column per action.

    Of at most 30 states, or 12 actions, the labels stand beside the rows, or below the columns.
    """
    figure = Figure(figsize=(max_px / DPI, max_px / DPI), dpi=DPI)
    states, actions = names
    rows = [] if states is None or len(states) > MOST_ROWS else brief(states.texts.tolist())
    columns = [] if actions is None or len(actions) > MOST_COLUMNS else brief(actions.texts.tolist())
    # 7 points of type are about 5 pixels a letter.
    left = 0.13 + 5 / max_px * max(map(len, rows), default=0)
    slanted = sum(map(len, columns)) * 6 > (0.78 - left) * max_px
    bottom = 0.12 + (5 / max_px * max(map(len, columns)) if slanted else 0)
    axes = figure.add_axes((left, bottom, 0.78 - left, 0.92 - bottom))
    image = axes.imshow(table, aspect="auto", interpolation="nearest", cmap="viridis")
    axes.set_xlabel("action a")
    axes.set_ylabel("state s")
    axes.set_xticks(range(table.shape[1]) if table.shape[1] <= MOST_COLUMNS else [])
    if columns:
        axes.set_xticks(range(len(columns)), columns, fontsize=7, rotation=90 if slanted else 0)
    if rows:
        axes.set_yticks(range(len(rows)), rows, fontsize=7)
    axes.set_title(title, fontsize=9)
    colour_bar(figure, image, label)
    return pixels(figure)


def brief(labels: Sequence[str]) -> list[str]:
    """Labels on one line each, at most 24 letters long and as different as they were, that matplotlib takes for no
    formula: cut at their ends, else in their middles, else without what all begin and end with, else after numbers."""
    lines = [" ".join(label.split()) for label in labels]
    both = (lines, [line[::-1] for line in lines])
    head, tail = (len(os.path.commonprefix(x)) for x in both)  # noqa: RUF071  of texts
    shortest = min(map(len, lines), default=0)
    inner = [line[head : len(line) - min(tail, shortest - head)] for line in lines]
    ways = (
        [_cut(line, LETTERS - 1) for line in lines],
        [_cut(line, LETTERS // 2) for line in lines],
        [_cut(f"\u2026{line}\u2026", LETTERS - 1) for line in inner],
        [_cut(f"\u2026{line}\u2026", LETTERS // 2) for line in inner],
    )
    numbered = [_cut(f"{i}: {line}", LETTERS - 1) for i, line in enumerate(lines)]
    found = next((way for way in ways if len(set(way)) == len(set(labels))), numbered)
    return [line.replace("$", r"\$") for line in found]


def _cut(line: str, first: int) -> str:
    """Its ``first`` letters and the last, ``LETTERS`` in all, where it is longer."""
    last = LETTERS - 1 - first
    return line if len(line) <= LETTERS else f"{line[:first]}\u2026{line[len(line) - last :]}"


def learning_curves(sizes: Sequence[int], curves: Mapping[str, Sequence[Mapping[str, Any]]], title: str) -> np.ndarray:
    """Gap against tuples of experience, log-log; ``curves`` as ``Comparison.summary`` gives them.

    Lines are interquartile means, bands their intervals; each name stands at the right end of its line.
    """
    figure = Figure(figsize=(8.4, 5.0), dpi=150)
    axes = figure.add_axes((0.095, 0.115, 0.66, 0.77))
    axes.set_xscale("log")
    axes.set_yscale("log")
    ends = []
    for i, (name, points) in enumerate(curves.items()):
        # No logarithm: a gap of 0 (the policy is exact to rounding), or None (a seed failed).
        drawn = [(n, point) for n, point in zip(sizes, points, strict=True) if point["iqm"]]
        if not drawn:
            continue
        colour, marker = COLOURS[i % len(COLOURS)], MARKERS[i // len(COLOURS) % len(MARKERS)]
        x, y = [n for n, _ in drawn], [point["iqm"] for _, point in drawn]
        axes.plot(x, y, marker, color=colour, linestyle="-", linewidth=1.8, markersize=4, zorder=3, clip_on=False)
        bands = [(n, *point["interval"]) for n, point in drawn if point["interval"]]
        if bands:
            at, low, high = np.array(bands).T
            # An interval that reaches 0 has no lower end on this axis: it is cut at a third of the lowest point.
            axes.fill_between(at, np.maximum(low, min(y) / 3), high, color=colour, alpha=0.18, linewidth=0, zorder=2)
        ends.append((y[-1], name, colour))
    plain(axes, "tuples of experience", "gap  g* \u2212 J,  reward a step")
    axes.set_xlim(sizes[0] / 1.15 if len(sizes) > 1 else sizes[0] / 2, sizes[-1])
    figure.text(0.095, 0.945, title, fontsize=11, weight="bold")
    figure.text(0.095, 0.908, "interquartile mean over seeds, 95 % band", fontsize=8.5, color="#666666")
    _name_ends(axes, sorted(ends))
    return pixels(figure)


class BandLine(NamedTuple):
    """One line of ``bands``, with its bands."""

    name: str
    x: Sequence[float]
    statistics: Sequence[Mapping[str, float]]  # mean, q25, q75, min, max at each x
    exact: Sequence[float | None]  # at each x; None where it is not known


def bands(
    panels: Mapping[str, Sequence[BandLine]], x_label: str, title: str, markers: bool = False, card: bool = False
) -> np.ndarray:
    """Statistics over replicas, one panel per label: mean, quartiles (shaded), extremes (thin), exact values.

    ``markers``: each x is a setting; exact values are crosses there. Otherwise they are a dashed line.
    ``card``: draw it small enough for a card of TensorBoard's; use it with one panel.
    """
    exact: dict[str, Any] = {"linestyle": "", "marker": "x", "markersize": 5} if markers else {"linestyle": "--"}
    known = any(y is not None for lines in panels.values() for line in lines for y in line.exact)
    caption = "mean; shaded: quartiles; thin: extremes"
    caption += f"; {'crosses' if markers else 'dashed'}: exact" if known else ""
    figure, all_axes = _panels(len(panels), title, caption, card)
    for axes, (label, lines) in zip(all_axes, panels.items(), strict=True):
        for i, line in enumerate(lines):
            colour = COLOURS[i % len(COLOURS)]
            column = {key: [p[key] for p in line.statistics] for key in ("mean", "q25", "q75", "min", "max")}
            style: dict[str, Any] = {"marker": "o", "markersize": 3} if markers else {}
            axes.plot(line.x, column["mean"], color=colour, linewidth=1.5, label=line.name, zorder=3, **style)
            axes.fill_between(line.x, column["q25"], column["q75"], color=colour, alpha=0.22, linewidth=0, zorder=2)
            for end in ("min", "max"):
                axes.plot(line.x, column[end], color=colour, linewidth=0.5, alpha=0.8, zorder=2)
            crosses = [(x, y) for x, y in zip(line.x, line.exact, strict=True) if y is not None]
            if crosses:
                axes.plot(*zip(*crosses, strict=True), color="#222222" if len(lines) == 1 else colour,
                          linewidth=1.0, zorder=3.5 if markers else 2.5, **exact)  # fmt: skip
        spread = [x for line in lines for x in line.x]
        if markers and min(spread) > 0 and max(spread) / min(spread) >= 20:
            axes.set_xscale("log")
        if not markers:
            axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        plain(axes, x_label, label)
        if len(lines) > 1 and axes is all_axes[0]:
            axes.legend(fontsize=7, frameon=False)
    return pixels(figure)


def _panels(n: int, title: str, caption: str, card: bool) -> tuple[Figure, list[Axes]]:
    columns = 1 if n == 1 else 2
    rows = -(-n // columns)
    panel = 3.4 if card else 4.6  # inches
    width, height = panel * columns, 2.9 * rows + 0.6
    figure = Figure(figsize=(width, height), dpi=DPI if card else 130)
    panels = []
    for i in range(n):
        row, column = divmod(i, columns)
        left, bottom = (panel * column + 0.85) / width, (2.9 * (rows - 1 - row) + 0.55) / height
        panels.append(figure.add_axes((left, bottom, (panel - 1.05) / width, 2.15 / height)))
    left = (0.1 if card else 0.85) / width
    if card:
        title = title.replace(": ", ":\n")
    figure.text(left, 1 - (0.36 if card else 0.28) / height, title, fontsize=9 if card else 11, weight="bold")
    figure.text(left, 1 - (0.55 if card else 0.48) / height, caption, fontsize=8, color="#666666")
    return figure, panels


def plain(axes: Axes, x_label: str, y_label: str) -> None:
    """Labels, a grid, and no frame at the top and on the right."""
    axes.grid(True, which="major", color="#dddddd", linewidth=0.8, zorder=0)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    axes.tick_params(which="both", colors="#444444", labelsize=8)
    axes.set_xlabel(x_label, fontsize=9)
    axes.set_ylabel(y_label, fontsize=9)


def _name_ends(axes: Axes, ends: list[tuple[float, str, str]]) -> None:
    """Write names right of the axes, at the heights of the curves' ends, moved apart where they would overlap."""
    if not ends:
        return
    height = axes.transData.transform
    bottom, top = (axes.transAxes.transform((0, y))[1] for y in (0, 1))
    at = np.array([(height((1, y))[1] - bottom) / (top - bottom) for y, _, _ in ends])
    apart = min(0.05, 1 / len(at))
    room = apart * np.arange(len(at))
    # Least squares under a least distance: pool neighbours whose wishes cross.
    pools: list[list[float]] = []
    for wish in at - room:
        pools.append([wish])
        while len(pools) > 1 and np.mean(pools[-2]) > np.mean(pools[-1]):
            pools[-2:] = [pools[-2] + pools[-1]]
    placed = np.concatenate([np.full(len(pool), np.mean(pool)) for pool in pools])
    placed = np.clip(placed, 0.0, max(0.0, 1.0 - room[-1])) + room
    for y, wish, (_, name, colour) in zip(placed, at, ends, strict=True):
        axes.plot(
            [1.0, 1.035], [wish, y], color=colour, linewidth=0.9, transform=axes.transAxes, clip_on=False, zorder=3
        )
        axes.text(1.045, y, name, color=colour, fontsize=9, weight="bold", va="center", transform=axes.transAxes)


# All layouts are fixed, because matplotlib's layout engines take longer than the rest of the picture.
def colour_bar(figure: Figure, shades: ScalarMappable, label: str) -> None:
    width = figure.get_figwidth() * DPI
    bar = figure.colorbar(shades, cax=figure.add_axes((1 - 72 / width, 0.12, 12 / width, 0.76)))
    bar.ax.tick_params(labelsize=7)
    bar.set_label(label, fontsize=8)


def pixels(figure: Figure) -> np.ndarray:
    canvas = FigureCanvasAgg(figure)
    with warnings.catch_warnings():  # labels may be in any script; a sign that the font lacks is drawn as a box
        warnings.filterwarnings("ignore", "Glyph .* missing from font", UserWarning)
        canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()
