"""Learners with networks for actions in a box: an actor beside the critics.

The prior is uniform in the box. A normal distribution squashed into it stands in for the policy ~ exp(beta Q), of which
it falls short by KL(actor || policy)/beta a step.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, ClassVar

import numpy as np
import torch

from erl_torch.checks import InputError
from erl_torch.networks import kernels
from erl_torch.networks.layout import Layout, mlp
from erl_torch.networks.learner import DeepS1, NetworkLearner
from erl_torch.networks.policy import ActorPolicy
from erl_torch.networks.problem import BoxProblem
from erl_torch.networks.replay import COLUMNS, Replay


@dataclass(frozen=True, eq=False, kw_only=True)
class ActorCritic(NetworkLearner):
    """What both have: two networks of Q, the lesser counts, and the actor's. Settings as of ``NetworkLearner``."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for key in ("optimism", "support_penalty"):
            if getattr(self, key):
                raise InputError(key, getattr(self, key), "0, for actions in a box")
        if not self.compiled:
            raise InputError("hidden", list(self.hidden), "two hidden layers, on the CPU, for actions in a box")

    @property
    def compiled(self) -> bool:
        return len(self.hidden) == 2 and self.device == "cpu" and self.path != "autograd"

    def check(self, problem: BoxProblem) -> None:
        if not problem.low:
            raise InputError("learner", type(self).__name__, "deep_s1 or asql, for Discrete actions")

    def critic(self, problem: BoxProblem) -> Layout:
        """Of each Q: its input is the observation and the action in (-1, 1)^k."""
        return mlp(problem.n_observation + len(problem.low), self.hidden, 1)

    def actor(self, problem: BoxProblem) -> Layout:
        """Its output is mean [k] and the measure of log sd [k]."""
        return mlp(problem.n_observation, self.hidden, 2 * len(problem.low))

    def layouts(self, problem: BoxProblem) -> tuple[Layout, Layout | None]:
        return self.critic(problem), mlp(problem.n_observation, self.hidden, 1) if self.separate else None

    def _start(self, problem: BoxProblem, rng: np.random.Generator) -> tuple[np.ndarray, slice]:
        q, v = self.layouts(problem)
        parts = [q.start(rng), q.start(rng)]
        if v is not None:
            parts.append(v.start(rng, zero_output=True))
        parts.append(self.actor(problem).start(rng))
        copied = slice(0, 2 * q.size) if v is None else slice(2 * q.size, 2 * q.size + v.size)
        return np.concatenate(parts), copied

    def _policy(self, problem: BoxProblem, weights: torch.Tensor) -> Any:  # another kind than of NetworkLearner
        layout = self.actor(problem)
        return ActorPolicy(layout, weights[-layout.size :], problem.low, problem.high)

    def _updates(
        self, problem: BoxProblem, replay: Replay, weights: torch.Tensor, lagged: torch.Tensor, m: torch.Tensor,
        v: torch.Tensor, numbers: np.ndarray, random: np.ndarray, n_total: int,
    ) -> Any:  # fmt: skip
        arrays = [x.numpy() for x in (weights, lagged, m, v)]
        fixed = [getattr(replay, name) for name in COLUMNS]
        draws = random.view(np.uint64)
        low, high = np.array(problem.low, np.float32), np.array(problem.high, np.float32)
        tail = (
            *self.hidden, self.batch, self.separate, float(self.scaled_beta), (low + high) / 2, (high - low) / 2,
            float(self.lr), self.lr * self.lr_end_fraction, n_total, float(self.tau), float(self.g_rate),
            self.on_termination == "episodic",
        )  # fmt: skip

        def update(stored: int, n: int) -> None:
            kernels.advance_actor(*arrays, numbers, draws, *fixed, stored, n, *tail)

        return update

    def _chooser(self, problem: BoxProblem, weights: torch.Tensor) -> Any:
        policy = self._policy(problem, weights)
        return lambda observation, uniform: policy.draw(observation, uniform[None])[0][0]

    def _told(
        self, problem: BoxProblem, weights: torch.Tensor, observation: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray | None]:
        policy, (q, v) = self._policy(problem, weights), self.layouts(problem)
        uniform = np.random.default_rng(0).random((len(observation), len(problem.low)))
        action, surprise = policy.draw(observation, uniform)
        if v is None:
            return surprise, None
        low, high = np.array(problem.low), np.array(problem.high)
        inside = ((action - (low + high) / 2) / ((high - low) / 2)).astype(np.float32)
        pair = torch.from_numpy(np.concatenate([observation, inside], 1))
        least = torch.minimum(*(q.output(weights[c * q.size : (c + 1) * q.size], pair)[:, 0] for c in range(2)))
        value = v.output(weights[2 * q.size : 2 * q.size + v.size], torch.from_numpy(observation))[:, 0]
        return surprise, (least - value).double().numpy() - surprise / self.scaled_beta


@dataclass(frozen=True, eq=False, kw_only=True)
class ActorCriticS1(ActorCritic):
    """S1 with an actor (S1-AC): Q fits r + V(s') of a lagged V; V the lesser Q less log(pi/prior)/beta less g."""

    separate: ClassVar[bool] = True


@dataclass(frozen=True, eq=False, kw_only=True)
class AverageActorCritic(ActorCritic):
    """Average-reward soft actor-critic (ASAC): Q fits r - g + V(s') of its lagged copies and the actor."""

    separate: ClassVar[bool] = False


def suited(learner: NetworkLearner, problem: BoxProblem) -> NetworkLearner:
    """``learner``, or where it is ``DeepS1`` and actions are in a box ``ActorCriticS1`` with its settings."""
    if isinstance(learner, DeepS1) and problem.low:
        return ActorCriticS1(**{field.name: getattr(learner, field.name) for field in fields(learner)})
    return learner
