"""Golden bags: a short recorded run of a scenario that later versions must reproduce.

``bags/NAME/`` has ``bag/`` and ``golden.yaml``, which records how the bag was made and what may differ.
"""

from __future__ import annotations

import argparse
import re
import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from pydantic import Field, ValidationError
from softrig_bags.compare import Comparison, Tolerance, compare
from softrig_bags.read import read_bag
from softrig_bags.write import write_bag
from softrig_core import Recording, Rig, RunError, ScenarioError, Signals, load_scenario, rig_of, simulate
from softrig_core.block.params import flatten
from softrig_core.entry import Entry
from softrig_core.guard import replace
from softrig_core.scenario.places import explain
from softrig_core.scenario.yaml_file import read_yaml
from softrig_core.wire.signals import topic_of
from softrig_optim.sweep import sweep

from ..folder import alone_in
from ..page.junit import Case, Suite, write_reports
from ..run.run import versions

DECIDE = ("machine", "math", "numpy", "scipy", "casadi", "pin", "daqp")  # versions that determine the bits of a run
# Python decides where a block is not ours: since 3.12 its `sum` compensates floats, since 3.14 complex numbers too
ERAS = ((3, 12), (3, 14))
FILE = "golden.yaml"
STEADY = re.compile(r"softrig_(core|control|optim|drives|power|robots|systems)\.")


class Allowed(Entry):
    """Tolerance of a number: ``max(absolute, relative |golden|)``."""

    absolute: float = Field(1e-9, ge=0)
    relative: float = Field(1e-9, ge=0)


