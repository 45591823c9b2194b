"""Every compiled loop of the package.

Kernels take plain C-contiguous arrays and scalars, use no globals, and validate nothing: the callers do.
``error_model="numpy"``: a division by zero gives inf or nan for the caller to find, and no check costs time.
They stand in one file because Numba's cache does not notice a changed kernel in another file.

Pair index: ``k = s * n_actions + a``. Transition matrices come as CSR arrays (indptr, indices, data).
"""

from __future__ import annotations

import math
from pathlib import Path

import numba
import numpy as np
from llvmlite import ir
from numba.extending import intrinsic


def compiled_before() -> bool:
    """Whether an earlier run on this machine has left compiled loops behind."""
    return any(Path(u_epoch.stats.cache_path).glob("kernels.u_epoch*.nbi"))


# ---------------------------------------------------------------------------------------------------
# Algorithm S1, lines 2-3: one epoch of the psi phase is the affine map x <- decay * x + W psi
# ---------------------------------------------------------------------------------------------------


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
def psi_phase(indptr, indices, data, decay, psi, log_psi, mean_psi, mean_log_psi, tolerance, epsilon, max_epochs):
    """Lines 2-3 until the relative change between epochs is below ``tolerance``; tables change in place.

    Each epoch costs O(n_pairs), whatever the number of tuples. Returns (epochs, last relative change).
    """
    n_pairs = decay.size
    add_psi = np.zeros(n_pairs)
    add_log_psi = np.zeros(n_pairs)
    for k in range(n_pairs):
        for m in range(indptr[k], indptr[k + 1]):
            add_psi[k] += data[m] * psi[indices[m]]
            add_log_psi[k] += data[m] * log_psi[indices[m]]
    change = np.inf
    epochs = 0
    while epochs < max_epochs:
        epochs += 1
        change = 0.0
        for k in range(n_pairs):
            x = mean_psi[k]
            mean_psi[k] = decay[k] * x + add_psi[k]
            change = max(change, abs(mean_psi[k] - x) / x)
            y = mean_log_psi[k]
            mean_log_psi[k] = decay[k] * y + add_log_psi[k]
            change = max(change, abs(mean_log_psi[k] - y) / (abs(y) + epsilon))
        if not change >= tolerance:  # also leaves on NaN
            break
    return epochs, change


# ---------------------------------------------------------------------------------------------------
# Algorithm S1, lines 9-11, in the gauge z = psi * u, with one division a tuple
# ---------------------------------------------------------------------------------------------------


@intrinsic
def _fma(typing, a, b, c):
    """a * b + c with one rounding: written out, since what a compiler fuses by itself differs from loop to loop."""
    signature = numba.float64(numba.float64, numba.float64, numba.float64)

    def generate(context, builder, signature, arguments):
        return builder.fma(*arguments)

    return signature, generate


@numba.njit(cache=True, error_model="numpy", nogil=True)
def _lines_10_and_11(gain, z, z_next, q, lr_u, lr_rho, inv_rho_min, same):
    """(z, q = 1/rho) after a tuple of gain g(s,a).

    With w = g * z(s',a'), line 10 is z' = (1-lr_u) z + lr_u w q, and line 11, rho' = (1-lr_rho) rho + lr_rho w / z',
    becomes q' = q z' / ((1-lr_rho) z' + lr_rho w q). Written in the old z, numerator and denominator are ready
    together: a chain of multiply-add, divide, multiply. ``same``: a self-loop read with the new u, so that
    u(s',a')/u(s,a) = 1 in line 11.
    """
    keep_rho = 1.0 - lr_rho
    w = gain * z_next
    kept = (1.0 - lr_u) * z
    z_new = _fma(lr_u * w, q, kept)
    # Selects, not branches.
    den_kept = keep_rho if same else keep_rho * kept
    den_w = lr_rho * gain if same else _fma(keep_rho, lr_u, lr_rho) * w
    num = 1.0 if same else z_new
    q_new = q * (num / _fma(den_w, q, den_kept))
    # Not max(): NaN must stay visible.
    return z_new, inv_rho_min if q_new < inv_rho_min else q_new


