"""Make a readable bag from files after a crash: truncated MCAP and SQLite files, shards of a run."""

from __future__ import annotations

import re
import shutil
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory

from mcap.records import Attachment, Channel, Footer, Message, Metadata, Schema
from softrig_core import Recording
from softrig_core.wire.recording import shard_topics

from .content.topics import BagTopic
from .errors import BagError
from .files.bag import BagWriter
from .files.compressed import expanded, expanded_message, plain
from .files.mcap_recover import Recovery
from .files.metadata import custom_data, profiles
from .files.reader import BagReader
from .files.remains import METADATA, Remains, remains
from .files.source import SourceTopic
from .files.sqlite_recover import SqliteRecovery, journals
from .write import write_bag

# `write_bag` uses this name for a bag that it has not finished; the repaired bag gets the final one.
_UNFINISHED = re.compile(r"^\.(.+)\.\d+\.part$")


@dataclass
class FileReport:
    """Contents of one damaged file: messages kept, descriptions of losses, and whether it had an index."""

    name: str
    kept: int = 0
    lost: list[str] = field(default_factory=list)
    indexed: bool = False
    compression: str = "none"
    topics: list[BagTopic] = field(default_factory=list)
    custom_data: dict[str, str] = field(default_factory=dict)
    left_out: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        text = f"{self.name}: {self.kept} messages kept"
        if self.left_out:
            text += f", left out: {', '.join(self.left_out)}"
        if self.lost:
            return f"{text}, lost: {', '.join(self.lost)}"
        return text if self.indexed else f"{text}, no index; what was not yet flushed when the recorder died is lost"


@dataclass
class Repair:
    """Result of `repair`.

    Parameters
    ----------
    bag : Path or None
        The new bag; None when nothing was wrong.
    files : list of FileReport
        Messages recovered from each file.
    original : Path, optional
        Where the old bag is now.
    differing : list of str
        What the metadata claims otherwise, in words.
    """

    bag: Path | None
    files: list[FileReport]
    original: Path | None = None
    differing: list[str] = field(default_factory=list)

    @property
    def complete(self) -> bool:
        """Return whether everything that was found or claimed is in the new bag."""
        return not self.differing and not any(f.lost or f.left_out for f in self.files)

    def __str__(self) -> str:
        lines = [*map(str, self.files), *self.differing]
        if self.bag is None:
            lines.append("nothing to repair")
        else:
            lines.append(f"{sum(f.kept for f in self.files)} messages in {self.bag}")
        if self.original is not None:
            lines.append(f"the damaged files are in {self.original}")
        return "\n".join(lines)


def repair(path: Path | str, out: Path | str | None = None) -> Repair:
    """Save every complete message of a damaged bag, and write a new index and metadata.

    Parameters
    ----------
    path : Path or str
        Bag directory, a single .mcap or .db3 file (also compressed whole, .zstd), a directory with the shards of a
        run that was killed, or the run's own directory. A database is read with the journals beside it.
    out : Path or str, optional
        Path of the new bag. By default it replaces a damaged directory, which is renamed to ``NAME.damaged``. For a
        file it is ``NAME_repaired`` beside the file; for shards it is ``bag`` beside their directory.

    Raises
    ------
    BagError
        There is nothing to save, or the target exists.
    """
    result = remains(Path(path).absolute())
    damaged = result.place
    target = Path(out).absolute() if out is not None else None
    if result.shards:
        return _repair_shards(result.shards, target or damaged.with_name("bag"))
    # With an output path a new bag is wanted in any case. With a journal beside a file, a reader of the file alone
    # would miss committed rows.
    if damaged.is_dir() and target is None and not result.pending and _is_sound(damaged):
        return Repair(None, [])
    original = None
    if target is None and damaged.is_file():
        target = damaged.with_name(plain(damaged).stem + "_repaired")
    elif target is None:
        target = damaged.with_name(_UNFINISHED.sub(r"\1", damaged.name))
        original = damaged.with_name(damaged.name + ".damaged")
    for existing in (target, original):
        if existing is not None and existing != damaged and existing.exists():
            raise BagError(f"{existing} exists already; move it away first")
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = target.with_name(f".{target.name}.part")
    # A repair that was killed may have left its folder here.
    shutil.rmtree(temporary, ignore_errors=True)
    try:
        reports, saved = _rewrite(result, temporary, target.name)
        # Definitions or names in it may be damaged too; such a bag must not replace the files it was made of.
        if not _is_sound(temporary):
            raise BagError(f"{damaged}: the rest of it is not a readable bag")
        if original is not None:
            # The old bag gives way only now that the new one has been read completely.
            damaged.rename(original)
        temporary.rename(target)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    claimed = Counter({(t.name, t.msgtype): t.count for t in result.claimed.topics})
    differing = [
        f"{name}: {saved[name, msgtype]} messages, metadata.yaml claimed {count}"
        for (name, msgtype), count in claimed.items()
        if saved[name, msgtype] != count
    ]
    return Repair(target, reports, original, differing)


