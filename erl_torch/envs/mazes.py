"""Random windy mazes of the paper's Figure 2 and Table S1.

Layout: all F, S at row -2 col 1, G at row 1 col -2. Traps H are drawn uniformly among the F tiles without replacement,
outside the 3x3 blocks around S and G (the paper draws again until that holds, which is the same law).

Wind: one angle for all tiles, then five in-place raster sweeps, i = 1..5, in which each angle becomes the mean of
itself and its four neighbours (periodic) plus N(0, 0.6 pi / i). The strength of each tile is drawn from
Beta(wind_level, 2); one such sweep of means follows. The wind does not blow on S, G and H: there it is stored as 0.

All numbers come from the raw 64-bit words of PCG64, whose stream NumPy keeps for ever, through inverse
distribution functions. So a seed gives the same maze on every machine and in every version.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.special import betaincinv, ndtri

from erl_torch import checks
from erl_torch.checks import InputError
from erl_torch.envs import kernels
from erl_torch.envs.grid_world import GridWorld

SWEEPS = 5
CELL_BYTES = 2500  # of memory per tile, while the model is made
BATCH_NUMBERS = 4_000_000  # random numbers in memory at once


def random_maze(
    size: int = 10,
    n_traps: int | None = None,
    density: float = 0.2,
    wind_level: float = 2.0,
    seed: int = 0,
    trap_reward: float = -2.0,
    lowest_angle: float = 0.0,
) -> GridWorld:
    """One random maze; the arguments are those of ``random_mazes``."""
    return next(random_mazes(1, size, n_traps, density, wind_level, seed, trap_reward, lowest_angle))


def random_mazes(
    n: int,
    size: int = 10,
    n_traps: int | None = None,
    density: float = 0.2,
    wind_level: float = 2.0,
    seed: int = 0,
    trap_reward: float = -2.0,
    lowest_angle: float = 0.0,
) -> Iterator[GridWorld]:
    """``n`` random mazes; the i-th of ``seed`` does not depend on ``n``.

    Args:
        n: whole number >= 0.
        size: rows and columns, >= 5.
        n_traps: number of traps; None takes ``density``.
        density: traps per row length, where n_traps is None: round(size * density), half to even.
        wind_level: first parameter of Beta(wind_level, 2), > 0.
        seed: whole number >= 0.
        trap_reward: reward of leaving a trap.
        lowest_angle: the first angle is uniform in [lowest_angle, 2 pi); the authors' scripts have 1 here.

    Raises:
        InputError: an argument out of range, or more traps than tiles.
    """
    checks.at_least("n", n, 0)
    checks.at_least("size", size, 5)
    checks.at_least("seed", seed, 0)
    checks.positive("wind_level", wind_level)
    checks.number("lowest_angle", lowest_angle, lambda x: 0 <= x < 2 * np.pi, "in [0, 2 pi)")
    if n_traps is None:
        checks.number("density", density, lambda x: 0 <= x < np.inf, "a finite number >= 0")
        n_traps = round(size * density)
    checks.memory("size", size, CELL_BYTES * size**2, f"a maze of {size} x {size} tiles and its model")
    layout, free = _layout(size)
    checks.at_least("n_traps", n_traps, 0)
    if n_traps > free.size:
        raise InputError("n_traps", n_traps, f"at most {free.size}, the free tiles of a {size}x{size} maze")
    return _generate(n, size, int(n_traps), wind_level, seed, trap_reward, lowest_angle, layout, free)


def _layout(size: int) -> tuple[np.ndarray, np.ndarray]:
    """Tiles [size, size] without traps, and the flat indices where traps may be."""
    layout = np.full((size, size), "F")
    kept = np.zeros((size, size), bool)  # free of traps
    for row, col, tile in ((size - 2, 1, "S"), (1, size - 2, "G")):
        layout[row, col] = tile
        kept[row - 1 : row + 2, col - 1 : col + 2] = True
    return layout, np.flatnonzero(~kept)


def _generate(
    n: int,
    size: int,
    n_traps: int,
    wind_level: float,
    seed: int,
    trap_reward: float,
    lowest_angle: float,
    layout: np.ndarray,
    free: np.ndarray,
) -> Iterator[GridWorld]:
    cells = size * size
    counts = [free.size, 1, SWEEPS * cells, cells]  # numbers per maze: traps, first angle, noise, strengths
    batch = max(1, BATCH_NUMBERS // sum(counts))
    scale = 0.6 * np.pi / np.arange(1, SWEEPS + 1)[:, None, None]
    for first in range(0, n, batch):
        drawn = np.stack([_uniforms(seed, i, sum(counts)) for i in range(first, min(n, first + batch))])
        order, angle, noise, strength = np.split(drawn, np.cumsum(counts)[:-1], axis=1)
        tiles = np.repeat(layout.reshape(1, cells), len(drawn), axis=0)
        traps = free[np.argsort(order, axis=1, kind="stable")[:, :n_traps]]
        np.put_along_axis(tiles, traps, "H", axis=1)
        wind = np.empty((len(drawn), 2, size, size))
        wind[:, 0] = (lowest_angle + (2 * np.pi - lowest_angle) * angle)[:, :, None]
        wind[:, 1] = betaincinv(wind_level, 2.0, strength).reshape(-1, size, size)
        kernels.smooth_wind(wind, ndtri(noise).reshape(-1, SWEEPS, size, size) * scale)
        wind *= (tiles == "F").reshape(-1, 1, size, size)
        for rows, field in zip(tiles.reshape(-1, size, size), wind, strict=True):
            yield GridWorld(tuple("".join(row) for row in rows), field, trap_reward)


def _uniforms(seed: int, maze: int, n: int) -> np.ndarray:
    """[n] numbers in (0, 1), from the upper 52 bits of the words of the PCG64 of that maze."""
    words = np.random.PCG64(np.random.SeedSequence(seed, spawn_key=(maze,))).random_raw(n)
    return ((words >> np.uint64(12)) + 0.5) * 2.0**-52
