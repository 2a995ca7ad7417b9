"""The imports of each package are in its package.xml, under a key of rosdistro or of config/rosdep.yaml, and nothing
else is.
"""

import ast
import configparser
import importlib
import re
import sys
import tomllib
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import softrig_core
import yaml
from pages.statements import imported
from softrig_bags.cli import main_bag
from softrig_bags.files import compressed
from softrig_bags.files.compressed import inflate
from softrig_core import ScenarioError
from softrig_core.analysis.linear import Linear
from softrig_core.extras import EXTRAS, OF_PIP
from softrig_core.judge import formula

ROOT = Path(__file__).parents[2]
PACKAGES = sorted(p.parent for p in ROOT.glob("ros_pkgs/*/package.xml"))
KEYS = yaml.safe_load(Path(__file__).with_name("rosdep_keys.yaml").read_text())
PAGE = (ROOT / "ros_pkgs/softrig_bringup/doc/set_up.md").read_text()
(LINE,) = re.findall(r"pip install ((?:.*\\\n)*.*pydantic(?:.*\\\n)*.*)", PAGE)
FROM_PIP = {re.match(r"[\w.-]+", word).group() for word in LINE.replace("'", "").split() if word != "\\"}
BRINGUP = ROOT / "ros_pkgs/softrig_bringup/softrig_bringup"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
OWN = yaml.safe_load((ROOT / "config/rosdep.yaml").read_text())  # keys that rosdistro does not have
SOURCES = {  # modules whose package has another name
    "ruamel": "ruamel.yaml",
    "typing_extensions": "typing-extensions",
    "PIL": "pil",
    "elftools": "pyelftools",
    "serial": "pyserial",
    "can": "python-can",
    "pinocchio": "pin",
    "llvmlite": "numba",
    "backports": "backports.zstd",
    "compression": "backports.zstd",
}
COMMON = configparser.ConfigParser()
COMMON.read(ROOT / "ros_pkgs/softrig_core/setup.cfg")
OWN_TESTS = (ROOT / "ros_pkgs/softrig_core/test/test_softrig_core.py").read_text()
OTHERS = {"motulator", "gym_electric_motor", "jax"}  # optional: compared with softrig only where they are installed


RELEASED = ("softrig_core", "softrig_nodes", "softrig_bags")  # packages that a ROS distribution may include
# Debian has this package since trixie, but rosdistro only has a key for pip.
WAITS_FOR = {"softrig_bags": ["python3-rosbags-pip"]}
TEMPLATE = ROOT / "ros_pkgs/softrig_bringup/softrig_bringup/template/package.xml.template"


def depends(file, kind="exec"):
    return set(re.findall(f"<{kind}_depend.*?>(.+?)</", file.read_text()))


def keys(module):
    """Names under which a module may be declared."""
    name = SOURCES.get(module, module)
    return {name, f"{name}-pip", f"python3-{name}", f"python3-{name}-pip"}


def imports(folder):
    """Modules that a package imports, except Python's and its own."""
    results = set()
    for file in (*folder.glob(f"{folder.name}/**/*.py"), *folder.glob("launch/*.py")):
        for node, _ in imported(file):
            if isinstance(node, ast.Import):
                results |= {alias.name.partition(".")[0] for alias in node.names}
            elif not node.level:
                results.add(node.module.partition(".")[0])
    return results - set(sys.stdlib_module_names) - OTHERS - {folder.name}


def test_every_key_exists():
    packages = {folder.name for folder in PACKAGES}
    files = [TEMPLATE, *(folder / "package.xml" for folder in PACKAGES)]
    used = {key for file in files for kind in ("exec", "test", "build") for key in depends(file, kind)} - packages
    assert used == {*KEYS["ros"], *KEYS["system"], *KEYS["pip"], *OWN}
    for key, system in KEYS["system"].items():  # rosdistro itself installs none of these keys from pip
        names = system["ubuntu"]["*"] if isinstance(system["ubuntu"], dict) else system["ubuntu"]
        assert names == [key]


@pytest.mark.parametrize("folder", PACKAGES, ids=lambda f: f.name)
def test_every_import_is_declared(folder):
    extras = {name for requirements in PROJECT["optional-dependencies"].values() for name in requirements}
    declared = depends(folder / "package.xml")
    used = {name for name in imports(folder) if SOURCES.get(name, name) not in extras}
    if folder.name in RELEASED:
        used = {name for name in used if SOURCES.get(name, name) not in OF_PIP}
    if folder == BRINGUP.parent:
        used |= {*OF_PIP}
    assert {name for name in used if not keys(name) & declared} == set()
    python = {key for key in declared if key in {*KEYS["system"], *KEYS["pip"], *OWN}}
    assert python <= set().union(*map(keys, used))


@pytest.mark.parametrize("name", RELEASED)
def test_packages_for_a_distribution_use_only_keys_of_rosdistro(name):
    declared = depends(ROOT / "ros_pkgs" / name / "package.xml") - {*RELEASED}
    assert declared <= {*KEYS["ros"], *KEYS["system"], *WAITS_FOR.get(name, ())}


