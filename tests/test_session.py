"""A logged run from Python: the run of the command line, silent, and gone on with."""

import collections
import copy
import dataclasses
import enum
import functools
import json
import os
import re
import shutil
import subprocess
import sys
import threading
import time
import types
import warnings
from dataclasses import dataclass, field
from decimal import Decimal
from fractions import Fraction
from pathlib import Path
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import pytest
import torch
import yaml
from helpers import composed, scalars

import erl_torch
from erl_torch import (
    AlgorithmS1,
    EvaluationSettings,
    InputError,
    NonFiniteError,
    Note,
    Replicas,
    Simulation,
    Status,
    StreamLearner,
)
from erl_torch.envs.tabular import TabularEnv
from erl_torch.envs.windy_cliff import WindyCliffEnv
from erl_torch.experience.sources import Simulate
from erl_torch.learners import CertaintyEquivalence, Exact
from erl_torch.learners.learner import columns
from erl_torch.learners.s1.algorithm import S1State
from erl_torch.log.event_file import EventFile
from erl_torch.log.tensorboard import hyperparameters
from erl_torch.run.checkpoint import check_state, decode, encode
from erl_torch.run.groups import Group, Record
from erl_torch.run.identity import plain
from erl_torch.run.replicas import ReplicaRecorder, _status
from erl_torch.run.training import train as train_configured
from erl_torch.solvers.policy import objective

MDP = WindyCliffEnv().mdp
SHORT = AlgorithmS1(n_epochs=2, n_bias=2)
QUICK = EvaluationSettings(n_episodes=2, pictures=False)
pytestmark = pytest.mark.filterwarnings("ignore::erl_torch.Note")


@pytest.fixture
def tuples():
    return erl_torch.collect(MDP, 20, 200, seed=0)


def test_it_is_the_run_of_the_command_line(tmp_path, capfd):
    """The same records and tables, and nothing is printed or set."""
    cfg = composed(
        "learner.n_epochs=2",
        "learner.n_bias=2",
        "experience.n_episodes=20",
        "experience.episode_length=200",
        "evaluation.n_episodes=2",
        "evaluation.pictures=false",
    )
    result = train_configured(cfg, tmp_path / "typed")
    capfd.readouterr()
    threads, filters = torch.get_num_threads(), list(warnings.filters)
    env = gym.make("erl_torch/WindyCliff-v0")
    solution = erl_torch.train(SHORT, env, Simulate(20, 200), directory=tmp_path / "called", evaluation=QUICK)
    assert capfd.readouterr() == ("", "")
    assert (torch.get_num_threads(), list(warnings.filters)) == (threads, filters)
    assert (tmp_path / "called" / "solution.npz").read_bytes() == (tmp_path / "typed" / "solution.npz").read_bytes()
    assert scalars(tmp_path / "called") == scalars(tmp_path / "typed")
    again = json.loads((tmp_path / "called" / "result.json").read_text())
    free = ("env", "learner", "seconds", "seconds_learning")
    assert {k: v for k, v in again.items() if k not in free} == {k: v for k, v in result.items() if k not in free}
    assert solution.theta == result["theta"]


@dataclass(frozen=True)
class Nothing(erl_torch.Source):
    """A source that gives none."""

    def __call__(self, problem, seed, report):
        return None


def test_a_stopped_run_goes_on_and_a_complete_one_is_read(tmp_path, tuples, monkeypatch):
    whole = erl_torch.train(SHORT, MDP, tuples, directory=tmp_path / "whole", evaluation=QUICK)
    step, steps = AlgorithmS1.step, []

    def stopping(*arguments):
        if len(steps) == 2:
            raise KeyboardInterrupt
        steps.append(1)
        return step(*arguments)

    monkeypatch.setattr(AlgorithmS1, "step", stopping)
    with pytest.raises(KeyboardInterrupt):
        erl_torch.train(SHORT, MDP, tuples, directory=tmp_path / "cut", evaluation=QUICK)
    monkeypatch.setattr(AlgorithmS1, "step", step)
    erl_torch.train(SHORT, MDP, tuples, directory=tmp_path / "cut", evaluation=QUICK)
    assert (tmp_path / "cut" / "solution.npz").read_bytes() == (tmp_path / "whole" / "solution.npz").read_bytes()
    assert scalars(tmp_path / "cut") == scalars(tmp_path / "whole")
    monkeypatch.setattr(AlgorithmS1, "step", None)  # it learns no more
    read = erl_torch.train(SHORT, MDP, tuples, directory=tmp_path / "whole", evaluation=QUICK)
    assert torch.equal(read.policy, whole.policy)


def test_replicas_of_two_temperatures(tmp_path, tuples):
    """Groups are neighbours of the same settings; each replica is the run of its learner alone."""
    replicas = Replicas.of(SHORT, beta=[2.0, 2.0, 5.0, 5.0])
    simulation = Simulation(MDP, 20, 200, seeds=[0, 1, 0, 1])
    solution = erl_torch.train(replicas, MDP, simulation, directory=tmp_path, evaluation=QUICK)
    result = json.loads((tmp_path / "result.json").read_text())
    assert [group["settings"] for group in result["groups"]] == [{"beta": 2.0}, {"beta": 5.0}]
    assert {path.name for path in tmp_path.iterdir()} >= {"replicas.npz", "bands.png", "sweep.png"}
    alone = AlgorithmS1(beta=5.0, n_epochs=2, n_bias=2).fit(erl_torch.collect(MDP, 20, 200, seed=1), 15, 4)
    assert torch.equal(solution[3].policy, alone.policy)


def test_the_exact_solver_runs_without_experience(tmp_path):
    solution = erl_torch.train(Exact(), MDP, directory=tmp_path, evaluation=QUICK)
    assert solution.theta == pytest.approx(1.0101363366, abs=1e-8)  # value iteration in 50 digits
    assert scalars(tmp_path)["learner/theta_lower"][-1][1] == pytest.approx(1.0101363, abs=1e-6)


