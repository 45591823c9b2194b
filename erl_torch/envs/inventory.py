"""The stochastic inventory of Puterman, Markov Decision Processes (1994), section 3.2."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from erl_torch import checks
from erl_torch.envs.tabular import TabularEnv
from erl_torch.mdp.tabular import TabularMDP


def inventory(
    capacity: int = 3,
    demand: Sequence[float] = (0.25, 0.5, 0.25),
    price: float = 8.0,
    order_cost: float = 4.0,
    unit_cost: float = 2.0,
    holding_cost: float = 1.0,
) -> TabularMDP:
    """The MDP of ``InventoryEnv``, whose arguments these are.

    Raises:
        InputError: a capacity below 1, a number that is not finite, or ``demand`` that is no distribution.
    """
    checks.at_least("capacity", capacity, 1)
    chances = checks.array("demand", demand, ("most + 1",), checks.NOT_NEGATIVE)
    if abs(chances.sum() - 1) > 1e-9:
        raise checks.InputError("demand", demand, "1 in sum")
    given = {"price": price, "order_cost": order_cost, "unit_cost": unit_cost, "holding_cost": holding_cost}
    for name, value in given.items():
        checks.finite(name, value)

    def outcomes(s: int, a: int) -> Iterator[tuple[float, int, float]]:
        stock = s + a
        if stock > capacity:
            return  # no such order
        paid = (order_cost + unit_cost * a) * (a > 0) + holding_cost * stock
        for wanted, p in enumerate(chances):
            sold = min(wanted, stock)
            yield float(p), stock - sold, price * sold - paid

    return TabularMDP.from_outcomes(capacity + 1, capacity + 1, outcomes)


class InventoryEnv(TabularEnv):
    """Order goods before the demand of the month is known.

    ## Description
    Stock `s` in the morning; an order of `a` units arrives at once and must find room, so that a state has only the
    orders up to `capacity - s`. Demand is drawn from `demand`; what is not there is lost. The default is Puterman's
    example 3.2.1: optimal is to order up to three when the store is empty, 97/44 a month.

    ## Action Space
    `Discrete(capacity + 1)`: units ordered. State s does not have the orders above capacity - s.

    ## Observation Space
    `Discrete(capacity + 1)`: stock.

    ## Starting State
    Any, all as likely.

    ## Rewards
    Mean sales at `price`, less `order_cost + unit_cost * a` for an order, less `holding_cost` for each unit in stock
    after the order has come.

    ## Episode End
    None. The registered environment truncates after 1000 steps.

    ## Arguments
    `capacity` (3), `demand` (probabilities of 0, 1, 2, ...: .25, .5, .25), `price` (8), `order_cost` (4), `unit_cost`
    (2), `holding_cost` (1), `render_mode` ("ansi").

    ## Version History
    v0: first version.
    """

    def __init__(
        self,
        capacity: int = 3,
        demand: Sequence[float] = (0.25, 0.5, 0.25),
        price: float = 8.0,
        order_cost: float = 4.0,
        unit_cost: float = 2.0,
        holding_cost: float = 1.0,
        render_mode: str | None = None,
    ) -> None:
        super().__init__(inventory(capacity, demand, price, order_cost, unit_cost, holding_cost), render_mode)
