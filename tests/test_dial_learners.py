"""Optimism in what learns from counts: certainty equivalence, EfficientS1, intervals, and runs."""

import json
from dataclasses import replace

import hypothesis
import numpy as np
import pytest
import scipy.sparse as sp
from helpers import problems, random_mdp, random_stream, scalars
from hypothesis import strategies as st
from scipy.special import logsumexp

import erl_torch
from erl_torch import (
    CertaintyEquivalence,
    EfficientS1,
    EvaluationSettings,
    ListedS1,
    Replicas,
    Simulation,
    Status,
    TabularMDP,
    Transitions,
    collect,
    empirical_mdp,
    policy_uncertainty,
    solve_soft_bellman,
    theta_uncertainty,
)
from erl_torch.checks import InputError
from erl_torch.empirical.counts import joint
from erl_torch.learners import Exact
from erl_torch.learners.action_value.q_learning import ULearning
from erl_torch.learners.efficient_s1 import kernels
from erl_torch.run.compare import compare
from erl_torch.run.judge import of_data
from erl_torch.solvers.policy import objective


def noisy(data, rng, scale):
    return Transitions(data.s, data.a, data.r + scale * rng.standard_normal(len(data)), data.s_next, data.a_next)


def rate(backup, n_states):
    """(V, g) of V + g = backup(V), by damped value iteration until 1e-13."""
    value = np.zeros(n_states)
    for _ in range(20_000):
        gain = backup(value) - value
        if np.ptp(gain) < 1e-13:
            break
        value = value + 0.7 * (gain - gain.min())
    return value, gain.mean()


def of_tuples(data, shape, beta, optimism, together):
    """(theta, policy) of the problem that the tuples pose, pair by pair, from the definition of C."""
    n_states, n_actions = shape
    kappa = optimism * beta
    met = {(s, a): np.flatnonzero((data.s == s) & (data.a == a)) for s in range(n_states) for a in range(n_actions)}

    def q(value):
        table = np.empty(shape)
        for pair, t in met.items():
            r, after = data.r[t], value[data.s_next[t]]
            if together:
                table[pair] = (logsumexp(kappa * (r + after)) - np.log(len(t))) / kappa
            else:
                table[pair] = r.mean() + (logsumexp(kappa * after) - np.log(len(t))) / kappa
        return table

    value, g = rate(lambda v: logsumexp(beta * q(v), axis=1, b=1 / n_actions) / beta, n_states)
    policy = np.exp(beta * q(value))
    return -g, policy / policy.sum(1, keepdims=True)


# -- what is learnt ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("optimism", "together"), [(2.0, False), (1.0, True), (0.3, False), (-0.5, False), (-2.0, True)]
)
def test_both_learners_solve_the_problem_of_the_tuples(optimism, together):
    rng = np.random.default_rng(7)
    data = noisy(random_stream(rng, random_mdp(rng, 4, 2), 2000), rng, 0.2)
    theta, policy = of_tuples(data, (4, 2), 3.0, optimism, together)
    noise = "joint" if together else "mean"
    exact = CertaintyEquivalence(3.0, optimism=optimism, reward_noise=noise).fit(data, 4, 2)
    learnt = EfficientS1(3.0, optimism=optimism, reward_noise=noise).fit(data, 4, 2)
    for found, tol in ((exact, 1e-9), (learnt, 1e-5)):
        assert found.status is Status.CONVERGED
        assert found.optimism == optimism
        assert found.theta == pytest.approx(theta, abs=tol)
        np.testing.assert_allclose(found.policy, policy, atol=tol)


@pytest.mark.parametrize("optimism", [1.0, -0.5])
def test_the_paper_s_delta_at_any_optimism(optimism):
    """(1 - lam) (C_lam V - C_(lam-1) V), of the rows of the counts."""
    rng = np.random.default_rng(1)
    data = random_stream(rng, random_mdp(rng, 4, 2), 2000)
    found = EfficientS1(2.0, optimism=optimism).fit(data, 4, 2)
    p, value = empirical_mdp(data, 4, 2).transition.toarray(), -found.log_psi.numpy() / 2.0

    def certain(lam):
        if lam == 0:
            return p @ value
        return logsumexp(lam * 2.0 * value, axis=1, b=p) / (lam * 2.0)

    delta = (1 - optimism) * (certain(optimism) - certain(optimism - 1))
    np.testing.assert_allclose(found.reward_bias.numpy().ravel(), delta, atol=1e-5)


