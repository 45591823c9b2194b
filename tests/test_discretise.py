"""Uniform bins, and environments with Box observations made Discrete."""

import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from gymnasium.utils.passive_env_checker import env_reset_passive_checker, env_step_passive_checker
from hypothesis import given
from hypothesis import strategies as st

from erl_torch import InputError
from erl_torch.envs.discretise import Discretise, UniformBins


def digitized(space, points):
    """The same cells by np.digitize, point by point."""
    cells = []
    for point in points:
        places = [
            np.digitize(x, np.linspace(low, high, n + 1)[1:-1])
            for x, n, low, high in zip(point, space.bins, space.low, space.high, strict=True)
        ]
        cells.append(np.ravel_multi_index(places, space.bins, order="F"))
    return np.array(cells)


@st.composite
def spaces(draw):
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    d = draw(st.integers(1, 4))
    low = rng.normal(size=d)
    high = low + rng.lognormal(size=d)
    return rng, UniformBins(tuple(rng.integers(1, 9, d).tolist()), tuple(low.tolist()), tuple(high.tolist()))


@given(spaces())
def test_cells_are_those_of_digitize(problem):
    rng, space = problem
    width = np.subtract(space.high, space.low)
    points = np.array(space.low) + rng.uniform(-0.5, 1.5, (200, len(width))) * width
    expected = digitized(space, points)
    assert np.array_equal(space.cells(points), expected)
    by_torch = space.cells(torch.from_numpy(points))
    assert by_torch.dtype == torch.int64
    assert np.array_equal(by_torch.numpy(), expected)


@given(spaces())
def test_corners_enclose_the_cell(problem):
    rng, space = problem
    cells = rng.integers(space.n_cells, size=100)
    lower, upper = space.corners(cells)
    np.testing.assert_allclose(upper - lower, np.tile(space.widths, (100, 1)), rtol=1e-9)
    assert np.array_equal(digitized(space, lower + rng.uniform(0.001, 0.999, lower.shape) * (upper - lower)), cells)


def test_whole_numbers_of_any_type():
    bins, low, high = (2, 3), (0.0, 0.0), (1.0, 1.0)
    assert UniformBins((np.int32(2), np.uint8(3)), low, high) == UniformBins(bins, low, high)


def test_little_endian_and_end_bins():
    space = UniformBins((2, 3), (0.0, 0.0), (1.0, 3.0))
    points = [[0.1, 0.5], [0.9, 0.5], [0.1, 1.5], [0.9, 2.5], [-9, 99], [np.inf, -np.inf], [0.5, 1.0]]
    assert space.cells(np.array(points)).tolist() == [0, 1, 2, 5, 4, 1, 3]


@given(spaces())
def test_distribution_of_a_box(problem):
    """Against the overlap of every cell with the box, the end bins open outwards; a point is in its cell."""
    rng, space = problem
    width = np.subtract(space.high, space.low)
    a = np.array(space.low) + rng.uniform(-0.5, 1.0, len(width)) * width
    b = a + rng.uniform(0.1, 1.0, len(width)) * width
    lower, upper = space.corners(np.arange(space.n_cells))
    lower = np.where(lower <= np.array(space.low) + 1e-9, -np.inf, lower)
    upper = np.where(upper >= np.array(space.high) - 1e-9, np.inf, upper)
    overlap = np.clip(np.minimum(upper, b) - np.maximum(lower, a), 0, None) / (b - a)
    np.testing.assert_allclose(space.box_distribution(a, b), overlap.prod(1), atol=1e-9)
    point = space.box_distribution(a, a)
    assert point.sum() == 1
    assert point[space.cells(a[None])[0]] == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (((2,), (0.0,), (1.0, 2.0)), "of one length"),
        (((), (), ()), "of one length"),
        (((0,), (0.0,), (1.0,)), r"bins\[0\]=0: must be a whole number >= 1"),
        (((1.5,), (0.0,), (1.0,)), r"bins\[0\]=1.5"),
        (((2,), (-np.inf,), (1.0,)), r"low\[0\]=-inf: must be a finite number"),
        (((2, 2), (0.0, 0.0), (1.0, np.nan)), r"high\[1\]=nan"),
        (((2,), (1.0,), (1.0,)), r"high\[0\]=1.0: must be above low\[0\]=1.0"),
        (((2**11,) * 3, (0.0,) * 3, (1.0,) * 3), "fewer than"),
    ],
)
def test_bad_bins_are_refused(arguments, message):
    with pytest.raises(InputError, match=message):
        UniformBins(*arguments)


def test_bad_points_are_refused():
    space = UniformBins((2, 2), (0.0, 0.0), (1.0, 1.0))
    for points in (np.array([[0.5, np.nan]]), torch.tensor([[0.5, torch.nan]])):
        with pytest.raises(InputError, match="points=nan"):
            space.cells(points)
    with pytest.raises(InputError, match=r"shape \[N, 2\]"):
        space.cells(np.zeros((3, 1)))


class Fixed(gym.Env):
    """Spaces as given; the observation is the action, or what it is told to be."""

    def __init__(self, observation_space, action_space, observation=None):
        self.observation_space, self.action_space, self.observation = observation_space, action_space, observation

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(self.observation_space.shape, np.float32), {}

    def step(self, action):
        self.action = action
        return (action if self.observation is None else self.observation), 1, False, False, {}


BOX = gym.spaces.Box(-1, 1, (2,))


