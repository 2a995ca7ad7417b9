"""The first page, the lists of each kind of page, and the gallery of systems."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import yaml
from pages.generated import verdicts
from softrig_bags.read import signals
from softrig_bringup.film.film import PAST, rows
from softrig_bringup.film.svg import still
from softrig_core import list_scenarios, load_scenario, rig_of
from softrig_core.drawing import drawing_for
from softrig_core.rig.code import is_ours

from .outline import GALLERY, GUIDES, KINDS, ROOT, SYSTEMS, opening, pages, title

_ROW = re.compile(r"\]\(ros_pkgs/[^)]*/doc/(\w+)\.md\)[^`|]*`(\w+)`\s*\|\s*([^|]*?)\s*\|")

INDEX = """# softrig

Closed loops over real ROS 2 topics **that give the same numbers every time**: published plants and controllers of
drives, power converters, robots and networks, each its own node, in one process or in ten, recorded and replayed bit
for bit.

![A robot in motion beside its curves, and a terminal in which its run is repeated](pictures/first_run.svg)

```bash
scripts/softrig run dc_motor_smc --mode container
```

::::{grid} 1 2 2 2
:gutter: 3

"""


def sentences() -> dict[str, tuple[str, str]]:
    """Return for each system the scenario to run and its result, as in the table of the README."""
    table = (ROOT / "README.md").read_text(encoding="utf-8")
    return {name: (scenario, text) for name, scenario, text in _ROW.findall(table)}


def thumbnail(name: str, site: Path) -> None:
    """Draw the plant of a system, on light and dark ground, at six tenths of its shortest-named golden bag."""
    recipe = min(ROOT.glob(f"bags/{name}*/golden.yaml"), key=lambda path: (len(path.parent.name), path))
    drawing = drawing_for(rig_of(yaml.safe_load(recipe.read_text(encoding="utf-8"))["scenario"]))
    assert drawing is not None, name
    result = signals(recipe.parent / "bag")
    known = {n: result[n] for n in drawing.signals if n in result and result[n].t.size}
    end = max(float(signal.t[-1]) for signal in known.values())
    row = rows(known, np.linspace(0.0, 0.6 * end, PAST))
    text = still(drawing, drawing.frame(row[-1], row[:-1] if drawing.trail else ()))
    (site / "pictures").mkdir(exist_ok=True)
    (site / "pictures" / f"{name}_drawing.svg").write_text(text, encoding="utf-8")


def slug(text: str) -> str:
    """Write a word as the name of a class."""
    return re.sub(r"\W+", "-", text.lower())


def write(site: Path) -> None:
    """Write the gallery: a card a system, with buttons for fields and methods."""
    message = sentences()
    if missing := sorted(GALLERY.keys() - message.keys()):
        raise ValueError(f"README.md: its table of systems has no row of {', '.join(missing)}")
    fields = dict.fromkeys(s.field for s in GALLERY.values())
    methods = sorted({m for s in GALLERY.values() for m in s.methods})
    text = [
        "# Gallery",
        "",
        "Most systems were rebuilt from a paper, whose errors are corrected in the model; the page holds what was",
        "published beside what is measured here. Machines and converters of the field are held against closed forms.",
        "",
        "```{raw} html",
        '<div class="filter">',
    ]
    for label, names in (("Field", fields), ("Method", methods)):
        buttons = "".join(f'<button type="button" data-only="{slug(n)}">{n}</button>' for n in names)
        text.append(f'<p><span>{label}</span><button type="button" data-only="" class="on">all</button>{buttons}</p>')
    text += ["</div>", "```", "", "::::{grid} 1 2 2 3", ":gutter: 3", ":class-container: systems", ""]
    for name, system in GALLERY.items():
        scenario, sentence = message[name]
        claims = [f"{{.verdicts}}\nClaims of the paper: {verdicts(load_scenario(scenario).system)}", ""]
        text += [
            f":::{{grid-item-card}} {title(pages()[name]).split(':')[0]}", f":link: {name}", ":link-type: doc",
            f":img-top: ../pictures/{name}_drawing.svg", f":img-alt: {title(pages()[name])}",
            f":class-item: {' '.join(map(slug, (system.field, *system.methods)))}", "",
            sentence, "", f"{{.tags}}\n{system.field} · {' · '.join(system.methods)}", "",
            *(claims if name in SYSTEMS else ()), f"{{.try}}\n`run {scenario}`", "",
            f"{{.another}}\nAnother machine: {load_scenario(system.another).title}, `run {system.another}`", ":::", "",
        ]  # fmt: skip
    text += ["::::", "", "```{toctree}", ":hidden:", "", *GALLERY, "```", ""]
    (site / "gallery" / "index.md").write_text("\n".join(text), encoding="utf-8")


def write_indices(site: Path) -> None:
    """Write the first page, and one index for each kind of page."""
    index = [INDEX]
    shown = "{} systems: {} experiments to run, change and question."
    entries = [("gallery", "Gallery", shown.format(len(GALLERY), len(list_scenarios())))]
    entries += [(kind, head, text) for kind, (head, text, _) in KINDS.items()]
    for folder, head, text in entries:
        index += [f":::{{grid-item-card}} {head}", f":link: {folder}/index", ":link-type: doc", "", text, ":::", ""]
    index += ["::::", "", "```{toctree}", ":hidden:", "", *(f"{folder}/index" for folder, _, _ in entries), "```", ""]
    (site / "index.md").write_text("\n".join(index), encoding="utf-8")
    for kind, (head, text, names) in KINDS.items():
        made = sorted(p.stem for p in (site / kind).glob("*.*") if p.stem not in names)
        made.sort(key=lambda name: (is_ours(name), name != "softrig_core", name != "verbs"))
        lines = [f"# {head}", "", text, ""]
        groups = {"": (*names, *made)} if kind != "how-to" else GUIDES | ({"More": tuple(made)} if made else {})
        for group, members in groups.items():
            lines += [f"## {group}", ""] if group else []
            for name in members:
                (page,) = (site / kind).glob(f"{name}.*")
                lines += [f"- [{title(page)}]({page.name})  ", f"  {opening(page)}"]
            caption = [f":caption: {group}"] if group else []
            lines += ["", "```{toctree}", ":hidden:", *caption, "", *members, "```", ""]
        (site / kind / "index.md").write_text("\n".join(lines), encoding="utf-8")
