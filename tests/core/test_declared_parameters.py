"""Each declared parameter of each executable keeps type, range and existence, whatever is asked of the services."""

import math
from pathlib import Path
from types import SimpleNamespace

import pytest
from by_hand import Hand
from conftest import few
from faultrig import Lag
from rcl_interfaces.msg import Parameter as Message, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.node import Node
from rclpy.parameter import Parameter
from softrig_core.block.params import build, declarations, flatten
from softrig_core.errors import ScenarioError
from softrig_core.renamed import executables
from softrig_core.rig.installed import load_block
from softrig_core.rig.options import Links, RunOptions
from softrig_nodes.adapter.adapter import Adapter
from softrig_nodes.face.tuning import Tuning
from softrig_nodes.main import _parameters
from softrig_nodes.ros.ros import Credit, ServingNode, plain
from softrig_nodes.seam.monitor import Monitor

ROOT = Path(__file__).parents[2]
RUN = {d.name: d for d in declarations(RunOptions, "run.")}
TINY = 5e-324


def blocks():
    for file in sorted(ROOT.glob("ros_pkgs/*/setup.cfg")):
        for name in executables(file.parent.name):
            try:
                block = load_block(file.parent.name, name)
                block.Params()
            except (ScenarioError, ValueError):  # a tool; a block without defaults
                continue
            yield pytest.param(block, id=f"{file.parent.name}-{name}")


def value(kind, **content):
    return ParameterValue(type=getattr(ParameterType, f"PARAMETER_{kind}"), **content)


HOSTILE = (
    value("STRING", string_value="x"),
    value("STRING", string_value=""),
    value("BOOL", bool_value=True),
    value("NOT_SET"),
    value("DOUBLE", double_value=math.inf),
    value("DOUBLE", double_value=-math.inf),
    value("DOUBLE", double_value=math.nan),
    value("DOUBLE", double_value=TINY),
    value("DOUBLE", double_value=1e308),
    value("DOUBLE", double_value=0.5),
    value("INTEGER", integer_value=2**63 - 1),
    value("INTEGER", integer_value=-(2**63)),
    value("DOUBLE_ARRAY", double_array_value=[math.nan, math.inf]),
    value("DOUBLE_ARRAY", double_array_value=[]),
    value("INTEGER_ARRAY", integer_array_value=[1]),
    value("STRING_ARRAY", string_array_value=["x"]),
    value("BYTE_ARRAY", byte_array_value=[b"\0"]),
    ParameterValue(type=77),
)


class Stood(ServingNode):
    """A node with rclpy's own parameters and services, without a context: what would be published is dropped."""

    def __init__(self):
        self.offered = {}
        self._parameters, self._descriptors = {}, {}
        self._parameter_overrides, self._allow_undeclared_parameters = {}, False
        for kind in ("pre_set", "on_set", "post_set"):
            setattr(self, f"_{kind}_parameters_callbacks", [])
        self._parameter_event_publisher = SimpleNamespace(publish=lambda event: None)
        self._clock = SimpleNamespace(now=lambda: SimpleNamespace(to_msg=lambda: None))
        self.monitor, self._credit = Monitor(lambda: None), Credit()
        self._credit.wanting = lambda: 0.0

    def get_name(self):
        return "node"

    def get_namespace(self):
        return "/"

    def get_logger(self):
        return SimpleNamespace(error=lambda *_, **__: None, warning=lambda *_, **__: None)


@pytest.fixture
def event(monkeypatch):
    monkeypatch.setattr("rclpy.node.ParameterEvent", lambda: SimpleNamespace(
        new_parameters=[], changed_parameters=[], deleted_parameters=[]))  # fmt: skip

    def offer(self, kind, name, answer, **_):
        self.offered[name] = answer
        return SimpleNamespace(send_response=None, srv_name=name)

    monkeypatch.setattr(Node, "create_service", offer)


def served(node, block, state):
    """Declare the parameters of a block, and have the services of a node that is at rest, runs, or is in real time."""
    params, _ = _parameters(node, block)
    adapter = Adapter(Hand("node"), Lag(), RunOptions(mode="realtime" if state == "realtime" else "lockstep",
                      links=Links(owns_clock=True, base="0.01").model_dump_json()))  # fmt: skip
    adapter.block = SimpleNamespace(p=params)
    paces = []
    if state == "running":
        adapter.hold.begin(adapter.middleware, lambda: None)
        adapter.hold._pace.change = lambda pace, now: paces.append(pace)
    current = [params]

    def change(values):  # as a step does: checked as a whole, and what may not change stays
        fixed = [n for n in values if not {d.name: d for d in declarations(block.Params)}[n].live]
        assert not fixed, fixed
        current[0] = build(block.Params, flatten(current[0]) | values)
        return []

    adapter.step.set = change
    Tuning(node, adapter)
    for kind, name in ((SetParameters, "set"), (SetParametersAtomically, "together")):
        node.create_service(kind, name, None)
    return current, paces, adapter


@pytest.mark.parametrize("state", [pytest.param(s, marks=pytest.mark.long) for s in ("rest", "realtime")] + ["running"])
@pytest.mark.parametrize("block", few(blocks(), 10))
def test_no_call_changes_type_range_or_existence(block, state, event):
    node = Stood()
    current, paces, adapter = served(node, block, state)
    before = {n: p.type_ for n, p in node._parameters.items()}
    described = {n: (d.type, d.read_only, str(d.floating_point_range), str(d.integer_range)) for n, d in
                 node._descriptors.items()}  # fmt: skip
    declared = {d.name: d for d in declarations(block.Params)} | RUN
    assert before.keys() <= declared.keys()
    for name in before:
        for hostile in HOSTILE:
            message = Message(name=name, value=hostile)
            kept, type_ = plain(node._parameters[name]), node._parameters[name].type_
            for service, kind in (("set", SetParameters), ("together", SetParametersAtomically)):
                response = node.offered[service](kind.Request(parameters=[message]), kind.Response())
                (result,) = response.results if service == "set" else [response.result]
                found = node._parameters[name]
                assert result.successful or (plain(found) == kept and result.reason), (name, hostile, result)
                first = type_ == Parameter.Type.NOT_SET and result.successful  # one without a value gets one
                assert first or found.type_ == type_, (name, hostile, found.type_)
                kept, type_ = plain(found), found.type_
            number = plain(node._parameters[name])
            if isinstance(number, float | int):
                assert math.isfinite(number)
                assert declared[name].lower is None or declared[name].lower <= number <= declared[name].upper
    now = {n: plain(p) for n, p in node._parameters.items() if p.type_ != Parameter.Type.NOT_SET}
    build(block.Params, {n: v for n, v in now.items() if n not in RUN})
    build(RunOptions, {n.removeprefix("run."): v for n, v in now.items() if n in RUN})
    assert {n: v for n, v in flatten(current[0]).items() if n in now} == {n: v for n, v in now.items() if n not in RUN}
    assert all(pace == 0.0 or 1e-12 <= pace <= 1e3 for pace in paces)
    assert bool(paces) is (state == "running")
    for n, d in node._descriptors.items():
        then = (
            node._parameters[n].type_.value if before[n] == Parameter.Type.NOT_SET else described[n][0],
            *described[n][1:],
        )
        assert (d.type, d.read_only, str(d.floating_point_range), str(d.integer_range)) == then, n
    assert adapter.state != "failed"
