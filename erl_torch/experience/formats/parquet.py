"""Parquet files with the five columns (needs pyarrow). Missing values are bad tuples."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Protocol

import numpy as np

from erl_torch.checks import InputError
from erl_torch.experience.formats.format import Batch, Options, plugin, readable
from erl_torch.experience.transitions import COLUMNS


def claims(path: str) -> bool:
    return Path(path).suffix == ".parquet" and Path(path).is_file()


def reader(path: str, options: Options) -> Parquet:
    return Parquet(path)


class ArrowColumn(Protocol):
    """What is used of a column of pyarrow, which has no types."""

    null_count: int

    def cast(self, kind: str) -> ArrowColumn: ...
    def fill_null(self, value: float) -> ArrowColumn: ...
    def to_numpy(self, *, zero_copy_only: bool) -> np.ndarray: ...


class Parquet:
    """A Parquet file. Missing values are bad tuples."""

    def __init__(self, path: str) -> None:
        self.path, self.short = path, 0

    def batches(self, rows: int, strict: bool) -> Iterator[Batch]:
        parquet = plugin("pyarrow.parquet", self.path, "parquet")
        with readable(self.path, "Parquet file"):
            file = parquet.ParquetFile(self.path, page_checksum_verification=True)
        with file:
            for name in COLUMNS:
                if name not in file.schema_arrow.names:
                    allowed = f"a Parquet file with columns {', '.join(COLUMNS)}; it lacks {name}"
                    raise InputError("path", self.path, allowed)
            found = file.iter_batches(batch_size=rows, columns=list(COLUMNS), use_threads=False)
            row = 0
            while True:
                with readable(self.path, f"Parquet file (from row {row} on)"):
                    table = next(found, None)
                    if table is None:
                        return
                    batch = {name: self._column(table.column(name), name) for name in COLUMNS}
                row += len(batch["s"])
                yield batch

    def _column(self, column: ArrowColumn, name: str) -> np.ndarray:
        if column.null_count and name == "r":
            column = column.cast("float64").fill_null(np.nan)
        elif column.null_count:
            column = column.cast("int64").fill_null(-1)
        return np.asarray(column.to_numpy(zero_copy_only=False))
