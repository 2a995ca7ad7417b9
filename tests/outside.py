"""A script as a process that the fork server forks: as by ``python -c``, without half a second of imports.

A script that must not have softrig imported is started by an interpreter of its own.
"""

import os
import signal

from softrig_nodes.processes.executables import find_executable
from softrig_nodes.processes.fork_server import start_node


def script(code, variables, *arguments, output=2):
    """Run a script with arguments in an environment; return what has the interface of `subprocess.Popen`."""
    command = [str(find_executable("faultrig", "script")), code, *arguments]
    return start_node("faultrig", "script", command, variables, output)


SPIN = """
from rclpy.executors import ExternalShutdownException
try:
    rclpy.spin(node)
except (KeyboardInterrupt, ExternalShutdownException):
    pass
node.destroy_node()
rclpy.try_shutdown()
"""


def outside(bench, name, code, *arguments):
    """Run a script beside the nodes of a bench."""
    bench.nodes[name] = script(code, bench.environment, *arguments)
    return bench.nodes[name]


def go(bench, name):
    """End a node, or a script that ends in `SPIN`, by Ctrl-C: a killed one stays in the graph for 3 s more."""
    bench.nodes[name].send_signal(signal.SIGINT)
    assert bench.ends(name) == 0


def busy():
    """By which factor a second becomes longer on a host with that many running processes, which take turns on its
    processors.
    """
    return max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1))
