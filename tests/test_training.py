"""Whole runs: what a run directory holds, what is logged, and that bits repeat."""

import json
import os
import re
import signal
import sys
from concurrent.futures import ThreadPoolExecutor

import gymnasium as gym
import numpy as np
import pytest
import torch
from helpers import ROOT, composed, ended, events, random_mdp, undocumented, wait_until
from omegaconf import OmegaConf

from erl_torch import InputError, Solution, Status, Transitions, evaluate
from erl_torch.cli import main as cli
from erl_torch.learners import LEARNERS
from erl_torch.run import loop
from erl_torch.run.training import train

SMALL = ("experience.n_episodes=20", "learner.n_epochs=2", "learner.n_bias=3")


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    directory = tmp_path_factory.mktemp("run")
    result = train(composed(*SMALL), directory)
    return directory, result


def test_a_run_that_mostly_evaluates_says_so_once(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(loop, "LONG", 0.0)
    monkeypatch.setattr(loop, "MOST", 0.0)
    train(composed("learner.n_epochs=3", "learner.n_bias=2", "evaluation.pictures=false"), tmp_path)
    assert capsys.readouterr().err.count("seconds went into evaluation: evaluation.every=10 measures") == 1


def test_run_directory(finished):
    directory, result = finished
    names = sorted(p.name for p in directory.iterdir() if p.is_file())
    assert names[0].startswith("events.out.tfevents")
    assert names[1:] == ["result.json", "settings.json", "solution.npz"]
    assert json.loads((directory / "result.json").read_text()) == result
    assert result["status"] == "completed"
    assert result["n_experience"] == 20_000
    assert result["n_tuples"] == 120_000
    solution = Solution.load(directory / "solution.npz")
    assert solution.theta == result["theta"]
    low, high = result["theta_bounds"]  # of the known model, solved at the end
    assert low - 1e-10 <= 1.0101363366 <= high + 1e-10
    assert high - low < 1e-8
    assert result["gap"] == pytest.approx(-low - result["objective"], abs=1e-9)
    assert solution.theta == pytest.approx(-np.log(solution.rho) / 10 - solution.reward_bias_max, rel=1e-14)
    assert {"erl_torch", "python", "torch", "numpy", "gymnasium"} == set(result["versions"])


def test_scalars(finished):
    directory, result = finished
    reader = events(directory)
    steps = [0, *range(20_000, 120_001, 20_000)]
    documented = {
        f"learner/{name}"
        for name in ("rho", "theta", "delta_max", "delta_mean", "psi_error", "psi_epochs", "bias_iteration")
    } | {"eval/return", "eval/reward_per_step", "eval/objective"}
    figures = {"objective", "reward_per_step", "return"}
    lines = {
        "data": {"theta", "theta_lower", "theta_upper"},
        "optimal": {"theta", "theta_lower", "theta_upper", "rho", "delta_max", "delta_mean"} | figures,
        "prior": figures,
        "Final": {"theta", "gap"} | figures,
    }
    more = {f"{group}/{name}" for group, names in lines.items() for name in names}
    assert set(reader.Tags()["scalars"]) == documented | more | {"time/tuples_per_second"}
    assert undocumented(directory) == set()
    values = {}
    for tag in documented:
        assert [e.step for e in reader.Scalars(tag)] == steps, tag
        values[tag] = [e.value for e in reader.Scalars(tag)]
        assert np.isfinite(values[tag]).all()
    assert values["eval/reward_per_step"][0] == pytest.approx(-1.6263453, abs=1e-6)  # the prior policy
    assert values["learner/theta"][0] == pytest.approx(1.0)
    assert values["learner/rho"][0] == pytest.approx(np.exp(-10))
    assert values["learner/bias_iteration"] == [0, 0, 0, 1, 1, 2, 2]
    for tag, key in [("learner/theta", "theta"), ("eval/objective", "objective"), ("eval/return", "return")]:
        assert values[tag][-1] == pytest.approx(result[key], rel=1e-6)
    history = Solution.load(directory / "solution.npz").history
    np.testing.assert_allclose(values["learner/delta_max"][1:], history["delta_max"], rtol=1e-6)


def test_interval_of_the_data(finished):
    directory, result = finished
    reader = events(directory)
    theta, low, high = (reader.Scalars(f"data/theta{end}")[-1].value for end in ("", "_lower", "_upper"))
    assert low < 1.0101363366 < high  # fixed seed
    value, *ends = map(float, re.fullmatch(r"theta = (\S+) in \[(\S+), (\S+)\]", result["data"]).groups())
    assert value == pytest.approx(theta, abs=6e-4)  # three digits are printed
    assert ends == pytest.approx([low, high], abs=1.1e-3)  # rounded outward


@pytest.mark.slow
@pytest.mark.parametrize("learner", sorted(set(LEARNERS) - {"s1", "exact"}))
def test_every_learner_runs(tmp_path, learner):
    passes = [] if learner == "certainty_equivalence" else ["learner.n_epochs=2"]
    passes += ["learner.n_bias=3"] if learner == "s1_efficient" else []
    result = train(composed(f"learner={learner}", "experience.n_episodes=20", *passes), tmp_path)
    reader = events(tmp_path)
    assert undocumented(tmp_path) == set()
    assert [e.value for e in reader.Scalars("eval/objective")][-1] == pytest.approx(result["objective"], abs=1e-6)
    assert result["gap"] >= 0
    assert "policy" in reader.Tags()["images"]


def test_pictures_text_and_boards(finished):
    reader = events(finished[0])
    assert [e.step for e in reader.Images("policy")] == [0, 40_000, 80_000, 120_000]
    assert [e.step for e in reader.Images("reward_bias")] == [40_000, 80_000, 120_000]
    assert all(max(e.width, e.height) <= 401 for e in reader.Images("policy"))
    plugins = reader.summary_metadata
    assert "configuration/text_summary" in plugins
    assert plugins["custom_scalars__config__"].plugin_data.plugin_name == "custom_scalars"
    hparams = [tag for tag, meta in plugins.items() if meta.plugin_data.plugin_name == "hparams"]
    assert sorted(hparams) == ["_hparams_/session_end_info", "_hparams_/session_start_info"]


def bits(tmp_path, name, *overrides):
    train(composed(*SMALL, "evaluation.pictures=false", *overrides), tmp_path / name)
    return (tmp_path / name / "solution.npz").read_bytes()


def test_same_seed_same_bits(tmp_path):
    first = bits(tmp_path, "a")
    assert bits(tmp_path, "b") == first
    try:
        assert bits(tmp_path, "c", "threads=2") == first
    finally:
        torch.set_num_threads(1)
    assert bits(tmp_path, "d", "seed=1") != first
    # Evaluation draws from a stream of its own.
    assert bits(tmp_path, "e", "evaluation.n_episodes=3", "evaluation.every=2") == first


def test_recorded_experience_is_the_simulated_one(tmp_path):
    first = bits(tmp_path, "a", f"experience.save_to={tmp_path}/tuples.npz")
    assert len(Transitions.load(tmp_path / "tuples.npz")) == 20_000
    overrides = (*SMALL[1:], "evaluation.pictures=false", "env=windy_cliff", "experience=recorded")
    train(composed(*overrides, f"experience.path={tmp_path}/tuples.npz"), tmp_path / "b")
    assert (tmp_path / "b" / "solution.npz").read_bytes() == first


def test_environment_without_a_model(tmp_path):
    result = train(
        composed(
            "env=gym", "env.id=FrozenLake-v1", "++env.kwargs.is_slippery=false", "learner.beta=5",
            "experience.n_episodes=3000", "experience.episode_length=100", "learner.unvisited=prior",
            "learner.lr_u=0.05", "learner.n_bias=2", "evaluation.horizon=100", "evaluation.every=15",
        ),
        tmp_path,
    )  # fmt: skip
    first = events(tmp_path).Scalars("eval/reward_per_step")[0].value
    assert result["status"] == "completed"
    assert result["reward_per_step"] > 5 * max(first, 0.001)
    assert events(tmp_path).Images("policy")[-1].height == 400


@pytest.mark.slow
@pytest.mark.parametrize("method", ["biasing", "soft_bellman"])
def test_exact_learner(tmp_path, method):
    result = train(composed("learner=exact", f"learner.method={method}", "experience.n_episodes=1"), tmp_path)
    assert result["status"] == "converged"
    assert result["theta"] == pytest.approx(1.0101363366, abs=1e-9)
    assert result["objective"] == pytest.approx(-1.0101363366, abs=1e-9)
    assert result["theta_bounds"][0] <= result["theta"] <= result["theta_bounds"][1]
    assert result["gap"] < 1e-9
    assert result["k"] == (5 if method == "biasing" else None)
    assert result["n_experience"] == 0
    reader = events(tmp_path)
    low, theta, high = (
        [e.value for e in reader.Scalars(f"learner/{n}")] for n in ("theta_lower", "theta", "theta_upper")
    )
    assert len(low) == len(theta) == len(high) == result["n_iterations"]
    assert all(a <= b + 1e-6 for a, b in zip(low, high, strict=True))
    assert theta[-1] == pytest.approx(1.0101363366, abs=1e-6)
    assert reader.Scalars("learner/kl_max")[-1].value < 1e-6
    assert len(reader.Images("policy")) == result["n_iterations"] + 1
    assert undocumented(tmp_path) == set()
    history = Solution.load(tmp_path / "solution.npz").history
    assert len(history["theta"]) == result["n_iterations"]


def test_exact_learner_at_low_temperature_with_positive_rewards(tmp_path):
    """rho = exp(-beta (theta + Delta)) is beyond double precision; the answer is not."""
    overrides = ("learner=exact", "learner.method=soft_bellman", "learner.beta=1e4", "env.trap_reward=50")
    result = train(composed(*overrides, "evaluation.pictures=false"), tmp_path)
    assert result["status"] == "converged"
    assert result["rho"] is None
    assert result["objective"] == pytest.approx(-result["theta"], abs=1e-6)


def test_exact_learner_needs_a_model(tmp_path):
    with pytest.raises(InputError, match="learner=exact: must be one that learns from experience: no model of froz"):
        train(composed("learner=exact", "env=frozen_lake", "env.use_model=false"), tmp_path)


def test_failure_keeps_what_was_learnt(tmp_path):
    """exp(-5 beta) underflows at beta 300: the run stops with step and cause, and its files stand."""
    from erl_torch import NonFiniteError

    with pytest.raises(NonFiniteError, match=r"^step \d+: .*beta"):
        train(composed(*SMALL, "learner.beta=300", "learner.lr_u=0.9"), tmp_path)
    result = json.loads((tmp_path / "result.json").read_text())
    assert result["status"] == "non_finite"
    assert result["message"].startswith("step ")
    assert Solution.load(tmp_path / "solution.npz").status is Status.NON_FINITE
    assert len(events(tmp_path).Scalars("eval/objective")) >= 1


# -- the command line, as typed ---------------------------------------------------------------------------


ENDLESS = ("learner.n_epochs=100000", "evaluation.pictures=false")


@pytest.fixture(scope="module")
def typed(tmp_path_factory, start_for_all):
    """(process, its directory) of each command below; started together, they share the cores."""
    commands = {
        "endless": ENDLESS,
        "sweep": ("-m", "learner.beta=2,-1,5", "seed=0,1", *SMALL, "evaluation.pictures=false"),
        "run": ("env=windy_cliff", *SMALL, "evaluation.pictures=false"),
    }
    started = {}
    for name, arguments in commands.items():
        directory = tmp_path_factory.mktemp("typed")
        started[name] = start_for_all(sys.executable, ROOT / "train.py", *arguments, cwd=directory), directory
    return started


def learning(cwd):
    """Whether the run below ``cwd`` has written what an epoch made."""
    paths = list(cwd.rglob("events.*"))
    reader = events(paths[0]) if paths else None
    return reader and "learner/theta" in reader.Tags()["scalars"] and reader.Scalars("learner/theta")[-1].step > 0


def signalled(cwd, send):
    """Call ``send`` once the run below ``cwd`` is inside its epochs, or has not come there: it has no end."""
    try:
        wait_until(lambda: learning(cwd), "an epoch")
    finally:
        send()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_termination_keeps_what_was_learnt(typed, typed_here, tmp_path, number):
    """In a process of its own, and in this one."""
    if number == signal.SIGTERM:
        process, cwd = typed["endless"]
        signalled(cwd, lambda: process.send_signal(number))
        code, out, _ = ended(process)
    else:
        cwd = tmp_path
        with ThreadPoolExecutor(1) as pool:
            sent = pool.submit(signalled, cwd, lambda: os.kill(os.getpid(), number))
            code, out, _ = typed_here("train.py", *ENDLESS)
            sent.result()
    assert code == 128 + number
    assert "stopped by the caller" in out
    (directory,) = (cwd / "runs" / "windy_cliff").iterdir()
    result = json.loads((directory / "result.json").read_text())
    assert result["status"] == "stopped"
    assert result["n_tuples"] > 0
    logged = events(directory).Scalars("learner/theta")
    assert logged[-1].step == result["n_tuples"]
    assert logged[-1].value == pytest.approx(result["theta"], rel=1e-6)


def test_command_line_run(typed):
    process, cwd = typed["run"]
    code, out, err = ended(process)
    assert code == 0, err
    (directory,) = (cwd / "runs" / "windy_cliff").iterdir()
    assert {".hydra", "result.json", "solution.npz"} < {p.name for p in directory.iterdir()}
    assert f"runs/windy_cliff/{directory.name}" in out
    assert "tensorboard --logdir runs" in out
    # In a pipe: a line a biasing iteration, and no bar.
    lines = err.splitlines()
    assert [line.split(":")[0] for line in lines] == [f"biasing iteration {k}" for k in range(3)]
    assert "\r" not in err


def test_multirun_writes_one_named_directory_a_job(typed):
    """The job that cannot run says so and leaves nothing; the others finish."""
    process, cwd = typed["sweep"]
    code, _, err = ended(process)
    assert code == 1
    (sweep,) = (cwd / "runs" / "windy_cliff").iterdir()
    assert sweep.name.startswith("sweep-")
    names = [p.name.split("-pictures")[0] for p in sorted(sweep.iterdir()) if p.is_dir()]
    assert [n[:3] for n in names] == ["000", "001", "004", "005"]
    for directory in sweep.iterdir():
        if directory.is_dir():
            result = json.loads((directory / "result.json").read_text())
            assert f"beta={result['beta']:g}-" in directory.name
            assert directory.name.endswith(f"-seed={result['seed']}")
    assert err.count("learner.beta=-1.0: must be a finite number > 0") == 2


@pytest.mark.parametrize(
    ("argument", "code", "start"),
    [
        ("learner.beta=-1", 1, "error: learner.beta=-1.0: must be a finite number > 0"),
        ("+learner.betta=2", 1, "error: learner.betta=2: must be left out: no such key; there are"),
        ("learner.beta=two", 1, "error: learner.beta=two: must be a number"),
        ("beta", 2, "error: beta: not of the form key=value"),
        ("hydra.run.dir=/dev/null/here", 1, "error: /dev/null/here: Not a directory"),
    ],
)
def test_errors_are_one_line(typed_here, tmp_path, argument, code, start):
    found, out, err = typed_here("train.py", argument)
    assert found == code
    assert err.startswith(start)
    assert err.count("\n") == 1
    assert out == ""
    assert not list(tmp_path.rglob("runs/*"))


def test_a_refused_command_leaves_the_run_s_own(typed_here, tmp_path):
    """Hydra writes its files before the work begins: those of a refused command took the place of the run's."""
    arguments = (*SMALL, "evaluation.pictures=false", "hydra.run.dir=run")
    assert typed_here("train.py", *arguments)[0] == 0
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    code, _, err = typed_here("train.py", *arguments, "learner.beta=7")
    assert code == 1
    assert "not learner.beta=7 (there: 10.0)" in err
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before
    code, _, err = typed_here("train.py", "resume=run", "threads=2")  # no result depends on it
    assert code == 0
    assert "is complete" in err
    assert OmegaConf.load(tmp_path / "run/.hydra/config.yaml").threads == 2
    for name in ("settings.json", "result.json", "solution.npz"):  # nothing but Hydra's files is left
        (tmp_path / "run" / name).unlink()
    assert typed_here("train.py", "resume=run", "learner.beta=-1")[0] == 1
    assert OmegaConf.load(tmp_path / "run/.hydra/config.yaml").learner.beta == 10


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"", "the list of the arguments that the run began with"),
        (b"\xff\xfe", "a readable list of the arguments that the run began with"),
        (b"- env: [\n", "a readable list of the arguments that the run began with"),
        (b"- {a: 1}\n", "the list of the arguments that the run began with"),
        (b"- hydra.callbacks.x._target_=mine.Class\n", "that of a run: 'hydra.callbacks.x._target_=mine.Class' in its"),
        (
            b"- ++hydra/launcher=joblib\n",
            "that of a run: '++hydra/launcher=joblib' in its",
        ),
        (b"- --config-dir=/elsewhere\n", "that of a run: '--config-dir=/elsewhere' in its"),
        (b"- env=mine:Id-v0\n", "named with its module, which is imported: add env=mine:Id-v0"),
        (b"- env=gym\n- env.id='mine:Id-v0'\n", "named with its module, which is imported: add env=mine:Id-v0"),
        (b"- 'env={id: \"mine:Id-v0\"}'\n", "named with its module, which is imported"),
    ],
)
def test_resume_takes_only_what_a_run_begins_with(typed_here, tmp_path, monkeypatch, content, expected):
    (tmp_path / "mine.py").write_text("raise SystemExit('imported')\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "mine", raising=False)  # another test's
    path = tmp_path / "run" / ".hydra" / "overrides.yaml"
    path.parent.mkdir(parents=True)
    path.write_bytes(content)
    code, _, err = typed_here("train.py", "resume=run")
    assert code == 1
    assert err.startswith("error: resume=run")
    assert expected in err
    assert err.count("\n") == 1
    assert path.read_bytes() == content
    if "module" in expected and b"- env=" in content:
        code, _, err = typed_here("train.py", "resume=run", "env=mine:Id-v0")
        assert code == 1
        assert "mine failed (SystemExit: imported, mine.py, line 1)" in err


def test_help_is_complete_and_needs_no_torch(tmp_path, start):
    environment = {**os.environ, "PYTHONPROFILEIMPORTTIME": "1"}
    code, out, err = ended(start(sys.executable, ROOT / "train.py", "--help", cwd=tmp_path, env=environment))
    assert code == 0
    for text in ("python train.py env=windy_cliff", "windy_cliff,windy_frozen_lake", "lr_psi: 0.1", "conf/"):
        assert text in out
    assert " gymnasium\n" in err
    for module in (" torch\n", " numba\n", " scipy\n", " matplotlib\n"):
        assert module not in err
    assert not (tmp_path / "runs").exists()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("overrides", "better"),
    [
        (("env=windy_frozen_lake",), 20),
        (("env=windy_frozen_lake", "env.n_actions=9", "++env.tile_rewards={N:-3}"), 20),
        (("env=windy_maze",), 10),
        (("env=dynamics_shift",), 100),
        (("env=frozen_lake",), 0.01),
        (("env=cliff_walking",), 5000),
        (("env=taxi",), 100),
        (("env=gym", "env.id=FrozenLake-v1", "++env.kwargs={is_slippery:false}", "env.use_model=false"), 0.05),
    ],
)
def test_environments_are_learnt(tmp_path, overrides, better):
    """The learnt policy's return in the environment lies clearly above the prior's."""
    small = ("experience.n_episodes=200", "evaluation.every=15", "evaluation.pictures=false")
    result = train(composed(*overrides, *small), tmp_path)
    returns = [event.value for event in events(tmp_path).Scalars("eval/return")]
    assert result["status"] == "completed"
    assert returns[-1] > returns[0] + better


