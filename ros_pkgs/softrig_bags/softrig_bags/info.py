"""Summary of a bag's contents as text."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

from softrig_core import SECOND

from .content.definitions import UnknownType
from .files.reader import BagReader
from .read import WALL_CLOCK


def describe(path: Path | str) -> str:
    """Return files, times, topics and the writer's notes of a bag.

    Raises
    ------
    BagError
        No bag there, or it is damaged.
    """
    with BagReader(path) as bag:
        counts = bag.counts
        size = sum(f.stat().st_size for f in bag.files)
        lines = [f"{bag.path}: {', '.join(f.name for f in bag.files)}, {size / 1e6:.3g} MB"]
        start = f"{bag.start / SECOND:.9g} s"
        if bag.start >= WALL_CLOCK:
            start = datetime.fromtimestamp(bag.start / SECOND, UTC).isoformat(" ", "milliseconds")
        lines.append(f"{bag.count} messages in {(bag.end - bag.start) / SECOND:.9g} s from {start}")
        # A name in a damaged bag may contain line breaks, which would break the table.
        names = [" ".join(topic.name.split()) for topic in bag.topics]
        width = max(map(len, names), default=0)
        for i, (topic, count) in enumerate(zip(bag.topics, counts, strict=True)):
            profiles = {(q.reliability.name.lower(), q.durability.name.lower()) for q in topic.offered}
            offered = "; ".join(" ".join(p) for p in sorted(profiles)) or "QoS unknown"
            lines.append(f"  {names[i]:{width}}  {count:8}  {topic.msgtype}  ({offered})")
            try:
                bag.types(i)
            except UnknownType as error:
                lines.append(f"  {'':{width}}            cannot be decoded: {error}")
        lines += [f"  attachment {name}: {length} bytes" for name, length in bag.attachments]
        lines += [f"  {key}: {value}" for key, value in bag.custom_data.items()]
        return "\n".join(lines)
