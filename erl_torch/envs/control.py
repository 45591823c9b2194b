"""Classic control with binned states: the code that the tasks share.

A ``ControlTask`` holds the dynamics of one of Gymnasium's environments as pure functions over tensors, so that many
states step at once on any device. ``ControlEnv`` wraps Gymnasium's own environment of the task in Discrete spaces.
``erl_torch.envs.estimate`` turns a task into a TabularMDP, ``erl_torch.experience.rollouts`` plays episodes in the
original dynamics.

A state tensor is [N, d], float64; contiguous columns (``torch.stack(columns).T``) are the fastest.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import gymnasium as gym
import numpy as np
import torch
from gymnasium.core import RenderFrame

from erl_torch import checks
from erl_torch.checks import InputError
from erl_torch.envs import CONTROL_TASKS
from erl_torch.envs.discretise import Discretise, UniformBins

REWARDS = ("original", "cyclic")


class Step(NamedTuple):
    """The outcome of one step from each of N states."""

    state: torch.Tensor  # [N, d]
    reward: torch.Tensor  # [N], Gymnasium's
    terminated: torch.Tensor  # [N] bool


@dataclass(frozen=True)
class ControlTask:
    """One of Gymnasium's classic control environments, batched.

    Args:
        name: its key in ``erl_torch.envs.CONTROL_TASKS``.
        gymnasium_id: the original.
        bins, low, high: default bins of ``variables``.
        actions: default values of the actions.
        max_action: the largest |value| that the original takes; None where its actions are fixed.
        beta: inverse temperature in the paper's Table S2.
        reset_low, reset_high: the first state is uniform in this box.
        step: (states [N, d], action values [N]) -> Step, equal to the original's ``env.step``.
        instant_reward: (states [N, d], their Step) -> reward [N] of the paper's model, which has no episodes.
        variables: states [N, d] -> the variables that are binned, [N, d].
        features: one observation of the original -> the variables that are binned, [d]; None where they are the same.
        reset_dtype: precision in which the original draws its first state.
        max_reward: the largest reward of a step in the original.
    """

    name: str
    gymnasium_id: str
    bins: tuple[int, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    actions: tuple[float, ...]
    max_action: float | None
    beta: float
    reset_low: tuple[float, ...]
    reset_high: tuple[float, ...]
    step: Callable[[torch.Tensor, torch.Tensor], Step]
    instant_reward: Callable[[torch.Tensor, Step], torch.Tensor]
    variables: Callable[[torch.Tensor], torch.Tensor]
    features: Callable[[np.ndarray], np.ndarray] | None = None
    reset_dtype: torch.dtype = torch.float64
    max_reward: float = 0.0

    def initial(self, n: int, rng: np.random.Generator) -> torch.Tensor:
        """[n, d] first states, as the original draws them."""
        draws = rng.uniform(self.reset_low, self.reset_high, (n, len(self.reset_low)))
        return torch.from_numpy(draws).to(self.reset_dtype).double()

    def uniform_bins(
        self,
        bins: int | Sequence[int] | None = None,
        low: Sequence[float] | None = None,
        high: Sequence[float] | None = None,
    ) -> UniformBins:
        """Bins of these numbers and bounds; None is the task's own. Raises InputError as ``UniformBins`` does."""
        d = len(self.bins)
        numbers = [bins] * d if bins is not None and np.ndim(bins) == 0 else bins
        sizes = self.bins if numbers is None else checks.sequence("bins", numbers)
        first, last = (
            own if given is None else tuple(checks.array(key, given, (d,)).tolist())
            for key, given, own in (("low", low, self.low), ("high", high, self.high))
        )
        if len(sizes) != d:
            raise InputError("bins", list(sizes), f"a whole number or {d} of them")
        return UniformBins(sizes, first, last)

    def action_values(self, actions: Sequence[float] | None = None) -> tuple[float, ...]:
        """``actions`` as floats; None is the task's own. Raises InputError for values that the original refuses."""
        if actions is None:
            return self.actions
        if self.max_action is None:
            raise InputError("actions", list(actions), f"left out: those of {self.gymnasium_id} are fixed")
        values = checks.sequence("actions", actions)
        good = all(checks.is_number(x) and abs(x) <= min(self.max_action, np.finfo(float).max) for x in values)
        if not values or not good:
            limit = f" of at most {self.max_action:g} in size" if math.isfinite(self.max_action) else ""
            raise InputError("actions", list(values), f"a list of finite numbers{limit}")
        return tuple(map(float, values))


