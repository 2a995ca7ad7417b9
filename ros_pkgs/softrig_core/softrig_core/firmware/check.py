"""Build firmware, run it in a simulator of its board, and compare its answers with those of this machine."""

from __future__ import annotations

import json
import math
import re
import struct
import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..board.frames import Kind
from ..board.layout import Layout
from ..board.line import Build, Line
from ..board.simavr import DEBIAN as SIMAVR
from ..board.wires import Simulated, opened
from ..errors import ScenarioError
from ..export.check import BOARDS, FLAGS, TOOLS, c_compiler, tool

DEBIAN = f"{SIMAVR} gcc-avr avr-libc arduino-core-avr"
CORE = Path("/usr/share/arduino/hardware/arduino/avr")
# the parts that a sketch with a serial port needs; WString.cpp does not compile with Debian's avr-gcc 5.4
CORE_FILES = ("wiring.c", "hooks.c", "HardwareSerial.cpp", "HardwareSerial0.cpp", "Print.cpp", "main.cpp", "abi.cpp")
AVR = ("-mmcu=atmega328p", "-Os", "-ffp-contract=off", "-ffunction-sections", "-fdata-sections")
ARDUINO = ("-DF_CPU=16000000UL", "-DARDUINO=10819", "-DARDUINO_AVR_UNO", "-DARDUINO_ARCH_AVR")
FLASH, RAM = 32256, 2048  # bytes of an Uno without its boot loader
# Simulated time (ns) for an instruction with -icount shift=10, and for a clock cycle of an MPS2 board (25 MHz).
INSTRUCTION_NS, PER_TICK_NS = 1024, 40
TIMEOUT = 2.0  # s; tried 16 times, because a simulator may be slow on a busy machine
RUN, DRAWN = 300, 200  # rows of the run, and of drawn inputs


@dataclass(frozen=True)
class Checked:
    """Result of a simulated board.

    Attributes
    ----------
    rows, differing : int
        Steps, and those whose answers differ from this machine's with the same number type.
    unit : str
        Of `longest`: cycles or instructions.
    longest : int
        Longest step.
    flash, ram, stack : int
        Bytes: code and constants; static data; deepest stack, from `-fstack-usage` and from the pushes in library
        functions.
    """

    rows: int
    differing: int
    unit: str
    longest: int
    flash: int
    ram: int
    stack: int

    def __str__(self) -> str:
        """Return the result in one line."""
        same = "the bits of this machine" if not self.differing else f"{self.differing} answers differ"
        time = f"{self.longest} {self.unit}" + (f" ({self.longest / 16:.0f} us)" if self.unit == "cycles" else "")
        return (
            f"{self.rows} steps, {same}; at most {time}, {self.flash} bytes of flash, "
            f"{self.ram} bytes of RAM, {self.stack} bytes of stack"
        )


def checked(folder: Path, name: str, layout: Layout, board: str) -> Checked:
    """Build the firmware of a folder as ``NAME.elf``, which stays, and run it in a simulator.

    Parameters
    ----------
    board : str
        ``arduino`` or a core of `BOARDS`.

    Raises
    ------
    ScenarioError
        A tool is missing, a compiler refuses the code, or it does not fit the board.
    """
    build = _arduino if board == "arduino" else _cortex_m
    with tempfile.TemporaryDirectory() as scratch:
        flash, ram, stack = build(folder, name, Path(scratch), board)
        if board == "arduino" and (flash > FLASH or ram + stack > RAM):
            raise ScenarioError(
                f"{name} does not fit an Uno: {flash} of {FLASH} bytes of flash, {ram} bytes of RAM and {stack} of "
                f"stack of {RAM}"
            )
        host = _host(folder, name, Path(scratch), layout)
        described = json.loads((folder / f"{name}.json").read_text())
        over, under = described["period_s"]
        kind = "simavr" if board == "arduino" else "qemu"
        expected = Build(described["digest"], (over, under), layout)
        line, reference = (_line(f"{k}:{f}", expected) for k, f in ((kind, folder / f"{name}.elf"), ("program", host)))
        rows = differing = 0
        try:
            for step in _steps((folder / f"{name}_rows.txt").read_text(), layout):
                if step is None:
                    line.begin(b"")
                    reference.begin(b"")
                    continue
                rows += 1
                differing += not _same(line.ask(Kind.STEP, step), reference.ask(Kind.STEP, step), layout.answer)
            longest = _longest(line, board)
        finally:
            line.close()
            reference.close()
    unit = "cycles" if board == "arduino" else "instructions"
    return Checked(rows, differing, unit, longest, flash, ram, stack)


