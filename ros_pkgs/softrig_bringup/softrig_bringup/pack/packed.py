"""A run in one file for other users: its permitted contents, and an unpacker that is safe for untrusted files."""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import stat
import struct
import time
import zipfile
import zlib
from collections.abc import Iterable, Mapping
from contextlib import suppress
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from softrig_bags.errors import BagError
from softrig_bags.files.reader import BagReader
from softrig_core import ScenarioError
from softrig_core.kit.compiled import cache_folder

from .parts import ABOUT, BAG, CRATE, METRICS, PACKAGES, SCENARIO, STUDY

MOST = 4 << 30  # bytes, unpacked
FILES = 10_000
# In bytes, unpacked. A file that unpacks to less is accepted however small it is packed.
SMALL = 64 << 20
# The largest ratio of unpacked to packed size, against zip bombs: bags of real runs have 2 to 20.
TIMES = 100
# In bytes, for an entry of the list at the end of a zip file, on average.
HEAD = 512
# In bytes. These files are read as a whole, so their size must fit in memory.
LARGEST = {ABOUT: 8 << 20, METRICS: 64 << 20}
_LONGEST = 3072  # bytes of a name with its folders; a path may have 4096
_ABANDONED = 86400.0  # s
_DAMAGED = (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, ValueError)
_NAME = re.compile(
    rf"(?:{ABOUT}|{METRICS}|{CRATE}|(?:{SCENARIO}|{PACKAGES}|{BAG}|{STUDY})(?:/[^/\\\x00-\x1f\x7f]{{1,150}}){{1,20}})"
)
_PLACE = re.compile(r"(?<![\w./])/([\w.+@-]+)/(?:[\w.+@-]+/)*")
_BAG = re.compile(rf"{BAG}/(?:metadata\.yaml|[^/]+\.(?:mcap|db3)(?:\.zstd)?)")
_END = struct.Struct("<4s4H2LH")  # end of a zip file: signature, ..., size of the list of entries, ...
Name = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]{0,99}$")]


class Digest(BaseModel):
    """Digest of a topic: the number of messages, and the first half of a SHA-256 of ticks, stamps and values."""

    model_config = ConfigDict(frozen=True)

    messages: int = Field(ge=0)
    sha256: str = Field(pattern=r"^[0-9a-f]{32}$")


class About(BaseModel):
    """The contents of ``pack.json``.

    Parameters
    ----------
    format : int
        Of the file; a different number was written by a later version of softrig.
    scenario : str
        Name of the scenario, whose file is the only one in ``scenario/``.
    packages : dict of str to str
        Packages outside softrig, and their versions. Each is in ``packages/``; if its sources were not found, it must
        be installed on the machine that runs the pack.
    offers : dict
        Entry points by package and group, from name to ``module:function``; older files have them in ``setup.cfg``.
    versions, code, contents : dict
        As in ``metrics.json``: everything that determines the numbers.
    digests : dict of str to Digest
        By topic, in a file without the bag.
    run : str
        The digest that bag, figures and scenario of a run share; see `softrig_bringup.options.identity`.
    files : dict of str to str
        SHA-256 of each file; empty in older files.
    """

    model_config = ConfigDict(frozen=True)

    format: int = Field(1, ge=1, le=1)
    scenario: str = Field(pattern=r"^[^/\\\x00-\x1f\x7f]{1,140}$")
    packages: dict[Name, str] = Field({}, max_length=100)
    offers: dict[Name, dict[str, dict[str, str]]] = {}
    versions: dict[str, str] = {}
    code: dict[str, str] = {}
    contents: dict[str, dict[str, str]] = {}
    digests: dict[str, Digest] = {}
    run: str = Field("", pattern=r"^([0-9a-f]{32})?$")
    files: dict[str, Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]] = {}


def placeless(value: Any) -> Any:
    """Return text, or all texts in a value, with paths shortened so that no folder of this machine remains.

    A text that does not begin with an existing folder stays unchanged, such as a topic or an address.
    """
    if isinstance(value, str):
        return _PLACE.sub(lambda match: "" if Path("/", match[1]).is_dir() else match[0], value)
    if isinstance(value, Mapping):
        return {placeless(k): placeless(v) for k, v in value.items()}
    return [placeless(v) for v in value] if isinstance(value, list | tuple) else value


