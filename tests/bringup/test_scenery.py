"""A robot's bag contains the robot: description, frames and path, with the same bytes in every placement."""

import hashlib
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from rosbags.interfaces import QosDurability
from softrig_bags.content.topics import typestore
from softrig_bags.files.reader import BagReader
from softrig_bags.read import read_bag, signals
from softrig_bringup.cli import main
from softrig_core import rig_of

# scenario, topic of the joints, tip, number of links that move
ROBOTS = [("manipulator_adsmc", "tool", 3), ("rehab_impedance", "foot", 2)]


def run(scenario, mode, out, duration="0.2"):
    main(["run", scenario, "--mode", mode, "--duration", duration, "--no-plots", "--out", str(out)])
    return out / "bag"


def messages(bag, topic):
    result = bag.recording.topics[topic]
    return [
        (t, typestore().deserialize_cdr(data, result.msgtype))
        for t, data in zip(result.times, result.data, strict=True)
    ]


def matrix(transform):
    p, q = transform.translation, transform.rotation
    return pin.SE3(pin.Quaternion(q.w, q.x, q.y, q.z).matrix(), np.array([p.x, p.y, p.z]))


@pytest.mark.parametrize(("scenario", "tip", "joints"), ROBOTS)
def test_the_frames_in_the_bag_are_forward_kinematics_of_its_description(tmp_path, scenario, tip, joints):
    bag = signals(run(scenario, "inprocess", tmp_path))
    ((start, text),) = messages(bag, "robot_description")
    model = pin.buildModelFromXML(text.data)
    data = model.createData()
    assert start == 0
    fixed = {t.child_frame_id: t for t in messages(bag, "tf_static")[0][1].transforms}
    frames = messages(bag, "tf")
    assert [t for t, _ in frames] == [k * 20_000_000 for k in range(11)]
    state = bag.table("joint_states")
    q = np.array([state.columns[f"{name}/position"] for name in list(model.names)[1:]]).T
    for t, message in frames:
        moving = {x.child_frame_id: x for x in message.transforms}
        assert len(moving) == joints
        assert {x.header.stamp.sec * 10**9 + x.header.stamp.nanosec for x in message.transforms} == {t}
        pin.framesForwardKinematics(model, data, q[np.flatnonzero(state.t == t / 1e9)[0]])
        for name in (*moving, tip):  # the chain from the base to each link
            place, at = pin.SE3.Identity(), name
            while at != "base_link":
                link = {**fixed, **moving}[at]
                place, at = matrix(link.transform) * place, link.header.frame_id
            wanted = data.oMf[model.getFrameId(name)]
            assert np.allclose(place.homogeneous, wanted.homogeneous, atol=1e-12)
    ((_, array),) = messages(bag, "markers")
    (line,) = array.markers
    assert line.header.frame_id == "base_link"
    end = line.points[-1]
    assert (end.x, end.y, end.z) == pytest.approx(data.oMf[model.getFrameId(tip)].translation.tolist(), abs=1e-12)
    assert np.ptp(q, axis=0).max() > 1e-6  # the joints move during the run


def test_frames_are_offered_to_late_subscribers_and_cost_little(tmp_path):
    with BagReader(run("manipulator_adsmc", "inprocess", tmp_path)) as bag:
        latched = {t.name for t in bag.topics if t.offered[0].durability == QosDurability.TRANSIENT_LOCAL}
        assert latched == {"/robot_description", "/tf_static", "/markers"}
        assert all(t.definition and t.digest.startswith("RIHS01_") for t in bag.topics)
        sizes = dict.fromkeys((t.name for t in bag.topics), 0)
        for i, _, data in bag.messages():
            sizes[bag.topics[i].name] += len(data)
    assert sizes["/tf"] < 0.05 * sum(sizes.values())


@pytest.mark.long
@pytest.mark.processes
def test_the_bag_is_the_same_from_processes_containers_and_in_process(tmp_path):
    modes = ("inprocess", "processes", "container")
    bags = [run("manipulator_adsmc", mode, tmp_path / mode, "0.1") for mode in modes]
    topics = [signals(b).recording.topics for b in bags]
    digests = [
        {name: hashlib.sha256(b"".join(t.data)).hexdigest() for name, t in result.items() if name != "/clock"}
        for result in topics
    ]
    assert {"tf", "tf_static", "robot_description", "markers"} <= set(digests[0])
    assert digests[0] == digests[1] == digests[2]


def test_a_rig_without_a_robot_has_no_such_topics(tmp_path):
    bag = signals(run("dc_motor_smc_b2", "inprocess", tmp_path))
    assert not {"tf", "robot_description"} & set(bag.recording.topics)
    assert Path(tmp_path / "bag").is_dir()


def test_record_all_adds_descriptions_health_and_figures_and_nothing_else_changes(tmp_path):
    words = ["run", "dc_motor_smc", "--mode", "inprocess", "--duration", "0.2", "--no-plots"]
    for name, more in (("plain", []), ("all", ["--record-all"]), ("again", ["--record-all"])):
        main([*words, *more, "--out", str(tmp_path / name)])
    plain, whole = (read_bag(tmp_path / name / "bag") for name in ("plain", "all"))
    assert all(whole.topics[name].data == topic.data for name, topic in plain.topics.items())
    assert whole.topics.keys() - plain.topics.keys() == {"robot_description", "diagnostics", "dc_motor_metrics/metrics"}
    (message,) = whole.topics["diagnostics"].data
    health = typestore().deserialize_cdr(message, "diagnostic_msgs/msg/DiagnosticArray")
    members = rig_of("dc_motor_smc").members
    assert [s.name for s in health.status] == sorted(f"/{m.name}" for m in members)
    assert {s.message for s in health.status} == {"done"}
    (text,) = whole.topics["robot_description"].data
    assert typestore().deserialize_cdr(text, "std_msgs/msg/String").data.endswith("</robot>\n")
    again = read_bag(tmp_path / "again" / "bag")
    assert {n: t.data for n, t in again.topics.items()} == {n: t.data for n, t in whole.topics.items()}
    with BagReader(tmp_path / "all" / "bag") as bag:
        latched = {t.name for t in bag.topics if t.offered[0].durability == QosDurability.TRANSIENT_LOCAL}
    assert latched == {"/robot_description"}
