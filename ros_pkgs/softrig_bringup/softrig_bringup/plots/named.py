"""Names and display data of pictures, for pages that draw none themselves."""

from __future__ import annotations

import re
from dataclasses import dataclass

from softrig_core.data import Data

OVERVIEW = "overview.svg"
LEAST = 3  # runs that a band needs; fewer are drawn one by one


def plot_name(number: int, title: str) -> str:
    """File name of a scenario's plot entry, counted from 1."""
    return f"plot_{number:02d}_{re.sub(r'[^a-z0-9]+', '_', title.lower()).strip('_')[:60]}.svg"


@dataclass(frozen=True)
class Shown(Data):
    """Display data of a plotted signal on pages about several runs: its unit, and how it is drawn."""

    unit: str
    held: bool
    reference: bool
