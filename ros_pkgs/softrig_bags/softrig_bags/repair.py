"""Make a readable bag out of what a crash left: cut MCAP and SQLite files, shards of a run."""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from mcap.records import Channel, Footer, Message, Metadata, Schema
from rosbags.rosbag2.metadata import parse_qos
from softrig_core import Recording
from softrig_core.wire.recording import shard_topics

from .bag import BagWriter
from .compressed import expanded, expanded_message, plain, storage_files
from .errors import BagError
from .mcap_recover import Recovery
from .reader import BagReader
from .topics import BagTopic, custom_data
from .write import write_bag


@dataclass
class FileReport:
    """What was found in one file: messages kept, what was lost in words, whether its index was there."""

    name: str
    kept: int = 0
    lost: list[str] = field(default_factory=list)
    indexed: bool = False
    compression: str = "none"
    topics: list[BagTopic] = field(default_factory=list)
    custom_data: dict[str, str] = field(default_factory=dict)

    def __str__(self) -> str:
        text = f"{self.name}: {self.kept} messages kept"
        if self.lost:
            return f"{text}, lost: {', '.join(self.lost)}"
        return text if self.indexed else f"{text}, no index; what was not yet flushed when the recorder died is lost"


@dataclass
class Repair:
    """Result of `repair`: the new bag (None when nothing was wrong), what each file gave, where the old one is."""

    bag: Path | None
    files: list[FileReport]
    original: Path | None = None

    def __str__(self) -> str:
        lines = [str(f) for f in self.files]
        if self.bag is None:
            lines.append("nothing to repair")
        else:
            lines.append(f"{sum(f.kept for f in self.files)} messages in {self.bag}")
        if self.original is not None:
            lines.append(f"the damaged files are in {self.original}")
        return "\n".join(lines)


def repair(path: Path | str, out: Path | str | None = None) -> Repair:
    """Save every whole message of a damaged bag, write index and metadata anew.

    Parameters
    ----------
    path : Path or str
        Bag directory, a single .mcap or .db3 file (also compressed whole, .zstd), or a directory with the shards of a
        run that was killed.
    out : Path or str, optional
        Where the new bag goes. By default it takes the place of a damaged directory, which is renamed to
        ``NAME.damaged``; a file gets ``NAME_repaired`` beside it, shards get ``bag`` beside their directory.

    Raises
    ------
    BagError
        There is nothing to save, or the target exists.
    """
    path = Path(path).absolute()
    target = Path(out).absolute() if out is not None else None
    if path.is_dir() and (shards := sorted(path.glob("*.shard"))):
        return _repair_shards(shards, target or path.with_name("bag"))
    sources = storage_files(path)
    if path.is_dir() and target is None and _is_sound(path):
        return Repair(None, [])
    original = None
    if target is None:
        target = path
        if path.is_file():
            target = path.with_name(plain(path).stem + "_repaired")
        else:
            original = path.with_name(path.name + ".damaged")
    for place in (target, original):
        if place is not None and place != path and place.exists():
            raise BagError(f"{place} exists already; move it away first")
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = target.with_name(f".{target.name}.part")
    shutil.rmtree(temporary, ignore_errors=True)
    try:
        reports = _rewrite(sources, temporary, target.name)
        if not _is_sound(temporary):  # definitions or names that no reader takes
            raise BagError(f"{path}: what is left of it makes no readable bag")
        if original is not None:
            path.rename(original)
        temporary.rename(target)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    return Repair(target, reports, original)


def _is_sound(path: Path) -> bool:
    try:
        with BagReader(path) as bag:
            return sum(1 for _ in bag.messages()) == bag.count
    except BagError:
        return False


