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
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from omegaconf import DictConfig, OmegaConf

from erl_torch import checks
from erl_torch.checks import InputError
from erl_torch.compiled import announcement
from erl_torch.experience.experience import Experience, permitted
from erl_torch.experience.log import Log
from erl_torch.experience.simulation import digest, longest
from erl_torch.experience.sources import Simulate, Source
from erl_torch.learners.learner import TabularLearner, as_told, with_prior
from erl_torch.learners.replicas import Replicas
from erl_torch.learners.s1 import kernels
from erl_torch.log.tensorboard import hyperparameters
from erl_torch.mdp.from_gymnasium import sizes
from erl_torch.mdp.tabular import check_policy
from erl_torch.notes import collected, note
from erl_torch.problem import Problem
from erl_torch.rng import streams
from erl_torch.run.build import (
    Counted,
    FromLog,
    World,
    check_sizes,
    group,
    is_log,
    make_env,
    make_experience,
    make_learner,
    make_log,
    make_problem,
    make_replica_experience,
    make_source,
    make_world,
)
from erl_torch.run.checkpoint import Checkpoints, failure_of
from erl_torch.run.groups import Group, groups_of
from erl_torch.run.judge import EvaluationSettings
from erl_torch.run.loop import Run, SafePoint
from erl_torch.run.networks import has_networks, network_digest, network_parts
from erl_torch.run.origin import shown
from erl_torch.run.replicas import ReplicaRecorder
from erl_torch.run.report import Title
from erl_torch.run.settings import check_keys
from erl_torch.run.single import SingleRecorder

# Of a run: learner, problem, experience, recorder, hyperparameters besides.
Parts = tuple[Any, Any, Any, Any, dict[str, Any]]


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
    networks = has_networks(cfg.learner)
    if not kernels.compiled_before():
        print(announcement(), file=sys.stderr)
    settings = evaluation_settings(cfg.evaluation)
    device = "cpu" if many else cfg.learner.get("device", "cpu")
    saved = Checkpoints(directory, plain(cfg), cfg.checkpoint_every, device)
    if (result := saved.result()) is not None:
        print(f"note: the run in {directory} is complete", file=sys.stderr)
        saved.clear()
        if (failure := failure_of(result)) is not None:
            raise failure
        return result
    for key in ("shared_stream", "keep_tuples"):
        if cfg[key] and not many:
            raise InputError(key, cfg[key], "left out, or used with n_replicas > 1 or vary.KEY=[...]")
    with collected() as notes, contextlib.ExitStack() as stack:
        suited = cfg.env.get("suggest", {}).get("learner")
        if suited is not None and cfg.learner.name == "s1":
            note(f"{cfg.env.name} wants learner={suited}: published S1 does not learn it (docs/environments.md)")
        parts = network_parts(cfg, settings, many) if networks else _of_tables(cfg, settings, many, stack, safe_point)
        learner, problem, experience, recorder, more = parts
        run: Run[Any, Any, Any, Any] = Run(
            learner=learner,
            problem=problem,
            experience=experience,
            digest=network_digest(experience) if networks else digest(experience),
            recorder=recorder,
            saved=saved,
            hyperparameters=hyperparameters(plain(cfg), shown(directory), **more),
            configuration=OmegaConf.to_yaml(cfg, resolve=True),
            every=settings.every,
            talks=True,
            safe_point=safe_point,
            began=began,
        )
        _, result = run.perform(notes)
        return result


def _of_tables(
    cfg: DictConfig,
    settings: EvaluationSettings,
    many: bool,
    stack: contextlib.ExitStack,
    safe_point: SafePoint,
) -> Parts:
    """Of a run of learners of tables; ``stack`` closes its environment."""
    log: Log | None = None
    if is_log(cfg.env):
        log, learner = make_log(cfg, safe_point)
        problem = log.problem
        print(f"{log.report}\n")
    else:
        env = stack.enter_context(contextlib.closing(make_env(cfg.env)))
        learner, problem = _of_environment(cfg, env, safe_point)
    return (_replicas if many else _single)(cfg, learner, problem, log, settings, safe_point)


