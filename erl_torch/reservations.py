"""What a run cannot do, or has not done: data in, one line a reservation out.

The lines are for ``erl_torch.notes.note``.
"""

from __future__ import annotations

import numpy as np
from scipy.stats import chi2

from erl_torch.empirical import Tally
from erl_torch.solution import Status

LEVEL = 1e-6  # at which a' are said to be no draws from the prior
FAR = 5.0  # standard errors from the proven interval, at which data are said to contradict the model


def of_rewards(found: Tally, averages_exp: bool) -> list[str]:
    """What the rewards of a stream allow; ``averages_exp``: the learner averages exp(beta r)."""
    low, high = found.reward_range
    if low == high:
        return [f"every reward is {low:g}: there is nothing to learn, and the prior policy is optimal"]
    if averages_exp and found.varied:
        return [
            "rewards vary for the same (s,a): Algorithm S1 averages exp(beta r), so its theta and policy are "
            "optimistic about that noise; learner=certainty_equivalence takes the mean reward"
        ]
    return []


def of_next_actions(counts: np.ndarray, prior: np.ndarray) -> list[str]:
    """Whether the recorded a' can be draws from the prior, by Pearson's chi-square test at ``LEVEL``.

    Args:
        counts: [S, A], of (s', a').
        prior: [S, A], rows sum to 1. States where an action is expected less than five times are left out.
    """
    expected = counts.sum(1, keepdims=True) * prior
    enough = expected.min(1) >= 5
    freedom = int(enough.sum()) * (counts.shape[1] - 1)
    if not freedom:
        return []
    statistic = float(((counts - expected)[enough] ** 2 / expected[enough]).sum())
    if chi2.sf(statistic, freedom) >= LEVEL:
        return []
    return [
        f"the recorded a' are no draws from the prior (chi-square {statistic:.4g}, {freedom} degrees of freedom): "
        "theta and policy are of another problem"
    ]


def of_model(value: float, standard_error: float, bounds: tuple[float, float]) -> list[str]:
    """Whether the data's theta is ``FAR`` standard errors outside what is proven of the model."""
    off = max(bounds[0] - value, value - bounds[1])
    if not off > FAR * standard_error:
        return []
    return [
        f"the data contradict the model: their theta is {value:.6g}, standard error {standard_error:.2g}, "
        f"and the model's is in [{bounds[0]:.10g}, {bounds[1]:.10g}]"
    ]


def of_outcome(status: Status, learnt: float, prior: float) -> list[str]:
    """What the end of a run says; ``learnt`` and ``prior`` are the objectives of the two policies."""
    lines = [] if status in (Status.COMPLETED, Status.CONVERGED) else [f"the run ended early: {status.value}"]
    if learnt < prior - 1e-9 * (1 + abs(prior)):  # beyond rounding
        lines.append(f"the learnt policy is worse than the prior: objective {learnt:.6g}, the prior's {prior:.6g}")
    return lines
