"""The configuration: complete, typed, explained, and clear about what it refuses."""

import inspect
import math
import re
import resource
from dataclasses import fields
from itertools import pairwise
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import load_env_creator
from helpers import CONF, composed
from omegaconf import OmegaConf

from erl_torch import InputError, checks, read_log
from erl_torch.checks import InputError as ChecksInputError
from erl_torch.cli import config
from erl_torch.cli import main as cli
from erl_torch.envs import ENTRY_POINTS
from erl_torch.learners import LEARNERS, AlgorithmS1, ListedS1
from erl_torch.run import classes
from erl_torch.run import settings as schemas
from erl_torch.run.build import OF_THE_MODEL, make_learner
from erl_torch.run.training import train


def complaint(directory, *overrides):
    """The one line that a run with these overrides ends in."""
    try:
        train(composed(*overrides), directory)
    except (*cli.BY_CONFIGURATION, *cli.BY_RUN) as error:
        return cli._line(error)
    raise AssertionError(f"{overrides} ran")


def test_defaults_are_figure_5s(authors):
    cfg = composed()
    learner = cfg.learner
    assert (learner.beta, learner.lr_u, learner.lr_psi) == (
        authors["beta"],
        authors["alpha"],
        authors["alpha_psi"],
    )
    assert learner.lr_rho is None  # lr_u / n_states
    assert (learner.n_epochs, learner.n_bias) == (15, 6)
    assert (learner.rho_init, learner.self_loop) == ("carry", "old")  # as the authors' script made it
    assert cfg.experience.n_episodes * cfg.experience.episode_length == 500_000
    assert cfg.env.wind_angle == pytest.approx(authors["wind"][0, 1, 1], abs=1e-15)


@pytest.mark.parametrize("path", sorted(CONF.rglob("*.yaml")), ids=lambda p: f"{p.parent.name}/{p.stem}")
def test_every_key_is_explained(path):
    """A comment on the key's own line or on the one above."""
    lines = path.read_text().splitlines()
    assert lines[0].startswith("# ")
    exempt = ("defaults", "name", "hydra", "job", "run", "sweep", "dir", "subdir", "chdir")
    for above, line in pairwise(lines):
        key = re.match(r"\s*(\w+):", line)
        if key and key[1] not in exempt:
            assert "#" in line or above.lstrip().startswith("#"), line


OF_A_CLASS = [path for group in classes.GROUPS for path in sorted((CONF / group).glob("*.yaml"))]


@pytest.mark.parametrize("path", OF_A_CLASS, ids=lambda path: f"{path.parent.name}/{path.stem}")
def test_keys_are_the_arguments_of_the_class(path):
    """All of them, and besides those that tell where it is and what suits it."""
    text: Any = OmegaConf.load(path)
    keys = set(text) - {"defaults", "class", "name", "id", "suggest", *OF_THE_MODEL}
    if path.stem == "windy_frozen_lake":  # its episodes may end
        keys -= set(classes.OF_ENDS)
    if "class" in text:
        kind = classes.resolve(text["class"], "class")
        if path.parent.name == "learner":
            assert kind is LEARNERS.get(path.stem, kind)  # others are of networks
    elif path.stem == "log":  # no environment: what read_log is told of it
        assert keys - {"end_target"} < set(inspect.signature(read_log).parameters)
        return
    elif not OmegaConf.is_missing(text, "id") and text.id in ENTRY_POINTS:
        kind = load_env_creator(gym.spec(text.id).entry_point)
    else:  # any environment of Gymnasium's: its arguments are in kwargs
        assert keys <= {"kwargs", *classes.OF_EVERY_ENV}
        return
    assert keys == set(inspect.signature(kind).parameters) - {"render_mode"}


@pytest.mark.parametrize("path", sorted((CONF / "env").glob("*.yaml")), ids=lambda path: path.stem)
def test_suggestions_are_settings_that_exist(path):
    assert set(OmegaConf.load(path).suggest) <= {f.name for f in fields(schemas.Suggest)}


@pytest.mark.parametrize("path", sorted((CONF / "env").glob("*.yaml")), ids=lambda path: path.stem)
def test_environments_compose_and_suggest_a_beta(path):
    needed = {"gym": ["env.id=FrozenLake-v1"], "mdp": ["env.path=mdp.npz"]}
    cfg = composed(f"env={path.stem}", *needed.get(path.stem, []))
    assert cfg.learner.beta == cfg.env.suggest.beta > 0
    assert composed("learner=exact", f"env={path.stem}", "learner.beta=3").learner.beta == 3
    schemas.check_keys(cfg)


