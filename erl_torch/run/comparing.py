"""One comparison of learners, from a configuration to a run directory; Hydra stays outside.

The directory holds ``compare.json`` (``Comparison.summary``) and ``compare.png``.
"""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig
from tqdm import tqdm

from erl_torch import checks, pictures
from erl_torch.checks import InputError
from erl_torch.files import read_npy, write_json, write_png
from erl_torch.learners import LEARNERS
from erl_torch.learners.s1 import kernels
from erl_torch.mdp.tabular import TabularMDP
from erl_torch.notes import collected
from erl_torch.run.comparison import compare
from erl_torch.run.settings import check_comparison_keys
from erl_torch.run.training import make_env, make_learner, make_world

FIT_BYTES = 500  # of the figures of one fit


def run_comparison(cfg: DictConfig, directory: Path, safe_point: Callable[[], None] = lambda: None) -> dict[str, Any]:
    """Run ``cfg`` (as composed from ``conf/compare.yaml``) in ``directory``; returns what ``compare.json`` holds.

    ``safe_point`` is called after each fit. Raises InputError before anything is learnt or written.
    """
    began = time.perf_counter()
    check_comparison_keys(cfg)
    for key, least in (("seed", 0), ("seeds", 1), ("n_sizes", 1)):
        checks.at_least(key, cfg[key], least)
    checks.at_least("seed + seeds", cfg.seed + cfg.seeds, 1)
    checks.workers("processes", cfg.processes)
    fits = len(cfg.learners) * cfg.seeds
    checks.memory("seeds", cfg.seeds, FIT_BYTES * fits, f"{fits:,} fits")
    checks.memory("n_sizes", cfg.n_sizes, FIT_BYTES * fits * cfg.n_sizes, f"{fits:,} fits of each size")
    checks.processes("processes", min(cfg.processes, fits))
    if cfg.experience.name != "simulate":
        raise InputError("experience", cfg.experience.name, "simulate: every seed needs a stream of its own")
    if cfg.experience.save_to is not None:
        raise InputError("experience.save_to", cfg.experience.save_to, "null: there is a stream a seed")
    if not cfg.learners:
        raise InputError("learners", "[]", "at least one")
    for name in cfg.learners:
        if not hasattr(LEARNERS.get(name), "fit"):
            able = " or ".join(name for name, learner in LEARNERS.items() if hasattr(learner, "fit"))
            raise InputError("learners", name, able)
    torch.set_num_threads(1)
    if not kernels.compiled_before():
        print("compiling the loops, about ten seconds: on the first run only", file=sys.stderr)
    with collected(), contextlib.closing(make_env(cfg.env)) as env:
        world = make_world(cfg.env, env, safe_point)
    # The start of the stream may be another than that of the episodes; the optimum does not depend on it.
    mdp = world.source if isinstance(world.source, TabularMDP) else world.mdp
    if mdp is None:
        raise InputError("env", cfg.env.name, "one with a known model: gaps are measured against its exact solution")
    learners = {}
    for name in cfg.learners:
        settings = cfg.learner[name].copy()
        for key in ("beta", "prior_policy"):
            if cfg[key] is not None:
                settings[key] = cfg[key]
        learners[name] = make_learner(settings, mdp.n_states, mdp.n_actions, f"learner.{name}")
    behaviour = cfg.experience.behaviour_policy
    total = len(learners) * cfg.seeds
    with tqdm(
        total=total, desc="comparing", unit=" fits", disable=None,
        bar_format="{l_bar}{bar:20}| {n_fmt}/{total_fmt}{unit}, {elapsed}<{remaining}",
    ) as bar:  # fmt: skip

        def report(done: int, total: int) -> None:
            bar.update(done - bar.n)
            safe_point()

        found = compare(
            mdp,
            learners,
            cfg.experience.n_episodes,
            cfg.experience.episode_length,
            range(cfg.seed, cfg.seed + cfg.seeds),
            None if behaviour is None else read_npy(behaviour, "experience.behaviour_policy"),
            next(iter(learners.values())).prior_policy,
            cfg.n_sizes,
            cfg.processes,
            report,
        )
    result = {"env": cfg.env.name, **found.summary(), "seconds": round(time.perf_counter() - began, 1)}
    write_json(directory / "compare.json", result)
    title = f"{cfg.env.name}, beta {found.beta:g}: {len(found.seeds)} seeds"
    write_png(directory / "compare.png", pictures.learning_curves(result["sizes"], result["curves"], title))
    with contextlib.suppress(ValueError):
        directory = directory.resolve().relative_to(Path.cwd())
    print(f"\n{title}, {found.sizes[-1]:,} tuples each, theta* {found.theta:.7f}\n\n{found.table()}")
    print("\ngap: mean over seeds, interquartile mean and its interval (Student's t); other columns: means")
    print(f"tuples: streamed, all passes together\nrun directory  {directory}")
    return result
