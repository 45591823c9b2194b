"""From a configuration to objects: environment, model, learner, experience."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Callable, Iterator
from dataclasses import fields
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from omegaconf import DictConfig, OmegaConf
from tqdm import tqdm

from erl_torch import checks
from erl_torch.checks import InputError
from erl_torch.envs.discretise import Discretise
from erl_torch.envs.estimate import estimate_mdp
from erl_torch.experience.collect import collect
from erl_torch.experience.experience import Experience
from erl_torch.experience.recording import FileRecording, check_target
from erl_torch.files import read_npy
from erl_torch.learners import LEARNERS
from erl_torch.mdp.from_gymnasium import MeanRewardWarning, absorbing, known_mdp, tabular_mdp
from erl_torch.mdp.tabular import TabularMDP
from erl_torch.notes import note
from erl_torch.rng import Streams

SafePoint = Callable[[], None]
TABLES = 8  # of a learner's size, about, while it learns and is evaluated
REPLICA_BYTES = 10_000  # of a replica, besides: generators and settings
NOT_ARGUMENTS = ("name", "id", "suggest", "stream", "n_samples", "model_seed")


class World(NamedTuple):
    """What a run learns from and is judged by."""

    source: TabularMDP | gym.Env[Any, Any]  # of the stream
    mdp: TabularMDP | None  # the model to evaluate on, to certify with, and to solve
    episode: TabularMDP | None = None  # the model of one episode: its end is absorbed, without reward


@contextlib.contextmanager
def group(name: str) -> Iterator[None]:
    """Complaints raised inside name their configuration group."""
    try:
        yield
    except InputError as error:
        raise error.within(name) from error


def make_env(cfg: DictConfig, render_mode: str | None = None) -> gym.Env[Any, Any]:
    """The environment of ``cfg``. Raises InputError."""
    keys: Any = OmegaConf.to_container(cfg, resolve=True)
    arguments = keys["kwargs"] if "kwargs" in keys else {k: v for k, v in keys.items() if k not in NOT_ARGUMENTS}
    with group("env"):
        if isinstance(arguments.get("wind"), str):
            arguments["wind"] = read_npy(arguments["wind"], "wind")
        if render_mode is not None:
            arguments["render_mode"] = render_mode
        try:
            env = gym.make(cfg.id, **arguments)
        except InputError:
            raise
        except (gym.error.Error, ImportError) as error:
            raise InputError("id", cfg.id, f"an environment that Gymnasium has ({error})") from error
        except Exception as error:  # whatever an environment answers arguments with
            if checks.out_of_memory(error):
                raise
            said = f"{type(error).__name__}: {error}"
            raise InputError("kwargs", arguments, f"arguments of {cfg.id} ({said})") from error
        binning = {key: keys.get(key) for key in ("bins", "low", "high", "actions")}
        if "kwargs" in keys and any(value is not None for value in binning.values()):
            return Discretise(env, **binning)
        return env


def make_world(cfg: DictConfig, env: gym.Env[Any, Any], safe_point: SafePoint) -> World:
    """What there is to learn from in ``env``, as ``cfg`` says. Raises InputError."""
    if "n_samples" in cfg:
        return _control_world(cfg, env, safe_point)
    on_end = cfg.get("on_end", "restart")
    checks.one_of("env.on_end", on_end, ("restart", "absorb"))
    if known_mdp(env) is not None or not cfg.get("use_model") or not hasattr(env.unwrapped, "P"):
        if on_end == "absorb":
            raise InputError("env.on_end", on_end, "restart, where there is no model (P) to read")
        return World(env, known_mdp(env))
    models = {}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", MeanRewardWarning)
        for reading in ("restart", "absorb"):
            try:
                models[reading] = tabular_mdp(env, reading)
            except InputError as error:
                if reading == on_end == "absorb":
                    raise error.within("env") from error
                if reading == on_end:
                    note(f"learning from env.step, for {error}")
    for message in sorted({str(warning.message) for warning in caught}):
        note(message)
    episode = models.get("absorb")
    if episode is not None and episode.reward[absorbing(episode)].any():
        episode = None  # an end that pays for ever is no end
    mdp = models.get(on_end)
    return World(env if mdp is None else mdp, mdp, episode)


def _control_world(cfg: DictConfig, env: gym.Env[Any, Any], safe_point: SafePoint) -> World:
    with group("env"):
        checks.one_of("stream", cfg.stream, ("model", "episodes"))
        if cfg.stream == "episodes":
            return World(env, None)
        base: Any = env.unwrapped
        mdp = estimate_mdp(
            base.task,
            base.bins.bins,
            base.bins.low,
            base.bins.high,
            actions=base.actions if base.task.max_action is not None else None,
            n_samples=cfg.n_samples,
            seed=cfg.model_seed,
            report=lambda _: safe_point(),
            progress=True,
        ).mdp
    # Episodes of the stream start in any cell, so that all are learnt about.
    return World(TabularMDP(mdp.transition, mdp.reward), mdp)


def episode_model(env: gym.Env[Any, Any], world: World) -> TabularMDP | None:
    """The model whose rewards over the horizon are an episode's return; None where there is none."""
    endless = known_mdp(env) is not None and not getattr(env.unwrapped, "ends", np.zeros(1)).any()
    return world.episode or (world.mdp if endless else None)


