"""Speed of many replicas at once, each figure beside its alternatives in one run.

    python benchmarks/bench_replicas.py                all parts (about six minutes)
    python benchmarks/bench_replicas.py kernels        update phase and sampling on one core, beside C++ in AVX2
    python benchmarks/bench_replicas.py threads        whole epochs on one core and on two
    python benchmarks/bench_replicas.py figure         throughput against replicas and table size, as a picture
    python benchmarks/bench_replicas.py command        Figure 5 with 200 replicas: seconds and memory
    python benchmarks/bench_replicas.py learners       whole fits of other learners, replicas against one by one

Medians of interleaved rounds: CPU seconds of this process where one core works, wall seconds elsewhere. C++ needs g++
and a processor with AVX2, and is left out without them.
"""

from __future__ import annotations

import ctypes
import json
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import torch
from bench_s1 import medians
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from erl_torch import AlgorithmS1, CertaintyEquivalence, EfficientS1, Replicas, Simulation, TabularMDP, collect
from erl_torch.envs.windy_cliff import WindyCliffEnv
from erl_torch.experience.sampling import Sampler
from erl_torch.learners.s1 import kernels
from erl_torch.learners.s1.lanes import ROWS, Engine, Lanes
from erl_torch.rng import streams

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "docs" / "results"
LANES = 32


def compile_cpp(directory: str) -> ctypes.CDLL | None:
    cpu = Path("/proc/cpuinfo")
    if shutil.which("g++") is None or not cpu.exists() or " avx2" not in cpu.read_text():
        return None
    library = Path(directory) / "lanes.so"
    flags = ["-O3", "-mavx2", "-mfma", "-shared", "-fPIC"]
    subprocess.run(["g++", *flags, str(Path(__file__).with_name("lanes.cpp")), "-o", str(library)], check=True)
    return ctypes.CDLL(str(library))


