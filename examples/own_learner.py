"""A learner of your own: with five methods, runs, replicas and certificates work. This is soft value iteration."""

from dataclasses import dataclass
from typing import ClassVar

import torch

import erl_torch
from erl_torch.envs.windy_cliff import WindyCliffEnv


@dataclass(frozen=True)
class SweepState:
    epoch: int
    n_tuples: int
    theta: float  # reward a step
    value: torch.Tensor  # [S]
    q: torch.Tensor  # [S, A], r + E V
    policy: torch.Tensor  # [S, A]
    reward_bias: ClassVar[None] = None  # it has none

    def metrics(self):
        return {"theta": self.theta, "epoch": self.epoch, "n_tuples": self.n_tuples}


@dataclass(frozen=True)
class SoftValueIteration(erl_torch.StreamLearner):
    states: ClassVar = (SweepState,)  # what a checkpoint may hold
    beta: float = 10.0
    n_epochs: int = 400
    prior_policy: None = None  # uniform

    def init(self, n_states, n_actions):
        q = torch.zeros(n_states, n_actions).double()
        return SweepState(0, 0, 0.0, q[:, 0], q, q.softmax(1))

    def prepare(self, transitions, n_states, n_actions):
        return erl_torch.empirical_mdp(transitions, n_states, n_actions)

    def step(self, state, model):
        q = torch.from_numpy(model.reward + (model.transition @ state.value.numpy()).reshape(model.reward.shape))
        backed_up = (self.beta * q).exp().mean(1).log() / self.beta  # TV of docs/theory.md
        theta = float(state.value[0] - backed_up[0])
        value = (state.value + backed_up + theta) / 2  # lazy: no period can catch it
        n, policy = state.n_tuples + int(model.visits.sum()), (self.beta * q).softmax(1)
        return SweepState(state.epoch + 1, n, theta, value, q, policy)

    def finished(self, state):
        return state.epoch == self.n_epochs

    def solution(self, state, history=(), failure=None):
        end = {"n_steps": state.n_tuples, "status": self.ended(state, failure)}
        prior = torch.ones_like(state.q).softmax(1)
        return erl_torch.Solution.of_action_values(state.q, prior, self.beta, state.theta, **end)


mdp = WindyCliffEnv().mdp
tuples = erl_torch.collect(mdp, n_episodes=200, episode_length=1000, seed=0)
learnt = SoftValueIteration().fit(tuples, 15, 4)
gap = erl_torch.certify(learnt, mdp, 10.0).gap
print(f"tuples {len(tuples):,}\ntheta {learnt.theta:.5f}\ngap {gap:.1e}")
