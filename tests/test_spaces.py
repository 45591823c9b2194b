"""Environments with any finite spaces, whose names come back; what they return is checked; whose model is believed."""

import contextlib
import itertools
import sys
import textwrap
from functools import partial, partialmethod
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.envs.toy_text.frozen_lake import FrozenLakeEnv
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from helpers import composed
from omegaconf import OmegaConf

import erl_torch
from erl_torch import CertaintyEquivalence, InputError, Labels, Note, Problem, TabularMDP, Transitions
from erl_torch.empirical import reservations
from erl_torch.envs import Discretise
from erl_torch.envs.encoded import Encoded, EncodedVector, encoded, labels_of
from erl_torch.envs.ends import EndReward
from erl_torch.envs.windy_cliff import WindyCliffEnv
from erl_torch.files import read_npz
from erl_torch.labels import Names
from erl_torch.learners.replicas import ReplicaSolution
from erl_torch.mdp.from_gymnasium import changed_by, known_mdp
from erl_torch.pictures import table_picture
from erl_torch.run.build import make_env
from erl_torch.run.playing import play
from erl_torch.run.training import train

FIVE, TWO = spaces.Discrete(5), spaces.Discrete(2)


class Row(gym.Env):
    """Five cells in a row; the last one pays 1 and ends the episode. The spaces show and read them."""

    def __init__(self, observation_space=FIVE, action_space=TWO, show=int, read=int):
        self.observation_space, self.action_space, self.show, self.read = observation_space, action_space, show, read

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.cell = int(self.np_random.integers(3))
        return self.show(self.cell), {}

    def step(self, action):
        assert self.action_space.contains(action)
        self.cell = min(max(self.cell + (1 if self.read(action) else -1), 0), 4)
        return self.show(self.cell), float(self.cell == 4), self.cell == 4, False, {}


def both(c):
    return c, c % 2


SPACES: dict[str, Any] = {
    "start": (spaces.Discrete(5, start=-3), TWO, lambda c: c - 3, int),
    "start of actions": (FIVE, spaces.Discrete(2, start=7), int, lambda a: a - 7),
    "tuple": (spaces.Tuple((FIVE, TWO)), TWO, both, int),
    "dict": (spaces.Dict(cell=FIVE, odd=TWO), TWO, lambda c: {"cell": c, "odd": c % 2}, int),
    "nested": (
        spaces.Tuple((TWO, spaces.Dict(a=spaces.Tuple((FIVE,))))), TWO, lambda c: (1, {"a": (c,)}), int,
    ),
    "multi-discrete": (spaces.MultiDiscrete([5, 2], start=[1, -1]), TWO, lambda c: np.array([c + 1, c % 2 - 1]), int),
    "bits": (spaces.MultiBinary(3), TWO, lambda c: np.array([c & 1, c >> 1 & 1, c >> 2], np.int8), int),
    "whole numbers in a box": (spaces.Box(2, 9, (1,), np.int32), TWO, lambda c: np.array([c + 2], np.int32), int),
    "actions of two parts": (FIVE, spaces.Tuple((spaces.Discrete(1), TWO)), int, lambda a: a[1]),
    "actions in a dict": (FIVE, spaces.Dict(go=spaces.MultiBinary(1)), int, lambda a: a["go"][0]),
}  # fmt: skip
CELLS: dict[str, Any] = {
    "start": lambda x: x + 3, "start of actions": int, "tuple": lambda x: x[0], "dict": lambda x: x["cell"],
    "nested": lambda x: x[1]["a"][0], "multi-discrete": lambda x: x[0] - 1,
    "bits": lambda x: x[0] + 2 * x[1] + 4 * x[2],
    "whole numbers in a box": lambda x: x[0] - 2, "actions of two parts": int, "actions in a dict": int,
}  # fmt: skip


def same_but_for_names(name, named, plain, space):
    """The states of ``named``, by their labels, are those of ``plain``; so are actions and rewards."""
    labels = Labels.of_space(space)
    for column in ("s", "s_next"):
        cells = [CELLS[name](labels.decode(int(s))) for s in getattr(named, column)]
        np.testing.assert_array_equal(cells, getattr(plain, column))
    for column in ("a", "r", "a_next"):
        np.testing.assert_array_equal(getattr(named, column), getattr(plain, column))


# -- every kind of space -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SPACES)
def test_other_names_give_the_same_stream(name):
    plain = erl_torch.collect(Row(), 20, 10, seed=3)
    same_but_for_names(name, erl_torch.collect(Row(*SPACES[name]), 20, 10, seed=3), plain, SPACES[name][0])


@pytest.mark.parametrize("mode", AutoresetMode)
@pytest.mark.parametrize("name", SPACES)
def test_other_names_give_the_same_stream_of_vectors(name, mode):
    def stream(*arguments):
        def make():
            return gym.wrappers.TimeLimit(Row(*arguments), 4)  # so that some episodes are cut off

        vector = SyncVectorEnv([make] * 3, autoreset_mode=mode)
        return erl_torch.collect(vector, 10, 12, seed=5)

    same_but_for_names(name, stream(*SPACES[name]), stream(), SPACES[name][0])


def test_what_is_discrete_already_is_left_alone():
    env = Row()
    assert encoded(env) is env
    assert labels_of(env) == (None, None)
    vector = SyncVectorEnv([Row])
    assert encoded(vector) is vector
    mdp = TabularMDP([[[1.0]]], [[0.0]])
    assert encoded(mdp) is mdp
    named = encoded(Row(*SPACES["tuple"]))
    assert isinstance(named, Encoded)
    assert encoded(named) is named
    states, actions = labels_of(gym.wrappers.TimeLimit(named, 5))
    assert states is not None
    assert states.decode(7) == (3, 1)
    assert actions is None
    assert isinstance(encoded(SyncVectorEnv([partial(Row, *SPACES["dict"])])), EncodedVector)


