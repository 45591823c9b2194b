"""``ValueSolution``: the result of the solvers whose objective is a sum of rewards, not their average."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp
import torch
from numpy.typing import ArrayLike

from erl_torch import checks
from erl_torch.mdp import kernels
from erl_torch.mdp.tabular import TabularMDP
from erl_torch.solution import Status
from erl_torch.solvers.chains import EPSILON
from erl_torch.solvers.problem import BellmanProblem


@dataclass(frozen=True, eq=False, kw_only=True)
class ValueSolution:
    """The policy with the largest expected sum of rewards less KL/beta, and bounds that rounding cannot leave.

    Where time counts (``solve_finite_horizon``), arrays have one more axis, the step, in front.
    """

    policy: torch.Tensor  # [S, A], rows sum to 1
    value: torch.Tensor  # V(s), [S], reward: the sum from s on
    action_value: torch.Tensor  # r + discount E V, [S, A], reward; -infinite for an action that is never taken
    value_low: torch.Tensor  # [S], value_low <= V* <= value_high in exact arithmetic
    value_high: torch.Tensor  # [S]
    start_bounds: tuple[float, float]  # on the mean of V* over the start distribution
    gap: float  # at least V*(s) - (what the policy is worth from s), in every state solved
    beta: float
    n_steps: int  # linear systems, or backups
    status: Status
    message: str = ""


def whole_problem(mdp: TabularMDP, beta: float, prior_policy: ArrayLike | None) -> BellmanProblem:
    """The problem on all states, whatever the start leads to. Raises InputError as ``BellmanProblem.of``."""
    checks.instance("mdp", mdp, TabularMDP, "a TabularMDP")
    everywhere = replace(mdp, start=np.full(mdp.n_states, 1 / mdp.n_states))
    return replace(BellmanProblem.of(everywhere, beta, prior_policy), start=mdp.start)


def with_end(transition: sp.csr_array, into: np.ndarray, n_actions: int) -> sp.csr_array:
    """A transition matrix [(n + 1)*A, n + 1] whose last state is an end, entered with probability ``into`` [n*A]."""
    n = transition.shape[1]
    last = sp.csr_array(into[:, None])
    stay = sp.csr_array((np.ones(n_actions), (np.arange(n_actions), np.full(n_actions, n))), shape=(n_actions, n + 1))
    whole = sp.csr_array(sp.vstack([sp.hstack([transition, last]), stay]))
    whole.sort_indices()
    whole.eliminate_zeros()
    return whole


def chance_of(transition: sp.csr_array, states: np.ndarray) -> np.ndarray:
    """The probability that each row gives to ``states`` [S] bool, within 2 units of the last place."""
    part = sp.csr_array(transition[:, np.flatnonzero(states)])
    chance = np.empty(part.shape[0])
    kernels.row_sums(part.indptr, part.data, chance)
    return chance


def start_bounds(start: np.ndarray, low: np.ndarray, high: np.ndarray) -> tuple[float, float]:
    """Bounds on the mean, under ``start`` [S], of a value between ``low`` and ``high`` [S]."""
    at = start > 0
    weight = start[at] / start[at].sum()
    ends = []
    for bound, way in ((low[at], -np.inf), (high[at], np.inf)):
        if not np.isfinite(bound).all():
            ends.append(way if (bound == way).any() else -way)
            continue
        mean, size = float(weight @ bound), float(weight @ np.abs(bound))
        slack = (2 * len(weight) + 16) * EPSILON * size
        ends.append(float(np.nextafter(mean + np.copysign(slack, way), way)))
    return ends[0], ends[1]


def scale(problem: BellmanProblem, value: np.ndarray, policy: np.ndarray) -> float:
    """What tolerances refer to: the largest of |V| and of the mean |r| of a step under the policy; where both are 0,
    the range of the rewards."""
    largest = max(float(np.abs(value).max()), float((policy * np.abs(problem.reward)).sum(1).max()))
    return largest or problem.reward_range


def down(x: np.ndarray) -> np.ndarray:
    """The next smaller doubles: below a sum of two numbers that was rounded to ``x``."""
    return np.asarray(np.nextafter(x, -np.inf))


def up(x: np.ndarray) -> np.ndarray:
    """The next larger doubles."""
    return np.asarray(np.nextafter(x, np.inf))