def about(folder: Path) -> About:
    """Read the ``pack.json`` of an unpacked file.

    Raises
    ------
    ScenarioError
        It is missing or has another form.
    """
    try:
        return About.model_validate_json((folder / ABOUT).read_bytes())
    except OSError:
        raise ScenarioError(f"no {ABOUT} in it: expected a file that `softrig pack` has written") from None
    except ValidationError as error:
        first = error.errors()[0]
        location = "".join(f"{key}: " for key in [".".join(map(str, first["loc"]))[:200]] if key)
        raise ScenarioError(f"{ABOUT}: {location}{first['msg'].lower()}") from None


def digest_of(path: Path) -> str:
    """Compute the SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@cache
def opened(path: Path) -> Path:
    """Return the folder with the content of a pack, unpacked and checked; nothing of it is imported.

    The folder is in the cache, named by a digest of the file, so that node processes and later calls find it.

    Raises
    ------
    ScenarioError
        The file was not written by `softrig pack`, or must not be unpacked; nothing of it is kept.
    """
    try:
        folder = cache_folder() / "packs" / digest_of(path)[:32]
        if not folder.is_dir():
            folder.parent.mkdir(parents=True, exist_ok=True)
            _sweep(folder.parent)
            with TemporaryDirectory(dir=folder.parent, prefix=".new_") as aside:
                new = Path(aside) / "new"
                _check_content(new, unpack(path, new))
                # Another process may have unpacked the same file meanwhile; its folder has the same content.
                if not folder.is_dir():
                    new.rename(folder)
    except ScenarioError as error:
        raise ScenarioError(f"{path}: {error}") from None
    # The scenario may cite papers that only the folders of its maker have, so its own folder is searched too.
    known = os.environ.get("SOFTRIG_SCENARIOS", "").split(os.pathsep)
    if (scenarios := str(folder / SCENARIO)) not in known:
        os.environ["SOFTRIG_SCENARIOS"] = os.pathsep.join(filter(None, (*known, scenarios)))
    return folder


def _sweep(packs: Path) -> None:
    """Remove what processes that were killed have half unpacked."""
    for left in packs.glob(".new_*"):
        with suppress(OSError):
            if time.time() - left.stat().st_mtime > _ABANDONED:
                shutil.rmtree(left, ignore_errors=True)


def unpack(path: Path, folder: Path) -> dict[str, str]:
    """Unpack a file below a new folder, and nowhere else.

    Returns
    -------
    dict of str to str
        SHA-256 of each file by its place.

    Raises
    ------
    ScenarioError
        It is damaged, too large (`MOST`, `FILES`, `TIMES` its own size, half of what is free on the disk), or has
        something in it that is no plain file at one of its places.
    """
    result: dict[str, str] = {}
    try:
        _check_list(path)
        with zipfile.ZipFile(path) as archive:
            entries = archive.infolist()
            size = sum(entry.file_size for entry in entries)
            folder.mkdir()
            most = min(MOST, shutil.disk_usage(folder).free // 2)
            if len(entries) > FILES or size > most:
                raise ScenarioError(f"{len(entries)} files of {size} bytes in all, expected at most {FILES} of {most}")
            if size > max(SMALL, TIMES * path.stat().st_size):
                raise ScenarioError(f"unpacks to {size} bytes, expected at most {TIMES} times its own size")
            for entry in entries:
                # The entry is checked before it is written, for a name such as ../x would leave the folder.
                _check(entry, result)
                result[entry.filename] = _extract(archive, entry, folder / entry.filename)
    except ScenarioError:
        raise
    except (*_DAMAGED, FileExistsError, NotADirectoryError) as error:
        raise ScenarioError(f"cannot be unpacked: {error}") from None
    return result


def _check_list(path: Path) -> None:
    """Refuse a list of entries that is longer than `FILES` can need, before zipfile reads all of it."""
    with path.open("rb") as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(max(0, size - _END.size - 0xFFFF))
        tail = file.read()
    start = tail.rfind(b"PK\x05\x06")
    if start >= 0 and len(tail) - start >= _END.size and (listed := _END.unpack_from(tail, start)[5]) > FILES * HEAD:
        raise ScenarioError(f"its list of files is {listed} bytes long, expected at most {FILES * HEAD}")


def _extract(archive: zipfile.ZipFile, entry: zipfile.ZipInfo, target: Path) -> str:
    """Write one file; return its SHA-256."""
    target.parent.mkdir(parents=True, exist_ok=True)
    digest = hashlib.sha256()
    # zipfile reads what the entry declares and no more, so the sum of sizes that was checked holds.
    with archive.open(entry) as packed, target.open("xb") as file:
        while block := packed.read(1 << 20):
            digest.update(block)
            file.write(block)
    return digest.hexdigest()


def _check(entry: zipfile.ZipInfo, earlier: Iterable[str]) -> None:
    """Refuse entries that are not plain files at distinct places below the folder."""
    name, kind = entry.filename, stat.S_IFMT(entry.external_attr >> 16)
    parts = name.split("/")
    # A file system counts bytes, not letters.
    short = len(name.encode()) <= _LONGEST and max(len(part.encode()) for part in parts) <= 255
    plain = short and _NAME.fullmatch(name) and "." not in parts and ".." not in parts and kind in (0, stat.S_IFREG)
    # zipfile cuts a name at a null byte; then the name that was checked is not the one in the file.
    if not plain or name in earlier or entry.orig_filename != name:
        raise ScenarioError(
            f"{name[:100]!r}: expected plain files below {SCENARIO}, {PACKAGES}, {BAG}, {STUDY}, each once"
        )
    if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) or entry.flag_bits & 1:
        raise ScenarioError(f"{name[:100]!r}: expected it stored or deflated, and not encrypted")
    if parts[0] == BAG and not _BAG.fullmatch(name):
        raise ScenarioError(f"{name[:100]!r}: expected metadata.yaml and files of messages in {BAG}")
    if entry.file_size > LARGEST.get(name, MOST):
        raise ScenarioError(f"{name}: {entry.file_size} bytes, expected at most {LARGEST[name]}")


def _check_content(folder: Path, files: dict[str, str]) -> None:
    """Refuse an unpacked file whose files, packages, scenario or bag do not match its description."""
    stated = about(folder)
    if stated.files and stated.files != (have := {k: v for k, v in files.items() if k != ABOUT}):
        wrong = sorted(k for k in {*stated.files, *have} if stated.files.get(k) != have.get(k))
        raise ScenarioError(f"{wrong[0]!r} is not the file that {ABOUT} lists; expected the files as they were packed")
    if f"{SCENARIO}/{stated.scenario}.yaml" not in files:
        raise ScenarioError(f"no {SCENARIO}/{stated.scenario}.yaml in it, the scenario that {ABOUT} names")
    for name in sorted({path.split("/")[1] for path in files if path.startswith(f"{PACKAGES}/")}):
        if name not in stated.packages:
            raise ScenarioError(f"{PACKAGES}/{name[:100]}: {ABOUT} names no such package; expected the ones it names")
    if any(path.startswith(f"{BAG}/") for path in files):
        try:
            with BagReader(folder / BAG):
                pass
        except BagError as error:
            raise ScenarioError(str(error).replace(f"{folder}/", "")) from None


def need_packages(source: object, packages: Iterable[str]) -> None:
    """Name the packages that a run needs and that are not here.

    Raises
    ------
    ScenarioError
        A package is missing, or blocks were typed at a prompt and belong to no package.
    """
    names = list(packages)
    typed = [name for name in names if not name.isidentifier()]
    if typed:
        raise ScenarioError(
            f"{source}: {', '.join(typed)} was defined interactively: only blocks of a package can be repeated"
        )
    missing = [name for name in names if find_spec(name) is None]
    if missing:
        noun = "package" if len(missing) == 1 else "packages"
        raise ScenarioError(
            f"{source}: it needs {noun} {', '.join(missing)}, not installed here; `softrig pack RUN`, "
            "where they are, puts the run and them into one file"
        )
