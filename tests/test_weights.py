"""Other dynamics from the same tuples: weights, and dynamics that are given."""

import re
from dataclasses import fields

import numpy as np
import pytest
from helpers import ROOT, random_mdp, random_stream

import erl_torch
from erl_torch import (
    AlgorithmS1,
    CertaintyEquivalence,
    EfficientS1,
    InputError,
    ListedS1,
    Note,
    Replicas,
    TabularMDP,
    Transitions,
    bootstrap_theta,
    empirical_mdp,
    fit_reward,
    for_dynamics,
    learners,
    read_experience,
    read_log,
    reweighted,
    solve_soft_bellman,
    theta_uncertainty,
    write_experience,
)
from erl_torch.empirical.counts import joint
from erl_torch.envs import dynamics_shift
from erl_torch.experience.experience import Selection, is_weighted
from erl_torch.experience.transitions import join
from erl_torch.learners.efficient_s1 import kernels

BETA = 2.0


def tilted(rng, mdp, size):
    """Other dynamics of the same support, and their ratio [S, A, S]."""
    p = mdp.transition.toarray().reshape(*mdp.reward.shape, -1)
    other = p * np.exp(size * rng.standard_normal(p.shape))
    other /= other.sum(-1, keepdims=True)
    return TabularMDP(other, mdp.reward), np.divide(other, p, out=np.zeros_like(p), where=p > 0)


def of(table):
    return lambda s, a, s_next: table[s, a, s_next]


def noisy(data, rng, scale=0.5):
    return Transitions(data.s, data.a, data.r + scale * rng.standard_normal(len(data)), data.s_next, data.a_next)


@pytest.fixture
def setting():
    rng = np.random.default_rng(4)
    old = random_mdp(rng, 5, 3)
    new, ratio = tilted(rng, old, 0.5)
    return rng, old, new, ratio, random_stream(rng, old, 4000)


def same_model(one, other, rtol=1e-12):
    for name in ("reward", "reward_given_next"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol, 1e-13)
    np.testing.assert_allclose(one.transition.toarray(), other.transition.toarray(), rtol)


# -- counts ---------------------------------------------------------------------------------------------------


def test_weights_that_are_whole_numbers_are_copies(setting):
    """A tuple of weight k counts as k of it, one of weight 0 as none."""
    rng, _, _, _, data = setting
    data = noisy(data, rng)
    copies = rng.integers(0, 4, len(data))
    weighted = Transitions(data.s, data.a, data.r, data.s_next, data.a_next, copies)
    repeated = data.where(np.repeat(np.arange(len(data)), copies))
    one, other = (empirical_mdp(x, 5, 3) for x in (weighted, repeated))
    same_model(one, other)
    kappa = 1.5
    same_model(joint(one, weighted, kappa), joint(other, repeated, kappa), 1e-10)
    n, m = np.maximum(one.visits, 1), np.maximum(other.visits, 1)
    np.testing.assert_allclose(one.reward_variance * (n - 1) / n, other.reward_variance * (m - 1) / m, 1e-10)
    for make in (CertaintyEquivalence, EfficientS1):
        assert make(BETA).fit(weighted, 5, 3).theta == pytest.approx(make(BETA).fit(repeated, 5, 3).theta, abs=1e-7)


def test_only_the_ratio_of_weights_counts(setting):
    _, _, _, ratio, data = setting
    factor = np.linspace(1.0, 30.0, 15).reshape(5, 3, 1)
    one, other = (empirical_mdp(reweighted(data, of(x)), 5, 3) for x in (ratio, ratio * factor))
    same_model(one, other)
    a, b = theta_uncertainty(one, BETA), theta_uncertainty(other, BETA)
    assert a.standard_error == pytest.approx(b.standard_error, rel=1e-9)