def make_learner(cfg: DictConfig, n_states: int, n_actions: int, key: str = "learner") -> Any:
    """The learner of ``cfg``; complaints name their keys under ``key``."""
    learner_class = LEARNERS[cfg.name]
    with group(key):
        arguments = {f.name: cfg[f.name] for f in fields(learner_class)}
        if cfg.prior_policy is not None:
            arguments["prior_policy"] = read_npy(cfg.prior_policy, "prior_policy")
        learner = learner_class(**arguments)
    check_sizes(n_states, n_actions)
    with group(key):
        learner.init(n_states, n_actions)  # validates the prior against the sizes
        return learner


def check_sizes(n_states: int, n_actions: int, n_replicas: int = 1) -> None:
    """Raise InputError unless pairs have numbers of 32 bits, and the tables of a learner find room."""
    n_pairs = n_states * n_actions
    if n_pairs >= 2**31:
        raise InputError("n_states * n_actions", f"{n_states} * {n_actions}", "below 2**31")
    needed = n_replicas * (8 * TABLES * n_pairs + REPLICA_BYTES)
    what = f"{n_states:,} states and {n_actions:,} actions, in {TABLES} tables"
    if n_replicas > 1:
        checks.memory("n_replicas", n_replicas, needed, f"a learner each, of {what}")
    else:
        checks.memory("n_states * n_actions", f"{n_states} * {n_actions}", needed, what)


def recorded(
    cfg: DictConfig, env: Any, n_states: int, n_actions: int, seed: int, prior: np.ndarray, safe_point: SafePoint
) -> FileRecording:
    """The stream that ``cfg`` names. Raises InputError."""
    with group("experience"), _collecting("reading", None, safe_point) as report:
        data = FileRecording(
            cfg.path,
            n_states,
            n_actions,
            on_bad=cfg.on_bad,
            chunk=cfg.chunk,
            env=env,
            prior_policy=prior,
            on_prior=cfg.on_prior,
            seed=seed,
            report=report,
        )
    if data.n_skipped:
        total = data.n_skipped + len(data)
        said = f"; the first is {data.first_skipped}" if data.first_skipped else ""
        note(f"{cfg.path}: {data.n_skipped:,} bad tuples of {total:,} left out{said}")
    return data


@contextlib.contextmanager
def _collecting(what: str, total: int | None, safe_point: SafePoint) -> Iterator[Callable[[int], None]]:
    """A progress bar that is told how many tuples there are so far, and lets signals through."""
    with tqdm(
        total=total, desc=what, unit=" tuples", unit_scale=True, delay=1, leave=False, disable=None,
    ) as bar:  # fmt: skip

        def report(n: int) -> None:
            bar.update(n - bar.n)
            safe_point()

        yield report


def collected_experience(
    cfg: DictConfig,
    source: TabularMDP | gym.Env[Any, Any],
    n_states: int,
    n_actions: int,
    rng: Streams,
    prior: np.ndarray,
    safe_point: Callable[[], None],
) -> Experience:
    with group("experience"):
        behaviour = None
        if cfg.behaviour_policy is not None:
            behaviour = read_npy(cfg.behaviour_policy, "behaviour_policy")
        if cfg.save_to is not None:
            check_target("save_to", cfg.save_to)
        total = cfg.n_episodes * cfg.episode_length if cfg.n_episodes >= 1 and cfg.episode_length >= 1 else 0
        with _collecting("collecting", total, safe_point) as report:
            arguments = cfg.n_episodes, cfg.episode_length, rng, behaviour, prior, report
            if cfg.save_to is not None and cfg.save_to.endswith("/"):
                return collect(source, *arguments, save_to=str(cfg.save_to))
            data = collect(source, *arguments)
        if cfg.save_to is not None:
            check_target("save_to", cfg.save_to)  # again: the collecting may have taken hours
            data.save(cfg.save_to)
        return data


def check_evaluation(cfg: DictConfig) -> None:
    with group("evaluation"):
        for key in ("every", "n_episodes", "horizon", "exact_up_to"):
            checks.at_least(key, cfg[key], 1)
        checks.memory("n_episodes", cfg.n_episodes, 8 * cfg.n_episodes, "the returns of all episodes")
