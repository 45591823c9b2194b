"""What a run cannot do, or has not done: data in, reservations out. Their texts are for ``erl_torch.notes.note``.

Counts n of draws are held against probabilities p by n KL(counts/n || p), summed over independent rows. For k
categories, any n and any p, E exp(x n KL) <= (1 - x)^-(k - 1), 0 <= x < 1 (Agrawal, "Finite-sample concentration of the
multinomial in relative entropy", IEEE Trans. Inf. Theory 66, 2020). So with d the sum of all k - 1 and D > d the total,

    P(total >= D) <= exp(-(D - d - d log(D/d))):

a bound where Pearson's chi-square, whose tail is that of a limit, is wrong by decades at ``LEVEL`` in cells that expect
few draws. Cells of a row that expect less than one draw are pooled, which leaves the bound as it is.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp
from scipy.special import rel_entr

from erl_torch.checks import InputError
from erl_torch.empirical.counts import EmpiricalMDP, Tally, empirical_mdp, tally
from erl_torch.empirical.uncertainty import Estimate
from erl_torch.experience.experience import Experience
from erl_torch.experience.transitions import Transitions
from erl_torch.mdp.tabular import TabularMDP
from erl_torch.solution import Status, proven
from erl_torch.solvers.chains import reachable_from

LEVEL = 1e-9  # chance, at most, that data as they should be are spoken of
EXPECTED = 1.0  # draws, below which cells are pooled
MATTERS = 1e-4  # beta^2 Var/2: share of exp(beta r) that noise in rewards adds
SINGLE = 1e-6  # relative: rewards recorded in single precision are the same
BEYOND = 1e-3  # of the largest reward: theta out of the range of rewards by more is wrong
NO_CHANCE = 0.02  # of the range of rewards: so far theta may be from that of data without any chance
FAR = 10.0  # half widths of the 95% interval, from which a learnt theta is far from the data's


CLOSER = (
    "more passes or other steps come closer, if the learner solves the same problem (docs/learners.md); "
    "learner=certainty_equivalence does"
)


class Reservation(NamedTuple):
    """``kind`` is the same for all runs that have it; ``text`` has the figures of one."""

    kind: str
    text: str


@dataclass(frozen=True, eq=False)
class Counted:
    """What a stream tells in one pass, and two more where rewards vary."""

    tally: Tally
    model: EmpiricalMDP | None  # None where the squares of rewards overflow
    next_actions: np.ndarray | None  # counts of (s',a'), [S, A]


class _Passing:
    """A recording whose (s',a') are counted as it is read."""

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


def count(data: Experience, n_states: int, n_actions: int, next_actions: bool) -> Counted:
    """Read ``data``; ``next_actions``: a' counts as well. Raises InputError as ``tally`` does."""
    passing = _Passing(data, n_states, n_actions) if next_actions else None
    found = tally(passing or data, n_states, n_actions)
    try:
        model = empirical_mdp(data, n_states, n_actions, found)
    except InputError:  # of the size of rewards
        model = None
    return Counted(found, model, passing.counts if passing else None)


def of_stream(counted: Counted, learner: Any, prior: np.ndarray) -> list[Reservation]:
    """What a stream does not allow ``learner``, by what it declares (``erl_torch.learners``); ``prior`` [S, A]."""
    found = of_rewards(*counted.tally.reward_range)
    if learner.averages_exp_reward:
        found += of_noise(counted, learner.beta)
    if learner.drawn_from_prior == "a":
        found += of_actions(counted.tally.visits.reshape(prior.shape), prior, "a")
    elif learner.drawn_from_prior == "a_next":
        assert counted.next_actions is not None
        found += of_actions(counted.next_actions, prior, "a'")
    return found


def of_rewards(low: float, high: float) -> list[Reservation]:
    """Of a stream whose rewards lie in [low, high]."""
    if low < high:
        return []
    text = f"every reward of the stream is {low:g}: it gives no reason to prefer any action to the prior policy's"
    return [Reservation("rewards are all equal", text)]


def of_noise(counted: Counted, beta: float) -> list[Reservation]:
    """What noise in the rewards does to a learner that averages exp(beta r): it sees about r + beta Var/2."""
    model = counted.model
    if not counted.tally.varied or model is None:
        return []
    excess = 0.5 * beta * model.reward_variance
    if not beta * excess.max() > MATTERS:
        return []
    s, a = np.unravel_index(np.argmax(excess), excess.shape)
    most = counted.tally.reward_range[1] - model.reward[s, a]
    size = f"{excess[s, a]:.2g}"
    if excess[s, a] > most:  # far from the limit of little noise, where the largest reward is all that counts
        size = f"{most:.2g} (its largest reward less its mean), and not beta Var/2 = {size},"
    else:
        size = f"beta Var/2 = {size}"
    return [
        Reservation(
            "rewards vary",
            "rewards vary for the same (s,a), and this learner averages exp(beta r): theta is too low, by about "
            f"{size} at the noisiest pair (s={s}, a={a}), and the policy seeks the noise; "
            "learner=certainty_equivalence takes mean rewards",
        )
    ]


