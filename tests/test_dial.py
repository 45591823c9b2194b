"""Any optimism, solved exactly: against many digits, games solved without a Bellman equation, and closed forms."""

import math
from itertools import pairwise

import numpy as np
import pytest
from helpers import random_mdp, random_policy
from many_digits import KINDS, Given, problem, shares
from mpmath import mp, mpf
from oracle import soft_optimum, soft_rate, stationary
from scipy.optimize import minimize

from erl_torch import InputError, Status, TabularMDP, certify, evaluate, solve_soft_bellman
from erl_torch.envs.windy_cliff import WindyCliffEnv
from erl_torch.evaluation import Judge
from erl_torch.solvers import nested
from erl_torch.solvers.certificates import gains, policy_gains
from erl_torch.solvers.optimum import measure, solve_optimum
from erl_torch.solvers.policy import objective
from erl_torch.solvers.problem import BellmanProblem

CLIFF = WindyCliffEnv().mdp
UNIFORM = np.full((15, 4), 0.25)
DIALS = (10.0, 3.0, 1.0, 0.5, 1e-3, -1e-3, -0.5, -1.0, -3.0, -10.0)
# theory.md, B6: theta on the cliff at beta 10.
ON_THE_CLIFF = {
    3.0: 0.91978, 1.5: 0.93769, 1.0: 0.95122, 0.5: 0.97357, 0.1: 1.00430, 0.0: 1.01014,
    -0.1: 1.01531, -0.5: 1.02724, -1.0: 1.03039, -3.0: 1.03177, -10.0: 1.03341,
}  # fmt: skip


# -- many digits ----------------------------------------------------------------------------------------------


class Many:
    """T, T_pi and g* of a dense problem, in as many digits as mpmath is set to."""

    def __init__(self, given: Given, kappa: float) -> None:
        self.n, self.n_actions = given.reward.shape
        self.p = [[shares(row) for row in rows] for rows in given.transition]
        self.prior = [shares(row) for row in given.prior]
        self.r = [[mpf(float(x)) for x in row] for row in given.reward]
        self.beta, self.kappa = mpf(given.beta), mpf(kappa)

    def drift(self, value, s, a):
        """(C V - V(s), the tilted row)."""
        row = self.p[s][a]
        x = [v - value[s] for v in value]
        if not self.kappa:
            return mp.fsum(w * y for w, y in zip(row, x, strict=True)), row
        top = max(self.kappa * y for w, y in zip(row, x, strict=True) if w)
        weight = [w * mp.exp(self.kappa * y - top) if w else mpf(0) for w, y in zip(row, x, strict=True)]
        total = mp.fsum(weight)
        return (top + mp.log(total)) / self.kappa, [w / total for w in weight]

    def gains(self, value):
        """(TV - V, K)."""
        gain, chain = [], []
        for s in range(self.n):
            actions = [a for a in range(self.n_actions) if self.prior[s][a]]
            found = {a: self.drift(value, s, a) for a in actions}
            q = {a: self.r[s][a] + found[a][0] for a in actions}
            top = max(q.values())
            weight = {a: self.prior[s][a] * mp.exp(self.beta * (q[a] - top)) for a in actions}
            total = mp.fsum(weight.values())
            gain.append(top + mp.log(total) / self.beta)
            chain.append([mp.fsum(weight[a] * found[a][1][t] for a in actions) / total for t in range(self.n)])
        return gain, chain

    def policy_gains(self, policy, value):
        out = []
        for s in range(self.n):
            row = shares(policy[s])
            terms = [
                row[a] * (self.r[s][a] + self.drift(value, s, a)[0] - mp.log(row[a] / self.prior[s][a]) / self.beta)
                for a in range(self.n_actions)
                if row[a]
            ]
            out.append(mp.fsum(terms))
        return out

    def rate(self, value):
        """(low, high) of g* and a value; Newton from ``value``, which may be any: the two are proven by B3."""
        value = [mpf(float(v)) for v in value]
        for _ in range(12):
            gain, chain = self.gains(value)
            low, high = min(gain), max(gain)
            if high - low < mpf(10) ** -28:
                break
            system = mp.matrix(self.n)
            for s in range(self.n):
                for t in range(self.n):
                    system[s, t] = (s == t) - chain[s][t]
                system[s, 0] = mpf(1)  # V(0) stays; its column is g's
            try:
                move = mp.lu_solve(system, mp.matrix(gain))
            except ZeroDivisionError:  # closed within the digits
                break
            value = [value[0]] + [value[s] + move[s] for s in range(1, self.n)]
        return low, high, value