NAN, INF = float("nan"), float("inf")
NOT_POSITIVE = (0.0, -1.5, NAN, INF)
NOT_A_STEP = (0.0, -0.1, math.nextafter(1.0, 2.0), NAN)
NOT_A_COUNT = (0, -3)
TEXT = ("abcxyz",)
BAD_VALUES = {
    "learner.beta": (*NOT_POSITIVE, *TEXT),
    "learner.lr_u": (*NOT_A_STEP, *TEXT),
    "learner.lr_rho": NOT_A_STEP,
    "learner.lr_psi": NOT_A_STEP,
    "learner.n_epochs": (*NOT_A_COUNT, *TEXT, 1.5),
    "learner.n_bias": NOT_A_COUNT,
    "learner.psi_tol": NOT_POSITIVE,
    "learner.rescale_every": NOT_A_COUNT,
    "learner.max_psi_epochs": NOT_A_COUNT,
    "learner.rho_init": TEXT,
    "learner.self_loop": TEXT,
    "learner.unvisited": TEXT,
    "learner.implementation": TEXT,
    "learner.device": TEXT,
    "learner.clip_rho": TEXT,
    "learner.prior_policy": TEXT,
    "experience.n_episodes": NOT_A_COUNT,
    "experience.episode_length": NOT_A_COUNT,
    "experience.behaviour_policy": TEXT,
    "learner.tol": NOT_POSITIVE,
    "learner.max_steps": NOT_A_COUNT,
    "evaluation.every": NOT_A_COUNT,
    "evaluation.n_episodes": NOT_A_COUNT,
    "evaluation.horizon": NOT_A_COUNT,
    "evaluation.exact_up_to": NOT_A_COUNT,
    "env.wind_strength": (-1e-9, math.nextafter(1.0, 2.0)),
    "env.wind_angle": (NAN, INF),
    "seed": (-1,),
    "threads": NOT_A_COUNT,
}


@pytest.mark.parametrize("key", sorted(BAD_VALUES))
def test_bad_values_get_one_line_that_names_them(tmp_path, key):
    exact = ["learner=exact"] if key in ("learner.tol", "learner.max_steps") else []
    small = [] if "n_episodes" in key else ["experience.n_episodes=1"]
    for value in BAD_VALUES[key]:
        line = complaint(tmp_path, f"{key}={value}", *exact, *small)
        assert line.startswith((key, key.split(".")[-1]))
        assert "\n" not in line
        assert len(line) > len(key) + 10
        assert list(tmp_path.iterdir()) == []


TOO_LARGE = "1" + "0" * 30  # beyond 64 bits
COUNTS = ["seed", "n_replicas", "threads", "learner.n_epochs", "learner.n_bias", "learner.max_psi_epochs"]
COUNTS += ["learner.rescale_every", "experience.n_episodes", "experience.episode_length", "evaluation.every"]
COUNTS += ["evaluation.n_episodes", "evaluation.horizon", "evaluation.exact_up_to"]


@pytest.mark.parametrize("key", COUNTS)
def test_whole_numbers_beyond_64_bits_are_named(tmp_path, key):
    assert complaint(tmp_path, f"{key}={TOO_LARGE}") == f"{key}={TOO_LARGE}: must be below 2**63"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("experience.n_episodes=1000000000000", "experience.n_episodes=1000000000000: must be smaller: a stream of"),
        ("experience.episode_length=1000000000000", "experience.n_episodes=500: must be smaller: a stream of"),
        ("n_replicas=1000000000", "n_replicas=1000000000: must be smaller: one learner per replica"),
        ("evaluation.n_episodes=1000000000000", "evaluation.n_episodes=1000000000000: must be smaller: the returns"),
        ("threads=100000", "threads=100000: must be at most 1024"),
        ("env=windy_maze env.size=1000000", "env.size=1000000: must be smaller: a maze of"),
        ("env=pendulum env.bins=40000 env.n_samples=1", "env.bins=[40000, 40000]: must be smaller: a model of"),
        ("n_replicas=1000 keep_tuples=true experience.n_episodes=100000000", "keep_tuples=true: must be smaller"),
        (f"n_replicas=2 seed={2**63 - 2}", f"seed + n_replicas={2**63}: must be below 2**63"),
        (f"vary.beta=[{TOO_LARGE}]", f"vary.beta=[{TOO_LARGE}]: must be whole numbers below 2**63"),
    ],
)
def test_sizes_are_refused_before_anything_is_allocated(tmp_path, override, expected):
    line = complaint(tmp_path, *(f"++{o}" if o.startswith("vary") else o for o in override.split()))
    assert line.startswith(expected)
    if "smaller" in expected:
        assert re.search(r"needs \S+ GB of memory, and \S+ GB are free$", line)
    assert list(tmp_path.iterdir()) == []


def test_free_memory_is_within_the_process_s_own_limit():
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (used + 2**30, before[1]))
    try:
        assert 0 < checks.free_memory() <= 2**30
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)
    checks.memory("x", 1, 1000, "a table")
    with pytest.raises(InputError, match=r"x=1e31: must be smaller: it needs more than 1e291 GB of memory, and"):
        checks.memory("x", 10**31, 10**400, "it")