def test_known_ratios_lead_to_the_other_dynamics(setting):
    """Each (s,a,s') once for each ten-thousandth of its probability: the weighted model is the target, exactly."""
    rng, old, new, _, _ = setting
    counts = np.rint(1e4 * old.transition.toarray()).astype(int)
    k, s_next = np.divmod(np.repeat(np.arange(counts.size), counts.ravel()), 5)
    s, a = np.divmod(k, 3)
    order = rng.permutation(len(s))
    s, a, s_next = s[order], a[order], s_next[order]
    data = Transitions(s, a, old.reward[s, a], s_next, 0 * s)
    shown = (counts / counts.sum(1, keepdims=True)).reshape(5, 3, 5)
    target = new.transition.toarray().reshape(5, 3, 5)
    weighted = reweighted(data, lambda s, a, t: target[s, a, t] / shown[s, a, t])
    exact = solve_soft_bellman(new, BETA, optimism=-0.5)
    for make in (CertaintyEquivalence, EfficientS1):
        found = make(BETA, optimism=-0.5).fit(weighted, 5, 3)
        assert found.theta == pytest.approx(exact.theta, abs=1e-7)
        np.testing.assert_allclose(found.policy, exact.policy, atol=1e-6)


@pytest.mark.parametrize("make", [CertaintyEquivalence, EfficientS1])
def test_weights_of_1_change_no_bit(setting, make):
    rng, _, _, _, data = setting
    data = noisy(data, rng)
    ones = reweighted(data, lambda s, a, t: np.ones(len(s)))
    here, there = (make(BETA, optimism=0.5).fit(x, 5, 3) for x in (data, ones))
    assert here.theta == there.theta
    assert bool((here.policy == there.policy).all())
    a, b = (theta_uncertainty(empirical_mdp(x, 5, 3), BETA) for x in (data, ones))
    assert (a.value, a.standard_error, a.interval()) == (b.value, b.standard_error, b.interval())
    whole = Selection(ones, lambda chunk: np.ones(len(chunk), bool), len(ones))  # not in memory
    assert make(BETA, optimism=0.5).fit(whole, 5, 3).theta == there.theta


def test_rewards_of_successors_are_weighted(setting):
    """r(s,a,s'): the mean reward of the other dynamics is another; only the ratio-weighted mean is right."""
    rng, old, new, ratio, _ = setting
    of_step = rng.standard_normal((5, 3, 5))
    data = random_stream(rng, old, 200_000)
    data = Transitions(data.s, data.a, of_step[data.s, data.a, data.s_next], data.s_next, data.a_next)
    wanted = (new.transition.toarray().reshape(5, 3, 5) * of_step).sum(-1)
    plain = (old.transition.toarray().reshape(5, 3, 5) * of_step).sum(-1)
    weighted = empirical_mdp(reweighted(data, of(ratio)), 5, 3)
    error = np.sqrt(weighted.reward_variance / weighted.visits)
    assert np.abs((weighted.reward - wanted) / error).max() < 5
    assert np.abs((plain - wanted) / error).max() > 20
    given = for_dynamics(data, new, rewards="successor")
    np.testing.assert_allclose(given.reward, wanted, atol=1e-12)
    np.testing.assert_array_equal(given.transition.toarray(), new.transition.toarray())


@pytest.mark.parametrize("log", ["off", "on"])
@pytest.mark.parametrize("optimism", [0.0, -1.0, 1.0])
def test_efficient_s1_ends_at_certainty_equivalence(setting, optimism, log):
    rng, old, _, _, data = setting
    _, ratio = tilted(rng, old, 2.0)
    weighted = reweighted(noisy(data, rng), of(ratio))
    assert weighted.weight.max() > 20
    ce = CertaintyEquivalence(BETA, optimism=optimism).fit(weighted, 5, 3)
    found = EfficientS1(BETA, optimism=optimism, log_domain=log).fit(weighted, 5, 3)
    assert found.status.name == "CONVERGED"
    assert found.theta == pytest.approx(ce.theta, abs=1e-6)
    np.testing.assert_allclose(found.policy, ce.policy, atol=1e-4)


