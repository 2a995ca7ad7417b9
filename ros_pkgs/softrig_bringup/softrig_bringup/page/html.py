"""Self-contained HTML pages: nothing to fetch, no script, for the screen and for paper."""

from __future__ import annotations

import base64
import struct
from collections.abc import Sequence
from pathlib import Path
from xml.etree.ElementTree import Element, fromstring, tostring

from softrig_core.guard import replace

NONE = "–"  # text of an empty cell


def write_page(output: Path, title: str, body: Sequence[Element]) -> None:
    """Write a page; the file appears complete or not at all."""
    replace(output, page(title, body))


def page(title: str, body: Sequence[Element]) -> str:
    """Create the text of a page from the elements of its main part."""
    head = e(
        "head",
        e("meta", charset="utf-8"),
        e("meta", name="viewport", content="width=device-width, initial-scale=1"),
        e("meta", name="color-scheme", content="light dark"),
        e("title", f"{title} · softrig"),
        e("style", _STYLE),
    )
    root = e("html", head, e("body", e("main", *body)), lang="en")
    return "<!DOCTYPE html>\n" + tostring(root, "unicode", "html")


def e(tag: str, *content: Element | str, **attributes: str) -> Element:
    """Create an element; text is escaped when the tree is written. ``class_`` is written as ``class``."""
    element = Element(tag, {name.rstrip("_"): value for name, value in attributes.items() if value})
    for item in content:
        if isinstance(item, Element):
            element.append(item)
        elif len(element):
            element[-1].tail = (element[-1].tail or "") + item
        else:
            element.text = (element.text or "") + item
    return element


def table(header: Sequence[str], rows: Sequence[Sequence[Element | str]], numbers: str = "") -> Element:
    """Create a table; `numbers` has an ``n`` for each column of numbers, right-aligned.

    It scrolls by itself; on a narrow screen each row becomes a list of its cells with their headings.
    """
    kinds = [kind.replace("n", "number").strip() for kind in numbers.ljust(len(header))]
    head = e("tr", *(e("th", text, scope="col", class_=kind) for text, kind in zip(header, kinds, strict=True)))
    body = [
        e(
            "tr",
            *(
                e("td", cell, class_=f"{kind} none".strip() if cell == NONE else kind, **{"data-label": label})
                for cell, kind, label in zip(row, kinds, header, strict=True)
            ),
        )
        for row in rows
    ]
    return e("div", e("table", e("thead", head), e("tbody", *body)), class_="scroll")


def picture(content: bytes | str, title: str) -> Element:
    """Create an image embedded in the page, with its size, so that the layout does not shift while the page loads.

    Parameters
    ----------
    content : bytes or str
        A picture of `softrig_bringup.plots.svg`, which becomes a part of the page with its description; or a PNG.
    title : str
        Title for a PNG, which has no title of its own.
    """
    png = content if isinstance(content, bytes) else content.encode()
    if png.startswith(b"<svg"):
        drawn = fromstring(png.replace(b' xmlns="http://www.w3.org/2000/svg"', b"", 1))
        drawn[:] = [element for element in drawn if element.tag != "style"]  # the page has a style of its own
        return drawn
    width, height = struct.unpack(">II", png[16:24])
    source = f"data:image/png;base64,{base64.b64encode(png).decode()}"
    return e("img", src=source, alt=title, width=str(width), height=str(height))


def mark(passed: bool, text: str) -> Element:
    """A verdict that does not depend on colour."""
    return e("span", "✓ " if passed else "✗ ", text, class_="pass" if passed else "miss")


