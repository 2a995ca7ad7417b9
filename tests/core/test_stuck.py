"""A block whose code does not return is reported, and a signal then ends its process."""

import os
import signal
import subprocess
import sys
import threading
import time
import warnings
from io import StringIO
from pathlib import Path

import pytest
from conftest import PATIENCE, make_scenario
from faultrig import Gain
from softrig_bringup import cli
from softrig_core import RunError, ScenarioError, rig_of, run_inprocess
from softrig_core.run import stuck


class Endless(Gain):
    """Does not return from its third tick until the test allows it."""

    def update(self, x, t, **inputs):
        if t == 20_000_000:
            AT_LAST.clear()
            STARTED.set()
            while not AT_LAST.wait(0.001):
                pass
        return super().update(x, t, **inputs)


class Seen(Gain):
    """Has the watch look at its second tick."""

    def update(self, x, t, **inputs):
        if t == 10_000_000:
            stuck._running._check(0.0, stuck.LOOK)
            assert threading.get_ident() in stuck._running._seen
        return super().update(x, t, **inputs)


AT_LAST, STARTED = threading.Event(), threading.Event()


@pytest.fixture
def lines(monkeypatch):
    """What is printed; the first line lets the block return."""
    results = []

    def tell(tag, text):
        results.append(f"{tag}: {text}")
        AT_LAST.set()

    monkeypatch.setattr(stuck, "print_for", tell)
    monkeypatch.setattr(stuck, "LOOK", 0.02)
    monkeypatch.setattr(stuck, "LONG", 0.2)
    monkeypatch.setattr(stuck, "LAST", 0.2)
    return results


def watches():
    return sum(thread.name == "softrig watch" for thread in threading.enumerate())


def rig():
    scenario = make_scenario({"plant": "plant", "source": "source", "gain": "gain"}, 0.1)
    return rig_of(scenario, classes={"gain": Endless})


def test_a_tick_that_does_not_return_is_reported_with_node_time_and_place(lines):
    run_inprocess(rig(), 0)
    (line,) = lines
    assert line.startswith("gain: `update` at t = 0.02 s has not returned for 0.2 s; Ctrl-C ends the run (")
    assert "test_stuck.py, line " in line or "threading.py, line " in line
    assert watches() == 0
    assert signal.set_wakeup_fd(-1) == -1


def test_the_watch_does_not_keep_the_memory_of_a_run_that_has_ended():
    scenario = make_scenario({"plant": "plant", "source": "source", "gain": "gain"}, 0.1)
    with stuck.watched():
        run_inprocess(rig_of(scenario, classes={"gain": Seen}), 0)
        assert threading.get_ident() not in stuck._running._seen


def test_a_signal_ends_the_process_when_the_tick_does_not_return(lines, monkeypatch):
    ended = []
    monkeypatch.setattr(stuck, "LONG", PATIENCE)
    monkeypatch.setattr(stuck.os, "_exit", lambda status: (ended.append(status), AT_LAST.set()))
    monkeypatch.setattr(stuck, "print_for", lambda title, text: lines.append(f"{title}: {text}"))
    # The handler never runs, because the stuck code does not return to Python.
    before = signal.signal(signal.SIGTERM, lambda number, frame: None)
    STARTED.clear()
    killer = threading.Thread(target=lambda: STARTED.wait(PATIENCE) and os.kill(os.getpid(), signal.SIGTERM))
    killer.start()
    try:
        run_inprocess(rig(), 0)
    finally:
        signal.signal(signal.SIGTERM, before)
        killer.join()
    assert ended[0] == 143
    assert lines[0].startswith("gain: `update` at t = 0.02 s has not returned 0.2 s after SIGTERM (")
    assert lines[0].endswith("): the process is ended, and unwritten data are lost")


class Ends(Gain):
    """Ends Python, or fails, where it is asked to."""

    where, error = "", Exception()

    def raise_in(self, where):
        if where == self.where:
            raise self.error

    def setup(self):
        self.raise_in("setup")

    def reset(self, seed):
        self.raise_in("reset")
        super().reset(seed)

    @classmethod
    def ports(cls, params):
        cls.raise_in(cls, "ports")
        return super().ports(params)

    @classmethod
    def agreed(cls, params):
        cls.raise_in(cls, "agreed")
        return super().agreed(params)

    def update(self, x, t, **inputs):
        if t == 20_000_000:
            self.raise_in("update")
        return super().update(x, t, **inputs)