def test_spaces_that_are_not_finite_keep_the_hint():
    with pytest.raises(InputError, match=r"^observation_space=Box.*a finite space.*a Box can be cut: env\.bins"):
        erl_torch.collect(gym.make("CartPole-v1"), 1, 1)
    with pytest.raises(InputError, match=r"^action_space=Box.*: must be a finite space"):
        erl_torch.collect(Row(FIVE, spaces.Box(0, 1, (1,))), 1, 1)
    pixels = Row(spaces.Box(0, 255, (8, 8), np.uint8), show=lambda c: np.full((8, 8), c, np.uint8))
    with pytest.raises(InputError, match=r"smaller: it has about 1e154 members, and 2\*\*31 - 1 are allowed"):
        erl_torch.collect(pixels, 1, 1)
    cut = Discretise(gym.make("MountainCar-v0"), 3)
    assert encoded(cut) is cut


def test_tables_that_do_not_fit_the_memory_are_one_line():
    with pytest.raises(InputError, match=r"of memory, and .* free") as error:
        erl_torch.collect(Row(spaces.MultiBinary(30), spaces.MultiBinary(20), lambda c: np.zeros(30, np.int8)), 1, 1)
    assert "\n" not in str(error.value)


# -- against models made by hand ------------------------------------------------------------------------------


def blackjack():
    """(states, their row of the table: action -> (mean reward, {s' or None: probability})), start of Blackjack-v1 with
    sab=False: from the rules, with cards of an infinite deck (10 counts four times)."""
    cards = {**dict.fromkeys(range(1, 10), 1 / 13), 10: 4 / 13}

    def add(total: int, ace: bool, card: int) -> tuple[int, bool]:  # total counts one ace as 11 where ``ace``
        total, ace = total + card, ace
        if card == 1 and total + 10 <= 21 and not ace:
            total, ace = total + 10, True
        if ace and total > 21:
            total, ace = total - 10, False
        return total, ace

    def dealer(total, ace):
        if total >= 17:
            return {min(total, 22): 1.0}
        ends: dict[int, float] = {}
        for card, p in cards.items():
            for end, q in dealer(*add(total, ace, card)).items():
                ends[end] = ends.get(end, 0) + p * q
        return ends

    finals = {show: dealer(*add(0, False, show)) for show in cards}
    start: dict[tuple[int, int, int], float] = {}
    for (one, p), (two, q), (show, o) in itertools.product(cards.items(), repeat=3):
        total, ace = add(*add(0, False, one), two)
        start[total, show, int(ace)] = start.get((total, show, int(ace)), 0) + p * q * o
    table: dict[tuple[int, int, int], Any] = {}
    todo = list(start)
    while todo:
        state = total, show, ace = todo.pop()
        if state in table:
            continue
        stick = sum(p * (1 if end > 21 else np.sign(total - end)) for end, p in finals[show].items())
        hit: dict[Any, float] = {}
        for card, p in cards.items():
            after, soft = add(total, bool(ace), card)
            key = (after, show, int(soft)) if after <= 21 else None
            hit[key] = hit.get(key, 0) + p
        table[state] = (stick, {None: 1.0}), (-hit.get(None, 0), hit)
        todo += [s for s in hit if s is not None]
    return table, start


def blackjack_mdp():
    table, start = blackjack()
    labels = Labels.of_values(table)
    n = len(labels)
    first = np.zeros(n)
    for state, p in start.items():
        first[labels.encode(state)] = p
    transition, reward = np.zeros((n, 2, n)), np.zeros((n, 2))
    for state, rows in table.items():
        for a, (mean, after) in enumerate(rows):
            s = labels.encode(state)
            reward[s, a] = mean
            for s_next, p in after.items():
                transition[s, a] += p * (first if s_next is None else np.eye(n)[labels.encode(s_next)])
    return TabularMDP(transition, reward, first), labels


@pytest.fixture(scope="module")
def played():
    return erl_torch.collect(gym.make("Blackjack-v1", sab=False), 4000, 100, seed=0)


def test_blackjack_is_the_game_of_its_rules(played):
    """The stream contradicts no entry of a model made from the rules: transitions, mean rewards."""
    mdp, labels = blackjack_mdp()
    members = Labels.of_space(gym.make("Blackjack-v1").observation_space)
    assert len(members) == 32 * 11 * 2
    s, s_next = ([labels.encode(members.decode(int(x))) for x in column] for column in (played.s, played.s_next))
    data = Transitions(np.array(s), played.a, played.r, np.array(s_next), played.a_next)
    counted = reservations.count(data, mdp.n_states, 2, False)
    assert reservations.of_model(counted, mdp) == []
    other = TabularMDP(mdp.transition, -mdp.reward, mdp.start)
    assert reservations.of_model(counted, other) != []


def test_what_is_learnt_of_blackjack_plays_well(played):
    """The return of the policy learnt from 4000 games, exactly, in the model of the rules."""
    labels = blackjack_mdp()[1]
    members = Labels.of_space(gym.make("Blackjack-v1").observation_space)
    learnt = CertaintyEquivalence(beta=100.0).fit(played, len(members), 2).policy.numpy()
    policy = np.array([learnt[members.encode(label)] for label in labels])
    table, start = blackjack()

    def expected(choose):
        """Return of a game, by the policy ``choose``: state -> [2]."""
        worth: dict[Any, float] = {None: 0.0}
        for state in sorted(table, key=lambda s: (-s[0] + 10 * s[2], s)):  # hard totals grow, soft ones become hard
            todo = [state]
            while todo:
                one = todo[-1]
                missing = [s for _, after in table[one] for s in after if s not in worth]
                if missing:
                    todo += missing
                    continue
                values = [mean + sum(p * worth[s] for s, p in after.items()) for mean, after in table[one]]
                worth[todo.pop()] = float(choose(one, values))
        return sum(p * worth[s] for s, p in start.items())

    best = expected(lambda s, values: max(values))
    own = expected(lambda s, values: policy[labels.encode(s)] @ values)
    random = expected(lambda s, values: np.mean(values))
    assert -0.05 < best < -0.04  # sab=True pays naturals otherwise: -.0431
    assert random < -0.3
    assert best >= own > best - 0.06


def test_returns_of_blackjack_are_those_published():
    """With sab=True and the random policy: -.394175, found by enumeration elsewhere."""
    env = gym.make("Blackjack-v1")
    prior = np.full((704, 2), 0.5)
    rng = np.random.default_rng(0)
    n = 4000
    measured = erl_torch.evaluate(env, prior, 1.0, rng, n_episodes=n).mean_return
    assert abs(measured + 0.394175) < 4 * 0.92 / np.sqrt(n)  # the standard deviation of a game is below .92


