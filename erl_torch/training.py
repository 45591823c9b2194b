"""One training run, from a configuration to a run directory; Hydra stays outside.

A run directory holds the event file, ``result.json`` and ``solution.npz`` (and Hydra's ``.hydra/``).
"""

from __future__ import annotations

import contextlib
import platform
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from omegaconf import DictConfig, OmegaConf
from tqdm import tqdm

import erl_torch
from erl_torch import checks, kernels, pictures
from erl_torch.board import Board
from erl_torch.checks import InputError
from erl_torch.config import check_keys
from erl_torch.envs.grid_world import GridWorld
from erl_torch.evaluation import Evaluation, evaluate
from erl_torch.experience import collect, sizes
from erl_torch.files import read_npy, write_json
from erl_torch.learners import LEARNERS, NonFiniteError, S1State
from erl_torch.mdp import check_policy
from erl_torch.rng import Streams, streams
from erl_torch.solution import Solution, Status
from erl_torch.transitions import Transitions


def train(cfg: DictConfig, directory: Path, safe_point: Callable[[], None] = lambda: None) -> dict[str, Any]:
    """Run ``cfg`` (as composed from ``conf/``) in ``directory``; returns what ``result.json`` holds.

    ``safe_point`` is called between blocks of work; it may raise SystemExit or KeyboardInterrupt, which goes
    on to the caller once everything learnt has been written.

    Raises:
        InputError: a key or value that cannot be used, before anything is learnt or written.
        NonFiniteError: the learner left the finite numbers; everything up to the last good epoch is
            written.
    """
    began = time.perf_counter()
    check_keys(cfg)
    checks.at_least("seed", cfg.seed, 0)
    checks.at_least("threads", cfg.threads, 1)
    torch.set_num_threads(cfg.threads)
    if not kernels.compiled_before():
        print("compiling the loops, about ten seconds: on the first run only", file=sys.stderr)
    rng = streams(cfg.seed)
    _check_evaluation(cfg.evaluation)
    env = _make_env(cfg.env)
    with contextlib.closing(env):
        n_states, n_actions = sizes(env)
        learner = _make_learner(cfg.learner, n_states, n_actions)
        prior = check_policy("learner.prior_policy", learner.prior_policy, n_states, n_actions)
        data = _experience(cfg.experience, env, n_states, n_actions, rng, prior, safe_point)
        safe_point()

        def measure(policy: torch.Tensor) -> Evaluation:
            e = cfg.evaluation
            return evaluate(env, policy, learner.beta, rng.evaluation, e.n_episodes, e.horizon, prior)

        start = state = learner.init(n_states, n_actions)
        history: list[dict[str, float]] = []
        stopped: BaseException | None = None
        clock = _Stopwatch()
        hyperparameters = _flat({**cfg.learner, "seed": cfg.seed, "n_experience": len(data)})
        with Board(directory, hyperparameters) as board:
            board.text("configuration", f"```yaml\n{OmegaConf.to_yaml(cfg, resolve=True)}```")
            first = last = measure(state.policy)
            board.scalars(_tags(state, first), 0)
            drawer = _Drawer(board, getattr(env.unwrapped, "grid", None)) if cfg.evaluation.pictures else None
            if drawer:
                drawer.policy(state, "prior policy")
            # Whatever ends the loop, what was learnt until then is written below.
            try:
                with _Progress(learner, len(data)) as progress:
                    for state in clock.time(learner.iterate(data, n_states, n_actions)):
                        history.append(state.metrics())
                        ends_phase = state.epoch == learner.n_epochs
                        if ends_phase or len(history) % cfg.evaluation.every == 0:
                            last = measure(state.policy)
                            board.scalars(_tags(state, last), state.n_tuples)
                        if ends_phase and drawer:
                            drawer.policy(state, f"policy, biasing iteration {state.bias_iteration}")
                            drawer.bias(state)
                        progress.advance(state, last, ends_phase)
                        safe_point()
            except (NonFiniteError, KeyboardInterrupt, SystemExit) as error:
                stopped = error
            failure = stopped if isinstance(stopped, NonFiniteError) else None
            solution = learner.solution(state, history, failure)
            rate = state.n_tuples / max(clock.seconds, 1e-9)
            board.scalars({"time/tuples_per_second": rate}, state.n_tuples)

    solution.save(directory / "solution.npz")
    result = _result(cfg, solution, last, len(data), clock.seconds, time.perf_counter() - began)
    write_json(directory / "result.json", result)
    print(_summary(cfg, first, last, start, result, directory))
    if stopped is not None:
        raise stopped
    return result


