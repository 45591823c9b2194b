"""Sweeps: a job that fails or dies costs no other job, and one table shows the end of each.

``cli.job`` writes a note of every job to ``.jobs/`` in the sweep's directory, because the process that waits for the
jobs may be another one, on another machine, and need not live as long. ``sweep.json`` is made from these notes and the
jobs' ``result.json``, at the end of a sweep and whenever ``python -m erl_torch.cli.sweeps DIRECTORY`` is called.
"""

from __future__ import annotations

import contextlib
import logging
import math
import re
import shlex
import shutil
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from itertools import count, takewhile
from pathlib import Path
from types import NoneType
from typing import Any

from hydra.core.config_store import ConfigStore
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.plugins import Plugins
from hydra.core.utils import JobReturn, JobStatus
from hydra.errors import HydraException
from hydra.plugins.launcher import Launcher
from omegaconf import DictConfig, flag_override, read_write

from erl_torch.checks import InputError, is_number
from erl_torch.cli.paths import quoted
from erl_torch.files import alone, here, read_json, write_json
from erl_torch.output import lasting
from erl_torch.run.origin import key_of

EXTRAS = {"joblib": "joblib", "submitit_slurm": "slurm", "submitit_local": "slurm", "optuna": "optuna"}
FIGURES = ("objective", "theta", "gap")  # of result.json, the first to compare jobs of one problem by
COLUMNS = (*FIGURES, "seconds")
# And all of env: settings that change it.
OF_THE_PROBLEM = ("learner.beta", "learner.optimism", "learner.prior_policy", "experience.path")
MOST_ROWS = 40  # of jobs that are printed beside their means over seeds; sweep.json has all
LONG_NUMBER = r"(?<==)-?\d*\.\d{5,}(e-?\d+)?$"
UNFINISHED = ("waiting", "running")
FINISHED = ("ended", "failed")  # statuses of jobs that are not started again
# Slurm's names of the end of a job, whatever its cause; "GONE" is ours, of a job that Slurm no longer lists.
SLURM_ENDS = {"BOOT_FAIL", "CANCELLED", "COMPLETED", "DEADLINE", "FAILED", "NODE_FAIL", "OUT_OF_MEMORY", "PREEMPTED"}
SLURM_ENDS |= {"TIMEOUT", "GONE"}
ASK_SLURM = 5.0  # seconds between questions to Slurm


def directory(arguments: Sequence[str]) -> list[str]:
    """hydra.sweep.dir of a sweep over environments: it is named for none of them."""
    given = any(a.startswith("hydra.sweep.dir=") for a in arguments)
    return [] if given or "env" not in varying(arguments) else ["hydra.sweep.dir=runs/sweep-${now:%m%d-%H%M%S-%f}"]


def varying(arguments: Sequence[str]) -> list[str]:
    """The keys among ``arguments`` that take several values."""
    read = OverridesParser.create()
    found = []
    for argument in arguments:
        with contextlib.suppress(HydraException):  # Hydra says what is wrong
            override = read.parse_override(argument)
            if override.is_sweep_override():
                found.append(override.key_or_group)
    return found


def presets() -> None:
    """Register this project's defaults for the plugins that are installed, under the plugins' own names."""
    Plugins.instance()  # the plugins register theirs first
    store = ConfigStore.instance()
    with contextlib.suppress(ImportError):
        from hydra_plugins.hydra_submitit_launcher.config import SlurmQueueConf

        # A job whose time is up saves a checkpoint and queues again, as often as it takes.
        slurm = SlurmQueueConf(cpus_per_task=1, max_num_timeout=1000)
        store.store(group="hydra/launcher", name="submitit_slurm", node=slurm, provider="erl_torch")
    with contextlib.suppress(ImportError):
        from hydra_plugins.hydra_optuna_sweeper.config import Direction, OptunaSweeperConf

        logging.getLogger("alembic").setLevel(logging.WARNING)  # it speaks of databases, and none is used
        # The objective is a reward; a trial that fails does not end the study.
        optuna = OptunaSweeperConf(direction=Direction.maximize, max_failure_rate=1.0)
        store.store(group="hydra/sweeper", name="optuna", node=optuna, provider="erl_torch")


# -- notes and the table ----------------------------------------------------------------------------


