"""Tables: CSV, JSON lines and Parquet files, directories of such parts, frames, arrays by name.

A ``Table`` gives its columns some rows at a time, as ``Cells``. What the columns mean, and how rows become tuples, is
``erl_torch.experience.formats.rows``. CSV, Parquet and frames are read by pyarrow. Of CSV everything is read as text:
what type a column is of shows when all of it is known.
"""

from __future__ import annotations

import bz2
import contextlib
import gzip
import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np

from erl_torch.checks import InputError
from erl_torch.experience.formats.format import plugin, readable
from erl_torch.files import read_npz

SUFFIXES = {
    ".csv": "csv", ".tsv": "csv", ".tab": "csv", ".jsonl": "json", ".ndjson": "json", ".parquet": "parquet",
    ".pq": "parquet",
}  # fmt: skip
WHAT = {"csv": "CSV file", "json": "file of JSON lines", "parquet": "Parquet file"}
PACKED: dict[str, Callable[..., Any]] = {".gz": gzip.open, ".bz2": bz2.open}  # as Python opens them
BLOCK = 1 << 22  # bytes of CSV at a time
EXTRA = "parquet"  # what installs pyarrow


MISSING = ("na", "n/a", "nan", "null", "none", "#n/a", "<na>", "-")  # in a column of numbers


class Cells(NamedTuple):
    """A column, some rows of it: ``values[codes]``, where a code of -1 is a missing value.

    Without codes the values are numbers or truth values, one a row; NaN is a missing value.
    """

    values: Any  # [m] distinct, a list; or [n] array of kind b, i, u or f
    codes: np.ndarray | None = None  # [n] int64

    @property
    def n_rows(self) -> int:
        return len(self.values if self.codes is None else self.codes)

    def factors(self) -> tuple[list[Any], np.ndarray]:
        """(distinct values, codes [n], -1 where one is missing): numbers too.

        Missing is an empty text, and among numbers what stands for none, ``MISSING``.
        """
        if self.codes is not None:
            there = [
                value for value in self.values if not isinstance(value, str) or value.lower() not in ("", *MISSING)
            ]
            if len(there) == len(self.values):
                return self.values, self.codes
            numbers = all(map(_is_number, there))
            gone = [isinstance(v, str) and (not v or (numbers and v.lower() in MISSING)) for v in self.values]
            return self.values, np.where(np.array([*gone, True])[self.codes], -1, self.codes)
        distinct, codes = np.unique(self.values, return_inverse=True)
        codes = codes.reshape(-1).astype(np.int64)
        if distinct.dtype.kind == "f" and len(distinct) and np.isnan(distinct[-1]):
            return distinct[:-1].tolist(), np.where(codes == len(distinct) - 1, -1, codes)
        return distinct.tolist(), codes


def _is_number(value: object) -> bool:
    try:
        float(str(value).replace(",", "."))
    except ValueError:
        return False
    return True


class Table(Protocol):
    """Columns by name, which can be read again and again."""

    path: str  # what messages call it
    decimal_comma: bool  # 1,5 is a number
    invalid: int  # rows without the right number of columns, left out; known after a pass

    @property
    def names(self) -> Sequence[str]:
        """Of its columns, in their order; a name may be there twice."""

    def batches(self, names: Sequence[str], rows: int, strict: bool) -> Iterator[dict[str, Cells]]:
        """Make one pass over some columns, in order, at most ``rows`` rows at a time.

        Raises InputError for a file that cannot be read; it names the path. Where ``strict`` is false, lines that
        cannot be split into columns are left out and counted.
        """

    def number(self, row: int) -> int:
        """The place in the file of a row, from 0, as messages name it."""


class InOrder:
    """What most tables share."""

    decimal_comma = False
    invalid = 0

    def number(self, row: int) -> int:
        return row


# -- which table is at a path ------------------------------------------------------------------------------


def kind_of(path: Path) -> str | None:
    """ "csv", "json" or "parquet", by the name of a file, whatever its case; None for another."""
    suffixes = [suffix.lower() for suffix in path.suffixes]
    if suffixes and suffixes[-1] in PACKED:
        suffixes.pop()
        return SUFFIXES.get(suffixes[-1]) if suffixes and suffixes[-1] not in (".parquet", ".pq") else None
    return SUFFIXES.get(suffixes[-1]) if suffixes else None


