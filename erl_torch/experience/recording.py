"""Experience of any size: streams of tuples in files, read in chunks of bounded memory.

``read_experience`` picks the reader from the path

    FILE.npz          columns s, a, r, s_next, a_next, as ``Transitions.save`` writes them
    DIRECTORY         s.npy, a.npy, r.npy, s_next.npy, a_next.npy, as ``ColumnWriter`` writes them: the fastest
    FILE.parquet      the same five columns (needs pyarrow)
    minari:DATASET    episodes of a local Minari data set (needs minari and h5py)

and reads everything once: each tuple is checked against the sizes, and the stream gets its length and checksum. Every
pass over it checks again, since a file may change.

A bad tuple (a state or action out of range, a reward that is not finite, a missing value) is named by file and row,
and ends the reading; with ``on_bad="skip"`` it is left out and counted, as are the rows for which a column of a
directory or npz is too short. A damaged npz, Parquet or Minari file ends the reading with either: none of its rows can
be trusted. (Damage shows by the file's own checksums, which Parquet has only where its writer was asked for them.)

Minari's episodes become tuples as ``erl_torch.experience.collect`` has them. Where an episode terminated, s' is the
first state of the next one (the first episode follows the last); where it was truncated, or just ends, s' is the
state reached. a' is the action taken next where the behaviour policy was the prior (``on_prior``) and an action was
taken at s'; else it is drawn from the prior, with the stream "behaviour" of the seed, a number for each tuple.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import shutil
import warnings
import zipfile
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, BinaryIO, Protocol

import numpy as np
from numpy.lib import format as npy

from erl_torch import checks
from erl_torch.checks import InputError
from erl_torch.envs.discretise import Discretise
from erl_torch.experience.experience import EXPERIENCE, Experience
from erl_torch.experience.transitions import COLUMNS, Checksum, Transitions, join, regroup
from erl_torch.files import check_directory
from erl_torch.mdp.tabular import check_policy
from erl_torch.rng import streams

CHUNK = 1 << 22  # tuples held in memory: 100 MB of columns
READ = 1 << 16  # tuples at a time, of longer ones: they stay in the processor's cache
TYPES = {name: np.dtype("<f8" if name == "r" else "<i4") for name in COLUMNS}

Batch = dict[str, np.ndarray]


class Source(Protocol):
    """A file format. Raises InputError for what cannot be read."""

    path: str
    short: int  # rows that a column lacks; known once a pass has begun

    def batches(self, rows: int, strict: bool) -> Iterator[Batch]:
        """Columns of one length, about ``rows`` at a time; ``strict``: columns that are too short are an error."""


class FileRecording:
    """A ``Experience`` in files, read anew in every pass.

    Args:
        path: see the module's docstring.
        n_states, n_actions: sizes of the problem.
        on_bad: "stop" or "skip", for bad tuples.
        chunk: tuples at a time at most (but for what a learner handles at once, some thousands), in ``held`` too.
        env, prior_policy, on_prior, seed: for Minari: the environment whose bins serve where the spaces are Box, and
            where a' comes from.
        report: called with the number of tuples read so far.

    Raises:
        InputError: what is wrong, with file and row.

    Attributes: ``n_skipped`` bad tuples are left out, ``first_skipped`` is the first of them, as text.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        n_states: int,
        n_actions: int,
        *,
        on_bad: str = "stop",
        chunk: int = CHUNK,
        env: Any = None,
        prior_policy: Any = None,
        on_prior: bool = False,
        seed: int = 0,
        report: Callable[[int], object] | None = None,
    ) -> None:
        checks.one_of("on_bad", on_bad, ("stop", "skip"))
        chunk = checks.at_least("chunk", chunk, 1)
        n_states, n_actions = checks.at_least("n_states", n_states, 1), checks.at_least("n_actions", n_actions, 1)
        checks.instance("path", path, (str, os.PathLike), "a path")
        if n_states * n_actions > np.iinfo(np.int32).max:
            raise InputError("n_states * n_actions", n_states * n_actions, "below 2**31")
        self._source: Source
        if str(path).startswith("minari:"):
            prior = check_policy("prior_policy", prior_policy, n_states, n_actions)
            self._source = _Minari(str(path), env, prior, on_prior, seed)
        elif not Path(path).exists():
            raise InputError("path", path, "there: an npz or Parquet file, a directory of columns, or minari:DATASET")
        elif Path(path).suffix == ".parquet" and Path(path).is_file():
            self._source = _Parquet(str(path))
        else:
            self._source = _Npy(str(path))
        self._chunk, self._strict = chunk, on_bad == "stop"
        self._sizes = n_states, n_actions
        self._limits = {"s": n_states, "a": n_actions, "s_next": n_states, "a_next": n_actions}
        self._n = self.n_skipped = 0
        self.first_skipped = ""
        self._counted = False
        running = Checksum()
        for part in self._read(min(chunk, READ)):
            self._n += len(part)
            self._checksum = running.of(part)
            if report is not None:
                report(self._n)
        self.n_skipped += self._source.short
        self._counted = True
        if not self._n:
            raise InputError(f"path={self.path}", "0 good tuples", "at least one tuple")

    @property
    def path(self) -> str:
        return self._source.path

    def __len__(self) -> int:
        return self._n

    def check_range(self, n_states: int, n_actions: int) -> None:
        """Every pass has been, and is, checked against the sizes it was opened with. Raises InputError for others."""
        if n_states < self._sizes[0] or n_actions < self._sizes[1]:
            raise InputError("n_states, n_actions", (n_states, n_actions), f"those it was opened with, {self._sizes}")

    def chunks(self, multiple: int = 1) -> Iterator[Transitions]:
        """One pass; see ``Experience``. Raises InputError for a file that is no longer what it was."""
        n = 0
        for part in regroup(self._read(max(1, min(self._chunk, READ) // multiple) * multiple), multiple):
            n += len(part)
            yield part
        if n != self._n:
            raise InputError(f"path={self.path}", f"{n} tuples", f"left as it was while it is read: {self._n} tuples")

    def checksum(self) -> int:
        return self._checksum

    def load(self) -> Transitions:
        """All of it, in memory."""
        return join(list(self.chunks()))

    def held(self) -> Transitions | FileRecording:
        """In memory where it is no longer than a chunk, else as it is."""
        return self.load() if len(self) <= self._chunk else self

    def _read(self, rows: int) -> Iterator[Transitions]:
        row = 0
        for batch in self._source.batches(rows, self._strict):
            columns = {name: self._typed(name, batch[name]) for name in COLUMNS}
            n = len(columns["s"])
            bad = self._bad(columns, row)
            row += n
            if bad is not None:
                self.n_skipped += 0 if self._counted else int(bad.sum())
                columns = {name: column[~bad] for name, column in columns.items()}
            if len(columns["s"]):
                yield Transitions.checked(
                    *(np.ascontiguousarray(columns[name], TYPES[name].newbyteorder("=")) for name in COLUMNS)
                )

    def _typed(self, name: str, column: np.ndarray) -> np.ndarray:
        kinds, allowed = ("iuf", "numbers") if name == "r" else ("iu", "whole numbers")
        if column.dtype.kind not in kinds:
            raise InputError(f"path={self.path}: {name}", f"dtype {column.dtype}", f"a column of {allowed}")
        with np.errstate(over="ignore"):  # of wider numbers: they are no longer finite
            return np.asarray(column, np.float64) if name == "r" else column

    def _bad(self, columns: Batch, first: int) -> np.ndarray | None:
        """Mask of the bad tuples, None without any. Raises InputError for the first where that is an error."""
        wrong: Batch = {}
        for name, column in columns.items():
            if not len(column):
                return None
            if name == "r":
                mask = ~np.isfinite(column)
                if mask.any():
                    wrong[name] = mask
            elif column.min() < 0 or column.max() >= self._limits[name]:
                wrong[name] = (column < 0) | (column >= self._limits[name])
        if not wrong:
            return None
        bad = np.logical_or.reduce(list(wrong.values()))
        i = int(np.argmax(bad))
        name = next(name for name, mask in wrong.items() if mask[i])
        allowed = "finite" if name == "r" else f"a whole number in [0, {self._limits[name]})"
        error = InputError(f"path={self.path}: {name}[{first + i}]", columns[name][i].item(), allowed)
        if self._strict:
            raise error
        self.first_skipped = self.first_skipped or f"{name}[{first + i}]={columns[name][i].item()}"
        return np.asarray(bad)


def read_experience(
    path: str | os.PathLike[str], n_states: int, n_actions: int, **options: Any
) -> Transitions | FileRecording:
    """The recording behind ``path``: in memory where it is no longer than a chunk, else in its files.

    Arguments and errors as of ``FileRecording``.
    """
    return FileRecording(path, n_states, n_actions, **options).held()


# -- formats --------------------------------------------------------------------------------------------


@contextlib.contextmanager
def _readable(path: str, what: str) -> Iterator[None]:
    """Whatever a library says of a damaged file becomes one InputError."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:  # a dozen kinds, zlib's and struct's among them
        said = f"{error.strerror}" if isinstance(error, OSError) and error.strerror else f"{error}"
        raise InputError("path", path, f"a readable {what} ({said or type(error).__name__})") from error


class _Npy:
    """Columns in npy format: the files of a directory, or the members of an npz."""

    def __init__(self, path: str) -> None:
        self.path, self.short = path, 0
        self._what = "directory of npy columns" if Path(path).is_dir() else "npz file without pickled objects"

    def batches(self, rows: int, strict: bool) -> Iterator[Batch]:
        with contextlib.ExitStack() as stack:
            with _readable(self.path, self._what):
                columns = {name: _NpyColumn(name, *opened) for name, opened in self._open(stack).items()}
            claimed = max(column.claimed for column in columns.values())
            length = min(min(column.claimed, column.held) for column in columns.values())
            for name, column in columns.items():
                if strict and min(column.claimed, column.held) < claimed:
                    n = min(column.claimed, column.held)
                    raise InputError(
                        f"path={self.path}: {name}[{n}]", "missing", f"there: {claimed} rows are announced"
                    )
                if column.held > column.claimed:
                    allowed = f"as long as its header says, {column.claimed} rows"
                    raise InputError(f"path={self.path}: {name}", "longer", allowed)
            self.short = claimed - length
            for begin in range(0, length, rows):
                n = min(rows, length - begin)
                with _readable(self.path, f"{self._what} (from row {begin} on)"):
                    batch = {name: column.read(n) for name, column in columns.items()}
                yield batch
            with _readable(self.path, self._what):
                for column in columns.values():
                    column.finish(self.short > 0)

    def _open(self, stack: contextlib.ExitStack) -> dict[str, tuple[BinaryIO, int]]:
        """Files and their sizes in bytes."""
        if Path(self.path).is_dir():
            files: dict[str, BinaryIO] = {}
            for name in COLUMNS:
                path = Path(self.path, f"{name}.npy")
                if not path.is_file():
                    raise InputError("path", self.path, f"a directory of {name}.npy and the like; it lacks {name}.npy")
                files[name] = stack.enter_context(path.open("rb"))
            return {name: (file, os.fstat(file.fileno()).st_size) for name, file in files.items()}
        archive = stack.enter_context(zipfile.ZipFile(self.path))
        check_directory(archive)
        found: dict[str, tuple[BinaryIO, int]] = {}
        for name in COLUMNS:
            if f"{name}.npy" not in archive.namelist():
                allowed = f"an npz with columns {', '.join(COLUMNS)}; it lacks {name}"
                raise InputError("path", self.path, allowed)
            member: Any = stack.enter_context(archive.open(f"{name}.npy"))
            found[name] = member, archive.getinfo(f"{name}.npy").file_size
        return found


class _NpyColumn:
    """One npy stream, read from front to end. Raises ValueError."""

    def __init__(self, name: str, file: BinaryIO, size: int) -> None:
        self.file = file
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            version = npy.read_magic(file)
            if version not in ((1, 0), (2, 0)):
                raise ValueError(f"{name}: npy format {version}")
            header = npy.read_array_header_1_0(file) if version == (1, 0) else npy.read_array_header_2_0(file)
        shape, _, self.dtype = header
        if len(shape) != 1 or self.dtype.kind not in "iuf":
            raise ValueError(f"{name} is of shape {shape} and dtype {self.dtype}")
        self.claimed: int = shape[0]
        self.held = (size - file.tell()) // self.dtype.itemsize  # rows

    def read(self, n: int) -> np.ndarray:
        column = np.empty(n, self.dtype)
        left = column.view(np.uint8).data
        while left:
            got = self.file.readinto(left)  # type: ignore[attr-defined]
            if not got:
                raise ValueError("it ends too early")
            left = left[got:]
        return column

    def finish(self, cut: bool) -> None:
        """Read what is left, so that an archive checks its checksums."""
        while rest := self.file.read(1 << 20):
            if not cut:
                raise ValueError(f"{len(rest)} bytes too many")


class _Parquet:
    """A Parquet file. Missing values are bad tuples."""

    def __init__(self, path: str) -> None:
        self.path, self.short = path, 0

    def batches(self, rows: int, strict: bool) -> Iterator[Batch]:
        parquet = _plugin("pyarrow.parquet", self.path, "parquet")
        with _readable(self.path, "Parquet file"):
            file = parquet.ParquetFile(self.path, page_checksum_verification=True)
        with file:
            for name in COLUMNS:
                if name not in file.schema_arrow.names:
                    allowed = f"a Parquet file with columns {', '.join(COLUMNS)}; it lacks {name}"
                    raise InputError("path", self.path, allowed)
            found = file.iter_batches(batch_size=rows, columns=list(COLUMNS), use_threads=False)
            row = 0
            while True:
                with _readable(self.path, f"Parquet file (from row {row} on)"):
                    table = next(found, None)
                    if table is None:
                        return
                    batch = {name: self._column(table.column(name), name) for name in COLUMNS}
                row += len(batch["s"])
                yield batch

    def _column(self, column: Any, name: str) -> np.ndarray:
        if column.null_count and name == "r":
            column = column.cast("float64").fill_null(np.nan)
        elif column.null_count:
            column = column.cast("int64").fill_null(-1)
        return np.asarray(column.to_numpy(zero_copy_only=False))


class _Minari:
    """Episodes of a local Minari data set, as tuples."""

    def __init__(self, path: str, env: Any, prior: np.ndarray, on_prior: bool, seed: int) -> None:
        self.path, self.short = path, 0
        self._on_prior, self._seed = on_prior, seed
        self._cdf = np.cumsum(prior, axis=1)
        self._bins = env
        while self._bins is not None and not isinstance(self._bins, Discretise):
            self._bins = getattr(self._bins, "env", None)

    def batches(self, rows: int, strict: bool) -> Iterator[Batch]:
        minari = _plugin("minari", self.path, "minari")
        with _readable(self.path, "Minari data set on this machine"):
            data = minari.load_dataset(self.path.removeprefix("minari:"))
            episodes = iter(data.iterate_episodes())
        held: list[tuple[Batch, np.ndarray, bool]] = []  # with a number a tuple, and whether the end is open
        rng = streams(self._seed).behaviour
        first: tuple[int, int] | None = None
        number = 0
        ready: list[Batch] = []
        while True:
            with _readable(self.path, f"Minari data set (from episode {number} on)"):
                episode = next(episodes, None)
                if episode is None:
                    break
                batch, terminated = self._tuples(episode, number, data)
            number += 1
            if not len(batch["s"]):
                continue
            begins = int(batch["s"][0]), int(batch["a"][0])
            first = first or begins
            ready += [self._ended(*before, begins) for before in held]
            held = [(batch, rng.random(len(batch["s"])), terminated)]
            if sum(len(batch["s"]) for batch in ready) >= rows:
                yield _joined(ready)
                ready = []
        if first is not None:
            ready += [self._ended(*before, first) for before in held]
        if ready:
            yield _joined(ready)

    def _ended(self, batch: Batch, x: np.ndarray, terminated: bool, begins: tuple[int, int]) -> Batch:
        """An episode whose end leads to what ``begins`` next, and its a'."""
        s_next = batch["s_next"].copy()
        if terminated:
            s_next[-1] = begins[0]
        cdf = self._cdf[np.clip(s_next, 0, len(self._cdf) - 1)]
        a_next = (cdf <= (x * cdf[:, -1])[:, None]).sum(1)
        if self._on_prior:
            a_next[:-1] = batch["a"][1:]
            a_next[-1] = begins[1] if terminated else a_next[-1]
        return {**batch, "s_next": s_next, "a_next": a_next}

    def _tuples(self, episode: Any, number: int, data: Any) -> tuple[Batch, bool]:
        r = np.asarray(episode.rewards)
        s, a = self._states(episode.observations, data.observation_space), self._actions(episode.actions, data)
        if not (len(s) == len(a) + 1 == len(r) + 1 == len(episode.terminations) + 1):
            raise ValueError(f"episode {number} has {len(s)} observations, {len(a)} actions and {len(r)} rewards")
        if np.any(episode.terminations[:-1]):
            raise ValueError(f"episode {number} terminates before its last step")
        return {"s": s[:-1], "a": a, "r": r, "s_next": s[1:]}, bool(len(r) and episode.terminations[-1])

    def _states(self, observations: Any, space: Any) -> np.ndarray:
        x = np.asarray(observations)
        if x.ndim == 1 and x.dtype.kind in "iu":
            return np.asarray(x.astype(np.int64) - getattr(space, "start", 0))
        if self._bins is None or x.ndim != 2 or x.dtype.kind != "f":
            raise InputError(f"{self.path}: observation_space", space, "Discrete, or a Box that env cuts into bins")
        features = self._bins.features
        x = x.astype(np.float64) if features is None else np.stack([features(row) for row in x])
        return np.asarray(self._bins.bins.cells(x))

    def _actions(self, actions: Any, data: Any) -> np.ndarray:
        x = np.asarray(actions)
        if x.ndim == 1 and x.dtype.kind in "iu":
            return np.asarray(x.astype(np.int64) - getattr(data.action_space, "start", 0))
        if self._bins is None or x.ndim != 2 or self._bins.actions.ndim != 2:
            raise InputError(
                f"{self.path}: action_space", data.action_space, "Discrete, or a Box that env has actions of"
            )
        return np.asarray(((x[:, None] - self._bins.actions) ** 2).sum(2).argmin(1))  # the nearest


def _joined(batches: list[Batch]) -> Batch:
    return {name: np.concatenate([batch[name] for batch in batches]) for name in COLUMNS}


def _plugin(module: str, path: str, extra: str) -> Any:
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise InputError("path", path, f"read with what `pip install erl_torch[{extra}]` installs ({error})") from error


# -- writing --------------------------------------------------------------------------------------------


class ColumnWriter:
    """Writes tuples to a directory of npy columns, in memory of a chunk; it has its name once it is complete.

        with ColumnWriter("tuples") as writer:
            writer.append(chunk)

    A directory of columns that has the name already is replaced, once the new one is whole. Raises InputError for one
    that holds anything else, and for a link.
    """

    def __init__(self, directory: str | os.PathLike[str]) -> None:
        self.directory = Path(directory)
        self._temporary = self.directory.with_name(f".{self.directory.name}.{os.getpid()}.tmp")
        self._n = 0

    def __enter__(self) -> ColumnWriter:
        check_target("directory", self.directory)
        shutil.rmtree(self._temporary, ignore_errors=True)
        self._temporary.mkdir(parents=True)
        self._files = {name: (self._temporary / f"{name}.npy").open("wb") for name in COLUMNS}
        self._head()
        return self

    def append(self, chunk: Transitions) -> None:
        for name, file in self._files.items():
            getattr(chunk, name).astype(TYPES[name], copy=False).tofile(file)
        self._n += len(chunk)

    def __exit__(self, kind: Any, *error: Any) -> None:
        try:
            if kind is None:
                self._head()
                for file in self._files.values():
                    file.flush()
                    os.fsync(file.fileno())
            for file in self._files.values():
                file.close()
            if kind is None:
                check_target("directory", self.directory)  # again: the collecting may have taken hours
                self._take_name()
        finally:
            shutil.rmtree(self._temporary, ignore_errors=True)

    def _take_name(self) -> None:
        """A directory that holds something cannot be renamed onto: the old one steps aside, and goes last."""
        aside = self.directory.with_name(f".{self.directory.name}.{os.getpid()}.old")
        if self.directory.exists():
            os.rename(self.directory, aside)
        try:
            os.rename(self._temporary, self.directory)
        except OSError:
            if aside.exists():
                os.rename(aside, self.directory)
            raise
        shutil.rmtree(aside, ignore_errors=True)

    def _head(self) -> None:
        for name, file in self._files.items():
            file.seek(0)
            # Room for any length is left, so that what follows stays where it is.
            npy.write_array_header_1_0(
                file, {"descr": TYPES[name].str, "fortran_order": False, "shape": (self._n,)}
            )  # fmt: skip


def check_target(key: str, path: str | os.PathLike[str]) -> None:
    """Raise InputError unless a recording may be written to ``path``: nothing is there, or a recording of ours.

    A directory is of columns and may be empty, a file an npz of the five columns and no more; neither is a link.
    """
    target = Path(path)
    of_columns = key == "directory" or str(path).endswith("/")
    kind = "directory of columns" if of_columns else "npz of columns"
    if target.is_symlink():
        raise InputError(key, path, f"a new {kind}, or one to replace: it is a link")
    if os.path.lexists(target) and not (_our_columns(target) if of_columns else _our_npz(target)):
        raise InputError(key, path, f"a new {kind}, or one to replace: what is there is none")
    parent = target.parent
    while not os.path.lexists(parent):
        parent = parent.parent
    if not parent.is_dir() or not os.access(parent, os.W_OK):
        raise InputError(key, path, f"where files can be written: {parent} is no such directory")


def _our_columns(path: Path) -> bool:
    entries = list(path.iterdir()) if path.is_dir() else [path]
    if not entries:
        return True
    if {entry.name for entry in entries} != {f"{name}.npy" for name in COLUMNS}:
        return False
    columns = {}
    try:
        for name in COLUMNS:
            if (path / f"{name}.npy").is_symlink():
                return False
            with (path / f"{name}.npy").open("rb") as file:
                columns[name] = _NpyColumn(name, file, os.fstat(file.fileno()).st_size)
    except (OSError, ValueError, UserWarning):
        return False
    same_length = len({column.claimed for column in columns.values()}) == 1
    return same_length and all(columns[name].dtype == TYPES[name] for name in COLUMNS)


def _our_npz(path: Path) -> bool:
    try:
        with zipfile.ZipFile(path) as archive:
            return sorted(archive.namelist()) == sorted(f"{name}.npy" for name in COLUMNS)
    except (OSError, zipfile.BadZipFile):
        return False


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
