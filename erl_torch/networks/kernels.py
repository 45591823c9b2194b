"""Updates of small networks, and the actions that they choose, on the memory of their vectors (``layout``).

Kernels take C-contiguous arrays and scalars and validate nothing: the callers do. Float32; products by BLAS. One call
makes any number of updates of one seed, with the same bits however they are cut. Two hidden layers.

A vector of weights holds the network of Q, then, of ``SEPARATE`` learners, that of V. ``lagged`` is the copy that
targets are made of: of V, or, without a network of V, of Q.
"""

from __future__ import annotations

import math

import numba
import numpy as np

# Places in ``numbers`` [N_NUMBERS] float64.
G, UPDATES, THETA_SUM, RESIDUAL_SUM, LOSS_SUM, SUMMED = range(6)
N_NUMBERS = 6


@numba.njit(cache=True, error_model="numpy", nogil=True, inline="always")
def _next(state):
    """The next 64 random bits (splitmix64); ``state`` [1] uint64 goes on."""
    state[0] += np.uint64(0x9E3779B97F4A7C15)
    z = state[0]
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@numba.njit(cache=True, error_model="numpy", nogil=True)
def _layer(x, weight, bias, out, rectified):
    """out = x W + b, rectified or not."""
    np.dot(x, weight, out)
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            y = out[i, j] + bias[j]
            out[i, j] = y if y > 0.0 or not rectified else np.float32(0.0)


@numba.njit(cache=True, error_model="numpy", nogil=True)
def _forward(p, n_in, h1, h2, n_out, x, a, b, out):
    """Output of the network p at x [B, n_in]; hidden layers into a [B, h1], b [B, h2]."""
    i, j, k = n_in * h1, (n_in + 1) * h1, (n_in + 1) * h1 + h1 * h2
    m = k + h2
    _layer(x, p[:i].reshape(n_in, h1), p[i:j], a, True)
    _layer(a, p[j:k].reshape(h1, h2), p[k:m], b, True)
    _layer(b, p[m : m + h2 * n_out].reshape(h2, n_out), p[m + h2 * n_out : m + (h2 + 1) * n_out], out, False)


@numba.njit(cache=True, error_model="numpy", nogil=True)
def _masked(error, active):
    """error where active > 0, else 0."""
    for i in range(error.shape[0]):
        for j in range(error.shape[1]):
            if active[i, j] <= 0.0:
                error[i, j] = np.float32(0.0)


@numba.njit(cache=True, error_model="numpy", nogil=True)
def _sums(error, into):
    """Sums over the rows of error."""
    into[:] = np.float32(0.0)
    for i in range(error.shape[0]):
        for j in range(error.shape[1]):
            into[j] += error[i, j]


@numba.njit(cache=True, error_model="numpy", nogil=True)
def _backward(p, n_in, h1, h2, n_out, x, a, b, error, da, db, slope):
    """The slope [size] of sum(error * output) by p."""
    i, j, k = n_in * h1, (n_in + 1) * h1, (n_in + 1) * h1 + h1 * h2
    m = k + h2
    q = m + h2 * n_out
    np.dot(b.T, error, slope[m:q].reshape(h2, n_out))
    _sums(error, slope[q : q + n_out])
    np.dot(error, p[m:q].reshape(h2, n_out).T, db)
    _masked(db, b)
    np.dot(a.T, db, slope[j:k].reshape(h1, h2))
    _sums(db, slope[k:m])
    np.dot(db, p[j:k].reshape(h1, h2).T, da)
    _masked(da, a)
    np.dot(x.T, da, slope[:i].reshape(n_in, h1))
    _sums(da, slope[i:j])


@numba.njit(cache=True, error_model="numpy", nogil=True)
def _adam(p, slope, m, v, rate, correction):
    """One step of Adam (Kingma and Ba, betas .9 and .999, eps 1e-8); ``correction`` is sqrt(1 - .999^t)."""
    for i in range(p.size):
        d = slope[i]
        m[i] += np.float32(0.1) * (d - m[i])
        v[i] += np.float32(0.001) * (d * d - v[i])
        p[i] -= rate * m[i] / (math.sqrt(v[i]) / correction + np.float32(1e-8))


