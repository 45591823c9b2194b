"""How far theta and a policy's value may be off, from the visit counts alone.

J(pi), the reward rate less KL/beta, of the empirical model moves with each row p(.|s,a) and mean reward that the data
got wrong. To first order, with V the relative value of pi and d its stationary distribution over pairs,

    dJ = sum_{s,a} d(s,a) (dr(s,a) + sum_s' dp(s'|s,a) V(s')),
    Var J = sum_{s,a} d(s,a)^2 Var(r + V(s') | s,a) / n(s,a)

r and s' of one tuple may go together, so the variance is that of their sum, estimated with divisor n - 1.
theta* = -J(pi*): to move pi* with the data is of second order (J is flat there), so the same formula holds. One more
sample of (s,a) takes d^2 Var (1/n - 1/(n+1)) = d^2 Var / (n (n+1)) off the variance: the pair where that is largest
comes first.

What is assumed: the draws of a pair are independent and alike, and every pair and successor that matters has been seen
more than a few times (``smallest_visits`` is the fewest draws of a pair behind at least 1% of the variance). Where that
is nearly so the interval makes up for it, and where it is not there is none (``withheld`` says why):

    rare events   the variance of a count grows with the count: a score interval, skewed as the data are, with
                  Student's t for the variance's own error
    second order  noise in the rows moves J on average (the optimum of a model with errors picks among its errors and
                  looks better than it is): derived in docs/theory.md, 4, and taken off
    unseen        successors: a row brings a new one about as often as draws have had one of their own (Good and
                  Turing), worth anyone's value; a pair seen once shows no variance and is given the largest of the
                  others; pairs never tried, were they as good as those tried in their state, widen one side

A state that the data never show is no part of the problem (``erl_torch.empirical``), nor of the error.

The bootstrap draws n(s,a) successors anew for every pair (multinomial; the reward's mean with the noise left at a given
successor), and solves each model: it sees the second order, and takes off nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from statistics import NormalDist
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp
from scipy import special

from erl_torch import checks
from erl_torch.chains import SingularChainError
from erl_torch.checks import InputError
from erl_torch.empirical import EmpiricalMDP, EmpiricalProblem
from erl_torch.evaluation import kl_per_state
from erl_torch.mdp import check_policy
from erl_torch.solution import Status
from erl_torch.solvers.soft_bellman import solve_problem

COUNTS = 0.01  # share of the variance from which a pair counts
BIAS_STATES = 1000  # beyond, the second order is left out: it takes a dense inverse
LOPSIDED = 0.1  # the middle's distance from the value, in half widths
FEWEST = 3.0  # independent events at least behind an interval


@dataclass(frozen=True, eq=False)
class Estimate:
    """A figure with its error; ``str`` gives value and 95% interval: ``theta = 1.0118 +- 0.0009``, or ``[low, high]``
    where it is lopsided."""

    name: str
    value: float  # reward a step
    standard_error: float
    samples: np.ndarray | None = None  # of the bootstrap, [n]
    variance: np.ndarray | None = None  # what each pair adds to standard_error^2, [S, A]; plug-in
    visits: np.ndarray | None = None  # [S, A]
    third: float = 0.0  # third central moment of the estimate
    freedom: float = np.inf  # degrees of freedom of standard_error, as of Student's t
    bias: float = 0.0  # of second order; taken off ``value`` already
    untried: tuple[float, float] = (0.0, 0.0)  # by how much pairs never visited may lower and raise the figure
    smallest_visits: int | None = None  # of the pairs behind at least 1% of the variance
    withheld: str = ""  # why there is no interval, if there is none

    def interval(self, level: float = 0.95) -> tuple[float, float]:
        """Two-sided; infinite where it is withheld. Of a bootstrap the basic one (samples mirrored at the value).

        Of a plug-in estimate the score interval whose variance grows along the figure as its skewness says: all T with
        (value - T)^2 <= t^2 (se^2 + (third/se^2) (T - value)), t of Student's distribution. For a count of rare events
        that is Wilson's; without skewness value -+ t se. What was never tried comes on top.
        """
        level = checks.number("level", level, lambda x: 0 < x < 1, "a number in (0, 1)")
        if self.withheld:
            return -np.inf, np.inf
        if self.samples is not None:
            low, high = np.quantile(self.samples, [(1 - level) / 2, (1 + level) / 2])
            return 2 * self.value - float(high), 2 * self.value - float(low)
        t = float(special.stdtrit(self.freedom, (1 + level) / 2)) if np.isfinite(self.freedom) else _normal(level)
        variance = self.standard_error**2
        shift = 0.5 * t**2 * self.third / variance if variance > 0 else 0.0
        half = float(np.sqrt(shift**2 + t**2 * variance))
        return self.value + shift - half - self.untried[0], self.value + shift + half + self.untried[1]

    def next_samples(self, n: int = 5) -> list[tuple[int, int, float]]:
        """The n pairs (s, a, drop of the variance by one more sample), best first. Plug-in estimates only."""
        n = checks.at_least("n", n, 1)
        if self.variance is None or self.visits is None:
            raise InputError("next_samples", "bootstrap", "asked of a plug-in estimate")
        drop = self.variance / (self.visits + 1)
        order = np.argsort(-drop, axis=None, kind="stable")[:n]
        return [(int(k // drop.shape[1]), int(k % drop.shape[1]), float(drop.flat[k])) for k in order]

    def __str__(self) -> str:
        if self.withheld:
            return f"{self.name} = {self.value:.4f}, no interval: {self.withheld}"
        low, high = self.interval()
        half = (high - low) / 2
        digits = 4
        if half > 0:
            first = int(np.floor(np.log10(half)))  # of its digits; two are shown where the first is a 1
            digits = max(0, (half < 2 * 10.0**first) - first)
        if abs(0.5 * (low + high) - self.value) > LOPSIDED * half:
            return f"{self.name} = {self.value:.{digits}f} in [{low:.{digits}f}, {high:.{digits}f}]"
        return f"{self.name} = {self.value:.{digits}f} +- {half:.{digits}f}"


def _normal(level: float) -> float:
    return NormalDist().inv_cdf((1 + level) / 2)


def theta_uncertainty(model: EmpiricalMDP, beta: float, prior_policy: Any = None) -> Estimate:
    """Plug-in estimate of theta* from counts, less its bias of second order, with its error (docs/theory.md, 4).

    Args:
        model: counts and mean rewards, of ``empirical_mdp``.
        beta: inverse temperature, 1/reward, > 0.
        prior_policy: [S, A], entries > 0; None is uniform.

    Raises:
        InputError: beta or prior out of range, or a stream that never returns to any state.
    """
    part = model.problem(beta, prior_policy)
    solution = solve_problem(part.problem, model, prior_policy)
    policy = solution.policy.numpy()
    try:
        found = _plug_in(model, part, policy[part.problem.states], optimal=True)
    except SingularChainError:  # the optimum keeps to a part that the process leaves at last, or all but closed parts
        bounds = solution.theta_bounds
        assert bounds is not None
        reason = "the optimal policy's chain falls into parts that double precision cannot join"
        return Estimate("theta", 0.5 * sum(bounds), np.inf, withheld=reason)
    return replace(
        found,
        name="theta",
        value=-found.value,
        third=-found.third,
        bias=-found.bias,
        untried=found.untried[::-1],
    )


def policy_uncertainty(model: EmpiricalMDP, policy: Any, beta: float, prior_policy: Any = None) -> Estimate:
    """J(policy), the reward rate less KL/beta, as the counts have it, less its bias of second order, with its error.

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
    return _plug_in(model, part, table[part.problem.states], optimal=False)


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
    seed = checks.seed("seed", seed)
    checks.at_least("n_resamples", n_resamples, 2)
    rng = np.random.default_rng(seed)
    part = model.problem(beta, prior_policy)
    bounds = solve_problem(part.problem, model, prior_policy).theta_bounds
    assert bounds is not None
    value = 0.5 * sum(bounds)
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


