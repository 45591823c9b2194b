"""Models of other packages, solved exactly and learnt from tuples, against theta computed without this package.

    pip install pymdptoolbox quantecon gym-classics minigrid
    python benchmarks/other_packages.py [to=docs/results/other_packages.md]

The values were found by two routes each that share no code with this package (policy iteration or a linear program, and
relative soft value iteration); they have ten digits. A package that is not installed is left out, and said.

Columns: difference between theta of ``solve_soft_bellman`` and the independent value, at beta 1 and 10; theta at
beta 1 as ``EfficientS1`` learns it from 200,000 tuples of the prior, with the interval (95%) of the data.
"""

from __future__ import annotations

import importlib.metadata
import itertools
import sys
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

import erl_torch
from erl_torch import TabularMDP

DIGITS = 2e-10  # the values are rounded
GYM_CLASSICS = {
    "5Walk": -0.0819925601, "19Walk": -0.0049916888, "ClassicGridworld": 0.0008974512, "CliffWalk": 1.0471663132,
    "DynaMaze": -0.0017377063, "FourRooms": 0.0,
    "JacksCarRental": -47.6320458339, "JacksCarRentalModified": -48.1958375680,
    "SparseGridworld": -0.0072030346, "WindyGridworld": 0.9997277506, "WindyGridworldKings": 0.9993504917,
    "WindyGridworldKingsNoOp": 0.9994872604, "WindyGridworldKingsStochastic": 0.9998437758,
}  # fmt: skip


class Model(NamedTuple):
    """A model, and theta at beta 1 and, where known, 10, with the uniform prior over the actions of each state."""

    package: str
    name: str
    make: Callable[[], TabularMDP]
    warm: float
    cold: float | None = None


def models() -> Iterator[Model]:
    """All of them; packages are imported when a model is made."""
    forests = {"": (-2.5512235472, -3.1706852819), "S=10": (-0.8931563759, -1.4803672398)}
    forests["S=300, is_sparse=True"] = (-0.2556253734, -0.4050739131)
    for arguments, values in forests.items():
        yield Model("pymdptoolbox", f"forest({arguments})", partial(_toolbox, f"forest({arguments})"), *values)
    yield Model("pymdptoolbox", "small()", lambda: _toolbox("small()"), -3.3959110890, -3.8195743278)
    yield Model("pymdptoolbox", "rand(12, 3), seed 0", _random_toolbox, -0.1027057639, -0.3051268215)
    yield Model("quantecon", "random_discrete_dp(20, 4), seed 0", _random_quantecon, -0.2933224748, -0.8416074609)
    yield Model("quantecon", "DiscreteDP of Puterman 3.1", _puterman_1, 1.0, 1.0)
    yield Model("quantecon", "DiscreteDP of Puterman 3.2.1", _puterman_2, -1.4981619060, -2.1083586110)
    for name, theta in GYM_CLASSICS.items():
        yield Model("gym-classics", name, partial(_gym_classics, name), theta)
    yield Model("minigrid", "Empty-5x5", _minigrid, -0.0085355096, -0.0559190434)
    yield Model("gymnasium", "FrozenLake-v1", lambda: _table("FrozenLake-v1"), -0.0019155856, -0.0028229629)
    yield Model("gymnasium", "CliffWalking-v1", lambda: _table("CliffWalking-v1"), 1.0471663132, 1.0047166313)
    yield Model("gymnasium", "Taxi-v4", lambda: _table("Taxi-v4"), 0.7855585124, -0.4432331054)
    yield Model("gymnasium", "Blackjack-v1 (sab), by its rules", _blackjack, 0.2220820800, 0.0824949423)


def _toolbox(call: str) -> TabularMDP:
    import mdptoolbox.example  # type: ignore[import-not-found]

    return TabularMDP.from_pymdptoolbox(*eval(f"example.{call}", {"example": mdptoolbox.example}))


def _random_toolbox() -> TabularMDP:
    import mdptoolbox.example

    np.random.seed(0)  # noqa: NPY002 (mdptoolbox draws from it)
    return TabularMDP.from_pymdptoolbox(*mdptoolbox.example.rand(12, 3))


