"""What an artifact of the paper is to the runner, and how its numbers are held against the published ones."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import scipy.stats
from matplotlib.figure import Figure

REPRODUCED = "reproduced"
IN_DISTRIBUTION = "reproduced in distribution"
NOT_REPRODUCED = "not reproduced"
VERDICTS = (REPRODUCED, IN_DISTRIBUTION, NOT_REPRODUCED)
PAPER = "paper"
ORACLE = "oracle"  # computed independently of this package, to high precision

Units = dict[str, dict[str, Any]]  # name of a unit -> keyword arguments of ``work``, as JSON takes them
Results = dict[str, dict[str, np.ndarray]]  # name of a unit -> what ``work`` returned, as arrays


class Comparison(NamedTuple):
    """One number of the paper beside ours."""

    quantity: str
    published: Any  # number, text, or list of numbers
    ours: Any
    verdict: str  # one of VERDICTS
    source: str = PAPER  # of ``published``
    note: str = ""


@dataclass(frozen=True)
class Output:
    """What ``assemble`` makes of the results: the same results give the same Output.

    Args:
        rows: lines of the CSV file, all with the keys of the first, in its order.
        comparisons: every published number beside ours.
        figure: the picture; its title or caption names the settings.
        reading: which reading is taken where the sources disagree, a sentence each.
        data: more that the JSON file should hold, as JSON takes it (no NaN).
    """

    rows: Sequence[Mapping[str, Any]]
    comparisons: Sequence[Comparison]
    figure: Figure
    reading: Sequence[str] = ()
    data: Mapping[str, Any] = field(default_factory=dict)

    @property
    def verdict(self) -> str:
        """The weakest of the comparisons'."""
        return max((c.verdict for c in self.comparisons), key=VERDICTS.index, default=REPRODUCED)


@dataclass(frozen=True)
class Artifact:
    """One figure or table.

    Args:
        name: also the name of its module and files.
        title: one line.
        units: (scale, seed) -> its units of work. Their keyword arguments hold everything that the result depends on;
            a unit of another scale with the same name and arguments has the same result. Longest first: they share
            the cores best then.
        work: a function of a module (it is sent to other processes by name) that turns the keyword arguments of a unit
            into named arrays or numbers. Pure: no files but the caches of the library, no clock, nothing of the
            process or thread it runs in.
        assemble: (results of all units, scale) -> Output; quick, as it runs again at every call.
        version: goes up whenever ``work`` makes other numbers of the same arguments.
        units_of: the artifact that these units belong to, where two draw on the same ones; None is its own.
    """

    name: str
    title: str
    units: Callable[[str, int], Units]
    work: Callable[..., Mapping[str, Any]]
    assemble: Callable[[Results, str], Output]
    version: int = 1
    units_of: str | None = None


def compared(
    quantity: str, published: float, ours: float, within: float, source: str = PAPER, note: str = ""
) -> Comparison:
    """Reproduced if ``ours`` is within ``within`` of ``published``."""
    verdict = REPRODUCED if abs(ours - published) <= within else NOT_REPRODUCED
    return Comparison(quantity, published, float(ours), verdict, source, note)


def compared_in_distribution(
    quantity: str, published: float, ours: np.ndarray, source: str = PAPER, in_logs: bool = False
) -> Comparison:
    """Reproduced in distribution if ``published`` lies where one more of our replicas [n] would, with 95 %.

    Student's prediction interval, of the logarithms if ``in_logs``.
    """
    values = np.log(ours) if in_logs else ours
    half = scipy.stats.t.ppf(0.975, len(ours) - 1) * values.std(ddof=1) * np.sqrt(1 + 1 / len(ours))
    low, high = values.mean() - half, values.mean() + half
    inside = low <= (np.log(published) if in_logs else published) <= high
    if in_logs:
        low, high = np.exp(low), np.exp(high)
    note = f"{len(ours)} replicas in [{ours.min():.4g}, {ours.max():.4g}]; 95 % of more: [{low:.4g}, {high:.4g}]"
    return Comparison(
        quantity, published, float(ours.mean()), IN_DISTRIBUTION if inside else NOT_REPRODUCED, source, note
    )
