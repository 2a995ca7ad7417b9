"""A board in memory: the exported firmware as a library of this process, and a wire that damages frames."""

import ctypes
import heapq
import subprocess

from softrig_core.export.check import FLAGS

# Scenarios that need an AVR compiler and simavr, and whose board cannot rewind.
UNO = ("dc_motor_smc_uno", "dc_motor_smc_uno_pid", "dc_motor_smc_uno_soft")
HARNESS = """
#include "{n}_link.h"
#include <stddef.h>
static {n}_link board;
static uint8_t out[1 << 16];
static int used;
static void put(uint8_t byte) {{ out[used++] = byte; }}
void power(void) {{ {n}_link_init(&board, put, NULL); used = 0; }}
int feed(const uint8_t *in, int n, uint8_t *to)
{{
    int found;
    used = 0;
    for (int i = 0; i < n; i++) {{ {n}_link_take(&board, in[i]); }}
    for (found = 0; found < used; found++) {{ to[found] = out[found]; }}
    return used;
}}
"""


def library(folder, name):
    """Compile the firmware of a folder into a library; each copy that `Board` loads is a board of its own."""
    (folder / "harness.c").write_text(HARNESS.format(n=name))
    command = ["cc", *FLAGS, "-fPIC", "-shared", "-o", "board.so", "harness.c", f"{name}.c", f"{name}_link.c", "-lm"]
    subprocess.run(command, cwd=folder, check=True, capture_output=True)
    return folder / "board.so"


class Board:
    """Firmware in this process."""

    copies = 0

    def __init__(self, path, folder):
        Board.copies += 1
        copy = folder / f"board{Board.copies}.so"
        copy.write_bytes(path.read_bytes())
        self._library = ctypes.CDLL(str(copy))
        self._out = (ctypes.c_uint8 * (1 << 16))()
        self.power()

    def power(self):
        self._library.power()

    def feed(self, data):
        n = self._library.feed(bytes(data), len(data), self._out)
        return bytes(self._out[:n])


class QuietWire:
    """Bytes that arrive complete and without delay; time does not pass."""

    def __init__(self, *boards):
        self.boards, self.waiting, self.time = boards, b"", 0.0

    def now(self):
        return self.time

    def opened(self):
        return self

    def sleep(self, seconds):
        self.time += seconds

    def write(self, data):
        for board in self.boards:
            self.waiting += board.feed(data)

    def read(self, wait):
        if not self.waiting:
            self.time += max(wait, 1e-3)
        data, self.waiting = self.waiting, b""
        return data

    def close(self):
        pass


class NoisyWire(QuietWire):
    """A wire on which frames are cut, flipped, doubled, delayed, lost, or get zeros, and that is unplugged at times.

    Parameters
    ----------
    rng : random.Random
    rate : float
        Part of the frames, each way, to which something happens.
    pulled : float
        Part of the writes at which the wire is pulled out for a while; the boards keep their power.
    """

    def __init__(self, rng, rate, *boards, pulled=0.0):
        super().__init__(*boards)
        self.rng, self.rate, self.pulled = rng, rate, pulled
        self.queue, self.order, self.absent_until = [], 0, -1.0
        self.happened = dict.fromkeys(("cut", "flipped", "doubled", "delayed", "lost", "zero", "noise", "pulled"), 0)

    def opened(self):
        """Open it again."""
        if self.time < self.absent_until:
            raise OSError(2, "no such port")
        return self

    def _send(self, data, what):
        for copy, delay in self._damaged(data):
            self.order += 1
            heapq.heappush(self.queue, (self.time + delay, self.order, what, copy))

    def _damaged(self, data):
        if self.rng.random() >= self.rate:
            return [(data, 1e-3)]
        what = self.rng.choice(["cut", "flipped", "doubled", "delayed", "lost", "zero", "noise"])
        self.happened[what] += 1
        at = self.rng.randrange(len(data))
        if what == "cut":
            return [(data[:at], 1e-3)]
        if what == "flipped":
            return [(data[:at] + bytes([data[at] ^ (1 << self.rng.randrange(8))]) + data[at + 1 :], 1e-3)]
        if what == "doubled":
            return [(data, 1e-3), (data, self.rng.random() * 2.0)]
        if what == "delayed":
            return [(data, self.rng.random() * 2.0)]
        if what == "zero":
            return [(data[:at] + b"\0" + data[at:], 1e-3)]
        if what == "noise":
            return [(self.rng.randbytes(at + 1) + data, 1e-3)]
        return []

    def write(self, data):
        self._there()
        if self.rng.random() < self.pulled:
            self.happened["pulled"] += 1
            self.absent_until = self.time + self.rng.random() * 2.0
        self._there()
        self._send(data, "to board")

    def read(self, wait):
        self._there()
        end = self.time + max(wait, 0.0)
        while not self.waiting and self.queue and self.queue[0][0] <= end:
            at, _, what, data = heapq.heappop(self.queue)
            self.time = max(self.time, at)
            if what == "to board":
                for board in self.boards:
                    if answer := board.feed(data):
                        for frame in answer.split(b"\0")[:-1]:
                            self._send(frame + b"\0", "from board")
            else:
                self.waiting += data
        if not self.waiting:
            self.time = max(end, self.time + 1e-3)
        data, self.waiting = self.waiting, b""
        return data

    def _there(self):
        if self.time < self.absent_until:
            raise OSError(5, "the board was pulled out")
