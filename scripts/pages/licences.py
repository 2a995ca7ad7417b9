"""Licences of installed software: of distributions by their metadata, of the content of CasADi's wheel by its texts."""

from __future__ import annotations

import importlib.metadata
import re
import sys
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

LOCKS = Path(__file__).resolve().parents[1] / "locks"
# Licences by a pattern that only their text has; the first match counts.
TEXTS = (
    ("EPL-2.0", r"Eclipse Public License.{0,12}2\.0"),
    ("EPL-1.0", "Eclipse Public License"),
    ("CeCILL-C", "CeCILL-C"),
    ("AGPL", "AFFERO GENERAL PUBLIC"),
    ("LGPL", "LESSER GENERAL PUBLIC"),
    ("GPL", "GENERAL PUBLIC LICENSE"),
    ("MPL-2.0", "Mozilla Public License"),
    ("Apache-2.0", r"Apache License.{0,40}2\.0"),
    ("BSL-1.0", "Boost Software License"),
    ("BSD", r"Redistributions? (and use )?(of source code|in source)"),
    ("MIT", "Permission is hereby granted, free of charge"),
    ("Zlib", "misrepresent|provided .as-is., without"),
)


USUAL = {  # words in metadata without an SPDX expression
    "OSI Approved": "",
    "BSD License": "BSD",
    "MIT License": "MIT",
    "Apache Software License": "Apache-2.0",
    "Apache License 2.0": "Apache-2.0",
    "Apache License, Version 2.0": "Apache-2.0",
    "Apache 2.0": "Apache-2.0",
    "Python Software Foundation License": "PSF-2.0",
    "zlib License": "Zlib",
    "GNU Lesser General Public License v3 or later (LGPLv3+)": "LGPL-3.0-or-later",
}


def names(lock: str) -> list[str]:
    """Distributions that a lock file pins."""
    return re.findall(r"^([\w.-]+)==", (LOCKS / f"{lock}.lock").read_text(), re.MULTILINE)


def licence(name: str) -> str:
    """Return the licence of a distribution as its metadata states it; '' if it is not installed."""
    try:
        result = importlib.metadata.distribution(name)
    except importlib.metadata.PackageNotFoundError:
        return ""
    about: Any = result.metadata  # an email.message.Message
    if expression := about.get("License-Expression"):
        return str(expression)
    plain = (about.get("License") or "").strip()
    kinds = [plain] if plain and "\n" not in plain and len(plain) < 60 else []
    kinds += [c.rpartition(" :: ")[2] for c in about.get_all("Classifier", []) if c.startswith("License ::")]
    package = Path(sys.prefix, "share", name.removeprefix("ros-").replace("-", "_"), "package.xml")
    if name.startswith("ros-") and package.is_file():
        kinds += [node.text or "" for node in ElementTree.parse(package).getroot().findall("license")]
    text = ", ".join(dict.fromkeys(filter(None, (USUAL.get(kind, kind) for kind in kinds))))
    own = [file for file in result.files or () if file.parts[0].endswith("dist-info") and "LICEN" in file.name.upper()]
    return text or _by_text(Path(str(file.locate())) for file in own)


def _by_text(files: Iterable[Path]) -> str:
    results = []
    for path in files:
        text = " ".join(path.read_text(errors="replace").split()) if path.is_file() else ""
        results += [kind for kind, words in TEXTS if re.search(words, text, re.IGNORECASE)][:1]
    return ", ".join(dict.fromkeys(results)) or "not said"


def table(locks: Iterable[str]) -> str:
    """Return rows of licence and packages, Markdown, for packages that the lock files pin and that are
    installed here.
    """
    result = defaultdict(set)
    for name in {name for lock in locks for name in names(lock)}:
        if text := licence(name):
            result[text].add(name)
    rows = [f"| {kind} | {', '.join(sorted(result[kind]))} |" for kind in sorted(result, key=str.lower)]
    return "\n".join(["| licence, as it says of itself | packages |", "|---|---|", *rows])


def inside_casadi() -> str:
    """Return rows of licence and libraries inside CasADi's wheel, by the licence texts in it, Markdown."""
    spec = importlib.metadata.distribution("casadi")
    folder = Path(str(spec.locate_file("casadi/include/licenses")))
    result = defaultdict(set)
    for library in sorted(folder.iterdir()):
        result[_by_text(sorted(p for p in library.rglob("*") if p.is_file()))].add(
            library.name.partition("-external")[0]
        )
    rows = [f"| {kind} | {', '.join(sorted(result[kind]))} |" for kind in sorted(result, key=str.lower)]
    return "\n".join(["| licence, by the text in the wheel | libraries |", "|---|---|", *rows])


def licences(what: str) -> str:
    """Return a part of the page: ``casadi``, or names of lock files."""
    return inside_casadi() if what == "casadi" else table(what.split())
