"""Speed of the exact solvers beside other packages, and cost against size.

    python benchmarks/bench_solvers.py pair          dominant eigenpair of the tilted matrix
    python benchmarks/bench_solvers.py solve         whole solve, beside bettermdptools and quantecon if installed
    python benchmarks/bench_solvers.py size [MAX]    whole solve on grids of 1e2 to MAX states (default 1e5)
    python benchmarks/bench_solvers.py low           beta 1e-3 to 1e4 on the cliff and two grids

CPU seconds, medians. The other packages solve the *discounted, unregularised* problem (gamma .99), which has a horizon
of 100 steps and no certificate: a comparison of effort on the same transition matrix, not of the same task.
"""

from __future__ import annotations

import json
import resource
import statistics
import sys
import time
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import scipy.sparse as sp

from erl_torch import TabularMDP
from erl_torch.envs.grid_world import GridWorld
from erl_torch.envs.windy_cliff import WindyCliffEnv
from erl_torch.solvers import perron, solve_biasing, solve_soft_bellman


def windy_grid(n: int, seed: int = 0) -> TabularMDP:
    """n x n floor, round(n / 4) traps (the paper's densest), goal opposite the start, random wind."""
    rng = np.random.default_rng(seed)
    tiles = np.full((n, n), "F")
    free = np.flatnonzero(np.add.outer(np.arange(n), -np.arange(n)).ravel() ** 2 < (n - 4) ** 2)
    tiles.flat[rng.choice(free, round(n / 4), replace=False)] = "H"
    tiles[n - 2, 1], tiles[1, n - 2] = "S", "G"
    wind = np.stack([rng.normal(1, 1, (n, n)), rng.beta(2, 2, (n, n))])
    return GridWorld(tuple("".join(row) for row in tiles), wind, trap_reward=-2.0).mdp()


def median_seconds(call: Callable[[], object], rounds: int = 7) -> float:
    call()
    seconds = []
    for _ in range(rounds):
        tick = time.process_time()
        call()
        seconds.append(time.process_time() - tick)
    return statistics.median(seconds)


def tilted(mdp: TabularMDP, beta: float) -> sp.csr_array:
    """sum_a prior exp(beta r) p, [S, S]."""
    n_states, n_actions = mdp.reward.shape
    weight = np.exp(beta * mdp.reward).ravel() / n_actions
    rows = np.repeat(np.arange(n_states), n_actions)
    choose = sp.csr_array((weight, (rows, np.arange(n_states * n_actions))), shape=(n_states, n_states * n_actions))
    return sp.csr_array(choose @ mdp.transition)


def bench_pair() -> None:
    print("\neigenpair of the tilted matrix, Collatz-Wielandt spread 1e-13\n")
    print("| states | beta | ms | spread | Newton steps | status |\n|---|---|---|---|---|---|")
    for n in (30, 100):
        mdp = windy_grid(n)
        for beta in (0.1, 1.0, 5.0, 50.0):
            matrix = tilted(mdp, beta)
            seconds = median_seconds(partial(perron, matrix))
            pair = perron(matrix)
            spread = pair.bounds[1] - pair.bounds[0]
            print(f"| {n * n} | {beta:g} | {seconds * 1e3:.1f} | {spread:.0e} | {pair.n_steps} | {pair.status.name} |")


def bench_solve() -> None:
    print("\nwhole solve, milliseconds\n")
    print(
        "| states | beta | soft Bellman | biasing | quantecon MPI .99 | bettermdptools VI .99 |\n"
        "|---|---|---|---|---|---|"
    )
    for n in (30, 100):
        mdp = windy_grid(n)
        others = [quantecon_mpi(mdp), bettermdptools_vi(mdp)]
        for beta in (1.0, 5.0, 20.0):
            mine = [
                median_seconds(lambda f=f, beta=beta, mdp=mdp: f(mdp, beta), 3)  # type: ignore[misc]
                for f in (solve_soft_bellman, solve_biasing)
            ]
            cells = [f"{s * 1e3:.1f}" if s is not None else "not installed" for s in [*mine, *others]]
            print(f"| {n * n} | {beta:g} | " + " | ".join(cells) + " |")


