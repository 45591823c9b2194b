"""Environments taken through ``env.step``: to evaluate a policy, to show it, or to collect tuples.

``episode`` steps an environment, for each of these purposes; ``tuples`` makes a stream of its steps. ``vector_tuples``
steps a vector of environments.

Where ``reset`` and ``step`` tell the actions that a state has (``info["action_mask"]``, as Gymnasium's Taxi), no other
is ever taken: a policy is taken on those that are left, with their shares.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode

from erl_torch.checks import InputError
from erl_torch.experience.transitions import Transitions
from erl_torch.mdp.masks import ActionMasks
from erl_torch.rng import Streams

CHUNK = 10_000  # tuples


class Step(NamedTuple):
    """One step of an environment."""

    s: int
    a: int
    r: float
    s_next: int  # the state reached, also where the episode ends
    terminated: bool
    last: bool  # of its episode: terminated, truncated, or the last that the horizon allows
    mask: np.ndarray | None = None  # the actions that s_next has, [A] bool; None where the environment does not tell


class Seen(NamedTuple):
    """A state, and the actions that it has, [A] bool; None where the environment does not tell."""

    s: int
    mask: np.ndarray | None = None


class Draws:
    """Draws actions from a policy [S, A], each with one number of ``rng``.

    ``key``: name of a policy that may take only actions that there are; without one, its share of the others is spread.
    """

    def __init__(self, policy: np.ndarray, rng: np.random.Generator, key: str = "") -> None:
        self._policy, self._rng, self._key = policy, rng, key
        self._cdf = np.cumsum(policy, axis=1)

    def __call__(self, s: int, mask: np.ndarray | None = None) -> int:
        """An action in state ``s``, of those in ``mask``. Raises InputError where the policy has none of them."""
        row = self._cdf[s] if mask is None else self._among(s, mask)
        return int(row.searchsorted(self._rng.random() * row[-1], side="right"))

    def each(self, s: np.ndarray, masks: ActionMasks) -> np.ndarray:
        """An action in each of the states ``s`` [n]."""
        rows = self._cdf[s]
        for i in np.flatnonzero(masks.told[s]):
            rows[i] = self._among(int(s[i]), masks.allowed[s[i]])
        x = self._rng.random(len(s)) * rows[:, -1]
        return np.asarray((rows <= x[:, None]).sum(1))

    def _among(self, s: int, mask: np.ndarray) -> np.ndarray:
        """The running sums of the policy on the actions of ``mask``."""
        row = self._policy[s]
        others = np.flatnonzero((row > 0) & ~mask)
        if not others.size:
            return np.asarray(self._cdf[s])
        if self._key or not (row > 0)[mask].any():
            a = others[0]
            allowed = f"0: the environment says that state {s} does not have action {a} (action_mask)"
            raise InputError(f"{self._key or 'policy'}[{s}, {a}]", row[a], allowed)
        return np.cumsum(np.where(mask, row, 0.0))


class Plan(NamedTuple):
    """How many tuples are collected, and how their actions are drawn."""

    n_episodes: int
    episode_length: int  # steps of an episode at most
    rng: Streams
    behaviour: np.ndarray  # [S, A], rows sum to 1: a is drawn from it
    prior: np.ndarray  # [S, A], rows sum to 1: a' is drawn from it
    on_prior: bool  # the behaviour policy is the prior, and a' the action taken next
    masks: ActionMasks | None = None  # where the actions that states have are noted, as the environment tells them


def reset(env: gym.Env[Any, Any], rng: np.random.Generator) -> Seen:
    """Reset ``env`` with a seed drawn from ``rng``; the first state."""
    observation, info = env.reset(seed=_seed(rng))
    return Seen(int(observation), _mask(info, env))


def episode(
    env: gym.Env[Any, Any], first: Seen, choose: Callable[[int, np.ndarray | None], int], horizon: int
) -> Iterator[Step]:
    """Step ``env`` from ``first``, the state that it was reset to, to the end of the episode.

    Args:
        env: with Discrete spaces.
        first: its first state.
        choose: (state, the actions that it has) -> action, as ``Draws``; called once per step, just before it.
        horizon: steps at most, >= 1.
    """
    s, mask = first
    for t in range(1, horizon + 1):
        a = choose(s, mask)
        observation, reward, terminated, truncated, info = env.step(a)
        s_next, last = int(observation), bool(terminated or truncated or t == horizon)
        mask = _mask(info, env)
        yield Step(s, a, float(reward), s_next, bool(terminated), last, mask)
        if last:
            return
        s = s_next


def _mask(info: Any, env: gym.Env[Any, Any]) -> np.ndarray | None:
    """The actions that the state just reached has, [A] bool, as ``info`` tells; None where it does not."""
    given = info.get("action_mask") if isinstance(info, dict) else None
    if given is None:
        return None
    space: Any = env.action_space
    return _checked_mask(given, (int(space.n),))


def _checked_mask(given: object, shape: tuple[int, ...]) -> np.ndarray:
    mask = np.asarray(given)
    if mask.shape != shape or not np.isin(mask, (0, 1)).all() or not mask.any(-1).all():
        allowed = f"of shape {list(shape)}, 1 where the state has the action and 0 elsewhere, and not all 0"
        raise InputError("info['action_mask']", given, allowed)
    return np.asarray(mask == 1)


def tuples(env: gym.Env[Any, Any], plan: Plan) -> Iterator[Transitions]:
    """Collect the tuples of ``plan`` from ``env``, ``CHUNK`` at a time; the last chunk holds what is left."""
    act = Draws(plan.behaviour, plan.rng.behaviour, "" if plan.on_prior else "behaviour_policy")
    act_next = Draws(plan.prior, plan.rng.behaviour)
    masks = plan.masks or ActionMasks(*plan.prior.shape)
    drawn: list[int] = []  # a', where it is the action taken next

    def choose(s: int, mask: np.ndarray | None) -> int:
        return drawn.pop() if drawn else act(s, mask)

    rows: list[tuple[int, int, float, int, int]] = []
    now = reset(env, plan.rng.environment)
    masks.enter(*now)
    for _ in range(plan.n_episodes):
        for step in episode(env, now, choose, plan.episode_length):
            reached = Seen(step.s_next, step.mask)
            if not step.terminated:  # the actions of a state that is never left are no one's concern
                masks.enter(*reached)
            now = reset(env, plan.rng.environment) if step.last else reached
            masks.enter(*now)
            s_next, mask = now if step.terminated else reached
            a_next = act_next(s_next, mask)
            if plan.on_prior and not step.last:
                drawn.append(a_next)
            rows.append((step.s, step.a, step.r, s_next, a_next))
            if len(rows) == CHUNK:
                yield _of_rows(rows)
                rows = []
    if rows:
        yield _of_rows(rows)


def _of_rows(rows: list[tuple[int, int, float, int, int]]) -> Transitions:
    return Transitions(*(np.array(column) for column in zip(*rows, strict=True)))


def vector_tuples(env: gym.vector.VectorEnv[Any, Any, Any], plan: Plan) -> Iterator[Transitions]:
    """Collect n_episodes * episode_length tuples, ordered by step and within a step by environment.

    Raises:
        InputError: an environment that does not tell its autoreset mode.
    """
    n, rng = plan.n_episodes * plan.episode_length, plan.rng
    mode = env.metadata.get("autoreset_mode")
    if not isinstance(mode, AutoresetMode):
        raise InputError("metadata['autoreset_mode']", mode, "a gymnasium.vector.AutoresetMode")
    act = Draws(plan.behaviour, rng.behaviour, "" if plan.on_prior else "behaviour_policy")
    act_next = Draws(plan.prior, rng.behaviour)
    masks = plan.masks or ActionMasks(*plan.prior.shape)
    observation, info = env.reset(seed=_seed(rng.environment))
    state = np.array(observation)
    _enter(masks, state, info, np.ones(env.num_envs, bool))
    action = act.each(state, masks)
    reward = np.zeros(env.num_envs)
    restarting = np.zeros(env.num_envs, bool)  # this step is a reset: its observation a first state
    unfinished = restarting.copy()  # terminated the step before: s' is that first state
    columns, collected, given = list[tuple[np.ndarray, ...]](), 0, 0
    while collected < n:
        observation, stepped_reward, terminated, truncated, info = env.step(action)
        after = np.array(observation)
        reward = np.where(restarting, reward, stepped_reward)
        terminated, truncated = terminated & ~restarting, truncated & ~restarting
        over = terminated | truncated
        first = after.copy()  # first state of the next episode, where has_first
        has_first = restarting.copy()
        _enter(masks, after, info, ~terminated if mode != AutoresetMode.SAME_STEP else ~restarting)
        if over.any() and mode == AutoresetMode.SAME_STEP:
            has_first |= over
            after[over] = [int(last) for last in info["final_obs"][over]]
            _enter(masks, after, info.get("final_info", {}), truncated & ~terminated)
        elif over.any() and mode == AutoresetMode.DISABLED:
            has_first |= over
            observation, info = env.reset(seed=_seed(rng.environment), options={"reset_mask": over})
            _enter(masks, first := np.array(observation), info, over)
        ready = (~restarting & (~terminated | has_first)) | unfinished
        after = np.where((terminated & has_first) | unfinished, first, after)
        action_next = act_next.each(after, masks)
        columns.append(tuple(column[ready] for column in (state, action, reward, after, action_next)))
        collected += int(ready.sum())
        if collected >= n or collected - given >= CHUNK:
            chunk = Transitions(*(np.concatenate(column) for column in zip(*columns, strict=True)))
            yield chunk.first(min(collected, n) - given)
            columns, given = [], collected
        goes_on = ~over & ~restarting
        unfinished = terminated & ~has_first
        held_state, held_action = state, action
        state = np.where(goes_on, after, first)
        action = np.where(goes_on & plan.on_prior, action_next, act.each(state, masks))
        restarting = over & ~has_first
        state, action = np.where(restarting, held_state, state), np.where(restarting, held_action, action)


def _enter(masks: ActionMasks, states: np.ndarray, info: Any, which: np.ndarray) -> None:
    """Note the actions of those of ``states`` [n] that ``which`` [n] has, where ``info`` of a vector tells them."""
    given = info.get("action_mask") if isinstance(info, dict) else None
    if given is None:
        return
    told = np.flatnonzero(which & np.asarray(info.get("_action_mask", np.ones(len(states), bool))))
    if told.size:
        checked = _checked_mask(np.stack([np.asarray(given[i]) for i in told]), (told.size, masks.allowed.shape[1]))
        for i, mask in zip(told, checked, strict=True):
            masks.enter(int(states[i]), mask)


def _seed(rng: np.random.Generator) -> int:
    return int(rng.integers(2**31))