class Recipe(Entry):
    """Content of golden.yaml.

    Parameters
    ----------
    duration : float
        Length of the golden run, s; usually shorter than the scenario's.
    default : Allowed
        For every signal without a pattern of its own. Tolerances are for other versions than those that wrote the bag
        (another C library, numpy, casadi, machine; another Python only for blocks that are not softrig's); with the
        same ones bytes are compared.
    tolerances : dict of str to Allowed
        By pattern of the signal name (``motor/state/*``).
    elsewhere : dict of str to Allowed
        As `tolerances`: the effect of a change of the last bits on this rig, measured when the bag was made.
    why : str
        Reason for the tolerances.
    made_with : dict of str to str
        Versions that wrote the bag.
    """

    scenario: str
    duration: float = Field(gt=0)
    seed: int = Field(0, ge=0)
    default: Allowed = Allowed()
    tolerances: dict[str, Allowed] = {}
    elsewhere: dict[str, Allowed] = {}
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
        """Return the path of the bag."""
        return self.folder / "bag"

    def recording(self) -> Recording:
        """Read the golden bag."""
        return read_bag(self.bag)

    def rerun(self) -> Recording:
        """Run the scenario as it is now."""
        return simulate(self.rig, seed=self.recipe.seed).recording

    def shaken(self, bits: float) -> Recording:
        """Run the scenario with the parameters of its plants changed by `bits` units in the last place.

        Another build of a library changes results by about as much.
        """
        changed: dict[str, Any] = {}
        for member in self.rig.members:
            for name, value in flatten(member.params).items() if member.is_plant else ():
                if isinstance(value, float) and value and name != "period":
                    new = value * (1.0 + bits * 2.0**-52)
                    if _allowed(self.rig, f"{member.name}.{name}", new):
                        changed[f"{member.name}.{name}"] = new
        return simulate(self.rig, seed=self.recipe.seed, overrides=changed).recording

    def sensitivity(self) -> dict[str, Allowed]:
        """Measure what a change of the last bits does: ten times the largest deviation of each topic, above 1e-9."""
        first = Signals(self.rerun())
        largest: dict[str, float] = {}
        for bits in (4.0, -4.0):
            shaken = Signals(self.shaken(bits))
            for name in first:
                a, b = first[name].x, shaken[name].x
                if a.size and a.size == b.size:
                    topic = topic_of(name, self.rig.topics)
                    largest[topic] = max(largest.get(topic, 0.0), float(np.nanmax(np.abs(a - b), initial=0.0)))
        return {
            f"{topic}/*": Allowed(absolute=float(f"{10.0 * d:.1e}"))
            for topic, d in sorted(largest.items())
            if 10.0 * d > 1e-9
        }

    @property
    def others(self) -> dict[str, tuple[str, str]]:
        """Return the settings that affect the bits and differ from the recording: name to the value there and here."""
        now, recorded = versions(), self.recipe.made_with
        pairs = {name: (recorded.get(name, "unknown"), now.get(name, "unknown")) for name in DECIDE}
        if not all(STEADY.match(member.block_class.__module__) for member in self.rig.members):
            python = recorded.get("python", "unknown"), now["python"]
            pairs |= {"python": python} if _era(python[0]) != _era(python[1]) else {}
        return {name: pair for name, pair in pairs.items() if pair[0] != pair[1]}

    @property
    def how(self) -> str:
        """Return how a new recording is compared, and why."""
        return f"within tolerances: {self._differing}" if self.others else "byte for byte"

    @property
    def _differing(self) -> str:
        return ", ".join(f"{name} {recorded} there, {now} here" for name, (recorded, now) in self.others.items())

    def check(self) -> tuple[Comparison, str]:
        """Run the scenario again and compare; return the comparison and a description of the agreement.

        If conditions differ from those in which the bag was made, every byte may still be equal; the description then
        states it.
        """
        new, old = self.rerun(), self.recording()
        result = self.compare(new, old=old)
        same = result.equal and self.others and self.compare(new, elsewhere=False, old=old).equal
        how = f"byte for byte, with {self._differing}" if same else self.how
        recorded = {topic.topic for topic in result.topics}
        further = [topic for topic in new.topics if topic not in recorded]
        return result, how + (f"; not in the bag: {', '.join(further)}" if further else "")

    def compare(
        self,
        new: Recording,
        topics: Sequence[str] | None = None,
        *,
        elsewhere: bool | None = None,
        old: Recording | None = None,
    ) -> Comparison:
        """Compare a new recording with the golden one: byte for byte, or elsewhere within the recipe's tolerances.

        Parameters
        ----------
        topics : sequence of str, optional
            Topics to compare. By default all that the bag holds: a plant with one more output need not rewrite the
            bags of all its scenarios.
        elsewhere : bool, optional
            Whether to allow what another build may change; found out when absent.
        old : Recording, optional
            The golden one, if it has been read already.
        """
        recording = self.recording() if old is None else old
        before, signals = Signals(recording), Signals(new)
        topics = list(recording.topics) if topics is None else topics
        if not (bool(self.others) if elsewhere is None else elsewhere):
            return compare(before, signals, bitwise=True, topics=topics)
        allowed = self.recipe.elsewhere | self.recipe.tolerances
        limits = {name: Tolerance(a.absolute, a.relative) for name, a in allowed.items()}
        default = Tolerance(self.recipe.default.absolute, self.recipe.default.relative)
        return compare(before, signals, default=default, tolerances=limits, topics=topics)

    def make(self, differing: bool = False) -> Comparison | None:
        """Write the golden bag again; returns the comparison of the new with the old, if there was one.

        The old bag is kept until the new one is written.

        Parameters
        ----------
        differing : bool
            Leave a bag that agrees as it is.

        Raises
        ------
        ScenarioError
            The folder contains something that is not a golden bag.
        RunError
            The new bag could not be written.
        """
        _check_folder(self.bag)
        new = self.rerun()
        difference = self.compare(new) if self.bag.exists() else None
        if differing and difference is not None and difference.equal:
            return difference
        recipe = self.recipe.model_copy(update={"made_with": versions(), "elsewhere": self.sensitivity()})
        with TemporaryDirectory(prefix=".new_", dir=self.folder) as aside:
            write_bag(Path(aside) / self.bag.name, new, compression="zstd")
            if self.bag.exists():
                self.bag.replace(Path(aside) / "old")
            (Path(aside) / self.bag.name).replace(self.bag)
        _write(self.folder / FILE, recipe)
        return difference


def _era(python: str) -> int:
    """Describe which `sum` a version of Python has; -1 when that is not known."""
    match = re.match(r"(\d+)\.(\d+)", python)
    return sum((int(match[1]), int(match[2])) >= era for era in ERAS) if match else -1