def test_a_weighted_step_is_that_of_the_listing_with_weights():
    """z += a (w/w_bar)(target - z), rho += lr (w/w_bar)(w/z - rho), tuple by tuple; logarithms the same."""
    rng = np.random.default_rng(0)
    n, s, a = 40, 3, 2
    pair, after = rng.integers(0, s * a, n).astype(np.int32), rng.integers(0, s, n).astype(np.int32)
    g, z0, weight = rng.uniform(0.5, 2, s * a), rng.uniform(0.5, 2, s * a), np.full(s * a, 0.5)
    relative, largest = rng.uniform(0, 3, n), np.full(s * a, 1 / 3)
    z, rho = z0.copy(), 1.3
    for k, t, x in zip(pair, after, relative, strict=True):
        w = g[k] * (z.reshape(s, a)[t] @ weight[:a])
        step = min(0.4, largest[k]) * x
        z[k] += step * (w / rho - z[k])
        rho += 0.01 * x * (w / z[k] - rho)
    common = dict(n_actions=a, steps=np.array([0.4]), lr_rho=0.01, expected=True, rescale_every=1000, begin=0, end=n)
    for log in (False, True):
        number = np.log if log else np.array
        kernel = kernels.log_gauge_epoch if log else kernels.gauge_epoch
        found, visits = number(z0), np.zeros(s * a, np.int64)
        last, _ = kernel(
            pair, after, number(np.ones(1)), False, number(g), found, number(np.full(s * a, 1e-300)), False,
            number(weight), common["n_actions"], common["steps"], visits, float(number(1.3)), common["lr_rho"],
            float(number(100.0)), True, 1000, 0, n, 0, relative, largest,
        )  # fmt: skip
        found, last = (np.exp(found), np.exp(last)) if log else (found, last)
        np.testing.assert_allclose(found / found[0], z / z[0], 1e-12)
        assert last == pytest.approx(rho, rel=1e-12)


# -- intervals ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("optimism", [0.0, -1.0, 0.5])
def test_the_variance_is_that_of_a_ratio_of_means(setting, optimism):
    """theta moves with each tuple's weight: the infinitesimal jackknife of the solver, in differences, is the sandwich.

    With d theta/d(count of tuple i) = -d* w_i (x_i - mean x) / sum w, the sum of its squares is that of the pairs.
    """
    rng, _, _, ratio, data = setting
    data = reweighted(noisy(data.first(300), rng, 0.2), of(ratio))
    model = empirical_mdp(data, 5, 3)
    estimate = theta_uncertainty(model, BETA, optimism=optimism)
    step, wanted = 1e-4, np.zeros((5, 3))

    def theta(i, change):
        weight = data.weight.copy()
        weight[i] *= 1 + change
        moved = Transitions(data.s, data.a, data.r, data.s_next, data.a_next, weight)
        return CertaintyEquivalence(BETA, optimism=optimism, tol=1e-13).fit(moved, 5, 3).theta

    chosen = np.argwhere(estimate.variance >= np.sort(estimate.variance, None)[-3])
    for s, a in chosen:
        for i in np.flatnonzero((data.s == s) & (data.a == a)):
            wanted[s, a] += ((theta(i, step) - theta(i, -step)) / (2 * step)) ** 2
    s, a = chosen.T
    found = estimate.variance[s, a]
    n = model.visits[s, a]
    # The estimate has n/(n - 1) on top, n the draws that tell as much; between half and twice the visits here.
    assert (found > wanted[s, a]).all()
    np.testing.assert_array_less(found / wanted[s, a] - 1, 2.5 / n)


def test_few_effective_tuples_are_told(setting):
    """Five tuples of the pair that matters most have nearly all of its weight."""
    *_, data = setting
    plain = theta_uncertainty(empirical_mdp(data, 5, 3), BETA)
    assert not plain.warning
    s, a = np.unravel_index(np.argmax(plain.variance), (5, 3))
    weight = np.ones(len(data))
    weight[np.flatnonzero((data.s == s) & (data.a == a))[:5]] = 1e4
    few = Transitions(data.s, data.a, data.r, data.s_next, data.a_next, weight)
    estimate = theta_uncertainty(empirical_mdp(few, 5, 3), BETA)
    assert f"at state {s}, action {a} the weights leave an effective sample of 5" in estimate.warning
    assert estimate.smallest_visits == 5


