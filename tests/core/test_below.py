"""Uses of rclpy below its public interface: each self-test can fail, and the public way then gives the same."""

import ast
import ctypes
import struct
from pathlib import Path

import pytest
import rclpy
from conftest import differences, in_process, make_scenario
from pages.statements import imported
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.logging import LoggingSeverity
from rclpy.parameter import Parameter
from softrig_core import rig_of
from softrig_nodes import run_processes
from softrig_nodes.below import arrival, carrier, uses
from softrig_nodes.processes.placement import Placement
from softrig_nodes.ros.ros import ServingNode
from std_msgs.msg import Float64

PACKAGES = Path(__file__).parents[2] / "ros_pkgs"
BELOW = ("rclpy._rclpy_pybind11", "rclpy.impl", "rclpy.experimental")
# These modules call the C library, not internals of ROS.
C = {f"softrig_nodes/{name}.py" for name in ("seam/health", "processes/fork_server", "processes/dead_locks")}


@pytest.fixture
def public(monkeypatch):
    """Use the public way for one use, or for all."""

    def choose(name):
        monkeypatch.setenv(uses.VARIABLE, name)
        uses.works.cache_clear()

    yield choose
    monkeypatch.undo()
    uses.works.cache_clear()


@pytest.fixture(scope="module")
def node():
    context = Context()
    words = ["--ros-args", "-p", "k:=2.5", "-p", "qos_overrides./x:=1", "-r", "/a:=/b"]
    rclpy.init(context=context, args=words, domain_id=97)
    made = ServingNode("below", namespace="/rig", context=context)
    made.declare_parameter("k", 1.0)
    yield made
    made.destroy_node()
    rclpy.shutdown(context=context)


@pytest.mark.parametrize("name", uses.USES)
def test_a_private_use_of_a_library_works_and_a_changed_one_falls_back(name, monkeypatch):
    uses.works.cache_clear()
    assert uses.works(name)
    use = uses.USES[name]
    assert use.seen
    assert use.instead

    def missing_import(name):
        raise ImportError(name)  # as in a version of rclpy without these modules

    with monkeypatch.context() as other:
        other.setattr(uses.importlib, "import_module", missing_import)
        other.setattr(uses, "Node", type("Node", (), {"__init__": lambda self: None}))
        uses.works.cache_clear()
        assert not uses.works(name)
    uses.works.cache_clear()


def test_no_other_module_uses_private_interfaces():
    """By imports, and ctypes; private attributes are checked by ruff (SLF001), which exempts this folder only."""
    results = []
    for file in PACKAGES.glob("softrig_*/softrig_*/**/*.py"):
        if "below" in file.parts or not {"softrig_nodes", "softrig_bags"} & set(file.parts):
            continue
        for one, _ in imported(file):
            names = [a.name for a in one.names] if isinstance(one, ast.Import) else []
            names += (
                [f"{one.module}.{a.name}" for a in one.names] if isinstance(one, ast.ImportFrom) and one.module else []
            )
            place = "/".join(file.parts[-3:])
            results += [(place, n) for n in names if n.startswith(BELOW) or (n == "ctypes" and place not in C)]
    assert results == [("softrig_nodes/softrig_nodes/preloaded.py", "rclpy.experimental.events_executor")]


def test_no_other_module_calls_the_objects_behind_a_handle():
    """`handle` of a publisher, subscription or node is rclpy's C object, whose methods are not public."""
    results = []
    for file in PACKAGES.glob("softrig_*/**/*.py"):
        if "below" not in file.parts and ".handle." in (text := file.read_text()):
            calls = [c.func for c in ast.walk(ast.parse(text)) if isinstance(c, ast.Call)]
            of = [f.value for f in calls if isinstance(f, ast.Attribute) and isinstance(f.value, ast.Attribute)]
            results += [(file.name, ast.unparse(v)) for v in of if v.attr == "handle"]
    # rclpy passes a goal handle to the callbacks of an action, so this name is public.
    assert results == [("following.py", "active.handle")]


