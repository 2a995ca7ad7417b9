"""Scenario files: their locations, inheritance and variants."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator, Mapping
from functools import lru_cache
from itertools import chain
from os.path import exists, isfile, samefile
from pathlib import Path
from typing import Any, NamedTuple

from ..board import SIMULATORS
from ..errors import ScenarioError, closest
from ..kit.resource import prefixes
from ..renamed import report

SHARED = re.compile(r"\$([A-Za-z_]\w*)")  # a reference to a shared value
_FILE = re.compile(r"[^/\s$:][^\s$:]{0,300}\.[A-Za-z]\w{0,9}")  # a relative path that ends as files do
PARENTS = 50  # length of a chain of `extends`
OWN = ("expect", "requirements", "claims")  # a scenario does not inherit the keys by which it is judged


def scenario_folders() -> Iterator[Path]:
    """Return the folders of scenario files: SOFTRIG_SCENARIOS, then ``share/PACKAGE/scenarios`` of installed
    packages.
    """
    listed = [Path(p) for p in os.environ.get("SOFTRIG_SCENARIOS", "").split(os.pathsep) if p]
    installed = (folder for prefix in prefixes() for folder in sorted(prefix.glob("share/*/scenarios")))
    return (f for f in chain(listed, installed) if f.is_dir())  # looked for as far as somebody asks


def list_scenarios(broken: list[ScenarioError] | None = None) -> dict[str, Path]:
    """Return every scenario name, variants included, and the file it is in.

    Parameters
    ----------
    broken : list, optional
        Gets what is wrong with files that cannot be read, which are then left out.

    Raises
    ------
    ScenarioError
        A file cannot be read, and `broken` is not given.
    """
    result: dict[str, Path] = {}
    for folder in scenario_folders():
        for path in sorted(folder.glob("*.yaml")):
            if path.stem in result and isfile(path) and samefile(path, result[path.stem]):
                continue  # a checkout's own, which its install folder links to
            try:
                for name in list(names(path)):
                    result.setdefault(name, path)
            except ScenarioError as error:
                if broken is None:
                    raise
                broken.append(error)
    return result


def locate(name: str) -> tuple[str, Path]:
    """Find a scenario: its name and the file it is in.

    Parameters
    ----------
    name : str
        A name, a variant's name, or the path of a YAML file.

    Raises
    ------
    ScenarioError
        There is none of that name; the message names the closest.
    """
    path = Path(name)
    if path.suffix in (".yaml", ".yml") and isfile(path):
        return path.stem, path
    result = find(name)
    if result is None and (path / "metrics.json").is_file():
        raise ScenarioError(f"{name}: is a run, expected a scenario; `softrig run --like {name}` repeats that run")
    if result is None and path.suffix == ".zip" and isfile(path):
        raise ScenarioError(f"{name}: is a pack, expected a scenario; `softrig run --like {name}` repeats its run")
    if result is None and (path.suffix in (".yaml", ".yml") or len(path.parts) > 1):
        listed = f"; a scenario of this name is there: {path.stem}" if find(path.stem) is not None else ""
        raise ScenarioError(f"{name}: no such file, expected a scenario's YAML file or its name{listed}")
    if result is None:
        known = list_scenarios()
        near = closest(name, known) or ends(name, known)
        raise ScenarioError(f"scenario {name!r} is unknown{near}; `softrig list` shows all {len(known)}")
    return name, result


def ends(name: str, known: Iterable[str]) -> str:
    """Suggest the scenarios whose names end with a name."""
    result = [candidate for candidate in known if candidate.endswith(f"_{name}")][:3]
    return f" (did you mean {' or '.join(map(repr, result))}?)" if result else ""


def read(path: Path) -> dict[str, Any]:
    """Read the mapping of a scenario file; a file that has not changed is read once a process.

    Raises
    ------
    ScenarioError
        Cannot be read, not YAML, or not a mapping.
    """
    from .yaml_file import SIZE  # half of a start, for those that only look for a file

    try:
        state = path.stat()
    except OSError as error:
        raise ScenarioError(f"{path.name}: {error.strerror}") from None
    if state.st_size > SIZE:
        raise ScenarioError(f"{path.name}: {state.st_size} bytes, expected at most {SIZE}")
    return dict(_read(path, state.st_mtime_ns, state.st_size))


@lru_cache(maxsize=1024)
def _read(path: Path, changed: int, size: int) -> dict[str, Any]:
    from .yaml_file import read_mapping

    return read_mapping(path)


def names(path: Path) -> Iterator[str]:
    """Yield the names of the scenarios in a file: its own and those of its variants."""
    yield path.stem
    for variant in _variants(path, read(path)):
        yield f"{path.stem}_{variant}"


def resolve(name: str, path: Path, seen: tuple[str, ...] = ()) -> dict[str, Any]:
    """Apply `extends` and the variant that the name selects; the file's own data is not modified.

    Raises
    ------
    ScenarioError
        The scenario extends itself or an unknown scenario.
    """
    if len(seen) >= PARENTS:
        raise ScenarioError(
            f"{path.name}: extends more than {PARENTS} scenarios, one the other: {' -> '.join(seen[:3])} ..."
        )
    if name in seen:
        raise ScenarioError(f"{path.name}: extends itself: {' -> '.join((*seen, name))}")
    raw = _with_whole_paths(path, read(path))
    variants = _variants(path, raw)
    raw.pop("variants", None)
    parent = raw.pop("extends", None)
    if parent is not None:
        raw = inherit(resolve(parent, parent_of(path, parent), (*seen, name)), raw)
    if name != path.stem:
        raw = inherit(raw, variants[name.removeprefix(f"{path.stem}_")] or {})
    return raw


def _with_whole_paths(path: Path, raw: dict[str, Any]) -> dict[str, Any]:
    """Return the absolute path of a file that a node's parameter or link, or a shared value, names beside this one.

    A path that exists relative to the current directory stays as written.
    """

    def full(value: Any) -> Any:
        if isinstance(value, Mapping):
            return {k: full(v) for k, v in value.items()}
        if isinstance(value, list):
            return [full(v) for v in value]
        if not isinstance(value, str) or not _FILE.fullmatch(value) or isfile(value):
            return value
        return str(file.absolute()) if isfile(file := path.parent / value) else value

    def linked(link: Any) -> Any:
        if not isinstance(link, Mapping):
            return link
        result = dict(link)
        firmware, port = result.get("firmware"), result.get("port")
        if isinstance(firmware, str) and not exists(firmware) and exists(file := path.parent / firmware):
            result["firmware"] = str(file.absolute())
        if isinstance(port, str) and port.startswith(tuple(f"{kind}:" for kind in SIMULATORS)):
            kind, _, name = port.partition(":")
            if not isfile(name) and isfile(file := path.parent / name):
                result["port"] = f"{kind}:{file.absolute()}"
        return result

    def inside(part: Any) -> Any:
        if not isinstance(part, Mapping):
            return part
        result = dict(part)
        if "shared" in result:
            result["shared"] = full(result["shared"])
        if isinstance(nodes := result.get("nodes"), Mapping):
            result["nodes"] = {
                name: {k: full(v) if k == "parameters" else linked(v) if k == "link" else v for k, v in node.items()}
                if isinstance(node, Mapping)
                else node
                for name, node in nodes.items()
            }
        if isinstance(variants := result.get("variants"), Mapping):
            result["variants"] = {name: inside(changes) for name, changes in variants.items()}
        return result

    actual: dict[str, Any] = inside(raw)
    return actual


def inherit(base: Mapping[str, Any], change: Any) -> dict[str, Any]:
    """Merge a scenario's own entry into the inherited one.

    Mappings merge level by level, null removes, and the keys `OWN` come from the entry alone. A node with another
    executable loses the inherited parameters, and a figure with another function loses all inherited keys, because they
    would be meaningless.

    Parameters
    ----------
    base : mapping
        What is inherited; left as it is.
    change : mapping
        The scenario's own entry, or a variant's.
    """
    if not isinstance(change, Mapping):
        raise ScenarioError(f"a variant is a mapping of changes, got {change!r}")
    below = {k: v for k, v in base.items() if k not in OWN}
    change = _by_new_names(below.get("nodes"), change)
    for part, key, lost in (
        ("nodes", "executable", ("parameters",)),
        ("figures", "function", ("arguments", "unit", "since")),
    ):
        old, new = below.get(part), change.get(part)
        if isinstance(old, Mapping) and isinstance(new, Mapping):
            below[part] = {k: _without(v, new.get(k), key, lost) for k, v in old.items()}
    return merge(below, change)


def _by_new_names(below: Any, change: Mapping[str, Any]) -> Mapping[str, Any]:
    """Replace old names of executables, so that an inherited entry with the new name counts as the same executable."""
    nodes, below = change.get("nodes"), below if isinstance(below, Mapping) else {}
    if not isinstance(nodes, Mapping):
        return change
    results = dict(nodes)
    for name, entry in nodes.items():
        if isinstance(entry, Mapping) and isinstance(executable := entry.get("executable"), str):
            old = below.get(name)
            package = entry.get("package", old.get("package") if isinstance(old, Mapping) else None)
            if isinstance(package, str):
                results[name] = {**entry, "executable": report(package, executable)}
    return {**change, "nodes": results}


def _without(old: Any, new: Any, key: str, lost: tuple[str, ...]) -> Any:
    """Remove the keys `lost` of an entry if the overriding entry has another `key`."""
    if not isinstance(old, Mapping) or not isinstance(new, Mapping) or new.get(key, old.get(key)) == old.get(key):
        return old
    return {k: v for k, v in old.items() if k not in lost}


class Over(NamedTuple):
    """Changes to a mapping that is written as ``$name``; they are merged when the shared values are filled in."""

    below: str
    changes: tuple[Mapping[str, Any], ...]


def merge(base: Mapping[str, Any], change: Mapping[str, Any]) -> dict[str, Any]:
    """Merge one mapping into another, level by level; null removes a key.

    Parameters
    ----------
    base : mapping
        The lower mapping; it is not modified.
    change : mapping
        Mapping that overrides it. A mapping over a reference ``$name`` becomes an `Over`.
    """
    merged = dict(base)
    for key, value in change.items():
        if value is None:
            merged.pop(key, None)
        elif isinstance(value, Mapping):
            below = merged.get(key)
            if isinstance(below, Over):
                merged[key] = Over(below.below, (*below.changes, value))
            elif isinstance(below, str) and SHARED.fullmatch(below):
                merged[key] = Over(below, (value,))
            else:
                merged[key] = merge(below if isinstance(below, Mapping) else {}, value)
        else:
            merged[key] = value
    return merged


def _variants(path: Path, raw: Mapping[str, Any]) -> dict[str, Any]:
    variants = raw.get("variants") or {}
    if not isinstance(variants, dict):
        raise ScenarioError(f"{path.name}: variants: expected a mapping of name to changes, got {variants!r}")
    for name in variants:
        if not re.fullmatch(r"\w+", str(name)):
            raise ScenarioError(f"{path.name}: variant {name!r}: expected letters, digits and _ only")
    return {str(name): changes for name, changes in variants.items()}  # YAML reads 40 as a number


def parent_of(path: Path, parent: Any) -> Path:
    """Find the file of the scenario that another one extends; a ScenarioError names the nearest."""
    if not isinstance(parent, str) or "/" in parent:
        raise ScenarioError(f"{path.name}: extends: expected the name of a scenario, got {parent!r}"[:200])
    beside = path.with_name(f"{parent}.yaml")
    result = beside if isfile(beside) else find(parent, path.parent)
    if result is None:
        raise ScenarioError(f"{path.name}: extends {parent!r}, which is unknown{closest(parent, list_scenarios())}")
    return result


def find(name: str, first: Path | None = None) -> Path | None:
    """Find the file of a scenario by its name, or by the longest prefix of it that is a file with such a variant.

    Parameters
    ----------
    first : Path, optional
        A folder to look into before those of `scenario_folders`.

    Returns
    -------
    Path or None
        None: there is none of that name.
    """
    for folder in chain([first] if first else [], scenario_folders()):
        stem = "" if "/" in name else name
        while stem:
            path = folder / f"{stem}.yaml"
            if isfile(path) and (stem == name or name in names(path)):
                return path
            stem = stem.rpartition("_")[0]
    return None