def line(names: Iterable[str]) -> str:
    """Describe which row of the table in doc/bits.md this machine belongs to.

    Parameters
    ----------
    names : iterable of str
        Settings that differ from those of the golden bags: `Golden.others` of all of them.
    """
    differ = set(names)
    if "machine" in differ:
        return "another architecture"
    if "math" in differ:
        return "other functions of the C library"
    if differ - {"python"}:
        return "other packages"
    return "another Python, and blocks of your own" if differ else "the same functions and packages"


def _check_folder(bag: Path) -> None:
    """Check that a folder, if it exists, contains a bag and nothing else; a ScenarioError names what is not of one."""
    foreign = [p for p in bag.glob("*") if not re.fullmatch(r"metadata\.yaml|bag_\d+\.mcap", p.name) or p.is_symlink()]
    if bag.is_symlink() or foreign or (bag.exists() and not bag.is_dir()):
        raise ScenarioError(f"{foreign[0] if foreign else bag} was not made by `softrig golden`; move it away")


def _allowed(rig: Rig, name: str, value: float) -> bool:
    """Return whether a changed parameter is still within its bounds."""
    try:
        rig_of(rig, overrides={name: value})
    except ScenarioError:
        return False
    return True


# folder, recipe (None: to be made), its changes, whether to check, whether only what differs is made again
_Work = tuple[Path, Recipe | None, dict[str, Any], bool, bool]


def load(folder: Path, **changes: Any) -> Golden:
    """Read a golden folder.

    Parameters
    ----------
    **changes
        Keys of the recipe that are to differ from golden.yaml.

    Raises
    ------
    ScenarioError
        golden.yaml is missing or wrong; names file and key.
    """
    recipe = _read(folder, changes)
    return Golden(folder, recipe, _rig(recipe))


def _read(folder: Path, changes: dict[str, Any]) -> Recipe:
    file = folder / FILE
    if not file.is_file():
        raise ScenarioError(
            f"{folder} has no golden.yaml; `softrig golden {folder.name}` records one, --bags DIR names another folder"
        )
    content = read_yaml(file.read_text(errors="replace"), str(file))
    return _recipe(file, content | changes if isinstance(content, dict) else content)


def create(folder: Path, scenario: str, duration: float | None = None, seed: int = 0) -> Golden:
    """Create the recipe of a new golden bag; the default duration is that of the scenario."""
    file = folder / FILE
    duration = load_scenario(scenario).duration if duration is None else duration
    recipe = _recipe(file, {"scenario": scenario, "duration": duration, "seed": seed})
    rig = _rig(recipe)
    if (folder / "bag").exists():
        raise ScenarioError(f"{folder} has a bag and no golden.yaml: it was not made by `softrig golden`; move it away")
    folder.mkdir(parents=True, exist_ok=True)
    _write(file, recipe)
    return Golden(folder, recipe, rig)


def _recipe(file: Path, content: Any) -> Recipe:
    try:
        return Recipe.model_validate(content)
    except ValidationError as error:
        raise ScenarioError(f"{file}: {explain(error, Recipe)}") from None


def _rig(recipe: Recipe) -> Rig:
    scenario = load_scenario(recipe.scenario)
    return rig_of(scenario.model_copy(update={"duration": recipe.duration}))


def _write(file: Path, recipe: Recipe) -> None:
    from ruamel.yaml import YAML

    yaml = YAML()
    yaml.width = 110
    content: dict[str, Any] = recipe.model_dump()
    stream = StringIO()
    stream.write(f"# Made by `scripts/softrig golden {file.parent.name}`; edit the tolerances by hand.\n")
    yaml.dump(content, stream)
    replace(file, stream.getvalue())


def main(options: argparse.Namespace) -> int:
    """Record golden bags again (all of the folder when none is named) and show the difference.

    A duration or seed is written into existing recipes; their other entries, edited by hand, are kept.
    """
    changes = {k: v for k in ("duration", "seed") if (v := getattr(options, k)) is not None}
    folder, recipes = _chosen(options, options.names, changes, new=True)
    works = [(folder / name, recipe, changes, False, options.differing) for name, recipe in recipes.items()]
    for row, new, _ in sweep(_made_or_checked, works, title="golden bags", workers=1):
        _print_row(folder, row, new)
    return 0


