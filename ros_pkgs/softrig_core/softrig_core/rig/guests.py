"""The external nodes of a run."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from .children import Child, read_status
from .peers import ours
from .rig import Rig


class Guests:
    """The external nodes of a run: says what they are to do, and when they have come."""

    def __init__(self, rig: Rig, announce: Callable[[str], object] | None) -> None:
        self._announce = announce
        self._needed = {
            m.name: {p.topic for p in m.outputs if ours(rig.readers(m, p))} for m in rig.members if m.external
        }  # fmt: skip
        self._rig = rig
        self._warned: set[str] = set()
        self._awaited = [name for name, topics in self._needed.items() if topics]

    def invite(self, domain: int) -> None:
        """Say who is expected, where, and with what."""
        if self._announce is None or not self._needed:
            return
        who = ", ".join(self._awaited or self._needed)
        lines = [f"waiting for {who} (as long as it takes or --wait says; Ctrl-C ends); in another terminal:",
                 f"  export ROS_DOMAIN_ID={domain} ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST"]  # fmt: skip
        for m in self._rig.members:
            for p in m.outputs if m.external else ():
                verb = "must publish" if p.topic in self._needed[m.name] else "may publish"
                lines.append(f"  {m.name} {verb} {p.topic} ({p.msgtype}, {', '.join(p.labels)})")
            lines += [f"  {m.name} can read {p.topic} ({p.msgtype})" for p in m.inputs if m.external]
        self._announce("\n".join(lines))

    def look(self, children: list[Child]) -> None:
        """Say who has come since the last look."""
        if not self._awaited:
            return
        states = [read_status(c.status) for c in children]
        if any("lacking" not in s for s in states):
            return  # not all of ours are there themselves
        self._warn(states)
        lacking = {topic for s in states for topic in s["lacking"]}
        for name in [n for n in self._awaited if not self._needed[n] & lacking]:
            self._awaited.remove(name)
            if self._announce is not None:
                self._announce(f"{name} is there")

    def _warn(self, states: list[dict[str, Any]]) -> None:
        """Say, once, who cannot be heard because of its type."""
        for state in states:
            for key, (_, text, _) in state.get("reports", {}).items():
                if key.startswith("type of ") and text not in self._warned:
                    self._warned.add(text)
                    if self._announce is not None:
                        self._announce(text)
