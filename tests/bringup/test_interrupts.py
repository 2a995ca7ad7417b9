"""Each phase of a run is interrupted in each way: the status is never 0, and one line names what is missing.

What is here needs no installation of ROS; `doc/lab/ros_tools.md` has the table of what was tried by hand.
"""

import signal
import sys
from importlib import import_module
from types import SimpleNamespace

import pytest
from conftest import in_process
from launching import nodes_of
from softrig_bringup import launched
from softrig_bringup.cli import main
from softrig_bringup.terminal import progress
from softrig_bringup.view import here as here_module
from softrig_core import RunError, rig_of
from softrig_core.guard import quietly, stopped_by
from softrig_nodes.processes.stopping import stoppable
from softrig_nodes.processes.supervision import left_early
from test_launch import SCENARIO
from tornado.ioloop import IOLoop

RUN, VERB = "softrig_bringup.run.run", "softrig_bringup.verbs.run_verb"
PICTURES = (
    "figures and bag are in r, pictures and report are not; `softrig report r --out r/report.html` makes a report"
)
PHASES = {  # phases of the end of a run: the function called in each, and the line expected
    "figures": (f"{VERB}.summary", PICTURES),
    "bag": (f"{RUN}.write_bag", PICTURES),
    "pictures": (f"{RUN}.plot_run", PICTURES),
    "report": (f"{RUN}.write_report", PICTURES),
    "table": (f"{VERB}.print_judged", "the table was not printed; it is in r"),
}
BEFORE = {
    "start": (f"{VERB}.checked", "nothing was run or written"),
    "native": (f"{RUN}.run_inprocess", "stopped by {} at t = 0 s"),
}
SIGNALS = [signal.SIGINT, signal.SIGTERM]


@pytest.fixture(autouse=True)
def lag(tmp_path, monkeypatch):
    (tmp_path / "lag.yaml").write_text(
        SCENARIO.replace("claims:", "plots: [{title: x, signals: {lag/state/x/position: x}}]\nclaims:")
    )
    monkeypatch.setenv("SOFTRIG_SCENARIOS", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(f"{RUN}.plot_run", lambda *_, **__: [])  # other tests cover pictures and page
    monkeypatch.setattr(f"{RUN}.write_report", lambda folders, page: page.touch())


def strike(monkeypatch, where, number, twice):
    """Send a signal when a function is called, and another during the cleanup."""
    module, _, name = where.rpartition(".")
    real = getattr(import_module(module), name)

    def struck(*arguments, **options):
        try:
            signal.raise_signal(number)
        finally:
            if twice:
                signal.raise_signal(number)
        return real(*arguments, **options)

    monkeypatch.setattr(where, struck)


def in_a_run():
    return main(["run", "lag", "--mode", "inprocess", "--out", "r"])


class Pages:
    """Pages of a browser that lets the run continue and closes at its end."""

    url = "http://here"

    def __init__(self, source, control, *_):
        self.control = control

    def measure(self):
        if self.control.held:
            self.control.hold("me", "resume")

    def left(self):
        return True

    def close(self):
        pass


@pytest.fixture
def in_a_view(monkeypatch):
    monkeypatch.setattr(here_module, "Pages", Pages)
    monkeypatch.setattr(here_module, "FRAME", 5)
    monkeypatch.setattr("softrig_bringup.verbs.run_verb._check_view", lambda options: None)
    loop = IOLoop(make_current=False)
    monkeypatch.setattr(IOLoop, "current", staticmethod(lambda *_: loop))
    yield lambda: main(["view", "lag", "--mode", "inprocess", "--out", "r", "--pace", "full", "--running"])
    loop.close()


@pytest.fixture
def in_a_launch(monkeypatch, capsys):
    """The end of a launch whose nodes have all finished, without any process."""
    rig = rig_of("lag")
    done = in_process(rig), {m.name: {"state": "done", "t": 0} for m in rig.members}
    monkeypatch.setattr(launched, "gathered", lambda *_: done)

    def launch():
        values = {"scenario": "lag", "mode": "lockstep", "record": "true", "judge": "true", "out": "r"}
        try:
            for node in nodes_of(values):
                event = SimpleNamespace(returncode=0, process_name=node.name)
                node.on_exit(event, SimpleNamespace(is_shutdown=False))
        except RuntimeError as error:  # launch logs this error and ends with status 1
            print("softrig:", error, file=sys.stderr)
            return 1
        return 0

    return launch


@pytest.mark.parametrize(
    ("number", "twice"),
    [
        pytest.param(n, twice, id=f"{n.name}-{'twice' if twice else 'once'}", marks=marks)
        for twice in (False, True)
        for n, marks in ((SIGNALS[twice], ()), (SIGNALS[not twice], pytest.mark.long))
    ],
)
@pytest.mark.parametrize(
    ("door", "phase"),
    [
        (door, phase)
        for door in ("run", "view", "launch")
        for phase in (*BEFORE, *PHASES)
        if phase != "native" or door == "run"  # `view` and `launch` run their nodes by other loops
    ],
)
def test_no_interrupted_run_has_status_0_and_one_line_says_what_is_missing(
    door, phase, number, twice, monkeypatch, capsys, request
):
    where, reported = (BEFORE | PHASES)[phase]
    if door == "launch":
        where = where.replace(f"{VERB}.checked", "softrig_bringup.launched.checked")
    call = in_a_run if door == "run" else request.getfixturevalue(f"in_a_{door}")
    strike(monkeypatch, where, number, twice)
    usual = [signal.getsignal(n) for n in SIGNALS]
    assert call() == (1 if door == "launch" else 128 + number)
    assert [signal.getsignal(n) for n in SIGNALS] == usual
    lines = [line for line in capsys.readouterr().err.splitlines() if "stopped" in line]
    assert len(lines) == 1, lines
    assert reported.format(number.name) in lines[0]
    assert number.name in lines[0]


def test_the_command_of_the_line_makes_what_is_missing(monkeypatch, tmp_path):
    with monkeypatch.context() as patched:
        strike(patched, f"{RUN}.plot_run", signal.SIGINT, False)
        assert in_a_run() == 130
    assert main(["report", "r", "--out", "r/report.html"]) == 0
    page = (tmp_path / "r/report.html").read_text()
    assert "This run has no pictures" not in page
    assert page.count("<figure>") >= 2
    assert in_a_run() == 1  # files left behind do not prevent the next run


def test_recordings_of_nodes_are_named_if_their_run_was_not_written(monkeypatch, capsys, tmp_path):
    def end_run(rig, placement, log, listener):
        log.mkdir()
        (log / "plant.shard").write_bytes(b"")
        signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr(f"{VERB}.execute", end_run)
    assert in_a_run() == 143
    assert "`softrig bag repair r/log` makes a bag" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("record", "text"),
    [
        ("true", r"^stopped by SIGINT at t = 0\.5 s$"),
        ("false", "^stopped by SIGINT: the run did not reach its end, and nothing of it was recorded or judged "),
    ],
)
def test_a_launch_that_is_interrupted_during_the_run_does_not_pass(record, text, in_a_launch):
    values = {"scenario": "lag", "mode": "lockstep", "record": record, "out": "r"}
    over = SimpleNamespace(is_shutdown=True)

    def end():
        for node in nodes_of(values):
            node.on_exit(SimpleNamespace(returncode=0, process_name=node.name), over)

    with pytest.raises(RuntimeError, match=text):
        end()


