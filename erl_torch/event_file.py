"""One TensorBoard event file, written record by record, that can be cut and gone on with.

Going on after a crash, the file is cut to what it held at the checkpoint and written on: no step is missing or there
twice, and a run has one file, however often it was killed.
"""

from __future__ import annotations

import os
import socket
import time
from pathlib import Path
from typing import Any

from tensorboard.compat.proto.event_pb2 import Event
from tensorboard.summary.writer.record_writer import RecordWriter

PATTERN = "events.out.tfevents.*"


class EventFile:
    """The event file of a run directory.

    Args:
        directory: made if it is missing.
        size: bytes to keep of the file that is there; 0 begins anew.
    """

    def __init__(self, directory: str | os.PathLike[str], size: int = 0) -> None:
        directory = Path(directory)
        directory.mkdir(parents=True, exist_ok=True)
        before = sorted(directory.glob(PATTERN))
        if size and before and before[0].stat().st_size >= size:
            path = before[0]
            os.truncate(path, size)
        else:
            size = 0
            for path in before:
                path.unlink()
            path = directory / f"events.out.tfevents.{int(time.time())}.{socket.gethostname()}.{os.getpid()}"
        self._file = open(path, "ab")  # noqa: SIM115 (closed by close)
        self._records = RecordWriter(self._file)
        if not size:
            self._write(Event(wall_time=time.time(), file_version="brain.Event:2"))

    def add(self, summary: Any, step: int = 0) -> None:
        """One record of a summary, as ``torch.utils.tensorboard.summary`` makes them."""
        self._write(Event(wall_time=time.time(), step=step, summary=summary))

    def flush(self) -> int:
        """Hand everything to the system; the size of the file."""
        self._records.flush()
        return self._file.tell()

    def close(self) -> None:
        self._records.close()

    def _write(self, event: Event) -> None:
        self._records.write(event.SerializeToString())
