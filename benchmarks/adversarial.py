"""Bounds, gaps and statuses on problems made to break them, held against many digits (``tests/many_digits.py``).

    python benchmarks/adversarial.py [n=10000] [seed=0] [workers=1] [to=FILE.jsonl] [page=docs/results/adversarial]
    python benchmarks/adversarial.py one=NUMBER [seed=0]     one problem, in this process
    python benchmarks/adversarial.py before=TREE ...         beside the package of another tree (or its `to=` FILE)
    python benchmarks/adversarial.py from=FILE.jsonl ...     tables of an earlier run

Each problem: both solvers, and ``certify`` of the policies of ``many_digits.policies``. They run in processes of their
own, so that one that dies is counted, named, and left out.
"""

from __future__ import annotations

import collections
import json
import os
import signal
import subprocess
import sys
import time
import traceback
import warnings
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "tests"))

import numpy as np  # noqa: E402
import torch  # noqa: E402
from many_digits import KINDS, Given, NoRateError, Oracle, Rate, policies, problem  # noqa: E402
from mpmath import mp, mpf  # noqa: E402

from erl_torch import InputError, TabularMDP, certify, evaluation, solve_biasing, solve_soft_bellman  # noqa: E402
from erl_torch.solvers import policy as exact_policy  # noqa: E402

try:
    from erl_torch.solvers import certificates
except ImportError:  # an earlier package
    certificates = None

# Biasing iterations that converge have done so by then; 200 of those that do not take seconds.
SOLVERS: dict[str, Any] = {"soft policy iteration": solve_soft_bellman, "biasing": partial(solve_biasing, max_steps=50)}
TOL = 1e-10  # of the solvers, by default
ORACLE_SECONDS = 60
COUNTED = ("problems", "violations", "died", "no oracle", "infinite bounds", "no gap")  # columns


class TooLongError(ArithmeticError):
    """The oracle took longer than it may."""


def _too_long(*_: Any) -> None:
    raise TooLongError(f"more than {ORACLE_SECONDS} s")


def examine(given: Given, seed: int, certifying: bool = True) -> dict[str, Any]:
    """Statuses, seconds and violations of one problem; ``certifying``: gaps and objectives too."""
    warnings.simplefilter("ignore")
    out: dict[str, Any] = {"kind": given.kind, "size": list(given.reward.shape), "wrong": [], "infinite": 0, "none": 0}
    oracle = Oracle(given)
    found = {}
    tick = time.process_time()
    try:
        mdp = TabularMDP(given.transition, given.reward, given.start)
    except InputError as error:
        return out | {"refused": str(error), "status": dict.fromkeys(SOLVERS, "refused")}
    out["status"] = {}
    for name, solve in SOLVERS.items():
        try:
            found[name] = solve(mdp, given.beta, given.prior)
            out["status"][name] = found[name].status.name
        except InputError as error:
            out["status"][name] = "refused"
            out["refused"] = str(error)
        except Exception as error:
            out["status"][name] = "raised"
            _wrong(out, name, f"raised {type(error).__name__}: {error}", traceback.format_exc())
    out["seconds"] = time.process_time() - tick
    tick = time.process_time()
    handler = signal.signal(signal.SIGALRM, _too_long)
    signal.alarm(ORACLE_SECONDS)
    try:
        value = next((s.value.numpy() for s in found.values() if s.status.name == "CONVERGED"), None)
        rate = oracle.rate(value)
    except (NoRateError, TooLongError) as error:
        return out | {"no_oracle": repr(error)}
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, handler)
    out["oracle_seconds"] = time.process_time() - tick
    for name, solution in found.items():
        out["infinite"] += not np.isfinite(solution.theta_bounds).all()
        check_solution(out, name, solution, rate)
        if certifying:
            check_gap(out, f"gap of {name}", solution, rate, oracle.worth(solution.policy.numpy()))
    if certifying and "soft policy iteration" in found:
        certified(out, oracle, mdp, rate, found["soft policy iteration"], seed)
    return out


def _wrong(out: dict[str, Any], where: str, what: str, size: Any = 0.0) -> None:
    out["wrong"].append([where, what, size if isinstance(size, str) else float(size)])


