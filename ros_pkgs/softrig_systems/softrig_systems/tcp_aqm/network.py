"""What the fluid and the packet plant share: topics, commands, disturbances and events of the network."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

from softrig_core import BlockParams, Level, Plant, Port, Values, param
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
        "none", "event: the queue is measured too high, grows suddenly, or receives traffic without congestion control"
    )
    disturbance_value: float = param(20.0, "its size in packets; packet/s of a rate", ge=-1e6, le=1e6)
    disturbance_time: float = param(10.0, "when it begins", "s", ge=0.0, le=1e6)

    @property
    def longest_delay(self) -> float:
        """Largest round trip time R_max = q_max/C + tau_p, s."""
        return self.q_max / self.C + self.tau_p

    def _check(self) -> None:
        if self.history < self.longest_delay:
            raise ValueError(
                f"history = {self.history:g} s is shorter than the longest delay q_max/C + tau_p = "
                f"{self.longest_delay:g} s"
            )
        if not self.w_min <= self.w0 <= self.w_max:
            raise ValueError(f"w0 = {self.w0:g}: expected w_min <= w0 <= w_max, {self.w_min:g} to {self.w_max:g}")
        if self.q0 > self.q_max:
            raise ValueError(f"q0 = {self.q0:g}: expected at most q_max = {self.q_max:g}")


class Net(NamedTuple):
    """Present network: flows, capacity (packet/s), propagation delay (s), uncontrolled traffic (packet/s).

    It also has the offset of the queue measurement (packets), and the events applied last.
    """

    flows: int
    capacity: float
    propagation: float
    rate: float = 0.0
    offset: float = 0.0
    events: tuple[float, ...] | None = None


class Seen(NamedTuple):
    """Window (of packets the mean over the sources), queue, packets served so far; both first one round trip before."""

    window: float
    queue: float
    served: float
    window_delayed: float
    queue_delayed: float


P = TypeVar("P", bound=NetworkParams, default=NetworkParams)


class Network(Plant[P]):
    """A queue whose drop or mark probability is the command; subclasses implement the sources.

    The command is held for one period; outside [0, 1] it is clipped. Disturbances and events act at the internal step
    nearest to their time. The network changes by events on its topic; the parameters give the initial values. The state
    has the fields `step`, the number of internal steps so far, and `net`, a `Net`.
    """

    DRAWN_BY = "softrig_systems.tcp_aqm.drawing:Bottleneck"
    OUTPUTS = (STATE, TRUTH)

    @classmethod
    def agreed(cls, params: NetworkParams) -> Mapping[str, Any]:
        """The bottleneck."""
        return params.agreed()

    @classmethod
    def ports(cls, params: NetworkParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """Declare the ports; events change values that begin with the parameters."""
        now = (float(params.N), params.C, params.tau_p, 0.0)
        return (COMMAND, events(now)), cls.OUTPUTS

    def setup(self) -> None:
        """Find the internal step of the disturbance."""
        p = self.p
        self._change = -1 if p.disturbance == "none" else round(p.disturbance_time / self._h)

    def first(self) -> Any:
        """Return a state in which the given window and queue have always been constant."""
        p = self.p
        x = self.begin(Net(p.N, p.C, p.tau_p))
        return self._disturbed(x) if self._change == 0 else x

    def outputs(self, x: Any, t: int) -> Values:
        """Return the measured state and the truth at t."""
        w, q, served, w_R, q_R = self.seen(x)
        C, tau_p, offset = x.net.capacity, x.net.propagation, x.net.offset
        measured = q + offset
        return {
            "state": (w, measured, measured / C + tau_p),
            "truth": (w, q, q / C + tau_p, w_R, q_R / C + tau_p, served),
        }

    def advance(self, x: Any, t: int, *, command: tuple[float, ...], events: tuple[float, ...] | None = None) -> Any:
        """Hold the drop probability for one period."""
        if events is not None and events != x.net.events:
            x = self._happened(x, *events)
        p = self._accept(command[0])
        end = x.step + self._steps
        if x.step < self._change <= end:
            x = self._disturbed(self.moved(x, self._change - x.step, p))
        return self.moved(x, end - x.step, p) if end > x.step else x

    def _accept(self, p: float) -> float:
        if not 0.0 <= p <= 1.0:
            self.report(Level.WARN, "clipped", f"drop probability {p:g} clipped to [0, 1]")
            return 0.0 if p < 0.0 else 1.0
        return p

    def _disturbed(self, x: Any) -> Any:
        p = self.p
        if p.disturbance == "queue_jump":
            return self.jumped(x, p.disturbance_value)
        if p.disturbance == "sensor_offset":
            return self.changed(x, x.net._replace(offset=p.disturbance_value))
        return self.changed(x, x.net._replace(rate=x.net.rate + p.disturbance_value))

    def _happened(self, x: Any, flows: float, capacity: float, propagation: float, rate: float) -> Any:
        """Apply new constants of the network, unless they are impossible."""
        net, count = x.net._replace(events=(flows, capacity, propagation, rate)), round(flows)
        possible = 1 <= count <= self.most_flows and capacity > 0.0 and propagation > 0.0
        if possible and self.p.q_max / capacity + propagation <= self.p.history and 4.0 * self._h <= propagation:
            net = net._replace(flows=count, capacity=capacity, propagation=propagation, rate=rate)
        else:
            self.report(
                Level.ERROR,
                "impossible_event",
                f"event flows {flows:g}, capacity {capacity:g}, propagation "
                f"{propagation:g}: impossible, or its delay is beyond the history; ignored",
            )
        return self.changed(x, net)

    # what a subclass has ----------------------------------------------------------------------------------------

    _h: float  # internal step, s
    _steps: int  # internal steps in a period
    most_flows: int = 2000

    def begin(self, net: Net) -> Any:
        """Return the state at the start."""
        raise NotImplementedError

    def seen(self, x: Any) -> Seen:
        """Return its outputs."""
        raise NotImplementedError

    def moved(self, x: Any, steps: int, p: float) -> Any:
        """Run internal steps of size `_h` with the drop probability p."""
        raise NotImplementedError

    def jumped(self, x: Any, packets: float) -> Any:
        """Add packets to the queue in one batch."""
        raise NotImplementedError

    def changed(self, x: Any, net: Net) -> Any:
        """Continue in another network."""
        raise NotImplementedError
