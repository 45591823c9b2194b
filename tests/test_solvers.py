"""Exact solvers: independent routes meet, certificates hold, at any temperature and on nasty chains."""

from dataclasses import replace
from itertools import pairwise

import hypothesis
import numpy as np
import oracle
import pytest
import scipy.sparse as sp
import torch
from helpers import kl, maze, problems, random_mdp, random_policy
from hypothesis import strategies as st

import erl_torch
from erl_torch import (
    AlgorithmS1,
    InputError,
    Status,
    TabularMDP,
    certify,
    iterate_biasing,
    perron,
    solve_biasing,
    solve_soft_bellman,
)
from erl_torch.envs.windy_cliff import WindyCliffEnv
from erl_torch.learners import Exact
from erl_torch.solvers import chains, eigenpair, kernels
from erl_torch.solvers.chains import RegenerativeLU, SingularChainError, classes, reachable_from
from erl_torch.solvers.eigenpair import REFUSALS
from erl_torch.solvers.policy import induced_distribution, kl_per_state, objective, policy_chain, reward_per_step
from erl_torch.solvers.problem import BellmanProblem

CLIFF = WindyCliffEnv().mdp
UNIFORM = np.full((15, 4), 0.25)
BETAS = (1e-3, 0.1, 1.0, 10.0, 100.0, 1e3, 1e4)


# -- three routes -------------------------------------------------------------------------------------------


@hypothesis.settings(max_examples=200)
@hypothesis.given(problem=problems(), beta=st.floats(0.05, 20.0), scale=st.sampled_from([0.1, 1.0, 10.0]))
def test_three_routes_agree(problem, beta, scale):
    """Biasing iterations, soft Bellman, and the fixed point of S1's expected updates (its equations)."""
    _, mdp, prior = problem
    mdp = TabularMDP(mdp.transition, mdp.reward * scale + 0.5, mdp.start)
    bellman, biasing = solve_soft_bellman(mdp, beta, prior, tol=1e-13), solve_biasing(mdp, beta, prior, tol=1e-13)
    for solution in (bellman, biasing):
        assert solution.status in (Status.CONVERGED, Status.STAGNATED)
        assert solution.theta_bounds[1] - solution.theta_bounds[0] < 1e-10
    assert bellman.theta == pytest.approx(biasing.theta, abs=1e-10)
    assert kl(bellman.policy, biasing.policy) < 1e-12
    # S1: sum over s', a' of exp(beta r_b) b p pi0 u(s',a') = rho u(s,a), with b and delta from psi (eqs. 4, 7-9).
    n_states, n_actions = mdp.reward.shape
    p = mdp.transition.toarray().reshape(n_states, n_actions, n_states)
    psi, u = bellman.psi.numpy(), bellman.u.numpy()
    mean_psi, mean_log_psi = p @ psi, p @ np.log(psi)
    delta = (np.log(mean_psi) - mean_log_psi) / beta
    np.testing.assert_allclose(bellman.reward_bias, delta, atol=1e-9)
    b = psi / mean_psi[..., None]
    expected = np.exp(beta * (mdp.reward + delta - delta.max())) * np.einsum("sat,sat,t->sa", p, b, (prior * u).sum(1))
    np.testing.assert_allclose(expected, bellman.rho * u, rtol=1e-8)
    np.testing.assert_allclose(psi * (prior * u).sum(1), (psi * (prior * u).sum(1))[0], rtol=1e-9)  # eq. (7)


