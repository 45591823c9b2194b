"""Classes of one's own on the command line: ``learner.class=my_package.MyLearner learner.KEY=VALUE``.

The class is imported, and its arguments become the keys of its group, as if ``conf/`` had a file for it. What a run
directory alone names is not imported: that would run code which nobody has asked for.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from hydra.core.config_store import ConfigStore
from omegaconf import DictConfig, OmegaConf

from erl_torch.checks import InputError
from erl_torch.cli.config import composed, config_dir
from erl_torch.run.classes import GROUPS, foreign, is_own, offered, parameters, resolve

PATH = re.compile(r"[A-Za-z_]\w*(\.\w+)+")


def choices(arguments: Sequence[str], conf: Path) -> list[str]:
    """``arguments`` with GROUP=PATH for GROUP.class=PATH where nothing else chooses the group.

    So it is for ``learner.NAME.class=PATH`` of a comparison, where conf/ has no learner of that name.
    """
    chosen = {group for group in GROUPS if any(a.lstrip("+").startswith(f"{group}=") for a in arguments)}
    result = []
    for argument in arguments:
        key, _, value = argument.partition("=")
        group, _, name = key.removesuffix(".class").partition(".")
        if not key.endswith(".class") or group not in GROUPS or (group in chosen and not name):
            result.append(argument)
        elif not name:
            result.append(f"{group}={value}")
            chosen.add(group)
        elif (conf / group / f"{name}.yaml").exists() or "." in name:
            result.append(argument)
        else:
            result.append(f"+{group}@{group}.{name}={value}")
    return result


def paths(arguments: Sequence[str]) -> list[tuple[str, str]]:
    """(group, path) of each class that ``arguments``, as ``choices`` gives them, make the command line import."""
    found = []
    for argument in arguments:
        key, _, value = argument.lstrip("+").partition("=")
        group = re.split(r"[@.]", key)[0]
        if group in GROUPS and (key == group or key.endswith(".class") or key.startswith(f"{group}@")):
            names = (name.strip(" '\"") for name in value.split(","))
            found += [(group, name) for name in names if PATH.fullmatch(name)]
    return found


def offer(arguments: Sequence[str]) -> list[str]:
    """Import the classes and make their arguments keys: ``arguments`` as Hydra takes them. Raises InputError."""
    added: set[str] = set()
    for group, path in paths(arguments):
        ConfigStore.instance().store(group=group, name=path, node=offered(group, path))
        if f"{group}.class={path}" in arguments:  # in the place of another's: arguments of its own are new keys
            added |= {f"{group}.{name}=" for name in parameters(resolve(path, f"{group}.class"))}
    return [f"++{a}" if any(a.startswith(key) for key in added) else a for a in arguments]


def named_again(directory: Path, arguments: Sequence[str], typed: Sequence[str]) -> None:
    """Raise InputError for a class that ``arguments``, those of a run directory among them, make the command line
    import, and that nobody has ``typed``."""
    for group, path in paths(arguments):
        _require(directory, f"{group}.class", path, typed)


def composed_again(directory: Path, arguments: Sequence[str], typed: Sequence[str], conf: Path, name: str) -> None:
    """Raise InputError for a class, or a module of an environment, that the configuration of a run directory comes to,
    and that nobody has ``typed``."""
    cfg = composed(conf, name, arguments)
    for key, path in foreign(cfg).items():
        _require(directory, key, path, typed)
    env_id = str(cfg.env.get("id"))
    module = env_id.partition(":")[0]
    if ":" in env_id and not any(f"{module}:" in a.partition("=")[2] for a in typed if a.lstrip("+").startswith("env")):
        raise InputError("resume", directory, f"named with its module, which is imported: add env={env_id}")


def _require(directory: Path, key: str, path: str, typed: Sequence[str]) -> None:
    if is_own(path) or path in {name for _, name in paths(typed)} or path in _of_files(typed):
        return
    raise InputError("resume", directory, f"named with its class, which is imported: add {key}={path}")


def _of_files(typed: Sequence[str]) -> set[str]:
    """The classes in the files of a --config-dir that is ``typed``."""
    folder = config_dir(typed)
    files = [path for group in GROUPS for path in sorted((folder / group).glob("*.yaml"))] if folder else []
    loaded = [OmegaConf.load(path) for path in files]
    return {str(node.get("class")) for node in loaded if isinstance(node, DictConfig)}
