"""Golden bags: a short recorded run of a scenario that later versions must reproduce.

``bags/NAME/`` holds ``bag/`` and ``golden.yaml``, which says how it was made and what may differ.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from softrig_bags.compare import Comparison, Tolerance, compare
from softrig_bags.read import read_bag
from softrig_bags.write import write_bag
from softrig_core.errors import RunError, ScenarioError
from softrig_core.rig.inprocess import run_inprocess
from softrig_core.rig.replay import feed
from softrig_core.rig.rig import Rig
from softrig_core.rig.scenario import load_scenario
from softrig_core.wire.recording import Recording
from softrig_core.wire.signals import Signals

from .run import versions


class Allowed(BaseModel):
    """How far a number may be off: ``max(absolute, relative |golden|)``."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    absolute: float = Field(1e-9, ge=0)
    relative: float = Field(1e-9, ge=0)


class Recipe(BaseModel):
    """Content of golden.yaml.

    Parameters
    ----------
    scenario : str
    duration : float
        Length of the golden run, s; usually shorter than the scenario's.
    seed : int
    default : Allowed
        For every signal without a pattern of its own.
    tolerances : dict of str to Allowed
        By pattern of the signal name (``motor/state/*``).
    why : str
        Why the tolerances are what they are.
    made_with : dict of str to str
        Versions that wrote the bag.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)
    scenario: str
    duration: float = Field(gt=0)
    seed: int = Field(0, ge=0)
    default: Allowed = Allowed()
    tolerances: dict[str, Allowed] = {}
    why: str = ""
    made_with: dict[str, str] = {}


@dataclass(frozen=True)
class Golden:
    """A recipe, its rig and, once made, the golden recording."""

    folder: Path
    recipe: Recipe
    rig: Rig

    @property
    def bag(self) -> Path:
        """Where the bag is."""
        return self.folder / "bag"

    def recording(self) -> Recording:
        """Read the golden bag."""
        return read_bag(self.bag)

    def rerun(self) -> Recording:
        """Run the scenario as it is now."""
        recording = Recording((t, p.msgtype) for t, p in self.rig.topics.items())
        run_inprocess(self.rig, self.recipe.seed, recording)
        return recording

    def compare(self, new: Recording, topics: Sequence[str] | None = None) -> Comparison:
        """Compare a new recording with the golden one within the recipe's tolerances."""
        limits = {name: Tolerance(a.absolute, a.relative) for name, a in self.recipe.tolerances.items()}
        default = Tolerance(self.recipe.default.absolute, self.recipe.default.relative)
        return compare(Signals(self.recording()), Signals(new), default=default, tolerances=limits, topics=topics)

    def open_loop(self, node: str) -> Comparison:
        """Feed one node with the golden inputs and compare what it answers."""
        member = next(m for m in self.rig.members if m.name == node)
        answers = feed(self.rig, member, self.recipe.seed, self.recording())
        return self.compare(answers, list(answers.topics))

    def make(self) -> Comparison | None:
        """Write the golden bag anew; gives the comparison of the new with the old, if there was one."""
        new = self.rerun()
        difference = self.compare(new) if self.bag.exists() else None
        recipe = self.recipe.model_copy(update={"made_with": versions()})
        shutil.rmtree(self.bag, ignore_errors=True)
        write_bag(self.bag, new, compression="zstd")
        _write(self.folder / "golden.yaml", recipe)
        return difference


def load(folder: Path, **changes: Any) -> Golden:
    """Read a golden folder.

    Parameters
    ----------
    folder : Path
    **changes
        Keys of the recipe that are to differ from golden.yaml.

    Raises
    ------
    ScenarioError
        golden.yaml is missing or wrong; names file and key.
    """
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    file = folder / "golden.yaml"
    if not file.is_file():
        raise ScenarioError(f"{folder} has no golden.yaml")
    try:
        content = YAML(typ="safe", pure=True).load(file.read_text())
    except YAMLError as error:
        raise ScenarioError(f"{file}: not valid YAML: {' '.join(str(error).split())}") from None
    recipe = _recipe(file, content | changes if isinstance(content, dict) else content)
    return Golden(folder, recipe, _rig(recipe))


def create(folder: Path, scenario: str, duration: float | None = None, seed: int = 0) -> Golden:
    """Make the recipe of a new golden bag; it lasts as long as the scenario when no duration is given."""
    file = folder / "golden.yaml"
    duration = load_scenario(scenario).duration if duration is None else duration
    recipe = _recipe(file, {"scenario": scenario, "duration": duration, "seed": seed})
    rig = _rig(recipe)
    folder.mkdir(parents=True, exist_ok=True)
    _write(file, recipe)
    return Golden(folder, recipe, rig)


def _recipe(file: Path, content: Any) -> Recipe:
    try:
        return Recipe.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        raise ScenarioError(f"{file}: {where}: {first['msg']}, got {first['input']!r}") from None


def _rig(recipe: Recipe) -> Rig:
    scenario = load_scenario(recipe.scenario)
    return Rig.from_scenario(scenario.model_copy(update={"duration": recipe.duration}))


def _write(file: Path, recipe: Recipe) -> None:
    from ruamel.yaml import YAML

    yaml = YAML()
    yaml.width = 110
    content: dict[str, Any] = recipe.model_dump()
    with file.open("w") as stream:
        stream.write(f"# Made by `scripts/softrig golden {file.parent.name}`; edit the tolerances by hand.\n")
        yaml.dump(content, stream)


def main(names: Sequence[str], folder: Path, *, duration: float | None, seed: int | None, check: bool) -> int:
    """Regenerate golden bags (all of the folder when none is named), or only check them.

    A duration or seed changes the recipes that are there and leaves the rest of them, which was edited by hand.
    """
    changes: dict[str, Any] = {k: v for k, v in {"duration": duration, "seed": seed}.items() if v is not None}
    if check and changes:
        given = " and ".join(f"--{key}" for key in changes)
        raise ScenarioError(f"golden --check with {given}: expected --check alone, a bag is checked as it was made")
    chosen = list(names) or sorted(p.parent.name for p in folder.glob("*/golden.yaml"))
    if not chosen:
        raise ScenarioError(f"{folder} has no golden bags yet; name the scenarios to make them of")
    status = 0
    for name in chosen:
        there = (folder / name / "golden.yaml").is_file()
        golden = load(folder / name, **changes) if there or check else create(folder / name, name, **changes)
        try:
            result = golden.compare(golden.rerun()) if check else golden.make()
        except RunError as error:
            raise RunError(f"{name}: {error}") from error
        size = sum(f.stat().st_size for f in golden.bag.glob("*")) / 1e3
        print(f"{name}: {golden.recipe.duration:g} s, {size:.0f} kB, "
              + ("new" if result is None else "agrees" if result.equal else "DIFFERS"))  # fmt: skip
        if result is not None and not result.equal:
            print(result)
            status = 1 if check else status
    return status
