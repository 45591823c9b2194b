"""EfficientS1 beside certainty equivalence, the limit of what the data allow, and published S1; intervals; online mode.

    python benchmarks/statistical_limit.py cliff [n_seeds]     the paper's cliff, default 20 seeds
    python benchmarks/statistical_limit.py breadth [n_seeds]   mazes, FrozenLake, three behaviour policies, default 4
    python benchmarks/statistical_limit.py beta                beta .1 to 5000 on the cliff
    python benchmarks/statistical_limit.py coverage [n]        95% intervals of theta, default 300 datasets
    python benchmarks/statistical_limit.py noise [n_seeds]     rewards with variance up to 4, default 10
    python benchmarks/statistical_limit.py online [n_seeds]    quantiles of the online loss, default 100 streams

Each prints a Markdown table and writes it to docs/results/statistical_limit_<what>.md with the figures in .json
(online: .png too). Loss is g* - J of the policy in the true MDP, exact, reward a step. Minutes each, on one core.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import scipy.sparse as sp
from tqdm import tqdm

from erl_torch import (
    AlgorithmS1,
    CertaintyEquivalence,
    EfficientS1,
    ListedS1,
    TabularMDP,
    Transitions,
    collect,
    empirical_mdp,
    estimate_mdp,
    solve_soft_bellman,
    theta_uncertainty,
)
from erl_torch.envs.windy_cliff import WindyCliffEnv
from erl_torch.files import write_json
from erl_torch.solvers.policy import kl_per_state, objective

ROOT = Path(__file__).parents[1]
CLIFF = WindyCliffEnv().mdp


def maze(i: int) -> TabularMDP:
    """One of the authors' 10x10 mazes of the tests."""
    with np.load(ROOT / "tests" / "data" / "windy_mazes.npz") as d:
        r = d[f"m{i:02d}_R"]
        rows = (d[f"m{i:02d}_data"], d[f"m{i:02d}_indices"], d[f"m{i:02d}_indptr"])
        return TabularMDP(sp.csr_array(rows, shape=(r.size, len(r))), r, d[f"m{i:02d}_start"])


def frozen_lake() -> TabularMDP:
    """FrozenLake-v1, slippery; a step that ends an episode leads to the start."""
    table = gym.make("FrozenLake-v1", is_slippery=True).unwrapped.P  # type: ignore[attr-defined]
    p, r = np.zeros((len(table), 4, len(table))), np.zeros((len(table), 4))
    for s, actions in table.items():
        for a, outcomes in actions.items():
            for chance, s_next, reward, done in outcomes:
                p[s, a, 0 if done else s_next] += chance
                r[s, a] += chance * reward
    return TabularMDP(p, r, np.eye(len(table))[0])


def uniform(mdp: TabularMDP) -> np.ndarray:
    return np.full(mdp.reward.shape, 1 / mdp.n_actions)


def part(data: Transitions, begin: int, end: int) -> Transitions:
    return Transitions(*(getattr(data, name)[begin:end] for name in ("s", "a", "r", "s_next", "a_next")))


def losses(mdp: TabularMDP, beta: float, exact: Any, policy: np.ndarray) -> tuple[float, float]:
    """(g* - J, mean KL(optimal || policy)); the KL is over states that the start leads to."""
    kl = kl_per_state(exact.policy.numpy(), policy)
    return -exact.theta - objective(mdp, policy, uniform(mdp), beta), float(kl.mean())


def write(what: str, command: str, text: str, header: Sequence[str], rows: list[list[Any]]) -> None:
    lines = [f"# {text[0].upper()}{text[1:].splitlines()[0]}\n", f"    {command}\n", *text.splitlines()[1:], ""]
    lines += [f"| {' | '.join(header)} |", "|" + "---|" * len(header)]
    lines += [f"| {' | '.join(x if isinstance(x, str) else f'{x:.3g}' for x in row)} |" for row in rows]
    path = ROOT / "docs" / "results" / f"statistical_limit_{what}"
    path.with_suffix(".md").write_text("\n".join(lines) + "\n")
    write_json(path.with_suffix(".json"), {"command": command, "columns": list(header), "rows": rows})
    print("\n".join(lines))


