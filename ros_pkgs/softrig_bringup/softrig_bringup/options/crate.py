"""What a pack says of itself to archives: RO-Crate 1.1, JSON-LD that Zenodo, WorkflowHub and others read."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from .packed import CRATE

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
    published: str,
) -> bytes:
    """Write the metadata of a pack.

    Parameters
    ----------
    name, about : str
        Of the whole, and what is in it.
    versions : mapping
        Of softrig's packages, as the run has them.
    files : mapping of str to bytes or Path
        By place.
    sums : mapping of str to str
        SHA-256 by place.
    published : str
        The day, as ISO 8601 has it.
    """
    parts: list[dict[str, Any]] = [
        {
            "@id": place,
            "@type": "File",
            "name": place.rpartition("/")[2],
            "contentSize": str(len(content) if isinstance(content, bytes) else content.stat().st_size),
            "encodingFormat": _KINDS.get(Path(place).suffix, "application/octet-stream"),
            "sha256": sums[place],
        }
        for place, content in files.items()
    ]
    root = {
        "@id": "./",
        "@type": "Dataset",
        "name": name,
        "description": about,
        "datePublished": published,
        "license": {"@id": "#license"},
        "hasPart": [{"@id": part["@id"]} for part in parts],
        "mentions": {"@id": "#made"},
    }
    tool = {
        "@id": "#softrig",
        "@type": "SoftwareApplication",
        "name": "softrig",
        "version": versions.get("softrig_core", ""),
        "description": "Software test rigs for drives, power converters and robots as ROS 2 nodes",
    }
    made_of = [{"@id": part["@id"]} for part in parts if part["@id"].startswith("scenario/")]
    made = {
        "@id": "#made",
        "@type": "CreateAction",
        "name": f"simulation of {name}",
        "instrument": {"@id": "#softrig"},
        "result": {"@id": "./"},
        "object": made_of[0] if len(made_of) == 1 else made_of,
    }
    allowed = {
        "@id": "#license",
        "@type": "CreativeWork",
        "name": "not stated",
        "description": "ask the person who gave you this file",
    }
    head = {
        "@id": CRATE,
        "@type": "CreativeWork",
        "about": {"@id": "./"},
        "conformsTo": {"@id": "https://w3id.org/ro/crate/1.1"},
    }
    graph = [head, root, tool, made, allowed, *parts]
    return json.dumps({"@context": "https://w3id.org/ro/crate/1.1/context", "@graph": graph}, indent=1).encode() + b"\n"