@pytest.mark.parametrize("i", range(5))
def test_authors_mazes(i):
    """theta and k are the authors'. The stored policies carry about seven digits: one exact step of soft policy
    iteration from a stored policy's own value, done densely here, moves it by up to 1.5e-7, onto ours."""
    mdp, known = maze(i)
    beta, (n_states, n_actions) = float(known["beta"]), mdp.reward.shape
    bellman, biasing = solve_soft_bellman(mdp, beta, tol=1e-12), solve_biasing(mdp, beta, tol=1e-12)
    assert biasing.k == known["k"]
    for solution in (bellman, biasing):
        assert solution.theta == pytest.approx(float(known["theta"]), abs=1e-9)
        np.testing.assert_allclose(solution.policy, known["policy"], atol=2e-7)
    np.testing.assert_allclose(bellman.policy, biasing.policy, atol=1e-9)
    prior = np.full((n_states, n_actions), 1 / n_actions)
    stored = known["policy"]
    p = np.einsum("sa,sat->st", stored, mdp.transition.toarray().reshape(n_states, n_actions, n_states))
    reward = (stored * mdp.reward).sum(1) - kl_per_state(stored, prior) / beta
    system = np.eye(n_states) - p
    system[:, np.argmax(mdp.start)] = 1.0  # the gain in place of the value of the start
    value = np.linalg.solve(system, reward)
    value[np.argmax(mdp.start)] = 0.0
    q = mdp.reward + (mdp.transition @ value).reshape(n_states, n_actions)
    improved = prior * np.exp(beta * (q - q.max(1, keepdims=True)))
    improved /= improved.sum(1, keepdims=True)
    np.testing.assert_allclose(bellman.policy, improved, atol=1e-8)


def test_cliff_oracles():
    for beta, theta, rate in ((10.0, 1.0101363366, -0.955595), (50.0, 0.9395271537, -0.914773)):
        for solve in (solve_soft_bellman, solve_biasing):
            solution = solve(CLIFF, beta, tol=1e-12)
            assert solution.theta == pytest.approx(theta, abs=1e-9)
            assert solution.gap < 1e-10
            assert objective(CLIFF, solution.policy.numpy(), UNIFORM, np.inf) == pytest.approx(rate, abs=1e-6)
    d = induced_distribution(CLIFF, solution.policy.numpy()).reshape(5, 3)
    oracle_rows = [
        [0, 0.0852, 0.0403],
        [0, 0.0994, 0.1311],
        [0, 0.0994, 0.1847],
        [0, 0.0011, 0.1852],
        [0, 0.0863, 0.0872],
    ]
    np.testing.assert_allclose(d, oracle_rows, atol=1e-4)
    first = next(iter(iterate_biasing(CLIFF, 50.0)))
    assert first.theta == pytest.approx(0.8366259, abs=1e-7)  # nearly periodic


def test_biasing_converges_as_measured():
    """max |V_k - V*| on the cliff at beta 10, the constant free."""
    optimum = solve_soft_bellman(CLIFF, 10.0, tol=1e-13).value.numpy()
    for state, expected in zip(iterate_biasing(CLIFF, 10.0), (0.31, 0.085, 0.015, 7.7e-4, 2.2e-6), strict=False):
        difference = state.value - optimum
        # Half the range is the distance with the best constant: between half and once the measured figure.
        assert 0.4 * expected < np.ptp(difference) / 2 < 1.1 * expected


@pytest.mark.parametrize("seed", range(3))
def test_biasing_iterations_are_the_dense_ones(seed):
    rng = np.random.default_rng(seed)
    mdp, prior = random_mdp(rng, 5, 3), random_policy(rng, 5, 3)
    exact = oracle.biasing_iterations(mdp.transition.toarray().reshape(5, 3, 5), mdp.reward, prior, 3.0, 4)
    for state, iterate in zip(iterate_biasing(mdp, 3.0, prior), exact, strict=False):
        assert state.theta == pytest.approx(iterate.theta, abs=1e-11)
        np.testing.assert_allclose(state.policy, iterate.policy, rtol=1e-9)
        np.testing.assert_allclose(state.reward_bias, iterate.delta, atol=1e-11)


# -- certificates --------------------------------------------------------------------------------------------


