"""Turn windy grid worlds, rows of tiles and a wind field, into TabularMDPs.

Rules (state = row * n_cols + col, row 0 on top)

    actions  0..3 = left, down, right, up, 4 = stay, 5..8 = left-down, down-right, right-up, up-left. With
             n_actions 4, 5 or 9 the first ones; with 8 all moves without stay: 4..7 are then the diagonals.
    tiles    S start, F floor with wind, R floor without wind, H trap, G goal, W wall, C and N floors
             that cost 0.5 and 1.5.
    reward   of the tile being LEFT: H `trap_reward`, G 0, C -0.5, N -1.5, any other -1; a diagonal step
             costs sqrt(2) times as much.
    ends     from H or G every action leads to the start distribution: uniform over the S tiles, or over
             the F tiles if there is no S. Nothing terminates (`cyclic`); otherwise that step ends the episode.
    moves    elsewhere the wind moves first, then the action, which succeeds with `action_success_prob[a]`
             and otherwise leaves the agent where the wind left it. Walls block each of the two moves; borders clip
             it, so that a diagonal step slides along them.
    wind     blows on F tiles only. With strength w in [0, 1], angle phi (rows grow downward),
             h = sqrt(w) cos(phi), v = sqrt(w) sin(phi): P(left) = max(0,-h)^2, P(down) = max(0,v)^2,
             P(right) = max(0,h)^2, P(up) = max(0,-v)^2, P(none) = the rest.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from erl_torch import checks
from erl_torch.checks import InputError
from erl_torch.mdp.tabular import TabularMDP

TILES = "SFRHGWCN"
END_TILES = "HG"
DEFAULT_REWARD = -1.0
TILE_REWARDS = {"G": 0.0, "C": -0.5, "N": -1.5}
# (row, col) of each action; the first five are the wind's, too.
MOVES = np.array([(0, -1), (1, 0), (0, 1), (-1, 0), (0, 0), (1, -1), (1, 1), (-1, 1), (-1, -1)])
MOVE_NAMES = ("left", "down", "right", "up", "stay", "left-down", "down-right", "right-up", "up-left")
ACTIONS = {4: [0, 1, 2, 3], 5: [0, 1, 2, 3, 4], 8: [0, 1, 2, 3, 5, 6, 7, 8], 9: [0, 1, 2, 3, 4, 5, 6, 7, 8]}


@dataclass(frozen=True, eq=False)
class GridWorld:
    """Tiles and wind.

    Args:
        desc: rows of tiles, all of one length.
        wind: angle (radians) and strength (in [0, 1]), [2, rows, cols], or [2] for all tiles; None is no wind.
        trap_reward: reward of leaving an H tile.
        action_success_prob: one number in [0, 1], or one per action.
        n_actions: 4, 5, 8 or 9.
        cyclic: H and G lead back to the start; False: a step from them ends the episode.
        tile_rewards: rewards of leaving a tile, where they differ from the rules, as {"C": -0.25}.

    Raises:
        InputError: ragged rows, unknown tiles, no start, a bad wind field, or an argument out of range.
    """

    desc: tuple[str, ...]
    wind: np.ndarray = None  # type: ignore[assignment]  # [2, rows, cols]
    trap_reward: float = -5.0
    action_success_prob: float | Sequence[float] = 1.0
    n_actions: int = 4
    cyclic: bool = True
    tile_rewards: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        rows = (self.desc,) if isinstance(self.desc, str) else tuple(str(row) for row in self.desc)
        if not rows or not rows[0] or len({len(row) for row in rows}) > 1:
            raise InputError("desc", list(rows), "one or more rows of one length")
        unknown = sorted(set("".join(rows)) - set(TILES))
        if unknown:
            raise InputError("desc", "".join(unknown), f"made of the tiles {' '.join(TILES)}")
        if not set("".join(rows)) & set("SF"):
            raise InputError("desc", list(rows), "a map with an S or F tile to start on")
        shape = (2, len(rows), len(rows[0]))
        wind = np.asarray((0, 0) if self.wind is None else self.wind, dtype=np.float64)
        if wind.shape == (2,):
            wind = np.broadcast_to(wind[:, None, None], shape)
        if wind.shape != shape:
            raise InputError("wind", f"array of shape {wind.shape}", f"of shape {shape}, or [2]")
        if not (np.isfinite(wind).all() and (wind[1] >= 0).all() and (wind[1] <= 1).all()):
            raise InputError("wind", "array", "finite angles and strengths in [0, 1]")
        if self.n_actions not in ACTIONS:
            raise InputError("n_actions", self.n_actions, " or ".join(map(str, ACTIONS)))
        success = np.asarray(self.action_success_prob)
        if success.dtype.kind not in "iuf":
            allowed = f"one number in [0, 1], or {self.n_actions} of them"
            raise InputError("action_success_prob", self.action_success_prob, allowed)
        if success.shape not in ((), (self.n_actions,)) or not ((success >= 0) & (success <= 1)).all():
            raise InputError(
                "action_success_prob", success.tolist(), f"one number in [0, 1], or {self.n_actions} of them"
            )
        if not (set(self.tile_rewards) <= set(TILES)):
            raise InputError("tile_rewards", list(self.tile_rewards), f"rewards of the tiles {' '.join(TILES)}")
        given = {"trap_reward": self.trap_reward} | {f"tile_rewards.{t}": r for t, r in self.tile_rewards.items()}
        for key, reward in given.items():
            checks.finite(key, reward)
        checks.flag("cyclic", self.cyclic)
        object.__setattr__(self, "desc", rows)
        object.__setattr__(self, "wind", wind)
        object.__setattr__(self, "action_success_prob", np.broadcast_to(success.astype(np.float64), self.n_actions))

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols)"""
        return len(self.desc), len(self.desc[0])

    @property
    def moves(self) -> np.ndarray:
        """[A, 2] (row, col) of each action."""
        return MOVES[ACTIONS[self.n_actions]]

    @property
    def action_names(self) -> tuple[str, ...]:
        return tuple(MOVE_NAMES[move] for move in ACTIONS[self.n_actions])

    @cached_property
    def tiles(self) -> np.ndarray:
        """[S] the letter of each state's tile."""
        return np.array(list("".join(self.desc)))

    @property
    def ends(self) -> np.ndarray:
        """[S] bool: traps and goals."""
        return np.isin(self.tiles, list(END_TILES))

    def wind_probabilities(self) -> np.ndarray:
        """[S, 5] probabilities that the wind moves the agent left, down, right, up, or not at all."""
        angle, strength = self.wind.reshape(2, -1)
        strength = np.where(self.tiles == "F", strength, 0.0)
        h, v = np.sqrt(strength) * np.cos(angle), np.sqrt(strength) * np.sin(angle)
        moved = np.maximum([-h, v, h, -v], 0).T ** 2  # [S, 4]
        return np.column_stack([moved, np.maximum(1 - moved.sum(1), 0)])

    def mdp(self) -> TabularMDP:
        """The grid world as a TabularMDP. H and G lead to the start, also where a step from them ends an episode."""
        n_states, n_actions = self.tiles.size, self.n_actions
        start = (self.tiles == ("S" if "S" in self.tiles else "F")).astype(np.float64)
        start /= start.sum()
        rewards = {**TILE_REWARDS, "H": self.trap_reward, **self.tile_rewards}
        reward = np.array([rewards.get(tile, DEFAULT_REWARD) for tile in self.tiles])
        cost = np.linalg.norm(self.moves, axis=1)  # 1, or sqrt(2) for diagonals
        cost[cost == 0] = 1.0

        free = np.flatnonzero(~self.ends)
        target = self._targets()  # [9, S]
        blown = target[:5, free].T  # [n, 5], where the wind leads
        wind = self.wind_probabilities()[free]  # [n, 5]
        moved = target[ACTIONS[n_actions]][:, blown].transpose(1, 0, 2)  # [n, A, 5]
        success = np.asarray(self.action_success_prob)[:, None]  # [A, 1]
        to = np.stack([moved, np.broadcast_to(blown[:, None], moved.shape)], -1)  # [n, A, 5, 2]
        p = np.stack([wind[:, None] * success, wind[:, None] * (1 - success)], -1)
        rows = np.broadcast_to((free[:, None] * n_actions + np.arange(n_actions))[:, :, None, None], to.shape)
        happens = p > 0

        ends, starts = np.flatnonzero(self.ends), np.flatnonzero(start)
        end_rows = (ends[:, None] * n_actions + np.arange(n_actions)).ravel()
        row = np.concatenate([rows[happens], np.repeat(end_rows, starts.size)])
        column = np.concatenate([to[happens], np.tile(starts, end_rows.size)])
        probability = np.concatenate([p[happens], np.tile(start[starts], end_rows.size)])
        shape = (n_states * n_actions, n_states)
        return TabularMDP(
            transition=sp.coo_array((probability, (row, column)), shape=shape),
            reward=reward[:, None] * cost,
            start=start,
        )

    def _targets(self) -> np.ndarray:
        """[9, S]: the state that one step in each direction leads to; borders and walls block it."""
        rows, cols = self.shape
        state = np.arange(rows * cols)
        here = np.stack(np.divmod(state, cols))  # [2, S]
        there = np.clip(here + MOVES[:, :, None], 0, [[rows - 1], [cols - 1]])  # [9, 2, S]
        target = there[:, 0] * cols + there[:, 1]
        return np.where(self.tiles[target] == "W", state, target)


def uniform_wind(wind_angle: float, wind_strength: float) -> np.ndarray:
    """The same wind everywhere, [2]. Raises InputError naming the argument."""
    angle = checks.number("wind_angle", wind_angle, math.isfinite, "a finite number (radians)")
    return np.array([angle, checks.number("wind_strength", wind_strength, lambda x: 0 <= x <= 1, "a number in [0, 1]")])
