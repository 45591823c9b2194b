"""Reservations: texts for ``erl_torch.notes.note`` that say what the data of a run do not allow.

Counts n of draws are held against probabilities p by n KL(counts/n || p), summed over independent rows. For k
categories, any n and any p, E exp(x n KL) <= (1 - x)^-(k - 1), 0 <= x < 1 (Agrawal, "Finite-sample concentration of the
multinomial in relative entropy", IEEE Trans. Inf. Theory 66, 2020). So with d the sum of all k - 1 and D > d the total,

    P(total >= D) <= exp(-(D - d - d log(D/d))):

which is a bound. Pearson's chi-square has the tail of a limit: at ``LEVEL`` it is wrong by decades in cells that
expect few draws. Cells of a row that expect less than one draw are pooled; the bound holds as before.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
import scipy.sparse as sp
from scipy.special import rel_entr

from erl_torch.checks import InputError
from erl_torch.empirical.counts import EmpiricalMDP, Tally, empirical_mdp, tally
from erl_torch.empirical.uncertainty import Estimate
from erl_torch.experience.experience import Experience
from erl_torch.experience.transitions import Transitions
from erl_torch.labels import NUMBERS, Names
from erl_torch.mdp.tabular import TabularMDP
from erl_torch.solution import Status, proven
from erl_torch.solvers.chains import reachable_from

LEVEL = 1e-9  # the chance, at most, of a false reservation
LEAST_EXPECTED = 1.0  # draws, below which cells are pooled
NOTED_NOISE = 1e-4  # of beta^2 Var/2, the share of exp(beta r) that noise in rewards adds
SINGLE_PRECISION = 1e-6  # relative; rewards recorded in single precision are equal within it
RANGE_MARGIN = 1e-3  # of the largest reward; a theta further out of the range of rewards is wrong
CHANCELESS_ERROR = 0.02  # of the range of rewards, between theta and that of data that leave nothing to chance
FAR_HALF_WIDTHS = 10.0  # of the 95% interval, from which on a learnt theta is far from the data's


ADVICE = (
    "more passes or other steps come closer, if the learner solves the same problem (docs/learners.md); "
    "learner=certainty_equivalence does"
)


CONTRADICTED = (
    "the data contradict what is proven, as those of another problem, or of the part of this one that was met, do"
)


class Reservation(NamedTuple):
    """``kind`` is the same in all runs that have the reservation; ``text`` has the figures of one run."""

    kind: str
    text: str


@dataclass(frozen=True, eq=False)
class Counted:
    """The counts of one pass over a stream, and of two more where rewards vary."""

    tally: Tally
    model: EmpiricalMDP | None  # None where the squares of rewards overflow
    next_actions: np.ndarray | None  # counts of (s',a'), [S, A]
    names: Names = NUMBERS  # for texts


class StreamNeeds(Protocol):
    """What a learner declares of the stream that it needs (``erl_torch.learners``)."""

    @property
    def beta(self) -> float: ...

    @property
    def optimism(self) -> float: ...

    @property
    def reward_noise(self) -> str: ...

    @property
    def averages_exp_reward(self) -> bool:
        """Whether noise in r counts as reward."""

    @property
    def assumed_optimism(self) -> float | None:
        """Of a learner that has no choice in it, where that is not 0."""

    @property
    def drawn_from_prior(self) -> str:
        """The column that must be draws from the prior policy: "a", "a_next", or ""."""


class _Passing:
    """A recording whose (s',a') are counted while it is read."""

    def __init__(self, data: Experience, n_states: int, n_actions: int) -> None:
        self.data, self.counts = data, np.zeros((n_states, n_actions), np.int64)

    def __len__(self) -> int:
        return len(self.data)

    def check_range(self, n_states: int, n_actions: int) -> None:
        self.data.check_range(n_states, n_actions)

    def checksum(self) -> int:
        return self.data.checksum()

    def chunks(self, multiple: int = 1) -> Iterator[Transitions]:
        n_actions = np.int32(self.counts.shape[1])
        for chunk in self.data.chunks(multiple):
            pair = chunk.s_next * n_actions + chunk.a_next
            self.counts += np.bincount(pair, minlength=self.counts.size).reshape(self.counts.shape)
            yield chunk


def count(data: Experience, n_states: int, n_actions: int, next_actions: bool, names: Names = NUMBERS) -> Counted:
    """Count ``data``; with ``next_actions`` (s',a') too. Raises InputError as ``tally`` does."""
    passing = _Passing(data, n_states, n_actions) if next_actions else None
    seen = tally(passing or data, n_states, n_actions)
    try:
        model = empirical_mdp(data, n_states, n_actions, seen)
    except InputError:  # of the size of rewards
        model = None
    return Counted(seen, model, passing.counts if passing else None, names)


def of_stream(counted: Counted, learner: StreamNeeds, prior: np.ndarray) -> list[Reservation]:
    """What a stream does not allow ``learner``, by the needs that the learner declares; ``prior`` [S, A]."""
    reservations = of_rewards(*counted.tally.reward_range)
    if learner.averages_exp_reward:
        reservations += of_noise(counted, learner.beta)
    if learner.assumed_optimism is not None:
        reservations += of_optimism(counted, learner.assumed_optimism)
    if learner.reward_noise == "joint" and learner.optimism and counted.tally.varied:
        text = (
            "rewards vary for the same (s,a), and count together with s' (learner.reward_noise=joint): objectives, and "
            "what is proven where a model is known, are of mean rewards"
        )
        reservations.append(Reservation("rewards count together with s'", text))
    if learner.drawn_from_prior == "a":
        reservations += of_actions(counted.tally.visits.reshape(prior.shape), prior, "a")
    elif learner.drawn_from_prior == "a_next":
        assert counted.next_actions is not None
        reservations += of_actions(counted.next_actions, prior, "a'")
    return reservations


def of_rewards(low: float, high: float) -> list[Reservation]:
    """Of a stream whose rewards lie in [low, high]."""
    if low < high:
        return []
    text = f"every reward of the stream is {low:g}: it gives no reason to prefer any action to the prior policy's"
    return [Reservation("rewards are all equal", text)]


def of_noise(counted: Counted, beta: float) -> list[Reservation]:
    """The effect of noise in the rewards on a learner that averages exp(beta r): it sees about r + beta Var/2."""
    model = counted.model
    if not counted.tally.varied or model is None:
        return []
    excess = 0.5 * beta * model.reward_variance
    if not beta * excess.max() > NOTED_NOISE:
        return []
    s, a = np.unravel_index(np.argmax(excess), excess.shape)
    most = counted.tally.reward_range[1] - model.reward[s, a]
    size = f"{excess[s, a]:.2g}"
    if excess[s, a] > most:  # far from the limit of little noise: only the largest reward counts
        size = f"{most:.2g} (its largest reward less its mean), and not beta Var/2 = {size},"
    else:
        size = f"beta Var/2 = {size}"
    return [
        Reservation(
            "rewards vary",
            "rewards vary for the same (s,a), and this learner averages exp(beta r): theta is too low, by about "
            f"{size} at the noisiest pair ({counted.names.pair(int(s), int(a))}), and the policy seeks the noise; "
            "learner=certainty_equivalence takes mean rewards",
        )
    ]


def of_optimism(counted: Counted, optimism: float) -> list[Reservation]:
    """What a learner at an optimism of its own makes of dynamics that are left to chance."""
    seen = counted.tally
    if not (np.diff(seen.indptr) > 1).any():
        return []
    text = (
        f"the dynamics are left to chance, and this learner is optimistic about them: it solves optimism {optimism:g} "
        f"of the dial (as learner=s1 learner.optimism={optimism:g} does), and is held against optimism 0"
    )
    return [Reservation("optimistic about the dynamics", text)]


def of_estimate(estimate: Estimate | None) -> list[Reservation]:
    """That what the data say rests on a handful of tuples."""
    if estimate is None or not estimate.warning:
        return []
    return [Reservation("a handful of tuples", f"what the data say of theta: {estimate.warning}")]


def divergence(counts: np.ndarray, row: np.ndarray, p: np.ndarray, n_rows: int) -> tuple[float, int]:
    """(n KL(counts/n || p) summed over rows, its degrees of freedom), small cells pooled.

    Args:
        counts: draws in each cell, [n]; 0 where p is.
        row: row of each cell, [n], whole numbers below n_rows.
        p: probability of each cell in its row, [n].
    """
    expected = np.bincount(row, counts, n_rows)[row] * p
    small = expected < LEAST_EXPECTED

    def cells(values: np.ndarray) -> np.ndarray:
        return np.concatenate((values[~small], np.bincount(row[small], values[small], n_rows)))

    seen, due = cells(counts), cells(expected)
    number = np.bincount(np.concatenate((row[~small], np.arange(n_rows)))[due > 0], minlength=n_rows)
    return float(rel_entr(seen, due).sum()), int(np.maximum(number - 1, 0).sum())


def unlikely(total: float, freedom: int) -> bool:
    """Whether draws from p reach ``total`` with a chance below ``LEVEL``, by the module's bound."""
    if total == np.inf:  # a draw of what has probability 0
        return True
    if not total > freedom > 0:
        return False
    return bool(total - freedom - freedom * np.log(total / freedom) > -np.log(LEVEL))