def refined_gain(mdp, beta, prior, value):
    """-theta* in extended precision (64-bit mantissa): Newton with residuals in longdouble from a good value."""
    wide = np.longdouble
    n_states, n_actions = mdp.reward.shape
    p = mdp.transition.toarray().reshape(n_states, n_actions, n_states)
    v, p_wide, r, pr = value.astype(wide), p.astype(wide), mdp.reward.astype(wide), prior.astype(wide)
    # Rows that sum to 1 within rounding in double are made to in longdouble.
    p_wide /= p_wide.sum(-1, keepdims=True)
    pr /= pr.sum(-1, keepdims=True)
    for _ in range(6):
        q = r + np.einsum("sat,t->sa", p_wide, v)
        top = q.max(1, keepdims=True)
        weight = pr * np.exp(wide(beta) * (q - top))
        error = top[:, 0] + np.log(weight.sum(1)) / wide(beta) - v
        policy = (weight / weight.sum(1, keepdims=True)).astype(np.float64)
        system = np.eye(n_states) - np.einsum("sa,sat->st", policy, p)
        system[:, 0] = 1.0
        step = np.linalg.solve(system, (error - error.mean()).astype(np.float64))
        step[0] = 0.0
        v = v + step
    return error.min(), error.max()


@pytest.mark.slow
def test_a_thousand_certificates():
    """Every bound contains the extended-precision answer and is narrower than 1e-9; G never rises."""
    for seed in range(1000):
        rng = np.random.default_rng(seed)
        n_states, n_actions = int(rng.integers(1, 7)), int(rng.integers(1, 4))
        mdp, prior = random_mdp(rng, n_states, n_actions), random_policy(rng, n_states, n_actions)
        beta = float(10 ** rng.uniform(-1, 1.5))
        solution = solve_soft_bellman(mdp, beta, prior)
        low, high = refined_gain(mdp, beta, prior, solution.value.numpy())
        assert high - low < 1e-15
        assert -solution.theta_bounds[1] <= low
        assert high <= -solution.theta_bounds[0]
        assert solution.theta_bounds[1] - solution.theta_bounds[0] < 1e-9
        assert 0 <= solution.gap < 1e-9
        if seed % 5 == 0:
            states = list(iterate_biasing(mdp, beta, prior, max_steps=8))
            optimism = [state.theta for state in states]  # -G: rises to theta*
            assert all(b >= a - 1e-12 for a, b in pairwise(optimism))
            for state in states:
                assert state.theta <= -low + 1e-12
                assert state.theta_bounds[0] <= -high
                assert -low <= state.theta_bounds[1]


@hypothesis.settings(max_examples=60)
@hypothesis.given(problem=problems(), beta=st.floats(0.1, 10.0), spread=st.floats(0.0, 5.0))
def test_any_value_carries_a_certificate(problem, beta, spread):
    """min(TV - V) <= J(pi_V) <= g* <= max(TV - V), and the gap identity g* - J = E_d KL(pi || pi*)/beta."""
    rng, mdp, prior = problem
    value = spread * rng.standard_normal(mdp.n_states)
    found = BellmanProblem.of(mdp, beta, prior).gains(value)
    policy, (low, high) = found.policy, found.theta_bounds
    q = mdp.reward + (mdp.transition @ value).reshape(mdp.reward.shape)
    weight = prior * np.exp(beta * (q - q.max(1, keepdims=True)))
    np.testing.assert_allclose(policy, weight / weight.sum(1, keepdims=True), rtol=1e-9)
    optimum = solve_soft_bellman(mdp, beta, prior, tol=1e-13)
    j = objective(mdp, policy, prior, beta)
    assert -high <= j <= -optimum.theta + 1e-12
    assert low <= optimum.theta <= high
    d = induced_distribution(mdp, policy)
    assert -optimum.theta - j == pytest.approx(d @ kl_per_state(policy, optimum.policy.numpy()) / beta, abs=1e-9)
    certified = certify(replace(optimum, policy=torch.from_numpy(policy)), mdp, beta, prior)
    assert certified.gap == pytest.approx(-optimum.theta - j, abs=1e-9)