def test_notes_are_warnings_of_the_caller(tmp_path):
    """A stream that meets 14 of 15 states."""
    few = erl_torch.collect(MDP, 2, 100, seed=0)
    with pytest.warns(Note, match="the stream meets") as warned:
        erl_torch.train(SHORT, MDP, few, directory=tmp_path, evaluation=QUICK)
    assert {one.filename for one in warned} == {__file__}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"learner": "s1"}, "learner=s1: must be a learner, as AlgorithmS1()"),
        ({"problem": 3}, "problem=3"),
        ({"experience": None}, "experience=NoneType: must be given: tuples, or a source of them"),
        ({"learner": Exact()}, "experience=Transitions: must be None: the learner solves the model"),
        ({"seed": -1}, "seed=-1"),
        ({"checkpoint_every": -1}, "checkpoint_every=-1"),
        ({"checkpoint_every": "often"}, "checkpoint_every=often"),
    ],
)
def test_bad_arguments_are_named(tmp_path, tuples, change, message):
    arguments = {"learner": SHORT, "problem": MDP, "experience": tuples, "directory": tmp_path / "run"} | change
    with pytest.raises(InputError) as error:
        erl_torch.train(**arguments)
    assert str(error.value).startswith(message)
    assert not (tmp_path / "run").exists()


OTHERS: dict[str, Any] = {
    "seed": lambda: {"seed": 1},
    "settings": lambda: {"learner": AlgorithmS1(n_epochs=3, n_bias=2)},
    "class of the same settings": lambda: {"learner": type("AlgorithmS1", (AlgorithmS1,), {})(n_epochs=2, n_bias=2)},
    "model": lambda: {"problem": WindyCliffEnv(wind_strength=0.5).mdp},
    "tuples": lambda: {"experience": erl_torch.collect(MDP, 20, 200, seed=1)},
    "horizon": lambda: {"evaluation": EvaluationSettings(n_episodes=2, pictures=False, horizon=7)},
}


@pytest.mark.parametrize("other", OTHERS)
def test_a_directory_of_another_run_is_refused(tmp_path, tuples, other):
    arguments = {"learner": SHORT, "problem": MDP, "experience": tuples, "directory": tmp_path, "evaluation": QUICK}
    erl_torch.train(**arguments)
    other = OTHERS[other]()
    with pytest.raises(InputError, match="with these settings, or a new one"):
        erl_torch.train(**(arguments | other))


# -- learners of one's own that a run cannot hold -------------------------------------------------------------


def test_an_environment_without_a_model_is_known_by_its_arguments(tmp_path):
    lakes = [gym.make("FrozenLake-v1", is_slippery=slippery) for slippery in (True, False)]
    tuples = erl_torch.collect(lakes[0], 20, 50, seed=0)
    erl_torch.train(SHORT, lakes[0], tuples, directory=tmp_path, evaluation=QUICK)
    with pytest.raises(InputError, match=r"env\.kwargs\.is_slippery=False"):
        erl_torch.train(SHORT, lakes[1], tuples, directory=tmp_path, evaluation=QUICK)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"learner": AlgorithmS1}, "must be a learner, as AlgorithmS1"),
        ({"evaluation": {}}, "evaluation="),
        ({"experience": "tuples.npz"}, "experience="),
        ({"experience": Nothing()}, "experience="),
    ],
)
def test_arguments_of_other_types_are_named(tmp_path, tuples, change, message):
    arguments = {"learner": SHORT, "problem": MDP, "experience": tuples, "directory": tmp_path / "run"} | change
    with pytest.raises(InputError, match=message):
        erl_torch.train(**arguments)


@dataclass(frozen=True)
class Counted:
    n_tuples: int
    epoch: int
    policy: torch.Tensor
    more: object = None
    theta: ClassVar[None] = None
    reward_bias: ClassVar[None] = None

    def metrics(self):
        return self.more if isinstance(self.more, dict) and self.epoch else {"epoch": self.epoch}


@dataclass(frozen=True)
class Counts(StreamLearner):
    """Three passes, of which ``second`` is what the state of the second holds."""

    states: ClassVar[tuple[type, ...]] = (Counted,)
    beta: float = 10.0
    prior_policy: None = None
    first: object = None
    second: object = None

    def init(self, n_states, n_actions):
        return Counted(0, 0, torch.full((n_states, n_actions), 1 / n_actions, dtype=torch.float64), self.first)

    def prepare(self, transitions, n_states, n_actions):
        return len(transitions)

    def step(self, state, stream):
        more = self.second if state.epoch == 1 else None
        return Counted(state.n_tuples + stream, state.epoch + 1, state.policy, more)

    def finished(self, state):
        return state.epoch == 3

    def solution(self, state, history=(), failure=None):
        q = torch.zeros_like(state.policy)
        end = {"n_steps": state.n_tuples, "status": self.ended(state, failure), "history": columns(history)}
        return erl_torch.Solution.of_action_values(q, state.policy, self.beta, None, **end)


class Odd:
    pass


@dataclass(frozen=True)
class NotNamed(Counts):
    states: ClassVar[tuple[type, ...]] = ()


@pytest.mark.parametrize(
    ("learner", "message"),
    [
        (Counts(first=Odd()), "learner=Counts: must be a learner whose states are of numbers.*a Odd has no place"),
        (NotNamed(), r"learner=NotNamed: must be .*the classes in its states \(unknown class Counted"),
    ],
)
def test_what_no_checkpoint_can_hold_is_refused_at_the_start(tmp_path, tuples, learner, message):
    with pytest.raises(InputError, match=message):
        erl_torch.train(learner, MDP, tuples, directory=tmp_path / "run", evaluation=QUICK)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("second", "message"),
    [
        ({"epoch": "two"}, "metrics of the learner, epoch=two: must be a number"),
        ({"pass": 2}, "metrics of the learner=epoch, pass: must be the same names in every state"),
    ],
)
def test_metrics_that_change_end_the_run_and_what_was_learnt_is_kept(tmp_path, tuples, second, message):
    with pytest.raises(InputError) as error:
        erl_torch.train(Counts(second=second), MDP, tuples, directory=tmp_path, evaluation=QUICK)
    assert str(error.value).startswith(message)
    result = json.loads((tmp_path / "result.json").read_text())
    assert (result["status"], result["n_tuples"]) == ("stopped", len(tuples))


class Kind(enum.Flag):
    A = 1
    B = 2


@dataclass(frozen=True)
class Kinds(Counts):
    states: ClassVar[tuple[type, ...]] = (Counted, Kind)


