"""Reader of a bag: its topics, its messages by time, and a check of what was read against the metadata.

Topics are mapped by name and type. Counts, times and order come from the messages in the files. They are compared with
metadata.yaml and with the statistics in the files; each difference is reported with topic and count.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator
from dataclasses import replace
from itertools import chain, count
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from softrig_core.errors import nearby
from softrig_core.guard import incomplete
from softrig_core.wire.recording import relative

from ..content.block import Block, distinct, joined
from ..content.definitions import Types, UnknownType, complete, distribution_of, full_type, types_of
from ..content.layouts import Decoder
from ..content.topics import BagTopic, checked_namespace
from ..errors import BagError
from .compressed import SUFFIXES, Expanded, plain, plain_messages
from .mcap_format import MAGIC
from .mcap_source import McapSource
from .metadata import Metadata, embedded, profiles, read_metadata
from .source import Damaged, SourceTopic

if TYPE_CHECKING:
    from .sqlite_source import SqliteSource

# Bytes of a block at least: blocks bound the memory, and numpy needs many messages at a time to pay off. It is less
# than an MCAP file loads together, so that what was loaded is passed on without a copy.
BATCH = 1 << 21
_SQLITE = b"SQLite format 3\0"
# These files are often mistaken for bags; the message then names what the file is and what to do.
_OTHERS = {
    b"#ROSBAG V": "a bag of ROS 1; convert it by rosbags-convert of the Python package rosbags",
    b"ULog": "a log of PX4 (ULog), not a bag",
    b"PK\3\4": "a ZIP archive; unpack it first",
    b"\x1f\x8b": "compressed by gzip; unpack it first",
    b"BZh": "compressed by bzip2; unpack it first",
    b"\xfd7zXZ": "compressed by xz; unpack it first",
    b"\x04\x22\x4d\x18": "compressed by lz4 as a whole; unpack it first",
    b"version https://git-lfs": "a pointer of Git LFS, not the file itself; fetch it by `git lfs pull`",
}
LATEST = 2**63 - 1
# So many bags below a folder are named, so that the reader of the message can choose one.
SHOWN = 5


class _Waiting(NamedTuple):
    """Messages that are read but may be preceded by others; `rank` is the order in which they were written."""

    rank: tuple[int, int]
    block: Block


class BagReader:
    """Context manager around a rosbag2 bag: MCAP or sqlite3, split or not, compressed or not, any metadata version.

    Parameters
    ----------
    path : Path or str
        Bag directory, or a single .mcap or .db3 file, also compressed whole (.zstd).
    report : callable, optional
        Receives each difference between what was read and what was claimed, in place of a line and status 1.
    namespace : str
        Only messages of topics in this namespace are returned; the check covers the whole bag.

    Attributes
    ----------
    topics : list of BagTopic
        In the order of the metadata, then of the files. A name may occur twice, with two types.
    labels : list of str
        A name for each topic that no other has, relative as in scenario files, to `namespace` if that is given; empty
        for a topic outside of it.
    metadata : Metadata
        The contents of metadata.yaml; for a single file, the metadata that its writer stored in it, without counts.

    Raises
    ------
    BagError
        On entering and on reading: no bag, damaged, or of an unknown format.
    """

    def __init__(self, path: Path | str, report: Callable[[str], object] | None = None, namespace: str = "") -> None:
        self.path = Path(path)
        self._namespace = checked_namespace(namespace)
        self._report = report or (lambda line: incomplete(f"{self.path}: {line}"))
        self.topics: list[BagTopic] = []
        self.labels: list[str] = []
        self.metadata = Metadata()
        self._sources: list[McapSource | SqliteSource] = []
        self._expanded: list[Expanded] = []
        self._numbers: list[dict[int, int]] = []  # for each file: number of a topic in it to its number here
        self._types: dict[int, Types] = {}
        self._counts: list[int] | None = None
        self._start: int | None = None
        self._end = 0
        self._logged: set[str] = set()

    def __enter__(self) -> BagReader:
        try:
            self._open()
        except BaseException:
            self._close()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._close()

    def _close(self) -> None:
        for source in self._sources:
            source.close()
        for copy in self._expanded:
            copy.close()

    # Opening ----------------------------------------------------------------------------------------------------------

    def _open(self) -> None:
        if not self.path.exists():
            raise BagError(f"{self.path} does not exist{nearby(self.path)}")
        if self.path.is_dir():
            self._check_directory()
            try:
                self.metadata = read_metadata(self.path / "metadata.yaml")
            except Damaged as error:
                raise self._damaged(error) from error
            self.files = list(dict.fromkeys(self._file(name) for name in self.metadata.files))
            if not self.files:
                raise BagError(f"{self.path}: metadata.yaml names no storage file")
        else:
            self.files = [self.path]
        for file in self.files:
            try:
                self._sources.append(self._source(file))
            except Damaged as error:
                raise self._damaged(error, file) from error
        if not self.path.is_dir():
            result = embedded(self._sources[0].metadata)
            self.metadata = Metadata(
                version=result.version, custom_data=result.custom_data, distribution=result.distribution
            )
        self._map_topics()
        # Some files declare topics only where their messages are, so there is nothing to check yet.
        if self.topics:
            self._require_namespace()

    def _require_namespace(self) -> None:
        if self._namespace and not self.chosen:
            spaces = dict.fromkeys("/" + t.name.split("/")[1] for t in self.topics if t.name.count("/") > 1)
            raise BagError(
                f"{self.path}: no topic in the namespace {self._namespace}; expected one of {', '.join(spaces) or '/'}"
            )

    def _check_directory(self) -> None:
        if (self.path / "metadata.yaml").exists():
            return
        if any(p.suffix in SUFFIXES for p in map(plain, self.path.iterdir())):
            raise BagError(
                f"{self.path} has no metadata.yaml: the recording was cut off; "
                f"`softrig bag repair {self.path}` restores it"
            )
        below = sorted({p.parent for depth in ("*", "*/bag") for p in self.path.glob(f"{depth}/metadata.yaml")})
        more = f"; bags below it: {', '.join(map(str, below[:SHOWN]))}{', ...' * (len(below) > SHOWN)}" if below else ""
        raise BagError(f"{self.path} is not a bag: no metadata.yaml, no .mcap and no .db3 file in it{more}")

    def _file(self, name: str) -> Path:
        """Return a file of the bag: older versions name it with its folder, and it may be compressed since."""
        results = [self.path / Path(name).name]
        # An absolute path is that of the folder in which the bag was recorded; it may have been moved since.
        if not Path(name).is_absolute():
            results.insert(0, self.path / name)
        results += [p.with_name(p.name + ".zstd") for p in results] + [plain(p) for p in results]
        for path in results:
            if path.is_file():
                return path
        raise BagError(
            f"{self.path}: {name} is in metadata.yaml, but not in the folder; copy it there, or remove it by "
            f"`softrig bag repair`"
        )

    def _source(self, file: Path) -> McapSource | SqliteSource:
        with file.open("rb") as opened:
            head = opened.read(16)
        if head[:4] == b"\x28\xb5\x2f\xfd":
            self._expanded.append(Expanded(file))
            file = self._expanded[-1].path
            with file.open("rb") as opened:
                head = opened.read(16)
        if head[:8] == MAGIC:
            return McapSource(file)
        if head == _SQLITE:
            from .sqlite_source import SqliteSource

            return SqliteSource(file)
        known = next((name for begin, name in _OTHERS.items() if head.startswith(begin)), "")
        if known:
            raise BagError(f"{self.path}: {file.name} is {known}")
        raise Damaged(f"{file.name} {'is neither an MCAP file nor one of SQLite' if head else 'has 0 bytes'}")

    def _map_topics(self) -> None:
        """Create one topic of all that have a name and a type, whichever file or channel they are in."""
        for stated in self.metadata.topics:
            result = SourceTopic(stated.name, stated.msgtype, "", "", stated.digest, stated.offered, "")
            self._add(result)
        for source in self._sources:
            # Numbers of topics differ from file to file; name and type identify a topic.
            self._numbers.append({number: self._add(topic) for number, topic in source.topics.items()})

    def _add(self, topic: SourceTopic) -> int:
        """Return the number of a topic, which may be a new one."""
        msgtype = full_type(topic.msgtype) if "/" in topic.msgtype else topic.msgtype
        new = BagTopic(
            topic.name, msgtype, topic.definition, topic.digest, profiles(topic.offered), topic.language, topic.encoding
        )
        for i, old in enumerate(self.topics):
            if _is_same(old, new):
                offered = (*old.offered, *(q for q in new.offered if q not in old.offered))
                described = old if old.definition or not new.definition else new
                self.topics[i] = replace(
                    described, digest=old.digest or new.digest, offered=offered, wire=old.wire or new.wire
                )
                return i
        self.topics.append(new)
        label = self.label(topic.name) or ""
        choices = chain((label, f"{label} ({msgtype})"), (f"{label} ({msgtype}) {k}" for k in count(2)))
        self.labels.append(next(x for x in choices if x not in self.labels) if self._is_inside(topic.name) else "")
        return len(self.topics) - 1

    def _is_inside(self, name: str) -> bool:
        return not self._namespace or name.startswith(f"{self._namespace}/")

    def label(self, name: str) -> str | None:
        """Return the name of a topic as scenario files write it; None for one outside of the namespace."""
        return relative(name.removeprefix(self._namespace)) if self._is_inside(name) else None

    @property
    def chosen(self) -> list[int]:
        """Numbers of the topics in the namespace."""
        return [i for i, topic in enumerate(self.topics) if self._is_inside(topic.name)]

    # What is there ----------------------------------------------------------------------------------------------------

    @property
    def start(self) -> int:
        """Bag time of the first message in ns, as the files have it; 0 in an empty bag."""
        if self._start is None:
            blocks = map(self._inside, self._by_time([Counter() for _ in self._sources]))
            self._start = next((int(block.t[0]) for block in blocks if len(block)), 0)
        return self._start

    @property
    def end(self) -> int:
        """Bag time of the last message in ns, as the files have it; 0 in an empty bag."""
        claimed = max((s.last for s in self._sources), default=0)
        if self._counts is None and self.start <= claimed < LATEST:
            return claimed
        # There is no claim, or a wrong one, so everything has to be read.
        return self._end if self.counts else 0

    @property
    def counts(self) -> list[int]:
        """Number of messages of each topic: all of them are read once to count them, in the order of the files."""
        if self._counts is None:
            counted: list[Counter[int]] = [Counter() for _ in self._sources]
            last = 0
            for i, source in enumerate(self._sources):
                try:
                    for _, block, _ in source.blocks():
                        last = max(last, int(np.max(block.t, initial=0)))
                        plain_messages(self._inside(self._noted(counted, i, block)))
                except Damaged as error:
                    raise self._damaged(error, self.files[i]) from error
            self._end = last
            self._account(counted)
        assert self._counts is not None
        return self._counts

    @property
    def count(self) -> int:
        """Number of messages."""
        return sum(self.counts)

    def claimed(self, i: int) -> int:
        """Return how many messages a topic has as the files claim, at most one for each of their bytes."""
        result = 0
        for source, numbers in zip(self._sources, self._numbers, strict=True):
            claim = sum(source.stated.get(number, 0) for number, topic in numbers.items() if topic == i)
            result += min(claim, source.path.stat().st_size)
        return result

    @property
    def is_empty(self) -> bool:
        """Return whether the files have no message."""
        return all(s.first == LATEST for s in self._sources)

    @property
    def custom_data(self) -> dict[str, str]:
        """Return the custom data of the metadata; a single file has a copy of them."""
        return self.metadata.custom_data

    @property
    def is_whole(self) -> bool:
        """Return whether everything read so far agrees with the metadata."""
        return not self._logged

    @property
    def attachments(self) -> list[tuple[str, int]]:
        """Return name and size of the attachments and other non-message records of MCAP files."""
        return [a for s in self._sources for a in s.attachments]

    # Reading ----------------------------------------------------------------------------------------------------------

    def blocks(self, topics: Collection[int] | None = None, start: int = 0) -> Iterator[Block]:
        """Return all messages in blocks, by time, equal times as written; see `Block`.

        After a complete read, the counts are compared with those that the metadata and the files claim.

        Parameters
        ----------
        topics : collection of int, optional
            Numbers of the topics; default all.
        start : int
            First bag time in ns.
        """
        counted: list[Counter[int]] = [Counter() for _ in self._sources]
        chosen = None if topics is None else np.array(sorted(topics), np.int64)
        last = 0
        from_start = start <= (self._start or 0)
        # The whole bag is read from 0 on, because the files may claim a wrong start.
        for block in self._by_time(counted, 0 if from_start else start):
            last = int(block.t[-1])
            rows = block.t >= start
            if chosen is not None:
                rows &= np.isin(block.topic, chosen)
            result = self._inside(block if rows.all() else block.select(rows))
            if len(result):
                try:
                    yield plain_messages(result)
                except Damaged as error:
                    raise self._damaged(error) from error
        if from_start:
            self._end = last
            self._account(counted)

    def _inside(self, block: Block) -> Block:
        """Return what is in the namespace."""
        if not self._namespace:
            return block
        rows = np.isin(block.topic, self.chosen)
        return block if rows.all() else block.select(rows)

    def _by_time(self, counted: list[Counter[int]], start: int = 0) -> Iterator[Block]:
        """Merge the files, which yield their blocks by time, and yield messages as soon as none earlier can follow."""
        streams = {i: source.blocks(start) for i, source in enumerate(self._sources)}
        # No earlier message follows in a file than its bound, so that messages before all bounds are in their final
        # order.
        bounds = {i: source.first for i, source in enumerate(self._sources)}
        # A file's messages of its own bound precede those that follow in it, but not those of another file.
        several = len(bounds) > 1
        waiting: list[_Waiting] = []
        size = 0
        while streams:
            # The file that is furthest behind is read next, which keeps few messages waiting.
            i = min(streams, key=lambda k: (bounds[k], k))
            try:
                position, block, bound = next(streams[i])
            except StopIteration:
                del streams[i], bounds[i]
                continue
            except Damaged as error:
                raise self._damaged(error, self.files[i]) from error
            bounds[i] = bound - several
            waiting.append(_Waiting((i, position), self._noted(counted, i, block)))
            size += int(block.size.sum())
            if size >= BATCH and (until := min(bounds.values())) > np.min(waiting[0].block.t, initial=LATEST):
                ready, waiting = _parted(waiting, until)
                size = sum(int(w.block.size.sum()) for w in waiting)
                yield ready
        ready, _ = _parted(waiting, LATEST + 1)
        if len(ready):
            yield ready

    def _noted(self, counted: list[Counter[int]], i: int, block: Block) -> Block:
        """Count the messages of a file, and replace its topic numbers by those of the bag."""
        numbers, known = distinct(block.topic), self._numbers[i]
        counted[i].update({n: int(np.count_nonzero(block.topic == n)) for n in numbers})
        for number in numbers:
            if number not in known:
                known[number] = self._add(
                    self._sources[i].topics.get(number) or SourceTopic(f"topic {number} without a name", "")
                )
        table = np.zeros(max(known, default=0) + 1, np.int64)
        table[list(known)] = list(known.values())
        return replace(block, topic=table[block.topic])

    def messages(self, topics: Collection[str] | None = None, start: int = 0) -> Iterator[tuple[int, int, bytes]]:
        """Return (index into `topics`, bag time in ns, bytes) by time, equal times as written.

        Parameters
        ----------
        topics : collection of str, optional
            Absolute names; default all.
        start : int
            First bag time in ns.
        """
        numbers = None if topics is None else [i for i, t in enumerate(self.topics) if t.name in topics]
        for block in self.blocks(numbers, start):
            yield from block.messages()

    # Accounting -------------------------------------------------------------------------------------------------------

    def _account(self, counted: list[Counter[int]]) -> None:
        """Compare what was read with the metadata, and report each difference."""
        self._require_namespace()
        self._counts = [0] * len(self.topics)
        for numbers, result in zip(self._numbers, counted, strict=True):
            for number, n in result.items():
                self._counts[numbers[number]] += n
        for line in self.differences(counted):
            if line not in self._logged:
                self._logged.add(line)
                self._report(line)

    def differences(self, counted: list[Counter[int]]) -> Iterator[str]:
        """Describe how the read messages differ from metadata.yaml and the statistics of the files."""
        assert self._counts is not None
        for source, file, result in zip(self._sources, self.files, counted, strict=True):
            for number, described in source.topics.items():
                claimed = source.stated.get(number, 0)
                if source.stated and claimed != result[number]:
                    yield f"{described.name}: {result[number]} messages in {file.name}, its statistics claim {claimed}"
            total = sum(result.values())
            if source.stated_count is not None and not source.stated and source.stated_count != total:
                yield f"{total} messages in {file.name}, its statistics claim {source.stated_count}"
        if not self.path.is_dir():
            return
        for stated in self.metadata.topics:
            read = sum(n for t, n in zip(self.topics, self._counts, strict=True) if _is_stated(t, stated))
            claimed = sum(s.count for s in self.metadata.topics if (s.name, s.msgtype) == (stated.name, stated.msgtype))
            if claimed != read:
                yield f"{stated.name}: {read} messages in the files, metadata.yaml claims {claimed}"
        for topic, n in zip(self.topics, self._counts, strict=True):
            if n and not any(_is_stated(topic, stated) for stated in self.metadata.topics):
                yield f"{topic.name}: {n} messages in the files, metadata.yaml does not name the topic"
        total = sum(self._counts)
        if self.metadata.count not in (None, total):
            yield f"{total} messages in the files, metadata.yaml claims {self.metadata.count}"
        named = {plain(file) for file in self.files}
        for file in sorted(self.path.iterdir()):
            if plain(file).suffix in SUFFIXES and plain(file) not in named:
                yield f"{file.name} is in the folder, but not in metadata.yaml: it was not read"

    def _damaged(self, error: Exception, file: Path | None = None) -> BagError:
        location = self.path if file in (None, self.path) else f"{self.path}: {file.name}"  # type: ignore[union-attr]
        return BagError(f"{location} is damaged: {error}; `softrig bag repair` saves what is readable")

    # Types ------------------------------------------------------------------------------------------------------------

    def types(self, i: int) -> Types:
        """Return the definitions of a topic's type and of all types in it.

        Raises
        ------
        UnknownType
            There are no definitions, they cannot be read, or the messages are not encoded as CDR; the text gives the
            reason.
        """
        if i not in self._types:
            topic = self.topics[i]
            if topic.wire not in ("cdr", ""):
                raise UnknownType(f"its messages are in {topic.wire}, expected cdr")
            if not topic.msgtype:
                raise UnknownType("its channel has no schema")
            defined = types_of(topic.msgtype, topic.definition, topic.encoding) if topic.definition.strip() else {}
            distribution = distribution_of(self.metadata.distribution, self.metadata.version)
            self._types[i] = complete(topic.msgtype, defined, distribution)
        return self._types[i]

    def decoder(self, i: int) -> Decoder:
        """Return a function that makes columns of a topic's messages; raises as `types`."""
        return Decoder(self.topics[i].msgtype, self.types(i))