@pytest.mark.parametrize("max_steps", [1, 2, 3])
def test_the_gap_is_that_of_the_policy_returned(max_steps):
    """Also where the best bounds were proven by an earlier iteration."""
    for seed in range(30):
        rng = np.random.default_rng(seed)
        mdp, prior = random_mdp(rng, 5, 3), random_policy(rng, 5, 3)
        best = -solve_soft_bellman(mdp, 20.0, prior).theta
        for solve in (solve_biasing, solve_soft_bellman):
            solution = solve(mdp, 20.0, prior, max_steps=max_steps)
            assert best - objective(mdp, solution.policy.numpy(), prior, 20.0) <= solution.gap + 1e-10


@pytest.mark.parametrize("method", ["biasing", "soft_bellman"])
def test_exact_learner_with_nothing_to_iterate(method):
    """One state: V = 0 is the solution, before any step."""
    mdp = TabularMDP([[1.0], [1.0]], [[-1.0, -3.0]])
    learner = Exact(beta=1.0, method=method)
    states = list(learner.iterate(mdp))
    solution = learner.solution(states[-1], [s.metrics() for s in states])
    assert solution.status is Status.CONVERGED
    assert solution.theta == pytest.approx(-np.log(0.5 * (np.exp(-1) + np.exp(-3))), abs=1e-10)


def test_learnt_solutions_are_certified():
    data = erl_torch.collect(CLIFF, 100, 1000, 0)
    learnt = certify(AlgorithmS1(n_bias=3).fit(data, 15, 4), CLIFF, 10.0)
    assert learnt.theta_bounds[0] <= 1.0101363366 + 1e-9
    assert learnt.theta_bounds[1] - learnt.theta_bounds[0] < 1e-8
    assert learnt.gap == pytest.approx(-1.0101363366 - objective(CLIFF, learnt.policy.numpy(), UNIFORM, 10.0), abs=1e-8)


# -- any temperature -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("beta", BETAS)
@pytest.mark.parametrize("name", ["cliff", 0, 1, 2, 3, 4, "deep", "positive"])
def test_any_temperature(name, beta):
    mdp = CLIFF if isinstance(name, str) else maze(name)[0]
    if name == "deep":
        mdp = TabularMDP(CLIFF.transition, CLIFF.reward * 200, CLIFF.start)  # rewards to -1000
    if name == "positive":
        mdp = TabularMDP(CLIFF.transition, CLIFF.reward + 100, CLIFF.start)
    solution = solve_soft_bellman(mdp, beta)
    low, high = solution.theta_bounds
    assert solution.status is Status.CONVERGED
    assert high - low <= 1e-8 * np.ptp(mdp.reward)
    for name in ("policy", "value", "action_value", "reward_bias"):
        assert torch.isfinite(getattr(solution, name)).all()
    assert (solution.policy.sum(1) - 1).abs().max() < 1e-12
    prior = np.full(mdp.reward.shape, 0.25)
    assert objective(mdp, solution.policy.numpy(), prior, beta) == pytest.approx(
        -solution.theta, abs=1e-8 * np.ptp(mdp.reward)
    )


def test_theta_falls_with_beta_between_its_limits():
    """theta is minus the prior's reward rate as beta -> 0, and falls to minus the best rate."""
    thetas = [solve_soft_bellman(CLIFF, beta).theta for beta in BETAS]
    assert all(b < a for a, b in pairwise(thetas))
    assert thetas[0] == pytest.approx(-objective(CLIFF, UNIFORM, UNIFORM, 1.0), abs=2e-3)


# -- chains that are not one recurrent class -------------------------------------------------------------------


def two_ends():
    """0 leads to 1 or 2, which cannot be left."""
    return TabularMDP(
        [[[0, 0.5, 0.5]] * 2, [[0, 1, 0]] * 2, [[0, 0, 1]] * 2], np.array([[0, 0], [-1, -1], [-2, -2.0]]), [1, 0, 0]
    )


def test_several_ends_are_named():
    for solve in (solve_soft_bellman, solve_biasing):
        solution = solve(two_ends(), 1.0)
        assert solution.status is Status.REDUCIBLE
        assert "2 closed sets of states" in solution.message
        assert "[1]" in solution.message
        assert "[2]" in solution.message
        assert solution.theta_bounds[0] <= 1.5 <= solution.theta_bounds[1]


