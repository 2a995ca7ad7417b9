"""Layouts for other viewers: they have the plots of a scenario, and name fields that messages have."""

import json
import re
from functools import cache
from xml.etree import ElementTree

import pytest
from conftest import few
from docs.gallery import sentences
from softrig_bags.content.topics import typestore
from softrig_bringup.cli import main
from softrig_bringup.verbs.layouts import files
from softrig_core import ScenarioError, load_scenario, rig_of, simulate

# For each system the scenario named by the README or, if it has no plots, the one named as the system.
SHOWN = {name: scenario if load_scenario(scenario).plots else name for name, (scenario, _) in sentences().items()}


@pytest.mark.parametrize("name", SHOWN)
def test_each_system_has_layouts_with_all_its_plots(name):
    rig = rig_of(SHOWN[name])
    made = files(rig)
    panels = json.loads(made[f"{SHOWN[name]}.foxglove.json"])["configById"].values()
    tabs = [tab.get("tab_name") for tab in ElementTree.fromstring(made[f"{SHOWN[name]}.plotjuggler.xml"]).iter("Tab")]
    for titles in ([panel.get("foxglovePanelTitle", "") for panel in panels], tabs):
        assert all(any(title.startswith(entry.title) for title in titles) for entry in rig.scenario.plots), titles


def test_legends_and_titles_have_units():
    made = files(rig_of("pmsm_foc"))
    panels = json.loads(made["pmsm_foc.foxglove.json"])["configById"].values()
    labels = {path["value"]: path["label"] for panel in panels for path in panel["paths"]}
    assert labels["/joint_states.velocity[0]"] == "speed (rad/s)"
    assert labels["/currents.vector.x"].endswith("(A)")
    assert 'tab_name="Torque, N m"' in made["pmsm_foc.plotjuggler.xml"]


@cache
def run(name):
    return simulate(name)


def value(message, path):
    """Follow a message path as Foxglove does: fields by dots, elements by index."""
    for part in re.findall(r"\w+", path):
        message = message[int(part)] if part.isdigit() else getattr(message, part)
    return float(message)


# Message types: JointState and trajectory; wrench; vector and array.
@pytest.mark.parametrize("name", few(["induction_dtc_short", "rehab_impedance_r5", "fault_location_m4k"], 2))
def test_the_paths_lead_to_the_values_of_the_signals(name):
    recording, signals = run(name).recording, run(name).signals
    rig = run(name).rig
    panels = json.loads(files(rig)[f"{name}.foxglove.json"])["configById"]
    paths = {path["value"] for panel in panels.values() for path in panel.get("paths", ())}
    wanted = {part for entry in rig.scenario.plots for s in entry.signals for part in s.split(" - ")}
    tree = ElementTree.fromstring(files(rig)[f"{name}.plotjuggler.xml"])
    series = {c.get("curve_y") or c.get("name") for c in tree.iter("curve")}
    assert len(paths) == len(wanted) == len(series)
    results = set()
    for path in sorted(paths):
        topic, _, place = path[1:].partition(".")
        received = recording.topics[topic]
        if not received.times:
            continue
        message = typestore().deserialize_cdr(received.data[-1], received.msgtype)
        matching = {s for s in wanted if s.startswith(f"{topic}/") and signals[s].x[-1] == value(message, place)}
        assert matching, path
        results |= matching
    silent = {s for s in wanted if not recording.topics[next(t for t in rig.topics if s.startswith(f"{t}/"))].times}
    assert results == wanted - silent


def test_plotjuggler_reads_a_joint_state_by_its_channels_and_a_trajectory_by_index():
    tree = ElementTree.fromstring(files(rig_of("induction_dtc"))["induction_dtc.plotjuggler.xml"])
    series = {c.get("curve_y") or c.get("name") for c in tree.iter("curve")}
    assert {"/joint_states/shaft/effort", "/speed_ref/points[0]/velocities[0]", "/flux_true/vector/y"} <= series
    selected = tree.find("Plugins/plugin/selected_topics").get("value").split(";")
    assert "/speed_ref" in selected
    assert all(any(name.startswith(f"{topic}/") for topic in selected) for name in series)


def test_the_verb_writes_layouts_and_reports_what_it_cannot(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["draw", "layouts", "lsrm_fuzzy", "--out", "for/others"]) == 0
    (tmp_path / "for/others").rename(tmp_path / "layouts")
    names = ["lsrm_fuzzy.foxglove.json", "lsrm_fuzzy.plotjuggler.xml", "lsrm_fuzzy.rviz"]
    assert sorted(p.name for p in (tmp_path / "layouts").iterdir()) == names
    rviz = json.loads((tmp_path / "layouts" / "lsrm_fuzzy.rviz").read_text())["Visualization Manager"]
    assert rviz["Global Options"]["Fixed Frame"] == "world"
    assert "/lsrm_plant/markers" in [d["Name"] for d in rviz["Displays"]]
    assert main(["draw", "layouts", "pwa_delay_margin"]) == 2
    assert "pwa_delay_margin has no plots, from which layouts are made" in capsys.readouterr().err
    with pytest.raises(ScenarioError, match="no plots"):
        files(rig_of("pwa_delay_margin"))
