"""A PLC in memory: it executes the printed program, a cycle at each look at it; its network loses and tears copies."""

import struct

from softrig_core.export.st_run import Program, Struct
from softrig_core.firmware.ads_files import link_units

KINDS = {"UDINT": "I", "BOOL": "?", "LINT": "q", "LREAL": "d"}


class _Link(Program):
    """The link program, which contains the function block of another text."""

    def __init__(self, text, block):
        self.inner = block
        super().__init__(text.replace("PROGRAM ", "FUNCTION_BLOCK ").replace("END_PROGRAM", "END_FUNCTION_BLOCK"))

    def new(self, kind):
        if not kind.strip().startswith("FB_"):
            return super().new(kind)
        inner = self.inner
        called = type("Called", (Struct,), {"__call__": lambda me: inner.call(me)})
        return called(**vars(inner.block()))


class Plc:
    """The part of a PLC that `AdsLine` uses.

    Parameters
    ----------
    units : list of Unit
        Of the node in structured text; none: `work` computes.
    work : callable
        Takes request, answer and an own dict.
    """

    def __init__(self, member, units=(), work=None):
        self.link = link_units(member, units[-1] if units else None)
        request, answer, _ = self.link
        self.formats = [struct.Struct("<" + "".join(KINDS[kind] for _, kind in u.fields)) for u in (request, answer)]
        self.names = [[name for name, _ in u.fields] for u in (request, answer)]
        block = Program("\n".join(u.text() for u in units)) if units else None
        text = "\n".join(u.text() for u in self.link)
        if work is not None:
            begin, end = (text.index(word) for word in ("        (* Your code", "        answer.again :="))
            text = text[:begin] + "        answer.gave_up := work(request, answer);\n" + text[end:]
        self.program = _Link(text, block)
        if work is not None:
            self.program.scope["work"] = work
        self.power()

    def power(self):
        self.me = self.program.block()

    @property
    def digest(self):
        return self.me.build

    def take(self, data):
        """Copy bytes into the request."""
        vars(self.me.request).update(zip(self.names[0], self.formats[0].unpack(data), strict=True))

    def request(self):
        return self.formats[0].pack(*(getattr(self.me.request, n) for n in self.names[0]))

    def cycle(self):
        self.program.call(self.me)
        return self.formats[1].pack(*(getattr(self.me.answer, n) for n in self.names[1]))


class Net:
    """The network to a PLC, with its own time; calls are lost, time out and copy half."""

    def __init__(self, plc, rng, rate=0.0, pulled=0.0):
        self.plc, self.rng, self.rate, self.pulled = plc, rng, rate, pulled
        self.time, self.back, self.old = 0.0, 0.0, b""
        self.happened = dict.fromkeys(["lost", "torn", "stale", "unplugged"], 0)

    def now(self):
        return self.time

    def sleep(self, seconds):
        self.time += max(seconds, 1e-6)

    def opened(self, wait):
        if self.time < self.back:
            self.time += min(wait, 0.01)
            raise OSError("no route to host")
        return self

    def wait(self, seconds):
        self.longest = max(seconds, 0.001)

    def build(self):
        self._passes()
        return self.plc.digest

    def write(self, data):
        what = self._passes()
        if what == "lost":
            return
        at = self.rng.randrange(len(data)) if what == "torn" else len(data)
        # A torn copy has new bytes first, as they are copied in order.
        self.plc.take(data[:at] + self.plc.request()[at:])
        if self.rng.random() < 0.5:
            self.plc.cycle()

    def read(self, size):
        what = self._passes()
        new = self.plc.cycle()
        assert len(new) == size
        at = {"torn": self.rng.randrange(size), "stale": 0}.get(what, size)
        result, self.old = new[:at] + (self.old or new)[at:], new
        return result

    def close(self):
        pass

    def _passes(self):
        self.time += 2e-4
        if self.rng.random() < self.pulled:
            self.happened["unplugged"] += 1
            self.time += min(self.longest, 0.001)
            self.back = self.time + self.rng.random() / 4
            raise OSError("timeout elapsed")
        if self.rng.random() >= self.rate:
            return ""
        what = self.rng.choice(["lost", "torn", "stale"])
        self.happened[what] += 1
        return what
