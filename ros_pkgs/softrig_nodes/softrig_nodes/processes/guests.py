"""The external nodes of a run."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Set
from difflib import get_close_matches
from typing import Any

from softrig_core.rig.rig import Rig

from .peers import has_own_reader

UNSEEN = 10.0  # s: on one host ROS finds a node within 3 s
# With LOCALHOST a participant of Cyclone DDS is found only by unicast.
CYCLONE = (
    '<CycloneDDS><Domain><General><Interfaces><NetworkInterface name="lo"/></Interfaces>'
    '<AllowMulticast>false</AllowMulticast></General><Discovery><Peers><Peer address="127.0.0.1"/></Peers></Discovery>'
    "</Domain></CycloneDDS>"
)
HINT = f"where it runs on Cyclone DDS: export CYCLONEDDS_URI='{CYCLONE}'"


class Guests:
    """Reports what users must start for a run, and when these external nodes have joined."""

    def __init__(self, rig: Rig, announce: Callable[[str], object] | None) -> None:
        self._announce = announce
        self._needed = {
            m.name: {p.topic for p in m.outputs if has_own_reader(rig.readers(m, p))} for m in rig.members if m.external
        }
        self._rig = rig
        self._reported: set[str] = set()
        self._awaited = [name for name, topics in self._needed.items() if topics]
        self._since = time.monotonic()

    def invite(self, domain: int) -> None:
        """Report which external nodes are expected, in which domain, and with which topics."""
        if self._announce is None or not self._needed:
            return
        names = ", ".join(self._awaited or self._needed)
        lines = [
            f"waiting for {names} (without limit, or for --wait S; Ctrl-C ends); in another terminal:",
            f"  export ROS_DOMAIN_ID={domain} ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST",
        ]
        for m in self._rig.members:
            for p in m.outputs if m.external else ():
                verb = "must publish" if p.topic in self._needed[m.name] else "may publish"
                lines.append(f"  {m.name} {verb} {p.topic} ({p.msgtype}, {', '.join(p.labels)})")
            lines += [f"  {m.name} can read {p.topic} ({p.msgtype})" for p in m.inputs if m.external]
        self._announce("\n".join(lines))

    def check(self, states: Mapping[str, Mapping[str, Any]]) -> None:
        """Report nodes that have joined since the last call and, once, what prevents others from joining.

        Parameters
        ----------
        states : mapping
            Status of each of our nodes, by name (`softrig_nodes.adapter.account.Account.status`).
        """
        if not self._needed:
            return
        for name, state in states.items():
            for topic, (_, why) in state.get("refused", {}).items():
                self._once(f"{name} refuses {topic}", f"{name} refused a message on {topic}: {why}")
        if not self._awaited or any("lacking" not in s for s in states.values()):
            # Until each of our nodes reports what it lacks, an external node may look present although it is not.
            return
        for state in states.values():
            for key, (_, text, _) in state.get("reports", {}).items():
                if key.startswith("type of "):
                    self._once(text, text)
        lacking = {topic for s in states.values() for topic in s["lacking"]}
        for name in [n for n in self._awaited if not self._needed[n] & lacking]:
            self._awaited.remove(name)
            self._once(f"{name} is there", f"{name} is there")
        for state in states.values():
            self._name_strays(lacking, state.get("published", {}))
        if self._awaited and time.monotonic() - self._since > UNSEEN:
            names = ", ".join(self._awaited)
            self._once("unseen", f"{names}: not seen for {UNSEEN:g} s; {HINT}")

    def _name_strays(self, lacking: Set[str], published: Mapping[str, list[tuple[str, str]]]) -> None:
        """Report nodes that publish the type of an awaited topic under a name that the rig does not know."""
        awaited = {
            p.topic: (m.name, p.msgtype)
            for m in self._rig.members
            if m.external
            for p in m.outputs
            if p.topic in lacking
        }
        known = {f"/{topic.lstrip('/')}" for topic in self._rig.topics}
        rig_nodes = {f"/{m.name}" for m in self._rig.members if not m.external}
        for topic, writers in published.items():
            for msgtype, publisher in writers if topic not in known else ():
                fitting = [t for t, (_, wanted) in awaited.items() if wanted == msgtype and publisher not in rig_nodes]
                for meant in get_close_matches(topic, fitting, 1, 0.0):
                    self._once(
                        f"stray {topic}",
                        f"{publisher} publishes {topic}, which nobody in the rig reads; "
                        f"{meant} is awaited from {awaited[meant][0]}",
                    )

    def _once(self, key: str, text: str) -> None:
        if key not in self._reported:
            self._reported.add(key)
            if self._announce is not None:
                self._announce(text)
