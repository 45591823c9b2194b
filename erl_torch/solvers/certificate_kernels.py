"""One-step gains with what rounding can have done to them (docs/theory.md, 6).

Conventions as in ``erl_torch.mdp.kernels``.
"""

from __future__ import annotations

import math

import numba
import numpy as np


@numba.njit(cache=True, error_model="numpy", nogil=True)
def _drift(indices, data, first, last, value, s):
    """(sum_s' p (V(s') - V(s)), sum_s' p |V(s') - V(s)|) over one CSR row: s itself plays no part."""
    total, lost, size = 0.0, 0.0, 0.0
    for m in range(first, last):
        if indices[m] != s:
            x = data[m] * (value[indices[m]] - value[s])
            size += abs(x)
            new = total + x
            lost += (total - new) + x if abs(total) >= abs(x) else (x - new) + total
            total = new
    return total + lost, size


@numba.njit(cache=True, error_model="numpy", nogil=True)
def _soft_maximum(q, weight, beta, choice):
    """((1/beta) log sum_a weight exp(beta q) / sum_a weight, bound on its rounding); fills choice, the weights there.

    weight [A] >= 0, not all 0. Around the largest q where that keeps half of the weight, a sum of terms of one sign;
    around the largest weighted term otherwise: no digit cancels in either.
    """
    n = q.size
    epsilon = 2.0**-52
    top = -np.inf
    total = 0.0
    for a in range(n):
        total += weight[a]
        if weight[a] > 0.0:
            top = max(top, q[a])
    below = 0.0
    for a in range(n):
        choice[a] = 0.0
        if weight[a] > 0.0:
            below += weight[a] * math.expm1(beta * (q[a] - top))
    below /= total
    summed = 0.0
    if below >= -0.5:
        logarithm = math.log1p(below)
        for a in range(n):
            if weight[a] > 0.0:
                choice[a] = weight[a] * math.exp(beta * (q[a] - top))
                summed += choice[a]
    else:
        largest = -np.inf
        for a in range(n):
            if weight[a] > 0.0:
                choice[a] = beta * (q[a] - top) + math.log(weight[a])
                largest = max(largest, choice[a])
        for a in range(n):
            if weight[a] > 0.0:
                choice[a] = math.exp(choice[a] - largest)
                summed += choice[a]
        logarithm = largest + math.log(summed) - math.log(total)
    for a in range(n):
        choice[a] /= summed
    maximum = top + logarithm / beta
    size = -logarithm if below >= -0.5 else abs(logarithm) + math.log(n)
    # The last: products that underflow.
    rounding = (2 * n + 20) * epsilon * abs(size) / beta + 2.0 * epsilon * abs(maximum) + (n + 1) * 1e-323 / beta
    return maximum, rounding


@numba.njit(cache=True, error_model="numpy", nogil=True)
def _longest(indptr):
    n = 0
    for k in range(indptr.size - 1):
        n = max(n, indptr[k + 1] - indptr[k])
    return n


@numba.njit(cache=True, error_model="numpy", nogil=True)
def _entropic_drift(indices, data, first, last, value, s, kappa, moved, weight, tilted):
    """(C V - V(s), bound on its rounding) over one CSR row, C V = (1/kappa) log sum_s' p exp(kappa V(s')), kappa not 0.

    Where little moves, log1p of a sum over s' other than s, as in ``_drift``: a tiny kappa, or a state that is rarely
    left, costs no digit. ``_soft_maximum`` of +-(V(s') - V(s)) else. The last three [longest row]: overwritten.
    """
    epsilon = 2.0**-52
    n = last - first
    if n == 0:
        return 0.0, 0.0
    total, lost, size, spoilt = 0.0, 0.0, 0.0, 0.0
    for m in range(first, last):
        if indices[m] != s:
            t = kappa * (value[indices[m]] - value[s])
            x = data[m] * math.expm1(t)
            size += abs(x)
            spoilt += abs(x) * (2.0 + max(t, 0.0))  # the condition of expm1
            new = total + x
            lost += (total - new) + x if abs(total) >= abs(x) else (x - new) + total
            total = new
    if size <= 0.5:
        drift = math.log1p(total + lost) / kappa
        error = (5.0 * epsilon * spoilt + (n + 1) * 1e-322) * 1.1 / ((1.0 - size) * abs(kappa))
        return drift, error + 3.0 * epsilon * abs(drift)
    sign = 1.0 if kappa > 0.0 else -1.0
    far = 0.0
    for m in range(first, last):
        moved[m - first] = sign * (value[indices[m]] - value[s])
        weight[m - first] = data[m]
        far = max(far, abs(moved[m - first]))
    maximum, rounding = _soft_maximum(moved[:n], weight[:n], abs(kappa), tilted[:n])
    # Of the differences: as far as each is weighted, where that is known well.
    off = far
    if abs(kappa) * far * epsilon < 0.1:
        off = n * 1e-300 * far
        for j in range(n):
            off += 1.3 * tilted[j] * abs(moved[j])
    return sign * maximum, rounding + epsilon * off