def claims(path: str) -> bool:
    place = Path(path)
    if place.is_dir():
        return any(list(map(kind_of, place.iterdir())))
    return place.is_file() and kind_of(place) is not None


def open_table(path: str) -> Table:
    """The table at a path that is claimed. Raises InputError."""
    place = Path(path)
    if not place.is_dir():
        return _of_files(path, [place])
    parts = [part for part in place.iterdir() if not part.name.startswith((".", "_"))]
    odd = [part.name for part in parts if part.is_dir() or kind_of(part) is None]
    kinds = {kind_of(part) for part in parts} - {None}
    if odd or len(kinds) != 1:
        what = odd[0] if odd else " and ".join(sorted(map(str, kinds)))
        raise InputError("path", path, f"a directory of parts of one format, and of nothing else: it has {what}")
    # part-10 comes after part-9
    parts.sort(key=lambda part: [(0, int(x), "") if x.isdigit() else (1, 0, x) for x in re.split(r"(\d+)", part.name)])
    return _of_files(path, parts)


def _of_files(path: str, files: list[Path]) -> Table:
    makers: dict[str, Callable[[str, Path], Table]] = {"csv": CsvFile, "json": JsonFile, "parquet": ParquetFile}
    tables = [makers[str(kind_of(file))](str(file), file) for file in files]
    return tables[0] if len(tables) == 1 and str(files[0]) == path else Parts(path, tables)


def is_frame(value: object) -> bool:
    """Whether ``value`` is a table in memory: a frame, a table of Arrow, or arrays by name."""
    return isinstance(value, Mapping) or hasattr(value, "__arrow_c_stream__") or hasattr(value, "columns")


def of_frame(value: Any) -> Table:  # of pandas, polars, pyarrow, ...
    """The table of a frame (of pandas, polars, pyarrow: whatever Arrow can take), or of arrays by name.

    Raises InputError for columns that are of no use.
    """
    if isinstance(value, Mapping):
        return Arrays("dict", {str(name): column for name, column in value.items()})
    name = type(value).__name__
    if hasattr(value, "__arrow_c_stream__") or type(value).__module__.partition(".")[0] == "pandas":
        arrow = plugin("pyarrow", name, EXTRA)
        # pandas has columns of mixed types, which Arrow has not.
        with contextlib.suppress(arrow.ArrowInvalid, arrow.ArrowTypeError, arrow.ArrowNotImplementedError):
            whole = arrow.table(value) if hasattr(value, "__arrow_c_stream__") else arrow.Table.from_pandas(value)
            return ArrowTable(name, whole)
    if not hasattr(value, "columns"):
        raise InputError("path", name, "a path, a frame, a table of Arrow or arrays by name")
    columns = list(value.columns)
    if len(set(map(str, columns))) < len(columns):
        raise InputError(f"path={name}: columns", ", ".join(map(str, columns)), "of different names")
    return Arrays(name, {str(column): value[column] for column in columns})


# -- tables ------------------------------------------------------------------------------------------------


class Parts(InOrder):
    """Several files, one after the other, as one table."""

    def __init__(self, path: str, parts: list[Table]) -> None:
        self.path, self._parts, self.names = path, parts, parts[0].names
        self.decimal_comma = parts[0].decimal_comma
        for part in parts:
            if set(part.names) != set(self.names):
                allowed = f"of the columns of {Path(parts[0].path).name}, {', '.join(self.names)}"
                raise InputError(f"path={part.path}: columns", ", ".join(part.names), allowed)

    def batches(self, names: Sequence[str], rows: int, strict: bool) -> Iterator[dict[str, Cells]]:
        self.invalid = 0
        for part in self._parts:
            yield from part.batches(names, rows, strict)
            self.invalid += part.invalid


