"""Definition of a study: validated data from a YAML file in ``config/studies`` or from the command line."""

from __future__ import annotations

import os
from os.path import isfile
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, ValidationError, model_validator
from softrig_core import ScenarioError
from softrig_core.entry import Entry
from softrig_core.errors import closest
from softrig_core.judge.claims import Claim
from softrig_core.judge.expectation import Expected
from softrig_core.scenario.places import explain
from softrig_core.scenario.references import fill
from softrig_core.scenario.scenario_file import scenario_folders
from softrig_core.scenario.yaml_file import read_mapping, write_yaml

# The most seeds, points or candidates, because memory is allocated for all of them together.
MOST = 1_000_000
# The definition of a study in the folder of its results.
FILE = "study.yaml"


Bound = float | list[float]


class Distribution(Entry):
    """Distribution of one parameter; exactly one of the keys. Bounds may be lists with one item per vector element."""

    uniform: tuple[Bound, Bound] | None = None
    log_uniform: tuple[Bound, Bound] | None = None
    normal: tuple[Bound, Bound] | None = Field(None, description="mean and standard deviation")
    integers: tuple[int, int] | None = Field(None, description="both included")
    choice: list[Any] | None = None

    @model_validator(mode="after")
    def _one(self) -> Distribution:
        stated = [k for k in type(self).model_fields if getattr(self, k) is not None]
        if len(stated) != 1:
            raise ValueError(f"expected one of {', '.join(type(self).model_fields)}, got {', '.join(stated) or 'none'}")
        pair = getattr(self, stated[0])
        if stated[0] == "log_uniform" and min(_flat(pair)) <= 0.0:
            raise ValueError("log_uniform: expected bounds above 0")
        if stated[0] in ("uniform", "log_uniform", "integers"):
            low, high = (_flat([side]) for side in pair)
            if len(low) != len(high) or any(a > b for a, b in zip(low, high, strict=True)):
                raise ValueError(f"{stated[0]}: expected a lower and an upper bound, got {pair}")
        return self


def _flat(values: Any) -> list[float]:
    return [x for v in values for x in (v if isinstance(v, list) else [v])]


class Draws(Entry):
    """Drawn parameters: `count` points by a generator of its own seed.

    ``sobol`` is a scrambled Sobol' sequence. ``sensitivity`` takes two sets of `count` points of one, and for each
    drawn number the first set with that number of the second: count (numbers + 2) points.
    """

    count: int = Field(ge=1, le=MOST)
    seed: int = Field(0, ge=0)
    method: Literal["random", "latin_hypercube", "sobol", "sensitivity"] = "latin_hypercube"
    parameters: dict[str, Distribution] = Field(min_length=1)

    @model_validator(mode="after")
    def _balanced(self) -> Draws:
        if self.method in ("sobol", "sensitivity") and self.count & (self.count - 1):
            near = 2 ** (self.count.bit_length() - 1)
            raise ValueError(f"{self.method}: expected a power of two, as {near} or {2 * near}, got {self.count} draws")
        return self


class Search(Entry):
    """A search for parameters that minimise (or maximise) a figure; a figure that cannot be measured counts as worst.

    Candidates are evaluated in batches and their values are passed to the search in order, so the result does not
    depend on the number of workers. `subject_to` maps figures to expectations, which must hold in each run; a candidate
    that violates one is never the best.
    """

    figure: str
    subject_to: dict[str, Expected] = {}
    aim: Literal["minimise", "maximise"] = "minimise"
    count: int = Field(ge=1, le=MOST)
    batch: int = Field(4, ge=1, le=10_000)
    seed: int = Field(0, ge=0)
    sampler: Literal["tpe", "random"] = "tpe"
    parameters: dict[str, Distribution] = Field(min_length=1)


class Summary(Entry):
    """A number over many runs.

    Parameters
    ----------
    statistic : str
        ``share`` counts the runs that meet `of`; a figure that could not be measured does not meet it.
    q : float
        Of ``quantile``.
    of : Expectation
        Of ``share``: ``at least 99``.
    where : dict
        Only the runs whose case (key ``case``) or parameters have these values. If it covers several cases, it is
        computed for each of them.
    """

    figure: str
    statistic: Literal["mean", "median", "std", "min", "max", "sum", "count", "quantile", "share"] = "mean"
    q: float = Field(0.5, ge=0.0, le=1.0)
    of: Expected | None = None
    where: dict[str, Any] = {}

    @model_validator(mode="after")
    def _share(self) -> Summary:
        if (self.of is not None) != (self.statistic == "share"):
            raise ValueError("of: needed by the statistic share, and allowed only there")
        return self


def _seeds(value: Any) -> Any:
    if not isinstance(value, int) or isinstance(value, bool):
        return value
    if not 1 <= value <= MOST:
        raise ValueError(f"expected 1 to {MOST} seeds, or a list of them")
    return list(range(value))


