"""One run of many replicas, from a configuration to a run directory; Hydra stays outside.

The directory holds the event file, ``result.json`` (statistics a group), ``replicas.npz`` (``ReplicaSolution``, and the
record of every replica), ``bands.png`` and, where settings vary, ``sweep.png``.

A group is a set of replicas with the same settings; its replicas have the seeds seed, seed + 1, ..., and each is the
run that ``train.py`` makes of that seed alone, bit for bit.
"""

from __future__ import annotations

import contextlib
import functools
import itertools
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from omegaconf import DictConfig, OmegaConf
from tqdm import tqdm

from erl_torch import checks, pictures
from erl_torch.checks import InputError
from erl_torch.empirical import reservations
from erl_torch.empirical.reservations import Counted, Reservation
from erl_torch.empirical.uncertainty import Estimate
from erl_torch.evaluation import Judge, evaluate
from erl_torch.experience.collect import COLUMN_BYTES, collect
from erl_torch.experience.recording import check_target, write_experience
from erl_torch.experience.simulation import KEEP_BYTES, TUPLE_BYTES, ReplicaExperience, Simulation
from erl_torch.experience.transitions import Transitions
from erl_torch.files import read_npy, write_json, write_png
from erl_torch.learners import Exact, NonFiniteError
from erl_torch.learners.learner import columns
from erl_torch.learners.replicas import Replicas, ReplicaSolution
from erl_torch.log.tensorboard import Board, hyperparameters, replica_layout
from erl_torch.mdp.from_gymnasium import known_mdp, sizes
from erl_torch.mdp.tabular import TabularMDP, check_policy
from erl_torch.notes import collected, note
from erl_torch.rng import streams
from erl_torch.run.build import (
    SafePoint,
    World,
    check_sizes,
    episode_model,
    make_env,
    make_learner,
    make_world,
    recorded,
)
from erl_torch.run.checkpoint import Checkpoints, Ended, rows_of
from erl_torch.run.judge import SMALL, of_data
from erl_torch.run.report import ended_as, learning_bar, note_rows, plural, versions, where
from erl_torch.solution import Status
from erl_torch.solvers import solve_soft_bellman

QUANTITIES = {
    "theta": "theta, reward a step",
    "rho": "rho",
    "delta_max": "largest reward bias, reward",
    "empirical_width": "bound on the loss in the empirical model, reward a step",
    "reward_per_step": "reward a step",
    "objective": "objective J, reward a step",
    "return": "return of an episode, reward",
}  # what is logged of replicas, as far as there is
FEW = 24  # replicas whose simulated streams are sampled once more, to hold theta against what they say
MOST_LOGGED = 24  # groups with curves of their own; all are in result.json and in the pictures


@dataclass(frozen=True)
class Group:
    """Replicas with the same settings."""

    settings: Mapping[str, float]  # those that vary
    members: slice
    beta: float

    @property
    def name(self) -> str:
        """As a part of tags: ``replicas``, or ``beta_2``."""
        return "-".join(f"{key}_{value:g}" for key, value in self.settings.items()) or "replicas"

    @property
    def title(self) -> str:
        return ", ".join(f"{key} {value:g}" for key, value in self.settings.items())


