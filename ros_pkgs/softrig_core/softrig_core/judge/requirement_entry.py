"""Requirements as a scenario file has them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Annotated, Any

from pydantic import BeforeValidator, Field

from ..entry import Entry
from ..errors import ScenarioError
from ..timebase import SECOND
from .expression import references
from .formula import horizon, named, read, timing, with_names


class Requirement(Entry):
    """A requirement on a run.

    Parameters
    ----------
    formula : str
        A formula over the scenario's shared names, ``$node.parameter`` and figures, times in s: ``always[1.1, 3]
        abs(speed - set_point) <= 0.02 * set_point``.
    where : str
        Place of the requirement in the paper or data sheet.
    scale : dict of str to float
        By unit, the value that counts as one, for formulas that compare several units. The margin is then a pure
        number.
    live : bool
        Whether a node ``requirement_NAME`` monitors it while the rig runs.
    ends : bool
        Whether that node ends the run when it is violated; implies `live`.
    """

    formula: str = Field(min_length=1, max_length=2000)
    where: str = ""
    scale: dict[str, Annotated[float, Field(gt=0.0)]] = {}
    live: bool = False
    ends: bool = False


Required = Annotated[
    Requirement, BeforeValidator(lambda value: {"formula": value} if isinstance(value, str) else value)
]


def check_lengths(
    duration: float, shared: Mapping[str, Any], requirements: Mapping[str, Requirement], figures: Iterable[str] = ()
) -> None:
    """Refuse requirements that no run of a scenario's length can be judged by.

    Times that are taken from nodes are not known yet; a run that ends before them is not judged by that requirement.

    Parameters
    ----------
    duration : float
        Of the run, s.
    shared : mapping
        Values by name.
    requirements : mapping
        By name.
    figures : iterable of str, optional
        Names of the scenario's figures, which formulas may use.

    Raises
    ------
    ScenarioError
        Names the requirement, its last window and the duration.
    """
    for name, requirement in requirements.items():
        formula, asked = with_names(requirement.formula), {*map(named, references(requirement.formula))}
        numbers = {k: float(v) if _is_number(v) else None for k, v in shared.items()}
        later = asked | {*figures} | {k for k, v in shared.items() if isinstance(v, str) and references(v)}
        if timing(formula) & later - {k for k, v in numbers.items() if v is not None}:
            continue
        try:
            # References that are only compared do not affect a window, so any number stands for them.
            reach = horizon(read(formula, dict.fromkeys(asked, 1.0) | dict.fromkeys(figures) | numbers)[0]) / SECOND
        except ScenarioError as error:
            raise ScenarioError(f"requirement {name}: {error}") from None
        # Both are rounded floats, so a window that ends with the run may seem to end after it.
        if reach > duration * (1.0 + 1e-12):
            raise ScenarioError(
                f"requirement {name}: its last window ends {reach:g} s after the start, the run ends "
                f"after {duration:g} s"
            )


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
