"""The wiring of a rig as a block diagram: an SVG drawing that takes its colours from the page.

Boxes are arranged in columns (`softrig_bringup.page.wiring.columns`). Between two columns is a channel. A wire leaves
its box to the right, is labelled with its topic, and has a vertical lane of its own in that channel. Readers in the
next column are connected to this lane. All other readers are connected by a track below the boxes and a second lane in
the channel before them. Every lane and track carries one wire, so wires cross but never overlap.

No library draws this: Graphviz is a program, which pip does not install, and elkjs is 1.5 MB of JavaScript in each
report. The layouts of networkx do not route wires.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from xml.etree.ElementTree import Element

from .html import e
from .wiring import Wire, Wiring, columns

LETTER = 6.7  # px, of the 11 px monospace letters
ROW = 22  # px from one wire of a box to the next; box tops are multiples of it, so rows of all boxes agree
HEAD = 2 * ROW  # px of a box above its first wire
LANE = 11  # px between lanes, and between tracks
STEM = 12  # px before the first and after the last lane of a channel; a ring at the end of a stub fits in
SMALLEST = 0.72  # smallest scale: a larger drawing scrolls


@dataclass(frozen=True)
class Box:
    """A node's place, px."""

    column: int
    x: float
    y: float
    width: float
    height: float