class Grid(gym.Env):
    """Turn left, turn right, go on: a room of 3 x 3 cells, whose far corner ends the episode and pays 1."""

    observation_space = spaces.Dict(position=spaces.MultiDiscrete([3, 3]), direction=spaces.Discrete(4))
    action_space = spaces.Discrete(3, start=1)
    ahead = ((0, 1), (1, 0), (0, -1), (-1, 0))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.row, self.column, self.direction = 0, 0, 0
        return self.seen(), {}

    def seen(self):
        return {"direction": np.int64(self.direction), "position": np.array([self.row, self.column])}

    def step(self, action):
        self.row, self.column, self.direction = moved(self.row, self.column, self.direction, int(action) - 1)
        there = (self.row, self.column) == (2, 2)
        return self.seen(), float(there), there, False, {}


def moved(row, column, direction, a):
    if a < 2:
        return row, column, (direction + (-1, 1)[a]) % 4
    step = Grid.ahead[direction]
    return min(max(row + step[0], 0), 2), min(max(column + step[1], 0), 2), direction


def test_a_grid_of_dicts_is_learnt_exactly():
    """Nothing is left to chance: with every pair met, theta is that of the model written by hand."""
    places = [(r, c, d) for r in range(3) for c in range(3) for d in range(4) if (r, c) != (2, 2)]
    n = len(places)
    transition, reward = np.zeros((n, 3, n)), np.zeros((n, 3))
    for (s, place), a in itertools.product(enumerate(places), range(3)):
        after = moved(*place, a)
        reward[s, a] = after[:2] == (2, 2)
        transition[s, a, places.index((0, 0, 0) if reward[s, a] else after)] = 1
    model = TabularMDP(transition, reward, np.eye(n)[places.index((0, 0, 0))])
    best = erl_torch.solve_soft_bellman(model, 5.0)
    env = Grid()
    data = erl_torch.collect(env, 60, 1000, seed=0)
    labels = Labels.of_space(env.observation_space)
    assert len(labels) == 36
    learnt = CertaintyEquivalence(beta=5.0).fit(data, 36, 3)
    assert learnt.theta is not None
    assert best.theta is not None
    np.testing.assert_allclose(learnt.theta, best.theta, rtol=1e-9)
    for s, (row, column, direction) in enumerate(places):
        own = learnt.policy[labels.encode({"position": [row, column], "direction": direction})]
        np.testing.assert_allclose(own, best.policy[s], atol=1e-7)


class Masked(Row):
    """The same row, with the mask of its actions beside the state."""

    def __init__(self):
        super().__init__(spaces.Dict(observation=FIVE, action_mask=spaces.MultiBinary(2)), show=self.with_mask)

    def with_mask(self, c):
        return {"observation": c, "action_mask": np.array([c > 0, 1], np.int8)}


def test_a_mask_is_no_part_of_the_state():
    env: Any = encoded(Masked())
    s, info = env.reset(seed=0)
    assert s == env.unwrapped.cell
    np.testing.assert_array_equal(info["action_mask"], [s > 0, 1])
    while s != 4:
        s, *_, info = env.step(1)
        np.testing.assert_array_equal(info["action_mask"], [s > 0, 1])
    assert env.observation_space == FIVE
    assert labels_of(env) == (None, None)
    for mode in AutoresetMode:
        vector = encoded(SyncVectorEnv([Masked] * 2, autoreset_mode=mode))
        s, info = vector.reset(seed=0)
        for _ in range(4):
            np.testing.assert_array_equal(info["action_mask"], np.stack([s > 0, [True] * 2], 1))
            s, _, terminated, _, info = vector.step(np.array([1, 1]))
            if mode is AutoresetMode.DISABLED and terminated.any():
                s, info = vector.reset(options={"reset_mask": terminated})


def test_a_bonus_at_the_ends_is_paid_by_any_names():
    plain = erl_torch.collect(EndReward(Row(), 3.0, "none"), 20, 10, seed=3)
    assert 4.0 in plain.r
    named = erl_torch.collect(EndReward(Row(*SPACES["dict"]), 3.0, "none"), 20, 10, seed=3)
    same_but_for_names("dict", named, plain, SPACES["dict"][0])


# -- names come back -------------------------------------------------------------------------------------------


SHOP = """
    import gymnasium as gym
    from gymnasium.spaces import Dict, Discrete, Tuple


    class Shop(gym.Env):
        observation_space = Tuple((Discrete(3, start=1), Dict(open=Discrete(2))))
        action_space = Discrete(2)
        action_labels = ("wait", "order")

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            self.stock = 3
            return self.seen(), {}

        def seen(self):
            return self.stock, {"open": int(self.stock > 1)}

        def step(self, action):
            sold = self.stock > 1 and self.np_random.random() < 0.7
            self.stock = 3 if action else self.stock - sold
            return self.seen(), float(sold) - 0.5 * action, False, False, {}


    gym.register("Shop-v0", "shop:Shop", max_episode_steps=50)
"""


@pytest.fixture
def shop(tmp_path, monkeypatch):
    """The module ``shop`` can be imported; a folder for runs."""
    (tmp_path / "shop.py").write_text(textwrap.dedent(SHOP))
    monkeypatch.syspath_prepend(tmp_path)
    yield tmp_path
    sys.modules.pop("shop", None)
    gym.registry.pop("Shop-v0", None)


NAMES = ["(1, {'open': 0})", "(1, {'open': 1})", "(2, {'open': 0})", "(2, {'open': 1})", "(3, {'open': 0})"]
FEW = (
    "experience.n_episodes=20",
    "experience.episode_length=50",
    "learner=certainty_equivalence",
    "env=gym",
    "env.id=shop:Shop-v0",
)


