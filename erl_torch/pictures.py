"""Pictures as uint8 arrays [height, width, 3], drawn without pyplot and without a display."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PolyCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize, to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.ticker import EngFormatter

from erl_torch.envs.grid_world import TILES, GridWorld

DPI = 100
MAX_PX = 400  # TensorBoard's image cards are about this wide
TILE_COLOURS = {
    "S": "#cfe3f7",
    "F": "#f7f7f5",
    "R": "#e9e7df",
    "H": "#5d3a3a",
    "G": "#9bd19b",
    "W": "#333333",
    "C": "#fdf0c4",
    "N": "#f6d2a8",
}
ARROW = "#1b4f9c"
WIND = "#b9c6d3"
SHARE = "#f08c00"
# Okabe and Ito's, told apart with any colour vision, and three more.
COLOURS = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#222222", "#7b3294", "#8c6d31", "#9a9a9a"]
MARKERS = "os^"


def policy_picture(
    policy: np.ndarray, grid: GridWorld | None = None, title: str = "", max_px: int = MAX_PX
) -> np.ndarray:
    """The policy [S, A]: arrows as long as their probability on a grid, else a table of shades."""
    if grid is None:
        return table_picture(policy, title, "pi(a|s)", max_px)
    return grid_picture(grid, policy, title=title, max_px=max_px)


def grid_picture(
    grid: GridWorld,
    policy: np.ndarray | None = None,
    distribution: np.ndarray | None = None,
    title: str = "",
    max_px: int = MAX_PX,
    scale: float = 1.0,
) -> np.ndarray:
    """Tiles and wind, with a policy [S, A] as arrows and a distribution over states [S] as shading.

    An arrow is as long as its action's probability, a dot as wide where the action is to stay. ``scale`` gives more
    pixels, for print, to the same drawing.
    """
    figure, axes = _grid_axes(grid, title, max_px, bar=distribution is not None)
    draw_grid(axes, grid, policy, distribution)
    if distribution is not None:
        _bar(figure, shares(float(distribution.max())), "share of time")
    figure.set_dpi(DPI * scale)
    return _pixels(figure)


def draw_grid(
    axes: Axes,
    grid: GridWorld,
    policy: np.ndarray | None = None,
    distribution: np.ndarray | None = None,
    top: float | None = None,
    wind: bool = True,
) -> None:
    """``grid_picture``'s drawing on ``axes``; ``top`` is the share of time with the full colour, None the largest."""
    _frame(axes, grid)
    _tiles(axes, grid)
    if distribution is not None:
        top = float(distribution.max()) if top is None else top
        axes.imshow(distribution.reshape(grid.shape), cmap=shares(top).get_cmap(), vmin=0, vmax=top, zorder=1.2)
    if wind:
        _wind(axes, grid)
    if policy is not None:
        _policy(axes, grid, policy)


def shares(top: float) -> ScalarMappable:
    """The colours of shares of time from 0 to ``top``, for a colour bar."""
    colours = LinearSegmentedColormap.from_list("share of time", [(*to_rgb(SHARE), 0.0), (*to_rgb(SHARE), 1.0)])
    return ScalarMappable(Normalize(0.0, top), colours)


def bias_picture(
    reward_bias: np.ndarray, grid: GridWorld | None = None, title: str = "", max_px: int = MAX_PX
) -> np.ndarray:
    """delta(s,a) [S, A], reward: a grid tile shows each action's value on the side it points to."""
    label = "delta(s,a), reward"
    if grid is None:
        return table_picture(reward_bias, title, label, max_px)
    figure, axes = _grid_axes(grid, title, max_px, bar=True)
    row, col = np.divmod(np.arange(grid.tiles.size), grid.shape[1])
    centre = np.stack([col, row], 1)[:, None, None, :]  # [S, 1, 1, 2]
    step = grid.moves[:, ::-1]  # [A, 2] in (x, y)
    if grid.n_actions == 4:
        middle, side = step / 2, step[:, ::-1] / 2  # side: at right angles to the step
        corners = np.stack([np.zeros_like(middle), middle + side, middle - side], 1)  # [A, 3, 2]
    else:
        square = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) / 6
        corners = step[:, None] / 3 + square  # [A, 4, 2]
    shades = PolyCollection(
        list((centre + corners).reshape(-1, *corners.shape[1:])),
        array=reward_bias.ravel(),
        cmap="viridis",
        edgecolors="#ffffff",
        linewidths=0.3,
    )
    shades.set_clim(0.0, max(float(reward_bias.max()), 1e-12))
    axes.add_collection(shades)
    _letters(axes, grid, "#ffffff")
    _bar(figure, shades, label)
    return _pixels(figure)


