"""``Solution``: what every learner and solver returns."""

from __future__ import annotations

import enum
import math
import os
from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, field, fields
from decimal import ROUND_CEILING, ROUND_FLOOR, Context, Decimal
from pathlib import Path
from typing import Any

import numpy as np
import torch

from erl_torch import checks
from erl_torch.checks import InputError
from erl_torch.files import read_npz, write_npz
from erl_torch.labels import Labels
from erl_torch.mdp.tabular import check_policy

LABELS = "state_labels", "action_labels"
NO_NAN: checks.Entries = (lambda x: ~np.isnan(x), "a number")


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
    NO_SINGLE_RATE = (
        "no single rate was found for all starts, as may happen below optimism 0; the bounds hold for every start"
    )
    ILL_POSED = "a way round that never ends pays more than ending; the message names it"
    STOPPED = "stopped by the caller before the last pass; the tables are those of the last full epoch"
    PSI_LIMIT = "the psi phase met max_psi_epochs before psi_tol: raise max_psi_epochs or lr_psi"
    UNCERTIFIED = "the certificate is wider than asked for, as the message says; the bound holds as it stands"
    NON_FINITE = "a table left the positive finite numbers; the tables are those of the last good epoch"


def proven(bounds: tuple[float, float], gap: float | None) -> str:
    """Bounds on theta* and on a policy's loss as text, rounded outwards."""
    low, high = _rounded(bounds[0], 10, ROUND_FLOOR), _rounded(bounds[1], 10, ROUND_CEILING)
    loss = "" if gap is None else f"; objective at most {_rounded(gap, 2, ROUND_CEILING)} below its maximum"
    return f"theta* in [{low}, {high}]{loss}"


def _rounded(x: float, digits: int, way: str) -> str:
    if not np.isfinite(x):
        return f"{x:g}"
    return f"{float(Context(prec=digits, rounding=way).create_decimal(Decimal(x))):.{digits}g}"


