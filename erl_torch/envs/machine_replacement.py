"""Machine replacement: when to buy a new one."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from erl_torch import checks
from erl_torch.envs.tabular import TabularEnv
from erl_torch.mdp.tabular import TabularMDP

KEEP, REPLACE = 0, 1


def machine_replacement(
    costs: Sequence[float] = (0.0, 2.0, 4.0, 7.0, 12.0), wear_probability: float = 0.3, new_cost: float = 10.0
) -> TabularMDP:
    """The MDP of ``MachineReplacementEnv``, whose arguments these are.

    Raises:
        InputError: no costs, a number that is not finite, or a probability outside (0, 1].
    """
    running = [checks.finite(f"costs[{i}]", cost) for i, cost in enumerate(costs)]
    checks.at_least("len(costs)", len(running), 1)
    wears = checks.number("wear_probability", wear_probability, lambda x: 0 < x <= 1, "in (0, 1]")
    new = checks.finite("new_cost", new_cost)
    last = len(running) - 1

    def outcomes(s: int, a: int) -> Iterator[tuple[float, int, float]]:
        if a == REPLACE:
            yield 1.0, 0, -new
        else:
            yield wears, min(s + 1, last), -running[s]
            yield 1 - wears, s, -running[s]

    return TabularMDP.from_outcomes(last + 1, 2, outcomes, [1.0] + [0.0] * last)


class MachineReplacementEnv(TabularEnv):
    """Keep a machine that costs more as it wears, or replace it.

    ## Description
    Wear goes up by one with probability `wear_probability` in each period in which the machine is kept; a new one has
    none. Replacing at wear k costs (new_cost + sum of costs below k / p) / (1 + k / p) a period, p the probability of
    wear. With the default, k = 2 is best, 50/23 a period.

    ## Action Space
    `Discrete(2)`: 0 keep, 1 replace.

    ## Observation Space
    `Discrete(len(costs))`: wear.

    ## Starting State
    0.

    ## Rewards
    `-costs[wear]` to keep, `-new_cost` to replace.

    ## Episode End
    None. The registered environment truncates after 1000 steps.

    ## Arguments
    `costs` (0, 2, 4, 7, 12), `wear_probability` (.3), `new_cost` (10), `render_mode` ("ansi").

    ## Version History
    v0: first version.
    """

    def __init__(
        self,
        costs: Sequence[float] = (0.0, 2.0, 4.0, 7.0, 12.0),
        wear_probability: float = 0.3,
        new_cost: float = 10.0,
        render_mode: str | None = None,
    ) -> None:
        super().__init__(machine_replacement(costs, wear_probability, new_cost), render_mode)
