"""Episodes of control tasks in their original, continuous dynamics, many at once.

The action is a draw from policy(.|cell of the state). An episode ends where the original terminates, or after
``max_steps``. Episodes advance together, one batched step of the dynamics at a time; each has its own column of
random numbers.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike

from erl_torch import checks
from erl_torch.envs.control import REWARDS, ControlEnv, ControlTask, control_task
from erl_torch.envs.discretise import UniformBins
from erl_torch.experience.play import Plan
from erl_torch.experience.sampling import policy_cdf
from erl_torch.experience.transitions import Transitions
from erl_torch.mdp.tabular import check_policy
from erl_torch.rng import Streams, streams


class Episodes(NamedTuple):
    """Figures of played episodes."""

    returns: np.ndarray  # [n_episodes] undiscounted
    lengths: np.ndarray  # [n_episodes] steps


class _Tick(NamedTuple):
    """One step of the episodes that are still running, n of them."""

    episode: np.ndarray  # [n]
    s: np.ndarray  # [n] cells
    a: np.ndarray  # [n]
    r: np.ndarray  # [n]
    s_next: np.ndarray  # [n]
    a_next: np.ndarray  # [n] drawn from the prior at s_next
    terminated: np.ndarray  # [n] bool


def rollout(
    task: str | ControlTask,
    policy: ArrayLike,
    n_episodes: int,
    max_steps: int,
    rng: np.random.Generator,
    bins: UniformBins | int | Sequence[int] | None = None,
    actions: tuple[float, ...] | None = None,
    reward: str = "original",
) -> Episodes:
    """Play ``n_episodes`` under ``policy`` [S, A] from the original's own first states.

    Args:
        task: as in ``estimate_mdp``.
        policy: [S, A] over the cells; rows sum to 1.
        n_episodes: whole number >= 1.
        max_steps: steps at which an episode is cut off.
        rng: draws first states and actions.
        bins, actions: as in ``estimate_mdp``, or ``UniformBins`` with other bounds; None is the task's own.
        reward: "original", or "cyclic" as in ``ControlEnv``.

    Raises:
        InputError: an argument out of range.
    """
    player = _Player(task, bins, actions, reward)
    table = check_policy("policy", policy, player.bins.n_cells, len(player.values))
    n_episodes, max_steps = checks.at_least("n_episodes", n_episodes, 1), checks.at_least("max_steps", max_steps, 1)
    checks.instance("rng", rng, np.random.Generator, "a generator, as numpy.random.default_rng(0)")
    returns, lengths = np.zeros(n_episodes), np.zeros(n_episodes, np.int64)
    state = player.task.initial(n_episodes, rng)
    for tick in player.play(state, table, None, max_steps, rng):
        returns[tick.episode] += tick.r
        lengths[tick.episode] += 1
    return Episodes(returns, lengths)


def collect_rollouts(
    task: str | ControlTask,
    n_episodes: int,
    episode_length: int,
    seed: int | Streams = 0,
    behaviour_policy: ArrayLike | None = None,
    prior_policy: ArrayLike | None = None,
    bins: UniformBins | int | Sequence[int] | None = None,
    actions: tuple[float, ...] | None = None,
    reward: str = "cyclic",
) -> Transitions:
    """``erl_torch.collect`` in the original dynamics: episode after episode, as a stream of tuples.

    Ends of episodes, a', seed and policies as in ``erl_torch.experience.collect``: where an episode terminates, s' is
    the first state of the next. ``reward`` is "cyclic" (see ``rollout``) unless asked for: some originals pay the
    same for every step.

    Raises:
        InputError: an argument out of range.
    """
    player = _Player(task, bins, actions, reward)
    n_states, n_actions = player.bins.n_cells, len(player.values)
    n_episodes = checks.at_least("n_episodes", n_episodes, 1)
    episode_length = checks.at_least("episode_length", episode_length, 1)
    prior = check_policy("prior_policy", prior_policy, n_states, n_actions)
    on_prior = behaviour_policy is None
    behaviour = prior if on_prior else check_policy("behaviour_policy", behaviour_policy, n_states, n_actions)
    draws = seed if isinstance(seed, Streams) else streams(seed)

    # One first state more, for the end of the last episode.
    first = player.task.initial(n_episodes + 1, draws.environment)
    after = player.cells(first)[1:]
    ticks = player.play(first[:-1], behaviour, prior, episode_length, draws.behaviour)
    episode, s, a, r, s_next, a_next, terminated = map(np.concatenate, zip(*ticks, strict=True))
    s_next[terminated] = after[episode[terminated]]
    a_next[terminated] = player.draw(_table(prior), s_next[terminated], draws.behaviour.random(terminated.sum()))
    order = np.argsort(episode, kind="stable")
    return Transitions(*(column[order] for column in (s, a, r, s_next, a_next)))


class _Player:
    def __init__(
        self,
        task: str | ControlTask,
        bins: UniformBins | int | Sequence[int] | None,
        actions: tuple[float, ...] | None,
        reward: str,
    ) -> None:
        self.task = control_task(task)
        self.bins = bins if isinstance(bins, UniformBins) else self.task.uniform_bins(bins)
        self.values = torch.tensor(self.task.action_values(actions), dtype=torch.float64)
        checks.one_of("reward", reward, REWARDS)
        self.cyclic = reward == "cyclic"

    def cells(self, state: torch.Tensor) -> np.ndarray:
        return self.bins.cells(self.task.variables(state)).numpy()

    def draw(self, cdf: np.ndarray, cells: np.ndarray, x: np.ndarray) -> np.ndarray:
        """[n] actions: the first with x < cdf [S, A]."""
        return np.asarray((x[:, None] >= cdf[cells]).sum(1))

    def play(
        self,
        state: torch.Tensor,
        policy: np.ndarray,
        prior: np.ndarray | None,
        max_steps: int,
        rng: np.random.Generator,
    ) -> Iterator[_Tick]:
        """Yield every step. a' is a draw from ``prior``, which is the action taken next if it is the policy or None."""
        n = len(state)
        behaviour_cdf = _table(policy)
        apart = prior is not None and prior is not policy
        prior_cdf = _table(prior) if prior is not None and apart else behaviour_cdf
        episode = np.arange(n)
        s = self.cells(state)
        a = self.draw(behaviour_cdf, s, rng.random(n))
        for _ in range(max_steps):
            step = self.task.step(state, self.values[a])
            s_next = self.cells(step.state)
            # A number for every episode, running or not: an episode does not depend on the ends of others.
            a_next = self.draw(prior_cdf, s_next, rng.random(n)[episode])
            terminated = step.terminated.numpy()
            reward = step.reward.numpy()
            if self.cyclic:
                reward = np.where(terminated, 0.0, reward) - self.task.max_reward
            yield _Tick(episode, s, a, reward, s_next, a_next, terminated)
            taken = self.draw(behaviour_cdf, s_next, rng.random(n)[episode]) if apart else a_next
            state, s, a = step.state, s_next, taken
            if terminated.any():
                on = ~terminated
                episode, s, a, state = episode[on], s[on], a[on], state[torch.from_numpy(on)]
                if not len(episode):
                    return


def _table(policy: np.ndarray) -> np.ndarray:
    return policy_cdf(policy).reshape(policy.shape)


def episodes_of(env: ControlEnv, plan: Plan, reward: str | None) -> Transitions:
    """Episodes of ``env``, all at once; ``reward`` as in ``rollout``, None is the environment's own."""
    return collect_rollouts(
        env.task,
        plan.n_episodes,
        plan.episode_length,
        plan.rng,
        None if plan.on_prior else plan.behaviour,
        plan.prior,
        env.bins,
        None if env.task.max_action is None else env.actions,
        env.reward if reward is None else reward,
    )
