"""The motor with an Arduino Uno in front: the firmware runs on a simulated processor, cycle by cycle."""

from __future__ import annotations

import json
import math
import re
import shutil
import struct
import subprocess
import tempfile
from collections.abc import Mapping
from functools import lru_cache
from importlib import resources
from pathlib import Path
from typing import Any, Literal, NamedTuple

from softrig_core import BlockParams, Plant, Values, param, to_ns
from softrig_core.board.simavr import compiled, made_of
from softrig_core.errors import RunError, ScenarioError
from softrig_core.export.command import export_c
from softrig_core.firmware.check import DEBIAN
from softrig_core.run.expand import rig_of

from .model import MotorConstants, SensorConstants
from .ports import APPLIED, SENSORS, TRUE_STATE

MOTOR, MOTOR_NODE, MOTOR_STEP = "dc_motor_smc_c1", "dc_motor_plant", 1e-5  # the plant of the suite, and its period in s
ROW = struct.Struct("<8d")
AVR = ("-mmcu=atmega328p", "-std=gnu11", "-Os", "-ffp-contract=off", "-DF_CPU=16000000UL", "-Wall", "-Wextra")


class DcMotorUnoParams(SensorConstants, MotorConstants, BlockParams):
    """The controller of the firmware, the motor, and the parts between them."""

    scenario: str = param("dc_motor_smc_b1", "scenario whose controller the firmware has, in single precision")
    controller: str = param("dc_motor_smc", "its node")
    set_point: float = param(10.0, "set point, compiled in", "rad/s")
    pwm: Literal["fast", "phase_correct"] = param("fast", "mode of the timer: 977 Hz or 490 Hz")
    vmax: float = param(12.0, "supply voltage", "V", gt=0.0)
    bridge_drop: float = param(2.0, "voltage lost in the L298 bridge", "V", ge=0.0)
    current_lsb: float = param(0.0008, "resolution of the INA219", "A", gt=0.0)
    current_limit: float = param(3.2, "range of the INA219", "A", gt=0.0)


class State(NamedTuple):
    """Number of the tick, and the simulator's answer to it."""

    k: int = 0
    row: tuple[float, ...] = (0.0,) * 8


class Simulator:
    """The process of the simulated board."""

    def __init__(self, program: Path, firmware: Path) -> None:
        pipe = subprocess.PIPE
        # Ctrl-C in a terminal is for the node: a board that ended before it would be taken for one that has failed.
        self._process: Any = subprocess.Popen(
            [program, firmware], bufsize=0, stdin=pipe, stdout=pipe, stderr=subprocess.DEVNULL, process_group=0
        )
        self.k = 0

    def run(self, until: int) -> tuple[float, ...]:
        """Run up to a time in ns, and return its row.

        Raises
        ------
        RunError
            The simulator has ended.
        """
        try:
            self._process.stdin.write(struct.pack("<q", until))
            data = self._process.stdout.read(ROW.size)
        except OSError:
            data = b""
        if len(data) != ROW.size:
            raise RunError("the simulated board has ended")
        self.k += 1
        return tuple(ROW.unpack(data))

    def close(self) -> None:
        """End the process."""
        self._process.stdin.close()
        self._process.stdout.close()
        self._process.wait()


class DcMotorUno(Plant[DcMotorUnoParams]):
    """A brushed DC motor whose voltage an Arduino Uno controls, simulated to the cycle.

    The firmware is the exported controller of a scenario (`softrig export c`, in float) behind an encoder with
    interrupts, an INA219 on I2C and 8 bits of PWM; it runs on simavr. The motor is `DcMotorPlant` as C,
    stepped each 10 us with the mean of the voltage that bridge and PWM give. The board is compiled on first use.
    """

    OUTPUTS = (TRUE_STATE, SENSORS, APPLIED)
    SCRATCH = frozenset({"_boards"})  # the simulator, which can only go on
    STATE = State

    def setup(self) -> None:
        """Compile firmware and simulator; the cache has them afterwards."""
        p = self.p
        self._period = to_ns(p.period)
        if self._period % to_ns(MOTOR_STEP):
            raise ScenarioError(f"period = {p.period:g} s, expected a multiple of {MOTOR_STEP:g} s")
        if p.bridge_drop >= p.vmax:
            raise ScenarioError(f"bridge_drop = {p.bridge_drop:g} V leaves no voltage of vmax = {p.vmax:g} V")
        self._program = simulator_of(p)
        self._firmware = firmware_of(p)
        self._boards: list[Simulator] = []

    def save(self, x: State) -> Any:
        """Refuse: the state is that of a process.

        Raises
        ------
        RunError
        """
        raise RunError(f"{self.name}: the state of the simulated board cannot be saved")

    def outputs(self, x: State, t: int) -> Values:
        """Return the motor's state, the firmware's view of it, and the voltage set by the PWM register."""
        theta, w, i, applied, count, current, *_ = x.row
        return {"true_state": (theta, w, self.p.Kt * i), "sensors": (count, current), "applied": (applied,)}

    def advance(self, x: State, t: int, **inputs: Any) -> State:
        """Run the board and the motor for a period."""
        if x.k == 0:
            while self._boards:
                self._boards.pop().close()
            self._boards.append(Simulator(self._program, self._firmware))
        (board,) = self._boards
        if board.k != x.k:
            raise RunError(f"{self.name}: the simulated board cannot go back to an earlier tick")
        return State(x.k + 1, board.run(t + self._period))

    def health(self, x: State) -> Mapping[str, str]:
        """Return the longest tick of the firmware."""
        return {"firmware": f"longest tick {x.row[7]:.0f} cycles, {x.row[7] / 16:.0f} us"}


