"""What a run says: tags, pictures, ``result.json``, and the summary at the end."""

from __future__ import annotations

import platform
import shlex
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch

import erl_torch
from erl_torch.empirical.uncertainty import Estimate
from erl_torch.evaluation import Evaluation
from erl_torch.experience.log import Log
from erl_torch.files import here
from erl_torch.log.quantities import tagged
from erl_torch.mdp.tabular import TabularMDP
from erl_torch.problem import Problem
from erl_torch.run.judge import episode_model
from erl_torch.solution import Solution, Status
from erl_torch.solvers.policy import objective, reward_per_step


@dataclass(frozen=True)
class Title:
    """What a run is called."""

    env: str
    learner: str
    seed: int


def evaluation_tags(measured: Evaluation, prefix: str = "eval") -> dict[str, float]:
    return tagged(prefix, figures(measured))


def figures(measured: Evaluation) -> dict[str, float]:
    """By name, as in ``erl_torch.log.quantities``; those that there are: a log alone tells of an objective at most."""
    found = {
        "return": measured.mean_return,
        "reward_per_step": measured.reward_per_step,
        "objective": measured.objective,
    }
    found |= {"success_rate": measured.success_rate, "objective_real": measured.objective_real}
    return {name: value for name, value in found.items() if not np.isnan(value)}


def optimal_tags(optimum: Solution | None, model: TabularMDP | None, problem: Problem) -> dict[str, float]:
    """What ``optimum`` proves of theta*, and where the proof is complete the figures of its policy in ``model``."""
    if optimum is None or optimum.theta is None or optimum.theta_bounds is None:
        return {}
    low, high = optimum.theta_bounds
    values = {"theta": optimum.theta, "theta_lower": low, "theta_upper": high}
    if optimum.status is Status.CONVERGED:
        values |= {"objective": -optimum.theta, "delta_max": optimum.reward_bias_max}
        values["delta_mean"] = float(optimum.reward_bias.mean())
        if optimum.rho is not None and np.isfinite(optimum.rho):
            values["rho"] = optimum.rho
        if model is not None:
            policy = optimum.policy.numpy()
            if optimum.optimism and optimum.beta is not None:
                values["objective_real"] = objective(model, policy, problem.prior, optimum.beta)
            values["reward_per_step"] = reward_per_step(model, policy, problem.horizon)
            if (episode := episode_model(problem)) is not None:
                values["return"] = mean_return(episode, problem.horizon, policy)
                if problem.success is not None:
                    values["success_rate"] = success_rate(episode, problem.success, problem.horizon, policy)
    return tagged("optimal", values)


def data_tags(estimate: Estimate | None) -> dict[str, float]:
    if estimate is None or np.isnan(estimate.value):
        return {}
    if estimate.withheld:
        return tagged("data", {"theta": estimate.value})
    low, high = estimate.interval()
    return tagged("data", {"theta": estimate.value, "theta_lower": low, "theta_upper": high})


def mean_return(episode: TabularMDP, horizon: int, policy: np.ndarray) -> float:
    """Expected return of an episode of at most ``horizon`` steps, which ``episode`` is the model of."""
    return horizon * reward_per_step(episode, policy, horizon)


def success_rate(episode: TabularMDP, success: np.ndarray, horizon: int, policy: np.ndarray) -> float:
    """Probability that an episode of at most ``horizon`` steps ends in success; ``success`` [S, A]: of each step."""
    return horizon * reward_per_step(replace(episode, reward=success), policy, horizon)


def versions() -> dict[str, str]:
    """Of what a result depends on."""
    return {
        "erl_torch": erl_torch.__version__,
        "python": platform.python_version(),
        "torch": torch.__version__,
        "numpy": np.__version__,
        "gymnasium": gym.__version__,
    }


def at(beta: float, optimism: float) -> str:
    """``beta 10``, with the optimism where that is not 0."""
    return f"beta {beta:g}" + (f", optimism {optimism:g}" if optimism else "")


def headline(heading: str, result: Mapping[str, Any]) -> list[str]:
    """The first lines of a summary."""
    return ["", f"{heading}: {ended_as(result)}"]


def end_reward(problem: Problem, log: Log | None) -> str | None:
    """What is added to the rewards of which ends, in words; None for nothing."""
    if log is not None:
        return log.report.counted_ends or None
    rule = problem.ends
    if rule is None or not rule.end_reward:
        return None
    return f"{rule}; it counts in theta, objective and reward per step, not in the return"


def last_rows(result: Mapping[str, Any], directory: Path) -> list[str]:
    """The last rows of a summary."""
    where = here(directory)
    seconds, learning = result["seconds"], result["seconds_learning"]
    remedy = "" if seconds < 30 or learning > seconds / 5 else "; evaluation.every=10 measures policies less often"
    more = result["end_reward"]
    return [
        *([f"{'end reward':18}{more}"] if more else []),
        f"{'seconds':18}{seconds:.1f}, of which {learning:.1f} learning{remedy}",
        f"{'run directory':18}{where}",
        f"{'look at it':18}tensorboard --logdir {shlex.quote(str(where))}",
        *(f"{'note':18}{text}" for text in result["notes"]),
    ]


def ended_as(result: Mapping[str, Any]) -> str:
    """The status of ``result.json``, which is no success without its notes."""
    n = len(result["notes"])
    return f"{result['status']}, with {plural(n, 'note')}" if n else f"{result['status']}"


def plural(n: int, thing: str) -> str:
    return f"{n} {thing}" if n == 1 else f"{n} {thing}s"