def of_actions(counts: np.ndarray, prior: np.ndarray, name: str) -> list[Reservation]:
    """Whether recorded actions can be draws from the prior.

    Args:
        counts: draws of each (state, action), [S, A].
        prior: [S, A], rows sum to 1.
        name: name of the column.
    """
    n_states, n_actions = counts.shape
    total, freedom = divergence(counts.ravel(), np.repeat(np.arange(n_states), n_actions), prior.ravel(), n_states)
    if not unlikely(total, freedom):
        return []
    return [
        Reservation(
            f"{name} are not from the prior",
            f"the recorded {name} are no draws from the prior policy, as this learner needs them (relative entropy "
            f"{total:.4g} nats, {freedom} degrees of freedom): theta and policy are of another problem; "
            "learner=s1_efficient and learner=certainty_equivalence do not need them",
        )
    ]


def of_model(
    counted: Counted, mdp: TabularMDP, estimate: Estimate | None = None, bounds: tuple[float, float] | None = None
) -> list[Reservation]:
    """Whether the data can come from ``mdp``: transitions, mean rewards and, where given, theta and its error.

    Of actions that are not to be taken (prior 0) give ``mdp.restricted``: then they need not be met.
    """
    weighted = counted.model is not None and counted.model.weights is not None  # the tuples are of other dynamics
    contradictions = [] if weighted else [*_transitions(counted.tally, mdp, counted.names)]
    contradictions += _rewards(counted, mdp)
    if estimate is not None and bounds is not None and _covered(counted.tally, mdp):
        contradictions += _theta(estimate, bounds)
    if not contradictions:
        return []
    text = f"the data contradict the model: {'; '.join(contradictions)}. What is proven is of the model alone"
    return [Reservation("data contradict the model", text)]


