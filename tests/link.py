"""A link between two network namespaces that delays, reorders and drops UDP, like netem, which some kernels lack.

``python link.py FIRST SECOND DELAY_MS JITTER_MS LOSS_PERCENT`` hands each frame that arrives at one interface on to the
other; run it in a namespace of its own, to which both interfaces belong. Prints "ready" when the link works.
"""

import heapq
import random
import select
import socket
import sys
import time
from itertools import count

IPV4, UDP = b"\x08\x00", 17
PACKET_OUTGOING = 4  # packets that this interface sends itself


def is_udp(frame):
    return frame[12:14] == IPV4 and frame[23] == UDP


def without_checksum(frame):
    """Leave the checksum out, as UDP allows: within a host the kernel computes none, and would refuse a wrong one."""
    head = 14 + 4 * (frame[14] & 0x0F)
    offset = int.from_bytes(frame[20:22]) & 0x1FFF
    return frame if offset else frame[: head + 6] + b"\0\0" + frame[head + 8 :]


def main(first, second, delay, jitter, loss):
    ends = []
    for name in (first, second):
        end = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(0x0003))
        end.bind((name, 0))
        ends.append(end)
    others = dict(zip(ends, reversed(ends), strict=True))
    draw, number = random.Random(1), count()
    waiting = []  # (time, number, interface, frame); with a jitter, later frames overtake earlier ones
    print("ready", flush=True)
    while True:
        remaining = max(0.0, waiting[0][0] - time.monotonic()) if waiting else None
        for end in select.select(ends, [], [], remaining)[0]:
            frame, (_, _, kind, *_) = end.recvfrom(65536)
            if kind == PACKET_OUTGOING:
                continue
            late = 0.0
            if is_udp(frame):
                if draw.random() < float(loss) / 100.0:
                    continue
                frame = without_checksum(frame)
                late = max(0.0, float(delay) + draw.uniform(-1.0, 1.0) * float(jitter)) / 1000.0
            heapq.heappush(waiting, (time.monotonic() + late, next(number), others[end], frame))
        while waiting and waiting[0][0] <= time.monotonic():
            _, _, end, frame = heapq.heappop(waiting)
            end.send(frame)


if __name__ == "__main__":
    main(*sys.argv[1:])
