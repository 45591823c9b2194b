"""One kind of error for bad input: it names the key, the value, and what is allowed."""

from __future__ import annotations

import math
import numbers
import os
import re
import shutil
from collections.abc import Callable, Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeGuard

import numpy as np

from erl_torch.guesses import did_you_mean

if TYPE_CHECKING:
    import scipy.sparse as sp
    import torch
    from _typeshed import DataclassInstance

LARGEST_INTEGER = 2**63 - 1  # compiled loops and files count in 64 bits
MOST_WORKERS = 1024  # threads or processes at once; systems allow a few thousand
PROCESS_BYTES = 250_000_000  # about what one process takes
SMALLEST_BETA, LARGEST_BETA = 1e-100, 1e100  # products with rewards stay in double precision
DEEPEST_LIST = 4  # levels of lists in lists that are looked into
LONGEST_TEXT = 500  # characters of a value in a message
LARGE_ARRAY = 1 << 27  # bytes from which the free memory is asked for before an array is made
REAL_KINDS = "biuf"  # numpy's kinds of numbers that a double can hold

Shape = tuple[int | str, ...]
Entries = tuple[Callable[[np.ndarray], np.ndarray], str]  # a test of every entry, and its words for the message
FINITE: Entries = (np.isfinite, "finite")
NOT_NEGATIVE: Entries = (lambda x: np.isfinite(x) & (x >= 0), "finite and >= 0")


class InputError(ValueError):
    """The caller gave a value that cannot be used. ``str`` is one line: key, value, what is allowed.

    Attributes: ``key`` (dotted name), ``value``, ``allowed`` (free text that completes "must be ...").
    """

    def __init__(self, key: str, value: object, allowed: str) -> None:
        super().__init__(key, value, allowed)
        self.key, self.value, self.allowed = key, value, allowed

    def __str__(self) -> str:
        return " ".join(f"{self.key}={_text(self.value)}: must be {self.allowed}".split())

    def within(self, group: str) -> InputError:
        """The same error with ``group.`` before the key; a key that names a place ("ENV, step 3: ...") stays."""
        if re.search(r", (step \d+|reset)\b", self.key):
            return self
        return InputError(f"{group}.{self.key}", self.value, self.allowed)

    def of_file(self, path: str | os.PathLike[str]) -> InputError:
        """The same error, about the content of a file."""
        return InputError(f"path={path}: {self.key}", self.value, self.allowed)


# -- one number -----------------------------------------------------------------------------------------


def is_number(value: object) -> TypeGuard[float]:
    """Whether ``value`` is an int or a float of Python's; True and False are none."""
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def number(key: str, value: object, fits: Callable[[float], bool], allowed: str) -> float:
    """``value``, Python's or numpy's, as a float. Raises InputError unless it is a number that ``fits``."""
    value = _python(value)
    if is_number(value) and fits(_float(value)):
        return _float(value)
    raise InputError(key, value, allowed)


def finite(key: str, value: object) -> float:
    """``value`` as a float. Raises InputError unless it is a finite number."""
    return number(key, value, math.isfinite, "a finite number")


def positive(key: str, value: object) -> float:
    """``value`` as a float. Raises InputError unless it is a finite number > 0."""
    return number(key, value, lambda x: 0 < x < math.inf, "a finite number > 0")


def temperature(key: str, value: object) -> float:
    """``value`` as a float. Raises InputError unless it is an inverse temperature that leaves products in double
    precision."""
    beta = positive(key, value)
    return number(key, beta, lambda x: SMALLEST_BETA <= x <= LARGEST_BETA, f"in [{SMALLEST_BETA:g}, {LARGEST_BETA:g}]")


def optimism(key: str, value: object, beta: float) -> float:
    """``value`` as a float. Raises InputError unless it is a finite number whose product with ``beta`` is 0 or leaves
    products in double precision."""
    optimism = finite(key, value)
    kappa = abs(optimism * beta)
    if optimism and not SMALLEST_BETA <= kappa <= LARGEST_BETA:
        raise InputError(key, value, f"0, or such that |optimism * beta| is in [{SMALLEST_BETA:g}, {LARGEST_BETA:g}]")
    return optimism


def step_size(key: str, value: object) -> float:
    """``value`` as a float. Raises InputError unless it lies in (0, 1]."""
    return number(key, value, lambda x: 0 < x <= 1, "a number in (0, 1]")


def at_least(key: str, value: object, least: int) -> int:
    """``value`` as an int. Raises InputError unless it is whole, Python's or numpy's, and in [``least``, 2**63)."""
    value = _python(value)
    if not isinstance(value, int) or isinstance(value, bool) or value < least:
        raise InputError(key, value, f"a whole number >= {least}")
    if value > LARGEST_INTEGER:
        raise InputError(key, value, "below 2**63")
    return value


