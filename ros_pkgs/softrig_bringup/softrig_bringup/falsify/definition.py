"""Definition of a falsification: validated data from ``config/studies/NAME.falsify.yaml`` or the command line."""

from __future__ import annotations

from os.path import isfile
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, ValidationError
from softrig_core import ScenarioError, list_scenarios
from softrig_core.entry import Entry
from softrig_core.errors import closest
from softrig_core.judge.expectation import Expected
from softrig_core.scenario.places import explain
from softrig_core.scenario.scenario_file import find
from softrig_core.scenario.yaml_file import read_mapping

from ..study.definition import study_folders

SUFFIX = ".falsify.yaml"


class Falsification(Entry):
    """A search for the run that violates a requirement.

    Parameters
    ----------
    scenario : str
        Name or file.
    requirements : tuple of str
        Names; if empty, those of the scenario whose bounds follow the machine's parameters.
    strict : bool
        Without `requirements`: whether to judge all of the scenario's, also those with numbers for the unchanged
        machine.
    over : dict of str to str
        Range by parameter or signal, see `softrig_bringup.falsify.space.parse`.
    budget : int
        Runs of the search.
    first : bool
        End at the first violation instead of looking for the worst.
    expect : Expectation, optional
        Expected least margin.
    """

    name: str
    title: str = ""
    scenario: str
    requirements: tuple[str, ...] = ()
    strict: bool = False
    over: dict[str, str] = Field(min_length=1)
    duration: float | None = Field(None, gt=0.0)
    budget: int = Field(200, ge=1, le=1_000_000)
    seed: int = Field(0, ge=0, lt=2**31)
    sampler: Literal["cmaes", "tpe", "random"] = "cmaes"
    first: bool = False
    expect: Expected | None = None


def list_falsifications() -> dict[str, Path]:
    """Return every falsification's name and file."""
    result: dict[str, Path] = {}
    for folder in study_folders():
        for path in sorted(folder.glob(f"*{SUFFIX}")):
            result.setdefault(path.name.removesuffix(SUFFIX), path)
    return result


def falsification_of(name: str, changes: dict[str, Any]) -> Falsification:
    """Read a falsification by name or file, or make one of a scenario, with the command line's changes.

    Raises
    ------
    ScenarioError
        Neither, or bad data; names file and key.
    """
    known = list_falsifications()
    path = known.get(name) or (Path(name) if name.endswith(SUFFIX) and isfile(name) else None)
    if path is not None:
        raw = {"title": path.name, **read_mapping(path), "name": path.name.removesuffix(SUFFIX)}
    elif isfile(name) or find(name) is not None:
        raw = {"name": Path(name).stem, "scenario": name}
    else:
        names = [*known, *list_scenarios()]
        raise ScenarioError(f"{name!r} is neither a falsification nor a scenario{closest(name, names)}")
    source = path.name if path else name
    raw["over"] = {**raw.get("over", {}), **changes.pop("over", {})}
    if not raw["over"]:
        raise ScenarioError(
            f"{source}: nothing to search over; expected --over NAME=LOW..HIGH of a node or a fault, or "
            "--over SIGNAL=LOW..HIGH*6"
        )
    try:
        return Falsification.model_validate(raw | changes)
    except ValidationError as error:
        raise ScenarioError(f"{source}: {explain(error, Falsification)}") from None
