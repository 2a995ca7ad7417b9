"""Hostile calls of the parameter services of live nodes: started alone, and in a rig during a run, in lockstep or in
real time.

Each declared parameter, `run.*` and rclpy's own too, must keep its type, its range and its existence; the node answers
each call and goes on.
"""

from __future__ import annotations

import json
import math
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import rclpy
from parameters import blocks
from rcl_interfaces.msg import Parameter, ParameterDescriptor, ParameterType as Type, ParameterValue
from rcl_interfaces.srv import (
    DescribeParameters,
    GetParameters,
    GetParameterTypes,
    ListParameters,
    SetParameters,
    SetParametersAtomically,
)
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from softrig_core import ScenarioError, load_scenario
from softrig_nodes.processes.domain import free_domain
from softrig_nodes.processes.executables import environment, find_executable

ROOT = Path(__file__).parents[2]
ANSWER, START = 60.0, 120.0  # s until a service answers, and until it exists, on a loaded machine
PAUSE = "expected a pause of"  # the message of a node that gets more calls than it can answer between its ticks


def value(kind: str, **content: object) -> ParameterValue:
    """Create the value of a message."""
    return ParameterValue(type=getattr(Type, f"PARAMETER_{kind}"), **content)


NUMBERS = (math.inf, -math.inf, math.nan, 5e-324, -5e-324, -0.0, 0.5, 1e308, -1e308)
HOSTILE = (
    *(value("DOUBLE", double_value=number) for number in NUMBERS),
    *(value("INTEGER", integer_value=number) for number in (2**63 - 1, -(2**63), 0, 1, -1)),
    *(
        value("STRING", string_value=text)
        for text in ("", "x", "true", "nan", "1e400", "[1.0, nan]", "\x00", "é" * 500)
    ),
    value("BOOL", bool_value=True),
    value("BOOL", bool_value=False),
    value("NOT_SET"),
    *(value("DOUBLE_ARRAY", double_array_value=row) for row in ([], [math.nan], [1.0, math.inf], [1e308] * 50)),
    *(value("INTEGER_ARRAY", integer_array_value=row) for row in ([], [1], [2**63 - 1] * 3)),
    *(value("STRING_ARRAY", string_array_value=row) for row in ([], ["x"], ["", "nan"])),
    *(value("BOOL_ARRAY", bool_array_value=row) for row in ([], [True, False])),
    *(value("BYTE_ARRAY", byte_array_value=row) for row in ([], [b"\x00"], [b"\xff"] * 8)),
    ParameterValue(type=77),
    ParameterValue(type=255, double_value=1.0),
)
NUMBER_OR_NONE = (Type.PARAMETER_NOT_SET, Type.PARAMETER_DOUBLE)
STRANGE = ("no.such", "", "run", "run.", ".", "a" * 5000, "\x00", "é")  # names of no parameter
FIELDS = ("", "bool_value", "integer_value", "double_value", "string_value")
FIELDS += ("byte_array_value", "bool_array_value", "integer_array_value", "double_array_value", "string_array_value")


class Client:
    """Calls services of other nodes."""

    def __init__(self, domain: int) -> None:
        self.context = Context()
        rclpy.init(context=self.context, domain_id=domain)
        self.node = Node("stranger", context=self.context)
        self._executor = SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self.node)

    def __call__(self, kind: Any, name: str, **fields: object) -> Any:
        """Call a service; it must answer."""
        client = self._client(kind, name)
        assert client.wait_for_service(timeout_sec=START), f"no service {name}"
        future = client.call_async(kind.Request(**fields))
        deadline = time.monotonic() + ANSWER
        while not future.done():
            assert time.monotonic() < deadline, f"{name} does not answer: {str(fields)[:300]}"
            self.turn()
        return future.result()

    @cache  # noqa: B019 - for the life of the client
    def _client(self, kind: Any, name: str) -> Any:
        return self.node.create_client(kind, name)

    def turn(self) -> None:
        """Process messages that have arrived."""
        self._executor.spin_once(0.02)

    def close(self) -> None:
        """Leave the graph."""
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)


