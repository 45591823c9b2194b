"""Bounds that hold in exact arithmetic: on theta*, and on what a policy is worth.

For any V, with TV(s) = (1/beta) log sum_a prior exp(beta (r + E V)) and, for a policy pi,
T_pi V(s) = sum_a pi (r + E V - log(pi/prior)/beta),

    min(TV - V) <= J(pi_V) <= -theta* <= max(TV - V)        and        min(T_pi V - V) <= J(pi) <= max(T_pi V - V),

whatever the chain. In the second, minimum and maximum over the states that pi comes back to for ever suffice. Proof:
TV - V is the one-step regularised reward of pi_V with the difference V(s') - V(s) added, which averages to nothing
under a stationary distribution; and of all policies pi_V has the largest such reward in every state.

With optimism, C V = (1/kappa) log sum_s' p exp(kappa V(s')) stands for E V, kappa = optimism * beta: T and T_pi stay
monotone and commute with constants, so both lines hold, with J(pi) the limit of T_pi^N 0 / N, in every state. But
states that are left for ever count in the second then (``nested.py``).

The compiled rows (``certificate_kernels.gain_rows``, ``certificate_kernels.policy_gain_rows``) return each gain with
a lower and an upper bound that rounding cannot leave. E V - V(s) is a sum of p (V(s') - V(s)) over s' other than s,
so that no digit is lost where a state is rarely left. The error of an action counts as far as the action is chosen
(docs/theory.md, 6: every operation). The rows of transition, prior and policy stand for the rows divided by their
sums, which are 1 but for rounding.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.sparse as sp

from erl_torch.solvers import certificate_kernels
from erl_torch.solvers.chains import (
    EPSILON,
    GTH_STATES,
    RegenerativeLU,
    Share,
    SingularChainError,
    classes,
    long_run,
    policy_chain,
    reachable_from,
)

SHARP_WIDTH = 1e-11  # of bounds on J, relative to J: where they are as narrow, nothing more is tried


class Gains(NamedTuple):
    """TV - V with bounds on its rounding, and the policy that attains it."""

    gain: np.ndarray  # [S]
    low: np.ndarray  # [S]
    high: np.ndarray  # [S]
    policy: np.ndarray  # pi_V, [S, A]

    @property
    def theta_bounds(self) -> tuple[float, float]:
        """On theta*, reward per step."""
        return -float(self.high.max()), -float(self.low.min())


def gains(
    transition: sp.csr_array,
    reward: np.ndarray,
    prior: np.ndarray,
    beta: float,
    value: np.ndarray,
    kappa: float = 0.0,
) -> Gains:
    """TV - V of ``value`` [S] for a transition matrix [S*A, S], reward and prior [S, A]; kappa as in C V above."""
    n_states = len(value)
    gain, low, high = np.empty(n_states), np.empty(n_states), np.empty(n_states)
    policy = np.empty(reward.shape)
    p = transition
    certificate_kernels.gain_rows(
        p.indptr, p.indices, p.data, reward, prior, beta, kappa, value, gain, low, high, policy
    )
    return Gains(gain, low, high, policy)


def policy_gains(
    transition: sp.csr_array,
    reward: np.ndarray,
    prior: np.ndarray,
    beta: float,
    policy: np.ndarray,
    value: np.ndarray,
    kappa: float = 0.0,
) -> tuple[np.ndarray, np.ndarray]:
    """(low, high) [S] of T_pi V - V, as ``gains``, for any policy [S, A]; -infinite where it leaves the prior."""
    low, high = np.empty(len(value)), np.empty(len(value))
    p = transition
    certificate_kernels.policy_gain_rows(
        p.indptr, p.indices, p.data, reward, prior, beta, kappa, policy, value, low, high
    )
    return low, high


def certainty_equivalent(transition: sp.csr_array, n_actions: int, kappa: float, value: np.ndarray) -> np.ndarray:
    """C V [S*A] = (1/kappa) log sum_s' p exp(kappa V(s')) of ``value`` [S], E V at kappa 0; 0 where a row is empty."""
    if kappa == 0.0:
        return np.asarray(transition @ value)
    certain = np.empty(transition.shape[0])
    p = transition
    certificate_kernels.certainty_rows(p.indptr, p.indices, p.data, n_actions, kappa, value, certain)
    return certain


def soft_backup(q: np.ndarray, prior: np.ndarray, beta: float) -> tuple[np.ndarray, np.ndarray]:
    """((1/beta) log sum_a prior exp(beta q) [S], its policy [S, A]); accurate for any beta > 0 and any prior."""
    backed_up, policy = np.empty(len(q)), np.empty(q.shape)
    certificate_kernels.soft_rows(np.ascontiguousarray(q), np.ascontiguousarray(prior), beta, backed_up, policy)
    return backed_up, policy


def normalised(policy: np.ndarray) -> np.ndarray:
    """``policy`` [S, A], its rows divided by their sums where these are not 1 but for rounding."""
    policy = np.asarray(policy, np.float64)
    sums = policy.sum(1, keepdims=True)
    return np.where(np.abs(sums - 1) > 2e-15, policy / sums, policy)


class Objective(NamedTuple):
    """J(pi), the long-run reward rate less KL/beta from the start, reward per step."""

    value: float  # J but for rounding; where products of probabilities underflow, anywhere between low and high
    low: float  # low <= J <= high in exact arithmetic
    high: float


def objective(
    transition: sp.csr_array,
    reward: np.ndarray,
    prior: np.ndarray,
    beta: float,
    policy: np.ndarray,
    start: np.ndarray,
) -> Objective:
    """J(policy) with bounds.

    Three bounds hold together: that of the one-step rewards of the states that the policy comes back to (V = 0), that
    of the gains of its relative value, and that of its shares of time where the elimination's error is known. Where
    products of probabilities underflow, ``value`` may be anywhere between the bounds. The KL of states that the policy
    leaves for ever does not count.
    """
    n_states, n_actions = reward.shape
    policy = normalised(policy)
    chain = policy_chain(transition, policy)
    # Which state can follow which, even where products of probabilities underflow.
    possible = sp.csr_array((np.ones(transition.nnz), transition.indices, transition.indptr), shape=transition.shape)
    pattern = policy_chain(possible, (policy > 0).astype(np.float64))
    label, closed = classes(pattern)
    ends = closed[label] & reachable_from(pattern, start)
    within = policy_gains(transition, reward, prior, beta, policy, np.zeros(n_states))
    low, high = float(within[0][ends].min()), float(within[1][ends].max())
    if not (np.isfinite(low) and np.isfinite(high)):
        return Objective(low, low, high)
    worth = one_step_worth(*within)
    if chain.nnz < pattern.nnz:
        share = _share(chain, start)
        middle = 0.5 * (low + high) if share is None else float(share.of_state @ worth)
        return Objective(min(max(middle, low), high), low, high)
    ends_in = np.unique(label[ends])
    share = _share(chain, start) if ends.sum() <= GTH_STATES else None
    if share is None or not np.isfinite(share.relative_error):
        value, of_one = _by_regeneration(chain, worth, label, ends_in)
        if value is not None:
            again = policy_gains(transition, reward, prior, beta, policy, value)
            low, high = max(low, float(again[0][ends].min())), min(high, float(again[1][ends].max()))
        share = share or of_one
        if high - low > SHARP_WIDTH * max(abs(low), abs(high)):
            share = _share(chain, start, dense=True) or share
        share = share or _share(chain, start)
    if share is None:
        return Objective(0.5 * (low + high), low, high)
    d = share.of_state[ends]
    mean = float(d @ worth[ends])
    # The entries of the chain are sums over actions.
    error = share.relative_error + 2 * n_states * (n_actions + 24) * EPSILON
    if error < 0.1:
        off = np.abs(worth[ends] - mean)
        slack = (1.2 * error + (len(d) + 8) * EPSILON) * float(d @ off) + (len(d) + 8) * EPSILON * abs(mean)
        slack += len(d) * 1e-300 * float(off.max())
        low = max(low, mean - 1.2 * float(d @ (worth - within[0])[ends]) - slack)
        high = min(high, mean + 1.2 * float(d @ (within[1] - worth)[ends]) + slack)
    return Objective(mean, min(low, mean), max(high, mean))


def _share(chain: sp.csr_array, start: np.ndarray, dense: bool = False) -> Share | None:
    try:
        return long_run(chain, start, dense)
    except SingularChainError:
        return None


def one_step_worth(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """sum_a pi (r - log(pi/prior)/beta), [S]: the middle of its bounds; 0 where they are infinite."""
    with np.errstate(invalid="ignore"):
        middle = low + 0.5 * (high - low)
    return np.where(np.isfinite(middle), middle, 0.0)


def _by_regeneration(
    chain: sp.csr_array, worth: np.ndarray, label: np.ndarray, ends_in: np.ndarray
) -> tuple[np.ndarray | None, Share | None]:
    """(relative value [S] of rewards ``worth`` on the closed classes ``ends_in``, 0 elsewhere; the shares of time where
    there is one class). Each is None where it cannot be computed.
    """
    value, share = np.zeros(len(worth)), None
    for c in ends_in:
        members = np.flatnonzero(label == c)
        try:
            lu = RegenerativeLU.adapted(sp.csr_array(chain[members][:, members]), 0)
        except SingularChainError:
            return None, None
        value[members] = lu.poisson(worth[members])[1]
        if len(ends_in) == 1:
            of_state = np.zeros(len(worth))
            of_state[members] = lu.stationary()
            share = Share(of_state, np.inf)
    return value, share
