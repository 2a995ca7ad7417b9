"""Pictures: the record of both ends, the objective along the line, the methods over the 48 cases, the misprints."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .cases import LENGTH, PLACES, PUBLISHED, Case
from .method.location import Location, Locator
from .method.objective import LocatorParams
from .records.record import Record

if TYPE_CHECKING:
    from .study import Row

MISPRINTS = ("corrected", "printed", "printed_sign", "printed_coefficient", "printed_resistance", "printed_speed")


def _figure(rows: int, columns: int = 1, *, height: float) -> tuple[Any, Any]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, height * rows + 0.6), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns, squeeze=False)


def waveforms(record: Record, p: LocatorParams, path: Path, fault: tuple[float, float] | None = None) -> None:
    """Draw voltages and currents of both ends, with the window shaded and a known fault interval darker."""
    figure, axes = _figure(4, height=1.9)
    titles = ("bus S, voltage, kV", "bus S, current, kA", "bus R, voltage, kV", "bus R, current, kA")
    ms = 1e3 * record.t
    for axis, name, title in zip(axes[:, 0], ("u_s", "i_s", "u_r", "i_r"), titles, strict=True):
        for phase, color in zip(range(3), ("tab:red", "tab:olive", "tab:blue"), strict=True):
            axis.plot(ms, 1e-3 * record.group(name)[:, phase], color=color, lw=0.8, label="abc"[phase])
        axis.axvspan(1e3 * p.window_start, 1e3 * p.window_end, color="0.85", zorder=0)
        if fault is not None:
            for t in fault:
                axis.axvline(1e3 * t, color="k", lw=0.7, ls="--")
        axis.set_ylabel(title, fontsize=8)
    axes[0, 0].legend(loc="upper right", ncols=3, fontsize=8)
    axes[-1, 0].set_xlabel("time, ms (shaded: window of the objective; dashed: the fault)")
    figure.savefig(path, dpi=110)


def objective(record: Record, p: LocatorParams, location: Location, path: Path, truth: float | None = None) -> None:
    """Draw F(x) of the three aerial modes with its minimum and the truth, whole line and the last 400 m around it."""
    work = Locator(record, p)
    figure, axes = _figure(1, 2, height=3.4)
    centre = location.x_km if location.x_km is not None else (0.5 * work.section.length if truth is None else truth)
    wide = np.linspace(0.0, work.section.length, 601)
    near = np.clip(np.linspace(centre - 0.2, centre + 0.2, 401), 0.0, work.section.length)
    for axis, x in zip(axes[0], (wide, near), strict=True):
        for mode, label in ((1, "(a-b)/3"), (2, "(b-c)/3"), (3, "(c-a)/3")):
            axis.plot(x, work.f(x, mode), lw=1.5 if mode == location.mode else 0.7, label=f"mode {mode} {label}")
        if location.x_km is not None:
            axis.axvline(location.x_km, color="tab:green", lw=1.0, label=f"minimum {location.x_km:.4f} km")
        if truth is not None:
            axis.axvline(truth, color="k", lw=0.8, ls="--", label=f"truth {truth:g} km")
        axis.set_yscale("log")
        axis.set_xlabel("x, km")
        if location.x_km is not None:  # a mode without excitation is far below the others
            axis.set_ylim(bottom=0.3 * location.f_min)
    axes[0, 0].set_ylabel("F(x), V")
    axes[0, 0].legend(fontsize=7)
    axes[0, 1].locator_params(axis="x", nbins=5)
    figure.savefig(path, dpi=110)


def methods(rows: Sequence[Row], path: Path) -> None:
    """Draw |error| of every method over the 48 cases, with the published values of the two swarms."""
    figure, axes = _figure(1, height=4.2)
    axis = axes[0, 0]
    order = list(PUBLISHED)
    for name in dict.fromkeys(row.method for row in rows):
        of_case = {Case(r.type, r.x_km, r.rf_ohm): r.error_percent for r in rows if r.method == name}
        errors = [of_case.get(case) for case in order]
        axis.plot([np.nan if e is None else max(abs(e), 1e-6) for e in errors], ".-", lw=0.6, ms=4, label=name)
    for label, key in (("WOA, published", "woa_error"), ("GWO, published", "gwo_error")):
        axis.plot([abs(getattr(PUBLISHED[case], key)) for case in order], "x", ms=4, label=label)
    axis.set_yscale("log")
    axis.set_ylabel("|error|, % of the line")
    axis.set_xticks(range(0, 48, 4), [f"{c.type}\n{c.rf_ohm:g} ohm" for c in order[::4]], fontsize=7)
    axis.set_xlabel(f"each type at {', '.join(f'{x:g}' for x in PLACES)} km")
    axis.legend(fontsize=7, ncols=4)
    axis.grid(alpha=0.3)
    figure.savefig(path, dpi=110)


def misprints(record: Record, p: LocatorParams, path: Path, truth: float) -> None:
    """Draw F(x) by the corrected equations and by each misprint of the paper."""
    figure, axes = _figure(1, height=3.8)
    axis = axes[0, 0]
    mode = Locator(record, p).choose().mode
    for equations in MISPRINTS:
        work = Locator(record, p.model_copy(update={"equations": equations}))
        x = np.linspace(0.0, LENGTH, 1201)
        f = work.f(x, mode)
        (line,) = axis.plot(x, f, lw=0.9, label=f"{equations}: {x[int(np.argmin(f))]:.1f} km")
        axis.plot(x[int(np.argmin(f))], np.min(f), "o", ms=4, color=line.get_color())
    axis.axvline(truth, color="k", lw=0.8, ls="--", label=f"truth {truth:g} km")
    axis.set_yscale("log")
    axis.set_xlabel("x, km")
    axis.set_ylabel("F(x), V")
    axis.legend(fontsize=7)
    figure.savefig(path, dpi=110)
