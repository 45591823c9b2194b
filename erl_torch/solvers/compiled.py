"""The eigenvector of M_V by a compiled Newton iteration, for chains whose LU factors stay sparse.

The states' pattern never changes between biasing iterations and Newton steps: it is ordered and its fill found once,
and every step is then one loop over known places. The method is that of ``eigenpair.solve_log_perron``, which takes
over where the fill is large (a supernodal LU is faster there) or a chain falls apart within rounding.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla

from erl_torch import kernels
from erl_torch.solvers.eigenpair import LOG_POWER_STEPS, POWER_STEPS

MAX_STATES = 4000
MAX_OPERATIONS = 15_000_000  # multiplications of one LU: some ten milliseconds


@dataclass(frozen=True, eq=False)
class NewtonPattern:
    """Which state can follow which, and the fill of the LU factors of such chains."""

    transition: sp.csr_array  # [n*A, n]
    log_p: np.ndarray  # of its entries
    slot: np.ndarray  # place of each of its entries in ``ind``
    ptr: np.ndarray  # [n + 1]
    ind: np.ndarray  # successors of each state
    rank: np.ndarray  # [n], place in the elimination
    lu: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]  # as ``kernels.lu_pattern`` has it

    @classmethod
    def of(cls, transition: sp.csr_array, n_actions: int) -> NewtonPattern | None:
        """The pattern of a transition matrix [n*A, n], or None where it is too large or fills too much."""
        n = transition.shape[1]
        if n > MAX_STATES:
            return None
        ptr, ind, slot = kernels.state_pattern(transition.indptr, transition.indices, n_actions)
        # Any values will do: SuperLU is asked for its minimum-degree ordering alone.
        some = 2 * sp.eye_array(n) - sp.csr_array((np.full(ind.size, 1.0 / n), ind, ptr), shape=(n, n))
        ordered = spla.splu(
            some.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        )
        rank = ordered.perm_c.astype(np.int32)
        lu = kernels.lu_pattern(ptr, ind, rank)
        if (np.diff(lu[2]) ** 2).sum() > MAX_OPERATIONS:
            return None
        return cls(transition, np.log(transition.data), slot, ptr, ind, rank, lu)

    def eigenvector(
        self, log_weight: np.ndarray, ref: int, rtol: float, max_steps: int
    ) -> tuple[np.ndarray, tuple[float, float], int] | None:
        """(h, bounds on log rho, Newton steps) for M(s, s') = sum_a exp(log_weight(s, a)) p(s'|s, a).

        log_weight [n, A]; ``ref`` is a state to cut chains at. None where the iteration fails.
        """
        p = self.transition
        log_m = np.empty(self.ind.size)
        kernels.merge_log_weights(p.indptr, self.log_p, log_weight, self.slot, self.ptr, log_m)
        h = np.zeros(p.shape[1])
        converged, low, high, steps = kernels.newton_perron(
            self.ptr, self.ind, self.rank, *self.lu, log_m, h, ref, rtol, max_steps, POWER_STEPS, LOG_POWER_STEPS
        )
        if not converged:
            return None
        slack = 8 * np.finfo(np.float64).eps * (1 + np.abs(h).max() + max(abs(low), abs(high)))
        return h, (low - slack, high + slack), steps
