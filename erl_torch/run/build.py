"""From a configuration to objects: environment, model, learner, experience."""

from __future__ import annotations

import contextlib
import re
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec, load_env_creator
from omegaconf import DictConfig, OmegaConf
from tqdm import tqdm

from erl_torch import checks
from erl_torch.checks import InputError
from erl_torch.empirical.charge import charge_of_tuples
from erl_torch.envs import ENTRY_POINTS
from erl_torch.envs.discretise import Discretise
from erl_torch.envs.encoded import encoded, labels_of
from erl_torch.envs.ends import EndReward
from erl_torch.envs.estimate import estimate_mdp
from erl_torch.experience.collect import COLUMN_BYTES
from erl_torch.experience.experience import EXPERIENCE, Experience
from erl_torch.experience.log import UNSEEN, Log
from erl_torch.experience.recording import FileRecording
from erl_torch.experience.simulation import KEEP_BYTES, TUPLE_BYTES, ReplicaExperience
from erl_torch.experience.sources import Recorded, Simulate, Source
from erl_torch.experience.transitions import Transitions, join
from erl_torch.files import read_npy
from erl_torch.learners.learner import CONTRACT, TabularLearner, with_prior
from erl_torch.mdp.ends import RULES, EndRule, Failures
from erl_torch.mdp.from_gymnasium import (
    MeanRewardWarning,
    absorbing,
    end_pays,
    ending_states,
    has_table,
    known_mdp,
    model_ends,
    rule_of_ends,
    sizes,
    tabular_mdp,
)
from erl_torch.mdp.masks import ActionMasks
from erl_torch.mdp.tabular import TabularMDP, check_policy
from erl_torch.notes import note
from erl_torch.problem import Problem
from erl_torch.run.classes import KEYS_OF_ENV, OF_EVERY_ENV, imported, parameters, resolve, settings_of
from erl_torch.solvers.charge import smallest_charge

SafePoint = Callable[[], None]
TABLES = 8  # of a learner's size, about, while it learns and is evaluated
REPLICA_BYTES = 10_000  # of a replica, besides: generators and settings
LABELS = ("class", "name")  # keys of every group that are no arguments
OF_THE_MODEL = ("stream", "n_samples", "model_seed")  # of a control task
NO_ENV = "none"  # in the place of Gymnasium's id
OF_A_LOG = (*LABELS, "id", "suggest", "unseen_actions", "end_reward", "failures", "end_target")
OF_NO_ENV = (*KEYS_OF_ENV, *OF_THE_MODEL, *OF_EVERY_ENV)


class World(NamedTuple):
    """What a run learns from and is judged by."""

    source: TabularMDP | gym.Env[Any, Any]  # of the stream
    mdp: TabularMDP | None  # the model to evaluate on, to certify with, and to solve
    episode: TabularMDP | None = None  # the model of one episode: its end is absorbed, without reward
    success: np.ndarray | None = None  # [S, A], the probability that a step of it ends it in success
    ends: EndRule | None = None

    @property
    def allowed(self) -> np.ndarray | None:
        """The actions that each state has, [S, A] bool, as the model tells them; None where there is none."""
        mdp = self.source if isinstance(self.source, TabularMDP) else self.mdp
        return None if mdp is None else mdp.allowed


# The tuples that a world gives, and the prior [S, A] on the actions that it told meanwhile.
Counted = Callable[[World], tuple[Experience, np.ndarray]]


@contextlib.contextmanager
def group(name: str) -> Iterator[None]:
    """Complaints raised inside name their configuration group."""
    try:
        yield
    except InputError as error:
        own = error.within(name)
        # Keys in the text too: columns.s=NAME is experience.columns.s=NAME.
        own = InputError(
            own.key, own.value, re.sub(r"(?<![\w.])columns\.(?=\w+(=NAME| has))", f"{name}.columns.", own.allowed)
        )
        raise own from error


