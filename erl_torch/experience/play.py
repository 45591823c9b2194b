"""Environments taken through ``env.step``: to evaluate a policy, to show it, or to collect tuples.

``episode`` steps an environment, for each of these purposes; ``tuples`` makes a stream of its steps. ``vector_tuples``
steps a vector of environments.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode

from erl_torch.checks import InputError
from erl_torch.experience.transitions import Transitions
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


class Plan(NamedTuple):
    """How many tuples are collected, and how their actions are drawn."""

    n_episodes: int
    episode_length: int  # steps of an episode at most
    rng: Streams
    behaviour: np.ndarray  # [S, A], rows sum to 1: a is drawn from it
    prior: np.ndarray  # [S, A], rows sum to 1: a' is drawn from it
    on_prior: bool  # the behaviour policy is the prior, and a' the action taken next


def reset(env: gym.Env[Any, Any], rng: np.random.Generator) -> int:
    """Reset ``env`` with a seed drawn from ``rng``; the first state."""
    return int(env.reset(seed=_seed(rng))[0])


def draw_action(cdf: np.ndarray, rng: np.random.Generator, s: int) -> int:
    """Draw an action in state ``s`` with one number of ``rng``; ``cdf`` [S, A] has the running sums of a policy."""
    row = cdf[s]
    return int(row.searchsorted(rng.random() * row[-1], side="right"))


def episode(env: gym.Env[Any, Any], s: int, choose: Callable[[int], int], horizon: int) -> Iterator[Step]:
    """Step ``env`` from ``s``, the state that it was reset to, to the end of the episode.

    Args:
        env: with Discrete spaces.
        s: its first state.
        choose: state -> action; called once per step, just before it.
        horizon: steps at most, >= 1.
    """
    for t in range(1, horizon + 1):
        a = choose(s)
        observation, reward, terminated, truncated, _ = env.step(a)
        s_next, last = int(observation), bool(terminated or truncated or t == horizon)
        yield Step(s, a, float(reward), s_next, bool(terminated), last)
        if last:
            return
        s = s_next


def tuples(env: gym.Env[Any, Any], plan: Plan) -> Iterator[Transitions]:
    """Collect the tuples of ``plan`` from ``env``, ``CHUNK`` at a time; the last chunk holds what is left."""
    act, act_next = (
        partial(draw_action, np.cumsum(policy, axis=1), plan.rng.behaviour) for policy in (plan.behaviour, plan.prior)
    )
    drawn: list[int] = []  # a', where it is the action taken next

    def choose(s: int) -> int:
        return drawn.pop() if drawn else act(s)

    rows: list[tuple[int, int, float, int, int]] = []
    s = reset(env, plan.rng.environment)
    for _ in range(plan.n_episodes):
        for step in episode(env, s, choose, plan.episode_length):
            s = reset(env, plan.rng.environment) if step.last else step.s_next
            s_next = s if step.terminated else step.s_next
            a_next = act_next(s_next)
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
    behaviour_cdf, prior_cdf = np.cumsum(plan.behaviour, axis=1), np.cumsum(plan.prior, axis=1)

    def draw(cdf: np.ndarray, s: np.ndarray) -> np.ndarray:
        x = rng.behaviour.random(len(s)) * cdf[s, -1]
        return np.asarray((cdf[s] <= x[:, None]).sum(1))

    state = np.array(env.reset(seed=_seed(rng.environment))[0])
    action = draw(behaviour_cdf, state)
    reward = np.zeros(env.num_envs)
    restarting = np.zeros(env.num_envs, bool)  # this step is a reset: its observation a first state
    unfinished = restarting.copy()  # terminated the step before: s' is that first state
    columns: list[tuple[np.ndarray, ...]] = []
    collected = given = 0
    while collected < n:
        observation, stepped_reward, terminated, truncated, info = env.step(action)
        after = np.array(observation)
        reward = np.where(restarting, reward, stepped_reward)
        terminated, truncated = terminated & ~restarting, truncated & ~restarting
        over = terminated | truncated
        first = after.copy()  # first state of the next episode, where has_first
        has_first = restarting.copy()
        if over.any() and mode == AutoresetMode.SAME_STEP:
            has_first |= over
            after[over] = [int(last) for last in info["final_obs"][over]]
        elif over.any() and mode == AutoresetMode.DISABLED:
            has_first |= over
            first = np.array(env.reset(seed=_seed(rng.environment), options={"reset_mask": over})[0])
        ready = (~restarting & (~terminated | has_first)) | unfinished
        after = np.where((terminated & has_first) | unfinished, first, after)
        action_next = draw(prior_cdf, after)
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
        action = np.where(goes_on & plan.on_prior, action_next, draw(behaviour_cdf, state))
        restarting = over & ~has_first
        state, action = np.where(restarting, held_state, state), np.where(restarting, held_action, action)


def _seed(rng: np.random.Generator) -> int:
    return int(rng.integers(2**31))
