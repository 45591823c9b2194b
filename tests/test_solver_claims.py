"""What the exact solvers prove, against dense oracles and closed forms, where a plain run would not show a mistake."""

from dataclasses import replace
from fractions import Fraction

import numpy as np
import oracle
import pytest
import torch
from helpers import random_mdp, random_policy
from many_digits import problem

from erl_torch import InputError, Status, TabularMDP, certify, iterate_biasing, solve_biasing, solve_soft_bellman
from erl_torch.solvers import soft_bellman
from erl_torch.solvers.biasing import PATIENCE
from erl_torch.solvers.horizons import Backup
from erl_torch.solvers.newton import NewtonPattern
from erl_torch.solvers.problem import BellmanProblem
from erl_torch.solvers.result import exact_solution
from erl_torch.solvers.soft_bellman import with_bounds


def dense(mdp):
    return mdp.transition.toarray().reshape(*mdp.reward.shape, -1)


@pytest.mark.parametrize("seed", range(6))
def test_the_gap_is_of_the_policy_whatever_proved_the_bounds(seed):
    """Bounds on theta* may be tight where the value in hand, and so its policy, is poor."""
    rng = np.random.default_rng(seed)
    mdp, prior, beta = random_mdp(rng, 4, 3), random_policy(rng, 4, 3), 5.0
    p = dense(mdp)
    theta = oracle.biasing_iterations(p, mdp.reward, prior, beta, 25)[-1].theta
    value = rng.standard_normal(4)
    backed_up, policy = oracle.backup(p, mdp.reward, prior, beta, value)
    bounds = theta - 1e-9, theta + 1e-9
    found = exact_solution(mdp, BellmanProblem.of(mdp, beta, prior), value, Status.STEP_LIMIT, 1, bounds, prior)
    np.testing.assert_allclose(found.policy, policy, rtol=1e-12)
    loss = -theta - oracle.worth(p, mdp.reward, prior, beta, policy)
    assert loss > 1e-3
    assert loss <= found.gap + 1e-9
    assert found.gap <= np.ptp(backed_up - value) + 1e-8


@pytest.mark.parametrize("seed", range(6))
def test_a_certified_gap_counts_from_the_end_that_no_policy_passes(seed):
    """g* is at most -theta_bounds[0]; with wide bounds the other end would claim less than is lost."""
    rng = np.random.default_rng(seed)
    mdp, prior, beta = random_mdp(rng, 5, 3), random_policy(rng, 5, 3), 20.0
    p, policy = dense(mdp), random_policy(rng, 5, 3)
    theta = oracle.biasing_iterations(p, mdp.reward, prior, beta, 25)[-1].theta
    wide = solve_soft_bellman(mdp, beta, prior, max_steps=1)
    low, high = wide.theta_bounds
    assert low + 1e-4 < theta < high - 1e-7
    j = oracle.worth(p, mdp.reward, prior, beta, policy)
    found = certify(replace(wide, policy=torch.from_numpy(policy)), mdp, beta, prior, best=wide)
    assert found.gap >= -theta - j
    assert found.gap == pytest.approx(-low - j, abs=1e-9)


@pytest.mark.parametrize(("seed", "sizes", "beta"), [(130, (5, 2), 20.0), (281, (5, 2), 5.0), (356, (3, 2), 1.0)])
def test_bounds_of_biasing_iterations_are_the_best_so_far(seed, sizes, beta):
    """What a new value proves by itself is at times less than what was proven before."""
    rng = np.random.default_rng(seed)
    rng.integers(3, 7), rng.integers(2, 4)
    p = rng.dirichlet(np.full(sizes[0], (0.5, 0.1, 0.03)[seed % 3]), size=sizes) + 1e-9
    mdp = TabularMDP(p / p.sum(-1, keepdims=True), -rng.random(sizes))
    p, prior = dense(mdp), random_policy(rng, *sizes)
    proven = []
    for state in iterate_biasing(mdp, beta, prior, max_steps=6):
        gains = oracle.backup(p, mdp.reward, prior, beta, state.value)[0] - state.value
        proven.append((-gains.max(), -gains.min()))
        best = max(low for low, _ in proven), min(high for _, high in proven)
        np.testing.assert_allclose(state.theta_bounds, best, atol=1e-11)
    assert any(high > before + 1e-3 for (_, high), (_, before) in zip(proven[1:], proven, strict=False))