@dataclass(frozen=True, eq=False, kw_only=True)
class Solution:
    """A policy with the tables and the record behind it (symbols as in ``erl_torch.learners.s1.algorithm``).

    Where the prior is 0 the state does not have the action: policy, u and reward bias are 0 there, Q is -inf.
    ``history`` has one array per logged quantity, one entry per epoch. theta and rho are None where the learner
    estimates neither (discounted learners); bounds, gap and k where they are not known.
    """

    policy: torch.Tensor  # [S, A], rows sum to 1
    u: torch.Tensor  # [S, A] > 0, mean 1; 0 or infinite beyond double precision, where ``log_u`` is not
    psi: torch.Tensor  # [S] > 0, 1 / sum_a prior(a|s) u(s,a); likewise, ``log_psi``
    rho: float | None = None
    theta: float | None = None  # reward per step; -theta is the regularised reward rate
    reward_bias: torch.Tensor  # [S, A] >= 0, reward per step; <= 0 above optimism 1
    reward_bias_max: float
    n_steps: int  # tuples that the u updates used, all epochs together
    status: Status
    message: str = ""  # where and why, if the run failed
    history: Mapping[str, np.ndarray] = field(default_factory=dict)
    beta: float | None = None
    optimism: float = 0.0  # 1 optimistic (control as inference), 0 right, negative robust
    value: torch.Tensor | None = None  # V(s), [S], reward, up to a constant; exact solvers
    action_value: torch.Tensor | None = None  # Q(s,a), [S, A], with the same constant
    theta_bounds: tuple[float, float] | None = None  # two-sided, on theta*; where the model is known
    gap: float | None = None  # at least -theta* - J(policy), reward per step; where the model is known
    k: int | None = None  # biasing iterations as the paper's Table S1 counts them
    state_labels: Labels | None = None  # what the states and actions are called; None: their numbers
    action_labels: Labels | None = None

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

        Raises InputError for ``n_steps`` < 0, or above 0 where the solution has no theta, or no beta.
        """
        n_steps = checks.at_least("n_steps", n_steps, 0)
        if self.theta is None and n_steps:
            raise InputError("n_steps", n_steps, "0: this solution has no theta")
        total = self.theta * n_steps if self.theta is not None else 0.0
        if self.action_value is not None and self.value is not None:
            return self.action_value - total, self.value - total
        if self.beta is None:
            raise InputError("beta", None, "known: this solution has none, so that u has no unit of reward")
        return self.u.log() / self.beta - total, -self.psi.log() / self.beta - total

    # Any: each field has a type of its own.
    @classmethod
    def of_action_values(
        cls, q: torch.Tensor, prior_policy: torch.Tensor, beta: float, theta: float | None, **others: Any
    ) -> Solution:
        """The solution of the policy ~ prior exp(beta q), q [S, A], with V = (1/beta) log sum_a prior exp(beta q).

        Both are shifted so that their maximum is 0; Q is -inf where the prior is 0. ``others`` are fields as they are.
        """
        q = torch.where(prior_policy > 0, q, -torch.inf)
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
        """Every field that is not None by its name, as ``save`` writes it."""
        values: dict[str, Any] = {}
        for item in fields(self):
            value = getattr(self, item.name)
            if item.name == "history":
                values |= {f"history/{name}": curve for name, curve in value.items()} if history else {}
            elif isinstance(value, torch.Tensor):
                values[item.name] = value.detach().cpu().numpy()
            elif isinstance(value, Labels):
                values[item.name] = value.texts
            elif value is not None:
                values[item.name] = value.name if isinstance(value, Status) else value
        return {name: np.asarray(value) for name, value in values.items()}

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Solution:
        """Read what ``save`` wrote. Raises InputError naming the file, and the array that ``save`` would not write."""
        return cls.of_arrays(read_npz(path), path)

    @classmethod
    def of_arrays(cls, arrays: Mapping[str, np.ndarray], path: str | os.PathLike[str]) -> Solution:
        """The solution of ``arrays``, read from ``path``. Raises InputError as ``load``."""
        values: dict[str, Any] = {"history": {}}
        readers = _readers()
        try:
            for name, array in arrays.items():
                if name.startswith("history/"):
                    values["history"][name.removeprefix("history/")] = _curve(name, array)
                elif name in readers:
                    values[name] = readers[name](name, array)
                else:
                    raise InputError(name, f"array of shape {array.shape}", "left out: a Solution has no such array")
            for item in fields(cls):
                if item.name not in values and item.default is MISSING:
                    raise InputError(item.name, None, "there, as Solution.save writes it")
            sizes = values["policy"].shape
            for name, table in values.items():
                if isinstance(table, torch.Tensor) and table.shape != sizes[: table.ndim]:
                    allowed = f"of shape {list(sizes[: table.ndim])}, to go with the policy"
                    raise InputError(name, f"array of shape {tuple(table.shape)}", allowed)
            for name, n in zip(LABELS, sizes, strict=True):
                if values.get(name) is not None and len(values[name]) != n:
                    raise InputError(name, f"{len(values[name])} labels", f"{n} labels, to go with the policy")
        except InputError as error:
            raise error.of_file(path) from error
        return cls(**values)


def _readers() -> dict[str, Callable[[str, np.ndarray], Any]]:
    """By name, the function that turns an array of a saved solution into the field's value."""

    def table(*shape: str) -> Callable[[str, np.ndarray], Any]:
        return lambda name, array: torch.from_numpy(checks.array(name, array, shape, NO_NAN))

    def number(fits: Callable[[float], bool], allowed: str) -> Callable[[str, np.ndarray], float]:
        return lambda name, array: checks.number(name, _single(name, array), fits, allowed)

    def count(name: str, array: np.ndarray) -> int:
        return checks.at_least(name, _single(name, array), 0)

    def policy(name: str, array: np.ndarray) -> torch.Tensor:
        kept = checks.array(name, array, ("n_states", "n_actions"), checks.NOT_NEGATIVE)
        check_policy(name, kept, *kept.shape)
        return torch.from_numpy(kept)

    def status(name: str, array: np.ndarray) -> Status:
        value = _single(name, array)
        checks.one_of(name, value, tuple(Status.__members__))
        return Status[str(value)]

    def message(name: str, array: np.ndarray) -> str:
        value = _single(name, array)
        checks.instance(name, value, str, "text")
        return str(value)

    def bounds(name: str, array: np.ndarray) -> tuple[float, float]:
        low, high = checks.array(name, array, (2,), NO_NAN).tolist()
        if low > high:
            raise InputError(name, (low, high), "in order")
        return low, high

    def labels(name: str, array: np.ndarray) -> Labels:
        if array.ndim != 1 or array.dtype.kind != "U":
            raise InputError(name, f"array of shape {array.shape} and dtype {array.dtype}", "a column of texts")
        return Labels.of_texts(array.tolist())

    pair, state = table("n_states", "n_actions"), table("n_states")
    finite = number(math.isfinite, "a finite number")
    not_negative = number(lambda x: x >= 0, "a number >= 0")
    return {
        "policy": policy, "u": pair, "psi": state, "reward_bias": pair, "value": state, "action_value": pair,
        "rho": not_negative, "theta": finite, "reward_bias_max": finite, "gap": not_negative,
        "beta": number(lambda x: 0 < x < math.inf, "a finite number > 0"), "n_steps": count, "k": count,
        "optimism": finite, "status": status, "message": message, "theta_bounds": bounds,
        "state_labels": labels, "action_labels": labels,
    }  # fmt: skip


def _single(name: str, array: np.ndarray) -> object:
    if array.ndim:
        raise InputError(name, f"array of shape {array.shape}", "a single value")
    value: object = array.item()
    return value


def _curve(name: str, array: np.ndarray) -> np.ndarray:
    if array.ndim == 0 or array.dtype.kind not in checks.REAL_KINDS:
        raise InputError(name, f"array of shape {array.shape} and dtype {array.dtype}", "numbers, one entry per epoch")
    return array
