"""The command line as a user calls it: exit status, files, one line for every error."""

import hashlib
import importlib
import io
import json
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest
from conftest import PATIENCE, few
from softrig_bags.files.reader import BagReader
from softrig_bringup.cli import main, make_parser
from softrig_bringup.options.run_options import folder_name, repeat
from softrig_bringup.plots.pictures import plot_run
from softrig_bringup.run.run import checkout, gaps, summary
from softrig_bringup.verbs.run_verb import _announce
from softrig_core import Recording, Rig, Run, figure, load_scenario, rig_of, run_inprocess, simulate
from softrig_core.guard import guarded
from softrig_core.scenario.plot_entry import PlotEntry
from softrig_core.scenario.scenario_file import locate
from softrig_core.wire import signals

SCRIPTS = Path(__file__).parents[2] / "scripts"

SCENARIO = """
title: First-order lag
system: lag
source: none
duration: 1.0
nodes:
  plant: {package: faultrig, executable: plant}
  source: {package: faultrig, executable: source}
  gain: {package: faultrig, executable: gain, parameters: {noise: 0.01}}
figures:
  last: {function: final_value, arguments: {signal: lag/state/x/position}, unit: m}
expect: {last: between 0.1 and 0.5}
claims:
  last: {published: 0.3, tolerance: 0.2, where: nowhere, verdict: reproduced}
plots:
  - {title: Position, signals: {lag/state/x/position: x}}
variants:
  misses:
    expect: {last: 9.0}
  shares:
    shared: {k: 2.0}
    nodes: {gain: {parameters: {k: $k}}}
  watched:
    nodes: {watcher: {package: faultrig, executable: watcher}}
  typo:
    figures: {last: {function: finalvalue}}
  plot_typo:
    plots: [{title: Position, signals: {lag/state/y/position: y}}]
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
    out = folder / "runs" / "lag-gain.k=1.5-seed_4"
    content = json.loads((out / "metrics.json").read_text())
    assert (content["scenario"], content["mode"], content["seed"], content["ticks"]) == ("lag", "inprocess", 4, 100)
    assert content["parameters"]["gain"]["k"] == 1.5
    (metric,) = content["metrics"]
    assert metric["pass"] is True
    assert metric["published"] == 0.3
    command = f"run {folder / 'lag.yaml'} --mode inprocess --set gain.k=1.5 --seed 4"
    assert content["command"].partition(" ")[2] == command  # the printed command must also work in another folder
    assert (out / "bag" / "metadata.yaml").is_file()
    assert list(out.glob("plot_*.svg"))
    assert "<html" in (out / "report.html").read_text()
    printed = capsys.readouterr().out
    assert "last" in printed
    assert "not judged" in printed


def test_a_negative_number_in_scientific_notation_is_not_an_option():
    assert make_parser().parse_args(["set", "law.k", "-1e-3"]).values == ["law.k", "-1e-3"]


def test_a_shared_value_is_set_by_its_name_and_the_rig_is_built_once(folder, monkeypatch):
    built = []
    from_scenario = Rig.from_scenario
    monkeypatch.setattr(
        Rig, "from_scenario", lambda scenario, classes: built.append(scenario.name) or from_scenario(scenario, classes)
    )
    assert run("lag_shares", "--mode", "inprocess", "--set", "k=1.5", "--no-plots", "--no-record", "--out", "own") == 0
    assert json.loads((folder / "own" / "metrics.json").read_text())["parameters"]["gain"]["k"] == 1.5
    assert built == ["lag_shares"]


def test_the_last_figures_of_an_observer_are_in_metrics_and_bag(folder):
    assert run("lag_watched", "--mode", "inprocess", "--no-plots", "--out", "seen") == 0
    figures = {"seen": [101.0, ""]}
    assert json.loads((folder / "seen" / "metrics.json").read_text())["nodes"]["watcher"]["figures"] == figures
    with BagReader(folder / "seen" / "bag") as bag:
        assert json.loads(bag.custom_data["observed"]) == {"watcher": figures}


@pytest.mark.processes
def test_a_run_whose_outside_node_never_starts_has_no_figures(folder, capsys):
    assert run("lag", "--external", "gain", "--realtime", "--wait", "1", "--no-plots", "--out", "alone") == 3
    content = json.loads((folder / "alone" / "metrics.json").read_text())
    assert "not all peers after 1 s" in content["error"]
    assert (content["metrics"], content["ticks"]) == ([], 0)
    assert "pass" not in capsys.readouterr().out


def test_the_exit_status_distinguishes_a_miss_a_mistake_and_a_broken_run(folder, capsys):
    assert run("lag_misses", "--mode", "inprocess", "--no-record", "--no-plots") == 1
    assert not (folder / "runs" / "lag_misses" / "bag").exists()
    assert run("nothing", "--mode", "inprocess") == 2
    assert run("lag_typo", "--mode", "inprocess") == 2
    assert run("lag", "--mode", "inprocess", "--set", "gain.kk=1") == 2
    assert run("lag", "--mode", "inprocess", "--set", "k=1") == 2
    assert run("lag", "--mode", "inprocess", "--duration", "-1") == 2
    capsys.readouterr()
    assert run("lag_breaks", "--mode", "inprocess", "--no-plots") == 3
    error = capsys.readouterr().err
    assert "the run broke: gain: command u/effort became nan at t = 0.5 s" in error
    assert json.loads((folder / "runs" / "lag_breaks" / "metrics.json").read_text())["error"]


def test_the_command_accepts_what_launch_passes_to_every_executable(folder, capsys):
    assert main(["list", "--signals", "lag", "--ros-args", "--log-level", "info", "-r", "__node:=softrig"]) == 0
    assert "lag/state/x/position" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("lag", "--set", "gain.k=[1"), "--set 'gain.k=[1': not valid YAML: while parsing a flow sequence"),
        (("lag", "--seed", "-1"), "run: argument --seed: expected a whole number from 0 to 9.22337e+18, got '-1'"),
        (
            ("lag_plot_typo",),
            "plot 'Position': no signal 'lag/state/y/position' (did you mean 'lag/state/x/position'?)",
        ),
    ],
)
def test_a_mistake_is_one_line_before_the_run(folder, capsys, monkeypatch, arguments, message):
    monkeypatch.setattr("softrig_bringup.run.run.run_inprocess", None)  # no run may start
    assert run(*arguments, "--mode", "inprocess") == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"softrig: {message}")
    assert not (folder / "runs" / arguments[0] / "metrics.json").exists()


@pytest.mark.parametrize("error", [AttributeError, IndexError, KeyError, TypeError, ValueError, ZeroDivisionError])
def test_a_metric_that_cannot_be_computed_is_a_miss_with_its_reason(folder, monkeypatch, error):
    def broken(signals, signal):
        raise error("no such thing")

    monkeypatch.setattr("softrig_core.judge.measures.final_value", figure("{signal}")(broken))
    assert run("lag", "--mode", "inprocess", "--no-record", "--no-plots") == 1
    (metric,) = json.loads((folder / "runs" / "lag" / "metrics.json").read_text())["metrics"]
    assert (metric["value"], metric["pass"]) == (None, False)
    assert "no such thing" in metric["error"]


def test_metrics_and_pictures_share_the_decoded_signals(monkeypatch):
    decoded = []
    joined = signals.Signals._joined

    def noted(self, topic, parts):
        decoded.append(topic.name)
        return joined(self, topic, parts)

    monkeypatch.setattr(signals.Signals, "_joined", noted)
    assert run("lag", "--mode", "inprocess", "--no-record") == 0
    assert sorted(decoded) == sorted(set(decoded))
    assert "lag/state" in decoded


def test_the_command_of_a_run_repeats_it_from_any_folder(folder):
    arguments = ["lag", "--mode", "container", "--realtime", "--set", "gain.k=2", "--external", "gain",
                 "--duration", "0.5", "--seed", "3", "--domain", "42"]  # fmt: skip
    result = repeat(make_parser().parse_args(["run", *arguments, "--out", "x"]))
    assert result == [str(folder / "lag.yaml"), *arguments[1:], "--out", str(folder / "x")]
    # a shipped scenario is found from every folder
    assert repeat(make_parser().parse_args(["run", "dc_motor_smc_b2"]))[0] == "dc_motor_smc_b2"


def test_an_invalid_or_used_domain_is_one_line(capsys):
    """Two runs in one domain would read each other's messages."""
    from softrig_nodes.processes.domain import free_domain

    assert main(["run", "dc_motor_smc", "--domain", "233"]) == 2
    assert "argument --domain: expected a whole number from 0 to 232, got '233'" in capsys.readouterr().err
    with free_domain() as domain:
        assert main(["run", "dc_motor_smc", "--domain", str(domain)]) == 3
    assert f"domain {domain} is in use by other runs" in capsys.readouterr().err


