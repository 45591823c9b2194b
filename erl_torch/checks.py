"""One kind of error for bad input: it names the key, the value, and what is allowed."""

from __future__ import annotations

import math
from typing import Any

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
    """Raise InputError unless ``value`` is a whole number >= ``least``."""
    if isinstance(value, bool) or int(value) != value or value < least:
        raise InputError(key, value, f"a whole number >= {least}")


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