def cliff(command: str, n_seeds: int = 20) -> None:
    exact = solve_soft_bellman(CLIFF, 10.0)
    learners: dict[str, Any] = {
        "published S1, as the authors' script reads it": AlgorithmS1(),
        "published S1, as listed": ListedS1(),
        "EfficientS1, 15 epochs x 6": EfficientS1(n_epochs=15, n_bias=6),
        "EfficientS1, defaults (3 x 30)": EfficientS1(),
        "certainty equivalence": CertaintyEquivalence(),
    }
    found = np.empty((len(learners), n_seeds, 4))
    for seed in tqdm(range(n_seeds), disable=None):
        data = collect(CLIFF, 500, 1000, seed)
        for i, learner in enumerate(learners.values()):
            s = learner.fit(data, 15, 4)
            passes = s.n_steps / len(data)
            found[i, seed] = *losses(CLIFF, 10.0, exact, s.policy.numpy()), abs(s.theta - exact.theta), passes
    mean = found.mean(1)
    rows = [
        [name, g, g / mean[-1, 0], k, k / mean[-1, 1], t, n] for name, (g, k, t, n) in zip(learners, mean, strict=True)
    ]
    text = f"windy cliff, beta 10, 500,000 tuples\nMeans over {n_seeds} streams of the uniform prior."
    write("cliff", command, text, ["learner", "loss", "x CE", "KL", "x CE", "error of theta", "passes"], rows)


def mountain_car() -> TabularMDP:
    """Episodes of 50 steps from any cell."""
    model = estimate_mdp("mountain_car").mdp
    return TabularMDP(model.transition, model.reward)


def breadth(command: str, n_seeds: int = 4) -> None:
    problems = [
        *((f"maze {i}, 10x10", maze(i), beta) for i in (0, 1) for beta in (5.0, 20.0)),
        *(("FrozenLake-v1 slippery, restart", frozen_lake(), beta) for beta in (5.0, 20.0)),
        ("windy cliff", CLIFF, 10.0),
        ("MountainCar, 12^2 bins", mountain_car(), 2.0),
    ]
    rows = []
    for name, mdp, beta in tqdm(problems, disable=None):
        exact = solve_soft_bellman(mdp, beta)
        best = exact.policy.numpy()
        poor = 1 / np.maximum(best, 0.02)
        behaviours = {
            "prior": None,
            "half optimum": 0.5 * best + 0.5 * uniform(mdp),
            "poor": poor / poor.sum(1, keepdims=True),
        }
        for kind, behaviour in behaviours.items():
            found = np.empty((2, n_seeds, 2))
            status = []
            for seed in range(n_seeds):
                data = collect(mdp, *((10_000, 50) if "bins" in name else (500, 1000)), seed, behaviour)
                for i, learner in enumerate((EfficientS1(beta), CertaintyEquivalence(beta))):
                    s = learner.fit(data, *mdp.reward.shape)  # type: ignore[attr-defined]
                    found[i, seed] = losses(mdp, beta, exact, s.policy.numpy())[0], s.n_steps / len(data)
                    status += [s.status.name] if i == 0 else []
            ours, limit = found[:, :, 0]
            worst = float((ours / limit).max())
            certified = f"{status.count('CONVERGED')} of {n_seeds}"
            row = [name, beta, kind, ours.mean(), limit.mean(), ours.mean() / limit.mean(), worst, certified]
            rows.append([*row, found[0, :, 1].mean()])
    header = ["problem", "beta", "behaviour", "loss", "loss of CE", "ratio", "worst ratio", "certified", "passes"]
    text = f"""EfficientS1 beside certainty equivalence on the same streams
Default settings, 500,000 tuples, means over {n_seeds} streams. Behaviour: the uniform prior; half the optimal policy
and half the prior; a poor policy, proportional to 1/max(optimal, .02), which has full support."""
    write("breadth", command, text, header, rows)