def test_containers_numbers_and_arrays_come_back_as_what_they_were(tmp_path, tuples, monkeypatch):
    """Of the same types: arithmetic of single precision goes on in single precision."""
    numbers = {"s": np.float32(1.5), "i": np.int8(3), "b": np.bool_(True), "kind": Kind.A | Kind.B}
    held: dict[Any, Any] = {"a": [1, 2.5, None, True, "x", (3,)], 4: np.arange(3.0), "t": torch.ones(2), **numbers}
    step = Counts.step
    back: list[Any] = []

    def stopping(self, state, stream):
        back.append(state.more and state.more[0])
        if len(back) == 3:
            raise KeyboardInterrupt
        return step(self, state, stream)

    monkeypatch.setattr(Counts, "step", stopping)
    arguments = {"directory": tmp_path, "evaluation": QUICK}
    with pytest.raises(KeyboardInterrupt):
        erl_torch.train(Kinds(second=[held]), MDP, tuples, **arguments)
    erl_torch.train(Kinds(second=[held]), MDP, tuples, **arguments)
    assert back[3].keys() == held.keys()
    for key, value in held.items():
        assert type(back[3][key]) is type(value)
        if isinstance(value, np.ndarray | torch.Tensor):
            assert (back[3][key] == value).all()
        else:
            assert back[3][key] == value
    assert [type(item) for item in back[3]["a"]] == [type(item) for item in held["a"]]


@pytest.mark.parametrize(
    "value",
    [
        collections.OrderedDict(a=1),
        collections.Counter("ab"),
        np.ma.masked_array([1.0, 2.0], [True, False]),
        torch.ones(2, requires_grad=True),
        np.longdouble(1),
        {1, 2},
        np.array(["a"], object),
    ],
    ids=lambda value: type(value).__name__,
)
def test_what_would_come_back_as_another_is_refused(tmp_path, tuples, value):
    with pytest.raises(InputError, match="learner=Counts: must be a learner whose states are of"):
        erl_torch.train(Counts(first=value), MDP, tuples, directory=tmp_path / "run", evaluation=QUICK)


@pytest.mark.parametrize("lr_rho", [None, 0.01])
def test_settings_of_any_kind_make_groups(tmp_path, tuples, lr_rho):
    """Wherever they stand among the replicas; text and truth values too."""
    learners = [
        AlgorithmS1(beta, lr_rho=rate, n_epochs=1, n_bias=1, clip_rho=clip)
        for beta, rate, clip in ((2.0, None, True), (5.0, lr_rho, True), (2.0, None, True), (5.0, lr_rho, False))
    ]
    replicas = Replicas(tuple(learners))
    solution = erl_torch.train(replicas, MDP, tuples, directory=tmp_path, evaluation=QUICK)
    result = json.loads((tmp_path / "result.json").read_text())
    assert [group["replicas"] for group in result["groups"]] == [2, 1, 1]
    assert [group["settings"]["clip_rho"] for group in result["groups"]] == [True, True, False]
    assert [group["theta"]["mean"] for group in result["groups"]] == pytest.approx(
        [(solution[0].theta + solution[2].theta) / 2, solution[1].theta, solution[3].theta], rel=1e-15
    )
    steps = [step for step, _ in scalars(tmp_path)["beta_2-clip_rho_True/theta_mean" if lr_rho is None else
             "beta_2-lr_rho_None-clip_rho_True/theta_mean"]]  # fmt: skip
    assert len(set(steps)) == len(steps)


@dataclass(frozen=True)
class array:
    class_: int
    arguments: int
    of: int
    late: int = field(init=False, default=0)

    def __post_init__(self):
        object.__setattr__(self, "late", self.late + self.of)
        object.__setattr__(self, "of", self.of + 1)  # done twice, it is another


@dataclass(frozen=True)
class Strange(Counts):
    states: ClassVar[tuple[type, ...]] = (Counted, array)


def test_classes_of_a_state_come_back_as_they_were():
    there = array(1, 2, 3)
    back = decode(encode(there), (array,))
    assert back == there
    assert (back.late, back.of) == (3, 4)
    check_state(Counted(0, 0, torch.ones(1, 1), there), Strange.states)


@dataclass(frozen=True)
class Evaluation:
    x: int


@pytest.mark.parametrize(
    "classes", [(Counted, Evaluation), (Counted, type("Counted", (Counted,), {}))], ids=["common", "own"]
)
def test_two_classes_of_one_name_are_refused(classes):
    with pytest.raises(InputError, match="two classes are called"):
        check_state(Counted(0, 0, torch.ones(1, 1)), classes)


@pytest.mark.parametrize("epoch", [None, "one", 2**70, [1, "x"]])
def test_metrics_of_the_start_are_numbers(tmp_path, tuples, monkeypatch, epoch):
    monkeypatch.setattr(Counted, "metrics", lambda self: {"passes": epoch})
    with pytest.raises(InputError, match="metrics of the learner, passes="):
        erl_torch.train(Counts(), MDP, tuples, directory=tmp_path / "run", evaluation=QUICK)
    assert not (tmp_path / "run").exists()


def test_a_learner_that_fails_at_its_end_loses_nothing(tmp_path, tuples, monkeypatch):
    """Mended, it goes on from what was learnt."""
    solution = Counts.solution

    def failing(self, state, history=(), failure=None):
        raise ZeroDivisionError("in the last line")

    monkeypatch.setattr(Counts, "solution", failing)
    with pytest.raises(ZeroDivisionError):
        erl_torch.train(Counts(), MDP, tuples, directory=tmp_path, evaluation=QUICK)
    monkeypatch.setattr(Counts, "solution", solution)
    monkeypatch.setattr(Counts, "step", None)  # nothing is left to learn
    learnt = erl_torch.train(Counts(), MDP, tuples, directory=tmp_path, evaluation=QUICK)
    assert learnt.n_steps == 3 * len(tuples)


def test_episodes_end_at_the_environments_own_limit(tmp_path):
    """FrozenLake's are of 100 steps: figures over more would be of another problem."""
    lake = gym.make("FrozenLake-v1")
    tuples = erl_torch.collect(lake, 20, 50, seed=0)
    erl_torch.train(SHORT, lake, tuples, directory=tmp_path, evaluation=QUICK)
    assert json.loads((tmp_path / "settings.json").read_text())["env.horizon"] == lake.spec.max_episode_steps == 100