@numba.njit(cache=True, error_model="numpy", nogil=True)
def _u_chunk(pair, pair_next, factor, noisy, g, z, inv_rho, lr_u, lr_rho, inv_rho_min, new, begin, end):
    """Tuples begin..end of lines 9-11. z changes in place; returns 1/rho."""
    q = inv_rho
    for t in range(begin, end):
        k = pair[t]
        j = pair_next[t]
        gain = g[k]
        if noisy:
            gain *= factor[t]
        z[k], q = _lines_10_and_11(gain, z[k], z[j], q, lr_u, lr_rho, inv_rho_min, new and k == j)
    return q


@numba.njit(cache=True, error_model="numpy", nogil=True)
def _is_healthy(z, q):
    if not (np.isfinite(q) and q > 0.0):
        return False
    for k in range(z.size):
        if not (np.isfinite(z[k]) and z[k] > 0.0):
            return False
    return True


@numba.njit(cache=True, error_model="numpy", nogil=True)
def u_epoch(
    pair, pair_next, factor, noisy, g, z, inv_rho, lr_u, lr_rho, inv_rho_min, new, rescale_every, begin, end, first=0
):
    """Lines 9-11 over tuples begin..end of a pass; z [n_pairs] changes in place.

    ``first``: tuple of the pass that stands first in the columns.

    Every ``rescale_every`` tuples z is multiplied by a power of two that brings its mean to about 1: the
    updates are homogeneous in z, so this changes no bit of rho or of the policy.

    Returns (1/rho, t): t = end, or the first tuple whose update is not a positive finite number.
    """
    backup = np.empty_like(z)
    q = inv_rho
    t = begin
    while t < end:
        stop = min(end, t - t % rescale_every + rescale_every)
        backup[:] = z
        q_before = q
        q = _u_chunk(pair, pair_next, factor, noisy, g, z, q, lr_u, lr_rho, inv_rho_min, new, t - first, stop - first)
        if not _is_healthy(z, q):
            z[:] = backup
            q = q_before
            for bad in range(t - first, stop - first):
                q = _u_chunk(pair, pair_next, factor, noisy, g, z, q, lr_u, lr_rho, inv_rho_min, new, bad, bad + 1)
                k = pair[bad]
                if not (np.isfinite(q) and q > 0.0 and np.isfinite(z[k]) and z[k] > 0.0):
                    return q, bad + first
            return q, stop - 1
        t = stop
        if t % rescale_every == 0:
            _, exponent = math.frexp(np.mean(z))
            if exponent > 1 or exponent < 0:
                scale = math.ldexp(1.0, -exponent)
                for k in range(z.size):
                    z[k] *= scale
    return q, end


# ---------------------------------------------------------------------------------------------------
# The same for many replicas at once. A stream bounds its own learner by the latency of a division; side by side,
# replicas fill the gaps. Lane i of a block holds z and g of pair k at [k * step_k + i * step_lane] of flat tables.
# Every lane goes through the operations of `u_epoch`, in its order: the same bits, whatever the block.
# ---------------------------------------------------------------------------------------------------


@numba.njit(cache=True, error_model="numpy", nogil=True)
def _lanes_rows(
    pair, pair_next, factor, noisy, g, z, q, lr_u, lr_rho, inv_rho_min, new, step_k, step_lane, begin, end
):  # fmt: skip
    """Rows begin..end of streams [n, lanes], a stream a lane; z [n_pairs * lanes] and q [lanes] change in place."""
    # Unsigned: Numba would look at the sign of every other index.
    step_k, step_lane = np.uint64(step_k), np.uint64(step_lane)
    for t in range(begin, end):
        for i in range(q.size):
            k = np.uint64(pair[t, i]) * step_k + np.uint64(i) * step_lane
            j = np.uint64(pair_next[t, i]) * step_k + np.uint64(i) * step_lane
            gain = g[k]
            if noisy:
                gain *= factor[t, i]
            z[k], q[i] = _lines_10_and_11(gain, z[k], z[j], q[i], lr_u[i], lr_rho[i], inv_rho_min[i], new and k == j)


@numba.njit(cache=True, error_model="numpy", nogil=True)
def _shared_rows(pair, pair_next, factor, noisy, g, z, q, lr_u, lr_rho, inv_rho_min, new, begin, end):
    """Tuples begin..end of one stream [n] for all lanes; z, g [n_pairs * lanes], lanes side by side: no gather."""
    lanes = q.size
    for t in range(begin, end):
        k = pair[t] * lanes
        j = pair_next[t] * lanes
        same = new and k == j
        # Slices, whose indices are plainly in range: the loops become vector instructions.
        gain, here, there = g[k : k + lanes], z[k : k + lanes], z[j : j + lanes]
        if noisy:
            for i in range(lanes):
                here[i], q[i] = _lines_10_and_11(
                    gain[i] * factor[t, i], here[i], there[i], q[i], lr_u[i], lr_rho[i], inv_rho_min[i], same
                )
        else:
            for i in range(lanes):
                here[i], q[i] = _lines_10_and_11(
                    gain[i], here[i], there[i], q[i], lr_u[i], lr_rho[i], inv_rho_min[i], same
                )


