"""The recorder of a run of one learner: exact figures or played episodes, pictures, certificate, ``solution.npz``."""

from __future__ import annotations

import csv
import functools
import io
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from erl_torch import checks
from erl_torch.checks import InputError
from erl_torch.empirical import reservations
from erl_torch.empirical.reservations import Reservation
from erl_torch.empirical.uncertainty import Estimate
from erl_torch.envs import grid_pictures
from erl_torch.evaluation import Evaluation, evaluate
from erl_torch.experience.experience import Experience
from erl_torch.experience.log import Log
from erl_torch.files import write_bytes
from erl_torch.learners.learner import NonFiniteError, TabularLearner, TabularState, check_numbers
from erl_torch.log.quantities import QUANTITIES, results, tagged, with_own
from erl_torch.log.tensorboard import Board, Boards, layout
from erl_torch.notes import note
from erl_torch.problem import Policy, Problem
from erl_torch.run.checkpoint import Content
from erl_torch.run.judge import DataJudge, EvaluationSettings, judging_model, of_data
from erl_torch.run.loop import Outcome, Row
from erl_torch.run.report import (
    Title,
    at,
    data_tags,
    end_reward,
    evaluation_tags,
    figures,
    headline,
    last_rows,
    mean_return,
    optimal_tags,
    success_rate,
    versions,
)
from erl_torch.run.verdict import verdict
from erl_torch.solution import Solution, proven
from erl_torch.solvers import solve_soft_bellman
from erl_torch.solvers.policy import objective
from erl_torch.solvers.problem import BellmanProblem
from erl_torch.solvers.soft_bellman import with_bounds

NO_FIGURES: dict[str, float | None] = {"reward_per_step": None, "objective": None, "return": None}
SAID = ("reward_per_step", "objective")  # at milestones


