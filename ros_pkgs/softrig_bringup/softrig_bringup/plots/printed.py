"""A picture drawn by matplotlib: for a paper, a page of the documentation, a notebook."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from softrig_core.wire.long import is_long

from . import style as look
from .canvas import Across, Axes, Figure, Place

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Printed


def printed(figure: Figure, style: Mapping[str, Any] | None = None) -> Printed:
    """Redraw a picture with matplotlib.

    Parameters
    ----------
    style : mapping
        Settings of matplotlib in addition to those of `softrig_bringup.plots.style`.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure as New

    with rc_context(look.style() | {"lines.linewidth": figure.line} | dict(style or {})):
        paper = New(figsize=figure.size, dpi=figure.dpi, layout="constrained")
        known: dict[int, Any] = {id(figure): paper}
        for call in figure.calls:
            target = known[id(call.target)]
            if call.name == "whole_numbers":
                from matplotlib.ticker import MaxNLocator

                target.xaxis.set_major_locator(MaxNLocator(integer=True))
                continue
            args = [_counterpart(value, known) for value in call.args]
            kwargs = {name: _counterpart(value, known, target) for name, value in call.kwargs.items()}
            result = getattr(target, call.name)(*args, **kwargs)
            if isinstance(call.result, np.ndarray | list):
                known |= {
                    id(shape): drawn for shape, drawn in zip(np.ravel(call.result), np.ravel(result), strict=True)
                }
            elif call.result is not None:
                known[id(call.result)] = result
    return paper


def _counterpart(value: Any, known: Mapping[int, Any], target: Any = None) -> Any:
    """Return matplotlib's counterpart of one of our objects; a number or a text is returned unchanged."""
    if isinstance(value, Across):
        return target.get_xaxis_transform() if value.data == "x" else target.get_yaxis_transform()
    # matplotlib takes an array that is read in stretches for one with several columns.
    if is_long(value):
        return np.asarray(value)
    if isinstance(value, Place):
        return known[id(value.grid)][value.key]
    if isinstance(value, list) and any(id(item) in known for item in value):
        return [_counterpart(item, known) for item in value]
    return known.get(id(value), value) if isinstance(value, Axes) or not isinstance(value, (int, float, str)) else value
