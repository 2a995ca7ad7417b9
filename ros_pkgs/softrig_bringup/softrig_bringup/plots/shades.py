"""Colour scales of pictures: matplotlib's cividis and viridis (CC0) by 21 of their colours, straight in between."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from softrig_core import Array

_SCALES = {
    "cividis": "00224e 002b62 083370 243c6e 35456c 434e6c 4f576c 5b606e 666970 727274 7d7c78 888578 948e77 a19975 "
    "aea371 bcae6c c8b866 d6c35d e5cf52 f3db42 fee838",
    "viridis": "440154 471365 482475 463480 414487 3b528b 355f8d 2f6c8e 2a788e 25848e 21918c 1e9c89 22a884 2fb47c "
    "44bf70 5ec962 7ad151 9bd93c bddf26 dfe318 fde725",
}


def shades(scale: str, shares: Sequence[float] | Array) -> list[str]:
    """Return the colours at places of a scale.

    Parameters
    ----------
    scale : {"cividis", "viridis"}
        Dark to light.
    shares : floats of shape (n,)
        From 0 to 1; NaN has no colour.

    Returns
    -------
    list of str
        As ``#rrggbb``; empty for NaN.
    """
    known = np.array([[int(c[k : k + 2], 16) for k in (0, 2, 4)] for c in _SCALES[scale].split()], float)
    positions = np.clip(np.asarray(shares, float), 0.0, 1.0)
    steps = np.linspace(0.0, 1.0, len(known))
    colours = np.stack([np.interp(positions, steps, known[:, k]) for k in range(3)], axis=-1).round()
    return ["" if np.isnan(colour).any() else "#{:02x}{:02x}{:02x}".format(*colour.astype(int)) for colour in colours]