def make_env(cfg: DictConfig, render_mode: str | None = None) -> gym.Env[Any, Any]:
    """The environment of ``cfg``, with both spaces Discrete. Raises InputError."""
    shown: dict[str, Any] = {} if render_mode is None else {"render_mode": render_mode}
    env, arguments = _env_of(cfg, shown)
    keys: Any = OmegaConf.to_container(cfg, resolve=True)
    with group("env"):
        binning = {key: keys.get(key) for key in ("bins", "low", "high", "actions") if key not in arguments}
        if any(value is not None for value in binning.values()):
            return Discretise(env, **binning)
        return encoded(env)


def raw_env(cfg: DictConfig, **more: object) -> gym.Env[Any, Any]:
    """The environment of ``cfg`` with the spaces that it has; ``more`` is for ``gymnasium.make``. Raises InputError."""
    return _env_of(cfg, more)[0]


def _env_of(cfg: DictConfig, more: dict[str, Any]) -> tuple[gym.Env[Any, Any], dict[str, Any]]:
    """The environment of ``cfg``, its ``class`` or what Gymnasium has under its ``id``, and its arguments."""
    keys: Any = OmegaConf.to_container(cfg, resolve=True)
    with group("env"):
        kind, spec = _env_class(keys)
        if kind is not None and keys.get("class") is not None:
            named = {key: value for key, value in keys.items() if key not in KEYS_OF_ENV}
            arguments = settings_of(named, kind, OF_NO_ENV) | (keys.get("kwargs") or {})
        elif "kwargs" in keys:
            arguments = keys["kwargs"]
            checks.instance("kwargs", arguments, dict, "arguments by name, as in env.kwargs.is_slippery=false")
        elif kind is None:
            arguments = {
                key: value for key, value in keys.items() if key not in OF_NO_ENV or key in ("bins", "low", "high")
            }
        else:
            arguments = settings_of(keys, kind, OF_NO_ENV)
        if isinstance(arguments.get("wind"), str):
            arguments["wind"] = read_npy(arguments["wind"], "wind")
        try:
            if isinstance(spec, EnvSpec):  # its arguments may have the names of gymnasium.make's own
                spec.kwargs = arguments
                env = gym.make(spec, **more)
            else:
                env = gym.make(spec, **arguments, **more)
        except InputError:
            raise
        except (gym.error.Error, ImportError) as error:
            raise InputError("id", cfg.get("id"), f"an environment that Gymnasium has ({error})") from error
        except Exception as error:  # whatever an environment answers arguments with
            if checks.out_of_memory(error):
                raise
            message = f"{type(error).__name__}: {error}"
            name = spec if isinstance(spec, str) else keys["class"]
            allowed = f"arguments of {name} ({message})"
            if keys.get("kwargs") or not arguments:
                raise InputError("kwargs", arguments, allowed) from error
            *others, (last, value) = arguments.items()  # as they were typed
            raise InputError("".join(f"{k}={v} env." for k, v in others) + last, value, allowed) from error
        return env, arguments


def _env_class(keys: dict[str, Any]) -> tuple[type | None, str | EnvSpec]:
    """The class of an environment, None where only Gymnasium knows it, and what ``gymnasium.make`` takes."""
    path, name = keys.get("class"), keys.get("id")
    if path is None and name is None:
        raise InputError("id", name, "given, as in env.id=FrozenLake-v1, or env.class=my_package.MyEnv")
    if path is None:
        module, colon, _ = str(name).partition(":")
        if colon:  # Gymnasium imports it too, and tells less where that fails
            imported(module, "id", name, "an environment that Gymnasium has, as MODULE:ID")
        known = "kwargs" not in keys and name in ENTRY_POINTS
        creator: Any = load_env_creator(str(gym.spec(str(name)).entry_point)) if known else None
        return creator, str(name)
    kind = resolve(path, "class")
    if not issubclass(kind, gym.Env):
        raise InputError("class", path, "a class derived from gymnasium.Env")
    creator = kind
    return kind, EnvSpec(kind.__name__, entry_point=creator)


