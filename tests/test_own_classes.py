"""Classes of one's own: named on the command line, they work as the built-in ones; a run directory names none."""

import importlib
import json
import os
import re
import shlex
import subprocess
import sys
from typing import Any

import numpy as np
import pytest
from helpers import ROOT, composed, wait_until
from omegaconf import OmegaConf

from erl_torch import InputError, Solution
from erl_torch.run import classes
from erl_torch.run.build import make_env, make_learner, make_source

PACKAGE = ROOT / "examples" / "third_party"
PAGE = (ROOT / "docs" / "own-classes.md").read_text()
TRAIN, RESUME, PLAY, COMPARE, SWEEP, REPLICAS = (
    shlex.split(line)[1:] for line in re.findall(r"^    (python .*)$", PAGE.split("## Used")[1], re.M)
)


@pytest.fixture(autouse=True)
def _installed(monkeypatch):
    monkeypatch.syspath_prepend(PACKAGE)


def test_the_page_shows_every_file():
    shown = set(re.findall(r"^<!-- file: (\S+) -->$", PAGE, re.M))
    assert shown == {str(path.relative_to(ROOT)) for path in PACKAGE.rglob("*.py")}


def test_only_public_names_are_used():
    for path in PACKAGE.rglob("*.py"):
        assert not re.search(r"import erl_torch\.|from erl_torch\b", path.read_text())


