"""An environment that a learner steps while it learns.

Every episode has a seed of its own. What is known of the present one is its number and the actions since its reset, so
that a run that goes on resets the environment with that seed and takes the same actions again: every environment that
keeps Gymnasium's contract (what follows a seeded reset is a function of the actions) is then where it was.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from erl_torch.checks import InputError
from erl_torch.networks.problem import BoxProblem, Environment
from erl_torch.networks.replay import Replay


@dataclass(frozen=True)
class Exploration:
    """How often actions are drawn from the prior, and for how long each is held.

    Args:
        start, end: shares of the steps that explore, in [0, 1], at the beginning and from ``fraction`` of the run on.
        fraction: of the run, in (0, 1], over which the share goes from start to end, on a line.
        hold: steps that an exploratory action is held in the mean (a geometric length), >= 1.
    """

    start: float
    end: float
    fraction: float
    hold: float

    def share(self, step: int, n_steps: int) -> float:
        """Of the steps that explore, at ``step`` of ``n_steps``."""
        return self.start + (self.end - self.start) * min(1.0, step / max(1.0, self.fraction * n_steps))

    def begins(self, step: int, n_steps: int) -> float:
        """The chance that an exploratory action begins where none is held, so that the share of time is ``share``."""
        share = self.share(step, n_steps)
        return share / (self.hold * (1.0 - share) + share)


@dataclass(frozen=True, eq=False)
class Walk:
    """Where one environment stands, as a value.

    Args:
        n_steps: taken so far.
        episode: number of the present one.
        actions: taken since its reset.
        observation: the present one, [d] float32.
        held: steps that ``action`` is still held.
        action: the exploratory action that is held.
        generator: state of the generator of exploration and of the policy's draws.
        episode_return: rewards of the present episode, without ``end_reward``.
        returns: of the episodes that ended in the last epoch.
    """

    n_steps: int
    episode: int
    actions: np.ndarray
    observation: np.ndarray
    held: int
    action: np.ndarray
    generator: dict[str, Any]
    episode_return: float
    returns: tuple[float, ...]


def seed_of(seed: int, episode: int) -> int:
    """What the environment of ``seed`` is reset with before ``episode``."""
    return int(np.random.SeedSequence([seed, episode]).generate_state(1)[0])


class Live:
    """The environment of one seed, and where it stands.

    Args:
        problem: what there is to learn.
        seed: whole number >= 0.
    """

    def __init__(self, problem: BoxProblem, seed: int) -> None:
        self.problem, self.seed = problem, seed
        self._env: Environment | None = None
        self._at: Walk | None = None  # where the environment stands
        self._rng = np.random.default_rng()

    def start(self) -> Walk:
        """Before the first step."""
        rng = np.random.default_rng(np.random.SeedSequence([self.seed, 0]).spawn(1)[0])
        k = len(self.problem.low)
        actions = np.zeros((0, k), np.float32) if k else np.zeros(0, np.int32)
        action = np.zeros(k, np.float32) if k else np.zeros((), np.int32)
        observation = self._reset(0)
        self._at = Walk(0, 0, actions, observation, 0, action, dict(rng.bit_generator.state), 0.0, ())
        return self._at

    def _reset(self, episode: int) -> np.ndarray:
        if self._env is None:
            self._env = self.problem.make()
        observation, _ = self._env.reset(seed=seed_of(self.seed, episode))
        return self._flat(observation)

    def _flat(self, observation: Any) -> np.ndarray:
        flat = np.asarray(observation, np.float32).reshape(-1)
        if flat.size != self.problem.n_observation or not np.isfinite(flat).all():
            allowed = f"{self.problem.n_observation} finite numbers in every observation"
            raise InputError(f"observation of {self.problem.name}", observation, allowed)
        return flat

    def _stand(self, walk: Walk) -> None:
        """Bring the environment to where ``walk`` is. Raises InputError where it comes to another observation."""
        if walk is self._at:
            return
        observation = self._reset(walk.episode)
        for action in walk.actions:
            observation = self._flat(self._step(action)[0])
        if not np.array_equal(observation, walk.observation):
            allowed = (
                "one whose steps are a function of the seed of its reset and the actions, to go on from a checkpoint"
            )
            raise InputError("env", self.problem.name, allowed)
        self._at = walk

    def _step(self, action: Any) -> tuple[Any, float, bool, bool]:
        assert self._env is not None
        taken = action if self.problem.low else int(action) + self.problem.first_action
        observation, reward, terminated, truncated, _ = self._env.step(taken)
        reward = float(reward)
        if not math.isfinite(reward):
            raise InputError(f"reward of {self.problem.name}", reward, "a finite number")
        return observation, reward, bool(terminated), bool(truncated)

    def collect(
        self, walk: Walk, replay: Replay, n: int, n_total: int, exploration: Exploration, choose: Any, learn: Any,
        scale: float = 1.0, time_limit: int | None = None,
    ) -> tuple[Walk, Replay]:  # fmt: skip
        """``n`` steps from ``walk``, stored in ``replay``, and learnt from one by one.

        Args:
            walk: where it stands.
            replay: the tuples so far; a value, as ``walk``.
            n: steps, >= 1.
            n_total: steps of the whole run.
            exploration: its schedule.
            choose: (observation [1, d], uniform numbers [max(1, k)]) -> action of the policy.
            learn: called after each step with the number of tuples.
            scale: of rewards where they are stored.
            time_limit: steps of an episode at most; None is none.

        Raises:
            InputError: an observation or reward that is no number, or an environment that is not where it was.
        """
        self._stand(walk)
        self._at = None  # until all is done
        problem, rng = self.problem, self._rng
        rng.bit_generator.state = walk.generator
        replay = replay.with_room(n)
        rows, at, stored = len(replay.reward), replay.at, replay.n
        now = walk.observation.reshape(1, -1).copy()
        taken = list(walk.actions)
        held, episode, total = walk.held, walk.episode, walk.episode_return
        action: Any = walk.action
        returns, width = [], max(1, len(problem.low))
        limit = time_limit or 0
        low, high = np.array(problem.low, np.float32), np.array(problem.high, np.float32)
        for step in range(walk.n_steps, walk.n_steps + n):
            if held:
                held -= 1
                chosen = action
            elif rng.random() < exploration.begins(step, n_total):
                action = rng.uniform(low, high).astype(np.float32) if problem.low else rng.integers(problem.n_actions)
                chosen, held = action, int(rng.geometric(1.0 / exploration.hold)) - 1
            else:
                chosen = choose(now, rng.random(width))
            observation, reward, terminated, truncated = self._step(chosen)
            taken.append(chosen)
            total += reward
            following = self._flat(observation)
            replay.observation[at], replay.action[at] = now[0], chosen
            replay.reward[at] = scale * (reward + (problem.end_reward if terminated else 0.0))
            replay.ended[at] = terminated
            over = terminated or truncated or len(taken) == limit
            if over:
                returns.append(total)
                taken, held, total, episode = [], 0, 0.0, episode + 1
                first = self._reset(episode)
                replay.following[at] = first if terminated else following
                now[0] = first
            else:
                replay.following[at] = now[0] = following
            at = (at + 1) % rows
            stored = min(stored + 1, rows)
            learn(stored)
        kind = walk.actions.dtype
        actions = np.array(taken, kind).reshape(len(taken), *walk.actions.shape[1:])
        walk = Walk(
            walk.n_steps + n, episode, actions, now[0].copy(), held, np.asarray(action, kind),
            dict(rng.bit_generator.state), total, tuple(returns),
        )  # fmt: skip
        self._at = walk
        return walk, replace(replay, n=stored, at=at)
