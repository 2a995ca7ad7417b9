"""The part of launch and launch_ros that our launch file needs; neither is in the package registries.

After launch 3.4 and launch_ros 0.26: an argument has choices, `on_exit` is called with the event and the context, what
it raises shuts the launch down with status 1, and a shutdown interrupts what still runs.
"""

import signal
import sys
import time
import types
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace

from conftest import fork
from softrig_nodes.processes.executables import find_executable

FILE = Path(__file__).parents[1] / "ros_pkgs" / "softrig_bringup" / "launch" / "rig.launch.py"


class LaunchDescription(list):
    pass


class DeclareLaunchArgument:
    def __init__(self, name, *, default_value=None, description="", choices=None):
        self.name, self.default, self.choices = name, default_value, choices

    def given(self, values):
        value = values.get(self.name, self.default)
        if value is None or (self.choices is not None and value not in self.choices):
            raise RuntimeError(f"argument {self.name!r}: {value!r}, expected one of {self.choices}")
        return value


class LaunchConfiguration:
    def __init__(self, name):
        self.name = name

    def perform(self, context):
        return context.values[self.name]


class OpaqueFunction:
    def __init__(self, function):
        self.function = function


class AsyncSafeSignalManager:
    pass


class Shutdown:
    def __init__(self, *, reason, due_to_sigint=False):
        self.reason, self.due_to_sigint = reason, due_to_sigint


class Node:
    def __init__(self, *, package, executable, name=None, namespace=None, output="log", on_exit=None, arguments=(),
                 remappings=(), parameters=(), additional_env=None):  # fmt: skip
        self.package, self.executable, self.name, self.on_exit = package, executable, name, on_exit
        self.namespace, self.variables = namespace, dict(additional_env or {})
        self.parameters, self.remappings, self.arguments = list(parameters), list(remappings), list(arguments)

    def command(self):
        ros = [f"__node:={self.name}"] if self.name else []
        ros += [f"__ns:=/{self.namespace}"] if self.namespace else []
        ros += [f"{old}:={new}" for old, new in self.remappings]
        options = [word for rule in ros for word in ("-r", rule)]
        options += [word for file in self.parameters for word in ("--params-file", file)]
        path = str(find_executable(self.package, self.executable))
        return [path, *self.arguments, *(["--ros-args", *options] if options else [])]


MODULES = {
    "launch": [LaunchDescription],
    "launch.actions": [DeclareLaunchArgument, OpaqueFunction, Shutdown],
    "launch.events": [Shutdown],
    "launch.substitutions": [LaunchConfiguration],
    "launch.utilities": [],
    "launch.utilities.signal_management": [AsyncSafeSignalManager],
    "launch_ros": [],
    "launch_ros.actions": [Node],
}


def nodes_of(values, **context):
    """The Node actions of the launch file for these arguments, in a context with further variables."""
    before = {name: sys.modules.get(name) for name in MODULES}
    try:
        for name, classes in MODULES.items():
            sys.modules[name] = types.ModuleType(name)
            sys.modules[name].__dict__.update({c.__name__: c for c in classes})
        space = {}
        exec(compile(FILE.read_text(), str(FILE), "exec"), space)
    finally:
        for name, module in before.items():
            sys.modules.pop(name) if module is None else sys.modules.update({name: module})
    *declared, last = space["generate_launch_description"]()
    return last.function(SimpleNamespace(values={a.name: a.given(values) for a in declared}, **context))


def launch(values, variables, meddle=lambda processes: None):
    """Launch until all have ended; return status and output. `meddle` gets the processes by node name.

    Several launches on one domain: `values` is a list.
    """
    nodes = [node for one in (values if isinstance(values, list) else [values]) for node in nodes_of(one)]
    context, status, messages = SimpleNamespace(is_shutdown=False), 0, []
    stack, running = ExitStack(), {}
    try:
        for node in nodes:
            own = variables | node.variables
            running[node] = fork(stack, node.package, node.executable, node.command(), own)
        while running:
            meddle({n.name: p for n, p in running.items()})
            for node, process in [(n, p) for n, p in running.items() if p.poll() is not None]:
                del running[node]
                messages.append(process.communicate()[0])
                event = SimpleNamespace(returncode=process.returncode, process_name=node.name or node.executable)
                try:
                    node.on_exit(event, context)
                except RuntimeError as error:
                    messages.append(str(error))
                    status, context.is_shutdown = 1, True
                    for other in running.values():
                        other.send_signal(signal.SIGINT)
            time.sleep(0.01)
    finally:
        for process in running.values():
            process.kill()
            process.wait()
        stack.close()
    return status, "".join(messages)
