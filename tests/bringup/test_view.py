"""The page beside a run, over its websocket as a browser has it: parameters, pause, step; it does not affect the
numbers.
"""

import errno
import json
import logging
import math
import multiprocessing
import os
import re
import shutil
import signal
import subprocess
import sys
import warnings
from contextlib import contextmanager
from types import SimpleNamespace
from urllib.error import HTTPError
from urllib.parse import urlsplit
from urllib.request import HTTPCookieProcessor, Request, build_opener, urlopen

import numpy as np
import pytest
from bokeh.document import Document
from conftest import PATIENCE
from softrig_bags.compare import compare
from softrig_bags.read import signals
from softrig_bringup.cli import main
from softrig_bringup.folder import ResultsFolder
from softrig_bringup.view.control import Control, Knob
from softrig_bringup.view.here import SessionSource, show_here
from softrig_bringup.view.page import SLOW, Page, reach
from softrig_bringup.view.pictures import plots_of
from softrig_bringup.view.run_pages import RunPages
from softrig_bringup.view.serve import OneLine
from softrig_bringup.view.sources import Live, Recorded
from softrig_bringup.view.tracks import Track
from softrig_core import Recording, Session, Signals, load_scenario, rig_of, simulate
from softrig_core.export.check import FLAGS
from softrig_core.firmware.files import export_firmware
from softrig_core.wire.recording import read_shards
from softrig_nodes.processes.placement import Placement

HASTY = """
from softrig_bringup.view import serve
serve.AWAY = 500
from softrig_bringup.cli import main
raise SystemExit(main())
"""


@contextmanager
def running(*words, start=("-m", "softrig_bringup")):
    """A command of ours; returns its process and the lines that it has printed so far."""
    process = subprocess.Popen(
        [sys.executable, *start, *map(str, words)],
        text=True,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
    )
    try:
        yield process
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
        process.communicate(timeout=PATIENCE)


@contextmanager
def forked(*words):
    """A command of ours in a fork of this process, which saves its imports; as `running`."""
    reader, writer = os.pipe()

    def child():
        os.dup2(writer, 2)
        sys.stdout, sys.stderr = open(os.devnull, "w"), open(2, "w", buffering=1)  # noqa: SIM115
        sys.exit(main([*map(str, words)]))

    process = multiprocessing.get_context("fork").Process(target=child)
    with warnings.catch_warnings():  # Bokeh's other threads survive a fork
        warnings.simplefilter("ignore", DeprecationWarning)
        process.start()
    os.close(writer)
    with open(reader) as lines:
        try:
            yield SimpleNamespace(stderr=lines, send_signal=lambda number: os.kill(process.pid, number))
        finally:
            if process.is_alive():
                os.kill(process.pid, signal.SIGINT)
            process.join(PATIENCE)


def address(process):
    """The address of the page."""
    for line in process.stderr:
        if match := re.search(r"the page is (http[^\s;]+)", line):
            return match[1]
    raise AssertionError("it ended without a page")


class Browser:
    """A page as a browser has it: its content, and actions of a person."""

    def __init__(self, url, **arguments):
        from bokeh.client import pull_session

        base, _, token = url.partition("?token=")
        arguments = ({"token": token} if token else {}) | arguments
        self.session = pull_session(url=f"{base}view", arguments=arguments)
        self.document = self.session.document

    def __getitem__(self, name):
        return self.document.select_one({"name": name})

    def press(self, name):
        from bokeh.document.events import MessageSentEvent
        from bokeh.events import ButtonClick

        # Bokeh's Python client cannot click; this sends the event that the browser sends.
        self.session._document_patched(MessageSentEvent(self.document, "bokeh_event", ButtonClick(self[name])))

    def until(self, condition):
        """Read what the server sends until the page shows something; the time limit of tests ends an endless wait."""

        def seen():
            if self["echo"].text != (beat := self["beat"].text):
                self["echo"].text = beat  # the page's script echoes the beat when the state is drawn
            return condition()

        self.session._connection._loop_until(seen)
        assert self.session.connected, self["log"].text

    def says(self, text):
        self.until(lambda: text in self["log"].text)

    def close(self):
        self.session.close()


