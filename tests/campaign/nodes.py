"""Hostile messages, parameters and button presses over the real middleware to every live node: it rejects them and
lives on.
"""

import json
import os
import random
import signal
import subprocess
import time
from contextlib import suppress
from pathlib import Path

import rclpy
from parameters import blocks
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from rclpy._rclpy_pybind11 import RCLError
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from softrig_core import Port, Refused
from softrig_core.block.codec import Decoder, encoder
from softrig_core.block.params import declarations
from softrig_core.wire.cdr import Layout
from softrig_nodes.processes.domain import free_domain
from softrig_nodes.processes.executables import environment, find_executable
from softrig_nodes.ros.messages import message_class
from softrig_nodes.ros.ros import QOS
from std_srvs.srv import Trigger

from bags import damaged

MESSAGES = 200  # of one case
BURST = 8  # fewer messages than a subscriber queues
MEMORY = 2000  # MB of a node


class Attacker:
    """Publishes on the inputs of one node, good and bad, and checks what it answers."""

    def __init__(
        self,
        node: Node,
        executor: SingleThreadedExecutor,
        inputs: list[Port],
        outputs: list[Port],
        chance: random.Random,
        live: bool,
    ) -> None:
        self.node, self.executor, self.chance, self.live = node, executor, chance, live
        self.ports = inputs
        layouts = [p.layout() for p in inputs]
        if not live:  # in lockstep an array of a wrong tick ends the run, as it should
            layouts = [Layout(*layout.form[:-1]) for layout in layouts]
        self.encoders = [encoder(layout, {"": 0}, "") for layout in layouts]
        self.decoders = [Decoder(p) for p in inputs]
        self.publishers = [node.create_publisher(message_class(p.msgtype), topic(p), QOS) for p in inputs]
        self.bad = dict.fromkeys((p.topic for p in inputs), 0)
        self.answers, self.garbage = 0, ""
        for port in outputs:
            node.create_subscription(message_class(port.msgtype), topic(port), self._reader(port), QOS, raw=True)

    def _reader(self, port: Port) -> object:
        decode = Decoder(port)

        def read(data: bytes) -> None:
            self.answers += 1
            try:
                decode(data)
            except Refused as error:
                self.garbage = f"{port.topic}: {error}"

        return read

    def send(self) -> None:
        """Send a burst, a message or two of it good, on inputs at random."""
        if not self.ports:
            return
        for _ in range(BURST):
            k = self.chance.randrange(len(self.ports))
            data = self.message(k)
            try:
                self.decoders[k](data)
            except Refused:
                self.bad[self.ports[k].topic] += 1
            with suppress(RCLError):  # too short even for rclpy to publish
                self.publishers[k].publish(data)
        for publisher in self.publishers:
            publisher.wait_for_all_acked(Duration(seconds=1))
        self.executor.spin_once(0.005)

    def message(self, k: int) -> bytes:
        """Make a message: valid, damaged, or with impossible numbers or an impossible stamp."""
        chance, port, encode = self.chance, self.ports[k], self.encoders[k]
        stamp = time.time_ns() if self.live else 0
        values = [float(v) for v in port.safe] if port.safe else [0.0] * port.size
        match chance.randrange(6):
            case 0:
                stamp = chance.choice((0, 1, 2**31 * 10**9 - 1, stamp + 10**12, stamp - 10**12))
            case 1 if values and not port.msgtype.endswith("Bool"):
                values[chance.randrange(len(values))] = chance.choice((float("nan"), float("inf"), 1e308, -1e300))
            case 2:
                return encode(stamp, values)
            case 3:
                return chance.randbytes(chance.randrange(300))
            case _:
                return damaged(encode(stamp, values), chance)
        return encode(stamp, values)

    def call(self, client: object, request: object, what: str) -> object:
        """Call a service; it must answer."""
        assert client.wait_for_service(timeout_sec=25.0), f"no service {what}"
        future = client.call_async(request)
        deadline = time.monotonic() + 25.0  # each press can cause a second of work
        while not future.done():
            assert time.monotonic() < deadline, f"{what} does not answer"
            self.executor.spin_once(0.02)
        return future.result()


def topic(port: Port) -> str:
    """Return the full name of a topic of the node."""
    return port.topic.replace("~", "/victim") if port.topic.startswith("~") else f"/{port.topic.lstrip('/')}"


