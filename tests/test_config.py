"""The configuration: complete, typed, explained, and clear about what it refuses."""

import math
import re
from dataclasses import fields
from itertools import pairwise
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from erl_torch import InputError, cli, config
from erl_torch.checks import InputError as ChecksInputError
from erl_torch.learners import LEARNERS
from erl_torch.training import train

CONF = Path(__file__).parents[1] / "conf"
config.register()


def composed(*overrides):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose("train", list(overrides))


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


@pytest.mark.parametrize("name", sorted(LEARNERS))
def test_schema_is_the_learners_signature(name):
    schema = {f.name: f.default for f in fields(config.SCHEMAS["learner"][name])}
    learner = {f.name: f.default for f in fields(LEARNERS[name])}
    assert schema.pop("name") == name
    assert schema == learner


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


def presets(group):
    """Files that only set keys of another one of their group."""
    paths = (CONF / group).glob("*.yaml")
    return {path.stem for path in paths if OmegaConf.load(path).defaults[0] in config.SCHEMAS[group]}


@pytest.mark.parametrize("group", sorted(config.SCHEMAS))
def test_every_schema_has_its_yaml(group):
    stems = {p.stem for p in (CONF / group).glob("*.yaml")}
    assert stems - presets(group) == set(config.SCHEMAS[group])
    for stem in stems - presets(group):
        keys = set(OmegaConf.load(CONF / group / f"{stem}.yaml")) - {"defaults"}
        assert keys == {f.name for f in fields(config.SCHEMAS[group][stem])}


@pytest.mark.parametrize("path", sorted((CONF / "env").glob("*.yaml")), ids=lambda path: path.stem)
def test_environments_compose_and_suggest_a_beta(path):
    needed = {"gym": ["env.id=FrozenLake-v1"], "mdp": ["env.path=mdp.npz"]}
    cfg = composed(f"env={path.stem}", *needed.get(path.stem, []))
    assert cfg.learner.beta == cfg.env.suggest.beta > 0
    assert composed("learner=exact", f"env={path.stem}", "learner.beta=3").learner.beta == 3
    config.check_keys(cfg)


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


@pytest.mark.parametrize("group", ["", *(f"{g}." for g in config.SCHEMAS)])
@pytest.mark.parametrize("plus", ["", "+"])
def test_unknown_keys_get_one_line(tmp_path, group, plus):
    line = complaint(tmp_path, f"{plus}{group}abcxyz=2")
    assert line.startswith(f"{group}abcxyz")
    assert "no such key; there are " in line
    assert "\n" not in line


@pytest.mark.parametrize(
    ("overrides", "expected"),
    [
        (["env=cliff"], "env=cliff: must be acrobot or cart_pole or cliff_walking or dynamics_shift or"),
        (["env=gym"], "env.id=???: must be given, as in env.id=VALUE"),
        (["experience=recorded"], "experience.path=???: must be given, as in experience.path=VALUE"),
        (["learner.beta="], "learner.beta="),
        (["learner.beta=[1,"], "learner.beta=[1,: not of the form key=value"),
        (["env=gym", "env.id=Nowhere-v0"], "env.id=Nowhere-v0: must be an environment that Gymnasium has"),
        (["env=gym", "env.id=CartPole-v1"], "observation_space=Box"),
        (["env=gym", "env.id=FrozenLake-v1", "++env.kwargs.ice=3"], "env.kwargs={'ice': 3}: must be arguments of"),
        (["learner.beta=1000"], "learner.beta=1000.0: must be below 745"),
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
