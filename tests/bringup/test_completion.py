"""Completion in the shell, the list of scenarios, and what a node says to who starts it by hand."""

import os
import subprocess
from contextlib import ExitStack
from pathlib import Path

import pytest
from conftest import PATIENCE, fork
from softrig_bringup.cli import _parser, main
from softrig_bringup.completion import candidates
from softrig_core.node.startup import introduction
from softrig_core.rig.executables import find_executable
from softrig_core.rig.options import RunOptions
from softrig_drives.dc_motor.sliding_mode import DcMotorSmc

SOFTRIG = Path(__file__).parents[2] / "scripts" / "softrig"


def offered(*words):
    return candidates(_parser(), list(words))


def test_each_place_of_a_command_is_completed():
    assert offered("ne") == ["new"]
    assert offered("run", "dc_motor_smc_b5_p") == ["dc_motor_smc_b5_pid"]
    assert "--external" in offered("run", "dc_motor_smc_b2", "--")
    assert "inprocess" in offered("run", "dc_motor_smc_b2", "--mode", "")
    assert offered("run", "dc_motor_smc_b2", "--set", "dc_motor_smc.del") == ["dc_motor_smc.delta="]
    assert "motor_reference" in offered("run", "dc_motor_smc_b2", "--external", "")
    assert "softrig_drives" in offered("node", "soft")
    assert offered("node", "softrig_drives", "dc_motor_smc_") == ["dc_motor_smc_kalman"]
    assert offered("run", "lsrm_fuzzy", "--set", "v_") == ["v_d="]
    assert offered("run", "no_such", "--set", "") == []
    assert offered("nonsense", "") == []


def test_bash_uses_it():
    script = f"""eval "$('{SOFTRIG}' completion)"; COMP_WORDS=('{SOFTRIG}' run dc_motor_smc_b5_p); COMP_CWORD=2
        compopt() {{ :; }}; _softrig; echo "${{COMPREPLY[@]}}" """
    done = subprocess.run(["bash", "-c", script], capture_output=True, text=True, timeout=PATIENCE)
    assert done.stdout == "dc_motor_smc_b5_pid\n", done.stderr


def test_the_list_is_a_tree_where_it_is_narrow_and_one_line_a_scenario_in_a_pipe(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "60")
    assert main(["list", "dc_motor_smc"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("dc_motor")
    assert max(map(len, lines)) <= 60
    branch = next(i for i, line in enumerate(lines) if "dc_motor_smc_b5 " in line)
    assert lines[branch].index("dc_motor_smc") < next(x for x in lines if "dc_motor_smc_b5_pid" in x).index(
        "dc_motor_smc"
    )
    monkeypatch.delenv("COLUMNS")
    assert main(["list", "dc_motor_smc_b5_pid"]) == 0
    (line,) = capsys.readouterr().out.splitlines()
    assert line.split("\t")[:3] == ["dc_motor_smc_b5_pid", "dc_motor", "10 s"]


@pytest.mark.parametrize("stray", ["delta:=2", "--params-file", "-p"])
def test_stray_arguments_of_a_node_are_refused(stray, tmp_path):
    logs = os.environ | {"ROS_LOG_DIR": str(tmp_path)}
    with ExitStack() as stack:
        done = fork(stack, "faultrig", "plant", [find_executable("faultrig", "plant"), stray], logs)
        said, _ = done.communicate(PATIENCE)
        assert done.wait() == 2
    assert said.startswith(f"plant: unexpected argument '{stray}': expected --ros-args")


def test_a_node_by_hand_says_what_it_is_and_waits_for():
    text = introduction(DcMotorSmc(), RunOptions())
    assert "waits for motor/state" in text
    assert "publishes motor/command" in text
    assert "\n" not in text
