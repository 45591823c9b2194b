"""The eigenvector of M_V by a compiled Newton iteration, for chains whose LU factors stay sparse.

The pattern of the states' transitions is the same in all biasing iterations and Newton steps. So its order and its
fill are computed once, and every step is one loop over their places. The method is that of
``eigenpair.solve_log_perron``, which takes over where the fill is large (a supernodal LU is faster there) or where a
chain falls apart within rounding.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from erl_torch.solvers import kernels
from erl_torch.solvers.chains import EPSILON, Elimination
from erl_torch.solvers.eigenpair import LOG_POWER_STEPS, POWER_STEPS
from erl_torch.solvers.problem import BellmanProblem


@dataclass(frozen=True, eq=False)
class NewtonPattern:
    """A problem's transitions, merged over actions, on the pattern of its chains."""

    indptr: np.ndarray  # of the transition matrix [n*A, n]
    slot: np.ndarray  # place of each of its entries in the chain's
    elimination: Elimination

    @classmethod
    def of(cls, problem: BellmanProblem) -> NewtonPattern | None:
        """The pattern of ``problem``; None where that is too large or its factors fill too much."""
        if not problem.elimination.fits:
            return None
        p = problem.transition
        return cls(p.indptr, problem.pattern[2], problem.elimination)

    def eigenvector(
        self, log_weight: np.ndarray, log_q: np.ndarray, ref: int, rtol: float, max_steps: int
    ) -> tuple[np.ndarray, tuple[float, float], int] | None:
        """(h, bounds on log rho, Newton steps) for M(s, s') = sum_a exp(log_weight(s, a)) q(s'|s, a).

        log_weight [n, A]; log_q: log q on the transitions, as CSR data; ``ref`` is a state to cut chains at. None where
        the iteration fails.
        """
        e = self.elimination
        log_m = np.empty(e.ind.size)
        kernels.merge_log_weights(self.indptr, log_q, log_weight, self.slot, e.ptr, log_m)
        h = np.zeros(len(e.rank))
        converged, low, high, steps = kernels.newton_perron(
            e.ptr, e.ind, e.rank, *e.lu, log_m, h, ref, rtol, max_steps, POWER_STEPS, LOG_POWER_STEPS
        )
        if not converged:
            return None
        terms = int(np.diff(e.ptr).max()) + log_weight.shape[1]  # of the sums over successors and actions
        slack = EPSILON * (terms + 8 * (1 + np.abs(h).max() + max(abs(low), abs(high))))
        return h, (low - slack, high + slack), steps