@numba.njit(cache=True, error_model="numpy", nogil=True)
def _soft(q, log_prior, beta):
    """(1/beta) log sum_a exp(log_prior + beta q) of one row, -infinite priors left out."""
    top = -np.inf
    for a in range(q.size):
        x = log_prior[a] + beta * q[a]
        if x > top:
            top = x
    total = 0.0
    for a in range(q.size):
        total += math.exp(log_prior[a] + beta * q[a] - top)
    return (top + math.log(total)) / beta


@numba.njit(cache=True, error_model="numpy", nogil=True)
def advance(
    weights, lagged, m, v, numbers, random, observation, action, reward, following, ended, n, n_updates,
    h1, h2, batch, separate, beta, kappa, log_prior, lr, lr_end, n_total, tau, g_rate, penalty, episodic, limit,
):  # fmt: skip
    """``n_updates`` updates from the first ``n`` tuples; all arrays before ``observation`` change in place.

    Args:
        weights, m, v: [size] float32: the networks, and Adam's means.
        lagged: the copy that targets are made of, float32.
        numbers: [N_NUMBERS] float64.
        random: [1] uint64, draws minibatches.
        observation, following: [N, d] float32; action [N] int32; reward [N] float32; ended [N] bool.
        separate: whether V has a network of its own (S1); else targets are of Q's copy.
        kappa: rate of the exponential loss, optimism * beta; 0 is the squared loss.
        limit: no exponential of it is above exp(limit).
        log_prior: [n_actions] float64.
        lr, lr_end, n_total: Adam's rate falls on a line from lr to lr_end over n_total updates.
        penalty: weight of support, reward: (pi - data) is added to the slope of Q.
        episodic: an end is worth 0, and g stays 0; else ``following`` of an end is where the next episode began.
    """
    n_in, n_actions = observation.shape[1], log_prior.size
    size_q = (n_in + 1) * h1 + (h1 + 1) * h2 + (h2 + 1) * n_actions
    n_lagged = 1 if separate else n_actions
    f = np.float32
    x, x2 = np.empty((batch, n_in), f), np.empty((batch, n_in), f)
    a1, a2, q = np.empty((batch, h1), f), np.empty((batch, h2), f), np.empty((batch, n_actions), f)
    c1, c2, value = np.empty((batch, h1), f), np.empty((batch, h2), f), np.empty((batch, 1), f)
    l1, l2, after = np.empty((batch, h1), f), np.empty((batch, h2), f), np.empty((batch, n_lagged), f)
    d1, d2 = np.empty((batch, h1), f), np.empty((batch, h2), f)
    error, error_v = np.empty((batch, n_actions), f), np.empty((batch, 1), f)
    slope = np.empty(weights.size, f)
    chosen = np.empty(batch, np.int64)
    soft, next_value = np.empty(batch), np.empty(batch)
    for _ in range(n_updates):
        for i in range(batch):
            at = np.int64((_next(random) >> np.uint64(11)) * (1.0 / 9007199254740992.0) * n)
            chosen[i] = at
            for j in range(n_in):
                x[i, j] = observation[at, j]
                x2[i, j] = following[at, j]
        _forward(weights[:size_q], n_in, h1, h2, n_actions, x, a1, a2, q)
        _forward(lagged, n_in, h1, h2, n_lagged, x2, l1, l2, after)
        mean_soft, mean_next = 0.0, 0.0
        for i in range(batch):
            soft[i] = _soft(q[i], log_prior, beta)
            next_value[i] = after[i, 0] if separate else _soft(after[i], log_prior, beta)
            if episodic and ended[chosen[i]]:
                next_value[i] = 0.0
            mean_soft += soft[i] / batch
            mean_next += next_value[i] / batch
        if separate:
            _forward(weights[size_q:], n_in, h1, h2, 1, x, c1, c2, value)
            if not episodic:
                numbers[G] += g_rate * (mean_soft - numbers[G])
        g = numbers[G]
        loss, theta, residual = 0.0, 0.0, 0.0
        for i in range(batch):
            at = chosen[i]
            k = action[at]
            target = reward[at] + next_value[i] - (0.0 if separate else g)
            off = target - q[i, k]
            step = -off
            if kappa != 0.0:
                step = -(math.exp(min(kappa * off, limit)) - 1.0) / kappa
            loss += 0.5 * off * off / batch
            for j in range(n_actions):
                extra = 0.0
                if penalty != 0.0:
                    extra = penalty * math.exp(log_prior[j] + beta * (q[i, j] - soft[i]))
                error[i, j] = extra / batch
            error[i, k] += (step - penalty) / batch
            if separate:
                h = soft[i] - g
                error_v[i, 0] = (value[i, 0] - h) / batch
                loss += 0.5 * (value[i, 0] - h) ** 2 / batch
                theta -= (soft[i] - value[i, 0]) / batch
                residual += abs(soft[i] - value[i, 0] - g) / batch
            else:
                theta -= (reward[at] + next_value[i] - q[i, k]) / batch
                residual += abs(off) / batch
        if not separate and not episodic:
            numbers[G] += g_rate * (mean_next - numbers[G])
        _backward(weights[:size_q], n_in, h1, h2, n_actions, x, a1, a2, error, d1, d2, slope[:size_q])
        if separate:
            _backward(weights[size_q:], n_in, h1, h2, 1, x, c1, c2, error_v, d1, d2, slope[size_q:])
        numbers[UPDATES] += 1.0
        t = numbers[UPDATES]
        rate = (lr + (lr_end - lr) * min(1.0, (t - 1.0) / n_total)) / (1.0 - 0.9**t)
        _adam(weights, slope, m, v, np.float32(rate), np.float32(math.sqrt(1.0 - 0.999**t)))
        first = size_q if separate else 0
        for i in range(lagged.size):
            lagged[i] += np.float32(tau) * (weights[first + i] - lagged[i])
        numbers[THETA_SUM] += theta
        numbers[RESIDUAL_SUM] += residual
        numbers[LOSS_SUM] += loss
        numbers[SUMMED] += 1.0