def test_streams_in_another_order_are_another_run(tmp_path, tuples):
    streams = [tuples, erl_torch.collect(MDP, 20, 200, seed=1)]
    replicas = Replicas.of(SHORT, 2)
    erl_torch.train(replicas, MDP, streams, directory=tmp_path, evaluation=QUICK)
    with pytest.raises(InputError, match="with these settings, or a new one: not these tuples"):
        erl_torch.train(replicas, MDP, streams[::-1], directory=tmp_path, evaluation=QUICK)


# -- what a directory is of ------------------------------------------------------------------------------


class Mode(enum.Enum):
    A = 1
    B = 2


class Word(enum.StrEnum):
    A = "a"
    B = "b"


class Slots:
    __slots__ = ("x",)

    def __init__(self, x):
        self.x = x


def tripled(x):
    return 3 * x


PAIRS = [
    (Mode.A, Mode.B),
    (Word.A, Word.B),
    ({1, 2}, {1, 3}),
    (frozenset("ab"), frozenset("ac")),
    (1j, 2j),
    (Fraction(1, 3), Fraction(1, 4)),
    (Decimal("1.0"), Decimal("1.1")),
    (b"ab", b"ac"),
    (Path("a"), Path("b")),
    (np.datetime64("2026-01-01"), np.datetime64("2026-01-02")),
    (slice(1), slice(2)),
    (lambda x: x + 1, lambda x: x + 2),
    (functools.partial(tripled, 1), functools.partial(tripled, 2)),
    (Slots(1), Slots(2)),
    (types.SimpleNamespace(a=1), types.SimpleNamespace(a=2)),
    (10**400, 10**401),
    (np.arange(3), np.arange(3.0)),
    (np.array([1, "a"], object), np.array([1, "b"], object)),
    ([1, [2]], [1, [3]]),
    ({"a": 1}, {"a": 2}),
    (torch.zeros(2), torch.ones(2)),
    (torch.zeros(2, dtype=torch.bfloat16), torch.zeros(2)),
    (lambda x, k=1: x + k, lambda x, k=2: x + k),
    ({0: 0.1}.get, {0: 0.2}.get),
    (functools.lru_cache(lambda x: x), functools.lru_cache(lambda x: 2 * x)),
    (collections.OrderedDict(a=1, b=2), collections.OrderedDict(b=2, a=1)),
    (collections.defaultdict(int), collections.defaultdict(list)),
    ({1: "a"}, {"1": "a"}),
    ({1}, {"1"}),
    (np.ma.masked_array([1, 2], [0, 1]), np.ma.masked_array([1, 2], [0, 0])),
    (np.sin, np.cos),
    (re.compile("a"), re.compile("b")),
    (np.random.default_rng(1), np.random.default_rng(2)),
]


def test_a_text_is_the_same_in_every_process():
    """A set's order is not: a run that was killed was refused when it was called again."""
    program = (
        "from erl_torch.run.identity import plain; print(plain('f', [lambda x: x in {'alpha', 'beta'}, {'c', 'd'}]))"
    )
    texts = {
        subprocess.run(
            [sys.executable, "-c", program], env={**os.environ, "PYTHONHASHSEED": seed}, capture_output=True, check=True
        ).stdout
        for seed in ("1", "2")
    }
    assert len(texts) == 1


@pytest.mark.parametrize(("one", "other"), PAIRS, ids=lambda value: type(value).__name__)
def test_settings_that_differ_are_told_apart(one, other):
    """A complete directory gave the solution of the other."""
    first, second = plain("setting", one), plain("setting", other)
    assert json.loads(json.dumps(first)) != json.loads(json.dumps(second))
    assert yaml.safe_load(yaml.safe_dump(first)) == json.loads(json.dumps(first))
    assert plain("setting", copy.deepcopy(one)) == first


def test_a_setting_that_nothing_tells_is_refused():
    with pytest.raises(InputError, match=r"setting=of class _thread.lock: must be a value that can be told"):
        plain("setting", threading.Lock())
    deep = value = []
    for _ in range(50):
        value.append([])
        value = value[0]
    with pytest.raises(InputError, match="objects deep"):
        plain("setting", deep)


def test_wrappers_and_limits_belong_to_a_run(tmp_path):
    def learnt(env):
        return erl_torch.train(SHORT, env, Simulate(5, 20), directory=tmp_path, evaluation=QUICK)

    learnt(gym.make("FrozenLake-v1", max_episode_steps=10))
    for other in (
        gym.make("FrozenLake-v1", max_episode_steps=20),
        gym.wrappers.TransformReward(gym.make("FrozenLake-v1", max_episode_steps=10), lambda r: 2 * float(r)),
    ):
        with pytest.raises(InputError, match="of a run with these settings"):
            learnt(other)


# -- how a run ends ----------------------------------------------------------------------------------------


class Failing(AlgorithmS1):
    """Fails after ``good`` epochs."""

    good: ClassVar[int] = 3
    error: ClassVar[BaseException] = KeyboardInterrupt()

    def step(self, state, stream):
        if state.n_tuples >= self.good * len(stream.data):
            raise self.error
        return super().step(state, stream)


@pytest.mark.parametrize("error", [KeyboardInterrupt(), NonFiniteError(7, "lost"), RuntimeError("lost")])
def test_the_last_epoch_is_recorded_however_the_run_ends(tmp_path, tuples, error, monkeypatch):
    """The figures were those of the record before: the prior's."""
    monkeypatch.setattr(Failing, "error", error)
    rare = dataclasses.replace(QUICK, every=100)
    with pytest.raises(type(error)):
        erl_torch.train(Failing(), MDP, tuples, directory=tmp_path, evaluation=rare)
    result = json.loads((tmp_path / "result.json").read_text())
    policy = np.load(tmp_path / "solution.npz")["policy"]
    assert result["objective"] == pytest.approx(float(objective(MDP, policy, np.full((15, 4), 0.25), 10.0)), abs=1e-9)
    assert scalars(tmp_path)["eval/objective"][-1][0] == 3 * len(tuples)


def test_the_same_bits_after_a_stop_between_records(tmp_path, tuples, monkeypatch):
    rare = dataclasses.replace(QUICK, every=4)
    learner = Failing(n_epochs=5, n_bias=2)
    monkeypatch.setattr(Failing, "good", 10**9)
    erl_torch.train(learner, MDP, tuples, directory=tmp_path / "whole", evaluation=rare)
    monkeypatch.setattr(Failing, "good", 2)
    with pytest.raises(KeyboardInterrupt):
        erl_torch.train(learner, MDP, tuples, directory=tmp_path / "cut", evaluation=rare)
    monkeypatch.setattr(Failing, "good", 10**9)
    erl_torch.train(learner, MDP, tuples, directory=tmp_path / "cut", evaluation=rare)
    assert (tmp_path / "cut/solution.npz").read_bytes() == (tmp_path / "whole/solution.npz").read_bytes()
    assert scalars(tmp_path / "cut") == scalars(tmp_path / "whole")


