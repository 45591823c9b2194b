"""Windy frozen lakes: maps for teaching, by name, or rows of tiles of one's own."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from erl_torch.checks import InputError
from erl_torch.envs.grid_world import GridWorld, uniform_wind
from erl_torch.envs.tabular import GridWorldEnv
from erl_torch.mdp.tabular import TabularMDP

MAPS = {
    # Nothing in the way: what wind alone does to a policy.
    "empty": ("FFFFFFF", "FSFFFFF", "FFFFFFF", "FFFFFFF", "FFFFFFF", "FFFFFGF", "FFFFFFF"),
    # Scattered traps: the straight way is not the safe one.
    "holes": ("SFFFFFFF", "FFHFFFHF", "FFFFFFFF", "FHFFHFFF", "FFFFFFFF", "FFHFFFHF", "FFFFFFFF", "HFFFHFFG"),
    # A short windy ridge between traps, or a long sheltered way round.
    "ridge": ("RHHHHHHHR", "SFFFFFFFG", "RHHHHHHHR", "RRRRRRRRR"),
    # Walls that force a long way: wind blocked on one side.
    "zigzag": ("SFFFFFF", "WWWWWFF", "FFFFFFF", "FFWWWWW", "FFFFFFF", "WWWWWFF", "GFFFFFF"),
    # Doors to find, two ways to the goal.
    "four_rooms": (
        "SFFFWFFFF", "FFFFWFFFF", "FFFFFFFFF", "FFFFWFFFF", "WWFWWWFWW",
        "FFFFWFFFF", "FFFFFFFFF", "FFFFWFFFF", "FFFFWFFFG",
    ),
}  # fmt: skip


def _tiles(desc: str | Sequence[str]) -> tuple[str, ...]:
    """Rows of tiles; a text is the name of a map."""
    if not isinstance(desc, str):
        return tuple(desc)
    if desc not in MAPS:
        raise InputError("desc", desc, f"rows of tiles or a map: {', '.join(sorted(MAPS))}")
    return MAPS[desc]


def windy_frozen_lake(
    desc: str | Sequence[str] = "holes",
    wind: np.ndarray | None = None,
    trap_reward: float = -2.0,
    n_actions: int = 4,
    action_success_prob: float | Sequence[float] = 1.0,
    tile_rewards: Mapping[str, float] | None = None,
) -> TabularMDP:
    """The TabularMDP of a windy lake, without making an environment.

    Args:
        desc: rows of tiles, or the name of a map.
        wind: [2, rows, cols], angle (radians) and strength; None is no wind.
        trap_reward, n_actions, action_success_prob, tile_rewards: as in ``GridWorld``.

    Raises:
        InputError: as ``GridWorld``, or an unknown map.
    """
    rules = dict(tile_rewards or {})
    field = uniform_wind(0.0, 0.0) if wind is None else wind
    return GridWorld(_tiles(desc), field, trap_reward, action_success_prob, n_actions, tile_rewards=rules).mdp()


class WindyFrozenLakeEnv(GridWorldEnv):
    """Cross a frozen lake on which the wind pushes.

    ## Description
    A grid of tiles: S start, F floor with wind, R floor without wind, H trap, G goal, W wall, C and N floors that
    cost less and more. Rules: `erl_torch.envs.grid_world`.

    ## Action Space
    `Discrete(n_actions)`: 0 left, 1 down, 2 right, 3 up; with 5 or 9 actions 4 is stay; with 9 (8) the
    diagonals left-down, down-right, right-up, up-left are 5..8 (4..7).

    ## Observation Space
    `Discrete(rows * cols)`: row * cols + col, row 0 on top.

    ## Starting State
    One of the S tiles; of the F tiles if there is no S.

    ## Rewards
    Of the tile being left: H `trap_reward` (-2), G 0, C -0.5, N -1.5, any other -1; a diagonal step costs sqrt(2)
    times as much. `tile_rewards` overrides them, as `{"C": 0.5}`.

    ## Episode End
    Cyclic: none, a step out of H or G leads to the start. With `cyclic=False` that step ends the episode (it
    stays there). The registered environment truncates after 1000 steps.

    ## Arguments
    `desc` (a map's name: empty, four_rooms, holes, ridge, zigzag; or rows of tiles), `wind` (array
    [2, rows, cols] of angle and strength; default the same everywhere: `wind_angle` in radians, rows grow downward,
    and `wind_strength` in [0, 1]), `n_actions` (4, 5, 8, 9), `action_success_prob` (a number, or one per action),
    `cyclic`, `trap_reward`, `tile_rewards`, `render_mode` ("ansi" or "rgb_array").

    ## Version History
    v0: first version.
    """

    def __init__(
        self,
        desc: str | Sequence[str] = "holes",
        wind: np.ndarray | None = None,
        wind_angle: float = 0.75 * math.pi,
        wind_strength: float = 0.3,
        n_actions: int = 4,
        action_success_prob: float | Sequence[float] = 1.0,
        cyclic: bool = True,
        trap_reward: float = -2.0,
        tile_rewards: Mapping[str, float] | None = None,
        render_mode: str | None = None,
    ) -> None:
        field = uniform_wind(wind_angle, wind_strength) if wind is None else wind
        rules = dict(tile_rewards or {})
        grid = GridWorld(_tiles(desc), field, trap_reward, action_success_prob, n_actions, cyclic, rules)
        super().__init__(grid, render_mode)
