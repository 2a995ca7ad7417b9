"""A bag's signals as tables, CSV, Parquet or MAT, one file a topic; except for MAT in constant memory."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from softrig_core import SECOND
from softrig_core.arrow import arrow
from softrig_core.extras import need
from softrig_core.guard import print_line

from .errors import BagError
from .files.reader import BagReader
from .read import epoch_of, report_left_out
from .tables import Columns, Growing, Piece

ROWS = 1 << 14  # rows that are written at a time
FORMATS = ("csv", "parquet", "mat")
# MATLAB cuts names of variables beyond this number of letters.
LONGEST = 63
# In bytes. File systems allow 255, and the parts of a table have longer names.
LONGEST_NAME = 200
OWN = ("time", "stamp")  # columns that every table has
# MATLAB does not load variables with these names.
KEYWORDS = {
    "break",
    "case",
    "catch",
    "classdef",
    "continue",
    "else",
    "elseif",
    "end",
    "for",
    "function",
    "global",
    "if",
}
KEYWORDS |= {"otherwise", "parfor", "persistent", "return", "spmd", "switch", "try", "while"}


def export(path: Path | str, directory: Path | str, file_format: str, namespace: str = "") -> list[Path]:
    """Write each topic's signals as a table: columns time, stamp (s), then one a signal.

    Parameters
    ----------
    path : Path or str
        Bag.
    directory : Path or str
        Where the files go; is created.
    file_format : str
        ``csv``, ``parquet``, or ``mat`` (MATLAB 5: a column vector a signal, their names in `names`).
    namespace : str
        Only the topics in it; the files are named without it.

    Returns
    -------
    list of Path
        The files; a topic that cannot be decoded has none, and is named.

    Raises
    ------
    BagError
        Bad bag, unknown format, or not one topic can be decoded.
    """
    need("pyarrow", "an export")
    if file_format not in FORMATS:
        raise BagError(f"format {file_format!r}: expected {', '.join(FORMATS)}")
    with BagReader(path, namespace=namespace) as bag:
        columns, epoch = Columns(bag), epoch_of(bag)[0]
        columns.texts = {}
        Path(directory).mkdir(parents=True, exist_ok=True)
        files: dict[int, _TopicFile] = {}

        def file(topic: int) -> _TopicFile:
            if topic not in files:
                ending = "parquet" if file_format == "mat" else file_format
                files[topic] = _TopicFile(Path(directory) / f"{names[topic]}.{ending}", epoch)
            return files[topic]

        names: list[str] = []
        written: list[Path] = []
        try:
            for block in bag.blocks():
                # A file may declare a topic only where its first message is.
                names += _file_names(bag.labels, names)
                for topic, piece in columns.pieces(block):
                    file(topic).add(piece)
            names += _file_names(bag.labels, names)
            columns.finish()
            tabular = [i for i in bag.chosen if columns.decoder(i) and not columns.reason(i)]
            report_left_out(path, columns)
            for line in columns.untold():
                print_line(f"{path}: {line}")
            if not tabular:
                raise BagError(f"{path}: none of its topics can be decoded, so there is nothing to export")
            for topic in tabular:
                with _named(file(topic).path):
                    written.append(file(topic).close())
            return [*map(_mat, written)] if file_format == "mat" else written
        finally:
            for opened in files.values():
                opened.abort()
            for table in written if file_format == "mat" else ():
                table.unlink(missing_ok=True)


def _file_names(labels: list[str], known: list[str]) -> Iterator[str]:
    """Yield a valid file name on every file system for each topic that has none yet.

    Some file systems ignore case, so no two names differ in case alone. The name is the topic's name with dots in place
    of slashes; any other name is reported.
    """
    used = {name.casefold() for name in known}
    for label in labels[len(known) :]:
        dotted = label.strip("/").replace("/", ".")
        short = dotted.encode(errors="replace")[:LONGEST_NAME].decode(errors="ignore")
        name = first = re.sub(r'^\.|[\x00-\x1f\x7f<>:"\\|?*]', "_", short) or "topic"
        k = 1
        while name.casefold() in used:
            k += 1
            name = f"{first}_{k}"
        used.add(name.casefold())
        if name != dotted:
            print_line(f"topic {label} is in the file {name}")
        yield name


class _TopicFile:
    """One table that grows; if columns are added later, it is written in parts that are joined at the end."""

    def __init__(self, path: Path, epoch: int) -> None:
        self.path, self._epoch = path, epoch
        self._parts: list[Path] = []
        self._kinds: dict[str, Any] = {}  # type of each label
        self._waiting = Growing(2 * ROWS, exact=True)
        self._writer: Any = None

    def add(self, piece: Piece) -> None:
        """Append rows."""
        self._waiting.add(piece)
        if self._waiting.rows >= ROWS:
            with _named(self.path):
                self._flush()

    def _flush(self) -> None:
        # Imported here, because the import takes half a second.
        import pyarrow

        piece = self._waiting.whole()
        if self._writer is None or not piece.columns.keys() <= self._kinds.keys():
            self._kinds |= {label: x.dtype for label, x in piece.columns.items() if label not in self._kinds}
            self._next_part()
        arrays = [arrow((x - self._epoch) / SECOND) for x in (piece.t, piece.stamp)]
        for label, kind in self._kinds.items():
            arrays.append(arrow(piece.columns[label], None if kind.kind == "f" else piece.absent.get(label)))
        self._writer.write_table(pyarrow.table(arrays, schema=self._schema))
        self._waiting.clear()

    def _next_part(self) -> None:
        if self._writer is not None:
            self._writer.close()
        self._parts.append(self.path.with_name(f".{self.path.name}.{len(self._parts)}.part"))
        self._writer = _writer(self._parts[-1], self.path.suffix, self._schema)

    @property
    def _schema(self) -> Any:
        import pyarrow

        dtypes = [np.dtype(float)] * len(OWN) + [*self._kinds.values()]
        # Floats have NaN in place of nulls. A column that may have none is written in three quarters of the time.
        return pyarrow.schema(
            pyarrow.field(heading, pyarrow.from_numpy_dtype(kind), nullable=kind.kind != "f")
            for heading, kind in zip(_headings(self._kinds), dtypes, strict=True)
        )

    def close(self) -> Path:
        """Write the pending rows, move the table to its place and return its path."""
        import pyarrow

        if self._waiting.rows or self._writer is None:
            self._flush()
        self._writer.close()
        if len(self._parts) > 1:
            schema = self._schema
            joined = self.path.with_name(f".{self.path.name}.part")
            writer = _writer(joined, self.path.suffix, schema)
            for path in self._parts:
                for rows in _batches(path, self.path.suffix, schema):
                    none = {pyarrow.float64(): arrow(np.full(rows.num_rows, np.nan))}
                    arrays = [
                        rows[field.name] if field.name in rows.schema.names
                        else none.get(field.type, pyarrow.nulls(rows.num_rows, field.type))
                        for field in schema
                    ]  # fmt: skip
                    writer.write_table(pyarrow.table(arrays, schema=schema))
            writer.close()
            self.abort()
            self._parts = [joined]
        self._parts[0].replace(self.path)
        self._parts = []
        return self.path

    def abort(self) -> None:
        """Delete everything that has not been moved to its place."""
        for path in self._parts:
            path.unlink(missing_ok=True)


@contextmanager
def _named(path: Path) -> Iterator[None]:
    """Name the file of an OSError that pyarrow has written its own text for."""
    try:
        yield
    except OSError as error:
        raise OSError(error.errno, os.strerror(error.errno) if error.errno else str(error), str(path)) from error


def _headings(labels: Iterable[str]) -> list[str]:
    """Return the names of all columns; a field with the name of one of the table's own columns gets another name."""
    return [*OWN, *(f"field/{label}" if label in OWN else label for label in labels)]


