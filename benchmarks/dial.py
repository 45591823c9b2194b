"""The dial on random problems, held against many digits (``tests/dial_digits.py``): docs/results/dial.md.

    python benchmarks/dial.py [quick] [n=5000] [seed=0] [workers=2] [to=runs/dial.jsonl] [page=docs/results/dial]
    python benchmarks/dial.py one=NUMBER [seed=0]     one problem, in this process

``quick``: n=200, and no page. Killed and started again with the same ``to``, it goes on. Each problem has one optimism;
dense, sparse, periodic, deterministic and nearly closed (to 1e-8) ones alternate.

Run beside the package, and written from the equations: Newton on V + g = TV without any safeguard, and (below optimism
0) the game itself, in which nature picks distributions q and pays KL(q || p)/|kappa| (``Oracle.game``).
"""

from __future__ import annotations

import json
import os
import sys
import time
import warnings
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(variable, "1")

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "tests"))

import numpy as np  # noqa: E402
from dial_digits import KINDS, OPTIMISMS, Answer, Oracle, problem  # noqa: E402
from many_digits import Given  # noqa: E402
from mpmath import mpf  # noqa: E402

from erl_torch import Solution, TabularMDP, solve_biasing, solve_soft_bellman  # noqa: E402

NARROW = 1e-8  # of the bounds, in rewards (which are standard normal), at which a problem counts as solved
GAME = 1e-20  # of the players' values from the answer
STEPS = 100
SOLVERS = ("solve_soft_bellman", "plain Newton", "solve_biasing")


# -- written here -----------------------------------------------------------------------------------------------


