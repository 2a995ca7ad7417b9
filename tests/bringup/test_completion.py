"""Completion in the shell, the list of scenarios, and what a node started by a person prints."""

import json
import os
import shutil
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace

import pytest
from conftest import PATIENCE, few, fork
from softrig_bringup.cli import main
from softrig_core.rig.options import RunOptions
from softrig_drives.dc_motor.sliding_mode import DcMotorSmc
from softrig_nodes.main import introduction
from softrig_nodes.processes.executables import find_executable
from softrig_optim.sweep import progress

SOFTRIG = Path(__file__).parents[2] / "scripts" / "softrig"


ASK = """
import json, os, sys
from softrig_bringup.cli import main
from softrig_core import load_scenario
load_scenario("dc_motor_smc")  # what each would import by itself
for k, line in enumerate(json.load(sys.stdin)):
    if os.fork() == 0:
        os.environ |= {"_ARGCOMPLETE": "1", "_ARGCOMPLETE_COMP_WORDBREAKS": "", "COMP_LINE": line,
                       "COMP_POINT": str(len(line)), "_ARGCOMPLETE_STDOUT_FILENAME": f"{sys.argv[1]}/{k}"}
        main()
    os.wait()
"""


def test_each_position_of_a_command_is_completed(tmp_path):
    exactly = {
        "ne": {"new"},
        "run dc_motor_smc_b5_p": {"dc_motor_smc_b5_pid"},
        "run dc_motor_smc_b2 --set dc_motor_smc.del": {"dc_motor_smc.delta="},
        "node softrig_drives dc_motor_smc_": {"dc_motor_smc_kalman"},
        "run lsrm_fuzzy --set v_": {"v_d="},
        "study lsrm_fuzzy --grid v_": {"v_d="},
        "run no_such --set ": set(),
        "bag inf": {"info"},
        "bag pla": {"play"},
        "bag inf'": set(),
    }
    among = {"run dc_motor_smc_b2 --": {"--external", "--mode"}, "run dc_motor_smc_b2 --mode ": {"inprocess"},
             "run dc_motor_smc_b2 --external ": {"motor_reference"}, "node soft": {"softrig_drives"},
             "check dc_motor_smc lsrm": {"lsrm_fuzzy"}, "bag play --": {"--remap"}}  # fmt: skip
    lines = [f"softrig {line}" for line in [*exactly, *among]]
    subprocess.run([sys.executable, "-c", ASK, str(tmp_path)], input=json.dumps(lines), text=True, timeout=PATIENCE,
                   capture_output=True, check=True)  # fmt: skip
    messages = [
        {word.rstrip() for word in (tmp_path / str(k)).read_text().split("\v") if word} for k in range(len(lines))
    ]
    assert dict(zip(exactly, messages, strict=False)) == exactly
    for line, expected, result in zip(among, among.values(), messages[len(exactly) :], strict=True):
        assert expected <= result, line


@pytest.mark.long
def test_bash_uses_it_for_the_scenarios_of_an_own_package_too(tmp_path):
    assert main(["new", "heater", "--into", str(tmp_path)]) == 0
    script = f"""eval "$('{SOFTRIG}' env --completion)"; COMP_WORDBREAKS=$' ='; compopt() {{ :; }}
        for COMP_LINE in 'softrig run dc_motor_smc_b5_p' 'softrig run heate'; do
            COMP_POINT=${{#COMP_LINE}}; _python_argcomplete '{SOFTRIG}'; echo "${{COMPREPLY[@]}}"
        done"""
    done = subprocess.run(["bash", "-c", script], capture_output=True, text=True, timeout=PATIENCE,
                          env=os.environ | {"SOFTRIG_WORKSPACE": str(tmp_path / "heater")})  # fmt: skip
    assert done.stdout.split() == ["dc_motor_smc_b5_pid", "heater"], done.stderr


@pytest.mark.parametrize("shell", ["zsh", "fish"])
def test_other_shells_get_a_script_that_they_can_read(shell, capsys):
    assert main(["env", "--completion", shell]) == 0
    printed = capsys.readouterr().out
    assert "softrig" in printed
    if shutil.which(shell):
        assert subprocess.run([shell, "-n", "/dev/stdin"], input=printed, text=True, timeout=PATIENCE).returncode == 0


@pytest.mark.parametrize("stray", few(["delta:=2", "--params-file", "-p"], 1))
def test_stray_arguments_of_a_node_are_refused(stray, tmp_path):
    logs = os.environ | {"ROS_LOG_DIR": str(tmp_path)}
    with ExitStack() as stack:
        done = fork(stack, "faultrig", "plant", [find_executable("faultrig", "plant"), stray], logs)
        printed, _ = done.communicate(PATIENCE)
        assert done.wait() == 2
    assert printed.startswith(f"plant: unexpected argument '{stray}': expected --ros-args")


def test_a_node_started_by_a_person_prints_what_it_is_and_waits_for():
    text = introduction(DcMotorSmc(), RunOptions())
    assert "waits for motor/state" in text
    assert "publishes motor/command" in text
    assert "\n" not in text


def test_quiet_prints_nothing_and_the_status_is_the_result(tmp_path, capsys):
    words = ["run", "dc_motor_smc_b2", "--mode", "inprocess", "--no-plots", "--out", str(tmp_path / "run")]
    assert main([*words, "--quiet"]) == 0
    assert (tmp_path / "run" / "metrics.json").is_file()
    assert capsys.readouterr() == ("", "")
    assert main(["list", "-q", "--figures", "final_value"]) == 0
    assert main(["list", "--figures", "final_value"]) == 0
    assert "Last value" in capsys.readouterr().out  # these lines are printed only without -q
    assert main(["bag", "info", "--quiet", str(tmp_path / "run" / "bag")]) == 0  # this verb has its own parser
    assert capsys.readouterr() == ("", "")
    assert main(["run", "-q", "dc_motor_smc_b9000", "--mode", "inprocess"]) == 2
    assert "dc_motor_smc_b9000" in capsys.readouterr().err  # errors are printed in spite of -q


def test_on_a_narrow_terminal_no_number_and_no_word_is_broken(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "50")
    words = ["run", "dc_motor_smc_b2", "--mode", "inprocess", "--no-plots", "--out", str(tmp_path / "run")]
    assert main(words) == 0
    lines = capsys.readouterr().out.splitlines()
    assert (
        lines[0].rstrip() == "dc_motor_smc_b2: DC motor rig, softened sliding"
    )  # the title fills the width of the terminal
    assert max(map(len, lines)) <= 50
    assert "rise_time  pass" in [line.rstrip() for line in lines]
    measured = json.loads((tmp_path / "run/metrics.json").read_text())["metrics"]
    text = " ".join(lines)
    for figure in measured:
        assert figure["name"] in text
        assert f"measured {figure['value']:.6g}" in " ".join(text.split())


def test_few_long_cases_show_progress_without_a_terminal(capsys, monkeypatch):
    now = iter(range(0, 100, 5))
    monkeypatch.setattr("softrig_optim.sweep.time", SimpleNamespace(monotonic=lambda: float(next(now))))
    with progress("scenarios", 6) as advance:
        for _ in range(6):
            advance()
    assert capsys.readouterr().err.splitlines() == ["softrig: scenarios: 3 of 6", "softrig: scenarios: 6 of 6"]
