"""What the suite costs: `scripts/softrig bench [PART...]`. Ratios to baselines of the same run, as machines differ."""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy is loaded, as on the command line
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from softrig_core.guard import guarded

from . import (
    against,
    beside,
    environment,
    exported,
    fault_location,
    gupfc,
    induction,
    loop,
    machines,
    native,
    optimal_control,
    places,
    reading,
    realtime,
    recorder,
    rectifier,
    rigs,
    systems,
    view,
)
from .console import console
from .falsification import table as falsification_table
from .page import Begin, Page, Tables, page, show, write

PARTS: dict[str, Callable[[], Tables | None]] = {
    "loop": loop.loop, "tick": loop.tick, "recording": loop.recording, "inprocess": rigs.inprocess,
    "processes": loop.processes, "bags": recorder.recorder_rate, "rigs": rigs.rigs, "native": native.tables,
    "exported_law": exported.print_law, "exported_rigs": exported.print_rigs,
    "exported_plant": exported.print_plant, "exported_fmus": exported.print_fmus,
    "containers": rigs.containers, "reading": reading.reading,
    "realtime": realtime.realtime, "view": view.view,
    "systems": systems.print_table, "induction": induction.table, "machines": machines.print_table,
    "peers": beside.peers,
    "fault_location": fault_location.print_table,
    "gupfc": gupfc.print_table, "rectifier": rectifier.print_table, "optimal_control": optimal_control.print_table,
    "falsify": falsification_table.print_table, "environment": environment.print_table,
    "places": places.table,
}  # fmt: skip

WARM = "All times are processor time, with code compiled and memory pages mapped by a run before"
#: The page of each part that has one.
PAGES: dict[str, Page] = {
    "peers": page("bringup", "peers", f"{WARM}. softrig has the least of three runs; each library ran once."),
    "reading": page(
        "bags",
        "bags_measured",
        "All times are processor time of a new process for each value, with fresh memory pages.",
    ),
    "native": page(
        "core",
        "native_measured",
        f"{WARM}; each value is the least of five. The memory of recordings is new in each run.",
    ),
    "induction": page(
        "core",
        "native_measured",
        f"{WARM}. softrig has the median of three runs; each library ran once.",
    ),
    "places": page("core", "native_measured", "A count, no time."),
    "containers": page(
        "nodes",
        "placements_measured",
        "Rates are by the wall clock, each run in a new process with fresh memory pages; container and in process have "
        "the best of three.",
    ),
    "loop": page(
        "nodes",
        "placements_measured",
        "All times are by the wall clock, the median of three runs of 5,000 loops in new processes.",
    ),
}


def about(part: str) -> str:
    """Return the subject of a part: the first line of its function's docstring."""
    return (PARTS[part].__doc__ or "").splitlines()[0]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the named parts, all when none is named."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    own_mains = {"against": against.main, "realtime": realtime.main}
    if words and (part_main := own_mains.get(words[0])):
        return guarded(partial(part_main, words[1:]))
    about_against = "this checkout and another commit, in turn"
    own = "bench against --help, bench realtime --help: options of these two"
    lines = "\n".join(f"  {part:17}{about(part)}" for part in PARTS)
    parser = argparse.ArgumentParser(
        prog="scripts/softrig bench",
        description=(__doc__ or "").splitlines()[0],
        epilog=f"parts:\n{lines}\n\nagainst COMMIT: {about_against}\n{own}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("parts", nargs="*", metavar="PART", help="which of those below; exported: each exported_...")
    parser.add_argument(
        "--write", action="store_true", help="write the tables of " + ", ".join(PAGES) + " to their pages"
    )
    options = parser.parse_args(words)
    named = options.parts or (list(PAGES) if options.write else list(PARTS))
    parts = [part for word in named for part in ([p for p in PARTS if p.startswith(f"{word}_")] or [word])]
    unknown = [part for part in parts if part not in PARTS]
    if unknown:
        parser.error(f"no part {', '.join(unknown)}; there are {', '.join(PARTS)}")
    if options.write and (bare := [part for part in parts if part not in PAGES]):
        parser.error(f"--write: {', '.join(bare)} has no page; {', '.join(PAGES)} have one")
    for part in parts:
        console.print(f"\n[bold]{part}[/]: {about(part)}")
        begin, begun = time.monotonic(), Begin.now()
        tables = PARTS[part]() or {}
        for table in tables.values():
            show(table)
        if options.write:
            write(PAGES[part], tables, f"scripts/softrig bench {part} --write", begun)
        console.print(f"{part} took {time.monotonic() - begin:.0f} s")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
