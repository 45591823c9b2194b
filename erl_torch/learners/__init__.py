"""Learners: ``fit(transitions, n_states, n_actions) -> Solution``, ``iterate(...)`` yields every epoch.

``Exact`` solves a model instead: ``solve(mdp)``, ``iterate(mdp)``.
"""

from typing import Any

from erl_torch.learners.algorithm_s1 import AlgorithmS1, NonFiniteError, S1State
from erl_torch.learners.exact import Exact, ExactState

LEARNERS: dict[str, Any] = {"s1": AlgorithmS1, "exact": Exact}

__all__ = ["LEARNERS", "AlgorithmS1", "Exact", "ExactState", "NonFiniteError", "S1State"]
