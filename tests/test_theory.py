"""The statements of docs/theory.md in numbers, dense and written from the page: no solver is used."""

import re
from pathlib import Path

import numpy as np
import pytest
from helpers import random_policy
from oracle import stationary

RNG_SEEDS = range(12)


class Dense:
    """T, pi_V, M_V and the biasing iteration of the page, on dense arrays."""

    def __init__(self, p, r, prior, beta):
        self.p, self.r, self.prior, self.beta = p, r, prior, beta
        self.n_states, self.n_actions = r.shape

    def q(self, v):
        return self.r + self.p @ v

    def backup(self, v):
        return np.log((self.prior * np.exp(self.beta * self.q(v))).sum(1)) / self.beta

    def policy(self, v):
        weight = self.prior * np.exp(self.beta * self.q(v))
        return weight / weight.sum(1, keepdims=True)

    def chain(self, policy):
        return np.einsum("sa,sat->st", policy, self.p)

    def objective(self, policy, d):
        return d @ ((policy * self.r).sum(1) - kl(policy, self.prior) / self.beta)

    def matrix(self, v):
        return np.einsum("sa,sat->st", self.prior * np.exp(self.beta * (self.q(v) - v[:, None])), self.p)

    def root(self, v):
        return np.log(perron(self.matrix(v))[0]) / self.beta

    def bias(self, v):
        """BV, with its first entry 0."""
        new = v + np.log(perron(self.matrix(v))[1]) / self.beta
        return new - new[0]

    def solution(self, v=None):
        """(V* with V*(0) = 0, g*)."""
        v = np.zeros(self.n_states) if v is None else v
        for _ in range(60):
            v = self.bias(v)
        return v, self.root(v)


def perron(m):
    values, vectors = np.linalg.eig(m)
    top = np.argmax(values.real)
    return values[top].real, np.abs(vectors[:, top].real)


def kl(policy, other):
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(policy > 0, policy * np.log(policy / other), 0.0).sum(1)


def sparse_problem(seed, periodic=False, beta=None):
    """Irreducible, few successors a pair; with ``periodic`` every step leads from odd to even or back."""
    rng = np.random.default_rng(seed)
    n, n_actions = 2 * int(rng.integers(2, 4)), int(rng.integers(2, 4))
    p = np.zeros((n, n_actions, n))
    for s in range(n):
        for a in range(n_actions):
            others = np.arange((s + 1) % 2, n, 2) if periodic else np.arange(n)
            for to in rng.choice(others, 2, replace=False):
                p[s, a, to] = 0.2 + rng.random()
        p[s, 0, (s + 1) % n] += 0.3  # a cycle through all states
    p /= p.sum(-1, keepdims=True)
    beta = float(rng.uniform(0.5, 5)) if beta is None else beta
    return rng, Dense(
        p, rng.standard_normal((n, n_actions)), random_policy(rng, n, n_actions) * 0.9 + 0.1 / n_actions, beta
    )


# -- 1: one identity ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", RNG_SEEDS)
def test_performance_identity(seed):
    """1.1, for any value, also without full support and with two closed classes."""
    rng, problem = sparse_problem(seed)
    n = problem.n_states
    v = 2 * rng.standard_normal(n)
    policy = random_policy(rng, n, problem.n_actions)
    policy[rng.random(policy.shape) < 0.3] = 0.0
    policy[:, 0] += 1e-3
    policy /= policy.sum(1, keepdims=True)
    d = stationary(problem.chain(policy))
    identity = d @ (problem.backup(v) - v) - d @ kl(policy, problem.policy(v)) / problem.beta
    assert problem.objective(policy, d) == pytest.approx(identity, abs=1e-11)
    halves = np.zeros((4, 2, 4))  # {0, 1} and {2, 3} closed: a stationary distribution for every mixture
    halves[:2, :, :2] = rng.dirichlet(np.ones(2), size=(2, 2))
    halves[2:, :, 2:] = rng.dirichlet(np.ones(2), size=(2, 2))
    apart = Dense(halves, rng.standard_normal((4, 2)), random_policy(rng, 4, 2), problem.beta)
    policy, v = random_policy(rng, 4, 2), rng.standard_normal(4)
    chain = apart.chain(policy)
    d = np.concatenate([0.3 * stationary(chain[:2, :2]), 0.7 * stationary(chain[2:, 2:])])
    identity = d @ (apart.backup(v) - v) - d @ kl(policy, apart.policy(v)) / apart.beta
    assert apart.objective(policy, d) == pytest.approx(identity, abs=1e-11)


