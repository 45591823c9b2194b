"""Fixtures of all test files, and Hypothesis' settings."""

import runpy
import sys

import hypothesis
import numpy as np
import pytest
from helpers import DATA, ROOT

from erl_torch import Transitions

# First calls compile, so no deadline; the same examples every time.
hypothesis.settings.register_profile("erl_torch", deadline=None, derandomize=True)
# For benchmarks/mutants.py: a failure is all that is asked for, not its smallest example.
hypothesis.settings.register_profile(
    "unshrunk", deadline=None, derandomize=True, phases=(hypothesis.Phase.explicit, hypothesis.Phase.generate)
)
hypothesis.settings.load_profile("erl_torch")


@pytest.fixture(scope="session")
def authors():
    """What the authors' script makes of 20,000 tuples of the windy cliff (see tests/data/README.md)."""
    with np.load(DATA / "windy_cliff_s1.npz") as archive:
        return dict(archive)


@pytest.fixture(scope="session")
def authors_tuples(authors):
    return Transitions(*(authors[name] for name in ("s", "a", "r", "s_next", "a_next")))


@pytest.fixture
def typed_here(tmp_path, monkeypatch, capsys):
    """A script run from ``tmp_path`` in this process, torch being imported already: (exit code, stdout, stderr)."""

    def call(script, *arguments):
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", [script, *arguments])
        monkeypatch.setenv("HYDRA_FULL_ERROR", "")
        code = 0
        try:
            runpy.run_path(str(ROOT / script), run_name="__main__")
        except SystemExit as end:
            code = end.code
        return code, *capsys.readouterr()

    return call
