"""Files that a run or a recorder has left in a folder: storage files, the files beside them, and shards."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from ..errors import BagError
from .compressed import SUFFIXES, plain
from .metadata import Metadata, read_metadata
from .source import Damaged
from .sqlite_recover import JOURNALS, journals

METADATA = "metadata.yaml"
# The second suffix marks the record of a node that has died, until the node has started again.
SHARD, DIED = ".shard", ".shard.died"


@dataclass
class Remains:
    """Readable files in one place.

    Attributes
    ----------
    place : Path
        The bag's folder, the file, or the folder of shards.
    files : list of Path
        Storage files in their order, of .mcap and .db3, compressed or not.
    shards : list of Path
        Records of nodes; only if there are no storage files.
    claimed : Metadata
        The contents of metadata.yaml.
    """

    place: Path
    files: list[Path] = field(default_factory=list)
    shards: list[Path] = field(default_factory=list)
    claimed: Metadata = field(default_factory=Metadata)

    @property
    def absent(self) -> list[str]:
        """Names of files that metadata.yaml lists and that are not there."""
        names = {plain(file).name for file in self.files}
        return [name for name in self.claimed.files if plain(Path(name)).name not in names]

    @property
    def pending(self) -> bool:
        """Return whether a journal exists beside a file: a reader of the file alone would miss committed rows."""
        return any(journals(file) for file in self.files if file.suffix == ".db3")


def remains(path: Path) -> Remains:
    """Find the storage files or shards that a path refers to.

    Parameters
    ----------
    path : Path
        Bag directory, a storage file or the journal beside it, a folder of shards, or the folder of a run: then its
        bag, else the shards in its ``log``, else the bag that was being written.

    Raises
    ------
    BagError
        There is nothing of a bag or a run.
    """
    if path.is_file():
        for suffix in (*JOURNALS, "-shm"):
            if path.name.endswith(f".db3{suffix}"):
                path = path.with_name(path.name.removesuffix(suffix))
        if plain(path).suffix in SUFFIXES and path.is_file():
            return Remains(path, [path])
    elif path.is_dir():
        for folder in (path, path / "bag", path / "log", *sorted(path.glob(".*.part"))):
            if folder.is_dir() and (result := _in_folder(folder)) is not None:
                return result
    raise BagError(f"{path}: no .mcap, .db3 or .shard file there")


def _in_folder(path: Path) -> Remains | None:
    """Look into one folder.

    If rosbag2 was killed while it compressed a file, both files exist, and only the uncompressed one is complete.
    """
    patterns = [f"*{suffix}{packed}" for packed in (".zstd", "") for suffix in SUFFIXES]
    results = {plain(p): p for pattern in patterns for p in path.glob(pattern) if p.is_file()}
    shards = {p.name.removesuffix(SHARD): p for p in path.glob(f"*{SHARD}")}
    # A node that starts again writes its record from the beginning, so the longer one of both has more messages.
    for died in path.glob(f"*{DIED}"):
        name = died.name.removesuffix(DIED)
        if name not in shards or shards[name].stat().st_size < died.stat().st_size:
            shards[name] = died
    if results and shards:
        raise BagError(
            f"{path} has shards of a run ({sorted(shards.values())[0].name}) and files of a bag "
            f"({sorted(results.values())[0].name}): expected one of the two; move one of them away"
        )
    if not results and not shards:
        return None
    files = [results[p] for p in sorted(results, key=lambda p: (len(p.name), p.name))]
    claimed = stated(path) if files else Metadata()
    return Remains(path, files, [shards[name] for name in sorted(shards)], claimed)


def stated(path: Path) -> Metadata:
    """Return the content of metadata.yaml; empty if it is absent or damaged."""
    try:
        return read_metadata(path / METADATA)
    except (OSError, Damaged):
        return Metadata()
