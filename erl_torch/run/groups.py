"""Replicas in groups of the same settings, and the record of their figures."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from erl_torch import checks, pictures
from erl_torch.checks import InputError
from erl_torch.learners.learner import StreamLearner
from erl_torch.log.quantities import BANDS, BY_NAME, PROGRESS, QUANTITIES, SWEEP, Quantity, tagged
from erl_torch.log.tensorboard import Board
from erl_torch.run.identity import plain

LOGGED = ("mean", "median", "q25", "q75", "min", "max")
MOST_LOGGED = (
    24  # groups with curves of their own, on the boards and in pictures; all are in result.json and in sweep.png
)


@dataclass(frozen=True)
class Group:
    """Replicas with the same settings."""

    settings: Mapping[str, Any]  # those that vary
    members: slice | np.ndarray  # of all replicas
    beta: float
    optimism: float = 0.0

    @property
    def name(self) -> str:
        """As a part of tags: ``replicas``, or ``beta_2``."""
        return "-".join(f"{key}_{setting_text(value)}" for key, value in self.settings.items()) or "replicas"

    @property
    def title(self) -> str:
        return ", ".join(f"{key} {setting_text(value)}" for key, value in self.settings.items())


def setting_text(setting: object) -> str:
    """A setting as a part of titles and tags; other numbers have other texts."""
    if not checks.is_number(setting):
        return str(setting)
    short = f"{setting:g}"
    return short if float(short) == setting else repr(setting)


def groups_of(
    vary: Mapping[str, Any], n_replicas: int, settings: Mapping[str, Any], beta: float, optimism: float = 0.0
) -> list[Group]:
    """Every combination of the values that vary, in their order: ``n_replicas`` of each.

    Args:
        vary: a number, or a list of numbers, by the setting that takes them.
        n_replicas: in each group.
        settings: those of the learner, by name.
        beta, optimism: of the learner, where they do not vary.

    Raises:
        InputError: a key that is no setting of the learner, or values that are not numbers.
    """
    names = [name for name in settings if name not in ("name", "class", "prior_policy")]
    columns = {}
    for key, values in vary.items():
        column = values if isinstance(values, list) else [values]
        if key not in names:
            raise InputError(f"vary.{key}", values, f"left out: the settings of the learner are {', '.join(names)}")
        if not column or not all(checks.is_number(value) for value in column):
            raise InputError(f"vary.{key}", values, "a list of numbers")
        if any(abs(value) > checks.LARGEST_INTEGER for value in column if isinstance(value, int)):
            raise InputError(f"vary.{key}", values, "whole numbers below 2**63")
        if len(set(column)) < len(column):
            raise InputError(f"vary.{key}", values, "values that differ (n_replicas is how many there are of each)")
        columns[key] = column
    groups = []
    for i, values in enumerate(itertools.product(*columns.values())):
        varied = dict(zip(columns, values, strict=True))
        members = slice(i * n_replicas, (i + 1) * n_replicas)
        of = float(varied.get("beta", beta)), float(varied.get("optimism", optimism))
        groups.append(Group(varied, members, *of))
    return groups


def groups_among(learners: Sequence[StreamLearner[Any, Any]]) -> tuple[list[Group], dict[str, list[float]]]:
    """Learners with the same settings, in order of their first; and the values of what varies, by name."""
    settings = [field.name for field in fields(learners[0]) if field.name != "prior_policy"]  # type: ignore[arg-type]
    told = [{name: repr(plain(name, getattr(one, name))) for name in settings} for one in learners]
    names = [name for name in settings if any(row[name] != told[0][name] for row in told)]
    members: dict[tuple[str, ...], list[int]] = {}
    for r, row in enumerate(told):
        members.setdefault(tuple(row[name] for name in names), []).append(r)
    groups = []
    for rows in members.values():
        first = learners[rows[0]]
        settled = {name: getattr(first, name) for name in names}
        groups.append(Group(settled, np.array(rows), float(first.beta), float(first.optimism)))
    firsts = [rows[0] for rows in members.values()]
    vary = {name: {told[r][name]: getattr(learners[r], name) for r in firsts} for name in names}
    return groups, {name: list(values.values()) for name, values in vary.items()}


def statistics(values: np.ndarray) -> dict[str, float]:
    """mean, quartiles and extremes of [n] finite values."""
    low, middle, high = np.quantile(values, (0.25, 0.5, 0.75))
    return {
        "mean": float(values.mean()),
        "q25": float(low),
        "median": float(middle),
        "q75": float(high),
        "min": float(values.min()),
        "max": float(values.max()),
    }


def worth_of(rows: Sequence[Mapping[str, Any]]) -> dict[int, float]:
    """The mean objective of each group that has one, by its number: that of the real world where optimism is not 0 in
    all, as others are not of one scale."""
    name = "objective_real" if any(row.get("objective_real") for row in rows) else "objective"
    return {g: row[name]["mean"] for g, row in enumerate(rows) if row.get(name)}


class Record:
    """Figures of all replicas, record by record."""

    def __init__(
        self,
        groups: Sequence[Group],
        optima: Sequence[Mapping[str, float]],
        table: Sequence[Quantity] = QUANTITIES,
    ) -> None:
        self.groups, self.optima = groups, optima
        self.names = [quantity.name for quantity in table if quantity.replicas]
        self.prior: dict[str, float] = {}  # by tag
        self.steps: dict[str, list[int]] = {}
        self.rows: dict[str, list[np.ndarray]] = {}
        self.alive: dict[str, list[np.ndarray]] = {}

    def content(self) -> tuple[Any, ...]:
        """What a checkpoint keeps."""
        steps = {name: list(steps) for name, steps in self.steps.items()}  # a copy: it goes on
        return dict(self.prior), steps, *({k: np.stack(v) for k, v in x.items()} for x in (self.rows, self.alive))

    def lengths(self) -> dict[str, int]:
        """Records so far, by quantity."""
        return {name: len(steps) for name, steps in self.steps.items()}

    def cut(self, lengths: Mapping[str, int]) -> None:
        """Back to what it was at ``lengths``."""
        for of_names in (self.steps, self.rows, self.alive):
            for name in list(of_names):
                if name in lengths:
                    del of_names[name][lengths[name] :]
                else:
                    del of_names[name]

    def restore(self, content: tuple[Any, ...]) -> None:
        """Go on from ``content``."""
        self.prior, self.steps = content[:2]
        self.rows, self.alive = ({name: list(column) for name, column in x.items()} for x in content[2:])

    def add(self, step: int, measured: Mapping[str, np.ndarray], board: Board, alive: np.ndarray | None = None) -> None:
        for name in self.names:
            if name not in measured:
                continue
            values = np.asarray(measured[name], dtype=np.float64)
            good = np.isfinite(values) if alive is None else alive & np.isfinite(values)
            self.steps.setdefault(name, []).append(step)
            self.rows.setdefault(name, []).append(values)
            self.alive.setdefault(name, []).append(good)
            for group, known in zip(self.groups[:MOST_LOGGED], self.optima, strict=False):
                inside = values[group.members][good[group.members]]
                if not inside.size:
                    continue
                found, tag = statistics(inside), f"{group.name}/{name}"
                if step == 0:
                    self.prior[tag] = found["mean"]
                lines = {"prior": self.prior.get(tag), "optimal": known.get(name)}
                board.scalars({f"{tag}_{key}": found[key] for key in LOGGED}, step)
                board.scalars({f"{tag}_{key}": value for key, value in lines.items() if value is not None}, step)

    def lose(self, lost: np.ndarray) -> None:
        """Of the last records those of the replicas ``lost`` [R] count no longer."""
        for rows in self.alive.values():
            rows[-1] = rows[-1] & ~lost

    def statistics(self, group: Group) -> dict[str, Any]:
        """Of the last record: statistics by quantity, replicas that count."""
        found: dict[str, Any] = {"replicas": 0}
        for name, rows in self.rows.items():
            inside = rows[-1][group.members][self.alive[name][-1][group.members]]
            found[name] = statistics(inside) if inside.size else None
            found["replicas"] = max(found["replicas"], int(inside.size))
        return found

    def curves(self) -> dict[str, list[pictures.BandLine]]:
        """For ``pictures.bands``: quantity -> one line per group."""
        shown: dict[str, list[pictures.BandLine]] = {}
        for name in [*BANDS, *(name for name in self.names if name not in BY_NAME)]:
            if name not in self.rows or (name == "return" and "reward_per_step" in self.rows):
                continue
            lines = []
            for group, known in zip(self.groups[:MOST_LOGGED], self.optima, strict=False):
                points = [
                    (step, statistics(row[group.members][good[group.members]]))
                    for step, row, good in zip(self.steps[name], self.rows[name], self.alive[name], strict=True)
                    if good[group.members].any()
                ]
                steps, found = zip(*points, strict=True) if points else ((), ())
                lines.append(pictures.BandLine(group.title, steps, found, [known.get(name)] * len(steps)))
            shown[name] = lines
        return shown

    def line(self) -> str:
        """The last record in a line, over all replicas of the first group."""
        shown = []
        for name in PROGRESS:
            found = self.statistics(self.groups[0]).get(name)
            if found:
                shown.append(f"{name} {found['mean']:.5g} [{found['q25']:.5g}, {found['q75']:.5g}]")
        more = f"  (first of {len(self.groups)} groups)" if len(self.groups) > 1 else ""
        return "  ".join(shown) + more

    def arrays(self) -> dict[str, np.ndarray]:
        """``record/NAME`` [n, R] with ``record_step/NAME`` [n]."""
        found = {f"record/{name}": np.stack(rows) for name, rows in self.rows.items()}
        return found | {f"record_step/{name}": np.array(steps) for name, steps in self.steps.items()}

    def final(self) -> dict[str, float]:
        """Means over the replicas of the group with the best objective, by tag."""
        rows = [self.statistics(group) for group in self.groups]
        worth = worth_of(rows)
        if not worth:
            return {}
        best = max(worth, key=worth.__getitem__)
        names = [quantity.name for quantity in QUANTITIES if "Final" in quantity.prefixes]
        final = {name: rows[best][name]["mean"] for name in names if rows[best].get(name)}
        if "objective" in self.optima[best]:
            final["gap"] = self.optima[best]["objective"] - final["objective"]
        return tagged("Final", final)

    def sweep(self) -> tuple[str, dict[str, list[pictures.BandLine]]]:
        """The first setting that varies in numbers, and quantity -> one line per combination of the others.

        ("", {}) where there is none.
        """
        numbers = (k for k in self.groups[0].settings if all(checks.is_number(g.settings[k]) for g in self.groups))
        key = next(numbers, "")
        if not key:
            return "", {}
        panels: dict[str, list[pictures.BandLine]] = {}
        for name in SWEEP:
            points: dict[str, list[tuple[float, dict[str, float], float | None]]] = {}
            pairs = zip(self.groups, self.optima, strict=True)
            for group, optimum in sorted(pairs, key=lambda pair: pair[0].settings[key]):
                row = self.statistics(group).get(name)
                if row is not None:
                    others = ", ".join(f"{k} {setting_text(v)}" for k, v in group.settings.items() if k != key)
                    points.setdefault(others, []).append((group.settings[key], row, optimum.get(name)))
            if points:
                panels[name] = [pictures.BandLine(others, *zip(*row, strict=True)) for others, row in points.items()]
        return key, panels
