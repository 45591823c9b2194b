"""Experience: a stream of tuples (s, a, r, s', a'), stored as five columns."""

from __future__ import annotations

import os
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from erl_torch.checks import InputError
from erl_torch.files import read_npz, write_npz


@dataclass(frozen=True, eq=False)
class Transitions:
    """A stream of tuples, in the order in which they are learnt from.

    ``a_next`` is the action a' ~ prior(.|s') that the sampled backup of Algorithm S1 uses; it need not be
    the action taken next.

    Args:
        s, a, s_next, a_next: whole numbers >= 0, [N].
        r: finite rewards, [N].

    Raises:
        InputError: the column (and row) that is not as above.
    """

    s: np.ndarray  # [N] int32
    a: np.ndarray  # [N] int32
    r: np.ndarray  # [N] float64
    s_next: np.ndarray  # [N] int32
    a_next: np.ndarray  # [N] int32

    def __post_init__(self) -> None:
        for field in fields(self):
            object.__setattr__(self, field.name, _column(field.name, getattr(self, field.name)))
        for field in fields(self):
            if len(getattr(self, field.name)) != len(self.s):
                lengths = {f.name: len(getattr(self, f.name)) for f in fields(self)}
                raise InputError("columns", f"lengths {lengths}", "of one length")
        if len(self) == 0:
            raise InputError("transitions", "0 tuples", "at least one tuple")

    def __len__(self) -> int:
        return len(self.s)

    def first(self, n: int) -> Transitions:
        """The first ``n`` tuples."""
        return Transitions(*(getattr(self, field.name)[:n] for field in fields(self)))

    def check_range(self, n_states: int, n_actions: int) -> None:
        """Raise InputError naming the first tuple with a state or action out of range."""
        for name, bound in (("s", n_states), ("a", n_actions), ("s_next", n_states), ("a_next", n_actions)):
            column = getattr(self, name)
            if column.max() >= bound:
                row = int(np.argmax(column >= bound))
                raise InputError(f"{name}[{row}]", int(column[row]), f"below {bound}")

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the columns to a compressed npz file (temporary name, then renamed)."""
        return write_npz(path, {field.name: getattr(self, field.name) for field in fields(self)})

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Transitions:
        """Read what ``save`` wrote, or any npz with these five columns; further arrays are passed over.

        Raises InputError naming the file.
        """
        arrays = read_npz(path)
        names = [field.name for field in fields(cls)]
        missing = [name for name in names if name not in arrays]
        if missing:
            raise InputError("path", path, f"an npz with columns {', '.join(names)}; it lacks {missing[0]}")
        try:
            return cls(**{name: arrays[name] for name in names})
        except InputError as error:
            raise InputError(f"{path}: {error.key}", error.value, error.allowed) from error


def _column(name: str, value: Any) -> np.ndarray:
    if hasattr(value, "detach"):
        value = value.detach().cpu().numpy()
    column = np.asarray(value)
    if column.ndim != 1:
        raise InputError(name, f"array of shape {column.shape}", "one-dimensional")
    if name == "r":
        if column.dtype.kind not in "iuf":
            raise InputError(name, f"dtype {column.dtype}", "an array of numbers")
        column = np.ascontiguousarray(column, dtype=np.float64)
        if not np.isfinite(column).all():
            row = int(np.argmin(np.isfinite(column)))
            raise InputError(f"r[{row}]", column[row], "finite")
        return column
    if column.dtype.kind not in "iu" and column.size:
        raise InputError(name, f"dtype {column.dtype}", "an array of whole numbers")
    if column.size and (column.min() < 0 or column.max() > np.iinfo(np.int32).max):
        row = int(np.argmax((column < 0) | (column > np.iinfo(np.int32).max)))
        raise InputError(f"{name}[{row}]", int(column[row]), "a whole number in [0, 2**31)")
    return np.ascontiguousarray(column, dtype=np.int32)