@pytest.mark.parametrize(
    ("package", "use", "what"),
    [
        ("control", lambda: Linear(*[np.eye(1)] * 4, *np.zeros((3, 1))).system(), "a system of python-control"),
        ("sentil", lambda: formula.read("G[0:1](u - 1)", {"u": None}), "a requirement as a formula"),
        ("pycparser", lambda: importlib.import_module("softrig_core.export.st"), "structured text"),
        ("mcap", lambda: main_bag.__wrapped__(["repair", "none"]), "a repair"),
        ("lz4", lambda: inflate(b"x", "lz4"), "a bag that is compressed by lz4"),
        ("backports.zstd", lambda: inflate(b"x", "zstd"), "a bag that is compressed by zstd"),
    ],
    ids=lambda x: x if isinstance(x, str) and " " not in x else "",
)
def test_a_distribution_without_pip_packages_asks_for_them_at_the_first_use(package, use, what, monkeypatch):
    monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.delitem(sys.modules, "softrig_core.export.st", raising=False)
    compressed.zstd.cache_clear()
    formula._tree.cache_clear()
    with pytest.raises(ScenarioError, match=f"^{what} needs the package '{package}': pip install {package}$"):
        use()


def above(file):
    """Modules that a file imports when it is loaded, as full names; an imported name may be a module, too."""
    package = file.relative_to(BRINGUP.parent).with_suffix("").parts[:-1]
    for node in ast.parse(file.read_text()).body:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            start = ".".join(package[: len(package) - node.level + 1]) if node.level else ""
            module = ".".join(filter(None, (start, node.module or "")))
            yield module
            yield from (f"{module}.{alias.name}" for alias in node.names)


def test_no_verb_imports_an_extra_before_it_asks_for_it():
    """A checkout installs it when `need` asks; an import at the head of a verb's module would fail before that."""
    targets = re.findall(r'"([\w.]+):\w+"', (BRINGUP / "verbs/declared.py").read_text())
    waiting = {f"softrig_bringup.{target}" for target in targets}
    assert len(waiting) > 10
    seen = set(waiting)
    while waiting:
        name = waiting.pop()
        file = BRINGUP.parent.joinpath(*name.split(".")).with_suffix(".py")
        if file.is_file():
            new = set(above(file))
            assert not {n.partition(".")[0] for n in new} & EXTRAS.keys(), f"{name} needs an extra as it is loaded"
            waiting |= {n for n in new if n.startswith("softrig_bringup.")} - seen
            seen |= new


def test_our_own_keys_match_the_projects_pip_requirements():
    wanted = {re.match(r"[\w.-]+", r).group(): r.partition(";")[0].strip() for r in PROJECT["dependencies"]}
    for key, systems in OWN.items():
        name = key.removeprefix("python3-").removesuffix("-pip")
        pip = {"pip": {"packages": [wanted[name]]}}
        if key in KEYS["system"]:  # the versions of Debian bookworm and Ubuntu noble are too old
            assert systems == {s: {old: pip, "*": [key]} for s, old in (("debian", "bookworm"), ("ubuntu", "noble"))}
        else:
            assert systems == dict.fromkeys(("debian", "ubuntu"), pip)
            assert key not in KEYS["pip"]


@pytest.mark.parametrize("folder", PACKAGES, ids=lambda f: f.name)
def test_each_package_stands_alone_with_licence_and_configuration(folder):
    """A distribution takes them one by one."""
    root = ElementTree.parse(folder / "package.xml").getroot()
    assert root.find("license").attrib == {"file": "LICENSE"}
    assert (folder / "LICENSE").read_text() == (ROOT / "LICENSE").read_text()
    config = configparser.ConfigParser()
    config.read(folder / "setup.cfg")
    assert config["flake8"] == {**COMMON["flake8"]}
    assert "LICENSE" in config["options.data_files"][f"share/{folder.name}"]
    own = folder / f"test/test_{folder.name}.py"
    assert own.read_text().replace(folder.name, "softrig_core") == OWN_TESTS


def test_the_pip_line_lists_what_the_set_up_installs():
    wanted = {re.match(r"[\w.-]+", r).group() for r in PROJECT["dependencies"]}
    assert {name for name in wanted if not name.startswith("ros-")} == FROM_PIP
    assert "'pydantic>=2'" in LINE


def test_an_old_pydantic_is_refused_in_one_line(monkeypatch, tmp_path):
    (tmp_path / "pydantic").mkdir()
    (tmp_path / "pydantic" / "__init__.py").write_text("VERSION = '1.10.14'")
    (tmp_path / "pydantic" / "version.py").write_text("VERSION = '1.10.14'")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "pydantic")
    with pytest.raises(ImportError, match=rf"needs pydantic 2 and finds an older one in {tmp_path}/pydantic: .*set_up"):
        importlib.reload(softrig_core)
