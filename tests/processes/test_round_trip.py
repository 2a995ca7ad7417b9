"""A node that was tuned, dumped and started again from the dump is the same node."""

import math
from contextlib import contextmanager

import pytest
import rclpy
import yaml
from conftest import until
from faultrig import Gain
from helpers import blocks
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from softrig_core.block.params import declarations, flatten
from softrig_nodes.main import make_adapter
from softrig_nodes.processes.domain import free_domain
from softrig_nodes.ros.ros import RosMiddleware, ServingNode, plain

FMUS = ("fmu_controller", "fmu_plant")  # these nodes require a file
# One each with optional numbers, with lists, and a plant.
DAILY = ("dc_motor_smc", "profile_generator", "reference_source", "rectifier_plant")
EXECUTABLES = [
    pytest.param(name, block, marks=[] if name in DAILY else pytest.mark.long, id=name)
    for _, name, block in blocks()
    if name not in FMUS
]


@pytest.fixture
def domain():
    with free_domain() as result:
        yield result


@contextmanager
def started(name, block, domain, *files):
    """A node of a block with files of parameters, and a client of its services, as `ros2 param` has."""
    context = Context()
    words = [word for file in files for word in ("--params-file", str(file))]
    rclpy.init(args=["--ros-args", "-p", "run.mode:=lockstep", *words], context=context, domain_id=domain)
    node = ServingNode(name, context=context)
    tool = rclpy.create_node("tool", context=context, use_global_arguments=False)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    executor.add_node(tool)
    client = AsyncParameterClient(tool, name)

    def done(future):
        executor.spin_until_future_complete(future, 30.0)
        return future.result()

    try:
        adapter = make_adapter(node, block, RosMiddleware(node))
        until(lambda: executor.spin_once(0.05) or client.services_are_ready(), "the services")
        yield node, adapter, client, done
    finally:
        executor.shutdown()
        tool.destroy_node()
        node.destroy_node()
        context.shutdown()


def other(declared, value):
    """Another value of a parameter within its bounds, if there is one near."""
    if isinstance(value, float) or (value is None and declared.type is float):
        near = 0.5 * value if value else 0.01
        return min(max(near, declared.lower), declared.upper)
    return not value if isinstance(value, bool) else value


@pytest.mark.processes
@pytest.mark.parametrize(("name", "block"), EXECUTABLES)
def test_tuned_dumped_and_loaded_it_is_the_same(name, block, tmp_path, domain):
    file = tmp_path / "dump.yaml"

    def dumped():  # the content of a file by `ros2 param dump`
        values = {n: plain(p) for n, p in node._parameters.items()}
        file.write_text(yaml.dump({name: {"ros__parameters": values}}))
        return values

    def loaded():  # sets the values as `ros2 param load` does, and returns the refusals
        results = done(client.load_parameter_file(str(file))).results
        assert len(results) == len(node._parameters)
        return [r.reason for r in results if not r.successful]

    with started(name, block, domain) as (node, adapter, client, done):
        before = flatten(adapter.block.p)
        values = dumped()
        assert (loaded(), dumped()) == ([], values)
        wanted = [(d.name, other(d, before[d.name])) for d in declarations(block.Params) if d.live]
        done(client.set_parameters([Parameter(n, value=v) for n, v in wanted if v is not None and v != []]))
        values = dumped()  # the node may have refused some of the values
    with started(name, block, domain, file) as (node, adapter, client, done):
        again = flatten(adapter.block.p)
        assert {n: again[n] for n in before if n in values} == {n: values[n] for n in before if n in values}
        assert (loaded(), dumped()) == ([], values)
    with started(name, block, domain) as (node, adapter, client, done):
        loaded()  # live parameters get their tuned values; the node refuses the others
        live = {d.name for d in declarations(block.Params) if d.live}
        now = {n: plain(p) for n, p in node._parameters.items()}
        assert {n: now[n] for n in live & now.keys()} == {n: values[n] for n in live & values.keys()}


def test_an_unknown_parameter_is_named_and_the_others_are_set(domain):
    with started("gain", Gain, domain) as (_, _, client, done):
        results = done(client.set_parameters([Parameter("k", value=2.0), Parameter("noize", value=1.0)])).results
        together = done(client.set_parameters_atomically([Parameter("noize", value=1.0)])).result
    reason = "'noize' is not a parameter of gain (did you mean 'noise'?)"
    assert [(r.successful, r.reason) for r in results] == [(True, ""), (False, reason)]
    assert (together.successful, together.reason) == (False, reason)


def hostile():
    """Values of wrong types, beyond all ranges, and none."""
    for value in ("x", "", True, math.inf, -math.inf, math.nan, 5e-324, 1e308, 2**63 - 1, -(2**63), [math.nan], ["x"]):
        yield lambda name, value=value: Parameter(name, value=value)
    yield lambda name: Parameter(name, Parameter.Type.NOT_SET)


@pytest.mark.processes
@pytest.mark.parametrize(("name", "block"), EXECUTABLES)
def test_whatever_is_set_over_ros_each_parameter_keeps_its_type_and_range(name, block, domain):
    """By both services, with `list` and `describe` before and after; tests/core/test_declared_parameters.py has all
    executables.
    """

    def seen():
        names = sorted(done(client.list_parameters()).result.names)
        described = done(client.describe_parameters(names)).descriptors
        return names, [(d.name, d.type, d.read_only) for d in described if node._parameters[d.name].value is not None]

    with started(name, block, domain) as (node, _, client, done):
        empty = {n for n, p in node._parameters.items() if p.value is None}
        before = seen()
        for make in hostile():
            wanted = [make(n) for n in before[0] if n not in empty]
            results = done(client.set_parameters(wanted)).results
            assert len(results) == len(wanted)
            assert all(r.reason for r in results if not r.successful)
            assert not done(client.set_parameters_atomically(wanted)).result.successful
        assert seen() == before
