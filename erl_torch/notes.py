"""Notes: what a reader of the results should know, where nothing is wrong enough to stop.

In Python a note is a warning of class ``Note``. A run prints each once, ``note: ...`` on standard error, and keeps
them for ``result.json``.
"""

from __future__ import annotations

import contextlib
import os
import sys
import warnings
from collections.abc import Iterator
from typing import Any

PACKAGE = os.path.dirname(__file__) + os.sep


class Note(UserWarning):
    """The results hold, with the reservation that the text names."""


def note(text: str) -> None:
    """Say ``text`` (one line) to whoever asked for the results: the warning is of the line that called the package."""
    level, frame = 1, sys._getframe()
    while frame.f_back is not None and (
        frame.f_code.co_filename.startswith((PACKAGE, "<string>"))
    ):  # or its dataclasses
        level, frame = level + 1, frame.f_back
    warnings.warn(" ".join(text.split()), Note, stacklevel=level)


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