def test_a_run_gives_the_names_back(shop, capsys):
    cfg = composed(*FEW)
    run = shop / "run"
    train(cfg, run)
    saved = read_npz(run / "solution.npz")
    assert saved["state_labels"].tolist()[:5] == NAMES
    assert saved["action_labels"].tolist() == ["wait", "order"]
    loaded = erl_torch.Solution.load(run / "solution.npz")
    assert loaded.state_labels == Labels.of_texts(saved["state_labels"])
    full, empty = (loaded.policy[loaded.state_labels.encode((n, {"open": int(n > 1)}))] for n in (3, 1))
    order = loaded.action_labels.encode("order")
    assert empty[order] > 0.5 > full[order]  # an empty shop sells nothing
    (run / ".hydra").mkdir()
    OmegaConf.save(cfg, run / ".hydra" / "config.yaml")
    capsys.readouterr()
    play(composed(f"run={run}", "module=shop", "n_episodes=1", "n_steps=2", "greedy=true", command="play"))
    out = capsys.readouterr().out.splitlines()
    assert out[-3] == "s=(3, {'open': 1})"
    assert out[-2].startswith("s=(3, {'open': 1}), a=wait, r=")
    assert ", s'=(" in out[-1]


def test_replicas_give_the_names_back_and_a_run_resumes(shop):
    train(composed(*FEW, "n_replicas=2"), shop / "many")
    saved = read_npz(shop / "many" / "replicas.npz")
    assert saved["state_labels"].tolist()[:5] == NAMES
    many = ReplicaSolution.load(shop / "many" / "replicas.npz")
    assert many.action_labels == Labels.of_values(["wait", "order"])
    train(composed(*FEW), shop / "one")
    train(composed(*FEW), shop / "one")  # complete: it is read
    one = erl_torch.Solution.load(shop / "one" / "solution.npz")
    np.testing.assert_array_equal(one.policy, many[0].policy)
    assert one.state_labels == many[1].state_labels
    assert one.action_labels == many.action_labels


def test_the_command_line_takes_it(shop, start):
    import os

    from helpers import ROOT, ended

    command = (
        sys.executable,
        ROOT / "train.py",
        *FEW[:3],
        "env=shop:Shop-v0",
        "evaluation.pictures=false",
        "hydra.run.dir=run",
    )
    environment = {**os.environ, "PYTHONPATH": f"{ROOT}{os.pathsep}{shop}"}
    code, out, err = ended(start(*command, cwd=shop, env=environment))
    assert code == 0, err
    assert read_npz(shop / "run" / "solution.npz")["action_labels"].tolist() == ["wait", "order"]
    code, out, err = ended(
        start(sys.executable, ROOT / "play.py", "run=run", "module=shop", "n_episodes=1", cwd=shop, env=environment)
    )
    assert code == 0, err
    assert "a=wait" in out


def test_a_problem_in_python_has_names(tmp_path):
    env = Row(*SPACES["tuple"])
    data = erl_torch.collect(env, 50, 10, seed=0)
    learner = CertaintyEquivalence(beta=2.0)
    solution = erl_torch.train(learner, env, data, directory=tmp_path / "env")
    assert solution.state_labels is not None
    assert solution.state_labels.decode(3) == (1, 1)
    assert solution.action_labels is None
    problem = Problem(env, env, np.full((10, 2), 0.5), action_labels=Labels.of_values(["left", "right"]))
    solution = erl_torch.train(learner, problem, data, directory=tmp_path / "problem")
    assert solution.state_labels is not None
    assert solution.action_labels == Labels.of_values(["left", "right"])
    assert erl_torch.Solution.load(tmp_path / "problem" / "solution.npz").action_labels == solution.action_labels


def test_labels_that_do_not_fit_the_policy_are_refused(tmp_path):
    env = Row(*SPACES["tuple"])
    data = erl_torch.collect(env, 50, 10, seed=0)
    solution = erl_torch.train(CertaintyEquivalence(beta=2.0), env, data, directory=tmp_path / "run")
    arrays = solution.arrays()
    for wrong, words in ((np.array(["a"]), "1 labels: must be 10 labels"), (np.arange(10), "a column of texts")):
        with pytest.raises(InputError, match=words):
            erl_torch.Solution.of_arrays({**arrays, "state_labels": wrong}, "file")
    row: Any = Row()
    row.action_labels = ["left", "right", "stay"]
    with pytest.raises(InputError, match=r"action_labels=3 different ones: must be one for each member"):
        erl_torch.train(CertaintyEquivalence(beta=2.0), row, data, directory=tmp_path / "other")


def test_notes_name_pairs():
    names = Names(Labels.of_values(["home", "shop"]), Labels.of_values(["go"]))
    data = Transitions([0, 1, 0], [0, 0, 0], [1.0, 0.0, 1.0], [1, 1, 0], [0, 0, 0])
    model = TabularMDP([[[0, 1.0]], [[1.0, 0]]], [[0.0], [0.0]])
    ((_, text),) = reservations.of_model(reservations.count(data, 2, 1, False, names), model)
    assert "from s=home, a=go to s'=home" in text or "from s=shop, a=go to s'=shop" in text
    assert "at s=home, a=go" in text


def test_pictures_show_names():
    table = np.array([[0.0, 1.0], [1.0, 0.0]])
    plain = table_picture(table, "title", "label")
    named = table_picture(table, "title", "label", names=Names(Labels.of_values(["x$_{", "a" * 60]), None))
    assert named.shape == plain.shape
    assert (named != plain).any()
    many = Names(Labels.of_values(range(31)), Labels.of_values(range(100, 113)))
    big = np.zeros((31, 13))
    np.testing.assert_array_equal(table_picture(big, "t", "l", names=many), table_picture(big, "t", "l"))


def test_tuples_of_labels():
    columns = (["home", "shop"], ["go", ("buy", 1)], [0.0, 1.0], ["shop", "home"], [("buy", 1), "go"])
    data, states, actions = Transitions.of_labels(*columns)
    assert list(states) == ["home", "shop"]
    assert list(actions) == ["go", ("buy", 1)]
    assert [data.s.tolist(), data.a.tolist(), data.s_next.tolist(), data.a_next.tolist()] == [
        [0, 1], [0, 1], [1, 0], [1, 0],
    ]  # fmt: skip
    assert data.r.tolist() == [0.0, 1.0]
    known = Labels.of_values(["shop", "elsewhere", "home"])
    again = Transitions.of_labels(*columns, known)
    assert again.transitions.s.tolist() == [2, 0]
    assert again.states is known
    numbers = Transitions.of_labels(*map(np.array, ([5, 7], [1, 1], [0.0, 0.0], [7, 5], [1, 1])))
    assert list(numbers.states) == [5, 7]
    with pytest.raises(InputError, match=r"^s_next\[1\]=home: must be one of shop"):
        Transitions.of_labels(["shop"] * 2, [0, 0], [0.0, 0.0], ["shop", "home"], [0, 0], Labels.of_values(["shop"]))
    with pytest.raises(InputError, match="of one length"):
        Transitions.of_labels(["shop"] * 2, [0], [0.0, 0.0], ["shop"] * 2, [0, 0])