@numba.njit(cache=True, error_model="numpy", nogil=True)
def values(weights, h1, h2, n_out, x, out):
    """Output [N, n_out] of the network at x [N, n_in], a row at a time: no row's bits depend on the others."""
    n_in = x.shape[1]
    i, j, k = n_in * h1, (n_in + 1) * h1, (n_in + 1) * h1 + h1 * h2
    m = k + h2
    e = m + h2 * n_out
    a, b = np.empty(h1, np.float32), np.empty(h2, np.float32)
    for row in range(x.shape[0]):
        a[:] = weights[i:j]
        for c in range(n_in):
            y = x[row, c]
            for d in range(h1):
                a[d] += y * weights[c * h1 + d]
        b[:] = weights[k:m]
        for c in range(h1):
            if a[c] > 0.0:
                for d in range(h2):
                    b[d] += a[c] * weights[j + c * h2 + d]
        out[row] = weights[e : e + n_out]
        for c in range(h2):
            if b[c] > 0.0:
                for d in range(n_out):
                    out[row, d] += b[c] * weights[m + c * n_out + d]


@numba.njit(cache=True, error_model="numpy", nogil=True)
def act(weights, h1, h2, log_prior, beta, observation, uniform):
    """The action drawn by ``uniform`` in [0, 1) from pi(a|s) ~ prior exp(beta Q), at observation [1, d]."""
    q = np.empty((1, log_prior.size), np.float32)
    values(weights, h1, h2, log_prior.size, observation, q)
    soft = _soft(q[0], log_prior, beta)
    left = uniform
    last = 0
    for a in range(log_prior.size):
        p = math.exp(log_prior[a] + beta * (q[0, a] - soft))
        if p > 0.0:
            last = a
        if left < p:
            return a
        left -= p
    return last


@numba.njit(cache=True, error_model="numpy", nogil=True)
def _normal(random):
    """A standard normal number (Box and Muller)."""
    u = ((_next(random) >> np.uint64(11)) + 1.0) * (1.0 / 9007199254740992.0)
    w = (_next(random) >> np.uint64(11)) * (1.0 / 9007199254740992.0)
    return math.sqrt(-2.0 * math.log(u)) * math.cos(2.0 * math.pi * w)


@numba.njit(cache=True, error_model="numpy", nogil=True)
def _squashed(output, noise, drawn, surprise):
    """Actions tanh(mean + sd noise) in (-1, 1), [B, k], into ``drawn``, of the actor's ``output`` [B, 2k]; and
    log pi/prior, the prior uniform in (-1, 1)^k, [B], into ``surprise``."""
    k = noise.shape[1]
    for i in range(noise.shape[0]):
        surprise[i] = 0.0
        for j in range(k):
            log_sd = -5.0 + 3.5 * (math.tanh(output[i, k + j]) + 1.0)
            before = output[i, j] + math.exp(log_sd) * noise[i, j]
            drawn[i, j] = math.tanh(before)
            # log(1 - tanh^2) = 2 (log 2 - |x| - log(1 + exp(-2 |x|)))
            size = abs(before)
            slope = 2.0 * (math.log(2.0) - size - math.log1p(math.exp(-2.0 * size)))
            density = -0.5 * noise[i, j] ** 2 - log_sd - 0.5 * math.log(2.0 * math.pi) - slope
            surprise[i] += density + math.log(2.0)