def train_replicas(cfg: DictConfig, directory: Path, safe_point: SafePoint, saved: Checkpoints) -> dict[str, Any]:
    """Run ``cfg``, which ``erl_torch.run.training.train`` has checked; returns what ``result.json`` holds.

    Raises:
        InputError: a key or value that cannot be used, before anything is learnt or written.
        NonFiniteError: replicas left the finite numbers; everything is written, the others to their end.
    """
    began = time.perf_counter()
    with collected() as notes, contextlib.closing(make_env(cfg.env)) as env:
        world = make_world(cfg.env, env, safe_point)
        n_states, n_actions = sizes(env)
        learner = make_learner(cfg.learner, n_states, n_actions)
        if isinstance(learner, Exact):
            raise InputError("learner", "exact", "one that learns from experience: replicas of it would be the same")
        check_sizes(n_states, n_actions, cfg.n_replicas)
        groups = _groups(cfg)
        check_sizes(n_states, n_actions, cfg.n_replicas * len(groups))
        threads = cfg.threads or os.cpu_count() or 1
        learners = [_with(learner, group.settings) for group in groups for _ in range(cfg.n_replicas)]
        for one in learners[:: cfg.n_replicas]:
            one.init(n_states, n_actions)
        replicas = Replicas(tuple(learners), threads)
        seeds = [cfg.seed + i for _ in groups for i in range(cfg.n_replicas)]
        prior = replicas.prior_policy(n_states, n_actions)
        experience = _experience(cfg, env, world, seeds, n_states, n_actions, prior, safe_point)
        n_experience = max(_lengths(experience))
        judge = _Judges(cfg, env, world, prior, [one.beta for one in learners], seeds, threads)

        asked, data = _reservations(experience, learners, prior, judge.model, cfg.evaluation.certify, safe_point)
        for said in asked:
            note(said)
        exact = _exact(cfg, judge, groups)
        record = _Record(groups, exact)
        stream = None if isinstance(experience, Simulation) else [data.checksum() for data in _recorded(experience)]
        found = saved.start()
        if found and found["digest"] != stream:
            raise InputError("experience", "another stream", "the one that the run in its directory began with")
        stopped: BaseException | None = None
        state: Any = None
        history: list[dict[str, np.ndarray]] = []
        learning = 0.0
        varied = {f"vary.{key}": values for key, values in _plain(cfg.vary).items()}
        settings = hyperparameters(cfg, n_replicas=cfg.n_replicas, n_experience=n_experience, **varied)
        first = {} if found else judge(np.repeat(prior[None], len(replicas), axis=0), True)
        if found:
            state, history, learning = found["state"], rows_of(found["history"]), found["learning"]
            record.restore(found["record"])
            judge.restore(found["evaluation"])
            began -= found["seconds"]
        logged = [*learners[0].init(n_states, n_actions).metrics(), *first]
        boards = replica_layout({g.name: known for g, known in zip(groups[:MOST_LOGGED], exact, strict=False)}, logged)
        mark = found["events"] if found else None
        solution: ReplicaSolution | None = None
        ended = Ended(lambda: solution is not None)
        with ended, saved.refusing(lambda: bool(history)), Board(directory, settings, boards, mark) as board:
            if not found:
                board.texts(cfg)
                record.add(0, first, board)

            def snapshot() -> dict[str, Any]:
                return {
                    "state": state,
                    "history": columns(history),
                    "record": record.content(),
                    "evaluation": judge.generators(),
                    "events": board.flush(),
                    "learning": learning,
                    "seconds": time.perf_counter() - began,
                    "digest": stream,
                }

            def complete() -> dict[str, Any]:
                """As of ``erl_torch.run.training.train``; the record's rows are counted, and cut on return."""
                return {
                    "state": state,
                    "evaluation": judge.generators(),
                    "events": board.mark(),
                    "learning": learning,
                    "n": (len(history), record.lengths()),
                }

            passes = getattr(learner, "n_bias", 1) * getattr(learner, "n_epochs", 1)
            reached = complete()
            try:
                with learning_bar(passes * n_experience * len(replicas), "tuples") as bar:
                    bar.update(int(history[-1]["n_tuples"].sum()) if history else 0)
                    tick = time.perf_counter()
                    goes_on_from = state
                    for state in replicas.iterate(experience, n_states, n_actions, goes_on_from):
                        learning += time.perf_counter() - tick
                        metrics = state.metrics()
                        milestone = _milestone(learner, metrics, history)
                        history.append(metrics)
                        bar.update(int(metrics["n_tuples"].sum()) - bar.n)
                        if milestone or len(history) % cfg.evaluation.every == 0:
                            measured = metrics | judge(state.policy.numpy(), bool(milestone))
                            alive = np.array([r not in state.failures for r in range(len(replicas))])
                            record.add(state.n_tuples, measured, board, alive)
                            if milestone:
                                tqdm.write(f"{milestone}: {record.line()}", file=sys.stderr)
                        reached = complete()
                        saved.offer(state.n_tuples, snapshot)
                        safe_point()
                        tick = time.perf_counter()
            except (Exception, KeyboardInterrupt, SystemExit) as error:
                stopped, state = error, reached["state"]
                del history[reached["n"][0] :]
                record.cut(reached["n"][1])
                if state is None or (not history and isinstance(error, Exception)):
                    raise  # nothing is learnt
                if history:
                    ended.keep(saved, state.n_tuples, lambda: snapshot() | reached)
            solution = replicas.solution(state, history)
            done = int(history[-1]["n_tuples"].sum())
            each = " of each setting" if len(groups) > 1 else ""
            title = f"{cfg.env.name}, {cfg.learner.name}: {plural(cfg.n_replicas, 'replica')}{each}"
            drawn = [("bands", record.curves(exact), "tuples streamed, each replica", title)]
            if cfg.vary:
                key, panels = _sweep(groups, record, exact)
                drawn.append(("sweep", panels, key, f"{title}, at the end"))
            for name, panels, x_label, heading in drawn:
                markers = name == "sweep"
                whole = pictures.bands({QUANTITIES[k]: v for k, v in panels.items()}, x_label, heading, markers)
                write_png(directory / f"{name}.png", whole)
                for k, lines in panels.items():  # on TensorBoard's small cards one panel can be read
                    card = pictures.bands({QUANTITIES[k]: lines}, x_label, heading, markers, card=True)
                    board.picture(f"{name}/{k}", card, state.n_tuples)
            board.scalars({"time/tuples_per_second": done / max(learning, 1e-9)}, state.n_tuples)
            board.scalars(_final(groups, record, exact), state.n_tuples)
            for said in reservations.of_replicas(record.outcomes(solution, data, judge.model is not None)):
                note(said)
            if solution.failures:
                board.failed()

    stopped = stopped or ended.error
    assert solution is not None
    solution.save(directory / "replicas.npz", record.arrays() | {"seed": np.array(seeds), **_columns(groups)})
    objectives = [record.statistics(group).get("objective") for group in groups]
    result = {
        "env": cfg.env.name,
        "learner": cfg.learner.name,
        "seed": cfg.seed,
        "n_replicas": cfg.n_replicas,
        "vary": _plain(cfg.vary),
        "status": Status.STOPPED.name.lower() if stopped else _status(solution),
        "message": f"{type(stopped).__name__}: {stopped}" if isinstance(stopped, Exception) else "",
        "failures": {str(r): str(error) for r, error in solution.failures.items()},
        "objective": max((found["mean"] for found in objectives if found), default=None),  # of the best group
        "groups": [
            {
                "settings": dict(group.settings),
                "beta": group.beta,
                "exact": best,
                **record.statistics(group),
            }
            for group, best in zip(groups, exact, strict=True)
        ],
        "data_half_widths": _half_widths(solution, data),
        "n_experience": n_experience,
        "n_tuples": done,
        "seconds_learning": round(learning, 3),
        "seconds": round(time.perf_counter() - began, 3),
        "versions": versions(),
        "notes": notes,
    }
    write_json(directory / "result.json", result)
    print(_summary(cfg, groups, result, directory))
    if stopped is not None:
        raise stopped
    saved.clear()
    if solution.failures:
        raise _as_one(solution.failures, seeds, learners)
    return result


