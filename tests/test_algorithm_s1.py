"""Algorithm S1 against its equations, its literal twin, and the authors' own data."""

import math
from dataclasses import replace
from typing import Any

import hypothesis
import numpy as np
import oracle
import pytest
import torch
from helpers import overshooting, problems, random_mdp, random_policy, random_stream
from hypothesis import strategies as st

from erl_torch import AlgorithmS1, InputError, ListedS1, NonFiniteError, Solution, Status, Transitions, collect
from erl_torch.empirical.counts import tally
from erl_torch.envs.windy_cliff import WindyCliffEnv
from erl_torch.learners.s1 import kernels

IMPLEMENTATIONS = ("fast", "literal")


def all_tuples(mdp):
    """One tuple of every (s, a, s', a') with p > 0."""
    n_actions = mdp.n_actions
    pairs, s_next = mdp.transition.nonzero()
    s, a = np.divmod(np.repeat(pairs, n_actions), n_actions)
    a_next = np.tile(np.arange(n_actions), len(pairs))
    return Transitions(s, a, mdp.reward[s, a], np.repeat(s_next, n_actions), a_next)


# -- the authors' script --------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
def test_gives_what_the_authors_script_gives(authors, authors_tuples, implementation):
    learner = AlgorithmS1(
        beta=float(authors["beta"]),
        lr_u=float(authors["alpha"]),
        lr_rho=float(authors["alpha_rho"]),
        lr_psi=float(authors["alpha_psi"]),
        n_epochs=int(authors["n_epochs"]),
        n_bias=int(authors["n_bias"]) + 1,
        rho_init="carry",
        self_loop="old",
        implementation=implementation,
    )
    ends = [s for s in learner.iterate(authors_tuples, 15, 4) if s.epoch == learner.n_epochs]
    assert [s.bias_iteration for s in ends] == [0, 1, 2, 3]
    for k, state in enumerate(ends):
        assert state.theta == pytest.approx(authors["theta"][k], abs=1e-9)
        assert state.reward_bias_max == pytest.approx(authors["offset"][k], abs=1e-9)
        assert state.rho == pytest.approx(authors["rho"][k], rel=1e-9)
        np.testing.assert_allclose(state.policy, authors["policy"][k], rtol=1e-9)
        np.testing.assert_allclose(state.mean_psi, authors["e_psi"][k], rtol=1e-9)
        np.testing.assert_allclose(state.mean_log_psi, authors["e_logpsi"][k], atol=1e-9)
        for ours, theirs in ((state.u, authors["u"][k]), (state.psi, authors["psi"][k])):
            np.testing.assert_allclose(ours / ours.mean(), theirs / theirs.mean(), rtol=1e-9)


def test_default_step_size_of_rho_is_the_scripts(authors, authors_tuples):
    assert authors["alpha_rho"] == pytest.approx(authors["alpha"] / 15, rel=1e-15)
    explicit = AlgorithmS1(n_epochs=1, n_bias=2, lr_rho=float(authors["alpha"]) / 15)
    default = AlgorithmS1(n_epochs=1, n_bias=2)
    assert default.fit(authors_tuples, 15, 4).rho == explicit.fit(authors_tuples, 15, 4).rho


# -- the two implementations ----------------------------------------------------------------------------


@hypothesis.settings(max_examples=40)
@hypothesis.given(
    problem=problems(),
    beta=st.floats(0.1, 8.0),
    lr_u=st.floats(1e-3, 0.5),
    lr_psi=st.floats(0.01, 1.0),
    rho_init=st.sampled_from(("reset", "carry")),
    self_loop=st.sampled_from(("new", "old")),
    unvisited=st.sampled_from(("initial", "prior")),
    clip_rho=st.booleans(),
    noisy=st.booleans(),
    shift=st.sampled_from((0.0, 0.5)),
    rescale_every=st.sampled_from((None, 7, 64)),
)
def test_fast_is_the_listing(problem, noisy, shift, **options):
    rng, mdp, prior = problem
    data = random_stream(rng, mdp, 300)
    data = replace(data, r=data.r + shift + (0.3 * rng.standard_normal(len(data)) if noisy else 0.0))
    fast, literal = (
        AlgorithmS1(n_epochs=2, n_bias=3, prior_policy=prior, implementation=i, **options).fit(
            data, mdp.n_states, mdp.n_actions
        )
        for i in IMPLEMENTATIONS
    )
    assert fast.status == literal.status == Status.COMPLETED
    assert fast.theta == pytest.approx(literal.theta, rel=1e-9, abs=1e-9)
    assert fast.reward_bias_max == pytest.approx(literal.reward_bias_max, rel=1e-9, abs=1e-12)
    for name in ("policy", "u", "psi", "reward_bias"):
        np.testing.assert_allclose(getattr(fast, name), getattr(literal, name), rtol=1e-9, atol=1e-12)