@pytest.mark.long
@pytest.mark.processes
def test_processes_and_inprocess_leave_the_same_bag(folder):
    assert run("lag", "--out", "a", "--no-plots") == 0
    assert run("lag", "--out", "b", "--mode", "inprocess", "--no-plots") == 0
    bags = [sorted((folder / name / "bag").glob("*.mcap")) for name in "ab"]
    assert [f.name for f in bags[0]] == [f.name for f in bags[1]]
    assert main(["bag", "compare", "--bitwise", "a/bag", "b/bag"]) == 0


@pytest.mark.long
@pytest.mark.processes
def test_a_broken_run_through_processes_leaves_a_readable_bag(folder):
    from softrig_bags.read import read_bag

    assert run("lag_breaks", "--no-plots") == 3
    recording = read_bag(folder / "runs" / "lag_breaks" / "bag")
    assert len(recording.topics["lag/state"].times) == 51


def test_a_second_run_replaces_the_first(folder):
    assert run("lag", "--mode", "inprocess", "--out", "x") == 0
    (folder / "x" / "mine.txt").write_text("keep")
    assert run("lag", "--mode", "inprocess", "--out", "x", "--no-plots") == 0
    assert not (folder / "x" / "report.html").exists()
    assert (folder / "x" / "mine.txt").exists()


def test_a_report_of_two_runs_and_of_none(folder):
    run("lag", "--mode", "inprocess", "--no-record", "--no-plots")
    run("lag_misses", "--mode", "inprocess", "--no-record", "--no-plots")
    assert main(["report", "runs/lag", "runs/lag_misses", "--out", "all.html"]) == 0
    assert (folder / "all.html").read_text().count("First-order lag") >= 2
    assert main(["report", "runs/none"]) == 2


