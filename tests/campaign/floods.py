"""Floods of service calls from clients that leave without a goodbye: the rig continues, reports why it is paused, and
ends.

A case is a rig in processes, in a container or in real time, and what its clients call: refused sets, valid ones,
pauses, steps, resumes, lists, and the services of simulation_interfaces where it is installed. `doc/lab/tests.md` has a
table.
"""

from __future__ import annotations

import os
import random
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import Parameter
from rcl_interfaces.srv import SetParameters
from services import Client, judge, value
from softrig_nodes.processes.domain import free_domain
from softrig_nodes.processes.executables import environment
from std_srvs.srv import Trigger

LENGTH = 8.0  # s of a flood
PACE = 5.0  # of a container in lockstep: by itself it writes some GB in the time of a case
STANDS = 2.0  # s of a rig without a tick after which it has to say why
CLIENT = """
import os, random, sys, time
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import ListParameters, SetParameters
from std_srvs.srv import Trigger
import rclpy
what, node, clock, seed = sys.argv[1:]
SERVICES = ("GetEntities", "GetEntityState", "GetSimulationState", "GetSimulatorFeatures", "ResetSimulation")
SERVICES += ("SetSimulationState", "StepSimulation")
chance = random.Random(int(seed))
rclpy.init()
stranger = rclpy.create_node(f"stranger{seed}")
kinds = {
    "set": (SetParameters, f"{node}/set_parameters"), "refused": (SetParameters, f"{node}/set_parameters"),
    "list": (ListParameters, f"{node}/list_parameters"),
    **{name: (Trigger, f"{clock}/{name}") for name in ("pause", "resume", "step")},
}
if what == "simulation":
    import simulation_interfaces.srv
    for name in SERVICES:
        snake = "".join(f"_{c.lower()}" if c.isupper() else c for c in name)[1:]
        kinds[name] = getattr(simulation_interfaces.srv, name), f"/{snake}"
calls = {"pauses": ("pause", "step", "resume"), "steps": ("step",), "simulation": SERVICES}.get(what, (what,))
clients = {name: stranger.create_client(*kinds[name]) for name in calls}
for client in clients.values():
    client.wait_for_service(20.0)

def request(name):
    asked = kinds[name][0].Request()
    if name in ("set", "refused"):
        number = ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=chance.uniform(1.0, 60.0))
        text = ParameterValue(type=ParameterType.PARAMETER_STRING, string_value="x" * 1000)
        named, value = ("k", number) if name == "set" else ("no.such", text)
        asked.parameters = [Parameter(name=named, value=value)]
    if name == "GetEntityState":
        asked.entity = chance.choice(("", "shaft", "x" * 1000))
    if name == "SetSimulationState":
        asked.state.state = chance.choice((0, 1, 2, 77))  # stopped, playing, paused, none
    if name == "StepSimulation":
        asked.steps = chance.choice((0, 1, 2**64 - 1))
    return asked

end = time.monotonic() + chance.uniform(0.5, 2.0)
while time.monotonic() < end:
    name = chance.choice(calls)
    clients[name].call_async(request(name))
os._exit(0)  # with all answers under way
"""
REASONS = ("stands", "services", "paused")
KINDS = ("refused", "set", "list", "pauses", "steps")
KINDS += ("simulation",) if find_spec("simulation_interfaces") else ()
PLACES: tuple[tuple[str, ...], ...] = (("processes",), ("container",), ("container", "--realtime"))


