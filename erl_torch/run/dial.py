"""What a turn of the dial does: theta, and the real world of each policy, of replicas whose optimism varies."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from erl_torch import pictures
from erl_torch.envs.grid_pictures import draw_grid, share_bar
from erl_torch.envs.grid_world import GridWorld
from erl_torch.mdp.tabular import TabularMDP
from erl_torch.solution import Status
from erl_torch.solvers import solve_soft_bellman
from erl_torch.solvers.dial import slope
from erl_torch.solvers.policy import policy_chain, reward_variance, stationary_distribution

BETWEEN = 40  # values of optimism between the ends, at which the exact line is drawn
LEARNT, EXACT, TANGENT = "#0072b2", "#222222", "#d55e00"
PANELS = {
    "theta": "theta, reward per step",
    "reward": "reward per step",
    "falls": "falls per step",
    "variance": "long-run variance of rewards, per step",
}


class World(NamedTuple):
    """Long-run figures of a policy in the real world, per step."""

    reward: float
    falls: float  # steps on traps; NaN where there are none
    variance: float  # of the sum of the rewards, reward squared
    share: np.ndarray  # of time, [S]


class Learnt(NamedTuple):
    """Replicas of one optimism."""

    optimism: float
    theta: np.ndarray  # [R], reward per step; NaN where there is none
    policy: np.ndarray  # [R, S, A]


class Line(NamedTuple):
    """Exact figures at several values of optimism, NaN where there is no single rate."""

    optimism: np.ndarray  # [n]
    figures: dict[str, np.ndarray]  # [n], by the names of PANELS
    tangent: tuple[float, float]  # (theta, d theta/d optimism) at optimism 0


def world(mdp: TabularMDP, policy: np.ndarray, grid: GridWorld | None) -> World:
    """Figures of ``policy`` [S, A]: falls are steps on tiles H of ``grid``."""
    share = stationary_distribution(policy_chain(mdp, policy).transition, mdp.start)
    traps = None if grid is None else np.array([tile == "H" for tile in grid.tiles])
    falls = np.nan if traps is None or not traps.any() else float(share @ traps)
    return World(float(share @ (policy * mdp.reward).sum(1)), falls, reward_variance(mdp, policy), share)


def exact_line(
    mdp: TabularMDP, beta: float, prior: np.ndarray, optimism: Sequence[float], grid: GridWorld | None
) -> Line:
    """The optimum at ``optimism`` and at values between."""
    at = np.unique([*np.linspace(min(optimism), max(optimism), BETWEEN), *optimism, 0.0])
    figures = {name: np.full(len(at), np.nan) for name in PANELS}
    tangent = (np.nan, np.nan)
    for i, value in enumerate(at):
        solution = solve_soft_bellman(mdp, beta, prior, optimism=float(value))
        if solution.status is not Status.CONVERGED or solution.theta is None:
            continue
        of = world(mdp, solution.policy.numpy(), grid)
        for name, figure in zip(PANELS, (solution.theta, *of[:3]), strict=True):
            figures[name][i] = figure
        if value == 0:
            tangent = solution.theta, slope(solution, mdp, prior).optimism
    return Line(at, figures, tangent)


def dial_picture(
    learnt: Sequence[Learnt], line: Line, mdp: TabularMDP, grid: GridWorld | None, title: str
) -> np.ndarray:
    """theta, and what each policy meets in the real world, against optimism; policies and shares of time of some.

    Dots are means over replicas, bars their quartiles; the line is exact.
    """
    learnt = sorted(learnt, key=lambda one: one.optimism)
    worlds = [[world(mdp, policy, grid) for policy in one.policy] for one in learnt]
    found = {"theta": [one.theta for one in learnt]}
    for name in ("reward", "falls", "variance"):
        found[name] = [np.array([getattr(of, name) for of in each]) for each in worlds]
    shown = [name for name in PANELS if np.isfinite(line.figures[name]).any()]
    boards = [] if grid is None else _shown([one.optimism for one in learnt])
    figure, axes, places = _layout(len(shown), len(boards), grid)
    figure.text(0.02, 1 - 0.3 / figure.get_figheight(), title, fontsize=11, weight="bold")
    caption = "dots: learnt, mean with quartiles; line: exact; dashed: slope of theta at optimism 0"
    figure.text(0.02, 1 - 0.52 / figure.get_figheight(), caption, fontsize=8, color="#666666")
    for one, name in zip(axes, shown, strict=True):
        _panel(one, [each.optimism for each in learnt], found[name], line, name)
    if grid is not None:
        shares = [np.mean([of.share for of in worlds[i]], axis=0) for i in boards]
        top = float(np.max(shares, initial=0.0))
        for place, i, share in zip(places, boards, shares, strict=True):
            on = figure.add_axes(place)
            draw_grid(on, grid, learnt[i].policy.mean(0), share, top)
            on.set_title(f"optimism {learnt[i].optimism:g}", fontsize=9)
        share_bar(figure, (0.955, places[0][1], 0.008, places[0][3]), top)
    return pictures.pixels(figure)


def _shown(optimism: Sequence[float]) -> list[int]:
    """Places in the ascending ``optimism`` whose boards are drawn: the lowest, what is nearest to 0, the first above
    that, and what is nearest to 1."""
    at = np.array(optimism)
    zero = int(np.argmin(np.abs(at)))
    return sorted({0, zero, min(zero + 1, len(at) - 1), int(np.argmin(np.abs(at - 1)))})


def _layout(
    n_panels: int, n_boards: int, grid: GridWorld | None
) -> tuple[Figure, list[Axes], list[tuple[float, float, float, float]]]:
    """(figure, axes of the curves, places of the boards)."""
    width, curves = 12.0, 2.6  # inches
    rows, cols = (1, 1) if grid is None else grid.shape
    board = min(2.6 * cols / rows, 0.92 * width / max(n_boards, 1) - 0.2)
    boards = board * rows / cols + 0.45 if n_boards else 0.0
    height = 0.75 + curves + 0.55 + boards
    figure = Figure(figsize=(width, height), dpi=130)
    step = 0.99 / n_panels
    axes = [
        figure.add_axes((0.055 + i * step, (boards + 0.5) / height, step - 0.065, (curves - 0.1) / height))
        for i in range(n_panels)
    ]
    wide, high = board / width, (boards - 0.45) / height
    gap = (0.93 - n_boards * wide) / max(n_boards, 1)
    places = [(0.02 + gap / 2 + i * (wide + gap), 0.1 / height, wide, high) for i in range(n_boards)]
    return figure, axes, places


def _panel(axes: Axes, optimism: Sequence[float], found: Sequence[np.ndarray], line: Line, name: str) -> None:
    axes.plot(line.optimism, line.figures[name], color=EXACT, linewidth=1.2, zorder=2)
    good = [(x, values[np.isfinite(values)]) for x, values in zip(optimism, found, strict=True)]
    drawn = [(x, values) for x, values in good if values.size]
    if drawn:
        x = [x for x, _ in drawn]
        mean = np.array([values.mean() for _, values in drawn])
        low, high = np.array([np.quantile(values, (0.25, 0.75)) for _, values in drawn]).T
        axes.vlines(x, low, high, color=LEARNT, linewidth=2.5, alpha=0.5, zorder=3)
        axes.plot(x, mean, "o", color=LEARNT, markersize=4, zorder=4)
    if name == "theta" and np.isfinite(line.tangent).all():
        ends = np.array([line.optimism.min(), line.optimism.max()])
        limits = axes.get_ylim()
        axes.plot(ends, line.tangent[0] + line.tangent[1] * ends, "--", color=TANGENT, linewidth=1.0, zorder=1.5)
        axes.set_ylim(limits)
    axes.axvline(0.0, color="#999999", linewidth=0.8, zorder=1)
    pictures.plain(axes, "robust   \u2190   optimism   \u2192   optimistic", PANELS[name])
