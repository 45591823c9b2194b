"""Figure S2: pictures of the four control tasks."""

from __future__ import annotations

import os
from typing import Any

import gymnasium as gym
import numpy as np
from matplotlib.figure import Figure

from erl_torch.envs.control import control_task
from erl_torch.reproduction.artifact import REPRODUCED, Artifact, Comparison, Output, Results, Units, compared
from erl_torch.reproduction.control import TASKS

# Table S2: bins a variable, variables, actions
SPACES = {"pendulum": (16, 2, 3), "mountain_car": (12, 2, 3), "cart_pole": (8, 4, 2), "acrobot": (12, 4, 3)}
BETAS = {"pendulum": 1.0, "mountain_car": 2.0, "cart_pole": 10.0, "acrobot": 25.0}


def units(scale: str, seed: int) -> Units:
    return {task: {"task": task, "seed": seed} for task in TASKS}


def work(task: str, seed: int) -> dict[str, Any]:
    """The picture [H, W, 3] of a first state."""
    os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # nothing is shown: no display is looked for
    env = gym.make(control_task(task).gymnasium_id, render_mode="rgb_array")
    env.reset(seed=seed)
    picture = np.asarray(env.render(), dtype=np.uint8)
    env.close()
    return {"picture": picture}


def assemble(results: Results, scale: str) -> Output:
    figure = Figure(figsize=(9.6, 3.2))
    figure.text(0.02, 0.93, "Figure S2: the control tasks", fontsize=12, weight="bold")
    rows, comparisons = [], []
    for i, (task, name) in enumerate(TASKS.items()):
        its = control_task(task)
        n, variables, n_actions = SPACES[task]
        axes = figure.add_axes((0.02 + 0.245 * i, 0.03, 0.23, 0.68))
        axes.imshow(results[task]["picture"])
        axes.set_axis_off()
        axes.set_title(f"({'abcd'[i]}) {name}\n{n}^{variables} cells, {n_actions} actions", fontsize=9)
        rows.append(
            {
                "environment": name, "gymnasium_id": its.gymnasium_id, "cells": int(np.prod(its.bins)),
                "actions": len(its.actions), "beta": its.beta, "low": list(its.low), "high": list(its.high),
            }
        )  # fmt: skip
        comparisons += [
            Comparison(f"{name}: cells", f"{n}^{variables}", f"{its.bins[0]}^{len(its.bins)}", REPRODUCED),
            compared(f"{name}: actions", n_actions, len(its.actions), 0),
            compared(f"{name}: beta", BETAS[task], its.beta, 0),
        ]
    reading = ["First states of Gymnasium's own environments, drawn by Gymnasium."]
    return Output(rows, comparisons, figure, reading)


ARTIFACT = Artifact("figure_s2", "the four control tasks", units, work, assemble)
