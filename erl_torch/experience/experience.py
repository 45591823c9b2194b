"""``Experience``, the contract of what learners learn from, and what can be done with anything that fulfils it.

``Transitions`` fulfils it in memory, ``erl_torch.experience.recording`` in files of any size.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Generic, Protocol, TypeVar, runtime_checkable

import numpy as np

from erl_torch.checks import InputError
from erl_torch.experience.transitions import COLUMNS, WEIGHT, Checksum, Transitions, regroup

EXPERIENCE = "experience, as of Transitions or read_experience"  # what is allowed, in messages
Part = TypeVar("Part")


@runtime_checkable
class Experience(Protocol):
    """A stream of tuples (s, a, r, s', a') of any size, in the order in which they are learnt from.

    Every pass over it gives the same tuples. What a learner computes from it does not depend on how it is cut.
    """

    def __len__(self) -> int:
        """Number of tuples, >= 1."""

    def check_range(self, n_states: int, n_actions: int) -> None:
        """Check that all s, s' are below ``n_states`` and all a, a' below ``n_actions``.

        Raises:
            InputError: a size below 1, or a tuple out of range; it names the first such tuple where it is known.
        """

    def chunks(self, multiple: int = 1) -> Iterator[Transitions]:
        """Make one pass: all tuples, in order, some at a time.

        Args:
            multiple: whole number >= 1; the length of every chunk but the last is a multiple of it.

        Raises:
            InputError: tuples that can no longer be read, or are no longer those of the first pass.
        """

    def checksum(self) -> int:
        """Checksum of all columns, in [0, 2**32), as of ``Checksum``. It does not depend on how the stream is cut."""


class Parts(Generic[Part]):
    """What ``make`` makes of each chunk. It is kept where the stream is in memory, else made again in every pass."""

    def __init__(self, data: Experience, make: Callable[[Transitions], Part], multiple: int = 1) -> None:
        self._data, self._make, self._multiple = data, make, multiple
        self._whole = [make(data)] if isinstance(data, Transitions) else []

    @property
    def whole(self) -> Part:
        """What was made of a stream in memory."""
        return self._whole[0]

    def __iter__(self) -> Iterator[Part]:
        return iter(self._whole) if self._whole else map(self._make, self._data.chunks(self._multiple))


class Selection:
    """The tuples of ``data`` in the masks [n] of ``takes_part`` (chunk -> mask): ``n_tuples`` of them, >= 1."""

    def __init__(self, data: Experience, takes_part: Callable[[Transitions], np.ndarray], n_tuples: int) -> None:
        self._data, self._takes_part, self._n = data, takes_part, n_tuples

    def __len__(self) -> int:
        return self._n

    def check_range(self, n_states: int, n_actions: int) -> None:
        self._data.check_range(n_states, n_actions)

    def chunks(self, multiple: int = 1) -> Iterator[Transitions]:
        masked = ((chunk, self._takes_part(chunk)) for chunk in self._data.chunks())
        return regroup((chunk.where(mask) for chunk, mask in masked if mask.any()), multiple)

    def checksum(self) -> int:
        running = Checksum()
        return [running.of(chunk) for chunk in self.chunks()][-1]


def permitted(
    data: Experience, prior: np.ndarray, next_actions: bool, told: Callable[[str], None] | None = None
) -> Experience:
    """The tuples of ``data`` whose action has a prior [S, A] above 0, and with ``next_actions`` whose a' has; ``data``
    itself where these are all.

    Args:
        data: the tuples.
        prior: [S, A]; 0 where a state does not have the action.
        next_actions: whether a' counts.
        told: called with a line that says how many are left out.

    Raises:
        InputError: a tuple out of range, or no tuple that is left.
    """
    there = prior > 0
    if there.all():
        return data
    data.check_range(*prior.shape)

    def taken(chunk: Transitions) -> np.ndarray:
        mask = there[chunk.s, chunk.a]
        return np.asarray(mask & there[chunk.s_next, chunk.a_next] if next_actions else mask)

    n = sum(int(taken(chunk).sum()) for chunk in data.chunks())
    if n == len(data):
        return data
    if not n:
        raise InputError("transitions", f"{len(data)} tuples", "some of actions whose prior is above 0")
    if told is not None:
        told(f"{len(data) - n:,} of {len(data):,} tuples are left out: the prior of their action is 0")
    return data.where(taken(data)) if isinstance(data, Transitions) else Selection(data, taken, n)


class Unweighted:
    """The same tuples as ``data``, each of weight 1."""

    def __init__(self, data: Experience) -> None:
        self._data = data

    def __len__(self) -> int:
        return len(self._data)

    def check_range(self, n_states: int, n_actions: int) -> None:
        self._data.check_range(n_states, n_actions)

    def chunks(self, multiple: int = 1) -> Iterator[Transitions]:
        return map(without_weight, self._data.chunks(multiple))

    def checksum(self) -> int:
        running = Checksum()
        return [running.of(chunk) for chunk in self.chunks()][-1]


def without_weight(chunk: Transitions) -> Transitions:
    return Transitions.checked(*(getattr(chunk, name) for name in COLUMNS))


def is_weighted(data: Experience) -> bool:
    """Whether the tuples have weights: those of the first chunk say it of all."""
    return next(data.chunks()).weight is not None


def check_unweighted(key: str, data: Experience, allowed: str) -> None:
    """Raise InputError, of the column, where there are weights that would count for nothing."""
    if is_weighted(data):
        raise InputError(f"{key}.{WEIGHT}", "a column", f"left out: {allowed}")


def weighing(data: Experience, n_states: int, n_actions: int) -> Experience:
    """The tuples of ``data`` whose weight is above 0; ``Unweighted`` where every weight is 1, and ``data`` itself where
    there are none.

    Raises:
        InputError: a tuple out of range, or a pair all of whose tuples have weight 0; it is named.
    """
    if not is_weighted(data):
        return data
    data.check_range(n_states, n_actions)
    largest = np.full(n_states * n_actions, -1.0)
    n, ones = 0, True
    for chunk in data.chunks():
        assert chunk.weight is not None
        np.maximum.at(largest, chunk.s * np.int32(n_actions) + chunk.a, chunk.weight)
        n += int((chunk.weight > 0).sum())
        ones = ones and bool((chunk.weight == 1).all())
    nothing = np.flatnonzero(largest == 0)
    if len(nothing):
        s, a = divmod(int(nothing[0]), n_actions)
        more = f" (and at {len(nothing) - 1} other pairs)" if len(nothing) > 1 else ""
        allowed = "above 0 somewhere: other dynamics lead where these tuples never do, which no weight makes up for"
        raise InputError(f"weight of state {s}, action {a}{more}", "0 in every tuple", allowed)
    if ones:
        return without_weight(data) if isinstance(data, Transitions) else Unweighted(data)
    if n == len(data):
        return data

    def counts(chunk: Transitions) -> np.ndarray:
        assert chunk.weight is not None
        return np.asarray(chunk.weight > 0)

    return data.where(counts(data)) if isinstance(data, Transitions) else Selection(data, counts, n)


def tuple_at(data: Experience, t: int) -> tuple[int, int, float]:
    """(s, a, r) of tuple ``t``."""
    for chunk in data.chunks():
        if t < len(chunk):
            return int(chunk.s[t]), int(chunk.a[t]), float(chunk.r[t])
        t -= len(chunk)
    raise IndexError(t)