def drawn(rng, kind):
    """Dense, sparse, periodic, deterministic, or in two halves that are all but closed; one class."""
    n, a = int(rng.integers(2, 6)), int(rng.integers(1, 4))
    p = rng.dirichlet(np.full(n, 0.5), size=(n, a))
    if kind == "sparse":
        p *= rng.random(p.shape) < 0.4
    if kind == "periodic":
        n += n % 2
        p = rng.dirichlet(np.full(n, 0.5), size=(n, a)) * (np.arange(n)[:, None, None] % 2 != np.arange(n) % 2)
    if kind == "deterministic":
        p = np.eye(n)[rng.integers(0, n, (n, a))]
        p[:, 0] = 0.0
    p[np.arange(n), 0, (np.arange(n) + 1) % n] += 0.3
    p[p.sum(2) == 0] = np.eye(n)[0]
    if kind == "nearly closed":
        half, eps = n // 2, 10.0 ** -rng.uniform(1, 8)
        p[:half, :, half:] *= eps
        p[half:, :, :half] *= eps
    p /= p.sum(2, keepdims=True)
    start = np.eye(n)[rng.integers(n)]
    prior = rng.dirichlet(np.full(a, 3.0), n)
    return Given(kind, p, -rng.random((n, a)), prior, start, float(10 ** rng.uniform(-1, 1.5)))


@pytest.mark.parametrize("kind", ["dense", "sparse", "periodic", "deterministic", "nearly closed"])
def test_bounds_contain_the_rate_of_many_digits(kind):
    """Every optimum in turn; that of T too: what is not converged has bounds that hold all the same."""
    rng = np.random.default_rng(sum(map(ord, kind)))
    converged = 0
    for i in range(60):
        given, optimism = drawn(rng, kind), DIALS[i % len(DIALS)]
        mdp = TabularMDP(given.transition, given.reward, given.start)
        found = solve_soft_bellman(mdp, given.beta, given.prior, optimism=optimism)
        assert found.optimism == optimism
        with mp.workdps(60):
            low, high, value = Many(given, optimism * given.beta).rate(found.value.numpy())
            below, above = (mpf(b) for b in found.theta_bounds)
            assert below <= -low
            assert -high <= above
            if found.status is not Status.CONVERGED:
                assert kind != "dense"
                continue
            assert high - low < 1e-25
            assert below <= -high <= -low <= above
            assert above - below < 1e-9
            assert found.gap < 1e-8
            same = np.array([float(v - value[0]) for v in value])
        converged += 1
        if kind != "nearly closed":  # there the value is known as far as its gains say
            np.testing.assert_allclose(found.value - found.value[0], same, atol=1e-6 * max(np.ptp(same), 1))
    assert converged >= 55


@pytest.mark.filterwarnings("ignore::erl_torch.notes.Note")
@pytest.mark.parametrize("kappa", [0.0, 1e-12, -1e-12, 1e-3, -1e-3, 2.0, -2.0, 300.0, -300.0, 1e6, -1e6])
def test_gains_lie_between_their_ends_at_any_kappa(kappa):
    rng = np.random.default_rng(3)
    for i in range(40):
        given = problem(11, i)
        if len(given.reward) > 9:
            continue
        mdp = TabularMDP(given.transition, given.reward, given.start)
        # The rows as they are stored.
        p = mdp.transition.toarray().reshape(given.transition.shape)
        value = rng.normal(size=mdp.n_states) * 10.0 ** rng.uniform(-6, 6)
        policy = random_policy(rng, *given.reward.shape)
        prior = np.asarray(given.prior, float)
        parts = (mdp.transition, mdp.reward, prior, given.beta)
        found = gains(*parts, value, kappa)
        of_policy = policy_gains(*parts, policy, value, kappa)
        with mp.workdps(400):
            many = Many(Given("", p, mdp.reward, prior, given.start, given.beta), kappa)
            exact, _ = many.gains([mpf(v) for v in value])
            exact_of_policy = many.policy_gains(policy, [mpf(v) for v in value])
            for low, x, high in zip(found.low, exact, found.high, strict=True):
                assert low <= x <= high
            for low, x, high in zip(of_policy[0], exact_of_policy, of_policy[1], strict=True):
                assert low <= x <= high
        scale = np.abs(mdp.reward).max() + np.ptp(value) + 800 / given.beta + (800 / abs(kappa) if kappa else 0)
        assert (found.high - found.low).max() <= 1e-12 * scale


