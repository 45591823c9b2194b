"""A logged run from Python: the run of the command line, silent, and gone on with."""

import collections
import enum
import json
import warnings
from dataclasses import dataclass, field
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import pytest
import torch
from helpers import composed, scalars

import erl_torch
from erl_torch import AlgorithmS1, EvaluationSettings, InputError, Note, Replicas, Simulation, StreamLearner
from erl_torch.envs.windy_cliff import WindyCliffEnv
from erl_torch.experience.sources import Simulate
from erl_torch.learners import Exact
from erl_torch.learners.learner import columns
from erl_torch.run.checkpoint import check_state, decode, encode
from erl_torch.run.training import train as train_configured

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
    with pytest.raises(InputError, match="with these settings, or a new one: not digest="):
        erl_torch.train(replicas, MDP, streams[::-1], directory=tmp_path, evaluation=QUICK)
