"""Reader of a whole MCAP file: the records decide; the index is only a hint, the statistics only a claim to check.

Format: https://mcap.dev/spec. Chunks, summary, statistics, message and chunk indexes, repeated schemas and channels are
all optional; a file without them is as good as one with them.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from typing import NamedTuple

import numpy as np

from ..content.block import Block, Bytes, Ints, numbers_at
from .compressed import decompressed
from .mcap_format import (
    ATTACHMENT,
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
from .source import Damaged, Source, SourceTopic

# Bytes that are read at a time where messages are outside of chunks, which may be most of a large file.
WINDOW = 1 << 23
# Bytes of messages that are loaded together. numpy needs many messages at a time to pay off, and a chunk has few.
GROUP = 1 << 22
# MCAP has unsigned times of 64 bits, but they are signed in every ROS API (ns).
LATEST = 2**63 - 1
_HEAD = struct.Struct("<BQ")  # head of a record: opcode, length
_CHUNK = struct.Struct("<QQQII")  # first and last time, size and checksum of the content, letters of the compression
_MESSAGE_HEAD = 31  # bytes of a message record before its data
_NONE = np.empty(0, np.int64)
_NOTED = (SCHEMA, CHANNEL, STATISTICS, METADATA, ATTACHMENT)
# An attachment may have gigabytes, but only its name and size are reported.
_LONGEST = 1 << 16  # bytes of an attachment's head that are read
# Reading records one by one is slow in Python; after so many the pattern of their lengths is tried on all that follow.
_PROBE = 64


class Part(NamedTuple):
    """A chunk, or messages outside of chunks: where it begins and ends, and which times and size it claims."""

    start: int
    end: int
    first: int
    last: int
    size: int  # bytes of its content, uncompressed
    hint: tuple[int, int] | None = None  # where the message indexes of a chunk begin and end

    @property
    def after(self) -> int:
        """Where the next record begins that does not belong to it."""
        return self.hint[1] if self.hint else self.end


@dataclass
class McapSource(Source):
    """One MCAP file that is open for reading; its topics have the numbers of their channels.

    Raises
    ------
    Damaged
        The file is cut, or its bytes are not those of an MCAP file.
    """

    def __post_init__(self) -> None:
        self._schemas: dict[int, tuple[str, str, str]] = {}
        self._parts: list[Part] = []
        self._channels_stated: int | None = None
        self._file = self.path.open("rb", buffering=0)
        try:
            self._walk(os.fstat(self._file.fileno()).st_size)
            # Channels need not be repeated outside of the chunks that use them, so the chunks are read for them.
            if self._channels_stated is None or len(self.topics) < self._channels_stated:
                for group in _groups(self._parts):
                    self._load(group)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _read(self, offset: int, n: int) -> bytes:
        return os.pread(self._file.fileno(), n, offset)

    @property
    def first(self) -> int:
        """Return the earliest time that the parts claim, ns: the file has no message before it."""
        return min((p.first for p in self._parts), default=LATEST)

    @property
    def last(self) -> int:
        """Return the latest time that the parts declare; `LATEST` if one part declares none."""
        return max((p.last for p in self._parts), default=0)

    def blocks(self, start: int = 0) -> Iterator[tuple[int, Block, int]]:
        """Yield blocks, each with its place in the file and the time before which nothing follows that precedes it.

        A message of an equal time precedes another one if it was written before.

        Parameters
        ----------
        start : int
            Blocks that end earlier may be left out.
        """
        parts = sorted((p for p in self._parts if p.last >= start or not start), key=lambda p: (p.first, p.start))
        groups = [*_groups(parts)]
        for group, following in zip_longest(groups, groups[1:]):
            # What was written later may have the same time.
            bound = following[0].first + (following[0].start > group[-1].start) if following else LATEST
            yield group[0].start, self._load(group), bound

    def _walk(self, end: int) -> None:
        """Note all records outside of chunks."""
        if self._read(0, len(MAGIC)) != MAGIC:
            raise Damaged("it does not begin as an MCAP file")
        offset = len(MAGIC)
        while offset + _HEAD.size <= end:
            head = self._read(offset, _HEAD.size + _CHUNK.size)
            code, length = _HEAD.unpack_from(head)
            begin, after = offset + _HEAD.size, offset + _HEAD.size + length
            if after > end:
                break
            if code == MESSAGE:
                offset = self._bare_messages(offset, length, end)
                continue
            if code == CHUNK:
                if length < _CHUNK.size:
                    raise Damaged("a chunk is shorter than its fields")
                first, last, size, _, _ = _CHUNK.unpack_from(head, _HEAD.size)
                # A last time of 0 or before the first is no claim, because some writers leave the field unset.
                if size:
                    self._parts.append(Part(offset, after, first, last if last and last >= first else LATEST, size))
            elif code == MESSAGE_INDEX and self._parts:
                part = self._parts[-1]
                self._parts[-1] = part._replace(hint=(part.hint[0] if part.hint else offset, after))
            elif code == FOOTER:
                if self._read(after, len(MAGIC)) != MAGIC:
                    break
                return
            elif code in _NOTED:
                self._note(code, self._read(begin, min(length, _LONGEST) if code == ATTACHMENT else length))
            offset = after
        raise Damaged("the file is cut off: it has no footer")

    def _bare_messages(self, offset: int, length: int, end: int) -> int:
        """Note a window of messages outside of chunks; return where the next record begins."""
        content = self._read(offset, min(max(WINDOW, _HEAD.size + length), end - offset))
        view = np.frombuffer(content, np.uint8)
        starts, after = message_run(content, view, 0, len(content))
        t = _heads(view, starts)[2]
        self._parts.append(Part(offset, offset + after, int(np.min(t)), int(np.max(t)), after))
        return offset + after

    def _note(self, code: int, content: bytes) -> None:
        """Store the content of a record, unless it is a message."""
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

    def _load(self, parts: Sequence[Part]) -> Block:
        """Read the messages of parts that follow each other in the file, in the order in which they were written."""
        begin, stop = parts[0].start, parts[-1].after
        read = memoryview(self._read(begin, stop - begin))
        if len(read) < stop - begin:
            raise Damaged("the file became shorter while it was read")
        contents = [_content(read[part.start - begin : part.end - begin]) for part in parts]
        indexes = [read[p.hint[0] - begin : p.hint[1] - begin] if p.hint else read[:0] for p in parts]
        content = contents[0] if len(contents) == 1 else memoryview(b"".join(contents))
        view = np.frombuffer(content, np.uint8)
        edges = np.cumsum([0, *map(len, contents)])
        # The index is only a hint: chunks that it does not name are read record by record in the gaps.
        starts, gaps = _indexed(indexes, view, edges)
        results = [starts]
        for offset, end in gaps:
            while offset < end:
                if content[offset] == MESSAGE:
                    more, after = message_run(content, view, offset, end)
                    results.append(more)
                else:
                    code, length = _HEAD.unpack_from(_least(content, offset, end, _HEAD.size))
                    after = offset + _HEAD.size + length
                    if after <= end:
                        self._note(code, bytes(content[offset + _HEAD.size : after]))
                if not offset < after <= end:
                    raise Damaged("a record in a chunk is cut off")
                offset = after
        block = _block(view, np.sort(np.concatenate(results)) if len(results) > 1 else starts)
        places = np.searchsorted(block.at, edges)
        for part, first, last in zip(parts, places, places[1:], strict=False):
            if (earliest := int(np.min(block.t[first:last], initial=LATEST))) < part.first:
                raise Damaged(f"a chunk has a message at {earliest} ns, but claims to begin at {part.first} ns")
        return block


def _groups(parts: Iterable[Part]) -> Iterator[list[Part]]:
    """Put parts together that follow each other in the file and have few bytes."""
    group: list[Part] = []
    size = 0
    for part in parts:
        size += part.size
        if group and (size > GROUP or part.start != group[-1].after):
            yield group
            group, size = [], part.size
        group.append(part)
    if group:
        yield group


def _indexed(indexes: Sequence[memoryview], view: Bytes, edges: Ints) -> tuple[Ints, list[tuple[int, int]]]:
    """Return where the messages begin that the indexes of chunks name, and the gaps between them.

    Messages that an index leaves out are in a gap. An error in an index makes its whole chunk a gap.

    Parameters
    ----------
    indexes : sequence of memoryview
        Of each chunk: the bytes of its message indexes.
    view : array of uint8
        The contents of the chunks.
    edges : array of int64, shape (chunks + 1,)
        Where they begin, and the end of the last one.
    """
    records = [(k, offsets) for k, index in enumerate(indexes) for offsets in _offsets(index)]
    chunk = np.repeat([k for k, _ in records], [len(offsets) for _, offsets in records]).astype(np.int64)
    offsets = np.concatenate([_NONE, *(offsets for _, offsets in records)])
    starts, counts = offsets + edges[chunk], np.bincount(chunk, minlength=len(indexes))
    right = counts.all() and not ((offsets < 0) | (offsets > edges[chunk + 1] - edges[chunk] - _MESSAGE_HEAD)).any()
    if right and not (view[starts] != MESSAGE).any():
        starts.sort()
        lengths = _lengths(view, starts)
        if not ((lengths < _MESSAGE_HEAD - _HEAD.size) | (lengths > len(view))).any():
            # A chunk has a gap wherever a message does not begin at the end of the one before.
            places = np.cumsum(counts)
            before = np.insert(starts + _HEAD.size + lengths, places - counts, edges[:-1])
            after = np.insert(starts, places, edges[1:])
            if not (before > after).any():
                gaps = np.flatnonzero(before != after)
                return starts, [(int(before[k]), int(after[k])) for k in gaps]
    if len(indexes) == 1:
        return _NONE, [(int(edges[0]), int(edges[1]))]
    single = [_indexed(indexes[k : k + 1], view, edges[k : k + 2]) for k in range(len(indexes))]
    return np.concatenate([starts for starts, _ in single]), [gap for _, gaps in single for gap in gaps]


def _offsets(index: memoryview) -> Iterator[Ints]:
    """Yield where the messages of each topic begin in a chunk, as the indexes after it name them."""
    offset = 0
    while offset < len(index):
        code, length = _HEAD.unpack_from(index, offset)
        count = int.from_bytes(index[offset + 11 : offset + 15], "little") // 16
        if code == MESSAGE_INDEX and 16 * count + 6 <= length:
            yield np.frombuffer(index, "<i8", 2 * count, offset + 15)[1::2]
        offset += _HEAD.size + length


def _content(record: memoryview) -> bytes | memoryview:
    """Return the content of a chunk, decompressed and checked; messages outside of chunks as they are."""
    if record[0] != CHUNK:
        return record
    _, _, size, checksum, letters = _CHUNK.unpack_from(record, _HEAD.size)
    offset = _HEAD.size + _CHUNK.size
    compression = bytes(record[offset : offset + min(letters, 16)]).decode(errors="replace")
    stored = int.from_bytes(_least(record, offset + letters, len(record), 8), "little")
    offset += letters + 8
    if offset + stored > len(record):
        raise Damaged("a chunk is shorter than its header states")
    content = decompressed(record[offset : offset + stored], compression, size)
    if checksum and zlib.crc32(content) != checksum:
        raise Damaged("Chunk checksum mismatch")
    return content


def _block(view: Bytes, starts: Ints) -> Block:
    channel, length, t = _heads(view, starts)
    if len(t) and np.min(t) < 0:
        raise Damaged("a message has a time of more than 63 bits")
    return Block(view, channel, t, starts + _MESSAGE_HEAD, length - 22)


def _heads(view: Bytes, starts: Ints) -> tuple[Ints, Ints, Ints]:
    """Return channel, length of the record and time of messages."""
    channel = numbers_at(view, starts + 9, "<u2").astype(np.int64)
    return channel, _lengths(view, starts), numbers_at(view, starts + 15, "<i8")


def _lengths(view: Bytes, starts: Ints) -> Ints:
    return numbers_at(view, starts + 1, "<i8")


def message_run(content: bytes | memoryview, view: Bytes, offset: int, stop: int) -> tuple[Ints, int]:
    """Find the message records that follow each other from a place on.

    Records are read one by one until their lengths repeat. From there on the same lengths are expected, which is
    checked for all of them in one batch.

    Parameters
    ----------
    content, view : bytes and array of uint8
        The same buffer.
    offset : int
        Where the first record begins.
    stop : int
        Upper end of the buffer; a record that extends beyond it is left out.

    Returns
    -------
    (array of int64, int)
        Where the messages begin, and where the record after them does.

    Raises
    ------
    Damaged
        A message is shorter than its own head.
    """
    results, probe, unpack = [], _PROBE, _HEAD.unpack_from
    while True:
        starts: list[int] = []
        while len(starts) < probe and offset + _HEAD.size <= stop and content[offset] == MESSAGE:
            length = unpack(content, offset)[1]
            if length < 22:
                raise Damaged("a message is shorter than its fields")
            if offset + 9 + length > stop:
                break
            starts.append(offset)
            offset += 9 + length
        results.append(np.array(starts, np.int64))
        if len(starts) < probe:
            return np.concatenate(results), offset
        ahead = _expected(view, np.array([*starts, offset]), stop)
        if len(ahead):
            results.append(ahead[:-1])
            offset = int(ahead[-1])
        # Without a pattern the next attempt sees more records, since a longer period may be found among them.
        probe = _PROBE if len(ahead) > 4 * probe else min(2 * probe, 1 << 14)


def _expected(view: Bytes, starts: Ints, stop: int) -> Ints:
    """Return where further messages begin if lengths continue to repeat, as far as they do, and where the next
    one begins.
    """
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
        """Skip some bytes."""
        self._at += n

    def number(self, form: str) -> int:
        """Return the next number; `form` as of struct."""
        kind = struct.Struct(form)
        self._at += kind.size
        if self._at > len(self._content):
            raise Damaged("a record is shorter than its fields")
        return int(kind.unpack_from(self._content, self._at - kind.size)[0])

    def data(self) -> bytes:
        """Return the next bytes, which are preceded by their length."""
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
        inner, result = Fields(self.data()), {}
        while inner._at < len(inner._content):
            key = inner.text()
            result[key] = _lenient(inner.data())
        return result


def _lenient(data: bytes) -> str:
    """Return a text of another writer, with bytes that are not UTF-8 replaced."""
    return data.decode(errors="replace")


def _least(view: bytes | memoryview, offset: int, end: int, n: int) -> bytes | memoryview:
    if offset + n > end:
        raise Damaged("a record is shorter than its fields")
    return view[offset : offset + n]