def test_transient_states_are_solved_by_soft_bellman_and_named_by_biasing():
    """0 -> 1 <-> 2 with prob. 1: the gain is that of {1, 2}, and V(0) = r(0) - g + V(1)."""
    p = np.array([[[0, 1.0, 0]], [[0, 0, 1.0]], [[0, 1.0, 0]]])
    mdp = TabularMDP(p, [[-5.0], [-1.0], [-2.0]], [1, 0, 0])
    solution = solve_soft_bellman(mdp, 2.0)
    assert solution.status is Status.CONVERGED
    assert solution.theta == pytest.approx(1.5, abs=1e-10)
    assert float(solution.value[0] - solution.value[1]) == pytest.approx(-5.0 + 1.5, abs=1e-9)
    assert solve_biasing(mdp, 2.0).status is Status.REDUCIBLE


@pytest.mark.parametrize("beta", [0.5, 1.0, 3.0, 10.0])
def test_a_transient_state_that_is_better_off_staying(beta):
    """0 may stay (reward 0, KL log 2) or fall into 1 (reward -1 for ever): theta* = min(1, log(2)/beta)."""
    mdp = TabularMDP([[[1, 0], [0, 1]], [[0, 1], [0, 1]]], [[0.0, 0.0], [-1.0, -1.0]], [1, 0])
    solution = solve_soft_bellman(mdp, beta)
    best = min(1.0, np.log(2) / beta)
    assert solution.theta_bounds[0] <= best + 1e-9
    assert best <= solution.theta_bounds[1]
    if beta < np.log(2):
        assert solution.status is Status.CONVERGED
    else:  # two gains: bounds cannot close; the policy is right, and the states are named
        assert solution.status is Status.REDUCIBLE
        assert "[1]" in solution.message
        assert "[0]" in solution.message
        assert solution.policy[0, 0] > 1 - 1e-12
        assert solution.theta_bounds[0] == pytest.approx(best, abs=1e-9)


def test_unreachable_states_keep_the_prior():
    p = np.zeros((4, 2, 4))
    p[0, :, 1] = p[1, :, 0] = p[2, :, 0] = p[3, :, 3] = 1.0
    mdp = TabularMDP(p, [[-1.0, -2.0], [-1.0, -3.0], [9.0, 0.0], [9.0, 9.0]], [1, 0, 0, 0])
    prior = np.tile([0.3, 0.7], (4, 1))
    for solve in (solve_soft_bellman, solve_biasing):
        solution = solve(mdp, 1.0, prior)
        assert solution.status is Status.CONVERGED  # 2 and 3, with all their reward, do not count
        np.testing.assert_allclose(solution.policy[2:], prior[2:])
        per_step = [np.log(prior[0] @ np.exp(r)) for r in (mdp.reward[0], mdp.reward[1])]
        assert solution.theta == pytest.approx(-np.mean(per_step), abs=1e-10)


def test_staying_away_for_ever():
    """A corner that earns more than the way back pays: the policy stays, though the start leads there rarely."""
    n = 12
    p = np.zeros((n, 2, n))
    for s in range(n):  # action 0: towards the start (earns -2); action 1: away from it
        p[s, 0, max(s - 1, 0)] = p[s, 1, min(s + 1, n - 1)] = 1.0
    mdp = TabularMDP(p, np.repeat(np.linspace(-2, -1, n)[:, None], 2, 1), np.eye(n)[0])
    for beta in BETAS:
        solution = solve_soft_bellman(mdp, beta)
        assert solution.status is Status.CONVERGED
        reward_rate = objective(mdp, solution.policy.numpy(), np.full((n, 2), 0.5), np.inf)
        assert -2 <= reward_rate <= -1
        if beta >= 100:
            assert reward_rate > -1.01