# -- what environments return ----------------------------------------------------------------------------------


class Wrong(Row):
    """Its second step returns ``parts`` in place of the right ones, or what ``whole`` makes of them."""

    def __init__(self, whole=None, first=None, **parts):
        super().__init__()
        self.whole, self.first, self.parts, self.t = whole, first, parts, 0

    def reset(self, *, seed=None, options=None):
        self.t = 0
        _, info = super().reset(seed=seed)
        self.cell = 0
        return (0, info) if self.first is None else self.first

    def step(self, action):
        self.t += 1
        names = ("observation", "reward", "terminated", "truncated", "info")
        result = dict(zip(names, super().step(action), strict=True))
        if self.t == 2:
            result |= self.parts
        whole = tuple(result.values())
        return self.whole(whole) if self.whole and self.t == 2 else whole


WRONG = [
    ({"observation": 5}, r"observation=5: must be in Discrete\(5\)"),
    ({"observation": -1}, r"observation=-1: must be in Discrete\(5\)"),
    ({"observation": 0.5}, r"observation=0\.5: must be in Discrete\(5\)"),
    ({"observation": np.nan}, r"observation=nan: must be in"),
    ({"observation": None}, r"observation=None: must be in"),
    ({"observation": np.array([1])}, r"observation=\[1\]: must be in .*\(not an array of shape \(1,\)\)"),
    ({"reward": np.nan}, r"reward=nan: must be finite"),
    ({"reward": None}, r"reward=None \(NoneType\): must be a number"),
    ({"reward": np.array([1.0])}, r"reward=array\(\[1\.\]\) \(ndarray\): must be a number"),
    ({"reward": "1"}, r"reward='1' \(str\): must be a number"),
    ({"reward": 1j}, r"reward=1j \(complex\): must be a number"),
    ({"terminated": None}, r"terminated=None \(NoneType\): must be True or False"),
    ({"terminated": 1}, r"terminated=1 \(int\): must be True or False"),
    ({"truncated": np.array([True])}, r"truncated=.*: must be True or False"),
    (
        {"whole": lambda x: x[:4]},
        r"what it returned=\(.*\): must be \(observation, .*two ends apart",
    ),
    ({"whole": lambda x: x[0]}, r"what it returned=\d: must be \(observation, reward, terminated, truncated, info\)"),
    ({"whole": list}, r"what it returned=\[.*\]: must be \(observation, reward, terminated, truncated, info\)"),
]
FIRST = [
    (0, r"what it returned=0: must be \(observation, info\), info a dict"),
    ((0, 1), r"what it returned=\(0, 1\): must be \(observation, info\)"),
    ((0, {}, 1), r"what it returned=\(0, \{\}, 1\): must be \(observation, info\)"),
    ((7, {}), r"observation=7: must be in Discrete\(5\)"),
]


@pytest.mark.parametrize(("arguments", "words"), WRONG)
def test_a_wrong_step_is_named(arguments, words):
    with pytest.raises(InputError, match=f"^Wrong, step 2 of an episode: {words}") as error:
        erl_torch.collect(Wrong(**arguments), 2, 5)
    assert "\n" not in str(error.value)
    with pytest.raises(InputError, match=r"^Wrong, step 2 of an episode: "):
        erl_torch.evaluate(Wrong(**arguments), np.full((5, 2), 0.5), 1.0, np.random.default_rng(0))


@pytest.mark.parametrize("arguments", [one for one, _ in WRONG[6:9] + WRONG[10:16]])
@pytest.mark.parametrize("wrap", [Encoded, partial(EndReward, end_reward=1.0, failures="none")])
def test_wrappers_do_not_hide_a_wrong_step(wrap, arguments):
    with pytest.raises(InputError, match=r"^Wrong, step 2 of an episode: ") as error:
        erl_torch.collect(wrap(Wrong(**arguments)), 2, 5)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(("first", "words"), FIRST)
def test_a_wrong_reset_is_named(first, words):
    with pytest.raises(InputError, match=f"^Wrong, reset: {words}"):
        erl_torch.collect(Wrong(first=first), 2, 5)


@pytest.mark.filterwarnings("ignore")  # of Gymnasium's checks
@pytest.mark.parametrize("arguments", [WRONG[0][0], WRONG[6][0], WRONG[7][0], WRONG[14][0], WRONG[15][0]])
def test_a_registered_environment_is_named_by_its_id(arguments):
    """Gymnasium's own wrappers and checks stand between, and take the tuple apart first."""
    gym.register("Wrong-v0", lambda **kwargs: Wrong(**kwargs), max_episode_steps=9)
    try:
        with pytest.raises(InputError, match=r"^Wrong-v0, step 2 of an episode: ") as error:
            erl_torch.collect(gym.make("Wrong-v0", **arguments), 2, 5)
        assert "\n" not in str(error.value)
    finally:
        gym.registry.pop("Wrong-v0")


def test_whole_floats_and_numpy_numbers_are_taken():
    taken = {"observation": 1.0, "reward": np.float32(2), "terminated": np.False_, "truncated": np.True_}
    data = erl_torch.collect(Wrong(**taken), 1, 5)
    assert data.s_next[1] == 1
    assert data.r[1] == 2


def test_an_old_reset_is_named():
    class Old(Row):
        def reset(self):  # type: ignore[override]
            return 0

    with pytest.raises(InputError, match=r"^Old, reset: class=Old: must be one of Gymnasium's: reset\(seed=None"):
        erl_torch.collect(Old(), 1, 1)


def test_errors_of_an_environment_are_its_own():
    class Broken(Row):
        def step(self, action):
            raise ValueError("its own")

    with pytest.raises(ValueError, match=r"^its own$") as error:
        erl_torch.collect(Broken(), 1, 1)
    assert not isinstance(error.value, InputError)


def test_a_wrong_member_of_a_space_is_named():
    env = Row(SPACES["tuple"][0], show=lambda c: (c, 7))
    with pytest.raises(InputError, match=r"^Row, reset: observation=\(\d, 7\): must be in Tuple"):
        erl_torch.collect(env, 1, 1)


