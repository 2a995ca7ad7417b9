"""All times, sizes and counts that nodes and runs use, in one table; the meaning of each is documented at its
definition.

An intended change of a value is made here, too, where the values that depend on it are in view.
"""

import signal
from importlib import import_module

import pytest

MS, SECOND = 1_000_000, 1_000_000_000

LIMITS = {
    # intervals at which nodes check something, ns
    "softrig_nodes.adapter.account": {"WATCH_PERIOD": 250 * MS, "CHECK_EVERY": 4},
    "softrig_nodes.adapter.handshake": {"CHECK": 20 * MS, "SETTLED": 25},
    "softrig_nodes.adapter.departure": {"LEAD": 500 * MS, "CLOCKS": 500 * MS, "REPEAT": 5},
    "softrig_nodes.face.frames": {"PERIOD": 33_333_333},
    "softrig_nodes.face.simulation": {"LOOK": 5 * MS, "APART": 1e-6},
    "softrig_nodes.ros.ros": {"LOOK": 20 * MS, "SEARCH": 250 * MS, "PATIENCE": 2.0, "LAST": 10.0},
    "softrig_nodes.ros.requests.Credit": {"SHARE": 0.2, "MOST": 2.0},
    "softrig_nodes.ros.requests": {"MOST": 100, "IDLE": 20 * MS, "BUSY": 2 * MS, "PATIENCE": 2.0, "UNKNOWN": 2.0},
    # a run in lockstep: ticks, messages, and s without progress
    "softrig_nodes.lockstep.comeback": {"SAID": 2},
    "softrig_nodes.lockstep.lockstep": {"FEW": 2, "REPORT_AFTER": 250},
    "softrig_nodes.lockstep.lockstep.Lockstep": {"status_every": 1},
    "softrig_nodes.lockstep.paired": {"AHEAD": 100_000},
    "softrig_nodes.lockstep.stalls": {"GONE_AFTER": 0.5, "GOODBYE": 2.0, "REPORT_AFTER": 1.5},
    "softrig_nodes.seam.tick": {"LAG": 4},
    "softrig_nodes.seam.hold": {"LOOK": 10 * MS},
    "softrig_nodes.seam.solving": {"LOOK": 2 * MS, "REPORT_EVERY": 0.5},
    "softrig_core.run.session": {"KEPT": 256},
    # a run in real time, in ns, except AGAIN
    "softrig_nodes.realtime.beat": {"BEHIND": 50 * MS},
    "softrig_core.block.gathering": {"STRETCH": 10 * MS},
    "softrig_nodes.realtime.live": {"KEPT": 64, "GONE": SECOND},
    "softrig_nodes.realtime.realtime": {"AGAIN": 10.0, "SOON": MS, "CATCH_UP": SECOND, "END_GRACE": SECOND},
    "softrig_nodes.realtime.realtime.Realtime": {"status_every": 4},
    "softrig_nodes.realtime.stand": {"LEAD": 50 * MS, "NEVER": 2**63 - 1},
    # nodes of one process, in ns, except GRACE and the counts of calls and messages
    "softrig_nodes.container": {"LOOK": 100 * MS, "SPIN": 300_000, "GRACE": 1.0},
    "softrig_nodes.lockstep.turns": {"SLICE": 5 * MS},
    "softrig_nodes.seam.exchange": {"BATCH": 16, "BURST": 8, "SLACK": 150_000, "SLICE": 5 * MS},
    "softrig_nodes.seam.monitor": {"LONG": 5 * MS, "SHORT_ONES": 20},
    "softrig_nodes.ros.garbage": {"CLEAN": 100, "UNCLEAN": 10},
    "softrig_nodes.ros.processor": {"SHORT": 200_000, "ENOUGH": 100, "LONG": 200 * MS},
    # s until a process has ended, and until a request from outside fails
    "softrig_nodes.below.leave": {"PATIENCE": 2},
    "softrig_nodes.ros.remote": {"PATIENCE": 10.0},
    "softrig_nodes.processes.supervision": {"GRACE": 1.5},
    "softrig_nodes.processes.children": {
        "STOP_STEPS": ((signal.SIGINT, 3.0), (signal.SIGTERM, 3.0), (signal.SIGKILL, 3.0)),
    },
    # numbers of domains and DDS ports, and s
    "softrig_nodes.processes.domain": {
        "DOMAINS": range(1, 101),
        "BEYOND": (*range(215, 232), *range(101, 215)),
        "HIGHEST": 232,
    },
    "softrig_nodes.processes.executables": {"MARGIN": 2},
    "softrig_nodes.processes.ports": {
        "BASE": 7400,
        "GAIN": 250,
        "WELL_KNOWN": {"offsetd0": 0, "offsetd1": 10, "offsetd2": 1},
        "STANDARD": 11,
        "HIGHEST": 65_535,
        "USER": range(76, 188),
        "UNIQUE": 400,
        "FLOWS": range(6200, 7000),
        "AROUND": 18.0,
        "AT_ONCE": 50,
    },
    "softrig_nodes.processes.shared_memory": {
        "AGE": 2.0,
        "ABANDONED": 60.0,
        "LOOKS": 100,
        "SIZE": 1_250_000,
        "RECENT": 1e9,
        "MADE": b"\2\0\0\0",
    },
    "softrig_nodes.processes.shared_memory.Ears": {"PATIENCE": 10.0},
    "softrig_nodes.processes.fork_server": {"LARGEST": 100_000, "ROOM": 8_000},
    # constants of <sys/prctl.h>, <net/if.h>, <fcntl.h>, rcl/types.h and rcl_interfaces
    "softrig_nodes.processes.fork_server ": {"PR_SET_PDEATHSIG": 1, "PR_SET_NAME": 15},
    "softrig_nodes.processes.domain ": {"SIOCGIFFLAGS": 0x8913, "IFF_UP": 1},
    "softrig_nodes.seam.health": {"AT_FDCWD": -100, "RENAME_EXCHANGE": 2},
    "softrig_nodes.below.arrival": {"TAKE_FAILED": 401, "SIZE": 4096},
    "softrig_nodes.below.tf_message": {"MESSAGE": 18, "MESSAGES": 145},
    # numbers of digits, names, messages and bytes in records
    "softrig_core.wire.cdr": {"DIGITS": 12, "SINGLY": 32},
    "softrig_core.wire.recording": {"CHUNK": 4096},
    "softrig_core.wire.recording.ShardWriter": {"LIMIT": 4096},
    "softrig_core.wire.recording.ShardTail": {"LIMIT": 1 << 22},
}


@pytest.mark.parametrize("where", LIMITS)
def test_a_limit_has_its_documented_value(where):
    path = where.strip()
    module, _, name = path.rpartition(".")
    holder = getattr(import_module(module), name) if name[0].isupper() else import_module(path)
    assert {key: getattr(holder, key) for key in LIMITS[where]} == LIMITS[where]


def test_queues_of_ros_hold_ten_messages_and_a_writer_in_lockstep_keeps_two_hundred():
    from softrig_nodes.ros.ros import QOS, WRITTEN

    assert [(q.depth, q.reliability.name) for q in (QOS, WRITTEN)] == [(10, "RELIABLE"), (200, "RELIABLE")]
