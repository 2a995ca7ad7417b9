"""Shell settings that would replace packages of softrig are left out, and a line names them."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

SOFTRIG = Path(__file__).parents[2] / "scripts" / "softrig"


@pytest.mark.parametrize(
    ("name", "value", "text"),
    [
        ("PYTHONHOME", "/usr", "PYTHONHOME=/usr is left out: it belongs to another Python"),
        ("PYTHONPATH", "{}/broken:{}/mine", "PYTHONPATH: {}/broken is left out: numpy in it would replace"),
        ("LD_LIBRARY_PATH", "/conda/lib:/mine", "LD_LIBRARY_PATH: /conda/lib is left out: conda's libraries"),
    ],
)
def test_packages_that_would_replace_one_of_the_set_up_are_left_out(tmp_path, name, value, text):
    (tmp_path / "broken" / "numpy").mkdir(parents=True)
    (tmp_path / "broken" / "numpy" / "__init__.py").write_text("raise ImportError('broken')\n")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "my_law.py").write_text("")
    code = "import numpy, os, sys; print(os.environ.get('LD_LIBRARY_PATH', '')); print(sys.path); import my_law"
    prefixes = ("PYTHON", "VIRTUAL_ENV", "LD_", "AMENT_", "COLCON_", "_ROS_")
    user = {k: v for k, v in os.environ.items() if not k.startswith(prefixes)}
    user |= {"PYTHONPATH": str(tmp_path / "mine"), "CONDA_PREFIX": "/conda", name: value.replace("{}", str(tmp_path))}
    if name == "PYTHONHOME":
        user["PYTHONPATH"] = str(tmp_path / "mine")
    done = subprocess.run([SOFTRIG, "python", "-c", code], env=user, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert text.replace("{}", str(tmp_path)) in done.stderr
    if name == "LD_LIBRARY_PATH":
        assert "/conda/lib" not in done.stdout
        assert "/mine" in done.stdout


def test_a_python_with_the_wheels_of_ros_starts_once_and_other_programs_do_not_see_their_libraries():
    prefixes = ("PYTHON", "VIRTUAL_ENV", "LD_", "AMENT_", "COLCON_", "_ROS_")
    user = {k: v for k, v in os.environ.items() if not k.startswith(prefixes)} | {"LD_LIBRARY_PATH": "/mine"}

    def path(*command):
        done = subprocess.run([SOFTRIG, *command], env=user, capture_output=True, text=True, check=True)
        return done.stdout.strip().split(":")

    code = "import os; print(os.environ['LD_LIBRARY_PATH'])"
    *wheels, own_path = path("python", "-S", "-c", code)  # -S leaves out what the wheels load when Python starts
    assert own_path == "/mine"
    assert set(path("python", "-c", code)) == {*wheels, own_path}
    assert path("env", "printenv", "LD_LIBRARY_PATH") == ["/mine"]
    wheels_are_used = "ros_rclpy" in "".join(wheels) or "ROS_DISTRO" in user
    assert wheels_are_used


def test_help_is_kept_until_a_file_that_makes_it_is_newer():
    kept = Path(sys.prefix).parent / ".ws" / "help" / "71 report --help"

    def printed():
        command, wide = [SOFTRIG, "report", "--help"], os.environ | {"COLUMNS": "71"}
        return subprocess.run(command, env=wide, capture_output=True, text=True, check=True).stdout

    kept.unlink(missing_ok=True)
    text = printed()
    assert text.startswith("usage: softrig report")
    assert kept.read_text() == text
    kept.write_text("kept\n")
    assert printed() == "kept\n"
    os.utime(kept, (0, 0))
    assert printed() == text
