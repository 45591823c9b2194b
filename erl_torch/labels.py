"""``Labels``: the names of states or actions, and their numbers from 0.

A label is a whole number, a text, a tuple of labels, or a dict {text: label}, as of Gymnasium's Dict spaces. Whatever
is equal once it is written as text is the same label: ``3`` and ``"3"``, ``np.int64(3)`` and ``3.0``, a list and an
array and a tuple of the same entries.
"""

from __future__ import annotations

import ast
import difflib
import math
from collections.abc import Iterable, Iterator, Mapping
from functools import cached_property
from typing import Any, NamedTuple, Protocol, TypeGuard

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from erl_torch import checks
from erl_torch.checks import InputError

Label = Any  # int | str | tuple[Label, ...] | dict[str, Label]: mypy has no recursive types for isinstance

ALLOWED = "a whole number, a text, or a tuple or dict of such"
MOST = 2**31 - 1  # states or actions: tuples hold them in 32 bits


class Names(NamedTuple):
    """What texts for people call states and actions."""

    states: Labels | None = None  # None: their numbers
    actions: Labels | None = None

    def state(self, s: int, symbol: str = "s") -> str:
        return f"{symbol}={s if self.states is None else self.states.text(int(s))}"

    def pair(self, s: int, a: int) -> str:
        return f"{self.state(s)}, a={a if self.actions is None else self.actions.text(int(a))}"


NUMBERS = Names()


class Labels:
    """An ordered finite set of labels, numbered from 0.

    ``Labels.of_values``, ``Labels.of_space`` and ``Labels.of_texts`` make them.
    """

    def __init__(self, labels: tuple[Label, ...]) -> None:
        self._labels = labels

    @classmethod
    def of_values(cls, values: Iterable[object]) -> Labels:
        """The different ones of ``values``, in the order in which they first appear.

        Raises:
            InputError: no value, or one that is no label; it names the first.
        """
        if _plain_column(values):
            values = values[np.sort(np.unique(values, return_index=True)[1])]
        first: dict[str, Label] = {}
        for i, value in enumerate(values):
            label = canonical(f"labels[{i}]", value)
            first.setdefault(text(label), label)
        if not first:
            raise InputError("labels", "0 of them", "at least one")
        return cls(tuple(first.values()))

    @staticmethod
    def of_space(space: gym.Space[Any]) -> SpaceLabels:
        """The members of a finite space: Discrete, MultiDiscrete, MultiBinary, a Box of bounded whole numbers, and
        Tuple and Dict of such. In the order of their entries: the last one counts fastest. A Dict's entries are in
        the order of their names.

        Raises:
            InputError: a space that is not finite, or one with 2**31 members or more.
        """
        return SpaceLabels(space)

    @classmethod
    def of_texts(cls, texts: Iterable[object]) -> Labels:
        """The labels behind ``texts``, as they were saved.

        A text that is written as a whole number, a tuple or a dict comes back as such.

        Raises:
            InputError: no text, something else than a text, or the same one twice.
        """
        labels = cls.of_values(map(_read, texts := list(texts)))
        if len(labels) < len(texts):
            twice = next(x for i, x in enumerate(texts) if x in texts[:i])
            raise InputError("labels", twice, "there once only")
        return labels

    def __len__(self) -> int:
        return len(self._labels)

    def __iter__(self) -> Iterator[Label]:
        return map(self.decode, range(len(self)))

    def __eq__(self, other: object) -> bool:
        """Whether they are the same labels in the same order."""
        if not isinstance(other, Labels) or len(self) != len(other):
            return False
        return all(text(a) == text(b) for a, b in zip(self, other, strict=True))

    __hash__ = None  # type: ignore[assignment]  # too long to hash

    def encode(self, value: object, key: str = "label") -> int:
        """The number of a label. Raises InputError under ``key`` for one that is not among them."""
        label = canonical(key, value)
        number = self._numbers.get(text(label))
        if number is None:
            raise InputError(key, label, self._allowed(label))
        return number

    def encode_all(self, values: Iterable[object], key: str = "label") -> np.ndarray:
        """The numbers [N] int64 of a column of labels. Raises InputError under ``key``, with the first row."""
        if _plain_column(values):
            different, first, place = np.unique(values, return_index=True, return_inverse=True)
            numbers = np.empty(len(different), np.int64)
            for i in np.argsort(first):  # so that the first row that is wrong is named
                numbers[i] = self.encode(different[i], f"{key}[{first[i]}]")
            return numbers[place]
        return np.array([self.encode(value, f"{key}[{i}]") for i, value in enumerate(values)], np.int64)

    def decode(self, number: int) -> Label:
        """The label of a number. Raises InputError for one that is not in [0, n)."""
        return self._labels[self._in_range(number)]

    def text(self, number: int) -> str:
        """The label of a number as text. Raises InputError for a number that is not in [0, n)."""
        return text(self.decode(number))

    @property
    def texts(self) -> np.ndarray:
        """[n] of numpy's texts: the labels in order, as files hold them."""
        return np.array([text(label) for label in self], dtype=np.str_)

    @cached_property
    def _numbers(self) -> dict[str, int]:
        return {text(label): i for i, label in enumerate(self._labels)}

    def _in_range(self, number: int) -> int:
        number = checks.at_least("number", number, 0)
        if number >= len(self):
            raise InputError("number", number, f"below {len(self)}, the number of labels")
        return number

    def _allowed(self, label: Label) -> str:
        close = difflib.get_close_matches(text(label), self._numbers, 1)
        meant = f" (did you mean {close[0]}?)" if close else ""
        few = ", ".join(list(self._numbers)[:10])
        return f"one of {few}{'' if len(self) <= 10 else f', ... ({len(self):,} of them)'}{meant}"


