"""Learners: ``fit(transitions, n_states, n_actions) -> Solution``, ``iterate(...)`` yields every epoch.

``Exact`` solves a model instead: ``solve(mdp)``, ``iterate(mdp)``.
"""

from typing import Any

from erl_torch.learners.algorithm_s1 import AlgorithmS1, NonFiniteError, S1State
from erl_torch.learners.certainty_equivalence import CertaintyEquivalence
from erl_torch.learners.efficient_s1 import EfficientS1, EfficientState
from erl_torch.learners.exact import Exact, ExactState

LEARNERS: dict[str, Any] = {
    "s1": AlgorithmS1,
    "s1_efficient": EfficientS1,
    "certainty_equivalence": CertaintyEquivalence,
    "exact": Exact,
}

__all__ = [
    "LEARNERS",
    "AlgorithmS1",
    "CertaintyEquivalence",
    "EfficientS1",
    "EfficientState",
    "Exact",
    "ExactState",
    "NonFiniteError",
    "S1State",
]