def _entries(seen: Tally, mdp: TabularMDP) -> tuple[np.ndarray, np.ndarray]:
    """(the model's entry for each (s,a,s') of the stream, whether there is one), [nnz] each."""
    p, n_states = mdp.transition, np.int64(mdp.n_states)
    listed = np.repeat(np.arange(p.shape[0]), np.diff(p.indptr)) * n_states + p.indices
    met = np.repeat(np.arange(p.shape[0]), np.diff(seen.indptr)) * n_states + seen.indices
    at = np.minimum(np.searchsorted(listed, met), len(listed) - 1)
    return at, listed[at] == met


def _transitions(seen: Tally, mdp: TabularMDP, names: Names) -> Iterator[str]:
    p = mdp.transition
    at, possible = _entries(seen, mdp)
    if not possible.all():
        odd = np.flatnonzero(~possible)
        worst = odd[np.argmax(seen.counts[odd])]
        pair = int(np.searchsorted(seen.indptr, worst, side="right")) - 1
        s, a = divmod(pair, mdp.n_actions)
        symbol = "s'"
        yield (
            f"{seen.counts[odd].sum():,} of {seen.counts.sum():,} transitions are impossible in it, as from "
            f"{names.pair(s, a)} to {names.state(int(seen.indices[worst]), symbol)} ({seen.counts[worst]:,} times)"
        )
    counts = np.zeros(p.nnz, np.int64)
    counts[at[possible]] = seen.counts[possible]
    row = np.repeat(np.arange(p.shape[0]), np.diff(p.indptr))
    total, freedom = divergence(counts, row, p.data, p.shape[0])
    if unlikely(total, freedom):
        yield (
            "the other counts" if not possible.all() else "transition counts"
        ) + f" are no draws from its rows (relative entropy {total:.4g} nats, {freedom} degrees of freedom)"


