"""How far theta and a policy's value may be off, from the visit counts alone.

J(pi), the reward rate less KL/beta, of the empirical model moves with each row p(.|s,a) and mean reward that the data
got wrong. To first order, with V the relative value of pi and d its stationary distribution over pairs,

    dJ = sum_{s,a} d(s,a) (dr(s,a) + sum_s' dp(s'|s,a) V(s')),
    Var J = sum_{s,a} d(s,a)^2 Var(r + V(s') | s,a) / n(s,a)

r and s' of one tuple may go together, so the variance is that of their sum, estimated with divisor n - 1.
theta* = -J(pi*): to move pi* with the data is of second order (J is flat there), so the same formula holds. One more
sample of (s,a) takes d^2 Var (1/n - 1/(n+1)) = d^2 Var / (n (n+1)) off the variance: the pair where that is largest
comes first.

A pair seen once shows no variance: it is given the largest of the others. What the data never show (a pair or state
never visited) is no part of the problem (``erl_torch.empirical``), and not of the error either. Nor is the second
order: the optimum of a model with errors is optimistic by about what its policy loses.

The bootstrap draws n(s,a) successors anew for every pair (multinomial; the reward's mean with the noise left at a given
successor), and solves each model: it sees the second order too.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from statistics import NormalDist
from typing import Any

import numpy as np
import scipy.sparse as sp

from erl_torch import checks
from erl_torch.chains import RegenerativeLU
from erl_torch.checks import InputError
from erl_torch.empirical import EmpiricalMDP, EmpiricalProblem
from erl_torch.evaluation import kl_per_state
from erl_torch.mdp import check_policy
from erl_torch.solution import Status
from erl_torch.solvers.soft_bellman import solve_problem


@dataclass(frozen=True, eq=False)
class Estimate:
    """A figure with its error; ``str`` gives value and half width of the 95% interval: ``theta = 1.0118 +- 0.0009``."""

    name: str
    value: float  # reward a step
    standard_error: float
    samples: np.ndarray | None = None  # of the bootstrap, [n]
    variance: np.ndarray | None = None  # what each pair adds to standard_error^2, [S, A]; plug-in
    visits: np.ndarray | None = None  # [S, A]

    def interval(self, level: float = 0.95) -> tuple[float, float]:
        """Two-sided: normal, or the basic bootstrap interval (samples mirrored at the value)."""
        if not 0 < level < 1:
            raise InputError("level", level, "a number in (0, 1)")
        if self.samples is not None:
            low, high = np.quantile(self.samples, [(1 - level) / 2, (1 + level) / 2])
            return 2 * self.value - float(high), 2 * self.value - float(low)
        half = NormalDist().inv_cdf((1 + level) / 2) * self.standard_error
        return self.value - half, self.value + half

    def next_samples(self, n: int = 5) -> list[tuple[int, int, float]]:
        """The n pairs (s, a, drop of the variance by one more sample), best first. Plug-in estimates only."""
        if self.variance is None or self.visits is None:
            raise InputError("next_samples", "bootstrap", "asked of a plug-in estimate")
        drop = self.variance / (self.visits + 1)
        order = np.argsort(-drop, axis=None, kind="stable")[:n]
        return [(int(k // drop.shape[1]), int(k % drop.shape[1]), float(drop.flat[k])) for k in order]

    def __str__(self) -> str:
        low, high = self.interval()
        half = (high - low) / 2
        digits = 4
        if half > 0:
            first = int(np.floor(np.log10(half)))  # of its digits; two are shown where the first is a 1
            digits = max(0, (half < 2 * 10.0**first) - first)
        return f"{self.name} = {self.value:.{digits}f} +- {half:.{digits}f}"


def theta_uncertainty(model: EmpiricalMDP, beta: float, prior_policy: Any = None) -> Estimate:
    """Plug-in estimate of theta* from counts, with its standard error (docs/theory.md, 4).

    Args:
        model: counts and mean rewards, of ``empirical_mdp``.
        beta: inverse temperature, 1/reward, > 0.
        prior_policy: [S, A], entries > 0; None is uniform.

    Raises:
        InputError: beta or prior out of range, or a stream that never returns to any state.
    """
    part = model.problem(beta, prior_policy)
    policy = solve_problem(part.problem, model, prior_policy).policy.numpy()
    estimate = _plug_in(model, part, policy[part.problem.states])
    return replace(estimate, name="theta", value=-estimate.value)


def policy_uncertainty(model: EmpiricalMDP, policy: Any, beta: float, prior_policy: Any = None) -> Estimate:
    """J(policy), the reward rate less KL/beta, as the counts have it, with its standard error.

    Args:
        model: counts and mean rewards, of ``empirical_mdp``.
        policy: [S, A], rows sum to 1.
        beta: inverse temperature, 1/reward, > 0.
        prior_policy: [S, A], entries > 0; None is uniform.

    Raises:
        InputError: a policy [S, A] that takes an action never tried (in a state of the empirical problem).
    """
    part = model.problem(beta, prior_policy)
    table = check_policy("policy", policy, model.n_states, model.n_actions)
    untried = (table > 0) & ~part.used & part.used.any(1, keepdims=True)
    if untried.any():
        s, a = np.argwhere(untried)[0]
        raise InputError(f"policy[{s}, {a}]", table[s, a], "0, as the pair is not in the data")
    return _plug_in(model, part, table[part.problem.states])


def bootstrap_theta(
    model: EmpiricalMDP,
    beta: float,
    prior_policy: Any = None,
    n_resamples: int = 200,
    seed: int | np.random.Generator = 0,
) -> Estimate:
    """Estimate of theta* with the bootstrap's standard error and samples; the same seed gives the same samples.

    Samples whose model cannot be solved (reducible by the draw) are left out.

    Args:
        model: counts and mean rewards, of ``empirical_mdp``.
        beta: inverse temperature, 1/reward, > 0.
        prior_policy: [S, A], entries > 0; None is uniform.
        n_resamples: whole number >= 2; each solves a model.
        seed: a whole number, or a generator.

    Raises:
        InputError: an argument out of range, or fewer than two samples that can be solved.
    """
    checks.at_least("n_resamples", n_resamples, 2)
    rng = np.random.default_rng(seed)
    part = model.problem(beta, prior_policy)
    value = solve_problem(part.problem, model, prior_policy).theta
    assert value is not None
    p, visits = model.transition, model.visits.ravel()
    rows = np.repeat(np.arange(len(visits)), np.diff(p.indptr))
    within = _within(model, p.data, rows)
    samples = []
    for _ in range(n_resamples):
        counts = _multinomial(rng, visits, p, rows)
        share = counts / visits[rows]
        mean = np.bincount(rows, share * model.reward_given_next, len(visits))
        mean += rng.standard_normal(len(visits)) * np.sqrt(within / np.maximum(visits, 1))
        drawn = sp.csr_array((share, p.indices.copy(), p.indptr.copy()), shape=p.shape)
        drawn.eliminate_zeros()
        resampled = replace(model, transition=drawn, reward=mean.reshape(model.reward.shape))
        try:
            problem = resampled.problem(beta, prior_policy)
        except InputError:
            continue
        solution = solve_problem(problem.problem, model, prior_policy, tol=1e-8)
        if solution.status is Status.CONVERGED and not problem.reducible and solution.theta is not None:
            samples.append(solution.theta)
    if len(samples) < 2:
        raise InputError("transitions", f"a stream with {len(samples)} solvable resamples", "longer")
    return Estimate("theta", value, float(np.std(samples, ddof=1)), samples=np.array(samples))


def _plug_in(model: EmpiricalMDP, part: EmpiricalProblem, policy: np.ndarray) -> Estimate:
    """J of ``policy`` [n, A], on the problem's states."""
    problem = part.problem
    ref = problem.regeneration_state()
    assert ref is not None  # an empirical problem has one closed class
    prior = np.where(policy > 0, problem.prior, 1.0)
    reward = (policy * problem.reward).sum(1) - kl_per_state(policy, prior) / problem.beta
    lu = RegenerativeLU.adapted(problem.chain(policy), ref)
    gain, relative = lu.poisson(reward)
    d, value = np.zeros(model.visits.shape), np.zeros(model.n_states)
    d[problem.states], value[problem.states] = lu.stationary()[:, None] * policy, relative

    p = model.transition
    inside = np.asarray(part.used.any(1))
    rows = np.repeat(np.arange(d.size), np.diff(p.indptr))
    weight = p.data * (inside[p.indices] & part.used.ravel()[rows])
    share = np.bincount(rows, weight, d.size)  # of the visits that stay inside
    n = model.visits * share.reshape(d.shape)
    with np.errstate(invalid="ignore", divide="ignore"):
        weight = np.where(weight > 0, weight / share[rows], 0.0)
    x = model.reward_given_next + value[p.indices]
    spread = np.bincount(rows, weight * (x - np.bincount(rows, weight * x, d.size)[rows]) ** 2, d.size)
    one = ((spread + _within(model, weight, rows)).reshape(d.shape)) * n / np.maximum(n - 1, 1)
    known = part.used & (n > 1.5)
    one = np.where(known, one, np.where(part.used, one[known].max(initial=0.0), 0.0))
    variance = np.where(part.used, d**2 * one / np.maximum(n, 1), 0.0)
    return Estimate("J", gain, float(np.sqrt(variance.sum())), variance=variance, visits=model.visits)


def _within(model: EmpiricalMDP, weight: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Variance of the reward left once s' is known, mean over s', [S*A]; divisor n."""
    visits = model.visits.ravel()
    total = model.reward_variance.ravel() * (visits - 1) / np.maximum(visits, 1)
    explained = weight * (model.reward_given_next - model.reward.ravel()[rows]) ** 2
    return np.asarray(np.maximum(total - np.bincount(rows, explained, len(visits)), 0.0))


def _multinomial(rng: np.random.Generator, visits: np.ndarray, p: sp.csr_array, rows: np.ndarray) -> np.ndarray:
    """Counts [nnz] of visits[k] draws from each row, as binomials one entry after another."""
    counts = np.zeros(len(p.data), np.int64)
    left, mass = visits.copy(), np.ones(len(visits))
    width = np.diff(p.indptr)
    for j in range(int(width.max())):
        row = np.flatnonzero(width > j)
        entry = p.indptr[row] + j
        final = width[row] == j + 1
        chance = np.where(final, 1.0, np.clip(p.data[entry] / np.maximum(mass[row], 1e-300), 0.0, 1.0))
        counts[entry] = rng.binomial(left[row], chance)
        left[row] -= counts[entry]
        mass[row] -= p.data[entry]
    return counts
