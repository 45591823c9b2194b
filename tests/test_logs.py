"""Logs: every format gives the same tuples; ends, gaps and labels; what is learnt from a log alone."""

import csv
import gzip
import io
import json
import os
import re
import runpy
import shlex
import sys
from collections import defaultdict
from itertools import pairwise

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq
import pytest
from helpers import ROOT, composed, ended, events, scalars, undocumented
from scipy.special import logsumexp

import erl_torch
from erl_torch import CertaintyEquivalence, EfficientS1, InputError, Replicas, read_experience, read_log
from erl_torch.experience.formats.encoding import number_of
from erl_torch.experience.recording import FileRecording
from erl_torch.experience.transitions import COLUMNS
from erl_torch.run.training import train

SHOP = runpy.run_path(str(ROOT / "examples" / "shop_log.py"))
NAMES = ("customer", "week", "segment", "offer", "profit", "left", "unwatched")
ROLES = dict(
    s="segment", a="offer", r="profit", episode="customer", step="week", terminated="left", truncated="unwatched"
)


def shop_text(n_customers=60, seed=3, forgotten=True):
    rows = [row for row in SHOP["rows"](n_customers, seed) if forgotten or row[4] != ""]
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([NAMES, *rows])
    return text.getvalue()


# -- an oracle that shares no code: plain Python on the text of the file ---------------------------------------


def by_hand(text):
    """[(s, a, r, s')] of the shop's log, by the rules that docs/logs.md states."""
    rows = [dict(zip(NAMES, line, strict=True)) for line in list(csv.reader(io.StringIO(text)))[1:]]
    found = []
    first = {row["customer"]: int(row["week"]) for row in reversed(rows)}
    watched = max(int(row["week"]) - first[row["customer"]] for row in rows)
    for i, row in enumerate(rows):
        following = rows[i + 1] if i + 1 < len(rows) else rows[0]
        same = i + 1 < len(rows) and following["customer"] == row["customer"]
        if row["left"] == "yes" and int(row["week"]) - first[row["customer"]] == watched:
            continue  # at the time limit, where all others are cut
        if row["left"] == "yes":
            s_next = following["segment"]
        elif row["unwatched"] == "yes" or not same or int(following["week"]) != int(row["week"]) + 1:
            continue
        else:
            s_next = following["segment"]
        if row["profit"] != "":
            found.append((row["segment"], row["offer"], float(row["profit"]), s_next))
    return found


def counted(tuples):
    """(states, {(s, a): ({s': share}, mean reward)})."""
    to, total = defaultdict(lambda: defaultdict(int)), defaultdict(list)
    for s, a, r, s_next in tuples:
        to[s, a][s_next] += 1
        total[s, a].append(r)
    pairs = {
        pair: ({s: n / sum(seen.values()) for s, n in seen.items()}, sum(total[pair]) / len(total[pair]))
        for pair, seen in to.items()
    }
    return sorted({s for s, _ in pairs}), pairs


def solved(pairs, beta):
    """(theta, {(s, a): probability}): relative soft value iteration on the lazy chain; prior uniform on these pairs."""
    states = sorted({s for s, _ in pairs})
    actions = {s: sorted(a for t, a in pairs if t == s) for s in states}
    v = dict.fromkeys(states, 0.0)
    q = {}
    for _ in range(100_000):
        q = {(s, a): r + sum(p * v[t] for t, p in to.items()) for (s, a), (to, r) in pairs.items()}
        new = {
            s: float(logsumexp([beta * q[s, a] for a in actions[s]]) - np.log(len(actions[s]))) / beta for s in states
        }
        change = [new[s] - v[s] for s in states]
        if max(change) - min(change) < 1e-12:
            break
        v = {s: 0.5 * (v[s] + new[s]) - 0.5 * new[states[0]] for s in states}
    policy = {}
    for s in states:
        logits = np.array([beta * q[s, a] for a in actions[s]])
        policy |= {(s, a): float(p) for a, p in zip(actions[s], np.exp(logits - logsumexp(logits)), strict=True)}
    return -0.5 * (max(change) + min(change)), policy


def named(log):
    """[(s, a, r, s')] of a log by labels."""
    data = log.experience
    states, actions = (
        [str(i) for i in range(n)] if labels is None else labels.texts.tolist()
        for n, labels in (
            (log.n_states, log.problem.state_labels),
            (log.n_actions, log.problem.action_labels),
        )
    )
    return [
        (states[s], actions[a], r, states[t])
        for s, a, r, t in zip(data.s.tolist(), data.a.tolist(), data.r.tolist(), data.s_next.tolist(), strict=True)
    ]


def test_the_shop_by_hand(tmp_path):
    text = shop_text(forgotten=True)
    (tmp_path / "shop.csv").write_text(text)
    with pytest.raises(InputError, match=r"shop.csv: r\[\d+\] \(profit\)=missing: must be a finite number"):
        read_log(tmp_path / "shop.csv", columns=ROLES)
    log = read_log(tmp_path / "shop.csv", columns=ROLES, on_bad="skip")
    tuples = by_hand(text)
    assert named(log) == tuples
    states, pairs = counted(tuples)
    assert log.problem.state_labels.texts.tolist() == states == ["gold", "new", "regular", "sleeping"]
    prior = {
        (s, a): log.problem.prior[i, j] for i, s in enumerate(states) for j, a in enumerate(["call", "mail", "nothing"])
    }
    assert {pair for pair, p in prior.items() if p > 0} == set(pairs)
    theta, policy = solved(pairs, 1.0)
    for learner in (CertaintyEquivalence(1.0), EfficientS1(1.0)):
        learner = type(learner)(1.0, prior_policy=log.problem.prior)
        solution = learner.fit(log.experience, log.n_states, log.n_actions)
        assert solution.theta == pytest.approx(theta, abs=1e-6)
        for (s, a), p in prior.items():
            learnt = solution.policy[states.index(s), ["call", "mail", "nothing"].index(a)]
            assert float(learnt) == pytest.approx(policy.get((s, a), 0.0), abs=1e-5), (s, a, p)
            assert p > 0 or float(learnt) == 0


def test_the_report_counts(tmp_path):
    text = shop_text()
    (tmp_path / "shop.csv").write_text(text)
    log = read_log(tmp_path / "shop.csv", columns=ROLES, on_bad="skip")
    rows = [dict(zip(NAMES, line, strict=True)) for line in list(csv.reader(io.StringIO(text)))[1:]]
    tuples = by_hand(text)
    _, pairs = counted(tuples)
    report = log.report
    customers = {row["customer"] for row in rows}
    left = {row["customer"] for row in rows if row["left"] == "yes"}
    unwatched = {row["customer"] for row in rows if row["unwatched"] == "yes"}
    assert (report.rows, report.tuples, report.states, report.actions) == (len(rows), len(tuples), 4, 3)
    assert (report.episodes, report.terminated, report.truncated) == (len(customers), len(left), len(unwatched))
    assert report.cut == len(customers - left - unwatched)
    assert report.rows == report.tuples + report.bad + report.last + report.before_gaps + report.at_limit
    steps = [int(b["week"]) - int(a["week"]) for a, b in pairwise(rows) if a["customer"] == b["customer"]]
    assert report.gaps == sum(step != 1 for step in steps)
    assert (report.pairs, report.pairs_never_seen) == (len(pairs), 2)
    assert report.reward_range == (min(r for _, _, r, _ in tuples), max(r for _, _, r, _ in tuples))
    assert report.mean_reward == pytest.approx(np.mean([r for _, _, r, _ in tuples]))
    counts = defaultdict(int)
    for s, a, _, _ in tuples:
        counts[s, a] += 1
    assert report.rare_pairs == sum(n < 5 for n in counts.values())
    kinds = defaultdict(set)
    for s, a, r, _ in tuples:
        kinds[s, a].add(r)
    assert report.varying_pairs == sum(len(seen) > 1 for seen in kinds.values())
    for line in ("not answered", "there is no model and no environment", "2 pairs (s,a) would bring", "10 of 12 seen"):
        assert line in str(report)