@dataclass(eq=False)
class SingleRecorder:
    """``erl_torch.run.loop.Recorder`` of one learner.

    Args:
        learner, problem, experience: as of the run.
        settings: what is measured.
        rng: draws the episodes that are played.
        title: names, for result and summary.
        n_skipped: bad tuples that were left out of the experience.
        log: where it is all that there is.
    """

    learner: TabularLearner[Any]
    problem: Problem
    experience: Experience | None
    settings: EvaluationSettings
    rng: np.random.Generator
    title: Title
    n_skipped: int = 0
    log: Log | None = None

    def __post_init__(self) -> None:
        self.model = judging_model(self.problem, self.settings)
        self.start: TabularState = self.learner.start(self.problem)
        if not isinstance(self.start.policy, torch.Tensor):
            raise InputError("policy of the learner", type(self.start.policy).__name__, "a torch.Tensor [S, A]")
        self.optimum = self._optimum() if self.settings.certify else None
        self.estimate = self._estimate() if self.settings.certify else None
        for _, text in self._reservations():
            note(text)
        self.first: Evaluation
        self.last: Evaluation

    # -- what it is held against ----------------------------------------------------------------------

    def _optimum(self) -> Solution | None:
        """The exact answer to the model; None where there is no model, or the run itself finds it."""
        if self.model is None or self.learner.needs_model:
            return None
        try:
            return solve_soft_bellman(self.model, self.learner.beta, self.problem.prior, optimism=self.learner.optimism)
        except (MemoryError, RuntimeError) as error:  # what factorisations need shows as they go
            if not checks.out_of_memory(error):
                raise
            allowed = f"false: the exact solution of this model needs more memory than there is ({error})"
            raise InputError("evaluation.certify", "true", allowed) from error

    def _estimate(self) -> Estimate | None:
        """theta* with its error, as the counts of the stream alone have it; None where there is no stream."""
        if self.counts is None:
            return None
        one = self.learner
        return of_data(self.counts.model, one.beta, self.problem.prior, one.optimism, one.reward_noise)

    @functools.cached_property
    def counts(self) -> reservations.Counted | None:
        """The stream as counts."""
        if self.experience is None:
            return None
        next_actions = self.learner.drawn_from_prior == "a_next"
        n_states, n_actions = self.problem.prior.shape
        return reservations.count(self.experience, n_states, n_actions, next_actions, self.problem.names)

    @functools.cached_property
    def of_data(self) -> DataJudge | None:
        """What the stream itself says of policies."""
        if self.counts is None or self.counts.model is None:
            return None
        return DataJudge(self.counts.model, self.problem.prior)

    def _reservations(self) -> list[Reservation]:
        """What the stream does not allow the learner, and where it contradicts the model."""
        if self.counts is None:
            return []
        noted = reservations.of_stream(self.counts, self.learner, self.problem.prior)
        noted += reservations.of_estimate(self.estimate)
        if self.model is not None:
            bounds = None if self.optimum is None else self.optimum.theta_bounds
            model = self.model.restricted(self.problem.prior > 0)
            noted += reservations.of_model(self.counts, model, self.estimate, bounds)
            noted += reservations.of_states(self.counts.tally, model)
        return noted

    def _measure(self, policy: Policy) -> Evaluation:
        p, e, beta, optimism = self.problem, self.settings, self.learner.beta, self.learner.optimism
        exact = succeeds = None
        if p.env is None:
            judge, table = self.of_data, policy.detach().cpu().numpy()
            known = np.nan if judge is None else judge.objective(table, beta, optimism=optimism)
            real = np.nan if judge is None or not optimism else judge.objective(table, beta)
            return Evaluation(np.nan, np.nan, known, objective_real=real)
        if p.episode is not None:
            exact = functools.partial(mean_return, p.episode, p.horizon)
            if p.success is not None:
                succeeds = functools.partial(success_rate, p.episode, p.success, p.horizon)
        steps = e.n_episodes, p.horizon
        found = evaluate(p.env, policy, beta, self.rng, *steps, p.prior, self.model, exact, succeeds, p.ends)
        if not optimism:
            return found
        # Episodes that are played tell of the real world alone.
        nested = np.nan
        if self.model is not None:
            nested = objective(self.model, policy.detach().cpu().numpy(), p.prior, beta, optimism=optimism)
        return found._replace(objective=nested, objective_real=found.objective)

    # -- records --------------------------------------------------------------------------------------

    def begin(self) -> None:
        self.first = self.last = self._measure(self.start.policy)

    @functools.cached_property
    def _constant(self) -> dict[str, float]:
        """Tags of what does not change."""
        return evaluation_tags(self.first, "prior") | self._optimal(self.optimum) | data_tags(self.estimate)

    def _optimal(self, solution: Solution | None) -> dict[str, float]:
        return optimal_tags(solution, self.model, self.problem)

    @property
    def shape(self) -> tuple[int, ...]:
        return ()

    def boards(self, alone: bool) -> Boards:
        table = with_own(self.learner.quantities)
        return layout([*self._names(self.start), *evaluation_tags(self.first)], self._constant, table, alone)

    def open(self, board: Board, goes_on: bool) -> None:
        board.lines(self._constant)
        if not goes_on:
            board.record(self._tags(self.start, 0, self.start.metrics()), 0)
            self._draw(self.start, 0, "prior policy", board)

    def check(self, state: TabularState, row: Row) -> None:
        policy = state.policy if isinstance(state.policy, torch.Tensor) else None  # others are named in ``record``
        check_numbers(self.learner.position(state), row.get("theta"), policy)

    def record(self, state: TabularState, row: Row, milestone: str, board: Board) -> None:
        position = self.learner.position(state)
        policy = state.policy
        if not isinstance(policy, torch.Tensor) or policy.shape != self.problem.prior.shape:
            shape = list(self.problem.prior.shape)
            raise InputError("policy of the learner", type(policy).__name__, f"a torch.Tensor {shape}, in every epoch")
        self.last = self._measure(policy)
        board.record(self._tags(state, position, row), position)
        if milestone:
            self._draw(state, position, milestone, board)
        self._said = self._figures(row)

    def _names(self, state: TabularState) -> dict[str, float]:
        return tagged("learner", state.metrics())

    def _tags(self, state: TabularState, position: int, row: Row) -> dict[str, float]:
        # A solver has proven nothing at step 0; TensorBoard's band chart wants the same steps in all its tags.
        logged = {} if self.learner.needs_model and not position else tagged("learner", row)
        return {tag: value for tag, value in logged.items() if np.isfinite(value)} | evaluation_tags(self.last)

    def _draw(self, state: TabularState, position: int, title: str, board: Board) -> None:
        if not self.settings.pictures:
            return
        grid = None if self.problem.env is None else grid_pictures.grid_of(self.problem.env)
        names = self.problem.names
        heading = f"policy, {title}" if position else title
        policy = state.policy.cpu().numpy()
        board.picture("policy", grid_pictures.policy_picture(policy, grid, heading, names=names), position)
        if position and state.reward_bias is not None:
            bias = state.reward_bias.cpu().numpy()
            heading = f"reward bias, {title}"
            board.picture("reward_bias", grid_pictures.bias_picture(bias, grid, heading, names=names), position)

    def _figures(self, row: Row) -> str:
        if "theta_lower" in row:
            # A biasing iteration's own theta is optimistic: below theta* until the last.
            text = f"theta {row['theta']:.10f}  {proven((row['theta_lower'], row['theta_upper']), None)}  "
        else:
            text = f"rho {row['rho']:.4e}  " if "rho" in row else ""
            text += f"theta {row['theta']:.5f}  " if "theta" in row else ""
        text += f"delta max {row['delta_max']:.4f}  " if "delta_max" in row else ""
        measured = figures(self.last)
        found = [f"{name.replace('_', ' ')} {measured[name]:.4f}" for name in SAID if name in measured]
        return "  ".join([text.rstrip(), *found]).strip()

    def line(self) -> str:
        return self._said

    # -- checkpoints ----------------------------------------------------------------------------------

    def content(self) -> Content:
        return {"first": self.first, "last": self.last, "evaluation": self.rng.bit_generator.state}

    def restore(self, content: Content) -> None:
        self.first = content["first"]
        self.back(content)

    def mark(self) -> Content:
        return {"last": self.last, "evaluation": self.rng.bit_generator.state}

    def back(self, mark: Content) -> None:
        self.last = mark["last"]
        self.rng.bit_generator.state = mark["evaluation"]

    # -- the end --------------------------------------------------------------------------------------

    def finish(self, outcome: Outcome[TabularState], solution: Solution, board: Board) -> Solution:
        stopped, position = outcome.stopped, self.learner.position(outcome.state)
        if isinstance(stopped, NonFiniteError):
            solution = replace(solution, message=solution.message or str(stopped))
        elif isinstance(stopped, Exception):
            solution = replace(solution, message=f"{type(stopped).__name__}: {stopped}")
        if self.optimum is not None:
            assert self.model is not None
            bounds = self.optimum.theta_bounds
            assert bounds is not None
            posed = BellmanProblem.of(self.model, self.learner.beta, self.problem.prior, self.learner.optimism)
            solution = with_bounds(solution, posed, bounds, self.model)
        else:
            for step in (0, position):
                board.scalars(self._optimal(solution), step)
        exact = (self.last.objective, self.first.objective) if self.model is not None else (np.nan, np.nan)
        noted = reservations.of_outcome(solution.status, solution.message, *exact)
        if self.counts is not None:
            seen = self.counts.tally
            lacking = reservations.lacks_actions(seen, self.problem.prior)
            known = seen.reward_range, self.estimate, solution.theta_bounds, lacking
            noted += reservations.of_theta(solution.theta, *known)
        for _, text in noted:
            note(text)
        rate = position / max(outcome.seconds, 1e-9)
        board.scalars({f"time/{self.learner.unit}_per_second": rate}, position)
        final = {"theta": solution.theta, "gap": solution.gap}
        said = verdict([row.get("theta", np.nan) for row in outcome.history], solution, self.estimate)
        board.texts({"answer": said})
        ends = {name: value for name, value in final.items() if value is not None}
        board.scalars(tagged("Final", figures(self.last) | ends), position)
        names = self.problem.names
        return replace(solution, state_labels=names.states, action_labels=names.actions)

    def save(self, solution: Solution, directory: Path) -> None:
        solution.save(directory / "solution.npz")
        if self.log is not None:
            write_bytes(directory / "policy.csv", policy_table(solution.policy.numpy(), self.log).encode())

    def failed(self, solution: Solution) -> None:
        """The error has ended the run already."""

    def result(self, outcome: Outcome[TabularState], solution: Solution) -> dict[str, Any]:
        n_experience = 0 if self.experience is None else len(self.experience)
        estimate, counts = self.estimate, self.counts
        away = reservations.half_widths(solution.theta, estimate)
        data = None
        if estimate is not None:
            data = f"nothing: {estimate.withheld}" if np.isnan(estimate.value) else str(estimate)
        states_met = None
        if estimate is not None and counts is not None:
            visits = counts.tally.visits.reshape(self.problem.n_states, self.problem.n_actions)
            states_met = [int(visits.any(1).sum()), self.problem.n_states]
        rho = solution.rho if solution.rho and solution.rho < np.inf else None  # beyond double precision: theta tells
        delta_max = solution.reward_bias_max
        return {
            "env": self.title.env,
            "learner": self.title.learner,
            "beta": float(self.learner.beta),
            "optimism": float(self.learner.optimism),
            "seed": self.title.seed,
            "status": solution.status.name.lower(),
            "message": solution.message,
            **results({"theta": solution.theta, "rho": rho, "delta_max": delta_max} | NO_FIGURES | figures(self.last)),
            "theta_bounds": list(solution.theta_bounds) if solution.theta_bounds else None,
            "gap": solution.gap,
            "k": solution.k,
            "n_experience": n_experience,
            f"n_{self.learner.unit}": solution.n_steps,
            "end_reward": end_reward(self.problem, self.log),
            "seconds_learning": round(outcome.seconds, 3),
            "versions": versions(),
            "data": data,
            "data_smallest_visits": None if estimate is None or estimate.withheld else estimate.smallest_visits,
            "data_states": states_met,
            "data_half_widths": away if np.isfinite(away) else None,
            "n_skipped": self.n_skipped,
            **({} if self.log is None else {"log": self.log.report.content()}),
        }

    def summary(self, result: Mapping[str, Any], directory: Path) -> str:
        of_play = "" if self.model is not None else "  (the prior's: an estimate, of the episodes played)"
        if self.problem.env is None:
            of_play = "  (objectives and the prior's theta: of the model of the counts)"
        before = figures(self.first)
        if "objective" in before:
            before = {"theta": -self.first.objective, **before}
        logged = {*self.start.metrics(), *before, *figures(self.last)}
        rows = [
            (
                q.row,
                f"{before[q.name]:z12{q.digits}}" if q.name in before else f"{'-':>12}",
                f"{result[q.result]:z12{q.digits}}" + of_play * (q.name == "theta"),
            )
            for q in QUANTITIES
            if q.digits and q.name in logged and result[q.result] is not None
        ]
        of = at(self.learner.beta, self.learner.optimism)
        heading = f"{self.title.env}, {self.title.learner}, {of}, seed {self.title.seed}"
        lines = [
            *headline(heading, result),
            f"{'':18}{'prior':>12}{'learnt':>12}",
            *(f"{name:18}{prior}{learnt}" for name, prior, learnt in rows),
        ]
        if result["theta_bounds"] is not None:
            lines.append(f"{'proven':18}{proven(result['theta_bounds'], result['gap'])}")
        if result["data"]:
            lines.append(f"{'the data say':18}{result['data']}{_reach_of_data(result)}")
        done = result[f"n_{self.learner.unit}"]
        if result["n_experience"]:
            rate = done / max(result["seconds_learning"], 1e-3) / 1e6
            lines.append(f"{'tuples streamed':18}{done:,} (of {result['n_experience']:,}; {rate:.3g} M/s)")
        else:
            k = "" if result["k"] is None else f" (k = {result['k']})"
            lines.append(f"{'iterations':18}{done}{k}")
        return "\n".join([*lines, *last_rows(result, directory)])