def test_fast_is_the_listing_on_the_cliff(authors_tuples):
    """The other options are the authors' own, above."""
    fast, literal = (
        AlgorithmS1(n_epochs=2, n_bias=3, implementation=i).fit(authors_tuples.first(10_000), 15, 4)
        for i in IMPLEMENTATIONS
    )
    assert fast.theta == pytest.approx(literal.theta, abs=1e-9)
    np.testing.assert_allclose(fast.u, literal.u, rtol=1e-9)
    np.testing.assert_allclose(fast.policy, literal.policy, rtol=1e-9)


def test_literal_walks_torch_tables_as_it_walks_views(authors_tuples):
    """On a device without NumPy views the listing indexes torch tensors: same doubles."""
    from erl_torch.learners.s1 import listing

    few = Transitions(*(getattr(authors_tuples, n)[:400] for n in ("s", "a", "r", "s_next", "a_next")))
    settings = dict(
        beta=10.0, lr_u=0.1, lr_rho=0.01, rho_max=1.0, self_loop="new", rescale_every=150
    )  # fmt: skip
    psi, table = torch.linspace(0.5, 2.0, 15, dtype=torch.float64), torch.ones(15, 4, dtype=torch.float64)
    results = []
    for convert in (lambda t: t.clone(), lambda t: t.clone().numpy()):
        mean_psi, mean_log_psi, u = convert(table), convert(table * 0), convert(table)
        listing.psi_epoch(few, convert(psi), convert(psi.log()), mean_psi, mean_log_psi, 0.1)
        rho, done = listing.u_epoch(few, convert(psi), mean_psi, mean_log_psi, 0.1, u, math.exp(-10), **settings)
        assert done == 400
        results.append((rho, np.asarray(mean_psi), np.asarray(mean_log_psi), np.asarray(u)))
    assert results[0][0] == pytest.approx(results[1][0], rel=1e-12)
    for ours, theirs in zip(results[0][1:], results[1][1:], strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-12)


# -- equations (3)-(11) -----------------------------------------------------------------------------------


def at_oracle(learner, mdp, iterate, k):
    """The state that stands at an exact biasing iteration, as the learner would hold it."""
    tensor = lambda x: torch.from_numpy(np.ascontiguousarray(x))  # noqa: E731
    state = learner.init(mdp.n_states, mdp.n_actions)
    u = iterate.u / iterate.u.mean()
    return replace(
        state,
        bias_iteration=k,
        epoch=1,
        rho=iterate.rho,
        u=tensor(u),
        psi_in_use=tensor(iterate.psi),
        mean_psi=tensor(iterate.mean_psi),
        mean_log_psi=tensor(iterate.mean_log_psi),
        reward_bias=tensor(iterate.delta),
    )


