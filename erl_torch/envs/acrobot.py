"""The acrobot of Gymnasium, binned."""

from __future__ import annotations

import math

import numpy as np
import torch

from erl_torch.envs.control import ControlEnv, ControlTask, Step, wrap

# Links of length 1 and mass 1, centre of mass in the middle, moment of inertia 1.
GRAVITY, DT = 9.8, 0.2
MAX_SPEED_1, MAX_SPEED_2 = 4 * math.pi, 9 * math.pi

Columns = tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]


def _slope(state: Columns, torque: torch.Tensor) -> Columns:
    """Time derivative of (angle 1, angle 2, velocity 1, velocity 2); Sutton and Barto's equations."""
    angle_1, angle_2, speed_1, speed_2 = state
    cos, sin = angle_2.cos(), angle_2.sin()
    d1 = cos + 3.5  # 1/4 + (1 + 1/4 + cos) + 2
    d2 = 0.5 * cos + 1.25
    phi_2 = (0.5 * GRAVITY) * (angle_1 + angle_2).sin()
    phi_1 = phi_2 + (1.5 * GRAVITY) * angle_1.sin() - (0.5 * speed_2 + speed_1) * speed_2 * sin
    ratio = d2 / d1
    turn = (torque + ratio * phi_1 - 0.5 * speed_1**2 * sin - phi_2) / (1.25 - d2 * ratio)
    return speed_1, speed_2, -(d2 * turn + phi_1) / d1, turn


def _along(state: Columns, slope: Columns, time: float) -> Columns:
    a, b, c, d = (torch.add(x, k, alpha=time) for x, k in zip(state, slope, strict=True))
    return a, b, c, d


def step(state: torch.Tensor, torque: torch.Tensor) -> Step:
    """One fourth-order Runge-Kutta step of DT seconds."""
    begin: Columns = state.unbind(1)  # type: ignore[assignment]
    k1 = _slope(begin, torque)
    k2 = _slope(_along(begin, k1, DT / 2), torque)
    k3 = _slope(_along(begin, k2, DT / 2), torque)
    k4 = _slope(_along(begin, k3, DT), torque)
    angle_1, angle_2, speed_1, speed_2 = (
        x + (DT / 6) * (a + 2 * (b + c) + d) for x, a, b, c, d in zip(begin, k1, k2, k3, k4, strict=True)
    )
    angle_1, angle_2 = wrap(angle_1), wrap(angle_2)
    speed_1, speed_2 = speed_1.clamp(-MAX_SPEED_1, MAX_SPEED_1), speed_2.clamp(-MAX_SPEED_2, MAX_SPEED_2)
    terminated = -angle_1.cos() - (angle_1 + angle_2).cos() > 1
    return Step(torch.stack((angle_1, angle_2, speed_1, speed_2)).T, terminated.double() - 1, terminated)


def features(observation: np.ndarray) -> np.ndarray:
    cos_1, sin_1, cos_2, sin_2, *speeds = observation.tolist()
    return np.array([math.atan2(sin_1, cos_1), math.atan2(sin_2, cos_2), *speeds])


TASK = ControlTask(
    name="acrobot",
    gymnasium_id="Acrobot-v1",
    bins=(12, 12, 12, 12),
    low=(-math.pi, -math.pi, -12.566371, -28.274334),
    high=(math.pi, math.pi, 12.566371, 28.274334),
    actions=(-1.0, 0.0, 1.0),
    max_action=math.inf,
    beta=25.0,
    reset_low=(-0.1,) * 4,
    reset_high=(0.1,) * 4,
    step=step,
    instant_reward=lambda state, step: step.reward,
    variables=lambda state: torch.stack((wrap(state[:, 0]), wrap(state[:, 1]), state[:, 2], state[:, 3])).T,
    features=features,
    reset_dtype=torch.float32,
)


class DiscreteAcrobotEnv(ControlEnv):
    """Swing the free end of a two-link chain above a line; angles and velocities are binned.

    ## Description
    Gymnasium's `Acrobot-v1`, which takes each step; the learner sees the bin of the state.

    ## Action Space
    `Discrete(3)`: the entries of `torques`, on the joint between the links.

    ## Observation Space
    `Discrete(20736)`: angle of the first link (0 down), of the second relative to the first, and their velocities,
    uniform bins, little-endian.

    ## Starting State
    All four uniform in +-0.1.

    ## Rewards
    -1 per step, 0 for the one that reaches the line.

    ## Episode End
    Terminates when -cos(angle 1) - cos(angle 1 + angle 2) > 1. The registered environment truncates after 500 steps.

    ## Arguments
    `bins` (12, or one number per variable), `low`, `high` (+-pi, +-pi, +-4 pi, +-9 pi), `torques` (-1, 0, 1),
    `reward` ("original" or "cyclic", here the same), `render_mode` ("human" or "rgb_array").

    ## Version History
    v0: the setting of the paper's Table S2.
    """

    task = TASK
