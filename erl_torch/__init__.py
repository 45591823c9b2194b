"""Entropy-regularised reinforcement learning in MDPs with stochastic dynamics, learnt from experience.

Importing the package registers its Gymnasium environments. Its names load on first use, so that the
import itself stays light.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import erl_torch.envs  # noqa: F401  (registers the environments)
from erl_torch.lazy import Renamed, loader

if TYPE_CHECKING:
    from erl_torch.checks import InputError
    from erl_torch.empirical.counts import EmpiricalMDP, empirical_mdp
    from erl_torch.empirical.uncertainty import Estimate, bootstrap_theta, policy_uncertainty, theta_uncertainty
    from erl_torch.envs.estimate import EstimatedModel, estimate_mdp
    from erl_torch.evaluation import Evaluation, evaluate
    from erl_torch.experience.collect import collect
    from erl_torch.experience.experience import Experience
    from erl_torch.experience.recording import read_experience, write_experience
    from erl_torch.experience.rollouts import collect_rollouts, rollout
    from erl_torch.experience.simulation import Simulation
    from erl_torch.experience.transitions import Transitions
    from erl_torch.learners.certainty_equivalence import CertaintyEquivalence
    from erl_torch.learners.efficient_s1.algorithm import EfficientS1
    from erl_torch.learners.learner import NonFiniteError
    from erl_torch.learners.replicas import Replicas, ReplicaSolution
    from erl_torch.learners.s1.algorithm import AlgorithmS1, ListedS1, S1State
    from erl_torch.mdp.from_gymnasium import MeanRewardWarning, tabular_mdp
    from erl_torch.mdp.tabular import TabularMDP
    from erl_torch.notes import Note
    from erl_torch.solution import Solution, Status
    from erl_torch.solvers import certify, iterate_biasing, perron, solve_biasing, solve_soft_bellman

__version__ = "0.1.0"

_HOME = {
    "AlgorithmS1": "learners.s1.algorithm",
    "EstimatedModel": "envs.estimate",
    "CertaintyEquivalence": "learners.certainty_equivalence",
    "EfficientS1": "learners.efficient_s1.algorithm",
    "EmpiricalMDP": "empirical.counts",
    "Estimate": "empirical.uncertainty",
    "Experience": "experience.experience",
    "Evaluation": "evaluation",
    "InputError": "checks",
    "ListedS1": "learners.s1.algorithm",
    "MeanRewardWarning": "mdp.from_gymnasium",
    "NonFiniteError": "learners.learner",
    "Note": "notes",
    "ReplicaSolution": "learners.replicas",
    "Replicas": "learners.replicas",
    "S1State": "learners.s1.algorithm",
    "Simulation": "experience.simulation",
    "Solution": "solution",
    "bootstrap_theta": "empirical.uncertainty",
    "certify": "solvers",
    "iterate_biasing": "solvers",
    "perron": "solvers",
    "policy_uncertainty": "empirical.uncertainty",
    "solve_biasing": "solvers",
    "solve_soft_bellman": "solvers",
    "Status": "solution",
    "TabularMDP": "mdp.tabular",
    "Transitions": "experience.transitions",
    "collect": "experience.collect",
    "read_experience": "experience.recording",
    "write_experience": "experience.recording",
    "collect_rollouts": "experience.rollouts",
    "estimate_mdp": "envs.estimate",
    "evaluate": "evaluation",
    "tabular_mdp": "mdp.from_gymnasium",
    "rollout": "experience.rollouts",
    "empirical_mdp": "empirical.counts",
    "theta_uncertainty": "empirical.uncertainty",
}

_RENAMED = {
    "FileRecording": Renamed("experience.recording", "FileRecording", "erl_torch.read_experience"),
    "Recording": Renamed("experience.experience", "Experience", "erl_torch.Experience"),
    "open_recording": Renamed("experience.recording", "read_experience", "erl_torch.read_experience"),
    "record": Renamed("experience.collect", "record", "erl_torch.collect(..., save_to=DIRECTORY)"),
    "save_columns": Renamed("experience.recording", "write_experience", "erl_torch.write_experience"),
}

__all__ = [
    "AlgorithmS1",
    "CertaintyEquivalence",
    "EfficientS1",
    "EmpiricalMDP",
    "Estimate",
    "EstimatedModel",
    "Evaluation",
    "Experience",
    "InputError",
    "ListedS1",
    "MeanRewardWarning",
    "NonFiniteError",
    "Note",
    "ReplicaSolution",
    "Replicas",
    "S1State",
    "Simulation",
    "Solution",
    "Status",
    "TabularMDP",
    "Transitions",
    "bootstrap_theta",
    "certify",
    "collect",
    "collect_rollouts",
    "empirical_mdp",
    "estimate_mdp",
    "evaluate",
    "iterate_biasing",
    "perron",
    "policy_uncertainty",
    "read_experience",
    "rollout",
    "solve_biasing",
    "solve_soft_bellman",
    "tabular_mdp",
    "theta_uncertainty",
    "write_experience",
]


__getattr__ = loader(__name__, _HOME, _RENAMED)


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOME])
