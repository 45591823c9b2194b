"""Contract of every registered environment, and the rules of the grid worlds."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
import scipy.sparse as sp
from conftest import DATA
from gymnasium.utils.env_checker import check_env
from scipy import stats

from erl_torch import InputError
from erl_torch.envs import ENTRY_POINTS, EPISODE_LENGTH
from erl_torch.envs.grid_world import GridWorld, uniform_wind
from erl_torch.envs.tabular import TabularEnv
from erl_torch.envs.windy_cliff import WindyCliffEnv

IDS = sorted(ENTRY_POINTS)


@pytest.mark.parametrize("env_id", IDS)
def test_passes_gymnasiums_own_check(env_id):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gym.make(env_id).unwrapped)
        check_env(gym.make(env_id, render_mode="ansi").unwrapped)


@pytest.mark.parametrize("env_id", IDS)
def test_steps_follow_the_model(env_id):
    """Chi-square of s' given (s, a), over all pairs visited often; p > 1e-4 with a fixed seed."""
    env = gym.make(env_id).unwrapped
    n_states, n_actions = env.mdp.n_states, env.mdp.n_actions
    counts = np.zeros((n_states * n_actions, n_states))
    state, _ = env.reset(seed=0)
    actions = np.random.default_rng(1).integers(n_actions, size=60_000)
    for action in actions:
        row = state * n_actions + action
        expected_reward = env.mdp.reward[state, action]
        state, reward, terminated, truncated, _ = env.step(action)
        assert reward == expected_reward
        assert not terminated
        assert not truncated
        counts[row, state] += 1
    p = env.mdp.transition.toarray()
    assert counts[p == 0].sum() == 0
    often = counts.sum(1) > 200
    expected = p[often] * counts[often].sum(1, keepdims=True)
    used = expected > 0
    statistic = ((counts[often] - expected)[used] ** 2 / expected[used]).sum()
    assert stats.chi2.sf(statistic, used.sum() - often.sum()) > 1e-4


@pytest.mark.parametrize("env_id", IDS)
def test_same_seed_same_episode(env_id):
    def episode():
        env = gym.make(env_id)
        states = [env.reset(seed=7)[0]]
        return states + [env.step(t % env.action_space.n)[0] for t in range(200)]

    assert episode() == episode()


@pytest.mark.parametrize("env_id", IDS)
def test_time_limit_and_renders(env_id):
    env = gym.make(env_id, render_mode="rgb_array")
    env.reset(seed=0)
    first = env.render()
    truncated = [env.step(0)[3] for _ in range(EPISODE_LENGTH)]
    assert truncated == [False] * (EPISODE_LENGTH - 1) + [True]
    picture = env.render()
    assert picture.dtype == np.uint8
    assert picture.ndim == 3
    env.unwrapped.state = (env.unwrapped.state + 1) % env.observation_space.n
    assert not np.array_equal(env.render(), picture)  # the agent shows
    assert first.shape == picture.shape
    text = gym.make(env_id, render_mode="ansi")
    text.reset(seed=0)
    assert isinstance(text.render(), str)
    with pytest.raises(ValueError, match="render_mode=holo"):
        text.unwrapped.__class__(render_mode="holo")


def test_cliff_is_the_authors(authors):
    env = WindyCliffEnv()
    np.testing.assert_allclose(env.mdp.transition.toarray(), authors["P"].reshape(60, 15), atol=1e-12)
    assert np.array_equal(env.mdp.reward, authors["R"])
    assert np.array_equal(env.mdp.start, authors["start"])


@pytest.mark.parametrize("i", range(5))
def test_mazes_are_the_authors(i):
    """Rebuilt from tiles and wind field alone."""
    with np.load(DATA / "windy_mazes.npz") as data:
        known = {name: data[f"m{i:02d}_{name}"] for name in ("desc", "wind", "indptr", "indices", "data", "R", "start")}
    mdp = GridWorld(tuple(known["desc"]), known["wind"], trap_reward=-2.0).mdp()
    rows = (known["data"], known["indices"], known["indptr"])
    stored = sp.csr_array(rows, shape=mdp.transition.shape)
    assert abs(mdp.transition - stored).max() <= 1e-12
    np.testing.assert_allclose(mdp.reward, known["R"], atol=1e-12)
    assert np.array_equal(mdp.start, known["start"])


