"""A learner of your own: with five methods, the loops, runs, replicas and certificates work. This is soft value
iteration on the counts of the stream."""

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
    beta: float
    reward_bias: ClassVar[None] = None  # it has none

    @property
    def policy(self):  # of a uniform prior
        return (self.beta * self.q).softmax(1)

    def metrics(self):
        return {"theta": self.theta, "epoch": self.epoch, "n_tuples": self.n_tuples}


@dataclass(frozen=True)
class SoftValueIteration(erl_torch.StreamLearner):
    states: ClassVar = (SweepState,)  # what a checkpoint may hold
    beta: float = 10.0
    n_epochs: int = 400
    prior_policy: None = None  # uniform

    def init(self, n_states, n_actions):
        nothing = torch.zeros(n_states, n_actions, dtype=torch.float64)
        return SweepState(0, 0, 0.0, nothing[:, 0], nothing, self.beta)

    def prepare(self, transitions, n_states, n_actions):
        return erl_torch.empirical_mdp(transitions, n_states, n_actions)

    def step(self, state, model):
        q = torch.from_numpy(model.reward + (model.transition @ state.value.numpy()).reshape(model.reward.shape))
        backed_up = (self.beta * q).exp().mean(1).log() / self.beta  # TV of docs/theory.md
        theta = float(state.value[0] - backed_up[0])
        value = (state.value + backed_up + theta) / 2  # lazy: no period can catch it
        return SweepState(state.epoch + 1, state.n_tuples + int(model.visits.sum()), theta, value, q, self.beta)

    def finished(self, state):
        return state.epoch == self.n_epochs

    def solution(self, state, history=(), failure=None):
        prior = torch.ones_like(state.q).softmax(1)
        end = dict(n_steps=state.n_tuples, status=self.ended(state, failure))
        return erl_torch.Solution.of_action_values(state.q, prior, self.beta, state.theta, **end)


mdp = WindyCliffEnv().mdp
tuples = erl_torch.collect(mdp, n_episodes=200, episode_length=1000, seed=0)
learnt = SoftValueIteration().fit(tuples, 15, 4)
print(f"{len(tuples):,} tuples, 400 sweeps over their counts:\ntheta {learnt.theta:.5f}")
print(f"gap {erl_torch.certify(learnt, mdp, 10.0).gap:.1e}")
sweep = erl_torch.Replicas.of(SoftValueIteration(), beta=[2.0, 5.0, 10.0]).fit(tuples, 15, 4)
print("three temperatures at once:", [f"{theta:.4f}" for theta in sweep.theta])
