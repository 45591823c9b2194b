"""Many learners at once: error bands over seeds, then a sweep over temperatures, each in one call."""

import numpy as np

import erl_torch
from erl_torch.envs.windy_cliff import WindyCliffEnv

mdp = WindyCliffEnv().mdp
n_states, n_actions = mdp.n_states, mdp.n_actions

# Twelve seeds of published S1, each on a stream of its own, interleaved in one compiled loop.
learner = erl_torch.AlgorithmS1(beta=10.0)
replicas = erl_torch.Replicas.of(learner, n_replicas=12)
streams = erl_torch.Simulation(mdp, n_episodes=100, episode_length=1000, seeds=range(12))
print("biasing iteration   theta: median, quartiles over 12 seeds")
for state in replicas.iterate(streams, n_states, n_actions):
    row = state.metrics()  # arrays [12]
    if row["epoch"][0] == learner.n_epochs:
        low, middle, high = np.quantile(row["theta"], [0.25, 0.5, 0.75])
        print(f"{int(row['bias_iteration'][0]):9}{middle:19.4f}  [{low:.4f}, {high:.4f}]")
found = replicas.solution(state)
print("tables have a leading axis:", tuple(found.policy.shape), "and found[7] is a Solution")

# A phase diagram: one recorded stream, eight temperatures.
betas = [0.5, 1.0, 2.0, 3.0, 5.0, 8.0, 12.0, 20.0]
tuples = erl_torch.collect(mdp, n_episodes=200, episode_length=1000, seed=0)
sweep = erl_torch.Replicas.of(erl_torch.EfficientS1(), beta=betas).fit(tuples, n_states, n_actions)
print("\n beta   theta learnt   exact    reward a step")
for beta, solution in zip(betas, sweep.solutions, strict=True):
    exact = erl_torch.solve_soft_bellman(mdp, beta).theta
    rate = erl_torch.evaluate(mdp, solution.policy, beta, np.random.default_rng(0), n_episodes=1).reward_per_step
    print(f"{beta:5.1f}{solution.theta:13.4f}{exact:10.4f}{rate:13.4f}")
