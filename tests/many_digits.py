"""Problems made to break bounds, and what is true of them: many digits, nothing shared with the package.

``problem(seed, number)`` is deterministic. ``Oracle`` solves it in mpmath straight from the definitions:

- J(pi): stationary distribution of the closed classes that the policy meets, by elimination from the off-diagonal
  entries (nothing is subtracted, so digits do not depend on how rarely a set is left).
- g*: each maximal end component (a set of states that some of its actions never leave, and which they connect) has one
  optimal rate: Newton on V + g = TV over those actions, ended by min(TV - V) <= g <= max(TV - V) in as many digits as
  it takes. g*(s) is then an optimal stopping problem: the best component to end in.

Rows, prior, policies and start are divided by their sums in as many digits.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from mpmath import mp, mpf

DIGITS = (50, 110, 230, 470, 950)
SHARP = mpf(10) ** -22  # width of the bounds on g, relative to it
Row = dict[int, mpf]


@dataclass(frozen=True, eq=False)
class Given:
    """A problem as a user hands it over; rows need not sum to 1."""

    kind: str
    transition: np.ndarray  # [S, A, S]
    reward: np.ndarray  # [S, A]
    prior: np.ndarray  # [S, A]
    start: np.ndarray  # [S]
    beta: float


class Rate(NamedTuple):
    """low <= g* <= high, for every state that can be reached, and from the start."""

    low: list[mpf]
    high: list[mpf]
    states: list[int]
    start_low: mpf
    start_high: mpf
    seen: mpf  # mean |r| that the optimal policy meets in the long run; in the component with the largest rate


class NoRateError(ArithmeticError):
    """Newton's bounds stay apart, or the digits do not suffice."""


# -- many digits ------------------------------------------------------------------------------------------------


def shares(row: np.ndarray) -> list[mpf]:
    total = mp.fsum(mpf(float(x)) for x in row)
    return [mpf(float(x)) / total for x in row]


def components(successors: list[set[int]]) -> list[list[int]]:
    """Strongly connected components, those that are reached first in the list (Tarjan, without recursion)."""
    index: dict[int, int] = {}
    low: dict[int, int] = {}
    stack: list[int] = []
    held: set[int] = set()
    found = []
    for root in range(len(successors)):
        if root in index:
            continue
        work = [(root, iter(successors[root]))]
        index[root] = low[root] = len(index)
        stack.append(root)
        held.add(root)
        while work:
            s, rest = work[-1]
            for t in rest:
                if t not in index:
                    index[t] = low[t] = len(index)
                    stack.append(t)
                    held.add(t)
                    work.append((t, iter(successors[t])))
                    break
                if t in held:
                    low[s] = min(low[s], index[t])
            else:
                work.pop()
                if work:
                    low[work[-1][0]] = min(low[work[-1][0]], low[s])
                if low[s] == index[s]:
                    one = []
                    while not one or one[-1] != s:
                        one.append(stack.pop())
                        held.discard(one[-1])
                    found.append(one)
    return found


def reached(successors: list[set[int]], sources: list[int]) -> list[int]:
    seen, todo = set(sources), list(sources)
    while todo:
        for t in successors[todo.pop()] - seen:
            seen.add(t)
            todo.append(t)
    return sorted(seen)


class Removed(NamedTuple):
    """A state as it was when it was censored."""

    state: int
    row: Row
    out: mpf  # the weight with which it is left
    into: dict[int, mpf]  # weights with which it is entered, divided by that


