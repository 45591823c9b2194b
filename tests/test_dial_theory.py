"""Section 9 of docs/theory.md in numbers, dense and written from the page: no solver is used but in the last part."""

import re
from itertools import chain, combinations
from pathlib import Path

import numpy as np
import pytest
from helpers import random_policy
from oracle import stationary

from erl_torch import InputError, TabularMDP, dynamics_in_mind, slope, solve_soft_bellman

SEEDS = range(2)  # 0 alternates between two halves
OPTIMISMS = (2.0, 1.0, 0.5, 0.0, -0.5, -2.0)


class Dial:
    """C, T, T_pi, q_V, M_V of the page, on dense arrays."""

    def __init__(self, p, r, prior, beta, optimism):
        self.p, self.r, self.prior, self.beta, self.optimism = p, r, prior, beta, optimism
        self.kappa = optimism * beta
        self.n_states, self.n_actions = r.shape

    def at(self, optimism):
        return Dial(self.p, self.r, self.prior, self.beta, optimism)

    def sure(self, v):
        """C V, [S, A]."""
        if self.kappa == 0:
            return self.p @ v
        x = np.where(self.p > 0, self.kappa * v, -np.inf)
        top = x.max(-1)
        return (top + np.log((self.p * np.exp(x - top[..., None])).sum(-1))) / self.kappa

    def tilt(self, v):
        """q_V, [S, A, S]."""
        weight = self.p * np.exp(np.where(self.p > 0, self.kappa * (v - self.sure(v)[..., None]), 0.0))
        return weight / weight.sum(-1, keepdims=True)

    def backup(self, v):
        q = self.r + self.sure(v)
        top = q.max(1)
        return top + np.log((self.prior * np.exp(self.beta * (q - top[:, None]))).sum(1)) / self.beta

    def policy(self, v):
        q = self.r + self.sure(v)
        weight = self.prior * np.exp(self.beta * (q - q.max(1, keepdims=True)))
        return weight / weight.sum(1, keepdims=True)

    def one_step(self, policy):
        return (policy * self.r).sum(1) - kl(policy, self.prior) / self.beta

    def backup_of(self, policy, v):
        """T_pi V."""
        return self.one_step(policy) + (policy * self.sure(v)).sum(1)

    def rate(self, policy, q):
        """The long-run mean of r - log(pi/prior)/beta - KL(q || p)/kappa under (pi, q), and its (s, a) shares."""
        d = stationary(flow(policy, q))[:, None] * policy
        price = kl(q, self.p) / self.kappa if self.kappa else 0.0
        return d.sum(1) @ self.one_step(policy) - (d * price).sum(), d

    def solve(self, policy=None):
        """(V, g) with V + g = TV, or T_pi V, and V(0) = 0: Newton's method."""
        v = np.zeros(self.n_states)
        for _ in range(60):
            new = self.backup(v) if policy is None else self.backup_of(policy, v)
            k = flow(self.policy(v) if policy is None else policy, self.tilt(v))
            v = v + poisson(k, new - v)[1]
        gain = (self.backup(v) if policy is None else self.backup_of(policy, v)) - v
        assert np.ptp(gain) < 1e-8
        return v, float(gain.mean())

    def matrix(self, v):
        return flow(self.prior * np.exp(self.beta * (self.r + self.sure(v) - v[:, None])), self.tilt(v))

    def root(self, v):
        return np.log(perron(self.matrix(v))[0]) / self.beta

    def bias(self, v):
        new = v + np.log(perron(self.matrix(v))[1]) / self.beta
        return new - new[0]


def flow(weight, p):
    return np.einsum("sa,sat->st", weight, p)


def poisson(k, reward):
    """(g, V) with V + g = reward + k V, V(0) = 0."""
    system = np.eye(len(k)) - k
    system[:, 0] = 1.0
    found = np.linalg.solve(system, reward)
    return found[0], np.append(0.0, found[1:])


def perron(m):
    values, vectors = np.linalg.eig(m)
    top = np.argmax(values.real)
    return values[top].real, np.abs(vectors[:, top].real)


def kl(of, to):
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(of > 0, of * np.log(of / to), 0.0).sum(-1)


