"""C code that answers the ticks of an exported node on a CAN bus, with the messages of a DBC."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from importlib import resources
from pathlib import Path

from ..block.block import Plant
from ..block.port import Port
from ..board.dbc import LARGEST_FLOAT, Frame, Messages, messages_of
from ..errors import ScenarioError
from ..export.command import DRAWN, ROWS, export_c
from ..export.golden import member_of
from ..export.kinds import identifier
from ..export.unit import literal
from ..guard import write_files
from ..rig.rig import Rig

SUPPORT = "softrig_can.h"


def export_can(rig: Rig, node: str, dbc: Path, build: str, folder: Path, rows: int = ROWS, drawn: int = DRAWN) -> str:
    """Write a node as C, and ``NODE_can.h`` and ``NODE_can.c`` that answer the messages of a DBC.

    Parameters
    ----------
    dbc : Path
        As `printed` gives it, or edited.
    build : str
        See `build_of`.

    Returns
    -------
    str
        The prefix of all names.

    Raises
    ------
    ScenarioError
        The node has no C, or a signal cannot be packed by it.
    """
    member = member_of(rig, node)
    inputs, outputs = member.block_class.ports(member.params)
    messages = messages_of(dbc, member.name, inputs, outputs, build)
    if messages.hello is None or messages.ready is None:
        raise ScenarioError(f"{dbc}: it has no message {node}_from_0, with which the node's C begins a run")
    done = export_c(rig, node, folder, rows=rows, drawn=drawn)
    period = (member.schedule.period * 10**9).as_integer_ratio()
    plant = issubclass(member.block_class, Plant)
    files = {
        SUPPORT: (resources.files(__package__) / SUPPORT).read_text(),
        f"{done.name}_can.h": _HEADER.format(n=done.name, upper=done.name.upper(), most=max(1, len(messages.back))),
        f"{done.name}_can.c": _source(done.name, messages, inputs, outputs, plant, build, period),
    }
    write_files(folder, files)
    return done.name


def _source(
    n: str,
    messages: Messages,
    inputs: Sequence[Port],
    outputs: Sequence[Port],
    plant: bool,
    build: str,
    period: tuple[int, int],
) -> str:
    assert messages.hello is not None
    assert messages.ready is not None
    fields, back = _c_names(inputs, "in", "held"), _c_names(outputs, "out", "sporadic")
    parts = [line for k, frame in enumerate(messages.to) for line in _unpacking(k, frame, fields)]
    answers = [line for k, frame in enumerate(messages.back) for line in _packed(k, frame, back)]
    num, den = period
    time = f"k * INT64_C({num})" if den == 1 else f"(k * INT64_C({num})) / INT64_C({den})"
    step = [f"status = {n}_step(&s->node, &s->in, &s->out, {n}_time(k));"]
    if plant:
        step = [
            "if (s->stepped) {",
            f"    status = {n}_advance(&s->node, &s->in, {n}_time(s->k));",
            "}",
            "if (status == SR_DONE) {",
            f"    status = {n}_outputs(&s->node, &s->out, {n}_time(k));",
            "}",
        ]
    words = {
        "n": n,
        "time": time,
        "hello": f"{messages.hello.message.frame_id:#x}",
        "ready": f"{messages.ready.message.frame_id:#x}",
        "build": f"0x{build}",
        "all": f"{(1 << len(messages.to)) - 1:#x}",
        "parts": "\n".join(f"    {line}" for line in parts),
        "step": "\n".join(f"        {line}" for line in step),
        "answers": "\n".join(f"    {line}" for line in answers),
        "count": len(messages.back),
    }
    return _SOURCE.format(**words)


def _c_names(ports: Sequence[Port], struct: str, flag: str) -> list[str]:
    """Return where C has the values of ports, in the order of `values_of`."""
    result: list[str] = []
    for port in ports:
        name = identifier(port.name)
        result += [f"s->{struct}.has_{name}"] if getattr(port, flag) else []
        result += [f"s->{struct}.{name}[{i}]" for i in range(port.size)]
    return result


def _unpacking(k: int, frame: Frame, fields: Sequence[str]) -> Iterator[str]:
    """Write code that unpacks a message for the node."""
    yield f"if (id == {frame.message.frame_id:#x}u) {{"
    yield f"    part = {1 << k:#x}u;"
    for index, signal in frame.signals:
        start, bits = _bits(signal)
        if fields[index].startswith("s->in.has_"):
            yield f"    {fields[index]} = sr_can_get(data, {start}u, {bits}u) != 0u;"
            continue
        raw = f"sr_can_get(data, {start}u, {bits}u)"
        number = f"sr_can_float({raw})" if signal.is_float else f"sr_can_signed({raw}, {bits}u)"
        number = number if signal.is_float or signal.is_signed else f"(double){raw}"
        yield f"    {fields[index]} = (real_t)({number} * {_number(signal.scale)} + {_number(signal.offset)});"
    yield "}"


def _packed(k: int, frame: Frame, fields: Sequence[str]) -> Iterator[str]:
    """Write code that packs a message of the node; a value beyond the range of its signal is limited first."""
    yield f"s->frames[{k}].id = {frame.message.frame_id:#x}u;"
    yield f"sr_can_put(s->frames[{k}].data, 0u, 16u, s->tick);"
    yield f"sr_can_put(s->frames[{k}].data, 16u, 8u, s->run);"
    for index, signal in frame.signals:
        start, bits = _bits(signal)
        value = fields[index]
        if value.startswith("s->out.has_"):
            yield f"sr_can_put(s->frames[{k}].data, {start}u, {bits}u, {value} ? 1u : 0u);"
            continue
        most = LARGEST_FLOAT[64]
        low, high = (_number(most * sign if end is None else end)
                     for end, sign in ((signal.minimum, -1.0), (signal.maximum, 1.0)))  # fmt: skip
        limited = (
            f"(sr_can_limited((double){value}, {low}, {high}) - {_number(signal.offset)}) / {_number(signal.scale)}"
        )
        half = 1 << bits - 1
        least, largest = (-half, half - 1) if signal.is_signed else (0, 2 * half - 1)
        code = f"sr_can_of_float({limited})"
        if not signal.is_float:
            code = f"(uint32_t)(int64_t)rint(sr_can_limited({limited}, {_number(least)}, {_number(largest)}))"
        yield f"sr_can_put(s->frames[{k}].data, {start}u, {bits}u, {code});"


def _number(value: float) -> str:
    """Return a number in double precision, whatever `real_t` is."""
    return literal(float(value)).removeprefix("SR_REAL(").removesuffix(")")


def _bits(signal: object) -> tuple[int, int]:
    """Return first bit and length of a signal.

    Raises
    ------
    ScenarioError
        It is one of another order of bytes, or too long.
    """
    start, length, order = (getattr(signal, key) for key in ("start", "length", "byte_order"))
    if order != "little_endian" or length > 32 or (getattr(signal, "is_float") and length != 32):  # noqa: B009
        raise ScenarioError(
            f"the CAN signal {getattr(signal, 'name')} has {length} bits, {order}; "  # noqa: B009
            "C packs little-endian ones of at most 32 bits"
        )
    return start, length


_HEADER = """/** @file {n}_can.h
 * A node on a CAN bus: answers the messages that softrig sends. Written by `softrig export dbc --code`.
 *
 * Call {n}_can_receive with each received frame, and send the frames that it returns.
 */