def eliminate(rows: dict[int, Row], columns: dict[int, list[mpf]], keep: set[int]) -> list[Removed]:
    """Censor a chain on ``keep``, in place: ``rows`` (off-diagonal entries) and ``columns`` (right-hand sides)."""
    into: dict[int, set[int]] = {s: set() for s in rows}
    for s, row in rows.items():
        for t in row:
            into[t].add(s)
    removed = []
    left = set(rows) - keep
    while left:
        k = min(left, key=lambda s: (len(rows[s]) * len(into[s]), s))
        left.discard(k)
        row = rows.pop(k)
        out = mp.fsum(row.values())
        right = columns[k]
        for t in row:
            into[t].discard(k)
        entered = {}
        for i in into.pop(k):
            other = rows[i]
            entered[i] = share = other.pop(k) / out
            for t, p in row.items():
                if t != i:
                    other[t] = other[t] + share * p if t in other else share * p
                    into[t].add(i)
            columns[i] = [x + share * y for x, y in zip(columns[i], right, strict=True)]
        removed.append(Removed(k, row, out, entered))
    return removed


def relative_value(rows: dict[int, Row], reward: dict[int, mpf]) -> tuple[mpf, dict[int, mpf]]:
    """(g, h) with h + g = reward + K h, for an irreducible chain of off-diagonal entries; h = 0 where it is most often:
    the values of rare states, seen from there, take no more digits than they have."""
    home = min(rows)
    while True:
        columns = {s: [reward[s], mpf(1)] for s in rows}
        removed = eliminate({s: dict(row) for s, row in rows.items()}, columns, {home})
        often = {home: mpf(1)}
        for k, _, _, into in reversed(removed):
            often[k] = mp.fsum(often[i] * share for i, share in into.items())
        most = max(often, key=lambda s: often[s])
        if often[most] <= 2:
            break
        home = most
    g = columns[home][0] / columns[home][1]
    h = {home: mpf(0)}
    for k, row, out, _ in reversed(removed):
        h[k] = (columns[k][0] - g * columns[k][1] + mp.fsum(p * h[t] for t, p in row.items())) / out
    return g, h


def ended_in(rows: dict[int, Row], ends: dict[int, mpf]) -> dict[int, mpf]:
    """Mean of ``ends`` at the first of those states that is met, from each transient state of ``rows`` and them."""
    columns: dict[int, list[mpf]] = {s: [] for s in [*rows, *ends]}
    removed = eliminate({**{s: dict(row) for s, row in rows.items()}, **{s: {} for s in ends}}, columns, set(ends))
    x = dict(ends)
    for k, row, out, _ in reversed(removed):
        x[k] = mp.fsum(p * x[t] for t, p in row.items()) / out
    return x


