"""What there is to learn where observations, and perhaps actions, are continuous."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import gymnasium as gym
import numpy as np

from erl_torch.checks import InputError

Environment = gym.Env[Any, Any]


class Truth(Protocol):
    """What judges a policy exactly, where a model of the environment is known; ``optimum`` is that of the best one."""

    optimum: dict[str, float]

    def figures(self, probabilities: Callable[[np.ndarray], np.ndarray]) -> dict[str, float]:
        """By name: "objective", "loss_of_policy", "kl_to_optimal" and others, of the policy that gives the
        ``probabilities`` [N, A] at observations [N, d]."""

    def picture(self, policy: Any) -> np.ndarray:  # a NetworkPolicy, which is defined above
        """Of the policy beside the best one, [H, W, 3] uint8."""


@dataclass(frozen=True, eq=False)
class BoxProblem:
    """An environment with observations in a Box.

    Args:
        make: gives a fresh environment without a time limit, the same each time.
        n_observation: numbers of an observation, flattened.
        n_actions: of a Discrete space; 0 where actions are continuous.
        first_action: of the Discrete space: what the environment calls action 0.
        low, high: [k] of continuous actions; empty of discrete ones.
        time_limit: steps of an episode at most; None is none.
        end_reward: added to the reward of a step that terminates an episode: a charge < 0, or a bonus > 0.
        name: what messages and pictures call it.
    """

    make: Callable[[], Environment]
    n_observation: int
    n_actions: int
    first_action: int = 0
    low: tuple[float, ...] = ()
    high: tuple[float, ...] = ()
    time_limit: int | None = None
    end_reward: float = 0.0
    name: str = "the environment"


def spaces(env: Environment, name: str) -> tuple[int, int, int, tuple[float, ...], tuple[float, ...]]:
    """(n_observation, n_actions, first_action, low, high) of ``env``. Raises InputError, of ``env``."""
    observation, action = env.observation_space, env.action_space
    if not isinstance(observation, gym.spaces.Box):
        raise InputError(
            "env", name, f"one with observations in a Box, for learners with networks (they are in {observation})"
        )
    size = int(np.prod(observation.shape))
    if size < 1:
        raise InputError("env", name, f"one with at least one number in an observation (it is {observation})")
    if isinstance(action, gym.spaces.Discrete):
        return size, int(action.n), int(action.start), (), ()
    if isinstance(action, gym.spaces.Box) and np.isfinite(action.low).all() and np.isfinite(action.high).all():
        return size, 0, 0, tuple(map(float, action.low.ravel())), tuple(map(float, action.high.ravel()))
    raise InputError("env", name, f"one with actions in a Discrete space or a bounded Box (they are in {action})")
