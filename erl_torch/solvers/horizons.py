"""Newton's method with a growing horizon, for the soft Bellman backup T and for that of one policy, T_pi.

Both are monotone and commute with constants, and the derivative of either is a chain, K = sum_a pi q_V (``problem.py``;
q_V is p at optimism 0). So Newton's step is one Poisson equation of that chain. Far from the solution it may have sets
that are all but closed, which double precision cannot tell from closed ones. So the horizon is short first, and grows.
With lambda = 1 - 1/horizon

    V + g = T(lambda V),    V(ref) = 0

is the discounted problem in relative form, where Newton's matrix I - lambda K is well conditioned whatever the chain.
Each horizon starts from the value of the one before. Every V also carries a certificate of the undiscounted problem.
As soon as that shows that the solution is near, undiscounted steps finish; where they fail, the horizon grows on.

T is convex from optimism 0 up, T_pi is convex there and concave below: Newton's steps are policy iteration, of the
agent or of the dynamics, and need no care. T below 0 is neither. A step counts there where the residual falls, if need
be the half, quarter or eighth of it; else the policy is evaluated to the end and improved (Hoffman and Karp), under
which its value never falls.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from erl_torch.solvers.certificates import policy_gains, soft_backup
from erl_torch.solvers.chains import EPSILON, RegenerativeLU, SingularChainError
from erl_torch.solvers.problem import BellmanProblem

FIRST_HORIZON = 300.0  # steps
GROWTH = 100.0
LAST_HORIZON = 1e13
FIRST_RESIDUAL = 0.1  # relative to the reward range, at which the horizon grows; lower after each undiscounted try
UNDISCOUNTED_WIDTH = 0.3  # of the undiscounted bounds, relative to the reward range, at which discounting may end
SHARES = 1.0, 0.5, 0.25, 0.125  # of a step, tried in turn
ROUNDING = 16  # of a residual, in units of the value's last place
NEAR_ROUNDING = 1e5  # the same, from where on PATIENCE counts
PATIENCE = 8  # steps in which the residual does not halve
EVALUATION_STEPS = 30
EVALUATION_RESIDUAL = 1e-3  # of a policy's value, relative to the residual of T


@dataclass(frozen=True, eq=False)
class BellmanState:
    """A value and the bounds that it proves."""

    step: int  # linear systems solved
    horizon: float  # infinite once undiscounted
    value: np.ndarray  # [n], reward
    gain: np.ndarray  # TV - V, [n]
    policy: np.ndarray  # pi_V, [n, A]
    theta_bounds: tuple[float, float]  # on theta* of the undiscounted problem, by this value alone

    @property
    def width(self) -> float:
        return self.theta_bounds[1] - self.theta_bounds[0]


@dataclass(frozen=True, eq=False)
class Backup:
    """T of a problem, or T_pi of one policy."""

    problem: BellmanProblem
    policy: np.ndarray | None = None  # [n, A]; None: T

    @cached_property
    def _cost(self) -> np.ndarray:
        """KL(pi || prior)/beta, [n]."""
        policy, prior = self.policy, self.problem.prior
        assert policy is not None
        used = policy > 0
        terms = np.zeros(policy.shape)
        terms[used] = policy[used] * (np.log(policy[used]) - np.log(prior[used]))
        return np.asarray(terms.sum(1) / self.problem.beta)

    @property
    def is_convex(self) -> bool:
        """Or concave: Newton's steps then need no care."""
        return self.policy is not None or self.problem.kappa >= 0

    def __call__(self, value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(TV [n], the policy that attains it [n, A]) of ``value`` [n]."""
        q = self.problem.action_value(value)
        if self.policy is None:
            return soft_backup(q, self.problem.prior, self.problem.beta)
        return (self.policy * q).sum(1) - self._cost, self.policy

    def state(self, value: np.ndarray, step: int, horizon: float) -> BellmanState:
        """``value`` with its certificate."""
        p = self.problem
        if self.policy is None:
            gains = p.gains(value)
            return BellmanState(step, horizon, value, gains.gain, gains.policy, gains.theta_bounds)
        low, high = policy_gains(p.transition, p.reward, p.prior, p.beta, self.policy, value, p.kappa)
        bounds = -float(high.max()), -float(low.min())
        return BellmanState(step, horizon, value, 0.5 * (low + high), self.policy, bounds)


def iterate(backup: Backup, ref: int, done: Callable[[BellmanState], bool], max_steps: int) -> Iterator[BellmanState]:
    """Yield a state after each Newton step, until one is ``done`` or progress ends."""
    problem = backup.problem
    state = backup.state(np.zeros(problem.n_states), 0, 0.0)
    yield state
    horizon, residual, home = FIRST_HORIZON, FIRST_RESIDUAL, ref
    while not done(state) and state.step < max_steps and horizon <= LAST_HORIZON:
        discount = 1 - 1 / horizon
        step = _Step(backup, home, discount)
        for once in range(50):
            backed_up, policy = backup(discount * state.value)
            error = backed_up - state.value
            enough = residual * problem.reward_range
            if state.step >= max_steps or (once and np.ptp(error) <= enough) or step.is_lost(state.value, error):
                break
            lu = step.factors(state.value, policy)
            value, steps = step.next(state.value, error, policy, lu)
            state = backup.state(value, state.step + steps, horizon)
            # Within the horizon the process spends most time here: it comes back to this state.
            ref = int(np.argmax(lu.stationary()))
            yield state
            if done(state):
                return
        if state.width < UNDISCOUNTED_WIDTH * problem.reward_range or horizon > 1e6:
            best, steps = state, state.step
            for new in undiscounted(backup, state, ref, done, max_steps):
                yield new
                steps = new.step
                best = new if new.width < best.width else best
            state = replace(best, step=steps)
            residual *= 0.1
        horizon *= GROWTH


@dataclass(eq=False)
class _Step:
    """Newton's steps of one horizon; where those of T fail below optimism 0, Hoffman's and Karp's from there on."""

    backup: Backup
    home: int
    discount: float
    evaluates: bool = False
    least: float = np.inf  # residual
    patience: int = PATIENCE

    def is_lost(self, value: np.ndarray, error: np.ndarray) -> bool:
        """Whether rounding alone is left, of values that a long horizon makes large; never at optimism 0."""
        if not self.backup.problem.kappa:
            return False
        spread, place = float(np.ptp(error)), EPSILON * float(np.abs(value).max())
        self.patience -= spread <= NEAR_ROUNDING * place
        if spread <= 0.5 * self.least:
            self.patience = PATIENCE
        self.least = min(self.least, spread)
        return self.patience <= 0 or spread <= ROUNDING * place

    def factors(self, value: np.ndarray, policy: np.ndarray) -> RegenerativeLU:
        problem = self.backup.problem
        chain = problem.chain(policy, problem.tilted(self.discount * value))
        return RegenerativeLU(chain, self.home, self.discount, problem.elimination)

    def next(
        self, value: np.ndarray, error: np.ndarray, policy: np.ndarray, lu: RegenerativeLU
    ) -> tuple[np.ndarray, int]:
        """(the next value, linear systems solved for it)."""
        move = lu.poisson(error, refine=False)[1]
        if self.backup.is_convex:
            return value + move, 1
        if not self.evaluates:
            spread = np.ptp(error)
            for share in SHARES:
                tried = value + share * move
                if np.ptp(self.backup(self.discount * tried)[0] - tried) <= (1 - 0.1 * share) * spread:
                    return tried, 1
            self.evaluates = True
        return self._evaluate(value, value + move, policy, float(np.ptp(error)))

    def _evaluate(
        self, value: np.ndarray, first: np.ndarray, policy: np.ndarray, spread: float
    ) -> tuple[np.ndarray, int]:
        """(the value of ``policy`` within the horizon, linear systems solved); ``first``: after one step already."""
        own = Backup(self.backup.problem, policy)
        of_policy = replace(self, backup=own)
        value, before, steps = first, np.inf, 1
        while steps < EVALUATION_STEPS:
            error = own(self.discount * value)[0] - value
            residual = float(np.ptp(error))
            if residual <= EVALUATION_RESIDUAL * spread or residual >= before:
                break
            before = residual
            value = value + of_policy.factors(value, policy).poisson(error, refine=False)[1]
            steps += 1
        return value, steps


def undiscounted(
    backup: Backup, state: BellmanState, ref: int, done: Callable[[BellmanState], bool], max_steps: int
) -> Iterator[BellmanState]:
    """Newton steps from ``state`` until its bounds are ``done``, or have not halved in three steps."""
    problem = backup.problem
    widths = [state.width]
    lu: RegenerativeLU | None = None
    while not done(state) and state.step < max_steps:
        if len(widths) > 3 and min(widths[-3:]) > 0.5 * min(widths[:-3]):
            return
        new = _newton(backup, state, lu) if lu else None
        # Keep the factors of an earlier step while they still gain two digits.
        if new is None or not new.width < 0.01 * state.width:
            try:
                lu = problem.regeneration(state.policy, ref, problem.tilted(state.value))
            except SingularChainError:
                return
            ref = lu.ref
            new = _newton(backup, state, lu)
        if not np.isfinite(new.width):
            return
        state = new
        widths.append(state.width)
        yield state


def _newton(backup: Backup, state: BellmanState, lu: RegenerativeLU) -> BellmanState:
    """The state after one step; where T is neither convex nor concave, after the part of it that narrows the bounds."""
    move = lu.poisson(state.gain)[1]
    for share in SHARES[:1] if backup.is_convex else SHARES:
        value = state.value + share * move
        new = backup.state(value - value[lu.ref], state.step + 1, np.inf)
        if new.width < state.width:
            break
    return new
