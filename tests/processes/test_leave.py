"""The end of a process whose middleware does not let it go."""

import subprocess
import sys

import pytest
from conftest import PATIENCE

STUCK = """
import ctypes
from softrig_core.node.ros.leave import leave

class Node:
    executor = None

    def destroy_node(self):
        print("leaving")
        ctypes.PyDLL(None).pause()  # keeps the interpreter, as a call of the middleware does

leave([Node()], {status})
"""


@pytest.mark.parametrize("status", [pytest.param(0, marks=pytest.mark.long), 3])
def test_a_node_that_cannot_leave_ends_with_its_status(status):
    done = subprocess.run([sys.executable, "-c", STUCK.format(status=status)], capture_output=True, timeout=PATIENCE)
    assert done.returncode == status
    assert done.stderr == b""
