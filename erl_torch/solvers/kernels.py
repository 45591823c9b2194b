"""Compiled loops of the exact solvers: elimination without subtraction, Newton's method on a fixed pattern, tilted
dynamics.

Conventions as in ``erl_torch.mdp.kernels``.
"""

from __future__ import annotations

import math

import numba
import numpy as np


@numba.njit(cache=True, error_model="numpy", nogil=True)
def finite_horizon_return(indptr, indices, data, reward, start, horizon):
    """Expected undiscounted sum of ``reward`` [S] over ``horizon`` steps of a chain (CSR [S, S])."""
    now = start.copy()
    after = np.empty_like(now)
    total = 0.0
    for _ in range(horizon):
        after[:] = 0.0
        for s in range(now.size):
            if now[s] != 0.0:
                total += now[s] * reward[s]
                for m in range(indptr[s], indptr[s + 1]):
                    after[indices[m]] += now[s] * data[m]
        now, after = after, now
    return total


@numba.njit(cache=True, error_model="numpy", nogil=True)
def chain_of(data, place, policy, indptr, chain):
    """Chain of a policy [n_pairs]: entry m of the transition matrix (CSR rows ``indptr``) goes to chain[place[m]]."""
    chain[:] = 0.0
    for k in range(indptr.size - 1):
        for m in range(indptr[k], indptr[k + 1]):
            chain[place[m]] += policy[k] * data[m]


@numba.njit(cache=True, error_model="numpy", nogil=True)
def _compensated(x, n):
    """Sum of the first n of x >= 0, within 2 units of the last place (Neumaier)."""
    total, lost = 0.0, 0.0
    for i in range(n):
        new = total + x[i]
        lost += (total - new) + x[i] if total >= x[i] else (x[i] - new) + total
        total = new
    return total + lost


@numba.njit(cache=True, error_model="numpy", nogil=True)
def gth(p):
    """(stationary distribution [S], whether its digits can be trusted) of one closed class, dense p [S, S] (destroyed).

    Grassmann, Taksar, Heyman (1985): no subtraction, the diagonal is not read, and every component comes out to nearly
    full relative accuracy, however rarely the chain moves between its parts (docs/theory.md, 6). Not to be trusted:
    a product has left the range of normal numbers.
    """
    n = p.shape[0]
    tiny = 1e-307
    sound = True
    # In units of each state's own largest rate: slow states cost no range.
    rate = np.ones(n)
    for i in range(n):
        top = 0.0
        for j in range(n):
            if j != i:
                top = max(top, p[i, j])
        if n > 1 and not top >= tiny:
            return np.full(n, np.nan), False
        rate[i] = top
        for j in range(n):
            if 0.0 < p[i, j] < tiny:
                sound = False
            p[i, j] /= top
    for k in range(n - 1, 0, -1):
        out = _compensated(p[k], k)
        if not out >= tiny:
            return np.full(n, np.nan), False
        for i in range(k):
            if p[i, k] > 0.0:
                weight = p[i, k] / out
                p[i, k] = weight
                sound = sound and weight >= tiny
                for j in range(k):
                    if p[k, j] > 0.0:
                        p[i, j] += weight * p[k, j]
                        sound = sound and (p[i, j] >= tiny or i == j)
    x = np.zeros(n)
    x[0] = 1.0
    for k in range(1, n):
        for i in range(k):
            x[k] += x[i] * p[i, k]
        x[: k + 1] /= np.max(x[: k + 1])
    least = np.min(rate)
    for k in range(n):
        sound = sound and x[k] >= tiny
        x[k] *= least / rate[k]
    return x / np.sum(x), sound and np.isfinite(np.sum(x))


@numba.njit(cache=True, error_model="numpy", nogil=True)
def tilt_rows(indptr, indices, data, h, log_mean, kl, tilted):
    """For each row: log_mean = log sum_j p_j exp(h_j), tilted_j = p_j exp(h_j - log_mean), and
    kl = sum_j tilted_j log(tilted_j / p_j).

    CSR rows of positive entries; h [n_columns] of any size. Fills log_mean, kl [rows] and tilted (as data). Empty rows,
    of pairs that there are not, get 0.
    """
    for row in range(indptr.size - 1):
        if indptr[row] == indptr[row + 1]:
            log_mean[row] = 0.0
            kl[row] = 0.0
            continue
        top = -np.inf
        for m in range(indptr[row], indptr[row + 1]):
            top = max(top, h[indices[m]])
        total = 0.0
        for m in range(indptr[row], indptr[row + 1]):
            tilted[m] = data[m] * math.exp(h[indices[m]] - top)
            total += tilted[m]
        log_total = math.log(total)
        average = 0.0
        for m in range(indptr[row], indptr[row + 1]):
            tilted[m] /= total
            average += tilted[m] * (h[indices[m]] - top)
        log_mean[row] = top + log_total
        kl[row] = max(average - log_total, 0.0)


