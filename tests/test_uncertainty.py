"""Errors on theta and on a policy's value: coverage, derivatives, and what they depend on."""

import numpy as np
import pytest
from conftest import random_mdp, random_stream

from erl_torch import (
    Estimate,
    InputError,
    TabularMDP,
    Transitions,
    bootstrap_theta,
    collect,
    empirical_mdp,
    policy_uncertainty,
    solve_soft_bellman,
    theta_uncertainty,
)
from erl_torch.envs.windy_cliff import WindyCliffEnv
from erl_torch.evaluation import objective

CLIFF = WindyCliffEnv().mdp
UNIFORM = np.full((15, 4), 0.25)


def noisy(data, rng, scale):
    return Transitions(data.s, data.a, data.r + scale * rng.standard_normal(len(data)), data.s_next, data.a_next)


@pytest.mark.parametrize(("beta", "noise"), [(10.0, 0.0), (2.0, 2.0)])
def test_interval_covers(beta, noise):
    """100 datasets of 200,000 tuples: the number of hits of a 95% interval is binomial, 0.88..0.99 in 98.5% of all."""
    theta = solve_soft_bellman(CLIFF, beta).theta
    z = []
    for seed in range(100):
        data = noisy(collect(CLIFF, 200, 1000, seed), np.random.default_rng(seed), noise)
        estimate = theta_uncertainty(empirical_mdp(data, 15, 4), beta)
        z.append((estimate.value - theta) / estimate.standard_error)
    assert 0.88 <= np.mean(np.abs(z) < 1.96) <= 0.99
    assert np.std(z) == pytest.approx(1, abs=0.2)  # three standard errors


def test_policy_value_covers_and_matches_its_spread():
    policy = np.random.default_rng(0).dirichlet(np.full(4, 3.0), size=15)
    truth = objective(CLIFF, policy, UNIFORM, 3.0)
    estimates = [policy_uncertainty(empirical_mdp(collect(CLIFF, 300, 1000, s), 15, 4), policy, 3.0) for s in range(60)]
    values, errors = np.array([(e.value, e.standard_error) for e in estimates]).T
    assert values.mean() == pytest.approx(truth, abs=4 * values.std() / np.sqrt(60))
    assert errors.mean() == pytest.approx(values.std(), rel=0.3)


def test_variance_is_the_derivative_of_the_value_with_the_rows():
    """Var J = sum_k Var(row k): each row's part by differences of J under another reward and another successor."""
    rng = np.random.default_rng(1)
    mdp, policy = random_mdp(rng, 3, 2), rng.dirichlet(np.ones(2), size=3)
    prior = np.full((3, 2), 0.5)
    data = noisy(random_stream(rng, mdp, 400), rng, 0.5)
    model = empirical_mdp(data, 3, 2)
    estimate = policy_uncertainty(model, policy, 2.0)

    def value(p, r):
        return objective(TabularMDP(p, r), policy, prior, 2.0)

    p, r = model.transition.toarray(), model.reward
    assert estimate.value == pytest.approx(value(p, r), abs=1e-12)
    eps = 1e-6
    for k in range(6):
        here = data.s * 2 + data.a == k
        influence = []  # dJ of one tuple at (s', r): move the row and the reward a little towards it
        for s_next, reward in zip(data.s_next[here], data.r[here], strict=True):
            q, x = p.copy(), r.copy()
            q[k] = (1 - eps) * q[k] + eps * np.eye(3)[s_next]
            x.flat[k] = (1 - eps) * x.flat[k] + eps * reward
            influence.append((value(q, x) - estimate.value) / eps)
        expected = np.var(influence, ddof=1) / here.sum()
        assert estimate.variance.flat[k] == pytest.approx(expected, rel=1e-3)


def test_rewards_that_go_with_the_successor_count_once():
    """Reward -1 at s'=1 and +1 at s'=0, from either state: r and V(s') cancel or add, their sum counts."""
    rng = np.random.default_rng(2)
    s = rng.integers(0, 2, 4000)
    s_next = rng.integers(0, 2, 4000)
    reward = np.where(s_next == 0, 1.0, -1.0) + np.where(s == 0, -1.0, 1.0)  # telescopes: J is 0, whatever the rows
    data = Transitions(s, np.zeros(4000, int), reward, s_next, np.zeros(4000, int))
    estimate = theta_uncertainty(empirical_mdp(data, 2, 1), 1.0)
    assert estimate.value == pytest.approx(0, abs=1e-12)
    assert estimate.standard_error < 1e-8


def test_one_more_sample_helps_where_it_says():
    model = empirical_mdp(collect(CLIFF, 100, 1000, 3), 15, 4)
    estimate = theta_uncertainty(model, 10.0)
    ranking = estimate.next_samples(60)
    drops = [drop for _, _, drop in ranking]
    assert drops == sorted(drops, reverse=True)
    s, a, drop = ranking[0]
    n = model.visits[s, a]
    assert drop == pytest.approx(estimate.variance[s, a] - estimate.variance[s, a] * n / (n + 1))
    assert len({(s, a) for s, a, _ in ranking}) == 60


def test_bootstrap_agrees_with_the_plug_in_and_with_itself():
    data = noisy(collect(CLIFF, 300, 1000, 4), np.random.default_rng(4), 1.0)
    model = empirical_mdp(data, 15, 4)
    plug_in, boot = theta_uncertainty(model, 5.0), bootstrap_theta(model, 5.0, n_resamples=100, seed=1)
    assert boot.value == pytest.approx(plug_in.value, abs=1e-9)
    assert boot.standard_error == pytest.approx(plug_in.standard_error, rel=0.25)
    low, high = boot.interval()
    assert low < boot.value < high
    assert np.array_equal(boot.samples, bootstrap_theta(model, 5.0, n_resamples=100, seed=1).samples)


def test_a_pair_seen_once_is_given_the_largest_variance():
    rng = np.random.default_rng(5)
    data = random_stream(rng, random_mdp(rng, 3, 2), 300)
    first = np.flatnonzero((data.s == 0) & (data.a == 0))
    keep = np.ones(300, bool)
    keep[first[1:]] = False
    data = Transitions(*(getattr(data, name)[keep] for name in ("s", "a", "r", "s_next", "a_next")))
    estimate = theta_uncertainty(empirical_mdp(data, 3, 2), 1.0)
    assert estimate.visits[0, 0] == 1
    assert estimate.variance[0, 0] == estimate.variance.max() > 0


def test_a_policy_off_the_data_is_refused():
    data = Transitions(np.zeros(5, int), np.zeros(5, int), np.zeros(5), np.zeros(5, int), np.zeros(5, int))
    with pytest.raises(InputError, match=r"policy\[0, 1\]"):
        policy_uncertainty(empirical_mdp(data, 1, 2), np.array([[0.5, 0.5]]), 1.0)


def test_as_text():
    assert str(Estimate("theta", 1.01184, 0.0009 / 1.96)) == "theta = 1.0118 +- 0.0009"
    assert str(Estimate("theta", 1.01184, 0.00164 / 1.96)) == "theta = 1.0118 +- 0.0016"
    assert str(Estimate("J", -12.3, 2.0)) == "J = -12 +- 4"
    assert str(Estimate("J", 0.5, 0.0)) == "J = 0.5000 +- 0.0000"
    assert Estimate("J", 0.0, 1.0).interval(0.6827) == pytest.approx((-1, 1), abs=1e-4)
    with pytest.raises(InputError, match="level"):
        Estimate("J", 0.0, 1.0).interval(1.0)