@pytest.mark.parametrize("kappa", [1e-9, 3.0, -3.0])
@pytest.mark.parametrize("escape", [1e-12, 1e-100, 1e-250])
def test_a_state_that_is_rarely_left_costs_no_digit(kappa, escape):
    p = np.array([[[1.0, escape]], [[1.0, 0.0]]])
    mdp = TabularMDP(p, np.zeros((2, 1)), [1.0, 0.0])
    value = np.array([0.0, 1.7])
    found = gains(mdp.transition, mdp.reward, np.ones((2, 1)), 2.0, value, kappa)
    with mp.workdps(600):
        exact = mp.log(1 + mpf(escape) * mp.expm1(mpf(kappa) * mpf(1.7)) / (1 + mpf(escape))) / mpf(kappa)
        assert found.low[0] <= exact <= found.high[0]
    assert found.high[0] - found.low[0] < 1e-13 * abs(found.gain[0])


@pytest.mark.filterwarnings("ignore::erl_torch.notes.Note")
@pytest.mark.parametrize("kind", range(len(KINDS)))
def test_extremes_are_solved_or_said(kind):
    """Problems made to break bounds, at any optimism: no NaN, no error, bounds in order and theta within them."""
    last = -np.inf
    given = problem(5, kind)
    mdp = TabularMDP(given.transition, given.reward, given.start)
    for optimism in (1e3, 3.0, 1.0, 0.3, -0.3, -1.0, -30.0):
        found = solve_soft_bellman(mdp, given.beta, given.prior, optimism=optimism)
        low, high = found.theta_bounds
        assert low <= high
        assert found.gap >= 0
        assert not found.policy.isnan().any()
        assert found.theta is None or low <= found.theta <= high
        if found.status is not Status.REDUCIBLE:  # theta never rises with optimism
            assert high >= last
            last = max(last, low)


# -- closed forms, and figures of the theory ----------------------------------------------------------------------


@pytest.mark.parametrize(("optimism", "theta"), ON_THE_CLIFF.items())
def test_the_cliff(optimism, theta):
    found = solve_soft_bellman(CLIFF, 10.0, optimism=optimism)
    assert found.status is Status.CONVERGED
    assert found.theta == pytest.approx(theta, abs=6e-6)
    assert objective(CLIFF, found.policy.numpy(), UNIFORM, 10.0, optimism=optimism) == pytest.approx(
        -found.theta, abs=1e-9
    )
    delta = found.reward_bias.numpy()
    assert (delta >= 0).all() if optimism <= 1 else (delta <= 0).all()
    assert found.rho == pytest.approx(math.exp(-10 * (found.theta + found.reward_bias_max)), rel=1e-12)


def test_optimism_1_is_the_eigenvalue():
    """Of sum_a prior exp(beta r) p, dense, in 60 digits (a power of it, its cycle being all but periodic)."""
    found = solve_soft_bellman(CLIFF, 50.0, optimism=1.0, tol=1e-13)
    with mp.workdps(60):
        matrix = mp.zeros(15)
        for k, row in enumerate(CLIFF.transition.toarray()):
            s, a = divmod(k, 4)
            for t, x in enumerate(shares(row)):
                matrix[s, t] += mp.exp(50 * mpf(CLIFF.reward[s, a])) * x / 4
        exact = -mp.log(max(abs(x) for x in mp.eig(matrix, left=False, right=False))) / 50
        assert mpf(found.theta_bounds[0]) <= exact <= mpf(found.theta_bounds[1])
    assert found.theta == pytest.approx(0.8366259179, abs=1e-10)
    assert (found.reward_bias == 0).all()