def make_world(
    cfg: DictConfig,
    env: gym.Env[Any, Any],
    safe_point: SafePoint,
    beta: float | None = None,
    prior: np.ndarray | None = None,
    counted: Counted | None = None,
) -> World:
    """What there is to learn from in ``env``, as ``cfg`` says.

    ``beta``, ``prior`` and, where there is no model, ``counted`` are for ``end_reward=auto``. Raises InputError.
    """
    if all(key in cfg for key in OF_THE_MODEL):
        return _control_world(cfg, env, safe_point)
    on_end = cfg.get("on_end", "restart")
    checks.one_of("env.on_end", on_end, ("restart", "absorb"))
    masking = bool(cfg.get("use_action_mask"))
    with group("env"):
        failures = _failures(cfg, env)
        if not reads_table(cfg, env):
            if on_end == "absorb":
                raise InputError("on_end", on_end, "restart, where there is no model (P) to read")
            if masking:
                reason = "there is no model (P) to read, and masks of mdp or info are used in any case"
                raise InputError("use_action_mask", True, f"false: {reason}")
            return _world_of_steps(cfg, env, failures, beta, prior, counted)
        allowed = masks_of(env) if masking else None
        end_reward = _end_reward(cfg, env, beta, prior, allowed)
    told = cfg.get("failures", "default")
    mdp = episode = None
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", MeanRewardWarning)
        try:
            mdp = tabular_mdp(env, on_end, allowed=allowed, end_reward=end_reward, failures=told)
        except InputError as error:
            if on_end == "absorb" or end_reward or masking:
                raise error.within("env") from error
            note(f"learning from env.step, for {error}")
    for message in sorted({str(warning.message) for warning in caught}):
        note(message)
    with warnings.catch_warnings(), contextlib.suppress(InputError):
        warnings.simplefilter("ignore", MeanRewardWarning)
        episode = tabular_mdp(env, "absorb", allowed=allowed)  # an episode is worth what the environment pays
    if episode is not None and episode.reward[absorbing(episode)].any():
        episode = None  # an end that pays for ever is no end
    rule = None if failures is None else EndRule(failures, end_reward)
    success = None
    if episode is not None:
        chances = model_ends(env, told)
        success = chances.ended - chances.failed
        success[absorbing(episode)] = 0.0
        success = success if success.any() else None
    return World(env if mdp is None else mdp, mdp, episode, success, rule)


def _failures(cfg: DictConfig, env: gym.Env[Any, Any]) -> Failures | None:
    """The rule of ``cfg`` in ``env``; None where it is the default and the environment does not tell how it ends."""
    rule = cfg.get("failures", "default")
    rule = rule if isinstance(rule, str) else list(rule)
    return None if rule == "default" and end_pays(env) is None else rule_of_ends(rule, env)


def _end_reward(
    cfg: DictConfig,
    env: gym.Env[Any, Any],
    beta: float | None,
    prior: np.ndarray | None,
    allowed: np.ndarray | None = None,
) -> float:
    """The number of ``cfg``; for ``auto`` minus the smallest charge of the model of ``env``."""
    value = cfg.get("end_reward", 0.0)
    if value != "auto":
        return checks.finite("end_reward", value)
    if beta is None:
        raise InputError("end_reward", value, "a number here, or one beta: the charge depends on it")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MeanRewardWarning)
        ends = model_ends(env, cfg.get("failures", "default"))
        if not ends.failed.any():
            raise InputError("end_reward", value, "a number: no end is a failure by this rule (env.failures)")
        with _end_target():
            model = tabular_mdp(env, allowed=allowed)
            found = smallest_charge(model, ends.failed, beta, cfg.get("end_target", 1e-3), prior)
    note(f"end_reward=auto: {0.0 - found.charge:.9g}, at which {found.failing_rate:.3g} of the optimum's steps fail")
    return 0.0 - found.charge


@contextlib.contextmanager
def _end_target() -> Iterator[None]:
    """Complaints raised inside call the target by its key."""
    try:
        yield
    except InputError as error:
        raise InputError("end_target", error.value, error.allowed) if error.key == "target" else error from error


def _counted_charge(free: Experience, charged: Experience, beta: float, target: float, prior: np.ndarray) -> float:
    """The end reward of ``end_reward=auto`` where tuples are all that there is (``charge_of_tuples``)."""
    with _end_target():
        found = charge_of_tuples(free, charged, beta, target, prior)
    rate = f"{found.failing_rate:.3g} of the steps of their optimum fail"
    note(f"end_reward=auto: {0.0 - found.charge:.9g}, by the counts of the tuples alone, at which {rate}")
    return 0.0 - found.charge