def plain(settings: DataclassInstance) -> None:
    """Turn the numbers of a frozen dataclass into Python's own, in place; a field of type float gets a float.

    Numpy's single precision would make all arithmetic single, and Numba compiles anew for each type of argument.
    Raises InputError for a field of type bool that holds anything else.
    """
    for field in fields(settings):
        value = _python(getattr(settings, field.name))
        if field.type == "bool":
            value = flag(field.name, value)
        if str(field.type).startswith("float") and is_number(value):
            value = _float(value)
        object.__setattr__(settings, field.name, value)


def _python(value: object) -> object:
    """A number of numpy's as Python's; anything else as it is."""
    return value.item() if isinstance(value, (np.integer, np.floating)) else value


def _float(value: float) -> float:
    """A number as a float; infinite where it is an int beyond double precision."""
    try:
        return float(value)
    except OverflowError:
        return math.inf if value > 0 else -math.inf


def seed(key: str, value: object) -> int | np.random.Generator:
    """``value``: a generator as it is, else an int. Raises InputError unless it is either, the int >= 0."""
    return value if isinstance(value, np.random.Generator) else at_least(key, value, 0)


def workers(key: str, value: object) -> int:
    """``value`` as an int. Raises InputError unless a system can start so many threads or processes."""
    n = at_least(key, value, 1)
    if n > MOST_WORKERS:
        raise InputError(key, n, f"at most {MOST_WORKERS}")
    return n


def processes(key: str, value: int) -> None:
    """Raise InputError unless there is memory for ``value`` processes, each with torch and its compiled loops."""
    memory(key, value, PROCESS_BYTES * (value if value > 1 else 0), "so many processes")


def memory(key: str, value: object, needed: int, what: str) -> None:
    """Raise InputError unless ``needed`` bytes, for ``what``, are free. Call it before they are allocated.

    A system that promises more memory than it has kills the process at the moment when it uses the memory.
    """
    free = free_memory()
    if needed > free:
        allowed = f"smaller: {what} needs {_gigabytes(needed)} of memory, and {_gigabytes(free)} are free"
        raise InputError(key, value, allowed)


def disk(key: str, value: object, needed: int, what: str, path: str) -> None:
    """Raise InputError unless the disk that holds ``path``, or will hold it, has ``needed`` bytes free for ``what``."""
    place = Path(path).absolute()
    while not place.exists():
        place = place.parent
    free = shutil.disk_usage(place).free
    if needed > free:
        allowed = f"smaller: {what} needs {_gigabytes(needed)} of disk, and {_gigabytes(free)} are free at {place}"
        raise InputError(key, value, allowed)


