"""What ROS users find in a package: a changelog that bloom reads, and a page with all arguments of the launch file."""

import re
from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree

import pytest
import yaml
from softrig_bringup.launched import ARGUMENTS
from softrig_bringup.view.rviz import viewer
from softrig_core import ByHand, list_scenarios, load_scenario, rig_of
from softrig_core.block.port import WORLD
from softrig_core.block.scene import scene_of, standing

PACKAGES = Path(__file__).parents[2] / "ros_pkgs"


@pytest.mark.parametrize("package", sorted(p.parent.name for p in PACKAGES.glob("*/package.xml")))
def test_the_changelog_has_the_form_that_bloom_reads(package):
    """The package's name between two bars, then sections of versions: unreleased, or that of package.xml."""
    lines = (PACKAGES / package / "CHANGELOG.rst").read_text().splitlines()
    title = f"Changelog for package {package}"
    assert lines[:4] == ["^" * len(title), title, "^" * len(title), ""]
    sections = [(a, b) for a, b in pairwise(lines[4:]) if b and not b.strip("-")]
    assert all(len(a) == len(b) for a, b in sections)
    version = re.search("<version>(.*)</version>", (PACKAGES / package / "package.xml").read_text())[1]
    assert f"version = {version}" in (PACKAGES / package / "setup.cfg").read_text().splitlines()
    assert re.fullmatch(rf"Forthcoming|{re.escape(version)} \(\d{{4}}-\d\d-\d\d\)", sections[0][0])
    assert any(line.startswith("* ") for line in lines)


def test_the_page_of_the_workspace_has_every_argument_of_the_launch_file_and_no_other():
    page = (PACKAGES / "softrig_bringup/doc/workspace.md").read_text().partition("## ")[0]
    rows = re.findall(r"^\| (`\w+`(?:, `\w+`)*) \| .* \|$", page, re.M)
    assert {name.strip(" `") for row in rows for name in row.split(",")} == set(ARGUMENTS)


@pytest.mark.parametrize(
    "name", ["manipulator_adsmc", "rehab_impedance", "lsrm_fuzzy", "fault_location", "dc_motor_smc"]
)
def test_rviz_shows_what_the_nodes_publish_in_frames_that_they_publish(name, tmp_path):
    rig = rig_of(load_scenario(first(name)))
    rviz = viewer(rig, tmp_path, "a", simulated=True)
    shown = yaml.safe_load(Path(rviz.arguments[1]).read_text())["Visualization Manager"]
    assert shown["Global Options"]["Fixed Frame"] == WORLD
    placed, drawn = {WORLD}, {}
    for m in rig.members:
        block, scene = ByHand(m.block(0)), scene_of(m.block_class, m.params)
        still = standing(block.markers(), scene, m.outputs)
        assert {pose.parent for pose in still} <= {WORLD, *(pose.child for pose in still)} | links(scene)
        placed |= {pose.child for pose in still}
        drawn[m.name] = {k.frame_id for k in block.markers()}
        if scene is not None:
            robot = ElementTree.fromstring(scene.description)
            port = next(p for p in m.outputs if p.name == scene.port)
            moving = {j.get("name") for j in robot.iter("joint") if j.get("type") != "fixed"}
            assert port.msgtype == "sensor_msgs/msg/JointState"
            assert moving == {label.rpartition("/")[0] for label in port.labels}
            poses = scene.moving([0.0] * len(moving))
            assert links(scene) <= {WORLD, *(pose.child for pose in (*still, *poses))}
            assert "/a/robot_description" in [d.get("Description Topic", {}).get("Value") for d in shown["Displays"]]
    assert {frame for result in drawn.values() for frame in result} <= placed
    topics = {d["Topic"]["Value"] for d in shown["Displays"] if "Topic" in d}
    assert {f"/a/{node}/markers" for node, result in drawn.items() if result} <= topics
    assert ("/tf", "/a/tf") in rviz.remappings


def links(scene):
    return set() if scene is None else {x.get("name") for x in ElementTree.fromstring(scene.description).iter("link")}


@pytest.mark.parametrize(
    ("scenario", "config"),
    [
        ("rehab_impedance", "softrig_robots/config/rehab_leg_controllers.yaml"),
        ("manipulator_adsmc", "softrig_robots/config/manipulator_controllers.yaml"),
        ("dc_motor_smc_b1", "softrig_drives/config/dc_motor_controllers.yaml"),
        ("dc_motor_fsfb", "softrig_drives/config/dc_axis_controllers.yaml"),
        ("lsrm_fuzzy", "softrig_drives/config/lsrm_controllers.yaml"),
    ],
)
def test_the_tag_of_ros2_control_and_the_controllers_fit_the_plant(scenario, config):
    rig = rig_of(scenario)
    plant = next(m for m in rig.members if m.is_plant)
    robot = ElementTree.fromstring(plant.block(0).latched()["robot_description"])
    tag = robot.find("ros2_control")
    moving = {j.get("name") for j in robot.findall("joint") if j.get("type") != "fixed"}
    assert {j.get("name") for j in tag.findall("joint")} == moving
    system = {p.get("name"): p.text for p in tag.find("hardware").iter("param")}
    states = next(p for p in plant.outputs if f"/{p.topic}" == system["joint_states_topic"])
    commands = next(p for m in rig.members for p in m.inputs if f"/{p.topic}" == system["joint_commands_topic"])
    known = set(commands.also or commands.channels)
    names = {f"{j.get('name')}/{i.get('name')}" for j in tag.findall("joint") for i in j.findall("state_interface")}
    assert names == set(states.labels)
    wanted = {f"{j.get('name')}/{i.get('name')}" for j in tag.findall("joint") for i in j.findall("command_interface")}
    assert wanted == {f"{name}/{field}" for name in known for field in commands.fields}
    # The driver must send a command even if it has not changed.
    assert float(system["trigger_joint_command_threshold"]) < 0
    content = yaml.safe_load((PACKAGES / config).read_text())
    manager = content.pop("controller_manager")["ros__parameters"]
    law = next(m for m in rig.members for p in m.outputs if p.topic == commands.topic)
    assert manager.pop("update_rate") * law.params.period == 1
    assert set(manager) == set(content)
    for entry in content.values():
        parameters = entry["ros__parameters"]
        kinds = parameters.get("command_interfaces") or [
            parameters.get("interface_name") or parameters["command_interface"]
        ]
        joints = parameters.get("joints") or parameters["dof_names"]
        assert {f"{j}/{k}" for j in joints for k in kinds} <= wanted
        kinds = parameters.get("state_interfaces", parameters.get("reference_and_state_interfaces", []))
        assert {f"{j}/{k}" for j in joints for k in kinds} <= names


def test_the_scenario_of_the_page_uses_an_array_in_place_of_a_controller(tmp_path):
    page = (PACKAGES / "softrig_bringup/doc/workspace.md").read_text()
    (block,) = re.findall(r"((?:^    .*\n)+)", page[page.index("to a `forward_command_controller`") :], re.M)[:1]
    (tmp_path / "mine.yaml").write_text(re.sub("^    ", "", block, flags=re.M))
    rig = rig_of(load_scenario(str(tmp_path / "mine.yaml")))
    forward = next(m for m in rig.members if m.name == "forward_command_controller")
    assert [p.topic for p in forward.inputs] == ["forward_command_controller/commands"]
    assert [(m.name, p.name) for m, p in rig.readers(forward, forward.outputs[0])] == [("dc_motor_plant", "command")]
    assert "dc_motor_smc" not in [m.name for m in rig.members]


def first(system):
    return next(name for name in list_scenarios() if name.startswith(system))
