"""What a run computes with, as text, to tell the settings of one run from those of another.

Equal values have equal texts, in every process. What differs has another text, as far as its own attributes tell: of a
function that is its name, code, defaults, attributes and what it closes over, but not the global names that it uses.
"""

from __future__ import annotations

import copyreg
import datetime
import decimal
import enum
import fractions
import hashlib
import types
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from pathlib import PurePath
from typing import Any

import gymnasium as gym
import numpy as np
import torch

from erl_torch.checks import LARGEST_INTEGER, InputError
from erl_torch.mdp.tabular import TabularMDP

DEEPEST = 20  # objects in objects
TOLD_BY_REPR: tuple[type, ...] = (
    complex,
    fractions.Fraction,
    decimal.Decimal,
    PurePath,
    slice,
    range,
    type(...),
    datetime.tzinfo,
)
TOLD_BY_REPR += (datetime.date, datetime.time, datetime.timedelta, np.dtype)


def plain(key: str, value: object, depth: int = 0) -> Any:  # what YAML and JSON hold
    """``value`` in numbers, text and containers; of an array or a model its shape and the SHA-256 of its bytes.

    An object of another class is told by its class and attributes, a function by its name and code. Raises InputError,
    under ``key``, for what Python cannot tell apart so.
    """
    if depth > DEEPEST:
        raise InputError(key, type(value).__name__, f"no more than {DEEPEST} objects deep")
    if value is None or type(value) in (bool, float, str):
        return value
    if type(value) is int:
        return value if abs(value) <= LARGEST_INTEGER else f"int {value:x}"
    for told in (_value, _array, _container):
        if (found := told(key, value, depth + 1)) is not None:
            return found
    return _object(key, value, depth + 1)


def _value(key: str, value: object, depth: int) -> Any:
    """One value; None of anything else."""
    if isinstance(value, enum.Enum):
        return f"{_name(type(value))}.{value.name}"
    if isinstance(value, np.generic):
        number = value.dtype.kind in "biuf" and value.dtype.itemsize <= 8
        return plain(key, value.item(), depth) if number else f"{value.dtype} {value!r}"
    if isinstance(value, (bytes, bytearray, memoryview)):
        return f"{len(value)} bytes, {hashlib.sha256(value).hexdigest()[:16]}"
    if isinstance(value, (int, float, str, *TOLD_BY_REPR)):  # of classes of their own, the first three
        return f"{_name(type(value))} {value!r}"
    return None


def _array(key: str, value: object, depth: int) -> Any:
    """An array or a model; None of anything else."""
    if isinstance(value, TabularMDP):
        p = value.transition
        parts = (p.indptr, p.indices, p.data, value.reward, value.start, value.allowed)
        return f"{value.n_states} states, {value.n_actions} actions, {_sha256(parts)}"
    if isinstance(value, torch.Tensor):
        return {"tensor": str(value.dtype), "of": _array(key, value.detach().cpu().to_dense().double().numpy(), depth)}
    if not isinstance(value, np.ndarray):
        return None
    if type(value) is not np.ndarray:  # with attributes of its own: a mask, units
        return _object(key, value, depth)
    if value.dtype.kind == "O":
        return {"array": list(value.shape), "entries": [plain(key, item, depth) for item in value.flat]}
    return f"array {list(value.shape)}, {_sha256((value,))}"


def _container(key: str, value: object, depth: int) -> Any:
    """A dataclass, mapping, set or list; None of anything else."""
    if is_dataclass(value) and not isinstance(value, type):
        own = {f.name: plain(f"{key}.{f.name}", getattr(value, f.name), depth) for f in fields(value)}
        return own if depth == 1 else {"class": _name(type(value)), **own}
    if type(value) is dict and all(isinstance(item, str) for item in value):
        return {item: plain(f"{key}.{item}", value[item], depth) for item in value}
    if isinstance(value, Mapping):
        pairs = [[plain(key, item, depth), plain(f"{key}.{item}", value[item], depth)] for item in value]
        own = plain(key, getattr(value, "default_factory", None), depth)
        return {
            "class": _name(type(value)),
            "pairs": pairs if type(value) is not dict else sorted(pairs, key=repr),
            "default": own,
        }
    if isinstance(value, (set, frozenset)):
        return {"set": sorted((plain(key, item, depth) for item in value), key=repr)}
    if isinstance(value, (list, tuple)):
        return [plain(f"{key}[{i}]", item, depth) for i, item in enumerate(value)]
    return None