def test_bins_of_the_spaces_own_bounds():
    env: Any = Discretise(gym.make("MountainCar-v0"), [12, 6])
    assert env.observation_space == gym.spaces.Discrete(72)
    assert env.action_space == gym.spaces.Discrete(3)
    low, high = (tuple(np.array(ends, np.float32).tolist()) for ends in ([-1.2, -0.07], [0.6, 0.07]))
    space = UniformBins((12, 6), low, high)
    state, _ = env.reset(seed=0)
    for t in range(150):
        assert type(state) is np.int64
        assert state == digitized(space, [np.array(env.unwrapped.state, np.float32)])[0]
        state, reward, *_ = env.step(t // 30 % 3)
        assert reward == -1.0


def test_box_actions():
    env: Any = Discretise(Fixed(BOX, BOX), 4, actions=3)
    assert env.action_space.n == 9
    env.reset(seed=0)
    seen = []
    for a in range(9):
        state, *_ = env.step(np.int64(a))
        assert state == digitized(env.bins, [env.unwrapped.action])[0]
        seen.append(env.unwrapped.action.tolist())
    assert sorted(seen) == [[x, y] for x in (-1, 0, 1) for y in (-1, 0, 1)]
    assert Discretise(Fixed(BOX, BOX), 4, actions=[[0, 1], [1, 0]]).actions.tolist() == [[0, 1], [1, 0]]
    pendulum = Discretise(gym.make("Pendulum-v1"), 5, actions=[-2, 0.5])
    assert pendulum.actions.tolist() == [[-2], [0.5]]
    with pytest.raises(ValueError, match=r"action=2: must be a whole number in \[0, 2\)"):
        pendulum.step(2)


def test_discrete_actions_keep_their_numbers():
    env: Any = Discretise(Fixed(BOX, gym.spaces.Discrete(3, start=5), np.zeros(2)), 4)
    env.reset(seed=0)
    env.step(2)
    assert env.unwrapped.action == 7


def test_features_and_nan():
    env: Any = Discretise(Fixed(BOX, BOX), 4, [0.0], [2.0], actions=3, features=lambda x: np.hypot(*x)[None])
    env.reset(seed=0)
    assert env.observation_space.n == 4
    assert env.step(4)[0] == 0
    assert env.step(8)[0] == 2
    broken = Discretise(Fixed(BOX, BOX, np.full(2, np.nan)), 4, actions=3)
    broken.reset(seed=0)
    with pytest.raises(InputError, match="nan"):
        broken.step(0)


def test_gymnasiums_check_sees_only_that_it_is_a_wrapper():
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        env = gym.make("Pendulum-v1").unwrapped
        wrapped = Discretise(env, 5, actions=3)
        env_reset_passive_checker(wrapped)
        env_step_passive_checker(wrapped, 1)  # type: ignore[misc]  # its own type of actions
    assert not caught

    class Unwrapped(gym.Env):  # check_env wants an environment that is not a wrapper
        def __init__(self):
            self.inner = Discretise(gym.make("Pendulum-v1").unwrapped, 5, actions=3)
            self.observation_space, self.action_space = self.inner.observation_space, self.inner.action_space

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            return self.inner.reset(seed=seed, options=options)

        def step(self, action):
            return self.inner.step(action)

    check_env(Unwrapped(), skip_render_check=True)


@pytest.mark.parametrize(
    ("env", "arguments", "message"),
    [
        ("CartPole-v1", dict(bins=4), r"low\[1\]=-inf: must be finite: dimension 1 .* give low and high"),
        ("CartPole-v1", dict(bins=4, low=-1.0), r"high\[1\]=inf"),
        ("CartPole-v1", dict(bins=[4, 4], low=-1.0, high=1.0), r"bins=\[4, 4\]: must be a number or 4 numbers"),
        ("CartPole-v1", dict(bins=4, low=[0.0], high=1.0), "low=.*a number or 4 numbers"),
        ("CartPole-v1", dict(bins=4, low=-1.0, high=1.0, actions=3), "actions=3: must be left out"),
        ("Pendulum-v1", dict(bins=4), "actions=None: must be a list of values in Box"),
        ("Pendulum-v1", dict(bins=4, actions=[-3.0, 0.0]), r"actions=\[-3.0, 0.0\]: must be a list of values in Box"),
        ("Pendulum-v1", dict(bins=4, actions=[]), "actions="),
        ("Pendulum-v1", dict(bins=4, actions=["up"]), "actions="),
        ("Pendulum-v1", dict(bins=4, actions=1), "actions=1: must be a whole number >= 2"),
        ("Pendulum-v1", dict(bins=4, actions=3, features=lambda x: x), "low, high=None, None: must be lists"),
        ("FrozenLake-v1", dict(bins=4), r"observation_space=Discrete\(16\): must be a one-dimensional Box"),
        (Fixed(gym.spaces.Box(0, 255, (4, 4, 3), np.uint8), BOX), dict(bins=4), "observation_space=Box"),
        (Fixed(gym.spaces.Dict(x=BOX), BOX), dict(bins=4), "observation_space=Dict"),
        (Fixed(BOX, gym.spaces.MultiDiscrete([2, 2])), dict(bins=4), "action_space=MultiDiscrete"),
        (Fixed(BOX, gym.spaces.Box(-np.inf, 1, (1,))), dict(bins=4, actions=3), "has no bounds to divide"),
        (Fixed(gym.spaces.Box(-np.finfo(np.float32).max, 1, (1,)), BOX), dict(bins=4, actions=3), r"low\[0\]=-3.4"),
    ],
)
def test_what_cannot_be_binned_is_refused_in_one_line(env, arguments, message):
    with pytest.raises(InputError, match=message) as caught:
        Discretise(gym.make(env) if isinstance(env, str) else env, **arguments)
    assert "\n" not in str(caught.value)