@pytest.mark.parametrize("log_domain", ["off", "on"])
@pytest.mark.parametrize("optimism", [1.0, -0.5])
def test_with_every_option_off_it_is_algorithm_s1(optimism, log_domain):
    """Two implementations of the listing at any optimism."""
    rng = np.random.default_rng(0)
    data = random_stream(rng, random_mdp(rng, 4, 3), 500)
    options = dict(beta=2.0, optimism=optimism, lr_u=0.05, lr_psi=0.1, n_epochs=2, n_bias=3)
    paper = ListedS1(**options).fit(data, 4, 3)
    ours = EfficientS1.published(**options, log_domain=log_domain).fit(data, 4, 3)
    assert ours.theta == pytest.approx(paper.theta, rel=1e-12)
    for name in ("policy", "u", "psi", "reward_bias"):
        np.testing.assert_allclose(getattr(ours, name), getattr(paper, name), rtol=1e-10, atol=1e-14)


@pytest.mark.parametrize(
    "options",
    [
        dict(expected_backup=False),
        dict(sample_mean_psi=False, lr_psi=0.002),
        dict(mean_reward=False),
        dict(log_domain="on"),
        dict(unvisited="initial"),
    ],
    ids=lambda options: next(iter(options)),
)
def test_options_hold_at_any_optimism(options):
    """What streams e as it comes is noisy, and near; the others end at the certificate."""
    rng = np.random.default_rng(3)
    data = random_stream(rng, random_mdp(rng, 4, 2), 10_000)
    theta = CertaintyEquivalence(2.0, optimism=-1.0).fit(data, 4, 2).theta
    found = EfficientS1(2.0, optimism=-1.0, clock_floor=0.001, n_bias=8, **options).fit(data, 4, 2)
    assert found.theta == pytest.approx(theta, abs=0.01)


def test_online_it_is_certified_however_the_stream_is_cut():
    rng = np.random.default_rng(5)
    data = random_stream(rng, random_mdp(rng, 5, 3), 10_000)
    theta = CertaintyEquivalence(4.0, optimism=-1.5).fit(data, 5, 3).theta
    ends = []
    for cut in (10_000, 3001):
        chunks = [data.where(slice(i, i + cut)) for i in range(0, 10_000, cut)]
        *_, state = EfficientS1(4.0, optimism=-1.5).online(chunks, 5, 3)
        assert state.certified
        assert state.theta == pytest.approx(theta, abs=state.empirical_width)
        ends.append(state)
    for name in ("mean_value", "log_z", "log_psi", "log_average"):
        np.testing.assert_array_equal(getattr(ends[0], name), getattr(ends[1], name))


@hypothesis.settings(max_examples=6, deadline=None)
@hypothesis.given(problem=problems(), kappa=st.floats(-6, 6), average=st.booleans(), factors=st.booleans())
def test_kernels_back_up_the_tilted_mean(problem, kappa, average, factors):
    """The loop as it is written in the module's docstring, tuple by tuple."""
    rng, mdp, prior = problem
    (n_states, n_actions), n = mdp.reward.shape, 150
    data = random_stream(rng, mdp, n)
    tilt, share = np.exp(kappa * rng.random(n_states)), rng.uniform(0.5, 2, n_states * n_actions)
    g, z_0 = rng.uniform(0.2, 1, share.size), rng.uniform(0.5, 2, share.size)
    largest = rng.uniform(0.2, 1, share.size)
    factor = rng.uniform(0.5, 2, n) if factors else np.ones(1)
    steps, members = np.linspace(1, 0.1, 6), np.arange(n_states)
    z, rho, total, visits, least = z_0.copy(), 0.7, np.zeros(share.size), np.zeros(share.size, int), np.inf
    y = (prior * z.reshape(prior.shape)).sum(1)
    for t in range(n):
        least = min(y) if t == 0 else min(least, min(y))
        k = data.s[t] * n_actions + data.a[t]
        e = tilt[data.s_next[t]] * share[k] * (factor[t] if factors else 1.0)
        w = g[k] * (least + e * (y[data.s_next[t]] - least))
        z[k] += min(steps[min(visits[k], 5)], largest[k]) * (w / rho - z[k])
        visits[k] += 1
        total[k] += z[k] if average else 0.0
        rho = min(rho + 0.05 * (w / z[k] - rho), 5.0)
        y = (prior * z.reshape(prior.shape)).sum(1)
    pair, weight = data.s * np.int32(n_actions) + data.a, prior.ravel()
    for kernel, number, back in (
        (kernels.tilted_gauge_epoch, np.exp, np.asarray),
        (kernels.log_tilted_gauge_epoch, np.asarray, np.exp),
    ):
        tables = [number(np.log(x)) for x in (g, tilt, share, z_0)]
        sums, counts = number(np.full(share.size, -np.inf)), np.zeros(share.size, np.int64)
        found, healthy = kernel(
            pair, data.s_next, number(np.log(factor)), factors, *tables[:3], largest, members, tables[3], sums, average,
            number(np.log(weight)), n_actions, steps, counts, float(number(np.log(0.7))), 0.05,
            float(number(np.log(5.0))), 5000, 0, n,
        )  # fmt: skip
        assert healthy
        assert back(found) == pytest.approx(rho, rel=1e-10)
        got = back(tables[3])
        np.testing.assert_allclose(got / got.sum(), z / z.sum(), rtol=1e-9)
        if average:
            np.testing.assert_allclose(back(sums) / got.sum(), total / z.sum(), rtol=1e-9)


