"""Scenario files: one experiment as YAML, validated, with inheritance and variants."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from ..errors import ScenarioError


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class NodeEntry(_Model):
    """One node: which executable, with which parameters and remapped topics."""

    package: str
    executable: str
    parameters: dict[str, Any] = {}
    remap: dict[str, str] = {}
    external: bool = Field(False, description="somebody else starts it; our executable only tells its ports")


class MetricEntry(_Model):
    """One figure of merit and what it should be."""

    name: str
    function: str
    arguments: dict[str, Any] = {}
    unit: str = ""
    published: float | None = None
    expected: float | None = None
    tolerance: float | None = Field(None, ge=0)
    at_most: float | None = None
    at_least: float | None = None


class PlotEntry(_Model):
    """One picture: signals as ``topic/channel/field`` with an optional label.

    Parameters
    ----------
    title : str
    signals : dict of str to str
        Signal name to label (empty: the signal's own name). Over time also ``one - other``: a signal less the newest
        value of another.
    unit : str
        Of the y axis; when empty, that of the ports, with one row a unit.
    x : str
        Instead of time, the label below each signal's own topic that gives the x axis: ``x`` draws ``flux/y``
        against ``flux/x``, ``voltage/position`` a power against the voltage of the same topic.
    window : (float, float)
        First and last time (s) shown; None: the whole run.
    """

    title: str
    signals: dict[str, str] = Field(min_length=1)
    unit: str = ""
    x: str = ""
    window: tuple[float, float] | None = None


class Scenario(_Model):
    """A rig and its experiment."""

    name: str
    title: str
    system: str
    source: str
    duration: float = Field(gt=0)
    seed: int = Field(0, ge=0)
    timeout: float = Field(10.0, gt=0, description="wall-clock s without progress before a lockstep run fails")
    start_timeout: float = Field(30.0, gt=0, description="wall-clock s to wait for all nodes, 0 < external ones")
    nodes: dict[str, NodeEntry] = Field(min_length=1)
    metrics: tuple[MetricEntry, ...] = ()
    plots: tuple[PlotEntry, ...] = ()


def scenario_folders() -> list[Path]:
    """Where scenario files are looked for: SOFTRIG_SCENARIOS, then the installed share folder."""
    folders = [Path(p) for p in os.environ.get("SOFTRIG_SCENARIOS", "").split(os.pathsep) if p]
    for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
        if prefix:
            folders.append(Path(prefix) / "share" / "softrig_bringup" / "scenarios")
    return [f for f in folders if f.is_dir()]


def list_scenarios() -> dict[str, Path]:
    """Give every scenario name, variants included, and the file it is in."""
    found: dict[str, Path] = {}
    for folder in scenario_folders():
        for path in sorted(folder.glob("*.yaml")):
            for name in _names(path, _read(path)):
                found.setdefault(name, path)
    return found


def load_scenario(name: str, overrides: Mapping[str, Any] | None = None) -> Scenario:
    """Read a scenario by name or file.

    Parameters
    ----------
    name : str
        ``dc_motor_smc_b2``, a variant ``dc_motor_smc_b2_delta1``, or a path to a YAML file.
    overrides : mapping, optional
        ``node.parameter`` to value.

    Raises
    ------
    ScenarioError
        Unknown scenario, YAML error, unknown key or bad value; names file and key.
    """
    path = Path(name)
    if path.suffix in (".yaml", ".yml") and path.is_file():
        name = path.stem
    else:
        found = _find(name)
        if found is None:
            known = list_scenarios()
            raise ScenarioError(f"scenario {name!r} is unknown{_closest(name, known)}; `softrig list` shows all "
                                f"{len(known)}")  # fmt: skip
        path = found
    raw = _resolve(name, path)
    if "name" in raw:
        raise ScenarioError(f"{path.name}: key name: a scenario is named by its file")
    for key, value in (overrides or {}).items():
        node, _, parameter = key.partition(".")
        nodes = raw.get("nodes") or {}
        if node not in nodes or not parameter:
            raise ScenarioError(f"override {key!r}: expected node.parameter with node one of {', '.join(nodes)}")
        nodes[node] = merge(nodes[node] or {}, {"parameters": {parameter: value}})
    try:
        return Scenario.model_validate({**raw, "name": name})
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(p) for p in first["loc"])
        more = f" (and {error.error_count() - 1} more)" if error.error_count() > 1 else ""
        hint = "unknown key" if first["type"] == "extra_forbidden" else first["msg"]
        given = "" if first["type"] == "missing" else f", got {first['input']!r}"
        raise ScenarioError(f"{path.name}: {where}: {hint}{given}{more}") from None


def merge(base: Mapping[str, Any], change: Mapping[str, Any]) -> dict[str, Any]:
    """Lay one mapping over another, level by level; null removes a key."""
    merged = dict(base)
    for key, value in change.items():
        if value is None:
            merged.pop(key, None)
        elif isinstance(value, Mapping) and isinstance(merged.get(key), Mapping):
            merged[key] = merge(merged[key], value)
        else:
            merged[key] = value
    return merged


def _find(name: str) -> Path | None:
    """Find the file of a scenario, reading only those whose name could hold it."""
    for folder in scenario_folders():
        for path in sorted(folder.glob("*.yaml"), key=lambda p: -len(p.stem)):
            if name == path.stem or (name.startswith(f"{path.stem}_") and name in _names(path, _read(path))):
                return path
    return None


def _read(path: Path) -> dict[str, Any]:
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    try:
        raw = YAML(typ="safe", pure=True).load(path.read_text())
    except (YAMLError, UnicodeDecodeError) as error:
        raise ScenarioError(f"{path.name}: not valid YAML: {' '.join(str(error).split())}") from None
    if not isinstance(raw, dict):
        raise ScenarioError(f"{path.name}: expected a mapping of keys, got {type(raw).__name__}")
    return raw


def _names(path: Path, raw: Mapping[str, Any]) -> Iterator[str]:
    yield path.stem
    for variant in raw.get("variants") or {}:
        yield f"{path.stem}_{variant}"


def _resolve(name: str, path: Path, seen: tuple[str, ...] = ()) -> dict[str, Any]:
    """Apply `extends` and the variant that the name asks for."""
    if name in seen:
        raise ScenarioError(f"{path.name}: extends itself: {' -> '.join((*seen, name))}")
    raw = _read(path)
    variants = raw.pop("variants", None) or {}
    if not isinstance(variants, dict):
        raise ScenarioError(f"{path.name}: variants: expected a mapping of name to changes, got {variants!r}")
    parent = raw.pop("extends", None)
    if parent is not None:
        beside = path.with_name(f"{parent}.yaml")
        found = beside if beside.is_file() else _find(parent)
        if found is None:
            raise ScenarioError(
                f"{path.name}: extends {parent!r}, which is unknown{_closest(parent, list_scenarios())}"
            )
        raw = merge(_resolve(parent, found, (*seen, name)), raw)
    if name != path.stem:
        raw = merge(raw, variants[name.removeprefix(f"{path.stem}_")] or {})
    return raw


def _closest(name: str, known: Mapping[str, Any]) -> str:
    import difflib

    near = difflib.get_close_matches(name, list(known), 1)
    return f" (did you mean {near[0]!r}?)" if near else ""
