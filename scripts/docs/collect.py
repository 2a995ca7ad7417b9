"""Pages of the packages in the form of the site: adapted links, no comments, folding parts as there."""

from __future__ import annotations

import html
import json
import os
import re
import shutil
from pathlib import Path

from .outline import KEYWORDS, ROOT, places

_COMMENT = re.compile(r"^<!--.*?-->\n|<!--.*?-->", re.S | re.M)
_LINK = re.compile(r"(\]\()([^)\s]+)(\))")
_FENCE = re.compile(r"(^```.*?^```$)", re.S | re.M)
_SUMMARY = re.compile(r"<details>\n<summary>(.*?)</summary>")
_FORMULA = re.compile(r"\$`([^`]+)`\$")
_INDENTED = re.compile(r"(?<=\n\n)(?:    .*\n|\n+(?=    ))+")
_COMMAND = re.compile(r"    ([\w./]*softrig|scripts/|ros2|eval|export|echo|colcon|docker|pip|cd|git|ROS_|SOFTRIG_)\b")
_YAML = re.compile(r"    [\w/]+:( .*)?$", re.M)
_COMMENTED = re.compile(r"^(\S.*?) {2,}(# .*)$")
WIDTH = 88  # width of code in letters that a page shows beside its sidebars
_HEADING = re.compile(r"^```.*?^```$|^(#+) ", re.S | re.M)


def collect(site: Path) -> None:
    """Write every page of the packages to its place in a folder, with the pictures that it shows."""
    for page, place in places().items():
        target = site / f"{place}{page.suffix}"
        target.parent.mkdir(parents=True, exist_ok=True)
        text = page.read_text(encoding="utf-8")
        made = notebook(text, page, place, site) if page.suffix == ".ipynb" else moved(text, page, place, site)
        if words := KEYWORDS.get(page.stem):  # the search finds a page by these words
            made = f"---\nmyst:\n  html_meta:\n    keywords: {words}\n---\n\n{made}"
        target.write_text(made, encoding="utf-8")


def notebook(text: str, page: Path, place: str, site: Path) -> str:
    """Return a notebook for its place on the site: its cells with adapted links, and the unchanged file for
    download.
    """
    content = json.loads(text)
    shutil.copyfile(page, _folder(site / "pictures") / page.name)
    student = page.with_stem(f"{page.stem}_student").name
    (site / "pictures" / student).write_text(without_solutions(text), encoding="utf-8")
    for cell in content["cells"]:
        if cell["cell_type"] == "markdown":
            cell["source"] = moved("".join(cell["source"]), page, place, site)
    files = {"The notebook as a file": page.name, "the same for students, without solutions": student}
    links = ", ".join(f"{{download}}`{words} <../pictures/{name}>`" for words, name in files.items())
    content["cells"][0]["source"] += f"\n\n{links}"
    return json.dumps(content)


def without_solutions(text: str) -> str:
    """Return a notebook as students get it: an empty cell in place of each solution.

    Raises
    ------
    ValueError
        It has no solutions, or one that does not begin with the number of its exercise.
    """
    content = json.loads(text)
    sources = ["".join(cell["source"]) for cell in content["cells"]]
    first = next((k for k, source in enumerate(sources) if source.startswith("## Solutions")), None)
    if first is None:
        raise ValueError("expected a cell that begins with '## Solutions'")
    for cell, source in zip(content["cells"][first + 1 :], sources[first + 1 :], strict=True):
        number = re.match(r"# \d+\.", source)
        if number is None:
            raise ValueError(f"a solution begins with {source[:20]!r}, expected '# 1.' and so on")
        cell |= {"source": f"{number[0]} ", "metadata": {}}
    content["cells"][first]["source"] = "## Your answers"
    return json.dumps(content, indent=1) + "\n"


def moved(text: str, page: Path, place: str, site: Path) -> str:
    """Return the text of a page for its place on the site; copies its pictures.

    Raises
    ------
    ValueError
        A link leads to what the site does not have.
    """
    here = Path(place).parent

    def link(match: re.Match[str]) -> str:
        target, hash_, anchor = match[2].partition("#")
        if not target or ":" in target:
            return match[0]
        there = (page.parent / target).resolve()
        if there in places():
            target = os.path.relpath(f"{places()[there]}{there.suffix}", here)
        elif there == ROOT / "README.md":
            target, hash_, anchor = os.path.relpath("index.md", here), "", ""
        elif there.suffix in (".png", ".svg", ".gif", ".webp") and there.is_file():
            shutil.copyfile(there, _folder(site / "pictures") / there.name)
            target = os.path.relpath(f"pictures/{there.name}", here)
        else:
            raise ValueError(f"{page}: the link {match[2]} leads to no page and no picture of the site")
        return f"{match[1]}{target}{hash_}{anchor}{match[3]}"

    parts = _FENCE.split(_COMMENT.sub("", text))
    for k in range(0, len(parts), 2):  # text in code fences is not changed
        text = _FORMULA.sub(r"{math}`\1`", _LINK.sub(link, parts[k]))
        text = _SUMMARY.sub(_unfolding, text).replace("</details>", ":::")
        parts[k] = _INDENTED.sub(_fenced, text)
    return promoted("".join(parts))


def promoted(text: str) -> str:
    """Raise headings that skip a level: generated parts do not know the level of their heading."""
    above: list[int] = []

    def heading(match: re.Match[str]) -> str:
        if not match[1]:
            return match[0]
        while len(above) > 1 and above[-1] >= len(match[1]):
            above.pop()
        if not above or above[-1] < len(match[1]):
            above.append(len(match[1]))
        return "#" * (above[0] + len(above) - 1) + " "

    return _HEADING.sub(heading, text)


def _folder(path: Path) -> Path:
    path.mkdir(parents=True, exist_ok=True)
    return path


def _fenced(match: re.Match[str]) -> str:
    """Mark commands as such, with their comments dimmed, and above them if a line would be cut; YAML as YAML."""
    block = match[0].strip("\n")
    commands = _COMMAND.match(block)
    if not (commands or _YAML.match(block)):
        return match[0]
    lines = [line[4:] for line in block.split("\n")]
    if commands and max(map(len, lines)) > WIDTH:
        lines = [_COMMENTED.sub(r"\2\n\1", line) for line in lines]
    return "\n".join(["```bash" if commands else "```yaml", *lines, "```", ""])


def _unfolding(match: re.Match[str]) -> str:
    """Return the folding parts of a page in the form of the site."""
    return ":::{dropdown} " + html.unescape(re.sub(r"</?code>", "`", match[1]))