# -- ends, in random logs ------------------------------------------------------------------------------------


def reference(rows, s_next, episode, terminated, truncated, step):
    """[(s, a, r, s')] of rows (dicts) where the columns named are there: one row at a time.

    Where two or more episodes are cut at the last of all places, what terminates there is left out.
    """
    found, first, lasts = [], 0, []
    ending = []  # places in ``found`` of rows that terminate, with their place in the episode
    for i, row in enumerate(rows):
        place = row["step"] - rows[first]["step"] if step and not s_next else i - first
        after = rows[i + 1] if i + 1 < len(rows) else None
        end = after is None or (episode and after["episode"] != row["episode"])
        end = end or (terminated and row["terminated"]) or (truncated and row["truncated"])
        cut = end and not s_next and not (terminated and row["terminated"])
        if end:
            lasts.append((place, cut))
            first = i + 1
        if terminated and row["terminated"]:
            to = (after or rows[0])["s"]
            ending.append((len(found), place))
        elif s_next:
            to = row["s_next"]
        elif end or (step and after["step"] != row["step"] + 1):
            continue
        else:
            to = after["s"]
        found.append((row["s"], row["a"], row["r"], to))
    limit = max(place for place, _ in lasts)
    if lasts.count((limit, True)) > 1:
        for at in [at for at, place in ending if place == limit]:
            found[at] = None
    return [one for one in found if one]


@pytest.mark.filterwarnings("ignore:ends are too frequent:erl_torch.Note")
@pytest.mark.parametrize("seed", range(40))
def test_random_logs(seed):
    rng = np.random.default_rng(seed)
    there = {name: bool(rng.random() < 0.5) for name in ("s_next", "episode", "terminated", "truncated", "step")}
    if not (there["s_next"] or there["episode"] or there["terminated"] or there["truncated"]):
        there["episode"] = True
    n, episode, step = 300, 0, 0
    rows = []
    for _ in range(n):
        s, a, s_next = (f"s{rng.integers(4)}", f"a{rng.integers(3)}", f"s{rng.integers(4)}")
        row = dict(s=s, a=a, r=float(rng.normal()), s_next=s_next,
                   terminated=bool(rng.random() < 0.1), truncated=bool(rng.random() < 0.1))  # fmt: skip
        row |= dict(episode=episode, step=step)
        step += 1 if rng.random() < 0.9 else 3
        if row["terminated"] or row["truncated"] or rng.random() < 0.05:
            episode, step = episode + 1, 0
        rows.append(row)
    names = ["s", "a", "r", *(name for name, used in there.items() if used)]
    frame = {name: [row[name] for row in rows] for name in names}
    log = read_log(frame)
    assert named(log) == reference(rows, **there)
    report, after = log.report, [*rows[1:], None]
    ends = [
        b is None
        or any(there[x] and a[x] for x in ("terminated", "truncated"))
        or (there["episode"] and a["episode"] != b["episode"])
        for a, b in zip(rows, after, strict=True)
    ]
    if there["episode"] or there["terminated"] or there["truncated"]:
        terminated = sum(bool(there["terminated"] and row["terminated"]) for row in rows)
        cut = [row for row in rows if not (there["terminated"] and row["terminated"])]
        truncated = sum(bool(there["truncated"] and row["truncated"]) for row in cut)
        assert (report.episodes, report.terminated, report.truncated) == (sum(ends), terminated, truncated)
        assert report.cut == sum(ends) - terminated - truncated >= 0
    if there["s_next"]:
        assert report.gaps == sum(a["s_next"] != b["s"] for a, b, end in zip(rows, after, ends, strict=True) if not end)
    frame["r"] = [None if rng.random() < 0.1 else r for r in frame["r"]]
    spoilt = read_log(frame, on_bad="skip").report
    assert spoilt.tuples + spoilt.bad + spoilt.last + spoilt.before_gaps == spoilt.rows
    frame["r"] = [row["r"] for row in rows]
    for chunk in (1, 7):
        pieces = read_log(frame, chunk=chunk)
        assert isinstance(pieces.experience, FileRecording)
        assert pieces.experience.checksum() == log.experience.checksum()


BUSY = np.array([[0.6, 0.2], [0.7, 0.3]])  # the chance of busy after (calm, busy) x (push, rest)
BREAKS = np.array([[0, 0], [0.15, 0.02]])  # that the step ends the episode
WAGES = np.array([[2.0, 0.0], [4.0, 1.0]])


def cut_log(limits, seed):
    """(columns without a state after, that column): an episode for each of ``limits``, the most rows it may have."""
    rng, n = np.random.default_rng(seed), len(limits)
    s, live, found = np.zeros(n, int), np.ones(n, bool), []
    for t in range(limits.max()):
        a = rng.integers(2, size=n)
        ends, to = rng.random(n) < BREAKS[s, a], (rng.random(n) < BUSY[s, a]).astype(int)
        live &= t < limits
        found.append(np.stack([np.arange(n), np.full(n, t), s, a, WAGES[s, a], ends, to])[:, live])
        live, s = live & ~ends, to
    joined = np.concatenate(found, 1)
    columns = joined[:, np.lexsort((joined[1], joined[0]))].T
    frame = dict(zip(("episode", "step", "s", "a", "r", "terminated"), columns.T[:6], strict=True))
    return frame, columns.T[6]


def true_theta(charge):
    """-J* by the average-reward soft Bellman equation at beta 1, iterated in numpy."""
    to_busy = (1 - BREAKS) * BUSY
    p = np.stack([1 - to_busy, to_busy], 2)
    v = np.zeros(2)
    for _ in range(500):
        v, before = np.log(np.exp(WAGES + charge * BREAKS + p @ (v - v[0])).mean(1)), v - v[0]
    return -(v - before)[0]


def test_the_mean_of_large_rewards():
    frame = dict(s=[0, 1, 0, 1], a=[0] * 4, r=[1.5e308, 1.5e308, 1.5e308, -1.5e308], terminated=[0, 0, 0, 1])
    assert read_log(frame).report.mean_reward == pytest.approx(0.75e308, rel=1e-12)


@pytest.mark.parametrize(("limit", "step"), [(3, True), (6, False)])
def test_a_time_limit_selects_no_ends(limit, step):
    """Rows that are cut are left out, so those that end in the same place must be: else ends are too frequent."""
    frame, _ = cut_log(np.full(20_000, limit), 0)
    if not step:
        del frame["step"]
    log = read_log(frame, end_reward=-10, failures="all")  # no note: they would be errors
    assert log.report.at_limit == sum(
        ended and place == limit - 1 for ended, place in zip(frame["terminated"], cut_places(frame), strict=True)
    )
    solution = CertaintyEquivalence(1.0).fit(log.experience, 2, 2)
    estimate = erl_torch.theta_uncertainty(erl_torch.empirical_mdp(log.experience, 2, 2), 1.0)
    low, high = estimate.interval(1 - 1e-6)
    assert low < true_theta(-10) < high
    assert high - low < 0.3
    assert low < solution.theta < high
    pieces = read_log(frame, end_reward=-10, failures="all", chunk=1000)
    assert pieces.experience.checksum() == log.experience.checksum()
    given = read_experience(frame, 2, 2)  # of a problem that is known
    assert np.array_equal(given.s, log.experience.s)
    assert np.array_equal(given.s_next, log.experience.s_next)


def cut_places(frame):
    """Of each row in its episode."""
    first = np.append(True, np.diff(frame["episode"]) != 0)
    return np.arange(len(first)) - np.flatnonzero(first)[np.cumsum(first) - 1]


def test_cuts_in_many_places_are_noted():
    """The excess of ends that the note tells, against the ends that cut rows would have had."""
    limits = np.random.default_rng(1).integers(1, 5, 20_000)
    frame, s_next = cut_log(limits, 2)
    with pytest.warns(erl_torch.Note, match="A column s_next, the state after, mends it") as caught:
        log = read_log(frame)
    share = float(re.search(r"by about (\S+) of their number", str(caught[0].message))[1])
    pairs = list(zip(frame["s"], frame["a"], strict=True))
    busy = np.array([s == 1 for s, _ in pairs])
    rate = np.array(frame["terminated"])[busy].mean()  # all rows: no selection
    kept = sum(s == "1" for s, *_ in named(log))
    ends = frame["terminated"].sum() - log.report.at_limit
    assert ends / (kept - ends) / (rate / (1 - rate)) - 1 == pytest.approx(share, abs=0.05)
    read_log(frame | {"s_next": s_next})  # no note