def random_problem(seed, optimism, beta=None, dense=None):
    """(generator, Dial): at optimism < 0 every row has full support, else rows have few successors, with seed divisible
    by 3 in two halves that alternate."""
    rng = np.random.default_rng(seed)
    n, n_actions = 2 * int(rng.integers(2, 4)), int(rng.integers(2, 4))
    p = np.zeros((n, n_actions, n))
    if optimism < 0 if dense is None else dense:
        p += rng.dirichlet(np.full(n, 0.7), (n, n_actions)) + 0.01
    else:
        for s in range(n):
            others = np.arange((s + 1) % 2, n, 2) if seed % 3 == 0 else np.arange(n)
            for a in range(n_actions):
                p[s, a, rng.choice(others, 2, replace=False)] = 0.2 + rng.random(2)
            p[s, 0, (s + 1) % n] += 0.3  # a way through all states
    p /= p.sum(-1, keepdims=True)
    beta = float(rng.uniform(0.5, 3)) if beta is None else beta
    prior = random_policy(rng, n, n_actions) * 0.9 + 0.1 / n_actions
    return rng, Dial(p, rng.standard_normal((n, n_actions)), prior, beta, optimism)


def random_dynamics(rng, p):
    weight = p * rng.gamma(0.5, size=p.shape)
    return weight / weight.sum(-1, keepdims=True)


def two_states(optimism, beta=10.0):
    """9.6: in x (0) stay or go to y; in y (1) both actions lead to x half the time. r(x) = 1, r(y) = 0."""
    p = np.array([[[1.0, 0.0], [0.0, 1.0]], [[0.5, 0.5], [0.5, 0.5]]])
    return Dial(p, np.array([[1.0, 1.0], [0.0, 0.0]]), np.full((2, 2), 0.5), beta, optimism)


def disjoint_sets(p):
    """Whether D1, D2 of 9.6 exist."""
    n = p.shape[2]
    every = list(chain.from_iterable(combinations(range(n), k) for k in range(1, n)))
    to = p > 0

    def keeps(d):  # some action's successors all in d, in each state of d
        return all((~to[s][:, [t for t in range(n) if t not in d]].any(1)).any() for s in d)

    def meets(d):  # each action has a successor in d
        return all(to[s][:, list(d)].any(1).all() for s in d)

    return any(keeps(d) and meets(e) for d in every for e in every if not set(d) & set(e))


# -- 9.1, 9.2, 9.3: definition, certificate, a policy's worth -----------------------------------------------------


@pytest.mark.parametrize("optimism", OPTIMISMS)
@pytest.mark.parametrize("seed", SEEDS)
def test_certificate_at_any_optimism(seed, optimism):
    """9.2: min <= J(pi_V) <= g* <= max, at any V; J by 2,000 steps of the definition where the chain falls apart."""
    rng, problem = random_problem(seed, optimism)
    _, best = problem.solve()
    for scale in (0.1, 1.0, 3.0):
        v = scale * rng.standard_normal(problem.n_states)
        gain = problem.backup(v) - v
        _, worth = problem.solve(problem.policy(v))
        assert gain.min() - 1e-9 <= worth <= best + 1e-9
        assert best <= gain.max() + 1e-9
    halves = np.zeros((4, 2, 4))  # {0, 1} and {2, 3} closed
    halves[:2, :, :2] = rng.dirichlet(np.ones(2), size=(2, 2))
    halves[2:, :, 2:] = rng.dirichlet(np.ones(2), size=(2, 2))
    apart = Dial(halves, rng.standard_normal((4, 2)), random_policy(rng, 4, 2), problem.beta, optimism)
    v, steps = rng.standard_normal(4), 2000
    gain, policy, best, worth = apart.backup(v) - v, apart.policy(v), np.zeros(4), np.zeros(4)
    for _ in range(steps):
        best, worth = apart.backup(best), apart.backup_of(policy, worth)
    slack = np.ptp(v) / steps + 1e-12
    assert (gain.min() - slack <= worth / steps).all()
    assert (worth <= best + 1e-9).all()
    assert (best / steps <= gain.max() + slack).all()


