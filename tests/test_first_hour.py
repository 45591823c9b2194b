"""What a newcomer meets: typing mistakes, own environments, odd paths, stops, sweeps, answers in words."""

import json
import os
import re
import shlex
import shutil
import sys
import tempfile
from pathlib import Path
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
import torch
from helpers import ROOT
from hydra.core.override_parser.overrides_parser import OverridesParser
from hypothesis import given
from hypothesis import strategies as st

from erl_torch import InputError, Solution, Status, TabularMDP, compiled, pictures, solve_soft_bellman
from erl_torch.cli import main as cli
from erl_torch.cli import paths, sweeps
from erl_torch.cli.typed import Typed
from erl_torch.empirical.uncertainty import Estimate
from erl_torch.guesses import guess
from erl_torch.run.classes import resolve
from erl_torch.run.verdict import verdict

QUICK = ("learner=certainty_equivalence", "experience.n_episodes=2", "evaluation.pictures=false")
MINE = """
import gymnasium as gym

gym.register("Mine-v0", entry_point="mine:Ring")

class Ring(gym.Env):
    observation_space, action_space = gym.spaces.Discrete(3), gym.spaces.Discrete(2)
    def __init__(self, name="ring", id=0):
        print("made", name, id)
    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.s = 0
        return 0, {}
    def step(self, action):
        self.s = (self.s + (1 if action else 2)) % 3
        return self.s, float(self.s == 2), False, False, {}
"""
ABSENT = "module 'mine' has no attribute 'absent'"


# -- typing mistakes -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("word", "meant"),
    [("windy_clif", "windy_cliff"), ("FrozenLake", "frozen_lake"), ("frozenlake-v1", "frozen_lake"), ("xyz", None)],
)
def test_guesses(word, meant):
    assert guess(word, ["windy_cliff", "windy_maze", "frozen_lake"]) == meant


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "hint"),
    [
        (["beta=5"], "did you mean learner.beta=5?"),
        (["learner.betta=5"], "did you mean learner.beta=5?"),
        (["learnr=s1"], "did you mean learner=s1?"),
        (["n_episods=3"], "did you mean experience.n_episodes=3?"),
        (["env=windy_clif"], "did you mean windy_cliff?"),
        (["learner=q_lerning"], "did you mean q_learning?"),
        (["learner.rho_init=cary"], "did you mean carry?"),
        (["+evaluation.picture=false"], "did you mean evaluation.pictures?"),
        (["env=nothing_like_it"], "or MODULE:ID or MODULE:CLASS of your own"),
        (["experience.n_episodes=a=b"], "text with signs of its own goes in quotes: \"experience.n_episodes='a=b'\""),
    ],
)
def test_mistakes_get_a_guess(typed_here, arguments, hint):
    code, out, err = typed_here("train.py", *arguments)
    assert code in (1, 2)
    assert not out
    assert err.count("\n") == 1
    assert err.rstrip().endswith(hint)


# -- environments of one's own -------------------------------------------------------------------------------


@pytest.fixture
def mine(tmp_path, monkeypatch):
    """A module in the working directory."""
    (tmp_path / "mine.py").write_text(MINE)
    (tmp_path / "broken.py").write_text("import mine\nmine.absent\n")
    monkeypatch.syspath_prepend(tmp_path)
    for name in ("mine", "broken"):
        monkeypatch.delitem(sys.modules, name, raising=False)  # of another test
    monkeypatch.delitem(gym.registry, "Mine-v0", raising=False)
    yield
    gym.registry.pop("Mine-v0", None)
    for name in ("mine", "broken"):
        sys.modules.pop(name, None)


@pytest.mark.slow
@pytest.mark.parametrize("env", ["mine:Mine-v0", "mine:Ring"])
def test_own_environments_are_named_by_module_and_id_or_class(tmp_path, typed_here, mine, env):
    """Every step of the ring leads on: the best policy takes two steps of three from the paying state."""
    assert typed_here("train.py", f"env={env}", *QUICK, "hydra.run.dir=run")[0] == 0
    assert json.loads((tmp_path / "run" / "result.json").read_text())["status"] == "converged"
    named = {"mine:Mine-v0": "module=mine", "mine:Ring": "env.class=mine.Ring"}[env]
    code, _, err = typed_here("play.py", "run=run", "n_episodes=1")
    assert code == 1
    assert err.endswith(f"add {named}\n")
    assert typed_here("play.py", "run=run", "n_episodes=1", named)[0] == 0