def _plug_in(model: EmpiricalMDP, part: EmpiricalProblem, policy: np.ndarray, optimal: bool) -> Estimate:
    """J of ``policy`` [n, A], on the problem's states; ``optimal``: it moves with the data."""
    problem = part.problem
    prior = np.where(policy > 0, problem.prior, 1.0)
    reward = (policy * problem.reward).sum(1) - kl_per_state(policy, prior) / problem.beta
    lu = problem.regeneration(policy)
    gain, relative = lu.poisson(reward)
    d, value = np.zeros(model.visits.shape), np.zeros(model.n_states)
    d[problem.states], value[problem.states] = lu.stationary()[:, None] * policy, relative
    rows = _rows(model, part, value)
    n = np.maximum(rows.n, 1.0)
    weight = np.where(part.used, d**2 / n, 0.0)
    variance = weight * rows.variance
    total = float(variance.sum())
    third = float((weight * d / n * rows.third).sum())
    # Twice the squared variance over the variance of its own estimate, less what the skewness explains.
    with np.errstate(invalid="ignore", divide="ignore"):
        explained = np.where(rows.variance > 0, rows.third**2 / rows.variance, 0.0)
    spread = np.maximum(rows.fourth - rows.variance**2 - explained, 0.0)
    freedom = 2 * total**2 / max(float((weight**2 * spread / n).sum()), 1e-300) if total > 0 else np.inf
    bias = _second_order(model, part, policy, rows, value, optimal)
    untried = _untried(model, part, d) if optimal else 0.0
    withheld = _withheld(total, third, bias, untried)
    if withheld:  # a correction that cannot be trusted is none
        bias = 0.0
    counts = np.flatnonzero(variance > COUNTS * total)
    fewest = int(model.visits.flat[counts].min()) if counts.size else None
    return Estimate(
        "J",
        gain - bias,
        float(np.sqrt(total)),
        variance=variance,
        visits=model.visits,
        third=third,
        freedom=max(freedom, 1.0),
        bias=bias,
        untried=(0.0, untried),
        smallest_visits=fewest,
        withheld=withheld,
    )


