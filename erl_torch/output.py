"""Let a run outlive its standard output and error: a reader that goes away, a full disk, a closed descriptor."""

from __future__ import annotations

import contextlib
import errno
import os
import sys
from collections.abc import Callable
from typing import Any, TextIO


class Lasting:
    """A text stream whose loss is no error: text that cannot be written is dropped, and so is all that follows.

    ``broken`` is the reason of the loss, "" before. Any other attribute is that of the wrapped stream.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream, self.broken = stream, ""

    def write(self, text: str) -> int:
        self._attempt(lambda: self._stream.write(text))
        return len(text)

    def flush(self) -> None:
        self._attempt(self._stream.flush)

    def __getattr__(self, name: str) -> Any:  # of whatever type the wrapped stream's attribute has
        return getattr(self._stream, name)

    def _attempt(self, call: Callable[[], object]) -> None:
        try:
            call()
        except BlockingIOError:
            pass  # the pipe is full just now: this text is lost, the next one may not be
        except OSError as error:
            self._lose(error)
        except (RuntimeError, ValueError):
            pass  # a signal handler writes during a write, or the stream is closed

    def _lose(self, error: OSError) -> None:
        if self.broken:
            return
        self.broken = error.strerror or str(error)
        with contextlib.suppress(OSError, ValueError):  # the text that is still in its buffer, at exit too, is dropped
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self._stream.fileno())
            os.close(nowhere)
        if error.errno != errno.EPIPE and self is sys.stdout:
            print(f"warning: standard output is lost ({self.broken}): going on without it", file=sys.stderr)


def lasting() -> None:
    """Make the output of this process last. Harmless when repeated.

    Descriptors 0 to 2 that are closed are opened on the null device. Otherwise the next file would get their number,
    and with it whatever is written to standard output.
    """
    for descriptor in (0, 1, 2):
        try:
            os.fstat(descriptor)
        except OSError:
            # The system gives the lowest free number: this one.
            os.open(os.devnull, os.O_RDONLY if descriptor == 0 else os.O_WRONLY)
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:  # closed when Python started
            stream = open(os.devnull, "w")  # noqa: SIM115 (open as long as the process)
        if not isinstance(stream, Lasting):
            if hasattr(stream, "reconfigure"):  # characters that its encoding lacks are written as escapes
                stream.reconfigure(errors="backslashreplace")
            setattr(sys, name, Lasting(stream))
