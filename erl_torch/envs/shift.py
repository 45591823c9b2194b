"""The dynamics shift of the paper's Figure 4: an agent's motor for "up" breaks."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

from erl_torch import checks
from erl_torch.envs.grid_world import GridWorld, uniform_wind
from erl_torch.envs.tabular import GridWorldEnv

DESC = ("HRRG", "FRHR", "FHHR", "FRRS")
SUCCESS = 0.99  # of every action before the shift
UP_SUCCESS = 1e-4  # of "up" after it, as published; the authors' later script has 0.01


class DynamicsShift(NamedTuple):
    """The same grid before and after the shift."""

    before: GridWorld
    after: GridWorld


def dynamics_shift(up_success: float = UP_SUCCESS) -> DynamicsShift:
    """Both grids. ``up_success``: probability in [0, 1] that "up" works after the shift; raises InputError."""
    before = GridWorld(DESC, uniform_wind(1.5 * math.pi, 0.5), trap_reward=-2.0, action_success_prob=SUCCESS)
    return DynamicsShift(before, replace(before, action_success_prob=(SUCCESS, SUCCESS, SUCCESS, up_success)))


class DynamicsShiftEnv(GridWorldEnv):
    """Reach the goal above the start, before or after the action "up" has broken.

    ## Description
    Four rows of four tiles, `HRRG / FRHR / FHHR / FRRS`. The short way up along the right edge needs "up"; after the
    shift only the wind, which blows upward on the three F tiles of the left edge, carries the agent there.
    Rules: `erl_torch.envs.grid_world`.

    ## Action Space
    `Discrete(4)`: 0 left, 1 down, 2 right, 3 up, each of which works with probability 0.99; after the shift "up"
    works with probability `up_success`.

    ## Observation Space
    `Discrete(16)`: row * 4 + col, row 0 on top.

    ## Starting State
    The S tile, state 15.

    ## Rewards
    Of the tile being left: H -2, G 0, any other -1.

    ## Episode End
    None: a step out of H or G leads to the start. The registered environment truncates after 1000 steps.

    ## Arguments
    `shifted` (default False), `up_success` (1e-4), `render_mode` ("ansi" or "rgb_array").

    ## Version History
    v0: as in the paper.
    """

    def __init__(self, shifted: bool = False, up_success: float = UP_SUCCESS, render_mode: str | None = None) -> None:
        grids = dynamics_shift(up_success)
        super().__init__(grids.after if checks.flag("shifted", shifted) else grids.before, render_mode)
