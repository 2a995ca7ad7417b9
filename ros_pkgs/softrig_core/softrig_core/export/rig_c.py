"""A whole rig as C: all its plants and controllers in one struct, wired as in the rig, one `step` a tick."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import resources
from typing import Any

from ..block.loop import Act, Loop, acts
from ..block.port import Sample
from ..block.schedule import Plan
from ..block.step import Step
from ..errors import ScenarioError
from ..native.value import NotNative
from ..rig.members import Link, Member
from ..rig.rig import Rig
from ..run.inprocess import check_here, wired
from .c_files import (
    REPLAY_END,
    REPLAY_HEAD,
    REPLAY_OPEN,
    SUPPORT,
    Exported,
    c_of_member,
    check_class,
    compared,
    numbers_of,
)
from .golden import Call, Changed, watched
from .kinds import identifier, remark
from .unit import literal

DRAWN = 200  # calls with drawn inputs: they find ways that the run never takes


@dataclass(frozen=True)
class Ticks:
    """Messages of a run by tick: the time in ns, and the outputs of each node that was due."""

    rows: list[tuple[int, dict[str, Mapping[str, Any]]]]
    calls: dict[str, list[Call | Changed]]


def rig_files(rig: Rig, most: int, *, single: bool = False) -> tuple[Exported, dict[str, str]]:
    """Write a rig as C.

    Parameters
    ----------
    most : int
        Ticks of its run that become golden rows.
    single : bool
        Numbers are float.

    Returns
    -------
    Exported
    dict of str to str
        Nodes without readers that were left out, and why they have no C.

    Raises
    ------
    ScenarioError
        A node that others read has no C.
    """
    check_here(rig)
    left: dict[str, str] = {}
    for member in rig.members:
        with _left_out(left, member):
            check_class(member)
    _check_read(rig, left)  # before the run, which may take long
    ticks = _run(rig, most)
    exported: dict[str, Exported] = {}
    for member in rig.members:
        if member.name not in left:
            with _left_out(left, member):
                exported[member.name] = _member(rig, member, ticks.calls[member.name], single)
    _check_read(rig, left)
    members = [m for m in rig.members if m.name in exported]
    if not members:
        raise ScenarioError(f"no node of {rig.scenario.name} can be exported as C: {next(iter(left.values()))}")
    return _RigFiles(rig, members, exported, ticks, left).exported(), left


@contextmanager
def _left_out(left: dict[str, str], member: Member) -> Iterator[None]:
    """Record the reason why a member has no C."""
    try:
        yield
    except NotNative as reason:
        left[member.name] = str(reason)


def _check_read(rig: Rig, left: dict[str, str]) -> None:
    """Refuse a plant without C, and a node without C that others need; an observer of such a node is left out, too."""
    read = {link.source.name for member in rig.members for link in member.links.values()}
    for member in rig.members:
        for link in member.links.values():
            if member.name not in left and link.source.name in left:
                why = left[link.source.name]
                if not member.is_plant and member.name not in read:
                    left[member.name] = f"it reads {link.source.name}, which has no C: {why}"
                    break
                raise ScenarioError(f"{link.source.name}, which {member.name} reads, cannot be exported as C: {why}")
        if member.is_plant and member.name in left:
            raise ScenarioError(f"the plant {member.name} cannot be exported as C: {left[member.name]}")


def _run(rig: Rig, most: int) -> Ticks:
    blocks = {m.name: m.block(rig.scenario.seed) for m in rig.members}
    calls: dict[str, list[Call | Changed]] = {name: [] for name in blocks}
    steps: dict[str, Step] = wired(rig, blocks)
    for name, step in steps.items():
        watched(step, calls[name])
    rows: list[tuple[int, dict[str, Mapping[str, Any]]]] = []
    for t in Loop(list(steps.values())).run():
        if t is None or t == rig.end or len(rows) >= most:  # at the end not all nodes answer
            break
        rows.append((t, {m.name: _published(steps[m.name]) for m in rig.members if m.schedule.due(t)}))
    return Ticks(rows, calls)


def _published(step: Step) -> dict[str, Any]:
    return {p.name: row for p, row in zip(step.outputs, step.last_answer, strict=True) if row is not None}


def _member(rig: Rig, member: Member, calls: Sequence[Call | Changed], single: bool) -> Exported:
    if member.changes:
        raise NotNative("its parameters change while it runs")
    if not calls:
        raise NotNative("it has no tick in the run")
    return c_of_member(member, calls, DRAWN, rig.scenario.seed, single)


class _RigFiles:
    def __init__(
        self,
        rig: Rig,
        members: Sequence[Member],
        exported: Mapping[str, Exported],
        ticks: Ticks,
        left: Mapping[str, str],
    ) -> None:
        self.rig, self.members, self.files_of, self.left = rig, members, exported, left
        self.name = f"{identifier(rig.scenario.name)}_rig"
        self.plan = Plan(m.schedule for m in members)
        due = {m.name for m in members}
        self.rows = [(t, {n: v for n, v in row.items() if n in due}) for t, row in ticks.rows]
        # Without the nodes that were left out the clock may be slower: at some ticks of the run nothing is due.
        self.rows = [(t, row) for t, row in self.rows if self.plan.clock.due(t)]
        ended = [(files.end, f"{m}: {files.ends}") for m, files in exported.items() if files.end is not None]
        end, self.ends = min(ended, default=(None, ""))
        # From there on C may differ from Python, which goes on from a state that C does not have.
        if end is not None:
            self.rows = [(t, row) for t, row in self.rows if t < end]
        if not self.rows:
            raise ScenarioError(f"no tick of {rig.scenario.name} can be compared: {self.ends or 'it has none'}")

    def exported(self) -> Exported:
        """Return all files: those of its members without their rows, and its own."""
        files: dict[str, str] = {}
        for part in self.files_of.values():
            files |= {n: t for n, t in part.files.items() if n.endswith((".h", ".c")) and not n.endswith(_OWN)}
        n = self.name
        files |= {
            f"{n}.h": self.header(),
            f"{n}.c": self.source(),
            f"{n}_rows.txt": self.text_of_rows(),
            f"{n}_replay.c": self.replay(),
            f"{n}_main.c": _MAIN.format(n=n, upper=n.upper()),
            SUPPORT: (resources.files(__package__) / SUPPORT).read_text(),
            f"{n}.json": self.description(),
        }
        libm = sorted({f for part in self.files_of.values() for f in part.libm})
        channels = tuple(f"{m.name}: {p.topic}/{label}" for m in self.members for p in m.outputs for label in p.labels)
        discards = tuple(f"{m}: {r}" for m, part in self.files_of.items() for r in part.discards)
        return Exported(n, files, tuple(libm), (), channels, discards, self.ends)

    def header(self) -> str:
        """Return the header."""
        n, upper, period = self.name, self.name.upper(), self.plan.clock.period
        lines = [
            f"/** @file {n}.h",
            f" * All nodes of the scenario {remark(self.rig.scenario.name)}: one struct, one step a tick.",
            " *",
            " * Written by `softrig export c`. Plants first, then the others in the order in which they answer.",
            " */",
            f"#ifndef {upper}_H",
            f"#define {upper}_H",
            "",
            *(f'#include "{member.name}.h"' for member in self.files_of.values()),
            "",
            f"#define {upper}_TICKS {self.plan.ticks or 0} /**< of the scenario; 0: endless */",
            f"#define {upper}_PERIOD_NUMERATOR {period.numerator} /**< of a tick, s, as a fraction */",
            f"#define {upper}_PERIOD_DENOMINATOR {period.denominator}",
            "",
            "/** The rig: each node, what it reads, what it published last. */",
            f"typedef struct {n} {{",
            "    int64_t k; /**< number of the tick that comes next */",
            "    int64_t t_ns; /**< time of the newest tick */",
        ]
        for member in self.files_of.values():
            # C++ accepts a member with the name of its type only after `struct`
            lines += [f"    struct {name} {name};" for name in (member.name, f"{member.name}_in", f"{member.name}_out")]
        lines += [
            f"}} {n};",
            "",
            "#ifdef __cplusplus",
            'extern "C" {',
            "#endif",
            "",
            "/** Go to the state before the first tick. */",
            f"void {n}_init({n} *s);",
            "",
            "/** Answer one tick, then move the plants on.",
            " * @return SR_DONE, or SR_GAVE_UP where the run in Python ends by an error or refuses a message */",
            f"int {n}_step({n} *s);",
            "",
            "#ifdef __cplusplus",
            "}",
            "#endif",
            "",
            "#endif",
            "",
        ]
        return "\n".join(lines)

    def source(self) -> str:
        """Return the source: `init`, and `step` with the wiring."""
        n, (num, den) = self.name, (self.plan.clock.period * 10**9).as_integer_ratio()
        time = f"k * INT64_C({num})"
        # As `Schedule.time`: rounded to the nearest ns.
        if den != 1:
            time = f"((2 * k * INT64_C({num})) + INT64_C({den})) / INT64_C({2 * den})"
        lines = [
            f"/* {n}.c: see {n}.h. Written by `softrig export c`. */",
            f'#include "{n}.h"',
            "",
            "#include <stddef.h>",
            "#include <string.h>",
            "",
            f"void {n}_init({n} *s)",
            "{",
            "    memset(s, 0, sizeof *s);",
            *(f"    {line}" for m in self.members for line in self._begin(m)),
            "}",
            "",
            f"int {n}_step({n} *s)",
            "{",
            "    const int64_t k = s->k;",
            f"    const int64_t t = {time};",
            "    int status = SR_DONE;",
            "    s->t_ns = t;",
            *(f"    {line}" for m, act in acts(self.members, lambda m: m.is_plant) for line in self._turn(m, act)),
            "    s->k = k + 1;",
            "    return status;",
            "}",
            "",
        ]
        return "\n".join(lines)

    def _c(self, member: Member) -> str:
        return self.files_of[member.name].name

    def _begin(self, member: Member) -> list[str]:
        c = self._c(member)
        lines = [f"{c}_init(&s->{c}, NULL);"]
        for port in member.inputs:
            value = port.initial
            data = value.data if isinstance(value, Sample) else value or ()
            lines += [f"s->{c}_in.{identifier(port.name)}[{i}] = {literal(v)};" for i, v in enumerate(data) if v]
        return lines

    def _turn(self, member: Member, act: Act) -> list[str]:
        """Write one action of a node under the condition that it is due, then the inputs that it fills."""
        c, every = self._c(member), self.plan.every(member.schedule)
        call, args = {
            "outputs": ("outputs", f"&s->{c}_out"),
            "update": ("step", f"&s->{c}_in, &s->{c}_out"),
            "advance": ("advance", f"&s->{c}_in"),
        }[act]
        lines = [f"if (SR_RARELY({c}_{call}(&s->{c}, {args}, t) != SR_DONE)) {{", "    status = SR_GAVE_UP;", "}"]
        if act != "advance":
            for reader in self.members:
                for name, link in reader.links.items():
                    if link.source is member:
                        lines += self._filled(reader, name, link)
        return lines if every == 1 else [f"if ((k % {every}) == 0) {{", *(f"    {line}" for line in lines), "}"]

    def _filled(self, reader: Member, name: str, link: Link) -> list[str]:
        """Write how an output fills an input."""
        port, source = link.port, f"s->{self._c(link.source)}_out"
        target = f"s->{self._c(reader)}_in"
        sink = next(p for p in reader.inputs if p.name == name)
        dst, src = identifier(name), identifier(port.name)
        picks = range(port.size) if link.pick is None else link.pick
        lines = [
            # In a pick a whole number is a place and a float is a constant.
            f"{target}.{dst}[{i}] = {f'{source}.{src}[{p}]' if type(p) is int else literal(p)};"
            for i, p in enumerate(picks)
        ]
        # An output without a stamp of its own has the stamp of its tick.
        if sink.delayed:
            lines.append(f"{target}.{dst}_stamp_ns = {f'{source}.{src}_stamp_ns' if port.delayed else 't'};")
        if sink.held:
            lines.append(f"{target}.has_{dst} = true;")
        # A fault may publish values that its reader rejects.
        if port.unchecked:
            tests = [f"SR_MATH(fabs)({target}.{dst}[{i}]) <= {literal(limit)}" for i, limit in enumerate(sink.limits)]
            lines += [f"if (SR_RARELY(!({' && '.join(f'({t})' for t in tests)}))) {{", "    status = SR_GAVE_UP;", "}"]
        if port.sporadic:
            lines = [f"if ({source}.has_{src}) {{", *(f"    {line}" for line in lines), "}"]
        return lines

    def text_of_rows(self) -> str:
        """Return the golden rows, one tick a line: for each node that is due 1 and its outputs, otherwise 0."""
        lines = []
        for t, row in self.rows:
            words = [str(t)]
            for member in self.members:
                words.append(str(int(member.name in row)))
                if member.name in row:
                    words += numbers_of(member.outputs, row[member.name], "sporadic")
            lines.append(" ".join(words))
        return "\n".join(lines) + "\n"

    def replay(self) -> str:
        """Return the program that runs the rig and compares its outputs, tick by tick."""
        cases: list[str] = []
        channel = 0
        for member in self.members:
            lines = compared(member.outputs, f"rig.{self._c(member)}_out", channel)
            channel += sum(p.size for p in member.outputs)
            cases += ["if (strtol(at, &at, 10) != 0) {", *(f"    {line}" for line in lines), "}"]
        return _REPLAY.format(n=self.name, channels=channel, cases="\n".join(f"        {line}" for line in cases))

    def sources(self) -> list[str]:
        """Return the names of the C files of its members."""
        return [n for f in self.files_of.values() for n in f.files if n.endswith(".c") and not n.endswith(_OWN)]

    def description(self) -> str:
        """Return the JSON description."""
        results = {
            "scenario": self.rig.scenario.name,
            "period_s": list(self.plan.clock.period.as_integer_ratio()),
            "nodes": [{"node": m.name, "files": self._c(m), "plant": m.is_plant} for m in self.members],
            "left_out": dict(self.left),
            "sources": self.sources(),
            "golden_rows": len(self.rows),
            "ends": self.ends,
        }
        return json.dumps(results, indent=1) + "\n"


_OWN = ("_replay.c", "_main.c")  # files of a node that is exported alone; a rig has its own

_MAIN = """/* Example: runs the rig and prints how far it came. Written by `softrig export c`. */
#include "{n}.h"

#include <stdio.h>

static {n} rig;

int main(void)
{{
    long ticks = 0;
    {n}_init(&rig);
    while ((ticks < {upper}_TICKS) && ({n}_step(&rig) == SR_DONE)) {{
        ticks++;
    }}
    printf("%ld of %d ticks, the last one at %.9f s\\n", ticks, {upper}_TICKS, (double)rig.t_ns * 1e-9);
    return (ticks == {upper}_TICKS) ? 0 : 1;
}}
"""

_REPLAY = (
    """/* Runs the rig and compares each output with {n}_rows.txt. Written by `softrig export c`. */
"""
    + REPLAY_HEAD
    + """    static {n} rig;
    static char line[1 << 18];
"""
    + REPLAY_OPEN
    + """    {n}_init(&rig);
    sequence = 1;
    while (fgets(line, sizeof line, file) != NULL) {{
        char *at = line;
        const int64_t t = (int64_t)strtoll(at, &at, 10);
        const unsigned long failed = ({n}_step(&rig) != SR_DONE) ? 1u : 0u;
        rows++;
        gave_up += failed;
        wrong_status += failed;
        differing += (t != rig.t_ns) ? 1u : 0u;
{cases}
    }}
"""
    + REPLAY_END
)
