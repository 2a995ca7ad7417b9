"""Metadata of a pack for archives: RO-Crate 1.1, as JSON-LD that Zenodo, WorkflowHub and others read."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from .parts import CRATE
from .publication import Publication

_KINDS = {
    ".yaml": "application/yaml",
    ".json": "application/json",
    ".jsonl": "application/jsonl",
    ".mcap": "application/mcap",
    ".py": "text/x-python",
    ".bib": "application/x-bibtex",
    ".csv": "text/csv",
}


def crate(
    name: str,
    about: str,
    versions: Mapping[str, str],
    files: Mapping[str, bytes | Path],
    sums: Mapping[str, str],
    publication: Publication,
) -> bytes:
    """Write the metadata of a pack.

    Parameters
    ----------
    name, about : str
        Name of the pack, and a description of its contents.
    versions : mapping
        Versions of softrig's packages in the run.
    files : mapping of str to bytes or Path
        By place.
    sums : mapping of str to str
        SHA-256 by place.
    publication : Publication
        Authors, publisher, date and licence.
    """
    entries: list[dict[str, Any]] = [
        {
            "@id": path,
            "@type": "File",
            "name": path.rpartition("/")[2],
            "contentSize": str(len(content) if isinstance(content, bytes) else content.stat().st_size),
            "encodingFormat": _KINDS.get(Path(path).suffix, "application/octet-stream"),
            "sha256": sums[path],
        }
        for path, content in files.items()
    ]
    allowed = publication.license or {
        "@id": "#license",
        "@type": "CreativeWork",
        "name": "not stated",
        "description": "ask the author of this file",
    }
    authors = list({author["@id"]: author for author in publication.authors}.values())  # each entity once
    people = [*authors, *([publication.publisher] if publication.publisher else [])]
    root: dict[str, Any] = {
        "@id": "./",
        "@type": "Dataset",
        "name": name,
        "description": about,
        "datePublished": publication.day,
        "license": {"@id": allowed["@id"]},
        "hasPart": [{"@id": entry["@id"]} for entry in entries],
        "mentions": {"@id": "#made"},
    }
    if authors:
        root["author"] = _one_or_all([{"@id": author["@id"]} for author in authors])
    if publication.publisher:
        root["publisher"] = {"@id": publication.publisher["@id"]}
    tool = {
        "@id": "#softrig",
        "@type": "SoftwareApplication",
        "name": "softrig",
        "version": versions.get("softrig_core", ""),
        "description": "Software test rigs for drives, power converters and robots as ROS 2 nodes",
    }
    made_of = [{"@id": entry["@id"]} for entry in entries if entry["@id"].startswith("scenario/")]
    action = {
        "@id": "#made",
        "@type": "CreateAction",
        "name": f"simulation of {name}",
        "instrument": {"@id": "#softrig"},
        "result": {"@id": "./"},
        "object": _one_or_all(made_of),
    }
    head = {
        "@id": CRATE,
        "@type": "CreativeWork",
        "about": {"@id": "./"},
        "conformsTo": {"@id": "https://w3id.org/ro/crate/1.1"},
    }
    graph = [head, root, tool, action, allowed, *people, *entries]
    return json.dumps({"@context": "https://w3id.org/ro/crate/1.1/context", "@graph": graph}, indent=1).encode() + b"\n"


def _one_or_all(entities: list[Any]) -> Any:
    """Return a list of one as its entry, as flattened JSON-LD requires."""
    return entities[0] if len(entities) == 1 else entities
