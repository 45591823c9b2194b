"""Learners: ``fit(transitions, n_states, n_actions) -> Solution``, ``iterate(...)`` yields every epoch.

What a learner asks of its stream it declares: ``averages_exp_reward`` (noise in r counts as reward) and
``drawn_from_prior`` (the column that must be draws from the prior policy: "a", "a_next", or "").

``Exact`` solves a model instead: ``solve(mdp)``, ``iterate(mdp)``.
"""

from typing import Any

from erl_torch.learners.action_value.q_learning import (
    ActionValueState,
    DifferentialSoftQ,
    QLearning,
    RVISoftQ,
    Sarsa,
    SoftQ,
    ULearning,
)
from erl_torch.learners.action_value.z_learning import ZLearning
from erl_torch.learners.certainty_equivalence import CertaintyEquivalence, CertaintyEquivalenceState
from erl_torch.learners.efficient_s1.algorithm import EfficientS1, EfficientState, OnlineState
from erl_torch.learners.exact import Exact, ExactState
from erl_torch.learners.learner import NonFiniteError
from erl_torch.learners.s1.algorithm import AlgorithmS1, ListedS1, S1State

LEARNERS: dict[str, Any] = {
    "s1": AlgorithmS1,
    "s1_listing": ListedS1,
    "differential_soft_q": DifferentialSoftQ,
    "rvi_soft_q": RVISoftQ,
    "u_learning": ULearning,
    "z_learning": ZLearning,
    "soft_q": SoftQ,
    "q_learning": QLearning,
    "sarsa": Sarsa,
    "s1_efficient": EfficientS1,
    "certainty_equivalence": CertaintyEquivalence,
    "exact": Exact,
}


def states() -> tuple[type, ...]:
    """All classes that states of learners are made of: what a checkpoint may hold."""
    from erl_torch.evaluation import Evaluation
    from erl_torch.learners.action_value.z_learning import ZState
    from erl_torch.learners.replicas import EachState
    from erl_torch.learners.s1.lanes import LanesState
    from erl_torch.solution import Solution, Status

    return (
        ActionValueState,
        CertaintyEquivalenceState,
        EachState,
        EfficientState,
        Evaluation,
        LanesState,
        NonFiniteError,
        S1State,
        Solution,
        Status,
        ZState,
    )


__all__ = [
    "LEARNERS",
    "ActionValueState",
    "AlgorithmS1",
    "CertaintyEquivalence",
    "DifferentialSoftQ",
    "EfficientS1",
    "EfficientState",
    "Exact",
    "ExactState",
    "ListedS1",
    "NonFiniteError",
    "OnlineState",
    "QLearning",
    "RVISoftQ",
    "S1State",
    "Sarsa",
    "SoftQ",
    "ULearning",
    "ZLearning",
]
