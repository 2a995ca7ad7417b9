"""Selection of topics by names, regular expressions and hidden names."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from ..content.topics import absolute, checked_namespace
from ..errors import BagError

_NAME = re.compile(r"/?[A-Za-z_]\w*(/[A-Za-z_]\w*)*", re.ASCII)


@dataclass(frozen=True)
class Selection:
    """A choice of topics.

    Parameters
    ----------
    names : tuple of str
        Absolute names.
    regex, exclude : re.Pattern, optional
        Searched for in the absolute name.
    namespace : str
        Namespace of the topics that are not named, with a leading slash; empty for the root.
    """

    names: tuple[str, ...] = ()
    regex: re.Pattern[str] | None = None
    exclude: re.Pattern[str] | None = None
    namespace: str = ""

    @classmethod
    def of(cls, names: Sequence[str], regex: str = "", exclude: str = "", namespace: str = "") -> Selection:
        """Create a selection from the command line; names without a leading slash are in the namespace.

        Raises
        ------
        BagError
            Not a name of a topic, or not a regular expression.
        """
        for name in names:
            if not _NAME.fullmatch(name):
                raise BagError(f"{name!r} is not the name of a topic; ROS arguments come after --ros-args")
        patterns = []
        for text in (regex, exclude):
            try:
                patterns.append(re.compile(text) if text else None)
            except re.error as error:
                raise BagError(f"regular expression {text!r}: {error}") from None
        prefix = checked_namespace(namespace)
        full = tuple(n if n.startswith("/") else prefix + absolute(n) for n in names)
        return cls(full, patterns[0], patterns[1], prefix)

    def __contains__(self, topic: str) -> bool:
        if topic in self.names:
            return True
        if self.namespace and not topic.startswith(f"{self.namespace}/"):
            return False
        if self.exclude and self.exclude.search(topic):
            return False
        if self.regex:
            return bool(self.regex.search(topic))
        # ROS hides topics with a part that begins with an underscore; a tool takes them only if they are requested.
        return not self.names and "/_" not in topic