def test_a_report_distinguishes_runs_and_names_what_it_leaves_out(folder):
    for k in ("1.2", "1.3"):
        run("lag", "--mode", "inprocess", "--no-record", "--no-plots", "--set", f"gain.k={k}", "--out", k)
    (folder / "empty").mkdir()
    assert main(["report", "1.2", "empty", "1.3", "--out", "all.html"]) == 0
    page = (folder / "all.html").read_text()
    assert '<a href="#run-1">1.2</a>' in page
    assert '<a href="#run-2">1.3</a>' in page
    assert "lag, gain.k=1.3" in page
    assert "compared, not judged" in page
    assert "Left out, without a metrics.json: empty" in page
    assert main(["report", "empty"]) == 2
    assert main(["report", "1.2", "--label", "soft", "--label", "hard", "--out", "one.html"]) == 2
    assert main(["report", "1.2", "1.3", "--label", "soft", "--out", "all.html"]) == 0
    assert '<a href="#run-1">soft</a>' in (folder / "all.html").read_text()


def test_the_version_is_printed(capsys):
    with pytest.raises(SystemExit) as ended:
        main(["--version"])
    assert ended.value.code == 0
    assert re.match(r"softrig \d+\.\d+", capsys.readouterr().out)


def test_a_run_keeps_the_commit_and_the_lock_file(folder, monkeypatch):
    monkeypatch.setenv("SOFTRIG_COMMAND", str(SCRIPTS / "softrig"))
    checkout.cache_clear()
    run("lag", "--mode", "inprocess", "--no-record", "--no-plots")
    versions = json.loads((folder / "runs" / "lag" / "metrics.json").read_text())["versions"]
    lock = (SCRIPTS / "locks" / "run.lock").read_bytes()
    assert versions["run.lock"] == f"sha256:{hashlib.sha256(lock).hexdigest()}"
    if (SCRIPTS.parent / ".git").exists():
        assert re.fullmatch(r"[0-9a-f]{40}\+?", versions["commit"])


@pytest.mark.parametrize(
    ("mode", "where"),
    [
        ("inprocess", "softrig_bringup.verbs.run_verb.summary"),
        pytest.param("container", "softrig_nodes.processes.processes.stop", marks=pytest.mark.processes),
        pytest.param(
            "container",
            "softrig_nodes.processes.processes.gathered",
            marks=[pytest.mark.processes, pytest.mark.long],
        ),
    ],
)
def test_a_signal_after_the_last_tick_loses_nothing(mode, where, tmp_path, monkeypatch):
    module, _, name = where.rpartition(".")
    real = getattr(importlib.import_module(module), name)

    def interrupted(*arguments, **keywords):
        signal.raise_signal(signal.SIGINT)
        return real(*arguments, **keywords)

    monkeypatch.setattr(where, interrupted)
    out = tmp_path / "run"
    command = ["run", "dc_motor_smc_b2", "--mode", mode, "--out", str(out), "--duration", "0.02"]
    assert main(command) == 130
    with BagReader(out / "bag") as bag:
        assert max(t for _, t, _ in bag.messages()) == 20_000_000
    assert (out / "metrics.json").exists()


def test_a_stopped_run_reports_what_it_did_and_judges_nothing(folder, monkeypatch, capsys):
    def stopping(rig, seed, recording, progress, **keys):
        stop = lambda t: os.kill(os.getpid(), signal.SIGTERM) if t >= 5e8 else None  # noqa: E731
        run_inprocess(rig, seed, recording, stop, **keys)

    monkeypatch.setattr("softrig_bringup.run.run.run_inprocess", stopping)
    assert run("lag", "--mode", "inprocess", "--no-record") == 143
    out = " ".join(capsys.readouterr().out.split())
    content = json.loads((folder / "runs" / "lag" / "metrics.json").read_text())
    assert 0.5 <= content["reached_s"] < 0.6
    assert f"inprocess: {content['ticks']} ticks, {content['reached_s']:.6g} of 1 s simulated" in out
    assert content["ticks"] == round(content["reached_s"] * 100)
    assert not {"pass", "differs", "MISS"} & set(out.split())
    page = (folder / "runs" / "lag" / "report.html").read_text()
    assert f"{content['reached_s']:.6g} of 1 s" in page
    assert "differs" not in page


def test_strict_and_junit_judge_a_changed_run(folder):
    changed = ["lag", "--mode", "inprocess", "--no-record", "--no-plots", "--set", "gain.k=9", "--junit", "unit.xml"]
    assert run(*changed) == 0
    assert ElementTree.parse(folder / "unit.xml").getroot().get("failures") == "0"
    assert run(*changed, "--strict") == 1
    root = ElementTree.parse(folder / "unit.xml").getroot()
    assert int(root.get("failures")) >= 1
    assert root.find(".//testcase[@name='last']/failure") is not None
    assert run("lag_breaks", "--mode", "inprocess", "--no-record", "--no-plots", "--junit", "unit.xml") == 3
    assert ElementTree.parse(folder / "unit.xml").getroot().get("errors") == "1"