def draw_diagram(wiring: Wiring) -> Element:
    """Draw the block diagram of a rig.

    Returns
    -------
    Element
        An ``svg`` with one group of class ``node`` for each node and one of class ``wire`` for each wire, which name
        it in ``data-node`` and ``data-topic``.
    """
    result = columns(wiring)
    home = {n: k for k, column in enumerate(result) for n in column}
    # Lanes of the channel left of column k + 1.
    lanes = [_lanes(wiring.wires, home, k) for k in range(-1, len(result))]
    # from the column before on top, then from the tracks; the first wire has the lowest track: so few wires cross
    ins = {
        n: sorted((w for w in wiring.wires if n in w.readers), key=lambda w: home[w.source] + 1 != home[n])
        for n in wiring.nodes
    }
    outs = {n: [w for w in wiring.wires if w.source == n] for n in wiring.nodes}
    heights = {n: HEAD + ROW * max(1, len(ins[n]), len(outs[n])) for n in wiring.nodes}
    tall = max((sum(heights[n] + ROW for n in c) - ROW for c in result), default=0)
    boxes: dict[str, Box] = {}
    channels: list[float] = []  # x of the first lane of each channel
    x = 1.0
    for k, column in enumerate([[], *result]):
        wide = max((_width(wiring, n) for n in column), default=0.0)
        y = ROW * ((tall - sum(heights[n] + ROW for n in column) + ROW) // (2 * ROW))
        for n in column:
            boxes[n] = Box(k - 1, x, y, wide, heights[n])
            y += heights[n] + ROW
        longest = max((len(w.topic) for n in column for w in outs[n]), default=0)
        x += wide + (longest * LETTER + STEM if longest else 0.0)
        channels.append(x + STEM)
        x += LANE * len(lanes[k]) + 2 * STEM if lanes[k] or longest else 0.0
    below = {w.topic: tall + ROW + LANE * i for i, w in enumerate(w for w in wiring.wires[::-1] if _far(w, home))}
    height = tall + (ROW + LANE * len(below) if below else 0) + 2
    route = _Routes(boxes, channels, lanes, below, ins, outs)
    elements = [*(_wire(w, route) for w in wiring.wires), *(_box(n, wiring, boxes[n]) for n in wiring.nodes)]
    size = f"width: 100%; max-width: {x:.0f}px; min-width: {SMALLEST * x:.0f}px"
    return e(
        "svg",
        e("title", "Block diagram of the rig"),
        *elements,
        viewBox=f"-1 -1 {x + 2:.0f} {height + 2:.0f}",
        role="img",
        class_="diagram",
        style=size,
    )


def _far(wire: Wire, home: Mapping[str, int]) -> list[int]:
    """Return the columns of subscribers that are not next to the publisher's column."""
    return sorted({home[r] for r in wire.readers} - {home[wire.source] + 1})


def _lanes(wires: Sequence[Wire], home: Mapping[str, int], column: int) -> list[str]:
    """Return the lanes of the channel after a column: first those of its own wires, then those that lead to tracks."""
    outgoing = [f"{w.topic} out" for w in wires if home[w.source] == column and w.readers]
    return outgoing[::-1] + [f"{w.topic} in" for w in wires if column + 1 in _far(w, home)]


def _width(wiring: Wiring, node: str) -> float:
    kind = wiring.nodes[node].executable.partition("/")[2]
    return LETTER * 1.1 * max(len(node), len(kind) if kind != node else 0, 9) + 18.0


@dataclass(frozen=True)
class _Routes:
    """Positions of boxes, lanes and tracks."""

    boxes: Mapping[str, Box]
    channels: Sequence[float]
    lanes: Sequence[Sequence[str]]
    below: Mapping[str, float]
    ins: Mapping[str, Sequence[Wire]]
    outs: Mapping[str, Sequence[Wire]]

    def lane(self, column: int, name: str) -> float:
        """Place of a lane in the channel after a column."""
        return self.channels[column + 1] + LANE * self.lanes[column + 1].index(name)

    def start(self, wire: Wire) -> tuple[float, float]:
        box = self.boxes[wire.source]
        return box.x + box.width, box.y + HEAD + ROW * self.outs[wire.source].index(wire)

    def end(self, wire: Wire, reader: str) -> tuple[float, float]:
        box = self.boxes[reader]  # half a row below the outputs, so that the two never meet in a channel
        return box.x, box.y + HEAD + ROW * self.ins[reader].index(wire) + ROW / 2


def _wire(wire: Wire, route: _Routes) -> Element:
    """Draw one topic: stub with its name, lane, branches, track."""
    x0, y0 = route.start(wire)
    column = route.boxes[wire.source].column
    listed = ", ".join(wire.readers) or "nobody"
    elements: list[Element] = [e("title", f"{wire.topic} ({wire.type}): {wire.source} to {listed}")]
    name = e("text", wire.topic, x=f"{x0 + 5:g}", y=f"{y0 - 4:g}")
    if not wire.readers:
        end = x0 + 10 + LETTER * len(wire.topic)
        elements += [_path([(x0, y0), (end, y0)]), e("circle", cx=f"{end + 3:g}", cy=f"{y0:g}", r="3", class_="open")]
        return e("g", *elements, name, class_="wire", **{"data-topic": wire.topic})
    lane = route.lane(column, f"{wire.topic} out")
    elements.append(_path([(x0, y0), (lane, y0)]))
    near = [route.end(wire, r) for r in wire.readers if route.boxes[r].column == column + 1]
    levels = [y0, *(y for _, y in near)]
    for x, y in near:
        elements += _arrow(lane, x, y)
    far: dict[int, list[str]] = {}
    for r in wire.readers:
        if route.boxes[r].column != column + 1:
            far.setdefault(route.boxes[r].column, []).append(r)
    if far:
        track = route.below[wire.topic]
        levels.append(track)
        entries = {k: route.lane(k - 1, f"{wire.topic} in") for k in far}
        elements += _line([(x, track) for x in (lane, *entries.values())])
        for k, readers in far.items():
            ends = [route.end(wire, r) for r in readers]
            elements += _line([(entries[k], y) for y in (track, *(y for _, y in ends))])
            for x, y in ends:
                elements += _arrow(entries[k], x, y)
    elements += _line([(lane, y) for y in levels])
    return e("g", *elements, name, class_="wire", **{"data-topic": wire.topic})


def _line(points: Sequence[tuple[float, float]]) -> Iterator[Element]:
    """A straight line over points, with a dot at each that is not an end: there the wire branches."""
    first, *between, last = sorted(set(points))
    yield _path([first, last])
    yield from (e("circle", cx=f"{x:g}", cy=f"{y:g}", r="2.4", class_="dot") for x, y in between)


def _arrow(x0: float, x1: float, y: float) -> list[Element]:
    return [_path([(x0, y), (x1 - 6, y)]), e("path", d=f"M{x1:g} {y:g}l-8 -4v8z", class_="head")]


def _path(points: Sequence[tuple[float, float]]) -> Element:
    return e("path", d="M" + "L".join(f"{x:g} {y:g}" for x, y in points))


def _box(name: str, wiring: Wiring, box: Box) -> Element:
    node = wiring.nodes[name]
    kind = node.executable.partition("/")[2]
    below = "outside" if node.outside else kind if kind != name else "plant" if node.plant else ""
    middle = f"{box.x + box.width / 2:g}"
    about = f"{name}: {node.executable}, every {1e3 * node.period:g} ms{', outside' if node.outside else ''}"
    text = " ".join(["node", *(["plant"] if node.plant else []), *(["outside"] if node.outside else [])])
    return e(
        "g",
        e("title", about),
        e("rect", x=f"{box.x:g}", y=f"{box.y:g}", width=f"{box.width:g}", height=f"{box.height:g}", rx="5"),
        e("text", name, x=middle, y=f"{box.y + 17:g}", class_="name"),
        *([e("text", below, x=middle, y=f"{box.y + 32:g}", class_="kind")] if below else []),
        class_=text,
        **{"data-node": name},
    )
