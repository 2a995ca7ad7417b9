"""Parameters of a running node: values set by the usual ROS services are checked, and take effect at the next tick."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.parameter import Parameter
from softrig_core.block.block import Level
from softrig_core.block.params import ParameterError, build, flatten
from softrig_core.rig.options import RunOptions

from ..adapter.adapter import Adapter
from ..ros.ros import ServingNode, plain


class Tuning:
    """Passes changed parameters to the step of a node, all of a call or none.

    Parameters
    ----------
    node : ServingNode
        The node that declares the parameters.
    """

    def __init__(self, node: ServingNode, adapter: Adapter) -> None:
        self._node, self._adapter = node, adapter
        self._own = flatten(adapter.block.p).keys()
        node.add_on_set_parameters_callback(self._set)
        node.paused = lambda: adapter.hold.held
        # in /diagnostics, and logged with the next tick
        node.overdrawn = lambda text: adapter.step.note(Level.WARN, "services", text)
        node.dropped = lambda: adapter.step.note(Level.OK, "answers", "an answer is dropped: its client has left")

    def _set(self, parameters: Sequence[Parameter]) -> SetParametersResult:
        adapter = self._adapter
        pace = next((plain(p) for p in parameters if p.name == "run.pace"), None)
        values = {p.name: plain(p) for p in parameters if p.name in self._own}
        try:
            if adapter.state in ("done", "failed"):
                raise ParameterError("the run is over")
            removed = [p.name for p in parameters if p.name in values and p.type_ == Parameter.Type.NOT_SET]
            if removed:
                raise ParameterError(f"parameter {removed[0]} has no value, expected one")
            if pace is not None and not adapter.hold.has_pace:
                raise ParameterError("run.pace can be set only at the node of the clock, in lockstep, after the start")
            run: Any = run_options({p.name: plain(p) for p in parameters if p.name.startswith("run.")})
            replaced = adapter.step.set(values) if values else []
            # The pace is set last, because it cannot fail any more: a call sets all of its parameters or none.
            if pace is not None:
                adapter.hold.go_at(run.pace)
        except ParameterError as error:
            return SetParametersResult(successful=False, reason=str(error))
        if replaced:
            self._node.remark = f"in place of {', '.join(replaced)} that was set before and had not taken effect"
        return SetParametersResult(successful=True)


def run_options(values: Mapping[str, Any]) -> RunOptions:
    """Return the options with these values of the parameters ``run.*``; a ParameterError names the parameter."""
    try:
        return build(RunOptions, {name.removeprefix("run."): value for name, value in values.items()})  # type: ignore[return-value]
    except ParameterError as error:
        raise ParameterError(str(error).replace("parameter ", "parameter run.", 1)) from None
