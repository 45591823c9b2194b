"""Learn online: chunks of experience come in, each is seen once and forgotten; the policy in use is the one learnt."""

import numpy as np

import erl_torch
from erl_torch.envs.windy_cliff import WindyCliffEnv

BETA, CHUNK = 10.0, 5000

mdp = WindyCliffEnv().mdp
prior = np.full((mdp.n_states, mdp.n_actions), 0.25)
current = prior


def experience():
    """Chunks of the policy of the moment, a third of its actions still random."""
    for seed in range(40):
        behaviour = 2 / 3 * current + 1 / 3 * prior
        yield erl_torch.collect(mdp, 5, CHUNK // 5, seed, behaviour_policy=behaviour)


best = erl_torch.solve_soft_bellman(mdp, BETA)
rng = np.random.default_rng(0)
learner = erl_torch.EfficientS1(beta=BETA)
print(f"optimal objective {-best.theta:.5f}")
print(" tuples seen   theta    objective of the policy    its loss in the counts' model, at most")
for state in learner.online(experience(), mdp.n_states, mdp.n_actions):
    current = state.policy.numpy()
    if state.epoch in (1, 2, 4, 8, 16, 32, 40):
        worth = erl_torch.evaluate(mdp, current, BETA, rng, n_episodes=1)
        verdict = "" if state.certified else f"  {state.message}"
        print(f"{state.n_tuples:12,}{state.theta:9.4f}{worth.objective:12.5f}{state.empirical_width:26.5f}{verdict}")
print("nothing was stored but counts: tables of", current.shape)
