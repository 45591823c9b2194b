"""Notes: what a reader of the results should know, where nothing is wrong enough to stop.

In Python a note is a warning of class ``Note``. A run prints each once, ``note: ...`` on standard error, and keeps
them for ``result.json``.
"""

from __future__ import annotations

import contextlib
import sys
import warnings
from collections.abc import Iterator
from typing import Any


class Note(UserWarning):
    """The results hold, with the reservation that the text names."""


def note(text: str) -> None:
    """Say ``text`` (one line) to whoever asked for the results."""
    warnings.warn(" ".join(text.split()), Note, stacklevel=3)


@contextlib.contextmanager
def collected() -> Iterator[list[str]]:
    """The notes given inside, in order and each once, printed as they come."""
    found: list[str] = []
    with warnings.catch_warnings():
        warnings.simplefilter("always", Note)
        otherwise = warnings.showwarning

        def show(message: Warning | str, category: type[Warning], *where: Any, **more: Any) -> None:
            if not issubclass(category, Note):
                otherwise(message, category, *where, **more)
            elif str(message) not in found:
                found.append(str(message))
                print(f"note: {message}", file=sys.stderr)

        warnings.showwarning = show
        yield found