def _random_quantecon() -> TabularMDP:
    from quantecon.markov import random_discrete_dp

    return TabularMDP.from_quantecon(random_discrete_dp(20, 4, random_state=0, sa_pair=True, sparse=True))


def _puterman_1() -> TabularMDP:
    from quantecon.markov import DiscreteDP

    transition = np.array([[[0.5, 0.5], [0.0, 1.0]], [[0.0, 1.0], [0.5, 0.5]]])
    return TabularMDP.from_quantecon(DiscreteDP(np.array([[5.0, 10.0], [-1.0, -np.inf]]), transition, 0.95))


def _puterman_2() -> TabularMDP:
    from quantecon.markov.tests.test_ddp import TestFiniteHorizon

    example = TestFiniteHorizon()
    example.setup_method()
    return TabularMDP.from_quantecon(example.ddp)


def _gym_classics(name: str) -> TabularMDP:
    import gym_classics  # type: ignore[import-not-found]

    if f"{name}-v0" not in gym.registry:
        gym_classics.register("gymnasium")
    env: Any = gym.make(f"{name}-v0").unwrapped
    starts = [env.encode(state) for state in env._starts]

    def outcomes(s: int, a: int) -> Iterator[tuple[float, int, float]]:
        for to, r, done, p in zip(*env.model(s, a), strict=True):
            for first in starts if done else [to]:
                yield float(p) / (len(starts) if done else 1), int(first), float(r)

    n_states = int(env.observation_space.n)
    start = np.bincount(starts, minlength=n_states) / len(starts)
    return TabularMDP.from_outcomes(n_states, int(env.action_space.n), outcomes, start)


def _minigrid() -> TabularMDP:
    import minigrid  # type: ignore[import-not-found]  # noqa: F401

    env: Any = gym.make("MiniGrid-Empty-5x5-v0").unwrapped
    env.reset(seed=0)
    cells = [(x, y, d) for x in (1, 2, 3) for y in (1, 2, 3) for d in range(4) if (x, y) != (3, 3)]

    def outcomes(s: int, a: int) -> Iterator[tuple[float, int, float]]:
        x, y, env.agent_dir = cells[s]
        env.agent_pos, env.step_count = np.array([x, y]), 0
        _, _, terminated, _, _ = env.step(a)
        after = (1, 1, 0) if terminated else (*map(int, env.agent_pos), int(env.agent_dir))
        yield 1.0, cells.index(after), float(terminated)

    return TabularMDP.from_outcomes(len(cells), 7, outcomes, np.eye(len(cells))[cells.index((1, 1, 0))])


def _table(env_id: str) -> TabularMDP:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", erl_torch.MeanRewardWarning)
        return erl_torch.tabular_mdp(gym.make(env_id))


CARDS = {card: (4 if card == 10 else 1) / 13 for card in range(1, 11)}  # of an infinite deck
Hand = tuple[int, int, bool, bool]  # best sum, dealer's card, usable ace, whether it is a natural


def _added(total: int, ace: bool, card: int) -> tuple[int, bool]:
    """(best sum, usable ace) with one more card; ``total`` counts a usable ace as 11."""
    low = total - 10 * ace + card
    return (low + 10, True) if (ace or card == 1) and low + 10 <= 21 else (low, False)


def _dealers(total: int, ace: bool, n_cards: int) -> dict[tuple[int, bool], float]:
    """Distribution of (final sum, natural); above 21 is a bust. The dealer stands at 17."""
    if total >= 17:
        return {(total, total == 21 and n_cards == 2): 1.0}
    found: dict[tuple[int, bool], float] = {}
    for card, p in CARDS.items():
        for end, q in _dealers(*_added(total, ace, card), n_cards + 1).items():
            found[end] = found.get(end, 0.0) + p * q
    return found


def _dealt() -> dict[Hand, float]:
    found: dict[Hand, float] = {}
    for (first, p), (second, q), (shown, w) in itertools.product(CARDS.items(), repeat=3):
        total, ace = _added(*_added(0, False, first), second)
        hand = (total, shown, ace, total == 21)
        found[hand] = found.get(hand, 0.0) + p * q * w
    return found