@pytest.mark.parametrize("optimism", OPTIMISMS)
@pytest.mark.parametrize("seed", SEEDS)
def test_certainty_equivalent_is_an_extremum_over_dynamics(seed, optimism):
    """9.1: C V = ext_q (q V - KL(q || p)/kappa), attained by q_V; C rises with optimism, between min V and max V."""
    rng, problem = random_problem(seed, optimism)
    v = rng.standard_normal(problem.n_states)
    sure, q = problem.sure(v), problem.tilt(v)
    if optimism:
        np.testing.assert_allclose(q @ v - kl(q, problem.p) / problem.kappa, sure, atol=1e-12)
        other = random_dynamics(rng, problem.p)
        assert (optimism * (other @ v - kl(other, problem.p) / problem.kappa - sure) <= 1e-12).all()
    assert (problem.at(optimism - 0.1).sure(v) <= sure + 1e-12).all()
    assert (v.min() <= sure).all()
    assert (sure <= v.max()).all()


@pytest.mark.parametrize("optimism", OPTIMISMS)
@pytest.mark.parametrize("seed", SEEDS)
def test_worth_is_an_extremum_over_dynamics(seed, optimism):
    """9.3: J(pi) is the rate of (pi, q_pi), and no rate of (pi, q) is better (worse, below 0)."""
    rng, problem = random_problem(seed, optimism)
    policy = random_policy(rng, problem.n_states, problem.n_actions)
    v, worth = problem.solve(policy)
    assert problem.rate(policy, problem.tilt(v))[0] == pytest.approx(worth, abs=1e-9)
    if optimism:
        rate, _ = problem.rate(policy, random_dynamics(rng, problem.p))
        assert optimism * (rate - worth) <= 1e-9


@pytest.mark.parametrize("optimism", OPTIMISMS)
@pytest.mark.parametrize("seed", SEEDS)
def test_exponential_utility(seed, optimism):
    """9.3: below 1 its optimum is g*, too; at 1 every policy attains it; above 1 pi* does not maximise it."""
    rng, problem = random_problem(seed, optimism)
    if optimism == 0:
        pytest.skip("exponential utility needs kappa")
    v, best = problem.solve()

    def utility(policy):
        weight = policy ** (1 - optimism) * problem.prior**optimism * np.exp(problem.kappa * problem.r)
        return np.log(perron(flow(weight, problem.p))[0]) / problem.kappa

    assert utility(problem.policy(v)) == pytest.approx(best, abs=1e-8)
    above = []
    for _ in range(8):
        policy = random_policy(rng, problem.n_states, problem.n_actions)
        found = utility(policy)
        assert optimism * (found - problem.solve(policy)[1]) >= -1e-8
        above.append(found - best)
    if optimism < 1:
        assert max(above) <= 1e-8
    elif optimism == 1:
        np.testing.assert_allclose(above, 0, atol=1e-8)
    else:
        assert min(above) > 1e-6


# -- 9.4, 9.5: gap identity, sharper bound ------------------------------------------------------------------------


@pytest.mark.parametrize("optimism", OPTIMISMS)
@pytest.mark.parametrize("seed", SEEDS)
def test_gap_identity_at_any_optimism(seed, optimism):
    """9.4, both forms, with their one-sided bounds; and the weight of the leading term is the tilted process."""
    rng, problem = random_problem(seed, optimism)
    v, best = problem.solve()
    star, q_star = problem.policy(v), problem.tilt(v)
    price = 1 / problem.kappa if optimism else 0.0
    for near in (1.0, 1e-2):
        policy = (1 - near) * star + near * random_policy(rng, *star.shape)
        v_pi, worth = problem.solve(policy)
        q_pi, gap = problem.tilt(v_pi), best - worth
        own, at_star = problem.rate(policy, q_pi)[1], problem.rate(policy, q_star)[1]
        agent = kl(policy, star) / problem.beta
        first, second = own.sum(1) @ agent, at_star.sum(1) @ agent
        moved, back = price * kl(q_pi, q_star), price * kl(q_star, q_pi)
        assert first + (own * moved).sum() == pytest.approx(gap, abs=1e-10)
        assert second - (at_star * back).sum() == pytest.approx(gap, abs=1e-10)
        assert np.sign(optimism) * (gap - first) >= -1e-10
        assert np.sign(optimism) * (second - gap) >= -1e-10
    assert gap / second == pytest.approx(1, abs=0.05)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("optimism", [o for o in OPTIMISMS if o])
