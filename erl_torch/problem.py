"""What there is to learn: ``Problem``; and what is learnt: ``Policy``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeAlias

import gymnasium as gym
import numpy as np
import torch

from erl_torch.labels import Labels, Names
from erl_torch.mdp.ends import EndRule
from erl_torch.mdp.masks import ActionMasks
from erl_torch.mdp.tabular import TabularMDP

Policy: TypeAlias = torch.Tensor
"""Probabilities of the actions in each state: [S, A], every row sums to 1; [R, S, A] of R replicas."""


@dataclass(frozen=True, eq=False)
class Problem:
    """An environment with finite spaces, and what is known of it; or what a log alone tells (``erl_torch.read_log``).

    Args:
        env: where policies are played; None: a log is all that there is.
        source: where experience is collected: ``env``, or a model in its place; None with ``env``.
        prior: the prior policy, [S, A], rows sum to 1; 0 where a state does not have the action.
        mdp: the model that policies are evaluated on, and that is solved to compare with; None where it is not known.
        episode: the model of one episode: its end is absorbed, without reward; None where there is none.
        horizon: steps of an episode at most, >= 1.
        name: what messages and pictures call it.
        masks: where the actions of each state are noted, as ``env`` tells them; None where it does not.
        state_labels, action_labels: what states and actions are called; None: their numbers.
        success: [S, A], the probability that a step of the episode's model ends it in success; None where not known.
        ends: which ends are failures, and what is added to their rewards where ``env`` is learnt from; None where
            episodes do not end, or that is not known.
    """

    env: gym.Env[Any, Any] | None
    source: TabularMDP | gym.Env[Any, Any] | None
    prior: np.ndarray
    mdp: TabularMDP | None = None
    episode: TabularMDP | None = None
    horizon: int = 1000
    name: str = "the environment"
    masks: ActionMasks | None = None
    state_labels: Labels | None = None
    action_labels: Labels | None = None
    success: np.ndarray | None = None
    ends: EndRule | None = None

    @property
    def allowed(self) -> np.ndarray:
        """The actions that each state has, [S, A] bool: those with a prior above 0 that the model has, and the
        environment as far as it has told."""
        allowed = self.prior > 0
        for known in (self.source, self.mdp):
            if isinstance(known, TabularMDP):
                allowed = allowed & known.allowed
        return allowed if self.masks is None else allowed & self.masks.allowed

    @property
    def n_states(self) -> int:
        return int(self.prior.shape[0])

    @property
    def n_actions(self) -> int:
        return int(self.prior.shape[1])

    @property
    def names(self) -> Names:
        return Names(self.state_labels, self.action_labels)