def test_episodes_that_end_are_learnt_as_restarts(tmp_path):
    """Leaving H or G ends the episode, the model restarts: the same problem as the endless one."""
    common = ("env=windy_frozen_lake", "learner=exact", "learner.method=soft_bellman", "evaluation.pictures=false")
    endless = train(composed(*common), tmp_path / "endless")
    episodic = train(composed(*common, "env.cyclic=false"), tmp_path / "episodic")
    assert episodic["theta"] == endless["theta"]
    assert episodic["return"] > endless["return"]  # shorter


@pytest.mark.slow
def test_mdp_files_and_their_pictures(tmp_path):
    path = random_mdp(np.random.default_rng(0), 5, 3).save(tmp_path / "mdp.npz")
    result = train(composed("env=mdp", f"env.path={path}", *SMALL), tmp_path / "run")
    assert result["gap"] < 0.1
    assert result["env"] == "mdp"
    with pytest.raises(InputError, match=r"env.path=nowhere.npz"):
        train(composed("env=mdp", "env.path=nowhere.npz"), tmp_path / "other")
    np.save(tmp_path / "one.npy", np.eye(2))
    with pytest.raises(InputError, match=r"env.path=\S*one.npy: must be a readable npz file .*is not a zip file\)$"):
        train(composed("env=mdp", f"env.path={tmp_path}/one.npy"), tmp_path / "other")


