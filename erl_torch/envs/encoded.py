"""Environments with any finite spaces, as Discrete and Discrete: ``encoded``.

States and actions get the numbers of ``erl_torch.Labels.of_space``: every member of a space has one, whether it is
reachable or not.

An observation that is a Dict of ``observation`` and ``action_mask`` is the state and, which is no part of it, the mask
of the actions that may be taken: it goes to ``info["action_mask"]``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeVar, overload

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector.utils import batch_space, concatenate, create_empty_array

from erl_torch import checks
from erl_torch.checks import InputError
from erl_torch.labels import Labels
from erl_torch.mdp.from_gymnasium import MASKED, space_labels

Other = TypeVar("Other")


if TYPE_CHECKING:
    VectorBase = gym.vector.VectorWrapper[Any, Any, Any, Any, Any]
else:
    VectorBase = gym.vector.VectorWrapper  # Gymnasium 1.3 does not know it as generic


class Encoded(gym.Wrapper[np.int64, np.int64, Any, Any], gym.utils.RecordConstructorArgs):
    """An environment with finite spaces, as Discrete and Discrete.

    Attributes: ``state_labels``, ``action_labels``.

    Raises:
        InputError: a space that is not finite, or one with 2**31 members or more. ``reset`` and ``step``: an
            observation that is not in its space, or an action that is not.
    """

    model_holds = True  # it renames states and actions, and nothing else

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        gym.utils.RecordConstructorArgs.__init__(self)
        super().__init__(env)
        self._masked = is_masked(env.observation_space)
        self.state_labels = space_labels("observation_space", env.observation_space)
        self.action_labels = space_labels("action_space", env.action_space)
        self.observation_space = spaces.Discrete(len(self.state_labels))
        self.action_space = spaces.Discrete(len(self.action_labels))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.int64, dict[str, Any]]:
        observation, info = self.env.reset(seed=seed, options=options)
        return self._state(observation, info)

    def step(self, action: np.int64) -> tuple[np.int64, float, bool, bool, dict[str, Any]]:
        if not self.action_space.contains(action):
            raise InputError("action", action, f"a whole number in [0, {len(self.action_labels)})")
        observation, reward, terminated, truncated, info = self.env.step(self.action_labels.member(int(action)))
        s, info = self._state(observation, info)
        return s, reward, terminated, truncated, info  # type: ignore[return-value]  # the reward is looked at later

    def _state(self, observation: Any, info: dict[str, Any]) -> tuple[np.int64, dict[str, Any]]:
        if self._masked:
            observation, info = _parted(observation, info)
        return np.int64(self.state_labels.encode(observation, "observation")), info


class EncodedVector(VectorBase):
    """A vector of environments with finite spaces, as Discrete and Discrete; else as ``Encoded``."""

    def __init__(self, env: gym.vector.VectorEnv[Any, Any, Any]) -> None:
        super().__init__(env)
        self._masked = is_masked(env.single_observation_space)
        self.state_labels = space_labels("observation_space", env.single_observation_space)
        self.action_labels = space_labels("action_space", env.single_action_space)
        self.single_observation_space = spaces.Discrete(len(self.state_labels))
        self.single_action_space = spaces.Discrete(len(self.action_labels))
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        observations, info = self.env.reset(seed=seed, options=options)
        return self._states(observations, info)

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, Any, Any, Any, dict[str, Any]]:
        members = [self.action_labels.member(int(a)) for a in actions]
        space = self.env.single_action_space
        room: Any = create_empty_array(space, self.num_envs)
        batch = concatenate(space, members, room)
        observations, reward, terminated, truncated, info = self.env.step(batch)
        states, info = self._states(observations, info)
        if "final_obs" in info:  # [N] objects, None where no episode ended
            final = [None if last is None else self._last(last) for last in info["final_obs"]]
            info = {**info, "final_obs": np.array(final, dtype=object)}
        return states, reward, terminated, truncated, info

    def _states(self, observations: Any, info: dict[str, Any]) -> tuple[np.ndarray, dict[str, Any]]:
        if self._masked:
            observations, info = _parted(observations, info)
        return self.state_labels.encode_batch(observations, self.num_envs, "observation"), info

    def _last(self, observation: Any) -> int:
        return self.state_labels.encode(_parted(observation, {})[0] if self._masked else observation, "observation")


@overload
def encoded(source: gym.Env[Any, Any]) -> gym.Env[Any, Any]: ...


@overload
def encoded(source: gym.vector.VectorEnv[Any, Any, Any]) -> gym.vector.VectorEnv[Any, Any, Any]: ...


@overload
def encoded(source: Other) -> Other: ...


def encoded(source: Any) -> Any:
    """An environment, or a vector of them, with both spaces Discrete from 0: itself where they are, else wrapped.

    Anything else comes back as it is. Raises InputError for a space that is not finite, or too large.
    """
    if isinstance(source, gym.vector.VectorEnv):
        both = source.single_observation_space, source.single_action_space
        return source if all(map(is_plain, both)) else EncodedVector(source)
    if isinstance(source, gym.Env):
        return source if all(map(is_plain, (source.observation_space, source.action_space))) else Encoded(source)
    return source


def labels_of(env: gym.Env[Any, Any]) -> tuple[Labels | None, Labels | None]:
    """The labels of states and of actions of what ``encoded`` gave; None where they are numbers from 0.

    An environment names its own: the lists ``state_labels`` and ``action_labels`` of the environment, without wrappers.
    Raises InputError where there are more or fewer of them than states or actions.
    """
    inner: Any = env
    while isinstance(inner, gym.Wrapper) and not isinstance(inner, Encoded):
        inner = inner.env
    found: list[Labels | None] = []
    for name, space in (("state_labels", env.observation_space), ("action_labels", env.action_space)):
        given = getattr(env.unwrapped, name, None)
        coded = getattr(inner, name) if isinstance(inner, Encoded) else None
        if given is None:
            found.append(None if coded is None or is_plain(coded.space) else coded)
            continue
        labels = Labels.of_values(checks.sequence(name, given))
        if len(labels) != len(Labels.of_space(space)):
            raise InputError(name, f"{len(labels)} different ones", f"one for each member of {space}")
        found.append(labels)
    return found[0], found[1]


def is_plain(space: gym.Space[Any]) -> bool:
    """Whether members are the numbers from 0 already."""
    return isinstance(space, spaces.Discrete) and int(space.start) == 0


def is_masked(space: gym.Space[Any]) -> bool:
    """Whether an observation is a state with the mask of its actions."""
    return isinstance(space, spaces.Dict) and set(space.spaces) == set(MASKED)


def _parted(observation: Any, info: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
    """A state, and ``info`` with the mask of its actions."""
    state, mask = MASKED
    if not isinstance(observation, dict) or set(observation) != {state, mask}:
        raise InputError("observation", observation, f"a dict with {state} and {mask}")
    return observation[state], {**info, mask: observation[mask]}
