"""Empirical models and certainty equivalence, against brute force and the exact solver."""

import re

import hypothesis
import mpmath
import numpy as np
import oracle
import pytest
import torch
from helpers import problems, random_stream
from hypothesis import strategies as st
from scipy.optimize import minimize_scalar

from erl_torch import (
    CertaintyEquivalence,
    InputError,
    Status,
    TabularMDP,
    Transitions,
    collect,
    empirical_mdp,
    solve_soft_bellman,
)
from erl_torch.envs.windy_cliff import WindyCliffEnv
from erl_torch.solvers.policy import objective

CLIFF = WindyCliffEnv().mdp


def tuples(*rows):
    """Rows (s, a, r, s')."""
    s, a, r, s_next = zip(*rows, strict=True)
    return Transitions(np.array(s), np.array(a), np.array(r, float), np.array(s_next), np.zeros(len(s), int))


@hypothesis.settings(max_examples=30)
@hypothesis.given(problem=problems(), noise=st.sampled_from((0.0, 1.0)))
def test_statistics_are_those_of_the_tuples(problem, noise):
    rng, mdp, _ = problem
    data = random_stream(rng, mdp, 200)
    data = Transitions(data.s, data.a, data.r + noise * rng.standard_normal(200), data.s_next, data.a_next)
    model = empirical_mdp(data, *mdp.reward.shape)
    p = model.transition.toarray().reshape(*mdp.reward.shape, -1)
    for s, a in np.ndindex(mdp.reward.shape):
        here = (data.s == s) & (data.a == a)
        assert model.visits[s, a] == here.sum()
        if here.any():
            np.testing.assert_allclose(p[s, a], np.bincount(data.s_next[here], minlength=mdp.n_states) / here.sum())
            assert model.reward[s, a] == pytest.approx(data.r[here].mean())
            variance = data.r[here].var(ddof=1) if here.sum() > 1 else 0.0
            assert model.reward_variance[s, a] == pytest.approx(variance, abs=1e-12)
            if not noise:
                assert model.reward[s, a] == data.r[here][0]  # to the last bit


def test_rewards_by_successor():
    model = empirical_mdp(tuples((0, 0, 1.0, 0), (0, 0, 3.0, 0), (0, 0, 5.0, 1), (1, 0, 0.0, 0)), 2, 1)
    np.testing.assert_array_equal(model.reward_given_next, [2.0, 5.0, 0.0])


@hypothesis.settings(max_examples=30)
@hypothesis.given(problem=problems(), beta=st.floats(0.1, 10.0))
def test_full_data_is_solved_as_the_model_it_shows(problem, beta):
    """Every pair visited: the exact solver on the frequencies gives the same policy and theta."""
    rng, mdp, prior = problem
    data = random_stream(rng, mdp, 3000)
    model = empirical_mdp(data, *mdp.reward.shape)
    hypothesis.assume(model.visits.all())
    exact = solve_soft_bellman(TabularMDP(model.transition, model.reward), beta, prior, tol=1e-12)
    found = CertaintyEquivalence(beta, prior_policy=prior).fit(data, *mdp.reward.shape)
    assert found.status is Status.CONVERGED
    assert found.theta == pytest.approx(exact.theta, abs=1e-9)
    np.testing.assert_allclose(found.policy, exact.policy, atol=1e-7)
    biasing = oracle.biasing_iterations(
        model.transition.toarray().reshape(*mdp.reward.shape, -1), model.reward, prior, beta, 12
    )[-1]
    assert found.theta == pytest.approx(biasing.theta, abs=1e-6)


def test_a_pair_never_visited_is_an_action_that_is_not_there():
    """Against the best of all policies that never take it, KL counted with the whole prior."""
    rng = np.random.default_rng(3)
    rows = [(s, a, -rng.random(), int(rng.integers(2))) for s in (0, 1) for a in (0, 1) for _ in range(20)]
    rows = [row for row in rows if row[:2] != (1, 1)]
    data, prior = tuples(*rows, (0, 0, -0.5, 1), (1, 0, -0.5, 0)), np.array([[0.3, 0.7], [0.4, 0.6]])
    found = CertaintyEquivalence(3.0, prior_policy=prior).fit(data, 2, 2)
    assert found.policy[1].tolist() == [1.0, 0.0]
    model = empirical_mdp(data, 2, 2)
    p = model.transition.toarray().reshape(2, 2, 2)
    p[1, 1] = p[1, 0]  # not taken
    mdp = TabularMDP(p, np.where(model.visits > 0, model.reward, 1e3))

    def loss(x):
        return -objective(mdp, np.array([[x, 1 - x], [1.0, 0.0]]), prior, 3.0)

    best = minimize_scalar(loss, bounds=(0, 1), method="bounded", options={"xatol": 1e-8})
    assert found.theta == pytest.approx(best.fun, abs=1e-12)
    assert found.policy[0, 0] == pytest.approx(best.x, abs=1e-7)
    assert found.u[1, 1] == 0
    weight = found.u.numpy() * prior
    np.testing.assert_allclose(found.policy, weight / weight.sum(1, keepdims=True), atol=1e-12)


