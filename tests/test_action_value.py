"""The baselines of Algorithm S1 against their equations: slow twins, exact solvers, the optimistic eigenproblem."""

import math
from typing import Any

import hypothesis
import numpy as np
import oracle
import pytest
import scipy.sparse as sp
import torch
from helpers import problems, random_stream
from hypothesis import strategies as st

from erl_torch import InputError, Status, TabularMDP, Transitions, collect, solve_soft_bellman
from erl_torch.envs.windy_cliff import WindyCliffEnv
from erl_torch.learners import LEARNERS, DifferentialSoftQ, QLearning, RVISoftQ, Sarsa, SoftQ, ULearning, ZLearning
from erl_torch.learners.action_value import kernels as action_value_kernels
from erl_torch.solvers import kernels as solvers_kernels
from erl_torch.solvers.chains import RegenerativeLU
from erl_torch.solvers.optimum import measure, solve_optimum

AVERAGE = (DifferentialSoftQ, RVISoftQ)
OPTIMISTIC = (ULearning, ZLearning)
DISCOUNTED = (SoftQ, QLearning, Sarsa)
ALL = AVERAGE + OPTIMISTIC + DISCOUNTED


def even_mdp(rng, n_states=4, n_actions=2, n_next=3):
    """Every (s,a) leads to ``n_next`` draws of s' with equal probability: (MDP, every tuple once)."""
    s_next = rng.integers(n_states, size=(n_states, n_actions, n_next))
    s_next[..., 0] = (np.arange(n_states)[:, None] + 1) % n_states  # irreducible
    p = (s_next[..., None] == np.arange(n_states)).mean(2)
    reward = -rng.random((n_states, n_actions))
    s, a, _ = (index.ravel() for index in np.indices(s_next.shape))
    return TabularMDP(p, reward), Transitions(s, a, reward[s, a], s_next.ravel(), np.zeros(s.size, int))


def long_stream(rng, once, n_tiles=20_000):
    """``once`` over and over, in a new order each time: averages exact, steps small at the end."""
    order = rng.permuted(np.tile(np.arange(len(once)), (n_tiles, 1)), axis=1).ravel()
    return Transitions(*(getattr(once, name)[order] for name in ("s", "a", "r", "s_next", "a_next")))


def deterministic_mdp(rng):
    return even_mdp(rng, n_next=1)


# -- slow twins -----------------------------------------------------------------------------------------


def slow_value(learner, q, visits, prior):
    if not (visits > 0).any():
        return 0.0
    q, prior = q[visits > 0], prior[visits > 0] / prior[visits > 0].sum()
    if isinstance(learner, QLearning):
        return q.max()
    weight = prior * np.exp(learner.beta * (q - q.max()))
    if isinstance(learner, Sarsa):
        return (weight * q).sum() / weight.sum()
    return q.max() + np.log(weight.sum()) / learner.beta


def slow(learner, data, n_states, n_actions, prior):
    """(q, visits, rate) after n_epochs, a tuple at a time, as the module's docstring has it."""
    if isinstance(learner, ZLearning):  # one action a state
        data = Transitions(data.s, 0 * data.a, data.r, data.s_next, data.a_next)
        n_actions, prior = 1, np.ones((n_states, 1))
    beta = learner.beta
    q, visits, rate = np.zeros((n_states, n_actions)), np.zeros((n_states, n_actions)), 0.0
    lr_rate = getattr(learner, "lr_rate", 0.0)
    lr_rate = 1 / q.size if lr_rate is None else lr_rate
    for _ in range(learner.n_epochs):
        for s, a, r, s_next in zip(data.s, data.a, data.r, data.s_next, strict=True):
            target = (
                r
                - rate
                + getattr(learner, "discount", 1.0) * slow_value(learner, q[s_next], visits[s_next], prior[s_next])
            )
            visits[s, a] += 1
            before = q[s, a]
            step = 1 / visits[s, a] ** learner.power
            with np.errstate(divide="ignore"):  # log 0 at the first visit
                if isinstance(learner, OPTIMISTIC):
                    q[s, a] = np.logaddexp(np.log(1 - step) + beta * q[s, a], np.log(step) + beta * target) / beta
                    error = beta * (target - q[s, a])
                    rate += np.logaddexp(np.log(1 - lr_rate * step), np.log(lr_rate * step) + error) / beta
                else:
                    q[s, a] = (1 - step) * q[s, a] + step * target
                    rate += lr_rate * (q[s, a] - before)
            if isinstance(learner, RVISoftQ) and s == learner.reference:
                rate = slow_value(learner, q[s], visits[s], prior[s])
    return q, visits, rate