@pytest.mark.parametrize("optimism", [3.0, 0.5, -0.5, -4.0])
def test_one_action_is_an_eigenvalue(optimism):
    """Exponential utility of the rewards, where there is no choice."""
    mdp, beta = random_mdp(np.random.default_rng(8), 5, 1), 3.0
    kappa = optimism * beta
    matrix = np.exp(kappa * mdp.reward) * mdp.transition.toarray()
    root = np.abs(np.linalg.eigvals(matrix)).max()
    assert solve_soft_bellman(mdp, beta, optimism=optimism).theta == pytest.approx(-np.log(root) / kappa, abs=1e-9)


def test_the_slope_at_0_is_priced_by_the_solution_there():
    """d theta / d optimism = -(beta/2) E Var V there, from both sides."""
    beta = 10.0
    at = solve_soft_bellman(CLIFF, beta, tol=1e-13)
    value, p = at.value.numpy(), CLIFF.transition.toarray().reshape(15, 4, 15)
    chain = np.einsum("sa,sat->st", at.policy.numpy(), p)
    spread = p @ value**2 - (p @ value) ** 2
    slope = -beta / 2 * stationary(chain) @ (at.policy.numpy() * spread).sum(1)
    assert slope == pytest.approx(-0.0528, abs=1e-4)
    for optimism in (1e-4, -1e-4):
        theta = solve_soft_bellman(CLIFF, beta, tol=1e-13, optimism=optimism).theta
        assert (theta - at.theta) / optimism == pytest.approx(slope, rel=2e-3)
    for optimism in (1e-9, -1e-9, 1e-13, -1e-13, 1e-40):
        found = solve_soft_bellman(CLIFF, beta, tol=1e-13, optimism=optimism)
        assert found.theta == pytest.approx(at.theta + optimism * slope, abs=1e-12)
        np.testing.assert_allclose(found.policy, at.policy, atol=1e-8)


def test_optimism_0_has_the_bits_of_none():
    rng = np.random.default_rng(2)
    mdp, prior = random_mdp(rng, 6, 3), random_policy(rng, 6, 3)
    plain, zero = solve_soft_bellman(mdp, 4.0, prior), solve_soft_bellman(mdp, 4.0, prior, optimism=0.0)
    for name in ("policy", "u", "psi", "value", "action_value", "reward_bias"):
        assert (getattr(plain, name) == getattr(zero, name)).all()
    assert (plain.theta_bounds, plain.gap, plain.rho, plain.n_steps) == (
        zero.theta_bounds, zero.gap, zero.rho, zero.n_steps,
    )  # fmt: skip


@pytest.mark.parametrize("optimism", [1e6, 100.0, -30.0, -100.0, -1000.0, -1e6])
def test_far_ends_of_the_dial(optimism):
    """Full support: |kappa| span V goes far beyond what exp holds, and the limit is the best or worst successor."""
    rng = np.random.default_rng(4)
    for _ in range(10):
        n, a = int(rng.integers(2, 7)), int(rng.integers(1, 4))
        p = rng.dirichlet(np.ones(n), size=(n, a)) + 1e-4
        mdp = TabularMDP(p / p.sum(2, keepdims=True), -rng.random((n, a)), np.eye(n)[0])
        beta = float(10 ** rng.uniform(-1, 1.5))
        found = solve_soft_bellman(mdp, beta, optimism=optimism)
        assert found.status is Status.CONVERGED
        # Every state is within reach: the best (worst) successor is the state with the largest (smallest) V.
        extreme = mdp.reward.astype(float)
        backed_up = np.log(np.exp(beta * extreme).mean(1)) / beta
        limit = backed_up.max() if optimism > 0 else backed_up.min()
        slack = -np.log(p.min() / p.sum(2).max()) / abs(optimism * beta)
        assert abs(-found.theta - limit) <= slack + 1e-9


def test_theta_never_rises_with_optimism():
    rng = np.random.default_rng(6)
    for _ in range(20):
        mdp, beta = random_mdp(rng, 5, 3), float(10 ** rng.uniform(-1, 1))
        rates = [solve_soft_bellman(mdp, beta, optimism=x) for x in (30, 3, 1, 0.3, 0, -0.3, -1, -3, -30)]
        assert all(a.theta_bounds[0] <= b.theta_bounds[1] for a, b in pairwise(rates))
        assert rates[0].theta < rates[-1].theta


# -- games, without a Bellman equation ------------------------------------------------------------------------------


