"""Rewards found again from behaviour: by the balanced flow, by raw feature matching, by likelihood; beside `imitation`.

    python benchmarks/inverse.py table [n]            three estimators, n repeats (150)
    python benchmarks/inverse.py cliff [n]            windy cliff: its exact distribution; 10,000 steps, n seeds (40)
    python benchmarks/inverse.py imitation PYTHON     tabular MCE IRL of `imitation`, run by another PYTHON (mce_irl.py)

Each writes its part of docs/results/inverse.json; all parts that are there become docs/results/inverse.md.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.optimize import minimize
from tqdm import tqdm

from erl_torch import TabularMDP, Transitions, collect, fit_reward, soft_bellman, solve_soft_bellman
from erl_torch.envs.windy_cliff import WindyCliffEnv
from erl_torch.files import write_json
from erl_torch.solvers.policy import objective

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "results" / "inverse.md"
CLIFF, BETA = WindyCliffEnv().mdp, 10.0
TRUTH = np.array([1.0, -0.5, 0.7])  # weights of the random problem
WARM = 2.0  # its beta
HEAD = """# Rewards found again from behaviour

    python benchmarks/inverse.py table, then cliff, then imitation PYTHON

The estimators: [Which reward explains this behaviour?](../inverse.md); proofs: [Theory](../theory.md).
"""


def counts(data: Transitions, shape: tuple[int, ...]) -> np.ndarray:
    """n(s, a)."""
    found = np.zeros(shape)
    np.add.at(found, (data.s, data.a), 1.0)
    return found


def maximised(
    mdp: TabularMDP, beta: float, features: np.ndarray, goal: Callable[..., torch.Tensor], penalty: float = 0.0
) -> np.ndarray:
    """The weights [F] at which ``goal`` (reward, solution) less penalty |w|^2/2 is largest, by the derivatives."""
    phi, values = torch.from_numpy(features), torch.from_numpy(mdp.transition.data)

    def loss(w: np.ndarray) -> tuple[float, np.ndarray]:
        weights = torch.tensor(w, requires_grad=True)
        reward = phi @ weights
        found = goal(reward, soft_bellman(reward, values, beta=beta, pattern=mdp.transition))
        found = found - penalty * (weights @ weights) / 2
        found.backward()
        assert weights.grad is not None
        return -found.item(), -weights.grad.numpy()

    start = np.zeros(features.shape[2])
    options = {"maxiter": 500, "ftol": 1e-14, "gtol": 1e-10}
    return np.asarray(minimize(loss, start, jac=True, method="L-BFGS-B", options=options).x)


def by_raw_features(
    mdp: TabularMDP, beta: float, features: np.ndarray, seen: np.ndarray, penalty: float = 0.0
) -> np.ndarray:
    share = torch.from_numpy(seen / seen.sum())
    return maximised(mdp, beta, features, lambda reward, found: beta * ((share * reward).sum() + found.theta), penalty)


def by_likelihood(mdp: TabularMDP, beta: float, features: np.ndarray, seen: np.ndarray) -> np.ndarray:
    share = torch.from_numpy(seen / seen.sum())
    return maximised(mdp, beta, features, lambda reward, found: (share * found.log_policy).sum())


def table(n: int = 150) -> dict[str, Any]:
    """Spread, coverage and bias of three estimators on one random problem, from a stream and from short episodes."""
    rng = np.random.default_rng(0)
    p = rng.dirichlet(np.full(6, 0.5), size=(6, 3)) + 1e-3
    mdp = TabularMDP(p / p.sum(2, keepdims=True), np.zeros((6, 3)), rng.dirichlet(np.ones(6)))
    features = rng.normal(size=(6, 3, 3))
    policy = solve_soft_bellman(TabularMDP(mdp.transition, features @ TRUTH, mdp.start), WARM).policy.numpy()
    exact = fit_reward(policy * 1e12, features, mdp=mdp, beta=WARM)  # so many steps that its errors are Fisher's
    rows = {}
    for what, (episodes, length) in {"a stream": (1, 5000), "episodes of 4": (1250, 4)}.items():
        found, errors = np.empty((3, n, 3)), np.empty((n, 3))
        for seed in tqdm(range(n), disable=None):
            seen = counts(collect(mdp, episodes, length, seed, policy), (6, 3))
            fit = fit_reward(seen, features, mdp=mdp, beta=WARM)
            found[0, seed], errors[seed] = fit.weights, fit.standard_error
            found[1, seed] = by_raw_features(mdp, WARM, features, seen)
            found[2, seed] = by_likelihood(mdp, WARM, features, seen)
        off = found - TRUTH
        rows[what] = {
            name: {
                "sd": off[k].std(0, ddof=1).tolist(),
                "bias": off[k].mean(0).tolist(),
                "coverage": (np.abs(off[k]) <= 1.96 * errors).mean(0).tolist(),
            }
            for k, name in enumerate(("balanced", "raw features", "likelihood"))
        }
        rows[what]["said"] = {"sd": np.sqrt((errors**2).mean(0)).tolist()}
    assert exact.standard_error is not None
    return {"n": n, "rows": rows, "fisher": (exact.standard_error * np.sqrt(6e12 / 5000)).tolist()}


def cliff_features() -> dict[str, np.ndarray | None]:
    tile = CLIFF.reward[:, 0]
    return {
        "2 (trap; step)": np.stack([tile == -5, tile == -1], 1).astype(float),
        "15 (a state each)": np.eye(15),
        "60 (a table)": None,
    }


def loss(policy: np.ndarray) -> float:
    """g* - J in the true cliff, reward a step."""
    best = solve_soft_bellman(CLIFF, BETA)
    return -best.theta - objective(CLIFF, policy, np.full((15, 4), 0.25), BETA)


def every_pair(features: np.ndarray | None) -> np.ndarray:
    if features is None:
        return np.eye(60).reshape(15, 4, 60)
    return np.repeat(features[:, None, :], 4, 1)


def cliff(n: int = 40) -> dict[str, Any]:
    """Loss in the true cliff of the policy that is best for the reward found."""
    expert = solve_soft_bellman(CLIFF, BETA).policy.numpy()
    rows = {}
    for name, features in cliff_features().items():
        begin = time.process_time()
        fit = fit_reward(expert, features, mdp=CLIFF, beta=BETA, exact=True)
        seconds = time.process_time() - begin
        balanced, raw = [], []
        for seed in tqdm(range(n), disable=None):
            seen = counts(collect(CLIFF, 1, 10_000, seed, expert), (15, 4))
            balanced.append(loss(fit_reward(seen, features, mdp=CLIFF, beta=BETA).solution.policy.numpy()))
            if seed < 10:  # slow, and without a penalty its weights run away: the traps are never met
                weights = by_raw_features(CLIFF, BETA, every_pair(features), seen, 1e-4)
                again = TabularMDP(CLIFF.transition, every_pair(features) @ weights, CLIFF.start)
                raw.append(loss(solve_soft_bellman(again, BETA).policy.numpy()))
        rows[name] = {
            "exact": loss(fit.solution.policy.numpy()),
            "seconds": seconds,
            "median": float(np.median(balanced)),
            "largest": max(balanced),
            "raw": float(np.median(raw)),
        }
    return {"n": n, "rows": rows}


def imitation(python: str, seeds: int = 2) -> dict[str, Any]:
    """Ours and MCE IRL on the same 10 episodes of 1,000 steps, a reward for each state."""
    expert = solve_soft_bellman(CLIFF, BETA).policy.numpy()
    rows = []
    fit_reward(expert, np.eye(15), mdp=CLIFF, beta=BETA)  # so that nothing is compiled below
    for seed in range(seeds):
        data = collect(CLIFF, 10, 1000, seed, expert)
        begin = time.process_time()
        fit = fit_reward(data, np.eye(15), mdp=CLIFF, beta=BETA)
        seconds = time.process_time() - begin
        rows.append(["fit_reward", seed, loss(fit.solution.policy.numpy()), None, seconds, 1.0])
        states = np.concatenate([data.s.reshape(10, 1000), data.s_next.reshape(10, 1000)[:, -1:]], 1)
        for rate in (0.01, 0.5):
            with tempfile.TemporaryDirectory() as folder:
                source, target = Path(folder) / "in.npz", Path(folder) / "out.npz"
                np.savez(
                    source, transition=CLIFF.transition.toarray().reshape(15, 4, 15), start=CLIFF.start, states=states,
                    max_iter=1000, lr=rate, eps=1e-3,
                )  # fmt: skip
                script = Path(__file__).with_name("mce_irl.py")
                subprocess.run([python, "-W", "ignore", str(script), str(source), str(target)], check=True)
                with np.load(target) as found:
                    reward = np.repeat(found["reward"][:, None], 4, 1) / BETA
                    again = TabularMDP(CLIFF.transition, reward, CLIFF.start)
                    lost = loss(solve_soft_bellman(again, BETA).policy.numpy())
                    own, took, version = loss(found["policy"]), float(found["seconds"]), str(found["version"])
            rows.append([f"imitation {version}, Adam {rate:g}, 1,000 steps", seed, lost, own, took, took / seconds])
            print(rows[-1], flush=True)
    return {"rows": rows}


def page(parts: dict[str, Any]) -> str:
    """docs/results/inverse.md."""
    lines = [HEAD]
    three = lambda x: " ".join(f"{v:.2g}" for v in x)  # noqa: E731
    if "table" in parts:
        found = parts["table"]
        lines += [
            "## Three estimators",
            "",
            f"Random problem, 6 states, 3 actions, 3 features, beta {WARM:g}; 5,000 steps of the expert, {found['n']} "
            "repeats. Three numbers: a weight each. Coverage of estimate -+ 1.96 standard errors of `fit_reward`; root "
            f"mean square of these in the last column. Fisher, (beta² N E A A')^-1: {three(found['fisher'])}.",
            "",
            "| demonstrations | estimator | sd | bias | coverage | said |",
            "|---|---|---|---|---|---|",
        ]
        for what, row in found["rows"].items():
            for name in ("balanced", "raw features", "likelihood"):
                one, said = row[name], three(row["said"]["sd"]) if name == "balanced" else ""
                cells = (three(one["sd"]), three(one["bias"]), three(one["coverage"]), said)
                lines.append(f"| {what} | {name} | {' | '.join(cells)} |")
        lines.append("")
    if "cliff" in parts:
        found = parts["cliff"]
        lines += [
            "## Windy cliff",
            "",
            "Loss, g* - J in the true problem (beta 10), of the policy that is best for the reward found: from the "
            f"expert's exact policy; from 10,000 steps, {found['n']} seeds (raw features: 10, and "
            "penalty 1e-4, without which their weights run away).",
            "",
            "| features | exact | its seconds | balanced, median | largest | raw features, median |",
            "|---|---|---|---|---|---|",
        ]
        for name, row in found["rows"].items():
            cells = (row[key] for key in ("exact", "seconds", "median", "largest", "raw"))
            lines.append(f"| {name} | {' | '.join(f'{x:.2g}' for x in cells)} |")
        lines.append("")
    if "imitation" in parts:
        lines += [
            "## Beside the tabular MCE IRL of `imitation`",
            "",
            "Windy cliff, the same 10 episodes of 1,000 steps, a reward for each state, one run; seconds of the "
            "processor. MCE IRL has the episodes' horizon, 1,000, a linear reward, and Adam; .01 is its default. "
            "Loss: of the policy that is best for its reward in the endless problem, and of its own first step's.",
            "",
            "| by | seed | loss | own policy's | seconds | times ours |",
            "|---|---|---|---|---|---|",
        ]
        for by, seed, lost, own, took, ratio in parts["imitation"]["rows"]:
            cells = (f"{lost:.2g}", "" if own is None else f"{own:.2g}", f"{took:.2g}", f"{ratio:.3g}")
            lines.append(f"| {by} | {seed} | {' | '.join(cells)} |")
        lines += ["", parts["imitation"].get("note", "")]
    return "\n".join(lines).rstrip() + "\n"


def main() -> None:
    tasks: dict[str, Callable[..., dict[str, Any]]] = {"table": table, "cliff": cliff, "imitation": imitation}
    if len(sys.argv) < 2 or sys.argv[1] not in tasks:
        sys.exit(__doc__)
    arguments = [int(word) if word.isdigit() else word for word in sys.argv[2:]]
    found = tasks[sys.argv[1]](*arguments)
    kept = PAGE.with_suffix(".json")
    parts = json.loads(kept.read_text()) if kept.exists() else {}
    parts[sys.argv[1]] = found
    write_json(kept, parts)
    PAGE.write_text(page(parts))
    print(page({sys.argv[1]: found}))


if __name__ == "__main__":
    main()