def beta(command: str, n_seeds: int = 1) -> None:
    rows = []
    for beta in tqdm((0.1, 1.0, 10.0, 50.0, 200.0, 1000.0, 5000.0), disable=None):
        exact = solve_soft_bellman(CLIFF, beta)
        data = collect(CLIFF, 500, 1000, 0)
        s, ce, paper = (learner(beta).fit(data, 15, 4) for learner in (EfficientS1, CertaintyEquivalence, _published))
        loss = [losses(CLIFF, beta, exact, x.policy.numpy())[0] for x in (s, ce, paper)]
        error = [abs(x.theta - exact.theta) for x in (s, ce, paper)]
        rows.append([beta, *loss[:2], loss[2], *error, s.status.name, paper.status.name])
    header = [
        "beta",
        "loss",
        "loss of CE",
        "loss of published S1",
        "error of theta",
        "CE",
        "published",
        "status",
        "pub.",
    ]
    write("beta", command, "any temperature: windy cliff, 500,000 tuples\n", header, rows)


def _published(beta: float) -> Any:
    """Published S1; EfficientS1's form of it, which ends with a status where numbers leave their range."""
    return EfficientS1.published(beta)


def rare(chance: float) -> TabularMDP:
    """State 1 pays 100, is entered with this chance from state 0, and left at once."""
    p = np.zeros((2, 2, 2))
    p[0, :, 1], p[0, :, 0], p[1, :, 0] = chance, 1 - chance, 1.0
    return TabularMDP(p, np.array([[0.0, -0.1], [100.0, 100.0]]), np.array([1.0, 0.0]))


def drawn(seed: int, n_states: int, n_actions: int, concentration: float, scale: float) -> TabularMDP:
    """Rows from a Dirichlet distribution, normal rewards."""
    rng = np.random.default_rng(seed)
    p = rng.dirichlet(np.full(n_states, concentration), n_states * n_actions)
    return TabularMDP(p, scale * rng.normal(size=(n_states, n_actions)))


def corridor(length: int) -> TabularMDP:
    """From the left end; action 0 leads left with chance .8, action 1 right with .6. Each step costs 1 but at the right
    end."""
    p, r = np.zeros((length, 2, length)), -np.ones((length, 2))
    for s in range(length):
        for a, right in enumerate((0.2, 0.6)):
            p[s, a, max(s - 1, 0)] += 1 - right
            p[s, a, min(s + 1, length - 1)] += right
    r[-1] = 0.0
    return TabularMDP(p, r, np.eye(length)[0])


def trap() -> TabularMDP:
    """State 1 costs 10 a step and is left with chance .1; state 0 leads there with chance .001, or .01 by action 1."""
    p = np.array([[[0.999, 0.001], [0.99, 0.01]], [[0.1, 0.9], [0.1, 0.9]]])
    return TabularMDP(p, np.array([[0.0, 0.1], [-10.0, -10.0]]), np.array([1.0, 0.0]))


def ring() -> TabularMDP:
    """20 states in a ring, state 0 pays 1; action 1 moves on in 9 of 10 steps, action 0 in 1 of 2, and they fall into a
    pit, which costs 20 a step for about two steps, with chance .004 and .001."""
    p, r = np.zeros((21, 2, 21)), np.zeros((21, 2))
    for s in range(20):
        for a, (on, fall) in enumerate(((0.5, 0.001), (0.9, 0.004))):
            p[s, a, [(s + 1) % 20, s, 20]] = on, 1 - on - fall, fall
    p[20, :, [0, 20]] = 0.5
    r[0], r[20] = 1.0, -20.0
    return TabularMDP(p, r, np.eye(21)[0])


def queue() -> TabularMDP:
    """Up to 11 wait, for .1 each; one arrives with chance .4, one is served with chance .3, or .6 for .5."""
    p, r = np.zeros((12, 2, 12)), np.zeros((12, 2))
    for s in range(12):
        for a, served in enumerate((0.3, 0.6)):
            up, down = 0.4 * (1 - served), 0.6 * served
            p[s, a, min(s + 1, 11)] += up
            p[s, a, max(s - 1, 0)] += down
            p[s, a, s] += 1 - up - down
            r[s, a] = -0.1 * s - 0.5 * a
    return TabularMDP(p, r, np.eye(12)[0])


