"""A log alone: states, actions and what is known of them are what its rows say.

``read_log`` finds the columns, the labels of states and actions, and the pairs (s,a) that are there; it makes the
``Problem`` that has no environment, and the experience to learn it from. A pair that no row shows is an action that the
state lacks (its prior is 0), unless the user says that it may be taken.

Nothing is claimed beyond the data: there is no model to prove anything of, and no environment to play in.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from erl_torch import checks
from erl_torch.checks import InputError
from erl_torch.experience.formats import ALLOWED, FORMATS, minari, npy, rows
from erl_torch.experience.formats.encoding import Encoding, Met
from erl_torch.experience.formats.format import Options
from erl_torch.experience.formats.order import in_order, stride_of
from erl_torch.experience.formats.roles import Roles, roles_of
from erl_torch.experience.formats.rows import SCALE, TERMINATED, Rows, Seen, limit_of, note_of_cuts, terminations
from erl_torch.experience.formats.table import Cells, InOrder, Table, is_frame, of_frame, of_npz, open_table
from erl_torch.experience.recording import CHUNK, READ, FileRecording, Recordable
from erl_torch.experience.transitions import COLUMNS, WEIGHT, Transitions
from erl_torch.labels import Labels
from erl_torch.mdp.ends import RULES, UNPAID, EndRule, Failures
from erl_torch.mdp.tabular import check_policy, uniform
from erl_torch.problem import Problem

UNSEEN = ("missing", "allowed")  # pairs that no row shows
FEW = 5  # visits of a pair, below which it is named
NAMED = 5  # labels or pairs in a line of the report
LISTED = 12  # labels in the lines of states and actions
ROLE_TEXT = {"s_next": "s'", "a_next": "a'"}


@dataclass(frozen=True)
class LogReport:
    """What a log says of itself; ``str`` is the text that a run prints first.

    Pairs and visits are of (s,a) in the tuples; ``columns`` has the names of the columns by role.
    """

    path: str
    columns: dict[str, str]
    rows: int
    tuples: int
    bad: int  # rows left out, with on_bad="skip"
    first_bad: str
    last: int  # last rows of episodes, left out: no state after
    before_gaps: int  # rows left out: the next row is missing
    at_limit: int  # rows left out that terminate at a time limit, where all other episodes are cut
    gaps: int | None  # rows that do not go on where the row before led to; None where that cannot be seen
    states: int
    actions: int
    state_labels: list[str]  # the first of them
    action_labels: list[str]
    episodes: int | None  # None where nothing tells them
    terminated: int
    truncated: int
    cut: int  # episodes that just end
    reward_range: tuple[float, float]
    mean_reward: float
    varying_pairs: int  # pairs with more than one reward
    pairs: int  # that are seen
    pairs_never_seen: int  # of the states that are left
    rare_pairs: int  # seen fewer than 5 times
    rarest: list[str]
    never_left: int  # states
    never_left_labels: list[str]
    unseen_actions: str
    end_reward: str  # what is added to the rewards of which ends; "" for nothing
    ends_counted: int  # ends that it is added to
    ends: int  # tuples that terminate an episode
    not_answered: list[str]

    @property
    def counted_ends(self) -> str:
        """What is added to the rewards of which ends, and to how many; "" for nothing."""
        if not self.end_reward:
            return ""
        some = self.ends_counted < self.ends
        say = "; env.failures says which: default, unpaid, all or none" if some else ""
        return f"{self.end_reward}, {self.ends_counted:,} of {self.ends:,}{say}"

    def content(self) -> dict[str, Any]:
        """As ``result.json`` holds it."""
        return asdict(self)

    def __str__(self) -> str:
        used = ", ".join(f"{ROLE_TEXT.get(role, role)}={name}" for role, name in self.columns.items())
        lines = [("log", f"{self.path}: {_n(self.rows, 'row')}; {used}")]
        out = [
            *([f"{_n(self.last, 'last row')} of an episode, without a state after"] if self.last else []),
            *([f"{_n(self.at_limit, 'end')} at the time limit, as all others are cut there"] if self.at_limit else []),
            *([f"{_n(self.before_gaps, 'row')} before a gap"] if self.before_gaps else []),
            *([f"{_n(self.bad, 'bad row')} (the first is {self.first_bad})"] if self.bad else []),
        ]
        lines.append(("tuples", f"{self.tuples:,}" + ("; left out: " + ", ".join(out) if out else "")))
        for name, n, labels in (
            ("states", self.states, self.state_labels),
            ("actions", self.actions, self.action_labels),
        ):
            lines.append((name, f"{n:,}: {', '.join(labels)}{', ...' * (n > len(labels))}"))
        if self.episodes is not None:
            ends = [
                f"{n:,} {what} ({n / max(self.episodes, 1):.0%})"
                for n, what in (
                    (self.terminated, "terminated"),
                    (self.truncated, "truncated"),
                    (self.cut, "just end, as if truncated"),
                )
                if n
            ]
            lines.append(("episodes", f"{self.episodes:,}: {', '.join(ends)}"))
        low, high = self.reward_range
        if self.end_reward:
            lines.append(("end reward", self.counted_ends))
        vary = f"they vary for {self.varying_pairs:,} of {_n(self.pairs, 'pair')} (s,a)"
        lines.append(("rewards", f"{low:g} to {high:g}, mean {self.mean_reward:.6g} a tuple; {vary}"))
        rare = ""
        if self.rare_pairs:
            more = ", ..." * (self.rare_pairs > len(self.rarest))
            rare = f"; {self.rare_pairs:,} of them fewer than {FEW} times: {', '.join(self.rarest)}{more}"
        lines.append(("pairs (s,a)", f"{self.pairs:,} of {self.pairs + self.pairs_never_seen:,} seen{rare}"))
        if self.gaps is None:
            step = self.columns.get("step")
            why = "there is neither a state after nor a step"
            if step is not None:
                why = f"there is no state after, and {step} does not go up by one number from row to row"
            lines.append(("gaps", f"cannot be seen: {why}"))
        else:
            do = "does" if self.gaps == 1 else "do"
            lines.append(("gaps", f"{_n(self.gaps, 'row')} that {do} not go on where the row before led to"))
        lines += [("not answered" if i == 0 else "", text) for i, text in enumerate(self.not_answered)]
        return "\n".join(f"{name:18}{text}" for name, text in lines)


def _n(n: int, thing: str) -> str:
    return f"{n:,} {thing}" + "s" * (n != 1)


@dataclass(frozen=True, eq=False)
class Log:
    """A log, read: what there is to learn, what from, and a report of it."""

    problem: Problem  # without an environment
    recording: FileRecording
    report: LogReport
    visits: np.ndarray  # n(s,a), [S, A]

    @cached_property
    def experience(self) -> Transitions | FileRecording:
        """The tuples, in memory where ``chunk`` of them are enough."""
        return self.recording.held()

    @property
    def n_states(self) -> int:
        return self.problem.n_states

    @property
    def n_actions(self) -> int:
        return self.problem.n_actions


def read_log(
    path: Recordable,
    *,
    columns: Mapping[str, Any] | None = None,
    unseen_actions: str = "missing",
    prior_policy: ArrayLike | None = None,
    on_bad: str = "stop",
    chunk: int = CHUNK,
    on_prior: bool = False,
    seed: int = 0,
    end_reward: float = 0.0,
    failures: str = "default",
    report: Callable[[int], object] | None = None,
) -> Log:
    """Read a log that is all there is to learn from.

    Args:
        path: of a CSV, Parquet, JSON-lines or npz file, a directory of such parts or of npy columns, or
            ``minari:DATASET``; or a frame of pandas or polars, a table of Arrow, arrays by name.
        columns: which columns are which, as {"s": "segment", "r": "profit"}; several make tuples, {"s": ["x", "y"]};
            the others are found by their usual names (``erl_torch.experience.formats.roles``).
        unseen_actions: "missing": a state lacks the actions that no row has in it; "allowed": it may have them.
        prior_policy: [S, A], in the order of the labels; None is uniform over the actions that a state has.
        on_bad: "stop" or "skip", for bad rows.
        chunk: tuples in memory at most.
        on_prior: the log was made with the prior policy, so that a' is the action of the next row.
        seed: of a' where it is drawn.
        end_reward: added to the reward of the steps that terminate an episode: a charge, < 0, of those that fail, or a
            bonus, > 0, of the others. The report is of the rewards as they are recorded.
        failures: which ends are failures: "default", "unpaid", "all" or "none" (``erl_torch.mdp.ends``).
        report: called with the number of rows now and then; may raise.

    Raises:
        InputError: what is wrong, with file and row.
    """
    checks.one_of("unseen_actions", unseen_actions, UNSEEN)
    checks.one_of("on_bad", on_bad, ("stop", "skip"))
    checks.one_of("failures", failures, RULES)  # the state that an end leads to is none of a log's
    end_reward = checks.finite("end_reward", end_reward)
    told: Callable[[int], object] = report or (lambda _: None)
    strict = on_bad == "stop"
    source = table_of(path)
    roles = roles_of(source, columns)
    source = in_order(source, roles)
    stride = stride_of(source, roles, "columns.step" if "step" in (columns or {}) else "")
    states, actions = _encodings(source, roles, strict, told)
    sizes = states.n, actions.n
    checks.memory("n_states * n_actions", f"{sizes[0]} * {sizes[1]}", 40 * sizes[0] * sizes[1], "the counts of pairs")
    reader = Rows(source, roles, states, actions, stride=stride)
    counts = _counted(reader, sizes, strict, told)
    finals = reader.seen.finals
    limit = limit_of(finals).place
    if limit is not None and (limit, TERMINATED) in finals:
        reader.limit = limit
        counts = _counted(reader, sizes, strict, told)
    note_of_cuts(reader.seen)
    if not counts.visits.any():
        raise InputError(f"path={source.path}", "0 good tuples", "at least one tuple")
    prior = prior_of(counts.visits, unseen_actions)
    if prior_policy is not None:
        prior = check_policy("prior_policy", prior_policy, *sizes)
    ends = _end_rule(end_reward, failures, reader.seen, int(counts.visits.sum()))
    known = Rows(source, roles, states, actions, prior, on_prior, seed, stride, ends, limit)
    recording = FileRecording(
        source.path, *sizes, on_bad=on_bad, chunk=chunk, report=told, format=_Prepared(known), seed=seed
    )
    problem = Problem(
        None,
        None,
        prior,
        name=Path(source.path).name,
        state_labels=states.labels,
        action_labels=actions.labels,
    )
    told_of = _report(source, roles, states, actions, counts, reader.seen, unseen_actions, bool(stride), ends)
    return Log(problem, recording, told_of, counts.visits)


def _end_rule(end_reward: float, failures: str, seen: Seen, tuples: int) -> EndRule | None:
    """What the ends count for. Raises InputError where no end gets ``end_reward``."""
    if not end_reward:
        return None
    others = tuples - seen.ends
    going_on = (seen.sum_of_rewards - seen.sum_of_ends) / others / SCALE if others else -np.inf
    rule = EndRule(Failures.of(failures, seen.best_end, 1, going_on), end_reward)
    if not _counted_ends(rule, seen):
        kind = "failure" if end_reward < 0 else "success"
        which = f"no end is a {kind} by failures={failures}"
        if not seen.terminated:
            which = "no row terminates an episode"
        elif not seen.ends and seen.at_limit:
            which = "all ends are at the time limit, where nothing is known of the rows that are cut without s_next"
        raise InputError("end_reward", end_reward, f"0: {which}")
    return rule


def _counted_ends(rule: EndRule, seen: Seen) -> int:
    """How many ends get the end reward."""
    limit = rule.failures.limit
    failed = {np.inf: seen.ends, -np.inf: 0, UNPAID: seen.unpaid_ends}.get(limit, seen.ends - seen.best_ends)
    return failed if rule.end_reward < 0 else seen.ends - failed


def prior_of(visits: np.ndarray, unseen_actions: str) -> np.ndarray:
    """The uniform prior [S, A] over the actions that each state has, by its visits [S, A].

    ``unseen_actions`` is as of ``read_log``. A state that is never left has all actions, as nothing tells which.
    """
    has = visits > 0 if unseen_actions == "missing" else np.ones_like(visits, bool)
    has = has | ~has.any(1, keepdims=True)
    return uniform(has)


# -- where the rows are ------------------------------------------------------------------------------------


def table_of(path: Recordable) -> Table:
    """Whatever there is at a path, or a frame, as a table. Raises InputError."""
    if not isinstance(path, (str, os.PathLike)):
        if not is_frame(path):
            raise InputError("path", type(path).__name__, "a path, a frame, or arrays by name")
        return of_frame(path)
    text = str(path)
    claimant = next((one for one in FORMATS if one.claims(text)), None)
    if claimant is None:
        raise InputError("path", path, ALLOWED)
    if claimant is rows:
        return open_table(text)
    if claimant is minari:
        return minari.Episodes(text)
    if Path(text).is_file() and not npy.has_columns(text):
        return of_npz(text)
    return Tuples(npy.reader(text, Options(1, 1)))


class Tuples(InOrder):
    """What a reader of the five columns (and weights) reads, as a table."""

    def __init__(self, reader: Any) -> None:
        self.path, self._reader = reader.path, reader
        first: Mapping[str, np.ndarray] = next(reader.batches(1, False), {})
        self.names: Sequence[str] = (*COLUMNS, WEIGHT) if WEIGHT in first else COLUMNS

    def batches(self, names: Sequence[str], rows: int, strict: bool) -> Any:
        for batch in self._reader.batches(rows, strict):
            yield {name: Cells(batch[name]) for name in names}


class _Prepared:
    """A format: the one reader that there is already."""

    def __init__(self, reader: Rows) -> None:
        self._reader = reader

    def claims(self, path: str) -> bool:
        return True

    def reader(self, path: str, options: Options) -> Rows:
        return self._reader


# -- what they say -----------------------------------------------------------------------------------------


def _encodings(source: Table, roles: Roles, strict: bool, told: Callable[[int], object]) -> tuple[Encoding, Encoding]:
    """The numbers of states and of actions, from all rows."""
    names = list(dict.fromkeys(name for columns in roles.values() for name in columns))
    states = Met(f"path={source.path}: {', '.join(roles['s'])}", len(roles["s"]))
    actions = Met(f"path={source.path}: {', '.join(roles['a'])}", len(roles["a"]))
    n = 0
    for found in source.batches(names, READ, strict):
        parts = {role: [found[name] for name in columns] for role, columns in roles.items()}
        everywhere = np.ones(parts["s"][0].n_rows, bool)
        # The state after the end of an episode is none that anything leads to.
        goes_on = ~terminations(roles, parts)
        for met, role, where in (
            (states, "s", everywhere),
            (states, "s_next", goes_on),
            (actions, "a", everywhere),
            (actions, "a_next", goes_on),
        ):
            if role in parts:
                met.add(parts[role], where)
        n += len(everywhere)
        told(n)
    if not n:
        raise InputError(f"path={source.path}", "no row", "at least one row")
    return states.encoding(), actions.encoding()


class _Counts:
    """What the tuples have of each pair."""

    def __init__(self, n_states: int, n_actions: int) -> None:
        n = n_states * n_actions
        self.n_actions = n_actions
        self.visits = np.zeros((n_states, n_actions), np.int64)
        self.low, self.high = np.full(n, np.inf), np.full(n, -np.inf)
        self.entered = np.zeros(n_states, bool)

    def add(self, batch: Mapping[str, np.ndarray]) -> None:
        pair = batch["s"] * self.n_actions + batch["a"]
        self.visits += np.bincount(pair, minlength=self.visits.size).reshape(self.visits.shape)
        np.minimum.at(self.low, pair, batch["r"])
        np.maximum.at(self.high, pair, batch["r"])
        self.entered[batch["s_next"]] = True


def _counted(reader: Rows, sizes: tuple[int, int], strict: bool, told: Callable[[int], object]) -> _Counts:
    """What all tuples have of each pair."""
    counts = _Counts(*sizes)
    for batch in reader.batches(READ, strict):
        counts.add(batch)
        told(reader.seen.rows)
    return counts


def _report(
    source: Table,
    roles: Roles,
    states: Encoding,
    actions: Encoding,
    counts: _Counts,
    seen: Seen,
    unseen_actions: str,
    counted_steps: bool,
    rule: EndRule | None,
) -> LogReport:
    visits, tuples = counts.visits, int(counts.visits.sum())
    met = visits > 0
    left = met.any(1)
    never_left = np.flatnonzero(counts.entered & ~left)
    never_seen = int((~met[left]).sum())
    rare = np.argwhere(met & (visits < FEW))
    rare = rare[np.argsort(visits[rare[:, 0], rare[:, 1]], kind="stable")]
    state, action = _texts(states), _texts(actions)
    never_left_labels = [state(int(i)) for i in never_left[:NAMED]]
    unanswered = ["how far the policy is from the best one, and what it earns: there is no model and no environment"]
    if never_seen:
        taken = {
            "missing": "the states are taken to lack these actions (env.unseen_actions=allowed: to have them)",
            "allowed": "the states are taken to have these actions, and nothing is known of them",
        }[unseen_actions]
        unanswered.append(f"what {_n(never_seen, 'pair')} (s,a) would bring that no row shows: {taken}")
    if len(never_left):
        more = ", ..." * (len(never_left) > NAMED)
        which = f"{_n(len(never_left), 'state')} that no row leaves: {', '.join(never_left_labels)}{more}"
        unanswered.append(f"what comes after {which}")
    ends = bool({"episode", "terminated", "truncated"} & roles.keys())
    gaps = seen.gaps if "s_next" in roles or counted_steps else None
    if gaps is None:
        unanswered.append("whether rows are missing")
    return LogReport(
        path=source.path,
        columns={role: ", ".join(names) for role, names in roles.items()},
        rows=seen.rows,
        tuples=tuples,
        bad=seen.bad,
        first_bad=seen.first_bad,
        last=seen.last,
        before_gaps=seen.before_gaps,
        at_limit=seen.at_limit,
        gaps=gaps,
        states=states.n,
        actions=actions.n,
        state_labels=[state(i) for i in range(min(states.n, LISTED))],
        action_labels=[action(i) for i in range(min(actions.n, LISTED))],
        episodes=seen.episodes if ends else None,
        terminated=seen.terminated,
        truncated=seen.truncated,
        cut=seen.episodes - seen.terminated - seen.truncated if ends else 0,
        reward_range=(float(counts.low.min()), float(counts.high.max())),
        mean_reward=seen.sum_of_rewards / tuples / SCALE,
        varying_pairs=int((counts.high > counts.low).sum()),
        pairs=int(met.sum()),
        pairs_never_seen=never_seen,
        rare_pairs=len(rare),
        rarest=[f"{state(s)}, {action(a)} ({visits[s, a]})" for s, a in rare[:NAMED].tolist()],
        never_left=len(never_left),
        never_left_labels=never_left_labels,
        unseen_actions=unseen_actions,
        end_reward="" if rule is None else str(rule),
        ends_counted=0 if rule is None else _counted_ends(rule, seen),
        ends=seen.ends,
        not_answered=unanswered,
    )


def _texts(encoding: Encoding) -> Callable[[int], str]:
    """The number of a state or an action as text, on one line."""
    labels: Labels | None = encoding.labels
    return str if labels is None else lambda number: " ".join(labels.text(number).splitlines())
