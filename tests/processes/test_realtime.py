"""Nodes in real time, started one by one as a user does: watchdog, recovery, second publishers, bad input."""

import mmap
import re
import struct
import time
from contextlib import contextmanager

import pytest
import rclpy
from conftest import PATIENCE, PRESS, ears, make_scenario
from outside import SPIN, go, outside
from rclpy.context import Context
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.task import Future
from softrig_core import Signals, rig_of
from softrig_nodes import run_processes
from softrig_nodes.processes.domain import free_domain
from softrig_nodes.processes.placement import Placement
from softrig_nodes.ros.ros import RosMiddleware, ServingNode

pytestmark = pytest.mark.processes

STATE, COMMAND, APPLIED = "lag/state/x/position", "lag/command/u/effort", "lag/applied/u/effort"


def recorded(bench, name, signal, number):
    """Wait until a node has recorded a number of values: checks four times a second, as often as a status file is
    written.
    """
    bench.wait(lambda: bench.signal(name, signal).x.size > number)


def goes_on(bench, ticks):
    """Wait until the plant has run a number of further ticks."""
    recorded(bench, "plant", STATE, bench.signal("plant", STATE).x.size + ticks)


def test_nodes_started_one_by_one_close_the_loop_and_stop_on_ctrl_c(bench):
    bench.start("plant", "plant")
    bench.start("source", "source")
    bench.start("gain", "gain")
    recorded(bench, "gain", COMMAND, 50)
    for name in ("gain", "plant"):
        bench.nodes[name].send_signal(2)
        assert bench.ends(name) == 0
    t, x = bench.signal("plant", STATE)
    assert abs(x).max() > 0.01
    # The wall clock sets the rate: message n is stamped n periods after the first, including missed ones.
    assert t[-1] - t[0] == pytest.approx(0.01 * (len(t) - 1 + bench.status("plant")["missed_deadlines"]), abs=1e-6)
    assert bench.status("plant")["round_trip_p50_ms"] < 1000


def test_a_lockstep_node_without_peers_and_end_does_not_run_away(bench):
    """Found by a campaign: a clock started alone in lockstep ran ticks and did nothing else."""
    bench.start("clock", "clock", "-p", "run.mode:=lockstep", package="softrig_core")
    for _ in range(2):
        ticks = bench.status("clock").get("ticks", 0)
        bench.wait(lambda ticks=ticks: bench.status("clock").get("ticks", 0) > ticks)
    bench.nodes["clock"].send_signal(2)
    assert bench.ends("clock") == 0


def test_a_lost_controller_gives_the_safe_input_and_a_new_one_takes_over(bench):
    bench.start("plant", "plant")
    bench.start("source", "source")
    bench.start("gain", "gain")
    recorded(bench, "gain", COMMAND, 30)
    ports = ears(bench.nodes["gain"])
    bench.kill("gain")
    bench.wait(lambda: "stale lag/command" in bench.status("plant")["reports"])
    goes_on(bench, 20)
    bench.wait(lambda: bench.signal("plant", APPLIED).x[-1] == 0.0)
    bench.start("gain", "gain")
    bench.wait(lambda: ears(bench.nodes["gain"]))
    assert ports.isdisjoint(ears(bench.nodes["gain"]))  # other nodes still send to the ports of the dead node
    bench.wait(lambda: "recovered lag/command" in bench.status("plant")["reports"])
    bench.wait(lambda: bench.signal("plant", APPLIED).x[-1] != 0.0)


def test_a_timer_that_is_always_late_lets_messages_through():
    """For a tick that takes longer than its period, and messages that arrive during it: no queue grows."""
    period, late, received = 200_000, [], []
    context = Context()
    with free_domain() as domain:
        rclpy.init(context=context, domain_id=domain)
        node = ServingNode("late", context=context)
        executor = EventsExecutor(context=context)
        executor.add_node(node)
        over = Future(executor=executor)

        def tick():
            timer.again(period - time.monotonic_ns() % period, period)
            late.append(len(late))
            executor.create_task(received.append, late[-1])
            time.sleep((0.0003, 0.0008, 0.0011)[len(late) % 3])  # so that the phase to the ticks differs each time
            if len(late) == 400:
                over.set_result(None)

        timer = RosMiddleware(node).timer(period, tick)
        executor.spin_until_future_complete(over, PATIENCE)
        executor.shutdown()
        node.destroy_node()
        context.shutdown()
    assert len(late) >= 400
    assert received == late[: len(received)]
    assert len(received) >= len(late) - 3


