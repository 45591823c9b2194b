"""The recorder of a run of replicas: statistics per group of the same settings, bands, ``replicas.npz``."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from erl_torch import checks, pictures
from erl_torch.empirical import reservations
from erl_torch.empirical.reservations import Counted, Reservation
from erl_torch.empirical.uncertainty import Estimate
from erl_torch.envs import grid_pictures
from erl_torch.evaluation import Judge, evaluate
from erl_torch.experience.collect import COLUMN_BYTES
from erl_torch.experience.log import Log
from erl_torch.experience.simulation import KEEP_BYTES, ReplicaExperience, Simulation, longest, streams_of
from erl_torch.experience.transitions import Transitions
from erl_torch.files import write_png
from erl_torch.labels import NUMBERS, Names
from erl_torch.learners.learner import NonFiniteError, StreamLearner
from erl_torch.learners.replicas import Replicas, ReplicaSolution, ReplicaState
from erl_torch.log.quantities import with_own
from erl_torch.log.tensorboard import Board, Boards, replica_layout
from erl_torch.mdp.tabular import TabularMDP, check_policy
from erl_torch.notes import note
from erl_torch.problem import Problem
from erl_torch.rng import streams
from erl_torch.run.checkpoint import Content
from erl_torch.run.dial import Learnt, dial_picture, exact_line
from erl_torch.run.groups import MOST_LOGGED, Group, Record, setting_text, statistics, worth_of
from erl_torch.run.identity import plain
from erl_torch.run.judge import (
    SMALL,
    DataJudge,
    EvaluationSettings,
    data_judge,
    episode_model,
    judging_model,
    of_data,
)
from erl_torch.run.loop import Outcome, Row, SafePoint
from erl_torch.run.report import Title, at, end_reward, ended_as, last_rows, plural, versions
from erl_torch.run.verdict import verdict_of_replicas
from erl_torch.solution import Status
from erl_torch.solvers import solve_soft_bellman

MOST_LETTERS = 64  # of a setting that is text, in ``replicas.npz``
WORST_FIRST = (
    Status.NON_FINITE,
    Status.STOPPED,
    Status.ILL_POSED,
    Status.NO_SINGLE_RATE,
    Status.PSI_LIMIT,
    Status.STEP_LIMIT,
    Status.STAGNATED,
    Status.REDUCIBLE,
    Status.UNCERTIFIED,
    Status.COMPLETED,
    Status.CONVERGED,
)
FEW = 24  # replicas whose simulated streams are sampled once more, to hold theta against what they say


@dataclass(eq=False)
class ReplicaRecorder:
    """``erl_torch.run.loop.Recorder`` of replicas.

    Args:
        replicas, problem, experience: as of the run.
        groups: of the same settings, in the order of the replicas.
        seeds: one per replica.
        vary: the values of the settings that vary, by name.
        settings: what is measured.
        title: names, for result, pictures and summary.
        safe_point: called between streams that are read; may raise.
        log: where it is all that there is.
    """

    replicas: Replicas
    problem: Problem
    experience: ReplicaExperience
    groups: Sequence[Group]
    seeds: Sequence[int]
    vary: Mapping[str, Any]
    settings: EvaluationSettings
    title: Title
    safe_point: SafePoint
    log: Log | None = None

    def __post_init__(self) -> None:
        learners = self.replicas.learners
        betas = [(learner.beta, learner.optimism) for learner in learners]
        self.judges = Judges(
            self.problem,
            self.settings,
            betas,
            self.seeds,
            self.replicas.workers,
            _judges_of(self.problem, self.experience),
        )
        texts, self.data = reservations_of(
            self.experience,
            learners,
            self.problem.prior,
            self.judges.model,
            self.settings.certify,
            self.safe_point,
            self.problem.names,
        )
        for text in texts:
            note(text)
        dial = [(group.beta, group.optimism) for group in self.groups]
        self.proven: dict[tuple[float, float], tuple[float, float] | None] = {}  # of theta*, by beta and optimism
        found = {each: self._optimum(*each) for each in dict.fromkeys(dial)}
        self.optima = [found[each] for each in dial]
        self.table = with_own(learners[0].quantities)
        self.recorded = Record(self.groups, self.optima, self.table)
        self.first: dict[str, np.ndarray] = {}

    def _optimum(self, beta: float, optimism: float) -> dict[str, float]:
        """Figures of the optimum of a small known model, by quantity; none where there is none."""
        model = self.judges.model
        if model is None or not self.settings.certify or model.n_states > SMALL:
            return {}
        optimum = solve_soft_bellman(model, beta, self.problem.prior, optimism=optimism)
        if optimum.status is not Status.CONVERGED or optimum.theta is None:
            return {}
        self.proven[beta, optimism] = optimum.theta_bounds
        figures = {"theta": optimum.theta, "delta_max": optimum.reward_bias_max, "objective": -optimum.theta}
        if self.judges.of_dial:
            figures["objective_real"] = self.judges.of_model.objective(optimum.policy.numpy(), beta)
        return figures | self.judges.rewards(optimum.policy.numpy())

    # -- records --------------------------------------------------------------------------------------

    def begin(self) -> None:
        self.first = self.judges(np.repeat(self.problem.prior[None], len(self.replicas), axis=0), True)

    @property
    def shape(self) -> tuple[int, ...]:
        return (len(self.replicas),)

    def boards(self, alone: bool) -> Boards:
        metrics = self.replicas.learners[0].start(self.problem).metrics()
        optima = dict(zip((group.name for group in self.groups[:MOST_LOGGED]), self.optima, strict=False))
        return replica_layout(optima, [*metrics, *self.first], self.table)

    def open(self, board: Board, goes_on: bool) -> None:
        if not goes_on:
            self.recorded.add(0, self.first, board)

    def check(self, state: ReplicaState, row: Row) -> None:
        """Replicas that are lost are told by ``state.failures``; the others go on."""

    def record(self, state: ReplicaState, row: Row, milestone: str, board: Board) -> None:
        measured = {**row, **self.judges(state.policy.numpy(), bool(milestone))}
        alive = np.array([r not in state.failures for r in range(len(self.replicas))])
        self.recorded.add(state.n_tuples, measured, board, alive)

    def line(self) -> str:
        return self.recorded.line()

    # -- checkpoints ----------------------------------------------------------------------------------

    def content(self) -> Content:
        return {"record": self.recorded.content(), "evaluation": self.judges.generators(), "first": self.first}

    def restore(self, content: Content) -> None:
        self.first = content["first"]
        self.recorded.restore(content["record"])
        self.judges.restore(content["evaluation"])

    def mark(self) -> Content:
        return {"lengths": self.recorded.lengths(), "evaluation": self.judges.generators()}

    def back(self, mark: Content) -> None:
        self.recorded.cut(mark["lengths"])
        self.judges.restore(mark["evaluation"])

    # -- the end --------------------------------------------------------------------------------------

    def finish(self, outcome: Outcome[ReplicaState], solution: ReplicaSolution, board: Board) -> ReplicaSolution:
        step = outcome.state.n_tuples
        lost = np.isin(np.arange(len(self.replicas)), list(solution.failures))
        self.recorded.lose(lost)
        if self.judges.plays and self.recorded.steps.get("return", [step])[-1] != step:
            alive = np.array([r not in outcome.state.failures for r in range(len(self.replicas))])
            self.recorded.add(step, self.judges(outcome.state.policy.numpy(), True), board, alive)
        per_setting = " of each setting" if len(self.groups) > 1 else ""
        title = f"{self.title.env}, {self.title.learner}: {plural(self._n_each, 'replica')}{per_setting}"
        title += f", {lost.sum()} lost" * bool(lost.any())
        drawn = [("bands", self.recorded.curves(), "tuples streamed, each replica", title)]
        key, panels = self.recorded.sweep()
        if key:
            drawn.append(("sweep", panels, key, f"{title}, at the end"))
        axes = {one.name: one.axis for one in with_own(self.replicas.learners[0].quantities)}
        for name, panels, x_label, heading in drawn:
            markers = name == "sweep"
            whole = pictures.bands({axes[k]: v for k, v in panels.items()}, x_label, heading, markers)
            write_png(board.directory / f"{name}.png", whole)
            for k, lines in panels.items():  # on TensorBoard's small cards one panel can be read
                card = pictures.bands({axes[k]: lines}, x_label, heading, markers, card=True)
                board.picture(f"{name}/{k}", card, step)
        self._draw_dial(solution, title, board, step)
        rate = outcome.state.work / max(outcome.seconds, 1e-9)
        board.scalars({"time/tuples_per_second": rate}, step)
        board.scalars(self.recorded.final(), step)
        board.texts({"answer": verdict_of_replicas(self._away(solution))})
        for text in reservations.of_replicas(self._outcomes(solution)):
            note(text)
        states, actions = self.problem.names
        named = (replace(one, state_labels=states, action_labels=actions) for one in solution.solutions)
        return ReplicaSolution(tuple(named), solution.failures)

    def _draw_dial(self, solution: ReplicaSolution, title: str, board: Board, step: int) -> None:
        """``dial.png``, where optimism alone varies and the model is small."""
        model = self.judges.model
        if list(self.groups[0].settings) != ["optimism"] or model is None or model.n_states > SMALL:
            return
        learnt = []
        for group in self.groups:
            own = [solution.solutions[r] for r in np.arange(len(self.replicas))[group.members]]
            theta = np.array([np.nan if one.theta is None else one.theta for one in own])
            learnt.append(Learnt(group.optimism, theta, np.stack([one.policy.numpy() for one in own])))
        grid = None if self.problem.env is None else grid_pictures.grid_of(self.problem.env)
        values = [group.optimism for group in self.groups]
        line = exact_line(model, self.groups[0].beta, self.problem.prior, values, grid)
        picture = dial_picture(learnt, line, model, grid, f"{title}, beta {self.groups[0].beta:g}")
        write_png(board.directory / "dial.png", picture)
        board.picture("dial", picture, step)

    @property
    def _n_each(self) -> int:
        """Replicas of each group, at most."""
        return max(len(np.arange(len(self.replicas))[group.members]) for group in self.groups)

    def _outcomes(self, solution: ReplicaSolution) -> list[list[Reservation]]:
        """How each replica ended, and what its theta shows."""
        exact = self.judges.model is not None
        rows = self.recorded.rows["objective"] if exact else [np.full(len(solution), np.nan)]
        return [
            reservations.of_outcome(one.status, one.message, float(learnt), float(prior))
            + reservations.of_theta(one.theta, *against, self.proven.get((of.beta, of.optimism)))
            for one, of, learnt, prior, against in zip(
                solution.solutions, self.replicas.learners, rows[-1], rows[0], self.data, strict=True
            )
        ]

    def save(self, solution: ReplicaSolution, directory: Path) -> None:
        varied = {}
        for key in self.groups[0].settings:
            own = [group.settings[key] for group in self.groups]
            column = np.empty(len(self.replicas), None if all(map(checks.is_number, own)) else f"U{MOST_LETTERS}")
            for group, value in zip(self.groups, own, strict=True):
                column[group.members] = value if column.dtype.kind == "f" else setting_text(value)
            varied[f"vary/{key}"] = column
        more = self.recorded.arrays() | {"seed": np.array(self.seeds)} | varied
        solution.save(directory / "replicas.npz", more)

    def failed(self, solution: ReplicaSolution) -> NonFiniteError | None:
        """The first failure, with how many there are."""
        if not solution.failures:
            return None
        r, error = min(solution.failures.items())
        n_failed, n = len(solution.failures), len(self.replicas)
        others = f" ({n_failed} of {n} replicas ended so)" if n_failed > 1 else ""
        beta = self.replicas.learners[r].beta
        return NonFiniteError(error.step, f"replica {r} (seed {self.seeds[r]}, beta {beta:g}): {error.cause}{others}")

    def result(self, outcome: Outcome[ReplicaState], solution: ReplicaSolution) -> dict[str, Any]:
        stopped = outcome.stopped
        rows = [self.recorded.statistics(group) for group in self.groups]
        return {
            "env": self.title.env,
            "learner": self.title.learner,
            "seed": int(self.seeds[0]),
            "n_replicas": self._n_each,
            "vary": {key: plain(f"vary.{key}", values, 1) for key, values in self.vary.items()},
            "status": Status.STOPPED.name.lower() if stopped else _status(solution),
            "message": f"{type(stopped).__name__}: {stopped}" if isinstance(stopped, Exception) else "",
            "failures": {str(r): str(error) for r, error in solution.failures.items()},
            "objective": max(worth_of(rows).values(), default=None),  # of the best group
            "groups": [
                {
                    "settings": {k: plain(k, v, 1) for k, v in group.settings.items()},
                    "beta": group.beta,
                    "optimism": group.optimism,
                    "exact": optimum,
                    **row,
                }
                for group, optimum, row in zip(self.groups, self.optima, rows, strict=True)
            ],
            "data_half_widths": self._half_widths(solution),
            "n_experience": longest(self.experience),
            "n_tuples": outcome.state.work,
            "end_reward": end_reward(self.problem, self.log),
            "seconds_learning": round(outcome.seconds, 3),
            "versions": versions(),
            **({} if self.log is None else {"log": self.log.report.content()}),
        }

    def _seeds_text(self) -> str:
        """The seeds of each group, where all have the same; else all that there are."""
        by_group = [[*np.array(self.seeds)[group.members]] for group in self.groups]
        same = all(own == by_group[0] for own in by_group)
        seeds = sorted(set(by_group[0] if same else self.seeds))
        low, high = seeds[0], seeds[-1]
        if len(seeds) == 1:
            text = f"seed {low}"
        elif len(seeds) == high - low + 1:
            text = f"seeds {low} to {high}"
        else:
            text = f"{len(seeds)} seeds from {low} to {high}"
        return f"{text} each" if same and len(self.groups) > 1 else text

    def _half_widths(self, solution: ReplicaSolution) -> dict[str, float] | None:
        """Statistics of how far each theta is from what its own stream says; None where no stream has an interval."""
        finite = np.array([x for x in self._away(solution) if np.isfinite(x)])
        return statistics(finite) | {"replicas": len(finite)} if finite.size else None

    def _away(self, solution: ReplicaSolution) -> list[float]:
        """Of the replicas that are not lost."""
        pairs = enumerate(zip(solution.solutions, self.data, strict=True))
        return [
            reservations.half_widths(one.theta, data.estimate) for r, (one, data) in pairs if r not in solution.failures
        ]

    def summary(self, result: Mapping[str, Any], directory: Path) -> str:
        name = f"{self.title.env}, {self.title.learner}"
        seeds = self._seeds_text()
        if len(self.groups) == 1:
            lines = ["", *one_group(name, seeds, self.recorded.names, result)]
        else:
            lines = ["", *_many_groups(name, seeds, self.groups, result)]
        if (away := result["data_half_widths"]) is not None:
            lines.append(
                f"{'the data say':18}theta is off by {away['median']:.3g} half widths of the 95% interval of its own "
                f"stream (median; at most {away['max']:.3g}; {away['replicas']} of {len(self.replicas)} streams have "
                "one)"
            )
        rate = result["n_tuples"] / max(result["seconds_learning"], 1e-3) / 1e6
        lines.append(f"{'tuples streamed':18}{result['n_tuples']:,} ({rate:.3g} M/s)")
        return "\n".join([*lines, *last_rows(result, directory)])


def _status(solution: ReplicaSolution) -> str:
    """The worst of all replicas'."""
    return min((one.status for one in solution.solutions), key=WORST_FIRST.index).name.lower()


