"""The set-up: its layout equals what colcon builds, and its installed packages are pinned and have reasons."""

import ast
import importlib.util
import os
import re
import shutil
import subprocess
import sys
import tomllib
import xml.etree.ElementTree as ET
from importlib.metadata import distributions
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
LOCKS = {file.stem: file.read_text() for file in ROOT.glob("scripts/locks/*.lock")}
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
spec = importlib.util.spec_from_file_location("layout", ROOT / "scripts" / "layout.py")
layout = importlib.util.module_from_spec(spec)
spec.loader.exec_module(layout)


def visible(prefix):
    """What ROS sees of a prefix: executables, data files and the ament index; what Python sees of the packages."""
    files = {
        str(path.relative_to(prefix)): path.resolve() if path.is_symlink() else None
        for folder in ("lib", "share")
        for path in (prefix / folder).rglob("*")
        if path.is_file() and not {"site-packages", "colcon-core", "hook"} & set(path.parts) and path.stem != "package"
    }
    executables = {name for name in files if name.startswith("lib/")}
    assert all(os.access(prefix / name, os.X_OK) for name in executables)
    return {k: v for k, v in files.items() if k not in executables}, executables


def entry_points(*places):
    result = distributions(path=[str(p) for p in places])
    return {(d.name.replace("-", "_"), d.version, tuple(sorted(map(str, d.entry_points)))) for d in result}


def test_the_layout_has_every_package_and_starts_its_nodes(tmp_path):
    layout.lay_out(tmp_path / "my prefix")
    files, executables = visible(tmp_path / "my prefix")
    packages = {file.parent.name for file in ROOT.glob("ros_pkgs/*/package.xml")}
    assert {f"share/ament_index/resource_index/packages/{name}" for name in packages} < set(files)
    assert "share/softrig_bringup/scenarios/dc_motor_smc.yaml" in files
    assert "lib/softrig_drives/dc_motor_plant" in executables
    source = f". '{tmp_path}/my prefix/setup.sh'; echo $PYTHONPATH; echo $AMENT_PREFIX_PATH"
    printed = subprocess.run(["sh", "-c", source], env={"AMENT_PREFIX_PATH": "/under"}, capture_output=True, text=True)
    library, index = printed.stdout.splitlines()
    assert index == f"{tmp_path}/my prefix:/under"
    shown = subprocess.run(
        [tmp_path / "my prefix/lib/softrig_drives/dc_motor_plant", "--help"],
        capture_output=True,
        text=True,
        env=os.environ | {"PYTHONPATH": library},
    )
    assert "publishes motor/state" in shown.stdout, shown.stderr


@pytest.mark.long
def test_the_layout_is_what_colcon_builds(tmp_path):
    layout.lay_out(tmp_path / "ours")
    own_folder = tmp_path / "ours" / layout.library()
    foreign = tmp_path / "theirs"
    command = ["colcon", "--log-base", tmp_path / "log", "build", "--base-paths", ROOT / "ros_pkgs", "--build-base",
               tmp_path / "build", "--install-base", foreign, "--merge-install", "--symlink-install"]  # fmt: skip
    subprocess.run(command, cwd=tmp_path, check=True, capture_output=True)
    assert visible(tmp_path / "ours") == visible(foreign)
    assert entry_points(own_folder) == entry_points(*tmp_path.glob("build/*"))


@pytest.mark.long
def test_colcon_test_runs_the_own_tests_of_each_package(tmp_path):
    def colcon(verb, *options):
        command = ["colcon", "--log-base", tmp_path / "log", verb, "--base-paths", ROOT / "ros_pkgs", "--build-base",
                   tmp_path / "build", "--install-base", tmp_path / "install", *options]  # fmt: skip
        subprocess.run(command, cwd=tmp_path, check=True, capture_output=True)

    colcon("build")
    colcon("test", "--return-code-on-test-failure")
    results = {f.parent.name: ET.parse(f).find("testsuite").attrib for f in tmp_path.glob("build/*/pytest.xml")}
    assert set(results) == {p.parent.name for p in ROOT.glob("ros_pkgs/*/package.xml")}
    for package, result in results.items():
        assert (result["failures"], result["errors"]) == ("0", "0"), package
        assert int(result["tests"]) > 0, package


