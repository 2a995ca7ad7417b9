"""A study from the command line."""

from __future__ import annotations

import re
from argparse import Namespace
from collections.abc import Mapping, Sequence
from os.path import isfile
from pathlib import Path
from typing import Any

from softrig_core import ScenarioError
from softrig_core.command_line import named
from softrig_core.errors import closest
from softrig_core.scenario.scenario_file import ends, find, list_scenarios, locate
from softrig_core.scenario.yaml_file import read_yaml

from ..options.grammar import NUMBER, settings, span, values
from ..options.naming import elsewhere, folder_of, scenario_file
from .definition import Study, list_studies, load_study, make_study

VIEWS = ("figures", "signals", "samples", "strict")  # the kept data of runs, and the options by which they are judged
DRAWN, BALANCED = 100, 128  # draws by default; the second value is for methods that need a power of two


def study_of(options: Namespace) -> Study:
    """Return the study of a name or file, with the command line's changes; or make one of a scenario.

    Raises
    ------
    ScenarioError
        Neither a study nor a scenario, or an option that cannot be read.
    """
    name: str = options.study
    if not name:
        raise ScenarioError("expected a study or a scenario, or --like FILE")
    changes = _changes(options)
    path = Path(name)
    file = path.suffix in (".yaml", ".yml") and isfile(path)
    _check_counts(options)
    if name in list_studies() or (file and "scenario" in (read_yaml(path.read_text(), path.name) or {})):
        written = load_study(name).model_dump()
        changed = make_study(_recounted(written, options) | changes)
        altered = [k for k, v in changed.model_dump().items() if k not in VIEWS and v != written[k]]
        return changed.model_copy(update={"changed": tuple(altered)}) if written["summaries"] else changed
    if options.draws and not options.draw:
        raise ScenarioError(f"--draws {options.draws}: nothing is drawn, expected --draw NAME=LOW..HIGH")
    if not file and find(name) is None:
        known = [*list_studies(), *list_scenarios([])]
        near = closest(name, known) or ends(name, known)
        raise ScenarioError(
            f"{name!r} is neither a study nor a scenario{near}; `softrig study list`, `softrig list` show them"
        )
    slug = locate(name)[0]
    return make_study({"name": slug, "title": f"Study of {slug}", "scenario": name} | changes)


def _check_counts(options: Namespace) -> None:
    """Refuse options that would have no effect."""
    if options.maximise and not options.search:
        raise ScenarioError("--maximise: there is no search, expected --search FIGURE")


def _recounted(study: dict[str, Any], options: Namespace) -> dict[str, Any]:
    """Return a study of a file with the number of draws or candidates from the command line."""
    if not options.draws or options.draw:
        return study
    for key in ("draws", "search"):
        if study[key]:
            return study | {key: study[key] | {"count": options.draws}}
    raise ScenarioError(f"--draws {options.draws}: {options.study} draws nothing, expected --draw NAME=LOW..HIGH")


def folder_name(name: str, options: Namespace) -> str:
    """Name the folder of a study by the varied parameters, so that different studies use different folders."""
    draws = [f"{_method(options)}_{_draws(options)}"] if options.draw else []
    draws += [f"draws_{options.draws}"] if options.draws and not options.draw else []
    search = [f"{'max' if options.maximise else 'min'}_{options.search}", *options.subject_to] if options.search else []
    against = [f"against_{rival}" for rival in options.against]
    parts = [f"study_{name}", *against, *options.grid, *options.draw, *draws, *search]
    parts += [f"{key}_{value}" for key in ("seeds", "duration") if (value := getattr(options, key)) is not None]
    parts += [*options.figures, *options.signals, *(["strict"] if options.strict else [])]
    return folder_of(parts, elsewhere(scenario_file(options.study)))


