"""The package as pip builds it trains from a folder of its own."""

import ast
import json
import os
import sys
import tomllib
import zipfile

from helpers import ROOT, ended


def test_every_folder_is_a_package_of_the_wheel():
    listed = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"]
    folders = {".".join(path.parent.relative_to(ROOT).parts) for path in (ROOT / "erl_torch").rglob("__init__.py")}
    assert set(listed) == folders | {"erl_torch.conf"}


def test_the_wheel_trains_in_an_empty_folder(tmp_path, start):
    wheels, home, empty = (tmp_path / name for name in ("wheels", "home", "empty"))
    empty.mkdir()
    copy = tmp_path / "tree"  # building leaves folders behind
    build = ["-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation", "-w", wheels, copy]
    for command in (["git", "-C", ROOT, "checkout-index", "-a", f"--prefix={copy}/"], [sys.executable, *build]):
        code, _, err = ended(start(*command))
        assert code == 0, err
    (wheel,) = wheels.iterdir()
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
        archive.extractall(home)
    assert {"erl_torch/py.typed", "erl_torch/conf/train.yaml", "erl_torch/conf/env/windy_cliff.yaml"} <= names
    assert not [name for name in names if name.startswith(("tests/", "conf/", "benchmarks/"))]
    tiny = ["experience.n_episodes=1", "experience.episode_length=100", "learner.n_epochs=1", "learner.n_bias=1"]
    tiny += ["evaluation.horizon=100", "evaluation.pictures=false", "hydra.run.dir=run"]
    # Uncompiled: a folder that Numba has never seen costs ten seconds of compiling.
    environment = {**os.environ, "PYTHONPATH": str(home), "NUMBA_DISABLE_JIT": "1"}
    command = [sys.executable, "-m", "erl_torch.cli.commands", "train", *tiny]
    code, _, err = ended(start(*command, cwd=empty, env=environment))
    assert code == 0, err
    assert json.loads((empty / "run" / "result.json").read_text())["env"] == "windy_cliff"


def test_commands_are_named(start):
    for arguments, code in ((["--help"], 0), ([], 2), (["trian"], 2)):
        found = ended(start(sys.executable, "-m", "erl_torch.cli.commands", *arguments, cwd=ROOT))
        assert found[0] == code
        assert "erl-torch train" in found[1] + found[2]
        assert (code == 0) == (found[2] == "")


def test_scripts_are_a_few_lines():
    for name in ("train", "compare", "play", "reproduce"):
        assert len(ast.parse((ROOT / f"{name}.py").read_text()).body) <= 3
