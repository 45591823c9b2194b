"""``BellmanProblem``, the problem that the solvers solve: an MDP on the states that count, with beta and prior.

    TV(s) = (1/beta) log sum_a prior(a|s) exp(beta (r(s,a) + C V(s,a))),    kappa = optimism * beta,
    C V(s,a) = (1/kappa) log E_{s'|s,a} exp(kappa V(s')),    E_{s'|s,a} V(s') at optimism 0

is its soft Bellman backup; ``erl_torch.solvers.certificates`` has the bounds that V and TV prove.

A pair with prior 0 is no pair of the problem: its term of TV is 0 whatever its reward and row are, and a policy that
takes it has KL infinite. Its row is empty and its reward 0 here, so that it is in no graph and no range.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike

from erl_torch import checks
from erl_torch.mdp.tabular import TabularMDP, check_prior
from erl_torch.solvers import certificate_kernels, kernels
from erl_torch.solvers.certificates import Gains, certainty_equivalent, gains
from erl_torch.solvers.chains import Elimination, RegenerativeLU, SingularChainError, classes, reachable_from


@dataclass(frozen=True, eq=False)
class BellmanProblem:
    """An MDP on the states that can be reached from its start, with beta and prior."""

    states: np.ndarray  # [n] the original states, ascending
    transition: sp.csr_array  # [n*A, n]
    reward: np.ndarray  # [n, A]
    prior: np.ndarray  # [n, A]; 0 where the state does not have the action
    start: np.ndarray  # [n]
    beta: float
    optimism: float = 0.0  # 1 optimistic, 0 right, negative robust: what is made of the dice of the dynamics

    @classmethod
    def of(
        cls, mdp: TabularMDP, beta: float, prior_policy: ArrayLike | None = None, optimism: float = 0.0
    ) -> BellmanProblem:
        """Restrict ``mdp``, also to the pairs with prior > 0. Raises InputError for beta <= 0, optimism that is no
        finite number, or a prior that is not one of the actions that ``mdp`` has."""
        checks.instance("mdp", mdp, TabularMDP, "a TabularMDP")
        beta = checks.temperature("beta", beta)
        optimism = checks.optimism("optimism", optimism, beta)
        prior = check_prior("prior_policy", prior_policy, mdp.n_states, mdp.n_actions, mdp.allowed)
        mdp = mdp.restricted(prior > 0)
        p, n_actions = mdp.transition, mdp.n_actions
        mask = reachable_from(state_graph(p, n_actions), mdp.start)
        states = np.flatnonzero(mask)
        if not mask.all():
            rows = (states[:, None] * n_actions + np.arange(n_actions)).ravel()
            p = sp.csr_array(p[rows][:, states])
        return cls(states, p, mdp.reward[mask], prior[mask], mdp.start[mask], beta, optimism)

    @property
    def kappa(self) -> float:
        """optimism * beta, 1/reward: the coefficient of the certainty equivalent of V(s')."""
        return self.optimism * self.beta

    @property
    def n_states(self) -> int:
        return len(self.states)

    @property
    def n_actions(self) -> int:
        return int(self.reward.shape[1])

    @cached_property
    def reward_range(self) -> float:
        """max r - min r, or max |r| if that is 0, or 1."""
        return float(np.ptp(self.rewards)) or float(np.abs(self.rewards).max()) or 1.0

    @property
    def rewards(self) -> np.ndarray:
        """Those of the pairs with prior > 0, flat."""
        return np.asarray(self.reward[self.prior > 0])

    def scale_seen(self, policy: np.ndarray, bounds: tuple[float, float]) -> float:
        """What tolerances refer to, reward per step: max(|theta|, long-run mean of |r| under ``policy`` [n, A]).

        Rewards that the policy never meets do not count. Where both are 0 (or theta may be, by its ``bounds``), the
        scale is the smallest |r| that is not 0.
        """
        if np.ptp(self.rewards) == 0:
            return self.reward_range
        seen = max(bounds[0], -bounds[1], 0.0)
        # Where the class falls apart in double precision, theta alone counts.
        with contextlib.suppress(SingularChainError):
            share = self.regeneration(policy).stationary()
            seen = max(seen, float(share @ (policy * np.abs(self.reward)).sum(1)))
        if not seen > 0:
            size = np.abs(self.rewards)
            seen = float(size[size > 0].min(initial=np.inf))
        return seen

    def is_narrow(self, bounds: tuple[float, float], tol: float, policy: np.ndarray) -> bool:
        """Whether bounds on theta* are as narrow as ``tol`` asks, relative to ``scale_seen`` by the policy."""
        width, theta = bounds[1] - bounds[0], 0.5 * (bounds[0] + bounds[1])
        if not width <= tol * self.reward_range:
            return False
        # The second test takes an LU.
        return width <= tol * abs(theta) or width <= tol * self.scale_seen(policy, bounds)

    def gains(self, value: np.ndarray) -> Gains:
        """TV - V of ``value`` [n], with bounds on its rounding."""
        return gains(self.transition, self.reward, self.prior, self.beta, value, self.kappa)

    @cached_property
    def classes(self) -> tuple[np.ndarray, np.ndarray]:
        """(label, closed) of the classes of states under policies with full support."""
        return classes(state_graph(self.transition, self.n_actions))

    def certainty_equivalent(self, value: np.ndarray) -> np.ndarray:
        """C V = (1/kappa) log sum_s' p exp(kappa V(s')), E V at optimism 0, of ``value`` [n]: [n*A]; 0 where the prior
        is 0."""
        return certainty_equivalent(self.transition, self.n_actions, self.kappa, value)

    def action_value(self, value: np.ndarray) -> np.ndarray:
        """r + C V, r + E V at optimism 0, [n, A]; 0 where the prior is 0."""
        return np.asarray(self.reward + self.certainty_equivalent(value).reshape(self.reward.shape))

    def tilted(self, value: np.ndarray) -> np.ndarray | None:
        """q_V(s'|s,a) = p exp(kappa (V(s') - C V)) as CSR data, the derivative of C at ``value`` [n]; None: p itself,
        at optimism 0. Entries may underflow to 0 (``support_lost``)."""
        return self.tilt(self.kappa * value)[2] if self.kappa else None

    def support_lost(self, value: np.ndarray) -> bool:
        """Whether an entry of q_V leaves the normal numbers: M_V has lost support then, and its root is no bound."""
        tilted = self.tilted(value)
        return tilted is not None and bool((tilted < np.finfo(np.float64).tiny).any())

    @cached_property
    def pattern(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """CSR (ptr, ind) of the states that can follow each, and the place of each transition entry in ind."""
        pattern: tuple[np.ndarray, np.ndarray, np.ndarray] = kernels.state_pattern(
            self.transition.indptr, self.transition.indices, self.n_actions
        )
        return pattern

    @cached_property
    def elimination(self) -> Elimination:
        """The order of elimination that all chains of the problem share."""
        return Elimination.of(*self.pattern[:2])

    def chain(self, policy: np.ndarray, tilted: np.ndarray | None = None) -> sp.csr_array:
        """The chain of ``policy`` [n, A], CSR [n, n]; ``tilted`` replaces the transition probabilities (CSR data)."""
        p, (ptr, ind, slot) = self.transition, self.pattern
        data = np.empty(len(ind))
        kernels.chain_of(p.data if tilted is None else tilted, slot, policy.reshape(-1), p.indptr, data)
        return sp.csr_array((data, ind, ptr), shape=(self.n_states, self.n_states))

    def regeneration(
        self, policy: np.ndarray, ref: int | None = None, tilted: np.ndarray | None = None
    ) -> RegenerativeLU:
        """The LU of the policy's chain, cut at a state that it visits often; ``tilted`` as in ``chain``. Raises
        SingularChainError."""
        ref = self.regeneration_state() if ref is None else ref
        if ref is None:
            raise SingularChainError("several closed classes")
        return RegenerativeLU.adapted(self.chain(policy, tilted), ref, self.elimination)

    def tilt(self, h: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(log <exp h> [n*A], KL(tilted || p) [n*A], p exp(h)/<exp h> as CSR data)."""
        p, n = self.transition, self.reward.size
        log_mean, kl, tilted = np.empty(n), np.empty(n), np.empty(p.nnz)
        kernels.tilt_rows(p.indptr, p.indices, p.data, h, log_mean, kl, tilted)
        return log_mean, kl, tilted

    def feared(self, value: np.ndarray) -> BellmanProblem:
        """Below optimism 0: the problem, at optimism 0, of an agent that is paid KL(q||p)/|kappa| to live in q_V.

        No start has a larger g* here than there: q_V is one of the dynamics that may be feared. The pay is rounded up.
        """
        tilted, p, kl = self.tilted(value), self.transition, np.empty(self.reward.size)
        assert tilted is not None
        certificate_kernels.divergence_rows(p.indptr, tilted, p.data, kl)
        paid = np.nextafter(kl / -self.kappa, np.inf, where=kl > 0, out=np.zeros(len(kl))).reshape(self.reward.shape)
        reward = np.where(paid > 0, np.nextafter(self.reward + paid, np.inf), self.reward)
        q = sp.csr_array((tilted, p.indices.copy(), p.indptr.copy()), shape=p.shape)
        q.eliminate_zeros()
        return replace(self, transition=q, reward=reward, optimism=0.0)

    def ending(self) -> BellmanProblem:
        """The problem on its one closed class, where the process ends under every policy with full support."""
        label, closed = self.classes
        members = np.flatnonzero(label == np.flatnonzero(closed)[0])
        rows = (members[:, None] * self.n_actions + np.arange(self.n_actions)).ravel()
        p = sp.csr_array(self.transition[rows][:, members])
        start = np.full(len(members), 1.0 / len(members))
        return replace(
            self,
            states=self.states[members],
            transition=p,
            reward=self.reward[members],
            prior=self.prior[members],
            start=start,
        )

    def regeneration_state(self) -> int | None:
        """The most likely first state in the only closed class; None where there are several classes."""
        label, closed = self.classes
        if closed.sum() != 1:
            return None
        members = np.flatnonzero(label == np.flatnonzero(closed)[0])
        return int(members[np.argmax(self.start[members])])


def state_graph(transition: sp.csr_array, n_actions: int) -> sp.csr_array:
    """Which state can follow which, under any action: CSR [S, S] (pattern only)."""
    n = transition.shape[1]
    data = np.ones(len(transition.indices), np.int8)
    graph = sp.csr_array((data, transition.indices.copy(), transition.indptr[::n_actions].copy()), shape=(n, n))
    graph.sum_duplicates()
    return graph
