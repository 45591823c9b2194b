"""Other dynamics from the same tuples: weights, or the target itself.

What the tuples of dynamics p say of dynamics p^ depends on what is known of p^:

    the ratio p^/p    ``reweighted``: each tuple gets the weight p^(s'|s,a) / p(s'|s,a), and counts for that much
                      (``erl_torch.empirical.counts``). p itself need not be known: one motor breaks, a lottery pays
                      half as often. p^ must lead nowhere that p does not; no weight shows what was never seen.
                      A factor of each pair cancels; but the ratio itself has mean 1 under p, so that a mean far below
                      tells of successors that were never seen.
    p^                ``for_dynamics``: no weights. The tuples serve for the rewards alone, and no noise of their
                      successors enters.

A reward of (s,a) is the same under both dynamics. One of (s,a,s') is not: its mean changes with p^. Weights see to
that; with p^ given, ``rewards="successor"`` does, where each successor was seen.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import overload

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike

from erl_torch import checks
from erl_torch.checks import InputError
from erl_torch.empirical.counts import EmpiricalMDP, empirical_mdp, entries_of
from erl_torch.empirical.uncertainty import LEAST_MEAN_WEIGHT
from erl_torch.experience.experience import EXPERIENCE, Experience, check_unweighted, permitted, weighing
from erl_torch.experience.transitions import Checksum, Transitions
from erl_torch.mdp.tabular import TabularMDP, check_prior
from erl_torch.notes import note
from erl_torch.solvers.chains import reachable_from

REWARDS = ("pair", "successor")  # what a reward depends on
NAMED = 5  # pairs in a message

LARGEST_RATIO = 1e100
Ratio = Callable[[np.ndarray, np.ndarray, np.ndarray], ArrayLike]


@overload
def reweighted(experience: Transitions, ratio: Ratio) -> Transitions: ...


@overload
def reweighted(experience: Experience, ratio: Ratio) -> Experience: ...


def reweighted(experience: Experience, ratio: Ratio) -> Experience:
    """The same tuples, each with the weight of other dynamics.

    Args:
        experience: the tuples. Weights that they have are multiplied.
        ratio: of arrays s, a, s' [n], p^(s'|s,a) / p(s'|s,a) [n]: 0, or from 1e-100 to 1e100.

    Notes:
        Pairs whose mean ratio is below .5 are told (``erl_torch.notes``): most of the successors that p^ leads to were
        never seen there.

    Returns:
        ``Transitions`` of ``Transitions``; of a recording, what makes the weights in every pass.

    Raises:
        InputError: a weight that is not as above, named by its tuple; a pair all of whose tuples have weight 0, named.
    """
    checks.instance("experience", experience, Experience, EXPERIENCE)
    if not callable(ratio):
        raise InputError("ratio", ratio, "a function of arrays s, a, s' [n]")
    if isinstance(experience, Transitions):
        found: Experience = _with_ratio(experience, ratio)
    else:
        found = Reweighted(experience, ratio)
    # What is wrong is named here, not by whoever learns.
    sizes = np.zeros(2, np.int64)
    for chunk in found.chunks():
        sizes = np.maximum(sizes, [max(chunk.s.max(), chunk.s_next.max()), chunk.a.max()])
    n_states, n_actions = sizes + 1
    weighing(found, int(n_states), int(n_actions))
    n, total = np.zeros((2, n_states * n_actions))
    for chunk in found.chunks():
        pair = chunk.s * np.int32(n_actions) + chunk.a
        n += np.bincount(pair, minlength=len(n))
        total += np.bincount(pair, chunk.weight, len(n))
    lacking = np.flatnonzero(total < LEAST_MEAN_WEIGHT * n)
    if len(lacking):
        pairs = np.stack(np.divmod(lacking, n_actions), 1)
        note(
            f"at {_named(pairs)} the mean weight is below {LEAST_MEAN_WEIGHT:g} (the first: "
            f"{total[lacking[0]] / n[lacking[0]]:.2g} of {n[lacking[0]]:.0f} tuples), not 1: most successors under the "
            "other dynamics were never seen there"
        )
    return found


class Reweighted:
    """The tuples of ``data`` with the weights of ``ratio``, as ``reweighted``."""

    def __init__(self, data: Experience, ratio: Ratio) -> None:
        self._data, self._ratio = data, ratio

    def __len__(self) -> int:
        return len(self._data)

    def check_range(self, n_states: int, n_actions: int) -> None:
        self._data.check_range(n_states, n_actions)

    def chunks(self, multiple: int = 1) -> Iterator[Transitions]:
        return (_with_ratio(chunk, self._ratio) for chunk in self._data.chunks(multiple))

    def checksum(self) -> int:
        running = Checksum()
        return [running.of(chunk) for chunk in self.chunks()][-1]


def _with_ratio(chunk: Transitions, ratio: Ratio) -> Transitions:
    try:
        found = ratio(chunk.s, chunk.a, chunk.s_next)
    except (TypeError, ValueError) as error:  # as of a function of three numbers
        allowed = f"a function of arrays s, a, s' [n] ({type(error).__name__}: {error})"
        raise InputError("ratio", getattr(ratio, "__name__", type(ratio).__name__), allowed) from error
    weight = checks.real("ratio", found)
    if weight.shape != chunk.s.shape:
        raise InputError("ratio", f"an array of shape {weight.shape}", f"of one weight a tuple, {chunk.s.shape}")
    weight = np.ascontiguousarray(weight, np.float64)
    # Sums of squares stay in double precision.
    if not (good := (weight == 0) | ((weight >= 1 / LARGEST_RATIO) & (weight <= LARGEST_RATIO))).all():
        t = int(np.argmin(good))
        place = f"ratio({chunk.s[t]}, {chunk.a[t]}, {chunk.s_next[t]})"
        raise InputError(place, float(weight[t]), f"finite and >= 0: 0, or {1 / LARGEST_RATIO:g} to {LARGEST_RATIO:g}")
    if chunk.weight is not None:
        with np.errstate(over="ignore"):  # an infinite weight is refused, by its row
            weight = weight * chunk.weight
        if not np.isfinite(weight).all():
            raise InputError("weight", np.inf, "finite: the weights that the tuples have are too large for this ratio")
    return Transitions.checked(chunk.s, chunk.a, chunk.r, chunk.s_next, chunk.a_next, weight)


def for_dynamics(
    experience: Experience, target: TabularMDP, prior_policy: ArrayLike | None = None, *, rewards: str = "pair"
) -> EmpiricalMDP:
    """The model of dynamics that are given, with rewards of the tuples, whatever dynamics these are of.

    It goes to ``CertaintyEquivalence.solve`` and ``theta_uncertainty``, whose interval has the noise of the rewards
    alone. The rewards of ``target`` are not looked at.

    Args:
        experience: the tuples, without weights.
        target: has the dynamics.
        prior_policy: [S, A], 0 where an action is not to be taken, so that no reward of it is needed; None is uniform
            over the actions that the target's states have.
        rewards: what they depend on. "pair": (s,a), so that the mean over the tuples of a pair serves. "successor":
            (s,a,s'), so that each successor's own mean counts with the target's probability.

    Raises:
        InputError: a tuple out of range; pairs that the target may reach from the states of the tuples and no tuple has
            a reward of (with "successor": successors), named.
    """
    checks.instance("experience", experience, Experience, EXPERIENCE)
    checks.instance("target", target, TabularMDP, "a TabularMDP")
    checks.one_of("rewards", rewards, REWARDS)
    check_unweighted("experience", experience, "the target's dynamics are known, so that no weight is needed")
    shape = target.n_states, target.n_actions
    prior = check_prior("prior_policy", prior_policy, *shape, target.allowed)
    seen = empirical_mdp(permitted(experience, prior, next_actions=False), *shape)
    p = sp.csr_array(target.transition, copy=True)
    p.eliminate_zeros()
    p.sort_indices()
    needed = _reached(p, prior, seen) & (prior > 0)
    missing = np.argwhere(needed & (seen.visits == 0))
    if len(missing):
        raise InputError(
            "experience", f"no reward of {_named(missing)}", "tuples of every pair that the target reaches"
        )
    row = np.repeat(np.arange(p.shape[0]), np.diff(p.indptr))
    kept = needed.ravel()[row]
    rows = np.concatenate(([0], np.cumsum(np.bincount(row[kept], minlength=p.shape[0]))))
    p = sp.csr_array((p.data[kept], p.indices[kept], rows), shape=p.shape)
    visits = np.where(needed, seen.visits, 0)
    if rewards == "pair":
        return EmpiricalMDP(
            visits=visits,
            transition=p,
            reward=np.where(needed, seen.reward, 0.0),
            reward_variance=np.where(needed, seen.reward_variance, 0.0),
            reward_given_next=seen.reward.ravel()[row[kept]],
            given=True,
        )
    return _by_successor(experience, seen, p, needed)


def _reached(p: sp.csr_array, prior: np.ndarray, seen: EmpiricalMDP) -> np.ndarray:
    """[S, 1] bool: states that ``p`` leads to from those that the tuples leave, these included."""
    n_states, n_actions = prior.shape
    row = np.repeat(np.arange(p.shape[0]), np.diff(p.indptr))
    there = prior.ravel()[row] > 0
    graph = sp.csr_array(
        (np.ones(int(there.sum())), (row[there] // n_actions, p.indices[there])), shape=(n_states, n_states)
    )
    return np.asarray(reachable_from(graph, seen.visits.any(1).astype(float)))[:, None]


def _by_successor(experience: Experience, seen: EmpiricalMDP, p: sp.csr_array, needed: np.ndarray) -> EmpiricalMDP:
    """The tuples weighted by p^ over their own frequencies: that is p^ itself, on successors that were seen."""
    n_actions = needed.shape[1]
    row = np.repeat(np.arange(p.shape[0]), np.diff(p.indptr))
    frequency = np.asarray(sp.csr_array(seen.transition)[row, p.indices]).ravel()
    missing = np.flatnonzero(frequency == 0)
    if len(missing):
        steps = np.stack([row[missing] // n_actions, row[missing] % n_actions, p.indices[missing]], 1)
        raise InputError("experience", f"no reward of {_named(steps)}", "tuples of every successor that the target has")
    entry = np.repeat(np.arange(p.shape[0]), np.diff(seen.transition.indptr))
    ratio = np.asarray(p[entry, seen.transition.indices]).ravel() / seen.transition.data
    tuples = permitted(experience, needed.astype(float), next_actions=False)
    weighted = Reweighted(tuples, lambda *of: ratio[entries_of(seen, *of)])
    return replace(empirical_mdp(weighted, *needed.shape), transition=p, given=True)


def _named(rows: np.ndarray) -> str:
    """The first of the pairs (s,a), or of (s,a,s'), and how many there are."""
    shown = ", ".join(str(tuple(row)) for row in rows[:NAMED].tolist())
    what = "(s, a, s')" if rows.shape[1] == 3 else "(s, a)"
    return f"{what} = {shown}" + (f", ... ({len(rows)} of them)" if len(rows) > NAMED else "")