class _Rows(NamedTuple):
    """What the draws of each pair say of x = r + V(s'), [S, A] each."""

    n: np.ndarray  # draws that stay inside the problem
    share: np.ndarray  # of each transition entry among them, [nnz]
    x: np.ndarray  # mean of x given s', less the row's mean, [nnz]
    variance: np.ndarray  # divisor n - 1, with the successors that were never seen
    third: np.ndarray  # central moments
    fourth: np.ndarray


def _rows(model: EmpiricalMDP, part: EmpiricalProblem, value: np.ndarray) -> _Rows:
    p, shape = model.transition, model.visits.shape
    inside = np.asarray(part.used.any(1))
    rows = np.repeat(np.arange(model.visits.size), np.diff(p.indptr))
    kept = p.data * (inside[p.indices] & part.used.ravel()[rows])
    total = np.bincount(rows, kept, model.visits.size)
    n = model.visits.ravel() * total
    with np.errstate(invalid="ignore", divide="ignore"):
        share = np.where(kept > 0, kept / total[rows], 0.0)

    def mean(entries: np.ndarray) -> np.ndarray:
        return np.bincount(rows, share * entries, model.visits.size)

    x = model.reward_given_next + value[p.indices]
    centre = mean(x)
    x = x - centre[rows]
    within = _within(model, share, rows)
    between = mean(x**2)
    unbiased = np.where(n > 1.5, n / np.maximum(n - 1, 1), 1.0)
    # A successor that was never seen: the next draw brings one about as often as draws have had one of their own.
    seen_once = np.bincount(rows, (np.rint(kept * model.visits.ravel()[rows]) == 1), model.visits.size)
    new = seen_once / np.maximum(n, 1)  # Good and Turing
    others = value[inside]
    away = others.var() + (others.mean() - (centre - model.reward.ravel())) ** 2
    variance = (between + within) * unbiased + new * away
    known = part.used.ravel() & (n > 1.5)
    # One draw shows no variance: it is given the largest of the others.
    largest = variance[known].max(initial=0.0)
    variance = np.where(known, variance, np.where(part.used.ravel(), np.maximum(largest, variance), 0.0))
    third = mean(x**3)
    fourth = mean(x**4) + 6 * between * within + 3 * within**2 + new * away**2
    return _Rows(n.reshape(shape), share, x, *(m.reshape(shape) for m in (variance, third, fourth)))