@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("k", [0, 1, 2])
def test_expected_update_vanishes_at_the_exact_solution(implementation, seed, k):
    """Equations (3)-(9): at an exact eigenpair the mean of lines 10 and 11 over s', a' changes nothing."""
    rng = np.random.default_rng(seed)
    mdp = random_mdp(rng, 4, 3)
    prior = random_policy(rng, 4, 3)
    beta, lr = 3.0, 1e-7
    p = mdp.transition.toarray().reshape(4, 3, 4)
    iterate = oracle.biasing_iterations(p, mdp.reward, prior, beta, k + 1)[k]
    learner = AlgorithmS1(
        beta=beta, lr_u=lr, lr_rho=lr, n_epochs=5, n_bias=9, prior_policy=prior, implementation=implementation
    )
    state = at_oracle(learner, mdp, iterate, k)
    assert state.theta == pytest.approx(iterate.theta, abs=1e-12)
    drift_u, drift_rho = np.zeros((4, 3)), np.zeros((4, 3))
    data = all_tuples(mdp)
    before = state.u.numpy()
    for t in range(len(data)):
        one = Transitions(*(getattr(data, n)[t : t + 1] for n in ("s", "a", "r", "s_next", "a_next")))
        s, a = one.s[0], one.a[0]
        after = learner.step(state, learner.prepare(one, 4, 3))
        weight = p[s, a, one.s_next[0]] * prior[one.s_next[0], one.a_next[0]]
        # u is rescaled after each epoch: compare with another entry, which the tuple left alone.
        other = (s, (a + 1) % 3)
        u_after = after.u[s, a].item() / after.u[other].item() * before[other]
        drift_u[s, a] += weight * (u_after - before[s, a]) / (lr * before[s, a])
        drift_rho[s, a] += weight * (after.rho - state.rho) / (lr * state.rho)
    np.testing.assert_allclose(drift_u, 0, atol=2e-6)
    np.testing.assert_allclose(drift_rho, 0, atol=2e-6)


@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
def test_sample_means_of_psi_are_equations_10_and_11(implementation):
    """With step 1 the psi phase keeps the last visit: an average that is known exactly."""
    rng = np.random.default_rng(0)
    mdp = random_mdp(rng, 5, 2)
    data = random_stream(rng, mdp, 200)
    learner = AlgorithmS1(beta=2.0, lr_psi=1.0, n_epochs=1, n_bias=2, implementation=implementation)
    first, second = learner.iterate(data, 5, 2)
    for s in range(5):
        for a in range(2):
            visits = np.flatnonzero((data.s == s) & (data.a == a))
            last = first.psi[data.s_next[visits[-1]]]
            assert second.mean_psi[s, a] == pytest.approx(last.item(), rel=1e-15)
            assert second.mean_log_psi[s, a] == pytest.approx(last.log().item(), rel=1e-14)
    assert second.reward_bias.abs().max() < 1e-14  # one sample has no spread


@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
@pytest.mark.parametrize("unvisited", ["initial", "prior"])
def test_psi_and_policy_are_equations_7_and_12(implementation, unvisited):
    """With a prior that is not uniform, and states and pairs never visited; both count with the prior."""
    rng = np.random.default_rng(1)
    mdp, prior = random_mdp(rng, 4, 3), random_policy(rng, 6, 3)
    data = random_stream(rng, mdp, 200)
    learner = AlgorithmS1(
        3.0, lr_u=0.1, n_epochs=2, n_bias=3, prior_policy=prior, unvisited=unvisited, implementation=implementation
    )
    for state in learner.iterate(data.where((data.s != 1) | (data.a != 2)), 6, 3):
        weight = prior * state.u.numpy()
        np.testing.assert_allclose(state.psi.numpy() * weight.sum(1), 1, rtol=1e-13)
        np.testing.assert_allclose(state.policy, weight / weight.sum(1, keepdims=True), rtol=1e-13)
        assert state.u.mean().item() == pytest.approx(1, rel=1e-13)


@pytest.mark.parametrize("seed", range(3))
def test_converges_to_the_exact_biasing_iterations(seed):
    rng = np.random.default_rng(seed)
    mdp, prior = random_mdp(rng, 3, 2), random_policy(rng, 3, 2)
    data = collect(mdp, 1, 100_000, seed, prior_policy=prior)
    learner = AlgorithmS1(beta=2.0, lr_u=0.002, lr_psi=0.002, n_epochs=8, n_bias=4, prior_policy=prior)
    exact = oracle.biasing_iterations(mdp.transition.toarray().reshape(3, 2, 3), mdp.reward, prior, 2.0, 4)
    for state in learner.iterate(data, 3, 2):
        if state.epoch == learner.n_epochs:
            iterate = exact[state.bias_iteration]
            assert state.theta == pytest.approx(iterate.theta, abs=0.02)
            np.testing.assert_allclose(state.policy, iterate.policy, atol=0.02)
            np.testing.assert_allclose(state.reward_bias, iterate.delta, atol=0.05)