def wear() -> TabularMDP:
    """A machine of 5 levels of wear earns 1; it fails with chance .002 to .1 (cost 10, then as new); action 1 repairs
    it for 2."""
    p, r = np.zeros((6, 2, 6)), np.zeros((6, 2))
    for s in range(5):
        fails = 0.002 * 2.66**s
        p[s, 0, 5] = fails
        p[s, 0, min(s + 1, 4)] += 0.2
        p[s, 0, s] += 0.8 - fails
        p[s, 1, 0] = 1.0
        r[s] = 1.0, -2.0
    p[5, :, 0], r[5] = 1.0, -10.0
    return TabularMDP(p, r, np.eye(6)[0])


def alike() -> TabularMDP:
    """Two states; two actions a thousandth apart."""
    p = np.array([[[0.7, 0.3], [0.699, 0.301]], [[0.4, 0.6], [0.4, 0.6]]])
    return TabularMDP(p, np.array([[0.0, 0.001], [1.0, 1.001]]))


def moves() -> TabularMDP:
    """8 states, 3 actions, a step to a given state each."""
    rng = np.random.default_rng(8)
    p = np.eye(8)[np.stack([(np.arange(8) + 1) % 8, rng.integers(8, size=8), rng.integers(8, size=8)], 1)]
    return TabularMDP(p, rng.normal(size=(8, 3)), np.eye(8)[0])