# -- from configuration to objects ------------------------------------------------------------------


def _groups(cfg: DictConfig) -> list[Group]:
    """Every combination of the values that vary, in the order of the configuration."""
    columns = {}
    for key, values in _plain(cfg.vary).items():
        column = values if isinstance(values, list) else [values]
        if key not in cfg.learner or key in ("name", "prior_policy"):
            able = ", ".join(k for k in map(str, cfg.learner) if k not in ("name", "prior_policy"))
            raise InputError(f"vary.{key}", values, f"left out: the settings of the learner are {able}")
        if not column or not all(checks.is_number(value) for value in column):
            raise InputError(f"vary.{key}", values, "a list of numbers")
        if any(abs(value) > checks.MOST for value in column if isinstance(value, int)):
            raise InputError(f"vary.{key}", values, "whole numbers below 2**63")
        columns[key] = column
    found = []
    for i, values in enumerate(itertools.product(*columns.values())):
        settings = dict(zip(columns, values, strict=True))
        members = slice(i * cfg.n_replicas, (i + 1) * cfg.n_replicas)
        found.append(Group(settings, members, float(settings.get("beta", cfg.learner.beta))))
    return found


def _plain(node: DictConfig) -> dict[str, Any]:
    found: Any = OmegaConf.to_container(node)
    return {str(key): value for key, value in found.items()}


def _with(learner: Any, settings: Mapping[str, float]) -> Any:
    try:
        return replace(learner, **settings)
    except InputError as error:
        raise error.within("vary") from error