def _world_of_steps(
    cfg: DictConfig,
    env: gym.Env[Any, Any],
    failures: Failures | None,
    beta: float | None,
    prior: np.ndarray | None,
    counted: Counted | None,
) -> World:
    """That of an environment without a table ``P``, or whose table is not to be used."""
    mdp = known_mdp(env)
    if mdp is not None:
        ending = ending_states(env, mdp.n_states).any()
        rule = None
        if ending or cfg.get("end_reward", 0.0):
            assert failures is not None
            rule = EndRule(failures, _end_reward(cfg, env, beta, prior))
        if rule is None or not rule.end_reward:
            return World(env, mdp, ends=rule)
        charged = tabular_mdp(env, end_reward=rule.end_reward, failures=cfg.get("failures", "default"))
        return World(charged, charged, ends=rule)
    end_reward = cfg.get("end_reward", 0.0)
    if end_reward == "auto":
        if beta is None or counted is None:
            allowed = "a number, where there is no model (but for train.py with experience=simulate and one beta)"
            raise InputError("end_reward", end_reward, allowed)
        source = EndReward(env, -1.0, cfg.get("failures", "default"))
        data, _ = counted(World(env, None))
        lower, told = counted(World(source, None, ends=source.rule))
        end_reward = _counted_charge(data, lower, beta, cfg.get("end_target", 1e-3), told)
    end_reward = checks.finite("end_reward", end_reward)
    if not end_reward:
        return World(env, None, ends=None if failures is None else EndRule(failures))
    source = EndReward(env, end_reward, cfg.get("failures", "default"))
    return World(source, None, ends=source.rule)


def reads_table(cfg: DictConfig, env: gym.Env[Any, Any]) -> bool:
    """Whether the model of ``env`` is read from its table ``P``."""
    return known_mdp(env) is None and bool(cfg.get("use_model")) and has_table(env)


def masks_of(env: gym.Env[Any, Any]) -> np.ndarray:
    """[S, A] bool: the actions that each state has, as ``action_mask(state)`` of an environment (Taxi's) tells. Raises
    InputError where there is no such method."""
    tell = getattr(env.unwrapped, "action_mask", None)
    if not callable(tell):
        allowed = "false: the environment has no method action_mask(state)"
        raise InputError("use_action_mask", True, allowed)
    n_states, n_actions = sizes(env)
    rows = [checks.array(f"action_mask({s})", tell(s), (n_actions,)) for s in range(n_states)]
    return np.stack(rows) > 0


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


# -- a log alone ----------------------------------------------------------------------------------------


def is_log(cfg: DictConfig) -> bool:
    """Whether ``cfg``, of the environment, says that there is none."""
    return bool(cfg.get("id") == NO_ENV)


