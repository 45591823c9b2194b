"""Exact solvers of a finite MDP, each answer with a proof of how good it is."""

from erl_torch.solvers.biasing import BiasingState, iterate_biasing, solve_biasing
from erl_torch.solvers.eigenpair import PerronPair, perron
from erl_torch.solvers.soft_bellman import certify, solve_soft_bellman

__all__ = [
    "BiasingState",
    "PerronPair",
    "certify",
    "iterate_biasing",
    "perron",
    "solve_biasing",
    "solve_soft_bellman",
]