def check_solution(out: dict[str, Any], name: str, solution: Any, rate: Rate) -> None:
    low, high = solution.theta_bounds
    if np.isnan([low, high]).any() or not torch.isfinite(solution.policy).all():
        _wrong(out, name, "NaN in bounds or policy")
        return
    # theta* = -g* lies in [-g.high, -g.low] of the oracle.
    size = max(mpf(low) + max(rate.low), -min(rate.high) - mpf(high))
    if size > 0:
        _wrong(out, name, f"bounds {low!r}, {high!r} miss theta* by {mp.nstr(size, 3)}", size)
    if solution.value is not None and torch.isnan(solution.value).any():
        _wrong(out, name, "NaN in value")
    if solution.status.name == "CONVERGED":
        if solution.theta is None or not np.isfinite(solution.theta):
            _wrong(out, name, f"CONVERGED with theta {solution.theta}")
            return
        theta = mpf(solution.theta)
        off = max(theta + max(rate.low), -min(rate.high) - theta)
        seen = max(abs(rate.low[0]), abs(rate.high[0]), rate.seen)
        if off > 2 * TOL * seen:
            _wrong(out, name, f"CONVERGED, theta {solution.theta!r} is off by {mp.nstr(off, 3)}", off / (seen or 1))
    elif solution.status.name == "REDUCIBLE" and solution.theta is not None:
        spread = max(rate.low) - min(rate.high)
        if spread > 0:
            _wrong(out, name, f"REDUCIBLE with theta {solution.theta!r}; theta* differs by {mp.nstr(spread, 3)}")


def check_gap(out: dict[str, Any], where: str, solution: Any, rate: Rate, worth: mpf) -> None:
    if solution.gap is None:
        out["none"] += 1
        return
    short = rate.start_low - worth - mpf(solution.gap) if np.isfinite(solution.gap) else mpf(0)
    if np.isnan(solution.gap):
        _wrong(out, where, "NaN")
    elif short > 0:
        loss = rate.start_low - worth
        _wrong(out, where, f"{solution.gap!r} is below the true loss {mp.nstr(loss, 17)}", short)


def certified(out: dict[str, Any], oracle: Oracle, mdp: TabularMDP, rate: Rate, best: Any, seed: int) -> None:
    """``certify`` and the routes to the objective, for policies that are not the solver's."""
    given = oracle.given
    total = given.prior.astype(float)
    total /= total.sum(1, keepdims=True)
    judge = evaluation.Judge(mdp, total, 10)
    for name, policy in policies(given, best.policy.numpy(), seed).items():
        worth = oracle.worth(policy)
        try:
            new = certify(replace(best, policy=torch.from_numpy(policy)), mdp, given.beta, given.prior, best=best)
            check_gap(out, f"certify of {name}", new, rate, worth)
            if new.gap is None or not np.isfinite(new.gap):
                _wrong(out, f"certify of {name}", f"gap {new.gap}")
            if certificates is None:
                continue
            j = certificates.objective(mdp.transition, mdp.reward, total, given.beta, policy, mdp.start)
            out["infinite"] += not np.isfinite([j.low, j.high]).all()
            size = max(mpf(j.low) - worth, worth - mpf(j.high))
            if size > oracle.rounding:
                _wrong(out, f"objective of {name}", f"{j} leaves out {mp.nstr(worth, 17)}", size)
            routes = {
                "exact_policy.objective": exact_policy.objective(mdp, policy, total, given.beta),
                "Judge.objective": judge.objective(policy, given.beta),
            }
            for route, found in routes.items():
                # What is promised is that the value lies between the same ends as J does.
                if not j.low <= found <= j.high:
                    off = abs(mpf(found) - worth)
                    _wrong(out, f"{route} of {name}", f"{found!r} is not in {j.low!r}, {j.high!r}", off)
        except Exception as error:
            _wrong(out, f"certify of {name}", f"raised {type(error).__name__}: {error}", traceback.format_exc())


# -- processes --------------------------------------------------------------------------------------------------