def quantecon_mpi(mdp: TabularMDP) -> float | None:
    try:
        from quantecon.markov import DiscreteDP
    except ImportError:
        return None
    n_states, n_actions = mdp.reward.shape
    s, a = np.repeat(np.arange(n_states), n_actions), np.tile(np.arange(n_actions), n_states)
    ddp = DiscreteDP(mdp.reward.ravel(), sp.csr_matrix(mdp.transition), 0.99, s, a)
    return median_seconds(lambda: ddp.solve(method="modified_policy_iteration", epsilon=1e-8, max_iter=10_000), 3)


def bettermdptools_vi(mdp: TabularMDP) -> float | None:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            from bettermdptools.algorithms.planner import Planner
    except ImportError:
        return None
    n_states, n_actions = mdp.reward.shape
    p = mdp.transition
    table = {
        s: {
            a: [
                (p.data[m], int(p.indices[m]), mdp.reward[s, a], False)
                for m in range(p.indptr[s * n_actions + a], p.indptr[s * n_actions + a + 1])
            ]
            for a in range(n_actions)
        }
        for s in range(n_states)
    }
    planner = Planner(table)
    return median_seconds(
        lambda: planner.value_iteration_vectorized(gamma=0.99, n_iters=2000, theta=1e-8),
        1 if n_states > 1000 else 3,
    )


def bench_size(largest: float = 1e5) -> None:
    print("\ncost against size, beta 1, tol 1e-9 of the reward range\n")
    print(
        "| states | seconds | steps | width of theta's bounds | peak memory, GB | status |\n|---|---|---|---|---|---|"
    )
    rows = []
    solve_soft_bellman(windy_grid(10), 1.0)  # compiled code is loaded
    for n in (10, 32, 100, 316, 1000):
        if n * n > largest * 1.01:
            break
        mdp = windy_grid(n)
        tick = time.perf_counter()
        solution = solve_soft_bellman(mdp, 1.0, tol=1e-9)
        seconds = time.perf_counter() - tick
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
        assert solution.theta_bounds is not None
        width = solution.theta_bounds[1] - solution.theta_bounds[0]
        rows.append(
            {"states": n * n, "seconds": seconds, "steps": solution.n_steps, "width": width, "peak_gb": peak,
             "theta": solution.theta, "status": solution.status.name}
        )  # fmt: skip
        print(
            f"| {n * n:,} | {seconds:.3g} | {solution.n_steps} | {width:.0e} | {peak:.2f} | {rows[-1]['status']} |",
            flush=True,
        )
    out = Path(__file__).parents[1] / "docs" / "results"
    (out / "solver_sizes.json").write_text(json.dumps(rows, indent=2) + "\n")
    draw_sizes(rows, out / "solver_sizes.png")


def draw_sizes(rows: list[dict[str, float]], path: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5, 3.6), layout="constrained")
    axes = figure.add_subplot()
    axes.loglog([r["states"] for r in rows], [r["seconds"] for r in rows], "o-", label="whole solve")
    axes.loglog(
        [r["states"] for r in rows],
        [r["seconds"] / max(r["steps"], 1) for r in rows],
        "s--",
        label="a Newton step",
    )
    axes.set_xlabel("states of the windy grid")
    axes.set_ylabel("seconds, one core")
    axes.set_title("Soft policy iteration, beta 1, four actions", fontsize=10)
    axes.grid(alpha=0.3)
    axes.legend()
    figure.savefig(path, dpi=110)


def bench_low() -> None:
    print("\nany temperature: width of theta's bounds relative to the reward range\n")
    print("| problem | beta | theta | width | steps | seconds | status |\n|---|---|---|---|---|---|---|")
    for name, mdp in (("cliff", WindyCliffEnv().mdp), ("30x30", windy_grid(30)), ("100x100", windy_grid(100))):
        for beta in (1e-3, 0.1, 1.0, 10.0, 100.0, 1e3, 1e4):
            tick = time.process_time()
            s = solve_soft_bellman(mdp, beta)
            seconds = time.process_time() - tick
            assert s.theta_bounds is not None
            width = (s.theta_bounds[1] - s.theta_bounds[0]) / np.ptp(mdp.reward)
            cells = f"{s.theta:.10f} | {width:.0e} | {s.n_steps} | {seconds:.2f} | {s.status.name}"
            print(f"| {name} | {beta:g} | {cells} |", flush=True)


if __name__ == "__main__":
    part = {"pair": bench_pair, "solve": bench_solve, "size": bench_size, "low": bench_low}[sys.argv[1]]
    part(*map(float, sys.argv[2:]))