def _rewrite(sources: list[Path], directory: Path, name: str) -> list[FileReport]:
    writer: BagWriter | None = None
    numbers: dict[str, int] = {}
    reports = []
    for i, source in enumerate(sources):
        report = FileReport(source.name)
        reports.append(report)
        for topic, t, data in _recover(source, report, directory.parent):
            if writer is None:
                storage = "mcap" if plain(source).suffix == ".mcap" else "sqlite3"
                writer = BagWriter(
                    directory,
                    storage=storage,
                    compression=report.compression,
                    name=name,
                    custom_data=report.custom_data,
                )
            if i and not report.kept:
                writer.next_file()
            if topic.name not in numbers:
                numbers[topic.name] = writer.add_topic(topic)
            writer.write(numbers[topic.name], t, data)
            report.kept += 1
        if writer is not None:
            for topic in report.topics:
                if topic.name not in numbers:
                    numbers[topic.name] = writer.add_topic(topic)
    if writer is None:
        hint = "; `sqlite3 FILE .recover` may find rows" if plain(sources[0]).suffix == ".db3" else ""
        raise BagError(f"{', '.join(s.name for s in sources)}: not one whole message in it{hint}")
    writer.close()
    return reports


def _recover(source: Path, report: FileReport, scratch: Path) -> Iterator[tuple[BagTopic, int, bytes]]:
    """Give the whole messages of a file, what rosbag2 has compressed expanded."""
    with expanded(source, scratch) as (path, lost):
        read = _recover_mcap(path, report) if path.suffix == ".mcap" else _recover_sqlite3(path, report, scratch)
        for topic, t, data in read:
            whole = expanded_message(data)
            if whole is None:
                report.lost.append(f"a message of {topic.name} at {t} ns")
            else:
                yield topic, t, whole
        report.lost += lost
        if path != source:  # rosbag2 compresses files that it has closed
            report.indexed = not report.lost


def _recover_mcap(path: Path, report: FileReport) -> Iterator[tuple[BagTopic, int, bytes]]:
    schemas: dict[int, Schema] = {}
    topics: dict[int, BagTopic] = {}
    recovery = Recovery(path)
    for record in recovery:
        report.compression = recovery.compression
        if isinstance(record, Schema):
            schemas[record.id] = record
        elif isinstance(record, Channel):
            if record.id not in topics:
                topics[record.id] = _mcap_topic(record, schemas.get(record.schema_id))
                report.topics.append(topics[record.id])
        elif isinstance(record, Message) and record.channel_id in topics:
            yield topics[record.channel_id], record.log_time, record.data
        elif isinstance(record, Metadata) and record.name == "rosbag2":
            report.custom_data = custom_data(record.metadata.get("serialized_metadata", "")) or report.custom_data
        elif isinstance(record, Footer):
            report.indexed = True
    report.lost += recovery.lost


def _mcap_topic(channel: Channel, schema: Schema | None) -> BagTopic:
    digest = channel.metadata.get("topic_type_hash", "")
    offered = channel.metadata.get("offered_qos_profiles", "")
    if schema is None:
        return _topic(channel.topic, "", "", "", digest, offered)
    return _topic(channel.topic, schema.name, schema.data.decode(errors="replace"), schema.encoding, digest, offered)


def _topic(name: str, msgtype: str, text: str, encoding: str, digest: str, offered: str) -> BagTopic:
    try:
        profiles = parse_qos(offered)
    except Exception:  # damaged text makes the parser raise whatever it leads to
        profiles = []
    known = BagTopic.known(name, msgtype, profiles, digest)
    return BagTopic(name, msgtype, text, known.digest, known.offered, encoding) if text else known


_SQLITE_ERRORS = (sqlite3.Error, UnicodeDecodeError)  # the latter when SQLite's own words quote damaged names


def _recover_sqlite3(path: Path, report: FileReport, scratch: Path) -> Iterator[tuple[BagTopic, int, bytes]]:
    with TemporaryDirectory(dir=scratch, prefix=".repair-") as directory:
        database = sqlite3.connect(_whole_copy(path, Path(directory)))  # undoes a commit that was cut off
        with suppress(*_SQLITE_ERRORS):  # older schemas have no such table
            for (text,) in database.execute("SELECT metadata FROM metadata ORDER BY id"):
                report.custom_data = custom_data(text) or report.custom_data
        try:
            topics = _sqlite3_topics(database)
            report.topics = list(topics.values())
            damaged = 0
            for _, number, t, data in _rows(database, path.stat().st_size, report.lost):
                if _is_message(topics, number, t, data):
                    yield topics[number], t, data
                else:
                    damaged += 1
            report.indexed = (path.parent / "metadata.yaml").exists()
            if damaged:
                report.lost.append(f"{damaged} damaged rows")
        except _SQLITE_ERRORS as error:
            report.lost.append(f"the list of topics ({error})")
        database.close()


