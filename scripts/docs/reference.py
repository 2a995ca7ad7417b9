"""Pages of the reference that the code writes: verbs, nodes, figures, faults, messages, Python."""

from __future__ import annotations

import argparse
import importlib
import inspect
import re
from collections.abc import Callable
from pathlib import Path
from typing import get_args
from unittest import mock

import softrig_core
from pages.generated import node, parameters
from softrig_bringup import cli
from softrig_control.nodes.fault import Fault, FaultParams, Kind
from softrig_core import ScenarioError
from softrig_core.judge.registry import find, registered
from softrig_core.renamed import executables
from softrig_core.rig.installed import load_block
from softrig_core.wire.types import TYPES

from .outline import ROOT

PACKAGES = sorted(p.parent.name for p in ROOT.glob("ros_pkgs/*/setup.cfg"))


def write(site: Path) -> None:
    """Write all generated pages of the reference."""
    made = (
        all_nodes()
        | front_door()
        | {"verbs": verbs(), "figures": figures(), "faults": faults(), "messages": messages()}
    )
    for package in PACKAGES:
        if package != "softrig_core":
            made |= api(package)
    for name, text in made.items():
        page = site / "reference" / f"{name}.md"
        page.parent.mkdir(exist_ok=True)
        page.write_text(text, encoding="utf-8")


def _cell(text: object) -> str:
    """Return the text of a cell with Markdown's special characters escaped, except in code."""
    parts = str(text).replace("|", "\\|").replace("\n", " ").split("`")
    return "`".join(p if k % 2 else p.replace("<", "&lt;").replace("*", "\\*") for k, p in enumerate(parts))