# -- what policies and streams are held against ------------------------------------------------------


class Judges:
    """Figures of the policies of all replicas: exact ones of the model, and episodes played at milestones.

    ``dial``: (beta, optimism) of each.
    """

    def __init__(
        self,
        problem: Problem,
        settings: EvaluationSettings,
        dial: Sequence[tuple[float, float]],
        seeds: Sequence[int],
        threads: int,
        of_data: Sequence[DataJudge | None] = (),
    ) -> None:
        self.of_data = list(of_data)
        self.problem, self.dial, self.n_episodes, self.threads = problem, dial, settings.n_episodes, threads
        self.rngs = [streams(seed).evaluation for seed in seeds]
        self.model = judging_model(problem, settings)
        self.episode = None if self.model is None else episode_model(problem)

    @property
    def of_dial(self) -> bool:
        """Whether the real world is another than that of an objective."""
        return any(optimism for _, optimism in self.dial)

    @property
    def plays(self) -> bool:
        """Whether figures come from episodes that are played, at milestones and at the end."""
        return self.episode is None and self.problem.env is not None

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
        return Judge(self.model, self.problem.prior, self.problem.horizon)

    @functools.cached_property
    def of_episode(self) -> Judge:
        """Of the episodes' model that there is."""
        assert self.episode is not None
        return (
            self.of_model
            if self.episode is self.model
            else Judge(self.episode, self.problem.prior, self.problem.horizon)
        )

    @functools.cached_property
    def of_success(self) -> Judge | None:
        """Of the episodes' model with a reward of 1 for a success; None where it is not known."""
        if self.episode is None or self.problem.success is None:
            return None
        return Judge(replace(self.episode, reward=self.problem.success), self.problem.prior, self.problem.horizon)

    def rewards(self, policy: np.ndarray) -> dict[str, float]:
        """Reward per step of a policy [S, A], and return of an episode where its model is known."""
        figures = {"reward_per_step": self.of_model.reward_per_step(policy)}
        if self.episode is not None:
            figures["return"] = self.problem.horizon * self.of_episode.reward_per_step(policy)
        if self.of_success is not None:
            figures["success_rate"] = self.problem.horizon * self.of_success.reward_per_step(policy)
        return figures

    def __call__(self, policies: np.ndarray, milestone: bool) -> dict[str, np.ndarray]:
        """Figures of policies [R, S, A], [R] each."""
        figures: dict[str, np.ndarray] = {}

        def each(figure: Callable[[int], float]) -> np.ndarray:
            with ThreadPoolExecutor(self.threads) as pool:
                return np.array(list(pool.map(figure, range(len(policies)))))

        if self.model is not None:
            figures["reward_per_step"] = each(lambda r: self.of_model.reward_per_step(policies[r]))
            of, dial = self.of_model, self.dial
            figures["objective"] = each(lambda r: of.objective(policies[r], dial[r][0], optimism=dial[r][1]))
            if self.of_dial:
                figures["objective_real"] = each(lambda r: of.objective(policies[r], dial[r][0]))
        if self.episode is not None:
            if self.episode is self.model:
                figures["return"] = self.problem.horizon * figures["reward_per_step"]
            else:
                figures["return"] = self.problem.horizon * each(lambda r: self.of_episode.reward_per_step(policies[r]))
            if (succeeds := self.of_success) is not None:
                figures["success_rate"] = self.problem.horizon * each(lambda r: succeeds.reward_per_step(policies[r]))
        elif self.problem.env is None:
            figures |= self._of_counts(policies)
        elif milestone:
            figures |= self._played(policies)
        return figures

    def _of_counts(self, policies: np.ndarray) -> dict[str, np.ndarray]:
        """Objectives in the models of the counts."""
        judges = self.of_data * len(policies) if len(self.of_data) == 1 else self.of_data
        told = list(zip(judges, policies, self.dial, strict=True))

        def objectives(real: bool) -> np.ndarray:
            return np.array(
                [
                    np.nan if judge is None else judge.objective(policy, beta, optimism=0.0 if real else optimism)
                    for judge, policy, (beta, optimism) in told
                ]
            )

        return {"objective": objectives(False)} | ({"objective_real": objectives(True)} if self.of_dial else {})

    def _played(self, policies: np.ndarray) -> dict[str, np.ndarray]:
        """Of episodes, which tell of the real world alone."""
        p, env = self.problem, self.problem.env
        assert env is not None
        played = [
            evaluate(env, policy, beta, rng, self.n_episodes, p.horizon, p.prior, ends=p.ends)
            for policy, (beta, _), rng in zip(policies, self.dial, self.rngs, strict=True)
        ]
        figures = {"return": np.array([one.mean_return for one in played])}
        if p.ends is not None:
            figures["success_rate"] = np.array([one.success_rate for one in played])
        if self.model is None:
            figures["reward_per_step"] = np.array([one.reward_per_step for one in played])
            real = np.array([one.objective for one in played])
            figures["objective"] = np.where([optimism != 0 for _, optimism in self.dial], np.nan, real)
            if self.of_dial:
                figures["objective_real"] = real
        return figures