@hypothesis.settings(max_examples=30)
@hypothesis.given(
    problem=problems(),
    learner_class=st.sampled_from(ALL),
    beta=st.floats(0.1, 30.0),
    power=st.floats(0.51, 1.0),
)
def test_compiled_is_the_slow_twin(problem, learner_class, beta, power):
    rng, mdp, prior = problem
    sizes = mdp.n_states, mdp.n_actions
    data = random_stream(rng, mdp, 150)
    options = {"reference": int(data.s[7])} if learner_class is RVISoftQ else {}
    learner = learner_class(beta=beta, power=power, n_epochs=2, prior_policy=prior, **options)
    *_, state = learner.iterate(data, *sizes)
    q, visits, rate = slow(learner, data, *sizes, prior)
    if learner_class is ZLearning:
        np.testing.assert_allclose(state.value, q[:, 0], rtol=1e-12, atol=1e-12)
        np.testing.assert_array_equal(state.state_visits, visits[:, 0])
    else:
        np.testing.assert_allclose(state.q, q, rtol=1e-12, atol=1e-12)
        np.testing.assert_array_equal(state.visits, visits)
    if state.rate is not None:
        assert state.rate == pytest.approx(rate, rel=1e-12, abs=1e-12)


def test_read_out_of_z_learning_is_the_mean_over_visits():
    rng = np.random.default_rng(3)
    mdp, once = even_mdp(rng)
    state: Any
    *_, state = ZLearning(beta=2.0, n_epochs=2).iterate(once, mdp.n_states, mdp.n_actions)
    z, p = np.exp(2.0 * state.value.numpy()), mdp.transition.toarray()
    u = np.exp(2.0 * (mdp.reward - state.rate)) * (p @ z).reshape(mdp.reward.shape)
    np.testing.assert_allclose(state.q, np.log(u) / 2.0, rtol=1e-12)
    np.testing.assert_allclose(state.policy, u / u.sum(1, keepdims=True), rtol=1e-12)


@pytest.mark.parametrize("x", [-1e4, -800.0, -3.0, -1e-12, 0.0, 1e-12, 2.0, 800.0, 1e4])
@pytest.mark.parametrize("step", [1e-9, 0.3, 1.0])
def test_log_mix(x, step):
    if step == 1.0:
        expected = x
    elif abs(x) < 1e-9:
        expected = step * x
    else:
        expected = np.logaddexp(math.log1p(-step), math.log(step) + x)
    assert action_value_kernels.log_mix(x, step) == pytest.approx(expected, rel=1e-6, abs=1e-24)


# -- fixed points -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("learner_class", AVERAGE)
@pytest.mark.parametrize("seed", [0, 1])
def test_average_reward_learners_solve_the_soft_bellman_equation(learner_class, seed):
    rng = np.random.default_rng(seed)
    mdp, once = even_mdp(rng)
    exact = solve_soft_bellman(mdp, 3.0)
    found = learner_class(beta=3.0, power=0.8, n_epochs=1).fit(long_stream(rng, once), 4, 2)
    assert found.status is Status.COMPLETED
    assert found.theta == pytest.approx(exact.theta, abs=1e-3)
    np.testing.assert_allclose(found.policy, exact.policy, atol=1e-3)
    np.testing.assert_allclose(found.value - found.value[0], exact.value - exact.value[0], atol=1e-3)
    assert (
        oracle.biasing_iterations(mdp.transition.toarray().reshape(4, 2, 4), mdp.reward, np.full((4, 2), 0.5), 3.0, 1)[
            0
        ].theta
        < exact.theta - 0.005
    )  # so the two families are told apart


