"""The folders of a package, their content, and which they import, read from the import statements."""

from __future__ import annotations

import ast
from dataclasses import dataclass, field
from pathlib import Path

from pages.statements import imported

PACKAGES = Path(__file__).parents[2] / "ros_pkgs"


@dataclass
class Room:
    """A folder of modules.

    Parameters
    ----------
    name : str
        Below its package: ``node.seam``.
    text : str
        What it holds, the first line of its docstring.
    modules, lines : int
    knows : set of str
        Rooms that its modules import from.
    floor : int
        One above the highest room that it knows; 0 is the ground.
    """

    name: str
    text: str
    modules: int = 0
    lines: int = 0
    knows: set[str] = field(default_factory=set)
    floor: int = 0


def rooms(package: str) -> dict[str, Room]:
    """Return the rooms of a package by name, from the ground up."""
    root = PACKAGES / package / package
    results = {}
    for file in sorted(root.glob("**/__init__.py")):
        name = ".".join(file.parent.relative_to(root).parts)
        if name:
            text = (ast.get_docstring(ast.parse(file.read_text())) or "").partition("\n")[0]
            results[name] = Room(name, text)
    for file in sorted(root.rglob("*.py")):
        own = ".".join(file.parent.relative_to(root).parts)
        if not own:
            continue
        source = file.read_text()
        results[own].modules += file.stem != "__init__"
        results[own].lines += source.count("\n")
        for node, _ in imported(file):
            if isinstance(node, ast.ImportFrom):
                results[own].knows |= _targets(node, [package, *own.split(".")], package, results) - {own}
    for room in results.values():
        _raise(room, results)
    return dict(sorted(results.items(), key=lambda item: (item[1].floor, item[0])))


def _targets(node: ast.ImportFrom, inside: list[str], package: str, rooms: dict[str, Room]) -> set[str]:
    base = (
        ".".join([*inside[: len(inside) - node.level + 1], *filter(None, [node.module])]) if node.level else node.module
    )
    names = {f"{base}.{alias.name}" for alias in node.names}
    own = {name.removeprefix(f"{package}.") for name in names if name.startswith(f"{package}.")}
    fitting = ([room for room in rooms if name == room or name.startswith(f"{room}.")] for name in own)
    return {max(one, key=len) for one in fitting if one}


def _raise(room: Room, rooms: dict[str, Room]) -> int:
    """Rank a folder above those that it imports."""
    room.floor = max((_raise(rooms[name], rooms) + 1 for name in room.knows), default=0)
    return room.floor