class Target:
    """The parameters of one node, as its services show them."""

    def __init__(self, call: Client, name: str) -> None:
        self.call, self.name = call, name
        listed = call(ListParameters, f"{name}/list_parameters", depth=0).result.names
        self.names = sorted(listed)
        assert len(set(listed)) == len(listed) > 5, listed
        self.values, self.described = self.get(self.names), self.describe(self.names)

    def get(self, names: Sequence[str]) -> dict[str, ParameterValue]:
        """Return the present values of the parameters that have one."""
        results = {}
        for name in names:  # if one of several parameters has no value, rclpy's answer is empty
            for one in self.call(GetParameters, f"{self.name}/get_parameters", names=[name]).values:
                results[name] = one
        return results

    def describe(self, names: Sequence[str]) -> dict[str, ParameterDescriptor]:
        """Return the descriptors."""
        result = self.call(DescribeParameters, f"{self.name}/describe_parameters", names=names).descriptors
        assert len(result) == len(names)
        return {one.name: one for one in result}

    def set(self, parameters: list[Parameter], together: bool) -> list[Any]:
        """Set parameters; return the result of each."""
        while True:
            if together:
                results = [self.call(SetParametersAtomically, f"{self.name}/set_parameters_atomically",
                                     parameters=parameters).result]  # fmt: skip
            else:
                results = self.call(SetParameters, f"{self.name}/set_parameters", parameters=parameters).results
                assert len(results) == len(parameters)
            if not any(PAUSE in result.reason for result in results):
                return results
            time.sleep(0.2)

    def attack(self, name: str) -> int:
        """Set one parameter to each hostile value, and back; return how many were refused."""
        kept, descriptor, refused = self.values.get(name), self.described[name], 0
        for k, hostile in enumerate(HOSTILE):
            (result,) = self.set([Parameter(name=name, value=hostile)], together=bool(k % 2))
            where = f"{self.name} {name} = {shown(hostile)}"
            refused += not result.successful
            if not result.successful:
                assert result.reason, where
                assert len(result.reason) < 3000, where
                assert "Error" not in result.reason, f"{where}: {result.reason}"
            now = self.get([name]).get(name)
            # An optional parameter may get a first value.
            if now is None or kept is None or kept.type == Type.PARAMETER_NOT_SET:
                assert now is None or now == kept or result.successful, where
                assert now is None or not descriptor.floating_point_range or now.type in NUMBER_OR_NONE, where
                self.values[name] = kept = now or kept
                continue
            check(where, now, kept, descriptor, result)
            if content(now) != content(kept):
                (back,) = self.set([Parameter(name=name, value=kept)], together=False)
                assert back.successful, f"{where} was taken, and {shown(kept)} is refused then: {back.reason}"
        assert self.describe([name])[name].type == (descriptor.type if kept is None else kept.type)
        return refused

    def strange(self, most: int) -> None:
        """Call with unknown names, with one name twice, with none, and with good and bad ones together."""
        good = next(n for n in self.names if n in self.values)
        known = Parameter(name=good, value=self.values[good])
        for name in (*STRANGE, good + ".", good.upper() + "_"):
            for hostile in (value("NOT_SET"), *HOSTILE[:2], *HOSTILE[-2:])[:most]:
                message = Parameter(name=name, value=hostile)
                for together in (False, True):
                    (result,) = self.set([message], together)
                    assert not result.successful, (name, result)
                    assert "is not a parameter of" in result.reason or "no type" in result.reason, result.reason
                first, second = self.set([known, message], together=False)
                assert first.successful, f"{good} beside {name!r}: {first.reason}"
                assert not second.successful
                assert not self.set([known, message], together=True)[0].successful
            for kind, service in ((GetParameters, "get_parameters"), (GetParameterTypes, "get_parameter_types"),
                                  (DescribeParameters, "describe_parameters")):  # fmt: skip
                self.call(kind, f"{self.name}/{service}", names=[name, good, good])
            for depth in (0, 1, 2**64 - 1):
                self.call(ListParameters, f"{self.name}/list_parameters", prefixes=[name, name], depth=depth)
        assert self.set([], together=False) == []
        assert self.set([], together=True)[0].successful
        unset = Parameter(name=good, value=value("NOT_SET"))
        assert not self.set([known, unset, known], together=True)[0].successful
        assert [r.successful for r in self.set([known, unset, known], together=False)] == [True, False, True]

    def unchanged(self) -> None:
        """Check that all parameters are as before."""
        assert sorted(self.call(ListParameters, f"{self.name}/list_parameters", depth=0).result.names) == self.names
        now = self.get(self.names)
        for name, before in self.values.items():
            assert content(now[name]) == content(before), f"{self.name} {name}: {shown(before)}, now {shown(now[name])}"


def check(where: str, now: ParameterValue, kept: ParameterValue, descriptor: Any, result: Any) -> None:
    """Check that a parameter has kept its type and range, and its value where a call was refused."""
    assert now.type == kept.type, f"{where}: its type is {now.type}, was {kept.type}"
    if not result.successful:
        assert content(now) == content(kept), f"{where} was refused and changed to {shown(now)}"
    elif descriptor.read_only:
        assert content(now) == content(kept), f"{where}: fixed, and changed to {shown(now)}"
    number = content(now)
    for bounds in (*descriptor.floating_point_range, *descriptor.integer_range):
        if isinstance(number, float | int):
            assert bounds.from_value <= number <= bounds.to_value, f"{where}: {number} is out of range"
    for one in number if isinstance(number, list) else [number]:
        assert not isinstance(one, float) or math.isfinite(one), where


def content(one: ParameterValue) -> Any:
    """Return the content of a value."""
    result = getattr(one, FIELDS[one.type]) if 0 < one.type < len(FIELDS) else None
    return list(result) if one.type > Type.PARAMETER_STRING else result