def _experience(
    cfg: DictConfig,
    env: gym.Env[Any, Any],
    world: World,
    seeds: list[int],
    n_states: int,
    n_actions: int,
    prior: np.ndarray,
    safe_point: SafePoint,
) -> ReplicaExperience:
    shared = cfg.shared_stream or cfg.experience.name == "recorded"
    if shared and cfg.n_replicas > 1:
        said = "1: on one stream, replicas with the same settings would be the same (let settings vary, vary.KEY=[...])"
        raise InputError("n_replicas", cfg.n_replicas, said)
    if cfg.experience.name == "recorded":
        found = recorded(cfg.experience, env, n_states, n_actions, cfg.seed, prior, safe_point)
        if len(found) * 24 > KEEP_BYTES:
            allowed = f"of at most {KEEP_BYTES // 24:,} tuples, as replicas hold them in memory: it has {len(found):,}"
            raise InputError("experience.path", found.path, allowed)
        return found.load()
    e = cfg.experience
    if e.save_to is not None and not shared:
        raise InputError("experience.save_to", e.save_to, "null: there is a stream a replica (or shared_stream=true)")
    behaviour = None if e.behaviour_policy is None else read_npy(e.behaviour_policy, "experience.behaviour_policy")
    if shared:
        if e.save_to is not None:
            check_target("experience.save_to", e.save_to)
        data = collect(world.source, e.n_episodes, e.episode_length, cfg.seed, behaviour, prior)
        if e.save_to is not None:
            check_target("experience.save_to", e.save_to)
            write_experience(data, e.save_to) if e.save_to.endswith("/") else data.save(e.save_to)
        return data
    mdp = known_mdp(world.source)
    if mdp is not None:
        if cfg.keep_tuples:
            held = TUPLE_BYTES * len(seeds) * e.n_episodes * e.episode_length
            checks.memory("keep_tuples", "true", held, f"the tuples of {len(seeds):,} replicas")
        return Simulation(mdp, e.n_episodes, e.episode_length, seeds, behaviour, cfg.keep_tuples)
    made: dict[int, Transitions] = {}
    for seed in tqdm(sorted(set(seeds)), desc="collecting", unit=" streams", delay=1, leave=False, disable=None):
        made[seed] = collect(world.source, e.n_episodes, e.episode_length, seed, behaviour, prior)
        safe_point()
    return [made[seed] for seed in seeds]


def _recorded(experience: Transitions | Sequence[Transitions]) -> Sequence[Transitions]:
    return [experience] if isinstance(experience, Transitions) else experience


def _lengths(experience: ReplicaExperience) -> list[int]:
    if isinstance(experience, Simulation):
        return [experience.n_tuples]
    return [len(data) for data in _recorded(experience)]


class _Judges:
    """Figures of the policies of all replicas: exact ones of the model, and episodes played at milestones."""

    def __init__(
        self,
        cfg: DictConfig,
        env: gym.Env[Any, Any],
        world: World,
        prior: np.ndarray,
        betas: list[float],
        seeds: list[int],
        threads: int,
    ) -> None:
        e = cfg.evaluation
        self.env, self.prior, self.betas, self.n_episodes = env, prior, betas, e.n_episodes
        self.rngs = [streams(seed).evaluation for seed in seeds]
        self.horizon = min(e.horizon, (env.spec and env.spec.max_episode_steps) or e.horizon)
        self.threads = threads
        self.model: TabularMDP | None = world.mdp
        if world.mdp is not None and world.mdp.transition.nnz > e.exact_up_to:
            self.model = None
            note("a large model (evaluation.exact_up_to): episodes are played instead")
        self.episode = None if self.model is None else episode_model(env, world)

    def generators(self) -> list[Any]:
        """States of the generators that play episodes."""
        return [rng.bit_generator.state for rng in self.rngs]

    def restore(self, states: list[Any]) -> None:
        """Set the generators to ``states``."""
        for rng, state in zip(self.rngs, states, strict=True):
            rng.bit_generator.state = state

    @functools.cached_property
    def of_model(self) -> Judge:
        """Of the model that there is."""
        assert self.model is not None
        return Judge(self.model, self.prior, self.horizon)

    @functools.cached_property
    def of_episode(self) -> Judge:
        """Of the episodes' model that there is."""
        assert self.episode is not None
        return self.of_model if self.episode is self.model else Judge(self.episode, self.prior, self.horizon)

    def __call__(self, policies: np.ndarray, milestone: bool) -> dict[str, np.ndarray]:
        """Figures of policies [R, S, A], [R] each."""
        found: dict[str, np.ndarray] = {}

        def each(figure: Callable[[int], float]) -> np.ndarray:
            with ThreadPoolExecutor(self.threads) as pool:
                return np.array(list(pool.map(figure, range(len(policies)))))

        if self.model is not None:
            found["reward_per_step"] = each(lambda r: self.of_model.reward_per_step(policies[r]))
            found["objective"] = each(lambda r: self.of_model.objective(policies[r], self.betas[r]))
        if self.episode is not None:
            if self.episode is self.model:
                found["return"] = self.horizon * found["reward_per_step"]
            else:
                found["return"] = self.horizon * each(lambda r: self.of_episode.reward_per_step(policies[r]))
        elif milestone:
            played = [
                evaluate(self.env, policy, beta, rng, self.n_episodes, self.horizon, self.prior)
                for policy, beta, rng in zip(policies, self.betas, self.rngs, strict=True)
            ]
            found["return"] = np.array([figures.mean_return for figures in played])
            if self.model is None:
                found["reward_per_step"] = np.array([figures.reward_per_step for figures in played])
                found["objective"] = np.array([figures.objective for figures in played])
        return found


