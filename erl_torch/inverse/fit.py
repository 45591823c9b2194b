"""Which reward explains this behaviour? ``fit_reward``, from demonstrations in a known or counted model.

The expert is taken to be optimal for a reward r = sum_k w_k phi_k, as ``solve_soft_bellman`` has it: with policy pi_w
and rate g_w. At optimism 0 the estimator balances the flow (docs/theory.md, Inverse):

    pi_E(a|s) = (n(s,a) + c prior) / (n(s) + c),  d_E the long-run share of pairs under pi_E,
    maximise    beta (sum d_E r_w - g_w) - penalty |w|^2 / 2.

That is concave, and its first term is the mean of log(pi_w/prior) over d_E. Only pi_E(a|s) enters: demonstrations may
be short, begin anywhere and be cut anywhere. Above optimism 0 the mean of log pi_w over the demonstrations is maximised
itself; it is not concave, and what is found is a local maximum.

What behaviour cannot tell: at optimism 0, w and w + v explain it alike if sum_k v_k phi_k = Phi(s) - E Phi(s') + const,
which a table of rewards always allows: of S A entries S A - S are told. The weights returned have no part in such
directions. Above optimism 0 the directions named are those that change nothing to first order.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import minimize

from erl_torch import checks
from erl_torch.checks import InputError
from erl_torch.empirical.counts import EmpiricalMDP
from erl_torch.experience.experience import Experience
from erl_torch.inverse.demonstrations import Demonstrated, Setting, demonstrated, setting
from erl_torch.inverse.derivatives import Linearised, linearise
from erl_torch.mdp.tabular import TabularMDP
from erl_torch.solution import Solution
from erl_torch.solvers import nested
from erl_torch.solvers.chains import SingularChainError
from erl_torch.solvers.problem import BellmanProblem
from erl_torch.solvers.soft_bellman import solve_problem

TOLD = 1e-9  # of singular values of the advantages, relative to the largest: below, behaviour tells nothing
ROUNDING = 1e-12  # of an advantage, relative to the size of its feature
WIDTH = 1e-9  # of TV - V, relative to the rewards' range, at which a value is a solution
WARM_STEPS = 8  # Newton steps from the value of the reward before
FALLS = (1e-8, 1e-13)  # of the objective in a step, relative, at which L-BFGS hands over to scoring; its second try
SCORING_STEPS = 50
SHARED = ("pattern", "elimination", "classes")  # of problems that differ in their rewards alone
MUCH_UNSEEN = 1e-3  # of the expert's time
PART = 1e-6  # of a feature that may lie in directions that are not told
SMALL = 1e-14  # eigenvalues of the information, relative to the largest, that rounding hides
SIZES = (1e-100, 1e100)  # of a feature, and of pseudo_count: within, squares stay in double precision
WEAK = 1e-6  # information of a step about beta times a feature's size times its weight, nats
LEVEL = 1e-9  # nats a step: a likelihood that falls by less is level
RISES, LEVELS = "rises", "level"
RISE = 1e-12  # nats a step, above what rounding makes of a likelihood


@dataclass(frozen=True, eq=False, kw_only=True)
class RewardFit:
    """A reward that explains demonstrations, how sure they are of it, and what they cannot tell.

    Errors are of first order, and count the chance in the expert's actions alone: the model is taken to be right.
    """

    weights: np.ndarray  # [F], reward; at optimism 0 without a part in ``unidentified``
    reward: np.ndarray  # [S, A], sum_k w_k phi_k; of a table 0 in pairs that take no part
    standard_error: np.ndarray | None  # of the told part of ``weights``, [F]; infinite without, None where exact
    identified: np.ndarray  # [F] bool: whether the weight itself is, not only a combination; its error is finite
    unidentified: np.ndarray  # [F, k], orthonormal columns: w plus any of them explains the behaviour as well;
    # above optimism 0 to first order in them
    eigenvalues: np.ndarray  # of the information of one step about the other directions, ascending, 1/reward^2
    unmet: tuple[int, ...]  # features that are 0 in all that was demonstrated
    solution: Solution  # of ``reward``, with its certificate
    gap: float  # what pi_E loses by ``reward`` at the expert's optimism, g* - J(pi_E), reward per step
    log_likelihood: float  # mean of log(pi/prior) over the demonstrations, nats per step
    n_steps: float  # demonstrated; infinite where the policy was exact
    # The flows of features differ by ``tol`` of each feature's size at most, the penalty counted, and the likelihood is
    # not seen to rise without end:
    converged: bool
    message: str
    names: tuple[str, ...]

    def __str__(self) -> str:
        """A line a feature: weight, standard error, what is not told."""
        lines = []
        width = max(map(len, self.names))
        for k, name in enumerate(self.names):
            error = "" if self.standard_error is None else f" +- {self.standard_error[k]:.2g}"
            more = "" if self.identified[k] else "  (not told apart from others)"
            lines.append(f"{name:{width}} {self.weights[k]: .4g}{error}{more}{'  (never met)' * (k in self.unmet)}")
        return "\n".join([*lines, *([self.message] if self.message else [])])


def fit_reward(
    demonstrations: Experience | ArrayLike,
    features: ArrayLike | None = None,
    *,
    mdp: TabularMDP | EmpiricalMDP,
    beta: float,
    prior_policy: ArrayLike | None = None,
    penalty: float = 0.0,
    pseudo_count: float = 0.01,
    exact: bool = False,
    names: Sequence[str] | None = None,
    tol: float = 1e-9,
    max_iterations: int = 1000,
    optimism: float = 0.0,
) -> RewardFit:
    """The reward, as a sum of features, for which the demonstrated behaviour is optimal; optimism 1 optimistic (control
    as inference), 0 right, negative is refused.

    Args:
        demonstrations: tuples, of which s and a count (their order, rewards and a' do not); or a table [S, A] of counts
            n(s, a), or with ``exact`` of a policy, or of shares of pairs: proportions within a row are the policy.
        features: [S, A, F], or [S, F] of the state alone, the largest value of each 0 or of size 1e-100 to 1e100;
            None: each pair is one, the reward is a table.
        mdp: the model, whose rewards are ignored; or counts of tuples, the expert's or others', as of
            ``empirical_mdp``.
        beta: inverse temperature of the expert, 1/reward. Only beta times the reward is told.
        prior_policy: [S, A], 0 where an action is not to be taken; None is uniform over the actions of each state.
        penalty: >= 0, 1/reward^2, of |w|^2 / 2, taken from the log-likelihood of one step.
        pseudo_count: 1e-100 to 1e100, steps of the prior that are added to those of each state.
        exact: the table is the expert's policy itself, of infinitely many steps.
        names: [F], of the features; None: numbers, or pairs.
        tol: of the gradient: difference of mean features, each in units of its largest value.
        max_iterations: of L-BFGS.
        optimism: of the expert, >= 0.

    Returns:
        A RewardFit.

    Raises:
        InputError: arguments out of range, optimism below 0, no step in a pair of the problem, or a model that
            ``solve_soft_bellman`` does not solve.
    """
    beta = checks.temperature("beta", beta)
    if checks.optimism("optimism", optimism, beta) < 0:
        raise InputError("optimism", optimism, ">= 0: below 0 not even the rate is a convex function of the reward")
    penalty = checks.number("penalty", penalty, lambda x: 0 <= x < np.inf, "a finite number >= 0")
    low, high = SIZES
    pseudo_count = checks.number("pseudo_count", pseudo_count, lambda x: low <= x <= high, f"{low:g} to {high:g}")
    checks.positive("tol", tol)
    checks.at_least("max_iterations", max_iterations, 1)
    given = setting(mdp, beta, prior_policy, optimism)
    expert = demonstrated(demonstrations, given, pseudo_count, checks.flag("exact", exact))
    table, labels = _features(features, given, names)
    objective = _Objective(given, expert, table, penalty)
    weights, at, converged = _maximise(objective, tol, max_iterations)
    space = _directions(objective, at)
    told, hidden = space.told, space.hidden
    refused = features is None and penalty == 0 and objective.refuses()  # a table explains that only in the limit
    away = RISES if refused else _away(objective, weights, at)
    if optimism == 0:  # shaping, which changes nothing at all
        weights = told @ (told.T @ weights)
    solution = objective.solve(objective.problem(weights))
    eigenvalues, error, lost = _information(objective, at, space)
    converged = converged and away != RISES
    rounded = [labels[k] for k in np.flatnonzero(lost & space.own)]
    told_of = [*_maximum_told(converged, away), *_directions_told(hidden, rounded, bool(away), optimism)]
    seen = (expert.weight if expert.exact else expert.counts).ravel() > 0
    unmet = tuple(np.flatnonzero(~(table[seen] != 0).any(0)).tolist())
    return RewardFit(
        weights=weights,
        reward=_reward(features, given, table, weights),
        standard_error=error,
        identified=space.own & ~lost,
        unidentified=hidden,
        eigenvalues=eigenvalues,
        unmet=unmet,
        solution=solution,
        gap=_gap(expert, at),
        log_likelihood=float((expert.weight * at.log_ratio).sum()),
        n_steps=np.inf if expert.exact else expert.n_steps,
        converged=converged,
        message=_message(given, expert, solution, [labels[k] for k in unmet], told_of),
        names=labels,
    )


def _features(
    features: ArrayLike | None, given: Setting, names: Sequence[str] | None
) -> tuple[np.ndarray, tuple[str, ...]]:
    """(features of the problem's pairs [n*A, F], 0 where the prior is 0; their names)."""
    problem, there = given.problem, given.problem.prior > 0
    n_states, n_actions = given.prior.shape
    low, high = SIZES
    if features is None:
        pairs = np.argwhere(there)
        checks.room("features", (there.size, len(pairs)))
        table = np.zeros((there.size, len(pairs)))
        table[np.flatnonzero(there), np.arange(len(pairs))] = 1.0
        labels = tuple(f"({problem.states[s]}, {a})" for s, a in pairs)
    else:
        whole = _every_pair(features, n_states, n_actions)
        table = np.where(there[:, :, None], whole[problem.states], 0.0).reshape(there.size, -1)
        labels = tuple(map(str, range(table.shape[1])))
        sizes = np.abs(table).max(0)
        if (odd := np.flatnonzero((sizes != 0) & ((sizes < low) | (sizes > high)))).size:
            k = int(odd[0])
            raise InputError("features", f"one (number {k}) of size {sizes[k]:g}", f"0, or of size {low:g} to {high:g}")
    if names is not None:
        labels = checks.sequence("names", names)
        for name in labels:
            checks.instance("names", name, str, "texts")
        if len(labels) != table.shape[1]:
            raise InputError("names", f"{len(labels)} names", f"{table.shape[1]}, one a feature")
    return table, labels


def _every_pair(features: ArrayLike, n_states: int, n_actions: int) -> np.ndarray:
    """``features`` as [S, A, F]."""
    table = checks.real("features", features)
    if table.ndim == 2:
        by_state = checks.array("features", table, (n_states, "n_features"))
        return np.repeat(by_state[:, None, :], n_actions, axis=1)
    return checks.array("features", table, (n_states, n_actions, "n_features"))


def _reward(features: ArrayLike | None, given: Setting, table: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """[S, A]."""
    if features is not None:
        return np.asarray(_every_pair(features, *given.prior.shape) @ weights)
    reward = np.zeros(given.prior.shape)
    reward[given.problem.states] = (table @ weights).reshape(given.problem.reward.shape)
    return reward


class _Objective:
    """The log-likelihood of one step less the penalty, with its derivatives, as a function of x [F]: weights times beta
    times ``scale``, the size of each feature."""

    def __init__(self, given: Setting, expert: Demonstrated, features: np.ndarray, penalty: float) -> None:
        self.given, self.base, self.expert, self.penalty = given, given.problem, expert, penalty
        self.scale = np.abs(features).max(0)
        self.scale[self.scale == 0] = 1.0
        self.features = features / self.scale
        with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
            self.stiffness = np.sqrt(penalty) / (self.base.beta * self.scale)
            self.stiffness = self.stiffness**2
        if not np.isfinite(self.stiffness).all():
            raise InputError("penalty", penalty, "less: in units of beta times the features it leaves double precision")
        self._aim = self.features.T @ expert.flow.ravel()
        self._value: np.ndarray | None = None

    def refuses(self) -> bool:
        """Whether the expert never takes an action that it may take, in a state where it spends time."""
        expert, there = self.expert, self.base.prior > 0
        return bool(((expert.policy == 0) & there & (expert.weight.sum(1, keepdims=True) > 0)).any())

    def weights(self, x: np.ndarray) -> np.ndarray:
        return np.asarray(x / (self.base.beta * self.scale))

    def problem(self, weights: np.ndarray) -> BellmanProblem:
        """With the reward of ``weights`` [F]."""
        base = self.base
        reward = (self.features @ (self.scale * weights)).reshape(base.reward.shape)
        problem = replace(base, reward=base.reward + reward)
        for name in SHARED:
            problem.__dict__[name] = getattr(base, name)
        return problem

    def solve(self, problem: BellmanProblem) -> Solution:
        return solve_problem(problem, self.given.mdp, self.given.prior)

    def at(self, x: np.ndarray) -> Linearised | None:
        """The solution; None where there is none in double precision."""
        problem = self.problem(self.weights(x))
        if not np.isfinite(problem.reward).all():
            return None
        for value in (self._value, None):
            try:
                if value is None:
                    whole = self.solve(problem).value
                    assert whole is not None
                    value = whole.numpy()[problem.states]
                found = linearise(problem, value, WARM_STEPS)
            except SingularChainError:
                continue
            if found.width <= WIDTH * problem.reward_range:
                self._value = found.value
                return found
        return None

    def share(self, at: Linearised) -> np.ndarray:
        """Weight of each state in the second derivative, [n]."""
        return at.share if self.base.kappa == 0 else np.asarray(self.expert.weight.sum(1))

    def evaluate(self, x: np.ndarray, at: Linearised) -> tuple[float, np.ndarray]:
        """(objective, its gradient [F])."""
        beta, expert = self.base.beta, self.expert
        mean = float((expert.weight * at.log_ratio).sum())
        if self.base.kappa == 0:
            reward = float((expert.flow * at.problem.reward).sum())
            mean = beta * (reward - at.rate)
            gradient = self._aim - self.features.T @ (at.share[:, None] * at.policy).ravel()
        else:
            none = np.zeros(len(at.value))
            gradient = self.features.T @ at.backward(none, 0.0, expert.weight).pair.ravel() / beta
        return mean - float(self.stiffness @ x**2) / 2, gradient - self.stiffness * x


def _maximise(objective: _Objective, tol: float, max_iterations: int) -> tuple[np.ndarray, Linearised, bool]:
    """(weights [F], the solution there, whether the gradient is small): L-BFGS, then scoring steps."""
    x = np.zeros(objective.features.shape[1])
    first = objective.at(x)
    if first is None:
        why = objective.solve(objective.problem(x))
        allowed = f"a model that solve_soft_bellman solves ({why.message or why.status.value})"
        raise InputError("mdp", f"a model whose solution without rewards is {why.status.name}", allowed)
    best = x, first, *objective.evaluate(x, first)

    def loss(x: np.ndarray) -> tuple[float, np.ndarray]:
        nonlocal best
        at = objective.at(x)
        if at is None:
            return np.inf, np.zeros(len(x))
        value, gradient = objective.evaluate(x, at)
        if value >= best[2]:
            best = x.copy(), at, value, gradient
        return -value, -gradient

    for fall in FALLS:
        options = {"maxiter": max_iterations, "maxfun": 4 * max_iterations, "ftol": fall, "gtol": tol, "maxcor": 20}
        minimize(loss, best[0], jac=True, method="L-BFGS-B", options=options)
        for _ in range(SCORING_STEPS):
            if np.abs(best[3]).max() <= 1e-3 * tol or (better := _scored(objective, *best)) is None:
                break
            best = better
        if np.abs(best[3]).max() <= tol:
            break
    x, at, _, gradient = best
    return objective.weights(x), at, bool(np.abs(gradient).max() <= tol)


def _scored(
    objective: _Objective, x: np.ndarray, at: Linearised, value: float, gradient: np.ndarray
) -> tuple[np.ndarray, Linearised, float, np.ndarray] | None:
    """(x, solution, objective, gradient) after a step along the inverse information; None where no part of it helps."""
    information = _squares(at, _advantages(objective, at), objective.share(at)) + np.diag(objective.stiffness)
    sizes, axes = np.linalg.eigh(information)
    kept = sizes > SMALL * max(sizes[-1], 0.0)
    step = axes[:, kept] @ ((axes[:, kept].T @ gradient) / sizes[kept])
    for length in 0.5 ** np.arange(10):
        new = x + length * step
        there = objective.at(new)
        if there is None:
            continue
        new_value, new_gradient = objective.evaluate(new, there)
        smaller = np.linalg.norm(new_gradient) < 0.9 * np.linalg.norm(gradient)
        if new_value > value + 1e-14 * max(abs(value), 1.0) or (smaller and new_value > value - 1e-12):
            return new, there, new_value, new_gradient
    return None


def _advantages(objective: _Objective, at: Linearised) -> np.ndarray:
    """Those of the features, divided by their sizes, [n*A, F]."""
    n, n_actions = at.policy.shape
    return at.advantages(objective.features.reshape(n, n_actions, -1)).reshape(n * n_actions, -1)


def _squares(at: Linearised, advantages: np.ndarray, share: np.ndarray) -> np.ndarray:
    """sum_s share sum_a pi A A', [F, F]."""
    weight = (share[:, None] * at.policy).ravel()
    return np.asarray(advantages.T @ (weight[:, None] * advantages))


class _Space(NamedTuple):
    """What behaviour tells of the weights, and what it does not."""

    told: np.ndarray  # [F, r], orthonormal columns: the rest of ``hidden``
    hidden: np.ndarray  # [F, k], orthonormal columns
    basis: np.ndarray  # [F, r]: coordinates of what is told, to weights times the features' sizes
    part: np.ndarray  # [F, r]: the same, to the part of the weights in ``told``, times the features' sizes
    own: np.ndarray  # [F] bool: whether the weight has no part in ``hidden``


def _directions(objective: _Objective, at: Linearised) -> _Space:
    """What behaviour tells of the weights; the rank is asked of features divided by their sizes."""
    scaled = _advantages(objective, at)[objective.base.prior.ravel() > 0]
    n_pairs, n_features = scaled.shape
    _, sizes, axes = np.linalg.svd(scaled, full_matrices=n_features > n_pairs)
    # Of features that tell nothing at all, rounding is left: their sizes are 1, so that of a column is sqrt(n_pairs).
    rank = int((sizes > max(TOLD * sizes[0], ROUNDING * np.sqrt(n_pairs))).sum())
    own = np.sqrt((axes[rank:] ** 2).sum(0)) < PART
    scale = objective.scale
    if rank == n_features:  # the features themselves are coordinates, and no sizes mix
        basis = np.eye(n_features)
        return _Space(basis, np.zeros((n_features, 0)), basis, basis, own)
    whole = np.linalg.qr((axes[rank:] * (scale.min() / scale)).T, mode="complete")[0]
    told, hidden = whole[:, n_features - rank :], whole[:, : n_features - rank]
    basis = axes[:rank].T
    part = basis - scale[:, None] * (hidden @ (hidden.T @ (basis / scale[:, None])))
    return _Space(told, hidden, basis, part, own)


def _information(
    objective: _Objective, at: Linearised, space: _Space
) -> tuple[np.ndarray, np.ndarray | None, np.ndarray]:
    """(eigenvalues of a step's information about the directions told, standard errors of the weights [F], [F] bool:
    whether a weight has a part in directions that are told by less than rounding leaves).

    With h the weight of a state in the objective, its second derivative is -H, H = beta^2 sum_s h E A A', and the
    variance of its first that of the expert's actions, beta^2 sum_s h^2 E A A' / n(s): the errors are those of
    H^-1 (...) H^-1, which is the inverse of the Fisher information where steps fall as h does. Coordinates are divided
    by the roots of H's diagonal, so that rounding is the same on every scale of features.
    """
    expert, beta, scale = objective.expert, objective.base.beta, objective.scale
    share, whole = objective.share(at), _advantages(objective, at)
    with np.errstate(over="ignore"):
        sizes = np.linalg.eigvalsh(_squares(at, beta * (whole * (scale / scale.max())) @ space.told, share))
        sizes = sizes * scale.max() ** 2
    advantages = whole @ space.basis
    plain = _squares(at, advantages, share)
    unit = np.sqrt(np.diag(plain))
    unit[unit == 0] = 1.0
    stiff = space.part / unit
    plain = plain / np.outer(unit, unit)
    known_sizes, axes = np.linalg.eigh(plain)
    known = known_sizes > SMALL * max(known_sizes.max(initial=0.0), 0.0)
    part = stiff @ axes
    lost = _share_of(part, ~known) > PART
    if expert.exact:
        return sizes, None, lost
    visits = expert.counts.sum(1)
    reach = share**2 * (visits / (visits + expert.pseudo_count)) / (visits + expert.pseudo_count)
    kept = part[:, known]
    second = np.diag(known_sizes[known]) + kept.T @ (objective.stiffness[:, None] * kept)
    spread = np.linalg.solve(second, kept.T).T
    turned = axes[:, known]
    noise = turned.T @ (_squares(at, advantages, reach) / np.outer(unit, unit)) @ turned
    variance = np.einsum("fi,ij,fj->f", spread, noise, spread)
    error = np.sqrt(np.maximum(variance, 0.0)) / (beta * scale)
    untold = np.sqrt((space.part**2).sum(1)) < PART
    return sizes, np.where(lost | untold | ~np.isfinite(error), np.inf, error), lost | (space.own & ~np.isfinite(error))


def _share_of(part: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """Share of each row of ``part`` that is in columns ``chosen``, [F]; 0 for a row of zeros."""
    whole = np.sqrt((part**2).sum(1))
    return np.asarray(np.sqrt((part[:, chosen] ** 2).sum(1)) / np.where(whole > 0, whole, 1.0))


def _away(objective: _Objective, weights: np.ndarray, at: Linearised) -> str:
    """Whether the objective still rises, or is level, where what is hardly told of the weights is doubled; "" if not.

    Weights that run away stop where the gradient is lost in rounding. What is not told at all stays at 0 meanwhile.
    """
    x = weights * objective.base.beta * objective.scale
    information = _squares(at, _advantages(objective, at), objective.share(at)) + np.diag(objective.stiffness)
    sizes, axes = np.linalg.eigh(information)
    weak = axes[:, sizes < WEAK]
    more = weak @ (weak.T @ x)
    if np.abs(more).max(initial=0.0) < 1:
        return ""
    there = objective.at(x + more)
    if there is None:
        return ""
    change = objective.evaluate(x + more, there)[0] - objective.evaluate(x, at)[0]
    return RISES if change > RISE else LEVELS if change > -LEVEL else ""


def _gap(expert: Demonstrated, at: Linearised) -> float:
    """g* - J(pi_E) >= 0, reward per step; no digit is lost, as it is a rate of divergences.

    T_pi V* - V* = g* - KL(pi || pi*)/beta, so J - g* is the worth of pi where it pays these in the dynamics q*.
    """
    loss = _divergence(expert.policy, at) / at.problem.beta
    if not at.problem.optimism:
        return float(loss @ expert.flow.sum(1))
    p, policy = at.problem, expert.policy
    reward = np.repeat(-loss[:, None], policy.shape[1], axis=1)
    worth = nested.objective(at.tilted, reward, policy, p.beta, policy, p.start, optimism=p.optimism)
    return max(-worth.value, 0.0) + 0.0  # no -0


def _divergence(policy: np.ndarray, at: Linearised) -> np.ndarray:
    """KL(policy || pi*) of each state, [n]."""
    prior = at.problem.prior
    ratio = policy / np.where(prior > 0, prior, 1.0)
    terms = np.where(policy > 0, policy * (np.log(np.where(policy > 0, ratio, 1.0)) - at.log_ratio), 0.0)
    return np.asarray(np.maximum(terms.sum(1), 0.0))


def _maximum_told(converged: bool, away: str) -> list[str]:
    if away == RISES:
        return ["the likelihood has no maximum that was found: weights grow without end; a penalty keeps them"]
    if away == LEVELS:
        return ["the likelihood is level where weights grow: they may be any large numbers; a penalty keeps them"]
    return [] if converged else ["the maximum was not reached; where weights grow without end, a penalty keeps them"]


def _directions_told(hidden: np.ndarray, lost: list[str], away: bool, optimism: float) -> list[str]:
    parts = []
    if hidden.shape[1]:
        where, order = " out there" if away else "", " to first order" if optimism else ""
        parts.append(f"{hidden.shape[1]} of {len(hidden)} directions of the weights change no behaviour{order}{where}")
    if lost:
        parts.append(f"what tells {_listed(lost)} is lost in rounding: no error")
    return parts


def _listed(names: list[str]) -> str:
    return f"{', '.join(names[:5])}{'...' if len(names) > 5 else ''}"


def _message(given: Setting, expert: Demonstrated, solution: Solution, unmet: list[str], found: list[str]) -> str:
    """What to know of the fit, in one line; "" where there is nothing."""
    parts = [given.message, *found] if given.message else found
    if unmet:
        parts.append(f"no demonstration meets {_listed(unmet)}: told by what was avoided alone")
    if expert.unseen > MUCH_UNSEEN:
        parts.append(f"{expert.unseen:.2g} of the expert's time would pass in states without a step, on the prior")
    if solution.status.name != "CONVERGED":
        parts.append(f"the solution is {solution.status.name}: {solution.message or solution.status.value}")
    return "; ".join(parts)
