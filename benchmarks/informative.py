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

import gymnasium as gym
import numpy as np

import erl_torch
from erl_torch.empirical.informative import collect_informative
from erl_torch.mdp.from_gymnasium import known_mdp
from erl_torch.parallel import results

RESULTS = Path(__file__).parents[1] / "docs" / "results"
PROBLEMS = {  # environment, beta, the width that is asked for
    "windy cliff": ("erl_torch/WindyCliff-v0", 10.0, 0.004),
    "river swim": ("erl_torch/RiverSwim-v0", 1.0, 0.004),
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
    """Tuples at which the median width is ``wanted``; NaN outside the sizes tried."""
    x, y = np.log(np.array(EPISODES) * LENGTH), np.log(np.minimum.accumulate(widths))
    if not y[-1] <= np.log(wanted) <= y[0]:
        return float("nan")
    return float(np.exp(np.interp(np.log(wanted), y[::-1], x[::-1])))


def main() -> None:
    options = dict(word.split("=") for word in sys.argv[1:])
    seeds, processes = int(options.get("seeds", 20)), int(options.get("processes", 2))
    jobs = [(p, way, n, seed) for p in PROBLEMS for way in WAYS for n in EPISODES for seed in range(seeds)]
    found = dict(results({job: partial(width, job) for job in jobs}, processes))
    lines, record = [], {}
    for p, (_, beta, wanted) in PROBLEMS.items():
        tuples = {}
        for way in WAYS:
            cells = [[found[p, way, n, seed] for seed in range(seeds)] for n in EPISODES]
            widths = [float(np.median([w for w, _ in cell])) for cell in cells]
            covered = float(np.mean([ok for cell in cells for _, ok in cell]))
            tuples[way] = needed(widths, wanted)
            record[f"{p}, {way}"] = {"widths": widths, "covered": covered, "tuples": tuples[way]}
            row = " | ".join(f"{w:.2g}" for w in widths)
            lines.append(f"| {p}, beta {beta:g} | {way} | {row} | {tuples[way]:,.0f} | {covered:.3f} |")
        record[f"{p}, ratio"] = tuples["prior"] / tuples["informative"]
    ratios = ", ".join(f"{p} {record[f'{p}, ratio']:.1f}" for p in PROBLEMS)
    asked = ", ".join(f"{p} {wanted:g}" for p, (_, _, wanted) in PROBLEMS.items())
    heads = " | ".join(f"{n * LENGTH:,}" for n in EPISODES)
    text = [
        "# Which sample next",
        "",
        f"`python benchmarks/informative.py seeds={seeds}`: width of the 95% interval of theta (median over {seeds}",
        "seeds) by the number of tuples, of the prior's behaviour and of `experience=informative`; the tuples that a",
        f"width takes ({asked}); and how often the intervals hold theta*, over all sizes and seeds.",
        "",
        f"| problem | behaviour | {heads} | tuples for the width | holds theta* |",
        "|---|---|" + "---|" * (len(EPISODES) + 2),
        *lines,
        "",
        f"Fewer tuples by a factor of: {ratios}.",
    ]
    (RESULTS / "informative.md").write_text("\n".join(text) + "\n")
    (RESULTS / "informative.json").write_text(json.dumps(record, indent=1) + "\n")
    print("\n".join(text))


if __name__ == "__main__":
    main()