@pytest.mark.long
@pytest.mark.processes
@pytest.mark.parametrize("mode", ["processes", "container"])
def test_a_run_paused_stepped_and_changed_on_its_page_has_the_bag_of_the_same_run_without_a_page(tmp_path, mode):
    words = ("dc_motor_smc", "--duration", "0.1", "--no-plots")
    with running("view", *words, "--mode", mode, "--out", tmp_path / "seen") as process:
        url = address(process)
        first, second = Browser(url), Browser(url)
        first.until(lambda: "paused" in first["state"].text and first["hold"].label == "resume")
        for t in ("0.0001", "0.0002"):
            first.press("step")
            first.says("step: one step")
            first.until(lambda t=t: f">{mode}: {t} of 0.1 s, paused<" in first["state"].text)
        first["dc_motor_smc.c"].value = "-1.0"
        first.says("c out of range")
        second.says("c out of range")  # every page shows a refusal
        first.until(lambda: first["dc_motor_smc.c"].value == second["dc_motor_smc.c"].value != "-1.0")
        first["pace"].value = "0.5"
        first.says("pace 0.5")
        second.says("pace 0.5")
        second.until(lambda: second["pace"].value == "0.5")
        second.close()  # the page disconnects while the run continues
        first.press("hold")
        first.until(lambda: "ended" in first["state"].text)
        assert "the run is over" in first["state"].text
        first["dc_motor_smc.k"].value = "70.0"
        first.says("refused: the run is over")
        speed = first["Speed follows its reference: motor/state/shaft/velocity"].data
        first.close()
        assert main(["run", *words, "--mode", "container", "--out", str(tmp_path / "plain")]) in (0, 1)
        process.send_signal(signal.SIGINT)  # otherwise the run would wait for the page to reconnect
        assert process.wait(PATIENCE) in (0, 1)
    seen, unseen = signals(tmp_path / "seen/bag"), signals(tmp_path / "plain/bag")
    assert compare(seen, unseen, bitwise=True).equal
    t, recorded = seen["motor/state/shaft/velocity"]
    # The page shows everything up to the end of the bag.
    assert (speed["x"][-1], speed["y"][-1]) == (t[-1], recorded[-1])


@pytest.mark.long
@pytest.mark.processes
@pytest.mark.parametrize("mode", ["processes", "container"])
def test_two_pages_change_one_parameter(mode, tmp_path):
    """At the very tick at which the run is paused, and while it runs: all see the newest value, and the run repeats."""
    words = ("dc_motor_smc", "--duration", "0.5", "--no-plots", "--mode", mode, "--out", tmp_path / "run")
    with running("view", *words) as process:
        url = address(process)
        pages = [Browser(url), Browser(url)]
        pages[0].until(lambda: "paused" in pages[0]["state"].text and pages[0]["hold"].label == "resume")
        for k, turned in enumerate(("60.0", "70.0", "65.0"), 1):
            pages[k % 2]["dc_motor_smc.k"].value = turned
            pages[k % 2].says(f"dc_motor_smc.k = {float(turned):g} rad/s^3")  # the value that the node reports
            pages[k % 2].press("step")
            for page in (pages[k % 2], pages[k % 2 - 1]):  # the page that sent the change receives it as well
                page.until(lambda page=page, k=k: f">{mode}: {k * 1e-4:.6g} of 0.5 s, paused<" in page["state"].text)
                page.until(
                    lambda page=page, turned=turned: float(page["dc_motor_smc.k"].value or "nan") == float(turned)
                )
        pages[1].press("hold")
        for k in range(6):
            pages[k % 2]["dc_motor_smc.delta"].value = str(1.0 + k)
            pages[k % 2].says(f"dc_motor_smc.delta = {1.0 + k:g}")
        pages[1].close()
        pages[0].until(lambda: "ended" in pages[0]["state"].text)
        last = pages[0]["dc_motor_smc.k"].value
        pages[0].close()
        assert process.wait(PATIENCE) in (0, 1)
    changes = json.loads((tmp_path / "run" / "metrics.json").read_text())["changes"]
    first = [(c["at_s"], c["set"]["k"]) for c in changes if "k" in c["set"]]
    assert [k for _, k in first] == [60.0, 70.0, 65.0]
    assert float(last) == 65.0
    assert np.diff([t for t, _ in first]) == pytest.approx([1e-4, 1e-4])
    again = ["run", "--like", tmp_path / "run", "--mode", "inprocess", "--no-plots", "--out", tmp_path / "again"]
    assert main([*map(str, again)]) in (0, 1)
    assert compare(signals(tmp_path / "run/bag"), signals(tmp_path / "again/bag"), bitwise=True).equal


