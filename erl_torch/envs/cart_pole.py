"""The cart and pole of Gymnasium, binned."""

from __future__ import annotations

import math

import torch

from erl_torch.envs.control import ControlTask, FixedActionsEnv, Step

GRAVITY, MASS_POLE, MASS, HALF_LENGTH, FORCE, DT = 9.8, 0.1, 1.1, 0.5, 10.0, 0.02
MAX_POSITION, MAX_ANGLE = 2.4, math.radians(12)


def step(state: torch.Tensor, direction: torch.Tensor) -> Step:
    x, x_dot, angle, angle_dot = state.unbind(1)
    cos, sin = angle.cos(), angle.sin()
    moment = MASS_POLE * HALF_LENGTH / MASS
    push = torch.addcmul(direction * (FORCE / MASS), angle_dot**2, sin, value=moment)
    angle_acc = (GRAVITY * sin - cos * push) / (HALF_LENGTH * 4 / 3 - moment * cos**2)
    x_acc = torch.addcmul(push, angle_acc, cos, value=-moment)
    x, angle = x.add(x_dot, alpha=DT), angle.add(angle_dot, alpha=DT)
    x_dot, angle_dot = x_dot.add(x_acc, alpha=DT), angle_dot.add(angle_acc, alpha=DT)
    state = torch.stack((x, x_dot, angle, angle_dot)).T
    return Step(state, torch.ones_like(x), (x.abs() > MAX_POSITION) | (angle.abs() > MAX_ANGLE))


TASK = ControlTask(
    name="cart_pole",
    gymnasium_id="CartPole-v1",
    bins=(8, 8, 8, 8),
    low=(-2.5, -3.5, -0.25, -2.5),
    high=(2.5, 3.5, 0.25, 2.5),
    actions=(-1.0, 1.0),
    max_action=None,
    beta=10.0,
    reset_low=(-0.05,) * 4,
    reset_high=(0.05,) * 4,
    step=step,
    instant_reward=lambda state, step: torch.where(step.terminated, 0.0, step.reward),
    variables=lambda state: state,
    max_reward=1.0,
)


class DiscreteCartPoleEnv(FixedActionsEnv):
    """Balance a pole on a cart; positions and velocities are binned.

    ## Description
    Gymnasium's `CartPole-v1`, which takes each step; the learner sees the bin of the state.

    ## Action Space
    `Discrete(2)`: 0 push left, 1 push right.

    ## Observation Space
    `Discrete(4096)`: position, velocity, angle and angular velocity, uniform bins, little-endian.

    ## Starting State
    All four uniform in +-0.05.

    ## Rewards
    1 per step, also for the step that fails. With `reward="cyclic"` 0 per step and -1 for that one.

    ## Episode End
    Terminates when the position leaves +-2.4 or the angle +-12 degrees. The registered environment truncates after
    500 steps.

    ## Arguments
    `bins` (8, or one number per variable), `low`, `high` (+-2.5, +-3.5, +-0.25, +-2.5), `reward` ("original" or
    "cyclic"), `render_mode` ("human" or "rgb_array").

    ## Version History
    v0: the setting of the paper's Table S2.
    """

    task = TASK
