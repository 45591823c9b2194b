"""Learners compared on the same experience, against the exact optimum of a known model.

For each seed one stream of tuples is collected and handed to every learner: all of it, and its first n tuples for the
learning curve, each time from scratch. Each policy pi is measured exactly on the model:

    gap          g* - J(pi), reward a step: J = reward rate - KL(pi || prior)/beta, g* = -theta* its maximum.
                 Computed as (1/beta) E_{d_pi} KL(pi || pi*), which is the same and loses no digits near the optimum
                 (of learners with ``optimism``: J is the nested one, and all have the same)
    kl           sum_s d*(s) KL(pi*(.|s) || pi(.|s)), nats, d* the stationary distribution of pi*
    kl_states    mean over all states of the same KL
    theta_error  |theta - theta*|, reward a step; NaN where the learner estimates no theta
    n_steps      tuples streamed, all passes together
    seconds      wall clock of the fit

Results other than seconds do not depend on the number of processes.
"""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import scipy.stats
import torch
from numpy.typing import ArrayLike
from omegaconf import DictConfig
from tqdm import tqdm

from erl_torch import checks, parallel, pictures
from erl_torch.checks import InputError
from erl_torch.compiled import announcement
from erl_torch.experience.collect import collect
from erl_torch.experience.sources import Simulate
from erl_torch.files import here, read_npy, write_json, write_png
from erl_torch.learners.learner import StreamLearner, with_prior
from erl_torch.learners.s1 import kernels
from erl_torch.mdp.from_gymnasium import sizes
from erl_torch.mdp.tabular import TabularMDP, check_policy
from erl_torch.notes import collected
from erl_torch.run.build import learner_class, make_env, make_learner, make_source, make_world
from erl_torch.run.report import at
from erl_torch.run.settings import check_comparison_keys
from erl_torch.solution import Status
from erl_torch.solvers.optimum import Optimum, measure, solve_optimum

MEASURES = ("gap", "kl", "kl_states", "theta_error", "n_steps", "seconds")
LEVEL = 0.95  # of the intervals
FIRST_SIZE = 1000  # tuples, of a learning curve


@dataclass(frozen=True, eq=False)
class Comparison:
    """What ``compare`` found. ``measures`` has, by the names above, arrays [learners, seeds, sizes]."""

    learners: tuple[str, ...]
    seeds: tuple[int, ...]
    sizes: tuple[int, ...]  # tuples of experience, ascending; the last is the whole stream
    beta: float
    optimism: float
    theta: float  # theta*, of the model
    measures: dict[str, np.ndarray]
    status: dict[str, list[list[str]]]  # a learner: [seeds][sizes], lower-case names of Status

    def summary(self) -> dict[str, Any]:
        """Everything as JSON takes it; null for a figure that does not exist or is not finite.

        ``table`` holds, a learner and measure of the whole stream: mean, iqm (interquartile mean over seeds) and
        ``interval`` of the iqm (``iqm_interval``); ``curves`` the iqm of the gap and its interval at every size.
        """
        table = {
            name: {m: _statistics(self.measures[m][i, :, -1]) for m in MEASURES} for i, name in enumerate(self.learners)
        }
        curves = {
            name: [_statistics(self.measures["gap"][i, :, k]) for k in range(len(self.sizes))]
            for i, name in enumerate(self.learners)
        }
        return {
            "beta": self.beta,
            "optimism": self.optimism,
            "theta": self.theta,
            "seeds": list(self.seeds),
            "sizes": list(self.sizes),
            "table": table,
            "curves": curves,
            "measures": {
                m: {name: _nullable(values[i].tolist()) for i, name in enumerate(self.learners)}
                for m, values in self.measures.items()
            },
            "status": self.status,
        }

    def table(self) -> str:
        """The whole stream's figures, a line a learner, ordered by the gap."""
        summary = self.summary()["table"]
        order = sorted(self.learners, key=lambda name: _number(summary[name]["gap"]["iqm"]))
        width = max(map(len, [*order, "learner"])) + 2
        lines = [
            f"{'learner':{width}}{'gap g* - J':>11}{'iqm':>11}  {'95 % interval':22}"
            f"{'KL(pi*||pi)':>12}{'over states':>13}{'theta error':>13}{'tuples':>13}{'seconds':>9}"
        ]
        for name in order:
            row = summary[name]
            low, high = row["gap"]["interval"] or (None, None)
            interval = f"[{_cell(low)}, {_cell(high)}]"
            failed = sum(seed[-1] == "non_finite" for seed in self.status[name])
            lines.append(
                f"{name:{width}}{_cell(row['gap']['mean']):>11}{_cell(row['gap']['iqm']):>11}  {interval:22}"
                f"{_cell(row['kl']['mean']):>12}{_cell(row['kl_states']['mean']):>13}"
                f"{_cell(row['theta_error']['mean']):>13}{row['n_steps']['mean']:13,.0f}{row['seconds']['mean']:9.2f}"
                + (f"  {failed} of {len(self.seeds)} seeds left the finite numbers" if failed else "")
            )
        return "\n".join(lines)


