"""Learners of action values: Q-learning and its kin.

Kernels take plain C-contiguous arrays and scalars, use no globals, and validate nothing: the callers do.
``error_model="numpy"``: a division by zero gives inf or nan for the caller to find, and no check costs time.
Those that call each other stand in one file: Numba's cache does not notice a changed kernel in another file.
Pair index: ``k = s * n_actions + a``. Transition matrices come as CSR arrays (indptr, indices, data).
"""

from __future__ import annotations

import math

import numba
import numpy as np


@numba.njit(cache=True, error_model="numpy", nogil=True)
def backed_up(q, visits, prior, beta, first, last, backup):
    """V of the state whose pairs are first..last; pairs without visits are left out, and V = 0 where all are.

    ``backup`` 0: (1/beta) log sum_a prior exp(beta q); 1: max_a q; 2: sum_a pi q with pi ~ prior exp(beta q).
    The prior is that of the pairs with visits, normalised.
    """
    top = -np.inf
    for k in range(first, last):
        if visits[k] > 0 and q[k] > top:
            top = q[k]
    if top == -np.inf:
        return 0.0
    if backup == 1:
        return top
    mass = 0.0
    total = 0.0
    average = 0.0
    for k in range(first, last):
        if visits[k] > 0:
            weight = prior[k] * math.exp(beta * (q[k] - top))
            mass += prior[k]
            total += weight
            average += weight * (q[k] - top)
    if backup == 2:
        return top + average / total
    return top + math.log(total / mass) / beta


@numba.njit(cache=True, error_model="numpy", nogil=True)
def log_mix(x, step):
    """log(1 - step + step exp(x)) for any x and 0 < step <= 1."""
    if x > 0.0:
        return x + math.log1p((1.0 - step) * math.expm1(-x))
    if step == 1.0:
        return x
    return math.log1p(step * math.expm1(x))


@numba.njit(cache=True, error_model="numpy", nogil=True)
def action_value_epoch(
    pair,
    s_next,
    reward,
    prior,
    n_actions,
    beta,
    discount,
    backup,
    exponential,
    power,
    lr_rate,
    reference,
    q,
    visits,
    rate,
):
    """One pass: q(s,a) moves towards r - rate + discount V(s') by the step n(s,a)**-power.

    ``exponential``: what is averaged is exp(beta q). ``lr_rate``: step size of the rate relative to that of q;
    ``reference`` >= 0: the rate is V of that state. q and visits [n_pairs] change in place; returns the rate.
    """
    for t in range(pair.size):
        k = pair[t]
        first = s_next[t] * n_actions
        value = backed_up(q, visits, prior, beta, first, first + n_actions, backup)
        visits[k] += 1
        step = float(visits[k]) ** -power
        error = reward[t] - rate + discount * value - q[k]
        if exponential:
            change = log_mix(beta * error, step) / beta
            # As line 11 of Algorithm S1: the ratio of the target to the new u is at most 1 / step.
            rate += log_mix(beta * (error - change), lr_rate * step) / beta
        else:
            change = step * error
            rate += lr_rate * change
        q[k] += change
        if reference >= 0 and k // n_actions == reference:
            first = reference * n_actions
            rate = backed_up(q, visits, prior, beta, first, first + n_actions, backup)
    return rate