def bench_kernels() -> None:
    mdp, n = WindyCliffEnv().mdp, 50_000
    uniform = np.full((15, 4), 0.25)
    sampler = Sampler(mdp, [streams(seed) for seed in range(LANES)], 1000, uniform, uniform, True)
    pair, _, pair_next = sampler.take(n)
    one, one_next = pair[:, 0].copy(), pair_next[:, 0].copy()
    gain = np.repeat(np.exp(10 * mdp.reward).ravel(), LANES)
    rates = (np.full(LANES, 0.005), np.full(LANES, 0.005 / 15), np.ones(LANES))
    z, q, failed, no = np.ones(60 * LANES), np.ones(LANES), np.full(LANES, -1), np.ones((1, 1))

    def fresh() -> None:
        z[:], q[:] = 1, np.exp(10)

    def own() -> None:
        fresh()
        kernels.lanes_epoch(pair, pair_next, no, False, gain, z, q, *rates, False, LANES, 1, 5000, failed, 0, n)

    def shared() -> None:
        fresh()
        kernels.shared_epoch(one, one_next, no, False, gain, z, q, *rates, False, 5000, failed, 0, n)

    buffers = tuple(np.empty((ROWS, LANES), np.int32) for _ in range(3))

    def fused() -> None:
        fresh()
        kernels.sampled_epoch(
            sampler.tables, sampler.environment, sampler.behaviour, sampler.now, buffers, gain, z, q, *rates, False,
            LANES, 1, 5000, failed, 0, n,
        )  # fmt: skip

    single = np.exp(10 * mdp.reward).ravel()

    def alone() -> None:
        for _ in range(4):
            kernels.u_epoch(
                one,
                one_next,
                np.ones(1),
                False,
                single,
                np.ones(60),
                np.exp(10),
                0.005,
                0.005 / 15,
                1.0,
                False,
                5000,
                0,
                n,
            )

    work: dict[str, Callable[[], object]] = {
        "one stream, one learner": alone,
        "own streams, recorded": own,
        "own streams, sampled as they are used": fused,
        "sampling alone": lambda: [sampler.take(ROWS) for _ in range(n // ROWS)],
        "one shared stream": shared,
    }
    with tempfile.TemporaryDirectory() as directory:
        library = compile_cpp(directory)
        if library is not None:

            def cpp(function: ctypes._NamedFuncPointer, *columns: np.ndarray) -> Callable[[], None]:
                pointers = [x.ctypes.data_as(ctypes.c_void_p) for x in (*columns, gain, z, q, *rates)]

                def call() -> None:
                    fresh()
                    function(*pointers, ctypes.c_int64(LANES), ctypes.c_int64(n))

                return call

            work["own streams, recorded: C++ in AVX2"] = cpp(library.own_streams, pair, pair_next)
            work["one shared stream: C++ in AVX2"] = cpp(library.shared_stream, one, one_next)
        seconds = medians(work, rounds=15)
    print(f"\n{LANES} replicas on the windy cliff, fp64, one core\n\n| what | M tuple-updates/s a core |\n|---|---|")
    for name, value in seconds.items():
        updates = n * (4 if name.startswith("one stream,") else LANES)
        print(f"| {name} | {updates / value / 1e6:.0f} |")
    if library is not None:
        for name in ("own streams, recorded", "one shared stream"):
            print(f"\n{name}: {seconds[name + ': C++ in AVX2'] / seconds[name]:.2f} of C++ in AVX2")


def epoch(engine: Engine, lanes: Lanes, pool: ThreadPoolExecutor) -> Callable[[], object]:
    """One epoch of the second biasing iteration's kind, lines 9-12."""
    state = engine.step(engine.init(), lanes, pool)
    return lambda: engine.step(state, lanes, pool)


def wall(work: dict[str, Callable[[], object]], rounds: int) -> dict[str, float]:
    times: dict[str, list[float]] = {name: [] for name in work}
    for once in range(rounds + 1):
        for name, call in work.items():
            tick = time.perf_counter()
            call()
            if once:
                times[name].append(time.perf_counter() - tick)
    return {name: statistics.median(seconds) for name, seconds in times.items()}


def bench_threads() -> None:
    mdp, n = WindyCliffEnv().mdp, 256
    work: dict[str, Callable[[], object]] = {}
    pools = {threads: ThreadPoolExecutor(threads) for threads in (1, 2)}
    for kind, keep in (("recorded", True), ("sampled", False)):
        for threads, pool in pools.items():
            simulation = Simulation(mdp, 50, 1000, range(n), keep=keep)
            engine = Engine(Replicas.of(AlgorithmS1(), n, threads=threads, block=32), simulation, 15, 4)
            work[f"{kind}, {threads}"] = epoch(engine, engine.prepare(pool), pool)
    for threads, pool in pools.items():
        data = collect(mdp, 50, 1000, 0)
        betas = np.linspace(1, 10, n)
        engine = Engine(Replicas.of(AlgorithmS1(), beta=betas, threads=threads, block=32), data, 15, 4)
        work[f"shared, {threads}"] = epoch(engine, engine.prepare(pool), pool)
    seconds = wall(work, rounds=9)
    print(f"\n{n} replicas, 50,000 tuples each, whole epochs, wall seconds\n")
    print("| streams | one thread, M/s | two threads, M/s | ratio |\n|---|---|---|---|")
    for kind in ("recorded", "sampled", "shared"):
        one, two = seconds[f"{kind}, 1"], seconds[f"{kind}, 2"]
        print(f"| {kind} | {n * 0.05 / one:.0f} | {n * 0.05 / two:.0f} | {one / two:.2f} |")


def ring(n_states: int) -> TabularMDP:
    """A cycle of states with four actions: steps of -1, 0, 1 and a wide one, each with two outcomes."""
    s = np.arange(n_states)
    rows = []
    for step in (-1, 0, 1, max(2, n_states // 7)):
        rows.append(np.stack([(s + step) % n_states, (s + step + 1) % n_states], axis=1))
    indices = np.stack(rows, axis=1).reshape(-1)
    import scipy.sparse as sp

    n = 4 * n_states
    p = sp.csr_array((np.tile([0.75, 0.25], n), indices, np.arange(0, 2 * n + 1, 2)), shape=(n, n_states))
    return TabularMDP(p, -np.random.default_rng(0).random((n_states, 4)))


def bench_figure() -> None:
    """CPU throughput of whole epochs, one thread."""
    pool = ThreadPoolExecutor(1)
    counts, sizes = (1, 4, 16, 32, 64, 256, 1024, 4096), (60, 400, 4_000, 40_000, 400_000)
    found: dict[str, dict[str, list[float | None]]] = {}
    for kind in ("recorded", "sampled", "shared"):
        found[kind] = {}
        for n_pairs in sizes:
            mdp = WindyCliffEnv().mdp if n_pairs == 60 else ring(n_pairs // 4)
            row: list[float | None] = []
            for n in counts:
                if n * n_pairs > 40_000_000:
                    row.append(None)  # tables of more than a gigabyte
                    continue
                tuples = max(5_000, min(200_000, 8_000_000 // n), n_pairs if n < 64 else 0)
                learner = AlgorithmS1(beta=2.0)
                if kind == "shared":
                    replicas = Replicas.of(learner, beta=np.linspace(1, 2, n), threads=1)
                    engine = Engine(replicas, collect(mdp, 1, tuples, 0), n_pairs // 4, 4)
                else:
                    simulation = Simulation(mdp, 1, tuples, range(n), keep=kind == "recorded")
                    engine = Engine(Replicas.of(learner, n, threads=1), simulation, n_pairs // 4, 4)
                call = epoch(engine, engine.prepare(pool), pool)
                value = medians({"": call}, rounds=5)[""]
                row.append(n * tuples / value / 1e6)
                print(f"{kind:9} {n_pairs:7,} entries {n:5,} replicas {row[-1]:7.0f} M/s", flush=True)
            found[kind][str(n_pairs)] = row
    (RESULTS / "replicas_throughput.json").write_text(
        json.dumps({"replicas": counts, "M tuple-updates/s, one thread, by streams and table entries": found}, indent=1)
        + "\n"
    )
    draw(counts, found)


def draw(counts: Sequence[int], found: dict[str, dict[str, list[float | None]]]) -> None:
    figure = Figure(figsize=(11, 3.8), dpi=110)
    titles = ("own streams, recorded", "own streams, sampled as used", "one shared stream")
    colours = ("#0072b2", "#56b4e9", "#009e73", "#e69f00", "#d55e00")
    for i, curves in enumerate(found.values()):
        axes = figure.add_axes((0.065 + 0.315 * i, 0.14, 0.27, 0.72))
        for (n_pairs, values), colour in zip(curves.items(), colours, strict=True):
            points = [(n, value) for n, value in zip(counts, values, strict=True) if value is not None]
            axes.plot(*zip(*points, strict=True), "o-", color=colour, markersize=4, label=f"{int(n_pairs):,}")
        axes.set_xscale("log", base=2)
        axes.set_xticks([1, 16, 256, 4096], ["1", "16", "256", "4096"])
        axes.set_ylim(0, 1.35 * axes.dataLim.ymax)  # room for the legend
        axes.grid(True, color="#dddddd")
        axes.set_axisbelow(True)
        axes.set_title(titles[i], fontsize=10)
        axes.set_xlabel("replicas")
        if i == 0:
            axes.set_ylabel("million tuple-updates/s, one core")
            axes.legend(title="table entries S x A", fontsize=8, title_fontsize=8, ncols=3, loc="upper left")
    FigureCanvasAgg(figure).print_png(str(RESULTS / "replicas_throughput.png"))


def bench_command() -> None:
    print("\nFigure 5 with 200 replicas, whole command (9 billion u updates, evaluation after every epoch included)\n")
    print("| command | wall seconds | largest resident memory, GB |\n|---|---|---|")
    with tempfile.TemporaryDirectory() as directory:
        for arguments in (["n_replicas=200", "keep_tuples=false"], ["n_replicas=200"]):  # the larger one last
            tick = time.perf_counter()
            subprocess.run(
                [sys.executable, str(ROOT / "train.py"), *arguments], cwd=directory, check=True, capture_output=True
            )
            seconds = time.perf_counter() - tick
            memory = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1e6  # of all children so far
            print(f"| `python train.py {' '.join(arguments)}` | {seconds:.1f} | {memory:.2f} |", flush=True)


def bench_learners() -> None:
    mdp, n = WindyCliffEnv().mdp, 16
    print(f"\n{n} replicas, 100,000 tuples each, whole fits, wall seconds\n")
    print("| learner | one by one | replicas | ratio |\n|---|---|---|---|")
    for learner in (AlgorithmS1(), EfficientS1(), CertaintyEquivalence()):

        def alone(learner: object = learner) -> None:
            for seed in range(n):
                learner.fit(collect(mdp, 100, 1000, seed), 15, 4)  # type: ignore[attr-defined]

        def together(learner: object = learner) -> None:
            Replicas.of(learner, n).fit(Simulation(mdp, 100, 1000, range(n)), 15, 4)

        seconds = wall({"alone": alone, "together": together}, rounds=3)
        ratio = seconds["alone"] / seconds["together"]
        print(f"| {type(learner).__name__} | {seconds['alone']:.2f} | {seconds['together']:.2f} | {ratio:.2f} |")


if __name__ == "__main__":
    torch.set_num_threads(1)
    parts = {
        "kernels": bench_kernels,
        "threads": bench_threads,
        "figure": bench_figure,
        "command": bench_command,
        "learners": bench_learners,
    }
    for part in sys.argv[1:] or parts:
        parts[part]()