class SpaceLabels(Labels):
    """The members of a finite space; see ``Labels.of_space``. They are computed, not listed."""

    def __init__(self, space: gym.Space[Any]) -> None:
        self.space = space
        self._part = _part(space)
        if self._part.n > MOST:
            few = f"smaller: it has {_count(self._part.n)} members, and 2**31 - 1 are allowed"
            raise InputError("space", space, few)

    def __len__(self) -> int:
        return self._part.n

    def __eq__(self, other: object) -> bool:
        if isinstance(other, SpaceLabels) and self.space == other.space:
            return True
        return super().__eq__(other)

    __hash__ = None

    def encode(self, value: object, key: str = "label") -> int:
        """The number of a member of the space, or of its label. Raises InputError under ``key`` for anything else."""
        try:
            return self._part.encode(value)
        except _Outside as error:
            if isinstance(value, str) and not isinstance(read := _read(value), str):
                return self.encode(read, key)
            raise InputError(key, value, f"in {self.space}{error}") from None

    def encode_batch(self, values: object, n: int, key: str = "label") -> np.ndarray:
        """The numbers [n] int64 of ``n`` members, batched as Gymnasium's vector environments do.

        Raises InputError under ``key``, with the place in the batch of the first one that is not in the space.
        """
        try:
            return self._part.encode_batch(values, n)
        except _Outside as error:
            place = "" if error.place is None else f"[{error.place}]"
            raise InputError(f"{key}{place}", error.value, f"in {self.space}{error}") from None

    def decode(self, number: int) -> Label:
        return self._part.decode(self._in_range(number))

    def member(self, number: int) -> Any:
        """The member of the space with a number, of the types that the space asks for."""
        return self._part.member(self._in_range(number))


def canonical(key: str, value: object) -> Label:
    """``value`` as a label. Raises InputError under ``key`` if it is none."""
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, (bool, np.bool_, int, np.integer)):
        return int(value)
    if isinstance(value, (float, np.floating)) and float(value).is_integer():
        return int(value)
    if isinstance(value, str):
        plain = str.__str__(value)
        try:
            plain.encode()
        except UnicodeEncodeError as error:
            raise InputError(key, ascii(plain), "a text that can be written in UTF-8") from error
        if "\0" in plain:  # which numpy's texts lose at their end
            raise InputError(key, ascii(plain), "a text without the character NUL")
        return plain
    if isinstance(value, (tuple, list)):
        return tuple(canonical(key, item) for item in value)
    if isinstance(value, Mapping) and all(isinstance(name, str) for name in value):
        return {canonical(key, name): canonical(key, value[name]) for name in sorted(value)}
    raise InputError(key, f"{value!r} ({type(value).__name__})", ALLOWED)


