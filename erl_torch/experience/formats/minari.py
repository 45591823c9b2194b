"""Episodes of a local Minari data set, as tuples (needs minari and h5py).

Episodes become tuples as ``erl_torch.experience.collect`` has them. Where an episode terminated, s' is the first state
of the next one (the first episode follows the last); where it was truncated, or just ends, s' is the state reached. a'
is the action taken next where the behaviour policy was the prior (``on_prior``), an action was taken at s', and the
prior has it; else it is drawn from the prior, with the stream "behaviour" of the seed, one number per tuple.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from typing import Any, Protocol

import gymnasium as gym
import numpy as np

from erl_torch.checks import InputError
from erl_torch.envs.discretise import Discretise
from erl_torch.experience.formats.format import Batch, Options, plugin, readable
from erl_torch.experience.formats.table import Cells, InOrder
from erl_torch.experience.transitions import COLUMNS
from erl_torch.labels import Labels, SpaceLabels
from erl_torch.mdp.tabular import check_policy
from erl_torch.rng import streams

PREFIX = "minari:"
Space = gym.spaces.Space[Any]


def claims(path: str) -> bool:
    return path.startswith(PREFIX)


def reader(path: str, options: Options) -> Minari:
    return Minari(path, options)


class Episode(Protocol):
    """What is used of an episode of Minari, n steps long."""

    observations: object  # [n + 1, ...]
    actions: object  # [n, ...]
    rewards: np.ndarray  # [n]
    terminations: np.ndarray  # [n] bool


class Spaces(Protocol):
    """What is used of a data set of Minari, or of an environment."""

    observation_space: Space
    action_space: Space


class Minari:
    """Episodes of a local Minari data set, as tuples."""

    def __init__(self, path: str, options: Options) -> None:
        self.path, self.short = path, 0
        self._on_prior, self._seed = options.on_prior, options.seed
        prior = check_policy("prior_policy", options.prior_policy, options.n_states, options.n_actions)
        self._prior, self._cdf = prior, np.cumsum(prior, axis=1)
        env = options.env
        while isinstance(env, gym.Wrapper) and not isinstance(env, Discretise):
            env = env.env
        self._bins = env if isinstance(env, Discretise) else None

    def episodes(self) -> Iterator[tuple[Batch, bool]]:
        """(s, a, r, s' of an episode, whether it terminated), one after the other. Raises InputError."""
        minari = plugin("minari", self.path, "minari")
        with readable(self.path, "Minari data set on this machine"):
            data = minari.load_dataset(self.path.removeprefix(PREFIX))
            episodes = iter(data.iterate_episodes())
        for number in itertools.count():
            with readable(self.path, f"Minari data set (from episode {number} on)"):
                episode = next(episodes, None)
                if episode is None:
                    return
                found = self._tuples(episode, number, data)
            yield found

    def batches(self, rows: int, strict: bool) -> Iterator[Batch]:
        held: list[tuple[Batch, np.ndarray, bool]] = []  # with one number per tuple, and whether it terminated
        rng = streams(self._seed).behaviour
        first: tuple[int, int] | None = None
        ready: list[Batch] = []
        for batch, terminated in self.episodes():
            if not len(batch["s"]):
                continue
            begins = int(batch["s"][0]), int(batch["a"][0])
            first = first or begins
            ready += [self._ended(*before, begins) for before in held]
            held = [(batch, rng.random(len(batch["s"])), terminated)]
            if sum(len(batch["s"]) for batch in ready) >= rows:
                yield _joined(ready)
                ready = []
        if first is not None:
            ready += [self._ended(*before, first) for before in held]
        if ready:
            yield _joined(ready)

    def _ended(self, batch: Batch, x: np.ndarray, terminated: bool, begins: tuple[int, int]) -> Batch:
        """An episode with a', and with s' of its end: both depend on the (s, a) with which the next one ``begins``."""
        s_next = batch["s_next"].copy()
        if terminated:
            s_next[-1] = begins[0]
        known = np.clip(s_next, 0, len(self._cdf) - 1)  # what is out of range is named later
        cdf = self._cdf[known]
        a_next = (cdf <= (x * cdf[:, -1])[:, None]).sum(1)
        if self._on_prior:
            taken = np.append(batch["a"][1:], begins[1] if terminated else -1)
            has = self._prior[known, np.clip(taken, 0, self._prior.shape[1] - 1)] > 0
            a_next = np.where((taken >= 0) & has, taken, a_next)
        return {**batch, "s_next": s_next, "a_next": a_next}

    def _tuples(self, episode: Episode, number: int, data: Spaces) -> tuple[Batch, bool]:
        r = np.asarray(episode.rewards)
        n = len(r)
        s = self._states(episode.observations, data.observation_space, n + 1)
        a = self._actions(episode.actions, data, n)
        if not (len(s) == len(a) + 1 == len(r) + 1 == len(episode.terminations) + 1):
            raise ValueError(f"episode {number} has {len(s)} observations, {len(a)} actions and {len(r)} rewards")
        if np.any(episode.terminations[:-1]):
            raise ValueError(f"episode {number} terminates before its last step")
        return {"s": s[:-1], "a": a, "r": r, "s_next": s[1:]}, bool(len(r) and episode.terminations[-1])

    def _states(self, observations: object, space: Space, n: int) -> np.ndarray:
        if (labels := _composed(space)) is not None:
            return labels.encode_batch(observations, n, f"{self.path}: observations")
        x = np.asarray(observations)
        if x.ndim == 1 and x.dtype.kind in "iu":
            return np.asarray(x.astype(np.int64) - _start(space))
        if self._bins is None or x.ndim != 2 or x.dtype.kind != "f":
            raise InputError(f"{self.path}: observation_space", space, "Discrete, or a Box that env cuts into bins")
        features = self._bins.features
        x = x.astype(np.float64) if features is None else np.stack([features(row) for row in x])
        return np.asarray(self._bins.bins.cells(x))

    def _actions(self, actions: object, data: Spaces, n: int) -> np.ndarray:
        if (labels := _composed(data.action_space)) is not None:
            return labels.encode_batch(actions, n, f"{self.path}: actions")
        x = np.asarray(actions)
        if x.ndim == 1 and x.dtype.kind in "iu":
            return np.asarray(x.astype(np.int64) - _start(data.action_space))
        if self._bins is None or x.ndim != 2 or self._bins.actions.ndim != 2:
            raise InputError(
                f"{self.path}: action_space", data.action_space, "Discrete, or a Box that env has actions of"
            )
        return np.asarray(((x[:, None] - self._bins.actions) ** 2).sum(2).argmin(1))  # the nearest


class Episodes(InOrder):
    """Episodes of a local Minari data set with Discrete spaces, as a table with a row a step."""

    names: Sequence[str] = ("s", "a", "r", "s_next", "terminated", "truncated", "episode")

    def __init__(self, path: str) -> None:
        self.path = path
        self._episodes = Minari(path, Options(1, 1)).episodes

    def batches(self, names: Sequence[str], rows: int, strict: bool) -> Iterator[dict[str, Cells]]:
        held: list[Batch] = []
        for number, (batch, terminated) in enumerate(self._episodes()):
            n = len(batch["s"])
            last = np.arange(n) == n - 1
            flags = {"terminated": last & terminated, "truncated": last & (not terminated)}
            held.append({**batch, **flags, "episode": np.full(n, number, np.int64)})
            if sum(len(one["s"]) for one in held) >= rows:
                yield from _as_cells(held, names, rows)
                held = []
        yield from _as_cells(held, names, rows)


def _as_cells(held: list[Batch], names: Sequence[str], rows: int) -> Iterator[dict[str, Cells]]:
    if held:
        columns = {name: np.concatenate([one[name] for one in held]) for name in names}
        for begin in range(0, len(columns[names[0]]), rows):
            yield {name: Cells(column[begin : begin + rows]) for name, column in columns.items()}


def _joined(batches: list[Batch]) -> Batch:
    return {name: np.concatenate([batch[name] for batch in batches]) for name in COLUMNS}


def _composed(space: Space) -> SpaceLabels | None:
    """The labels of a finite space that is not Discrete; None of any other."""
    kinds = (gym.spaces.MultiDiscrete, gym.spaces.MultiBinary, gym.spaces.Tuple, gym.spaces.Dict)
    return Labels.of_space(space) if isinstance(space, kinds) else None


def _start(space: Space) -> int:
    return int(space.start) if isinstance(space, gym.spaces.Discrete) else 0
