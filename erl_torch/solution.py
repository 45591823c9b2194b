"""What every learner returns."""

from __future__ import annotations

import enum
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from erl_torch.files import read_npz, write_npz


class Status(enum.Enum):
    """How a run ended; the value says what to do next."""

    COMPLETED = (
        "all passes made; the steps are constant, so judge convergence by theta of the last biasing iterations"
    )
    STOPPED = "stopped by the caller before the last pass; the tables are those of the last full epoch"
    PSI_LIMIT = "the psi phase met max_psi_epochs before psi_tol: raise max_psi_epochs or lr_psi"
    NON_FINITE = "a table left the positive finite numbers; the tables are those of the last good epoch"


@dataclass(frozen=True, eq=False)
class Solution:
    """A policy with the tables and the record behind it (symbols as in ``erl_torch.learners.algorithm_s1``).

    ``history`` has one array a logged quantity, one entry an epoch.
    """

    policy: torch.Tensor  # [S, A], rows sum to 1
    u: torch.Tensor  # [S, A] > 0, mean 1
    psi: torch.Tensor  # [S] > 0, 1 / sum_a prior(a|s) u(s,a)
    rho: float
    theta: float  # reward a step; -theta is the regularised reward rate
    reward_bias: torch.Tensor  # [S, A] >= 0, reward a step
    reward_bias_max: float
    n_steps: int  # tuples streamed through the u updates
    status: Status
    message: str = ""  # where and why, if the run failed
    history: Mapping[str, np.ndarray] = field(default_factory=dict)

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write everything to an npz file; the history's arrays are named ``history/...``."""
        tables = {
            "policy": self.policy,
            "u": self.u,
            "psi": self.psi,
            "reward_bias": self.reward_bias,
        }
        arrays = {name: np.asarray(table.detach().cpu()) for name, table in tables.items()}
        scalars = {
            "rho": self.rho,
            "theta": self.theta,
            "reward_bias_max": self.reward_bias_max,
            "n_steps": self.n_steps,
            "status": self.status.name,
            "message": self.message,
        }
        history = {f"history/{name}": values for name, values in self.history.items()}
        return write_npz(path, arrays | scalars | history)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Solution:
        """Read what ``save`` wrote. Raises InputError naming the file."""
        arrays = read_npz(path)
        tables = {name: torch.from_numpy(arrays[name]) for name in ("policy", "u", "psi", "reward_bias")}
        return cls(
            **tables,
            rho=float(arrays["rho"]),
            theta=float(arrays["theta"]),
            reward_bias_max=float(arrays["reward_bias_max"]),
            n_steps=int(arrays["n_steps"]),
            status=Status[str(arrays["status"])],
            message=str(arrays["message"]),
            history={k.removeprefix("history/"): v for k, v in arrays.items() if k.startswith("history/")},
        )
