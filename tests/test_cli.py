"""The command line as a user calls it: exit status, files, one line for every mistake."""

import json
import os
import subprocess
import sys
import types
from pathlib import Path

import pytest
from softrig_bringup.cli import main
from softrig_bringup.run import gaps
from softrig_core.recording import Recording
from softrig_core.rig import Rig
from softrig_core.scenario import load_scenario

SCENARIO = """
title: First-order lag
system: lag
source: none
duration: 1.0
nodes:
  plant: {package: faultrig, executable: plant}
  source: {package: faultrig, executable: source}
  gain: {package: faultrig, executable: gain, parameters: {noise: 0.01}}
metrics:
  - {name: last, function: final_value, arguments: {signal: lag/state/x/position}, unit: m, published: 0.3,
     expected: 0.3, tolerance: 0.2}
plots:
  - {title: Position, signals: {lag/state/x/position: x}}
variants:
  misses:
    metrics: [{name: last, function: final_value, arguments: {signal: lag/state/x/position}, expected: 9.0}]
  typo:
    metrics: [{name: last, function: finalvalue, arguments: {}}]
  breaks:
    nodes: {gain: {executable: killed, parameters: {how: nan, at: 0.5, noise: null}}}
"""


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    (tmp_path / "lag.yaml").write_text(SCENARIO)
    monkeypatch.setenv("SOFTRIG_SCENARIOS", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(*arguments):
    return main(["run", *arguments])


def test_a_run_leaves_bag_metrics_plots_and_report(folder, capsys):
    assert run("lag", "--mode", "inprocess", "--seed", "4", "--set", "gain.k=1.5") == 0
    out = folder / "runs" / "lag"
    content = json.loads((out / "metrics.json").read_text())
    assert (content["scenario"], content["mode"], content["seed"], content["ticks"]) == ("lag", "inprocess", 4, 100)
    assert content["parameters"]["gain"]["k"] == 1.5
    (metric,) = content["metrics"]
    assert metric["pass"] is True
    assert metric["published"] == 0.3
    assert content["command"] == "scripts/softrig run lag --mode inprocess --set gain.k=1.5 --seed 4"
    assert (out / "bag" / "metadata.yaml").is_file()
    assert list(out.glob("plot_*.png"))
    assert "<html" in (out / "report.html").read_text()
    printed = capsys.readouterr().out
    assert "last" in printed
    assert "pass" in printed


def test_exit_status_tells_a_miss_from_a_mistake_from_a_break(folder, capsys):
    assert run("lag_misses", "--mode", "inprocess", "--no-record") == 1
    assert not (folder / "runs" / "lag_misses" / "bag").exists()
    assert run("nothing", "--mode", "inprocess") == 2
    assert run("lag_typo", "--mode", "inprocess") == 2
    assert run("lag", "--mode", "inprocess", "--set", "gain.kk=1") == 2
    assert run("lag", "--mode", "inprocess", "--set", "k=1") == 2
    assert run("lag", "--mode", "inprocess", "--duration", "-1") == 2
    capsys.readouterr()
    assert run("lag_breaks", "--mode", "inprocess") == 3
    error = capsys.readouterr().err
    assert "the run broke: gain: command u/effort became nan at t = 0.5 s" in error
    assert json.loads((folder / "runs" / "lag_breaks" / "metrics.json").read_text())["error"]


@pytest.mark.processes
def test_processes_and_inprocess_leave_the_same_bag(folder):
    assert run("lag", "--out", "a") == 0
    assert run("lag", "--out", "b", "--mode", "inprocess") == 0
    bags = [sorted((folder / name / "bag").glob("*.mcap")) for name in "ab"]
    assert [f.name for f in bags[0]] == [f.name for f in bags[1]]
    assert main(["compare", "--bitwise", "a/bag", "b/bag"]) == 0


@pytest.mark.processes
def test_a_broken_run_through_processes_leaves_a_readable_bag(folder):
    from softrig_bags.read import read_bag

    assert run("lag_breaks") == 3
    recording = read_bag(folder / "runs" / "lag_breaks" / "bag")
    assert len(recording.topics["lag/state"].times) == 51


def test_a_second_run_replaces_the_first(folder):
    assert run("lag", "--mode", "inprocess", "--out", "x") == 0
    (folder / "x" / "mine.txt").write_text("keep")
    assert run("lag", "--mode", "inprocess", "--out", "x", "--no-plots") == 0
    assert not (folder / "x" / "report.html").exists()
    assert (folder / "x" / "mine.txt").exists()


def test_list_and_report(folder, capsys):
    assert main(["list"]) == 0
    assert "lag_misses" in capsys.readouterr().out
    run("lag", "--mode", "inprocess", "--no-record")
    run("lag_misses", "--mode", "inprocess", "--no-record")
    assert main(["report", "runs/lag", "runs/lag_misses", "--out", "all.html"]) == 0
    assert (folder / "all.html").read_text().count("First-order lag") >= 2
    assert main(["report", "runs/none"]) == 2


def test_a_gap_is_found(folder):
    rig = Rig.from_scenario(load_scenario("lag"))
    recording = Recording((t, p.msgtype) for t, p in rig.topics.items())
    for topic, port in enumerate(rig.topics.values()):
        for k in range(101 if port.topic in ("/clock", "lag/state", "lag/applied") else 100):
            if not (port.topic == "lag/state" and k == 7) and port.topic not in ("lag/offset", "lag/kick"):
                recording.add(topic, k * 10_000_000, b"")
    assert gaps(rig, recording) == "lag/state: 100 messages of 101, first gap at t = 0.07 s"


def test_the_node_verb_is_the_executable(folder):
    done = subprocess.run(
        [sys.executable, "-m", "softrig_bringup", "node", "faultrig", "plant", "--ros-args", "-p", "gain:=0.0"],
        capture_output=True, text=True, timeout=60, env=os.environ | {"ROS_LOG_DIR": str(folder)},
    )  # fmt: skip
    assert done.returncode == 2
    assert done.stderr.strip() == "plant: parameter gain = 0.0: input should be greater than 0"
    assert main(["node", "faultrig", "plnt"]) == 2


def test_a_node_explains_itself():
    done = subprocess.run([sys.executable, "-m", "softrig_bringup", "node", "softrig_drives", "dc_motor_smc", "--help"],
                          capture_output=True, text=True, timeout=60)  # fmt: skip
    assert done.returncode == 0
    assert "reads motor/state" in done.stdout
    assert "delta = 0.0 rad/s^2: softening" in done.stdout
    assert "run.mode = 'realtime'" in done.stdout


def test_the_launch_file_starts_the_nodes_of_a_scenario(monkeypatch):
    """Launch is not in the package registries, so its few classes are stand-ins that keep what they are given."""

    class Kept:
        def __init__(self, *arguments, **keywords):
            self.arguments, self.keywords = arguments, keywords

    class Configuration(Kept):
        def perform(self, context):
            return context[self.arguments[0]]

    names = {"launch": {"LaunchDescription": Kept}, "launch.substitutions": {"LaunchConfiguration": Configuration},
             "launch.actions": {"DeclareLaunchArgument": Kept, "OpaqueFunction": Kept}, "launch_ros": {},
             "launch_ros.actions": {"Node": Kept}}  # fmt: skip
    for name, content in names.items():
        module = types.ModuleType(name)
        module.__dict__.update(content)
        monkeypatch.setitem(sys.modules, name, module)
    file = Path(__file__).parents[1] / "ros_pkgs" / "softrig_bringup" / "launch" / "rig.launch.py"
    namespace = {}
    exec(compile(file.read_text(), str(file), "exec"), namespace)
    nodes = namespace["_nodes"]({"scenario": "lag", "mode": "lockstep", "seed": ""})
    assert [n.keywords["executable"] for n in nodes] == ["plant", "source", "gain"]
    assert nodes[2].keywords["parameters"][0]["noise"] == 0.01
    assert nodes[2].keywords["parameters"][0]["run.mode"] == "lockstep"
