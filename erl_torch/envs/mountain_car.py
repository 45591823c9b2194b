"""The mountain car of Gymnasium, binned."""

from __future__ import annotations

import torch

from erl_torch.envs.control import ControlTask, FixedActionsEnv, Step

FORCE, GRAVITY = 0.001, 0.0025
LEFT, RIGHT, GOAL, MAX_SPEED = -1.2, 0.6, 0.5, 0.07


def step(state: torch.Tensor, throttle: torch.Tensor) -> Step:
    position, velocity = state.unbind(1)
    velocity = (velocity + (throttle * FORCE - GRAVITY * (3 * position).cos())).clamp(-MAX_SPEED, MAX_SPEED)
    position = (position + velocity).clamp(LEFT, RIGHT)
    velocity = torch.where((position == LEFT) & (velocity < 0), 0.0, velocity)
    terminated = (position >= GOAL) & (velocity >= 0)
    return Step(torch.stack((position, velocity)).T, torch.full_like(position, -1.0), terminated)


TASK = ControlTask(
    name="mountain_car",
    gymnasium_id="MountainCar-v0",
    bins=(12, 12),
    low=(-1.2, -0.07),
    high=(0.6, 0.07),
    actions=(-1.0, 0.0, 1.0),
    max_action=None,
    beta=2.0,
    reset_low=(-0.6, 0.0),
    reset_high=(-0.4, 0.0),
    step=step,
    # The reward of the state that is reached, at any velocity: reaching the flag pays.
    instant_reward=lambda state, step: torch.where(step.state[:, 0] >= GOAL, 0.0, step.reward),
    variables=lambda state: state,
)


class DiscreteMountainCarEnv(FixedActionsEnv):
    """Drive an underpowered car out of a valley; position and velocity are binned.

    ## Description
    Gymnasium's `MountainCar-v0`, which takes each step; the learner sees the bin of the state.

    ## Action Space
    `Discrete(3)`: 0 push left, 1 nothing, 2 push right.

    ## Observation Space
    `Discrete(144)`: position and velocity, uniform bins, little-endian.

    ## Starting State
    Position uniform in [-0.6, -0.4], at rest.

    ## Rewards
    -1 per step. With `reward="cyclic"` 0 for the step that terminates.

    ## Episode End
    Terminates at a position of 0.5 or more with a velocity of 0 or more. The registered environment truncates after
    500 steps.

    ## Arguments
    `bins` (12, or one number per variable), `low`, `high` ([-1.2, 0.6], +-0.07), `reward` ("original" or "cyclic"),
    `render_mode` ("human" or "rgb_array").

    ## Version History
    v0: the setting of the paper's Table S2.
    """

    task = TASK
