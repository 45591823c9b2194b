"""Notes: what a reader of the results should know, where nothing is so wrong that the run must stop.

In Python a note is a warning of class ``Note``. A run prints each once, ``note: ...`` on standard error, and keeps
them for ``result.json``.
"""

from __future__ import annotations

import contextlib
import os
import sys
import warnings
from collections.abc import Iterator
from typing import TextIO

PACKAGE = os.path.dirname(__file__) + os.sep


class Note(UserWarning):
    """The results hold, with the reservation that the text names."""


def note(text: str) -> None:
    """Give the note ``text``, one line. The warning names the line of the caller's program that called the package."""
    level, frame = 1, sys._getframe()
    # "<string>" is the code that dataclasses generate.
    while frame.f_back is not None and frame.f_code.co_filename.startswith((PACKAGE, "<string>")):
        level, frame = level + 1, frame.f_back
    warnings.warn(" ".join(text.split()), Note, stacklevel=level)


@contextlib.contextmanager
def collected(print_them: bool = True) -> Iterator[list[str]]:
    """Collect the notes given inside the block, in order and without repetition; print each as it comes, if asked."""
    notes: list[str] = []
    with warnings.catch_warnings():
        warnings.simplefilter("always", Note)
        show_other = warnings.showwarning

        def show(
            message: Warning | str,
            category: type[Warning],
            filename: str,
            lineno: int,
            file: TextIO | None = None,
            line: str | None = None,
        ) -> None:
            if not issubclass(category, Note):
                show_other(message, category, filename, lineno, file, line)
            elif str(message) not in notes:
                notes.append(str(message))
                if print_them:
                    print(f"note: {message}", file=sys.stderr)

        warnings.showwarning = show
        yield notes
