"""Jack's car rental, Sutton and Barto, Reinforcement Learning, 2nd edition, Example 4.2 and Exercise 4.7."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp

from erl_torch import checks
from erl_torch.envs.tabular import TabularEnv
from erl_torch.mdp.tabular import TabularMDP

MOST_MOVED = 5
RENT, MOVE, PARKING, FREE_PARKING = 10.0, 2.0, 4.0, 10
REQUESTS, RETURNS = (3.0, 4.0), (3.0, 2.0)  # means at the two lots


class Day(NamedTuple):
    """One day at one lot, from the cars there in the morning."""

    transition: np.ndarray  # [cars, cars in the evening]
    rented: np.ndarray  # [cars], on average


def car_rental(capacity: int = 20, most_drawn: int | None = None, extended: bool = False) -> TabularMDP:
    """The MDP of ``CarRentalEnv``, whose arguments these are. State: cars at lot 1 * (capacity + 1) + cars at lot 2.

    Raises:
        InputError: a capacity below 1, ``most_drawn`` below 1, or ``extended`` that is no bool.
    """
    checks.at_least("capacity", capacity, 1)
    if most_drawn is not None:
        checks.at_least("most_drawn", most_drawn, 1)
    checks.flag("extended", extended)
    first, second = (
        _day(capacity, requests, returns, most_drawn) for requests, returns in zip(REQUESTS, RETURNS, strict=True)
    )
    n, n_actions = (capacity + 1) ** 2, 2 * MOST_MOVED + 1
    reward = np.full((n, n_actions), -np.inf)
    rows = sp.lil_array((n * n_actions, n))
    for s in range(n):
        cars = divmod(s, capacity + 1)
        for a in range(n_actions):
            moved = a - MOST_MOVED
            if moved > cars[0] or -moved > cars[1]:
                continue  # no such move
            lots = min(cars[0] - moved, capacity), min(cars[1] + moved, capacity)
            rows[s * n_actions + a] = np.outer(first.transition[lots[0]], second.transition[lots[1]]).ravel()
            paid = RENT * (first.rented[lots[0]] + second.rented[lots[1]])
            reward[s, a] = paid - _cost(moved, lots, extended)
    return TabularMDP(rows.tocsr(), reward)


def _cost(moved: int, lots: tuple[int, int], extended: bool) -> float:
    if not extended:
        return MOVE * abs(moved)
    return MOVE * (abs(moved) - (moved > 0)) + PARKING * sum(cars > FREE_PARKING for cars in lots)


def _day(capacity: int, requests: float, returns: float, most_drawn: int | None) -> Day:
    """``requests`` and ``returns`` are means."""
    transition, rented = np.zeros((capacity + 1, capacity + 1)), np.zeros(capacity + 1)
    for cars in range(capacity + 1):
        for gone, p in enumerate(_capped(requests, cars, most_drawn)):
            rented[cars] += p * gone
            left = cars - gone
            transition[cars, left:] += p * _capped(returns, capacity - left, most_drawn)
    return Day(transition, rented)


def _capped(mean: float, most: int, most_drawn: int | None) -> np.ndarray:
    """Distribution [most + 1] of min(draw, most), draw Poisson; none above ``most_drawn``, the rest scaled to sum 1."""
    last = max(most, 60) if most_drawn is None else most_drawn  # beyond 60 the chance is below 1e-45
    chances = np.array([math.exp(-mean + k * math.log(mean) - math.lgamma(k + 1)) for k in range(last + 1)])
    chances /= chances.sum()
    return np.append(chances[:most], chances[most:].sum()) if last >= most else np.pad(chances, (0, most - last))


class CarRentalEnv(TabularEnv):
    """Move cars between two lots overnight, so that tomorrow's customers find them.

    ## Description
    Cars at the two lots in the evening. Up to five are moved overnight, 2 each. Next day 3 and 4 customers on average
    (Poisson) ask for a car and pay 10 where there is one; 3 and 2 cars come back on average and can be rented the day
    after. A lot holds 20 cars; more go away.

    ## Action Space
    `Discrete(11)`: a - 5 cars are moved from lot 1 to lot 2. A state has only the moves of cars that are there.

    ## Observation Space
    `Discrete((capacity + 1)**2)`: cars at lot 1 * (capacity + 1) + cars at lot 2.

    ## Starting State
    Any, all as likely.

    ## Rewards
    Mean rent, less the cost of the moves. With `extended`, as in Exercise 4.7, the first car from lot 1 to lot 2 is
    moved for nothing, and a lot with more than 10 cars after the move costs 4.

    ## Episode End
    None. The registered environment truncates after 1000 steps.

    ## Arguments
    `capacity` (20), `most_drawn` (None: all that Poisson draws; 10: no requests or returns above 10, probabilities
    scaled to sum 1, as most programs have it), `extended` (False), `render_mode` ("ansi").

    ## Version History
    v0: first version.
    """

    def __init__(
        self,
        capacity: int = 20,
        most_drawn: int | None = None,
        extended: bool = False,
        render_mode: str | None = None,
    ) -> None:
        super().__init__(car_rental(capacity, most_drawn, extended), render_mode)