class Oracle:
    """Of one problem."""

    def __init__(self, given: Given) -> None:
        self.given = given
        self.n_states, self.n_actions = given.reward.shape
        self.support = [
            [[int(t) for t in np.flatnonzero(given.transition[s, a])] for a in range(self.n_actions)]
            for s in range(self.n_states)
        ]
        self._digits = 0
        self._at(DIGITS[0])

    def _at(self, digits: int) -> None:
        """Numbers with that many digits."""
        mp.dps = digits
        if self._digits == digits:
            return
        self._digits = digits
        given, n_states, n_actions = self.given, self.n_states, self.n_actions
        self.p = [
            [
                {t: x for t, x in enumerate(shares(given.transition[s, a])) if x and t != s}  # the state's own left out
                for a in range(n_actions)
            ]
            for s in range(n_states)
        ]
        self.reward = [[mpf(float(x)) for x in row] for row in given.reward]
        self.prior = [shares(row) for row in given.prior]
        self.beta = mpf(given.beta)
        # Far above that of these numbers, far below that of doubles; it counts where theta* is 0 to all digits.
        largest = max(abs(x) for row in self.reward for x in row)
        surprise = max(abs(mp.log(x)) for row in self.prior for x in row)
        self.rounding = mpf(10) ** (15 - DIGITS[0]) * (largest + surprise / self.beta)

    # -- a policy's worth

    def worth(self, policy: np.ndarray) -> mpf:
        """J(policy) from the start, for a table [S, A]; 50 digits but for cancellation among rewards."""
        self._at(DIGITS[0])
        pi = [shares(row) for row in policy]
        used = [[a for a in range(self.n_actions) if pi[s][a]] for s in range(self.n_states)]
        successors = [{t for a in used[s] for t in self.support[s][a]} for s in range(self.n_states)]
        states = reached(successors, [int(s) for s in np.flatnonzero(self.given.start)])
        rows: dict[int, Row] = {}
        one_step = {}
        for s in states:
            rows[s] = {}
            for a in used[s]:
                for t, p in self.p[s][a].items():
                    rows[s][t] = rows[s].get(t, mpf(0)) + pi[s][a] * p
            one_step[s] = mp.fsum(
                pi[s][a] * (self.reward[s][a] - mp.log(pi[s][a] / self.prior[s][a]) / self.beta) for a in used[s]
            )
        known: dict[int, mpf] = {}
        for inside in components(successors):
            if inside[0] in rows and all(successors[s] <= set(inside) for s in inside):
                g, _ = relative_value({s: rows[s] for s in inside}, one_step)
                known |= dict.fromkeys(inside, g)
        known = ended_in({s: rows[s] for s in states if s not in known}, known)
        start = shares(self.given.start)
        return mp.fsum(start[s] * known[s] for s in states if start[s])

    # -- the best rate

    def end_components(self) -> list[tuple[list[int], list[list[int]]]]:
        """Maximal ones: (states, for each state of the problem the actions that stay inside)."""
        found = []
        todo = [set(range(self.n_states))]
        allowed = [set(range(self.n_actions)) for _ in range(self.n_states)]
        while todo:
            inside = todo.pop()
            while True:
                for s in inside:
                    allowed[s] = {a for a in allowed[s] if set(self.support[s][a]) <= inside}
                kept = {s for s in inside if allowed[s]}
                if kept == inside:
                    break
                inside = kept
            if not inside:
                continue
            successors: list[set[int]] = [set() for _ in range(self.n_states)]
            for s in inside:
                successors[s] = {t for a in allowed[s] for t in self.support[s][a]}
            parts = [part for part in components(successors) if part[0] in inside]
            if len(parts) == 1:
                found.append((sorted(inside), [sorted(a) for a in allowed]))
            else:
                todo += [set(part) for part in parts]
        return found

    def rate(self, value: np.ndarray | None = None) -> Rate:
        """g* of every state that can be reached. ``value`` [S]: where Newton starts, if all is one component.

        Raises NoRateError.
        """
        start = [int(s) for s in np.flatnonzero(self.given.start)]
        everywhere = [{t for row in self.support[s] for t in row} for s in range(self.n_states)]
        states = reached(everywhere, start)
        ends = []
        for inside, actions in self.end_components():
            if set(inside) & set(states):
                begin = None
                if value is not None and len(inside) == len(states) and np.isfinite(value).all():
                    begin = value
                ends.append((inside, *self._component(inside, actions, begin)))
        seen = max(ends, key=lambda end: end[1])[3]
        self._at(DIGITS[0])
        low = self._stopping(states, [(inside, low) for inside, low, _, _ in ends])
        high = self._stopping(states, [(inside, high) for inside, _, high, _ in ends])
        of_start = shares(self.given.start)
        return Rate(
            [low[s] for s in states],
            [high[s] for s in states],
            states,
            mp.fsum(of_start[s] * low[s] for s in start),
            mp.fsum(of_start[s] * high[s] for s in start),
            seen,
        )

    def gains(
        self, inside: list[int], actions: list[list[int]], value: dict[int, mpf], beta: mpf
    ) -> tuple[dict[int, mpf], dict[int, dict[int, mpf]]]:
        """(TV - V, pi_V) on ``inside``, over ``actions`` alone."""
        gain, policy = {}, {}
        for s in inside:
            q = {
                a: self.reward[s][a] + mp.fsum(p * (value[t] - value[s]) for t, p in self.p[s][a].items())
                for a in actions[s]
            }
            top = max(q.values())
            weight = {a: self.prior[s][a] * mp.exp(beta * (x - top)) for a, x in q.items()}
            total = mp.fsum(weight.values())
            gain[s] = top + mp.log(total) / beta
            policy[s] = {a: x / total for a, x in weight.items()}
        return gain, policy

    def _component(self, inside: list[int], actions: list[list[int]], begin: np.ndarray | None) -> tuple[mpf, mpf, mpf]:
        """(low, high, mean |r| met) of an end component."""
        for digits in DIGITS:
            self._at(digits)
            for at in (begin, None) if begin is not None else (None,):
                if at is None:
                    value = {s: mpf(0) for s in inside}
                    sizes = [abs(self.reward[s][a]) for s in inside for a in actions[s]]
                    beta = min(self.beta, 1 / max(max(sizes), mpf(10) ** -30))
                else:
                    value, beta = {s: mpf(float(at[s])) for s in inside}, self.beta
                while True:
                    final = beta == self.beta
                    found = self._newton(inside, actions, value, beta, SHARP if final else mpf("0.01"))
                    if final or found is None:
                        break
                    value, beta = found[0], min(8 * beta, self.beta)
                if found is not None:
                    _, low, high, seen = found
                    return low - self.rounding, high + self.rounding, seen
        raise NoRateError(f"{len(inside)} states")

    def _newton(
        self, inside: list[int], actions: list[list[int]], value: dict[int, mpf], beta: mpf, sharp: mpf
    ) -> tuple[dict[int, mpf], mpf, mpf, mpf] | None:
        """(value, low, high, mean |r| met), or None where the bounds cease to approach each other."""
        widths: list[mpf] = []
        while True:
            gain, policy = self.gains(inside, actions, value, beta)
            low, high = min(gain.values()), max(gain.values())
            rows: dict[int, Row] = {}
            size = {}
            for s in inside:
                rows[s] = {}
                for a in actions[s]:
                    for t, p in self.p[s][a].items():
                        rows[s][t] = rows[s].get(t, mpf(0)) + policy[s][a] * p
                size[s] = mp.fsum(policy[s][a] * abs(self.reward[s][a]) for a in actions[s])
            width = high - low
            if width <= sharp * max(abs(low), abs(high)):
                return value, low, high, relative_value(rows, size)[0]
            widths.append(width)
            if len(widths) > 80 or (len(widths) > 8 and min(widths[-8:]) > min(widths[:-8]) / 2):
                return None
            step = relative_value(rows, gain)[1]
            if max(abs(x) for x in step.values()) > mpf(10) ** 2000:  # a policy that all but never leaves a bad set
                return None
            value = {s: value[s] + step[s] for s in inside}

    def _stopping(self, states: list[int], ends: list[tuple[list[int], mpf]]) -> dict[int, mpf]:
        """Largest mean of the components' rates, from each state: policy iteration, a component being one node."""
        node = {s: s for s in states}
        rate = {}
        for inside, g in ends:
            node |= dict.fromkeys(inside, inside[0])
            rate[inside[0]] = g
        choices: dict[int, list[Row]] = {}
        for s in states:
            for a in range(self.n_actions):
                row: Row = {}
                for t, p in self.p[s][a].items():
                    if node[t] != node[s]:
                        row[node[t]] = row.get(node[t], mpf(0)) + p
                if row:
                    choices.setdefault(node[s], []).append(row)
        stop = dict(rate)
        chosen: dict[int, Row] = {s: rows[0] for s, rows in choices.items() if s not in rate}
        while True:
            x = ended_in(chosen, stop)
            better = False
            for s, rows in choices.items():
                for row in rows:
                    new = mp.fsum(p * x[t] for t, p in row.items()) / mp.fsum(row.values())
                    if new > x[s] + mpf(10) ** -30 * max(abs(new), abs(x[s])):
                        chosen[s], better = row, True
                        stop.pop(s, None)
                        x[s] = new
            if not better:
                return {s: x[node[s]] for s in states}