def test_successors_that_were_never_seen_are_told(setting):
    """The mean of p^/p under p is 1: where it is not, most of p^ is elsewhere, and there is no interval."""
    _, _, _, _, data = setting
    elsewhere = np.ones((5, 3, 5))
    elsewhere[2, 1] = 0.01
    with pytest.warns(Note, match=r"\(s, a\) = \(2, 1\) the mean weight is below 0.5 .the first: 0.01 of"):
        weighted = reweighted(data, of(elsewhere))
    estimate = theta_uncertainty(empirical_mdp(weighted, 5, 3), BETA)
    assert "at state 2, action 1 the mean weight of" in estimate.withheld
    assert estimate.interval() == (-np.inf, np.inf)


def test_the_bootstrap_wants_plain_counts(setting):
    _, _, new, ratio, data = setting
    for model in (empirical_mdp(reweighted(data, of(ratio)), 5, 3), for_dynamics(data, new)):
        with pytest.raises(InputError, match="plain counts"):
            bootstrap_theta(model, BETA)


# -- dynamics that are given ------------------------------------------------------------------------------------


def test_given_dynamics_take_nothing_but_rewards(setting):
    """The solution is the target's with mean rewards; its interval has the noise of those alone."""
    rng, _, new, _, data = setting
    data = noisy(data, rng)
    given = for_dynamics(data, new)
    means = np.array([[data.r[(data.s == s) & (data.a == a)].mean() for a in range(3)] for s in range(5)])
    exact = solve_soft_bellman(TabularMDP(new.transition, means), BETA)
    found = CertaintyEquivalence(BETA).solve(given)
    assert found.theta == pytest.approx(exact.theta, abs=1e-9)
    np.testing.assert_allclose(found.policy, exact.policy, atol=1e-8)
    estimate = theta_uncertainty(given, BETA)
    d = np.zeros((5, 3))
    for s, a in np.ndindex(5, 3):  # d* is the derivative of -theta with the rewards
        up, down = means.copy(), means.copy()
        up[s, a] += 1e-5
        down[s, a] -= 1e-5
        d[s, a] = (
            -(
                solve_soft_bellman(TabularMDP(new.transition, up), BETA, tol=1e-13).theta
                - solve_soft_bellman(TabularMDP(new.transition, down), BETA, tol=1e-13).theta
            )
            / 2e-5
        )
    error = np.sqrt((d**2 * given.reward_variance / given.visits).sum())
    assert estimate.standard_error == pytest.approx(error, rel=1e-4)
    low, high = estimate.interval()
    assert high - low == pytest.approx(2 * 1.96 * error, rel=0.05)


def test_given_dynamics_and_plain_rewards_leave_nothing_to_estimate(setting):
    _, _, new, _, data = setting
    estimate = theta_uncertainty(for_dynamics(data, new), BETA)
    assert estimate.value == pytest.approx(solve_soft_bellman(new, BETA).theta, abs=1e-9)
    assert "no reward varies" in str(estimate)


def test_missing_coverage_is_named(setting):
    _, _, new, _, data = setting
    lacking = data.where((data.s != 2) | (data.a != 1))
    with pytest.raises(InputError, match=r"no reward of \(s, a\) = \(2, 1\)"):
        for_dynamics(lacking, new)
    prior = np.full((5, 3), 1 / 3)
    prior[2] = [0.5, 0.0, 0.5]
    found = CertaintyEquivalence(BETA, prior_policy=prior).solve(for_dynamics(lacking, new, prior))
    assert found.theta == pytest.approx(solve_soft_bellman(new, BETA, prior_policy=prior).theta, abs=1e-9)
    few = data.where((data.s != 2) | (data.a != 1) | (data.s_next != 3))
    with pytest.raises(InputError, match=r"no reward of \(s, a, s'\) = .*\(2, 1, 3\)"):
        for_dynamics(few, new, rewards="successor")


