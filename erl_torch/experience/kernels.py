"""Sampling a finite MDP.

Kernels take plain C-contiguous arrays and scalars, use no globals, and validate nothing: the callers do.
``error_model="numpy"``: a division by zero gives inf or nan for the caller to find, and no check costs time.
Those that call each other stand in one file: Numba's cache does not notice a changed kernel in another file.
Pair index: ``k = s * n_actions + a``. Transition matrices come as CSR arrays (indptr, indices, data).
"""

from __future__ import annotations

import numba
import numpy as np
from llvmlite import ir
from numba.extending import intrinsic


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


def _pcg64_uncompiled(high, low, increment_high, increment_low):
    """``_pcg64`` in whole numbers of any size."""
    increment = int(increment_high) << 64 | int(increment_low)
    state = (int(high) << 64 | int(low)) * 0x2360ED051FC65DA44385DF649FCCF645 + increment
    high, low = state >> 64 & 2**64 - 1, state & 2**64 - 1
    twice = (high ^ low) << 64 | (high ^ low)
    return np.uint64(high), np.uint64(low), np.uint64(twice >> (high >> 58) & 2**64 - 1)


if numba.config.DISABLE_JIT:
    _pcg64 = _pcg64_uncompiled


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
