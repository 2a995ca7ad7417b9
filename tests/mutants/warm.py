"""Runs pytest in forks of a process that has imported all foreign modules: one line of JSON for each request and
answer.
"""

import json
import os
import signal
import sys
import time
from importlib import import_module

FOREIGN = ("pytest", "hypothesis", "numpy", "scipy.optimize", "scipy.signal", "numba", "pydantic", "yaml", "casadi",
           "pinocchio", "matplotlib.figure", "rosbags.rosbag2", "mcap.writer", "control", "rclpy.node")  # fmt: skip


def ended(child: int, limit: float) -> int | None:
    """Wait for a child; return its exit status, None if it was killed after `limit` s."""
    end = time.monotonic() + limit
    while time.monotonic() < end:
        ended_pid, status = os.waitpid(child, os.WNOHANG)
        if ended_pid:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.02)
    os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return None


def main() -> None:
    """Serve until the input is closed."""
    for name in FOREIGN:
        import_module(name)
    assert not any(name.startswith("softrig") for name in sys.modules)
    for line in sys.stdin:
        arguments, limit = json.loads(line)
        child = os.fork()
        if not child:
            os.setsid()
            null = os.open(os.devnull, os.O_RDWR)
            for number in range(3):
                os.dup2(null, number)
            os._exit(int(sys.modules["pytest"].main(["-q", "-p", "no:cacheprovider", *arguments])))
        print(json.dumps(ended(child, limit)), flush=True)


if __name__ == "__main__":
    main()
