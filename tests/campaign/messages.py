"""Message bytes of any kind into the codecs: values or `Refused`, nothing else."""

import math
import random
from pathlib import Path

from softrig_core import (
    Port,
    Refused,
    array,
    button,
    command,
    joint_state,
    number,
    pose,
    reference,
    scalars,
    vector3,
    wrench,
)
from softrig_core.block.codec import Decoder

from bags import damaged

PORTS = (
    command("a", "t", ["u", "v"], "V"),
    joint_state("a", "t", ["x"], position="m", velocity="m/s"),
    scalars("a", "t", {"voltage": "V", "current": "A"}),
    reference("a", "t", ["x"], position="m", velocity="m/s"),
    vector3("a", "t", "abc", "V"),
    wrench("a", "t"),
    pose("a", "t", "base"),
    array("a", "t", {"rows": 2, "columns": 3}, "m"),
    number("a", "t", "m"),
    button("a", "t"),
    Port("stamp", "t", "rosgraph_msgs/msg/Clock"),
)


def attack(seed: int, directory: Path) -> None:
    """Decode 100 damaged messages of each kind, with a good one in between."""
    chance = random.Random(seed)
    # Unbuffered, and opened once: closing it each time would wait for the disk.
    with (directory / "message").open("wb", buffering=0) as kept:
        for port in PORTS:
            layout, decode = port.layout(), Decoder(port)
            good = [
                chance.choice((0.0, 1.0)) if port.msgtype.endswith("Bool") else chance.gauss(0, 1e3)
                for _ in range(layout.size)
            ]
            seconds = chance.randrange(2**31)
            data = layout.encode(seconds if layout.numbered else seconds * 10**9, good)
            for _ in range(100):
                kept.seek(0)
                kept.truncate()
                kept.write(bad := damaged(data, chance))
                try:
                    _, values = decode(bad)
                except Refused:
                    continue
                assert len(values) == port.size
                assert all(map(math.isfinite, values)), values
                assert decode(data)[1] == tuple(good)