def _rewards(counted: Counted, mdp: TabularMDP) -> Iterator[str]:
    """Mean rewards must be equal where rewards do not vary, else within Chernoff's bound for draws in the range met."""
    seen, model = counted.tally, counted.model
    if model is None:
        return
    visits, mean, exact = model.visits, model.reward, mdp.reward
    off = np.abs(mean - exact)
    rounding = SINGLE_PRECISION * np.maximum(np.abs(exact), np.abs(mean)) + 1e-12 * np.abs(exact).max()
    differs = np.asarray((visits > 0) & (off > rounding))
    if seen.varied and differs.any():
        low = min(seen.reward_range[0], exact[differs].min())
        high = max(seen.reward_range[1], exact[differs].max())
        margin = 0.01 * (high - low)  # the range of all rewards may be a little wider than the range met
        x, y = ((m - low + margin) / (high - low + 2 * margin) for m in (mean, exact.clip(low, high)))
        surprise = visits * (rel_entr(x, y) + rel_entr(1 - x, 1 - y))
        differs = differs & (surprise > np.log(2 * visits.size / LEVEL))
    if differs.any():
        s, a = np.unravel_index(np.argmax(np.where(differs, off, -1.0)), off.shape)
        yield (
            f"mean rewards of {differs.sum()} of {(visits > 0).sum()} pairs are others, as {mean[s, a]:.6g} for "
            f"{exact[s, a]:.6g} at {counted.names.pair(int(s), int(a))}"
        )


def _theta(estimate: Estimate, bounds: tuple[float, float]) -> Iterator[str]:
    """No interval is exact at LEVEL. So the model's theta must also be far in half widths of the 95% interval."""
    if not min(half_widths(bound, estimate) for bound in bounds) > FAR_HALF_WIDTHS:
        return
    low, high = estimate.interval(1 - LEVEL)
    if low > bounds[1] or high < bounds[0]:
        yield (
            f"their theta is {estimate.value:.6g}, standard error {estimate.standard_error:.2g}, "
            f"the model's {proven(bounds, None)}"
        )


def of_states(seen: Tally, mdp: TabularMDP) -> list[Reservation]:
    """Whether ``mdp``, from the states met, reaches states that the stream does not meet."""
    met: np.ndarray = np.asarray(seen.visits.reshape(mdp.n_states, mdp.n_actions).any(1))
    met[seen.indices] = True
    p = mdp.transition
    n_entries = p.indptr[:: mdp.n_actions]  # of the actions of a state together
    reached = reachable_from(sp.csr_array((p.data, p.indices, n_entries), shape=(mdp.n_states,) * 2), met)
    unmet = int((reached & ~met).sum())
    if not unmet:
        return []
    text = (
        f"the stream meets {met.sum():,} of the {reached.sum():,} states that the model can reach: what the data say "
        "of theta, and its interval, is of the part that was met"
    )
    return [Reservation("states never met", text)]


def _covered(seen: Tally, mdp: TabularMDP) -> bool:
    """Whether every action is tried in every state met, and all states that these lead to are met: theta is theirs."""
    tried = seen.visits.reshape(mdp.n_states, mdp.n_actions) > 0
    members: np.ndarray = np.asarray(tried.any(1))
    p = mdp.transition
    entry: np.ndarray = np.repeat(np.repeat(members, mdp.n_actions), np.diff(p.indptr))
    return bool((tried | ~mdp.allowed)[members].all() and members[p.indices[entry]].all())


def lacks_actions(seen: Tally, prior: np.ndarray) -> bool:
    """Whether a state that the stream leaves has an action, of ``prior`` [S, A] above 0, that was never tried there."""
    tried = seen.visits.reshape(prior.shape) > 0
    return bool((~tried & (prior > 0))[tried.any(1)].any())


def of_outcome(status: Status, message: str, learnt: float, prior: float) -> list[Reservation]:
    """What the end of a run shows.

    Args:
        status, message: those of its solution.
        learnt, prior: exact objectives of the two policies; NaN where there are none, as played ones are too noisy.
    """
    reservations = []
    if status not in (Status.COMPLETED, Status.CONVERGED):
        text = f"{status.name.lower()}: {status.value}" + (f" ({message})" if message else "")
        reservations.append(Reservation(status.name, text))
    if learnt < prior - 1e-9 * (1 + abs(prior)):  # beyond rounding
        text = f"the learnt policy is worse than the prior: objective {learnt:.6g}, the prior's {prior:.6g}"
        reservations.append(Reservation("worse than the prior", text))
    return reservations