def test_periodic_chain():
    mdp = TabularMDP(np.roll(np.eye(6), 1, axis=1)[:, None, :].repeat(2, 1), np.tile([[0.0, -1.0]], (6, 1)))
    expected = -np.log(0.5 * (1 + np.exp(-3.0))) / 3.0
    for solve in (solve_soft_bellman, solve_biasing):
        assert solve(mdp, 3.0).theta == pytest.approx(expected, abs=1e-12)


# -- another target -----------------------------------------------------------------------------------------------


def test_target_dynamics_are_what_is_solved():
    rng = np.random.default_rng(0)
    known, target, prior = random_mdp(rng, 5, 3), random_mdp(rng, 5, 3), random_policy(rng, 5, 3)
    wanted = solve_soft_bellman(target, 4.0, prior)
    solution = solve_biasing(known, 4.0, prior, target=target)
    assert solution.status is Status.CONVERGED
    assert solution.theta == pytest.approx(wanted.theta, abs=1e-9)
    np.testing.assert_allclose(solution.policy, wanted.policy, atol=1e-8)
    first = next(iter(iterate_biasing(known, 4.0, prior, target=target)))
    alone = next(iter(iterate_biasing(known, 4.0, prior)))
    assert first.theta == pytest.approx(alone.theta, abs=1e-12)  # iteration 0 is the old problem
    # Its KL to the target, by hand: optimal dynamics ~ p exp(h), h = beta V_1.
    p, q = (m.transition.toarray().reshape(5, 3, 5) for m in (known, target))
    optimal = p * np.exp(4.0 * first.value)
    optimal /= optimal.sum(-1, keepdims=True)
    np.testing.assert_allclose(first.kl, (optimal * np.log(optimal / q)).sum(-1), atol=1e-10)
    with pytest.raises(InputError, match="target"):
        solve_biasing(known, 4.0, target=random_mdp(rng, 4, 3))


# -- eigenpairs and chains -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(20))
def test_perron_against_dense_eig(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 12))
    m = rng.random((n, n)) * (rng.random((n, n)) < 0.4) + np.roll(np.eye(n), 1, 1) * 0.1
    pair = perron(sp.csr_array(m))
    values, vectors = np.linalg.eig(m)
    top = np.argmax(values.real)
    vector = np.abs(vectors[:, top].real)
    assert pair.status is Status.CONVERGED
    assert pair.root == pytest.approx(values[top].real, rel=1e-12)
    np.testing.assert_allclose(pair.vector, vector / vector.max(), rtol=1e-8)
    assert pair.bounds[0] <= np.log(values[top].real) + 1e-13
    assert pair.bounds[1] - pair.bounds[0] < 1e-11


def test_perron_components_over_hundreds_of_decades():
    """A chain of states, each 1e-6 of the one before: y_i is known in closed form; 140 decades, far below eps."""
    n, step = 24, 1e-6
    m = sp.lil_array((n, n))
    m[0, 0], m[0, n - 1] = 1.0, step
    for i in range(1, n):
        m[i, i - 1] = step
    pair = perron(sp.csr_array(m))
    root = np.exp(pair.log_root)
    # y_i = (step/root)^i y_0, and (root - 1) y_0 = step y_{n-1}.
    np.testing.assert_allclose(pair.log_vector, np.arange(n) * (np.log(step) - np.log(root)), rtol=1e-12, atol=1e-12)


def test_perron_nearly_periodic_and_scaled():
    m = np.roll(np.eye(50), 1, 1)
    m[0, 0] = 1e-9
    for scale in (1.0, 1e-200, 1e200):
        pair = perron(sp.csr_array(m * scale))
        assert pair.status is Status.CONVERGED
        assert pair.log_root == pytest.approx(np.log(scale) + 1e-9 / 50, abs=1e-12)


def test_perron_names_what_it_cannot_solve():
    pair = perron(np.array([[1.0, 1.0], [0.0, 2.0]]))
    assert pair.status is Status.REDUCIBLE
    assert "2 classes" in pair.message
    for bad, message in ((np.ones((2, 3)), "square"), (-np.eye(2), ">= 0"), (np.full((2, 2), np.nan), "finite")):
        with pytest.raises(InputError, match=message):
            perron(bad)


