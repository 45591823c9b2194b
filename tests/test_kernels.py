"""Kernels alone, where what calls them would not show a mistake: edges, extremes, chains counted by hand."""

import math
from itertools import product

import numba
import numpy as np
import pytest

from erl_torch import TabularMDP, Transitions
from erl_torch.empirical.counts import tally
from erl_torch.envs import kernels as envs_kernels
from erl_torch.evaluation import Judge
from erl_torch.experience import kernels as experience_kernels
from erl_torch.experience.sampling import _levels, _words, policy_cdf, sampling_tables
from erl_torch.learners.efficient_s1 import kernels as efficient_s1_kernels
from erl_torch.learners.s1 import kernels as s1_kernels
from erl_torch.solvers.policy import reward_per_step

BELOW_1 = math.nextafter(1.0, 0.0)


@pytest.mark.parametrize("x", [0.0, 0.1, 0.25, 0.3, 0.5, 0.75, BELOW_1])
def test_draws_are_of_half_open_intervals(x):
    """Entry m is drawn for x in [cdf[m - 1], cdf[m]): never one of probability 0, also at the edges."""
    cdf = np.array([9.0, 9.0, 0.0, 0.25, 0.25, 0.5, 0.5, 1.0, 9.0])  # a row at 2..8
    expected = 2 + np.searchsorted(cdf[2:8], x, side="right")
    assert experience_kernels._draw(cdf, 2, 8, x) == expected
    low, length = np.full(5, 2, np.uint64), np.full(5, 6, np.uint64)
    experience_kernels._draw_lanes(cdf, low, length, _levels(6), np.full(5, x))
    assert (low == expected).all()


def test_uniforms_are_numpys_to_the_last_bit():
    generators = [np.random.default_rng(seed) for seed in range(3)]
    state, out = _words(generators), np.empty((500, 3))
    experience_kernels._uniforms(state, out[:200], 200)
    experience_kernels._uniforms(state, out[200:], 300)
    assert np.array_equal(out, np.stack([generator.random(500) for generator in generators], axis=1))


def test_a_step_of_pcg64_without_the_compiler_is_numpys():
    generator = np.random.PCG64(5)
    state = generator.state["state"]
    words = [state["state"] >> 64, state["state"] & 2**64 - 1, state["inc"] >> 64, state["inc"] & 2**64 - 1]
    for expected in generator.random_raw(1000):
        *words[:2], found = experience_kernels._pcg64_uncompiled(*words)
        assert found == expected


@numba.njit
def fma(a, b, c):
    return s1_kernels._fma(a, b, c)


EDGES = (
    0.0,
    -0.0,
    1.0,
    -1.0 - 2**-52,
    0.1,
    3.0,
    2.0**-1074,
    2.0**-537,
    -(2.0**-600),
    1e308,
    -1e308,
    math.inf,
    math.nan,
)


def test_a_multiply_add_without_the_compiler_is_the_compiled_one():
    """Signs of zeros, numbers below the smallest normal one, overflow; and numbers whose product nearly cancels."""
    rng = np.random.default_rng(0)
    cases = list(product(EDGES, repeat=3))
    for a, b in rng.standard_normal((1000, 2)):
        cases += [(a, b, -a * b), (a, b, rng.standard_normal()), (a * 2.0**-700, b * 2.0**-350, 2.0**-1060)]
    with np.errstate(all="ignore"):
        for case in cases:
            one, other = s1_kernels._fma_uncompiled(*case), np.float64(fma(*case))
            assert one.tobytes() == other.tobytes() or (np.isnan(one) and np.isnan(other)), case


def test_lanes_draw_from_rows_of_any_length():
    for n in range(1, 70):
        middles = np.tile((np.arange(n) + 0.5) / n, 4)
        low, length = np.zeros(4 * n, np.uint64), np.full(4 * n, n, np.uint64)
        experience_kernels._draw_lanes(np.arange(1, n + 1) / n, low, length, _levels(n), middles)
        assert np.array_equal(low, np.tile(np.arange(n), 4))


def test_rounding_reaches_no_entry_of_probability_0():
    """Ten times .1 is less than 1, by as much as the largest uniform number is."""
    data = np.array([0.1] * 10 + [0.0, 0.5, 0.5])
    assert sum(data[:10]) == BELOW_1
    cdf = experience_kernels.cumulative_rows(np.array([0, 11, 13]), data)
    assert experience_kernels._draw(cdf, 0, 11, BELOW_1) == 9
    low, length = np.zeros(4, np.uint64), np.full(4, 11, np.uint64)
    experience_kernels._draw_lanes(cdf, low, length, _levels(11), np.full(4, BELOW_1))
    assert (low == 9).all()
    assert cdf[11:].tolist() == [0.5, 1.0]


def test_returns_on_a_cycle_are_counted():
    """0 -> 1 -> 2 -> 0 pays 1, 10, 100 on the state left: seven steps from 0 are 223."""
    mdp = TabularMDP(np.roll(np.eye(3), 1, 1)[:, None], [[1.0], [10.0], [100.0]], [1, 0, 0])
    policy = np.ones((3, 1))
    returns = np.zeros(2)
    experience_kernels.simulate_returns(*sampling_tables(mdp), policy_cdf(policy), 7, np.random.default_rng(0), returns)
    assert returns.tolist() == [223.0, 223.0]
    for rate in (reward_per_step(mdp, policy, 7), Judge(mdp, policy, 7).reward_per_step(policy)):
        assert 7 * rate == pytest.approx(223.0, rel=1e-15)


def test_cells_are_counted_row_by_row():
    cells = np.random.default_rng(0).integers(9, size=(20, 6)).astype(np.int32)
    length, indices, counts = envs_kernels.count_rows(cells, 9)
    expected = [np.unique(row, return_counts=True) for row in cells]
    assert length.tolist() == [len(cell) for cell, _ in expected]
    assert np.array_equal(indices, np.concatenate([cell for cell, _ in expected]))
    assert np.array_equal(counts, np.concatenate([n for _, n in expected]))


def test_the_tally_keeps_the_last_reward_and_the_range():
    for rewards, varied in (([1.0, 3.0, 1.0, -2.0], True), ([3.0, 1.0, 1.0, 1.0], True), ([2.0] * 4, False)):
        zeros = np.zeros(4, int)
        found = tally(Transitions(zeros, zeros, rewards, zeros, zeros), 1, 1)
        assert (found.last_reward[0], found.varied) == (rewards[-1], varied)
        assert found.reward_range == (min(rewards), max(rewards))
    # Each pair has one reward, whatever the others have.
    s = np.array([0, 1, 0, 1])
    assert not tally(Transitions(s, 0 * s, [1.0, 2.0, 1.0, 2.0], s, 0 * s), 2, 1).varied


@pytest.mark.parametrize("log_new", [-1e4, -800.0, -1.0, 0.0, 1e-9, 3.0, 800.0, 1e4])
@pytest.mark.parametrize("step", [1e-12, 0.3, 1.0])
def test_log_blend(log_new, step):
    """log((1 - step) x + step new)."""
    for log_x in (0.0, -50.0, 1e3):
        expected = log_new
        if step < 1.0:
            expected = np.logaddexp(math.log1p(-step) + log_x, math.log(step) + log_new)
        assert efficient_s1_kernels._log_blend(log_x, log_new, step) == pytest.approx(expected, rel=1e-9, abs=1e-11)
