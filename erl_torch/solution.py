"""What every learner returns."""

from __future__ import annotations

import enum
import os
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from decimal import ROUND_CEILING, ROUND_FLOOR, Context, Decimal
from pathlib import Path
from typing import Any

import numpy as np
import torch

from erl_torch.checks import InputError
from erl_torch.files import read_npz, write_npz


class Status(enum.Enum):
    """How a run ended; the value says what to do next."""

    COMPLETED = "all passes made; the steps are constant, so judge convergence by theta of the last biasing iterations"
    CONVERGED = "the certificate is as narrow as asked for"
    STEP_LIMIT = "max_steps met before tol: raise max_steps; the bounds hold as they stand"
    STAGNATED = (
        "rounding, or a nearly closed set of states, ends progress above tol; the bounds hold as they stand. "
        "Raise tol or lower beta"
    )
    REDUCIBLE = "the states that the start leads to are not one recurrent class; the message names them"
    STOPPED = "stopped by the caller before the last pass; the tables are those of the last full epoch"
    PSI_LIMIT = "the psi phase met max_psi_epochs before psi_tol: raise max_psi_epochs or lr_psi"
    UNCERTIFIED = "the certificate is wider than asked for, as the message says; the bound holds as it stands"
    NON_FINITE = "a table left the positive finite numbers; the tables are those of the last good epoch"


def proven(bounds: tuple[float, float], gap: float | None) -> str:
    """Bounds on theta* and on a policy's loss as text, rounded away from what they enclose."""
    low, high = _rounded(bounds[0], 10, ROUND_FLOOR), _rounded(bounds[1], 10, ROUND_CEILING)
    loss = "" if gap is None else f"; objective at most {_rounded(gap, 2, ROUND_CEILING)} below its maximum"
    return f"theta* in [{low}, {high}]{loss}"


def _rounded(x: float, digits: int, way: str) -> str:
    if not np.isfinite(x):
        return f"{x:g}"
    return f"{float(Context(prec=digits, rounding=way).create_decimal(Decimal(x))):.{digits}g}"


@dataclass(frozen=True, eq=False, kw_only=True)
class Solution:
    """A policy with the tables and the record behind it (symbols as in ``erl_torch.learners.algorithm_s1``).

    ``history`` has one array a logged quantity, one entry an epoch. theta and rho are None where the learner
    estimates neither (discounted learners); bounds, gap and k where they are not known.
    """

    policy: torch.Tensor  # [S, A], rows sum to 1
    u: torch.Tensor  # [S, A] > 0, mean 1; 0 or infinite beyond double precision, where ``log_u`` is not
    psi: torch.Tensor  # [S] > 0, 1 / sum_a prior(a|s) u(s,a); likewise, ``log_psi``
    rho: float | None = None
    theta: float | None = None  # reward a step; -theta is the regularised reward rate
    reward_bias: torch.Tensor  # [S, A] >= 0, reward a step
    reward_bias_max: float
    n_steps: int  # tuples streamed through the u updates
    status: Status
    message: str = ""  # where and why, if the run failed
    history: Mapping[str, np.ndarray] = field(default_factory=dict)
    beta: float | None = None
    value: torch.Tensor | None = None  # V(s), [S], reward, up to a constant; exact solvers
    action_value: torch.Tensor | None = None  # Q(s,a), [S, A], with the same constant
    theta_bounds: tuple[float, float] | None = None  # two-sided, on theta*; where the model is known
    gap: float | None = None  # at least -theta* - J(policy), reward a step; where the model is known
    k: int | None = None  # biasing iterations as the paper's Table S1 counts them

    @property
    def log_u(self) -> torch.Tensor:
        """log u(s,a), [S, A], up to a constant: finite also where u itself leaves double precision."""
        if self.action_value is not None and self.beta is not None:
            return self.beta * self.action_value
        return self.u.log()

    @property
    def log_psi(self) -> torch.Tensor:
        """log psi(s), [S], up to a constant: finite also where psi itself leaves double precision."""
        if self.value is not None and self.beta is not None:
            return -self.beta * self.value
        return self.psi.log()

    def value_functions(self, n_steps: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
        """(Q [S, A], V [S]) of equations (1) and (2) for trajectories of ``n_steps``; reward, up to a constant.

        Q = -theta N + log(u)/beta, V = -theta N + log(sum_a prior u)/beta.
        """
        if self.theta is None and n_steps:
            raise ValueError("value_functions needs theta, which this solution does not carry")
        total = self.theta * n_steps if self.theta is not None else 0.0
        if self.action_value is not None and self.value is not None:
            return self.action_value - total, self.value - total
        if self.beta is None:
            raise ValueError("value_functions needs beta, which this solution does not carry")
        return self.u.log() / self.beta - total, -self.psi.log() / self.beta - total

    @classmethod
    def of_action_values(
        cls, q: torch.Tensor, prior_policy: torch.Tensor, beta: float, theta: float | None, **others: Any
    ) -> Solution:
        """The solution of the policy ~ prior exp(beta q), q [S, A], with V = (1/beta) log sum_a prior exp(beta q).

        Both are shifted so that their maximum is 0; ``others`` are fields as they stand.
        """
        logits = beta * q + prior_policy.log()
        value = logits.logsumexp(1) / beta
        shift = torch.maximum(q.max(), value.max())
        q, value = q - shift, value - shift
        return cls(
            policy=torch.softmax(logits, 1),
            u=(beta * q).exp(),
            psi=(-beta * value).exp(),
            rho=None if theta is None else float(np.exp(np.clip(-beta * theta, -700, 700))),
            theta=theta,
            reward_bias=torch.zeros_like(q),
            reward_bias_max=0.0,
            beta=beta,
            value=value,
            action_value=q,
            **others,
        )

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write everything to an npz file; the history's arrays are named ``history/...``."""
        return write_npz(path, self.arrays())

    def arrays(self, history: bool = True) -> dict[str, np.ndarray]:
        """Everything by name, as ``save`` writes it."""
        found: dict[str, Any] = {}
        for item in fields(self):
            value = getattr(self, item.name)
            if item.name == "history":
                found |= {f"history/{name}": values for name, values in value.items()} if history else {}
            elif isinstance(value, torch.Tensor):
                found[item.name] = value.detach().cpu().numpy()
            elif value is not None:
                found[item.name] = value.name if isinstance(value, Status) else value
        return {name: np.asarray(value) for name, value in found.items()}

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Solution:
        """Read what ``save`` wrote. Raises InputError naming the file."""
        return cls.of_arrays(read_npz(path), path)

    @classmethod
    def of_arrays(cls, arrays: Mapping[str, np.ndarray], path: str | os.PathLike[str]) -> Solution:
        """The solution of ``arrays``, read from ``path``. Raises InputError naming the file."""
        values: dict[str, Any] = {"history": {}}
        try:
            for name, array in arrays.items():
                if name.startswith("history/"):
                    values["history"][name.removeprefix("history/")] = array
                elif name == "theta_bounds":
                    values[name] = (float(array[0]), float(array[1]))
                elif array.ndim:
                    values[name] = torch.from_numpy(array)
                else:
                    values[name] = array.item()
            return cls(**(values | {"status": Status[values["status"]]}))
        except (IndexError, KeyError, TypeError, ValueError) as error:
            raise InputError("path", path, f"a solution as Solution.save writes it ({error})") from error
