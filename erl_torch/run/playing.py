"""A learnt policy, played in the environment of its run; Hydra stays outside."""

from __future__ import annotations

import contextlib
import os
import shlex
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from omegaconf import DictConfig, OmegaConf

from erl_torch import checks
from erl_torch.checks import InputError
from erl_torch.envs.encoded import labels_of
from erl_torch.experience.play import Draws, Step, episode, reset
from erl_torch.files import write_gif
from erl_torch.labels import Names
from erl_torch.learners.replicas import ReplicaSolution
from erl_torch.mdp.from_gymnasium import sizes
from erl_torch.mdp.tabular import check_policy
from erl_torch.networks.policy import load_policy
from erl_torch.rng import streams
from erl_torch.run.build import is_log, make_env, raw_env, reads_table
from erl_torch.run.classes import is_own
from erl_torch.run.networks import FILE, make_network_problem, of_seed
from erl_torch.run.settings import Play, check_keys
from erl_torch.solution import Solution

RUNS = Path("runs")
TABLES = ("solution.npz", "replicas.npz", FILE)
MODES = {"ansi": "ansi", "gif": "rgb_array"}  # Gymnasium's names
SHOWN = {"ansi": 10, "gif": 200}  # steps


class Played(NamedTuple):
    """Episodes of one policy."""

    returns: np.ndarray  # [n_episodes], undiscounted, reward
    lengths: np.ndarray  # [n_episodes], steps
    ended: np.ndarray  # [n_episodes] bool: by the environment, not by a limit
    shown: list[Any]  # what the first episode looks like: text, or pictures [H, W, 3]


def play(cfg: DictConfig) -> Played:
    """Play as ``cfg`` (``conf/play.yaml``) says, and print the figures of the episodes.

    Raises:
        InputError: a key or value that cannot be used, or a directory that is no run.
    """
    check_keys(cfg, Play)
    checks.at_least("n_episodes", cfg.n_episodes, 1)
    checks.at_least("seed", cfg.seed, 0)
    checks.one_of("render", cfg.render, (*MODES, "none"))
    if cfg.n_steps is not None:
        checks.at_least("n_steps", cfg.n_steps, 1)
    os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # pygame draws without a display
    run = find_run(cfg.run)
    settings = run_settings(run)
    _check_named(cfg, settings, run)
    if is_log(settings.env):
        allowed = f"one with an environment: a log alone has none to play in; its policy is in {run / 'policy.csv'}"
        raise InputError("run", run, allowed)
    mode = MODES.get(cfg.render)
    if any(run.glob(of_seed("*"))) or (run / FILE).is_file():  # of a network
        played, fps = _of_network(cfg, settings, run)
        return _told(cfg, settings, run, played, fps)
    table = run_policy(run, cfg.replica)
    with contextlib.closing(make_env(settings.env)) as plain:
        n_states, n_actions = sizes(plain)
        modes = plain.metadata.get("render_modes") or []
    if mode not in modes and cfg.render == "gif":
        raise InputError("render", "gif", f"ansi or none: {settings.env.name} draws no pictures")
    plain_text = cfg.render == "ansi" and mode not in modes
    if plain_text and "rgb_array" in modes:
        print(f"note: {settings.env.name} has no text of its own to show; render=gif draws it")
    try:
        table = check_policy("policy", table, n_states, n_actions)
    except InputError as error:
        raise InputError("run", run, f"one whose policy fits its environment ({error})") from error
    if cfg.greedy:
        table = np.eye(n_actions)[table.argmax(1)]
    with contextlib.closing(make_env(settings.env, mode if mode in modes else None)) as env:
        n_shown = (cfg.n_steps or SHOWN[cfg.render]) if mode in modes or plain_text else 0
        masked = not reads_table(settings.env, env) or bool(settings.env.get("use_action_mask"))
        played = episodes(env, table, cfg.n_episodes, settings.evaluation.horizon, cfg.seed, n_shown, masked)
        fps = env.metadata.get("render_fps", 10)
    return _told(cfg, settings, run, played, fps)