@pytest.mark.parametrize(("options", "status"), [([], 0), (["--max-missed", "50"], 1), (["--max-missed", "76.8"], 0)])
def test_a_run_that_missed_most_deadlines_does_not_pass(folder, monkeypatch, capsys, options, status):
    def late(scenario, *_):
        done = simulate(scenario)
        done.status = {"plant": {"state": "done", "ticks": 232, "missed_deadlines": 768}, "gain": {"ticks": 100}}
        return done

    monkeypatch.setattr("softrig_bringup.verbs.run_verb.execute", late)
    assert run("lag", "--realtime", "--no-record", "--no-plots", *options) == status
    first = capsys.readouterr().err.partition("\n")[0]
    slow = first.startswith("softrig: the machine did not keep up: plant missed 76.8 % of its deadlines; ")
    slow &= first.endswith("of a slower loop, --mode container is faster")
    # The run missed exactly 76.8 % of its ticks, which is allowed.
    assert slow == (options != ["--max-missed", "76.8"])


def test_work_that_was_late_is_named_first(folder, monkeypatch, capsys):
    def late(scenario, *_):
        done = simulate(scenario)
        done.status = {"gain": {"ticks": 100, "missed_deadlines": 0, "reports": {"unfinished": [0, "not done", 3]}}}
        return done

    monkeypatch.setattr("softrig_bringup.verbs.run_verb.execute", late)
    run("lag", "--realtime", "--no-record", "--no-plots")
    text = "the machine did not keep up: the result of gain was late at 3 of its ticks; "
    assert capsys.readouterr().err.startswith(f"softrig: {text}the figures are of a slower loop\n")


def test_what_was_not_simulated_is_not_measured_and_an_event_that_never_happens_is_never(folder, capsys):
    x = {"signal": "lag/state/x/position"}
    settings = {
        "late": {"function": "final_value", "arguments": {**x, "start": 0.9}},
        "rise": {"function": "reach_time", "arguments": {**x, "level": 9.0}},
    }
    (folder / "short.yaml").write_text(
        json.dumps({"title": "Short", "extends": "lag", "figures": settings, "expect": {"late": 0.4, "rise": 0.1}})
    )
    assert run("short", "--mode", "inprocess", "--duration", "0.5", "--no-record") == 0
    rows = {line.split()[0]: line.split() for line in capsys.readouterr().out.splitlines() if line.split()}
    assert rows["late"][1:3] == ["not", "measured"]
    assert "differs" not in rows["late"]
    assert (rows["rise"][1], rows["rise"][-2:]) == ("never", ["not", "judged"])
    page = (folder / "runs" / "short-duration_0.5" / "report.html").read_text()
    assert "never" in page
    assert "the result is inf" not in page
    assert page.count(">not judged<") == 2  # the run, and the figure that was never measured


def test_an_outside_law_leaves_no_parameters_title_or_pictures_of_the_node_it_replaces(folder):
    outside = load_scenario("lag", {}).model_copy(
        update={"plots": (PlotEntry(title="Law", signals={"lag/command/u/effort": "u"}),)}
    )
    nodes = dict(outside.nodes)
    nodes["gain"] = nodes["gain"].model_copy(update={"external": True})
    rig = rig_of(outside.model_copy(update={"nodes": nodes}))
    content = summary(Run(rig, 0, Recording((t, p.msgtype) for t, p in rig.topics.items())), [], "", "my PI")
    assert sorted(content["parameters"]) == ["plant", "source"] == sorted(content["units"])
    assert content["label"] == "my PI"
    source = simulate(rig_of(outside)).recording
    source.topics["lag/command"].times.clear()
    source.topics["lag/command"].data.clear()
    assert [p.name for p in plot_run(signals.Signals(source), rig, folder)] == ["overview.svg"]


def test_a_gap_is_found(folder):
    rig = rig_of("lag")
    recording = Recording((t, p.msgtype) for t, p in rig.topics.items())
    for topic, port in enumerate(rig.topics.values()):
        for k in range(101 if port.topic in ("/clock", "lag/state", "lag/applied") else 100):
            if not (port.topic == "lag/state" and k == 7) and port.topic not in ("lag/offset", "lag/kick"):
                recording.add(topic, k * 10_000_000, b"")
    assert gaps(rig, recording) == "lag/state: 100 messages of 101, first gap at t = 0.07 s"


@pytest.mark.long
def test_the_node_verb_is_the_executable(folder):
    done = subprocess.run(
        [sys.executable, "-m", "softrig_bringup", "node", "faultrig", "plant", "--ros-args", "-p", "gain:=0.0"],
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        env=os.environ | {"ROS_LOG_DIR": str(folder)},
    )
    assert done.returncode == 2
    assert done.stderr.strip() == "plant: parameter gain = 0.0: input should be greater than 0"
    assert main(["node", "faultrig", "plnt"]) == 2


def test_a_node_explains_itself():
    done = subprocess.run(
        [sys.executable, "-m", "softrig_bringup", "node", "softrig_drives", "dc_motor_smc", "--help"],
        capture_output=True,
        text=True,
        timeout=PATIENCE,
    )
    assert done.returncode == 0
    assert "reads motor/state" in done.stdout
    assert "delta = 0.0 rad/s^2: softening" in done.stdout
    assert "run.mode = 'realtime'" in done.stdout


