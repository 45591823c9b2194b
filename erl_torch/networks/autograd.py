"""The updates of ``kernels.advance`` in plain torch: their test, and the way of wide networks and other devices."""

from __future__ import annotations

import math

import numpy as np
import torch

from erl_torch.networks.kernels import LOSS_SUM, RESIDUAL_SUM, SUMMED, THETA_SUM, UPDATES, G
from erl_torch.networks.layout import Layout

GAMMA, FIRST, SECOND = (np.uint64(x) for x in (0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB))


def drawn(random: np.ndarray, size: int, n: int) -> np.ndarray:
    """The next ``size`` places in [0, n), as ``kernels.advance`` draws them; ``random`` [1] uint64 goes on."""
    with np.errstate(over="ignore"):
        z = random[0] + GAMMA * np.arange(1, size + 1, dtype=np.uint64)
        random[0] = z[-1]
        z = (z ^ (z >> np.uint64(30))) * FIRST
        z = (z ^ (z >> np.uint64(27))) * SECOND
        z = z ^ (z >> np.uint64(31))
    return np.asarray((z >> np.uint64(11)) * (1.0 / 9007199254740992.0) * n).astype(np.int64)


def advance(
    q_layout: Layout,
    v_layout: Layout | None,
    weights: torch.Tensor,
    lagged: torch.Tensor,
    m: torch.Tensor,
    v: torch.Tensor,
    numbers: np.ndarray,
    random: np.ndarray,
    columns: tuple[torch.Tensor, ...],
    n: int,
    n_updates: int,
    batch: int,
    beta: float,
    kappa: float,
    log_prior: torch.Tensor,
    lr: float,
    lr_end: float,
    n_total: int,
    tau: float,
    g_rate: float,
    penalty: float,
    episodic: bool,
    limit: float,
) -> None:
    """As ``kernels.advance``, with the layouts of Q and V (None: no network of V) in the place of sizes, and the five
    columns of tuples in one."""
    observation, action, reward, following, ended = columns
    separate, size_q = v_layout is not None, q_layout.size
    prior = log_prior.to(weights.dtype)
    for _ in range(n_updates):
        chosen = torch.from_numpy(drawn(random, batch, n)).to(weights.device)
        x, x2, r = observation[chosen], following[chosen], reward[chosen]
        k = action[chosen].long()[:, None]
        with torch.no_grad():
            after = (v_layout or q_layout).output(lagged, x2)
            after = after[:, 0] if separate else torch.logsumexp(prior + beta * after, 1) / beta
            if episodic:
                after = torch.where(ended[chosen], 0.0, after)
        p = weights.clone().requires_grad_()
        q = q_layout.output(p[:size_q], x)
        with torch.no_grad():
            soft = torch.logsumexp(prior + beta * q, 1) / beta
            if separate and not episodic:
                numbers[G] += g_rate * (float(soft.mean()) - numbers[G])
            g = float(numbers[G])
            target = r + after - (0.0 if separate else g)
        off = target - q.gather(1, k)[:, 0]
        if kappa:
            slope = -(torch.exp((kappa * off.detach()).clamp(max=limit)) - 1) / kappa
            loss = (slope * q.gather(1, k)[:, 0]).mean()
        else:
            loss = 0.5 * (off**2).mean()
        if penalty:
            loss = loss + penalty * (torch.logsumexp(prior + beta * q, 1) / beta - q.gather(1, k)[:, 0]).mean()
        told = float(0.5 * (off.detach() ** 2).mean())
        if v_layout is not None:
            value = v_layout.output(p[size_q:], x)[:, 0]
            fit = 0.5 * ((value - (soft - g)) ** 2).mean()
            loss, told = loss + fit, told + float(fit.detach())
            residual = soft - value.detach()
            theta, size = -float(residual.mean()), float((residual - g).abs().mean())
        else:
            theta, size = -float((target + g - q.detach().gather(1, k)[:, 0]).mean()), float(off.detach().abs().mean())
            if not episodic:
                numbers[G] += g_rate * (float(after.mean()) - numbers[G])
        (slope,) = torch.autograd.grad(loss, p)
        numbers[UPDATES] += 1.0
        t = numbers[UPDATES]
        rate = (lr + (lr_end - lr) * min(1.0, (t - 1.0) / n_total)) / (1.0 - 0.9**t)
        m += 0.1 * (slope - m)
        v += 0.001 * (slope**2 - v)
        weights -= rate * m / (v.sqrt() / math.sqrt(1.0 - 0.999**t) + 1e-8)
        lagged += tau * (weights[size_q if separate else 0 :] - lagged)
        for place, value_of in ((THETA_SUM, theta), (RESIDUAL_SUM, size), (LOSS_SUM, told), (SUMMED, 1.0)):
            numbers[place] += value_of
