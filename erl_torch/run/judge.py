"""What a run is held against."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from erl_torch import checks
from erl_torch.checks import InputError
from erl_torch.empirical import reservations
from erl_torch.empirical.counts import EmpiricalMDP
from erl_torch.empirical.uncertainty import Estimate, theta_uncertainty
from erl_torch.evaluation import Judge
from erl_torch.experience.experience import Experience
from erl_torch.mdp.from_gymnasium import ending_states, known_mdp
from erl_torch.mdp.tabular import TabularMDP
from erl_torch.notes import note
from erl_torch.problem import Problem
from erl_torch.solvers.chains import SingularChainError

SMALL = 2000  # states of a model, or that a stream meets, up to which it is solved beside every run


def of_data(
    model: EmpiricalMDP | None, beta: float, prior: np.ndarray, optimism: float = 0.0, reward_noise: str = "mean"
) -> Estimate:
    """theta* with its error, as a stream alone has it; withheld, with a value of NaN, where that cannot be had."""
    if optimism and reward_noise == "joint" and (model is None or model.reward_variance.any()):
        reason = (
            "rewards vary and count together with s' (learner.reward_noise=joint): its error is that of mean rewards"
        )
    elif model is None:
        reason = "the squares of the rewards overflow"
    elif (met := int(model.visits.any(1).sum())) > SMALL:
        reason = f"the stream meets {met:,} states, and more than {SMALL:,} are not solved beside a run"
    else:
        try:
            return theta_uncertainty(model, beta, prior, optimism=optimism)
        except InputError as error:  # streams that return nowhere
            reason = str(error)
        except (SingularChainError, np.linalg.LinAlgError):
            reason = "the chain of the data falls apart in double precision"
    return Estimate("theta", np.nan, np.inf, withheld=reason)


@dataclass(frozen=True)
class EvaluationSettings:
    """What is measured of a policy while it learns.

    Args:
        every: epochs between records, >= 1; milestones and ends are always recorded.
        n_episodes: episodes behind ``eval/return``, >= 1.
        horizon: steps of an evaluated episode, >= 1.
        certify: where the model is known, solve it for the gap of the learnt policy.
        pictures: of policy and reward bias, after each milestone.
        exact_up_to: transitions of a model that figures are exact for, >= 1; beyond, episodes are played.

    Raises:
        InputError: an argument out of its range.
    """

    every: int = 1
    n_episodes: int = 20
    horizon: int = 1000
    certify: bool = True
    pictures: bool = True
    exact_up_to: int = 1_000_000

    def __post_init__(self) -> None:
        for key in ("every", "n_episodes", "horizon", "exact_up_to"):
            checks.at_least(key, getattr(self, key), 1)
        checks.flag("certify", self.certify)
        checks.flag("pictures", self.pictures)
        checks.memory("n_episodes", self.n_episodes, 8 * self.n_episodes, "the returns of all episodes")


class DataJudge:
    """The objective of policies in the model of the counts: what a log alone says of them.

    Args:
        model: counts and mean rewards.
        prior: [S, A].
    """

    def __init__(self, model: EmpiricalMDP, prior: np.ndarray) -> None:
        self._model, self._prior = model, prior
        self._parts: dict[float, tuple[Judge, np.ndarray, np.ndarray] | None] = {}

    def objective(self, policy: np.ndarray, beta: float, *, optimism: float = 0.0) -> float:
        """Of a policy [S, A]; NaN where it takes actions that were never tried, or whose future no tuple tells."""
        if beta not in self._parts:
            self._parts[beta] = self._judge(beta)
        found = self._parts[beta]
        if found is None:
            return np.nan
        judge, states, used = found
        taken = policy[states]
        if (taken[~used] > 0).any():
            return np.nan
        return judge.objective(taken, beta, optimism=optimism)

    def _judge(self, beta: float) -> tuple[Judge, np.ndarray, np.ndarray] | None:
        try:
            empirical = self._model.problem(beta, self._prior)
        except InputError:  # a stream that returns nowhere
            return None
        problem = empirical.problem
        if len(problem.states) > SMALL:
            return None
        used = empirical.used[problem.states]
        rows = sp.diags_array(used.ravel().astype(np.float64)) @ problem.transition
        mdp = TabularMDP(rows, np.where(used, problem.reward, 0.0), problem.start, allowed=used)
        return Judge(mdp, problem.prior, 1), problem.states, used


def data_judge(data: Experience, prior: np.ndarray) -> DataJudge | None:
    """Of a stream; None where the squares of its rewards overflow."""
    model = reservations.count(data, prior.shape[0], prior.shape[1], False).model
    return None if model is None else DataJudge(model, prior)


def judging_model(problem: Problem, settings: EvaluationSettings) -> TabularMDP | None:
    """The model that policies of ``problem`` are judged by; None, with a note, where it is large."""
    if problem.mdp is None or problem.mdp.transition.nnz <= settings.exact_up_to:
        return problem.mdp
    note("a large model (evaluation.exact_up_to): episodes are played instead")
    return None


def episode_model(problem: Problem) -> TabularMDP | None:
    """The model whose rewards over the horizon are an episode's return; None where there is none."""
    env = problem.env
    if env is None:
        return problem.episode
    endless = known_mdp(env) is not None and not ending_states(env, problem.n_states).any()
    return problem.episode or (problem.mdp if endless else None)