def _plain_column(values: object) -> TypeGuard[np.ndarray]:
    """Whether ``values`` is a column that numpy sorts: the distinct ones are then looked at alone."""
    return isinstance(values, np.ndarray) and values.ndim == 1 and values.dtype.kind in "iuU"


def text(label: Label) -> str:
    """A label as text: a text as it is, anything else as Python writes it."""
    return label if isinstance(label, str) else repr(label)


def _read(value: object) -> Label:
    """The label that is written as ``value``; a text that no other label is written as stays one."""
    if not isinstance(value, str):
        raise InputError("labels", f"{value!r} ({type(value).__name__})", "texts")
    try:
        label = canonical("labels", ast.literal_eval(value))
    except (ValueError, SyntaxError, MemoryError, RecursionError, TypeError):  # InputError is a ValueError
        return value
    return label if text(label) == value else value


def _count(n: int) -> str:
    return f"{n:,}" if n < 10**15 else f"about 1e{math.log10(n):.0f}"


# -- members of spaces --------------------------------------------------------------------------------------


class _Outside(Exception):
    """A value is not in its space; the text says more, in brackets, or nothing."""

    def __init__(self, reason: str = "", value: object = None, place: int | None = None) -> None:
        super().__init__(f" ({reason})" if reason else "")
        self.value, self.place = value, place


class _Part(Protocol):
    """A finite space, and the numbers [0, n) of its members."""

    n: int

    def encode(self, value: object) -> int: ...

    def encode_batch(self, values: object, n: int) -> np.ndarray: ...

    def decode(self, number: int) -> Label: ...

    def member(self, number: int) -> Any: ...