@pytest.mark.long
@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler (Debian: apt-get install gcc)")
def test_a_gain_changed_on_the_page_changes_on_the_board(tmp_path):
    name, node, folder = "dc_motor_smc_b2", "dc_motor_smc", tmp_path / "firmware"
    export_firmware(rig_of(name), node, folder, "host", rows=20, drawn=2)
    build = ["cc", *FLAGS, "-D_POSIX_C_SOURCE=200809L", "-o", node, "main.c", f"{node}.c", f"{node}_link.c", "-lm"]
    subprocess.run(build, cwd=folder, check=True)
    link = {"port": f"program:{folder / node}", "firmware": f"{folder / node}.json"}
    scenario = {"extends": name, "duration": 0.5, "nodes": {node: {"link": link}}}
    (tmp_path / "board.yaml").write_text(json.dumps(scenario))
    words = ("view", tmp_path / "board.yaml", "--mode", "inprocess", "--no-plots", "--out", tmp_path / "seen")
    with running(*words) as process:
        page = Browser(address(process))
        page.until(lambda: "paused" in page["state"].text and not page[f"{node}.k_per_ref"].disabled)
        for _ in range(3):
            page.press("step")
            page.says("step: one step")
        page[f"{node}.k_per_ref"].value = "4.0"
        page.says("k_per_ref = 4")
        page.press("hold")
        page.until(lambda: "the run is over" in page["state"].text)
        page.close()
        assert process.wait(PATIENCE) in (0, 1)
    (change,) = json.loads((tmp_path / "seen/metrics.json").read_text())["changes"]
    script = [{"at": change["at_s"], "set": {f"{node}.k_per_ref": 4.0}}]
    (tmp_path / "python.yaml").write_text(json.dumps({"extends": name, "duration": 0.5, "changes": script}))
    wanted = Signals(simulate(str(tmp_path / "python.yaml")).recording)
    assert compare(signals(tmp_path / "seen/bag"), wanted, bitwise=True).equal
    assert not compare(Signals(simulate(name, duration=0.5).recording), wanted, bitwise=True).equal