def test_a_run_whose_end_fails_is_not_complete(tmp_path, tuples, monkeypatch):
    """It was "completed" for ever, without certificate; its records at the end came twice."""
    whole = erl_torch.train(SHORT, MDP, tuples, directory=tmp_path / "whole", evaluation=QUICK)
    for error in (OSError("disk full"), KeyboardInterrupt()):
        directory = tmp_path / type(error).__name__
        with monkeypatch.context() as patch:
            patch.setattr("erl_torch.run.single.with_bounds", raising(error))
            with pytest.raises(type(error)):
                erl_torch.train(SHORT, MDP, tuples, directory=directory, evaluation=QUICK)
        result = directory / "result.json"
        assert not result.exists() or json.loads(result.read_text())["status"] == "stopped"
        again = erl_torch.train(SHORT, MDP, tuples, directory=directory, evaluation=QUICK)
        assert again.gap == whole.gap
        assert scalars(directory) == scalars(tmp_path / "whole")


def raising(error):
    def fail(*_, **__):
        raise error

    return fail


class Diverging(AlgorithmS1):
    """theta stays a number; the policy does not."""

    def step(self, state, stream):
        after = super().step(state, stream)
        return dataclasses.replace(after, u=after.u * float("nan")) if after.n_tuples > 2 * len(stream.data) else after


def test_a_policy_that_is_lost_is_non_finite(tmp_path, tuples):
    """... said "stopped by the caller", and lost the run in the JSON of its result."""
    for _ in range(2):  # a complete run says so again
        with pytest.raises(NonFiniteError, match=r"no numbers|theta is nan"):
            erl_torch.train(Diverging(), MDP, tuples, directory=tmp_path, evaluation=QUICK)
    result = json.loads((tmp_path / "result.json").read_text())
    assert result["status"] == "non_finite"
    assert np.isfinite(np.load(tmp_path / "solution.npz")["policy"]).all()


def test_a_directory_taken_away_is_said(tmp_path, tuples):
    class Removed(AlgorithmS1):
        def step(self, state, stream):
            if state.n_tuples == 2 * len(tuples):
                shutil.rmtree(tmp_path / "run")
            return super().step(state, stream)

    with pytest.warns(Note, match="was taken away while the run wrote to it"):
        first = erl_torch.train(Removed(), MDP, tuples, directory=tmp_path / "run", evaluation=QUICK)
    again = erl_torch.train(Removed(), MDP, tuples, directory=tmp_path / "run", evaluation=QUICK)
    assert again.theta == first.theta


def test_two_runs_in_a_new_directory(tmp_path):
    """The one that came later overwrote the other's result."""

    @dataclass(frozen=True, eq=False)
    class Slow(Simulate):
        def __call__(self, problem, seed, report):
            with pytest.raises(InputError, match="no other run is writing to"):
                erl_torch.train(SHORT, MDP, Simulate(5, 20), directory=tmp_path / "run", evaluation=QUICK)
            return super().__call__(problem, seed, report)

    erl_torch.train(SHORT, MDP, Slow(5, 20), directory=tmp_path / "run", evaluation=QUICK)


def test_bad_input_after_a_stop_leaves_the_directory_alive(tmp_path, tuples, monkeypatch):
    monkeypatch.setattr(Failing, "good", 0)
    monkeypatch.setattr(Failing, "error", KeyboardInterrupt())
    with pytest.raises(KeyboardInterrupt):
        erl_torch.train(Failing(), MDP, tuples, directory=tmp_path, evaluation=QUICK)
    monkeypatch.setattr(Failing, "error", InputError("tuples", 1, "others"))
    with pytest.raises(InputError, match="others"):
        erl_torch.train(Failing(), MDP, tuples, directory=tmp_path, evaluation=QUICK)
    monkeypatch.setattr(Failing, "good", 10**9)
    assert erl_torch.train(Failing(), MDP, tuples, directory=tmp_path, evaluation=QUICK).theta > 0


def test_an_exact_solver_that_is_stopped_at_once_can_go_on(tmp_path, monkeypatch):
    """It was REDUCIBLE for ever."""
    with monkeypatch.context() as patch:
        patch.setattr(Exact, "iterate", raising(KeyboardInterrupt()))
        with pytest.raises(KeyboardInterrupt):
            erl_torch.train(Exact(beta=2.0), MDP, directory=tmp_path, evaluation=QUICK)
    assert erl_torch.train(Exact(beta=2.0), MDP, directory=tmp_path, evaluation=QUICK).status.name == "CONVERGED"


# -- replicas ------------------------------------------------------------------------------------------------


class Averaged(AlgorithmS1):
    """Another step than its parent's."""

    def step(self, state, stream):
        after = super().step(state, stream)
        return dataclasses.replace(after, u=(after.u + state.u) / 2)


def test_replicas_of_a_derived_class_are_its_own():
    """The parent's compiled loop ran instead."""
    learner = Averaged(n_epochs=2, n_bias=2)
    many = Replicas.of(learner, 2).fit(Simulation(MDP, 20, 100, seeds=[3, 4]), 15, 4)
    for r, seed in enumerate((3, 4)):
        alone = learner.fit(erl_torch.collect(MDP, 20, 100, seed=seed), 15, 4)
        assert many[r].theta == alone.theta
        assert torch.equal(many[r].policy, alone.policy)


def test_replicas_are_told_by_their_own_seeds(tmp_path, capsys):
    replicas = Replicas.of(SHORT, 2)
    erl_torch.train(
        replicas, MDP, Simulation(MDP, 5, 20, seeds=[7, 42]), directory=tmp_path, evaluation=QUICK, talks=True
    )
    assert "2 replicas (2 seeds from 7 to 42)" in capsys.readouterr().out
    assert json.loads((tmp_path / "result.json").read_text())["seed"] == 7