@pytest.mark.parametrize("n", [3, 8, 30])
@pytest.mark.parametrize("back", [1e-9, 1e-12])
def test_the_cut_is_moved_off_a_state_that_is_hardly_ever_met(n, back):
    """A walk away from 0 that goes back with probability ``back``: cut at 0, all digits are lost.

    M = diag(w) P with w = y/(P y) has the eigenvector y and the root 1, whatever y is.
    """
    p = np.zeros((n, n))
    for s in range(n):
        p[s, max(s - 1, 0)] += back
        p[s, min(s + 1, n - 1)] += 1 - 2 * back
        p[s, s] += back
    log_y = np.random.default_rng(n).standard_normal(n)
    mdp = TabularMDP(p[:, None] / p.sum(1)[:, None, None], np.zeros((n, 1)), np.eye(n)[0])
    log_weight = log_y - np.log(dense(mdp)[:, 0] @ np.exp(log_y))
    found = NewtonPattern.of(BellmanProblem.of(mdp, 1.0)).eigenvector(
        log_weight[:, None], np.log(mdp.transition.data), 0, 1e-13, 60
    )
    assert found is not None
    h, (low, high), _ = found
    np.testing.assert_allclose(h - h[0], log_y - log_y[0], atol=1e-11)
    assert low <= 1e-15
    assert high >= -1e-15
    assert high - low < 1e-12


def test_a_tilted_row_is_as_defined():
    """log <exp h>, p exp(h)/<exp h> and its KL to p, also where exp(h) is beyond doubles."""
    rng = np.random.default_rng(0)
    p = rng.dirichlet(np.ones(5), size=(4, 2))
    problem = BellmanProblem.of(TabularMDP(np.concatenate([p, p[:1]]), np.zeros((5, 2))), 1.0)
    for h in (rng.standard_normal(5), 1e4 + 300 * rng.standard_normal(5)):
        log_mean, kl, tilted = problem.tilt(h)
        rows = problem.transition.toarray()
        log_terms = np.log(rows) + h
        expected = np.logaddexp.reduce(log_terms, axis=1)
        np.testing.assert_allclose(log_mean, expected, rtol=1e-13)
        log_tilted = log_terms - expected[:, None]
        np.testing.assert_allclose(tilted.reshape(10, 5), np.exp(log_tilted), rtol=1e-9, atol=1e-300)
        np.testing.assert_allclose(kl, (np.exp(log_tilted) * (log_tilted - np.log(rows))).sum(1), rtol=1e-9)


def moving(to, reward):
    """One action; state s leads to to[s]."""
    return TabularMDP(np.eye(len(to))[to][:, None], np.array(reward)[:, None])


def test_the_model_known_before_needs_one_class_as_the_target_does():
    """Known: 0 stays, 1 goes to 0. Target: they take turns, theta* -1/2."""
    known, target = moving([0, 0], [0.0, 1.0]), moving([1, 0], [0.0, 1.0])
    with pytest.raises(InputError, match=r"known before, beside target: once in the closed set \[0\]"):
        iterate_biasing(known, 1.0, target=target)
    found = solve_biasing(known, 1.0, target=target)
    assert found.status is Status.REDUCIBLE
    assert found.theta is None
    assert found.rho is None
    assert found.theta_bounds[0] <= -0.5 <= found.theta_bounds[1]
    assert solve_biasing(target, 1.0, target=target).theta == pytest.approx(-0.5, abs=1e-12)


def test_a_target_on_other_states_is_refused():
    """From 0 the known model leads to 1, the target stays."""
    p = np.array([[[0.0, 1.0]], [[1.0, 0.0]]])
    stays = np.array([[[1.0, 0.0]], [[1.0, 0.0]]])
    start = [1.0, 0.0]
    known, target = TabularMDP(p, np.zeros((2, 1)), start), TabularMDP(stays, np.zeros((2, 1)), start)
    with pytest.raises(InputError, match="the same states"):
        solve_biasing(known, 1.0, target=target)


def test_at_the_first_iteration_with_small_kl_the_bounds_say_whether_it_has_converged():
    """One action: iteration 0 is exact, its KL 0 where the rewards are equal; CONVERGED wins over STOPPED."""
    found = solve_biasing(moving([1, 0], [1.0, 1.0]), 1.0, stop="kl")
    assert found.status is Status.CONVERGED
    assert found.k == 0
    assert found.theta == pytest.approx(-1, abs=1e-12)


def test_an_eigenvector_beyond_doubles_ends_the_iteration():
    """Two states that are left with weight 1e-12 exp(-4e9): Newton's chain falls apart, and every iteration adds no
    more than a power step does. The first gives the bounds, PATIENCE others nothing."""
    t = np.zeros((2, 2, 2))
    t[:, 0] = np.eye(2)
    t[:, 1] = [[1 - 1e-12, 1e-12], [1e-12, 1 - 1e-12]]
    mdp = TabularMDP(t, [[0.3, -1e9], [0.2, -1e9]])
    states = list(iterate_biasing(mdp, 4.0))
    assert all(state.status is not Status.CONVERGED for state in states)
    assert len(states) == 1 + PATIENCE
    # Apart, the states earn .3 - log(2)/4 and .2 - log(2)/4; leaving never pays.
    assert states[-1].theta_bounds[0] <= -(0.3 - np.log(2) / 4) <= states[-1].theta_bounds[1]
    found = solve_biasing(mdp, 4.0)
    assert found.status is Status.STAGNATED
    assert found.n_steps == len(states)


