"""A logged run from Python: the run of the command line, silent, and gone on with."""

import json
import warnings
from dataclasses import dataclass
from typing import ClassVar

import gymnasium as gym
import numpy as np
import pytest
import torch
from helpers import composed, events

import erl_torch
from erl_torch import AlgorithmS1, EvaluationSettings, InputError, Note, Replicas, Simulation, StreamLearner
from erl_torch.envs.windy_cliff import WindyCliffEnv
from erl_torch.experience.sources import Simulate
from erl_torch.learners import Exact
from erl_torch.learners.learner import columns
from erl_torch.run.training import train as train_configured

MDP = WindyCliffEnv().mdp
SHORT = AlgorithmS1(n_epochs=2, n_bias=2)
QUICK = EvaluationSettings(n_episodes=2, pictures=False)
pytestmark = pytest.mark.filterwarnings("ignore::erl_torch.Note")


@pytest.fixture
def tuples():
    return erl_torch.collect(MDP, 20, 200, seed=0)


def scalars(directory):
    reader = events(directory)
    tags = [tag for tag in reader.Tags()["scalars"] if not tag.startswith("time/")]
    return {tag: [(e.step, e.value) for e in reader.Scalars(tag)] for tag in tags}


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


class Stop(BaseException):
    pass


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
        ({"learner": "s1"}, "learner=str: must be a learner, as AlgorithmS1()"),
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


@pytest.mark.parametrize("other", [{"seed": 1}, {"learner": AlgorithmS1(n_epochs=3, n_bias=2)}, {"problem": "shaken"}])
def test_a_directory_of_another_run_is_refused(tmp_path, tuples, other):
    arguments = {"learner": SHORT, "problem": MDP, "experience": tuples, "directory": tmp_path, "evaluation": QUICK}
    erl_torch.train(**arguments)
    if other == {"problem": "shaken"}:
        other = {"problem": WindyCliffEnv(wind_strength=0.5).mdp}
    with pytest.raises(InputError, match="with these settings, or a new one"):
        erl_torch.train(**(arguments | other))


# -- learners of one's own that a run cannot hold -------------------------------------------------------------


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
        (Counts(first=Odd()), "learner=Counted: must be a learner whose states are of numbers.*a Odd has no place"),
        (NotNamed(), r"learner=Counted: must be .*the classes in its states \(unknown class Counted"),
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


def test_containers_numbers_and_arrays_come_back(tmp_path, tuples):
    held = {"a": [1, 2.5, None, True, "x", (3,)], 4: np.arange(3.0), "t": torch.ones(2), "s": np.float32(1.5)}
    learner = Counts(first=held)
    erl_torch.train(learner, MDP, tuples, directory=tmp_path, evaluation=QUICK, checkpoint_every=0)
    assert json.loads((tmp_path / "result.json").read_text())["status"] == "completed"