# -- identities -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
def test_scale_of_u_changes_no_bit(implementation):
    rng = np.random.default_rng(3)
    mdp = random_mdp(rng, 4, 3)
    data = random_stream(rng, mdp, 500)
    learner = AlgorithmS1(beta=3.0, lr_u=0.1, n_epochs=3, n_bias=2, implementation=implementation)
    stream = learner.prepare(data, 4, 3)
    state = learner.step(learner.init(4, 3), stream)
    for factor in (2.0**-40, 2.0**300):
        scaled = learner.step(replace(state, u=state.u * factor), stream)
        plain = learner.step(state, stream)
        assert scaled.rho == plain.rho
        assert torch.equal(scaled.policy, plain.policy)


def test_rescaling_changes_no_bit(authors_tuples):
    results = [
        AlgorithmS1(n_epochs=2, n_bias=2, rescale_every=every).fit(authors_tuples, 15, 4)
        for every in (1, 13, 5000, 10**9)
    ]
    for result in results[1:]:
        assert result.rho == results[0].rho
        assert torch.equal(result.policy, results[0].policy)


@hypothesis.settings(max_examples=30)
@hypothesis.given(problem=problems(), lr_psi=st.floats(1e-3, 1.0), epochs=st.integers(1, 6))
def test_affine_psi_phase_is_the_sequential_one(problem, lr_psi, epochs):
    rng, mdp, _ = problem
    n_states, n_actions = mdp.reward.shape
    data = random_stream(rng, mdp, 150)
    pair = data.s * np.int32(n_actions) + data.a
    found = tally(data, n_states, n_actions, lr_psi)
    counts, affine = found.visits, found.psi_map
    assert np.array_equal(counts, np.bincount(pair, minlength=n_states * n_actions))
    psi = rng.lognormal(size=n_states)
    mean_psi, mean_log_psi = np.ones(n_states * n_actions), np.zeros(n_states * n_actions)
    done, change = kernels.psi_phase(
        *affine, (1 - lr_psi) ** counts, psi, np.log(psi), mean_psi, mean_log_psi, 1e-300, 1e-10, epochs
    )
    assert 1 <= done <= epochs
    assert done == epochs or change < 1e-300
    x, y = np.ones(n_states * n_actions), np.zeros(n_states * n_actions)
    for _ in range(epochs):
        for k, s in zip(pair, data.s_next, strict=True):
            x[k] = (1 - lr_psi) * x[k] + lr_psi * psi[s]
            y[k] = (1 - lr_psi) * y[k] + lr_psi * np.log(psi[s])
    np.testing.assert_allclose(mean_psi, x, rtol=1e-12)
    np.testing.assert_allclose(mean_log_psi, y, rtol=1e-12, atol=1e-13)


def test_psi_map_sorts_its_columns_and_forgets_old_visits():
    zeros = np.zeros(20_000, np.int32)
    s_next = np.concatenate([np.full(19_000, 2), np.tile([1, 0], 500)]).astype(np.int32)
    indptr, indices, data = tally(Transitions(zeros, zeros, zeros, s_next, zeros), 3, 1, 0.9).psi_map
    assert indptr.tolist() == [0, 2, 2, 2]
    assert indices.tolist() == [0, 1]
    np.testing.assert_allclose(data, [0.9 / (1 - 0.01), 0.09 / (1 - 0.01)], rtol=1e-12)


@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
def test_deterministic_dynamics_need_no_bias(implementation):
    """delta = 0 and b = 1: psi(s') is <psi>(s,a), for every pair, in every biasing iteration."""
    rng = np.random.default_rng(5)
    n_states, n_actions = 5, 3
    # p(s'|s,a) in {0, 1}; action 0 walks the cycle, so that the chain is irreducible.
    target = rng.integers(n_states, size=(n_states, n_actions))
    target[:, 0] = (np.arange(n_states) + 1) % n_states
    mdp = erl_mdp(np.eye(n_states)[target], -rng.random((n_states, n_actions)))
    data = random_stream(rng, mdp, 3000)
    learner = AlgorithmS1(beta=4.0, lr_u=0.05, n_epochs=3, n_bias=4, psi_tol=1e-13, implementation=implementation)
    for state in learner.iterate(data, n_states, n_actions):
        assert state.reward_bias.min() >= 0
        assert state.reward_bias.max() < 1e-11
        b = state.psi_in_use[torch.from_numpy(target)] / state.mean_psi
        np.testing.assert_allclose(b, 1, rtol=1e-11)


