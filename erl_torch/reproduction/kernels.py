"""The power iteration that the paper's Table S1 counts.

Conventions as in ``erl_torch.mdp.kernels``.
"""

from __future__ import annotations

import math

import numba
import numpy as np


@numba.njit(cache=True, error_model="numpy")
def _moving(new, old, first, bound):
    """A component whose ratio new/old is not within 1/bound..bound, looked for from ``first`` on; -1 if all are."""
    for i in range(new.size):
        k = (first + i) % new.size
        ratio = new[k] / old[k]
        if not (ratio <= bound and ratio * bound >= 1.0):
            return k
    return -1


@numba.njit(cache=True, error_model="numpy")
def capped_power(indptr, indices, data, log_weight, beta, tolerance, max_steps):
    """Plain power iteration of the tilted matrix, uniform prior, from ones, as the authors' scripts stop it.

    u(s,a) = exp(log_weight(s,a)) sum_s' p(s'|s,a) chi(s') with chi the mean of u over actions, log_weight [n*A], and
    the same for the other eigenvector v, both normalised; it ends once no logarithm of a component of either moves by
    more than ``tolerance`` * beta, or after ``max_steps``. Returns (chi [n], steps, whether both had converged).
    """
    n_pairs = log_weight.size
    n = int(np.max(indices)) + 1
    n_actions = n_pairs // n
    weight = np.exp(log_weight)
    chi, u, v = np.ones(n), np.ones(n_pairs), np.ones(n)
    new_u, new_v = np.empty(n_pairs), np.empty(n)
    bound = math.exp(tolerance * beta)
    moving_u = moving_v = v_steps = 0
    for steps in range(1, max_steps + 1):
        norm = 0.0
        for k in range(n_pairs):
            total = 0.0
            for m in range(indptr[k], indptr[k + 1]):
                total += data[m] * chi[indices[m]]
            new_u[k] = weight[k] * total
            norm += new_u[k] * new_u[k]
        scale = 1.0 / math.sqrt(norm)
        for s in range(n):
            total = 0.0
            for k in range(s * n_actions, (s + 1) * n_actions):
                new_u[k] *= scale
                total += new_u[k]
            chi[s] = total / n_actions
        u, new_u = new_u, u
        if moving_u >= 0:
            moving_u = _moving(u, new_u, moving_u, bound)
            if moving_u >= 0:
                continue
        # v is needed only once u has come to rest.
        while v_steps < steps:
            v_steps += 1
            new_v[:] = 0.0
            for k in range(n_pairs):
                share = weight[k] * v[k // n_actions] / n_actions
                for m in range(indptr[k], indptr[k + 1]):
                    new_v[indices[m]] += share * data[m]
            new_v /= math.sqrt(np.sum(new_v * new_v))
            v, new_v = new_v, v
        moving_v = _moving(v, new_v, max(moving_v, 0), bound)
        if moving_v < 0 and _moving(u, new_u, 0, bound) < 0:
            return chi, steps, True
    return chi, max_steps, False