class _Grid:
    """Arrays of whole numbers: entry i lies in [low_i, low_i + size_i). Discrete is one of shape ()."""

    def __init__(self, low: np.ndarray, size: list[int], dtype: Any) -> None:
        self.shape, self.dtype = low.shape, dtype
        self.n = math.prod(size)
        self.low = low.reshape(-1)
        if self.n > MOST:
            return  # refused by the caller, once it is known how many there are in all
        self.size = np.array(size, np.int64)
        # Compared with, as a difference from ``low`` may leave the range of int64.
        last = (int(x) + n - 1 for x, n in zip(self.low.tolist(), size, strict=True))
        self.last = np.array([min(x, checks.LARGEST_INTEGER) for x in last], np.int64)
        self.strides = np.array([math.prod(size[i + 1 :]) for i in range(len(size))], np.int64)

    def encode(self, value: object) -> int:
        if not self.shape and isinstance(value, (int, np.integer)):  # the short way, for each step of an environment
            number = int(value) - int(self.low[0])
            if 0 <= number < self.n:
                return number
        return int(self._encode(value, self.shape).reshape(-1) @ self.strides)

    def encode_batch(self, values: object, n: int) -> np.ndarray:
        return np.asarray(self._encode(values, (n, *self.shape)) @ self.strides)

    def _encode(self, value: object, shape: tuple[int, ...]) -> np.ndarray:
        """Entries from 0, [values, entries of one] int64."""
        try:
            array = np.asarray(value)
        except (ValueError, TypeError, RuntimeError) as error:
            raise _Outside(type(value).__name__, value) from error
        if array.shape != shape:
            raise _Outside(f"not an array of shape {array.shape}" if array.ndim else "", value)
        if array.dtype.kind not in "iufb":
            raise _Outside(f"not {type(value).__name__}", value)
        entries = array.reshape(math.prod(shape[: len(shape) - len(self.shape)]), len(self.low))
        if array.dtype.kind == "f":
            good = np.isfinite(entries) & (entries == np.floor(entries)) & (abs(entries) < 2**63)
        else:
            good = entries <= checks.LARGEST_INTEGER
        whole = np.where(good, entries, 0).astype(np.int64)
        good &= (whole >= self.low) & (whole <= self.last)
        if not good.all():
            row = int(np.argmin(good.all(1)))
            raise _Outside("", array[row] if array.ndim > len(self.shape) else value, row)
        return np.asarray(whole - self.low)

    def decode(self, number: int) -> Label:
        return canonical("label", self._entries(number).tolist())

    def member(self, number: int) -> Any:
        entries = self._entries(number).astype(self.dtype)
        return entries if self.shape else entries[()]

    def _entries(self, number: int) -> np.ndarray:
        return np.asarray(number // self.strides % self.size + self.low).reshape(self.shape)


class _Product:
    """Members of several spaces at once, as a tuple or, with ``names``, as a dict."""

    def __init__(self, parts: list[_Part], names: list[str] | None) -> None:
        self.parts, self.names = parts, names
        self.n = math.prod(part.n for part in parts)

    def encode(self, value: object) -> int:
        number = 0
        for part, item in zip(self.parts, self._items(value), strict=True):
            number = number * part.n + part.encode(item)
        return number

    def encode_batch(self, values: object, n: int) -> np.ndarray:
        number = np.zeros(n, np.int64)
        for part, item in zip(self.parts, self._items(values), strict=True):
            number = number * part.n + part.encode_batch(item, n)
        return number

    def _items(self, value: object) -> list[Any]:
        if self.names is None:
            if not isinstance(value, (tuple, list, np.ndarray)) or len(value) != len(self.parts):
                raise _Outside(f"a tuple of {len(self.parts)}", value)
            return list(value)
        if not isinstance(value, Mapping):
            raise _Outside(f"a dict with {', '.join(self.names)}", value)
        if set(value) != set(self.names):
            raise _Outside(f"with the keys {', '.join(self.names)}, and no other", value)
        return [value[name] for name in self.names]

    def decode(self, number: int) -> Label:
        items = [part.decode(i) for part, i in zip(self.parts, self._numbers(number), strict=True)]
        return tuple(items) if self.names is None else dict(zip(self.names, items, strict=True))

    def member(self, number: int) -> Any:
        items = [part.member(i) for part, i in zip(self.parts, self._numbers(number), strict=True)]
        return tuple(items) if self.names is None else dict(zip(self.names, items, strict=True))

    def _numbers(self, number: int) -> list[int]:
        numbers = []
        for part in reversed(self.parts):
            number, i = divmod(number, part.n)
            numbers.append(i)
        return numbers[::-1]


def _part(space: gym.Space[Any]) -> _Part:
    """Raises InputError for a space that is not finite."""
    if isinstance(space, spaces.Discrete):
        return _Grid(np.array(space.start, np.int64), [int(space.n)], space.dtype)
    if isinstance(space, spaces.MultiDiscrete):
        return _Grid(np.asarray(space.start, np.int64), [int(n) for n in space.nvec.flat], space.dtype)
    if isinstance(space, spaces.MultiBinary):
        return _Grid(np.zeros(space.shape, np.int64), [2] * math.prod(space.shape), space.dtype)
    if isinstance(space, spaces.Box) and space.dtype is not None and space.dtype.kind in "iu":
        if int(space.high.max(initial=0)) > checks.LARGEST_INTEGER:
            raise InputError("space", space, "one of whole numbers below 2**63")
        sizes = [int(high) - int(low) + 1 for low, high in zip(space.low.flat, space.high.flat, strict=True)]
        return _Grid(space.low.astype(np.int64), sizes, space.dtype)
    if isinstance(space, spaces.Tuple):
        return _Product([_part(part) for part in space.spaces], None)
    if isinstance(space, spaces.Dict):
        names = sorted(map(str, space.spaces))  # files and Gymnasium order them in several ways
        return _Product([_part(space.spaces[name]) for name in names], names)
    allowed = "a finite space: Discrete, MultiDiscrete, MultiBinary, a Box of whole numbers, or Tuple and Dict of such"
    raise InputError("space", space, allowed)
