"""Where the files of the packages in ros_pkgs go below an install prefix.

`colcon build --symlink-install` needs 10 s for nine packages of pure Python; this, from the same setup.cfg files, a
tenth of a second (a test holds one against the other). `python layout.py PREFIX` makes links, `python layout.py PREFIX
DIR` those of the packages in DIR; the wheel is made of the same lists.
"""

import os
import shlex
import shutil
import sys
from collections.abc import Iterator, Sequence
from configparser import ConfigParser
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
Tree = dict[str, Path | str]  # by path below the prefix: the file to link or copy, or the text of a new file

OURS = ("ros_pkgs/*/setup.cfg",)
WORKSPACE = ("setup.cfg", "*/setup.cfg", "src/*/setup.cfg")  # places of packages in a workspace
SHELL = """# Source me from any POSIX shell. Made by scripts/layout.py.
export AMENT_PREFIX_PATH={prefix}"${{AMENT_PREFIX_PATH:+:$AMENT_PREFIX_PATH}}"
export PYTHONPATH={library}"${{PYTHONPATH:+:$PYTHONPATH}}"
"""
EXECUTABLE = """import sys

from {module} import {first}

if __name__ == "__main__":  # processes that it starts import it
    sys.exit({function}())
"""


def packages(root: Path = ROOT, places: Sequence[str] = OURS) -> Iterator[tuple[str, Path, ConfigParser]]:
    """Yield each package's name, folder and setup.cfg."""
    files = (file for place in places for file in root.glob(place))
    for file in sorted(file for file in files if file.with_name("package.xml").is_file()):
        config = ConfigParser(delimiters=("=",))
        config.optionxform = str  # type: ignore[assignment,method-assign] # names keep their case
        config.read_string(file.read_text(encoding="utf-8"))
        yield config["metadata"]["name"], file.parent, config


def share(folder: Path, config: ConfigParser) -> Tree:
    """Return the data files of a package: its marker in the ament index, package.xml, launch files and the like."""
    result: Tree = {}
    for place, patterns in config.items("options.data_files") if config.has_section("options.data_files") else ():
        for pattern in patterns.replace("\n", ",").split(","):
            for file in sorted((folder / os.path.dirname(pattern.strip())).glob(os.path.basename(pattern.strip()))):
                result[f"{place}/{file.name}"] = file.resolve()
    return result


def executables(name: str, config: ConfigParser) -> Iterator[tuple[str, str]]:
    """Yield each executable's place and text, without its first line."""
    for line in config.get("options.entry_points", "console_scripts", fallback="").split("\n"):
        executable, _, target = (part.strip() for part in line.partition("="))
        if target:
            module, _, function = target.partition(":")
            yield (
                f"lib/{name}/{executable}",
                EXECUTABLE.format(module=module, first=function.partition(".")[0], function=function),
            )


def metadata(name: str, config: ConfigParser) -> Tree:
    """Return the metadata of a package for importlib.metadata."""
    version = config["metadata"].get("version", "0")
    groups = config["options.entry_points"].items() if config.has_section("options.entry_points") else ()
    about = config["metadata"].get("description", name)
    message = f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\nSummary: {about}\n"
    points = "\n".join(f"[{group}]\n{lines.strip()}\n" for group, lines in groups)
    return {
        f"{name}-{version}.egg-info/{file}": text
        for file, text in (("PKG-INFO", message), ("entry_points.txt", points))
    }


def library() -> str:
    """Return the place of Python packages below a prefix."""
    return f"lib/python{sys.version_info[0]}.{sys.version_info[1]}/site-packages"


def lay_out(prefix: Path, root: Path = ROOT, places: Sequence[str] = OURS) -> None:
    """Create a prefix whose files are links to those of the checkout, so that editing a Python file needs no new one.

    Parameters
    ----------
    prefix : Path
        What is there goes: a package that is gone leaves no trace.
    root : Path, optional
    places : sequence of str
        Patterns of the setup.cfg files below `root`.
    """
    tree: Tree = {
        "setup.sh": SHELL.format(prefix=shlex.quote(str(prefix)), library=shlex.quote(str(prefix / library())))
    }
    for name, folder, config in packages(root, places):
        tree |= share(folder, config) | {f"{library()}/{k}": v for k, v in metadata(name, config).items()}
        tree |= {f"{library()}/{name}": folder / name}
        tree |= {place: f"#!{sys.executable}\n{text}" for place, text in executables(name, config)}
    new = prefix.with_name(f"{prefix.name}.new")
    shutil.rmtree(new, ignore_errors=True)
    for place, content in tree.items():
        path = new / place
        path.parent.mkdir(parents=True, exist_ok=True)
        if isinstance(content, Path):
            path.symlink_to(content)
        else:
            path.write_text(content)
            path.chmod(0o755 if content.startswith("#!") else 0o644)
    shutil.rmtree(prefix, ignore_errors=True)
    new.rename(prefix)


if __name__ == "__main__":
    below = (Path(sys.argv[2]).absolute(), WORKSPACE) if len(sys.argv) > 2 else (ROOT, OURS)
    lay_out(Path(sys.argv[1]).absolute(), *below)