def _is_sound(path: Path) -> bool:
    """Return whether a bag can be read completely and agrees with its metadata."""
    differing: list[str] = []
    try:
        with BagReader(path, differing.append) as bag:
            for _ in bag.blocks():
                pass
    except BagError:
        return False
    return not differing


def _rewrite(result: Remains, directory: Path, name: str) -> tuple[list[FileReport], Counter[tuple[str, str]]]:
    """Write the complete messages; return a report of each file and the number of messages by topic and type."""
    writer: BagWriter | None = None
    # The key holds type and encoding too, because a topic may return with another one.
    numbers: dict[tuple[str, ...], int] = {}
    reports = []
    saved: Counter[tuple[str, str]] = Counter()
    for i, source in enumerate(result.files):
        report = FileReport(" with ".join(file.name for file in [source, *journals(source)]))
        reports.append(report)
        for topic, t, data in _recover(source, report, directory.parent):
            if writer is None:
                mcap = any(plain(file).suffix == ".mcap" for file in result.files)
                writer = BagWriter(
                    directory,
                    storage="mcap" if mcap else "sqlite3",
                    compression=report.compression if mcap else "none",
                    name=name,
                    custom_data=report.custom_data,
                )
            # The new bag is split where the old one was, at the first message that each file still has.
            if i and not report.kept:
                writer.next_file()
            key = topic.name, topic.msgtype, topic.wire
            if key not in numbers:
                numbers[key] = writer.add_topic(topic)
            writer.write(numbers[key], t, data)
            report.kept += 1
            saved[topic.name, topic.msgtype] += 1
        if writer is not None:
            # Topics without a saved message are declared too, so that the list of topics is complete.
            for topic in report.topics:
                key = topic.name, topic.msgtype, topic.wire
                if key not in numbers:
                    numbers[key] = writer.add_topic(topic)
    if writer is None:
        hint = "; `sqlite3 FILE .recover` may find rows" if plain(result.files[0]).suffix == ".db3" else ""
        raise BagError(f"{', '.join(s.name for s in result.files)}: no complete message in it{hint}")
    writer.close()

    absent = "all of it: metadata.yaml lists this file, but it does not exist"
    return [*reports, *(FileReport(name, 0, [absent]) for name in result.absent)], saved


def _recover(source: Path, report: FileReport, scratch: Path) -> Iterator[tuple[BagTopic, int, bytes]]:
    """Yield the complete messages of a file, with content that rosbag2 has compressed expanded."""
    with expanded(source, scratch) as (path, lost):
        read = _recover_mcap(path, report) if path.suffix == ".mcap" else _recover_sqlite3(path, report, scratch)
        for topic, t, data in read:
            message = expanded_message(data)
            if message is None:
                report.lost.append(f"a message of {topic.name} at {t} ns")
            else:
                yield topic, t, message
        report.lost += lost
        # rosbag2 compresses a file after it has closed it, so a file that can be expanded whole had its index.
        if path != source:
            report.indexed = not report.lost