@pytest.mark.slow
def test_the_newcomer_s_path(tmp_path, typed_here, monkeypatch):
    """The page's module and commands; theta and policy against the model, written down by hand."""
    page = (ROOT / "docs" / "getting-started.md").read_text()
    (tmp_path / "my_module.py").write_text(
        re.search(r"<!-- newcomer: my_module.py -->\n```python\n(.*?)```", page, re.S)[1]
    )
    train, play, _ = re.search(r"<!-- newcomer: commands -->\n```bash\n(.*?)```", page, re.S)[1].splitlines()
    monkeypatch.syspath_prepend(tmp_path)
    for line in (train, play):
        program, command, *arguments = shlex.split(line)
        assert program == "erl-torch"
        assert typed_here(f"{command}.py", *arguments)[0] == 0
    transition, reward = np.zeros((5, 2, 5)), np.zeros((5, 2))
    for s in range(5):
        for a in range(2):
            items = min(s + a, 4)
            p_sold = 0.5 * (items > 0)
            transition[s, a, max(items - 1, 0)] += p_sold
            transition[s, a, items] += 1 - p_sold
            reward[s, a] = p_sold - 0.6 * a
    best = solve_soft_bellman(TabularMDP(transition, reward), 10.0)
    learnt = Solution.load(tmp_path / "runs" / "shelf" / "solution.npz")
    assert learnt.theta == pytest.approx(best.theta, abs=0.01)  # the data's interval is +- .003
    assert learnt.policy.numpy() == pytest.approx(best.policy.numpy(), abs=0.05)


@pytest.mark.slow
def test_arguments_that_are_keys_of_every_environment_are_given_apart(typed_here, mine):
    code, out, _ = typed_here("train.py", "env=mine:Ring", "env.kwargs.name=other", "env.kwargs.id=7", *QUICK)
    assert code == 0
    assert "made other 7" in out
    assert "\nother" not in out  # the run keeps its own name


@pytest.mark.slow
@pytest.mark.parametrize(
    ("argument", "said"),
    [
        ("env=mine:Rin", "Rin is nothing of mine; did you mean mine.Ring?"),
        ("env=broken:Ring", f"broken failed (AttributeError: {ABSENT}, broken.py, line 2)"),
        ("env=broken:Ring-v0", f"that can be imported: broken failed (AttributeError: {ABSENT}"),
        ("env=not_there:Ring-v0", "there is no module not_there"),
        ("env=not_there:Ring", "env=not_there:Ring: must be"),
        ("learner.class=shop", "learner.class=shop: must be the dotted name of a class"),
    ],
)  # fmt: skip
def test_what_cannot_be_imported_is_told_with_its_cause(typed_here, mine, argument, said):
    code, _, err = typed_here("train.py", argument)
    assert code == 1
    assert said in err
    assert err.count("\n") == 1


@pytest.mark.slow
def test_resuming_asks_for_all_classes_at_once(tmp_path, typed_here):
    noted = tmp_path / "run" / ".hydra"
    noted.mkdir(parents=True)
    (noted / "overrides.yaml").write_text("- learner.class=a.A\n- env.class=b.B\n- experience.class=c.C\n")
    code, _, err = typed_here("train.py", "resume=run", "env.class=b.B")
    assert code == 1
    assert err.endswith("add learner.class=a.A experience.class=c.C\n")


# -- paths ---------------------------------------------------------------------------------------------------

# What a file may be called, but for a comma and what is a value of another kind.
NAMES = st.text(st.characters(exclude_characters="/\0,$~", exclude_categories=["Cs", "Cc"]), min_size=1, max_size=12)
OTHERS = ("null", "???")


@given(NAMES.filter(lambda name: name not in OTHERS and not paths.AS_THEY_ARE.fullmatch(name)))
def test_paths_reach_hydra_as_they_were_typed(name):
    argument = paths.readable(f"env.path=folder/{name}.npz", False)
    assert OverridesParser.create().parse_override(argument).value() == f"folder/{name}.npz"
    once_more = paths.readable(argument, False)
    assert once_more == argument or OverridesParser.create().parse_override(once_more).value() == f"folder/{name}.npz"


@given(st.lists(NAMES.filter(lambda name: "'" not in name and '"' not in name), min_size=2, max_size=4))
def test_commas_part_the_paths_of_a_sweep(names):
    argument = paths.readable("experience.path=" + ",".join(f"d/{name}.npz" for name in names), True)
    override = OverridesParser.create().parse_override(argument)
    assert override.is_sweep_override()
    found = list(override.sweep_string_iterator())
    read = OverridesParser.create()
    assert [read.parse_override(f"x={one}").value() for one in found] == [f"d/{name}.npz" for name in names]


