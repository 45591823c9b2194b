"""The empirical model of a stream: visit counts, transition frequencies, mean rewards.

What no tuple shows is no part of the problem. ``EmpiricalMDP.problem`` poses the problem on the rest:

    pairs     a pair (s,a) never visited, or with prior 0, is not available: the optimum is over the others. The KL cost
              is still
              that of the whole prior, so with m(s) the prior's mass on the visited actions of s
              sum_visited pi0 exp(beta q) = m sum_visited (pi0/m) exp(beta q): a reward log(m(s))/beta on top.
    states    a state never left (as the last of an episode) has no known future: the tuples that lead there are
              left out, and with them the pairs and states that have no other tuples.
    classes   where the empirical process has several closed classes, the problem is the one with the most tuples;
              where it has one, states from which that is reached take part too.

States that take no part keep the prior policy. ``message`` names what was left out.

Rewards that vary for the same (s,a) count by their mean. Where optimism is not 0 they may count together with s' in
place of that (``joint``), the certainty equivalent being (1/kappa) log <exp(kappa (r + V(s')))> over the tuples of the
pair, kappa = optimism * beta: S1's listing at optimism 1. That is the problem of other frequencies and rewards,

    p'(s'|s,a) ~ n(s,a,s') <exp(kappa r)>(s,a,s'),    r'(s,a) = (1/kappa) log <exp(kappa r)>(s,a).

Tuples with weights w count for w each: with W(s,a,s') their sum, the frequencies are W(s,a,s')/W(s,a), and means are
sums of w x over sums of w: the model of other dynamics p^ ~ w p. Tuples of weight 0 are left out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike

from erl_torch import checks
from erl_torch.checks import InputError
from erl_torch.empirical import kernels
from erl_torch.experience.experience import EXPERIENCE, Experience, is_weighted, weighing
from erl_torch.mdp.tabular import check_prior, normalise_rows
from erl_torch.solvers.chains import classes
from erl_torch.solvers.problem import BellmanProblem

NOISE = ("mean", "joint")  # how rewards that vary count
BLOCK = 1 << 16  # tuples at a time: they stay in the processor's cache


@dataclass(frozen=True, eq=False)
class WeightSums:
    """What the weights w of the tuples of each (s,a,s') come to, [nnz] each; entries as in ``transition``."""

    total: np.ndarray  # sum of w
    squares: np.ndarray  # sum of w^2
    off: np.ndarray  # sum of w^2 (r - mean r given s')
    off_squares: np.ndarray  # sum of w^2 (r - mean r given s')^2
    drawn: np.ndarray  # tuples of each pair, those of weight 0 too, [S*A]

    def mean(self, rows: np.ndarray) -> np.ndarray:
        """Mean weight of each pair, [S*A]; 1 without a tuple. ``rows`` [nnz]: pairs of the entries."""
        total = np.bincount(rows, self.total, len(self.drawn))
        return np.where(self.drawn > 0, total / np.maximum(self.drawn, 1), 1.0)


@dataclass(frozen=True, eq=False)
class EmpiricalMDP:
    """Sufficient statistics of a stream: S*A and nnz numbers, for a stream of any length."""

    visits: np.ndarray  # n(s,a), [S, A] int64; tuples of weight 0 excepted
    transition: sp.csr_array  # n(s,a,s')/n(s,a), [S*A, S]; rows without visits are empty
    reward: np.ndarray  # mean, [S, A]; 0 without visits
    reward_variance: np.ndarray  # of one reward, [S, A], divisor n-1; 0 below two visits
    reward_given_next: np.ndarray  # mean reward of (s,a,s'), [nnz], entries as in `transition`
    weights: WeightSums | None = None  # of tuples with weights
    given: bool = False  # `transition` is known, and only the rewards are of the stream (erl_torch.empirical.dynamics)

    @property
    def n_states(self) -> int:
        return int(self.visits.shape[0])

    @property
    def n_actions(self) -> int:
        return int(self.visits.shape[1])

    def problem(self, beta: float, prior_policy: ArrayLike | None = None, *, optimism: float = 0.0) -> EmpiricalProblem:
        """The empirical problem; the module's docstring says what is left out.

        ``optimism``: 1 optimistic (control as inference), 0 right, negative robust.

        Raises:
            InputError: beta, prior or optimism out of range, or no state that is ever returned to.
        """
        beta = checks.temperature("beta", beta)
        optimism = checks.optimism("optimism", optimism, beta)
        prior = check_prior("prior_policy", prior_policy, self.n_states, self.n_actions)
        used, entries, message, reducible = self._solvable(prior > 0)
        taken = used.any(1)
        states = np.flatnonzero(taken)
        # A pair that is not used repeats one that is, with a prior of 0. So shapes stay [n, A], and the graph stays.
        action = np.where(used, np.arange(self.n_actions), used.argmax(1)[:, None])[states]
        rows = (states[:, None] * self.n_actions + action).ravel()
        p = self.transition.copy()
        p.data = p.data * entries
        p = sp.csr_array(p[rows][:, states])
        p.eliminate_zeros()
        p.sort_indices()
        normalise_rows(str, p.indptr, p.data, np.inf)
        weight = (prior * used)[states]
        mass = weight.sum(1, keepdims=True)
        reward = np.take_along_axis(self.reward[states], action, axis=1) + np.log(np.minimum(mass, 1.0)) / beta
        visits = (self.visits * (prior > 0))[states]
        start = visits.sum(1) / visits.sum()
        problem = BellmanProblem(states, p, reward, weight / mass, start, float(beta), optimism)
        return EmpiricalProblem(problem, used, message, reducible, np.minimum(mass[:, 0], 1.0))

    def _solvable(self, allowed: np.ndarray) -> tuple[np.ndarray, np.ndarray, str, bool]:
        """(pairs that take part [S, A], entries of ``transition`` that do [nnz], message, several closed classes), of
        the pairs ``allowed`` [S, A]."""
        p, n_actions = self.transition, self.n_actions
        pair_of = np.repeat(np.arange(self.visits.size), np.diff(p.indptr))
        there, visits = allowed.ravel()[pair_of], self.visits * allowed
        alive: np.ndarray = np.asarray(visits.any(1))
        while True:
            entries = alive[p.indices] & alive[pair_of // n_actions] & there
            used = (np.bincount(pair_of, entries, self.visits.size) > 0).reshape(self.visits.shape)
            if (used.any(1) == alive).all():
                break
            alive = np.asarray(used.any(1))
        if not alive.any():
            raise InputError("transitions", "a stream that never returns to any state", "long enough to have cycles")
        lost = visits.any(1) & ~alive
        message = f"states {np.flatnonzero(lost)[:5].tolist()} lead nowhere in this stream" if lost.any() else ""
        origin, to = pair_of[entries] // n_actions, p.indices[entries]
        graph = sp.csr_array((np.ones(len(to)), (origin, to)), shape=(self.n_states, self.n_states))
        label, closed = classes(graph)
        closed[label[~alive]] = False  # states that take no part are classes of their own
        if closed.sum() > 1:
            tuples = np.bincount(label, visits.sum(1)) * closed
            members = label == np.argmax(tuples)
            used &= members[:, None]
            entries &= members[pair_of // n_actions]
            message = (
                f"{closed.sum()} closed sets of states in this stream; solved on {_name(members)}, the most visited"
            )
        return used, entries, message, bool(closed.sum() > 1)


def _name(members: np.ndarray) -> str:
    states = np.flatnonzero(members)
    return f"{states[:5].tolist()}{'...' if len(states) > 5 else ''}"


@dataclass(frozen=True, eq=False)
class EmpiricalProblem:
    """The soft Bellman problem that a stream poses, and what it leaves out."""

    problem: BellmanProblem  # on the states that take part
    used: np.ndarray  # [S, A] bool, pairs that take part
    message: str  # what was left out, and why; "" where nothing was
    reducible: bool  # the stream shows several closed classes; the problem is the most visited one
    tried: np.ndarray  # the prior's mass on the pairs that take part, [n]


@dataclass(frozen=True, eq=False)
class Tally:
    """The counts of one pass over a stream, in memory for S*A pairs and the distinct (s,a,s')."""

    visits: np.ndarray  # [S*A] int64
    indptr: np.ndarray  # [S*A + 1], rows of the (s,a,s') met
    indices: np.ndarray  # [nnz] int32, s', ascending in a row
    counts: np.ndarray  # [nnz] int64
    reward_given_next: np.ndarray  # mean, [nnz]
    last_reward: np.ndarray  # of the last visit, [S*A]; 0 without visits
    varied: bool  # a pair has had two rewards
    reward_range: tuple[float, float]
    psi_weight: np.ndarray  # [nnz], W of one psi epoch; 0 without lr_psi

    @property
    def psi_map(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """W as CSR [S*A, S] without weights that underflowed; the decay is (1 - lr_psi)**visits."""
        kept = self.psi_weight > 0
        indptr = np.concatenate(([0], np.cumsum(kept)))[self.indptr]
        return indptr, self.indices[kept], self.psi_weight[kept]


def tally(data: Experience, n_states: int, n_actions: int, lr_psi: float = 0.0) -> Tally:
    """Count a stream. The bits do not depend on how it is cut into chunks.

    Args:
        data: the tuples; a' is not used.
        n_states, n_actions: sizes of the tables.
        lr_psi: step size of lines 2-3 of Algorithm S1, for W; 0 computes no W.

    Raises:
        InputError: naming the first tuple with a state or action out of range.
    """
    checks.instance("transitions", data, Experience, EXPERIENCE)
    data.check_range(n_states, n_actions)
    n_pairs = n_states * n_actions
    if n_pairs > np.iinfo(np.int32).max:
        raise InputError("n_states * n_actions", n_pairs, "below 2**31")
    pairs = np.tile([0.0, 0.0, 1.0, -1.0], (n_pairs, 1))
    size, used = 512, 0
    keys, entries = np.empty(size, np.int64), np.zeros((size, 4))
    table, shift = _table(keys, 0, 2 * size)
    varied, smallest, largest = False, np.inf, -np.inf
    for chunk in data.chunks():
        for begin in range(0, len(chunk), BLOCK):
            block = slice(begin, begin + BLOCK)
            pair, s_next, r = chunk.s[block] * np.int32(n_actions) + chunk.a[block], chunk.s_next[block], chunk.r[block]
            done = 0
            while done < len(pair):
                if used == size:
                    size *= 4
                    keys, entries = np.resize(keys, size), np.concatenate((entries, np.zeros((size - used, 4))))
                    table, shift = _table(keys, used, 2 * size)
                done, used, changed, low, high = kernels.tally(
                    pair, s_next, r, n_states, lr_psi, shift, table, keys, entries, pairs, used, done
                )
                varied, smallest, largest = varied or changed, min(smallest, low), max(largest, high)
    order = np.argsort(keys[:used])
    row, indices = np.divmod(keys[:used][order], n_states)
    counts, totals, weight, _ = entries[order].T
    return Tally(
        visits=pairs[:, 0].astype(np.int64),
        indptr=np.concatenate(([0], np.cumsum(np.bincount(row, minlength=n_pairs)))),
        indices=indices.astype(np.int32),
        counts=counts.astype(np.int64),
        reward_given_next=totals / counts,
        last_reward=pairs[:, 1].copy(),
        varied=varied,
        reward_range=(float(smallest), float(largest)),
        psi_weight=weight * pairs[row, 2],
    )


def _table(keys: np.ndarray, used: int, size: int) -> tuple[np.ndarray, int]:
    """(hash table [size, 2] of the entries, shift), for ``kernels.tally``; size a power of two."""
    table = np.full((size, 2), -1, np.int64)
    shift = 65 - size.bit_length()
    kernels.enter(table, keys, used, shift)
    return table, shift


def empirical_mdp(data: Experience, n_states: int, n_actions: int, counted: Tally | None = None) -> EmpiricalMDP:
    """Counts and mean rewards of a stream: one pass over it, and two more where rewards vary.

    Args:
        data: the tuples; a' is not used. Weights count, as the module's docstring says.
        n_states, n_actions: sizes of the tables.
        counted: the tally of the stream, where the caller has it.

    Raises:
        InputError: naming the first tuple with a state or action out of range, or a pair all of whose tuples have
            weight 0.
    """
    checks.instance("transitions", data, Experience, EXPERIENCE)
    if is_weighted(data):
        kept = weighing(data, n_states, n_actions)
        if is_weighted(kept):
            drawn = np.zeros(n_states * n_actions, np.int64)
            for chunk in data.chunks():
                drawn += np.bincount(chunk.s * np.int32(n_actions) + chunk.a, minlength=len(drawn))
            return _weighted(kept, n_states, n_actions, drawn)
        data = kept
    counted = counted or tally(data, n_states, n_actions)
    visits, base = counted.visits, counted.last_reward
    n = np.maximum(visits, 1)
    # Sums of differences from one reward of the pair: the mean of a constant reward is exactly that reward.
    off, squares = np.zeros(len(visits)), np.zeros(len(visits))
    reward = base + off
    if counted.varied:
        with np.errstate(over="ignore", invalid="ignore"):
            for chunk in data.chunks():
                pair = chunk.s * np.int32(n_actions) + chunk.a
                np.add.at(off, pair, chunk.r - base[pair])
            reward = base + off / n
            for chunk in data.chunks():
                pair = chunk.s * np.int32(n_actions) + chunk.a
                np.add.at(squares, pair, (chunk.r - reward[pair]) ** 2)
        if not np.isfinite(squares).all():
            low, high = counted.reward_range
            raise InputError("r", f"between {low:g} and {high:g}", "of a size whose squares are finite numbers")
    rows = np.diff(counted.indptr)
    return EmpiricalMDP(
        visits=visits.reshape(n_states, n_actions),
        transition=sp.csr_array(
            (counted.counts / np.repeat(n, rows), counted.indices, counted.indptr), shape=(len(visits), n_states)
        ),
        reward=reward.reshape(n_states, n_actions),
        reward_variance=(squares / np.maximum(visits - 1, 1)).reshape(n_states, n_actions),
        reward_given_next=counted.reward_given_next,
    )


def entries_of(model: EmpiricalMDP, s: np.ndarray, a: np.ndarray, s_next: np.ndarray) -> np.ndarray:
    """[N], the entry of ``model.transition`` that each (s,a,s') is of; its rows are sorted, and it has them all."""
    p, n_states = model.transition, np.int64(model.n_states)
    keys = np.repeat(np.arange(p.shape[0]), np.diff(p.indptr)) * n_states + p.indices
    return np.asarray(np.searchsorted(keys, (s * np.int32(model.n_actions) + a) * n_states + s_next))


def _weighted(data: Experience, n_states: int, n_actions: int, drawn: np.ndarray) -> EmpiricalMDP:
    """``empirical_mdp`` of tuples with weights above 0: three passes. ``drawn`` [S*A] counts those of weight 0 too."""
    seen = tally(data, n_states, n_actions)
    n_pairs, nnz, base = len(seen.visits), len(seen.counts), seen.last_reward
    row = np.repeat(np.arange(n_pairs), np.diff(seen.indptr))
    plain = EmpiricalMDP(
        visits=seen.visits.reshape(n_states, n_actions),
        transition=sp.csr_array((np.ones(nnz), seen.indices, seen.indptr), shape=(n_pairs, n_states)),
        reward=np.zeros((n_states, n_actions)),
        reward_variance=np.zeros((n_states, n_actions)),
        reward_given_next=np.zeros(nnz),
    )
    total, squares, off, square_off, spread, square_spread = np.zeros((6, nnz))
    for chunk in data.chunks():
        assert chunk.weight is not None
        entry, w = entries_of(plain, chunk.s, chunk.a, chunk.s_next), chunk.weight
        np.add.at(total, entry, w)
        np.add.at(squares, entry, w**2)
        np.add.at(off, entry, w * (chunk.r - base[row[entry]]))
    of_pair = np.bincount(row, total, n_pairs)
    some = np.maximum(of_pair, np.finfo(float).tiny)
    reward = base + np.bincount(row, off, n_pairs) / some
    given = base[row] + off / total
    with np.errstate(over="ignore", invalid="ignore"):
        for chunk in data.chunks():
            assert chunk.weight is not None
            entry, w = entries_of(plain, chunk.s, chunk.a, chunk.s_next), chunk.weight
            np.add.at(spread, entry, w * (chunk.r - reward[row[entry]]) ** 2)
            np.add.at(square_off, entry, w**2 * (chunk.r - given[entry]))
            np.add.at(square_spread, entry, w**2 * (chunk.r - given[entry]) ** 2)
    if not all(np.isfinite(x).all() for x in (total, squares, spread, square_spread)):
        raise InputError("weight", "weights and rewards", "of a size whose squares are finite numbers")
    n = np.maximum(seen.visits, 1)
    variance = np.where(n > 1, np.bincount(row, spread, n_pairs) / some * n / np.maximum(n - 1, 1), 0.0)
    return replace(
        plain,
        transition=sp.csr_array((total / of_pair[row], seen.indices, seen.indptr), shape=(n_pairs, n_states)),
        reward=reward.reshape(n_states, n_actions),
        reward_variance=variance.reshape(n_states, n_actions),
        reward_given_next=given,
        weights=WeightSums(total, squares, square_off, square_spread, drawn),
    )


def joint(model: EmpiricalMDP, data: Experience, kappa: float) -> EmpiricalMDP:
    """``model``, of the stream ``data``, with rewards that count together with s': the module's docstring.

    Two passes over the stream; pairs whose rewards do not vary stay as they are, and all do at kappa 0. Intervals
    (``erl_torch.empirical.uncertainty``) are of mean rewards alone.

    Args:
        model: ``empirical_mdp`` of ``data``.
        data: the tuples.
        kappa: optimism * beta, 1/reward.
    """
    varied = np.asarray(model.reward_variance.ravel() > 0)
    if kappa == 0 or not varied.any():
        return model
    data = weighing(data, model.n_states, model.n_actions)
    p = model.transition
    row = np.repeat(np.arange(p.shape[0]), np.diff(p.indptr))
    largest, total = np.full(p.nnz, -np.inf), np.zeros(p.nnz)
    mean = model.reward.ravel()
    off, widest = np.zeros((2, p.shape[0]))  # of kappa (r - mean r): the sum of expm1, the largest size
    for sums in (False, True):
        for chunk in data.chunks():
            entry, weight = (
                entries_of(model, chunk.s, chunk.a, chunk.s_next),
                1.0 if chunk.weight is None else chunk.weight,
            )
            if sums:
                np.add.at(total, entry, weight * np.exp(kappa * chunk.r - largest[entry]))
                pair = row[entry]
                x = kappa * (chunk.r - mean[pair])
                np.maximum.at(widest, pair, np.abs(x))
                np.add.at(off, pair, weight * np.expm1(np.minimum(x, 1.0)))
            else:
                np.maximum.at(largest, entry, kappa * chunk.r)
    first = p.indptr[:-1][np.diff(p.indptr) > 0]
    visits = model.visits.ravel() if model.weights is None else np.bincount(row, model.weights.total, p.shape[0])
    log_share = largest + np.log(total / visits[row])
    log_mean = np.zeros(p.shape[0])
    log_mean[row[first]] = np.logaddexp.reduceat(log_share, first)
    # A share that underflows stays a successor.
    share = np.where(varied[row], np.maximum(np.exp(log_share - log_mean[row]), 1e-300), p.data)
    # Where all is close to the mean, the difference of logarithms would lose what kappa divides.
    n = np.bincount(row, visits[row] * p.data, p.shape[0]) if model.weights is None else visits
    near = mean + np.log1p(off / np.maximum(n, np.finfo(float).tiny)) / kappa
    reward = np.where(varied, np.where(widest <= 1.0, near, log_mean / kappa), mean)
    transition = sp.csr_array((share, p.indices, p.indptr), shape=p.shape)
    return replace(model, transition=transition, reward=reward.reshape(model.reward.shape))
