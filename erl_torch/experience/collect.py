"""Collecting a stream of tuples under a behaviour policy.

A TabularMDP, or an environment of this package that follows one, is sampled in a compiled loop, this package's
control tasks in batches; any other Gymnasium environment with finite spaces, or vector of environments, is taken
through ``env.step``. States and actions are numbered as ``erl_torch.Labels.of_space`` does.

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
from typing import Any, overload

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike

from erl_torch import checks
from erl_torch.envs.encoded import encoded
from erl_torch.experience.play import Plan, tuples, vector_tuples
from erl_torch.experience.recording import FileRecording, read_experience, write_chunks
from erl_torch.experience.sampling import Sampler
from erl_torch.experience.transitions import COLUMNS, TYPES, Transitions, join
from erl_torch.mdp.from_gymnasium import changed_by, known_mdp, sizes
from erl_torch.mdp.masks import ActionMasks
from erl_torch.mdp.tabular import TabularMDP, check_policy
from erl_torch.rng import Streams, streams

BLOCK = 1_000_000  # steps per compiled call, so that signals and progress bars are served
TUPLE_BYTES = 32  # of a tuple while it is sampled: two pairs and five columns
COLUMN_BYTES = 24  # of a tuple in a file, or in memory

Report = Callable[[int], object]
Source = TabularMDP | gym.Env[Any, Any] | gym.vector.VectorEnv[Any, Any, Any]


@overload
def collect(
    source: Source,
    n_episodes: int,
    episode_length: int,
    seed: int | Streams = 0,
    behaviour_policy: ArrayLike | None = None,
    prior_policy: ArrayLike | None = None,
    report: Report | None = None,
    save_to: None = None,
    masks: ActionMasks | None = None,
) -> Transitions: ...


@overload
def collect(
    source: Source,
    n_episodes: int,
    episode_length: int,
    seed: int | Streams = 0,
    behaviour_policy: ArrayLike | None = None,
    prior_policy: ArrayLike | None = None,
    report: Report | None = None,
    *,
    save_to: str | os.PathLike[str],
    masks: ActionMasks | None = None,
) -> Transitions | FileRecording: ...


def collect(
    source: Source,
    n_episodes: int,
    episode_length: int,
    seed: int | Streams = 0,
    behaviour_policy: ArrayLike | None = None,
    prior_policy: ArrayLike | None = None,
    report: Report | None = None,
    save_to: str | os.PathLike[str] | None = None,
    masks: ActionMasks | None = None,
) -> Transitions | FileRecording:
    """Collect experience, in memory or in a directory of columns.

    Args:
        source: a TabularMDP, or a Gymnasium environment or vector environment with finite spaces.
        n_episodes, episode_length: whole numbers >= 1. A TabularMDP gives exactly their product in tuples, as does a
            vector environment, which ends its episodes itself; an environment's own ends make episodes shorter.
        seed: a whole number, or the streams of one.
        behaviour_policy: [S, A]; None is the prior.
        prior_policy: [S, A], behind a'; None is uniform over the actions of each state. Where the environment masks
            actions (``info["action_mask"]``), it is taken on those that are left.
        report: called with the number of tuples after each block.
        save_to: a directory that the same tuples are written to, in the memory of one block, whatever their number.
            (This package's control tasks need the memory of all: their episodes are played at once.)
        masks: where the actions of each state are noted, as the environment masks them.

    Returns:
        The tuples; with ``save_to``, what ``read_experience`` reads from there.

    Raises:
        InputError: an argument out of range, spaces that are not finite, tuples that do not fit the memory or the
            disk, a directory that holds anything but columns, a policy that takes an action that a state does not have,
            or masks that differ between two visits of a state.
    """
    arguments = n_episodes, episode_length, seed, behaviour_policy, prior_policy, report, masks
    if save_to is not None:
        return read_experience(record(source, save_to, *arguments), *sizes(source))
    chunks, n = _stream(source, "memory", *arguments)
    return _filled(chunks, n) if n else join(list(chunks))


def record(
    source: Source,
    directory: str | os.PathLike[str],
    n_episodes: int,
    episode_length: int,
    seed: int | Streams = 0,
    behaviour_policy: ArrayLike | None = None,
    prior_policy: ArrayLike | None = None,
    report: Report | None = None,
    masks: ActionMasks | None = None,
) -> Path:
    """Write to ``directory`` without reading it back; else as ``collect`` with ``save_to``."""
    arguments = n_episodes, episode_length, seed, behaviour_policy, prior_policy, report, masks
    return write_chunks(_stream(source, str(directory), *arguments)[0], directory)


def _stream(
    source: Source,
    destination: str,
    n_episodes: int,
    episode_length: int,
    seed: int | Streams,
    behaviour_policy: ArrayLike | None,
    prior_policy: ArrayLike | None,
    report: Report | None,
    masks: ActionMasks | None,
) -> tuple[Iterator[Transitions], int]:
    """The tuples, a block at a time, and their number; 0 where it shows only as they come.

    ``destination`` is "memory", or the directory that they go to. Raises InputError where they do not fit there.
    """
    n_episodes = checks.at_least("n_episodes", n_episodes, 1)
    episode_length = checks.at_least("episode_length", episode_length, 1)
    source = encoded(source)
    n_states, n_actions = sizes(source)
    mdp = known_mdp(source)
    prior = check_policy("prior_policy", prior_policy, n_states, n_actions, None if mdp is None else mdp.allowed)
    on_prior = behaviour_policy is None
    behaviour = prior
    if not on_prior:
        behaviour = check_policy("behaviour_policy", behaviour_policy, n_states, n_actions, prior > 0)
    rng = seed if isinstance(seed, Streams) else streams(seed)
    plan = Plan(n_episodes, episode_length, rng, behaviour, prior, on_prior, masks)
    n = 0
    if mdp is not None or isinstance(source, gym.vector.VectorEnv):
        n = n_episodes * episode_length
        _fits(destination, plan, n * (TUPLE_BYTES if destination == "memory" else COLUMN_BYTES))
    if mdp is not None:
        chunks = _of_model(mdp, plan)
    elif isinstance(source, gym.vector.VectorEnv):
        chunks = vector_tuples(source, plan)
    else:
        assert not isinstance(source, TabularMDP)
        batch = batched(source)
        if batch is not None:
            chunks = iter([batch(plan, None)])
        else:
            chunks = tuples(source, plan)
            chunks = _holding(chunks, plan) if destination == "memory" else chunks
    return chunks if report is None else _reported(chunks, report), n


def _reported(chunks: Iterator[Transitions], report: Report) -> Iterator[Transitions]:
    done = 0
    for chunk in chunks:
        done += len(chunk)
        report(done)
        yield chunk


def _holding(chunks: Iterator[Transitions], plan: Plan) -> Iterator[Transitions]:
    """``chunks`` of a stream whose length shows as it goes. Raises InputError before it is too long to be joined."""
    held, looked_at = 0, 20_000
    for chunk in chunks:
        held += len(chunk)
        if held >= looked_at:
            _fits("memory", plan, COLUMN_BYTES * held)  # as much again
            looked_at = held + held // 8
        yield chunk


def _fits(destination: str, plan: Plan, needed: int) -> None:
    """Raise InputError unless ``needed`` bytes of a stream fit ``destination``."""
    what = f"a stream of {plan.n_episodes:,} episodes of {plan.episode_length:,} steps"
    if destination == "memory":
        checks.memory("n_episodes", plan.n_episodes, needed, what)
    else:
        checks.disk("n_episodes", plan.n_episodes, needed, what, destination)


def batched(env: gym.Env[Any, Any]) -> Callable[[Plan, str | None], Transitions] | None:
    """The function (plan, reward) that plays all episodes of ``env`` at once; None where there is none.

    ``reward`` is as in ``rollout``; None is that of ``env``. There is none for an ``env`` that a wrapper changes.
    """
    base = env.unwrapped
    control = sys.modules.get("erl_torch.envs.control")  # which loads torch: there where there is such an environment
    if control is None or not isinstance(base, control.ControlEnv) or changed_by(env) is not None:
        return None
    from erl_torch.experience.rollouts import episodes_of

    longest = env.spec.max_episode_steps if env.spec else None

    def collect_at_once(plan: Plan, reward: str | None) -> Transitions:
        return episodes_of(
            base, plan._replace(episode_length=min(plan.episode_length, longest or plan.episode_length)), reward
        )

    return collect_at_once


def _of_model(mdp: TabularMDP, plan: Plan) -> Iterator[Transitions]:
    """The tuples of ``plan``, sampled from ``mdp`` in compiled code, ``BLOCK`` at a time."""
    n = plan.n_episodes * plan.episode_length
    sampler = Sampler(mdp, [plan.rng], plan.episode_length, plan.behaviour, plan.prior, plan.on_prior)
    for begin in range(0, n, BLOCK):
        here, _, there = sampler.take(min(n, begin + BLOCK) - begin)
        yield _of_pairs(here[:, 0], there[:, 0], mdp.reward)
    sampler.give_back()


def _of_pairs(pair: np.ndarray, pair_next: np.ndarray, reward: np.ndarray) -> Transitions:
    """The tuples of pairs s * A + a and s' * A + a', [N] int32 each, with rewards from the table [S, A] of an MDP."""
    s, a = np.divmod(pair, np.int32(reward.shape[1]))
    s_next, a_next = np.divmod(pair_next, np.int32(reward.shape[1]))
    return Transitions.checked(s, a, reward.ravel()[pair], s_next, a_next)


def _filled(chunks: Iterator[Transitions], n: int) -> Transitions:
    """``n`` tuples as one, in the memory of their columns and one chunk."""
    columns = [np.empty(n, TYPES[name].newbyteorder("=")) for name in COLUMNS]
    done = 0
    for chunk in chunks:
        for name, column in zip(COLUMNS, columns, strict=True):
            column[done : done + len(chunk)] = getattr(chunk, name)
        done += len(chunk)
    return Transitions.checked(*columns)