def test_states_that_the_target_does_not_reach_need_no_reward():
    """From 0 the target goes to 1 and back; 2 is another place, where nobody has been."""
    p = np.zeros((3, 1, 3))
    p[0, 0, 1] = p[1, 0, 0] = p[2, 0, 0] = 1.0
    s = np.array([0, 1] * 10)
    data = Transitions(s, 0 * s, s * 1.0, 0 * s, 0 * s)
    found = CertaintyEquivalence(BETA).solve(for_dynamics(data, TabularMDP(p, np.zeros((3, 1)))))
    assert found.theta == pytest.approx(-0.5, abs=1e-12)


@pytest.mark.parametrize("up_success", [1e-4, 0.01])
def test_a_broken_motor_is_learnt_from_the_time_before(up_success):
    """Figure 4's shift, from tuples of the old dynamics alone: by the target, exactly; by weights, once each pair that
    matters has failed, which one use of "up" in a hundred does."""
    before, after = (grid.mdp() for grid in dynamics_shift(up_success))
    shape = (16, 4, 16)
    p, q = before.transition.toarray().reshape(shape), after.transition.toarray().reshape(shape)
    ratio = np.divide(q, p, out=np.zeros(shape), where=p > 0)
    exact = solve_soft_bellman(after, 15.0)
    few = erl_torch.collect(before, 100, 1000, seed=0)
    given = CertaintyEquivalence(15.0).solve(for_dynamics(few, after))
    assert given.theta == pytest.approx(exact.theta, abs=1e-9)
    np.testing.assert_allclose(given.policy, exact.policy, atol=1e-7)
    with pytest.warns(Note, match="never seen"):
        weighted = reweighted(few, of(ratio))
    ce, learnt = (make(15.0).fit(weighted, 16, 4) for make in (CertaintyEquivalence, EfficientS1))
    assert learnt.theta == pytest.approx(ce.theta, abs=1e-5)
    many = reweighted(erl_torch.collect(before, 3000, 1000, seed=0), of(ratio))
    estimate = theta_uncertainty(empirical_mdp(many, 16, 4), 15.0)
    low, high = estimate.interval(0.999)
    assert low < exact.theta < high
    assert high - low < 0.01


# -- columns --------------------------------------------------------------------------------------------------


def test_weights_go_through_files(tmp_path, setting):
    _, _, _, ratio, data = setting
    weighted = reweighted(data, of(ratio))
    weighted.save(tmp_path / "tuples.npz")
    write_experience(weighted, tmp_path / "columns")
    data.save(tmp_path / "plain.npz")
    columns = [f.name for f in fields(Transitions)]
    for found in (
        Transitions.load(tmp_path / "tuples.npz"),
        read_experience(tmp_path / "tuples.npz", 5, 3),
        read_experience(tmp_path / "columns", 5, 3),
        join(list(read_experience(tmp_path / "columns", 5, 3, chunk=1000).chunks())),
        read_log(tmp_path / "columns").experience,
        read_log(weighted.arrays()).experience,
    ):
        for name in columns:
            np.testing.assert_array_equal(getattr(found, name), getattr(weighted, name))
        assert found.checksum() == weighted.checksum() != data.checksum()
    stream = read_experience(tmp_path / "columns", 5, 3, chunk=1000)
    assert CertaintyEquivalence(BETA).fit(stream, 5, 3).theta == CertaintyEquivalence(BETA).fit(weighted, 5, 3).theta
    plain = read_experience(tmp_path / "plain.npz", 5, 3)
    again = reweighted(read_experience(tmp_path / "plain.npz", 5, 3, chunk=1000), of(ratio))
    assert plain.weight is None
    assert again.checksum() == weighted.checksum()
    write_experience(data, tmp_path / "columns")  # may be replaced, and then has no weights
    assert read_experience(tmp_path / "columns", 5, 3).weight is None


