"""The signals of a node on a CAN bus: a DBC is printed from its ports, and read again."""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

from ..block.block import Block
from ..block.params import flatten
from ..block.port import PLAUSIBLE, PLAUSIBLE_OTHER, Port
from ..errors import RunError, ScenarioError
from ..extras import need
from ..judge.units import misfit
from ..wire.types import BUTTON
from .entry import contents_of

TICK, RUN, BUILD = "tick", "run", "build"
BITS = {TICK: 16, RUN: 8, BUILD: 32}
HEAD = BITS[TICK] + BITS[RUN]  # bits of the counters at the beginning of each message with values
NUMBERS = 1 << BITS[TICK]
FRAME_BITS, WORD = 64, 32
LARGEST_FLOAT = {16: 65504.0, 32: 3.4028234663852886e38, 64: 1.7976931348623157e308}
WHAT = "a node on a CAN bus"


class Value(NamedTuple):
    """A number of a port, or the flag that the port has a value; `limit` is None if the port declares none."""

    name: str
    bits: int
    unit: str = ""
    limit: float | None = None
    flag: bool = False


class Frame(NamedTuple):
    """A message of the DBC, and the place of each of its signals among the numbers of a tick."""

    message: Any
    signals: tuple[tuple[int, Any], ...]
    numbered: bool

    @property
    def key(self) -> tuple[int, bool]:
        """Return its identifier, and whether this is one of 29 bits."""
        return self.message.frame_id, self.message.is_extended_frame


class Messages(NamedTuple):
    """The messages of a node.

    Attributes
    ----------
    hello, ready : Frame or None
        Begin a run, to the node and from it; None where the node echoes no numbers.
    to, back : list of Frame
        Values to the node and from it.
    flags : frozenset of int
        Places of the numbers from the node that are flags.
    """

    hello: Frame | None
    ready: Frame | None
    to: list[Frame]
    back: list[Frame]
    flags: frozenset[int]


def values_of(ports: Sequence[Port], flag: str) -> list[Value]:
    """Return the values that a tick transmits in one direction, in the order of `Layout`.

    Parameters
    ----------
    flag : {"held", "sporadic"}
        Ports of this kind have a bit that is set if there is a value.

    Raises
    ------
    ScenarioError
        A port is delayed, or two values have the same name.
    """
    results: dict[str, Value] = {}
    for port in ports:
        if port.delayed:
            raise ScenarioError(f"port {port.name} carries acquisition times, which a CAN link does not transmit")
        result = [Value(f"{port.name}_given", 1, flag=True)] if getattr(port, flag) else []
        for label, unit, limit in zip(port.labels, port.units, port.limits, strict=True):
            bounds = None if limit == PLAUSIBLE.get(unit, PLAUSIBLE_OTHER) else limit
            bits = 1 if port.msgtype == BUTTON.name else WORD
            result.append(Value(re.sub(r"\W", "_", f"{port.name}_{label}", flags=re.ASCII), bits, unit, bounds))
        for value in result:
            if value.name in results:
                raise ScenarioError(f"two values would be the CAN signal {value.name}; rename a port or a channel")
            results[value.name] = value
    return list(results.values())


