"""The generated parts of the doc pages: ``scripts/softrig docs pages [--check] [--runs] [--pictures] PAGE...``.

A page holds pairs of markers; what stands between them is made from the code and the scenario files::

    <!-- nodes: softrig_drives dc_motor_plant dc_motor_smc -->      topics and parameters of executables
    <!-- claims: dc_motor_smc -->                                   what the paper says, by beginning of scenario names;
                                                                    what was measured anew only with --runs
    <!-- scenarios: dc_motor_smc -->                                scenarios, by beginning of their names
    <!-- sources: dc_motor_smc -->                                  papers that these scenarios cite, with BibTeX
    <!-- picture: dc_motor_smc_b2 1 -->                             plot entry of a scenario; anew only with --runs
    <!-- animation: lsrm_fuzzy 0.8 0.9 -->                          its plant from 0.8 s to 0.9 s; anew only with --runs
    <!-- code: softrig_core.block.loop say Loop.run -->            functions of a module, as they stand there
    <!-- rooms: softrig_core -->                                   rooms of a package, by their imports
    <!-- licences: run -->                                         of what lock files pin, or of what casadi has inside;
                                                                    anew only with --runs
    <!-- format: softrig_robots.urdf_file URDF -->                 a table of what is used, ignored, refused of a file
    <!-- exported: classes -->                                      classes that have C; anew only with --runs
    <!-- exported: boards -->                                       what runs on simulated boards; anew only with --runs
    <!-- exported: rigs -->                                         whole scenarios that have C; anew only with --runs
    <!-- names: nodes -->                                      nodes, topics, parameters or verbs with the field's names
    <!-- measured: v_min v_max of rectifier_mpc rectifier_mpc_n2 --> figures of these scenarios; anew only with --runs
    <!-- end -->

and, within a line, ``<!-- verdicts: dc_motor -->``, how many claims of a system have which verdict.
Tables that are there to be looked up fold: a click on their summary opens them, in a repository's view and on the site.
Numbers in the text that people write have their sources too, see `numbers`.
"""

from __future__ import annotations

import argparse
import inspect
import math
import re
from collections import Counter
from collections.abc import Callable, Sequence
from functools import cache
from importlib import import_module
from operator import attrgetter
from pathlib import Path
from textwrap import dedent

from softrig_bringup.page.citations import cited, listed
from softrig_bringup.study.definition import list_studies, load_study
from softrig_core import Port, list_scenarios, load_scenario, simulate
from softrig_core.block.params import Declaration, Params, declarations
from softrig_core.judge.claims import VERDICTS
from softrig_core.kit.file_format import FileFormat
from softrig_core.rig.installed import load_block
from softrig_core.verdict.findings import hold
from softrig_core.verdict.result import Result

from . import drawn, numbers
from .exported import EXPORTED
from .licences import licences
from .names import names
from .plots import animate, animation, draw, picture
from .rooms import rooms

_KINDS = "names|exported|format|licences|rooms|code|nodes|claims|scenarios|sources|picture|animation|measured"
_PART = re.compile(rf"(<!-- ({_KINDS}): ([^>]*?) -->\n).*?(<!-- end -->)", re.DOTALL)
LONG = 6  # rows of measurements; longer tables are folded
ANIMATION = re.compile(r"<!-- animation: (\S+) (\S+) (\S+) -->")
_VERDICTS = re.compile(r"(<!-- verdicts: ([^>]*?) -->)[^\n]*?(<!-- end -->)")


def generate(page: str, runs: bool = False) -> str:
    """Return a page with its generated parts renewed; measured parts stay unless `runs`, which simulates."""

    def part(match: re.Match[str]) -> str:
        if match[2] in ("exported", "measured", "licences") and not runs:
            return match[0]
        first, *words = match[3].split()
        made: dict[str, Callable[[], str]] = {
            "nodes": lambda: nodes(first, words),
            "claims": lambda: claims([first, *words], None if runs else match[0]),
            "scenarios": lambda: scenarios([first, *words]),
            "sources": lambda: sources([first, *words]),
            "picture": lambda: picture(first, int(words[0])),
            "animation": lambda: animation(first),
            "measured": lambda: measured(match[3]),
            "exported": lambda: EXPORTED[first](words),
            "rooms": lambda: house(first),
            "code": lambda: code(first, words),
            "names": lambda: names(first),
            "licences": lambda: licences(match[3]),
            "format": lambda: file_format(getattr(import_module(first), words[0])),
        }
        return f"{match[1]}\n{made[match[2]]()}\n\n{match[4]}"

    return _VERDICTS.sub(lambda match: f"{match[1]}{verdicts(match[2])}{match[3]}", _PART.sub(part, page))