def test_killed_and_resumed_the_bits_are_those_of_a_whole_run(tmp_path, typed_here, monkeypatch):
    slow = ["learner.n_epochs=500", "checkpoint_every=0", "evaluation.pictures=false"]
    arguments = [a for a in TRAIN if not a.startswith("hydra.run.dir")]
    assert typed_here(*arguments, *slow, "hydra.run.dir=whole")[0] == 0
    process = subprocess.Popen(
        [sys.executable, str(ROOT / TRAIN[0]), *TRAIN[1:], *slow],
        cwd=tmp_path, env={**os.environ, "PYTHONPATH": f"{ROOT}{os.pathsep}{PACKAGE}"},
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    run = tmp_path / "runs" / "ring"
    try:
        wait_until(lambda: process.poll() is not None or list(run.glob("checkpoints/*.ckpt")), "a checkpoint")
    finally:
        process.kill()
        process.wait()
    assert not (run / "result.json").exists()
    my_package = importlib.import_module("my_package")
    steps, step = [], my_package.Sweeps.step
    monkeypatch.setattr(my_package.Sweeps, "step", lambda *given: steps.append(1) or step(*given))
    code, _, err = typed_here(*RESUME)
    assert code == 0, err
    assert 0 < len(steps) < 500  # from the checkpoint on
    assert (run / "solution.npz").read_bytes() == (tmp_path / "whole" / "solution.npz").read_bytes()


def test_played(typed_here):
    assert typed_here(*TRAIN, "learner.n_epochs=50", "evaluation.pictures=false")[0] == 0
    code, out, _ = typed_here(*PLAY)
    assert code == 0
    assert out.startswith("Ring, Sweeps, seed 0")
    assert "x......." in out
    refused, _, err = typed_here(*(a for a in PLAY if not a.startswith("env")))
    assert refused == 1
    assert err.endswith("add env.class=my_package.Ring\n")


def test_compared(tmp_path, typed_here):
    """Both learners make the most of the same counts: the first by sweeps, the second by a solver."""
    assert typed_here(*COMPARE)[0] == 0
    (path,) = tmp_path.rglob("compare.json")
    table = json.loads(path.read_text())["table"]
    assert table["mine"]["gap"]["mean"] == pytest.approx(table["certainty_equivalence"]["gap"]["mean"], rel=1e-3)


def test_swept(tmp_path, typed_here):
    code, out, _ = typed_here(*SWEEP, "evaluation.pictures=false")
    assert code == 0
    assert "2 jobs, 0 failed" in out
    (table,) = tmp_path.rglob("sweep.json")
    rows = json.loads(table.read_text())["jobs"]
    assert [row["status"] for row in rows] == ["completed"] * 2
    assert all("learner=my_package.Sweeps" in row["overrides"] for row in rows)


def test_processes_of_a_launcher_find_the_class(tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "erl_torch.cli.commands", "train", *SWEEP[1:], "hydra/launcher=joblib",
         "hydra.launcher.n_jobs=2", "learner.n_epochs=20", "evaluation.pictures=false"],
        cwd=tmp_path, env={**os.environ, "PYTHONPATH": f"{ROOT}{os.pathsep}{PACKAGE}"}, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "2 jobs, 0 failed" in done.stdout


def test_replicas(tmp_path, typed_here):
    """A replica of a seed is the run of that seed alone."""
    few = ("learner.n_epochs=20", "evaluation.pictures=false")
    assert typed_here(*REPLICAS, *few, "hydra.run.dir=many")[0] == 0
    alone = [a for a in REPLICAS if not a.startswith(("n_replicas", "vary"))]
    assert typed_here(*alone, *few, "seed=1", "learner.beta=5", "hydra.run.dir=one")[0] == 0
    with np.load(tmp_path / "many" / "replicas.npz") as table:
        np.testing.assert_array_equal(table["policy"][3], Solution.load(tmp_path / "one" / "solution.npz").policy)


def test_help_and_completion_show_the_arguments(typed_here, monkeypatch):
    code, out, _ = typed_here(*TRAIN, "--help")
    assert code == 0
    assert "rate: 0.2" in out
    assert "size: 8" in out
    assert "share: 0.7" in out
    monkeypatch.setenv("COMP_LINE", "train.py learner.class=my_package.Sweeps learner.ra")
    assert typed_here("train.py", "-sc", "query=bash")[1].split() == ["learner.rate="]


def test_the_class_of_a_yaml_can_be_another(tmp_path, typed_here):
    (tmp_path / "my_s1.py").write_text(
        "from dataclasses import dataclass\nimport erl_torch\n\n"
        "@dataclass(frozen=True, eq=False)\nclass MyS1(erl_torch.AlgorithmS1):\n    more: float = 1.0\n"
    )
    sys.path.insert(0, str(tmp_path))
    try:
        arguments = (
            "learner=s1",
            "learner.class=my_s1.MyS1",
            "learner.more=2",
            "learner.n_bias=1",
            "learner.n_epochs=1",
        )
        code, _, err = typed_here("train.py", *arguments, "experience.n_episodes=5", "hydra.run.dir=run")
        assert code == 0, err
        written = OmegaConf.load(tmp_path / "run" / ".hydra" / "config.yaml").learner
        assert (written["class"], written.more, written.self_loop) == ("my_s1.MyS1", 2, "old")
    finally:
        sys.path.remove(str(tmp_path))


def test_a_folder_of_configurations(tmp_path, typed_here):
    (tmp_path / "conf" / "learner").mkdir(parents=True)
    (tmp_path / "conf" / "learner" / "mine.yaml").write_text(
        "class: my_package.Sweeps\nname: mine\nbeta: 5.0\nrate: 0.5\nn_epochs: 3\nprior_policy: null\n"
    )
    chosen = ("--config-dir", "conf", "learner=mine")
    few = ("experience.n_episodes=5", "evaluation.pictures=false", "hydra.run.dir=run")
    assert typed_here("train.py", *chosen, *few)[0] == 0
    (tmp_path / "run" / "result.json").unlink()
    assert typed_here("train.py", "resume=run")[0] == 1
    assert typed_here("train.py", "--config-dir", "conf", "resume=run")[0] == 0


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["learner.class=my_package.Nothing"], "learner.class=my_package.Nothing: must be the dotted name of a class"),
        (["learner.class=no_such_package.A"], "learner.class=no_such_package.A: must be the dotted name of a class"),
        (["learner.class=os.path.join"], "learner.class=os.path.join: must be the dotted name of a class"),
        (["learner.class=my_package.Ring"], "learner.class=my_package.Ring: must be that of a learner: it has no"),
        (["env.class=my_package.Sweeps"], "env.class=my_package.Sweeps: must be a class derived from gymnasium.Env"),
        (["experience.class=my_package.Ring"], "experience.class=my_package.Ring: must be a class derived"),
        (["learner.class=my_package.Sweeps", "learner.rat=1"], "learner.rat=1: no such key; there are"),
        (["learner.class=my_package.Sweeps", "+learner.rat=1"], "learner.rat=1: must be left out: no such key"),
        (["learner.class=my_package.Sweeps", "learner.rate=fast"], "learner.rate=fast: must be a number"),
        (["learner.class=my_package.Sweeps", "learner.n_epochs=1.5"], "learner.n_epochs=1.5: must be a whole number"),
        (["learner.class=my_package.Sweeps", "learner.rate=0"], "learner.rate=0.0: must be a number in (0, 1]"),
        (["env.class=my_package.Ring", "env.size=x"], "env.size=x: must be a whole number, in digits"),
        (["env.class=my_package.Ring", "env.size=0"], "env.size=0 env.slip=0.1: must be arguments of"),
    ],
)  # fmt: skip
def test_bad_classes_and_settings_get_one_line(tmp_path, typed_here, arguments, expected):
    code, _, err = typed_here("train.py", *arguments)
    assert code == 1
    assert err.startswith(f"error: {expected}")
    assert err.count("\n") == 1
    assert not list(tmp_path.rglob("runs/*"))


