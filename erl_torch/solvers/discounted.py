"""The discounted neighbour of the average-reward problem: V = TV with

    TV(s) = (1/beta) log sum_a prior(a|s) exp(beta (r(s,a) + discount E_{s'|s,a} V(s'))).

Newton's step is soft policy iteration, one linear system I - discount K of the policy's chain. V is kept as w + c with
one constant c and w = 0 in one state, so that differences keep their digits as the discount nears 1, where c grows like
the average reward over 1 - discount.

Bounds. T is monotone and T(V + k) = TV + discount k. So with low <= TV - V <= high in every state,

    V + low/(1 - discount) <= J(pi_V) <= V* <= V + high/(1 - discount).

TV - V is the gain of a process that ends, without reward, with probability 1 - discount after each step: the rows and
the rounding of ``certificate_kernels.gain_rows`` (docs/theory.md, 6).
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import ArrayLike

from erl_torch import checks
from erl_torch.mdp.tabular import TabularMDP
from erl_torch.solution import Status
from erl_torch.solvers.certificates import gains, policy_gains, soft_backup
from erl_torch.solvers.chains import EPSILON, RegenerativeLU
from erl_torch.solvers.problem import BellmanProblem
from erl_torch.solvers.values import ValueSolution, down, scale, start_bounds, up, whole_problem, with_end


def solve_discounted(
    mdp: TabularMDP,
    beta: float,
    discount: float,
    prior_policy: ArrayLike | None = None,
    tol: float = 1e-10,
    max_steps: int = 200,
) -> ValueSolution:
    """The policy with the largest discounted sum of rewards less KL/beta, in every state, with bounds on its value.

    As the discount nears 1, (1 - discount) V nears the average reward -theta of ``solve_soft_bellman``.

    Args:
        mdp: the problem.
        beta: inverse temperature, 1/reward, > 0.
        discount: in [0, 1), of the reward one step later.
        prior_policy: [S, A]; None is uniform.
        tol: width of the bounds at which to stop, relative to the largest |V|, or mean |r| of a step if that is more.
        max_steps: linear systems at most.

    Returns:
        A ValueSolution. Status STAGNATED where rounding keeps the bounds wider than ``tol``; they hold all the same.

    Raises:
        InputError: beta, discount, prior, tol or max_steps out of range.
    """
    problem = whole_problem(mdp, beta, prior_policy)
    discount = checks.number("discount", discount, lambda x: 0 <= x < 1, "a number in [0, 1)")
    checks.positive("tol", tol)
    checks.at_least("max_steps", max_steps, 1)
    n, n_actions = problem.n_states, problem.n_actions
    exists = np.diff(problem.transition.indptr) > 0
    ended = with_end(problem.transition * discount, np.where(exists, 1 - discount, 0.0), n_actions)
    reward = np.vstack([problem.reward, np.zeros(n_actions)])
    prior = np.vstack([problem.prior, np.full(n_actions, 1 / n_actions)])

    def bounds(w: np.ndarray, c: float) -> tuple[float, float]:
        found = gains(ended, reward, prior, problem.beta, np.append(w, -c))
        return _over(float(found.low[:n].min()), float(found.high[:n].max()), discount)

    w, c, steps = np.zeros(n), 0.0, 0
    best = w, c, bounds(w, c)
    since = 0

    def narrow() -> bool:
        w, c, (low, high) = best
        policy = soft_backup(problem.action_value(discount * w), problem.prior, problem.beta)[1]
        return high - low <= tol * scale(problem, w + c + 0.5 * (low + high), policy)

    while steps < max_steps and since < 3 and not narrow():
        w, c = _newton(problem, w, discount)
        steps += 1
        low, high = bounds(w, c)
        since = 0 if high - low < 0.5 * (best[2][1] - best[2][0]) else since + 1
        if high - low < best[2][1] - best[2][0]:
            best = w, c, (low, high)
    w, c, (low, high) = best
    q = problem.action_value(discount * w)
    policy = soft_backup(q, problem.prior, problem.beta)[1]
    value_low, value_high = down(down(w + c) + low), up(up(w + c) + high)
    c += 0.5 * (low + high)
    own = np.vstack([policy, prior[-1:]])
    worth = policy_gains(ended, reward, prior, problem.beta, own, np.append(w, -c))[0][:n]
    over = float((value_high - down(w + c)).max()) - _over(float(worth.min()), 0.0, discount)[0]
    status = Status.CONVERGED if narrow() else Status.STEP_LIMIT if steps >= max_steps else Status.STAGNATED
    return ValueSolution(
        policy=torch.from_numpy(policy),
        value=torch.from_numpy(w + c),
        action_value=torch.from_numpy(np.where(problem.prior > 0, q + discount * c, -np.inf)),
        value_low=torch.from_numpy(value_low),
        value_high=torch.from_numpy(value_high),
        start_bounds=start_bounds(problem.start, value_low, value_high),
        gap=float(np.nextafter(max(over, 0.0) * (1 + 2 * EPSILON), np.inf)),
        beta=problem.beta,
        n_steps=steps,
        status=status,
    )


def _newton(problem: BellmanProblem, w: np.ndarray, discount: float) -> tuple[np.ndarray, float]:
    """(w, c) of the value w + c of pi_V, for V = ``w`` and any constant."""
    policy = soft_backup(problem.action_value(discount * w), problem.prior, problem.beta)[1]
    chain = problem.chain(policy)
    lu = RegenerativeLU(chain, 0, discount, problem.elimination)
    home = int(np.argmax(lu.stationary()))  # the values of rare states, seen from there, take no more digits
    if home:
        lu = RegenerativeLU(chain, home, discount, problem.elimination)
    w = w - w[home]
    backed_up = soft_backup(problem.action_value(discount * w), problem.prior, problem.beta)[0]
    gain, more = lu.poisson(backed_up - w)
    return w + more, gain / (1 - discount)


def _over(low: float, high: float, discount: float) -> tuple[float, float]:
    """``low`` and ``high`` divided by 1 - discount, rounded outwards."""
    left = 1 - discount
    return (
        float(np.nextafter(low / left, -np.inf)) - 2 * EPSILON * abs(low / left),
        float(np.nextafter(high / left, np.inf)) + 2 * EPSILON * abs(high / left),
    )
