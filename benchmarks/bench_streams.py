"""Streams on disk against streams in memory.

    python benchmarks/bench_streams.py DIRECTORY [TUPLES]      windy cliff; written first where there is no DIRECTORY

CPU seconds of this process and tuples a CPU second; the part in memory is 2e7 tuples in a process of its own.
"""

from __future__ import annotations

import contextlib
import io
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import torch

from erl_torch import AlgorithmS1, CertaintyEquivalence, collect
from erl_torch.envs.windy_cliff import WindyCliffEnv
from erl_torch.experience.collect import record
from erl_torch.experience.recording import FileRecording
from erl_torch.learners import DifferentialSoftQ

IN_MEMORY = 20_000_000


def timed(name: str, n: int, work: Callable[[], Any]) -> Any:
    """Print one row of the table."""
    cpu, wall = time.process_time(), time.perf_counter()
    found = work()
    cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"| {name} | {cpu:.3g} | {wall:.3g} | {n / cpu / 1e6:.3g} | {peak:.0f} |", flush=True)
    return found


def passed(learner: Any, stream: Any) -> None:
    learner.step(learner.init(15, 4), stream)


def learn(data: Any) -> None:
    n = len(data)
    timed("certainty equivalence", n, lambda: CertaintyEquivalence().fit(data, 15, 4))
    for learner in (AlgorithmS1(n_epochs=1, n_bias=1), DifferentialSoftQ(n_epochs=1)):
        stream = timed(f"{type(learner).__name__}, prepare", n, partial(learner.prepare, data, 15, 4))
        timed(f"{type(learner).__name__}, pass", n, partial(passed, learner, stream))


def main(path: str, n: int) -> None:
    torch.set_num_threads(1)
    with contextlib.redirect_stdout(io.StringIO()):
        learn(collect(WindyCliffEnv(), 2, 1000, 0))  # compiles
    print("\n| what | CPU s | wall s | M tuples/s | largest resident, MB |\n|---|---|---|---|---|", flush=True)
    if path == "memory":
        learn(collect(WindyCliffEnv(), n // 1000, 1000, 7))
        return
    if not Path(path).exists():
        timed("write", n, lambda: record(WindyCliffEnv(), path, n // 1000, 1000, 7))
    data = timed("open: read, check, checksum", n, lambda: FileRecording(path, 15, 4))
    learn(data)
    subprocess.run([sys.executable, __file__, "memory", str(IN_MEMORY)], check=True)


if __name__ == "__main__":
    main(sys.argv[1], int(float(sys.argv[2])) if len(sys.argv) > 2 else 1_000_000_000)
