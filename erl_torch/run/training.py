"""One training run, from a configuration to a run directory; Hydra stays outside.

A run directory holds the event file, ``result.json`` and ``solution.npz`` (and Hydra's ``.hydra/``).
"""

from __future__ import annotations

import contextlib
import functools
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from omegaconf import DictConfig, OmegaConf
from tqdm import tqdm

from erl_torch import checks
from erl_torch.checks import InputError
from erl_torch.empirical import reservations
from erl_torch.empirical.reservations import Reservation
from erl_torch.empirical.uncertainty import Estimate
from erl_torch.evaluation import Evaluation, evaluate
from erl_torch.files import write_json
from erl_torch.learners import Exact, ExactState, NonFiniteError, S1State
from erl_torch.learners.learner import columns
from erl_torch.learners.s1 import kernels
from erl_torch.log.tensorboard import Board, hyperparameters, layout
from erl_torch.mdp.from_gymnasium import sizes
from erl_torch.mdp.tabular import TabularMDP, check_policy
from erl_torch.notes import collected, note
from erl_torch.problem import Problem
from erl_torch.rng import Streams, streams
from erl_torch.run.build import (
    SafePoint,
    World,
    check_evaluation,
    episode_model,
    make_env,
    make_experience,
    make_learner,
    make_source,
    make_world,
)
from erl_torch.run.checkpoint import Checkpoints, Ended, rows_of
from erl_torch.run.judge import of_data
from erl_torch.run.replicated import train_replicas
from erl_torch.run.report import (
    Drawer,
    Stopwatch,
    data_tags,
    evaluation_tags,
    learning_bar,
    mean_return,
    optimal_tags,
    result_of,
    say,
    summary,
)
from erl_torch.run.settings import check_keys
from erl_torch.solution import Solution, proven
from erl_torch.solvers import certify, solve_soft_bellman


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
    checks.at_least("n_replicas", cfg.n_replicas, 1)
    checks.at_least("seed + n_replicas", cfg.seed + cfg.n_replicas, 1)  # seeds count on from the first
    if cfg.threads is not None:
        checks.workers("threads", cfg.threads)
    if cfg.checkpoint_every is not None and not cfg.checkpoint_every >= 0:
        raise InputError("checkpoint_every", cfg.checkpoint_every, "seconds >= 0, or null")
    many = cfg.n_replicas > 1 or cfg.vary
    torch.set_num_threads(1 if many else cfg.threads or 1)
    if not kernels.compiled_before():
        print("compiling the loops, about ten seconds: on the first run only", file=sys.stderr)
    check_evaluation(cfg.evaluation)
    settings: Any = OmegaConf.to_container(cfg, resolve=True)
    saved = Checkpoints(directory, settings, cfg.checkpoint_every, "cpu" if many else cfg.learner.get("device", "cpu"))
    if (result := saved.result()) is not None:
        print(f"note: the run in {directory} is complete", file=sys.stderr)
        saved.clear()
        return result
    if many:
        return train_replicas(cfg, directory, safe_point, saved)
    for key in ("shared_stream", "keep_tuples"):
        if cfg[key]:
            raise InputError(key, cfg[key], "left out, or used with n_replicas > 1 or vary.KEY=[...]")
    rng = streams(cfg.seed)
    with collected() as notes, contextlib.closing(make_env(cfg.env)) as env:
        world = make_world(cfg.env, env, safe_point)
        judge = world.mdp
        if judge is not None and judge.transition.nnz > cfg.evaluation.exact_up_to:
            judge = None
            note("a large model (evaluation.exact_up_to): episodes are played instead")
        n_states, n_actions = sizes(env)
        learner = make_learner(cfg.learner, n_states, n_actions)
        prior = check_policy("learner.prior_policy", learner.prior_policy, n_states, n_actions)
        run = (_Solving if isinstance(learner, Exact) else _Learning)(cfg, env, world, learner, rng, prior, safe_point)

        e = cfg.evaluation
        horizon = min(e.horizon, (env.spec and env.spec.max_episode_steps) or e.horizon)

        def measure(policy: torch.Tensor) -> Evaluation:
            exact = None if world.episode is None else functools.partial(mean_return, world.episode, horizon)
            return evaluate(env, policy, learner.beta, rng.evaluation, e.n_episodes, horizon, prior, judge, exact)

        start = state = learner.init(n_states, n_actions)
        history: list[dict[str, float]] = []
        stopped: BaseException | None = None
        clock = Stopwatch()
        best = run.optimum(judge, prior) if e.certify else None
        estimate = run.uncertainty(prior) if e.certify else None
        episode = episode_model(env, world)
        for _, text in run.reservations(prior, judge, estimate, None if best is None else best.theta_bounds):
            note(text)
        found = run.check(saved.start())
        if found:
            state, first, last = (found[key] for key in ("state", "first", "last"))
            history = rows_of(found["history"])
            rng.evaluation.bit_generator.state = found["evaluation"]
            clock.seconds, began = found["learning"], began - found["seconds"]
        else:
            first = last = measure(state.policy)
        lines = evaluation_tags(first, "prior") | optimal_tags(best, judge, episode, horizon) | data_tags(estimate)
        boards = layout([*run.names(start), *evaluation_tags(first)], lines)
        settings = hyperparameters(cfg, n_experience=run.n_experience)
        mark = found["events"] if found else None
        solution: Solution | None = None
        ended = Ended(lambda: solution is not None)
        with ended, saved.refusing(lambda: bool(history)), Board(directory, settings, boards, mark) as board:
            board.lines(lines)
            drawer = Drawer(board, getattr(env.unwrapped, "grid", None)) if cfg.evaluation.pictures else None
            if not found:
                board.texts(cfg)
                board.record(run.tags(state, first), 0)
                if drawer:
                    drawer.policy(state, 0, "prior policy")

            def snapshot() -> dict[str, Any]:
                return {
                    "state": state,
                    "history": columns(history),
                    "first": first,
                    "last": last,
                    "evaluation": rng.evaluation.bit_generator.state,
                    "events": board.flush(),
                    "learning": clock.seconds,
                    "seconds": time.perf_counter() - began,
                    "digest": run.digest,
                }

            def complete() -> dict[str, Any]:
                """What an epoch left when all was done that belongs to it: an error may come in the midst of that."""
                now = {"state": state, "first": first, "last": last, "events": board.mark(), "n": len(history)}
                return now | {"evaluation": rng.evaluation.bit_generator.state, "learning": clock.seconds}

            reached = complete()
            # Whatever ends the loop, what was learnt until then is written below.
            try:
                with run.bar() as bar:
                    bar.update(run.step(state))
                    goes_on_from = state if found else None
                    for state in clock.time(run.states(goes_on_from)):
                        history.append(state.metrics())
                        step, milestone = run.step(state), run.milestone(state)
                        if milestone or len(history) % cfg.evaluation.every == 0:
                            last = measure(state.policy)
                            board.record(run.tags(state, last), step)
                        if milestone and drawer:
                            drawer.policy(state, step, f"policy, {milestone}")
                        if milestone and drawer and hasattr(state, "reward_bias"):
                            drawer.bias(state, step, f"reward bias, {milestone}")
                        bar.set_postfix_str(run.postfix(state), refresh=False)
                        bar.update(step - bar.n)
                        if milestone:
                            say(milestone, state, last)
                        reached = complete()
                        if run.digest is not None:
                            saved.offer(step, snapshot)
                        safe_point()
            except (Exception, KeyboardInterrupt, SystemExit) as error:
                stopped = error
                state, last = reached["state"], reached["last"]
                del history[reached["n"] :]
                if not history and not isinstance(error, (NonFiniteError, KeyboardInterrupt, SystemExit)):
                    raise  # nothing is learnt
                if run.digest is not None and history and not isinstance(error, NonFiniteError):
                    ended.keep(saved, run.step(state), lambda: snapshot() | {**reached, "history": columns(history)})
            solution = run.solution(state, history, stopped)
            if isinstance(stopped, Exception) and not isinstance(stopped, NonFiniteError):
                solution = replace(solution, message=f"{type(stopped).__name__}: {stopped}")
            if best is not None:
                assert judge is not None
                solution = certify(solution, judge, learner.beta, prior, best)
            else:
                for step in (0, run.step(state)):
                    board.scalars(optimal_tags(solution, judge, episode, horizon), step)
            exact = (last.objective, first.objective) if judge is not None else (np.nan, np.nan)
            ended_so = reservations.of_outcome(solution.status, solution.message, *exact)
            for _, text in ended_so + run.outcome(solution.theta, estimate):
                note(text)
            rate = run.step(state) / max(clock.seconds, 1e-9)
            board.scalars({f"time/{run.unit}_per_second": rate}, run.step(state))
            final = {"theta": solution.theta, "gap": solution.gap}
            known = {f"Final/{name}": value for name, value in final.items() if value is not None}
            board.scalars(evaluation_tags(last, "Final") | known, run.step(state))
            if isinstance(stopped, NonFiniteError):
                board.failed()

    stopped = stopped or ended.error
    assert solution is not None
    solution.save(directory / "solution.npz")
    seconds = time.perf_counter() - began
    result = result_of(cfg, solution, last, run.n_experience, clock.seconds, seconds)
    if estimate is not None:
        result["data"] = f"nothing: {estimate.withheld}" if np.isnan(estimate.value) else str(estimate)
    else:
        result["data"] = None
    result["data_smallest_visits"] = None if estimate is None or estimate.withheld else estimate.smallest_visits
    away = reservations.half_widths(solution.theta, estimate)
    result["data_states"] = None if estimate is None else run.states_met
    result["data_half_widths"] = away if np.isfinite(away) else None
    result["n_skipped"] = run.n_skipped
    result["notes"] = notes
    write_json(directory / "result.json", result)
    print(summary(cfg, first, last, start, result, directory, run.unit, played=judge is None))
    if stopped is not None:
        raise stopped
    saved.clear()
    return result