def test_episodes_that_are_mixed_are_put_together():
    rows = [("x", 0, "p"), ("y", 0, "q"), ("x", 1, "r"), ("y", 1, "p"), ("z", 0, "q"), ("x", 2, "p"), ("z", 1, "p")]
    frame = dict(episode=[e for e, _, _ in rows], t=[t for _, t, _ in rows], s=[s for _, _, s in rows],
                 a=[0, 1] * 3 + [0], r=[0.0, 1, 2, 3, 4, 5, 6], done=[0, 0, 0, 1, 0, 1, 1])  # fmt: skip
    log = read_log(frame)
    # x: rows 0, 2, 5; y: 1, 3; z: 4, 6. Each ends by terminating: s' is the first state of the next in this order.
    assert named(log) == [
        ("p", "0", 0.0, "r"), ("r", "0", 2.0, "p"), ("p", "1", 5.0, "q"), ("q", "1", 1.0, "p"), ("p", "1", 3.0, "q"),
        ("q", "0", 4.0, "p"), ("p", "0", 6.0, "p"),
    ]  # fmt: skip
    frame["r"] = [0.0, 1, 2, None, 4, 5, 6]  # named by its place in the file
    with pytest.raises(InputError, match=r"r\[3\]=missing"):
        read_log(frame)


def test_a_next_is_drawn_from_the_prior_that_lacks_what_is_never_seen():
    rng = np.random.default_rng(0)
    n = 30_000
    s = rng.integers(3, size=n)
    a = np.where(s == 0, rng.integers(2, size=n), rng.integers(3, size=n))  # 0 has not the third action
    frame = dict(s=s, a=a, r=rng.normal(size=n), s_next=rng.integers(3, size=n))
    data = read_log(frame, seed=5).experience
    counts = np.zeros((3, 3))
    np.add.at(counts, (data.s_next, data.a_next), 1)
    prior = np.array([[0.5, 0.5, 0], [1 / 3] * 3, [1 / 3] * 3])
    expected = counts.sum(1, keepdims=True) * prior
    assert counts[0, 2] == 0
    used = expected > 0
    assert ((counts - expected)[used] ** 2 / expected[used]).sum() < 25  # chi-square, 5 degrees of freedom: 1.4e-4
    assert np.array_equal(read_log(frame, seed=5, chunk=999).recording.load().a_next, data.a_next)
    assert not np.array_equal(read_log(frame, seed=6).experience.a_next, data.a_next)
    everywhere = read_log(frame, unseen_actions="allowed")
    assert np.allclose(everywhere.problem.prior, 1 / 3)
    own = np.array([[0.9, 0.1, 0.0]] * 3)
    drawn = read_log(frame, prior_policy=own).experience.a_next
    assert set(drawn.tolist()) == {0, 1}
    assert abs(drawn.mean() - 0.1) < 5 * np.sqrt(0.09 / n)


# -- formats ---------------------------------------------------------------------------------------------------


class OnlyArrow:
    """A frame of which nothing is known but Arrow's interface."""

    def __init__(self, table):
        self._table = table

    def __arrow_c_stream__(self, requested_schema=None):
        return self._table.__arrow_c_stream__(requested_schema)


def columns_of(text):
    header, *lines = csv.reader(io.StringIO(text))
    typed = {
        name: [int(x) if name in ("customer", "week") else float(x) if name == "profit" else x for x in column]
        for name, column in zip(header, zip(*lines, strict=True), strict=True)
    }
    return typed | {name: [x == "yes" for x in typed[name]] for name in ("left", "unwatched")}


def packed(path, data):
    with gzip.open(path, "wb") as file:
        file.write(data)


def lines_of(table):
    return "".join(json.dumps(row) + "\n" for row in table.to_pylist()).encode()


def parts(folder, table, write, suffix):
    folder.mkdir()
    for i, begin in enumerate(range(0, len(table), 40)):
        write(table.slice(begin, 40), folder / f"part.{i}{suffix}")  # part.10 comes after part.9
    (folder / "_SUCCESS").touch()


WRITE = {
    "log.csv": lambda path, text, table: path.write_text(text),
    "LOG.CSV": lambda path, text, table: path.write_text(text),
    "windows.csv": lambda path, text, table: path.write_bytes(b"\xef\xbb\xbf" + text.replace("\n", "\r\n").encode()),
    "spaces.csv": lambda path, text, table: path.write_text(text.replace(",", " , ")),
    "quoted.csv": lambda path, text, table: path.write_text(re.sub(r"[^,\n]+", r'"\g<0>"', text)),
    "log.csv.gz": lambda path, text, table: packed(path, text.encode()),
    "log.tsv": lambda path, text, table: path.write_text(text.replace(",", "\t")),
    "tabs.csv": lambda path, text, table: path.write_text(text.replace(",", "\t")),
    "european.csv": lambda path, text, table: path.write_text(text.replace(",", ";").replace(".", ",")),
    "log.jsonl": lambda path, text, table: path.write_bytes(lines_of(table)),
    "log.ndjson.gz": lambda path, text, table: packed(path, lines_of(table)),
    "log.parquet": lambda path, text, table: pq.write_table(table, path, row_group_size=33),
    "log.pq": lambda path, text, table: pq.write_table(table, path),
    "LOG.PARQUET": lambda path, text, table: pq.write_table(table, path),
    "categories.pq": lambda path, text, table: pq.write_table(
        table.set_column(2, "segment", table["segment"].dictionary_encode()), path
    ),
    "parts.parquet": lambda path, text, table: parts(path, table, pq.write_table, ".parquet"),
    "parts": lambda path, text, table: parts(path, table, pa.csv.write_csv, ".csv"),
    "log.npz": lambda path, text, table: np.savez(path, **{n: np.array(x) for n, x in columns_of(text).items()}),
}  # fmt: skip
FRAMES = {
    "dict": lambda text, table: columns_of(text),
    "arrow": lambda text, table: table,
    "capsule": lambda text, table: OnlyArrow(table),
    "pandas": lambda text, table: pytest.importorskip("pandas").DataFrame(columns_of(text)),
    "polars": lambda text, table: pytest.importorskip("polars").DataFrame(columns_of(text)),
}


@pytest.fixture(scope="module")
def whole():
    text = shop_text(forgotten=False)
    return text, pa.table(columns_of(text)), by_hand(text)


@pytest.mark.parametrize("name", [*WRITE, *FRAMES])
def test_every_format_gives_the_same_tuples(tmp_path, whole, name):
    text, table, tuples = whole
    if name in WRITE:
        place = tmp_path / name
        WRITE[name](place, text, table)
    else:
        place = FRAMES[name](text, table)
    log = read_log(place, columns=ROLES)
    assert named(log) == tuples
    expected = read_log(columns_of(text), columns=ROLES)
    assert log.experience.checksum() == expected.experience.checksum()
    cut = read_log(place, columns=ROLES, chunk=7).recording
    assert (len(cut), cut.checksum()) == (len(tuples), expected.experience.checksum())
    assert cut.load().checksum() == cut.checksum()


@pytest.mark.parametrize("name", ["tuples.csv", "tuples.jsonl", "tuples.pq", "tuples.npz", "tuples"])
def test_the_five_columns_are_a_log_too(tmp_path, name):
    """With the sizes given and without, from our own files and others'."""
    data = erl_torch.collect(erl_torch.TabularMDP(np.full((4, 2, 4), 0.25), np.arange(8.0).reshape(4, 2)), 3, 200, 1)
    table = pa.table({column: getattr(data, column) for column in COLUMNS})
    path = tmp_path / name
    if name == "tuples":
        erl_torch.write_experience(data, path)
    elif name == "tuples.npz":
        data.save(path)
    elif name == "tuples.pq":
        pq.write_table(table, path)
    elif name == "tuples.jsonl":
        path.write_bytes(lines_of(table))
    else:
        pa.csv.write_csv(table, path)
    assert read_experience(path, 4, 2).checksum() == data.checksum()
    log = read_log(path)
    assert log.experience.checksum() == data.checksum()
    assert log.problem.state_labels is log.problem.action_labels is None


