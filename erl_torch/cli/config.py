"""What Hydra is told: schemas, the resolvers that name run directories, and how a configuration is composed."""

from __future__ import annotations

import re
from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path

from hydra import compose, initialize_config_dir
from hydra._internal.utils import get_args_parser
from hydra.core.config_store import ConfigStore
from omegaconf import DictConfig, OmegaConf

from erl_torch import configurations
from erl_torch.cli.paths import quoted
from erl_torch.run.settings import Compare, Play, Reproduce, Standard, Suggest, Train

NOT_COMPARED = ("exact", "deep_s1", "asql", "asac")  # they learn from no stream of tuples with numbers of states
RECORDED = ("recorded", "erl_torch.experience.sources.Recorded")  # experience that needs no environment
COMMANDS = {"train": Train, "compare": Compare, "reproduce": Reproduce, "play": Play}


def slug(text: object) -> str:
    """``text`` as part of a file name: no separators, nothing a shell would touch."""
    return re.sub(r"[^A-Za-z0-9_.=+]+", "-", str(text)).strip("-.") or "run"


def default_env(experience: str) -> str:
    """The environment where none is given: recorded experience tells all that there is."""
    return "log" if experience in RECORDED else "windy_cliff"


def run_name(number: int, overrides: str) -> str:
    """``NNN-key=value-...`` of a multirun job: keys without their group, at most 80 characters."""
    parts = [part.lstrip("+~").split(".")[-1] if "=" not in part else
             part.split("=", 1)[0].lstrip("+~").split(".")[-1] + "=" + part.split("=", 1)[1].strip("'\"")
             for part in overrides.split(",") if part]  # fmt: skip
    return f"{int(number):03d}-{slug('-'.join(parts))}"[:80]


def register() -> None:
    """Make the schemas and resolvers known to Hydra; harmless when repeated."""
    store = ConfigStore.instance()
    for name, schema in COMMANDS.items():
        store.store(group="schema", name=name, node=schema)
    store.store(group="schema", name="suggest", node=Suggest)
    store.store(group="schema/evaluation", name="standard", node=Standard)
    compared = [name for name in configurations.names("learner") if name not in NOT_COMPARED]
    store.store(name="every_learner", node={"defaults": [{f"learner@learner.{name}": name} for name in compared]})
    OmegaConf.register_new_resolver("slug", slug, replace=True)
    OmegaConf.register_new_resolver("default_env", default_env, replace=True)
    OmegaConf.register_new_resolver("run_name", run_name, replace=True)


def options(arguments: Sequence[str]) -> Namespace:
    """Hydra's own options among the arguments of a command, as ``multirun``; the others as ``overrides``."""
    return get_args_parser().parse_known_args(list(arguments))[0]


def config_dir(arguments: Sequence[str]) -> Path | None:
    """The folder of ``--config-dir`` among the arguments of a command."""
    folder = options(arguments).config_dir
    return None if folder is None else Path(folder)


def overrides(arguments: Sequence[str]) -> list[str]:
    """The arguments of a command without Hydra's options."""
    return list(options(arguments).overrides)


def composed(conf: Path, config_name: str, arguments: Sequence[str]) -> DictConfig:
    """What the arguments of a command make of ``config_name``; those for Hydra itself are left out."""
    of_ours = [a for a in overrides(arguments) if not a.startswith("hydra")]
    folder = config_dir(arguments)
    if folder is not None:
        of_ours.append(f"hydra.searchpath=[{quoted(f'file://{folder.resolve()}')}]")
    with initialize_config_dir(str(conf.resolve()), version_base="1.3"):
        return compose(config_name, of_ours)
