"""Runs of learners with networks: their objects from a configuration, and their recorder."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from omegaconf import DictConfig

from erl_torch import checks, pictures
from erl_torch.checks import InputError
from erl_torch.files import write_npz, write_png
from erl_torch.learners.learner import NonFiniteError
from erl_torch.log.quantities import results, tagged, with_own
from erl_torch.log.tensorboard import Board, Boards, layout, replica_layout
from erl_torch.networks.actor_critic import suited
from erl_torch.networks.episodes import Stage
from erl_torch.networks.learner import NetworkLearner, NetworkSolution, NetworkState
from erl_torch.networks.live import Live
from erl_torch.networks.policy import Acting, NetworkPolicy, Prior
from erl_torch.networks.problem import BoxProblem, Truth, spaces
from erl_torch.networks.quantities import NETWORK_QUANTITIES
from erl_torch.networks.replay import Recorded, Steps
from erl_torch.networks.seeds import Seeds, SeedsState
from erl_torch.networks.truth import TRUTHS
from erl_torch.notes import note
from erl_torch.run.build import group, made, raw_env
from erl_torch.run.checkpoint import Content
from erl_torch.run.classes import resolve
from erl_torch.run.groups import Group, Record
from erl_torch.run.judge import EvaluationSettings
from erl_torch.run.loop import Outcome, Row
from erl_torch.run.replicas import one_group
from erl_torch.run.report import Title, at, headline, last_rows, plural, versions

TABLE = with_own(NETWORK_QUANTITIES)
SATURATED = 0.05  # nats below log A, from which on a policy is called nearly deterministic
FILE = "policy.safetensors"


def of_seed(seed: int | str) -> str:
    """The file of the policy of one replica."""
    return f"policy-{seed}.safetensors"


def has_networks(cfg: DictConfig) -> bool:
    """Whether the learner of ``cfg`` is one of networks. Raises InputError for no class."""
    return issubclass(resolve(cfg.get("class"), "learner.class"), NetworkLearner)


def make_network_problem(cfg: DictConfig) -> BoxProblem:
    """What there is to learn, as the run ``cfg`` says. Raises InputError."""
    env = raw_env(cfg.env)
    try:
        name = str(cfg.env.name)
        n_observation, n_actions, first, low, high = spaces(env, name)
        limit = (env.spec and env.spec.max_episode_steps) or None
    finally:
        env.close()
    with group("env"):
        end_reward = cfg.env.get("end_reward", 0.0)
        if end_reward == "auto":
            raise InputError("end_reward", end_reward, "a number, for learners with networks")
        end_reward = checks.finite("end_reward", end_reward) or float(cfg.env.suggest.network.end_reward)
        if cfg.env.get("failures", "default") not in ("default", "all"):
            raise InputError("failures", cfg.env.failures, "default or all: with networks every end gets end_reward")

    def make() -> gym.Env[Any, Any]:
        return raw_env(cfg.env, max_episode_steps=-1)

    return BoxProblem(make, n_observation, n_actions, first, low, high, limit, end_reward, name)


@dataclass(eq=False)
class NetworkRecorder:
    """``erl_torch.run.loop.Recorder`` of one learner of networks, or of one for each of several seeds.

    Args:
        learner, problem: as of the run.
        seeds: one of each learner.
        settings: what is measured.
        title: names, for result and summary.
        many: whether it is a run of replicas.
        live: whether it steps the environment while it learns.
    """

    learner: NetworkLearner
    problem: BoxProblem
    truth: Truth | None
    seeds: Sequence[int]
    settings: EvaluationSettings
    title: Title
    many: bool
    live: bool = True
    first: dict[str, np.ndarray] = field(default_factory=dict)
    last: dict[str, np.ndarray] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.stage = Stage(self.problem, self.settings.n_episodes, self.settings.horizon, self.title.seed)
        group = Group({}, slice(0, len(self.seeds)), self.learner.beta, self.learner.optimism)
        self.recorded = Record([group], [self._optimum()], TABLE)

    def _optimum(self) -> dict[str, float]:
        if self.truth is None:
            return {}
        found = dict(self.truth.optimum)
        return found | {"theta": -found["objective"]}

    @property
    def shape(self) -> tuple[int, ...]:
        return (len(self.seeds),) if self.many else ()

    def _measure(self, policies: Sequence[Acting]) -> dict[str, np.ndarray]:
        """Figures [K] of the policies of all seeds."""
        rows = []
        for policy in policies:
            sampled, greedy = (self.stage.play(policy, way) for way in (False, True))
            rate = sampled.rate(self.problem.end_reward)
            real = rate - sampled.kl / self.learner.beta
            row = {"reward_per_step": rate, "objective" if not self.learner.optimism else "objective_real": real}
            if self.truth is not None:
                assert isinstance(policy, (NetworkPolicy, Prior))
                row |= self.truth.figures(policy)
            row |= {"return": sampled.returns.mean(), "return_greedy": greedy.returns.mean()}
            rows.append(row)
        return {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}

    # -- records --------------------------------------------------------------------------------------

    def begin(self) -> None:
        prior = Prior(self.problem.n_actions, self.problem.low, self.problem.high)
        self.first = self.last = self._measure([prior] * len(self.seeds))

    def _one(self, measured: Mapping[str, np.ndarray]) -> dict[str, float]:
        return {name: float(values[0]) for name, values in measured.items() if np.isfinite(values[0])}

    def _constant(self) -> dict[str, float]:
        return tagged("prior", self._one(self.first)) | tagged("optimal", self._optimum())

    def _metrics(self) -> list[str]:
        return list(self.learner.names(self.live))

    def boards(self, alone: bool) -> Boards:
        if self.many:
            return replica_layout({"replicas": self._optimum()}, [*self._metrics(), *self.first], TABLE)
        learnt = [*tagged("learner", dict.fromkeys(self._metrics(), 0.0)), *tagged("eval", self._one(self.first))]
        return layout(learnt, self._constant(), TABLE, alone)

    def open(self, board: Board, goes_on: bool) -> None:
        if self.many:
            if not goes_on:
                self.recorded.add(0, self.first, board)
            return
        board.lines(self._constant())
        if not goes_on:
            board.record(tagged("eval", self._one(self.first)), 0)

    def check(self, state: NetworkState | SeedsState, row: Row) -> None:
        """The learners look at their weights themselves."""

    def record(self, state: NetworkState | SeedsState, row: Row, milestone: str, board: Board) -> None:
        each = _each(state)
        self.last = self._measure([self.learner.policy(self.problem, one) for one in each])
        step = self.learner.position(each[0])
        if milestone and self.truth is not None and self.settings.pictures:
            board.picture("paths", self.truth.picture(self.learner.policy(self.problem, each[0])), step)
        if self.many:
            self.recorded.add(step, {**row, **self.last}, board)
        else:
            logged = {name: value for name, value in row.items() if np.isfinite(value)}
            board.record(tagged("learner", logged) | tagged("eval", self._one(self.last)), step)

    def line(self) -> str:
        shown = ("objective", "loss_of_policy", "return", "return_greedy")
        return "  ".join(
            f"{name.replace('_', ' ')} {self.last[name].mean():.4f}" for name in shown if name in self.last
        )

    # -- checkpoints ----------------------------------------------------------------------------------

    def content(self) -> Content:
        return {"first": self.first, "last": self.last, "record": self.recorded.content() if self.many else None}

    def restore(self, content: Content) -> None:
        self.first, self.last = content["first"], content["last"]
        if self.many:
            self.recorded.restore(content["record"])

    def mark(self) -> Content:
        return {"last": self.last, "lengths": self.recorded.lengths()}

    def back(self, mark: Content) -> None:
        self.last = mark["last"]
        self.recorded.cut(mark["lengths"])

    # -- the end --------------------------------------------------------------------------------------

    def finish(
        self, outcome: Outcome[NetworkState | SeedsState], solution: NetworkSolution, board: Board
    ) -> NetworkSolution:
        self.stage.close()
        for text in self._notes(outcome):
            note(text)
        rate = solution.n_steps * len(self.seeds) / max(outcome.seconds, 1e-9)
        board.scalars({"time/steps_per_second": rate}, solution.n_steps)
        if self.many:
            board.scalars(self.recorded.final(), solution.n_steps)
        else:
            board.scalars(
                tagged("Final", {**self._one(self.last), "theta": float(solution.theta[0])}), solution.n_steps
            )
        return solution

    def _notes(self, outcome: Outcome[NetworkState | SeedsState]) -> list[str]:
        """What a reader of the figures should know."""
        each, found = _each(outcome.state), []
        kl = max(one.figures["kl"] for one in each)
        most = float(np.log(self.problem.n_actions or np.inf))
        if kl > most - SATURATED:
            found.append(
                f"the policy is nearly deterministic (KL to the prior {kl:.3g} of at most {most:.3g} nats a step); a "
                "smaller beta keeps actions apart that are nearly as good"
            )
        replay = each[0].replay
        reward = replay.reward[: replay.n]
        if replay.n and reward.min() == reward.max():
            found.append(
                f"every step paid {reward[0] / self.learner.reward_scale:g}: all policies are worth the same; "
                "env.end_reward makes the ends count"
            )
        if self.learner.optimism:
            found.append("optimism: the slope of the loss is capped, which moves its fixed point")
        return found

    def save(self, solution: NetworkSolution, directory: Path) -> None:
        for seed, state in zip(self.seeds, solution.states, strict=True):
            self.learner.policy(self.problem, state).save(
                directory / (f"policy-{seed}.safetensors" if self.many else FILE)
            )
        if self.many:
            write_npz(directory / "replicas.npz", self.recorded.arrays() | {"seeds": np.array(self.seeds)})
            shown = {name: lines for name, lines in self.recorded.curves().items() if lines}
            write_png(
                directory / "bands.png", pictures.bands(shown, f"{self.title.env}, {self.title.learner}", "steps")
            )

    def failed(self, solution: NetworkSolution) -> NonFiniteError | None:
        """The error has ended the run already."""
        return None

    def result(self, outcome: Outcome[NetworkState | SeedsState], solution: NetworkSolution) -> dict[str, Any]:
        means = {name: float(values.mean()) for name, values in self.last.items()}
        theta = None if np.isnan(solution.theta).all() else float(solution.theta.mean())
        found: dict[str, Any] = {
            "env": self.title.env,
            "learner": self.title.learner,
            "beta": float(self.learner.beta),
            "optimism": float(self.learner.optimism),
            "seed": self.title.seed,
            "status": solution.status.name.lower(),
            "message": solution.message,
            **results({"theta": theta, "reward_per_step": None, "objective": None, "return": None} | means),
            "return_greedy": means.get("return_greedy"),
            "exact_theta": self._optimum().get("theta"),
            **{
                name: means.get(name)
                for name in ("loss_of_policy", "kl_to_optimal", "falls", "arrivals")
                if name in means
            },
            "n_steps": solution.n_steps,
            "end_reward": f"{self.problem.end_reward:+g} at every end; not in the return"
            if self.problem.end_reward
            else None,
            "seconds_learning": round(outcome.seconds, 3),
            "versions": versions(),
        }
        if self.many:
            found |= {"n_replicas": len(self.seeds)}
            found["groups"] = [
                {"settings": {}, "beta": self.learner.beta, "optimism": self.learner.optimism, "exact": self._optimum()}
                | self.recorded.statistics(self.recorded.groups[0])
            ]
        return found

    def summary(self, result: Mapping[str, Any], directory: Path) -> str:
        name = f"{self.title.env}, {self.title.learner}"
        if self.many:
            seeds = f"seeds {self.seeds[0]} to {self.seeds[-1]}"
            lines = ["", *one_group(name, seeds, self.recorded.names, result)]
        else:
            of = at(self.learner.beta, self.learner.optimism)
            lines = headline(f"{name}, {of}, seed {self.title.seed}", result)
            exact = self._optimum()
            lines.append(f"{'':18}{'prior':>12}{'learnt':>12}" + f"{'optimal':>12}" * bool(exact))
            prior = {"theta": -self.first["objective"]} if "objective" in self.first else {}
            now = {"theta": result["theta"]} | {name: values[0] for name, values in self.last.items()}
            for one, value in now.items():
                if value is None or not np.isfinite(value):
                    continue
                before = (prior | self.first).get(one)
                cells = [f"{'-':>12}" if before is None else f"{float(before[0]):12.5g}", f"{float(value):12.5g}"]
                cells += [f"{exact[one]:12.5g}"] if one in exact else []
                lines.append(f"{one.replace('_', ' '):18}" + "".join(cells))
        rate = result["n_steps"] * len(self.seeds) / max(result["seconds_learning"], 1e-3)
        lines.append(f"{'steps':18}{result['n_steps']:,} of {plural(len(self.seeds), 'seed')} ({rate:,.0f} a second)")
        return "\n".join([*lines, *last_rows(result, directory)])


def _each(state: NetworkState | SeedsState) -> tuple[NetworkState, ...]:
    return state.each if isinstance(state, SeedsState) else (state,)


def network_parts(
    cfg: DictConfig, settings: EvaluationSettings, many: bool
) -> tuple[Any, BoxProblem, Any, NetworkRecorder, dict[str, Any]]:
    """Learner, problem, experience, recorder and hyperparameters of the run ``cfg``. Raises InputError."""
    if cfg.vary:
        raise InputError("vary", dict(cfg.vary), "{}, for learners with networks: sweep with -m learner.KEY=A,B")
    problem = make_network_problem(cfg)
    learner: NetworkLearner = made(cfg.learner, resolve(cfg.learner["class"], "learner.class"), "learner")
    learner = suited(learner, problem)
    learner.check(problem)
    truth = None
    kind = TRUTHS.get(str(cfg.env.get("id")))
    if kind is not None and settings.certify:
        truth = kind(float(learner.beta), float(learner.optimism))
    seeds = tuple(cfg.seed + i for i in range(cfg.n_replicas))
    experience: list[Live | Recorded] = [Live(problem, seed) for seed in seeds]
    recorded = _recorded(cfg.experience, problem)
    if recorded is not None:
        experience = [Recorded(recorded, seed) for seed in seeds]
    title = Title(cfg.env.name, cfg.learner.name, cfg.seed)
    recorder = NetworkRecorder(learner, problem, truth, seeds, settings, title, many, recorded is None)
    told = {} if recorded is None else {"n_experience": len(recorded)}
    if many:
        return Seeds(learner, seeds, cfg.threads or os.cpu_count() or 1), problem, experience, recorder, told
    return learner, problem, experience[0], recorder, told


def _recorded(cfg: DictConfig, problem: BoxProblem) -> Steps | None:
    """The tuples of group ``experience``; None where the environment is stepped. Raises InputError."""
    if cfg.name == "simulate":
        return None
    if cfg.name != "recorded":
        allowed = "simulate (learners with networks step the environment themselves) or recorded"
        raise InputError("experience", cfg.name, allowed)
    with group("experience"):
        steps = Steps.load(str(cfg.path))
        steps.check(problem)
        return steps


def network_digest(experience: Any) -> int | None:  # of one learner, or of each of several
    """A checksum of recorded tuples; None where environments are stepped."""
    one = experience[0] if isinstance(experience, list) else experience
    return one.steps.checksum() if isinstance(one, Recorded) else None