# This script replaces Python, uv and what they install, so that set-up needs neither minutes nor a network. It logs
# its arguments.
STUB = """#!/bin/bash
echo "$(basename "$0") $*" >>"$HOME/calls"
case "$*" in
*-m" "venv*) mkdir -p "${@: -1}/bin"; cp "$0" "${@: -1}/bin/python" ;;
*uv.lock) [ -n "$NO_UV" ] && exit 1; cp "$0" "$(dirname "$0")/uv" ;;
*layout.py*) sleep "${SETUP_S:-0}"; mkdir -p "${@: -1}/lib/softrig_bringup"
    echo 'export PYTHONPATH=/built AMENT_PREFIX_PATH=/built' >"${@: -1}/setup.sh"
    install -m 755 /dev/null "${@: -1}/lib/softrig_bringup/softrig" ;;
esac
"""


@pytest.fixture
def bare(tmp_path):
    """A checkout without a set-up, on a machine with only the stub; returns its environment."""
    for folder in ("scripts", "ros_pkgs/here", "config/scenarios", "bin"):
        (tmp_path / folder).mkdir(parents=True)
    for file in ("setup.py", "setup.cfg", "package.xml"):
        (tmp_path / "ros_pkgs" / "here" / file).touch()
    (tmp_path / "scripts" / "locks").mkdir()
    for file in ("locks/run.lock", "locks/uv.lock", "softrig", "layout.py"):
        shutil.copy(SCRIPTS / file, tmp_path / "scripts" / file)
    stub = tmp_path / "bin" / "python3.13"
    stub.write_text(STUB)
    stub.chmod(0o755)
    return {"PATH": f"{tmp_path / 'bin'}:/usr/bin:/bin", "HOME": str(tmp_path)}


def test_a_call_that_waited_for_another_set_up_uses_its_result(bare, tmp_path):
    calls = [
        subprocess.Popen(
            [tmp_path / "scripts" / "softrig", "env"],
            env=bare | {"SETUP_S": "1"},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for _ in range(2)
    ]
    (first, printed), (second, also) = (call.communicate(timeout=PATIENCE) for call in calls)
    assert [call.returncode for call in calls] == [0, 0], printed + also
    # One call did the set-up while the other waited.
    assert sorted(("ready after" in printed, "ready after" in also)) == [False, True]
    assert first == second
    assert f"export SOFTRIG_SCENARIOS={tmp_path}/config/scenarios" in first
    assert "export AMENT_PREFIX_PATH=/built" in first
    installs = [c for c in (tmp_path / "calls").read_text().splitlines() if " install " in c]
    # pip installs uv, and uv installs all other packages, each once.
    assert [c.split()[0] for c in installs] == ["python", "uv"]
    assert all("--require-hashes" in c for c in installs)


def test_pip_is_used_without_uv_and_a_shared_environment_is_not_installed_twice(bare, tmp_path):
    def softrig(*arguments, **variables):
        return subprocess.run([tmp_path / "scripts" / "softrig", *arguments], env=bare | variables, timeout=60,
                              stdin=subprocess.DEVNULL, capture_output=True, text=True)  # fmt: skip

    assert softrig("setup", NO_UV="1", SOFTRIG_WHEELS="bin").returncode == 0
    installs = [c for c in (tmp_path / "calls").read_text().splitlines() if " install " in c]
    assert len(installs) == 2
    for call in installs:  # pip installs from the folder, verifies the digests and does not use the network
        assert call.startswith("python -m pip install ")
        assert f" --require-hashes --no-index --find-links {tmp_path}/bin -r {tmp_path}" in call
    shutil.rmtree(tmp_path / ".ws")  # simulates another checkout whose .venv is a link to this one
    assert softrig("setup").returncode == 0
    assert [c for c in (tmp_path / "calls").read_text().splitlines() if " install " in c] == installs
    (tmp_path / ".venv" / "share" / "softrig" / "run").unlink()
    shutil.rmtree(tmp_path / ".ws")
    assert softrig("setup", SOFTRIG_WHEELS="bin").returncode == 0  # uv does not use the network either
    (call,) = [c for c in (tmp_path / "calls").read_text().splitlines() if c.startswith("uv ")]
    assert f"--require-hashes --build-constraints {tmp_path}/.ws/run.txt --require-build-hashes --no-index" in call
    text = softrig("setup", "tables")
    assert text.returncode == 2
    assert "setup tables: no such set; there are run uv" in text.stderr
    python = tmp_path / ".venv" / "bin" / "python"
    for missing in (lambda: shutil.rmtree(tmp_path / ".venv"), lambda: (python.unlink(), python.symlink_to("/gone"))):
        missing()  # the user has removed .venv, or uninstalled the Python that made it
        text = softrig("setup", "run")
        assert (text.returncode, python.is_file()) == (0, True), text.stderr


def test_kilteds_wheels_are_set_up_beside_jazzys_and_remembered(bare, tmp_path):
    def softrig(*arguments, **variables):
        command = [tmp_path / "scripts" / "softrig", *arguments]
        return subprocess.run(
            command, env=bare | variables, timeout=60, stdin=subprocess.DEVNULL, capture_output=True, text=True
        )

    (tmp_path / "scripts" / "locks" / "distro").mkdir()
    shutil.copy(SCRIPTS / "locks/distro/kilted.lock", tmp_path / "scripts/locks/distro")
    assert softrig("setup", "--distro", "humble").returncode == 2
    assert softrig("setup", SOFTRIG_DISTRO="rolling").returncode == 2
    assert softrig("setup", "--distro", "kilted").returncode == 0
    wanted = (tmp_path / ".kilted" / ".ws" / "run.txt").read_text()
    # A package with one entry for each Python keeps the last.
    pinned = dict(re.findall(r"^([\w-]+)==(\S+)", wanted, re.M))
    lines = re.findall(r"^([\w-]+==\S+) ; .*", (SCRIPTS / "locks/distro/kilted.lock").read_text(), re.M)
    assert all(wanted.count(f"\n{line} ;") == 1 for line in lines)
    assert "ros-kilted-rclpy" in pinned
    assert "ros-jazzy-rclpy" not in pinned
    jazzys = dict(re.findall(r"^([\w-]+)==(\S+)", (SCRIPTS / "locks/run.lock").read_text(), re.M))
    others = {name: version for name, version in pinned.items() if not name.startswith("ros-")}
    assert others == {name: version for name, version in jazzys.items() if not name.startswith("ros-")}
    assert not (tmp_path / ".ws").exists()
    assert f"VIRTUAL_ENV={tmp_path}/.kilted/.venv" in softrig("env").stdout  # later calls use the same environment
    assert f"VIRTUAL_ENV={tmp_path}/.venv" in softrig("env", SOFTRIG_DISTRO="jazzy").stdout
    assert softrig("setup", "--distro", "jazzy").returncode == 0
    assert f"VIRTUAL_ENV={tmp_path}/.venv" in softrig("env").stdout


READ_ONLY = 'mount --bind "$1" "$1" && mount -o remount,ro,bind "$1" "$1" || exit 77; exec "$1/scripts/softrig" setup'


def test_a_read_only_checkout_has_its_set_up_in_the_cache_or_one_line(bare, tmp_path):
    (tmp_path / ".ws").touch()  # a file in place of the folder: even root cannot write into it
    printed = subprocess.run([tmp_path / "scripts" / "softrig", "setup"], env=bare, capture_output=True, text=True)
    line = "not writable; set XDG_CACHE_HOME to a folder of yours\n"
    assert (printed.returncode, printed.stderr) == (2, f"softrig: cannot set up in {tmp_path}: {line}")
    command = ["unshare", "-m", "bash", "-c", READ_ONLY, "bash", str(tmp_path)]
    printed = subprocess.run(command, env=bare, capture_output=True, text=True)
    if printed.returncode in (1, 77):
        pytest.skip("mounts are not permitted here")
    # the default cache is inside the same read-only folder in this test
    cache = re.escape(f"{tmp_path}/.cache/softrig/checkout-") + r"\d+"
    assert printed.returncode == 2
    assert re.fullmatch(f"softrig: cannot set up in {cache}: {line}", printed.stderr)


def test_an_error_of_softrig_is_one_line_and_a_log(monkeypatch, tmp_path, capsys):
    def broken(options):
        raise ZeroDivisionError("x" * 5000)

    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)
    monkeypatch.setattr("softrig_bringup.verbs.list_verb.main", broken)
    assert main(["list"]) == 4
    printed = capsys.readouterr().err
    assert printed.count("\n") == 1
    assert len(printed) < 1100
    assert "error of softrig itself: ZeroDivisionError" in printed
    (log,) = tmp_path.glob("softrig-error-*.log")
    assert "in broken" in log.read_text()