def _told(cfg: DictConfig, settings: DictConfig, run: Path, played: Played, fps: float) -> Played:
    """``played``, printed, and drawn where ``cfg`` asks for it."""
    head = f"{settings.env.name}, {settings.learner.name}" + ("" if cfg.replica is None else f", replica {cfg.replica}")
    print(_report(f"{head}{', greedy' * cfg.greedy}, seed {cfg.seed} ({run})", played))
    if cfg.render == "ansi" and played.shown:
        print(f"\nthe first {len(played.shown) - 1} steps of the first episode:\n")
        print("\n".join(played.shown))
    if cfg.render == "gif":
        which = ("" if cfg.replica is None else f"-replica-{cfg.replica}") + "-greedy" * cfg.greedy
        path = write_gif(run / f"episode{which}-seed-{cfg.seed}.gif", played.shown, fps)
        print(f"{'picture':18}{path}")
    return played


def _of_network(cfg: DictConfig, settings: DictConfig, run: Path) -> tuple[Played, float]:
    """Episodes of the network that ``run`` learnt, and pictures a second. Raises InputError."""
    name = FILE
    if not (run / FILE).is_file():
        replica = cfg.replica or 0
        if not 0 <= replica < settings.n_replicas:
            raise InputError("replica", replica, f"a whole number in [0, {settings.n_replicas})")
        name = of_seed(settings.seed + replica)
    elif cfg.replica is not None:
        raise InputError("replica", cfg.replica, f"left out: {run} holds one policy")
    policy, problem = load_policy(run / name), make_network_problem(settings)
    outputs = problem.n_actions or 2 * len(problem.low)
    if (problem.n_observation, outputs) != (policy.layout.widths[0], policy.layout.widths[-1]):
        raise InputError("run", run, "one whose policy fits its environment")
    mode = MODES.get(cfg.render)
    with contextlib.closing(raw_env(settings.env)) as plain:
        modes = plain.metadata.get("render_modes") or []
    if cfg.render == "gif" and mode not in modes:
        raise InputError("render", "gif", f"ansi or none: {settings.env.name} draws no pictures")
    drawn = {"render_mode": mode} if mode in modes else {}
    n_shown = 0 if cfg.render == "none" else cfg.n_steps or SHOWN[cfg.render]
    n, horizon = cfg.n_episodes, settings.evaluation.horizon
    returns, lengths, ended = np.zeros(n), np.zeros(n, np.int64), np.zeros(n, bool)
    shown: list[Any] = []
    with contextlib.closing(raw_env(settings.env, **drawn)) as env:
        for i, own in enumerate(np.random.SeedSequence([cfg.seed, 3]).spawn(n)):
            rng = np.random.default_rng(own)
            observation, _ = env.reset(seed=int(rng.integers(2**31)))
            if i == 0 and n_shown:
                shown.append(env.render() if drawn else str(observation))
            over = False
            while not over and lengths[i] < horizon:
                now, uniform = (
                    np.asarray(observation, np.float32).reshape(1, -1),
                    rng.random((1, max(1, len(problem.low)))),
                )
                a = (policy.best(now) if cfg.greedy else policy.draw(now, uniform)[0])[0]
                taken = a if problem.low else int(a) + problem.first_action
                observation, reward, terminated, truncated, _ = env.step(taken)
                returns[i] += float(reward)
                lengths[i] += 1
                ended[i], over = terminated, terminated or truncated
                if i == 0 and lengths[0] <= n_shown:
                    line = f"a={a}, r={float(reward):g}, {observation}{', the end' * bool(terminated)}"
                    shown.append(env.render() if drawn else line)
        return Played(returns, lengths, ended, shown), env.metadata.get("render_fps", 10)


def _check_named(cfg: DictConfig, settings: DictConfig, run: Path) -> None:
    """Whatever is imported to make the environment of ``run`` must be named in ``cfg``. Raises InputError."""
    kind = settings.env.get("class")
    named = cfg.env["class"]
    if named is not None and named != kind:
        raise InputError("env.class", named, f"left out: the environment of {run} is of another class")
    module, colon, _ = str(settings.env.get("id")).partition(":")
    wanted = [f"env.class={kind}"] * (kind is not None and not is_own(kind) and named is None)
    wanted += [f"module={module}"] * bool(colon and cfg.module is None)
    if wanted:
        raise InputError(
            "run", run, f"played with what makes its environment, which is imported: add {shlex.join(wanted)}"
        )
    if cfg.module is not None and cfg.module != (module if colon else None):
        allowed = module if colon else f"left out: no module makes the environment of {run}"
        raise InputError("module", cfg.module, allowed)


