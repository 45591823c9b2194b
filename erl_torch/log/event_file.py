"""One TensorBoard event file, written record by record, that can be cut and gone on with.

Going on after a crash, the file is cut to what it held at the checkpoint and written on: no step is missing or there
twice, and a run has one file, however often it was killed.
"""

from __future__ import annotations

import fnmatch
import os
import socket
import struct
import sys
import time
from pathlib import Path

from tensorboard.compat.proto.event_pb2 import Event
from tensorboard.compat.proto.summary_pb2 import Summary
from tensorboard.summary.writer.record_writer import RecordWriter

from erl_torch.checks import InputError

PATTERN = "events.out.tfevents.*"
HEAD, TAIL = 12, 4  # bytes about a record: its length with a checksum, and the checksum of its content

Mark = tuple[str, int]  # of a file at some moment: its name and its size in bytes


class EventFile:
    """The event file of a run directory.

    Args:
        directory: made if it is missing.
        mark: as ``mark`` gave it, to go on from there; None begins a file beside those that are there. Of a file that
            has become shorter the whole records are kept, and one that is gone is begun, with a warning.

    Raises:
        InputError: a mark of a file that is none of TensorBoard's in ``directory``.

    ``fresh`` is whether the file has been begun.
    """

    def __init__(self, directory: str | os.PathLike[str], mark: Mark | None = None) -> None:
        directory = Path(directory)
        directory.mkdir(parents=True, exist_ok=True)
        name, size = mark or (f"events.out.tfevents.{int(time.time())}.{socket.gethostname()}.{os.getpid()}", 0)
        if Path(name).name != name or not fnmatch.fnmatchcase(name, PATTERN):
            raise InputError("checkpoint: event file", name, f"of a name like {PATTERN}")  # it would be cut
        path = directory / name
        kept = size
        if mark is not None:
            there = path.stat().st_size if path.is_file() else 0
            kept = size if there >= size else _whole_records(path)
            if kept < size:
                print(
                    f"warning: {path} has lost what it held at the checkpoint: records of before are missing",
                    file=sys.stderr,
                )
            if there:
                os.truncate(path, kept)
        self.name, self.fresh = name, not kept
        self._file = open(path, "ab")  # noqa: SIM115 (closed by close)
        self._records = RecordWriter(self._file)
        if self.fresh:
            self._write(Event(wall_time=time.time(), file_version="brain.Event:2"))

    def add(self, summary: Summary, step: int = 0) -> None:
        """Write one record of a summary, as ``torch.utils.tensorboard.summary`` makes them."""
        self._write(Event(wall_time=time.time(), step=step, summary=summary))

    def mark(self) -> Mark:
        """Where the file can be gone on with, once it is flushed."""
        return self.name, self._file.tell()

    def flush(self) -> Mark:
        """Hand everything to the system; the mark."""
        self._records.flush()
        return self.mark()

    def close(self) -> None:
        self._records.close()

    def _write(self, event: Event) -> None:
        self._records.write(event.SerializeToString())


def _whole_records(path: Path) -> int:
    """Bytes of the records at the front of ``path`` that are there to their ends; 0 without the file."""
    kept = 0
    if path.is_file():
        size = path.stat().st_size
        with open(path, "rb") as file:
            while len(head := file.read(HEAD)) == HEAD:
                end = kept + HEAD + struct.unpack_from("<Q", head)[0] + TAIL
                if end > size:
                    break
                kept = end
                file.seek(kept)
    return kept