@pytest.mark.parametrize("where", ["execute", "save"])
def test_an_error_of_softrig_in_a_run_is_kept_in_its_folder(folder, monkeypatch, capsys, where):
    def broken(*arguments, **keys):
        raise ZeroDivisionError("none of yours")

    def once():
        with monkeypatch.context() as patched:
            patched.setattr("softrig_bringup.run.run." + {"execute": "run_inprocess", "save": "_scenes"}[where], broken)
            return run("lag", "--mode", "inprocess", "--out", "out")

    assert once() == 4
    (log,) = (folder / "out" / "log").glob("softrig-error-*.log")
    assert f"the traceback is in {log}" in capsys.readouterr().err
    assert "in broken" in log.read_text()
    assert once() == 4
    assert len(list((folder / "out" / "log").glob("softrig-error-*"))) == 1  # the new log replaced the old one
    assert run("lag", "--mode", "inprocess", "--no-plots", "--out", "out") == 0
    assert not (folder / "out" / "log").exists()


def test_nothing_is_imported_from_the_current_directory(tmp_path):
    (tmp_path / "rich.py").write_text("raise SystemExit('a file of the current directory was run')")
    (tmp_path / "softrig_core.py").write_text("raise SystemExit('a file of the current directory was run')")
    result = subprocess.run(
        [SCRIPTS / "softrig", "list", "dc_motor_smc_b2"], cwd=tmp_path, capture_output=True, text=True
    )
    assert result.returncode == 0, result.stderr
    assert "dc_motor_smc_b2" in result.stdout


def command(*arguments, **options):
    """The command line in a separate process, without the time that scripts/softrig needs."""
    return subprocess.run([sys.executable, "-P", "-m", "softrig_bringup", *arguments], timeout=PATIENCE, **options)


