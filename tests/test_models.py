"""Models read from Gymnasium's tables, with both readings of an episode's end."""

import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from helpers import random_mdp

import erl_torch
from erl_torch import InputError, MeanRewardWarning, TabularMDP, tabular_mdp
from erl_torch.envs.tabular import TabularEnv
from erl_torch.mdp.from_gymnasium import known_mdp

TOYS = ["FrozenLake-v1", "CliffWalking-v1", "Taxi-v4"]


def quiet(env, *args, **kwargs):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MeanRewardWarning)
        return tabular_mdp(env, *args, **kwargs)


class Table(gym.Env):
    """A third party's environment: P, a start distribution under an older name."""

    def __init__(self, table, start=None, n_states=2, n_actions=1):
        self.observation_space = gym.spaces.Discrete(n_states)
        self.action_space = gym.spaces.Discrete(n_actions)
        self.P = table
        if start is not None:
            self.isd = start


@pytest.mark.parametrize("env_id", TOYS)
def test_restart_against_a_loop_over_P(env_id):
    env: Any = gym.make(env_id)
    mdp = quiet(env)
    start = env.unwrapped.initial_state_distrib
    p = np.zeros((mdp.n_states, mdp.n_actions, mdp.n_states))
    r = np.zeros((mdp.n_states, mdp.n_actions))
    for s, actions in env.unwrapped.P.items():
        for a, outcomes in actions.items():
            for probability, to, reward, terminated in outcomes:
                p[s, a] += probability * (start if terminated else np.eye(mdp.n_states)[to])
                r[s, a] += probability * reward
    np.testing.assert_allclose(mdp.transition.toarray(), p.reshape(-1, mdp.n_states), atol=1e-15)
    np.testing.assert_allclose(mdp.reward, r, atol=1e-12)
    np.testing.assert_allclose(mdp.start, start)


@pytest.mark.parametrize("env_id", TOYS)
def test_restart_has_the_law_of_episodes(env_id):
    """Model and env.step agree: mean reward and the share of each state in a stream, under the prior (fixed seed)."""
    env: Any = gym.make(env_id)
    model = erl_torch.collect(quiet(env), 400, 100, seed=0)
    steps = erl_torch.collect(env, 400, 100, seed=1)
    n = env.observation_space.n

    def per_episode(data, values):
        """Mean and standard error over blocks; tuples are correlated."""
        blocks = np.array([block.mean() for block in np.array_split(values, 100)])
        return blocks.mean(), blocks.std(ddof=1) / 10

    for values in (lambda d: d.r, lambda d: d.s < n / 2, lambda d: d.s_next % 7 == 0):
        (mean, error), (other, other_error) = (per_episode(d, values(d)) for d in (model, steps))
        assert abs(mean - other) < 4.5 * np.hypot(error, other_error)


@pytest.mark.parametrize(("env_id", "terminal"), [("FrozenLake-v1", [5, 7, 11, 12, 15]), ("CliffWalking-v1", [47])])
def test_absorbed_states_are_never_left_and_pay_nothing(env_id, terminal):
    mdp = quiet(gym.make(env_id), on_end="absorb")
    p = mdp.transition.toarray().reshape(mdp.n_states, mdp.n_actions, mdp.n_states)
    for s in range(mdp.n_states):
        assert (p[s, :, s] == 1).all() == (s in terminal)
    assert not mdp.reward[terminal].any()
    everywhere = quiet(gym.make(env_id))
    others = np.setdiff1d(np.arange(mdp.n_states), terminal)
    assert np.array_equal(mdp.reward[others], everywhere.reward[others])


def test_ends_that_depend_on_the_way_cannot_be_absorbed():
    table = {0: {0: [(0.5, 1, 0.0, True), (0.5, 1, 0.0, False)]}, 1: {0: [(1.0, 0, 1.0, False)]}}
    with pytest.raises(InputError, match="on_end=absorb: must be restart: state 1 is entered with and without"):
        quiet(Table(table, [1.0, 0.0]), "absorb")
    assert quiet(Table(table, [1.0, 0.0])).transition.toarray().tolist() == [[0.5, 0.5], [1, 0]]


def test_absorbing_lake_keeps_what_its_ends_pay():
    env = gym.make("erl_torch/WindyFrozenLake-v0", desc=["SHG"], cyclic=False)
    mdp = tabular_mdp(env, "absorb")
    assert mdp.transition.toarray()[4:].tolist() == [[0, 1, 0]] * 4 + [[0, 0, 1]] * 4
    assert mdp.reward[:, 0].tolist() == [-1, -2, 0]
    assert tabular_mdp(env).transition.toarray()[4:].tolist() == [[1, 0, 0]] * 8


def test_rewards_that_depend_on_s_next_are_reported():
    """FrozenLake: 1 with probability 1/3 beside the goal: mean 1/3, standard deviation sqrt(2)/3."""
    with pytest.warns(MeanRewardWarning, match=r"for 3 of 64 pairs \(s, a\), with standard deviations up to 0.471"):
        mdp = tabular_mdp(gym.make("FrozenLake-v1"))
    assert sorted(set(np.round(mdp.reward.ravel(), 12))) == [0, pytest.approx(1 / 3)]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        tabular_mdp(gym.make("FrozenLake-v1", is_slippery=False))


