"""A source of experience: here one that prefers an action."""

from dataclasses import dataclass

import numpy as np

import erl_torch


@dataclass(frozen=True)
class Biased(erl_torch.Source):
    """Action 0 has probability ``share``; the others have the rest in equal parts."""

    n_tuples: int = 20_000
    share: float = 0.7  # in (0, 1)

    def __call__(self, problem, seed, report):
        policy = np.full((problem.n_states, problem.n_actions), (1 - self.share) / (problem.n_actions - 1))
        policy[:, 0] = self.share
        return erl_torch.collect(problem.source, 1, self.n_tuples, seed, policy, problem.prior, report)