def note(sweep: Path, number: int, status: str, **more: str | float | None) -> None:
    """Note that job ``number`` is running, ended or failed, and ``more``; the rest of an earlier note stays."""
    write_json(_note(sweep, number), _read(_note(sweep, number)) | {"status": status, **more})


def fail(sweep: Path, number: int, complaint: str) -> None:
    """Note that job ``number`` has failed, and print the complaint."""
    print(f"error: job {number}: {complaint}", file=sys.stderr)
    note(sweep, number, "failed", complaint=complaint)


def _note(sweep: Path, number: int) -> Path:
    return sweep / ".jobs" / f"{number}.json"


def _read(path: Path) -> dict[str, Any]:
    """The content of a JSON file; empty where there is none that can be read."""
    try:
        return read_json(path, "path", "") or {}
    except InputError:
        return {}


def _rows(sweep: Path) -> list[dict[str, Any]]:
    """The table of ``sweep.json``. Raises InputError where there is none, or a damaged one."""
    path = sweep / "sweep.json"
    remedy = "the same command again makes it anew"
    content = read_json(path, "directory", remedy)
    if content is None:
        raise InputError("directory", sweep, "that of a sweep: it holds a sweep.json")
    rows = content.get("jobs")
    if not (isinstance(rows, list) and rows and all(map(_is_row, rows))):
        raise InputError("directory", path, f"what a sweep writes: a row of every job; {remedy}")
    return rows


def _is_row(row: object) -> bool:
    return (
        isinstance(row, dict)
        and isinstance(row.get("job"), int)
        and isinstance(row.get("overrides"), list)
        and all(isinstance(o, str) for o in row["overrides"])
        and isinstance(row.get("status"), str)
        and all(isinstance(row.get(key), (str, NoneType)) for key in ("directory", "complaint"))
    )


def _figure(value: object) -> float | None:
    """A number of a ``result.json``; None for anything else."""
    return value if is_number(value) else None


def _plan(sweep: Path, jobs: dict[int, list[str]], anew: bool) -> None:
    """Add jobs to the table; ``anew`` forgets those of an earlier sweep in this directory."""
    if anew:
        shutil.rmtree(sweep / ".jobs", ignore_errors=True)
    rows = [] if anew else _rows(sweep)
    rows += [{"job": n, "overrides": overrides, "status": "waiting"} for n, overrides in jobs.items()]
    write_json(sweep / "sweep.json", {"jobs": rows})


def collect(sweep: Path) -> list[dict[str, Any]]:
    """Collect the state of all jobs, and write it to ``sweep.json``.

    Returns:
        one row per job: job, overrides, status (of the result, or failed, running, waiting), complaint, theta,
        objective, gap, seconds and directory; None where there is no such figure.

    Raises:
        InputError: ``sweep`` holds no ``sweep.json``, or a damaged one.
    """
    rows = _rows(sweep)
    for row in rows:
        noted = row | _read(_note(sweep, row["job"]))
        row |= {key: (noted if _is_row(noted) else row).get(key) for key in ("status", "complaint", "directory")}
        result = _read(sweep / row["directory"] / "result.json") if row["directory"] else {}
        row |= {key: _figure(result.get(key)) for key in COLUMNS}
        if row["status"] == "ended":
            row["status"] = str(result.get("status", "completed"))
        if row["directory"] and not (sweep / row["directory"]).exists():
            row["directory"] = None  # bad input: nothing was written
    write_json(sweep / "sweep.json", {"jobs": rows, "averages": averages(rows)})
    if all(row["status"] not in UNFINISHED for row in rows):
        shutil.rmtree(sweep / ".jobs", ignore_errors=True)
    return rows