def _line(port: str, build: Build) -> Line:
    return Line(port, lambda: opened(port, 0), build, TIMEOUT)


def _longest(line: Line, board: str) -> int:
    """Return the longest step: simavr's program counts it, a Cortex-M reports it in its next hello message."""
    if board == "arduino":
        assert isinstance(line.wire, Simulated)
        return int(line.wire.end_and_count().get("cycles", 0))
    line.begin(b"")
    line.ask(Kind.RESET, b"")
    return round(line.longest * PER_TICK_NS / INSTRUCTION_NS)


def _same(first: bytes, second: bytes, layout: struct.Struct) -> bool:
    """Return whether two answers have the same numbers; all NaNs are equal, whatever their bits."""
    if first == second:
        return True
    if len(first) != layout.size or len(second) != layout.size:
        return False
    pairs = list(zip(layout.unpack(first), layout.unpack(second), strict=True))
    return all((a == b and math.copysign(1.0, a) == math.copysign(1.0, b)) or (a != a and b != b) for a, b in pairs)


def _steps(rows: str, layout: Layout) -> Iterator[bytes | None]:
    """Yield the golden rows as values of steps, some of the run and some drawn; None restores the first state."""
    moved: list[Any] = []
    count = sequence = 0
    for line in rows.splitlines():
        if line == "init":
            sequence += 1
            count = count if sequence > 2 else 0
            moved = []
            yield None
            continue
        if count >= (RUN if sequence == 1 else DRAWN):
            if sequence > 1:
                return
            continue
        method, _, t, *numbers = line.split()
        row = [] if layout.plant and method == "0" else _inputs(numbers, layout)
        if layout.plant and method == "1":
            moved = [int(t), *row]
            continue
        if layout.plant:
            row = [bool(moved), moved[0] if moved else int(t), int(t), *(moved[1:] or layout.numbers({}))]
        else:
            row = [int(t), *row]
        try:
            step = layout.step.pack(*row)
        except OverflowError:  # beyond the board's float
            continue
        count += 1
        yield step


def _inputs(numbers: Sequence[str], layout: Layout) -> list[Any]:
    result: list[Any] = []
    words = iter(numbers)
    for port in layout.inputs:
        result += [int(next(words)) for _ in range(port.held + port.delayed)]
        result += [float.fromhex(next(words)) for _ in range(port.size)]
    return result


# building ------------------------------------------------------------------------------------------------------------


def _run(command: Sequence[str], subject: str, folder: Path) -> str:
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode:
        raise ScenarioError(f"{Path(command[0]).name} refuses {subject}: {done.stderr.strip()[-1500:]}")
    return done.stdout


def _c_files(folder: Path, name: str) -> list[str]:
    """Return the C files of a node, of its link, and those that CasADi has generated."""
    further = json.loads((folder / f"{name}.json").read_text())["sources"]
    return [str((folder / f).resolve()) for f in (f"{name}.c", f"{name}_link.c", *further)]


def _host(folder: Path, name: str, scratch: Path, layout: Layout) -> Path:
    """Return the node as a program of this machine, in the same number type."""
    from .files import filled

    (scratch / "host.c").write_text(filled("board_host.c", name, 0))
    sources = [str(scratch / "host.c"), *_c_files(folder, name)]
    single = ["-DSR_FLOAT"] if layout.single else []
    command = [
        c_compiler(),
        *FLAGS,
        "-D_POSIX_C_SOURCE=200809L",
        *single,
        f"-I{folder.resolve()}",
        "-o",
        "host",
        *sources,
    ]
    _run([*command, "-lm"], f"{name}.c", scratch)
    return scratch / "host"


