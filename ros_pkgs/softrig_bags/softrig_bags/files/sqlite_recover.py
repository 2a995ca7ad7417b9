"""SQLite files after a crash: with their journals, and the rows that can be read after damaged pages."""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

from .metadata import custom_data
from .source import SourceTopic

# SQLite keeps these beside a database. It creates the -shm again from the -wal, so that one is not copied.
JOURNALS = "-wal", "-journal"
# A UnicodeDecodeError comes when a message of SQLite quotes damaged names.
ERRORS = (sqlite3.Error, UnicodeDecodeError)
_ROWS = "SELECT id, topic_id, timestamp, data FROM messages WHERE id > ? ORDER BY id"
# The steps after a damaged page double, so this limit is reached after some forty of them if no page can be read.
_LAST_ROW = 1 << 40
_GAP = 1 << 20
# Bytes that a row takes at least, which bounds how many rows a file can hold.
_SMALLEST_ROW = 8
_TRIES = 3


def journals(path: Path) -> list[Path]:
    """List the files beside a database in which SQLite keeps a part of it."""
    return [path.with_name(name) for name, _, _ in _state(path) if name != path.name]


def _state(path: Path) -> list[tuple[str, int, int]]:
    """List name, size and time of change of a database and its journals, of those that hold something."""
    result = []
    for suffix in ("", *JOURNALS):
        # A recorder that still works may remove a journal between two calls.
        with suppress(FileNotFoundError):
            state = path.with_name(path.name + suffix).stat()
            result += [(path.name + suffix, state.st_size, state.st_mtime_ns)] if state.st_size else []
    return result


class SqliteRecovery:
    """The rows that can be read from a copy of a database and its journals.

    Parameters
    ----------
    path : Path
        The database; it and its journals are left as they are.
    scratch : Path
        Folder for the copy.

    Attributes
    ----------
    topics : dict of int to SourceTopic
        By the number that the rows carry.
    custom_data : dict of str to str
        From the newest metadata in the file.
    lost : list of str
        What could not be read, in words.
    """

    def __init__(self, path: Path, scratch: Path) -> None:
        self._copy = _whole_copy(path, scratch)
        self.topics: dict[int, SourceTopic] = {}
        self.custom_data: dict[str, str] = {}
        self.lost: list[str] = []

    def __iter__(self) -> Iterator[tuple[int, int, bytes]]:
        """Yield the number of the topic, the time in ns and the bytes of each message, in the order of the rows."""
        size = sum(file.stat().st_size for file in [self._copy, *journals(self._copy)])
        # Opening undoes a commit that was cut off, which changes the file; hence the copy.
        with closing(sqlite3.connect(self._copy)) as database:
            # Older schemas have no such table.
            with suppress(*ERRORS):
                for (text,) in database.execute("SELECT metadata FROM metadata ORDER BY id"):
                    self.custom_data = custom_data(text) or self.custom_data
            try:
                self.topics = _readable_topics(database)
                damaged = 0
                for _, number, t, data in _rows(database, size, self.lost):
                    if number in self.topics and isinstance(t, int) and t >= 0 and isinstance(data, bytes):
                        yield number, t, data
                    else:
                        # SQLite returns values of any kind from a damaged page.
                        damaged += 1
                if damaged:
                    self.lost.append(f"{damaged} damaged rows")
            except ERRORS as error:
                self.lost.append(f"the list of topics ({error})")


def columns_of(database: sqlite3.Connection, table: str) -> set[str]:
    """Return the names of a table's columns; empty if there is no such table."""
    return {row[1] for row in database.execute(f"PRAGMA table_info({table})")}


def topics_of(database: sqlite3.Connection) -> Iterator[tuple[Any, SourceTopic]]:
    """Yield number and description of each topic as the database has them, which may be of any type if damaged."""
    texts: dict[Any, tuple[Any, Any]] = {}
    # Older schemas have no such table. Converters of bags leave NULL where they know nothing.
    if columns_of(database, "message_definitions"):
        for name, text, language in database.execute(
            "SELECT topic_type, coalesce(encoded_message_definition, ''), coalesce(encoding, '') "
            "FROM message_definitions ORDER BY id"
        ):
            texts.setdefault(name, (text, language))
    columns = columns_of(database, "topics")
    offered = "coalesce(offered_qos_profiles, '')" if "offered_qos_profiles" in columns else "''"
    digest = "coalesce(type_description_hash, '')" if "type_description_hash" in columns else "''"
    for number, name, msgtype, hashed, profiles, wire in database.execute(
        f"SELECT id, name, type, {digest}, {offered}, coalesce(serialization_format, '') FROM topics ORDER BY id"
    ):
        yield number, SourceTopic(name, msgtype, *texts.get(msgtype, ("", "")), hashed, profiles, wire)


def _readable_topics(database: sqlite3.Connection) -> dict[int, SourceTopic]:
    """Return the topics whose description is text; of a damaged definition the topic remains without it."""
    result = {}
    for number, topic in topics_of(database):
        if not (isinstance(topic.definition, str) and isinstance(topic.language, str)):
            topic = topic._replace(definition="", language="")
        if all(isinstance(text, str) for text in topic):
            result[number] = topic
    return result


def _rows(database: sqlite3.Connection, size: int, lost: list[str]) -> Iterator[tuple[int, Any, Any, Any]]:
    """Yield the rows of all messages; after a damaged page continue with doubling steps until there is a row."""
    # Damaged pages that claim each other as children yield rows without end, so the number of rows is bounded.
    last, step, left = 0, 1, size // _SMALLEST_ROW
    while last < _LAST_ROW and left > 0:
        try:
            for row in database.execute(_ROWS, (last,)):
                left -= 1
                if left <= 0:
                    break
                if row[0] > last:
                    yield row
                    # A larger jump is due to a damaged number, and continuing after it would skip the rows in between.
                    if row[0] < last + _GAP:
                        last, step = row[0], 1
            else:
                return
        except ERRORS as error:
            lost[:] = [f"the content of damaged pages ({error})"]
            last, step = last + step, 2 * step
    if left <= 0:
        lost[:] = ["rows beyond what the file can hold"]


def _whole_copy(path: Path, directory: Path) -> Path:
    """Copy a database with its journals, with zeros for truncated pages: SQLite does not open a shorter file."""
    copy = directory / path.name
    for _ in range(_TRIES):
        before = _state(path)
        with suppress(FileNotFoundError):
            for name in {path.name, *(name for name, _, _ in before)}:
                shutil.copyfile(path.with_name(name), directory / name)
            if _state(path) == before:
                break
    else:
        # A recorder writes faster than files are copied; only the locks of SQLite give the state of one moment.
        for file in [copy, *journals(copy)]:
            file.unlink()
        with (
            closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True)) as source,
            closing(sqlite3.connect(copy)) as target,
        ):
            source.backup(target)
    with copy.open("r+b") as database:
        head = database.read(32)
        if len(head) == 32:
            page_size, pages = int.from_bytes(head[16:18], "big"), int.from_bytes(head[28:32], "big")
            # A damaged head may claim more pages than a file can have.
            with suppress(OSError):
                database.truncate(max(copy.stat().st_size, pages * (page_size if page_size != 1 else 65536)))
    return copy
