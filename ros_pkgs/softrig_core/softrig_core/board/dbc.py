"""The signals of a node on a CAN bus: a DBC is printed from its ports, and read again."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from ..block.port import PLAUSIBLE, PLAUSIBLE_OTHER, Port
from ..errors import RunError, ScenarioError
from ..extras import need
from ..wire.types import BUTTON

TICK, TICK_BITS = "tick", 16
NUMBERS = (1 << TICK_BITS) - 1  # after the last number comes 1: 0 is the first tick of a run
FRAME_BITS, WORD = 64, 32
LARGEST_FLOAT = {16: 65504.0, 32: 3.4028234663852886e38, 64: 1.7976931348623157e308}
WHAT = "a node on a CAN bus"


class Value(NamedTuple):
    """A number of a port, or the flag that the port has a value; `limit` is None where the port states none."""

    name: str
    bits: int
    unit: str = ""
    limit: float | None = None


class Frame(NamedTuple):
    """A message of the DBC, and the place of each of its signals among the numbers of a tick."""

    message: Any
    signals: tuple[tuple[int, Any], ...]
    numbered: bool


def values_of(ports: Sequence[Port], flag: str) -> list[Value]:
    """Return what a tick carries in one direction, in the order of `Layout`.

    Parameters
    ----------
    flag : {"held", "sporadic"}
        Ports of this kind have a bit that says whether there is a value.

    Raises
    ------
    ScenarioError
        A port is delayed, or two values have the same name.
    """
    found: dict[str, Value] = {}
    for port in ports:
        if port.delayed:
            raise ScenarioError(f"port {port.name} carries acquisition times, which a CAN link does not transmit")
        made = [Value(f"{port.name}_given", 1)] if getattr(port, flag) else []
        for label, unit, limit in zip(port.labels, port.units, port.limits, strict=True):
            own = None if limit == PLAUSIBLE.get(unit, PLAUSIBLE_OTHER) else limit
            bits = 1 if port.msgtype == BUTTON.name else WORD
            made.append(Value(re.sub(r"\W", "_", f"{port.name}_{label}"), bits, unit, own))
        for value in made:
            if value.name in found:
                raise ScenarioError(f"two values would be the CAN signal {value.name}; rename a port or a channel")
            found[value.name] = value
    return list(found.values())


def printed(node: str, inputs: Sequence[Port], outputs: Sequence[Port], first_id: int) -> str:
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
    for way, sender, receiver, values in (
        ("to", "softrig", node, values_of(inputs, "held")),
        ("from", node, "softrig", values_of(outputs, "sporadic")),
    ):
        for k, part in enumerate(_parts(values), 1):
            number = first_id + len(messages)
            if number > 0x7FF:
                raise ScenarioError(f"{node}: identifier {number:#x} is beyond 0x7ff; choose a smaller --id")
            signals = list(_signals(part, receiver))
            messages.append(Message(number, f"{node}_{way}_{k}", FRAME_BITS // 8, signals, senders=[sender]))
    return str(Database(messages, [Node("softrig"), Node(node)], version="").as_dbc_string())


def _parts(values: Sequence[Value]) -> list[list[Value]]:
    """Return the values by message, each of which begins with the number of the tick."""
    parts: list[list[Value]] = [[]]
    used = TICK_BITS
    for value in values:
        if used + value.bits > FRAME_BITS:
            parts.append([])
            used = TICK_BITS
        parts[-1].append(value)
        used += value.bits
    return parts


def _signals(values: Sequence[Value], receiver: str) -> Iterator[Any]:
    from cantools.database.can.signal import Signal
    from cantools.database.conversion import BaseConversion

    yield Signal(TICK, 0, TICK_BITS, minimum=0, maximum=NUMBERS, receivers=[receiver])
    at = TICK_BITS
    for name, bits, unit, limit in values:
        if bits == 1:
            yield Signal(name, at, 1, minimum=0, maximum=1, receivers=[receiver])
        else:
            scale = 1.0 if limit is None else limit / (2 ** (WORD - 1) - 1)
            how = BaseConversion.factory(scale, 0.0, is_float=limit is None)
            ends: dict[str, Any] = {} if limit is None else {"minimum": -limit, "maximum": limit}
            yield Signal(
                name, at, WORD, is_signed=True, conversion=how, unit=unit or None, receivers=[receiver], **ends
            )
        at += bits


def frames_of(
    file: Path, node: str, inputs: Sequence[Port], outputs: Sequence[Port]
) -> tuple[list[Frame], list[Frame]]:
    """Return the messages to a node and from it, as a DBC has them.

    Raises
    ------
    ScenarioError
        The file cannot be read, or a signal is missing, doubled, multiplexed or in a message that is too long.
    """
    need("cantools", WHAT)
    import cantools

    try:
        database = cantools.database.load_file(str(file), database_format="dbc")
    except OSError as error:
        raise ScenarioError(f"link: {file}: {error.strerror}; `softrig export dbc` writes it") from None
    except (cantools.Error, ValueError) as error:
        raise ScenarioError(f"link: {file} is no DBC ({str(error).splitlines()[0]})") from None
    where = f"link: {file}"
    to = _found(database, f"{node}_to", values_of(inputs, "held"), where)
    back = _found(database, f"{node}_from", values_of(outputs, "sporadic"), where)
    if len({frame.numbered for frame in back}) == 2:
        raise ScenarioError(f"{where}: some messages {node}_from_... have the signal {TICK} and some have not")
    return to, back


def _found(database: Any, prefix: str, values: Sequence[Value], where: str) -> list[Frame]:
    frames, places = [], {value.name: k for k, value in enumerate(values)}
    seen: set[str] = set()
    for message in database.messages:
        if not re.fullmatch(rf"{re.escape(prefix)}_\d+", message.name):
            continue
        if message.length * 8 > FRAME_BITS or message.is_multiplexed():
            raise ScenarioError(f"{where}: message {message.name} is multiplexed or longer than 8 bytes")
        signals = {signal.name: signal for signal in message.signals}
        tick = signals.pop(TICK, None)
        if tick is not None and (tick.length != TICK_BITS or tick.is_signed or (tick.scale, tick.offset) != (1, 0)):
            raise ScenarioError(f"{where}: {message.name}.{TICK} must be a whole number of {TICK_BITS} bits")
        for name in signals:
            if name not in places or name in seen:
                what = "is there twice" if name in seen else f"is none of {', '.join(places) or 'no signals'}"
                raise ScenarioError(f"{where}: {message.name}.{name} {what}")
            seen.add(name)
        frames.append(Frame(message, tuple((places[n], s) for n, s in signals.items()), tick is not None))
    if missing := [name for name in places if name not in seen]:
        raise ScenarioError(f"{where}: no message {prefix}_... has the signal {missing[0]}; export the DBC again")
    if not frames:
        raise ScenarioError(f"{where}: there is no message {prefix}_1; export the DBC again")
    return frames


def encoded(frame: Frame, number: int, row: Sequence[float]) -> tuple[bytes, list[str]]:
    """Return the bytes of a message, and the names of the signals that were limited.

    Each value is limited to the signal's range before it becomes a whole number: bits beyond it would be cut.

    Raises
    ------
    RunError
        A value is not finite.
    """
    raw: dict[str, float] = {TICK: number} if frame.numbered else {}
    limited = []
    for place, signal in frame.signals:
        value = float(row[place])
        if not math.isfinite(value):
            raise RunError(f"CAN signal {signal.name} would be {value}, expected a finite number")
        raw[signal.name], cut = _raw(signal, value)
        if cut:
            limited.append(signal.name)
    return frame.message.encode(raw, scaling=False, strict=False), limited


def _raw(signal: Any, value: float) -> tuple[float, bool]:
    low = -math.inf if signal.minimum is None else signal.minimum
    high = math.inf if signal.maximum is None else signal.maximum
    inside = min(max(value, low), high)
    number = (inside - signal.offset) / signal.scale
    if signal.is_float:
        most = LARGEST_FLOAT[signal.length]
        kept = min(max(number, -most), most)
        return kept, inside != value or kept != number
    least, most = (
        (-(1 << signal.length - 1), (1 << signal.length - 1) - 1)
        if signal.is_signed
        else (
            0,
            (1 << signal.length) - 1,
        )
    )
    whole = min(max(number, float(least)), float(most))
    # a float may round the largest number of more than 53 bits up
    return min(max(round(whole), least), most), inside != value or whole != number


def decoded(frame: Frame, data: bytes) -> tuple[int | None, Mapping[int, float]] | None:
    """Return the number of a message and its values by place; None where it has another length."""
    if len(data) != frame.message.length:
        return None
    raw = frame.message.decode(data, scaling=False, decode_choices=False)
    return raw.get(TICK), {place: raw[s.name] * s.scale + s.offset for place, s in frame.signals}
