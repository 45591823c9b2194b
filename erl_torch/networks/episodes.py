"""Episodes that measure a policy: many at a time, from starts that are the same for every policy."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from erl_torch.networks.policy import Acting
from erl_torch.networks.problem import BoxProblem, Environment


class Played(NamedTuple):
    """Episodes of one policy."""

    returns: np.ndarray  # [n], without the reward of ends
    steps: np.ndarray  # [n]
    ended: np.ndarray  # [n] bool: by the environment, not by a limit
    kl: float  # KL(policy || prior) a step, nats

    def rate(self, end_reward: float) -> float:
        """Reward a step, that of ends among it."""
        return float((self.returns.sum() + end_reward * self.ended.sum()) / self.steps.sum())


class Stage:
    """Environments that play ``n`` episodes at once, each from the same start every time.

    Args:
        problem: whose environments.
        n: episodes, >= 1.
        horizon: steps of an episode at most, besides the problem's own limit.
        seed: whole number; its starts have nothing to do with those that are learnt from.
    """

    def __init__(self, problem: BoxProblem, n: int, horizon: int, seed: int) -> None:
        self._problem, self._n = problem, n
        self._limit = min(horizon, problem.time_limit or horizon)
        self._seeds = np.random.SeedSequence([seed, 2]).generate_state(n).tolist()
        self._environments: list[Environment] = []

    def play(self, policy: Acting, greedy: bool) -> Played:
        """The episodes of ``policy``, of its most probable actions where ``greedy``."""
        n, problem = self._n, self._problem
        if not self._environments:
            self._environments = [problem.make() for _ in range(n)]
        rng = np.random.default_rng(self._seeds)
        now = np.zeros((n, problem.n_observation), np.float32)
        for i, env in enumerate(self._environments):
            now[i] = np.asarray(env.reset(seed=int(self._seeds[i]))[0], np.float32).reshape(-1)
        returns, steps, ended, total = np.zeros(n), np.zeros(n, np.int64), np.zeros(n, bool), 0.0
        playing, width = np.arange(n), max(1, len(problem.low))
        while len(playing):
            uniform = rng.random((n, width))[playing]  # of each episode its own, however long the others are
            chosen, kl = policy.draw(now[playing], uniform)
            total += float(kl.sum())
            chosen = policy.best(now[playing]) if greedy else chosen
            left = []
            for i, a in zip(playing.tolist(), chosen, strict=True):
                taken = a if problem.low else int(a) + problem.first_action
                observation, reward, terminated, truncated, _ = self._environments[i].step(taken)
                now[i] = np.asarray(observation, np.float32).reshape(-1)
                returns[i] += float(reward)
                steps[i] += 1
                ended[i] = terminated
                if not (terminated or truncated or steps[i] == self._limit):
                    left.append(i)
            playing = np.array(left, np.int64)
        return Played(returns, steps, ended, total / float(steps.sum()))

    def close(self) -> None:
        for env in self._environments:
            env.close()
        self._environments = []