class _Stopwatch:
    """Seconds spent inside an iterator, apart from what its caller does between the items."""

    def __init__(self) -> None:
        self.seconds = 0.0

    def time(self, states: Iterator[S1State]) -> Iterator[S1State]:
        while True:
            tick = time.perf_counter()
            try:
                state = next(states)
            except StopIteration:
                return
            finally:
                self.seconds += time.perf_counter() - tick
            yield state


# -- from configuration to objects ------------------------------------------------------------------


@contextlib.contextmanager
def _group(name: str) -> Iterator[None]:
    """Complaints raised inside name their configuration group."""
    try:
        yield
    except InputError as error:
        raise error.within(name) from error


def _make_env(cfg: DictConfig) -> gym.Env[Any, Any]:
    if "kwargs" in cfg:
        arguments = {str(key): value for key, value in cfg.kwargs.items()}
    else:
        arguments = {str(key): value for key, value in cfg.items() if key not in ("name", "id")}
    with _group("env"):
        try:
            return gym.make(cfg.id, **arguments)
        except gym.error.Error as error:
            raise InputError("id", cfg.id, f"an environment that Gymnasium has ({error})") from error
        except TypeError as error:
            raise InputError("kwargs", arguments, f"arguments of {cfg.id} ({error})") from error


def _make_learner(cfg: DictConfig, n_states: int, n_actions: int) -> Any:
    learner_class = LEARNERS[cfg.name]
    with _group("learner"):
        arguments = {f.name: cfg[f.name] for f in fields(learner_class)}
        if cfg.prior_policy is not None:
            arguments["prior_policy"] = read_npy(cfg.prior_policy, "prior_policy")
        learner = learner_class(**arguments)
        learner.init(n_states, n_actions)  # validates the prior against the sizes
        return learner


def _experience(
    cfg: DictConfig,
    env: gym.Env[Any, Any],
    n_states: int,
    n_actions: int,
    rng: Streams,
    prior: np.ndarray,
    safe_point: Callable[[], None],
) -> Transitions:
    with _group("experience"):
        if cfg.name == "recorded":
            data = Transitions.load(cfg.path)
            try:
                data.check_range(n_states, n_actions)
            except InputError as error:
                raise InputError(f"path={cfg.path}: {error.key}", error.value, error.allowed) from error
            return data
        behaviour = None
        if cfg.behaviour_policy is not None:
            behaviour = read_npy(cfg.behaviour_policy, "behaviour_policy")
        with tqdm(
            total=cfg.n_episodes * cfg.episode_length if cfg.n_episodes >= 1 and cfg.episode_length >= 1 else 0,
            desc="collecting", unit=" tuples", unit_scale=True, delay=1, leave=False, disable=None,
        ) as bar:  # fmt: skip

            def report(n: int) -> None:
                bar.update(n - bar.n)
                safe_point()

            data = collect(env, cfg.n_episodes, cfg.episode_length, rng, behaviour, prior, report)
        if cfg.save_to is not None:
            data.save(cfg.save_to)
        return data


def _check_evaluation(cfg: DictConfig) -> None:
    with _group("evaluation"):
        for key in ("every", "n_episodes", "horizon"):
            checks.at_least(key, cfg[key], 1)


# -- what is shown ----------------------------------------------------------------------------------


def _tags(state: S1State, measured: Evaluation) -> dict[str, float]:
    logged = ("rho", "theta", "delta_max", "delta_mean", "psi_error", "psi_epochs", "bias_iteration")
    metrics = state.metrics()
    return {f"s1/{name}": metrics[name] for name in logged} | {
        "eval/return": measured.mean_return,
        "eval/reward_per_step": measured.reward_per_step,
        "eval/objective": measured.objective,
    }