def control_task(task: str | ControlTask) -> ControlTask:
    """The task of that name. Raises InputError for an unknown one."""
    if isinstance(task, ControlTask):
        return task
    checks.one_of("task", task, tuple(CONTROL_TASKS))
    named: ControlTask = importlib.import_module(f"erl_torch.envs.{task}").TASK
    return named


def wrap(angle: torch.Tensor) -> torch.Tensor:
    """``angle`` (radians) brought into [-pi, pi) by whole turns."""
    return angle - 2 * math.pi * torch.floor((angle + math.pi) * (0.5 / math.pi))


class ControlEnv(gym.Env[np.int64, np.int64]):
    """A control task with Discrete spaces. The original environment steps; its state is binned.

    Args:
        bins, low, high: as in ``erl_torch.estimate_mdp``.
        torques: values of the actions, ``actions`` of ``erl_torch.estimate_mdp``.
        reward: "original", or "cyclic": the largest reward is subtracted, after the step that terminates got 0; so all
            are at most 0. Learn from the cyclic one: some originals pay the same for every step, so that a stream of
            episodes would not tell short episodes from long ones.
        render_mode: one of the original's, or None.

    Raises:
        InputError: an argument out of range.
    """

    task: ClassVar[ControlTask]
    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": 30}  # noqa: RUF012

    def __init__(
        self,
        bins: int | Sequence[int] | None = None,
        low: Sequence[float] | None = None,
        high: Sequence[float] | None = None,
        torques: Sequence[float] | None = None,
        reward: str = "original",
        render_mode: str | None = None,
    ) -> None:
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise InputError("render_mode", render_mode, " or ".join(self.metadata["render_modes"]))
        checks.one_of("reward", reward, REWARDS)
        task, self.reward, self.render_mode = self.task, reward, render_mode
        self.bins = task.uniform_bins(bins, low, high)
        self.actions = task.action_values(torques)
        original = gym.make(task.gymnasium_id, render_mode=render_mode).unwrapped  # without its time limit
        self.metadata = original.metadata
        values = list(self.actions) if isinstance(original.action_space, gym.spaces.Box) else None
        if values is None and task.max_action is not None:
            original.AVAIL_TORQUE = list(self.actions)  # type: ignore[attr-defined]  # Acrobot
            original.action_space = gym.spaces.Discrete(len(self.actions))
        bounds = self.bins.low, self.bins.high
        self.env = Discretise(original, self.bins.bins, *bounds, values, task.features)
        self.observation_space = gym.spaces.Discrete(self.bins.n_cells)
        self.action_space = gym.spaces.Discrete(len(self.actions))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.int64, dict[str, Any]]:
        super().reset(seed=seed)
        return self.env.reset(seed=seed, options=options)

    def step(self, action: np.int64) -> tuple[np.int64, float, bool, bool, dict[str, Any]]:
        cell, reward, terminated, truncated, info = self.env.step(action)
        if self.reward == "cyclic":
            reward = (0.0 if terminated else reward) - self.task.max_reward
        return cell, reward, terminated, truncated, info

    def render(self) -> RenderFrame | list[RenderFrame] | None:
        return self.env.render()

    def close(self) -> None:
        self.env.close()


class FixedActionsEnv(ControlEnv):
    """A ``ControlEnv`` of a task whose actions are fixed; ``Args`` and ``Raises`` as there."""

    def __init__(
        self,
        bins: int | Sequence[int] | None = None,
        low: Sequence[float] | None = None,
        high: Sequence[float] | None = None,
        reward: str = "original",
        render_mode: str | None = None,
    ) -> None:
        super().__init__(bins, low, high, None, reward, render_mode)