def test_one_action_cycle_is_solved_exactly():
    """One action, a deterministic cycle: theta is minus the mean reward, psi u = 1, both to rounding."""
    r = np.array([[-1.0], [-0.25], [-0.5], [0.0]])
    mdp = erl_mdp(np.roll(np.eye(4), 1, axis=1)[:, None, :], r)
    data = random_stream(np.random.default_rng(0), mdp, 4000)
    solution = AlgorithmS1(beta=2.0, lr_u=0.5, lr_rho=0.1, n_epochs=20, n_bias=3).fit(data, 4, 1)
    assert solution.theta == pytest.approx(0.4375, abs=1e-12)
    assert solution.reward_bias_max < 1e-12
    np.testing.assert_allclose(solution.psi * solution.u[:, 0], 1, rtol=1e-12)
    u = solution.u[:, 0].numpy()
    np.testing.assert_allclose(np.exp(2 * r[:, 0]) * np.roll(u, -1), solution.rho * u, rtol=1e-11)  # eq. (3)


def test_positive_rewards_are_not_clipped_at_one():
    r = np.array([[1.0], [3.0]])
    mdp = erl_mdp(np.array([[[0.0, 1.0]], [[1.0, 0.0]]]), r)
    data = random_stream(np.random.default_rng(0), mdp, 2000)
    solution = AlgorithmS1(beta=1.0, lr_u=0.5, lr_rho=0.1, n_epochs=20, n_bias=2).fit(data, 2, 1)
    assert solution.theta == pytest.approx(-2.0, abs=1e-10)


@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
@pytest.mark.parametrize("largest_reward", [-0.02, 0.0, 0.2])
def test_rho_is_clipped_at_its_bound(implementation, largest_reward):
    """At max(1, exp(beta max r)), and not without clip_rho."""
    data, steps = overshooting(largest_reward), dict(beta=5.0, lr_u=0.05, lr_rho=0.1)
    bound = max(1.0, math.exp(5.0 * largest_reward))
    learner = ListedS1(n_epochs=1, n_bias=1, implementation=implementation, **steps)
    clipped, free = (
        oracle.lines_9_to_11(data, (2, 1), **steps, rho_max=bound),
        oracle.lines_9_to_11(data, (2, 1), **steps),
    )
    assert clipped.largest > 1.05 * bound
    assert clipped.rho == bound
    assert learner.fit(data, 2, 1).rho == pytest.approx(bound, rel=1e-15)
    found = replace(learner, clip_rho=False).fit(data, 2, 1)
    assert found.rho == pytest.approx(free.rho, rel=1e-12)
    np.testing.assert_allclose(found.u, free.u / free.u.mean(), rtol=1e-12)


@pytest.mark.parametrize("psi", [0.01, 1.01, 100.0])
@pytest.mark.parametrize("keep", [0.3, 0.9])
def test_the_psi_phase_ends_by_the_larger_relative_error(psi, keep):
    """One pair: after n epochs <psi> = psi + (1 - psi) keep^n and <log psi> = log(psi) (1 - keep^n)."""
    n = np.arange(500)
    x, y = psi + (1 - psi) * keep**n, math.log(psi) * (1 - keep**n)
    error = np.maximum(np.abs(np.diff(x)) / x[:-1], np.abs(np.diff(y)) / (np.abs(y[:-1]) + 1e-10))
    expected = int(np.argmax(error < 1e-3))
    affine = np.array([0, 1]), np.array([0], np.int32), np.array([1 - keep])
    mean_psi, mean_log_psi = np.ones(1), np.zeros(1)
    learner = AlgorithmS1(psi_tol=1e-3)
    epochs, found = learner.psi_phase(affine, np.array([keep]), np.array([psi]), mean_psi, mean_log_psi)
    assert epochs == expected + 1
    assert found == pytest.approx(error[expected], rel=1e-9)
    assert mean_psi[0] == pytest.approx(x[epochs], rel=1e-12)
    assert mean_log_psi[0] == pytest.approx(y[epochs], rel=1e-12)