@pytest.mark.long
def test_a_run_goes_back_from_its_page_and_the_branch_equals_run_from(tmp_path):
    words = ("dc_motor_smc", "--mode", "inprocess", "--duration", "0.1", "--no-plots")
    words = ("view", *words, "--pace", "full", "--out", tmp_path / "first")
    with running(*words, start=("-c", HASTY)) as process:
        page = Browser(address(process))
        page.until(lambda: "paused" in page["state"].text)
        page.press("step")
        page.says("step: one step")
        page.press("hold")
        page.until(lambda: "the run is over" in page["state"].text)
        for asked, text in (("0,04", "expected a time"), ("0.2", "at most 0.1 s")):
            page["back to"].value = asked
            page.press("go back")
            page.says(text)
        page["back to"].value = "0.04"
        page.press("go back")
        page.says("back to 0.04 s from 0.1 s")
        page.until(lambda: "0.0399 of 0.1 s, paused" in page["state"].text and not page["dc_motor_smc.delta"].disabled)
        assert page["Speed follows its reference: motor/state/shaft/velocity"].data["x"][-1] < 0.04
        page["dc_motor_smc.delta"].value = "0.5"
        page.says("dc_motor_smc.delta = 0.5")
        page.press("hold")
        page.until(lambda: "the run is over" in page["state"].text)
        page.close()
        assert process.wait(PATIENCE) == 0
    again = ("--from", f"{tmp_path}/first@0.04", "--set", "dc_motor_smc.delta=0.5", "--mode", "inprocess", "--no-plots")
    assert main(["run", *again, "--out", str(tmp_path / "from")]) == 0
    first, second, asked = (signals(tmp_path / name / "bag") for name in ("first", "first-2", "from"))
    assert compare(second, asked, bitwise=True).equal
    assert not compare(second, first, bitwise=True).equal
    content = json.loads((tmp_path / "first-2/metrics.json").read_text())
    assert content["branched"] == [{"at_s": 0.04, "from_s": 0.1, "left": str(tmp_path / "first")}]
    assert "branched at 0.04 s" in content["changed"]


def test_parameters_stay_changed_after_going_back_and_the_old_branch_can_be_run(tmp_path):
    source = SessionSource(Session("dc_motor_smc", duration=0.1), True, 1.0, folder=lambda: tmp_path)
    session, control = source.session, source.control
    session.go(0.05)
    control.turn("me", "dc_motor_smc.delta", 0.5)
    session.go(0.06)
    control.turn("me", "dc_motor_smc.delta", 0.8)
    session.go(0.08)
    source.read_new()
    left = session.recording.before(80_000_000)
    shard = tmp_path / "log/rig.shard"
    assert read_shards([shard]).topics == left.topics  # if the process is killed now, the file is complete
    control.go_back("me", 0.03)
    assert (session.t, source.end, control.knobs["dc_motor_smc.delta"].value) == (0.03, 0.0299, 0.8)
    assert source.pane(0.0, 1.0)["motor/state/shaft/velocity"].t[-1] == 0.0299
    # The file is kept until the run continues from the earlier instant.
    assert read_shards([shard]).topics == left.topics
    # The scenario of the branch is already written, so a killed process would leave it.
    run = simulate(str(tmp_path / "left_1.yaml"))
    assert run.recording.before(80_000_000).topics == left.topics
    control.go_back("me", 0.02)  # no parameter was changed in between
    session.go(0.03)
    session.go()
    source.read_new()
    assert [t for t, *_ in source.changes] == [0.02]
    assert read_shards([shard]).topics == session.recording.topics
    plain = simulate("dc_motor_smc", duration=0.1)
    assert session.recording.topics == plain.branch(0.02, {"dc_motor_smc.delta": 0.8}).recording.topics
    assert source.branched == [
        {"at_s": 0.03, "from_s": 0.08, "left": "left_1.yaml"},
        {"at_s": 0.02, "from_s": 0.03, "left": "left_2.yaml"},
    ]