def rows(x, shape):
    """Rows of probabilities from any numbers."""
    x = x.reshape(*shape[:-1], -1)
    x = np.concatenate([np.zeros((*x.shape[:-1], 1)), x], -1)
    w = np.exp(x - x.max(-1, keepdims=True))
    return w / w.sum(-1, keepdims=True)


def paid(p, r, kappa, q):
    """r - KL(q || p)/kappa."""
    return r - (q * np.log(q / p)).sum(-1) / kappa


@pytest.mark.parametrize("optimism", [-4.0, -1.0, -0.25])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_robust_is_the_value_of_a_game(optimism, seed):
    """min over q of the agent's optimum in q, minimised numerically, and max over pi of the least rate in any q."""
    rng = np.random.default_rng(seed)
    n, a, beta = 3, 2, 2.0
    p, r = rng.dirichlet(np.ones(n), (n, a)) + 0.02, -rng.random((n, a))
    p /= p.sum(2, keepdims=True)
    prior, kappa = np.full((n, a), 0.5), optimism * beta
    found = solve_soft_bellman(TabularMDP(p, r, np.eye(n)[0]), beta, optimism=optimism)
    pi = found.policy.numpy()

    def best_in(x):
        q = rows(x, (n, a, n))
        return soft_optimum(q, paid(p, r, kappa, q), prior, beta)[0]

    def worth_in(x):
        q = rows(x, (n, a, n))
        return soft_rate(q, paid(p, r, kappa, q), prior, beta, pi)[0]

    def worst_of(x):  # over q, by a first-order condition of its own: none is used
        return worth_in(x)

    begin = np.log(p[..., 1:] / p[..., :1]).ravel()
    least = minimize(worst_of, begin, method="BFGS", jac="3-point", options={"gtol": 1e-9})
    assert least.fun == pytest.approx(-found.theta, abs=1e-7)  # so max over pi of the least rate is at least g*
    assert best_in(least.x) == pytest.approx(-found.theta, abs=1e-5)  # and min over q of the best is at most g*
    for _ in range(5):  # no q that is drawn leaves the agent less than g*
        assert best_in(least.x + rng.normal(size=begin.size)) >= -found.theta - 1e-9


@pytest.mark.parametrize("optimism", [2.0, 0.5])
def test_optimistic_is_a_maximum_over_dynamics(optimism):
    rng = np.random.default_rng(1)
    n, a, beta = 3, 2, 2.0
    p, r = rng.dirichlet(np.ones(n), (n, a)) + 0.02, -rng.random((n, a))
    p /= p.sum(2, keepdims=True)
    prior, kappa = np.full((n, a), 0.5), optimism * beta

    def loss(x):
        q, pi = rows(x[: n * a * (n - 1)], (n, a, n)), rows(x[n * a * (n - 1) :], (n, a))
        return -soft_rate(q, paid(p, r, kappa, q), prior, beta, pi)[0]

    begin = np.concatenate([np.log(p[..., 1:] / p[..., :1]).ravel(), np.zeros(n * (a - 1))])
    best = minimize(loss, begin, method="BFGS", jac="3-point", options={"gtol": 1e-9})
    found = solve_soft_bellman(TabularMDP(p, r, np.eye(n)[0]), beta, optimism=optimism)
    assert best.fun == pytest.approx(found.theta, abs=1e-7)


# -- no single rate -----------------------------------------------------------------------------------------------


def two_rates(start=(1.0, 0.0)):
    """B5: x may stay for 1; y pays 0 and returns with probability 1/2."""
    p = np.array([[[1.0, 0.0], [0.0, 1.0]], [[0.5, 0.5], [0.5, 0.5]]])
    return TabularMDP(p, [[1.0, 1.0], [0.0, 0.0]], start)


def long_run_rates(p, r, beta, kappa, steps):
    """(T^2N 0 - T^N 0)/N from each state, by value iteration."""
    value, half = np.zeros(len(p)), None
    with np.errstate(divide="ignore"):
        log_p = np.log(p)
    for i in range(2 * steps):
        certain = np.logaddexp.reduce(log_p + kappa * value, axis=2) / kappa
        value = np.log(np.exp(beta * (r + certain - certain.max(1, keepdims=True))).mean(1)) / beta + certain.max(1)
        half = value if i == steps - 1 else half
    return (value - half) / steps


