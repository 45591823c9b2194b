"""The numbers of states and actions: of a problem that is known, or of the values that a whole table has.

What a column is of is judged by all of it. Where all its values are whole numbers (3, 3.0 and "3" are), so are the
labels; where all are numbers, the labels are these numbers as text; else all are texts.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from erl_torch.checks import InputError
from erl_torch.experience.formats.table import MISSING, Cells
from erl_torch.labels import Labels

NUMBER = re.compile(r"[+-]?((0|[1-9][0-9]*)(\.[0-9]*)?|\.[0-9]+)([eE][+-]?[0-9]+)?")
TRUE, FALSE = ("true", "t", "yes", "y", "1"), ("false", "f", "no", "n", "0")
LOST, UNKNOWN = -1, -2  # numbers of a missing value, and of one that is no state (or action)
MOST_LABELS = 1 << 22  # different values of a column
MOST_FRACTIONS = 1000  # different values of a column of numbers that are not whole


def number_of(value: object) -> int | float | None:
    """The number that ``value`` is or that it is written as, whole where it is; None where it is none."""
    if isinstance(value, bool):
        return None
    if isinstance(value, str):
        if not NUMBER.fullmatch(value):
            return None
        value = float(value) if set(".eE") & set(value) else int(value)
    if isinstance(value, float):
        return int(value) if value.is_integer() else value
    return value if isinstance(value, int) else None


def _name(value: object, kind: str) -> Any:
    """The label that a value of a column of this kind has; None for a missing value."""
    if value is None or value == "":
        return None
    if kind == "text":
        return value if isinstance(value, (str, tuple)) else str(value)
    number = number_of(value)
    return None if number is None else number if isinstance(number, int) else repr(number)


class Met:
    """The different values of the columns of a role, as they are met; then the labels that they are."""

    def __init__(self, key: str, width: int) -> None:
        self.key = key
        self._parts: list[dict[Any, None]] = [{} for _ in range(width)]
        self._tuples: dict[tuple[Any, ...], None] = {}

    def add(self, parts: Sequence[Cells], rows: np.ndarray) -> None:
        """Those of the ``rows`` [n] bool."""
        for known, cells in zip(self._parts, parts, strict=True):
            values, codes = cells.factors()
            used = np.unique(codes[rows])
            known |= dict.fromkeys(values[i] for i in used[used >= 0].tolist())
            if len(known) > MOST_LABELS:
                allowed = f"at most {MOST_LABELS:,} different values: make fewer states of them"
                raise InputError(self.key, f"more than {MOST_LABELS:,} values", allowed)
        if len(self._parts) > 1:
            values, codes = together(parts)
            used = np.unique(codes[rows])
            self._tuples |= dict.fromkeys(values[i] for i in used[used >= 0].tolist())

    def encoding(self) -> Encoding:
        """Raises InputError where there is no value, or numbers that have to be cut into bins."""
        kinds = [_kind(known) for known in self._parts]
        for kind, known in zip(kinds, self._parts, strict=True):
            if kind == "number" and len(known) > MOST_FRACTIONS:
                example = next(value for value in known if isinstance(number_of(value), float))
                allowed = f"cut into bins first: it has {len(known):,} different values that are not whole numbers"
                raise InputError(self.key, example, allowed)
        if len(kinds) == 1:
            labels = {_name(value, kinds[0]) for value in self._parts[0]}
        else:
            labels = {_tuple(value, kinds) for value in self._tuples}
        labels.discard(None)
        if not labels:
            raise InputError(self.key, "no value", "at least one row")
        ordered = sorted(labels, key=_order)
        if ordered == list(range(len(ordered))) and len(kinds) == 1:
            return Encoding(len(ordered), None, kinds)
        try:
            return Encoding(len(ordered), Labels.of_values(ordered), kinds)
        except InputError as error:  # of a text that is no label
            raise InputError(self.key, error.value, error.allowed) from error


def _kind(values: Iterable[object]) -> str:
    """What all values of a column are: "whole" numbers, "number"s, or "text"."""
    numbers = [number_of(value) for value in values if not (isinstance(value, str) and value.lower() in ("", *MISSING))]
    if not numbers or any(number is None for number in numbers):
        return "text"
    return "whole" if all(isinstance(number, int) for number in numbers) else "number"


def _tuple(value: tuple[Any, ...], kinds: Sequence[str]) -> tuple[Any, ...] | None:
    names = tuple(_name(part, kind) for part, kind in zip(value, kinds, strict=True))
    return None if None in names else names


def _order(label: Any) -> Any:
    """Numbers come before texts, in their order; so within tuples."""
    if isinstance(label, tuple):
        return (2, [_order(part) for part in label])
    number = number_of(label)
    return (0, number, str(label)) if number is not None else (1, label)


def together(parts: Sequence[Cells]) -> tuple[list[Any], np.ndarray]:
    """(distinct values, codes [n]) of one column, or of several as tuples."""
    values, codes = parts[0].factors()
    if len(parts) == 1:
        return values, codes
    factors = [part.factors() for part in parts]
    rows = np.stack([codes for _, codes in factors], 1)
    distinct, codes = np.unique(rows, axis=0, return_inverse=True)
    lost = np.asarray((distinct < 0).any(1))
    found = [
        None if gone else tuple(values[i] for (values, _), i in zip(factors, row, strict=True))
        for row, gone in zip(distinct.tolist(), lost.tolist(), strict=True)
    ]
    codes = codes.reshape(-1)
    return found, np.where(lost[codes], -1, codes)


@dataclass(frozen=True, eq=False)
class Encoding:
    """The numbers of states, or of actions.

    Args:
        n: how many there are.
        labels: their labels; None: they are numbers from 0.
        kinds: of the columns that the labels were made of; None where they are somebody else's.
    """

    n: int
    labels: Labels | None = None
    kinds: Sequence[str] | None = None
    _known: dict[Any, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.labels is not None:
            self._known.update({text: i for i, text in enumerate(self.labels.texts.tolist())})

    def codes(self, parts: Sequence[Cells]) -> np.ndarray:
        """[n] int64; ``LOST`` or ``UNKNOWN`` where there is none."""
        if self.labels is None and parts[0].codes is None and parts[0].values.dtype.kind in "biu":
            column = parts[0].values
            if len(column) and (column.min() < 0 or column.max() >= self.n):
                column = np.where((column >= 0) & (column < self.n), column.astype(np.int64), UNKNOWN)
            return np.asarray(column, np.int64)
        values, codes = together(parts)
        return np.asarray(np.array([self._code(value) for value in values] + [LOST], np.int64)[codes])

    def _code(self, value: Any) -> int:
        if value is None or value == "":
            return LOST
        if self.labels is None:
            if isinstance(value, str) and value.lower() in MISSING:
                return LOST
            number = int(value) if isinstance(value, bool) else number_of(value)
            return number if isinstance(number, int) and 0 <= number < self.n else UNKNOWN
        if self.kinds is not None:
            name = _tuple(value, self.kinds) if len(self.kinds) > 1 else _name(value, self.kinds[0])
            return LOST if name is None else self._known.get(_text(name), UNKNOWN)
        found = self._known.get(_text(value))
        if found is None:  # of other types: 3.0 for 3, texts for numbers
            parts = value if isinstance(value, tuple) else (value,)
            names = tuple(part if number_of(part) is None else number_of(part) for part in parts)
            found = self._known.get(_text(names if isinstance(value, tuple) else names[0]), UNKNOWN)
        return found

    @property
    def allowed(self) -> str:
        """What a value must be, for messages."""
        if self.labels is None:
            return f"a whole number in [0, {self.n})"
        few = ", ".join(self.labels.texts[:10].tolist())
        return f"one of {few}{'' if self.n <= 10 else f', ... ({self.n:,} of them)'}"


def _text(label: Any) -> str:
    return label if isinstance(label, str) else repr(label)


def truth(cells: Cells) -> np.ndarray:
    """[n]: 1 where it is true, 0 where it is false, -1 where it is missing or neither."""
    if cells.codes is None and cells.values.dtype.kind == "b":
        return np.asarray(cells.values.astype(np.int64))
    values, codes = cells.factors()
    texts = [str(value).lower().removesuffix(".0") for value in values]
    return np.asarray(np.array([1 if text in TRUE else 0 if text in FALSE else -1 for text in texts] + [-1])[codes])


def numbers(cells: Cells, decimal_comma: bool) -> np.ndarray:
    """[n] float64; NaN for what is missing or no number."""
    if cells.codes is None:
        with np.errstate(over="ignore"):
            return np.asarray(cells.values, np.float64)

    # All at once, if all are numbers.
    if not decimal_comma and not any("_" in value for value in cells.values if isinstance(value, str)):
        with contextlib.suppress(TypeError, ValueError, OverflowError):
            return np.asarray(np.append(np.array(cells.values, np.float64), np.nan)[cells.codes])

    def number(value: Any) -> float:
        if isinstance(value, str):
            if decimal_comma and "." not in value:
                value = value.replace(",", ".")
            if "_" in value:
                return np.nan
        try:
            return float(value)
        except (TypeError, ValueError, OverflowError):
            return np.nan

    return np.asarray(np.array([number(value) for value in cells.values] + [np.nan])[cells.codes])