def gains(given: Given, kappa: float, value: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(TV - V [S], pi_V [S, A], q_V [S, A, S])."""
    p, apart = given.transition, value[None, :] - value[:, None]
    if kappa:
        x = np.where(p > 0, kappa * apart[:, None, :], -np.inf)
        top = x.max(2, keepdims=True)
        weight = p * np.exp(x - top)
        total = weight.sum(2, keepdims=True)
        q, sure = weight / total, (top + np.log(total))[:, :, 0] / kappa
    else:
        q, sure = p, (p * apart[:, None, :]).sum(2)
    policy, gain = choice(given, given.reward + sure)
    return gain, policy, q


def choice(given: Given, worth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(policy ~ prior exp(beta worth), (1/beta) log of its sum) of a table [S, A]."""
    top = worth.max(1, keepdims=True)
    weight = given.prior * np.exp(given.beta * (worth - top))
    total = weight.sum(1, keepdims=True)
    return weight / total, (top + np.log(total) / given.beta)[:, 0]


def poisson(chain: np.ndarray, reward: np.ndarray) -> tuple[float, np.ndarray]:
    """(g, V) of V + g = reward + chain V, V(0) = 0."""
    system = np.eye(len(chain)) - chain
    system[:, 0] = 1.0
    found = np.linalg.solve(system, reward)
    return float(found[0]), np.append(0.0, found[1:])


def plain_newton(given: Given, optimism: float) -> tuple[float, int]:
    """(narrowest width of min and max of TV - V, steps)."""
    kappa, value, best = optimism * given.beta, np.zeros(len(given.reward)), np.inf
    for step in range(STEPS):
        gain, policy, q = gains(given, kappa, value)
        if not np.isfinite(gain).all():
            return best, step
        best = min(best, float(np.ptp(gain)))
        if best <= NARROW:
            return best, step
        try:
            value = value + poisson(np.einsum("sa,sat->st", policy, q), gain)[1]
        except np.linalg.LinAlgError:
            return best, step
    return best, STEPS


def rates(given: Given, optimism: float, steps: int = 16_384) -> tuple[np.ndarray, np.ndarray]:
    """(rate of each start by value iteration, how far to trust it), for problems without a single one."""
    value, kept = np.zeros(len(given.reward)), {}
    for step in range(1, steps + 1):
        value = value + gains(given, optimism * given.beta, value)[0]
        if step in (steps // 4, steps // 2, steps):
            kept[step] = value
    late = (kept[steps] - kept[steps // 2]) / (steps // 2)
    early = (kept[steps // 2] - kept[steps // 4]) / (steps // 4)
    return late, np.abs(late - early) + 1e-9


# -- one problem ------------------------------------------------------------------------------------------------


def examine(seed: int, number: int) -> dict[str, Any]:
    """What is found of a problem; ``wrong`` names each bound that is passed."""
    given, optimism = problem(seed, number)
    oracle = Oracle(given, optimism)
    begun = time.perf_counter()
    answer = oracle.solve()
    found: dict[str, Any] = {
        "number": number, "kind": given.kind, "optimism": optimism, "shape": list(given.reward.shape),
        "beta": given.beta, "single": answer.met, "g": float(answer.low), "g_high": float(answer.high),
        "oracle_seconds": time.perf_counter() - begun, "wrong": [], "width": {}, "status": {}, "steps": {},
    }  # fmt: skip
    mdp = TabularMDP(given.transition, given.reward, given.start)
    # Solvers may warn of numbers out of range on their way; what they return is looked at.
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        for name, solve in (("solve_soft_bellman", solve_soft_bellman), ("solve_biasing", solve_biasing)):
            try:
                solution = solve(mdp, given.beta, given.prior, max_steps=200, optimism=optimism)
            except Exception as error:
                found["wrong"].append(f"{name}: {type(error).__name__}: {error}")
                found["status"][name], found["width"][name], found["steps"][name] = "raised", None, 0
                continue
            assert solution.theta_bounds is not None
            found["status"][name] = solution.status.name
            found["steps"][name] = solution.n_steps
            width = solution.theta_bounds[1] - solution.theta_bounds[0]
            found["width"][name] = float(width) if np.isfinite(width) else None
            found["wrong"] += [f"{name}: {what}" for what in passed(given, oracle, answer, solution)]
        width, steps = plain_newton(given, optimism)
        found["width"]["plain Newton"], found["steps"]["plain Newton"] = width if np.isfinite(width) else None, steps
    if optimism < 0 and answer.met:
        secured, held = oracle.game()
        found["game"] = float(max(abs(secured - answer.low), abs(held - answer.high)))
    return found


def passed(given: Given, oracle: Oracle, answer: Answer, solution: Solution) -> list[str]:
    """The claims of a solution that are wrong."""
    assert solution.theta_bounds is not None
    low, high = -mpf(solution.theta_bounds[1]), -mpf(solution.theta_bounds[0])
    wrong = []
    if answer.met and not (low <= answer.low and answer.high <= high):
        wrong.append(f"g* = {float(answer.low)!r} is not in {float(low)!r}, {float(high)!r}")
    if not answer.met:
        rate, trust = rates(given, oracle.optimism)
        if not (float(low) <= rate.min() + trust.max() and rate.max() - trust.max() <= float(high)):
            wrong.append(f"rates {rate.tolist()} (+- {trust.max():.1g}) are not in {float(low)!r}, {float(high)!r}")
        if solution.status.name == "CONVERGED":
            wrong.append("CONVERGED without a single rate")
    if solution.gap is None:
        wrong.append("no gap")
    elif answer.met:
        worth = oracle.worth(solution.policy.numpy(), answer.value)
        if answer.high - worth.high > mpf(solution.gap):
            wrong.append(f"loss {float(answer.low - worth.high):.3g} exceeds gap {solution.gap:.3g}")
    return wrong


# -- all of them ------------------------------------------------------------------------------------------------


def run(seed: int, n: int, workers: int, to: Path) -> list[dict[str, Any]]:
    """The records of problems 0 to n - 1; those that ``to`` holds are not made again."""
    records = {}
    if to.exists():
        whole = [line for line in to.read_text().splitlines() if line.endswith("}")]
        records = {r["number"]: r for r in map(json.loads, whole) if r["number"] < n}
        to.write_text("".join(json.dumps(r) + "\n" for r in records.values()))
    left = [number for number in range(n) if number not in records]
    to.parent.mkdir(parents=True, exist_ok=True)
    with to.open("a") as file, ProcessPoolExecutor(workers) as pool:
        for record in pool.map(examine, [seed] * len(left), left, chunksize=8):
            records[record["number"]] = record
            file.write(json.dumps(record) + "\n")
            file.flush()
            if len(records) % 200 == 0:
                wrong = sum(bool(r["wrong"]) for r in records.values())
                print(f"{len(records)} of {n}, {wrong} with a bound that is passed", file=sys.stderr, flush=True)
    return [records[number] for number in sorted(records)]


def row(records: list[dict[str, Any]]) -> dict[str, Any]:
    """Figures of some problems."""
    found: dict[str, Any] = {"problems": len(records), "wrong": sum(bool(r["wrong"]) for r in records)}
    single = [r for r in records if r["single"]]
    found["single rate"] = len(single)
    for name in SOLVERS:
        found[name] = sum(r["width"][name] is not None and r["width"][name] <= NARROW for r in records)
    for name in ("solve_soft_bellman", "solve_biasing"):
        found[f"{name}, status"] = dict(Counter(r["status"][name] for r in records))
    games = [r["game"] for r in single if "game" in r]
    found["games"], found["games met"] = len(games), sum(x <= GAME for x in games)
    return found


def page(records: list[dict[str, Any]], command: str) -> tuple[str, dict[str, Any]]:
    """(the page, its figures)."""
    wrong = [[r["number"], *r["wrong"]] for r in records if r["wrong"]]
    figures: dict[str, Any] = {
        "command": command, "problems": len(records), "wrong": wrong,
        "by optimism": {f"{x:g}": row([r for r in records if r["optimism"] == x]) for x in OPTIMISMS},
        "by kind": {kind: row([r for r in records if r["kind"] == kind]) for kind in KINDS},
    }  # fmt: skip
    lines = [
        "# The dial",
        "",
        f"    {command}",
        "",
        f"{len(records):,} random problems (2 to 7 states, 1 to 4 actions, standard normal rewards, beta .1 to 30; a",
        "fifth each dense, sparse, periodic, deterministic, and nearly closed, to 1e-8), each at one optimism.",
        "",
        "- *Passed*: the answer, in 60 to 400 digits (`tests/dial_digits.py`), passes a bound of either solver, on",
        "  theta* or on the loss of the policy; or a solver ended CONVERGED where there is no single rate.",
        "- *Single rate*: the answer's own bounds meet. Where they do not ([theory](../theory.md), 9.6), the rates of",
        "  value iteration from every state have to lie between the solver's bounds.",
        f"- *Solved*: bounds no wider than {NARROW:g}. *Plain Newton* is Newton's method on V + g = TV without a",
        f"  safeguard, from V = 0, in at most {STEPS} steps; written in the benchmark.",
        "- *Game*: an independent max-min solver, in many digits, that knows distributions and their KL alone:",
        f"  problems with a single rate on which what each player can secure is within {GAME:g} of the answer.",
        "",
        "| optimism | problems | passed | single rate | solved: `solve_soft_bellman` | plain Newton | `solve_biasing` "
        "| NO_SINGLE_RATE | game |",
        "|---" * 9 + "|",
    ]
    for name, f in {**figures["by optimism"], **figures["by kind"]}.items():
        lost = f["solve_soft_bellman, status"].get("NO_SINGLE_RATE", 0)
        game = f"{f['games met']} of {f['games']}" if f["games"] else ""
        cells = (name, f["problems"], f["wrong"], f["single rate"], *(f[s] for s in SOLVERS), lost, game)
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    lines += ["", "Statuses of `solve_soft_bellman`: " + _statuses(records, "solve_soft_bellman") + "."]
    lines += ["", "Of `solve_biasing`: " + _statuses(records, "solve_biasing") + "."]
    if figures["wrong"]:
        lines += ["", "Passed (`one=NUMBER` runs a problem):", ""]
        lines += [f"- {number}: {'; '.join(what)}" for number, *what in figures["wrong"][:40]]
    return "\n".join(lines) + "\n", figures


def _statuses(records: list[dict[str, Any]], name: str) -> str:
    return ", ".join(f"{status} {n}" for status, n in Counter(r["status"][name] for r in records).most_common())


def main(arguments: list[str]) -> None:
    quick = "quick" in arguments
    given = dict(argument.split("=", 1) for argument in arguments if argument != "quick")
    seed = int(given.get("seed", 0))
    if "one" in given:
        print(json.dumps(examine(seed, int(given["one"])), indent=1))
        return
    n = int(given.get("n", 200 if quick else 5000))
    to = Path(given.get("to", ROOT / "runs" / f"dial{'-quick' if quick else ''}-seed{seed}.jsonl"))
    records = run(seed, n, int(given.get("workers", 2)), to)
    text, figures = page(records, f"python benchmarks/dial.py n={n} seed={seed}")
    print(text)
    at = given.get("page", None if quick else str(ROOT / "docs" / "results" / "dial"))
    if at:
        Path(at).with_suffix(".md").write_text(text)
        Path(at).with_suffix(".json").write_text(json.dumps(figures, indent=1) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