def table_picture(table: np.ndarray, title: str, label: str, max_px: int = MAX_PX) -> np.ndarray:
    """Any [S, A] table as shades: states down, actions across."""
    figure = Figure(figsize=(max_px / DPI, max_px / DPI), dpi=DPI)
    axes = figure.add_axes((0.13, 0.12, 0.65, 0.8))
    image = axes.imshow(table, aspect="auto", interpolation="nearest", cmap="viridis")
    axes.set_xlabel("action a")
    axes.set_ylabel("state s")
    axes.set_xticks(range(table.shape[1]) if table.shape[1] <= 12 else [])
    axes.set_title(title, fontsize=9)
    _bar(figure, image, label)
    return _pixels(figure)


def learning_curves(sizes: Sequence[int], curves: Mapping[str, Sequence[Mapping[str, Any]]], title: str) -> np.ndarray:
    """Gap against tuples of experience, log-log; ``curves`` as ``Comparison.summary`` has them.

    Lines are interquartile means, bands their intervals; names stand at the right ends.
    """
    figure = Figure(figsize=(8.4, 5.0), dpi=150)
    axes = figure.add_axes((0.095, 0.115, 0.66, 0.77))
    axes.set_xscale("log")
    axes.set_yscale("log")
    ends = []
    for i, (name, points) in enumerate(curves.items()):
        # A gap of 0 is a policy exact to rounding; a failed seed has no figure.
        shown = [(n, point) for n, point in zip(sizes, points, strict=True) if point["iqm"]]
        if not shown:
            continue
        colour, marker = COLOURS[i % len(COLOURS)], MARKERS[i // len(COLOURS) % len(MARKERS)]
        x, y = [n for n, _ in shown], [point["iqm"] for _, point in shown]
        axes.plot(x, y, marker, color=colour, linestyle="-", linewidth=1.8, markersize=4, zorder=3, clip_on=False)
        bands = [(n, *point["interval"]) for n, point in shown if point["interval"]]
        if bands:
            at, low, high = np.array(bands).T
            # An interval that reaches 0 has no lower end here: the axis keeps to the lines.
            axes.fill_between(at, np.maximum(low, min(y) / 3), high, color=colour, alpha=0.18, linewidth=0, zorder=2)
        ends.append((y[-1], name, colour))
    _plain(axes, "tuples of experience", "gap  g* \u2212 J,  reward a step")
    axes.set_xlim(sizes[0] / 1.15 if len(sizes) > 1 else sizes[0] / 2, sizes[-1])
    figure.text(0.095, 0.945, title, fontsize=11, weight="bold")
    figure.text(0.095, 0.908, "interquartile mean over seeds, 95 % band", fontsize=8.5, color="#666666")
    _name_ends(axes, sorted(ends))
    return _pixels(figure)


class BandLine(NamedTuple):
    """A line with its bands for ``bands``."""

    name: str
    x: Sequence[float]
    statistics: Sequence[Mapping[str, float]]  # mean, q25, q75, min, max at each x
    exact: Sequence[float | None]  # at each x


def bands(
    panels: Mapping[str, Sequence[BandLine]], x_label: str, title: str, markers: bool = False, card: bool = False
) -> np.ndarray:
    """Statistics over replicas, a panel for each label: mean, quartiles (shaded), extremes (thin), exact values.

    ``markers``: each x is a setting, and exact values are known there alone: crosses, else a dashed line.
    ``card``: small enough for a card of TensorBoard's, which takes one panel.
    """
    exact: dict[str, Any] = {"linestyle": "", "marker": "x", "markersize": 5} if markers else {"linestyle": "--"}
    caption = f"mean; shaded: quartiles; thin: extremes; {'crosses' if markers else 'dashed'}: exact"
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
            known = [(x, y) for x, y in zip(line.x, line.exact, strict=True) if y is not None]
            if known:
                axes.plot(*zip(*known, strict=True), color="#222222" if len(lines) == 1 else colour,
                          linewidth=1.0, zorder=3.5 if markers else 2.5, **exact)  # fmt: skip
        spread = [x for line in lines for x in line.x]
        if markers and min(spread) > 0 and max(spread) / min(spread) >= 20:
            axes.set_xscale("log")
        if not markers:
            axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        _plain(axes, x_label, label)
        if len(lines) > 1 and axes is all_axes[0]:
            axes.legend(fontsize=7, frameon=False)
    return _pixels(figure)


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


def _plain(axes: Axes, x_label: str, y_label: str) -> None:
    axes.grid(True, which="major", color="#dddddd", linewidth=0.8, zorder=0)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    axes.tick_params(which="both", colors="#444444", labelsize=8)
    axes.set_xlabel(x_label, fontsize=9)
    axes.set_ylabel(y_label, fontsize=9)


def _name_ends(axes: Axes, ends: list[tuple[float, str, str]]) -> None:
    """Names right of the axes at the heights of the curves' ends, moved apart where they would overlap."""
    if not ends:
        return
    height = axes.transData.transform
    bottom, top = (axes.transAxes.transform((0, y))[1] for y in (0, 1))
    at = np.array([(height((1, y))[1] - bottom) / (top - bottom) for y, _, _ in ends])
    apart = min(0.05, 1 / len(at))
    room = apart * np.arange(len(at))
    # Least squares with a least distance: pool neighbours whose wishes cross.
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


def board(grid: GridWorld, cell_px: int = 64) -> np.ndarray:
    """The bare grid with its wind, for ``render``: cell_px (fewer on large grids) pixels a tile."""
    rows, cols = grid.shape
    cell_px = max(12, min(cell_px, 1200 // max(rows, cols)))
    figure = Figure(figsize=(cols * cell_px / DPI, rows * cell_px / DPI), dpi=DPI)
    axes = figure.add_axes((0, 0, 1, 1))
    _frame(axes, grid)
    _tiles(axes, grid)
    _wind(axes, grid)
    return _pixels(figure)


def with_agent(picture: np.ndarray, shape: tuple[int, int], cell: tuple[int, int]) -> np.ndarray:
    """A copy of a ``board`` of ``shape`` (rows, cols) with the agent at ``cell`` (row, col)."""
    height, width = picture.shape[:2]
    y = (cell[0] + 0.5) * height / shape[0]
    x = (cell[1] + 0.5) * width / shape[1]
    radius = 0.27 * min(height / shape[0], width / shape[1])
    rows, cols = np.ogrid[:height, :width]
    # One pixel of soft edge.
    distance = np.hypot(rows + 0.5 - y, cols + 0.5 - x)
    cover = np.clip(radius - distance + 0.5, 0, 1)[..., None]
    colour = np.array(to_rgb("#d9480f")) * 255
    return np.asarray(picture * (1 - cover) + colour * cover, dtype=np.uint8)


def _grid_axes(grid: GridWorld, title: str, max_px: int, bar: bool = False) -> tuple[Figure, Axes]:
    rows, cols = grid.shape
    top, right = 24, 80 if bar else 6  # px: the title's line, the colour bar
    px = min((max_px - top - 6) / rows, (max_px - right - 6) / cols)  # a tile
    width, height = max(px * cols + right + 6, 340), px * rows + top + 6
    figure = Figure(figsize=(width / DPI, height / DPI), dpi=DPI)
    axes = figure.add_axes((6 / width, 6 / height, 1 - (right + 6) / width, 1 - (top + 6) / height))
    figure.text(0.5, 1 - 6 / height, title, fontsize=8, ha="center", va="top")
    _frame(axes, grid)
    return figure, axes


# The layouts are fixed: matplotlib's own layout engines take longer than the rest of the picture.
def _bar(figure: Figure, shades: ScalarMappable, label: str) -> None:
    width = figure.get_figwidth() * DPI
    bar = figure.colorbar(shades, cax=figure.add_axes((1 - 72 / width, 0.12, 12 / width, 0.76)))
    bar.ax.tick_params(labelsize=7)
    bar.set_label(label, fontsize=8)


def _frame(axes: Axes, grid: GridWorld) -> None:
    rows, cols = grid.shape
    axes.set_xlim(-0.5, cols - 0.5)
    axes.set_ylim(rows - 0.5, -0.5)
    axes.set_aspect("equal")
    axes.set_axis_off()


def _tiles(axes: Axes, grid: GridWorld) -> None:
    rows, cols = grid.shape
    colours = np.array([to_rgb(TILE_COLOURS[tile]) for tile in TILES])
    index = np.array([TILES.index(tile) for tile in grid.tiles]).reshape(rows, cols)
    axes.imshow(colours[index], interpolation="nearest", zorder=0)
    lines: dict[str, Any] = {"color": "#ffffff", "linewidth": 1.0, "zorder": 1}
    axes.hlines(np.arange(rows + 1) - 0.5, -0.5, cols - 0.5, **lines)
    axes.vlines(np.arange(cols + 1) - 0.5, -0.5, rows - 0.5, **lines)
    _letters(axes, grid, "#4a4a4a", dark="#e8d5d5")


def _letters(axes: Axes, grid: GridWorld, colour: str, dark: str | None = None) -> None:
    if grid.tiles.size > 400:
        return
    size = max(5, min(10, 60 // max(grid.shape)))
    for s, tile in enumerate(grid.tiles):
        if tile in "SGH":
            row, col = divmod(s, grid.shape[1])
            shade = dark if dark and tile == "H" else colour
            axes.text(col - 0.44, row - 0.42, tile, fontsize=size, color=shade, va="top", zorder=2)


def _wind(axes: Axes, grid: GridWorld) -> None:
    angle, strength = grid.wind.reshape(2, -1)
    windy = np.flatnonzero((grid.tiles == "F") & (strength > 0))
    row, col = np.divmod(windy, grid.shape[1])
    dx, dy = 0.8 * strength[windy] * np.cos(angle[windy]), 0.8 * strength[windy] * np.sin(angle[windy])
    axes.quiver(
        col, row, dx, dy, angles="xy", scale_units="xy", units="xy", scale=1, pivot="mid", color=WIND,
        width=0.1, headwidth=2.5, headlength=2.5, headaxislength=2.5, zorder=1.5,
    )  # fmt: skip


def _policy(axes: Axes, grid: GridWorld, policy: np.ndarray) -> None:
    # Out of H and G every action does the same: arrows there would only look like a choice.
    free = np.flatnonzero(~np.isin(grid.tiles, ["H", "G", "W"]))
    row, col = np.divmod(free, grid.shape[1])
    for move, probability in zip(grid.moves, policy[free].T, strict=True):
        shown = probability > 0.02
        if not move.any():
            for x, y, p in zip(col[shown], row[shown], probability[shown], strict=True):
                axes.add_patch(Circle((x, y), 0.2 * p, color=ARROW, zorder=3))
            continue
        dy, dx = move[:, None] * 0.46 * probability[shown]
        axes.quiver(
            col[shown], row[shown], dx, dy, angles="xy", scale_units="xy", units="xy", scale=1, color=ARROW,
            width=0.06, headwidth=3.5, headlength=3.5, headaxislength=3, minlength=0.2, zorder=3,
        )  # fmt: skip


def _pixels(figure: Figure) -> np.ndarray:
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()
