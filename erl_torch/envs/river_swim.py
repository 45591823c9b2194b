"""RiverSwim, in three versions that were published under this name."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from erl_torch import checks
from erl_torch.envs.tabular import TabularEnv
from erl_torch.mdp.tabular import TabularMDP

LEFT, RIGHT = 0, 1


class Version(NamedTuple):
    """What "right" does, and what is paid."""

    up: float  # probability in the states between
    back: float
    up_first: float  # in the first state
    back_last: float  # in the last state
    small: float  # for "left" in the first state
    large: float  # for "right" in the last state
    pays_staying: bool  # the large reward only if the last state is kept


VERSIONS = {
    "osband": Version(0.35, 0.05, 0.6, 0.4, 0.005, 1.0, False),
    "easy": Version(0.9, 0.05, 0.9, 0.05, 0.005, 1.0, True),
    "strehl_littman": Version(0.3, 0.1, 0.3, 0.7, 5.0, 10_000.0, False),
}


def river_swim(version: str = "osband", n_states: int = 6) -> TabularMDP:
    """The MDP of ``RiverSwimEnv``, whose arguments these are.

    Raises:
        InputError: an unknown version, or fewer than 2 states.
    """
    checks.one_of("version", version, tuple(VERSIONS))
    checks.at_least("n_states", n_states, 2)
    rules, last = VERSIONS[version], n_states - 1

    def outcomes(s: int, a: int) -> Iterator[tuple[float, int, float]]:
        if a == LEFT:
            yield 1.0, max(s - 1, 0), rules.small if s == 0 else 0.0
        elif s == 0:
            yield rules.up_first, 1, 0.0
            yield 1 - rules.up_first, 0, 0.0
        elif s == last:
            yield 1 - rules.back_last, s, rules.large
            yield rules.back_last, s - 1, 0.0 if rules.pays_staying else rules.large
        else:
            yield rules.up, s + 1, 0.0
            yield rules.back, s - 1, 0.0
            yield 1 - rules.up - rules.back, s, 0.0

    start = [float(s == 0) for s in range(n_states)]
    return TabularMDP.from_outcomes(n_states, 2, outcomes, start)


class RiverSwimEnv(TabularEnv):
    """Swim against the current for a large reward far up, or drift for a small one.

    ## Description
    States in a row. "Left" drifts down by one, surely. "Right" swims up and may fail. Three versions are found under
    this name, with other probabilities and rewards; say which when you compare figures:

    | `version` | up, stay, back | at the first state | at the last state | rewards |
    |---|---|---|---|---|
    | `osband` (the usual one) | .35 .6 .05 | .6 up | .4 back | .005; 1 for the action |
    | `easy` (Wan, Naik and Sutton, 2021) | .9 .05 .05 | .9 up | .05 back | .005; 1 if the state is kept |
    | `strehl_littman` | .3 .6 .1 | .3 up | .7 back | 5; 10,000 for the action |

    ## Action Space
    `Discrete(2)`: 0 left, 1 right.

    ## Observation Space
    `Discrete(n_states)`: 0 is furthest down.

    ## Starting State
    0.

    ## Rewards
    The small one for "left" in state 0, the large one for "right" in the last state, 0 elsewhere. Where it depends on
    the next state, its mean.

    ## Episode End
    None. The registered environment truncates after 1000 steps.

    ## Arguments
    `version`, `n_states` (6), `render_mode` ("ansi").

    ## Version History
    v0: first version.
    """

    def __init__(self, version: str = "osband", n_states: int = 6, render_mode: str | None = None) -> None:
        super().__init__(river_swim(version, n_states), render_mode)