def test_one_sided_bound_of_fixed_dynamics(seed, optimism):
    """9.5: below 0, g* <= U(q_V) <= max(TV - V), U(q) the optimum at 0 of q with its price; above 0 reversed."""
    rng, problem = random_problem(seed, optimism)
    _, best = problem.solve()
    v = rng.standard_normal(problem.n_states)
    for q in (problem.tilt(v), random_dynamics(rng, problem.p) * 0.5 + problem.p * 0.5):
        paid = problem.r - kl(q, problem.p) / problem.kappa
        _, fixed = Dial(q, paid, problem.prior, problem.beta, 0.0).solve()
        assert np.sign(optimism) * (best - fixed) >= -1e-9
    paid = problem.r - kl(problem.tilt(v), problem.p) / problem.kappa
    _, fixed = Dial(problem.tilt(v), paid, problem.prior, problem.beta, 0.0).solve()
    gain = problem.backup(v) - v
    assert gain.min() - 1e-9 <= fixed <= gain.max() + 1e-9


# -- 9.6: existence -----------------------------------------------------------------------------------------------


def test_no_single_rate():
    """9.6: the two states have one rate exactly below the threshold; past it, .931 and .693, and V that runs away."""
    limit = np.log(2) / (1 - np.log(2) / 10)
    assert limit == pytest.approx(0.745, abs=5e-4)
    problem = two_states(-0.95 * limit / 10)
    v, g = problem.solve()
    np.testing.assert_allclose(problem.backup(v) - v, g, atol=1e-9)
    problem = two_states(-0.1)
    assert disjoint_sets(problem.p)
    v, steps = np.zeros(2), 4000
    for _ in range(steps):
        v = problem.backup(v)
    half = v.copy()
    for _ in range(steps):
        v = problem.backup(v)
    rate = (v - half) / steps
    np.testing.assert_allclose(rate, [1 - np.log(2) / 10, np.log(2)], atol=1e-6)
    np.testing.assert_allclose(rate, [0.931, 0.693], atol=5e-4)
    for apart in np.linspace(-5, 400, 4000):  # no V does: the gains of the states differ
        gain = problem.backup(np.array([apart, 0.0])) - np.array([apart, 0.0])
        assert gain[0] - gain[1] > 0.23


@pytest.mark.parametrize("optimism", [3.0, 1.0, 0.0, -0.02, -1.0, -5.0])
@pytest.mark.parametrize("seed", SEEDS)
def test_solution_exists(seed, optimism):
    """9.6: for optimism >= 0 on sparse and periodic chains, below 0 without the two sets, and near 0: the limit of the
    discounted solutions."""
    _, problem = random_problem(seed, optimism, beta=1.0, dense=optimism < -0.5)
    assert not (optimism < -0.5 and disjoint_sets(problem.p))
    v, g = problem.solve()
    np.testing.assert_allclose(problem.backup(v) - v, g, atol=1e-9)
    discounted = v.copy()
    for discount in (0.9, 0.99, 0.999):
        for _ in range(60):  # Newton
            residual = problem.backup(discount * discounted) - discounted
            k = flow(problem.policy(discount * discounted), problem.tilt(discount * discounted))
            discounted = discounted + np.linalg.solve(np.eye(len(v)) - discount * k, residual)
        assert np.abs(residual).max() < 1e-7
    assert (1 - discount) * discounted.min() == pytest.approx(g, abs=0.02 * (1 + np.ptp(v)))
    np.testing.assert_allclose(discounted - discounted[0], v, atol=0.05 * (1 + np.ptp(v)))