def test_a_full_disk_does_not_affect_a_run_in_the_process_of_its_page(tmp_path, monkeypatch, capsys):
    """What cannot be written is left out, shards for a killed process are given up once, and a run can be ended
    again.
    """
    (tmp_path / "log").mkdir()
    for full in ("log/rig.shard", f".left_1.yaml.{os.getpid()}.part"):
        (tmp_path / full).symlink_to("/dev/full")
    plain = SessionSource(Session("dc_motor_smc", duration=0.1), True, 1.0)
    plain.session.go(0.05)
    plain._place = lambda: tmp_path
    plain.control.go_back("me", 0.0)  # no parameter was changed, so no branch is kept
    assert plain.session.t == 0.0
    source = SessionSource(Session("dc_motor_smc", duration=0.1), True, 1.0, folder=lambda: tmp_path)
    source.control.turn("me", "dc_motor_smc.delta", 0.5)
    source.session.go(0.05)
    source.read_new()
    source.read_new()
    assert capsys.readouterr().err.count("nothing can be repaired if this process is killed: [Errno 28]") == 1
    source.control.go_back("me", 0.0)
    assert re.match(r"back to 0 s refused: .*No space left on device", source.control.entries[-1].text)
    assert (source.session.t, source.branched) == (0.05, [])
    source.control.go_back("me", 0.0)  # the refused file leaves no link behind
    assert (source.session.t, source.branched[0]["left"]) == (0.0, "left_1.yaml")

    written, outcomes = [], []

    def conclude(run, into):
        written.append((into.path.name, sum(len(topic.times) for topic in run.recording.topics.values())))
        if len(written) == 1:
            raise OSError(errno.ENOSPC, "No space left on device")
        (into.path / "metrics.json").write_text('{"metrics": [], "nodes": {}}')
        return 0

    class Pages:
        url = ""

        def __init__(self, source, control, *_):
            self.source, self.control = source, control

        def measure(self):
            if self.source.outcome:
                outcomes.append(self.source.outcome)
                self.control.go_back("me", 0.0)
            elif self.control.held:
                self.control.hold("me", "resume")

        def left(self):
            return len(outcomes) == 2

        def close(self):
            pass

    monkeypatch.setattr("softrig_bringup.view.here.Pages", Pages)
    folder = ResultsFolder(tmp_path / "run")
    folder.clear()
    rig = rig_of(load_scenario("dc_motor_smc").having(duration=0.01))
    assert show_here(rig, Placement("inprocess", paused=False, pace=0.0), "127.0.0.1:0", folder, conclude) == 0
    assert "it is not written: [Errno 28]" in outcomes[0]
    assert outcomes[1] == "ended"
    assert [name for name, _ in written] == ["run", "run-2"]
    assert written[0][1] == written[1][1] > 0

    def broken(run, into):
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):  # an error in softrig ends the run instead of blocking it
        show_here(rig, Placement("inprocess", paused=False, pace=0.0), "127.0.0.1:0", folder, broken)


def test_a_page_in_the_process_of_its_rig_keeps_the_pace_whatever_people_do(monkeypatch):
    """A tick takes a second of wall-clock time, or half of one; ten actions within it must not trigger a tick each."""
    clock = SimpleNamespace(now=0.0, monotonic=lambda: clock.now)
    monkeypatch.setattr("softrig_bringup.view.here.time", clock)
    source = SessionSource(Session("dc_motor_smc", duration=0.1), False, PERIOD := 1e-4)
    knob, control = "dc_motor_smc.delta", source.control

    def ticks(seconds, do):
        """The number of ticks while an action was repeated at each tenth."""
        first = source.session.t
        for k in range(10 * seconds):
            do(k)
            for _ in range(10):
                clock.now += 0.01
                source.turn()
        return (source.session.t - first) / PERIOD

    assert ticks(10, lambda k: None) == pytest.approx(10, abs=1.01)
    assert ticks(10, lambda k: control.go_at("me", PERIOD * (1 + k % 2))) == pytest.approx(15, abs=1.01)
    assert ticks(10, lambda k: control.turn("me", knob, 1.0 + k)) == pytest.approx(20, abs=1.01)
    assert ticks(10, lambda k: control.hold("me", ("pause", "resume")[k % 2])) == pytest.approx(10, abs=1.01)
    control.hold("me", "pause")
    assert ticks(10, lambda k: control.hold("me", "step")) == pytest.approx(100)
    control.hold("me", "resume")
    assert ticks(10, lambda k: None) == pytest.approx(20, abs=1.01)
    clock.now += 60.0  # the clock does not catch up the minute for which the process was stopped
    assert ticks(1, lambda k: None) == pytest.approx(3, abs=1.01)


def test_requests_of_a_browser_run_in_the_thread_of_the_ticks():
    asked = []
    source = SessionSource(Session("dc_motor_smc", duration=0.1), True, 1.0, asked.append)
    source.session.go(0.05)
    source.control.go_back("me", 0.02)  # Bokeh calls this in its own thread
    assert source.session.t == 0.05
    asked.pop()()
    assert source.session.t == 0.02


