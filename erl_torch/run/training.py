"""One training run in a directory, from a configuration; Hydra stays outside.

A run directory holds the event file, ``result.json`` and ``solution.npz`` (and Hydra's ``.hydra/``); that of replicas
``replicas.npz`` (``ReplicaSolution``, and the record of every replica), ``bands.png`` and, where settings vary,
``sweep.png``. A replica of a seed is the run of that seed alone, bit for bit.
"""

from __future__ import annotations

import contextlib
import os
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from tqdm import tqdm

from erl_torch import checks
from erl_torch.checks import InputError
from erl_torch.experience.collect import collect
from erl_torch.experience.experience import Experience
from erl_torch.experience.recording import check_target, save_columns
from erl_torch.experience.simulation import KEEP_BYTES, TUPLE_BYTES, ReplicaExperience, Simulation, streams_of
from erl_torch.experience.transitions import Transitions
from erl_torch.files import read_npy
from erl_torch.learners.replicas import Replicas
from erl_torch.learners.s1 import kernels
from erl_torch.log.tensorboard import hyperparameters
from erl_torch.mdp.from_gymnasium import known_mdp, sizes
from erl_torch.mdp.tabular import check_policy
from erl_torch.notes import collected
from erl_torch.problem import Problem
from erl_torch.rng import streams
from erl_torch.run.build import (
    check_sizes,
    collected_experience,
    group,
    make_env,
    make_learner,
    make_world,
    recorded,
)
from erl_torch.run.checkpoint import Checkpoints
from erl_torch.run.groups import Group, groups_of
from erl_torch.run.judge import EvaluationSettings
from erl_torch.run.loop import Run, SafePoint
from erl_torch.run.replicas import ReplicaRecorder
from erl_torch.run.report import Title
from erl_torch.run.settings import check_keys
from erl_torch.run.single import SingleRecorder


def train(cfg: DictConfig, directory: Path, safe_point: Callable[[], None] = lambda: None) -> dict[str, Any]:
    """Run ``cfg`` (as composed from ``conf/``) in ``directory``; returns what ``result.json`` holds.

    ``safe_point`` is called between blocks of work; it may raise SystemExit or KeyboardInterrupt, which goes
    on to the caller once everything learnt has been written.

    Raises:
        InputError: a key or value that cannot be used, before anything is learnt or written.
        NonFiniteError: the learner (or a replica) left the finite numbers; everything is written, up to the last good
            epoch.
    """
    began = time.perf_counter()
    check_keys(cfg)
    checks.at_least("seed", cfg.seed, 0)
    checks.at_least("n_replicas", cfg.n_replicas, 1)
    checks.at_least("seed + n_replicas", cfg.seed + cfg.n_replicas, 1)  # seeds count on from the first
    if cfg.threads is not None:
        checks.workers("threads", cfg.threads)
    if cfg.checkpoint_every is not None and not cfg.checkpoint_every >= 0:
        raise InputError("checkpoint_every", cfg.checkpoint_every, "seconds >= 0, or null")
    many = cfg.n_replicas > 1 or bool(cfg.vary)
    torch.set_num_threads(1 if many else cfg.threads or 1)
    if not kernels.compiled_before():
        print("compiling the loops, about ten seconds: on the first run only", file=sys.stderr)
    settings = evaluation_settings(cfg.evaluation)
    device = "cpu" if many else cfg.learner.get("device", "cpu")
    saved = Checkpoints(directory, plain(cfg), cfg.checkpoint_every, device)
    if (result := saved.result()) is not None:
        print(f"note: the run in {directory} is complete", file=sys.stderr)
        saved.clear()
        return result
    for key in ("shared_stream", "keep_tuples"):
        if cfg[key] and not many:
            raise InputError(key, cfg[key], "left out, or used with n_replicas > 1 or vary.KEY=[...]")
    with collected() as notes, contextlib.closing(make_env(cfg.env)) as env:
        n_states, n_actions = sizes(env)
        world = make_world(cfg.env, env, safe_point)
        learner = make_learner(cfg.learner, n_states, n_actions)
        prior = check_policy("learner.prior_policy", learner.prior_policy, n_states, n_actions)
        horizon = min(settings.horizon, (env.spec and env.spec.max_episode_steps) or settings.horizon)
        problem = Problem(env, world.source, prior, world.mdp, world.episode, horizon, cfg.env.name)
        make = _replicas if many else _single
        run = make(cfg, learner, problem, settings, saved, safe_point, began)
        return run.perform(notes)


def evaluation_settings(cfg: DictConfig) -> EvaluationSettings:
    """Those of group ``evaluation``. Raises InputError."""
    with group("evaluation"):
        return EvaluationSettings(**{str(key): value for key, value in cfg.items() if key != "name"})


def plain(node: DictConfig) -> dict[str, Any]:
    """``node`` as a dictionary, resolved."""
    values: Any = OmegaConf.to_container(node, resolve=True)
    return {str(key): value for key, value in values.items()}


def _common(
    cfg: DictConfig,
    problem: Problem,
    settings: EvaluationSettings,
    saved: Checkpoints,
    safe_point: SafePoint,
    began: float,
    **more: Any,
) -> dict[str, Any]:
    """Arguments of ``Run`` that all runs of a configuration share."""
    return {
        "problem": problem,
        "saved": saved,
        "hyperparameters": hyperparameters(cfg, **more),
        "configuration": OmegaConf.to_yaml(cfg, resolve=True),
        "every": settings.every,
        "talks": True,
        "safe_point": safe_point,
        "began": began,
    }


# -- one learner --------------------------------------------------------------------------------------