@numba.njit(cache=True, error_model="numpy", nogil=True)
def certainty_rows(indptr, indices, data, n_actions, kappa, value, certain):
    """Fills certain [S*A] with C V, kappa not 0; 0 where a row is empty."""
    n = _longest(indptr)
    moved, weight, tilted = np.empty(n), np.empty(n), np.empty(n)
    for k in range(indptr.size - 1):
        first, last, s = indptr[k], indptr[k + 1], k // n_actions
        certain[k] = 0.0
        if last > first:
            drift, _ = _entropic_drift(indices, data, first, last, value, s, kappa, moved, weight, tilted)
            certain[k] = value[s] + drift


@numba.njit(cache=True, error_model="numpy", nogil=True)
def soft_rows(q, prior, beta, backed_up, policy):
    """backed_up(s) = (1/beta) log sum_a prior exp(beta q) and the policy that attains it; q, prior, policy [S, A]."""
    for s in range(q.shape[0]):
        backed_up[s], _ = _soft_maximum(q[s], prior[s], beta, policy[s])


@numba.njit(cache=True, error_model="numpy", nogil=True)
def gain_rows(indptr, indices, data, reward, prior, beta, kappa, value, gain, low, high, policy):
    """gain = TV - V [S] with low <= gain <= high in exact arithmetic, and pi_V [S, A]; E V at kappa 0, else C V.

    The rows of the transition matrix (CSR) and of the prior count as divided by their sums, which are 1 within 1e-15.
    A gain that is no finite number has infinite bounds.
    """
    n_states, n_actions = reward.shape
    epsilon = 2.0**-52
    q, error, scratch = np.empty(n_actions), np.empty(n_actions), np.empty(n_actions)
    n = _longest(indptr) if kappa != 0.0 else 0
    moved, weight, tilted = np.empty(n), np.empty(n), np.empty(n)
    for s in range(n_states):
        top = -np.inf
        for a in range(n_actions):
            k = s * n_actions + a
            first, last = indptr[k], indptr[k + 1]
            if kappa == 0.0:
                drift, size = _drift(indices, data, first, last, value, s)
                off = 10.0 * epsilon * size
            else:
                drift, off = _entropic_drift(indices, data, first, last, value, s, kappa, moved, weight, tilted)
            q[a] = reward[s, a] + drift
            error[a] = off + epsilon * abs(q[a]) + 1e-320 * (1 + last - first)
            if prior[s, a] > 0.0:
                top = max(top, q[a])
        for a in range(n_actions):
            error[a] += 2.0 * epsilon * abs(q[a] - top)
        gain[s], _ = _soft_maximum(q, prior[s], beta, policy[s])
        below, rounding = _soft_maximum(q - error, prior[s], beta, scratch)
        low[s] = below - rounding
        above, rounding = _soft_maximum(q + error, prior[s], beta, scratch)
        high[s] = above + rounding
        if not (np.isfinite(low[s]) and np.isfinite(high[s])):
            low[s], high[s] = -np.inf, np.inf


