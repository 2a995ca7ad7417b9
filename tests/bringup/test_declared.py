"""What each package needs is in its package.xml, under a key that rosdep has, or in the pip line of the page Set-up."""

import ast
import importlib
import re
import sys
import tomllib
from pathlib import Path

import pytest
import softrig_core
import yaml

ROOT = Path(__file__).parents[2]
PACKAGES = sorted(p.parent for p in ROOT.glob("ros_pkgs/*/package.xml"))
KEYS = yaml.safe_load(Path(__file__).with_name("rosdep_keys.yaml").read_text())
PAGE = (ROOT / "ros_pkgs/softrig_bringup/doc/set_up.md").read_text()
(LINE,) = re.findall(r"pip install ((?:.*\\\n)*.*pydantic(?:.*\\\n)*.*)", PAGE)
FROM_PIP = {re.match(r"[\w.-]+", word).group() for word in LINE.replace("'", "").split() if word != "\\"}
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
SOURCES = {  # modules that another name brings
    "yaml": "python3-yaml", "ruamel": "python3-ruamel.yaml", "typing_extensions": "python3-typing-extensions",
    "pinocchio": "pin", "PIL": "pillow", "llvmlite": "numba", "backports": "backports.zstd",
    "compression": "backports.zstd",
}  # fmt: skip
OTHERS = {"motulator", "gym_electric_motor"}  # compared with where somebody has installed them


TEMPLATE = ROOT / "ros_pkgs/softrig_bringup/softrig_bringup/template/package.xml.template"


def depends(file, kind="exec"):
    return set(re.findall(f"<{kind}_depend>(.+?)</", file.read_text()))


def imports(folder):
    """Modules that a package imports, without Python's and its own."""
    found = set()
    for file in (*folder.glob(f"{folder.name}/**/*.py"), *folder.glob("launch/*.py")):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.Import):
                found |= {alias.name.partition(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and not node.level:
                found.add(node.module.partition(".")[0])
    return found - set(sys.stdlib_module_names) - OTHERS - {folder.name}


def test_every_key_exists():
    ours = {folder.name for folder in PACKAGES}
    files = [TEMPLATE, *(folder / "package.xml" for folder in PACKAGES)]
    used = {key for file in files for kind in ("exec", "test", "build") for key in depends(file, kind)} - ours
    assert used == {*KEYS["ros"], *KEYS["system"]}
    for key, system in KEYS["system"].items():  # none that rosdep would have pip put into the system's Python
        names = system["ubuntu"]["*"] if isinstance(system["ubuntu"], dict) else system["ubuntu"]
        assert names == [key]


@pytest.mark.parametrize("folder", PACKAGES, ids=lambda f: f.name)
def test_every_import_is_declared(folder):
    extras = {name for requirements in PROJECT["optional-dependencies"].values() for name in requirements}
    declared = depends(folder / "package.xml") | FROM_PIP | extras
    missing = {name for name in imports(folder) if not {name, f"python3-{name}", SOURCES.get(name, name)} & declared}
    assert not missing


def test_the_pip_line_has_what_the_set_up_installs():
    wanted = {re.match(r"[\w.-]+", r).group() for r in PROJECT["dependencies"]}
    assert {name for name in wanted if not name.startswith("ros-")} == FROM_PIP
    assert "'pydantic>=2'" in LINE


def test_an_old_pydantic_is_refused_in_words(monkeypatch, tmp_path):
    (tmp_path / "pydantic").mkdir()
    (tmp_path / "pydantic" / "__init__.py").write_text("VERSION = '1.10.14'")
    (tmp_path / "pydantic" / "version.py").write_text("VERSION = '1.10.14'")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "pydantic")
    with pytest.raises(ImportError, match=rf"needs pydantic 2 and finds an older one in {tmp_path}/pydantic: .*set_up"):
        importlib.reload(softrig_core)
