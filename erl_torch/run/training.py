"""One training run, from a configuration to a run directory; Hydra stays outside.

A run directory holds the event file, ``result.json`` and ``solution.npz`` (and Hydra's ``.hydra/``).
"""

from __future__ import annotations

import contextlib
import functools
import platform
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch
from omegaconf import DictConfig, OmegaConf
from tqdm import tqdm

import erl_torch
from erl_torch import checks
from erl_torch.checks import InputError
from erl_torch.empirical import reservations
from erl_torch.empirical.counts import EmpiricalMDP
from erl_torch.empirical.reservations import Reservation
from erl_torch.empirical.uncertainty import Estimate, theta_uncertainty
from erl_torch.envs import grid_pictures
from erl_torch.envs.discretise import Discretise
from erl_torch.envs.estimate import estimate_mdp
from erl_torch.envs.grid_world import GridWorld
from erl_torch.evaluation import Evaluation, evaluate
from erl_torch.experience.collect import collect, record
from erl_torch.experience.recording import FileRecording, check_target, open_recording
from erl_torch.experience.transitions import Recording
from erl_torch.files import read_npy, write_json
from erl_torch.learners import LEARNERS, Exact, ExactState, NonFiniteError, S1State
from erl_torch.learners.learner import columns
from erl_torch.learners.s1 import kernels
from erl_torch.log.tensorboard import Board, hyperparameters, layout
from erl_torch.mdp.from_gymnasium import MeanRewardWarning, absorbing, known_mdp, sizes, tabular_mdp
from erl_torch.mdp.tabular import TabularMDP, check_policy
from erl_torch.notes import collected, note
from erl_torch.rng import Streams, streams
from erl_torch.run.checkpoint import Checkpoints, rows_of
from erl_torch.run.settings import check_keys
from erl_torch.solution import Solution, Status, proven
from erl_torch.solvers import certify, solve_soft_bellman
from erl_torch.solvers.chains import SingularChainError
from erl_torch.solvers.policy import reward_per_step

SafePoint = Callable[[], None]
TABLES = 8  # of a learner's size, about, while it learns and is evaluated
REPLICA_BYTES = 10_000  # of a replica, besides: generators and settings
SMALL = 2000  # states of a model, or that a stream meets, up to which it is solved beside every run
NOT_ARGUMENTS = ("name", "id", "suggest", "stream", "n_samples", "model_seed")


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
    _check_evaluation(cfg.evaluation)
    settings: Any = OmegaConf.to_container(cfg, resolve=True)
    saved = Checkpoints(directory, settings, cfg.checkpoint_every, "cpu" if many else cfg.learner.get("device", "cpu"))
    if (result := saved.result()) is not None:
        print(f"note: the run in {directory} is complete", file=sys.stderr)
        saved.clear()
        return result
    if many:
        from erl_torch.run.replicated import train_replicas

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
        clock = _Stopwatch()
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
        lines = evaluation_tags(first, "prior") | _optimal_tags(best, judge, episode, horizon) | _data_tags(estimate)
        boards = layout([*run.names(start), *evaluation_tags(first)], lines)
        settings = hyperparameters(cfg, n_experience=run.n_experience)
        mark = found["events"] if found else None
        solution: Solution | None = None
        ended = Ended(lambda: solution is not None)
        with ended, saved.refusing(lambda: bool(history)), Board(directory, settings, boards, mark) as board:
            board.lines(lines)
            drawer = _Drawer(board, getattr(env.unwrapped, "grid", None)) if cfg.evaluation.pictures else None
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
                            _say(milestone, state, last)
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
                    board.scalars(_optimal_tags(solution, judge, episode, horizon), step)
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
    result = _result(cfg, solution, last, run.n_experience, clock.seconds, seconds)
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
    print(_summary(cfg, first, last, start, result, directory, run.unit, played=judge is None))
    if stopped is not None:
        raise stopped
    saved.clear()
    return result


class Ended:
    """Around the end of a run: what goes wrong once there is something to save is kept in ``error`` until it is saved.

    Args:
        learnt: whether there is.
    """

    def __init__(self, learnt: Callable[[], bool]) -> None:
        self.learnt = learnt
        self.error: Exception | None = None

    def __enter__(self) -> Ended:
        return self

    def __exit__(self, kind: Any, error: BaseException | None, trace: Any) -> bool:
        if not isinstance(error, Exception) or not self.learnt():
            return False
        self.error = error
        return True

    @staticmethod
    def keep(saved: Checkpoints, step: int, content: Callable[[], dict[str, Any]]) -> None:
        """A checkpoint now; where even that fails, the rest can still be saved."""
        try:
            saved.offer(step, content, now=True)
        except Exception as error:
            print(f"warning: no checkpoint of tuple {step:,} ({type(error).__name__}: {error})", file=sys.stderr)


class World(NamedTuple):
    """What a run learns from and is judged by."""

    source: TabularMDP | gym.Env[Any, Any]  # of the stream
    mdp: TabularMDP | None  # the model to evaluate on, to certify with, and to solve
    episode: TabularMDP | None = None  # the model of one episode: its end is absorbed, without reward


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
        self.n_skipped = 0
        self.data: Recording
        if cfg.experience.name == "recorded":
            found = recorded(cfg.experience, env, *self.sizes, cfg.seed, prior, safe_point)
            self.data, self.n_skipped = found.held(), found.n_skipped
        else:
            self.data = _experience(cfg.experience, world.source, *self.sizes, rng, prior, safe_point)
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


