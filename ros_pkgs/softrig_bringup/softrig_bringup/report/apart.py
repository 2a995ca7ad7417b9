"""Distinction of runs: their names on a page, and the differences between them."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from softrig_core.kit.file_format import json_of

from .record import RunRecord

SHORT, LONGEST = 30, 60  # letters of a run's name, and of the description of a difference


def names(runs: Sequence[tuple[Path, RunRecord]], labels: Sequence[str] = ()) -> list[str]:
    """Name each run by the command line, by its own label, or by its folder.

    Parameters
    ----------
    labels : sequence of str
        Names of the first runs.

    Returns
    -------
    list of str
        All names are different. A folder is named by the last parts of its path that distinguish it or, if these are
        long, by what differs between the runs. The same text is appended to equal labels.
    """
    folders = _tails([path for path, _ in runs])
    if max(map(len, folders), default=0) > SHORT:
        folders = _by_difference([run for _, run in runs]) or folders
    wanted = [run.label for _, run in runs]
    wanted[: len(labels)] = labels
    return [f"{w} ({f})" if w and wanted.count(w) > 1 else w or f for w, f in zip(wanted, folders, strict=True)]


def _by_difference(runs: Sequence[RunRecord]) -> list[str]:
    """Name runs by their differences, such as ``delta 2, seed 3``; empty if that is too long or not unique."""
    changed, _ = differing(runs)
    entries = {key: values for key, values in changed.items() if not key.startswith(("code of", "version of", "node "))}
    columns = [
        [value if key in ("scenario", "mode", "ended") else f"{key.split('.')[-1]} {value}" for value in values]
        for key, values in entries.items()
    ]
    results = [", ".join(filter(None, values)) for values in zip(*columns, strict=True)]
    fits = len({*results}) == len(runs) and all(results) and max(map(len, results)) <= LONGEST
    return results if fits else []


def _tails(paths: Sequence[Path]) -> list[str]:
    """The last parts of each path, as many as make them different."""
    parts = [path.absolute().parts for path in paths]
    for n in range(1, max(map(len, parts)) + 1):
        results = ["/".join(p[-n:]) for p in parts]
        if len({*results}) == len({*parts}):
            break
    return [f"{name} [{k}]" if results.count(name) > 1 else name for k, name in enumerate(results, 1)]


def differing(runs: Sequence[RunRecord]) -> tuple[dict[str, list[str]], dict[str, list[str]]]:
    """Return the differences between runs: from the name of each difference to its value in each run, empty if absent.

    Returns
    -------
    changed : dict of str to list of str
        Differences made by a person: scenario, mode, seed, length, and changes on the command line or by hand. Also the
        code of each package, the nodes, the machine, and how the runs ended.
    follows : dict of str to list of str
        Parameters that differ as a consequence. If the runs do not record what was changed, these parameters are the
        change.
    """
    about: dict[str, Callable[[RunRecord], str]] = {
        "scenario": lambda r: r.scenario,
        "mode": lambda r: r.mode,
        "seed": lambda r: str(r.seed),
        "duration, s": lambda r: f"{r.duration_s:g}",
        "ended": lambda r: "broke" if r.error else r.stopped,
    }
    results = {item: [say(r) for r in runs] for item, say in about.items()}
    for kind, get in (("code of", lambda r: r.code), ("version of", machine)):
        for name in dict.fromkeys(name for r in runs for name in get(r)):
            results[f"{kind} {name}"] = [get(r).get(name, "") for r in runs]
    values: dict[str, list[str]] = {}
    for node in dict.fromkeys(name for r in runs for name in r.wiring.nodes):
        nodes = [r.wiring.nodes.get(node) for r in runs]
        results[f"node {node}"] = [f"{n.executable}{', outside' if n.outside else ''}" if n else "" for n in nodes]
        if len({*results[f"node {node}"]}) == 1:
            params = [dict(_leaves(node, r.parameters.get(node, {}))) for r in runs]
            values |= {name: [p.get(name, "") for p in params] for p in params for name in p}
    follows = {item: texts for item, texts in values.items() if len({*texts}) > 1}
    messages = [dict(_key_value(text) for text in r.changed if r.stopped != text) for r in runs]
    for item in dict.fromkeys(key for texts in messages for key in texts):
        results.setdefault(item, follows.pop(item, []) or [texts.get(item, "as in the scenario") for texts in messages])
    changed = {item: texts for item, texts in results.items() if len({*texts}) > 1}
    causes = {"scenario", *(key for texts in messages for key in texts)} - {"seed"}
    return (changed, follows) if causes & changed.keys() else (changed | follows, {})


def machine(run: RunRecord) -> dict[str, str]:
    """Return the versions; the commit is omitted if digests of the code are known."""
    return {k: v for k, v in run.versions.items() if k not in ("commit", "run.lock") or not run.code}


def _key_value(text: str) -> tuple[str, str]:
    """Split a change into its name and its value: ``node.k=3``, ``duration 3``, or a text by itself."""
    key, sign, value = text.partition("=")
    if sign:
        return key, value
    key, _, value = text.partition(" ")
    return ("duration, s", value) if key == "duration" else (key, value) if key == "seed" else (text, "yes")


def _leaves(name: str, value: Any) -> Iterator[tuple[str, str]]:
    """Yield each value below a name as text; JSON in a parameter is split, too."""
    if isinstance(value, str) and value[:1] in ("{", "["):
        with suppress(ValueError):
            value = json_of(value)
    if isinstance(value, dict):
        for key, item in value.items():
            yield from _leaves(f"{name}.{key}", item)
    elif isinstance(value, list) and any(isinstance(item, dict) for item in value):
        for k, item in enumerate(value):
            yield from _leaves(f"{name}[{k}]", item)
    else:
        yield name, value if isinstance(value, str) else json.dumps(value)