def build_of(block: type[Block], params: Any) -> str:
    """Return the build of a node: eight hexadecimal digits that depend on its block, ports and parameters."""
    ports = [[[p.name, p.labels, p.units, p.limits, p.held, p.sporadic] for p in side] for side in block.ports(params)]
    known = [f"{block.__module__}:{block.__qualname__}", ports, flatten(params)]
    return hashlib.sha256(json.dumps(known, default=str).encode()).hexdigest()[: BITS[BUILD] // 4]


def printed(node: str, inputs: Sequence[Port], outputs: Sequence[Port], first_id: int, build: str) -> str:
    """Return the DBC of a node.

    A value whose port states a limit is a whole number of 32 bits whose range is the limit; another is an IEEE float.

    Raises
    ------
    ScenarioError
        A port cannot be transmitted, the identifiers do not suffice, or cantools is missing.
    """
    need("cantools", "the DBC of a node")
    from cantools.database import Database
    from cantools.database.can.message import Message
    from cantools.database.can.node import Node

    messages: list[Message] = []
    for direction, sender, receiver, values in (
        ("to", "softrig", node, values_of(inputs, "held")),
        ("from", node, "softrig", values_of(outputs, "sporadic")),
    ):
        parts = [list(_signals(part, receiver)) for part in _parts(values)]
        for k, signals in enumerate([_greeting(build, receiver), *parts]):
            number = first_id + len(messages)
            if number > 0x7FF:
                raise ScenarioError(f"{node}: identifier {number:#x} is beyond 0x7ff; choose a smaller --id")
            messages.append(Message(number, f"{node}_{direction}_{k}", FRAME_BITS // 8, signals, senders=[sender]))
    return str(Database(messages, [Node("softrig"), Node(node)], version="").as_dbc_string())


def _parts(values: Sequence[Value]) -> list[list[Value]]:
    """Return the values by message; each message begins with the number of the tick and of the run."""
    parts: list[list[Value]] = [[]]
    used = HEAD
    for value in values:
        if used + value.bits > FRAME_BITS:
            parts.append([])
            used = HEAD
        parts[-1].append(value)
        used += value.bits
    return parts


def _integer(name: str, start: int, receiver: str, least: int = 0, most: int | None = None) -> Any:
    """Return the signal of a whole number."""
    from cantools.database.can.signal import Signal

    most = (1 << BITS[name]) - 1 if most is None else most
    return Signal(name, start, BITS[name], minimum=least, maximum=most, receivers=[receiver])


def _greeting(build: str, receiver: str) -> list[Any]:
    number = int(build, 16)
    return [_integer(RUN, BITS[TICK], receiver), _integer(BUILD, HEAD, receiver, number, number)]


def _signals(values: Sequence[Value], receiver: str) -> Iterator[Any]:
    from cantools.database.can.signal import Signal
    from cantools.database.conversion import BaseConversion

    yield _integer(TICK, 0, receiver)
    yield _integer(RUN, BITS[TICK], receiver)
    start = HEAD
    for name, bits, unit, limit, _ in values:
        if bits == 1:
            yield Signal(name, start, 1, minimum=0, maximum=1, receivers=[receiver])
        else:
            scale = 1.0 if limit is None else limit / (2 ** (WORD - 1) - 1)
            how = BaseConversion.factory(scale, 0.0, is_float=limit is None)
            ends: dict[str, Any] = {} if limit is None else {"minimum": -limit, "maximum": limit}
            ends["unit"] = _shown(unit) or None
            yield Signal(name, start, WORD, is_signed=True, conversion=how, receivers=[receiver], **ends)
        start += bits


def _shown(unit: str) -> str:
    """Return a unit as a DBC can contain it: no quotation marks, one code page."""
    shown = "".join(sign if sign.isprintable() and sign not in '"\\' else "_" for sign in unit)
    return shown.encode("cp1252", errors="replace").decode("cp1252")


def _another(stated: str | None, unit: str) -> str:
    """Describe why a signal's unit does not fit its channel; empty if it does. A wrong unit would scale the number."""
    if (stated or "") in ("", _shown(unit)):
        return ""
    if why := misfit(str(stated), unit):
        return f"{why.partition('; ')[0]}; write the channel's unit, and scale and offset for it"
    return ""


def messages_of(file: Path, node: str, inputs: Sequence[Port], outputs: Sequence[Port], build: str) -> Messages:
    """Return the messages to a node and from it, as a DBC has them.

    Raises
    ------
    ScenarioError
        The file cannot be read or is of another build; a signal is missing, doubled, multiplexed, of a type or with a
        scale that cannot be transmitted; a message is too long, or its identifier is that of another one.
    """
    link = f"link: {file}"
    database = _loaded(file, link)
    to, back = values_of(inputs, "held"), values_of(outputs, "sporadic")
    read = {side: _frames_of(database, f"{node}_{side}", values, link) for side, values in (("to", to), ("from", back))}
    (hello, requests), (ready, answers) = read["to"], read["from"]
    if ready is not None and hello is None:
        raise ScenarioError(f"{link}: {node}_from_0 needs {node}_to_0; export the DBC again")
    if hello is not None and hello.signals[0][1].minimum != int(build, 16):
        raise ScenarioError(f"{link} is of another block or of other parameters of {node}; export the DBC again")
    all_of = [*requests, *answers, *(f for f in (hello, ready) if f is not None)]
    for number in {f.key for f in all_of}:
        same = [m.name for m in database.messages if (m.frame_id, m.is_extended_frame) == number]
        if len(same) > 1:
            raise ScenarioError(f"{link}: {' and '.join(same)} have one identifier, {number[0]:#x}")
    flags = frozenset(k for k, value in enumerate(back) if value.flag)
    return Messages(hello if ready is not None else None, ready, requests, answers, flags)


def _loaded(file: Path, link: str) -> Any:
    need("cantools", WHAT)
    try:
        text = contents_of(file).decode("cp1252", "replace")
    except OSError as error:
        raise ScenarioError(f"{link}: {error.strerror}; `softrig export dbc` writes it") from None
    except ValueError as error:
        raise ScenarioError(f"{link} has {error}; `softrig export dbc` writes the node's alone") from None
    try:
        return _parsed(text)
    except Exception as error:  # for a damaged file the parser raises many kinds of errors
        first = str(error).strip().partition("\n")[0] or type(error).__name__
        raise ScenarioError(f"{link} is no DBC ({first[:200]})") from None


@lru_cache(maxsize=4)  # a file of the longest size takes seconds, and each block of a node reads it
def _parsed(text: str) -> Any:
    import cantools

    return cantools.database.load_string(text, database_format="dbc")


def _frames_of(database: Any, prefix: str, values: Sequence[Value], link: str) -> tuple[Frame | None, list[Frame]]:
    """Return the message that begins a run, and those with values."""
    greeting, frames, index_of = None, [], {value.name: k for k, value in enumerate(values)}
    seen: set[str] = set()
    for message in database.messages:
        if not re.fullmatch(rf"{re.escape(prefix)}_\d+", message.name):
            continue
        if message.length * 8 > FRAME_BITS or any(s.is_multiplexer or s.multiplexer_ids for s in message.signals):
            raise ScenarioError(f"{link}: message {message.name} is multiplexed or longer than 8 bytes")
        signals = {signal.name: signal for signal in message.signals}
        if message.name == f"{prefix}_0":
            head = _head(signals, (RUN, BUILD), message.name, link)
            if len(head) < 2 or signals:
                raise ScenarioError(f"{link}: {message.name} must have the signals {RUN} and {BUILD} alone")
            greeting = Frame(message, ((0, head[BUILD]),), True)
            continue
        head = _head(signals, (TICK, RUN), message.name, link)
        for name, signal in signals.items():
            if name not in index_of or name in seen:
                fault = "is there twice" if name in seen else f"is none of {', '.join(index_of) or 'no signals'}"
                raise ScenarioError(f"{link}: {message.name}.{name} {fault}")
            if reason := _unfit(signal) or _another(signal.unit, values[index_of[name]].unit):
                raise ScenarioError(f"{link}: {message.name}.{name} {reason}")
            seen.add(name)
        if len(head) == 1:
            raise ScenarioError(
                f"{link}: {message.name} has one of the signals {TICK} and {RUN}, expected both or none"
            )
        frames.append(Frame(message, tuple((index_of[n], s) for n, s in signals.items()), bool(head)))
    if missing := [name for name in index_of if name not in seen]:
        raise ScenarioError(f"{link}: no message {prefix}_... has the signal {missing[0]}; export the DBC again")
    if not frames:
        raise ScenarioError(f"{link}: there is no message {prefix}_1; export the DBC again")
    if {frame.numbered for frame in frames} != {greeting is not None}:
        raise ScenarioError(f"{link}: {prefix}_0 and the signals {TICK} and {RUN} of all {prefix}_... belong together")
    return greeting, frames


def _head(signals: dict[str, Any], names: Sequence[str], message: str, link: str) -> dict[str, Any]:
    """Separate softrig's counters from the other signals of a message."""
    result = {name: signals.pop(name) for name in names if name in signals}
    for name, signal in result.items():
        plain = not signal.is_signed and not signal.is_float and (signal.scale, signal.offset) == (1, 0)
        if signal.length != BITS[name] or not plain:
            raise ScenarioError(f"{link}: {message}.{name} must be a whole number of {BITS[name]} bits without sign")
    return result


def _unfit(signal: Any) -> str:
    """Return why a signal cannot have a number; empty if it can."""
    numbers = [signal.scale, signal.offset, *(x for x in (signal.minimum, signal.maximum) if x is not None)]
    if not all(abs(x) <= LARGEST_FLOAT[64] for x in numbers) or signal.scale == 0:  # an int may be beyond all floats
        return f"has the scale {signal.scale} and the offset {signal.offset}, expected finite numbers and a scale not 0"
    low, high = signal.minimum, signal.maximum
    if low is not None and high is not None and low >= high:  # [0|0], which is none, has no numbers here
        return f"has the range {low} to {high}, expected the smaller number first, or [0|0] for none"
    if signal.is_float and signal.length not in LARGEST_FLOAT:
        return f"is a float of {signal.length} bits, expected 16, 32 or 64"
    return ""


def encoded(frame: Frame, head: Mapping[str, int], row: Sequence[float]) -> tuple[bytes, list[str]]:
    """Return the bytes of a message, and the names of the signals that were limited.

    Each value is limited to the signal's range before it becomes a whole number: bits beyond it would be cut.

    Parameters
    ----------
    head : mapping of str to int
        Of tick and run; of no meaning where the message has neither.

    Raises
    ------
    RunError
        A value is not finite.
    """
    raw: dict[str, float] = dict(head) if frame.numbered else {}
    limited = []
    for index, signal in frame.signals:
        value = float(row[index])
        if not math.isfinite(value):
            raise RunError(f"CAN signal {signal.name} would be {value}, expected a finite number")
        raw[signal.name], cut = _raw(signal, value)
        if cut:
            limited.append(signal.name)
    return bytes(frame.message.encode(raw, scaling=False, strict=False)), limited


def _raw(signal: Any, value: float) -> tuple[float, bool]:
    low = -math.inf if signal.minimum is None else signal.minimum
    high = math.inf if signal.maximum is None else signal.maximum
    limited = min(max(value, low), high)
    number = (limited - signal.offset) / signal.scale
    if signal.is_float:
        most = LARGEST_FLOAT[signal.length]
        stored = min(max(number, -most), most)
        return stored, limited != value or stored != number
    half = 1 << signal.length - 1
    least, most = (-half, half - 1) if signal.is_signed else (0, 2 * half - 1)
    rounded = min(max(number, float(least)), float(most))
    # a float may round the largest number of more than 53 bits up
    return min(max(round(rounded), least), most), limited != value or rounded != number


def decoded(frame: Frame, data: bytes) -> tuple[int | None, int | None, dict[int, float]] | None:
    """Return tick, run and values by place of a message; None where it has another length or a value is not finite."""
    if len(data) != frame.message.length:
        return None
    raw = frame.message.decode(data, scaling=False, decode_choices=False)
    values = {index: raw[s.name] * s.scale + s.offset for index, s in frame.signals}
    return (raw.get(TICK), raw.get(RUN), values) if all(map(math.isfinite, values.values())) else None
