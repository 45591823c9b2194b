"""Learnt policies in their environments: figures, text and pictures, and what is refused."""

import contextlib
import shutil
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers import ROOT, composed, ended
from omegaconf import OmegaConf
from PIL import Image

from erl_torch import InputError, Solution, TabularMDP
from erl_torch.cli import main as cli
from erl_torch.learners.replicas import ReplicaSolution
from erl_torch.run.build import make_env
from erl_torch.run.playing import find_run, play
from erl_torch.run.training import train
from erl_torch.solvers.policy import reward_per_step

arguments = partial(composed, command="play")


def copy(template, run, policy, *overrides):
    """A run directory like ``template``, with a policy and settings of our own."""
    run.mkdir()
    policy = torch.as_tensor(policy)
    table, ones = torch.ones(policy.shape), torch.ones(len(policy))
    tables = {"u": table, "psi": ones, "reward_bias": 0 * table, "value": None, "action_value": None}
    solution = Solution.load(template / "solution.npz")
    replace(solution, policy=policy, **tables).save(run / "solution.npz")
    (run / ".hydra").mkdir()
    OmegaConf.save(composed(*overrides), run / ".hydra" / "config.yaml")
    return run


@pytest.fixture(scope="module")
def cliff(tmp_path_factory):
    """A run on the windy cliff, solved exactly."""
    run = tmp_path_factory.mktemp("cliff") / "run"
    cfg = composed("learner=exact", "evaluation.pictures=false", "evaluation.horizon=200")
    train(cfg, run)
    (run / ".hydra").mkdir()
    OmegaConf.save(cfg, run / ".hydra" / "config.yaml")
    return run


def test_returns_are_those_of_the_model(cliff, capsys):
    played = play(arguments(f"run={cliff}", "n_episodes=200", "render=none"))
    env: Any = make_env(composed().env).unwrapped
    mdp = env.mdp
    expected = 200 * reward_per_step(mdp, Solution.load(cliff / "solution.npz").policy.numpy(), 200)
    error = played.returns.std() / np.sqrt(200)
    assert abs(played.returns.mean() - expected) < 4.5 * error
    assert (played.lengths == 200).all()
    assert not played.ended.any()
    out = capsys.readouterr().out
    assert out.startswith(f"windy_cliff, exact, seed 0 ({cliff})\n")
    assert f"{played.returns.mean():.6g}" in out
    assert "200, of which the environment ended 0" in out


def test_episodes_have_their_own_streams(cliff):
    few, many = (play(arguments(f"run={cliff}", f"n_episodes={n}", "render=none")) for n in (3, 6))
    np.testing.assert_array_equal(few.returns, many.returns[:3])
    other = play(arguments(f"run={cliff}", "n_episodes=3", "render=none", "seed=1"))
    assert (few.returns != other.returns).any()


def test_text_shows_the_first_steps(cliff, capsys):
    played = play(arguments(f"run={cliff}", "n_episodes=1", "n_steps=3"))
    assert len(played.shown) == 4
    assert played.shown[0] == " H  G  R \n H  F  F \n H  F  F \n H  F  F \n H [S] R \n"
    out = capsys.readouterr().out
    assert "the first 3 steps" in out
    assert out.endswith("\n".join(played.shown) + "\n")


def test_gif(cliff, capsys):
    played = play(arguments(f"run={cliff}", "n_episodes=1", "n_steps=5", "render=gif", "greedy=true"))
    path = cliff / "episode-greedy-seed-0.gif"
    assert str(path) in capsys.readouterr().out
    with Image.open(path) as picture:
        # Equal pictures in a row become one that stays longer.
        assert 1 < picture.n_frames <= len(played.shown) == 6  # type: ignore[attr-defined]  # of gifs
        assert picture.size == played.shown[0].shape[1::-1]
        total = 0
        for frame in range(picture.n_frames):  # type: ignore[attr-defined]
            picture.seek(frame)
            total += picture.info["duration"]
        assert total == 6 * 250  # four steps a second


