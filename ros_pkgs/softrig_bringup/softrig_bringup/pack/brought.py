"""Confirmed code of a pack: imported from one folder of the cache, in this process and its child processes."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable
from importlib import invalidate_caches
from pathlib import Path
from shutil import copytree, rmtree
from tempfile import mkdtemp

from softrig_core.kit.compiled import cache_folder

from .cargo import Package

_FORM = 1  # version of what `_lay_out` writes
_EXECUTABLE = """#!{python}
import sys

from {module} import {first}

if __name__ == "__main__":  # processes that it starts import it
    sys.exit({function}())
"""


def add_packages(digest: str, packages: Iterable[Package]) -> None:
    """Add packages to the import path of this process and of every process that it starts.

    Their folder contains only these packages and is last in the search path, so they replace no installed module.

    Parameters
    ----------
    digest : str
        Of the pack.
    packages : iterable of Package
        Packages whose names have been checked.
    """
    prefix = cache_folder() / "packs" / f"{digest}-code{_FORM}-py{sys.version_info[0]}.{sys.version_info[1]}"
    if not prefix.is_dir():
        new = Path(mkdtemp(dir=prefix.parent, prefix=".new_"))
        try:
            for package in packages:
                _lay_out(package, new)
            if not prefix.is_dir():
                new.rename(prefix)
        finally:
            rmtree(new, ignore_errors=True)
    library = str(prefix / "python")
    for name, entry in (("AMENT_PREFIX_PATH", str(prefix)), ("PYTHONPATH", library)):
        present = [p for p in os.environ.get(name, "").split(os.pathsep) if p and p != entry]
        os.environ[name] = os.pathsep.join([*present, entry])
    if library not in sys.path:
        sys.path.append(library)
    invalidate_caches()


def _lay_out(package: Package, prefix: Path) -> None:
    """Write the files of a package that Python and the ament index read; their texts are ours."""
    name, library = package.name, prefix / "python"
    about = library / f"{name}-{package.version}.dist-info"
    about.mkdir(parents=True)
    copytree(package.folder / name, library / name)  # files that Python compiles here are not part of the pack
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {package.version}\n")
    groups = (
        f"[{group}]\n" + "".join(f"{point} = {target}\n" for point, target in points.items())
        for group, points in package.offers.items()
    )
    (about / "entry_points.txt").write_text("\n".join(groups))
    mark = prefix / "share/ament_index/resource_index/packages" / name
    for path in (mark, prefix / "lib" / name / "x", prefix / "share" / name / "x"):
        path.parent.mkdir(parents=True, exist_ok=True)
    mark.touch()
    for point, target in package.offers.get("console_scripts", {}).items():
        module, _, function = target.partition(":")
        script = prefix / "lib" / name / point
        first = function.partition(".")[0]
        script.write_text(_EXECUTABLE.format(python=sys.executable, module=module, first=first, function=function))
        script.chmod(0o755)
    for relative, file in package.share.items():
        path = prefix / relative
        path.parent.mkdir(parents=True, exist_ok=True)
        path.unlink(missing_ok=True)
        path.symlink_to(file)
