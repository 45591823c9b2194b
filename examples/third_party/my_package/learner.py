"""A learner: damped soft value iteration on the counts of the stream."""

from dataclasses import dataclass
from typing import ClassVar

import torch

import erl_torch


@dataclass(frozen=True)
class SweepsState:
    """After ``epoch`` sweeps."""

    epoch: int
    n_tuples: int
    theta: float  # reward a step
    value: torch.Tensor  # [S]
    q: torch.Tensor  # [S, A], r + E V
    beta: float
    reward_bias: ClassVar[None] = None  # it has none

    @property
    def policy(self):
        return (self.beta * self.q).softmax(1)  # of the uniform prior

    def metrics(self):
        return {"theta": self.theta, "epoch": self.epoch, "n_tuples": self.n_tuples}


@dataclass(frozen=True)
class Sweeps(erl_torch.StreamLearner):
    """Its settings are its fields: learner.beta, learner.rate, learner.n_epochs."""

    beta: float = 10.0
    rate: float = 0.5  # step size, in (0, 1]
    n_epochs: int = 400
    prior_policy: None = None  # uniform

    states: ClassVar = (SweepsState,)  # what a checkpoint may hold

    def __post_init__(self):
        if not 0 < self.rate <= 1:
            raise erl_torch.InputError("rate", self.rate, "a number in (0, 1]")

    def init(self, n_states, n_actions):
        nothing = torch.zeros(n_states, n_actions, dtype=torch.float64)
        return SweepsState(0, 0, 0.0, nothing[:, 0], nothing, self.beta)

    def prepare(self, experience, n_states, n_actions):
        return erl_torch.empirical_mdp(experience, n_states, n_actions)

    def step(self, state, model):
        q = torch.from_numpy(model.reward + (model.transition @ state.value.numpy()).reshape(model.reward.shape))
        backed_up = (self.beta * q).exp().mean(1).log() / self.beta
        theta = float(state.value[0] - backed_up[0])
        value = state.value + self.rate * (backed_up + theta - state.value)
        return SweepsState(state.epoch + 1, state.n_tuples + int(model.visits.sum()), theta, value, q, self.beta)

    def finished(self, state):
        return state.epoch == self.n_epochs

    def solution(self, state, history=(), failure=None):
        prior = torch.ones_like(state.q).softmax(1)
        end = dict(n_steps=state.n_tuples, status=self.ended(state, failure))
        return erl_torch.Solution.of_action_values(state.q, prior, self.beta, state.theta, **end)
