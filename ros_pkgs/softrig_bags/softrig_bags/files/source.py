"""Interface of a bag's storage file: its topics, its stated counts, and its messages in blocks by time."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from ..content.block import Block


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


class Source(Protocol):
    """One storage file that is open for reading."""

    path: Path
    topics: dict[int, SourceTopic]
    stated: dict[int, int]
    stated_count: int | None
    metadata: str
    attachments: list[tuple[str, int]]

    @property
    def first(self) -> int:
        """Bag time before which it has no message, ns."""

    @property
    def last(self) -> int:
        """Bag time after which it has no message, ns."""

    def blocks(self, start: int = 0) -> Iterator[tuple[int, Block, int]]:
        """Yield blocks, each with its place in the file and the time before which no further message follows.

        Parameters
        ----------
        start : int
            Blocks that end earlier may be left out.
        """

    def close(self) -> None:
        """Close the file."""