def of_data(model: EmpiricalMDP | None, beta: float, prior: np.ndarray) -> Estimate:
    """theta* with its error, as a stream alone has it; withheld, with a value of NaN, where that cannot be had."""
    if model is None:
        reason = "the squares of the rewards overflow"
    elif (met := int(model.visits.any(1).sum())) > SMALL:
        reason = f"the stream meets {met:,} states, and more than {SMALL:,} are not solved beside a run"
    else:
        try:
            return theta_uncertainty(model, beta, prior)
        except InputError as error:  # streams that return nowhere
            reason = str(error)
        except (SingularChainError, np.linalg.LinAlgError):
            reason = "the chain of the data falls apart in double precision"
    return Estimate("theta", np.nan, np.inf, withheld=reason)


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


def _optimal_tags(
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


def _data_tags(estimate: Estimate | None) -> dict[str, float]:
    if estimate is None or np.isnan(estimate.value):
        return {}
    if estimate.withheld:
        return {"data/theta": estimate.value}
    low, high = estimate.interval()
    return {"data/theta": estimate.value, "data/theta_lower": low, "data/theta_upper": high}


def _say(milestone: str, state: Any, measured: Evaluation) -> None:
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


class _Stopwatch:
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


# -- from configuration to objects ------------------------------------------------------------------


@contextlib.contextmanager
def _group(name: str) -> Iterator[None]:
    """Complaints raised inside name their configuration group."""
    try:
        yield
    except InputError as error:
        raise error.within(name) from error


def make_env(cfg: DictConfig, render_mode: str | None = None) -> gym.Env[Any, Any]:
    """The environment of ``cfg``. Raises InputError."""
    keys: Any = OmegaConf.to_container(cfg, resolve=True)
    arguments = keys["kwargs"] if "kwargs" in keys else {k: v for k, v in keys.items() if k not in NOT_ARGUMENTS}
    with _group("env"):
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
    with _group("env"):
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


def mean_return(episode: TabularMDP, horizon: int, policy: np.ndarray) -> float:
    """Expected return of an episode of at most ``horizon`` steps, which ``episode`` is the model of."""
    return horizon * reward_per_step(episode, policy, horizon)


def make_learner(cfg: DictConfig, n_states: int, n_actions: int, key: str = "learner") -> Any:
    """The learner of ``cfg``; complaints name their keys under ``key``."""
    learner_class = LEARNERS[cfg.name]
    with _group(key):
        arguments = {f.name: cfg[f.name] for f in fields(learner_class)}
        if cfg.prior_policy is not None:
            arguments["prior_policy"] = read_npy(cfg.prior_policy, "prior_policy")
        learner = learner_class(**arguments)
    check_sizes(n_states, n_actions)
    with _group(key):
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
    with _group("experience"), _collecting("reading", None, safe_point) as report:
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


def _experience(
    cfg: DictConfig,
    source: TabularMDP | gym.Env[Any, Any],
    n_states: int,
    n_actions: int,
    rng: Streams,
    prior: np.ndarray,
    safe_point: Callable[[], None],
) -> Recording:
    with _group("experience"):
        behaviour = None
        if cfg.behaviour_policy is not None:
            behaviour = read_npy(cfg.behaviour_policy, "behaviour_policy")
        if cfg.save_to is not None:
            check_target("save_to", cfg.save_to)
        total = cfg.n_episodes * cfg.episode_length if cfg.n_episodes >= 1 and cfg.episode_length >= 1 else 0
        with _collecting("collecting", total, safe_point) as report:
            arguments = cfg.n_episodes, cfg.episode_length, rng, behaviour, prior, report
            if cfg.save_to is not None and cfg.save_to.endswith("/"):
                return open_recording(record(source, cfg.save_to, *arguments), n_states, n_actions)
            data = collect(source, *arguments)
        if cfg.save_to is not None:
            check_target("save_to", cfg.save_to)  # again: the collecting may have taken hours
            data.save(cfg.save_to)
        return data


def _check_evaluation(cfg: DictConfig) -> None:
    with _group("evaluation"):
        for key in ("every", "n_episodes", "horizon", "exact_up_to"):
            checks.at_least(key, cfg[key], 1)
        checks.memory("n_episodes", cfg.n_episodes, 8 * cfg.n_episodes, "the returns of all episodes")


# -- what is shown ----------------------------------------------------------------------------------


class _Drawer:
    def __init__(self, board: Board, grid: GridWorld | None) -> None:
        self.board, self.grid = board, grid

    def policy(self, state: Any, step: int, title: str) -> None:
        self.board.picture("policy", grid_pictures.policy_picture(state.policy.cpu().numpy(), self.grid, title), step)

    def bias(self, state: Any, step: int, title: str) -> None:
        self.board.picture(
            "reward_bias", grid_pictures.bias_picture(state.reward_bias.cpu().numpy(), self.grid, title), step
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


def _summary(
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