# -- problems ---------------------------------------------------------------------------------------------------


def _rows(rng: np.random.Generator, n: int, a: int) -> np.ndarray:
    p = rng.dirichlet(np.full(n, 10.0 ** rng.uniform(-1, 1)), (n, a))
    p[p < 1e-12] = 0.0
    if n > 2 and rng.random() < 0.5:
        p[rng.random(p.shape) < rng.uniform(0, 0.8)] = 0.0
    p[np.arange(n), :, (np.arange(n) + 1) % n] += 0.01  # a way round: one class
    return np.asarray(p / p.sum(2, keepdims=True))


def _size(rng: np.random.Generator) -> int:
    return int(rng.integers(1, 9) if rng.random() < 0.95 else rng.integers(9, 61))


def _small(rng: np.random.Generator, shape: tuple[int, ...], furthest: float) -> np.ndarray:
    """10^-x with x uniform up to a bound that is itself drawn."""
    return np.asarray(10.0 ** -rng.uniform(0, rng.choice([3.0, 17.0, furthest]), shape))


def _plain(rng: np.random.Generator, n: int | None = None) -> Given:
    n = n or _size(rng)
    a = int(rng.integers(1, 5))
    prior = rng.dirichlet(np.ones(a), n) + 1e-3 if rng.random() < 0.5 else np.ones((n, a))
    start = rng.dirichlet(np.ones(n)) if rng.random() < 0.5 else np.eye(n)[rng.integers(n)]
    reward = rng.normal(size=(n, a)) * 10.0 ** rng.uniform(-1, 1)
    beta = 10.0 ** rng.uniform(-3, 4)
    return Given("plain", _rows(rng, n, a), reward, prior / prior.sum(1, keepdims=True), start, beta)