@numba.njit(cache=True, error_model="numpy", nogil=True)
def _settle(z, q, z_before, q_before, failed, step_k, step_lane, rescale, began):
    """After a stretch that began at tuple ``began``: lanes that left the numbers go back, the others are rescaled.

    ``failed`` [lanes] gets the stretch in which a lane first left, -1 before.
    """
    n_pairs = z.size // q.size
    for i in range(q.size):
        healthy = np.isfinite(q[i]) and q[i] > 0.0
        total = 0.0
        for n in range(n_pairs):
            x = z[n * step_k + i * step_lane]
            healthy = healthy and np.isfinite(x) and x > 0.0
            total += x
        if not healthy:
            if failed[i] < 0:
                failed[i] = began
            q[i] = q_before[i]
            for n in range(n_pairs):
                k = n * step_k + i * step_lane
                z[k] = z_before[k]
        elif rescale:
            _, exponent = math.frexp(total / n_pairs)
            if exponent > 1 or exponent < 0:
                scale = math.ldexp(1.0, -exponent)
                for n in range(n_pairs):
                    z[n * step_k + i * step_lane] *= scale


@numba.njit(cache=True, error_model="numpy", nogil=True)
def lanes_epoch(
    pair, pair_next, factor, noisy, g, z, q, lr_u, lr_rho, inv_rho_min, new, step_k, step_lane, rescale_every, failed,
    begin, end,
):  # fmt: skip
    """``u_epoch`` over tuples begin..end of streams, which are the rows of pair, pair_next [end - begin, lanes] and,
    where ``noisy``, factor.

    z, q and failed change in place (see ``_settle``).
    """
    t = begin
    while t < end:
        stop = min(end, t - t % rescale_every + rescale_every)
        z_before, q_before = z.copy(), q.copy()
        _lanes_rows(
            pair, pair_next, factor, noisy, g, z, q, lr_u, lr_rho, inv_rho_min, new, step_k, step_lane, t - begin,
            stop - begin,
        )  # fmt: skip
        _settle(z, q, z_before, q_before, failed, step_k, step_lane, stop % rescale_every == 0, t)
        t = stop


@numba.njit(cache=True, error_model="numpy", nogil=True)
def shared_epoch(
    pair, pair_next, factor, noisy, g, z, q, lr_u, lr_rho, inv_rho_min, new, rescale_every, failed, begin, end
):
    """``lanes_epoch`` over one stream [n] for all lanes, which lie side by side in z and g."""
    t = begin
    while t < end:
        stop = min(end, t - t % rescale_every + rescale_every)
        z_before, q_before = z.copy(), q.copy()
        _shared_rows(
            pair, pair_next, factor, noisy, g, z, q, lr_u, lr_rho, inv_rho_min, new, t - begin, stop - begin,
        )  # fmt: skip
        _settle(z, q, z_before, q_before, failed, q.size, 1, stop % rescale_every == 0, t)
        t = stop


# ---------------------------------------------------------------------------------------------------
# EfficientS1: lines 9-11 in the gauge z = psi * u, with a step for every visit and either backup
# ---------------------------------------------------------------------------------------------------


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


# ---------------------------------------------------------------------------------------------------
# Sampling a finite MDP, and exact finite-horizon returns
# ---------------------------------------------------------------------------------------------------


@numba.njit(cache=True, error_model="numpy")
def cumulative_rows(indptr, data):
    """Running sums within each CSR row; 1 from the last positive entry on, so that rounding can neither
    leave the row nor reach an entry of probability 0."""
    cdf = np.empty_like(data)
    for row in range(indptr.size - 1):
        total = 0.0
        last = indptr[row]
        for m in range(indptr[row], indptr[row + 1]):
            total += data[m]
            cdf[m] = total
            if data[m] > 0.0:
                last = m
        cdf[last : indptr[row + 1]] = 1.0
    return cdf


