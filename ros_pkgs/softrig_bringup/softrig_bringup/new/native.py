"""A folder to begin with: a law in C, C++, Fortran or Rust, its scenario, its build and a test of its own."""

from __future__ import annotations

import os
import shlex
from importlib.resources import files
from pathlib import Path
from shutil import rmtree
from string import Template
from typing import NamedTuple

from softrig_core.guard import naming


class Language(NamedTuple):
    """Template of a controller in a language: its files, the build command, and the path its scenario uses."""

    title: str
    source: str
    files: dict[str, str]
    built: str
    steps: str


_CMAKE = {"CMakeLists.txt": "CMakeLists.txt", "law_test.c": "test_$name.c"}
_OWN = """softrig compiles the source itself. Your build and your test, without softrig:

    cmake -B build && cmake --build build && ctest --test-dir build

A library that you have built is used by `library: build/lib$name.so` in place of `sources`."""
LANGUAGES = {
    "c": Language("C", "$name.c", _CMAKE | {"law.c": "$name.c"}, "sources: [$name.c]", _OWN),
    "c++": Language("C++", "$name.cpp", _CMAKE | {"law.cpp": "$name.cpp"}, "sources: [$name.cpp]", _OWN),
    "fortran": Language("Fortran", "$name.f90", _CMAKE | {"law.f90": "$name.f90"}, "sources: [$name.f90]", _OWN),
    "rust": Language(
        "Rust",
        "src/lib.rs",
        {"Cargo.toml": "Cargo.toml", "lib.rs": "src/lib.rs"},
        "library: target/release/lib$name.so",
        "Build it before the first run, and after each change:\n\n    cargo test && cargo build --release",
    ),
}
EVERY = {"law.h": "$name.h", "scenario.yaml": "$name.yaml", "README.md": "README.md"}


def new_native(name: str, folder: Path, language: str, command: str) -> Path:
    """Write a law in another language than Python.

    Parameters
    ----------
    name : str
        Of the law, checked.
    folder : Path
        Folder that is created with the files.
    language : str
        One of `LANGUAGES`.
    command : str
        Command with which a user starts softrig.

    Returns
    -------
    Path
        Its scenario.
    """
    spec = LANGUAGES[language]
    values = {"name": name, "NAME": name.upper(), "language": spec.title, "softrig": command}
    values |= {"also": {"c++": " CXX", "fortran": " Fortran"}.get(language, "")}
    values |= {key: Template(text).substitute(values) for key, text in spec._asdict().items() if isinstance(text, str)}
    source = files("softrig_bringup") / "template" / "native"
    try:
        for file, pattern in (EVERY | spec.files).items():
            target = folder / Template(pattern).substitute(values)
            target.parent.mkdir(parents=True, exist_ok=True)
            text = Template((source / f"{file}.template").read_text(encoding="utf-8")).substitute(values)
            with naming(target):
                target.write_text(text, encoding="utf-8")
    except OSError:
        rmtree(folder, ignore_errors=True)  # the folder did not exist before
        raise
    return folder / f"{name}.yaml"


def next_steps(scenario: Path, language: str, command: str) -> str:
    """Describe the written files, and the next steps."""
    folder = shlex.quote(os.path.relpath(scenario.parent))
    build = f"  cargo build --release --manifest-path {folder}/Cargo.toml\n" if language == "rust" else ""
    title = LANGUAGES[language].title
    return (
        f"wrote {folder}: a control law in {title}, a scenario, a build, a test, README.md; now:\n"
        f"{build}  {command} run {folder}/{scenario.name} --mode inprocess"
    )
