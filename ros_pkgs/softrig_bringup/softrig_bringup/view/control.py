"""Control of a running rig from pages: knobs, buttons, pause, step and pace; all pages share one instance."""

from __future__ import annotations

import math
import re
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, get_args, get_origin

from softrig_core import Rig, ScenarioError
from softrig_core.block.change import changeable
from softrig_core.block.params import LARGEST, Params, declarations, flatten
from softrig_core.rig.members import Member
from softrig_core.scenario.faults import EXECUTABLE, PACKAGE
from softrig_core.scenario.yaml_file import read_yaml

KEPT = 100  # lines of messages that are kept
# The order in which a page shows the knobs of nodes.
ROLES = ("law", "fault", "command", "observer", "source", "plant")

Answer = Callable[[bool, str], object]
Ask = Callable[[Mapping[str, Any], Answer], object]


@dataclass
class Knob:
    """A parameter that may change now.

    Parameters
    ----------
    value : Any
        The newest value that the node has accepted.
    bounds : (float, float)
        As declared; infinite where nothing was.
    idle : bool
        Whether it belongs to a law or kind that is not the chosen one.
    """

    node: str
    name: str
    unit: str
    doc: str
    value: Any
    kind: type
    bounds: tuple[float, float]
    idle: bool = False

    @property
    def key(self) -> str:
        """Its name as scenarios write it."""
        return f"{self.node}.{self.name}"

    @property
    def number(self) -> bool:
        """Return whether it is one number."""
        return self.kind in (int, float) and isinstance(self.value, int | float | None)

    def read(self, text: str) -> Any:
        """Convert text that a user has typed to a value.

        Raises
        ------
        ScenarioError
            The text is not a valid value.
        """
        if self.kind is str:
            return text
        if not self.number:
            value = read_yaml(text, self.key)
            if value is None:
                raise ScenarioError(f"{self.key}: expected a value")
            return value
        expected = "a whole number" if self.kind is int else "a number, such as 2.5 or 1e-3"
        try:
            return self.kind(text)
        except ValueError:
            raise ScenarioError(f"{self.key} = {text!r} refused: expected {expected}") from None


class Entry(NamedTuple):
    """A line for the page: time in the run (s), author, text, and whether the change was refused."""

    t: float
    author: str
    text: str
    wrong: bool


class Control:
    """The live parameters (knobs) and buttons of a rig, as a page shows them.

    Parameters
    ----------
    ask : callable
        Called with a request (`softrig_nodes.ros.remote`) and a callback for its answer; None if requests are not
        possible.
    now : callable
        Returns the time of the run, s.
    over : callable
        Returns how the run ended; empty while the run is under way.
    held : bool or None
        Whether the run is paused; None if it cannot be paused.
    pace : float or None
        Ratio of simulated to wall-clock time; 0: as fast as possible; None: in real time.

    Attributes
    ----------
    knobs : dict of str to Knob
        By `Knob.key`, those of the controllers first.
    roles : dict of str to str
        Role of each node with a knob, see `role`.
    lines : int
        Number of lines so far.
    goes_back : bool
        Whether the run can go back to an earlier time.
    """

    goes_back = False

    def __init__(
        self,
        rig: Rig,
        ask: Ask | None,
        now: Callable[[], float],
        over: Callable[[], str],
        held: bool | None = None,
        pace: float | None = 0.0,
    ) -> None:
        self._ask, self._now, self._over = ask, now, over
        self.held, self.pace = held, pace
        self.clock = rig.clock.name
        members = [m for m in rig.members if not m.external] if ask is not None else []
        roles = {m.name: role(rig, m) for m in members}
        first = sorted(members, key=lambda m: ROLES.index(roles[m.name]))
        self.knobs = {k.key: k for m in first for k in _knobs(m)}
        self.roles = {knob.node: roles[knob.node] for knob in self.knobs.values()}
        self.buttons = [
            (m.name, p.name)
            for m in members
            for p in m.inputs
            if p.msgtype == "std_msgs/msg/Bool" and p.name not in m.links
        ]
        self.entries: deque[Entry] = deque(maxlen=KEPT)
        self.lines = 0

    def add_entry(self, author: str, text: str, wrong: bool = False) -> None:
        """Add a line to the log on all pages."""
        self.entries.append(Entry(self._now(), author, text, wrong))
        self.lines += 1

    def turn(self, author: str, key: str, value: Any) -> None:
        """Change a parameter; the outcome is shown on all pages."""
        knob = self.knobs[key]
        value = float(value) if knob.kind is float and isinstance(value, int) and not isinstance(value, bool) else value

        def answered(done: bool, reason: str) -> None:
            if done:
                knob.value = value
            self.add_entry(
                author,
                f"{key} = {_shown(value)} {knob.unit}".rstrip() + ("" if done else f" refused: {reason}"),
                not done,
            )

        self._send(author, f"{key} = {_shown(value)}", {"node": knob.node, "set": {knob.name: value}}, answered)

    def press(self, author: str, node: str, name: str) -> None:
        """Press a button of the rig."""
        self._call(author, node, name, f"{node}/{name}")

    def hold(self, author: str, action: str) -> None:
        """Pause, resume or step the run."""

        def after() -> None:
            if action != "step":
                self.held = action == "pause"

        self._call(author, self.clock, action, action, after)

    def go_back(self, author: str, t: float) -> None:
        """Return to a time of the run, s; this is possible after its end, too."""

        def answered(done: bool, reason: str) -> None:
            self.add_entry(author, reason if done else f"back to {t:g} s refused: {reason}", not done)

        assert self._ask is not None
        self._ask({"node": self.clock, "back": t}, answered)

    def go_at(self, author: str, pace: float) -> None:
        """Set the pace: simulated seconds for each second of wall clock; 0 means as fast as possible."""
        text = f"pace {pace:g}" if pace else "as fast as it goes"

        def answered(done: bool, reason: str) -> None:
            if done:
                self.pace = pace
            self.add_entry(author, text if done else f"{text} refused: {reason}", not done)

        self._send(author, text, {"node": self.clock, "set": {"run.pace": pace}}, answered)

    def _call(self, author: str, node: str, name: str, text: str, after: Callable[[], object] = lambda: None) -> None:
        def answered(done: bool, reason: str) -> None:
            if done:
                after()
            self.add_entry(author, f"{text}: {reason}" if done else f"{text} refused: {reason}", not done)

        self._send(author, text, {"node": node, "call": name}, answered)

    def _send(self, author: str, text: str, request: Mapping[str, Any], answered: Answer) -> None:
        if over := self._over():
            self.add_entry(author, f"{text} refused: the run is over ({over})", True)
        elif self._ask is None:
            self.add_entry(author, f"{text} refused: this is a recording", True)
        else:
            self._ask(request, answered)

    def log_change(self, t: float, node: str, values: Mapping[str, Any]) -> None:
        """Add a line for a change that a node has recorded, from any source."""
        for name, value in values.items():
            if (knob := self.knobs.get(f"{node}.{name}")) is not None:
                knob.value = value
            self.entries.append(Entry(t, node, f"{name} = {_shown(value)} from this tick on", False))
            self.lines += 1


