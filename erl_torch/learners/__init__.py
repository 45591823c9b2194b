"""Learners: ``fit(transitions, n_states, n_actions) -> Solution``, ``iterate(...)`` yields every epoch.

What a learner asks of its stream it declares: ``averages_exp_reward`` (noise in r counts as reward) and
``drawn_from_prior`` (the column that must be draws from the prior policy: "a", "a_next", or "").

``Exact`` solves a model instead: ``solve(mdp)``, ``iterate(mdp)``.
"""

import functools
import importlib
from typing import TYPE_CHECKING, Any

import yaml

from erl_torch import configurations
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
from erl_torch.learners.certainty_equivalence import CertaintyEquivalence
from erl_torch.learners.efficient_s1.algorithm import EfficientS1, EfficientState, OnlineState
from erl_torch.learners.exact import Exact, ExactState
from erl_torch.learners.learner import NonFiniteError
from erl_torch.learners.s1.algorithm import AlgorithmS1, ListedS1, S1State

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


@functools.cache
def by_name() -> dict[str, Any]:
    """The classes of the learners of tables that ``conf/learner`` has, by the name of their configuration."""
    classes = {}
    for name in configurations.names("learner"):
        path = configurations.folder() / "learner" / f"{name}.yaml"
        module, _, attribute = yaml.safe_load(path.read_text())["class"].rpartition(".")
        if not module.startswith("erl_torch.networks."):
            classes[name] = getattr(importlib.import_module(module), attribute)
    return classes


if TYPE_CHECKING:
    LEARNERS: dict[str, Any]


def __getattr__(name: str) -> object:
    if name == "LEARNERS":
        return by_name()
    raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
