"""The DC axis as real nodes: equal to in-process bit for bit, and moved by a person's buttons in real time."""

import numpy as np
import pytest
from outside import go, outside
from softrig_core import Signals, load_scenario, rig_of
from softrig_core.judge import measures
from softrig_nodes import run_processes
from softrig_nodes.processes.placement import Placement

pytestmark = pytest.mark.processes

Y = "axis/true_state/axis/position"
SET_POINT = "axis/controller_state/set_point/position"


@pytest.mark.long
def test_real_time_reaches_the_same_result_with_the_delay_read_from_the_stamps(tmp_path):
    """Missed periods of a busy host may change the figures, but not the delay, the end and the small overshoot."""
    # Long enough that a node that starts late receives it.
    long_press = {"step_buttons.forward": [1.0], "step_buttons.hold": 3.0}
    rig = rig_of(load_scenario("dc_motor_fsfb", long_press), duration=5.0)
    outcome = run_processes(rig, 0, tmp_path, Placement(clock="realtime"))
    assert outcome.error == ""
    signals = Signals(outcome.recording, outcome.epoch)
    age = signals["axis/controller_state/age/position"].x
    assert np.median(age) == pytest.approx(0.08, abs=1e-9)
    assert age.min() >= 0.0
    assert signals[Y].x[-1] == pytest.approx(10.0, abs=0.1)
    assert measures.overshoot(signals, Y, final=10.0) < 5.0


PERSON = """
import rclpy, sys
from rclpy.node import Node
from std_msgs.msg import Bool
from std_srvs.srv import Trigger
rclpy.init()
node = Node("person")
publishers = {}
for line in sys.argv[1:]:
    kind, name = line.split()
    if kind.startswith("call"):
        client = node.create_client(Trigger, name)
        client.wait_for_service()
        future = client.call_async(Trigger.Request())
        rclpy.spin_until_future_complete(node, future)
        assert future.result().success == (kind == "call"), future.result().message
    else:
        if name not in publishers:
            publishers[name] = node.create_publisher(Bool, name, 10)
        publisher = publishers[name]
        while not publisher.get_subscription_count():
            pass
        publisher.publish(Bool(data=kind == "press"))
        publisher.wait_for_all_acked()
"""


class Axis:
    """The three nodes that a person starts by hand, with their published parameters."""

    def __init__(self, bench):
        self.bench = bench
        bench.start("plant", "dc_axis_plant", package="softrig_drives")
        bench.start("link", "fieldbus_delay", package="softrig_control")
        self.start_controller()
        bench.wait(lambda: len(bench.signal("controller", SET_POINT).x) > 30 and len(bench.signal("plant", Y).x) > 0)

    def start_controller(self, *arguments):
        self.bench.start("controller", "fsfb_controller", *arguments, package="softrig_drives")

    def ask(self, *lines):
        outside(self.bench, "person", PERSON, *lines)
        assert self.bench.ends("person") == 0

    def asked(self, where):
        """Wait until the set point has a value."""
        self.wait(lambda: self.bench.signal("controller", SET_POINT).x[-1] == where)

    def arrives(self, where):
        """Wait until set point and axis have reached a value."""

        def reached():
            asked, y = self.bench.signal("controller", SET_POINT).x, self.bench.signal("plant", Y).x[-50:]
            return asked[-1] == where and np.abs(y - where).max() < 0.1

        self.wait(reached)

    def wait(self, condition):
        """Check the recording when it has grown."""
        seen = None

        def more():
            nonlocal seen
            size = (self.bench.directory / "plant.shard").stat().st_size
            if size == seen:
                return False
            seen = size
            return condition()

        self.bench.wait(more)


@pytest.fixture
def axis(bench):
    return Axis(bench)


@pytest.mark.long
def test_buttons_by_topic_and_by_service_move_the_axis(axis):
    assert not axis.bench.signal("plant", Y).x.any()  # no reference was published
    axis.ask("press forward", "call-in-vain controller/forward")
    axis.asked(10.0)
    # The newest of two messages within a tick counts, so they are sent one after the other.
    axis.ask("release forward")
    axis.ask("call controller/forward", "call controller/forward")
    axis.asked(30.0)  # each call counts as a press, even if calls follow quickly
    axis.ask("call controller/reverse")
    axis.asked(20.0)
    # On its way; the test below waits until it has arrived.
    axis.wait(lambda: axis.bench.signal("plant", Y).x[-1] > 3.0)


@pytest.mark.long
def test_a_lost_controller_stops_the_axis_and_a_new_one_takes_over_without_a_bump(axis):
    bench = axis.bench
    axis.ask("press forward")
    axis.wait(lambda: bench.signal("plant", Y).x[-1] > 3.0)
    go(bench, "controller")
    bench.wait(lambda: "stale axis/command" in bench.status("plant")["reports"])
    axis.wait(lambda: np.ptp(bench.signal("plant", Y).x[-50:]) < 1e-3)  # the axis has come to rest
    stopped = bench.signal("plant", "axis/state/axis/position").x[-1]
    axis.start_controller()
    bench.wait(lambda: "recovered axis/command" in bench.status("plant")["reports"])
    axis.arrives(stopped)
    before = len(bench.signal("plant", Y).x)
    axis.ask("call controller/forward")
    axis.arrives(stopped + 10.0)
    assert np.abs(bench.signal("plant", Y).x[before - 50 : before] - stopped).max() < 0.05