@pytest.mark.parametrize("at", ["0.0.0.0:0", pytest.param("127.0.0.1:0", marks=pytest.mark.long)])
def test_only_requests_with_the_token_are_accepted(tmp_path, at):
    assert main(["run", "dc_motor_smc", "--mode", "inprocess", "--duration", "0.05", "--no-plots", "--out",
                 str(tmp_path / "run")]) in (0, 1)  # fmt: skip
    with forked("view", tmp_path / "run", "--address", at) as process:
        base, token = address(process).split("?token=")
        for wanted in (
            "",
            "view",
            "view?token=wrong",
            "view?token=%C3%A4",
            "view/autoload.js?bokeh-autoload-element=1",
        ):
            with pytest.raises(HTTPError, match="403: expected the address of the page with its token"):
                urlopen(base + wanted)
        for text in ({}, {"token": "wrong"}):
            with pytest.raises(OSError, match="error code: 403"):
                Browser(base, **text)
        kept = build_opener(HTTPCookieProcessor())
        assert b"dc_motor_smc - softrig" in kept.open(f"{base}?token={token}").read()
        # A browser requests this when it reloads the page.
        assert b"dc_motor_smc - softrig" in kept.open(f"{base}view").read()
        evil = Request(f"{base}view?token={token}", headers={"Host": f"evil.example:{urlsplit(base).port}"})
        if at.startswith("127"):  # a foreign host name can resolve to this address
            with pytest.raises(HTTPError, match="403: the page is served to this host only, expected its own address"):
                urlopen(evil)
        else:
            assert urlopen(evil).status == 200
        browser = Browser(base, token=token)
        browser.until(lambda: "0.05 s, recorded" in browser["state"].text)
        browser["window"].value = "abc"
        browser.until(lambda: browser["window"].value == "all")
        browser.close()
        process.send_signal(signal.SIGINT)
        assert "Traceback" not in process.stderr.read()


def test_an_invalid_message_of_a_browser_is_reported_in_one_line(caplog):
    logger = logging.getLogger("bokeh.server.protocol_handler")
    logger.addFilter(one := OneLine())
    try:
        try:
            int(math.nan)
        except ValueError:
            logger.error("error handling message", exc_info=True)
    finally:
        logger.removeFilter(one)
    assert "Traceback" not in caplog.text
    assert "a page sent an invalid message: ValueError: cannot convert float NaN to integer" in caplog.text


def test_a_flood_of_invalid_messages_of_a_browser_is_a_few_lines(caplog):
    logger = logging.getLogger("bokeh.server.views.ws")
    logger.addFilter(one := OneLine())
    try:
        for k in range(3000):
            logger.error("no message of ours: %s", f"{k} {'x' * 500}")
    finally:
        logger.removeFilter(one)
    lines = [record.getMessage() for record in caplog.records]
    assert [line.partition(" x")[0] for line in lines] == [
        f"no message of ours: {k}" for k in (0, 1, 2, 3, 4, 9, 99, 999)
    ]
    assert [line.rpartition("(")[2] for line in lines[5:]] == [f"{n} lines like this by now)" for n in (10, 100, 1000)]
    assert max(map(len, lines)) < 350


def test_a_track_keeps_extremes_and_stays_small():
    track = Track(limit=1000)
    x = np.random.default_rng(1).normal(size=50_000)
    x[123], x[40_000] = 50.0, -60.0
    for first in range(0, 50_000, 700):
        part = slice(first, first + 700)
        track.append(np.arange(50_000.0)[part], {"x": x[part]})
    table = track.table(0.0, 1e9)
    assert len(table.t) <= 1000
    assert track.thinned
    assert (table.columns["x"].max(), table.columns["x"].min()) == (50.0, -60.0)
    assert np.all(np.diff(table.t) >= 0)
    assert np.array_equal(table.columns["x"][-300:], x[-300:])  # the newest rows are not thinned


