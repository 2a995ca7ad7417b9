"""A node on a CAN bus in memory, as the page *A board in a rig* describes it, and a bus that loses frames."""

import heapq

import cantools
from softrig_core.board.dbc import printed

can = __import__("can")  # tests that use this module are skipped without python-can


class Node:
    """Answers requests; `step` returns the signals of an answer from those of a request and the state."""

    def __init__(self, file, name, step, first):
        self.db, self.name, self.step, self.first = cantools.database.load_file(file), name, step, first
        names = [m.name for m in self.db.messages]
        self.want = sum(n.startswith(f"{name}_to_") and n != f"{name}_to_0" for n in names)
        self.answers = [m for m in self.db.messages if m.name.startswith(f"{name}_from_") and m.name[-2:] != "_0"]
        self.ready = next((m for m in self.db.messages if m.name == f"{name}_from_0"), None)
        self.build = None if self.ready is None else int(self.ready.get_signal_by_name("build").minimum)
        self.power()

    def power(self):
        """Begin without a run."""
        self.run = self.last = None
        self.parts, self.answer = {}, []

    def feed(self, frame):
        """Return the frames with which the node answers a frame."""
        message = next((m for m in self.db.messages if m.frame_id == frame.arbitration_id), None)
        if message is None or len(frame.data) != message.length or frame.is_remote_frame or frame.is_error_frame:
            return []
        read = message.decode(bytes(frame.data))
        run, tick = read.pop("run"), read.pop("tick", None)
        if message.name == f"{self.name}_to_0":
            if run != self.run:
                self.run, self.last, self.state, self.parts = run, None, self.first(), {}
            return [framed(self.ready, {"run": run, "build": self.build})]
        if run != self.run:
            return []
        self.parts.setdefault(tick, {})[message.name] = read
        if len(self.parts[tick]) < self.want:
            return []
        signal_values = {k: v for part in self.parts.pop(tick).values() for k, v in part.items()}
        if tick != self.last:
            if self.last is not None and (tick - self.last) % 65536 > 32767:
                return []  # the frame is older than the last one
            self.state, signals = self.step(self.state, tick, signal_values)
            self.last, self.parts = tick, {}
            self.answer = [framed(m, {"run": run, "tick": tick} | signals) for m in self.answers]
        return self.answer


def framed(message, values):
    data = message.encode({s.name: values.get(s.name, 0) for s in message.signals}, strict=False)
    return can.Message(arbitration_id=message.frame_id, is_extended_id=False, data=data)


class Bus:
    """The part of python-can that `CanLine` uses, in memory with its own time; frames arrive late, twice or not
    at all.
    """

    def __init__(self, rng, rate, *nodes, pulled=0.0):
        self.rng, self.rate, self.nodes, self.pulled = rng, rate, nodes, pulled
        self.time, self.back, self.coming, self.count = 0.0, 0.0, [], 0
        self.happened = dict.fromkeys(["lost", "doubled", "delayed", "cut", "remote", "error", "other"], 0)
        self.unplugged = 0

    def opened(self):
        if self.time < self.back:
            raise OSError("no such device")
        return self

    def now(self):
        return self.time

    def sleep(self, seconds):
        self.time += seconds

    def set_filters(self, filters):
        self.passed = {f["can_id"] for f in filters}

    def shutdown(self):
        pass

    def send(self, frame, timeout=None):
        if self.rng.random() < self.pulled:
            self.unplugged += 1
            self.back = self.time + self.rng.random() / 8
            raise can.CanOperationError("no buffer space")
        self.time += 1e-4
        for at, received in self._damaged(frame):
            for node in self.nodes:
                for answer in node.feed(received):
                    for later, one in self._damaged(answer):
                        self.count += 1
                        heapq.heappush(self.coming, (self.time + at + later, self.count, one))

    def recv(self, wait):
        if self.time < self.back:
            raise can.CanOperationError("network is down")
        end = self.time + wait
        while self.coming and self.coming[0][0] <= end:
            at, _, frame = heapq.heappop(self.coming)
            self.time = max(self.time, at)
            if frame.arbitration_id in self.passed:
                return frame
        self.time = max(self.time, end) + (0.0 if wait else 1e-6)
        return None

    def _damaged(self, frame):
        if self.rng.random() >= self.rate:
            return [(0.0, frame)]
        what = self.rng.choice(list(self.happened))
        self.happened[what] += 1
        if what == "lost":  # so is a frame with a flipped bit: the bus discards it by its CRC
            return []
        if what == "doubled":
            return [(0.0, frame), (self.rng.choice([0.0, 0.3]), frame)]
        if what == "delayed":
            return [(self.rng.choice([0.002, 0.03, 0.3, 3.0]), frame)]
        return [(0.0, broken(frame, what, self.rng))]


def broken(frame, what, rng):
    """Return a frame that must not count."""
    more = {"is_remote_frame": what == "remote", "is_error_frame": what == "error"}
    data = b"" if what == "remote" else frame.data[: rng.randrange(8)] if what == "cut" else rng.randbytes(8)
    number = 0x7F0 if what == "other" else frame.arbitration_id
    return can.Message(arbitration_id=number, is_extended_id=False, data=data, **more)


def file_of(folder, ports, build="0badcafe", node="n"):
    """Write the DBC of a node with these ports."""
    file = folder / f"{node}.dbc"
    file.write_text(printed(node, *ports, 0x100, build))
    return file