# -- 9.7: biasing -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("optimism", OPTIMISMS)
@pytest.mark.parametrize("seed", SEEDS)
def test_one_biasing_step(seed, optimism):
    """9.7: upper bounds that fall up to optimism 1, where one step ends; lower bounds that rise above."""
    rng, problem = random_problem(seed, optimism)
    best, gain = problem.solve()
    for scale in (0.1, 1.0, 2.0):
        v = scale * rng.standard_normal(problem.n_states)
        root, new = problem.root(v), problem.bias(v)
        after = problem.backup(new) - new
        if optimism <= 1:
            assert after.max() <= root + 1e-9
            assert gain - 1e-9 <= problem.root(new) <= after.max() + 1e-9
        if optimism >= 1:
            assert after.min() >= root - 1e-9
            assert after.min() - 1e-9 <= problem.root(new) <= gain + 1e-9
        if optimism == 1:
            np.testing.assert_allclose(new, best, atol=1e-8)
    zero = np.zeros(problem.n_states)  # iteration 0 does not depend on the dial
    np.testing.assert_allclose(problem.bias(zero), problem.at(0.0).bias(zero), atol=1e-10)


@pytest.mark.parametrize("optimism", [0.25, 0.5, 0.75])
@pytest.mark.parametrize("seed", SEEDS)
def test_biasing_converges_from_everywhere_between_0_and_1(seed, optimism):
    """9.7, with the bound on the span that its proof needs."""
    rng, problem = random_problem(seed, optimism, beta=1.0)
    best, gain = problem.solve()
    for scale in (1.0, 5.0):
        v = scale * rng.standard_normal(problem.n_states)
        step = problem.root(v) - problem.r.min() - np.log(problem.prior.min()) / problem.beta
        smallest = problem.p[problem.p > 0].min()
        limit = step * (smallest ** -np.arange(1.0, problem.n_states)).sum()
        for _ in range(40):
            v = problem.bias(v)
            assert np.ptp(v) <= limit
        np.testing.assert_allclose(v, best, atol=1e-8)
        assert problem.root(v) == pytest.approx(gain, abs=1e-9)


@pytest.mark.parametrize("optimism", [o for o in OPTIMISMS if o != 1])
@pytest.mark.parametrize("seed", SEEDS)
def test_biasing_is_quadratic_at_any_optimism(seed, optimism):
    """9.7: a start half as far away ends a quarter as far away."""
    rng, problem = random_problem(seed, optimism)
    best, _ = problem.solve()
    v = rng.standard_normal(problem.n_states)
    far, near = (np.ptp(problem.bias(best + step * v) - best) for step in (4e-3, 2e-3))
    assert near / far == pytest.approx(0.25, abs=0.02)


@pytest.mark.parametrize("optimism", OPTIMISMS)
@pytest.mark.parametrize("seed", SEEDS)
def test_what_never_falls(seed, optimism):
    """9.7: for optimism >= 0 the rate of (pi_V, q_V) along Newton's steps; below 0 J along exact replies."""
    rng, problem = random_problem(seed, optimism)
    v, before = rng.standard_normal(problem.n_states), -np.inf
    for _ in range(12):
        policy = problem.policy(v)
        if optimism < 0:
            v, rate = problem.solve(policy)
        else:
            rate, step = poisson(flow(policy, problem.tilt(v)), problem.backup(v) - v)
            v = v + step
            assert (problem.backup(v) - v).min() >= rate - 1e-9
        assert rate >= before - 1e-9
        before = rate
    assert before == pytest.approx(problem.solve()[1], abs=1e-8)


# -- 9.8, 9.9, 9.10: slope, Algorithm S1, interval ----------------------------------------------------------------


@pytest.mark.parametrize("optimism", [*OPTIMISMS, 1e-3])
@pytest.mark.parametrize("seed", SEEDS)
def test_slope_of_the_dial(seed, optimism):
    """9.8, against central differences; theta never rises with optimism."""
    _, problem = random_problem(seed, optimism, dense=True)
    v, g = problem.solve()
    q = problem.tilt(v)
    _, d = problem.rate(problem.policy(v), q)
    price = kl(q, problem.p) / problem.kappa**2 if optimism else (problem.p @ v**2 - (problem.p @ v) ** 2) / 2
    priced = (d * price).sum()
    agent = d.sum(1) @ kl(problem.policy(v), problem.prior)
    step = 1e-4
    higher, lower = problem.at(optimism + step).solve()[1], problem.at(optimism - step).solve()[1]
    assert lower <= g + 1e-12
    assert g <= higher + 1e-12
    assert (higher - lower) / (2 * step) == pytest.approx(problem.beta * priced, rel=1e-4, abs=1e-6)

    def at(beta):
        return Dial(problem.p, problem.r, problem.prior, beta, optimism).solve()[1]

    found = (at(problem.beta + step) - at(problem.beta - step)) / (2 * step)
    assert found == pytest.approx(agent / problem.beta**2 + optimism * priced, rel=1e-4, abs=1e-6)


