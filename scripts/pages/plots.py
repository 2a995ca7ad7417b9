"""Pictures on doc pages: a plot entry of a scenario, or its plant in motion, from a run in process beside the page."""

from __future__ import annotations

import shutil
from pathlib import Path
from tempfile import TemporaryDirectory

from softrig_bringup.plots.named import plot_name
from softrig_bringup.plots.pictures import plot_run
from softrig_bringup.verbs.animate import film_of, write
from softrig_core import ScenarioError, load_scenario, simulate
from softrig_core.drawing import drawing_for
from softrig_core.scenario.plot_entry import PlotEntry


def picture(scenario: str, number: int) -> str:
    """Return the Markdown of a picture.

    Parameters
    ----------
    scenario : str
    number : int
        Of one of its plot entries, from 1.

    Raises
    ------
    ScenarioError
        It has no such entry.
    """
    return f"![{_entry(scenario, number).title}]({_file(scenario, number)})"


def draw(scenario: str, number: int, directory: Path) -> None:
    """Run a scenario in process and draw one of its plot entries; parameters as for `picture`."""
    title = _entry(scenario, number).title
    run = simulate(scenario)
    with TemporaryDirectory() as drawn:
        plot_run(run.signals, run.rig, Path(drawn), "png")
        picture = Path(drawn, plot_name(number, title)).with_suffix(".png")
        shutil.copyfile(picture, directory / _file(scenario, number))


def animation(scenario: str) -> str:
    """Return the Markdown of a scenario's plant in motion.

    Raises
    ------
    ScenarioError
        There is no drawing of it.
    """
    drawing = drawing_for(scenario)
    if drawing is None:
        raise ScenarioError(f"animation of {scenario}: there is no drawing of its plant")
    return f"![{drawing.title}]({scenario}.svg)"


def animate(scenario: str, start: float, end: float, directory: Path) -> None:
    """Run a scenario in process and draw its plant from one time to another, s."""
    write(film_of(scenario, start, end), directory / f"{scenario}.svg")


def _entry(scenario: str, number: int) -> PlotEntry:
    plots = load_scenario(scenario).plots
    if not 1 <= number <= len(plots):
        raise ScenarioError(f"picture {number} of {scenario}: expected a plot entry from 1 to {len(plots)}")
    return plots[number - 1]


def _file(scenario: str, number: int) -> str:
    return f"{scenario}_{number}.png"