class _Learning:
    """A run that learns from a stream of tuples."""

    unit = "tuples"

    def __init__(
        self,
        cfg: DictConfig,
        env: gym.Env[Any, Any],
        world: World,
        learner: Any,
        rng: Streams,
        prior: np.ndarray,
        safe_point: SafePoint,
    ) -> None:
        self.learner = learner
        self.sizes = sizes(world.source)
        problem = Problem(env, world.source, prior, world.mdp, world.episode)
        self.data, self.n_skipped = make_experience(make_source(cfg.experience), problem, cfg.seed, safe_point)
        self.n_experience = len(self.data)
        self.digest: int | None = self.data.checksum()
        safe_point()

    def check(self, found: dict[str, Any] | None) -> dict[str, Any] | None:
        """A checkpoint, if it is of this stream. Raises InputError."""
        if found and found["digest"] != self.digest:
            raise InputError("experience", "another stream", "the one that the run in its directory began with")
        return found

    def states(self, state: Any) -> Iterator[Any]:
        yield from self.learner.iterate(self.data, *self.sizes, state)

    def step(self, state: Any) -> int:
        return int(state.n_tuples)

    def milestone(self, state: Any) -> str:
        if state.epoch < getattr(self.learner, "n_epochs", 1):
            return ""
        return f"biasing iteration {state.bias_iteration}" if hasattr(state, "bias_iteration") else "last pass"

    def names(self, state: Any) -> dict[str, float]:
        """What the learner logs, by tag."""
        prefix = "s1" if isinstance(state, S1State) else "learner"
        return {f"{prefix}/{k}": v for k, v in state.metrics().items() if k not in ("epoch", "n_tuples")}

    def tags(self, state: Any, measured: Evaluation) -> dict[str, float]:
        known = {tag: value for tag, value in self.names(state).items() if np.isfinite(value)}
        return known | evaluation_tags(measured)

    def postfix(self, state: Any) -> str:
        bias = f"bias {state.bias_iteration}/{self.learner.n_bias - 1} " if hasattr(state, "bias_iteration") else ""
        return f"{bias}epoch {state.epoch}" + ("" if state.theta is None else f" theta {state.theta:.4f}")

    def bar(self) -> tqdm:
        passes = getattr(self.learner, "n_bias", 1) * getattr(self.learner, "n_epochs", 1)
        return learning_bar(passes * self.n_experience, self.unit)

    def solution(self, state: Any, history: list[dict[str, float]], stopped: BaseException | None) -> Solution:
        failure = stopped if isinstance(stopped, NonFiniteError) else None
        solution: Solution = self.learner.solution(state, history, failure)
        return solution

    @functools.cached_property
    def counted(self) -> reservations.Counted:
        """The stream as counts."""
        return reservations.count(self.data, *self.sizes, self.learner.drawn_from_prior == "a_next")

    def reservations(
        self,
        prior: np.ndarray,
        judge: TabularMDP | None,
        estimate: Estimate | None,
        bounds: tuple[float, float] | None,
    ) -> list[Reservation]:
        """What the stream does not allow the learner, and where it contradicts the model."""
        found = reservations.of_stream(self.counted, self.learner, prior)
        if judge is not None:
            found += reservations.of_model(self.counted, judge, estimate, bounds)
            found += reservations.of_states(self.counted.tally, judge)
        return found

    @property
    def states_met(self) -> list[int]:
        """[states in which the stream acts, states there are]."""
        return [int(self.counted.tally.visits.reshape(self.sizes).any(1).sum()), self.sizes[0]]

    def outcome(self, theta: float | None, estimate: Estimate | None) -> list[Reservation]:
        """What the learnt theta shows."""
        return reservations.of_theta(theta, self.counted.tally.reward_range, estimate)

    def optimum(self, judge: TabularMDP | None, prior: np.ndarray) -> Solution | None:
        """The exact answer to ``judge``, to compare with."""
        if judge is None:
            return None
        try:
            return solve_soft_bellman(judge, self.learner.beta, prior)
        except (MemoryError, RuntimeError) as error:  # what factorisations need shows as they go
            if not checks.out_of_memory(error):
                raise
            allowed = f"false: the exact solution of this model needs more memory than there is ({error})"
            raise InputError("evaluation.certify", "true", allowed) from error

    def uncertainty(self, prior: np.ndarray) -> Estimate:
        """theta* with its error, as the counts of the stream alone have it."""
        return of_data(self.counted.model, self.learner.beta, prior)


