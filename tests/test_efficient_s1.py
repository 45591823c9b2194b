"""EfficientS1: all options off, it is Algorithm S1; all on, it is certainty equivalence; and it never breaks."""

import copy
from dataclasses import fields, replace
from fractions import Fraction
from itertools import pairwise

import hypothesis
import numpy as np
import oracle
import pytest
import torch
from helpers import maze, overshooting, problems, random_mdp, random_policy, random_stream
from hypothesis import strategies as st
from scipy.special import logsumexp

import erl_torch
from erl_torch import (
    AlgorithmS1,
    CertaintyEquivalence,
    EfficientS1,
    InputError,
    ListedS1,
    NonFiniteError,
    Status,
    Transitions,
    collect,
    empirical_mdp,
    solve_soft_bellman,
)
from erl_torch.envs.windy_cliff import WindyCliffEnv
from erl_torch.experience.transitions import COLUMNS
from erl_torch.learners.efficient_s1 import kernels
from erl_torch.learners.efficient_s1.algorithm import SWITCHES, certificate, swept
from erl_torch.learners.s1 import listing
from erl_torch.solvers.policy import kl_per_state, objective
from erl_torch.solvers.problem import BellmanProblem

CLIFF = WindyCliffEnv().mdp
UNIFORM = np.full((15, 4), 0.25)
STREAM = collect(CLIFF, 300, 1000, 2)


def with_noise(data, rng, scale=1.0):
    return Transitions(data.s, data.a, data.r + scale * rng.standard_normal(len(data)), data.s_next, data.a_next)


# -- off: the paper ---------------------------------------------------------------------------------------


