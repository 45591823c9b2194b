"""Exact solvers of a finite MDP; each solution carries proven bounds on its error."""

from __future__ import annotations

from typing import TYPE_CHECKING

from erl_torch.lazy import loader

if TYPE_CHECKING:
    from erl_torch.solvers.biasing import BiasingState, iterate_biasing, solve_biasing
    from erl_torch.solvers.eigenpair import PerronPair, perron
    from erl_torch.solvers.soft_bellman import certify, solve_soft_bellman

_HOME = {
    "BiasingState": "biasing",
    "PerronPair": "eigenpair",
    "certify": "soft_bellman",
    "iterate_biasing": "biasing",
    "perron": "eigenpair",
    "solve_biasing": "biasing",
    "solve_soft_bellman": "soft_bellman",
}

__all__ = [
    "BiasingState",
    "PerronPair",
    "certify",
    "iterate_biasing",
    "perron",
    "solve_biasing",
    "solve_soft_bellman",
]

__getattr__ = loader(__name__, _HOME)
