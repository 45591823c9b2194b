"""Biasing iterations at any optimism, against answers in many digits (``dial_digits``) and the dense page."""

import numpy as np
import pytest
from dial_digits import OPTIMISMS, Oracle, problem
from helpers import random_mdp
from mpmath import mpf
from test_dial_theory import random_problem, two_states

from erl_torch import InputError, Status, TabularMDP, iterate_biasing, solve_biasing, solve_soft_bellman


def many_digits(number, seed=1):
    """(MDP, problem as given, optimism, the oracle's answer)."""
    given, optimism = problem(seed, number)
    return TabularMDP(given.transition, given.reward), given, optimism, Oracle(given, optimism).solve()


@pytest.mark.parametrize("number", [*range(0, 40, 5), 24, 27])
def test_bounds_and_roots_in_many_digits(number):
    """theta_bounds of each iteration, and the side of theta* that -G(V) is on."""
    mdp, given, optimism, answer = many_digits(number)
    assert answer.met
    theta = -answer.low
    for state in iterate_biasing(mdp, given.beta, given.prior, max_steps=12, optimism=optimism):
        low, high = state.theta_bounds
        assert mpf(low) <= theta <= mpf(high)
        if state.status is Status.CONVERGED:
            assert np.sign(1 - optimism) * (float(theta) - state.theta) >= -1e-9 * (1 + np.ptp(state.value))


@pytest.mark.parametrize("number", [n for n in range(16) if OPTIMISMS[n % len(OPTIMISMS)] < 0])
def test_the_game_has_that_value(number):
    """Below optimism 0, what the agent can secure and what nature can hold it to meet where TV = V + g says."""
    _, given, optimism, answer = many_digits(number)
    secured, held = Oracle(given, optimism).game()
    assert abs(secured - answer.low) < mpf(10) ** -20
    assert abs(held - answer.high) < mpf(10) ** -20


@pytest.mark.parametrize("optimism", [o for o in OPTIMISMS if abs(o) < 5])
@pytest.mark.parametrize("seed", range(2))
def test_iterations_are_the_dense_ones(seed, optimism):
    """Value, theta, policy, and KL of the optimal dynamics to q_V, of the first iterations."""
    _, dense = random_problem(seed, optimism)
    mdp, v = TabularMDP(dense.p, dense.r), np.zeros(dense.n_states)
    for state in iterate_biasing(mdp, dense.beta, dense.prior, max_steps=3, optimism=optimism):
        assert state.theta == pytest.approx(-dense.root(v), abs=1e-9)
        new = dense.bias(v)
        y, q = np.exp(dense.beta * (new - v)), dense.tilt(v)
        mean = q @ y
        policy = dense.prior * np.exp(dense.beta * (dense.r + dense.sure(v))) * mean
        np.testing.assert_allclose(state.policy, policy / policy.sum(1, keepdims=True), atol=1e-8)
        best = q * y / mean[..., None]
        found = np.where(q > 0, best * np.log(np.where(q > 0, y / mean[..., None], 1.0)), 0.0).sum(-1)
        np.testing.assert_allclose(state.kl, found, atol=1e-7)
        np.testing.assert_allclose(state.value - state.value[0], new, atol=1e-7)
        v = new


@pytest.mark.parametrize("optimism", [3.0, 1.0, 0.5, -0.5, -1.0, -3.0])
@pytest.mark.parametrize("seed", range(2))
def test_both_routes_agree(seed, optimism):
    _, dense = random_problem(seed, optimism)
    mdp = TabularMDP(dense.p, dense.r)
    direct = solve_soft_bellman(mdp, dense.beta, dense.prior, optimism=optimism)
    biased = solve_biasing(mdp, dense.beta, dense.prior, optimism=optimism)
    assert direct.status is biased.status is Status.CONVERGED
    assert biased.optimism == optimism
    assert biased.theta == pytest.approx(direct.theta, abs=1e-8)
    np.testing.assert_allclose(biased.policy, direct.policy, atol=1e-7)
    assert (biased.k is None) == (optimism == 1)  # one iteration ends there, before the KL test can hold


def test_one_iteration_at_optimism_1():
    """It is U-learning: k counts the update that the KL test then finds needless."""
    mdp = random_mdp(np.random.default_rng(0), 5, 3)
    states = list(iterate_biasing(mdp, 2.0, max_steps=2, optimism=1.0))
    assert states[0].theta_bounds[1] - states[0].theta_bounds[0] < 1e-12
    assert states[1].kl.max() < 1e-12
    assert solve_biasing(mdp, 2.0, optimism=1.0).n_steps == 1


@pytest.mark.parametrize("optimism", [-30.0, -1000.0, 100.0])
@pytest.mark.parametrize("seed", range(2))
def test_far_ends_of_the_dial(seed, optimism):
    """|kappa| span V up to thousands, with full support: theta is between those of the best and the worst successor."""
    _, dense = random_problem(seed, optimism, dense=True)
    mdp = TabularMDP(dense.p, dense.r)
    solution = solve_biasing(mdp, dense.beta, dense.prior, optimism=optimism)
    assert solution.status is Status.CONVERGED
    value = solution.value.numpy()
    ends = value.max() if optimism > 0 else value.min()
    q = dense.r + ends  # every state is a successor
    top = q.max(1, keepdims=True)
    limit = (top[:, 0] + np.log((dense.prior * np.exp(dense.beta * (q - top))).sum(1)) / dense.beta) - value
    slack = -np.log(dense.p.min()) / abs(dense.kappa)
    assert limit.min() - slack <= -solution.theta <= limit.max() + slack


def test_without_a_single_rate():
    """The two states of docs/theory.md, 9.6."""
    problem = two_states(-0.1)
    solution = solve_biasing(TabularMDP(problem.p, problem.r), problem.beta, optimism=-0.1)
    assert solution.status is Status.NO_SINGLE_RATE
    low, high = solution.theta_bounds
    assert low <= -(1 - np.log(2) / 10) < -np.log(2) <= high


@pytest.mark.parametrize("optimism", [1.0, 0.5, -1.0])
def test_other_dynamics(optimism):
    """The dynamics known before enter iteration 0 alone, at any optimism."""
    rng = np.random.default_rng(3)
    known, target = random_mdp(rng, 5, 2), random_mdp(rng, 5, 2)
    found = solve_biasing(known, 2.0, target=target, optimism=optimism)
    best = solve_soft_bellman(target, 2.0, optimism=optimism)
    assert found.theta == pytest.approx(best.theta, abs=1e-9)
    np.testing.assert_allclose(found.policy, best.policy, atol=1e-8)


@pytest.mark.parametrize("optimism", [np.nan, np.inf, "much"])
def test_optimism_is_a_finite_number(optimism):
    mdp = random_mdp(np.random.default_rng(0), 2, 2)
    with pytest.raises(InputError, match="optimism"):
        solve_biasing(mdp, 1.0, optimism=optimism)
    with pytest.raises(InputError, match="optimism"):
        iterate_biasing(mdp, 1.0, optimism=optimism)
