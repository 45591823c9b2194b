"""Random problems of every optimism, and what is true of them: many digits, nothing shared with the package.

``problem(seed, number)`` is deterministic. ``Oracle`` solves it in mpmath from the definitions: Newton on V + g = TV
(below optimism 0, where that fails: the agent's policy and nature's reply in turn), ended by
min(TV - V) <= g <= max(TV - V) in as many digits as it takes. The chains' equations are eliminated without a
subtraction (``many_digits``).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from many_digits import Given, Row, relative_value, shares
from mpmath import mp, mpf

OPTIMISMS = (3.0, 1.0, 0.5, 0.0, -0.5, -1.0, -3.0, -10.0)
KINDS = ("dense", "sparse", "periodic", "deterministic", "nearly closed")
DIGITS = (60, 150, 400)
SHARP = mpf(10) ** -25  # width of the bounds on g, relative to the rewards
FAR = mpf(10) ** 30  # of a value
STEPS = 60


class Answer(NamedTuple):
    """low <= g* <= high for every start; they meet where there is a single rate."""

    low: mpf
    high: mpf
    value: list[mpf]
    met: bool


class At(NamedTuple):
    """What an operator makes of a value."""

    gain: list[mpf]
    rows: dict[int, Row]  # its derivative: a chain, off its diagonal


def problem(seed: int, number: int) -> tuple[Given, float]:
    """(a problem in which every state leads to every other, optimism)."""
    rng = np.random.default_rng([seed, number])
    optimism, kind = OPTIMISMS[number % len(OPTIMISMS)], KINDS[number // len(OPTIMISMS) % len(KINDS)]
    n, n_actions = int(rng.integers(2, 8)), int(rng.integers(1, 5))
    n += (n % 2) * (kind == "periodic" and 1)
    n -= 2 * (n > 7)
    p = np.zeros((n, n_actions, n))
    after = (np.arange(n) + 1) % n
    if kind == "dense":
        p += rng.dirichlet(np.full(n, 10.0 ** rng.uniform(-0.5, 1)), (n, n_actions)) + 1e-4
    elif kind == "nearly closed":
        half = np.arange(n) < rng.integers(1, n)
        across = 10.0 ** rng.uniform(-8, -1)
        p += rng.dirichlet(np.ones(n), (n, n_actions)) + 1e-3
        p *= np.where(half[:, None, None] == half, 1.0, across)
    elif kind == "deterministic":
        p[np.arange(n)[:, None], np.arange(n_actions), rng.integers(0, n, (n, n_actions))] = 1.0
        p[:, 0] = np.eye(n)[after]
    else:
        for s in range(n):
            others = np.arange((s + 1) % 2, n, 2) if kind == "periodic" else np.arange(n)
            for a in range(n_actions):
                p[s, a, rng.choice(others, min(2, len(others)), replace=False)] = 0.2 + rng.random()
        p[np.arange(n), 0, after] += 0.3
    prior = 0.9 * rng.dirichlet(np.full(n_actions, 2.0), n) + 0.1 / n_actions
    beta = float(np.exp(rng.uniform(np.log(0.1), np.log(30.0))))
    p /= p.sum(2, keepdims=True)
    reward = rng.standard_normal((n, n_actions))
    return Given(kind, p, reward, prior / prior.sum(1, keepdims=True), np.full(n, 1.0 / n), beta), optimism


class Oracle:
    """Of one problem; kappa is optimism times beta as a double."""

    def __init__(self, given: Given, optimism: float) -> None:
        self.given, self.optimism = given, optimism
        self.n_states, self.n_actions = given.reward.shape
        self._at(DIGITS[0])

    def _at(self, digits: int) -> None:
        mp.dps = digits
        given = self.given
        self.p = [
            [{t: x for t, x in enumerate(shares(row)) if x} for row in given.transition[s]]
            for s in range(self.n_states)
        ]
        self.reward = [[mpf(float(x)) for x in row] for row in given.reward]
        self.prior = [shares(row) for row in given.prior]

    def solve(self) -> Answer:
        """g* with bounds that meet, or (below optimism 0 alone) the narrowest that were found."""
        beta = mpf(self.given.beta)
        for digits in DIGITS if self.optimism >= 0 else DIGITS[:2]:
            self._at(digits)
            value, at = [mpf(0)] * self.n_states, min(beta, mpf(1))
            while True:
                answer = self._newton(value, at, None, SHARP if at == beta else mpf("0.01"))
                if at == beta:
                    break
                value, at = answer.value if answer.met else value, min(8 * at, beta)
            if not answer.met and self.optimism < 0:
                answer = self._in_turn(answer)
            if answer.met:
                return answer
        return answer

    def worth(self, policy: np.ndarray, value: list[mpf]) -> Answer:
        """Bounds on J(policy) (nested), by Newton from ``value``."""
        return self._newton(value, mpf(self.given.beta), [shares(row) for row in policy], SHARP)

    def gains(self, value: list[mpf], beta: mpf, policy: list[list[mpf]] | None) -> At:
        """TV - V, or with a policy T_pi V - V, with the chain of (pi, q_V)."""
        kappa = mpf(self.optimism * self.given.beta) * (beta / mpf(self.given.beta))
        y = [mp.exp(kappa * x) for x in value]
        gain, rows = [], {}
        for s in range(self.n_states):
            worth, tilted = [], []
            for a in range(self.n_actions):
                p = self.p[s][a]
                if kappa:
                    weight = {t: x * y[t] for t, x in p.items()}
                    total = mp.fsum(weight.values())
                    worth.append(self.reward[s][a] + mp.log(total / y[s]) / kappa)
                    tilted.append({t: x / total for t, x in weight.items()})
                else:
                    worth.append(self.reward[s][a] + mp.fsum(x * (value[t] - value[s]) for t, x in p.items()))
                    tilted.append(p)
            if policy is None:
                top = max(worth)
                pi = [x * mp.exp(beta * (w - top)) for x, w in zip(self.prior[s], worth, strict=True)]
                total = mp.fsum(pi)
                gain.append(top + mp.log(total) / beta)
                pi = [x / total for x in pi]
            else:
                pi = policy[s]
                pairs = zip(pi, self.prior[s], worth, strict=True)
                gain.append(mp.fsum(x * (w - mp.log(x / x0) / beta) for x, x0, w in pairs if x))
            rows[s] = {}
            for x, row in zip(pi, tilted, strict=True):
                for t, chance in row.items():
                    if t != s and x:
                        rows[s][t] = rows[s].get(t, mpf(0)) + x * chance
        return At(gain, rows)

    def policy(self, value: list[mpf], beta: mpf) -> list[list[mpf]]:
        """pi_V."""
        kappa = mpf(self.optimism * self.given.beta)
        y = [mp.exp(kappa * x) for x in value]
        found = []
        for s in range(self.n_states):
            worth = [
                self.reward[s][a] + mp.log(mp.fsum(x * y[t] for t, x in self.p[s][a].items())) / kappa
                for a in range(self.n_actions)
            ]
            top = max(worth)
            pi = [x * mp.exp(beta * (w - top)) for x, w in zip(self.prior[s], worth, strict=True)]
            found.append([x / mp.fsum(pi) for x in pi])
        return found

    def _newton(self, value: list[mpf], beta: mpf, policy: list[list[mpf]] | None, sharp: mpf) -> Answer:
        """The bounds of each step hold together; the value is the last one."""
        low, high, widths = -mp.inf, mp.inf, []
        for _ in range(STEPS):
            at = self.gains(value, beta, policy)
            low, high = max(low, min(at.gain)), min(high, max(at.gain))
            widths.append(max(at.gain) - min(at.gain))
            if widths[-1] <= sharp:
                return Answer(min(at.gain), max(at.gain), value, True)
            if len(widths) > 12 and min(widths[-12:]) > min(widths[:-12]) / 2:
                break
            step = relative_value(at.rows, dict(enumerate(at.gain)))[1]
            new = [x + step[s] for s, x in enumerate(value)]
            if max(abs(x) for x in new) > FAR**2:  # a policy that all but never leaves a bad set
                break
            value = [x - new[0] for x in new]
        return Answer(low, high, value, False)

    def _in_turn(self, best: Answer) -> Answer:
        """Nature's reply to a policy, exactly, then the agent's to that (Hoffman and Karp); J never falls."""
        beta = mpf(self.given.beta)
        value = [mpf(0)] * self.n_states
        low, high = best.low, best.high
        for _ in range(STEPS):
            value = self._newton(value, beta, self.policy(value, beta), SHARP).value
            gain = self.gains(value, beta, None).gain
            low, high = max(low, min(gain)), min(high, max(gain))
            if max(gain) - min(gain) <= SHARP:
                return Answer(min(gain), max(gain), value, True)
            if max(abs(x) for x in value) > mpf(10) ** 6:
                break
        return Answer(low, high, value, False)

    # -- the game, for optimism < 0

    def game(self) -> tuple[mpf, mpf]:
        """(what the agent can secure, what nature can hold it to), of the game behind optimism < 0: g* is in between.

        Policy iteration for each side against the other's fixed reply. It knows distributions, what nature pays for
        them, KL(q || p)/|kappa|, and the linear equations of (pi, q), but no certainty equivalent. Infinite where a
        reply all but closes a set of states, so that values run away.
        """
        self._at(DIGITS[0])
        policy, q = self.prior, self.p
        secured = -mp.inf
        for _ in range(STEPS):
            least = mp.inf
            for _ in range(STEPS):
                g, value = self._rate(policy, q)
                if max(abs(x) for x in value.values()) > FAR:
                    return -mp.inf, mp.inf
                q = self._reply(value)
                if least - g <= SHARP:
                    break
                least = g
            if least - secured <= SHARP:
                break
            secured = least
            policy = self._best(q, value)
        most = -mp.inf
        for _ in range(STEPS):
            g, value = self._rate(policy, q)
            if max(abs(x) for x in value.values()) > FAR:
                return secured, mp.inf
            policy = self._best(q, value)
            if g - most <= SHARP:
                break
            most = g
        return secured, most

    def _paid(self, q: list[list[Row]], s: int, a: int) -> mpf:
        """r and what nature pays."""
        kappa = mpf(self.optimism * self.given.beta)
        surprise = mp.fsum(x * mp.log(x / self.p[s][a][t]) for t, x in q[s][a].items())
        return self.reward[s][a] - surprise / kappa

    def _rate(self, policy: list[list[mpf]], q: list[list[Row]]) -> tuple[mpf, dict[int, mpf]]:
        rows: dict[int, Row] = {s: {} for s in range(self.n_states)}
        reward = {}
        for s in range(self.n_states):
            steps = []
            for a, (x, x0) in enumerate(zip(policy[s], self.prior[s], strict=True)):
                steps.append(x * (self._paid(q, s, a) - mp.log(x / x0) / mpf(self.given.beta)))
                for t, chance in q[s][a].items():
                    if t != s:
                        rows[s][t] = rows[s].get(t, mpf(0)) + x * chance
            reward[s] = mp.fsum(steps)
        return relative_value(rows, reward)

    def _reply(self, value: dict[int, mpf]) -> list[list[Row]]:
        """Nature's: argmin of q V + KL(q || p)/|kappa|."""
        kappa = mpf(self.optimism * self.given.beta)
        y = {t: mp.exp(kappa * x) for t, x in value.items()}
        weights = [[{t: x * y[t] for t, x in row.items()} for row in rows] for rows in self.p]
        return [[{t: x / mp.fsum(row.values()) for t, x in row.items()} for row in rows] for rows in weights]

    def _best(self, q: list[list[Row]], value: dict[int, mpf]) -> list[list[mpf]]:
        """The agent's policy against q."""
        found = []
        for s in range(self.n_states):
            worth = [
                self._paid(q, s, a) + mp.fsum(x * value[t] for t, x in q[s][a].items()) for a in range(self.n_actions)
            ]
            top = max(worth)
            pi = [x * mp.exp(mpf(self.given.beta) * (w - top)) for x, w in zip(self.prior[s], worth, strict=True)]
            found.append([x / mp.fsum(pi) for x in pi])
        return found
