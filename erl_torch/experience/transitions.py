"""Tuples (s, a, r, s', a') in memory: ``Transitions``, five columns of one length, or six with weights."""

from __future__ import annotations

import os
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from erl_torch import checks
from erl_torch.checks import InputError
from erl_torch.files import read_npz, write_npz
from erl_torch.labels import Labels

COLUMNS = ("s", "a", "r", "s_next", "a_next")
WEIGHT = "weight"  # the column that need not be there
REAL = ("r", WEIGHT)  # columns of numbers that need not be whole
TYPES = {name: np.dtype("<f8" if name in REAL else "<i4") for name in (*COLUMNS, WEIGHT)}  # in files


@dataclass(frozen=True, eq=False)
class Transitions:
    """A stream of tuples, in the order in which they are learnt from.

    ``a_next`` is the action a' ~ prior(.|s') that the sampled backup of Algorithm S1 uses; it need not be
    the action taken next.

    Args:
        s, a, s_next, a_next: whole numbers >= 0, [N].
        r: finite rewards, [N].
        weight: finite numbers >= 0, [N], what each tuple counts for: p^(s'|s,a) / p(s'|s,a), of the dynamics that are
            to be learnt and those that the tuples are of, up to a factor of each pair (docs/other-dynamics.md). None: 1
            each.

    Raises:
        InputError: the column (and row) that is not as above.
    """

    s: np.ndarray  # [N] int32
    a: np.ndarray  # [N] int32
    r: np.ndarray  # [N] float64
    s_next: np.ndarray  # [N] int32
    a_next: np.ndarray  # [N] int32
    weight: np.ndarray | None = None  # [N] float64

    def __post_init__(self) -> None:
        for name in self.names:
            object.__setattr__(self, name, _column(name, getattr(self, name)))
        lengths = {name: len(column) for name, column in self.arrays().items()}
        if len(set(lengths.values())) > 1:
            raise InputError("columns", f"lengths {lengths}", "of one length")
        if len(self) == 0:
            raise InputError("transitions", "0 tuples", "at least one tuple")

    @classmethod
    def of_labels(
        cls,
        s: Iterable[object],
        a: Iterable[object],
        r: Iterable[float],
        s_next: Iterable[object],
        a_next: Iterable[object],
        states: Labels | None = None,
        actions: Labels | None = None,
        weight: Iterable[float] | None = None,
    ) -> Labelled:
        """Make them of columns [N] of labels, as ``erl_torch.Labels``: whole numbers, texts, tuples.

        Args:
            states, actions: labels that are known; None: those met, in the order in which they first appear, row by row
                and s, a before s', a'.
            weight: as of ``Transitions``.

        Raises:
            InputError: no label, or one that is not known; the message names column and row.
        """
        labels = {"s": states, "a": actions}
        columns = {name: _label_column(value) for name, value in zip(COLUMNS, (s, a, r, s_next, a_next), strict=True)}
        for name, known in labels.items():
            if known is None:
                both = zip(columns[name], columns[f"{name}_next"], strict=False)
                labels[name] = Labels.of_values(label for pair in both for label in pair)
        for name in ("s", "a", "s_next", "a_next"):
            own = labels[name[0]]
            assert own is not None
            columns[name] = own.encode_all(columns[name], name)
        weights = None if weight is None else _label_column(weight)
        return Labelled(cls(**columns, weight=weights), labels["s"], labels["a"])  # type: ignore[arg-type]

    def __len__(self) -> int:
        return len(self.s)

    @property
    def names(self) -> tuple[str, ...]:
        """Of the columns that there are."""
        return COLUMNS if self.weight is None else (*COLUMNS, WEIGHT)

    def arrays(self) -> dict[str, np.ndarray]:
        """The columns that there are, by name."""
        return {name: getattr(self, name) for name in self.names}

    def first(self, n: int) -> Transitions:
        """The first ``n`` tuples."""
        return self.where(slice(n))

    def where(self, rows: slice | np.ndarray) -> Transitions:
        """The tuples of a slice or mask; at least one."""
        return Transitions.checked(*(column[rows] for column in self.arrays().values()))

    @classmethod
    def checked(cls, *columns: np.ndarray) -> Transitions:
        """Make them of five columns, or six, that are known to be right, types and lengths included. Nothing is checked
        again."""
        if not len(columns[0]):
            raise InputError("transitions", "0 tuples", "at least one tuple")
        new = object.__new__(cls)
        weight = columns[len(COLUMNS)] if len(columns) > len(COLUMNS) else None
        for name, column in zip((*COLUMNS, WEIGHT), (*columns[: len(COLUMNS)], weight), strict=True):
            object.__setattr__(new, name, column)
        return new

    def chunks(self, multiple: int = 1) -> Iterator[Transitions]:
        """Yield itself, the one chunk."""
        yield self

    def checksum(self) -> int:
        """Of all columns."""
        return Checksum().of(self)

    def check_range(self, n_states: int, n_actions: int) -> None:
        """Raise InputError naming the first tuple with a state or action out of range."""
        checks.at_least("n_states", n_states, 1)
        checks.at_least("n_actions", n_actions, 1)
        for name, bound in (("s", n_states), ("a", n_actions), ("s_next", n_states), ("a_next", n_actions)):
            column = getattr(self, name)
            if column.max() >= bound:
                row = int(np.argmax(column >= bound))
                raise InputError(f"{name}[{row}]", int(column[row]), f"below {bound}")

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the columns to a compressed npz file (temporary name, then renamed)."""
        return write_npz(path, self.arrays())

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Transitions:
        """Read what ``save`` wrote, or any npz with the five columns, and weight if there; others are passed over.

        Raises InputError naming the file.
        """
        arrays = read_npz(path)
        missing = [name for name in COLUMNS if name not in arrays]
        if missing:
            raise InputError("path", path, f"an npz with columns {', '.join(COLUMNS)}; it lacks {missing[0]}")
        try:
            return cls(**{name: arrays[name] for name in (*COLUMNS, WEIGHT) if name in arrays})
        except InputError as error:
            raise error.of_file(path) from error


class Labelled(NamedTuple):
    """Tuples, and what their states and actions are called."""

    transitions: Transitions
    states: Labels
    actions: Labels


def _label_column(value: Any) -> Any:
    """A column that can be gone through more than once."""
    return value if isinstance(value, np.ndarray) else list(value)


class Checksum:
    """A running CRC-32 of each column."""

    def __init__(self) -> None:
        self.columns: dict[str, int] = {}

    def of(self, chunk: Transitions) -> int:
        """The checksum of all chunks so far, this one included."""
        for name, column in chunk.arrays().items():
            self.columns[name] = zlib.crc32(column.data, self.columns.get(name, 0))
        return zlib.crc32(np.array(list(self.columns.values()), "<u4").tobytes())


def regroup(chunks: Iterable[Transitions], multiple: int) -> Iterator[Transitions]:
    """The same tuples in chunks of multiples of ``multiple``; the last holds what is left."""
    held: list[Transitions] = []
    for chunk in chunks:
        held.append(chunk)
        n = sum(map(len, held))
        whole = n - n % multiple
        if whole:
            joined = join(held)
            held = []
            yield joined if whole == n else joined.where(slice(whole))
            if whole < n:  # copied: a view would hold on to the chunk
                held = [Transitions.checked(*(column[whole:].copy() for column in joined.arrays().values()))]
    if held:
        yield join(held)


def join(chunks: list[Transitions]) -> Transitions:
    """The tuples of ``chunks``, in order, as one: of one stream, so that all have weights or none has."""
    if len(chunks) == 1:
        return chunks[0]
    columns = [chunk.arrays() for chunk in chunks]
    return Transitions.checked(*(np.concatenate([column[name] for column in columns]) for name in columns[0]))


def _column(name: str, value: object) -> np.ndarray:
    column = checks.real(name, value)
    if column.ndim != 1:
        raise InputError(name, f"array of shape {column.shape}", "one-dimensional")
    if name in REAL:
        if column.dtype.kind == "b":
            raise InputError(name, f"dtype {column.dtype}", "an array of numbers")
        column = np.ascontiguousarray(column, dtype=np.float64)
        fits, allowed = checks.FINITE if name == "r" else checks.NOT_NEGATIVE
        if not (good := fits(column)).all():
            row = int(np.argmin(good))
            raise InputError(f"{name}[{row}]", column[row], allowed)
        return column
    if column.dtype.kind not in "iuf" and column.size:
        raise InputError(name, f"dtype {column.dtype}", "an array of whole numbers")
    if column.dtype.kind == "f" and not (whole := column == np.floor(column)).all():  # false for NaN
        row = int(np.argmin(whole))
        raise InputError(f"{name}[{row}]", column[row].item(), "a whole number in [0, 2**31)")
    if column.size and (column.min() < 0 or column.max() > np.iinfo(np.int32).max):
        row = int(np.argmax((column < 0) | (column > np.iinfo(np.int32).max)))
        raise InputError(f"{name}[{row}]", column[row].item(), "a whole number in [0, 2**31)")
    return np.ascontiguousarray(column, dtype=np.int32)