def role(rig: Rig, member: Member) -> str:
    """Return the role of a node for tuning, one of `ROLES`; a node on a feedback loop of the plant is a law."""
    if (member.package, member.executable) == (PACKAGE, EXECUTABLE):
        return "fault"
    if member.is_plant:
        return "plant"
    if not member.links:
        return "source"
    plants = [m for m in rig.members if m.is_plant]
    leads = any(member in _before(plant) for plant in plants)
    if leads and not _before(member).isdisjoint(plants):
        return "law"
    return "command" if leads else "observer"


def _before(member: Member) -> set[Member]:
    """Return the nodes whose messages a node depends on, those of others included."""
    result: set[Member] = set()
    left = [member]
    while left:
        new = {link.source for link in left.pop().links.values()} - result
        result |= new
        left += new
    return result


def _knobs(member: Member) -> list[Knob]:
    live, values = changeable(type(member.params)), flatten(member.params)
    choices = _choices(type(member.params))
    known = {choice for name, owners in choices.items() for choice in owners if isinstance(values[name], str)}
    chosen = {values[name] for name in choices}
    result = []
    for d in declarations(type(member.params)):
        if d.name in live:
            low = -math.inf if d.lower is None or d.lower <= -LARGEST else float(d.lower)
            high = math.inf if d.upper is None or d.upper >= LARGEST else float(d.upper)
            owners = _owners(d.name, d.doc) & known
            idle = bool(owners) and not owners & chosen
            result.append(Knob(member.name, d.name, d.unit, d.doc, values[d.name], d.type, (low, high), idle))
    return result


def _choices(model: type[Params], prefix: str = "") -> dict[str, tuple[str, ...]]:
    """Return the parameters that choose one of some words, as a law, by dotted name."""
    result: dict[str, tuple[str, ...]] = {}
    for name, field in model.model_fields.items():
        kind = field.annotation
        if isinstance(kind, type) and issubclass(kind, Params):
            result |= _choices(kind, f"{prefix}{name}.")
        elif get_origin(kind) is Literal:
            result[prefix + name] = get_args(kind)
    return result


def _owners(name: str, doc: str) -> set[str]:
    """Return the possible choices that a parameter belongs to: ``smc.k``, ``ideal, series: ...``, ``of `delay`,
    ...``.
    """
    before = re.match(r"([\w ,]+): ", doc)
    names = re.split(r", | and ", before[1]) if before else re.findall(r"`(\w+)`", doc)
    return {*names, *name.split(".")[:-1]}


def _shown(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)
