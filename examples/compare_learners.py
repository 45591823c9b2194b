"""The same stream for every learner of the average-reward problem: which policy is nearest to the optimum?"""

import time

import erl_torch
from erl_torch.envs.windy_cliff import WindyCliffEnv
from erl_torch.learners import LEARNERS

BETA = 10.0
NAMES = ("certainty_equivalence", "s1_efficient", "rvi_soft_q", "differential_soft_q", "s1", "u_learning")

mdp = WindyCliffEnv().mdp
tuples = erl_torch.collect(mdp, n_episodes=200, episode_length=1000, seed=0)
best = erl_torch.solve_soft_bellman(mdp, BETA)
print(f"{len(tuples):,} tuples; exact theta {best.theta:.5f}\n")
print(f"{'learner':22} {'gap':>9} {'theta':>9} {'seconds':>8}")
for name in NAMES:
    began = time.perf_counter()
    learnt = LEARNERS[name](beta=BETA).fit(tuples, mdp.n_states, mdp.n_actions)
    seconds = time.perf_counter() - began  # of the first call: with loading compiled code
    gap = erl_torch.certify(learnt, mdp, BETA).gap
    print(f"{name:22} {gap:9.1e} {learnt.theta:9.5f} {seconds:8.2f}")
print("\nu_learning is optimistic: it plans as if it chose the wind, so its theta is too low and its policy poor")
