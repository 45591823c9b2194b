"""How the solution moves with the problem: ``Linearised``, the derivatives at a solution, forwards and backwards.

At V + g = TV, with K = sum_a pi* q*, q*(s'|s,a) = p exp(kappa (V(s') - C V(s,a))) and c(s) what TV(s) changes by while
V stays,

    (I - K) dV + dg = c        d log pi* = d log prior + beta (dr + dC V - dV(s) - dg) + dbeta (r + C V - TV).

dg and dV are one linear equation with the matrix [[I - K, 1], [e', 0]], its last row a gauge of V; the derivative of a
function of the solution is one equation with its transpose (docs/theory.md, Inverse). Nothing is unrolled.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla

from erl_torch.solvers.certificates import soft_backup
from erl_torch.solvers.chains import RegenerativeLU, SingularChainError
from erl_torch.solvers.dial import price
from erl_torch.solvers.problem import BellmanProblem

NEAR = 1e-9  # of a Newton step, times beta: below, the next one would change nothing
LAST_STEPS = 4


class Bordered:
    """LU of [[I - K, 1], [e_ref', 0]] for a chain ``K``, CSR [n, n], with one closed class that ``ref`` is in."""

    def __init__(self, chain: sp.csr_array, ref: int) -> None:
        n = chain.shape[0]
        origin = np.repeat(np.arange(n), np.diff(chain.indptr))
        away = origin != chain.indices
        # The diagonal is the sum of the rest of its row, never a difference.
        diagonal = np.bincount(origin[away], chain.data[away], n)
        every = np.arange(n)
        rows = np.concatenate([origin[away], every, every, [n]])
        columns = np.concatenate([chain.indices[away], every, np.full(n, n), [ref]])
        data = np.concatenate([-chain.data[away], diagonal, np.ones(n), [1.0]])
        self._matrix = sp.csc_array((data, (rows, columns)), shape=(n + 1, n + 1))
        try:
            self._lu = spla.splu(self._matrix)
        except RuntimeError as error:  # exactly singular
            raise SingularChainError(str(error)) from error

    def solve(self, c: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(w, g) with (I - K) w + g = c and w(ref) = 0, for c [n] or columns [n, F]: w as c, g [] or [F]."""
        x = self._refined(np.concatenate([c, np.zeros((1, *c.shape[1:]))]), "N")
        return x[:-1], x[-1]

    def transposed(self, v: np.ndarray, total: float) -> np.ndarray:
        """lam [n] with (I - K)' lam = v and sum lam = ``total``, for v [n] that sums to 0."""
        return self._refined(np.append(v, total), "T")[:-1]

    def _refined(self, b: np.ndarray, way: str) -> np.ndarray:
        matrix = self._matrix if way == "N" else self._matrix.T
        x = self._lu.solve(b, way)
        return np.asarray(x + self._lu.solve(b - matrix @ x, way))


class Cotangents(NamedTuple):
    """Derivatives of a number by the parts of the problem, each with the others as they are."""

    pair: np.ndarray  # by r(s,a), [n, A]; times ``slope`` by p(s'|s,a)
    log_prior: np.ndarray  # by log prior(a|s), [n, A]; only differences within a row count
    beta: float  # optimism as it is


@dataclass(frozen=True, eq=False)
class Linearised:
    """A problem at its solution, of which it has the derivatives."""

    problem: BellmanProblem
    value: np.ndarray  # V, [n], mean 0
    rate: float  # g = -theta
    certain: np.ndarray  # C V, [n*A]
    policy: np.ndarray  # pi*, [n, A]
    log_ratio: np.ndarray  # log(pi*/prior), [n, A]; 0 where the prior is 0
    tilted: sp.csr_array  # q*, [n*A, n]
    chain: sp.csr_array  # K, [n, n]
    share: np.ndarray  # d*, stationary under K, [n]
    width: float  # max (TV - V) - min (TV - V) but for rounding

    @cached_property
    def lu(self) -> Bordered:
        """Raises SingularChainError."""
        return Bordered(self.chain, int(np.argmax(self.share)))

    def slope(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """xi(s'|s,a) less its mean over p: the change of C V of pair ``rows`` with p of state ``columns``."""
        kappa, off = self.problem.kappa, self.value[columns] - self.certain[rows]
        if kappa == 0:
            return np.asarray(off)
        with np.errstate(over="ignore"):
            return np.asarray(np.expm1(kappa * off) / kappa)

    def advantages(self, features: np.ndarray) -> np.ndarray:
        """A = phi + q* Phi - Phi(s) - mean of features phi [n, A, F], where (I - K) Phi + mean = sum_a pi* phi.

        [n, A, F]; d log pi* / dw = beta A, where r is the sum of w times the features.
        """
        n, n_actions, n_features = features.shape
        potential, mean = self.lu.solve((self.policy[:, :, None] * features).sum(1))
        ahead = np.asarray(self.tilted @ potential).reshape(n, n_actions, n_features)
        found = features + ahead - potential[:, None, :] - mean
        return np.where((self.problem.prior > 0)[:, :, None], found, 0.0)

    def backward(self, by_value: np.ndarray, by_rate: float, by_log_policy: np.ndarray) -> Cotangents:
        """The derivatives of a number whose derivatives by V [n] (they sum to 0), g and log pi* [n, A] are these.

        Where the prior is 0, ``by_log_policy`` is 0.
        """
        problem, beta = self.problem, self.problem.beta
        total = by_rate - beta * float(by_log_policy.sum())
        if by_value.any() or by_log_policy.any():
            per_state = by_value + beta * (self.tilted.T @ by_log_policy.ravel() - by_log_policy.sum(1))
            weight = self.lu.transposed(per_state, total)
        else:
            weight = total * self.share
        pair = np.where(problem.prior > 0, weight[:, None] * self.policy + beta * by_log_policy, 0.0)
        cost = (self.policy * self.log_ratio).sum(1) / beta**2
        by_beta = weight @ cost + float((by_log_policy * self.log_ratio).sum()) / beta
        if problem.optimism:
            by_beta += problem.optimism * float((pair * price(problem, self.value, self.tilted.data)).sum())
        return Cotangents(pair, pair / beta, float(by_beta))


def linearise(problem: BellmanProblem, value: np.ndarray, steps: int = LAST_STEPS) -> Linearised:
    """Derivatives at the solution next to ``value`` [n], to which at most ``steps`` Newton steps lead first.

    Raises:
        SingularChainError: the solution's chain has no single closed class, as far as double precision can tell.
    """
    ref = problem.regeneration_state()
    if ref is None:
        raise SingularChainError("several closed classes")
    value = value - value.mean()
    for _ in range(steps):
        certain, tilted = problem.certainty_equivalent(value), problem.tilted(value)
        backed_up, policy = _backup(problem, certain)
        chain = problem.chain(policy, tilted)
        lu = RegenerativeLU.adapted(chain, ref, problem.elimination)
        _, change = lu.poisson(backed_up - value)
        value = value + change - change.mean()
        if problem.beta * np.ptp(change) < NEAR:
            break
    share = lu.stationary()
    certain, tilted = problem.certainty_equivalent(value), problem.tilted(value)
    backed_up, policy = _backup(problem, certain)
    q = problem.reward + certain.reshape(policy.shape)
    p = problem.transition
    return Linearised(
        problem=problem,
        value=value,
        rate=float(share @ (backed_up - value)),
        certain=certain,
        policy=policy,
        log_ratio=np.where(problem.prior > 0, problem.beta * (q - backed_up[:, None]), 0.0),
        tilted=p if tilted is None else sp.csr_array((tilted, p.indices, p.indptr), shape=p.shape),
        chain=chain,
        share=share,
        width=float(np.ptp(backed_up - value)),
    )


def _backup(problem: BellmanProblem, certain: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return soft_backup(problem.reward + certain.reshape(problem.reward.shape), problem.prior, problem.beta)