def test_settings_that_print_alike_have_their_own_curves(tmp_path, tuples):
    erl_torch.train(Replicas.of(SHORT, beta=[2.0, 2.0000001]), MDP, tuples, directory=tmp_path, evaluation=QUICK)
    tags = {tag.split("/")[0] for tag in scalars(tmp_path) if tag.startswith("beta")}
    assert tags == {"beta_2", "beta_2.0000001"}


@pytest.mark.parametrize(
    ("statuses", "worst"),
    [
        ((Status.CONVERGED, Status.REDUCIBLE), "reducible"),
        ((Status.CONVERGED, Status.STAGNATED), "stagnated"),
        ((Status.COMPLETED, Status.UNCERTIFIED), "uncertified"),
        ((Status.STEP_LIMIT, Status.STOPPED, Status.COMPLETED), "stopped"),
        ((Status.PSI_LIMIT, Status.STEP_LIMIT, Status.CONVERGED), "psi_limit"),
        (tuple(Status), "non_finite"),
    ],
)
def test_the_worst_status_is_that_of_all(statuses, worst):
    solution = types.SimpleNamespace(solutions=[types.SimpleNamespace(status=status) for status in statuses])
    assert _status(solution) == worst


def test_a_metric_of_another_shape_is_refused(tmp_path, tuples):
    class Odd(AlgorithmS1):
        def init(self, n_states, n_actions):
            state = super().init(n_states, n_actions)
            kind = type("OddState", (type(state),), {"metrics": lambda self: {"theta": np.zeros(3)}})
            return kind(**{f.name: getattr(state, f.name) for f in dataclasses.fields(state)})

    with pytest.raises(InputError, match="metrics of the learner, theta"):
        erl_torch.train(Odd(), MDP, tuples, directory=tmp_path / "run", evaluation=QUICK)
    assert not (tmp_path / "run").exists()


# -- figures of a run --------------------------------------------------------------------------------------