def test_greedy_takes_the_most_probable_action(cliff, tmp_path):
    """Three states in a row, two actions: stay or go on; the last returns. Rewards tell the state."""
    stay, go = np.eye(3), np.roll(np.eye(3), 1, axis=1)
    mdp = TabularMDP(np.stack([stay, go], 1), np.array([[0.0, 0], [1, 1], [2, 2]]), np.eye(3)[0])
    path = mdp.save(tmp_path / "mdp.npz")
    policy = np.array([[0.4, 0.6]] * 3)
    run = copy(cliff, tmp_path / "run", policy, "env=mdp", f"env.path={path}", "evaluation.horizon=6")
    played = play(arguments(f"run={run}", "greedy=true", "n_episodes=2", "n_steps=2"))
    assert played.returns.tolist() == [6.0, 6.0]
    assert played.shown == ["state 0\n", "state 1\n", "state 2\n"]
    with pytest.raises(InputError, match="render=gif: must be ansi or none: mdp draws no pictures"):
        play(arguments(f"run={run}", "render=gif"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("env", "n_states", "n_actions", "render"),
    [
        ("frozen_lake", 16, 4, "ansi"),
        ("cliff_walking", 48, 4, "gif"),
        ("taxi", 500, 6, "ansi"),
        ("windy_maze", 100, 4, "gif"),
        ("pendulum", None, None, "gif"),
        ("mountain_car", None, None, "ansi"),
        ("cart_pole", None, None, "gif"),
        ("acrobot", None, None, "none"),
    ],
)
def test_environments(cliff, tmp_path, capsys, env, n_states, n_actions, render):
    cfg = composed(f"env={env}")
    if n_states is None:
        spaces: Any = make_env(cfg.env)
        n_states, n_actions = spaces.observation_space.n, spaces.action_space.n
    run = copy(cliff, tmp_path / "run", np.full((n_states, n_actions), 1 / n_actions), f"env={env}")
    played = play(arguments(f"run={run}", "n_episodes=1", f"render={render}", "n_steps=2"))
    if env == "mountain_car":
        assert "mountain_car has no text of its own to show; render=gif draws it" in capsys.readouterr().out
    elif render != "none":
        assert len(played.shown) == 3
    assert len(list(run.glob("*.gif"))) == (render == "gif")
    if env == "cart_pole":  # the original's reward: 1 for each step, the last included
        assert played.returns.tolist() == played.lengths.tolist()
        assert played.ended.all()


@pytest.mark.slow
def test_latest_and_replicas(cliff, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match="run=latest: must be a run directory: there is no run below runs/"):
        find_run("latest")
    shutil.copytree(cliff, "runs/windy_cliff/old")
    run = Path("runs/windy_cliff/sweep/new")
    cfg = composed("n_replicas=2", "experience.n_episodes=2", "learner.n_epochs=1", "learner.n_bias=1")
    train(cfg, run)
    (run / ".hydra").mkdir()
    OmegaConf.save(cfg, run / ".hydra" / "config.yaml")
    assert find_run("latest") == run
    one = play(arguments("run=latest", "replica=1", "n_episodes=2", "render=none"))
    policy = ReplicaSolution.load(run / "replicas.npz")[1].policy.numpy()
    alone = copy(cliff, tmp_path / "alone", policy, "env=windy_cliff")
    other = play(arguments(f"run={alone}", "n_episodes=2", "render=none"))
    np.testing.assert_array_equal(one.returns, other.returns)
    with pytest.raises(InputError, match=r"replica=2: must be a whole number in \[0, 2\)"):
        play(arguments("run=latest", "replica=2"))


def test_bad_runs_get_one_line(cliff, tmp_path):
    def complaint(*overrides):
        with pytest.raises(cli.BY_RUN) as caught:
            play(arguments(*overrides))
        line = cli._line(caught.value)
        assert "\n" not in line
        return line

    good = f"run={cliff}"
    assert (
        complaint("run=nowhere")
        == "run=nowhere: must be a run directory of train.py, with solution.npz or replicas.npz or policy.safetensors"
    )
    assert complaint(good, "replica=0").startswith("replica=0: must be left out")
    assert complaint(good, "render=video") == "render=video: must be ansi or gif or none"
    assert complaint(good, "n_episodes=0") == "n_episodes=0: must be a whole number >= 1"
    assert complaint(good, "+steps=3").startswith("steps=3: must be left out: no such key; there are run, ")
    for i, (text, expected) in enumerate(
        [
            (None, "No such file"),
            (b"env: [", "while parsing"),
            (b"- 3", "config.yaml ("),
            (b"seed: 0", "Missing key env"),
            (b"env: {name: x}\nlearner: {name: s1}\nevaluation: {horizon: 1}", "Missing key id"),
            (b"\xff\xfe\xfa", "config.yaml ("),
            (b"a: ${b}", "config.yaml ("),
        ]
    ):
        run = tmp_path / str(i)
        shutil.copytree(cliff, run)
        (run / ".hydra" / "config.yaml").unlink()
        if text is not None:
            (run / ".hydra" / "config.yaml").write_bytes(text)
        line = complaint(f"run={run}")
        assert line.startswith(f"run={run}: must be a run directory with the configuration")
        assert expected in line
    misfit = copy(cliff, tmp_path / "misfit", np.full((3, 2), 0.5), "env=windy_cliff")
    assert "policy fits its environment (policy=array of shape (3, 2)" in complaint(f"run={misfit}")
    (misfit / "solution.npz").write_bytes(b"PK junk")
    assert "readable npz" in complaint(f"run={misfit}")


def test_modules_are_imported_only_if_named_again(cliff, tmp_path, monkeypatch):
    (tmp_path / "mine.py").write_text(
        "from gymnasium import register\nregister('Mine-v0', entry_point='erl_torch.envs.windy_cliff:WindyCliffEnv')\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    policy = Solution.load(cliff / "solution.npz").policy
    run = copy(cliff, tmp_path / "run", policy, "env=gym", "env.id='mine:Mine-v0'", "env.name=mine")
    for module, said in (("null", r"run=.*: must be played with .*: add module=mine$"), ("other", "must be mine$")):
        with pytest.raises(InputError, match=said):
            play(arguments(f"run={run}", f"module={module}", "n_episodes=1"))
    assert "mine" not in sys.modules
    assert len(play(arguments(f"run={run}", "module=mine", "n_episodes=1", "render=none")).returns) == 1
    assert "mine" in sys.modules
    with pytest.raises(InputError, match="module=mine: must be left out"):
        play(arguments(f"run={cliff}", "module=mine"))


def test_sizes_beyond_memory_are_refused_first(cliff):
    with pytest.raises(InputError, match=r"n_episodes=\d+: must be smaller: the returns .* GB are free"):
        play(arguments(f"run={cliff}", f"n_episodes={10**15}"))


@pytest.mark.parametrize("field", ["theta_bounds", "policy", "status", "psi"])
def test_solutions_with_a_wrong_field_are_refused(cliff, tmp_path, field):
    arrays = Solution.load(cliff / "solution.npz").arrays()
    for i, value in enumerate([np.array("text"), np.array(["text"]), np.zeros(0)]):
        np.savez(tmp_path / f"{i}.npz", **arrays | {field: value})
        with contextlib.suppress(InputError):
            Solution.load(tmp_path / f"{i}.npz")
    np.savez(tmp_path / "r.npz", policy=np.zeros((2, 3, 1)), psi=np.zeros(3), status=np.array(["STOPPED"] * 2))
    with pytest.raises(InputError, match="as many rows in every array"):
        ReplicaSolution.load(tmp_path / "r.npz")


def test_command_line(cliff, tmp_path, start):
    cases = [
        ((f"run={cliff}", "render=none", "n_episodes=2"), 0, "windy_cliff, exact, seed 0", ""),
        (("run=nowhere",), 1, "", "error: run=nowhere: must be a run directory"),
    ]
    played = [start(sys.executable, ROOT / "play.py", *overrides, cwd=tmp_path) for overrides, *_ in cases]
    for process, (_, code, out, err) in zip(played, cases, strict=True):
        found = ended(process)
        assert found[0] == code, found
        assert found[1].startswith(out)
        assert found[2].startswith(err)
        assert found[2].count("\n") == code
    assert not list(tmp_path.iterdir())  # nothing of its own is left