@pytest.mark.long
def test_a_node_whose_port_is_taken_away_ends_by_name(bench):
    bench.start("plant", "plant")
    recorded(bench, "plant", STATE, 30)
    for port in ears(bench.nodes["plant"]):
        port.unlink()
    assert bench.ends("plant") == 3
    assert "receives no messages any more: its port fastrtps_port" in bench.status("plant")["error"]


@pytest.mark.long
def test_a_node_whose_port_was_judged_damaged_receives_again(bench):
    """Fast DDS in any process may do so on a host so busy that the reader did not run: the reader makes another
    port.
    """
    for name in ("plant", "source", "gain"):
        bench.start(name, name)
    bench.wait(lambda: bench.status("gain")["ticks"] > 30)
    ports = {port: port.stat().st_ino for port in ears(bench.nodes["gain"])}
    for port in ports:
        mark_damaged(port)
    bench.wait(lambda: all(port.exists() and port.stat().st_ino != inode for port, inode in ports.items()))
    ticks = bench.status("gain")["ticks"]
    bench.wait(lambda: bench.status("gain")["ticks"] > ticks + 100)
    assert bench.status("gain")["state"] == "running"
    assert ears(bench.nodes["gain"]) == ports.keys()


@pytest.mark.long
def test_no_port_of_a_living_node_is_judged(bench):
    """A process that opens an idle port, such as one without messages, would wait for its reader for 6.7 s or more."""
    for name in ("plant", "source"):
        bench.start(name, name)
    bench.wait(lambda: bench.status("plant")["ticks"] > 2500)
    ports = [port for name in ("plant", "source") for port in ears(bench.nodes[name])]
    assert len(ports) == 4
    for port in ports:
        with port_node(port) as (node, begin):
            # This byte follows the flags of the first reader: its count of activity, and when it was last checked.
            stirred = node[begin - 20 + 20_632 + 1]
        assert (stirred & 15, stirred >> 4) == (1, 0)


def mark_damaged(port):
    """Mark a port as `SharedMemGlobal` does (`PortNode::is_port_ok`): the first bit after six numbers."""
    with port_node(port) as (node, begin):
        node[begin + 24] &= ~1


