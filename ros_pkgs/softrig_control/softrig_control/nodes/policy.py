"""A policy in place of a controller: a function from observations to commands, by its registered name."""

from __future__ import annotations

import copy
import importlib.metadata
import pickle
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from types import CellType, FunctionType
from typing import Any, NamedTuple

from softrig_core import Block, BlockParams, ParameterError, Port, Sample, param
from softrig_core.scenario.port_text import ports_of

GROUP = "softrig_policies"  # group of entry points
Act = Callable[[Sequence[float]], Sequence[float]]


def linear(weights: Sequence[float], observations: int, actions: int) -> Act:
    """Return the policy ``u = W y + b``.

    Parameters
    ----------
    weights : sequence of float
        Row by row, one an action: its weight of each observation, then its constant.
    observations, actions : int
        How many there are.

    Raises
    ------
    ValueError
        Another number of weights.
    """
    wide = observations + 1
    if len(weights) != actions * wide:
        raise ValueError(
            f"a linear policy of {observations} observations and {actions} actions has {actions * wide} "
            f"weights, row by row with the constant last; got {len(weights)}"
        )
    rows = [weights[k * wide : (k + 1) * wide] for k in range(actions)]

    def act(observed: Sequence[float]) -> list[float]:
        result = []
        for row in rows:
            total = row[-1]
            # A row has its constant behind the weights and is thus longer than the observation.
            for weight, value in zip(row, observed, strict=False):
                total += weight * value
            result.append(total)
        return result

    return act


def find(name: str) -> Callable[[Sequence[float], int, int], Act]:
    """Find the factory of a policy: `linear`, or the entry point of an installed package in the group `GROUP`.

    Raises
    ------
    ParameterError
        There is none; the message lists those that exist. Only registered code is imported, because a scenario may be
        untrusted.
    """
    if name == "linear":
        return linear
    points = importlib.metadata.entry_points(group=GROUP)
    if name not in points.names:
        known = ", ".join(["linear", *sorted(points.names)])
        raise ParameterError(
            f"policy = {name!r}: expected one of {known}; a package registers its own, "
            f"module:callable, in the group {GROUP}"
        )
    try:
        make: Any = points[name].load()
    except (ImportError, AttributeError) as error:
        raise ParameterError(f"policy = {name!r} ({points[name].value}) cannot be loaded: {error}") from None
    if not callable(make):
        raise ParameterError(f"policy = {name!r}: {points[name].value} is a {type(make).__name__}, expected a function")
    return make  # type: ignore[no-any-return]


def copied(act: Act) -> Act:
    """Copy a policy with its memory, in an object or in the variables around a function.

    A policy that cannot be copied is returned itself; it is assumed to have no state.
    """
    if not isinstance(act, FunctionType) or not act.__closure__:
        try:
            return copy.deepcopy(act)
        except (TypeError, ValueError, AttributeError, copy.Error, pickle.PicklingError):
            return act
    cells = tuple(CellType(copied(c.cell_contents)) for c in act.__closure__)
    result = FunctionType(act.__code__, act.__globals__, act.__name__, act.__defaults__, cells)
    result.__kwdefaults__ = act.__kwdefaults__
    return result