@pytest.mark.parametrize("seed", RNG_SEEDS)
def test_upper_bound_holds_for_policies_with_memory(seed):
    """1.2: another policy in every step."""
    rng, problem = sparse_problem(seed)
    n, steps = problem.n_states, 7
    v = rng.standard_normal(n)
    now, total = np.eye(n)[0], 0.0
    for _ in range(steps):
        policy = rng.dirichlet(np.full(problem.n_actions, 0.3), size=n)
        total += problem.objective(policy, now)
        now = now @ problem.chain(policy)
    assert total / steps <= (problem.backup(v) - v).max() + np.ptp(v) / steps + 1e-12


@pytest.mark.parametrize("seed", RNG_SEEDS)
def test_gap_is_second_order(seed):
    """1.3: g* - J over its leading term tends to 1, with an error that halves as the step does."""
    rng, problem = sparse_problem(seed)
    v, gain = problem.solution()
    best = problem.policy(v)
    eta = rng.standard_normal(best.shape) * best
    eta -= best * eta.sum(1, keepdims=True)
    leading = stationary(problem.chain(best)) @ (eta**2 / best).sum(1) / (2 * problem.beta)
    off = []
    for step in (1e-2, 5e-3):
        policy = best + step * eta
        loss = gain - problem.objective(policy, stationary(problem.chain(policy)))
        off.append(loss / (step**2 * leading) - 1)
    assert abs(off[1]) < 0.05
    assert abs(off[1]) < 0.6 * abs(off[0]) + 1e-4


# -- 2, 3: the biasing iteration ----------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", RNG_SEEDS)
def test_biasing_is_an_exact_iteration_of_s1(seed):
    """2.1: equations (4), (7)-(9) on pairs, from any psi, against M_V on states."""
    rng, problem = sparse_problem(seed)
    p, beta, prior = problem.p, problem.beta, problem.prior
    v = rng.standard_normal(problem.n_states)
    psi = np.exp(-beta * v)
    mean, mean_log = p @ psi, p @ np.log(psi)
    delta = (np.log(mean) - mean_log) / beta
    weight = np.exp(beta * (problem.r + delta - delta.max()))
    b = psi / mean[..., None]
    rho, u = perron(np.einsum("sa,sat,sat,tb->satb", weight, p, b, prior).reshape(prior.size, prior.size))
    u = u.reshape(prior.shape)
    assert -np.log(rho) / beta - delta.max() == pytest.approx(-problem.root(v), abs=1e-10)
    value = np.log((prior * u).sum(1)) / beta  # -log(psi_new)/beta
    np.testing.assert_allclose(value - value[0], problem.bias(v), atol=1e-9)
    y = perron(problem.matrix(v))[1]
    policy = prior * np.exp(beta * problem.q(v)) * (p @ y)
    np.testing.assert_allclose(
        prior * u / (prior * u).sum(1, keepdims=True), policy / policy.sum(1, keepdims=True), rtol=1e-9
    )


@pytest.mark.parametrize("seed", RNG_SEEDS)
def test_root_is_convex_and_bounds_the_optimum(seed):
    """3.1, 3.2."""
    rng, problem = sparse_problem(seed, periodic=seed % 3 == 0)
    _, gain = problem.solution()
    for scale in (0.1, 1.0, 4.0):
        v, w = scale * rng.standard_normal((2, problem.n_states))
        ends = problem.root(v), problem.root(w)
        assert problem.root(v + 3.0) == pytest.approx(ends[0], abs=1e-10)
        for t in (0.25, 0.5, 0.75):
            assert problem.root((1 - t) * v + t * w) <= (1 - t) * ends[0] + t * ends[1] + 1e-10
        new = problem.bias(v)
        above = (problem.backup(new) - new).max()
        assert gain - 1e-10 <= above <= ends[0] + 1e-10
        assert gain - 1e-10 <= problem.root(new) <= above + 1e-10


