"""The error of theta and of a policy's value, from the visit counts alone.

J(pi), the reward rate less KL/beta, of the empirical model moves with each row p(.|s,a) and mean reward that the data
got wrong. To first order, with V the relative value of pi and d its stationary distribution over pairs,

    dJ = sum_{s,a} d(s,a) (dr(s,a) + sum_s' dp(s'|s,a) V(s')),
    Var J = sum_{s,a} d(s,a)^2 Var(r + V(s') | s,a) / n(s,a)

r and s' of one tuple may go together, so the variance is that of their sum, estimated with divisor n - 1.
theta* = -J(pi*): to move pi* with the data is of second order (J is flat there), so the same formula holds. One more
sample of (s,a) takes d^2 Var (1/n - 1/(n+1)) = d^2 Var / (n (n+1)) off the variance: the pair where that is largest
comes first.

The interval is that of the likelihood (Owen's, with a successor that was never seen): all values of J of models with

    sum_{s,a} n(s,a) (sum_s' p log(p/q) + dr^2 / (2 Var(r | s,a,s'))) <= t^2 / 2,

p the frequencies, q the model's rows, dr what its mean reward is off beyond what q makes of it. A row may also lead
where another action leads that shares its state and a successor with it, or where most states lead, or, where
a successor has one draw alone, anywhere: n draws may hide an event of chance 1 - exp(-t^2/2n). Few events make the
interval wide and lopsided; where much was seen it is value -+ t se. Each end is found by steps: to the models worst
to first order, J there, and on.

Assumptions: the draws of a pair are independent and alike, the mean of the noise in the reward of one (s,a,s') is
about normal, and what was seen nowhere (a state, a penalty) does not exist. Then

    second order  noise in the rows moves J on average (the optimum of a model with errors picks among its errors and
                  looks better than it is); derived in docs/theory.md, 4, and subtracted
    luck          where actions' values differ by less than their noise and 1/beta is small beside it, the optimum
                  takes the luckier one; the mean of its luck widens one side
    never tried   pairs that were never tried may bring the best that was seen from their state; that widens one side

``smallest_visits`` is the fewest draws of a pair behind at least 1% of the variance; ``withheld`` says why there is no
interval, where there is none.

A state that the data never show is no part of the problem (``erl_torch.empirical.counts``), nor of the error.

Above optimism 0 and below, kappa = optimism * beta, J is the nested one (``erl_torch.solvers``), E V gives way to
C V = (1/kappa) log E exp(kappa V(s')), d is of the process of pi and q = p exp(kappa (V(s') - C V)), and in place of
V(s') stands xi = exp(kappa (V(s') - C V)) / kappa: Var_p(xi) = chi^2(q || p) / kappa^2. ``warning`` names a pair that
matters where max q/p is above sqrt(n): what the data say of it rests on a handful of tuples. A successor that was never
seen shows at no optimism.

Tuples with weights w: where Var / n stands above, the interval has the sandwich

    v(s,a) = sum_i w_i^2 (x_i - mean x)^2 / (sum_i w_i)^2,    x = r + V(s') (or r + xi), mean x = sum w x / sum w

(first order: a ratio of means), times n/(n - 1) for n = Var(x)/v, Var with weights: as many draws from p^ itself would
tell as much of x, and n stands for the visits in the likelihood and the second order. Kish's effective sample size
(sum w)^2 / sum w^2 is that n only where w says nothing of (x - mean x)^2; it serves a ``warning`` where it is small.
A mean weight far below 1 shows successors that were never seen, and no interval knows of them: it is withheld.
Where the dynamics are given (``erl_torch.empirical.dynamics``) no term of p is in the interval: the rewards alone err.

The bootstrap draws n(s,a) successors anew for every pair (multinomial; the reward's mean with the noise left at a given
successor), and solves each model. It includes the second order, and subtracts nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike
from scipy import optimize, special

from erl_torch import checks
from erl_torch.checks import InputError
from erl_torch.empirical import kernels
from erl_torch.empirical.counts import EmpiricalMDP, EmpiricalProblem, WeightSums
from erl_torch.mdp.tabular import check_policy
from erl_torch.solution import Status
from erl_torch.solvers.certificates import soft_backup
from erl_torch.solvers.chains import RegenerativeLU, SingularChainError
from erl_torch.solvers.policy import kl_per_state
from erl_torch.solvers.problem import BellmanProblem
from erl_torch.solvers.soft_bellman import solve_problem

NONE = np.empty(0)
COUNTED_SHARE = 0.01  # of the variance, from which on a pair counts for ``smallest_visits``
BIAS_STATES = 1000  # beyond, the second order is a mean over random signs, as the exact one takes S linear systems
SIGNS = 100  # vectors of random signs
FALLS_APART = "the policy's chain falls into parts that double precision cannot join"
MOST_DIGITS = 15
LOPSIDED = 0.1  # half widths between the middle and the value, from which on both ends are printed
LEAST_RESAMPLED = 0.5  # of the plug-in's standard error; resamples with less are too alike
MAX_STEPS = 50
PATIENCE = 10  # steps that gain nothing, where J has kinks
LARGEST_LOG_PRICE = 100.0  # logarithm of a price at which likelihood costs nothing
END_TOLERANCE = 0.01  # of the half width: steps stop where one moves the end by less (at kinks, a few hundredths)
TIED = 2.0  # standard errors between two actions' values, up to which either may be the better
SMALLEST_SHARE = 1e-3  # of a Newton step
STALLED = 0.5  # a step that leaves more of the width is the last
UNSOLVED = 1e-6  # width, of the range of the rewards, of a relative value that is none
UNSEEN_SHARE = 0.1  # of the standard error, by which successors that were never seen may move a rate
LEAST_MEAN_WEIGHT = 0.5  # of a pair: p^/p has mean 1 under p, less what p^ has of successors that were never seen
FEW_EFFECTIVE = 30.0  # draws: a smaller effective sample size of a pair that matters is told
COMMON = 0.5  # share of the states; a successor met from more of them may be met from any


@dataclass(frozen=True, eq=False)
class Estimate:
    """A figure with its error; ``str`` gives value and 95% interval: ``theta = 1.0118 +- 0.0009``, or ``[low, high]``
    where it is lopsided."""

    name: str
    value: float  # reward per step
    standard_error: float
    samples: np.ndarray | None = None  # of the bootstrap, [n]
    variance: np.ndarray | None = None  # share of each pair in standard_error^2, [S, A]; plug-in
    visits: np.ndarray | None = None  # [S, A]
    freedom: float = np.inf  # degrees of freedom of standard_error (Student's t)
    bias: float = 0.0  # of second order; subtracted from ``value`` already
    untried: tuple[float, float] = (0.0, 0.0)  # by how much pairs never visited may lower and raise the figure
    smallest_visits: int | None = None  # of the pairs behind at least 1% of the variance
    withheld: str = ""  # why there is no interval, if there is none
    warning: str = ""  # of a pair whose figures rest on a handful of tuples
    limits: Callable[[float], tuple[float, float]] | None = None  # fall of the log-likelihood -> interval; plug-in

    def interval(self, level: float = 0.95) -> tuple[float, float]:
        """The two-sided interval at ``level``, a number in (0, 1); infinite where it is withheld.

        A bootstrap gives the basic interval (samples mirrored at the value). A plug-in estimate gives that of the
        likelihood, down by t^2/2 with t of Student's distribution; the effect of pairs never tried is added.
        """
        level = checks.number("level", level, lambda x: 0 < x < 1, "a number in (0, 1)")
        if self.withheld:
            return -np.inf, np.inf
        if self.samples is not None:
            low, high = np.quantile(self.samples, [(1 - level) / 2, (1 + level) / 2])
            return 2 * self.value - float(high), 2 * self.value - float(low)
        t = float(special.stdtrit(self.freedom, (1 + level) / 2)) if np.isfinite(self.freedom) else _normal(level)
        low, high = self.value - t * self.standard_error, self.value + t * self.standard_error
        if self.limits is not None:
            low, high = self.limits(0.5 * t**2)
        return low - self.untried[0], high + self.untried[1]

    def next_samples(self, n: int = 5) -> list[tuple[int, int, float]]:
        """The n pairs (s, a, drop of the variance by one more sample), largest drop first. Plug-in estimates only."""
        n = checks.at_least("n", n, 1)
        if self.variance is None or self.visits is None:
            raise InputError("next_samples", "bootstrap", "asked of a plug-in estimate")
        drop = self.variance / (self.visits + 1)
        order = np.argsort(-drop, axis=None, kind="stable")[:n]
        return [(int(k // drop.shape[1]), int(k % drop.shape[1]), float(drop.flat[k])) for k in order]

    def __str__(self) -> str:
        if np.isnan(self.value):
            return f"no {self.name}: {self.withheld}"
        if self.withheld:
            return f"{self.name} = {self.value:z.4g}, no interval: {self.withheld}"
        low, high = self.interval()
        distance = min(self.value - low, high - self.value)
        digits = 4
        if distance > 0:
            first = int(
                np.floor(np.log10(distance))
            )  # place of its first digit; two digits are printed where that is a 1
            digits = min(max(0, (distance < 2 * 10.0**first) - first), MOST_DIGITS)
        # Round so that the printed interval contains the interval.
        unit = 10.0**-digits
        if abs(0.5 * (low + high) - self.value) > LOPSIDED * 0.5 * (high - low):
            low, high = np.floor(low / unit) * unit, np.ceil(high / unit) * unit
            return f"{self.name} = {self.value:z.{digits}f} in [{low:z.{digits}f}, {high:z.{digits}f}]"
        printed = float(f"{self.value:.{digits}f}")
        half = max(0.0, np.ceil(max(high - printed, printed - low) / unit - 1e-9)) * unit
        return f"{self.name} = {self.value:z.{digits}f} +- {half:.{digits}f}"


def _normal(level: float) -> float:
    return NormalDist().inv_cdf((1 + level) / 2)


def _check_model(model: object) -> None:
    checks.instance("model", model, EmpiricalMDP, "an EmpiricalMDP, as of empirical_mdp")


def theta_uncertainty(
    model: EmpiricalMDP, beta: float, prior_policy: ArrayLike | None = None, *, optimism: float = 0.0
) -> Estimate:
    """Plug-in estimate of theta* from counts, less its bias of second order, and its error (docs/theory.md, 4).

    Args:
        model: counts and mean rewards, of ``empirical_mdp``.
        beta: inverse temperature, 1/reward, > 0.
        prior_policy: [S, A], 0 where an action is not to be taken; None is uniform.
        optimism: 1 optimistic (control as inference), 0 right, negative robust.

    Raises:
        InputError: beta, prior or optimism out of range, or a stream that never returns to any state.
    """
    _check_model(model)
    empirical = model.problem(beta, prior_policy, optimism=optimism)
    solution = solve_problem(empirical.problem, model, prior_policy)
    if solution.status is Status.NO_SINGLE_RATE:
        return Estimate("theta", np.nan, np.inf, withheld="no single rate was found for all states in the data")
    states, value = empirical.problem.states, solution.value
    assert value is not None
    try:
        estimate = _plug_in(model, empirical, solution.policy.numpy()[states], True, value.numpy()[states])
    except SingularChainError:  # the optimum stays in states that the process leaves at last, or sets all but closed
        return Estimate("theta", np.nan, np.inf, withheld=FALLS_APART)
    limits = estimate.limits
    return replace(
        estimate,
        name="theta",
        value=-estimate.value,
        bias=-estimate.bias,
        untried=estimate.untried[::-1],
        limits=None if limits is None else lambda budget: (-limits(budget)[1], -limits(budget)[0]),
    )


def policy_uncertainty(
    model: EmpiricalMDP,
    policy: ArrayLike,
    beta: float,
    prior_policy: ArrayLike | None = None,
    *,
    optimism: float = 0.0,
) -> Estimate:
    """J(policy), the reward rate less KL/beta at optimism 0, from counts, less its bias of second order, and its error.

    Args:
        model: counts and mean rewards, of ``empirical_mdp``.
        policy: [S, A], rows sum to 1.
        beta: inverse temperature, 1/reward, > 0.
        prior_policy: [S, A], 0 where an action is not to be taken; None is uniform.
        optimism: 1 optimistic (control as inference), 0 right, negative robust; the nested J.

    Raises:
        InputError: a policy [S, A] that takes an action never tried (in a state of the empirical problem).
    """
    _check_model(model)
    empirical = model.problem(beta, prior_policy, optimism=optimism)
    table = check_policy("policy", policy, model.n_states, model.n_actions)
    untried = (table > 0) & ~empirical.used & empirical.used.any(1, keepdims=True)
    if untried.any():
        s, a = np.argwhere(untried)[0]
        raise InputError(f"policy[{s}, {a}]", table[s, a], "0, as the pair is not in the data")
    try:
        return _plug_in(model, empirical, table[empirical.problem.states], False)
    except SingularChainError:  # each set of states has a J of its own
        return Estimate("J", np.nan, np.inf, withheld=FALLS_APART)


def bootstrap_theta(
    model: EmpiricalMDP,
    beta: float,
    prior_policy: ArrayLike | None = None,
    n_resamples: int = 200,
    seed: int | np.random.Generator = 0,
    *,
    optimism: float = 0.0,
) -> Estimate:
    """Estimate theta*, with the bootstrap's standard error and samples; the same seed gives the same samples.

    Samples whose model cannot be solved (the draw made it reducible) are left out.

    Args:
        model: counts and mean rewards, of ``empirical_mdp``.
        beta: inverse temperature, 1/reward, > 0.
        prior_policy: [S, A], 0 where an action is not to be taken; None is uniform.
        n_resamples: whole number >= 2; each takes the solution of one model.
        seed: a whole number, or a generator.
        optimism: 1 optimistic (control as inference), 0 right, negative robust.

    Raises:
        InputError: an argument out of range, or fewer than two samples that can be solved.
    """
    _check_model(model)
    if model.weights is not None or model.given:
        raise InputError("model", "counts with weights, or with dynamics that are given", "plain counts in a bootstrap")
    seed = checks.seed("seed", seed)
    checks.at_least("n_resamples", n_resamples, 2)
    rng = np.random.default_rng(seed)
    plug_in = theta_uncertainty(model, beta, prior_policy, optimism=optimism)
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
            problem = resampled.problem(beta, prior_policy, optimism=optimism)
        except InputError:
            continue
        solution = solve_problem(problem.problem, model, prior_policy, tol=1e-8)
        if solution.status is Status.CONVERGED and not problem.reducible and solution.theta is not None:
            samples.append(solution.theta)
    if len(samples) < 2:
        raise InputError("transitions", f"a stream with {len(samples)} solvable resamples", "longer")
    error = float(np.std(samples, ddof=1))
    withheld = plug_in.withheld
    if not withheld and error < LEAST_RESAMPLED * plug_in.standard_error:
        withheld = "the resamples vary less than the draws: pairs that matter were drawn too few times"
    return Estimate(
        "theta", plug_in.value + plug_in.bias, error, np.array(samples), withheld=withheld, warning=plug_in.warning
    )


def _plug_in(
    model: EmpiricalMDP,
    empirical: EmpiricalProblem,
    policy: np.ndarray,
    optimal: bool,
    value: np.ndarray | None = None,
) -> Estimate:
    """J of ``policy`` [n, A], on the problem's states; ``optimal``: the policy moves with the data. ``value`` [n]: its
    relative value, about, where that is known."""
    problem = empirical.problem
    here = _worth(problem, policy, value)
    d = np.zeros(model.visits.shape)
    d[problem.states] = here.d
    with np.errstate(over="ignore", invalid="ignore"):
        rows = _rows(model, empirical, here)
        weight = np.where(empirical.used, d**2 / np.maximum(rows.n, 1.0), 0.0)
        variance = weight * rows.variance
        total = float(variance.sum())
        bias, bias_error = _second_order(model, empirical, here, policy, rows, optimal)
        # Welch and Satterthwaite.
        unsure = float(((variance / total) ** 2 / np.maximum(rows.n - 1, 1)).sum()) if total > 0 else 0.0
    untried = _untried(empirical, here) if optimal else 0.0
    luck = _luck(empirical, here, rows, policy) if optimal else 0.0
    counts = np.flatnonzero(variance > COUNTED_SHARE * total)
    estimate = Estimate(
        "J",
        here.gain - bias,
        float(np.sqrt(total)),
        variance=variance,
        visits=model.visits,
        freedom=1 / unsure if unsure > 0 else np.inf,
        bias=bias,
        untried=(0.0, untried),
        smallest_visits=int(_effective(model).flat[counts].min()) if counts.size else None,
        withheld=_same_reward(model, empirical)
        or _unseen(model, empirical, here, optimal, float(np.sqrt(total)))
        or _withheld(total, bias, untried),
        warning="; ".join(filter(None, (_warning(model, rows, counts), _few_effective(model, counts)))),
    )
    if estimate.withheld:  # the correction cannot be trusted
        return replace(estimate, value=here.gain, bias=0.0)

    @lru_cache(maxsize=8)
    def limits(budget: float) -> tuple[float, float]:
        if budget == 0:  # a level too small to tell from 0
            return here.gain - bias, here.gain - bias
        low = _furthest(model, empirical, rows, here, -1.0, budget, policy, optimal, luck > 0)
        high = _furthest(model, empirical, rows, here, 1.0, budget, policy, optimal, False)
        return low - max(bias, 0.0) - 2 * bias_error - luck, high - min(bias, 0.0) + 2 * bias_error

    estimate = replace(estimate, limits=limits)
    if not np.isfinite(estimate.interval()).all():
        return replace(estimate, value=here.gain, bias=0.0, withheld="models that fit the data fall into parts")
    return estimate


class _Worth(NamedTuple):
    """Figures of a policy [n, A] in a problem."""

    gain: float  # J
    d: np.ndarray  # its stationary distribution over pairs, [n, A]
    value: np.ndarray  # relative, [n]
    certain: np.ndarray = NONE  # C V, [n*A]; none at optimism 0
    tilted: np.ndarray = NONE  # q, as the data of the transitions; none at optimism 0


def _worth(problem: BellmanProblem, policy: np.ndarray, value: np.ndarray | None = None) -> _Worth:
    """By Newton's method from ``value`` [n] (None: 0) above optimism 0 and below."""
    prior = np.where(policy > 0, problem.prior, 1.0)
    reward = (policy * problem.reward).sum(1) - kl_per_state(policy, prior) / problem.beta
    if not problem.optimism:
        lu = problem.regeneration(policy)
        gain, value = lu.poisson(reward)
        return _Worth(gain, lu.stationary()[:, None] * policy, value)
    ref = problem.regeneration_state()
    if ref is None:
        raise SingularChainError("several closed classes")

    def backed_up(value: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(T V - V of the policy [n], C V [n*A], q)."""
        certain, tilted = problem.certainty_equivalent(value), problem.tilted(value)
        assert tilted is not None
        return reward + (policy * certain.reshape(policy.shape)).sum(1) - value, certain, tilted

    value = np.zeros(problem.n_states) if value is None else value - value[ref]
    change, certain, tilted = backed_up(value)
    for _ in range(MAX_STEPS):
        lu = problem.regeneration(policy, ref, tilted)
        step, share = lu.poisson(change)[1], 1.0
        while True:
            there = backed_up(value + share * step)
            if np.ptp(there[0]) < np.ptp(change) or share < SMALLEST_SHARE:
                break
            share *= 0.5
        if not np.ptp(there[0]) < np.ptp(change):
            break
        small = not np.ptp(there[0]) < STALLED * np.ptp(change)
        value, (change, certain, tilted) = value + share * step, there
        if small and share == 1:
            break
    if not np.ptp(change) <= UNSOLVED * problem.reward_range:
        raise SingularChainError("no relative value")
    lu = problem.regeneration(policy, ref, tilted)
    d = lu.stationary()
    return _Worth(float(d @ change), d[:, None] * policy, value, certain, tilted)


def _effect(problem: BellmanProblem, here: _Worth, to: np.ndarray, row: np.ndarray) -> np.ndarray:
    """What a share of probability of the successors ``to`` adds to J in ``row`` (of [n*A]): V(s'), or xi - 1/kappa."""
    if not problem.optimism:
        return np.asarray(here.value[to])
    return np.asarray(np.expm1(problem.kappa * (here.value[to] - here.certain[row])) / problem.kappa)


def _optimum(problem: BellmanProblem, value: np.ndarray, tol: float) -> _Worth:
    """Those of the optimal policy, to ``tol`` in J, by soft policy iteration from ``value`` [n]."""
    last = -np.inf
    for _ in range(MAX_STEPS):
        worth = _worth(problem, soft_backup(problem.action_value(value), problem.prior, problem.beta)[1], value)
        if not worth.gain > last + tol:
            break
        last, value = worth.gain, worth.value
    return worth


class _Rows(NamedTuple):
    """Statistics of x = r + V(s'), or r + xi, over the draws of each pair, [S, A] each."""

    n: np.ndarray  # draws whose s' is in the problem
    share: np.ndarray  # of each transition entry among them, [nnz]
    x: np.ndarray  # mean of x given s', less the row's mean, [nnz]
    noise: np.ndarray  # variance of r given s', mean over s'
    variance: np.ndarray  # of x; divisor n - 1, as that of noise
    ratio: np.ndarray  # q/p, [nnz]; 1 at optimism 0

    # Of tuples with weights, n is the number of draws without that would tell as much of x.


def _rows(model: EmpiricalMDP, empirical: EmpiricalProblem, here: _Worth) -> _Rows:
    p, shape = model.transition, model.visits.shape
    members = np.asarray(empirical.used.any(1))
    rows = np.repeat(np.arange(model.visits.size), np.diff(p.indptr))
    kept = p.data * (members[p.indices] & empirical.used.ravel()[rows])
    total = np.bincount(rows, kept, model.visits.size)
    n = model.visits.ravel() * total
    with np.errstate(invalid="ignore", divide="ignore"):
        share = np.where(kept > 0, kept / total[rows], 0.0)
    problem = empirical.problem
    value, ratio = np.zeros(model.n_states), np.ones(p.nnz)
    value[problem.states] = here.value
    effect = value[p.indices]
    if problem.optimism:
        certain = np.zeros(model.visits.shape)
        certain[problem.states] = here.certain.reshape(problem.reward.shape)
        exponent = np.where(kept > 0, problem.kappa * (effect - certain.ravel()[rows]), 0.0)
        ratio, effect = np.exp(exponent), np.expm1(exponent) / problem.kappa
    x = model.reward_given_next + effect
    x = x - np.bincount(rows, share * x, model.visits.size)[rows]
    if model.given:
        x = np.zeros_like(x)
    if model.weights is not None:
        spread = np.bincount(rows, share * x**2, model.visits.size) + _within(model, share, rows)
        n = _as_many(model.weights, kept > 0, rows, x, spread)
    unbiased = np.where(n > 1.5, n / np.maximum(n - 1, 1), 1.0)
    noise = _within(model, share, rows) * unbiased
    variance = np.bincount(rows, share * x**2, model.visits.size) * unbiased + noise
    used = empirical.used.ravel()
    once = used & ~(n > 1.5)
    # One draw shows no variance: its pair gets the largest of the others.
    for each in (noise, variance):
        each[once] = each[used & ~once].max(initial=0.0)
        each[~used] = 0.0
    return _Rows(n.reshape(shape), share, x, noise.reshape(shape), variance.reshape(shape), ratio)


def _furthest(
    model: EmpiricalMDP,
    empirical: EmpiricalProblem,
    rows: _Rows,
    here: _Worth,
    sign: float,
    budget: float,
    policy: np.ndarray,
    optimal: bool,
    tied: bool,
) -> float:
    """The largest (``sign`` 1) or smallest (-1) J that steps reach among models whose log-likelihood is down by
    ``budget`` at most; of the optimal policy or of ``policy`` [n, A]. Infinite where such a model has no J.

    ``tied``: J has kinks where the best action changes, and a step against one action helps the other. So steps that
    gain nothing are followed by steps against the mean of all policies met so far (fictitious play).
    """
    problem = empirical.problem
    p, given = _with_successor(model, empirical, rows, sign * here.value)
    row = np.repeat(np.arange(problem.reward.size), np.diff(p.indptr))
    n = np.where(empirical.used, np.maximum(rows.n, 1.0), np.inf)[problem.states].ravel()
    noise = rows.noise[problem.states].ravel()
    moved, cost = np.empty(p.nnz), np.empty(len(n))
    now, best = here, here.gain
    weights, weighed, steps, idle = np.zeros(len(n)), np.zeros(p.nnz), 0, 0
    for _ in range(MAX_STEPS):
        d = now.d.ravel()
        x = given + _effect(problem, now, p.indices, row)
        x = x - np.add.reduceat(p.data * x, p.indptr[:-1])[row]
        x = np.zeros_like(x) if model.given else x
        if tied:
            steps, weights, weighed = steps + 1, weights + d, weighed + d[row] * x
        if idle:
            d = weights / steps
            x = np.divide(weighed, weights[row], out=x, where=weights[row] > 0)
        slope = sign * d / n  # of J, along what one draw says
        unit = max(float((slope[row] * x).max()), float(np.abs(slope * np.sqrt(noise)).max()))
        if not np.isfinite(unit):
            return sign * np.inf
        if unit <= 1e-30 * float(np.abs(slope).max()) * float(np.abs(x).max()):  # none but by rounding
            return best
        slope = slope / unit

        def spent(log_price: float, slope: np.ndarray = slope, x: np.ndarray = x) -> float:
            """Logarithm of (likelihood spent at that price / budget); leaves the rows in ``moved``."""
            at = slope * np.exp(-log_price)
            kernels.likelihood_rows(p.indptr, p.data, x, at, moved, cost)
            per_draw = cost + 0.5 * at**2 * noise
            return float(np.log(np.maximum((n[per_draw > 0] * per_draw[per_draw > 0]).sum(), 1e-300) / budget))

        log_price = _root(spent)
        spent(log_price)
        reward = np.add.reduceat(moved * given, p.indptr[:-1]) + slope * np.exp(-log_price) * noise
        model_there = _with_rows(problem, p, moved, reward)
        try:
            if optimal:
                now = _optimum(model_there, now.value, 0.1 * END_TOLERANCE * abs(best - here.gain))
            else:
                now = _worth(model_there, policy, now.value)
        except SingularChainError:
            return sign * np.inf
        gained = sign * (now.gain - best)
        if gained > 0:
            best = now.gain
        if not gained > END_TOLERANCE * abs(best - here.gain):
            idle += 1
            if not np.isfinite(now.gain):
                return sign * np.inf
            if not tied or idle == PATIENCE:
                return best
    return best


def _with_rows(problem: BellmanProblem, p: sp.csr_array, moved: np.ndarray, reward: np.ndarray) -> BellmanProblem:
    """``problem`` with rows ``moved`` (the data of ``p``), and ``reward`` [n*A] added."""
    transition = sp.csr_array((moved.copy(), p.indices.copy(), p.indptr.copy()), shape=p.shape)
    if problem.optimism:  # the tilt is of successors that there are
        transition.eliminate_zeros()
    return replace(problem, transition=transition, reward=problem.reward + reward.reshape(problem.reward.shape))


def _root(falling: Callable[[float], float]) -> float:
    """The root, to about a thousandth, of a function that falls from above 0 to below; few steps at slopes near -2.

    -LARGEST_LOG_PRICE where the function is below 0 there.
    """
    low = high = 0.0
    step = 1.0
    while falling(low) < 0:
        if low == -LARGEST_LOG_PRICE:
            return low
        high, low, step = low, max(low - step, -LARGEST_LOG_PRICE), 2 * step
    while falling(high) >= 0:
        low, high, step = high, high + step, 2 * step
    return float(optimize.brentq(falling, low, high, xtol=1e-3))


def _with_successor(
    model: EmpiricalMDP, empirical: EmpiricalProblem, rows: _Rows, worth: np.ndarray
) -> tuple[sp.csr_array, np.ndarray]:
    """(the problem's transitions, each row with one more entry of probability 0: the successor of most ``worth`` [n]
    that the row may hide; mean reward of each entry less the row's, 0 where the entry was not seen).

    A row may hide a successor of another action that shares its state and a successor with it, and a state that is met
    from most states (a reset, a slip); where one of its successors has one draw alone, any state.
    """
    problem = empirical.problem
    p, n_actions = problem.transition, problem.n_actions
    n_rows = p.shape[0]
    row = np.repeat(np.arange(n_rows), np.diff(p.indptr))
    _, to, slot = problem.pattern
    leads = sp.csr_array((np.ones(p.nnz), slot, p.indptr), shape=(n_rows, len(to)))  # row to (state, successor)
    like = sp.csr_array((leads @ leads.T) @ leads)
    like = sp.csr_array((worth[to[like.indices]] - worth.min(), like.indices, like.indptr), shape=like.shape)
    best = np.maximum.reduceat(like.data, like.indptr[:-1])
    place = np.flatnonzero(like.data == np.repeat(best, np.diff(like.indptr)))
    hidden = to[like.indices[place[np.searchsorted(place, like.indptr[:-1])]]]
    met = np.unique(np.stack([p.indices[p.data > 0], row[p.data > 0] // n_actions]), axis=1)[0]
    common = np.flatnonzero(np.bincount(met, minlength=problem.n_states) > COMMON * problem.n_states)
    if common.size:
        reset = common[np.argmax(worth[common])]
        hidden = np.where(worth[reset] > worth[hidden], reset, hidden)
    draws = p.data * rows.n[problem.states].ravel()[row]
    hidden[np.bincount(row, np.abs(draws - 1) < 0.5, n_rows) > 0] = np.argmax(worth)
    at = np.concatenate([row, np.arange(n_rows)]), np.concatenate([p.indices, hidden])
    wide = sp.csr_array((np.concatenate([p.data, np.zeros(n_rows)]), at), shape=p.shape)
    row = np.repeat(np.arange(n_rows), np.diff(wide.indptr))
    seen = model.transition
    of_entry = sp.csr_array((model.reward_given_next, seen.indices, seen.indptr), shape=seen.shape)
    pair = problem.states[row // n_actions] * n_actions + row % n_actions
    given = np.asarray(of_entry[pair, problem.states[wide.indices]]).ravel()
    given = np.where(wide.data > 0, given - np.bincount(row, wide.data * given, n_rows)[row], 0.0)
    return wide, given


def _second_order(
    model: EmpiricalMDP, empirical: EmpiricalProblem, here: _Worth, policy: np.ndarray, rows: _Rows, optimal: bool
) -> tuple[float, float]:
    """(how far noise in the rows moves J on average, standard error of that); docs/theory.md, 4.

    At optimism 0, with e(s,a) the error of the mean of r + V(s') and Z = (I - K + 1 d)^-1: dV = Z (sum_a pi e), and on
    average over d

        sum_a pi (dp dV) + (beta/2) Var_pi(e + p dV),        the second term if the policy moves along.

    Otherwise e is that of r + xi, K and p dV become those of q, dp dV becomes dp (q/p) (dV - q dV), and
    (kappa/2) (Var_q(dV) - Var_p(xi)/n) is added: C has a second order of its own.

    That is tr(M Z) + sum |H Z diag(source)^1/2|^2, column by column; of more than BIAS_STATES states, the mean over
    random signs in place of columns (Hutchinson).
    """
    problem = empirical.problem
    states, n, n_actions = problem.states, problem.n_states, problem.n_actions
    lu, d, follows = _process(problem, policy, here), here.d.sum(1), problem.transition
    draws = np.maximum(rows.n, 1.0)
    measured = empirical.used & (rows.n > 1.5)  # the variance of one draw is set by a rule, not measured
    noise = np.where(measured, rows.variance / draws, 0.0)[states]
    # dp of a row correlates with its own e alone.
    p = model.transition
    pair = np.repeat(np.arange(model.visits.size), np.diff(p.indptr))
    place = np.full(model.n_states, -1)
    place[states] = np.arange(n)
    weight = np.zeros(model.visits.shape)
    weight[states] = d[:, None] * policy**2
    entry = (rows.share > 0) & measured.ravel()[pair] & (not model.given)
    together = (weight / draws).ravel()[pair[entry]] * (rows.share * rows.x)[entry]
    at = place[pair[entry] // n_actions], place[p.indices[entry]]
    moved, kappa = 0.0, problem.kappa
    if kappa:
        follows = sp.csr_array((here.tilted, follows.indices, follows.indptr), shape=follows.shape)
        together = together * rows.ratio[entry]
    matrix = sp.csr_array((together, at), shape=(n, n))
    if kappa:
        whole = np.bincount(pair[entry], together, model.visits.size).reshape(model.visits.shape)[states]
        matrix = matrix - _by_state(whole) @ follows
        squares = rows.share * ((rows.ratio - 1) / kappa) ** 2
        excess = np.bincount(pair[entry], squares[entry], model.visits.size)
        own = (excess.reshape(draws.shape) / np.maximum(draws - 1, 1))[states]
        moved = -0.5 * kappa * float((here.d * own).sum())  # of C
    source = (policy**2 * noise).sum(1)  # variance of sum_a pi e, state by state
    if optimal:
        moved += 0.5 * problem.beta * float((here.d * (1 - policy) * noise).sum())  # Var_pi(e)
        both = problem.beta * d[:, None] * policy * (policy * noise - source[:, None])
        matrix = matrix + _by_state(both) @ follows

    def through(x: np.ndarray) -> np.ndarray:
        """Z x."""
        y = lu.poisson(x)[1]
        return np.asarray(y + d @ (x - y))

    exact = n <= BIAS_STATES
    terms = []
    for x in np.eye(n) if exact else np.random.default_rng(0).choice([-1.0, 1.0], (SIGNS, n)):
        term = float(x @ (matrix @ through(x)))
        if kappa:
            moves = through(np.sqrt(source) * x)
            term += 0.5 * kappa * float(here.d.ravel() @ (follows @ moves**2 - (follows @ moves) ** 2))  # Var_q(dV)
        if optimal:
            h = (follows @ through(np.sqrt(source) * x)).reshape(n, n_actions)
            h = h - (policy * h).sum(1, keepdims=True)
            term += 0.5 * problem.beta * float((here.d * h**2).sum())  # Var_pi(p dV)
        terms.append(term)
    if exact:
        return moved + sum(terms), 0.0
    return moved + float(np.mean(terms)), float(np.std(terms, ddof=1) / np.sqrt(SIGNS))


def _process(problem: BellmanProblem, policy: np.ndarray, here: _Worth) -> RegenerativeLU:
    """The LU of the chain of ``policy`` [n, A] and q."""
    return problem.regeneration(policy, tilted=here.tilted if problem.optimism else None)


def _by_state(table: np.ndarray) -> sp.csr_array:
    """Rows [n, n*A] that weigh the pairs of each state by ``table`` [n, A]."""
    ends = np.arange(0, table.size + 1, table.shape[1])
    return sp.csr_array((table.ravel(), np.arange(table.size), ends))


def _as_many(weights: WeightSums, kept: np.ndarray, rows: np.ndarray, x: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """``spread`` [S*A], the variance of r + V(s') (divisor n), over the sandwich v(s,a): the draws that tell as much.

    Kish's effective sample size where nothing varies. ``kept`` [nnz]: entries that lead to states in the problem; ``x``
    [nnz]: mean of r + V(s') given s', less that of the row.
    """
    total = np.bincount(rows, weights.total * kept, len(spread))
    squares = weights.squares * x**2 + 2 * x * weights.off + weights.off_squares
    meat = np.bincount(rows, squares * kept, len(spread))
    kish = total**2 / np.maximum(np.bincount(rows, weights.squares * kept, len(spread)), np.finfo(float).tiny)
    varies = (meat > 0) & (spread > 0)
    return np.where(varies, spread * total**2 / np.where(varies, meat, 1.0), kish)


def _effective(model: EmpiricalMDP) -> np.ndarray:
    """Kish's effective sample size of each pair, [S, A]; its visits where there are no weights."""
    if model.weights is None:
        return model.visits
    rows = np.repeat(np.arange(model.visits.size), np.diff(model.transition.indptr))
    total, squares = (np.bincount(rows, x, model.visits.size) for x in (model.weights.total, model.weights.squares))
    return np.asarray(np.divide(total**2, squares, out=np.zeros_like(total), where=squares > 0)).reshape(
        model.visits.shape
    )


def _unseen(model: EmpiricalMDP, empirical: EmpiricalProblem, here: _Worth, optimal: bool, error: float) -> str:
    """That pairs lack most of the other dynamics' successors, which might matter, whatever these are; "" if not.

    The model that lacks them is wrong there, so that time spent by its optimum tells nothing: the missing share of a
    row is led to the best of all states, and to the worst, and the rate is found again. For the rate of a policy, its
    time there times the range of V is taken.
    """
    if model.weights is None or model.given:
        return ""
    problem = empirical.problem
    rows = np.repeat(np.arange(model.visits.size), np.diff(model.transition.indptr))
    mean = model.weights.mean(rows).reshape(model.visits.shape)[problem.states]
    missing = np.where((mean < LEAST_MEAN_WEIGHT) & (problem.prior > 0), 1.0 - mean, 0.0)
    if not missing.any():
        return ""
    off = float((here.d * missing).sum() * np.ptp(here.value))
    if optimal:
        ends = here.value.argmax(), here.value.argmin()
        off = max(abs(_rate_with(model, problem, missing, int(to)) - here.gain) for to in ends)
    if not off > UNSEEN_SHARE * error + 1e-12 * float(np.abs(problem.reward).max()):  # beyond rounding
        return ""
    i, a = np.unravel_index(int(missing.argmax()), missing.shape)
    s = int(problem.states[i])
    return (
        f"at state {s}, action {a} the mean weight of {model.weights.drawn[s * model.n_actions + int(a)]} tuples is "
        f"{mean[i, a]:.2g}, not 1: most successors under the other dynamics were never seen"
    )


def _rate_with(model: EmpiricalMDP, problem: BellmanProblem, missing: np.ndarray, to: int) -> float:
    """g* where the shares ``missing`` [n, A] of the rows lead to the state ``to``; infinite where that has none."""
    share = missing.ravel()
    ends = sp.csr_array((share, (np.arange(len(share)), np.full(len(share), to))), shape=problem.transition.shape)
    led = sp.csr_array(sp.diags_array(1.0 - share) @ problem.transition + ends)
    led.sort_indices()
    solution = solve_problem(replace(problem, transition=led), model)
    return np.inf if solution.theta is None else -solution.theta


def _few_effective(model: EmpiricalMDP, counts: np.ndarray) -> str:
    """That the weights of a pair among ``counts`` (of [S*A]) leave few effective draws; "" if not."""
    if model.weights is None or not counts.size:
        return ""
    effective = _effective(model).ravel()
    worst = int(counts[np.argmin(effective[counts])])
    if effective[worst] >= FEW_EFFECTIVE:
        return ""
    s, a = divmod(worst, model.n_actions)
    return (
        f"at state {s}, action {a} the weights leave an effective sample of {effective[worst]:.3g} of "
        f"{model.visits.flat[worst]} tuples: the other dynamics go where these tuples seldom do"
    )


def _warning(model: EmpiricalMDP, rows: _Rows, counts: np.ndarray) -> str:
    """That a pair among ``counts`` (of [S*A]) has a successor of whose weight q/p few tuples tell; "" if none has."""
    if model.given:
        return ""
    p = model.transition
    pair = np.repeat(np.arange(model.visits.size), np.diff(p.indptr))
    ratio = np.where((rows.share > 0) & np.isin(pair, counts), rows.ratio, 0.0)
    draws = rows.n.ravel()[pair]
    over = ratio / np.sqrt(np.maximum(draws, 1.0))
    worst = int(np.argmax(over))
    if not over[worst] > 1:
        return ""
    s, a = divmod(int(pair[worst]), model.n_actions)
    return (
        f"at state {s}, action {a} the successor {p.indices[worst]} counts {ratio[worst]:.3g} times its share of "
        f"{draws[worst]:.0f} tuples: what the data say rests on a handful of them"
    )


def _luck(empirical: EmpiricalProblem, here: _Worth, rows: _Rows, policy: np.ndarray) -> float:
    """The amount by which J may be too large, beyond the second order, where actions' values differ by less than their
    noise.

    The optimum takes the luckier of actions that may be as good as each other: it gains (1/beta) log mean exp(beta e)
    on average, e the errors of their values. The second order has (beta/2) Var_pi(e) of that, of a policy that has made
    its choice already, which is too little where beta e is not small.
    """
    problem, n = empirical.problem, np.maximum(rows.n, 1.0)
    noise = np.where(empirical.used, rows.variance / n, 0.0)[problem.states]
    with np.errstate(divide="ignore"):
        worth = problem.action_value(here.value) + np.log(problem.prior) / problem.beta
    best = worth.argmax(1)
    together = noise + np.take_along_axis(noise, best[:, None], 1)
    tied = worth.max(1)[:, None] - worth <= TIED * np.sqrt(together)
    tied &= problem.beta**2 * together > 1  # else the second order has it
    np.put_along_axis(tied, best[:, None], True, 1)
    undecided = np.flatnonzero(tied.sum(1) > 1)
    if not undecided.size:
        return 0.0
    draws = np.random.default_rng(0).standard_normal((SIGNS, 1, problem.n_actions)) * np.sqrt(noise[undecided])
    exponent = np.where(tied[undecided], problem.beta * draws, -np.inf)
    gained = (special.logsumexp(exponent, axis=2) - np.log(tied[undecided].sum(1))).mean(0) / problem.beta
    had = 0.5 * problem.beta * (policy * (1 - policy) * noise).sum(1)[undecided]
    luck = np.zeros(problem.n_states)
    luck[undecided] = np.maximum(gained - had, 0.0)
    return float((here.d.sum(1) * luck).sum())


def _withheld(variance: float, bias: float, untried: float) -> str:
    if not variance > 0:
        return "no pair shows any variance"
    if not np.isfinite(variance):
        return "its variance is beyond double precision"
    if not abs(bias) <= np.sqrt(variance):
        return "the second order is larger than the first"
    if untried > 2 * np.sqrt(variance):
        return "pairs never tried matter more than those that were"
    return ""


def _same_reward(model: EmpiricalMDP, empirical: EmpiricalProblem) -> str:
    if model.given and not model.reward_variance[empirical.used].any():
        return "no reward varies in these tuples, and nothing else is estimated where the dynamics are given"
    rewards = model.reward[empirical.used]
    if np.ptp(rewards) == 0 and not model.reward_variance[empirical.used].any():
        return "every reward seen is the same"
    return ""


def _untried(empirical: EmpiricalProblem, here: _Worth) -> float:
    """The gain of J, to first order, if each pair never visited brought the best reward and the best successor seen
    from its state.
    """
    problem = empirical.problem
    ptr, to, _ = problem.pattern
    rewards = problem.reward - np.log(empirical.tried)[:, None] / problem.beta
    best = np.max(rewards, axis=1) + np.maximum.reduceat(here.value[to], ptr[:-1])
    better = problem.beta * (best - here.value - here.gain)
    with np.errstate(divide="ignore"):
        gain = np.logaddexp(0.0, np.log1p(-empirical.tried) + better)
    return float(here.d.sum(1) @ gain) / problem.beta


def _within(model: EmpiricalMDP, weight: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Variance of the reward given s', mean over s', [S*A]; divisor n."""
    visits = model.visits.ravel()
    total = model.reward_variance.ravel() * (visits - 1) / np.maximum(visits, 1)
    explained = weight * (model.reward_given_next - model.reward.ravel()[rows]) ** 2
    return np.asarray(np.maximum(total - np.bincount(rows, explained, len(visits)), 0.0))


def _multinomial(rng: np.random.Generator, visits: np.ndarray, p: sp.csr_array, rows: np.ndarray) -> np.ndarray:
    """Counts [nnz] of visits[k] draws from each row k, drawn as binomials, one entry after another."""
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