@pytest.mark.parametrize("optimism", OPTIMISMS)
@pytest.mark.parametrize("seed", SEEDS)
def test_s1_lives_in_the_world_of_one_less(seed, optimism):
    """9.9: b and delta of optimism lambda are the world of lambda - 1 and its cost; lines 6-12 are a biasing step."""
    rng, problem = random_problem(seed, optimism)
    beta, prior = problem.beta, problem.prior
    v = rng.standard_normal(problem.n_states)
    psi = np.exp(-beta * v)
    power = psi ** (1 - optimism)
    mean = problem.p @ power
    level = -np.log(problem.p @ psi**-optimism) / optimism if optimism else problem.p @ np.log(psi)
    b = power / mean[..., None]
    delta = (np.log(mean) - (1 - optimism) * level) / beta
    world = problem.at(optimism - 1)
    np.testing.assert_allclose(problem.p * b, world.tilt(v), rtol=1e-9)
    np.testing.assert_allclose(delta, (1 - optimism) * (problem.sure(v) - world.sure(v)), atol=1e-10)
    assert (np.sign(1 - optimism) * delta >= -1e-12).all()
    weight = np.exp(beta * (problem.r + delta - delta.max()))
    rho, u = perron(np.einsum("sa,sat,sat,tb->satb", weight, problem.p, b, prior).reshape(prior.size, prior.size))
    assert -np.log(rho) / beta - delta.max() == pytest.approx(-problem.root(v), abs=1e-9)
    assert np.log(rho) <= beta * problem.r.max() + 1e-9
    value = np.log((prior * u.reshape(prior.shape)).sum(1)) / beta
    np.testing.assert_allclose(value - value[0], problem.bias(v), atol=1e-8)


@pytest.mark.parametrize("optimism", OPTIMISMS)
@pytest.mark.parametrize("seed", SEEDS)
def test_derivative_with_the_rows(seed, optimism):
    """9.10: dg* = sum d* (dr + dp xi); Var_p xi = chi2(q* || p)/kappa^2."""
    rng, problem = random_problem(seed, optimism)
    v, _ = problem.solve()
    q = problem.tilt(v)
    _, d = problem.rate(problem.policy(v), q)
    dr = rng.standard_normal(problem.r.shape)
    dp = np.where(problem.p > 0, rng.standard_normal(problem.p.shape), 0.0)
    dp -= (problem.p > 0) * (dp.sum(-1) / (problem.p > 0).sum(-1))[..., None]
    if optimism:
        xi = np.exp(problem.kappa * (v - problem.sure(v)[..., None])) / problem.kappa
        variance = (problem.p * xi**2).sum(-1) - (problem.p * xi).sum(-1) ** 2
        ratio = np.divide(q, problem.p, out=np.ones_like(q), where=problem.p > 0)
        np.testing.assert_allclose(variance, (problem.p * (ratio - 1) ** 2).sum(-1) / problem.kappa**2, atol=1e-10)
    else:
        xi = np.broadcast_to(v, problem.p.shape)
    step = 1e-5

    def gain(sign):
        moved = (problem.p + sign * step * dp, problem.r + sign * step * dr)
        return Dial(*moved, problem.prior, problem.beta, optimism).solve()[1]

    expected = (d * (dr + (dp * xi).sum(-1))).sum()
    assert (gain(1) - gain(-1)) / (2 * step) == pytest.approx(expected, rel=1e-5, abs=1e-7)


# -- what the package makes of it -----------------------------------------------------------------------------------


def solved(seed, optimism, **changes):
    rng, problem = random_problem(seed, optimism, **changes)
    mdp = TabularMDP(problem.p, problem.r)
    return rng, problem, mdp, solve_soft_bellman(mdp, problem.beta, problem.prior, 1e-12, optimism=optimism)