def test_names_of_other_programs(tmp_path):
    """D4RL's arrays; Gymnasium's names; states of several numbers."""
    np.savez(tmp_path / "d4rl.npz", observations=[[0.0], [1.0], [2.0], [0.0]], actions=[1.0, 0.0, 1.0, 1.0],
             rewards=np.arange(4, dtype=np.float32), terminals=[False, True, False, False],
             timeouts=[False, False, False, True])  # fmt: skip
    log = read_log(tmp_path / "d4rl.npz")
    assert named(log) == [("0", "1", 0.0, "1"), ("1", "0", 1.0, "2"), ("2", "1", 2.0, "0")]
    assert log.problem.state_labels is None
    assert log.report.last == 1
    frame = {
        "Observation": [(0, 1), (2, 3)],
        "Next Observation": [(2, 3), (0, 1)],
        "ACTION": ["l", "r"],
        "Reward": [1, 2],
    }
    log = read_log(frame)
    assert list(log.problem.state_labels) == [(0, 1), (2, 3)]
    frame = dict(x=[0, 2], y=["a", "b"], x2=[2, 0], y2=["b", "a"], a=[0, 1], r=[1, 2])
    log = read_log(frame, columns={"s": ["x", "y"], "s_next": ["x2", "y2"]})
    assert list(log.problem.state_labels) == [(0, "a"), (2, "b")]
    assert named(log) == [("(0, 'a')", "0", 1.0, "(2, 'b')"), ("(2, 'b')", "1", 2.0, "(0, 'a')")]


def test_done_where_time_limits_are_told_too():
    """``done`` of older programs is true at both; ``terminated`` beside ``truncated`` is an end."""
    frame = dict(s=["p", "q", "p"], a=[0, 0, 0], r=[1, 2, 3], s_next=["q", "z", "q"], truncated=[0, 1, 0])
    assert named(read_log(frame | dict(done=[0, 1, 1])))[1] == ("q", "0", 2.0, "z")
    assert named(read_log(frame | dict(terminated=[0, 1, 1])))[1] == ("q", "0", 2.0, "p")


@pytest.mark.parametrize(
    ("values", "labels"),
    [
        ([3, 1, 2], ["1", "2", "3"]),
        ([0, 1, 2], None),
        ([2.0, 0.0, 1.0], None),
        (["2", "0", "1.0"], None),
        (["10", "9", "x"], ["9", "10", "x"]),
        (["007", "7", "8"], ["7", "8", "007"]),
        ([0.5, 10.25, 2.5], ["0.5", "2.5", "10.25"]),
        ([True, False, True], ["False", "True"]),
        ([1, "1", "é"], ["1", "é"]),
        (["NA", "EU", "US"], ["EU", "NA", "US"]),
        ([-1, 0, 1], ["-1", "0", "1"]),
    ],
)
def test_labels_are_judged_by_the_whole_column(values, labels):
    log = read_log(dict(s=values, a=[0, 1, 0], r=[1, 2, 3], s_next=values[1:] + values[:1]))
    found = log.problem.state_labels
    assert (None if found is None else sorted(found.texts.tolist(), key=lambda x: (number_of(x) is None, x))) == (
        None if labels is None else sorted(labels, key=lambda x: (number_of(x) is None, x))
    )
    if labels is not None:
        assert found.texts.tolist() == labels


def test_types_are_judged_by_the_column_not_its_first_batch(tmp_path):
    """A first text after a million characters of numbers; floats after whole numbers; a first null."""
    n = 400_000
    lines = [f"{i % 3},{i % 2},{i % 5}\n" for i in range(n)]
    (tmp_path / "long.csv").write_text("s,a,r,done\n" + "".join(line[:-1] + ",0\n" for line in lines) + "x,1,0.25,1\n")
    log = read_log(tmp_path / "long.csv")
    assert log.problem.state_labels.texts.tolist() == ["0", "1", "2", "x"]
    assert log.experience.r[-1] == 0.25
    assert len(log.experience) == n + 1


@pytest.mark.parametrize("given", [False, True])
def test_a_next_of_a_log_made_with_the_prior_has_the_chances_of_its_state(given):
    """Prior rows differ by state; a row's action tells where it was drawn. In between, behind ends, and behind gaps."""
    rng = np.random.default_rng(3)
    n = 20_000
    prior = np.array([[0.999, 0.001], [0.001, 0.999]])
    truncated, gap = (rng.random(n) < 0.2 for _ in range(2))
    terminated = (rng.random(n) < 0.2) & ~truncated
    gap &= ~terminated & ~truncated
    s = rng.integers(2, size=n)
    a = (rng.random(n) < prior[s, 1]).astype(int)
    s_next = np.where(gap | terminated | truncated, 1 - np.roll(s, -1), np.roll(s, -1))
    frame = dict(s=s, a=a, r=np.ones(n), s_next=s_next, terminated=terminated, truncated=truncated)
    if given:  # at an end, what was drawn in the state where the episode ended
        frame["a_next"] = np.where(terminated, 1 - np.roll(s, -1), (rng.random(n) < prior[s_next, 1]).astype(int))
    log = read_log(frame, prior_policy=prior, on_prior=not given)
    data = log.experience
    assert len(data.s) == n
    assert log.report.gaps == gap[:-1].sum()
    assert np.array_equal(data.s_next, np.where(terminated, np.roll(s, -1), s_next))
    inside = ~(gap | terminated | truncated)
    for rows in (inside, truncated, terminated, gap):
        for state in range(2):
            drawn = data.a_next[rows & (data.s_next.astype(int) == state)]
            deviation = np.sqrt(0.001 * 0.999 / len(drawn))
            assert abs(drawn.mean() - prior[state, 1]) < 5 * deviation + 1 / len(drawn)
    if not given:
        assert np.array_equal(data.a_next[:-1][inside[:-1]], a[1:][inside[:-1]])


def test_a_next_that_the_prior_lacks_is_drawn():
    rng = np.random.default_rng(4)
    prior = np.array([[0.5, 0.5, 0.0], [0.0, 0.5, 0.5]])
    s, s_next = rng.integers(2, size=(2, 4000))
    a = np.where(s == 0, rng.integers(2, size=4000), 1 + rng.integers(2, size=4000))
    frame = dict(s=s, a=a, r=np.ones(4000), s_next=s_next, a_next=rng.integers(3, size=4000))
    data = read_log(frame, prior_policy=prior).experience
    assert len(data.s) == 4000
    has = prior[s_next, frame["a_next"]] > 0
    assert np.array_equal(data.a_next[has], frame["a_next"][has])
    assert (prior[data.s_next, data.a_next] > 0).all()
    again = data.a_next[~has & (s_next == 0)]
    assert abs(again.mean() - 0.5) < 5 * 0.5 / np.sqrt(len(again))


def test_an_episode_that_is_not_told():
    """Nothing is known of a row without its episode: neither what it leads to, nor what led to it."""
    rows = [{"s": i % 3, "a": 0, "r": float(i), "episode": 0, "step": i, "terminated": False} for i in range(8)]
    rows[3]["episode"] = None
    frame = pa.Table.from_pylist(rows)
    with pytest.raises(InputError, match=r"episode\[3\]=missing: must be there"):
        read_log(frame)
    log = read_log(frame, on_bad="skip")
    assert log.experience.r.tolist() == [0, 1, 4, 5, 6]
    assert (log.report.bad, log.report.first_bad) == (1, "episode[3]=missing")
    nowhere = frame.set_column(3, "episode", pa.nulls(8, pa.int64()))
    with pytest.raises(InputError, match=r"episode\[0\]=missing: must be there"):
        read_log(nowhere)


