"""Fixtures: rigs made of the blocks in tests/rig_package, in-process and through real processes."""

import os
from pathlib import Path

import pytest

os.environ["ROS_PYTHON_CHECK_FIELDS"] = "1"  # rclpy then refuses what it would send as garbage
PACKAGE = Path(__file__).parent / "rig_package"
os.environ["AMENT_PREFIX_PATH"] = f"{PACKAGE}{os.pathsep}{os.environ.get('AMENT_PREFIX_PATH', '')}"
os.environ["PYTHONPATH"] = f"{PACKAGE / 'python'}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"

import sys  # noqa: E402

sys.path.insert(0, str(PACKAGE / "python"))

from softrig_core.inprocess import run_inprocess  # noqa: E402
from softrig_core.recording import Recording  # noqa: E402
from softrig_core.rig import Rig  # noqa: E402
from softrig_core.scenario import Scenario  # noqa: E402


def make_scenario(nodes, duration=1.0, **keys):
    """Scenario of faultrig blocks: node name -> executable, or -> dict with executable and more."""
    entries = {
        name: {"package": "faultrig", **({"executable": entry} if isinstance(entry, str) else entry)}
        for name, entry in nodes.items()
    }
    return Scenario(name="test", title="test", system="lag", source="", duration=duration, nodes=entries, **keys)


def in_process(rig, seed=0):
    """Recording of an in-process run."""
    recording = Recording((t, p.msgtype) for t, p in rig.topics.items())
    run_inprocess(rig, seed, recording)
    return recording


def differences(a, b):
    """Topics whose messages differ in time or bytes."""
    return [n for n in a.topics if a.topics[n].times != b.topics[n].times or a.topics[n].data != b.topics[n].data]


@pytest.fixture
def lag_rig():
    """Plant, source and controller."""
    return Rig.from_scenario(make_scenario({"plant": "plant", "source": "source", "gain": "gain"}))
