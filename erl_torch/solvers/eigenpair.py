"""The dominant eigenpair of a nonnegative matrix, every component accurate, in logarithms.

M y = rho y with y = exp(h). F(h) = log(M exp(h)) is convex and monotone, its derivative K is row-stochastic, and the
Collatz-Wielandt numbers min(F(h) - h) <= log rho <= max(F(h) - h) bound the root for every h. A few power steps
h <- F(h), then Newton steps: (K - I) dh + (F(h) - h) = const, one sparse LU each, quadratic, also where power
iteration needs a million steps (nearly periodic, nearly reducible). Stop on the spread of the bounds; a small
residual norm would say nothing about small components.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
import torch

from erl_torch import checks, kernels
from erl_torch.chains import Elimination, RegenerativeLU, SingularChainError, classes, likely_state
from erl_torch.checks import InputError
from erl_torch.solution import Status

POWER_STEPS = 300  # cheap ones, on the matrix itself
LOG_POWER_STEPS = 40
LARGEST_ENTRY = 1e300  # of a matrix: the sum of a row stays in double precision
# (F(h), derivative K as a row-stochastic CSR) at h
Tilt = Callable[[np.ndarray], tuple[np.ndarray, sp.csr_array]]


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


def perron(matrix: Any, rtol: float = 1e-13, max_steps: int = 60) -> PerronPair:
    """Dominant eigenvalue and right eigenvector of a nonnegative irreducible matrix [n, n].

    Args:
        matrix: sparse (scipy, torch) or any array of real numbers, entries in [0, 1e300]; for the left eigenvector pass
            its transpose.
        rtol: spread of the Collatz-Wielandt bounds, relative to the root, to stop at; > 0.
        max_steps: Newton steps, >= 1.

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
        shown = ", ".join(f"{np.flatnonzero(label == c)[:4].tolist()}" for c in range(min(len(sizes), 5)))
        message = f"{len(sizes)} classes of states, the first begin with {shown}: solve each apart"
        nothing = torch.full((n,), torch.nan, dtype=torch.float64)
        return PerronPair(np.nan, nothing, (-np.inf, np.inf), Status.REDUCIBLE, 0, message)
    log_mean, kl, tilted = np.empty(n), np.empty(n), np.empty(m.nnz)

    def tilt(h: np.ndarray) -> tuple[np.ndarray, sp.csr_array]:
        kernels.tilt_rows(m.indptr, m.indices, m.data, h, log_mean, kl, tilted)
        return log_mean.copy(), sp.csr_array((tilted.copy(), m.indices, m.indptr), shape=m.shape)

    y = np.ones(n)
    kernels.lazy_power(m.indptr, m.indices, m.data, y, POWER_STEPS)
    start = np.log(y) if np.isfinite(y).all() and y.min() > 1e-280 else np.zeros(n)
    h, bounds, status, n_steps = solve_log_perron(tilt, start, rtol, max_steps, 0)
    h -= h.max()
    return PerronPair(0.5 * sum(bounds), torch.from_numpy(h), bounds, status, n_steps)


def solve_log_perron(
    tilt: Tilt,
    h: np.ndarray,
    rtol: float,
    max_steps: int,
    power_steps: int = LOG_POWER_STEPS,
    elimination: Elimination | None = None,
) -> tuple[np.ndarray, tuple[float, float], Status, int]:
    """(h, bounds on log rho, status, Newton steps) of M exp(h) = rho exp(h); ``elimination`` of its pattern."""

    def bounds_of(gain: np.ndarray) -> tuple[float, float]:
        slack = np.finfo(np.float64).eps * (terms + 8 * (1 + np.abs(h).max() + np.abs(gain).max()))
        return float(gain.min() - slack), float(gain.max() + slack)

    backed_up, chain = tilt(h)
    terms = int(np.diff(chain.indptr).max())  # of a row's sum
    gain = backed_up - h
    for _ in range(power_steps):
        if np.ptp(gain) < 0.1:  # Newton is quadratic from here
            break
        h = _half_step(h, backed_up)
        backed_up, chain = tilt(h)
        gain = backed_up - h
    ref = likely_state(chain)
    best, best_bounds = h, bounds_of(gain)
    refused, before = 0, np.inf
    lu: RegenerativeLU | None = None
    elimination = elimination or Elimination.of(chain.indptr, chain.indices)
    for step in range(max_steps + 1):
        spread = np.ptp(gain)
        rounding = 64 * np.finfo(np.float64).eps * (1 + np.abs(h).max() + np.abs(gain).max())
        if rounding < 0.1 and spread <= max(rtol, rounding if spread > 0.25 * before else 0.0):
            return h, bounds_of(gain), Status.CONVERGED, step
        if step == max_steps:
            break
        try:
            new, (new_backed_up, new_chain) = _step(tilt, h, gain, lu) if lu else (h, (backed_up, chain))
            new_gain = new_backed_up - new
            # The factors of an earlier step will do where they still gain two digits.
            if lu is None or not np.ptp(new_gain) < 1e-2 * spread:
                lu = RegenerativeLU.adapted(chain, ref, elimination)
                ref = lu.ref
                new, (new_backed_up, new_chain) = _step(tilt, h, gain, lu)
                new_gain = new_backed_up - new
            if not np.isfinite(new_gain).all():
                raise SingularChainError("not finite")
        except SingularChainError:
            refused, lu = refused + 1, None
            if refused > 5:
                return best, best_bounds, Status.STAGNATED, step
            for _ in range(200):
                h = _half_step(h, backed_up)
                backed_up, chain = tilt(h)
            gain = backed_up - h
            before = np.inf
            continue
        before = spread
        h, backed_up, chain, gain = new, new_backed_up, new_chain, new_gain
        if np.ptp(gain) < best_bounds[1] - best_bounds[0]:
            best, best_bounds = h, bounds_of(gain)
    return best, best_bounds, Status.STEP_LIMIT, max_steps


def _step(
    tilt: Tilt, h: np.ndarray, gain: np.ndarray, lu: RegenerativeLU
) -> tuple[np.ndarray, tuple[np.ndarray, sp.csr_array]]:
    new = h + lu.poisson(gain)[1]
    new -= new.max()
    return new, tilt(new)


def _half_step(h: np.ndarray, backed_up: np.ndarray) -> np.ndarray:
    """A power step averaged with standing still: no period can catch it."""
    new = np.logaddexp(h + (backed_up - h).mean(), backed_up)
    return np.asarray(new - new.max())