@lru_cache(maxsize=16)
def _exported(scenario: str, node: str, overrides: tuple[tuple[str, Any], ...], single: bool) -> Mapping[str, str]:
    """Return the exported files of a node by name, without rows and replay."""
    with tempfile.TemporaryDirectory() as scratch:
        rig = rig_of(scenario, duration=0.05, overrides=dict(overrides))
        done = export_c(rig, node, Path(scratch), rows=200, drawn=0, single=single)
    sources = ("softrig_c.h", f"{done.name}.h", f"{done.name}.c")
    return {file: done.files[file] for file in sources} | {"description": done.files[f"{done.name}.json"]}


def simulator_of(p: DcMotorUnoParams) -> Path:
    """Return the program that simulates board and motor.

    Raises
    ------
    ScenarioError
        There is no compiler or no libsimavr; the message names what to install.
    """
    constants = {name: getattr(p, name) for name in ("R", "L", "J", "b", "Kt", "Ke", "counts_per_rev")}
    values = {f"{MOTOR_NODE}.{name}": value for name, value in constants.items()}
    values |= {f"{MOTOR_NODE}.period": MOTOR_STEP, "motor_voltage.period": MOTOR_STEP}
    files = {k: v for k, v in _exported(MOTOR, MOTOR_NODE, tuple(values.items()), False).items() if k != "description"}
    defined = {
        "VMAX": p.vmax,
        "BRIDGE_DROP": p.bridge_drop,
        "CURRENT_LSB": p.current_lsb,
        "CURRENT_LIMIT": p.current_limit,
        "COUNTS_PER_REV": float(p.counts_per_rev),
    }
    lines = "".join(f"#define {name} {value!r}\n" for name, value in defined.items())
    host = (resources.files(__package__) / "uno_host.c").read_text()
    return compiled(files | {"uno_host.c": lines + host}, ["-lsimavr", "-lelf"], "dc_motor_uno", DEBIAN)


def firmware_of(p: DcMotorUnoParams) -> Path:
    """Return the firmware with the controller of a scenario.

    Raises
    ------
    ScenarioError
        There is no AVR compiler, the controller has no C, or it has other ports than the board's wiring.
    """
    results = dict(_exported(p.scenario, p.controller, (), True))
    described = json.loads(results.pop("description"))
    over, under = described["period_s"]
    known = {port["name"] for port in described["ports"] if port["direction"] == "in"}
    if not {"state", "reference"} <= known <= {"state", "reference", "sensors"} or over * 100 != under:
        raise ScenarioError(
            f"{p.controller} of {p.scenario} cannot run on the Uno of this rig: expected the inputs state, reference, "
            f"sensors or the first two, and a period of 0.01 s; it has {', '.join(sorted(known))}, {over}/{under} s"
        )
    name = re.sub(r"\W", "_", p.controller)
    defined = {
        "LAW_HEADER": f'"{name}.h"',
        "LAW": name,
        **{f"LAW_{word}": f"{name}_{word.lower()}" for word in ("IN", "OUT", "STEP", "INIT")},
        "VMAX": repr(p.vmax),
        "SET_POINT": repr(p.set_point),
        "CURRENT_LSB": repr(p.current_lsb),
        "SPEED_PER_COUNT": repr(math.tau / p.counts_per_rev * 100.0),
    }
    defined |= {"HAS_CURRENT": ""} if "sensors" in known else {}
    defined |= {"PHASE_CORRECT": ""} if p.pwm == "phase_correct" else {}
    lines = "".join(f"#define {key} {value}\n" for key, value in defined.items())
    return built(results | firmware_files(lines), "dc_motor_uno")


def firmware_files(defined: str) -> dict[str, str]:
    """Return the firmware's own files, with given first lines of the source."""
    sources = {name: (resources.files(__package__) / name).read_text() for name in ("uno_pwm.h", "uno_firmware.c")}
    return sources | {"uno_firmware.c": defined + sources["uno_firmware.c"]}


def built(files: Mapping[str, str], name: str) -> Path:
    """Compile files for an ATmega328P; firmware that the cache has is not compiled again.

    Raises
    ------
    ScenarioError
        There is no compiler, or it reports errors.
    """
    compiler = shutil.which("avr-gcc")
    if compiler is None:
        raise ScenarioError(f"avr-gcc is not installed (Debian: {DEBIAN})")
    try:
        return made_of(files, compiler, AVR, (), f"{name}.elf")
    except subprocess.CalledProcessError as error:
        raise ScenarioError(f"avr-gcc refuses {name}: {error.stderr.strip()[-1500:]}") from None
