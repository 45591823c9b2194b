"""One kind of error for bad input: it names the key, the value, and what is allowed."""

from __future__ import annotations

import math
import os
import shutil
from pathlib import Path
from typing import Any

MOST = 2**63 - 1  # compiled loops and files count in 64 bits
MOST_WORKERS = 1024  # threads or processes at once: systems allow a few thousand
PROCESS_BYTES = 250_000_000  # of a process at work, about
SMALLEST_BETA, LARGEST_BETA = 1e-100, 1e100  # products with rewards stay in double precision


class InputError(ValueError):
    """A value that was handed in is unusable. ``str`` is one line: key, value, what is allowed.

    Attributes: ``key`` (dotted name), ``value``, ``allowed`` (free text that completes "must be ...").
    """

    def __init__(self, key: str, value: Any, allowed: str) -> None:
        super().__init__(key, value, allowed)
        self.key, self.value, self.allowed = key, value, allowed

    def __str__(self) -> str:
        return " ".join(f"{self.key}={self.value}: must be {self.allowed}".split())

    def within(self, group: str) -> InputError:
        """The same complaint with ``group.`` before the key."""
        return InputError(f"{group}.{self.key}", self.value, self.allowed)


def positive(key: str, value: float) -> None:
    """Raise InputError unless ``value`` is a finite number > 0."""
    if not (is_number(value) and math.isfinite(value) and value > 0):
        raise InputError(key, value, "a finite number > 0")


def temperature(key: str, value: float) -> None:
    """Raise InputError unless ``value`` is an inverse temperature that leaves products in double precision."""
    positive(key, value)
    if not SMALLEST_BETA <= value <= LARGEST_BETA:
        raise InputError(key, value, f"in [{SMALLEST_BETA:g}, {LARGEST_BETA:g}]")


def step_size(key: str, value: float) -> None:
    """Raise InputError unless ``value`` lies in (0, 1]."""
    if not (is_number(value) and 0 < value <= 1):
        raise InputError(key, value, "a number in (0, 1]")


def at_least(key: str, value: int, least: int) -> None:
    """Raise InputError unless ``value`` is a whole number in [``least``, 2**63)."""
    finite = isinstance(value, int) or (hasattr(value, "__float__") and math.isfinite(value))
    if isinstance(value, bool) or not (finite and int(value) == value and value >= least):
        raise InputError(key, _shown(value), f"a whole number >= {least}")
    if value > MOST:
        raise InputError(key, _shown(value), "below 2**63")


def workers(key: str, value: int) -> None:
    """Raise InputError unless ``value`` is a number of threads or processes that a system can start."""
    at_least(key, value, 1)
    if value > MOST_WORKERS:
        raise InputError(key, value, f"at most {MOST_WORKERS}")


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
        raise InputError(key, _shown(value), allowed)


def disk(key: str, value: Any, needed: int, what: str, path: str) -> None:
    """Raise InputError unless ``needed`` bytes, for ``what``, are free where ``path`` is, or will be."""
    place = Path(path).absolute()
    while not place.exists():
        place = place.parent
    free = shutil.disk_usage(place).free
    if needed > free:
        allowed = f"smaller: {what} needs {_gigabytes(needed)} of disk, and {_gigabytes(free)} are free at {place}"
        raise InputError(key, _shown(value), allowed)


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


def _shown(value: Any) -> Any:
    """``value``, of a length to be read; Python writes no number of more than 4,300 digits."""
    if isinstance(value, int) and not isinstance(value, bool) and abs(value) > 10**30:
        return f"{'-' * (value < 0)}1e{math.log10(abs(value)):.0f}"
    return value


def one_of(key: str, value: str, allowed: tuple[str, ...]) -> None:
    """Raise InputError unless ``value`` is one of ``allowed``."""
    if value not in allowed:
        raise InputError(key, value, " or ".join(allowed))


def is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def device(key: str, value: str) -> None:
    """Raise InputError unless torch can put a tensor on ``value``."""
    import torch

    try:
        torch.empty(0, device=value)
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(key, value, f"a device that is present, as cpu ({reason[:120]})") from error
