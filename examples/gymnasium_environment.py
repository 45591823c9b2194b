"""Any Gymnasium environment with finite spaces: learnt from env.step alone, then held against its table P."""

import warnings

import gymnasium as gym
import numpy as np

import erl_torch

BETA = 20.0

env = gym.make("FrozenLake-v1", is_slippery=True)
tuples = erl_torch.collect(env, n_episodes=5000, episode_length=100, seed=0)  # through env.reset and env.step
print(f"{len(tuples):,} steps of FrozenLake, {int(tuples.r.sum())} of them into the goal")

learnt = erl_torch.EfficientS1(beta=BETA).fit(tuples, 16, 4)
warnings.simplefilter("ignore", erl_torch.MeanRewardWarning)  # its reward depends on s': the model has r(s,a)
model = erl_torch.tabular_mdp(env, on_end="restart")  # its table P, episode after episode
proven = erl_torch.certify(learnt, model, BETA)
print(f"theta learnt {learnt.theta:.5f}, exact in {list(proven.theta_bounds)}")

rng = np.random.default_rng(0)
uniform = np.full((16, 4), 0.25)
for name, policy in (("uniform", uniform), ("learnt", learnt.policy)):
    worth = erl_torch.evaluate(model, policy, BETA, rng)
    print(f"{name:8} objective {worth.objective:.4f} a step, a goal every {1 / worth.reward_per_step:.0f} steps")
print("with restarts, quick and risky tries pay best here: falling in costs only the way back to the start")