class Vector(gym.vector.VectorEnv):
    """Two environments of five states, whose second step returns ``parts`` in place of the right ones."""

    num_envs = 2
    single_observation_space, single_action_space = FIVE, TWO
    metadata = {"autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012

    def __init__(self, **parts):
        self.parts, self.t = parts, 0

    def reset(self, *, seed=None, options=None):
        return np.zeros(2, int), {}

    def step(self, actions):
        self.t += 1
        none = np.zeros(2, bool)
        right = {
            "observation": np.ones(2, int),
            "reward": np.zeros(2),
            "terminated": none,
            "truncated": none,
            "info": {},
        }
        return tuple((right | (self.parts if self.t == 2 else {})).values())


@pytest.mark.parametrize(
    ("parts", "words"),
    [
        ({"observation": np.array([0, 5])}, r"observation\[1\]=5: must be in Discrete\(5\)"),
        ({"observation": np.array([0.5, 1])}, r"observation\[0\]=0\.5: must be in"),
        ({"observation": np.zeros(3, int)}, r"observation=.*shape \(3,\)"),
        ({"reward": np.array([0, np.nan])}, r"reward\[1\]=nan: must be finite"),
        ({"reward": np.zeros((2, 1))}, r"reward=float64 of shape \(2, 1\): must be numbers, of shape \(2,\)"),
        ({"reward": None}, r"reward=object of shape \(\): must be numbers"),
        ({"terminated": np.zeros(2, int)}, r"terminated=int64 of shape \(2,\): must be True or False"),
    ],
)
def test_a_wrong_step_of_a_vector_is_named(parts, words):
    with pytest.raises(InputError, match=f"^Vector, step 2: {words}"):
        erl_torch.collect(Vector(**parts), 5, 5)


# -- whose model is believed ---------------------------------------------------------------------------------------


class Costly(FrozenLakeEnv):
    def step(self, action):
        state, reward, ended, cut, info = super().step(action)
        return state, reward - 1.0, ended, cut, info


class Fined(WindyCliffEnv):
    def step(self, action):
        state, reward, ended, cut, info = super().step(action)
        return state, reward - 50.0, ended, cut, info


class Elsewhere(FrozenLakeEnv):
    def reset(self, *, seed=None, options=None):
        _, info = super().reset(seed=seed)
        self.s = 14
        return 14, info


class Mixed:
    def step(self, action):
        state, reward, *rest = super().step(action)  # type: ignore[misc]
        return state, 2 * reward, *rest


class WithMixed(Mixed, FrozenLakeEnv):
    pass


class Trusted(Costly):
    model_holds = True


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (Costly, "Costly overrides step of FrozenLakeEnv"),
        (Elsewhere, "Elsewhere overrides reset of FrozenLakeEnv"),
        (WithMixed, "Mixed overrides step of FrozenLakeEnv"),
        (Fined, "Fined overrides step of TabularEnv"),
    ],
)
def test_a_model_of_another_step_is_not_believed(make, words):
    with pytest.raises(InputError, match=f"^env=.*: must be one whose model .*: {words} .*model_holds"):
        erl_torch.tabular_mdp(make())
    with pytest.raises(InputError, match=words):
        erl_torch.tabular_mdp(gym.wrappers.TimeLimit(make(), 5))


def test_a_replaced_method_is_seen():
    env = FrozenLakeEnv()
    step = env.step
    env.step = lambda action: step(action)
    with pytest.raises(InputError, match="step of this FrozenLakeEnv was replaced"):
        erl_torch.tabular_mdp(env)
    wrapped = gym.wrappers.TimeLimit(FrozenLakeEnv(), 5)
    wrapped.step = env.step
    with pytest.raises(InputError, match="without TimeLimit"):
        erl_torch.tabular_mdp(wrapped)


def test_a_wrapper_of_ones_own_is_seen_also_where_it_derives_from_a_neutral_one():
    class Doubling(gym.wrappers.TimeLimit):
        def step(self, action):
            state, reward, *rest = super().step(action)
            return state, 2 * float(reward), *rest

    assert changed_by(Doubling(FrozenLakeEnv(), 5)) == "Doubling"
    assert changed_by(gym.make("FrozenLake-v1")) is None
    assert changed_by(encoded(gym.make("FrozenLake-v1"))) is None

    class Renders(gym.wrappers.TimeLimit):
        def render(self):
            return None

    assert changed_by(Renders(FrozenLakeEnv(), 5)) is None


@pytest.mark.filterwarnings("ignore::erl_torch.MeanRewardWarning")
def test_a_class_says_that_its_model_holds():
    np.testing.assert_array_equal(
        erl_torch.tabular_mdp(Trusted()).reward, erl_torch.tabular_mdp(FrozenLakeEnv()).reward
    )
    env = Costly()
    env.model_holds = True  # type: ignore[attr-defined]
    assert erl_torch.tabular_mdp(env).n_states == 16


def test_what_is_not_believed_is_learnt_from_steps():
    with pytest.warns(Note, match="learning from env.step, as Fined overrides step of TabularEnv"):
        data = erl_torch.collect(Fined(), 5, 100, seed=0)
    assert (data.r <= -50).all()
    with pytest.warns(Note, match="learning from env.step"):
        assert known_mdp(Fined()) is None
    with pytest.warns(Note, match="learning from env.step"):
        measured = erl_torch.evaluate(Fined(), np.full((15, 4), 0.25), 1.0, np.random.default_rng(0), 2, 50)
    assert measured.mean_return <= -50 * 50


def test_a_run_on_another_step_proves_nothing(tmp_path, capsys):
    for kind in ("Costly", "Fined"):
        gym.register(f"{kind}-v0", globals()[kind], max_episode_steps=50)
        cfg = composed("env=gym", f"env.id={kind}-v0", "learner=certainty_equivalence", "experience.n_episodes=10",
                       "experience.episode_length=50", "evaluation.pictures=false")  # fmt: skip
        train(cfg, tmp_path / kind)
        assert erl_torch.Solution.load(tmp_path / kind / "solution.npz").theta_bounds is None
        assert f"{kind} overrides step" in capsys.readouterr().err
        gym.registry.pop(f"{kind}-v0")