def _ends(hand: Hand, hit: bool) -> Iterator[tuple[float, float]]:
    """(probability, reward) of what ends the deal."""
    total, shown, ace, natural = hand
    if hit:
        yield from ((p, -1.0) for card, p in CARDS.items() if _added(total, ace, card)[0] > 21)
        return
    for (final, theirs), p in _dealers(*_added(0, False, shown), 1).items():
        best = 0 if final > 21 else final
        yield p, 1.0 if natural and not theirs else float((total > best) - (total < best))


def _blackjack() -> TabularMDP:
    """The player's natural (two cards) beats 21 of more cards. The end of a deal leads to the next."""
    dealt = _dealt()
    more = itertools.product(range(4, 22), CARDS, (False, True))
    hands = sorted({*dealt, *((t, d, ace, False) for t, d, ace in more if t > 11 or not ace)})
    number = {hand: i for i, hand in enumerate(hands)}

    def outcomes(s: int, a: int) -> Iterator[tuple[float, int, float]]:
        total, shown, ace, _ = hands[s]
        for card, p in CARDS.items() if a else ():
            after, usable = _added(total, ace, card)
            if after <= 21:
                yield p, number[after, shown, usable, False], 0.0
        for p, reward in _ends(hands[s], bool(a)):
            for hand, q in dealt.items():
                yield p * q, number[hand], reward

    return TabularMDP.from_outcomes(len(hands), 2, outcomes, [dealt.get(hand, 0.0) for hand in hands])


def row(model: Model) -> str:
    """One row of the table; raises ImportError where the package is not there."""
    mdp = model.make()
    off = []
    for beta, value in ((1.0, model.warm), (10.0, model.cold)):
        if value is None:
            off.append("")
            continue
        best = erl_torch.solve_soft_bellman(mdp, beta)
        low, high = best.theta_bounds
        inside = low - DIGITS <= value <= high + DIGITS
        off.append(f"{abs(best.theta - value):.0e}{'' if inside else ' OUTSIDE'}")
    tuples = erl_torch.collect(mdp, 200, 1000, seed=0)
    prior = mdp.uniform_policy
    learnt = erl_torch.EfficientS1(beta=1.0, prior_policy=prior).fit(tuples, mdp.n_states, mdp.n_actions)
    said = erl_torch.theta_uncertainty(erl_torch.empirical_mdp(tuples, mdp.n_states, mdp.n_actions), 1.0, prior)
    interval = str(said).removeprefix("theta = ")
    size = f"{mdp.n_states} / {int(mdp.allowed.sum())}"
    cells = (model.package, model.name, size, f"{model.warm:.10g}", *off, f"{learnt.theta + 0.0:.6g}", interval)
    return f"| {' | '.join(cells)} |"


def main() -> None:
    target = next((word.removeprefix("to=") for word in sys.argv[1:] if word.startswith("to=")), None)
    lines = [
        "# Models of other packages",
        "",
        "`python benchmarks/other_packages.py to=docs/results/other_packages.md`. theta with the uniform prior over",
        "the actions that a state has, an end leading to the start; the values come from two routes each without this",
        "package. Off: distance of the solver's theta from them (they have ten digits), at beta 1 and 10; the proven",
        "bounds contain each value to its digits unless OUTSIDE is said. Learnt: by `EfficientS1` at beta 1 from",
        "200,000 tuples of the prior: some 40 for a pair of the car rental, which are too few, as its interval says.",
        "",
        "| package | model | states / pairs | theta, beta 1 | off | off, beta 10 | learnt | the data say (95%) |",
        "|---|---|---|---|---|---|---|---|",
    ]
    absent = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for model in models():
            try:
                lines.append(row(model))
            except ImportError:
                absent.append(f"{model.package}: {model.name}")
                continue
            print(lines[-1], flush=True)
    versions = []
    for package in ("pymdptoolbox", "quantecon", "gym-classics", "minigrid", "gymnasium"):
        try:
            versions.append(f"{package} {importlib.metadata.version(package)}")
        except importlib.metadata.PackageNotFoundError:
            continue
    lines += ["", f"Versions: {', '.join(versions)}." + (f" Not installed: {', '.join(absent)}." if absent else "")]
    if target is not None:
        Path(target).write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