def _changes(options: Namespace) -> dict[str, Any]:
    changes: dict[str, Any] = {k: getattr(options, k) for k in ("figures", "signals") if getattr(options, k)}
    changes |= {k: getattr(options, k) for k in ("duration", "seeds") if getattr(options, k) is not None}
    changes |= {"strict": True} if options.strict else {}
    grid = dict(named(text, "--grid", "A,B,C or LOW:HIGH:STEP") for text in options.grid)
    if grid:
        changes["grid"] = {name: values(name, text) for name, text in grid.items()}
    spans = dict(named(text, "--draw", "LOW..HIGH") for text in options.draw)
    drawn = {name: _drawn(name, text) for name, text in spans.items()}
    if options.search:
        aim = "maximise" if options.maximise else "minimise"
        changes["search"] = {
            "figure": options.search,
            "aim": aim,
            "count": _draws(options),
            "parameters": drawn,
            "subject_to": dict(map(_constraint, options.subject_to)),
        }
    else:
        changes |= {"require": dict(map(_constraint, options.subject_to))} if options.subject_to else {}
        changes |= {"draws": _drawn_points(options, drawn)} if drawn else {}
    if options.sensitivity and (options.search or not drawn):
        why = "goes with no --search" if options.search else "of what --draw names, expected --draw NAME=LOW..HIGH"
        raise ScenarioError(f"--sensitivity: {why}")
    if options.against:
        changes["cases"] = _cases(options)
    return changes


def _method(options: Namespace) -> str:
    return "sensitivity" if options.sensitivity else str(options.method)


def _draws(options: Namespace) -> int:
    count: int | None = options.draws
    return count or (BALANCED if options.draw and _method(options) in ("sobol", "sensitivity") else DRAWN)


def _drawn_points(options: Namespace, drawn: Mapping[str, Any]) -> dict[str, Any]:
    return {"count": _draws(options), "method": _method(options), "parameters": drawn}


def _cases(options: Namespace) -> dict[str, dict[str, Any]]:
    """Return the cases: the unchanged scenario, and those that it is compared with."""
    result: dict[str, dict[str, Any]] = {_slug(options.study): {}}
    for text in options.against:
        change = settings([text]) if "=" in text else {"scenario": text}
        name = text if "=" in text else _slug(text)
        if name in result and "=" not in text and not _is_same(text, (options.study, *options.against)):
            name = text  # two files have the same name, so the path tells them apart
        if name in result:
            raise ScenarioError(f"--against {text}: it is the scenario itself, or is listed twice")
        result[name] = change
    return result


def _is_same(text: str, others: Sequence[str]) -> bool:
    """Return whether a scenario occurs twice in a list, also under different paths."""
    return sum(locate(other)[1].samefile(locate(text)[1]) for other in others if "=" not in other) > 1


def _slug(name: str) -> str:
    return locate(name)[0]


def _drawn(name: str, text: str) -> dict[str, Any]:
    """Read a range, or a list of values to choose from, as a distribution."""
    if "," in text:
        if ".." in text and "[" not in text:
            raise ScenarioError(f"{name}={text}: expected LOW..HIGH with decimal points, or one of A,B,C")
        return {"choice": values(name, text)}
    result = span(name, text)
    if result.linear:
        raise ScenarioError(f"{name}={text}: a parameter has no time profile, expected LOW..HIGH*N for a list")
    ends: list[Any] = [result.low, result.high]
    return {"log_uniform" if result.log else "uniform": [[x] * result.count for x in ends] if result.count else ends}


def _constraint(text: str) -> tuple[str, str]:
    """Read ``overshoot <= 5`` as a figure and its limit."""
    match = re.fullmatch(rf"\s*(\w+)\s*(<=|>=)\s*({NUMBER})\s*", text)
    if match is None:
        raise ScenarioError(f"--subject-to {text!r}: expected FIGURE <= NUMBER or FIGURE >= NUMBER")
    return match[1], f"at {'most' if match[2] == '<=' else 'least'} {match[3]}"