class Data(NamedTuple):
    """What theta is held against once it is learnt."""

    rewards: tuple[float, float]  # (low, high)
    estimate: Estimate | None


def _reservations(
    experience: ReplicaExperience,
    learners: list[Any],
    prior: np.ndarray,
    model: TabularMDP | None,
    certify: bool,
    safe_point: SafePoint,
) -> tuple[list[str], list[Data]]:
    """(notes on what streams do not allow the learners, what theta is to be held against); each stream is read once.
    Theta is not held against the model's."""
    shape = prior.shape

    def data_of(here: Counted, learner: Any) -> Data:
        return Data(here.tally.reward_range, of_data(here.model, learner.beta, prior) if certify else None)

    if isinstance(experience, Simulation):  # of the model itself: it is not held against the model
        behaviour = experience.behaviour_policy
        rewards = float(experience.mdp.reward.min()), float(experience.mdp.reward.max())
        own = reservations.of_rewards(*rewards)
        if learners[0].drawn_from_prior == "a" and behaviour is not None:
            table = check_policy("experience.behaviour_policy", behaviour, prior.shape[0], prior.shape[1])
            draws = np.rint(experience.n_tuples * table / len(table))  # as if it were in all states alike
            own += reservations.of_actions(draws, prior, "a")
        held = [Data(rewards, None)] * len(learners)
        few = len(learners) <= FEW and experience.n_tuples * COLUMN_BYTES <= KEEP_BYTES
        if certify and few and experience.mdp.n_states <= SMALL:
            same: dict[int, list[int]] = {}
            for r, seed in enumerate(experience.seeds):
                same.setdefault(int(seed), []).append(r)
            for members in same.values():
                safe_point()
                here = reservations.count(experience.stream(members[0], prior), shape[0], shape[1], False)
                for r in members:
                    held[r] = data_of(here, learners[r])
        return reservations.of_replicas([own] * len(learners)), held
    next_actions = any(learner.drawn_from_prior == "a_next" for learner in learners)
    streams_of = [experience] * len(learners) if isinstance(experience, Transitions) else experience
    counted: dict[int, Counted] = {}
    found: list[list[Reservation]] = []
    held = []
    for learner, data in zip(learners, streams_of, strict=True):
        if id(data) not in counted:
            counted[id(data)] = reservations.count(data, shape[0], shape[1], next_actions)
        here = counted[id(data)]
        against = (
            [] if model is None else reservations.of_model(here, model) + reservations.of_states(here.tally, model)
        )
        found.append(reservations.of_stream(here, learner, prior) + against)
        held.append(data_of(here, learner))
    return reservations.of_replicas(found), held


def _half_widths(solution: ReplicaSolution, data: list[Data]) -> dict[str, float] | None:
    """Statistics of how far each theta is from what its own stream says; None where no stream has an interval."""
    away = [reservations.half_widths(one.theta, d.estimate) for one, d in zip(solution.solutions, data, strict=True)]
    finite = np.array([x for x in away if np.isfinite(x)])
    return statistics(finite) | {"replicas": len(finite)} if finite.size else None


