"""Names of what a pack holds, and whether a file is one; for code that reads no pack."""

from __future__ import annotations

from pathlib import Path

SUFFIX = ".softrig.zip"
ABOUT, METRICS, CRATE = "pack.json", "metrics.json", "ro-crate-metadata.json"
SCENARIO, PACKAGES, BAG, STUDY = "scenario", "packages", "bag", "study"


def is_pack(path: Path) -> bool:
    """Return whether a path is a file that `softrig pack` may have written."""
    # Imported only for a file, because it takes 5 ms and most runs are folders.
    from zipfile import is_zipfile

    return path.is_file() and is_zipfile(path)
