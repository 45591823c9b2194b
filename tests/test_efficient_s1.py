"""EfficientS1: all options off, it is Algorithm S1; all on, it is certainty equivalence; and it never breaks."""

from dataclasses import fields, replace

import hypothesis
import numpy as np
import oracle
import pytest
import torch
from conftest import DATA, overshooting, problems, random_mdp, random_policy, random_stream
from hypothesis import strategies as st

import erl_torch
from erl_torch import (
    AlgorithmS1,
    CertaintyEquivalence,
    EfficientS1,
    ListedS1,
    InputError,
    NonFiniteError,
    Status,
    Transitions,
    collect,
    empirical_mdp,
    kernels,
    solve_soft_bellman,
)
from erl_torch.envs.windy_cliff import WindyCliffEnv
from erl_torch.evaluation import kl_per_state, objective
from erl_torch.learners import listing
from erl_torch.learners.efficient_s1 import SWITCHES, empirical_width

CLIFF = WindyCliffEnv().mdp
UNIFORM = np.full((15, 4), 0.25)
STREAM = collect(CLIFF, 300, 1000, 2)


def with_noise(data, rng, scale=1.0):
    return Transitions(data.s, data.a, data.r + scale * rng.standard_normal(len(data)), data.s_next, data.a_next)


# -- off: the paper ---------------------------------------------------------------------------------------


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
    errors = AlgorithmS1(**options).fit(authors_tuples, 15, 4).history["psi_error"]
    assert errors[-1] < 1e-4 < errors.max()
    assert EfficientS1.published(**options).fit(authors_tuples, 15, 4).status is Status.PSI_LIMIT


# -- the compiled loops and their twins -------------------------------------------------------------------


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


@hypothesis.settings(max_examples=30)
@hypothesis.given(problem=problems(), beta=st.floats(0.1, 5.0), growth=st.sampled_from((1.3, 2.0)))
def test_online_mode_agrees_with_its_direct_form(problem, beta, growth):
    rng, mdp, prior = problem
    shape = mdp.reward.shape
    data = with_noise(random_stream(rng, mdp, 700), rng, 0.1)
    learner = EfficientS1(beta, prior_policy=prior, phase_growth=growth)
    *_, state = learner.online([data], *shape)
    steps = replace(learner, clock_floor=learner.lr_u).steps()
    value, z, weight, rho = np.zeros(shape[0]), np.ones(shape), prior.copy(), np.exp(-beta)
    visits, begin, end, phase = np.zeros(shape), 0, 10 * prior.size, 0
    rewards, rho_max = np.zeros(shape), 1.0
    while begin < len(data):
        part = Transitions(*(getattr(data, f.name)[begin:end] for f in fields(data)))
        sums = np.stack([visits, np.zeros(shape), rewards])
        np.add.at(sums[1], (data.s[:begin], data.a[:begin]), value[data.s_next[:begin]])
        rho, rho_max = listing.online_phase(
            part, value, sums, z, weight, rho, beta=beta, prior=prior, steps=steps,
            lr_rho=0.005 / shape[0] / (phase + 1), rho_max=rho_max,
        )  # fmt: skip
        visits, rewards = sums[0], sums[2]
        assert end > len(data) or len(part) == end - begin
        if end <= len(data):
            h = np.log((weight * z).sum(1))
            h -= np.average(h, weights=visits.sum(1))
            z, value = z / np.exp(h)[:, None], value + h / beta
        begin, end, phase = end, int(np.ceil(growth * end)), phase + 1
    policy = weight * z / (weight * z).sum(1, keepdims=True)
    np.testing.assert_allclose(state.policy, policy, rtol=1e-7, atol=1e-12)


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
    import scipy.sparse as sp

    with np.load(DATA / "windy_mazes.npz") as d:
        r = d["m01_R"]
        rows = sp.csr_array((d["m01_data"], d["m01_indices"], d["m01_indptr"]), shape=(r.size, len(r)))
        mdp = erl_torch.TabularMDP(rows, r, d["m01_start"])
    data = collect(mdp, 200, 1000, 1)
    prior = np.full(r.shape, 0.25)
    found, limit = EfficientS1(5.0).fit(data, *r.shape), CertaintyEquivalence(5.0).fit(data, *r.shape)
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
        width = empirical_width(part, np.log(last.psi), policy)
        assert width == pytest.approx(kl.max() / beta, abs=1e-9)
        chain = np.einsum("sa,sat->st", policy, p)
        share = np.linalg.matrix_power(chain, 10_000)[0]
        loss = -last.theta - share @ ((policy * model.reward).sum(1) - kl_prior / beta)
        for spread in (0.0, 0.1, 1.0):
            assert loss <= empirical_width(part, np.log(last.psi) + spread * rng.standard_normal(4), policy) + 1e-12


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
    assert learner.solution(state).status is Status.COMPLETED
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
        {"prior_policy": np.array([[1.0, 0.0]])},
    ],
)
def test_bad_settings_name_the_key(bad):
    with pytest.raises(InputError, match=next(iter(bad))):
        EfficientS1(**bad).init(1, 2)


# -- online -----------------------------------------------------------------------------------------------


def test_online_does_not_depend_on_how_the_stream_is_cut():
    def run(edges):
        parts = [Transitions(*(getattr(STREAM, f.name)[i:j] for f in fields(STREAM))) for i, j in edges]
        *_, state = EfficientS1().online(parts, 15, 4)
        return state

    whole, cut = run([(0, 60_000)]), run([(0, 1), (1, 777), (777, 40_000), (40_000, 60_000)])
    np.testing.assert_allclose(whole.policy, cut.policy, rtol=1e-9)
    assert whole.theta == pytest.approx(cut.theta, rel=1e-12)
    assert whole.n_tuples == cut.n_tuples == 60_000


def test_online_loss_falls_to_that_of_certainty_equivalence():
    theta = solve_soft_bellman(CLIFF, 10.0).theta

    def loss(policy):
        return -theta - objective(CLIFF, policy.numpy(), UNIFORM, 10.0)

    online, limit = [], []
    for seed in range(3):
        chunks = [collect(CLIFF, 500, 1000, 10 * seed + i) for i in range(4)]
        online.append([loss(state.policy) for state in EfficientS1().online(chunks, 15, 4)])
        everything = Transitions(*(np.concatenate([getattr(c, f.name) for c in chunks]) for f in fields(chunks[0])))
        limit.append(loss(CertaintyEquivalence().fit(everything, 15, 4).policy))
    online = np.mean(online, axis=0)
    assert online[-1] < 2 * np.mean(limit)
    assert online[-1] < online[0]


def test_clocks_of_any_accepted_settings_have_steps():
    for horizon, floor in ((1e308, 1e-308), (1e308, 1.0), (1.0, 5e-324)):
        steps = EfficientS1(clock_horizon=horizon, clock_floor=floor).steps()
        assert ((steps > 0) & (steps <= 1)).all()
