"""Types of the names that ``erl_torch`` loads on first use."""

from erl_torch.checks import InputError as InputError
from erl_torch.empirical.counts import EmpiricalMDP as EmpiricalMDP, empirical_mdp as empirical_mdp
from erl_torch.empirical.uncertainty import Estimate as Estimate, bootstrap_theta as bootstrap_theta, policy_uncertainty as policy_uncertainty, theta_uncertainty as theta_uncertainty
from erl_torch.envs.estimate import EstimatedModel as EstimatedModel, estimate_mdp as estimate_mdp
from erl_torch.evaluation import Evaluation as Evaluation, evaluate as evaluate
from erl_torch.experience.collect import collect as collect
from erl_torch.experience.experience import Experience as Experience
from erl_torch.experience.recording import read_experience as read_experience, write_experience as write_experience
from erl_torch.experience.rollouts import collect_rollouts as collect_rollouts, rollout as rollout
from erl_torch.experience.simulation import Simulation as Simulation
from erl_torch.experience.sources import Source as Source
from erl_torch.experience.transitions import Transitions as Transitions
from erl_torch.learners.certainty_equivalence import CertaintyEquivalence as CertaintyEquivalence
from erl_torch.learners.efficient_s1.algorithm import EfficientS1 as EfficientS1
from erl_torch.learners.learner import Learner as Learner, NonFiniteError as NonFiniteError, State as State, StreamLearner as StreamLearner
from erl_torch.learners.replicas import Replicas as Replicas, ReplicaSolution as ReplicaSolution
from erl_torch.learners.s1.algorithm import AlgorithmS1 as AlgorithmS1, ListedS1 as ListedS1, S1State as S1State
from erl_torch.mdp.from_gymnasium import MeanRewardWarning as MeanRewardWarning, tabular_mdp as tabular_mdp
from erl_torch.mdp.tabular import TabularMDP as TabularMDP
from erl_torch.notes import Note as Note
from erl_torch.problem import Policy as Policy, Problem as Problem
from erl_torch.run.judge import EvaluationSettings as EvaluationSettings
from erl_torch.run.session import train as train
from erl_torch.solution import Solution as Solution, Status as Status
from erl_torch.solvers import certify as certify, iterate_biasing as iterate_biasing, perron as perron, solve_biasing as solve_biasing, solve_soft_bellman as solve_soft_bellman

__version__: str
