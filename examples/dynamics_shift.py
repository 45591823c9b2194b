"""The paper's Figure 4: the motor for "up" breaks. What is the old policy worth then, and what is better?"""

import numpy as np

import erl_torch

BETA, UP = 15.0, 3

before, after = (grid.mdp() for grid in erl_torch.envs.dynamics_shift(up_success=0.01))
old = erl_torch.solve_biasing(before, BETA)
new = erl_torch.solve_biasing(before, BETA, target=after)  # starts from the old solution
alone = erl_torch.solve_biasing(after, BETA)
rng = np.random.default_rng(0)


def report(name, mdp, policy):
    worth = erl_torch.evaluate(mdp, policy, BETA, rng, n_episodes=1)
    used = float(np.asarray(policy)[:, UP].mean())
    print(f"{name:34}{1000 * worth.reward_per_step:10.2f}{worth.objective:12.5f}{used:10.2f}")


print(f"{'':34}{'return':>10}{'objective':>12}{'P(up)':>10}")
report("old policy, motor intact", before, old.policy)
report("old policy, motor broken", after, old.policy)
report("new policy, motor broken", after, new.policy)
print(f"\nbiasing iterations: {new.n_steps} from the old solution, {alone.n_steps} from nothing")
print(f"new theta in {list(new.theta_bounds)}")

tuples = erl_torch.collect(after, n_episodes=200, episode_length=1000, seed=0)
learnt = erl_torch.EfficientS1(beta=BETA).fit(tuples, after.n_states, after.n_actions)
report(f"learnt from {len(tuples):,} tuples", after, learnt.policy)