def test_repeated_entries_are_summed():
    table = {0: {0: [(0.25, 1, 4.0, False), (0.25, 1, 0.0, False), (0.5, 0, 1.0, True)]}, 1: {0: [(1.0, 0, 2, False)]}}
    mdp = quiet(Table(table), start=[0.0, 1.0])
    assert mdp.transition.toarray().tolist() == [[0, 1], [1, 0]]  # the end leads to the start, state 1
    assert mdp.reward.tolist() == [[1.5], [2.0]]
    assert quiet(Table(table, start=np.array([0.5, 0.5]))).transition.toarray().tolist() == [[0.25, 0.75], [1, 0]]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: gym.make("Taxi-v4", fickle_passenger=True), "fickle_passenger=True: must be False"),
        (lambda: gym.make("CartPole-v1"), "observation_space=Box"),
        (lambda: gym.make("Blackjack-v1"), "one that has its model as P"),
        (lambda: gym.wrappers.TransformReward(gym.make("Taxi-v4"), float), "without TransformReward"),
        (lambda: Table([{0: [(1.0, 0, 0.0, False)]}]), "P=1 items: must be a dict, or a list of 2"),
        (
            lambda: Table({0: {0: [(1.0, 2, 0.0, False)]}, 1: {0: [(1.0, 0, 0.0, False)]}}, [1, 0]),
            r"P\[0\]\[0\]: s'=2: must be in Discrete\(2\)",
        ),
        (lambda: Table({0: {0: [(0.9, 1, 0.0, False)]}, 1: {0: [(1.0, 0, 0.0, False)]}}, [1, 0]), "transition row 0"),
        (lambda: Table({0: {0: [(1.0, 1, 0.0, False)]}, 1: {0: [(1.0, 0, 0.0, False)]}}), "start=None: must be given"),
    ],
)
def test_what_has_no_model_is_refused(make, message):
    with pytest.raises(InputError, match=message):
        tabular_mdp(make())


def test_environments_without_a_table_are_refused():
    env = Table(None)
    with pytest.raises(InputError, match="one that has its model as P or mdp"):
        tabular_mdp(env)
    with pytest.raises(InputError, match="on_end=stop: must be restart or absorb"):
        tabular_mdp(env, on_end="stop")


def test_a_wrapper_that_changes_the_process_hides_the_model():
    env: Any = gym.make("erl_torch/WindyCliff-v0")
    assert known_mdp(env) is env.unwrapped.mdp
    assert known_mdp(gym.wrappers.RecordEpisodeStatistics(env)) is env.unwrapped.mdp
    doubled = gym.wrappers.TransformReward(env, lambda r: 2 * float(r))
    assert known_mdp(doubled) is None
    assert set(erl_torch.collect(doubled, 1, 200).r) == {-10.0, -2.0}  # stepped through, so what the user wrapped


def test_own_model_with_another_start():
    mdp = random_mdp(np.random.default_rng(0), 3, 2)
    start = np.array([0, 0, 1.0])
    other = tabular_mdp(TabularEnv(mdp), start=start)
    assert np.array_equal(other.start, start)
    assert (other.transition != mdp.transition).nnz == 0


def test_mdp_files(tmp_path):
    mdp = random_mdp(np.random.default_rng(1), 4, 3)
    again = TabularMDP.load(mdp.save(tmp_path / "mdp.npz"))
    assert (again.transition != mdp.transition).nnz == 0
    assert np.array_equal(again.reward, mdp.reward)
    assert np.array_equal(again.start, mdp.start)
    dense = mdp.transition.toarray().reshape(4, 3, 4)
    np.savez(tmp_path / "dense.npz", transition=dense, reward=mdp.reward)
    loaded = TabularMDP.load(tmp_path / "dense.npz")
    assert (loaded.transition != mdp.transition).nnz == 0
    assert loaded.start.tolist() == [0.25] * 4


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (dict(reward=None), "an npz with reward and transition"),
        (dict(transition_data=None), "an npz with reward and transition"),
        (dict(transition_indices=np.full(48, 9)), "CSR parts"),
        (dict(transition_indptr=np.arange(5)), "CSR parts"),
        (dict(reward=np.zeros(3)), r"of shape \[n_states, n_actions\]"),
        (dict(reward=np.full((4, 3), np.nan)), r"reward\[0, 0\]=nan"),
        (dict(transition_data=np.full(48, 0.3)), "row 0"),
    ],
)
def test_damaged_mdp_files_are_refused(tmp_path, change, message):
    path = random_mdp(np.random.default_rng(1), 4, 3).save(tmp_path / "mdp.npz")
    with np.load(path) as archive:
        arrays = {name: value for name, value in ({**archive} | change).items() if value is not None}
    np.savez(path, **arrays)
    with pytest.raises(InputError, match=message) as error:
        TabularMDP.load(path)
    assert str(path) in str(error.value)
