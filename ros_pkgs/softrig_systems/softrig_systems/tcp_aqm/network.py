"""What the fluid and the packet plant share: topics, commands, disturbances and events of the network."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, NamedTuple, Self

from pydantic import model_validator
from softrig_core import BlockParams, Level, Plant, Port, param
from typing_extensions import TypeVar

from .model import Bottleneck
from .ports import COMMAND, STATE, TRUTH, events


class NetworkParams(Bottleneck, BlockParams):
    """Bottleneck, start and disturbance."""

    w_max: float = param(60.0, "largest window", "packet", gt=1.0, le=1e5)
    w_min: float = param(1.0, "smallest window; TCP never goes below one packet", "packet", gt=0.0, le=1e5)
    w0: float = param(1.0, "window at the start and before", "packet", gt=0.0, le=1e5)
    q0: float = param(0.0, "queue at the start and before", "packet", ge=0.0, le=1e6)
    p0: float = param(0.0, "drop probability before the first command", ge=0.0, le=1.0)
    history: float = param(1.0, "how far back the past is kept", "s", gt=0.0, le=100.0)
    disturbance: Literal["none", "sensor_offset", "queue_jump", "rate"] = param(
        "none", "what happens: the queue is measured too high, grows at once, or gets traffic that obeys nobody"
    )
    disturbance_value: float = param(20.0, "its size in packets; packet/s of a rate", ge=-1e6, le=1e6)
    disturbance_time: float = param(10.0, "when it begins", "s", ge=0.0, le=1e6)

    @property
    def longest_delay(self) -> float:
        """Largest round trip time R_max = q_max/C + tau_p, s."""
        return self.q_max / self.C + self.tau_p

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.history < self.longest_delay:
            raise ValueError(f"history = {self.history:g} s is shorter than the longest delay q_max/C + tau_p = "
                             f"{self.longest_delay:g} s")  # fmt: skip
        if not self.w_min <= self.w0 <= self.w_max:
            raise ValueError(f"w0 = {self.w0:g}: expected w_min <= w0 <= w_max, {self.w_min:g} to {self.w_max:g}")
        if self.q0 > self.q_max:
            raise ValueError(f"q0 = {self.q0:g}: expected at most q_max = {self.q_max:g}")
        return self


class State(NamedTuple):
    """Window (packets; of packets the mean over the sources), queue (packets), packets served so far."""

    w: float
    q: float
    served: float


P = TypeVar("P", bound=NetworkParams, default=NetworkParams)


class Network(Plant[P]):
    """A queue whose drop or mark probability is the command; what is behind it is the subclass's.

    The command is held for one period; outside [0, 1] it is clipped. Disturbances and events act at the internal step
    nearest to their time. What the network is made of changes by events on its topic; the parameters are the start.
    """

    OUTPUTS = (STATE, TRUTH)

    @classmethod
    def drawing(cls) -> Any:
        """Give what draws it."""
        from .drawing import Bottleneck

        return Bottleneck

    @classmethod
    def agreed(cls, params: NetworkParams) -> Mapping[str, Any]:
        """The bottleneck."""
        return params.agreed()

    @classmethod
    def ports(cls, params: NetworkParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """Events change what the parameters begin with."""
        now = (float(params.N), params.C, params.tau_p, 0.0)
        return (COMMAND, events(now)), cls.OUTPUTS

    def start(self) -> None:
        """Begin with the given window and queue, which have been so for ever."""
        p = self.p
        self.flows, self.capacity, self.propagation, self.rate = p.N, p.C, p.tau_p, 0.0
        self._events: tuple[float, ...] | None = None
        self._step = 0
        self._p = p.p0
        self._offset = 0.0
        self._change = -1 if p.disturbance == "none" else round(p.disturbance_time / self._h)
        self.begin()
        if self._change == 0:
            self._disturb()
        self._sense()

    @property
    def state(self) -> State:
        """Give the true state of now; what is under way in the network counts as well."""
        return State(self.window, self.queue, self.served)

    def outputs(self, t: int) -> Mapping[str, tuple[float, ...]]:
        """Give the measured state and the truth at t."""
        return self._answer

    def advance(self, t: int, *, command: tuple[float, ...], events: tuple[float, ...] | None = None) -> None:
        """Hold the drop probability for one period."""
        if events is not None and events != self._events:
            self._events = events
            self._happen(*events)
        p = self._accept(command[0])
        end = self._step + self._steps
        if self._step < self._change <= end:
            self.move(self._change - self._step, p)
            self._step = self._change
            self._disturb()
        if end > self._step:
            self.move(end - self._step, p)
            self._step = end
        self._sense()

    def _accept(self, p: float) -> float:
        if not 0.0 <= p <= 1.0:
            self.report(Level.WARN, "clipped", f"drop probability {p:g} clipped to [0, 1]")
            return 0.0 if p < 0.0 else 1.0
        return p

    def _disturb(self) -> None:
        p = self.p
        if p.disturbance == "sensor_offset":
            self._offset = p.disturbance_value
        elif p.disturbance == "queue_jump":
            self.jump(p.disturbance_value)
        else:
            self.rate += p.disturbance_value
            self.changed()

    def _happen(self, flows: float, capacity: float, propagation: float, rate: float) -> None:
        """Take new constants of the network, unless they are impossible."""
        count = round(flows)
        possible = 1 <= count <= self.most_flows and capacity > 0.0 and propagation > 0.0
        if not possible or self.p.q_max / capacity + propagation > self.p.history or 4.0 * self._h > propagation:
            self.report(Level.ERROR, "impossible_event", f"event flows {flows:g}, capacity {capacity:g}, propagation "
                        f"{propagation:g}: impossible, or its delay is beyond the history; ignored")  # fmt: skip
            return
        self.flows, self.capacity, self.propagation = count, capacity, propagation
        self.rate = rate
        self.changed()

    def _sense(self) -> None:
        C, tau_p = self.capacity, self.propagation
        measured = self.queue + self._offset
        self._answer = {
            "state": (self.window, measured, measured / C + tau_p),
            "truth": (self.window, self.queue, self.queue / C + tau_p, self.window_delayed,
                      self.queue_delayed / C + tau_p, self.served),
        }  # fmt: skip

    # what a subclass has ----------------------------------------------------------------------------------------

    window: float
    queue: float
    served: float
    window_delayed: float
    queue_delayed: float
    _h: float
    _steps: int
    most_flows: int = 2000

    def begin(self) -> None:
        """Set the state to the start."""
        raise NotImplementedError

    def move(self, steps: int, p: float) -> None:
        """Take internal steps of size `_h` from number `_step` on with the drop probability p."""
        raise NotImplementedError

    def jump(self, packets: float) -> None:
        """Put packets into the queue at once."""
        raise NotImplementedError

    def changed(self) -> None:
        """React to new `flows`, `capacity`, `propagation` or `rate`."""