def _rows(database: sqlite3.Connection, size: int, lost: list[str]) -> Iterator[tuple[int, Any, Any, Any]]:
    """Give the rows of all messages; behind a damaged page it goes on, with steps that double until it gets a row."""
    last, step, left = 0, 1, size // _SMALLEST_ROW  # pages that claim each other as children give rows without end
    while last < _LAST_ROW and left > 0:
        try:
            for row in database.execute(_ROWS, (last,)):
                left -= 1
                if left <= 0:
                    break
                if row[0] > last:
                    yield row
                    if row[0] < last + _GAP:  # else a damaged number
                        last, step = row[0], 1
            else:
                return
        except _SQLITE_ERRORS as error:
            lost[:] = [f"what stood on damaged pages ({error})"]
            last, step = last + step, 2 * step
    if left <= 0:
        lost[:] = ["rows beyond what the file can hold"]


def _is_message(topics: dict[int, BagTopic], number: Any, t: Any, data: Any) -> bool:
    """Whether the columns of a row are what they should be: on a damaged page SQLite gives anything."""
    return number in topics and isinstance(t, int) and t >= 0 and isinstance(data, bytes)


_ROWS = "SELECT id, topic_id, timestamp, data FROM messages WHERE id > ? ORDER BY id"
_LAST_ROW = 1 << 40
_GAP = 1 << 20
_SMALLEST_ROW = 8  # bytes in the file


def _whole_copy(path: Path, directory: Path) -> Path:
    """Copy a database with its journal, with zeros for pages cut off: SQLite opens nothing that is shorter."""
    copy = directory / path.name
    shutil.copyfile(path, copy)
    journal = path.with_name(path.name + "-journal")
    if journal.exists():
        shutil.copyfile(journal, directory / journal.name)
    with copy.open("r+b") as file:
        head = file.read(32)
        if len(head) == 32:
            page_size, pages = int.from_bytes(head[16:18], "big"), int.from_bytes(head[28:32], "big")
            with suppress(OSError):  # a damaged head may say more than a file can have
                file.truncate(max(copy.stat().st_size, pages * (page_size if page_size != 1 else 65536)))
    return copy


def _sqlite3_topics(database: sqlite3.Connection) -> dict[int, BagTopic]:
    columns = {row[1] for row in database.execute("PRAGMA table_info(topics)")}
    offered = "offered_qos_profiles" if "offered_qos_profiles" in columns else "''"
    digest = "type_description_hash" if "type_description_hash" in columns else "''"
    texts: dict[str, tuple[str, str]] = {}
    if database.execute("SELECT 1 FROM sqlite_master WHERE name = 'message_definitions'").fetchone():
        rows = database.execute("SELECT topic_type, encoded_message_definition, encoding FROM message_definitions")
        texts = {row[0]: (row[1], row[2]) for row in rows if _all_text(row)}
    return {
        number: _topic(name, msgtype, *texts.get(msgtype, ("", "")), hashed, profiles)
        for number, name, msgtype, hashed, profiles in database.execute(
            f"SELECT id, name, type, {digest}, {offered} FROM topics"
        )
        if _all_text((name, msgtype, hashed, profiles))
    }


def _all_text(values: Sequence[Any]) -> bool:
    return all(isinstance(v, str) for v in values)


def _repair_shards(shards: list[Path], target: Path) -> Repair:
    topics = {}
    for shard in shards:
        topics.update(shard_topics(shard))
    order = sorted(topics, key=lambda name: (name != "/clock", name))
    recording = Recording([(name, topics[name]) for name in order])
    reports = []
    for shard in shards:
        before = sum(len(t.data) for t in recording.topics.values())
        lost = recording.read_shard(shard)
        kept = sum(len(t.data) for t in recording.topics.values()) - before
        reports.append(FileReport(shard.name, kept, [f"the last {lost} bytes"] if lost else [], indexed=True))
    if not any(r.kept for r in reports):
        raise BagError(f"{shards[0].parent}: not one whole message in its shards")
    write_bag(target, recording)
    return Repair(target, reports)
