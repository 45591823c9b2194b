"""Streams of tuples: their law, their ends, their seeds."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from helpers import random_mdp, random_policy
from scipy import stats

import erl_torch
from erl_torch import InputError, collect
from erl_torch.envs.tabular import TabularEnv
from erl_torch.envs.windy_cliff import WindyCliffEnv
from erl_torch.rng import streams

NAMES = ("s", "a", "r", "s_next", "a_next")


def chi_square(counts, p):
    """p-value of counts [n, m] against probabilities [n, m], rows given."""
    expected = p * counts.sum(1, keepdims=True)
    assert counts[p == 0].sum() == 0
    used = expected > 0
    return stats.chi2.sf(((counts - expected)[used] ** 2 / expected[used]).sum(), used.sum() - len(p))


class Unknown(TabularEnv):
    """The same environment to ``env.step``, but its model is not found."""

    def __init__(self, mdp):
        super().__init__(mdp)
        self.hidden, self.__dict__["mdp"] = mdp, mdp

    @property
    def unwrapped(self):
        return Bare()


class Bare:
    pass


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("on_prior", [True, False])
def test_law_of_the_stream(known, on_prior):
    rng = np.random.default_rng(0)
    mdp = random_mdp(rng, 4, 3)
    prior = random_policy(rng, 4, 3)
    behaviour = None if on_prior else random_policy(rng, 4, 3)
    data = collect(mdp if known else Unknown(mdp), 1000, 40, 5, behaviour, prior)
    assert len(data) == 40_000
    pairs = np.zeros((12, 4))
    np.add.at(pairs, (data.s * 3 + data.a, data.s_next), 1)
    acts, next_acts = np.zeros((4, 3)), np.zeros((4, 3))
    np.add.at(acts, (data.s, data.a), 1)
    np.add.at(next_acts, (data.s_next, data.a_next), 1)
    assert chi_square(pairs, mdp.transition.toarray()) > 1e-3
    assert chi_square(acts, prior if on_prior else behaviour) > 1e-3
    assert chi_square(next_acts, prior) > 1e-3
    assert np.array_equal(data.r, mdp.reward[data.s, data.a])
    first = np.arange(0, 40_000, 40)
    goes_on = np.setdiff1d(np.arange(1, 40_000), first)
    assert np.array_equal(data.s[goes_on], data.s_next[goes_on - 1])
    assert np.array_equal(data.a[goes_on], data.a_next[goes_on - 1]) == on_prior
    starts = np.bincount(data.s[first], minlength=4)[None]
    assert chi_square(starts, mdp.start[None]) > 1e-3


def test_blocks_do_not_show(monkeypatch):
    mdp = WindyCliffEnv().mdp
    whole = collect(mdp, 50, 100, 1)
    monkeypatch.setattr("erl_torch.experience.collect.BLOCK", 730)
    seen = []
    parts = collect(mdp, 50, 100, 1, report=seen.append)
    assert seen == [*range(730, 5000, 730), 5000]
    for name in NAMES:
        assert np.array_equal(getattr(whole, name), getattr(parts, name))


@pytest.mark.parametrize("source", [WindyCliffEnv().mdp, "FrozenLake-v1"], ids=["model", "steps"])
def test_seeds(source):
    def columns(seed):
        data = collect(gym.make(source) if isinstance(source, str) else source, 30, 50, seed)
        return [getattr(data, name).tolist() for name in NAMES]

    assert columns(3) == columns(3)
    assert columns(3) != columns(4)


def test_streams_are_independent_by_name():
    """More draws for one purpose leave the others as they were."""
    first, second = streams(0), streams(0)
    first.evaluation.random(1000)
    first.environment.random(10)
    assert first.behaviour.random() == second.behaviour.random()
    drawn = {streams(seed)._asdict()[name].random() for seed in range(3) for name in first._fields}
    assert len(drawn) == 9


def test_terminal_states_lead_to_the_start():
    """FrozenLake's holes and goal terminate: s' is the start, and no tuple begins in them."""
    env = gym.make("FrozenLake-v1", is_slippery=False)
    data = collect(env, 300, 100, 0)
    ends = [5, 7, 11, 12, 15]
    assert not np.isin(data.s, ends).any()
    assert not np.isin(data.s_next, ends).any()
    # From 14, right: the goal, its reward, and the start.
    won = (data.s == 14) & (data.a == 2)
    assert won.any()
    assert (data.r[won] == 1).all()
    assert (data.s_next[won] == 0).all()
    assert (data.r[~won] == 0).all()


def test_truncation_keeps_the_state_reached():
    env = gym.make("erl_torch/WindyCliff-v0", max_episode_steps=7)
    unknown = gym.make("FrozenLake-v1", max_episode_steps=3, desc=["SFFFFFFF", "FFFFFFFG"], is_slippery=False)
    data = collect(unknown, 40, 100, 0)
    assert len(data) == 120
    assert (data.s[::3] == 0).all()
    assert (data.s_next[2::3] != 0).any()  # truncated where it stood
    assert len(collect(env, 2, 10, 0)) == 20  # a known model is sampled by episode_length alone


def test_compiled_and_stepped_agree_on_the_cliff():
    """Both give the prior's visit frequencies of the cliff (mean reward -1.6263 a step)."""
    env = WindyCliffEnv()
    compiled, stepped = collect(env, 100, 1000, 0), collect(Unknown(env.mdp), 40, 1000, 0)
    for data in (compiled, stepped):
        episodes = data.r.reshape(-1, 1000).mean(1)
        error = episodes.std(ddof=1) / np.sqrt(len(episodes))
        assert abs(episodes.mean() + 1.6263453) < 3.5 * error < 0.04


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (dict(n_episodes=0), "n_episodes=0"),
        (dict(episode_length=0), "episode_length=0"),
        (dict(behaviour_policy=np.ones((15, 4))), "behaviour_policy"),
        (dict(prior_policy=np.ones((2, 2)) / 2), "prior_policy"),
    ],
)
def test_bad_arguments(arguments, message):
    with pytest.raises(InputError, match=message):
        collect(WindyCliffEnv(), **(dict(n_episodes=1, episode_length=10) | arguments))


