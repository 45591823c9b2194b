"""The run loop: a learner learns, a recorder writes, checkpoints are offered, until the learner is finished.

One loop for a single learner, for replicas and for exact solvers. What differs between them is their recorder's:
``erl_torch.run.single``, ``erl_torch.run.replicas``.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

import numpy as np
from tqdm import tqdm
from typing_extensions import TypeVar as Defaulting

from erl_torch.checks import InputError
from erl_torch.files import write_json
from erl_torch.learners.learner import Learner, NonFiniteError, State, columns
from erl_torch.log.event_file import PATTERN
from erl_torch.log.tensorboard import Board, Boards, of_sweep
from erl_torch.notes import note
from erl_torch.problem import Problem
from erl_torch.run.checkpoint import Checkpoints, Content, Ended, check_state, rows_of
from erl_torch.run.origin import texts

LONG, MOST = 5.0, 4.0  # seconds of evaluation, and of learning, from which on a line says so
SafePoint = Callable[[], None]
Row = Mapping[str, Any]  # of the history: ``metrics()`` of a state
S = TypeVar("S", bound=State)
E = TypeVar("E")
A = TypeVar("A")
P = Defaulting("P", default=Problem)


@dataclass
class Outcome(Generic[S]):
    """What a run has come to."""

    state: S
    history: list[Row] = field(default_factory=list)
    seconds: float = 0.0  # of learning
    stopped: BaseException | None = None  # what ended it before the learner was finished
    recorded: int = 0  # epochs at the last record


class Recorder(Protocol[S, A]):
    """What a run makes of the states of its learner: figures of their policies, records on the board, files.

    A run calls ``begin`` or ``restore``, then ``open`` with the ``boards``; ``record`` after epochs, and ``line`` at
    milestones; ``mark`` after each epoch, and ``back`` where one was cut short; ``content`` for a checkpoint; at the
    end ``finish``, ``save``, ``result``, ``summary``, ``failed``.
    """

    def begin(self) -> None:
        """Measure the prior policy; not called where a checkpoint is restored."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Of a metric: () of one learner, [R] of replicas."""

    def boards(self, alone: bool) -> Boards:
        """Charts of tab Custom Scalars, of a run that is ``alone`` or a job of a sweep."""

    def open(self, board: Board, goes_on: bool) -> None:
        """The record of the prior policy at step 0, unless the run ``goes_on`` from a checkpoint."""

    def check(self, state: S, row: Row) -> None:
        """Raise NonFiniteError where ``state`` is no longer of numbers: the one before is then the last good one."""

    def record(self, state: S, row: Row, milestone: str, board: Board) -> None:
        """Measure the policy of ``state`` and write; ``row`` is its ``metrics()``."""

    def line(self) -> str:
        """The last record, in a line that is said at milestones."""

    def content(self) -> Content:
        """All that a checkpoint keeps, by names of its own."""

    def restore(self, content: Content) -> None:
        """Go on from ``content``."""

    def mark(self) -> Content:
        """Where ``back`` leads: light, for it is taken after every epoch."""

    def back(self, mark: Content) -> None:
        """To the figures as they were at ``mark``."""

    def finish(self, outcome: Outcome[S], solution: A, board: Board) -> A:
        """The records of the end, and the solution with what is known of it."""

    def save(self, solution: A, directory: Path) -> None:
        """Write ``solution`` to the run directory."""

    def result(self, outcome: Outcome[S], solution: A) -> dict[str, Any]:
        """What ``result.json`` holds, but for the seconds and notes of the run."""

    def summary(self, result: Mapping[str, Any], directory: Path) -> str:
        """The text at the end."""

    def failed(self, solution: A) -> NonFiniteError | None:
        """What is to be raised of a run that went to its end, for learners that left the finite numbers."""


