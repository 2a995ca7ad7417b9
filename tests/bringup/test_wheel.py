"""The wheel: it is complete, and it works in an environment without the checkout."""

import importlib.metadata
import json
import os
import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
from softrig_bringup.cli import main, make_parser
from softrig_core.guard import WITHOUT_ROS

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "ros_pkgs/softrig_bringup/doc/wheel.md").read_text()
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
DEPENDENCIES, VERSION = PROJECT["dependencies"], PROJECT["version"]
PACKAGES = sorted(p.parent.name for p in ROOT.glob("ros_pkgs/*/package.xml"))
OURS = ("AMENT_", "PYTHON", "VIRTUAL_ENV", "COLCON_", "SOFTRIG_", "ROS_", "PYTEST_")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation", "-w", folder, ROOT]
    subprocess.run(command, check=True)
    (file,) = folder.glob("softrig-*-py3-none-any.whl")
    return file


def environment(folder, **more):
    """The environment of a user without ROS and without settings."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith(OURS)}
    return kept | {"HOME": str(folder), "PYTHONNOUSERSITE": "1"} | more


def test_the_wheel_is_complete_and_contains_nothing_of_this_machine(wheel):
    with zipfile.ZipFile(wheel) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    data = {name.partition(".data/data/")[2] for name in files}
    for package in PACKAGES:
        assert f"share/ament_index/resource_index/packages/{package}" in data
        assert f"share/{package}/package.xml" in data
        points = importlib.metadata.distribution(package).entry_points.select(group="console_scripts")
        executables = {f"lib/{package}/{point.name}" for point in points}
        assert executables == {name for name in data if name.startswith(f"lib/{package}/")}
        folder = ROOT / "ros_pkgs" / package
        assert {str(file.relative_to(folder)) for file in folder.glob(f"{package}/**/*.py")} <= set(files)
    assert {f"share/softrig_bringup/scenarios/{f.name}" for f in ROOT.glob("config/scenarios/*.yaml")} <= data
    assert {f"share/softrig_robots/urdf/{f.name}" for f in ROOT.glob("ros_pkgs/softrig_robots/**/*.urdf")} <= data
    assert {"softrig_nodes/fastdds_profile.xml", "softrig_nodes/fastdds_loopback.xml"} <= set(files)
    assert not [name for name in files if name.endswith(".pyc")]
    assert not [name for name, content in files.items() if os.fsencode(ROOT) in content]
    (metadata,) = (files[name].decode() for name in files if name.endswith(".dist-info/METADATA"))
    lines = [line.partition(": ")[2] for line in metadata.splitlines() if line.startswith("Requires-Dist:")]
    assert names(DEPENDENCIES) == names(line for line in lines if "extra ==" not in line)

    assert metadata.partition("\n\n")[2].strip() == PAGE.strip()


def test_its_page_lists_its_content():
    shown = re.findall(r"^    softrig (\w+)", PAGE, re.MULTILINE)
    assert {"list", "run", "new"} <= set(shown) <= set(make_parser()._subparsers._group_actions[0].choices)
    assert not {"setup", "docs", "bench", "env"} & set(shown)
    # One builds the wheel; instead of the other, type `softrig VERB`.
    assert re.findall(r"scripts/softrig (\w+)", PAGE) == ["python", "VERB"]


WITHOUT = """
import sys
sys.modules |= dict.fromkeys(["rclpy", "std_msgs", "sensor_msgs", "geometry_msgs", "std_srvs", "rcl_interfaces"])
from softrig_bringup.cli import main
run = ["run", "dc_motor_smc_b2", "--no-plots", "--out"]
for verb in ([*run, "one", "--mode", "inprocess"], ["bag", "info", "one/bag"], [*run, "two"], ["bag", "record"]):
    print("status", main(verb), flush=True)
