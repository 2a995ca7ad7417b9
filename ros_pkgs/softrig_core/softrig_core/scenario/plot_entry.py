"""The entry of a picture in a scenario."""

from __future__ import annotations

from pydantic import Field, field_validator

from ..entry import Entry


class PlotEntry(Entry):
    """One picture: signals as ``topic/channel/field`` with an optional label.

    Parameters
    ----------
    signals : dict of str to str
        Signal name to label (empty: the signal's own name). In plots over time also ``one - other``: a signal minus the
        newest value of another.
    unit : str
        Of the y axis; if empty, that of the ports, with one row per unit.
    quantity : str
        Title of the y axis, before its unit; if empty, the quantity that the unit measures.
    x : str
        Label of the signal on the x axis, below each signal's own topic, in place of time: ``x`` draws ``flux/y``
        against ``flux/x``; ``voltage/position`` draws a power against the voltage of the same topic.
    window : (float, float)
        First and last time (s) shown; None: the whole run.
    """

    title: str
    signals: dict[str, str] = Field(min_length=1)
    unit: str = ""
    quantity: str = ""
    x: str = ""
    window: tuple[float, float] | None = None

    @field_validator("window")
    @classmethod
    def _forward(cls, window: tuple[float, float] | None) -> tuple[float, float] | None:
        if window is not None and not window[0] < window[1]:
            raise ValueError(f"window {window[0]:g} to {window[1]:g} s: expected its begin before its end")
        return window
