"""What a run says: tags, pictures, ``result.json``, and the summary at the end."""

from __future__ import annotations

import contextlib
import platform
import sys
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from omegaconf import DictConfig
from tqdm import tqdm

import erl_torch
from erl_torch.empirical.uncertainty import Estimate
from erl_torch.envs import grid_pictures
from erl_torch.envs.grid_world import GridWorld
from erl_torch.evaluation import Evaluation
from erl_torch.learners import ExactState, S1State
from erl_torch.log.tensorboard import Board
from erl_torch.mdp.tabular import TabularMDP
from erl_torch.solution import Solution, Status, proven
from erl_torch.solvers.policy import reward_per_step


def learning_bar(total: int | None, unit: str) -> tqdm:
    return tqdm(
        total=total, desc="learning", unit=f" {unit}", unit_scale=True, disable=None,
        bar_format="{l_bar}{bar:20}| {elapsed}<{remaining}, {rate_fmt}{postfix}" if total else None,
    )  # fmt: skip


def evaluation_tags(measured: Evaluation, prefix: str = "eval") -> dict[str, float]:
    return {
        f"{prefix}/return": measured.mean_return,
        f"{prefix}/reward_per_step": measured.reward_per_step,
        f"{prefix}/objective": measured.objective,
    }


def optimal_tags(
    best: Solution | None, judge: TabularMDP | None, episode: TabularMDP | None, horizon: int
) -> dict[str, float]:
    """What ``best`` proves of theta*, and where the proof is complete the figures of its policy."""
    if best is None or best.theta is None or best.theta_bounds is None:
        return {}
    low, high = best.theta_bounds
    found = {"theta": best.theta, "theta_lower": low, "theta_upper": high}
    if best.status is Status.CONVERGED:
        found |= {"objective": -best.theta, "delta_max": best.reward_bias_max}
        found["delta_mean"] = float(best.reward_bias.mean())
        if best.rho is not None and np.isfinite(best.rho):
            found["rho"] = best.rho
        if judge is not None:
            policy = best.policy.numpy()
            found["reward_per_step"] = reward_per_step(judge, policy, horizon)
            if episode is not None:
                found["return"] = mean_return(episode, horizon, policy)
    return {f"optimal/{name}": value for name, value in found.items()}


def data_tags(estimate: Estimate | None) -> dict[str, float]:
    if estimate is None or np.isnan(estimate.value):
        return {}
    if estimate.withheld:
        return {"data/theta": estimate.value}
    low, high = estimate.interval()
    return {"data/theta": estimate.value, "data/theta_lower": low, "data/theta_upper": high}


def say(milestone: str, state: Any, measured: Evaluation) -> None:
    if isinstance(state, ExactState):
        # A biasing iteration's own theta is optimistic: below theta* until the last.
        found = f"theta {state.theta:.10f}  {proven(state.theta_bounds, None)}  "
    else:
        found = f"rho {state.rho:.4e}  " if hasattr(state, "rho") else ""
        found += "" if state.theta is None else f"theta {state.theta:.5f}  "
    if hasattr(state, "reward_bias"):
        found += f"delta max {float(state.reward_bias.max()):.4f}  "
    tqdm.write(
        f"{milestone}: {found}reward per step {measured.reward_per_step:.4f}  objective {measured.objective:.4f}",
        file=sys.stderr,
    )


class Stopwatch:
    """Seconds spent inside an iterator, apart from what its caller does between the items."""

    def __init__(self) -> None:
        self.seconds = 0.0

    def time(self, states: Iterator[Any]) -> Iterator[Any]:
        while True:
            tick = time.perf_counter()
            try:
                state = next(states)
            except StopIteration:
                return
            finally:
                self.seconds += time.perf_counter() - tick
            yield state


def mean_return(episode: TabularMDP, horizon: int, policy: np.ndarray) -> float:
    """Expected return of an episode of at most ``horizon`` steps, which ``episode`` is the model of."""
    return horizon * reward_per_step(episode, policy, horizon)


class Drawer:
    def __init__(self, board: Board, grid: GridWorld | None) -> None:
        self.board, self.grid = board, grid

    def policy(self, state: Any, step: int, title: str) -> None:
        self.board.picture("policy", grid_pictures.policy_picture(state.policy.cpu().numpy(), self.grid, title), step)

    def bias(self, state: Any, step: int, title: str) -> None:
        self.board.picture(
            "reward_bias", grid_pictures.bias_picture(state.reward_bias.cpu().numpy(), self.grid, title), step
        )