@pytest.mark.parametrize("seed", RNG_SEEDS)
def test_minimisers_and_the_kl_test(seed):
    """3.3: any V where the dynamics are deterministic; elsewhere V* + h with h constant on each pair's successors."""
    rng = np.random.default_rng(seed)
    # From {0, 1} always to {2, 3} and back: h is constant on {0, 1} and on {2, 3}.
    p = np.zeros((4, 2, 4))
    p[:2, :, 2:] = rng.dirichlet(np.ones(2), size=(2, 2))
    p[2:, :, :2] = rng.dirichlet(np.ones(2), size=(2, 2))
    stochastic = Dense(p, rng.standard_normal((4, 2)), random_policy(rng, 4, 2), 2.0)
    cycle = np.zeros((4, 2, 4))
    for s in range(4):
        cycle[s, 0, (s + 1) % 4] = cycle[s, 1, rng.integers(4)] = 1.0
    deterministic = Dense(cycle, rng.standard_normal((4, 2)), random_policy(rng, 4, 2), 2.0)
    h = np.repeat(rng.standard_normal(2), 2)
    for problem, v in ((stochastic, stochastic.solution()[0] + h), (deterministic, rng.standard_normal(4))):
        best, gain = problem.solution()
        assert problem.root(v) == pytest.approx(gain, abs=1e-10)
        y = perron(problem.matrix(v))[1]
        tilted = problem.p * y / (problem.p @ y)[..., None]
        np.testing.assert_allclose(tilted, problem.p, atol=1e-9)  # the paper's KL test holds
        np.testing.assert_allclose(problem.bias(v), best, atol=1e-9)  # and the new value solves
    moved = stochastic.solution()[0] + np.array([0.0, 0.5, 0.0, 0.0])
    assert stochastic.root(moved) > stochastic.solution()[1] + 1e-6


@pytest.mark.parametrize("seed", RNG_SEEDS)
@pytest.mark.parametrize("periodic", [False, True])
def test_global_convergence(seed, periodic):
    """3.4, 1.4: one solution from far starts, theta that never falls, bounds that close, and the bound on the span."""
    rng, problem = sparse_problem(seed, periodic, beta=1.0)
    found, gain = problem.solution()
    np.testing.assert_allclose(problem.backup(found) - found, gain, atol=1e-10)
    for scale in (1.0, 10.0):
        v = scale * rng.standard_normal(problem.n_states)
        first = before = problem.root(v)
        kappa = first - problem.r.min() - np.log(problem.prior.min()) / problem.beta
        p_min = problem.p[problem.p > 0].min()
        limit = kappa * (p_min ** -np.arange(1.0, problem.n_states)).sum()
        for _ in range(40):
            v = problem.bias(v)
            root = problem.root(v)
            assert root <= before + 1e-9
            assert np.ptp(v) <= limit
            before = root
        np.testing.assert_allclose(v, found, atol=1e-8)


@pytest.mark.parametrize("seed", RNG_SEEDS)
def test_quadratic_convergence(seed):
    """3.5: a start half as far away ends a quarter as far away."""
    rng, problem = sparse_problem(seed)
    best, gain = problem.solution()
    v = rng.standard_normal(problem.n_states)
    after, above = [], []
    for step in (1e-2, 5e-3):
        after.append(np.ptp(problem.bias(best + step * v) - best))
        above.append(problem.root(best + step * v) - gain)
    assert after[1] / after[0] == pytest.approx(0.25, abs=0.02)
    assert above[1] / above[0] == pytest.approx(0.25, abs=0.02)


@pytest.mark.parametrize("seed", RNG_SEEDS)
def test_soft_policy_iteration_never_loses(seed):
    """3.6, from a far value."""
    rng, problem = sparse_problem(seed, beta=2.0)
    v, before = 3 * rng.standard_normal(problem.n_states), -np.inf
    for _ in range(12):
        policy = problem.policy(v)
        chain = problem.chain(policy)
        gain = problem.objective(policy, stationary(chain))
        assert gain >= before - 1e-10
        system = np.eye(problem.n_states) - chain
        system[:, 0] = 1.0  # g in place of V(0) = 0
        solved = np.linalg.solve(system, problem.backup(v) - chain @ v)
        assert solved[0] == pytest.approx(gain, abs=1e-9)
        v, before = np.concatenate([[0.0], solved[1:]]), gain
    np.testing.assert_allclose(problem.backup(v) - v, problem.solution()[1], atol=1e-9)


