"""Your own problem as NumPy arrays: exact, learnt, and kept in a file for the command line.

A machine that wears out: in states 0 (new) to 4 (broken) either run it, or repair it.
"""

import tempfile
from pathlib import Path

import numpy as np

import erl_torch

N, BETA = 5, 4.0
RUN, REPAIR = 0, 1

transition = np.zeros((N, 2, N))  # p(s'|s,a), [S, A, S]
for s in range(N):
    transition[s, RUN, s] += 0.7
    transition[s, RUN, min(s + 1, N - 1)] += 0.3
    transition[s, REPAIR, 0] = 1.0
reward = np.zeros((N, 2))  # [S, A]
reward[:, RUN] = [1.0, 0.9, 0.7, 0.4, -1.0]
reward[:, REPAIR] = -0.5
prior = np.tile([0.9, 0.1], (N, 1))  # habit: run it; leaving the habit costs KL/beta

mdp = erl_torch.TabularMDP(transition, reward, start=np.eye(N)[0])
best = erl_torch.solve_soft_bellman(mdp, BETA, prior)
print(f"exact: objective {-best.theta:.6f} a step, proven to {best.theta_bounds[1] - best.theta_bounds[0]:.0e}")

tuples = erl_torch.collect(mdp, n_episodes=20, episode_length=500, seed=1, prior_policy=prior)
learnt = erl_torch.EfficientS1(beta=BETA, prior_policy=prior).fit(tuples, N, 2)
loss = erl_torch.certify(learnt, mdp, BETA, prior).gap
print(f"learnt from {len(tuples):,} tuples: objective at most {loss:.1e} below that")

print("\nstate  P(repair): exact   learnt   habit")
for s in range(N):
    print(f"{s}{best.policy[s, REPAIR]:23.3f}{learnt.policy[s, REPAIR]:9.3f}{prior[s, REPAIR]:8.3f}")

try:
    erl_torch.TabularMDP(transition * 0.9, reward)
except erl_torch.InputError as error:
    print(f"\na mistake is named: {error}")

with tempfile.TemporaryDirectory() as folder:
    path = mdp.save(Path(folder) / "machine.npz")
    print(f"\n{path.name} ({path.stat().st_size} bytes): python train.py env=mdp env.path={path.name}")
