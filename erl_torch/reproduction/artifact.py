"""The interface of an artifact of the paper to the runner, and the comparison of its numbers with the paper's."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import scipy.stats
from matplotlib.figure import Figure

REPRODUCED = "reproduced"
NOT_REPRODUCED = "not reproduced"
NOTHING = "no number of the paper"
VERDICTS = (NOTHING, REPRODUCED, NOT_REPRODUCED)
AGREES, DIFFERS = "agrees", "differs"  # verdicts on computed values, which are not the paper's to reproduce
PRINTED = "printed"  # a number in the paper's text or tables
PICTURE = "picture"  # read off a figure of the paper
STATED = "stated"  # in the paper's words
ORACLE = "computed"  # not the paper's: computed independently of this package
# source: the column of its values, in print and in JSON
COLUMNS = {PRINTED: "printed", STATED: "printed", PICTURE: "read off", ORACLE: "computed"}
LEVEL = 0.95  # chance that all lines of one artifact and column are reproduced, where both samples are of one law

Units = dict[str, dict[str, Any]]  # name of a unit -> keyword arguments of ``work``, as JSON takes them
Results = dict[str, dict[str, np.ndarray]]  # name of a unit -> what ``work`` returned, as arrays


class Comparison(NamedTuple):
    """One number of others beside ours."""

    quantity: str
    reference: Any  # number, text, or list of numbers
    ours: Any
    verdict: str  # ``judged``
    source: str = PRINTED  # of ``reference``, a key of COLUMNS
    within: float | None = None  # the largest difference that counts as none
    note: str = ""

    def row(self) -> dict[str, Any]:
        """As JSON takes it: ``reference`` in the column of its source, None in the other columns."""
        columns = dict.fromkeys(COLUMNS.values()) | {COLUMNS[self.source]: self.reference}
        rest = {name: value for name, value in self._asdict().items() if name not in ("quantity", "reference")}
        return {"quantity": self.quantity, **columns, **rest}


@dataclass(frozen=True)
class Output:
    """The result of ``assemble``; the same results of units give the same Output.

    Args:
        rows: lines of the CSV file, all with the keys of the first, in its order.
        comparisons: every number of the paper, and every one computed independently, beside ours.
        figure: the picture; its title or caption names the settings.
        reading: the reading taken where the sources disagree, one sentence per question.
        data: more for the JSON file, as JSON takes it (no NaN).
    """

    rows: Sequence[Mapping[str, Any]]
    comparisons: Sequence[Comparison]
    figure: Figure
    reading: Sequence[str] = ()
    data: Mapping[str, Any] = field(default_factory=dict)

    @property
    def verdict(self) -> str:
        """The weakest of the comparisons with the paper; independent computations do not count."""
        return max((c.verdict for c in self.comparisons if c.source != ORACLE), key=VERDICTS.index, default=NOTHING)


@dataclass(frozen=True)
class Artifact:
    """One figure or table.

    Args:
        name: also the name of its module and files.
        title: one line.
        units: (scale, seed) -> its units of work. Their keyword arguments hold everything that the result depends on;
            a unit of another scale with the same name and arguments has the same result. List the longest first: they
            share the cores best then.
        work: a function of a module (other processes load it by name) that turns the keyword arguments of a unit into
            named arrays or numbers. It is pure: it uses no files but the caches of the library, no clock, and nothing
            of the process or thread that it runs in.
        assemble: (results of all units, scale) -> Output; quick, as it runs again at every call.
        version: raise it whenever ``work`` makes other numbers from the same arguments.
        units_of: the artifact whose units these are, where two artifacts share them; None is this one.
    """

    name: str
    title: str
    units: Callable[[str, int], Units]
    work: Callable[..., Mapping[str, Any]]
    assemble: Callable[[Results, str], Output]
    version: int = 1
    units_of: str | None = None


def judged(holds: bool, source: str) -> str:
    """The verdict of a comparison with a value of that source."""
    words = (DIFFERS, AGREES) if source == ORACLE else (NOT_REPRODUCED, REPRODUCED)
    return words[holds]


def compared(
    quantity: str, reference: float, ours: float, within: float, source: str = PRINTED, note: str = ""
) -> Comparison:
    """A comparison that holds if ``ours`` is within ``within`` of ``reference``.

    For numbers without chance ``within`` is half a unit of the last digit given, or the error of reading.
    """
    verdict = judged(bool(abs(ours - reference) <= within), source)
    return Comparison(quantity, reference, float(ours), verdict, source, float(within), note)


def alone(lines: int) -> float:
    """The chance of failing that each of ``lines`` independent lines may have, if all are to hold with LEVEL."""
    return 1 - float(LEVEL ** (1 / lines))


def compared_means(
    quantity: str,
    reference: float,
    ours: float,
    error: float,
    reference_error: float,
    last_digit: float,
    lines: int,
    freedom: float = np.inf,
    source: str = PRINTED,
    note: str = "",
) -> Comparison:
    """A comparison of means that holds if they differ by no more than LEVEL allows for the error of the difference.

    Args:
        quantity, reference, source, note: as in ``Comparison``.
        ours: our mean.
        error, reference_error: standard errors of both.
        last_digit: half a unit of the last digit given, or the error of reading; taken as uniform.
        lines: number of values of this artifact and column that are subject to chance; the level of all together is
            at least LEVEL (Sidak).
        freedom: degrees of freedom of the standard errors (Student's t).
    """
    of_difference = float(np.sqrt(error**2 + reference_error**2 + last_digit**2 / 3))
    quantile = float(scipy.stats.t.isf(alone(lines) / 2, freedom))
    ratio = abs(ours - reference) / of_difference if of_difference else np.inf
    apart = f"{ratio:.1f} standard errors of {of_difference:.2g} apart"
    return compared(quantity, reference, ours, quantile * of_difference, source, f"{apart}; {note}" if note else apart)


def compared_samples(
    quantity: str, reference: float, ours: np.ndarray, n_reference: int, last_digit: float, lines: int,
    source: str = PRINTED, note: str = "",
) -> Comparison:  # fmt: skip
    """As ``compared_means``: a mean of ``n_reference`` draws (1: a single draw) against our draws [n].

    The standard deviation of ours stands for both.
    """
    deviation = ours.std(ddof=1)
    samples = f"ours of {len(ours)} in [{ours.min():.4g}, {ours.max():.4g}], the other taken as of {n_reference}"
    return compared_means(
        quantity, reference, ours.mean(), deviation / np.sqrt(len(ours)), deviation / np.sqrt(n_reference), last_digit,
        lines, len(ours) - 1, source, f"{samples}; {note}" if note else samples,
    )  # fmt: skip