def test_rewards_that_do_not_vary_count_the_same_together():
    rng = np.random.default_rng(0)
    data = random_stream(rng, random_mdp(rng, 3, 2), 500)
    model = empirical_mdp(data, 3, 2)
    assert joint(model, data, 2.0) is model
    varied = noisy(data, rng, 0.1)
    assert joint(empirical_mdp(varied, 3, 2), varied, 0.0).reward[0, 0] == empirical_mdp(varied, 3, 2).reward[0, 0]
    near = joint(empirical_mdp(varied, 3, 2), varied, 1e-6)
    np.testing.assert_allclose(near.reward, empirical_mdp(varied, 3, 2).reward, atol=1e-7)


def test_arguments_are_named():
    for optimism in (np.nan, np.inf, "1"):
        for learner in (CertaintyEquivalence, EfficientS1, erl_torch.learners.Exact):
            with pytest.raises(InputError, match="optimism="):
                learner(5.0, optimism=optimism)
    with pytest.raises(InputError, match=r"reward_noise=.*mean.*joint"):
        CertaintyEquivalence(reward_noise="both")
    for off in ("sample_mean_psi", "mean_reward"):
        with pytest.raises(InputError, match="reward_noise=joint: must be mean where sample_mean_psi"):
            EfficientS1(reward_noise="joint", **{off: False})
    data = random_stream(np.random.default_rng(0), random_mdp(np.random.default_rng(0), 3, 2), 50)
    with pytest.raises(InputError, match="reward_noise=joint: must be mean in the online mode"):
        next(EfficientS1(optimism=1.0, reward_noise="joint").online([data], 3, 2))


# -- intervals --------------------------------------------------------------------------------------------


def solved(p, reward, beta, optimism, policy=None):
    """g* of rows p [S, A, S], or J of ``policy``, by value iteration."""
    kappa, n_actions = optimism * beta, reward.shape[1]

    def backup(value):
        certain = p @ value if kappa == 0 else logsumexp(kappa * value, axis=2, b=p) / kappa
        if policy is None:
            return logsumexp(beta * (reward + certain), axis=1, b=1 / n_actions) / beta
        return (policy * (reward + certain - np.log(policy * n_actions) / beta)).sum(1)

    return rate(backup, len(reward))[1]


@pytest.mark.parametrize(
    ("optimism", "of_policy"), [(2.0, False), (1.0, True), (0.0, False), (-2.0, False), (-2.0, True)]
)
def test_error_and_bias_are_those_of_derivatives_taken_by_differences(optimism, of_policy):
    """J along the draws of each pair: the slopes' variance, and half the mean of the curvatures, over n."""
    rng = np.random.default_rng(11)
    mdp = random_mdp(rng, 3, 2)
    counted = empirical_mdp(random_stream(rng, mdp, 300), 3, 2)
    n = 1_000_000  # so that n - 1 is n
    model = replace(counted, visits=np.full((3, 2), n))
    policy = rng.dirichlet((2.0, 2.0), 3) if of_policy else None
    p, r = counted.transition.toarray().reshape(3, 2, 3), counted.reward
    middle = solved(p, r, 2.0, optimism, policy)
    variance = bias = 0.0
    for s, a in np.ndindex(3, 2):
        for to in range(3):
            moved = []
            for h in (-1e-3, 1e-3):
                there = p.copy()
                there[s, a] += h * (np.eye(3)[to] - p[s, a])
                moved.append(solved(there, r, 2.0, optimism, policy))
            if p[s, a, to] > 0.002:
                variance += p[s, a, to] * ((moved[1] - moved[0]) / 2e-3) ** 2 / n
                bias += 0.5 * p[s, a, to] * (moved[0] + moved[1] - 2 * middle) / 1e-6 / n
    if of_policy:
        found, sign = policy_uncertainty(model, policy, 2.0, optimism=optimism), 1
    else:
        found, sign = theta_uncertainty(model, 2.0, optimism=optimism), -1
    assert found.standard_error == pytest.approx(np.sqrt(variance), rel=1e-4)
    assert sign * found.bias == pytest.approx(bias, rel=1e-3, abs=1e-4 * variance)
    assert sign * found.value + bias == pytest.approx(middle, abs=1e-9)
    low, high = found.interval()
    assert high - low == pytest.approx(2 * 1.96 * found.standard_error, rel=0.01)


