"""Algorithm S1: one stream, or many side by side.

A stream bounds its own learner by the latency of a division (one a tuple, in the gauge z = psi * u); side by side,
replicas fill the gaps. Lane i of a block holds z and g of pair k at [k * step_k + i * step_lane] of flat tables.
Every lane goes through the operations of ``u_epoch``, in its order: the same bits, whatever the block.
An epoch of the psi phase (lines 2-3) is the affine map x <- decay * x + W psi.

Kernels take plain C-contiguous arrays and scalars, use no globals, and validate nothing: the callers do.
``error_model="numpy"``: a division by zero gives inf or nan for the caller to find, and no check costs time.
Those that call each other stand in one file: Numba's cache does not notice a changed kernel in another file.
Pair index: ``k = s * n_actions + a``. Transition matrices come as CSR arrays (indptr, indices, data).
"""

from __future__ import annotations

import math
from fractions import Fraction
from pathlib import Path

import numba
import numpy as np
from numba.extending import intrinsic

# Numba looks at this file alone to see whether it has changed: the other's checksum changes it.
# experience/kernels.py: 1519040632
from erl_torch.experience.kernels import sample_rows


def compiled_before() -> bool:
    """Whether an earlier run on this machine has left compiled loops behind, or none are compiled at all."""
    if numba.config.DISABLE_JIT:
        return True
    folder, package = Path(u_epoch.stats.cache_path), Path(__file__).parents[2]
    # Any loop: each learner compiles its own, and all runs those of the solvers.
    return any(package.rglob("*.nbi") if package in folder.parents else folder.parent.glob("*/*.nbi"))


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


@numba.njit(cache=True, error_model="numpy", nogil=True)
def _mixed(x, y, keep, exponent):
    """log (keep exp(exponent x) + (1 - keep) exp(exponent y)) / exponent, between x and y; their mean at 0."""
    if keep == 1.0 or x == y:
        return x
    if keep == 0.0:
        return y
    difference = exponent * (y - x)
    if difference == 0.0:
        return keep * x + (1.0 - keep) * y
    if difference < 0.0:  # from the larger term: nothing overflows
        excess, rest = (1.0 - keep) * np.expm1(difference), keep + (1.0 - keep) * np.exp(difference)
        return x + (np.log1p(excess) if excess > -0.5 else np.log(rest)) / exponent
    excess, rest = keep * np.expm1(-difference), (1.0 - keep) + keep * np.exp(-difference)
    return y + (np.log1p(excess) if excess > -0.5 else np.log(rest)) / exponent


@numba.njit(cache=True, error_model="numpy", nogil=True)
def power_phase(
    indptr, indices, data, decay, log_psi, optimism, log_mean_psi, mean_log_psi, tolerance, epsilon, max_epochs
):
    """``psi_phase`` where optimism is not 0, in logarithms throughout; tables change in place.

    log_mean_psi [n_pairs]: log <psi^(1-optimism)> / (1-optimism); mean_log_psi: -log <psi^(-optimism)> / optimism.
    Sums of the stream's weights are 1 - decay, so that an epoch mixes each table with the stream's own mean. Returns
    (epochs, last relative change of exp(log_mean_psi) and mean_log_psi).
    """
    n_pairs = decay.size
    own = np.zeros((2, n_pairs))
    for k in range(n_pairs):
        total = 0.0
        for m in range(indptr[k], indptr[k + 1]):
            if data[m] > 0.0:
                total += data[m]
                keep = (total - data[m]) / total
                own[0, k] = _mixed(own[0, k], log_psi[indices[m]], keep, 1.0 - optimism)
                own[1, k] = _mixed(own[1, k], log_psi[indices[m]], keep, -optimism)
    change = np.inf
    epochs = 0
    while epochs < max_epochs:
        epochs += 1
        change = 0.0
        for k in range(n_pairs):
            x, y = log_mean_psi[k], mean_log_psi[k]
            log_mean_psi[k] = _mixed(x, own[0, k], decay[k], 1.0 - optimism)
            change = max(change, abs(np.expm1(log_mean_psi[k] - x)))
            mean_log_psi[k] = _mixed(y, own[1, k], decay[k], -optimism)
            change = max(change, abs(mean_log_psi[k] - y) / (epsilon + abs(y)))
        if not change >= tolerance:  # also leaves on NaN
            break
    return epochs, change


@intrinsic
def _fma(typing, a, b, c):
    """a * b + c with one rounding: written out, since what a compiler fuses by itself differs from loop to loop."""
    signature = numba.float64(numba.float64, numba.float64, numba.float64)

    def generate(context, builder, signature, arguments):
        return builder.fma(*arguments)

    return signature, generate


def _fma_uncompiled(a, b, c):
    """``_fma`` in fractions, which are rounded once."""
    if not (math.isfinite(a) and math.isfinite(b)):
        return np.float64(a) * b + c
    if not math.isfinite(c):
        return np.float64(c)  # however large the product is
    exact = Fraction(a) * Fraction(b) + Fraction(c)
    if not exact:
        return np.float64(a) * b + c  # a zero of the right sign
    try:
        return np.float64(exact)
    except OverflowError:
        return np.float64(math.inf if exact > 0 else -math.inf)


if numba.config.DISABLE_JIT:
    _fma = _fma_uncompiled


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
def _are_healthy(z, g, q):
    """Whether all are positive finite numbers; z of a pair that there is not (g < 0) is 0."""
    if not (np.isfinite(q) and q > 0.0):
        return False
    for k in range(z.size):
        if not (np.isfinite(z[k]) and z[k] > 0.0) and not g[k] < 0.0:
            return False
    return True


@numba.njit(cache=True, error_model="numpy", nogil=True)
def u_epoch(
    pair, pair_next, factor, noisy, g, z, inv_rho, lr_u, lr_rho, inv_rho_min, new, rescale_every, begin, end, first=0
):
    """Lines 9-11 over tuples begin..end of a pass; z [n_pairs] changes in place. Where there is no such pair, z is 0, g
    is below 0, and no tuple has it.

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
        if not _are_healthy(z, g, q):
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


@numba.njit(cache=True, error_model="numpy", nogil=True)
def _lanes_rows(
    pair, pair_next, factor, noisy, g, z, q, lr_u, lr_rho, inv_rho_min, new, step_k, step_lane, begin, end
):  # fmt: skip
    """Rows begin..end of streams [n, lanes], one stream per lane; z [n_pairs * lanes] and q [lanes] change in place."""
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
def _settle(z, g, q, z_before, q_before, failed, step_k, step_lane, rescale, began):
    """After a stretch that began at tuple ``began``: lanes that left the numbers go back, the others are rescaled.

    ``failed`` [lanes] gets the stretch in which a lane first left, -1 before.
    """
    n_pairs = z.size // q.size
    for i in range(q.size):
        healthy = np.isfinite(q[i]) and q[i] > 0.0
        total = 0.0
        for n in range(n_pairs):
            k = n * step_k + i * step_lane
            healthy = healthy and ((np.isfinite(z[k]) and z[k] > 0.0) or g[k] < 0.0)
            total += z[k]
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
        _settle(z, g, q, z_before, q_before, failed, step_k, step_lane, stop % rescale_every == 0, t)
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
        _settle(z, g, q, z_before, q_before, failed, q.size, 1, stop % rescale_every == 0, t)
        t = stop


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
        _settle(z, g, q, z_before, q_before, failed, step_k, step_lane, stop % rescale_every == 0, t)
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