def free_memory() -> float:
    """Bytes that this process can still get: the least that the machine, its control group and its own limit allow."""
    allowed = [math.inf]
    machine = _numbers("/proc/meminfo")
    if "MemAvailable:" in machine:
        allowed.append(1024 * machine["MemAvailable:"])
    elif "SC_PHYS_PAGES" in os.sysconf_names:
        allowed.append(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    for limit, used, cache in (
        ("memory.max", "memory.current", "inactive_file"),
        ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes", "total_inactive_file"),
    ):
        group = Path("/sys/fs/cgroup")
        try:
            most, now = (int((group / name).read_text()) for name in (limit, used))
        except (OSError, ValueError):  # no such group, or no limit ("max")
            continue
        allowed.append(most - now + _numbers(str((group / limit).with_name("memory.stat"))).get(cache, 0))
    try:
        import resource

        soft = resource.getrlimit(resource.RLIMIT_AS)[0]
        if soft != resource.RLIM_INFINITY:
            pages = int(Path("/proc/self/statm").read_text().split()[0])
            allowed.append(soft - pages * resource.getpagesize())
    except (ImportError, OSError):
        pass
    return max(0, min(allowed))


def out_of_memory(error: BaseException | None) -> bool:
    """Whether ``error`` means that memory ran out. Torch has no class of its own for it, so the text is read."""
    text = str(error).lower()
    return isinstance(error, MemoryError) or (
        isinstance(error, RuntimeError)
        and any(words in text for words in ("can't allocate memory", "out of memory", "not enough memory"))
    )


def _gigabytes(n: float) -> str:
    return f"{n / 1e9:.3g} GB" if n < 1e300 else "more than 1e291 GB"  # beyond double precision too


def _numbers(path: str) -> dict[str, int]:
    """{name: whole number} of a file whose lines begin with the two; empty where there is no such file."""
    try:
        rows = [line.split() for line in Path(path).read_text().splitlines()]
    except OSError:
        return {}
    return {row[0]: int(row[1]) for row in rows if len(row) > 1 and row[1].isdigit()}


def _text(value: object) -> str:
    """``value`` as a text short enough to read; Python writes no number of more than 4,300 digits."""
    if isinstance(value, int) and not isinstance(value, bool) and abs(value) > 10**30:
        return f"{'-' * (value < 0)}1e{math.log10(abs(value)):.0f}"
    text = str(value)
    return text if len(text) <= LONGEST_TEXT else f"{text[:LONGEST_TEXT]}..."


# -- one of a kind --------------------------------------------------------------------------------------


def one_of(key: str, value: object, allowed: tuple[str, ...]) -> None:
    """Raise InputError unless ``value`` is one of ``allowed``."""
    if not isinstance(value, str) or value not in allowed:
        raise InputError(key, value, " or ".join(allowed) + did_you_mean(value, allowed))


def flag(key: str, value: object) -> bool:
    """``value`` as a bool. Raises InputError unless it is True or False, Python's or numpy's."""
    instance(key, value, (bool, np.bool_), "True or False")
    return bool(value)


def sequence(key: str, value: object) -> tuple[Any, ...]:
    """``value`` as a tuple. Raises InputError unless it is a list, an array or the like; bytes are none."""
    try:
        if isinstance(value, (bytes, bytearray, memoryview)):  # their entries would be numbers
            raise TypeError
        return tuple(value)  # type: ignore[arg-type]  # TypeError for what has no entries
    except (TypeError, RuntimeError) as error:
        raise InputError(key, f"{_text(value)} ({type(value).__name__})", "a list") from error


def instance(key: str, value: object, kind: type | tuple[type, ...], allowed: str) -> None:
    """Raise InputError unless ``value`` is of a class of ``kind``, which ``allowed`` describes."""
    if not isinstance(value, kind):
        raise InputError(key, f"{_text(value)} ({type(value).__name__})", allowed)


def device(key: str, value: object) -> None:
    """Raise InputError unless torch can put a tensor on the device ``value``."""
    import torch

    try:
        torch.empty(0, device=torch.device(value))  # type: ignore[call-overload]  # TypeError for what is no name
    except (RuntimeError, AssertionError, NotImplementedError, TypeError, ValueError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(key, value, f"a device that is present, as cpu ({reason[:120]})") from error


# -- arrays ---------------------------------------------------------------------------------------------


def array(key: str, value: object, shape: Shape, entries: Entries = FINITE) -> np.ndarray:
    """``value`` as a new float64 array of ``shape``: sizes, or names of sizes above 0; equal names are equal sizes.

    Raises InputError: not an array of real numbers (numpy's, torch's, scipy's, or lists), another shape, an entry that
    is not usable (the message names it), or too little memory.
    """
    table = real(key, value)
    _check_shape(key, table.shape, shape)
    room(key, table.shape)
    with np.errstate(over="ignore"):  # an entry of extended precision; the test below refuses it
        table = np.array(table, np.float64, order="C")
    usable, allowed = entries
    good = usable(table)
    if not good.all():
        first = tuple(int(i) for i in np.argwhere(~good)[0])
        raise InputError(f"{key}{list(first)}" if first else key, table[first], allowed)
    return table


def real(key: str, value: object) -> np.ndarray:
    """``value`` as an array of real numbers, of its own type and shape; an array is not copied.

    Raises InputError: text, dates, complex numbers, masked entries, tensors without data, and whatever else is no array
    of real numbers, or too little memory.
    """
    if is_sparse(value):
        whole = tuple(value.shape)
        room(key, whole)
        value = _cpu(key, value).to_dense() if _is_tensor(value) else sparse(key, value, whole).toarray()
    if _is_tensor(value):
        value = _cpu(key, value).numpy()
    if isinstance(value, Sequence):
        room(key, _lengths(value))
    if _masked(value):
        raise InputError(key, "an array with masked entries", "an array without")
    try:
        table = np.asarray(value)
        if table.dtype.kind == "O" and table.size and all(isinstance(x, numbers.Real) for x in table.flat):
            table = table.astype(np.float64)
    except (TypeError, ValueError, OverflowError, RuntimeError) as error:  # ragged lists, for one
        raise InputError(key, type(value).__name__, "an array of real numbers") from error
    if table.dtype.kind not in REAL_KINDS and not (table.dtype.kind == "O" and table.size == 0):
        raise InputError(key, _described(value, table.dtype), "an array of real numbers")
    return table


def sparse(key: str, value: object, shape: Shape, hint: str = "") -> sp.csr_array:
    """``value`` [m, n], sparse (scipy's or torch's) or dense, as a new float64 CSR matrix: sorted, without zeros,
    repeated entries summed. Its entries may be infinite, or NaN.

    Raises InputError: as ``array``, and an index out of range; ``hint`` completes the message about the shape.
    """
    import scipy.sparse as sp

    matrix: Any = value  # scipy's classes have no types
    if not is_sparse(value) or (_is_tensor(value) and value.dense_dim() > 0):
        matrix = real(key, value)
    _check_shape(key, tuple(matrix.shape), shape, hint)
    try:
        if _is_tensor(matrix):
            coo = _cpu(key, matrix).coalesce()
            matrix = sp.coo_array((coo.values().numpy(), tuple(coo.indices().numpy())), shape=tuple(coo.shape))
        if matrix.dtype.kind not in REAL_KINDS:
            raise InputError(key, _described(matrix, matrix.dtype), "a matrix of real numbers")
        if not sp.issparse(matrix):
            room(key, matrix.shape)
        # Before anything is converted: conversions and compiled loops trust the indices.
        elif hasattr(matrix, "check_format"):
            matrix.check_format(full_check=True)
        elif matrix.format == "coo":
            matrix = sp.coo_array((matrix.data, matrix.coords), shape=matrix.shape)
        with np.errstate(over="ignore"):
            csr = sp.csr_array(matrix, dtype=np.float64, copy=True)
        csr.check_format(full_check=True)
    except InputError:
        raise
    except (ValueError, TypeError, IndexError) as error:
        raise InputError(key, "sparse matrix", f"one with indices in range ({error})") from error
    csr.sum_duplicates()
    csr.eliminate_zeros()
    return csr


def is_sparse(value: object) -> TypeGuard[sp.csr_array | torch.Tensor]:
    """Whether ``value`` is a sparse matrix of scipy's or a sparse tensor of torch's."""
    if _is_tensor(value):
        return "strided" not in str(value.layout)
    import scipy.sparse as sp

    return bool(sp.issparse(value))


def _is_tensor(value: object) -> TypeGuard[torch.Tensor]:
    """Whether ``value`` is a tensor of torch's, asked without importing torch."""
    return hasattr(value, "detach") and hasattr(value, "layout")


def _lengths(value: Sequence[Any]) -> tuple[int, ...]:
    """The shape of the array that nested lists make, before it is made: lengths of the list, of its first entry, ..."""
    lengths: list[int] = []
    while isinstance(value, Sequence) and not isinstance(value, str) and len(lengths) < DEEPEST_LIST:
        try:
            lengths.append(len(value))
        except OverflowError:  # of a range
            lengths.append(LARGEST_INTEGER)
        if not lengths[-1]:
            break
        value = value[0]
    return tuple(lengths)


def _masked(value: object, depth: int = 0) -> bool:
    """Whether an array, or one in a list, has masked entries. Numpy would use the values behind the mask."""
    if isinstance(value, (list, tuple)):
        return depth < DEEPEST_LIST and any(_masked(item, depth + 1) for item in value)
    return isinstance(value, np.ma.MaskedArray) and bool(np.ma.is_masked(value))


def _cpu(key: str, value: torch.Tensor) -> torch.Tensor:
    """A tensor on the CPU, floats in double precision, strided or as COO with indices in range."""
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
        elif value.layout is not torch.strided:  # torch checks these indices only where it is asked to
            by_row = value.layout in (torch.sparse_csr, torch.sparse_bsr)
            parts = (
                (value.crow_indices(), value.col_indices()) if by_row else (value.ccol_indices(), value.row_indices())
            )
            torch.sparse_compressed_tensor(
                *parts, value.values(), value.shape, layout=value.layout, check_invariants=True
            )
            value = value.to_sparse_coo()  # type: ignore[no-untyped-call]
        return value.to(torch.float64) if value.is_floating_point() else value  # numpy has no bfloat16
    except (RuntimeError, ValueError, TypeError, NotImplementedError, AttributeError) as error:
        if out_of_memory(error):
            raise
        reason = str(error).splitlines()[0][:120] if str(error) else type(error).__name__
        allowed = "a tensor with data, and with indices in range where it is sparse"
        raise InputError(key, _described(value, value.dtype), f"{allowed} ({reason})") from error


def _described(value: object, dtype: object) -> str:
    return f"{type(value).__name__} of dtype {dtype}" if value is not None else "None"


def _check_shape(key: str, given: tuple[int, ...], shape: Shape, hint: str = "") -> None:
    sizes: dict[str, int] = {}
    good = len(given) == len(shape) and all(
        n == wanted if isinstance(wanted, int) else 0 < n == sizes.setdefault(wanted, n)
        for n, wanted in zip(given, shape, strict=True)
    )
    if not good:
        raise InputError(key, f"array of shape {given}", f"of shape [{', '.join(map(str, shape))}]{hint}")


def room(key: str, shape: tuple[int, ...]) -> None:
    """Raise InputError unless there is memory for an array of this shape. Call it before the array is made."""
    needed = 8 * math.prod(shape)
    if needed > LARGE_ARRAY:
        memory(key, f"array of shape {shape}", needed, "in double precision it")