def compare(
    mdp: TabularMDP,
    learners: Mapping[str, Any],
    n_episodes: int = 500,
    episode_length: int = 1000,
    seeds: int | Sequence[int] = 20,
    behaviour_policy: ArrayLike | None = None,
    prior_policy: ArrayLike | None = None,
    n_sizes: int = 1,
    processes: int = 1,
    report: Callable[[int, int], object] = lambda done, total: None,
) -> Comparison:
    """Fit every learner to the same streams and measure it on the model.

    Args:
        mdp: the known model; the tuples are drawn from it.
        learners: by name; anything with ``beta``, ``optimism``, ``prior_policy`` and ``fit``. All have one beta, one
            optimism and one prior.
        n_episodes, episode_length: the stream of a seed is n_episodes * episode_length tuples.
        seeds: a number (0, 1, ...) or the seeds themselves; the streams are those of ``collect`` with that seed.
        behaviour_policy: [S, A]; None is the prior.
        prior_policy: [S, A], 0 where an action is not to be taken; None is uniform.
        n_sizes: sizes of experience on the learning curve, evenly spaced in logarithms from 1000 tuples to all.
        processes: at work at once; only ``seconds`` depends on it.
        report: called with (fits done, fits in all).

    Raises:
        InputError: an argument out of range; learners of different beta, optimism or prior; a model that has not one
            optimum.
    """
    names = tuple(learners)
    if not names:
        raise InputError("learners", "{}", "at least one")
    seeds = _seeds(seeds)
    for key, value in {
        "n_episodes": n_episodes,
        "episode_length": episode_length,
        "n_sizes": n_sizes,
    }.items():
        checks.at_least(key, value, 1)
    checks.workers("processes", processes)
    prior = check_policy("prior_policy", prior_policy, mdp.n_states, mdp.n_actions, mdp.allowed)
    learners = {name: with_prior(learner, mdp.allowed) for name, learner in learners.items()}
    beta, optimism = learners[names[0]].beta, learners[names[0]].optimism
    for name, learner in learners.items():
        if learner.beta != beta:
            raise InputError(f"{name}: beta", learner.beta, f"that of {names[0]}, {beta:g}: one objective for all")
        if learner.optimism != optimism:
            allowed = f"that of {names[0]}, {optimism:g}: one objective for all"
            raise InputError(f"{name}: optimism", learner.optimism, allowed)
        its = check_policy(f"{name}: prior_policy", learner.prior_policy, mdp.n_states, mdp.n_actions, mdp.allowed)
        if not np.allclose(its, prior, rtol=0, atol=1e-12):
            raise InputError(f"{name}: prior_policy", "array", "the prior of the comparison: one objective for all")
    best = solve_optimum(mdp, beta, prior, optimism=optimism)
    sizes = _sizes(n_episodes * episode_length, n_sizes)
    experience = (mdp, n_episodes, episode_length)
    jobs = {
        (i, j): partial(_run, learners[name], experience, seed, behaviour_policy, prior, sizes, best)
        for j, seed in enumerate(seeds)
        for i, name in enumerate(names)
    }
    measures = {name: np.full((len(names), len(seeds), len(sizes)), np.nan) for name in MEASURES}
    status = {name: [[""] * len(sizes) for _ in seeds] for name in names}
    for done, ((i, j), rows) in enumerate(parallel.results(jobs, processes), 1):
        for k, (figures, ended) in enumerate(rows):
            for name in MEASURES:
                measures[name][i, j, k] = figures[name]
            status[names[i]][j][k] = ended.name.lower()
        report(done, len(jobs))
    return Comparison(names, seeds, sizes, beta, optimism, best.theta, measures, status)


# -- its parts ----------------------------------------------------------------------------------------


def _seeds(seeds: int | Sequence[int]) -> tuple[int, ...]:
    if not isinstance(seeds, Sequence):
        checks.at_least("seeds", seeds, 1)
        return tuple(range(seeds))
    for seed in seeds:
        checks.at_least("seeds", seed, 0)
    if not seeds:
        raise InputError("seeds", "[]", "at least one")
    return tuple(seeds)


def _sizes(n_tuples: int, n_sizes: int) -> tuple[int, ...]:
    first = min(FIRST_SIZE, n_tuples)
    return tuple(sorted({n_tuples, *np.geomspace(n_tuples, first, n_sizes).round().astype(int).tolist()}))


def _run(
    learner: StreamLearner[Any, Any],
    experience: tuple[TabularMDP, int, int],
    seed: int,
    behaviour_policy: ArrayLike | None,
    prior: np.ndarray,
    sizes: tuple[int, ...],
    best: Optimum,
) -> list[tuple[dict[str, float], Status]]:
    """One learner on one stream, one row per size."""
    mdp, n_episodes, episode_length = experience
    data = collect(mdp, n_episodes, episode_length, seed, behaviour_policy, prior)
    rows = []
    for size in sizes:
        began = time.perf_counter()
        solution = learner.fit(data.first(size), mdp.n_states, mdp.n_actions)
        seconds = time.perf_counter() - began
        rows.append(
            (
                measure(mdp, best, solution, learner.beta, prior, optimism=learner.optimism) | {"seconds": seconds},
                solution.status,
            )
        )
    return rows