def work(seed: int, first: int, end: int, certifying: bool) -> None:
    """Examine problems [first, end): a line before each, and a line of JSON after."""

    torch.set_num_threads(1)
    for number in range(first, end):
        print(number, flush=True)
        try:
            found = examine(problem(seed, number), seed, certifying)
        except Exception as error:
            found = {"kind": problem(seed, number).kind, "harness": f"{type(error).__name__}: {error}", "wrong": []}
            print(traceback.format_exc(), file=sys.stderr)
        print(json.dumps({"number": number, **found}), flush=True)


def collect(seed: int, first: int, end: int, tree: str, certifying: bool) -> list[dict[str, Any]]:
    """``work`` in processes; the next begins after the problem in which one died."""
    records: list[dict[str, Any]] = []
    environment = {**os.environ, "PYTHONPATH": tree}
    while first < end:
        command = [sys.executable, __file__, "work", str(seed), str(first), str(end), str(int(certifying))]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)
        assert process.stdout is not None
        begun = first
        for line in process.stdout:
            if line.startswith("{"):
                records.append(json.loads(line))
                begun = records[-1]["number"] + 1
            else:
                begun = int(line)
        code = process.wait()
        if begun < end:
            kind = problem(seed, begun).kind
            died = ["process", f"died with code {code}", 0.0]
            records.append({"number": begun, "kind": kind, "wrong": [died], "status": dict.fromkeys(SOLVERS, "died")})
        first = begun + 1
    return records


def run(seed: int, n: int, workers: int, tree: str, certifying: bool, to: Path | None) -> list[dict[str, Any]]:
    chunk = 250
    records: list[dict[str, Any]] = []
    with ThreadPoolExecutor(workers) as pool:
        parts = [pool.submit(collect, seed, i, min(i + chunk, n), tree, certifying) for i in range(0, n, chunk)]
        for part in parts:
            records += part.result()
            wrong = sum(bool(r["wrong"]) for r in records)
            print(f"{len(records)} of {n}, {wrong} with a violation", file=sys.stderr, flush=True)
            if to:
                to.write_text("".join(json.dumps(r) + "\n" for r in records))
    return records


# -- tables -----------------------------------------------------------------------------------------------------


