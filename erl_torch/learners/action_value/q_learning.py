r"""Q-learning and its kin, on a recorded stream of tuples: the baselines of Algorithm S1.

One update for all of them, with the step a_n = n(s,a)**-power, n(s,a) the visits of the pair so far (all passes):

    q(s,a) += a_n (r - g + discount V(s') - q(s,a))
    soft      V(s) = (1/beta) log sum_a pi0(a|s) exp(beta q(s,a))
    greedy    V(s) = max_a q(s,a)
    on-policy V(s) = sum_a pi(a|s) q(s,a)
    policy    pi(a|s) ~ pi0(a|s) exp(beta q(s,a))                           of all, the Boltzmann policy

    learner          V          discount  g                                objective of its fixed point
    ---------------  ---------  --------  -------------------------------  --------------------------------------------
    differential     soft       1         g += lr_rate a_n (td after)      average reward - KL(pi || pi0) / beta
    RVI              soft       1         V(reference)                     the same
    U-learning       soft       1         averages exp(beta q) instead     the same at optimism 1: control as inference
    soft Q           soft       < 1       0                                discounted sum of r - KL(pi || pi0) / beta
    Q                greedy     < 1       0                                discounted sum of r
    SARSA            on-policy  < 1       0                                discounted sum of r under its own pi

The first two solve the problem of this package, V + g = (1/beta) log sum_a pi0 exp(beta (r + E V)), g = -theta*.

``lr_rate`` multiplies the error that is left after the update of q, as line 11 of Algorithm S1 reads the new u: the
first visit of a pair (a_n = 1) then moves q all the way and g not at all.

a' of the stream is not used, and any behaviour policy with support will do. Where an action has never been taken in
a state, V is that of the others, and the action keeps its prior share in the policy. Where the prior is 0 the state
does not have the action: tuples that take it are left out.

Steps need 1/2 < power <= 1 to converge; near 1 they forget too slowly what early values got wrong.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import torch

from erl_torch import checks
from erl_torch.checks import InputError
from erl_torch.experience.experience import Experience, Parts
from erl_torch.experience.transitions import Transitions
from erl_torch.learners.action_value import kernels
from erl_torch.learners.learner import NonFiniteError, StreamLearner, columns, message
from erl_torch.mdp.tabular import check_prior
from erl_torch.solution import Solution

BLOCK = 1 << 22  # tuples a compiled call, so that signals are served several times a second
LARGEST = 1e300  # of beta |q|: differences must stay finite
SOFT, GREEDY, ON_POLICY = 0, 1, 2  # backups, as the kernel has them


@dataclass(frozen=True, eq=False)
class ActionValueState:
    """What a learner of action values knows after a pass; a value, never changed in place."""

    epoch: int
    n_tuples: int
    beta: float
    prior_policy: torch.Tensor  # [S, A]
    q: torch.Tensor  # [S, A], reward
    visits: torch.Tensor  # [S, A] int64
    rate: float | None  # g, reward a step; None where none is estimated

    reward_bias: ClassVar[None] = None

    @property
    def action_value(self) -> torch.Tensor:
        """q where visited; elsewhere the soft value of the state's visited actions, or 0 if it has none; -inf where the
        prior is 0: [S, A]."""
        there = self.prior_policy > 0
        seen = (self.visits > 0) & there
        logits = torch.where(seen, self.beta * self.q + self.prior_policy.log(), -torch.inf)
        mass = (self.prior_policy * seen).sum(1).log()
        value = torch.where(seen.any(1), (logits.logsumexp(1) - mass) / self.beta, 0.0)
        return torch.where(there, torch.where(seen, self.q, value[:, None]), -torch.inf)

    @property
    def policy(self) -> torch.Tensor:
        """[S, A]: prior exp(beta q), normalised."""
        return torch.softmax(self.beta * self.action_value + self.prior_policy.log(), 1)

    @property
    def theta(self) -> float | None:
        """-g, reward a step; None for a discounted learner, which estimates none."""
        return None if self.rate is None else -self.rate

    def metrics(self) -> dict[str, float]:
        """The scalars that are logged; no theta where there is none."""
        known = {} if self.theta is None else {"theta": self.theta}
        q = self.q[self.prior_policy > 0]
        return known | {
            "q_min": float(q.min()),
            "q_max": float(q.max()),
            "epoch": self.epoch,
            "n_tuples": self.n_tuples,
        }


@dataclass(frozen=True, eq=False)
class ActionValueStream:
    """A stream as the compiled loop takes it."""

    data: Experience
    parts: Parts[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]  # s, s * A + a, s' and r, a chunk each
    reference: int  # state that is visited most


@dataclass(frozen=True, eq=False)
class ActionValueLearner(StreamLearner[ActionValueState, ActionValueStream]):
    """What the learners of action values share; see the module's docstring.

    Args:
        beta: inverse temperature, 1/reward, > 0.
        power: of the step n(s,a)**-power, in (1/2, 1].
        n_epochs: passes over the stream; the clocks run on.
        prior_policy: [S, A], rows sum to 1, 0 where a state does not have the action; None is uniform.

    Raises:
        InputError: an argument out of its range.
    """

    states: ClassVar[tuple[type, ...]] = (ActionValueState,)
    stream_bytes: ClassVar[int] = 28  # columns, pairs

    beta: float = 10.0
    power: float = 0.6
    n_epochs: int = 15
    prior_policy: torch.Tensor | np.ndarray | None = None

    backup: ClassVar[int] = SOFT
    exponential: ClassVar[bool] = False

    @property
    def averages_exp_reward(self) -> bool:
        return self.exponential

    def __post_init__(self) -> None:
        checks.plain(self)
        checks.temperature("beta", self.beta)
        if not (checks.is_number(self.power) and 0.5 < self.power <= 1):
            raise InputError("power", self.power, "a number in (0.5, 1]")
        checks.at_least("n_epochs", self.n_epochs, 1)

    def finished(self, state: ActionValueState) -> bool:
        """After the last pass."""
        return state.epoch == self.n_epochs

    @property
    def passes(self) -> int:
        """n_epochs."""
        return self.n_epochs

    def solution(
        self,
        state: ActionValueState,
        history: Sequence[Mapping[str, float]] = (),
        failure: BaseException | None = None,
    ) -> Solution:
        """The solution that ``state`` stands for."""
        return Solution.of_action_values(
            state.action_value,
            state.prior_policy,
            self.beta,
            state.theta,
            n_steps=state.n_tuples,
            status=self.ended(state, failure),
            message=message(failure),
            history=columns(history),
        )

    def init(self, n_states: int, n_actions: int) -> ActionValueState:
        """The state before any tuple: q = 0, the prior policy."""
        prior = check_prior("prior_policy", self.prior_policy, n_states, n_actions)
        return ActionValueState(
            epoch=0,
            n_tuples=0,
            beta=self.beta,
            prior_policy=torch.from_numpy(prior),
            q=torch.zeros(n_states, n_actions, dtype=torch.float64),
            visits=torch.zeros(n_states, n_actions, dtype=torch.int64),
            rate=0.0 if self._discount == 1.0 else None,
        )

    def prepare(self, transitions: Experience, n_states: int, n_actions: int) -> ActionValueStream:
        """Validate the stream against the sizes."""
        transitions.check_range(n_states, n_actions)
        if n_states * n_actions > np.iinfo(np.int32).max:
            raise InputError("n_states * n_actions", n_states * n_actions, "below 2**31")
        visits = np.zeros(n_states, np.int64)
        for chunk in transitions.chunks():
            visits += np.bincount(chunk.s, minlength=n_states)

        def part(chunk: Transitions) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
            return chunk.s, chunk.s * np.int32(n_actions) + chunk.a, chunk.s_next, chunk.r

        return ActionValueStream(transitions, Parts(transitions, part), int(np.argmax(visits)))

    def step(self, state: ActionValueState, stream: ActionValueStream) -> ActionValueState:
        """One pass over the stream. Raises NonFiniteError."""
        q, visits = state.q.clone(), state.visits.clone()
        rate = self._pass(stream, state.prior_policy.numpy(), q.numpy(), visits.numpy(), state.rate or 0.0)
        self._check(q, rate, state, stream)
        return replace(
            state,
            epoch=state.epoch + 1,
            n_tuples=state.n_tuples + len(stream.data),
            q=q,
            visits=visits,
            rate=None if state.rate is None else rate,
        )

    # -- its parts ------------------------------------------------------------------------------------

    @property
    def _discount(self) -> float:
        return 1.0

    def _rate(self, stream: ActionValueStream, n_pairs: int) -> tuple[float, int]:
        """(lr_rate, reference state or -1), as the kernel takes them."""
        return 0.0, -1

    def _pass(
        self,
        stream: ActionValueStream,
        prior: np.ndarray,  # [S, A]
        q: np.ndarray,  # [S, A], changes in place
        visits: np.ndarray,  # [S, A], changes in place
        rate: float,
        of_states: bool = False,  # tables of states, [S, 1]
    ) -> float:
        lr_rate, reference = self._rate(stream, q.size)
        settings = (
            prior.ravel(),
            q.shape[1],
            float(self.beta),
            self._discount,
            self.backup,
            self.exponential,
            float(self.power),
            lr_rate,
            reference,
            q.reshape(-1),
            visits.reshape(-1),
        )
        for s, pair, s_next, r in stream.parts:
            for begin in range(0, len(s), BLOCK):
                part = slice(begin, begin + BLOCK)
                here = s[part] if of_states else pair[part]
                rate = kernels.action_value_epoch(here, s_next[part], r[part], *settings, rate)
        return rate

    def _check(self, table: torch.Tensor, rate: float, before: ActionValueState, stream: ActionValueStream) -> None:
        largest = self.beta * max(float(table.abs().max()), abs(rate))
        if not largest < LARGEST:  # also on NaN
            raise NonFiniteError(
                before.n_tuples + len(stream.data),
                f"beta * q or beta * rate overflows at beta={self.beta:g}: scale the rewards down",
            )


@dataclass(frozen=True, eq=False)
class _Average(ActionValueLearner):
    lr_rate: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.lr_rate is not None:
            checks.step_size("lr_rate", self.lr_rate)

    def _rate(self, stream: ActionValueStream, n_pairs: int) -> tuple[float, int]:
        return (1 / n_pairs if self.lr_rate is None else self.lr_rate), -1


@dataclass(frozen=True, eq=False)
class DifferentialSoftQ(_Average):
    """Differential (average-reward) soft Q-learning with KL to the prior.

    Objective: the package's own, reward rate - KL(pi || pi0)/beta. Not optimistic: E V enters linearly.
    After Wan, Naik, Sutton, "Learning and planning in average-reward Markov decision processes", ICML 2021, with
    the soft backup.

    Args:
        lr_rate: step size of g relative to that of q, in (0, 1]; None is 1 / (S A).
        beta, power, n_epochs, prior_policy: as for all (``ActionValueLearner``).
    """


@dataclass(frozen=True, eq=False)
class RVISoftQ(ActionValueLearner):
    """Relative value iteration by soft Q-learning: g is V at a reference state.

    Objective: the package's own, reward rate - KL(pi || pi0)/beta. Not optimistic.
    After Abounadi, Bertsekas, Borkar, "Learning algorithms for Markov decision processes with average cost",
    SIAM J. Control Optim. 40 (2001), with the soft backup.

    Args:
        reference: the reference state; None is the one that the stream visits most. A rare one makes g lag behind,
            and with it every value.
        beta, power, n_epochs, prior_policy: as for all (``ActionValueLearner``).
    """

    reference: int | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.reference is not None:
            checks.at_least("reference", self.reference, 0)

    def init(self, n_states: int, n_actions: int) -> ActionValueState:
        if self.reference is not None and self.reference >= n_states:
            raise InputError("reference", self.reference, f"a state below {n_states}")
        return super().init(n_states, n_actions)

    def _rate(self, stream: ActionValueStream, n_pairs: int) -> tuple[float, int]:
        return 0.0, stream.reference if self.reference is None else self.reference


@dataclass(frozen=True, eq=False)
class ULearning(_Average):
    """U-learning: the optimistic problem, optimism 1 of the dial, as biasing iteration 0 of Algorithm S1 poses it.

    ``AlgorithmS1(optimism=1)`` solves the same problem, by the listing's updates: b = 1 and delta = 0.

    Objective: reward rate - KL/beta where the *dynamics* too are at the learner's choice, at the price of their KL.
    Optimistic in stochastic dynamics, and only there: it averages u = exp(beta q), so that
    u rho = exp(beta r) E sum_a' pi0 u(s',a'). Here in logarithms, q += log(1 - a_n + a_n exp(beta td)) / beta (safe
    at any beta), with the expected backup in place of a sampled a', and g = log(rho)/beta likewise.

    Args:
        lr_rate: step size of rho relative to that of u, in (0, 1]; None is 1 / (S A).
        beta, power, n_epochs, prior_policy: as for all (``ActionValueLearner``).
    """

    exponential: ClassVar[bool] = True
    assumed_optimism: ClassVar[float | None] = 1.0


@dataclass(frozen=True, eq=False)
class _Discounted(ActionValueLearner):
    discount: float = 0.9

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (checks.is_number(self.discount) and 0 <= self.discount < 1):
            raise InputError("discount", self.discount, "a number in [0, 1)")

    @property
    def _discount(self) -> float:
        return float(self.discount)


@dataclass(frozen=True, eq=False)
class SoftQ(_Discounted):
    """Soft Q-learning, discounted.

    Objective: the discounted sum of r - KL(pi || pi0)/beta; not optimistic. No estimate of theta.
    As discount goes to 1 its fixed point's policy goes to the package's own, and learning takes 1/(1 - discount)
    times as long.

    Args:
        discount: in [0, 1).
        beta, power, n_epochs, prior_policy: as for all (``ActionValueLearner``).
    """


@dataclass(frozen=True, eq=False)
class QLearning(_Discounted):
    """Q-learning (Watkins), read out as a Boltzmann policy.

    Objective of q: the discounted sum of r, without any KL; not optimistic (but for the bias of a maximum over
    noisy values). The policy, prior exp(beta q), is not that of q's objective and approaches the greedy one as beta
    grows. No estimate of theta.

    Args:
        discount: in [0, 1).
        beta, power, n_epochs, prior_policy: as for all (``ActionValueLearner``).
    """

    backup: ClassVar[int] = GREEDY


@dataclass(frozen=True, eq=False)
class Sarsa(_Discounted):
    """Expected SARSA of the Boltzmann policy (van Seijen et al., 2009).

    Objective of q: the discounted sum of r under its own policy pi ~ prior exp(beta q), without any KL; not
    optimistic. A fixed stream holds no a' of the changing policy, so its expectation is taken: SARSA without the
    noise. The operator is no contraction at large beta, where several fixed points may exist. No estimate of theta.

    Args:
        discount: in [0, 1).
        beta, power, n_epochs, prior_policy: as for all (``ActionValueLearner``).
    """

    backup: ClassVar[int] = ON_POLICY