def test_counts_are_whole_numbers_of_64_bits():
    for value in (math.nan, math.inf, -1, 0.5, 3.0, True, "3", None, 2**63, 10**5000):
        with pytest.raises(InputError, match=r"^n=.*: must be (a whole number >= 0|below 2\*\*63)$"):
            checks.at_least("n", value, 0)
    for good in (0, np.int32(5), 2**63 - 1):
        found = checks.at_least("n", good, 0)
        assert found == good
        assert type(found) is int


@pytest.mark.parametrize(
    ("message", "expected"),
    [
        (MemoryError("Unable to allocate 9 TiB"), True),
        (
            RuntimeError("DefaultCPUAllocator: can't allocate memory"),
            True,
        ),
        (RuntimeError("CUDA out of memory. Tried to allocate 2 GiB"), True),
        (RuntimeError("a bug"), False),
    ],
)
def test_want_of_memory_is_one_line(message, expected):
    assert checks.out_of_memory(message) is expected
    assert cli.expected(message) is expected
    if expected:
        assert re.fullmatch(r"memory: not enough \(.*\)", cli._line(message))


@pytest.mark.parametrize("group", ["", "env.", "learner.", "experience.", "evaluation."])
@pytest.mark.parametrize("plus", ["", "+"])
def test_unknown_keys_get_one_line(tmp_path, group, plus):
    line = complaint(tmp_path, f"{plus}{group}abcxyz=2")
    assert line.startswith(f"{group}abcxyz")
    assert "no such key; there are " in line
    assert "\n" not in line


@pytest.mark.parametrize(
    ("overrides", "expected"),
    [
        (["env=cliff"], "env=cliff: must be access_control or acrobot or acrobot_v1 or admission or car_rental or"),
        (["env=gym"], "env.id=???: must be given, as in env.id=VALUE"),
        (["experience=recorded"], "experience.path=???: must be given, as in experience.path=VALUE"),
        (["learner.beta="], "learner.beta="),
        (["learner.beta=[1,"], "learner.beta=[1,: not of the form key=value"),
        (["env=gym", "env.id=Nowhere-v0"], "env.id=Nowhere-v0: must be an environment that Gymnasium has"),
        (["env=gym", "env.id=CartPole-v1"], "env.observation_space=Box"),
        (["env=gym", "env.id=FrozenLake-v1", "++env.kwargs.ice=3"], "env.kwargs={'ice': 3}: must be arguments of"),
        (["learner.beta=1000"], "learner.beta=1000.0: must be below 745"),
        (["n_replicas=2.5"], "n_replicas=2.5: must be a whole number >= 1, in digits"),
        (["seed=abc"], "seed=abc: must be a whole number >= 0, in digits"),
        (["experience.n_episodes=1e15"], "experience.n_episodes=1000000000000000.0: must be a whole number, in digits"),
        (["++learner.n_epochs=1.5"], "learner.n_epochs=1.5: must be a whole number, in digits"),
        (["learner.lr_rho=x"], "learner.lr_rho=x: must be a number, or null"),
        (["learner.clip_rho=maybe"], "learner.clip_rho=maybe: must be true or false"),
        (["env.suggest.beta=x"], "env.suggest.beta=x: must be a number"),
        (["++vary.beta=[]"], "vary.beta=[]: must be a list of numbers"),
        (["env=mdp", "env.path=nothere.npz"], "env.path=nothere.npz: must be a readable npz file"),
        (["experience=recorded", "experience.path=nothere.npz"], "experience.path=nothere.npz: must be there"),
    ],
)
def test_other_complaints(tmp_path, overrides, expected):
    line = complaint(tmp_path, *overrides)
    assert line.startswith(expected)
    assert "\n" not in line


def test_run_names():
    assert config.run_name(3, "learner.beta=2,seed=0") == "003-beta=2-seed=0"
    assert config.run_name(0, "") == "000-run"
    assert config.run_name(12, "+env.kwargs.desc=[a/b c],learner=s1") == "012-desc=-a-b-c-learner=s1"
    assert len(config.run_name(1, "x=" + "y" * 500)) == 80
    assert "/" not in config.slug("../../a b/c")
    assert config.slug("") == "run"


def test_input_errors_are_value_errors_on_one_line():
    error = InputError("key", "a\nb", "c").within("group")
    assert isinstance(error, ValueError)
    assert InputError is ChecksInputError
    assert str(error) == "group.key=a b: must be c"


@pytest.mark.parametrize(("name", "python"), [("s1", AlgorithmS1()), ("s1_listing", ListedS1())])
def test_the_command_line_and_python_have_one_set_of_defaults(name, python):
    """On the windy cliff, where README's figures are."""
    made = make_learner(composed(f"learner={name}").learner, 15, 4)
    assert type(made) is type(python)
    for item in fields(python):
        assert getattr(made, item.name) == getattr(python, item.name), item.name
