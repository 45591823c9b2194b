"""Figure 5's learner over many seeds: where each biasing iteration ends.

    python benchmarks/figure_5.py [n_seeds] [key=value of erl_torch.AlgorithmS1 ...]

Prints a Markdown table: mean reward per step (1000 steps from the start, exact) of the policy at the end of
every biasing iteration, theta and objective of the last.
"""

from __future__ import annotations

import sys

import numpy as np
from tqdm import tqdm

from erl_torch import AlgorithmS1, collect
from erl_torch.envs.windy_cliff import WindyCliffEnv
from erl_torch.evaluation import objective, reward_per_step


def main() -> None:
    n_seeds = int(next((a for a in sys.argv[1:] if "=" not in a), 12))
    options = dict(a.split("=", 1) for a in sys.argv[1:] if "=" in a)
    learner = AlgorithmS1(**({"rho_init": "carry", "self_loop": "old"} | options))  # type: ignore[arg-type]
    mdp, uniform = WindyCliffEnv().mdp, np.full((15, 4), 0.25)
    rows = []
    for seed in tqdm(range(n_seeds), disable=None):
        states = learner.iterate(collect(mdp, 500, 1000, seed), 15, 4)
        ends = [s for s in states if s.epoch == learner.n_epochs]
        policy = ends[-1].policy.numpy()
        returns = [reward_per_step(mdp, s.policy.numpy(), 1000) for s in ends]
        rows.append([*returns, ends[-1].theta, objective(mdp, policy, uniform, learner.beta)])
    table = np.array(rows)
    print("| seed |" + "".join(f" #{k} |" for k in range(learner.n_bias)) + " theta | objective |")
    print("|---|" + "---|" * table.shape[1])
    names = [*map(str, range(n_seeds)), "mean", "min", "max"]
    for name, row in zip(names, [*table, table.mean(0), table.min(0), table.max(0)], strict=True):
        print(f"| {name} |" + "".join(f" {value:.4f} |" for value in row))


if __name__ == "__main__":
    main()