@pytest.mark.parametrize("error", [SystemExit(0), GeneratorExit(), KeyError("k")], ids=lambda e: type(e).__name__)
@pytest.mark.parametrize(
    ("where", "message"),
    [
        ("update", r"^gain: failed at t = 0\.02 s: {}"),
        ("setup", r"node gain: set-up failed: {}"),
        ("reset", r"node gain: set-up failed: {}"),
        ("ports", r"node gain: {}"),
        ("agreed", r"`agreed` of Ends\w+: {}"),
    ],
)
def test_code_of_a_block_that_raises_anything_is_named_and_does_not_end_python(where, message, error):
    """`sys.exit(0)` in a law ended a run with status 0, without figures and without a bag."""
    block = type(f"Ends{where}{type(error).__name__}", (Ends,), {"where": where, "error": error})
    scenario = make_scenario({"plant": "plant", "source": "source", "gain": "gain"}, 0.1)
    with pytest.raises((RunError, ScenarioError), match=message.format(type(error).__name__)):
        run_inprocess(rig_of(scenario, classes={"gain": block}), 0)


def test_a_verb_whose_code_ends_python_or_closes_its_output_reports_it(monkeypatch, capsys):
    for error, message in (
        (SystemExit(0), "code that `softrig list` called has ended it: SystemExit: 0 ("),
        (None, "standard output: closed by a user's code; the output is lost"),
    ):

        def verb(options, error=error):
            if error is not None:
                raise error
            monkeypatch.setattr(sys, "stdout", StringIO())
            sys.stdout.close()
            print("figures")

        monkeypatch.setattr(cli, "_late", lambda function, options, verb=verb: verb(options))
        assert cli.main(["list"]) == 3
        assert capsys.readouterr().err.startswith(f"softrig: {message}")


def test_a_thread_that_continues_is_not_waited_for():
    text = """if True:
        import sys, threading
        from softrig_core.guard import end_within
        threading.Thread(target=threading.Event().wait, name="law").start()
        print("figures")
        end_within(0.05, 1)
        sys.exit(1)"""
    done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, timeout=PATIENCE, check=False)
    line = "softrig: law, started by a user's code, still runs; softrig ends without waiting for it\n"
    assert (done.returncode, done.stderr) == (1, line)


def test_a_node_that_waits_for_a_compiler_or_runs_no_block_is_left_alone(lines):
    with stuck.watched():
        with stuck.watched():  # nested in another watch it has no effect
            assert watches() == 1
        assert watches() == 1
        assert stuck.calls() == {}
        time.sleep(0.3)
        with warnings.catch_warnings():  # the watching thread holds no lock, so the fork is safe
            warnings.simplefilter("ignore", DeprecationWarning)
            pid = os.fork()
        if not pid:  # a fork needs a watch of its own and does not share its parent's signals
            with stuck.watched():
                os._exit(10 + threading.active_count())
        assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 12
    assert lines == []


LOOPS = {
    "python": "        while t >= 100_000_000:\n            pass\n",
    "c": "    volatile int loop = t_ns >= 100000000;\n    while (loop) {}\n",
}


def written(code, folder):
    """Write a package whose law loops from 0.1 s on; return the arguments that run it."""
    command = [sys.executable, "-m", "softrig_bringup"]
    options = ["--only", "law", "--for", "dc_motor_smc_b2"] if code == "python" else ["--language", "c"]
    subprocess.run([*command, "new", "law", *options], cwd=folder, check=True, capture_output=True)
    file, before = (
        (folder / "law/law/controller.py", "        x, outputs = super")
        if code == "python"
        else (folder / "law/law.c", "    (void)t_ns;")
    )
    text = file.read_text()
    assert before in text
    file.write_text(text.replace(before, LOOPS[code] + before))
    if code == "python":
        return [str(Path(__file__).parents[2] / "scripts/softrig"), "--workspace", "law"], "law"
    return command, "law/law.yaml"


@pytest.mark.long
@pytest.mark.parametrize(
    ("code", "verb", "mode"),
    [(code, "run", mode) for code in LOOPS for mode in ("inprocess", "container", "processes")]
    + [(code, verb, "inprocess") for code in LOOPS for verb in ("check", "study")],
)
def test_a_law_that_loops_is_named_and_ctrl_c_ends_it(code, verb, mode, tmp_path):
    command, what = written(code, tmp_path)
    options = {"run": ["--mode", mode], "check": [], "study": ["--seeds", "4"]}[verb]
    message = (tmp_path / "said").open("w+")
    process = subprocess.Popen([*command, verb, what, *options], cwd=tmp_path, stdout=message, stderr=message)
    try:
        deadline = time.monotonic() + PATIENCE
        while "has not returned for 5 s" not in (text := (tmp_path / "said").read_text()):
            assert process.poll() is None, text
            assert time.monotonic() < deadline, text
            time.sleep(0.05)
        (line, *_) = [line for line in text.splitlines() if "has not returned" in line]
        assert ("dc_motor_smc" if code == "python" else "law") in line
        assert "t = 0.1 s" in line
        if mode != "processes":  # in processes the other nodes end after the scenario's timeout
            process.send_signal(signal.SIGINT)
        assert process.wait(30.0) == (3 if mode == "processes" else 130), (tmp_path / "said").read_text()
    finally:
        process.kill()
        process.wait()
        message.close()
