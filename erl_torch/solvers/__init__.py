"""Exact solvers of a finite MDP; each solution carries proven bounds on its error."""

from __future__ import annotations

from typing import TYPE_CHECKING

from erl_torch.lazy import loader

if TYPE_CHECKING:
    from erl_torch.solvers.biasing import BiasingState, iterate_biasing, solve_biasing
    from erl_torch.solvers.discounted import solve_discounted
    from erl_torch.solvers.eigenpair import PerronPair, perron
    from erl_torch.solvers.episodes import EpisodeFigures, evaluate_episodes
    from erl_torch.solvers.finite_horizon import solve_finite_horizon
    from erl_torch.solvers.first_exit import ExitSolution, solve_first_exit
    from erl_torch.solvers.soft_bellman import certify, solve_soft_bellman
    from erl_torch.solvers.values import ValueSolution

_HOME = {
    "BiasingState": "biasing",
    "EpisodeFigures": "episodes",
    "ExitSolution": "first_exit",
    "PerronPair": "eigenpair",
    "ValueSolution": "values",
    "certify": "soft_bellman",
    "evaluate_episodes": "episodes",
    "iterate_biasing": "biasing",
    "perron": "eigenpair",
    "solve_biasing": "biasing",
    "solve_discounted": "discounted",
    "solve_finite_horizon": "finite_horizon",
    "solve_first_exit": "first_exit",
    "solve_soft_bellman": "soft_bellman",
}

__all__ = [
    "BiasingState",
    "EpisodeFigures",
    "ExitSolution",
    "PerronPair",
    "ValueSolution",
    "certify",
    "evaluate_episodes",
    "iterate_biasing",
    "perron",
    "solve_biasing",
    "solve_discounted",
    "solve_finite_horizon",
    "solve_first_exit",
    "solve_soft_bellman",
]

__getattr__ = loader(__name__, _HOME)
