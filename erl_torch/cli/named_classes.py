"""Classes of one's own on the command line: ``learner.class=my_package.MyLearner learner.KEY=VALUE``.

The class is imported, and its arguments become the keys of its group, as if ``conf/`` had a file for it. What a run
directory alone names is not imported: that would run code which nobody has asked for.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import DictConfig, OmegaConf

from erl_torch.checks import InputError
from erl_torch.cli.config import composed, config_dir
from erl_torch.run.classes import GROUPS, foreign, is_own, offered, parameters, resolve

PATH = re.compile(r"[A-Za-z_]\w*(\.\w+)+")
COLON = re.compile(r"([A-Za-z_]\w*(?:\.\w+)*):([A-Za-z_]\w*)")  # MODULE:CLASS, as others write it
CHOICE = re.compile(r"\+{0,2}(env|learner|experience)(@[\w.]+|(\.\w+)?\.class)?")


def dotted(argument: str) -> str:
    """``argument`` with MODULE.CLASS for MODULE:CLASS where it chooses a group or a class.

    Raises InputError for a module that cannot be imported or has no such class, and for a ``class`` without a module.
    """
    key, _, value = argument.partition("=")
    match = CHOICE.fullmatch(key)
    if match is None:
        return argument
    names = value.split(",")
    if key.endswith(".class"):
        for name in names:
            if not (PATH.fullmatch(name) or COLON.fullmatch(name)) and re.fullmatch(r"[A-Za-z_]\w*", name):
                resolve(name, key)  # raises: no module
    for i, name in enumerate(names):
        if parts := COLON.fullmatch(name):
            names[i] = f"{parts[1]}.{parts[2]}"
            try:
                resolve(names[i], key)
            except InputError as error:
                raise InputError(error.key, name if error.value == names[i] else error.value, error.allowed) from error
    return f"{key}={','.join(names)}"


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
    """Raise InputError for classes that ``arguments``, those of a run directory among them, make the command line
    import, and that nobody has ``typed``."""
    named = {f"{group}.class={path}": path for group, path in paths(arguments)}
    if missing := _missing(named, typed):
        _refuse(directory, [*missing, *(a for a in needed(directory) if not _is_typed(a, typed))])


def composed_again(directory: Path, arguments: Sequence[str], typed: Sequence[str], conf: Path, name: str) -> None:
    """Raise InputError for classes, or a module of an environment, that the configuration of a run directory comes to,
    and that nobody has ``typed``."""
    cfg = composed(conf, name, arguments)
    _refuse(directory, [argument for argument in _imported(cfg) if not _is_typed(argument, typed)])


def needed(directory: Path) -> list[str]:
    """What has to be typed beside resume=``directory``: the classes and modules that its configuration names."""
    path = directory / ".hydra" / "config.yaml"
    try:
        return _imported(OmegaConf.load(path))
    except Exception:  # of a file of any kind: whoever resumes is told
        return []


def _imported(cfg: Any) -> list[str]:  # a configuration
    """KEY=PATH of each class outside this package that ``cfg`` names, and env=MODULE:ID."""
    named = [f"{key}={path}" for key, path in foreign(cfg).items()]
    env = cfg.get("env")
    env_id = str(env.get("id")) if isinstance(env, DictConfig) else ""
    return named + [f"env={env_id}"] * (":" in env_id)


def _is_typed(argument: str, typed: Sequence[str]) -> bool:
    path = argument.partition("=")[2]
    module, colon, _ = path.partition(":")
    if colon:
        return any(f"{module}:" in a.partition("=")[2] for a in typed if a.lstrip("+").startswith("env"))
    return is_own(path) or path in {name for _, name in paths(typed)} or path in _of_files(typed)


def _missing(named: Mapping[str, str], typed: Sequence[str]) -> list[str]:
    return [argument for argument in named if not _is_typed(argument, typed)]


def _refuse(directory: Path, missing: Sequence[str]) -> None:
    """Raise InputError if anything is ``missing``: all of it at once."""
    if missing := list(dict.fromkeys(missing)):
        what = "class, which is" if len(missing) == 1 else "classes, which are"
        what = "module, which is" if ":" in missing[0] else what
        raise InputError("resume", directory, f"named with its {what} imported: add {shlex.join(missing)}")


def _of_files(typed: Sequence[str]) -> set[str]:
    """The classes in the files of a --config-dir that is ``typed``."""
    folder = config_dir(typed)
    files = [path for group in GROUPS for path in sorted((folder / group).glob("*.yaml"))] if folder else []
    loaded = [OmegaConf.load(path) for path in files]
    return {str(node.get("class")) for node in loaded if isinstance(node, DictConfig)}
