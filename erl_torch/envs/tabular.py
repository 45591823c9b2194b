"""Any TabularMDP as a Gymnasium environment."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np

from erl_torch.mdp import TabularMDP


class TabularEnv(gym.Env[np.int64, np.int64]):
    """Steps through a TabularMDP. It never terminates; a time limit truncates.

    Observation: the state, Discrete(n_states). Action: Discrete(n_actions). Reward: ``mdp.reward[s, a]``.
    """

    metadata = {"render_modes": ["ansi"], "render_fps": 4}  # noqa: RUF012

    def __init__(self, mdp: TabularMDP, render_mode: str | None = None) -> None:
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise ValueError(f"render_mode={render_mode}: must be one of {self.metadata['render_modes']}")
        self.mdp = mdp
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
        return np.int64(self.state), {}

    def step(self, action: np.int64) -> tuple[np.int64, float, bool, bool, dict[str, Any]]:
        if not self.action_space.contains(action):
            raise ValueError(f"action={action}: must be in [0, {self.mdp.n_actions})")
        row = self.state * self.mdp.n_actions + int(action)
        reward = float(self.mdp.reward[self.state, action])
        p = self.mdp.transition
        entries = slice(p.indptr[row], p.indptr[row + 1])
        cdf = np.cumsum(p.data[entries])
        drawn = int(np.searchsorted(cdf, self.np_random.random() * cdf[-1], side="right"))
        self.state = int(p.indices[entries][min(drawn, len(cdf) - 1)])
        self.last_action = int(action)
        return np.int64(self.state), reward, False, False, {}

    def render(self) -> Any:
        if self.render_mode == "ansi":
            return f"state {self.state}\n"
        return None