"""


@pytest.mark.long
def test_without_ros_verbs_that_need_it_say_so_and_the_rest_works(tmp_path):
    done = subprocess.run([sys.executable, "-c", WITHOUT], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert re.findall(r"^status (\d)", done.stdout, re.MULTILINE) == ["0", "0", "2", "2"]
    assert done.stderr.splitlines() == [f"softrig: {WITHOUT_ROS}"] * 2


def names(requirements):
    return {re.sub(r"[._]", "-", re.split(r"[ ;<>=]", line)[0]).lower() for line in requirements}


def use(prefix, folder, variables):
    """Use what is installed in a prefix: the command, a run through processes, a node by itself."""

    def call(*command, timeout=240):
        done = subprocess.run([prefix / command[0], *command[1:]], cwd=folder, env=variables, capture_output=True,
                              text=True, timeout=timeout, stdin=subprocess.DEVNULL)  # fmt: skip
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    assert call("bin/softrig", "--version") == f"softrig {VERSION}\n"
    assert "dc_motor_smc_b2" in call("bin/softrig", "list")
    call("bin/softrig", "run", "dc_motor_smc_b2", "--no-plots", "--out", "out")
    metrics = json.loads((folder / "out" / "metrics.json").read_text())
    assert metrics["mode"] == "processes"
    assert all(m["pass"] for m in metrics["metrics"])
    assert "publishes motor/state" in call("lib/softrig_drives/dc_motor_plant", "--help")
    assert "publishes motor/state" in call("bin/softrig", "node", "softrig_drives", "dc_motor_plant", "--help")
    loaded = call("bin/python", "-c", "import softrig_drives, softrig_core; print(softrig_drives.__path__[0])")
    assert loaded.startswith(str(prefix))


@pytest.mark.long
def test_it_works_beside_the_packages_that_are_installed(wheel, tmp_path):
    prefix = tmp_path / "venv"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", prefix], check=True)
    subprocess.run([sys.executable, "-m", "pip", "--python", prefix / "bin" / "python", "install", "-q", "--no-deps",
                    "--no-index", "--no-compile", wheel], check=True, env=environment(tmp_path))  # fmt: skip
    (library,) = prefix.glob("lib/python3*/site-packages")
    shared = Path(importlib.metadata.distribution("numpy").locate_file(""))
    (library / "shared.pth").write_text(f"import site; site.addsitedir({str(shared)!r})\n")
    use(prefix, tmp_path, environment(tmp_path, AMENT_PREFIX_PATH=sys.prefix))


@pytest.mark.long
def test_the_sdist_makes_the_same_wheel(wheel, tmp_path):
    """From a checkout that is set up, where links in .ws lead to the packages once more."""
    build = f"from hatchling.build import build_sdist; print(build_sdist({str(tmp_path)!r}))"
    done = subprocess.run([sys.executable, "-c", build], cwd=ROOT, check=True, capture_output=True, text=True)
    sdist = tmp_path / done.stdout.split()[-1]
    assert sdist.name == f"softrig-{VERSION}.tar.gz"
    command = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation", "-w", tmp_path, sdist]
    subprocess.run(command, check=True, cwd=tmp_path)
    (again,) = tmp_path.glob("*.whl")
    assert contents(again) == contents(wheel)


def contents(wheel):
    with zipfile.ZipFile(wheel) as archive:
        return {entry.filename: entry.CRC for entry in archive.infolist()}


@pytest.mark.long
def test_pip_installs_all_that_it_needs(wheel, tmp_path):
    """From the registry, or from the wheels in SOFTRIG_WHEELS."""
    wheels = os.environ.get("SOFTRIG_WHEELS")
    prefix = tmp_path / "venv"
    subprocess.run([sys.executable, "-m", "venv", prefix], check=True)
    subprocess.run(
        [
            prefix / "bin" / "python",
            "-m",
            "pip",
            "install",
            "-q",
            wheel,
            *(("--no-index", "--find-links", wheels) if wheels else ()),
        ],
        check=True,
        env=environment(tmp_path),
    )
    use(prefix, tmp_path, environment(tmp_path))


@pytest.mark.parametrize(
    "words",
    ["--workspace my_rig run my_rig", "setup", "docs", "bench native", "env", "env colcon build", "python -c x"],
)
def test_verbs_that_only_a_checkout_has_are_refused_with_the_reason(words, capsys):
    assert main(words.split()) == 2
    (text,) = capsys.readouterr().err.splitlines()
    assert "scripts/softrig" in text
    assert "pip install ./my_rig" in text


@pytest.mark.parametrize(
    ("where", "first"), [("", "    pip install . && softrig run"), ("/x/softrig", "    /x/softrig --workspace . run")]
)
def test_a_new_package_names_available_tools(where, first, tmp_path, monkeypatch, capsys):
    """Neither --workspace nor colcon from a wheel; both if a checkout has the command."""
    monkeypatch.delenv("SOFTRIG_COMMAND", raising=False)
    if where:
        monkeypatch.setenv("SOFTRIG_COMMAND", where)
    monkeypatch.chdir(tmp_path)
    assert main(["new", "my_rig"]) == 0
    text = (tmp_path / "my_rig" / "README.md").read_text()
    assert first in text
    assert ("--workspace" in text, "env colcon" in text) == (bool(where), bool(where))
    printed = capsys.readouterr().out.splitlines()[-1].strip()
    assert printed == (
        "/x/softrig --workspace my_rig run my_rig" if where else "pip install ./my_rig && softrig run my_rig"
    )
