"""The verbs `linearise` and `steady`: a rig as a control engineer sees it, as numbers and pictures."""

from __future__ import annotations

import argparse
import json
import math
import sys
from typing import Any

from softrig_core import LinearAlong, LinearView, NoOperatingPoint, ScenarioError, linear_along, linear_view, steady
from softrig_core.guard import replace

from ..options.grammar import settings
from ..terminal.console import console

DEGREES = 180.0 / math.pi
SHOWN = 8  # modes that are printed
NOTABLE = 1e-6  # share of the motion of an output up to which a deviation is not reported
ANY = 1e-9  # a gain margin downwards below this is rounding: the loop is stable with any smaller gain
ANOTHER = 0.5  # variation above which poles and margins describe another system


def numbers(view: LinearView) -> dict[str, Any]:
    """Return a linear view as plain data; None where a margin is infinite."""
    result: dict[str, Any] = {
        "scenario": view.rig, "at_s": view.at, "period_s": view.period, "error": view.error, "worst": view.worst,
        "variation": view.state_error, "heard": dict(view.output_errors),
        "left_out": dict(view.left_out), "stable": view.stable, "values": dict(view.values), "units": dict(view.units),
        "closed": {"states": list(view.states), "inputs": list(view.inputs), "outputs": list(view.outputs),
                   **_matrices(view)},
        "modes": [{"pole": [m.pole.real, m.pole.imag], "rate": [m.rate.real, m.rate.imag], "states": m.shares}
                  for m in view.modes],
    }  # fmt: skip
    if view.link:
        states, poles = list(view.opened.state_labels), [[p.real, p.imag] for p in view.loop_poles.tolist()]
        margins = {k: v if math.isfinite(v) else None for k, v in view.margins._asdict().items()}
        opened = {"states": states} | _matrices(view.opened) | {"poles": poles}
        result |= {"link": view.link, "margins": margins, "opened": opened}
    return result


def _matrices(system: Any) -> dict[str, list[Any]]:
    return {name: getattr(system, name).tolist() for name in "ABCD"}


def along_numbers(view: LinearAlong) -> dict[str, Any]:
    """Return a view along a run as plain data: a matrix of each kind for each period."""
    about = {"scenario": view.rig, "at_s": view.at, "period_s": view.period, "variation": view.state_error}
    names = {"states": list(view.states), "inputs": list(view.inputs), "outputs": list(view.outputs)}
    return about | {"heard": view.output_errors} | names | _matrices(view)


def _asked(options: argparse.Namespace) -> dict[str, Any]:
    """Return what both verbs ask of an analysis."""
    overrides = settings(options.set, options.scenario)
    return {"at": options.at, "outputs": options.output, "overrides": overrides}


def _print_along(options: argparse.Namespace) -> int:
    """Print how far a view along a run is from it; with ``--out``, write its matrices."""
    view = linear_along(options.scenario, options.along, inputs=options.input, **_asked(options))
    out = console()
    out.print(f"{view.rig}, {len(view.A)} periods of {view.period:g} s from {view.at:.6g} s: {len(view.states)} states")
    out.print(f"  {'states':20} {view.state_error:.1e} from the rig itself, after a small disturbance", markup=False)
    for name, apart in view.output_errors.items():
        out.print(f"  {name:20} {apart:.1e}", markup=False)
    if options.out:
        options.out.mkdir(parents=True, exist_ok=True)
        replace(options.out / "along.json", json.dumps(along_numbers(view)) + "\n")
        out.print(f"  {options.out}/along.json")
    return 0


def linearise(options: argparse.Namespace) -> int:
    """Print poles and margins; with ``--out``, write numbers and pictures."""
    if options.along is not None:
        if options.open:
            raise ScenarioError("--along gives the matrices of the whole rig: expected no --open beside it")
        return _print_along(options)
    view = linear_view(options.scenario, options.open, inputs=options.input, **_asked(options))
    out = console()
    out.print(f"{view.rig}, t = {view.at:.6g} s: {len(view.states)} states, period {view.period:g} s")
    rows = [("poles (in z)", "1/s")] if view.modes else []
    rows += [(_complex(m.pole), f"{_complex(m.rate):22} {_states(m.shares)}") for m in view.modes[:SHOWN]]
    if len(view.modes) > SHOWN:
        rows += [("", f"and {len(view.modes) - SHOWN} faster ones")]
    if view.link:
        m, value = view.margins, f"{view.values[view.link]:.6g} {view.units[view.link]}".rstrip()
        rows += [
            ("opened at", f"{view.link} = {value}"),
            ("closed", "stable" if view.stable else "unstable: the margins say where that changes"),
            (
                "gain margin",
                f"{m.gain:.4g}, down to {m.gain_down:.4g}" if m.gain_down > ANY else f"{m.gain:.4g}, down to any gain",
            ),
            ("phase margin", f"{m.phase * DEGREES:.4g} degrees"),
            ("delay margin", f"{m.delay:.4g} s, {m.delay / view.period:.4g} periods"),
            ("disk margin", f"{m.disk:.4g}"),
            ("crossover", f"{m.crossover:.4g} rad/s"),
        ]
    rows += [
        ("known to", f"{view.error:.1e} of a column, the worst is {view.worst}"),
        ("varies by", f"{view.state_error:.1e} from the rig itself within ten periods"),
    ]
    rows += [("left out", f"{name} {why}") for name, why in view.left_out.items()]
    if (most := max(view.output_errors.values(), default=0.0)) > NOTABLE:
        name = max(view.output_errors, key=view.output_errors.__getitem__)
        rows += [("outputs", f"{most:.1e} from the rig within 40 periods, the worst is {name}")]
    if view.state_error > ANOTHER:
        rows += [("so", "this is not the rig: it contains steps, or it changes every period (--along)")]
    for name, text in rows:
        out.print(f"  {name:20} {text}", markup=False)
    if options.out:
        options.out.mkdir(parents=True, exist_ok=True)
        replace(options.out / "linear.json", json.dumps(numbers(view), indent=1) + "\n")
        files = "linear.json"
        if view.link:
            view.plot().savefig(options.out / "linear.png", dpi=120)
            files += ", linear.png"
        out.print(f"  {options.out}/{files}")
    return 0


def _complex(value: complex) -> str:
    return f"{value.real:.4g}" if not value.imag else f"{value.real:.4g} +- {abs(value.imag):.4g}j"


def _states(shares: dict[str, float]) -> str:
    return ", ".join(f"{name} {share:.0%}" for name, share in list(shares.items())[:3])


def print_steady(options: argparse.Namespace) -> int:
    """Print an operating point; status 1 if there is none."""
    try:
        point = steady(options.scenario, **_asked(options))
    except NoOperatingPoint as error:
        print(f"softrig: {error}", file=sys.stderr)
        return 1
    for name, value in (*point.signals.items(), *point.states.items()):
        rate = f"\tdrifts by {point.drifting[name]:.6g} a second" if name in point.drifting else ""
        print(f"{name}\t{value:.9g} {point.units.get(name, '')}".rstrip() + rate)
    kind = "stable" if point.stable else "unstable"
    print(f"{kind}, slowest pole {point.slowest:.6g}; {point.steps} steps; a run from there moves by {point.moved:.1g}")
    return 0