def test_wind_fields_come_from_a_file(tmp_path):
    wind = np.zeros((2, 8, 8))
    np.save(tmp_path / "wind.npy", wind)
    arguments = ("env=windy_frozen_lake", "learner=exact", "evaluation.pictures=false")
    still = train(composed(*arguments, f"env.wind={tmp_path / 'wind.npy'}"), tmp_path / "still")
    also = train(composed(*arguments, "env.wind_strength=0"), tmp_path / "also")
    assert still["theta"] == pytest.approx(also["theta"], abs=1e-12)
    with pytest.raises(InputError, match=r"env\.wind=array of shape"):
        train(
            composed("env=windy_frozen_lake", "env.desc=ridge", f"env.wind={tmp_path / 'wind.npy'}"), tmp_path / "bad"
        )


def test_exact_return_of_an_episode(tmp_path):
    """FrozenLake's return is the probability of reaching the goal in its 100 steps: against env.step."""
    overrides = ("env=frozen_lake", "learner=exact", "learner.beta=200", "evaluation.pictures=false")
    result = train(composed(*overrides), tmp_path)
    policy = Solution.load(tmp_path / "solution.npz").policy.numpy()
    played = evaluate(gym.make("FrozenLake-v1"), policy, 200.0, np.random.default_rng(0), 3000, 100).mean_return
    assert abs(result["return"] - played) < 4.5 * 0.5 / np.sqrt(3000)
    assert result["return"] > 0.15  # restarts are free, so the best rate of reward is that of quick tries


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ("env=FrozenLake-v1", ["env=frozen_lake"]),
        ("env=erl_torch/WindyCliff-v0", ["env=windy_cliff"]),
        ("env=CartPole-v1", ["env=cart_pole_v1"]),
        ("env=Blackjack-v1", ["env=gym", "env.id=Blackjack-v1"]),
        ("env=my_package:My/World-v3", ["env=gym", "env.id=my_package:My/World-v3"]),
        ("env=windy_cliff", ["env=windy_cliff"]),
        ("seed=1", ["seed=1"]),
    ],
)
def test_environments_by_id(given, expected):
    assert cli._by_id(given, ROOT / "conf") == expected


