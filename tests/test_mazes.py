"""Random mazes: the law of experiments, and the same maze for a seed for ever."""

import hashlib

import numpy as np
import pytest
from scipy import stats

from erl_torch import InputError
from erl_torch.envs import kernels
from erl_torch.envs.mazes import random_maze, random_mazes


def fingerprint(grid):
    wind = np.round(grid.wind, 9) + 0.0  # no negative zeros
    return hashlib.sha256("".join(grid.desc).encode() + wind.tobytes()).hexdigest()[:16]


@pytest.mark.parametrize(
    ("arguments", "known"),
    [
        (dict(), "f409b1bb00e391c9"),
        (dict(size=30, density=0.25, wind_level=4.0, seed=7), "8cc85139703d4158"),
        (dict(size=20, n_traps=3, wind_level=1.0, seed=123456789, lowest_angle=1.0), "dba53b1cb6988364"),
    ],
)
def test_a_seed_gives_the_same_maze_for_ever(arguments, known):
    assert fingerprint(random_maze(**arguments)) == known


def test_number_i_does_not_depend_on_how_many(monkeypatch):
    many = [fingerprint(grid) for grid in random_mazes(7, 10, seed=3)]
    assert [fingerprint(grid) for grid in random_mazes(4, 10, seed=3)] == many[:4]
    assert len(set(many)) == 7
    monkeypatch.setattr("erl_torch.envs.mazes.BATCH_NUMBERS", 2000)
    assert [fingerprint(grid) for grid in random_mazes(7, 10, seed=3)] == many
    assert list(random_mazes(0)) == []


def test_layout():
    """S, G and the traps stand where they may; each free tile is a trap equally often (chi-square)."""
    counts = np.zeros((8, 8))
    for grid in random_mazes(3000, 8, n_traps=6, seed=1):
        tiles = grid.tiles.reshape(8, 8)
        assert tiles[6, 1] == "S"
        assert tiles[1, 6] == "G"
        traps = tiles == "H"
        assert traps.sum() == 6
        assert set(tiles.ravel()) == set("SGHF")
        counts += traps
    near = np.zeros((8, 8), bool)
    near[5:8, 0:3] = near[0:3, 5:8] = True
    assert counts[near].sum() == 0
    expected = 3000 * 6 / (~near).sum()
    # Traps of one maze exclude each other: the variance is smaller by (1 - 6/46) than chi-square takes it to be.
    statistic = ((counts[~near] - expected) ** 2 / expected).sum() / (1 - 6 / 46)
    assert 1e-4 < stats.chi2.sf(statistic, (~near).sum() - 1) < 1 - 1e-4


def smoothed_by_the_rules(field, noise):
    """The sweeps of the law, tile by tile."""
    rows, cols = field.shape
    for added in noise:
        for i in range(rows):
            for j in range(cols):
                around = (field[i - 1, j], field[(i + 1) % rows, j], field[i, j - 1], field[i, (j + 1) % cols])
                field[i, j] = (field[i, j] + sum(around)) / 5 + added[i, j]
    return field


def test_smoothing_is_the_raster_sweep():
    rng = np.random.default_rng(0)
    wind, noise = rng.random((3, 2, 6, 5)), rng.standard_normal((3, 5, 6, 5))
    expected = wind.copy()
    for m in range(3):
        expected[m, 0] = smoothed_by_the_rules(expected[m, 0].copy(), noise[m])
        expected[m, 1] = smoothed_by_the_rules(expected[m, 1].copy(), np.zeros((1, 6, 5)))
    kernels.smooth_wind(wind, noise)
    np.testing.assert_allclose(wind, expected, rtol=1e-12)


def test_wind_follows_its_law():
    """Against fields drawn tile by tile with NumPy's own generators: two-sample Kolmogorov-Smirnov at fixed tiles."""
    level, n, size = 4.0, 1500, 6
    drawn = [grid.wind for grid in random_mazes(n, size, 0, wind_level=level, seed=5)]
    rng = np.random.default_rng(0)
    other = []
    for _ in range(n):
        noise = rng.standard_normal((5, size, size)) * (0.6 * np.pi / np.arange(1, 6))[:, None, None]
        angle = smoothed_by_the_rules(np.full((size, size), rng.uniform(0, 2 * np.pi)), noise)
        strength = smoothed_by_the_rules(rng.beta(level, 2, (size, size)), np.zeros((1, size, size)))
        other.append(np.stack([angle, strength]))
    fields = np.stack(drawn), np.stack(other)
    for i, j in ((0, 0), (2, 3), (5, 5)):
        for part in range(2):
            assert stats.ks_2samp(*(field[:, part, i, j] for field in fields)).pvalue > 1e-3
    neighbours = [wind[:, 0, 2, 3] - wind[:, 0, 2, 2] for wind in fields]
    assert stats.ks_2samp(*neighbours).pvalue > 1e-3


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (dict(size=4), "size=4"),
        (dict(n_traps=83), "n_traps=83: must be at most 82"),
        (dict(n_traps=-1), "n_traps=-1"),
        (dict(density=-0.1), "density=-0.1"),
        (dict(wind_level=0.0), "wind_level=0.0"),
        (dict(seed=-1), "seed=-1"),
        (dict(lowest_angle=7.0), "lowest_angle=7.0"),
        (dict(trap_reward=float("inf")), "trap_reward=inf"),
    ],
)
def test_bad_arguments_are_refused(arguments, message):
    with pytest.raises(InputError, match=message):
        random_maze(**arguments)


def test_number_of_traps_rounds_half_to_even():
    assert ["".join(random_maze(10, density=d).desc).count("H") for d in (0.15, 0.25, 0.2)] == [2, 2, 2]
