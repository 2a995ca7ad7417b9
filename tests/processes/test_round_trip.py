"""A node that was tuned, dumped and started again from the dump is the same node."""

from contextlib import contextmanager
from importlib.metadata import distribution
from pathlib import Path

import pytest
import rclpy
import yaml
from rclpy.context import Context
from rclpy.parameter import Parameter
from softrig_core.block.params import declarations, flatten
from softrig_core.errors import ScenarioError
from softrig_core.node.main import make_adapter
from softrig_core.node.ros.ros import RosMiddleware, ServingNode
from softrig_core.processes.domain import free_domain
from softrig_core.rig.installed import load_block

ROOT = Path(__file__).parents[2]
FMUS = ("fmu_law", "fmu_plant")  # nothing without a file
DAILY = ("dc_motor_smc", "profile_generator", "reference_source", "rectifier_plant")  # optional numbers, lists, a plant


def executables():
    for file in sorted(ROOT.glob("ros_pkgs/*/setup.cfg")):
        for name in sorted(distribution(file.parent.name).entry_points.select(group="console_scripts").names):
            if name in FMUS:
                continue
            try:
                block = load_block(file.parent.name, name)
                block.Params()
            except (ScenarioError, ValueError):  # a tool; a block without defaults
                continue
            yield pytest.param(name, block, marks=[] if name in DAILY else pytest.mark.long, id=name)


@pytest.fixture
def domain():
    with free_domain() as found:
        yield found


@contextmanager
def started(name, block, domain, *files):
    """A node of a block with files of parameters."""
    context = Context()
    words = [word for file in files for word in ("--params-file", str(file))]
    rclpy.init(args=["--ros-args", "-p", "run.mode:=lockstep", *words], context=context, domain_id=domain)
    node = ServingNode(name, context=context)
    try:
        yield node, make_adapter(node, block, RosMiddleware(node))
    finally:
        node.destroy_node()
        context.shutdown()


def other(declared, value):
    """Another value of a parameter within its bounds, if there is one near."""
    if isinstance(value, float) or (value is None and declared.type is float):
        near = 0.5 * value if value else 0.01
        return min(max(near, declared.lower), declared.upper)
    return not value if isinstance(value, bool) else value


@pytest.mark.processes
@pytest.mark.parametrize(("name", "block"), executables())
def test_tuned_dumped_and_loaded_it_is_the_same(name, block, tmp_path, domain):
    with started(name, block, domain) as (node, adapter):
        before = flatten(adapter.block.p)
        wanted = [(d.name, other(d, before[d.name])) for d in declarations(block.Params) if d.live]
        messages = [Parameter(n, value=v).to_parameter_msg() for n, v in wanted if v is not None and v != []]
        node._set(messages)  # some may not fit, which is refused
        now = {n: p.value for n, p in node._parameters.items()}
        # as `ros2 param dump` writes it
        values = {n: v if v is None or isinstance(v, bool | int | float | str) else list(v) for n, v in now.items()}
    file = tmp_path / "dump.yaml"
    file.write_text(yaml.dump({name: {"ros__parameters": values}}))
    with started(name, block, domain, file) as (node, adapter):
        again = flatten(adapter.block.p)
        assert {n: again[n] for n in before if n in values} == {n: values[n] for n in before if n in values}
        loaded = node._set([Parameter(n, value=v).to_parameter_msg() for n, v in values.items() if v not in (None, [])])
        assert [r.reason for r in loaded if not r.successful] == []  # `ros2 param load` of it changes nothing