class Study(Entry):
    """A scenario many times: cases x grid x draws x seeds, or a search.

    Parameters
    ----------
    cases : dict of str to dict
        By name: parameters to change; the key ``scenario`` selects another scenario.
    grid : dict of str to list
        Every combination of the values.
    seeds : int or list of int
        Rig seeds; a number n means 0 to n - 1. Default: the seed of the scenario.
    figures : list of str
        Figures to store; all if empty.
    signals : list of str
        Signals to store at `samples` times; they are drawn with bands over the seeds.
    require : dict of str to Expectation
        Figures with requirements; the study estimates how often each requirement holds.
    strict : bool
        Whether changed runs are also judged by values published for the unchanged machine, as with `run --strict`.
    summaries, expect, claims
        Numbers computed over the runs, their expected values, and the paper's claims about them.
    changed : tuple of str
        Entries changed on the command line; `expect` and `claims` apply to the study file without these changes.
    """

    name: str
    title: str
    source: str = ""
    scenario: str
    duration: float | None = Field(None, gt=0)
    cases: dict[str, dict[str, Any]] = {}
    grid: dict[str, Annotated[list[Any], Field(min_length=1)]] = {}
    draws: Draws | None = None
    search: Search | None = None
    seeds: Annotated[list[Annotated[int, Field(ge=0)]] | None, BeforeValidator(_seeds)] = None
    figures: list[str] = []
    signals: list[str] = []
    samples: int = Field(200, ge=2, le=10_000)
    require: dict[str, Expected] = {}
    strict: bool = False
    summaries: dict[str, Summary] = {}
    expect: dict[str, Expected] = {}
    claims: dict[str, Claim] = {}
    changed: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _fits(self) -> Study:
        if self.search is not None and (self.draws or self.grid or self.cases):
            raise ValueError("search: can be combined with seeds, not with cases, grid or draws")
        for kind, names in (("expect", list(self.expect)), ("claims", [c.figure or k for k, c in self.claims.items()])):
            for name in names:
                if name not in self.summaries and not (kind == "claims" and not name):
                    known = ", ".join(self.summaries) or "none"
                    raise ValueError(f"{kind}: no summary {name!r}; the summaries are {known}")
        mixed = [name for name, s in self.summaries.items() if self.each_case(s)]
        for key, claim in self.claims.items():
            if (name := claim.figure or key) in mixed:
                raise ValueError(f"claims: {name} has {len(self.cases)} cases; choose one by where: {{case: ...}}")
        return self

    @property
    def written(self) -> str:
        """Describe the unchanged study to which the expectations apply; empty if nothing was changed."""
        return f"the study without other {', '.join(self.changed)}" if self.changed else ""

    def each_case(self, summary: Summary) -> bool:
        """Return whether a summary is computed for each case."""
        return len(self.cases) > 1 and not {"case", "scenario"} & summary.where.keys()


def study_folders() -> list[Path]:
    """Return the folders of study files: ``studies`` beside each folder of scenarios."""
    folders = [folder.parent / "studies" for folder in scenario_folders()]
    from_environment = [Path(p) for p in os.environ.get("SOFTRIG_STUDIES", "").split(os.pathsep) if p]
    return [f for f in (*from_environment, *folders) if f.is_dir()]


def list_studies() -> dict[str, Path]:
    """Return every study's name and file."""
    result: dict[str, Path] = {}
    for folder in study_folders():
        for path in sorted(folder.glob("*.yaml")):
            if "." not in path.stem:  # NAME.falsify.yaml is no study
                result.setdefault(path.stem, path)
    return result


def load_study(name: str) -> Study:
    """Read a study by name or file.

    Raises
    ------
    ScenarioError
        Unknown, not YAML, an unknown key or a bad value; names file and key.
    """
    path = Path(name)
    if not (path.suffix in (".yaml", ".yml") and isfile(path)):
        known = list_studies()
        if name not in known:
            raise ScenarioError(f"study {name!r} is unknown{closest(name, known)}; there are {', '.join(known)}")
        path = known[name]
    raw = read_mapping(path)
    shared = raw.pop("shared", None) or {}
    try:
        return make_study({**fill(raw, shared), "name": path.stem})
    except ScenarioError as error:
        raise ScenarioError(f"{path.name}: {error}") from None


def make_study(raw: dict[str, Any]) -> Study:
    """Validate a study."""
    try:
        return Study.model_validate(raw)
    except ValidationError as error:
        raise ScenarioError(explain(error, Study)) from None


def saved(study: Study) -> str:
    """Write all of a study as a file that `softrig study` reads."""
    return write_yaml(study.model_dump(mode="json", exclude_defaults=True))
