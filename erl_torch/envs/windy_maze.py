"""One random maze of the paper's Table S1 as an environment."""

from __future__ import annotations

from erl_torch.envs.mazes import random_maze
from erl_torch.envs.tabular import GridWorldEnv


class WindyMazeEnv(GridWorldEnv):
    """Cross a random maze of traps and changing winds.

    ## Description
    A square of floor tiles, S near the lower left corner, G near the upper right, random traps and a random wind that
    changes smoothly from tile to tile: `erl_torch.envs.mazes`. Rules: `erl_torch.envs.grid_world`.

    ## Action Space
    `Discrete(4)`: 0 left, 1 down, 2 right, 3 up.

    ## Observation Space
    `Discrete(size * size)`: row * size + col, row 0 on top.

    ## Starting State
    The S tile.

    ## Rewards
    Of the tile being left: H `trap_reward` (-2), G 0, any other -1.

    ## Episode End
    None: a step out of H or G leads to the start. The registered environment truncates after 1000 steps.

    ## Arguments
    `size`, `n_traps` (null: round(size * density)), `density`, `wind_level` (strength ~ Beta(wind_level, 2)),
    `maze_seed`, `trap_reward`, `render_mode` ("ansi" or "rgb_array").

    ## Version History
    v0: as in the paper; a `maze_seed` gives the same maze in every version.
    """

    def __init__(
        self,
        size: int = 10,
        n_traps: int | None = 10,
        density: float = 0.2,
        wind_level: float = 2.0,
        maze_seed: int = 0,
        trap_reward: float = -2.0,
        render_mode: str | None = None,
    ) -> None:
        super().__init__(random_maze(size, n_traps, density, wind_level, maze_seed, trap_reward), render_mode)
