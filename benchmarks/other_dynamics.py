"""Other dynamics from the same tuples: docs/results/other_dynamics.md.

    python benchmarks/other_dynamics.py [n=300] [n_tuples=20000] [seed=0] [to=runs/other_dynamics.jsonl]
        [page=docs/results/other_dynamics]

Killed and started again with the same ``to``, it goes on.

Coverage: intervals for theta* under p^ from ``n`` datasets of dynamics p with weights p^/p, against the exact theta*.
The shift of Figure 4: learnt from tuples of the time before alone.
"""

from __future__ import annotations

import json
import os
import sys
import time
import warnings
from functools import partial
from pathlib import Path
from typing import Any

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(variable, "1")

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "tests"))

import numpy as np  # noqa: E402
from helpers import random_mdp  # noqa: E402

from erl_torch import (  # noqa: E402
    CertaintyEquivalence,
    EfficientS1,
    TabularMDP,
    Transitions,
    collect,
    empirical_mdp,
    for_dynamics,
    reweighted,
    solve_soft_bellman,
    theta_uncertainty,
)
from erl_torch.empirical.uncertainty import _effective, _rows, _worth  # noqa: E402
from erl_torch.envs import dynamics_shift  # noqa: E402
from erl_torch.notes import Note  # noqa: E402
from erl_torch.solvers.policy import objective  # noqa: E402

BETA, SHAPE, OPTIMISMS = 2.0, (8, 3), (0.0, -1.0)
T95 = 1.959964
SHIFT_BETA = 15.0


def _at(table: np.ndarray, s: np.ndarray, a: np.ndarray, s_next: np.ndarray) -> np.ndarray:
    return np.asarray(table[s, a, s_next])


def cases(rng: np.random.Generator, mdp: TabularMDP) -> dict[str, np.ndarray]:
    """Ratios p^/p [S, A, S] by name."""
    p = mdp.transition.toarray().reshape(*SHAPE, -1)
    value = solve_soft_bellman(mdp, BETA).value.numpy()
    x = (value - value.mean()) / value.std()
    tilts = {
        "mild random shift": 0.35 * rng.standard_normal(p.shape),
        "w rises with V": 0.6 * x + 0 * p,
        "w falls in the tails": -1.2 * np.abs(x) + 0 * p,
    }
    ratios = {}
    for name, tilt in tilts.items():
        other = p * np.exp(tilt)
        ratios[name] = other / other.sum(-1, keepdims=True) / p
    return ratios


def noisy(data: Transitions, rng: np.random.Generator) -> Transitions:
    r = data.r + 0.1 * rng.standard_normal(len(data))
    return Transitions(data.s, data.a, r, data.s_next, data.a_next)


def kish_error(weighted: Transitions, optimism: float) -> float:
    """The standard error of theta with Kish's effective sample size in place of n."""
    model = empirical_mdp(weighted, *SHAPE)
    empirical = model.problem(BETA, optimism=optimism)
    solution = CertaintyEquivalence(BETA, optimism=optimism).solve(model)
    states = empirical.problem.states
    here = _worth(empirical.problem, solution.policy.numpy()[states], solution.value.numpy()[states])
    d = np.zeros(SHAPE)
    d[states] = here.d
    rows = _rows(model, empirical, here)
    return float(np.sqrt((d**2 * rows.variance / np.maximum(_effective(model), 1.0)).sum()))


def coverage(n: int, n_tuples: int, seed: int, to: Path) -> list[dict[str, Any]]:
    rng = np.random.default_rng(seed)
    mdp = random_mdp(rng, *SHAPE)
    ratios = cases(rng, mdp)
    p = mdp.transition.toarray().reshape(*SHAPE, -1)
    exact = {
        (name, x): solve_soft_bellman(TabularMDP(p * ratio, mdp.reward), BETA, optimism=x).theta
        for name, ratio in ratios.items()
        for x in OPTIMISMS
    }
    to.parent.mkdir(parents=True, exist_ok=True)
    to.touch()
    known = [record for record in map(json.loads, to.read_text().splitlines()) if record["seed"] == [seed, n_tuples]]
    for i in range(len(known), n):
        data = noisy(collect(mdp, 1, n_tuples, 10_000 * seed + i), np.random.default_rng([seed, i]))
        known.append({"seed": [seed, n_tuples], "found": []})
        for (name, x), theta in exact.items():
            weighted = reweighted(data, partial(_at, ratios[name]))
            estimate = theta_uncertainty(empirical_mdp(weighted, *SHAPE), BETA, optimism=x)
            low, high = estimate.interval()
            error = kish_error(weighted, x)
            off = estimate.value - theta
            figures = [bool(low <= theta <= high), off / estimate.standard_error, off / error, high - low]
            known[-1]["found"].append(figures)
        with to.open("a") as file:
            file.write(json.dumps(known[-1]) + "\n")
    rows = []
    for k, (name, x) in enumerate(exact):
        inside, z, of_kish, width = np.array([record["found"][k] for record in known[:n]], float).T
        rows.append({
            "case": name, "max w": float(ratios[name].max()), "optimism": x, "n": len(inside),
            "covered": float(inside.mean()), "symmetric": float((np.abs(z) <= T95).mean()), "sd z": float(z.std()),
            "kish": float((np.abs(of_kish) <= T95).mean()), "kish sd z": float(of_kish.std()),
            "width": float(width.mean()),
        })  # fmt: skip
    return rows


