"""Contract of every registered environment, and the rules of the grid worlds."""

import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import scipy.sparse as sp
from gymnasium.envs.registration import load_env_creator
from gymnasium.utils.env_checker import check_env
from helpers import DATA, random_mdp
from scipy import stats

import erl_torch
from erl_torch import InputError, tabular_mdp
from erl_torch.envs import CONTROL_ENTRY_POINTS, CONTROL_EPISODE_LENGTH, ENTRY_POINTS, EPISODE_LENGTH
from erl_torch.envs.frozen_lake import MAPS, windy_frozen_lake
from erl_torch.envs.grid_world import GridWorld, uniform_wind
from erl_torch.envs.shift import dynamics_shift
from erl_torch.envs.tabular import TabularEnv
from erl_torch.envs.windy_cliff import WindyCliffEnv
from erl_torch.mdp.from_gymnasium import sizes
from erl_torch.solvers.policy import reward_per_step

IDS = sorted(ENTRY_POINTS)
CONTINUOUS = ("erl_torch/WindyStrip-v0",)  # its model: test_network_runs.py
MODELS = [env_id for env_id in IDS if env_id not in {*CONTROL_ENTRY_POINTS, *CONTINUOUS}]  # others: test_control.py
GRIDS = [
    env_id
    for env_id in MODELS
    if "rgb_array" in load_env_creator(gym.spec(env_id).entry_point).metadata["render_modes"]
]


@pytest.fixture(scope="module")
def needed(tmp_path_factory):
    """Arguments that an environment cannot do without."""
    path = tmp_path_factory.mktemp("mdp") / "mdp.npz"
    random_mdp(np.random.default_rng(0), 6, 3).save(path)
    return {"erl_torch/TabularMDP-v0": {"path": str(path)}}


@pytest.fixture
def make(needed):
    return lambda env_id, **arguments: gym.make(env_id, **needed.get(env_id, {}), **arguments)


@pytest.mark.parametrize("env_id", IDS)
def test_passes_gymnasiums_own_check(make, env_id):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(checkable(make(env_id)), skip_render_check=True)
        for mode in set(make(env_id).unwrapped.metadata["render_modes"]) - {"human"}:
            env = make(env_id, render_mode=mode)
            check_env(checkable(env), skip_render_check=True)
            env.reset(seed=0)
            assert isinstance(env.render(), str if mode == "ansi" else np.ndarray)


def checkable(env):
    """The environment itself; where a state lacks actions, Gymnasium's check draws among those that there are."""
    base = env.unwrapped
    mdp = getattr(base, "mdp", None)
    if mdp is not None and not mdp.allowed.all():
        base.action_space.sample = lambda *_: np.random.default_rng(0).choice(np.flatnonzero(mdp.allowed[base.state]))
    return base


@pytest.mark.parametrize("env_id", MODELS)
def test_rows_sum_to_one_and_every_state_is_a_state(make, env_id):
    env = make(env_id)
    n_states, n_actions = sizes(env)
    mdp = tabular_mdp(env)
    assert (mdp.n_states, mdp.n_actions) == (n_states, n_actions)
    np.testing.assert_allclose(mdp.transition.sum(axis=1), mdp.allowed.ravel(), atol=1e-12)
    np.testing.assert_allclose(mdp.start.sum(), 1, atol=1e-12)
    assert (mdp.transition.data > 0).all()


@pytest.mark.slow
@pytest.mark.parametrize("env_id", MODELS)
def test_steps_follow_the_model(make, env_id):
    steps_follow_the_model(make(env_id).unwrapped)


def test_steps_follow_the_model_with_every_rule():
    """Nine actions that may fail, walls, an end of the episode; the model restarts where the environment ends."""
    wind = np.random.default_rng(0).random((2, 7, 7)) * np.array([2 * np.pi, 0.9])[:, None, None]
    env = gym.make(
        "erl_torch/WindyFrozenLake-v0", desc="zigzag", wind=wind, n_actions=9,
        action_success_prob=np.linspace(0.5, 1, 9), cyclic=False,
    )  # fmt: skip
    steps_follow_the_model(env.unwrapped)