def check(options: argparse.Namespace) -> int:
    """Run the scenarios of golden bags (all of the folder when none is named) and compare; 1 when one differs."""
    folder, recipes = _chosen(options, options.scenarios, {})
    suites, content = [], []
    elsewhere: set[str] = set()
    works: list[_Work] = [(folder / name, recipe, {}, True, False) for name, recipe in recipes.items()]
    for row, _, settings in sweep(_made_or_checked, works, title="golden bags", workers=options.workers):
        _print_row(folder, row)
        length = f"{row['duration_s']:g} s"
        suites.append(Suite(row["bag"], row["wall_s"], [Case("bag", row["differs"], length)]))
        content.append(row)
        elsewhere |= settings
    write_reports(options.junit, suites, options.json, content)
    now = versions()
    host = f"{now['machine']}, CPython {now['python']}, {now.get('libc') or 'unknown C library'}, math {now['math']}"
    print(f'{host}: in bits.md the line "{line(elsewhere)}"')
    return 0 if all(row["pass"] for row in content) else 1


def _chosen(
    options: argparse.Namespace, named: Sequence[str], changes: dict[str, Any], new: bool = False
) -> tuple[Path, dict[str, Recipe | None]]:
    """Return the folder of golden bags and the requested recipes, all read before the first run.

    Parameters
    ----------
    new : bool
        Whether a recipe may be missing, which is None then.
    """
    folder = options.bags or Path("bags")
    chosen = list(named) or sorted(p.parent.name for p in folder.glob("*/golden.yaml"))
    if not chosen:
        raise ScenarioError(f"{folder} has no golden bags yet; name the scenarios: `softrig golden SCENARIO`")
    missing = [name for name in chosen if new and options.node is None and not (folder / name / FILE).is_file()]
    recipes = {name: None if name in missing else _read(folder / name, changes) for name in chosen}
    return folder, recipes if options.node is None else _with(options.node, folder, recipes)


def _print_row(folder: Path, row: dict[str, Any], new: bool = False) -> None:
    size = sum(f.stat().st_size for f in (folder / row["bag"] / "bag").glob("*")) / 1e3
    verdict = "new" if new else f"{'agrees' if row['pass'] else 'DIFFERS'} {row['compared']}"
    print(f"{row['bag']}: {row['duration_s']:g} s, {size:.0f} kB, {verdict}")
    if not row["pass"]:
        print(row["differs"])


def _with(node: str, folder: Path, recipes: Mapping[str, Recipe | None]) -> dict[str, Recipe | None]:
    """Return the golden bags whose scenario has a node of this name or executable."""
    nodes = {name: load_scenario(recipe.scenario).nodes for name, recipe in recipes.items() if recipe is not None}
    known = {name: {*entries, *(entry.executable for entry in entries.values())} for name, entries in nodes.items()}
    if not (results := {name: recipes[name] for name, names in known.items() if node in names}):
        listed = ", ".join(sorted(set().union(*known.values())))
        raise ScenarioError(f"golden --with {node}: no node or executable of that name in {folder}; there are {listed}")
    return results


def _made_or_checked(work: _Work) -> tuple[dict[str, Any], bool, set[str]]:
    """Create or check a golden bag; return its outcome, whether there was none before, and its `settings`."""
    started = time.perf_counter()
    folder, recipe, changes, check, differing = work
    golden = Golden(folder, recipe, _rig(recipe)) if recipe is not None else create(folder, folder.name, **changes)
    how, settings = golden.how if golden.bag.exists() else "", set(golden.others)
    result: Comparison | None
    try:
        with nullcontext() if check else alone_in(folder):
            if check:
                result, how = golden.check()
            else:
                result = golden.make(differing)
    except RunError as error:
        raise RunError(f"{folder.name}: {error}") from error
    differs = "" if result is None or result.equal else str(result)
    return (
        {
            "bag": folder.name,
            "scenario": golden.recipe.scenario,
            "duration_s": golden.recipe.duration,
            "seed": golden.recipe.seed,
            "pass": not differs,
            "compared": how,
            "differs": differs,
            "wall_s": round(time.perf_counter() - started, 3),
        },
        result is None,
        settings,
    )