def make_log(cfg: DictConfig, safe_point: SafePoint) -> tuple[Log, TabularLearner[Any]]:
    """What the log of the run ``cfg`` says, and the learner, with the prior that it says. Raises InputError."""
    learner: TabularLearner[Any] = made(cfg.learner, learner_class(cfg.learner), "learner")
    if learner.needs_model:
        raise InputError("learner", cfg.learner.name, "one that learns from experience: a log has no model to solve")
    source = make_source(cfg.experience)
    if not isinstance(source, Recorded):
        allowed = f"recorded: env={cfg.env.name} has no environment to collect from"
        raise InputError("experience", cfg.experience.name, allowed)
    for key in map(str, cfg.env):
        if key not in OF_A_LOG:
            raise InputError(f"env.{key}", cfg.env[key], f"left out: no such key; there are {', '.join(OF_A_LOG[-4:])}")
    checks.one_of("env.unseen_actions", cfg.env.unseen_actions, UNSEEN)
    end_reward, failures = cfg.env.get("end_reward", 0.0), cfg.env.get("failures", "default")
    auto = end_reward == "auto"
    if auto and "beta" in cfg.vary:
        raise InputError("env.end_reward", end_reward, "a number here, or one beta: the charge depends on it")
    with group("env"):
        checks.finite("end_reward", 0.0 if auto else end_reward)
        checks.one_of("failures", failures, RULES)

    def read(end_reward: float) -> Log:
        with group("experience"), _collecting(source.work, None, safe_point) as report:
            return source.log(cfg.seed, cfg.env.unseen_actions, learner.prior_policy, report, end_reward, failures)

    try:
        if auto:
            free, charged = read(0.0), read(-1.0)
            with group("env"):
                target = cfg.env.get("end_target", 1e-3)
                data = free.experience, charged.experience
                end_reward = _counted_charge(*data, learner.beta, target, free.problem.prior)
        log = read(end_reward)
    except InputError as error:
        name = error.key.removeprefix("experience.")
        if name == "end_reward":
            raise InputError("env.end_reward", error.value, error.allowed) from error
        if name.startswith("prior_policy"):
            raise InputError(f"learner.{name}", error.value, error.allowed) from error
        raise
    check_sizes(log.n_states, log.n_actions)
    learner = with_prior(learner, log.problem.allowed)
    with group("learner"):
        learner.init(log.n_states, log.n_actions)
    return log, learner


@dataclass(frozen=True, eq=False)
class FromLog(Source):
    """The tuples of a log that has been read."""

    log: Log

    one_stream: ClassVar[bool] = True

    def __call__(self, problem: Problem, seed: int, report: Callable[[int], None]) -> FileRecording:
        return self.log.recording


def make_problem(cfg: DictConfig, env: gym.Env[Any, Any], world: World, learner: TabularLearner[Any]) -> Problem:
    """What there is to learn in ``env`` as the run ``cfg`` says, with the prior of ``learner``. Raises InputError."""
    shape = sizes(env)
    prior = check_policy("learner.prior_policy", learner.prior_policy, *shape, world.allowed)
    horizon = steps_of(env, cfg.evaluation.horizon)
    return Problem(
        env,
        world.source,
        prior,
        world.mdp,
        world.episode,
        horizon,
        cfg.env.name,
        ActionMasks(*shape),
        *labels_of(env),
        success=world.success,
        ends=world.ends,
    )


def steps_of(env: gym.Env[Any, Any], horizon: int) -> int:
    """Steps of an episode of ``env``, at most ``horizon``."""
    return min(horizon, (env.spec and env.spec.max_episode_steps) or horizon)


def learner_class(cfg: DictConfig, key: str = "learner") -> type:
    """The class of the learner of ``cfg``. Raises InputError, under ``key``."""
    kind = resolve(cfg.get("class"), f"{key}.class")
    absent = [name for name in CONTRACT if not hasattr(kind, name) and name not in parameters(kind)]
    if absent:
        raise InputError(f"{key}.class", cfg["class"], f"that of a learner: it has no {', '.join(absent)}")
    return kind


def make_learner(cfg: DictConfig, n_states: int, n_actions: int, key: str = "learner") -> TabularLearner[Any]:
    """The learner of ``cfg``; complaints name their keys under ``key``."""
    learner: TabularLearner[Any] = made(cfg, learner_class(cfg, key), key)
    check_sizes(n_states, n_actions)
    with group(key):
        learner.init(n_states, n_actions)  # validates the prior against the sizes
        return learner


def make_source(cfg: DictConfig, key: str = "experience") -> Source:
    """The source of experience of ``cfg``. Raises InputError, under ``key``."""
    kind = resolve(cfg.get("class"), f"{key}.class")
    if not issubclass(kind, Source):
        raise InputError(f"{key}.class", cfg["class"], "a class derived from erl_torch.Source")
    source: Source = made(cfg, kind, key)
    return source


def made(cfg: DictConfig, kind: type, key: str) -> Any:  # of ``kind``, whatever that is
    """The dataclass ``kind`` with the settings of ``cfg``; the prior policy is a file there."""
    with group(key):
        values: Any = OmegaConf.to_container(cfg, resolve=True)
        arguments = settings_of(values, kind, LABELS)
        if arguments.get("prior_policy") is not None:
            arguments["prior_policy"] = read_npy(str(arguments["prior_policy"]), "prior_policy")
        try:
            return kind(**arguments)
        except TypeError as error:
            raise InputError("class", cfg["class"], f"one that takes these settings ({error})") from error


