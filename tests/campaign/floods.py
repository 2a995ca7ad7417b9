"""Floods of service calls from clients that leave without a goodbye: the rig continues, reports why it is paused, and
ends.

A case is a rig in processes, in a container or in real time, and what its clients call: refused sets, valid ones,
pauses, steps, resumes, lists, trajectories, and the services of simulation_interfaces and goals of control_msgs where
these are installed. `doc/lab/tests.md` has a table.
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

LENGTH = 8.0  # s that a flood lasts
PACE = 5.0  # real-time factor of a container in lockstep; without a limit it writes gigabytes in a case
STANDS = 2.0  # s without a tick, after which a rig must report the reason
CLIENT = """
import importlib, os, random, sys, time
import rclpy
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint
what, clock, node, seed = sys.argv[1:]
chance = random.Random(int(seed))
rclpy.init()
stranger = rclpy.create_node(f"stranger{seed}")

def calls(package, names, prefix):
    for name in names:
        kind = getattr(importlib.import_module(package + ".srv"), name)
        snake = "".join(f"_{c.lower()}" if c.isupper() else c for c in name)[1:]
        yield name, stranger.create_client(kind, f"{prefix}/{snake}"), kind

def presses(*names):
    from std_srvs.srv import Trigger
    for name in names:
        yield name, stranger.create_client(Trigger, f"{clock}/{name}"), Trigger

def request(name, kind):
    asked = kind.Request()
    if name == "SetParameters":
        number = ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=chance.uniform(1.0, 60.0))
        text = ParameterValue(type=ParameterType.PARAMETER_STRING, string_value="x" * 1000)
        asked.parameters = [Parameter(name="k", value=number) if what == "set" else Parameter(name="no", value=text)]
    if name == "GetEntityState":
        asked.entity = chance.choice(("", "shaft", "x" * 1000))
    if name == "SetSimulationState":
        asked.state.state = chance.choice((0, 1, 2, 77))  # stopped, playing, paused, none
    if name == "StepSimulation":
        asked.steps = chance.choice((0, 1, 2**64 - 1))
    return asked

def trajectory():
    names = chance.choice((["joint1", "joint2", "joint3"], ["joint2"], ["no"], [], ["x"] * 9999))
    made = JointTrajectory(joint_names=names)
    for k in range(chance.choice((0, 1, 1, 2, 5000 if len(names) < 9 else 1))):
        point = JointTrajectoryPoint(positions=[chance.uniform(-1.0, 1.0) for _ in names])
        point.time_from_start.sec = k + 1
        made.points.append(point)
    return made

SIMULATION = ("GetEntities", "GetEntityState", "GetSimulationState", "GetSimulatorFeatures", "ResetSimulation",
              "SetSimulationState", "StepSimulation")
if what == "trajectories":
    publisher = stranger.create_publisher(JointTrajectory, f"{node}/joint_trajectory", 10)
    some = [trajectory() for _ in range(20)]
    senders = [lambda: publisher.publish(chance.choice(some))]
elif what == "goals":
    from control_msgs.action import FollowJointTrajectory
    from rclpy.action import ActionClient
    client = ActionClient(stranger, FollowJointTrajectory, f"{node}/follow_joint_trajectory")
    client.wait_for_server(20.0)
    some = [FollowJointTrajectory.Goal(trajectory=trajectory()) for _ in range(20)]
    senders = [lambda: client.send_goal_async(chance.choice(some))]
else:
    made = {
        "set": lambda: calls("rcl_interfaces", ("SetParameters",), node),
        "refused": lambda: calls("rcl_interfaces", ("SetParameters",), node),
        "list": lambda: calls("rcl_interfaces", ("ListParameters",), node),
        "pauses": lambda: presses("pause", "step", "resume"),
        "steps": lambda: presses("step"),
        "simulation": lambda: calls("simulation_interfaces", SIMULATION, ""),
    }[what]()
    senders = []
    for name, client, kind in made:
        client.wait_for_service(20.0)
        senders.append(lambda name=name, client=client, kind=kind: client.call_async(request(name, kind)))
end = time.monotonic() + chance.uniform(0.5, 2.0)
while time.monotonic() < end:
    chance.choice(senders)()
