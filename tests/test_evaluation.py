"""Evaluation against closed forms and the measured oracles of the paper's cliff."""

import gymnasium as gym
import numpy as np
import oracle
import pytest
import scipy.sparse as sp
from helpers import random_mdp, random_policy

from erl_torch import TabularMDP, evaluate
from erl_torch.envs.windy_cliff import WindyCliffEnv
from erl_torch.solvers.policy import kl_per_state, objective, policy_chain, reward_per_step, stationary_distribution

CLIFF = WindyCliffEnv().mdp
UNIFORM = np.full((15, 4), 0.25)


def exact_cliff(n):
    p = CLIFF.transition.toarray().reshape(15, 4, 15)
    return oracle.biasing_iterations(p, CLIFF.reward, UNIFORM, 10.0, n)


def test_cliff_oracles():
    assert reward_per_step(CLIFF, UNIFORM, 1000) == pytest.approx(-1.6263453, abs=1e-7)
    iterates = exact_cliff(8)
    assert reward_per_step(CLIFF, iterates[0].policy, 1000) == pytest.approx(-1.3221561, abs=1e-7)
    assert objective(CLIFF, iterates[1].policy, UNIFORM, np.inf) == pytest.approx(-0.94197, abs=1e-5)
    last = iterates[-1]
    assert last.theta == pytest.approx(1.0101363366, abs=1e-9)
    assert reward_per_step(CLIFF, last.policy, 1000) == pytest.approx(-0.9559251, abs=1e-6)
    # The optimum's objective is -theta*: reward rate -.955595 less KL/beta.
    assert objective(CLIFF, last.policy, UNIFORM, 10.0) == pytest.approx(-1.0101363366, abs=1e-9)
    assert objective(CLIFF, last.policy, UNIFORM, np.inf) == pytest.approx(-0.955595, abs=1e-6)


def test_finite_horizon_is_the_sum_of_powers():
    rng = np.random.default_rng(0)
    mdp, policy = random_mdp(rng, 5, 3), random_policy(rng, 5, 3)
    chain = policy_chain(mdp, policy)
    p, r = chain.transition.toarray(), chain.reward
    by_hand = sum(mdp.start @ np.linalg.matrix_power(p, t) @ r for t in range(17)) / 17
    assert reward_per_step(mdp, policy, 17) == pytest.approx(by_hand, rel=1e-13)


@pytest.mark.parametrize("seed", range(5))
def test_stationary_distribution_is_stationary(seed):
    rng = np.random.default_rng(seed)
    p = policy_chain(random_mdp(rng, 6, 2), random_policy(rng, 6, 2)).transition
    d = stationary_distribution(p, np.eye(6)[0])
    np.testing.assert_allclose(d @ p.toarray(), d, atol=1e-14)
    assert d.sum() == pytest.approx(1, abs=1e-14)


def test_stationary_distribution_of_hard_chains():
    periodic = sp.csr_array(np.roll(np.eye(4), 1, axis=1))
    np.testing.assert_allclose(stationary_distribution(periodic, np.eye(4)[0]), 0.25)
    # 0 is transient and falls into {1} with 1/3, into the two-cycle {2, 3} with 2/3; 4 is unreachable.
    p = np.array(
        [
            [0.4, 0.2, 0.4, 0, 0],
            [0, 1, 0, 0, 0],
            [0, 0, 0, 1, 0],
            [0, 0, 1, 0, 0],
            [1, 0, 0, 0, 0],
        ]
    )
    d = stationary_distribution(sp.csr_array(p), np.eye(5)[0])
    np.testing.assert_allclose(d, [0, 1 / 3, 1 / 3, 1 / 3, 0], atol=1e-14)
    # Two states by odds: p01 = .1, p10 = .3.
    two = stationary_distribution(sp.csr_array([[0.9, 0.1], [0.3, 0.7]]), np.array([1.0, 0.0]))
    np.testing.assert_allclose(two, [0.75, 0.25], atol=1e-15)


def test_kl():
    policy, prior = np.array([[1.0, 0.0], [0.5, 0.5], [0.9, 0.1]]), np.array([[0.5, 0.5], [0.5, 0.5], [1.0, 0.0]])
    assert kl_per_state(policy, prior).tolist() == [np.log(2), 0.0, np.inf]


def test_sampled_agrees_with_exact():
    rng = np.random.default_rng(0)
    policy = exact_cliff(1)[0].policy
    means = np.array([evaluate(CLIFF, policy, 10.0, rng, 10, 1000).mean_return for _ in range(20)]) / 1000
    assert abs(means.mean() + 1.3221561) < 3.5 * means.std(ddof=1) / np.sqrt(20) < 0.01  # as of test_cliff_oracles
    hidden = gym.make("FrozenLake-v1", is_slippery=True)
    # FrozenLake under the uniform policy reaches the goal in 1.4% of the episodes.
    sampled = evaluate(hidden, np.full((16, 4), 0.25), 10.0, rng, 3000, 100)
    assert sampled.mean_return == pytest.approx(0.014, abs=0.008)
    assert sampled.objective == sampled.reward_per_step  # the prior itself: no KL


def test_sampled_objective_takes_kl_off():
    env = gym.make("FrozenLake-v1")
    policy = np.tile([0.7, 0.1, 0.1, 0.1], (16, 1))
    result = evaluate(env, policy, 2.0, np.random.default_rng(0), 50, 50)
    kl = kl_per_state(policy, np.full((16, 4), 0.25))[0]
    assert result.objective == pytest.approx(result.reward_per_step - kl / 2, abs=1e-12)


def test_single_state():
    mdp = TabularMDP([[1.0], [1.0]], [[-1.0, -3.0]])
    assert objective(mdp, np.array([[0.5, 0.5]]), np.array([[0.5, 0.5]]), 1.0) == -2.0
    assert reward_per_step(mdp, np.array([[0.25, 0.75]]), 10) == -2.5