def _exact(cfg: DictConfig, judges: _Judges, groups: list[Group]) -> list[dict[str, float]]:
    """What is known of the optimum of each group, by quantity: of a small known model."""
    model = judges.model
    if model is None or not cfg.evaluation.certify or model.n_states > SMALL:
        return [{} for _ in groups]
    known: dict[float, dict[str, float]] = {}
    for beta in {group.beta for group in groups}:
        best = solve_soft_bellman(model, beta, judges.prior)
        known[beta] = {}
        if best.status is Status.CONVERGED and best.theta is not None:
            policy = best.policy.numpy()
            known[beta] = {"theta": best.theta, "delta_max": best.reward_bias_max, "objective": -best.theta}
            known[beta]["reward_per_step"] = judges.of_model.reward_per_step(policy)
            if judges.episode is not None:
                known[beta]["return"] = judges.horizon * judges.of_episode.reward_per_step(policy)
    return [known[group.beta] for group in groups]


def _milestone(learner: Any, metrics: Mapping[str, np.ndarray], before: list[dict[str, np.ndarray]]) -> str:
    """What has come to its end in some replica just now, or nothing."""
    now = metrics["n_tuples"] > (before[-1]["n_tuples"] if before else 0)
    ends = now & (metrics["epoch"] >= getattr(learner, "n_epochs", 1))
    if not ends.any():
        return ""
    return f"biasing iteration {metrics['bias_iteration'][ends].max()}" if "bias_iteration" in metrics else "last pass"


def _status(solution: ReplicaSolution) -> str:
    """The one that asks for most: what ended badly comes first."""
    found = {s.status for s in solution.solutions}
    for status in (Status.NON_FINITE, Status.STOPPED, Status.PSI_LIMIT, Status.STEP_LIMIT):
        if status in found:
            return status.name.lower()
    return sorted(status.name for status in found)[0].lower()


def _as_one(failures: Mapping[int, NonFiniteError], seeds: list[int], learners: list[Any]) -> NonFiniteError:
    r, error = min(failures.items())
    others = f" ({len(failures)} of {len(seeds)} replicas ended so)" if len(failures) > 1 else ""
    cause = f"replica {r} (seed {seeds[r]}, beta {learners[r].beta:g}): {error.cause}{others}"
    return NonFiniteError(error.step, cause)


# -- what is recorded and shown -----------------------------------------------------------------------


def statistics(values: np.ndarray) -> dict[str, float]:
    """mean, quartiles and extremes of [n] finite values."""
    low, middle, high = np.quantile(values, (0.25, 0.5, 0.75))
    return {
        "mean": float(values.mean()),
        "q25": float(low),
        "median": float(middle),
        "q75": float(high),
        "min": float(values.min()),
        "max": float(values.max()),
    }


