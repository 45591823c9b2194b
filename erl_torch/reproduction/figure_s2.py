"""Figure S2: pictures of the four control tasks."""

from __future__ import annotations

import os
from typing import Any

import gymnasium as gym
import numpy as np
from matplotlib.figure import Figure

from erl_torch.envs.control import control_task
from erl_torch.reproduction.artifact import Artifact, Output, Results, Units
from erl_torch.reproduction.control import TASKS


def units(scale: str, seed: int) -> Units:
    return {task: {"task": task, "seed": seed} for task in TASKS}


def work(task: str, seed: int) -> dict[str, Any]:
    """The picture [H, W, 3] of a first state."""
    os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # there need not be a display
    env = gym.make(control_task(task).gymnasium_id, render_mode="rgb_array")
    env.reset(seed=seed)
    picture = np.asarray(env.render(), dtype=np.uint8)
    env.close()
    return {"picture": picture}


def assemble(results: Results, scale: str) -> Output:
    figure = Figure(figsize=(9.6, 3.2))
    figure.text(0.02, 0.93, "Figure S2: the control tasks", fontsize=12, weight="bold")
    rows = []
    for i, (task, name) in enumerate(TASKS.items()):
        control = control_task(task)
        axes = figure.add_axes((0.02 + 0.245 * i, 0.03, 0.23, 0.68))
        axes.imshow(results[task]["picture"])
        axes.set_axis_off()
        axes.set_title(
            f"({'abcd'[i]}) {name}\n{control.bins[0]}^{len(control.bins)} cells, {len(control.actions)} actions",
            fontsize=9,
        )
        rows.append(
            {
                "environment": name, "gymnasium_id": control.gymnasium_id, "cells": int(np.prod(control.bins)),
                "actions": len(control.actions), "beta": control.beta, "low": list(control.low),
                "high": list(control.high),
            }
        )  # fmt: skip
    reading = [
        "First states of Gymnasium's own environments, drawn by Gymnasium. Cells, actions and beta are settings taken "
        "from Table S2: there is nothing to hold against the paper.",
    ]
    return Output(rows, [], figure, reading)


ARTIFACT = Artifact("figure_s2", "the four control tasks", units, work, assemble)
