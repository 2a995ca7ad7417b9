"""What the readers of a bag's storage files have in common: topics, stated counts, what else is in a file."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple


class Damaged(Exception):
    """A file is not as its format demands; `softrig bag repair` helps."""


class SourceTopic(NamedTuple):
    """A topic as a file describes it: QoS as text or list, encoding of the messages as named there."""

    name: str
    msgtype: str
    definition: str = ""
    language: str = ""
    digest: str = ""
    offered: Any = ""
    encoding: str = "cdr"


@dataclass
class Source:
    """One storage file that is open for reading.

    Parameters
    ----------
    path : Path
        Of the file.

    Attributes
    ----------
    topics : dict of int to SourceTopic
        By number, those that have been met so far.
    stated : dict of int to int
        Messages by topic as the statistics of the file claim; empty where it has none.
    metadata : str
        What rosbag2 left in the file: its metadata as YAML.
    attachments : list of (str, int)
        Name and bytes of each.
    """

    path: Path
    topics: dict[int, SourceTopic] = field(default_factory=dict)
    stated: dict[int, int] = field(default_factory=dict)
    stated_count: int | None = None
    metadata: str = ""
    attachments: list[tuple[str, int]] = field(default_factory=list)
