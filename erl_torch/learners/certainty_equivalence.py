"""Certainty equivalence: count, then solve the empirical model exactly. The yardstick of every tabular learner.

Objective: the average reward minus KL(pi || prior)/beta, that of Algorithm S1; not optimistic, unless ``optimism`` says
so: then (1/kappa) log E exp(kappa V(s')) stands in the place of E V, kappa = optimism * beta. The optimum is over the
visited pairs of the class of states that the stream shows (``erl_torch.empirical.counts``); states outside keep
the prior. The policy's loss in the true MDP, g* - J, falls as 1/tuples: it is what the data allow.

The action a' of the stream is not used, and the stream may come from any behaviour policy.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np
import torch

from erl_torch import checks
from erl_torch.checks import InputError
from erl_torch.empirical.counts import NOISE, EmpiricalMDP, EmpiricalProblem, empirical_mdp, joint
from erl_torch.experience.experience import Experience
from erl_torch.learners.learner import StreamLearner, columns, message
from erl_torch.mdp.tabular import check_policy, check_prior
from erl_torch.solution import Solution, Status, proven
from erl_torch.solvers.soft_bellman import solve_problem


@dataclass(frozen=True, eq=False)
class CertaintyEquivalenceState:
    """Before (epoch 0) and after (epoch 1) the solution of the empirical model."""

    epoch: int
    n_tuples: int  # counted
    beta: float
    prior_policy: torch.Tensor  # [S, A]
    policy: torch.Tensor  # [S, A]; 0 on pairs never visited, the prior in states outside the empirical problem
    u: torch.Tensor  # [S, A], largest 1; 0 on pairs never visited, or with prior 0
    rho: float
    theta: float  # middle of the bounds on the empirical theta*; of the closed set where the model is reducible
    reward_bias: torch.Tensor  # [S, A]
    empirical_width: float  # of those bounds, reward a step
    answer: Solution | None = None

    @property
    def reward_bias_max(self) -> float:
        return float(self.reward_bias.max())

    def metrics(self) -> dict[str, float]:
        """The scalars that are logged, by their documented names (docs/logging.md)."""
        return {
            "rho": self.rho,
            "theta": self.theta,
            "delta_max": self.reward_bias_max,
            "delta_mean": float(self.reward_bias.mean()),
            "empirical_width": self.empirical_width,
            "epoch": self.epoch,
            "n_tuples": self.n_tuples,
        }


@dataclass(frozen=True, eq=False)
class CertaintyEquivalenceStream:
    """A stream as its sufficient statistics."""

    model: EmpiricalMDP
    empirical: EmpiricalProblem
    n_tuples: int


@dataclass(frozen=True, eq=False)
class CertaintyEquivalence(StreamLearner[CertaintyEquivalenceState, CertaintyEquivalenceStream]):
    """Counts -> empirical model -> soft policy iteration.

    Args:
        beta: inverse temperature, 1/reward, > 0.
        optimism: 1 optimistic (control as inference), 0 right (the paper), negative robust; any number.
        tol: width of the bounds on the empirical theta* to stop at, relative to the range of the rewards.
        max_steps: Newton steps at most.
        prior_policy: [S, A], 0 where an action is not to be taken; None is uniform.
        reward_noise: "mean": r(s,a) is the mean reward. "joint": rewards that vary for the same (s,a) count together
            with s', as in ``erl_torch.empirical.counts.joint``; the same at optimism 0.

    Raises:
        InputError: an argument out of its range.
    """

    states: ClassVar[tuple[type, ...]] = (CertaintyEquivalenceState,)
    stream_bytes: ClassVar[int] = 1  # counts alone
    takes_weights: ClassVar[bool] = True

    beta: float = 10.0
    optimism: float = field(default=0.0, kw_only=True)
    tol: float = 1e-10
    max_steps: int = 200
    prior_policy: torch.Tensor | np.ndarray | None = None
    reward_noise: str = "mean"

    def __post_init__(self) -> None:
        checks.plain(self)
        checks.temperature("beta", self.beta)
        checks.optimism("optimism", self.optimism, self.beta)
        checks.one_of("reward_noise", self.reward_noise, NOISE)
        checks.positive("tol", self.tol)
        checks.at_least("max_steps", self.max_steps, 1)

    def fit(self, transitions: Experience, n_states: int, n_actions: int) -> Solution:
        """Count and solve. Status REDUCIBLE, with a message, where the states that the stream shows are not one
        recurrent class; theta is then that of the closed set of states (of several, the most visited). NO_SINGLE_RATE,
        below optimism 0, where the data have none: then there is no theta."""
        return super().fit(transitions, n_states, n_actions)

    def solve(self, model: EmpiricalMDP) -> Solution:
        """The solution of counts that there are already, of ``empirical_mdp`` or ``for_dynamics``; as ``fit``."""
        checks.instance("model", model, EmpiricalMDP, "an EmpiricalMDP, as of empirical_mdp")
        if self.reward_noise == "joint" and self.optimism:
            raise InputError("reward_noise", "joint", "mean where the tuples themselves are not there")
        empirical = model.problem(self.beta, self.prior_policy, optimism=self.optimism)
        stream = CertaintyEquivalenceStream(model, empirical, int(model.visits.sum()))
        return self.solution(self.step(self.init(model.n_states, model.n_actions), stream))

    def finished(self, state: CertaintyEquivalenceState) -> bool:
        """Once solved."""
        return state.answer is not None

    def init(self, n_states: int, n_actions: int) -> CertaintyEquivalenceState:
        """The prior policy, before any tuple."""
        prior = torch.from_numpy(check_prior("prior_policy", self.prior_policy, n_states, n_actions))
        zero, one = torch.zeros_like(prior), (prior > 0).double()
        return CertaintyEquivalenceState(0, 0, self.beta, prior, prior, one, 1.0, 0.0, zero, math.inf)

    def prepare(self, transitions: Experience, n_states: int, n_actions: int) -> CertaintyEquivalenceStream:
        """Count. Raises InputError for tuples out of range, or a stream that never returns to any state."""
        model = empirical_mdp(transitions, n_states, n_actions)
        if self.reward_noise == "joint":
            model = joint(model, transitions, self.optimism * self.beta)
        empirical = model.problem(self.beta, self.prior_policy, optimism=self.optimism)
        return CertaintyEquivalenceStream(model, empirical, len(transitions))

    def step(self, state: CertaintyEquivalenceState, stream: CertaintyEquivalenceStream) -> CertaintyEquivalenceState:
        """Solve. Pure: ``state`` is left as it is."""
        part = stream.empirical
        answer = solve_problem(part.problem, stream.model, self.prior_policy, self.tol, self.max_steps)
        assert answer.theta_bounds is not None
        lower, upper = answer.theta_bounds
        theta, message, status = answer.theta, part.message, Status.REDUCIBLE if part.reducible else answer.status
        if answer.status is Status.NO_SINGLE_RATE:
            message = "; ".join(filter(None, (part.message, answer.message, proven((lower, upper), None))))
        elif theta is None:  # states are left for ever in the data, where other states may be better
            ending = solve_problem(part.problem.ending(), stream.model, None, self.tol, self.max_steps)
            theta, told = ending.theta, "theta is that of the closed set"
            if theta is None:  # nor has the closed set a single rate
                assert ending.theta_bounds is not None
                status, told = ending.status, proven(ending.theta_bounds, None)
            message = "; ".join(filter(None, (part.message, answer.message, told)))
        elif answer.status is not Status.CONVERGED:
            message = "; ".join(
                filter(None, (part.message, answer.message, f"in the data, {proven((lower, upper), None)}"))
            )
        estimate = 0.5 * (lower + upper) if theta is None else theta
        with np.errstate(over="ignore", under="ignore"):
            rho = float(np.exp(-self.beta * (estimate + answer.reward_bias_max))) if answer.rho is None else answer.rho
        known = torch.from_numpy(part.used | ~part.used.any(1, keepdims=True))
        reward_bias = answer.reward_bias
        if self.prior_policy is not None:  # actions that a state lacks have none
            prior = check_policy("prior_policy", self.prior_policy, *reward_bias.shape)
            reward_bias = reward_bias * torch.from_numpy(prior > 0)
        answer = replace(
            answer,
            u=answer.u * known,
            reward_bias=reward_bias,
            theta=theta,
            rho=None if theta is None else rho,
            theta_bounds=None,  # what is proven of the empirical model is not proven of the true one
            gap=None,
            n_steps=stream.n_tuples,
            status=status,
            message=message,
        )
        return replace(
            state,
            epoch=1,
            n_tuples=stream.n_tuples,
            policy=answer.policy,
            u=answer.u,
            rho=rho,
            theta=estimate,
            reward_bias=reward_bias,
            empirical_width=upper - lower,
            answer=answer,
        )

    def solution(
        self,
        state: CertaintyEquivalenceState,
        history: Sequence[Mapping[str, float]] = (),
        failure: BaseException | None = None,
    ) -> Solution:
        """The solution that ``state`` stands for."""
        answer = state.answer or Solution(
            policy=state.policy,
            u=state.u,
            psi=torch.ones(len(state.u), dtype=torch.float64),
            rho=state.rho,
            theta=state.theta,
            reward_bias=state.reward_bias,
            reward_bias_max=0.0,
            n_steps=0,
            status=self.ended(state, failure),
            message=message(failure),
            beta=self.beta,
            optimism=self.optimism,
        )
        return replace(answer, history=columns(history))
