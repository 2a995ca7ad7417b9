"""The end of a process whose middleware does not return."""

import subprocess
import sys

import pytest
from conftest import PATIENCE

STUCK = """
import ctypes
from softrig_nodes.below.leave import leave

class Node:
    executor = None

    def destroy_node(self):
        print("leaving")
        ctypes.PyDLL(None).{call}  # keeps the interpreter, as a call of the middleware does

leave([Node()], {status})
"""


@pytest.mark.parametrize(
    ("call", "status"),
    [pytest.param("pause()", 0, marks=pytest.mark.long), ("pause()", 3), ("strlen(None)", 0), ("abort()", 3)],
)
def test_a_node_that_cannot_leave_ends_with_its_status(call, status):
    """Fast DDS blocks forever or crashes while it removes a node from the graph; the node's own work is done by
    then.
    """
    code = STUCK.format(call=call, status=status)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, timeout=PATIENCE)
    assert done.returncode == status
    assert done.stderr == b""