def attack(seed: int, directory: Path) -> None:
    """Start one executable alone, attack it, stop it."""
    chance = random.Random(seed)
    package, executable, block = blocks()[seed % len(blocks())]
    live = chance.random() < 0.7
    (directory / "case").write_text(f"{package} {executable} {'realtime' if live else 'lockstep'}\n")
    message, status = directory / "said", directory / "status.json"
    with free_domain() as domain:
        os.environ.update(environment(domain, directory))
        command = [str(find_executable(package, executable)), "--ros-args", "-r", "__node:=victim"]
        options = {"mode": "realtime" if live else "lockstep", "status": status, "timeout": 60.0, "start_timeout": 0.0}
        for name, value in options.items():
            command += ["-p", f"run.{name}:={value}"]
        with message.open("wb") as output:
            process = subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL)
        try:
            bombard(chance, process, block, status, domain, live)
        finally:
            if process.poll() is None:
                process.kill()
                process.wait()
    text = message.read_text(errors="replace")
    assert "Traceback" not in text, text[-2000:]
    assert len(text.splitlines()) < 200, f"{len(text.splitlines())} lines of log"


def bombard(
    chance: random.Random, process: subprocess.Popen, block: type, status: Path, domain: int, live: bool
) -> None:
    """Attack a running node."""
    while not status.exists():
        if process.poll() is not None:
            assert process.returncode == 2, f"it ended at its start with status {process.returncode}"
            return  # the node requires parameters and has reported so
        time.sleep(0.02)
    inputs, outputs = block.ports(block.Params())
    context = Context()
    rclpy.init(context=context, domain_id=domain)
    node = Node("attacker", context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    try:
        attacker = Attacker(node, executor, list(inputs), list(outputs), chance, live)
        deadline = time.monotonic() + 10.0
        while any(not p.get_subscription_count() for p in attacker.publishers):
            assert time.monotonic() < deadline, "its inputs are not there"
            executor.spin_once(0.02)
        for _ in range(MESSAGES // BURST):
            attacker.send()
        _parameters(attacker, block)
        for port in inputs:
            if port.msgtype == "std_msgs/msg/Bool":
                attacker.call(node.create_client(Trigger, f"/victim/{port.name}"), Trigger.Request(), port.name)
        _judge(attacker, process, status, live)
    finally:
        executor.shutdown()
        node.destroy_node()
        rclpy.shutdown(context=context)


def _parameters(attacker: Attacker, block: type) -> None:
    request = SetParameters.Request()
    for declaration in attacker.chance.sample(declarations(block.Params), 1):
        for value in (
            ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=float("nan")),
            ParameterValue(type=ParameterType.PARAMETER_STRING, string_value="x" * 5000),
            ParameterValue(type=ParameterType.PARAMETER_NOT_SET),
            ParameterValue(type=77),
        ):
            request.parameters.append(Parameter(name=declaration.name, value=value))
    request.parameters.append(Parameter(name="no.such.parameter"))
    client = attacker.node.create_client(SetParameters, "/victim/set_parameters")
    attacker.call(client, request, "set_parameters")


def _judge(attacker: Attacker, process: subprocess.Popen, status: Path, live: bool) -> None:
    """It lives, has counted its rejected messages, answers with finite numbers, and ends on request."""
    before = status.stat().st_mtime_ns
    deadline = time.monotonic() + 15.0
    while status.stat().st_mtime_ns <= before and process.poll() is None:
        assert time.monotonic() < deadline, "it does nothing any more"
        attacker.executor.spin_once(0.05)
    content = json.loads(status.read_text())
    assert process.poll() is None, f"it ended with status {process.returncode}: {content.get('error')}"
    assert attacker.garbage == "", attacker.garbage
    peak = int(Path(f"/proc/{process.pid}/status").read_text().split("VmHWM:")[1].split()[0]) // 1024
    assert peak < MEMORY, f"{peak} MB"
    if live:
        for name, count in attacker.bad.items():
            counted = content["refused"].get(name, [0])[0]
            assert counted or count < 10, f"{count} bad messages on {name}, none refused"
    process.send_signal(signal.SIGINT)
    try:
        process.wait(15.0)
    except subprocess.TimeoutExpired:
        raise AssertionError("it does not end at SIGINT") from None
    assert process.returncode == 0, f"stopped, it ended with status {process.returncode}"
