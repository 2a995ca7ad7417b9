"""A block whose ticks are answered by a board; it replaces the block that the firmware was generated from."""

from __future__ import annotations

import hashlib
import json
import os
import struct
from collections.abc import Callable, Mapping
from contextlib import suppress
from fractions import Fraction
from functools import lru_cache
from pathlib import Path
from typing import Any, ClassVar

from ..block.block import Block, Level, Plant, finishes
from ..block.params import flatten
from ..block.port import Sample
from ..errors import RunError, ScenarioError
from .ads_line import ads_line
from .can_line import can_line
from .dbc import build_of
from .description import read_description
from .elsewhere import Elsewhere, LinkState
from .entry import LinkEntry, absolute_port, contents_of
from .frames import Kind
from .layout import Layout
from .line import Build, Line
from .wires import opened

BAUD = 115200  # bits a second of a serial port
PART = 0.5  # share of its period for which a node waits for its board in real time
DONE, GAVE_UP = 0, 1


class Linked(Elsewhere):
    """Answers each tick with the answer of a board.

    In lockstep a frame is sent again until it is answered, and the board runs exactly one step for it. In real time the
    answer must arrive within half a period, otherwise the safe values are published. Late and lost frames are counted
    in /diagnostics.
    """

    ENTRY: ClassVar[LinkEntry]
    FIRMWARE: ClassVar[Mapping[str, Any]]
    SCRATCH = frozenset({"_lines"})  # the open port, of which there is one at most

    def setup(self) -> None:
        """Prepare the frames; the port is opened with the first tick."""
        super().setup()
        self._lines: list[Any] = []
        inputs, outputs = self.ports(self.p)
        settable = _settable(self.FIRMWARE, self.p)
        single = self.FIRMWARE["real"] == "float"
        layout = self._layout = Layout(inputs, outputs, settable, isinstance(self, Plant), single)
        over, under = self.FIRMWARE["period_s"]
        self._build = Build(self.FIRMWARE["digest"], (over, under), layout)
        known = flatten(self.p)
        self._params = _packed(layout.params, [convert(known[name]) for name, convert in settable.items()])
        self._safe = {p.name: p.safe for p in outputs if not p.sporadic}
        self._delayed = frozenset(p.name for p in outputs if p.delayed)
        kind = self.ENTRY.port.partition(":")[0]
        openers: Mapping[str, Any] = {"can": can_line, "ads": ads_line}
        self._made: Callable[[Any], Any] = openers.get(kind, _serial_line)(self.ENTRY, self.name, self._build)

    @classmethod
    def fixed(cls, params: Any) -> Any:
        """Return the parameters that are compiled into the board's program and cannot change."""
        settable = cls.FIRMWARE["settable"]
        return {k: v for k, v in flatten(params).items() if k not in settable}

    @classmethod
    def contents(cls, params: Any) -> Mapping[str, str]:
        """Return the digest of the firmware's description."""
        text = json.dumps(cls.FIRMWARE, sort_keys=True)
        return {"firmware": hashlib.sha256(text.encode()).hexdigest()}

    def save(self, x: LinkState) -> Any:
        """Refuse: the state is on the board.

        Raises
        ------
        RunError
        """
        raise RunError(f"{self.name}: the state is on the board at {self.ENTRY.port} and cannot be saved")

    def refused(self, x: LinkState, t: int) -> tuple[LinkState, Any]:
        """Publish the last values: the board does not see the tick, as it would not see the bad input."""
        return x, None

    def health(self, x: LinkState) -> Mapping[str, str]:
        """Return the events on the line."""
        if not self._lines:
            return {"board": "not connected yet"}
        line = self._lines[0]
        return {"board": f"{self.ENTRY.port}, {line.counts.sent} frames; {line.remarks() or 'all answered'}"}

    def void(self, x: LinkState) -> str:
        """Return why a run in real time is not judged: no answer arrived, or none in the timeout before its end."""
        if not self.realtime or not self._lines:
            return ""
        line = self._lines[0]
        last = line.served[0]
        if last >= 0 and (x.k - 1 - last) * self.p.period <= self.ENTRY.timeout:
            return ""
        since = f"after {last * self.p.period:.6g} s" if last >= 0 else "at any time"
        return f"no answer came from {line.port} {since}, so the run is no evidence about this node"

    def asked(self, x: LinkState, t: int, row: list[Any]) -> Mapping[str, Any]:
        """Return the answer of the board to a tick.

        Parameters
        ----------
        row : list of number
            Of the frame of a step.

        Raises
        ------
        RunError
            Lockstep: the board does not answer, or its code has discarded the tick.
        """
        line = self._connected(x)
        remarks = line.remarks()
        values = _packed(self._layout.step, row)
        answer = self._live(line, x.k, values) if self.realtime else self._paired(line, x.k, values)
        if answer is not None and len(answer) != self._layout.answer.size:
            refused = str(answer[0]) if answer else "missing"
            raise RunError(f"the board at {line.port} refuses a step (status {refused})")
        result = None if answer is None else self._layout.answer.unpack(answer)
        status = (
            "no answer" if result is None else "" if result[0] == DONE else f"the board gave up (status {result[0]})"
        )
        if status and not self.realtime:
            raise RunError(f"{status}: an error in the block, or a number beyond the limit of its port")
        if line.remarks() != remarks:
            self.report(Level.WARN, "link", line.remarks())
        if status or result is None:
            self.report(Level.ERROR, "board", f"{status}: the safe values are published")
            return {name: Sample(t, row) if name in self._delayed else row for name, row in self._safe.items()}
        self.withdraw("board")
        return self._layout.outputs_of(result)

    def _connected(self, x: LinkState) -> Any:
        """Return the line, whose next request begins a session where the block is at its first state."""
        if not self._lines:
            self._lines.append(_line(self.ENTRY, self.name, self._made))
        line = self._lines[0]
        if x.k == 0:
            line.begin(self._params)
            line.served = -1, b"", b""
            line.accepted = self._params
        return line

    def _live(self, line: Any, k: int, values: bytes) -> bytes | None:
        wait = min(self.ENTRY.timeout, PART * self.p.period)
        if line.accepted != self._params:
            if line.joined and line.try_ask(Kind.PARAMS, self._params, wait) is None:
                return None
            line.accepted = self._params
        answer: bytes | None = line.try_ask(Kind.STEP, values, wait)
        if answer is not None:
            line.served = k, b"", answer
        return answer

    def _paired(self, line: Any, k: int, values: bytes) -> bytes:
        if (k, values) == line.served[:2]:  # the same tick again
            return line.served[2]
        if k not in (0, line.served[0] + 1):
            raise RunError(f"the board at {line.port} cannot go back to an earlier tick: its state is not known here")
        if line.accepted != self._params:
            line.ask(Kind.PARAMS, self._params)
            line.accepted = self._params
        answer = line.ask(Kind.STEP, values)
        line.served = k, values, answer
        return answer


