"""Columns in npy format: the files of a directory, read and written, or the members of an npz, read."""

from __future__ import annotations

import contextlib
import os
import shutil
import warnings
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import IO

import numpy as np
from numpy.lib import format as npy

from erl_torch.checks import InputError
from erl_torch.experience.formats import rows
from erl_torch.experience.formats.format import ALLOWED, Batch, Options, Reader, readable
from erl_torch.experience.formats.table import of_npz
from erl_torch.experience.transitions import COLUMNS, TYPES, WEIGHT, Transitions
from erl_torch.files import check_directory


def claims(path: str) -> bool:
    """All that exists, so that every other format has to be asked before."""
    return Path(path).exists()


def reader(path: str, options: Options) -> Reader:
    if Path(path).is_file():
        if Path(path).suffix.lower() != ".npz" and not zipfile.is_zipfile(path):
            raise InputError("path", path, ALLOWED)
        if options.columns or options.state_labels or options.action_labels or not has_columns(path):
            return rows.reader_of(of_npz(path), options)
    return Columns(path)


def has_columns(path: str) -> bool:
    """Whether an npz file has the five columns under their own names; True too of one that cannot be read."""
    with contextlib.suppress(OSError, zipfile.BadZipFile), zipfile.ZipFile(path) as archive:
        return set(archive.namelist()) >= {f"{name}.npy" for name in COLUMNS}
    return True


class Columns:
    """Columns in npy format: the files of a directory, or the members of an npz."""

    def __init__(self, path: str) -> None:
        self.path, self.short = path, 0
        self._what = "directory of npy columns" if Path(path).is_dir() else "npz file without pickled objects"

    def batches(self, rows: int, strict: bool) -> Iterator[Batch]:
        with contextlib.ExitStack() as stack:
            with readable(self.path, self._what):
                columns = {name: Column(name, *opened) for name, opened in self._open(stack).items()}
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
                with readable(self.path, f"{self._what} (from row {begin} on)"):
                    batch = {name: column.read(n) for name, column in columns.items()}
                yield batch
            with readable(self.path, self._what):
                for column in columns.values():
                    column.finish(self.short > 0)

    def _open(self, stack: contextlib.ExitStack) -> dict[str, tuple[IO[bytes], int]]:
        """Files and their sizes in bytes."""
        if Path(self.path).is_dir():
            files: dict[str, IO[bytes]] = {}
            for name in COLUMNS:
                path = Path(self.path, f"{name}.npy")
                if not path.is_file():
                    raise InputError("path", self.path, f"a directory of {name}.npy and the like; it lacks {name}.npy")
                files[name] = stack.enter_context(path.open("rb"))
            if (weight := Path(self.path, f"{WEIGHT}.npy")).is_file():
                files[WEIGHT] = stack.enter_context(weight.open("rb"))
            return {name: (file, os.fstat(file.fileno()).st_size) for name, file in files.items()}
        archive = stack.enter_context(zipfile.ZipFile(self.path))
        check_directory(archive)
        members: dict[str, tuple[IO[bytes], int]] = {}
        there = archive.namelist()
        for name in COLUMNS if f"{WEIGHT}.npy" not in there else (*COLUMNS, WEIGHT):
            if f"{name}.npy" not in there:
                allowed = f"an npz with columns {', '.join(COLUMNS)}; it lacks {name}"
                raise InputError("path", self.path, allowed)
            member = stack.enter_context(archive.open(f"{name}.npy"))
            members[name] = member, archive.getinfo(f"{name}.npy").file_size
        return members


class Column:
    """One npy stream, read from front to end. Raises ValueError."""

    def __init__(self, name: str, file: IO[bytes], size: int) -> None:
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


class ColumnWriter:
    """Writes tuples to a directory of npy columns, in the memory of one chunk.

        with ColumnWriter("tuples") as writer:
            writer.append(chunk)

    The directory gets its name once it is whole. One of columns that has the name already is replaced then. Raises
    InputError for one that holds anything else, and for a link.
    """

    def __init__(self, directory: str | os.PathLike[str]) -> None:
        self.directory = Path(directory)
        self._temporary = self.directory.with_name(f".{self.directory.name}.{os.getpid()}.tmp")
        self._n = 0

    def __enter__(self) -> ColumnWriter:
        check_target("directory", self.directory)
        shutil.rmtree(self._temporary, ignore_errors=True)
        self._temporary.mkdir(parents=True)
        self._files: dict[str, IO[bytes]] = {}
        self._open(COLUMNS)
        return self

    def append(self, chunk: Transitions) -> None:
        """Raises InputError where some chunks have weights and others have none."""
        columns = chunk.arrays()
        if not self._n and WEIGHT in columns:
            self._open((WEIGHT,))
        if columns.keys() != self._files.keys():
            raise InputError(f"transitions.{WEIGHT}", "a column of some chunks", "a column of all chunks, or of none")
        for name, column in columns.items():
            column.astype(TYPES[name], copy=False).tofile(self._files[name])
        self._n += len(chunk)

    def _open(self, names: Sequence[str]) -> None:
        self._files |= {name: (self._temporary / f"{name}.npy").open("wb") for name in names}
        self._head()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
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
        """Rename the old directory, then the new one, and remove the old one last: a full one cannot be replaced."""
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
            # NumPy leaves room for any length, so that the numbers below stay where they are.
            npy.write_array_header_1_0(
                file, {"descr": TYPES[name].str, "fortran_order": False, "shape": (self._n,)}
            )  # fmt: skip


def check_target(key: str, path: str | os.PathLike[str]) -> None:
    """Raise InputError unless experience may be written to ``path``: nothing is there, or experience in our own format.

    That is a directory of the five columns, or an empty one, or an npz of the five columns; a link is neither.
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
    names = {entry.name.removesuffix(".npy"): entry.suffix for entry in entries}
    if names.keys() - {WEIGHT} != set(COLUMNS) or set(names.values()) != {".npy"}:
        return False
    columns = {}
    try:
        for name in names:
            if (path / f"{name}.npy").is_symlink():
                return False
            with (path / f"{name}.npy").open("rb") as file:
                columns[name] = Column(name, file, os.fstat(file.fileno()).st_size)
    except (OSError, ValueError, UserWarning):
        return False
    same_length = len({column.claimed for column in columns.values()}) == 1
    return same_length and all(column.dtype == TYPES[name] for name, column in columns.items())


def _our_npz(path: Path) -> bool:
    try:
        with zipfile.ZipFile(path) as archive:
            return set(archive.namelist()) - {f"{WEIGHT}.npy"} == {f"{name}.npy" for name in COLUMNS}
    except (OSError, zipfile.BadZipFile):
        return False
