"""The verb `falsify`."""

from __future__ import annotations

import argparse
from pathlib import Path

from softrig_core.command_line import named

from ..falsify.definition import falsification_of, list_falsifications
from ..falsify.engine import falsify, prepare
from ..falsify.outcome import print_outcome, write
from ..folder import FALSIFICATION, ResultsFolder
from ..options.naming import folder_of


def main(options: argparse.Namespace) -> int:
    """Search and write the results; return 1 for a violation or a missed margin, 3 when no run could be judged."""
    if options.what == "list":
        print("\n".join(sorted(list_falsifications())))
        return 0
    keys = ("budget", "seed", "sampler", "duration", "first", "strict")
    changes = {k: v for k in keys if (v := getattr(options, k)) is not None}
    changes |= {"requirements": options.requirement} if options.requirement else {}
    changes["over"] = dict(named(text, "--over", "LOW..HIGH") for text in options.over)
    written = not any(changes.values())
    task = falsification_of(options.what, changes)
    messages = [*options.over, *options.requirement, *(f"{k}_{changes[k]}" for k in keys if k in changes)]
    out = options.out or Path("runs") / folder_of([f"falsify_{task.name}", *messages])
    folder = ResultsFolder(out, FALSIFICATION)
    # Input that is refused must leave no folder behind.
    prepared = prepare(task)
    with folder.alone():
        try:
            outcome = falsify(task, prepared, out, workers=options.workers, scheduler=options.scheduler)
            files = write(task, outcome, out, not options.no_plots, options.format)
        finally:
            folder.close()
    print_outcome(task, outcome, out, files)
    if outcome.case is None:
        return 3
    if task.expect is not None and written:
        return 0 if task.expect.holds(outcome.search.least) else 1
    return 1 if outcome.violated else 0
