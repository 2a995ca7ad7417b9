"""What every node does with its block: endpoints, checked answers, refusals, recording, its end.

The two ways to drive a block are its subclasses: `lockstep.Lockstep` and `realtime.Realtime`. Nothing here knows ROS:
messages, timers and clocks come from a `Middleware`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from operator import itemgetter
from pathlib import Path
from typing import Any, Literal

from ..errors import RunError, describe
from ..model.answer import check
from ..model.block import Block, Level, Plant
from ..model.port import CLOCK, Port, Sample
from ..model.schedule import Schedule
from ..model.timebase import SECOND
from ..rig.options import InputLink, Links, RunOptions
from ..wire.cdr import Layout
from ..wire.recording import ShardWriter, Sink, relative
from .buttons import Buttons
from .endpoint import Input, Output
from .health import write_status
from .middleware import Direct, Message, Middleware, Receive
from .start import other_types
from .tick import TICK, TickWriter

LOOK_EVERY = 4  # watches between two looks at the types of topics on which nothing comes
WATCH_PERIOD = SECOND // 4  # ns: progress check, status file, flush of the shard
CLOCK_LAYOUT = Layout(CLOCK.msgtype)


def repeated(number: int, sender: str, expected: int) -> str:
    """Say that an array has come that was there before."""
    return f"number {number} from {sender}, expected {expected} (already there)"


def _by_hand(block: Block, options: RunOptions) -> Links:
    """Give the links of a node that no rig tells of its peers: in lockstep who may be silent says its ticks."""
    if options.mode != "lockstep":
        return Links()
    plant = isinstance(block, Plant)
    silent = all(p.sporadic for p in block.ports(block.p)[1])
    return Links(owns_clock=plant, acknowledges=silent and not plant)


class Adapter:
    """A block as a node.

    Parameters
    ----------
    middleware : Middleware
    block : Block
    options : RunOptions
    sink : Sink, optional
        Gets what the node publishes, instead of the file that the options name.
    """

    open_ended = False  # whether being stopped is a normal end
    status_every = 1  # status files a running node writes: one in so many watch periods

    def __init__(self, middleware: Middleware, block: Block, options: RunOptions, sink: Sink | None = None) -> None:
        self.middleware = middleware
        self.block = block
        self.options = options
        self.links = Links.model_validate_json(options.links) if options.links else _by_hand(block, options)
        self.schedule = Schedule(
            block.p.period, self.links.base or None, options.duration, block.speaks_at_end()
        )  # fmt: skip
        self.is_plant = isinstance(block, Plant)
        self.namespace = middleware.full_name.rsplit("/", 1)[0]
        self.state: Literal["starting", "running", "done", "failed"] = "starting"
        self.ticks = 0
        self.t = 0
        self.values: dict[str, Any] = {}  # newest value of each input, as the block gets it
        self.epoch = 0  # ns added to a block's time for the stamp on the wire
        self.error: BaseException | None = None
        self.bad = False  # an input of this tick was refused
        self.waits_for: list[str] = []  # the senders whose silence ended the run
        self.lacking: list[str] = []  # topics of external nodes that nobody publishes yet
        self.on_finished: Callable[[], None] = lambda: None
        self._logged: set[str] = set()
        self._watches = 0
        self._said: Any = {}  # the newest answer: what is held when an input is refused
        finishes = block.finishes() and not isinstance(block, Plant)
        self._respond = self._update_or_finish if finishes else block.update
        block.ages = self.age
        inputs, outputs = block.ports(block.p)
        self.inputs = [Input(p) for p in inputs]
        self.paces: list[Input] = []  # /clock and the ticks of other nodes
        self.outputs = [Output(p, middleware.resolve(p.topic), i) for i, p in enumerate(outputs)]
        # A node that says everything at each tick, at its stamp, says a row of numbers.
        self._rows = not any(o.sporadic or o.delayed for o in self.outputs)
        self._sizes = tuple(o.port.size for o in self.outputs)
        self._bound = min((o.bound for o in self.outputs), default=0.0)
        self._numbered = [o for o in self.outputs if o.numbered]
        names = [o.name for o in self.outputs]
        self._pick = itemgetter(*names) if len(names) > 1 else lambda found: tuple(found[name] for name in names)
        self._open_record(sink)
        self.buttons = Buttons(self.values, self._record_press)
        self._publish_tick: Callable[[bytes], None] | None = None
        self._tick_bytes = TickWriter()
        self.tick_output = Output(Port("tick", "~/tick", TICK), f"{middleware.full_name}/tick", -1)
        if self.links.acknowledges:
            self._publish_tick = middleware.publisher("~/tick", TICK, self.tick_output.matched)
        for item in self.inputs:
            self._subscribe(item)
        for output in self.outputs:
            output.send, output.send_any = middleware.sender(
                output.port.topic, output.layout, output.bound, output.matched
            )
        self._send_row = middleware.together([o.send for o in self.outputs])
        middleware.timer(WATCH_PERIOD, self._watch)

    def _open_record(self, sink: Sink | None) -> None:
        """Number what is recorded: outputs, what comes from outside (by its first reader), the clock."""
        recorded = [(relative(o.topic), o.port.msgtype) for o in self.outputs]
        records = self.links.records
        outside = [
            i for i in self.inputs if (i.name not in self.links.inputs if records is None else i.name in records)
        ]  # fmt: skip
        self.foreign = {item.name: len(recorded) + k for k, item in enumerate(outside)}
        recorded += [(relative(self.middleware.resolve(i.port.topic)), i.port.msgtype) for i in outside]
        self.extra_numbers = len(recorded)
        row = {o.number: o.layout for o in self.outputs} if self._rows else {}
        if self.links.owns_clock:
            recorded.append((CLOCK.topic, CLOCK.msgtype))
            if self._rows and self.options.mode == "lockstep":
                row[self.extra_numbers] = CLOCK_LAYOUT
        self.recorded = recorded
        wanted = self.options.shard and sink is None
        self.shard = ShardWriter(Path(self.options.shard), recorded, row) if wanted else None
        self.sink = self.shard if sink is None else sink
        self._add_row = self.shard.add_row if self.shard is not None and row else None

    def _subscribe(self, item: Input) -> None:
        def matched(count: int) -> None:
            item.matched(count)
            self.on_matched(item)

        receive, direct = self.receiver(item)
        self.middleware.listen(item.port.topic, item.port.msgtype, receive, direct, matched)

    def _record_press(self, item: Input, down: bool) -> None:
        if self.sink is not None and item.name in self.foreign:
            self.sink.add(self.foreign[item.name], self.now(), item.port.layout().encode(0, (down,)))

    # what a subclass says -------------------------------------------------------------------------------------

    def receiver(self, item: Input) -> tuple[Receive, Direct | None]:
        """Give the callback for the raw messages of an input, and the one for messages without bytes if it has one."""
        raise NotImplementedError

    def on_matched(self, item: Input) -> None:
        """React to a change of the writers of an input."""

    def now(self) -> int:
        """Time in ns under which what comes from outside is recorded."""
        raise NotImplementedError

    def age(self, name: str) -> int | None:
        """Answer `Block.age`."""
        raise NotImplementedError

    def progress(self) -> None:
        """Check for stalls and missing peers; called every `WATCH_PERIOD`."""

    def busy(self) -> bool:
        """Whether peers that wait for this node are to be patient."""
        return False

    def statistics(self) -> dict[str, Any]:
        """Figures of the run for the status file."""
        return {}

    # ticks ----------------------------------------------------------------------------------------------------

    def peer(self, link: InputLink) -> Schedule:
        """Give the schedule of a peer."""
        return Schedule(link.period, self.schedule.clock, self.options.duration, link.at_end)

    def answer(self, t: int) -> Any:
        """Give what a block that is not a plant sends at `t`; it does not see a tick of which something was refused."""
        if not self.bad:
            self._said = found = self._respond(t, **self.values)
            return found
        self.bad = False
        own = self.block.refused(t)
        return self.held(t) if own is None else own

    def held(self, t: int) -> Any:
        """Give what was said last, at first the safe values; silence on sporadic ports."""
        return {
            o.name: self._said.get(o.name) or (Sample(t, o.port.safe) if o.delayed else o.port.safe)
            for o in self.outputs if not o.sporadic
        }  # fmt: skip

    def _update_or_finish(self, t: int, **inputs: Any) -> Any:
        last = self.schedule.last
        return (self.block.update if last is None or t < last else self.block.finish)(t, **inputs)

    def publish(self, t: int, stamp: int, found: Mapping[str, Any]) -> None:
        """Check, publish and record a block's answer of tick `t`, and acknowledge the tick.

        All messages go out in one burst: a reader that wakes for the first finds the others already there, and
        recording takes place while it works. (Each wake-up between two messages costs as much as the law.)
        """
        if not self.outputs and self._publish_tick is None and self._add_row is None:
            return  # an observer
        numbers = self._numbers(found)
        if numbers is None:
            self._publish_each(t, stamp, found)
            return
        rows, flat = numbers
        if self._numbered:
            for output, values in zip(self.outputs, rows, strict=True):
                output.send((output.said if output.numbered else stamp, values))
        else:
            self._send_row((stamp, rows))
        if self._publish_tick is not None:
            self._publish_tick(self._tick_bytes(stamp, ()))
        if self._add_row is not None:
            self._add_row(stamp, flat)
        elif self.sink is not None:
            for output, values in zip(self.outputs, rows, strict=True):
                mark = output.said if output.numbered else stamp
                self.sink.add(output.number, stamp, output.layout.encode(mark, values))
        for output in self._numbered:
            output.said += 1

    def _numbers(self, found: Mapping[str, Any]) -> tuple[tuple[tuple[float, ...], ...], tuple[float, ...]] | None:
        """Give the values of all outputs, and all in one tuple; None when each has to be looked at."""
        if not self._rows:
            return None
        try:
            rows = self._pick(found)
            flat: tuple[float, ...] = sum(rows, ())
            if tuple(map(len, rows)) != self._sizes or not sum(map(abs, flat)) <= self._bound:  # NaN, infinity, large
                return None
        except (KeyError, TypeError, ValueError, OverflowError):  # told by `check`
            return None
        return rows, flat

    def _publish_each(self, t: int, stamp: int, found: Mapping[str, Any]) -> None:
        """Do the same for an answer that leaves ports out, has its own stamps, or is no plain row of usual numbers."""
        burst: list[tuple[Output, Message]] = []
        for output in self.outputs:
            value = check(found, output.port, self.middleware.name, t)
            if value is None:
                continue
            mark, values = (value.stamp + self.epoch, value.data) if isinstance(value, Sample) else (stamp, value)
            burst.append((output, (output.said if output.numbered else mark, values)))
        for output, message in burst:
            send = output.send if sum(map(abs, message[1])) <= output.bound else output.send_any
            send(message)
        if self._publish_tick is not None:
            sent = [output.name for output, _ in burst if output.sporadic]
            self._publish_tick(self._tick_bytes(stamp, sent))
        if self._add_row is not None:
            self._add_row(stamp, [x for _, (_, values) in burst for x in values])
        elif self.sink is not None:
            for output, message in burst:
                self.sink.add(output.number, stamp, output.layout.encode(*message))
        for output, _ in burst:
            output.said += 1

    # health ----------------------------------------------------------------------------------------------------

    def refuse(self, item: Input, reason: str) -> None:
        """Count a bad message and log it once; it never reaches the block."""
        item.refused += 1
        if item.last_refusal != reason:
            item.last_refusal = reason
            kind = reason.split()[0]  # not the whole: a wrong stamp is another each time
            self.log_once(f"{item.port.topic}: {kind}", Level.ERROR, f"refused on {item.port.topic}: {reason}")

    def in_order(self, item: Input, number: int) -> bool:
        """Whether an array is new to an input that takes the newest; refuses one that is repeated, counts lost ones.

        Number 0 may begin anew: a bag that is played in a loop.

        Parameters
        ----------
        item : Input
        number : int
            What the array says of itself; -1 when it says nothing: then it is new.
        """
        expected = item.following
        if number < 0 or expected is None:
            pass
        elif number < expected and (number or expected == 1):
            self.refuse(item, repeated(number, self.sender(item), expected))
            return False
        elif number > expected:
            item.lost += number - expected
            text = f"{item.lost} messages of {self.sender(item)} are lost"
            self.block.report(Level.WARN, f"lost {item.port.topic}", text)
        item.following = None if number < 0 else number + 1
        return True

    def sender(self, item: Input) -> str:
        """Name who publishes what an input reads, as far as the rig says."""
        link = self.links.inputs.get(item.name)
        return link.node if link else "another node"

    def log_once(self, key: str, level: Level, text: str) -> None:
        """Log a text the first time its key appears."""
        if key not in self._logged:
            self._logged.add(key)
            self.middleware.log(level, text)

    def fail(self, text: str) -> None:
        """End the run with an error."""
        if self.error is None:
            self.error = RunError(text)
        self.finish("failed")

    def broke(self, error: ArithmeticError | RunError) -> None:
        """End the run because its numbers have left their range: one line, the place in it, no stack trace."""
        known = isinstance(error, RunError)
        self.fail(str(error) if known else f"failed at t = {self.t / SECOND:.9g} s: {describe(error)}")

    def finish(self, state: Literal["done", "failed"] = "done") -> None:
        """Stop."""
        self.state = state
        self.on_finished()

    def _notice_types(self) -> None:
        """Name a topic that somebody publishes with another type: nothing of it ever arrives."""
        for item in self.inputs:
            key = f"type of {item.port.topic}"
            if item.publishers or item.heard or key in self.block.reports:
                continue
            other = other_types(self.middleware, item.port)
            if other:
                text = f"{item.port.topic} exists with type {other}, expected {item.port.msgtype}"
                self.block.report(Level.ERROR, key, text)
                self.log_once(key, Level.ERROR, text)

    def _watch(self) -> None:
        if self.shard is not None:
            self.shard.flush()
        for key, (level, text, _) in self.block.reports.items():
            self.log_once(key, level, text)
        self.progress()
        if self._watches % LOOK_EVERY == 0:
            self._notice_types()
        self._watches += 1
        if self._watches % self.status_every == 0 or self.state != "running":
            write_status(self)