@pytest.mark.parametrize("start", [(1.0, 0.0), (0.0, 1.0), (0.5, 0.5)])
def test_where_the_rate_depends_on_the_start_it_is_said(start):
    mdp = two_rates(start)
    found = solve_soft_bellman(mdp, 10.0, optimism=-0.1)
    assert found.status is Status.NO_SINGLE_RATE
    assert found.theta is None
    assert found.rho is None
    assert "start" in found.message
    p = mdp.transition.toarray().reshape(2, 2, 2)
    rates = long_run_rates(p, mdp.reward, 10.0, -1.0, 2000)
    np.testing.assert_allclose(rates, [1 - math.log(2) / 10, math.log(2)], atol=1e-3)
    low, high = found.theta_bounds
    assert low <= -(1 - math.log(2) / 10) < -math.log(2) <= high
    assert high - low < 0.24  # no more than they are apart
    assert found.gap >= 0


def test_the_rate_is_single_up_to_the_threshold():
    threshold = -math.log(0.5) / (1 - math.log(2) / 10) / 10
    for optimism in (-0.5 * threshold, -0.9 * threshold):
        assert solve_soft_bellman(two_rates(), 10.0, optimism=optimism).status is Status.CONVERGED
    assert solve_soft_bellman(two_rates(), 10.0, optimism=-1.1 * threshold).status is Status.NO_SINGLE_RATE


def test_bounds_of_a_few_steps_are_sharpened_from_both_sides():
    """One step is too few for the gains: what the policy is worth, and what is had in the world it fears, are close."""
    rng = np.random.default_rng(12)
    for _ in range(10):
        mdp, beta = random_mdp(rng, 5, 3), 3.0
        exact = solve_soft_bellman(mdp, beta, optimism=-2.0)
        few = solve_soft_bellman(mdp, beta, optimism=-2.0, max_steps=2, tol=1e-13)
        own = BellmanProblem.of(mdp, beta, None, -2.0).gains(few.value.numpy()).theta_bounds
        low, high = few.theta_bounds
        assert low <= exact.theta_bounds[1]
        assert exact.theta_bounds[0] <= high
        assert high - low <= own[1] - own[0]


# -- what a policy is worth ------------------------------------------------------------------------------------------


def worth_many(given, kappa, policy):
    """J by value iteration on T_pi in many digits: bounds after damped steps."""
    many = Many(given, kappa)
    value = [mpf(0)] * many.n
    for _ in range(4000):
        gain = many.policy_gains(policy, value)
        if max(gain) - min(gain) < 1e-13:
            break
        value = [v + g / 2 for v, g in zip(value, gain, strict=True)]
        value = [v - value[0] for v in value]
    return min(gain), max(gain)


@pytest.mark.parametrize("optimism", [2.0, 1.0, -0.7, -5.0])
def test_worth_of_a_policy(optimism):
    rng = np.random.default_rng(21)
    for _ in range(3):
        mdp, prior, policy = random_mdp(rng, 3, 2), random_policy(rng, 3, 2), random_policy(rng, 3, 2)
        beta = float(10 ** rng.uniform(-0.5, 1))
        p = mdp.transition.toarray().reshape(3, 2, 3)
        found = nested.objective(mdp.transition, mdp.reward, prior, beta, policy, mdp.start, optimism=optimism)
        with mp.workdps(25):
            low, high = worth_many(Given("", p, mdp.reward, prior, mdp.start, beta), optimism * beta, policy)
        assert found.low <= high
        assert low <= found.high
        assert found.high - found.low < 1e-10
        assert (
            objective(mdp, policy, prior, beta, optimism=optimism)
            == found.value
            == pytest.approx(float(low), abs=1e-10)
        )
        judged = Judge(mdp, prior, 10).objective(policy, beta, optimism=optimism)
        assert judged == found.value
        seen = evaluate(mdp, policy, beta, np.random.default_rng(0), 1, 5, prior, optimism=optimism)
        assert seen.objective == found.value
        best = solve_soft_bellman(mdp, beta, prior, optimism=optimism)
        assert found.low <= -best.theta_bounds[0]


