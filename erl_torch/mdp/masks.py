"""``ActionMasks``: the actions that each state has, noted as an environment tells them while it is stepped."""

from __future__ import annotations

import numpy as np

from erl_torch.checks import InputError
from erl_torch.mdp.tabular import uniform


class ActionMasks:
    """The actions that each state has, as far as an environment has told (``info["action_mask"]`` of reset and step).

    Attributes: ``allowed`` [S, A] bool, all true in a state of which nothing was told; ``told`` [S] bool.
    """

    def __init__(self, n_states: int, n_actions: int) -> None:
        self.allowed, self.told = np.ones((n_states, n_actions), bool), np.zeros(n_states, bool)

    def enter(self, s: int, mask: np.ndarray | None) -> None:
        """Note the actions of state ``s``, [A] bool; None is nothing. Raises InputError where they are others than
        before."""
        if mask is None:
            return
        if self.told[s] and not np.array_equal(self.allowed[s], mask):
            before, now = self.allowed[s].astype(int).tolist(), mask.astype(int).tolist()
            allowed = f"{before}, as at an earlier visit of state {s}: the actions of a state must not change"
            raise InputError(f"action_mask of state {s}", now, allowed)
        self.allowed[s], self.told[s] = mask, True

    @property
    def uniform_policy(self) -> np.ndarray:
        """The policy that takes all actions that a state has alike, [S, A]: the prior to learn with."""
        return uniform(self.allowed)