def shift(up_success: float, lengths: tuple[int, ...]) -> list[dict[str, Any]]:
    before, after = (grid.mdp() for grid in dynamics_shift(up_success))
    shape = (16, 4, 16)
    p, q = before.transition.toarray().reshape(shape), after.transition.toarray().reshape(shape)
    ratio = np.divide(q, p, out=np.zeros(shape), where=p > 0)
    best = solve_soft_bellman(after, SHIFT_BETA)

    def loss(policy: Any) -> float:
        return -best.theta - float(objective(after, np.asarray(policy), np.full((16, 4), 0.25), SHIFT_BETA))

    rows = []
    for n in lengths:
        data = collect(before, n // 1000, 1000, seed=0)
        old = CertaintyEquivalence(SHIFT_BETA).fit(data, 16, 4)
        given = CertaintyEquivalence(SHIFT_BETA).solve(for_dynamics(data, after))
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always", Note)
            weighted = reweighted(data, lambda s, a, t: ratio[s, a, t])
        ce = CertaintyEquivalence(SHIFT_BETA).fit(weighted, 16, 4)
        streamed = EfficientS1(SHIFT_BETA).fit(weighted, 16, 4)
        estimate = theta_uncertainty(empirical_mdp(weighted, 16, 4), SHIFT_BETA)
        rows.append({
            "up": up_success, "tuples": len(data), "theta": best.theta, "loss of the old policy": loss(old.policy),
            "target theta": given.theta, "target loss": loss(given.policy),
            "weights": str(estimate), "weights loss": loss(ce.policy), "efficient theta": streamed.theta,
            "efficient loss": loss(streamed.policy), "weights theta": ce.theta, "notes": [str(w.message) for w in told],
        })  # fmt: skip
    return rows


def page(rows: list[dict[str, Any]], shifts: list[dict[str, Any]], command: str, n_tuples: int) -> str:
    lines = [
        "# Other dynamics from the same tuples",
        "",
        f"    {command}",
        "",
        f"**Intervals.** {rows[0]['n']} datasets of {n_tuples:,} tuples of one random problem (8 states, 3 actions,",
        "beta 2; normal noise of .1 in the rewards), weighted by p^/p, against the exact theta* under p^.",
        "*Covered*: the 95% interval of `theta_uncertainty`; *sandwich* and *Kish*: value -+ 1.96 standard errors,",
        "with the sandwich or with Kish's effective sample size in place of n; sd z: of (estimate - exact) / error.",
        "",
        "| case | largest w | optimism | covered | sandwich | sd z | Kish | sd z | mean width |",
        "|---" * 9 + "|",
    ]
    for r in rows:
        lines.append(
            f"| {r['case']} | {r['max w']:.1f} | {r['optimism']:g} | {r['covered']:.3f} | {r['symmetric']:.3f} "
            f"| {r['sd z']:.2f} | {r['kish']:.3f} | {r['kish sd z']:.2f} | {r['width']:.4f} |"
        )
    lines += [
        "",
        '**The shift of Figure 4**: the motor for "up" breaks (beta 15), learnt from tuples of the time before alone',
        "(the prior acts). Loss: g* - J in the new dynamics, reward a step. *Target*: the new dynamics are given.",
        '*Weights*: only their ratio to the old. One use of "up" in a hundred failed; each counts a hundredfold.',
        "",
        "| up works with | tuples | exact theta | loss of the old policy | target: theta, loss | weights: certainty "
        "equivalence, loss | EfficientS1, loss | interval |",
        "|---" * 8 + "|",
    ]
    for r in shifts:
        lines.append(
            f"| {r['up']:g} | {r['tuples']:,} | {r['theta']:.6f} | {r['loss of the old policy']:.3g} "
            f"| {r['target theta']:.6f}, {r['target loss']:.1e} | {r['weights theta']:.5f}, {r['weights loss']:.1e} "
            f"| {r['efficient theta']:.5f}, {r['efficient loss']:.1e} | {r['weights']} |"
        )
    told = [f"- {r['tuples']:,} tuples, up {r['up']:g}: {text}" for r in shifts for text in r["notes"]]
    if told:
        lines += ["", "What `reweighted` says of them:", "", *told]
    return "\n".join(lines) + "\n"


def main(arguments: list[str]) -> None:
    given = dict(argument.split("=", 1) for argument in arguments)
    n, n_tuples, seed = (int(given.get(k, x)) for k, x in (("n", 300), ("n_tuples", 20_000), ("seed", 0)))
    began = time.perf_counter()
    lengths = (100_000, 1_000_000, 4_000_000) if n >= 300 else (100_000, 300_000)
    rows = coverage(n, n_tuples, seed, Path(given.get("to", ROOT / "runs" / "other_dynamics.jsonl")))
    shifts = [row for up in (1e-4, 0.01) for row in shift(up, lengths)]
    command = f"python benchmarks/other_dynamics.py n={n} n_tuples={n_tuples} seed={seed}"
    text = page(rows, shifts, command, n_tuples)
    print(text, f"{time.perf_counter() - began:.0f} s")
    at = Path(given.get("page", ROOT / "docs" / "results" / "other_dynamics"))
    at.with_suffix(".md").write_text(text)
    at.with_suffix(".json").write_text(json.dumps({"coverage": rows, "shift": shifts}, indent=1) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
