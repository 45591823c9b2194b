"""A finite MDP as arrays: transition [S*A, S] sparse, reward [S, A], start [S].

Row ``s * n_actions + a`` of ``transition`` is p(.|s, a). ``reward`` is the expected reward of a step
(the paper's r(s, a), a function of state and action only). ``start`` is the distribution of the first state.

Actions that a state does not have. ``allowed`` [S, A] is false there; the row is empty and the reward 0, and neither is
ever read. A prior of exactly 0 says the same of a pair: whatever takes a prior takes no maximum, no mean and no draw
over pairs where it is 0.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import InitVar, dataclass
from pathlib import Path

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike

from erl_torch import checks
from erl_torch.checks import InputError
from erl_torch.files import read_npz, write_npz
from erl_torch.mdp import importers, kernels
from erl_torch.notes import note

ROW_SUM_TOLERANCE = 1e-5  # rows may be given in single precision
EXACT_SUM = 1e-15  # a row whose sum is this close to 1 keeps its bits
NOTED_CORRECTION = 1e-9
SMALLEST_PRIOR = 1e-307
LARGEST_REWARD = 1e100  # products of such numbers stay in range
REWARDS = (lambda r: np.abs(r) <= LARGEST_REWARD, f"finite, and at most {LARGEST_REWARD:g} in size")
ANY = (lambda r: np.ones(r.shape, bool), "")
CSR_PARTS = ("indptr", "indices", "data")


@dataclass(frozen=True, eq=False, repr=False)
class TabularMDP:
    """A validated finite MDP.

    Args:
        transition: p(s'|s, a), [S*A, S] or [S, A, S], as any array of real numbers (lists, numpy, torch). [S*A, S] may
            be sparse (scipy, torch); repeated entries are summed. A list of sparse matrices is one [S, S] per action.
        reward: [S, A], reward per step, -inf where the state does not have the action; or [S, A, S], r(s, a, s'), of
            which the mean over s' is kept.
        start: [S], distribution of the first state; None is uniform.
        normalise: divide every row, and start, by its sum, even where that is far from 1.
        allowed: [S, A] bool, the actions that each state has, at least one; None is all but those with reward -inf.
            What ``transition`` and ``reward`` hold at the others is not looked at.

    Rows and start that sum to 1 within 1e-5 are divided by their sums in any case. The rows as they then stand in
    ``transition`` are those that are kept, solved and certified. A ``Note`` gives the largest correction above 1e-9.

    Raises:
        InputError: no real numbers, wrong shape, an index out of range, a value that is not finite or is negative, a
            row that does not sum to 1 within 1e-5, or, with ``normalise``, sums to 0 (the message names the row), or a
            state without any action.
    """

    transition: sp.csr_array  # [S*A, S], float64, sorted, no repeated or zero entries
    reward: np.ndarray  # [S, A], float64
    start: np.ndarray = None  # type: ignore[assignment]  # [S], float64
    normalise: InitVar[bool] = False
    allowed: np.ndarray = None  # type: ignore[assignment]  # [S, A], bool, read-only

    def __post_init__(self, normalise: bool) -> None:
        given: object = self.transition
        if importers.is_by_action(given):
            given = importers.by_action("transition", given)
        reward = checks.array("reward", _mean_reward(given, self.reward), ("n_states", "n_actions"), ANY)
        n_states, n_actions = reward.shape
        allowed = _allowed(self.allowed, reward)
        transition = _csr(given, n_states, n_actions)
        if not allowed.all():
            reward[~allowed] = 0.0
            transition = _with_rows(transition, allowed)
        reward = checks.array("reward", reward, (n_states, n_actions), REWARDS)
        _check_entries(transition, n_actions)
        start = np.full(n_states, 1.0 / n_states)
        if self.start is not None:
            start = checks.array("start", self.start, (n_states,), checks.NOT_NEGATIVE)
        tolerance = np.inf if checks.flag("normalise", normalise) else ROW_SUM_TOLERANCE
        kept = np.flatnonzero(allowed)
        empty = np.diff(transition.indptr)[kept] == 0
        if empty.any():
            hint = "a distribution (of an action that the state does not have: reward -inf, or false in allowed)"
            raise InputError(_row_name(int(kept[np.argmax(empty)]), n_actions), "sum 0", hint)
        # The rows in between are empty, so that these follow each other.
        indptr = np.append(transition.indptr[kept], transition.nnz)
        rows = normalise_rows(lambda i: _row_name(int(kept[i]), n_actions), indptr, transition.data, tolerance)
        _note_correction("rows of transition", rows)
        _note_correction("start", normalise_rows(lambda row: "start", np.array([0, n_states]), start, tolerance))
        object.__setattr__(self, "transition", transition)
        object.__setattr__(self, "reward", reward)
        object.__setattr__(self, "start", start)
        allowed.flags.writeable = False
        object.__setattr__(self, "allowed", allowed)

    def __repr__(self) -> str:
        low, high = self.reward_range
        parts = [f"{self.n_states} states", f"{self.n_actions} actions", f"{self.transition.nnz} transitions"]
        if not self.allowed.all():
            parts[1] += f" ({self.allowed.sum()} of {self.allowed.size} pairs)"
        return f"TabularMDP({', '.join(parts)}, rewards in [{low:g}, {high:g}])"

    @property
    def n_states(self) -> int:
        return int(self.reward.shape[0])

    @property
    def n_actions(self) -> int:
        return int(self.reward.shape[1])

    @property
    def reward_range(self) -> tuple[float, float]:
        """(smallest, largest) reward of the pairs that there are."""
        rewards = self.reward[self.allowed]
        return float(rewards.min()), float(rewards.max())

    @property
    def uniform_policy(self) -> np.ndarray:
        """The policy that takes all actions that a state has alike, [S, A]: the default prior."""
        return uniform(self.allowed)

    def restricted(self, allowed: np.ndarray) -> TabularMDP:
        """The MDP without the pairs that ``allowed`` [S, A] bool leaves out; itself where it has none of them."""
        kept = self.allowed & allowed
        if (kept == self.allowed).all():
            return self
        return TabularMDP(self.transition, self.reward, self.start, allowed=kept)

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write transition_indptr, transition_indices, transition_data, reward and start to an npz file, and allowed
        where an action is missing."""
        parts = {f"transition_{name}": getattr(self.transition, name) for name in CSR_PARTS}
        if not self.allowed.all():
            parts["allowed"] = self.allowed
        return write_npz(path, {**parts, "reward": self.reward, "start": self.start})

    @classmethod
    def load(cls, path: str | os.PathLike[str], normalise: bool = False) -> TabularMDP:
        """Read what ``save`` wrote, or any npz with ``transition`` (or its CSR parts), ``reward`` and, where they are
        not the default, ``start`` and ``allowed``; ``normalise`` as in the constructor. Raises InputError naming the
        file."""
        arrays = read_npz(path)
        names = [f"transition_{name}" for name in CSR_PARTS]
        if "reward" not in arrays or not ("transition" in arrays or all(name in arrays for name in names)):
            raise InputError("path", path, f"an npz with reward and transition (or {', '.join(names)})")
        try:
            transition = arrays.get("transition")
            if transition is None:
                transition = _csr_of_parts([arrays[name] for name in names], arrays["reward"].shape)
            start, allowed = arrays.get("start"), arrays.get("allowed")
            return cls(transition, arrays["reward"], start, normalise, allowed)  # type: ignore[arg-type]
        except InputError as error:
            raise error.of_file(path) from error

    @classmethod
    def from_outcomes(
        cls, n_states: int, n_actions: int, outcomes: importers.Outcomes, start: ArrayLike | None = None
    ) -> TabularMDP:
        """The MDP whose steps a function lists; the reward of a pair is the mean over them.

        Args:
            n_states, n_actions: whole numbers >= 1.
            outcomes: (s, a) -> entries (probability, s', reward). No entry: the state does not have the action. The
                same s' may come several times.
            start: [S], distribution of the first state; None is uniform.

        Raises:
            InputError: an entry that is not as above, or what the constructor refuses.
        """
        return cls(*importers.of_outcomes(n_states, n_actions, outcomes), start)  # type: ignore[arg-type]

    @classmethod
    def from_pymdptoolbox(cls, transition: object, reward: object, start: ArrayLike | None = None) -> TabularMDP:
        """The MDP that pymdptoolbox has as P and R, one matrix an action.

        Args:
            transition: [A, S, S], or a sequence of A matrices [S, S], dense or sparse.
            reward: [S], [S, A], [A, S, S], or a sequence of A matrices [S, S], one of them at least sparse. Of
                r(a, s, s') the mean over s' is kept.
            start: [S], distribution of the first state; None is uniform.

        Raises:
            InputError: shapes that do not fit, or what the constructor refuses.
        """
        return cls(*importers.of_matrices(transition, reward), start)  # type: ignore[arg-type]

    @classmethod
    def from_pairs(
        cls,
        states: ArrayLike,
        actions: ArrayLike,
        transition: object,
        reward: ArrayLike,
        start: ArrayLike | None = None,
    ) -> TabularMDP:
        """The MDP of a list of state-action pairs; a pair that is not listed is one that the state does not have.

        Args:
            states, actions: [L] whole numbers >= 0, each pair once.
            transition: [L, S], dense or sparse, p(.|s, a) of each pair.
            reward: [L].
            start: [S], distribution of the first state; None is uniform.

        Raises:
            InputError: shapes that do not fit, a pair that comes twice, or what the constructor refuses.
        """
        return cls(*importers.of_pairs(states, actions, transition, reward), start)  # type: ignore[arg-type]

    @classmethod
    def from_quantecon(cls, problem: object, start: ArrayLike | None = None) -> TabularMDP:
        """The MDP of a ``quantecon.markov.DiscreteDP``, in either of its forms; its discount is left out.

        Args:
            problem: with R and Q, and s_indices and a_indices in the form of state-action pairs. R = -inf: the state
                does not have the action.
            start: [S], distribution of the first state; None is uniform.

        Raises:
            InputError: no such object, shapes that do not fit, or what the constructor refuses.
        """
        return cls(*importers.of_quantecon(problem), start)  # type: ignore[arg-type]

    @classmethod
    def from_prism(
        cls,
        transitions: str | os.PathLike[str],
        state_rewards: str | os.PathLike[str] | None = None,
        transition_rewards: str | os.PathLike[str] | None = None,
        labels: str | os.PathLike[str] | None = None,
    ) -> TabularMDP:
        """The MDP, or Markov chain, that PRISM exports in explicit form. The choices of a state are its actions 0, 1,
        ...

        Args:
            transitions: .tra file.
            state_rewards: .srew file; None is no such reward. It is paid whatever the action.
            transition_rewards: .trew file; None is no such reward. Of r(s, a, s') the mean over s' is kept.
            labels: .lab file; its states "init" are the start. None is a uniform start.

        Raises:
            InputError: a file that cannot be read, or what the constructor refuses (a state without a choice, say).
        """
        transition, reward = importers.of_prism(transitions, state_rewards, transition_rewards)
        start = None if labels is None else importers.prism_start(labels, len(reward))
        return cls(transition, reward, start)  # type: ignore[arg-type]


def uniform(allowed: np.ndarray) -> np.ndarray:
    """The policy that takes all actions of ``allowed`` [S, A] bool alike, [S, A]."""
    return np.asarray(allowed / allowed.sum(1, keepdims=True))


def check_policy(
    key: str, policy: ArrayLike | None, n_states: int, n_actions: int, allowed: np.ndarray | None = None
) -> np.ndarray:
    """``policy`` as a float64 array [S, A] whose rows are distributions; None is the uniform policy.

    ``allowed`` [S, A] bool: the actions that each state has; None is all. Raises InputError naming ``key``, also where
    an action that a state does not have is taken.
    """
    n_states, n_actions = checks.at_least("n_states", n_states, 1), checks.at_least("n_actions", n_actions, 1)
    if policy is None:
        checks.room("n_states * n_actions", (n_states, n_actions))
        return np.full((n_states, n_actions), 1.0 / n_actions) if allowed is None else uniform(allowed)
    table = checks.array(key, policy, (n_states, n_actions), checks.NOT_NEGATIVE)
    if allowed is not None and (table[~allowed] > 0).any():
        s, a = np.argwhere((table > 0) & ~allowed)[0]
        raise InputError(f"{key}[{s}, {a}]", table[s, a], f"0: state {s} does not have action {a}")
    rows = np.arange(n_states + 1) * n_actions
    _note_correction(f"rows of {key}", normalise_rows(lambda row: f"{key}[{row}]", rows, table.reshape(-1)))
    return table


def check_prior(
    key: str, prior: ArrayLike | None, n_states: int, n_actions: int, allowed: np.ndarray | None = None
) -> np.ndarray:
    """As ``check_policy``, for a prior. Every entry must be 0, which says that the state does not have the action, or
    at least 1e-307: below, digits are lost."""
    table = check_policy(key, prior, n_states, n_actions, allowed)
    small = (table < SMALLEST_PRIOR) & (table > 0)
    if small.any():
        s, a = np.argwhere(small)[0]
        raise InputError(f"{key}[{s}, {a}]", table[s, a], f">= {SMALLEST_PRIOR:g}, or 0 to leave the action out")
    return table


def normalise_rows(
    name: Callable[[int], str], indptr: np.ndarray, data: np.ndarray, tolerance: float = ROW_SUM_TOLERANCE
) -> float:
    """Divide the rows of ``data`` (CSR; finite, >= 0), in place, by their sums, except sums within 1e-15 of 1.

    Returns the largest distance of a sum from 1. Raises InputError, with the ``name`` of the row, for a sum that is
    further than ``tolerance`` from 1, or 0, or infinite.
    """
    sums = np.empty(len(indptr) - 1)
    kernels.row_sums(indptr, data, sums)
    off = np.abs(sums - 1)
    if off.max(initial=0.0) <= EXACT_SUM:  # false for a sum that overflows
        return 0.0
    bad = np.flatnonzero(~(off <= tolerance) | ~((sums > 0) & np.isfinite(sums)))
    if bad.size:
        allowed = "of a finite sum > 0" if np.isinf(tolerance) else f"1 in sum, within {tolerance:g}"
        raise InputError(name(int(bad[0])), f"sum {sums[bad[0]]:.12g}", allowed)
    for _ in range(2):  # a subnormal entry may need the second round
        factor = np.where(np.abs(sums - 1) > EXACT_SUM, sums, 1.0)
        data /= np.repeat(factor, np.diff(indptr))
        kernels.row_sums(indptr, data, sums)
        if not np.abs(sums - 1).max() > EXACT_SUM:
            break
    return float(off.max())


def _note_correction(what: str, largest: float) -> None:
    if largest > NOTED_CORRECTION:
        note(f"{what} did not sum to 1, by up to {largest:.1e}: what is kept is divided by the sum")


def _csr_of_parts(parts: Sequence[np.ndarray], sizes: tuple[int, ...]) -> sp.csr_array:
    indptr, indices, data = parts
    if len(sizes) != 2:
        raise InputError("reward", f"array of shape {sizes}", "of shape [n_states, n_actions]")
    try:
        matrix = sp.csr_array((data, indices, indptr), shape=(sizes[0] * sizes[1], sizes[0]))
        matrix.check_format(full_check=True)
    except (ValueError, TypeError, IndexError) as error:
        raise InputError("transition", "CSR parts", f"a CSR matrix [S*A, S] ({error})") from error
    return matrix


def _csr(value: object, n_states: int, n_actions: int) -> sp.csr_array:
    shape = (n_states * n_actions, n_states)
    hint = " ([S*A, S])"
    if not checks.is_sparse(value):
        table = checks.real("transition", value)
        value = table.reshape(shape) if table.shape == (n_states, n_actions, n_states) else table
        hint += f" or [{n_states}, {n_actions}, {n_states}] ([S, A, S])"
    hint += f", as reward is [{n_states}, {n_actions}] ([S, A]): one of the two is wrong"
    return checks.sparse("transition", value, shape, hint)


def _mean_reward(transition: object, reward: object) -> object:
    """``reward``; of r(s, a, s') [S, A, S] the mean over s' where ``transition`` has the shape for it."""
    if checks.is_sparse(reward):
        return reward
    table = checks.real("reward", reward)
    if table.ndim != 3 or table.shape[0] != table.shape[2]:
        return table
    n_states, n_actions, _ = table.shape
    return importers.mean_reward(_csr(transition, n_states, n_actions), table).reshape(n_states, n_actions)


def _allowed(given: ArrayLike | None, reward: np.ndarray) -> np.ndarray:
    """The mask of the pairs that there are, [S, A], from the mask ``given`` or from rewards of -inf."""
    allowed = np.asarray(~np.isneginf(reward))
    if given is not None:
        mask = checks.array("allowed", given, reward.shape, (lambda x: (x == 0) | (x == 1), "true or false"))
        odd = (mask == 1) & ~allowed
        if odd.any():
            s, a = np.argwhere(odd)[0]
            raise InputError(f"reward[{s}, {a}]", -np.inf, "finite: allowed says that the state has this action")
        allowed = mask == 1
    lacking = np.flatnonzero(~allowed.any(1))
    if lacking.size:
        raise InputError(f"allowed[{lacking[0]}]", "no action", "at least one action in every state")
    return allowed


def _with_rows(matrix: sp.csr_array, kept: np.ndarray) -> sp.csr_array:
    """``matrix`` with the rows outside the mask ``kept`` [S, A] empty."""
    width = np.where(kept.ravel(), np.diff(matrix.indptr), 0)
    inside = np.repeat(kept.ravel(), np.diff(matrix.indptr))
    indptr = np.concatenate(([0], np.cumsum(width))).astype(matrix.indptr.dtype)
    return sp.csr_array((matrix.data[inside], matrix.indices[inside], indptr), shape=matrix.shape)


def _row_name(row: int, n_actions: int) -> str:
    return f"transition row {row} (state {row // n_actions}, action {row % n_actions})"


def _check_entries(transition: sp.csr_array, n_actions: int) -> None:
    bad = np.flatnonzero(~(np.isfinite(transition.data) & (transition.data >= 0)))
    if bad.size:
        row = int(np.searchsorted(transition.indptr, bad[0], side="right")) - 1
        raise InputError(_row_name(row, n_actions), transition.data[bad[0]], "finite and >= 0 everywhere")