@pytest.mark.parametrize("learner_class", OPTIMISTIC)
@pytest.mark.parametrize("seed", [0, 1])
def test_optimistic_learners_solve_iteration_0(learner_class, seed):
    rng = np.random.default_rng(seed)
    mdp, once = even_mdp(rng)
    p = mdp.transition.toarray().reshape(4, 2, 4)
    (exact,) = oracle.biasing_iterations(p, mdp.reward, np.full((4, 2), 0.5), 3.0, 1)
    found = learner_class(beta=3.0, power=0.8, n_epochs=1).fit(long_stream(rng, once), 4, 2)
    assert found.theta == pytest.approx(exact.theta, abs=1e-3)
    assert found.rho == pytest.approx(exact.rho, rel=4e-3)
    np.testing.assert_allclose(found.policy, exact.policy, atol=1e-3)
    np.testing.assert_allclose(found.u / found.u.sum(), exact.u / exact.u.sum(), atol=1e-3)


@pytest.mark.parametrize("learner_class", AVERAGE + OPTIMISTIC)
def test_all_agree_where_dynamics_are_deterministic(learner_class):
    rng = np.random.default_rng(5)
    mdp, once = deterministic_mdp(rng)
    p = np.zeros((4, 2, 4))
    p[once.s, once.a, once.s_next] = 1
    p[0, 1] = [0, 0, 0, 1]  # a second cycle: aperiodic, and something to choose
    mdp = TabularMDP(p, mdp.reward)
    s, a = np.indices((4, 2)).reshape(2, -1)
    once = Transitions(s, a, mdp.reward[s, a], p[s, a].argmax(1), 0 * s)
    exact = solve_soft_bellman(mdp, 3.0)
    found = learner_class(beta=3.0, power=0.8, n_epochs=1).fit(long_stream(rng, once), 4, 2)
    assert found.theta == pytest.approx(exact.theta, abs=1e-3)
    np.testing.assert_allclose(found.policy, exact.policy, atol=1e-3)


def discounted_fixed_point(mdp, learner, prior):
    """Dense value iteration, from the definitions."""
    p, beta = mdp.transition.toarray().reshape(*mdp.reward.shape, -1), learner.beta
    q = np.zeros_like(mdp.reward)
    for _ in range(400):
        policy = prior * np.exp(beta * q)
        value = {
            SoftQ: np.log(policy.sum(1)) / beta,
            QLearning: q.max(1),
            Sarsa: (policy * q).sum(1) / policy.sum(1),
        }[type(learner)]
        q = mdp.reward + learner.discount * p @ value
    return q


@pytest.mark.parametrize("learner_class", DISCOUNTED)
@pytest.mark.parametrize("seed", [0, 1])
def test_discounted_learners_solve_their_equation(learner_class, seed):
    rng = np.random.default_rng(seed)
    mdp, once = even_mdp(rng)
    prior = rng.dirichlet([3.0, 3.0], size=4)
    learner = learner_class(beta=3.0, discount=0.8, power=0.8, n_epochs=1, prior_policy=prior)
    *_, state = learner.iterate(long_stream(rng, once), 4, 2)
    q = discounted_fixed_point(mdp, learner, prior)
    np.testing.assert_allclose(state.q, q, atol=2e-3)
    weight = prior * np.exp(3.0 * q)
    np.testing.assert_allclose(state.policy, weight / weight.sum(1, keepdims=True), atol=2e-3)
    assert state.theta is None
    assert "theta" not in state.metrics()
    others = [
        discounted_fixed_point(mdp, c(beta=3.0, discount=0.8), prior) for c in DISCOUNTED if c is not learner_class
    ]
    assert min(np.abs(q - other).max() for other in others) > 0.02  # three different problems