def test_steps_that_go_down_without_a_column_of_episodes_are_gaps():
    """An episode may have been cut there, and another one begun."""
    frame = dict(s=[0, 1, 2, 0, 1, 2], a=[0] * 6, r=[0.0, 1, 2, 3, 4, 5], step=[0, 1, 2, 0, 1, 2],
                 terminated=[False] * 5 + [True])  # fmt: skip
    log = read_log(frame)
    assert log.experience.r.tolist() == [0, 1, 3, 4, 5]
    assert log.report.before_gaps == 1


# -- hostile files -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("empty.csv", b"", "must be a readable CSV file"),
        ("header.csv", b"s,a,r,done\n", "no row: must be at least one row"),
        ("one.csv", b"s,a,r,done\n0,0,1,0\n", "0 good tuples"),
        ("ragged.csv", b"s,a,r,done\n0,0,1,0\n0,0\n", r"readable CSV file.*Expected 4 columns, got 2"),
        ("names.csv", b"x,y,z\n0,0,1\n", "s=missing: must be a column named s, state, .*the columns are x, y, z"),
        ("twice.csv", b"s,state,a,r,done\n0,0,0,1,1\n", "s=s and state: must be one column: say which, columns.s=NAME"),
        ("same.csv", b"s,s,a,r,done\n0,0,0,1,1\n", "s=s and s: must be one column"),
        ("ends.csv", b"s,a,r\n0,0,1\n", "s_next=missing: must be a column, or else one that tells the episodes"),
        ("text.csv", b"s,a,r,done\n0,0,1,0\n0,0,much,1\n", r"r\[1\]=much: must be a finite number"),
        ("inf.csv", b"s,a,r,done\n0,0,inf,1\n", r"r\[0\]=inf: must be a finite number"),
        ("digits.csv", b"s,a,r,done\n0,0,1_0,1\n", r"r\[0\]=1_0: must be a finite number"),
        ("flag.csv", b"s,a,r,done\n0,0,1,maybe\n", r"terminated\[0\] \(done\)=maybe: must be true or false"),
        ("noflag.csv", b"s,a,r,done\n0,0,1,\n", r"terminated\[0\] \(done\)=missing: must be true or false"),
        ("lost.csv", b"s,a,r,done\nx,0,1,0\n,0,1,1\n", r"s\[1\]=missing: must be one of x"),
        (
            "nul.csv",
            b"s,a,r,done\nx,0,1,0\ny\0,0,1,1\n",
            r"nul.csv: s='y.x00': must be a text without the character NUL",
        ),
        (
            "down.csv",
            b"episode,t,s,a,r\n1,3,0,0,1\n1,2,1,0,1\n1,1,0,0,1\n",
            r"t\[1\]=2: must be at least 3, that of the row before: steps of an episode are in order of time",
        ),
        (
            "mixed.csv",
            b"episode,t,s,a,r\n0,0,0,0,1\n0,2,1,0,1\n0,1,0,0,1\n0,3,0,0,1\n",
            r"t\[2\]=1: must be at least 2",
        ),
        ("latin.csv", "s,a,r,done\né,0,1,1\n".encode("latin-1"), "must be a readable CSV file"),
        (
            "cut.csv.gz",
            gzip.compress(b"s,a,r,done\n" + b"0,0,1,1\n" * 9000, mtime=0)[:40],
            "must be a readable CSV file",
        ),
        ("none.csv.gz", b"s,a,r,done\n0,0,1,1\n", "must be a readable CSV file"),
        ("text.jsonl", b'{"s":0,"a":0,"r":1,"done":true}\nnothing\n', "line 2=nothing: must be a JSON object"),
        ("list.jsonl", b"[1,2]\n", r"line 1=\[1,2\]: must be a JSON object"),
        ("short.jsonl", b'{"s":0,"a":0,"r":1,"done":true}\n{"s":0,"a":0,"r":1}\n', r"terminated\[1\] \(done\)=missing"),
        ("empty.jsonl", b"", "s=missing"),
        ("broken.parquet", b"PAR1nothing", "must be a readable Parquet file"),
        ("broken.npz", b"PK\x03\x04", "must be a readable npz file"),
        ("log.txt", b"s,a,r\n", "must be there: a CSV, Parquet, JSON-lines or npz file"),
    ],
)
def test_one_line_for_what_cannot_be_read(tmp_path, name, content, said):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=said) as error:
        read_log(tmp_path / name)
    assert "\n" not in str(error.value)
    assert name in str(error.value)


def test_bad_rows_are_left_out_and_counted(tmp_path):
    path = tmp_path / "t.csv"
    path.write_text("episode,s,a,r\n1,x,0,1\n1,y,0,\n1,,0,2\n1,x,1,3\n1,y,0,4\n1,x,0,5\n")
    log = read_log(path, on_bad="skip")
    # The row before the one whose state is missing has no state after.
    assert named(log) == [("x", "0", 1.0, "y"), ("x", "1", 3.0, "y"), ("y", "0", 4.0, "x")]
    assert (log.report.bad, log.report.last) == (2, 1)
    assert log.report.first_bad == "r[1]=missing"
    assert log.recording.n_skipped == 2


def test_other_refusals(tmp_path):
    frame = dict(s=[0, 1], a=[0, 1], r=[1, 2], done=[0, 1])
    for columns, said in (
        ({"q": "s"}, "columns.q=s: must be left out: no such column; there are s, a, r"),
        ({"s": "x"}, "columns.s=x: must be a column of dict; the columns are s, a, r, done"),
        ({"r": ["s", "r"]}, "columns.r="),
        ({"s": None}, "s=missing"),
        ({"s": ["s", "done"], "s_next": "s"}, "columns.s_next=s: must be 2 columns, as columns.s has"),
        ({"a": []}, "columns.a="),
    ):
        with pytest.raises(InputError, match=re.escape(said)):
            read_log(frame, columns=columns)
    with pytest.raises(InputError, match=r"columns\.step=when: must be a counter"):
        read_log(frame | dict(when=[5, 5]), columns={"step": "when"})
    with pytest.raises(InputError, match="unseen_actions=some: must be missing or allowed"):
        read_log(frame, unseen_actions="some")
    with pytest.raises(InputError, match="lengths"):
        read_log(frame | {"r": [1, 2, 3]})
    with pytest.raises(InputError, match="path=int: must be a path, a frame"):
        read_log(3)
    with pytest.raises(InputError, match="cut into bins first: it has 1,500 different values"):
        read_log(dict(s=(np.arange(1500) + 0.5), a=np.zeros(1500), r=np.zeros(1500), done=np.zeros(1500)))
    (tmp_path / "d").mkdir()
    (tmp_path / "d" / "a.csv").write_text("s,a,r,done\n0,0,1,1\n")
    (tmp_path / "d" / "b.csv").write_text("s,a,done\n0,0,1\n")
    with pytest.raises(InputError, match=r"b\.csv: columns=s, a, done: must be of the columns of a\.csv"):
        read_log(tmp_path / "d")
    (tmp_path / "d" / "year=1").mkdir()
    with pytest.raises(InputError, match="a directory of parts of one format, and of nothing else: it has year=1"):
        read_log(tmp_path / "d")


def test_a_log_whose_sizes_are_given(tmp_path):
    """With an environment its numbers count, and what is out of range is named."""
    path = tmp_path / "t.csv"
    path.write_text("s,a,r,s_next\n0,0,1,1\n1.0,1,2,0\n")
    data = read_experience(path, 2, 2)
    assert [data.s.tolist(), data.a.tolist(), data.s_next.tolist()] == [[0, 1], [0, 1], [1, 0]]
    for size, said in (((1, 2), r"s_next\[0\]=1: must be a whole number in \[0, 1\)"), ((2, 1), r"a\[1\]=1")):
        with pytest.raises(InputError, match=said):
            read_experience(path, *size)
    labels = erl_torch.labels.Labels.of_values(["x", "y"])
    path.write_text("s,a,r,s_next\nx,0,1,y\ny,1,2,x\n")
    with pytest.raises(InputError, match=r"s\[0\]=x: must be a whole number in \[0, 2\)"):
        read_experience(path, 2, 2)
    assert read_experience(path, 2, 2, state_labels=labels).s.tolist() == [0, 1]
    path.write_text("s,a,r,s_next\nx,0,1,z\n")
    with pytest.raises(InputError, match=r"s_next\[0\]=z: must be one of x, y"):
        read_experience(path, 2, 2, state_labels=labels)


