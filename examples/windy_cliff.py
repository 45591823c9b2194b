"""Learn the windy cliff from random experience, and prove how good the policy is."""

import erl_torch
from erl_torch.envs.windy_cliff import WindyCliffEnv

BETA = 10.0

env = WindyCliffEnv(render_mode="ansi")
mdp = env.mdp
tuples = erl_torch.collect(env, n_episodes=500, episode_length=1000, seed=0)  # of the uniform prior
print(f"{len(tuples):,} tuples of the uniform policy")

for learner in (erl_torch.AlgorithmS1(beta=BETA), erl_torch.EfficientS1(beta=BETA)):
    learnt = learner.fit(tuples, mdp.n_states, mdp.n_actions)
    proven = erl_torch.certify(learnt, mdp, BETA)  # needs the model, which the learner has not seen
    low, high = proven.theta_bounds
    print(f"\n{type(learner).__name__}: theta {learnt.theta:.4f}, and the truth is in [{low}, {high}]")
    print(f"  its objective is at most {proven.gap:.1e} a step below the best")

print("\nthe policy, tile by tile (H cliff, G goal; # more than one action above 30%):")
arrows = "".join(
    "<v>^"[int(row.argmax())] if (row > 0.3).sum() == 1 else "#" for row in learnt.policy
)  # 0..3: left, down, right, up
for row in range(5):
    tiles = env.grid.tiles[3 * row : 3 * row + 3]
    shown = [tile if tile in "HG" else arrow for tile, arrow in zip(tiles, arrows[3 * row :], strict=False)]
    print("  " + " ".join(shown))
