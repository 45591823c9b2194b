"""From the rows of a table to tuples (s, a, r, s', a').

A row is a step: its state s, its action a, its reward r and, where there are such columns, the state after (``s_next``),
the action drawn there (``a_next``), whether the step ``terminated`` or ``truncated`` its episode, the ``episode`` it is
of and the ``step`` of that. Columns are found by the names in ``NAMES``, in upper or lower case, or as the user says.

Ends, as in ``erl_torch.experience.collect``. Where a row terminates its episode, s' is the state of the next row, the
first of the next episode (the first row follows the last). Where an episode is truncated, or just ends, s' is
``s_next``; without such a column it is not known, and the row is left out. In between, s' is ``s_next`` or, without such
a column, the state of the next row; where a column ``step`` shows that rows are missing in between, it is not known
either.

a' is what ``a_next`` has; where that is missing, or the prior policy of the state lacks it, or the step terminated, it is
drawn from the prior at s', with the stream "behaviour" of the seed, one number a row.

A row is bad where a value that is needed is missing or is no such value. Rows are named by their place in the file,
from 0.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from erl_torch.checks import InputError
from erl_torch.experience.formats import table
from erl_torch.experience.formats.format import Batch, Options
from erl_torch.experience.formats.table import Cells, Sorted, Table
from erl_torch.labels import Labels
from erl_torch.mdp.tabular import check_policy
from erl_torch.rng import streams

NAMES = {
    "s": "s state states obs observation observations",
    "a": "a action actions",
    "r": "r reward rewards",
    "s_next": "s_next s' next_s next_state next_states next_obs next_observation next_observations",
    "a_next": "a_next a' next_a next_action next_actions",
    "terminated": "terminated terminal terminals terminations done dones",
    "truncated": "truncated truncations timeout timeouts",
    "episode": "episode episodes episode_id",
    "step": "step steps t",
}
NEEDED = ("s", "a", "r")
TRUE, FALSE = ("true", "t", "yes", "y", "1"), ("false", "f", "no", "n", "0")
MISSING = ("na", "n/a", "nan", "null", "none", "#n/a", "<na>", "-")  # in a column of numbers
NUMBER = re.compile(r"[+-]?(0|[1-9][0-9]*)?(\.[0-9]+|(?<=[0-9])\.)?([eE][+-]?[0-9]+)?")
MOST_LABELS = 1 << 22  # different values of a column
MOST_SORTED = 1 << 22  # rows that are put in order in memory
MOST_FRACTIONS = 1000  # different values of a column of numbers that are not whole, as states or actions
MOST_STRIDES = 1000
SHOWN = 30  # names of columns in a message

Roles = dict[str, tuple[str, ...]]
"""The columns of each role that there is: several columns make a tuple."""


def roles_of(source: Table, columns: Mapping[str, Any] | None, key: str = "columns") -> Roles:
    """Which columns of ``source`` are which.

    Args:
        source: has the names.
        columns: names by role, as the user says; None for a role is none of it. A list of names is a tuple of columns.
        key: of ``columns``, in messages.

    Raises:
        InputError: a role that is none, a column that is not there, is there twice, or cannot be told.
    """
    there = ", ".join(source.names[:SHOWN]) + ", ..." * (len(source.names) > SHOWN)
    roles: Roles = {}
    chosen = dict(columns or {})
    for role, given in chosen.items():
        if role not in NAMES:
            raise InputError(f"{key}.{role}", given, f"left out: no such column; there are {', '.join(NAMES)}")
        names = (
            () if given is None else tuple(map(str, given)) if isinstance(given, Sequence) and not isinstance(given, str)
            else (str(given),)
        )  # fmt: skip
        if len(names) > 1 and role not in ("s", "a", "s_next", "a_next"):
            raise InputError(f"{key}.{role}", list(names), "one column")
        for name in names:
            if name not in source.names:
                raise InputError(f"{key}.{role}", name, f"a column of {source.path}; the columns are {there}")
        if names:
            roles[role] = names
    taken = {name for names in roles.values() for name in names}
    for role, usual in NAMES.items():
        if role in chosen:
            continue
        found = [name for name in source.names if _plain(name) in usual.split() and name not in taken]
        if len(found) > 1:
            allowed = f"one column: say which, {key}.{role}=NAME; the columns are {there}"
            raise InputError(f"path={source.path}: {role}", " and ".join(found), allowed)
        if found:
            roles[role] = (found[0],)
    for role in NEEDED:
        if role not in roles:
            usual = ", ".join(NAMES[role].split())
            allowed = f"a column named {usual}, or any other: {key}.{role}=NAME; the columns are {there}"
            raise InputError(f"path={source.path}: {role}", "missing", allowed)
    for name in {name for names in roles.values() for name in names}:
        if list(source.names).count(name) > 1:
            raise InputError(f"path={source.path}: {name}", "two columns", "the name of one column")
    if "s_next" not in roles and not {"episode", "terminated", "truncated"} & roles.keys():
        allowed = (
            "a column, or else one that tells the episodes or their ends, so that it is the state of the next row: "
            f"{key}.s_next=NAME, {key}.episode=NAME, {key}.terminated=NAME or {key}.truncated=NAME; the columns are "
            f"{there}"
        )
        raise InputError(f"path={source.path}: s_next", "missing", allowed)
    return roles


def claims(path: str) -> bool:
    return table.claims(path)


def reader(path: str, options: Options) -> Rows:
    """Of a file, or a directory of parts, that ``claims`` knows."""
    return reader_of(table.open_table(path), options)


def reader_of(source: Table, options: Options) -> Rows:
    """Of a table whose sizes are known. Raises InputError."""
    roles = roles_of(source, options.columns)
    prior = check_policy("prior_policy", options.prior_policy, options.n_states, options.n_actions)
    states = Encoding(options.n_states, options.state_labels)
    actions = Encoding(options.n_actions, options.action_labels)
    source = in_order(source, roles)
    stride = stride_of(source, roles, "columns.step" if "step" in (options.columns or {}) else "")
    return Rows(source, roles, states, actions, prior, options.on_prior, options.seed, stride)


def _plain(name: str) -> str:
    return re.sub(r"[\s-]+", "_", name.strip().lower())


# -- labels ------------------------------------------------------------------------------------------------


def number_of(value: object) -> int | float | None:
    """The number that ``value`` is or that it is written as, whole where it is; None where it is none."""
    if isinstance(value, bool):
        return None
    if isinstance(value, str):
        if not NUMBER.fullmatch(value) or not any(map(str.isdigit, value)):
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
        self.key, self._parts = key, [{} for _ in range(width)]  # type: list[dict[Any, None]]
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
        return Encoding(len(ordered), Labels.of_values(ordered), kinds)


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
    lost = (distinct < 0).any(1)
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
        """[n] int64; -1 for a missing value, -2 for one that is no state (or action)."""
        if self.labels is None and len(parts) == 1 and parts[0].codes is None:
            numbers = parts[0].values
            if numbers.dtype.kind == "f":
                good = (numbers >= 0) & (numbers < self.n) & (numbers == np.floor(numbers))
                return np.where(np.isnan(numbers), -1, np.where(good, np.where(good, numbers, 0).astype(np.int64), -2))
            if len(numbers) and (numbers.min() < 0 or numbers.max() >= self.n):
                good = (numbers >= 0) & (numbers < self.n)
                return np.where(good, np.where(good, numbers, 0).astype(np.int64), -2)
            return np.asarray(numbers.astype(np.int64))
        values, codes = together(parts)
        return np.array([self._code(value) for value in values] + [-1], np.int64)[codes]

    def _code(self, value: Any) -> int:
        if value is None or value == "":
            return -1
        if self.labels is None:
            if isinstance(value, str) and value.lower() in MISSING:
                return -1
            number = int(value) if isinstance(value, bool) else number_of(value)
            return number if isinstance(number, int) and 0 <= number < self.n else -2
        if self.kinds is not None:
            name = _tuple(value, self.kinds) if len(self.kinds) > 1 else _name(value, self.kinds[0])
            return -1 if name is None else self._known.get(_text(name), -2)
        found = self._known.get(_text(value))
        if found is None:  # of other types: 3.0 for 3, texts for numbers
            parts = value if isinstance(value, tuple) else (value,)
            names = tuple(part if number_of(part) is None else number_of(part) for part in parts)
            found = self._known.get(_text(names if isinstance(value, tuple) else names[0]), -2)
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


# -- rows --------------------------------------------------------------------------------------------------


@dataclass
class Seen:
    """What a pass over the rows has met."""

    rows: int = 0
    episodes: int = 0
    terminated: int = 0  # of the episodes
    truncated: int = 0
    gaps: int = 0  # rows that do not go on where the row before led to
    last: int = 0  # last rows of episodes, left out: no state after
    before_gaps: int = 0  # rows left out: the next row is missing
    bad: int = 0
    first_bad: str = ""
    sum_of_rewards: float = 0.0  # of the tuples

    def content(self) -> dict[str, Any]:
        return dict(vars(self))


class Block(NamedTuple):
    """Some rows, encoded: [n] each."""

    row: np.ndarray  # place in the table
    s: np.ndarray
    a: np.ndarray
    r: np.ndarray
    s_next: np.ndarray  # -3: not in the table
    a_next: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    begins: np.ndarray  # another episode than the row before's, by its column
    step: np.ndarray  # NaN: not in the table
    bad: np.ndarray
    x: np.ndarray  # in [0, 1), for a'

    def at(self, rows: slice) -> Block:
        return Block(*(column[rows] for column in self))


def joined(blocks: Sequence[Block]) -> Block:
    return Block(*(np.concatenate(columns) for columns in zip(*blocks, strict=True)))


class Rows:
    """A reader (``erl_torch.experience.formats.format.Reader``) of the rows of a table.

    Args:
        table, roles: what is read; episodes stand together (``in_order``).
        states, actions: their numbers.
        prior_policy: [S, A], behind a'; None: a' is 0 where it is not recorded.
        on_prior: a' is the action of the next row, where that follows.
        seed: of a' where it is drawn.
        stride: of ``step`` from row to row; 0: it tells nothing.

    ``seen`` is what the last pass met, or the present one has met so far.
    """

    def __init__(
        self,
        table: Table,
        roles: Roles,
        states: Encoding,
        actions: Encoding,
        prior_policy: np.ndarray | None = None,
        on_prior: bool = False,
        seed: int = 0,
        stride: float = 0.0,
    ) -> None:
        self.path, self.short = table.path, 0
        self._table, self._roles, self._stride = table, roles, stride
        self._encodings = {"s": states, "s_next": states, "a": actions, "a_next": actions}
        self._prior, self._on_prior, self._seed = prior_policy, on_prior, seed
        self._cdf = None if prior_policy is None else np.cumsum(prior_policy, axis=1)
        self._of_next_row = "s_next" not in roles
        self._has_ends = bool({"episode", "terminated", "truncated"} & roles.keys())
        self._looks_on = self._has_ends or self._of_next_row or on_prior
        self.seen = Seen()

    @property
    def first_bad(self) -> str:
        return self.seen.first_bad

    def batches(self, rows: int, strict: bool) -> Iterator[Batch]:
        self.seen, self.short = Seen(), 0
        held: Block | None = None  # the last row so far: what becomes of it depends on the next
        first_s = -1
        before: tuple[int, bool] | None = None  # where the row before the block led to, and whether it ended there
        for block in self._blocks(rows, strict):
            first_s = int(block.s[0]) if held is None and self.seen.episodes == 0 and before is None else first_s
            whole = block if held is None else joined([held, block])
            if self.seen.episodes == 0:
                self.seen.episodes = 1
            now, held = whole.at(slice(-1)), whole.at(slice(-1, None))
            if len(now.s):
                batch, before = self._tuples(now, whole.at(slice(1, None)), strict, before)
                if len(batch["s"]):
                    yield batch
        if held is not None:
            batch, _ = self._tuples(held, None, strict, before, first_s)
            if len(batch["s"]):
                yield batch
        self.seen.bad += self._table.invalid
        self.short = self.seen.bad

    def _blocks(self, rows: int, strict: bool) -> Iterator[Block]:
        names = list(dict.fromkeys(name for columns in self._roles.values() for name in columns))
        rng = streams(self._seed).behaviour
        last: tuple[Any, ...] | None = None  # the episode of the last row
        for found in self._table.batches(names, rows, strict):
            parts = {role: [found[name] for name in columns] for role, columns in self._roles.items()}
            n = parts["s"][0].n_rows
            if not n:
                continue
            row = np.arange(self.seen.rows, self.seen.rows + n)
            wrong = _Wrong(self, row, strict)
            codes = {role: self._coded(role, parts, n, wrong) for role in ("s", "a", "s_next", "a_next")}
            r = numbers(parts["r"][0], self._table.decimal_comma)
            allowed = "finite" if parts["r"][0].codes is None else "a finite number"
            wrong.found("r", ~np.isfinite(r), parts["r"], allowed)
            flags = {role: self._flag(role, parts, n, wrong) for role in ("terminated", "truncated")}
            if {"done", "dones"} & set(map(_plain, self._roles.get("terminated", ()))):
                flags["terminated"] &= ~flags["truncated"]  # it is true at time limits too
            begins = np.zeros(n, bool)
            if "episode" in parts:
                values, episode = parts["episode"][0].factors()
                wrong.found("episode", episode < 0, parts["episode"], "there")
                begins[1:] = episode[1:] != episode[:-1]
                ids = (values[episode[0]] if episode[0] >= 0 else None, values[episode[-1]] if episode[-1] >= 0 else None)
                begins[0] = last is not None and last != (ids[0],)
                last = (ids[1],)
            step = np.full(n, np.nan)
            if self._stride:
                step = numbers(parts["step"][0], False)
                wrong.found("step", ~np.isfinite(step), parts["step"], "a finite number")
            self.seen.rows += n
            x = rng.random(n) if self._cdf is not None else np.zeros(n)
            yield Block(row, codes["s"], codes["a"], r, codes["s_next"], codes["a_next"], flags["terminated"],
                        flags["truncated"], begins, step, wrong.raised(), x)  # fmt: skip

    def _coded(self, role: str, parts: Mapping[str, Sequence[Cells]], n: int, wrong: _Wrong) -> np.ndarray:
        """[n] numbers of the values of a role; -3 where there is no such column."""
        if role not in parts:
            return np.full(n, -3)
        encoding = self._encodings[role]
        codes = encoding.codes(parts[role])
        # What may be missing is looked at once it is known whether it is needed.
        wrong.found(role, codes < 0 if role in NEEDED else codes == -2, parts[role], encoding.allowed)
        return codes

    def _flag(self, role: str, parts: Mapping[str, Sequence[Cells]], n: int, wrong: _Wrong) -> np.ndarray:
        if role not in parts:
            return np.zeros(n, bool)
        known = truth(parts[role][0])
        wrong.found(role, known < 0, parts[role], "true or false")
        return np.asarray(known == 1)

    def _tuples(
        self,
        now: Block,
        then: Block | None,
        strict: bool,
        before: tuple[int, bool] | None,
        first_s: int = -1,
    ) -> tuple[Batch, tuple[int, bool]]:
        """The tuples of the rows ``now``; ``then`` are the rows after each of them, None after the last of all."""
        n = len(now.s)
        following = np.array([first_s] * n) if then is None else then.s
        ends = now.terminated | now.truncated | (True if then is None else then.begins)
        s_next, out = now.s_next.copy(), np.zeros(n, bool)
        if self._looks_on:
            lost = s_next < 0
            out = lost & ends & ~now.terminated  # an episode that is truncated, or just ends
            self.seen.last += int((out & ~now.bad).sum())
            if self._of_next_row and then is not None:
                gap = ~ends & (following < 0)
                if self._stride:
                    gap |= ~ends & (then.step - now.step != self._stride)
                    self.seen.gaps += int((~ends & (then.step - now.step != self._stride)).sum())
                self.seen.before_gaps += int((gap & ~now.bad).sum())
                out |= gap
                s_next = np.where(~ends & ~gap, following, s_next)
            s_next = np.where(now.terminated, following, s_next)
            unknown = now.terminated & (following < 0)
            self.seen.before_gaps += int((unknown & ~now.bad).sum())
            out |= unknown
        bad = now.bad
        missing = ~bad & ~out & (s_next < 0)
        if missing.any():
            i = int(np.argmax(missing))
            name = self.place("s_next", int(now.row[i]))
            if strict:
                raise InputError(f"path={self.path}: {name}", "missing", self._encodings["s_next"].allowed)
            self.seen.first_bad = self.seen.first_bad or f"{name}=missing"
            bad = bad | missing
        self.seen.bad += int(bad.sum())
        if not self._of_next_row:
            led = np.concatenate(([before[0] if before else -1], now.s_next[:-1]))
            over = np.concatenate(([before[1] if before else True], ends[:-1]))
            self.seen.gaps += int((~over & (led >= 0) & (now.s >= 0) & (led != now.s)).sum())
        if self._has_ends:
            self.seen.terminated += int(now.terminated.sum())
            self.seen.truncated += int((now.truncated & ~now.terminated).sum())
            self.seen.episodes += int(ends.sum()) - (then is None)
        a_next = now.a_next.copy()
        if self._on_prior and then is not None:
            a_next = np.where((~ends | now.terminated) & (then.a >= 0), then.a, a_next)
        else:
            a_next[now.terminated] = -1
        good = ~bad & ~out
        s, a, r, s_next, a_next = (column[good] for column in (now.s, now.a, now.r, s_next, a_next))
        if self._cdf is None:
            a_next = np.maximum(a_next, 0)
        elif len(a_next):
            assert self._prior is not None
            draws = a_next < 0
            draws |= self._prior[s_next, np.maximum(a_next, 0)] == 0
            if draws.any():
                a_next[draws] = drawn(self._cdf, s_next[draws], now.x[good][draws])
        self.seen.sum_of_rewards += float(r.sum())
        return {"s": s, "a": a, "r": r, "s_next": s_next, "a_next": a_next}, (int(now.s_next[-1]), bool(ends[-1]))

    def place(self, role: str, row: int) -> str:
        """What messages call a cell: its role, the row in the file, and the column where it has another name."""
        columns = self._roles.get(role, (role,))
        own = "" if columns == (role,) else f" ({', '.join(columns)})"
        return f"{role}[{self._table.number(row)}]{own}"


class _Wrong:
    """The bad rows of a block; the first is raised where that is an error."""

    def __init__(self, rows: Rows, row: np.ndarray, strict: bool) -> None:
        self._rows, self._row, self._strict = rows, row, strict
        self._bad = np.zeros(len(row), bool)
        self._first: tuple[int, str, Any, str] | None = None

    def found(self, role: str, mask: np.ndarray, parts: Sequence[Cells], allowed: str) -> None:
        if not mask.any():
            return
        self._bad |= mask
        i = int(np.argmax(mask))
        if self._first is None or i < self._first[0]:
            values = [_shown(part, i) for part in parts]
            self._first = i, role, values[0] if len(values) == 1 else tuple(values), allowed

    def raised(self) -> np.ndarray:
        """The mask of the bad rows. Raises InputError for the first where that is an error."""
        if self._first is not None:
            i, role, value, allowed = self._first
            name = self._rows.place(role, int(self._row[i]))
            if self._strict:
                raise InputError(f"path={self._rows.path}: {name}", value, allowed)
            self._rows.seen.first_bad = self._rows.seen.first_bad or f"{name}={value}"
        return self._bad


def _shown(cells: Cells, i: int) -> Any:
    if cells.codes is None:
        value = cells.values[i].item()
        return value
    return "missing" if cells.codes[i] < 0 or cells.values[cells.codes[i]] == "" else cells.values[cells.codes[i]]


def truth(cells: Cells) -> np.ndarray:
    """[n]: 1 where it is true, 0 where it is false, -1 where it is missing or neither."""
    if cells.codes is None and cells.values.dtype.kind == "b":
        return np.asarray(cells.values.astype(np.int64))
    values, codes = cells.factors()
    texts = [str(value).lower().removesuffix(".0") for value in values]
    return np.array([1 if text in TRUE else 0 if text in FALSE else -1 for text in texts] + [-1])[codes]


def numbers(cells: Cells, decimal_comma: bool) -> np.ndarray:
    """[n] float64; NaN for what is missing or no number."""
    if cells.codes is None:
        with np.errstate(over="ignore"):
            return np.asarray(cells.values, np.float64)

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

    return np.array([number(value) for value in cells.values] + [np.nan])[cells.codes]


def drawn(cdf: np.ndarray, s: np.ndarray, x: np.ndarray) -> np.ndarray:
    """An action in each of the states s [n], with x [n] in [0, 1); ``cdf`` [S, A] has running sums of a policy."""
    a = np.empty(len(s), np.int64)
    block = max(1, (1 << 22) // cdf.shape[1])
    most = cdf.shape[1] - 1
    for begin in range(0, len(s), block):
        rows = cdf[s[begin : begin + block]]
        level = np.minimum(x[begin : begin + block] * rows[:, -1], np.nextafter(rows[:, -1], 0))
        a[begin : begin + block] = np.minimum((rows <= level[:, None]).sum(1), most)
    return a


# -- the order of rows -------------------------------------------------------------------------------------


def in_order(source: Table, roles: Roles) -> Table:
    """``source`` with the rows of each episode together: episodes in the order of their first rows.

    Raises InputError where that takes more than ``MOST_SORTED`` rows in memory.
    """
    if "episode" not in roles or ("s_next" in roles and "terminated" not in roles):
        return source
    (name,) = roles["episode"]
    known: dict[Any, int] = {}  # numbers of the episodes, by their first rows
    order: list[np.ndarray] = []
    apart, last, n = False, 0, 0
    for found in source.batches([name], 1 << 16, False):
        values, codes = found[name].factors()
        met, first = np.unique(codes, return_index=True)
        for code in met[np.argsort(first)].tolist():
            if code >= 0:
                known.setdefault(values[code], len(known))
        place = np.array([known[value] if value in known else -1 for value in values] + [-1], np.int64)[codes]
        place = np.concatenate(([last], place))
        place = place[np.maximum.accumulate(np.where(place >= 0, np.arange(len(place)), 0))]  # missing: as the row before
        apart = apart or bool((np.diff(place) < 0).any())
        last, n = int(place[-1]), n + len(codes)
        order.append(place[1:].astype(np.int32))
        if apart and n > MOST_SORTED:
            allowed = f"sorted, all rows of an episode together: more than {MOST_SORTED:,} rows are not sorted here"
            raise InputError(f"path={source.path}: {name}", "episodes that come back", allowed)
    if not apart:
        return source
    used = list(dict.fromkeys(name for columns in roles.values() for name in columns))
    return Sorted(source, used, np.argsort(np.concatenate(order), kind="stable"))


def stride_of(source: Table, roles: Roles, key: str = "") -> float:
    """By how much ``step`` goes up from row to row; 0 where it tells nothing, or s' does not depend on it.

    Args:
        source, roles: of ``in_order``.
        key: what messages call the column, where the user has named it: it is then an error if it tells nothing.

    Raises InputError for steps that go down.
    """
    if "step" not in roles or "s_next" in roles:
        return 0.0
    (name,) = roles["step"]
    names = [name, *roles.get("episode", ())]
    counted: Counter[float] = Counter()
    n = lost = 0
    last: tuple[Any, float] | None = None
    for found in source.batches(names, 1 << 16, False):
        step = numbers(found[name], False)
        if not len(step):
            continue
        same = np.ones(len(step), bool)
        first = final = None
        if "episode" in roles:
            values, codes = found[names[1]].factors()
            same[1:] = codes[1:] == codes[:-1]
            first, final = values[codes[0]], values[codes[-1]]
        before = np.concatenate(([last[1] if last is not None and last[0] == first else np.nan], step[:-1]))
        up = (step - before)[same | (np.arange(len(step)) == 0)]
        up = up[np.isfinite(up)]
        if len(counted) <= MOST_STRIDES:
            different, times = np.unique(up, return_counts=True)
            counted.update(dict(zip(different.tolist(), times.tolist(), strict=True)))
        n, lost, last = n + len(step), lost + int(np.isnan(step).sum()), (final, float(step[-1]))
    stride, times = counted.most_common(1)[0] if counted else (0.0, 0)
    if stride < 0 and 2 * times > counted.total() and 2 * lost < n:
        raise InputError(f"path={source.path}: {name}", f"steps of {stride:g}", "in order of time: it goes down")
    usable = stride > 0 and 2 * times > counted.total() and 2 * lost < n
    if key and not usable and counted.total():
        raise InputError(key, name, "a counter: it must go up by the same number from row to row of an episode")
    return stride if usable else 0.0
