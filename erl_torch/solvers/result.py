"""Turn a value into a Solution with its certificate."""

from __future__ import annotations

from typing import Protocol

import numpy as np
import torch
from numpy.typing import ArrayLike

from erl_torch.mdp.tabular import check_policy
from erl_torch.solution import Solution, Status
from erl_torch.solvers.certificates import policy_gains, soft_backup
from erl_torch.solvers.nested import objective
from erl_torch.solvers.problem import BellmanProblem

ROUNDING_WIDTH = 1e-6  # of bounds, relative to the reward range: what is wider has another cause
SEVERAL_RATES = (
    "below optimism 0 dynamics that are feared may keep the process where it starts, and the optimal rate then depends "
    "on the start: raise optimism"
)


class Sized(Protocol):
    """The sizes of an MDP, which are all that a Solution needs of it."""

    @property
    def n_states(self) -> int: ...

    @property
    def n_actions(self) -> int: ...


def exact_solution(
    mdp: Sized,
    problem: BellmanProblem,
    value: np.ndarray,
    status: Status,
    n_steps: int,
    bounds: tuple[float, float],
    prior_policy: ArrayLike | None = None,
    message: str = "",
    k: int | None = None,
) -> Solution:
    """The solution that belongs to ``value`` [n], on the problem's states; theta is the middle of the bounds.

    With status REDUCIBLE or NO_SINGLE_RATE, theta* may differ from state to state: there is no theta, and the bounds
    hold for each.
    """
    beta = problem.beta
    q = problem.action_value(value)
    backed_up, policy = soft_backup(q, problem.prior, beta)
    theta = 0.5 * (bounds[0] + bounds[1])
    several = status in (Status.REDUCIBLE, Status.NO_SINGLE_RATE)
    gap = policy_gap(problem, policy, bounds, value)
    prior = check_policy("prior_policy", prior_policy, mdp.n_states, mdp.n_actions)
    there = prior > 0
    # log u = beta V + log(pi/prior), so Q = log(u)/beta = V + q - TV.
    action_value = np.where(there[problem.states], value[:, None] + q - backed_up[:, None], -np.inf)
    shift = max(action_value.max(), value.max())
    action_value, value = action_value - shift, value - shift
    log_psi = -beta * value
    reward_bias = bias(problem, log_psi)
    delta = float(reward_bias.max())
    with np.errstate(over="ignore", under="ignore"):
        u, psi = np.exp(beta * action_value), np.exp(log_psi)
        rho = None if several else float(np.exp(-beta * (theta + delta)))
    return Solution(
        policy=spread(problem, policy, prior),
        u=spread(problem, u, there.astype(np.float64)),
        psi=spread(problem, psi, np.ones(mdp.n_states)),
        rho=rho,
        theta=None if several else theta,
        reward_bias=spread(problem, reward_bias, np.zeros_like(prior)),
        reward_bias_max=delta,
        n_steps=n_steps,
        status=status,
        message=message,
        beta=beta,
        optimism=problem.optimism,
        value=spread(problem, value, np.zeros(mdp.n_states)),
        action_value=spread(problem, action_value, np.where(there, 0.0, -np.inf)),
        theta_bounds=bounds,
        gap=gap,
        k=k,
    )


def bias(problem: BellmanProblem, log_psi: np.ndarray) -> np.ndarray:
    """delta(s,a), [n, A], reward: (log <psi> - <log psi>)/beta of equation (9) at optimism 0.

    At any optimism (1 - optimism) (C V - C' V), with C' of optimism - 1 and V = -log(psi)/beta: >= 0 up to 1, where
    there is no bias, and <= 0 above.
    """
    lam, beta = problem.optimism, problem.beta
    if lam == 0.0:
        delta = np.maximum(problem.tilt(log_psi)[0] - problem.transition @ log_psi, 0.0) / beta
    else:
        # (1 - optimism) C' V = -(1/beta) log <psi^(1 - optimism)>
        delta = (1 - lam) * problem.certainty_equivalent(-log_psi / beta) + problem.tilt((1 - lam) * log_psi)[0] / beta
        delta = np.maximum(delta, 0.0) if lam <= 1 else np.minimum(delta, 0.0)
    return np.asarray(delta.reshape(problem.reward.shape))


def policy_gap(
    problem: BellmanProblem, policy: np.ndarray, bounds: tuple[float, float], value: np.ndarray | None = None
) -> float:
    """Upper bound on g* - J(policy) from the start, reward per step, for ``bounds`` on theta* = -g*.

    ``value`` [n]: the value that the policy is pi_V of, if it is; its gains then bound J closely enough.
    """
    parts = (problem.transition, problem.reward, problem.prior, problem.beta, policy)
    worth = -np.inf
    if value is not None:
        worth = float(policy_gains(*parts, value, problem.kappa)[0].min())
    if value is None or -worth - bounds[0] > 2 * (bounds[1] - bounds[0]):
        worth = max(worth, objective(*parts, problem.start, optimism=problem.optimism).low)
    return max(float(np.nextafter(-bounds[0] - worth, np.inf)), 0.0)


def reducible_solution(mdp: Sized, problem: BellmanProblem, prior_policy: ArrayLike | None) -> Solution:
    """The policy and the bounds that V = 0 proves, and a message that names the classes."""
    value = np.zeros(problem.n_states)
    bounds = problem.gains(value).theta_bounds
    message = explain_classes(problem)
    return exact_solution(mdp, problem, value, Status.REDUCIBLE, 0, bounds, prior_policy, message)


def ended(
    mdp: Sized,
    problem: BellmanProblem,
    value: np.ndarray,
    bounds: tuple[float, float],
    tol: float,
    steps: int,
    max_steps: int,
    prior_policy: ArrayLike | None = None,
    k: int | None = None,
) -> Solution:
    """The solution of an iteration that stopped at ``value`` [n], with its status; ``bounds`` are on theta*."""
    message = ""
    if problem.is_narrow(bounds, tol, problem.gains(value).policy):
        status = Status.CONVERGED
    elif steps >= max_steps:
        status = Status.STEP_LIMIT
    elif len(problem.classes[1]) > 1:
        status, message = Status.REDUCIBLE, explain_classes(problem)
    elif problem.optimism < 0 and bounds[1] - bounds[0] > ROUNDING_WIDTH * problem.reward_range:
        status, message = Status.NO_SINGLE_RATE, SEVERAL_RATES
    else:
        status = Status.STAGNATED
    return exact_solution(mdp, problem, value, status, steps, bounds, prior_policy, message, k)


def explain_classes(problem: BellmanProblem) -> str:
    """A text: why the states that the start leads to are not one recurrent class, and what to do."""
    label, closed = problem.classes

    def name(c: int) -> str:
        members = problem.states[label == c]
        return f"{members[:5].tolist()}{'...' if len(members) > 5 else ''}"

    ends = [name(c) for c in np.flatnonzero(closed)[:5]]
    if closed.sum() > 1:
        return (
            f"{closed.sum()} closed sets of states, {', '.join(ends)}: let the process restart from them, "
            "or solve each apart"
        )
    others = [name(c) for c in np.flatnonzero(~closed)[:5]]
    return (
        f"once in the closed set {ends[0]}, the process never returns to {', '.join(others)}: let it restart, "
        "or solve those states apart (they may be better off never to leave)"
    )


def spread(problem: BellmanProblem, table: np.ndarray, elsewhere: np.ndarray) -> torch.Tensor:
    """``table`` on the problem's states, extended to all states by that of ``elsewhere``."""
    full = elsewhere.copy()
    full[problem.states] = table
    return torch.from_numpy(full)