def divergence(counts: np.ndarray, row: np.ndarray, p: np.ndarray, n_rows: int) -> tuple[float, int]:
    """(n KL(counts/n || p) summed over rows, its degrees of freedom), small cells pooled.

    Args:
        counts: draws in each cell, [n]; 0 where p is.
        row: of each cell, [n], whole numbers below n_rows.
        p: probability of each cell in its row, [n].
    """
    expected = np.bincount(row, counts, n_rows)[row] * p
    small = expected < EXPECTED

    def cells(values: np.ndarray) -> np.ndarray:
        return np.concatenate((values[~small], np.bincount(row[small], values[small], n_rows)))

    seen, due = cells(counts), cells(expected)
    number = np.bincount(np.concatenate((row[~small], np.arange(n_rows)))[due > 0], minlength=n_rows)
    return float(rel_entr(seen, due).sum()), int(np.maximum(number - 1, 0).sum())


def unlikely(total: float, freedom: int) -> bool:
    """Whether draws from p reach ``total`` with a chance below ``LEVEL``, by the bound above."""
    if not total > freedom > 0:
        return False
    return bool(total - freedom - freedom * np.log(total / freedom) > -np.log(LEVEL))


def of_actions(counts: np.ndarray, prior: np.ndarray, name: str) -> list[Reservation]:
    """Whether recorded actions can be draws from the prior.

    Args:
        counts: of (state, action), [S, A].
        prior: [S, A], rows sum to 1.
        name: of the column.
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
    """Whether the data can come from ``mdp``: transitions, mean rewards and, where given, theta with its error."""
    said = [*_transitions(counted.tally, mdp), *_rewards(counted, mdp)]
    if estimate is not None and bounds is not None and _covered(counted.tally, mdp):
        said += _theta(estimate, bounds)
    if not said:
        return []
    text = f"the data contradict the model: {'; '.join(said)}. What is proven is of the model alone"
    return [Reservation("data contradict the model", text)]


def _entries(found: Tally, mdp: TabularMDP) -> tuple[np.ndarray, np.ndarray]:
    """(the model's entry that each (s,a,s') of the stream is, whether there is one), [nnz] each."""
    p, n_states = mdp.transition, np.int64(mdp.n_states)
    known = np.repeat(np.arange(p.shape[0]), np.diff(p.indptr)) * n_states + p.indices
    met = np.repeat(np.arange(p.shape[0]), np.diff(found.indptr)) * n_states + found.indices
    at = np.minimum(np.searchsorted(known, met), len(known) - 1)
    return at, known[at] == met


def _transitions(found: Tally, mdp: TabularMDP) -> Iterator[str]:
    p = mdp.transition
    at, possible = _entries(found, mdp)
    if not possible.all():
        odd = np.flatnonzero(~possible)
        worst = odd[np.argmax(found.counts[odd])]
        pair = int(np.searchsorted(found.indptr, worst, side="right")) - 1
        s, a = divmod(pair, mdp.n_actions)
        yield (
            f"{found.counts[odd].sum():,} of {found.counts.sum():,} transitions are impossible in it, as from s={s}, "
            f"a={a} to s'={found.indices[worst]} ({found.counts[worst]:,} times)"
        )
    counts = np.zeros(p.nnz, np.int64)
    counts[at[possible]] = found.counts[possible]
    row = np.repeat(np.arange(p.shape[0]), np.diff(p.indptr))
    total, freedom = divergence(counts, row, p.data, p.shape[0])
    if unlikely(total, freedom):
        yield (
            "the other counts" if not possible.all() else "transition counts"
        ) + f" are no draws from its rows (relative entropy {total:.4g} nats, {freedom} degrees of freedom)"


def _rewards(counted: Counted, mdp: TabularMDP) -> Iterator[str]:
    """Mean rewards: the same where rewards do not vary; else within Chernoff's bound for draws in the range met."""
    found, model = counted.tally, counted.model
    if model is None:
        return
    visits, mean, known = model.visits, model.reward, mdp.reward
    off = np.abs(mean - known)
    rounding = SINGLE * np.maximum(np.abs(known), np.abs(mean)) + 1e-12 * np.abs(known).max()
    differs = np.asarray((visits > 0) & (off > rounding))
    if found.varied and differs.any():
        low = min(found.reward_range[0], known[differs].min())
        high = max(found.reward_range[1], known[differs].max())
        margin = 0.01 * (high - low)  # the range met is not quite the range there is
        x, y = ((m - low + margin) / (high - low + 2 * margin) for m in (mean, known.clip(low, high)))
        surprise = visits * (rel_entr(x, y) + rel_entr(1 - x, 1 - y))
        differs = differs & (surprise > np.log(2 * visits.size / LEVEL))
    if differs.any():
        s, a = np.unravel_index(np.argmax(np.where(differs, off, -1.0)), off.shape)
        yield (
            f"mean rewards of {differs.sum()} of {(visits > 0).sum()} pairs are others, as {mean[s, a]:.6g} for "
            f"{known[s, a]:.6g} at s={s}, a={a}"
        )


