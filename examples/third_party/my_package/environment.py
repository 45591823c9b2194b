"""An environment: any ``gymnasium.Env`` with Discrete spaces. With a table ``P`` its model is known, and solved."""

import gymnasium as gym
import numpy as np


class Ring(gym.Env):
    """Rooms in a ring. Each step leads to a neighbour, now and then the wrong one; leaving room 0 is free.

    Args:
        size: rooms, at least 3.
        slip: probability of the other direction.
        render_mode: "ansi" or None.
    """

    metadata = {"render_modes": ["ansi"], "render_fps": 4}  # noqa: RUF012

    def __init__(self, size: int = 6, slip: float = 0.1, render_mode: str | None = None):
        self.size, self.render_mode, self.room = size, render_mode, 0
        self.observation_space, self.action_space = gym.spaces.Discrete(size), gym.spaces.Discrete(2)

        def rows(room, step):
            reward = 0.0 if room == 0 else -1.0
            return [(p, (room + way) % size, reward, False) for p, way in ((1 - slip, step), (slip, -step))]

        self.P = {room: {0: rows(room, -1), 1: rows(room, 1)} for room in range(size)}
        self.initial_state_distrib = np.eye(size)[0]

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.room = 0
        return self.room, {}

    def step(self, action):
        rows = self.P[self.room][int(action)]
        row = rows[int(self.np_random.random() >= rows[0][0])]
        self.room = row[1]
        return self.room, row[2], row[3], False, {}

    def render(self):
        return "".join("x" if room == self.room else "." for room in range(self.size))
