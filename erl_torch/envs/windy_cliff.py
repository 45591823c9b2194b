"""The windy cliff of the paper's Figures 1 and 5."""

from __future__ import annotations

import math

from erl_torch.envs.grid_world import GridWorld, uniform_wind
from erl_torch.envs.tabular import GridWorldEnv

DESC = ("HGR", "HFF", "HFF", "HFF", "HSR")


class WindyCliffEnv(GridWorldEnv):
    """Walk up a path beside a cliff while the wind blows towards it.

    ## Description
    Five rows of three tiles, `HGR / HFF / HFF / HFF / HSR`: traps H along the left edge, the goal G on top,
    the start S at the bottom, wind on the six F tiles. Rules: `erl_torch.envs.grid_world`.

    ## Action Space
    `Discrete(4)`: 0 left, 1 down, 2 right, 3 up.

    ## Observation Space
    `Discrete(15)`: row * 3 + col, row 0 on top.

    ## Starting State
    The S tile, state 13.

    ## Rewards
    Of the tile being left: H `trap_reward` (-5), G 0, any other -1.

    ## Episode End
    None: a step out of H or G, whatever the action, goes to the start. The registered environment
    truncates after 1000 steps.

    ## Arguments
    `wind_angle` (radians, rows grow downward; 3 pi/4: to the left and down), `wind_strength` in [0, 1]
    (0.7: left .35, down .35, none .30), `trap_reward`, `render_mode` ("ansi" or "rgb_array").

    ## Version History
    v0: as in the paper.
    """

    def __init__(
        self,
        wind_angle: float = 0.75 * math.pi,
        wind_strength: float = 0.7,
        trap_reward: float = -5.0,
        render_mode: str | None = None,
    ) -> None:
        super().__init__(GridWorld(DESC, uniform_wind(wind_angle, wind_strength), trap_reward), render_mode)