@contextmanager
def port_node(port):
    """Return the content of a port, and the place of its number; the two following numbers are beside it."""
    number = int(port.name.removeprefix("fastrtps_port"))
    with port.open("r+b") as file, mmap.mmap(file.fileno(), 0) as node:
        yield (
            node,
            next(
                m.start()
                for m in re.finditer(re.escape(struct.pack("<I", number)), node)
                if struct.unpack_from("<2I", node, m.start() + 8) == (20000, 20000 // 3)
            ),
        )


PUBLISHER = (
    """
import rclpy, sys
from rclpy.node import Node
from sensor_msgs.msg import JointState
rclpy.init()
node = Node("intruder")
publisher = node.create_publisher(JointState, "lag/command", 10)
def send():
    message = JointState(name=["u"], effort=[VALUE])
    publisher.publish(message)
node.create_timer(0.01, send)
"""
    + SPIN
)


@pytest.mark.long
def test_neither_of_two_simultaneous_writers_is_accepted(bench):
    bench.start("plant", "plant")
    bench.start("source", "source")
    bench.start("gain", "gain")
    recorded(bench, "gain", COMMAND, 30)
    outside(bench, "intruder", PUBLISHER.replace("VALUE", "5.0"))
    bench.wait(lambda: bench.status("plant")["refused"]["lag/command"][0] > 10)
    goes_on(bench, 20)
    bench.wait(lambda: bench.signal("plant", APPLIED).x[-1] == 0.0)
    assert bench.signal("plant", APPLIED).x.max() < 5.0
    go(bench, "intruder")
    bench.wait(lambda: bench.signal("plant", APPLIED).x[-1] != 0.0)


ANOTHER = """def send():
    global publisher, said
    said += 1
    if said == 100:
        publisher = node.create_publisher(JointState, "lag/command", 10)"""
TAKES_OVER = PUBLISHER.replace("VALUE", "2.0 if said < 100 else 3.0").replace("def send():", f"said = 0\n{ANOTHER}")


@pytest.mark.long
def test_the_only_one_of_two_publishers_that_publishes_is_accepted(bench):
    """The first publisher stays matched and is silent, as a killed node is until its lease ends."""
    bench.start("plant", "plant")
    outside(bench, "intruder", TAKES_OVER)
    bench.wait(lambda: 3.0 in bench.signal("plant", APPLIED).x)
    bench.wait(lambda: "rivals lag/command" in bench.status("plant")["reports"])
    refused = bench.status("plant")["refused"]["lag/command"]
    assert refused[1].startswith("2 publishers at the same time")
    goes_on(bench, 50)
    assert bench.status("plant")["refused"]["lag/command"] == refused


def test_nan_from_outside_is_rejected_and_counted(bench):
    bench.start("plant", "plant")
    outside(bench, "intruder", PUBLISHER.replace("VALUE", "float('nan')"))
    bench.wait(lambda: bench.status("plant")["refused"]["lag/command"][0] > 10)
    recorded(bench, "plant", STATE, 10)
    assert bench.status("plant")["refused"]["lag/command"][1] == "u/effort is nan, expected a finite number"
    assert (bench.signal("plant", STATE).x == 0.0).all()


LISTENER = """
import rclpy
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rcl_interfaces.msg import Log
rclpy.init()
node = Node("listener")
heard = []
qos = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)  # also what was said before it was matched
node.create_subscription(Log, "/rosout", lambda m: heard.append((m.name, m.msg)), qos)
while not any(name == "plant" and "refused on lag/command: u/effort is nan" in text for name, text in heard):
    rclpy.spin_once(node)
"""


def test_the_usual_tools_see_a_rejection(bench):
    outside(bench, "listener", LISTENER)
    bench.start("plant", "plant")
    outside(bench, "intruder", PUBLISHER.replace("VALUE", "float('nan')"))
    assert bench.ends("listener") == 0


def test_a_person_moves_a_held_input(bench):
    code = """
import rclpy
from rclpy.node import Node
from std_msgs.msg import Float64
rclpy.init()
node = Node("person")
publisher = node.create_publisher(Float64, "lag/offset", 10)
node.create_timer(0.1, lambda: publisher.publish(Float64(data=3.0)))
rclpy.spin(node)
"""
    bench.start("plant", "plant")
    outside(bench, "person", code)
    recorded(bench, "plant", STATE, 10)
    bench.wait(lambda: bench.signal("plant", APPLIED).x[-1] == 3.0)
    assert bench.signal("plant", "lag/offset/data").x[-1] == 3.0


def test_an_empty_list_reaches_a_node_process(bench):
    bench.start("source", "reference_source", "-p", "positions:=[3.0]", "-p", "velocities:=[]", "-p",
                "run.duration:=0.2", package="softrig_control")  # fmt: skip
    assert bench.ends("source") == 0
    assert list(bench.signal("source", "reference/shaft/position").x)[:2] == [3.0, 3.0]


def test_a_button_is_also_a_service_that_presses_it_for_one_tick(bench):
    bench.start("plant", "plant")
    recorded(bench, "plant", STATE, 10)
    outside(bench, "person", PRESS)
    assert bench.ends("person") == 0
    bench.wait(lambda: bench.signal("plant", "lag/kick/data").x.size == 2)
    goes_on(bench, 50)
    assert list(bench.signal("plant", "lag/kick/data").x) == [1.0, 0.0]
    assert bench.signal("plant", APPLIED).x.sum() == 1.0


@pytest.mark.long
def test_a_realtime_rig_keeps_the_rate_of_the_wall_clock(tmp_path):
    rig = rig_of(make_scenario({"plant": "plant", "source": "source", "gain": "gain"}, 1.0))
    outcome = run_processes(rig, 0, tmp_path, Placement(clock="realtime"))
    assert outcome.error == ""
    t, x = Signals(outcome.recording, outcome.epoch)[STATE]
    missed = outcome.status["plant"]["missed_deadlines"]
    # a busy machine may start late and miss ticks, but each is on the grid and every period is accounted for
    assert t == pytest.approx(0.01 * (t / 0.01).round(), abs=1e-9)
    assert t[-1] >= 1.0
    assert round((t[-1] - t[0]) / 0.01) + 1 == len(t) + missed
    assert x.max() > 0.0


WATCHER = """
import rclpy
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from visualization_msgs.msg import MarkerArray
rclpy.init()
node = Node("viewer")
latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
seen = {}
node.create_subscription(String, "robot_description", lambda m: seen.setdefault("urdf", m.data), latched)
node.create_subscription(MarkerArray, "robot_dynamics/markers", lambda m: seen.setdefault("markers", m.markers), 10)
while len(seen) < 2:
    rclpy.spin_once(node)
assert seen["urdf"].startswith("<"), seen["urdf"][:20]
assert any(len(m.points) > 2 for m in seen["markers"])
"""


@pytest.mark.long
def test_a_late_viewer_gets_the_robot_description_and_markers(bench):
    bench.start("robot_dynamics", "robot_dynamics", package="softrig_robots")
    bench.wait(lambda: bench.status("robot_dynamics")["state"] == "running")
    outside(bench, "viewer", WATCHER)
    assert bench.ends("viewer") == 0


ASK_PROFILES = """
import rclpy, sys
from rclpy.node import Node
rclpy.init()
node = Node("asking")
found = {}
while len(found) < 2:
    for topic in ("/lag/state", "/lag/applied"):
        for end in node.get_publishers_info_by_topic(topic):
            found[topic] = end.qos_profile
told = {t: (q.durability.name, q.reliability.name, q.deadline.nanoseconds) for t, q in found.items()}
print(told)
kept = told["/lag/applied"][:2] == ("VOLATILE", "RELIABLE")
sys.exit(0 if kept and told["/lag/state"] == ("TRANSIENT_LOCAL", "BEST_EFFORT", 20_000_000) else 4)
"""


@pytest.mark.long
def test_the_qos_of_a_topic_can_be_set_as_for_any_ros_node(bench):
    """By the parameters that rclpy has for it; a topic that is not named keeps its own."""
    policies = {"durability": "transient_local", "reliability": "best_effort", "deadline": "20000000"}
    words = [w for k, v in policies.items() for w in ("-p", f"qos_overrides./lag/state.publisher.{k}:={v}")]
    bench.start("plant", "plant", *words)
    outside(bench, "asking", ASK_PROFILES)
    assert bench.ends("asking") == 0


HARDWARE = """
import rclpy, sys
from rclpy.node import Node
from rclpy.qos import QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import JointState
JOINTS, states, topic = {joints!r}, {states!r}, {commands!r}
rclpy.init()
node = Node("topic_based_ros2_control_hardware")
latest = []
commands = node.create_publisher(JointState, topic, QoSProfile(depth=1))
node.create_subscription(JointState, states, lambda m: latest.append(m), qos_profile_sensor_data)
def write():
    message = JointState(name=JOINTS, effort=[20.0] + [0.0] * (len(JOINTS) - 1))
    message.header.stamp = node.get_clock().now().to_msg()
    commands.publish(message)
node.create_timer(0.001, write)
while not latest or latest[-1].position[0] < latest[0].position[0] + 0.05:
    rclpy.spin_once(node)
    for m in latest[-1:]:  # it indexes all three by the names, without a look at their lengths
        if list(m.name) != JOINTS or not len(m.position) == len(m.velocity) == len(m.effort) == len(JOINTS):
            sys.exit(4)
"""


@pytest.mark.parametrize(
    ("package", "plant", "joints", "states", "commands"),
    [
        pytest.param(
            "softrig_robots",
            "rehab_plant",
            ["hip", "knee"],
            "/joint_states",
            "/motor_command",
            marks=pytest.mark.long,
        ),
        ("softrig_drives", "dc_motor_plant", ["shaft"], "/motor/state", "/motor/command"),
    ],
)
def test_a_plant_is_hardware_for_ros2_control_over_topics(package, plant, joints, states, commands, bench):
    """An outside node uses the topics of TopicBasedSystem (topic_based_ros2_control): best effort in, depth 1 out, no
    frame.
    """
    bench.start(plant, plant, "-p", "period:=0.001", package=package)
    outside(bench, "hardware", HARDWARE.format(joints=joints, states=states, commands=commands))
    assert bench.ends("hardware") == 0
    bench.wait(lambda: sum(bench.signal(plant, f"{states[1:]}/{joints[0]}/velocity").x) > 0)
    bench.wait(lambda: bench.status(plant)["ticks"])
    assert bench.status(plant)["refused"] == {}


COMMANDS = """
import rclpy
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
rclpy.init()
node = Node("person")
commands = node.create_publisher(Float64MultiArray, "forward_command_controller/commands", 10)
latest = []
node.create_subscription(JointState, "motor/state", latest.append, 10)
node.create_timer(0.1, lambda: [commands.publish(Float64MultiArray(data=x)) for x in ([-9.0, 0.0], [6.0])])
while not latest or latest[-1].velocity[0] < 1.0:
    rclpy.spin_once(node)
"""


@pytest.mark.long
def test_commands_for_a_forward_command_controller_drive_a_plant(bench):
    """A bare array, as `ros2 topic pub` and ros2_controllers write it; one of another length is rejected."""
    bench.start("plant", "dc_motor_plant", package="softrig_drives")
    bench.start("forward", "forward_command", "-r", "command:=motor/command", package="softrig_control")
    outside(bench, "person", COMMANDS)
    assert bench.ends("person") == 0
    bench.wait(lambda: bench.status("forward")["refused"])
    ((count, reason),) = bench.status("forward")["refused"].values()
    assert (count > 0, reason) == (True, "data has 2 values, expected 1")
    assert set(bench.signal("forward", "motor/command/armature/effort").x) == {0.0, 6.0}
