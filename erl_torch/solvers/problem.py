"""The soft Bellman backup of a finite MDP, its certificate, and the problem as the solvers hold it.

    TV(s) = (1/beta) log sum_a prior(a|s) exp(beta (r(s,a) + E_{s'|s,a} V(s')))

Certificate. For any V, with pi_V ~ prior exp(beta (r + E V)):  min(TV - V) <= J(pi_V) <= -theta* <= max(TV - V).
Proof: TV - V is the one-step regularised reward of pi_V with the difference V(s') - V(s) added, which averages to
nothing under a stationary distribution; and of all policies pi_V has the largest such reward in every state. Both
hold for any chain structure. The bounds returned are wider by what rounding can do.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp

from erl_torch import checks, kernels
from erl_torch.chains import classes, reachable_from
from erl_torch.checks import InputError
from erl_torch.mdp import TabularMDP, check_policy


@dataclass(frozen=True, eq=False)
class Problem:
    """An MDP on the states that can be reached from its start, with beta and prior."""

    states: np.ndarray  # [n] the original states, ascending
    transition: sp.csr_array  # [n*A, n]
    reward: np.ndarray  # [n, A]
    prior: np.ndarray  # [n, A]
    start: np.ndarray  # [n]
    beta: float

    @classmethod
    def of(cls, mdp: TabularMDP, beta: float, prior_policy: Any = None) -> Problem:
        """Restrict ``mdp``. Raises InputError for beta <= 0 or a prior that is 0 somewhere."""
        checks.temperature("beta", beta)
        prior = check_policy("prior_policy", prior_policy, mdp.n_states, mdp.n_actions)
        if not (prior > 0).all():
            s, a = np.argwhere(prior <= 0)[0]
            raise InputError(f"prior_policy[{s}, {a}]", prior[s, a], "> 0 (leave the action out instead)")
        p, n_actions = mdp.transition, mdp.n_actions
        mask = reachable_from(state_graph(p, n_actions), mdp.start)
        states = np.flatnonzero(mask)
        if not mask.all():
            rows = (states[:, None] * n_actions + np.arange(n_actions)).ravel()
            p = sp.csr_array(p[rows][:, states])
        return cls(states, p, mdp.reward[mask], prior[mask], mdp.start[mask], float(beta))

    @property
    def n_states(self) -> int:
        return len(self.states)

    @property
    def n_actions(self) -> int:
        return int(self.reward.shape[1])

    @cached_property
    def reward_range(self) -> float:
        """max r - min r, or max |r| if that is 0, or 1: what tolerances are relative to."""
        return float(np.ptp(self.reward)) or float(np.abs(self.reward).max()) or 1.0

    @cached_property
    def _pair_of_entry(self) -> np.ndarray:
        return np.repeat(np.arange(self.reward.size), np.diff(self.transition.indptr))

    @cached_property
    def classes(self) -> tuple[np.ndarray, np.ndarray]:
        """(label, closed) of the classes of states under policies with full support."""
        return classes(state_graph(self.transition, self.n_actions))

    def action_value(self, value: np.ndarray) -> np.ndarray:
        """r + E V, [n, A]."""
        return np.asarray(self.reward + (self.transition @ value).reshape(self.reward.shape))

    def chain(self, policy: np.ndarray, tilted: np.ndarray | None = None) -> sp.csr_array:
        """CSR [n, n] of ``policy`` [n, A]; ``tilted`` replaces the transition probabilities, entry by entry."""
        p = self.transition
        data = policy.ravel()[self._pair_of_entry] * (p.data if tilted is None else tilted)
        # Copies: sum_duplicates works in place.
        rows = p.indptr[:: self.n_actions].copy()
        chain = sp.csr_array((data, p.indices.copy(), rows), shape=(self.n_states, self.n_states))
        chain.sum_duplicates()
        return chain

    def tilt(self, h: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(log <exp h> [n*A], KL(tilted || p) [n*A], p exp(h)/<exp h> as CSR data)."""
        p, n = self.transition, self.reward.size
        log_mean, kl, tilted = np.empty(n), np.empty(n), np.empty(p.nnz)
        kernels.tilt_rows(p.indptr, p.indices, p.data, h, log_mean, kl, tilted)
        return log_mean, kl, tilted

    def regeneration_state(self) -> int | None:
        """A likely start in the only closed class, or None if there are several."""
        label, closed = self.classes
        if closed.sum() != 1:
            return None
        inside = np.flatnonzero(label == np.flatnonzero(closed)[0])
        return int(inside[np.argmax(self.start[inside])])


def state_graph(transition: sp.csr_array, n_actions: int) -> sp.csr_array:
    """Which state can follow which, under any action: CSR [S, S] (pattern only)."""
    n = transition.shape[1]
    data = np.ones(len(transition.indices), np.int8)
    graph = sp.csr_array((data, transition.indices.copy(), transition.indptr[::n_actions].copy()), shape=(n, n))
    graph.sum_duplicates()
    return graph


def soft_backup(q: np.ndarray, prior: np.ndarray, beta: float) -> tuple[np.ndarray, np.ndarray]:
    """((1/beta) log sum_a prior exp(beta q) [S], its policy [S, A]); accurate for any beta > 0."""
    top = q.max(1, keepdims=True)
    with np.errstate(under="ignore"):
        gap = beta * (q - top)
        weight = prior * np.exp(gap)
        # log1p and expm1: at small beta the logarithm is a small number.
        backed_up = top[:, 0] + np.log1p((prior * np.expm1(gap)).sum(1)) / beta
        return backed_up, weight / weight.sum(1, keepdims=True)


def theta_bounds(value: np.ndarray, backed_up: np.ndarray, reward: np.ndarray) -> tuple[float, float]:
    """Two-sided bounds on theta* from V and TV, widened by what rounding can do."""
    gain = backed_up - value
    slack = 16 * np.finfo(np.float64).eps * (np.abs(value).max() + np.abs(backed_up).max() + np.abs(reward).max())
    return float(-gain.max() - slack), float(-gain.min() + slack)
