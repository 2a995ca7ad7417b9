"""Each declared parameter of each executable keeps its type, range and existence, whatever the services are asked.

`tests/processes/test_tuning.py` asks the same of live nodes.
"""

import math
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from by_hand import Hand
from conftest import few
from faultrig import Lag
from helpers import blocks
from rcl_interfaces.msg import Parameter as Message
from rcl_interfaces.srv import (
    DescribeParameters,
    GetParameters,
    GetParameterTypes,
    ListParameters,
    SetParameters,
    SetParametersAtomically,
)
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.parameter_service import ParameterService
from softrig_core.block.params import build, declarations, flatten
from softrig_core.rig.options import Links, RunOptions
from softrig_nodes.adapter.adapter import Adapter
from softrig_nodes.face.tuning import Tuning
from softrig_nodes.main import _parameters
from softrig_nodes.ros.ros import ServingNode, plain
from softrig_nodes.seam.monitor import Monitor

sys.path.insert(0, str(Path(__file__).parents[1] / "campaign"))
from services import HOSTILE, STRANGE

RUN = {d.name: d for d in declarations(RunOptions, "run.")}


class Stood(ServingNode):
    """A node with rclpy's own parameters and services, without a context: publications are dropped."""

    def __init__(self):
        self.offered = {}
        self._parameters, self._descriptors = {}, {}
        self._parameter_overrides, self._allow_undeclared_parameters = {}, False
        for kind in ("pre_set", "on_set", "post_set"):
            setattr(self, f"_{kind}_parameters_callbacks", [])
        self._parameter_event_publisher = SimpleNamespace(publish=lambda event: None)
        self._clock = SimpleNamespace(now=lambda: SimpleNamespace(to_msg=lambda: None))
        self.monitor, self._answering = Monitor(lambda: None), {}

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
        self.offered[kind] = lambda **request: answer(kind.Request(**request), kind.Response())
        self.kept = _["qos_profile"].depth
        return name

    monkeypatch.setattr(Node, "create_service", offer)


def served(node, block, state):
    """Declare the parameters of a block, and have the services of a node at rest, running, or in real time."""
    params, _ = _parameters(node, block)
    adapter = Adapter(Hand("node"), Lag(), RunOptions(mode="realtime" if state == "realtime" else "lockstep",
                      links=Links(owns_clock=True, base="0.01").model_dump_json()))  # fmt: skip
    adapter.block = SimpleNamespace(p=params)
    paces = []
    if state == "running":
        adapter.hold.begin(adapter.middleware, lambda: None)
        adapter.hold._pace.change = lambda pace, now: paces.append(pace)
    current = [params]

    def change(values):  # a step checks all parameters together and refuses those that are not live
        fixed = [n for n in values if not {d.name: d for d in declarations(block.Params)}[n].live]
        assert not fixed, fixed
        current[0] = build(block.Params, flatten(current[0]) | values)
        return []

    adapter.step.set = change
    Tuning(node, adapter)
    node.served = ParameterService(node)
    return current, paces, adapter


@pytest.mark.parametrize("state", [pytest.param(s, marks=pytest.mark.long) for s in ("rest", "realtime")] + ["running"])
@pytest.mark.parametrize("block", few([pytest.param(b, id=f"{package}-{name}") for package, name, b in blocks()], 3))
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
            for kind in (SetParameters, SetParametersAtomically):
                response = node.offered[kind](parameters=[message])
                (result,) = response.results if kind is SetParameters else [response.result]
                actual = node._parameters[name]
                # The refusal may name another parameter, which the new value makes invalid.
                named = any(other in result.reason for other in before)
                assert result.successful or (plain(actual) == kept and named), (name, hostile, result)
                # A parameter without a value gets its first one.
                first = type_ == Parameter.Type.NOT_SET and result.successful
                assert first or actual.type_ == type_, (name, hostile, actual.type_)
                kept, type_ = plain(actual), actual.type_
            number = plain(node._parameters[name])
            if isinstance(number, float | int):
                assert math.isfinite(number)
                assert declared[name].lower is None or declared[name].lower <= number <= declared[name].upper
        was_set = before[name] != Parameter.Type.NOT_SET
        assert was_set <= len(node.offered[GetParameters](names=[name]).values)
        assert len(node.offered[GetParameterTypes](names=[name]).types) == 1
        assert [d.name for d in node.offered[DescribeParameters](names=[name]).descriptors] == [name]
    assert set(node.offered[ListParameters](depth=0).result.names) == before.keys()
    for strange in STRANGE:
        for hostile in HOSTILE[::7]:
            response = node.offered[SetParameters](parameters=[message, Message(name=strange, value=hostile)])
            assert "is not a parameter of node" in response.results[1].reason
            assert response.results[0].reason == node.offered[SetParameters](parameters=[message]).results[0].reason
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
