"""Start of a node process: ROS parameters to a validated block, then lockstep or realtime."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

import rclpy
from pydantic import ValidationError
from rclpy.node import Node
from rclpy.parameter import Parameter
from softrig_core.block.block import Block, Plant
from softrig_core.block.params import Declaration, build, declarations, flatten
from softrig_core.block.port import require_distinct
from softrig_core.board.clocked import ClockEntry, clocked
from softrig_core.board.entry import LinkEntry
from softrig_core.board.link import linked
from softrig_core.errors import FAILURES
from softrig_core.guard import print_for, secure_streams
from softrig_core.interrupt import interrupt
from softrig_core.rig.options import RunOptions
from softrig_core.run.stuck import watched

from .adapter.adapter import Adapter
from .adapter.spin import spin
from .below.leave import leave
from .below.uses import make_empty, overrides
from .face.faces import Faces
from .face.tuning import Tuning, run_options
from .group import Group
from .processes.executables import LOOPBACK, given_profile
from .rehearsal import rehearse
from .ros.arguments import non_ros_arguments, plain_errors
from .ros.messages import range_descriptor
from .ros.profile import joining
from .ros.ros import OF_QOS, RosMiddleware, ServingNode
from .seam.middleware import Middleware

# arguments that a node reads and that are no parameters of it afterwards, so that a `ros2 param dump` suits another run
RUNNERS = ("run.shard", "run.status", "run.links", "run.changes", "run.again")
HERE = "; reached from this host only (from others with ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET)"
ARRAYS = {
    float: Parameter.Type.DOUBLE_ARRAY,
    int: Parameter.Type.INTEGER_ARRAY,
    bool: Parameter.Type.BOOL_ARRAY,
    str: Parameter.Type.STRING_ARRAY,
}


def run_node(block_class: type[Block], argv: Sequence[str]) -> NoReturn:
    """Run a block as a node until it and the process end; invalid parameters cause one line and exit status 2."""
    secure_streams()
    name = Path(argv[0]).name
    if {"-h", "--help"} & set(argv[1:]):
        print(usage(name, block_class))
        leave([], 0)
    node = None
    try:
        if stray := non_ros_arguments(argv):
            raise ValueError(
                f"unexpected argument {stray[0]!r}: expected --ros-args -p NAME:=VALUE and the like; "
                "--help shows the parameters"
            )
        # The node's own timeout is a parameter, which is known only after it has joined; the default serves until then.
        with plain_errors(), joining(silence=RunOptions().timeout):
            rclpy.init(args=list(argv))
            interrupt.early = False
            node = ServingNode(name)
        # Compilation takes seconds, in which a signal must be able to end the node.
        with interrupt.leaving(partial(leave, [node], 0)), watched():
            adapter = make_adapter(node, block_class, middleware := RosMiddleware(node))
        Group([adapter])
        middleware.report_ignored()
        if not adapter.options.links:
            reach = HERE if given_profile() == LOOPBACK else ""
            node.get_logger().info(introduction(adapter.block, adapter.options) + reach)
    except KeyboardInterrupt:
        leave([node] if node else [], 0)
    # Every error of the start ends in one line that states what was wrong and where.
    except FAILURES as error:
        # A signal has shut the context down in the meantime, and the error is its consequence.
        if not interrupt.early and not rclpy.ok():
            leave([node] if node else [], 0)
        label = node.get_name() if node is not None else name
        print_for(label, error)
        leave([node] if node else [], 2)
    try:
        status = spin(node, adapter)
    # `spin` handles an interrupt itself, except one before its first turn or a second one.
    except KeyboardInterrupt:
        status = 0
    leave([node], status)


def make_adapter(node: ServingNode, block_class: type[Block], middleware: Middleware) -> Adapter:
    """Declare and validate a node's parameters, make its block and its adapter; a `Group` drives it.

    Raises
    ------
    ParameterError
        Bad parameters.
    """
    params, options = _parameters(node, block_class)
    require_distinct(*block_class.ports(params))
    if options.link:
        block_class = _answered(block_class, options.link, params, node.get_name())
    rehearse(block_class, params, node.get_name(), always=options.mode == "realtime")
    block = block_class(params, node.get_name())
    block.reset(options.seed)
    adapter = Adapter(middleware, block, options)
    Faces(node, adapter)
    Tuning(node, adapter)
    return adapter


def _answered(block_class: type[Block], entry: str, params: Any, name: str) -> type[Block]:
    """Return the class of a node whose ticks are answered by a board or by a third-party node."""
    if "answers" in json.loads(entry):
        return clocked(block_class, ClockEntry.model_validate_json(entry), params, name)
    return linked(block_class, LinkEntry.model_validate_json(entry), params, name)


def introduction(block: Block, options: RunOptions) -> str:
    """Describe in one line a node that was started alone, and the messages that it waits for."""
    inputs, outputs = block.ports(block.p)
    purpose = (type(block).__doc__ or type(block).__name__).strip().splitlines()[0].rstrip(".")
    wanted = [p.topic for p in inputs if not p.held]
    waits = f"waits for {', '.join(wanted)}" if wanted else "waits for no message"
    publishes = f"; publishes {', '.join(p.topic for p in outputs)}" if outputs else ""
    return f"{purpose}; {options.mode}, every {block.p.period:g} s; {waits}{publishes}"


def usage(name: str, block_class: type[Block]) -> str:
    """Return the help text of a node: its purpose, its topics, its parameters."""
    lines = [f"{name}: {(block_class.__doc__ or '').strip().splitlines()[0]}", ""]
    try:
        inputs, outputs = block_class.ports(block_class.Params())
    # A block without defaults has no ports until its parameters are given.
    except ValidationError:
        inputs, outputs = (), ()
    for title, ports in (("reads", inputs), ("publishes", outputs)):
        lines += [f"  {title} {p.topic} ({p.msgtype}: {', '.join(p.labels)})" for p in ports]
    if inputs and not issubclass(block_class, Plant):
        overridden = block_class.refused is not Block.refused
        text = (
            (block_class.refused.__doc__ or "").strip().splitlines()[0] if overridden else "Its last outputs are held."
        )
        lines += ["", f"At a tick of which an input is refused: {text}"]
    lines += ["", "Parameters, each as `--ros-args -p NAME:=VALUE` (node name, remaps and files as in any ROS 2 node):"]
    for d in [*declarations(block_class.Params), *declarations(RunOptions, "run.")]:
        unit = f" {d.unit}" if d.unit else ""
        lines.append(f"  {d.name} = {d.default!r}{unit}: {d.doc}{'; may change while running' if d.live else ''}")
    return "\n".join(lines)


def _parameters(node: Node, block_class: type[Block]) -> tuple[Any, RunOptions]:
    """Declare all parameters with descriptions and ranges, and validate the given values."""
    # rclpy gives an empty list in a file no type, so nothing can be declared from the raw override
    # Parameters that may have no value.
    absent = {d.name for d in declarations(block_class.Params) if d.default is None}
    values = {name: [] if p.type_ == Parameter.Type.NOT_SET else p.value for name, p in overrides(node).items()}
    values = {name: value for name, value in values.items() if not (name in absent and value in ([], "null"))}
    for name in ("use_sim_time", "start_type_description_service"):
        values.pop(name, None)
    values = {k: v for k, v in values.items() if not k.startswith(OF_QOS)}
    run = {k: v for k, v in values.items() if k.startswith("run.")}
    of_block = {k: v for k, v in values.items() if not k.startswith("run.")}
    params: Any = build(block_class.Params, of_block)
    options = run_options(run)
    _declare(node, declarations(block_class.Params), flatten(params))
    declared = [d for d in declarations(RunOptions, "run.") if d.name not in RUNNERS]
    _declare(node, declared, flatten(options, "run."))
    return params, options


def _declare(node: Node, wanted: list[Declaration], values: Mapping[str, Any]) -> None:
    for declaration in wanted:
        descriptor = range_descriptor(declaration)
        value = values.get(declaration.name)
        # an optional live parameter may get its first value
        if value is not None or declaration.live:
            node.declare_parameter(declaration.name, value, descriptor, ignore_override=True)
        # rclpy declares an empty list as one of bytes.
        if value == []:
            make_empty(node, declaration.name, ARRAYS[declaration.type])