def test_states_that_lead_nowhere_are_left_out_and_keep_the_prior():
    rows = [(0, 0, -1.0, 1), (1, 0, -1.0, 0), (0, 1, 0.0, 2), (2, 0, 0.0, 3)]  # 3 is never left, so neither is 2
    found = CertaintyEquivalence(1.0).fit(tuples(*rows), 4, 2)
    assert "[2]" in found.message
    np.testing.assert_array_equal(found.policy, [[1, 0], [1, 0], [0.5, 0.5], [0.5, 0.5]])
    # One action left of two, everywhere: KL = log 2 a step.
    assert found.theta == pytest.approx(1 + np.log(2))


def test_several_closed_sets_the_most_visited_is_solved():
    rows = [(0, 0, -1.0, 0)] * 2 + [(1, 0, -2.0, 2), (2, 0, -4.0, 1)] * 2
    found = CertaintyEquivalence(1.0).fit(tuples(*rows), 3, 1)
    assert found.status is Status.REDUCIBLE
    assert "[1, 2]" in found.message
    assert found.theta == pytest.approx(3.0)


def test_of_two_closed_sets_the_one_with_more_tuples_counts():
    """Not the one with more states."""
    rows = [(0, 0, -1.0, 0)] * 10 + [(1, 0, -2.0, 2), (2, 0, -4.0, 1)]
    found = CertaintyEquivalence(1.0).fit(tuples(*rows), 3, 1)
    assert "[0]" in found.message
    assert found.theta == pytest.approx(1.0)


def test_a_stream_without_cycles_is_refused():
    with pytest.raises(InputError, match="never returns"):
        CertaintyEquivalence().fit(tuples((0, 0, 0.0, 1)), 2, 1)


def test_interface():
    data, learner = collect(CLIFF, 20, 1000, 0), CertaintyEquivalence(10.0)
    (state,) = learner.iterate(data, 15, 4)
    solution = learner.fit(data, 15, 4)
    assert torch.equal(state.policy, solution.policy)
    assert state.metrics()["theta"] == solution.theta == solution.history["theta"][0]
    assert solution.n_steps == state.n_tuples == 20_000
    assert solution.theta_bounds is None  # nothing is proven of the true MDP
    start = learner.init(15, 4)
    assert learner.solution(start).status is Status.STOPPED
    assert (start.policy == 0.25).all()


def test_loss_falls_as_one_over_tuples():
    theta = solve_soft_bellman(CLIFF, 10.0).theta
    gaps = []
    for n in (200, 2000):
        fits = [CertaintyEquivalence().fit(collect(CLIFF, n, 1000, seed), 15, 4) for seed in range(6)]
        gaps.append(np.mean([-theta - objective(CLIFF, f.policy.numpy(), np.full((15, 4), 0.25), 10.0) for f in fits]))
    assert 0 <= gaps[1] < gaps[0] / 4


def test_a_stream_that_leaves_states_for_ever_has_the_theta_of_where_it_ends():
    """0 is better off never to leave, and is left at last: 1 pays 0, for log 2 of KL a step."""
    found = CertaintyEquivalence(5.0).fit(tuples((0, 0, 5.0, 0), (0, 1, 0.0, 1), (1, 0, 0.0, 1)), 2, 2)
    assert found.status is Status.REDUCIBLE
    assert found.theta == pytest.approx(np.log(2) / 5, abs=1e-12)
    assert "theta is that of the closed set" in found.message
    assert torch.isfinite(found.policy).all()
    s = [0] * 50 + [1] * 50  # an only action, which leaves 0 once in 50 steps: nothing is better than where it ends
    data = Transitions(s, [0] * 50 + [1] * 50, [1.0] * 49 + [0.0] * 51, [*s[1:], 1], [0] * 100)
    found = CertaintyEquivalence(5.0).fit(data, 2, 2)
    assert found.status is Status.CONVERGED
    assert found.theta == pytest.approx(np.log(2) / 5, abs=1e-9)