def policy_table(policy: np.ndarray, log: Log) -> str:
    """The policy [S, A] as CSV: a line for each action that a state has, with its label, its prior, and its visits."""
    problem, text = log.problem, io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["state", "action", "probability", "prior", "visits"])
    state, action = (
        list(map(str, range(n))) if labels is None else labels.texts.tolist()
        for n, labels in ((problem.n_states, problem.state_labels), (problem.n_actions, problem.action_labels))
    )
    for s, a in np.argwhere(problem.prior > 0).tolist():
        row = float(policy[s, a]), float(problem.prior[s, a]), int(log.visits[s, a])
        writer.writerow([state[s], action[a], *row])
    return text.getvalue()


def _reach_of_data(result: Mapping[str, Any]) -> str:
    """What the interval of the data rests on, and how far the learnt theta is from it."""
    fewest, away, met = result["data_smallest_visits"], result["data_half_widths"], result["data_states"]
    text = ""
    if fewest is not None:
        states = "" if met is None or met[0] == met[1] else f"{met[0]:,} of {met[1]:,} states met, "
        text = f" (95%; {states}{fewest} visit{'s' * (fewest != 1)} or more of each pair that counts)"
    return text + (f"; learnt: {away:.2f} half widths from its middle" if away is not None and away > 1 else "")
