"""Typed schemas of the configuration in ``conf/``, and the resolvers that name run directories.

Light to import (no torch): ``--help`` and Tab completion stop here. Types are checked by Hydra; unknown
keys (``+learner.betta=2`` included) by ``check_keys``; ranges by what the values are handed to, first thing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any

from omegaconf import MISSING, DictConfig, OmegaConf

from erl_torch.checks import InputError


@dataclass
class Suggest:
    """What suits an environment; the yaml files of learners and experience refer to it."""

    beta: float = 10.0
    lr_u: float = 0.005
    lr_rho: float | None = None
    n_episodes: int = 500
    episode_length: int = 1000


@dataclass
class WindyCliff:
    name: str = "windy_cliff"
    id: str = "erl_torch/WindyCliff-v0"
    suggest: Suggest = field(default_factory=Suggest)
    wind_angle: float = 0.75 * math.pi
    wind_strength: float = 0.7
    trap_reward: float = -5.0


@dataclass
class WindyFrozenLake:
    name: str = "windy_frozen_lake"
    id: str = "erl_torch/WindyFrozenLake-v0"
    suggest: Suggest = field(default_factory=Suggest)
    desc: Any = "holes"
    wind: str | None = None
    wind_angle: float = 0.75 * math.pi
    wind_strength: float = 0.3
    n_actions: int = 4
    action_success_prob: Any = 1.0
    cyclic: bool = True
    trap_reward: float = -2.0
    tile_rewards: dict[str, float] = field(default_factory=dict)


@dataclass
class WindyMaze:
    name: str = "windy_maze"
    id: str = "erl_torch/WindyMaze-v0"
    suggest: Suggest = field(default_factory=Suggest)
    size: int = 10
    n_traps: int | None = 10
    density: float = 0.2
    wind_level: float = 2.0
    maze_seed: int = 0
    trap_reward: float = -2.0


@dataclass
class DynamicsShift:
    name: str = "dynamics_shift"
    id: str = "erl_torch/DynamicsShift-v0"
    suggest: Suggest = field(default_factory=Suggest)
    shifted: bool = False
    up_success: float = 1e-4


@dataclass
class Control:
    name: str = MISSING
    id: str = MISSING
    suggest: Suggest = field(default_factory=Suggest)
    bins: Any = None
    low: Any = None
    high: Any = None
    reward: str = "cyclic"
    stream: str = "model"
    n_samples: int = 500
    model_seed: int = 0


@dataclass
class Torque(Control):
    torques: Any = None


@dataclass
class Mdp:
    name: str = "mdp"
    id: str = "erl_torch/TabularMDP-v0"
    suggest: Suggest = field(default_factory=Suggest)
    path: str = MISSING
    normalise: bool = False


@dataclass
class Gym:
    name: str = MISSING
    id: str = MISSING
    suggest: Suggest = field(default_factory=Suggest)
    kwargs: dict[str, Any] = field(default_factory=dict)
    use_model: bool = True
    on_end: str = "restart"
    bins: Any = None
    low: Any = None
    high: Any = None
    actions: Any = None


@dataclass
class S1:
    """The arguments of ``erl_torch.AlgorithmS1``; prior_policy is a file here."""

    name: str = "s1"
    beta: float = 10.0
    lr_u: float = 0.005
    lr_rho: float | None = None
    lr_psi: float = 0.1
    n_epochs: int = 15
    n_bias: int = 6
    psi_tol: float = 1e-4
    max_psi_epochs: int = 10_000
    prior_policy: str | None = None
    rho_init: str = "carry"
    self_loop: str = "old"
    clip_rho: bool = True
    rescale_every: int | None = None
    unvisited: str = "initial"
    implementation: str = "fast"
    device: str = "cpu"


@dataclass
class S1Listing(S1):
    """The arguments of ``erl_torch.ListedS1``; prior_policy is a file here."""

    name: str = "s1_listing"
    rho_init: str = "reset"
    self_loop: str = "new"


@dataclass
class S1Efficient:
    """The arguments of ``erl_torch.EfficientS1``; prior_policy is a file here."""

    name: str = "s1_efficient"
    beta: float = 10.0
    lr_u: float = 0.005
    lr_rho: float | None = None
    n_epochs: int = 3
    n_bias: int = 30
    prior_policy: str | None = None
    tol: float = 1e-7
    clock_horizon: float = 10.0
    clock_floor: float = 0.05
    phase_growth: float = 2.0
    lr_psi: float = 0.1
    psi_tol: float = 1e-4
    max_psi_epochs: int = 10_000
    sample_mean_psi: bool = True
    expected_backup: bool = True
    clocks: bool = True
    mean_reward: bool = True
    warm_start: bool = True
    polyak: bool = True
    log_domain: str = "auto"
    certificate: bool = True
    unvisited: str = "exclude"


@dataclass
class CertaintyEquivalence:
    """The arguments of ``erl_torch.CertaintyEquivalence``."""

    name: str = "certainty_equivalence"
    beta: float = 10.0
    tol: float = 1e-10
    max_steps: int = 200
    prior_policy: str | None = None


@dataclass
class Exact:
    """The arguments of ``erl_torch.learners.Exact``."""

    name: str = "exact"
    beta: float = 10.0
    method: str = "biasing"
    tol: float = 1e-10
    max_steps: int = 200
    prior_policy: str | None = None


@dataclass
class ActionValue:
    """The arguments that the learners of action values share."""

    beta: float = 10.0
    power: float = 0.6
    n_epochs: int = 15
    prior_policy: str | None = None


@dataclass
class DifferentialSoftQ(ActionValue):
    name: str = "differential_soft_q"
    lr_rate: float | None = None


@dataclass
class RVISoftQ(ActionValue):
    name: str = "rvi_soft_q"
    reference: int | None = None


@dataclass
class ULearning(ActionValue):
    name: str = "u_learning"
    lr_rate: float | None = None


@dataclass
class ZLearning(ActionValue):
    name: str = "z_learning"
    lr_rate: float | None = None


@dataclass
class SoftQ(ActionValue):
    name: str = "soft_q"
    discount: float = 0.9


@dataclass
class QLearning(ActionValue):
    name: str = "q_learning"
    discount: float = 0.9


@dataclass
class Sarsa(ActionValue):
    name: str = "sarsa"
    discount: float = 0.9


@dataclass
class Simulate:
    name: str = "simulate"
    n_episodes: int = 500
    episode_length: int = 1000
    behaviour_policy: str | None = None
    save_to: str | None = None


@dataclass
class Recorded:
    name: str = "recorded"
    path: str = MISSING
    on_bad: str = "stop"
    chunk: int = 4_194_304
    on_prior: bool = False


@dataclass
class Standard:
    name: str = "standard"
    every: int = 1
    n_episodes: int = 20
    horizon: int = 1000
    pictures: bool = True
    certify: bool = True
    exact_up_to: int = 1_000_000


@dataclass
class Train:
    seed: int = 0
    n_replicas: int = 1
    vary: dict[str, Any] = field(default_factory=dict)
    shared_stream: bool = False
    keep_tuples: bool | None = None
    threads: int | None = None
    checkpoint_every: float | None = 60.0
    env: Any = MISSING
    learner: Any = MISSING
    experience: Any = MISSING
    evaluation: Any = MISSING


@dataclass
class Compare:
    learners: list[str] = MISSING
    seeds: int = 20
    seed: int = 0
    beta: float | None = None
    prior_policy: str | None = None
    n_sizes: int = 7
    processes: int = 1
    env: Any = MISSING
    experience: Any = MISSING
    learner: dict[str, Any] = MISSING


@dataclass
class Reproduce:
    artifact: str = MISSING
    scale: str = "quick"
    seed: int = 0
    processes: int = 2


@dataclass
class Play:
    run: str = MISSING
    n_episodes: int = 20
    seed: int = 0
    greedy: bool = False
    module: str | None = None
    replica: int | None = None
    render: str = "ansi"
    n_steps: int | None = None


SCHEMAS: dict[str, dict[str, type]] = {
    "env": {
        "windy_cliff": WindyCliff,
        "windy_frozen_lake": WindyFrozenLake,
        "windy_maze": WindyMaze,
        "dynamics_shift": DynamicsShift,
        "pendulum": Torque,
        "mountain_car": Control,
        "cart_pole": Control,
        "acrobot": Torque,
        "mdp": Mdp,
        "gym": Gym,
    },
    "learner": {
        "s1": S1,
        "s1_listing": S1Listing,
        "s1_efficient": S1Efficient,
        "certainty_equivalence": CertaintyEquivalence,
        "differential_soft_q": DifferentialSoftQ,
        "rvi_soft_q": RVISoftQ,
        "u_learning": ULearning,
        "z_learning": ZLearning,
        "soft_q": SoftQ,
        "q_learning": QLearning,
        "sarsa": Sarsa,
        "exact": Exact,
    },
    "experience": {"simulate": Simulate, "recorded": Recorded},
    "evaluation": {"standard": Standard},
}


TOP = (Train, Compare, Reproduce, Play)
FROM = {"seed": 0, "maze_seed": 0, "model_seed": 0, "n_traps": 0, "reference": 0, "replica": 0, "size": 5}  # others: 1
KINDS = {
    "float": "a number",
    "bool": "true or false",
    "str": "text",
    "list[str]": "a list of names, [A,B]",
    "dict[str, Any]": "settings by name, {KEY: VALUE}",
    "dict[str, float]": "numbers by name, {KEY: VALUE}",
}


def allowed(key: str) -> str | None:
    """What a dotted key takes, by its type; None where there is no such key, or it takes anything."""
    group, _, rest = key.rpartition(".")
    schemas: list[type] = list(TOP)
    if group:
        schemas = [Suggest] if group.endswith(".suggest") else list(SCHEMAS.get(group.split(".")[0], {}).values())
    for schema in schemas:
        for item in fields(schema):
            if item.name == (rest or key):
                kind, _, optional = str(item.type).partition(" | ")
                said = f"a whole number >= {FROM.get(item.name, 1)}, in digits" if kind == "int" else KINDS.get(kind)
                return said and said + (", or null" if optional else "")
    return KINDS["float"] if group and allowed(group) == KINDS["dict[str, float]"] else None


def check_keys(cfg: DictConfig, schema: type = Train) -> None:
    """Raise InputError for a key that no schema has, and for one that has no value."""
    _check_node(cfg, schema, "")


def check_comparison_keys(cfg: DictConfig) -> None:
    """``check_keys`` for ``conf/compare.yaml``: ``learner`` holds the settings of several, by name."""
    _check_node(cfg, Compare, "")
    for name in map(str, cfg.learner):
        if name not in SCHEMAS["learner"]:
            raise InputError(f"learner.{name}", "", f"left out: the learners are {', '.join(SCHEMAS['learner'])}")
        _check_node(cfg.learner[name], SCHEMAS["learner"][name], f"learner.{name}.")


def check_reproduction_keys(cfg: DictConfig) -> None:
    """``check_keys`` for ``conf/reproduce.yaml``."""
    _check_node(cfg, Reproduce, "")


def _check_node(node: DictConfig, schema: Any, prefix: str) -> None:
    known = [field.name for field in fields(schema)] if is_dataclass(schema) else []
    for name in map(str, node):
        if name not in known:
            raise InputError(prefix + name, node[name], f"left out: no such key; there are {', '.join(known)}")
        if is_dataclass(OmegaConf.get_type(node, name)):
            _check_node(node[name], OmegaConf.get_type(node, name), f"{prefix}{name}.")
        if OmegaConf.is_missing(node, name):
            raise InputError(prefix + name, "???", f"given, as in {prefix}{name}=VALUE")