_STYLE = """
:root { --ink: #1c2024; --soft: #5b6570; --line: #d9dee3; --panel: #f5f7f9; --paper: #ffffff; --link: #0b5cad;
  --good: #116b3a; --bad: #b3261e; }
@media (prefers-color-scheme: dark) {
  :root { --ink: #e4e8ec; --soft: #9aa5b1; --line: #3a424b; --panel: #242628; --paper: #1a1a1a; --link: #7db7f0;
    --good: #5fcf93; --bad: #ff8a80; }
  img, .plot { filter: invert(0.9) /* white to #1a1a1a */ hue-rotate(180deg); }
}
body { margin: 0; background: var(--paper); color: var(--ink); font: 15px/1.5 system-ui, "Segoe UI", "DejaVu Sans",
  sans-serif; }
main { max-width: 1100px; margin: 0 auto; padding: 2rem 1.25rem 4rem; }
h1 { font-size: 1.7rem; line-height: 1.25; margin: 0 0 .25rem; }
h2 { font-size: 1.25rem; margin: 2.2rem 0 .6rem; }
h3 { font-size: 1.05rem; margin: 1.8rem 0 .5rem; }
p { margin: .2rem 0; max-width: 75ch; }
a { color: var(--link); }
code, pre { font-family: ui-monospace, "DejaVu Sans Mono", monospace; font-size: .92em; }
pre { background: var(--panel); border: 1px solid var(--line); border-radius: 6px; padding: .7rem .9rem; margin: 0;
  white-space: pre-wrap; overflow-wrap: anywhere; }
.what, .note, figcaption { color: var(--soft); }
.note, figcaption { font-size: .87rem; }
* + section.run { border-top: 3px solid var(--line); margin-top: 3rem; padding-top: .5rem; }
dl { margin: 0; }
dt { color: var(--soft); font-size: .82rem; }
dd { margin: 0; font-variant-numeric: tabular-nums; overflow-wrap: anywhere; }
.facts { display: flex; flex-wrap: wrap; gap: .5rem 2.2rem; margin-top: 1rem; padding: .7rem 1rem;
  background: var(--panel); border: 1px solid var(--line); border-radius: 6px; }
.facts dd { font-weight: 600; }
.pairs { columns: 3 18rem; column-gap: 2rem; }
.pairs div { display: flex; justify-content: space-between; gap: 1rem; break-inside: avoid; padding: .12rem 0;
  border-bottom: 1px dotted var(--line); }
.pairs dt { font-size: .9rem; }
.pairs dd { font-size: .9rem; text-align: right; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-size: .92rem; font-variant-numeric: tabular-nums; }
th, td { text-align: left; padding: .34rem .9rem .34rem 0; border-bottom: 1px solid var(--line); vertical-align: top; }
th { color: var(--soft); font-weight: 600; font-size: .82rem; border-bottom-width: 2px; vertical-align: bottom; }
td code { overflow-wrap: anywhere; }
.number { text-align: right; }
td.number { white-space: nowrap; }
td small { display: block; color: var(--soft); font-size: .87em; }
.scroll + pre { margin-top: .7rem; }
th:last-child, td:last-child { padding-right: 0; }
.pass { color: var(--good); white-space: nowrap; }
.miss { color: var(--bad); font-weight: 600; white-space: nowrap; }
.broken { color: var(--bad); font-weight: 600; margin-top: .8rem; }
.gauge { vertical-align: -2px; }
.gauge .band { fill: var(--line); }
.gauge .centre { stroke: var(--soft); }
.gauge .pass { fill: var(--good); }
.gauge .miss { fill: var(--bad); }
.diagram { display: block; height: auto; margin: .3rem 0; }
.diagram text { font: 11px ui-monospace, "DejaVu Sans Mono", monospace; fill: var(--ink); }
.diagram .node rect { fill: var(--paper); stroke: var(--soft); stroke-width: 1.3; }
.diagram .plant rect { fill: var(--panel); stroke: var(--link); stroke-width: 2; }
.diagram .outside rect { stroke-dasharray: 6 4; }
.diagram .node text { text-anchor: middle; }
.diagram .name { font-weight: 700; }
.diagram .kind { fill: var(--soft); font-size: 10px; }
.diagram .wire path { fill: none; stroke: var(--soft); stroke-width: 1.3; }
.diagram .wire .head, .diagram .wire .dot { fill: var(--soft); stroke: none; }
.diagram .wire .open { fill: none; stroke: var(--soft); stroke-width: 1.3; }
.diagram .wire:hover path { stroke: var(--link); stroke-width: 2.4; }
.diagram .wire:hover text, .diagram .wire:hover .head, .diagram .wire:hover .dot { fill: var(--link); }
figure { margin: 0 0 1.4rem; break-inside: avoid; }
img, .plot { display: block; max-width: 100%; height: auto; }
details { border-top: 1px solid var(--line); padding: .35rem 0; }
summary { cursor: pointer; }
details.run > summary { font-size: 1.15rem; font-weight: 600; padding: .4rem 0; }
details .pairs { padding: .3rem 0 .6rem 1.1rem; }
@media screen and (max-width: 640px) {
  main { padding: 1.2rem .9rem 3rem; }
  figure, .wide { overflow-x: auto; }
  figure::before, .wide::before { content: "\\2194  moves sideways"; position: sticky; left: 0; color: var(--soft);
    font-size: .82rem; }
  figure img, figure .plot { max-width: none; width: 680px; }
  figcaption { position: sticky; left: 0; overflow-wrap: anywhere; }
  thead { display: none; }
  table, tbody, tr, td { display: block; }
  tr { border-bottom: 2px solid var(--line); padding: .45rem 0; }
  td, td.number { display: flex; justify-content: space-between; gap: 1rem; border: 0; padding: .08rem 0;
    text-align: right; white-space: normal; overflow-wrap: anywhere; }
  td:first-child { font-weight: 600; text-align: left; }
  td .note { font-weight: 400; }
  td::before { content: attr(data-label); color: var(--soft); font-weight: 400; text-align: left; flex: none; }
  td:first-child::before { content: none; }
  td:empty, td.none { display: none; }
  td small { display: inline; }
  .judged tr { display: flex; flex-wrap: wrap; gap: 0 .5rem; }
  .judged td { font-size: .93em; }
  .judged td:first-child { flex: 0 0 100%; }
  .judged td::before { content: none; }
  .judged td[data-label="Accepted"]::before { content: "accepted"; }
  .judged td[data-label="Accepted"] { gap: .4rem; }
  .judged td[data-label="Result"] { margin-left: auto; }
  .judged td[data-label^="Pub"], .judged td[data-label^="Against"], .judged td[data-label^="In "] { display: none; }
}
@media print {
  :root { --ink: #000; --soft: #444; --line: #bbb; --panel: #fff; --paper: #fff; --link: #000; --good: #000;
    --bad: #000; }
  @page { margin: 15mm; }
  body { font-size: 9.5pt; }
  main { max-width: none; padding: 0; }
  img, .plot { filter: none; max-height: 235mm; width: auto; }
  h2, h3 { break-after: avoid; }
  tr { break-inside: avoid; }
  * + section.run { break-before: page; }
  .scroll { overflow: visible; }
  details::details-content { content-visibility: visible; block-size: auto; }
}
"""
