"""Linear switched reluctance motor as nodes: equality to in-process, over-current trip, bad input from a person."""

import numpy as np
import pytest
from conftest import differences, in_process
from outside import SPIN, go, outside
from softrig_bringup.run.run import checked, execute
from softrig_core import load_scenario, rig_of
from softrig_nodes.processes.placement import Placement

pytestmark = pytest.mark.processes

CURRENT_A = "phase_currents/a/position"


@pytest.mark.long  # a daily test with a load that trips the motor is below
@pytest.mark.parametrize("name", ["lsrm_fuzzy_short", "lsrm_fuzzy", "lsrm_fuzzy_n2_mrac"])
def test_the_same_bits_over_topics(name, tmp_path):
    scenario = load_scenario(name)
    run = execute(checked(scenario), Placement(), tmp_path)
    assert run.error == ""
    assert differences(in_process(rig_of(scenario), scenario.seed), run.recording) == []


@pytest.mark.long
def test_overcurrent_trips_in_a_process(tmp_path):
    scenario = load_scenario("lsrm_fuzzy_b5_trip")
    run = execute(checked(scenario), Placement(), tmp_path)
    assert run.error == ""
    currents = np.array([run.signals[f"phase_currents/{k}/position"].x for k in "ab"])
    tripped = int(np.argmax(currents.max(axis=0) > 12.0))
    assert 12.0 < currents.max() < 13.0
    assert tripped > 10
    assert (np.diff(currents.max(axis=0)[tripped:]) <= 0.0).all()
    assert currents[:, tripped + 60 :].max() == 0.0  # 3 ms later
    assert run.signals["phase_voltage/a/effort"].x.min() == 150.0  # the voltage is commanded all the time
    assert run.status["lsrm_plant"]["reports"]["overcurrent"][2] == 1
    assert differences(in_process(rig_of(scenario), scenario.seed), run.recording) == []


# Publishes one command again and again.
PERSON = f"""
import rclpy, sys
from math import nan
from rclpy.node import Node
from sensor_msgs.msg import JointState
rclpy.init()
node = Node("person")
topic, names, effort = sys.argv[1], sys.argv[2].split(), [float(x) for x in sys.argv[3].split()]
publisher = node.create_publisher(JointState, topic, 10)
def send():
    message = JointState(name=names, effort=effort)
    message.header.stamp = node.get_clock().now().to_msg()
    publisher.publish(message)
node.create_timer(0.005, send)
{SPIN}"""


class Hand:
    """A clamped motor started alone, and a user's node that commands it."""

    def __init__(self, bench):
        self.bench = bench
        parameters = {"period": 0.01, "substeps": 1000, "locked": True, "x_0": 0.0415}
        arguments = [a for k, v in parameters.items() for a in ("-p", f"{k}:={str(v).lower()}")]
        bench.start("plant", "lsrm_plant", *arguments, package="softrig_drives")
        bench.wait(lambda: bench.status("plant")["ticks"] > 3)

    def sends(self, topic, names, effort, until):
        """Publish a command until a condition holds."""
        outside(self.bench, "person", PERSON, topic, names, effort)
        self.bench.wait(until)
        go(self.bench, "person")

    def current(self):
        return self.bench.signal("plant", CURRENT_A).x[-1]

    def has_reported(self, key):
        return key in self.bench.status("plant")["reports"]

    def refused(self, topic):
        return self.bench.status("plant")["refused"].get(topic, [0, ""])


@pytest.mark.long
def test_nodes_started_one_by_one_move_the_translator_in_real_time(bench):
    slow = {"period": 0.005}  # a busy machine can run this in real time
    nodes = {
        "lsrm_plant": ("lsrm_plant", slow | {"substeps": 500}),
        "current_controller": ("current_controller", slow | {"K_pc": 0.01, "K_ic": 0.5}),
        "speed_controller": ("lsrm_fuzzy", {"period": 0.01, "K_de": 0.1}),
        "profile_generator": ("profile_generator", {"period": 0.01, "v_d": 0.1, "t_d": 1.0}),
    }
    for name, (executable, parameters) in nodes.items():
        arguments = [a for k, v in parameters.items() for a in ("-p", f"{k}:={v}")]
        bench.start(name, executable, *arguments, package="softrig_drives")
    for name in nodes:
        bench.wait(lambda name=name: bench.status(name)["ticks"] > 20)
    bench.wait(lambda: bench.signal("lsrm_plant", "joint_states/translator/position").x[-1] > 0.1)
    assert "overcurrent" not in bench.status("lsrm_plant")["reports"]
    # The load needs 2.4 N.
    bench.wait(lambda: bench.signal("speed_controller", "force_cmd/translator/effort").x.max() > 2.0)


@pytest.mark.long
def test_bad_commands_of_a_person_are_rejected_or_clipped_and_the_nodes_continue(bench):
    hand = Hand(bench)
    hand.sends("phase_voltage", "a b c d", "15 0 0 0", lambda: hand.current() > 5.9)
    bench.wait(lambda: hand.has_reported("stale phase_voltage"))  # without further commands the voltage is 0 V
    bench.wait(lambda: hand.current() < 1e-3)
    hand.sends("phase_voltage", "a b c d", "nan 0 0 0", lambda: "a/effort is nan" in hand.refused("phase_voltage")[1])
    hand.sends("phase_voltage", "a b c", "9 9 9", lambda: "names ['a', 'b', 'c']" in hand.refused("phase_voltage")[1])
    assert hand.current() < 1e-3
    hand.sends("load", "mass friction", "-5 0", lambda: hand.has_reported("bad_load"))
    assert not hand.has_reported("overcurrent")
    # The names in another order.
    hand.sends("phase_voltage", "d c b a", "0 0 0 900", lambda: hand.has_reported("overcurrent"))
    assert hand.has_reported("clipped")
    bench.wait(lambda: hand.current() == 0.0)