@numba.njit(cache=True, error_model="numpy")
def _draw(cdf, low, high, x):
    """First index m in [low, high) with x < cdf[m], by bisection."""
    high -= 1
    while low < high:
        middle = (low + high) // 2
        if x < cdf[middle]:
            high = middle
        else:
            low = middle + 1
    return low


@intrinsic
def _pcg64(typing, high, low, increment_high, increment_low):
    """One step of PCG64 (XSL-RR), NumPy's default generator: (state high, state low, word), all uint64."""
    word = numba.uint64
    signature = numba.types.UniTuple(word, 3)(word, word, word, word)

    def generate(context, builder, signature, arguments):
        wide, narrow = ir.IntType(128), ir.IntType(64)

        def joined(high, low):
            high, low = builder.zext(high, wide), builder.zext(low, wide)
            return builder.or_(builder.shl(high, ir.Constant(wide, 64)), low)

        multiplier = ir.Constant(wide, 0x2360ED051FC65DA44385DF649FCCF645)
        state = builder.add(builder.mul(joined(*arguments[:2]), multiplier), joined(*arguments[2:]))
        high, low = builder.trunc(builder.lshr(state, ir.Constant(wide, 64)), narrow), builder.trunc(state, narrow)
        mixed, turn = builder.xor(high, low), builder.lshr(high, ir.Constant(narrow, 58))
        back = builder.and_(builder.sub(ir.Constant(narrow, 0), turn), ir.Constant(narrow, 63))
        word = builder.or_(builder.lshr(mixed, turn), builder.shl(mixed, back))
        return context.make_tuple(builder, signature.return_type, [high, low, word])

    return signature, generate


@numba.njit(cache=True, error_model="numpy", nogil=True)
def _uniforms(state, out, n):
    """out[:n, i] gets what ``Generator(PCG64).random(n)`` gives; state [4, lanes] uint64 (see ``_pcg64``) moves on."""
    for t in range(n):
        for i in range(state.shape[1]):
            high, low, word = _pcg64(state[0, i], state[1, i], state[2, i], state[3, i])
            state[0, i] = high
            state[1, i] = low
            out[t, i] = np.float64(np.int64(word >> np.uint64(11))) * (1.0 / 9007199254740992.0)


@numba.njit(cache=True, error_model="numpy", nogil=True)
def _draw_lanes(cdf, low, length, levels, x):
    """``_draw`` in the rows low..low+length of every lane, without branches; low becomes the index drawn.

    ``levels`` halvings, enough for the longest row; length [lanes] is used up. Both arrays are uint64.
    """
    if low.size < 4:  # too few to hide the latency of so many steps
        for i in range(low.size):
            low[i] = _draw(cdf, np.int64(low[i]), np.int64(low[i] + length[i]), x[i])
        return
    none = np.uint64(0)
    for _ in range(levels):
        for i in range(low.size):
            half = length[i] >> np.uint64(1)
            # A select. Where half is 0, nothing is added, whatever is read.
            low[i] += half if cdf[low[i] + half - np.uint64(half > none)] <= x[i] else none
            length[i] -= half


@numba.njit(cache=True, error_model="numpy", nogil=True)
def sample_rows(
    indptr, indices, cdf, levels, start_cdf, behaviour_cdf, prior_cdf, on_prior, n_actions, action_levels,
    episode_length, environment, behaviour, now, done, pair, entry, pair_next,
):  # fmt: skip
    """The next tuples of every lane's stream, written into pair, entry and pair_next [n, lanes].

    ``entry`` is the index in the CSR transition matrix (s' = indices[entry]); pair_next is s' * A + a'. With
    ``on_prior`` the behaviour policy is the prior and the action taken next is a'; otherwise a' is a draw of its own.
    ``environment`` and ``behaviour`` [4, lanes] are the generators of each lane, ``now`` [lanes] uint64 the pairs that
    come next, ``done`` the tuples that each stream has had; all but the last move on in place.
    """
    n, lanes = pair.shape
    restarts = (done + n + episode_length - 1) // episode_length - (done + episode_length - 1) // episode_length
    acts = 1 if on_prior else 2
    x = np.empty((n + restarts, lanes))
    y = np.empty((acts * n + restarts, lanes))
    _uniforms(environment, x, len(x))
    _uniforms(behaviour, y, len(y))
    low = np.empty(lanes, np.uint64)
    length = np.empty(lanes, np.uint64)
    per_state = np.uint64(n_actions)
    x_row = 0
    y_row = 0
    for t in range(n):
        if (done + t) % episode_length == 0:
            for i in range(lanes):
                s = _draw(start_cdf, 0, start_cdf.size, x[x_row, i])
                now[i] = _draw(behaviour_cdf, s * n_actions, (s + 1) * n_actions, y[y_row, i])
            x_row += 1
            y_row += 1
        for i in range(lanes):
            k = now[i]
            pair[t, i] = k
            low[i] = indptr[k]
            length[i] = indptr[k + np.uint64(1)] - indptr[k]
        _draw_lanes(cdf, low, length, levels, x[x_row])
        x_row += 1
        for i in range(lanes):
            entry[t, i] = low[i]
            low[i] = np.uint64(indices[low[i]]) * per_state
            length[i] = per_state
        if not on_prior:
            now[:] = low
        _draw_lanes(prior_cdf, low, length, action_levels, y[y_row])
        y_row += 1
        for i in range(lanes):
            pair_next[t, i] = low[i]
        if on_prior:
            now[:] = low
        else:
            length[:] = per_state
            _draw_lanes(behaviour_cdf, now, length, action_levels, y[y_row])
            y_row += 1