def test_soft_q_goes_to_the_average_reward_policy():
    mdp, _ = even_mdp(np.random.default_rng(2))
    uniform = np.full((4, 2), 0.5)
    exact = solve_soft_bellman(mdp, 3.0).policy.numpy()
    errors = []
    for discount in (0.5, 0.9, 0.98):
        q = discounted_fixed_point(mdp, SoftQ(beta=3.0, discount=discount), uniform)
        weight = np.exp(3.0 * (q - q.max(1, keepdims=True)))
        errors.append(np.abs(weight / weight.sum(1, keepdims=True) - exact).max())
    assert errors[2] < 0.3 * errors[1] < 0.3 * errors[0]


# -- the cliff --------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def cliff():
    mdp = WindyCliffEnv().mdp
    return mdp, collect(mdp, 20, 1000, seed=0)


@pytest.mark.parametrize("learner_class", ALL)
@pytest.mark.parametrize("beta", [0.1, 1.0, 50.0, 200.0])
def test_any_beta_on_the_cliff(cliff, learner_class, beta):
    mdp, data = cliff
    found = learner_class(beta=beta, n_epochs=2).fit(data, 15, 4)
    assert found.status is Status.COMPLETED
    assert torch.isfinite(found.policy).all()
    np.testing.assert_allclose(found.policy.sum(1), 1.0, rtol=1e-12)
    assert torch.isfinite(found.action_value).all()
    if found.theta is not None:
        assert 0.0 < found.theta < 5.0  # the rewards lie in [-5, 0]
    measured = measure(mdp, solve_optimum(mdp, beta), found, beta)
    assert 0.0 <= measured["gap"] < 6.0
    assert math.isnan(measured["theta_error"]) == (found.theta is None)


def test_one_pass_of_differential_soft_q_on_the_cliff(cliff):
    """500,000 tuples, step n**-0.6: measured gap 1e-4, where Algorithm S1 as published has 2e-3."""
    mdp, _ = cliff
    best = solve_optimum(mdp, 10.0)
    data = collect(mdp, 500, 1000, seed=1)
    gap = {
        c: measure(mdp, best, c(n_epochs=1).fit(data, 15, 4), 10.0)["gap"]
        for c in (DifferentialSoftQ, RVISoftQ, ULearning)
    }
    assert gap[DifferentialSoftQ] < 2e-4
    assert gap[RVISoftQ] < 2e-4
    assert gap[ULearning] > 0.05


def test_the_reference_is_the_state_visited_most():
    rng = np.random.default_rng(0)
    s = np.array([2] * 60 + [0] * 30 + [1] * 10)
    data = Transitions(s, rng.integers(2, size=100), -rng.random(100), rng.integers(3, size=100), 0 * s)
    *_, chosen = RVISoftQ(beta=2.0, n_epochs=2).iterate(data, 3, 2)
    for reference in range(3):
        *_, given = RVISoftQ(beta=2.0, n_epochs=2, reference=reference).iterate(data, 3, 2)
        assert torch.equal(given.q, chosen.q) == (reference == 2)


# -- what a learner does with gaps and bad input ---------------------------------------------------------


@pytest.mark.parametrize("learner_class", ALL)
def test_actions_never_taken_keep_their_prior_share(learner_class):
    prior = np.array([[0.2, 0.3, 0.5], [0.2, 0.2, 0.6], [0.1, 0.1, 0.8]])
    data = Transitions([0, 0, 1, 0], [0, 1, 0, 0], [-1.0, -2.0, -3.0, -1.0], [1, 1, 0, 2], [0, 0, 0, 0])
    policy = learner_class(beta=1.0, prior_policy=prior).fit(data, 3, 3).policy.numpy()
    np.testing.assert_allclose(policy[0, 2], 0.5, rtol=1e-12)
    np.testing.assert_allclose(policy[1:], prior[1:], rtol=1e-12)
    assert policy[0, 0] > 0.2


@pytest.mark.parametrize("learner_class", ALL)
def test_overflow_ends_with_a_status(learner_class):
    data = Transitions([0, 0], [0, 0], [1e308, -1e308], [0, 0], [0, 0])
    found = learner_class(n_epochs=3).fit(data, 1, 1)
    assert found.status is Status.NON_FINITE
    assert "overflows" in found.message
    assert torch.isfinite(found.policy).all()
    assert found.theta is None or math.isfinite(found.theta)


