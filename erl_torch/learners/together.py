"""What many learners that run together have in common, whatever runs them."""

from __future__ import annotations

import os
from dataclasses import dataclass, is_dataclass
from typing import Any

import numpy as np

from erl_torch import checks
from erl_torch.checks import InputError
from erl_torch.learners.learner import StreamLearner
from erl_torch.mdp.tabular import check_policy


@dataclass(frozen=True, eq=False)
class Together:
    """Learners of one class and one prior policy, side by side; arguments as of ``Replicas``."""

    learners: tuple[StreamLearner[Any, Any], ...]
    threads: int | None = None
    block: int | None = None
    layout: str = "auto"
    backend: str = "auto"

    def __post_init__(self) -> None:
        checks.plain(self)
        object.__setattr__(self, "learners", checks.sequence("learners", self.learners))
        checks.at_least("n_replicas", len(self.learners), 1)
        for learner in self.learners:
            check_learner("learners", learner)
            if type(learner) is not type(self.learners[0]):
                raise InputError("learners", type(learner).__name__, f"all {type(self.learners[0]).__name__}")
        if self.threads is not None:
            checks.workers("threads", self.threads)
        if self.block is not None:
            checks.at_least("block", self.block, 1)
        checks.one_of("layout", self.layout, ("auto", "lanes", "tables"))
        checks.one_of("backend", self.backend, ("auto", "compiled", "torch"))

    def __len__(self) -> int:
        return len(self.learners)

    @property
    def workers(self) -> int:
        return self.threads or os.cpu_count() or 1

    def prior_policy(self, n_states: int, n_actions: int) -> np.ndarray:
        """[S, A], the one of all replicas. Raises InputError where they have several."""
        prior = check_policy("prior_policy", self.learners[0].prior_policy, n_states, n_actions)
        for r, learner in enumerate(self.learners):
            own = learner.prior_policy
            if own is not self.learners[0].prior_policy and not np.array_equal(
                check_policy("prior_policy", own, n_states, n_actions), prior
            ):
                raise InputError(f"learners[{r}].prior_policy", "array", "that of all replicas")
        return prior


OWN = ("iterate", "run", "start")  # of ``StreamLearner``: replicas step each learner themselves


def check_learner(key: str, learner: object) -> None:
    if not isinstance(learner, StreamLearner) or not is_dataclass(learner):
        raise InputError(key, f"{learner} ({type(learner).__name__})", "a learner that streams, as AlgorithmS1()")
    others = [name for name in OWN if getattr(type(learner), name) is not getattr(StreamLearner, name)]
    if others:
        allowed = f"one with the {', '.join(others)} of StreamLearner: replicas call its prepare and step themselves"
        raise InputError(key, type(learner).__name__, allowed)
