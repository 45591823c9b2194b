"""One kind of error for bad input: it names the key, the value, and what is allowed."""

from __future__ import annotations

import math
import numbers
import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import scipy.sparse as sp

MOST = 2**63 - 1  # compiled loops and files count in 64 bits
MOST_WORKERS = 1024  # threads or processes at once: systems allow a few thousand
PROCESS_BYTES = 250_000_000  # of a process at work, about
SMALLEST_BETA, LARGEST_BETA = 1e-100, 1e100  # products with rewards stay in double precision
MOST_DEEP = 4  # lists in lists, looked into
MOST_SHOWN = 500  # characters of a value
WORTH_A_LOOK = 1 << 27  # bytes from which an array must find room
REAL = "biuf"  # numpy's kinds of numbers that a double can hold

Shape = tuple[int | str, ...]
Entries = tuple[Callable[[np.ndarray], np.ndarray], str]  # which are usable, and how that is said
FINITE: Entries = (np.isfinite, "finite")
NOT_NEGATIVE: Entries = (lambda x: np.isfinite(x) & (x >= 0), "finite and >= 0")


class InputError(ValueError):
    """A value that was handed in is unusable. ``str`` is one line: key, value, what is allowed.

    Attributes: ``key`` (dotted name), ``value``, ``allowed`` (free text that completes "must be ...").
    """

    def __init__(self, key: str, value: Any, allowed: str) -> None:
        super().__init__(key, value, allowed)
        self.key, self.value, self.allowed = key, value, allowed

    def __str__(self) -> str:
        return " ".join(f"{self.key}={_shown(self.value)}: must be {self.allowed}".split())

    def within(self, group: str) -> InputError:
        """The same complaint with ``group.`` before the key."""
        return InputError(f"{group}.{self.key}", self.value, self.allowed)

    def of_file(self, path: Any) -> InputError:
        """The same complaint about what is in a file."""
        return InputError(f"path={path}: {self.key}", self.value, self.allowed)


# -- one number -----------------------------------------------------------------------------------------


def is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def number(key: str, value: Any, fits: Callable[[float], bool], allowed: str) -> float:
    """``value``, Python's or numpy's, as a float. Raises InputError unless it is a number that ``fits``."""
    value = _python(value)
    try:
        found = float(value) if is_number(value) else math.nan
    except OverflowError:
        found = math.inf if value > 0 else -math.inf
    if not (is_number(value) and fits(found)):
        raise InputError(key, value, allowed)
    return found


def positive(key: str, value: Any) -> float:
    """``value`` as a float. Raises InputError unless it is a finite number > 0."""
    return number(key, value, lambda x: 0 < x < math.inf, "a finite number > 0")


def temperature(key: str, value: Any) -> float:
    """``value`` as a float. Raises InputError unless it is an inverse temperature that leaves products in double
    precision."""
    found = positive(key, value)
    return number(key, found, lambda x: SMALLEST_BETA <= x <= LARGEST_BETA, f"in [{SMALLEST_BETA:g}, {LARGEST_BETA:g}]")


def step_size(key: str, value: Any) -> float:
    """``value`` as a float. Raises InputError unless it lies in (0, 1]."""
    return number(key, value, lambda x: 0 < x <= 1, "a number in (0, 1]")


def at_least(key: str, value: Any, least: int) -> int:
    """``value`` as an int. Raises InputError unless it is one, Python's or numpy's, in [``least``, 2**63)."""
    value = _python(value)
    if not isinstance(value, int) or isinstance(value, bool) or value < least:
        raise InputError(key, value, f"a whole number >= {least}")
    if value > MOST:
        raise InputError(key, value, "below 2**63")
    return value


def plain(settings: Any) -> None:
    """Numbers of numpy's among the fields of a frozen dataclass become Python's (with those of single precision,
    arithmetic would be of single precision), and whole numbers floats where the field is one (each type of argument is
    compiled for anew). Raises InputError for a field of truth values that holds another."""
    for item in fields(settings):
        value = _python(getattr(settings, item.name))
        if item.type == "bool":
            value = flag(item.name, value)
        if str(item.type).startswith("float") and is_number(value):
            try:
                value = float(value)
            except OverflowError:  # refused where it is looked at
                value = math.inf
        object.__setattr__(settings, item.name, value)


def _python(value: Any) -> Any:
    return value.item() if isinstance(value, (np.integer, np.floating)) else value