@pytest.mark.slow
@hypothesis.settings(max_examples=30)
@hypothesis.given(
    problem=problems(),
    beta=st.floats(0.1, 8.0),
    lr_u=st.floats(1e-3, 0.5),
    lr_psi=st.floats(0.01, 1.0),
    noisy=st.booleans(),
    log_domain=st.sampled_from(("off", "on", "auto")),
)
def test_with_every_option_off_it_is_algorithm_s1(problem, beta, lr_u, lr_psi, noisy, log_domain):
    rng, mdp, prior = problem
    data = random_stream(rng, mdp, 300)
    data = with_noise(data, rng, 0.1) if noisy else data
    options = dict(beta=beta, lr_u=lr_u, lr_psi=lr_psi, prior_policy=prior, n_epochs=2, n_bias=3)
    paper = ListedS1(**options).fit(data, *mdp.reward.shape)
    ours = EfficientS1.published(**options, log_domain=log_domain).fit(data, *mdp.reward.shape)
    assert ours.status is paper.status
    assert ours.theta == pytest.approx(paper.theta, rel=1e-9, abs=1e-9)
    assert ours.rho == pytest.approx(paper.rho, rel=1e-9)
    for name in ("policy", "u", "psi"):
        torch.testing.assert_close(getattr(ours, name), getattr(paper, name), rtol=1e-9, atol=0)
    torch.testing.assert_close(ours.reward_bias, paper.reward_bias, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("log_domain", ["off", "on"])
@pytest.mark.parametrize("largest_reward", [-0.02, 0.0, 0.2])
def test_rho_is_clipped_at_its_bound(log_domain, largest_reward):
    data, steps = overshooting(largest_reward), dict(beta=5.0, lr_u=0.05, lr_rho=0.1)
    bound = max(1.0, np.exp(5.0 * largest_reward))
    assert oracle.lines_9_to_11(data, (2, 1), **steps, rho_max=bound).largest > 1.05 * bound
    found = EfficientS1.published(n_epochs=1, n_bias=1, log_domain=log_domain, **steps).fit(data, 2, 1)
    assert found.rho == pytest.approx(bound, rel=1e-14)


def test_a_psi_phase_cut_short_is_remembered(authors_tuples):
    options = dict(n_epochs=1, n_bias=8, max_psi_epochs=60)
    errors = ListedS1(**options).fit(authors_tuples, 15, 4).history["psi_error"]
    assert errors[-1] < 1e-4 < errors.max()
    assert EfficientS1.published(**options).fit(authors_tuples, 15, 4).status is Status.PSI_LIMIT


# -- the compiled loops and their twins -------------------------------------------------------------------


@pytest.mark.slow
@hypothesis.settings(max_examples=40)
@hypothesis.given(
    problem=problems(),
    beta=st.floats(0.1, 8.0),
    expected=st.booleans(),
    noisy=st.booleans(),
    average=st.booleans(),
    n_steps=st.sampled_from((1, 20)),
    lr_rho=st.floats(1e-4, 0.3),
)
def test_kernels_agree_with_the_direct_form(problem, beta, expected, noisy, average, n_steps, lr_rho):
    rng, mdp, prior = problem
    shape, n_actions = mdp.reward.shape, mdp.n_actions
    data = random_stream(rng, mdp, 200)
    data = with_noise(data, rng, 0.1) if noisy else data
    psi, u = rng.uniform(0.5, 2, shape[0]), rng.uniform(0.5, 2, shape)
    mean_psi, mean_log_psi = rng.uniform(0.5, 2, shape), rng.uniform(-2, -1, shape)
    delta = (np.log(mean_psi) - mean_log_psi) / beta
    steps, rho_max = np.linspace(1, 0.1, n_steps + 1)[1:], 5.0
    visits, total, u_direct = np.zeros(shape, int), np.zeros(shape), u.copy()
    rho = listing.efficient_epoch(
        data, psi, mean_psi, delta, delta.max(), u_direct, 0.7, beta=beta, steps=steps, visits=visits, lr_rho=lr_rho,
        rho_max=rho_max, weight=prior, expected=expected, reward=None if noisy else mdp.reward, total=total,
    )  # fmt: skip
    log_g = beta * ((0 if noisy else mdp.reward) - delta.max()) - mean_log_psi + np.log(psi)[:, None]
    pair = data.s * np.int32(n_actions) + data.a
    after = data.s_next if expected else data.s_next * np.int32(n_actions) + data.a_next
    log_factor = beta * data.r if noisy else np.zeros(1)
    for kernel, number, back in (
        (kernels.gauge_epoch, np.exp, np.asarray),
        (kernels.log_gauge_epoch, np.asarray, np.exp),
    ):
        z, sums = number(np.log(u * psi[:, None]).ravel()), number(np.full(u.size, -np.inf))
        counts = np.zeros(u.size, np.int64)
        found, healthy = kernel(
            pair, after, number(log_factor), noisy, number(log_g.ravel()), z, sums, average,
            number(np.log(prior.ravel())), n_actions, steps, counts, float(number(np.log(0.7))),
            lr_rho, float(number(np.log(rho_max))), expected, 64, 0, len(data),
        )  # fmt: skip
        assert healthy
        assert back(found) == pytest.approx(rho, rel=1e-11)
        direct = u_direct * psi[:, None]
        np.testing.assert_allclose(back(z) / back(z).max(), direct.ravel() / direct.max(), rtol=1e-11)
        np.testing.assert_array_equal(counts, visits.ravel())
        if average:
            np.testing.assert_allclose(back(sums) / back(z).max(), total.ravel() / direct.max(), rtol=1e-11)


@pytest.mark.slow
@hypothesis.settings(max_examples=30)
@hypothesis.given(problem=problems(), beta=st.floats(0.1, 5.0))
def test_a_phase_of_the_online_mode_agrees_with_its_direct_form(problem, beta):
    """Both halves of a phase, the first of a stream: pairs are met for the first time in both."""
    rng, mdp, prior = problem
    shape, n_actions = mdp.reward.shape, mdp.n_actions
    data = with_noise(random_stream(rng, mdp, 300), rng, 0.1)
    value, steps = rng.uniform(-1, 1, shape[0]), np.linspace(1, 0.1, 20)
    z = rng.uniform(0.5, 2, shape)
    log_z, sums, weight = np.log(z), np.zeros((3, *shape)), prior.copy()
    visits, fresh = np.zeros(z.size, np.int64), np.zeros(z.size, np.int64)
    reward, squares, mean_value = np.zeros(z.size), np.zeros(z.size), np.zeros(z.size)
    log_rho, log_rho_max = -0.3, 0.0
    for half in (slice(150), slice(150, None)):
        part = data.where(half)
        log_rho, log_rho_max = kernels.online_phase(
            part.s * np.int32(n_actions) + part.a, part.s_next, part.r, beta, value, visits, fresh, reward, squares,
            mean_value, log_z.reshape(-1), np.log(prior.ravel()), n_actions, steps, log_rho, 0.02, log_rho_max,
        )  # fmt: skip
    rho, rho_max = listing.online_phase(
        data, value, sums, z, weight, np.exp(-0.3), beta=beta, prior=prior, steps=steps, lr_rho=0.02, rho_max=1.0
    )
    assert np.exp([log_rho, log_rho_max]) == pytest.approx([rho, rho_max], rel=1e-10)
    np.testing.assert_allclose(np.exp(log_z), z, rtol=1e-10)
    seen = visits > 0
    np.testing.assert_array_equal(visits, sums[0].ravel())
    np.testing.assert_allclose(mean_value[seen], (sums[1].ravel() / visits.clip(1))[seen], rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(reward[seen], (sums[2].ravel() / visits.clip(1))[seen], rtol=1e-10)
    for k in np.flatnonzero(seen):
        own = data.r[data.s * n_actions + data.a == k]
        assert squares[k] == pytest.approx(((own - own.mean()) ** 2).sum(), rel=1e-9, abs=1e-12)


# -- on: the statistical limit ----------------------------------------------------------------------------


@hypothesis.settings(max_examples=40)
@hypothesis.given(
    problem=problems(),
    beta=st.floats(0.1, 20.0),
    switches=st.fixed_dictionaries({name: st.booleans() for name in ("clocks", "polyak")}),
    log_domain=st.sampled_from(("auto", "on")),
)
def test_reaches_certainty_equivalence(problem, beta, switches, log_domain):
    """Sample means, expected backup and mean rewards make its fixed point; the rest is speed. Rewards are noisy."""
    rng, mdp, prior = problem
    data = with_noise(random_stream(rng, mdp, 1500), rng, 0.3)
    limit = CertaintyEquivalence(beta, prior_policy=prior).fit(data, *mdp.reward.shape)
    options = dict(prior_policy=prior, lr_u=0.05, lr_rho=0.01, n_epochs=8, n_bias=60, tol=1e-9)
    found = EfficientS1(beta, **options, **switches, log_domain=log_domain).fit(data, *mdp.reward.shape)
    assert found.status is Status.CONVERGED
    assert found.history["empirical_width"][-1] < 1e-8
    # The loss is KL/beta, and its bound 1e-8; rarely visited states weigh little in it.
    policy, best = found.policy.numpy(), limit.policy.numpy()
    share = empirical_mdp(data, *mdp.reward.shape).problem(beta, prior)
    assert float(kl_per_state(policy, best)[share.problem.states].max()) < 1e-5
    assert found.theta == pytest.approx(limit.theta, abs=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("n_epochs", [3, 15])
def test_windy_cliff_loses_what_certainty_equivalence_loses(n_epochs):
    exact = solve_soft_bellman(CLIFF, 10.0)
    data = collect(CLIFF, 500, 1000, 1)

    def loss(solution):
        kl = kl_per_state(exact.policy.numpy(), solution.policy.numpy()).mean()
        return np.array([-exact.theta - objective(CLIFF, solution.policy.numpy(), UNIFORM, 10.0), kl])

    ours = loss(EfficientS1(n_epochs=n_epochs, n_bias=90 // n_epochs).fit(data, 15, 4))
    limit = loss(CertaintyEquivalence().fit(data, 15, 4))
    assert (ours < 1.01 * limit).all()
    assert (loss(AlgorithmS1().fit(data, 15, 4)) > 20 * limit).all()


@pytest.mark.parametrize("beta", [0.1, 200.0, 5000.0])
def test_any_temperature(beta):
    """beta |r| up to 25,000."""
    data = STREAM.first(60_000)
    found = EfficientS1(beta).fit(data, 15, 4)
    limit = CertaintyEquivalence(beta).fit(data, 15, 4)
    gap = objective(CLIFF, limit.policy.numpy(), UNIFORM, beta) - objective(CLIFF, found.policy.numpy(), UNIFORM, beta)
    assert abs(gap) < 1e-8
    assert found.theta == pytest.approx(limit.theta, abs=1e-6)  # its tol is 1e-7 of the range of rewards


@pytest.mark.parametrize("kind", ["mixture", "poor"])
def test_any_behaviour_policy_with_support(kind):
    best = solve_soft_bellman(CLIFF, 10.0).policy.numpy()
    behaviour = 0.5 * best + 0.5 * UNIFORM
    if kind == "poor":
        behaviour = 1 / np.maximum(best, 0.02)
        behaviour /= behaviour.sum(1, keepdims=True)
    data = collect(CLIFF, 100, 1000, 2, behaviour)
    found, limit = EfficientS1().fit(data, 15, 4), CertaintyEquivalence().fit(data, 15, 4)
    np.testing.assert_allclose(found.policy, limit.policy, atol=1e-3)
    # Line 10's own backup needs a' of the prior: here with an a' of the behaviour it goes astray.
    data = Transitions(data.s, data.a, data.r, data.s_next, np.append(data.a[1:], 0))
    assert torch.equal(EfficientS1().fit(data, 15, 4).policy, found.policy)
    sampled = EfficientS1(expected_backup=False).fit(data, 15, 4)
    assert np.abs(sampled.policy.numpy() - limit.policy.numpy()).max() > 0.1


def test_noise_in_the_rewards_moves_published_s1_but_not_the_mean():
    """Variance 4 at beta 1: <exp(beta r)> is exp(2) times too large, theta 2 too low."""
    data = with_noise(STREAM, np.random.default_rng(0), 2.0)
    theta = solve_soft_bellman(CLIFF, 1.0).theta
    assert EfficientS1(1.0).fit(data, 15, 4).theta == pytest.approx(theta, abs=0.05)
    assert EfficientS1(1.0, mean_reward=False).fit(data, 15, 4).theta < theta - 1


def test_slow_maze_is_certified():
    """A 10x10 maze under strong wind, where biasing iterations mix slowly."""
    mdp, _ = maze(1)
    data = collect(mdp, 200, 1000, 1)
    shape = mdp.reward.shape
    prior = np.full(shape, 0.25)
    found, limit = EfficientS1(5.0).fit(data, *shape), CertaintyEquivalence(5.0).fit(data, *shape)
    loss = [-solve_soft_bellman(mdp, 5.0).theta - objective(mdp, f.policy.numpy(), prior, 5.0) for f in (found, limit)]
    assert loss[0] < 1.05 * loss[1]


def test_the_certificate_bounds_the_loss_in_the_empirical_model():
    model = empirical_mdp(STREAM, 15, 4)
    mdp = erl_torch.TabularMDP(model.transition, model.reward, CLIFF.start)
    best = -solve_soft_bellman(mdp, 10.0).theta
    for state in EfficientS1(n_epochs=2, n_bias=6).iterate(STREAM, 15, 4):
        loss = best - objective(mdp, state.policy.numpy(), UNIFORM, 10.0)
        assert -1e-12 <= loss <= state.empirical_width


@pytest.mark.parametrize("seed", range(5))
def test_the_width_bounds_the_loss_of_any_policy(seed):
    """At V* it is max_s KL(pi || pi*)/beta, since TV* - V* is the same in every state; anywhere it bounds g* - J."""
    rng = np.random.default_rng(seed)
    mdp, prior, beta = random_mdp(rng, 4, 3), random_policy(rng, 4, 3), 3.0
    model = empirical_mdp(random_stream(rng, mdp, 4000), 4, 3)
    assert model.visits.all()
    p = model.transition.toarray().reshape(4, 3, 4)
    last = oracle.biasing_iterations(p, model.reward, prior, beta, 25)[-1]
    part = model.problem(beta, prior)
    for sharpness in (0.0, 3.0):
        policy = prior * np.exp(sharpness * rng.standard_normal(prior.shape))
        policy /= policy.sum(1, keepdims=True)
        kl, kl_prior = ((policy * np.log(policy / other)).sum(1) for other in (last.policy, prior))
        low, high = certificate(part, np.log(last.psi), policy)
        assert high - low == pytest.approx(kl.max() / beta, abs=1e-9)
        chain = np.einsum("sa,sat->st", policy, p)
        share = np.linalg.matrix_power(chain, 10_000)[0]
        loss = -last.theta - share @ ((policy * model.reward).sum(1) - kl_prior / beta)
        for spread in (0.0, 0.1, 1.0):
            low, high = certificate(part, np.log(last.psi) + spread * rng.standard_normal(4), policy)
            assert loss <= high - low + 1e-12


def test_theta_is_carried_over_whatever_delta_becomes():
    """With no step for rho, theta = -log(rho)/beta - Delta stays at its first value, 1, in every iteration."""
    states = list(EfficientS1(lr_rho=1e-300, n_epochs=2, n_bias=6, certificate=False).iterate(STREAM, 15, 4))
    assert max(state.reward_bias_max for state in states) > 0.1
    np.testing.assert_allclose([state.theta for state in states], 1.0, rtol=1e-12)


def test_line_12_takes_the_mean_of_z_over_this_iterations_visits():
    """What the sums were before an iteration leaves no trace in it."""
    learner = EfficientS1(n_epochs=2, n_bias=3)
    stream, state = learner.prepare(STREAM, 15, 4), learner.init(15, 4)
    for _ in range(2):
        state = learner.step(state, stream)
    assert torch.isfinite(state.log_total).all()
    other = replace(state, log_total=state.log_total + torch.linspace(5.0, 50.0, 60).reshape(15, 4))
    for _ in range(2):
        state, other = learner.step(state, stream), learner.step(other, stream)
    assert torch.equal(state.policy, other.policy)


def test_steps_of_the_clocks():
    steps = EfficientS1(clock_horizon=4.0, clock_floor=0.1).steps()
    np.testing.assert_allclose(steps, [max(0.1, 4 / (4 + n)) for n in range(37)], rtol=1e-15)
    assert EfficientS1(clocks=False, lr_u=0.3).steps().tolist() == [0.3]


# -- never NaN --------------------------------------------------------------------------------------------


@pytest.mark.slow
@hypothesis.settings(max_examples=120)
@hypothesis.given(
    problem=problems(),
    beta=st.floats(-2, 4).map(lambda x: 10**x),
    reward_scale=st.sampled_from((0.0, 1.0, 100.0)),
    shift=st.sampled_from((-5.0, 0.0, 5.0)),
    switches=st.fixed_dictionaries({name: st.booleans() for name in SWITCHES}),
    steps=st.fixed_dictionaries(
        {name: st.sampled_from((1e-6, 1e-3, 0.1, 1.0)) for name in ("lr_u", "lr_rho", "lr_psi", "clock_floor")}
    ),
    clock_horizon=st.sampled_from((1.0, 10.0, 1e3)),
    unvisited=st.sampled_from(("exclude", "initial")),
    log_domain=st.sampled_from(("auto", "on")),
    n_epochs=st.integers(1, 3),
    n_tuples=st.sampled_from((30, 300)),
)
def test_no_setting_gives_nan(problem, beta, reward_scale, shift, switches, steps, n_tuples, **options):
    rng, mdp, prior = problem
    data = random_stream(rng, mdp, n_tuples)
    reward = reward_scale * data.r + shift + 0.1 * rng.standard_normal(n_tuples)
    data = Transitions(data.s, data.a, reward, data.s_next, data.a_next)
    learner = EfficientS1(beta, n_bias=4, prior_policy=prior, max_psi_epochs=50, **options, **switches, **steps)
    for state in learner.iterate(data, *mdp.reward.shape):
        check(state)
    for state in learner.online([data, data], *mdp.reward.shape):
        check(state)


def test_u_is_of_the_pairs_that_take_part():
    """One state, one of two actions tried: u has mean 1 and is 0 where nothing was tried, however small z is."""
    tuples = 400
    same = np.zeros(tuples, np.int32)
    data = Transitions(same, same, np.full(tuples, -100.0), same, same)
    for beta in (1.0, 1e2, 1e4):
        *_, state = EfficientS1(beta).online([data], 1, 2)
        assert state.u.tolist() == [[2.0, 0.0]]


def check(state):
    for name in ("log_z", "log_average", "log_psi", "log_mean_psi", "mean_log_psi", "policy", "u", "psi"):
        assert torch.isfinite(getattr(state, name)).all(), name
    torch.testing.assert_close(state.policy.sum(1), torch.ones(len(state.policy), dtype=torch.float64))
    assert np.isfinite([state.theta, state.log_rho, state.reward_bias_max]).all()
    assert state.reward_bias.min() >= 0


def test_plain_numbers_out_of_range_end_with_the_cause():
    learner = EfficientS1(2000.0, log_domain="off")
    solution = learner.fit(STREAM, 15, 4)
    assert solution.status is Status.NON_FINITE
    assert "log_domain" in solution.message
    with pytest.raises(NonFiniteError):
        list(learner.iterate(STREAM, 15, 4))


# -- interface --------------------------------------------------------------------------------------------


def test_step_by_step_is_iterate_and_leaves_the_state_alone():
    learner = EfficientS1(n_epochs=2, n_bias=3)
    stream, state = learner.prepare(STREAM, 15, 4), learner.init(15, 4)
    for expected in learner.iterate(STREAM, 15, 4):
        before = state.log_z.clone()
        after = learner.step(state, stream)
        assert torch.equal(state.log_z, before)
        state = after
        assert torch.equal(state.policy, expected.policy)
    assert (state.bias_iteration, state.epoch, state.n_tuples) == (2, 2, 6 * len(STREAM))
    assert learner.solution(state).status is Status.UNCERTIFIED  # after so few
    assert set(learner.fit(STREAM, 15, 4).history) == set(state.metrics())


def test_pairs_never_visited_have_probability_zero_and_unseen_states_the_prior():
    keep = ~((STREAM.s == 10) & (STREAM.a == 1))
    data = Transitions(*(getattr(STREAM, f.name)[keep] for f in fields(STREAM)))
    found, limit = EfficientS1().fit(data, 16, 4), CertaintyEquivalence().fit(data, 16, 4)
    assert found.policy[10, 1] == limit.policy[10, 1] == 0
    assert (found.policy[15] == 0.25).all()
    np.testing.assert_allclose(found.policy, limit.policy, atol=1e-3)
    kept = EfficientS1.published(n_epochs=1, n_bias=2).fit(data, 16, 4).policy
    assert kept[10, 1] > 0


@pytest.mark.parametrize(
    "bad",
    [
        {"beta": 0.0},
        {"clock_floor": 0.0},
        {"clock_horizon": 0.5},
        {"phase_growth": 1.0},
        {"log_domain": "yes"},
        {"unvisited": "prior"},
        {"tol": -1.0},
        {"prior_policy": np.array([[1.0, 1e-310]])},
    ],
)
def test_bad_settings_name_the_key(bad):
    with pytest.raises(InputError, match=next(iter(bad))):
        EfficientS1(**bad).init(1, 2)


def test_clocks_of_any_accepted_settings_have_steps():
    for horizon, floor in ((1e308, 1e-308), (1e308, 1.0), (1.0, 5e-324)):
        steps = EfficientS1(clock_horizon=horizon, clock_floor=floor).steps()
        assert ((steps > 0) & (steps <= 1)).all()


# -- online -----------------------------------------------------------------------------------------------

CLIFF_P, CLIFF_R = CLIFF.transition.toarray().reshape(15, 4, 15), CLIFF.reward


def cut(data, *edges):
    return [data.where(slice(i, j)) for i, j in pairwise((0, *edges, len(data)))]


def assert_same_bits(one, other, but=()):
    for f in fields(one):
        x, y = getattr(one, f.name), getattr(other, f.name)
        assert f.name in but or (np.array_equal(x, y) if np.ndim(x) else x == y), f.name


@pytest.mark.parametrize(
    ("beta", "n_tuples", "seeds"), [(10.0, 1_000_000, [49]), (5.0, 200_000, [0, 21, 49]), (20.0, 200_000, [6, 47, 90])]
)
def test_online_loses_what_certainty_equivalence_loses(beta, n_tuples, seeds):
    """Streams on which rho alone, without the certificates of phases, stays at its clip: losses .04 to .19."""
    best, _ = oracle.soft_optimum(CLIFF_P, CLIFF_R, UNIFORM, beta)
    losses = []
    for seed in seeds:
        data = collect(CLIFF, n_tuples // 1000, 1000, seed)
        *_, state = EfficientS1(beta).online([data], 15, 4)
        assert state.status is Status.CONVERGED
        p, r, visits = oracle.counted(data, 15, 4)
        assert visits.all()
        limit = oracle.soft_optimum(p, r, UNIFORM, beta)[1]
        both = (state.policy.numpy(), limit)
        losses.append([best - oracle.soft_rate(CLIFF_P, CLIFF_R, UNIFORM, beta, policy)[0] for policy in both])
        assert -state.theta == pytest.approx(best, abs=0.01)
    online, limits = np.array(losses).T
    assert (online >= 0).all()
    assert online.max() < 3 * limits.max()


@hypothesis.settings(max_examples=15)
@hypothesis.given(problem=problems(), beta=st.floats(-1, 2).map(lambda x: 10**x), noise=st.sampled_from((0.0, 0.5)))
def test_online_certificate_bounds_the_loss_in_the_model_of_the_counts(problem, beta, noise):
    rng, mdp, prior = problem
    data = with_noise(random_stream(rng, mdp, 6000), rng, noise)
    chunks = cut(data, *np.sort(rng.integers(2000, 6000, 2)))
    seen = 0
    for chunk, state in zip(
        chunks, EfficientS1(beta, prior_policy=prior).online(chunks, *mdp.reward.shape), strict=True
    ):
        seen += len(chunk)
        p, r, visits = oracle.counted(data.first(seen), *mdp.reward.shape)
        hypothesis.assume(visits.all())
        value, policy = -state.log_psi.numpy() / beta, state.policy.numpy()
        q = r + p @ value
        backed_up = logsumexp(np.log(prior) + beta * q, axis=1) / beta
        with np.errstate(divide="ignore", invalid="ignore"):
            kl = np.where(policy > 0, policy * np.log(policy / prior), 0.0).sum(1)
        followed = (policy * q).sum(1) - kl / beta
        width = (backed_up - value).max() - (followed - value).min()
        rounding = 1e-12 * (1 + np.log(1 / prior.min()) / beta)
        assert state.empirical_width == pytest.approx(width, rel=1e-6, abs=rounding)
        best, _ = oracle.soft_optimum(p, r, prior, beta)
        assert -10 * rounding <= best - oracle.soft_rate(p, r, prior, beta, policy)[0] <= width + 10 * rounding
        assert (followed - value).min() - rounding <= -state.theta <= (backed_up - value).max() + rounding
        due = max(1e-7, min(0.003, 3 * r.size / seen)) * (np.ptp(r) or np.abs(r).max() or 1.0)
        assert state.certified == (state.empirical_width <= due)
        assert (state.status is Status.CONVERGED) == state.certified == (state.message == "")


@pytest.mark.parametrize("n_tuples", [122_880, 245_760])
def test_at_the_end_of_a_phase_v_and_rho_are_within_what_is_due(n_tuples):
    """60 pairs times a power of 2; mean_value and z belong to that V."""
    for seed in (21, 49):
        data = collect(CLIFF, n_tuples // 1000 + 1, 1000, seed).first(n_tuples)
        *_, state = EfficientS1(5.0).online([data], 15, 4)
        assert state.phase_end == 2 * n_tuples
        assert state.n_replaced > 0
        p, r, visits = oracle.counted(data, 15, 4)
        assert visits.all()
        gain = logsumexp(5.0 * (r + p @ state.value), axis=1, b=UNIFORM) / 5.0 - state.value
        assert np.ptp(gain) <= np.ptp(r) * min(0.003, 180 / n_tuples) + 1e-12
        assert gain.min() - 1e-12 <= state.log_rho_in_use / 5.0 <= gain.max() + 1e-12
        np.testing.assert_allclose(state.mean_value.reshape(15, 4), p @ state.value, atol=1e-12)


@pytest.mark.parametrize("n_tuples", [200, 400, 600])
def test_online_leaves_out_what_was_never_visited(n_tuples):
    """The optimum over visited pairs, at the KL cost of the whole prior: weights that sum to less than 1."""
    data = STREAM.first(n_tuples)
    *_, state = EfficientS1().online([data], 15, 4)
    p, r, visits = oracle.counted(data, 15, 4)
    met = visits.any(1)
    assert set(data.s_next) <= set(np.flatnonzero(met))
    weight = (UNIFORM * (visits > 0))[met]
    assert (weight == 0).any()
    best, _ = oracle.soft_optimum(p[met][:, :, met], r[met], weight, 10.0)
    assert state.certified
    assert -state.theta == pytest.approx(best, abs=state.empirical_width)
    assert ((state.policy.numpy() == 0) == (met[:, None] & (visits == 0))).all()
    assert (state.policy.numpy()[~met] == 0.25).all()


def test_online_does_not_depend_on_how_the_stream_is_cut_or_resumed():
    data = with_noise(STREAM.first(30_000), np.random.default_rng(0))
    learner = EfficientS1()
    (whole,) = learner.online([data], 15, 4)
    chunks = cut(data, 1, 60, 777, 7680, 20_000)  # 60 and 7680 are ends of phases
    *_, middle, last = learner.online(chunks[:4], 15, 4)
    before = {f.name: copy.deepcopy(getattr(last, f.name)) for f in fields(last)}
    *_, resumed = learner.online(chunks[4:], 15, 4, last)
    assert whole.n_tuples == resumed.n_tuples == 30_000
    assert resumed.epoch == 6
    assert_same_bits(whole, resumed, but=("epoch",))
    assert_same_bits(last, replace(last, **before))
    assert_same_bits(learner.learn(middle, chunks[3]), last)


def test_online_counts_are_the_empirical_model():
    data = with_noise(STREAM.first(20_000), np.random.default_rng(0))
    *_, state = EfficientS1().online(cut(data, 3000), 15, 4)
    p, r, visits = oracle.counted(data, 15, 4)
    np.testing.assert_array_equal(state.model.visits, visits)
    np.testing.assert_allclose(state.model.transition.toarray().reshape(p.shape), p, rtol=1e-15)
    np.testing.assert_allclose(state.model.reward, r, rtol=1e-12, atol=1e-14)
    for s, a in np.argwhere(visits > 1):
        own = data.r[(data.s == s) & (data.a == a)]
        assert state.model.reward_variance[s, a] == pytest.approx(own.var(ddof=1), rel=1e-10)
    s, a, t = 0, 0, data.s_next[(data.s == 0) & (data.a == 0)][0]
    place = state.model.transition.indices[: state.model.transition.indptr[1]].tolist().index(t)
    mean = data.r[(data.s == s) & (data.a == a) & (data.s_next == t)].mean()
    assert state.model.reward_given_next[place] == pytest.approx(mean, rel=1e-12)


def test_online_state_is_no_success_where_its_certificate_is_wide():
    """A corridor of 40 places, prior to the left: value iteration takes thousands of sweeps, a state is given 32."""
    p, place = np.zeros((40, 2, 40)), np.arange(40)
    for a, step in enumerate((-1, 1)):
        p[place, a, (place + step).clip(0, 39)] += 0.9
        p[place, a, (place - step).clip(0, 39)] += 0.1
    r = -np.repeat((place < 39).astype(float)[:, None], 2, axis=1)
    prior = np.tile([0.55, 0.45], (40, 1))
    data = collect(erl_torch.TabularMDP(p, r), 1, 30_000, 1)
    learner = EfficientS1(0.5, prior_policy=prior)
    first, *_, last = learner.online(cut(data, 1), 40, 2)
    assert first.status is Status.UNCERTIFIED
    assert first.empirical_width == np.inf
    np.testing.assert_array_equal(first.policy, prior)
    empirical, reward, visits = oracle.counted(data, 40, 2)
    assert visits.all()
    assert last.empirical_width > 0.01
    assert not last.certified
    assert f"{last.empirical_width:.2g}" in last.message
    solution = learner.solution(last)
    assert solution.status is Status.UNCERTIFIED
    assert solution.message == last.message
    best, _ = oracle.soft_optimum(empirical, reward, prior, 0.5)
    loss = best - oracle.soft_rate(empirical, reward, prior, 0.5, last.policy.numpy())[0]
    assert 0 <= loss <= last.empirical_width


def test_online_takes_the_most_visited_of_several_closed_sets():
    """As certainty equivalence does, and says; and what leads nowhere is left out."""
    p = np.array([[[0.5, 0.5], [0.9, 0.1]], [[0.2, 0.8], [0.6, 0.4]]])
    r = -np.array([[1.0, 0.3], [0.2, 0.7]])
    data, apart = (collect(erl_torch.TabularMDP(p, r), 1, 1000 * n, n) for n in (3, 1))
    apart = replace(apart, s=apart.s + 2, s_next=apart.s_next + 2)
    both = Transitions(*(np.append(getattr(data, name), getattr(apart, name)) for name in COLUMNS))
    *_, state = EfficientS1(2.0).online([both], 4, 2)
    limit = CertaintyEquivalence(2.0).fit(both, 4, 2)
    assert state.status is limit.status is Status.REDUCIBLE
    assert state.message == limit.message
    np.testing.assert_allclose(state.policy, limit.policy, atol=0.02)
    assert (state.policy[2:] == 0.5).all()
    ends = Transitions(*(np.append(getattr(data, n), x) for n, x in zip(COLUMNS, (0, 1, 9.0, 2, 0), strict=True)))
    *_, state = EfficientS1(2.0).online([ends], 3, 2)
    limit = CertaintyEquivalence(2.0).fit(ends, 3, 2)
    assert state.certified
    assert state.message == limit.message
    np.testing.assert_allclose(state.policy, limit.policy, atol=0.02)


def test_sweeps_never_widen_and_find_the_optimum_of_a_periodic_chain():
    p = np.zeros((6, 2, 6))
    for s in range(6):
        p[s, 0, (s + 1) % 6] = p[s, 1, (s + 3) % 6] = 1.0
    r = -(np.arange(12.0).reshape(6, 2) ** 0.5)
    problem = BellmanProblem.of(erl_torch.TabularMDP(p, r), 3.0)
    value, spans = np.zeros(6), []
    for _ in range(60):
        value, gain, made = swept(problem, value, 0.0, 5)
        assert made == 5
        spans.append(np.ptp(gain))
    assert (np.diff(spans) <= 1e-14).all()
    assert spans[-1] < 1e-9
    best, _ = oracle.soft_optimum(p, r, np.full((6, 2), 0.5), 3.0)
    assert gain.mean() == pytest.approx(best, abs=1e-9)
    assert swept(problem, value, 1e-8, 5)[2] == 0


def test_online_refuses_rewards_whose_squares_are_not_finite():
    data = Transitions(
        np.zeros(2, int), np.zeros(2, int), np.array([1e200, -1e200]), np.zeros(2, int), np.zeros(2, int)
    )
    with pytest.raises(InputError, match="squares"):
        list(EfficientS1().online([data], 1, 1))


def test_a_penalty_that_is_never_paid_certifies_nothing_else():
    """One action costs 1e9: a width of 3 beside theta 1.5 is no certificate, offline or online."""
    p = np.array([[[0.5, 0.5], [0.0, 1.0]], [[0.1, 0.9], [0.1, 0.9]]])
    mdp = erl_torch.TabularMDP(p, np.array([[5.0, 10.0], [-2.0, -1e9]]))
    data = collect(mdp, 100, 1000, 0)
    rows, reward, _ = oracle.counted(data, 2, 2)
    best, _ = oracle.soft_optimum(rows, reward, np.full((2, 2), 0.5), 1.0)
    offline = EfficientS1(1.0).fit(data, 2, 2)
    if offline.status is Status.CONVERGED:
        assert offline.theta == pytest.approx(-best, abs=1e-5)
    *_, online = EfficientS1(1.0).online([data], 2, 2)
    if online.certified:
        assert online.theta == pytest.approx(-best, abs=0.2)


def test_passes_that_end_before_the_certificate_is_narrow_are_uncertified():
    """Of a binned task, pairs seen once or twice; every reward is 1, so theta of the data is -1 + the KL of what is not
    there, at most log(2)/beta."""
    rng = np.random.default_rng(0)
    s = np.cumsum(rng.choice([1, 1, 2], 300)) % 150
    columns = s[:-1], rng.integers(2, size=299), np.ones(299), s[1:], rng.integers(2, size=299)
    data = Transitions(*columns)
    learner, best = EfficientS1(1.0, n_bias=2), CertaintyEquivalence(1.0).fit(data, 150, 2).theta
    found = learner.fit(data, 150, 2)
    assert found.status is Status.UNCERTIFIED
    low, high = (float(x) for x in found.message.split("theta* in [")[1].rstrip("]").split(", "))
    assert low <= best <= high
    assert low <= found.theta <= high
    assert -1 <= found.theta <= -1 + np.log(2)
    # Optimism about noise is another problem, which nothing is certified of.
    noisy = replace(data, r=data.r + rng.standard_normal(299))
    assert EfficientS1(1.0, n_bias=1, mean_reward=False).fit(noisy, 150, 2).status is Status.COMPLETED


def test_the_certificate_holds_with_its_rounding():
    """V of size 1e9: what rounding leaves of J and g* is within the ends, and the ends are not exact."""
    stream = EfficientS1().prepare(STREAM, 15, 4)
    policy, shift = CertaintyEquivalence().fit(STREAM, 15, 4).policy.numpy(), 1e9
    log_psi = -10.0 * (shift + np.linspace(0.0, 1.0, 15))
    low, high = certificate(stream.part, log_psi, policy)
    exact = certificate(stream.part, -10.0 * np.linspace(0.0, 1.0, 15), policy)
    assert low < exact[0] + 1e-6
    assert high > exact[1] - 1e-6
    empirical, reward, _ = oracle.counted(STREAM, 15, 4)
    best, _ = oracle.soft_optimum(empirical, reward, np.full((15, 4), 0.25), 10.0)
    assert low <= best <= high


def test_a_fault_of_the_counts_is_not_taken_for_a_short_stream(monkeypatch):
    *_, state = EfficientS1().online([STREAM], 15, 4)

    def refuse(*_, **__):
        raise InputError("beta", 1, "another")

    monkeypatch.setattr("erl_torch.empirical.counts.EmpiricalMDP.problem", refuse)
    with pytest.raises(InputError, match="beta"):
        state.part()


def test_theta_ends_within_the_certificate():
    """After one pass over few tuples rho is near its start, exp(-beta): theta would be near 1. TV - V and T_pi V - V
    by the oracle's backup, V = -log(psi)/beta."""
    rng = np.random.default_rng(0)
    mdp, prior, beta = random_mdp(rng, 4, 2), np.full((4, 2), 0.5), 3.0
    data = random_stream(rng, mdp, 200)
    p, reward, visits = oracle.counted(data, 4, 2)
    assert visits.all()
    found = EfficientS1(beta, n_epochs=1, n_bias=1).fit(data, 4, 2)
    value, policy = -found.psi.log().numpy() / beta, found.policy.numpy()
    high = (oracle.backup(p, reward, prior, beta, value)[0] - value).max()
    low = ((policy * (reward + p @ value - np.log(policy / prior) / beta)).sum(1) - value).min()
    assert low < high < -found.theta + 1 / 2
    assert -high - 1e-9 <= found.theta <= -low + 1e-9


def test_a_stream_of_two_closed_sets_is_reducible():
    """theta is that of the one with more tuples: rewards -1, not -3."""
    s = np.repeat([0, 1], [60, 40])
    data = Transitions(s, 0 * s, np.where(s == 0, -1.0, -3.0), s, 0 * s)
    found = EfficientS1(1.0).fit(data, 2, 1)
    assert found.status is Status.REDUCIBLE
    assert found.message.startswith("2 closed sets of states in this stream; solved on [0]")
    assert found.theta == pytest.approx(1.0)


def test_ends_of_the_certificate_are_beyond_what_fractions_say():
    """One action, beta 1: T_pi V - V = TV - V = r + V(s') - V(s), to the last digit."""
    rng, n = np.random.default_rng(0), 6
    s, zero = np.arange(n), np.zeros(n, int)
    for size in (1.0, 1e6):
        reward, value = rng.normal(size=n), size * rng.normal(size=n)
        stream = EfficientS1(1.0).prepare(Transitions(s, zero, reward, (s + 1) % n, zero), n, 1)
        low, high = certificate(stream.part, -value, np.ones((n, 1)))
        each = [Fraction(reward[i]) + Fraction(value[(i + 1) % n]) - Fraction(value[i]) for i in range(n)]
        assert Fraction(low) <= min(each)
        assert max(each) <= Fraction(high)
        assert high - low == pytest.approx(float(max(each) - min(each)), rel=1e-9)
