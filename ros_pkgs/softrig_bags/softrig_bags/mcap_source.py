"""What stands in an MCAP file, read whole: index and statistics are hints and claims, the records are the truth.

Format: https://mcap.dev/spec. Chunks, summary, statistics, message and chunk indexes, repeated schemas and channels are
all optional; a file without them is as good as one with them.
"""

from __future__ import annotations

import mmap
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from .block import Block, Bytes, Ints, rows_of
from .compressed import decompressed
from .mcap_file import (
    CHANNEL,
    CHUNK,
    FOOTER,
    MAGIC,
    MESSAGE,
    MESSAGE_INDEX,
    METADATA,
    SCHEMA,
    STATISTICS,
)
from .source import Damaged, SourceTopic

ATTACHMENT = 0x09
WINDOW = 1 << 23  # bytes of messages outside of chunks that are read at a time
LATEST = 2**63 - 1  # ns: times are signed in every ROS API
_HEAD = struct.Struct("<BQ")  # of a record: opcode, length
_CHUNK = struct.Struct("<QQQII")  # first and last time, size and checksum of the content, letters of the compression
_MESSAGE_HEAD = 31  # bytes of a message record before its data
_PROBE = 64  # records that are looked at one by one before their lengths are expected to repeat


class Part(NamedTuple):
    """A chunk, or messages outside of chunks: where it begins and ends, and which times it claims."""

    start: int
    end: int
    first: int
    last: int
    hint: tuple[int, int] | None  # of a chunk: where its message indexes begin and end


