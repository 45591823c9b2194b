"""Learners at every optimism: their loss beside that of certainty equivalence, and the coverage of theta's intervals.

    python benchmarks/dial_streams.py loss [n_seeds [optimism ...]]    the cliff, 500,000 tuples, default 20 seeds
    python benchmarks/dial_streams.py coverage [n]                     random problems, default 300 datasets
    python benchmarks/dial_streams.py page                             docs/results/dial_streams.md of both

Each writes its figures to docs/results/dial_streams_<what>.json, and the page anew. Loss is g* - J of the policy in the
true MDP at that optimism, at most (its certificate), reward a step. Minutes each, on one core.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from erl_torch import (
    CertaintyEquivalence,
    EfficientS1,
    ListedS1,
    TabularMDP,
    certify,
    collect,
    empirical_mdp,
    solve_soft_bellman,
    theta_uncertainty,
)
from erl_torch.envs.windy_cliff import WindyCliffEnv
from erl_torch.files import write_json

RESULTS = Path(__file__).parents[1] / "docs" / "results"
PAGE = RESULTS / "dial_streams.md"
OPTIMISM = (1.0, 0.5, 0.0, -0.5, -1.0, -3.0)
BETA = 10.0
LEARNERS: dict[str, Callable[[float], Any]] = {
    "certainty equivalence": lambda lam: CertaintyEquivalence(BETA, optimism=lam),
    "EfficientS1": lambda lam: EfficientS1(BETA, optimism=lam),
    "S1 as listed": lambda lam: ListedS1(BETA, optimism=lam),
}
NOTE = """# Learners at every optimism

    python benchmarks/dial_streams.py loss
    python benchmarks/dial_streams.py coverage

Windy cliff, beta 10, 500,000 tuples of the uniform prior; means over {n} streams. Loss: g* - J of the policy in the
true MDP at that optimism, at most (its certificate), reward a step. Listed: constant steps, 15 epochs x 6. At optimism
-1 the cliff is nearly indifferent: its feared dynamics all but close sets of states, so that bounds say little.

| optimism | theta* | loss of certainty equivalence | EfficientS1 | ratio | passes | certified | S1 as listed | ratio |
|---|---|---|---|---|---|---|---|---|
{rows}

## Intervals

Random problems of 8 states and 3 actions, beta 2, 20,000 tuples each, {datasets} datasets: share of the 95%
intervals of theta that hold theta*, and error in standard errors.

| optimism | coverage | withheld | error, mean | error, deviation |
|---|---|---|---|---|
{coverage}
"""


def loss(n_seeds: int, optimism: tuple[float, ...]) -> None:
    """Figures of every learner and stream, by optimism; those of others stay."""
    mdp, path = WindyCliffEnv().mdp, RESULTS / "dial_streams_loss.json"
    for lam in tqdm(optimism):
        found = json.loads(path.read_text()) if path.exists() else {}
        best = solve_soft_bellman(mdp, BETA, tol=1e-12, optimism=lam)
        rows: dict[str, list[dict[str, Any]]] = {name: [] for name in LEARNERS}
        for seed in range(n_seeds):
            data = collect(mdp, 500, 1000, seed)
            for name, make in LEARNERS.items():
                began = time.perf_counter()
                solution = make(lam).fit(data, 15, 4)
                seconds = time.perf_counter() - began
                gap = certify(solution, mdp, BETA, best=best, optimism=lam).gap
                rows[name].append(
                    {
                        "loss": gap,
                        "theta": solution.theta,
                        "passes": solution.n_steps / len(data),
                        "status": solution.status.name.lower(),
                        "seconds": seconds,
                    }
                )
        found[str(lam)] = {"theta": best.theta, "seeds": n_seeds, "learners": rows}
        write_json(path, {str(one): found[str(one)] for one in OPTIMISM if str(one) in found})


def random_mdp(rng: np.random.Generator) -> TabularMDP:
    """8 states, 3 actions, dense, rewards in [-1, 0]."""
    p = rng.dirichlet(np.full(8, 0.5), size=(8, 3)) + 1e-3
    return TabularMDP(p / p.sum(-1, keepdims=True), -rng.random((8, 3)), np.full(8, 1 / 8))


def coverage(n: int) -> dict[str, Any]:
    """Coverage of theta's intervals by optimism."""
    found: dict[str, Any] = {"datasets": n}
    for lam in tqdm(OPTIMISM):
        inside, errors, withheld = 0, [], 0
        for seed in range(n):
            mdp = random_mdp(np.random.default_rng([7, seed]))
            theta = solve_soft_bellman(mdp, 2.0, optimism=lam).theta
            estimate = theta_uncertainty(empirical_mdp(collect(mdp, 20, 1000, seed), 8, 3), 2.0, optimism=lam)
            if estimate.withheld:
                withheld += 1
                continue
            low, high = estimate.interval()
            assert theta is not None
            inside += low <= theta <= high
            errors.append((estimate.value - theta) / estimate.standard_error)
        found[str(lam)] = {
            "coverage": inside / (n - withheld),
            "withheld": withheld,
            "mean": float(np.mean(errors)),
            "deviation": float(np.std(errors)),
        }
        write_json(RESULTS / "dial_streams_coverage.json", found)
    return found


def page() -> None:
    """Write docs/results/dial_streams.md from the two files of figures."""
    losses = json.loads((RESULTS / "dial_streams_loss.json").read_text())
    covered = json.loads((RESULTS / "dial_streams_coverage.json").read_text())
    rows = []
    for lam, of in losses.items():
        mean = {name: float(np.mean([one["loss"] for one in each])) for name, each in of["learners"].items()}
        ours = of["learners"]["EfficientS1"]
        passes = float(np.mean([one["passes"] for one in ours]))
        certified = sum(one["status"] == "converged" for one in ours)
        limit = mean["certainty equivalence"]
        cells = [
            f"{float(lam):g}", f"{of['theta']:.5f}", f"{limit:.3g}", f"{mean['EfficientS1']:.3g}",
            f"{mean['EfficientS1'] / limit:.3g}", f"{passes:.1f}", f"{certified} of {len(ours)}",
            f"{mean['S1 as listed']:.3g}", f"{mean['S1 as listed'] / limit:.3g}",
        ]  # fmt: skip
        rows.append("| " + " | ".join(cells) + " |")
    shares = [
        f"| {float(lam):g} | {of['coverage']:.3f} | {of['withheld']} | {of['mean']:.3f} | {of['deviation']:.3f} |"
        for lam, of in covered.items()
        if lam != "datasets"
    ]
    n = next(iter(losses.values()))["seeds"]
    PAGE.write_text(NOTE.format(n=n, rows="\n".join(rows), datasets=covered["datasets"], coverage="\n".join(shares)))


if __name__ == "__main__":
    what, *given = sys.argv[1:]
    if what == "loss":
        loss(int(given[0]) if given else 20, tuple(map(float, given[1:])) or OPTIMISM)
    elif what == "coverage":
        coverage(int(given[0]) if given else 300)
    page()