def test_other_values_stay(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", "/home/of mine")
    for argument in (
        "experience.save_to=null", "env.path='a b.npz'", "learner.beta=a=b", "run=latest",
        "experience.path=minari:A/b-v0",
        "hydra.run.dir=runs/${slug:${env.name}}/x",
    ):  # fmt: skip
        assert paths.readable(argument, False) == argument
    assert paths.readable("env.path=glob(*)", True) == "env.path=glob(*)"
    assert paths.readable("env.path=~/a.npz", False) == "env.path=/home/of mine/a.npz"
    (tmp_path / "~").mkdir()
    assert paths.readable("env.path=~", False) in ("env.path=~", "env.path='~'")
    assert paths.given("resume='a=b'") == "resume=a=b"


@pytest.mark.slow
@pytest.mark.parametrize("name", ["beta=2", "josé #3", "a(1)[0]", "o'hara,b", 'q"q\\b'])
def test_models_of_any_name(tmp_path, typed_here, name):
    TabularMDP(np.full((2, 2, 2), 0.5), np.eye(2)).save(tmp_path / f"{name}.npz")
    model = ("env=mdp", f"env.path={name}.npz", "learner=exact", "evaluation.pictures=false")
    assert typed_here("train.py", *model, f"hydra.run.dir={name}")[0] == 0
    assert (tmp_path / name / "result.json").exists()
    assert typed_here("play.py", f"run={name}", "n_episodes=1", "render=none")[0] == 0
    assert typed_here("train.py", f"resume={name}")[0] == 0


# -- run directories -----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_run_may_be_in_the_working_directory(tmp_path, typed_here):
    code, out, _ = typed_here("train.py", "hydra.run.dir=.", *QUICK)
    assert code == 0
    assert f"tensorboard --logdir {tmp_path.resolve()}" in out  # "." may be another folder in the shell
    first = (tmp_path / "solution.npz").read_bytes()
    for name in ("result.json", "solution.npz"):
        (tmp_path / name).unlink()
    assert typed_here("train.py", "resume=.")[0] == 0
    assert (tmp_path / "solution.npz").read_bytes() == first


@pytest.mark.slow
def test_jobs_may_work_in_their_directories(tmp_path, typed_here):
    TabularMDP(np.full((2, 2, 2), 0.5), np.eye(2)).save(tmp_path / "model.npz")
    model = ("env=mdp", "env.path=model.npz", "hydra.job.chdir=true")
    assert typed_here("train.py", *model, *QUICK, "experience.save_to=stream.npz", "hydra.run.dir=one")[0] == 0
    assert (tmp_path / "one" / "stream.npz").exists()
    code, out, _ = typed_here("train.py", "-m", "seed=0,1", *model, *QUICK, "hydra.sweep.dir=two")
    assert code == 0
    assert "2 jobs, 0 failed; table: two/sweep.json" in out


# -- loops without a cache -----------------------------------------------------------------------------------


def test_loops_are_kept_where_nobody_else_writes(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(compiled, "_found", [])
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setattr("erl_torch.compiled.sys", SimpleNamespace(modules={}))  # as before Numba is imported
    monkeypatch.setattr(compiled, "_can_be_written", lambda folder: True)
    compiled.find_room()
    assert "NUMBA_CACHE_DIR" not in os.environ
    assert compiled.announcement().endswith("on the first run only")
    monkeypatch.setattr(compiled, "_can_be_written", lambda folder: False)
    compiled.find_room()
    folder = Path(os.environ["NUMBA_CACHE_DIR"])
    assert folder.parent == tmp_path
    assert folder.stat().st_mode & 0o777 == 0o700
    assert str(folder) in compiled.announcement()
    folder.chmod(0o777)  # anybody may have put something there
    compiled.find_room()
    assert Path(os.environ["NUMBA_CACHE_DIR"]) not in (folder, tmp_path)
    monkeypatch.delenv("NUMBA_CACHE_DIR")


def test_what_can_be_written(tmp_path):
    assert compiled._can_be_written(tmp_path / "not" / "there" / "yet")
    (tmp_path / "file").touch()
    assert not compiled._can_be_written(tmp_path / "file" / "below")


# -- sweeps --------------------------------------------------------------------------------------------------


def job(number, overrides, objective, gap=None, theta=None):
    return {
        "job": number, "overrides": overrides, "status": "completed", "complaint": None, "theta": theta,
        "objective": objective, "gap": gap, "seconds": 1.0, "directory": f"{number:03d}",
    }  # fmt: skip


def test_seeds_are_averaged_and_the_best_is_marked(tmp_path):
    values = {"s1": [-1.5, -1.25, -1.0], "exact": [-1.0, -0.75, -0.5]}
    rows = [
        job(3 * k + i, [f"learner={name}", f"seed={i}", "env=windy_cliff"], value)
        for k, name in enumerate(values)
        for i, value in enumerate(values[name])
    ]
    averages = {tuple(one["overrides"]): one for one in sweeps.averages(rows)}
    for name, figures in values.items():
        mean, sd = averages[f"learner={name}", "env=windy_cliff"]["objective"]
        assert (mean, sd) == (pytest.approx(np.mean(figures)), pytest.approx(np.std(figures, ddof=1)))
    text = sweeps.table(tmp_path, rows).splitlines()
    (best,) = (line for line in text if line.startswith("*") and "learner=" in line)
    assert best.split() == ["*", "3", "learner=exact", "-0.75", "+-", "0.25"]
    assert "all jobs: env=windy_cliff" in text
    assert not [line for line in text if "gap" in line]  # no job has one


def test_problems_are_compared_by_their_gaps(tmp_path):
    rows = [
        job(0, ["env=a", "learner=x"], -3.0, 0.5), job(1, ["env=a", "learner=y"], -2.9, 0.4),
        job(2, ["env=b", "learner=x"], 7.0, 0.1), job(3, ["env=b", "learner=y"], 6.0, 1.1),
        job(4, ["env=c", "learner=x"], None),
    ]  # fmt: skip
    head, *lines = sweeps.table(tmp_path, rows).splitlines()[1:6]
    assert re.search(r"overrides +gap +objective +status", head)
    assert [line.startswith("*") for line in lines] == [False, True, True, False]
    assert not sweeps.averages(rows)


def test_a_failed_job_is_no_best_one(tmp_path):
    """Its figures are those of its last good tables."""
    rows = [job(i, [f"learner.rate={i}"], value) for i, value in enumerate((-0.40, -0.41, -0.42))]
    rows[0] |= {"status": "failed", "complaint": "step 9: theta is nan"}
    lines = sweeps.table(tmp_path, rows).splitlines()
    (best,) = (line for line in lines if line.startswith("*") and "learner.rate" in line)
    assert "learner.rate=1" in best


@pytest.mark.slow
def test_swept_environments_share_one_directory(tmp_path, typed_here, mine):
    envs = "env=windy_cliff,FrozenLake-v1,CliffWalkingSlippery-v1,mine:Mine-v0"
    code, out, err = typed_here("train.py", "-m", envs, "seed=0,1", *QUICK)
    assert code == 0, err
    (sweep,) = (tmp_path / "runs").iterdir()
    assert sweep.name.startswith("sweep-")
    found = json.loads((sweep / "sweep.json").read_text())
    assert [row["status"] for row in found["jobs"]] == ["converged"] * 8
    assert [row["jobs"] for row in found["averages"]] == [2] * 4
    assert {row["directory"] for row in found["jobs"][:4]} == {
        f"{n:03d}-env={env}-seed={n % 2}" for n, env in enumerate(["windy_cliff"] * 2 + ["frozen_lake"] * 2)
    }  # what does not vary is left out
    assert "8 jobs, 0 failed" in out


def test_what_varies_is_told_from_what_does_not():
    typed = ["seed=range(3)", "learner.beta=2,5", "learner=s1", "env.desc=[SF,FG]", "x=interval(0,1)", "bad=["]
    assert sweeps.varying(typed) == ["seed", "learner.beta", "x"]
    assert sweeps.directory(["env=a,b"])[0].startswith("hydra.sweep.dir=runs/sweep-")
    assert not sweeps.directory(["env=a", "seed=1,2"])
    assert not sweeps.directory(["env=a,b", "hydra.sweep.dir=mine"])


@pytest.mark.slow
def test_without_slurm_there_is_one_line(tmp_path, typed_here, monkeypatch):
    monkeypatch.setattr(shutil, "which", lambda name: None)
    code, out, err = typed_here("train.py", "-m", "hydra/launcher=submitit_slurm", "seed=0,1")
    assert (code, out, err.count("\n")) == (1, "", 1)
    assert "there is no srun here" in err
    assert not list(tmp_path.rglob("sweep.json"))


@pytest.mark.parametrize(("name", "extra"), [("launcher/joblib", "joblib"), ("sweeper/optuna", "optuna")])
def test_a_missing_extra_is_named(name, extra):
    group, _, choice = name.partition("/")
    error = cli.BY_CONFIGURATION[0](
        f"Could not find 'hydra/{group}/{choice}'\n\nAvailable options in 'hydra/{group}':\n\tbasic\n"
    )
    assert cli._line(error).startswith(f"hydra/{group}={choice}: not installed; pip install 'erl_torch[{extra}]'")


# -- stops ---------------------------------------------------------------------------------------------------


def test_the_line_that_goes_on(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    run = tmp_path / "runs" / "a b"
    (run / "checkpoints").mkdir(parents=True)
    (run / "checkpoints" / "1.ckpt").touch()
    (run / ".hydra").mkdir()
    (run / ".hydra" / "config.yaml").write_text(
        "env: {class: mine.Ring, name: x}\nlearner: {class: erl_torch.AlgorithmS1}\n"
    )
    Typed(("python", "train.py"), ("env=mine:Ring",), "train").say_how_to_go_on(run)
    what, _, line = capsys.readouterr().err.partition(": ")
    assert what == "to go on"
    assert shlex.split(line) == ["python", "train.py", "resume=runs/a b", "env.class=mine.Ring"]
    Typed(("erl-torch", "train"), ("-m", "seed=0,1", "hydra.sweep.dir=old"), "train").say_how_to_go_on_sweeping([run])
    line = capsys.readouterr().err.partition(": ")[2]
    assert shlex.split(line) == ["erl-torch", "train", "-m", "seed=0,1", "hydra.sweep.dir=runs/a b"]
    (run / "checkpoints" / "1.ckpt").unlink()
    Typed(("python", "train.py"), ("seed=3",), "train").say_how_to_go_on(run)
    assert capsys.readouterr().err == "nothing is kept; to begin again: python train.py seed=3\n"


# -- the answer in words -------------------------------------------------------------------------------------


def solution(theta, bounds=None, status=Status.COMPLETED):
    ones = torch.ones(1, 1)
    return Solution(
        policy=ones, u=ones, psi=torch.ones(1), reward_bias=0 * ones, reward_bias_max=0.0, status=status, n_steps=1,
        theta=theta, theta_bounds=bounds,
    )  # fmt: skip


def estimate(value, sd):
    """With 95% in value +- 1.96 sd."""
    return Estimate("theta", value, sd)


@pytest.mark.parametrize(
    ("thetas", "found", "data", "answer"),
    [
        ([1.0] * 20, solution(1.0), estimate(1.01, 0.02), "Yes, as far as the data can tell"),
        ([1.0] * 20, solution(1.0), estimate(1.1, 0.02), "It has settled, but outside"),
        ([1.0] * 20, solution(1.0, (0.5, 0.6)), estimate(1.01, 0.02), "but not at theta*: the data contradict"),
        ([1.0] * 20, solution(1.0, (0.9, 0.95)), estimate(1.01, 0.02), "Yes, as far as the data can tell"),
        ([*[1.0] * 19, 1.2], solution(1.2), estimate(1.2, 0.02), "Not settled"),
        ([1.0] * 20, solution(1.0), None, "Whether at theta*, no data tell"),
        ([1.0], solution(1.0, (0.9999, 1.0001)), None, "Yes: theta is inside its proven bounds"),
        ([1.0], solution(1.0, (-np.inf, np.inf)), None, "It has settled. Whether"),
        ([1.0] * 20, solution(1.0, status=Status.STOPPED), None, "Not answered"),
        ([], solution(np.nan, status=Status.NON_FINITE), None, "**No.**"),
    ],
)
def test_the_answer(thetas, found, data, answer):
    text = verdict(thetas, found, data)
    assert text.startswith("Did theta converge?")
    assert answer in text.split("\n")[2]


def test_zero_has_no_sign():
    assert str(estimate(-1e-9, 0.01)).startswith("theta = 0.00")
    assert str(Estimate("theta", -0.0, np.inf, withheld="no pair varies")).startswith("theta = 0, ")


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("markers", [True, False])
def test_captions_name_what_is_drawn(monkeypatch, known, markers):
    captions = []
    panels = pictures._panels

    def seen(n, title, caption, card):
        captions.append(caption)
        return panels(n, title, caption, card)

    monkeypatch.setattr(pictures, "_panels", seen)
    found = {"mean": 1.0, "q25": 0.5, "q75": 1.5, "min": 0.0, "max": 2.0}
    line = pictures.BandLine("x", [1, 2], [found] * 2, [1.0 if known else None] * 2)
    pictures.bands({"theta": [line]}, "beta", "title", markers)
    assert ("exact" in captions[0]) == known


@pytest.mark.parametrize("group", ["experience", "env"])
def test_a_file_is_an_experience_path(tmp_path, group):
    (tmp_path / "log.csv").write_text("s,a,r,s_next\n0,0,1,0\n")
    with pytest.raises(InputError, match=r"experience=recorded experience.path=.*log\.csv"):
        resolve(f"{tmp_path}/log.csv", f"{group}.class")