def test_a_log_names_its_weights():
    rows = {"s": [0, 1, 0], "a": [0, 0, 0], "r": [0.0, 1.0, 2.0], "s_next": [1, 0, 1], "weight": [0.5, 2.0, 1.0]}
    assert read_log(rows).experience.weight is None  # of something else, perhaps
    named = read_log(rows, columns={"weight": "weight"})
    np.testing.assert_array_equal(named.experience.weight, rows["weight"])
    assert "weight=weight" in str(named.report)
    rows["importance_weight"] = rows.pop("weight")
    np.testing.assert_array_equal(read_log(rows).experience.weight, [0.5, 2.0, 1.0])
    with pytest.raises(InputError, match=r"importance_weight\[1\]|weight\[1\]"):
        read_log(rows | {"importance_weight": [1.0, -1.0, 1.0]})


def test_slices_keep_weights(setting):
    _, _, _, ratio, data = setting
    weighted = reweighted(data, of(ratio))
    assert is_weighted(weighted)
    assert not is_weighted(data)
    np.testing.assert_array_equal(weighted.first(7).weight, weighted.weight[:7])
    labelled = Transitions.of_labels("ab", "xx", [0.0, 1.0], "ba", "xx", weight=[1.0, 2.0]).transitions
    np.testing.assert_array_equal(labelled.weight, [1.0, 2.0])
    twice = reweighted(weighted, of(ratio))
    np.testing.assert_array_equal(twice.weight, weighted.weight**2)


# -- what cannot be used ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("weight", "text"),
    [
        ([1.0, -1.0], r"weight\[1\]=-1.0: must be finite and >= 0"),
        ([np.nan, 1.0], r"weight\[0\]=nan: must be finite and >= 0"),
        ([1.0], "of one length"),
        ([True, False], "numbers"),
        ([[1.0], [1.0]], "one-dimensional"),
    ],
)
def test_weights_that_are_none(weight, text):
    with pytest.raises(InputError, match=text):
        Transitions([0, 1], [0, 0], [0.0, 1.0], [1, 0], [0, 0], weight)


@pytest.mark.parametrize(
    ("ratio", "text"),
    [
        (lambda s, a, t: 1.0 * (s != 3), "weight of state 3, action 0 .and at 2 other pairs.=0 in every tuple"),
        (lambda s, a, t: np.where(t == 3, np.inf, 1.0), r"ratio\(\d, \d, 3\)=inf: must be finite and >= 0"),
        (lambda s, a, t: 1.0, "one weight a tuple"),
        (lambda s, a, t: np.full(len(s), "a"), "ratio"),
    ],
)
def test_ratios_that_are_none(setting, ratio, text):
    with pytest.raises(InputError, match=text):
        reweighted(setting[-1], ratio)


@pytest.mark.parametrize(
    "learner",
    [
        AlgorithmS1(BETA),
        ListedS1(BETA),
        *(
            getattr(learners, name)()
            for name in ("SoftQ", "DifferentialSoftQ", "RVISoftQ", "QLearning", "Sarsa", "ULearning", "ZLearning")
        ),
    ],
    ids=lambda learner: type(learner).__name__,
)
def test_learners_without_weights_say_so(setting, learner):
    _, _, _, ratio, data = setting
    weighted = reweighted(data, of(ratio))
    name = type(learner).__name__
    with pytest.raises(InputError, match=f"transitions.weight=a column: must be left out: {name} has no weights"):
        learner.fit(weighted, 5, 3)
    with pytest.raises(InputError, match=f"{name} has no weights"):
        Replicas.of(learner, 2).fit([data, weighted], 5, 3)


def test_nor_do_others_pass_them_over(setting):
    _, old, new, ratio, data = setting
    weighted = reweighted(data, of(ratio))
    with pytest.raises(InputError, match=r"chunk\.weight=a column.*online"):
        list(EfficientS1(BETA).online([weighted], 5, 3))
    with pytest.raises(InputError, match=r"demonstrations\.weight=a column"):
        fit_reward(weighted, mdp=old, beta=BETA)
    with pytest.raises(InputError, match=r"experience\.weight=a column"):
        for_dynamics(weighted, new)
    with pytest.raises(InputError, match="sample_mean_psi=False"):
        EfficientS1(BETA, sample_mean_psi=False).fit(weighted, 5, 3)
    with pytest.raises(InputError, match="reward_noise=joint"):
        CertaintyEquivalence(BETA, optimism=1.0, reward_noise="joint").solve(for_dynamics(data, new))