def _judges_of(problem: Problem, experience: ReplicaExperience) -> list[DataJudge | None]:
    """What the streams themselves say of policies, one or one per replica, where there is nothing else; else none."""
    if problem.env is not None or isinstance(experience, Simulation):
        return []
    return [data_judge(data, problem.prior) for data in streams_of(experience)]


class Data(NamedTuple):
    """What theta is held against once it is learnt."""

    rewards: tuple[float, float]  # (low, high)
    estimate: Estimate | None


def reservations_of(
    experience: ReplicaExperience,
    learners: Sequence[StreamLearner[Any, Any]],
    prior: np.ndarray,
    model: TabularMDP | None,
    certify: bool,
    safe_point: SafePoint,
    names: Names = NUMBERS,
) -> tuple[list[str], list[Data]]:
    """(notes on what streams do not allow the learners, what theta is to be held against); each stream is read once.
    Theta is not held against the model's."""
    shape = prior.shape
    model = None if model is None else model.restricted(prior > 0)

    def data_of(here: Counted, learner: StreamLearner[Any, Any]) -> Data:
        of = learner.beta, prior, learner.optimism, learner.reward_noise
        return Data(here.tally.reward_range, of_data(here.model, *of) if certify else None)

    if isinstance(experience, Simulation):  # of the model itself: it is not held against the model
        behaviour = experience.behaviour_policy
        rewards = experience.mdp.restricted(prior > 0).reward_range
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
            counted[id(data)] = reservations.count(data, shape[0], shape[1], next_actions, names)
        here = counted[id(data)]
        against = (
            [] if model is None else reservations.of_model(here, model) + reservations.of_states(here.tally, model)
        )
        held.append(data_of(here, learner))
        of_it = reservations.of_stream(here, learner, prior) + reservations.of_estimate(held[-1].estimate)
        found.append(of_it + against)
    return reservations.of_replicas(found), held