# -- runs ----------------------------------------------------------------------------------------------------------

SHORT = ("learner.n_bias=2", "learner.n_epochs=2", "learner.beta=1")
COLUMNS_TYPED = "experience.columns={" + ", ".join(f"{role}: {name}" for role, name in ROLES.items()) + "}"


@pytest.fixture
def shop(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "shop.csv").write_text(shop_text(200, 1))
    return ("experience=recorded", "experience.path=shop.csv", "++" + COLUMNS_TYPED, "experience.on_bad=skip")


@pytest.mark.parametrize("learner", ["s1", "s1_efficient", "certainty_equivalence", "differential_soft_q"])
def test_a_run_says_what_the_data_say_and_no_more(tmp_path, shop, capsys, learner):
    few = () if learner == "certainty_equivalence" else ("learner.n_epochs=3",)
    result = train(composed(*shop, f"learner={learner}", "learner.beta=1", *few), tmp_path / "run")
    out = capsys.readouterr().out
    assert out.startswith("log               shop.csv: ")
    assert out.index("not answered") < out.index(f"log, {learner}, beta 1, seed 0: ")
    assert "windy" not in out
    assert "proven" not in out.split("seed 0:")[1]
    assert "return" not in out.split("seed 0:")[1]
    for key in ("theta_bounds", "gap", "return", "reward_per_step"):
        assert result[key] is None, key
    assert json.loads((tmp_path / "run" / "result.json").read_text())["log"]["states"] == 4
    tags = scalars(tmp_path / "run")
    assert not [tag for tag in tags if re.match(r"optimal/|.*(return|reward_per_step)", tag)]
    assert undocumented(tmp_path / "run") == set()
    assert events(tmp_path / "run").Images("policy")
    theta, policy = solved(counted(by_hand((tmp_path / "shop.csv").read_text()))[1], 1.0)
    if learner in ("s1_efficient", "certainty_equivalence"):
        assert result["theta"] == pytest.approx(theta, abs=1e-5)
        assert result["objective"] == pytest.approx(-theta, abs=1e-5)
    else:
        assert result["objective"] <= -theta + 1e-9  # of the model of the counts, its best is -theta
    with np.load(tmp_path / "run" / "solution.npz") as saved:
        assert saved["state_labels"].tolist() == ["gold", "new", "regular", "sleeping"]
        assert saved["action_labels"].tolist() == ["call", "mail", "nothing"]
    table = list(csv.reader((tmp_path / "run" / "policy.csv").read_text().splitlines()))
    assert table[0] == ["state", "action", "probability", "prior", "visits"]
    assert {(s, a) for s, a, *_ in table[1:]} == set(policy)
    if learner == "certainty_equivalence":
        assert {(s, a): pytest.approx(float(p), abs=1e-6) for s, a, p, *_ in table[1:]} == policy


def test_the_prior_of_the_counts(tmp_path, shop):
    """The objective of the prior policy, by the stationary distribution of the counted chain."""
    train(composed(*shop, *SHORT, "evaluation.pictures=false"), tmp_path / "run")
    states, pairs = counted(by_hand((tmp_path / "shop.csv").read_text()))
    share = np.full(len(states), 1 / len(states))
    chain, reward = np.zeros((len(states), len(states))), np.zeros(len(states))
    for i, s in enumerate(states):
        own = [pair for pair in pairs if pair[0] == s]
        for pair in own:
            reward[i] += pairs[pair][1] / len(own)
            for to, p in pairs[pair][0].items():
                chain[i, states.index(to)] += p / len(own)
    for _ in range(3000):
        share = share @ chain
    assert scalars(tmp_path / "run")["eval/objective"][0][1] == pytest.approx(float(share @ reward), rel=1e-5)


def test_what_is_missing_may_be_allowed(tmp_path, shop):
    result = train(
        composed(*shop, "env.unseen_actions=allowed", "learner=s1_efficient", "learner.beta=1"), tmp_path / "run"
    )
    assert result["log"]["unseen_actions"] == "allowed"
    table = list(csv.reader((tmp_path / "run" / "policy.csv").read_text().splitlines()))
    assert len(table) == 1 + 4 * 3
    assert {row[3] for row in table[1:]} == {str(1 / 3)}


def test_a_log_resumes_sweeps_and_varies(tmp_path, shop, typed_here):
    typed = [*(word.removeprefix("++") for word in shop), "learner.beta=1", "evaluation.pictures=false"]
    code, _, err = typed_here("train.py", *typed, *SHORT, "hydra.run.dir=whole")
    assert code == 0, err
    whole = json.loads((tmp_path / "whole" / "result.json").read_text())
    solution = (tmp_path / "whole" / "solution.npz").read_bytes()
    result = json.loads((tmp_path / "whole" / "result.json").read_text())
    (tmp_path / "whole" / "result.json").unlink()  # as if it had been killed at the end
    code, _, err = typed_here("train.py", "resume=whole")
    assert code == 0, err
    again = json.loads((tmp_path / "whole" / "result.json").read_text())
    assert {k: again[k] for k in ("theta", "log", "objective")} == {k: result[k] for k in ("theta", "log", "objective")}
    assert (tmp_path / "whole" / "solution.npz").read_bytes() == solution
    code, _, err = typed_here("train.py", "-m", *typed, "learner=s1", "learner.n_bias=1", "learner.n_epochs=1",
                              "learner.lr_u=0.01,0.02", "hydra.sweep.dir=sweep")  # fmt: skip
    assert code == 0, err
    assert len(list((tmp_path / "sweep").glob("*/policy.csv"))) == 2
    code, _, err = typed_here("train.py", *typed, *SHORT, "+vary.beta=[1,2]", "hydra.run.dir=many")
    assert code == 0, err
    many = json.loads((tmp_path / "many" / "result.json").read_text())
    assert many["groups"][0]["theta"]["mean"] == whole["theta"]
    assert many["groups"][0]["objective"]["mean"] == pytest.approx(whole["objective"], rel=1e-12)
    assert many["log"] == whole["log"]
    code, _, err = typed_here("play.py", "run=whole")
    assert (code, err.count("\n")) == (1, 1)
    assert "a log alone has none to play in; its policy is in whole/policy.csv" in err


@pytest.mark.parametrize(
    ("typed", "said"),
    [
        (("learner=exact",), "learner=exact: must be one that learns from experience: a log has no model to solve"),
        (("n_replicas=2",), "n_replicas=2: must be 1: on one stream"),
        (("env.wind_strength=0.5",), "env.wind_strength=0.5: no such key; there are "),
        (("env.unseen_actions=maybe",), "env.unseen_actions=maybe: must be missing or allowed"),
        (
            ("experience.columns.s=colour",),
            "experience.columns.s=colour: must be a column of shop.csv; the columns are",
        ),
        (
            ("experience.columns.s=null",),
            "experience.path=shop.csv: s=missing: must be a column named s, state, states, obs, observation, "
            "observations, or any other: experience.columns.s=NAME; the columns are",
        ),
        (("experience.on_bad=stop",), r"experience.path=shop.csv: r\["),
        (("learner.prior_policy=p.npy",), "learner.prior_policy=array of shape (2, 2): must be of shape [4, 3]"),
        (("env=windy_cliff",), "experience.path=shop.csv: s[0] (segment)=new: must be a whole number in [0, 15)"),
    ],
)
def test_complaints(tmp_path, shop, typed_here, typed, said):
    np.save(tmp_path / "p.npy", np.full((2, 2), 0.5))
    words = [word.removeprefix("++") for word in shop if not word.startswith("experience.on_bad")]
    words.append("experience.on_bad=skip")
    code, _, err = typed_here("train.py", *words, *typed, "hydra.run.dir=run")
    if "on_bad" in typed[0]:
        assert re.search(said, err)
    elif "env=windy_cliff" not in typed:
        assert err.startswith(f"error: {said}"), err
    assert (code, not (tmp_path / "run").exists()) == (1, True)
    assert err.count("\n") == 1