@pytest.mark.parametrize("seed", range(5))
def test_regeneration_solves_the_poisson_equation(seed):
    rng = np.random.default_rng(seed)
    chain = policy_chain(random_mdp(rng, 7, 2), random_policy(rng, 7, 2)).transition
    c = rng.standard_normal(7)
    lu = RegenerativeLU(chain, 3)
    gain, w = lu.poisson(c)
    np.testing.assert_allclose(w + gain, c + chain @ w, atol=1e-13)
    d = lu.stationary()
    np.testing.assert_allclose(d @ chain.toarray(), d, atol=1e-14)
    assert gain == pytest.approx(d @ c, abs=1e-13)
    # Discounted: w + (1 - discount) x[ref] with x = c + discount K x.
    x = np.linalg.solve(np.eye(7) - 0.9 * chain.toarray(), c)
    gain, w = RegenerativeLU(chain, 3, 0.9).poisson(c)
    assert gain == pytest.approx(0.1 * x[3], abs=1e-12)
    np.testing.assert_allclose(w, x - x[3], atol=1e-12)


def test_regeneration_needs_a_state_that_is_reached():
    chain = sp.csr_array([[1.0, 0.0], [0.5, 0.5]])
    with pytest.raises(SingularChainError):
        RegenerativeLU(chain, 1)
    assert RegenerativeLU.adapted(chain, 1).ref == 0
    label, closed = classes(chain)
    assert closed[label].tolist() == [True, False]
    assert reachable_from(chain, np.array([1.0, 0.0])).tolist() == [True, False]


# -- interface ------------------------------------------------------------------------------------------------


def test_value_functions_are_equations_1_and_2():
    solution = solve_soft_bellman(CLIFF, 10.0)
    for n_steps in (0, 7):
        q, v = solution.value_functions(n_steps)
        np.testing.assert_allclose(q, solution.u.log() / 10 - solution.theta * n_steps, atol=1e-9)
        np.testing.assert_allclose(v, torch.log((solution.u * 0.25).sum(1)) / 10 - solution.theta * n_steps, atol=1e-9)
    # One step more costs theta: Q_N = r + E V_{N-1}.
    q, _ = solution.value_functions(1)
    _, v = solution.value_functions(0)
    np.testing.assert_allclose(q, CLIFF.reward + (CLIFF.transition @ v.numpy()).reshape(15, 4), atol=1e-9)
    learnt = AlgorithmS1(n_epochs=1, n_bias=1).fit(erl_torch.collect(CLIFF, 5, 100, 0), 15, 4)
    np.testing.assert_allclose(learnt.value_functions()[1], -learnt.psi.log() / 10)


def test_finite_horizon_distribution():
    d = induced_distribution(CLIFF, UNIFORM, 1000)
    assert d.sum() == pytest.approx(1, abs=1e-12)
    assert d @ CLIFF.reward[:, 0] == pytest.approx(reward_per_step(CLIFF, UNIFORM, 1000), abs=1e-12)
    np.testing.assert_allclose(
        induced_distribution(CLIFF, UNIFORM, 10**5), induced_distribution(CLIFF, UNIFORM), atol=1e-4
    )


def test_step_limits_are_reported_with_bounds_that_hold():
    for solve in (solve_soft_bellman, solve_biasing):
        solution = solve(CLIFF, 10.0, max_steps=1)
        assert solution.status is Status.STEP_LIMIT
        assert solution.theta_bounds[0] <= 1.0101363366 <= solution.theta_bounds[1]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (dict(beta=0.0), "beta=0.0"),
        (dict(beta=np.nan), "beta=nan"),
        (dict(beta=1.0, tol=0.0), "tol=0.0"),
        (dict(beta=1.0, max_steps=0), "max_steps=0"),
        (dict(beta=1.0, prior_policy=np.eye(15)[:, :4]), "prior_policy"),
    ],
)
def test_bad_arguments(arguments, message):
    for solve in (solve_soft_bellman, solve_biasing):
        with pytest.raises(InputError, match=message):
            solve(CLIFF, **arguments)


