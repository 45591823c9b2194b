"""The first-exit neighbour of the average-reward problem (stochastic shortest path): V = TV, and V = 0 at the ends,

    TV(s) = (1/beta) log sum_a prior(a|s) exp(beta (r(s,a) + E_{s'|s,a} V(s'))).

V*(s) is the largest expected sum of rewards less KL/beta up to an end, over the policies that come to one almost
surely. Four things can be wrong with such a problem, and each is checked.

1. *The prior reaches an end*, through pairs with prior > 0, and never through a pair that may lead to where no end can
   be reached. States from which it does not have V = -infinity; they are named, and not solved.
2. *No way round pays.* A set of states that some of their actions never leave (an end component) has a regularised rate
   of its own, g = max of r - KL/beta over the policies inside; g > 0 makes V infinite, g = 0 leaves more than one
   solution.
3. *The certificate proves that none does.* With U and W such that TU >= U and TW <= W - eps, eps > 0, in every state,

       U <= J(pi_U) <= V* <= W,        eps E[steps to an end under the optimal policy] <= W - U,

   and every policy that is worth more than -infinity comes to an end (docs/theory.md, 8). U and W are V -+ d h, h the
   expected steps to an end under pi_V, d a little more than what is left of TV - V and its rounding.
4. *There is an end at all*: a table counted from a log without one is refused. ``avoiding`` names the states and
   actions that never come to an end, where there are such.

Newton's step is soft policy iteration from the prior on, one linear system of the policy's chain cut at the end.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
import torch
from numpy.typing import ArrayLike

from erl_torch import checks
from erl_torch.checks import InputError
from erl_torch.mdp.from_gymnasium import absorbed
from erl_torch.mdp.tabular import TabularMDP
from erl_torch.solution import Status
from erl_torch.solvers.certificates import gains, policy_gains, soft_backup
from erl_torch.solvers.chains import EPSILON, RegenerativeLU, SingularChainError, classes, reachable_from
from erl_torch.solvers.problem import BellmanProblem, state_graph
from erl_torch.solvers.soft_bellman import iterate_soft_bellman
from erl_torch.solvers.values import ValueSolution, chance_of, scale, start_bounds, up, with_end

WIDENINGS = 30  # of d, each fourfold
NAMED = 5  # states in a message


class Avoiding(NamedTuple):
    """States and actions that never lead to an end: a maximal end component."""

    states: np.ndarray  # [k], ascending
    actions: np.ndarray  # [k, A] bool: those that surely stay among the states


@dataclass(frozen=True, eq=False, kw_only=True)
class ExitSolution(ValueSolution):
    """A ValueSolution of a process that ends.

    ``value`` is 0 at the ends, and -infinite where no end can be reached; where ``solved`` is false, the policy is the
    prior. Without a certificate nothing is solved: values are NaN, or infinite, between bounds that hold.
    """

    ends: torch.Tensor  # [S] bool
    solved: torch.Tensor  # [S] bool: the start leads there, an end can be reached from there, and bounds were found
    steps: torch.Tensor  # [S], expected steps to an end under the policy, but for rounding
    steps_bound: torch.Tensor  # [S], at least the expected steps to an end under the optimal policy
    avoiding: tuple[Avoiding, ...]


def solve_first_exit(
    mdp: TabularMDP,
    beta: float,
    prior_policy: ArrayLike | None = None,
    ends: ArrayLike | None = None,
    tol: float = 1e-10,
    max_steps: int = 200,
) -> ExitSolution:
    """The policy with the largest expected sum of rewards less KL/beta up to an end, with bounds on its value.

    Args:
        mdp: the problem, on the states that its start leads to. ``tabular_mdp(env, on_end="absorb")`` makes the model
            of one episode from an environment; a model with on_end="restart" has no ends.
        beta: inverse temperature, 1/reward, > 0.
        prior_policy: [S, A]; None is uniform.
        ends: [S] bool; the process stops on entering such a state, and whatever ``mdp`` says of it does not count.
            None: the states that no action leaves and that pay 0.
        tol: width of the bounds at which to stop, relative to the largest |V|, or mean |r| of a step if that is more.
        max_steps: linear systems at most.

    Returns:
        An ExitSolution. Status ILL_POSED where a way round that never ends surely pays more than ending (the message
        names it; values are +infinite where it can be reached), STAGNATED where rounding keeps the bounds wider than
        ``tol``, or infinite, or hides whether a way round pays (the message names it). Other states than those solved
        keep the prior policy.

    Raises:
        InputError: beta, prior, ends, tol or max_steps out of range, or no end that the start leads to.
    """
    checks.instance("mdp", mdp, TabularMDP, "a TabularMDP")
    checks.positive("tol", tol)
    checks.at_least("max_steps", max_steps, 1)
    ended = ending(mdp, ends)
    problem = BellmanProblem.of(absorbed(mdp, np.flatnonzero(ended), 0.0), beta, prior_policy)
    inside = _Inside.of(problem, ended[problem.states])
    found = _solve(inside, tol, max_steps)
    return _solution(mdp, problem, inside, found, ended)


def ending(mdp: TabularMDP, ends: ArrayLike | None) -> np.ndarray:
    """[S] bool: ``ends`` checked; None is the states that no action leaves and that pay 0.

    Raises InputError where there is no end.
    """
    n_states, n_actions = mdp.n_states, mdp.n_actions
    if ends is None:
        p = mdp.transition
        origin = np.repeat(np.arange(n_states * n_actions) // n_actions, np.diff(p.indptr))
        leaves = np.bincount(origin, p.indices != origin, n_states)
        mask = np.asarray((leaves == 0) & (mdp.reward == 0).all(1))
        if not mask.any():
            allowed = (
                "given, as [S] true or false: no state of the model stays for ever without reward "
                '(of an environment: tabular_mdp(env, on_end="absorb"); of a log: its terminated column)'
            )
            raise InputError("ends", None, allowed)
        return mask
    mask = np.asarray(ends)
    if mask.shape != (n_states,) or mask.dtype != bool:
        raise InputError("ends", f"{mask.dtype} of shape {mask.shape}", f"true or false for each of {n_states} states")
    if not mask.any():
        raise InputError("ends", "false everywhere", "true in one state or more: without an end there is no first exit")
    return mask


@dataclass(frozen=True, eq=False)
class _Inside:
    """The states from which an end can be reached, and one more, the last, for all ends together."""

    problem: BellmanProblem  # of k + 1 states; prior 0 where an action may lead to where no end can be reached
    low: np.ndarray  # [k + 1, A], bounds on the rewards: they carry the prior that is left out
    high: np.ndarray
    members: np.ndarray  # [k], their places in the problem that was given
    names: np.ndarray  # [k], their numbers in the MDP
    trapped: np.ndarray  # places of the states from which no end can be reached

    @classmethod
    def of(cls, problem: BellmanProblem, ends: np.ndarray) -> _Inside:
        """Check 1. Raises InputError where no end can be reached from anywhere."""
        n, n_actions = problem.reward.shape
        p, has_prior = problem.transition, (problem.prior > 0).ravel()
        row = np.repeat(np.arange(n * n_actions), np.diff(p.indptr))
        good = ~ends
        while True:
            bad = np.bincount(row, ~(good | ends)[p.indices], n * n_actions) > 0
            usable = has_prior & ~bad & np.repeat(good, n_actions)
            edge = usable[row]
            back = sp.csr_array((np.ones(edge.sum(), np.int8), (p.indices[edge], row[edge] // n_actions)), shape=(n, n))
            reaches = reachable_from(back, ends.astype(np.float64)) & ~ends if ends.any() else np.zeros(n, bool)
            if (reaches == good).all():
                break
            good = reaches
        if not good.any() and not (problem.start[ends] > 0).any():
            raise InputError(
                "ends",
                problem.states[ends].tolist(),
                "reached, for certain, from some state that the start leads to, by actions with prior > 0",
            )
        members = np.flatnonzero(good)
        rows = (members[:, None] * n_actions + np.arange(n_actions)).ravel()
        into = chance_of(p[rows], ends)
        # A pair that is left out has an empty row.
        keep = sp.diags_array(usable[rows].astype(np.float64))
        inner = sp.csr_array(keep @ p[rows][:, members])
        inner.eliminate_zeros()
        transition = with_end(inner, np.where(usable[rows], into, 0.0), n_actions)
        prior = np.where(usable.reshape(n, n_actions)[members], problem.prior[members], 0.0)
        total = problem.prior[members].sum(1, keepdims=True)
        left = np.log(prior.sum(1, keepdims=True) / total) / problem.beta
        left[(prior == problem.prior[members]).all(1)] = 0.0
        reward = problem.reward[members] + left
        spoilt = (n_actions + 8) * EPSILON / problem.beta + 4 * EPSILON * np.abs(left) + EPSILON * np.abs(reward)
        spoilt = np.where(left != 0, spoilt, 0.0)
        reward, low, high = (np.vstack([x, np.zeros(n_actions)]) for x in (reward, reward - spoilt, reward + spoilt))
        prior = np.vstack([prior, np.full(n_actions, 1 / n_actions)])
        start = np.append(problem.start[members], problem.start[ends].sum())
        states = np.arange(len(members) + 1)
        own = BellmanProblem(states, transition, reward, prior, start, problem.beta)
        return cls(own, low, high, members, problem.states[members], np.flatnonzero(~good & ~ends))

    @property
    def k(self) -> int:
        return len(self.members)

    def gains(self, value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(low, high) [k] of TV - V, for ``value`` [k + 1]."""
        p = self.problem
        return (
            gains(p.transition, self.low, p.prior, p.beta, value).low[:-1],
            gains(p.transition, self.high, p.prior, p.beta, value).high[:-1],
        )

    def policy_gains(self, policy: np.ndarray, value: np.ndarray) -> np.ndarray:
        """Lower bounds [k] on T_pi V - V."""
        p = self.problem
        return policy_gains(p.transition, self.low, p.prior, p.beta, policy, value)[0][:-1]

    def evaluate(self, policy: np.ndarray) -> np.ndarray:
        """What ``policy`` [k + 1, A] is worth, [k + 1]. Raises SingularChainError where it may never end."""
        p = self.problem
        with np.errstate(divide="ignore", invalid="ignore"):
            kl = np.where(policy > 0, policy * np.log(policy * p.prior.sum(1, keepdims=True) / p.prior), 0.0).sum(1)
        once = (policy * p.reward).sum(1) - kl / p.beta
        once[-1] = 0.0
        return _finite(RegenerativeLU(p.chain(policy), self.k, elimination=p.elimination).poisson(once)[1])

    def newton(self, value: np.ndarray, more: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """(value [k + 1] of pi_V, its expected steps to the end), for rewards that are larger by ``more``.

        Raises SingularChainError.
        """
        p = self.problem
        backed_up, policy = soft_backup(p.action_value(value), p.prior, p.beta)
        lu = RegenerativeLU(p.chain(policy), self.k, elimination=p.elimination)
        residual = backed_up + more - value
        residual[-1] = 0.0
        new = _finite(value + lu.poisson(residual)[1])
        if np.abs(new).max() < 0.5 * np.abs(value).max():  # a difference of large numbers
            new = _finite(self.evaluate(policy) + more * lu.hitting_time)
        return new, lu.hitting_time


def _finite(value: np.ndarray) -> np.ndarray:
    if not np.isfinite(value).all():
        raise SingularChainError("a value beyond double precision")
    value[-1] = 0.0
    return value


class _Found(NamedTuple):
    """What the iteration came to; arrays [k]."""

    value: np.ndarray
    low: np.ndarray
    high: np.ndarray
    policy: np.ndarray  # [k, A]
    steps: np.ndarray
    steps_bound: np.ndarray
    gap: float
    n_steps: int
    status: Status
    message: str
    avoiding: list[Avoiding]
    solved: bool  # a certificate was found


def _solve(inside: _Inside, tol: float, max_steps: int) -> _Found:
    k, p = inside.k, inside.problem
    avoiding = end_components(p)
    value, steps, n_steps, failed = np.zeros(k + 1), np.full(k + 1, np.inf), 0, False
    try:
        # J never falls from here on, so no policy takes many more steps than the prior.
        value = inside.evaluate(p.prior / p.prior.sum(1, keepdims=True))
        best, since = (np.inf, value), 0
        while k and n_steps < max_steps and since < 3:
            value, _ = inside.newton(value)
            n_steps += 1
            low, high = inside.gains(value)
            left = float(max(high.max(), -low.min()))
            since = 0 if left < 0.5 * best[0] else since + 1
            best = min(best, (left, value), key=lambda one: one[0])
        # The steps that ``newton`` returns are those of the policy of the value before.
        value = best[1]
        steps = inside.newton(value)[1]
    except SingularChainError:
        failed = True
    certified = None if failed else _certificate(inside, value, steps)
    if certified is None and k:
        return _explained(inside, avoiding, n_steps, max_steps)
    low, high, bound = certified or (np.zeros(0), np.zeros(0), np.zeros(0))
    policy = soft_backup(p.action_value(value), p.prior, p.beta)[1]
    gap = _gap(inside, value, steps, policy, high)
    narrow = k == 0 or float((high - low).max()) <= tol * scale(p, value, policy)
    status = Status.CONVERGED if narrow else Status.STEP_LIMIT if n_steps >= max_steps else Status.STAGNATED
    return _Found(value[:k], low, high, policy[:k], steps[:k], bound, gap, n_steps, status, "", avoiding, True)


def _widths(inside: _Inside, value: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Sizes of d to try, ascending: from what is left of TV - V on."""
    low, high = inside.gains(value)
    least = max(float(high.max()), -float(low.min()), 0.0) + np.finfo(np.float64).tiny
    return np.asarray(2.0 * least * 4.0 ** np.arange(WIDENINGS))


def _certificate(
    inside: _Inside, value: np.ndarray, steps: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """(U, W, bound on the optimal policy's steps), [k] each; None where no W is found."""
    k = inside.k
    if k == 0 or not (np.isfinite(value).all() and np.isfinite(steps).all()):
        return None
    below, above, eps = None, None, 0.0
    for d in _widths(inside, value, steps):
        if below is None:
            lower = value - d * steps
            if inside.gains(lower)[0].min() >= 0:
                below = lower
        if above is None:
            above, eps = _above(inside, value, steps, d)
        if below is not None and above is not None:
            break
    if below is None or above is None:
        return None
    bound = _steps_bound(above[:k], below[:k], eps)
    # A wider W may say more about the steps.
    for share in (1e-2, 1e-4, 1e-6):
        wider, margin = _above(inside, value, steps, share / (inside.problem.beta * steps.max()), tries=1)
        if wider is not None:
            bound = np.minimum(bound, _steps_bound(wider[:k], below[:k], margin))
    return below[:k], above[:k], bound


def _above(
    inside: _Inside, value: np.ndarray, steps: np.ndarray, d: float, tries: int = 3
) -> tuple[np.ndarray | None, float]:
    """(W, eps) with TW <= W - eps, eps > 0; (None, 0) where V + d h, and the fixed point for rewards larger by d, have
    no such margin."""
    with np.errstate(over="ignore"):
        above = value + d * steps
    for again in range(tries):
        if not np.isfinite(above).all():
            break
        eps = -float(inside.gains(above)[1].max())
        if eps > 0:
            return above, eps
        if again + 1 < tries:
            try:
                above = inside.newton(above, more=d)[0]
            except SingularChainError:
                break
    return None, 0.0


def _steps_bound(above: np.ndarray, below: np.ndarray, eps: float) -> np.ndarray:
    """(W - U)/eps, rounded up; a step is taken in any case."""
    return np.asarray(np.maximum(up(up(up(above - below) / eps)), 1.0))


def _gap(inside: _Inside, value: np.ndarray, steps: np.ndarray, policy: np.ndarray, high: np.ndarray) -> float:
    """At least W - J(policy) in every state; the policy ends, as W shows."""
    if not inside.k:
        return 0.0
    for d in _widths(inside, value, steps):
        lower = value - d * steps
        if inside.policy_gains(policy, lower).min() >= 0:
            return float(np.nextafter((high - lower[:-1]).max(), np.inf))
    return np.inf


def _explained(inside: _Inside, avoiding: list[Avoiding], n_steps: int, max_steps: int) -> _Found:
    """No certificate: which way round it is that pays, or that rounding is in the way. No number is claimed."""
    k, p = inside.k, inside.problem
    paying = []
    for component in avoiding:
        low, high = _rate(p, component)
        if high >= 0:
            paying.append((component, low, high))
    infinite = np.zeros(k, bool)
    if paying:
        surely = [component for component, low, _ in paying if low > 0]
        if surely:
            back = sp.csr_array(state_graph(p.transition, p.n_actions).T)
            source = np.zeros(k + 1)
            source[np.concatenate([component.states for component in surely])] = 1.0
            infinite = reachable_from(back, source)[:k]
        status = Status.ILL_POSED if surely else Status.STAGNATED
        message = "; ".join(
            f"in {_some(inside, component.states)} {_round_actions(component)} never lead to an end, at a regularised "
            f"rate of {low:.6g} to {high:.6g}"
            for component, low, high in sorted(paying, key=lambda found: -found[1])[:3]
        )
        says = "pays more than" if surely else "may pay as much as, which rounding hides,"
        message += f": going on {says} ending (charge every step, or the failing end; or lower beta)"
    elif n_steps >= max_steps:
        status, message = Status.STEP_LIMIT, ""
    else:
        status, message = Status.STAGNATED, "no bound was found: some way round loses next to nothing"
    prior = p.prior[:k] / p.prior[:k].sum(1, keepdims=True)
    value = np.where(infinite, np.inf, np.nan)
    empty = np.full(k, np.inf)
    return _Found(
        value, np.where(infinite, np.inf, -np.inf), empty, prior, np.full(k, np.nan), empty, np.inf, n_steps, status,
        message, avoiding, False,
    )  # fmt: skip


def end_components(problem: BellmanProblem) -> list[Avoiding]:
    """The maximal sets of states, with actions of prior > 0 that surely stay among them and connect them, that do not
    hold the last state."""
    p, (n, n_actions) = problem.transition, problem.reward.shape
    row = np.repeat(np.arange(n * n_actions), np.diff(p.indptr))
    alive = (problem.prior > 0).ravel() & (np.diff(p.indptr) > 0)
    label = np.zeros(n, np.int64)
    label[-1] = 1
    while True:
        # Pairs that may leave their set, and states that have no pair left.
        left = np.bincount(row, label[p.indices] != label[row // n_actions], n * n_actions) > 0
        alive &= ~left
        alive.reshape(n, n_actions)[-1] = False
        used = alive[row]
        graph = sp.csr_array((np.ones(used.sum(), np.int8), (row[used] // n_actions, p.indices[used])), shape=(n, n))
        graph.sum_duplicates()
        new, _ = classes(graph)
        if len(np.unique(new)) == len(np.unique(label)):
            break
        label = new
    table = alive.reshape(n, n_actions)
    found = []
    for c in np.unique(label[table.any(1)]):
        states = np.flatnonzero((label == c) & table.any(1))
        found.append(Avoiding(states, table[states]))
    return found


def _rate(problem: BellmanProblem, component: Avoiding) -> tuple[float, float]:
    """Bounds on the largest rate of r - KL/beta of the policies that stay in ``component``, reward per step."""
    states, n_actions = component.states, problem.n_actions
    rows = (states[:, None] * n_actions + np.arange(n_actions)).ravel()
    stay = sp.diags_array(component.actions.ravel().astype(np.float64))
    transition = sp.csr_array(stay @ problem.transition[rows][:, states])
    transition.eliminate_zeros()
    prior = np.where(component.actions, problem.prior[states], 0.0)
    left = np.log(prior.sum(1, keepdims=True) / problem.prior[states].sum(1, keepdims=True)) / problem.beta
    reward = np.where(component.actions, problem.reward[states] + left, 0.0)
    k = len(states)
    own = BellmanProblem(np.arange(k), transition, reward, prior, np.full(k, 1 / k), problem.beta)
    bounds = [own.gains(np.zeros(k)).theta_bounds]
    bounds += [state.theta_bounds for state in iterate_soft_bellman(own, 0, 1e-9, 100)]
    slack = 8 * EPSILON * (n_actions / problem.beta + float(np.abs(left).max()))
    return -min(high for _, high in bounds) - slack, -max(low for low, _ in bounds) + slack


def _some(inside: _Inside, states: np.ndarray) -> str:
    return f"{inside.names[states[:NAMED]].tolist()}{'...' if len(states) > NAMED else ''}"


def _round_actions(component: Avoiding) -> str:
    used = np.flatnonzero(component.actions.any(0))
    return f"actions {used[:NAMED].tolist()}{'...' if len(used) > NAMED else ''}"


def _solution(
    mdp: TabularMDP, problem: BellmanProblem, inside: _Inside, found: _Found, ended: np.ndarray
) -> ExitSolution:
    members, n_states = inside.members, mdp.n_states
    states = problem.states[members]
    trapped = problem.states[inside.trapped]
    message = found.message
    if trapped.size:
        named = f"{trapped[:NAMED].tolist()}{'...' if trapped.size > NAMED else ''}"
        message = "; ".join(filter(None, [message, f"no end can be reached from states {named}: their value is -inf"]))
    solved = np.zeros(n_states, bool)
    solved[states] = found.solved

    def spread(table: np.ndarray, elsewhere: float) -> np.ndarray:
        full = np.full((n_states, *table.shape[1:]), elsewhere)
        full[states] = table
        full[trapped] = -np.inf
        full[ended] = 0.0
        return full

    value, low, high = (spread(x, 0.0) for x in (found.value, found.low, found.high))
    steps, bound = (np.abs(spread(x, 0.0)) for x in (found.steps, found.steps_bound))
    prior = mdp.uniform_policy
    prior[problem.states] = problem.prior
    policy = prior.copy()
    policy[states] = found.policy
    with np.errstate(invalid="ignore"):
        q = problem.action_value(value[problem.states])[members]
    q = np.where(inside.problem.prior[:-1] > 0, q, -np.inf)
    return ExitSolution(
        policy=torch.from_numpy(policy),
        value=torch.from_numpy(value),
        action_value=torch.from_numpy(spread(q, 0.0)),
        value_low=torch.from_numpy(low),
        value_high=torch.from_numpy(high),
        start_bounds=start_bounds(mdp.start, low, high),
        gap=found.gap,
        beta=problem.beta,
        n_steps=found.n_steps,
        status=found.status,
        message=message,
        ends=torch.from_numpy(ended.copy()),
        solved=torch.from_numpy(solved),
        steps=torch.from_numpy(steps),
        steps_bound=torch.from_numpy(bound),
        avoiding=tuple(Avoiding(states[component.states], component.actions) for component in found.avoiding),
    )
