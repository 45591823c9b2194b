"""What a file format is: ``Format``, and what its reader returns."""

from __future__ import annotations

import contextlib
import importlib
from collections.abc import Iterator, Mapping
from types import ModuleType
from typing import Any, NamedTuple, Protocol

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike

from erl_torch.checks import InputError
from erl_torch.labels import Labels

Batch = dict[str, np.ndarray]
"""Columns s, a, r, s_next, a_next, and weight where there are weights, of one length, of any type of numbers; they are
checked and converted elsewhere."""


class Options(NamedTuple):
    """What a format may need beside the path, to make tuples of what is recorded."""

    n_states: int
    n_actions: int
    env: gym.Env[Any, Any] | None = None  # has the bins where recorded spaces are Box
    prior_policy: ArrayLike | None = None  # [S, A], behind a'; None is uniform
    on_prior: bool = False  # the behaviour policy was the prior
    seed: int = 0  # of a' where it is drawn
    columns: Mapping[str, Any] | None = None  # of a table: names by role (erl_torch.experience.formats.rows)
    state_labels: Labels | None = None  # of the recorded states; None: they are numbers
    action_labels: Labels | None = None


ALLOWED = "there: a CSV, Parquet, JSON-lines or npz file, a directory of such parts or of columns, or minari:DATASET"


class Reader(Protocol):
    """A file that can be read again and again."""

    path: str
    short: int  # rows that some column lacks; known once a pass has begun

    def batches(self, rows: int, strict: bool) -> Iterator[Batch]:
        """Make one pass, in order.

        Args:
            rows: about so many rows at a time, >= 1.
            strict: columns of unequal length are an error; else rows that are not in all columns are left out.

        Raises:
            InputError: a file that cannot be read; it names the path.
        """


class Format(Protocol):
    """A file format: a module with these two functions, or any object with them."""

    def claims(self, path: str) -> bool:
        """Whether ``path`` is of this format, by its name or kind; what is in it is not looked at."""

    def reader(self, path: str, options: Options) -> Reader:
        """Make the reader of ``path``, which is claimed. Raises InputError."""


@contextlib.contextmanager
def readable(path: str, what: str) -> Iterator[None]:
    """Turn whatever a library raises of a damaged file into one InputError: ``path`` must be a readable ``what``."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:  # a dozen kinds, zlib's and struct's among them
        cause = f"{error.strerror}" if isinstance(error, OSError) and error.strerror else f"{error}"
        raise InputError("path", path, f"a readable {what} ({cause or type(error).__name__})") from error


def plugin(module: str, path: str, extra: str) -> ModuleType:
    """Import a library that the package does without. Raises InputError that names the ``extra`` to install."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise InputError("path", path, f"read with what `pip install erl_torch[{extra}]` installs ({error})") from error