def result_of(
    cfg: DictConfig, solution: Solution, last: Evaluation, n_data: int, learning: float, seconds: float
) -> dict[str, Any]:
    return {
        "env": cfg.env.name,
        "learner": cfg.learner.name,
        "beta": cfg.learner.beta,
        "seed": cfg.seed,
        "status": solution.status.name.lower(),
        "message": solution.message,
        "theta": solution.theta,
        "rho": solution.rho if solution.rho and solution.rho < np.inf else None,  # beyond double precision: theta tells
        "reward_bias_max": solution.reward_bias_max,
        "reward_per_step": last.reward_per_step,
        "objective": last.objective,
        "return": last.mean_return,
        "theta_bounds": list(solution.theta_bounds) if solution.theta_bounds else None,
        "gap": solution.gap,
        "k": solution.k,
        "n_experience": n_data,
        "n_tuples" if n_data else "n_iterations": solution.n_steps,
        "seconds_learning": round(learning, 3),
        "seconds": round(seconds, 3),
        "versions": versions(),
    }


def versions() -> dict[str, str]:
    """Of what a result depends on."""
    return {
        "erl_torch": erl_torch.__version__,
        "python": platform.python_version(),
        "torch": torch.__version__,
        "numpy": np.__version__,
        "gymnasium": gym.__version__,
    }


def where(directory: Path) -> tuple[Path, Path | str]:
    """A run directory as a user would write it, and what to give TensorBoard."""
    with contextlib.suppress(ValueError):
        directory = directory.resolve().relative_to(Path.cwd())
    if directory.parent.name.startswith("sweep-"):
        return directory, directory.parent  # its runs side by side, by short names
    return directory, "runs" if directory.parts[0] == "runs" else directory


def summary(
    cfg: DictConfig,
    first: Evaluation,
    last: Evaluation,
    start: Any,
    result: dict[str, Any],
    directory: Path,
    unit: str,
    played: bool,
) -> str:
    directory, logs = where(directory)
    done = result[f"n_{unit}"]
    is_s1 = isinstance(start, S1State)
    of_play = "  (the prior's: an estimate, of the episodes played)" * played
    rows = [
        *(
            [("theta", f"{-first.objective:12.5f}", f"{result['theta']:12.5f}{of_play}")]
            if result["theta"] is not None
            else []
        ),
        *([("rho", f"{'-':>12}", f"{result['rho']:12.4e}")] if is_s1 and result["rho"] is not None else []),
        ("reward per step", f"{first.reward_per_step:12.5f}", f"{last.reward_per_step:12.5f}"),
        ("objective", f"{first.objective:12.5f}", f"{last.objective:12.5f}"),
        ("episode return", f"{first.mean_return:12.2f}", f"{last.mean_return:12.2f}"),
    ]
    lines = [
        "",
        f"{cfg.env.name}, {cfg.learner.name}, beta {cfg.learner.beta:g}, seed {cfg.seed}: {ended_as(result)}",
        f"{'':18}{'prior':>12}{'learnt':>12}",
        *(f"{name:18}{before}{after}" for name, before, after in rows),
    ]
    if result["theta_bounds"] is not None:
        lines.append(f"{'proven':18}{proven(result['theta_bounds'], result['gap'])}")
    if result["data"]:
        fewest, away = result["data_smallest_visits"], result["data_half_widths"]
        met = result["data_states"]
        of = "" if met is None or met[0] == met[1] else f"{met[0]:,} of {met[1]:,} states met, "
        each = f"{fewest} visit{'s' * (fewest != 1)} or more of each pair that counts"
        rests = "" if fewest is None else f" (95%; {of}{each})"
        rests += f"; learnt: {away:.2f} half widths from its middle" if away is not None and away > 1 else ""
        lines.append(f"{'the data say':18}{result['data']}{rests}")
    if result["n_experience"]:
        rate = done / max(result["seconds_learning"], 1e-3) / 1e6
        lines.append(f"{'tuples streamed':18}{done:,} (of {result['n_experience']:,}; {rate:.3g} M/s)")
    else:
        k = "" if result["k"] is None else f" (k = {result['k']})"
        lines.append(f"{'iterations':18}{done}{k}")
    lines += [
        f"{'seconds':18}{result['seconds']:.1f}, of which {result['seconds_learning']:.1f} learning",
        f"{'run directory':18}{directory}",
        f"{'look at it':18}tensorboard --logdir {logs}",
    ]
    lines += note_rows(result)
    return "\n".join(lines)


def ended_as(result: Mapping[str, Any]) -> str:
    """The status of ``result.json``, which is no success without its notes."""
    n = len(result["notes"])
    return f"{result['status']}, with {plural(n, 'note')}" if n else f"{result['status']}"


def plural(n: int, thing: str) -> str:
    return f"{n} {thing}" if n == 1 else f"{n} {thing}s"


def note_rows(result: Mapping[str, Any]) -> list[str]:
    """A row of the summary each."""
    return [f"{'note':18}{text}" for text in result["notes"]]
