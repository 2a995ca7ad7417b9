"""softrig_core without ROS; blocks as nodes by the entry points of softrig_nodes; names of earlier versions."""

import importlib.util
import os
import subprocess
import sys
from importlib.metadata import EntryPoint
from pathlib import Path

import faultrig
import pytest
import softrig_core
from softrig_core import RunningBlock, former, runners
from softrig_core.errors import ScenarioError
from softrig_core.rig.installed import block_of
from test_walls import MIDDLEWARE

ROOT = Path(__file__).parents[2]
spec = importlib.util.spec_from_file_location("layout", ROOT / "scripts" / "layout.py")
layout = importlib.util.module_from_spec(spec)
spec.loader.exec_module(layout)
ALONE = ("softrig_core", "softrig_control", "softrig_optim", "softrig_drives")
# Hide ROS packages that are installed beside Python.
BLOCKED = f"""
import sys
class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {(*MIDDLEWARE, "softrig_nodes")!r}:
            raise ModuleNotFoundError(f"no {{name}} on this machine", name=name)
sys.meta_path.insert(0, Blocked())
"""


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """Run Python with only four packages installed and without ROS."""
    prefix = tmp_path_factory.mktemp("alone") / "prefix"
    layout.lay_out(prefix, places=[f"ros_pkgs/{name}/setup.cfg" for name in ALONE])
    prefixes = ("AMENT_", "PYTHON", "SOFTRIG_", "COLCON_", "ROS_", "RMW_")
    variables = {k: v for k, v in os.environ.items() if not k.startswith(prefixes)}
    variables["PYTHONPATH"] = str(prefix / layout.library())
    variables["SOFTRIG_JIT"] = "0"

    def run(code, *arguments):
        command = [sys.executable, "-c", BLOCKED + code, *arguments]
        return subprocess.run(command, capture_output=True, text=True, env=variables, cwd=prefix)

    return run


def test_the_core_is_imported_and_simulates_without_ros(alone):
    code = """
import importlib, pkgutil, softrig_core
for module in pkgutil.walk_packages(softrig_core.__path__, "softrig_core."):
    if not module.name.startswith("softrig_core.analysis.environment"):  # needs the extra of gymnasium
        importlib.import_module(module.name)
run = softrig_core.simulate(softrig_core.load_scenario(sys.argv[1]), duration=0.05)
print(len(run.signals["motor/true_state/shaft/velocity"].x), len(softrig_core.__path__))
assert not {"rclpy", "softrig_nodes"} & set(sys.modules)
"""
    done = alone(code, str(ROOT / "config" / "scenarios" / "dc_motor_smc_b2.yaml"))
    assert done.returncode == 0, done.stderr
    assert done.stdout == "6 1\n"


def test_a_node_without_softrig_nodes_names_what_it_needs(alone):
    code = """
from softrig_drives.dc_motor.plant import DcMotorPlant
DcMotorPlant.main(["/some/lib/softrig_drives/dc_motor_plant"])
"""
    done = alone(code)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == (
        "dc_motor_plant: nodes need the package softrig_nodes and ROS 2, and softrig_nodes is not installed here; "
        "`simulate` and runs in process need neither\n"
    )


def test_a_class_is_the_node_that_its_package_declares(monkeypatch):
    assert block_of(EntryPoint("gain", "faultrig:Gain.main", "console_scripts").load()) is faultrig.Gain
    assert block_of(faultrig.script) is None
    assert block_of("".join) is None  # a bound method whose object is no block
    asked = []
    monkeypatch.setattr(runners, "find_runner", lambda name: lambda *what: asked.append((name, *what)))
    monkeypatch.setattr(sys, "argv", ["/lib/faultrig/gain", "--help"])
    for arguments in (None, ["gain", "a"]):
        with pytest.raises(AssertionError, match="a node ends its process"):
            faultrig.Gain.main(arguments)
    assert asked == [("node", faultrig.Gain, ["/lib/faultrig/gain", "--help"]), ("node", faultrig.Gain, ["gain", "a"])]


def test_placements_are_those_of_softrig_nodes():
    import softrig_nodes.container
    import softrig_nodes.main

    assert runners.find_runner("processes") is softrig_nodes.run_processes
    assert runners.find_runner("node") is softrig_nodes.main.run_node
    assert runners.find_runner("container") is softrig_nodes.container.main
    with pytest.raises(ScenarioError, match="softrig_nodes is not installed"):
        runners.find_runner("none")
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        softrig_nodes.nothing  # noqa: B018


def test_earlier_names_work_and_name_their_replacement(monkeypatch):
    with pytest.warns(FutureWarning, match=r"executable\(Gain\) .* 0.4; use .*`NAME = faultrig:Gain.main`") as text:
        main = softrig_core.executable(faultrig.Gain)
    assert text[0].filename == __file__
    assert block_of(main) is faultrig.Gain
    asked = []
    monkeypatch.setattr(faultrig.Gain, "main", asked.append)
    main(["gain", "x"])
    assert asked == [["gain", "x"]]
    monkeypatch.setattr(former, "find_runner", lambda name: lambda *what, **how: (name, what, how))
    with pytest.warns(FutureWarning, match="use softrig_nodes.run_processes"):
        assert softrig_core.run_processes(1, x=2) == ("processes", (1,), {"x": 2})
    with pytest.warns(FutureWarning, match="use ros2 run softrig_nodes container"), pytest.raises(AssertionError):
        former.container()


def test_a_class_is_found_by_its_former_name():
    with pytest.warns(
        FutureWarning, match=r"^softrig_core.Held will go in softrig 0.4; use softrig_core.RunningBlock$"
    ):
        assert former.Held is RunningBlock
    with pytest.raises(AttributeError, match="no attribute 'holder'"):
        _ = former.holder