def seed(key: str, value: Any) -> int | np.random.Generator:
    """``value``, as an int unless it is a generator. Raises InputError unless it is one, or a whole number >= 0."""
    return value if isinstance(value, np.random.Generator) else at_least(key, value, 0)


def workers(key: str, value: Any) -> int:
    """``value`` as an int. Raises InputError unless a system can start so many threads or processes."""
    found = at_least(key, value, 1)
    if found > MOST_WORKERS:
        raise InputError(key, found, f"at most {MOST_WORKERS}")
    return found


def processes(key: str, value: int) -> None:
    """Raise InputError unless ``value`` processes, each with torch and what it compiles, find room."""
    memory(key, value, PROCESS_BYTES * (value if value > 1 else 0), "so many processes")


def memory(key: str, value: Any, needed: int, what: str) -> None:
    """Raise InputError unless ``needed`` bytes, for ``what``, are free: asked before they are allocated.

    A system that promises more memory than it has ends the process when the memory is used, which nothing survives.
    """
    free = free_memory()
    if needed > free:
        allowed = f"smaller: {what} needs {_gigabytes(needed)} of memory, and {_gigabytes(free)} are free"
        raise InputError(key, value, allowed)


def disk(key: str, value: Any, needed: int, what: str, path: str) -> None:
    """Raise InputError unless ``needed`` bytes, for ``what``, are free where ``path`` is, or will be."""
    place = Path(path).absolute()
    while not place.exists():
        place = place.parent
    free = shutil.disk_usage(place).free
    if needed > free:
        allowed = f"smaller: {what} needs {_gigabytes(needed)} of disk, and {_gigabytes(free)} are free at {place}"
        raise InputError(key, value, allowed)


