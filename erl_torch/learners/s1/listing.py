"""Algorithm S1's inner loops as the listing has them: the slow twins of the kernels beside it.

One tuple at a time, direct form, nothing rearranged. Tables are anything indexed as ``u[s, a]``: torch
tensors on any device, or NumPy views of them (thirty times faster on the CPU, same doubles).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from erl_torch.experience.transitions import Transitions

Table = Any  # torch.Tensor or np.ndarray: arithmetic of items of either has no type that mypy can say


def psi_epoch(
    data: Transitions, psi: Table, log_psi: Table, mean_psi: Table, mean_log_psi: Table, lr_psi: float
) -> None:
    """Lines 2-3 over the whole stream; mean_psi and mean_log_psi [S, A] change in place.

    Where optimism is not 0, psi^(1-optimism) and psi^(-optimism) stand for psi and log psi.
    """
    for s, a, s_next in zip(data.s.tolist(), data.a.tolist(), data.s_next.tolist(), strict=True):
        mean_psi[s, a] = (1 - lr_psi) * mean_psi[s, a] + lr_psi * psi[s_next]  # line 2
        mean_log_psi[s, a] = (1 - lr_psi) * mean_log_psi[s, a] + lr_psi * log_psi[s_next]  # line 3


def u_epoch(
    data: Transitions,
    psi: Table,
    mean_psi: Table,
    reward_bias: Table,
    reward_bias_max: float,
    u: Table,
    rho: float,
    *,
    beta: float,
    lr_u: float,
    lr_rho: float,
    rho_max: float,
    self_loop: str,
    rescale_every: int,
) -> tuple[float, int]:
    """Lines 9-11 over the whole stream; u [S, A] changes in place.

    Where optimism is not 0, psi^(1-optimism) and its mean stand for psi and mean_psi.

    Returns (rho, t): t = N, or the first tuple whose update is not a positive finite number.
    """
    columns = (data.s, data.a, data.r, data.s_next, data.a_next)
    for t, (s, a, r, s_next, a_next) in enumerate(zip(*(c.tolist() for c in columns), strict=True)):
        b = psi[s_next] / mean_psi[s, a]  # line 4
        biased_reward = r + float(reward_bias[s, a]) - reward_bias_max  # line 9
        weight = math.exp(beta * biased_reward)
        u_next = float(u[s_next, a_next])
        u[s, a] = (1 - lr_u) * u[s, a] + lr_u * weight / rho * u_next * b  # line 10
        if self_loop == "new":
            u_next = float(u[s_next, a_next])
        if not (math.isfinite(u[s, a]) and u[s, a] > 0):
            return rho, t
        rho = float((1 - lr_rho) * rho + lr_rho * weight * u_next / u[s, a] * b)  # line 11
        rho = min(rho, rho_max)
        if not (math.isfinite(rho) and rho > 0):
            return rho, t
        if (t + 1) % rescale_every == 0:
            u /= u.mean()
    return rho, len(data)


def efficient_epoch(
    data: Transitions,
    psi: Table,
    mean_psi: Table,
    reward_bias: Table,
    reward_bias_max: float,
    u: Table,
    rho: float,
    *,
    beta: float,
    steps: Table,
    visits: Table,
    lr_rho: float,
    rho_max: float,
    weight: Table,
    expected: bool,
    reward: Table = None,
    total: Table = None,
) -> float:
    """Lines 9-11 with EfficientS1's options; u, visits and total (sum of psi u over visits) change in place.

    ``reward`` [S, A] replaces the tuples' own; ``expected`` takes sum_a weight u(s',a) for u(s',a'). Returns rho.
    """
    columns = (data.s, data.a, data.r, data.s_next, data.a_next)
    for s, a, r, s_next, a_next in zip(*(c.tolist() for c in columns), strict=True):
        b = psi[s_next] / mean_psi[s, a]
        biased_reward = (r if reward is None else reward[s, a]) + reward_bias[s, a] - reward_bias_max
        gain = math.exp(beta * biased_reward) * b
        u_next = weight[s_next] @ u[s_next] if expected else u[s_next, a_next]
        step = steps[min(visits[s, a], len(steps) - 1)]
        visits[s, a] += 1
        u[s, a] = (1 - step) * u[s, a] + step * gain / rho * u_next
        if not expected:
            u_next = u[s_next, a_next]
        rho = min((1 - lr_rho) * rho + lr_rho * gain * u_next / u[s, a], rho_max)
        if total is not None:
            total[s, a] += psi[s] * u[s, a]
    return float(rho)


def online_phase(
    data: Transitions,
    value: Table,
    sums: Table,
    z: Table,
    weight: Table,
    rho: float,
    *,
    beta: float,
    prior: Table,
    steps: Table,
    lr_rho: float,
    rho_max: float,
) -> tuple[float, float]:
    """One phase of the online mode. ``sums`` [3, S, A]: visits, sum of V(s'), sum of r so far. Returns rho, rho_max."""
    fresh = np.zeros(z.shape, int)
    for s, a, r, s_next in zip(data.s.tolist(), data.a.tolist(), data.r.tolist(), data.s_next.tolist(), strict=True):
        sums[:, s, a] += (1, value[s_next], r)
        weight[s] = np.where(sums[0, s] > 0, prior[s], 0.0)
        n, sum_value, sum_reward = sums[:, s, a]
        w = math.exp(beta * ((sum_reward + sum_value) / n - value[s])) * (weight[s_next] @ z[s_next])
        step = steps[min(fresh[s, a], len(steps) - 1)]
        fresh[s, a] += 1
        z[s, a] = (1 - step) * z[s, a] + step * w / rho
        rho_max = max(rho_max, math.exp(beta * r))
        rho = min((1 - lr_rho) * rho + lr_rho * w / z[s, a], rho_max)
    return float(rho), rho_max