class _Record:
    """Figures of all replicas, record by record."""

    def __init__(self, groups: list[Group], exact: list[dict[str, float]]) -> None:
        self.groups, self.exact = groups, exact
        self.prior: dict[str, float] = {}  # by tag
        self.steps: dict[str, list[int]] = {}
        self.rows: dict[str, list[np.ndarray]] = {}
        self.alive: dict[str, list[np.ndarray]] = {}

    def content(self) -> tuple[Any, ...]:
        """What a checkpoint keeps."""
        return self.prior, self.steps, *({k: np.stack(v) for k, v in x.items()} for x in (self.rows, self.alive))

    def lengths(self) -> dict[str, int]:
        """Records so far, by quantity."""
        return {name: len(steps) for name, steps in self.steps.items()}

    def cut(self, lengths: Mapping[str, int]) -> None:
        """Back to what it was at ``lengths``."""
        for of_names in (self.steps, self.rows, self.alive):
            for name in list(of_names):
                if name in lengths:
                    del of_names[name][lengths[name] :]
                else:
                    del of_names[name]

    def restore(self, content: tuple[Any, ...]) -> None:
        """Go on from ``content``."""
        self.prior, self.steps = content[:2]
        self.rows, self.alive = ({name: list(column) for name, column in x.items()} for x in content[2:])

    def add(self, step: int, measured: Mapping[str, np.ndarray], board: Board, alive: np.ndarray | None = None) -> None:
        for name in QUANTITIES:
            if name not in measured:
                continue
            values = np.asarray(measured[name], dtype=np.float64)
            good = np.isfinite(values) if alive is None else alive & np.isfinite(values)
            self.steps.setdefault(name, []).append(step)
            self.rows.setdefault(name, []).append(values)
            self.alive.setdefault(name, []).append(good)
            for group, known in zip(self.groups[:MOST_LOGGED], self.exact, strict=False):
                inside = values[group.members][good[group.members]]
                if not inside.size:
                    continue
                found, tag = statistics(inside), f"{group.name}/{name}"
                if step == 0:
                    self.prior[tag] = found["mean"]
                lines = {"prior": self.prior.get(tag), "optimal": known.get(name)}
                board.scalars({f"{tag}_{key}": found[key] for key in LOGGED}, step)
                board.scalars({f"{tag}_{key}": value for key, value in lines.items() if value is not None}, step)

    def statistics(self, group: Group) -> dict[str, Any]:
        """Of the last record: statistics by quantity, replicas that count."""
        found: dict[str, Any] = {"replicas": 0}
        for name, rows in self.rows.items():
            inside = rows[-1][group.members][self.alive[name][-1][group.members]]
            found[name] = statistics(inside) if inside.size else None
            found["replicas"] = max(found["replicas"], int(inside.size))
        return found

    def outcomes(self, solution: ReplicaSolution, data: list[Data], exact: bool) -> list[list[Reservation]]:
        """How each replica ended, and what its theta shows; ``exact``: the objectives are."""
        rows = self.rows["objective"] if exact else [np.full(len(solution), np.nan)]
        return [
            reservations.of_outcome(one.status, one.message, float(learnt), float(prior))
            + reservations.of_theta(one.theta, *against)
            for one, learnt, prior, against in zip(solution.solutions, rows[-1], rows[0], data, strict=True)
        ]

    def curves(self, exact: list[dict[str, float]]) -> dict[str, list[pictures.BandLine]]:
        """For ``pictures.bands``: quantity -> a line a group."""
        shown: dict[str, list[pictures.BandLine]] = {}
        for name in ("theta", "delta_max", "reward_per_step", "objective", "return"):
            if name not in self.rows or (name == "return" and "reward_per_step" in self.rows):
                continue
            lines = []
            for group, known in zip(self.groups[:MOST_LOGGED], exact, strict=False):
                points = [
                    (step, statistics(row[group.members][good[group.members]]))
                    for step, row, good in zip(self.steps[name], self.rows[name], self.alive[name], strict=True)
                    if good[group.members].any()
                ]
                steps, found = zip(*points, strict=True) if points else ((), ())
                lines.append(pictures.BandLine(group.title, steps, found, [known.get(name)] * len(steps)))
            shown[name] = lines
        return shown

    def line(self) -> str:
        """The last record in a line, over all replicas of the first group."""
        shown = []
        for name in ("theta", "delta_max", "reward_per_step", "objective"):
            found = self.statistics(self.groups[0]).get(name)
            if found:
                shown.append(f"{name} {found['mean']:.5g} [{found['q25']:.5g}, {found['q75']:.5g}]")
        more = f"  (first of {len(self.groups)} groups)" if len(self.groups) > 1 else ""
        return "  ".join(shown) + more

    def arrays(self) -> dict[str, np.ndarray]:
        """``record/NAME`` [n, R] with ``record_step/NAME`` [n]."""
        found = {f"record/{name}": np.stack(rows) for name, rows in self.rows.items()}
        return found | {f"record_step/{name}": np.array(steps) for name, steps in self.steps.items()}


def _final(groups: list[Group], record: _Record, exact: list[dict[str, float]]) -> dict[str, float]:
    """Means over the replicas of the group with the best objective, by tag."""
    found = [record.statistics(group) for group in groups]
    able = [g for g in range(len(groups)) if found[g].get("objective")]
    if not able:
        return {}
    best = max(able, key=lambda g: found[g]["objective"]["mean"])
    names = ("theta", "objective", "reward_per_step", "return")
    final = {name: found[best][name]["mean"] for name in names if found[best].get(name)}
    if "objective" in exact[best]:
        final["gap"] = exact[best]["objective"] - final["objective"]
    return {f"Final/{name}": value for name, value in final.items()}


LOGGED = ("mean", "median", "q25", "q75", "min", "max")


def _columns(groups: list[Group]) -> dict[str, np.ndarray]:
    n = sum(group.members.stop - group.members.start for group in groups)
    keys = groups[0].settings
    columns = {f"vary/{key}": np.empty(n) for key in keys}
    for group in groups:
        for key, value in group.settings.items():
            columns[f"vary/{key}"][group.members] = value
    return columns