@pytest.mark.parametrize(
    ("learner_class", "options", "message"),
    [
        (DifferentialSoftQ, {"beta": 0.0}, "beta=0.0: must be"),
        (DifferentialSoftQ, {"power": 0.5}, r"power=0.5: must be a number in \(0.5, 1\]"),
        (DifferentialSoftQ, {"power": float("nan")}, "power=nan"),
        (DifferentialSoftQ, {"n_epochs": 0}, "n_epochs=0"),
        (DifferentialSoftQ, {"lr_rate": 0.0}, "lr_rate=0.0"),
        (ZLearning, {"lr_rate": 2.0}, "lr_rate=2.0"),
        (RVISoftQ, {"reference": -1}, "reference=-1"),
        (RVISoftQ, {"reference": 9}, "reference=9: must be a state below 2"),
        (SoftQ, {"discount": 1.0}, r"discount=1.0: must be a number in \[0, 1\)"),
        (Sarsa, {"discount": -0.1}, "discount=-0.1"),
        (QLearning, {"prior_policy": [[1.0, 1e-310], [0.5, 0.5]]}, r"prior_policy\[0, 1\]=1e-310"),
    ],
)
def test_bad_arguments(learner_class, options, message):
    with pytest.raises(InputError, match=message):
        learner_class(**options).init(2, 2)


def test_a_solution_of_a_discounted_learner_has_no_theta(tmp_path, cliff):
    from erl_torch import Solution

    found = SoftQ(n_epochs=1).fit(cliff[1], 15, 4)
    again = Solution.load(found.save(tmp_path / "solution.npz"))
    assert again.theta is again.rho is None
    np.testing.assert_array_equal(again.policy, found.policy)
    q, value = found.value_functions()
    np.testing.assert_allclose(torch.logsumexp(10 * q, 1) - math.log(4), 10 * value, atol=1e-9)
    with pytest.raises(ValueError, match="theta"):
        found.value_functions(n_steps=5)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(name for name, learner in LEARNERS.items() if hasattr(learner, "fit")))
def test_learners_share_one_interface(cliff, name):
    _, data = cliff
    few = data.first(500)
    learner = LEARNERS[name](**({} if name == "certainty_equivalence" else {"n_epochs": 2}))
    state, stream = learner.init(15, 4), learner.prepare(few, 15, 4)
    np.testing.assert_allclose(state.policy, np.full((15, 4), 0.25), rtol=1e-14)
    states = list(learner.iterate(few, 15, 4))
    for expected in states[:2]:
        state = learner.step(state, stream)
        np.testing.assert_array_equal(state.policy, expected.policy)
        assert state.metrics() == expected.metrics()
    assert all(math.isfinite(value) for value in state.metrics().values())
    solution = learner.fit(few, 15, 4)
    assert solution.n_steps == states[-1].n_tuples
    np.testing.assert_array_equal(solution.policy, states[-1].policy)
    assert set(solution.history) == set(state.metrics())
    if len(states) > 1:
        assert learner.solution(states[0]).status is Status.STOPPED


# -- nearly reducible chains ------------------------------------------------------------------------------


def test_gth_and_lu_are_the_stationary_distribution():
    p = np.random.default_rng(0).dirichlet(np.ones(9), size=9)
    for found in (RegenerativeLU(sp.csr_array(p), 0).stationary(), solvers_kernels.gth(p.copy())[0]):
        np.testing.assert_allclose(found, oracle.stationary(p), rtol=1e-12)


@pytest.mark.parametrize("leave", [1e-3, 1e-30, 1e-100])
def test_gth_keeps_digits_where_the_chain_nearly_falls_apart(leave):
    """Two pairs of states, joined both ways by ``leave`` and 3 ``leave``: shares 3/4 and 1/4."""
    p = np.array([[0.5, 0.5, 0, 0], [0.5, 0.5, leave, 0], [0, 3 * leave, 0.5, 0.5], [0, 0, 0.5, 0.5]])
    np.testing.assert_allclose(solvers_kernels.gth(p)[0], [0.375, 0.375, 0.125, 0.125], rtol=2 * leave + 1e-14)
