"""Location of a key in a scenario file, its variant or the scenario that it extends; only used in messages."""

from __future__ import annotations

import typing
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel, ValidationError

from ..errors import ScenarioError, closest
from .scenario_file import parent_of, read
from .yaml_file import compose


def place(name: str, path: Path, keys: Sequence[Any]) -> str:
    """Describe where a key of a scenario is written: ``motor.yaml, line 12``.

    Parameters
    ----------
    name : str
        Of the scenario, which may be a variant.
    path : Path
        Of its file.
    keys : sequence
        From the top of the scenario down; where the last ones are not written, the line of those above.

    Returns
    -------
    str
        The file alone when none of them is.
    """
    results = [(*_line(file, [*above, *keys]), file, len(above)) for file, above in _levels(name, path)]
    depth, line, file, above = max(results, key=lambda each: each[0] - each[3])
    return f"{file.name}, line {line}" if depth > above else path.name


def _levels(name: str, path: Path, seen: tuple[str, ...] = ()) -> Iterator[tuple[Path, list[str]]]:
    """Yield where a key may be defined, the strongest place first: file, and the keys above it."""
    if name != path.stem:
        yield path, ["variants", name.removeprefix(f"{path.stem}_")]
    yield path, []
    parent = read(path).get("extends")
    if isinstance(parent, str) and parent not in seen:
        with suppress(ScenarioError):
            yield from _levels(parent, parent_of(path, parent), (*seen, parent))


def _line(file: Path, keys: Sequence[Any]) -> tuple[int, int]:
    """Follow keys into a file as far as they exist; return their number and the line of the last one."""
    node, line = compose(file.read_text(encoding="utf-8")), 1
    for depth, key in enumerate(keys):
        below: list[tuple[Any, Any]] = []
        if isinstance(node, yaml.MappingNode):
            below = [(k, v) for k, v in node.value if k.value == str(key)]
        elif isinstance(node, yaml.SequenceNode) and isinstance(key, int) and key < len(node.value):
            below = [(node.value[key], node.value[key])]
        if not below:
            return depth, line
        line, node = below[0][0].start_mark.line + 1, below[0][1]
    return len(keys), line


def explain(error: ValidationError, model: type[BaseModel] | None = None) -> str:
    """Describe in one line the first error of a validation and its place; for an unknown key, also a similar one.

    Parameters
    ----------
    model : type of BaseModel, optional
        What was validated.
    """
    first = error.errors()[0]
    location = ".".join(str(p) for p in first["loc"])
    more = f" (and {error.error_count() - 1} more)" if error.error_count() > 1 else ""
    hint = first["msg"].removeprefix("Value error, ")
    if first["type"] == "extra_forbidden":
        key, keys = str(first["loc"][-1]), _keys(model, first["loc"][:-1])
        hint = f"unknown key{closest(key, keys)}"
        if "arguments" in keys and hint == "unknown key":  # key of a figure
            hint += f"; arguments of its function belong below arguments: {{{key}: ...}}"
    structured = first["type"] == "missing" or isinstance(first["input"], BaseModel | dict)
    value = "" if structured else f", got {first['input']!r}"[:120]
    return f"{location}: {hint}{value}{more}" if location else f"{hint}{more}"


def _keys(model: type[BaseModel] | None, above: Sequence[Any]) -> list[str]:
    """Return the keys that a model accepts below others."""
    for key in above:
        if model is not None and key in model.model_fields:
            model = next(_models(model.model_fields[key].annotation), None)
    return list(model.model_fields) if model else []


def _models(annotation: Any) -> Iterator[type[BaseModel]]:
    """Yield the models that an annotation names."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for part in typing.get_args(annotation):
        yield from _models(part)