@numba.njit(cache=True, error_model="numpy")
def lazy_power(indptr, indices, data, y, steps):
    """``steps`` steps y <- y/max(y) + M y/max(M y) of a CSR matrix; y [n] > 0 changes in place."""
    after = np.empty_like(y)
    for _ in range(steps):
        top = 0.0
        for row in range(y.size):
            total = 0.0
            for m in range(indptr[row], indptr[row + 1]):
                total += data[m] * y[indices[m]]
            after[row] = total
            top = max(top, total)
        scale = 1.0 / np.max(y)
        for row in range(y.size):
            y[row] = y[row] * scale + after[row] / top


@numba.njit(cache=True, error_model="numpy")
def state_pattern(indptr, indices, n_actions):
    """Which state can follow which: CSR (ptr [n + 1], ind), and of each transition entry its place in ``ind``."""
    n = (indptr.size - 1) // n_actions
    ptr = np.zeros(n + 1, np.int64)
    ind = np.empty(indices.size, np.int32)
    slot = np.empty(indices.size, np.int32)
    at = np.full(n, -1, np.int64)
    m = 0
    for s in range(n):
        first = m
        for e in range(indptr[s * n_actions], indptr[(s + 1) * n_actions]):
            j = indices[e]
            if at[j] < first:
                at[j] = m
                ind[m] = j
                m += 1
            slot[e] = at[j]
        ptr[s + 1] = m
    return ptr, ind[:m].copy(), slot


@numba.njit(cache=True, error_model="numpy")
def lu_pattern(ptr, ind, rank):
    """Pattern of the LU factors, without pivoting, of matrices with the pattern (ptr, ind) made symmetric.

    ``rank`` [n]: the place of each state in the elimination. Returns L by rows, (lptr, lind), ascending, and U by
    rows, which is L by columns, (uptr, uind). Row k of L: all that the elimination tree's paths from its entries meet.
    """
    n = rank.size
    aptr = np.zeros(n + 1, np.int64)
    for s in range(n):
        for m in range(ptr[s], ptr[s + 1]):
            aptr[max(rank[s], rank[ind[m]]) + 1] += 1
    aptr = np.cumsum(aptr)
    fill = aptr[:-1].copy()
    below = np.empty(ind.size, np.int32)
    for s in range(n):
        for m in range(ptr[s], ptr[s + 1]):
            k = max(rank[s], rank[ind[m]])
            below[fill[k]] = min(rank[s], rank[ind[m]])
            fill[k] += 1
    parent = np.full(n, -1, np.int64)
    mark = np.full(n, -1, np.int64)
    lptr = np.zeros(n + 1, np.int64)
    lind = np.empty(4 * ind.size + n, np.int32)
    m = 0
    for k in range(n):
        if m + k > lind.size:
            lind = np.concatenate((lind, np.empty(lind.size + n, np.int32)))
        first = m
        mark[k] = k
        for e in range(aptr[k], aptr[k + 1]):
            i = below[e]
            while mark[i] != k:
                if parent[i] == -1:
                    parent[i] = k
                lind[m] = i
                m += 1
                mark[i] = k
                i = parent[i]
        lind[first:m].sort()
        lptr[k + 1] = m
    lind = lind[:m].copy()
    uptr = np.zeros(n + 1, np.int64)
    for e in range(m):
        uptr[lind[e] + 1] += 1
    uptr = np.cumsum(uptr)
    fill = uptr[:-1].copy()
    uind = np.empty(m, np.int32)
    for k in range(n):
        for e in range(lptr[k], lptr[k + 1]):
            uind[fill[lind[e]]] = k
            fill[lind[e]] += 1
    return lptr, lind, uptr, uind


@numba.njit(cache=True, error_model="numpy")
def cut_lu(ptr, column, chain, order, ref, leak, lptr, lind, uptr, uind, low, up, diagonal, to_ref, row):
    """LU of I - K without the row and column of ``ref`` (a rank); fills low, up, diagonal. ``row`` [n] is zero.

    The rows of K sum to 1 - ``leak``: a pivot is the sum of the rest of its row and of what leaks, nothing is
    subtracted, and every entry of the factors is accurate however rarely ``ref`` is met (Grassmann, Taksar, Heyman).
    Stored with the sign of K.
    """
    for k in range(order.size):
        if k == ref:
            low[lptr[k] : lptr[k + 1]] = 0.0
            up[uptr[k] : uptr[k + 1]] = 0.0
            diagonal[k] = 1.0
            to_ref[k] = 0.0
            continue
        s = order[k]
        for m in range(ptr[s], ptr[s + 1]):
            row[column[m]] = chain[m]
        absorbed = row[ref] + leak
        row[ref] = 0.0
        for e in range(lptr[k], lptr[k + 1]):
            i = lind[e]
            factor = row[i] / diagonal[i]
            row[i] = 0.0
            low[e] = factor
            if factor != 0.0:
                absorbed += factor * to_ref[i]
                for x in range(uptr[i], uptr[i + 1]):
                    row[uind[x]] += factor * up[x]
        to_ref[k] = absorbed
        pivot = absorbed
        for x in range(uptr[k], uptr[k + 1]):
            up[x] = row[uind[x]]
            pivot += up[x]
            row[uind[x]] = 0.0
        row[k] = 0.0
        diagonal[k] = pivot