@numba.njit(cache=True, error_model="numpy", nogil=True)
def sampled_epoch(
    tables, environment, behaviour, now, buffers, g, z, q, lr_u, lr_rho, inv_rho_min, new, step_k, step_lane,
    rescale_every, failed, begin, end,
):  # fmt: skip
    """``lanes_epoch`` over streams that are sampled as they are used: no tuple is kept.

    ``tables``: the arguments of ``sample_rows`` that are the same for all lanes; ``buffers``: three arrays
    [rows, lanes] int32 for its results.
    """
    t = begin
    factor = np.empty((1, 1))
    while t < end:
        stop = min(end, t - t % rescale_every + rescale_every)
        z_before, q_before = z.copy(), q.copy()
        for first in range(t, stop, len(buffers[0])):
            n = min(len(buffers[0]), stop - first)
            pair, entry, pair_next = buffers[0][:n], buffers[1][:n], buffers[2][:n]
            sample_rows(*tables, environment, behaviour, now, first, pair, entry, pair_next)
            _lanes_rows(
                pair, pair_next, factor, False, g, z, q, lr_u, lr_rho, inv_rho_min, new, step_k, step_lane, 0, n
            )
        _settle(z, q, z_before, q_before, failed, step_k, step_lane, stop % rescale_every == 0, t)
        t = stop


@numba.njit(cache=True, error_model="numpy", nogil=True)
def _forget(weight, scale, keep, first, last):
    """One visit of a pair: what its row, scale * weight[first:last], holds is multiplied by ``keep``.

    Returns the new scale; the weights change only once it leaves the range where nothing is lost.
    """
    scale *= keep
    if scale < 1e-200:
        for m in range(first, last):
            weight[m] *= scale
        scale = 1.0
    return scale


@numba.njit(cache=True, error_model="numpy", nogil=True)
def survey(indptr, pair, entry, keep_psi, lr_psi, visits, weight, scale):
    """Visits and W (see ``tally``) of streams [n, lanes], on the rows of the model's CSR transition matrix.

    visits [lanes, n_pairs] counts on; W = scale [lanes, n_pairs] * weight [lanes, nnz].
    """
    n, lanes = pair.shape
    for t in range(n):
        for i in range(lanes):
            k = pair[t, i]
            visits[i, k] += 1
            scale[i, k] = _forget(weight[i], scale[i, k], keep_psi[i], indptr[k], indptr[k + 1])
            weight[i, entry[t, i]] += lr_psi[i] / scale[i, k]


@numba.njit(cache=True, error_model="numpy")
def simulate_returns(indptr, indices, cdf, reward, start_cdf, policy_cdf, episode_length, rng, returns):
    """Undiscounted return of ``returns.size`` episodes under a policy (cdf flat [S*A]); fills ``returns``."""
    n_actions = reward.shape[1]
    for episode in range(returns.size):
        s = _draw(start_cdf, 0, start_cdf.size, rng.random())
        total = 0.0
        for _ in range(episode_length):
            k = _draw(policy_cdf, s * n_actions, (s + 1) * n_actions, rng.random())
            total += reward[s, k - s * n_actions]
            s = indices[_draw(cdf, indptr[k], indptr[k + 1], rng.random())]
        returns[episode] = total


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
def row_sums(indptr, data, sums):
    """Sums of CSR rows with entries >= 0, each within 2 units of the last place."""
    for row in range(indptr.size - 1):
        sums[row] = _compensated(data[indptr[row] :], indptr[row + 1] - indptr[row])


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


