"""Speed of the environments, each figure beside Gymnasium's in one run.

    python benchmarks/bench_envs.py          all parts (about a minute)
    python benchmarks/bench_envs.py steps    steps/s of every task: env.step, our batched sampling, their ratio
    python benchmarks/bench_envs.py acrobot  the whole Acrobot model of Table S2: wall time, peak memory
    python benchmarks/bench_envs.py rollout  128 episodes of 500 steps in the original dynamics
    python benchmarks/bench_envs.py mazes    1,000 random 30x30 mazes with their sparse models

Sampling is everything behind a model: draw the state, step, bin, count. Of env.step only the step is timed, after the
state is set by hand. CPU seconds of one thread; medians of interleaved rounds.
"""

from __future__ import annotations

import os
import resource
import statistics
import subprocess
import sys
import time
from collections import deque
from typing import Any

import gymnasium as gym
import numpy as np
import torch

from erl_torch import estimate_mdp, rollout
from erl_torch.envs import CONTROL_TASKS
from erl_torch.envs.control import ControlTask, control_task
from erl_torch.envs.mazes import random_mazes

FEW = 2000  # env.step's share of a round


def by_stepping(task: ControlTask) -> float:
    """CPU seconds a step of Gymnasium's env.step, states uniform in the binned box."""
    rng = np.random.default_rng(0)
    env: Any = gym.make(task.gymnasium_id).unwrapped
    env.reset(seed=0)
    states = list(rng.uniform(task.low, task.high, (FEW, len(task.low))))
    if isinstance(env.action_space, gym.spaces.Box):
        actions = list(rng.choice(task.actions, (FEW, 1)))
    else:
        actions = list(rng.integers(len(task.actions), size=FEW))
    tick = time.process_time()
    for state, action in zip(states, actions, strict=True):
        env.state = state
        env.steps_beyond_terminated = None  # CartPole warns otherwise
        env.step(action)
    return (time.process_time() - tick) / FEW


def by_sampling(task: ControlTask, n_samples: int) -> float:
    """CPU seconds a step of ``estimate_mdp``."""
    tick = time.process_time()
    model = estimate_mdp(task, n_samples=n_samples, workers=1, cache=False)
    return (time.process_time() - tick) / (model.mdp.reward.size * n_samples)


def bench_steps(rounds: int = 5) -> None:
    print("\nmillion steps/s, one thread\n")
    print("| task | `env.step`, state set by hand | batched sampling | ratio |\n|---|---|---|---|")
    for name in CONTROL_TASKS:
        task = control_task(name)
        samples = {"acrobot": 30, "cart_pole": 500}.get(name, 5000)
        by_sampling(task, samples)
        pairs = [(by_stepping(task), by_sampling(task, samples)) for _ in range(rounds)]
        slow, fast = (statistics.median(column) for column in zip(*pairs, strict=True))
        print(f"| {task.gymnasium_id} | {1e-6 / slow:.3f} | {1e-6 / fast:.1f} | {slow / fast:.0f} |")


def bench_acrobot() -> None:
    if "--child" not in sys.argv:  # memory is measured in a process of its own
        subprocess.run([sys.executable, __file__, "acrobot", "--child"], check=True)
        return
    tick = time.perf_counter()
    model = estimate_mdp("acrobot", cache=False)
    wall = time.perf_counter() - tick
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    steps = model.mdp.reward.size * 500 / 1e6
    print(f"\nAcrobot, 12^4 cells x 3 actions x 500 samples = {steps:.1f} M steps, {os.cpu_count()} cores: ", end="")
    print(f"{wall:.1f} s, peak {peak:.2f} GiB resident, {model.mdp.transition.nnz:,} transitions")


def bench_rollout() -> None:
    print("\n128 episodes of at most 500 steps under the uniform policy, wall seconds\n")
    print("| task | seconds | steps |\n|---|---|---|")
    for name in CONTROL_TASKS:
        task = control_task(name)
        n_states, n_actions = task.uniform_bins().n_cells, len(task.actions)
        policy = np.full((n_states, n_actions), 1 / n_actions)
        seconds = []
        for _ in range(4):
            tick = time.perf_counter()
            played = rollout(task, policy, 128, 500, np.random.default_rng(0))
            seconds.append(time.perf_counter() - tick)
        print(f"| {task.gymnasium_id} | {statistics.median(seconds[1:]):.2f} | {played.lengths.sum():,} |")


def bench_mazes() -> None:
    deque(random_mazes(2), maxlen=0)  # compiles
    tick = time.perf_counter()
    mazes = list(random_mazes(1000, 30, density=0.25))
    drawn = time.perf_counter()
    for maze in mazes:
        maze.mdp()
    done = time.perf_counter()
    print(f"\n1,000 mazes of 30x30: {drawn - tick:.1f} s, their sparse models {done - drawn:.1f} s, one core")


if __name__ == "__main__":
    torch.set_num_threads(1)
    parts = {"steps": bench_steps, "acrobot": bench_acrobot, "rollout": bench_rollout, "mazes": bench_mazes}
    for part in [name for name in sys.argv[1:] if name in parts] or parts:
        parts[part]()