def steps_follow_the_model(env):
    """Chi-square of s' given (s, a), over all pairs visited often; p > 1e-4 with a fixed seed."""
    n_states, n_actions = env.mdp.n_states, env.mdp.n_actions
    counts = np.zeros((n_states * n_actions, n_states))
    state, _ = env.reset(seed=0)
    draws = np.random.default_rng(1).random(30_000)
    have = [np.flatnonzero(row) for row in env.mdp.allowed]
    for draw in draws:
        action = int(have[state][int(draw * len(have[state]))])
        row = state * n_actions + action
        expected_reward = env.mdp.reward[state, action]
        before = state
        state, reward, terminated, truncated, _ = env.step(action)
        assert reward == expected_reward
        assert terminated == env.ends[before]
        assert not truncated
        if terminated:
            assert state == before
            state, _ = env.reset()
        counts[row, state] += 1
    p = env.mdp.transition.toarray()
    assert counts[p == 0].sum() == 0
    often = counts.sum(1) > 200
    expected = p[often] * counts[often].sum(1, keepdims=True)
    used = expected > 0
    statistic = ((counts[often] - expected)[used] ** 2 / expected[used]).sum()
    freedom = used.sum() - often.sum()
    assert statistic == 0 if freedom == 0 else stats.chi2.sf(statistic, freedom) > 1e-4


def action_at(env, t):
    """The actions that the present state has, in turn."""
    mdp = getattr(env.unwrapped, "mdp", None)
    have = range(env.action_space.n) if mdp is None else np.flatnonzero(mdp.allowed[env.unwrapped.state])
    return int(have[t % len(have)])


