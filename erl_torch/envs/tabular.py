"""Any TabularMDP as a Gymnasium environment, and grid worlds with their rendering."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np

from erl_torch.checks import InputError
from erl_torch.envs import grid_pictures
from erl_torch.envs.grid_world import GridWorld
from erl_torch.mdp.tabular import TabularMDP


class TabularEnv(gym.Env[np.int64, np.int64]):
    """Step through a TabularMDP. Only the states of ``ends`` terminate an episode; a time limit truncates it.

    Where some states lack an action, ``info["action_mask"]`` has those of the state.

    Observation: the state, Discrete(n_states). Action: Discrete(n_actions). Reward: ``mdp.reward[s, a]``.

    Args:
        mdp: the process.
        render_mode: "ansi" or None.
        ends: [S] bool: every step from such a state ends the episode, and the agent stays there; ``mdp`` leads to the
            start instead. None is no such state.

    Raises:
        InputError: an unknown render_mode.
    """

    metadata = {"render_modes": ["ansi"], "render_fps": 4}  # noqa: RUF012

    def __init__(self, mdp: TabularMDP, render_mode: str | None = None, ends: np.ndarray | None = None) -> None:
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise InputError("render_mode", render_mode, " or ".join(self.metadata["render_modes"]))
        self.mdp = mdp
        self.ends = np.zeros(mdp.n_states, bool) if ends is None else ends
        self.render_mode = render_mode
        self.observation_space = gym.spaces.Discrete(mdp.n_states)
        self.action_space = gym.spaces.Discrete(mdp.n_actions)
        self.state = 0
        self.last_action: int | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.int64, dict[str, Any]]:
        super().reset(seed=seed)
        self.state = int(self.np_random.choice(self.mdp.n_states, p=self.mdp.start))
        self.last_action = None
        return np.int64(self.state), self._info()

    def step(self, action: np.int64) -> tuple[np.int64, float, bool, bool, dict[str, Any]]:
        if not self.action_space.contains(action):
            raise InputError("action", action, f"a whole number in [0, {self.mdp.n_actions})")
        if not self.mdp.allowed[self.state, action]:
            there = np.flatnonzero(self.mdp.allowed[self.state]).tolist()
            raise InputError("action", action, f"one of {there}, as state {self.state} has no other")
        row = self.state * self.mdp.n_actions + int(action)
        reward = float(self.mdp.reward[self.state, action])
        self.last_action = int(action)
        if self.ends[self.state]:
            return np.int64(self.state), reward, True, False, self._info()
        p = self.mdp.transition
        entries = slice(p.indptr[row], p.indptr[row + 1])
        cdf = np.cumsum(p.data[entries])
        drawn = int(np.searchsorted(cdf, self.np_random.random() * cdf[-1], side="right"))
        self.state = int(p.indices[entries][min(drawn, len(cdf) - 1)])
        return np.int64(self.state), reward, False, False, self._info()

    def _info(self) -> dict[str, Any]:
        """``action_mask``, [A] int8, where a state of the MDP lacks an action."""
        allowed = self.mdp.allowed
        return {} if allowed.all() else {"action_mask": allowed[self.state].astype(np.int8)}

    def render(self) -> str | np.ndarray | None:
        if self.render_mode == "ansi":
            return f"state {self.state}\n"
        return None


class TabularFileEnv(TabularEnv):
    """A finite MDP of one's own, from an npz file.

    ## Description
    The arrays `transition` ([S, A, S] or [S*A, S]; or its sparse parts `transition_indptr`, `transition_indices`,
    `transition_data`), `reward` [S, A], `start` [S] (default uniform) and, where states lack actions, `allowed` [S, A]
    (or `reward` -inf there), as `erl_torch.TabularMDP.save` writes them.

    ## Action Space
    `Discrete(n_actions)`.

    ## Observation Space
    `Discrete(n_states)`.

    ## Starting State
    Drawn from `start`.

    ## Rewards
    `reward[s, a]`.

    ## Episode End
    None. The registered environment truncates after 1000 steps.

    ## Arguments
    `path` (of the npz file; needed), `normalise` (False: rows far from sum 1 are refused), `render_mode` ("ansi").

    ## Version History
    v0: first version.
    """

    def __init__(self, path: str | None = None, normalise: bool = False, render_mode: str | None = None) -> None:
        if path is None:
            raise InputError("path", None, "given: an npz file with transition, reward and start")
        super().__init__(TabularMDP.load(path, normalise), render_mode)


class GridWorldEnv(TabularEnv):
    """A TabularEnv on a grid, rendered as text (``ansi``) or as a picture (``rgb_array``)."""

    metadata = {"render_modes": ["ansi", "rgb_array"], "render_fps": 4}  # noqa: RUF012

    def __init__(self, grid: GridWorld, render_mode: str | None = None) -> None:
        super().__init__(grid.mdp(), render_mode, None if grid.cyclic else grid.ends)
        self.grid = grid
        self._board: np.ndarray | None = None

    def render(self) -> str | np.ndarray | None:
        if self.render_mode == "ansi":
            return self._render_text()
        if self.render_mode == "rgb_array":
            return self._render_picture()
        return None

    def picture(
        self,
        policy: np.ndarray | None = None,
        distribution: np.ndarray | None = None,
        title: str = "",
        scale: float = 3,
    ) -> np.ndarray:
        """A picture [height, width, 3] for print: tiles, wind, a policy [S, A], a distribution over states [S]."""
        return grid_pictures.grid_picture(self.grid, policy, distribution, title, scale=scale)

    def _render_text(self) -> str:
        cols = self.grid.shape[1]
        cells = [f"[{tile}]" if s == self.state else f" {tile} " for s, tile in enumerate(self.grid.tiles.tolist())]
        lines = ["".join(cells[i : i + cols]) for i in range(0, len(cells), cols)]
        if self.last_action is not None:
            lines.insert(0, f"  ({self.grid.action_names[self.last_action]})")
        return "\n".join(lines) + "\n"

    def _render_picture(self) -> np.ndarray:
        if self._board is None:
            self._board = grid_pictures.board(self.grid)
        return grid_pictures.with_agent(self._board, self.grid.shape, divmod(self.state, self.grid.shape[1]))
