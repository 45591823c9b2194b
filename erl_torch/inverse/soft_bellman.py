"""The solution of a soft Bellman problem as a differentiable torch function of rewards, dynamics, prior and beta.

The derivatives are those of the exact solution, by one linear equation (``erl_torch.inverse.derivatives``). A row of
transition probabilities stands for the row divided by its sum, and so does a row of the prior. So their derivatives
are those of a function that does not change where a row is scaled: sum_s' p(s'|s,a) dp(s'|s,a) = 0, and for a change
of the row that sums to 0 they are what the derivative along the simplex is. At an entry that is 0 the derivative is
one-sided, from above. A pair with prior 0 is no pair of the problem: its derivatives are 0.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp
import torch
from torch.autograd.function import once_differentiable

from erl_torch import checks
from erl_torch.checks import InputError
from erl_torch.inverse.derivatives import Linearised, linearise
from erl_torch.mdp.tabular import ROW_SUM_TOLERANCE, TabularMDP, check_prior
from erl_torch.solution import Status
from erl_torch.solvers.chains import SingularChainError
from erl_torch.solvers.problem import BellmanProblem
from erl_torch.solvers.soft_bellman import solve_problem


class SoftBellman(NamedTuple):
    """The solution of V - theta = TV, tensors in double precision."""

    theta: torch.Tensor  # [], reward per step; -theta is the optimal regularised reward rate
    value: torch.Tensor  # V, [S], reward
    log_policy: torch.Tensor  # log pi*, [S, A]; -inf where the prior is 0


def soft_bellman(
    reward: torch.Tensor,
    transition: torch.Tensor,
    prior_policy: torch.Tensor | None = None,
    beta: float | torch.Tensor = 1.0,
    pattern: sp.csr_array | None = None,
    reference: int | None = None,
    tol: float = 1e-10,
    max_steps: int = 200,
    *,
    optimism: float = 0.0,
) -> SoftBellman:
    """The optimal entropy-regularised solution, differentiable (once) by reward, transition, prior and beta; optimism 1
    optimistic (control as inference), 0 right, negative robust.

    Args:
        reward: [S, A], reward per step; not looked at where the prior is 0.
        transition: p(s'|s, a), [S, A, S]; with ``pattern`` its entries [nnz]. Rows stand for the rows divided by their
            sums, which are 1 within 1e-5.
        prior_policy: [S, A], 0 where an action is not to be taken; None is uniform. Rows likewise.
        beta: inverse temperature, 1/reward, > 0; a number or a tensor [].
        pattern: CSR [S*A, S] whose indices say where the entries of ``transition`` stand (``mdp.transition``).
        reference: the state where V is 0; None: the mean of V over states is 0.
        tol: as of ``solve_soft_bellman``. Newton steps to the last digits follow.
        max_steps: linear systems at most, before those.
        optimism: coefficient of the certainty equivalent of V(s'), in units of beta; its derivative is not computed.

    Returns:
        theta, V and log pi*. theta needs no equation to be solved backwards.

    Raises:
        InputError: tensors that are not as above or not in double precision, or a problem whose solution is not
            ``CONVERGED``; the message has the status.
    """
    _check_tensor("reward", reward)
    _check_tensor("transition", transition)
    if prior_policy is None:
        n_states, n_actions = checks.array("reward", reward, ("n_states", "n_actions"), _ANY).shape
        prior_policy = torch.full((n_states, n_actions), 1.0 / n_actions, dtype=torch.float64)
    _check_tensor("prior_policy", prior_policy)
    if isinstance(beta, torch.Tensor):
        _check_tensor("beta", beta)
    solved: tuple[torch.Tensor, torch.Tensor, torch.Tensor] = _Solved.apply(
        reward, transition, prior_policy, beta, pattern, reference, (tol, max_steps, optimism)
    )  # type: ignore[no-untyped-call]
    return SoftBellman(*solved)


def _check_tensor(name: str, value: torch.Tensor) -> None:
    checks.instance(name, value, torch.Tensor, "a tensor, as torch.tensor(..., dtype=torch.float64) makes one")
    if value.dtype != torch.float64 or value.layout != torch.strided or value.device.type != "cpu":
        given = f"a tensor of {value.dtype}, {value.layout}, on {value.device}"
        raise InputError(name, given, "a strided tensor of torch.float64 on cpu")


class _Rows(NamedTuple):
    """The transition probabilities as given."""

    pair: np.ndarray  # [nnz], s*A + a
    to: np.ndarray  # [nnz], s'
    sums: np.ndarray  # of rows, [S*A]


class _Solved(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,  # torch's, without a type
        reward: torch.Tensor,
        transition: torch.Tensor,
        prior: torch.Tensor,
        beta: float | torch.Tensor,
        pattern: sp.csr_array | None,
        reference: int | None,
        settings: tuple[float, int, float],
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        tol, max_steps, optimism = settings
        n_states, n_actions = checks.array("reward", reward, ("n_states", "n_actions"), _ANY).shape
        matrix, rows = _rows(transition, pattern, n_states, n_actions)
        table = checks.array("prior_policy", prior, (n_states, n_actions), _ANY)
        weights = check_prior("prior_policy", _divided(table, table.sum(1, keepdims=True)), n_states, n_actions)
        mdp = TabularMDP(matrix, reward, allowed=weights > 0)  # type: ignore[arg-type]
        value_of_beta = beta.item() if isinstance(beta, torch.Tensor) and beta.ndim == 0 else beta
        problem = BellmanProblem.of(mdp, value_of_beta, weights, optimism)  # type: ignore[arg-type]
        if reference is not None and checks.at_least("reference", reference, 0) >= n_states:
            raise InputError("reference", reference, f"below {n_states}, the number of states")
        at = _solution(problem, mdp, weights, tol, max_steps)
        value = at.value - (at.value.mean() if reference is None else at.value[reference])
        with np.errstate(divide="ignore"):
            log_policy = np.log(weights) + at.log_ratio
        ctx.at, ctx.rows, ctx.reference = at, rows, reference
        ctx.shape, ctx.prior_sums = transition.shape, prior.detach().sum(1, keepdim=True).numpy()
        return torch.tensor(-at.rate, dtype=torch.float64), torch.from_numpy(value), torch.from_numpy(log_policy)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_theta: torch.Tensor, by_value: torch.Tensor, by_log_policy: torch.Tensor) -> Any:
        at: Linearised = ctx.at
        prior = at.problem.prior
        v = by_value.numpy().copy()
        if ctx.reference is None:
            v -= v.mean()
        else:
            v[ctx.reference] -= v.sum()
        found = at.backward(v, -by_theta.item(), np.where(prior > 0, by_log_policy.numpy(), 0.0))
        transition = prior_gradient = None
        if ctx.needs_input_grad[1]:
            pair = (found.pair.ravel() / np.maximum(ctx.rows.sums, 1e-300))[ctx.rows.pair]
            moved = np.zeros(len(pair))
            used = pair != 0
            moved[used] = pair[used] * at.slope(ctx.rows.pair[used], ctx.rows.to[used])
            transition = torch.from_numpy(moved).reshape(ctx.shape)
        if ctx.needs_input_grad[2]:
            by_log = found.log_prior - prior * found.log_prior.sum(1, keepdims=True)
            own = np.where(prior > 0, prior * ctx.prior_sums, 1.0)
            prior_gradient = torch.from_numpy(np.where(prior > 0, by_log / own, 0.0))
        beta = torch.tensor(found.beta, dtype=torch.float64) if ctx.needs_input_grad[3] else None
        return torch.from_numpy(found.pair), transition, prior_gradient, beta, None, None, None


def _rows(
    transition: torch.Tensor, pattern: sp.csr_array | None, n_states: int, n_actions: int
) -> tuple[sp.csr_array, _Rows]:
    """(transition [S*A, S], its entries as they are given)."""
    shape = (n_states * n_actions, n_states)
    if pattern is None:
        table = checks.array("transition", transition, (n_states, n_actions, n_states), _ANY).reshape(shape)
        pair, to = np.divmod(np.arange(table.size), n_states)
        sums = table.sum(1)
        return sp.csr_array(_divided(table, sums[:, None])), _Rows(pair, to, sums)
    checks.instance("pattern", pattern, sp.csr_array, "a csr_array of scipy's")
    if pattern.shape != shape:
        raise InputError("pattern", f"a matrix of shape {pattern.shape}", f"of shape {list(shape)} ([S*A, S])")
    try:
        pattern.check_format(full_check=True)
    except ValueError as error:
        raise InputError("pattern", "a sparse matrix", f"one with indices in range ({error})") from error
    data = checks.array("transition", transition, (len(pattern.indices),), _ANY)
    pair = np.repeat(np.arange(shape[0]), np.diff(pattern.indptr))
    sums = np.bincount(pair, data, shape[0])
    matrix = sp.csr_array((_divided(data, sums[pair]), pattern.indices, pattern.indptr), shape=shape)
    return matrix, _Rows(pair, pattern.indices, sums)


def _divided(table: np.ndarray, sums: np.ndarray) -> np.ndarray:
    """``table`` by its rows' sums; those that are far from 1 stay, to be refused by name."""
    return np.asarray(table / np.where(np.abs(sums - 1) <= ROW_SUM_TOLERANCE, sums, 1.0))


_ANY: checks.Entries = (lambda x: np.ones(x.shape, bool), "")


def _solution(problem: BellmanProblem, mdp: TabularMDP, prior: np.ndarray, tol: float, max_steps: int) -> Linearised:
    solution = solve_problem(problem, mdp, prior, tol, max_steps)
    if solution.status is not Status.CONVERGED:
        why = solution.message or solution.status.value
        raise InputError("reward", f"a problem whose solution is {solution.status.name}", f"one that CONVERGED ({why})")
    assert solution.value is not None
    try:
        return linearise(problem, solution.value.numpy())
    except SingularChainError as error:
        allowed = f"one whose chain double precision can solve ({error})"
        raise InputError("reward", "a problem without derivatives", allowed) from error