def test_cliff_ansi():
    env = WindyCliffEnv(render_mode="ansi")
    env.reset(seed=0)
    assert env.render() == " H  G  R \n H  F  F \n H  F  F \n H  F  F \n H [S] R \n"
    env.step(np.int64(2))
    assert env.render().startswith("  (right)\n")


def test_wind_at_three_quarters_pi():
    grid = GridWorld(("SFG",), uniform_wind(("SFG",), 0.75 * np.pi, 0.7))
    expected = [[0, 0, 0, 0, 1], [0.35, 0.35, 0, 0, 0.3], [0, 0, 0, 0, 1]]
    np.testing.assert_allclose(grid.wind_probabilities(), expected, atol=1e-12)


def test_rewards_of_tiles_left():
    grid = GridWorld(("SFRHGWCN",), trap_reward=-7.0)
    assert grid.mdp().reward[:, 0].tolist() == [-1, -1, -1, -7, 0, -1, -0.5, -1.5]


def test_walls_borders_and_success():
    #  S W    right from S is blocked by the wall, left and up by the border, down leads to F (state 2)
    #  F G
    grid = GridWorld(("SW", "FG"), action_success_prob=(1, 0.25, 1, 1))
    p = grid.mdp().transition.toarray().reshape(4, 4, 4)
    assert p[0, 0].tolist() == p[0, 2].tolist() == p[0, 3].tolist() == [1, 0, 0, 0]
    assert p[0, 1].tolist() == [0.75, 0, 0.25, 0]
    assert p[2, 2].tolist() == [0, 0, 0, 1]
    assert p[3].tolist() == [[1, 0, 0, 0]] * 4  # from G to the start


def test_starts_on_floor_without_a_start_tile():
    mdp = GridWorld(("FHF",)).mdp()
    assert mdp.start.tolist() == [0.5, 0, 0.5]
    assert mdp.transition.toarray()[4:8].tolist() == [[0.5, 0, 0.5]] * 4


def test_wind_moves_before_the_action():
    """Wind to the right from F (0) onto R (1), then action right to G (2); blocked order would differ."""
    grid = GridWorld(("FRG",), uniform_wind(("FRG",), 0.0, 1.0))
    p = grid.mdp().transition.toarray().reshape(3, 4, 3)
    np.testing.assert_allclose(p[0, 2], [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(p[0, 0], [1, 0, 0], atol=1e-12)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (dict(desc=("SF", "F")), "desc=.*one length"),
        (dict(desc=()), "desc=.*one length"),
        (dict(desc=("SX",)), "desc=X: must be made of the tiles"),
        (dict(desc=("HG",)), "S or F tile"),
        (dict(desc=("SF",), wind=np.zeros((2, 2, 2))), r"wind=array of shape \(2, 2, 2\)"),
        (dict(desc=("SF",), wind=np.full((2, 1, 2), 2.0)), r"strengths in \[0, 1\]"),
        (dict(desc=("SF",), action_success_prob=(1, 1, 1, 2)), "action_success_prob"),
        (dict(desc=("SF",), trap_reward=float("nan")), "trap_reward=nan"),
    ],
)
def test_bad_grids_are_refused(arguments, message):
    with pytest.raises(InputError, match=message):
        GridWorld(**arguments)


@pytest.mark.parametrize(("key", "value"), [("wind_strength", 1.5), ("wind_angle", np.inf), ("trap_reward", "low")])
def test_bad_cliffs_are_refused(key, value):
    with pytest.raises(InputError, match=key):
        WindyCliffEnv(**{key: value})


def test_bad_actions_are_refused():
    env = TabularEnv(WindyCliffEnv().mdp)
    env.reset(seed=0)
    with pytest.raises(ValueError, match="action=4"):
        env.step(4)