def _theta(estimate: Estimate, bounds: tuple[float, float]) -> Iterator[str]:
    """Out at LEVEL no interval is exact: the model's theta has to be far in units of the usual one too."""
    if not min(half_widths(bound, estimate) for bound in bounds) > FAR:
        return
    low, high = estimate.interval(1 - LEVEL)
    if low > bounds[1] or high < bounds[0]:
        yield (
            f"their theta is {estimate.value:.6g}, standard error {estimate.standard_error:.2g}, "
            f"the model's {proven(bounds, None)}"
        )


def of_states(found: Tally, mdp: TabularMDP) -> list[Reservation]:
    """Whether ``mdp`` reaches states from those met that the stream does not meet."""
    met: np.ndarray = np.asarray(found.visits.reshape(mdp.n_states, mdp.n_actions).any(1))
    met[found.indices] = True
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


def _covered(found: Tally, mdp: TabularMDP) -> bool:
    """Whether every action is tried in every state met, and no state that these lead to is missing: theta is theirs."""
    tried = found.visits.reshape(mdp.n_states, mdp.n_actions) > 0
    inside: np.ndarray = np.asarray(tried.any(1))
    p = mdp.transition
    entry: np.ndarray = np.repeat(np.repeat(inside, mdp.n_actions), np.diff(p.indptr))
    return bool(tried[inside].all() and inside[p.indices[entry]].all())


def of_outcome(status: Status, message: str, learnt: float, prior: float) -> list[Reservation]:
    """What the end of a run says.

    Args:
        status, message: of its solution.
        learnt, prior: exact objectives of the two policies. Played ones are too noisy: give NaN, which says nothing.
    """
    found = []
    if status not in (Status.COMPLETED, Status.CONVERGED):
        text = f"{status.name.lower()}: {status.value}" + (f" ({message})" if message else "")
        found.append(Reservation(status.name, text))
    if learnt < prior - 1e-9 * (1 + abs(prior)):  # beyond rounding
        text = f"the learnt policy is worse than the prior: objective {learnt:.6g}, the prior's {prior:.6g}"
        found.append(Reservation("worse than the prior", text))
    return found


def of_theta(theta: float | None, rewards: tuple[float, float], estimate: Estimate | None = None) -> list[Reservation]:
    """What theta itself shows.

    Rewards in [low, high] have theta* in [-high, -low], whatever the dynamics: no policy earns more than high a step,
    KL costs no less than nothing, and the prior's earns low at least, without KL.

    Args:
        theta: learnt; None or NaN, where there is none, says nothing.
        rewards: (low, high) of the stream.
        estimate: theta as the data have it; says nothing where its interval is withheld.
    """
    if theta is None or not np.isfinite(theta):
        return []
    low, high = 0.0 - rewards[1], 0.0 - rewards[0]  # no -0
    outside = max(low - theta, theta - high)
    if outside > BEYOND * max(abs(low), abs(high)):
        return [
            Reservation(
                "theta out of range",
                f"the learnt theta {theta:.6g} is wrong: with rewards from {rewards[0]:.6g} to {rewards[1]:.6g}, as in "
                f"the stream, theta* lies in [{low:.6g}, {high:.6g}], whatever the dynamics",
            )
        ]
    if estimate is None:
        return []
    away = half_widths(theta, estimate)
    if estimate.standard_error == 0 and abs(theta - estimate.value) > NO_CHANCE * (rewards[1] - rewards[0]):
        return [
            Reservation(
                "theta far from the data's",
                f"the learnt theta is {theta:.6g}, and that of the data, in which nothing is left to chance, is "
                f"{estimate.value:.6g}: {CLOSER}",
            )
        ]
    if not away > FAR:
        return []
    low, high = estimate.interval(1 - LEVEL)
    if low <= theta <= high:
        return []
    return [
        Reservation(
            "theta far from the data's",
            f"the learnt theta {theta:.6g} is {away:.3g} half widths from what the data say, {estimate} (95%): "
            f"{CLOSER}",
        )
    ]


def half_widths(theta: float | None, estimate: Estimate | None) -> float:
    """Distance of theta from the middle of the data's 95% interval, in half widths; NaN where there is none."""
    if theta is None or estimate is None or estimate.withheld:
        return np.nan
    low, high = estimate.interval()
    return abs(theta - 0.5 * (low + high)) / (0.5 * (high - low)) if high > low else np.nan


def of_replicas(found: Sequence[Sequence[Reservation]]) -> list[str]:
    """A line a kind, with how many of the replicas have it and the text of the first that has."""
    texts: dict[str, list[tuple[int, str]]] = {}
    for r, own in enumerate(found):
        for kind, text in own:
            texts.setdefault(kind, []).append((r, text))
    lines = []
    for (r, text), *others in texts.values():
        which = f" (so replica {r})" if any(other != text for _, other in others) else ""
        lines.append(f"{len(others) + 1} of {len(found)} replica{'s' * (len(found) > 1)}: {text}{which}")
    return lines