class _Drawer:
    def __init__(self, board: Board, grid: GridWorld | None) -> None:
        self.board, self.grid = board, grid

    def policy(self, state: S1State, title: str) -> None:
        pixels = pictures.policy_picture(state.policy.cpu().numpy(), self.grid, title)
        self.board.picture("policy", pixels, state.n_tuples)

    def bias(self, state: S1State) -> None:
        title = f"reward bias, biasing iteration {state.bias_iteration}"
        pixels = pictures.bias_picture(state.reward_bias.cpu().numpy(), self.grid, title)
        self.board.picture("reward_bias", pixels, state.n_tuples)


class _Progress:
    """A bar on a terminal; in a pipe, one line a biasing iteration."""

    def __init__(self, learner: Any, n_tuples: int) -> None:
        self.n_bias, self.n_tuples = learner.n_bias, n_tuples
        self.bar = tqdm(
            total=learner.n_bias * learner.n_epochs * n_tuples,
            desc="learning", unit=" tuples", unit_scale=True, disable=None,
            bar_format="{l_bar}{bar:20}| {elapsed}<{remaining}, {rate_fmt}{postfix}",
        )  # fmt: skip

    def __enter__(self) -> _Progress:
        self.bar.__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        self.bar.__exit__(*error)

    def advance(self, state: S1State, measured: Evaluation, ends_phase: bool) -> None:
        self.bar.set_postfix_str(
            f"bias {state.bias_iteration}/{self.n_bias - 1} epoch {state.epoch} "
            f"rho {state.rho:.3e} theta {state.theta:.4f}",
            refresh=False,
        )
        self.bar.update(self.n_tuples)
        if ends_phase:
            tqdm.write(
                f"biasing iteration {state.bias_iteration}: rho {state.rho:.4e}  theta {state.theta:.5f}  "
                f"delta max {state.reward_bias_max:.4f}  reward per step {measured.reward_per_step:.4f}  "
                f"objective {measured.objective:.4f}",
                file=sys.stderr,
            )


def _result(
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
        "rho": solution.rho,
        "reward_bias_max": solution.reward_bias_max,
        "reward_per_step": last.reward_per_step,
        "objective": last.objective,
        "return": last.mean_return,
        "n_experience": n_data,
        "n_tuples": solution.n_steps,
        "seconds_learning": round(learning, 3),
        "seconds": round(seconds, 3),
        "versions": {
            "erl_torch": erl_torch.__version__,
            "python": platform.python_version(),
            "torch": torch.__version__,
            "numpy": np.__version__,
            "gymnasium": gym.__version__,
        },
    }


def _summary(
    cfg: DictConfig, first: Evaluation, last: Evaluation, start: S1State, result: dict[str, Any], directory: Path
) -> str:
    with contextlib.suppress(ValueError):
        directory = directory.resolve().relative_to(Path.cwd())
    logs = "runs" if directory.parts[0] == "runs" else directory
    rate = result["n_tuples"] / max(result["seconds_learning"], 1e-3) / 1e6
    rows = [
        ("theta", f"{start.theta:12.5f}", f"{result['theta']:12.5f}"),
        ("rho", f"{start.rho:12.4e}", f"{result['rho']:12.4e}"),
        ("reward per step", f"{first.reward_per_step:12.5f}", f"{last.reward_per_step:12.5f}"),
        ("objective", f"{first.objective:12.5f}", f"{last.objective:12.5f}"),
        ("episode return", f"{first.mean_return:12.2f}", f"{last.mean_return:12.2f}"),
    ]
    lines = [
        "",
        f"{cfg.env.name}, {cfg.learner.name}, beta {cfg.learner.beta:g}, seed {cfg.seed}: {result['status']}",
        f"{'':18}{'prior':>12}{'learnt':>12}",
        *(f"{name:18}{before}{after}" for name, before, after in rows),
        f"{'tuples streamed':18}{result['n_tuples']:,} (of {result['n_experience']:,}; {rate:.3g} M/s)",
        f"{'seconds':18}{result['seconds']:.1f}, of which {result['seconds_learning']:.1f} learning",
        f"{'run directory':18}{directory}",
        f"{'look at it':18}tensorboard --logdir {logs}",
    ]
    if result["status"] != "completed":
        lines.append(f"{'status':18}{Status[result['status'].upper()].value}")
    return "\n".join(lines)


def _flat(values: dict[str, Any]) -> dict[str, Any]:
    """Hyper-parameters as TensorBoard takes them: numbers, booleans and text."""
    return {
        key: value if isinstance(value, (bool, int, float, str)) else str(value) for key, value in values.items()
    }