# -- 4: the interval ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", RNG_SEEDS)
def test_derivative_of_the_optimum(seed):
    """4: dg* = sum d* (dr + dp V*), the policy free to move: central differences along transitions that exist."""
    rng, problem = sparse_problem(seed)
    v, _ = problem.solution()
    best = problem.policy(v)
    d = stationary(problem.chain(best))[:, None] * best
    dr = rng.standard_normal(problem.r.shape)
    dp = np.where(problem.p > 0, rng.standard_normal(problem.p.shape), 0.0)
    dp -= (problem.p > 0) * (dp.sum(-1) / (problem.p > 0).sum(-1))[..., None]
    step = 1e-5

    def gain(sign):
        moved = Dense(problem.p + sign * step * dp, problem.r + sign * step * dr, problem.prior, problem.beta)
        return moved.solution(v)[1]

    assert (gain(1) - gain(-1)) / (2 * step) == pytest.approx((d * (dr + dp @ v)).sum(), abs=1e-7)


# -- 5: small identities ------------------------------------------------------------------------------------------


def test_small_identities():
    rng = np.random.default_rng(0)
    lr, beta, psi = 0.1, 2.0, rng.uniform(0.2, 5.0, 3)
    mean, mean_log = 1.0, 0.0
    visits = rng.integers(3, size=25)
    for s_next in visits:  # lines 2-3 for one pair
        mean, mean_log = (1 - lr) * mean + lr * psi[s_next], (1 - lr) * mean_log + lr * np.log(psi[s_next])
        delta = (np.log(mean) - mean_log) / beta
        assert delta >= 0
        # <psi> cancels, whatever the estimates are.
        assert np.exp(beta * delta) * psi[0] / mean == pytest.approx(psi[0] * np.exp(-mean_log), rel=1e-13)
    n = len(visits)
    power = lr * (1 - lr) ** np.arange(n - 1, -1, -1)
    assert mean == pytest.approx((1 - lr) ** n + power @ psi[visits], rel=1e-13)
    # With exact averages the root is at most exp(beta max r_b), and that at most exp(beta max r).
    for seed in RNG_SEEDS:
        rng, problem = sparse_problem(seed)
        v = rng.standard_normal(problem.n_states)
        psi = np.exp(-problem.beta * v)
        delta = (np.log(problem.p @ psi) - problem.p @ np.log(psi)) / problem.beta
        log_rho = problem.beta * (problem.root(v) - delta.max())
        largest = (problem.r + delta - delta.max()).max()
        assert log_rho <= problem.beta * largest + 1e-10
        assert largest <= problem.r.max() + 1e-12


def test_the_root_bound_needs_exact_averages():
    """0 <-> 1, one action, r = 0; the averages of 0 have converged, those of 1 are a tenth of the way."""
    psi = np.exp([1.0, -1.0])
    share = np.array([1.0, 0.1])
    mean = 1 - share + share * psi[::-1]
    mean_log = share * np.log(psi[::-1])
    delta = np.log(mean) - mean_log  # beta = 1
    weight = np.exp(delta - delta.max()) * psi[::-1] / mean  # exp(r_b) b, from 0 to 1 and from 1 to 0
    assert np.sqrt(weight.prod()) > 1.4  # the root; exp(beta max r) is 1


# -- the page -----------------------------------------------------------------------------------------------------


def test_the_page_names_tests_that_exist():
    here = Path(__file__).parent
    page = (here.parent / "docs" / "theory.md").read_text()
    named = re.findall(r"`(?:(test_\w+\.py)::)?(test_\w+)`", page)
    assert len(named) > 25
    for file, name in named:
        assert f"def {name}(" in (here / (file or "test_theory.py")).read_text(), (file, name)
    own = set(re.findall(r"^def (test_\w+)", Path(__file__).read_text(), re.M)) - {
        "test_the_page_names_tests_that_exist"
    }
    assert own <= {name for file, name in named if not file}