def folded(summary: str, text: str) -> str:
    """Fold a part of a page behind its summary (Markdown)."""
    shown = re.sub(r"`([^`]*)`", r"<code>\1</code>", summary.replace("&", "&amp;").replace("<", "&lt;"))
    return f"<details>\n<summary>{shown}</summary>\n\n{text}\n\n</details>"


def nodes(package: str, executables: Sequence[str]) -> str:
    """Return topics and parameters of the executables of a package, each folded with its name and purpose."""
    described = ((executable, *node(package, executable)) for executable in executables)
    return "\n\n".join(folded(f"`{executable}`: {head}", text) for executable, head, text in described)


def node(package: str, executable: str) -> tuple[str, str]:
    """Describe an executable, with its topics and parameters as tables."""
    block = load_block(package, executable)
    inputs, outputs = block.ports(block.Params())
    text = ["| topic | | type | values |", "|---|---|---|---|"]
    text += [_topic(port, "reads") for port in inputs] + [_topic(port, "publishes") for port in outputs]
    text += ["", *carried((*inputs, *outputs)), *parameters(block.Params)]
    head = (block.__doc__ or "").strip().splitlines()[0]
    return re.sub(":math:(`[^`]*`)", _plain, head), "\n".join(text)


_MECHANICAL = {"position": ("rad", "m"), "velocity": ("rad/s", "m/s"), "effort": ("N m", "N")}


def carried(ports: Sequence[Port]) -> list[str]:
    """Return a paragraph about fields of JointState with another unit than a joint's, and why; empty without
    such fields.
    """
    gathered: dict[str, dict[str, list[str]]] = {}
    for port in ports:
        if port.msgtype.endswith("/JointState"):
            for label, unit in zip(port.labels, port.units, strict=True):
                field = label.rpartition("/")[2]
                if unit not in _MECHANICAL[field]:
                    units = gathered.setdefault(field, {}).setdefault(port.topic, [])
                    units += [unit or "no unit"] if (unit or "no unit") not in units else []
    why = {
        "position": "measured or computed values with a name",
        "velocity": "rates in the unit of their position",
        "effort": "commands of an actuator or a source, as in the effort interface of ros2_control",
    }
    if not gathered:
        return []
    parts = []
    for field in (f for f in _MECHANICAL if f in gathered):
        topics = (f"`{topic}` ({', '.join(units)})" for topic, units in gathered[field].items())
        parts.append(f"`{field}` of {', '.join(topics)}: {why[field]}")
    head = "Its JointState messages also carry quantities that do not belong to joints (page *Names*)"
    return [f"{head}: {'; '.join(parts)}.", ""]


def _plain(formula: re.Match[str]) -> str:
    """Write a short formula without TeX, which folded parts and lists do not typeset."""
    return re.sub(r"\\(\w+)", r"\1", re.sub(r"\\dot (\w+)", r"\1'", formula[1]))


def _topic(port: Port, direction: str) -> str:
    kind = port.msgtype.replace("/msg/", "/")
    units = ("" if unit in ("", "1") else f" ({unit})" for unit in port.units)
    values = [f"{label}{unit}" for label, unit in zip(port.labels, units, strict=True)]
    shown = ", ".join(values[:12]) + (f" and {len(values) - 12} more" if len(values) > 12 else "")
    marks = [word for word, given in (("held", port.held), ("delayed", port.delayed)) if given]
    return f"| `{port.topic}` | {', '.join([direction, *marks])} | {kind} | {shown} |"


def parameters(model: type[Params]) -> list[str]:
    """Return the lines of a table of parameters."""
    head = "| parameter | default | unit | bounds | live: may change while running |"
    return [head, "|---|---|---|---|---|", *(_parameter(d) for d in declarations(model))]