def test_env_log_learns_from_recordings_alone(tmp_path, typed_here):
    code, _, err = typed_here("train.py", "env=log", "hydra.run.dir=run")
    assert code == 1
    assert err == "error: experience=simulate: must be recorded: env=log has no environment to collect from\n"
    code, _, err = typed_here("compare.py", "env=log", "seeds=1", "hydra.run.dir=run")
    assert (code, err.count("\n")) == (1, 1)


def test_from_python(tmp_path):
    text = shop_text(200, 1)
    (tmp_path / "shop.csv").write_text(text)
    log = read_log(tmp_path / "shop.csv", columns=ROLES, on_bad="skip")
    theta, _ = solved(counted(by_hand(text))[1], 1.0)
    with pytest.warns(erl_torch.Note, match="bad tuples"):
        solution = erl_torch.train(EfficientS1(1.0), log, directory=tmp_path / "run")
    assert solution.theta == pytest.approx(theta, abs=1e-5)
    assert solution.theta_bounds is solution.gap is None
    assert json.loads((tmp_path / "run" / "result.json").read_text())["log"]["tuples"] == len(log.experience)
    assert (tmp_path / "run" / "policy.csv").is_file()
    again = erl_torch.train(EfficientS1(1.0), log.problem, log.experience, directory=tmp_path / "other")
    assert again.theta == solution.theta
    many = Replicas.of(EfficientS1(1.0), beta=[1.0, 2.0])
    found = erl_torch.train(many, log, directory=tmp_path / "many")
    assert found.theta[0] == pytest.approx(theta, abs=1e-5)
    assert len(found) == 2


@pytest.mark.slow
def test_the_page_in_three_commands(tmp_path, start):
    """The commands of docs/logs.md as typed, and the truth behind the shop inside what the data say."""
    page = (ROOT / "docs" / "logs.md").read_text()
    block = re.search(r"```sh\n(.*?)```", page, re.S)[1].replace("\\\n", " ")
    commands = [line for line in block.splitlines() if line.strip()]
    assert len(commands) == 3
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    printed = []
    for command in commands:
        words = shlex.split(command)
        if words[0] == "erl-torch":
            words = [sys.executable, "-m", "erl_torch.cli.commands", *words[1:]]
        elif words[0] == "python":
            words[0] = sys.executable
        code, out, err = ended(start(*words, cwd=tmp_path, env={**os.environ, "PYTHONPATH": path}))
        assert code == 0, err
        printed.append(out)
    shown = re.findall(r"```text\n(.*?)```", page, re.S)
    assert len(shown) == 3
    for text, out in zip(shown, printed, strict=True):  # in the same order
        lines, said = (list(map(_told, filter(str.strip, one.splitlines()))) for one in (text, out))
        assert [line for line in said if line in lines] == lines
    result = json.loads((tmp_path / "runs" / "shop" / "result.json").read_text())
    theta, policy = solved(truth(), 1.0)
    value, half = map(float, re.fullmatch(r"theta = (\S+) \+- (\S+)", result["data"]).groups())
    assert abs(value - theta) <= half
    learnt = {(s, a): float(p) for s, a, p, *_ in csv.reader(printed[2].splitlines()[1:])}
    best = {s: max((p, a) for (t, a), p in policy.items() if t == s)[1] for s, _ in policy}
    assert {s: max((p, a) for (t, a), p in learnt.items() if t == s)[1] for s in best} == best
    assert f"is {-theta:.2f}. The" in page


def _told(line):
    """``line`` with its numbers to nine digits: the last ones are the processor's."""
    return re.sub(r"\d+\.\d{10,}", lambda number: f"{float(number[0]):.9g}", line.rstrip())


def truth():
    """The shop as its example describes it, {(s, a): ({s': chance}, mean profit)}: a new one comes after who leaves."""
    order = SHOP["SEGMENTS"]
    pairs = {}
    for s in order:
        for a in SHOP["offers_of"](s):
            up, i = SHOP["OFFERS"][a], order.index(s)
            stays = 1 - (SHOP["LEAVES"] if s == "sleeping" else 0)
            to = defaultdict(float)
            to["new"] += 1 - stays
            to[order[min(i + 1, 3)]] += stays * up
            to[order[max(i - 1, 0)]] += stays * (1 - up) / 2
            to[s] += stays * (1 - up) / 2
            pairs[s, a] = (dict(to), SHOP["SALES"][s] - SHOP["COSTS"][a])
    return pairs


# -- a charge or a bonus at the ends of a log -------------------------------------------------------------------

ENDS = """state,action,reward,terminated
a,go,0,0
b,go,-1,1
a,go,0,0
b,go,2,1
a,stay,0.5,0
a,go,0,0
b,stay,0,1
"""


@pytest.mark.parametrize(
    ("end_reward", "failures", "expected", "said"),
    [
        # ends that pay at most 0, as one pays 2
        (
            -3,
            "default",
            [0, -4, 0, 2, 0.5, 0, -3],
            "-3 at the ends that pay at most 0, 2 of 3; env.failures says which",
        ),
        (-3, "all", [0, -4, 0, -1, 0.5, 0, -3], "-3 at every end, 3 of 3"),
        (5, "default", [0, -1, 0, 7, 0.5, 0, 0], "+5 at all but the ends that pay at most 0, 1 of 3; env.failures"),
        (5, "none", [0, 4, 0, 7, 0.5, 0, 5], "+5 at every end, 3 of 3"),
        (0, "default", [0, -1, 0, 2, 0.5, 0, 0], ""),
    ],
)
def test_ends_of_a_log_count(tmp_path, capsys, end_reward, failures, expected, said):
    path = tmp_path / "log.csv"
    path.write_text(ENDS)
    log = read_log(path, end_reward=end_reward, failures=failures)
    assert log.experience.r.tolist() == expected
    assert log.report.reward_range == (-1, 2)  # as recorded
    cfg = composed(
        "experience=recorded", f"experience.path={path}", f"env.end_reward={end_reward}", f"env.failures={failures}",
        "learner=certainty_equivalence", "evaluation.pictures=false",
    )  # fmt: skip
    result = train(cfg, tmp_path / "run")
    assert result["n_experience"] == 7
    assert (result["end_reward"] or "").startswith(said)
    assert capsys.readouterr().out.count(f"end reward        {said}") == 2 * bool(said)  # in the report, and at the end


def test_breakdowns_of_any_cost_are_charged():
    """Where ends pay less than other steps do, that which pays most is no success."""
    frame = dict(s=list("ababab"), a=[0, 0, 0, 1, 0, 0], r=[-1.0, -7, -1, -10, -1, -7], terminated=[0, 1, 0, 1, 0, 1])
    log = read_log(frame, end_reward=-20)
    assert log.experience.r.tolist() == [-1, -27, -1, -30, -1, -27]
    assert "end reward        -20 at every end, 3 of 3" in str(log.report)
    unlike = read_log(frame | {"r": [-7.0, -7, -7, -10, -7, -7]}, end_reward=-20)
    assert unlike.experience.r.tolist() == [-7, -7, -7, -30, -7, -7]
    assert "-20 at the ends that pay less than -7, 1 of 3; env.failures says which" in str(unlike.report)


@pytest.mark.parametrize(
    ("text", "arguments", "said"),
    [
        (ENDS, {"end_reward": -1, "failures": "none"}, "end_reward=-1.0: must be 0: no end is a failure"),
        (ENDS, {"end_reward": 1, "failures": "all"}, "end_reward=1.0: must be 0: no end is a success"),
        (ENDS, {"failures": "some"}, "failures=some: must be default or unpaid or all or none"),
        (ENDS, {"end_reward": float("nan")}, "end_reward=nan"),
        (ENDS.replace(",1\n", ",0\n"), {"end_reward": -1}, "no row terminates an episode"),
    ],
)
def test_ends_that_nothing_counts_for(tmp_path, text, arguments, said):
    (tmp_path / "log.csv").write_text(text)
    with pytest.raises(InputError) as caught:
        read_log(tmp_path / "log.csv", **arguments)
    assert said in str(caught.value)


