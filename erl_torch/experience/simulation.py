"""Experience of many replicas: one stream for all of them, or one per replica, recorded or simulated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from erl_torch import checks
from erl_torch.experience.collect import collect
from erl_torch.experience.experience import Experience
from erl_torch.experience.transitions import Transitions
from erl_torch.mdp.tabular import TabularMDP, check_policy

KEEP_BYTES = 1 << 30  # of tuples kept by default
TUPLE_BYTES = 8  # a tuple in the interleaved loop


@dataclass(frozen=True, eq=False)
class Simulation:
    """One stream of ``mdp`` per seed: ``n_episodes`` of ``episode_length`` steps, a' from the learners' prior.

    Args:
        mdp: what is simulated; its sizes are those of the learners.
        n_episodes, episode_length: whole numbers >= 1; their product is the length of each stream.
        seeds: whole numbers >= 0, one per replica.
        behaviour_policy: [S, A]; None is the prior.
        keep: hold the tuples in memory (true), sample them again in every pass (false), or what fits 1 GiB (None).

    Raises:
        InputError: an argument out of its range.
    """

    mdp: TabularMDP
    n_episodes: int
    episode_length: int
    seeds: Sequence[int]
    behaviour_policy: ArrayLike | None = None
    keep: bool | None = None

    def __post_init__(self) -> None:
        checks.plain(self)
        checks.instance("mdp", self.mdp, TabularMDP, "a TabularMDP")
        if self.keep is not None:
            checks.flag("keep", self.keep)
        checks.at_least("n_episodes", self.n_episodes, 1)
        checks.at_least("episode_length", self.episode_length, 1)
        if self.behaviour_policy is not None:
            sizes = self.mdp.n_states, self.mdp.n_actions
            behaviour = check_policy("behaviour_policy", self.behaviour_policy, *sizes, self.mdp.allowed)
            object.__setattr__(self, "behaviour_policy", behaviour)
        seeds = checks.sequence("seeds", self.seeds)
        for seed in seeds:
            checks.at_least("seeds", seed, 0)
        if not isinstance(self.seeds, Sequence):
            object.__setattr__(self, "seeds", seeds)  # an iterator is empty by now

    @property
    def n_tuples(self) -> int:
        """Of each stream."""
        return self.n_episodes * self.episode_length

    def stream(self, replica: int, prior_policy: ArrayLike | None) -> Transitions:
        """The tuples of one replica."""
        seed = int(self.seeds[replica])
        return collect(self.mdp, self.n_episodes, self.episode_length, seed, self.behaviour_policy, prior_policy)


ReplicaExperience = Transitions | Sequence[Transitions] | Simulation


def streams_of(experience: Transitions | Sequence[Transitions]) -> Sequence[Transitions]:
    """Recorded streams, one for all or one per replica."""
    return [experience] if isinstance(experience, Transitions) else experience


def longest(experience: ReplicaExperience) -> int:
    """Tuples of the longest stream."""
    return experience.n_tuples if isinstance(experience, Simulation) else max(map(len, streams_of(experience)))


def digest(experience: Experience | ReplicaExperience | None) -> object:
    """The checksum of a stream, or of each; None of a simulation, whose settings tell all, or of nothing."""
    if experience is None or isinstance(experience, Simulation):
        return None
    if isinstance(experience, Sequence):
        return [data.checksum() for data in experience]
    return experience.checksum()


def tuples_of(experience: ReplicaExperience, r: int, prior: np.ndarray) -> Transitions:
    """The stream of one replica."""
    if isinstance(experience, Transitions):
        return experience
    return experience.stream(r, prior) if isinstance(experience, Simulation) else experience[r]


def fits(experience: ReplicaExperience, n_replicas: int, tuple_bytes: int) -> bool:
    """Whether the tuples of all replicas are to be kept, at so many bytes each."""
    if isinstance(experience, Simulation) and experience.keep is not None:
        return bool(experience.keep)
    return longest(experience) * n_replicas * tuple_bytes <= KEEP_BYTES
