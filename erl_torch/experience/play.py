"""Environments taken through ``env.step``: to evaluate a policy, to show it, or to collect tuples.

``episode`` steps an environment, for each of these purposes; ``tuples`` makes a stream of its steps. ``vector_tuples``
steps a vector of environments. Whatever an environment returns is checked here: ``InputError`` names the environment
and the step.

Where ``reset`` and ``step`` tell the actions that a state has (``info["action_mask"]``, as Gymnasium's Taxi), no other
is ever taken: a policy is taken on those that are left, with their shares.
"""

from __future__ import annotations

import contextlib
import itertools
import numbers
import traceback
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode

from erl_torch.checks import InputError
from erl_torch.experience.transitions import Transitions
from erl_torch.labels import Labels
from erl_torch.mdp.masks import ActionMasks
from erl_torch.rng import Streams

CHUNK = 10_000  # tuples
# Modules that stand between: what they stumble over is what an environment returned.
BETWEEN = (
    "gymnasium.wrappers",
    "gymnasium.core",
    "gymnasium.vector",
    "gymnasium.utils.passive_env",
    "erl_torch.envs.discretise",
    "erl_torch.envs.encoded",
    "erl_torch.envs.ends",
)
RESET = "(observation, info), info a dict"
STEP = "(observation, reward, terminated, truncated, info)"
INTERFACE = f"one of Gymnasium's: reset(seed=None, options=None) -> (observation, info), step(action) -> {STEP}"


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
    Without ``masked``, what an environment tells of them is passed over.
    """

    def __init__(self, policy: np.ndarray, rng: np.random.Generator, key: str = "", masked: bool = True) -> None:
        self._policy, self._rng, self._key, self._masked = policy, rng, key, masked
        self._cdf = np.cumsum(policy, axis=1)

    def __call__(self, s: int, mask: np.ndarray | None = None) -> int:
        """An action in state ``s``, of those in ``mask``. Raises InputError where the policy has none of them."""
        row = self._cdf[s] if mask is None or not self._masked else self._among(s, mask)
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
    with _blamed(env, "reset"):
        observation, info = _observed(env.reset(seed=_seed(rng)))
        return Seen(_state(observation, _n_states(env)), _mask(info, env))


def episode(
    env: gym.Env[Any, Any], first: Seen, choose: Callable[[int, np.ndarray | None], int], horizon: int
) -> Iterator[Step]:
    """Step ``env`` from ``first``, the state that it was reset to, to the end of the episode.

    Args:
        env: with Discrete spaces, from 0.
        first: its first state.
        choose: (state, the actions that it has) -> action, as ``Draws``; called once per step, just before it.
        horizon: steps at most, >= 1.

    Raises:
        InputError: the environment returns what no environment should; it names the environment and the step.
    """
    n_states = _n_states(env)
    s, mask = first
    for t in range(1, horizon + 1):
        a = choose(s, mask)
        try:
            s_next, r, terminated, truncated, info = _stepped(env.step(a), n_states)
            mask = _mask(info, env)
        except Exception as error:
            with _blamed(env, f"step {t} of an episode"):
                raise error
        last = terminated or truncated or t == horizon
        yield Step(s, a, r, s_next, terminated, last, mask)
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
    n_states = _n_states_of_each(env)
    state = _reset_states(env, None, n_states, plan, masks, "reset")
    action = act.each(state, masks)
    reward = np.zeros(env.num_envs)
    restarting = np.zeros(env.num_envs, bool)  # this step is a reset: its observation a first state
    unfinished = restarting.copy()  # terminated the step before: s' is that first state
    columns, collected, given = list[tuple[np.ndarray, ...]](), 0, 0
    for t in itertools.count(1):
        if collected >= n:
            return
        with _blamed(env, f"step {t}"):
            after, stepped_reward, terminated, truncated, info = _all_stepped(env.step(action), n_states, env.num_envs)
        reward = np.where(restarting, reward, stepped_reward)
        terminated, truncated = terminated & ~restarting, truncated & ~restarting
        over = terminated | truncated
        first = after.copy()  # first state of the next episode, where has_first
        has_first = restarting.copy()
        _enter(masks, after, info, ~terminated if mode != AutoresetMode.SAME_STEP else ~restarting)
        if over.any() and mode == AutoresetMode.SAME_STEP:
            has_first |= over
            with _blamed(env, f"step {t}"):
                after[over] = [_state(last, n_states) for last in info["final_obs"][over]]
                _enter(masks, after, info.get("final_info", {}), truncated & ~terminated)
        elif over.any() and mode == AutoresetMode.DISABLED:
            has_first |= over
            first = _reset_states(env, over, n_states, plan, masks, f"reset after step {t}")
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


def _reset_states(
    env: gym.vector.VectorEnv[Any, Any, Any],
    over: np.ndarray | None,
    n_states: int,
    plan: Plan,
    masks: ActionMasks,
    when: str,
) -> np.ndarray:
    """Reset those of the environments whose episode is ``over`` [n], None all; the states of all, [n]."""
    options = None if over is None else {"reset_mask": over}
    with _blamed(env, when):
        observation, info = _observed(env.reset(seed=_seed(plan.rng.environment), options=options))
        states = _states(observation, n_states, env.num_envs)
        _enter(masks, states, info, np.ones(env.num_envs, bool) if over is None else over)
    return states


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


# -- what environments return -----------------------------------------------------------------------------


def _n_states(env: gym.Env[Any, Any]) -> int:
    space = env.observation_space
    assert isinstance(space, gym.spaces.Discrete)
    return int(space.n)


def _observed(result: Any) -> tuple[Any, dict[str, Any]]:
    """What ``reset`` returned: observation and info. Raises InputError."""
    if not (_length_is(result, 2) and isinstance(result[1], dict)):
        raise InputError("what it returned", _short(result), RESET)
    return result[0], result[1]


def _parts(result: Any) -> Any:
    """The five parts of what ``step`` returned. Raises InputError."""
    if not _length_is(result, 5):
        old = ": old environments' (observation, reward, done, info) does not tell the two ends apart"
        raise InputError("what it returned", _short(result), STEP + old * _length_is(result, 4))
    if not isinstance(result[4], dict):
        raise InputError("info", _short(result[4]), "a dict")
    return result


def _stepped(result: Any, n_states: int) -> tuple[int, float, bool, bool, dict[str, Any]]:
    """What ``step`` returned, checked, the observation as a state. Raises InputError."""
    observation, reward, terminated, truncated, info = _parts(result)
    return (
        _state(observation, n_states),
        _reward(reward),
        _flag("terminated", terminated),
        _flag("truncated", truncated),
        info,
    )


def _state(observation: Any, n_states: int) -> int:
    """A whole number in [0, ``n_states``), which a float may be too (1.0). Raises InputError."""
    if isinstance(observation, (int, np.integer)) and 0 <= observation < n_states:
        return int(observation)
    return Labels.of_space(gym.spaces.Discrete(n_states)).encode(observation, "observation")


def _reward(reward: Any) -> float:
    plain = isinstance(reward, np.ndarray) and reward.ndim == 0 and reward.dtype.kind in "biuf"
    if not isinstance(reward, (numbers.Real, np.bool_)) and not plain:
        raise InputError("reward", f"{_short(reward)} ({type(reward).__name__})", "a number")
    try:
        r = float(reward)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError("reward", _short(reward), "a number") from error
    if not np.isfinite(r):
        raise InputError("reward", r, "finite")
    return r


def _flag(name: str, value: Any) -> bool:
    if not isinstance(value, (bool, np.bool_)):
        raise InputError(name, f"{_short(value)} ({type(value).__name__})", "True or False")
    return bool(value)


def _length_is(result: Any, n: int) -> bool:
    return isinstance(result, tuple) and len(result) == n


def _short(value: Any) -> str:
    return f"({', '.join(map(_short, value))})" if isinstance(value, tuple) else " ".join(repr(value).split())


def _name(env: gym.Env[Any, Any] | gym.vector.VectorEnv[Any, Any, Any]) -> str:
    return env.spec.id if env.spec is not None else type(env.unwrapped).__name__


@contextlib.contextmanager
def _blamed(env: gym.Env[Any, Any] | gym.vector.VectorEnv[Any, Any, Any], when: str) -> Iterator[None]:
    """Complaints raised inside name the environment and ``when``.

    So do those of wrappers that stand between and take what the environment returns apart.
    """
    try:
        yield
    except InputError as error:
        raise InputError(f"{_name(env)}, {when}: {error.key}", error.value, error.allowed) from error
    except (AssertionError, ValueError, TypeError, AttributeError, OverflowError) as error:
        # Raised by what stands between, or by NumPy, to which it hands on what the environment returned.
        between = False
        for frame, _ in traceback.walk_tb(error.__traceback__):
            place = str(frame.f_globals.get("__name__"))
            if place.startswith(BETWEEN):
                between = True
            elif not place.startswith(("numpy", "functools")):
                between = False
        old = "unexpected keyword argument" in str(error) and when == "reset"
        if not old and not between:
            raise
        cause = " ".join(str(error).split())
        kind = type(env.unwrapped).__name__
        raise InputError(f"{_name(env)}, {when}: class", kind, f"{INTERFACE} ({cause})") from error


def _n_states_of_each(env: gym.vector.VectorEnv[Any, Any, Any]) -> int:
    space = env.single_observation_space
    assert isinstance(space, gym.spaces.Discrete)
    return int(space.n)


def _all_stepped(result: Any, n_states: int, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, Any]:
    """As ``_stepped``, of a vector of ``n`` environments, and the info. Raises InputError that names the first."""
    observation, reward, terminated, truncated, info = _parts(result)
    states = _states(observation, n_states, n)
    rewards = np.asarray(reward)
    if rewards.shape != (n,) or rewards.dtype.kind not in "iufb":
        raise InputError("reward", f"{rewards.dtype} of shape {rewards.shape}", f"numbers, of shape ({n},)")
    rewards = rewards.astype(np.float64)
    if not np.isfinite(rewards).all():
        i = int(np.argmin(np.isfinite(rewards)))
        raise InputError(f"reward[{i}]", rewards[i], "finite")
    flags = []
    for name, values in (("terminated", np.asarray(terminated)), ("truncated", np.asarray(truncated))):
        if values.shape != (n,) or values.dtype.kind != "b":
            raise InputError(name, f"{values.dtype} of shape {values.shape}", f"True or False, of shape ({n},)")
        flags.append(values)
    return states, rewards, flags[0], flags[1], info


def _states(observation: Any, n_states: int, n: int) -> np.ndarray:
    """[N] int64, as a copy. Raises InputError, with the number of the environment."""
    return Labels.of_space(gym.spaces.Discrete(n_states)).encode_batch(observation, n, "observation")