def shown(one: ParameterValue) -> str:
    """Return a value as text."""
    return f"{content(one)!r}"[:80] if one.type < len(FIELDS) else f"type {one.type}"


@cache
def cases() -> list[tuple[str, str, str]]:
    """List the targets: package and executable, or '' and scenario, and their state.

    Scenarios are as few as hold all executables of any; all executables are tried alone, too.
    """
    paused_nodes = {}
    for name in sorted(file.stem for file in ROOT.glob("config/scenarios/*.yaml")):
        try:
            paused_nodes[name] = {(n.package, n.executable) for n in load_scenario(name).nodes.values()}
        except ScenarioError:
            continue
    known = {(package, executable) for package, executable, _ in blocks()}
    left, rigs = known & set().union(*paused_nodes.values()), []
    while left:
        rigs.append(max(paused_nodes, key=lambda name: len(paused_nodes[name] & left)))
        left -= paused_nodes[rigs[-1]]
    alone = [(package, executable, mode) for package, executable in sorted(known) for mode in ("lockstep", "realtime")]
    return alone + [("", name, mode) for name in rigs for mode in ("container", "processes", "realtime")]


def attack(seed: int, directory: Path) -> None:
    """Attack all parameters of one executable alone, or of all nodes of one rig during a run."""
    package, name, state = cases()[seed % len(cases())]
    (directory / "case").write_text(f"{package} {name} {state}\n")
    with alone(package, name, state, directory) if package else rig(name, state, directory) as (domain, alive):
        if domain is None:
            return  # the node requires parameters and has reported so
        call = Client(domain)
        try:
            nodes = alive()
            chance = random.Random(seed)
            # Ticks have priority over services, so each seed tries only some of the parameters.
            for node in chance.sample(nodes, min(2, len(nodes))):
                target = Target(call, node)
                names = target.names if package else chance.sample(target.names, min(2, len(target.names)))
                refused = sum(target.attack(parameter) for parameter in names)
                assert refused, f"{node}: nothing was refused"
                target.strange(len(HOSTILE) if package else 1)
                target.unchanged()
            assert alive() == nodes
        finally:
            call.close()


@contextmanager
def alone(package: str, executable: str, mode: str, directory: Path) -> Iterator[tuple]:
    """Start one node alone; return its domain and a check that it lives."""
    status, message = directory / "status.json", directory / "said"
    with free_domain() as domain, message.open("wb") as output:
        os.environ.update(environment(domain, directory))
        command = [str(find_executable(package, executable)), "--ros-args", "-r", "__node:=victim"]
        for name, option in {"mode": mode, "status": status, "timeout": 600.0, "start_timeout": 0.0}.items():
            command += ["-p", f"run.{name}:={option}"]
        process = subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL)
        try:
            while not status.exists() and process.poll() is None:
                time.sleep(0.02)

            def alive() -> list[str]:
                assert process.poll() is None, f"ended with status {process.returncode}: {message.read_text()[-500:]}"
                assert json.loads(status.read_text())["error"] == ""
                return ["/victim"]

            if process.poll() is None:
                yield domain, alive
                alive()
                process.send_signal(signal.SIGINT)
                assert process.wait(20.0) == 0, f"stopped, it ended with status {process.returncode}"
            else:
                assert process.returncode == 2, message.read_text()[-2000:]
                yield None, alive
        finally:
            process.kill()
            process.wait()
    judge(message)


@contextmanager
def rig(scenario: str, state: str, directory: Path) -> Iterator[tuple]:
    """Run a scenario for a long time; return its domain and a check that it continues."""
    message, files = directory / "said", directory / "run"
    with free_domain() as domain:
        pass  # only find a free domain; the run reserves it itself
    os.environ.update(environment(domain, directory))
    command = [sys.executable, "-m", "softrig_bringup", "run", scenario, "--duration", "1000", "--no-record"]
    command += ["--mode", "processes" if state == "processes" else "container", "--domain", str(domain), "--no-plots"]
    command += ["--out", str(files), *(["--realtime"] if state == "realtime" else [])]
    names = sorted(f"/{name}" for name in load_scenario(scenario).nodes)
    with message.open("wb") as output:
        process = subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL)
    try:

        def alive() -> list[str]:
            assert process.poll() is None, f"ended with status {process.returncode}: {message.read_text()[-1500:]}"
            return names

        yield domain, alive
        alive()
        process.send_signal(signal.SIGINT)
        assert process.wait(60.0) == 130, f"{process.returncode}: {message.read_text()[-1500:]}"
    finally:
        process.kill()
        process.wait()
    judge(message)


def judge(path: Path) -> None:
    """Check what was printed."""
    text = path.read_text(errors="replace")
    assert "Traceback" not in text, text[-3000:]
    assert len(text) < 100_000, f"{len(text)} characters of log"