def _second_order(
    model: EmpiricalMDP, part: EmpiricalProblem, policy: np.ndarray, rows: _Rows, value: np.ndarray, optimal: bool
) -> float:
    """By how much noise in rows moves J on average (docs/theory.md, 4); 0 beyond BIAS_STATES, where it is left out.

    With e(s,a) the error of the mean of r + V(s') and Z = (I - K + 1 d)^-1: dV = Z (sum_a pi e), and on average over d

        sum_a pi (dp dV) + (beta/2) Var_pi(e + p dV),        the second term if the policy moves along.
    """
    problem = part.problem
    states, n_states, n_actions = problem.states, problem.n_states, problem.n_actions
    if n_states > BIAS_STATES:
        return 0.0
    chain = problem.chain(policy)
    d = problem.regeneration(policy).stationary()
    try:
        z = np.linalg.inv(np.eye(n_states) - chain.toarray() + d)
    except np.linalg.LinAlgError as error:
        raise SingularChainError("parts of the chain are all but closed") from error
    noise = np.zeros((n_states, n_actions))
    used = part.used[states]
    known = used & (rows.n[states] > 1.5)  # what one draw leaves open is a rule's, and no measurement
    noise[known] = (rows.variance / np.maximum(rows.n, 1))[states][known]
    # dp of a row goes with its own e alone.
    p = model.transition
    pair = np.repeat(np.arange(model.visits.size), np.diff(p.indptr))
    place = np.full(model.n_states, -1)
    place[states] = np.arange(n_states)
    at, to = place[pair // n_actions], place[p.indices]
    entry = rows.share > 0
    moved = np.zeros(model.visits.size)
    moved += np.bincount(pair[entry], (rows.share * rows.x)[entry] * z[to[entry], at[entry]], model.visits.size)
    together = moved.reshape(model.visits.shape)[states] / np.maximum(rows.n, 1)[states]
    found = float((d[:, None] * policy**2 * np.where(known, together, 0.0)).sum())
    if optimal:
        source = (policy**2 * noise).sum(1)  # variance of sum_a pi e, state by state
        h = (problem.transition @ z).reshape(n_states, n_actions, n_states)
        h = h - (policy[:, :, None] * h).sum(1, keepdims=True)
        own = np.arange(n_states)
        direct = (policy * (1 - policy) * noise).sum(1)  # Var_pi(e)
        through = (policy * (h**2 @ source)).sum(1)  # Var_pi(p dV)
        both = 2 * (policy**2 * noise * h[own, :, own]).sum(1)
        found += 0.5 * problem.beta * float(d @ (direct + through + both))
    return found


def _withheld(variance: float, third: float, bias: float, untried: float) -> str:
    if not variance > 0:
        return "no pair shows any variance"
    if third**2 > 0 and variance**3 / third**2 < FEWEST:
        return f"it rests on about {variance**3 / third**2:.1f} events"
    if bias**2 > variance:
        return "the second order is larger than the first"
    if untried**2 > 4 * variance:
        return "pairs never tried matter more than those that were"
    return ""


def _untried(model: EmpiricalMDP, part: EmpiricalProblem, d: np.ndarray) -> float:
    """What J may gain from pairs that were never visited, were they as good as those tried in their state."""
    states = part.problem.states
    return float(d[states].sum(1) @ -np.log(part.tried)) / part.problem.beta


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
