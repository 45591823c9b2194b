"""From the rows of a table to tuples (s, a, r, s', a').

A row is a step: its state s, its action a, its reward r and, where there are such columns, the state after
(``s_next``), the action drawn there (``a_next``), whether the step ``terminated`` or ``truncated`` its episode, the
``episode`` it is of and the ``step`` of that, and its ``weight`` (``erl_torch.experience.formats.roles``).

Ends, as in ``erl_torch.experience.collect``. Where a row terminates its episode, s' is the state of the next row, the
first of the next episode (the first row follows the last). Where an episode is truncated, or just ends, s' is
``s_next``; without such a column it is not known, and the row is left out. In between, s' is ``s_next`` or, without
such a column, the state of the next row; where a column ``step`` shows that rows are missing in between, it is not
known either.

No selection by outcome. Where all episodes that get to some row and do not end there are cut, a time limit, the rows
that do terminate there are left out too (``limit_of``): if they stayed while the others go, ends would be too frequent.

a' is what ``a_next`` has; where that is missing, or the prior policy of the state lacks it, or the step terminated, it
is drawn from the prior at s', with the stream "behaviour" of the seed, one number a row.

A row is bad where a value that is needed is missing or is no such value. Rows are named by their place in the file,
from 0.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from erl_torch.checks import InputError
from erl_torch.experience.formats import table
from erl_torch.experience.formats.encoding import LOST, UNKNOWN, Encoding, numbers, truth
from erl_torch.experience.formats.format import Batch, Options
from erl_torch.experience.formats.order import ROWS, in_order, stride_of
from erl_torch.experience.formats.roles import NEEDED, Roles, plain, roles_of
from erl_torch.experience.formats.table import Cells, Table
from erl_torch.mdp.ends import EndRule
from erl_torch.mdp.tabular import check_policy
from erl_torch.notes import note
from erl_torch.rng import streams


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
    rows = Rows(source, roles, states, actions, prior, options.on_prior, options.seed, stride)
    if "terminated" in roles and {"episode", "truncated"} & roles.keys():
        for _ in rows.batches(ROWS, False):
            pass
        rows.limit = limit_of(rows.seen.finals).place
        note_of_cuts(rows.seen)
    return rows


# -- where episodes are cut ----------------------------------------------------------------------------------


CUT, TERMINATED, KNOWN = range(3)  # last rows: without a state after; that terminate; cut, with a state after
LEAST_CUT = 2  # episodes, of the same length, that make a time limit: one is where the log ends
NOTED_EXCESS = 0.5  # standard errors of the number of ends
SCALE = 2.0**-64  # of sums of rewards, so that they do not overflow
FEW_ENDS = 2.0  # too many, which are not noted


class Limit(NamedTuple):
    """What cuts do to the ends."""

    place: int | None  # steps from the first of an episode at which all are cut that get there; None: nowhere
    terminated: int  # ends before that
    excess: float  # how many of them are too many, in the mean, as rows that are cut where they end are left out


def limit_of(finals: Mapping[tuple[int, int], int]) -> Limit:
    """From the numbers of last rows by (place in the episode, kind).

    Of the rows at place t that do not terminate, the share c(t) is cut and left out, all those that do terminate stay.
    Where a cut does not depend on what the step brings, c(t) of the latter would have to go as well. At a time limit
    c is 1; elsewhere the sum of c(t) times the ends at t is the excess.
    """
    places = sorted({place for place, _ in finals})
    on, excess, terminated, limit = 0, 0.0, 0, None  # on: episodes that go on beyond the place
    for place in reversed(places):
        cut, ended, known = (finals.get((place, kind), 0) for kind in (CUT, TERMINATED, KNOWN))
        if cut >= LEAST_CUT and not on and not known:
            limit = place
        else:
            excess += ended * (cut / (cut + on + known) if cut else 0.0)
            terminated += ended
        on += cut + ended + known
    return Limit(limit, terminated, excess)


def note_of_cuts(seen: Seen) -> None:
    """A note where so many rows are left out for want of a state after that ends, which need none, are too frequent."""
    _, terminated, excess = limit_of(seen.finals)
    go_on = seen.rows - sum(seen.finals.values())
    excess += terminated * seen.before_gaps / max(go_on, 1)
    if excess > max(NOTED_EXCESS * np.sqrt(terminated), FEW_ENDS):
        share = excess / max(terminated - excess, 1.0)
        note(
            f"ends are too frequent in the tuples, by about {share:.2g} of their number ({excess:.0f} of "
            f"{terminated:,}): a row that is cut, or before a gap, is left out, as no state after it is known, and one "
            "that terminates stays; theta is off by that, and its interval does not allow for it. A column s_next, the "
            "state after, mends it"
        )


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
    sum_of_rewards: float = 0.0  # of the tuples, times SCALE
    worst_end: float = np.inf  # rewards of the steps that terminate an episode
    best_end: float = -np.inf
    ends: int = 0  # tuples that terminate an episode
    best_ends: int = 0  # of them, that pay as much as the best
    unpaid_ends: int = 0  # of them, that pay at most 0
    sum_of_ends: float = 0.0  # their rewards
    at_limit: int = 0  # rows that terminate where all others are cut, left out
    finals: Counter[tuple[int, int]] = field(default_factory=Counter)  # last rows by place in the episode and kind

    def ends_pay(self, reward: np.ndarray) -> None:
        """Of tuples that terminate an episode, [n]."""
        self.ends += len(reward)
        self.worst_end = min(self.worst_end, reward.min(initial=np.inf))
        best = max(self.best_end, reward.max(initial=-np.inf))
        self.best_ends = self.best_ends * (best == self.best_end) + int((reward == best).sum())
        self.best_end = best
        self.unpaid_ends += int((reward <= 0).sum())
        self.sum_of_ends += float((reward * SCALE).sum())


class Block(NamedTuple):
    """Some rows, encoded: [n] each."""

    row: np.ndarray  # place in the table
    s: np.ndarray
    a: np.ndarray
    r: np.ndarray
    s_next: np.ndarray  # below 0: missing
    a_next: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    begins: np.ndarray  # another episode than the row before's, by its column
    step: np.ndarray  # NaN: not in the table
    place: np.ndarray  # steps from the first of its episode; below 0: not known
    bad: np.ndarray
    x: np.ndarray  # in [0, 1), for a'
    weight: np.ndarray  # 1 without such a column

    def at(self, rows: slice | np.ndarray) -> Block:
        return Block(*(column[rows] for column in self))


def _joined(blocks: Sequence[Block]) -> Block:
    return Block(*(np.concatenate(columns) for columns in zip(*blocks, strict=True)))


class Rows:
    """A reader (``erl_torch.experience.formats.format.Reader``) of the rows of a table.

    Args:
        source, roles: what is read; episodes stand together (``in_order``).
        states, actions: their numbers.
        prior_policy: [S, A], behind a'; None: a' is 0 where it is not recorded.
        on_prior: a' is the action of the next row, where that follows: it is in s', and not behind a truncated end.
        seed: of a' where it is drawn.
        stride: of ``step`` from row to row; 0: it tells nothing.
        ends: what is added to the rewards of the steps that terminate an episode; None: nothing.
        limit: the place in their episodes at which rows that terminate are left out (``limit_of``); None: nowhere.

    ``seen`` is what the last pass met, or the present one has met so far.
    """

    def __init__(
        self,
        source: Table,
        roles: Roles,
        states: Encoding,
        actions: Encoding,
        prior_policy: np.ndarray | None = None,
        on_prior: bool = False,
        seed: int = 0,
        stride: float = 0.0,
        ends: EndRule | None = None,
        limit: int | None = None,
    ) -> None:
        self._ends, self.limit = ends, limit
        self.path, self.short = source.path, 0
        self._source, self._roles, self._stride = source, roles, stride
        self._encodings = {"s": states, "s_next": states, "a": actions, "a_next": actions}
        self._prior, self._on_prior, self._seed = prior_policy, on_prior, seed
        self._cdf = None if prior_policy is None else np.cumsum(prior_policy, axis=1)
        self._of_next_row = "s_next" not in roles
        self._looks_on = bool({"episode", "terminated", "truncated"} & roles.keys()) or on_prior
        self.seen = Seen()

    @property
    def first_bad(self) -> str:
        return self.seen.first_bad

    def batches(self, rows: int, strict: bool) -> Iterator[Batch]:
        self.seen, self.short = Seen(), 0
        for batch in self._looking_on(rows, strict) if self._looks_on else self._as_they_are(rows, strict):
            if len(batch["s"]):
                yield batch
        self.seen.bad += self._source.invalid
        if self._source.invalid and self._of_next_row:
            allowed = "mended: without s_next, the row before such a one would lead to the row after it"
            raise InputError(f"path={self.path}", f"{self._source.invalid} lines that are no rows", allowed)
        if self._source.invalid and not self.seen.first_bad:
            self.seen.first_bad = "a line that is no row"
        self.short = self.seen.bad

    def _as_they_are(self, rows: int, strict: bool) -> Iterator[Batch]:
        """Each row by itself: nothing tells of ends."""
        led = np.full(1, -1)
        for block in self._blocks(rows, strict):
            led = np.concatenate((led[-1:], block.s_next))
            self.seen.gaps += int(((led[:-1] >= 0) & (block.s >= 0) & (led[:-1] != block.s)).sum())
            yield self._tuples(block, block.s_next, block.a_next, np.zeros(len(block.s), bool), strict)

    def _looking_on(self, rows: int, strict: bool) -> Iterator[Batch]:
        """Each row with the one after it; after the last comes the first, of another episode."""
        held: Block | None = None
        first: Block | None = None
        for block in self._blocks(rows, strict):
            whole = block if held is None else _joined([held, block])
            first = block.at(slice(1)) if first is None else first
            yield self._with_next(whole.at(slice(-1)), whole.at(slice(1, None)), strict)
            held = whole.at(slice(-1, None))
        if held is not None and first is not None:
            yield self._with_next(held, first._replace(begins=np.ones(1, bool)), strict)

    def _blocks(self, rows: int, strict: bool) -> Iterator[Block]:
        names = list(dict.fromkeys(name for columns in self._roles.values() for name in columns))
        rng = streams(self._seed).behaviour
        last: list[Any] = []  # the episode of the last row
        places = _Places(self._stride)
        for found in self._source.batches(names, rows, strict):
            parts = {role: [found[name] for name in columns] for role, columns in self._roles.items()}
            n = parts["s"][0].n_rows
            if not n:
                continue
            wrong = _Wrong(self, np.arange(self.seen.rows, self.seen.rows + n), strict)
            r = numbers(parts["r"][0], self._source.decimal_comma)
            finite = "finite" if parts["r"][0].codes is None else "a finite number"
            flags = {role: self._flag(role, parts, n, wrong) for role in ("terminated", "truncated")}
            flags["terminated"] &= terminations(self._roles, parts)
            codes = {role: self._coded(role, parts, flags["terminated"], wrong) for role in self._encodings}
            wrong.found("r", ~np.isfinite(r), parts["r"], finite)
            weight = np.ones(n)
            if "weight" in parts:
                weight = numbers(parts["weight"][0], self._source.decimal_comma)
                wrong.found("weight", ~(np.isfinite(weight) & (weight >= 0)), parts["weight"], f"{finite} >= 0")
            begins = np.zeros(n, bool)
            if "episode" in parts:
                values, episode = parts["episode"][0].factors()
                wrong.found("episode", episode < 0, parts["episode"], "there")
                begins[1:] = episode[1:] != episode[:-1]
                ends = [None if code < 0 else values[code] for code in episode[[0, -1]].tolist()]
                begins[0] = bool(last) and last != ends[:1]
                last = ends[1:]
            step = np.full(n, np.nan)
            if self._stride:
                step = numbers(parts["step"][0], False)
                wrong.found("step", ~np.isfinite(step), parts["step"], "a finite number")
            self.seen.rows += n
            x = rng.random(n) if self._cdf is not None else np.zeros(n)
            place = places.of(begins, flags["terminated"] | flags["truncated"], step)
            yield Block(wrong.row, codes["s"], codes["a"], r, codes["s_next"], codes["a_next"], flags["terminated"],
                        flags["truncated"], begins, step, place, wrong.raised(), x, weight)  # fmt: skip

    def _coded(
        self, role: str, parts: Mapping[str, Sequence[Cells]], terminated: np.ndarray, wrong: _Wrong
    ) -> np.ndarray:
        """[n] numbers of the values of a role; below 0 where there are none."""
        if role not in parts:
            return np.full(len(terminated), LOST)
        encoding = self._encodings[role]
        codes = encoding.codes(parts[role])
        # Whether what is missing is needed shows later. What comes after an end is none of the states.
        wrong.found(
            role, codes < 0 if role in NEEDED else (codes == UNKNOWN) & ~terminated, parts[role], encoding.allowed
        )
        return codes

    def _flag(self, role: str, parts: Mapping[str, Sequence[Cells]], n: int, wrong: _Wrong) -> np.ndarray:
        if role not in parts:
            return np.zeros(n, bool)
        known = truth(parts[role][0])
        wrong.found(role, known < 0, parts[role], "true or false")
        return np.asarray(known == 1)

    def _with_next(self, now: Block, then: Block, strict: bool) -> Batch:
        """The tuples of the rows ``now``, of which ``then`` are the rows after each."""
        ends = now.terminated | now.truncated | then.begins
        seen, good = self.seen, ~now.bad
        seen.episodes += int(ends.sum())
        seen.terminated += int(now.terminated.sum())
        at_limit = now.terminated & (now.place == (-2 if self.limit is None else self.limit))
        seen.at_limit += int((at_limit & good).sum())
        paid = now.r
        if self._ends is not None:
            failed = now.terminated & self._ends.failures.among(now.r, now.s)
            counts = failed if self._ends.end_reward < 0 else now.terminated & ~failed
            now = now._replace(r=now.r + self._ends.end_reward * counts)
        seen.truncated += int((now.truncated & ~now.terminated).sum())
        last = ends & ~now.terminated & (now.s_next < 0)  # truncated, or the episode just ends
        kind = np.where(now.terminated, TERMINATED, np.where(last, CUT, KNOWN))
        told, times = np.unique((3 * now.place + kind)[ends & (now.place >= 0)], return_counts=True)
        seen.finals.update({divmod(x, 3): n for x, n in zip(told.tolist(), times.tolist(), strict=True)})
        s_next = np.where(now.terminated, then.s, now.s_next)
        out = now.terminated & (then.s < 0)
        if self._of_next_row:
            gap = np.zeros(len(ends), bool)
            if self._stride:
                off = np.abs(then.step - now.step - self._stride)
                gap = ~ends & ~(off <= 1e-4 * self._stride + 4 * np.spacing(np.abs(then.step)))
                seen.gaps += int(gap.sum())
            s_next = np.where(ends, s_next, then.s)
            out |= gap | (~ends & (then.s < 0))
        else:
            known = ~ends & (now.s_next >= 0) & (then.s >= 0)
            seen.gaps += int((known & (now.s_next != then.s)).sum())
        seen.last += int((last & good).sum())
        seen.before_gaps += int((out & good & ~at_limit).sum())
        seen.ends_pay(paid[now.terminated & good & ~at_limit & ~out])
        # What was drawn, or taken, at the end of an episode was so in another state than s'.
        a_next = np.where(now.terminated, -1, now.a_next)
        if self._on_prior:
            # Behind a gap the next row is in another state; s' of a truncated end is in no row.
            follows = (~ends | now.terminated) & (s_next == then.s)
            a_next = np.where(follows & (then.a >= 0), then.a, a_next)
        return self._tuples(now, s_next, a_next, last | out | at_limit, strict)

    def _tuples(self, now: Block, s_next: np.ndarray, a_next: np.ndarray, out: np.ndarray, strict: bool) -> Batch:
        """The tuples of the rows ``now`` that are neither bad nor ``out`` [n] bool."""
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
        columns = (now.s, now.a, now.r, s_next, a_next, now.x, now.weight)
        if (leave := bad | out).any():
            columns = tuple(column[~leave] for column in columns)
        s, a, r, s_next, a_next, x, weight = columns
        self.seen.sum_of_rewards += float((r * SCALE).sum())
        batch = {"s": s, "a": a, "r": r, "s_next": s_next, "a_next": self._next_actions(s_next, a_next, x)}
        return batch | {"weight": weight} if "weight" in self._roles else batch

    def _next_actions(self, s_next: np.ndarray, a_next: np.ndarray, x: np.ndarray) -> np.ndarray:
        """a', drawn where it is missing, or lacking in s'."""
        if self._cdf is None or self._prior is None:
            return np.asarray(np.maximum(a_next, 0))
        draws = np.asarray(a_next < 0) | (self._prior[s_next, np.maximum(a_next, 0)] == 0)
        if draws.any():
            a_next = a_next.copy()
            a_next[draws] = drawn(self._cdf, s_next[draws], x[draws])
        return a_next

    def place(self, role: str, row: int) -> str:
        """What messages call a cell: its role, the row in the file, and the column where it has another name."""
        columns = self._roles.get(role, (role,))
        own = "" if columns == (role,) else f" ({', '.join(columns)})"
        return f"{role}[{self._source.number(row)}]{own}"


class _Places:
    """How many steps rows are from the first of their episode; they come in blocks.

    Args:
        stride: of ``step`` from row to row; 0: rows are counted.
    """

    def __init__(self, stride: float) -> None:
        self._stride, self._ended = stride, True
        self._before = 0.0  # of the episode that goes on: its rows so far, or its first step

    def of(self, begins: np.ndarray, ended: np.ndarray, step: np.ndarray) -> np.ndarray:
        """[n] int64 of a block: rows of another episode than the row before's, rows that end theirs, and steps."""
        first = begins | np.append(self._ended, ended[:-1])
        index = np.arange(len(first))
        start = np.maximum.accumulate(np.where(first, index, -1))
        if self._stride:
            origin = np.where(start >= 0, step[start], self._before)
            place = (step - origin) / self._stride
            self._before = float(origin[-1])
        else:
            place = np.where(start >= 0, index - start, index + self._before)
            self._before = float(place[-1] + 1)
        self._ended = bool(ended[-1])
        known = (place >= 0) & (place < 1 << 60)  # not of NaN
        return np.where(known, np.rint(np.where(known, place, 0.0)), -1).astype(np.int64)


class _Wrong:
    """The bad rows of a block; the first is raised where that is an error."""

    def __init__(self, rows: Rows, row: np.ndarray, strict: bool) -> None:
        self._rows, self.row, self._strict = rows, row, strict
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
            name = self._rows.place(role, int(self.row[i]))
            if self._strict:
                raise InputError(f"path={self._rows.path}: {name}", value, allowed)
            self._rows.seen.first_bad = self._rows.seen.first_bad or f"{name}={value}"
        return self._bad


def _shown(cells: Cells, i: int) -> Any:
    if cells.codes is None:
        return cells.values[i].item()
    return "missing" if cells.codes[i] < 0 or cells.values[cells.codes[i]] == "" else cells.values[cells.codes[i]]


def terminations(roles: Roles, parts: Mapping[str, Sequence[Cells]]) -> np.ndarray:
    """[n] bool: rows that terminate their episode. ``done`` of older programs is true at time limits too."""
    if "terminated" not in roles:
        return np.zeros(parts["s"][0].n_rows, bool)
    ends = truth(parts["terminated"][0]) == 1
    if plain(roles["terminated"][0]) in ("done", "dones") and "truncated" in roles:
        ends &= truth(parts["truncated"][0]) != 1
    return np.asarray(ends)


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