def _single(
    cfg: DictConfig,
    learner: Any,
    problem: Problem,
    settings: EvaluationSettings,
    saved: Checkpoints,
    safe_point: SafePoint,
    began: float,
) -> Run[Any, Experience, Any]:
    rng = streams(cfg.seed)
    experience: Experience | None = None
    n_skipped = 0
    learner.start(problem)  # raises where the learner cannot learn this problem
    if not learner.needs_model:
        shape = problem.n_states, problem.n_actions
        if cfg.experience.name == "recorded":
            recording = recorded(cfg.experience, problem.env, *shape, cfg.seed, problem.prior, safe_point)
            experience, n_skipped = recording.held(), recording.n_skipped
        else:
            experience = collected_experience(cfg.experience, problem.source, *shape, rng, problem.prior, safe_point)
        safe_point()
    title = Title(cfg.env.name, cfg.learner.name, cfg.seed)
    recorder = SingleRecorder(learner, problem, experience, settings, rng.evaluation, title, n_skipped)
    n_experience = 0 if experience is None else len(experience)
    return Run(
        learner=learner,
        experience=experience,
        digest=None if experience is None else experience.checksum(),
        recorder=recorder,
        **_common(cfg, problem, settings, saved, safe_point, began, n_experience=n_experience),
    )


# -- replicas -----------------------------------------------------------------------------------------


def _replicas(
    cfg: DictConfig,
    learner: Any,
    problem: Problem,
    settings: EvaluationSettings,
    saved: Checkpoints,
    safe_point: SafePoint,
    began: float,
) -> Run[Any, ReplicaExperience, Any]:
    if learner.needs_model:
        allowed = "one that learns from experience: replicas of it would be the same"
        raise InputError("learner", cfg.learner.name, allowed)
    check_sizes(problem.n_states, problem.n_actions, cfg.n_replicas)
    vary = plain(cfg.vary)
    groups = groups_of(vary, cfg.n_replicas, plain(cfg.learner))
    check_sizes(problem.n_states, problem.n_actions, cfg.n_replicas * len(groups))
    learners = [_with(learner, one) for one in groups for _ in range(cfg.n_replicas)]
    for one in learners[:: cfg.n_replicas]:
        one.start(problem)
    replicas = Replicas(tuple(learners), cfg.threads or os.cpu_count() or 1)
    seeds = [cfg.seed + i for _ in groups for i in range(cfg.n_replicas)]
    experience = _experience(cfg, problem, seeds, safe_point)
    title = Title(cfg.env.name, cfg.learner.name, cfg.seed)
    recorder = ReplicaRecorder(replicas, problem, experience, groups, seeds, vary, settings, title, safe_point)
    digest = None if isinstance(experience, Simulation) else [data.checksum() for data in streams_of(experience)]
    more = {"n_replicas": cfg.n_replicas, "n_experience": recorder.n_experience}
    more |= {f"vary.{key}": values for key, values in vary.items()}
    return Run(
        learner=replicas,
        experience=experience,
        digest=digest,
        recorder=recorder,
        **_common(cfg, problem, settings, saved, safe_point, began, **more),
    )


def _with(learner: Any, group: Group) -> Any:
    try:
        return replace(learner, **group.settings)
    except InputError as error:
        raise error.within("vary") from error


def _experience(cfg: DictConfig, problem: Problem, seeds: Sequence[int], safe_point: SafePoint) -> ReplicaExperience:
    shared = cfg.shared_stream or cfg.experience.name == "recorded"
    if shared and cfg.n_replicas > 1:
        allowed = (
            "1: on one stream, replicas with the same settings would be the same (let settings vary, vary.KEY=[...])"
        )
        raise InputError("n_replicas", cfg.n_replicas, allowed)
    prior = problem.prior
    if cfg.experience.name == "recorded":
        recording = recorded(
            cfg.experience, problem.env, problem.n_states, problem.n_actions, cfg.seed, prior, safe_point
        )
        if len(recording) * 24 > KEEP_BYTES:
            most, n = KEEP_BYTES // 24, len(recording)
            allowed = f"of at most {most:,} tuples, as replicas hold them in memory: it has {n:,}"
            raise InputError("experience.path", recording.path, allowed)
        return recording.load()
    e = cfg.experience
    if e.save_to is not None and not shared:
        raise InputError("experience.save_to", e.save_to, "null: there is a stream a replica (or shared_stream=true)")
    behaviour = None if e.behaviour_policy is None else read_npy(e.behaviour_policy, "experience.behaviour_policy")
    if shared:
        if e.save_to is not None:
            check_target("experience.save_to", e.save_to)
        data = collect(problem.source, e.n_episodes, e.episode_length, cfg.seed, behaviour, prior)
        if e.save_to is not None:
            check_target("experience.save_to", e.save_to)
            save_columns(data, e.save_to) if e.save_to.endswith("/") else data.save(e.save_to)
        return data
    mdp = known_mdp(problem.source)
    if mdp is not None:
        if cfg.keep_tuples:
            held = TUPLE_BYTES * len(seeds) * e.n_episodes * e.episode_length
            checks.memory("keep_tuples", "true", held, f"the tuples of {len(seeds):,} replicas")
        return Simulation(mdp, e.n_episodes, e.episode_length, seeds, behaviour, cfg.keep_tuples)
    made: dict[int, Transitions] = {}
    for seed in tqdm(sorted(set(seeds)), desc="collecting", unit=" streams", delay=1, leave=False, disable=None):
        made[seed] = collect(problem.source, e.n_episodes, e.episode_length, seed, behaviour, prior)
        safe_point()
    return [made[seed] for seed in seeds]
