"""What the presets with ends of episodes come to, beside value iteration: docs/results/episodes.md.

    python benchmarks/episodes.py

Returns and success rates of the tables are exact (``evaluate_episodes``); CartPole and MountainCar are played. Value
iteration is written here, from the environment's table.
"""

from __future__ import annotations

import json
import warnings
from pathlib import Path

import gymnasium as gym
import numpy as np

import erl_torch
from erl_torch.envs import Discretise
from erl_torch.envs.ends import EndReward
from erl_torch.evaluation import evaluate

RESULTS = Path(__file__).parents[1] / "docs" / "results"
DISCOUNT = 0.999


def value_iteration(env: gym.Env, discount: float) -> np.ndarray:
    """The greedy policy [S, A] of the discounted problem; the first of equal actions."""
    table = env.unwrapped.P  # type: ignore[attr-defined]
    n, n_actions = len(table), len(table[0])
    value = np.zeros(n)

    def worth(s: int, a: int) -> float:
        return float(sum(p * (r + discount * value[to] * (not over)) for p, to, r, over in table[s][a]))

    for _ in range(100_000):
        q = np.array([[worth(s, a) for a in range(n_actions)] for s in range(n)])
        if np.abs(q.max(1) - value).max() < 1e-12:
            break
        value = q.max(1)
    return np.asarray(np.eye(n_actions)[q.argmax(1)])


def of_tables() -> list[dict[str, object]]:
    rows: list[dict[str, object]] = []
    cases = (
        ("FrozenLake-v1", {}, 100, [(20.0, -2.0), (100.0, -1.0)]),
        ("FrozenLake-v1", {"map_name": "8x8"}, 200, [(20.0, -2.0), (100.0, -1.0)]),
        ("CliffWalking-v1", {}, 1000, [(2.0, 50.0)]),
        ("Taxi-v4", {}, 200, [(2.0, 0.0), (5.0, 0.0)]),
    )
    for env_id, arguments, limit, settings in cases:
        env = gym.make(env_id, **arguments)
        episode = erl_torch.tabular_mdp(env, "absorb")
        # The end that pays most is a success.
        table = env.unwrapped.P  # type: ignore[attr-defined]
        n_actions = episode.n_actions
        best = max(r for s in table for a in table[s] for _, _, r, over in table[s][a] if over)
        paid = {to for s in table for a in table[s] for _, to, r, over in table[s][a] if over and r == best}
        successes = np.isin(np.arange(episode.n_states), list(paid))
        name = env_id + "".join(f", {value}" for value in arguments.values())

        def add(how: str, policy: np.ndarray, name=name, episode=episode, successes=successes, limit=limit) -> None:
            a_try = erl_torch.evaluate_episodes(episode, policy, successes=successes)
            limited = erl_torch.evaluate_episodes(episode, policy, successes=successes, horizon=limit)
            rows.append(
                {
                    "environment": name,
                    "policy": how,
                    "success": a_try.success_rate.value,
                    "return": a_try.mean_return.value,
                    "steps": a_try.steps.value,
                    "limit": limit,
                    "success_limited": limited.success_rate.value,
                    "return_limited": limited.mean_return.value,
                }
            )

        add("prior", np.full((episode.n_states, n_actions), 1 / n_actions))
        add(f"value iteration, discount {DISCOUNT}", value_iteration(env, DISCOUNT))
        beta, _ = settings[0]
        plain = erl_torch.solve_soft_bellman(erl_torch.tabular_mdp(env), beta)
        add(f"no end_reward, beta {beta:g}, exact", plain.policy.numpy())
        for beta, end_reward in settings:
            model = erl_torch.tabular_mdp(env, end_reward=end_reward)
            text = f"end_reward {end_reward:g}, beta {beta:g}"
            add(f"{text}, exact", erl_torch.solve_soft_bellman(model, beta).policy.numpy())
            tuples = erl_torch.collect(model, 500, 1000, seed=0)
            if (beta, end_reward) == settings[0]:
                learnt = erl_torch.AlgorithmS1(beta=beta).fit(tuples, model.n_states, model.n_actions)
                add(f"{text}, published S1", learnt.policy.numpy())
            learnt = erl_torch.EfficientS1(beta=beta).fit(tuples, model.n_states, model.n_actions)
            add(f"{text}, s1_efficient", learnt.policy.numpy())
        for large in (settings[-1][0], 1000.0):
            add(f"first exit, beta {large:g}", erl_torch.solve_first_exit(episode, large).policy.numpy())
    return rows


def of_control() -> list[dict[str, object]]:
    rows: list[dict[str, object]] = []
    bins = [1, 1, 6, 6], [-2.4, -2, -0.21, -2], [2.4, 2, 0.21, 2]
    env = Discretise(gym.make("CartPole-v1"), *bins)
    tuples = erl_torch.collect(EndReward(env, -10.0, "all"), 3000, 1000, seed=0)
    learnt = erl_torch.EfficientS1(beta=10.0).fit(tuples, 36, 2).policy.numpy()
    for how, policy in (("prior", np.full((36, 2), 0.5)), ("end_reward -10, beta 10, s1_efficient", learnt)):
        played = evaluate(env, policy, 10.0, np.random.default_rng(0), 100, 500)
        rows.append({"environment": "CartPole-v1", "policy": how, "return_limited": played.mean_return, "limit": 500})
    for how, n_bins, beta in (("12 x 12 bins, beta 2, exact", 12, 2.0), ("30 x 30 bins, beta 100, exact", 30, 100.0)):
        model = erl_torch.estimate_mdp("mountain_car", bins=n_bins, seed=0).mdp
        policy = erl_torch.solve_soft_bellman(model, beta).policy.numpy()
        driven = erl_torch.rollout("mountain_car", policy, 1000, 200, np.random.default_rng(0), bins=n_bins)
        rows.append(
            {
                "environment": "MountainCar-v0",
                "policy": how,
                "success_limited": float((driven.lengths < 200).mean()),
                "return_limited": float(driven.returns.mean()),
                "limit": 200,
            }
        )
    return rows


def page(rows: list[dict[str, object]]) -> str:
    lines = [
        "# Episodes of the presets",
        "",
        "`python benchmarks/episodes.py`. Success, return and steps of an episode, without a limit and within the",
        "environment's own limit of steps. Those of the first four are exact; CartPole's are of 100 episodes played,",
        "MountainCar's of 1,000. Value iteration knows the model, and is greedy; learners saw 500,000 tuples.",
        "",
        "| environment | policy | success | return | steps | limit | success within it | return within it |",
        "|---|---|---|---|---|---|---|---|",
    ]
    keys = (("success", ".4f"), ("return", ".3f"), ("steps", ".2f"), ("limit", "d"), ("success_limited", ".4f"),
            ("return_limited", ".3f"))  # fmt: skip
    for row in rows:
        cells = [format(row[key], form) if key in row else "" for key, form in keys]
        lines.append(f"| {row['environment']} | {row['policy']} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    warnings.simplefilter("ignore")
    rows = of_tables() + of_control()
    (RESULTS / "episodes.json").write_text(json.dumps(rows, indent=1) + "\n")
    (RESULTS / "episodes.md").write_text(page(rows))


if __name__ == "__main__":
    main()
