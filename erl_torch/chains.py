"""Markov chains: classes of states, and linear equations solved by regeneration.

A chain K [S, S] with a state ``ref`` that is reached from everywhere is cut at its visits to ``ref``: with A = I - K
without the row and column of ``ref``, both the Poisson equation and the stationary distribution are solves with the
sparse LU of A, a nonsingular M-matrix (stable without pivoting), and no dense column spoils its sparsity where many
states restart at ``ref``.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
import scipy.sparse.csgraph as csgraph
import scipy.sparse.linalg as spla


class SingularChainError(ArithmeticError):
    """``ref`` is not reached from every state, as far as double precision can tell."""


def reachable_from(chain: sp.csr_array, start: np.ndarray) -> np.ndarray:
    """[S] bool: states that have a path from the support of ``start`` [S]; ``chain`` CSR [S, S], its pattern counts."""
    n = len(start)
    sources = np.flatnonzero(start > 0)
    # One more state, with an edge to every source.
    indptr = np.concatenate([chain.indptr, [chain.indptr[-1] + len(sources)]])
    indices = np.concatenate([chain.indices, sources])
    graph = sp.csr_array((np.ones(len(indices), np.int8), indices, indptr), shape=(n + 1, n + 1))
    order = csgraph.breadth_first_order(graph, n, return_predecessors=False)
    seen = np.zeros(n + 1, bool)
    seen[order] = True
    return seen[:n]


def classes(chain: sp.csr_array) -> tuple[np.ndarray, np.ndarray]:
    """(label [S], closed [n_classes] bool): strongly connected classes, and which of them cannot be left."""
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


class RegenerativeLU:
    """Sparse LU of I - discount * ``chain``, cut at ``ref``; ``chain`` is a row-stochastic CSR [S, S].

    With discount 1, raises SingularChainError if ``ref`` is not reached from everywhere.
    """

    def __init__(self, chain: sp.csr_array, ref: int, discount: float = 1.0) -> None:
        n = chain.shape[0]
        self.ref, self.discount = ref, discount
        self.chain = chain if discount == 1.0 else chain * discount
        first, last = chain.indptr[ref], chain.indptr[ref + 1]
        self._row = np.zeros(n)  # of ref, without ref itself
        np.add.at(self._row, chain.indices[first:last], self.chain.data[first:last])
        self._row[ref] = 0.0
        data = -self.chain.data
        data[chain.indices == ref] = 0.0
        data[first:last] = 0.0
        cut = sp.csc_array(sp.csr_array((data, chain.indices, chain.indptr), shape=(n, n)) + sp.eye_array(n))
        cut.eliminate_zeros()
        try:
            # No pivoting: an M-matrix needs none, and the fill stays what the ordering makes it.
            self._lu = spla.splu(
                cut, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
            )
        except RuntimeError as error:  # exactly singular
            raise SingularChainError(str(error)) from error
        ones = np.ones(n)
        ones[ref] = 0.0
        self.hitting_time = self._lu.solve(ones)  # expected (discounted) steps to ref
        if not (np.isfinite(self.hitting_time).all() and self.hitting_time.min() >= 0):
            raise SingularChainError(f"state {ref} is not reached from every state")

    @classmethod
    def adapted(cls, chain: sp.csr_array, ref: int) -> RegenerativeLU:
        """Cut at ``ref``, or at the likeliest state where ``ref`` is so rare that digits would be lost."""
        try:
            lu = cls(chain, ref)
            share = lu.stationary()
            likely = int(np.argmax(share))
            if share[likely] < 100 * share[ref] or lu.hitting_time.max() < 1e5:
                return lu
        except SingularChainError:
            likely = likely_state(chain)
            if likely == ref:
                raise
        return cls(chain, likely)

    def poisson(self, c: np.ndarray, refine: bool = True) -> tuple[float, np.ndarray]:
        """(gain, w) with w + gain = c + discount K w and w[ref] = 0.

        With x = c + discount K x, the discounted value, w = x - x[ref] and gain = (1 - discount) x[ref].
        """
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
        d = np.maximum(self._lu.solve(self._row, "T"), 0.0)
        d[self.ref] = 1.0
        return np.asarray(d / d.sum())