def interquartile_mean(values: np.ndarray, axis: int = -1) -> Any:  # a number, or an array
    """Mean of the middle half: a quarter of the values, rounded down, is left out at either end."""
    return scipy.stats.trim_mean(values, 0.25, axis=axis)


def iqm_interval(values: np.ndarray) -> tuple[float, float] | None:
    """95 % interval of the interquartile mean of [n] independent values >= 0; None of fewer than two.

    Student's t with n - 2 floor(n/4) - 1 degrees of freedom and the winsorised deviation (Tukey and McLaughlin 1963),
    cut at 0. Below four values nothing is left out: the interval of the plain mean. Of normal values it holds the truth
    in .93 to .95 of cases for any n, of log-normal ones (deviation 1 of the logarithm) in .91 to .95; resampling, which
    never leaves the range of the values, in .51 of cases for n = 2, .76 for n = 3.
    """
    n, left_out = len(values), len(values) // 4
    used = n - 2 * left_out
    if used < 2:
        return None
    unit = values.max() or 1.0  # squares of the values may leave the range of numbers
    ordered = np.sort(values / unit)
    winsorised = np.clip(ordered, ordered[left_out], ordered[n - left_out - 1])
    error = unit * winsorised.std(ddof=1) * np.sqrt((n - 1) / (used * (used - 1)))
    half = scipy.stats.t.isf((1 - LEVEL) / 2, used - 1) * error
    middle = interquartile_mean(values)
    return max(float(middle - half), 0.0), float(middle + half)


def _statistics(values: np.ndarray) -> dict[str, Any]:
    """mean, iqm and interval of [seeds]; None where a value is not finite."""
    if not np.isfinite(values).all():
        return {"mean": None, "iqm": None, "interval": None}
    interval = iqm_interval(values)
    return {
        "mean": float(values.mean()),
        "iqm": float(interquartile_mean(values)),
        "interval": None if interval is None else list(interval),
    }


def _nullable(values: float | list[Any]) -> float | list[Any] | None:
    if isinstance(values, list):
        return [_nullable(value) for value in values]
    return values if np.isfinite(values) else None


def _number(value: float | None) -> float:
    return np.inf if value is None else value


def _cell(value: float | None) -> str:
    return "-" if value is None else f"{value:.2e}"


FIT_BYTES = 500  # of the figures of one fit


def _learners(cfg: DictConfig, n_states: int, n_actions: int) -> dict[str, Any]:
    """By name, with the settings that are of all."""
    learners = {}
    for name in cfg.learners:
        settings = cfg.learner[name].copy()
        for key in ("beta", "optimism", "prior_policy"):
            if cfg[key] is not None and (key != "optimism" or key in settings):
                settings[key] = cfg[key]
        learners[name] = make_learner(settings, n_states, n_actions, f"learner.{name}")
    return learners


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
    source = make_source(cfg.experience)
    if not isinstance(source, Simulate):
        raise InputError("experience", cfg.experience.name, "simulate: every seed needs a stream of its own")
    if source.save_to is not None:
        raise InputError("experience.save_to", source.save_to, "null: there is one stream per seed")
    if not cfg.learners:
        raise InputError("learners", "[]", "at least one")
    for name in cfg.learners:
        if name not in cfg.learner or not hasattr(learner_class(cfg.learner[name], f"learner.{name}"), "fit"):
            raise InputError("learners", name, " or ".join(n for n in map(str, cfg.learner) if n != name))
    torch.set_num_threads(1)
    if not kernels.compiled_before():
        print(announcement(), file=sys.stderr)
    with collected() as notes, contextlib.closing(make_env(cfg.env)) as env:
        learners = _learners(cfg, *sizes(env))
        first = next(iter(learners.values()))
        prior = first.prior_policy
        if prior is not None:
            prior = check_policy("prior_policy", prior, *sizes(env))
        world = make_world(cfg.env, env, safe_point, first.beta, prior)
    # The start of the stream may be another than that of the episodes; the optimum does not depend on it.
    mdp = world.source if isinstance(world.source, TabularMDP) else world.mdp
    if mdp is None:
        raise InputError("env", cfg.env.name, "one with a known model: gaps are measured against its exact solution")
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
            first.prior_policy,
            cfg.n_sizes,
            cfg.processes,
            report,
        )
    result = {"env": cfg.env.name, **found.summary(), "notes": notes, "seconds": round(time.perf_counter() - began, 1)}
    write_json(directory / "compare.json", result)
    title = f"{cfg.env.name}, {at(found.beta, found.optimism)}: {len(found.seeds)} seeds"
    write_png(directory / "compare.png", pictures.learning_curves(result["sizes"], result["curves"], title))
    print(f"\n{title}, {found.sizes[-1]:,} tuples each, theta* {found.theta:.7f}\n\n{found.table()}")
    print("\ngap: mean over seeds, interquartile mean and its interval (Student's t); other columns: means")
    print(f"tuples: streamed, all passes together\nrun directory  {here(directory)}")
    return result