def test_short_random_streams_have_the_theta_of_one_class_or_say_why_not():
    """Against value iteration on the class that the counts end in."""
    rng, seen = np.random.default_rng(3), set()
    for _ in range(60):
        n_states, n = rng.integers(2, 5), rng.integers(3, 12)
        s = rng.integers(n_states, size=n + 1)
        data = tuples(*zip(s[:-1], rng.integers(2, size=n), rng.choice([0.0, 1.0, -2.0, 5.0], n), s[1:], strict=True))
        try:
            found = CertaintyEquivalence(2.0).fit(data, n_states, 2)
        except InputError:
            continue
        seen.add(found.status)
        model = empirical_mdp(data, n_states, 2)
        part = model.problem(2.0)
        p = part.problem.transition.toarray().reshape(part.problem.n_states, 2, -1)
        reach = np.linalg.matrix_power(p.any(1) + np.eye(len(p)), len(p)) > 0
        ends = [i for i in range(len(p)) if (reach[:, i] | ~reach[i]).all()]  # all that i leads to lead back
        ends = [i for i in ends if reach[np.flatnonzero(reach[i])][:, i].all()]
        best, _ = oracle.soft_optimum(
            p[np.ix_(ends, [0, 1], ends)], part.problem.reward[ends], part.problem.prior[ends].clip(1e-300), 2.0
        )
        assert found.theta == pytest.approx(-best, abs=1e-7)
        if found.status is Status.CONVERGED:  # no state is better off
            best, _ = oracle.soft_optimum(p, part.problem.reward, part.problem.prior.clip(1e-300), 2.0)
            assert found.theta == pytest.approx(-best, abs=1e-7)
            assert not part.reducible
        else:
            assert found.message
            assert part.reducible or len(ends) < len(p)
    assert {Status.CONVERGED, Status.REDUCIBLE} <= seen


def test_an_answer_that_is_not_solved_says_what_is_proven():
    """After one step; the optimum of the counts by value iteration."""
    data = collect(CLIFF, 100, 1000, 0)
    p, reward, _ = oracle.counted(data, 15, 4)
    best, _ = oracle.soft_optimum(p, reward, np.full((15, 4), 0.25), 10.0)
    found = CertaintyEquivalence(10.0, max_steps=1).fit(data, 15, 4)
    assert found.status is Status.STEP_LIMIT
    low, high = (float(x) for x in found.message.split("in the data, theta* in [")[1].rstrip("]").split(", "))
    assert low <= -best <= high
    assert high - low > 1e-3


def test_data_whose_closed_set_has_no_single_rate():
    """States 0 and 1 keep apart below optimism 0, and state 2 is left for ever: no theta, bounds in words."""
    s, a = [2, 2, 0, 0, 1, 1, 1, 1], [0, 1, 0, 1, 0, 0, 1, 1]
    r, after = [0.0, 0, 1, 1, 0, 0, 0, 0], [0, 0, 0, 1, 0, 1, 0, 1]
    found = CertaintyEquivalence(beta=10.0, optimism=-1.0).fit(Transitions(s, a, r, after, a), 3, 2)
    assert found.status is Status.NO_SINGLE_RATE
    assert found.theta is None
    assert re.search(r"-?\d", found.message)


@pytest.mark.parametrize("optimism", [10.0**-k for k in (3, 6, 9, 12, 14, 16, 20, 50, 90)])
@pytest.mark.parametrize("sign", [1, -1])
def test_rewards_that_count_together_are_continuous_at_optimism_0(optimism, sign):
    """theta(o) - theta(0) is of order o: a difference of logarithms lost all digits."""
    rng = np.random.default_rng(0)
    n = 1000
    s, a, after = rng.integers(3, size=n), rng.integers(2, size=n), rng.integers(3, size=n)
    data = Transitions(s, a, rng.normal(size=n) + s, after, a)
    plain = CertaintyEquivalence(5.0).fit(data, 3, 2).theta
    found = CertaintyEquivalence(5.0, reward_noise="joint", optimism=sign * optimism).fit(data, 3, 2).theta
    assert abs(found - plain) <= 20 * optimism + 1e-9


def test_rewards_that_count_together_are_their_certainty_equivalent():
    """One state and action: theta = -(1/kappa) log <exp(kappa r)>, by mpmath, near and far from the mean."""
    rng = np.random.default_rng(1)
    r = rng.normal(size=50) * 3 + 7
    data = Transitions([0] * 50, [0] * 50, r, [0] * 50, [0] * 50)
    for optimism in (1e-12, 1e-4, 0.05, 0.5, 1.0, 30.0, -1e-9, -0.3, -20.0):
        kappa = mpmath.mpf(optimism) * 2
        with mpmath.workdps(60):
            exact = mpmath.log(sum(mpmath.exp(kappa * mpmath.mpf(float(x))) for x in r) / 50) / kappa
        found = CertaintyEquivalence(2.0, reward_noise="joint", optimism=optimism).fit(data, 1, 1).theta
        assert found == pytest.approx(-float(exact), rel=1e-12)
