"""Checkpoints of a run: everything that is needed to go on, bit for bit, in files that no crash can spoil.

A run directory has ``settings.json`` from the start, and ``checkpoints/`` until the run is complete. A checkpoint is a
line with its SHA-256, then what ``torch.save`` makes of numbers, tensors and containers, the settings of the run among
them, read back with ``weights_only``. It is written under a temporary name and renamed; the last two are kept, and one
that is damaged is passed over.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import math
import pickle
import re
import shutil
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import torch

from erl_torch.checks import InputError, out_of_memory
from erl_torch.evaluation import Evaluation
from erl_torch.files import read_json, write_bytes, write_json
from erl_torch.learners.learner import NonFiniteError
from erl_torch.log.event_file import PATTERN
from erl_torch.log.tensorboard import BESIDE
from erl_torch.solution import Solution, Status

FORMAT = 4  # 1 knew no settings, 2 no types of NumPy's numbers, 3 not which epoch was recorded last
KEPT = 2
MOST_TOLD = 80  # letters of a setting in a message
RESULTS = ("result.json", "solution.npz", "replicas.npz")
FILES = (
    "settings.json",
    *RESULTS,
    "bands.png",
    "sweep.png",
    "dial.png",
    "policy.csv",
)  # that a run writes under names of its own
# Settings that no result depends on.
FREE = ("threads", "checkpoint_every", "keep_tuples", "experience.keep", "experience.chunk")
COMMON = (Evaluation, NonFiniteError, Solution, Status)  # classes that any checkpoint may hold
PLAIN = (np.dtype(np.float64), np.dtype(np.int64), np.dtype(np.bool_))  # what Python's numbers become in an array
Content = dict[str, Any]


class Checkpoints:
    """The checkpoints of a run directory.

    Args:
        directory: the run's.
        settings: what the run computes with; a directory of other settings is refused.
        every: seconds between checkpoints; 0 is after every epoch, None is none but on a stop.
        device: where the tables of a checkpoint go.
        key: what the directory is called in complaints.

    Raises:
        InputError: the directory holds a run of other settings; the first keys that differ are named. Or its
            ``settings.json`` is damaged.
    """

    def __init__(
        self,
        directory: Path,
        settings: Mapping[str, Any],
        every: float | None,
        device: str = "cpu",
        key: str = "hydra.run.dir",
    ) -> None:
        self.directory, self.every, self.device, self.key = directory, every, device, key
        self._folder = directory / "checkpoints"
        self._settings = {key: value for key, value in _flat(settings).items() if key not in FREE}
        self._last = time.monotonic()
        for path in (*(directory / name for name in FILES), *self._folder.glob("*.ckpt")):
            if path.is_dir():
                raise InputError(self.key, directory, f"that of a run: {path} is a directory")
        otherwise = "move it away: the checkpoints, if there are any, know their settings"
        before = read_json(directory / "settings.json", "settings", otherwise)
        self._ours = before is not None
        self._others: set[Path] = set()  # event files that are not this run's
        if before is not None:
            self._compare(before)

    def start(self, classes: Iterable[type] = ()) -> Content | None:
        """Take possession of the directory (leftovers of a killed run go), and ``read``; None: the run begins.

        Raises InputError as ``read``; the directory is then as it was.
        """
        found = self.read(classes)
        self.write_settings()
        for leftover in (*self.directory.glob(".*.tmp"), *self._folder.glob(".*.tmp")):
            leftover.unlink(missing_ok=True)
        if self._ours and found is None:  # it repeats every record
            for path in self.directory.glob(PATTERN):
                path.unlink(missing_ok=True)
        self._others = set(self.directory.glob(PATTERN))
        return found

    def write_settings(self) -> None:
        """Say in the directory what its run computes with."""
        write_json(self.directory / "settings.json", self._settings)

    def read(self, classes: Iterable[type] = ()) -> Content | None:
        """The newest checkpoint that can be read; damaged ones go, with a warning.

        Args:
            classes: what states in it may be made of, beside ``COMMON``: nothing else is made of what a file names.

        Raises InputError for one of other settings, or one that is whole but of another version of the program.
        """
        for path in sorted(self._folder.glob("*.ckpt"), reverse=True):
            try:
                body = _body(path)
            except (OSError, ValueError) as error:
                print(f"warning: {path} cannot be read ({error}): going on from the one before", file=sys.stderr)
                if isinstance(error, ValueError):
                    path.unlink(missing_ok=True)
                continue
            try:
                settings, content = _loaded(body)
                self._compare(settings)
                found: Content = decode(content, (*COMMON, *classes), self.device)
            except (AttributeError, KeyError, TypeError, ValueError, RuntimeError, pickle.UnpicklingError) as error:
                if isinstance(error, InputError) or out_of_memory(error):
                    raise
                said = f"of this version ({' '.join(str(error).split())[:200]}), or moved away"
                raise InputError("checkpoint", path, said) from error
            return found
        return None

    @contextlib.contextmanager
    def refusing(self, learnt: Callable[[], bool]) -> Iterator[None]:
        """Bad input that shows before anything is ``learnt`` leaves nothing behind."""
        try:
            yield
        except InputError:
            if not learnt():
                ours = {self.directory / "settings.json"} if not self._ours else set()
                for path in (ours | {*self.directory.glob(PATTERN)}) - self._others:
                    path.unlink(missing_ok=True)
                for folder in (self.directory / name for name in BESIDE.values()):
                    for path in folder.glob(PATTERN):
                        path.unlink(missing_ok=True)
                    with contextlib.suppress(OSError):  # not there, or somebody else's too
                        folder.rmdir()
                self.clear()
            raise

    def result(self) -> dict[str, Any] | None:
        """What the run came to, if it is complete.

        Raises InputError for a damaged file, and where there are files of a run whose settings nothing tells.
        """
        there = [name for name in RESULTS if (self.directory / name).exists()]
        if there and not self._ours and not any(self._folder.glob("*.ckpt")):
            allowed = f"a new one, or that of a run: it holds a {there[0]} without the settings.json behind it"
            raise InputError(self.key, self.directory, allowed)
        otherwise = "move it away, and the run goes on from its checkpoint or begins again"
        found = read_json(self.directory / "result.json", "result", otherwise)
        if found is not None and not {"status", "objective", "seconds"} <= found.keys():
            raise InputError("result", self.directory / "result.json", f"what a run writes; {otherwise}")
        return None if found is None or found["status"] == "stopped" else found

    def offer(self, step: int, content: Callable[[], dict[str, Any]], now: bool = False) -> None:
        """Write ``content()`` as the checkpoint of ``step``, if it is time (or at once, ``now``)."""
        if not now and (self.every is None or time.monotonic() - self._last < self.every):
            return
        found = content()
        try:
            encoded = encode(found)
        except TypeError as error:
            raise InputError("state of the learner", error, "of what a checkpoint can hold, in every epoch") from error
        _write(self._folder / f"{step:018d}.ckpt", self._settings, encoded)
        for path in sorted(self._folder.glob("*.ckpt"))[:-KEPT]:
            path.unlink(missing_ok=True)
        self._last = time.monotonic()

    def clear(self) -> None:
        """The run is complete: none is needed any more."""
        shutil.rmtree(self._folder, ignore_errors=True)

    def _compare(self, before: Mapping[str, Any]) -> None:
        keys = {**before, **self._settings}.keys() - FREE
        differ = sorted(key for key in keys if before.get(key) != self._settings.get(key))
        if differ:
            differ.sort(key=lambda key: key.rpartition(".")[2] not in ("class", "name", "module"))
            shown = ", ".join(_differs(key, self._settings.get(key), before.get(key)) for key in differ[:5])
            more = f" and {len(differ) - 5} more" if len(differ) > 5 else ""
            allowed = f"of a run with these settings, or a new one: not {shown}{more}"
            raise InputError(self.key, self.directory, allowed)


def _differs(key: str, ours: object, theirs: object) -> str:
    """One setting that two runs do not share, in a few words."""
    if key == "digest":
        return "these tuples (there: others)"
    told = [text if len(text := str(value)) <= MOST_TOLD else f"{text[:MOST_TOLD]}..." for value in (ours, theirs)]
    return f"{key}={told[0]} (there: {told[1]})"


def rows_of(found: Mapping[str, np.ndarray]) -> list[dict[str, Any]]:
    """What ``erl_torch.learners.learner.columns`` was given: numbers as numbers, arrays as arrays."""
    n = max((len(column) for column in found.values()), default=0)
    plain = {
        name: column.tolist() if column.ndim == 1 and column.dtype in PLAIN else list(column)
        for name, column in found.items()
    }
    return [{name: column[i] for name, column in plain.items()} for i in range(n)]


# -- values and their files -----------------------------------------------------------------------------


def encode(value: object) -> object:
    """``value`` in containers, numbers, text and tensors; dataclasses and errors by the name of their class.

    ``decode`` gives back what was there, of the same types. Raises TypeError for a type that would not come back.
    """
    kind = type(value)
    if value is None or kind in (bool, int, float, str):
        return value
    if kind is np.ndarray or isinstance(value, np.generic):
        whole = np.require(value, requirements=("C", "W"))  # as torch takes it
        return {"class": "array" if kind is np.ndarray else "scalar", "value": torch.from_numpy(whole)}
    if kind is torch.Tensor and isinstance(value, torch.Tensor) and not value.requires_grad:
        return value.cpu()
    if is_dataclass(value) and not isinstance(value, type):
        return {"class": kind.__name__, "fields": {f.name: encode(getattr(value, f.name)) for f in fields(value)}}
    if isinstance(value, ArithmeticError):
        return {"class": kind.__name__, "arguments": [encode(item) for item in value.args]}
    if isinstance(value, Enum):
        return {"class": kind.__name__, "of": encode(value.value)}
    if isinstance(value, dict) and kind is dict:
        return {"class": "dict", "items": [(encode(k), encode(v)) for k, v in value.items()]}
    if isinstance(value, tuple) and hasattr(value, "_asdict"):
        return {"class": kind.__name__, "named": {name: encode(item) for name, item in value._asdict().items()}}
    if isinstance(value, tuple) and kind is tuple:
        return {"class": "tuple", "items": [encode(item) for item in value]}
    if isinstance(value, list) and kind is list:
        return [encode(item) for item in value]
    raise TypeError(f"a {kind.__name__} has no place in a checkpoint")


def decode(value: object, classes: Iterable[type], device: str = "cpu") -> Any:  # whatever was encoded
    """What ``encode`` was given. Raises ValueError for a class that is not one of ``classes``."""
    by_name = _by_name(classes)

    def decoded(value: Any) -> Any:  # what torch.load gave: anything
        if isinstance(value, list):
            return [decoded(item) for item in value]
        if isinstance(value, torch.Tensor):
            return value.to(device)
        if not isinstance(value, dict):
            return value
        kind, content = value.values()
        form = next(form for form in value if form != "class")
        if form == "value":
            return content.numpy() if kind == "array" else content.numpy()[()]
        if form == "items":
            return {decoded(k): decoded(v) for k, v in content} if kind == "dict" else tuple(map(decoded, content))
        if kind not in by_name:
            raise ValueError(f"unknown class {kind}")
        if form in ("fields", "named"):
            return _made(by_name[kind], form, {name: decoded(item) for name, item in content.items()})
        return _made(by_name[kind], form, decoded(content))

    return decoded(value)


def _by_name(classes: Iterable[type]) -> dict[str, Any]:
    by_name: dict[str, Any] = {}
    for one in classes:
        if by_name.setdefault(one.__name__, one) is not one:
            raise ValueError(f"two classes are called {one.__name__}")
    return by_name


def _made(kind: Any, form: str, content: Any) -> Any:  # of ``kind``, whatever that is
    """An instance of ``kind`` as ``encode`` found it."""
    if form == "arguments":
        return kind(*content)
    if form == "of":
        return kind(content)
    if form == "named":
        return kind(**content)
    if content.keys() != {f.name for f in fields(kind)}:
        raise ValueError(f"{kind.__name__} has other fields than there: {', '.join(content)}")
    new = object.__new__(kind)  # as it was: nothing is computed or checked anew
    for name, item in content.items():
        object.__setattr__(new, name, item)
    return new


def check_state(state: object, classes: Iterable[type], learner: str = "its learner") -> None:
    """Raise InputError unless a checkpoint can hold ``state``, of ``learner``, as it is made of ``classes``."""
    try:
        decode(encode(state), (*COMMON, *classes))
    except Exception as error:  # of classes that are not the package's
        if out_of_memory(error):
            raise
        allowed = "a learner whose states are of numbers, tensors, arrays, containers and the classes in its states"
        raise InputError("learner", learner, f"{allowed} ({error})") from error


def _write(path: Path, settings: Mapping[str, Any], content: object) -> None:
    """``content`` as ``encode`` gives it."""
    buffer = io.BytesIO()
    torch.save({"format": FORMAT, "settings": dict(settings), "content": content}, buffer)
    body = buffer.getvalue()
    write_bytes(path, hashlib.sha256(body).hexdigest().encode() + b"\n" + body)


def _body(path: Path) -> bytes:
    """Raises ValueError where the file is not what was written."""
    line, _, body = path.read_bytes().partition(b"\n")
    if hashlib.sha256(body).hexdigest().encode() != line:
        raise ValueError("its checksum does not match")
    return body


def _loaded(body: bytes) -> tuple[dict[str, Any], Any]:
    """Settings and encoded content."""
    whole = torch.load(io.BytesIO(body), weights_only=True)
    if whole["format"] != FORMAT:
        raise ValueError(f"it is of format {whole['format']}, not {FORMAT}")
    return whole["settings"], whole["content"]


def _flat(settings: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in settings.items():
        if isinstance(value, Mapping) and value:
            found |= _flat(value, f"{prefix}{key}.")
        else:
            found[f"{prefix}{key}"] = _json(value)
    return found


def _json(value: object) -> object:
    """``value`` as JSON gives it back; it has no infinities."""
    if isinstance(value, Mapping):
        return {str(key): _json(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_json(item) for item in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def failure_of(result: Mapping[str, Any]) -> NonFiniteError | None:
    """What a run raised whose ``result.json`` says that it left the finite numbers."""
    if result["status"] != Status.NON_FINITE.name.lower():
        return None
    told = result.get("message") or next(iter(result.get("failures", {}).values()), "")
    found = re.fullmatch(r"step (\d+): (.*)", told, re.DOTALL)
    return NonFiniteError(int(found[1]), found[2]) if found else NonFiniteError(0, told)


class Ended:
    """Around the end of a run: what goes wrong once there is something to save is kept in ``error`` until it is saved.

    Args:
        learnt: whether there is.
    """

    def __init__(self, learnt: Callable[[], bool]) -> None:
        self.learnt = learnt
        self.error: Exception | None = None

    def __enter__(self) -> Ended:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> bool:
        if not isinstance(error, Exception) or not self.learnt():
            return False
        self.error = error
        return True

    @staticmethod
    def keep(saved: Checkpoints, step: int, content: Callable[[], dict[str, Any]]) -> None:
        """A checkpoint now; where even that fails, the rest can still be saved."""
        try:
            saved.offer(step, content, now=True)
        except Exception as error:
            print(f"warning: no checkpoint of tuple {step:,} ({type(error).__name__}: {error})", file=sys.stderr)
