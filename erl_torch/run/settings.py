"""Typed schemas of the four commands.

Light to import (no torch): ``--help`` and Tab completion stop here. Hydra checks types; ``check_keys`` unknown keys;
what the values are handed to checks ranges, first thing. Environments, learners and sources of experience have no
schema: their keys are the arguments of their classes (``erl_torch.run.classes``).
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any

from omegaconf import MISSING, DictConfig, OmegaConf

from erl_torch.checks import InputError
from erl_torch.guesses import did_you_mean


@dataclass
class Network:
    """What suits learners with networks."""

    beta: float = 10.0
    n_steps: int = 50_000
    end_reward: float = 0.0
    reward_scale: float = 1.0
    hidden: list[int] = field(default_factory=lambda: [64, 64])
    lr: float = 1e-3
    tau: float = 0.01
    explore_start: float = 1.0
    explore_end: float = 0.1
    explore_fraction: float = 0.5
    explore_hold: float = 1.0
    train_time_limit: int | None = None  # None: the environment's own; 0: none


@dataclass
class Suggest:
    """What suits an environment; the yaml files of learners and experience refer to it."""

    beta: float = 10.0
    lr_u: float = 0.005
    lr_rho: float | None = None
    n_episodes: int = 500
    episode_length: int = 1000
    learner: str | None = None  # that published S1 should give way to
    network: Network = field(default_factory=Network)


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
    optimism: float | None = None
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
    env: dict[str, Any] = field(default_factory=lambda: {"class": None})


TOP = (Train, Compare, Reproduce, Play)
FROM = {"seed": 0, "replica": 0}  # others: 1
KINDS = {
    "float": "a number",
    "int": "a whole number, in digits",
    "bool": "true or false",
    "str": "text",
    "list[str]": "a list of names, [A,B]",
    "dict[str, Any]": "settings by name, {KEY: VALUE}",
}


def allowed(key: str) -> str | None:
    """What a dotted key of a schema takes, by its type; None where there is no such key, or it takes anything."""
    group, _, name = key.rpartition(".")
    schemas = {"": TOP, "evaluation": (Standard,), "env.suggest": (Suggest,)}.get(group, ())
    for item in (item for schema in schemas for item in fields(schema) if item.name == name):
        kind, _, optional = str(item.type).partition(" | ")
        text = f"a whole number >= {FROM.get(name, 1)}, in digits" if kind == "int" else KINDS.get(kind)
        return text and text + (", or null" if optional else "")
    return None


def check_keys(cfg: DictConfig, schema: type = Train) -> None:
    """Raise InputError for a key that no schema has, and for one that has no value.

    Keys of environment, learner and experience are arguments of their classes, which are looked at when these are made.
    """
    _check_node(cfg, schema, "")


def check_comparison_keys(cfg: DictConfig) -> None:
    """``check_keys`` for ``conf/compare.yaml``: ``learner`` holds the settings of several, by name."""
    _check_node(cfg, Compare, "")
    learners = cfg.learner.items()
    names = [str(name) for name, settings in learners if isinstance(settings, DictConfig) and "class" in settings]
    for name in map(str, cfg.learner):
        if name not in names:
            raise InputError(f"learner.{name}", cfg.learner[name], f"left out: the learners are {', '.join(names)}")


def check_reproduction_keys(cfg: DictConfig) -> None:
    """``check_keys`` for ``conf/reproduce.yaml``."""
    _check_node(cfg, Reproduce, "")


def _check_node(node: DictConfig, schema: Any, prefix: str) -> None:  # a dataclass
    names = [field.name for field in fields(schema)] if is_dataclass(schema) else list(map(str, node))
    for name in map(str, node):
        if name not in names:
            hint = did_you_mean(name, names, prefix + "{}")
            raise InputError(prefix + name, node[name], f"left out: no such key; there are {', '.join(names)}{hint}")
        if OmegaConf.is_missing(node, name):
            raise InputError(prefix + name, "???", f"given, as in {prefix}{name}=VALUE")
        if not OmegaConf.is_interpolation(node, name) and OmegaConf.is_dict(node[name]):
            _check_node(node[name], OmegaConf.get_type(node, name), f"{prefix}{name}.")