def _with(given: Given, **changed: Any) -> Given:
    return Given(**{**given.__dict__, **changed})


def one_state(rng: np.random.Generator) -> Given:
    return _plain(rng, 1)


def small_prior(rng: np.random.Generator) -> Given:
    given = _plain(rng)
    prior = _small(rng, given.prior.shape, 300.0)
    prior[np.arange(len(prior)), rng.integers(0, prior.shape[1], len(prior))] = 1.0
    given = _with(given, prior=prior / prior.sum(1, keepdims=True))
    if rng.random() < 0.7:  # the rarer the action, the more it pays: both may matter
        given = _with(given, reward=given.reward - rng.uniform(0, 2) * np.log(given.prior) / given.beta)
    return given


def _joined(rng: np.random.Generator, depth: int) -> np.ndarray:
    """[n, n], sets within sets, each left with its own small probability."""
    if depth == 0:
        n = int(rng.integers(1, 4))
        return np.asarray(rng.dirichlet(np.ones(n), n))
    parts = [_joined(rng, depth - 1) for _ in range(2)]
    k, n = len(parts[0]), len(parts[0]) + len(parts[1])
    p = np.zeros((n, n))
    p[:k, :k], p[k:, k:] = parts
    out = 10.0 ** -rng.uniform(0, rng.choice([4.0, 20.0, 300.0]))
    p[rng.integers(k), rng.integers(k, n)] = out
    p[rng.integers(k, n), rng.integers(k)] = min(out * 10.0 ** rng.uniform(-1, 1), 1.0)
    return p


def _nearly_closed(rng: np.random.Generator, depth: int) -> Given:
    pattern = _joined(rng, depth)
    given = _plain(rng, len(pattern))
    p = np.repeat(pattern[:, None], given.reward.shape[1], 1) * rng.uniform(0.5, 1.5, given.transition.shape)
    if rng.random() < 0.4:  # one action moves freely
        p[:, -1] = given.transition[:, -1]
    return _with(given, transition=p / p.sum(2, keepdims=True))


def nearly_closed(rng: np.random.Generator) -> Given:
    return _nearly_closed(rng, 1)


def nested(rng: np.random.Generator) -> Given:
    return _nearly_closed(rng, 2)