class _Solving:
    """A run that solves the environment's model."""

    unit = "iterations"
    n_experience = n_skipped = 0
    states_met = None
    digest = None  # no stream, and no checkpoints: it begins anew

    def __init__(
        self,
        cfg: DictConfig,
        env: gym.Env[Any, Any],
        world: World,
        learner: Exact,
        rng: Streams,
        prior: np.ndarray,
        safe_point: SafePoint,
    ) -> None:
        if world.mdp is None:
            raise InputError(
                "learner", "exact", f"one that learns from experience: no model of {cfg.env.name} is known"
            )
        self.learner, self.mdp = learner, world.mdp

    def reservations(self, *_: object) -> list[Reservation]:
        """There are no data."""
        return []

    def check(self, found: dict[str, Any] | None) -> None:
        return None

    def states(self, state: None) -> Iterator[ExactState]:
        return self.learner.iterate(self.mdp)

    def step(self, state: ExactState) -> int:
        return state.step

    def milestone(self, state: ExactState) -> str:
        if self.learner.method == "biasing":
            return f"biasing iteration {state.step - 1}"
        return f"Newton step {state.step}"

    def names(self, state: ExactState) -> dict[str, float]:
        return {f"exact/{name}": value for name, value in state.metrics().items()}

    def tags(self, state: ExactState, measured: Evaluation) -> dict[str, float]:
        # Nothing is proven at step 0; TensorBoard's band chart wants the same steps in all three tags.
        return (self.names(state) if state.step else {}) | evaluation_tags(measured)

    def postfix(self, state: ExactState) -> str:
        return f"theta {state.theta:.6f} {proven(state.theta_bounds, None)}"

    def bar(self) -> tqdm:
        return learning_bar(None, self.unit)

    def solution(self, state: ExactState, history: list[dict[str, float]], stopped: BaseException | None) -> Solution:
        return self.learner.solution(self.mdp, state, history, stopped is not None)

    def outcome(self, *_: object) -> list[Reservation]:
        """There are no data."""
        return []

    def optimum(self, judge: TabularMDP | None, prior: np.ndarray) -> None:
        """The run itself finds it."""

    def uncertainty(self, prior: np.ndarray) -> None:
        """There are no data."""