def verbs() -> str:
    """Return every verb with its options, from its parser."""
    parser = cli.make_parser()
    head = "Every command of `softrig` with all that it takes; `softrig COMMAND --help` prints the same."
    parts = ["# Commands", "", head, "", parser.epilog or "", ""]
    (subparsers,) = (a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
    helps = {a.dest: a.help or "" for a in subparsers._choices_actions}
    parts += ["| command | |", "|---|---|"]
    parts += [f"| [`{name}`](#{name}) | {_cell(helps[name])} |" for name in subparsers.choices] + [""]
    for name, sub in subparsers.choices.items():
        own = sub
        if name in cli.FOREIGN:
            module, function, _ = cli.FOREIGN[name]
            own = _parser_of(getattr(importlib.import_module(module), function))
        parts += _verb(name, own, helps[name], "##")
        for part, (module, function, text) in cli.FOREIGN.items():
            if part.startswith(f"{name} "):
                parts += _verb(part, _parser_of(getattr(importlib.import_module(module), function)), text, "###")
    return "\n".join(parts)


class _Captured(BaseException):
    """Carries the parser of a command line out of it."""


def _parser_of(main: Callable[[list[str]], int]) -> argparse.ArgumentParser:
    """Return the parser that a command makes when it is called."""

    def caught(self: argparse.ArgumentParser, *_: object, **__: object) -> None:
        raise _Captured(self)

    with mock.patch.object(argparse.ArgumentParser, "parse_args", caught):
        try:
            main([])
        except _Captured as found:
            return found.args[0]
    raise ValueError(f"{main} makes no parser")


def _verb(name: str, parser: argparse.ArgumentParser, text: str, mark: str) -> list[str]:
    parts = [f"{mark} {name}", "", text[:1].upper() + text[1:] + ".", ""]
    nested = [a for a in parser._actions if isinstance(a, argparse._SubParsersAction)]
    rows = []
    for action in parser._actions:
        if action.help == argparse.SUPPRESS or isinstance(action, argparse._HelpAction | argparse._SubParsersAction):
            continue
        value = (
            ""
            if action.nargs == 0
            else action.metavar
            or ("{" + ",".join(map(str, action.choices)) + "}" if action.choices else action.dest.upper())
        )
        value = " ".join(value) if isinstance(value, tuple) else value
        shown = " ".join(filter(None, (", ".join(action.option_strings), value)))
        rows.append(f"| {_cell(f'`{shown}`')} | {_cell((action.help or '') % _defaults(action, parser))} |")
    if rows:
        parts += ["| | |", "|---|---|", *rows, ""]
    for group in nested:
        about = {a.dest: a.help or "" for a in group._choices_actions}
        for child, sub in group.choices.items():
            if f"{name} {child}" not in cli.FOREIGN:  # this verb has its own parser, which follows below
                parts += _verb(f"{name} {child}", sub, about.get(child, sub.description or ""), f"{mark}#")
    return parts


def _defaults(action: argparse.Action, parser: argparse.ArgumentParser) -> dict[str, object]:
    return vars(action) | {"prog": parser.prog}


def all_nodes() -> dict[str, str]:
    """Every executable with its topics and parameters, from their declarations: a page each, and their list."""
    parts = [
        "# Nodes",
        "",
        "Every executable of the packages: what it reads and publishes, its parameters with unit",
        "and bounds. `scripts/softrig node PACKAGE EXECUTABLE` starts one with the values given here.",
        "",
    ]
    pages: dict[str, str] = {}
    for package in PACKAGES:
        shown = []
        for executable in executables(package):
            try:
                load_block(package, executable)
            except ScenarioError:
                continue  # the executable is a tool, not a node
            shown.append(executable)
        if shown:
            parts += [f"## {package}", ""]
            for executable in shown:
                head, tables = node(package, executable)
                place = f"nodes/{package.removeprefix('softrig_')}_{executable}"
                start = f"`scripts/softrig node {package} {executable}`"
                pages[place] = "\n".join(
                    [f"# {executable}", "", head, "", f"A node of {package}: {start}", "", tables, ""]
                )
                parts += [f"- [`{executable}`]({place}.md): {head.splitlines()[0]}"]
            parts += [""]
    return {"nodes": "\n".join([*parts, "```{toctree}", ":hidden:", "", *pages, "```", ""]), **pages}


def figures() -> str:
    """Every figure function, from its signature and docstring."""
    parts = [
        "# Figures",
        "",
        "What a scenario can measure: functions that its `figures` name.",
        "`scripts/softrig list --figures NAME` prints the same.",
        "",
    ]
    for name in registered():
        function = find(name)
        parts += [
            f"## {name}",
            "",
            f"Unit: {getattr(function, 'unit', None) or 'as in the scenario'}.",
            "",
            "```{eval-rst}",
            f".. autofunction:: {function.__module__}.{function.__qualname__}",
            "   :no-index:",
            "```",
            "",
        ]
    return "\n".join(parts)


def faults() -> str:
    """Return the kinds of faults, from their declaration."""
    doc = inspect.cleandoc((Fault.__doc__ or "").partition("Notes\n")[0])
    parts = [
        "# Faults",
        "",
        doc,
        "",
        "Kinds: " + ", ".join(f"`{kind}`" for kind in get_args(Kind)) + ".",
        "",
        "What each does and how a scenario names them: [the test bench](../tutorials/test_bench.md#a-fault). All "
        "parameters of the node `softrig_control fault`:",
        "",
        *parameters(FaultParams),
        "",
    ]
    return "\n".join(parts)


def messages() -> str:
    """Return every message type of softrig, from its codec."""
    parts = [
        "# Messages",
        "",
        "The message types that ports use, with what each carries on the wire, in order. All "
        "come from common_interfaces; every message in a loop carries its tick in `header.stamp`.",
        "",
        "| type | on the wire |",
        "|---|---|",
    ]
    for name, kind in TYPES.items():
        items = (f"{i.name or i.kind}" + (f" ({i.size})" if i.size else "") for i in kind.schema)
        parts.append(f"| `{name.replace('/msg/', '/')}` | {', '.join(items)} |")
    return "\n".join([*parts, ""])


def front_door() -> dict[str, str]:
    """Write what `softrig_core` exports, from docstrings: a page per module, and their list."""
    homes = vars(softrig_core)["_HOMES"]
    modules = {
        f"softrig_core.{home}": sorted(homes[home].split(), key=lambda name: name != "simulate")
        for home in sorted(homes, key=lambda home: (home != "run.simulate", home))
        if home != "former"  # deprecated names
    }
    head = "What a user needs is named by the package itself: `from softrig_core import simulate`."
    return _modules("softrig_core", head, modules, named_by="softrig_core")


def api(package: str) -> dict[str, str]:
    """Write the docstrings of a package's modules, classes and functions: a page each, and their list."""
    described = re.search("<description>(.*)</description>", (ROOT / "ros_pkgs" / package / "package.xml").read_text())
    assert described, f"{package}: package.xml without a description"
    modules = {}
    for path in sorted((ROOT / "ros_pkgs" / package / package).rglob("*.py")):
        dotted = ".".join(path.relative_to(ROOT / "ros_pkgs" / package).with_suffix("").parts).removesuffix(".__init__")
        if re.search(r"\.template|__main__", dotted):
            continue
        try:
            module = importlib.import_module(dotted)
        except ImportError:
            continue  # the module needs launch or an optional package
        there = ((n, v) for n, v in vars(module).items() if inspect.isclass(v) or inspect.isfunction(v))
        if own := [n for n, v in there if n[0] != "_" and v.__module__ == dotted and inspect.getdoc(v)]:
            modules[dotted] = own
    return _modules(package, f"{described[1]}. By module: what each holds, from its docstrings.", modules)


def _modules(package: str, head: str, modules: dict[str, list[str]], named_by: str = "") -> dict[str, str]:
    """Write a page for each of the modules, with the given names, and one that lists them.

    The pages of modules are in no sidebar, which every page of the site carries whole.
    """
    listed = [f"# Python: {package}", "", head, ""]
    pages: dict[str, str] = {}
    for dotted, names in modules.items():
        short = dotted.removeprefix(f"{package}.")
        about = " ".join((inspect.getdoc(importlib.import_module(dotted)) or "").partition("\n\n")[0].split())
        parts = [
            "---",
            "orphan: true",
            "---",
            "",
            f"# {short}",
            "",
            about,
            "",
            f"A module of [{package}](../{package}.md).",
            "",
            "```{eval-rst}",
        ]
        for name in names:
            value = getattr(importlib.import_module(named_by or dotted), name)
            kind = "autoclass" if inspect.isclass(value) else "autofunction" if callable(value) else "autodata"
            parts += [f".. {kind}:: {named_by or dotted}.{name}"]
            parts += ["   :members:", ""] if named_by and kind == "autoclass" else [""]
        pages[f"{package}/{short}"] = "\n".join([*parts, "```", ""])
        listed += [f"- [`{short}`]({package}/{short}.md): {', '.join(f'`{name}`' for name in names)}  ", f"  {about}"]
    return {package: "\n".join([*listed, ""]), **pages}
