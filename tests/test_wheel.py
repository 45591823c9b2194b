"""The package as pip builds it trains from a folder of its own."""

import ast
import json
import os
import subprocess
import sys
import tomllib
import zipfile

from helpers import ROOT


def test_every_folder_is_a_package_of_the_wheel():
    listed = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"]
    folders = {".".join(path.parent.relative_to(ROOT).parts) for path in (ROOT / "erl_torch").rglob("__init__.py")}
    assert set(listed) == folders | {"erl_torch.conf"}


def test_the_wheel_trains_in_an_empty_folder(tmp_path):
    wheels, home, empty = (tmp_path / name for name in ("wheels", "home", "empty"))
    empty.mkdir()
    build = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation", "-w", wheels, str(ROOT)]
    copy = tmp_path / "tree"  # building leaves folders behind
    subprocess.run(["git", "-C", str(ROOT), "checkout-index", "-a", f"--prefix={copy}/"], check=True)
    subprocess.run([*build[:-1], str(copy)], check=True, capture_output=True, text=True)
    (wheel,) = wheels.iterdir()
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
        archive.extractall(home)
    assert {"erl_torch/py.typed", "erl_torch/conf/train.yaml", "erl_torch/conf/env/windy_cliff.yaml"} <= names
    assert not [name for name in names if name.startswith(("tests/", "conf/", "benchmarks/"))]
    command = [sys.executable, "-m", "erl_torch.cli.commands", "train", "experience.n_episodes=5", "hydra.run.dir=run"]
    done = subprocess.run(
        command, cwd=empty, env={**os.environ, "PYTHONPATH": str(home)}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert json.loads((empty / "run" / "result.json").read_text())["env"] == "windy_cliff"


def test_commands_are_named():
    for arguments, code in ((["--help"], 0), ([], 2), (["trian"], 2)):
        command = [sys.executable, "-m", "erl_torch.cli.commands", *arguments]
        done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
        assert done.returncode == code
        assert "erl-torch train" in done.stdout + done.stderr
        assert (code == 0) == (done.stderr == "")


def test_scripts_are_a_few_lines():
    for name in ("train", "compare", "play", "reproduce"):
        assert len(ast.parse((ROOT / f"{name}.py").read_text()).body) <= 3