@dataclass(frozen=True, eq=False)
class Run(Generic[S, E, A, P]):
    """Everything that a run is made of.

    Args:
        learner: who learns.
        problem: what is learnt.
        experience: what it is learnt from; None of a learner that solves the model.
        digest: a checksum of the experience, which a checkpoint must share; None where its settings tell all.
        recorder: what is made of the states.
        saved: checkpoints, of the run directory.
        hyperparameters: by name, for tab HParams.
        configuration: the settings as YAML, for tab Text.
        every: epochs between records; milestones, and the last epoch, are always recorded.
        talks: progress bar, milestones and summary are shown.
        safe_point: called after every epoch; may raise SystemExit or KeyboardInterrupt.
        began: ``time.perf_counter()`` when the run began.
    """

    learner: Learner[S, E, A, P]
    problem: P
    experience: E | None
    digest: object
    recorder: Recorder[S, A]
    saved: Checkpoints
    hyperparameters: Mapping[str, int | float | str]
    configuration: str
    every: int
    talks: bool
    safe_point: SafePoint
    began: float

    def perform(self, notes: list[str]) -> tuple[A, dict[str, Any]]:
        """Go through the run, or what is left of it; returns the solution, and what ``result.json`` holds.

        Whatever ends it, what was learnt until then is written, and the error goes on to the caller.
        """
        saved, recorder, learner = self.saved, self.recorder, self.learner
        outcome = Outcome(learner.start(self.problem))
        _checked(outcome.state.metrics(), [], recorder.shape)
        if not learner.needs_model:
            check_state(outcome.state, learner.states, type(learner).__name__)
        checkpoint, began = saved.start(learner.states), self.began
        if checkpoint:
            if checkpoint["digest"] != self.digest:
                raise InputError("experience", "another stream", "the one that the run in its directory began with")
            rows: list[Row] = [*rows_of(checkpoint["history"])]
            outcome = Outcome(checkpoint["state"], rows, checkpoint["learning"], recorded=checkpoint["recorded"])
            recorder.restore(checkpoint)
            began -= checkpoint["seconds"]
        solution: A | None = None
        ended = Ended(lambda: solution is not None)
        with ended, saved.refusing(lambda: bool(outcome.history)):
            if not checkpoint:
                recorder.begin()
            mark = checkpoint["events"] if checkpoint else None
            boards = recorder.boards(not of_sweep(saved.directory))
            with Board(saved.directory, self.hyperparameters, boards, mark) as board:
                if not checkpoint:
                    board.texts(texts(self.configuration, saved.directory))
                recorder.open(board, checkpoint is not None)
                at = self._learn(outcome, checkpoint is not None, board, ended, began)
                learnt = self._content(outcome, board, began) | at  # before the end writes more
                try:
                    if len(outcome.history) > outcome.recorded:
                        recorder.record(outcome.state, outcome.history[-1], "", board)
                    solution = learner.solution(outcome.state, outcome.history, outcome.stopped)
                    solution = recorder.finish(outcome, solution, board)
                except BaseException:
                    self._keep(outcome, ended, lambda: learnt)
                    raise
                if isinstance(outcome.stopped, Exception) or recorder.failed(solution) is not None:
                    board.failed()
        assert solution is not None
        try:
            result = self._written(outcome, solution, ended, notes, began)
        except BaseException:
            self._keep(outcome, ended, lambda: learnt)
            raise
        if outcome.stopped is not None:
            raise outcome.stopped
        saved.clear()
        if (failure := recorder.failed(solution)) is not None:
            raise failure
        return solution, result

    def _written(
        self, outcome: Outcome[S], solution: A, ended: Ended, notes: list[str], began: float
    ) -> dict[str, Any]:
        """Write the solution and ``result.json``, and show the summary; what ``result.json`` holds."""
        recorder, saved = self.recorder, self.saved
        outcome.stopped = outcome.stopped or ended.error
        self._check_directory()
        recorder.save(solution, saved.directory)
        result = recorder.result(outcome, solution)
        if ended.error is not None:  # it goes on from the checkpoint
            result["status"] = "stopped"
            result["message"] = f"{type(ended.error).__name__}: {ended.error}"
        result["seconds"] = round(time.perf_counter() - began, 3)
        result["notes"] = notes
        result = {key: _finite(value) for key, value in result.items()}
        write_json(saved.directory / "result.json", result)
        if self.talks:
            print(recorder.summary(result, saved.directory))
        return result

    def _learn(self, outcome: Outcome[S], goes_on: bool, board: Board, ended: Ended, began: float) -> Content:
        """The loop. What ends it goes into ``outcome``; with nothing learnt, it is raised.

        Returns what a checkpoint must hold of the last epoch in the place of what there is now.
        """
        learner, recorder = self.learner, self.recorder

        def reached() -> Content:
            """What an epoch leaves when all is done that belongs to it: an error may come in the midst of that."""
            own = {"state": outcome.state, "n": len(outcome.history), "learning": outcome.seconds}
            return own | {"events": board.mark(), "recorder": recorder.mark(), "recorded": outcome.recorded}

        def content() -> Content:
            return self._content(outcome, board, began)

        last = reached()
        measuring, silent = 0.0, not self.talks
        try:
            with self._bar() as bar:
                bar.update(learner.work(outcome.state))
                states = learner.run(self.problem, self.experience, outcome.state if goes_on else None)
                for state in _timed(states, outcome):
                    row = _checked(state.metrics(), outcome.history, recorder.shape)
                    recorder.check(state, row)
                    outcome.state = state
                    outcome.history.append(row)
                    milestone = learner.milestone(state)
                    if milestone or len(outcome.history) % self.every == 0:
                        tick = time.perf_counter()
                        recorder.record(state, row, milestone, board)
                        outcome.recorded = len(outcome.history)
                        measuring += time.perf_counter() - tick
                    if not silent and measuring > max(LONG, MOST * outcome.seconds):
                        silent = True
                        text = f"{measuring:.0f} of {measuring + outcome.seconds:.0f} seconds went into evaluation"
                        remedy = f"evaluation.every={10 * self.every} measures policies less often"
                        tqdm.write(f"{text}: {remedy}", file=sys.stderr)
                    bar.set_postfix_str(learner.progress(state), refresh=False)
                    bar.update(learner.work(state) - bar.n)
                    if milestone and self.talks:
                        tqdm.write(f"{milestone}: {recorder.line()}", file=sys.stderr)
                    last = reached()
                    if not learner.needs_model:
                        self.saved.offer(learner.position(state), content)
                    self.safe_point()
        except (Exception, KeyboardInterrupt, SystemExit) as error:
            outcome.stopped, outcome.state, outcome.recorded = error, last["state"], last["recorded"]
            del outcome.history[last["n"] :]
            recorder.back(last["recorder"])
            if not outcome.history and not isinstance(error, (NonFiniteError, KeyboardInterrupt, SystemExit)):
                raise
            at = {"events": last["events"], "learning": last["learning"]}
            if not isinstance(error, NonFiniteError):
                self._keep(outcome, ended, lambda: content() | at)
            return at
        return {}

    def _content(self, outcome: Outcome[S], board: Board, began: float) -> Content:
        """What a checkpoint keeps."""
        return self.recorder.content() | {
            "state": outcome.state,
            "history": columns(outcome.history),
            "events": board.flush(),
            "learning": outcome.seconds,
            "seconds": time.perf_counter() - began,
            "digest": self.digest,
            "recorded": outcome.recorded,
        }

    def _keep(self, outcome: Outcome[S], ended: Ended, content: Callable[[], Content]) -> None:
        """A checkpoint of what is learnt, if anything is."""
        if outcome.history and not self.learner.needs_model:
            ended.keep(self.saved, self.learner.position(outcome.state), content)

    def _check_directory(self) -> None:
        """A note where the run's directory, or its event file, was taken away while it ran."""
        directory = self.saved.directory
        if not any(directory.glob(PATTERN)):
            note(f"{directory} or its event file was taken away while the run wrote to it: its records are lost")
            self.saved.write_settings()

    def _bar(self) -> tqdm:
        total = self.learner.total(self.experience)
        return tqdm(
            total=total, desc="learning", unit=f" {self.learner.unit}", unit_scale=True,
            disable=None if self.talks else True,
            bar_format="{l_bar}{bar:20}| {elapsed}<{remaining}, {rate_fmt}{postfix}" if total else None,
        )  # fmt: skip


def _checked(row: Row, before: list[Row], shape: tuple[int, ...]) -> Row:
    """``row``, if it is numbers of ``shape`` under the names of the rows before. Raises InputError."""
    for name, value in row.items():
        dtype = np.asarray(value).dtype
        if dtype.kind not in "biuf" or dtype.itemsize > 8 or np.shape(value) != shape:
            allowed = f"{shape[0]} numbers, one per replica" if shape else "a number"
            raise InputError(f"metrics of the learner, {name}", value, allowed)
    if before and row.keys() != before[0].keys():
        differ = ", ".join(sorted(row.keys() ^ before[0].keys()))
        raise InputError("metrics of the learner", differ, "the same names in every state")
    return row


def _finite(value: Any) -> Any:  # what JSON holds
    """``value`` with None in the place of numbers that JSON does not have."""
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def _timed(states: Iterator[S], outcome: Outcome[S]) -> Iterator[S]:
    """``states``; the seconds spent in them, apart from what their caller does in between, go to ``outcome``."""
    while True:
        tick = time.perf_counter()
        try:
            state = next(states)
        except StopIteration:
            return
        finally:
            outcome.seconds += time.perf_counter() - tick
        yield state