@numba.njit(cache=True, error_model="numpy", nogil=True)
def _relative_entropy(policy, prior):
    """(low, high) of sum_a pi log(pi / pi0) in nats, both rows divided by their sums; infinite off the support.

    A sum of terms pi0 h(pi/pi0 - 1) >= 0, h(x) = (1 + x) log(1 + x) - x: nothing cancels where pi is close to pi0.
    """
    epsilon = 2.0**-52
    n = policy.size
    total, of_prior, kl, size = 0.0, 0.0, 0.0, 0.0
    same = True
    for a in range(n):
        total += policy[a]
        of_prior += prior[a]
        if policy[a] > 0.0 and not prior[a] > 0.0:
            return np.inf, np.inf
        if policy[a] == prior[a]:
            continue
        same = False
        x = (policy[a] - prior[a]) / prior[a]
        if abs(x) < 0.1:
            h, power = 0.0, x
            for j in range(2, 20):
                power *= -x
                h -= power / (j * (j - 1))
            kl += prior[a] * h
            size += policy[a] * abs(x)
        elif policy[a] > 0.0:
            ratio = policy[a] / prior[a]
            logarithm = math.log(policy[a]) - math.log(prior[a])
            spoilt = abs(math.log(policy[a])) + abs(math.log(prior[a]))
            if 1e-300 < ratio < 1e300:
                logarithm = math.log(ratio)
                spoilt = abs(logarithm) + 1.0
            kl += policy[a] * logarithm - (policy[a] - prior[a])
            size += policy[a] * spoilt + abs(policy[a] - prior[a])
        else:
            kl += prior[a]
    if same:
        return 0.0, 0.0
    apart = (abs(total - of_prior) + (n + 2) * epsilon) / total
    kl = max(kl / total, 0.0)
    rounding = (n + 40) * epsilon * kl + 8.0 * epsilon * size + n * 1e-322  # the last: products that underflow
    return max(kl - rounding - apart * apart, 0.0), kl + rounding


@numba.njit(cache=True, error_model="numpy", nogil=True)
def divergence_rows(indptr, tilted, data, high):
    """high [rows] >= KL(tilted || data) of each CSR row in exact arithmetic, nats, rows divided by their sums."""
    for k in range(indptr.size - 1):
        high[k] = 0.0
        if indptr[k + 1] > indptr[k]:
            high[k] = _relative_entropy(tilted[indptr[k] : indptr[k + 1]], data[indptr[k] : indptr[k + 1]])[1]


@numba.njit(cache=True, error_model="numpy", nogil=True)
def policy_gain_rows(indptr, indices, data, reward, prior, beta, kappa, policy, value, low, high):
    """low <= T_pi V - V <= high [S] in exact arithmetic, T_pi V = sum_a pi (r + E V - log(pi/pi0)/beta); C V for E V
    where kappa is not 0.

    Rows count as divided by their sums, as in ``gain_rows``.
    """
    n_states, n_actions = reward.shape
    epsilon = 2.0**-52
    n = _longest(indptr) if kappa != 0.0 else 0
    moved_by, weight, tilted = np.empty(n), np.empty(n), np.empty(n)
    for s in range(n_states):
        total, mean, lost, error, size = 0.0, 0.0, 0.0, 0.0, 0.0
        for a in range(n_actions):
            if policy[s, a] > 0.0:
                k = s * n_actions + a
                first, last = indptr[k], indptr[k + 1]
                if kappa == 0.0:
                    drift, moved = _drift(indices, data, first, last, value, s)
                    off = 10.0 * epsilon * moved
                else:
                    drift, off = _entropic_drift(indices, data, first, last, value, s, kappa, moved_by, weight, tilted)
                q = reward[s, a] + drift
                total += policy[s, a]
                x = policy[s, a] * q
                size += abs(x)
                new = mean + x
                lost += (mean - new) + x if abs(mean) >= abs(x) else (x - new) + mean
                mean = new
                error += policy[s, a] * (off + 1e-320 * (1 + last - first)) + 1e-320
        least, most = _relative_entropy(policy[s], prior[s])
        mean = (mean + lost) / total
        error = 2.0 * error + (n_actions + 12) * epsilon * size
        low[s] = mean - most / beta
        high[s] = mean - least / beta
        if least == np.inf:
            low[s], high[s] = -np.inf, -np.inf
            continue
        low[s] -= error + 2.0 * epsilon * (abs(mean) + most / beta)
        high[s] += error + 2.0 * epsilon * (abs(mean) + least / beta)
        if not (np.isfinite(low[s]) and np.isfinite(high[s])):
            low[s], high[s] = -np.inf, np.inf
