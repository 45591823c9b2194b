"""Streams of tuples of a known MDP, sampled in compiled code: any number of them side by side, one lane per stream.

A lane draws what NumPy's generators of its seed draw, in the same order, so that its stream does not depend on the
lanes beside it or on how it is cut.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from erl_torch.experience import kernels
from erl_torch.mdp.tabular import TabularMDP
from erl_torch.rng import Streams

WORD = (1 << 64) - 1


class Sampler:
    """Lanes of endless streams: episodes of ``episode_length`` steps, one after the other.

    Args:
        mdp: what is sampled.
        rngs: the named streams of each lane; ``take`` leaves them as they are, ``give_back`` moves them on.
        episode_length: steps per episode.
        behaviour, prior: [S, A]; with ``on_prior`` the action taken next is a'.
    """

    def __init__(
        self,
        mdp: TabularMDP,
        rngs: Sequence[Streams],
        episode_length: int,
        behaviour: np.ndarray,
        prior: np.ndarray,
        on_prior: bool,
    ) -> None:
        indptr, indices, cdf, self.reward, start_cdf = sampling_tables(mdp)
        self.n_states, self.n_actions = self.reward.shape
        self.rngs = tuple(rngs)
        self.done = 0  # tuples sampled so far, of each lane
        self.now = np.zeros(len(self.rngs), np.uint64)
        self.environment = _words([rng.environment for rng in self.rngs])
        self.behaviour = _words([rng.behaviour for rng in self.rngs])
        self.tables = (
            indptr,
            indices,
            cdf,
            _levels(int(np.diff(indptr).max())),
            start_cdf,
            policy_cdf(behaviour),
            policy_cdf(prior),
            on_prior,
            self.n_actions,
            _levels(self.n_actions),
            episode_length,
        )

    def take(self, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The next ``n`` tuples of each lane: (pair, entry, pair_next), [n, lanes] int32.

        pair = s * A + a; entry is the index of s' in the transition's CSR data; pair_next = s' * A + a'.
        """
        pair, entry, pair_next = (np.empty((n, len(self.rngs)), np.int32) for _ in range(3))
        kernels.sample_rows(*self.tables, self.environment, self.behaviour, self.now, self.done, pair, entry, pair_next)
        self.done += n
        return pair, entry, pair_next

    def give_back(self) -> None:
        """Move the generators behind the lanes on to where the lanes are."""
        for i, rng in enumerate(self.rngs):
            for generator, words in ((rng.environment, self.environment), (rng.behaviour, self.behaviour)):
                bits = generator.bit_generator
                state: Any = bits.state
                state["state"]["state"] = (int(words[0, i]) << 64) | int(words[1, i])
                bits.state = state


def sampling_tables(mdp: TabularMDP) -> tuple[np.ndarray, ...]:
    """(indptr, indices, cdf, reward, start cdf) as the sampling kernels take them."""
    p = mdp.transition
    start_cdf = kernels.cumulative_rows(np.array([0, mdp.n_states]), mdp.start)
    return p.indptr, p.indices, kernels.cumulative_rows(p.indptr, p.data), mdp.reward, start_cdf


def policy_cdf(policy: np.ndarray) -> np.ndarray:
    """Running sums of each row, flat [S*A]."""
    n_states, n_actions = policy.shape
    rows = np.arange(0, n_states * n_actions + 1, n_actions)
    return np.asarray(kernels.cumulative_rows(rows, policy.ravel()))


def _levels(longest: int) -> int:
    """Halvings that bring ``longest`` down to one."""
    return (longest - 1).bit_length()


def _words(generators: Sequence[np.random.Generator]) -> np.ndarray:
    """State and increment of PCG64 generators as [4, lanes] uint64: both high word first."""
    states: list[Any] = [generator.bit_generator.state["state"] for generator in generators]
    rows = [[x >> 64, x & WORD, c >> 64, c & WORD] for x, c in ((s["state"], s["inc"]) for s in states)]
    return np.ascontiguousarray(np.array(rows, np.uint64).T)