def test_problem_restricts_to_what_the_start_leads_to():
    problem = BellmanProblem.of(two_ends(), 1.0)
    assert problem.n_states == 3
    assert BellmanProblem.of(TabularMDP(two_ends().transition, two_ends().reward, [0, 1, 0]), 1.0).states.tolist() == [
        1
    ]


@pytest.mark.parametrize("refusals", [1, REFUSALS, REFUSALS + 1])
def test_perron_goes_on_after_a_chain_that_falls_apart(monkeypatch, refusals):
    """With a power step each time; in any case the bounds hold the root that numpy finds."""
    matrix = np.random.default_rng(0).random((5, 5)) + 0.1
    root = np.log(np.abs(np.linalg.eigvals(matrix)).max())
    monkeypatch.setattr(eigenpair, "STEPS_AFTER_A_REFUSAL", 1)
    monkeypatch.setattr(eigenpair, "POWER_STEPS", 0)
    adapted, met = RegenerativeLU.adapted, []

    def refuse(*arguments):
        met.append(arguments)
        if len(met) <= refusals:
            raise SingularChainError
        return adapted(*arguments)

    monkeypatch.setattr(RegenerativeLU, "adapted", refuse)
    found = perron(matrix)
    assert len(met) >= refusals
    assert found.status is (Status.CONVERGED if refusals <= REFUSALS else Status.STAGNATED)
    assert found.bounds[0] - 1e-14 <= root <= found.bounds[1] + 1e-14


def test_gains_that_are_no_numbers_bound_nothing():
    point = eigenpair._Point(np.zeros(2), np.array([0.5, np.nan]), sp.csr_array(np.eye(2)))
    assert point.bounds(2) == (-np.inf, np.inf)


def test_power_steps_are_not_caught_by_a_period():
    """M = [[0, a], [b, 0]]: the root is sqrt(ab), y(0)/y(1) = sqrt(a/b). M^2 is a multiple of I: plain steps go to and
    fro for ever."""
    a, b = 3.0, 0.2
    h, gain, chain = np.zeros(2), np.empty(2), np.empty(2)
    ptr, ind = np.array([0, 1, 2]), np.array([1, 0], np.int32)
    low, high = kernels.lazy_log_steps(ptr, ind, np.log([a, b]), h, gain, chain, 200, 1e-12)
    assert (low, high) == pytest.approx((np.log(a * b) / 2,) * 2, abs=1e-11)
    assert h[0] - h[1] == pytest.approx(np.log(a / b) / 2, abs=1e-11)


@pytest.mark.parametrize("n", [3, 40])
def test_superlu_in_an_order_of_its_own_solves_what_dense_algebra_solves(monkeypatch, n):
    """States that are left at rates of their own, in an order of elimination that is not theirs."""
    monkeypatch.setattr(chains, "MAX_OPERATIONS", -1)
    rng = np.random.default_rng(n)
    chain = np.roll(np.eye(n), 1, axis=1) + (rng.random((n, n)) < 2 / n) * rng.random((n, n))
    chain = chain / chain.sum(1, keepdims=True)
    chain += np.diag(rng.uniform(0, 20, n))
    chain = chain / chain.sum(1, keepdims=True)
    lu, c = RegenerativeLU(sp.csr_array(chain), 1), rng.standard_normal(n)
    assert not lu.elimination.fits
    assert n == 3 or (lu.elimination.rank != np.arange(n)).any()
    d = oracle.stationary(chain)
    np.testing.assert_allclose(lu.stationary(), d, rtol=1e-9)
    gain, w = lu.poisson(c, refine=False)
    assert gain == pytest.approx(d @ c, abs=1e-11)
    np.testing.assert_allclose(w + gain, c + chain @ w, atol=1e-10)
