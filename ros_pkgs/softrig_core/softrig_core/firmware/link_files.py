"""The C files that put an exported node behind a link."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import resources

from ..block.port import Port
from ..board.layout import Layout
from ..export.kinds import identifier

SUPPORT = "softrig_link.h"

_HEADER = """/** @file {n}_link.h
 * The node {n} behind the frames of softrig's link. Written by `softrig export`.
 *
 * Call {n}_link_init once, then {n}_link_take with each byte that comes over the wire; it answers by `put`.
 */
#ifndef {N}_LINK_H
#define {N}_LINK_H

#include "{n}.h"

#define SR_LINK_ROOM {room}u /**< bytes of the longest frame */
#include "softrig_link.h"

/** The node, its parameters and its wire. */
typedef struct {n}_link {{
    sr_link wire;
    {n} node;
    {n}_in in;
    {n}_out out;
    {n}_params params;
    bool begun; /**< a step was answered since the reset */
    uint32_t (*now)(void); /**< a clock that measures steps; NULL: none */
    uint32_t longest;      /**< step so far, in its ticks */
}} {n}_link;

#ifdef __cplusplus
extern "C" {{
#endif

/** Begin; nothing is answered before the first hello.
 * @param put sends one byte
 * @param now see {n}_link; NULL: steps are not measured */
void {n}_link_init({n}_link *l, void (*put)(uint8_t), uint32_t (*now)(void));

/** Take one byte of the wire. */
void {n}_link_take({n}_link *l, uint8_t byte);

#ifdef __cplusplus
}}
#endif

#endif
"""

_SOURCE = """/* {n}_link.c: see {n}_link.h. Written by `softrig export`. */
#define SR_LINK_SOURCE
#include "{n}_link.h"

#include <stddef.h>

#ifndef SR_MARK
#ifdef __AVR__
#include <avr/io.h>
#define SR_MARK(x) (GPIOR0 = (x)) /* a register without a function: a simulator counts the cycles between two writes */
#else
#define SR_MARK(x) ((void)0)
#endif
#endif

void {n}_link_init({n}_link *l, void (*put)(uint8_t), uint32_t (*now)(void))
{{
    static const {n}_link zero;
    static const {n}_params params = {N}_PARAMS;
    *l = zero;
    l->params = params;
    l->wire.put = put;
    l->wire.code = 0xFFu;
    l->now = now;
}}

static uint8_t *answer_hello({n}_link *l, uint8_t *to)
{{
    static const char digest[] = {N}_DIGEST;
    static const int64_t period[] = {{ {N}_PERIOD_NUMERATOR, {N}_PERIOD_DENOMINATOR }};
    static const uint8_t size = (uint8_t)sizeof(real_t);
    static const uint16_t sizes[] = {{ {step}u, {answer}u, {params}u }};
    to = sr_write(to, digest, 16);
    to = sr_write(to, &period[0], 8);
    to = sr_write(to, &period[1], 8);
    to = sr_write(to, &size, 1);
    to = sr_write(to, sizes, 6);
    return sr_write(to, &l->longest, 4);
}}
{set}
static uint8_t step({n}_link *l)
{{
    const uint8_t *from = l->wire.in + SR_HEAD;
{read}
    const uint32_t begun = (l->now != NULL) ? l->now() : 0u;
    uint8_t status;
    SR_MARK(1u);
{call}
    SR_MARK(0u);
    if (l->now != NULL) {{
        const uint32_t duration = l->now() - begun;
        l->longest = (duration > l->longest) ? duration : l->longest;
    }}
    return status;
}}

static uint8_t *outputs(const {n}_link *l, uint8_t *to)
{{
{write}
    return to;
}}

