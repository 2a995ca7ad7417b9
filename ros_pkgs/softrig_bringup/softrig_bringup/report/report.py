"""Runs as one self-contained HTML page: nothing to fetch, no script, for the screen and for paper."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from xml.etree.ElementTree import Element

from softrig_core import ScenarioError
from softrig_core.guard import print_line

from ..folder import MARKS
from ..options.identity import contradictions
from ..pack.parts import is_pack
from ..page.html import e, write_page
from .apart import names
from .record import RunRecord, read_run
from .run_page import run_section
from .several import differences, index, overlaid, side_by_side

MARK = "metrics.json"  # this file marks the folder of a run


def _with_their_runs(directories: Sequence[Path]) -> list[Path]:
    """Replace each folder that is not a run by the runs below it, if there are any."""
    result: list[Path] = []
    for directory in directories:
        below = [] if (directory / MARK).exists() else sorted(mark.parent for mark in directory.glob(f"*/{MARK}"))
        result += below or [directory]
    return result


def write_report(
    directories: Sequence[Path],
    output: Path,
    labels: Sequence[str] = (),
    *,
    check: bool = False,
    head: Sequence[Element] = (),
) -> tuple[list[RunRecord], list[str]]:
    """Write one page about one or more runs.

    Parameters
    ----------
    directories : sequence of Path
        Run directories, or folders of such: ``metrics.json``, the bag, and the pictures of
        `softrig_bringup.plots.pictures.plot_run`, as far as they are there; or packs, whose figures are computed.
    output : Path
        The HTML file; it is written completely or not at all.
    labels : sequence of str
        Names of the first runs, in order; the other runs are named by their own label or folder.
    check : bool
        Whether bags are compared with their metrics.json; differences are reported and marked.

    head : sequence of Element
        Elements at the top of the page, in place of its own title.

    Returns
    -------
    list of RunRecord, list of str
        The runs and their names.

    Raises
    ------
    ScenarioError
        A directory is not that of a run, or there are more labels than runs.
    """
    runs: list[tuple[Path, RunRecord]] = []
    without = []
    for directory in _with_their_runs(directories):
        if directory.is_dir() and not (directory / MARK).exists():
            without.append(str(directory))
            continue
        runs.append(_of_pack(directory) if is_pack(directory) else (directory, read_run(directory)))
        folder, record = runs[-1]
        if check and not record.contradictions and (result := contradictions(folder)):
            runs[-1] = folder, record.having(contradictions=result)
        for contradiction in runs[-1][1].contradictions if check else ():
            print_line(f"{directory}: {contradiction}")
    if not runs:
        partial = any(any(Path(directory, "log").glob("*.shard")) for directory in without)
        remaining = (
            "; of parts of a rig (--only) softrig bag repair makes one bag from their .shard files" if partial else ""
        )
        for kind, path in ((MARKS.get(mark), Path(d)) for d in without for mark in MARKS if Path(d, mark).exists()):
            raise ScenarioError(f"{path}: is a {kind}; its page is {path / 'report.html'}, and its verb writes it")
        raise ScenarioError(f"{', '.join(without)}: no metrics.json there, expected directories of runs{remaining}")
    records = [run for _, run in runs]
    if len(labels) > len(runs):
        raise ScenarioError(f"--label {labels[len(runs)]!r}: there are {len(labels)} labels for {len(runs)} runs")
    named = names(runs, labels)
    if len(runs) == 1:
        title = records[0].label or records[0].title
        body = [run_section(*runs[0], title, "h1", "run-1")]
    else:
        title = f"{len(runs)} runs"
        body = [
            *([*head, e("h2", "The runs")] if head else ()),
            index(records, named) if head else e("header", e("h1", title), index(records, named)),
            *side_by_side(records, named),
            *differences(records, named),
            *overlaid(runs, named),
        ]
        body.append(e("h2", "Each run by itself"))  # folded, because the differences are listed above
        for i, (run, name) in enumerate(zip(runs, named, strict=True), 1):
            body.append(e("details", e("summary", name), run_section(*run, name, "h2", f"run-{i}"), class_="run"))
    if without:
        body.append(e("p", f"Left out, without a metrics.json: {', '.join(without)}", class_="note"))
    write_page(output, title, body)
    return records, named


def _of_pack(path: Path) -> tuple[Path, RunRecord]:
    """Read a pack as a run, without any code of its sender."""
    from ..pack.packed import opened  # late import: pydantic is not needed for the folder of a run
    from .looked import record_of_pack  # late import: it builds the rig

    folder = opened(path)
    try:
        run = record_of_pack(folder)
    except ScenarioError as error:
        raise ScenarioError(f"{path}: {error}") from None
    return folder, run.having(label=run.label or path.name)
