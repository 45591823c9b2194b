"""Lines 9-11 of Algorithm S1 for many replicas in torch operations, on any device: the twin of ``kernels.lanes_epoch``.

A tuple is a dozen operations on vectors of length R, whatever R: on the CPU worth it for nobody (the compiled loop is
faster at any R), on a CUDA device from many thousands of replicas on. Equal to the compiled loop to rounding.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

Rows = Callable[[int, int], tuple[np.ndarray, np.ndarray, "np.ndarray | None"]]
CHUNK = 1 << 20  # table entries of a chunk of tuples on the device


def u_phase(
    rows: Rows,
    begin: int,
    end: int,
    g: np.ndarray,
    z: np.ndarray,
    q: np.ndarray,
    rates: tuple[np.ndarray, np.ndarray, np.ndarray],
    new: bool,
    rescale_every: int,
    failed: np.ndarray,
    device: str,
) -> None:
    """Tuples begin..end; z, q and failed change in place, as in ``kernels.lanes_epoch``.

    Args:
        rows: (pair, pair_next, factor) of tuples i..j, [j - i, R] each; factor None where rewards do not vary.
        g, z: [n_pairs * R], the replicas of a pair side by side.
        q: 1/rho, [R].
        rates: lr_u, lr_rho, smallest 1/rho, [R] each.
    """
    n = q.size
    lane = torch.arange(n, device=device)
    gain_of, z_now, q_now = (torch.tensor(x, device=device) for x in (g, z, q))
    lr_u, lr_rho, q_min = (torch.tensor(rate, device=device) for rate in rates)
    keep, keep_rho = 1 - lr_u, 1 - lr_rho
    both = keep_rho * lr_u + lr_rho
    bad = torch.tensor(failed, device=device)
    chunk = max(1, CHUNK // n)
    t = begin
    while t < end:
        stretch_end = min(end, t - t % rescale_every + rescale_every)
        z_before, q_before = z_now.clone(), q_now
        for first in range(t, stretch_end, chunk):
            pair, pair_next, factor = rows(first, min(first + chunk, stretch_end))
            here = torch.tensor(pair, device=device, dtype=torch.int64) * n + lane
            there = torch.tensor(pair_next, device=device, dtype=torch.int64) * n + lane
            gain = gain_of[here]
            if factor is not None:
                gain = gain * torch.tensor(factor, device=device)
            loops = (here == there) if new else torch.zeros(len(here), 1, dtype=torch.bool)
            any_loop = loops.any(1).tolist()
            for i in range(len(here)):
                k = here[i]
                w = gain[i] * z_now[there[i]]
                kept = keep * z_now[k]
                z_new = torch.addcmul(kept, lr_u * w, q_now)
                q_new = q_now * (z_new / torch.addcmul(keep_rho * kept, both * w, q_now))
                if any_loop[i]:  # line 11 sees the new u
                    alone = q_now / torch.addcmul(keep_rho, lr_rho * gain[i], q_now)
                    q_new = torch.where(loops[i], alone, q_new)
                z_now[k] = z_new
                q_now = torch.maximum(q_new, q_min)  # keeps NaN
        table = z_now.view(-1, n)
        good = (torch.isfinite(table) & (table > 0)) | (gain_of.view(-1, n) < 0)  # g < 0: no pair, z is 0
        healthy = good.all(0) & torch.isfinite(q_now) & (q_now > 0)
        bad = torch.where(~healthy & (bad < 0), t, bad)
        table = torch.where(healthy, table, z_before.view(-1, n))
        q_now = torch.where(healthy, q_now, q_before)
        if stretch_end % rescale_every == 0:
            # A power of two: no bit changes.
            table = torch.ldexp(table, -torch.frexp(table.mean(0)).exponent)
        z_now = table.reshape(-1)
        t = stretch_end
    z[:], q[:], failed[:] = z_now.cpu().numpy(), q_now.cpu().numpy(), bad.cpu().numpy()