# -- documented behaviour ---------------------------------------------------------------------------------


def test_cliff_figure_5():
    env = WindyCliffEnv()
    data = collect(env, 500, 1000, 0)
    solution = AlgorithmS1().fit(data, 15, 4)
    assert solution.status is Status.COMPLETED
    assert solution.n_steps == 45_000_000
    assert solution.theta == pytest.approx(1.0101363366, abs=0.01)
    assert (solution.policy.sum(1) - 1).abs().max() < 1e-14


def test_visited_states_only():
    rng = np.random.default_rng(0)
    mdp, prior = random_mdp(rng, 4, 3), random_policy(rng, 6, 3)
    data = random_stream(rng, mdp, 400)
    few = data.a[data.s == 1]
    keep = ~((data.s == 1) & (data.a == 2))
    data = Transitions(*(getattr(data, n)[keep] for n in ("s", "a", "r", "s_next", "a_next")))
    assert (few == 2).any()
    options = dict(beta=3.0, lr_u=0.05, n_epochs=3, n_bias=3, prior_policy=prior)
    for implementation in IMPLEMENTATIONS:
        solution = ListedS1(unvisited="prior", implementation=implementation, **options).fit(data, 6, 3)
        # States 4 and 5 never occur, nor does action 2 in state 1.
        np.testing.assert_allclose(solution.policy[4:], prior[4:], rtol=1e-14)
        assert solution.policy[1, 2] == pytest.approx(prior[1, 2], rel=1e-14)
        assert abs(solution.policy[1, 0] - prior[1, 0]) > 1e-3
        assert solution.reward_bias[4:].abs().max() == 0
        listing = ListedS1(implementation=implementation, **options).fit(data, 6, 3)
        np.testing.assert_allclose(listing.policy[4:], prior[4:], rtol=1e-14)


def test_iterate_can_be_stopped_and_gone_on_with(authors_tuples):
    learner = AlgorithmS1(n_epochs=3, n_bias=2)
    whole = learner.fit(authors_tuples, 15, 4)
    stream = learner.prepare(authors_tuples, 15, 4)
    states = learner.iterate(authors_tuples, 15, 4)
    state = next(s for s in states if (s.bias_iteration, s.epoch) == (1, 1))
    assert learner.solution(state).status is Status.STOPPED
    for _ in range(2):
        state = learner.step(state, stream)
    assert state.rho == whole.rho
    assert torch.equal(state.u, whole.u)
    assert whole.history["n_tuples"].tolist() == [20_000 * k for k in range(1, 7)]
    assert whole.history["bias_iteration"].tolist() == [0, 0, 0, 1, 1, 1]
    assert whole.history["theta"][-1] == whole.theta


def test_states_are_values(authors_tuples):
    learner = AlgorithmS1(n_epochs=1, n_bias=2)
    stream = learner.prepare(authors_tuples, 15, 4)
    state = learner.step(learner.init(15, 4), stream)
    before = {k: v.clone() for k, v in vars(state).items() if isinstance(v, torch.Tensor)}
    again = [learner.step(state, stream) for _ in range(2)]
    assert again[0].rho == again[1].rho
    for name, table in before.items():
        assert torch.equal(getattr(state, name), table)


@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
def test_leaving_the_finite_numbers_stops_with_step_and_cause(implementation):
    """exp(beta r) = 0 at r = -100, so u halves at each visit; 2**-1075 is the first that is 0."""
    zeros = np.zeros(1200, int)
    data = Transitions(zeros, zeros, np.full(1200, -100.0), zeros + 1, zeros)
    learner = AlgorithmS1(beta=10.0, lr_u=0.5, lr_rho=1e-3, n_epochs=1, n_bias=1, implementation=implementation)
    solution = learner.fit(data, 2, 1)
    assert solution.status is Status.NON_FINITE
    with pytest.raises(NonFiniteError, match=r"tuple 1074 \(s=0, a=0, r=-100\).*beta\*r = -1000") as error:
        list(learner.iterate(data, 2, 1))
    assert error.value.step == 1075
    assert str(error.value) == solution.message
    assert solution.n_steps == 0
    assert torch.isfinite(solution.u).all()