@pytest.mark.parametrize("encoding", few(["ascii", "latin-1"], 1))
def test_an_output_encoding_that_lacks_a_character_shows_another(folder, monkeypatch, encoding):
    (folder / "lag.yaml").write_text(SCENARIO.replace("First-order lag", "First-order lag, 3 µs → 4 µs"))
    written = io.BytesIO()
    # Strict encoding, as Python opens its own output.
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(written, encoding))
    assert main(["list", "lag"]) == 0
    assert b"First-order lag, 3" in written.getvalue()


def test_closed_streams_are_opened_before_a_file_gets_their_descriptor(folder):
    assert run("lag", "--mode", "inprocess", "--out", "b", "--no-plots") == 0

    def close():
        for number in (0, 1, 2):
            os.close(number)

    result = command("run", "lag", "--mode", "inprocess", "--out", "a", "--no-plots", preexec_fn=close)
    assert result.returncode == 0
    assert (folder / "a/metrics.json").read_bytes()[:1] == b"{"
    assert main(["bag", "compare", "a/bag", "b/bag", "--bitwise"]) == 0


def test_a_full_disk_behind_the_output_and_a_closed_pipe_are_reported(folder):
    with open("/dev/full", "w") as full:
        result = command("--version", stdout=full, stderr=subprocess.PIPE, text=True)
    assert result.returncode == 3
    assert result.stderr == "softrig: [Errno 28] No space left on device\n"
    reader, writer = os.pipe()
    os.close(reader)
    result = command("--version", stdout=writer, stderr=subprocess.PIPE, text=True)
    os.close(writer)
    assert (result.returncode, result.stderr) == (141, "")