class CsvFile(InOrder):
    """A CSV file, packed or not: the delimiter is a tab by its suffix, or whichever of ``;`` and tab the first line
    has where it has no comma."""

    def __init__(self, path: str, file: Path) -> None:
        self.path = path
        self._arrow, self._csv = plugin("pyarrow", path, EXTRA), plugin("pyarrow.csv", path, EXTRA)
        with readable(path, WHAT["csv"]):
            with self._open() as stream:
                head = stream.read(1 << 16)
            line = head.removeprefix(b"\xef\xbb\xbf").split(b"\n")[0]
            tabs = {".tsv", ".tab"} & {suffix.lower() for suffix in file.suffixes[-2:]}
            self._delimiter = "\t" if tabs else ","
            if b"," not in line and self._delimiter == ",":
                self._delimiter = next((mark for mark in ";\t" if mark.encode() in line), ",")
            self.decimal_comma = self._delimiter == ";"
            with self._open() as stream, self._reader(stream, None, False) as reader:
                self._raw = list(reader.schema.names)
        self.names = [name.strip() for name in self._raw]

    def _open(self) -> Any:  # of pyarrow, which has no types
        return self._arrow.input_stream(self.path, compression="detect")

    def _reader(self, stream: Any, include: list[str] | None, strict: bool) -> Any:
        def invalid(row: Any) -> str:
            if strict:
                return "error"
            self.invalid += 1
            return "skip"

        csv = self._csv
        names = getattr(self, "_raw", [])
        return csv.open_csv(
            stream,
            read_options=csv.ReadOptions(block_size=BLOCK, use_threads=False),
            parse_options=csv.ParseOptions(
                delimiter=self._delimiter, newlines_in_values=True, invalid_row_handler=invalid
            ),
            convert_options=csv.ConvertOptions(
                column_types=dict.fromkeys(names, self._arrow.string()),
                include_columns=include,
                strings_can_be_null=False,
            ),
        )

    def batches(self, names: Sequence[str], rows: int, strict: bool) -> Iterator[dict[str, Cells]]:
        raw = [self._raw[self.names.index(name)] for name in names]
        self.invalid, row = 0, 0
        with contextlib.ExitStack() as stack:
            with readable(self.path, WHAT["csv"]):
                stream = stack.enter_context(self._open())
                reader = stack.enter_context(self._reader(stream, raw, strict))
            while True:
                with readable(self.path, f"{WHAT['csv']} (from row {row} on)"):
                    batch = next(reader, None)
                if batch is None:
                    return
                for begin in range(0, len(batch), rows):
                    part = batch.slice(begin, rows)
                    with readable(self.path, f"{WHAT['csv']} (from row {row} on)"):
                        columns = {name: _stripped(_cells(part.column(i))) for i, name in enumerate(names)}
                    row += len(part)
                    yield columns


class JsonFile(InOrder):
    """JSON lines, packed or not: an object a line, whose names are columns. A name that a line lacks is a missing
    value."""

    def __init__(self, path: str, file: Path) -> None:
        self.path, self._open = path, PACKED.get(file.suffix.lower(), open)
        found: dict[str, None] = {}
        for one in self._lines(False):
            found |= dict.fromkeys(one)
        if not found:  # then the first line that is none is what is wrong
            for _ in self._lines(True):
                pass
        self.names = list(found)

    def _lines(self, strict: bool) -> Iterator[dict[str, Any]]:
        self.invalid = 0
        with readable(self.path, WHAT["json"]), self._open(self.path, "rt", encoding="utf-8-sig") as file:
            for number, line in enumerate(file, 1):
                if not line.strip():
                    continue
                try:
                    one = json.loads(line)
                except (ValueError, RecursionError) as error:
                    one = error
                if isinstance(one, dict):
                    yield one
                elif strict:
                    said = f" ({one})" if isinstance(one, Exception) else ""
                    raise InputError(f"path={self.path}: line {number}", line.strip(), f"a JSON object{said}")
                else:
                    self.invalid += 1

    def batches(self, names: Sequence[str], rows: int, strict: bool) -> Iterator[dict[str, Cells]]:
        held: list[dict[str, Any]] = []

        def made() -> dict[str, Cells]:
            return {name: _of_objects([one.get(name) for one in held]) for name in names}

        for one in self._lines(strict):
            held.append(one)
            if len(held) == rows:
                yield made()
                held = []
        if held:
            yield made()


