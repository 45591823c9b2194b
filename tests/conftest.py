"""Shared problems: small random MDPs, exhaustive streams, the authors' data."""

import runpy
import sys
from pathlib import Path

import hypothesis
import numpy as np
import pytest
from hypothesis import strategies as st

import erl_torch
from erl_torch import TabularMDP, Transitions

# First calls compile, so no deadline; the same examples every time.
hypothesis.settings.register_profile("erl_torch", deadline=None, derandomize=True)
# For benchmarks/mutants.py: a failure is all that is asked for, not its smallest example.
hypothesis.settings.register_profile(
    "unshrunk", deadline=None, derandomize=True, phases=(hypothesis.Phase.explicit, hypothesis.Phase.generate)
)
hypothesis.settings.load_profile("erl_torch")

ROOT = Path(__file__).parents[1]
DATA = Path(__file__).parent / "data"


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


def random_mdp(rng: np.random.Generator, n_states: int, n_actions: int) -> TabularMDP:
    """Dense random dynamics (irreducible, aperiodic), rewards in [-1, 0]."""
    transition = rng.dirichlet(np.full(n_states, 0.5), size=(n_states, n_actions)) + 1e-3
    transition /= transition.sum(-1, keepdims=True)
    return TabularMDP(transition, -rng.random((n_states, n_actions)), rng.dirichlet(np.ones(n_states)))


def random_policy(rng: np.random.Generator, n_states: int, n_actions: int) -> np.ndarray:
    return rng.dirichlet(np.full(n_actions, 3.0), size=n_states)


def random_stream(rng: np.random.Generator, mdp: TabularMDP, n_tuples: int) -> Transitions:
    return erl_torch.collect(mdp, 1, n_tuples, int(rng.integers(2**31)))


def overshooting(largest_reward):
    """A stream of 2 states, 1 action, on whose last tuple line 11 leaves rho far above exp(beta largest_reward).

    u(1) has grown by the self-loops of 1, u(0) has not: w/u(0) is large. One tuple pays less, so that the bound is not
    that of just any reward.
    """
    s = np.array([1] * 30 + [0])
    r = np.full(31, float(largest_reward))
    r[3] -= 1.0
    return Transitions(s, 0 * s, r, np.ones(31, int), 0 * s)


@st.composite
def problems(draw):
    """(generator, MDP, prior policy) of a small random problem."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    n_states, n_actions = draw(st.integers(1, 6)), draw(st.integers(1, 4))
    return rng, random_mdp(rng, n_states, n_actions), random_policy(rng, n_states, n_actions)