def count(records: list[dict[str, Any]], old: list[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """By kind: problems, violations, statuses of each solver, CONVERGED before and now on the problems of ``old``."""
    table: dict[str, dict[str, Any]] = {}
    both = {r["number"] for r in old}
    for kind in [make.__name__ for make in KINDS]:
        of_kind = [r for r in records if r["kind"] == kind]
        before = [r for r in old if r["kind"] == kind]
        row: dict[str, Any] = {"problems": len(of_kind)}
        row["violations"] = sum(bool(r["wrong"]) for r in of_kind)
        row["died"] = sum(w[0] == "process" for r in of_kind for w in r["wrong"])
        row["no oracle"] = sum("no_oracle" in r or "harness" in r for r in of_kind)
        row["infinite bounds"] = sum(r.get("infinite", 0) for r in of_kind)
        row["no gap"] = sum(r.get("none", 0) for r in of_kind)
        for name in SOLVERS:
            row[name] = dict(collections.Counter(r.get("status", {}).get(name, "none") for r in of_kind))
            again = [r for r in of_kind if r["number"] in both]
            row[f"{name}, of these"] = dict(collections.Counter(r.get("status", {}).get(name, "none") for r in again))
            row[f"{name}, before"] = dict(collections.Counter(r.get("status", {}).get(name, "none") for r in before))
            row[f"{name}, CONVERGED but wrong before"] = sum(wrongly_converged(r, name) for r in before)
        table[kind] = row
    return table


def wrongly_converged(record: dict[str, Any], name: str) -> bool:
    return record.get("status", {}).get(name) == "CONVERGED" and any(w[0] == name for w in record["wrong"])


def page(table: dict[str, dict[str, Any]], records: list[dict[str, Any]], command: str) -> str:
    total = sum(row["problems"] for row in table.values())
    n_before = sum(sum(row[f"{name}, before"].values()) for row in table.values() for name in list(SOLVERS)[:1])
    lines = [
        "# Bounds on problems made to break them",
        "",
        f"    {command}",
        "",
        f"{total:,} problems of `tests/many_digits.py` (1 to 60 states, 1 to 4 actions), each with both solvers",
        "(biasing: at most 50 iterations) and `certify` of five policies (random, the same in single precision,",
        "greedy, one that stays put, and the same with some 1e-180 of anything else), held against an",
        "oracle of 50 to 950 digits. A violation is any of: bounds that leave out theta*, a gap below the true loss,",
        "an objective outside its bounds, CONVERGED with theta further off than the tolerance, NaN, an exception, a",
        "process that dies. *No oracle*: its bounds did not meet in the digits or the time that it has; there, all",
        "that is checked is that nothing is raised.",
        "",
        "Infinite bounds and gaps that are not given are counted, of both solvers and all policies. Share CONVERGED:",
        "of all problems of the kind. *Before*: the package before its bounds were theorems of floating point too, on",
        f"{n_before:,} of them, less those whose theta or bounds were wrong (their number in brackets); *now*: on the",
        "same.",
        "",
        "| kind | problems | violations | died | no oracle | infinite bounds | no gap "
        "| soft policy iteration | now | before | biasing | now | before |",
        "|---" * 13 + "|",
    ]
    for kind, row in table.items():
        cells = [kind.replace("_", " "), *(row[key] for key in COUNTED)]
        for name in SOLVERS:
            cells += [_share(row[name]), _share(row[f"{name}, of these"])]
            cells += [_share(row[f"{name}, before"], row[f"{name}, CONVERGED but wrong before"])]
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    lines += ["", "| solver | " + " | ".join(statuses := _statuses(table)) + " |", "|---|" + "---|" * len(statuses)]
    for name in SOLVERS:
        for when in ("", ", before"):
            sums = [sum(row[name + when].get(status, 0) for row in table.values()) for status in statuses]
            if any(sums):
                lines.append(f"| {name}{when} | " + " | ".join(map(str, sums)) + " |")
    bad = [(r["number"], r["kind"], *w) for r in records for w in r["wrong"]]
    if bad:
        lines += ["", "Violations (at most 40; `one=NUMBER` runs a problem):", ""]
        bad.sort(key=lambda b: -b[4] if isinstance(b[4], float) else -np.inf)
        lines += [f"- {number} ({kind}), {where}: {what}" for number, kind, where, what, _ in bad[:40]]
    return "\n".join(lines) + "\n"


def _share(statuses: dict[str, int], wrong: int = 0) -> str:
    n = sum(statuses.values())
    if not n:
        return ""
    return f"{(statuses.get('CONVERGED', 0) - wrong) / n:.1%}" + (f" ({wrong})" if wrong else "")


def _statuses(table: dict[str, dict[str, Any]]) -> list[str]:
    keys = [name + when for name in SOLVERS for when in ("", ", before")]
    return sorted({status for row in table.values() for key in keys for status in row[key]})


def main(arguments: list[str]) -> None:
    if arguments[:1] == ["work"]:
        seed, first, end, certifying = map(int, arguments[1:])
        work(seed, first, end, bool(certifying))
        return
    given = dict(argument.split("=", 1) for argument in arguments)
    seed = int(given.get("seed", 0))
    if "one" in given:
        print(json.dumps(examine(problem(seed, int(given["one"])), seed), indent=2))
        return
    n, workers = int(given.get("n", 10_000)), int(given.get("workers", 1))
    to = Path(given["to"]) if "to" in given else None
    if "from" in given:
        records = [json.loads(line) for line in Path(given["from"]).read_text().splitlines()]
    else:
        records = run(seed, n, workers, str(ROOT), True, to)
    old: list[dict[str, Any]] = []
    if "before" in given:
        tree = Path(given["before"])
        if tree.is_file():
            old = [json.loads(line) for line in tree.read_text().splitlines()]
        else:
            old = run(seed, n, workers, str(tree), False, to and to.with_suffix(".before.jsonl"))
    table = count(records, old)
    text = page(table, records, f"python benchmarks/adversarial.py n={n} seed={seed}")
    print(text)
    if "page" in given:
        Path(given["page"]).with_suffix(".md").write_text(text)
        Path(given["page"]).with_suffix(".json").write_text(json.dumps(table, indent=1) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
