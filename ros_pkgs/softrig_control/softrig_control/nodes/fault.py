"""A fault on a link between two nodes: the effect of a failing sensor, line or network on messages."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple

from softrig_core import Block, Port, Sample, button, param, to_ns
from softrig_core.wire import types

from .delay import Line, whole_periods
from .unit_delay import LinkParams

Kind = Literal["offset", "scale", "drift", "noise", "quantise", "saturate", "stuck", "spike", "delay", "loss", "repeat",
               "silence", "add", "replace", "invalid"]  # fmt: skip
Message = tuple[float, ...] | Sample


class FaultParams(LinkParams):
    """Parameters of a fault on a link: its messages, the kind of fault, the values concerned, and the times."""

    kind: Kind = param("offset", "what happens to the messages")
    affects: tuple[str, ...] = param((), "channels or single values (``shaft/velocity``) concerned; empty: all")
    value: tuple[float, ...] = param(
        (1.0,),
        "offset; factor; drift a second; standard deviation of the noise; step; "
        "upper limit; height of a spike: one, or one for each concerned",
        live=True,
    )
    lower: tuple[float, ...] = param((), "lower limit of `saturate`; empty: -value", live=True)
    points: tuple[float, ...] = param(
        (), "of `add` and `replace`: values of a profile over `span`, equally spaced", live=True
    )
    span: float = param(1.0, "time that the points cover, from `start` on; the last one stays", "s", gt=0.0, live=True)
    linear: bool = param(
        False, "whether the points are joined by lines, the last one at the end of `span`, or are steps", live=True
    )
    start: float = param(0.0, "time from which the fault is there", "s", ge=0.0, live=True)
    stop: float = param(0.0, "time from which it is gone; 0: it stays", "s", ge=0.0, live=True)
    every: float = param(0.0, "period with which it is switched on and off; 0: it stays on", "s", ge=0.0, live=True)
    lasts: float = param(0.0, "how long it is there in each period", "s", ge=0.0, live=True)
    probability: float = param(
        1.0, "of `spike`, `loss`, `repeat` and `invalid`, for each message", ge=0.0, le=1.0, live=True
    )
    lost_in_burst: float = param(
        1.0, "probability that a message is lost in a burst (Gilbert-Elliott)", ge=0.0, le=1.0, live=True
    )
    burst_begins: float = param(
        0.0, "probability that a burst of losses begins at a message; 0: none does", ge=0.0, le=1.0, live=True
    )
    burst_ends: float = param(1.0, "probability that it ends at a message", gt=0.0, le=1.0, live=True)
    delay: float = param(0.0, "of `delay`, rounded up to whole periods", "s", ge=0.0, le=1e4, live=True)
    jitter: float = param(
        0.0,
        "largest additional delay; whole periods from 0 up to it are equally likely",
        "s",
        ge=0.0,
        le=1e4,
        live=True,
    )
    overtaking: bool = param(
        True, "whether a message may arrive before one sent earlier, which is then dropped", live=True
    )
    delayed: bool = param(False, "whether the stamps are times of acquisition, as after a `fieldbus_delay`")
    holds: bool = param(
        False,
        "publish the held value again instead of silence, for subscribers that cannot see it; at first `initial`",
    )
    active: bool = param(True, "whether it is switched on at first; the button `toggle` switches", live=True)

    def _check(self) -> None:
        count = len(self.concerned())
        for name, values in (("value", self.value), ("lower", self.lower)):
            if len(values) not in ((1, count) if name == "value" else (0, 1, count)):
                raise ValueError(f"{name} has {len(values)} numbers, expected one, or one for each of {count} values")
        if self.kind in ("noise", "quantise") and min(self.value) < 0.0:
            raise ValueError(f"value = {min(self.value):g}: expected at least 0 for {self.kind}")
        if self.kind == "invalid" and self.message == types.BUTTON.name:
            raise ValueError("kind invalid: a std_msgs/msg/Bool is true or false and cannot be NaN")
        if self.delayed and not self.type.stamped:
            raise ValueError(f"delayed: a {self.message} has no stamp")
        if self.kind == "saturate":
            for low, high in zip(*self.range(), strict=True):
                if low > high:
                    raise ValueError(f"lower = {low:g} is above value = {high:g}")
        if (self.kind in ("add", "replace")) != bool(self.points):
            raise ValueError(f"points: {'needed' if not self.points else 'not used'} for kind {self.kind}")
        if 0.0 < self.stop <= self.start:
            raise ValueError(f"stop = {self.stop:g} s is not after start = {self.start:g} s")
        if self.every and not 0.0 < self.lasts < self.every:
            raise ValueError(f"lasts = {self.lasts:g} s: expected more than 0 and less than every = {self.every:g} s")
        if self.lasts and not self.every:
            raise ValueError("lasts needs every; for a single period use start and stop")

    def concerned(self) -> tuple[int, ...]:
        """Return the indices of the values that the fault changes.

        Raises
        ------
        ValueError
            A name that is no channel and no value of the message.
        """
        labels = self.port("link", self.topic_in).labels
        results: list[int] = []
        if not self.affects:
            return tuple(range(len(labels)))
        for name in self.affects:
            indices = [i for i, label in enumerate(labels) if label == name or label.split("/")[0] == name]
            if not indices:
                raise ValueError(f"affects {name!r}, but the link carries {', '.join(labels)}")
            results += [i for i in indices if i not in results]
        return tuple(results)

    def range(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Return lower and upper limit of each value that `saturate` concerns."""
        high = self.value * len(self.concerned()) if len(self.value) == 1 else self.value
        low = self.lower or tuple(-x for x in high)
        return low * len(high) if len(low) == 1 else low, high


