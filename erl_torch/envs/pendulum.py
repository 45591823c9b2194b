"""The pendulum of Gymnasium, binned."""

from __future__ import annotations

import math

import numpy as np
import torch

from erl_torch.envs.control import ControlEnv, ControlTask, Step, wrap

GRAVITY, MASS, LENGTH, DT = 10.0, 1.0, 1.0, 0.05
MAX_SPEED, MAX_TORQUE = 8.0, 2.0


def step(state: torch.Tensor, torque: torch.Tensor) -> Step:
    angle, velocity = state.unbind(1)
    torque = torque.clamp(-MAX_TORQUE, MAX_TORQUE)
    cost = wrap(angle) ** 2 + 0.1 * velocity**2 + 0.001 * torque**2
    pull = (3 * GRAVITY / (2 * LENGTH)) * angle.sin() + (3 / (MASS * LENGTH**2)) * torque
    velocity = (velocity + pull * DT).clamp(-MAX_SPEED, MAX_SPEED)
    return Step(torch.stack((angle + velocity * DT, velocity)).T, -cost, torch.zeros_like(angle, dtype=torch.bool))


def variables(state: torch.Tensor) -> torch.Tensor:
    return torch.stack((wrap(state[:, 0]), state[:, 1])).T


def features(observation: np.ndarray) -> np.ndarray:
    return np.array([math.atan2(observation[1], observation[0]), observation[2]])


TASK = ControlTask(
    name="pendulum",
    gymnasium_id="Pendulum-v1",
    bins=(16, 16),
    low=(-math.pi, -8.0),
    high=(math.pi, 8.0),
    actions=(-2.0, 0.0, 2.0),
    max_action=MAX_TORQUE,
    beta=1.0,
    reset_low=(-math.pi, -1.0),
    reset_high=(math.pi, 1.0),
    step=step,
    instant_reward=lambda state, step: step.reward,
    variables=variables,
    features=features,
)


class DiscretePendulumEnv(ControlEnv):
    """Swing a pendulum up with a motor that is too weak to lift it at once; angle and velocity are binned.

    ## Description
    Gymnasium's `Pendulum-v1`, which takes each step; the learner sees the bin of the state.

    ## Action Space
    `Discrete(3)`: the entries of `torques`.

    ## Observation Space
    `Discrete(256)`: angle (0 upright, wrapped to +-pi) and angular velocity, uniform bins, little-endian.

    ## Starting State
    Angle uniform in +-pi, velocity in +-1.

    ## Rewards
    -(angle^2 + 0.1 velocity^2 + 0.001 torque^2), of the state that is left.

    ## Episode End
    None. The registered environment truncates after 500 steps.

    ## Arguments
    `bins` (16, or one number per variable), `low`, `high` (+-pi, +-8), `torques` (-2, 0, 2; at most 2 in size),
    `reward` ("original" or "cyclic", here the same), `render_mode` ("human" or "rgb_array").

    ## Version History
    v0: the setting of the paper's Table S2.
    """

    task = TASK
