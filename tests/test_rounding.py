"""Bounds in floating point against many digits: mpmath and fractions, straight from the equations."""

import warnings
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
import scipy.sparse as sp
import torch
from helpers import random_mdp, random_policy
from mpmath import mp, mpf

from erl_torch import (
    InputError,
    Status,
    TabularMDP,
    certify,
    iterate_biasing,
    perron,
    solve_biasing,
    solve_soft_bellman,
)
from erl_torch.evaluation import Judge
from erl_torch.notes import Note
from erl_torch.solution import proven
from erl_torch.solvers import kernels
from erl_torch.solvers.certificates import gains, objective, policy_gains
from erl_torch.solvers.chains import RegenerativeLU, SingularChainError, long_run
from erl_torch.solvers.policy import objective as worth
from erl_torch.solvers.problem import BellmanProblem


@pytest.fixture(autouse=True)
def digits():
    with mp.workdps(60):
        yield


def hostile(rng):
    """(transition [S*A, S], reward, prior [S, A], beta): small probabilities, small priors, rewards of all sizes."""
    n_states, n_actions = int(rng.integers(1, 5)), int(rng.integers(1, 4))
    p = rng.dirichlet(np.full(n_states, 0.5), n_states * n_actions) + 1e-300
    p *= 10.0 ** rng.uniform(-40, 0, p.shape)
    p[np.arange(len(p)), np.arange(len(p)) // n_actions] += rng.random() < 0.5
    prior = 10.0 ** (rng.uniform(-20, 0, (n_states, n_actions)) * rng.integers(0, 2))
    reward = rng.normal(size=prior.shape) * 10.0 ** rng.uniform(-6, 9, prior.shape)
    mdp = TabularMDP(p, reward, normalise=True)
    prior = prior / prior.sum(1, keepdims=True)
    return mdp.transition, reward, prior, 10.0 ** rng.uniform(-12, 4)


def exact(transition, reward, value, s, a):
    """r + E V - V(s), the row divided by its sum."""
    row = slice(*transition.indptr[s * reward.shape[1] + a :][:2])
    p = [mpf(x) for x in transition.data[row]]
    mean = sum(x * mpf(value[j]) for x, j in zip(p, transition.indices[row], strict=True)) / sum(p)
    return mpf(reward[s, a]) + mean - mpf(value[s])


@pytest.mark.filterwarnings("ignore::erl_torch.notes.Note")
def test_gains_lie_between_their_ends():
    """TV - V for any V, to 60 digits; and the ends are close where no digit is lost in q itself."""
    rng = np.random.default_rng(0)
    for _ in range(400):
        transition, reward, prior, beta = hostile(rng)
        value = rng.normal(size=len(reward)) * 10.0 ** rng.uniform(-6, 12)
        found = gains(transition, reward, prior, beta, value)
        for s in range(len(reward)):
            q = [exact(transition, reward, value, s, a) for a in range(reward.shape[1])]
            top = max(q)
            weights = [mpf(x) for x in prior[s]]
            mean = sum(w * mp.exp(mpf(beta) * (x - top)) for w, x in zip(weights, q, strict=True)) / sum(weights)
            gain = top + mp.log(mean) / mpf(beta)
            assert mpf(found.low[s]) <= gain <= mpf(found.high[s])
            scale = max(abs(x) for x in q) + np.abs(reward[s]).max() + np.ptp(value)
            assert found.high[s] - found.low[s] <= 1e-13 * scale + 1e-310


@pytest.mark.filterwarnings("ignore::erl_torch.notes.Note")
def test_policy_gains_lie_between_their_ends():
    rng = np.random.default_rng(1)
    for case in range(400):
        transition, reward, prior, beta = hostile(rng)
        value = rng.normal(size=len(reward)) * 10.0 ** rng.uniform(-6, 12)
        policy = random_policy(rng, *reward.shape)
        if case % 3 == 0:  # close to the prior: KL is of second order
            policy = prior * (1 + 10.0 ** rng.uniform(-15, -1) * rng.normal(size=prior.shape) / 8)
            policy /= policy.sum(1, keepdims=True)
        if case % 3 == 1:
            policy = np.eye(reward.shape[1])[rng.integers(0, reward.shape[1], len(reward))]
        low, high = policy_gains(transition, reward, prior, beta, policy, value)
        for s in range(len(reward)):
            pi, of_prior = [mpf(x) for x in policy[s]], [mpf(x) for x in prior[s]]
            gain = mpf(0)
            for a, x in enumerate(pi):
                if x > 0:
                    ratio = (x / sum(pi)) / (of_prior[a] / sum(of_prior))
                    gain += x / sum(pi) * (exact(transition, reward, value, s, a) - mp.log(ratio) / mpf(beta))
            assert mpf(low[s]) <= gain <= mpf(high[s])


def rational_shares(chain):
    """The d with d K = d and sum 1 for a dense chain given by its off-diagonal entries: linear equations in fractions,
    and a check that they hold exactly."""
    n = len(chain)
    q = [[x if isinstance(x, Fraction) else Fraction(float(x)) for x in row] for row in chain]
    for s in range(n):
        q[s][s] = -sum(x for t, x in enumerate(q[s]) if t != s)  # K - I
    equations = [[q[s][t] for s in range(n)] + [Fraction(0)] for t in range(n - 1)] + [[Fraction(1)] * (n + 1)]
    for k in range(n):
        at = next(i for i in range(k, n) if equations[i][k] != 0)
        equations[k], equations[at] = equations[at], equations[k]
        pivot = equations[k][k]
        equations[k] = [x / pivot for x in equations[k]]
        for i in range(n):
            if i != k and equations[i][k] != 0:
                factor = equations[i][k]
                equations[i] = [x - factor * y for x, y in zip(equations[i], equations[k], strict=True)]
    d = [row[n] for row in equations]
    assert sum(d) == 1
    assert all(sum(d[s] * q[s][t] for s in range(n)) == 0 for t in range(n))
    return d


def test_shares_of_time_are_as_accurate_as_said():
    rng = np.random.default_rng(2)
    worst = 0.0
    for _ in range(60):
        n = int(rng.integers(2, 8))
        chain = rng.random((n, n)) * 10.0 ** (-150 * rng.random((n, n)) ** 2)
        share = long_run(sp.csr_array(chain), np.full(n, 1 / n))
        assert share.relative_error < 1e-12
        for found, true in zip(share.of_state, rational_shares(chain), strict=True):
            worst = max(worst, abs(float(Fraction(float(found)) / true - 1)) / share.relative_error)
    assert worst <= 1


def test_endings_of_a_chain_with_several_classes():
    """0 leaves for the closed sets {1} and {2, 3} with probabilities e and 2e, whatever e: shares 1/3 and 2/3."""
    for e in (0.1, 1e-20, 1e-200):
        chain = np.array([[1 - 3 * e, e, 2 * e, 0], [0, 1, 0, 0], [0, 0, 0.5, 0.5], [0, 0, 0.25, 0.75]])
        share = long_run(sp.csr_array(chain), np.eye(4)[0])
        np.testing.assert_allclose(share.of_state, [0, 1 / 3, 2 / 9, 4 / 9], rtol=1e-15)


@pytest.mark.parametrize("n_states", [4, 130])
@pytest.mark.parametrize("e", [1e-3, 1e-12, 1e-17, 1e-100])
@pytest.mark.filterwarnings("ignore::erl_torch.notes.Note")
def test_worth_of_a_policy_lies_between_its_bounds(n_states, e):
    """Two cycles, joined by weights e and 3 e beside the 1 of the way round; worth 0 and 1: J in closed form."""
    half = n_states // 2
    chain = np.zeros((n_states, n_states))
    for part in (range(half), range(half, n_states)):
        for i, s in enumerate(part):
            chain[s, part[(i + 1) % half]] = 1.0
    chain[0, half], chain[half, 0] = e, 3 * e
    reward = np.zeros((n_states, 1))
    reward[half:] = 1.0
    mdp = TabularMDP(chain, reward, normalise=True)
    one = np.ones((n_states, 1))
    found = objective(mdp.transition, mdp.reward, one, 1.0, one, mdp.start)
    # At the joints the flows both ways are equal; a cycle's other states get what the joint sends round.
    weights = Fraction(e), Fraction(3 * e)
    joint = [(1 + w) / w for w in weights]
    there, here = (d * (1 + (half - 1) / (1 + w)) for d, w in zip(joint, weights, strict=True))
    true = here / (here + there)
    rounding = true / 10**15  # of the rows' division on entry
    assert Fraction(found.low) <= true + rounding
    assert true - rounding <= Fraction(found.high)
    assert found.high - found.low < 1e-9
    assert found.low <= found.value <= found.high


def test_two_routes_to_the_same_worth_have_the_same_bits():
    rng = np.random.default_rng(4)
    for _ in range(30):
        mdp, prior, policy = random_mdp(rng, 9, 3), random_policy(rng, 9, 3), random_policy(rng, 9, 3)
        assert Judge(mdp, prior, 10).objective(policy, 2.0) == worth(mdp, policy, prior, 2.0)


# -- the faults, in closed form -------------------------------------------------------------------------------------


@pytest.mark.parametrize("solve", [solve_soft_bellman, solve_biasing])
@pytest.mark.parametrize(
    ("small", "beta", "reward"),
    [
        (1e-6, 1.0, 100.0),
        (1e-12, 1.0, 100.0),
        (1e-15, 1e-2, 1e4),
        (1e-16, 1.0, 1e3),
        (1e-300, 1.0, 1e3),
        (1e-9, 1e-8, 1.0),
    ],
)
def test_bounds_where_the_best_action_has_little_prior(solve, small, beta, reward):
    prior = np.array([[small, 1 - small]])
    found = solve(TabularMDP(np.ones((1, 2, 1)), [[reward, 0.0]]), beta, prior)
    a, b = mpf(prior[0, 0]), mpf(prior[0, 1])
    theta = -mp.log((a * mp.exp(mpf(beta) * reward) + b) / (a + b)) / mpf(beta)
    assert mpf(found.theta_bounds[0]) <= theta <= mpf(found.theta_bounds[1])


def test_loss_of_a_policy_that_nearly_stays_put():
    """Two states; action 0 leaves with probability e0 or e1, action 1 moves with 1/2: the worth of 'always 0'."""
    rng = np.random.default_rng(0)
    for _ in range(100):
        e = 10.0 ** rng.uniform(-300, -3) * np.array([1.0, rng.uniform(0.3, 3)])
        t = np.full((2, 2, 2), 0.5)
        t[0, 0], t[1, 0] = (1 - e[0], e[0]), (e[1], 1 - e[1])
        mdp = TabularMDP(t, [[0.0, 0.0], [1.0, 1.0]])
        best = solve_soft_bellman(mdp, 1.0)
        policy = np.array([[1.0, 0.0], [1.0, 0.0]])
        gap = certify(replace(best, policy=torch.from_numpy(policy)), mdp, 1.0, best=best).gap
        e0, e1 = Fraction(float(t[0, 0, 1])), Fraction(float(t[1, 0, 0]))
        e0 /= Fraction(float(t[0, 0, 0])) + e0
        e1 /= Fraction(float(t[1, 0, 1])) + e1
        share = e0 / (e0 + e1)
        true = mpf(share.numerator) / mpf(share.denominator) - mp.log(2)
        assert mpf(gap) >= -mpf(best.theta_bounds[1]) - true
        assert gap <= float(-best.theta_bounds[0] - true) + 1e-12


@pytest.mark.parametrize("penalty", [1e3, 1e9, 1e12])
def test_a_penalty_that_is_never_paid_loosens_nothing(penalty):
    """State 1 has an action that costs 1e12: theta* is that of the problem in which its weight is 0."""
    t = np.array([[[0.5, 0.5], [0.0, 1.0]], [[0.1, 0.9], [0.1, 0.9]]])
    mdp = TabularMDP(t, [[5.0, 10.0], [-2.0, -penalty]])
    value = [mpf(0), mpf(0)]
    for _ in range(3000):  # relative value iteration, half a step at a time; at the end 40 digits
        q = [[5 + (value[0] + value[1]) / 2, 10 + value[1]], [-2 + value[0] / 10 + 9 * value[1] / 10]]
        new = [mp.log(sum(mp.exp(x) / 2 for x in row)) for row in q]
        gain = [new[s] - value[s] for s in range(2)]
        value = [(value[s] + new[s]) / 2 - (value[0] + new[0]) / 2 for s in range(2)]
    assert abs(gain[0] - gain[1]) < mpf(10) ** -15
    for solve in (solve_soft_bellman, solve_biasing):
        found = solve(mdp, 1.0)
        assert found.status is Status.CONVERGED
        assert found.theta == pytest.approx(float(-gain[0]), abs=2e-9)
        assert found.theta_bounds[0] <= -gain[0] + mpf(10) ** -14
        assert -gain[0] - mpf(10) ** -14 <= found.theta_bounds[1]


# -- what goes in -----------------------------------------------------------------------------------------------


def test_rows_of_single_precision_are_welcome_and_named():
    rng = np.random.default_rng(5)
    p = rng.dirichlet(np.ones(5), (5, 3)).astype(np.float32)
    start = p[0, 0]
    with (
        pytest.warns(Note, match="rows of transition did not sum to 1, by up to"),
        pytest.warns(Note, match="start did not sum to 1, by up to"),
    ):
        mdp = TabularMDP(p, np.zeros((5, 3)), start)
    np.testing.assert_allclose(mdp.transition.sum(axis=1), 1, atol=4e-16)
    np.testing.assert_allclose(mdp.transition.toarray().reshape(5, 3, 5), p.astype(float), rtol=3e-7)
    with pytest.warns(Note, match="rows of prior_policy"):
        solve_soft_bellman(mdp, 1.0, rng.dirichlet(np.ones(3), 5).astype(np.float32))
    with pytest.raises(InputError, match=r"transition row 1 \(state 0, action 1\)=sum 2: must be 1 in sum, within"):
        TabularMDP([[[1.0], [2.0]]], [[0.0, 0.0]])
    with pytest.warns(Note):
        scaled = TabularMDP([[[1.0], [2.0]]], [[0.0, 0.0]], normalise=True)
    np.testing.assert_array_equal(scaled.transition.toarray(), 1.0)
    with pytest.raises(InputError, match="sum 0: must be a distribution"):
        TabularMDP([[[1.0], [0.0]]], [[0.0, 0.0]], normalise=True)


def test_rows_that_are_right_keep_their_bits():
    p = np.array([[1 / 3, 1 / 3, 1 / 3], [0.1, 0.2, 0.7], [0.25, 0.25, 0.5]])
    np.testing.assert_array_equal(TabularMDP(p, np.zeros((3, 1))).transition.toarray(), p)


@pytest.mark.parametrize("solve", [solve_soft_bellman, solve_biasing])
def test_a_printed_table_is_solved_as_its_normalised_rows(solve):
    """1/3 with eight digits, three times: the bounds are those of rows that sum to 1."""
    n = 50
    third = 0.33333333
    given = np.zeros((n, n))
    for s in range(n):
        for to in (min(s + 1, n - 1), max(s - 1, 0), s):
            given[s, to] += third
    reward = np.zeros((n, 1))
    reward[-1] = 1.0
    with pytest.warns(Note, match="by up to 1.0e-08"):
        found = solve(TabularMDP(given, reward), 1.0)
    assert found.theta_bounds[0] <= -1 / n <= found.theta_bounds[1]


@pytest.mark.parametrize("layout", ["csr", "csc", "coo", "bsr", "torch csr", "torch csc"])
def test_indices_out_of_range_are_named(layout):
    """Whatever the form: a conversion would read or write outside its arrays."""
    if layout.startswith("torch"):
        make = torch.sparse_csr_tensor if layout.endswith("csr") else torch.sparse_csc_tensor
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # torch calls the layout a beta
            far = torch.tensor([0, 700_000_000])
            p = make(torch.tensor([0, 1, 2]), far, torch.ones(2), size=(2, 2), check_invariants=False)
    else:
        p = getattr(sp, f"{layout}_array")(np.eye(2))
        if layout == "coo":
            p.coords[1][1] = 700_000_000
        else:
            p.indices[1] = 700_000_000
    with pytest.raises(InputError, match="indices in range"):
        TabularMDP(p, np.ones((2, 1)))


def test_states_that_are_never_left_do_not_reach_superlu(monkeypatch):
    monkeypatch.setattr("erl_torch.solvers.chains.ORDERED_STATES", 0)
    chain = sp.csr_array(np.array([[0.5, 0.5, 0.0], [0.0, 1.0, 0.0], [0.5, 0.0, 0.5]]))
    with pytest.raises(SingularChainError, match="state 1 is never left"):
        RegenerativeLU(chain, 0)


# -- statuses ---------------------------------------------------------------------------------------------------


def corridor(n_states):
    """Steps of -1, 0 and 1 with probability 1/3 each, whatever the action; reward 1 at the far end."""
    t = np.zeros((n_states, 2, n_states))
    for s in range(n_states):
        for to in (min(s + 1, n_states - 1), max(s - 1, 0), s):
            t[s, :, to] += 1 / 3
    reward = np.zeros((n_states, 2))
    reward[-1] = 1.0
    reward[:, 1] -= 0.01
    return TabularMDP(t, reward)


@pytest.mark.parametrize("solve", [solve_soft_bellman, solve_biasing])
@pytest.mark.parametrize("n_states", [30, 200])
def test_a_long_corridor(solve, n_states):
    """Actions move nothing, so pi* ~ exp(beta r) and the states are equally likely: theta* in closed form."""
    found = solve(corridor(n_states), 1.0)
    theta = -mpf(1) / n_states - mp.log((1 + mp.exp(mpf("-0.01"))) / 2)
    assert mpf(found.theta_bounds[0]) <= theta + mpf(10) ** -16
    assert theta - mpf(10) ** -16 <= mpf(found.theta_bounds[1])
    assert np.isfinite(found.gap)
    assert torch.isfinite(found.value).all()
    if found.status is Status.CONVERGED:
        assert found.theta == pytest.approx(float(theta), abs=1e-9)


def test_biasing_says_where_it_has_no_eigenvector():
    """0 leads to 1 and never comes back: one closed class, so soft policy iteration solves it, and Algorithm 1 not."""
    mdp = TabularMDP([[[0.5, 0.5]], [[0.0, 1.0]]], [[0.0], [2.0]], [1.0, 0.0])
    with pytest.raises(InputError, match=r"once in the closed set \[1\].*one class of states"):
        iterate_biasing(mdp, 1.0)
    found = solve_biasing(mdp, 1.0)
    assert found.status is Status.REDUCIBLE
    assert found.theta is None
    assert found.theta_bounds[0] <= -2 <= found.theta_bounds[1]
    assert "Soft policy iteration" in found.message
    assert solve_soft_bellman(mdp, 1.0).theta == pytest.approx(-2, abs=1e-12)


def test_logarithms_where_numbers_do_not_reach():
    """At beta 1e5 psi spans more than doubles do; its logarithm is finite."""
    solution = solve_soft_bellman(corridor(30), 1e5)
    assert solution.status is Status.CONVERGED
    assert not (solution.u > 0).all()
    assert torch.isfinite(solution.log_u).all()
    assert torch.isfinite(solution.log_psi).all()
    # psi = 1 / sum_a pi0 u, equation (7), in logarithms.
    total = torch.logsumexp(solution.log_u + np.log(0.5), 1)
    np.testing.assert_allclose(total + solution.log_psi, (total + solution.log_psi)[0], atol=1e-9 * 1e5)


def test_a_policy_that_stays_put_has_a_gap_in_every_chain():
    """Both states are closed under 'stay': from the start in 0 the policy earns 0 less log 2 for ever."""
    mdp = TabularMDP([[[1, 0], [0.5, 0.5]], [[0, 1], [0.5, 0.5]]], [[0.0, 0.0], [1.0, 1.0]], [0.75, 0.25])
    best = solve_soft_bellman(mdp, 1.0)
    stay = torch.tensor([[1.0, 0.0], [1.0, 0.0]], dtype=torch.float64)
    gap = certify(replace(best, policy=stay), mdp, 1.0, best=best).gap
    assert gap == pytest.approx(-best.theta - (0.25 - np.log(2)), abs=1e-9)
    assert gap >= -best.theta_bounds[1] - (0.25 - np.log(2))


def test_bounds_are_printed_away_from_what_they_enclose():
    assert proven((1.0101363366049483, 1.0101363366056269), 0.00261) == (
        "theta* in [1.010136336, 1.010136337]; objective at most 0.0027 below its maximum"
    )
    assert proven((-0.1, 0.3), 0.5) == "theta* in [-0.1000000001, 0.3]; objective at most 0.5 below its maximum"
    assert proven((-np.inf, np.inf), None) == "theta* in [-inf, inf]"


def test_digits_lost_below_the_range_of_numbers_are_known():
    """2 is reached with 3e-159 and 7e-160, and left with 1e-307: a share of 2e-11, of a product that has few digits."""
    chain = np.zeros((4, 4))
    chain[0, 1], chain[0, 3], chain[1, 0], chain[1, 2] = 3e-159, 1.0, 1.0, 7e-160
    chain[2, 0], chain[3, 0] = 1e-307, 1.0
    share, sound = kernels.gth(chain.copy())
    true = float(rational_shares(chain)[2])
    assert 1e-12 < true < 1e-10
    assert abs(share[2] / true - 1) > 1e-9
    assert not sound


def test_digits_lost_in_the_elimination_are_known():
    """0 reaches 1 by way of 2 alone, with 3e-159 and 7e-160: once 2 is out, an entry of six digits. 1 leaves with
    1e-20, so that no share of what is left of the elimination is below range."""
    chain = np.zeros((5, 5))
    chain[0, 3], chain[3, 0], chain[2, 0], chain[1, 4], chain[4, 1] = np.ones(5)
    chain[0, 2], chain[2, 1], chain[1, 0] = 3e-159, 7e-160, 1e-20
    share, sound = kernels.gth(chain.copy())
    assert abs(share[1] / float(rational_shares(chain)[1]) - 1) > 1e-9
    assert not sound


def test_the_judge_knows_rates_below_range():
    """0 is left with 1e-310, 1 with 3e-310: no elimination in normal numbers; the rewards are 0 and 1."""
    mdp = TabularMDP([[[1.0, 1e-310]], [[3e-310, 1.0]]], [[0.0], [1.0]])
    one = np.ones((2, 1))
    assert not kernels.gth(mdp.transition.toarray())[1]
    found = objective(mdp.transition, mdp.reward, one, 1.0, one, mdp.start)
    assert found.low <= 0.25 <= found.high
    assert found.low <= Judge(mdp, one, 10).objective(one, 1.0) <= found.high


def test_worth_of_random_chains_lies_between_its_bounds():
    """In fractions; a closed state that the start does not lead to, worth 100, plays no part."""
    rng = np.random.default_rng(6)
    for _ in range(100):
        n = int(rng.integers(2, 7))
        chain = np.zeros((n + 1, n + 1))
        chain[:n, :n] = rng.random((n, n)) * 10.0 ** rng.uniform(-9, 0, (n, n))
        chain[n, n] = 1.0
        reward = np.append(rng.normal(size=n) * 10.0 ** rng.uniform(-3, 3, n), 100.0)[:, None]
        mdp = TabularMDP(chain / chain.sum(1, keepdims=True), reward, np.eye(n + 1)[0])
        one = np.ones((n + 1, 1))
        found = objective(mdp.transition, reward, one, 1.0, one, mdp.start)
        dense = mdp.transition.toarray()[:n, :n]
        exact_rows = [[Fraction(float(x)) for x in row] for row in dense]
        shares = rational_shares(np.array([[x / sum(row) for x in row] for row in exact_rows], dtype=object))
        true = sum(d * Fraction(float(r)) for d, r in zip(shares, reward[:n, 0], strict=True))
        assert Fraction(found.low) <= true <= Fraction(found.high)
        assert found.high - found.low <= 1e-9 * np.abs(reward[:n]).max()


def test_policies_close_to_the_prior_have_narrow_gains():
    """KL(1/2 +- x || 1/2) = 2 x^2 to leading order; at beta 1e-6 a rounding of the logarithms would be a million times
    as large as KL/beta."""
    policy, prior, x = np.array([[0.5 + 2.0**-30, 0.5 - 2.0**-30]]), np.array([[0.5, 0.5]]), 2.0**-30
    transition = sp.csr_array(np.ones((2, 1)))
    low, high = policy_gains(transition, np.zeros((1, 2)), prior, 1e-6, policy, np.zeros(1))
    assert -2 * x**2 / 1e-6 == pytest.approx(0.5 * (low[0] + high[0]), rel=1e-5)
    assert high[0] - low[0] < 1e-15


def test_worth_where_products_of_probabilities_underflow():
    """1e-200 of choosing to go and 1e-200 of arriving: 1e-400, which is 0 in doubles, and still the way out of 0."""
    t = np.array([[[1.0, 0.0], [1.0, 1e-200]], [[0.0, 1.0], [0.0, 1.0]]])
    mdp = TabularMDP(t, [[0.0, 0.0], [-5.0, -5.0]], [1.0, 0.0])
    prior = np.full((2, 2), 0.5)
    policy = np.array([[1.0, 1e-200], [0.5, 0.5]])
    found = objective(mdp.transition, mdp.reward, prior, 1.0, policy, mdp.start)
    assert found.low <= -5 <= found.high  # in the end it is in 1 for ever
    assert found.low <= found.value <= found.high


def test_policies_of_single_precision_are_certified_as_their_normalised_rows():
    rng = np.random.default_rng(7)
    for _ in range(50):
        mdp, prior = random_mdp(rng, 3, 3), random_policy(rng, 3, 3)
        policy = random_policy(rng, 3, 3).astype(np.float32).astype(np.float64)
        rows = [[Fraction(float(x)) for x in row] for row in policy]
        rows = [[x / sum(row) for x in row] for row in rows]
        p = [[Fraction(float(x)) for x in row] for row in mdp.transition.toarray()]
        chain = [
            [sum(rows[s][a] * p[3 * s + a][j] / sum(p[3 * s + a]) for a in range(3)) for j in range(3)]
            for s in range(3)
        ]
        shares = rational_shares(np.array(chain, dtype=object))
        true = mpf(0)
        for s in range(3):
            mass = sum(mpf(float(x)) for x in prior[s])
            for a in range(3):
                pi = mpf(rows[s][a].numerator) / rows[s][a].denominator
                worth_of = mpf(mdp.reward[s, a]) - mp.log(pi * mass / mpf(prior[s, a])) / 2
                true += mpf(shares[s].numerator) / shares[s].denominator * pi * worth_of
        found = objective(mdp.transition, mdp.reward, prior, 2.0, policy, mdp.start)
        assert mpf(found.low) <= true <= mpf(found.high)
        assert found.high - found.low < 1e-10


def test_sums_that_overflow_are_refused():
    with pytest.raises(InputError, match="row 1"):
        TabularMDP([[[0.5, 0.5]], [[1e308, 1e308]]], [[0.0], [0.0]])
    with pytest.raises(InputError, match="finite sum"):
        TabularMDP([[[0.5, 0.5]], [[1e308, 1e308]]], [[0.0], [0.0]], normalise=True)


def test_the_judge_says_what_the_objective_says_off_the_prior_and_of_rough_rows():
    mdp = random_mdp(np.random.default_rng(8), 4, 2)
    prior = np.array([[0.5, 0.5]] * 3 + [[1.0, 0.0]])
    policy = np.full((4, 2), 0.5)
    assert Judge(mdp, prior, 10).objective(policy, 2.0) == worth(mdp, policy, prior, 2.0) == -np.inf
    rough = policy * np.array([[1 + 5e-6], [1.0], [1.0], [1.0]])
    prior = np.full((4, 2), 0.5)
    assert Judge(mdp, prior, 10).objective(rough, 2.0) == worth(mdp, rough, prior, 2.0)


def test_root_of_a_large_matrix_lies_between_its_bounds():
    """All entries .3: the root is n times the double next to .3."""
    for n in (10, 1000):
        low, high = perron(np.full((n, n), 0.3)).bounds
        assert mpf(low) <= mp.log(mpf(0.3) * n) <= mpf(high)


def test_products_that_underflow_are_in_the_bounds():
    """One state: theta* = -1e-307 log-weight over beta 1e-8, whatever vanishes on the way."""
    prior = np.array([[1e-307, 1.0]])
    found = solve_soft_bellman(TabularMDP(np.ones((1, 2, 1)), [[0.0, -1e-9]]), 1e-8, prior)
    a, b = mpf(prior[0, 0]), mpf(prior[0, 1])
    theta = -mp.log((a + b * mp.exp(mpf(1e-8) * mpf(-1e-9))) / (a + b)) / mpf(1e-8)
    assert mpf(found.theta_bounds[0]) <= theta <= mpf(found.theta_bounds[1])


def test_divergences_below_range_are_in_the_bounds():
    """One state, no reward, beta 1e-100: J = -KL/beta with KL near 1e-310, of which doubles keep few digits."""
    rng = np.random.default_rng(11)
    for _ in range(200):
        prior = np.array([[rng.uniform(1, 9) * 1e-311, 1.0]])
        policy = np.array([[rng.uniform(1, 9) * 1e-310, 1.0]])
        low, high = policy_gains(sp.csr_array(np.ones((2, 1))), np.zeros((1, 2)), prior, 1e-100, policy, np.zeros(1))
        with mp.workdps(700):
            x, w = mpf(policy[0, 0]), mpf(prior[0, 0])
            kl = (x * mp.log(x / w)) / (1 + x) + mp.log((1 + w) / (1 + x))
            assert mpf(low[0]) <= -kl / mpf(1e-100) <= mpf(high[0])


# -- problems that come close to what the bounds have room for: a quarter of a constant would not do ----------------


def test_rounding_of_a_drift_is_in_the_bounds():
    """One way out, of probability 1 - 9u and so 1 once divided by its sum; r takes off the drift as it is computed, so
    that the gain is the drift's rounding: 9u of the row, up to u each of difference and product."""
    rng = np.random.default_rng(12)
    one, p = np.ones((2, 1)), 1 - 9 * 2.0**-53
    transition = sp.csr_array(np.array([[0.0, p], [0.0, 1.0]]))
    for _ in range(1000):
        value = rng.uniform(1, 2, 2) * np.array([-1, 1])
        drift = p * (value[1] - value[0])
        reward = np.array([[-drift], [0.0]])
        gain = Fraction(float(value[1])) - Fraction(float(value[0])) - Fraction(float(drift))
        found = gains(transition, reward, one, 1.0, value)
        assert Fraction(float(found.low[0])) <= gain <= Fraction(float(found.high[0]))
        low, high = policy_gains(transition, reward, one, 1.0, one, value)
        assert Fraction(float(low[0])) <= gain <= Fraction(float(high[0]))


def test_rounding_of_many_small_priors_is_in_the_bounds():
    """500 priors of .51u beside .5: each rounds up in the sum of the prior, and, of exp(beta q) - 1 = -.98, down."""
    n, small = 500, 0.51 * 2.0**-53
    prior = np.concatenate([[0.5], np.full(n, small), [0.5 - n * small]])
    reward = np.concatenate([[-1e3], np.full(n, np.log(0.02)), [0.0]])
    found = gains(sp.csr_array(np.ones((n + 2, 1))), reward[None], prior[None], 1.0, np.zeros(1))
    weights = [mpf(float(x)) for x in prior]
    mean = sum(w * mp.exp(mpf(float(r))) for w, r in zip(weights, reward, strict=True)) / sum(weights)
    assert mpf(found.low[0]) <= mp.log(mean) <= mpf(found.high[0])


def test_rounding_of_a_sum_of_divergences_is_in_the_bounds():
    """1000 actions of prior .49u that are never chosen: beside the first, of .5, the sum of the terms loses each."""
    n, small = 1000, 0.49 * 2.0**-53
    prior = np.concatenate([[0.5], np.full(n, small), [0.5 - n * small]])
    policy = np.append(np.zeros(n + 1), 1.0)
    transition = sp.csr_array(np.ones((n + 2, 1)))
    low, high = policy_gains(transition, np.zeros((1, n + 2)), prior[None], 1.0, policy[None], np.zeros(1))
    kl = mp.log(sum(mpf(float(x)) for x in prior) / mpf(float(prior[-1])))
    assert mpf(low[0]) <= -kl <= mpf(high[0])


def test_rounding_of_a_divergence_where_its_terms_cancel_is_in_the_bounds():
    """Two actions, the second some 10% more likely than its prior of 1e-4: terms of 1e-5, a divergence of 1e-6."""
    rng = np.random.default_rng(13)
    transition = sp.csr_array(np.ones((2, 1)))
    for _ in range(1000):
        w = rng.uniform(1e-4, 2e-4)
        x = w * rng.uniform(1.1, 1.2)
        prior, policy = np.array([[1 - w, w]]), np.array([[1 - x, x]])
        low, high = policy_gains(transition, np.zeros((1, 2)), prior, 1.0, policy, np.zeros(1))
        pi, of_prior = [mpf(float(v)) for v in policy[0]], [mpf(float(v)) for v in prior[0]]
        kl = sum(p / sum(pi) * mp.log(p / sum(pi) / (q / sum(of_prior))) for p, q in zip(pi, of_prior, strict=True))
        assert mpf(low[0]) <= -kl <= mpf(high[0])


def test_rounding_of_a_sum_over_actions_is_in_the_bounds():
    """One state, the policy that of the prior, so KL = 0; two rewards whose mean is next to nothing."""
    rng = np.random.default_rng(14)
    transition = sp.csr_array(np.ones((2, 1)))
    for _ in range(200):
        w = rng.uniform(0.1, 0.9)
        prior = np.array([[w, 1 - w]])
        x = rng.uniform(1, 2)
        reward = np.array([[x, -x * w / (1 - w)]])
        low, high = policy_gains(transition, reward, prior, 1.0, prior, np.zeros(1))
        weights, r = [Fraction(float(v)) for v in prior[0]], [Fraction(float(v)) for v in reward[0]]
        mean = (weights[0] * r[0] + weights[1] * r[1]) / sum(weights)
        assert Fraction(float(low[0])) <= mean <= Fraction(float(high[0]))


# -- certainty equivalents ------------------------------------------------------------------------------------

HALF_UNIT = 2.0**-53


def only_rounding(row, value, kappa):
    """(low, exact, high) of the gain of a state whose reward cancels it as computed: what is left is rounding."""
    n = len(value)
    p = sp.csr_array(np.vstack([row, np.eye(n)[1:]]))
    p.eliminate_zeros()
    reward, prior = np.zeros((n, 1)), np.ones((n, 1))
    reward[0] = -gains(p, reward, prior, 1.0, value, kappa).gain[0]
    found = gains(p, reward, prior, 1.0, value, kappa)
    weights, moved = [mpf(float(x)) for x in row], [mpf(float(v)) - mpf(float(value[0])) for v in value]
    mean = mp.fsum(w * mp.exp(mpf(kappa) * x) for w, x in zip(weights, moved, strict=True)) / mp.fsum(weights)
    exact = mp.log(mean) / mpf(kappa) + mpf(float(reward[0, 0]))
    return mpf(float(found.low[0])), exact, mpf(float(found.high[0]))


def one_successor(rng):
    return np.array([0.0, 1 - 9 * HALF_UNIT]), rng.uniform(1, 2, 2) * [-1, 1], float(rng.choice([-0.1, 0.1, 1e-9]))


def rare_and_far(rng):
    t, kappa = rng.uniform(1, 600), rng.uniform(0.5, 2)
    p = np.exp(-t) * rng.uniform(0.05, 0.45)
    return np.array([1 - 9 * HALF_UNIT - p, p]), np.array([0, t / kappa]) + rng.uniform(), kappa


def rare_and_best(rng):
    t, kappa = rng.uniform(30, 300), rng.uniform(1, 5) * rng.choice([-1, 1])
    p = np.exp(-t) * rng.uniform(2, 9)
    return np.array([1 - 9 * HALF_UNIT - p, p]), np.array([0, t / kappa]) + rng.uniform(), kappa


@pytest.mark.parametrize("make", [one_successor, rare_and_far, rare_and_best], ids=lambda make: make.__name__)
def test_rounding_of_certainty_equivalents(make):
    """60 digits lie inside; with bounds a quarter as far from their middle some would not, but for the best one."""
    rng = np.random.default_rng(1)
    worst = 0.0
    for _ in range(300):
        low, exact, high = only_rounding(*make(rng))
        assert low <= exact <= high
        worst = max(worst, float(abs(exact - (low + high) / 2) / ((high - low) / 2)))
    assert worst > {"one_successor": 0.25, "rare_and_far": 0.1, "rare_and_best": 0.0}[make.__name__]


def test_what_nature_is_paid_is_rounded_up():
    """The feared problem's rewards: r + KL(q || p)/|kappa| or more, in 60 digits of the rows as they are stored."""
    rng = np.random.default_rng(0)
    for _ in range(40):
        n, kappa = int(rng.integers(2, 6)), -(10 ** rng.uniform(-2, 2))
        mdp = TabularMDP(rng.dirichlet(np.ones(n), (n, 2)), np.zeros((n, 2)))
        problem = BellmanProblem.of(mdp, 1.0, optimism=kappa)
        feared = problem.feared(rng.normal(size=n))
        p, q = problem.transition.toarray(), feared.transition.toarray()
        for row, paid in enumerate((feared.reward - problem.reward).ravel()):
            shares = [[mpf(float(x)) for x in table[row]] for table in (p, q)]
            old, new = ([x / mp.fsum(each) for x in each] for each in shares)
            kl = mp.fsum(b * mp.log(b / a) for a, b in zip(old, new, strict=True) if b)
            assert mpf(float(paid)) * mpf(float(-problem.kappa)) >= kl
