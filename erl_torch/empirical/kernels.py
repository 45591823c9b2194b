"""Count tuples into rows, and move rows as far as the counts allow.

Conventions as in ``erl_torch.mdp.kernels``.
"""

from __future__ import annotations

import math

import numba
import numpy as np


@numba.njit(cache=True, error_model="numpy", nogil=True)
def _slot(table, key, shift):
    """Row of the table that holds ``key``, or the free one (entry -1) that is to hold it."""
    last = len(table) - 1
    slot = np.int64((np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(shift))
    while table[slot, 1] >= 0 and table[slot, 0] != key:
        slot = (slot + 1) & last
    return slot


@numba.njit(cache=True, error_model="numpy", nogil=True)
def enter(table, keys, used, shift):
    """Fill a free table with the first ``used`` entries."""
    for e in range(used):
        slot = _slot(table, keys[e], shift)
        table[slot, 0] = keys[e]
        table[slot, 1] = e


@numba.njit(cache=True, error_model="numpy", nogil=True)
def tally(pair, s_next, r, n_states, lr_psi, shift, table, keys, entries, pairs, used, begin):
    """Tuples from ``begin`` on, counted into rows, so that a tuple touches few cache lines:

        pairs [n_pairs, 4]   visits, last reward, factor of the weights below, newest entry of the pair
        entries [n, 4]       of a (pair, s') met: tuples, sum of rewards, weight, next older entry of the pair

    With ``lr_psi`` > 0, factor * weight is W of one psi epoch: the i-th visit of a pair from its end enters with
    lr_psi * (1 - lr_psi)**i. ``table`` [2**(64 - shift), 2] holds key = pair * n_states + s' and entry; ``keys`` [n]
    the keys by entry. All change in place.

    Returns (t, used, varied, smallest r, largest r): t < N where the entries, all ``used``, do not suffice; varied
    where a reward is not the one of the pair's visit before.
    """
    varied = False
    smallest = np.inf
    largest = -np.inf
    for t in range(begin, pair.size):
        k = np.int64(pair[t])
        key = k * n_states + s_next[t]
        slot = _slot(table, key, shift)
        e = table[slot, 1]
        if e < 0:
            if used == keys.size:
                return t, used, varied, smallest, largest
            e = used
            used += 1
            table[slot, 0] = key
            table[slot, 1] = e
            keys[e] = key
            entries[e, 3] = pairs[k, 3]
            pairs[k, 3] = e
        entries[e, 0] += 1.0
        entries[e, 1] += r[t]
        if pairs[k, 0] > 0.0 and pairs[k, 1] != r[t]:
            varied = True
        pairs[k, 0] += 1.0
        pairs[k, 1] = r[t]
        smallest = min(smallest, r[t])
        largest = max(largest, r[t])
        if lr_psi > 0.0:
            # A visit multiplies the pair's whole row; the weights change only once the factor leaves the range where
            # nothing is lost.
            factor = pairs[k, 2] * (1.0 - lr_psi)
            if factor < 1e-200:
                m = np.int64(pairs[k, 3])
                while m >= 0:
                    entries[m, 2] *= factor
                    m = np.int64(entries[m, 3])
                factor = 1.0
            pairs[k, 2] = factor
            entries[e, 2] += lr_psi / factor
    return pair.size, used, varied, smallest, largest


@numba.njit(cache=True, error_model="numpy", nogil=True)
def likelihood_rows(indptr, data, x, slope, moved, cost):
    """Row by row, q that maximises slope * sum_j q_j x_j - sum_j p_j log(p_j/q_j), for slope [rows] of any sign.

    CSR rows p that sum to 1; x [entries]. An entry of probability 0 may be given mass: that of a successor not seen.
    Fills moved with q (as data) and cost [rows] with sum_j p_j log(p_j/q_j). Stationary where q_j = p_j/(eta - y_j),
    y = slope (x - mean): eta is the root of sum_j q_j = 1 above the largest y, or that y itself, where the successors
    that were seen leave mass over.
    """
    for row in range(indptr.size - 1):
        first, last = indptr[row], indptr[row + 1]
        mean = 0.0
        for m in range(first, last):
            mean += data[m] * x[m]
        top, place = 0.0, first
        for m in range(first, last):
            moved[m] = data[m]
            if slope[row] * (x[m] - mean) > top:
                top, place = slope[row] * (x[m] - mean), m
        cost[row] = 0.0
        if not top > 0:
            continue
        low, high = 0.0, 1.0  # of above = eta - top
        above = 1.0 - top if top < 1 else 1.0
        for _ in range(200):
            total, square = 0.0, 0.0
            for m in range(first, last):
                if data[m] > 0:
                    gap = above + (top - slope[row] * (x[m] - mean))
                    total += data[m] / gap
                    square += data[m] / gap**2
            if total < 1:
                high = above
            else:
                low = above
            new = above + total * (total - 1) / square  # Newton's step on 1/total, which is all but linear
            if not low < new < high:
                new = 0.5 * (low + high)
            if abs(new - above) <= 1e-14 * above or not low < new < high:
                break
            above = new
        left = 1.0
        for m in range(first, last):
            if data[m] > 0:
                gap = above + (top - slope[row] * (x[m] - mean))
                moved[m] = data[m] / gap
                left -= moved[m]
                cost[row] += data[m] * math.log(gap)
        if data[place] == 0:
            moved[place] = max(left, 0.0)