@pytest.mark.filterwarnings("ignore::erl_torch.notes.Note")
def test_a_lost_eigenvector_may_come_back_while_the_dynamics_change():
    """Nine states, three actions: no eigenvector in the first seven iterations, whose bounds are those of the first."""
    given = problem(4, 493)
    mdp = TabularMDP(given.transition, given.reward, given.start)
    states = list(iterate_biasing(mdp, given.beta, given.prior, max_steps=1 + PATIENCE))
    assert all(state.status is not Status.CONVERGED for state in states)
    found = solve_biasing(mdp, given.beta, given.prior)
    assert found.status is Status.CONVERGED
    assert found.theta == pytest.approx(solve_soft_bellman(mdp, given.beta, given.prior).theta, abs=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_where_an_eigenvector_is_too_coarse_the_value_is_polished(seed):
    """At beta 1e-8 a rounding of log(y) is one of 1e-8 in V = log(y)/beta: Newton steps on V itself take that off."""
    mdp, beta = random_mdp(np.random.default_rng(seed), 3, 2), 1e-8
    *_, last = iterate_biasing(mdp, beta)
    found = solve_biasing(mdp, beta)
    assert last.theta_bounds[1] - last.theta_bounds[0] > 1e-9
    assert found.status is Status.CONVERGED
    # As beta vanishes the prior is optimal; r varies by a few units.
    share = oracle.stationary(dense(mdp).mean(1))
    assert found.theta == pytest.approx(-share @ mdp.reward.mean(1), abs=1e-6)


def test_a_gap_is_not_below_the_loss_where_the_difference_rounds_down():
    """One state, one action: J = -2^-60 and g* at most 1, so the loss may be 1 + 2^-60, which rounds to 1."""
    mdp = TabularMDP([[[1.0]]], [[-(2.0**-60)]])
    gap = with_bounds(solve_soft_bellman(mdp, 1.0), BellmanProblem.of(mdp, 1.0), (-1.0, 1.0), mdp).gap
    assert gap is not None
    assert 1 + Fraction(1, 2**60) <= Fraction(gap) < 1 + Fraction(1, 2**50)


def test_a_poor_value_does_not_spoil_the_gap_of_its_policy():
    """One action: whatever V is, the policy loses nothing; the gains of V alone would say that it may lose 100."""
    mdp = moving([1, 0], [0.0, 1.0])
    found = exact_solution(mdp, BellmanProblem.of(mdp, 1.0), np.array([0.0, 100.0]), Status.STEP_LIMIT, 1, (-0.5, -0.5))
    assert 0 <= found.gap < 1e-12


def test_the_state_with_the_narrowest_bounds_is_kept(monkeypatch):
    """A last step that made the bounds wider does not count, neither in the iteration nor in polishing it."""
    rng = np.random.default_rng(3)
    mdp = random_mdp(rng, 4, 3)
    problem = BellmanProblem.of(mdp, 5.0)
    good = solve_soft_bellman(mdp, 5.0)
    value = good.value.numpy()
    states = [Backup(problem).state(v, i + 1, np.inf) for i, v in enumerate((0.9 * value, value + 1.0, 0 * value))]
    monkeypatch.setattr(soft_bellman, "iterate_soft_bellman", lambda *_: iter(states))
    found = soft_bellman.solve_problem(problem, mdp)
    np.testing.assert_allclose(found.policy, good.policy, atol=1e-9)
    monkeypatch.setattr(soft_bellman, "undiscounted", lambda *_: iter(states))
    kept, bounds = soft_bellman.polish(problem, np.zeros(4), (-np.inf, np.inf), 1e-300)
    np.testing.assert_array_equal(kept, states[1].value)
    assert bounds[1] - bounds[0] <= states[1].width


@pytest.mark.parametrize("seed", range(20))
def test_bounds_of_another_problem_prove_nothing(seed):
    """Whatever ``best`` is of, what is returned holds for the problem that is asked about, or it is refused."""
    rng = np.random.default_rng(seed)
    mdp, other = random_mdp(rng, 4, 3), random_mdp(rng, 4, 3)
    near = TabularMDP(mdp.transition, mdp.reward + 10.0 ** rng.uniform(-12, 0), mdp.start)
    exact = solve_soft_bellman(mdp, 5.0)
    own = replace(exact, policy=torch.from_numpy(random_policy(rng, 4, 3)))
    loss = certify(own, mdp, 5.0).gap
    for best in (solve_soft_bellman(one, 5.0) for one in (other, near)):
        try:
            found = certify(own, mdp, 5.0, best=best)
        except InputError as error:
            assert "best" in str(error)  # noqa: PT017 (refused, or right)
            continue
        low, high = found.theta_bounds
        assert low <= exact.theta_bounds[1]
        assert exact.theta_bounds[0] <= high
        assert found.gap >= loss - 1e-9
    with pytest.raises(InputError, match="best=of 5 states"):
        certify(own, mdp, 5.0, best=solve_soft_bellman(random_mdp(rng, 5, 3), 5.0))