def test_a_control_task_with_another_step_is_played(recwarn):
    from erl_torch.envs.mountain_car import DiscreteMountainCarEnv

    class Paid(DiscreteMountainCarEnv):
        def step(self, action):
            cell, reward, *rest = super().step(action)
            return cell, reward + 7, *rest

    assert (erl_torch.collect(DiscreteMountainCarEnv(), 2, 20, seed=0).r == -1).all()
    assert (erl_torch.collect(Paid(), 2, 20, seed=0).r == 6).all()


# -- tables P ----------------------------------------------------------------------------------------------------


class Table(gym.Env):
    """An environment that is its table."""

    def __init__(self, table, start, observation_space=None, n_actions=2):
        self.P, self.initial_state_distrib = table, np.asarray(start, float)
        self.observation_space = observation_space or spaces.Discrete(len(start))
        self.action_space = spaces.Discrete(n_actions)


GO, STAY = [(1.0, 1, 0.5, False)], [(0.25, 0, 0.0, False), (0.75, 2, 1.0, True)]
PLAIN = {0: {0: GO, 1: STAY}, 1: {0: STAY, 1: GO}, 2: {0: [(1.0, 2, 0.0, True)], 1: [(1.0, 2, 0.0, True)]}}


def model_by_hand():
    """States 0 and 1 of the table: (transition [2, 2, 3], reward [2, 2]); an end leads to the start, 0."""
    go, stay = (np.array([0.0, 1, 0]), 0.5), (np.array([1.0, 0, 0]), 0.75)
    return np.array([[go[0], stay[0]], [stay[0], go[0]]]), np.array([[go[1], stay[1]], [stay[1], go[1]]])


def numbered(table):
    return {np.int64(s): {np.int64(a): entries for a, entries in row.items()} for s, row in table.items()}


def arrays(table):
    whole = np.empty((3, 2), object)
    for s, a in itertools.product(range(3), range(2)):
        whole[s, a] = table[s][a]
    return whole


@pytest.mark.filterwarnings("ignore::erl_torch.MeanRewardWarning")
@pytest.mark.parametrize(
    "table",
    [
        PLAIN,
        [list(row.values()) for row in PLAIN.values()],
        arrays(PLAIN),
        numbered(PLAIN),
        {str(s): {str(a): e for a, e in row.items()} for s, row in PLAIN.items()},  # as JSON has them
        {0: PLAIN[0], 1: PLAIN[1], 2: {0: [], 1: []}},
        {0: PLAIN[0], 1: PLAIN[1], 2: {}},
        {0: PLAIN[0], 1: PLAIN[1]},
        {0: PLAIN[0], 1: PLAIN[1], 2: {0: [(0.0, 2, 0.0, False)], 1: [(0.0, 2, -np.inf, False)]}},
        {**PLAIN, 0: {0: [(0.0, 0, -np.inf, False), *GO], 1: STAY}},
        {s: {a: [(p, to, r) for p, to, r, _ in e] for a, e in row.items()} for s, row in PLAIN.items() if s < 2},
        {s: {a: np.array(e, float) for a, e in row.items()} for s, row in PLAIN.items()},
    ],
    ids=["dicts", "lists", "array", "numpy keys", "text keys", "empty", "no actions", "absent", "probability 0",
         "0 * -inf", "threes", "float rows"],
)  # fmt: skip
def test_tables_are_read_as_they_are_meant(table):
    env = Table(table, [1, 0, 0])
    transition, reward = model_by_hand()
    mdp = erl_torch.tabular_mdp(env)
    np.testing.assert_allclose(mdp.transition.toarray().reshape(3, 2, 3)[:2], transition)
    np.testing.assert_allclose(mdp.reward[:2], reward)
    np.testing.assert_allclose(mdp.transition.toarray().reshape(3, 2, 3)[2], [[1, 0, 0]] * 2)
    absorbed = erl_torch.tabular_mdp(env, on_end="absorb")
    np.testing.assert_allclose(absorbed.transition.toarray().reshape(3, 2, 3)[2], [[0, 0, 1]] * 2)
    assert (absorbed.reward[2] == 0).all()


@pytest.mark.filterwarnings("ignore::erl_torch.MeanRewardWarning")
@pytest.mark.parametrize(
    "row",
    [
        {0: GO},
        {0: GO, 1: []},
        {0: GO, 1: None},
        {0: GO, 1: [(0.0, 0, 5.0, False)]},
        {0: GO, 1: [(1.0, 0, -np.inf, False)]},
        {0: GO, 1: [(0.5, 0, 1.0, False), (0.5, 2, -np.inf, True)]},
        [GO, ()],
    ],
    ids=["absent", "empty", "none", "probability 0", "-inf", "a part -inf", "tuple"],
)
@pytest.mark.parametrize("on_end", ["restart", "absorb"])
def test_missing_actions_are_missing(row, on_end):
    table = {0: row, 1: PLAIN[1]}
    transition, reward = model_by_hand()
    mdp = erl_torch.tabular_mdp(Table(table, [1, 0, 0]), on_end)
    np.testing.assert_array_equal(mdp.allowed, [[True, False], [True, True], [True, True]])
    if on_end == "restart":
        dense = mdp.transition.toarray().reshape(3, 2, 3)
        np.testing.assert_allclose(dense[1], transition[1])
        np.testing.assert_allclose(dense[0, 0], transition[0, 0])
        np.testing.assert_allclose(mdp.reward[mdp.allowed], [0.5, 0.75, 0.5, 0, 0])
        best = erl_torch.solve_soft_bellman(mdp, 3.0)
        # State 0 goes on surely; the uniform prior of one action costs nothing.
        alone = TabularMDP([[[0.0, 1.0]] * 2, [[1.0, 0.0], [0.0, 1.0]]], [[0.5, 0.5], reward[1]], [1.0, 0.0])
        assert best.theta is not None
        np.testing.assert_allclose(best.theta, erl_torch.solve_soft_bellman(alone, 3.0).theta, rtol=1e-9)
        assert best.policy[0].tolist() == [1.0, 0.0]


