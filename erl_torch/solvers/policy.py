"""Evaluate a policy in a known MDP: its chain, its long run, reward rate and regularised objective.

``objective`` is J(pi) = reward rate - KL rate / beta, with KL(pi(.|s) || prior(.|s)) averaged over the
states that the policy visits; its maximum over policies is -theta*.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.sparse as sp

from erl_torch import checks
from erl_torch.mdp.tabular import TabularMDP
from erl_torch.solvers import chains, kernels, nested
from erl_torch.solvers.chains import long_run


class PolicyChain(NamedTuple):
    """The Markov chain of an MDP under a policy."""

    transition: sp.csr_array  # [S, S]
    reward: np.ndarray  # [S]


def policy_chain(mdp: TabularMDP, policy: np.ndarray) -> PolicyChain:
    """The chain of ``policy`` [S, A]."""
    return PolicyChain(chains.policy_chain(mdp.transition, policy), (policy * mdp.reward).sum(1))


def kl_per_state(policy: np.ndarray, prior: np.ndarray) -> np.ndarray:
    """KL(policy(.|s) || prior(.|s)) in nats, [S]; infinite where the policy leaves the prior's support."""
    with np.errstate(divide="ignore", invalid="ignore"):
        terms = np.where(policy > 0, policy * np.log(policy / prior), 0.0)
    return terms.sum(1)  # type: ignore[no-any-return]


def reward_per_step(mdp: TabularMDP, policy: np.ndarray, horizon: int) -> float:
    """Expected undiscounted return of ``horizon`` steps from the start distribution, divided by ``horizon``."""
    chain = policy_chain(mdp, policy)
    p = chain.transition
    total = kernels.finite_horizon_return(p.indptr, p.indices, p.data, chain.reward, mdp.start, horizon)
    return float(total) / horizon


def stationary_distribution(transition: sp.csr_array, start: np.ndarray) -> np.ndarray:
    """Long-run share of time in each state, from ``start`` [S]; chain as CSR [S, S].

    Periodic chains and chains with several closed classes are fine: each class counts by the probability of ending in
    it. No digit is lost where the chain rarely moves between sets of states (``erl_torch.solvers.chains``).
    """
    return long_run(transition, start).of_state


def induced_distribution(mdp: TabularMDP, policy: np.ndarray, horizon: int | None = None) -> np.ndarray:
    """Share of time in each state [S] under ``policy``: in the long run, or over ``horizon`` steps from the start."""
    chain = policy_chain(mdp, policy).transition
    if horizon is None:
        return stationary_distribution(chain, mdp.start)
    share, now, backward = np.zeros(mdp.n_states), mdp.start, sp.csr_array(chain.T)
    for _ in range(horizon):
        share, now = share + now, backward @ now
    return share / horizon


def reward_variance(mdp: TabularMDP, policy: np.ndarray) -> float:
    """lim Var(r_1 + ... + r_N)/N under ``policy`` [S, A] from the start, reward squared per step.

    With h of h + g = sum_a pi (r + E h), the mean of (r + h(s') - h(s) - g)**2 in the long run. NaN where the policy
    may end in several closed sets, of other rates, or where double precision does not tell one set.
    """
    chain = policy_chain(mdp, policy)
    share = stationary_distribution(chain.transition, mdp.start)
    label, closed = chains.classes(chain.transition)
    ends = np.unique(label[(share > 0) & closed[label]])
    if len(ends) != 1:
        return float("nan")
    inside = np.flatnonzero(label == ends[0])
    ref = int(np.argmax(share[inside]))
    try:
        lu = chains.RegenerativeLU.adapted(sp.csr_array(chain.transition[inside][:, inside]), ref)
    except chains.SingularChainError:
        return float("nan")
    h = np.zeros(mdp.n_states)
    gain, h[inside] = lu.poisson(chain.reward[inside])
    p = mdp.transition
    rows = np.repeat(np.arange(p.shape[0]), np.diff(p.indptr))
    # A sum of squares: nothing cancels.
    off = mdp.reward.ravel()[rows] + h[p.indices] - h[rows // mdp.n_actions] - gain
    weight = (share[:, None] * policy).ravel()[rows] * p.data
    return float(weight @ off**2)


def objective(mdp: TabularMDP, policy: np.ndarray, prior: np.ndarray, beta: float, *, optimism: float = 0.0) -> float:
    """J(pi) from the start distribution, reward per step: the stationary reward rate minus KL/beta at optimism 0.

    Exact but for rounding. Where products of probabilities underflow, it may be anywhere between the bounds that
    ``nested.objective`` gives with it.

    Args:
        optimism: 1 optimistic (control as inference), 0 right, negative robust, as in ``nested.objective``; there is
            also what J is where it depends on the start.
    """
    return nested.objective(
        mdp.transition, mdp.reward, prior, beta, policy, mdp.start, optimism=checks.optimism("optimism", optimism, beta)
    ).value
