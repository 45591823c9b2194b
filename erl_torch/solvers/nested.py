"""J(pi), the long-run worth of a policy, at any optimism.

    T_pi V(s) = sum_a pi (r + C V - log(pi/prior)/beta),    J(pi)(s) = lim T_pi^N 0 / N

with C of ``problem.py``: neutral in the policy's own dice and in KL, optimistic or robust in those of the dynamics. At
optimism 0 it is the reward rate less KL/beta. Else

    J(pi) = ext_q rate_{pi,q}[r - log(pi/prior)/beta - KL(q||p)/kappa],    ext = max above 0, min below,

over dynamics q: it depends on all states that the policy can meet, those that the real process leaves for ever
included, because q may stay there. For any V, min(T_pi V - V) <= J(pi) <= max(T_pi V - V) over them.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from erl_torch.solvers import certificates
from erl_torch.solvers.certificates import SHARP_WIDTH, Objective, normalised
from erl_torch.solvers.chains import policy_chain, reachable_from
from erl_torch.solvers.horizons import Backup, BellmanState, iterate
from erl_torch.solvers.problem import BellmanProblem

MAX_STEPS = 200  # linear systems
PATIENCE = 3  # states as narrow as the rewards allow, before the search for one as narrow as J allows ends


@np.errstate(over="ignore", invalid="ignore")  # a value beyond double precision has infinite bounds
def objective(
    transition: sp.csr_array,
    reward: np.ndarray,
    prior: np.ndarray,
    beta: float,
    policy: np.ndarray,
    start: np.ndarray,
    *,
    optimism: float = 0.0,
) -> Objective:
    """J(policy) from the start, with bounds; optimism: 1 optimistic (control as inference), 0 right, negative robust.

    The bounds hold in exact arithmetic, and for every start within the states that the policy can meet from ``start``.
    Where it can meet states with different J, they lie apart, and ``value`` is near the mean of J over the start, by a
    long horizon. -infinite where the policy leaves the prior.

    Args:
        transition, reward, prior: [S*A, S], [S, A], [S, A].
        beta: inverse temperature, 1/reward, > 0.
        policy: [S, A].
        start: [S].
    """
    if optimism == 0.0:
        return certificates.objective(transition, reward, prior, beta, policy, start)
    problem, policy = _met(transition, reward, prior, beta, normalised(policy), start, optimism)
    if ((policy > 0) & ~(problem.prior > 0)).any():
        return Objective(-np.inf, -np.inf, -np.inf)
    low, high, narrow = -np.inf, np.inf, 0

    def done(state: BellmanState) -> bool:
        return state.width <= SHARP_WIDTH * min(abs(state.theta_bounds[0]), abs(state.theta_bounds[1]))

    ref = problem.regeneration_state()
    ref = int(np.argmax(problem.start)) if ref is None else ref
    for state in iterate(Backup(problem, policy), ref, done, MAX_STEPS):
        low, high = max(low, -state.theta_bounds[1]), min(high, -state.theta_bounds[0])
        narrow += high - low <= SHARP_WIDTH * problem.reward_range
        if narrow > PATIENCE:
            break
    value = 0.5 * (low + high)
    if high - low > 1e-6 * problem.reward_range:
        value = float(problem.start @ state.gain) / float(problem.start.sum())
    return Objective(min(max(value, low), high), low, high)


def _met(
    transition: sp.csr_array,
    reward: np.ndarray,
    prior: np.ndarray,
    beta: float,
    policy: np.ndarray,
    start: np.ndarray,
    optimism: float,
) -> tuple[BellmanProblem, np.ndarray]:
    """(the problem of the states and pairs that ``policy`` can meet from the start, the policy there)."""
    n_actions = reward.shape[1]
    possible = sp.csr_array((np.ones(transition.nnz), transition.indices, transition.indptr), shape=transition.shape)
    mask = reachable_from(policy_chain(possible, (policy > 0).astype(np.float64)), start)
    states = np.flatnonzero(mask)
    rows = (states[:, None] * n_actions + np.arange(n_actions)).ravel()
    taken = policy[states] > 0
    lengths = np.where(taken.ravel(), np.diff(transition.indptr)[rows], 0)
    p = sp.csr_array(transition[rows])
    kept = np.repeat(taken.ravel(), np.diff(p.indptr))
    place = np.cumsum(mask) - 1
    pointers = np.concatenate([[0], np.cumsum(lengths)])
    p = sp.csr_array((p.data[kept], place[p.indices[kept]], pointers), shape=(len(rows), len(states)))
    own_reward = np.where(taken, reward[states], 0.0)
    return BellmanProblem(states, p, own_reward, prior[states], start[states], beta, optimism), policy[states]