@pytest.mark.filterwarnings("ignore::erl_torch.MeanRewardWarning")
@pytest.mark.parametrize(
    ("space", "name"),
    [
        (spaces.Discrete(3, start=1), lambda s: s + 1),
        (spaces.Tuple((spaces.Discrete(3), spaces.Discrete(1))), lambda s: (s, 0)),
    ],
)
def test_tables_have_the_states_of_their_space(space, name):
    table = {
        name(s): {a: [(p, name(to), r, end) for p, to, r, end in e] for a, e in row.items()} for s, row in PLAIN.items()
    }
    mdp = erl_torch.tabular_mdp(encoded(Table(table, [1, 0, 0], space)))
    other = erl_torch.tabular_mdp(Table(PLAIN, [1, 0, 0]))
    np.testing.assert_array_equal(mdp.transition.toarray(), other.transition.toarray())
    np.testing.assert_array_equal(mdp.reward, other.reward)


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({0: {0: GO, 1: GO}, 1: {0: GO, 1: GO}, 3: {}}, r"P: key=3: must be in Discrete\(3\)"),
        ({0: {0: GO, 2: GO}, 1: {0: GO}}, r"P\[0\]: key=2: must be in Discrete\(2\)"),
        ({0: {0: GO, "0": GO}}, r"P\[0\]: key=0: must be there once only"),
        ({0: {0: [(1.0, 2, 0.0, False)], 1: GO}, 1: {0: GO, 1: GO}}, r"P\[0\]\[0\]: s'=2: must be one with entries"),
        ({0: {0: [(1.0, 1)]}}, r"P\[0\]\[0\]=\(1.0, 1\): must be a list of \(p, s', reward, terminated\)"),
        ({0: {0: [("a", 1, 0.0)]}}, r"P\[0\]\[0\]=.*of numbers"),
        ({0: {0: [(1.0, 1, np.nan, False)]}}, r"P\[0\]\[0\]: reward=nan: must be finite"),
        ({0: {0: [(-1.0, 1, 0.0, False)]}}, r"P\[0\]\[0\]: probability=-1.0: must be finite and >= 0"),
        ({0: {0: [(1.0, 0.5, 0.0, False)]}}, r"P\[0\]\[0\]: s'=0.5: must be in"),
        ({0: {0: [(1.0, 1, 0.0, "no")]}}, r"P\[0\]\[0\]: terminated='no': must be True or False"),
        ({0: {0: 1.0}}, r"P\[0\]\[0\]=1.0 \(float\): must be P\[s\]\[a\] ="),
        ({0: GO[0]}, r"P\[0\]=4 items: must be a dict, or a list of 2"),
        ({}, "P=dict: must be a table with entries"),
        (7, r"P=7 \(int\)"),
        (np.zeros((3, 2, 3)), r"P\[0\]\[0\]=0.0|P\[0\]\[0\]=np.float64\(0.0\)"),
    ],
)
def test_other_tables_are_named(table, words):
    with pytest.raises(InputError, match=words) as error:
        erl_torch.tabular_mdp(Table(table, [1, 0, 0]))
    assert "\n" not in str(error.value)


def test_a_start_where_nothing_is_known_is_named():
    with pytest.raises(InputError, match=r"start\[2\]=0.5: must be 0, as P has no entries"):
        erl_torch.tabular_mdp(Table({0: PLAIN[0], 1: PLAIN[1]}, [0.5, 0, 0.5]))


def test_the_environment_of_the_command_line_is_encoded():
    with contextlib.closing(make_env(composed("env=gym", "env.id=Blackjack-v1").env)) as env:
        assert env.observation_space == spaces.Discrete(704)
        states, actions = labels_of(env)
    assert states is not None
    assert states.decode(703) == (31, 10, 1)
    assert actions is None


@pytest.mark.parametrize("part", ["observation", "reward", "info"])
def test_a_vector_hands_on_what_is_wrong_in_one_line(part):
    """What one of its environments returned ended in NumPy's own words."""
    values: dict[str, list[Any]] = {
        "observation": [0.5, None, "s", [1]],
        "reward": [10**400, None],
        "info": [None, [], "x"],
    }
    wrong = values[part]

    class Odd(gym.Env):
        observation_space, action_space, value = gym.spaces.Discrete(3), gym.spaces.Discrete(2), None

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            self.t = 0
            return 0, {}

        def step(self, action):
            self.t += 1
            own = {part: self.value} if self.t == 3 else {}
            return own.get("observation", 1), own.get("reward", 0.0), False, False, own.get("info", {})

    for value in wrong:
        kind = type("Odd", (Odd,), {"value": value})
        for env in (kind(), gym.vector.SyncVectorEnv([kind, kind])):
            with pytest.raises(InputError, match="step 3"):
                erl_torch.collect(env, 2, 10)


def paying(self, action):
    return 0, 99.0, False, False, {}


class Counting(FrozenLakeEnv):
    """Its step is its parent's."""

    model_holds = True

    def step(self, action):
        return super().step(action)


@pytest.mark.parametrize(
    "own",
    [
        type("Derived", (Counting,), {"step": paying}),
        type("Partial", (FrozenLakeEnv,), {"step": partialmethod(paying)}),
        type("Property", (FrozenLakeEnv,), {"step": property(lambda self: lambda action: paying(self, action))}),
    ],
)
def test_a_word_is_not_inherited_by_another_step(own):
    """The model of the lake was proven bounds of."""
    with pytest.raises(InputError, match="one whose model describes its steps"):
        erl_torch.tabular_mdp(own())


@pytest.mark.filterwarnings("ignore::erl_torch.MeanRewardWarning")
def test_a_class_that_was_patched_is_not_believed(monkeypatch):
    assert erl_torch.tabular_mdp(Counting()).n_states == 16
    monkeypatch.setattr(FrozenLakeEnv, "step", paying)
    with pytest.raises(InputError, match="step of FrozenLakeEnv was replaced"):
        erl_torch.tabular_mdp(FrozenLakeEnv())


def test_a_table_that_leaves_a_part_out_is_learnt_from_steps(tmp_path):
    """Taxi with a fickle passenger; the question how its episodes end was an error."""
    cfg = composed(
        "env=gym", "env.id=Taxi-v4", "++env.kwargs.fickle_passenger=true", "learner=certainty_equivalence",
        "experience.n_episodes=2", "experience.episode_length=50", "evaluation.n_episodes=1",
        "evaluation.pictures=false",
    )  # fmt: skip
    assert train(cfg, tmp_path)["n_experience"] > 0