def test_replicas_take_weights(setting):
    _, _, _, ratio, data = setting
    weighted = reweighted(data, of(ratio))
    for make in (CertaintyEquivalence, EfficientS1):
        together = Replicas.of(make(BETA), optimism=[0.0, -1.0]).fit(weighted, 5, 3)
        for r, optimism in enumerate((0.0, -1.0)):
            assert together[r].theta == make(BETA, optimism=optimism).fit(weighted, 5, 3).theta


def test_the_page_s_example_prints_what_the_page_says(capsys):
    page = (ROOT / "docs" / "other-dynamics.md").read_text()
    code, output = re.search(r"<!-- example: shift -->\n```python\n(.*?)```\n\n```text\n(.*?)```", page, re.S).groups()
    exec(code, {})
    assert capsys.readouterr().out == output


def test_weights_that_overflow_are_refused():
    data = Transitions([0, 1], [0, 0], [0.0, 0.0], [1, 0], [0, 0], [1e250, 1.0])
    with pytest.raises(InputError, match=r"weight=inf: must be finite"):
        reweighted(data, lambda s, a, s_next: np.full(len(s), 1e100))
    with pytest.raises(InputError, match=r"ratio\(0, 0, 1\)=1e\+200: must be finite and >= 0: 0, or 1e-100 to 1e\+100"):
        reweighted(data, lambda s, a, s_next: np.full(len(s), 1e200))


@pytest.mark.parametrize("share", [0.9, 0.99])
def test_an_interval_is_withheld_where_what_was_never_seen_would_be_sought(share):
    """Under p the tempting action leads to loss; under p^ mostly to gain, which no tuple shows. The optimum of the
    weighted model keeps away from it, so that the time it spends there tells nothing."""
    rng = np.random.default_rng(0)
    n_states, beta = 3, 3.0
    p = np.zeros((n_states, 2, n_states))
    p[:, 0] = 0.2, 0.6, 0.2
    p[:, 1] = 0.3, 0.3, 0.4
    p[1, 1] = 0, 0, 1  # the tempting one
    reward = np.array([[1.0, 1.0], [0.2, 0.2], [-2.0, -2.0]])
    q = p.copy()
    q[1, 1] = share, 0, 1 - share
    n = 20_000
    s = rng.integers(n_states, size=n)
    a = rng.integers(2, size=n)
    after = (rng.random((n, 1)) > np.cumsum(p[s, a], 1)).sum(1)
    ratio = np.divide(q, p, out=np.zeros_like(p), where=p > 0)
    data = Transitions(s, a, reward[s, a], after, np.roll(a, -1), ratio[s, a, after])
    estimate = theta_uncertainty(empirical_mdp(data, n_states, 2), beta)
    exact = solve_soft_bellman(TabularMDP(q, reward), beta).theta
    assert abs(estimate.value - exact) > 0.05
    assert "at state 1, action 1 the mean weight of" in estimate.withheld
    held = theta_uncertainty(empirical_mdp(Transitions(s, a, reward[s, a], after, np.roll(a, -1)), n_states, 2), beta)
    assert not held.withheld


def test_what_was_never_seen_and_cannot_matter_withholds_nothing():
    """The row that lacks successors is of two states with the same values."""
    rng = np.random.default_rng(1)
    n = 20_000
    s, a, after = rng.integers(2, size=n), rng.integers(2, size=n), rng.integers(2, size=n)
    weight = np.where((s == 0) & (a == 0), 0.1, 1.0)
    reward = np.where(a == 0, 1.0, 0.0)
    estimate = theta_uncertainty(empirical_mdp(Transitions(s, a, reward, after, a, weight), 2, 2), 2.0)
    assert not estimate.withheld


def test_a_ratio_of_numbers_gets_one_line(setting):
    *_, data = setting
    with pytest.raises(InputError, match=r"ratio=.*a function of arrays s, a, s' \[n\]"):
        reweighted(data, lambda s, a, after: 2.0 if after == 1 else 1.0)
