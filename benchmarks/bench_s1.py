"""Speed of Algorithm S1, each figure beside its alternatives in one run.

    python benchmarks/bench_s1.py            all parts (about three minutes)
    python benchmarks/bench_s1.py kernels    u phase: compiled kernel, C++, NumPy-array code
    python benchmarks/bench_s1.py psi        psi phase: cost of an epoch against the number of tuples
    python benchmarks/bench_s1.py notes      the pass that notes and the interval of theta need, against the learning
    python benchmarks/bench_s1.py commands   whole commands: the default run, --help

CPU seconds of this process; medians of interleaved rounds. C++ needs g++ and is left out without it.
"""

from __future__ import annotations

import ctypes
import math
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from erl_torch import AlgorithmS1, CertaintyEquivalence, EfficientS1, Transitions, collect
from erl_torch.empirical import reservations
from erl_torch.envs.windy_cliff import WindyCliffEnv
from erl_torch.experience.experience import Experience
from erl_torch.experience.formats.npy import ColumnWriter
from erl_torch.experience.recording import read_experience
from erl_torch.learners.s1 import kernels, listing
from erl_torch.learners.s1.algorithm import S1Stream

ROOT = Path(__file__).parents[1]
LR_U, LR_RHO, BETA = 0.005, 0.005 / 15, 10.0


def medians(work: dict[str, Callable[[], object]], rounds: int = 7) -> dict[str, float]:
    """Median CPU seconds of each, in turn, after one warm-up."""
    times: dict[str, list[float]] = {name: [] for name in work}
    for once in range(rounds + 1):
        for name, call in work.items():
            tick = time.process_time()
            call()
            if once:
                times[name].append(time.process_time() - tick)
    return {name: statistics.median(seconds) for name, seconds in times.items()}


def compile_cpp(directory: str) -> ctypes.CDLL | None:
    if shutil.which("g++") is None:
        return None
    library = Path(directory) / "one_division.so"
    source = Path(__file__).with_name("one_division.cpp")
    flags = ["-O3", "-march=native", "-shared", "-fPIC"]
    subprocess.run(["g++", *flags, str(source), "-o", str(library)], check=True)
    return ctypes.CDLL(str(library))


def bench_kernels() -> None:
    env = WindyCliffEnv()
    data = collect(env, 2000, 1000, 0)  # 2 M tuples
    few = collect(env, 50, 1000, 0)  # the NumPy code is slow
    learner = AlgorithmS1(beta=BETA, lr_u=LR_U, lr_rho=LR_RHO)
    stream = learner.prepare(data, 15, 4)
    g = np.exp(BETA * stream.reward)
    z, rho = np.ones(60), math.exp(-BETA)

    def fast() -> None:
        z[:] = 1
        kernels.u_epoch(
            stream.pair, stream.pair_next, stream.factor, False, g, z, 1 / rho, LR_U, LR_RHO, 1.0, True, 5000,
            0, len(data),
        )  # fmt: skip

    u, one, zero = np.ones((15, 4)), np.ones((15, 4)), np.zeros((15, 4))

    def numpy_code() -> None:
        u[:] = 1
        listing.u_epoch(
            few, np.ones(15), one, zero, 0.0, u, rho, beta=BETA, lr_u=LR_U, lr_rho=LR_RHO, rho_max=1.0,
            self_loop="new", rescale_every=5000,
        )  # fmt: skip

    pairs, nexts = stream.pair[: len(few)].tolist(), stream.pair_next[: len(few)].tolist()

    def tight_numpy() -> None:
        root = rho
        z[:] = 1
        for k, j in zip(pairs, nexts, strict=True):
            w = g[k] * z[j]
            z[k] += LR_U * (w / root - z[k])
            root += LR_RHO * (w / z[k] - root)

    def whole_fit() -> None:
        AlgorithmS1(beta=BETA, lr_u=LR_U, lr_rho=LR_RHO, n_epochs=1, n_bias=1).fit(data, 15, 4)

    work = {
        "kernel": fast,
        "whole fit, one epoch": whole_fit,
        "NumPy arrays, tightest loop": tight_numpy,
        "NumPy arrays, as listed (literal)": numpy_code,
    }
    with tempfile.TemporaryDirectory() as directory:
        library = compile_cpp(directory)
        if library is not None:

            def cpp(function: ctypes._NamedFuncPointer, scale: float) -> Callable[[], None]:
                function.restype = ctypes.c_double
                pointers = [x.ctypes.data_as(ctypes.c_void_p) for x in (stream.pair, stream.pair_next, g, z)]
                scalars = [ctypes.c_double(x) for x in (scale, LR_U, LR_RHO, 1.0)]

                def call() -> None:
                    z[:] = 1
                    function(*pointers, *scalars, ctypes.c_int(1), ctypes.c_int64(len(data)))

                return call

            work["C++, the same loop"] = cpp(library.u_chunk, 1 / rho)
            work["C++, the listing's two divisions"] = cpp(library.listing, rho)
        seconds = medians(work)
    for name in seconds:
        seconds[name] *= len(data) / len(few) if name.startswith("NumPy") else 1
    print(f"\nu phase, windy cliff, {len(data):,} tuples, one core, fp64\n")
    print("| what | M tuples/s | kernel is |\n|---|---|---|")
    for name, value in seconds.items():
        print(f"| {name} | {len(data) / value / 1e6:.4g} | {value / seconds['kernel']:.3g} x |")