@numba.njit(cache=True, error_model="numpy")
def cut_solve(lptr, lind, uptr, uind, low, up, diagonal, x):
    """x [n] becomes the solution of (I - K) x = x, in ranks."""
    for k in range(x.size):
        total = x[k]
        for e in range(lptr[k], lptr[k + 1]):
            total += low[e] * x[lind[e]]
        x[k] = total
    for k in range(x.size - 1, -1, -1):
        total = x[k]
        for e in range(uptr[k], uptr[k + 1]):
            total += up[e] * x[uind[e]]
        x[k] = total / diagonal[k]


@numba.njit(cache=True, error_model="numpy")
def cut_share(ptr, column, chain, order, ref, lptr, lind, uptr, uind, low, up, diagonal, x):
    """Fills x [n], in ranks: visits to each state between two to ``ref``, from the factors cut there."""
    x[:] = 0.0
    for m in range(ptr[order[ref]], ptr[order[ref] + 1]):
        x[column[m]] = chain[m]
    x[ref] = 0.0
    for k in range(x.size):
        x[k] /= diagonal[k]
        for e in range(uptr[k], uptr[k + 1]):
            x[uind[e]] += up[e] * x[k]
    for k in range(x.size - 1, -1, -1):
        for e in range(lptr[k], lptr[k + 1]):
            x[lind[e]] += low[e] * x[k]
    x[ref] = 1.0


@numba.njit(cache=True, error_model="numpy")
def merge_log_weights(indptr, log_p, log_weight, slot, ptr, log_m):
    """log_m(s, s') = log sum_a exp(log_weight(s, a)) p(s'|s, a) on a ``state_pattern``; log_weight [n, A]."""
    n, n_actions = log_weight.shape
    top = np.full(log_m.size, -np.inf)
    log_m[:] = 0.0
    for s in range(n):
        for a in range(n_actions):
            k = s * n_actions + a
            for e in range(indptr[k], indptr[k + 1]):
                top[slot[e]] = max(top[slot[e]], log_weight[s, a] + log_p[e])
        for a in range(n_actions):
            k = s * n_actions + a
            for e in range(indptr[k], indptr[k + 1]):
                log_m[slot[e]] += math.exp(log_weight[s, a] + log_p[e] - top[slot[e]])
        for m in range(ptr[s], ptr[s + 1]):
            log_m[m] = top[m] + math.log(log_m[m])


@numba.njit(cache=True, error_model="numpy")
def log_gains(ptr, ind, log_m, h, gain, chain):
    """Fills gain = log(M exp(h)) - h [n] and chain, its row-stochastic derivative; returns min and max of the gains."""
    low, high = np.inf, -np.inf
    for s in range(h.size):
        top = -np.inf
        for m in range(ptr[s], ptr[s + 1]):
            chain[m] = log_m[m] + h[ind[m]]
            top = max(top, chain[m])
        total = 0.0
        for m in range(ptr[s], ptr[s + 1]):
            chain[m] = math.exp(chain[m] - top)
            total += chain[m]
        for m in range(ptr[s], ptr[s + 1]):
            chain[m] /= total
        gain[s] = top + math.log(total) - h[s]
        if not np.isfinite(gain[s]):  # min and max would pass over it
            return -np.inf, np.inf
        low, high = min(low, gain[s]), max(high, gain[s])
    return low, high


@numba.njit(cache=True, error_model="numpy")
def lazy_log_steps(ptr, ind, log_m, h, gain, chain, steps, spread):
    """Make power steps on exp(h) in logarithms, averaged with standing still (so no period can catch them), until the
    gains differ by less than ``spread``, ``steps`` at most. h changes in place; gain, chain and the returned pair are
    those of ``log_gains`` there."""
    low, high = log_gains(ptr, ind, log_m, h, gain, chain)
    for _ in range(steps):
        if high - low < spread or not np.isfinite(high - low):
            break
        mean = np.mean(gain)
        for s in range(h.size):
            h[s] += max(gain[s], mean) + math.log1p(math.exp(-abs(gain[s] - mean)))
        h -= np.max(h)
        low, high = log_gains(ptr, ind, log_m, h, gain, chain)
    return low, high


