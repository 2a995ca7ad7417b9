"""The papers behind a scenario: entries of ``references.bib`` in the folders of scenarios, by their keys."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from xml.etree.ElementTree import Element

from softrig_core import ScenarioError
from softrig_core.data import Data
from softrig_core.errors import closest
from softrig_core.scenario.scenario_file import scenario_folders

from .html import e

FILE = "references.bib"


@dataclass(frozen=True, kw_only=True)
class Citation(Data):
    """A paper or book.

    Parameters
    ----------
    authors : tuple of str
        As they are printed: ``A. Çakan``.
    place : str
        Journal with volume, number and pages, or the publisher.
    doi : str
        Empty when none is known.
    bibtex : str
        Its entry, to be copied.
    """

    key: str
    authors: tuple[str, ...]
    title: str
    year: str
    place: str = ""
    doi: str = ""
    bibtex: str


def cited(keys: Sequence[str]) -> tuple[Citation, ...]:
    """Find the papers of a scenario's key ``cites``.

    Raises
    ------
    ScenarioError
        No file has such an entry, or the entry cannot be read; names the key and the file.
    """
    if not keys:
        return ()
    known: dict[str, Citation] = {}
    for folder in reversed(list(scenario_folders())):  # the first folder has priority
        if (path := folder / FILE).is_file():
            known |= _entries(path, path.stat().st_mtime_ns)
    wrong = next((key for key in keys if key not in known), None)
    if wrong is not None:
        raise ScenarioError(f"cites: no entry {wrong!r} in any {FILE} beside scenarios{closest(wrong, known)}")
    return tuple(known[key] for key in keys)


@lru_cache(maxsize=16)
def _entries(path: Path, written: int) -> dict[str, Citation]:
    """Read the entries of a file; a changed `written` time makes it read the file again."""
    from bibtexparser import entrypoint, middlewares

    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise ScenarioError(f"{path}: no text in UTF-8: {error.reason} at byte {error.start}") from None
    library = entrypoint.parse_string(
        text,
        append_middleware=[middlewares.SeparateCoAuthors(), middlewares.SplitNameParts()],
    )
    for block in library.failed_blocks:
        raise ScenarioError(f"{path}: line {(block.start_line or 0) + 1}: {str(block.error).split(' Note:')[0]}")
    result = {}
    for entry in library.entries:
        fields = {name: field.value for name, field in entry.fields_dict.items()}
        missing = [name for name in ("author", "title", "year") if name not in fields]
        if missing:
            raise ScenarioError(f"{path}: {entry.key}: no {', '.join(missing)}")
        authors = tuple(_name(n.first, [*n.von, *n.last, *n.jr]) for n in fields["author"])
        result[entry.key] = Citation(
            key=entry.key,
            authors=authors,
            title=_plain(fields["title"]),
            year=fields["year"],
            place=_publication({k: v for k, v in fields.items() if isinstance(v, str)}),
            doi=fields.get("doi", ""),
            bibtex=(entry.raw or "").strip(),
        )
    return result


def _name(first: Sequence[str], last: Sequence[str]) -> str:
    """Print a name with initials."""
    return " ".join([*(f"{name[0]}." for name in first), *last])


def _plain(text: str) -> str:
    return text.replace("{", "").replace("}", "").replace("--", "–").replace("\\&", "&")


def _publication(fields: dict[str, str]) -> str:
    """Return where a paper appeared: journal 2(6), 582–587, or the publisher."""
    volume = fields.get("volume", "") + (f"({fields['number']})" if "number" in fields else "")
    container = fields.get("journal", fields.get("booktitle", fields.get("publisher", "")))
    return _plain(", ".join(filter(None, (" ".join(filter(None, (container, volume))), fields.get("pages", "")))))


def sources(citations: Sequence[Citation]) -> Iterator[Element]:
    """Print papers for a page: each with its DOI, and its BibTeX entry to copy."""
    for c in citations:
        doi = e("a", f"doi:{c.doi}", href=f"https://doi.org/{c.doi}") if c.doi else "No DOI known"
        place = ", ".join(filter(None, (c.place, c.year)))
        yield e("p", f"{', '.join(c.authors)}: ", e("cite", c.title), f". {place}. ", doi, ".")
        yield e("details", e("summary", "BibTeX"), e("pre", c.bibtex))


def listed(citations: Sequence[Citation]) -> list[str]:
    """Print papers as the items of a Markdown list."""
    result = []
    for c in citations:
        doi = f"[doi:{c.doi}](https://doi.org/{c.doi})" if c.doi else "No DOI known"
        result.append(f"- {', '.join(c.authors)}: *{c.title}*. {', '.join(filter(None, (c.place, c.year)))}. {doi}.")
    return result
