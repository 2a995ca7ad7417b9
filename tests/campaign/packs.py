"""Packs of another person with something wrong: refused in one line, nothing written elsewhere, nothing imported."""

import io
import json
import os
import random
import sys
import zipfile
from pathlib import Path

from softrig_bringup.pack import cargo, packed, parts
from softrig_bringup.verbs.new import new_package
from softrig_core import ScenarioError

NAME = "stranger_rig"
NAMES = ("../x", "/tmp/x", "scenario/../../x", "bag/x", "scenario/a\\b", "packages/yaml/yaml/__init__.py", "pack.json",
         "packages/softrig_core/softrig_core/__init__.py", "scenario/\u202ea", "bag/a.mcap", "metrics.json",
         f"packages/{NAME}/{NAME}/x.pyc", f"packages/{NAME}/{NAME}/x.so", "scenario/" + "d/" * 25 + "x")  # fmt: skip
WORDS = ("../..", "os:system", "softrig_core", "/etc/passwd", "yaml", "\x00", "[", "%(x)s", "é", "share/x = y",
         "${HOME}")  # fmt: skip


def attack(seed: int, directory: Path) -> None:
    """Make a pack, change one to three parts, and open it as `run --like` does before the confirmation."""
    chance = random.Random(seed)
    packed.cache_folder = lambda: directory / "cache"
    file = directory / "x.softrig.zip"
    file.write_bytes(damaged(made(directory), chance))
    (directory / "case").write_text(f"seed {seed}")
    before = {p for p in directory.rglob("*") if "cache" not in p.parts}
    path, known = list(sys.path), set(sys.modules)
    try:
        folder = packed.opened(file) if parts.is_pack(file) else None
        listed = list(cargo.cargo_of(folder, packed.about(folder))) if folder else []
    except ScenarioError as error:
        listed = str(error).splitlines()[1:]  # the message of a refusal is its first line
    left = list((directory / "cache").rglob(".new_*"))
    assert not left, f"left in the cache: {left[:3]}"
    assert all(line.isascii() and line.startswith(("package ", "FMU ", "node ")) for line in listed), listed
    assert {p for p in directory.rglob("*") if "cache" not in p.parts} == before, "it wrote elsewhere"
    assert sys.path == path
    assert not [m for m in set(sys.modules) - known if m.partition(".")[0] in (NAME, "setup")], "it was imported"
    assert NAME not in os.environ.get("AMENT_PREFIX_PATH", "")


def made(directory: Path) -> dict[str, bytes]:
    """Return a valid pack by place."""
    folder = new_package(NAME, directory)
    files = {f"packages/{NAME}/{f.relative_to(folder)}": f.read_bytes() for f in folder.rglob("*") if f.is_file()}
    about = {"format": 1, "scenario": NAME, "packages": {NAME: "0.0.1"}}
    return {"pack.json": json.dumps(about).encode(), f"scenario/{NAME}.yaml":
            (folder / f"scenarios/{NAME}.yaml").read_bytes(), **files}  # fmt: skip


def damaged(files: dict[str, bytes], chance: random.Random) -> bytes:
    """Return the bytes of the file with something changed."""
    for _ in range(chance.randint(1, 3)):
        place = chance.choice(sorted(files))
        match chance.randrange(5):
            case 0:
                files[chance.choice(NAMES)] = chance.randbytes(chance.randrange(2000))
            case 1:
                del files[place]
            case 2:
                lines = files[place].decode(errors="replace").split("\n")
                k = chance.randrange(len(lines))
                lines[k] = lines[k].replace(lines[k].split(" ")[-1] or "x", chance.choice(WORDS))
                files[place] = "\n".join(lines).encode()
            case 3:
                data = bytearray(files[place] or b"x")
                data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
                files[place] = bytes(data)
            case _:
                files[place] = bytes(chance.choice((0, 1, 1 << 20)))
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", chance.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))) as archive:
        for name, data in files.items():
            entry = zipfile.ZipInfo(name)
            kind = (
                chance.choice((0o100644, 0o100644, 0o100644, 0o120777, 0o010644)) if chance.random() < 0.1 else 0o100644
            )
            entry.external_attr = kind << 16
            archive.writestr(entry, data)
    data = bytearray(content.getvalue())
    for _ in range(chance.choice((0, 0, 0, 1, 4))):
        data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
    return bytes(data[: chance.randrange(len(data))] if chance.random() < 0.05 else data)