def test_the_end_of_a_bad_row_tells_nothing(tmp_path):
    """The best end, beside which others fail, is that of the rows that count."""
    path = tmp_path / "log.csv"
    path.write_text(ENDS.replace("go,2,1", "go,1,1").replace("go,-1,1", "go,1,1") + ",go,9,1\n")
    with pytest.raises(InputError, match="no end is a failure"):
        read_log(path, on_bad="skip", end_reward=-3)


def test_the_charge_of_auto_is_that_of_the_counts(tmp_path):
    """Two states, one choice: with m = share of the risky action, its failing rate is m f, and the charge at which that
    is the target is known: m/(1 - m) = exp(beta (r - f c))."""
    rng = np.random.default_rng(5)
    rows = ["s,a,r,terminated,truncated"]
    failed = visits = 0
    for _ in range(4000):
        risky = rng.random() < 0.5
        fails = risky and rng.random() < 0.2
        rows.append(f"here,{'risky' if risky else 'safe'},{0 if fails else 1.0 * risky},{int(fails)},0")
        failed, visits = failed + fails, visits + risky
    rows += ["here,safe,2,1,0"] * 2  # an end that pays more: the others are failures
    (tmp_path / "log.csv").write_text("\n".join(rows))
    n_safe = 4002 - visits
    beta, target = 2.0, 0.01
    f, paid = failed / visits, 1 - failed / visits
    gap = paid - 2 * 2 / n_safe  # rewards are means over what was seen
    share = target / f
    charge = (gap - np.log(share / (1 - share)) / beta) / f
    keys = ("env.end_reward=auto", f"env.end_target={target}", f"learner.beta={beta}", "learner=certainty_equivalence")
    cfg = composed("experience=recorded", f"experience.path={tmp_path}/log.csv", *keys)
    result = train(cfg, tmp_path / "run")
    found = float(re.search(r"end_reward=auto: (\S+), by the counts", " ".join(result["notes"]))[1])
    assert found == pytest.approx(-charge, rel=1e-6)
    text = (tmp_path / "run" / "policy.csv").read_text()
    assert float(re.search(r"here,risky,(\S+?),", text)[1]) == pytest.approx(share, rel=1e-6)


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        (("+vary.beta=[1,2]",), "one beta: the charge depends on it"),
        (("env.end_target=0",), "env.end_target=0"),
        (("env.failures=none",), "env.end_reward"),
    ],
)
def test_auto_that_cannot_be(tmp_path, keys, said):
    (tmp_path / "log.csv").write_text(ENDS)
    cfg = composed("experience=recorded", f"experience.path={tmp_path}/log.csv", "env.end_reward=auto", *keys)
    with pytest.raises(InputError, match=said):
        train(cfg, tmp_path / "run")


# -- clocks, episodes that stand apart, names -------------------------------------------------------------------


@pytest.mark.parametrize("unit", [0.01, 1 / 3, 1e-3, 7.0])
@pytest.mark.parametrize("begin", [0.0, 1.7e9])
def test_a_clock_goes_up_by_as_much_as_it_shows(unit, begin):
    """0.01 k as a double: differences are not the same in all digits."""
    rng = np.random.default_rng(0)
    step = begin + unit * np.arange(1000)
    frame = {"s": rng.integers(3, size=1000), "a": rng.integers(2, size=1000), "r": rng.random(1000), "t": step}
    whole = read_log(frame | {"episode": np.zeros(1000, int)})
    assert (whole.report.before_gaps, whole.report.tuples) == (0, 999)
    kept = np.delete(np.arange(1000), [300, 700])
    cut = read_log({name: column[kept] for name, column in frame.items()} | {"episode": np.zeros(998, int)})
    assert (cut.report.before_gaps, cut.report.tuples) == (2, 995)


def test_episodes_that_stand_apart_are_put_together_with_the_state_after():
    n = 20
    frame = {
        "episode": np.arange(n) % 2, "s": np.arange(n) % 3, "a": np.zeros(n, int), "r": np.ones(n),
        "s_next": (np.arange(n) + 1) % 3,
    }  # fmt: skip
    assert read_log(frame).report.episodes == 2


def test_the_names_of_a_log_belong_to_a_run(tmp_path):
    """The same numbers under other names gave the names of the run before."""
    learner = CertaintyEquivalence(beta=1.0)
    quick = erl_torch.EvaluationSettings(pictures=False)
    for states, refused in ((["a", "b"], False), (["c", "d"], True), (["a", "b"], False)):
        frame = {"s": states * 10, "a": ["u", "v", "u"] * 6 + ["v", "u"], "r": np.arange(20.0), "episode": [0] * 20}
        log = read_log(frame)
        if refused:
            with pytest.raises(InputError, match="of a run with these settings"):
                erl_torch.train(learner, log, directory=tmp_path, evaluation=quick)
        else:
            found = erl_torch.train(learner, log, directory=tmp_path, evaluation=quick)
            assert [*found.state_labels.texts] == states


def test_a_row_that_cannot_be_split_hides_no_step(tmp_path):
    """Left out, it made the row before lead to the row after it."""
    lines = [json.dumps({"s": s, "a": 0, "r": 1.0, "episode": 0}) for s in "abcd"]
    for name, text in (
        ("log.csv", "s,a,r,episode\na,0,1,0\nb,0,1,0\nc,0\nd,0,1,0\n"),
        ("log.jsonl", "\n".join([*lines[:2], '{"s": ', lines[3]])),
    ):
        (tmp_path / name).write_text(text)
        with pytest.raises(InputError):
            read_log(tmp_path / name)
        with pytest.raises(InputError, match="1 lines that are no rows: must be mended"):
            read_log(tmp_path / name, on_bad="skip")
    whole = tmp_path / "whole.jsonl"
    row = {"s": "a", "a": 0, "r": 1.0, "s_next": "a"}
    whole.write_text(f"{json.dumps(row)}\n{{\n{json.dumps(row)}\n")
    log = read_log(whole, on_bad="skip")
    assert (log.report.tuples, log.report.bad) == (2, 1)
    assert "1 bad row (the first is a line that is no row)" in str(log.report)


# -- missing cells of a column of episodes ------------------------------------------------------------------------


@pytest.mark.parametrize("gone", ["", "NA", "nan"])
@pytest.mark.parametrize("header", ["s,a,r,episode", "s,a,r,episode,step"])
def test_a_row_whose_episode_is_missing_is_named_as_in_other_formats(tmp_path, gone, header):
    """Rows far apart were put together as an episode more, so that states led to others that never followed."""
    episodes = ["1", gone, "1", "2", gone, "2", "2"]
    steps = [0, 1, 2, 0, 1, 2, 3]
    rows = [f"{s},go,1,{episode}" for s, episode in zip("abcdefg", episodes, strict=True)]
    if header.endswith("step"):
        rows = [f"{row},{step}" for row, step in zip(rows, steps, strict=True)]
    (tmp_path / "log.csv").write_text("\n".join([header, *rows]))
    with pytest.raises(InputError, match=r"episode\[1\].*must be there"):
        read_log(tmp_path / "log.csv")
    log = read_log(tmp_path / "log.csv", on_bad="skip")
    texts = log.problem.state_labels.texts
    led = {(str(texts[s]), str(texts[t])) for s, t in zip(log.experience.s, log.experience.s_next, strict=True)}
    assert led <= {("a", "c"), ("f", "g"), ("d", "f")} - ({("a", "c"), ("d", "f")} if "step" in header else set())
    assert log.report.bad == 2


def test_names_of_episodes_may_be_words_that_stand_for_nothing(tmp_path):
    """Among words "none" is a name."""
    (tmp_path / "log.csv").write_text("s,a,r,episode\n0,0,1,none\n1,0,1,none\n0,1,1,all\n1,1,1,all\n")
    assert read_log(tmp_path / "log.csv").report.episodes == 2
