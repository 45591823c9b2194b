"""How sure are the data of theta, and where would the next samples help most?"""

import numpy as np

import erl_torch
from erl_torch.envs.windy_cliff import WindyCliffEnv

BETA, SAMPLES = 10.0, 200_000

mdp = WindyCliffEnv().mdp
exact = erl_torch.solve_soft_bellman(mdp, BETA).theta
prior = np.full((mdp.n_states, mdp.n_actions), 0.25)


def estimate(tuples):
    return erl_torch.theta_uncertainty(erl_torch.empirical_mdp(tuples, mdp.n_states, mdp.n_actions), BETA)


def merged(*streams):
    columns = ("s", "a", "r", "s_next", "a_next")
    return erl_torch.Transitions(*(np.concatenate([getattr(x, name) for x in streams]) for name in columns))


first = erl_torch.collect(mdp, n_episodes=SAMPLES // 1000, episode_length=1000, seed=0)
now = estimate(first)
low, high = now.interval(0.95)
print(f"{len(first):,} tuples: {now}, interval [{low:.4f}, {high:.4f}]; exact {exact:.4f}")
boot = erl_torch.bootstrap_theta(erl_torch.empirical_mdp(first, 15, 4), BETA, n_resamples=50)
print(f"standard error: plug-in {now.standard_error:.5f}, bootstrap {boot.standard_error:.5f}")

print("\none more sample helps most at")
for s, a, drop in now.next_samples(3):
    print(f"  state {s:2}, {('left', 'down', 'right', 'up')[a]:5}  variance falls by {drop:.1e}")

# As many samples again: where the prior goes, or in proportion to d* sigma, the share that is best for this formula.
share = np.sqrt(now.variance * now.visits)
counts = np.random.default_rng(1).multinomial(SAMPLES, share.ravel() / share.sum())
pairs = np.flatnonzero(counts)
rows = mdp.transition[pairs].toarray()  # p(.|s,a) of each
rng = np.random.default_rng(2)
s_next = np.concatenate([rng.choice(mdp.n_states, counts[k], p=row) for k, row in zip(pairs, rows, strict=True)])
k = np.repeat(pairs, counts[pairs])
targeted = erl_torch.Transitions(k // 4, k % 4, mdp.reward.ravel()[k], s_next, np.zeros(len(k), np.int64))
more = erl_torch.collect(mdp, n_episodes=SAMPLES // 1000, episode_length=1000, seed=1)
print(f"\n{SAMPLES:,} more of the prior:      {estimate(merged(first, more))}")
print(f"{SAMPLES:,} more where it matters: {estimate(merged(first, targeted))}")