os._exit(0)  # with all answers under way
"""
PYTHON = "in Python"  # a container without native code
REASONS = ("stands", "services", "paused")
MOTOR = ("dc_motor_smc", "/dc_motor_plant", "/dc_motor_smc")  # scenario, node of its clock, node that is called
ARM = ("manipulator_adsmc", "/manipulator_plant", "/trajectory_source")
KINDS = dict.fromkeys(("refused", "set", "list", "pauses", "steps"), MOTOR) | {"trajectories": ARM}
KINDS |= {"simulation": MOTOR} if find_spec("simulation_interfaces") else {}
KINDS |= {"goals": ARM} if find_spec("control_msgs") else {}
STOP = ("pauses", "steps", "simulation")  # floods that can leave a rig paused
PLACES: tuple[tuple[str, ...], ...] = (
    ("processes",),
    ("container",),
    ("container", "--realtime"),
    ("processes", "--realtime"),
    ("container", PYTHON),
)


def attack(seed: int, directory: Path) -> None:
    """One rig under one kind of flood."""
    what = list(KINDS)[seed % len(KINDS)]
    # The services of simulation_interfaces exist in lockstep only.
    places = [place for place in PLACES if what != "simulation" or "--realtime" not in place]
    place = places[seed // len(KINDS) % len(places)]
    scenario, clock, node = KINDS[what]
    (directory / "case").write_text(f"{what} {' '.join(place)}\n")
    with free_domain() as domain:
        pass  # only find a free domain; the run reserves it itself
    os.environ.update(environment(domain, directory))
    os.environ["SOFTRIG_JIT"] = "0" if PYTHON in place else "1"
    options = [option for option in place if option != PYTHON]
    command = [sys.executable, "-m", "softrig_bringup", "run", scenario, "--duration", "20000", "--no-record"]
    command += ["--mode", *options, "--domain", str(domain), "--no-plots", "--out", str(directory / "run")]
    text = directory / "said"
    with text.open("wb") as output:
        process = subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL)
    call = Client(domain)
    try:
        watch = Watch(call, clock)
        watch.until(lambda: watch.ticks > 10, 120.0, "the first ticks")
        if place[0] == "container" and "--realtime" not in place:
            pace = Parameter(name="run.pace", value=value("DOUBLE", double_value=PACE))
            call(SetParameters, f"{clock}/set_parameters", parameters=[pace])
        before = watch.rate(4.0)
        clients: list[subprocess.Popen] = []
        arguments = [what, clock, node]
        during = watch.rate(LENGTH, lambda: _flood(clients, arguments, random.Random(seed + len(clients))))
        watch.until(lambda: all(c.poll() is not None for c in clients), 60.0, "the end of a flooding client")
        if what in STOP:
            call(Trigger, f"{clock}/resume")
        after = watch.rate(4.0)
        with (directory / "case").open("a") as case:
            rates = f"{before:.0f} before, {during:.0f} during, {after:.0f} after"
            left = f"{len(clients)} clients left; the longest stand {watch.longest:.1f} s"
            case.write(f"ticks a second: {rates}; {left}; said {sorted(watch.reported)}\n")
        assert process.poll() is None, text.read_text()[-2000:]
        assert after > 0.2 * before, f"{before:.0f} ticks a second before, {after:.0f} after"
        if what not in STOP or what == "steps":
            assert during > 0.05 * before, f"{before:.0f} ticks a second before, {during:.0f} meanwhile"
        # On a loaded machine the report is late.
        late = STANDS * max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1))
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


def _flood(clients: list[subprocess.Popen], arguments: list[str], chance: random.Random) -> None:
    """Keep two clients busy, each of which leaves soon."""
    if sum(c.poll() is None for c in clients) < 2:
        seed = str(chance.randrange(10**9))
        clients.append(subprocess.Popen([sys.executable, "-c", CLIENT, *arguments, seed]))


class Watch:
    """Ticks of a rig and its reports, as /diagnostics shows them."""

    def __init__(self, call: Client, clock: str) -> None:
        self._clock = clock
        self.ticks, self.longest, self.unexplained, self.reported = 0, 0.0, 0.0, set[str]()
        self._call, self._moved, self._reasons = call, time.monotonic(), {}
        call.node.create_subscription(DiagnosticArray, "/diagnostics", self._hear, 100)

    def _hear(self, message: Any) -> None:
        for status in message.status:
            values = {v.key: v.value for v in status.values}
            reasons = [f"{k}: {re.sub('[0-9.]+', 'N', v)}" for k, v in values.items() if k in REASONS]
            self._reasons[status.name] = reasons
            self.reported.update(reasons)
            if status.name == self._clock:
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
            if stood > STANDS + 1.0 and not any(self._reasons.values()):  # diagnostics are published once a second
                self.unexplained = max(self.unexplained, stood)
        return (self.ticks - first) / seconds
