"""Types of the names that ``erl_torch`` loads on first use."""

from erl_torch.checks import InputError as InputError
from erl_torch.empirical.counts import EmpiricalMDP as EmpiricalMDP
from erl_torch.empirical.counts import empirical_mdp as empirical_mdp
from erl_torch.empirical.informative import collect_informative as collect_informative
from erl_torch.empirical.informative import informative_policy as informative_policy
from erl_torch.empirical.uncertainty import Estimate as Estimate
from erl_torch.empirical.uncertainty import bootstrap_theta as bootstrap_theta
from erl_torch.empirical.uncertainty import policy_uncertainty as policy_uncertainty
from erl_torch.empirical.uncertainty import theta_uncertainty as theta_uncertainty
from erl_torch.envs.estimate import EstimatedModel as EstimatedModel
from erl_torch.envs.estimate import estimate_mdp as estimate_mdp
from erl_torch.evaluation import Evaluation as Evaluation
from erl_torch.evaluation import evaluate as evaluate
from erl_torch.experience.collect import collect as collect
from erl_torch.experience.experience import Experience as Experience
from erl_torch.experience.log import Log as Log
from erl_torch.experience.log import LogReport as LogReport
from erl_torch.experience.log import read_log as read_log
from erl_torch.experience.recording import read_experience as read_experience
from erl_torch.experience.recording import write_experience as write_experience
from erl_torch.experience.rollouts import collect_rollouts as collect_rollouts
from erl_torch.experience.rollouts import rollout as rollout
from erl_torch.experience.simulation import Simulation as Simulation
from erl_torch.experience.sources import Source as Source
from erl_torch.experience.transitions import Transitions as Transitions
from erl_torch.inverse.fit import RewardFit as RewardFit
from erl_torch.inverse.fit import fit_reward as fit_reward
from erl_torch.inverse.soft_bellman import SoftBellman as SoftBellman
from erl_torch.inverse.soft_bellman import soft_bellman as soft_bellman
from erl_torch.labels import Labels as Labels
from erl_torch.learners.certainty_equivalence import CertaintyEquivalence as CertaintyEquivalence
from erl_torch.learners.efficient_s1.algorithm import EfficientS1 as EfficientS1
from erl_torch.learners.learner import Learner as Learner
from erl_torch.learners.learner import NonFiniteError as NonFiniteError
from erl_torch.learners.learner import State as State
from erl_torch.learners.learner import StreamLearner as StreamLearner
from erl_torch.learners.replicas import Replicas as Replicas
from erl_torch.learners.replicas import ReplicaSolution as ReplicaSolution
from erl_torch.learners.s1.algorithm import AlgorithmS1 as AlgorithmS1
from erl_torch.learners.s1.algorithm import ListedS1 as ListedS1
from erl_torch.learners.s1.algorithm import S1State as S1State
from erl_torch.mdp.from_gymnasium import MeanRewardWarning as MeanRewardWarning
from erl_torch.mdp.from_gymnasium import model_ends as model_ends
from erl_torch.mdp.from_gymnasium import tabular_mdp as tabular_mdp
from erl_torch.mdp.masks import ActionMasks as ActionMasks
from erl_torch.mdp.tabular import TabularMDP as TabularMDP
from erl_torch.notes import Note as Note
from erl_torch.problem import Problem as Problem
from erl_torch.run.judge import EvaluationSettings as EvaluationSettings
from erl_torch.run.session import train as train
from erl_torch.solution import Solution as Solution
from erl_torch.solution import Status as Status
from erl_torch.solvers import certify as certify
from erl_torch.solvers import iterate_biasing as iterate_biasing
from erl_torch.solvers import perron as perron
from erl_torch.solvers import solve_biasing as solve_biasing
from erl_torch.solvers import solve_soft_bellman as solve_soft_bellman
from erl_torch.solvers.charge import Charge as Charge
from erl_torch.solvers.charge import smallest_charge as smallest_charge
from erl_torch.solvers.dial import DynamicsInMind as DynamicsInMind
from erl_torch.solvers.dial import Slope as Slope
from erl_torch.solvers.dial import dynamics_in_mind as dynamics_in_mind
from erl_torch.solvers.dial import slope as slope
from erl_torch.solvers.discounted import solve_discounted as solve_discounted
from erl_torch.solvers.episodes import EpisodeFigures as EpisodeFigures
from erl_torch.solvers.episodes import evaluate_episodes as evaluate_episodes
from erl_torch.solvers.finite_horizon import solve_finite_horizon as solve_finite_horizon
from erl_torch.solvers.first_exit import ExitSolution as ExitSolution
from erl_torch.solvers.first_exit import solve_first_exit as solve_first_exit
from erl_torch.solvers.values import ValueSolution as ValueSolution

__version__: str
__all__: list[str]

def __getattr__(name: str) -> object: ...  # older names, with a DeprecationWarning