def test_a_launch_that_is_interrupted_while_it_reads_its_scenario_does_not_pass(monkeypatch):
    strike(monkeypatch, "softrig_bringup.launched.checked", signal.SIGINT, False)
    with pytest.raises(RunError, match=r"^stopped by SIGINT: nothing was run or written$"):
        nodes_of({"scenario": "lag"})


def test_stopping_a_node_ends_its_run_with_an_error():
    states = {"plant": {"state": "done", "t": 5 * 10**8, "left_early": True}, "gain": {"state": "done", "t": 10**9}}
    assert left_early(states) == "somebody has stopped node plant at t = 0.5 s"
    assert left_early({"gain": states["gain"]}) == ""


def test_long_work_is_announced(monkeypatch, capsys):
    class Timer:
        daemon = False

        def __init__(self, seconds, function, arguments):
            messages.append(seconds)
            self.start = lambda: function(*arguments)  # the second run has ended

        def cancel(self):
            messages.append("cancelled")

    messages = []
    monkeypatch.setattr(progress.threading, "Timer", Timer)
    assert in_a_run() == 1
    assert messages == [progress.SILENT, "cancelled"] * 3
    reported = [line for line in capsys.readouterr().err.splitlines() if "ing " in line]
    assert [line.split(": ", 1)[1] for line in reported] == [
        "computing 1 figures",
        "writing 253 messages into r; if it is killed, softrig bag repair r/log makes the bag",
        "drawing 1 pictures and the report into r",
    ]
    with quietly(), progress.busy("x"):
        pass
    assert "x" not in capsys.readouterr().err


def test_a_signal_without_a_note_stops_the_run():
    with pytest.raises(KeyboardInterrupt) as caught, stoppable():
        signal.raise_signal(signal.SIGTERM)
    assert stopped_by(caught.value) == "stopped by SIGTERM"
    caught.value.add_note("a")
    caught.value.add_note("b")
    assert stopped_by(caught.value) == "stopped by SIGTERM: a; b"