class PolicyParams(BlockParams):
    """The policy, its numbers, and the ports of the controller that it replaces."""

    policy: str = param("linear", "`linear`, or the name of an entry point in the group softrig_policies")
    weights: tuple[float, ...] = param((0.0, 0.0), "what the policy has learned")
    inputs: str = param(
        '[{"name": "state", "topic": "state", "msgtype": "sensor_msgs/msg/JointState", "channels": ["x"],'
        ' "fields": ["position"], "units": ["m"]}]',
        "the topics of the inputs, each as a port, in JSON",
    )
    outputs: str = param(
        '[{"name": "command", "topic": "command", "msgtype": "sensor_msgs/msg/JointState", "channels": ["x"],'
        ' "fields": ["effort"], "units": ["N"]}]',
        "the topics of the outputs, in the same form",
    )
    observe: tuple[str, ...] = param(("state/x/position",), "the signals of an observation: topic/channel/field")
    act: tuple[str, ...] = param(("command/x/effort",), "those of an action; the others keep their ports' safe values")
    low: tuple[float, ...] = param((), "least value of each action; empty: the limits of the ports")
    high: tuple[float, ...] = param((), "largest value of each action")

    def _check(self) -> None:
        for key, signals, ports in (("observe", self.observe, self.input_ports), ("act", self.act, self.output_ports)):
            known = {f"{p.topic}/{label}" for p in ports for label in p.labels}
            for signal in signals:
                if signal not in known:
                    raise ValueError(f"{key}: {signal!r} is on none of the ports; they have {', '.join(sorted(known))}")
            if len({*signals}) != len(signals) or not signals:
                raise ValueError(f"{key}: expected signals, each once")
        for name in ("low", "high"):
            if len(getattr(self, name)) not in (0, len(self.act)):
                raise ValueError(f"{name}: {len(getattr(self, name))} values, expected one an action, {len(self.act)}")
        for signal, (low, high) in zip(self.act, self.bounds(), strict=True):
            if not low < high:
                raise ValueError(f"bounds of {signal}: {low:g} is not below {high:g}")

    @cached_property
    def input_ports(self) -> tuple[Port, ...]:
        """The inputs that the text describes."""
        return ports_of(self.inputs)

    @cached_property
    def output_ports(self) -> tuple[Port, ...]:
        """The outputs that the text describes."""
        return ports_of(self.outputs)

    def bounds(self) -> list[tuple[float, float]]:
        """Least and largest value of each action, within the limits of its port."""
        limits = {
            f"{p.topic}/{label}": m for p in self.output_ports for label, m in zip(p.labels, p.limits, strict=True)
        }
        most = [limits[a] for a in self.act]
        low = self.low or [-m for m in most]
        high = self.high or most
        return [(max(a, -m), min(b, m)) for a, b, m in zip(low, high, most, strict=True)]


class State(NamedTuple):
    """The policy itself, which may remember anything."""

    act: Act


class Policy(Block[PolicyParams]):
    """Publishes at each tick the action of its policy for the newest observation, limited to the action bounds.

    A value that has not arrived yet is observed as the safe value of its port.
    """

    @classmethod
    def ports(cls, params: PolicyParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """Return the ports of the controller that it replaces."""
        return params.input_ports, params.output_ports

    def setup(self) -> None:
        """Find where each signal is, and the policy."""
        p = self.p
        known = {f"{port.topic}/{label}": (port, k) for port in p.input_ports for k, label in enumerate(port.labels)}
        self.observed = [known[signal] for signal in p.observe]
        index = {signal: k for k, signal in enumerate(p.act)}
        self._acted = [(port, [index.get(f"{port.topic}/{label}") for label in port.labels]) for port in p.output_ports]
        self._bounds = p.bounds()
        self._make = find(p.policy)
        self._policy()

    def _policy(self) -> Act:
        p = self.p
        try:
            return self._make(p.weights, len(p.observe), len(p.act))
        except ValueError as error:
            raise ParameterError(f"policy {p.policy}: {error}") from None

    def first(self) -> State:
        """Return a policy without memory of the past."""
        return State(self._policy())

    def save(self, x: State) -> State:
        """Copy the policy with its memory."""
        return State(copied(x.act))

    def load(self, saved: State) -> State:
        """Continue with a copy of the stored copy."""
        return State(copied(saved.act))

    def observation(self, inputs: Mapping[str, Any]) -> tuple[float, ...]:
        """Return the observation that the values of the ports make."""
        results = []
        for port, k in self.observed:
            values = inputs[port.name]
            values = port.safe if values is None else values.data if isinstance(values, Sample) else values
            results.append(values[k])
        return tuple(results)

    def update(self, x: State, t: int, **inputs: Any) -> tuple[State, Mapping[str, tuple[float, ...] | Sample | None]]:
        """Publish the commands of the policy."""
        result = x.act(self.observation(inputs))
        if len(result) != len(self._bounds):
            raise ValueError(f"the policy gave {len(result)} actions, expected {len(self._bounds)}")
        # Both comparisons are false for NaN: it is passed on and refused as that of any block.
        action = [low if a < low else high if a > high else a for a, (low, high) in zip(result, self._bounds)]
        messages: dict[str, tuple[float, ...] | Sample | None] = {}
        for port, indices in self._acted:
            row = tuple([safe if k is None else float(action[k]) for k, safe in zip(indices, port.safe, strict=True)])
            silent = port.sporadic and not any(k is not None for k in indices)
            messages[port.name] = None if silent else Sample(t, row) if port.delayed else row
        return x, messages