def _parameter(d: Declaration) -> str:
    bounds = " to ".join(("" if x is None else f"{x:g}") for x in (d.lower, d.upper)).strip()
    bounds = {"to": ""}.get(bounds, bounds)
    doc = d.doc.replace("|", "\\|") + (" (live)" if d.live else "")
    default = str(list(d.default) if isinstance(d.default, tuple) else d.default)
    return " | ".join(("| `" + d.name + "`", default or " ", d.unit, bounds, doc)) + " |"


def chosen(prefixes: Sequence[str]) -> list[str]:
    """Names of the scenarios that begin so, in order; a name of its own begins with itself."""
    return [n for n in sorted(list_scenarios()) if any(n == p or n.startswith(f"{p}_") for p in prefixes)]


def claims(prefixes: Sequence[str], old: str | None) -> str:
    """Return claims of the paper with their measurements, from the `old` table or from runs, and their verdicts."""
    kept: dict[tuple[str, ...], list[str]] = {}
    for row in (row[2:-2].split(" | ") for row in (old or "").splitlines() if row.startswith("| ")):
        if len(row) == 6:
            kept.setdefault((*row[:3], row[-1]), []).append(row[3])
    lines = ["| the paper says | where | published | measured | verdict | scenario |", "|---|---|---|---|---|---|"]
    for name in chosen(prefixes):
        for key, claim in load_scenario(name).claims.items():
            compared = ", ".join(f"{kind} {x}" for kind, x in claim.compared().items())
            number = f"{claim.published:.6g}" if claim.published is not None else compared
            verdict = f"**{claim.verdict.replace('_', ' ')}**" + (f": {claim.reason}" if claim.reason else "")
            cells = [claim.text or key.replace("_", " "), claim.where, number, verdict, f"`{name}`"]
            cells = [c.replace("|", "\\|") for c in cells]
            if claim.verdict == "not_checkable" and not claim.figure:
                text = " "
            elif old is not None:
                text = (kept.get((*cells[:3], cells[-1])) or ["?"]).pop(0)
            else:
                scenario, _, figure = (claim.figure or key).rpartition(".")
                text = next(_shown(r) for r in results(scenario or name) if r.name == figure)
            lines.append("| " + " | ".join([*cells[:3], text, *cells[3:]]) + " |")
    counts = Counter(v.replace("_", " ") for v in re.findall(r"\*\*(.*?)\*\*", "\n".join(lines)))
    reported = ", ".join(f"{n} {v}" for v, n in counts.most_common())
    return folded(f"Claim by claim: {len(lines) - 2} of them, {reported}", "\n".join(lines))


def _shown(result: Result) -> str:
    """A figure to five digits."""
    return "never" if math.isinf(result.number) else f"{result.number:.5g} {result.unit}".strip()


def house(package: str) -> str:
    """Return the folders of a package, bottom up: the content of each and which it imports."""
    lines = ["| floor | room | holds | knows |", "|---|---|---|---|"]
    for room in rooms(package).values():
        known = ", ".join(f"`{name}`" for name in sorted(room.knows))
        lines.append(f"| {room.floor} | `{room.name}` | {room.text.rstrip('.')} | {known} |")
    return "\n".join(lines)


def file_format(result: FileFormat) -> str:
    """Return the names of a file format and what softrig does with them, folded."""
    lines = ["| name | | |", "|---|---|---|"]
    for name, (use, text) in result.table.items():
        lines.append(f"| `{name}` | {use} | {text} |")
    counts = Counter(use for use, _ in result.table.values())
    reported = ", ".join(f"{n} {use}" for use, n in counts.most_common())
    return folded(f"{result.title}: {len(result.table)} names, {reported} ({result.standard})", "\n".join(lines))


def code(module: str, names: Sequence[str]) -> str:
    """Source of functions of a module, and of methods by the name of their class."""
    result = (attrgetter(name)(import_module(module)) for name in names)
    return "```python\n" + "\n\n\n".join(dedent(inspect.getsource(one)).rstrip() for one in result) + "\n```"


def scenarios(prefixes: Sequence[str]) -> str:
    """Scenarios with title and length."""
    lines = ["| scenario | | s |", "|---|---|---|"]
    for name in chosen(prefixes):
        scenario = load_scenario(name)
        lines.append(f"| `{name}` | {scenario.title} | {scenario.duration:g} |")
    return folded(f"All {len(lines) - 2} scenarios", "\n".join(lines))


