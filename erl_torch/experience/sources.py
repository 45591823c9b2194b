"""Sources of experience: ``source(problem, seed, report)`` gives the stream of a seed.

A source of one's own is a dataclass derived from ``Source``, whose fields are its settings:
``python train.py experience.class=my_package.MySource experience.KEY=VALUE``.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from erl_torch import checks
from erl_torch.checks import InputError
from erl_torch.experience.collect import collect, record
from erl_torch.experience.experience import Experience
from erl_torch.experience.formats.npy import check_target
from erl_torch.experience.log import Log, read_log
from erl_torch.experience.recording import CHUNK, FileRecording, read_experience
from erl_torch.experience.simulation import Simulation
from erl_torch.files import read_npy
from erl_torch.mdp.from_gymnasium import known_mdp
from erl_torch.problem import Problem

Report = Callable[[int], None]


class Source(ABC):
    """Where experience comes from."""

    one_stream: ClassVar[bool] = False  # the stream is the same for every seed
    work: ClassVar[str] = "collecting"  # in the progress bar
    designed_for: ClassVar[tuple[str, ...]] = ()  # settings of the learner that the stream depends on

    @abstractmethod
    def __call__(self, problem: Problem, seed: int, report: Report) -> Experience:
        """The stream of ``seed``.

        Args:
            problem: what there is to learn; ``problem.source`` is what to collect from.
            seed: whole number >= 0; the same one gives the same bits.
            report: to be called with the number of tuples so far, between blocks of work. It may end the run.

        Raises:
            InputError: settings that cannot be used.
        """

    @property
    def n_tuples(self) -> int | None:
        """Of a stream; None where that is not known beforehand."""
        return None

    def simulation(self, problem: Problem, seeds: Sequence[int], keep: bool | None) -> Simulation | None:
        """The streams of all ``seeds``, sampled while replicas learn; None where each is made beforehand."""
        return None


@dataclass(frozen=True, eq=False)
class Simulate(Source):
    """Collect a stream of tuples, from the model where there is one.

    Args:
        n_episodes, episode_length: whole numbers >= 1.
        behaviour_policy: [S, A] or the .npy file of it; None is the prior.
        save_to: .npz file, or directory of columns (with / at its end), to write the tuples to as well.

    Raises:
        InputError: an argument out of its range.
    """

    n_episodes: int = 500
    episode_length: int = 1000
    behaviour_policy: str | np.ndarray | None = None
    save_to: str | None = None

    def __post_init__(self) -> None:
        checks.at_least("n_episodes", self.n_episodes, 1)
        checks.at_least("episode_length", self.episode_length, 1)

    @property
    def n_tuples(self) -> int:
        return self.n_episodes * self.episode_length

    def __call__(self, problem: Problem, seed: int, report: Report) -> Experience:
        if problem.source is None:
            raise InputError("experience", type(self).__name__, "recorded: there is no environment to collect from")
        sizes = self.n_episodes, self.episode_length
        behaviour = self._behaviour()
        if self.save_to is None:
            return collect(problem.source, *sizes, seed, behaviour, problem.prior, report, masks=problem.masks)
        check_target("save_to", self.save_to)
        if self.save_to.endswith("/"):
            path = record(problem.source, self.save_to, *sizes, seed, behaviour, problem.prior, report, problem.masks)
            return read_experience(path, problem.n_states, problem.n_actions)
        data = collect(problem.source, *sizes, seed, behaviour, problem.prior, report, masks=problem.masks)
        check_target("save_to", self.save_to)  # again: the collecting may have taken hours
        data.save(self.save_to)
        return data

    def simulation(self, problem: Problem, seeds: Sequence[int], keep: bool | None) -> Simulation | None:
        if self.save_to is not None:
            raise InputError("save_to", self.save_to, "null: there is one stream per replica (or shared_stream=true)")
        mdp = known_mdp(problem.source)
        if mdp is None:
            return None
        return Simulation(mdp, self.n_episodes, self.episode_length, seeds, self._behaviour(), keep)

    def _behaviour(self) -> np.ndarray | None:
        policy = self.behaviour_policy
        return policy if policy is None or isinstance(policy, np.ndarray) else read_npy(policy, "behaviour_policy")


@dataclass(frozen=True, eq=False)
class Recorded(Source):
    """A stream recorded before.

    Args:
        path, on_bad, chunk, on_prior, columns: as of ``FileRecording``.
    """

    path: str
    on_bad: str = "stop"
    chunk: int = CHUNK
    on_prior: bool = False
    columns: dict[str, Any] = field(default_factory=dict)

    one_stream: ClassVar[bool] = True
    work: ClassVar[str] = "reading"

    def __call__(self, problem: Problem, seed: int, report: Report) -> FileRecording:
        return FileRecording(
            self.path,
            problem.n_states,
            problem.n_actions,
            on_bad=self.on_bad,
            chunk=self.chunk,
            env=problem.env,
            prior_policy=problem.prior,
            on_prior=self.on_prior,
            seed=seed,
            report=report,
            columns=self.columns,
            state_labels=problem.state_labels,
            action_labels=problem.action_labels,
        )

    def log(
        self,
        seed: int,
        unseen_actions: str,
        prior_policy: ArrayLike | None,
        report: Report,
        end_reward: float = 0.0,
        failures: str = "default",
    ) -> Log:
        """All that there is, without an environment: as ``read_log``."""
        return read_log(
            self.path,
            columns=self.columns,
            unseen_actions=unseen_actions,
            end_reward=end_reward,
            failures=failures,
            prior_policy=prior_policy,
            on_bad=self.on_bad,
            chunk=self.chunk,
            on_prior=self.on_prior,
            seed=seed,
            report=report,
        )