def _writer(path: Path, suffix: str, schema: Any) -> Any:
    import pyarrow.csv
    import pyarrow.parquet

    if suffix == ".csv":
        return pyarrow.csv.CSVWriter(str(path), schema)
    return pyarrow.parquet.ParquetWriter(str(path), schema, use_dictionary=False)


def _batches(path: Path, suffix: str, schema: Any) -> Iterator[Any]:
    """Read a table in parts of bounded size."""
    import pyarrow.csv
    import pyarrow.parquet

    if suffix == ".parquet":
        yield from pyarrow.parquet.ParquetFile(path).iter_batches(ROWS)
        return
    numbers = pyarrow.csv.ConvertOptions(schema, null_values=[""])
    yield from pyarrow.csv.open_csv(path, convert_options=numbers)


def _mat(table: Path) -> Path:
    """Write a table of a topic as a file for MATLAB in its place."""
    import pyarrow.parquet
    from scipy.io import savemat

    columns = pyarrow.parquet.read_table(table)
    variables: dict[str, Any] = {"names": np.array(columns.column_names, dtype=object)}
    # `names` is in `variables` already, so a signal of this name gets another one.
    for heading in columns.column_names:
        name = plain = _identifier(heading)
        k = 1
        while name in variables:
            k += 1
            name = f"{plain[: LONGEST - 4]}_{k}"
        variables[name] = result = _doubles(columns[heading])
        if columns[heading].null_count and np.abs(result[~np.isnan(result)]).max(initial=0.0) > 2.0**53:
            print_line(f"{table.stem}: {heading} is rounded to doubles: MATLAB's integers cannot mark missing values")
    file = table.with_suffix(".mat")
    partial = table.with_name(f".{file.name}.part")
    try:
        with _named(file):
            savemat(partial, variables, appendmat=False, long_field_names=True, do_compression=True, oned_as="column")
        partial.replace(file)
    except (ValueError, OverflowError) as error:
        raise BagError(f"{file}: {error}; a variable of MATLAB 5 has at most 2 GB: export csv or parquet") from None
    finally:
        partial.unlink(missing_ok=True)
    return file


def _doubles(column: Any) -> Any:
    """Return a column as doubles, the numbers of MATLAB; as whole numbers where doubles would round them."""
    exact = column.to_numpy()
    doubles = exact.astype(np.float64)
    if exact.dtype.kind == "f" or (np.abs(doubles) <= 2.0**53).all():
        return doubles
    return exact


def _identifier(heading: str) -> str:
    """Return the name of a column as MATLAB's variables are called: letters, digits and _, a letter first."""
    plain = re.sub(r"[^A-Za-z0-9]+", "_", heading).strip("_") or "x"
    return (plain if plain[0].isalpha() and plain not in KEYWORDS else f"x{plain}")[:LONGEST]