@dataclass
class McapSource:
    """One MCAP file that is open for reading.

    Parameters
    ----------
    path : Path
        Of the file.

    Attributes
    ----------
    topics : dict of int to SourceTopic
        By number of the channel, those that have been met so far.
    stated : dict of int to int
        Messages by channel as the statistics of the file claim; empty where it has none.
    metadata : str
        What rosbag2 left in the file: its metadata as YAML.
    attachments : list of (str, int)
        Name and bytes of each.

    Raises
    ------
    Damaged
        The file is cut, or its bytes are not those of an MCAP file.
    """

    path: Path
    topics: dict[int, SourceTopic] = field(default_factory=dict)
    stated: dict[int, int] = field(default_factory=dict)
    stated_count: int | None = None
    metadata: str = ""
    attachments: list[tuple[str, int]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._schemas: dict[int, tuple[str, str, str]] = {}
        self._parts: list[Part] = []
        self._channels_stated: int | None = None
        with self.path.open("rb") as file:
            self._map = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        self._view: Bytes = np.frombuffer(self._map, np.uint8)
        self._walk()
        if self._channels_stated is None or len(self.topics) < self._channels_stated:
            for part in self._parts:  # channels need not be repeated outside of the chunks that use them
                self._load(part)

    def close(self) -> None:
        """Close the file."""
        self._view = np.empty(0, np.uint8)

    @property
    def first(self) -> int:
        """Earliest time that the parts claim."""
        return min((p.first for p in self._parts), default=LATEST)

    @property
    def last(self) -> int:
        """Latest time that the parts claim."""
        return max((p.last for p in self._parts), default=0)

    def blocks(self, start: int = 0) -> Iterator[tuple[int, Block, int]]:
        """Return blocks, before each its place in the file, after it the time before which nothing follows."""
        parts = sorted((p for p in self._parts if p.last >= start or not start), key=lambda p: (p.first, p.start))
        for k, part in enumerate(parts):
            block = self._load(part)
            if len(block) and (earliest := int(np.min(block.t))) < part.first:
                raise Damaged(f"a chunk has a message at {earliest} ns, but claims to begin at {part.first} ns")
            yield part.start, block, parts[k + 1].first if k + 1 < len(parts) else LATEST

    def _walk(self) -> None:
        """Note all records outside of chunks."""
        view, at, end = self._map, len(MAGIC), len(self._map)
        if view[: len(MAGIC)] != MAGIC:
            raise Damaged("it does not begin as an MCAP file")
        while at + _HEAD.size <= end:
            code, length = _HEAD.unpack_from(view, at)
            begin, after = at + _HEAD.size, at + _HEAD.size + length
            if after > end:
                break
            if code == MESSAGE:
                at = self._bare_messages(at, end)
                continue
            if code == CHUNK:
                first, last, size, _, _ = _CHUNK.unpack_from(_least(view, begin, after, _CHUNK.size))
                if size:
                    self._parts.append(Part(at, after, first, last, None))
            elif code == MESSAGE_INDEX and self._parts:
                part = self._parts[-1]
                since = part.hint[0] if part.hint else at
                self._parts[-1] = part._replace(hint=(since, after))
            elif code == FOOTER:
                if view[after : after + len(MAGIC)] != MAGIC:
                    break
                return
            else:
                self._note(code, view[begin:after])
            at = after
        raise Damaged("the file is cut off: it has no footer")

    def _bare_messages(self, at: int, end: int) -> int:
        """Note a window of messages outside of chunks; return where the next record begins."""
        stop = min(end, at + WINDOW)
        starts, after = message_run(self._map, self._view, at, stop, end)
        t = _heads(self._view, starts)[2]
        self._parts.append(Part(at, after, int(np.min(t)), int(np.max(t)), None))
        return after

    def _note(self, code: int, content: bytes) -> None:
        """Take what a record says, unless it is a message."""
        fields = Fields(content)
        if code == SCHEMA:
            number, name, encoding = fields.number("<H"), fields.text(), fields.text()
            self._schemas[number] = name, encoding, _lenient(fields.data())
        elif code == CHANNEL:
            self._note_channel(fields)
        elif code == STATISTICS:
            self.stated_count = fields.number("<Q")
            fields.skip(2)
            self._channels_stated = fields.number("<I")
            fields.skip(12 + 16)
            self.stated = {fields.number("<H"): fields.number("<Q") for _ in range(fields.number("<I") // 10)}
        elif code == METADATA and fields.text() == "rosbag2":
            self.metadata = fields.map().get("serialized_metadata", "") or self.metadata
        elif code == ATTACHMENT:
            fields.skip(16)
            name, _ = fields.text(), fields.text()
            self.attachments.append((name, fields.number("<Q")))

    def _note_channel(self, fields: Fields) -> None:
        number, schema, name = fields.number("<H"), fields.number("<H"), fields.text()
        encoding, details = fields.text(), fields.map()
        msgtype, language, definition = self._schemas.get(schema, ("", "", ""))
        offered, digest = details.get("offered_qos_profiles", ""), details.get("topic_type_hash", "")
        self.topics[number] = SourceTopic(name, msgtype, definition, language, digest, offered, encoding)

    def _load(self, part: Part) -> Block:
        """Read the messages of a part, in the order in which they were written."""
        if self._map[part.start] != CHUNK:
            starts, _ = message_run(self._map, self._view, part.start, part.end, part.end)
            return self._block(self._view[part.start : part.end], starts - part.start)
        content = self._content(part)
        view = np.frombuffer(content, np.uint8)
        starts, gaps = self._indexed(part, view) if part.hint else (np.empty(0, np.int64), [(0, len(content))])
        found = [starts]
        for at, stop in gaps:
            while at < stop:
                if content[at] == MESSAGE:
                    more, at = message_run(content, view, at, stop, stop)
                    found.append(more)
                    continue
                code, length = _HEAD.unpack_from(_least(content, at, stop, _HEAD.size))
                after = at + _HEAD.size + length
                if after > stop:
                    raise Damaged("a record in a chunk is cut off")
                self._note(code, content[at + _HEAD.size : after])
                at = after
        return self._block(view, np.sort(np.concatenate(found)) if len(found) > 1 else starts)

    def _content(self, part: Part) -> bytes:
        """Return what a chunk holds, decompressed and checked."""
        begin = part.start + _HEAD.size
        _, _, size, checksum, letters = _CHUNK.unpack_from(self._map, begin)
        at = begin + _CHUNK.size
        compression = self._map[at : at + min(letters, 16)].decode(errors="replace")
        (stored,) = struct.unpack_from("<Q", _least(self._map, at + letters, part.end, 8))
        at += letters + 8
        if at + stored > part.end:
            raise Damaged("a chunk is shorter than it says")
        content = decompressed(self._map[at : at + stored], compression, size)
        if checksum and zlib.crc32(content) != checksum:
            raise Damaged("Chunk checksum mismatch")
        return content

    def _indexed(self, part: Part, view: Bytes) -> tuple[Ints, list[tuple[int, int]]]:
        """Return where the messages begin that the index of a chunk names, and the gaps between them.

        What the index leaves out is in a gap, and what is wrong in it makes the whole chunk a gap.
        """
        assert part.hint is not None
        at, stop = part.hint
        offsets = []
        while at < stop:
            code, length = _HEAD.unpack_from(self._map, at)
            count = int.from_bytes(self._map[at + 11 : at + 15], "little") // 16
            if code == MESSAGE_INDEX and 16 * count + 6 <= length:
                pairs = np.frombuffer(self._map, "<u8", 2 * count, at + 15)
                offsets.append(pairs[1::2].astype(np.int64))
            at += _HEAD.size + length
        whole = np.empty(0, np.int64), [(0, len(view))]
        starts = np.sort(np.concatenate(offsets)) if offsets else whole[0]
        if (
            not len(starts)
            or starts[0] < 0
            or starts[-1] + _MESSAGE_HEAD > len(view)
            or (view[starts] != MESSAGE).any()
        ):
            return whole
        ends = starts + _HEAD.size + _lengths(view, starts)
        after, before = np.append(starts[1:], len(view)), np.append(0, ends)
        if (ends > after).any():
            return whole
        edges = np.append(starts, len(view))
        gaps = np.flatnonzero(before != edges)
        return starts, [(int(before[k]), int(edges[k])) for k in gaps]

    def _block(self, view: Bytes, starts: Ints) -> Block:
        channel, length, t = _heads(view, starts)
        if len(t) and np.min(t) < 0:
            raise Damaged("a message has a time of more than 63 bits")
        return Block(view, channel, t, starts + _MESSAGE_HEAD, length - 22)


def _heads(view: Bytes, starts: Ints) -> tuple[Ints, Ints, Ints]:
    """Return channel, length of the record and time of messages."""
    if not len(starts):
        return (np.empty(0, np.int64),) * 3
    rows = rows_of(view, starts, _MESSAGE_HEAD)
    kinds = (("<u2", 9), ("<i8", 1), ("<i8", 15))
    channel, length, t = (rows[:, at : at + int(k[2:])].copy().view(k)[:, 0].astype(np.int64) for k, at in kinds)
    return channel, length, t


def _lengths(view: Bytes, starts: Ints) -> Ints:
    return rows_of(view, starts + 1, 8).copy().view("<i8")[:, 0]


def message_run(content: bytes | mmap.mmap, view: Bytes, at: int, stop: int, end: int) -> tuple[Ints, int]:
    """Find the message records that follow each other from a place on.

    Records are looked at one by one until their lengths repeat; from there on they are expected to go on so, which is
    checked for all at once.

    Parameters
    ----------
    content, view : bytes and array of uint8
        The same buffer.
    at : int
        Where the first record begins.
    stop : int
        No record that begins there or later is looked at.
    end : int
        No record may go beyond it.

    Returns
    -------
    (array of int64, int)
        Where the messages begin, and where the record after them does.

    Raises
    ------
    Damaged
        A message goes beyond the end, or is shorter than its own head.
    """
    found, probe, unpack = [], _PROBE, _HEAD.unpack_from
    while True:
        starts: list[int] = []
        while len(starts) < probe and at + _HEAD.size <= stop and content[at] == MESSAGE:
            length = unpack(content, at)[1]
            if length < 22 or at + 9 + length > end:
                raise Damaged("a message is cut off")
            starts.append(at)
            at += 9 + length
        found.append(np.array(starts, np.int64))
        if len(starts) < probe:
            return np.concatenate(found), at
        ahead = _expected(view, np.array([*starts, at]), min(stop, end))
        if len(ahead):
            found.append(ahead[:-1])
            at = int(ahead[-1])
        probe = _PROBE if len(ahead) > 4 * probe else min(2 * probe, 1 << 14)


def _expected(view: Bytes, starts: Ints, stop: int) -> Ints:
    """Return where further messages begin if lengths go on repeating, as far as that is so, and where the next does."""
    lengths = np.diff(starts)
    period = next((k for k in range(1, len(lengths) // 2 + 1) if (lengths[k:] == lengths[:-k]).all()), 0)
    if not period:
        return np.empty(0, np.int64)
    pattern = lengths[len(lengths) - period :]
    begin, turn = int(starts[-1]), int(pattern.sum())
    turns = max((stop - begin) // turn, 0)
    ahead = (begin + turn * np.arange(turns)[:, None] + (np.cumsum(pattern) - pattern)).ravel()
    if not len(ahead):
        return ahead
    right = (view[ahead] == MESSAGE) & (_lengths(view, ahead) == np.tile(pattern, turns) - _HEAD.size)
    good = len(ahead) if right.all() else int(np.argmin(right))
    return np.append(ahead, begin + turns * turn)[: good + 1] if good else np.empty(0, np.int64)


class Fields:
    """The fields of a record, one after the other."""

    def __init__(self, content: bytes) -> None:
        self._content, self._at = content, 0

    def skip(self, n: int) -> None:
        """Leave out some bytes."""
        self._at += n

    def number(self, form: str) -> int:
        """Return the next number; `form` as of struct."""
        kind = struct.Struct(form)
        self._at += kind.size
        if self._at > len(self._content):
            raise Damaged("a record is shorter than its fields")
        return int(kind.unpack_from(self._content, self._at - kind.size)[0])

    def data(self) -> bytes:
        """Return the next bytes, whose length stands before them."""
        n = self.number("<I")
        self._at += n
        if self._at > len(self._content):
            raise Damaged("a record is shorter than its fields")
        return self._content[self._at - n : self._at]

    def text(self) -> str:
        """Return the next text."""
        try:
            return self.data().decode()
        except UnicodeDecodeError as error:
            raise Damaged(f"a name is no UTF-8: {error}") from None

    def map(self) -> dict[str, str]:
        """Return the next map of texts."""
        inner, found = Fields(self.data()), {}
        while inner._at < len(inner._content):
            key = inner.text()
            found[key] = _lenient(inner.data())
        return found


def _lenient(data: bytes) -> str:
    """Return a text that others wrote; what of it is no UTF-8 is replaced."""
    return data.decode(errors="replace")


def _least(view: bytes | mmap.mmap, at: int, end: int, n: int) -> bytes:
    if at + n > end:
        raise Damaged("a record is shorter than its fields")
    return view[at : at + n]