void {n}_link_take({n}_link *l, uint8_t byte)
{{
    const uint8_t kind = sr_request(&l->wire, byte);
    const uint16_t size = l->wire.length;
    uint8_t *const begin = sr_values(&l->wire, kind);
    uint8_t *to = begin;
    uint8_t status = SR_DONE;
    switch (kind) {{
    case 0:
        return;
    case SR_HELLO:
        to = answer_hello(l, to);
        break;
    case SR_RESET: {{
        static const {n}_params params = {N}_PARAMS;
        l->params = params;
        {n}_init(&l->node, NULL);
        l->wire.reset = true;
        l->begun = false;
        break;
    }}
{params_case}    case SR_STEP:
        if (!l->wire.reset) {{
            status = SR_NOT_RESET;
        }} else if (size != {step}u) {{
            status = SR_BAD_LENGTH;
        }} else {{
            l->begun = true;
            status = step(l);
            to = outputs(l, to);
        }}
        break;
    default:
        status = SR_BAD_KIND;
        break;
    }}
    sr_answer(&l->wire, kind, status, (uint16_t)(to - begin));
}}
"""


def link_files(name: str, layout: Layout) -> dict[str, str]:
    """Return the files that put an exported node behind a link.

    Parameters
    ----------
    name : str
        Prefix of the exported files.
    layout : Layout
        Of its frames.
    """
    fields = {"n": name, "N": name.upper(), "room": layout.room}
    fields |= {"step": layout.step.size, "answer": layout.answer.size, "params": layout.params.size}
    fields["read"] = _lines([*_times(layout), *_moved("read", "l->in", layout.inputs, "held")])
    fields["write"] = _lines(_moved("write", "l->out", layout.outputs, "sporadic") or ["(void)l;"])
    fields["call"] = _lines(_call(name, layout))
    fields["set"], fields["params_case"] = _settable(name, layout)
    return {
        SUPPORT: (resources.files(__package__) / SUPPORT).read_text(),
        f"{name}_link.h": _HEADER.format(**fields),
        f"{name}_link.c": _SOURCE.format(**fields),
    }


def _lines(lines: Sequence[str]) -> str:
    return "\n".join(f"    {line}" for line in lines)


def _times(layout: Layout) -> list[str]:
    """Write code that reads the times at the start of a step."""
    if not layout.plant:
        return ["int64_t t_ns;", "from = sr_read(from, &t_ns, 8);"]
    return [
        "uint8_t moves;",
        "int64_t from_ns, t_ns;",
        "from = sr_read(from, &moves, 1);",
        "from = sr_read(from, &from_ns, 8);",
        "from = sr_read(from, &t_ns, 8);",
    ]


def _call(name: str, layout: Layout) -> list[str]:
    if not layout.plant:
        return [f"status = (uint8_t){name}_step(&l->node, &l->in, &l->out, t_ns);"]
    return [
        f"status = (moves != 0u) ? (uint8_t){name}_advance(&l->node, &l->in, from_ns) : (uint8_t)SR_DONE;",
        "if (status == SR_DONE) {",
        f"    status = (uint8_t){name}_outputs(&l->node, &l->out, t_ns);",
        "}",
    ]


def _moved(verb: str, struct: str, ports: Sequence[Port], flag: str) -> list[str]:
    """Write code that reads or writes the values of ports, one after the other."""
    ptr, lines = {"read": "from", "write": "to"}[verb], []
    for port in ports:
        name = identifier(port.name)
        if getattr(port, flag):
            if verb == "read":
                lines += [f"{struct}.has_{name} = (*from != 0u);", "from++;"]
            else:
                lines += [f"*to = {struct}.has_{name} ? 1u : 0u;", "to++;"]
        if port.delayed:
            lines.append(f"{ptr} = sr_{verb}({ptr}, &{struct}.{name}_stamp_ns, 8);")
        if port.size:
            lines.append(f"{ptr} = sr_{verb}({ptr}, {struct}.{name}, (uint16_t)({port.size}u * sizeof(real_t)));")
    return [*lines, "(void)from;"] if verb == "read" else lines


def _settable(name: str, layout: Layout) -> tuple[str, str]:
    """Return the function that sets parameters, and its case; empty if no parameter may be set."""
    if not layout.settable:
        return "", ""
    reads = []
    for key, kind in layout.settable.items():
        size = "8" if kind is int else "(uint16_t)sizeof(real_t)"
        reads.append(f"    from = sr_read(from, &l->params.{identifier(key)}, {size});")
    function = [
        "",
        f"static void set({name}_link *l)",
        "{",
        "    const uint8_t *from = l->wire.in + SR_HEAD;",
        *reads,
        "    (void)from;",
        "    if (l->begun) {",
        f"        {name}_set(&l->node, &l->params);",
        "    } else { /* the first state follows from them */",
        f"        {name}_init(&l->node, &l->params);",
        "    }",
        "}",
        "",
    ]
    case = [
        "    case SR_PARAMS:",
        f"        if (size == {layout.params.size}u && l->wire.reset) {{",
        "            set(l);",
        "        } else {",
        "            status = l->wire.reset ? SR_BAD_LENGTH : SR_NOT_RESET;",
        "        }",
        "        break;",
        "",
    ]
    return "\n".join(function), "\n".join(case)