def free_memory() -> float:
    """Bytes that this process can still get, as far as the system tells: machine, control group, own limit."""
    found = [math.inf]
    facts = _numbers("/proc/meminfo")
    if "MemAvailable:" in facts:
        found.append(1024 * facts["MemAvailable:"])
    elif hasattr(os, "sysconf") and "SC_PHYS_PAGES" in os.sysconf_names:
        found.append(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    for limit, used, cache in (
        ("memory.max", "memory.current", "inactive_file"),
        ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes", "total_inactive_file"),
    ):
        group = Path("/sys/fs/cgroup")
        try:
            most, now = (int((group / name).read_text()) for name in (limit, used))
        except (OSError, ValueError):  # no such group, or no limit ("max")
            continue
        found.append(most - now + _numbers(str((group / limit).with_name("memory.stat"))).get(cache, 0))
    try:
        import resource

        soft = resource.getrlimit(resource.RLIMIT_AS)[0]
        if soft != resource.RLIM_INFINITY:
            pages = int(Path("/proc/self/statm").read_text().split()[0])
            found.append(soft - pages * resource.getpagesize())
    except (ImportError, OSError):
        pass
    return max(0, min(found))


def out_of_memory(error: BaseException | None) -> bool:
    """Whether ``error`` says that memory could not be had; torch has no class of its own for it."""
    said = str(error).lower()
    return isinstance(error, MemoryError) or (
        isinstance(error, RuntimeError)
        and any(words in said for words in ("can't allocate memory", "out of memory", "not enough memory"))
    )


def _gigabytes(n: float) -> str:
    return f"{n / 1e9:.3g} GB" if n < 1e300 else "more than 1e291 GB"  # beyond double precision too


def _numbers(path: str) -> dict[str, int]:
    """A file of lines that begin with a name and a whole number; nothing where there is none."""
    try:
        rows = [line.split() for line in Path(path).read_text().splitlines()]
    except OSError:
        return {}
    return {row[0]: int(row[1]) for row in rows if len(row) > 1 and row[1].isdigit()}


def _shown(value: Any) -> str:
    """``value``, of a length to be read; Python writes no number of more than 4,300 digits."""
    if isinstance(value, int) and not isinstance(value, bool) and abs(value) > 10**30:
        return f"{'-' * (value < 0)}1e{math.log10(abs(value)):.0f}"
    text = str(value)
    return text if len(text) <= MOST_SHOWN else f"{text[:MOST_SHOWN]}..."


# -- one of a kind --------------------------------------------------------------------------------------


def one_of(key: str, value: Any, allowed: tuple[str, ...]) -> None:
    """Raise InputError unless ``value`` is one of ``allowed``."""
    if not isinstance(value, str) or value not in allowed:
        raise InputError(key, value, " or ".join(allowed))


def flag(key: str, value: Any) -> bool:
    """``value`` as a bool. Raises InputError unless it is one."""
    instance(key, value, (bool, np.bool_), "True or False")
    return bool(value)


def sequence(key: str, value: Any) -> tuple[Any, ...]:
    """``value`` as a tuple. Raises InputError unless it is a list, an array or the like."""
    try:
        return tuple(value)
    except (TypeError, RuntimeError) as error:
        raise InputError(key, f"{_shown(value)} ({type(value).__name__})", "a list") from error


def instance(key: str, value: Any, kind: type | tuple[type, ...], allowed: str) -> None:
    """Raise InputError unless ``value`` is of a class of ``kind``, which ``allowed`` describes."""
    if not isinstance(value, kind):
        raise InputError(key, f"{_shown(value)} ({type(value).__name__})", allowed)


def device(key: str, value: Any) -> None:
    """Raise InputError unless torch can put a tensor on ``value``."""
    import torch

    try:
        torch.empty(0, device=torch.device(value))
    except (RuntimeError, AssertionError, NotImplementedError, TypeError, ValueError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(key, value, f"a device that is present, as cpu ({reason[:120]})") from error


# -- arrays ---------------------------------------------------------------------------------------------


def array(key: str, value: Any, shape: Shape, entries: Entries = FINITE) -> np.ndarray:
    """``value`` as a new float64 array of ``shape`` (sizes, or names of sizes above 0; one name, one size).

    Raises InputError: not an array of real numbers (numpy's, torch's, scipy's, or lists), another shape, an entry that
    is not usable (it is named), or no room for it.
    """
    found = real(key, value)
    _check_shape(key, found.shape, shape)
    room(key, found.shape)
    with np.errstate(over="ignore"):  # of extended precision; the entry is refused below
        found = np.array(found, np.float64, order="C")
    usable, allowed = entries
    good = usable(found)
    if not good.all():
        first = tuple(int(i) for i in np.argwhere(~good)[0])
        raise InputError(f"{key}{list(first)}" if first else key, found[first], allowed)
    return found


def real(key: str, value: Any) -> np.ndarray:
    """``value`` as an array of real numbers, of its own type and shape; not copied where it is one.

    Raises InputError: text, dates, complex numbers, masked entries, tensors without data, and whatever else is no array
    of real numbers, or finds no room.
    """
    if is_sparse(value):
        whole = tuple(value.shape)
        room(key, whole)
        value = _tensor(key, value).to_dense() if hasattr(value, "detach") else sparse(key, value, whole).toarray()
    if hasattr(value, "detach"):
        value = _tensor(key, value).numpy()
    if isinstance(value, Sequence):
        room(key, _lengths(value))
    if _masked(value):
        raise InputError(key, "an array with masked entries", "an array without")
    try:
        found = np.asarray(value)
        if found.dtype.kind == "O" and found.size and all(isinstance(x, numbers.Real) for x in found.flat):
            found = found.astype(np.float64)
    except (TypeError, ValueError, OverflowError, RuntimeError) as error:  # ragged lists, for one
        raise InputError(key, type(value).__name__, "an array of real numbers") from error
    if found.dtype.kind not in REAL and not (found.dtype.kind == "O" and found.size == 0):
        raise InputError(key, _described(value, found.dtype), "an array of real numbers")
    return found


def sparse(key: str, value: Any, shape: Shape, more: str = "") -> sp.csr_array:
    """``value`` [m, n], sparse (scipy's or torch's) or not, as a new float64 CSR matrix, sorted, without zeros and
    without repeated entries, which are summed. Its entries may be infinite, or NaN.

    Raises InputError: as ``array``, and an index out of range; ``more`` completes the complaint about the shape.
    """
    import scipy.sparse as sp

    if not is_sparse(value) or (hasattr(value, "detach") and value.dense_dim() > 0):
        value = real(key, value)
    _check_shape(key, tuple(value.shape), shape, more)
    try:
        if hasattr(value, "detach"):
            value = _tensor(key, value).coalesce()
            value = sp.coo_array((value.values().numpy(), tuple(value.indices().numpy())), shape=tuple(value.shape))
        if value.dtype.kind not in REAL:
            raise InputError(key, _described(value, value.dtype), "a matrix of real numbers")
        if not sp.issparse(value):
            room(key, value.shape)
        # Before anything is converted: conversions and compiled loops trust the indices.
        elif hasattr(value, "check_format"):
            value.check_format(full_check=True)
        elif value.format == "coo":
            value = sp.coo_array((value.data, value.coords), shape=value.shape)
        with np.errstate(over="ignore"):
            csr = sp.csr_array(value, dtype=np.float64, copy=True)
        csr.check_format(full_check=True)
    except InputError:
        raise
    except (ValueError, TypeError, IndexError) as error:
        raise InputError(key, "sparse matrix", f"one with indices in range ({error})") from error
    csr.sum_duplicates()
    csr.eliminate_zeros()
    return csr


def is_sparse(value: Any) -> bool:
    """Whether ``value`` is a sparse matrix of scipy's or a sparse tensor of torch's."""
    if hasattr(value, "detach") and hasattr(value, "layout"):
        return "strided" not in str(value.layout)
    import scipy.sparse as sp

    return bool(sp.issparse(value))


def _lengths(value: Sequence[Any]) -> tuple[int, ...]:
    """Of a list and of what comes first in it, and so on: the shape of an array, before it is made."""
    found: list[int] = []
    while isinstance(value, Sequence) and not isinstance(value, str) and len(found) < MOST_DEEP:
        try:
            found.append(len(value))
        except OverflowError:  # of a range
            found.append(MOST)
        if not found[-1]:
            break
        value = value[0]
    return tuple(found)


def _masked(value: Any, depth: int = 0) -> bool:
    """Whether an array, or one in a list, has masked entries: numpy would go on with what is behind the mask."""
    if isinstance(value, (list, tuple)):
        return depth < MOST_DEEP and any(_masked(item, depth + 1) for item in value)
    return isinstance(value, np.ma.MaskedArray) and bool(np.ma.is_masked(value))


def _tensor(key: str, value: Any) -> Any:
    """A tensor on the CPU, in double precision where it is of floats, with strides or as COO with indices in range."""
    import torch

    if value.is_complex() or value.is_nested:
        raise InputError(key, _described(value, value.dtype), "an array of real numbers")
    if not is_sparse(value):
        room(key, tuple(value.shape))
    try:
        value = value.detach().cpu()
        if value.is_quantized:
            value = value.dequantize()
        if value.layout is torch.sparse_coo:
            parts = (value._indices(), value._values())
            value = torch.sparse_coo_tensor(*parts, value.shape, check_invariants=True)
        elif value.layout is not torch.strided:  # torch does not look at these indices by itself
            by_row = value.layout in (torch.sparse_csr, torch.sparse_bsr)
            parts = (
                (value.crow_indices(), value.col_indices()) if by_row else (value.ccol_indices(), value.row_indices())
            )
            torch.sparse_compressed_tensor(
                *parts, value.values(), value.shape, layout=value.layout, check_invariants=True
            )
            value = value.to_sparse_coo()
        return value.to(torch.float64) if value.is_floating_point() else value  # numpy has no bfloat16
    except (RuntimeError, ValueError, TypeError, NotImplementedError, AttributeError) as error:
        if out_of_memory(error):
            raise
        said = str(error).splitlines()[0][:120] if str(error) else type(error).__name__
        what = "a tensor with data, and with indices in range where it is sparse"
        raise InputError(key, _described(value, value.dtype), f"{what} ({said})") from error


def _described(value: Any, dtype: Any) -> str:
    return f"{type(value).__name__} of dtype {dtype}" if value is not None else "None"


def _check_shape(key: str, found: tuple[int, ...], shape: Shape, more: str = "") -> None:
    known: dict[str, int] = {}
    good = len(found) == len(shape) and all(
        n == wanted if isinstance(wanted, int) else 0 < n == known.setdefault(wanted, n)
        for n, wanted in zip(found, shape, strict=True)
    )
    if not good:
        raise InputError(key, f"array of shape {found}", f"of shape [{', '.join(map(str, shape))}]{more}")


def room(key: str, shape: tuple[int, ...]) -> None:
    """Raise InputError unless an array of this shape finds room, before it is made."""
    needed = 8 * math.prod(shape)
    if needed > WORTH_A_LOOK:
        memory(key, f"array of shape {shape}", needed, "in double precision it")
