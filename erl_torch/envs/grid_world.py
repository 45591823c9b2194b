"""Windy grid worlds: rows of tiles and a wind field, turned into a TabularMDP.

Rules (state = row * n_cols + col, row 0 on top; actions 0..3 = left, down, right, up)

    tiles    S start, F floor with wind, R floor without wind, H trap, G goal, W wall, C and N floors
             that cost 0.5 and 1.5.
    reward   of the tile being LEFT: H `trap_reward`, G 0, C -0.5, N -1.5, any other -1.
    cyclic   from H or G every action leads to the start distribution: uniform over the S tiles, or over
             the F tiles if there is no S. There is no terminal state.
    moves    elsewhere the wind moves first, then the action, which succeeds with `action_success_prob[a]`
             and otherwise leaves the agent where the wind left it. Walls and borders block each part.
    wind     blows on F tiles only. With strength w in [0, 1], angle phi (rows grow downward),
             h = sqrt(w) cos(phi), v = sqrt(w) sin(phi): P(left) = max(0,-h)^2, P(down) = max(0,v)^2,
             P(right) = max(0,h)^2, P(up) = max(0,-v)^2, P(none) = the rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from erl_torch import checks
from erl_torch.checks import InputError
from erl_torch.mdp import TabularMDP

TILES = "SFRHGWCN"
DEFAULT_REWARD = -1.0
TILE_REWARDS = {"G": 0.0, "C": -0.5, "N": -1.5}
MOVES = np.array([(0, -1), (1, 0), (0, 1), (-1, 0)])  # [A, 2] (row, col): left, down, right, up
ACTION_NAMES = ("left", "down", "right", "up")


@dataclass(frozen=True, eq=False)
class GridWorld:
    """Tiles and wind. Raises InputError for ragged rows, unknown tiles, no start, or a bad wind field.

    Args:
        desc: rows of tiles, all of one length.
        wind: [2, rows, cols]: angle (radians) and strength (in [0, 1]); None is no wind.
        trap_reward: reward of leaving an H tile.
        action_success_prob: [A], each in [0, 1].
    """

    desc: tuple[str, ...]
    wind: np.ndarray = None  # type: ignore[assignment]  # [2, rows, cols]
    trap_reward: float = -5.0
    action_success_prob: Sequence[float] = (1.0, 1.0, 1.0, 1.0)

    def __post_init__(self) -> None:
        rows = tuple(str(row) for row in self.desc)
        if not rows or not rows[0] or len({len(row) for row in rows}) > 1:
            raise InputError("desc", list(rows), "one or more rows of one length")
        unknown = sorted(set("".join(rows)) - set(TILES))
        if unknown:
            raise InputError("desc", "".join(unknown), f"made of the tiles {' '.join(TILES)}")
        if not set("".join(rows)) & set("SF"):
            raise InputError("desc", list(rows), "a map with an S or F tile to start on")
        shape = (2, len(rows), len(rows[0]))
        wind = np.zeros(shape) if self.wind is None else np.asarray(self.wind, dtype=np.float64)
        if wind.shape != shape:
            raise InputError("wind", f"array of shape {wind.shape}", f"of shape {shape}")
        if not (np.isfinite(wind).all() and (wind[1] >= 0).all() and (wind[1] <= 1).all()):
            raise InputError("wind", "array", "finite angles and strengths in [0, 1]")
        success = np.asarray(self.action_success_prob, dtype=np.float64)
        if success.shape != (len(MOVES),) or not ((success >= 0) & (success <= 1)).all():
            raise InputError("action_success_prob", success.tolist(), f"{len(MOVES)} numbers in [0, 1]")
        if not (checks.is_number(self.trap_reward) and np.isfinite(self.trap_reward)):
            raise InputError("trap_reward", self.trap_reward, "a finite number")
        object.__setattr__(self, "desc", rows)
        object.__setattr__(self, "wind", wind)

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols)"""
        return len(self.desc), len(self.desc[0])

    @cached_property
    def tiles(self) -> np.ndarray:
        """[S] single letters, state order."""
        return np.array(list("".join(self.desc)))

    def wind_probabilities(self) -> np.ndarray:
        """[S, 5]: probabilities that the wind moves left, down, right, up, or not at all."""
        angle, strength = self.wind.reshape(2, -1)
        strength = np.where(self.tiles == "F", strength, 0.0)
        h, v = np.sqrt(strength) * np.cos(angle), np.sqrt(strength) * np.sin(angle)
        moved = np.maximum([-h, v, h, -v], 0).T ** 2  # [S, 4]
        return np.column_stack([moved, 1 - moved.sum(1)])

    def mdp(self) -> TabularMDP:
        """The grid world as a TabularMDP."""
        n_states, n_actions = self.tiles.size, len(MOVES)
        identity = sp.eye_array(n_states, format="csr")
        moves = [self._move(move) for move in MOVES]
        blow = sum(
            sp.diags_array(p) @ move for p, move in zip(self.wind_probabilities().T, [*moves, identity], strict=True)
        )
        start = (self.tiles == ("S" if "S" in self.tiles else "F")).astype(np.float64)
        start /= start.sum()
        ends = np.isin(self.tiles, ["H", "G"]).astype(np.float64)
        restart = sp.csr_array(ends[:, None]) @ sp.csr_array(start[None, :])
        goes_on = sp.diags_array(1 - ends)
        per_action = [
            goes_on @ blow @ (p * move + (1 - p) * identity) + restart
            for p, move in zip(self.action_success_prob, moves, strict=True)
        ]
        # Stacked by action; rows are wanted as s * A + a.
        order = np.arange(n_actions * n_states).reshape(n_actions, n_states).T.ravel()
        reward = np.array([self._tile_reward(tile) for tile in self.tiles])
        return TabularMDP(
            transition=sp.vstack(per_action, format="csr")[order],
            reward=np.repeat(reward[:, None], n_actions, axis=1),
            start=start,
        )

    def _tile_reward(self, tile: str) -> float:
        return self.trap_reward if tile == "H" else TILE_REWARDS.get(tile, DEFAULT_REWARD)

    def _move(self, move: np.ndarray) -> sp.csr_array:
        """[S, S]: where one step in a direction leads, borders and walls blocking."""
        rows, cols = self.shape
        here = np.stack(np.divmod(np.arange(rows * cols), cols))  # [2, S]
        there = np.clip(here + move[:, None], 0, [[rows - 1], [cols - 1]])
        target = there[0] * cols + there[1]
        target = np.where(self.tiles[target] == "W", np.arange(target.size), target)
        ones = np.ones(target.size)
        return sp.csr_array((ones, (np.arange(target.size), target)), shape=(target.size, target.size))


def uniform_wind(desc: Sequence[str], angle: float, strength: float) -> np.ndarray:
    """The same wind on every tile, [2, rows, cols]."""
    shape = (len(desc), len(desc[0]))
    return np.stack([np.full(shape, angle, np.float64), np.full(shape, strength, np.float64)])