def _recover_mcap(path: Path, report: FileReport) -> Iterator[tuple[BagTopic, int, bytes]]:
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    topics: dict[int, BagTopic] = {}
    left_out: Counter[str] = Counter()
    recovery = Recovery(path)
    for record in recovery:
        report.compression = recovery.compression
        if isinstance(record, Schema):
            schemas[record.id] = record
        elif isinstance(record, Channel):
            # Channels are repeated in chunks and in the summary; only a new one is another topic.
            if channels.get(record.id) != record:
                channels[record.id] = record
                topics[record.id] = _mcap_topic(record, schemas.get(record.schema_id))
                report.topics.append(topics[record.id])
        elif isinstance(record, Message) and record.channel_id in topics:
            yield topics[record.channel_id], record.log_time, record.data
        elif isinstance(record, Message):
            left_out["messages on channels that are not described"] += 1
        elif isinstance(record, Attachment):
            left_out[f"attachment {record.name}"] += 1
        elif isinstance(record, Metadata) and record.name == "rosbag2":
            report.custom_data = custom_data(record.metadata.get("serialized_metadata", "")) or report.custom_data
        elif isinstance(record, Metadata):
            left_out[f"metadata {record.name}"] += 1
        elif isinstance(record, Footer):
            report.indexed = True
    report.lost += recovery.lost
    report.left_out += [f"{count} {name}" for name, count in left_out.items()]


def _mcap_topic(channel: Channel, schema: Schema | None) -> BagTopic:
    digest = channel.metadata.get("topic_type_hash", "")
    offered = channel.metadata.get("offered_qos_profiles", "")
    name, text, encoding = "", "", ""
    if schema is not None:
        name, text, encoding = schema.name, schema.data.decode(errors="replace"), schema.encoding
    return _topic(SourceTopic(channel.topic, name, text, encoding, digest, offered, channel.message_encoding))


def _topic(stated: SourceTopic) -> BagTopic:
    name, msgtype, text, language, digest, offered, wire = stated
    known = replace(BagTopic.known(name, msgtype, profiles(offered), digest), wire=wire)
    return replace(known, definition=text, encoding=language) if text else known


def _recover_sqlite3(path: Path, report: FileReport, scratch: Path) -> Iterator[tuple[BagTopic, int, bytes]]:
    with TemporaryDirectory(dir=scratch, prefix=".repair-") as directory:
        recovery = SqliteRecovery(path, Path(directory))
        topics: dict[int, BagTopic] = {}
        for number, t, data in recovery:
            if not topics:
                topics = _sqlite3_topics(recovery, report)
            yield topics[number], t, data
        if not topics:
            _sqlite3_topics(recovery, report)
    report.lost += recovery.lost
    report.indexed = (path.parent / METADATA).exists()


def _sqlite3_topics(recovery: SqliteRecovery, report: FileReport) -> dict[int, BagTopic]:
    topics = {n: _topic(t._replace(encoding=t.encoding or "cdr")) for n, t in recovery.topics.items()}
    report.topics, report.custom_data = list(topics.values()), recovery.custom_data
    return topics


def _repair_shards(shards: list[Path], target: Path) -> Repair:
    topics = {}
    for shard in shards:
        topics.update(shard_topics(shard))
    # /clock is the first topic of a bag of a run, so that its message comes first among those of equal times.
    order = sorted(topics, key=lambda name: (name != "/clock", name))
    recording = Recording([(name, topics[name]) for name in order])
    reports = []
    for shard in shards:
        before = sum(t.number for t in recording.topics.values())
        lost = recording.read_shard(shard)
        saved = sum(t.number for t in recording.topics.values()) - before
        reports.append(FileReport(shard.name, saved, [f"the last {lost} bytes"] if lost else [], indexed=True))
    if not any(r.kept for r in reports):
        raise BagError(f"{shards[0].parent}: no complete message in its shards")
    write_bag(target, recording)
    return Repair(target, reports)