def attack(seed: int, directory: Path) -> None:
    """One rig under one kind of flood."""
    what, place = KINDS[seed % len(KINDS)], PLACES[seed // len(KINDS) % len(PLACES)]
    (directory / "case").write_text(f"{what} {' '.join(place)}\n")
    with free_domain() as domain:
        pass  # the run reserves it
    os.environ.update(environment(domain, directory))
    command = [sys.executable, "-m", "softrig_bringup", "run", "dc_motor_smc", "--duration", "20000", "--no-record"]
    command += ["--mode", *place, "--domain", str(domain), "--no-plots", "--out", str(directory / "run")]
    text = directory / "said"
    with text.open("wb") as output:
        process = subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL)
    call = Client(domain)
    try:
        watch = Watch(call)
        watch.until(lambda: watch.ticks > 10, 120.0, "the first ticks")
        if place == ("container",):
            pace = Parameter(name="run.pace", value=value("DOUBLE", double_value=PACE))
            call(SetParameters, "/dc_motor_plant/set_parameters", parameters=[pace])
        before = watch.rate(4.0)
        clients: list[subprocess.Popen] = []
        during = watch.rate(LENGTH, lambda: _flood(clients, what, random.Random(seed)))
        watch.until(lambda: all(c.poll() is not None for c in clients), 60.0, "the end of a flooding client")
        if what in ("pauses", "steps", "simulation"):
            call(Trigger, "/dc_motor_plant/resume")
        after = watch.rate(4.0)
        with (directory / "case").open("a") as case:
            rates = f"{before:.0f} before, {during:.0f} during, {after:.0f} after"
            case.write(
                f"ticks a second: {rates}; {len(clients)} clients left; the longest stand {watch.longest:.1f} s; "
            )
            case.write(f"said {sorted(watch.said)}\n")
        assert process.poll() is None, text.read_text()[-2000:]
        assert after > 0.2 * before, f"{before:.0f} ticks a second before, {after:.0f} after"
        assert what in ("pauses", "simulation") or during > 0.05 * before, (
            f"{before:.0f} ticks a second before, {during:.0f} meanwhile"
        )
        late = STANDS * max(
            1.0, os.getloadavg()[0] / (os.cpu_count() or 1)
        )  # a loaded machine is slow, and says so late
        assert watch.unexplained < late, f"it stood for {watch.unexplained:.1f} s and did not say why"
        process.send_signal(signal.SIGINT)
        assert process.wait(60.0) == 130, text.read_text()[-2000:]
    finally:
        call.close()
        process.kill()
        process.wait()
    judge(text)
    logs = sum(len(log.read_text(errors="replace")) for log in (directory / "run/log").glob("*.log"))
    assert logs < 200_000, f"{logs} characters of logs"


def _flood(clients: list[subprocess.Popen], what: str, chance: random.Random) -> None:
    """Keep two clients busy, each of which leaves soon."""
    if sum(c.poll() is None for c in clients) < 2:
        arguments = [what, "/dc_motor_smc", "/dc_motor_plant", str(chance.randrange(10**9))]
        clients.append(subprocess.Popen([sys.executable, "-c", CLIENT, *arguments]))


class Watch:
    """Ticks of a rig and its reports, as /diagnostics shows them."""

    def __init__(self, call: Client) -> None:
        self.ticks, self.longest, self.unexplained, self.said = 0, 0.0, 0.0, set[str]()
        self._call, self._moved, self._reasons = call, time.monotonic(), {}
        call.node.create_subscription(DiagnosticArray, "/diagnostics", self._hear, 100)

    def _hear(self, message: Any) -> None:
        for status in message.status:
            values = {v.key: v.value for v in status.values}
            reasons = [f"{k}: {re.sub('[0-9.]+', 'N', v)}" for k, v in values.items() if k in REASONS]
            self._reasons[status.name] = reasons
            self.said.update(reasons)
            if status.name == "/dc_motor_plant":
                ticks = int(values["ticks"])
                if ticks != self.ticks:
                    self.ticks, self._moved = ticks, time.monotonic()

    def until(self, condition: Callable[[], bool], limit: float, what: str) -> None:
        """Listen until something has happened."""
        deadline = time.monotonic() + limit
        while not condition():
            assert time.monotonic() < deadline, f"never: {what}"
            self._call.turn()

    def rate(self, seconds: float, meanwhile: Callable[[], object] = bool) -> float:
        """Return ticks a second."""
        first, begun = self.ticks, time.monotonic()
        while (now := time.monotonic()) < begun + seconds:
            meanwhile()
            self._call.turn()
            stood = now - self._moved
            self.longest = max(self.longest, stood)
            if stood > STANDS + 1.0 and not any(self._reasons.values()):  # diagnostics come once a second
                self.unexplained = max(self.unexplained, stood)
        return (self.ticks - first) / seconds
