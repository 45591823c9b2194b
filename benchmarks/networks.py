"""Learners with networks on continuous problems, ten seeds each, all seeds shown.

    python benchmarks/networks.py [TASK ...]    writes docs/results/networks.json and docs/results/networks.md

Tasks: strip, cart_pole, acrobot, mountain_car, pendulum, lander, lander_wind (these two need box2d). Returns are means
of 100 episodes from starts that are the same for all seeds, by the most probable actions and as drawn. Seconds are of
the processor, learning alone.
"""

from __future__ import annotations

import json
import statistics
import sys
import time
from pathlib import Path

import numpy as np
import torch

from erl_torch import configurations
from erl_torch.cli.config import composed, register
from erl_torch.networks.actor_critic import suited
from erl_torch.networks.episodes import Stage
from erl_torch.networks.live import Live
from erl_torch.networks.truth import TRUTHS
from erl_torch.run.build import made
from erl_torch.run.classes import resolve
from erl_torch.run.networks import make_network_problem

OUT = Path(__file__).parents[1] / "docs" / "results"
TASKS = {
    "strip": ["env=windy_strip"],
    "cart_pole": ["env=cart_pole_v1"],
    "acrobot": ["env=acrobot_v1"],
    "mountain_car": ["env=mountain_car_v0"],
    "lander": ["env=lunar_lander"],
    "lander_wind": [
        "env=lunar_lander",
        "++env.kwargs.enable_wind=true",
        "++env.kwargs.wind_power=15.0",
        "++env.kwargs.turbulence_power=1.5",
    ],
    "pendulum": ["env=pendulum_v1"],
}
LEARNERS = ("asql", "deep_s1")
OF_BOXES = {"pendulum": ("asac", "deep_s1")}
SEEDS = range(10)
EPISODES = 100


def measured(task: str, name: str, seed: int) -> dict[str, float]:
    """One run."""
    cfg = composed(configurations.folder(), "train", [*TASKS[task], f"learner={name}"])
    problem = make_network_problem(cfg)
    learner = suited(made(cfg.learner, resolve(cfg.learner["class"], "learner.class"), "learner"), problem)
    began = time.process_time()
    *_, state = learner.run(problem, Live(problem, seed))
    seconds = time.process_time() - began
    policy = learner.policy(problem, state)
    found = {"seconds": seconds, "theta": state.theta}
    truth = TRUTHS.get(cfg.env.id)
    if truth is not None:
        judge = truth(float(learner.beta))
        found |= judge.figures(policy)
        found["theta_error"] = abs(state.theta + judge.optimum["objective"])
    else:
        stage = Stage(problem, EPISODES, 1000, 10_000)
        for way, greedy in (("sampled", False), ("greedy", True)):
            played = stage.play(policy, greedy)
            found[way] = float(played.returns.mean())
        stage.close()
    return found


def interquartile(values: list[float]) -> tuple[float, float, float]:
    """The interquartile mean, with its 95% interval by the bootstrap (seeded)."""

    def mean(x: np.ndarray) -> np.ndarray:
        n = x.shape[-1]
        inside = np.sort(x, -1)[..., n // 4 : n - n // 4]
        return np.asarray(inside.mean(-1))

    x = np.array(values)
    drawn = np.random.default_rng(0).choice(x, (10_000, len(x)))
    low, high = np.quantile(mean(drawn), [0.025, 0.975])
    return float(mean(x)), float(low), float(high)


def page(results: dict[str, dict[str, dict[str, dict[str, float]]]]) -> str:
    """The results as tables."""
    lines = [
        "# Learners with networks: ten seeds each",
        "",
        "`python benchmarks/networks.py strip cart_pole acrobot mountain_car` (and `lander lander_wind`), on two",
        "shared cores. Settings are those of `conf/env`; all seeds are shown, in the order 0 to 9. Returns are means",
        "of 100 episodes from common starts; seconds are of the processor, for learning.",
        "",
    ]
    for task, of_task in results.items():
        lines += [f"## {task}", ""]
        for name, of_learner in of_task.items():
            rows = list(of_learner.values())
            names = ("loss_of_policy", "theta_error", "falls") if "loss_of_policy" in rows[0] else ("greedy", "sampled")
            for key in (*names, "seconds"):
                values = [row[key] for row in rows]
                shown = " ".join(f"{value:.3g}" for value in values)
                middle = statistics.median(values)
                middle_mean, low, high = interquartile(values)
                text = f"median {middle:.4g}, interquartile mean {middle_mean:.4g} [{low:.4g}, {high:.4g}]"
                lines.append(f"- {name}, {key.replace('_', ' ')}: {shown}; {text}")
        lines.append("")
    return "\n".join(lines)


def main() -> None:
    register()
    torch.set_num_threads(1)
    path = OUT / "networks.json"
    results = json.loads(path.read_text()) if path.exists() else {}
    for task in sys.argv[1:] or ("strip", "cart_pole", "acrobot", "mountain_car"):
        for name in OF_BOXES.get(task, LEARNERS):
            done = results.setdefault(task, {}).setdefault(name, {})
            for seed in SEEDS:
                if str(seed) not in done:
                    done[str(seed)] = measured(task, name, seed)
                    print(
                        task, name, seed, {key: round(value, 5) for key, value in done[str(seed)].items()}, flush=True
                    )
                    path.write_text(json.dumps(results, indent=1))
    (OUT / "networks.md").write_text(page(results))


if __name__ == "__main__":
    main()