def test_records_stand_every_so_many_epochs(tmp_path, tuples):
    rare = dataclasses.replace(QUICK, every=2)
    erl_torch.train(AlgorithmS1(n_epochs=5, n_bias=1), MDP, tuples, directory=tmp_path, evaluation=rare)
    steps = [step // len(tuples) for step, _ in scalars(tmp_path)["eval/objective"]]
    assert steps == [0, 2, 4, 5]


class Slow(Failing):
    def step(self, state, stream):
        time.sleep(0.05)
        return super().step(state, stream)


def test_seconds_go_on_after_a_stop(tmp_path, tuples, monkeypatch):
    learner = Slow(n_epochs=4, n_bias=2)
    with pytest.raises(KeyboardInterrupt):
        erl_torch.train(learner, MDP, tuples, directory=tmp_path, evaluation=QUICK)
    before = json.loads((tmp_path / "result.json").read_text())
    monkeypatch.setattr(Failing, "good", 10**9)
    erl_torch.train(learner, MDP, tuples, directory=tmp_path, evaluation=QUICK)
    after = json.loads((tmp_path / "result.json").read_text())
    slept = 4 * 0.05 - 0.002  # eight epochs, three before; both figures are rounded to a millisecond
    assert after["seconds_learning"] >= before["seconds_learning"] + slept
    assert after["seconds"] >= before["seconds"] + slept


def test_replicas_that_play_go_on_with_the_same_episodes(tmp_path, monkeypatch):
    """The generators of the episodes are part of a checkpoint, and of what an error in an epoch takes back."""
    env = gym.make("FrozenLake-v1", max_episode_steps=20)
    played = dataclasses.replace(QUICK, n_episodes=5)
    learners = Replicas.of(Failing(beta=5.0, n_epochs=2, n_bias=3), 2)

    def learnt(directory):
        return erl_torch.train(learners, env, Simulate(20, 20), directory=directory, evaluation=played)

    monkeypatch.setattr(Failing, "good", 10**9)
    learnt(tmp_path / "whole")
    monkeypatch.setattr(Failing, "good", 4)
    with pytest.raises(KeyboardInterrupt):
        learnt(tmp_path / "cut")
    monkeypatch.setattr(Failing, "good", 10**9)
    learnt(tmp_path / "cut")
    assert (tmp_path / "cut/replicas.npz").read_bytes() == (tmp_path / "whole/replicas.npz").read_bytes()
    assert scalars(tmp_path / "cut") == scalars(tmp_path / "whole")


def test_seeds_are_those_of_the_call(tmp_path):
    env = gym.make("FrozenLake-v1", max_episode_steps=20)
    returns = {}
    for seed in (0, 5):
        erl_torch.train(Replicas.of(SHORT, 2), MDP, Simulate(5, 20), directory=tmp_path / f"r{seed}", seed=seed)
        assert np.load(tmp_path / f"r{seed}/replicas.npz")["seed"].tolist() == [seed, seed + 1]
        tuples = erl_torch.collect(env, 20, 20, seed=1)
        directory = tmp_path / f"s{seed}"
        played = dataclasses.replace(QUICK, n_episodes=50)
        erl_torch.train(SHORT, env, tuples, directory=directory, seed=seed, evaluation=played)
        returns[seed] = scalars(directory)["eval/return"]
    assert returns[0] != returns[5]


def test_the_learners_prior_counts(tmp_path, tuples):
    prior = np.random.default_rng(0).dirichlet(np.ones(4), 15)
    problem = erl_torch.Problem(TabularEnv(MDP), MDP, np.full((15, 4), 0.25), MDP)
    learner = CertaintyEquivalence(beta=2.0, prior_policy=prior)
    one = erl_torch.train(learner, problem, tuples, directory=tmp_path / "a", evaluation=QUICK)
    other = erl_torch.train(learner, MDP, tuples, directory=tmp_path / "b", evaluation=QUICK)
    assert one.gap == other.gap
    lines = scalars(tmp_path / "a")["prior/objective"]
    assert lines[0][1] == pytest.approx(objective(MDP, prior, prior, 2.0), abs=1e-5)


def test_the_bar_counts_all_passes(tuples):
    assert AlgorithmS1(n_epochs=3, n_bias=4).total(tuples) == 12 * len(tuples)
    assert CertaintyEquivalence().total(tuples) == len(tuples)


@pytest.mark.parametrize("kind", [np.float32, np.float16, np.int8, np.uint64, np.bool_])
def test_metrics_keep_their_type_over_a_stop(tmp_path, tuples, monkeypatch, kind):
    @dataclass(frozen=True, eq=False)
    class Kept(S1State):
        def metrics(self):
            return {**super().metrics(), "x": kind(self.n_tuples % 7 / 3)}

    class Own(Failing):
        states = (Kept,)

        def init(self, n_states, n_actions):
            state = super().init(n_states, n_actions)
            return Kept(**{f.name: getattr(state, f.name) for f in dataclasses.fields(state)})

    def learnt(name):
        return erl_torch.train(Own(n_epochs=3, n_bias=2), MDP, tuples, directory=tmp_path / name, evaluation=QUICK)

    monkeypatch.setattr(Failing, "good", 10**9)
    learnt("whole")
    monkeypatch.setattr(Failing, "good", 2)
    with pytest.raises(KeyboardInterrupt):
        learnt("cut")
    monkeypatch.setattr(Failing, "good", 10**9)
    learnt("cut")
    assert (tmp_path / "cut/solution.npz").read_bytes() == (tmp_path / "whole/solution.npz").read_bytes()


def test_a_recording_written_to_is_noticed(tmp_path, tuples):
    """With as many good rows as before, it was learnt from as it then was."""
    tuples.save(tmp_path / "tuples.npz")
    directory = erl_torch.write_experience(tuples, tmp_path / "columns")
    data = erl_torch.read_experience(directory, 15, 4, chunk=1000)
    rewards = np.load(directory / "r.npy")
    time.sleep(0.02)  # of the file system's clock
    np.save(directory / "r.npy", rewards + 1)
    with pytest.raises(InputError, match="it has been written to"):
        list(data.chunks())


def test_sizes_of_a_recording_are_those_it_was_opened_with(tmp_path, tuples):
    directory = erl_torch.write_experience(tuples, tmp_path / "columns")
    data = erl_torch.read_experience(directory, 15, 4, chunk=1000)
    for sizes in ((14, 4), (15, 3)):
        with pytest.raises(InputError, match="those it was opened with"):
            data.check_range(*sizes)


def test_a_checkpoint_names_no_file_elsewhere(tmp_path):
    """A mark cut the file that it named, wherever that was."""
    victim = tmp_path / "victim"
    victim.write_text("a" * 100)
    for name in ("../victim", str(victim), "victim", "sub/events.out.tfevents.1"):
        with pytest.raises(InputError, match="event file"):
            EventFile(tmp_path / "run", (name, 5))
    assert victim.read_text() == "a" * 100


@pytest.mark.parametrize("rescale_every", [1, 10, 100])
@pytest.mark.parametrize("implementation", ["fast", "literal"])
def test_the_scale_of_u_is_free_with_the_prior_for_unvisited_pairs(rescale_every, implementation):
    """... where a state is met as s' alone: its u was 1 whatever the scale of the others."""
    rng = np.random.default_rng(0)
    s, a, s_next, a_next = (rng.integers(n, size=200) for n in (2, 2, 3, 2))
    data = erl_torch.Transitions(s, a, -1.0 - s * 0.5 - 0.3 * a, s_next, a_next)
    found, once = (
        AlgorithmS1(
            beta=12.0, lr_u=0.1, n_epochs=3, n_bias=4, unvisited="prior", implementation=how, rescale_every=every
        ).fit(data, 3, 2)
        for how, every in ((implementation, rescale_every), ("literal", None))
    )
    assert found.theta == pytest.approx(once.theta, rel=1e-9)
    np.testing.assert_allclose(found.policy, once.policy, rtol=1e-9)


def test_replicas_that_are_lost_do_not_count():
    board = types.SimpleNamespace(scalars=lambda values, step: None)
    group = Group({}, slice(0, 3), 1.0)
    record = Record([group], [{}])
    record.add(0, {"theta": np.arange(3.0), "objective": np.arange(3.0)}, board)
    alive = np.array([True, False, True])
    record.add(9, {"theta": np.array([1.0, 99.0, 3.0]), "objective": np.array([np.nan, 5.0, 7.0])}, board, alive)
    found = record.statistics(group)
    assert (found["theta"]["mean"], found["theta"]["max"]) == (2.0, 3.0)
    assert (found["objective"]["mean"], found["objective"]["min"]) == (7.0, 7.0)
    assert found["replicas"] == 2  # of the quantity that most of them have


def test_a_metric_that_is_no_number_is_not_drawn(tmp_path, tuples):
    @dataclass(frozen=True, eq=False)
    class Kept(S1State):
        def metrics(self):
            return {**super().metrics(), "x": np.nan if self.n_tuples > len(tuples) else 1.0}

    class Own(AlgorithmS1):
        states = (Kept,)

        def init(self, n_states, n_actions):
            state = super().init(n_states, n_actions)
            return Kept(**{f.name: getattr(state, f.name) for f in dataclasses.fields(state)})

    erl_torch.train(Own(n_epochs=3, n_bias=1), MDP, tuples, directory=tmp_path, evaluation=QUICK)
    assert scalars(tmp_path)["learner/x"] == [(0, 1.0), (len(tuples), 1.0)]


def test_what_is_not_set_is_no_hyperparameter():
    settings = {"env": {"name": "lake", "kwargs": {}, "bins": None, "size": 3}, "learner": {"name": "s1"}, "seed": 0}
    assert hyperparameters(settings) == {"env": "lake", "learner": "s1", "env.size": 3, "seed": 0}


@pytest.mark.parametrize("values", [(Mode.A, Mode.B), (np.arange(2), np.arange(3)), (Path("a"), Path("b"))])
def test_objects_make_groups(tmp_path, tuples, values):
    """All was learnt, and then no JSON held them."""

    @dataclass(frozen=True, eq=False)
    class Own(AlgorithmS1):
        w: Any = None

    replicas = Replicas(tuple(Own(n_epochs=1, n_bias=1, w=value) for value in values))
    erl_torch.train(replicas, MDP, tuples, directory=tmp_path, evaluation=QUICK)
    groups = json.loads((tmp_path / "result.json").read_text())["groups"]
    assert len({json.dumps(group["settings"]) for group in groups}) == 2


@pytest.mark.parametrize("name", ["iterate", "run", "start"])
def test_replicas_refuse_what_they_would_pass_over(name):
    kind = type("Own", (AlgorithmS1,), {name: lambda self, *_: iter(())})
    with pytest.raises(InputError, match=f"one with the {name} of StreamLearner"):
        Replicas.of(kind(), 2)


def test_a_source_of_another_environment_is_another_run(tmp_path):
    lake = gym.make("FrozenLake-v1", max_episode_steps=10)
    for source, refused in ((lake, False), (gym.wrappers.TransformReward(lake, lambda r: 2 * float(r)), True)):
        problem = erl_torch.Problem(lake, source, np.full((16, 4), 0.25))
        if refused:
            with pytest.raises(InputError, match="of a run with these settings"):
                erl_torch.train(SHORT, problem, Simulate(5, 20), directory=tmp_path, evaluation=QUICK)
        else:
            erl_torch.train(SHORT, problem, Simulate(5, 20), directory=tmp_path, evaluation=QUICK)


def test_replicas_stopped_twice_between_records(tmp_path, tuples, monkeypatch):
    """The checkpoint of the first stop shared its steps with what the end wrote: no attempt came to its end again."""
    replicas = Replicas.of(Failing(n_epochs=4, n_bias=2), 2)
    rare = dataclasses.replace(QUICK, every=4)

    def learnt(name):
        return erl_torch.train(replicas, MDP, tuples, directory=tmp_path / name, evaluation=rare)

    monkeypatch.setattr(Failing, "good", 10**9)
    learnt("whole")
    monkeypatch.setattr(Failing, "good", 6)
    with monkeypatch.context() as patch:
        patch.setattr(ReplicaRecorder, "finish", raising(KeyboardInterrupt()))
        with pytest.raises(KeyboardInterrupt):
            learnt("cut")
    monkeypatch.setattr(Failing, "good", 10**9)
    learnt("cut")
    assert (tmp_path / "cut/replicas.npz").read_bytes() == (tmp_path / "whole/replicas.npz").read_bytes()
    assert scalars(tmp_path / "cut") == scalars(tmp_path / "whole")


def test_a_replica_whose_policy_is_lost_has_failed(tmp_path, tuples):
    with pytest.raises(NonFiniteError, match=r"2 of 2 replicas"):
        erl_torch.train(Replicas.of(Diverging(), 2), MDP, tuples, directory=tmp_path, evaluation=QUICK)
    assert np.isfinite(np.load(tmp_path / "replicas.npz")["policy"]).all()


def test_an_end_that_cannot_be_written_keeps_a_checkpoint(tmp_path, tuples, monkeypatch):
    for name in ("save", "result"):
        for error in (OSError("disk full"), KeyboardInterrupt()):
            directory = tmp_path / f"{name}-{type(error).__name__}"
            with monkeypatch.context() as patch:
                patch.setattr(f"erl_torch.run.single.SingleRecorder.{name}", raising(error))
                with pytest.raises(type(error)):
                    erl_torch.train(SHORT, MDP, tuples, directory=directory, evaluation=QUICK, checkpoint_every=None)
            with monkeypatch.context() as patch:  # nothing is learnt anew
                patch.setattr(AlgorithmS1, "step", raising(AssertionError("learnt anew")))
                assert (
                    erl_torch.train(
                        SHORT, MDP, tuples, directory=directory, evaluation=QUICK, checkpoint_every=None
                    ).gap
                    is not None
                )


def test_replicas_that_play_are_judged_at_their_end(tmp_path, monkeypatch):
    """The figures were the prior's, of the last milestone."""
    env = gym.make("FrozenLake-v1", max_episode_steps=20)
    monkeypatch.setattr(Failing, "good", 3)
    with pytest.raises(KeyboardInterrupt):
        erl_torch.train(
            Replicas.of(Failing(beta=5.0, n_epochs=5), 2), env, Simulate(20, 20), directory=tmp_path, evaluation=QUICK
        )
    arrays = np.load(tmp_path / "replicas.npz")
    assert arrays["record_step/objective"][-1] == arrays["record_step/theta"][-1] > 0


def test_a_replica_whose_theta_is_lost_has_failed(tmp_path, tuples):
    """Alone it is NON_FINITE; as a replica it was "completed", with NaN in its file."""

    class Lost(AlgorithmS1):
        def step(self, state, stream):
            after = super().step(state, stream)
            return dataclasses.replace(after, rho=float("nan")) if after.n_tuples > 2 * len(tuples) else after

    for name, learner in (("one", Lost()), ("many", Replicas.of(Lost(), 2))):
        with pytest.raises(NonFiniteError, match="theta is nan"):
            erl_torch.train(learner, MDP, tuples, directory=tmp_path / name, evaluation=QUICK)
    assert np.isfinite(np.load(tmp_path / "many/replicas.npz")["theta"]).all()


@dataclass(frozen=True)
class Losing(Counts):
    """Its policy is lost in the second of three passes; theta stays a number."""

    def step(self, state, stream):
        after = super().step(state, stream)
        return dataclasses.replace(after, policy=after.policy * float("nan")) if after.epoch == 2 else after


@pytest.mark.parametrize("every", [1, 2, 1000])
def test_a_policy_lost_between_records_is_not_kept(tmp_path, tuples, every):
    """The last good tables and the cause are kept, however rarely policies are measured."""
    settings = dataclasses.replace(QUICK, every=every)
    for _ in range(2):
        with pytest.raises(NonFiniteError, match="the policy has probabilities that are no numbers"):
            erl_torch.train(Losing(), MDP, tuples, directory=tmp_path, evaluation=settings)
    result = json.loads((tmp_path / "result.json").read_text())
    assert result["status"] == "non_finite"
    assert "no numbers" in result["message"]
    assert result["n_tuples"] == len(tuples)
    assert np.isfinite(np.load(tmp_path / "solution.npz")["policy"]).all()


def test_fit_looks_at_its_numbers_too(tuples):
    found = Losing().fit(tuples, MDP.n_states, MDP.n_actions)
    assert found.status is Status.NON_FINITE
    assert torch.isfinite(found.policy).all()


def test_lost_replicas_have_no_figures(tmp_path, tuples):
    """Lost in their first pass, before any record: the figures of the prior are none of theirs."""

    class Lost(AlgorithmS1):
        def step(self, state, stream):
            return dataclasses.replace(super().step(state, stream), rho=float("nan"))

    with pytest.raises(NonFiniteError):
        erl_torch.train(Replicas.of(Lost(), 2), MDP, tuples, directory=tmp_path, evaluation=QUICK)
    result = json.loads((tmp_path / "result.json").read_text())
    assert result["groups"][0]["replicas"] == 0
    assert result["objective"] is None
    assert result["data_half_widths"] is None
