"""The common start of a rig in real time: t = 0 is set when all its nodes are up and matched, outside ones included.

Each node repeatedly publishes that it is ready (`READY`, a Header with its name). One node is the starter. When it is
ready itself and has received the message of every other node, it sets the time of t = 0. It publishes this time
together with that of its own clock (`START`, a Header), and repeats it for each node that still publishes `READY` or
has been started again. A node whose clock differs by more than `CLOCKS` (because the host's clock was set in between,
for example) uses the starter's. If a person has stopped the clock of the rig, the message also contains the time at
which it stands (`node.realtime.stand`).

`READY` may be lost, since it is repeated. `START` is published only when the starter's writer is matched with all
nodes, because a run may be over before a node asks again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence, Set

from softrig_core.block.port import Port, Refused
from softrig_core.block.schedule import Schedule
from softrig_core.timebase import SECOND

from ..seam.endpoint import Input
from ..seam.middleware import Reader
from ..seam.tick import TICK, TickReader, TickWriter
from .adapter import Adapter
from .handshake import CHECK, Handshake

READY, START = "softrig/ready", "softrig/start"
LEAD = SECOND // 2  # ns from the first message with the start time to t = 0, in which it has to reach every node
CLOCKS = SECOND // 2  # ns from which on two clocks are taken for different
REPEAT = 5  # checks from one message that a node is ready to the next; it is repeated because it may be lost


class Departure(Reader):
    """Waits for the common start of one node.

    Parameters
    ----------
    local : set of str
        Other nodes of this process.
    begin : callable
        Called once with the wall-clock time of t = 0 and with the lead of the rig's clock over ours, ns.
    received : callable
        Called with the words of the node that stops or resumes the clock of the rig.
    """

    def __init__(
        self,
        node: Adapter,
        handshake: Handshake,
        local: Set[str],
        begin: Callable[[int, int], object],
        received: Callable[[Iterable[str]], object],
    ) -> None:
        self._node = node
        self._begin = begin
        self._on_words = received
        self._words: Sequence[str] = ()
        self.handshake = handshake
        self.absent: list[str] = []  # descriptions of missing peers
        self.neighbours: list[Departure] = []  # departures of the other nodes of this process
        self.is_starter = node.links.starter == node.middleware.name
        self._silent = set(node.links.starts) - {node.middleware.name}
        self._others = len(self._silent - local)  # nodes of other processes
        self._unheard = self._others  # nodes that are not matched with the starter yet
        self._epoch = 0
        self._checks = 0
        self._header, self._read = TickWriter(), TickReader()
        self._since = node.middleware.steady()
        middleware = node.middleware
        topic = START if not self.is_starter else READY
        self._input = Input(Port("stamp", topic, TICK))
        node.paces.append(self._input)
        self._send = middleware.publisher(READY if not self.is_starter else START, TICK, self._matched)
        middleware.subscribe(topic, TICK, self)
        self._timer = middleware.timer(CHECK, self._check)

    def _matched(self, count: int) -> None:
        self._unheard = self._others - count

    def _publish(self, data: bytes) -> None:
        self._send(data)
        for neighbour in self.neighbours:
            if neighbour.is_starter is not self.is_starter:
                # Nodes of one process are not connected by the middleware here, and a call from within would run one
                # node inside another.
                self._node.middleware.post(lambda neighbour=neighbour: neighbour.receive(data))  # type: ignore[misc]

    def receive(self, data: bytes) -> None:
        """Receive a message of the starter, or on the starter a message of another node."""
        try:
            epoch, words = self._read(data)
        except Refused as error:
            self._node.account.refuse(self._input, str(error))
            return
        if self.is_starter:
            self._silent -= words
            # A node that still reports that it is ready has missed the start time, or was started again.
            if self._epoch:
                self._announce_start()
        elif epoch > 0:
            self._follow(epoch, words)

    def _follow(self, epoch: int, words: Set[str]) -> None:
        """Begin at the time that the starter has set."""
        if not self._epoch:
            self._timer.cancel()
            self._epoch = epoch
            clock = next((int(word) for word in words if word.isdigit()), 0)
            ahead = clock - self._node.middleware.now() if clock else 0
            # A smaller difference is the transit time of the message, and does not change the own clock.
            self._begin(epoch, ahead if abs(ahead) > CLOCKS else 0)
        self._on_words(words)

    def announce(self, words: Sequence[str]) -> None:
        """Publish to all nodes, also to later ones, that the clock of the rig is paused or released."""
        self._words = words
        self._announce_start()

    def _announce_start(self) -> None:
        self._publish(TickWriter()(self._epoch, [str(self._node.middleware.now()), *self._words]))

    def _deaf(self) -> str:
        """Name the nodes that do not subscribe to the start message, as far as the graph shows it."""
        middleware = self._node.middleware
        readers = {middleware.name, *(peer.name for peer in middleware.subscribers(middleware.resolve(START)))}
        return ", ".join(n for n in self._node.links.starts if n not in readers) or f"one of {len(readers)} nodes"

    def _check(self) -> None:
        self.absent = self.handshake.absent()
        self._checks += 1
        if self.is_starter:
            self.absent += [f"{name} is not ready" for name in sorted(self._silent)]
            if self._unheard > 0:
                self.absent.append(f"{self._deaf()} has not subscribed to {START} yet")
            if not self.absent:
                self._timer.cancel()
                grid = Schedule(self._node.links.grid)
                # `held` rounds down to the grid; one period more keeps the lead.
                self._epoch = grid.held(self._node.middleware.now() + LEAD + grid.time(1))
                self._announce_start()
                self._begin(self._epoch, 0)
        elif not self.absent and self._checks % REPEAT == 0:
            self._publish(self._header(0, [self._node.middleware.name]))
        limit = self._node.options.start_timeout
        if limit and not self._epoch and self._node.middleware.steady() - self._since > limit:
            waits = "; ".join(self.absent) or f"{self._node.links.starter} has not published the start time"
            self._timer.cancel()
            self._node.fail(f"not all peers after {limit:g} s: {waits}")