def of_theta(
    theta: float | None,
    rewards: tuple[float, float],
    estimate: Estimate | None = None,
    bounds: tuple[float, float] | None = None,
    lacking: bool = False,
) -> list[Reservation]:
    """What a learnt theta shows by itself.

    Rewards in [low, high] have theta* in [-high, -low], whatever the dynamics: no policy earns more than high per step,
    the KL cost is not negative, and the prior policy earns at least low, without KL.

    Args:
        theta: learnt; None or NaN where there is none, which shows nothing.
        rewards: (low, high) of the stream.
        estimate: theta of the data; it shows nothing where its interval is withheld.
        bounds: what is proven of theta*, where a model is known: of data that contradict it nothing is advised.
        lacking: ``lacks_actions``, which may be why.
    """
    if theta is None or not np.isfinite(theta):
        return []
    low, high = 0.0 - rewards[1], 0.0 - rewards[0]  # no -0
    outside = max(low - theta, theta - high)
    if outside > RANGE_MARGIN * max(abs(low), abs(high)):
        return [
            Reservation(
                "theta out of range",
                f"the learnt theta {theta:.6g} is wrong: with rewards from {rewards[0]:.6g} to {rewards[1]:.6g}, as in "
                f"the stream, theta* lies in [{low:.6g}, {high:.6g}], whatever the dynamics"
                + "; actions that were never tried cost it, and the data's, their share of the prior"
                * lacking,
            )
        ]
    if estimate is None:
        return []
    away = half_widths(theta, estimate)
    advice = ADVICE
    if contradicted(estimate, bounds):
        assert bounds is not None
        advice = f"{CONTRADICTED} ({proven(bounds, None)}), so that to be closer to them is not to be closer to theta*"
    if estimate.standard_error == 0 and abs(theta - estimate.value) > CHANCELESS_ERROR * max(
        rewards[1] - rewards[0], RANGE_MARGIN * max(abs(low), abs(high))
    ):
        return [
            Reservation(
                "theta far from the data's",
                f"the learnt theta is {theta:.6g}, and that of the data, in which nothing is left to chance, is "
                f"{estimate.value:.6g}: {advice}",
            )
        ]
    if not away > FAR_HALF_WIDTHS:
        return []
    low, high = estimate.interval(1 - LEVEL)
    if low <= theta <= high:
        return []
    return [
        Reservation(
            "theta far from the data's",
            f"the learnt theta {theta:.6g} is {away:.3g} half widths from what the data say, {estimate} (95%): "
            f"{advice}",
        )
    ]


def contradicted(estimate: Estimate | None, bounds: tuple[float, float] | None) -> bool:
    """Whether ``bounds``, proven of theta*, lie outside what the data say, beyond chance: the stream did not meet all
    states, say."""
    if estimate is None or estimate.withheld or bounds is None:
        return False
    low, high = estimate.interval(1 - LEVEL)
    margin = SINGLE_PRECISION * max(abs(low), abs(high))
    return bool(low - margin > bounds[1] or high + margin < bounds[0])


def half_widths(theta: float | None, estimate: Estimate | None) -> float:
    """Distance of theta from the middle of the data's 95% interval, in half widths; NaN where there is none."""
    if theta is None or estimate is None or estimate.withheld:
        return np.nan
    low, high = estimate.interval()
    return abs(theta - 0.5 * (low + high)) / (0.5 * (high - low)) if high > low else np.nan


def of_replicas(by_replica: Sequence[Sequence[Reservation]]) -> list[str]:
    """One line per kind: how many of the replicas have it, and the text of the first of them."""
    texts: dict[str, list[tuple[int, str]]] = {}
    for r, own in enumerate(by_replica):
        for kind, text in own:
            texts.setdefault(kind, []).append((r, text))
    lines = []
    for (r, text), *others in texts.values():
        which = f" (so replica {r})" if any(other != text for _, other in others) else ""
        lines.append(f"{len(others) + 1} of {len(by_replica)} replica{'s' * (len(by_replica) > 1)}: {text}{which}")
    return lines
