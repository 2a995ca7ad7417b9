"""The page in a real browser: values are read from it, a gain is changed, a fault switched, a button pressed."""

import json
import os
import shutil
import signal

import pytest
from conftest import PATIENCE, SLOW_DRIVE, processes_of
from softrig_bags.read import signals
from softrig_bringup.cli import main
from test_view import address, running

CHROMIUM, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
pytestmark = [
    pytest.mark.processes,
    pytest.mark.skipif(not (CHROMIUM and DRIVER), reason="no chromium with its chromedriver on this machine"),
]
FLAGS = ("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync",
         "--disable-background-networking", "--disable-component-update", "--window-size=1400,1600")  # fmt: skip
SCENARIO = """
extends: induction_dtc
title: The drive under the hands of a person
duration: 0.3
{slow}faults:
  offset: {{link: joint_states -> speed_controller, kind: offset, value: [5.0], active: false}}
"""
# The properties of a widget in the page's script, by its name.
MODEL = "Bokeh.documents[0].get_model_by_name(arguments[0])"


class Chromium:
    def __init__(self, url):
        from selenium import webdriver
        from selenium.webdriver.support.ui import WebDriverWait

        options = webdriver.ChromeOptions()
        options.binary_location = CHROMIUM
        for flag in FLAGS:
            options.add_argument(flag)
        self.driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(DRIVER))
        self.wait = WebDriverWait(self.driver, PATIENCE)
        self.driver.get(url)
        self.until(
            "return window.Bokeh !== undefined && Bokeh.documents.length > 0 && "
            "Bokeh.documents[0].get_model_by_name('state') !== null"
        )

    def until(self, script, *arguments):
        return self.wait.until(lambda driver: driver.execute_script(script, *arguments))

    def text(self, name):
        return self.driver.execute_script(f"return {MODEL}.text", name)

    def says(self, text):
        self.until(f"return {MODEL}.text.includes(arguments[1])", "log", text)

    def click(self, name):
        """Press as a person would: the button in the shadow DOM of its widget."""
        self.driver.execute_script(
            f"const m = {MODEL}; const v = Bokeh.index.find_one(m); v.shadow_el.querySelector('button').click()", name
        )

    def turn(self, name, attribute, value):
        self.driver.execute_script(f"{MODEL}[arguments[1]] = arguments[2]", name, attribute, value)


@pytest.mark.long
@pytest.mark.parametrize("pace", ["lockstep", "real time"])
def test_a_person_uses_the_page_of_the_induction_motor(tmp_path, capsys, pace):
    file, out = tmp_path / "drive.yaml", tmp_path / "run"
    file.write_text(SCENARIO.format(slow=SLOW_DRIVE if pace == "real time" else ""))
    live = ("view", file, "--realtime", "--duration", 10)
    with running(*(live if pace == "real time" else ("view", file)), "--no-plots", "--out", out) as process:
        browser = Chromium(address(process))
        try:
            browser.until(f"return {MODEL}.label === 'resume'", "hold")
            browser.click("step")
            browser.says("step: one step")
            browser.turn("speed_controller.kp", "value", "2.5")
            browser.says("speed_controller.kp = 2.5")
            browser.turn("offset.active", "active", True)
            browser.says("offset.active = True")
            browser.turn("offset.probability slider", "value_throttled", 0.5)
            browser.says("offset.probability = 0.5")
            browser.click("offset/toggle")
            browser.says("offset/toggle: toggle pressed")
            browser.click("hold")
            if pace == "real time":  # pause and resume the run once
                browser.until(f"return {MODEL}.text.includes('running')", "state")
                browser.click("hold")
                browser.until(f"return {MODEL}.text.includes('paused')", "state")
                browser.click("hold")
            browser.until(f"return {MODEL}.text.includes('ended')", "state")
            browser.says("kp = 2.5 from this tick on")
            speed = browser.driver.execute_script(
                f"const d = {MODEL}.data; return [d.x[d.x.length - 1], d.y[d.y.length - 1]]",
                "Speed: joint_states/shaft/velocity",
            )
            marks = browser.driver.execute_script(f"return Array.from({MODEL}.data.t)", "changes")
        finally:
            browser.driver.quit()
        process.wait(PATIENCE)
    metrics = json.loads((out / "metrics.json").read_text())
    changes = metrics["changes"]
    turned = {(c["node"], k): v for c in changes for k, v in c["set"].items()}
    assert turned["speed_controller", "kp"] == 2.5
    assert ("offset", "active") in turned
    assert marks == sorted(c["at_s"] for c in changes)
    result = signals(out / "bag")
    t, velocity = result["joint_states/shaft/velocity"]
    assert speed == [t[-1], velocity[-1]]
    assert result["joint_states/offset/toggle/data"].x.max() == 1.0
    capsys.readouterr()
    assert main(["run", "--like", str(out), "--mode", "inprocess", "--no-plots", "--out", str(tmp_path / "again")]) == 0
    printed = capsys.readouterr().err
    late = pace == "real time" and "that run was late: " in printed  # the machine may be too slow for real time
    assert "run number for number: " in printed or (late and "differs from" in printed), printed


