"""Bounds, gaps, objectives and statuses of a few hundred problems made to break them, against many digits.

The problems, the oracle and what counts as a violation: ``many_digits.py`` and ``benchmarks/adversarial.py``, which
runs ten thousand.
"""

import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from many_digits import KINDS, Given, Oracle, problem
from mpmath import mp, mpf

from erl_torch import solve_biasing

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

import adversarial

EACH = 8  # problems of a kind


@pytest.fixture(autouse=True)
def digits():
    with mp.workdps(50):
        yield


@pytest.mark.slow
@pytest.mark.parametrize("kind", range(len(KINDS)), ids=lambda kind: KINDS[kind].__name__)
def test_nothing_that_is_called_proven_is_wrong(kind, monkeypatch):
    """Both solvers, ``certify`` of five policies, and three routes to the objective."""
    # Iterations that lead nowhere take seconds.
    monkeypatch.setitem(adversarial.SOLVERS, "biasing", partial(solve_biasing, max_steps=8))
    checked = 0
    for number in range(kind, EACH * len(KINDS), len(KINDS)):
        found = adversarial.examine(problem(1, number), 1)
        assert found["wrong"] == [], f"python benchmarks/adversarial.py seed=1 one={number}"
        assert "refused" not in found
        checked += "no_oracle" not in found
    assert checked >= EACH - 1


# -- the oracle itself, in closed form --------------------------------------------------------------------------


def close(found, true, digits=20):
    return abs(found - true) <= mpf(10) ** -digits * abs(true)


def test_oracle_of_one_state():
    prior = np.array([[1e-200, 1.0, 0.25]])
    given = Given("", np.ones((1, 3, 1)), np.array([[1e3, 1.0, -1e9]]), prior, np.ones(1), 0.75)
    weights = [mpf(float(x)) for x in prior[0]]
    beta, total = mpf("0.75"), mp.fsum(weights)
    g = mp.log(mp.fsum(w * mp.exp(beta * r) for w, r in zip(weights, (1000, 1, -(10**9)), strict=True)) / total) / beta
    rate = Oracle(given).rate()
    assert rate.low[0] <= rate.high[0]
    assert close(rate.low[0], g)
    assert close(rate.high[0], g)
    assert close(Oracle(given).worth(np.array([[0.0, 2.0, 0.0]])), 1 + mp.log(weights[1] / total) / beta)


@pytest.mark.parametrize("escape", [0.25, 1e-12, 1e-300])
def test_oracle_of_two_states_that_are_rarely_left(escape):
    """One action: the shares of time are as the chances to enter."""
    p = np.array([[[1.0, escape]], [[3 * escape, 1.0]]])
    given = Given("", p, np.array([[0.0], [1.0]]), np.ones((2, 1)), np.array([1.0, 0.0]), 2.0)
    e, f = mpf(escape), mpf(3 * escape)
    into, back = e / (1 + e), f / (1 + f)
    rate = Oracle(given).rate()
    for found in (rate.start_low, rate.start_high, Oracle(given).worth(np.ones((2, 1)))):
        assert close(found, into / (into + back))


def test_oracle_of_two_states_with_two_actions():
    """Action 0 stays, action 1 moves, uniform prior; only the second state pays. With z = exp(beta g), x = exp(beta V):
    the matrix [[1, 1], [e, e]]/2, e = exp(beta), has the root (1 + e)/2."""
    p = np.zeros((2, 2, 2))
    p[[0, 1], 0, [0, 1]] = p[[0, 1], 1, [1, 0]] = 1.0
    given = Given("", p, np.array([[0.0, 0.0], [1.0, 1.0]]), np.full((2, 2), 0.5), np.array([1.0, 0.0]), 3.0)
    rate = Oracle(given).rate()
    g = mp.log((1 + mp.exp(3)) / 2) / 3
    assert rate.states == [0, 1]
    for found in (*rate.low, *rate.high):
        assert close(found, g)


def test_oracle_of_a_state_that_may_be_kept_or_left():
    """From 0: stay for ever for 1 less log(2)/beta, or move to 1 (rate 5) or 2 (rate -7), half and half."""
    p = np.zeros((3, 2, 3))
    p[0, 0, 0] = 1.0
    p[0, 1] = [0.0, 0.5, 0.5]
    p[1, :, 1] = p[2, :, 2] = 1.0
    reward = np.array([[1.0, 100.0], [5.0, 5.0], [-7.0, -7.0]])
    given = Given("", p, reward, np.full((3, 2), 0.5), np.array([1.0, 0.0, 0.0]), 1.0)
    rate = Oracle(given).rate()
    for found, true in zip(rate.low, (1 - mp.log(2), mpf(5), mpf(-7)), strict=True):
        assert close(found, true)
    assert close(Oracle(given).worth(np.array([[0.5, 0.5], [0.5, 0.5], [1.0, 0.0]])), (5 - 7 - mp.log(2)) / 2)
