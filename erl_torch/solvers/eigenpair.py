"""The dominant eigenpair of a nonnegative matrix, in logarithms: every component is accurate.

M y = rho y with y = exp(h). F(h) = log(M exp(h)) is convex and monotone, its derivative K is row-stochastic, and the
Collatz-Wielandt numbers min(F(h) - h) <= log rho <= max(F(h) - h) bound the root for every h. The solver makes a few
power steps h <- F(h), then Newton steps (K - I) dh + (F(h) - h) = const, one sparse LU each. They converge
quadratically, also where power iteration needs a million steps (nearly periodic, nearly reducible). It stops on the
spread of the bounds: a small residual norm would say nothing about small components.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
import torch

from erl_torch import checks
from erl_torch.checks import InputError
from erl_torch.solution import Status
from erl_torch.solvers import kernels
from erl_torch.solvers.chains import EPSILON, Elimination, RegenerativeLU, SingularChainError, classes, likely_state

POWER_STEPS = 300  # on the matrix itself, where they are cheap
LOG_POWER_STEPS = 40
REFUSALS = 5  # chains that have no LU; more power steps follow each
STEPS_AFTER_A_REFUSAL = 200
NEWTON_SPREAD = 0.1  # of the gains F(h) - h, from which on Newton converges quadratically
LARGEST_ENTRY = 1e300  # of a matrix: the sum of a row stays in double precision


@dataclass(frozen=True, eq=False)
class PerronPair:
    """rho = exp(log_root), vector = exp(log_vector), largest component 1 (0 in the logarithm)."""

    log_root: float
    log_vector: torch.Tensor  # [n]
    bounds: tuple[float, float]  # Collatz-Wielandt, on log_root
    status: Status
    n_steps: int  # Newton steps
    message: str = ""

    @property
    def root(self) -> float:
        return float(np.exp(self.log_root))

    @property
    def vector(self) -> torch.Tensor:
        return self.log_vector.exp()


def perron(matrix: object, rtol: float = 1e-13, max_steps: int = 60) -> PerronPair:
    """Dominant eigenvalue and right eigenvector of a nonnegative irreducible matrix [n, n].

    Args:
        matrix: sparse (scipy, torch) or any array of real numbers, entries in [0, 1e300]. Pass the transpose for the
            left eigenvector.
        rtol: spread of the Collatz-Wielandt bounds, relative to the root, at which to stop; > 0.
        max_steps: Newton steps at most, >= 1.

    Returns:
        The pair; status REDUCIBLE (message names the classes) if no positive eigenvector exists.

    Raises:
        InputError: not square, an entry (or a sum of repeated ones) out of range, or rtol or max_steps out of range.
    """
    rtol, max_steps = checks.positive("rtol", rtol), checks.at_least("max_steps", max_steps, 1)
    m = checks.sparse("matrix", matrix, ("n", "n"), ", square")
    n = m.shape[0]
    bad = np.flatnonzero(~((m.data >= 0) & (m.data <= LARGEST_ENTRY)))
    if bad.size:
        row = int(np.searchsorted(m.indptr, bad[0], side="right")) - 1
        raise InputError(
            f"matrix[{row}, {m.indices[bad[0]]}]", m.data[bad[0]], f"finite and >= 0, at most {LARGEST_ENTRY:g}"
        )
    label, closed = classes(m)
    if len(closed) > 1 or m.nnz == 0:
        sizes = np.bincount(label)
        first_states = ", ".join(f"{np.flatnonzero(label == c)[:4].tolist()}" for c in range(min(len(sizes), 5)))
        message = f"{len(sizes)} classes of states, the first begin with {first_states}: solve each apart"
        nothing = torch.full((n,), torch.nan, dtype=torch.float64)
        return PerronPair(np.nan, nothing, (-np.inf, np.inf), Status.REDUCIBLE, 0, message)
    y = np.ones(n)
    kernels.lazy_power(m.indptr, m.indices, m.data, y, POWER_STEPS)
    start = np.log(y) if np.isfinite(y).all() and y.min() > 1e-280 else np.zeros(n)
    ptr, ind, terms = m.indptr.astype(np.int64), m.indices.astype(np.int32), int(np.diff(m.indptr).max())
    h, bounds, status, n_steps = solve_log_perron(ptr, ind, np.log(m.data), start, rtol, max_steps, terms, 0)
    h -= h.max()
    return PerronPair(0.5 * sum(bounds), torch.from_numpy(h), bounds, status, n_steps)


def solve_log_perron(
    ptr: np.ndarray,
    ind: np.ndarray,
    log_m: np.ndarray,
    start: np.ndarray,
    rtol: float,
    max_steps: int,
    terms: int,
    power_steps: int = LOG_POWER_STEPS,
    elimination: Elimination | None = None,
) -> tuple[np.ndarray, tuple[float, float], Status, int]:
    """(h [n], bounds on log rho, status, Newton steps) of M exp(h) = rho exp(h), for M = exp(log_m) as CSR (ptr, ind).

    ``start`` [n]; ``terms``: those of the longest row, with those that were summed to make log_m; ``elimination``: that
    of the pattern, where the caller has it.
    """

    def power(h: np.ndarray, steps: int, spread: float) -> _Point:
        h, gain, chain = h.copy(), np.full(len(h), np.nan), np.full(len(ind), np.nan)
        kernels.lazy_log_steps(ptr, ind, log_m, h, gain, chain, steps, spread)
        return _Point(h, gain, sp.csr_array((chain, ind, ptr), shape=(len(h), len(h))))

    def newton(at: _Point, lu: RegenerativeLU) -> _Point:
        new = at.h + lu.poisson(at.gain)[1]
        return power(new - new.max(), 0, 0.0)

    at = power(start, power_steps, NEWTON_SPREAD)
    ref = likely_state(at.chain)
    best = at
    refused, before = 0, np.inf
    lu: RegenerativeLU | None = None
    elimination = elimination or Elimination.of(ptr, ind)
    for step in range(max_steps + 1):
        spread, rounding = at.spread, 64 * EPSILON * at.size
        if rounding < 0.1 and spread <= max(rtol, rounding if spread > 0.25 * before else 0.0):
            return at.h, at.bounds(terms), Status.CONVERGED, step
        if step == max_steps:
            break
        try:
            new = newton(at, lu) if lu else at
            # Keep the factors of an earlier step while they still gain two digits.
            if lu is None or not new.spread < 1e-2 * spread:
                lu = RegenerativeLU.adapted(at.chain, ref, elimination)
                ref = lu.ref
                new = newton(at, lu)
            if not np.isfinite(new.gain).all():
                raise SingularChainError("not finite")
        except SingularChainError:
            refused, lu = refused + 1, None
            if refused > REFUSALS:
                return best.h, best.bounds(terms), Status.STAGNATED, step
            at, before = power(at.h, STEPS_AFTER_A_REFUSAL, 0.0), np.inf
            continue
        before, at = spread, new
        if at.spread < best.spread:
            best = at
    return best.h, best.bounds(terms), Status.STEP_LIMIT, max_steps


@dataclass(frozen=True, eq=False)
class _Point:
    """An h with its gains F(h) - h and the derivative of F, a row-stochastic CSR."""

    h: np.ndarray  # [n]
    gain: np.ndarray  # [n]
    chain: sp.csr_array

    @property
    def spread(self) -> float:
        return float(np.ptp(self.gain))

    @property
    def size(self) -> float:
        return float(1 + np.abs(self.h).max() + np.abs(self.gain).max())

    def bounds(self, terms: int) -> tuple[float, float]:
        """On log rho; ``terms`` of the longest row."""
        if not np.isfinite(self.gain).all():
            return -np.inf, np.inf
        slack = EPSILON * (terms + 8 * self.size)
        return float(self.gain.min() - slack), float(self.gain.max() + slack)