@numba.njit(cache=True, error_model="numpy", nogil=True)
def advance_actor(
    weights, lagged, m, v, numbers, random, observation, action, reward, following, ended, n, n_updates,
    h1, h2, batch, separate, beta, centre, half, lr, lr_end, n_total, tau, g_rate, episodic,
):  # fmt: skip
    """As ``advance``, for actions in a box: two networks of Q, that of V where ``separate``, and the actor's.

    ``centre`` and ``half`` [k] float32 take the ``action`` [N, k] to (-1, 1)^k. ``lagged`` is the copy of V, or,
    without a network of V, of both Q. The actor has tanh(mean + sd noise), and gives mean and the measure of log sd.
    """
    d, k = observation.shape[1], action.shape[1]
    n_in = d + k
    size_q = (n_in + 1) * h1 + (h1 + 1) * h2 + h2 + 1
    size_v = (d + 1) * h1 + (h1 + 1) * h2 + h2 + 1 if separate else 0
    at_v, at_actor = 2 * size_q, 2 * size_q + size_v
    f = np.float32
    x, x2 = np.empty((batch, d), f), np.empty((batch, d), f)
    pair, proposed, after = np.empty((batch, n_in), f), np.empty((batch, n_in), f), np.empty((batch, n_in), f)
    a1, a2 = np.empty((batch, h1), f), np.empty((batch, h2), f)
    e1, e2 = np.empty((2, batch, h1), f), np.empty((2, batch, h2), f)
    p1, p2 = np.empty((batch, h1), f), np.empty((batch, h2), f)
    c1, c2 = np.empty((batch, h1), f), np.empty((batch, h2), f)
    d1, d2 = np.empty((batch, h1), f), np.empty((batch, h2), f)
    q, value, error = np.empty((batch, 1), f), np.empty((batch, 1), f), np.empty((batch, 1), f)
    both = np.empty((2, batch, 1), f)
    lag = np.empty((2, batch, 1), f)
    out, out2 = np.empty((batch, 2 * k), f), np.empty((batch, 2 * k), f)
    error_actor = np.empty((batch, 2 * k), f)
    into = np.empty((batch, n_in), f)
    noise, drawn, surprise = np.empty((batch, k)), np.empty((batch, k)), np.empty(batch)
    noise2, drawn2, surprise2 = np.empty((batch, k)), np.empty((batch, k)), np.empty(batch)
    worth, next_value = np.empty(batch), np.empty(batch)
    slope = np.empty(weights.size, f)
    chosen = np.empty(batch, np.int64)
    actor = weights[at_actor:]
    for _ in range(n_updates):
        for i in range(batch):
            at = np.int64((_next(random) >> np.uint64(11)) * (1.0 / 9007199254740992.0) * n)
            chosen[i] = at
            for j in range(d):
                x[i, j] = observation[at, j]
                x2[i, j] = following[at, j]
                pair[i, j] = x[i, j]
                proposed[i, j] = x[i, j]
                after[i, j] = x2[i, j]
            for j in range(k):
                pair[i, d + j] = (action[at, j] - centre[j]) / half[j]
        for i in range(batch):
            for j in range(k):
                noise[i, j] = _normal(random)
        _forward(actor, d, h1, h2, 2 * k, x, p1, p2, out)
        _squashed(out, noise, drawn, surprise)
        for i in range(batch):
            for j in range(k):
                proposed[i, d + j] = drawn[i, j]
        # What comes next.
        if separate:
            _forward(lagged, d, h1, h2, 1, x2, a1, a2, value)
            for i in range(batch):
                next_value[i] = value[i, 0]
        else:
            for i in range(batch):
                for j in range(k):
                    noise2[i, j] = _normal(random)
            _forward(actor, d, h1, h2, 2 * k, x2, a1, a2, out2)
            _squashed(out2, noise2, drawn2, surprise2)
            for i in range(batch):
                for j in range(k):
                    after[i, d + j] = drawn2[i, j]
            _forward(lagged[:size_q], n_in, h1, h2, 1, after, a1, a2, lag[0])
            _forward(lagged[size_q:], n_in, h1, h2, 1, after, a1, a2, lag[1])
            for i in range(batch):
                next_value[i] = min(lag[0, i, 0], lag[1, i, 0]) - surprise2[i] / beta
        mean_next = 0.0
        for i in range(batch):
            if episodic and ended[chosen[i]]:
                next_value[i] = 0.0
            mean_next += next_value[i] / batch
        # What the actor proposes is worth.
        for c in range(2):
            _forward(weights[c * size_q : (c + 1) * size_q], n_in, h1, h2, 1, proposed, e1[c], e2[c], both[c])
        mean_worth = 0.0
        for i in range(batch):
            worth[i] = min(both[0, i, 0], both[1, i, 0]) - surprise[i] / beta
            mean_worth += worth[i] / batch
        if separate and not episodic:
            numbers[G] += g_rate * (mean_worth - numbers[G])
        g = numbers[G]
        loss, theta, residual = 0.0, 0.0, 0.0
        # The actor: up the lesser Q, whose slope by the action goes through tanh.
        error_actor[:] = f(0.0)
        for c in range(2):
            for i in range(batch):
                least = both[0, i, 0] <= both[1, i, 0]
                error[i, 0] = f(1.0) if least == (c == 0) else f(0.0)
            own = weights[c * size_q : (c + 1) * size_q]
            w1 = own[: n_in * h1].reshape(n_in, h1)
            _backward(own, n_in, h1, h2, 1, proposed, e1[c], e2[c], error, d1, d2, slope[c * size_q : (c + 1) * size_q])
            np.dot(d1, w1.T, into)
            for i in range(batch):
                for j in range(k):
                    error_actor[i, j] += into[i, d + j]
        for i in range(batch):
            for j in range(k):
                t = drawn[i, j]
                by_before = 2.0 * t / beta - error_actor[i, j] * (1.0 - t * t)
                shape = math.tanh(out[i, k + j])
                sd = math.exp(-5.0 + 3.5 * (shape + 1.0))
                by_log_sd = by_before * noise[i, j] * sd - 1.0 / beta
                error_actor[i, j] = by_before / batch
                error_actor[i, k + j] = by_log_sd * 3.5 * (1.0 - shape * shape) / batch
        _backward(actor, d, h1, h2, 2 * k, x, p1, p2, error_actor, d1, d2, slope[at_actor:])
        # Q and V.
        for c in range(2):
            own = weights[c * size_q : (c + 1) * size_q]
            _forward(own, n_in, h1, h2, 1, pair, a1, a2, q)
            for i in range(batch):
                target = reward[chosen[i]] + next_value[i] - (0.0 if separate else g)
                off = target - q[i, 0]
                error[i, 0] = -off / batch
                loss += 0.5 * off * off / batch
                if c == 0 and not separate:
                    theta -= (off + g) / batch
                    residual += abs(off) / batch
            _backward(own, n_in, h1, h2, 1, pair, a1, a2, error, d1, d2, slope[c * size_q : (c + 1) * size_q])
        if separate:
            _forward(weights[at_v:at_actor], d, h1, h2, 1, x, c1, c2, value)
            for i in range(batch):
                h = worth[i] - g
                error[i, 0] = (value[i, 0] - h) / batch
                loss += 0.5 * (value[i, 0] - h) ** 2 / batch
                theta -= (worth[i] - value[i, 0]) / batch
                residual += abs(worth[i] - value[i, 0] - g) / batch
            _backward(weights[at_v:at_actor], d, h1, h2, 1, x, c1, c2, error, d1, d2, slope[at_v:at_actor])
        elif not episodic:
            numbers[G] += g_rate * (mean_next - numbers[G])
        numbers[UPDATES] += 1.0
        t = numbers[UPDATES]
        rate = (lr + (lr_end - lr) * min(1.0, (t - 1.0) / n_total)) / (1.0 - 0.9**t)
        _adam(weights, slope, m, v, np.float32(rate), np.float32(math.sqrt(1.0 - 0.999**t)))
        first = at_v if separate else 0
        for i in range(lagged.size):
            lagged[i] += np.float32(tau) * (weights[first + i] - lagged[i])
        numbers[THETA_SUM] += theta
        numbers[RESIDUAL_SUM] += residual
        numbers[LOSS_SUM] += loss
        numbers[SUMMED] += 1.0