@pytest.mark.parametrize("env_id", IDS)
def test_same_seed_same_episode(make, env_id):
    def episode():
        env = make(env_id)
        states = [env.reset(seed=7)[0]]
        for t in range(200):
            state, _, terminated, _, _ = env.step(action_at(env, t // 3))
            states += [state, env.reset()[0]] if terminated else [state]
        return states

    assert all(np.array_equal(one, other) for one, other in zip(episode(), episode(), strict=True))


@pytest.mark.parametrize("env_id", IDS)
def test_time_limit(make, env_id):
    env = make(env_id)
    env.reset(seed=0)
    length = CONTROL_EPISODE_LENGTH if env_id in CONTROL_ENTRY_POINTS else EPISODE_LENGTH
    for t in range(1, length + 1):
        _, _, terminated, truncated, _ = env.step(action_at(env, t))
        if terminated:
            return  # CartPole's pole falls first
        assert truncated == (t == length)


@pytest.mark.parametrize("env_id", IDS)
def test_unknown_render_modes_are_refused(make, env_id):
    warnings.simplefilter("ignore")  # Gymnasium's own
    with pytest.raises(ValueError, match="render_mode=holo"):
        make(env_id, render_mode="holo")


@pytest.mark.parametrize("env_id", GRIDS)
def test_the_agent_shows(make, env_id):
    env = make(env_id, render_mode="rgb_array")
    env.reset(seed=0)
    first = env.render()
    assert first.dtype == np.uint8
    assert first.ndim == 3
    env.unwrapped.state = (env.unwrapped.state + 1) % env.observation_space.n
    second = env.render()
    assert second.shape == first.shape
    assert not np.array_equal(first, second)


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
    mdp = windy_frozen_lake(desc=known["desc"], wind=known["wind"], trap_reward=-2.0)
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
    grid = GridWorld(("SFG",), uniform_wind(0.75 * np.pi, 0.7))
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


def test_nine_actions():
    """Diagonals slide along borders, are stopped by walls, and cost sqrt(2)."""
    #  R R W    state 1 is the middle of the top row, 3 4 5 the second row
    #  S R R
    grid = GridWorld(("RRW", "SRR"), n_actions=9)
    p = grid.mdp().transition.toarray().reshape(6, 9, 6).argmax(2)
    assert p[4].tolist() == [3, 4, 5, 1, 4, 3, 5, 4, 0]  # right-up is a wall: it stays
    assert p[0].tolist() == [0, 3, 1, 0, 0, 3, 4, 1, 0]  # left-down and right-up slide, up-left stays
    root = -np.sqrt(2)
    np.testing.assert_allclose(grid.mdp().reward[4], [-1, -1, -1, -1, -1, root, root, root, root])
    assert grid.action_names[4:] == ("stay", "left-down", "down-right", "right-up", "up-left")


@pytest.mark.parametrize(
    ("n_actions", "kept"), [(4, [0, 1, 2, 3]), (5, [0, 1, 2, 3, 4]), (8, [0, 1, 2, 3, 5, 6, 7, 8])]
)
def test_fewer_actions_are_some_of_the_nine(n_actions, kept):
    wind = uniform_wind(1.0, 0.6)
    all_nine = windy_frozen_lake("holes", wind, n_actions=9)
    some = windy_frozen_lake("holes", wind, n_actions=n_actions)
    rows = (np.arange(64)[:, None] * 9 + np.array(kept)).ravel()
    assert abs(all_nine.transition[rows] - some.transition).max() < 1e-15
    assert np.array_equal(all_nine.reward[:, kept], some.reward)


@pytest.mark.parametrize("name", sorted(MAPS))
def test_maps_lead_from_start_to_goal(name):
    """Without wind the best policy finds the goal, far above the prior; with wind it is solved with a proof."""
    mdp = windy_frozen_lake(name)
    best = erl_torch.solve_soft_bellman(mdp, 20.0)
    goal = "".join(MAPS[name]).index("G")
    share = erl_torch.solvers.policy.induced_distribution(mdp, best.policy.numpy())
    assert share[goal] > 0.01
    assert reward_per_step(mdp, best.policy.numpy(), 1000) > reward_per_step(
        mdp, np.full((mdp.n_states, 4), 0.25), 1000
    )
    windy = erl_torch.solve_soft_bellman(windy_frozen_lake(name, uniform_wind(2.0, 0.4)), 20.0)
    assert windy.theta_bounds[1] - windy.theta_bounds[0] < 1e-8


def test_tile_rewards_can_be_set():
    assert windy_frozen_lake(["SCH"], tile_rewards={"C": 0.5, "H": -9}).reward[:, 0].tolist() == [-1, 0.5, -9]


def test_dynamics_shift_is_figure_4():
    """1000-step returns measured independently (beta 15)."""
    before, after = dynamics_shift()
    late = dynamics_shift(up_success=0.01).after
    solved = {grid: erl_torch.solve_soft_bellman(grid.mdp(), 15.0).policy.numpy() for grid in (before, after, late)}

    def returns(grid, policy):
        return 1000 * reward_per_step(grid.mdp(), policy, 1000)

    assert returns(before, solved[before]) == pytest.approx(-756.59, abs=0.005)
    assert returns(after, solved[before]) == pytest.approx(-1000.00, abs=0.005)
    assert returns(late, solved[before]) == pytest.approx(-997.14, abs=0.005)
    assert returns(late, solved[late]) == pytest.approx(-947.14, abs=0.005)
    assert returns(after, solved[after]) == pytest.approx(-946.76, abs=0.005)
    env: Any = gym.make("erl_torch/DynamicsShift-v0", shifted=True).unwrapped
    assert np.array_equal(env.mdp.reward, after.mdp().reward)


def test_wind_moves_before_the_action():
    """Wind to the right from F (0) onto R (1), then action right to G (2); blocked order would differ."""
    grid = GridWorld(("FRG",), uniform_wind(0.0, 1.0))
    p = grid.mdp().transition.toarray().reshape(3, 4, 3)
    np.testing.assert_allclose(p[0, 2], [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(p[0, 0], [1, 0, 0], atol=1e-12)


def test_success_is_of_the_action_alone():
    """Where the action fails, the agent is where the wind has left it."""
    grid = GridWorld(("FRRG",), uniform_wind(0.0, 1.0), action_success_prob=0.25)
    np.testing.assert_allclose(grid.mdp().transition.toarray()[2], [0, 0.75, 0.25, 0], atol=1e-12)


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
        (dict(desc=("SF",), wind=(0.0, 1.5)), r"strengths in \[0, 1\]"),
        (dict(desc=("SF",), n_actions=6), "n_actions=6: must be 4 or 5 or 8 or 9"),
        (dict(desc=("SF",), n_actions=5, action_success_prob=(1, 1, 1, 1)), "action_success_prob.*5 of them"),
        (dict(desc=("SF",), tile_rewards={"X": 1.0}), r"tile_rewards=\['X'\]"),
        (dict(desc=("SF",), tile_rewards={"C": "much"}), "tile_rewards.C=much"),
    ],
)
def test_bad_grids_are_refused(arguments, message):
    with pytest.raises(InputError, match=message):
        GridWorld(**arguments)


@pytest.mark.parametrize(("key", "value"), [("wind_strength", 1.5), ("wind_angle", np.inf), ("trap_reward", "low")])
def test_bad_cliffs_are_refused(key, value):
    with pytest.raises(InputError, match=key):
        WindyCliffEnv(**{key: value})


def test_unknown_maps_are_refused():
    with pytest.raises(InputError, match="desc=moon: must be rows of tiles or a map: empty, four_rooms"):
        windy_frozen_lake("moon")
    with pytest.raises(InputError, match="path=None"):
        gym.make("erl_torch/TabularMDP-v0")


def test_bad_actions_are_refused():
    env = TabularEnv(WindyCliffEnv().mdp)
    env.reset(seed=0)
    with pytest.raises(ValueError, match="action=4"):
        env.step(4)
