"""The interval of theta, rule by rule, where its ends have a closed form or an oracle of a few lines."""

import numpy as np
import pytest
from scipy.optimize import brentq, minimize_scalar
from scipy.stats import t as student

from erl_torch import Transitions, empirical_mdp, policy_uncertainty, theta_uncertainty
from erl_torch.empirical import uncertainty
from erl_torch.empirical.uncertainty import _luck, _with_successor, _Worth
from erl_torch.solvers.chains import SingularChainError

BUDGET = 1.92


def arms(*rewards):
    """Counts of one state, the rewards of each action; an action without any was never tried."""
    a = np.repeat(np.arange(len(rewards)), [len(r) for r in rewards])
    zero = np.zeros(len(a), int)
    return empirical_mdp(Transitions(zero, a, np.concatenate(rewards), zero, zero), 1, len(rewards))


def spread(n, variance=1.0):
    """n rewards of mean 0 and this variance (divisor n - 1), n even."""
    return np.tile([1.0, -1.0], n // 2) * np.sqrt(variance * (n - 1) / n)


def walk(*rows):
    """Counts of rows (how often, s, a, r, s')."""
    n, *columns = zip(*rows, strict=True)
    s, a, r, s_next = (np.repeat(column, n) for column in columns)
    return empirical_mdp(Transitions(s, a, r, s_next, a), int(s.max()) + 1, int(a.max()) + 1)


def _at_rest(part):
    """A policy whose states are worth the same."""
    return _Worth(0.0, np.empty(0), np.zeros(part.problem.n_states))


def divergence(p, q):
    """KL(p || q) of Bernoulli."""
    return p * np.log(p / q) + (1 - p) * np.log((1 - p) / (1 - q))


@pytest.mark.parametrize("n", [4, 40])
def test_interval_of_one_row_is_students(n):
    """One state, one action, rewards 0 and 1: the mean -+ t s/sqrt(n), n - 1 degrees of freedom."""
    rewards = np.tile([0.0, 1.0, 1.0, 1.0], n // 4)
    found = theta_uncertainty(arms(rewards), 2.0)
    half = student.ppf(0.975, n - 1) * rewards.std(ddof=1) / np.sqrt(n)
    assert found.withheld == ""
    assert found.value == pytest.approx(-0.75)
    assert found.interval() == pytest.approx((-0.75 - half, -0.75 + half), abs=2e-3 * half)


def test_rewards_go_with_the_successor_that_a_row_moves_to():
    """State 0 leads to 1 in 20 of 500 draws and is paid for that on the way; 1 leads back: J = q/(1+q)."""
    n, k = 500, 20
    q, model = k / n, walk((n - k, 0, 0, 0.0, 0), (k, 0, 0, 1.0, 1), (k, 1, 0, 0.0, 0))
    ends = [brentq(lambda x: n * divergence(q, x) - BUDGET, *between) for between in ((1e-9, q), (q, 0.5))]
    found = policy_uncertainty(model, np.ones((2, 1)), 1.0)
    bias = -q * (1 - q) / n / (1 + q) ** 3
    assert found.bias == pytest.approx(bias, rel=1e-6)
    low, high = (end / (1 + end) for end in ends)
    assert found.limits(BUDGET) == pytest.approx((low, high - bias), abs=0.01 * (high - low) / 2)


@pytest.mark.parametrize("reward", [1.0, -1.0])
def test_a_row_hides_what_another_action_has_shown_on_either_side(reward):
    """From state 0 action 1 leads to 1 in 10 of 100 draws, action 0 in none of 30; 1 pays and leads back. Each is taken
    half the time. At one end h = P(1 | 0, action 0) is above 0, at a cost of -30 log(1 - h); at the other, 0."""
    n, k, none = 100, 10, 30
    model = walk(
        (none, 0, 0, 0.0, 0), (n - k, 0, 1, 0.0, 0), (k, 0, 1, 0.0, 1), *((k, 1, a, reward, 0) for a in (0, 1))
    )

    def rest(h, *between):
        """P(1 | 0, action 1) where the likelihood is spent, h being as it is."""
        return brentq(lambda q: n * divergence(k / n, q) - none * np.log1p(-h) - BUDGET, *between)

    most = 1 - np.exp(-BUDGET / none)
    far = -minimize_scalar(lambda h: -(h + rest(h, k / n, 0.9)), bounds=(0, most - 1e-9), method="bounded").fun
    assert far > 1.05 * rest(0.0, k / n, 0.9)
    ends = [reward * q / (1 + q) for q in (rest(0.0, 1e-9, k / n) / 2, far / 2)]
    found = policy_uncertainty(model, np.full((2, 2), 0.5), 1.0)
    low, high = found.limits(BUDGET)
    bias, within = found.bias, 0.01 * abs(ends[1] - ends[0])
    assert (low + max(bias, 0), high + min(bias, 0)) == pytest.approx(tuple(sorted(ends)), abs=within)


def test_rows_with_a_single_draw_may_hide_any_state():
    """0 leads to 1 nine times and to 2 once, 1 to 2, 2 to 3, 3 to 0. No state is met from most."""
    model = walk((9, 0, 0, 0.0, 1), (1, 0, 0, 0.0, 2), (10, 1, 0, 0.0, 2), (10, 2, 0, 0.0, 3), (10, 3, 0, 0.0, 0))
    part = model.problem(1.0)
    rows = uncertainty._rows(model, part, _at_rest(part))
    for worth in (np.arange(4.0), -np.arange(4.0)):
        wide, _ = _with_successor(model, part, rows, worth)
        best = int(worth.argmax())
        expected = [{1, 2, best}, {2}, {3}, {0}]
        assert [set(wide.indices[wide.indptr[s] : wide.indptr[s + 1]].tolist()) for s in range(4)] == expected
        np.testing.assert_allclose(wide.toarray(), model.transition.toarray())


@pytest.mark.parametrize(("last", "hidden"), [(2, set()), (0, {0})])
def test_any_row_may_hide_what_is_met_from_most_states(last, hidden):
    """Two actions in each of four states, all alike. 1 and 2 may lead to 0, of most worth: half of the
    states; with 3, where the last leads there, it is most."""
    pairs = ((0, 1), (1, 2), (1, 0), (2, 3), (2, 0), (3, last))
    model = walk(*((10, s, a, 0.0, s_next) for s, s_next in pairs for a in (0, 1)))
    part = model.problem(1.0)
    wide, _ = _with_successor(model, part, uncertainty._rows(model, part, _at_rest(part)), -np.arange(4.0))
    for row in (0, 1):  # both actions of 0
        assert set(wide.indices[wide.indptr[row] : wide.indptr[row + 1]].tolist()) == {1} | hidden


@pytest.mark.parametrize("bias", [0.3, -0.3])
def test_the_second_order_moves_the_end_that_it_widens(monkeypatch, bias):
    """A bias of .3 half widths of J, known to .1: one end by both, the other by twice the error alone."""
    rewards = spread(40)
    half = student.ppf(0.975, 39) / np.sqrt(40)
    monkeypatch.setattr(uncertainty, "_second_order", lambda *_: (bias * half, 0.1 * half))
    found = policy_uncertainty(arms(rewards), np.ones((1, 1)), 1.0)
    low, high = found.interval()
    assert found.withheld == ""
    assert found.value == pytest.approx(-bias * half)
    assert low / half == pytest.approx(-1 - max(bias, 0) - 0.2, abs=0.005)
    assert high / half == pytest.approx(1 - min(bias, 0) + 0.2, abs=0.005)


def test_error_of_the_mean_over_signs_is_in_the_interval(monkeypatch):
    """Both ends move out by two standard errors, and one by what the second order is off."""
    rng = np.random.default_rng(0)
    s, a = rng.integers(0, 3, 600), rng.integers(0, 2, 600)
    model = empirical_mdp(Transitions(s, a, s * 1.0, rng.integers(0, 3, 600), a), 3, 2)
    exact = theta_uncertainty(model, 0.5)
    monkeypatch.setattr(uncertainty, "BIAS_STATES", 0)
    errors, second_order = [], uncertainty._second_order
    monkeypatch.setattr(uncertainty, "_second_order", lambda *_: errors.append(second_order(*_)) or errors[-1])
    found = theta_uncertainty(model, 0.5)
    ((bias, error),) = errors
    assert abs(bias + exact.bias) < 4 * error
    before = -exact.bias
    (low, high), (lower, higher) = exact.limits(BUDGET), found.limits(BUDGET)
    assert low - lower == pytest.approx(2 * error - min(bias, 0) + min(before, 0), rel=1e-6)
    assert higher - high == pytest.approx(2 * error + max(bias, 0) - max(before, 0), rel=1e-6)


def test_smallest_visits_are_of_pairs_that_count():
    """The variance of the second mean is 2.5e-5 of the first's, then a fifth of it."""
    policy = np.array([[0.5, 0.5]])
    assert policy_uncertainty(arms(spread(100), spread(4, 1e-6)), policy, 1.0).smallest_visits == 100
    assert policy_uncertainty(arms(spread(100), spread(4, 1e-2)), policy, 1.0).smallest_visits == 4


def test_a_pair_never_tried_may_bring_the_best_reward():
    """(1/beta) log sum prior exp(beta r), the third arm with the best reward of the two that were tried."""
    beta, prior = 2.0, np.array([[0.2, 0.5, 0.3]])
    found = theta_uncertainty(arms(np.zeros(5), np.ones(5), np.empty(0)), beta, prior)
    tried, all_of_them = 0.2 + 0.5 * np.exp(beta), 0.2 + 0.8 * np.exp(beta)
    assert found.untried == (pytest.approx(np.log(all_of_them / tried) / beta), 0)


def test_a_correction_that_is_not_trusted_is_not_made():
    """Twenty arms of two rewards +-1, variance 2: beta Var_pi/2 = .95 beta/2 of J, and the error .05^.5."""
    found = theta_uncertainty(arms(*[np.array([1.0, -1.0])] * 20), 0.6)
    assert np.sqrt(1 / 20) < 0.6 * 0.95 / 2
    assert found.withheld == "the second order is larger than the first"
    assert (found.value, found.bias) == (pytest.approx(0, abs=1e-12), 0)


def test_models_that_fall_apart_have_no_end(monkeypatch):
    worth, met = uncertainty._worth, []

    def falls_apart(*arguments):
        met.append(arguments)
        if len(met) > 1:
            raise SingularChainError
        return worth(*arguments)

    monkeypatch.setattr(uncertainty, "_worth", falls_apart)
    model = walk((40, 0, 0, 1.0, 0), (10, 0, 0, 1.0, 1), (10, 1, 0, 0.0, 0))
    found = policy_uncertainty(model, np.ones((2, 1)), 1.0)
    assert len(met) > 1
    assert found.withheld == "models that fit the data fall into parts"
    assert (found.value, found.bias) == (pytest.approx(5 / 6), 0)
    assert found.interval() == (-np.inf, np.inf)


@pytest.mark.parametrize("beta", [3.0, 30.0])
@pytest.mark.parametrize("policy", [0.5, 0.9, 1.0])
def test_luck_of_two_arms(monkeypatch, beta, policy):
    """(1/beta) E log mean exp(beta e), e of two means with variances .2 and .3, by quadrature of their difference; less
    (beta/2) Var_pi(e), which the second order has."""
    monkeypatch.setattr(uncertainty, "SIGNS", 40_000)
    part = arms(spread(10, 2.0), spread(10, 3.0))
    problem = part.problem(beta)
    here = _Worth(0.0, np.array([[policy, 1 - policy]]), np.zeros(1))
    rows = uncertainty._rows(part, problem, _at_rest(problem))
    x, weight = np.polynomial.hermite_e.hermegauss(101)
    y = beta * np.sqrt(0.5) * x
    gained = weight @ (np.logaddexp(0, y) - np.log(2)) / weight.sum() / beta
    had = 0.5 * beta * policy * (1 - policy) * 0.5
    expected = max(gained - had, 0.0)
    assert _luck(problem, here, rows, np.array([[policy, 1 - policy]])) == pytest.approx(expected, abs=0.02 * gained)


@pytest.mark.parametrize(("beta", "behind", "lucky"), [(30.0, 0.0, True), (30.0, 3.0, False), (0.5, 0.0, False)])
def test_luck_is_of_arms_that_may_be_as_good(beta, behind, lucky):
    """The second is behind by so many errors of the difference, 1; with beta .5 the second order has all of it."""
    model = arms(spread(10, 5.0), spread(10, 5.0) - behind)
    part, policy = model.problem(beta), np.array([[1.0, 0.0]])
    rows = uncertainty._rows(model, part, _at_rest(part))
    assert (_luck(part, _Worth(0.0, policy, np.zeros(1)), rows, policy) > 0) is lucky


@pytest.mark.parametrize("n_arms", [2, 3, 5])
def test_the_low_end_of_the_best_of_equal_arms_is_where_all_are_low(n_arms):
    """One mean is 0, the others -.01, of 100 draws of variance 1 each; J is about the largest. It is at L where all
    are, which costs 50 sum (mean - L)^2. The steps come within a twentieth of L, from this side."""
    beta, means = 1e6, np.append(0.0, np.full(n_arms - 1, -0.01))
    model = arms(*(spread(100) + mean for mean in means))
    part, policy = model.problem(beta), np.eye(n_arms)[:1]
    luck = _luck(part, _Worth(0.0, policy, np.zeros(1)), uncertainty._rows(model, part, _at_rest(part)), policy)
    level = brentq(lambda x: 50 * (np.maximum(means - x, 0) ** 2).sum() - BUDGET, -1, 0)
    found = theta_uncertainty(model, beta)
    assert found.bias == pytest.approx(0, abs=1e-9)
    assert 0.95 * level > -found.limits(BUDGET)[1] + luck > 1.001 * level