def sources(prefixes: Sequence[str]) -> str:
    """Papers that scenarios cite, each once, with their BibTeX entries."""
    keys = [key for name in chosen(prefixes) for key in load_scenario(name).cites]
    result = cited(list(dict.fromkeys(keys)))
    bibtex = "\n\n".join(c.bibtex for c in result)
    return "\n".join([*listed(result), "", folded("BibTeX", f"```bibtex\n{bibtex}\n```")])


def verdicts(system: str) -> str:
    """Count the claims of a system by verdict."""
    counts = _verdict_counts().get(system, Counter())
    return ", ".join(f"{counts[v]} {v.replace('_', ' ')}" for v in VERDICTS if counts[v])


@cache
def _verdict_counts() -> dict[str, Counter[str]]:
    """Count the verdicts of all scenarios and studies, by system, each statement once; read once."""
    messages: dict[str, dict[tuple[str, ...], str]] = {}
    claims = [(s.system, s.name, s.claims) for s in map(load_scenario, list_scenarios())]
    claims += [(load_scenario(s.scenario).system, s.name, s.claims) for s in map(load_study, list_studies())]
    for system, name, own in claims:
        messages.setdefault(system, {}).update((f.statement, f.verdict) for f in hold(name, own, lambda _: None, {}))
    return {system: Counter(result.values()) for system, result in messages.items()}


@cache
def results(name: str) -> list[Result]:
    """Figures of a scenario, run once in process."""
    return simulate(name).results


def measured(what: str) -> str:
    """Return figures of runs in process, with five digits: ``FIGURE... of SCENARIO...`` makes one row for each
    scenario.
    """
    figures, names = (part.split() for part in what.split(" of "))
    rows = []
    for name in names:
        gathered = {r.name: _shown(r) for r in results(name)}
        rows.append(
            " | ".join([f"| `{name}`", load_scenario(name).title, *(gathered.get(f, "") for f in figures)]) + " |"
        )
    titles = " | ".join(f.replace("_", " ") for f in figures)
    table = "\n".join([f"| scenario | | {titles} |", "|---" * (len(figures) + 2) + "|", *rows])
    summary = f"Measured in {len(rows)} scenarios: {titles.replace(' | ', ', ')}"
    return table if len(rows) <= LONG else folded(summary, table)


def untrue(page: str, path: Path, runs: bool = False) -> list[str]:
    """Describe which numbers of the text of a page at `path` have no source or differ from it."""
    tests = next((f / "tests" for f in path.resolve().parents if (f / "tests").is_dir()), path.parent)
    run = (lambda name: {r.name: r.number for r in results(name)}) if runs else None
    others = (p.read_text(encoding="utf-8") for p in sorted(tests.parent.glob("ros_pkgs/*/doc/**/*.md")))
    return list(numbers.faults(page, tests, run, "".join(others)))


def main(args: Sequence[str] | None = None) -> int:
    """Write the generated parts of pages, or check them against the code, and the other numbers against their
    sources.
    """
    parser = argparse.ArgumentParser(prog="scripts/softrig docs pages", description=main.__doc__)
    parser.add_argument("pages", nargs="+", type=Path, metavar="FILE", help="of a page")
    parser.add_argument("--check", action="store_true")
    parser.add_argument("--runs", action="store_true", help="also what is measured: takes as long as the runs")
    parser.add_argument("--pictures", action="store_true", help="the pictures that a page has a module in drawn for")
    given = parser.parse_args(args)
    if missing := [str(path) for path in given.pages if not path.is_file()]:
        parser.error(f"no such file: {', '.join(missing)}")
    status = 0
    for path in given.pages:
        old = path.read_text(encoding="utf-8")
        new = generate(old, given.runs)
        for name, number in re.findall(r"<!-- picture: (\S+) (\d+) -->", old) if given.runs and not given.check else ():
            draw(name, int(number), path.parent)
        for words in ANIMATION.findall(old) if given.runs and not given.check else ():
            animate(words[0], float(words[1]), float(words[2]), path.parent)
        if given.pictures and path.stem in drawn.PAGES:
            import_module(f"{drawn.__name__}.{path.stem}").draw(path.parent)
        if new != old:
            print(f"{path}: {'is not as the code says' if given.check else 'written'}")
            status = 1 if given.check else status
            if not given.check:
                path.write_text(new, encoding="utf-8")
        for fault in untrue(new, path, given.runs):
            print(f"{path}: {fault}")
            status = 1
    return status
