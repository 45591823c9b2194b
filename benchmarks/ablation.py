"""Which change takes Algorithm S1 to the limit of its data: each alone, all but each, all.

    python benchmarks/ablation.py [n_seeds]

Windy cliff, beta 10, 500,000 tuples of the uniform prior a seed, 15 epochs x 6 biasing iterations, default 20 seeds.
Writes docs/results/ablation.md, ablation.json and ablation.png: loss g* - J of the last policy in the true MDP, and
KL(optimal || learnt), mean over states, each counted alike. Seven minutes on one core.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from tqdm import tqdm

from erl_torch import CertaintyEquivalence, EfficientS1, collect, solve_soft_bellman
from erl_torch.envs.windy_cliff import WindyCliffEnv
from erl_torch.files import write_json
from erl_torch.learners.efficient_s1.algorithm import SWITCHES
from erl_torch.solvers.policy import kl_per_state, objective

RESULTS = Path(__file__).parents[1] / "docs" / "results"
BETA = 10.0
TITLES = {
    "sample_mean_psi": "sample-mean psi",
    "expected_backup": "expected backup",
    "clocks": "per-(s,a) clocks",
    "mean_reward": "mean reward",
    "warm_start": "warm-started u, rho",
    "polyak": "Polyak averaging",
    "certificate": "stop on certificate",
    "log_domain": "log domain",
}


def learners() -> dict[str, Any]:
    """Rows of the table, top to bottom."""
    passes: dict[str, Any] = {"n_epochs": 15, "n_bias": 6}
    rows: dict[str, Any] = {"published S1 (listing)": EfficientS1.published(BETA)}
    for name in (*SWITCHES, "log_domain"):
        on: Any = "on" if name == "log_domain" else True
        rows[f"+ {TITLES[name]}"] = EfficientS1.published(BETA, **{name: on})
    two: dict[str, Any] = {"sample_mean_psi": True, "expected_backup": True}
    rows["+ sample-mean psi, expected backup"] = EfficientS1.published(BETA, **two)
    rows["+ these two, warm-started u, rho"] = EfficientS1.published(BETA, **two, warm_start=True)
    rows["+ these three, clocks"] = EfficientS1.published(BETA, **two, warm_start=True, clocks=True)
    for name in SWITCHES:
        rows[f"all, less {TITLES[name]}"] = EfficientS1(BETA, **passes, **{name: False})
    rows["all"] = EfficientS1(BETA, **passes)
    rows["all, 3 epochs x 30"] = EfficientS1(BETA)
    rows["certainty equivalence"] = CertaintyEquivalence(BETA)
    return rows


def main() -> None:
    n_seeds = int(sys.argv[1]) if len(sys.argv) > 1 else 20
    mdp, prior = WindyCliffEnv().mdp, np.full((15, 4), 0.25)
    exact = solve_soft_bellman(mdp, BETA)
    rows = learners()
    gap, kl, passes = (np.empty((len(rows), n_seeds)) for _ in range(3))
    for seed in tqdm(range(n_seeds), disable=None):
        data = collect(mdp, 500, 1000, seed)
        for i, learner in enumerate(rows.values()):
            solution = learner.fit(data, 15, 4)
            policy = solution.policy.numpy()
            gap[i, seed] = -exact.theta - objective(mdp, policy, prior, BETA)
            kl[i, seed] = kl_per_state(exact.policy.numpy(), policy).mean()
            passes[i, seed] = solution.n_steps / len(data)
    command = f"python benchmarks/ablation.py {n_seeds}"
    write_json(
        RESULTS / "ablation.json",
        {"command": command, "rows": list(rows), "gap": gap.tolist(), "kl": kl.tolist(), "passes": passes.tolist()},
    )
    lines = [
        "# From Algorithm S1 to the statistical limit, a change at a time\n",
        f"    {command}\n",
        f"Windy cliff, beta 10, 500,000 tuples of the uniform prior, at most 90 passes, {n_seeds} streams; every",
        "row sees the same streams. Loss: g* - J of the last policy in the true MDP, reward a step. KL(optimal ||",
        "learnt): mean over states, each counted alike (README's table weights them as the optimal policy visits",
        "them). Published S1 is `s1_listing`, as the paper lists it. x CE: mean over that of certainty equivalence,",
        "which is what the data allow.\n",
        "| learner | mean loss | x CE | largest loss | mean KL | x CE | passes |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, g, k, n in zip(rows, gap, kl, passes, strict=True):
        lines.append(
            f"| {name} | {g.mean():.2e} | {g.mean() / gap[-1].mean():.2f} | {g.max():.2e} "
            f"| {k.mean():.2e} | {k.mean() / kl[-1].mean():.2f} | {n.mean():.0f} |"
        )
    lines += [
        "\nThe rewards of the cliff do not vary for the same (s,a), so the mean reward has nothing to do here, and the",
        "published steps never meet the certificate. Without a warm start each iteration begins with rho = exp(-beta),",
        "here 29 nats above its value (Delta is 2.9); a falling lr_rho of .005/15 does not get down in 15 epochs. With",
        "`lr_rho=0.005` that variant was certified to 4e-5 on one stream.\n",
        "![loss of each variant](ablation.png)",
    ]
    (RESULTS / "ablation.md").write_text("\n".join(lines) + "\n")
    draw(list(rows), gap, RESULTS / "ablation.png")
    print("\n".join(lines))


def draw(names: list[str], gap: np.ndarray, path: Path) -> None:
    figure = Figure(figsize=(8, 0.3 * len(names) + 1.4), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    limit = gap[-1].mean()
    for y, row in enumerate(gap):
        color = "C3" if y == 0 else "C2" if y >= len(names) - 3 else "C0"
        axes.plot(row, np.full(len(row), y), ".", color=color, alpha=0.35, markersize=4, label="one stream" * (y == 1))
        axes.plot(row.mean(), y, "D", color=color, markersize=6, label="mean" * (y == 1))
    axes.axvline(limit, color="black", lw=1, label="certainty equivalence, mean")
    axes.axvspan(limit, 1.25 * limit, color="black", alpha=0.12, lw=0, label="up to 1.25 times that")
    axes.set_yticks(range(len(names)), names)
    axes.invert_yaxis()
    axes.set_xscale("log")
    axes.set_xlabel("loss g* - J of the last policy in the true MDP (reward a step)")
    axes.set_title(f"Windy cliff, beta 10, 500,000 tuples, {gap.shape[1]} streams")
    axes.grid(axis="x", alpha=0.3)
    axes.legend(loc="lower right", fontsize=8)
    figure.savefig(path, dpi=130)


if __name__ == "__main__":
    main()