@pytest.mark.long
def test_a_page_whose_server_is_killed_is_restarted_and_the_run_continues(tmp_path):
    with running("view", "dc_motor_smc_b2", "--no-plots", "--out", tmp_path / "run") as process:
        browser = Chromium(address(process))
        try:
            browser.until(f"return {MODEL}.label === 'resume'", "hold")
            browser.driver.execute_script("window.before = true")
            (page,) = (p for p, command in processes_of(tmp_path).items() if b"softrig_bringup.view.serve" in command)
            os.kill(page, signal.SIGKILL)
            browser.until("return window.before === undefined && window.Bokeh !== undefined && Bokeh.documents.length")
            browser.until(f"return {MODEL} && {MODEL}.label === 'resume'", "hold")
            browser.click("hold")
            browser.until(f"return {MODEL}.text.includes('the run is over')", "state")
        finally:
            browser.driver.quit()
        assert process.wait(PATIENCE) == 0


@pytest.mark.long
def test_a_run_is_rewound_and_continued_with_another_gain(tmp_path, capsys):
    """In process: the branch equals what `run --from` makes of it, byte for byte; the run that had ended stays."""
    out = tmp_path / "run"
    arguments = ("view", "dc_motor_smc_b2", "--mode", "inprocess", "--pace", "full", "--duration", 1, "--no-plots")
    with running(*arguments, "--out", out) as process:
        browser = Chromium(address(process))
        try:
            browser.until(f"return {MODEL}.label === 'resume'", "hold")
            browser.click("hold")
            browser.until(f"return {MODEL}.text.includes('the run is over')", "state")
            browser.turn("back to", "value", "0.5")
            browser.click("go back")
            browser.says("back to 0.5 s from 1 s")
            browser.until(f"return {MODEL}.text.includes('paused')", "state")
            browser.turn("dc_motor_smc.delta", "value", "2")
            browser.says("dc_motor_smc.delta = 2")
            browser.click("hold")
            browser.until(f"return {MODEL}.text.includes('the run is over')", "state")
        finally:
            browser.driver.quit()
        assert process.wait(PATIENCE) == 0
    capsys.readouterr()
    changed = ["--set", "dc_motor_smc.delta=2", "--no-plots", "--out", str(tmp_path / "again")]
    assert main(["run", "--from", f"{out}@0.5", *changed]) == 0
    branch, again = tmp_path / "run-2" / "bag", tmp_path / "again" / "bag"
    assert main(["bag", "compare", str(branch), str(again)]) == 0, capsys.readouterr().out
    assert main(["bag", "compare", str(branch), str(out / "bag")]) == 1