@pytest.mark.parametrize("optimism", [3.0, -3.0])
def test_worth_of_a_deterministic_policy_is_an_eigenvalue(optimism):
    rng = np.random.default_rng(5)
    mdp, beta = random_mdp(rng, 5, 3), 2.0
    choice = rng.integers(0, 3, 5)
    p = mdp.transition.toarray().reshape(5, 3, 5)[np.arange(5), choice]
    kappa = optimism * beta
    worth = mdp.reward[np.arange(5), choice] - math.log(3) / beta
    root = np.abs(np.linalg.eigvals(np.exp(kappa * worth)[:, None] * p)).max()
    j = objective(mdp, np.eye(3)[choice], np.full((5, 3), 1 / 3), beta, optimism=optimism)
    assert j == pytest.approx(math.log(root) / kappa, abs=1e-10)


@pytest.mark.parametrize("kappa", [0.3, 0.6, 0.8, 3.0])
def test_a_state_that_is_left_for_ever_counts_where_there_is_hope(kappa):
    """x pays 1 and is kept with probability 1/2, y pays 0 for ever: dynamics that keep x cost log(2)/kappa a step."""
    mdp = TabularMDP([[[0.5, 0.5]], [[0.0, 1.0]]], [[1.0], [0.0]], [1.0, 0.0])
    one = np.ones((2, 1))
    found = nested.objective(mdp.transition, mdp.reward, one, 1.0, one, mdp.start, optimism=kappa)
    exact = max(1 - math.log(2) / kappa, 0.0)
    assert found.low <= exact <= found.high
    assert found.value == pytest.approx(exact, abs=1e-6)
    hopeless = nested.objective(mdp.transition, mdp.reward, one, 1.0, one, np.array([0.0, 1.0]), optimism=kappa)
    assert hopeless.low <= 0 <= hopeless.high
    assert hopeless.value == pytest.approx(0, abs=1e-9)
    feared = nested.objective(mdp.transition, -mdp.reward, one, 1.0, one, mdp.start, optimism=-kappa)
    assert feared.value == pytest.approx(-exact, abs=1e-6)


def test_a_policy_that_leaves_the_prior_is_worth_nothing():
    mdp, prior = random_mdp(np.random.default_rng(0), 3, 2), np.array([[1.0, 0.0], [0.5, 0.5], [0.5, 0.5]])
    uniform = np.full((3, 2), 0.5)
    assert objective(mdp, uniform, prior, 1.0, optimism=-1.0) == -np.inf


@pytest.mark.parametrize("optimism", [1.0, 0.4, -0.6, -3.0])
def test_the_loss_of_a_policy(optimism):
    """B4: g* - J = E_d [KL(pi||pi*)/beta + KL(q_pi||q*)/kappa], d of pi and its own tilted dynamics."""
    rng = np.random.default_rng(17)
    mdp, prior, pi, beta = random_mdp(rng, 4, 3), random_policy(rng, 4, 3), random_policy(rng, 4, 3), 2.5
    kappa, p = optimism * beta, mdp.transition.toarray().reshape(4, 3, 4)
    best = solve_soft_bellman(mdp, beta, prior, tol=1e-13, optimism=optimism)
    value = np.zeros(4)  # of pi, by damped steps
    with np.errstate(divide="ignore"):
        cost = (pi * np.log(pi / prior)).sum(1) / beta
    for _ in range(20_000):
        gain = (pi * (mdp.reward + np.log(p @ np.exp(kappa * value)) / kappa)).sum(1) - cost - value
        value = value + 0.5 * (gain - gain[0])

    def tilt(v):
        w = p * np.exp(kappa * (v - v.max() if kappa > 0 else v - v.min()))
        return w / w.sum(2, keepdims=True)

    q, q_best = tilt(value), tilt(best.value.numpy())
    d = stationary(np.einsum("sa,sat->st", pi, q))
    policies = (pi * np.log(pi / best.policy.numpy())).sum(1) / beta
    dynamics = (pi * (q * np.log(q / q_best)).sum(2)).sum(1) / kappa
    loss = d @ (policies + dynamics)
    assert -best.theta - objective(mdp, pi, prior, beta, optimism=optimism) == pytest.approx(loss, abs=1e-9)
    optimum = solve_optimum(mdp, beta, prior, optimism=optimism)
    other = solve_soft_bellman(mdp, beta, prior, optimism=0.0)
    found = measure(mdp, optimum, other, beta, prior, optimism=optimism)
    certified = certify(other, mdp, beta, prior, optimism=optimism)
    assert certified.optimism == optimism
    assert found["gap"] == pytest.approx(certified.gap, abs=1e-8)
    assert found["gap"] > 0


