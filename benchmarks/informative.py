"""Tuples that it takes to know theta to a given width: the informative behaviour policy against the prior's.

python benchmarks/informative.py [seeds=20] [processes=2]

Writes docs/results/informative.md and informative.json. Every cell is a median over seeds; the tuples for a width are
read off between two sizes, on logarithmic axes.
"""

from __future__ import annotations

import json
import sys
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

import erl_torch
from erl_torch.empirical.informative import collect_informative
from erl_torch.mdp.from_gymnasium import known_mdp
from erl_torch.parallel import results

RESULTS = Path(__file__).parents[1] / "docs" / "results"
PROBLEMS = {  # environment, beta, the width that is asked for
    "windy cliff": ("erl_torch/WindyCliff-v0", 10.0, 0.0044),
    "river swim": ("erl_torch/RiverSwim-v0", 1.0, 0.0021),
    "access control": ("erl_torch/AccessControl-v0", 2.0, 0.06),
    "windy maze": ("erl_torch/WindyMaze-v0", 10.0, 0.0006),
}
EPISODES = (10, 20, 40, 80, 160, 320)
LENGTH = 1000
WAYS = ("prior", "informative")


def width(job: tuple[str, str, int, int]) -> tuple[float, bool]:
    """(width of the 95% interval of theta, whether it holds theta*)."""
    name, way, episodes, seed = job
    env_id, beta, _ = PROBLEMS[name]
    mdp = known_mdp(gym.make(env_id))
    assert mdp is not None
    if way == "prior":
        data = erl_torch.collect(mdp, episodes, LENGTH, seed)
    else:
        data = collect_informative(mdp, episodes, LENGTH, beta, seed)
    low, high = erl_torch.theta_uncertainty(erl_torch.empirical_mdp(data, mdp.n_states, mdp.n_actions), beta).interval()
    bounds = erl_torch.solve_soft_bellman(mdp, beta).theta_bounds
    assert bounds is not None
    return high - low, low <= bounds[1] and bounds[0] <= high


def needed(widths: list[float], wanted: float) -> float:
    """Tuples at which the median width is ``wanted``; infinite beyond the sizes tried, and at least the smallest."""
    x, y = np.log(np.array(EPISODES) * LENGTH), np.log(np.minimum.accumulate(widths))
    if np.log(wanted) < y[-1]:
        return float("inf")
    return float(np.exp(np.interp(np.log(wanted), y[::-1], x[::-1])))


def _count(tuples: float) -> str:
    smallest, largest = EPISODES[0] * LENGTH, EPISODES[-1] * LENGTH
    return f"over {largest:,}" if np.isinf(tuples) else f"{'up to ' * (tuples < 1.001 * smallest)}{tuples:,.0f}"


def page(record: dict[str, dict[str, Any]], seeds: int) -> str:
    """docs/results/informative.md of the figures of every problem and way."""
    lines, covered, ratios = [], [], []
    for p, (_, beta, _) in PROBLEMS.items():
        tuples = {}
        for way in WAYS:
            found = record[f"{p}, {way}"]
            tuples[way] = needed(found["widths"], PROBLEMS[p][2])
            row = " | ".join(f"{w:.2g}" for w in found["widths"])
            lines.append(f"| {p}, beta {beta:g} | {way} | {row} | {_count(tuples[way])} |")
            shares = " | ".join(f"{x:.2f}" for x in found["covered"])
            covered.append(f"| {p} | {way} | {shares} | {np.mean(found['covered']):.3f} |")
        least = min(tuples["prior"], EPISODES[-1] * LENGTH) / tuples["informative"]
        ratios.append(f"{p} {'over ' if np.isinf(tuples['prior']) else ''}{least:.1f}")
    asked = ", ".join(f"{p} {wanted:g}" for p, (_, _, wanted) in PROBLEMS.items())
    heads = " | ".join(f"{n * LENGTH:,}" for n in EPISODES)
    text = [
        "# Which sample next",
        "",
        f"`python benchmarks/informative.py seeds={seeds}`: width of the 95% interval of theta (median over {seeds}",
        "seeds) by the number of tuples, of the prior's behaviour and of `experience=informative`, and the tuples that",
        f"a width takes ({asked}).",
        "",
        f"| problem | behaviour | {heads} | tuples for the width |",
        "|---|---|" + "---|" * (len(EPISODES) + 1),
        *lines,
        "",
        f"Fewer tuples by a factor of: {', '.join(ratios)}.",
        "",
        f"Share of the intervals that hold theta*, of {seeds} each:",
        "",
        f"| problem | behaviour | {heads} | all |",
        "|---|---|" + "---|" * (len(EPISODES) + 1),
        *covered,
        "",
        "An interval is of what was met. In the maze the informative policy does not look for more: one stream met 69",
        "of the 100 states in 40,000 tuples and in 320,000 (the prior's 63 and 78), and the narrower the interval, the",
        "more often it leaves theta* out. A run notes how many states it has not met.",
    ]
    return "\n".join(text) + "\n"


def main() -> None:
    options = dict(word.split("=") for word in sys.argv[1:])
    seeds, processes = int(options.get("seeds", 20)), int(options.get("processes", 2))
    jobs = [(p, way, n, seed) for p in PROBLEMS for way in WAYS for n in EPISODES for seed in range(seeds)]
    found = dict(results({job: partial(width, job) for job in jobs}, processes))
    record: dict[str, dict[str, Any]] = {}
    for p in PROBLEMS:
        for way in WAYS:
            cells = [[found[p, way, n, seed] for seed in range(seeds)] for n in EPISODES]
            record[f"{p}, {way}"] = {
                "widths": [float(np.median([w for w, _ in cell])) for cell in cells],
                "covered": [float(np.mean([ok for _, ok in cell])) for cell in cells],
            }
    text = page(record, seeds)
    (RESULTS / "informative.md").write_text(text)
    (RESULTS / "informative.json").write_text(json.dumps(record, indent=1) + "\n")
    print(text)


if __name__ == "__main__":
    main()
