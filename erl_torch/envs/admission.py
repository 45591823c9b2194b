"""Admission to an M/M/1 queue (Naor, 1969), uniformised to discrete steps."""

from __future__ import annotations

from collections.abc import Iterator

from erl_torch import checks
from erl_torch.envs.tabular import TabularEnv
from erl_torch.mdp.tabular import TabularMDP

REJECT, ACCEPT = 0, 1


def admission(
    arrival_rate: float = 0.6,
    service_rate: float = 0.9,
    payment: float = 10.0,
    waiting_cost: float = 1.0,
    capacity: int = 20,
) -> TabularMDP:
    """The MDP of ``AdmissionEnv``, whose arguments these are.

    Raises:
        InputError: a rate that is not above 0, a number that is not finite, or a capacity below 1.
    """
    arrives = checks.positive("arrival_rate", arrival_rate)
    rate = arrives + checks.positive("service_rate", service_rate)
    paid, cost = checks.finite("payment", payment), checks.finite("waiting_cost", waiting_cost) / rate
    checks.at_least("capacity", capacity, 1)

    def outcomes(s: int, a: int) -> Iterator[tuple[float, int, float]]:
        taken = a == ACCEPT and s < capacity
        yield arrives / rate, s + taken, paid * taken - cost * s
        yield 1 - arrives / rate, max(s - 1, 0), -cost * s

    return TabularMDP.from_outcomes(capacity + 1, 2, outcomes, [1.0] + [0.0] * capacity)


class AdmissionEnv(TabularEnv):
    """Admit customers to a queue with one server, each of whom pays, and costs while in the system.

    ## Description
    Customers arrive at rate `arrival_rate`, the server serves at rate `service_rate`, both exponential. A step is one
    event of the two clocks together, 1 / (arrival_rate + service_rate) long on average. The policy says in advance
    whether a customer who arrives in this step is admitted. Optimal is to admit below a threshold: 4 with the
    default, 2.86888 a step.

    ## Action Space
    `Discrete(2)`: 0 reject, 1 accept; with `capacity` customers in the system both reject.

    ## Observation Space
    `Discrete(capacity + 1)`: customers in the system.

    ## Starting State
    0.

    ## Rewards
    Mean `payment` of a customer who is admitted, less `waiting_cost` per customer in the system and unit of time.

    ## Episode End
    None. The registered environment truncates after 1000 steps.

    ## Arguments
    `arrival_rate` (.6), `service_rate` (.9), `payment` (10), `waiting_cost` (1), `capacity` (20), `render_mode`
    ("ansi").

    ## Version History
    v0: first version.
    """

    def __init__(
        self,
        arrival_rate: float = 0.6,
        service_rate: float = 0.9,
        payment: float = 10.0,
        waiting_cost: float = 1.0,
        capacity: int = 20,
        render_mode: str | None = None,
    ) -> None:
        super().__init__(admission(arrival_rate, service_rate, payment, waiting_cost, capacity), render_mode)
