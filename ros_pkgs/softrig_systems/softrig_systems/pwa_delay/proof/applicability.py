"""Check that the theorems apply to a system: equilibrium at the origin, and no sliding on a face."""

from __future__ import annotations

import numpy as np
from softrig_core import Array

from ..system import PwaSystem

ROUNDING = 1e-9  # share of the sizes of its terms up to which a sum counts as zero


class NotApplicable(ValueError):
    """The theorem does not apply to this system; the text names the reason, cell and face."""


def require_equilibrium(system: PwaSystem) -> PwaSystem:
    """Ensure that the origin is an equilibrium of every cell, or shift it there.

    Returns
    -------
    PwaSystem
        With a_i = 0: conditions (11) to (13) for cells without the origin are unusable as printed.

    Raises
    ------
    NotApplicable
        An offset that no shift of the origin removes.
    """
    if not any(np.any(a) for a in system.a):
        if not any(np.any(e) for e in system.e):
            return system
        raise NotApplicable("a cell does not hold the origin; conditions (11) to (13) are unusable as printed")
    for i in range(system.cells):
        remaining, *_ = np.linalg.lstsq(system.A[i] + system.Ad[i], -system.a[i], rcond=None)
        z = np.concatenate([remaining, remaining])
        if all(
            _vanishes(system.A[j] + system.Ad[j], remaining, system.a[j]) and _vanishes(system.E[j], z, system.e[j])
            for j in range(system.cells)
        ):
            zero = tuple(np.zeros(system.n) for _ in system.a)
            none = tuple(np.zeros_like(e) for e in system.e)
            return PwaSystem(system.A, system.Ad, zero, system.E, none, system.F, system.lines, system.lines_delayed)
    worst = max(range(system.cells), key=lambda i: float(np.abs(system.a[i]).max()))
    raise NotApplicable(
        f"no equilibrium: the offset {np.round(system.a[worst], 6).tolist()} of cell {worst} stays, wherever the "
        "origin is put; the conditions (11) to (13) for such cells are unusable as printed"
    )


def _vanishes(m: Array, z: Array, offset: Array) -> bool:
    """Return whether m z + offset is zero within rounding, relative to its own terms, so that units do not matter."""
    size = np.abs(m).sum(axis=1) * np.abs(z).max(initial=0.0) + np.abs(offset)  # z is right beside its largest entry
    return bool(np.all(np.abs(m @ z + offset) <= ROUNDING * size))


def require_no_sliding(system: PwaSystem, h: float, *, samples: int = 200) -> None:
    """Ensure that the vector field crosses every face on x, by samples.

    On a face c'x = 0, for |x| = 1 and every x_d with |x_d - x| <= h max |x'|, the velocities c'x' on both sides must
    not point at each other nor away from each other. Faces on x_d are crossed by what has already happened.

    Raises
    ------
    NotApplicable
        Names the face and a point where both sides disagree.
    """
    n = system.n
    rng = np.random.default_rng(4)
    fastest = max(
        float(np.linalg.norm(system.A[i], 2) + np.linalg.norm(system.Ad[i], 2) + np.linalg.norm(system.a[i]))
        for i in range(system.cells)
    )
    radius = min(h * fastest, 2.0)
    for i, row, j in system.faces():
        normal = system.E[i][row]
        if np.any(normal[n:] != 0.0) or j < i:
            continue
        c = normal[:n]
        for z in system.on_face(i, row, rng, samples):
            x = z[:n] / max(float(np.linalg.norm(z[:n])), 1e-9) if n > 1 else z[:n]
            step = rng.normal(size=n)
            x_d = x + radius * rng.random() * step / np.linalg.norm(step)
            speed_i, size_i = _across(system, i, c, x, x_d)
            speed_j, size_j = _across(system, j, c, x, x_d)
            if speed_i * speed_j < 0.0 and abs(speed_i) > ROUNDING * size_i and abs(speed_j) > ROUNDING * size_j:
                kind = "sliding" if speed_i < 0.0 < speed_j else "repelling"
                raise NotApplicable(
                    f"{kind} on the face {np.round(c, 3).tolist()} x = 0 of cells {i} and {j}: at x = "
                    f"{np.round(x, 3).tolist()}, x_d = {np.round(x_d, 3).tolist()} the velocities across it are "
                    f"{speed_i:.3g} and {speed_j:.3g}"
                )


def _across(system: PwaSystem, i: int, c: Array, x: Array, x_d: Array) -> tuple[float, float]:
    """Return the velocity c'x' in cell i, and the size of its terms."""
    A, Ad, a = system.A[i], system.Ad[i], system.a[i]
    size = np.abs(c) @ (np.abs(A) @ np.abs(x) + np.abs(Ad) @ np.abs(x_d) + np.abs(a))
    return float(c @ (A @ x + Ad @ x_d + a)), float(size)