class ParquetFile(InOrder):
    """A Parquet file."""

    def __init__(self, path: str, file: Path) -> None:
        self.path, self._parquet = path, plugin("pyarrow.parquet", path, EXTRA)
        with readable(path, WHAT["parquet"]), self._opened() as opened:
            self.names = list(opened.schema_arrow.names)

    def _opened(self) -> Any:
        return self._parquet.ParquetFile(self.path, page_checksum_verification=True)

    def batches(self, names: Sequence[str], rows: int, strict: bool) -> Iterator[dict[str, Cells]]:
        with readable(self.path, WHAT["parquet"]):
            file = self._opened()
        row = 0
        with file:
            found = file.iter_batches(batch_size=rows, columns=list(names), use_threads=False)
            while True:
                with readable(self.path, f"{WHAT['parquet']} (from row {row} on)"):
                    batch = next(found, None)
                    if batch is None:
                        return
                    columns = {name: _cells(batch.column(name)) for name in names}
                row += len(batch)
                yield columns


class ArrowTable(InOrder):
    """A table of Arrow's, in memory."""

    def __init__(self, path: str, table: Any) -> None:
        self.path, self._table, self.names = path, table, list(table.column_names)

    def batches(self, names: Sequence[str], rows: int, strict: bool) -> Iterator[dict[str, Cells]]:
        for batch in self._table.select(list(names)).to_batches(max_chunksize=rows):
            with readable(self.path, "table of Arrow"):
                columns = {name: _cells(batch.column(name)) for name in names}
            yield columns


class Arrays(InOrder):
    """Arrays by name, in memory: a row of a two-dimensional one is a tuple."""

    def __init__(self, path: str, arrays: Mapping[str, Any]) -> None:
        self.path, self.names = path, list(arrays)
        self._arrays = {name: column if isinstance(column, np.ndarray) else None for name, column in arrays.items()}
        self._given = arrays

    def _column(self, name: str) -> np.ndarray:
        column = self._arrays[name]
        if column is None:
            given = self._given[name]
            try:
                column = np.asarray(given if not isinstance(given, (list, tuple)) or _plain(given) else _objects(given))
            except (TypeError, ValueError, RuntimeError) as error:
                raise InputError(f"path={self.path}: {name}", type(given).__name__, f"a column ({error})") from error
            self._arrays[name] = column
        if column.ndim == 2 and column.shape[1] == 1:
            column = column[:, 0]
        if column.ndim not in (1, 2):
            raise InputError(f"path={self.path}: {name}", f"shape {column.shape}", "a column, or a table [n, d]")
        return column

    def batches(self, names: Sequence[str], rows: int, strict: bool) -> Iterator[dict[str, Cells]]:
        columns = {name: self._column(name) for name in names}
        lengths = {name: len(column) for name, column in columns.items()}
        if len(set(lengths.values())) > 1:
            raise InputError(f"path={self.path}: columns", f"lengths {lengths}", "of one length")
        for begin in range(0, next(iter(lengths.values())), rows):
            yield {name: _of_array(column[begin : begin + rows]) for name, column in columns.items()}


def of_npz(path: str) -> Table:
    """The arrays of an npz file, in memory. Raises InputError."""
    return Arrays(path, read_npz(path))