def bench_psi() -> None:
    print("\npsi phase, windy cliff: preparing the stream once, then ms an epoch\n")
    print("| tuples | prepare, ms | affine epoch, ms | sequential epoch (NumPy arrays), ms |\n|---|---|---|---|")
    env = WindyCliffEnv()
    psi = np.random.default_rng(0).lognormal(size=15)
    for n in (50_000, 500_000, 5_000_000):
        data, few = collect(env, n // 1000, 1000, 0), collect(env, 20, 1000, 0)
        stream = AlgorithmS1().prepare(data, 15, 4)

        def prepare(data: Transitions = data) -> None:
            AlgorithmS1().prepare(data, 15, 4)

        def epochs(stream: S1Stream = stream) -> None:
            tables = psi, np.log(psi), np.ones(60), np.zeros(60)
            kernels.psi_phase(*stream.psi_map, stream.decay, *tables, 0.0, 1e-10, 10_000)

        def sequential(few: Transitions = few) -> None:
            listing.psi_epoch(few, psi, np.log(psi), np.ones((15, 4)), np.zeros((15, 4)), 0.1)

        seconds = medians({"prepare": prepare, "epochs": epochs, "sequential": sequential}, rounds=3)
        epoch, slow = seconds["epochs"] / 10_000, seconds["sequential"] * len(data) / len(few)
        print(f"| {n:,} | {seconds['prepare'] * 1e3:.3g} | {epoch * 1e3:.3g} | {slow * 1e3:.4g} |")


def bench_notes() -> None:
    print("\n| stream | pass, ms | a tuple, ns | learner | learning, s | pass / learning |\n|---|---|---|---|---|---|")
    env = WindyCliffEnv()
    learners: dict[str, Any] = {"s1": AlgorithmS1(), "s1_efficient": EfficientS1()}
    learners["certainty_equivalence"] = CertaintyEquivalence()
    with tempfile.TemporaryDirectory() as directory:
        held = collect(env, 500, 1000, 0)
        with ColumnWriter(Path(directory) / "tuples") as writer:
            writer.append(collect(env, 5000, 1000, 0))
        streams: dict[str, Experience] = {
            "500,000 tuples, simulated": held,
            "5,000,000 tuples, recorded": read_experience(f"{directory}/tuples/", 15, 4),
        }
        for name, data in streams.items():
            for which, learner in learners.items():
                next_actions = learner.drawn_from_prior == "a_next"

                def count(data: Experience = data, next_actions: bool = next_actions) -> None:
                    reservations.count(data, 15, 4, next_actions)

                def fit(data: Experience = data, learner: Any = learner) -> None:
                    learner.fit(data, 15, 4)

                seconds = medians({"pass": count, "fit": fit}, rounds=3)
                each = f"{seconds['pass'] * 1e3:.3g} | {seconds['pass'] / len(data) * 1e9:.3g}"
                ratio = seconds["pass"] / seconds["fit"]
                print(f"| {name} | {each} | `{which}` | {seconds['fit']:.3g} | {ratio:.2g} |", flush=True)


def bench_commands() -> None:
    print("\nwhole commands, wall seconds, median (min to max) of 7, compile cache warm\n")
    print("| command | seconds |\n|---|---|")
    with tempfile.TemporaryDirectory() as directory:
        for arguments in (["env=windy_cliff"], ["--help"]):
            seconds = []
            for once in range(8):
                tick = time.perf_counter()
                command = [sys.executable, str(ROOT / "train.py"), *arguments]
                subprocess.run(command, cwd=directory, check=True, capture_output=True)
                if once:
                    seconds.append(time.perf_counter() - tick)
            middle, low, high = statistics.median(seconds), min(seconds), max(seconds)
            print(f"| `python train.py {' '.join(arguments)}` | {middle:.2f} ({low:.2f} to {high:.2f}) |")


if __name__ == "__main__":
    torch.set_num_threads(1)
    parts = {"kernels": bench_kernels, "psi": bench_psi, "notes": bench_notes, "commands": bench_commands}
    for part in sys.argv[1:] or parts:
        parts[part]()