# ---------------------------------------------------------------------------------------------------
# Certificates: one-step gains with what rounding can have done to them (docs/theory.md, 6)
# ---------------------------------------------------------------------------------------------------


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
    found = top + logarithm / beta
    size = -logarithm if below >= -0.5 else abs(logarithm) + math.log(n)
    # The last: products that underflow.
    rounding = (2 * n + 20) * epsilon * abs(size) / beta + 2.0 * epsilon * abs(found) + (n + 1) * 1e-323 / beta
    return found, rounding


@numba.njit(cache=True, error_model="numpy", nogil=True)
def soft_rows(q, prior, beta, backed_up, policy):
    """backed_up(s) = (1/beta) log sum_a prior exp(beta q) and the policy that attains it; q, prior, policy [S, A]."""
    for s in range(q.shape[0]):
        backed_up[s], _ = _soft_maximum(q[s], prior[s], beta, policy[s])


@numba.njit(cache=True, error_model="numpy", nogil=True)
def gain_rows(indptr, indices, data, reward, prior, beta, value, gain, low, high, policy):
    """gain = TV - V [S] with low <= gain <= high in exact arithmetic, and pi_V [S, A].

    The rows of the transition matrix (CSR) and of the prior count as divided by their sums, which are 1 within 1e-15.
    A gain that is no finite number has infinite bounds.
    """
    n_states, n_actions = reward.shape
    epsilon = 2.0**-52
    q, error, scratch = np.empty(n_actions), np.empty(n_actions), np.empty(n_actions)
    for s in range(n_states):
        top = -np.inf
        for a in range(n_actions):
            k = s * n_actions + a
            drift, size = _drift(indices, data, indptr[k], indptr[k + 1], value, s)
            q[a] = reward[s, a] + drift
            error[a] = 10.0 * epsilon * size + epsilon * abs(q[a]) + 1e-320 * (1 + indptr[k + 1] - indptr[k])
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
    total, of_prior, found, size = 0.0, 0.0, 0.0, 0.0
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
            found += prior[a] * h
            size += policy[a] * abs(x)
        elif policy[a] > 0.0:
            ratio = policy[a] / prior[a]
            logarithm = math.log(policy[a]) - math.log(prior[a])
            spoilt = abs(math.log(policy[a])) + abs(math.log(prior[a]))
            if 1e-300 < ratio < 1e300:
                logarithm = math.log(ratio)
                spoilt = abs(logarithm) + 1.0
            found += policy[a] * logarithm - (policy[a] - prior[a])
            size += policy[a] * spoilt + abs(policy[a] - prior[a])
        else:
            found += prior[a]
    if same:
        return 0.0, 0.0
    apart = (abs(total - of_prior) + (n + 2) * epsilon) / total
    found = max(found / total, 0.0)
    rounding = (n + 40) * epsilon * found + 8.0 * epsilon * size + n * 1e-322  # the last: products that underflow
    return max(found - rounding - apart * apart, 0.0), found + rounding


@numba.njit(cache=True, error_model="numpy", nogil=True)
def policy_gain_rows(indptr, indices, data, reward, prior, beta, policy, value, low, high):
    """low <= T_pi V - V <= high [S] in exact arithmetic, T_pi V = sum_a pi (r + E V - log(pi/pi0)/beta).

    Rows count as divided by their sums, as in ``gain_rows``.
    """
    n_states, n_actions = reward.shape
    epsilon = 2.0**-52
    for s in range(n_states):
        total, mean, lost, error, size = 0.0, 0.0, 0.0, 0.0, 0.0
        for a in range(n_actions):
            if policy[s, a] > 0.0:
                k = s * n_actions + a
                drift, moved = _drift(indices, data, indptr[k], indptr[k + 1], value, s)
                q = reward[s, a] + drift
                total += policy[s, a]
                x = policy[s, a] * q
                size += abs(x)
                new = mean + x
                lost += (mean - new) + x if abs(mean) >= abs(x) else (x - new) + mean
                mean = new
                error += policy[s, a] * (10.0 * epsilon * moved + 1e-320 * (1 + indptr[k + 1] - indptr[k])) + 1e-320
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


