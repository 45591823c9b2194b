"""Updates a core-second of small networks: compiled, by autograd, and C++ compiled on the spot.

    OPENBLAS_NUM_THREADS=1 python benchmarks/networks_speed.py

64x64, minibatches of 64, observations of 8 numbers, 4 actions; medians of interleaved rounds.
"""

from __future__ import annotations

import ctypes
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch

from erl_torch.networks import kernels
from erl_torch.networks.learner import AverageSoftQ, DeepS1, NetworkLearner
from erl_torch.networks.problem import BoxProblem
from erl_torch.networks.replay import Steps

ROUNDS, N, D, A = 7, 20_000, 8, 4


def compiled_on_the_spot() -> ctypes.CDLL:
    """The yardstick."""
    source = Path(__file__).with_name("networks_yardstick.cpp")
    target = Path(tempfile.mkdtemp()) / "yardstick.so"
    flags = ["-O3", "-march=native", "-ffast-math", "-shared", "-fPIC"]
    subprocess.run(["g++", *flags, str(source), "-o", str(target)], check=True)
    return ctypes.CDLL(str(target))


def main() -> None:
    torch.set_num_threads(1)
    rng = np.random.default_rng(0)
    data = Steps(
        rng.normal(size=(N, D)), rng.integers(A, size=N), rng.normal(size=N), rng.normal(size=(N, D)), np.zeros(N, bool)
    )
    problem = BoxProblem(lambda: gym.make("CartPole-v1"), D, A)
    library = compiled_on_the_spot()
    pointer = lambda x: x.ctypes.data_as(ctypes.c_void_p)  # noqa: E731
    real = ctypes.c_float
    for kind in (AverageSoftQ, DeepS1):
        many, few = 4000, 300
        learner: NetworkLearner = kind(beta=2.0, n_steps=10**9, epoch_steps=many)
        plain = replace(learner, path="autograd", epoch_steps=few)
        start = learner.begin(problem, data)
        arrays = [x.numpy().copy() for x in (start.weights, start.lagged, start.m, start.v)]
        numbers, random = np.zeros(kernels.N_NUMBERS), start.random.copy().view(np.uint64)

        def yardstick(arrays=arrays, numbers=numbers, random=random, learner=learner, many=many):
            library.advance(
                *map(pointer, (*arrays, numbers, random, data.observation, data.action, data.reward, data.following)),
                D, A, N, many, 64, 64, 64, int(learner.separate), real(2.0), real(1e-3), real(0.01), real(0.01),
            )  # fmt: skip
            return many

        ways: dict[str, Callable[[], int]] = {
            "compiled": lambda learner=learner, start=start, many=many: learner.epoch(problem, start, None) and many,  # type: ignore[misc]
            "C++": yardstick,
            "autograd": lambda plain=plain, start=start, few=few: plain.epoch(problem, start, None) and few,  # type: ignore[misc]
        }
        found: dict[str, list[float]] = {name: [] for name in ways}
        for _ in range(ROUNDS + 1):
            for name, way in ways.items():
                began = time.process_time()
                n = way()
                found[name].append(n / (time.process_time() - began))
        rates = {name: statistics.median(values[1:]) for name, values in found.items()}
        print(kind.__name__, {name: f"{rate:,.0f}" for name, rate in rates.items()}, end=" ")
        print(f"compiled/C++ {rates['compiled'] / rates['C++']:.2f}")


if __name__ == "__main__":
    main()