def _is_same(old: BagTopic, new: BagTopic) -> bool:
    """Return whether two descriptions are of one topic: name, type and encoding, and no other definition."""
    if (old.name, old.msgtype) != (new.name, new.msgtype) or (old.wire and new.wire and old.wire != new.wire):
        return False
    if not old.definition or not new.definition or old.definition == new.definition:
        return True
    try:
        first, second = (types_of(t.msgtype, t.definition, t.encoding).get(t.msgtype, (0, 0))[1] for t in (old, new))
    # A definition that cannot be read is reported when the topic is to be decoded.
    except UnknownType:
        return True
    return bool(first == second)


def _is_stated(topic: BagTopic, stated: object) -> bool:
    return (topic.name, topic.msgtype) == (stated.name, full_type(stated.msgtype))  # type: ignore[attr-defined]


def _parted(waiting: list[_Waiting], bound: int) -> tuple[Block, list[_Waiting]]:
    """Return the messages before a time in their order, and the remaining ones."""
    ready, left = [], []
    for rank, block in sorted(waiting, key=lambda w: w.rank):
        early = block.t < bound if bound <= LATEST else np.ones(len(block), bool)
        if early.all():
            ready.append(block)
        else:
            ready.append(block.select(early))
            remaining = block.select(~early)
            left.append(
                _Waiting(rank, remaining.compact() if 2 * remaining.size.sum() < len(remaining.raw) else remaining)
            )
    released = joined([b for b in ready if len(b)])
    if len(released) and (np.diff(released.t) < 0).any():
        released = released.select(np.argsort(released.t, kind="stable"))
    return released, left
