"""Entropy-regularised reinforcement learning in MDPs with stochastic dynamics, learnt from experience.

Importing the package registers its Gymnasium environments. Its names load on first use, so that the
import itself stays light. Their types are in ``__init__.pyi``.
"""

from __future__ import annotations

import erl_torch.envs  # noqa: F401  (registers the environments)
from erl_torch.compiled import find_room
from erl_torch.lazy import Renamed, loader

find_room()  # before any module with loops

__version__ = "0.1.0"

_PUBLIC = {
    "checks": "InputError",
    "empirical.counts": "EmpiricalMDP empirical_mdp",
    "empirical.dynamics": "for_dynamics reweighted",
    "empirical.informative": "collect_informative informative_policy",
    "empirical.uncertainty": "Estimate bootstrap_theta policy_uncertainty theta_uncertainty",
    "envs.estimate": "EstimatedModel estimate_mdp",
    "evaluation": "Evaluation evaluate",
    "experience.collect": "collect",
    "experience.experience": "Experience",
    "experience.log": "Log LogReport read_log",
    "experience.recording": "read_experience write_experience",
    "experience.rollouts": "collect_rollouts rollout",
    "experience.simulation": "Simulation",
    "experience.sources": "Source",
    "experience.transitions": "Transitions",
    "inverse.fit": "RewardFit fit_reward",
    "inverse.soft_bellman": "SoftBellman soft_bellman",
    "learners.certainty_equivalence": "CertaintyEquivalence",
    "learners.efficient_s1.algorithm": "EfficientS1",
    "learners.learner": "Learner NonFiniteError State StreamLearner",
    "learners.replicas": "Replicas ReplicaSolution",
    "learners.s1.algorithm": "AlgorithmS1 ListedS1 S1State",
    "labels": "Labels",
    "mdp.from_gymnasium": "MeanRewardWarning model_ends tabular_mdp",
    "mdp.masks": "ActionMasks",
    "mdp.tabular": "TabularMDP",
    "notes": "Note",
    "problem": "Problem",
    "run.judge": "EvaluationSettings",
    "run.session": "train",
    "solution": "Solution Status",
    "solvers": "certify iterate_biasing perron solve_biasing solve_soft_bellman",
    "solvers.charge": "Charge smallest_charge",
    "solvers.dial": "DynamicsInMind Slope dynamics_in_mind slope",
    "solvers.discounted": "solve_discounted",
    "solvers.episodes": "EpisodeFigures evaluate_episodes",
    "solvers.finite_horizon": "solve_finite_horizon",
    "solvers.first_exit": "ExitSolution solve_first_exit",
    "solvers.values": "ValueSolution",
}
_HOME = {name: module for module, names in _PUBLIC.items() for name in names.split()}

_RENAMED = {
    "FileRecording": Renamed("experience.recording", "FileRecording", "erl_torch.read_experience"),
    "Recording": Renamed("experience.experience", "Experience", "erl_torch.Experience"),
    "open_recording": Renamed("experience.recording", "read_experience", "erl_torch.read_experience"),
    "record": Renamed("experience.collect", "record", "erl_torch.collect(..., save_to=DIRECTORY)"),
    "save_columns": Renamed("experience.recording", "write_experience", "erl_torch.write_experience"),
}

__all__ = sorted(_HOME)

__getattr__ = loader(__name__, _HOME, _RENAMED)


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOME])
