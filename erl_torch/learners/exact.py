"""The exact solvers as a learner: nothing is learnt from experience, the environment's model is solved.

``method="biasing"`` runs the paper's Algorithm 1, one state per biasing iteration;
``method="soft_bellman"`` soft policy iteration, one state per Newton step (``erl_torch.solvers``).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np
import torch

from erl_torch import checks
from erl_torch.checks import InputError
from erl_torch.experience.experience import Experience
from erl_torch.learners.learner import columns
from erl_torch.log.quantities import Quantity
from erl_torch.mdp.tabular import TabularMDP, check_prior
from erl_torch.problem import Problem
from erl_torch.solution import Solution, Status, proven
from erl_torch.solvers.biasing import KL_TOLERANCE, BiasingState, iterate_biasing, solve_biasing
from erl_torch.solvers.horizons import BellmanState
from erl_torch.solvers.problem import BellmanProblem
from erl_torch.solvers.result import bias, ended, reducible_solution, spread
from erl_torch.solvers.soft_bellman import iterate_soft_bellman, polish, solve_soft_bellman


@dataclass(frozen=True, eq=False)
class ExactState:
    """One iteration, on all states of the MDP."""

    step: int  # biasing iteration, from 1; or Newton steps
    policy: torch.Tensor  # [S, A]
    reward_bias: torch.Tensor  # [S, A]
    theta: float  # -G(V) of a biasing iteration; the middle of the bounds of a Newton step
    theta_bounds: tuple[float, float]
    kl_max: float  # KL(optimal dynamics || p), largest over (s,a), nats; 0 for soft_bellman
    value: np.ndarray  # [n], on the states that the start leads to
    mdp: TabularMDP | None = None  # that is solved

    @property
    def reward_bias_max(self) -> float:
        return float(self.reward_bias.max())

    def metrics(self) -> dict[str, float]:
        """The scalars that are logged, by their documented names (docs/logging.md)."""
        return {
            "theta": self.theta,
            "theta_lower": self.theta_bounds[0],
            "theta_upper": self.theta_bounds[1],
            "delta_max": self.reward_bias_max,
            "delta_mean": float(self.reward_bias.mean()),
            "kl_max": self.kl_max,
        }


@dataclass(frozen=True, eq=False)
class Exact:
    """Solve the environment's model.

    Args:
        beta: inverse temperature, 1/reward, > 0.
        optimism: 1 optimistic (control as inference), 0 right (the paper), negative robust; any number.
        method: "biasing" or "soft_bellman".
        tol: width of the bounds on theta* to stop at, as in ``solve_soft_bellman``.
        max_steps: iterations at most.
        prior_policy: [S, A], 0 where an action is not to be taken; None is uniform over the actions of each state.

    Raises:
        InputError: an argument out of its range.
    """

    unit: ClassVar[str] = "iterations"
    needs_model: ClassVar[bool] = True
    states: ClassVar[tuple[type, ...]] = ()
    quantities: ClassVar[tuple[Quantity, ...]] = ()
    averages_exp_reward: ClassVar[bool] = False
    drawn_from_prior: ClassVar[str] = ""
    reward_noise: ClassVar[str] = "mean"
    assumed_optimism: ClassVar[float | None] = None

    beta: float = 10.0
    optimism: float = field(default=0.0, kw_only=True)
    method: str = "biasing"
    tol: float = 1e-10
    max_steps: int = 200
    prior_policy: torch.Tensor | np.ndarray | None = None

    def __post_init__(self) -> None:
        checks.plain(self)
        checks.temperature("beta", self.beta)
        checks.optimism("optimism", self.optimism, self.beta)
        checks.one_of("method", self.method, ("biasing", "soft_bellman"))
        checks.positive("tol", self.tol)
        checks.at_least("max_steps", self.max_steps, 1)

    def solve(self, mdp: TabularMDP) -> Solution:
        """The solution with its certificate."""
        solve = solve_biasing if self.method == "biasing" else solve_soft_bellman
        given = mdp, self.beta, self.prior_policy
        return solve(*given, tol=self.tol, max_steps=self.max_steps, optimism=self.optimism)

    def init(self, n_states: int, n_actions: int) -> ExactState:
        """The prior policy, before anything is known."""
        prior = check_prior("prior_policy", self.prior_policy, n_states, n_actions)
        nothing = torch.zeros(n_states, n_actions, dtype=torch.float64)
        return ExactState(0, torch.from_numpy(prior), nothing, 1.0, (-np.inf, np.inf), 0.0, np.zeros(0))

    def iterate(self, mdp: TabularMDP) -> Iterator[ExactState]:
        """Yield each iteration until the bounds are within ``tol``."""
        problem = BellmanProblem.of(mdp, self.beta, self.prior_policy, self.optimism)
        prior = check_prior("prior_policy", self.prior_policy, mdp.n_states, mdp.n_actions, mdp.allowed)
        ref = problem.regeneration_state()
        if ref is None or (self.method == "biasing" and len(problem.classes[1]) > 1):
            return

        def full(step: int, state: BiasingState | BellmanState, theta: float, kl_max: float) -> ExactState:
            log_psi = state.log_psi if isinstance(state, BiasingState) else -self.beta * state.value
            return ExactState(
                step=step,
                policy=spread(problem, state.policy, prior),
                reward_bias=spread(problem, bias(problem, log_psi), np.zeros_like(prior)),
                theta=theta,
                theta_bounds=state.theta_bounds,
                kl_max=kl_max,
                value=state.value,
                mdp=mdp,
            )

        if self.method == "soft_bellman":
            for newton in iterate_soft_bellman(problem, ref, self.tol, self.max_steps):
                if newton.step or problem.is_narrow(newton.theta_bounds, self.tol, newton.policy):
                    yield full(newton.step, newton, 0.5 * sum(newton.theta_bounds), 0.0)
            return
        given = mdp, self.beta, self.prior_policy
        for state in iterate_biasing(*given, max_steps=self.max_steps, optimism=self.optimism):
            yield full(state.k + 1, state, state.theta, float(state.kl.max()))
            if problem.is_narrow(state.theta_bounds, self.tol, state.policy):
                return

    def run(
        self, problem: Problem, experience: Experience | None = None, state: ExactState | None = None
    ) -> Iterator[ExactState]:
        """``iterate`` on the model of ``problem``. Raises InputError where there is none."""
        return self.iterate(self._model(problem))

    def start(self, problem: Problem) -> ExactState:
        """``init``, of the model of ``problem``. Raises InputError where there is none."""
        start, mdp = self.init(problem.n_states, problem.n_actions), self._model(problem)
        prior = check_prior("prior_policy", self.prior_policy, mdp.n_states, mdp.n_actions, mdp.allowed)
        return replace(start, policy=torch.from_numpy(prior), mdp=mdp)

    def _model(self, problem: Problem) -> TabularMDP:
        if problem.mdp is None:
            allowed = f"one that learns from experience: no model of {problem.name} is known"
            raise InputError("learner", "exact", allowed)
        return problem.mdp.restricted(problem.prior > 0)

    def position(self, state: ExactState) -> int:
        """Iterations so far."""
        return state.step

    def work(self, state: ExactState) -> int:
        """Iterations so far."""
        return state.step

    def total(self, experience: Experience | None) -> None:
        """Nothing tells."""

    def milestone(self, state: ExactState) -> str:
        """Every iteration is one."""
        return f"biasing iteration {state.step - 1}" if self.method == "biasing" else f"Newton step {state.step}"

    def progress(self, state: ExactState) -> str:
        """theta and its bounds."""
        return f"theta {state.theta:.6f} {proven(state.theta_bounds, None)}"

    def solution(
        self,
        state: ExactState,
        history: Sequence[Mapping[str, float]] = (),
        failure: BaseException | None = None,
    ) -> Solution:
        """The solution that ``state`` (of ``start`` or ``iterate``) stands for; STOPPED with any ``failure``."""
        mdp = state.mdp
        assert mdp is not None
        problem = BellmanProblem.of(mdp, self.beta, self.prior_policy, self.optimism)
        prior = check_prior("prior_policy", self.prior_policy, mdp.n_states, mdp.n_actions, mdp.allowed)
        if not len(state.value):  # no iteration could be made
            none = reducible_solution(mdp, problem, prior)
            return none if failure is None else replace(none, status=Status.STOPPED, message="")
        below = [i for i, row in enumerate(history) if row["kl_max"] < KL_TOLERANCE]
        k = below[0] if below and self.method == "biasing" else None
        value, bounds = state.value, state.theta_bounds
        if failure is None and state.step < self.max_steps:
            value, bounds = polish(problem, value, bounds, self.tol)
        solution = ended(mdp, problem, value, bounds, self.tol, state.step, self.max_steps, prior, k)
        if failure is not None:
            solution = replace(solution, status=Status.STOPPED, message="")
        return replace(solution, history=columns(history))
