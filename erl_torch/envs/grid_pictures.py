"""Pictures of grid worlds: tiles, wind, policies, shares of time, reward biases."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PolyCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize, to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from erl_torch.envs.grid_world import TILES, GridWorld
from erl_torch.labels import NUMBERS, Names
from erl_torch.pictures import DPI, MAX_PX, colour_bar, pixels, table_picture

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


def grid_of(env: gym.Env[Any, Any]) -> GridWorld | None:
    """The grid of an environment of this package; None of others."""
    grid = getattr(env.unwrapped, "grid", None)
    return grid if isinstance(grid, GridWorld) else None


def policy_picture(
    policy: np.ndarray,
    grid: GridWorld | None = None,
    title: str = "",
    max_px: int = MAX_PX,
    names: Names = NUMBERS,
) -> np.ndarray:
    """The policy [S, A]: arrows as long as their probability on a grid, else a table of shades."""
    if grid is None:
        return table_picture(policy, title, "pi(a|s)", max_px, names)
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
        colour_bar(figure, shares(float(distribution.max())), "share of time")
    figure.set_dpi(DPI * scale)
    return pixels(figure)


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


def share_bar(figure: Figure, place: tuple[float, float, float, float], top: float, extend: str = "neither") -> None:
    """A colour bar of shares of time from 0 to ``top`` at ``place`` (left, bottom, width, height; of the figure)."""
    bar = figure.colorbar(shares(top), cax=figure.add_axes(place), extend=extend)
    bar.set_label("share of time", fontsize=8)
    bar.ax.tick_params(labelsize=7)


def bias_picture(
    reward_bias: np.ndarray,
    grid: GridWorld | None = None,
    title: str = "",
    max_px: int = MAX_PX,
    names: Names = NUMBERS,
) -> np.ndarray:
    """delta(s,a) [S, A], reward: a grid tile shows each action's value on the side it points to."""
    label = "delta(s,a), reward"
    if grid is None:
        return table_picture(reward_bias, title, label, max_px, names)
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
    colour_bar(figure, shades, label)
    return pixels(figure)


def board(grid: GridWorld, cell_px: int = 64) -> np.ndarray:
    """The grid with its wind alone, for ``render``: cell_px pixels per tile, fewer on large grids."""
    rows, cols = grid.shape
    cell_px = max(12, min(cell_px, 1200 // max(rows, cols)))
    figure = Figure(figsize=(cols * cell_px / DPI, rows * cell_px / DPI), dpi=DPI)
    axes = figure.add_axes((0, 0, 1, 1))
    _frame(axes, grid)
    _tiles(axes, grid)
    _wind(axes, grid)
    return pixels(figure)


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
        visible = probability > 0.02
        if not move.any():
            for x, y, p in zip(col[visible], row[visible], probability[visible], strict=True):
                axes.add_patch(Circle((x, y), 0.2 * p, color=ARROW, zorder=3))
            continue
        dy, dx = move[:, None] * 0.46 * probability[visible]
        axes.quiver(
            col[visible], row[visible], dx, dy, angles="xy", scale_units="xy", units="xy", scale=1, color=ARROW,
            width=0.06, headwidth=3.5, headlength=3.5, headaxislength=3, minlength=0.2, zorder=3,
        )  # fmt: skip
