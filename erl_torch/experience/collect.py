"""Collecting a stream of tuples under a behaviour policy.

A TabularMDP, or an environment of this package that follows one, is sampled in a compiled loop, this package's
control tasks in batches; any other Gymnasium environment with Discrete spaces, or vector of environments, is taken
through ``env.step``.

a' is always a draw from the prior at s'. When the behaviour policy is the prior, a' is also the action
taken next (the paper's stream); otherwise it is a draw of its own.

Ends of episodes. The eigenvalue problem is that of an endless process, so where an environment
*terminates*, s' is the first state of the next episode: the terminal state leads straight to the start.
Where an episode is only *truncated* (a time limit, or ``episode_length``), s' is the state reached, and the
next tuple begins at a fresh start. A vector environment's resets are no steps: whatever its autoreset mode, only
real transitions enter the stream.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode

from erl_torch import checks
from erl_torch.checks import InputError
from erl_torch.experience.recording import ColumnWriter, save_columns
from erl_torch.experience.sampling import Sampler
from erl_torch.experience.transitions import Transitions, join
from erl_torch.mdp.from_gymnasium import changed_by, known_mdp, sizes
from erl_torch.mdp.tabular import TabularMDP, check_policy
from erl_torch.rng import Streams, streams

BLOCK = 1_000_000  # steps a compiled call, so that signals and progress bars are served
TUPLE_BYTES = 32  # of a tuple while it is sampled: two pairs and five columns
COLUMN_BYTES = 24  # of a tuple in a file, or in memory

Report = Callable[[int], object]


def collect(
    source: TabularMDP | gym.Env[Any, Any] | gym.vector.VectorEnv[Any, Any, Any],
    n_episodes: int,
    episode_length: int,
    seed: int | Streams = 0,
    behaviour_policy: Any = None,
    prior_policy: Any = None,
    report: Report | None = None,
) -> Transitions:
    """Collect experience.

    Args:
        source: a TabularMDP, or a Gymnasium environment or vector environment with Discrete spaces.
        n_episodes, episode_length: whole numbers >= 1. A TabularMDP gives exactly their product in tuples, as does a
            vector environment, which ends its episodes itself; an environment's own ends make episodes shorter.
        seed: a whole number, or the streams of one.
        behaviour_policy: [S, A]; None is the prior.
        prior_policy: [S, A], behind a'; None is uniform.
        report: called with the number of tuples after each block.

    Raises:
        InputError: an argument out of range, or spaces that are not Discrete.
    """
    n_episodes = checks.at_least("n_episodes", n_episodes, 1)
    episode_length = checks.at_least("episode_length", episode_length, 1)
    n_states, n_actions = sizes(source)
    prior = check_policy("prior_policy", prior_policy, n_states, n_actions)
    on_prior = behaviour_policy is None
    behaviour = prior if on_prior else check_policy("behaviour_policy", behaviour_policy, n_states, n_actions)
    rng = seed if isinstance(seed, Streams) else streams(seed)
    report = report or (lambda _: None)
    mdp = known_mdp(source)
    if mdp is not None or isinstance(source, gym.vector.VectorEnv):  # exactly so many tuples
        _fits("memory", n_episodes, episode_length, TUPLE_BYTES * n_episodes * episode_length)
    if mdp is not None:
        return _simulate(mdp, n_episodes, episode_length, rng, behaviour, prior, on_prior, report)
    batch = None if isinstance(source, (TabularMDP, gym.vector.VectorEnv)) else batched(source)
    if batch is not None:
        return batch(
            n_episodes, episode_length, seed=rng, behaviour_policy=None if on_prior else behaviour, prior_policy=prior
        )
    assert not isinstance(source, TabularMDP)
    played = _played(source, n_episodes, episode_length, rng, behaviour, prior, on_prior, report)
    return join(list(_holding(played, n_episodes, episode_length)))


def _holding(chunks: Iterator[Transitions], n_episodes: int, episode_length: int) -> Iterator[Transitions]:
    """``chunks`` of a stream whose length shows as it goes. Raises InputError before it is too long to be joined."""
    held, looked_at = 0, 20_000
    for chunk in chunks:
        held += len(chunk)
        if held >= looked_at:
            _fits("memory", n_episodes, episode_length, COLUMN_BYTES * held)  # as much again
            looked_at = held + held // 8
        yield chunk


def _fits(where: str, n_episodes: int, episode_length: int, needed: int) -> None:
    """Raise InputError unless ``needed`` bytes of a stream fit; ``where``: memory, or the directory it goes to."""
    what = f"a stream of {n_episodes:,} episodes of {episode_length:,} steps"
    if where == "memory":
        checks.memory("n_episodes", n_episodes, needed, what)
    else:
        checks.disk("n_episodes", n_episodes, needed, what, where)


def _played(
    source: gym.Env[Any, Any] | gym.vector.VectorEnv[Any, Any, Any],
    n_episodes: int,
    episode_length: int,
    rng: Streams,
    behaviour: np.ndarray,
    prior: np.ndarray,
    on_prior: bool,
    report: Report,
) -> Iterator[Transitions]:
    """The tuples of an environment that is stepped, some thousands at a time."""
    if isinstance(source, gym.vector.VectorEnv):
        return _step_vector(source, n_episodes * episode_length, rng, behaviour, prior, on_prior, report)
    return _step_through(source, n_episodes, episode_length, rng, behaviour, prior, on_prior, report)


def record(
    source: TabularMDP | gym.Env[Any, Any] | gym.vector.VectorEnv[Any, Any, Any],
    directory: str | os.PathLike[str],
    n_episodes: int,
    episode_length: int,
    seed: int | Streams = 0,
    behaviour_policy: Any = None,
    prior_policy: Any = None,
    report: Report | None = None,
) -> Path:
    """Write what ``collect`` gives to a directory of columns (``erl_torch.open_recording`` reads it).

    In memory of some tuples, whatever the length, but for this package's control tasks, whose episodes are played in
    batches.

    Raises:
        InputError: as ``collect``; a directory that holds anything else.
    """
    n_states, n_actions = sizes(source)
    mdp = known_mdp(source)
    if mdp is None and not isinstance(source, (TabularMDP, gym.vector.VectorEnv)) and batched(source):
        data = collect(source, n_episodes, episode_length, seed, behaviour_policy, prior_policy, report)
        return save_columns(data, directory)
    n_episodes = checks.at_least("n_episodes", n_episodes, 1)
    episode_length = checks.at_least("episode_length", episode_length, 1)
    prior = check_policy("prior_policy", prior_policy, n_states, n_actions)
    on_prior = behaviour_policy is None
    behaviour = prior if on_prior else check_policy("behaviour_policy", behaviour_policy, n_states, n_actions)
    rng = seed if isinstance(seed, Streams) else streams(seed)
    chunks: Iterator[Transitions]
    if mdp is not None or isinstance(source, gym.vector.VectorEnv):
        _fits(str(directory), n_episodes, episode_length, COLUMN_BYTES * n_episodes * episode_length)
    if mdp is not None:
        reward = mdp.reward
        blocks = _blocks(mdp, n_episodes * episode_length, episode_length, rng, behaviour, prior, on_prior)
        chunks = (of_pairs(*block, reward) for block in blocks)
    else:
        assert not isinstance(source, TabularMDP)
        chunks = _played(source, n_episodes, episode_length, rng, behaviour, prior, on_prior, lambda _: None)
    done = 0
    with ColumnWriter(directory) as writer:
        for chunk in chunks:
            writer.append(chunk)
            done += len(chunk)
            if report is not None:
                report(done)
    return writer.directory


def batched(env: gym.Env[Any, Any]) -> Callable[..., Transitions] | None:
    """What plays many episodes of ``env`` at once, if something can and it is not wrapped in something else."""
    base = env.unwrapped
    control = sys.modules.get("erl_torch.envs.control")  # which loads torch: there where there is such an environment
    if control is None or not isinstance(base, control.ControlEnv) or changed_by(env) is not None:
        return None
    from erl_torch.experience.rollouts import episodes_of

    longest = env.spec.max_episode_steps if env.spec else None

    def collect_at_once(n_episodes: int, episode_length: int, **arguments: Any) -> Transitions:
        return episodes_of(base, n_episodes, min(episode_length, longest or episode_length), **arguments)

    return collect_at_once


def _simulate(
    mdp: TabularMDP,
    n_episodes: int,
    episode_length: int,
    rng: Streams,
    behaviour: np.ndarray,
    prior: np.ndarray,
    on_prior: bool,
    report: Report,
) -> Transitions:
    n = n_episodes * episode_length
    pair, pair_next = np.empty(n, np.int32), np.empty(n, np.int32)
    done = 0
    for here, there in _blocks(mdp, n, episode_length, rng, behaviour, prior, on_prior):
        pair[done : done + len(here)], pair_next[done : done + len(here)] = here, there
        done += len(here)
        report(done)
    return of_pairs(pair, pair_next, mdp.reward)


def _blocks(
    mdp: TabularMDP,
    n: int,
    episode_length: int,
    rng: Streams,
    behaviour: np.ndarray,
    prior: np.ndarray,
    on_prior: bool,
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """``n`` tuples as (pair, pair_next), a block at a time."""
    sampler = Sampler(mdp, [rng], episode_length, behaviour, prior, on_prior)
    for begin in range(0, n, BLOCK):
        here, _, there = sampler.take(min(n, begin + BLOCK) - begin)
        yield here[:, 0], there[:, 0]
    sampler.give_back()


def of_pairs(pair: np.ndarray, pair_next: np.ndarray, reward: np.ndarray) -> Transitions:
    """The tuples of pairs s * A + a and s' * A + a', [N] each, with rewards from the table [S, A]."""
    s, a = np.divmod(pair, np.int32(reward.shape[1]))
    s_next, a_next = np.divmod(pair_next, np.int32(reward.shape[1]))
    return Transitions(s, a, reward.ravel()[pair], s_next, a_next)


def _step_through(
    env: gym.Env[Any, Any],
    n_episodes: int,
    episode_length: int,
    rng: Streams,
    behaviour: np.ndarray,
    prior: np.ndarray,
    on_prior: bool,
    report: Report,
) -> Iterator[Transitions]:
    rows: list[tuple[int, int, float, int, int]] = []
    done = 0
    behaviour_cdf, prior_cdf = np.cumsum(behaviour, axis=1), np.cumsum(prior, axis=1)

    def draw(cdf: np.ndarray, s: int) -> int:
        x = rng.behaviour.random() * cdf[s, -1]
        return int(np.searchsorted(cdf[s], x, side="right"))

    state = reset(env, rng.environment)
    for _ in range(n_episodes):
        action = draw(behaviour_cdf, state)
        for step in range(1, episode_length + 1):
            observation, reward, terminated, truncated, _ = env.step(action)
            over = terminated or truncated or step == episode_length
            fresh = reset(env, rng.environment) if over else None
            state_next = fresh if terminated and fresh is not None else int(observation)
            action_next = draw(prior_cdf, state_next)
            rows.append((state, action, float(reward), state_next, action_next))
            if len(rows) == 10_000:
                done += len(rows)
                report(done)
                yield _of_rows(rows)
                rows = []
            state = state_next if fresh is None else fresh
            if over:
                break
            action = action_next if on_prior else draw(behaviour_cdf, state)
    report(done + len(rows))
    if rows:
        yield _of_rows(rows)


def _of_rows(rows: list[tuple[int, int, float, int, int]]) -> Transitions:
    return Transitions(*(np.array(column) for column in zip(*rows, strict=True)))


def _step_vector(
    env: gym.vector.VectorEnv[Any, Any, Any],
    n: int,
    rng: Streams,
    behaviour: np.ndarray,
    prior: np.ndarray,
    on_prior: bool,
    report: Report,
) -> Iterator[Transitions]:
    """The first ``n`` tuples, step by step and within a step by environment."""
    mode = env.metadata.get("autoreset_mode")
    if not isinstance(mode, AutoresetMode):
        raise InputError("metadata['autoreset_mode']", mode, "a gymnasium.vector.AutoresetMode")
    behaviour_cdf, prior_cdf = np.cumsum(behaviour, axis=1), np.cumsum(prior, axis=1)

    def draw(cdf: np.ndarray, s: np.ndarray) -> np.ndarray:
        x = rng.behaviour.random(len(s)) * cdf[s, -1]
        return np.asarray((cdf[s] <= x[:, None]).sum(1))

    state = np.array(env.reset(seed=_seed(rng))[0])
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
        first = after.copy()  # first state of the next episode, where `known`
        known = restarting.copy()
        if over.any() and mode == AutoresetMode.SAME_STEP:
            known |= over
            after[over] = [int(last) for last in info["final_obs"][over]]
        elif over.any() and mode == AutoresetMode.DISABLED:
            known |= over
            first = np.array(env.reset(seed=_seed(rng), options={"reset_mask": over})[0])
        ready = (~restarting & (~terminated | known)) | unfinished
        after = np.where((terminated & known) | unfinished, first, after)
        action_next = draw(prior_cdf, after)
        columns.append(tuple(column[ready] for column in (state, action, reward, after, action_next)))
        collected += int(ready.sum())
        report(min(collected, n))
        if collected >= n or collected - given >= 10_000:
            part = Transitions(*(np.concatenate(column) for column in zip(*columns, strict=True)))
            yield part.first(min(collected, n) - given)
            columns, given = [], collected
        goes_on = ~over & ~restarting
        unfinished = terminated & ~known
        held_state, held_action = state, action
        state = np.where(goes_on, after, first)
        action = np.where(goes_on & on_prior, action_next, draw(behaviour_cdf, state))
        restarting = over & ~known
        state, action = np.where(restarting, held_state, state), np.where(restarting, held_action, action)


def _seed(rng: Streams) -> int:
    return int(rng.environment.integers(2**31))


def reset(env: gym.Env[Any, Any], rng: np.random.Generator) -> int:
    """Reset ``env`` with a seed drawn from ``rng``; the first state."""
    return int(env.reset(seed=int(rng.integers(2**31)))[0])
