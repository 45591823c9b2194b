"""The forest of pymdptoolbox: cut it, or wait and risk a fire."""

from __future__ import annotations

from collections.abc import Iterator

from erl_torch import checks
from erl_torch.envs.tabular import TabularEnv
from erl_torch.mdp.tabular import TabularMDP

WAIT, CUT = 0, 1


def forest(
    n_states: int = 3, fire_probability: float = 0.1, wait_reward: float = 4.0, cut_reward: float = 2.0
) -> TabularMDP:
    """The MDP of ``ForestEnv``, whose arguments these are.

    Raises:
        InputError: fewer than 2 states, a reward that is not finite, or a probability outside [0, 1].
    """
    oldest = checks.at_least("n_states", n_states, 2) - 1
    fire = checks.number("fire_probability", fire_probability, lambda x: 0 <= x <= 1, "in [0, 1]")
    waiting, cutting = checks.finite("wait_reward", wait_reward), checks.finite("cut_reward", cut_reward)

    def outcomes(s: int, a: int) -> Iterator[tuple[float, int, float]]:
        if a == CUT:
            yield 1.0, 0, cutting if s == oldest else float(s > 0)
        else:
            reward = waiting * (s == oldest)
            yield fire, 0, reward
            yield 1 - fire, min(s + 1, oldest), reward

    return TabularMDP.from_outcomes(n_states, 2, outcomes)


class ForestEnv(TabularEnv):
    """Let a forest grow for wildlife, or cut it for wood, while fire may take it.

    ## Description
    The forest ages by one each year unless it burns, with probability `fire_probability`; burnt or cut, it is young
    again.

    ## Action Space
    `Discrete(2)`: 0 wait, 1 cut.

    ## Observation Space
    `Discrete(n_states)`: age class, the last is the oldest.

    ## Starting State
    Any, all as likely.

    ## Rewards
    Of the oldest forest: `wait_reward` to wait, `cut_reward` to cut. Cutting pays 1 in the ages between and 0 in the
    youngest; waiting there pays 0.

    ## Episode End
    None. The registered environment truncates after 1000 steps.

    ## Arguments
    `n_states` (3), `fire_probability` (.1), `wait_reward` (4), `cut_reward` (2), `render_mode` ("ansi").

    ## Version History
    v0: first version.
    """

    def __init__(
        self,
        n_states: int = 3,
        fire_probability: float = 0.1,
        wait_reward: float = 4.0,
        cut_reward: float = 2.0,
        render_mode: str | None = None,
    ) -> None:
        super().__init__(forest(n_states, fire_probability, wait_reward, cut_reward), render_mode)
