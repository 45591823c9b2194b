"""Fixtures of all test files, marks, Hypothesis' settings, and a kernel cache for each worker of pytest-xdist."""

import os
import runpy
import signal
import sys
from pathlib import Path

if worker := os.environ.get("PYTEST_XDIST_WORKER"):
    # Before Numba is imported. Two processes that compile two signatures of one kernel at once may give both files the
    # same name; so each worker has a cache, kept from run to run.
    caches = os.environ.get("NUMBA_CACHE_DIR", str(Path(__file__).parents[1] / ".pytest_cache" / "numba"))
    os.environ["NUMBA_CACHE_DIR"] = os.path.join(caches, worker)

import hypothesis
import numba
import numpy as np
import pytest
from helpers import DATA, ROOT, processes

from erl_torch import Transitions

# First calls compile, so no deadline; the same examples every time.
hypothesis.settings.register_profile("erl_torch", deadline=None, derandomize=True)
# For benchmarks/mutants.py: a failure is all that is asked for, not its smallest example.
hypothesis.settings.register_profile(
    "unshrunk", deadline=None, derandomize=True, phases=(hypothesis.Phase.explicit, hypothesis.Phase.generate)
)
hypothesis.settings.load_profile("erl_torch")


def pytest_collection_modifyitems(items):
    """``command``: starts processes, as its fixtures tell. ``fast``: neither that nor ``slow``, which is written."""
    for item in items:
        if {"start", "start_for_all"} & set(item.fixturenames):
            item.add_marker("command")
        elif item.get_closest_marker("slow") is None:
            item.add_marker("fast")


if numba.config.DISABLE_JIT:

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_call(item):
        """Skip what takes longer than five seconds without the compiler, so that measuring coverage ends."""

        def skip(number, frame):
            pytest.skip("too long without the compiler")

        before = signal.signal(signal.SIGALRM, skip)
        signal.setitimer(signal.ITIMER_REAL, 5.0)
        try:
            return (yield)
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            signal.signal(signal.SIGALRM, before)


@pytest.fixture
def start():
    """Starts a process, as ``helpers.processes`` has it."""
    with processes() as start:
        yield start


@pytest.fixture(scope="module")
def start_for_all():
    """``start`` for the fixtures of a whole file."""
    with processes() as start:
        yield start


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