def stay_or_go(rng: np.random.Generator) -> Given:
    """The last action moves; the others stay but for escapes."""
    given = _plain(rng, int(rng.integers(2, 6)))
    n, a = given.reward.shape
    p = given.transition.copy()
    for s in range(n):
        for b in range(a - 1):
            p[s, b] = np.eye(n)[s]
            p[s, b, (s + 1 + rng.integers(n - 1)) % n] += _small(rng, (), 300.0)
    return _with(given, transition=p / p.sum(2, keepdims=True))


def periodic(rng: np.random.Generator) -> Given:
    given = _plain(rng, max(2, _size(rng)))
    n = len(given.reward)
    period = int(rng.integers(2, n + 1))
    phase = np.arange(n) % period
    p = given.transition * (phase[None, None] == (phase[:, None, None] + 1) % period)
    p[np.arange(n), :, (np.arange(n) + 1) % n] += (phase[(np.arange(n) + 1) % n] == (phase + 1) % period)[:, None]
    p[p.sum(2) == 0] = np.eye(n)[0]
    return _with(given, transition=p / p.sum(2, keepdims=True))


def ties(rng: np.random.Generator) -> Given:
    given = _plain(rng)
    n, a = given.reward.shape
    p = np.repeat(given.transition[:, :1], a, 1) if rng.random() < 0.5 else given.transition
    reward = rng.integers(0, 2, (n, a)).astype(float)
    return _with(given, transition=p, reward=reward, prior=np.full((n, a), 1 / a))


def mixed_rewards(rng: np.random.Generator) -> Given:
    given = _plain(rng)
    return _with(given, reward=rng.normal(size=given.reward.shape) * 10.0 ** rng.uniform(-6, 9, given.reward.shape))


def penalty(rng: np.random.Generator) -> Given:
    given = _plain(rng)
    reward = given.reward.copy()
    reward.flat[rng.integers(reward.size)] = -(10.0 ** rng.choice([9, 12]))
    return _with(given, reward=reward)


def single_precision(rng: np.random.Generator) -> Given:
    given = _plain(rng)

    def softmax(shape: tuple[int, ...]) -> np.ndarray:
        x = np.exp(rng.normal(scale=2, size=shape).astype(np.float32))
        return np.asarray(x / x.sum(-1, keepdims=True, dtype=np.float32))

    start = given.start.astype(np.float32)
    return _with(given, transition=softmax(given.transition.shape), prior=softmax(given.prior.shape), start=start)


def nine_digits(rng: np.random.Generator) -> Given:
    given = _plain(rng)
    printed: Callable[[np.ndarray], np.ndarray] = np.vectorize(lambda x: float(f"{x:.9g}"))
    p = given.transition.round(9) if rng.random() < 0.5 else printed(given.transition)
    return _with(given, transition=p, prior=printed(given.prior), start=printed(given.start))


def deterministic(rng: np.random.Generator) -> Given:
    given = _plain(rng)
    n, a = given.reward.shape
    to = rng.integers(0, n, (n, a))
    to[:, 0] = (np.arange(n) + 1) % n  # all one class
    return _with(given, transition=np.eye(n)[to])


def corridor(rng: np.random.Generator) -> Given:
    n = int(rng.integers(5, 15) if rng.random() < 0.8 else rng.integers(15, 61))
    given = _plain(rng, n)
    a = given.reward.shape[1]
    p = np.zeros((n, a, n))
    weight = rng.uniform(0.02, 1, (a, 3))  # back, rest, on; a drift against the reward makes the far end rare
    for s in range(n):
        for j, to in enumerate((max(s - 1, 0), s, min(s + 1, n - 1))):
            p[s, :, to] += weight[:, j]
    reward = np.zeros((n, a))
    reward[-1] = 1.0
    reward -= 0.01 * np.arange(a)
    return _with(given, transition=p / p.sum(2, keepdims=True), reward=reward, start=np.eye(n)[0])