def failures(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    return [row for row in rows if row["status"] == "failed"]


def averages(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Jobs that differ in their seed alone, together: overrides without it, number of jobs, and [mean, sd] of figures.

    sd: of a sample (n - 1); None of fewer than two. Empty where no two jobs differ in their seed alone.
    """
    groups: dict[tuple[str, ...], list[dict[str, Any]]] = {}
    for row in rows:
        groups.setdefault(tuple(o for o in row["overrides"] if key_of(o) != "seed"), []).append(row)
    if len(groups) == len(rows):
        return []
    found = []
    for overrides, members in groups.items():
        members = [row for row in members if row["status"] != "failed"]
        members = [row for row in members if any(row[name] is not None for name in FIGURES)]
        average: dict[str, Any] = {"overrides": list(overrides), "jobs": len(members)}
        for name in FIGURES:
            values = [row[name] for row in members if row[name] is not None]
            sd = statistics.stdev(values) if len(values) > 1 else None
            average[name] = [statistics.fmean(values), sd] if values else None
        found.append(average)
    return found


def _problem(overrides: Sequence[str]) -> tuple[str, ...]:
    """What two jobs must share for their objectives to measure the same thing."""
    return tuple(o for o in overrides if key_of(o).split(".")[0] == "env" or key_of(o) in OF_THE_PROBLEM)


def _best(candidates: Sequence[tuple[tuple[str, ...], float | None]]) -> set[int]:
    """Positions of the largest objective of each problem, among (problem, objective); of a lone one there is none."""
    groups: dict[tuple[str, ...], list[tuple[float, int]]] = {}
    for i, (problem, objective) in enumerate(candidates):
        if objective is not None:
            groups.setdefault(problem, []).append((objective, -i))
    return {-max(group)[1] for group in groups.values() if len(group) > 1}


def table(sweep: Path, rows: Sequence[dict[str, Any]]) -> str:
    """The rows of ``collect`` as text, means over seeds, and one line per failure below.

    The best job, or mean, of each problem is marked. The first figure is the one to compare by: the objective, or
    where problems differ the gap to the optimum of each.
    """
    shared = [o for o in rows[0]["overrides"] if len(rows) > 1 and all(o in row["overrides"] for row in rows)]
    problems = {_problem(row["overrides"]) for row in rows}
    columns = [name for name in FIGURES if any(row[name] is not None for row in rows)]
    if len(problems) > 1:
        columns.sort(key="gap".__ne__)

    def own(overrides: Sequence[str]) -> str:
        # Sweepers draw numbers of 17 digits; Hydra escapes colons.
        texts = (re.sub(LONG_NUMBER, lambda n: f"{float(n[0]):.4g}", o) for o in overrides if o not in shared)
        return " ".join(texts).replace("\\:", ":")

    means = averages(rows)
    ended = [None if row["status"] == "failed" else row["objective"] for row in rows]
    best = set() if means else _best([(_problem(row["overrides"]), one) for row, one in zip(rows, ended, strict=True)])
    text = []
    if len(rows) <= MOST_ROWS or not means:
        head = ("", "job", "overrides", *columns, "status", "seconds", "directory")
        text += _aligned(
            [
                head,
                *(
                    ("*" if i in best else "", str(row["job"]), own(row["overrides"]),
                     *("" if row[c] is None else f"{row[c]:z.6g}" for c in columns), row["status"],
                     "" if row["seconds"] is None else f"{row['seconds']:.1f}", row["directory"] or "")
                    for i, row in enumerate(rows)
                ),
            ]
        )  # fmt: skip
    if means:
        best = _best([(_problem(mean["overrides"]), (mean["objective"] or [None])[0]) for mean in means])
        head = ("", "jobs", "mean +- sd over seeds", *columns)
        text += [""] * bool(text) + _aligned(
            [
                head,
                *(
                    ("*" if i in best else "", str(mean["jobs"]), own(mean["overrides"]),
                     *(_mean(mean[c]) for c in columns))
                    for i, mean in enumerate(means)
                ),
            ]
        )  # fmt: skip
    if best:
        text.append("* the largest objective" + " of each problem" * (len(problems) > 1))
    where = here(sweep)
    failed, unfinished = failures(rows), sum(row["status"] in UNFINISHED for row in rows)
    counts = f"{len(rows)} jobs, {len(failed)} failed" + (f", {unfinished} not finished" if unfinished else "")
    return "\n".join(
        [
            "",
            *text,
            *([f"all jobs: {' '.join(shared)}"] if shared else []),
            f"{counts}; table: {where}/sweep.json; tensorboard --logdir {shlex.quote(str(where))}",
            *(f"failed: job {row['job']} ({own(row['overrides'])}): {row['complaint']}" for row in failed),
        ]
    )


def _mean(found: list[float | None] | None) -> str:
    if found is None or found[0] is None:
        return ""
    mean, sd = found
    return f"{mean:z.6g}" + ("" if sd is None else f" +- {sd:.2g}")


def _aligned(lines: Sequence[tuple[str, ...]]) -> list[str]:
    """Rows of cells as lines; text to the left, what stands between the third cell and the status to the right."""
    width = [max(map(len, column)) for column in zip(*lines, strict=True)]
    left = {0, 2} | {i for i, name in enumerate(lines[0]) if name in ("status", "directory")}
    return [
        "  ".join(f"{c:<{w}}" if i in left else f"{c:>{w}}" for i, (c, w) in enumerate(zip(line, width, strict=True)))
        .rstrip()
        for line in lines
    ]  # fmt: skip


# -- launchers --------------------------------------------------------------------------------------


@contextlib.contextmanager
def patient_launchers() -> Iterator[list[Path]]:
    """Make every launcher of Hydra's in this block a ``_Patient`` one; yields the directories of their sweeps."""
    sweeps: list[Path] = []
    make = Plugins.instantiate_launcher

    def instantiate_launcher(self: Plugins, *, config: DictConfig, **more: Any) -> Launcher:  # Any: as Hydra has it
        directory = str(config.hydra.sweep.dir)
        # Jobs are named by what varies: this is left out.
        task = list(map(str, config.hydra.overrides.task))
        same = sorted({key_of(a) for a in task} - set(varying(task)))
        # One directory for all jobs, even where its name depends on a key that is swept over.
        given = config.hydra.overrides.hydra
        with read_write(given), flag_override(given, "struct", False):
            given.append(f"hydra.sweep.dir={quoted(directory)}")
            given.append(f"hydra.job.config.override_dirname.exclude_keys=[{','.join(map(quoted, same))}]")
        return _Patient(make(self, config=config, **more), Path(directory), sweeps)

    Plugins.instantiate_launcher = instantiate_launcher  # type: ignore[method-assign,assignment]
    try:
        yield sweeps
    finally:
        Plugins.instantiate_launcher = make  # type: ignore[method-assign]


class _Patient(Launcher):
    """Run jobs through ``inner`` until each has ended or failed by itself. A job whose process dies is started once
    more, in the same directory, where it goes on from its checkpoint.
    """

    def __init__(self, inner: Launcher, sweep: Path, sweeps: list[Path]) -> None:
        self.inner, self.sweep, self.sweeps = inner, sweep, sweeps

    def setup(self, **_: object) -> None:
        """Do nothing: ``inner`` is ready."""

    def launch(self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int) -> Sequence[JobReturn]:
        _check_slurm(self.inner)
        jobs = {n: list(overrides) for n, overrides in enumerate(job_overrides, initial_job_idx)}
        _plan(self.sweep, jobs, anew=self.sweep not in self.sweeps)
        if self.sweep not in self.sweeps:
            self.sweeps.append(self.sweep)
        todo = dict(jobs)
        died: set[int] = set()
        while todo:
            # Launchers number jobs from the first one. A process that dies takes the others of its pool with it, so a
            # job whose process died runs alone.
            first = min(todo)
            together = takewhile(lambda n: n in todo and n not in died, count(first))
            numbers = [first] if first in died else list(together)
            error = None
            try:
                with _patient_submitit(self.inner, self.sweep, numbers):
                    self.inner.launch([todo[n] for n in numbers], numbers[0])
            except Exception as raised:
                error = raised
            before = len(todo), len(died)
            for number in numbers:
                if error is not None:
                    self._wait_for_writer(number)
                status = _read(_note(self.sweep, number)).get("status")
                if status in FINISHED:
                    del todo[number]
                elif status == "running" and number not in died:
                    died.add(number)
                elif status == "running":
                    fail(self.sweep, number, "its process died, twice")
                    del todo[number]
                elif error is None:
                    fail(self.sweep, number, "it did not start")
                    del todo[number]
            if error is not None and before == (len(todo), len(died)):
                if type(error).__module__.startswith("submitit"):
                    last = str(error).strip().splitlines()[-1]
                    raise InputError("hydra/launcher", type(self.inner).__name__, f"one that starts jobs ({last})")
                raise error
        return [self._returned(number, overrides) for number, overrides in jobs.items()]

    def _wait_for_writer(self, number: int) -> None:
        """Wait for the job's process to end. A broken pool raises before all its processes are dead."""
        for _ in range(300):
            noted = _read(_note(self.sweep, number))
            if noted.get("status") != "running":
                return
            with contextlib.suppress(InputError, FileNotFoundError), alone(self.sweep / noted["directory"]):
                return
            time.sleep(0.1)

    def _returned(self, number: int, overrides: list[str]) -> JobReturn:
        value = _read(_note(self.sweep, number)).get("value")
        return JobReturn(overrides=overrides, status=JobStatus.COMPLETED, _return_value=value)


def _check_slurm(launcher: Launcher) -> None:
    """Raise InputError where jobs are for Slurm and it is not on this machine."""
    if type(launcher).__name__ == "SlurmLauncher" and shutil.which("srun") is None:
        allowed = "used where Slurm is (there is no srun here); joblib runs jobs on all cores of one machine"
        raise InputError("hydra/launcher", "submitit_slurm", allowed)


@contextlib.contextmanager
def _patient_submitit(inner: Launcher, sweep: Path, numbers: Sequence[int]) -> Iterator[None]:
    """Let submitit's launchers wait for all jobs in this block. By themselves they give up at the first that fails."""
    if not type(inner).__module__.startswith("hydra_plugins.hydra_submitit_launcher"):
        yield
        return
    import submitit

    class Finished:
        def results(self) -> list[None]:
            return [None]

    map_array = submitit.AutoExecutor.map_array

    def and_wait(self: object, *arguments: object) -> list[Finished]:
        _wait(sweep, dict(zip(numbers, map_array(self, *arguments), strict=True)))
        return [Finished() for _ in numbers]

    submitit.AutoExecutor.map_array = and_wait
    try:
        yield
    finally:
        submitit.AutoExecutor.map_array = map_array


def _wait(sweep: Path, jobs: dict[int, Any]) -> None:
    """Return when every submitit job has ended, failed, or is lost. A job that Slurm no longer runs and that left no
    result is queued again, once, unless it was cancelled.
    """
    array = next(iter(jobs.values())).job_id.split("_")[0]
    on_slurm = type(next(iter(jobs.values()))).__name__ == "SlurmJob"
    left, asked = dict(jobs), -math.inf
    missing: set[int] = set()
    again: set[int] = set()
    while left:
        time.sleep(0.5)
        states: dict[str, str] = {}
        if on_slurm and time.monotonic() > asked + ASK_SLURM:
            states, asked = _slurm_states(array), time.monotonic()
        for number, job in list(left.items()):
            state = states.get(job.job_id, states.get("any"))
            if job.paths.result_pickle.exists():
                error = job.exception()
                if error is not None and _read(_note(sweep, number)).get("status") not in FINISHED:
                    fail(sweep, number, str(error).strip().splitlines()[-6])
                del left[number]
            elif not on_slurm:
                if job.done(force_check=True) and not job.paths.result_pickle.exists():
                    del left[number]
            elif state in SLURM_ENDS and number not in missing:
                missing.add(number)  # a shared file system may need a moment to show the result
            elif state in SLURM_ENDS and (state == "CANCELLED" or number in again or not _requeue(job.job_id)):
                fail(sweep, number, f"Slurm job {job.job_id} ended without a result: {state}")
                del left[number]
            elif state is not None:
                if state in SLURM_ENDS:
                    again.add(number)
                    print(f"job {number}: {state}, queued again", file=sys.stderr)
                missing.discard(number)


def _slurm_states(array: str) -> dict[str, str]:
    """The state of each task of a job array; empty where Slurm does not answer, and is to be asked again."""
    command = ["squeue", "--noheader", "--array", "--states=all", f"--jobs={array}", "--format=%i %T"]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        return {"any": "GONE"} if "Invalid job id" in done.stderr else {}
    return {"any": "GONE"} | dict(line.split() for line in done.stdout.splitlines())


def _requeue(job_id: str) -> bool:
    return subprocess.run(["scontrol", "requeue", job_id], capture_output=True).returncode == 0


def show(sweep: Path) -> list[dict[str, Any]]:
    """Collect the jobs and print their table."""
    rows = collect(sweep)
    print(table(sweep, rows))
    return rows


def main(arguments: Sequence[str]) -> int:
    lasting()
    if len(arguments) != 1:
        print("usage: python -m erl_torch.cli.sweeps DIRECTORY", file=sys.stderr)
        return 2
    try:
        rows = show(Path(arguments[0]))
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 1 if failures(rows) else 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
