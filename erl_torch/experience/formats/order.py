"""The order of the rows of a table: episodes together, steps one after the other."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np

from erl_torch.checks import InputError
from erl_torch.experience.formats.encoding import numbers, truth
from erl_torch.experience.formats.roles import Roles
from erl_torch.experience.formats.table import Sorted, Table

ROWS = 1 << 16  # at a time
MOST_SORTED = 1 << 22  # rows that are put in order in memory
MOST_STRIDES = 1000


def in_order(source: Table, roles: Roles) -> Table:
    """``source`` with the rows of each episode together: episodes in the order of their first rows.

    Raises InputError where that takes more than ``MOST_SORTED`` rows in memory.
    """
    if "episode" not in roles:
        return source
    (name,) = roles["episode"]
    known: dict[Any, int] = {}  # numbers of the episodes, by their first rows
    order: list[np.ndarray] = []
    apart, last, n = False, 0, 0
    for found in source.batches([name], ROWS, False):
        values, codes = found[name].factors()
        met, first = np.unique(codes, return_index=True)
        for code in met[np.argsort(first)].tolist():
            if code >= 0:
                known.setdefault(values[code], len(known))
        place = np.array([known.get(value, -1) for value in values] + [-1], np.int64)[codes]
        place = np.concatenate(([last], place))
        # Where it is missing: as in the row before.
        place = place[np.maximum.accumulate(np.where(place >= 0, np.arange(len(place)), 0))]
        apart = apart or bool((np.diff(place) < 0).any())
        last, n = int(place[-1]), n + len(codes)
        if n <= MOST_SORTED:
            order.append(place[1:].astype(np.int32))
        elif apart:
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

    Raises InputError for steps that go down inside an episode, and names the first such row. Without a column
    ``episode`` one that goes down now and then may begin an episode whose end is not told: it is a gap.
    """
    if "step" not in roles or "s_next" in roles:
        return 0.0
    (name,) = roles["step"]
    episode = roles.get("episode", ())
    flags = [flag for role in ("terminated", "truncated") for flag in roles.get(role, ())]
    counted: Counter[float] = Counter()
    n, lost = 0, 0
    last: tuple[Any, float, bool] | None = None  # episode, step, and whether it ended there
    for found in source.batches(list(dict.fromkeys([name, *episode, *flags])), ROWS, False):
        step = numbers(found[name], False)
        if not len(step):
            continue
        ended = np.zeros(len(step), bool)
        for flag in flags:
            ended |= truth(found[flag]) == 1
        same = np.append(False, ~ended[:-1])  # episode as the row before
        first = final = None
        if episode:
            values, codes = found[episode[0]].factors()
            same[1:] &= (codes[1:] == codes[:-1]) & (codes[1:] >= 0)
            first, final = (None if code < 0 else values[code] for code in codes[[0, -1]].tolist())
        same[0] = last is not None and last[0] == first and not last[2] and (first is not None or not episode)
        before = np.append(np.nan if last is None else last[1], step[:-1])
        with np.errstate(invalid="ignore"):
            up = np.where(same & np.isfinite(step) & np.isfinite(before), step - before, np.nan)
        if episode and (up < 0).any():
            i = int(np.argmax(up < 0))
            allowed = f"at least {before[i]:.15g}, that of the row before: steps of an episode are in order of time"
            raise InputError(f"path={source.path}: {name}[{source.number(n + i)}]", f"{step[i]:.15g}", allowed)
        up = up[np.isfinite(up)]
        if len(counted) <= MOST_STRIDES:
            # Steps of a clock differ in their last digits.
            different, times = np.unique(np.array([float(f"{x:.6g}") for x in up.tolist()]), return_counts=True)
            counted.update(dict(zip(different.tolist(), times.tolist(), strict=True)))
        n, lost, last = n + len(step), lost + int(np.isnan(step).sum()), (final, float(step[-1]), bool(ended[-1]))
    stride, most = counted.most_common(1)[0] if counted else (0.0, 0)
    usable = 2 * most > counted.total() and 2 * lost < n
    if stride < 0 and usable:
        raise InputError(f"path={source.path}: {name}", f"steps of {stride:g}", "in order of time: it goes down")
    usable = usable and stride > 0
    if key and not usable and counted.total():
        raise InputError(key, name, "a counter: it must go up by the same number from row to row of an episode")
    return stride if usable else 0.0