@numba.njit(cache=True, error_model="numpy")
def _lazy_steps(ptr, ind, log_m, h, power_steps):
    """Power steps on exp(h), averaged with standing still, without logarithms; false, and h as it was, if that leaves
    the range of doubles. They end where the gains log(M exp h) - h differ by less than 0.1."""
    m_data = np.exp(log_m)
    y = np.exp(h - np.max(h))
    after = np.empty_like(y)
    for _ in range(power_steps):
        least, most = np.inf, 0.0
        top = 0.0
        for s in range(y.size):
            total = 0.0
            for m in range(ptr[s], ptr[s + 1]):
                total += m_data[m] * y[ind[m]]
            after[s] = total
            top = max(top, total)
            least, most = min(least, total / y[s]), max(most, total / y[s])
        if not (least > 1e-250 and most < 1e250):
            return False
        if most < 1.1 * least:
            break
        scale = 1.0 / np.max(y)
        for s in range(y.size):
            y[s] = y[s] * scale + after[s] / top
        if not np.min(y) > 1e-250:
            return False
    h[:] = np.log(y)
    return True


@numba.njit(cache=True, error_model="numpy")
def newton_perron(
    ptr, ind, rank, lptr, lind, uptr, uind, log_m, h, ref, rtol, max_steps, power_steps, log_power_steps
):  # fmt: skip
    """M exp(h) = rho exp(h) for M = exp(log_m) on the pattern (ptr, ind); h [n] is the start, and becomes the answer.

    Power steps (in logarithms where doubles do not reach) until the gains log(M exp h) - h differ by less than 0.1, or
    there were that many; then Newton steps, with factors that are kept while a step with them leaves less than a
    quarter. ``ref``: where chains are cut.

    Returns (converged, min gain, max gain, Newton steps): bounds on log rho, before rounding.
    """
    n = h.size
    order = np.empty(n, np.int64)
    for s in range(n):
        order[rank[s]] = s
    column = rank[ind]
    gain, new, x = np.empty(n), np.empty(n), np.empty(n)
    chain, cut = np.empty(ind.size), np.empty(ind.size)
    low, up, diagonal, to_ref, row = np.empty(lind.size), np.empty(uind.size), np.empty(n), np.empty(n), np.zeros(n)
    hitting = np.empty(n)
    epsilon = 2.0**-52
    if _lazy_steps(ptr, ind, log_m, h, power_steps):
        log_power_steps = 0
    a, b = lazy_log_steps(ptr, ind, log_m, h, gain, chain, log_power_steps, 0.1)  # Newton is quadratic from there
    factored = False
    before = np.inf
    for step in range(max_steps + 1):
        spread = b - a
        rounding = 64 * epsilon * (1.0 + np.max(np.abs(h)) + max(abs(a), abs(b)))
        if not (np.isfinite(spread) and rounding < 0.1):  # a vector that spans more says nothing
            break
        if spread <= rtol or (spread <= rounding and spread > 0.25 * before):
            return True, a, b, step
        if step == max_steps:
            break
        before = spread
        for _ in range(2):
            fresh = not factored
            if fresh:
                cut[:] = chain
                for choice in range(2):
                    at = rank[ref]
                    cut_lu(ptr, column, cut, order, at, 0.0, lptr, lind, uptr, uind, low, up, diagonal, to_ref, row)
                    hitting[:] = 1.0
                    hitting[at] = 0.0
                    cut_solve(lptr, lind, uptr, uind, low, up, diagonal, hitting)
                    if choice == 1 or np.max(hitting) < 1e5:
                        break
                    # A state that is met so rarely costs digits.
                    cut_share(ptr, column, cut, order, at, lptr, lind, uptr, uind, low, up, diagonal, x)
                    if not np.max(x) > 100.0:
                        break
                    ref = order[np.argmax(x)]
                factored = True
            # Poisson's equation; its right side is small once the common part of the gains is gone.
            middle = 0.5 * (a + b)
            for k in range(n):
                x[k] = gain[order[k]] - middle
            common = x[rank[ref]]
            x[rank[ref]] = 0.0
            cut_solve(lptr, lind, uptr, uind, low, up, diagonal, x)
            length = 1.0
            for m in range(ptr[ref], ptr[ref + 1]):
                if ind[m] != ref:
                    common += cut[m] * x[column[m]]
                    length += cut[m] * hitting[column[m]]
            common /= length
            for s in range(n):
                new[s] = h[s] + x[rank[s]] - common * hitting[rank[s]]
            new -= np.max(new)
            new_a, new_b = log_gains(ptr, ind, log_m, new, x, chain)
            if fresh or new_b - new_a < 0.25 * spread:
                break
            # The old factors no longer do.
            log_gains(ptr, ind, log_m, h, gain, chain)
            factored = False
        a, b = new_a, new_b
        h[:] = new
        gain[:] = x
    return False, a, b, max_steps
