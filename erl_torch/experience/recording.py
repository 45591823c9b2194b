"""Experience of any size: streams of tuples in files, read in chunks of bounded memory.

``read_experience`` picks the reader from the path

    FILE.npz          columns s, a, r, s_next, a_next, and weight or not, as ``Transitions.save`` writes them
    DIRECTORY         s.npy, a.npy, r.npy, s_next.npy, a_next.npy (weight.npy), as ``ColumnWriter`` writes them: the
                      fastest
    FILE.csv, .tsv, .jsonl, .parquet, .pq, or a directory of such parts: see erl_torch.experience.formats.rows
                      (CSV and Parquet need pyarrow)
    minari:DATASET    episodes of a local Minari data set (needs minari and h5py)

(``erl_torch.experience.formats`` has one module per format) and reads everything once: each tuple is checked against
the sizes, and the stream gets its length and checksum. Every pass over it checks again, since a file may change.

A bad tuple (a state or action out of range, a reward that is not finite, a missing value) is named by file and row,
and ends the reading; with ``on_bad="skip"`` it is left out and counted, as are the rows for which a column of a
directory or npz is too short. A damaged npz, Parquet or Minari file ends the reading with either: none of its rows can
be trusted. (Damage shows by the file's own checksums, which Parquet has only where its writer was asked for them.)
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike

from erl_torch import checks
from erl_torch.checks import InputError
from erl_torch.experience.experience import EXPERIENCE, Experience
from erl_torch.experience.formats import ALLOWED, FORMATS
from erl_torch.experience.formats.format import Batch, Format, Options, Reader
from erl_torch.experience.formats.npy import ColumnWriter
from erl_torch.experience.formats.rows import reader_of
from erl_torch.experience.formats.table import is_frame, of_frame
from erl_torch.experience.transitions import COLUMNS, REAL, TYPES, WEIGHT, Checksum, Transitions, join, regroup
from erl_torch.labels import Labels

CHUNK = 1 << 22  # tuples held in memory: 100 MB of columns
READ = 1 << 16  # tuples at a time, of longer ones: they stay in the processor's cache

Recordable = Any
"""A path (``str`` or ``os.PathLike``), a frame or table that Arrow can take, or arrays by name: what can be read."""


class FileRecording:
    """An ``Experience`` in files, read anew in every pass.

    Args:
        path: see the module's docstring; or a frame (of pandas, polars, pyarrow), or arrays by name.
        n_states, n_actions: sizes of the problem.
        on_bad: "stop" or "skip", for bad tuples.
        chunk: tuples in memory at most, >= 1 (some thousands, if a learner has to have so many at once).
        env, prior_policy, on_prior, seed: for Minari: the environment whose bins serve where the spaces are Box, and
            where a' comes from.
        report: called with the number of tuples read so far.
        format: reads the path; None: the first of ``erl_torch.experience.formats`` that claims it.
        columns: of a table, which are which, as {"s": "segment", "r": "profit"}; the others are found by their names.
        state_labels, action_labels: of the recorded states and actions; None: they are whole numbers from 0.

    Raises:
        InputError: what is wrong, with file and row.

    Attributes: ``n_skipped`` counts the bad tuples that are left out, ``first_skipped`` names the first of them.
    """

    def __init__(
        self,
        path: Recordable,
        n_states: int,
        n_actions: int,
        *,
        on_bad: str = "stop",
        chunk: int = CHUNK,
        env: gym.Env[Any, Any] | None = None,
        prior_policy: ArrayLike | None = None,
        on_prior: bool = False,
        seed: int = 0,
        report: Callable[[int], object] | None = None,
        format: Format | None = None,
        columns: Mapping[str, Any] | None = None,
        state_labels: Labels | None = None,
        action_labels: Labels | None = None,
    ) -> None:
        checks.one_of("on_bad", on_bad, ("stop", "skip"))
        chunk = checks.at_least("chunk", chunk, 1)
        n_states, n_actions = checks.at_least("n_states", n_states, 1), checks.at_least("n_actions", n_actions, 1)
        if n_states * n_actions > np.iinfo(np.int32).max:
            raise InputError("n_states * n_actions", n_states * n_actions, "below 2**31")
        options = Options(n_states, n_actions, env, prior_policy, on_prior, seed, columns, state_labels, action_labels)
        self._reader = _reader(path, options, format)
        self._chunk, self._strict = chunk, on_bad == "stop"
        self._sizes = n_states, n_actions
        self._limits = {"s": n_states, "a": n_actions, "s_next": n_states, "a_next": n_actions}
        self._n = self.n_skipped = 0
        self.first_skipped = ""
        self._counted = False
        self._stamp = _stamp(self.path)
        running = Checksum()
        for block in self._read(min(chunk, READ)):
            self._n += len(block)
            self._checksum = running.of(block)
            if report is not None:
                report(self._n)
        self.n_skipped += self._reader.short
        self.first_skipped = self.first_skipped or getattr(self._reader, "first_bad", "")
        self._counted = True
        if not self._n:
            raise InputError(f"path={self.path}", "0 good tuples", "at least one tuple")

    @property
    def path(self) -> str:
        return self._reader.path

    def __len__(self) -> int:
        return self._n

    def check_range(self, n_states: int, n_actions: int) -> None:
        """Raise InputError for sizes below those it was opened with, against which every pass checks the tuples."""
        if n_states < self._sizes[0] or n_actions < self._sizes[1]:
            raise InputError("n_states, n_actions", (n_states, n_actions), f"those it was opened with, {self._sizes}")

    def chunks(self, multiple: int = 1) -> Iterator[Transitions]:
        """Make one pass, as ``Experience`` says. Raises InputError for a file that is no longer what it was."""
        n = 0
        self._check_stamp()
        for block in regroup(self._read(max(1, min(self._chunk, READ) // multiple) * multiple), multiple):
            n += len(block)
            yield block
        if n != self._n:
            raise InputError(f"path={self.path}", f"{n} tuples", f"left as it was while it is read: {self._n} tuples")
        self._check_stamp()

    def checksum(self) -> int:
        return self._checksum

    def _check_stamp(self) -> None:
        """Raise InputError where a file has another size or time of change than when it was opened."""
        if _stamp(self.path) != self._stamp:
            raise InputError("path", self.path, "left as it was while it is learnt from: it has been written to")

    def load(self) -> Transitions:
        """All its tuples, in memory."""
        return join(list(self.chunks()))

    def held(self) -> Transitions | FileRecording:
        """Its tuples in memory where ``chunk`` of them are enough, else itself."""
        return self.load() if len(self) <= self._chunk else self

    def _read(self, rows: int) -> Iterator[Transitions]:
        row = 0
        for batch in self._reader.batches(rows, self._strict):
            names = (*COLUMNS, WEIGHT) if WEIGHT in batch else COLUMNS
            shapes = {name: np.shape(batch[name]) if name in batch else () for name in names}
            if len(shapes["s"]) != 1 or len(set(shapes.values())) > 1:
                raise InputError(
                    f"path={self.path}", f"shapes {shapes} from row {row} on", "five columns of one length"
                )
            columns = {name: self._typed(name, batch[name]) for name in names}
            n = len(columns["s"])
            bad = self._bad(columns, row)
            row += n
            if bad is not None:
                self.n_skipped += 0 if self._counted else int(bad.sum())
                columns = {name: column[~bad] for name, column in columns.items()}
            if len(columns["s"]):
                yield Transitions.checked(
                    *(np.ascontiguousarray(columns[name], TYPES[name].newbyteorder("=")) for name in names)
                )

    def _typed(self, name: str, column: np.ndarray) -> np.ndarray:
        if column.dtype.kind not in "iuf":  # numbers that are not whole are bad tuples
            allowed = "numbers" if name in REAL else "whole numbers"
            raise InputError(f"path={self.path}: {name}", f"dtype {column.dtype}", f"a column of {allowed}")
        with np.errstate(over="ignore"):  # of wider numbers: they are no longer finite
            return np.asarray(column, np.float64) if name in REAL else column

    def _bad(self, columns: Batch, first: int) -> np.ndarray | None:
        """Mask of the bad tuples, None without any. Raises InputError for the first where that is an error."""
        wrong: Batch = {}
        for name, column in columns.items():
            if not len(column):
                return None
            if name in REAL:
                fits, _ = checks.FINITE if name == "r" else checks.NOT_NEGATIVE
                mask = ~fits(column)
                if mask.any():
                    wrong[name] = mask
            elif column.dtype.kind == "f":
                mask = ~((column >= 0) & (column < self._limits[name]) & (column == np.floor(column)))
                if mask.any():
                    wrong[name] = mask
            elif column.min() < 0 or column.max() >= self._limits[name]:
                wrong[name] = (column < 0) | (column >= self._limits[name])
        if not wrong:
            return None
        bad = np.logical_or.reduce(list(wrong.values()))
        i = int(np.argmax(bad))
        name = next(name for name, mask in wrong.items() if mask[i])
        allowed = {"r": checks.FINITE[1], WEIGHT: checks.NOT_NEGATIVE[1]}.get(name, "")
        allowed = allowed or f"a whole number in [0, {self._limits[name]})"
        error = InputError(f"path={self.path}: {name}[{first + i}]", columns[name][i].item(), allowed)
        if self._strict:
            raise error
        self.first_skipped = self.first_skipped or f"{name}[{first + i}]={columns[name][i].item()}"
        return np.asarray(bad)


def _reader(path: Recordable, options: Options, format: Format | None) -> Reader:
    """What reads ``path``. Raises InputError where nothing does."""
    if not isinstance(path, (str, os.PathLike)):
        if format is not None or not is_frame(path):
            raise InputError("path", type(path).__name__, "a path, a frame, or arrays by name")
        return reader_of(of_frame(path), options)
    claimant = next((one for one in (FORMATS if format is None else (format,)) if one.claims(str(path))), None)
    if claimant is None:
        raise InputError("path", path, ALLOWED if format is None else "claimed by the given format")
    return claimant.reader(str(path), options)


def _stamp(path: str) -> list[tuple[str, int, int]]:
    """(name, size, time of change in ns) of the file, or of those in the directory; nothing of what is neither."""
    root = Path(path)
    files = sorted(root.rglob("*")) if root.is_dir() else [root]
    return [(str(one), one.stat().st_size, one.stat().st_mtime_ns) for one in files if one.is_file()]


def read_experience(
    path: Recordable,
    n_states: int,
    n_actions: int,
    *,
    on_bad: str = "stop",
    chunk: int = CHUNK,
    env: gym.Env[Any, Any] | None = None,
    prior_policy: ArrayLike | None = None,
    on_prior: bool = False,
    seed: int = 0,
    report: Callable[[int], object] | None = None,
    format: Format | None = None,
    columns: Mapping[str, Any] | None = None,
    state_labels: Labels | None = None,
    action_labels: Labels | None = None,
) -> Transitions | FileRecording:
    """Read the experience at ``path``: into memory where it is no longer than ``chunk``, else in every pass anew.

    Arguments, attributes and errors are those of ``erl_torch.experience.recording.FileRecording``.
    """
    return FileRecording(
        path,
        n_states,
        n_actions,
        on_bad=on_bad,
        chunk=chunk,
        env=env,
        prior_policy=prior_policy,
        on_prior=on_prior,
        seed=seed,
        report=report,
        format=format,
        columns=columns,
        state_labels=state_labels,
        action_labels=action_labels,
    ).held()


def write_experience(data: Experience, directory: str | os.PathLike[str]) -> Path:
    """Write experience of any size to a directory of columns, which is the fastest to read.

    Args:
        data: as of ``Transitions`` or ``read_experience``.
        directory: a new one, or a directory of columns, which is replaced once the new one is whole.

    Returns:
        ``directory``.

    Raises:
        InputError: data that is no ``Experience``, or a directory that holds anything but columns.
    """
    checks.instance("data", data, Experience, EXPERIENCE)
    return write_chunks(data.chunks(), directory)


def write_chunks(chunks: Iterable[Transitions], directory: str | os.PathLike[str]) -> Path:
    """As ``write_experience``, for tuples that come once."""
    with ColumnWriter(directory) as writer:
        for chunk in chunks:
            writer.append(chunk)
    return writer.directory