def test_what_rests_on_a_handful_of_tuples_is_said():
    p = np.zeros((2, 1, 2))
    p[0, 0], p[1, 0] = (0.99, 0.01), (1.0, 0.0)
    s = np.array([0] * 198 + [1] * 2)
    after = np.array([0] * 196 + [1] * 2 + [0] * 2)
    data = Transitions(s, 0 * s, np.where(s == 1, -3.0, -0.01 * (np.arange(200) % 2)), after, 0 * s)
    found = theta_uncertainty(empirical_mdp(data, 2, 1), 3.0, optimism=-1.0)
    assert found.warning.startswith("at state 0, action 0 the successor 1 counts ")
    assert theta_uncertainty(empirical_mdp(data, 2, 1), 3.0).warning == ""


def test_no_single_rate_has_no_interval():
    """docs/theory.md: x may stay, y may not leave; below optimism -.0745 the rate depends on the start."""
    p = np.zeros((2, 2, 2))
    p[0, 0, 0] = p[0, 1, 1] = 1.0
    p[1, :] = 0.5
    data = collect(TabularMDP(p, np.array([[1.0, 1.0], [0.0, 0.0]]), np.array([1.0, 0.0])), 1, 20_000, 0)
    found = CertaintyEquivalence(10.0, optimism=-0.3).fit(data, 2, 2)
    assert found.status is Status.NO_SINGLE_RATE
    assert found.theta is None
    estimate = theta_uncertainty(empirical_mdp(data, 2, 2), 10.0, optimism=-0.3)
    assert "no single rate" in estimate.withheld
    assert EfficientS1(10.0, optimism=-0.3).fit(data, 2, 2).status is Status.UNCERTIFIED


def test_intervals_of_rewards_that_count_together_are_withheld():
    rng = np.random.default_rng(0)
    data = noisy(random_stream(rng, random_mdp(rng, 3, 2), 500), rng, 0.1)
    given = empirical_mdp(data, 3, 2), 2.0, np.full((3, 2), 0.5)
    assert "joint" in of_data(*given, 1.0, "joint").withheld
    assert not of_data(*given, 1.0, "mean").withheld
    assert not of_data(*given, 0.0, "joint").withheld


# -- runs -------------------------------------------------------------------------------------------------

QUICK = EvaluationSettings(pictures=False)


def windy(rng):
    return random_mdp(rng, 5, 3)


@pytest.mark.parametrize("learner", [CertaintyEquivalence(4.0, optimism=1.0), EfficientS1(4.0, optimism=-1.0)])
def test_a_run_is_held_against_the_optimum_of_its_optimism(tmp_path, learner):
    mdp = windy(np.random.default_rng(2))
    data = collect(mdp, 10, 1000, 0)
    solution = erl_torch.train(learner, mdp, data, directory=tmp_path, evaluation=QUICK)
    best, policy, prior = (
        solve_soft_bellman(mdp, 4.0, optimism=learner.optimism),
        solution.policy.numpy(),
        np.full((5, 3), 1 / 3),
    )
    result = json.loads((tmp_path / "result.json").read_text())
    assert result["optimism"] == learner.optimism
    assert result["theta_bounds"][0] <= best.theta <= result["theta_bounds"][1]
    own = objective(mdp, policy, prior, 4.0, optimism=learner.optimism)
    assert result["objective"] == pytest.approx(own, abs=1e-12)
    assert result["objective_real"] == pytest.approx(objective(mdp, policy, prior, 4.0), abs=1e-12)
    assert -best.theta - own - 1e-9 <= result["gap"] < 0.05
    logged = scalars(tmp_path)
    assert logged["optimal/objective"][0][1] == pytest.approx(-best.theta, abs=1e-6)
    real = objective(mdp, best.policy.numpy(), prior, 4.0)
    assert logged["optimal/objective_real"][0][1] == pytest.approx(real, abs=1e-6)
    assert logged["eval/objective_real"][-1][1] == pytest.approx(result["objective_real"], abs=1e-6)