def test_overflowing_rewards_are_refused():
    data = Transitions([0], [0], [100.0], [0], [0])
    solution = AlgorithmS1(beta=10.0).fit(data, 1, 1)
    assert solution.status is Status.NON_FINITE
    assert "beta*max(r) = 1000" in solution.message


def test_psi_limit_is_reported(authors_tuples):
    solution = AlgorithmS1(n_epochs=1, n_bias=2, max_psi_epochs=3).fit(authors_tuples, 15, 4)
    assert solution.status is Status.PSI_LIMIT
    assert solution.history["psi_epochs"].tolist() == [1, 3]
    assert solution.history["psi_error"][-1] >= 1e-4


def test_a_psi_phase_cut_short_is_remembered(authors_tuples):
    """The last one meets its tolerance, an earlier one did not."""
    solution = ListedS1(n_epochs=1, n_bias=8, max_psi_epochs=60).fit(authors_tuples, 15, 4)
    assert solution.history["psi_error"][-1] < 1e-4 < solution.history["psi_error"].max()
    assert solution.status is Status.PSI_LIMIT


def test_million_tuple_drift_stays_in_range():
    """rho far from its value lets u drift by exp(15) every pass: rescaling keeps it in range."""
    data = Transitions(np.zeros(3_000_000, int), np.zeros(3_000_000, int), np.full(3_000_000, -2.0),
                       np.zeros(3_000_000, int), np.zeros(3_000_000, int))  # fmt: skip
    solution = AlgorithmS1(beta=1.0, lr_u=0.01, lr_rho=1e-9, self_loop="old", n_epochs=1, n_bias=1).fit(data, 1, 1)
    assert solution.status is Status.COMPLETED
    assert solution.u.item() == 1.0


BAD: dict[str, Any] = {
    "beta": [0.0, -1.0, math.nan, math.inf, 1e4, 1e-300],
    "lr_u": [0.0, 1.5, math.nan],
    "lr_rho": [0.0, -0.1, math.inf],
    "lr_psi": [0.0, 1.0001],
    "n_epochs": [0, -3, 1.5, True],
    "n_bias": [0],
    "psi_tol": [0.0, math.nan],
    "max_psi_epochs": [0],
    "rho_init": ["once"],
    "self_loop": ["newest"],
    "rescale_every": [0],
    "unvisited": ["none"],
    "implementation": ["slow"],
    "device": ["nowhere", "cuda:99"],
    "prior_policy": [np.ones((15, 4)), np.full((15, 3), 1 / 3), np.eye(15)[:, :4], "uniform"],
}


@pytest.mark.parametrize(("key", "value"), [(k, v) for k, values in BAD.items() for v in values])
def test_bad_arguments_are_named(authors_tuples, key, value):
    with pytest.raises(InputError, match=rf"^{key}.*must be ") as error:
        AlgorithmS1(**{key: value}).fit(authors_tuples, 15, 4)
    assert "\n" not in str(error.value)


def test_bad_stream_is_named(authors_tuples):
    with pytest.raises(InputError, match=r"^s\[\d+\]=14: must be below 14"):
        AlgorithmS1().fit(authors_tuples, 14, 4)
    with pytest.raises(InputError, match=r"^a\[\d+\]=3: must be below 3"):
        AlgorithmS1().fit(authors_tuples, 15, 3)


def test_solution_round_trip(tmp_path, authors_tuples):
    solution = AlgorithmS1(n_epochs=1, n_bias=2).fit(authors_tuples, 15, 4)
    loaded = Solution.load(solution.save(tmp_path / "solution.npz"))
    for name in ("policy", "u", "psi", "reward_bias"):
        assert torch.equal(getattr(loaded, name), getattr(solution, name))
    for name in ("rho", "theta", "reward_bias_max", "n_steps", "status", "message"):
        assert getattr(loaded, name) == getattr(solution, name)
    for name, values in solution.history.items():
        assert np.array_equal(loaded.history[name], values)
    assert [p.name for p in tmp_path.iterdir()] == ["solution.npz"]


def erl_mdp(p, r):
    from erl_torch import TabularMDP

    return TabularMDP(p, r)