def test_continuous_spaces_are_refused():
    with pytest.raises(InputError, match=r"observation_space=.*must be a finite space: Discrete"):
        erl_torch.collect(gym.make("CartPole-v1"), 1, 10)


class Clock(gym.Env):
    """State t = 0, 1, ...: action 1 terminates from state 3 on, else the clock truncates at 6; reward tells (s, a)."""

    observation_space = gym.spaces.Discrete(8)
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return 0, {}

    def step(self, action):
        reward = float(10 * self.t + action)
        self.t += 1
        return self.t, reward, bool(action and self.t > 3), self.t == 6, {}


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_vector_environments_give_real_transitions_only(mode):
    env = gym.vector.SyncVectorEnv([Clock] * 5, autoreset_mode=mode)
    data = erl_torch.collect(env, 40, 25, seed=3)
    assert len(data) == 1000
    assert np.array_equal(data.r, 10 * data.s + data.a)  # no reset counted as a step, no action mixed up
    ended = (data.a == 1) & (data.s >= 3)
    assert (data.s_next[ended] == 0).all()  # a terminal state leads straight to the start
    assert np.array_equal(data.s_next[~ended], data.s[~ended] + 1)  # a truncated one stands: state 6
    assert (data.s_next == 6).any()
    assert set(data.s) == set(range(6))
    for action in (data.a, data.a_next):
        assert abs(action.mean() - 0.5) < 4.5 * 0.5 / np.sqrt(1000)


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_vector_environments_keep_each_environments_order(mode):
    """One environment in the vector: its tuples chain up, a' is the action taken unless an episode begins."""
    env = gym.vector.SyncVectorEnv([Clock], autoreset_mode=mode)
    data = erl_torch.collect(env, 1, 300, seed=1)
    begins = (data.s_next[:-1] == 6) | ((data.a[:-1] == 1) & (data.s[:-1] >= 3))
    assert np.array_equal(data.s[1:], np.where(begins, 0, data.s_next[:-1]))
    assert np.array_equal(data.a[1:][~begins], data.a_next[:-1][~begins])
    off_prior = erl_torch.collect(env, 1, 300, seed=1, behaviour_policy=np.tile([0.9, 0.1], (8, 1)))
    assert off_prior.a.mean() < 0.2
    assert 0.4 < off_prior.a_next.mean() < 0.6


def test_vector_environments_must_tell_how_they_reset():
    env = gym.vector.SyncVectorEnv([Clock])
    env.metadata = {}
    with pytest.raises(InputError, match="autoreset_mode"):
        erl_torch.collect(env, 1, 10)


def test_vector_of_this_packages_environments():
    env = gym.make_vec("erl_torch/WindyCliff-v0", 3, vectorization_mode="sync")
    data = erl_torch.collect(env, 3, 1000, seed=0)
    one: Any = gym.make("erl_torch/WindyCliff-v0").unwrapped
    p = one.mdp.transition.toarray()
    assert (p[data.s * 4 + data.a, data.s_next] > 0).all()
