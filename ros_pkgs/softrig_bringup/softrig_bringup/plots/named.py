"""Names and display data of pictures, for pages that draw none themselves."""

from __future__ import annotations

import re

from pydantic import BaseModel, ConfigDict

OVERVIEW = "overview.svg"
LEAST = 3  # runs that a band needs; fewer are drawn one by one


def plot_name(number: int, title: str) -> str:
    """File name of a scenario's plot entry, counted from 1."""
    return f"plot_{number:02d}_{re.sub(r'[^a-z0-9]+', '_', title.lower()).strip('_')[:60]}.svg"


class Shown(BaseModel):
    """Display data of a plotted signal on pages about several runs: its unit, and how it is drawn."""

    model_config = ConfigDict(frozen=True)

    unit: str
    held: bool
    reference: bool
