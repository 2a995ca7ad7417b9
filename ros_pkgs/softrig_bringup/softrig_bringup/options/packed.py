"""A run in one file, as somebody else gets it: what may be in it, and unpacking that a stranger's file cannot harm."""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import stat
import subprocess
import sys
import zipfile
import zlib
from collections.abc import Iterable
from functools import cache
from importlib import invalidate_caches
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from softrig_core import ScenarioError
from softrig_core.guard import say
from softrig_core.kit.compiled import cache_folder

SUFFIX = ".softrig.zip"
ABOUT, METRICS, SCENARIO, PACKAGES, BAG = "pack.json", "metrics.json", "scenario", "packages", "bag"
MOST = 4 << 30  # bytes, unpacked
FILES = 10_000
_DAMAGED = (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, ValueError)
_NAME = re.compile(rf"(?:{ABOUT}|{METRICS}|(?:{SCENARIO}|{PACKAGES}|{BAG})(?:/[^/\\\x00-\x1f\x7f]{{1,150}}){{1,20}})")


class Digest(BaseModel):
    """What a node said on a topic: how many messages, and the first half of a SHA-256 of ticks, stamps and values."""

    model_config = ConfigDict(frozen=True)

    messages: int = Field(ge=0)
    sha256: str = Field(pattern=r"^[0-9a-f]{32}$")


class About(BaseModel):
    """What ``pack.json`` says.

    Parameters
    ----------
    format : int
        Of the file; another one is of a later version of softrig.
    scenario : str
        Name of the scenario, whose file stands alone in ``scenario/``.
    packages : dict of str to str
        Packages that are no part of softrig, and their versions: each is in ``packages/``, or its sources were not
        found and who runs it has to have it.
    versions, code, contents : dict
        As ``metrics.json`` has them: what decided the numbers.
    digests : dict of str to Digest
        By topic, of a file without the bag.
    """

    model_config = ConfigDict(frozen=True)

    format: int = Field(1, ge=1, le=1)
    scenario: str = Field(pattern=r"^[^/\\\x00-\x1f\x7f]{1,140}$")
    packages: dict[Annotated[str, Field(pattern=r"^[A-Za-z]\w*$")], str] = {}
    versions: dict[str, str] = {}
    code: dict[str, str] = {}
    contents: dict[str, dict[str, str]] = {}
    digests: dict[str, Digest] = {}


def is_pack(path: Path) -> bool:
    """Whether a path is a file that `softrig pack` may have written."""
    return path.is_file() and zipfile.is_zipfile(path)


def about(folder: Path) -> About:
    """Read what an unpacked file says of itself.

    Raises
    ------
    ScenarioError
        It does not say it, or not in this form.
    """
    try:
        return About.model_validate_json((folder / ABOUT).read_bytes())
    except OSError:
        raise ScenarioError(f"no {ABOUT} in it: expected a file that `softrig pack` has written") from None
    except ValidationError as error:
        first = error.errors()[0]
        raise ScenarioError(f"{ABOUT}: {'.'.join(map(str, first['loc']))}: {first['msg'].lower()}") from None


@cache
def opened(path: Path) -> Path:
    """Give the folder of what a pack holds, once it is unpacked and the packages that it brings can be imported.

    It lies in the cache by what the file holds, so that node processes and later calls find it.

    Raises
    ------
    ScenarioError
        Not a file that `softrig pack` has written, or nothing that may be unpacked.
    """
    try:
        with path.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
        folder = cache_folder() / "packs" / digest[:32]
        if not folder.is_dir():
            folder.parent.mkdir(parents=True, exist_ok=True)
            with TemporaryDirectory(dir=folder.parent, prefix=".new_") as aside:
                new = Path(aside) / "new"
                unpack(path, new)
                about(new)
                if not folder.is_dir():
                    new.rename(folder)
        _bring(path, folder)
    except ScenarioError as error:
        raise ScenarioError(f"{path}: {error}") from None
    return folder


