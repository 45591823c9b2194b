"""What several test files need: problems, composed configurations, run directories read back."""

import contextlib
import os
import re
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp
from hydra import compose, initialize_config_dir
from hypothesis import strategies as st
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import erl_torch
from erl_torch import TabularMDP, Transitions
from erl_torch.cli import config
from erl_torch.solvers.policy import kl_per_state

ROOT = Path(__file__).parents[1]
CONF = ROOT / "conf"
DATA = ROOT / "tests" / "data"
# Seconds that a process or a condition is waited for before the test fails.
PATIENCE = 120 * float(os.environ.get("ERL_TORCH_TEST_PATIENCE", "1"))
config.register()


# -- problems -------------------------------------------------------------------------------------------------


def random_mdp(rng: np.random.Generator, n_states: int, n_actions: int) -> TabularMDP:
    """Dense random dynamics (irreducible, aperiodic), rewards in [-1, 0]."""
    transition = rng.dirichlet(np.full(n_states, 0.5), size=(n_states, n_actions)) + 1e-3
    transition /= transition.sum(-1, keepdims=True)
    return TabularMDP(transition, -rng.random((n_states, n_actions)), rng.dirichlet(np.ones(n_states)))


def random_policy(rng: np.random.Generator, n_states: int, n_actions: int) -> np.ndarray:
    return rng.dirichlet(np.full(n_actions, 3.0), size=n_states)


def random_stream(rng: np.random.Generator, mdp: TabularMDP, n_tuples: int) -> Transitions:
    return erl_torch.collect(mdp, 1, n_tuples, int(rng.integers(2**31)))


def overshooting(largest_reward: float) -> Transitions:
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


def maze(i: int):
    """The i-th windy maze of the authors' data, and what they found of it (tests/data/README.md)."""
    with np.load(DATA / "windy_mazes.npz") as data:
        r = data[f"m{i:02d}_R"]
        csr = (data[f"m{i:02d}_data"], data[f"m{i:02d}_indices"], data[f"m{i:02d}_indptr"])
        p = sp.csr_array(csr, shape=(r.size, len(r)))
        known = {name: data[f"m{i:02d}_{name}"] for name in ("theta", "policy", "k", "beta")}
        return TabularMDP(p, r, data[f"m{i:02d}_start"]), known


def kl(policy, other) -> float:
    """The largest divergence of a state, KL(policy(.|s) || other(.|s))."""
    return float(kl_per_state(np.asarray(policy), np.asarray(other)).max())


# -- runs -----------------------------------------------------------------------------------------------------


def composed(*overrides: str, command: str = "train"):
    """The configuration of ``command`` with these overrides."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose(command, list(overrides))


def events(directory: Path) -> EventAccumulator:
    """All that TensorBoard's files in ``directory`` hold."""
    return EventAccumulator(str(directory), size_guidance={"images": 0, "scalars": 0, "tensors": 0}).Reload()


def scalars(directory: Path) -> dict[str, list[tuple[int, float]]]:
    """Every record but the times: tag -> [(step, value)]."""
    reader = events(directory)
    tags = [tag for tag in reader.Tags()["scalars"] if not tag.startswith("time/")]
    return {tag: [(e.step, e.value) for e in reader.Scalars(tag)] for tag in tags}


DOCUMENTED = set(re.findall(r"`([\w/]+)`", (ROOT / "docs" / "logging.md").read_text()))


def undocumented(directory: Path) -> set[str]:
    """Tags of the run in ``directory`` that docs/logging.md does not have."""
    missing = set()
    tags = events(directory).Tags()
    texts = [tag.removesuffix("/text_summary") for tag in tags["tensors"] if tag.endswith("/text_summary")]
    for tag in [*tags["scalars"], *tags["images"], *texts]:
        name = re.sub(r"^(bands|sweep)/.*", r"\1/NAME", tag)
        if name not in DOCUMENTED and not re.match(r"(learner|eval|optimal|prior|data|Final|time)/", tag):
            name = re.sub(r"^[^/]+/(.*?)_(mean|median|q25|q75|min|max|optimal|prior)$", r"GROUP/\1", tag)
        if name not in DOCUMENTED:
            missing.add(tag)
    return missing


# -- processes ------------------------------------------------------------------------------------------------

Start = Callable[..., subprocess.Popen[str]]


@contextlib.contextmanager
def processes() -> Iterator[Start]:
    """``start(*command, **options of Popen)``; its output is captured. What still runs at the end is killed."""
    with contextlib.ExitStack() as stack:

        def start(*command: object, **options: Any) -> subprocess.Popen[str]:
            captured: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
            process = subprocess.Popen([str(word) for word in command], text=True, **captured | options)
            stack.enter_context(process)  # closes its pipes and waits
            stack.callback(process.kill)
            return process

        yield start


def ended(process: subprocess.Popen[str]) -> tuple[int, str, str]:
    """Wait for it: (exit code, stdout, stderr)."""
    out, err = process.communicate(timeout=PATIENCE)
    return process.returncode, out, err


def wait_until(condition: Callable[[], object], what: str) -> None:
    """Return once ``condition()`` is true; fail after ``PATIENCE`` seconds.

    It asks again and again, as there is nothing that another process's file or port would wake this one by.
    """
    limit = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < limit, f"still waiting for {what}"
        time.sleep(0.02)