@pytest.mark.parametrize("optimism", [*OPTIMISMS, 1e-3])
@pytest.mark.parametrize("seed", SEEDS)
def test_dynamics_in_mind(seed, optimism):
    _, problem, mdp, solution = solved(seed, optimism)
    v, g = problem.solve()
    found = dynamics_in_mind(solution, mdp, problem.prior)
    q = found.mdp.transition.toarray().reshape(problem.p.shape)
    np.testing.assert_allclose(q, problem.tilt(v), atol=1e-8)
    np.testing.assert_array_equal(found.mdp.reward, mdp.reward)
    np.testing.assert_allclose(found.kl, kl(problem.tilt(v), problem.p), atol=1e-8)
    rate, d = problem.rate(problem.policy(v), problem.tilt(v))
    assert rate == pytest.approx(g, abs=1e-8)
    assert found.kl_per_step == pytest.approx((d * found.kl).sum(), abs=1e-9)
    if optimism == 0:
        np.testing.assert_array_equal(q, mdp.transition.toarray().reshape(q.shape))
        assert found.kl_per_step == 0


@pytest.mark.parametrize("optimism", [*OPTIMISMS, 1e-9, -1e-6])
@pytest.mark.parametrize("seed", SEEDS)
def test_slope(seed, optimism):
    """Of theta, by differences in the solver; it is continuous through optimism 0."""
    _, problem, mdp, solution = solved(seed, optimism, dense=True)
    found = slope(solution, mdp, problem.prior)
    step = 1e-4

    def theta(optimism, beta):
        return solve_soft_bellman(mdp, beta, problem.prior, 1e-12, optimism=optimism).theta

    beta = problem.beta
    by_optimism = (theta(optimism + step, beta) - theta(optimism - step, beta)) / (2 * step)
    by_beta = (theta(optimism, beta + step) - theta(optimism, beta - step)) / (2 * step)
    assert found.optimism == pytest.approx(by_optimism, rel=1e-5, abs=1e-7)
    assert found.beta == pytest.approx(by_beta, rel=1e-5, abs=1e-7)
    if abs(optimism) < 1e-5:
        at_zero = slope(solve_soft_bellman(mdp, beta, problem.prior, 1e-12), mdp, problem.prior)
        assert found.optimism == pytest.approx(at_zero.optimism, rel=1e-4)


def test_states_and_pairs_outside_the_problem_keep_their_rows():
    """State 3 is never met, and pair (0, 1) has prior 0."""
    p = np.zeros((4, 2, 4))
    p[:, :, 0], p[:, 0, 1], p[:, 1, 2] = 0.2, 0.8, 0.8
    mdp = TabularMDP(p, np.arange(8.0).reshape(4, 2), np.eye(4)[0])
    prior = np.array([[1.0, 0.0], [0.5, 0.5], [0.5, 0.5], [0.5, 0.5]])
    found = dynamics_in_mind(solve_soft_bellman(mdp, 1.0, prior, optimism=-1.0), mdp, prior)
    q = found.mdp.transition.toarray().reshape(p.shape)
    np.testing.assert_array_equal(q[3], p[3])
    np.testing.assert_array_equal(q[0, 1], p[0, 1])
    assert q[0, 0, 1] != p[0, 0, 1]
    assert found.kl[3].max() == found.kl[0, 1] == 0


@pytest.mark.parametrize("function", [dynamics_in_mind, slope])
def test_errors_of_solutions(function):
    problem = two_states(-0.1)
    mdp = TabularMDP(problem.p, problem.r)
    lost = solve_soft_bellman(mdp, problem.beta, problem.prior, optimism=-0.1)
    with pytest.raises(InputError, match="single rate"):
        function(lost, mdp)
    other = TabularMDP(np.ones((1, 1, 1)), np.zeros((1, 1)))
    with pytest.raises(InputError, match="shape"):
        function(lost, other)


# -- the page -----------------------------------------------------------------------------------------------------


def test_the_page_names_these_tests():
    page = (Path(__file__).parents[1] / "docs" / "theory.md").read_text()
    named = set(re.findall(r"`test_dial_theory\.py::(test_\w+)`", page))
    own = set(re.findall(r"^def (test_\w+)", Path(__file__).read_text(), re.M))
    assert own - {"test_the_page_names_these_tests", "test_errors_of_solutions"} <= named