def _of_environment(
    cfg: DictConfig, env: gym.Env[Any, Any], safe_point: SafePoint
) -> tuple[TabularLearner[Any], Problem]:
    """Who learns, and what, where there is an environment."""
    beta: float | None = None
    prior: np.ndarray | None = None
    counted: Counted | None = None
    if cfg.env.get("end_reward") == "auto" and "beta" not in cfg.vary:  # the charge depends on both
        learner = make_learner(cfg.learner, *sizes(env))
        beta = learner.beta
        if learner.prior_policy is not None:
            prior = check_policy("learner.prior_policy", learner.prior_policy, *sizes(env))
        source = make_source(cfg.experience)
        if isinstance(source, Simulate):
            stream = replace(source, save_to=None)

            def counted(world: World) -> tuple[Experience, np.ndarray]:
                problem = make_problem(cfg, env, world, learner)
                data, _ = make_experience(stream, problem, cfg.seed, safe_point)
                return data, as_told(learner, problem)[1].prior

    world = make_world(cfg.env, env, safe_point, beta, prior, counted)
    learner = make_learner(cfg.learner, *sizes(env))
    if world.allowed is not None:
        learner = with_prior(learner, world.allowed)
    return learner, make_problem(cfg, env, world, learner)


def evaluation_settings(cfg: DictConfig) -> EvaluationSettings:
    """Those of group ``evaluation``. Raises InputError."""
    with group("evaluation"):
        return EvaluationSettings(**{str(key): value for key, value in cfg.items() if key != "name"})


def plain(node: DictConfig) -> dict[str, Any]:
    """``node`` as a dictionary, resolved."""
    values: Any = OmegaConf.to_container(node, resolve=True)
    return {str(key): value for key, value in values.items()}


def _source(cfg: DictConfig, log: Log | None) -> Source:
    return make_source(cfg.experience) if log is None else FromLog(log)


# -- one learner --------------------------------------------------------------------------------------


def _single(
    cfg: DictConfig,
    learner: TabularLearner[Any],
    problem: Problem,
    log: Log | None,
    settings: EvaluationSettings,
    safe_point: SafePoint,
) -> Parts:
    learner.start(problem)  # raises where the learner cannot learn this problem
    experience: Experience | None = None
    n_skipped = 0
    if not learner.needs_model:
        experience, n_skipped = make_experience(_source(cfg, log), problem, cfg.seed, safe_point)
        learner, problem = as_told(learner, problem)
        experience = permitted(experience, problem.prior, learner.drawn_from_prior == "a_next", note)
        safe_point()
    title = Title(cfg.env.name, cfg.learner.name, cfg.seed)
    rng = streams(cfg.seed).evaluation
    recorder = SingleRecorder(learner, problem, experience, settings, rng, title, n_skipped, log)
    return learner, problem, experience, recorder, {"n_experience": 0 if experience is None else len(experience)}


# -- replicas -----------------------------------------------------------------------------------------


def _replicas(
    cfg: DictConfig,
    learner: TabularLearner[Any],
    problem: Problem,
    log: Log | None,
    settings: EvaluationSettings,
    safe_point: SafePoint,
) -> Parts:
    if learner.needs_model:
        allowed = "one that learns from experience: replicas of it would be the same"
        raise InputError("learner", cfg.learner.name, allowed)
    check_sizes(problem.n_states, problem.n_actions, cfg.n_replicas)
    vary = plain(cfg.vary)
    groups = groups_of(vary, cfg.n_replicas, plain(cfg.learner), float(learner.beta), float(learner.optimism))
    check_sizes(problem.n_states, problem.n_actions, cfg.n_replicas * len(groups))
    learners = [_with(learner, one) for one in groups for _ in range(cfg.n_replicas)]
    for one in learners[:: cfg.n_replicas]:
        one.start(problem)
    replicas = Replicas(tuple(learners), cfg.threads or os.cpu_count() or 1)
    seeds = [cfg.seed + i for _ in groups for i in range(cfg.n_replicas)]
    source = _source(cfg, log)
    for key in source.designed_for:
        if key in vary and not cfg.shared_stream:
            allowed = (
                f"one value, for which the stream is designed (or shared_stream=true; or a sweep, -m learner.{key}=A,B)"
            )
            raise InputError(f"vary.{key}", vary[key], allowed)
    experience = make_replica_experience(cfg, source, problem, seeds, safe_point)
    replicas, problem = as_told(replicas, problem)
    experience = replicas.permitted(experience, problem.n_states, problem.n_actions, note)
    title = Title(cfg.env.name, cfg.learner.name, cfg.seed)
    recorder = ReplicaRecorder(replicas, problem, experience, groups, seeds, vary, settings, title, safe_point, log)
    varied = {f"vary.{key}": values for key, values in vary.items()}
    sizes_told = {"n_replicas": cfg.n_replicas, "n_experience": longest(experience)}
    return replicas, problem, experience, recorder, sizes_told | varied


def _with(learner: Any, group: Group) -> Any:  # a dataclass of the user's choice
    try:
        return replace(learner, **group.settings)
    except InputError as error:
        raise error.within("vary") from error