def episodes(
    env: gym.Env[Any, Any],
    policy: np.ndarray,
    n_episodes: int,
    horizon: int,
    seed: int,
    n_shown: int = 0,
    masked: bool = True,
) -> Played:
    """Play ``policy`` [S, A]: episodes of at most ``horizon`` steps, each with its own random stream.

    ``n_shown`` steps of the first episode are rendered, in the environment's render mode; without one each is a line of
    state, action and reward. ``masked``: of the actions that the environment masks none is taken.
    """
    checks.memory("n_episodes", n_episodes, 17 * n_episodes, "the returns and lengths of all episodes")
    returns, lengths, ended = np.zeros(n_episodes), np.zeros(n_episodes, np.int64), np.zeros(n_episodes, bool)
    shown: list[Any] = []
    names = Names(*labels_of(env))
    evaluation = streams(seed).evaluation
    for i in range(n_episodes):
        (rng,) = evaluation.spawn(1)
        first, draw = reset(env, rng), Draws(policy, rng, masked=masked)
        if i == 0 and n_shown:
            shown.append(names.state(first.s) if env.render_mode is None else env.render())
            if isinstance(shown[0], np.ndarray):
                most = min(n_shown, horizon)
                checks.memory("n_steps", n_shown, shown[0].nbytes * most, f"{most:,} pictures")
        for step in episode(env, first, draw, horizon):
            returns[i] += step.r
            lengths[i] += 1
            ended[i] = step.terminated
            if i == 0 and lengths[0] <= n_shown:
                shown.append(_line(step, names) if env.render_mode is None else env.render())
    return Played(returns, lengths, ended, shown)


def _line(step: Step, names: Names) -> str:
    """One step as text."""
    after = names.state(step.s_next, "s'")
    return f"{names.pair(step.s, step.a)}, r={step.r:g}, {after}{', the end' * step.terminated}"


def find_run(name: str) -> Path:
    """The run directory of that name; ``latest`` is the newest below ``runs/``. Raises InputError."""
    if name == "latest":
        saved = [path for table in TABLES for path in RUNS.rglob(table)]
        if not saved:
            raise InputError("run", name, f"a run directory: there is no run below {RUNS}/")
        return max(saved, key=lambda path: path.stat().st_mtime_ns).parent
    directory = Path(name)
    if not any((directory / table).is_file() for table in TABLES):
        raise InputError("run", name, f"a run directory of train.py, with {' or '.join(TABLES)}")
    return directory


def run_settings(run: Path) -> DictConfig:
    """The configuration of ``run``, with the rewards that its environment itself pays. Raises InputError."""
    path = run / ".hydra" / "config.yaml"
    try:
        cfg: Any = OmegaConf.load(path)
        OmegaConf.resolve(cfg)
        check_keys(cfg)
        place = "class" if "class" in cfg.env else "id"
        for group, names in (("env", ("name", place)), ("learner", ("name",)), ("evaluation", ("horizon",))):
            for name in names:
                _ = cfg[group][name]
        if "n_samples" in cfg.env:
            cfg.env.reward = "original"  # not those of the control task's endless model
        checks.at_least("evaluation.horizon", cfg.evaluation.horizon, 1)
    except Exception as error:  # of the parser, of OmegaConf, of values of any kind
        cause = " ".join(str(error).split())[:200]
        raise InputError(
            "run", run, f"a run directory with the configuration {path.relative_to(run)} ({cause})"
        ) from error
    return DictConfig(cfg)


def run_policy(run: Path, replica: int | None) -> np.ndarray:
    """The policy [S, A] that ``run`` learnt, or that one replica of it learnt. Raises InputError."""
    if (run / "solution.npz").is_file():
        if replica is not None:
            raise InputError("replica", replica, f"left out: {run} holds one policy")
        return np.asarray(Solution.load(run / "solution.npz").policy)
    replicas = ReplicaSolution.load(run / "replicas.npz")
    if not 0 <= (replica or 0) < len(replicas):
        raise InputError("replica", replica, f"a whole number in [0, {len(replicas)})")
    return np.asarray(replicas[replica or 0].policy)


def _report(head: str, played: Played) -> str:
    lines = [head, f"{'':18}{'mean':>12}{'quartiles':>26}{'extremes':>26}"]
    for name, values in (("return", played.returns), ("steps", played.lengths)):
        least, low, high, most = np.quantile(values, (0, 0.25, 0.75, 1))
        quartiles, extremes = f"{low:.6g} to {high:.6g}", f"{least:.6g} to {most:.6g}"
        lines.append(f"{name:18}{values.mean():12.6g}{quartiles:>26}{extremes:>26}")
    lines.append(f"{'episodes':18}{len(played.returns)}, of which the environment ended {played.ended.sum()}")
    return "\n".join(lines)