def test_a_slider_changes_its_parameter_and_follows_it():
    asked, document = [], Document()
    rig = rig_of("dc_motor_smc_faults")
    control = Control(rig, lambda *words: asked.append(words), lambda: 0.0, lambda: "")
    page = Page(document, Recorded(rig, Signals(Recording([])), {}), control, lambda: ((), True), "me", "here", "light")
    number, slider = (document.select_one({"name": f"noise.probability{what}"}) for what in ("", " slider"))
    assert (slider.start, slider.end, slider.value) == (0.0, 1.0, 1.0)
    # A parameter without an upper bound has no slider.
    assert document.select_one({"name": "noise.start slider"}) is None
    slider.value = 0.5  # the slider is still dragged
    assert not asked
    slider.trigger("value_throttled", 1.0, 0.25)  # a browser sends this event when the slider is released
    ((request, answered),) = asked
    assert request == {"node": "noise", "set": {"probability": 0.25}}
    answered(False, "no")
    page.update()
    assert (number.value, slider.value) == ("1.0", 1.0)
    slider.trigger("value_throttled", 0.25, 0.75)
    asked[-1][1](True, "")
    document.select_one({"name": "echo"}).text = document.select_one({"name": "beat"}).text
    page.update()
    assert (number.value, slider.value) == ("0.75", 0.75)
    assert len(asked) == 2
    for typed in ("0,5", "0.5 V", ""):  # the whole text must be a number
        number.value = typed
        assert (
            control.entries[-1].text == f"noise.probability = {typed!r} refused: expected a number, such as 2.5 or 1e-3"
        )
    number.value = "5e-1"
    assert asked[2][0] == {"node": "noise", "set": {"probability": 0.5}}
    assert len(asked) == 3


@pytest.mark.parametrize(
    ("bounds", "value", "ends"),
    [
        ((0.0, 1.0), 0.0, (0.0, 1.0)),
        ((0.0, 1e4), 0.0, None),
        # The slider covers the declared range up to twenty times the value, or up to 20.
        ((0.0, 20.0), 0.0, (0.0, 20.0)),
        ((0.0, 20.5), 0.0, None),
        ((0.0, 20.0), 0.5, (0.0, 20.0)),
        ((0.0, 21.0), 0.5, (0.0, 2.0)),
        ((-10.0, 50.0), 3.0, (-10.0, 50.0)),
        ((-10.0, 50.5), 3.0, (-6.0, 12.0)),
        ((0.0, math.inf), 1.0, None),
        ((-10.0, 10.0), 2, (-10, 10)),
        ((0.0, 1e7), 5.0, (0.0, 20.0)),
        ((-1e7, 1e7), -5.0, (-20.0, 10.0)),
        ((0.0, 1.0), None, None),
        ((0.0, 1.0), 0.01, (0.0, 1.0)),
    ],
)
def test_a_slider_spans_a_range_around_its_value(bounds, value, ends):
    assert reach(Knob("node", "name", "", "", value, float, bounds)) == ends


def test_requests_to_a_completed_run_or_a_recording_are_refused_in_one_line():
    asked, over = [], ["ended"]
    control = Control(rig_of("dc_motor_smc"), lambda *words: asked.append(words), lambda: 1.0, lambda: over[0])
    control.turn("me", "dc_motor_smc.k", 3.0)
    assert control.entries[-1].wrong
    assert "the run is over" in control.entries[-1].text
    over[0] = ""
    control.turn("me", "dc_motor_smc.k", 3)
    ((request, answered),) = asked
    assert request == {"node": "dc_motor_smc", "set": {"k": 3.0}}
    answered(False, "no")
    assert (
        control.entries[-1].text == "dc_motor_smc.k = 3 rad/s^2 refused: no"
        or "refused: no" in control.entries[-1].text
    )
    assert control.knobs["dc_motor_smc.k"].value != 3.0
    answered(True, "")
    assert control.knobs["dc_motor_smc.k"].value == 3.0


