"""Did theta converge? The answer in words, for tab Text: what is proven, what the data say, whether it still moves."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from erl_torch.empirical.reservations import CONTRADICTED, contradicted, half_widths
from erl_torch.empirical.uncertainty import Estimate
from erl_torch.solution import Solution, Status, proven

QUESTION = "Did theta converge?\n\n"
LAST = 0.1  # of the epochs: over these theta must have settled
SMALL_MOVE = 1e-3  # of |theta|, where no interval says what is small
UNANSWERED = (Status.STOPPED, Status.NON_FINITE)


def verdict(thetas: Sequence[float], solution: Solution, estimate: Estimate | None) -> str:
    """Markdown: an answer, then a table of what it rests on.

    Args:
        thetas: theta after each epoch, or each iteration of an exact solver.
        solution: at the end, with its proven bounds where the model is known.
        estimate: theta* as the stream's counts alone have it.

    "Settled" is: over the last tenth of the epochs theta moved by less than half the data's 95% interval, or without
    one by less than 0.1% of itself. Of a learner that goes through its tuples once nothing can be said to move.
    """
    theta, bounds = solution.theta, solution.theta_bounds
    if theta is None or not np.isfinite(theta):
        return f"{QUESTION}**No.** The learner has no finite theta ({solution.status.name.lower()}).\n"
    away = half_widths(theta, estimate)
    known = estimate is not None and np.isfinite(away)
    half = None
    if known:
        assert estimate is not None
        low, high = estimate.interval()
        half = 0.5 * (high - low)
    moved, n = _moved(thetas)
    small = SMALL_MOVE * abs(theta) if half is None else half
    settled = moved is None or moved <= small
    rows = [("proven", _of_bounds(theta, bounds))]
    rows.append(("the data", f"{estimate}; learnt: {away:.2f} half widths from its middle" if known else "no interval"))
    if moved is None:
        rows.append(("still moving", "cannot be seen: theta is there once"))
    else:
        rows.append(
            ("still moving", f"{'no' if settled else 'yes'}: by {moved:.2g} over the last {n} of {len(thetas)}")
        )
    table = "".join(f"| {name} | {text} |\n" for name, text in rows)
    opposed = contradicted(estimate, bounds)
    answer = _answer(solution, settled, away if known else None, opposed)
    return f"{QUESTION}**{answer}**\n\ntheta = {theta:z.6g}\n\n| | |\n|---|---|\n{table}"


def verdict_of_replicas(away: Sequence[float]) -> str:
    """Markdown, from the distance of each replica's theta to the middle of its own stream's 95% interval.

    Args:
        away: half widths; NaN where a stream has no interval.
    """
    known = [x for x in away if np.isfinite(x)]
    if not known:
        return f"{QUESTION}**Not answered.** No stream has an interval that theta is held against.\n"
    inside = sum(x <= 1 for x in known)
    return (
        f"{QUESTION}**Theta of {inside} of {len(known)} replicas is inside the 95% interval of its own stream.**\n\n"
        f"Median distance from its middle: {np.median(known):.3g} half widths; at most {max(known):.3g}. "
        f"{len(away) - len(known)} of {len(away)} replicas have no such interval.\n"
    )


def _answer(solution: Solution, settled: bool, away: float | None, opposed: bool) -> str:
    if solution.status in UNANSWERED:
        return f"Not answered: the run ended before it was through ({solution.status.name.lower()})."
    assert solution.theta is not None
    low, high = solution.theta_bounds or (-np.inf, np.inf)
    if low <= solution.theta <= high and high - low <= SMALL_MOVE * abs(solution.theta):
        return "Yes: theta is inside its proven bounds."
    if not settled:
        constant = " Constant steps do so however long they run." if solution.status is Status.COMPLETED else ""
        return f"Not settled: theta still moves.{constant}"
    if away is None:
        return "It has settled. Whether at theta*, no data tell."
    if opposed:
        return f"It has settled, but not at theta*: {CONTRADICTED}."
    if away <= 1:
        return "Yes, as far as the data can tell: it has settled inside their 95% interval."
    return "It has settled, but outside the data's 95% interval: the learner has an error of its own."


def _moved(thetas: Sequence[float]) -> tuple[float | None, int]:
    """The range of theta over the last epochs, and how many these are; None of fewer than two."""
    last = np.asarray(thetas[-max(2, int(np.ceil(LAST * len(thetas)))) :], dtype=np.float64)
    last = last[np.isfinite(last)]
    return (float(np.ptp(last)), len(last)) if len(last) > 1 else (None, len(last))


def _of_bounds(theta: float, bounds: tuple[float, float] | None) -> str:
    if bounds is None:
        return "nothing: there is no known model"
    low, high = bounds
    text = proven(bounds, None)
    if low <= theta <= high:
        return f"{text}; learnt: inside"
    side, distance = ("above", theta - high) if theta > high else ("below", low - theta)
    return f"{text}; learnt: {distance:.2g} {side}"
