"""The verbs `linearise` and `steady`: a loop as a control engineer sees it, as numbers and pictures."""

from __future__ import annotations

import argparse
import json
import math
from typing import Any

from softrig_core.rig.linear_view import LinearView, linear_view, steady

from .listing import console
from .run_options import assignment

DEGREES = 180.0 / math.pi


def _overrides(options: argparse.Namespace) -> dict[str, Any]:
    return dict(assignment(text) for text in options.set)


def numbers(view: LinearView) -> dict[str, Any]:
    """Give a linear view as plain data; None where a margin is infinite.

    Parameters
    ----------
    view : LinearView
    """
    system, m = view.closed, view.margins
    poles = sorted(system.poles(), key=abs, reverse=True)
    return {
        "scenario": view.rig, "link": view.signal, "unit": view.unit, "at_s": view.at, "period_s": view.period,
        "value": view.value, "pulse": view.step, "error": view.error, "variation": view.variation,
        "margins": {k: v if math.isfinite(v) else None for k, v in m._asdict().items()},
        "closed": {"A": system.A.tolist(), "B": system.B.tolist(), "C": system.C.tolist(), "misfit": view.misfit,
                   "poles": [[float(p.real), float(p.imag)] for p in poles]},
    }  # fmt: skip


def linearise(options: argparse.Namespace) -> int:
    """Print the margins and poles of a loop; with ``--out``, write numbers and pictures."""
    view = linear_view(
        options.scenario, options.open, at=options.at, window=options.window, overrides=_overrides(options)
    )
    found, m = numbers(view), view.margins
    out = console()
    out.print(f"{view.rig}, opened at {view.signal} = {view.value:.6g} {view.unit}".rstrip() + f", t = {view.at:.6g} s")
    rows = {
        "gain margin": f"{m.gain:.4g}" + (f", down to {m.gain_down:.4g}" if m.gain_down else ""),
        "phase margin": f"{m.phase * DEGREES:.4g} degrees",
        "delay margin": f"{m.delay:.4g} s, {m.delay / view.period:.4g} periods of {view.period:g} s",
        "disk margin": f"{m.disk:.4g}",
        "crossover": f"{m.crossover:.4g} rad/s",
        "poles, closed": "  ".join(_complex(*p) for p in found["closed"]["poles"]),
        "known to": f"{view.error:.1e} of the largest answer, pulse of {view.step:.3g} {view.unit}".rstrip(),
        "varies by": f"{view.variation:.1e} from one period to the next",
        "state space": f"{view.closed.nstates} states, {view.misfit:.1e} off",
    }
    for name, text in rows.items():
        out.print(f"  {name:14} {text}")
    if options.out:
        options.out.mkdir(parents=True, exist_ok=True)
        (options.out / "linear.json").write_text(json.dumps(found, indent=1) + "\n")
        view.plot().savefig(options.out / "linear.png", dpi=120)
        out.print(f"  {options.out}/linear.json, linear.png")
    return 0


def _complex(real: float, imag: float) -> str:
    return f"{real:.4g}" if not imag else f"{real:.4g}{imag:+.4g}j"


def print_steady(options: argparse.Namespace) -> int:
    """Print where each signal is at the end of a run; status 1 when one does not rest."""
    found = steady(options.scenario, at=options.at, window=options.window, overrides=_overrides(options))
    moving = 0
    for name, rest in found.items():
        rests = rest.rests(options.tolerance)
        moving += not rests
        moves = "" if rests else f"\tmoves: swing {rest.swing:.3g}, drift {rest.drift:.3g}"
        print(f"{name}\t{rest.mean:.9g} {rest.unit}".rstrip() + moves)
    return 1 if moving else 0
