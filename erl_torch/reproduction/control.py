"""Algorithm 1 on the sampled models of the control tasks: the units that Table S2 and Figure 3 share.

One biasing iteration is a dominant eigenvector y of M_V (``erl_torch.solvers.biasing``), found here by power iteration
in the gauge, M_V y / max(M_V y) from y = 1: on Acrobot's 20,736 states an exact sparse factorisation fills in, and the
number of power steps is one of the things that could explain the published counts.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import torch

from erl_torch import estimate_mdp
from erl_torch.envs.control import control_task
from erl_torch.envs.rollout import rollout
from erl_torch.mdp import TabularMDP
from erl_torch.solvers.problem import Problem, soft_backup
from erl_torch.solvers.result import spread

TASKS = {"pendulum": "Pendulum", "mountain_car": "MountainCar", "cart_pole": "CartPole", "acrobot": "Acrobot"}
SAMPLES = 500  # of each (s,a) in the paper
EPISODES = 128
EPISODE_LENGTH = 500
POWER_TOLERANCE = 1e-10  # change of y, whose maximum is 1, in a power step
POWER_STEPS = 100_000
MOST_ITERATIONS = 200
KL_TO_STOP = 1e-9  # below the 1e-6 of the published rule, so that other thresholds can be read off


class PowerState(NamedTuple):
    """One biasing iteration."""

    kl: float  # max KL(optimal dynamics || model) over (s,a), nats
    chi_change: float  # max relative change of chi(s) = exp(beta V(s)), its maximum being 1
    theta: float  # of the biased problem, less the largest reward bias: -G(V)
    power_steps: int
    policy: torch.Tensor  # [S, A]


def biasing_by_power(
    mdp: TabularMDP,
    beta: float,
    damping: float = 1.0,
    most_power_steps: int = POWER_STEPS,
    max_steps: int = MOST_ITERATIONS,
) -> Iterator[PowerState]:
    """Yield every biasing iteration, until KL_TO_STOP or ``max_steps``; V += damping log(y) / beta after each."""
    problem = Problem.of(mdp, beta)
    prior = np.full(mdp.reward.shape, 1.0 / mdp.n_actions)
    value = np.zeros(problem.n_states)
    for _ in range(max_steps):
        log_weight = beta * (problem.action_value(value) - value[:, None])
        top = log_weight.max()
        m = problem.chain(problem.prior * np.exp(log_weight - top))
        y, steps, change = np.ones(problem.n_states), 0, np.inf
        while change >= POWER_TOLERANCE and steps < most_power_steps:
            after = m @ y
            root = after.max()
            after /= root
            change = np.abs(after - y).max()
            y, steps = after, steps + 1
        h = np.log(np.maximum(y, 1e-300))
        log_mean, kl, _ = problem.tilt(h)
        q = problem.action_value(value) + log_mean.reshape(problem.reward.shape) / beta
        policy = spread(problem, soft_backup(q, problem.prior, beta)[1], prior)
        new = value + damping * h / beta
        new -= new.max()
        with np.errstate(over="ignore"):
            chi_change = float(np.abs(np.expm1(beta * (new - value))).max())
        theta = -(float(np.log(root)) + float(top)) / beta
        yield PowerState(float(kl.max()), min(chi_change, 1e300), theta, steps, policy)
        value = new
        if kl.max() < KL_TO_STOP:
            return


def work(
    task: str,
    n_samples: int,
    seed: int,
    damping: float = 1.0,
    most_power_steps: int = POWER_STEPS,
    episodes: int = 0,
) -> dict[str, Any]:
    """Every biasing iteration of one task: kl, chi_change, theta and power_steps [K]; returns [K, episodes]."""
    mdp, shift = estimate_mdp(task, n_samples=n_samples, seed=seed)
    states, returns = [], []
    for k, state in enumerate(biasing_by_power(mdp, control_task(task).beta, damping, most_power_steps)):
        states.append((state.kl, state.chi_change, state.theta, state.power_steps))
        if episodes:
            rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(k,)))
            returns.append(rollout(task, state.policy.numpy(), episodes, EPISODE_LENGTH, rng).returns)
    kl, chi_change, theta, power_steps = map(np.array, zip(*states, strict=True))
    result = {"kl": kl, "chi_change": chi_change, "theta": theta, "power_steps": power_steps, "reward_shift": shift}
    return result | ({"returns": np.array(returns)} if episodes else {})