def _arduino(folder: Path, name: str, scratch: Path, board: str) -> tuple[int, int, int]:
    """Build a sketch as the Arduino IDE does: its core, the sketch as C++, the other files as C."""
    c, cpp = tool("avr-gcc", DEBIAN), tool("avr-g++", DEBIAN)
    core = CORE / "cores" / "arduino"
    if not core.is_dir():
        raise ScenarioError(f"the Arduino core is not installed in {CORE} (Debian: {DEBIAN})")
    sketch = next(folder.glob("*.ino"))
    (scratch / "sketch.cpp").write_text(f'#include <Arduino.h>\n#line 1 "{sketch.name}"\n{sketch.read_text()}')
    files = [*(str(core / f) for f in CORE_FILES), str(scratch / "sketch.cpp"), *_c_files(folder, name)]
    paths = [f"-I{core}", f"-I{CORE / 'variants' / 'standard'}", f"-I{folder.resolve()}"]
    objects = []
    for file in files:
        cxx = file.endswith(".cpp")
        dialect = ["-std=gnu++11", "-fno-exceptions", "-fno-threadsafe-statics"] if cxx else ["-std=gnu11"]
        strict = [] if str(core) in file else ["-Wall", "-fstack-usage"]
        target = f"{Path(file).stem}.o"
        _run([cpp if cxx else c, *AVR, *ARDUINO, *dialect, *strict, *paths, "-c", file, "-o", target], file, scratch)
        objects.append(target)
    elf = str((folder / f"{name}.elf").resolve())
    try:
        _run([c, *AVR, "-Wl,--gc-sections", "-o", elf, *objects, "-lm"], sketch.name, scratch)
    except ScenarioError as error:
        region = re.search(r"region `(\w+)'", str(error))
        if region is None:
            raise
        room = f"{FLASH} bytes of flash" if region[1] == "text" else f"{RAM} bytes of RAM"
        raise ScenarioError(f"{name} does not fit an Uno: it takes more than {room}") from None
    return *_sizes("avr-size", elf), _stack("avr-objdump", elf, scratch, 2)


def _cortex_m(folder: Path, name: str, scratch: Path, board: str) -> tuple[int, int, int]:
    compiler = tool("arm-none-eabi-gcc", TOOLS)
    tool("qemu-system-arm", TOOLS)
    elf = str((folder / f"{name}.elf").resolve())
    sources = [str((folder / "main.c").resolve()), *_c_files(folder, name)]
    flags = [*FLAGS, "-mthumb", *BOARDS[board][1], "-ffunction-sections", "-fdata-sections", "-fstack-usage"]
    linked = ["-nostartfiles", "--specs=nosys.specs", "-T", str((folder / "board.ld").resolve()), "-Wl,--gc-sections"]
    objects = [f"{Path(source).stem}.o" for source in sources]
    for source, target in zip(sources, objects, strict=True):
        _run([compiler, *flags, "-c", source, "-o", target], source, scratch)
    _run([compiler, *flags, *linked, "-o", elf, *objects, "-lm"], f"{name}.c", scratch)
    return *_sizes("arm-none-eabi-size", elf), _stack("arm-none-eabi-objdump", elf, scratch, 0)


def _sizes(tool: str, elf: str) -> tuple[int, int]:
    """Return bytes of flash and of static data."""
    text, data, bss, *_ = _run([tool, elf], elf, Path(elf).parent).splitlines()[1].split()
    return int(text) + int(data), int(data) + int(bss)


_FUNCTION = re.compile(r"^[0-9a-f]+ <([\w.$]+)>:$")
_CALL = re.compile(r"\s(?:r?call|r?jmp|bl|b|b\.n|b\.w|bl\.w)\s.*<([\w.$]+)>")
_PUSH = re.compile(r"\s(?:v?push|stmdb)\s+(?:r\d+$|(?:sp!, )?\{(.*)\})")
_WORD = 4


def _stack(tool: str, elf: str, scratch: Path, address: int) -> int:
    """Return the deepest stack from `main` on: the sum of the compiler's stack sizes along the calls in the code.

    Parameters
    ----------
    address : int
        Bytes used by a call itself.
    """
    usage: dict[str, int] = {}
    for file in scratch.glob("*.su"):
        for line in file.read_text().splitlines():
            location, size, _ = line.split("\t")
            usage[location.rpartition(":")[2].rpartition(" ")[2]] = int(size)
    calls: dict[str, set[str]] = {}
    pushed: dict[str, int] = {}
    now = ""
    for line in _run([tool, "-d", "--no-show-raw-insn", elf], elf, scratch).splitlines():
        if match := _FUNCTION.match(line):
            now = match[1]
            calls[now], pushed[now] = set(), 0
        elif match := _CALL.search(line):
            calls[now].add(match[1].partition("+")[0])
        elif match := _PUSH.search(line):
            pushed[now] += 1 if match[1] is None else _WORD * len(match[1].split(","))
    depths: dict[str, int] = {}

    def depth(name: str, above: tuple[str, ...]) -> int:
        if name in above:
            return 0
        if name not in depths:
            inner = [address + depth(c, (*above, name)) for c in calls.get(name, ()) if c != name]
            depths[name] = usage.get(name, pushed.get(name, 0)) + max(inner, default=0)
        return depths[name]

    return depth("main", ())