class Sorted:
    """The rows of a table in another order, in memory.

    Args:
        table: where they are from.
        names: of the columns that are used.
        order: [n], the rows of ``table`` in the order in which they are given.
    """

    def __init__(self, table: Table, names: Sequence[str], order: np.ndarray) -> None:
        self.path, self.names, self.decimal_comma = table.path, list(names), table.decimal_comma
        self._order, self._numbers = order, table.number
        parts: dict[str, list[np.ndarray]] = {name: [] for name in names}
        known: dict[str, dict[Any, int]] = {name: {} for name in names}
        for batch in table.batches(names, 1 << 16, False):
            for name, cells in batch.items():
                values, codes = cells.factors()
                place = np.array([known[name].setdefault(value, len(known[name])) for value in values] + [-1], np.int64)
                parts[name].append(place[codes])
        self.invalid = table.invalid
        self._values = {name: list(found) for name, found in known.items()}
        self._codes = {name: np.concatenate(found)[order] for name, found in parts.items()}

    def batches(self, names: Sequence[str], rows: int, strict: bool) -> Iterator[dict[str, Cells]]:
        if strict and self.invalid:
            allowed = "a table whose lines have as many columns as the first"
            raise InputError(f"path={self.path}", f"{self.invalid} lines", allowed)
        for begin in range(0, len(self._order), rows):
            yield {name: Cells(self._values[name], self._codes[name][begin : begin + rows]) for name in names}

    def number(self, row: int) -> int:
        return self._numbers(int(self._order[row]))


# -- cells -------------------------------------------------------------------------------------------------


def _cells(column: Any) -> Cells:
    """Of an array of Arrow's."""
    import pyarrow as arrow

    kind = column.type
    if not column.null_count and (
        arrow.types.is_integer(kind) or arrow.types.is_floating(kind) or arrow.types.is_boolean(kind)
    ):
        return Cells(np.asarray(column.to_numpy(zero_copy_only=False)))
    if arrow.types.is_floating(kind):
        return Cells(np.asarray(column.cast("float64").fill_null(np.nan).to_numpy(zero_copy_only=False)))
    if arrow.types.is_nested(kind) and not arrow.types.is_dictionary(kind):
        return _of_objects(column.to_pylist())
    if not arrow.types.is_dictionary(kind):
        column = column.dictionary_encode()
    codes = column.indices.cast("int64").fill_null(-1).to_numpy(zero_copy_only=False)
    values = column.dictionary.to_pylist()
    lost = np.array([value is None for value in values] + [False])
    return Cells([_hashable(value) for value in values], np.where(lost[codes], -1, codes))


def _stripped(cells: Cells) -> Cells:
    """Texts of a CSV file without the spaces around them."""
    assert cells.codes is not None
    return Cells([value.strip() for value in cells.values], cells.codes)


def _of_array(column: np.ndarray) -> Cells:
    if column.ndim == 1 and column.dtype.kind in "biuf":
        return Cells(column)
    if column.ndim == 1 and column.dtype.kind in "US":
        distinct, codes = np.unique(column, return_inverse=True)
        texts = [x.decode(errors="backslashreplace") if isinstance(x, bytes) else x for x in distinct.tolist()]
        return Cells(texts, codes.astype(np.int64))
    if column.dtype.kind in "mM":
        return _of_array(column.astype(str))
    return _of_objects(column.tolist())


def _of_objects(values: list[Any]) -> Cells:
    """Of Python's objects: None and NaN are missing values."""
    known: dict[Any, int] = {}
    codes = np.empty(len(values), np.int64)
    for i, value in enumerate(values):
        value = _hashable(value)
        codes[i] = -1 if value is None or value != value else known.setdefault((type(value) is bool, value), len(known))
    return Cells([value for _, value in known], codes)


def _hashable(value: Any) -> Any:
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, (list, tuple)):
        return tuple(_hashable(item) for item in value)
    if isinstance(value, dict):
        return json.dumps(value, sort_keys=True, default=str)
    if isinstance(value, float) or value is None:
        return value
    return value if isinstance(value, (str, int)) else _plainly(value)


def _plainly(value: Any) -> Any:
    """Dates and the like as text, decimals as numbers, what is missing as None."""
    if str(value) in ("<NA>", "NaT"):
        return None
    if type(value).__name__ == "Decimal":
        return float(value)
    return str(value)


def _plain(values: Sequence[Any]) -> bool:
    """Whether numpy makes of a list what it is: numbers of one kind, or texts."""
    kinds = {type(value) for value in values}
    return kinds <= {int, float} or kinds in ({str}, {bool})


def _objects(values: Sequence[Any]) -> np.ndarray:
    column = np.empty(len(values), object)
    for i, value in enumerate(values):
        column[i] = value
    return column