def test_the_public_way_gives_the_same(node, public):
    ways = []
    publisher, received = node.create_publisher(Float64, "/b", 10), []
    reader = node.create_subscription(Float64, "/b", received.append, 10)
    for way in ("", "all"):
        public(way)
        with_way = ServingNode(f"way_{len(ways)}", context=node.context)
        ways.append(
            (
                {n: p.value for n, p in uses.overrides(with_way).items()},
                {n: p.value for n, p in uses.parameters(node).items() if n != "use_sim_time"},
                {n: d.type for n, d in uses.descriptors(node).items() if n == "k"},
                [(e.node_name, e.node_namespace, e.topic_type) for e in uses.endpoints(node, "/b", writers=True)],
                [e.node_name for e in uses.endpoints(node, "/b", writers=False)],
                uses.parameters(node).get("nothing"),
            )
        )
        for level in (LoggingSeverity.INFO, LoggingSeverity.WARN, LoggingSeverity.ERROR):
            uses.log(node.get_logger(), level, "a text")
        uses.sending(publisher)(b"\0\1\0\0" + bytes(8))
        with_way.destroy_node()
        assert (arrival.library() is None) == (way == "all")
    assert ways[0] == ways[1]
    assert ways[0][0] == {"k": 2.5, "qos_overrides./x": 1}
    assert len(ways[0][1]) >= 1
    assert len(ways[0][3]) == 1
    node.destroy_subscription(reader)


def test_an_empty_list_has_a_type_if_rclpy_allows_it(node, public):
    public("")
    node.declare_parameter("empty", [])
    uses.make_empty(node, "empty", Parameter.Type.DOUBLE_ARRAY)
    assert node.get_parameter("empty").type_ == Parameter.Type.DOUBLE_ARRAY
    public("parameters")
    uses.make_empty(node, "empty", Parameter.Type.STRING_ARRAY)  # the parameter keeps its type
    assert uses.parameters(node)["empty"].type_ == Parameter.Type.DOUBLE_ARRAY


@pytest.fixture
def carried():
    """A carrier whose thread runs, and what it has passed to a function in the place of rcl's, by publisher."""
    seen, codes = {7: [], 8: []}, iter(())

    def publish(publisher, message, allocation):
        contents = message.contents
        seen[publisher].append(ctypes.string_at(contents.buffer, contents.length))
        return next(codes, 0)

    made = carrier.Carrier(carrier._PUBLISH(publish))
    made.start()
    yield made, seen
    made.put(0, b"")  # an empty message ends the thread


def test_a_native_thread_publishes_everything_in_order_whatever_its_size(carried):
    made, seen = carried
    expected = {7: [], 8: []}
    for k in range(3 * carrier.SLOTS):
        expected[7 + k % 2].append(data := f"{k} ".encode() * (k % 90))
        made.put(7 + k % 2, bytes(bytearray(data)))  # a copy to which nothing else refers
    made.drain()
    assert seen == expected
    made.drain()  # returns at once, because no message is left


def test_a_message_that_rcl_does_not_publish_is_an_error_of_the_next(carried, monkeypatch):
    made, seen = carried
    made._failed[0] = 300
    monkeypatch.setattr(carrier.rclpy, "ok", lambda: False)  # errors of publishing after a shutdown are ignored
    made.put(7, b"a")
    made.drain()
    monkeypatch.setattr(carrier.rclpy, "ok", lambda: True)
    with pytest.raises(uses.RCLError, match="rcl reports 300"):
        made.drain()
    made.put(7, b"b")
    made.drain()
    assert seen[7] == [b"a", b"b"]


def test_what_is_not_published_in_time_is_an_error(monkeypatch):
    made = carrier.Carrier()  # its thread is not started, so no message is published
    monkeypatch.setattr(carrier, "PATIENCE", 0.01)
    made.put(7, b"a")
    with pytest.raises(uses.RCLError, match=r"1 messages are not published within 0\.01 s"):
        made.drain()


def test_real_readers_get_what_the_native_thread_publishes(node):
    publisher, received = node.create_publisher(Float64, "/carried", 100), []
    reader = node.create_subscription(Float64, "/carried", lambda message: received.append(message.data), 100)
    made = carrier.carrier()
    send = made.sender(publisher)
    for k in range(50):
        send(b"\0\1\0\0" + struct.pack("<d", k))
    made.drain()
    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    while len(received) < 50:
        executor.spin_once(5.0)
    executor.remove_node(node)
    assert received == [float(k) for k in range(50)]
    node.destroy_subscription(reader)
    node.destroy_publisher(publisher)


@pytest.mark.long
@pytest.mark.processes
def test_a_rig_that_uses_the_public_way_has_the_same_bits(public, tmp_path):
    public("all")
    rig = rig_of(make_scenario({"plant": "plant", "source": "source", "gain": "gain"}, 0.1))
    outcome = run_processes(rig, 0, tmp_path, Placement())
    assert outcome.error == ""
    assert differences(in_process(rig), outcome.recording) == []
    assert not any(status.get("prompt") for status in outcome.status.values())
