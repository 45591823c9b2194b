"""Classes by their dotted names: of a learner, an environment, a source of experience; their settings are arguments.

Light to import: the command line offers the arguments of a class of one's own as keys.
"""

from __future__ import annotations

import importlib
import inspect
import os
import traceback
from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from types import ModuleType
from typing import Any, TypeGuard

from omegaconf import BooleanNode, DictConfig, FloatNode, IntegerNode, StringNode, ValidationError

from erl_torch.checks import InputError, out_of_memory
from erl_torch.guesses import did_you_mean
from erl_torch.run.settings import KINDS

GROUPS = ("env", "learner", "experience")  # of which a configuration can name the class
NODES: dict[str, type[FloatNode | IntegerNode | BooleanNode | StringNode]] = {
    "float": FloatNode,
    "int": IntegerNode,
    "bool": BooleanNode,
    "str": StringNode,
}
OF_ENDS = {"on_end": "restart", "end_reward": 0.0, "failures": "default", "end_target": 1e-3}
OF_EVERY_ENV = {
    "use_model": True,
    "use_action_mask": False,
    **OF_ENDS,
    "bins": None,
    "low": None,
    "high": None,
    "actions": None,
}
# Keys of a run's environment: arguments of these names are given as env.kwargs.NAME.
KEYS_OF_ENV = ("class", "name", "id", "suggest", "kwargs")


def resolve(path: object, key: str) -> type:
    """Import the class at the dotted ``path``. Raises InputError under ``key``."""
    module, _, name = str(path).rpartition(".")
    allowed = "the dotted name of a class, as in my_package.MyClass"
    if not module:
        raise InputError(key, path, allowed)
    if key in ("experience.class", "env.class") and Path(str(path)).exists():
        raise InputError(key.split(".")[0], path, f"left out for a file: experience=recorded experience.path={path}")
    home = imported(module, key, path, allowed)
    if not isinstance(found := getattr(home, name, None), type):
        classes = [one for one, value in vars(home).items() if isinstance(value, type)]
        what = "no class" if found is not None else "nothing"
        hint = did_you_mean(name, classes, f"{module}.{{}}")
        raise InputError(key, path, f"{allowed}: {name} is {what} of {module}{hint}")
    return found


def imported(module: str, key: str, value: object, allowed: str) -> ModuleType:
    """Import ``module``. Raises InputError for ``value`` under ``key``: there is none, or why it failed."""
    try:
        return importlib.import_module(module)
    except (Exception, SystemExit) as error:  # of the import system, or whatever the module raises
        if out_of_memory(error):
            raise
        if _is_absent(error, module):
            where = "it has to be installed, in this folder, or on PYTHONPATH"
            raise InputError(key, value, f"{allowed}: there is no module {error.name} ({where})") from error
        raise InputError(key, value, f"of a module that can be imported: {failure(module, error)}") from error


def _is_absent(error: BaseException, module: str) -> TypeGuard[ModuleNotFoundError]:
    """Whether ``error`` says that ``module``, or a package above it, is not there; not one that it imports."""
    return isinstance(error, ModuleNotFoundError) and f"{module}.".startswith(f"{error.name}.")


def failure(module: str, error: BaseException) -> str:
    """Why the import of ``module`` failed, in words, with the line where it did."""
    lines = [frame for frame in traceback.extract_tb(error.__traceback__) if "importlib" not in frame.filename]
    at = f", {os.path.basename(lines[-1].filename)}, line {lines[-1].lineno}" if lines else ""
    return f"{module} failed ({type(error).__name__}: {error}{at})"


def is_own(path: object) -> bool:
    """Whether ``path`` is of this package, which every run directory may name."""
    return str(path).startswith("erl_torch.")


def foreign(cfg: DictConfig) -> dict[str, str]:
    """The classes outside this package that ``cfg`` names, by key: of its groups, and of each learner of several."""
    nodes = {group: cfg[group] for group in GROUPS if group in cfg}
    nodes |= {f"{group}.{name}": node[name] for group, node in nodes.items() for name in map(str, node)}
    paths = {f"{key}.class": node.get("class") for key, node in nodes.items() if isinstance(node, DictConfig)}
    return {key: str(path) for key, path in paths.items() if path is not None and not is_own(path)}


def parameters(kind: type) -> dict[str, inspect.Parameter]:
    """The arguments of ``kind`` that are settings, by name."""
    of_call = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    try:
        arguments = inspect.signature(kind).parameters.items()
    except ValueError as error:  # some built-in classes tell none
        raise InputError("class", kind.__name__, f"a class whose arguments Python can tell ({error})") from error
    return {name: one for name, one in arguments if name != "render_mode" and one.kind not in of_call}


def offered(group: str, path: str) -> dict[str, Any]:
    """The configuration of ``group`` with the class at ``path``: its arguments with their defaults.

    An argument without default is ``???``; one whose default no configuration can hold is left to the class.
    Raises InputError.
    """
    kind = resolve(path, f"{group}.class")
    defaults = {n: "???" if p.default is p.empty else p.default for n, p in parameters(kind).items()}
    if is_dataclass(kind):
        defaults |= {f.name: f.default_factory() for f in fields(kind) if f.default_factory is not MISSING and f.init}
    node: dict[str, Any] = {"class": path, "name": kind.__name__}
    if group == "env":
        node = {"defaults": ["/schema/suggest@suggest", "_self_"], **node, **OF_EVERY_ENV, "kwargs": {}}
        defaults = {name: value for name, value in defaults.items() if name not in KEYS_OF_ENV}
    return node | {name: value for name, value in defaults.items() if _is_setting(value)}


def _is_setting(value: object) -> bool:
    """Whether a configuration and ``settings.json`` can hold ``value``."""
    if isinstance(value, (list, tuple)):
        return all(map(_is_setting, value))
    if isinstance(value, dict):
        return all(isinstance(key, str) and _is_setting(item) for key, item in value.items())
    return value is None or type(value) in (bool, int, float, str)


def settings_of(values: Mapping[str, Any], kind: type, others: tuple[str, ...]) -> dict[str, Any]:
    """The arguments of ``kind`` among ``values``, as numbers, truth values and text where it says that it takes these.

    Raises InputError for a key that is neither an argument nor one of ``others``, and for a value of another type.
    """
    takes = parameters(kind)
    for key, value in values.items():
        if key not in takes and key not in others:
            hint = did_you_mean(key, takes)
            raise InputError(key, value, f"left out: no such key; there are {', '.join(takes)}{hint}")
    return {key: _typed(key, value, takes[key].annotation) for key, value in values.items() if key in takes}


def _typed(key: str, value: object, annotation: object) -> Any:  # as annotated
    text = annotation if isinstance(annotation, str) else inspect.formatannotation(annotation)
    types = {one.strip() for one in text.split("|")}
    if len(types - {"None"}) != 1 or not types <= {*NODES, "None"}:
        return value  # the class looks at it
    (kind,) = types - {"None"}
    if value is None and "None" in types:
        return None
    try:
        return NODES[kind](value, is_optional=False)._value()
    except ValidationError as error:
        raise InputError(key, value, KINDS[kind] + ", or null" * ("None" in types)) from error