# -- tables of the summary ----------------------------------------------------------------------------


def one_group(first: str, seeds: str, names: Sequence[str], result: Mapping[str, Any]) -> Iterator[str]:
    """Lines of the one group of ``result``, of ``seeds``; ``first`` says whose."""
    (group,) = result["groups"]
    of = at(group["beta"], group["optimism"])
    yield f"{first}, {of}, {plural(result['n_replicas'], 'replica')} ({seeds}): {ended_as(result)}"
    yield f"{'':18}{'mean':>12}{'quartiles':>26}{'extremes':>26}{'exact':>12}"
    for name in names:
        found = group.get(name)
        if found:
            quartiles = f"{found['q25']:.5g} to {found['q75']:.5g}"
            extremes = f"{found['min']:.5g} to {found['max']:.5g}"
            known = f"{group['exact'][name]:12.6g}" if name in group["exact"] else ""
            yield f"{name.replace('_', ' '):18}{found['mean']:12.6g}{quartiles:>26}{extremes:>26}{known}"


def _many_groups(first: str, seeds: str, groups: Sequence[Group], result: Mapping[str, Any]) -> Iterator[str]:
    yield f"{first}, {len(groups)} settings, {seeds}: {ended_as(result)}"
    width = max(len(group.title) for group in groups) + 2
    yield f"{'':{width}}{'theta':>11}{'quartiles':>24}{'exact':>11}{'objective':>12}{'at most':>11}"
    shown = result["groups"] if len(groups) <= 40 else [*result["groups"][:20], None, *result["groups"][-19:]]
    for found in shown:
        if found is None:
            yield "..."
            continue
        theta, objective, best = found.get("theta"), found.get("objective"), found["exact"]
        title = ", ".join(f"{key} {setting_text(value)}" for key, value in found["settings"].items())
        cells = [
            f"{theta['mean']:.6g}" if theta else "-",
            f"{theta['q25']:.5g} to {theta['q75']:.5g}" if theta else "-",
            f"{best['theta']:.6g}" if best else "-",
            f"{objective['mean']:.6g}" if objective else "-",
            f"{best['objective']:.6g}" if best else "-",
        ]
        widths = (11, 24, 11, 12, 11)
        yield f"{title:{width}}" + "".join(f"{cell:>{w}}" for cell, w in zip(cells, widths, strict=True))
