"""Ends of episodes: which are failures, and what a charge or a bonus makes of the rewards. Pure functions.

The objective is an average over an endless process in which an end leads to the next start. Where every step pays
the same, CartPole's +1 or MountainCar's -1, such an average is constant, and nothing can be learnt: the end itself must
count. ``end_reward`` is added to the reward of the step that ends an episode:

    a charge, end_reward < 0, at the ends that are failures;
    a bonus, end_reward > 0, at the others, which are successes.

Which ends are failures is the user's to say, by a rule, ``failures``:

    default  those whose step pays at most 0, where some other end pays more: FrozenLake's holes; none in CliffWalking,
             Taxi and MountainCar, which end in success only, and none in CartPole, which pays its falls too. Every
             end, where the best of them pays at most 0 and less than a step that goes on does in the mean: then the
             best is only less bad, and no success
    unpaid   those whose step pays at most 0
    all      every end: CartPole
    none     no end
    a list   ends in these states (the state that the ending step leads to)

A truncated episode has not ended.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from erl_torch import checks
from erl_torch.checks import InputError

RULES = ("default", "unpaid", "all", "none")
Rule = str | Sequence[int]
ROUNDING = 1e-9  # relative, of mean rewards
UNPAID = float(np.nextafter(0.0, 1.0))  # a step that pays less than this pays at most 0


@dataclass(frozen=True)
class Failures:
    """A rule for one environment: the ends in ``states``; where that is None, those that pay less than ``limit``."""

    limit: float
    states: tuple[int, ...] | None = None

    @classmethod
    def of(cls, rule: Rule, best: float | None, n_states: int, going_on: float = -np.inf) -> Failures:
        """``rule`` where the best end pays ``best``, None is not known, and a step that does not end an episode
        ``going_on``, in the mean; -infinite is not known.

        Raises InputError for another rule, for the default where ``best`` is not known, and for states out of range.
        """
        if not isinstance(rule, str):
            states = [checks.at_least("failures", s, 0) for s in checks.sequence("failures", rule)]
            for s in states:
                if s >= n_states:
                    raise InputError("failures", s, f"states in [0, {n_states})")
            return cls(-np.inf, tuple(sorted(set(states))))
        checks.one_of("failures", rule, RULES)
        if rule == "default":
            if best is None:
                allowed = "unpaid, all, none, or a list of states: the environment does not tell beforehand how it ends"
                raise InputError("failures", rule, allowed)
            worse = best < going_on - ROUNDING * max(1.0, abs(best), abs(going_on))
            return cls(np.inf if np.isfinite(best) and best <= 0 and worse else min(best, UNPAID))
        return cls({"unpaid": UNPAID, "all": np.inf, "none": -np.inf}[rule])

    def __str__(self) -> str:
        """Which ends they are, in words."""
        if self.states is not None:
            return f"the ends in states {', '.join(map(str, self.states))}" if self.states else "no end"
        if np.isinf(self.limit):
            return "every end" if self.limit > 0 else "no end"
        return "the ends that pay at most 0" if self.limit == UNPAID else f"the ends that pay less than {self.limit:g}"

    @property
    def every(self) -> bool:
        """Whether every end is a failure, so that an episode succeeds by not ending."""
        return self.states is None and self.limit == np.inf

    def among(self, reward: ArrayLike, state: ArrayLike) -> np.ndarray:
        """[N] bool: which of N ends are failures, by the ``reward`` of the ending step and the ``state`` it led to."""
        if self.states is not None:
            return np.asarray(np.isin(np.asarray(state), self.states))
        return np.asarray(np.asarray(reward) < self.limit)


class EndRule(NamedTuple):
    """What the ends of an environment's episodes count."""

    failures: Failures
    end_reward: float = 0.0

    def of(self, reward: float, state: int) -> tuple[bool, float]:
        """(whether the end is a failure, what is added to the reward of its step)."""
        failed = bool(self.failures.among(reward, state))
        return failed, self.end_reward if failed == (self.end_reward < 0) else 0.0

    def __str__(self) -> str:
        """What is added to which ends, in words."""
        failures = str(self.failures)
        if self.end_reward < 0:
            which = failures
        elif failures == "no end":
            which = "every end"
        else:
            which = f"all but {failures}"
        return f"{self.end_reward:+g} at {which}"


def failing_ends(
    reward: ArrayLike, terminated: ArrayLike, state: ArrayLike, n_states: int, failures: Rule = "default"
) -> np.ndarray:
    """[N] bool: the steps of a log that end an episode in failure.

    Args:
        reward: [N].
        terminated: [N] bool; a truncated episode has not ended.
        state: [N], that each step led to (of an ending step: the state where it ended, not the next start).
        n_states: whole number >= 1.
        failures: the rule; the best end of the log, and its mean step, are what "default" compares with.

    Raises:
        InputError: as ``Failures.of``, or columns of different lengths.
    """
    r, over, s = np.asarray(reward, np.float64), np.asarray(terminated, bool), np.asarray(state)
    if not r.shape == over.shape == s.shape or r.ndim != 1:
        raise InputError("terminated", f"array of shape {over.shape}", f"of the shape of reward and state, {r.shape}")
    best = float(r[over].max()) if over.any() else -np.inf
    going_on = float(r[~over].mean()) if not over.all() else -np.inf
    return np.asarray(over & Failures.of(failures, best, n_states, going_on).among(r, s))


def with_end_reward(reward: ArrayLike, ended: ArrayLike, failed: ArrayLike, end_reward: float) -> np.ndarray:
    """``reward`` with a charge where ``failed``, or a bonus where ``ended`` and not ``failed``; arrays of one shape.

    ``ended`` and ``failed`` may be truth values of steps, or probabilities of pairs (s,a).

    Raises:
        InputError: an end_reward that is not finite, or that no end gets.
    """
    end_reward = checks.finite("end_reward", end_reward)
    r, over, fails = (np.asarray(x, np.float64) for x in (reward, ended, failed))
    share = fails if end_reward < 0 else over - fails
    if end_reward and not share.any():
        if not over.any():
            allowed = "0: no step ends an episode"
        elif end_reward < 0:
            allowed = "0, or a bonus > 0: no end is a failure by this rule (failures=all charges every end)"
        else:
            allowed = "0, or a charge < 0: every end is a failure by this rule (failures=none: each is a success)"
        raise InputError("end_reward", end_reward, allowed)
    return r + end_reward * share


def chance_of_pairs(s: ArrayLike, a: ArrayLike, happened: ArrayLike, n_states: int, n_actions: int) -> np.ndarray:
    """[S, A]: the share of the visits to each pair at which something ``happened`` [N] bool; 0 where there is none."""
    pair = np.asarray(s, np.int64) * n_actions + np.asarray(a, np.int64)
    visits = np.bincount(pair, minlength=n_states * n_actions)
    counted: Any = np.bincount(pair, np.asarray(happened, np.float64), n_states * n_actions)
    return np.asarray((counted / np.maximum(visits, 1)).reshape(n_states, n_actions))