# ---------------------------------------------------------------------------------------------------
# Random mazes
# ---------------------------------------------------------------------------------------------------


@numba.njit(cache=True, error_model="numpy")
def smooth_wind(wind, noise):
    """Raster sweeps, in place, in which each value becomes the mean of itself and its four periodic neighbours.

    wind [n, 2, rows, cols]: the angles get one sweep for each noise [n, sweeps, rows, cols], which is added
    to the means as they are made; the strengths get one sweep.
    """
    n, _, rows, cols = wind.shape
    for m in range(n):
        for sweep in range(noise.shape[1] + 1):
            angles = sweep < noise.shape[1]
            field = wind[m, 0] if angles else wind[m, 1]
            for i in range(rows):
                for j in range(cols):
                    around = field[i - 1, j] + field[(i + 1) % rows, j] + field[i, j - 1] + field[i, (j + 1) % cols]
                    field[i, j] = (field[i, j] + around) / 5
                    if angles:
                        field[i, j] += noise[m, sweep, i, j]


# ---------------------------------------------------------------------------------------------------
# Exact solvers: expectations under the tilted dynamics, in logarithms
# ---------------------------------------------------------------------------------------------------


@numba.njit(cache=True, error_model="numpy", nogil=True)
def tilt_rows(indptr, indices, data, h, log_mean, kl, tilted):
    """For each row: log_mean = log sum_j p_j exp(h_j), tilted_j = p_j exp(h_j - log_mean), and
    kl = sum_j tilted_j log(tilted_j / p_j).

    CSR rows of positive entries; h [n_columns] of any size. Fills log_mean, kl [rows] and tilted (as data).
    """
    for row in range(indptr.size - 1):
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


@numba.njit(cache=True, error_model="numpy", nogil=True)
def likelihood_rows(indptr, data, x, slope, moved, cost):
    """Row by row, q that maximises slope * sum_j q_j x_j - sum_j p_j log(p_j/q_j), for slope [rows] of any sign.

    CSR rows p that sum to 1; x [entries]. An entry of probability 0 may be given mass: that of a successor not seen.
    Fills moved with q (as data) and cost [rows] with sum_j p_j log(p_j/q_j). Stationary where q_j = p_j/(eta - y_j),
    y = slope (x - mean): eta is the root of sum_j q_j = 1 above the largest y, or that y itself, where what is seen
    leaves mass over.
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


# ---------------------------------------------------------------------------------------------------
# Exact solvers: the dominant eigenvector by Newton's method in logarithms, on a fixed sparsity pattern
# ---------------------------------------------------------------------------------------------------


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
def lazy_log_steps(ptr, ind, log_m, h, gain, chain, steps, near):
    """Power steps on exp(h) in logarithms, averaged with standing still (no period can catch them), until the gains
    differ by less than ``near`` or there were ``steps``. h changes in place; gain, chain and what is returned are those
    of ``log_gains`` there."""
    low, high = log_gains(ptr, ind, log_m, h, gain, chain)
    for _ in range(steps):
        if high - low < near or not np.isfinite(high - low):
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


# ---------------------------------------------------------------------------------------------------
# A model from samples
# ---------------------------------------------------------------------------------------------------


@numba.njit(cache=True, error_model="numpy", nogil=True)
def count_rows(cells, n_cells):
    """How often each cell occurs in each row of ``cells`` [R, n] (all in [0, n_cells)).

    Returns (length [R], indices, counts): occupied cells of row after row, ascending, and their counts.
    """
    seen = np.zeros(n_cells, np.int32)
    length = np.empty(cells.shape[0], np.int64)
    indices = np.empty(cells.size, np.int32)
    counts = np.empty(cells.size, np.int32)
    n = 0
    for row in range(cells.shape[0]):
        first = n
        for i in range(cells.shape[1]):
            cell = cells[row, i]
            if seen[cell] == 0:
                indices[n] = cell
                n += 1
            seen[cell] += 1
        indices[first:n].sort()
        for m in range(first, n):
            counts[m] = seen[indices[m]]
            seen[indices[m]] = 0
        length[row] = n - first
    return length, indices[:n].copy(), counts[:n].copy()


# ---------------------------------------------------------------------------------------------------
# Learners of action values: Q-learning and its kin
# ---------------------------------------------------------------------------------------------------


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