@pytest.mark.slow
@pytest.mark.parametrize("stream", ["model", "episodes"])
def test_control_tasks_are_learnt(tmp_path, monkeypatch, stream):
    """Pendulum on few samples: the learnt policy's return in the original lies far above the prior's."""
    monkeypatch.setenv("ERL_TORCH_CACHE", str(tmp_path / "cache"))
    small = ("env.n_samples=50", "experience.n_episodes=1000", "evaluation.every=15", "evaluation.pictures=false")
    result = train(composed("env=pendulum", f"env.stream={stream}", *small), tmp_path / "run")
    returns = [event.value for event in events(tmp_path / "run").Scalars("eval/return")]
    assert returns[-1] > returns[0] + 1000
    assert (result["gap"] is None) == (stream == "episodes")
    with pytest.raises(InputError, match=r"env\.stream=both: must be model or episodes"):
        train(composed("env=pendulum", "env.stream=both"), tmp_path / "bad")


def test_continuous_observations_are_binned(tmp_path):
    small = ("experience.n_episodes=20", "learner.n_bias=2", "evaluation.every=15", "evaluation.pictures=false")
    overrides = ("env=gym", "env.id=MountainCar-v0", "env.bins=6", "learner.beta=1")
    result = train(composed(*overrides, *small), tmp_path / "run")
    assert Solution.load(tmp_path / "run" / "solution.npz").policy.shape == (36, 3)
    assert result["status"] == "completed"
    with pytest.raises(InputError, match=r"env\.low\[1\]=-?inf: must be finite: dimension 1"):
        train(composed("env=gym", "env.id=CartPole-v1", "env.bins=6"), tmp_path / "bad")
    with pytest.raises(InputError, match=r"observation_space=Box.* env\.bins"):
        train(composed("env=gym", "env.id=CartPole-v1"), tmp_path / "bad")
    with pytest.raises(InputError, match=r"env\.actions=None: must be a list of values"):
        train(composed("env=gym", "env.id=Pendulum-v1", "env.bins=6"), tmp_path / "bad")
