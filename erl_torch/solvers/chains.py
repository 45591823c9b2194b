"""Markov chains: classes of states, shares of time, and linear equations solved by regeneration.

A chain K [S, S] with a state ``ref`` that is reached from everywhere is cut at its visits to ``ref``. Let A be I - K
without the row and column of ``ref``. The LU of A solves both the Poisson equation and the stationary distribution.
A is a nonsingular M-matrix (stable without pivoting), and no dense column spoils its sparsity where many states
restart at ``ref``.

The diagonal of A is never a difference: it is the sum of the rest of its row, and so is every pivot (Grassmann,
Taksar, Heyman 1985), as long as the factors stay small enough for the compiled elimination. Beyond that SuperLU
factors A; its pivots are differences, and states that are all but closed cost digits there.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
import scipy.sparse.csgraph as csgraph
import scipy.sparse.linalg as spla

from erl_torch.solvers import kernels

GTH_STATES = 100  # up to here the dense elimination is the faster
DENSE_STATES = 2000  # up to here it serves where nothing else does: seconds, 32 MB
ORDERED_STATES = 4000  # up to here the elimination has an order of its own
EPSILON = float(np.finfo(np.float64).eps)
MAX_OPERATIONS = 15_000_000  # multiplications of one compiled LU: about ten milliseconds


class SingularChainError(ArithmeticError):
    """``ref`` is not reached from every state, as far as double precision can tell."""


def reachable_from(chain: sp.csr_array, start: np.ndarray) -> np.ndarray:
    """[S] bool: states with a path from the support of ``start`` [S], in the pattern of ``chain``, CSR [S, S]."""
    n = len(start)
    sources = np.flatnonzero(start > 0)
    # One search from one more state, with an edge to every source.
    indptr = np.concatenate([chain.indptr, [chain.indptr[-1] + len(sources)]])
    indices = np.concatenate([chain.indices, sources])
    graph = sp.csr_array((np.ones(len(indices), np.int8), indices, indptr), shape=(n + 1, n + 1))
    order = csgraph.breadth_first_order(graph, n, return_predecessors=False)
    seen = np.zeros(n + 1, bool)
    seen[order] = True
    return seen[:n]


def classes(chain: sp.csr_array) -> tuple[np.ndarray, np.ndarray]:
    """(label [S], closed [n_classes] bool): the strongly connected class of each state; the classes without exit."""
    n_classes, label = csgraph.connected_components(chain, directed=True, connection="strong")
    origin = np.repeat(np.arange(chain.shape[0]), np.diff(chain.indptr))
    leaves = label[origin] != label[chain.indices]
    closed = np.ones(n_classes, bool)
    closed[label[origin[leaves]]] = False
    return label, closed


def likely_state(chain: sp.csr_array, steps: int = 64) -> int:
    """A state where the chain spends much time, after ``steps`` lazy steps from everywhere."""
    share = np.full(chain.shape[0], 1.0 / chain.shape[0])
    for _ in range(steps):
        share = 0.5 * (share + chain.T @ share)
    return int(np.argmax(share))


@dataclass(frozen=True, eq=False)
class Elimination:
    """The order in which the states of chains of one pattern are eliminated, and the fill of their LU factors."""

    ptr: np.ndarray  # [n + 1], CSR of the pattern
    ind: np.ndarray
    rank: np.ndarray  # [n], place in the elimination; the state itself where the chains are too large to be ordered
    lu: tuple[np.ndarray, ...]  # (lptr, lind, uptr, uind) of ``kernels.lu_pattern``; empty: too large, or too much fill

    @classmethod
    def of(cls, ptr: np.ndarray, ind: np.ndarray) -> Elimination:
        """For CSR chains (ptr, ind)."""
        n = len(ptr) - 1
        if n > ORDERED_STATES:
            return cls(ptr, ind, np.arange(n, dtype=np.int32), ())
        # Any values serve: only SuperLU's minimum-degree ordering is used.
        matrix = 2 * sp.eye_array(n) - sp.csr_array((np.full(ind.size, 1.0 / n), ind, ptr), shape=(n, n))
        ordered = spla.splu(
            matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        )
        rank = ordered.perm_c.astype(np.int32)
        ptr, ind = ptr.astype(np.int64), ind.astype(np.int32)
        lu = kernels.lu_pattern(ptr, ind, rank)
        return cls(ptr, ind, rank, lu if (np.diff(lu[2]) ** 2).sum() <= MAX_OPERATIONS else ())

    @property
    def fits(self) -> bool:
        return bool(self.lu)

    @cached_property
    def order(self) -> np.ndarray:
        """The states in the order of elimination, [n]."""
        return np.argsort(self.rank)

    @cached_property
    def column(self) -> np.ndarray:
        """Rank of the successor of each entry."""
        return np.asarray(self.rank[self.ind])


class _CompiledLU:
    """LU of I - K, cut at ``ref``, without a subtraction; ``data``: K's entries on the elimination's pattern."""

    def __init__(self, elimination: Elimination, data: np.ndarray, ref: int, leak: float) -> None:
        e, n = elimination, len(elimination.rank)
        lptr, lind, uptr, uind = e.lu
        low, up, diagonal = np.empty(lind.size), np.empty(uind.size), np.empty(n)
        at = int(e.rank[ref])
        kernels.cut_lu(
            e.ptr,
            e.column,
            data,
            e.order,
            at,
            leak,
            lptr,
            lind,
            uptr,
            uind,
            low,
            up,
            diagonal,
            np.empty(n),
            np.zeros(n),
        )
        self._elimination, self._data, self._ref = e, data, at
        self._factors = (lptr, lind, uptr, uind, low, up, diagonal)

    def solve(self, x: np.ndarray) -> np.ndarray:
        ranked = x[self._elimination.order]
        kernels.cut_solve(*self._factors, ranked)
        return np.asarray(ranked[self._elimination.rank])

    def visits(self) -> np.ndarray:
        """Expected visits to each state between two to ``ref``, [n]."""
        e = self._elimination
        ranked = np.empty(len(e.rank))
        kernels.cut_share(e.ptr, e.column, self._data, e.order, self._ref, *self._factors, ranked)
        return np.asarray(ranked[e.rank])


class _SuperLU:
    """The same by SuperLU, for large factors."""

    def __init__(self, elimination: Elimination, chain: sp.csr_array, ref: int, leak: float, row: np.ndarray) -> None:
        n = chain.shape[0]
        origin = np.repeat(np.arange(n), np.diff(chain.indptr))
        away = chain.indices != origin
        diagonal = np.bincount(origin[away], chain.data[away], n) + leak
        diagonal[ref] = 1.0
        if not (diagonal > 0).all():  # where a diagonal entry is missing, SuperLU reads outside its arrays
            raise SingularChainError(f"state {int(np.argmin(diagonal))} is never left")
        kept = away & (chain.indices != ref) & (origin != ref)
        rank = elimination.rank
        off = sp.csr_array((-chain.data[kept], (rank[origin[kept]], rank[chain.indices[kept]])), shape=(n, n))
        cut = sp.csc_array(off + sp.diags_array(diagonal[elimination.order]))
        ordering = "MMD_AT_PLUS_A" if n > ORDERED_STATES else "NATURAL"  # up to there the rank has ordered them
        try:
            # No pivoting: an M-matrix needs none, and the fill stays what the ordering makes it.
            self._lu = spla.splu(cut, permc_spec=ordering, diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        except RuntimeError as error:  # exactly singular
            raise SingularChainError(str(error)) from error
        self._elimination, self._ref, self._row = elimination, ref, row

    def solve(self, x: np.ndarray, transposed: str = "N") -> np.ndarray:
        return np.asarray(self._lu.solve(x[self._elimination.order], transposed)[self._elimination.rank])

    def visits(self) -> np.ndarray:
        visits = np.maximum(self.solve(self._row, "T"), 0.0)
        visits[self._ref] = 1.0
        return np.asarray(visits)


class RegenerativeLU:
    """LU of I - discount * ``chain``, cut at ``ref``; ``chain`` is a row-stochastic CSR [S, S].

    ``elimination``: that of the chain's pattern, where the caller has it. With discount 1, raises SingularChainError
    if ``ref`` is not reached from everywhere.
    """

    def __init__(
        self, chain: sp.csr_array, ref: int, discount: float = 1.0, elimination: Elimination | None = None
    ) -> None:
        n = chain.shape[0]
        self.ref, self.discount = ref, discount
        self.chain = chain if discount == 1.0 else chain * discount
        first, last = chain.indptr[ref], chain.indptr[ref + 1]
        self._row = np.zeros(n)  # of ref, without ref itself
        np.add.at(self._row, chain.indices[first:last], self.chain.data[first:last])
        self._row[ref] = 0.0
        self.elimination = elimination or Elimination.of(chain.indptr, chain.indices)
        self._lu: _CompiledLU | _SuperLU
        if self.elimination.fits:
            self._lu = _CompiledLU(self.elimination, self.chain.data, ref, 1.0 - discount)
        else:
            self._lu = _SuperLU(self.elimination, self.chain, ref, 1.0 - discount, self._row)
        ones = np.ones(n)
        ones[ref] = 0.0
        with np.errstate(over="ignore", invalid="ignore"):
            self.hitting_time = self._lu.solve(ones)  # expected (discounted) steps to ref
        if not (np.isfinite(self.hitting_time).all() and self.hitting_time.min() >= 0):
            raise SingularChainError(f"state {ref} is not reached from every state")

    @classmethod
    def adapted(cls, chain: sp.csr_array, ref: int, elimination: Elimination | None = None) -> RegenerativeLU:
        """The LU cut at ``ref``, or at the likeliest state where ``ref`` is so rare that digits would be lost."""
        try:
            lu = cls(chain, ref, elimination=elimination)
            elimination = lu.elimination
            share = lu.stationary()
            likely = int(np.argmax(share))
            if share[likely] < 100 * share[ref] or lu.hitting_time.max() < 1e5:
                return lu
        except SingularChainError:
            likely = likely_state(chain)
            if likely == ref:
                raise
        return cls(chain, likely, elimination=elimination)

    def poisson(self, c: np.ndarray, refine: bool = True) -> tuple[float, np.ndarray]:
        """(gain, w) with w + gain = c + discount K w and w[ref] = 0.

        With x = c + discount K x, the discounted value, w = x - x[ref] and gain = (1 - discount) x[ref].
        """
        with np.errstate(over="ignore", invalid="ignore"):  # the callers check the result
            gain, w = self._poisson(c)
            if not refine:
                return gain, w
            # One refinement: the first answer is a difference of large numbers where ref is far.
            more, dw = self._poisson(c + self.chain @ w - w - gain)
            return gain + more, w + dw

    def _poisson(self, c: np.ndarray) -> tuple[float, np.ndarray]:
        x = c.copy()
        x[self.ref] = 0.0
        x = self._lu.solve(x)
        gain = (c[self.ref] + self._row @ x) / (1.0 + self._row @ self.hitting_time)
        return float(gain), x - gain * self.hitting_time

    def stationary(self) -> np.ndarray:
        """Share of time in each state [S] from ``ref`` on, with discount 1 for ever: the stationary distribution."""
        d = self._lu.visits()
        return np.asarray(d / d.sum())


class Share(NamedTuple):
    """Long-run shares of time."""

    of_state: np.ndarray  # [S], sums to 1
    relative_error: float  # of each share, at most, if the chain's entries have none; infinite where not known


def policy_chain(transition: sp.csr_array, policy: np.ndarray) -> sp.csr_array:
    """The chain [S, S] that ``policy`` [S, A] makes of a transition matrix [S*A, S]."""
    n_states, n_actions = policy.shape
    n = n_states * n_actions
    choose = sp.csr_array((policy.ravel(), np.arange(n), np.arange(0, n + 1, n_actions)), shape=(n_states, n))
    chain = sp.csr_array(choose @ transition)
    chain.eliminate_zeros()
    return chain


def long_run(chain: sp.csr_array, start: np.ndarray, dense: bool = False) -> Share:
    """Long-run share of time in each state, from ``start`` [S]; chain CSR [S, S], its diagonal is not read.

    Periodic chains and chains with several closed classes are fine: each class counts by the probability of ending in
    it. ``dense``: eliminate densely also where there are many states, because the error is known then.

    Raises SingularChainError for a class of more than DENSE_STATES states that falls apart in double precision.
    """
    chain = sp.csr_array(chain)
    if not (chain.data > 0).all():
        chain = chain.copy()
        chain.eliminate_zeros()
    reached = reachable_from(chain, start)
    label, closed = classes(chain)
    ends = np.unique(label[reached & closed[label]])
    weight, ending_error = _ending(chain, start, reached, label, ends, dense)
    share, error = np.zeros(len(start)), 0.0
    for c, mass in zip(ends, weight, strict=True):
        members = np.flatnonzero(label == c)
        own = stationary(chain if len(members) == len(start) else sp.csr_array(chain[members][:, members]), dense)
        share[members] = mass * own.of_state
        error = max(error, own.relative_error)
    return Share(share, error + ending_error)


def stationary(chain: sp.csr_array, dense: bool = False) -> Share:
    """Shares of time in one closed class [S, S], entries > 0; sets of its states may be all but closed.

    Raises as ``long_run``.
    """
    n = chain.shape[0]
    share = _dense_stationary(chain) if n <= (DENSE_STATES if dense else GTH_STATES) else None
    if share is None or not np.isfinite(share.relative_error):
        try:
            return Share(RegenerativeLU.adapted(chain, 0).stationary(), np.inf)
        except SingularChainError:
            if share is None and n <= DENSE_STATES and not dense:
                share = _dense_stationary(chain)
            if share is None:
                raise
    return share


def _dense_stationary(chain: sp.csr_array) -> Share | None:
    """``stationary`` by dense elimination, S^3/3 steps, with a bound on its rounding (docs/theory.md, 6).

    None where products of probabilities leave double precision.
    """
    n = chain.shape[0]
    if n == 1:
        return Share(np.ones(1), 0.0)
    share, sound = kernels.gth(chain.toarray())
    if not np.isfinite(share).all():
        return None
    return Share(np.asarray(share), 8.0 * n * (n + 2) * EPSILON if sound else np.inf)


def _ending(
    chain: sp.csr_array, start: np.ndarray, reached: np.ndarray, label: np.ndarray, ends: np.ndarray, dense: bool
) -> tuple[np.ndarray, float]:
    """(probability [n_ends] of ending in each of the classes ``ends``, its relative error).

    They are the shares of time in a chain that begins anew once it is in one of these classes.
    """
    if len(ends) == 1:
        return np.ones(1), 0.0
    passing = np.flatnonzero(reached & ~np.isin(label, ends))
    n, n_ends = len(passing), len(ends)
    place = np.full(len(start), -1)
    place[passing] = np.arange(n)
    for i, c in enumerate(ends):
        place[label == c] = n + i
    origin = np.repeat(np.arange(len(start)), np.diff(chain.indptr))
    used = (place[origin] >= 0) & (place[origin] < n)
    first = np.flatnonzero(start > 0)
    again = n + n_ends
    rows = np.concatenate([place[origin[used]], n + np.arange(n_ends), np.full(len(first), again)])
    columns = np.concatenate([place[chain.indices[used]], np.full(n_ends, again), place[first]])
    data = np.concatenate([chain.data[used], np.ones(n_ends), start[first]])
    anew = sp.csr_array((data, (rows, columns)), shape=(again + 1, again + 1))
    anew.sum_duplicates()
    share = stationary(anew, dense)
    ended = share.of_state[n:again]
    return np.asarray(ended / ended.sum()), 2 * share.relative_error
