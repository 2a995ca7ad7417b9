"""Time of the simulated line and of a location. A tool, not a node: ``softrig node softrig_power fault_bench``."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

from .location import Locator, LocatorParams
from .parameters import RATES, RigParams
from .simulation import FaultedLine
from .study import simulate

ROUNDS = 5


def spent(call: Callable[[], object], rounds: int = ROUNDS) -> float:
    """Give the least CPU time of a call in s, after one that compiles."""
    call()
    times = []
    for _ in range(rounds):
        begin = time.process_time()
        call()
        times.append(time.process_time() - begin)
    return min(times)


def print_table() -> None:
    """Print CPU times of the line, sampled at several rates, and of each algorithm."""
    p = RigParams()
    for profile in ("m20k", "raw1m"):
        rig = p.model_copy(update={"measurement": p.measurement.model_copy(update={"profile": profile})})
        line = FaultedLine(rig)
        steps = (rig.samples - 1) * rig.decimation
        seconds = spent(lambda line=line, n=rig.samples: line.run(n))  # type: ignore[misc]
        print(f"line, {steps} steps of 1 us, {RATES[profile]:>7} samples/s  {seconds:7.4f} s  "
              f"{1e6 * seconds / steps:5.2f} us a step")  # fmt: skip
    record = simulate(p)
    for algorithm in ("brent", "woa", "gwo", "integer_grid", "phasor"):
        settings = LocatorParams(algorithm=algorithm)  # type: ignore[arg-type]
        rounds = 1 if algorithm in ("woa", "gwo") else ROUNDS
        seconds = spent(lambda s=settings: Locator(record, s).locate(), rounds)  # type: ignore[misc]
        print(f"location by {algorithm:<14} {1e3 * seconds:10.2f} ms")


def main() -> int:
    """Print the table."""
    print_table()
    return 0


if __name__ == "__main__":
    sys.exit(main())
