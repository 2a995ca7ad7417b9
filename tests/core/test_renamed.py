"""Old names of executables and figures: each works as its new one for two versions, and one line says so."""

import re
import subprocess
import warnings
from importlib.metadata import version
from pathlib import Path

import pytest
from softrig_core import ScenarioError, load_scenario, renamed, simulate
from softrig_core.judge.registry import find, registered
from softrig_core.rig.installed import load_block
from softrig_nodes.processes.executables import find_executable

ROOT = Path(__file__).parents[2]
PACKAGES = [p.parent.name for p in sorted(ROOT.glob("ros_pkgs/*/setup.cfg"))]
OLD = [(package, old, new) for package in PACKAGES for old, new in renamed.former(package).items()]
EXECUTABLES = [o for o in OLD if o[1] != "dispatch_setpoint"]
EXTENDS = """
extends: {base}
title: mine
nodes:
  {node}: {{package: {package}, executable: {old}}}
"""


@pytest.fixture(autouse=True)
def nothing_reported(monkeypatch):
    monkeypatch.setattr(renamed, "_REPORTED", set())


def test_the_renamed_names_of_the_issue_exist():
    assert len(OLD) >= 10
    now, end = (tuple(map(int, v.split(".")[:2])) for v in (version("softrig_core"), renamed.END))
    assert now < end, "take the old names out of the setup.cfg files"


@pytest.mark.parametrize(("package", "old", "new"), EXECUTABLES)
def test_an_old_executable_is_the_new_one_and_in_no_list(package, old, new):
    assert load_block(package, old) is load_block(package, new)
    assert new in renamed.executables(package)
    assert old not in renamed.executables(package)
    with pytest.raises(ScenarioError) as error:
        load_block(package, "nothing_like_it")
    assert not re.search(rf"\b{old}\b", str(error.value).partition("it has")[2].replace(new, ""))


def test_a_scenario_with_an_old_name_runs_as_with_the_new_one(tmp_path):
    """Parameters that are inherited by the new name stay: it is no other executable."""
    values, runs = {}, {}
    for name in ("im_plant", "induction_dtc_plant"):
        file = tmp_path / f"{name}.yaml"
        file.write_text(EXTENDS.format(base="induction_dtc_s2", node="im_plant", package="softrig_drives", old=name))
        with warnings.catch_warnings(record=True) as text:
            warnings.simplefilter("always")
            values[name] = load_scenario(str(file)).nodes["im_plant"]
            runs[name] = simulate(str(file), duration=0.001).signals["currents_meas/x"][1].tolist()
        assert [str(w.message) for w in text if w.category is FutureWarning] == (
            [renamed.notice("softrig_drives", "im_plant")] if name == "im_plant" else []
        )
    assert values["im_plant"] == values["induction_dtc_plant"]
    assert values["im_plant"].parameters == load_scenario("induction_dtc_s2").nodes["im_plant"].parameters != {}
    assert runs["im_plant"] == runs["induction_dtc_plant"]


def test_a_name_that_is_old_in_one_package_may_be_new_in_another():
    assert renamed.current("softrig_power", "gpc_controller") == "rectifier_gpc"
    assert renamed.current("softrig_control", "gpc_controller") == "gpc_controller"
    assert renamed.current("no_such_package", "gpc_controller") == "gpc_controller"


def test_an_old_figure_is_the_new_one():
    with pytest.warns(FutureWarning, match="dispatch_set_point now"):
        assert find("dispatch_setpoint") is find("dispatch_set_point")
    assert "dispatch_setpoint" not in registered()


def test_an_old_node_name_is_reported_in_one_line():
    program = find_executable("softrig_robots", "vcs_controller")
    ran = subprocess.run([program, "--help"], capture_output=True, text=True, timeout=60)
    assert ran.stderr == f"vcs_controller: {renamed.notice('softrig_robots', 'vcs_controller')}\n"


def test_a_command_reports_an_old_name_in_one_line_without_a_place_in_python(tmp_path, capsys):
    from softrig_bringup.cli import main

    file = tmp_path / "mine.yaml"
    file.write_text(EXTENDS.format(base="rehab_impedance", node="prom_reference", package="softrig_robots",
                                   old="prom_reference"))  # fmt: skip
    assert main(["list", "--signals", str(file)]) == 0
    assert capsys.readouterr().err == f"softrig: {renamed.notice('softrig_robots', 'prom_reference')}\n"