def transient(rng: np.random.Generator) -> Given:
    given = _plain(rng, max(2, _size(rng)))
    n = len(given.reward)
    k = int(rng.integers(1, n))  # states below k are never met again once they are left
    p = given.transition.copy()
    p[k:, :, :k] = 0.0
    p[k:, :, k] += 0.1
    p[0, 0, k] += _small(rng, (), 300.0)
    if rng.random() < 0.5:  # and may be stayed in
        p[rng.integers(k), -1] = np.eye(n)[0]
    return _with(given, transition=p / p.sum(2, keepdims=True), start=np.eye(n)[0])


def several_classes(rng: np.random.Generator) -> Given:
    given = _plain(rng, max(3, _size(rng)))
    n = len(given.reward)
    k = int(rng.integers(2, n))  # {1..k-1} and {k..n-1} are closed, 0 leads to both
    p = given.transition.copy()
    p[1:k, :, k:] = p[1:k, :, :1] = p[k:, :, :k] = 0.0
    p[1:k, :, 1] += 0.1
    p[k:, :, k] += 0.1
    p[0, :, 1] += _small(rng, (), 20.0)
    p[0, :, k] += _small(rng, (), 20.0)
    start = np.eye(n)[0] if rng.random() < 0.5 else given.start
    return _with(given, transition=p / p.sum(2, keepdims=True), start=start)


def far_temperature(rng: np.random.Generator) -> Given:
    return _with(_plain(rng), beta=float(rng.choice([1e-6, 1e-5, 1e5, 1e6])))


def constant_reward(rng: np.random.Generator) -> Given:
    given = _plain(rng)
    return _with(given, reward=np.full(given.reward.shape, rng.choice([0.0, 1.0, -3.3, 1e-6, 1e9])))


def everything(rng: np.random.Generator) -> Given:
    given = _nearly_closed(rng, int(rng.integers(0, 3)))
    shape = given.reward.shape
    prior = _small(rng, shape, 300.0)
    prior[:, rng.integers(shape[1])] = 1.0
    reward = rng.normal(size=shape) * 10.0 ** (rng.uniform(-6, 9, shape) if rng.random() < 0.5 else rng.uniform(-1, 1))
    return _with(given, prior=prior / prior.sum(1, keepdims=True), reward=reward, beta=10.0 ** rng.uniform(-6, 6))


def plain(rng: np.random.Generator) -> Given:
    return _plain(rng)


KINDS: tuple[Callable[[np.random.Generator], Given], ...] = (
    plain,
    one_state,
    small_prior,
    nearly_closed,
    nested,
    stay_or_go,
    periodic,
    ties,
    mixed_rewards,
    penalty,
    single_precision,
    nine_digits,
    deterministic,
    corridor,
    transient,
    several_classes,
    far_temperature,
    constant_reward,
    everything,
)


def problem(seed: int, number: int) -> Given:
    """Problem ``number`` of a seed; the kinds take turns."""
    make = KINDS[number % len(KINDS)]
    return _with(make(np.random.default_rng([seed, number])), kind=make.__name__)


def policies(given: Given, best: np.ndarray, seed: int) -> dict[str, np.ndarray]:
    """A random one, its rows in single precision, a greedy one of ``best`` [S, A], the one that stays put where it can,
    and that one with a chance of some 1e-180 of anything else; each [S, A]."""
    n, a = given.reward.shape
    own = given.transition[np.arange(n), :, np.arange(n)]
    rng = np.random.default_rng([seed, 1])
    random, stay = rng.dirichlet(np.ones(a), n), np.eye(a)[own.argmax(1)]
    return {
        "random": random,
        "single precision": random.astype(np.float32).astype(np.float64),
        "greedy": np.eye(a)[best.argmax(1)],
        "stay": stay,
        "all but stay": np.where(stay > 0, 1.0, 10.0 ** -rng.uniform(160, 200, (n, a))),
    }