def test_the_parameters_of_controllers_come_first_and_those_of_plants_and_sources_last():
    control = Control(rig_of("dc_motor_smc_faults"), lambda *words: None, lambda: 0.0, lambda: "")
    assert [*dict.fromkeys(control.roles.values())] == ["law", "fault", "source", "plant"]
    assert next(iter(control.roles)) == "dc_motor_smc"
    assert next(iter(control.knobs)).startswith("dc_motor_smc.")


def test_a_picture_that_enlarges_another_is_not_shown_twice():
    rig = rig_of("dc_motor_smc")
    plots = {p.title: p.window for p in rig.scenario.plots}
    assert plots["Armature voltage, enlarged"] is not None
    assert {p.title for p in plots_of(rig)} == plots.keys() - {"Armature voltage, enlarged"}


def test_pictures_begin_with_the_length_of_the_run_and_the_drawing_at_rest():
    document, rig = Document(), rig_of("dc_motor_smc_b2")
    source = Recorded(rig, Signals(Recording([])), {})
    source.live, source.outcome, source.length = True, "", 6.0
    control = Control(rig, lambda *words: None, lambda: 0.0, lambda: "", True, 1.0)
    page = Page(document, source, control, lambda: ((), True), "me", "here", "light")
    page.update()
    assert (page.time.start, page.time.end) == (0.0, 6.0)
    assert "<svg" in document.select_one({"name": "drawing"}).text
    assert "0 of 6 s, paused" in document.select_one({"name": "state"}).text
    control.held = False
    echo, beat = (document.select_one({"name": name}) for name in ("echo", "beat"))
    echo.text = beat.text
    page.update()
    assert "running at the wall&#x27;s pace" in document.select_one({"name": "state"}).text


def test_a_page_names_the_nodes_that_a_starting_rig_waits_for(tmp_path):
    document, rig = Document(), rig_of("dc_motor_smc_b2")
    source = Live(rig, tmp_path, False)
    control = Control(rig, lambda *words: None, lambda: 0.0, lambda: "", True, 1.0)
    page = Page(document, source, control, lambda: ((), True), "me", "here", "light")
    head, beat, echo = (document.select_one({"name": name}) for name in ("state", "beat", "echo"))

    def says(text, **states):
        for name, state in states.items():
            (tmp_path / f"{name}.status").write_text(json.dumps({"state": state, "epoch": 0}))
        source.read_new()
        for _ in range(SLOW):
            page.update()
            echo.text = beat.text
        assert re.search(text, head.text), head.text

    members = [m.name for m in rig.members]
    says(rf"0 of 6 s, starting for \d+ s, waits for {', '.join(members)}<")
    source._complete -= 1000.0
    says(r"starting for 1\d\d\d s, waits for dc_motor_plant<", **dict.fromkeys(members[1:], "starting"))
    # All nodes have started and discover each other.
    says(f"waits for {', '.join(members)}<", dc_motor_plant="starting")
    says("0 of 6 s, paused<", **dict.fromkeys(members, "running"))
    assert source.waited < 1000.0


def test_a_page_that_breaks_is_restarted_and_finally_the_run_continues_without_it(tmp_path, capsys, monkeypatch):
    asked = []
    monkeypatch.setattr(
        "softrig_bringup.view.run_pages.Remote",
        lambda *words: SimpleNamespace(ask=lambda request, answered: asked.append(request), close=lambda: None),
    )
    page = RunPages(
        load_scenario("dc_motor_smc"), tmp_path, Placement("container", paused=True, pace=1.0), "127.0.0.1:0"
    )
    monkeypatch.setattr(page, "_start", lambda: subprocess.Popen(["false"], stdin=subprocess.PIPE, text=True))
    page.open(7)
    page.keeper.join(PATIENCE)
    printed = capsys.readouterr().err
    assert printed.count("the page has broken (status 1): it is started again") == 3
    assert printed.count("the page has broken (status 1): the run continues without it") == 1
    assert asked == [{"node": "dc_motor_plant", "call": "resume"}]
    page.close()
