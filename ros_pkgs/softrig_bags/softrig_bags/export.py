"""A bag's signals as tables, CSV, Parquet or MAT, one file a topic; but for MAT in memory that does not grow."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from softrig_core import SECOND
from softrig_core.extras import need
from softrig_core.guard import naming

from .errors import BagError
from .files.reader import BagReader
from .read import epoch_of, say_left_out
from .tables import Columns, Piece, stacked

ROWS = 1 << 14  # that are written at a time
FORMATS = ("csv", "parquet", "mat")
LONGEST = 63  # letters of a variable of MATLAB
OWN = ("time", "stamp")  # columns that every table has


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
    with BagReader(path, namespace=namespace) as bag, naming(Path(directory)):
        columns, epoch = Columns(bag), epoch_of(bag)[0]
        Path(directory).mkdir(parents=True, exist_ok=True)
        files: dict[int, _TopicFile] = {}

        def file(topic: int) -> _TopicFile:
            if topic not in files:
                ending = "parquet" if file_format == "mat" else file_format
                files[topic] = _TopicFile(Path(directory) / f"{names[topic]}.{ending}", epoch)
            return files[topic]

        names: list[str] = []
        try:
            for block in bag.blocks():
                names += _file_names(bag.labels, names)  # a file may name a topic late
                for topic, piece in columns.pieces(block):
                    file(topic).add(piece)
            names += _file_names(bag.labels, names)
            columns.finish()
            whole = [i for i in bag.chosen if columns.decoder(i) and not columns.reason(i)]
            say_left_out(path, columns)
            if not whole:
                raise BagError(f"{path}: not one topic of it can be decoded, there is nothing to export")
            written = [file(i).close() for i in whole]
            return [*map(_mat, written)] if file_format == "mat" else written
        finally:
            for opened in files.values():
                opened.abort()


def _file_names(labels: list[str], known: list[str]) -> Iterator[str]:
    """Return a name for the file of each topic that has none, no two of them equal."""
    taken = set(known)
    for label in labels[len(known) :]:
        name = plain = label.strip("/").replace("/", ".") or "topic"
        k = 1
        while name in taken:
            k += 1
            name = f"{plain}_{k}"
        taken.add(name)
        yield name


class _TopicFile:
    """One table that grows; where columns are added on the way it is written in parts that are joined in the end."""

    def __init__(self, path: Path, epoch: int) -> None:
        self._path, self._epoch = path, epoch
        self._parts: list[Path] = []
        self._labels: dict[str, None] = {}
        self._waiting: list[Piece] = []
        self._rows = 0
        self._writer: Any = None

    def add(self, piece: Piece) -> None:
        """Append rows."""
        self._waiting.append(piece)
        self._rows += len(piece.t)
        if self._rows >= ROWS:
            self._flush()

    def _flush(self) -> None:
        import pyarrow  # half a second, only here

        piece = stacked(self._waiting)
        self._waiting, self._rows = [], 0
        if self._writer is None or not piece.columns.keys() <= self._labels.keys():
            self._labels |= dict.fromkeys(piece.columns)
            self._next_part()
        absent = np.full(len(piece.t), np.nan)
        arrays = [(x - self._epoch) / SECOND for x in (piece.t, piece.stamp)]
        arrays += [piece.columns.get(label, absent) for label in self._labels]
        self._writer.write_table(pyarrow.table(arrays, names=_headings(self._labels)))

    def _next_part(self) -> None:
        if self._writer is not None:
            self._writer.close()
        self._parts.append(self._path.with_name(f".{self._path.name}.{len(self._parts)}.part"))
        self._writer = _writer(self._parts[-1], self._path.suffix, _headings(self._labels))

    def close(self) -> Path:
        """Write what is waiting, put the table in its place and return that."""
        import pyarrow

        if self._waiting or self._writer is None:
            self._flush()
        self._writer.close()
        if len(self._parts) > 1:
            headings = _headings(self._labels)
            joined = self._path.with_name(f".{self._path.name}.part")
            writer = _writer(joined, self._path.suffix, headings)
            for part in self._parts:
                for rows in _batches(part, self._path.suffix):
                    absent = pyarrow.array(np.full(rows.num_rows, np.nan))
                    arrays = [rows[name] if name in rows.schema.names else absent for name in headings]
                    writer.write_table(pyarrow.table(arrays, names=headings))
            writer.close()
            self.abort()
            self._parts = [joined]
        self._parts[0].replace(self._path)
        self._parts = []
        return self._path

    def abort(self) -> None:
        """Delete everything that has not been moved to its place."""
        for part in self._parts:
            part.unlink(missing_ok=True)


def _headings(labels: dict[str, None]) -> list[str]:
    """Return the names of all columns; a field that is called as one of the table's own gets another."""
    return [*OWN, *(f"field/{label}" if label in OWN else label for label in labels)]


def _writer(path: Path, suffix: str, headings: list[str]) -> Any:
    import pyarrow
    import pyarrow.csv
    import pyarrow.parquet

    schema = pyarrow.schema([(name, pyarrow.float64()) for name in headings])
    if suffix == ".csv":
        return pyarrow.csv.CSVWriter(str(path), schema)
    return pyarrow.parquet.ParquetWriter(str(path), schema, use_dictionary=False)


def _batches(path: Path, suffix: str) -> Iterator[Any]:
    """Read a table in parts of bounded size."""
    import pyarrow
    import pyarrow.csv
    import pyarrow.parquet

    if suffix == ".parquet":
        yield from pyarrow.parquet.ParquetFile(path).iter_batches(ROWS)
        return
    names = pyarrow.csv.open_csv(path).schema.names
    numbers = pyarrow.csv.ConvertOptions({name: pyarrow.float64() for name in names}, null_values=[])
    yield from pyarrow.csv.open_csv(path, convert_options=numbers)


def _mat(table: Path) -> Path:
    """Write a table of a topic as a file for MATLAB in its place."""
    import pyarrow.parquet
    from scipy.io import savemat

    columns = pyarrow.parquet.read_table(table)
    variables: dict[str, Any] = {}
    for heading in columns.column_names:
        name = plain = _identifier(heading)
        k = 1
        while name in variables:
            k += 1
            name = f"{plain[: LONGEST - 4]}_{k}"
        variables[name] = columns[heading].to_numpy()
    variables["names"] = np.array(columns.column_names, dtype=object)
    file = table.with_suffix(".mat")
    part = table.with_name(f".{file.name}.part")
    try:
        savemat(part, variables, appendmat=False, long_field_names=True, do_compression=True, oned_as="column")
        part.replace(file)
    except (ValueError, OverflowError) as error:
        raise BagError(f"{file}: {error}; a variable of MATLAB 5 has at most 2 GB: export csv or parquet") from None
    finally:
        part.unlink(missing_ok=True)
    table.unlink()
    return file


def _identifier(heading: str) -> str:
    """Return the name of a column as MATLAB's variables are called: letters, digits and _, a letter first."""
    plain = re.sub(r"[^A-Za-z0-9]+", "_", heading).strip("_") or "x"
    return (plain if plain[0].isalpha() else f"x{plain}")[:LONGEST]