def environment(env: gym.Env[Any, Any] | None) -> dict[str, Any]:
    """Class, id and arguments, wrappers and time limit, as far as Gymnasium knows them."""
    if env is None:
        return {"environment": "none"}
    wrappers = []
    inside: Any = env
    while isinstance(inside, gym.Wrapper):
        wrappers.append(_name(type(inside)))
        inside = inside.env
    found: dict[str, Any] = {"environment": _name(type(inside)), "wrappers": wrappers}
    if env.spec is not None:
        found |= {
            "id": env.spec.id,
            "kwargs": plain("env.kwargs", env.spec.kwargs, 1),
            "max_episode_steps": env.spec.max_episode_steps,
            "additional_wrappers": [
                {"name": one.name, "kwargs": plain("env.kwargs", one.kwargs, 1)} for one in env.spec.additional_wrappers
            ],
        }
    return found


def _object(key: str, value: object, depth: int) -> Any:
    if isinstance(value, (type, types.ModuleType)):
        return _name(value)
    if isinstance(value, types.FunctionType):
        inside = [cell.cell_contents for cell in value.__closure__ or ()]
        parts = (inside, value.__defaults__, value.__kwdefaults__, vars(value))
        return {"function": _name(value), "code": _code(value.__code__), "with": plain(key, parts, depth)}
    if isinstance(value, types.MethodType):
        return {"method": value.__name__, "of": plain(key, value.__self__, depth)}
    if isinstance(value, types.BuiltinFunctionType):
        of = value.__self__
        named = of is None or isinstance(of, (types.ModuleType, type))
        return _name(value) if named else {"method": value.__name__, "of": plain(key, of, depth)}
    if (wrapped := getattr(value, "__wrapped__", None)) is not None:
        return {"class": _name(type(value)), "of": plain(key, wrapped, depth)}
    try:
        reduce = copyreg.dispatch_table.get(type(value))
        made: Any = value.__reduce_ex__(2) if reduce is None else reduce(value)  # what a copy would be made of
    except Exception as error:  # of a lock, a file, and the like
        allowed = "a value that can be told from others: numbers, text, arrays, containers, dataclasses, functions"
        raise InputError(key, f"of class {_name(type(value))}", f"{allowed} ({error})") from error
    if isinstance(made, str):
        return f"{_name(type(value))} {made}"
    told = [plain(key, list(part) if isinstance(part, Iterator) else part, depth) for part in made]
    return {"class": _name(type(value)), "parts": told}


def _code(code: types.CodeType) -> str:
    whole = hashlib.sha256(code.co_code)
    for constant in code.co_consts:
        whole.update(_constant(constant).encode())
    whole.update(repr((code.co_names, code.co_varnames)).encode())
    return whole.hexdigest()[:16]


def _constant(value: object) -> str:
    if isinstance(value, types.CodeType):
        return _code(value)
    if isinstance(value, frozenset):  # its order changes from process to process
        return f"set {sorted(map(_constant, value))}"
    return f"({', '.join(map(_constant, value))})" if isinstance(value, tuple) else repr(value)


def _name(value: Any) -> str:  # of whatever has a name
    return f"{getattr(value, '__module__', '')}.{getattr(value, '__qualname__', getattr(value, '__name__', ''))}"


def _sha256(arrays: Sequence[np.ndarray]) -> str:
    whole = hashlib.sha256()
    for array in arrays:
        whole.update(str(array.dtype).encode())
        whole.update(np.ascontiguousarray(array).tobytes())
    return whole.hexdigest()[:16]
