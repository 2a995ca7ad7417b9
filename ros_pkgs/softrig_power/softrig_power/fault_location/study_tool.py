"""`ros2 run softrig_power fault_study`: the 48 published cases by every method on all cores, table and pictures."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from softrig_core.command_line import Number, without_ros
from softrig_core.guard import guarded, replace

from .cases import PUBLISHED
from .line.parameters import FaultParams, RigParams
from .method.location import locate
from .method.objective import LocatorParams
from .study import METHODS, SENSITIVITY, Row, as_csv, published_jobs, run, sensitivity, simulate


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study; 0 when it is complete, 130 when Ctrl-C stopped it."""
    return guarded(lambda: _study(sys.argv[1:] if arguments is None else arguments))


def _study(arguments: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(prog="fault_study", description=__doc__)
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS))
    parser.add_argument("--profile", default="m20k", choices=("m100k", "m20k", "m10k", "m4k", "raw100k", "raw20k"))
    parser.add_argument("--processes", type=Number(int, 1, 1000), metavar="N", help="default: all cores")
    parser.add_argument("--sensitivity", action="store_true", help="the disturbed records instead of the 48 cases")
    parser.add_argument("--out", type=Path, metavar="DIR", help="cases.csv and the pictures go here")
    options = parser.parse_args(without_ros(arguments))
    if options.sensitivity:
        print(sensitivity_table(sensitivity(processes=options.processes)))
        return 0
    began = time.monotonic()
    rows = run(published_jobs(options.methods, options.profile), options.processes)
    print(summary(rows))
    print(f"{len(rows)} locations in {time.monotonic() - began:.0f} s")
    if options.out is not None:
        _save(rows, options.out)
    return 0


def summary(rows: Sequence[Row]) -> str:
    """Return mean and largest |error| and the computation time of each method as a table, with the published ones."""
    lines = [f"{'method':<18}{'mean |E| %':>12}{'max |E| %':>12}{'max m':>10}{'CPU s':>10}{'located':>9}"]
    for method in dict.fromkeys(row.method for row in rows):
        selected = [row for row in rows if row.method == method]
        errors = np.array([abs(row.error_percent) for row in selected if row.error_percent is not None])
        spent = np.mean([row.cpu_s for row in selected])
        lines.append(
            f"{method:<18}{errors.mean():>12.4f}{errors.max():>12.4f}{errors.max() * 1200.0:>10.1f}{spent:>10.3f}"
            f"{errors.size:>6}/{len(selected)}"
        )
    for name, key in (("published WOA", "woa_error"), ("published GWO", "gwo_error")):
        printed = np.array([abs(getattr(row, key)) for row in PUBLISHED.values()])
        lines.append(f"{name:<18}{printed.mean():>12.4f}{printed.max():>12.4f}{printed.max() * 1200.0:>10.1f}")
    return "\n".join(lines)


def sensitivity_table(table: dict[str, list[float]]) -> str:
    """Return the sensitivity table with a head."""
    heads = [f"{c.type} {c.x_km:g} km {c.rf_ohm:g} ohm" for c in SENSITIVITY]
    lines = ["error in m".ljust(24) + "".join(f"{head:>20}" for head in heads)]
    lines += [name.ljust(24) + "".join(f"{value:>20.1f}" for value in values) for name, values in table.items()]
    return "\n".join(lines)


def _save(rows: Sequence[Row], folder: Path) -> None:
    """Write the table and the four pictures of the system."""
    from .pictures import methods, misprints, objective, waveforms

    folder.mkdir(parents=True, exist_ok=True)
    replace(folder / "cases.csv", as_csv(rows))
    methods(rows, folder / "methods.png")
    rig, p = RigParams(), LocatorParams()
    record, fault = simulate(rig), rig.fault
    waveforms(record, p, folder / "waveforms.png", (fault.t_on, fault.t_off))
    objective(record, p, locate(record, p), folder / "objective.png", truth=fault.x_km)
    far = RigParams(fault=FaultParams(x_km=115.0, rf_ohm=15.0))
    misprints(simulate(far), p, folder / "misprints.png", truth=far.fault.x_km)


if __name__ == "__main__":
    sys.exit(main())