@pytest.mark.long
def test_a_missing_home_and_temporary_folder_are_reported(folder, tmp_path):
    nowhere = {"HOME": "/proc/nowhere", "TMPDIR": "/proc/nowhere"}
    variables = {k: v for k, v in os.environ.items() if k != "XDG_CACHE_HOME"} | nowhere
    result = command("run", "lag", "--out", "a", "--no-plots", env=variables, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr


def test_a_signal_while_the_bag_is_written_waits_until_it_is_complete(folder, monkeypatch, capsys):
    from softrig_bags.write import write_bag

    def struck(*arguments, **options):
        os.kill(os.getpid(), signal.SIGTERM)
        return write_bag(*arguments, **options)

    monkeypatch.setattr("softrig_bringup.run.run.write_bag", struck)
    before = signal.getsignal(signal.SIGTERM)
    assert run("lag", "--mode", "inprocess", "--out", "a") == 143
    assert signal.getsignal(signal.SIGTERM) is before
    command = "softrig report a --out a/report.html"
    text = f"figures and bag are in a, pictures and report are not; `{command}` makes a report with them"
    assert capsys.readouterr().err == f"softrig: stopped by SIGTERM: {text}\n"
    monkeypatch.setattr("softrig_bringup.run.run.write_bag", write_bag)
    assert run("lag", "--mode", "inprocess", "--out", "b", "--no-plots") == 0
    assert main(["bag", "compare", "a/bag", "b/bag", "--bitwise"]) == 0
    # An interrupted run has written its manifest, so another run may replace its files.
    assert run("lag", "--mode", "inprocess", "--out", "a", "--no-plots") == 0


@pytest.mark.long
def test_a_terminal_that_closes_while_a_table_is_printed(folder):
    """rich by itself would end with status 1, which means that a metric misses."""
    reader, writer = os.pipe()
    os.close(reader)
    result = command("list", stdout=writer, env=os.environ | {"COLUMNS": "60"}, stderr=subprocess.PIPE, text=True)
    os.close(writer)
    assert (result.returncode, result.stderr) == (141, "")


@pytest.mark.parametrize(
    "error",
    [
        "MemoryError()",
        "ImportError('x.so: failed to map segment from shared object')",
        "OSError(12, 'Cannot allocate memory')",
    ],
)
def test_too_little_memory_is_not_bad_input(error, folder, monkeypatch, capsys):
    (folder / "greedy.py").write_text(f"raise {error}\n")
    (folder / "greedy-1.0.dist-info").mkdir()
    (folder / "greedy-1.0.dist-info" / "METADATA").write_text("Name: greedy\nVersion: 1.0\n")
    (folder / "greedy-1.0.dist-info" / "entry_points.txt").write_text("[console_scripts]\nplant = greedy:plant\n")
    monkeypatch.syspath_prepend(folder)
    (folder / "lag.yaml").write_text(
        SCENARIO.replace("package: faultrig, executable: plant", "package: greedy, executable: plant")
    )
    assert run("lag", "--mode", "inprocess") == 3
    assert "out of memory" in capsys.readouterr().err


def test_a_library_that_gets_no_memory_is_reported_as_such(capsys):
    def work():
        raise ImportError("x.so: failed to map segment from shared object")

    assert guarded(work) == 3
    assert capsys.readouterr().err == "softrig: out of memory; a shorter run or a smaller size may fit\n"


def test_a_file_that_is_not_a_scenario_hides_no_other(folder, capsys, monkeypatch):
    monkeypatch.delenv("COLUMNS", raising=False)
    (folder / "broken.yaml").write_text("a: [\n")
    (folder / "typo.yaml").write_text("{title: t, system: s, source: s, duration: -1, nodes: {}}\n")
    assert main(["list"]) == 2
    printed = capsys.readouterr()
    assert "lag\t" in printed.out
    assert "lag_misses\t" in printed.out
    assert "broken.yaml: not valid YAML" in printed.err
    assert "typo" in printed.err
    assert run("lag", "--mode", "inprocess", "--no-plots", "--no-record") == 0


def test_a_variant_may_be_named_by_a_number(folder):
    (folder / "lag.yaml").write_text(SCENARIO + "  40: {title: Forty}\n")
    assert load_scenario("lag_40").title == "Forty"


def test_a_current_directory_that_has_been_removed_is_named(tmp_path):
    missing = tmp_path / "gone"
    missing.mkdir()
    result = command("list", preexec_fn=lambda: (os.chdir(missing), missing.rmdir()), capture_output=True, text=True)
    assert result.returncode == 2
    assert result.stderr == "softrig: the current directory has been removed; change to one that exists\n"


def on_a_full_disk(limit, *arguments):
    """Run a command that can write no file beyond a size."""

    def full():
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    # Otherwise Python would leave a truncated .pyc file, which cannot be imported.
    environment = os.environ | {"PYTHONDONTWRITEBYTECODE": "1", "ROS_DOMAIN_ID": "230"}
    return command(*arguments, preexec_fn=full, capture_output=True, text=True, env=environment)


@pytest.mark.long
def test_a_full_disk_names_the_file_of_a_run(folder):
    result = on_a_full_disk(500, "run", "lag", "--mode", "inprocess", "--out", "a")
    assert result.returncode == 3
    assert result.stderr == f"softrig: {folder}/a/metrics.json: File too large\n"


@pytest.mark.parametrize(("limit", "words", "path"), few([
    pytest.param(100, ["study", "lag", "--seeds", "3", "--force", "--workers", "1", "--out", "a"], "a/study.json",
                 marks=pytest.mark.long),
    pytest.param(3000, ["study", "lag", "--seeds", "60", "--force", "--workers", "1", "--out", "a"], "a/rows.jsonl",
                 marks=pytest.mark.long),
    pytest.param(5000, ["study", "lag", "--seeds", "3", "--force", "--workers", "1", "--out", "a"],
                 "a/.new/report.html", marks=pytest.mark.long),
    (100_000, ["bag", "record", "--output", "a", "/x"], "a"),
], 1))  # fmt: skip
def test_a_full_disk_names_the_file_and_leaves_no_incomplete_file(limit, words, path, folder):
    done = on_a_full_disk(limit, *words)
    assert done.returncode == 3, done.stderr
    assert re.search(rf"softrig: (/.*/)?{re.escape(path)}: File too large$", done.stderr, re.MULTILINE), done.stderr
    left = {p.name for p in (folder / "a").rglob("*")} if (folder / "a").exists() else set()
    assert left <= {"study.json", "rows.jsonl", "softrig_files.json"}


def test_what_a_run_waits_for_is_reported_completely_and_in_lines(capsys):
    text = "waiting for a\n" + "\n".join(f"    a must publish topic_{i}" for i in range(60))
    _announce(text)
    assert capsys.readouterr().err == f"softrig: {text}\n"


DIFFERENT = ["lag --set a.k=[1,2]", "lag --set a.k=(1,2)", f"lag --set a.R={'1' * 66} --set a.Kt=0.01 --seed 1",
             f"lag --set a.R={'1' * 66} --set a.Kt=0.0 --seed 1", f"lag --set a.R={'1' * 66} --set a.Kt=0.01 --seed 2",
             f"lag --set a.R={'1' * 200}", f"lag --set a.R={'1' * 201}", "lag --params-file p.yaml",
             "lag --params-file a/p.yaml", "lag --params-file b/p.yaml", "a/lag.yaml", "b/lag.yaml", "--like runs/a",
             "--like runs/b", "--from runs/a@0.5", "--from runs/b@0.5", "--from runs/a@0.5000000000000001"]  # fmt: skip


def test_different_runs_have_different_folders_and_no_number_is_truncated():
    names = [folder_name("lag", make_parser().parse_args(["run", *words.split()])) for words in DIFFERENT]
    assert len(set(names)) == len(DIFFERENT)
    assert max(map(len, names)) <= 129
    for words, name in zip(DIFFERENT, names, strict=True):
        assert "Kt=" not in name or re.search(r"a.Kt=[0-9.]+", words)[0] in name.split("-")
    assert folder_name("lag", make_parser().parse_args(["run", "lag.yaml"])) == "lag"
    again = folder_name("dc_motor_smc", make_parser().parse_args(["run", str(locate("dc_motor_smc")[1])]))
    assert again == "dc_motor_smc"
    of_parts = make_parser().parse_args(["run", "lag", "--only", "gain", "--only", "other", "--set", "gain.k=2"])
    assert folder_name("lag", of_parts, of_parts.only) == "lag-gain-other-gain.k=2"


def test_a_results_folder_is_named_after_what_was_changed():
    parsed = make_parser().parse_args(
        ["run", "lag", "--external", "gain", "--duration", "0.5", "--set", "gain.k=[1, 2]"]
    )
    assert folder_name("lag", parsed) == "lag-gain.k=_1,_2_-external_gain-duration_0.5-6d0b790d"
    parsed = make_parser().parse_args(["run", "lag", "--mode", "container", "--realtime"])
    assert folder_name("lag", parsed) == "lag-realtime"
