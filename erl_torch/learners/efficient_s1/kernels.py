"""EfficientS1: lines 9-11 in the gauge z = psi * u, with a step for every visit and either backup.

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
def _is_healthy(z, q):
    if not (np.isfinite(q) and q > 0.0):
        return False
    for k in range(z.size):
        if not (np.isfinite(z[k]) and z[k] > 0.0):
            return False
    return True


@numba.njit(cache=True, error_model="numpy", nogil=True)
def gauge_epoch(
    pair, after, factor, noisy, g, z, total, average, weight, n_actions, steps, visits, rho, lr_rho, rho_max,
    expected, rescale_every, begin, end, first=0,
):  # fmt: skip
    """Lines 9-11 over tuples begin..end of a pass, of which ``first`` stands first in the columns; z, total and visits
    [n_pairs] change in place.

    ``after`` [N] is s' where ``expected`` (backup y(s') = sum_a weight z) or s' * A + a'. The step of a pair's n-th
    visit is ``steps[min(n, last)]``. With ``average``, total sums z over the visits. Every ``rescale_every`` tuples a
    power of two brings the largest z to about 1.

    Returns (rho, healthy): not healthy once a number is no longer positive and finite.
    """
    n_states = z.size // n_actions
    y = np.zeros(n_states)
    last = steps.size - 1
    t = begin
    while t < end:
        stop = min(end, t - t % rescale_every + rescale_every)
        for s in range(n_states):
            y[s] = 0.0
            for k in range(s * n_actions, (s + 1) * n_actions):
                y[s] += weight[k] * z[k]
        for i in range(t - first, stop - first):
            k = pair[i]
            gain = g[k]
            if noisy:
                gain *= factor[i]
            w = gain * (y[after[i]] if expected else z[after[i]])
            step = steps[min(visits[k], last)]
            visits[k] += 1
            z_new = (1.0 - step) * z[k] + step * w / rho
            z[k] = z_new
            if average:
                total[k] += z_new
            if not expected and k == after[i]:  # a self-loop sees the new z
                w = gain * z_new
            rho = (1.0 - lr_rho) * rho + lr_rho * w / z_new
            if rho > rho_max:
                rho = rho_max
            if expected:
                s = k // n_actions
                row = 0.0
                for m in range(s * n_actions, (s + 1) * n_actions):
                    row += weight[m] * z[m]
                y[s] = row
        t = stop
        if not _is_healthy(z, rho):
            return rho, False
        _, exponent = math.frexp(np.max(z))
        scale = math.ldexp(1.0, -exponent)
        for k in range(z.size):
            z[k] *= scale
            total[k] *= scale
    return rho, True


@numba.njit(cache=True, error_model="numpy", nogil=True)
def _log_blend(log_x, log_new, step):
    """log((1 - step) x + step new), for any size of the logarithms."""
    d = log_new - log_x
    if d <= 0.0:
        # At step 1 and d below rounding, log1p would be of -1.
        return log_new if step >= 1.0 else log_x + math.log1p(step * math.expm1(d))
    return log_new + math.log(step + (1.0 - step) * math.exp(-d))


@numba.njit(cache=True, error_model="numpy", nogil=True)
def _log_row(log_z, log_weight, first, n_actions):
    """log sum_a exp(log_weight + log_z) of one state."""
    top = -np.inf
    for k in range(first, first + n_actions):
        top = max(top, log_weight[k] + log_z[k])
    row = 0.0
    for k in range(first, first + n_actions):
        row += math.exp(log_weight[k] + log_z[k] - top)
    return top + math.log(row)


@numba.njit(cache=True, error_model="numpy", nogil=True)
def log_gauge_epoch(
    pair, after, log_factor, noisy, log_g, log_z, log_total, average, log_weight, n_actions, steps, visits, log_rho,
    lr_rho, log_rho_max, expected, rescale_every, begin, end, first=0,
):  # fmt: skip
    """``gauge_epoch`` in logarithms: finite for finite input of any size. Returns (log rho, true)."""
    n_states = log_z.size // n_actions
    y = np.zeros(n_states)
    last = steps.size - 1
    t = begin
    while t < end:
        stop = min(end, t - t % rescale_every + rescale_every)
        for s in range(n_states):
            y[s] = _log_row(log_z, log_weight, s * n_actions, n_actions)
        for i in range(t - first, stop - first):
            k = pair[i]
            gain = log_g[k]
            if noisy:
                gain += log_factor[i]
            w = gain + (y[after[i]] if expected else log_z[after[i]])
            step = steps[min(visits[k], last)]
            visits[k] += 1
            z_new = _log_blend(log_z[k], w - log_rho, step)
            log_z[k] = z_new
            if average:
                high, low = max(log_total[k], z_new), min(log_total[k], z_new)
                log_total[k] = high + math.log1p(math.exp(low - high))
            if not expected and k == after[i]:
                w = gain + z_new
            log_rho = min(_log_blend(log_rho, w - z_new, lr_rho), log_rho_max)
            if expected:
                s = k // n_actions
                y[s] = _log_row(log_z, log_weight, s * n_actions, n_actions)
        t = stop
        top = np.max(log_z)
        for k in range(log_z.size):
            log_z[k] -= top
            log_total[k] -= top
    return log_rho, True


@numba.njit(cache=True, error_model="numpy", nogil=True)
def tilted_gauge_epoch(
    pair, s_next, factor, noisy, g, tilt, share, largest_step, members, z, total, average, weight, n_actions, steps,
    visits, rho, lr_rho, rho_max, rescale_every, begin, end, first=0,
):  # fmt: skip
    """``gauge_epoch`` with y(s') tilted by e = tilt(s') share(s,a) (times ``factor`` where ``noisy``), whose mean over
    the visits of each pair is 1.

    What is backed up is c + e (y(s') - c), c the least y of the states ``members``: of the same mean over the visits as
    e y(s'), whatever c is, of positive numbers, and without noise where y is the same in all states. No step of a pair
    is above its ``largest_step``.
    """
    n_states = z.size // n_actions
    y = np.zeros(n_states)
    last = steps.size - 1
    t = begin
    while t < end:
        stop = min(end, t - t % rescale_every + rescale_every)
        for s in range(n_states):
            y[s] = 0.0
            for k in range(s * n_actions, (s + 1) * n_actions):
                y[s] += weight[k] * z[k]
        least = np.inf
        for s in members:
            least = min(least, y[s])
        for i in range(t - first, stop - first):
            k = pair[i]
            e = tilt[s_next[i]] * share[k]
            if noisy:
                e *= factor[i]
            w = g[k] * (least + e * (y[s_next[i]] - least))
            step = min(steps[min(visits[k], last)], largest_step[k])
            visits[k] += 1
            z_new = (1.0 - step) * z[k] + step * w / rho
            z[k] = z_new
            if average:
                total[k] += z_new
            rho = (1.0 - lr_rho) * rho + lr_rho * w / z_new
            if rho > rho_max:
                rho = rho_max
            s = k // n_actions
            row = 0.0
            for m in range(s * n_actions, (s + 1) * n_actions):
                row += weight[m] * z[m]
            y[s] = row
            least = min(least, row)
        t = stop
        if not _is_healthy(z, rho):
            return rho, False
        _, exponent = math.frexp(np.max(z))
        scale = math.ldexp(1.0, -exponent)
        for k in range(z.size):
            z[k] *= scale
            total[k] *= scale
    return rho, True


@numba.njit(cache=True, error_model="numpy", nogil=True)
def _log_backed_up(log_least, log_e, log_y):
    """log(c + e (y - c)) for logarithms of c <= y and e of any size."""
    above = log_y - log_least
    if not above > 0.0:
        return log_least
    x = log_e + above + math.log(-math.expm1(-above))
    return log_least + (x + math.log1p(math.exp(-x)) if x > 0.0 else math.log1p(math.exp(x)))


@numba.njit(cache=True, error_model="numpy", nogil=True)
def log_tilted_gauge_epoch(
    pair, s_next, log_factor, noisy, log_g, log_tilt, log_share, largest_step, members, log_z, log_total, average,
    log_weight, n_actions, steps, visits, log_rho, lr_rho, log_rho_max, rescale_every, begin, end, first=0,
):  # fmt: skip
    """``tilted_gauge_epoch`` in logarithms: finite for finite input of any size. Returns (log rho, true)."""
    n_states = log_z.size // n_actions
    y = np.zeros(n_states)
    last = steps.size - 1
    t = begin
    while t < end:
        stop = min(end, t - t % rescale_every + rescale_every)
        for s in range(n_states):
            y[s] = _log_row(log_z, log_weight, s * n_actions, n_actions)
        least = np.inf
        for s in members:
            least = min(least, y[s])
        for i in range(t - first, stop - first):
            k = pair[i]
            e = log_tilt[s_next[i]] + log_share[k]
            if noisy:
                e += log_factor[i]
            w = log_g[k] + _log_backed_up(least, e, y[s_next[i]])
            step = min(steps[min(visits[k], last)], largest_step[k])
            visits[k] += 1
            z_new = _log_blend(log_z[k], w - log_rho, step)
            log_z[k] = z_new
            if average:
                high, low = max(log_total[k], z_new), min(log_total[k], z_new)
                log_total[k] = high + math.log1p(math.exp(low - high))
            log_rho = min(_log_blend(log_rho, w - z_new, lr_rho), log_rho_max)
            s = k // n_actions
            y[s] = _log_row(log_z, log_weight, s * n_actions, n_actions)
            least = min(least, y[s])
        t = stop
        top = np.max(log_z)
        for k in range(log_z.size):
            log_z[k] -= top
            log_total[k] -= top
    return log_rho, True


@numba.njit(cache=True, error_model="numpy")
def online_phase(
    pair, s_next, r, beta, value, visits, fresh, reward, reward_squares, mean_value, log_z, log_prior, n_actions,
    steps, log_rho, lr_rho, log_rho_max,
):  # fmt: skip
    """Tuples of one phase of the online mode; V = ``value`` [S] is fixed, tables [n_pairs] change in place.

    ``mean_value`` and ``reward`` are means over all ``visits``, ``reward_squares`` the sum of squares about the
    latter; ``fresh`` counts the visits of this phase. Unvisited pairs of a visited state take no part.
    Returns (log rho, log_rho_max: at least beta times the largest r so far).
    """
    n_states = value.size
    log_weight = log_prior.copy()
    y = np.zeros(n_states)
    last = steps.size - 1
    for s in range(n_states):
        first = s * n_actions
        if np.sum(visits[first : first + n_actions]) > 0:
            for k in range(first, first + n_actions):
                if visits[k] == 0:
                    log_weight[k] = -np.inf
        y[s] = _log_row(log_z, log_weight, first, n_actions)
    for i in range(pair.size):
        k = pair[i]
        s = k // n_actions
        first = s * n_actions
        if visits[k] == 0:
            if np.sum(visits[first : first + n_actions]) == 0:
                log_weight[first : first + n_actions] = -np.inf
            log_weight[k] = log_prior[k]
            y[s] = _log_row(log_z, log_weight, first, n_actions)
        log_rho_max = max(log_rho_max, beta * r[i])
        step = steps[min(fresh[k], last)]
        fresh[k] += 1
        visits[k] += 1
        off = r[i] - reward[k]
        reward[k] += off / visits[k]
        reward_squares[k] += off * (r[i] - reward[k])
        mean_value[k] += (value[s_next[i]] - mean_value[k]) / visits[k]
        w = beta * (reward[k] + mean_value[k] - value[s]) + y[s_next[i]]
        log_z[k] = _log_blend(log_z[k], w - log_rho, step)
        log_rho = min(_log_blend(log_rho, w - log_z[k], lr_rho), log_rho_max)
        y[s] = _log_row(log_z, log_weight, first, n_actions)
    return log_rho, log_rho_max


@numba.njit(cache=True, error_model="numpy")
def tilted_online_phase(
    pair, s_next, r, beta, kappa, value, visits, fresh, reward, reward_squares, mean_value, log_z, log_prior,
    n_actions, steps, log_rho, lr_rho, log_rho_max, log_least, n_before, renew_every,
):  # fmt: skip
    """``online_phase`` with the certainty equivalent (1/kappa) log <exp(kappa V(s'))> in ``mean_value``, kappa not 0,
    and y(s') tilted as in ``tilted_gauge_epoch``.

    ``log_least`` is the logarithm of c, -inf to find it anew, as is done every ``renew_every`` tuples of the stream, of
    which there were ``n_before``.

    Returns (log rho, log_rho_max, log_least).
    """
    n_states = value.size
    log_weight = log_prior.copy()
    y = np.zeros(n_states)
    last = steps.size - 1
    for s in range(n_states):
        first = s * n_actions
        if np.sum(visits[first : first + n_actions]) > 0:
            for k in range(first, first + n_actions):
                if visits[k] == 0:
                    log_weight[k] = -np.inf
        y[s] = _log_row(log_z, log_weight, first, n_actions)
    for i in range(pair.size):
        if log_least == -np.inf or (n_before + i) % renew_every == 0:
            log_least = np.min(y)
        k = pair[i]
        s = k // n_actions
        first = s * n_actions
        if visits[k] == 0:
            if np.sum(visits[first : first + n_actions]) == 0:
                log_weight[first : first + n_actions] = -np.inf
            log_weight[k] = log_prior[k]
            y[s] = _log_row(log_z, log_weight, first, n_actions)
            log_least = min(log_least, y[s])
        log_rho_max = max(log_rho_max, beta * r[i])
        step = steps[min(fresh[k], last)]
        fresh[k] += 1
        visits[k] += 1
        off = r[i] - reward[k]
        reward[k] += off / visits[k]
        reward_squares[k] += off * (r[i] - reward[k])
        mean_value[k] = _log_blend(kappa * mean_value[k], kappa * value[s_next[i]], 1.0 / visits[k]) / kappa
        w = beta * (reward[k] + mean_value[k] - value[s])
        w += _log_backed_up(log_least, kappa * (value[s_next[i]] - mean_value[k]), y[s_next[i]])
        log_z[k] = _log_blend(log_z[k], w - log_rho, step)
        log_rho = min(_log_blend(log_rho, w - log_z[k], lr_rho), log_rho_max)
        y[s] = _log_row(log_z, log_weight, first, n_actions)
        log_least = min(log_least, y[s])
    return log_rho, log_rho_max, log_least