def _sweep(
    groups: list[Group], record: _Record, exact: list[dict[str, float]]
) -> tuple[str, dict[str, list[pictures.BandLine]]]:
    """The first setting that varies, and quantity -> a line for each combination of the others."""
    key = next(iter(groups[0].settings))
    panels: dict[str, list[pictures.BandLine]] = {}
    for name in ("theta", "objective", "delta_max"):
        points: dict[str, list[tuple[float, dict[str, float], float | None]]] = {}
        for group, known in sorted(zip(groups, exact, strict=True), key=lambda pair: pair[0].settings[key]):
            found = record.statistics(group).get(name)
            if found is not None:
                rest = ", ".join(f"{k} {v:g}" for k, v in group.settings.items() if k != key)
                points.setdefault(rest, []).append((group.settings[key], found, known.get(name)))
        if points:
            panels[name] = [pictures.BandLine(rest, *zip(*row, strict=True)) for rest, row in points.items()]
    return key, panels


def _summary(cfg: DictConfig, groups: list[Group], result: Mapping[str, Any], directory: Path) -> str:
    first = f"{cfg.env.name}, {cfg.learner.name}"
    last_seed = cfg.seed + cfg.n_replicas - 1
    seeds = f"seed {cfg.seed}" if cfg.n_replicas == 1 else f"seeds {cfg.seed} to {last_seed}"
    solved = cfg.n_replicas * len(groups)
    lines = [
        "",
        *(_one_group(first, seeds, result) if len(groups) == 1 else _many_groups(first, seeds, groups, result)),
    ]
    if (away := result["data_half_widths"]) is not None:
        lines.append(
            f"{'the data say':18}theta is off by {away['median']:.3g} half widths of the 95% interval of its own "
            f"stream (median; at most {away['max']:.3g}; {away['replicas']} of {solved} streams have one)"
        )
    rate = result["n_tuples"] / max(result["seconds_learning"], 1e-3) / 1e6
    shown, logs = where(directory)
    lines += [
        f"{'tuples streamed':18}{result['n_tuples']:,} ({rate:.3g} M/s)",
        f"{'seconds':18}{result['seconds']:.1f}, of which {result['seconds_learning']:.1f} learning",
        f"{'run directory':18}{shown}",
        f"{'look at it':18}tensorboard --logdir {logs}",
    ]
    lines += note_rows(result)
    return "\n".join(lines)


def _one_group(first: str, seeds: str, result: Mapping[str, Any]) -> Iterator[str]:
    (group,) = result["groups"]
    yield f"{first}, beta {group['beta']:g}, {plural(result['n_replicas'], 'replica')} ({seeds}): {ended_as(result)}"
    yield f"{'':18}{'mean':>12}{'quartiles':>26}{'extremes':>26}{'exact':>12}"
    for name in QUANTITIES:
        found = group.get(name)
        if found:
            quartiles = f"{found['q25']:.5g} to {found['q75']:.5g}"
            extremes = f"{found['min']:.5g} to {found['max']:.5g}"
            known = f"{group['exact'][name]:12.6g}" if name in group["exact"] else ""
            yield f"{name.replace('_', ' '):18}{found['mean']:12.6g}{quartiles:>26}{extremes:>26}{known}"


def _many_groups(first: str, seeds: str, groups: list[Group], result: Mapping[str, Any]) -> Iterator[str]:
    yield f"{first}, {len(groups)} settings, {seeds} each: {ended_as(result)}"
    width = max(len(group.title) for group in groups) + 2
    yield f"{'':{width}}{'theta':>11}{'quartiles':>24}{'exact':>11}{'objective':>12}{'at most':>11}"
    shown = result["groups"] if len(groups) <= 40 else [*result["groups"][:20], None, *result["groups"][-19:]]
    for found in shown:
        if found is None:
            yield "..."
            continue
        theta, objective, best = found.get("theta"), found.get("objective"), found["exact"]
        title = ", ".join(f"{key} {value:g}" for key, value in found["settings"].items())
        cells = [
            f"{theta['mean']:.6g}" if theta else "-",
            f"{theta['q25']:.5g} to {theta['q75']:.5g}" if theta else "-",
            f"{best['theta']:.6g}" if best else "-",
            f"{objective['mean']:.6g}" if objective else "-",
            f"{best['objective']:.6g}" if best else "-",
        ]
        widths = (11, 24, 11, 12, 11)
        yield f"{title:{width}}" + "".join(f"{cell:>{w}}" for cell, w in zip(cells, widths, strict=True))