def test_replicas_of_several_optimisms_have_an_optimum_each(tmp_path):
    mdp = windy(np.random.default_rng(3))
    learners = [EfficientS1(3.0, optimism=lam) for lam in (1.0, 0.0, -1.0) for _ in range(2)]
    replicas = Replicas(tuple(learners))
    streams = Simulation(mdp, n_episodes=3, episode_length=1000, seeds=[0, 1] * 3)
    erl_torch.train(replicas, mdp, streams, directory=tmp_path, evaluation=QUICK)
    result = json.loads((tmp_path / "result.json").read_text())
    assert [group["optimism"] for group in result["groups"]] == [1.0, 0.0, -1.0]
    for group in result["groups"]:
        best = solve_soft_bellman(mdp, 3.0, optimism=group["optimism"])
        assert group["exact"]["theta"] == pytest.approx(best.theta, abs=1e-9)
        assert group["objective"]["max"] <= group["exact"]["objective"] + 1e-9
    right = result["groups"][1]
    assert right["objective_real"]["mean"] == right["objective"]["mean"]


def test_a_learner_without_a_choice_says_so(tmp_path):
    mdp = windy(np.random.default_rng(4))
    data = collect(mdp, 2, 500, 0)
    with pytest.warns(erl_torch.Note, match="it solves optimism 1 of the dial"):
        erl_torch.train(ULearning(3.0, n_epochs=1), mdp, data, directory=tmp_path / "chance", evaluation=QUICK)
    certain = TabularMDP(sp.csr_array(np.eye(3)[[1, 2, 2, 0, 0, 1]]), np.arange(6.0).reshape(3, 2) - 6, np.ones(3) / 3)
    few = collect(certain, 2, 500, 0)
    erl_torch.train(ULearning(0.5, n_epochs=1), certain, few, directory=tmp_path / "none", evaluation=QUICK)
    notes = json.loads((tmp_path / "none" / "result.json").read_text())["notes"]
    assert not any("dial" in note for note in notes)


@pytest.mark.parametrize("method", ["biasing", "soft_bellman"])
def test_the_exact_solver_as_a_learner(method):
    mdp = windy(np.random.default_rng(6))
    learner = Exact(3.0, optimism=-0.5, method=method)
    *_, state = learner.iterate(mdp)
    best = solve_soft_bellman(mdp, 3.0, optimism=-0.5)
    for found in (learner.solve(mdp), learner.solution(state)):
        assert found.optimism == -0.5
        assert found.theta == pytest.approx(best.theta, abs=1e-8)
        np.testing.assert_allclose(found.policy, best.policy, atol=1e-6)


def test_a_comparison_is_of_one_optimism():
    mdp = windy(np.random.default_rng(5))
    learners = {"ce": CertaintyEquivalence(3.0, optimism=1.0), "s1": EfficientS1(3.0, optimism=1.0)}
    found = compare(mdp, learners, 5, 1000, seeds=2)
    assert found.theta == pytest.approx(solve_soft_bellman(mdp, 3.0, optimism=1.0).theta, abs=1e-9)
    assert found.measures["gap"].max() < 0.01
    np.testing.assert_allclose(found.measures["gap"][0], found.measures["gap"][1], atol=1e-6)
    with pytest.raises(InputError, match=r"s1: optimism=0\.0: must be that of ce, 1: one objective for all"):
        compare(mdp, learners | {"s1": EfficientS1(3.0)}, 5, 1000, seeds=1)


@pytest.mark.parametrize("optimism", [1e-14, -1e-12, 1e-10])
def test_intervals_are_continuous_at_0(optimism):
    mdp = windy(np.random.default_rng(6))
    model = empirical_mdp(collect(mdp, 1, 5000, 0), mdp.n_states, mdp.n_actions)
    there, near = (theta_uncertainty(model, 3.0, optimism=x) for x in (0.0, optimism))
    assert near.value == pytest.approx(there.value, abs=1e-8)
    np.testing.assert_allclose(near.interval(), there.interval(), atol=1e-6)


def test_optimism_that_streams_lose_is_refused():
    """Within 1e-8 of 0 theta lost its digits; certainty equivalence keeps them."""
    for near in (1e-9, -1e-14):
        with pytest.raises(InputError, match=r"optimism=.*0, or at least 1e-08 in size"):
            EfficientS1(5.0, optimism=near)
    assert EfficientS1(5.0, optimism=1e-8).optimism == 1e-8
