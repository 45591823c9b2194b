"""Standard output and standard error that a run outlives: a reader that goes away, a full disk, a closed descriptor."""

from __future__ import annotations

import contextlib
import errno
import os
import sys
from typing import Any


class Lasting:
    """A text stream whose loss is no error: what cannot be written is dropped, and so is all that follows.

    ``broken`` is the reason, once it is lost. All else is the stream's own.
    """

    def __init__(self, stream: Any) -> None:
        self._stream, self.broken = stream, ""

    def write(self, text: str) -> int:
        self._attempt(lambda: self._stream.write(text))
        return len(text)

    def flush(self) -> None:
        self._attempt(self._stream.flush)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def _attempt(self, call: Any) -> None:
        try:
            call()
        except BlockingIOError:
            pass  # a pipe that is full just now: this text is lost, the next may not be
        except (OSError, RuntimeError, ValueError) as error:  # a signal's handler writes inside a write; it is closed
            if isinstance(error, OSError):
                self._lose(error)

    def _lose(self, error: OSError) -> None:
        if self.broken:
            return
        self.broken = error.strerror or str(error)
        with contextlib.suppress(OSError, ValueError):  # what is still in its buffer goes nowhere, at exit too
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self._stream.fileno())
            os.close(nowhere)
        if error.errno != errno.EPIPE and self is sys.stdout:
            print(f"warning: standard output is lost ({self.broken}): going on without it", file=sys.stderr)


def lasting() -> None:
    """Make the process's own output last. Harmless when repeated.

    Descriptors 0 to 2 that are closed are opened on nothing: the next file would get their number, and the words of
    whoever writes there.
    """
    for descriptor in (0, 1, 2):
        try:
            os.fstat(descriptor)
        except OSError:
            # The lowest that is free: this one.
            os.open(os.devnull, os.O_RDONLY if descriptor == 0 else os.O_WRONLY)
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:  # it was closed when Python started
            stream = open(os.devnull, "w")  # noqa: SIM115 (open as long as the process)
        if not isinstance(stream, Lasting):
            if hasattr(stream, "reconfigure"):  # names that its encoding lacks are shown all the same
                stream.reconfigure(errors="backslashreplace")
            setattr(sys, name, Lasting(stream))