class LinkedLaw(Linked):
    """A controller on a board."""

    def update(self, x: LinkState, t: int, **inputs: Any) -> tuple[LinkState, Mapping[str, Any]]:
        """Return the answer of the board to the inputs."""
        return LinkState(x.k + 1), self.asked(x, t, [t, *self._layout.numbers(inputs)])


class LinkedPlant(Linked):
    """A plant on a board: a frame advances it and returns its next outputs."""

    def outputs(self, x: LinkState, t: int) -> Mapping[str, Any]:
        """Return the answer of the board."""
        moved = x.moved or (t, *self._layout.numbers({}))
        return self.asked(x, t, [bool(x.moved), moved[0], t, *moved[1:]])

    def advance(self, x: LinkState, t: int, **inputs: Any) -> LinkState:
        """Keep the inputs for the next frame."""
        return LinkState(x.k + 1, (t, *self._layout.numbers(inputs)))


def linked(block: type[Block], entry: LinkEntry, params: Any, label: str) -> type[Block]:
    """Return the class of a node whose block runs on a board.

    Parameters
    ----------
    block : type of Block
        Block that the firmware was generated from.
    params : BlockParams
        Parameters of the node; those that are compiled into the build must be the same.
    label : str
        Place of the entry, for errors.

    Raises
    ------
    ScenarioError
        The firmware cannot be read, or is of another block or of other parameters.
    """
    if issubclass(block, Linked):  # the rig may be made again with other parameters
        block = block.__bases__[1]
    if finishes(block):
        raise ScenarioError(f"{label}: link: a block that publishes at the end of a run can only run in this process")
    file, known = _of_signals(block, entry, params) if entry.shared else _of_board(block, entry, params, label)
    absolute = entry.model_copy(update={"firmware": str(file.resolve()), "port": absolute_port(entry.port)})
    return _class(block, absolute, json.dumps(known))  # type: ignore[arg-type]  # mypy: a class has no hash


