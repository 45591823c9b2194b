"""Finite MDPs in the forms that other packages give them, as the arrays that ``TabularMDP`` takes.

Each function returns (transition [S*A, S] sparse, reward [S, A]): a pair that the state does not have is an empty row
with reward -inf. ``TabularMDP`` has a constructor for each.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike

from erl_torch import checks
from erl_torch.checks import InputError

Arrays: TypeAlias = tuple[sp.csr_array, np.ndarray]
MOST_PAIRS = 2**31 - 1  # pairs have numbers of 32 bits
Outcomes = Callable[[int, int], Iterable[tuple[float, int, float]]]


# -- rules ------------------------------------------------------------------------------------------------


def of_outcomes(n_states: int, n_actions: int, outcomes: Outcomes) -> Arrays:
    """See ``TabularMDP.from_outcomes``."""
    checks.at_least("n_states", n_states, 1)
    checks.at_least("n_actions", n_actions, 1)
    checks.room("n_states * n_actions", (n_states, n_actions))
    if not callable(outcomes):
        raise InputError("outcomes", type(outcomes).__name__, "a function of (s, a)")
    data: list[float] = []
    columns: list[int] = []
    ends = [0]
    reward = np.full((n_states, n_actions), -np.inf)
    for s in range(n_states):
        for a in range(n_actions):
            parts = []
            for entry in _listed(f"outcomes({s}, {a})", outcomes(s, a)):
                p, to, r = _outcome(f"outcomes({s}, {a})", entry, n_states)
                data.append(p)
                columns.append(to)
                parts.append(p * r)
            if parts:
                reward[s, a] = math.fsum(parts)
            ends.append(len(data))
    return sp.csr_array((data, columns, ends), shape=(n_states * n_actions, n_states)), reward


def _listed(key: str, entries: Any) -> Iterable[Any]:
    if entries is not None and not isinstance(entries, Iterable):
        raise InputError(key, entries, "entries (probability, s', reward), or none")
    return () if entries is None else entries


def _outcome(key: str, entry: Any, n_states: int) -> tuple[float, int, float]:  # whatever the caller's function gives
    try:
        p, to, r = entry
    except (TypeError, ValueError) as error:
        raise InputError(key, entry, "entries (probability, s', reward)") from error
    probability = checks.number(f"{key}: probability", p, lambda x: 0 <= x < math.inf, "finite and >= 0")
    if isinstance(to, (bool, np.bool_)) or not isinstance(to, (int, np.integer)) or not 0 <= to < n_states:
        raise InputError(f"{key}: s'", to, f"a whole number in [0, {n_states})")
    return probability, int(to), checks.finite(f"{key}: reward", r)


# -- one matrix an action -----------------------------------------------------------------------------------


def is_by_action(value: Any) -> bool:
    """Whether ``value`` is a list (tuple, object array) of matrices of which one is sparse: one an action."""
    listed = isinstance(value, (list, tuple)) or (isinstance(value, np.ndarray) and value.dtype.kind == "O")
    return listed and any(checks.is_sparse(one) for one in value)


def by_action(key: str, value: object) -> sp.csr_array:
    """[S*A, S] of one [S, S] matrix an action: a sequence, or an array [A, S, S]. Raises InputError."""
    matrices = checks.sequence(key, value)
    checks.at_least(f"len({key})", len(matrices), 1)
    parts = [checks.sparse(f"{key}[{a}]", one, ("n_states", "n_states")) for a, one in enumerate(matrices)]
    n = parts[0].shape[0]
    for a, part in enumerate(parts):
        if part.shape[0] != n:
            raise InputError(f"{key}[{a}]", f"array of shape {part.shape}", f"of shape [{n}, {n}], as {key}[0]")
    rows = np.arange(n * len(parts)).reshape(len(parts), n).T.ravel()  # row s * A + a is row a * n + s below
    return sp.csr_array(sp.vstack(parts, format="csr")[rows])


def of_matrices(transition: object, reward: object) -> Arrays:
    """See ``TabularMDP.from_pymdptoolbox``."""
    rows = by_action("transition", transition)
    n_states = rows.shape[1]
    n_actions = rows.shape[0] // n_states
    if is_by_action(reward):
        table = mean_reward(rows, by_action("reward", reward))
        return rows, table.reshape(n_states, n_actions)
    given = checks.real("reward", reward)
    if given.shape == (n_states,):
        return rows, np.repeat(np.asarray(given, np.float64)[:, None], n_actions, 1)
    if given.shape == (n_states, n_actions):
        return rows, np.asarray(given, np.float64)
    if given.shape == (n_actions, n_states, n_states):
        return rows, mean_reward(rows, np.moveaxis(given, 0, 1)).reshape(n_states, n_actions)
    shapes = f"[{n_states}], [{n_states}, {n_actions}] or [{n_actions}, {n_states}, {n_states}], as transition is"
    raise InputError("reward", f"array of shape {given.shape}", f"of shape {shapes}")


def mean_reward(transition: sp.csr_array, reward: Any) -> np.ndarray:
    """[n] sum over s' of p(s') r(s') for each row of ``transition`` [n, S], where p > 0.

    Args:
        transition: CSR.
        reward: [n, S] sparse, or any array that has this size when it is reshaped.

    Entries of ``reward`` where p = 0 are not looked at. A -inf where p > 0 makes the mean -inf.
    """
    n, n_states = transition.shape
    row = np.repeat(np.arange(n), np.diff(transition.indptr))
    column = transition.indices
    if sp.issparse(reward):
        paid = np.asarray(reward[row, column]).ravel() if len(row) else np.zeros(0)
    else:
        paid = np.asarray(reward, np.float64).reshape(n, n_states)[row, column]
    return np.bincount(row, transition.data * paid, n)


# -- state-action pairs ---------------------------------------------------------------------------------------


def of_pairs(states: ArrayLike, actions: ArrayLike, transition: object, reward: ArrayLike) -> Arrays:
    """See ``TabularMDP.from_pairs``."""
    s, a = _indices("states", states), _indices("actions", actions)
    paid = checks.array("reward", reward, ("n_pairs",), (lambda x: ~np.isnan(x) & (x < np.inf), "finite, or -inf"))
    for key, column in (("states", s), ("actions", a)):
        if len(column) != len(paid):
            raise InputError(key, f"{len(column)} entries", f"{len(paid)} entries, as reward has")
    rows = checks.sparse("transition", transition, (len(paid), "n_states"))
    n_states, n_actions = rows.shape[1], int(a.max()) + 1
    if n_states * n_actions > MOST_PAIRS:
        raise InputError(
            "actions", int(a.max()), f"below {MOST_PAIRS // n_states}: each state has a row for each action"
        )
    checks.room("reward", (n_states, n_actions))
    if s.max() >= n_states:
        raise InputError("states", int(s.max()), f"below {n_states}, as transition has {n_states} columns")
    pair = s * n_actions + a
    unique, first, count = np.unique(pair, return_index=True, return_counts=True)
    if (count > 1).any():
        twice = first[count > 1][0]
        raise InputError("states, actions", (int(s[twice]), int(a[twice])), "pairs that come once each")
    reward_table = np.full(n_states * n_actions, -np.inf)
    reward_table[pair] = paid
    place = sp.csr_array((np.ones(len(unique)), (pair, np.arange(len(pair)))), shape=(n_states * n_actions, len(pair)))
    return sp.csr_array(place @ rows), reward_table.reshape(n_states, n_actions)


def _indices(key: str, value: ArrayLike) -> np.ndarray:
    column = checks.real(key, value)
    whole = column.ndim == 1 and column.size and column.dtype.kind in "iu"
    if not whole or column.min() < 0 or column.max() > checks.LARGEST_INTEGER:
        raise InputError(key, f"{column.dtype} array of shape {column.shape}", "whole numbers >= 0, [n_pairs]")
    return np.asarray(column.astype(np.int64))


def of_quantecon(problem: Any) -> Arrays:
    """See ``TabularMDP.from_quantecon``."""
    missing = [name for name in ("R", "Q") if not hasattr(problem, name)]
    if missing:
        raise InputError("problem", type(problem).__name__, f"quantecon's DiscreteDP; it has no {missing[0]}")
    s, a = getattr(problem, "s_indices", None), getattr(problem, "a_indices", None)
    if s is not None and a is not None:
        return of_pairs(s, a, problem.Q, problem.R)
    reward = checks.real("R", problem.R)
    table = checks.real("Q", problem.Q)
    if reward.ndim != 2 or table.shape != (*reward.shape, reward.shape[0]):
        raise InputError("Q", f"array of shape {table.shape}", "of shape [S, A, S], as R is [S, A]")
    have = ~np.isneginf(reward)
    rows = sp.csr_array(np.where(have[..., None], table, 0.0).reshape(reward.size, reward.shape[0]))
    return rows, np.asarray(reward, np.float64)


# -- files of PRISM -------------------------------------------------------------------------------------------


def of_prism(
    transitions: str | os.PathLike[str],
    state_rewards: str | os.PathLike[str] | None = None,
    transition_rewards: str | os.PathLike[str] | None = None,
) -> Arrays:
    """See ``TabularMDP.from_prism``."""
    header, lines = _prism_lines(transitions)
    if len(header) not in (2, 3):
        raise InputError(f"path={transitions}: first line", " ".join(header), "STATES CHOICES TRANSITIONS, of an MDP")
    chain = len(header) == 2  # of a Markov chain: one choice a state, not written
    n_states = int(_whole(transitions, 1, header[0]))
    checks.at_least(f"path={transitions}: states", n_states, 1)
    entries = [_prism_entry(transitions, n, words, chain, n_states) for n, words in lines]
    if len(entries) != int(_whole(transitions, 1, header[-1])):
        raise InputError(f"path={transitions}", f"{len(entries)} transitions", f"{header[-1]}, as its first line says")
    n_actions = 1 + max((a for _, a, _, _ in entries), default=0)
    if n_states * n_actions > MOST_PAIRS:
        raise InputError(
            f"path={transitions}", f"{n_states} states, choices up to {n_actions - 1}", "fewer than 2**31 pairs"
        )
    checks.room(f"path={transitions}: states * choices", (n_states, n_actions))
    row = np.array([s * n_actions + a for s, a, _, _ in entries], np.int64)
    to = np.array([t for _, _, t, _ in entries], np.int64)
    shape = (n_states * n_actions, n_states)
    rows = sp.csr_array((np.array([p for *_, p in entries]), (row, to)), shape=shape)
    present = np.bincount(row, minlength=shape[0]) > 0
    if not chain and _whole(transitions, 1, header[1]) != present.sum():
        raise InputError(f"path={transitions}", f"{present.sum()} choices", f"{header[1]}, as its first line says")
    reward = np.where(present, 0.0, -np.inf)
    if state_rewards is not None:
        reward += np.repeat(_prism_state_rewards(state_rewards, n_states), n_actions)
    if transition_rewards is not None:
        reward += mean_reward(rows, _prism_transition_rewards(transition_rewards, chain, rows, header))
    return rows, reward.reshape(n_states, n_actions)


def _prism_state_rewards(path: str | os.PathLike[str], n_states: int) -> np.ndarray:
    header, lines = _prism_lines(path)
    _check_header(path, header, [str(n_states)], len(lines))
    found: dict[int, float] = {}
    for n, words in lines:
        if len(words) != 2:
            raise InputError(f"path={path}: line {n}", " ".join(words), "STATE NUMBER")
        s = _below(path, n, words[0], n_states)
        if s in found:
            raise InputError(f"path={path}: line {n}", s, "a state that comes once")
        found[s] = _real(path, n, words[1])
    return np.array([found.get(s, 0.0) for s in range(n_states)])


def _prism_transition_rewards(
    path: str | os.PathLike[str], chain: bool, rows: sp.csr_array, model: Sequence[str]
) -> sp.csr_array:
    """r(s, a, s') [S*A, S] of the transitions that ``rows`` has; ``model`` is the first line of their file."""
    header, lines = _prism_lines(path)
    _check_header(path, header, model[:-1], len(lines))
    n_states = rows.shape[1]
    n_actions = rows.shape[0] // n_states
    there = sp.csr_array(rows > 0)
    found: dict[tuple[int, int], float] = {}
    for n, words in lines:
        s, a, to, r = _prism_entry(path, n, words, chain, n_states)
        place = (s * n_actions + a, to)
        if a >= n_actions or not there[place]:
            raise InputError(f"path={path}: line {n}", " ".join(words), "of a transition that the model has")
        if place in found:
            raise InputError(f"path={path}: line {n}", " ".join(words), "a transition that comes once")
        found[place] = r
    index = np.array([*found], np.int64).reshape(-1, 2)
    return sp.csr_array((np.array([*found.values()]), (index[:, 0], index[:, 1])), shape=rows.shape)


def _check_header(path: str | os.PathLike[str], header: Sequence[str], sizes: Sequence[str], n: int) -> None:
    """Raise InputError unless a file of rewards says the sizes of its model, and how many lines follow."""
    expected = [*sizes, str(n)]
    if [*header] != expected:
        raise InputError(
            f"path={path}: first line", " ".join(header), f"{' '.join(expected)}, for its model and its lines"
        )


def prism_start(labels: str | os.PathLike[str], n_states: int) -> np.ndarray:
    """[S], uniform over the states that a labels file (.lab) of PRISM calls "init". Raises InputError."""
    lines = _read_lines(labels)
    names = {name.strip('"'): number for number, _, name in (word.partition("=") for word in lines[0][1])}
    if "init" not in names:
        raise InputError(f"path={labels}: first line", " ".join(lines[0][1]), 'one with N="init"')
    start = np.zeros(n_states)
    for n, words in lines[1:]:
        if names["init"] in words[1:]:
            start[_below(labels, n, words[0].rstrip(":"), n_states)] = 1.0
    if not start.any():
        raise InputError(f"path={labels}", "no state", 'with a state of label "init"')
    return np.asarray(start / start.sum())


def _read_lines(path: str | os.PathLike[str]) -> list[tuple[int, list[str]]]:
    """(number from 1, words) of the lines that are neither empty nor a comment. Raises InputError."""
    try:
        text = Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError, TypeError, ValueError) as error:
        raise InputError("path", path, f"a text file that can be read ({error})") from error
    rows = [(n, line.split("#")[0].split()) for n, line in enumerate(text.splitlines(), 1)]
    rows = [(n, words) for n, words in rows if words]
    if not rows:
        raise InputError("path", path, "a file of PRISM's; it is empty")
    return rows


def _prism_lines(path: str | os.PathLike[str]) -> tuple[list[str], list[tuple[int, list[str]]]]:
    rows = _read_lines(path)
    return rows[0][1], rows[1:]


def _prism_entry(
    path: str | os.PathLike[str], line: int, words: Sequence[str], chain: bool, n_states: int
) -> tuple[int, int, int, float]:
    """(s, choice, s', number) of a line; an action's name after them is passed over."""
    if len(words) < 4 - chain:
        raise InputError(f"path={path}: line {line}", " ".join(words), "STATE CHOICE STATE NUMBER")
    s, to = (_below(path, line, words[i], n_states) for i in (0, 2 - chain))
    choice = 0 if chain else _whole(path, line, words[1])
    return s, choice, to, _real(path, line, words[3 - chain])


def _whole(path: str | os.PathLike[str], line: int, word: str) -> int:
    if not (word.isascii() and word.isdigit() and len(word) < 19):
        raise InputError(f"path={path}: line {line}", word, "a whole number >= 0")
    return int(word)


def _below(path: str | os.PathLike[str], line: int, word: str, n: int) -> int:
    value = _whole(path, line, word)
    if value >= n:
        raise InputError(f"path={path}: line {line}", word, f"a state below {n}")
    return value


def _real(path: str | os.PathLike[str], line: int, word: str) -> float:
    """A number, or a fraction as 1/3."""
    above, slash, below = word.partition("/")
    try:
        value = float(above) / float(below) if slash else float(above)
    except (ValueError, ZeroDivisionError) as error:
        raise InputError(f"path={path}: line {line}", word, "a number") from error
    return checks.finite(f"path={path}: line {line}", value)
