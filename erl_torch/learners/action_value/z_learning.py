r"""Z-learning: the optimistic problem in states alone (Todorov, "Efficient computation of optimal actions", PNAS 2009).

The desirability z(s) = sum_a pi0(a|s) u(s,a) solves rho z(s) = E exp(beta r(s,a)) z(s'), with a ~ pi0: the passive
dynamics is the chain of the prior. In logarithms, v = log(z)/beta, g = log(rho)/beta, step n(s)**-power:

    v(s) += log(1 - a_n + a_n exp(beta (r - g + v(s') - v(s)))) / beta

This is U-learning of the process with one action a state, and runs in the same compiled loop.

Where it applies. The stream must come from the prior policy: z averages over its actions as they come (the other
learners need only support). Todorov's optimal *dynamics*, p0 z(s')/<z>, is one that actions can make where each
action leads to one state; with stochastic dynamics z is optimistic, as U-learning is: optimism 1 of the dial.

The policy, for an MDP with actions: pi(a|s) ~ pi0(a|s) u(s,a), u(s,a) = the mean of exp(beta (r - g)) z(s') over the
visits of (s,a) in the stream (one more table, made after each pass, not learnt from).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import torch

from erl_torch.learners.action_value.q_learning import ActionValueState, ActionValueStream, _Average


@dataclass(frozen=True, eq=False)
class ZState(ActionValueState):
    """``q`` is the read-out log(u)/beta."""

    value: torch.Tensor  # v, [S], reward
    state_visits: torch.Tensor  # [S] int64


@dataclass(frozen=True, eq=False)
class ZLearning(_Average):
    """Z-learning, for streams from the prior policy; see the module's docstring.

    Objective: that of U-learning, optimism 1 of the dial, where the dynamics too are at the learner's choice, at the
    price of their KL. Optimistic in stochastic dynamics; where every action leads to one state, the package's
    own objective.

    Args:
        lr_rate: step size of rho relative to that of z, in (0, 1]; None is 1 / S.
        beta, power, n_epochs, prior_policy: as for all (``ActionValueLearner``); the steps are n(s)**-power.
    """

    exponential: ClassVar[bool] = True
    assumed_optimism: ClassVar[float | None] = 1.0
    drawn_from_prior: ClassVar[str] = "a"
    states: ClassVar[tuple[type, ...]] = (ZState,)

    def init(self, n_states: int, n_actions: int) -> ZState:
        start = super().init(n_states, n_actions)
        return ZState(
            **vars(start),
            value=torch.zeros(n_states, dtype=torch.float64),
            state_visits=torch.zeros(n_states, dtype=torch.int64),
        )

    def step(self, state: ActionValueState, stream: ActionValueStream) -> ZState:
        """One pass over the stream, and the read-out. Raises NonFiniteError."""
        assert isinstance(state, ZState)
        value, visits = state.value.clone(), state.state_visits.clone()
        column, visits_column = value.numpy()[:, None], visits.numpy()[:, None]
        rate = self._pass(stream, np.ones_like(column), column, visits_column, state.rate or 0.0, of_states=True)
        self._check(value, rate, state, stream)
        q, counts = _read_out(stream, value.numpy(), rate, self.beta, state.q.shape)
        return replace(
            state,
            epoch=state.epoch + 1,
            n_tuples=state.n_tuples + len(stream.data),
            q=q,
            visits=counts,
            rate=rate,
            value=value,
            state_visits=visits,
        )


def _read_out(
    stream: ActionValueStream, value: np.ndarray, rate: float, beta: float, shape: torch.Size
) -> tuple[torch.Tensor, torch.Tensor]:
    """(log(mean of exp(beta (r - g + v(s'))))/beta, visits) of every pair, [S, A]; 0 without visits."""
    counts = np.zeros(shape.numel(), np.int64)
    top, total = np.full(shape.numel(), -np.inf), np.zeros(shape.numel())
    for _, pair, s_next, r in stream.parts:
        counts += np.bincount(pair, minlength=shape.numel())
        np.maximum.at(top, pair, r - rate + value[s_next])
    top[counts == 0] = 0.0
    for _, pair, s_next, r in stream.parts:
        np.add.at(total, pair, np.exp(beta * (r - rate + value[s_next] - top[pair])))
    mean = np.divide(total, counts, out=np.ones_like(total), where=counts > 0)
    return torch.from_numpy(top + np.log(mean) / beta).reshape(shape), torch.from_numpy(counts).reshape(shape)