def _of_signals(block: type[Block], entry: LinkEntry, params: Any) -> tuple[Path, Mapping[str, Any]]:
    """Return the file with the signals of a node, and the requirements of its program."""
    file, text = Path(entry.firmware), b""
    with suppress(OSError, ValueError):  # errors are reported where the node's name is known
        text = contents_of(file)
    period = Fraction(params.period).limit_denominator(10**9)
    known = {
        "digest": build_of(block, params),
        "period_s": period.as_integer_ratio(),
        "settable": [],
        "parameters": {},
        "real": "double",
        "signals": hashlib.sha256(text).hexdigest(),
    }
    return file, known


def _of_board(block: type[Block], entry: LinkEntry, params: Any, label: str) -> tuple[Path, Mapping[str, Any]]:
    """Return the description of a board's firmware, and its content."""
    file = Path(entry.firmware)
    if file.is_dir():
        results = sorted(file.glob("*.json"))
        if len(results) != 1:
            raise ScenarioError(f"{label}: link: {file} has {len(results)} JSON files, expected one; name the file")
        file = results[0]
    try:
        known = read_description(file).model_dump(mode="json", by_alias=True, exclude={"node"})
    except OSError as error:
        raise ScenarioError(f"{label}: link: {file}: {error.strerror}; `softrig export` writes it") from None
    except ValueError as error:
        raise ScenarioError(
            f"{label}: link: {file} is not a description of firmware ({error}); `softrig export` writes it"
        ) from None
    _check(block, params, known, f"{label}: link: {file}")
    return file, known


@lru_cache(maxsize=64)
def _class(block: type[Block], entry: LinkEntry, known: str) -> type[Block]:
    base = LinkedPlant if issubclass(block, Plant) else LinkedLaw
    body = {"ENTRY": entry, "FIRMWARE": json.loads(known), "__module__": block.__module__, "__doc__": block.__doc__}
    return type(block.__name__, (base, block), body | {"__qualname__": block.__qualname__})


def _check(block: type[Block], params: Any, known: Mapping[str, Any], label: str) -> None:
    """Ensure that firmware is of a block with these parameters."""
    name = f"{block.__module__}:{block.__qualname__}"
    if known["class"] != name:
        raise ScenarioError(f"{label} is firmware of {known['class']}, expected {name}")
    inputs, outputs = block.ports(params)
    wanted = [(side, p.name, list(p.labels)) for side, ports in (("in", inputs), ("out", outputs)) for p in ports]
    actual = [(p["direction"], p["name"], [v["label"] for v in p["values"]]) for p in known["ports"]]
    if wanted != actual:
        raise ScenarioError(f"{label} has the ports {actual}, expected {wanted}; export it again")
    compiled, expected = known["parameters"], json.loads(json.dumps(flatten(params), default=str))
    for key, value in expected.items():
        if key not in known["settable"] and value != compiled.get(key):
            raise ScenarioError(
                f"{label} has {key} = {str(compiled.get(key))[:100]} compiled in, expected {value}; export it again"
            )


def _settable(known: Mapping[str, Any], params: Any) -> dict[str, type]:
    values = flatten(params)
    return {name: type(known["parameters"][name]) for name in known["settable"] if name in values}


def _packed(layout: struct.Struct, row: list[Any]) -> bytes:
    """Return numbers packed for the board.

    Raises
    ------
    RunError
        One does not fit the board's numbers.
    """
    try:
        return layout.pack(*row)
    except (OverflowError, struct.error) as error:
        raise RunError(f"a number does not fit the board's ({error})") from None


_lines: dict[tuple[int, str, int, str], Any] = {}  # ports of this process: opening a port again would reset its board


def _line(entry: LinkEntry, node: str, open_line: Callable[[Any], Any]) -> Any:
    key = os.getpid(), entry.port, entry.baud or BAUD, node if entry.shared else ""
    _lines[key] = open_line(_lines.get(key))
    return _lines[key]


def _serial_line(entry: LinkEntry, node: str, build: Build) -> Callable[[Line | None], Line]:
    def open_line(old: Line | None) -> Line:
        line = old or Line(entry.port, lambda: opened(entry.port, entry.baud or BAUD), build, entry.timeout)
        line.build, line.timeout = build, entry.timeout
        return line

    return open_line
