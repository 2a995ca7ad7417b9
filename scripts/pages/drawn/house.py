"""The house: rooms of softrig_core, softrig_nodes and softrig_bringup by floors, as their imports have it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from ..rooms import Room, rooms

PACKAGES = ("softrig_core", "softrig_nodes", "softrig_bringup")


def draw(folder: Path) -> None:
    """Draw the picture into a folder."""
    houses = [rooms(package) for package in PACKAGES]
    floors = [max(r.floor for r in house.values()) + 1 for house in houses]
    figure = Figure(figsize=(13.0, 0.85 * max(floors)), layout="constrained")
    for axis, package, house in zip(figure.subplots(1, 3, width_ratios=(5, 3, 4)), PACKAGES, houses, strict=True):
        _house(axis, house)
        axis.set_ylim(-0.6, max(floors) - 0.4)
        axis.set_title(package, fontsize=10, loc="left")
    figure.savefig(folder / "house.png", dpi=110)


def _house(axis: Any, house: dict[str, Room]) -> None:
    places = {}
    for floor in range(max(r.floor for r in house.values()) + 1):
        names = [r.name for r in house.values() if r.floor == floor]
        for k, name in enumerate(names):
            places[name] = (k - (len(names) - 1) / 2, floor)
    for room in house.values():
        for name in room.knows - {far for near in room.knows for far in _below(near, house)}:
            (x, y), (u, v) = places[room.name], places[name]
            axis.annotate("", (u, v + 0.22), (x, y - 0.22), arrowprops={"arrowstyle": "->", "color": "0.65", "lw": 0.9})
    for name, (x, y) in places.items():
        text = f"{name}\n{house[name].lines / 1000:.1f}k"
        box = {"boxstyle": "round,pad=0.35", "fc": "#eaf2f8", "ec": "#0072b2"}
        axis.text(x, y, text, ha="center", va="center", fontsize=8, bbox=box)
    wide = max(abs(x) for x, _ in places.values()) + 0.7
    axis.set_xlim(-wide, wide)
    axis.axis("off")


def _below(name: str, house: dict[str, Room]) -> set[str]:
    """Return all folders that a folder imports."""
    return house[name].knows | {far for near in house[name].knows for far in _below(near, house)}
