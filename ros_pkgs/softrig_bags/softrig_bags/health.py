"""Further contents of an externally recorded bag: descriptions, node health, figures of observers.

They are the final values that the nodes reported, so equal runs still produce equal bags. A bag uses a rig's own names,
without the namespace in which it was launched. `hardware_id`, which distinguishes rigs while they run, is empty.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from softrig_core import Recording

from .scenery import STRING, add, header, make

ARRAY = "diagnostic_msgs/msg/DiagnosticArray"


def with_health(recording: Recording, texts: Mapping[str, str], status: Mapping[str, Mapping[str, Any]]) -> Recording:
    """Return a recording extended by the reports of the nodes.

    Parameters
    ----------
    texts : mapping of str to str
        Topic to its latched text, such as ``robot_description``; topics that are already recorded stay unchanged.
    status : mapping of str to mapping
        Of each node: ``reports`` (key to level, text and count), ``figures`` of an observer (name to value and unit).

    Returns
    -------
    Recording
        The same messages, with the texts at the first stamp. At the last stamp it also has ``diagnostics`` (one status
        per node) and ``NODE/metrics`` of each observer.
    """
    ticks = [topic.ticks() for topic in recording.topics.values()]
    times = [int(t) for each in ticks for t in (*each[:1], *each[-1:])]
    if not times:
        return recording
    texts = {topic: text for topic, text in texts.items() if topic not in recording.topics}
    observers = {f"{name}/metrics": s["figures"] for name, s in status.items() if s.get("figures")}
    result = recording.with_topics(
        [*((topic, STRING) for topic in texts), ("diagnostics", ARRAY), *((topic, ARRAY) for topic in observers)]
    )
    for topic, text in texts.items():
        add(result, topic, STRING, min(times), data=text)
    end = max(times)
    health = [_status(name, s) for name, s in sorted(status.items())]
    add(result, "diagnostics", ARRAY, end, header=header(end, "world"), status=health)
    for topic, figures in observers.items():
        values = {name: f"{value:.9g} {unit}".strip() for name, (value, unit) in figures.items()}
        message = _message(topic.removesuffix("/metrics"), 0, "", values)
        add(result, topic, ARRAY, end, header=header(end, "world"), status=[message])
    return result


def _status(name: str, status: Mapping[str, Any]) -> Any:
    reports = status.get("reports", {})
    level = max((level for level, _, _ in reports.values()), default=0)
    values = {key: f"{count} x {text}" for key, (_, text, count) in reports.items()}
    values |= {f"refused {topic}": str(count) for topic, (count, _) in status.get("refused", {}).items()}
    return _message(f"/{name}", level, status.get("error") or "done", values)


def _message(name: str, level: int, text: str, values: Mapping[str, str]) -> Any:
    pairs = [make("diagnostic_msgs/msg/KeyValue", key=key, value=value) for key, value in values.items()]
    return make(
        "diagnostic_msgs/msg/DiagnosticStatus", level=level, name=name, message=text, hardware_id="", values=pairs
    )