#ifndef {upper}_CAN_H
#define {upper}_CAN_H

#include "{n}.h"
#include "softrig_can.h"

/** The node, what it received and answered last, and the frames to send. */
typedef struct {n}_can {{
    {n} node;
    {n}_in in;
    {n}_out out;
    int64_t k; /**< ticks since the run began */
    uint32_t parts; /**< messages of the tick `next` that have arrived, a bit each */
    uint16_t tick; /**< that was answered last */
    uint16_t next;
    uint8_t run;
    bool begun; /**< whether there is a run */
    bool stepped; /**< whether a tick of it was answered */
    bool answered; /**< whether that tick has a result */
    sr_can_frame frames[{most}];
}} {n}_can;

#ifdef __cplusplus
extern "C" {{
#endif

/** Wait for a run. */
void {n}_can_init({n}_can *s);

/** Take a received data frame with an identifier of 11 bits.
 * @return how many of `frames` are to be sent now, from the first one on; 0: none */
unsigned {n}_can_receive({n}_can *s, uint32_t id, const uint8_t *data, uint8_t length);

#ifdef __cplusplus
}}
#endif

#endif
"""

_SOURCE = """/* {n}_can.c: see {n}_can.h. Written by `softrig export dbc --code`. */
#include "{n}_can.h"

#include <stddef.h>
#include <string.h>

static int64_t {n}_time(int64_t k)
{{
    return {time};
}}

void {n}_can_init({n}_can *s)
{{
    memset(s, 0, sizeof *s);
    {n}_init(&s->node, NULL);
}}

/* Begin a run: the node goes to its first state unless the run is known. */
static unsigned {n}_greeted({n}_can *s, uint8_t run)
{{
    if ((!s->begun) || (run != s->run)) {{
        {n}_can_init(s);
        s->begun = true;
        s->run = run;
    }}
    s->frames[0].id = {ready}u;
    memset(s->frames[0].data, 0, sizeof s->frames[0].data);
    sr_can_put(s->frames[0].data, 16u, 8u, s->run);
    sr_can_put(s->frames[0].data, 24u, 32u, {build}u);
    return 1u;
}}

static void {n}_stepped({n}_can *s, uint16_t tick)
{{
    int status = SR_DONE;
    const int64_t k = s->stepped ? (s->k + (int64_t)(uint16_t)(tick - s->tick)) : (int64_t)tick;
{step}
    s->k = k;
    s->tick = tick;
    s->stepped = true;
    s->answered = (status == SR_DONE);
}}

unsigned {n}_can_receive({n}_can *s, uint32_t id, const uint8_t *data, uint8_t length)
{{
    uint32_t part = 0u;
    if (length != 8u) {{
        return 0u;
    }}
    const uint16_t tick = (uint16_t)sr_can_get(data, 0u, 16u);
    const uint8_t run = (uint8_t)sr_can_get(data, 16u, 8u);
    if (id == {hello}u) {{
        return {n}_greeted(s, run);
    }}
    if ((!s->begun) || (run != s->run) || (s->stepped && ((uint16_t)(tick - s->tick) > 32767u))) {{
        return 0u; /* of another run, or older than what was answered */
    }}
    if (tick != s->next) {{
        s->next = tick;
        s->parts = 0u;
    }}
{parts}
    s->parts |= part;
    if ((part == 0u) || (s->parts != {all}u)) {{
        return 0u;
    }}
    s->parts = 0u;
    if ((!s->stepped) || (tick != s->tick)) {{
        {n}_stepped(s, tick);
    }}
    if (!s->answered) {{
        return 0u;
    }}
    memset(s->frames, 0, sizeof s->frames);
{answers}
    return {count}u;
}}
"""