class State(NamedTuple):
    """State of the fault; times in ns."""

    on: bool
    """Whether it is switched on."""

    down: bool = False
    """Whether the button is."""

    burst: bool = False
    since: int = -1
    """When it came; -1 while it is not there."""

    stuck: tuple[float, ...] = ()
    """What was sent then."""

    before: Message = ()
    """The message before."""

    line: Line = Line()
    published: Message = ()
    """Handed on last."""

    newest_acquired: int = -1
    """Stamp of the newest message, of acquisition times."""

    newest: int = -1
    """Stamp of the newest that has arrived."""

    last_due: int = 0
    k: int = 0
    """Random numbers drawn: of kinds that draw some, 0 before the first message."""


class Fault(Block[FaultParams]):
    """Forwards messages, changed while the fault is active, or drops those that the fault loses.

    Its output is sporadic: when a message is lost, late or silenced, a reader keeps its last value, and `Block.age` is
    the age of this value. A message carries the stamp of the tick at which it is published. In lockstep, silence cannot
    be signalled to an external node; with `holds` such a reader receives the last value again.

    Notes
    -----
    ``drift`` grows from the moment the fault begins, ``stuck`` holds the value of that moment. The random numbers
    depend on the rig's seed and the node's name; they are drawn for every message, so that neither `start` nor `toggle`
    shifts them. A button (std_msgs/Bool) counts as pressed when its value rises above one half. After a link whose
    stamps are acquisition times, only a sample with a new acquisition time counts as a message, and it keeps that time.

    Live parameters (times, amounts, rates, `active`) act on all later messages. Messages under way still arrive at
    their scheduled times, and an active fault keeps its start time. Changing `active` switches the fault in the same
    way as `toggle`, and the button also changes `active`. So setting `active` to false after the button was pressed
    leaves the fault off.

    A lost message is drawn independently, or in bursts after Gilbert and Elliott [1]_ where
    `burst_begins` > 0.

    References
    ----------
    .. [1] E. O. Elliott, Estimates of error rates for codes on burst-noise channels, Bell System Technical Journal 42,
       1963, pp. 1977-1997.
    """

    @classmethod
    def ports(cls, params: FaultParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """Return both ends of the link, of the same message type, and the switch."""
        switch = button("toggle", f"{params.topic_out}/toggle", held=True)
        return (params.port("sent", params.topic_in, delayed=params.delayed), switch), (
            params.port(
                "arrived",
                params.topic_out,
                sporadic=not params.holds,
                delayed=params.delayed,
                unchecked=params.kind == "invalid",
            ),
        )

    def setup(self) -> None:
        """Turn times into ns, find the values concerned."""
        p = self.p
        self._period = to_ns(p.period)
        self._delay, self._jitter = (whole_periods(x, p.period)[0] for x in (p.delay, p.jitter))
        self._window = to_ns(p.start), to_ns(p.stop) if p.stop else math.inf
        self._span = to_ns(p.span)
        self._cycle = to_ns(p.every), to_ns(p.lasts)
        self._concerned = p.concerned()
        self._values = p.value if len(p.value) > 1 else p.value * len(self._concerned)
        self._pressed = p.message == types.BUTTON.name
        self._place = [
            self._concerned.index(i) if i in self._concerned else None
            for i, _ in enumerate(p.port("sent", p.topic_in).labels)
        ]
        self._limits = list(zip(*p.range(), strict=True)) if p.kind == "saturate" else []

    def first(self) -> State:
        """Return the state with the switch set by the parameters and no message in transit."""
        initial = self.p.initial or (0.0,) * self.p.port("sent", self.p.topic_in).size
        message = Sample(0, initial) if self.p.delayed else initial
        return State(self.p.active, stuck=initial, before=message, line=Line(len(initial)), published=message)

    def params(self, x: State) -> FaultParams:
        """The button moves `active`."""
        return self.p if x.on == self.p.active else self.p.model_copy(update={"active": x.on})

    def go_on(self, x: State, before: FaultParams) -> State:
        """Continue with another time, amount or switch of the fault."""
        return x._replace(on=self.p.active)

    def update(
        self, x: State, t: int, *, sent: Message, toggle: tuple[float] | None
    ) -> tuple[State, Mapping[str, Message]]:
        """Return the input of this tick as the fault changes it."""
        p, kind = self.p, self.p.kind
        on, was_down, burst, since, stuck, before, line, sample, used, newest, last_due, k = x
        down = toggle is not None and toggle[0] > 0.5
        if down and not was_down:
            on = not on
        age, received = self.age("sent"), False
        # A link that preserves acquisition times shows its last sample again until a new one arrives.
        if isinstance(sent, Sample):
            stamp, data = sent
            last, used = used, stamp if age is not None else -1
            fresh = used > last
        else:
            stamp, data, fresh = t, sent, age == 0
        if fresh:
            # Each message of this kind draws numbers, so k > 0 shows that there is a message to repeat.
            repeats = k > 0
            draws, burst, k = self._draws(burst, k)
            faulty = on and self._there(t)
            if not faulty:
                since = -1
            elif since < 0:
                since, stuck = t, data
            if faulty and kind == "delay":
                due = t + (self._delay + int(draws[0] * (self._jitter + 1))) * self._period
                last_due = due if p.overtaking else max(due, last_due)
                line = line.put(last_due, stamp, data)
            elif not faulty:
                received, newest, sample = True, stamp, sent
            elif not self._lost(burst, draws):
                received = True
                sample = (
                    before
                    if kind == "repeat" and repeats and draws[0] < p.probability
                    else (self._faulty(t, sent, data, since, stuck, draws))
                )
            before = sent
        if kind == "delay":
            last = newest
            line, newest, late = line.pop_arrived(t, newest, sample.data if isinstance(sample, Sample) else sample)
            if newest > last:
                received, sample = True, Sample(newest, late) if isinstance(sample, Sample) else late
        x = State(on, down, burst, since, stuck, before, line, sample, used, newest, last_due, k)
        if not received and not p.holds:
            return x, {}
        return x, {"arrived": sample}

    def _there(self, t: int) -> bool:
        """Return whether the fault is active at a time."""
        first, last = self._window
        every, lasts = self._cycle
        return first <= t < last and (not every or (t - first) % every < lasts)

    def _lost(self, burst: bool, draws: Sequence[float]) -> bool:
        """Return whether a message is lost while the fault is active."""
        kind, p = self.p.kind, self.p
        chance = p.probability if not p.burst_begins else p.lost_in_burst if burst else 0.0
        return kind == "silence" or (kind == "loss" and draws[0] < chance)

    def _faulty(
        self,
        t: int,
        message: Message,
        sent: tuple[float, ...],
        since: int,
        stuck: tuple[float, ...],
        draws: Sequence[float],
    ) -> Message:
        """Return a message with the fault, if it is not lost."""
        kind, p = self.p.kind, self.p
        if kind in ("loss", "repeat") or (kind in ("spike", "invalid") and draws[0] >= p.probability):
            return message
        profile = self._profile(t - self._window[0]) if p.points else 0.0
        changed = [
            x if k is None else self._changed(k, x, t, since, held, draws, profile)
            for x, k, held in zip(sent, self._place, stuck, strict=True)
        ]
        if self._pressed:
            changed = [float(x > 0.5) for x in changed]
        return Sample(message.stamp, tuple(changed)) if isinstance(message, Sample) else tuple(changed)

    def _profile(self, since: int) -> float:
        """Value of the profile at a time in ns after its start."""
        points = self.p.points
        position = since / self._span * (len(points) - self.p.linear)
        k = int(position)
        if k >= len(points) - 1:
            return points[-1]
        return points[k] + (position - k) * (points[k + 1] - points[k]) if self.p.linear else points[k]

    def _draws(self, burst: bool, k: int) -> tuple[list[float], bool, int]:
        """Random numbers of a message, the burst after it, and how many numbers have been drawn."""
        p = self.p
        if p.kind == "noise":
            n = len(self._concerned)
            return [self.standard_normal(k + i) for i in range(n)], burst, k + n
        if p.kind not in ("loss", "repeat", "delay", "spike", "invalid"):
            return [], burst, k
        if p.kind == "loss" and p.burst_begins:
            turn = self.uniform(k + 1)
            burst = turn >= p.burst_ends if burst else turn < p.burst_begins
        # Two numbers are used up even without bursts, so that switching bursts on leaves the other sequence as it is.
        return [self.uniform(k)], burst, k + 2

    def _changed(
        self, k: int, x: float, t: int, since: int, stuck: float, draws: Sequence[float], profile: float
    ) -> float:
        kind = self.p.kind
        if kind in ("add", "replace"):
            return profile if kind == "replace" else x + profile
        value = self._values[k]
        if kind == "scale":
            return x * value
        if kind == "drift":
            return x + value * ((t - since) / 1e9)
        if kind == "noise":
            return x + value * draws[k]
        if kind == "quantise":
            return math.floor(x / value + 0.5) * value if value else x
        if kind == "saturate":
            low, high = self._limits[k]
            return min(max(x, low), high)
        if kind == "stuck":
            return stuck
        if kind == "invalid":
            return math.nan
        return x + value  # offset, spike