@pytest.mark.long
def test_a_set_up_without_a_network_works(tmp_path):
    """What `fetch` has downloaded is all that a set-up needs, by uv, verified."""
    present = tmp_path / "there"
    for name in ("scripts", "ros_pkgs", "config"):
        shutil.copytree(ROOT / name, present / name, ignore=shutil.ignore_patterns("__pycache__", "*.egg-info"))
    own_folder = ("AMENT_", "PYTHON", "VIRTUAL_ENV", "COLCON_", "SOFTRIG_", "LD_", "_ROS_")
    user = {k: v for k, v in os.environ.items() if not k.startswith(own_folder)}
    user |= {"HOME": str(tmp_path), "PATH": f"{sys.base_prefix}/bin:/usr/bin:/bin"}
    subprocess.run(
        [ROOT / "scripts" / "softrig", "setup", "--fetch", tmp_path / "wheels", "tables"], check=True, env=user
    )
    nowhere = dict.fromkeys(("HTTP_PROXY", "HTTPS_PROXY", "ALL_PROXY"), "http://127.0.0.1:9")
    cut_off = user | {k: v for name in nowhere for k, v in ((name, nowhere[name]), (name.lower(), nowhere[name]))}

    def softrig(*arguments, **variables):
        return subprocess.run([present / "scripts" / "softrig", *arguments], cwd=tmp_path, env=cut_off | variables,
                              capture_output=True, text=True, stdin=subprocess.DEVNULL)  # fmt: skip

    done = softrig("run", "dc_motor_smc_b2", "--mode", "inprocess", SOFTRIG_WHEELS=str(tmp_path / "wheels"))
    assert done.returncode == 0, done.stderr
    assert "uv could not" not in (present / ".ws" / "setup.log").read_text()
    assert softrig("setup", "tables", SOFTRIG_WHEELS=str(tmp_path / "wheels")).returncode == 0
    # The package was not downloaded.
    assert softrig("setup", "search", SOFTRIG_WHEELS=str(tmp_path / "wheels")).returncode == 2
    assert softrig("python", "-c", "import pyarrow").returncode == 0


def names(requirements):
    return {re.match(r"[\w.-]+", r).group().replace("_", "-").replace(".", "-").lower() for r in requirements}


def test_requirements_are_pinned_with_hashes():
    pinned = {set_: names(re.findall(r"^[^ \n]+==\S+", lock, re.M)) for set_, lock in LOCKS.items()}
    extras = PROJECT["project"]["optional-dependencies"]
    assert names(PROJECT["project"]["dependencies"]) <= pinned["run"]
    assert set(LOCKS) == {"run", "uv", "test", *extras}
    for extra, requirements in extras.items():
        assert names(requirements) <= pinned[extra] | pinned["run"]
        assert pinned[extra] <= pinned["test"]
    assert names(PROJECT["dependency-groups"]["test"]) <= pinned["test"]
    kilted = (ROOT / "scripts/locks/distro/kilted.lock").read_text()
    asked = {name.replace("jazzy", "kilted") for name in names(PROJECT["project"]["dependencies"]) if "jazzy" in name}
    assert asked <= names(re.findall(r"^[^ \n]+==\S+", kilted, re.M))
    for lock in (*LOCKS.values(), kilted):
        entries = re.split(r"\n(?=\S)", lock.strip())
        assert all(re.match(r"\S+==\S+.*( \\\n    --hash=sha256:[0-9a-f]{64})+$", entry) for entry in entries)


def test_every_dependency_has_its_reason_beside_it():
    text = (ROOT / "pyproject.toml").read_text().partition("dependencies = [")[2].partition("[tool.")[0]
    block = False  # the reason of a block of dependencies is in its first line
    for line in text.splitlines():
        if line.strip().startswith('"') and not block:
            assert " # " in line, line
        elif "= [" in line:
            block = "colcon = [" in line
            assert " # " in line, line


@pytest.mark.long
def test_a_run_imports_nothing_of_the_test_set():
    """The run set is enough to import every module that is shipped."""
    run, test = (names(re.findall(r"^[^ \n]+==", LOCKS[name], re.M)) for name in ("run", "test"))
    loaded = subprocess.run([sys.executable, "-c", EVERY_MODULE], capture_output=True, text=True, check=True)
    assert not (test - run) & set(loaded.stdout.split())


EVERY_MODULE = """
import importlib, pkgutil, sys
from importlib.metadata import packages_distributions
import softrig_core, softrig_nodes, softrig_control, softrig_optim, softrig_drives, softrig_power, softrig_robots
import softrig_systems, softrig_bags, softrig_bringup
for package in [m for n, m in list(sys.modules.items()) if n.startswith("softrig_") and "." not in n]:
    for module in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
        # the environment and the page ask for their extras when they are imported, which nothing of a run does
        if not module.name.endswith(("__main__", ".environment", ".environments")) and ".view." not in module.name:
            importlib.import_module(module.name)
owners = packages_distributions()
# two packages bring lark; numpy.f2py takes charset_normalizer where it is there, numba coverage
found = {name: owners[name][0] for name in list(sys.modules) if name in owners}
others = ("charset_normalizer", "coverage", "lark")
print(*{d.replace("_", "-").lower() for name, d in found.items() if name not in others})
"""


def test_every_folder_of_tests_is_run():
    """They are listed one by one, for their order."""
    present = {str(file.parent.relative_to(ROOT)) for file in (ROOT / "tests").rglob("test_*.py")}
    assert sorted(PROJECT["tool"]["pytest"]["ini_options"]["testpaths"]) == sorted(present)


def test_an_independent_implementation_names_its_source():
    """Its module docstring says what it is based on, other than our code."""
    heads = {
        path.name: ast.get_docstring(ast.parse(path.read_text())) or ""
        for path in (ROOT / "tests").glob("*/test_*.py")
        if re.search("by_hand|account|measures|kernels|mirror|over_time", path.name)
    }
    assert len(heads) > 10
    assert [name for name, head in heads.items() if not re.search("^Sources?: |^Source of ", head, re.M)] == []