def check_sizes(n_states: int, n_actions: int, n_replicas: int = 1) -> None:
    """Raise InputError unless pairs have numbers of 32 bits, and the tables of a learner find room."""
    n_pairs = n_states * n_actions
    if n_pairs >= 2**31:
        raise InputError("n_states * n_actions", f"{n_states} * {n_actions}", "below 2**31")
    needed = n_replicas * (8 * TABLES * n_pairs + REPLICA_BYTES)
    what = f"{n_states:,} states and {n_actions:,} actions, in {TABLES} tables"
    if n_replicas > 1:
        checks.memory("n_replicas", n_replicas, needed, f"one learner per replica, of {what}")
    else:
        checks.memory("n_states * n_actions", f"{n_states} * {n_actions}", needed, what)


def make_experience(source: Source, problem: Problem, seed: int, safe_point: SafePoint) -> tuple[Experience, int]:
    """The stream of ``seed``, in memory where it is no longer than its chunk; bad tuples that were left out.

    Raises InputError.
    """
    with group("experience"), _collecting(source.work, source.n_tuples, safe_point) as report:
        data = source(problem, seed, report)
        checks.instance("class", data, Experience, f"a source of {EXPERIENCE}")
    charged = problem.source
    if isinstance(charged, EndReward) and not charged.n_paid and isinstance(source, Simulate):
        note(f"no end of the stream got env.end_reward ({charged.rule})")
    return accepted(data)


def accepted(data: Experience) -> tuple[Experience, int]:
    """``data``, in memory where it is no longer than its chunk; bad tuples that were left out, which a note tells."""
    if not isinstance(data, FileRecording):
        return data, 0
    if data.n_skipped:
        total = data.n_skipped + len(data)
        first = f"; the first is {data.first_skipped}" if data.first_skipped else ""
        note(f"{data.path}: {data.n_skipped:,} bad tuples of {total:,} left out{first}")
    return data.held(), data.n_skipped


def make_replica_experience(
    cfg: DictConfig, source: Source, problem: Problem, seeds: Sequence[int], safe_point: SafePoint
) -> ReplicaExperience:
    """One stream for all replicas, or one per seed, as the run ``cfg`` says. Raises InputError."""
    shared = cfg.shared_stream or source.one_stream
    if shared and cfg.n_replicas > 1:
        allowed = (
            "1: on one stream, replicas with the same settings would be the same (let settings vary, vary.KEY=[...])"
        )
        raise InputError("n_replicas", cfg.n_replicas, allowed)
    if shared:
        return _in_memory(make_experience(source, problem, cfg.seed, safe_point)[0])
    with group("experience"):
        simulation = source.simulation(problem, seeds, cfg.keep_tuples)
    if simulation is not None:
        if cfg.keep_tuples:
            held = TUPLE_BYTES * len(seeds) * simulation.n_tuples
            checks.memory("keep_tuples", "true", held, f"the tuples of {len(seeds):,} replicas")
        return simulation
    streams: dict[int, Transitions] = {}
    for seed in tqdm(sorted(set(seeds)), desc=source.work, unit=" streams", delay=1, leave=False, disable=None):
        with group("experience"):
            made = source(problem, seed, lambda _: safe_point())
            checks.instance("class", made, Experience, f"a source of {EXPERIENCE}")
            streams[seed] = _in_memory(made)
        safe_point()
    return [streams[seed] for seed in seeds]


def _in_memory(data: Experience) -> Transitions:
    """All tuples, as replicas hold them. Raises InputError for more of a file than finds room."""
    if isinstance(data, Transitions):
        return data
    most = KEEP_BYTES // COLUMN_BYTES
    if len(data) > most:
        raise InputError(
            "experience", f"{len(data):,} tuples", f"at most {most:,} tuples, as replicas hold them in memory"
        )
    return join(list(data.chunks()))


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