def unpack(path: Path, folder: Path) -> None:
    """Unpack a file below a new folder, and nowhere else.

    Raises
    ------
    ScenarioError
        It is damaged, too large (`MOST`, `FILES`, half of what is free on the disk), or has something in it that is no
        plain file at one of its places.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            entries = archive.infolist()
            size = sum(entry.file_size for entry in entries)
            folder.mkdir()
            most = min(MOST, shutil.disk_usage(folder).free // 2)
            if len(entries) > FILES or size > most:
                raise ScenarioError(f"{len(entries)} files of {size} bytes in all, expected at most {FILES} of {most}")
            seen: set[str] = set()
            for entry in entries:
                _check(entry, seen)
                place = folder / entry.filename
                place.parent.mkdir(parents=True, exist_ok=True)
                with archive.open(entry) as packed, place.open("xb") as file:  # gives what the entry declares, no more
                    shutil.copyfileobj(packed, file, 1 << 20)
    except ScenarioError:
        raise
    except (*_DAMAGED, FileExistsError, NotADirectoryError) as error:
        raise ScenarioError(f"cannot be unpacked: {error}") from None


def _check(entry: zipfile.ZipInfo, seen: set[str]) -> None:
    """Refuse what is not a plain file at a place of its own below the folder."""
    name, kind = entry.filename, stat.S_IFMT(entry.external_attr >> 16)
    parts = name.split("/")
    plain = _NAME.fullmatch(name) and "." not in parts and ".." not in parts and kind in (0, stat.S_IFREG)
    if not plain or name in seen or entry.orig_filename != name:
        raise ScenarioError(f"{name[:100]!r}: expected plain files below {SCENARIO}, {PACKAGES} and {BAG}, each once")
    if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) or entry.flag_bits & 1:
        raise ScenarioError(f"{name[:100]!r}: expected it stored or deflated, and not encrypted")
    seen.add(name)


def _bring(path: Path, folder: Path) -> None:
    """Make the packages that a file brings importable, here and in every process that is started from here."""
    brought = sorted(p.parent.name for p in (folder / PACKAGES).glob("*/package.xml"))
    if brought:
        layout = Path(os.environ.get("SOFTRIG_COMMAND") or "/").with_name("layout.py")
        if layout.is_file():
            prefix = cache_folder() / "packs" / f"{folder.name}-py{sys.version_info[0]}.{sys.version_info[1]}"
            made = subprocess.run([sys.executable, layout, prefix, folder / PACKAGES], capture_output=True, text=True)
            if made.returncode:
                raise ScenarioError(f"{PACKAGES}: {' '.join(made.stderr.splitlines()[-1:])}")
            library = next(prefix.glob("lib/python*/site-packages"))
            for name, place in (("AMENT_PREFIX_PATH", prefix), ("PYTHONPATH", library)):
                os.environ[name] = os.pathsep.join(filter(None, (str(place), os.environ.get(name))))
            sys.path.insert(0, str(library))
            invalidate_caches()
            say(f"{path} brings {', '.join(brought)}: code of who has made it runs here")
        elif absent := [name for name in brought if find_spec(name) is None]:
            folders = " ".join(str(folder / PACKAGES / name) for name in absent)
            raise ScenarioError(f"it brings {', '.join(absent)}, not installed here: pip install {folders}")
    # papers that only its maker's folders of scenarios have
    places = filter(None, (os.environ.get("SOFTRIG_SCENARIOS"), str(folder / SCENARIO)))
    os.environ["SOFTRIG_SCENARIOS"] = os.pathsep.join(places)


def need_packages(where: object, packages: Iterable[str]) -> None:
    """Name the packages that a run needs and that are not here.

    Raises
    ------
    ScenarioError
        One is missing, or its blocks were typed at a prompt and belong to none.
    """
    names = list(packages)
    typed = [name for name in names if not name.isidentifier()]
    if typed:
        raise ScenarioError(f"{where}: {', '.join(typed)} was typed, not imported: only a package can be repeated")
    missing = [name for name in names if find_spec(name) is None]
    if missing:
        what = "package" if len(missing) == 1 else "packages"
        raise ScenarioError(
            f"{where}: it needs {what} {', '.join(missing)}, not installed here; `softrig pack RUN`, "
            "where they are, puts the run and them into one file"
        )
