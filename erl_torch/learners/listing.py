"""Algorithm S1's two inner loops as the listing has them: the slow twin of ``erl_torch.kernels``.

One tuple at a time, direct form, nothing rearranged. Tables are anything indexed as ``u[s, a]``: torch
tensors on any device, or NumPy views of them (thirty times faster on the CPU, same doubles).
"""

from __future__ import annotations

import math
from typing import Any

from erl_torch.transitions import Transitions


def psi_epoch(data: Transitions, psi: Any, log_psi: Any, mean_psi: Any, mean_log_psi: Any, lr_psi: float) -> None:
    """Lines 2-3 over the whole stream; mean_psi and mean_log_psi [S, A] change in place."""
    for s, a, s_next in zip(data.s.tolist(), data.a.tolist(), data.s_next.tolist(), strict=True):
        mean_psi[s, a] = (1 - lr_psi) * mean_psi[s, a] + lr_psi * psi[s_next]  # line 2
        mean_log_psi[s, a] = (1 - lr_psi) * mean_log_psi[s, a] + lr_psi * log_psi[s_next]  # line 3


def u_epoch(
    data: Transitions,
    psi: Any,
    mean_psi: Any,
    reward_bias: Any,
    reward_bias_max: float,
    u: Any,
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
