"""The access-control queue of Sutton and Barto, Reinforcement Learning, 2nd edition, Example 10.2."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import comb

from erl_torch import checks
from erl_torch.envs.tabular import TabularEnv
from erl_torch.mdp.tabular import TabularMDP

REJECT, ACCEPT = 0, 1
RULES = ("accept_first", "free_first")


def access_control(
    n_servers: int = 10,
    priorities: Sequence[float] = (1.0, 2.0, 4.0, 8.0),
    free_probability: float = 0.06,
    rule: str = "accept_first",
) -> TabularMDP:
    """The MDP of ``AccessControlEnv``, whose arguments these are. State: free servers * len(priorities) + priority.

    Raises:
        InputError: a number out of its range, no priorities, or an unknown rule.
    """
    checks.at_least("n_servers", n_servers, 1)
    paid = [checks.finite(f"priorities[{i}]", priority) for i, priority in enumerate(priorities)]
    checks.at_least("len(priorities)", len(paid), 1)
    free = checks.number("free_probability", free_probability, lambda x: 0 < x <= 1, "in (0, 1]")
    checks.one_of("rule", rule, RULES)
    n_kinds = len(paid)

    def freed(busy: int) -> Iterator[tuple[float, int]]:
        for n in range(busy + 1):
            yield comb(busy, n) * free**n * (1 - free) ** (busy - n), n

    def outcomes(s: int, a: int) -> Iterator[tuple[float, int, float]]:
        servers, kind = divmod(s, n_kinds)
        if rule == "accept_first":
            taken = a == ACCEPT and servers > 0
            left = servers - taken
            ends = [(p, left + n, paid[kind] * taken) for p, n in freed(n_servers - left)]
        else:
            now = [(p, servers + n) for p, n in freed(n_servers - servers)]
            ends = [(p, n - (a == ACCEPT and n > 0), paid[kind] * (a == ACCEPT and n > 0)) for p, n in now]
        for p, after, reward in ends:
            for following in range(n_kinds):
                yield p / n_kinds, after * n_kinds + following, reward

    return TabularMDP.from_outcomes((n_servers + 1) * n_kinds, 2, outcomes)


class AccessControlEnv(TabularEnv):
    """Accept or reject customers of different priorities, who wait for one of a few servers.

    ## Description
    The customer at the head of an endless queue has one of four priorities, each as likely as any other. Accepted, the
    customer takes a free server and pays the priority; rejected, or with no server free, the customer goes away. Every
    busy server becomes free with probability .06 a step. There are two published rules for one step:

    - `accept_first` (Sutton and Barto): the customer is served if a server is free now; then the busy ones, the new one
      among them, may become free.
    - `free_first` (Wan, Naik and Sutton, 2021): the busy servers may become free first; then the customer is served if
      one is free.

    ## Action Space
    `Discrete(2)`: 0 reject, 1 accept.

    ## Observation Space
    `Discrete((n_servers + 1) * 4)`: free servers * 4 + number of the priority.

    ## Starting State
    Any, all as likely.

    ## Rewards
    The priority of a customer who is served. With a rule under which that is not known beforehand, its mean.

    ## Episode End
    None. The registered environment truncates after 1000 steps.

    ## Arguments
    `n_servers` (10), `priorities` (1, 2, 4, 8), `free_probability` (.06), `rule`, `render_mode` ("ansi").

    ## Version History
    v0: first version.
    """

    def __init__(
        self,
        n_servers: int = 10,
        priorities: Sequence[float] = (1.0, 2.0, 4.0, 8.0),
        free_probability: float = 0.06,
        rule: str = "accept_first",
        render_mode: str | None = None,
    ) -> None:
        super().__init__(access_control(n_servers, priorities, free_probability, rule), render_mode)