def test_certify_takes_the_optimism_of_the_solution():
    mdp = random_mdp(np.random.default_rng(3), 4, 2)
    found = solve_soft_bellman(mdp, 2.0, optimism=-1.0)
    again = certify(found, mdp, 2.0)
    assert again.optimism == -1.0
    assert again.theta_bounds == found.theta_bounds
    assert again.gap < 1e-9
    assert certify(found, mdp, 2.0, optimism=0.0).theta_bounds == solve_soft_bellman(mdp, 2.0).theta_bounds


def test_lost_support_is_known():
    mdp = random_mdp(np.random.default_rng(3), 3, 2)
    own = BellmanProblem.of(mdp, 1.0, None, -10.0)
    assert not own.support_lost(np.array([0.0, 1.0, 60.0]))
    assert own.support_lost(np.array([0.0, 1.0, 80.0]))
    assert not BellmanProblem.of(mdp, 1.0).support_lost(np.array([0.0, 1.0, 1e9]))


@pytest.mark.parametrize("optimism", [np.nan, np.inf, -np.inf, "1", None, 1e120])
def test_optimism_is_a_number(optimism):
    mdp = random_mdp(np.random.default_rng(3), 3, 2)
    with pytest.raises(InputError, match="optimism"):
        solve_soft_bellman(mdp, 1.0, optimism=optimism)


@pytest.mark.parametrize("best", [{"beta": 3.0, "optimism": 0.0}, {"beta": 2.0, "optimism": -2.0}])
def test_bounds_of_another_problem_certify_nothing(best):
    mdp = random_mdp(np.random.default_rng(0), 3, 2)
    solution = solve_soft_bellman(mdp, 3.0, optimism=-2.0)
    with pytest.raises(InputError, match=r"best=of beta .* must be of beta 3, optimism -2"):
        certify(solution, mdp, 3.0, best=solve_soft_bellman(mdp, best["beta"], optimism=best["optimism"]))
    assert certify(solution, mdp, 3.0, best=solution).gap <= 1e-9


def rates(p, r, prior, beta, optimism, policy, rounds=6000):
    """(g*, J of ``policy``) at ``optimism``, by value iteration from their equations; dense rows."""
    kappa = optimism * beta

    def certain(v):
        return (
            (p @ v)
            if kappa == 0
            else np.log(np.einsum("sat,t->sa", p, np.exp(kappa * (v - v.max())))) / kappa + v.max()
        )

    with np.errstate(divide="ignore", invalid="ignore"):
        cost = np.where(policy > 0, policy * np.log(policy / prior), 0.0).sum(1) / beta
    found = []
    for backup in (
        lambda q: np.log((prior * np.exp(beta * (q - q.max()))).sum(1)) / beta + q.max(),
        lambda q: (policy * q).sum(1) - cost,
    ):
        v = np.zeros(len(r))
        for _ in range(rounds):
            new = backup(r + certain(v))
            gain, v = new - v, 0.5 * (v + new - new[0])
        assert np.ptp(gain) < 1e-9
        found.append(float(gain.mean()))
    return found


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("optimism", [-0.3, -1.0, -3.0])
@pytest.mark.parametrize("max_steps", [1, 2, 3])
def test_the_gap_of_a_search_that_was_stopped_is_a_loss(seed, optimism, max_steps):
    """Below 0 the policy at hand is worth J under nature's answer: its gap is at least g* - J, and no number of
    another problem's."""
    rng = np.random.default_rng(seed)
    mdp, beta = random_mdp(rng, 4, 3), 2.0
    prior = random_policy(rng, 4, 3)
    found = solve_soft_bellman(mdp, beta, prior, max_steps=max_steps, optimism=optimism)
    p = mdp.transition.toarray().reshape(4, 3, 4)
    best, worth = rates(p, mdp.reward, prior, beta, optimism, found.policy.numpy())
    assert found.gap >= best - worth - 1e-9
    assert found.theta_bounds[0] - 1e-9 <= -best <= found.theta_bounds[1] + 1e-9
    own = certify(found, mdp, beta, prior, optimism=optimism).gap
    assert own == pytest.approx(best - worth, abs=1e-7)
