"""The statements of the pages about a C++ node and a class of thirty are true for the rig and for `check`."""

import csv
import re
import xml.etree.ElementTree as ElementTree

from docs.outline import pages
from softrig_bringup.cli import main
from softrig_core import load_scenario, rig_of


def fenced(name, language):
    return re.findall(rf"^```{language}\n(.*?)^```$", pages()[name].read_text(), re.S | re.M)


def test_the_node_in_cpp_publishes_as_the_rig_expects():
    """Topics, types and channels; the package declares what the code includes."""
    (code,) = fenced("cpp_node", "cpp")
    (cmake,) = fenced("cpp_node", "cmake")
    manifest = ElementTree.fromstring(fenced("cpp_node", "xml")[0])
    rig = rig_of(load_scenario("dc_motor_smc_b2"))
    law = next(m for m in rig.members if m.name == "dc_motor_smc")
    messages = dict(re.findall(r'create_(publisher|subscription)<[\w:]+>\(\s*"([^"]+)"', code))
    types = set(re.findall(r"create_(?:publisher|subscription)<(\w+)::msg::(\w+)>", code))
    command = next(p for p in law.outputs if p.topic == messages["publisher"])
    state = next(p for p in law.inputs if p.topic == messages["subscription"])
    assert {command.msgtype, state.msgtype} == {f"{package}/msg/{name}" for package, name in types}
    assert re.findall(r'command\.name = \{"(\w+)"\}', code) == [label.split("/")[0] for label in command.labels]
    assert any(label.endswith("/velocity") for label in state.labels)
    depends = {e.text for e in manifest.findall("depend")}
    assert (
        depends == {"rclcpp", "sensor_msgs"} == set(re.findall(r"find_package\((?!ament_cmake)(\w+) REQUIRED", cmake))
    )
    assert manifest.findtext("name") == re.search(r"project\((\w+)\)", cmake)[1]
    assert code.count("{") == code.count("}")


def test_the_task_of_the_class_is_judged_as_expected(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for text in fenced("classroom", "yaml"):
        place = tmp_path / re.match(r"# (\S+)\n", text)[1]
        place.parent.mkdir(exist_ok=True)
        place.write_text(text)
    assert main(["check", "--against", "expect1.yaml", "ann/task1.yaml", "--marks", "marks.csv", "--workers", "1"]) in (
        0,
        1,
    )
    assert "differs from expect1.yaml: nodes.dc_motor_pid.parameters.kp" in capsys.readouterr().out
    with (tmp_path / "marks.csv").open() as file:
        (row,) = csv.DictReader(file)
    assert (row["scenario"], row["judged"], row["error"]) == ("ann/task1.yaml", "2", "")
    assert float(row["peak (%)"]) > 5.0