# -- what a run directory names -------------------------------------------------------------------------------


@pytest.fixture
def trap(tmp_path, monkeypatch):
    """A module that leaves a file when it is imported."""
    (tmp_path / "trap.py").write_text(
        "from pathlib import Path\nPath(__file__).with_name('sprung').touch()\nclass Trap:\n    beta: float = 1.0\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    yield tmp_path / "sprung"
    sys.modules.pop("trap", None)


HOSTILE = [
    "learner=trap.Trap",
    "env=trap.Trap",
    "experience=trap.Trap",
    "learner.class=trap.Trap",
    "++learner.class='trap.Trap'",
    "learner={class: trap.Trap}",
    "learner.class=${oc.decode:\"'trap.Trap'\"}",
    "env.name=trap.Trap learner.class=${env.name}",
    "+learner@learner.x=trap.Trap",
    "learner=s1,trap.Trap",
]


@pytest.mark.parametrize("hostile", HOSTILE)
def test_resuming_imports_nothing_that_is_not_named_again(tmp_path, typed_here, trap, hostile):
    path = tmp_path / "run" / ".hydra" / "overrides.yaml"
    path.parent.mkdir(parents=True)
    content = OmegaConf.to_yaml(OmegaConf.create(re.split(r" (?=learner\.)", hostile)))
    path.write_text(content)
    code, _, err = typed_here("train.py", "resume=run")
    assert code == 1
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    assert not trap.exists()
    assert path.read_text() == content


@pytest.mark.parametrize(
    "hostile", ["learner.s1.class=trap.Trap", "++learner.s1={class: trap.Trap, name: x}", "env.class=trap.Trap"]
)
def test_resuming_a_comparison_imports_nothing_that_is_not_named_again(tmp_path, typed_here, trap, hostile):
    path = tmp_path / "run" / ".hydra" / "overrides.yaml"
    path.parent.mkdir(parents=True)
    path.write_text(OmegaConf.to_yaml(OmegaConf.create(["learners=[s1]", "seeds=1", "n_sizes=1", hostile])))
    code, _, err = typed_here("compare.py", "resume=run")
    assert code == 1
    assert err.startswith("error: ")
    assert not trap.exists()


def test_what_is_named_again_is_imported(tmp_path, typed_here, trap):
    path = tmp_path / "run" / ".hydra" / "overrides.yaml"
    path.parent.mkdir(parents=True)
    path.write_text("- learner=trap.Trap\n")
    code, _, err = typed_here("train.py", "resume=run", "learner.class=trap.Trap")
    assert trap.exists()
    assert code == 1
    assert "that of a learner: it has no" in err


@pytest.mark.parametrize("key", ["env", "learner", "experience"])
def test_playing_imports_nothing_that_is_not_named_again(tmp_path, typed_here, trap, key):
    assert typed_here("train.py", "learner=exact", "evaluation.pictures=false", "hydra.run.dir=run")[0] == 0
    path = tmp_path / "run" / ".hydra" / "config.yaml"
    cfg = OmegaConf.load(path)
    cfg[key]["class"] = "trap.Trap"
    OmegaConf.save(cfg, path)
    code, _, err = typed_here("play.py", "run=run", "n_episodes=1", "render=none")
    assert not trap.exists()
    assert (code, err.count("\n")) == ((1, 1) if key == "env" else (0, 0))
    assert key != "env" or "None" not in err


def test_classes_of_this_package_are_told_from_others():
    assert classes.is_own("erl_torch.AlgorithmS1")
    for path in ("erl_torch_more.A", "my.erl_torch.A", ".erl_torch.A", "", None):
        assert not classes.is_own(path)


def test_from_python_a_configuration_may_name_any_class():
    cfg = composed("learner=soft_q")
    OmegaConf.update(
        cfg, "learner", {"class": "my_package.Sweeps", "name": "x", "rate": 0.25}, merge=False, force_add=True
    )
    learner: Any = make_learner(cfg.learner, 3, 2)
    assert learner.rate == 0.25
    source = OmegaConf.create({"class": "my_package.Biased", "name": "x", "share": 1})
    assert make_source(source) == importlib.import_module("my_package").Biased(share=1.0)
    with pytest.raises(InputError, match=r"env\.class=my_package\.Biased: must be a class derived from gymnasium\.Env"):
        make_env(OmegaConf.create({"class": "my_package.Biased", "name": "x"}))