def rooms() -> TabularMDP:
    """Four rooms of three states, drawn; action 1 leads on to the next room with chance .1, and one room pays more."""
    rng = np.random.default_rng(11)
    p = np.zeros((12, 2, 12))
    for s in range(12):
        room = 3 * (s // 3)
        p[s, :, room : room + 3] = rng.dirichlet(np.ones(3), 2)
        p[s, 1] *= 0.9
        p[s, 1, (room + 3) % 12] += 0.1
    r = 0.3 * rng.normal(size=(12, 2))
    r[9:] += 0.5
    return TabularMDP(p, r)


def arms() -> TabularMDP:
    """One state, ten actions that pay nothing."""
    return TabularMDP(np.ones((1, 10, 1)), np.zeros((1, 10)))


def slips() -> TabularMDP:
    """10 states in a row, the last pays 3; actions step right (from the end to the start) or left, and any step slips
    to the start with chance .02."""
    p, r = np.zeros((10, 2, 10)), np.full((10, 2), -0.1)
    for s in range(10):
        for a, to in enumerate(((s + 1) % 10, max(s - 1, 0))):
            p[s, a, to] += 0.98
            p[s, a, 0] += 0.02
    r[9] = 3.0
    return TabularMDP(p, r, np.eye(10)[0])


def ties() -> TabularMDP:
    """5 states; three actions lead on alike, and pay some thousandths more or less."""
    rng = np.random.default_rng(10)
    p = np.repeat(rng.dirichlet(np.ones(5), (5, 1)), 3, axis=1)
    return TabularMDP(p, rng.normal(size=(5, 1)) + 0.003 * rng.normal(size=(5, 3)))


class Case(NamedTuple):
    """A problem of the coverage page. ``noise``: draws of it are added to every reward."""

    name: str
    mdp: TabularMDP
    beta: float
    episodes: int
    length: int
    noise: Callable[[np.random.Generator, int], np.ndarray] | None = None
    behaviour: Callable[[TabularMDP, float], np.ndarray] | None = None  # of problem and beta; None is uniform


def _normal(scale: float) -> Callable[[np.random.Generator, int], np.ndarray]:
    return lambda rng, n: scale * rng.standard_normal(n)


def _centred_exponential(rng: np.random.Generator, n: int) -> np.ndarray:
    return rng.exponential(size=n) - 1.0


def _half_optimal(mdp: TabularMDP, b: float) -> np.ndarray:
    return 0.5 * solve_soft_bellman(mdp, b).policy.numpy() + 0.5 * uniform(mdp)


SETTLED = (  # on which the rules of the interval were settled
    Case("windy cliff", CLIFF, 10.0, 200, 1000),
    Case("windy cliff, reward variance 4", CLIFF, 2.0, 200, 1000, _normal(2.0)),
    Case("FrozenLake-v1", frozen_lake(), 5.0, 200, 1000),
    Case("a rare state, chance .01", rare(0.01), 1.0, 1, 1000),
    Case("a rare state, chance .005", rare(0.005), 1.0, 1, 2000),
    Case("20 states x 4, rows Dirichlet(.05)", drawn(1, 20, 4, 0.05, 2.0), 5.0, 1, 2000),
    Case("20 states x 4, rows Dirichlet(.05)", drawn(2, 20, 4, 0.05, 2.0), 50.0, 1, 40_000),
    Case("8 states x 3, rows Dirichlet(1)", drawn(3, 8, 3, 1.0, 1.0), 2.0, 1, 2000),
    Case("trap, chances .001 and .01", trap(), 1.0, 1, 1000),
    Case("trap, chances .001 and .01", trap(), 1.0, 1, 5000),
    Case("corridor of 8", corridor(8), 50.0, 1, 300),
    Case("corridor of 8", corridor(8), 5.0, 1, 2000),
    Case("corridor of 8", corridor(8), 5.0, 1, 8000),
    Case("corridor of 8", corridor(8), 0.5, 1, 2000),
    Case("a row of 10 with slips", slips(), 2.0, 1, 4000),
    Case("three actions thousandths apart", ties(), 200.0, 1, 5000),
    Case("two actions a thousandth apart", alike(), 100.0, 1, 500),
)
FRESH = (
    Case("ring of 20 with a pit", ring(), 1.0, 1, 4000),
    Case("queue of 12", queue(), 2.0, 1, 3000),
    Case("corridor of 14", corridor(14), 2.0, 20, 1000),
    Case("10 states x 3, rewards exponential", drawn(4, 10, 3, 0.3, 1.0), 1.0, 1, 2000, _centred_exponential),
    Case("50 states x 2, rows Dirichlet(.1)", drawn(5, 50, 2, 0.1, 1.0), 10.0, 1, 20_000),
    Case("50 states x 4, ten visits a pair", drawn(6, 50, 4, 0.1, 1.0), 3.0, 1, 2000),
    Case("four rooms of 3", rooms(), 3.0, 1, 4000),
    Case("ten equal arms, noisy rewards", arms(), 1000.0, 1, 1000, _normal(1.0)),
    Case("5 states x 3, all but the prior", drawn(7, 5, 3, 0.5, 5.0), 0.01, 1, 1000),
    Case("8 states x 3, half the optimum", drawn(9, 8, 3, 0.3, 1.0), 100.0, 1, 2000, None, _half_optimal),
    Case("deterministic moves, noisy rewards", moves(), 5.0, 1, 1000, _normal(1.0)),
    Case("deterministic moves", moves(), 5.0, 1, 1000),
    Case("a machine that wears", wear(), 0.5, 1, 1000),
)


def covered(case: Case, n: int) -> tuple[list[Any], int, int]:
    """(row of the page, intervals given, those that hold theta*)."""
    mdp, b = case.mdp, case.beta
    theta = solve_soft_bellman(mdp, b).theta
    behaviour = case.behaviour(mdp, b) if case.behaviour else None
    plain = 0
    found = []
    for seed in tqdm(range(n), desc=case.name, disable=None):
        data = collect(mdp, case.episodes, case.length, seed, behaviour)
        if case.noise is not None:
            r = data.r + case.noise(np.random.default_rng(seed), len(data))
            data = Transitions(data.s, data.a, r, data.s_next, data.a_next)
        estimate = theta_uncertainty(empirical_mdp(data, *mdp.reward.shape), b)
        error = estimate.standard_error
        plain += abs(estimate.value + estimate.bias - theta) <= 1.96 * error
        if not estimate.withheld:
            low, high = estimate.interval()
            found.append([low <= theta <= high, high < theta, low > theta, (high - low) / 3.92 / error])
    row = [case.name, b, case.episodes * case.length, f"{n - len(found)}"]
    if not found:
        return [*row, "", "", "", "", f"{plain / n:.3f}"], 0, 0
    share = np.mean(found, axis=0)
    width = float(np.median([x[3] for x in found]))
    row += [f"{share[0]:.3f}", f"{share[1]:.3f}", f"{share[2]:.3f}", width, f"{plain / n:.3f}"]
    return row, len(found), int(sum(x[0] for x in found))


def coverage(command: str, n: int = 300) -> None:
    write_coverage(command, n, *([covered(case, n) for case in cases] for cases in (SETTLED, FRESH)))


def write_coverage(command: str, n: int, *found: list[tuple[list[Any], int, int]]) -> None:
    rows: list[list[Any]] = []
    for what, part in zip(("settled on", "fresh"), found, strict=True):
        rows += [[what, *row] for row, _, _ in part]
        given, hits = sum(x[1] for x in part), sum(x[2] for x in part)
        rows.append([what, "all", "", "", f"{n * len(part) - given}", f"{hits / given:.3f}", "", "", "", ""])
    header = ["", "problem", "beta", "tuples", "withheld", "coverage", "theta above", "theta below", "width"]
    text = f"""coverage of the 95% interval of theta
{n} datasets a problem, seeds 0 to {n - 1}. The rules of the interval were settled on the first problems; none was
made for the fresh ones, of which the rooms and the arms met the rules as they stand, and the others earlier ones as
well. Coverage is of the intervals that are given; withheld: datasets without one. "Theta above" and "theta below":
shares of the intervals given that miss it on that side. Width: median, in those of value -+ 1.96 standard errors,
whose own coverage, on all datasets, is in the last column. What is assumed: docs/theory.md, 4."""
    write("coverage", command, text, [*header, "value +- 1.96 se"], rows)


def noise(command: str, n_seeds: int = 10) -> None:
    rows = []
    for b in (1.0, 2.0):
        theta = solve_soft_bellman(CLIFF, b).theta
        for variance in (0.0, 1.0, 4.0):
            z, ours, paper, half = [], [], [], []
            for seed in range(n_seeds):
                data = _noisy(collect(CLIFF, 500, 1000, seed), seed, variance**0.5)
                estimate = theta_uncertainty(empirical_mdp(data, 15, 4), b)
                ours.append(EfficientS1(b).fit(data, 15, 4).theta)
                paper.append(AlgorithmS1(b).fit(data, 15, 4).theta - theta)
                z.append(abs(ours[-1] - theta) / estimate.standard_error)
                half.append(1.96 * estimate.standard_error)
            inside = f"{sum(x < 1.96 for x in z)} of {n_seeds}"
            row = [b, variance, theta, float(np.mean(ours)) - theta, float(np.mean(half)), inside]
            rows.append([*row, float(np.mean(paper)), b * variance / 2])
    header = ["beta", "variance", "theta", "error", "half interval", "inside", "error of published S1", "beta var/2"]
    text = f"""rewards that vary for the same (s,a)
Windy cliff, 500,000 tuples, {n_seeds} streams, normal noise of mean 0 on every reward. Published S1 averages
exp(beta r), which is exp(beta^2 variance/2) too large: its theta is too low by beta variance/2 if it converges."""
    write("noise", command, text, header, rows)


def _noisy(data: Transitions, seed: int, scale: float) -> Transitions:
    r = data.r + scale * np.random.default_rng(seed).standard_normal(len(data))
    return Transitions(data.s, data.a, r, data.s_next, data.a_next)


def online(command: str, n_seeds: int = 100) -> None:
    best = solve_soft_bellman(CLIFF, 10.0).policy.numpy()
    poor = 1 / np.maximum(best, 0.02)
    poor /= poor.sum(1, keepdims=True)
    few = range(max(n_seeds // 5, 1))
    cases: list[tuple[str, TabularMDP, float, Any, Sequence[int], Sequence[int]]] = [
        *(("cliff", CLIFF, b, None, range(n_seeds), (10_000, 100_000, 1_000_000)) for b in (5.0, 10.0, 20.0)),
        ("cliff, seed 49", CLIFF, 10.0, None, [49], [1_000_000]),
        ("cliff, seeds 1000 to 1015", CLIFF, 10.0, None, range(1000, 1016), [3_160_000]),
        ("cliff, poor behaviour", CLIFF, 10.0, poor, few, [10_000, 100_000, 1_000_000]),
        ("maze 1, 10x10", maze(1), 5.0, None, few, [100_000, 500_000]),
        ("FrozenLake-v1, restart", frozen_lake(), 5.0, None, few, [100_000, 500_000]),
    ]
    rows: list[list[Any]] = []
    figure_of = {}
    for name, mdp, b, behaviour, seeds, marks in tqdm(cases, disable=None):
        exact = solve_soft_bellman(mdp, b)
        found, ends = np.empty((2, len(marks), len(seeds))), []
        for i, seed in enumerate(seeds):
            data = collect(mdp, -(-marks[-1] // 1000), 1000, seed, behaviour)
            chunks = (part(data, *edges) for edges in pairwise([0, *marks]))
            states = list(EfficientS1(b).online(chunks, *mdp.reward.shape))
            ends.append(states)
            for m, state in enumerate(states):
                limit = CertaintyEquivalence(b).fit(part(data, 0, marks[m]), *mdp.reward.shape)
                for k, policy in enumerate((state.policy, limit.policy)):
                    found[k, m, i] = losses(mdp, b, exact, policy.numpy())[0]
        for m, n in enumerate(marks):
            ours, limits = (np.quantile(x[m], (0.5, 0.9, 0.99, 1.0)).tolist() for x in found)
            certified = f"{sum(states[m].certified for states in ends)} of {len(seeds)}"
            replaced = float(np.mean([states[m].n_replaced / states[m].bias_iteration for states in ends]))
            ratios = [ours[0] / limits[0], ours[-1] / limits[-1]]
            rows.append([name, b, f"{n:,}", *ours, *limits, *ratios, certified, f"{replaced:.2f}"])
            if name == "cliff" and b == 10.0:
                figure_of[n] = found[:, m]
    header = ["problem", "beta", "tuples"]
    header += [f"{who}{what}" for who in ("", "CE ") for what in ("median", ".9", ".99", "largest")]
    header += ["ratio of medians", "of the largest", "certified", "phases replaced"]
    text = f"""online mode: loss beside that of certainty equivalence
One pass, no tuple kept, default settings. Quantiles over streams of the uniform prior (poor behaviour: proportional to
1/max(optimal, .02)): seeds 0 to {n_seeds - 1} in the rows named cliff, 0 to {few[-1]} in others, or the seeds named.
CE: certainty equivalence on the same tuples. Ratios: median over median of CE, largest over largest. Certified: streams
whose state says so. Phases replaced: share of phases at whose end V was taken from the counts."""
    write("online", command, text, header, rows)

    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    points = list(figure_of)
    for k, (name, color) in enumerate((("online", "C0"), ("certainty equivalence", "black"))):
        for q, style in ((0.5, "o-"), (0.9, "o--"), (1.0, "o:")):
            curve = [np.quantile(figure_of[n][k], q) for n in points]
            label = {0.5: "median", 0.9: "quantile .9", 1.0: "largest"}[q]
            axes.loglog(points, curve, style, color=color, ms=4, label=f"{name}, {label}")
    axes.set_xlabel("tuples seen, once each")
    axes.set_ylabel("loss g* - J (reward a step)")
    axes.set_title(f"Windy cliff, beta 10, {n_seeds} streams")
    axes.grid(alpha=0.3)
    axes.legend(loc="lower left", fontsize=8)
    figure.savefig(ROOT / "docs" / "results" / "statistical_limit_online.png", dpi=130)


def main() -> None:
    tasks = {f.__name__: f for f in (cliff, breadth, beta, coverage, noise, online)}
    if len(sys.argv) < 2 or sys.argv[1] not in tasks:
        sys.exit(__doc__)
    numbers = [int(x) for x in sys.argv[2:3]]
    tasks[sys.argv[1]](" ".join(["python benchmarks/statistical_limit.py", *sys.argv[1:]]), *numbers)


if __name__ == "__main__":
    main()
