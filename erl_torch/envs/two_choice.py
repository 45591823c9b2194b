"""TwoChoice: a reward at once, or twice as much a little later (Naik et al., 2019)."""

from __future__ import annotations

from collections.abc import Iterator

from erl_torch import checks
from erl_torch.envs.tabular import TabularEnv
from erl_torch.mdp.tabular import TabularMDP


def two_choice(loop_length: int = 5) -> TabularMDP:
    """The MDP of ``TwoChoiceEnv``, whose argument this is. Raises InputError for fewer than 2 steps."""
    way = checks.at_least("loop_length", loop_length, 2) - 1  # states of a loop besides the fork

    def outcomes(s: int, a: int) -> Iterator[tuple[float, int, float]]:
        if s == 0:
            yield 1.0, 1 + a * way, 1.0 - a
        elif s % way:
            yield 1.0, s + 1, 0.0
        else:
            yield 1.0, 0, 2.0 * (s == 2 * way)

    return TabularMDP.from_outcomes(1 + 2 * way, 2, outcomes, [1.0] + [0.0] * (2 * way))


class TwoChoiceEnv(TabularEnv):
    """Choose between two loops of the same length, again and again.

    ## Description
    From the fork, state 0, the first loop pays 1 with its first step, the second 2 with its last. Per step the second
    is worth twice as much, which a discounted agent with a short horizon does not see. The process is periodic: plain
    value iteration does not converge on it.

    ## Action Space
    `Discrete(2)`: at the fork 0 the first loop, 1 the second; elsewhere both go on.

    ## Observation Space
    `Discrete(2 * loop_length - 1)`: 0 the fork, then the states of the first loop, then those of the second.

    ## Starting State
    0.

    ## Rewards
    1 for action 0 at the fork, 2 for the last step of the second loop, 0 elsewhere.

    ## Episode End
    None. The registered environment truncates after 1000 steps.

    ## Arguments
    `loop_length` (5), `render_mode` ("ansi").

    ## Version History
    v0: first version.
    """

    def __init__(self, loop_length: int = 5, render_mode: str | None = None) -> None:
        super().__init__(two_choice(loop_length), render_mode)
