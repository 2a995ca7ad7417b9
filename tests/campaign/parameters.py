"""Extreme parameters for every executable: built, set up and run for a few ticks, or refused in one line."""

import importlib.metadata
import math
import random
import re
import sys
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path

from softrig_core import (
    Block,
    BlockParams,
    Port,
    Recording,
    RunError,
    Sample,
    Scenario,
    ScenarioError,
    Solver,
    param,
    renamed,
    rig_of,
    run_inprocess,
)
from softrig_core.block.params import Declaration, declarations
from softrig_core.rig.installed import load_block

TICKS = 4
NUMBERS = (0.0, -0.0, 5e-324, 1e-300, 1e-12, 1e-3, 1.0, -1.0, 1e6, -1e6, 1e12, -1e12, 0, 1, -1, 2)
SLIPS = (1e300, -1e300, math.nan, math.inf, 2**31, 2**63, 10**400, True, "", "x", "1/3", "1/0", None, [], [[1.0]], {})
EXTREME = (*NUMBERS, *SLIPS)


def executables() -> Iterator[tuple[str, str, type[Block]]]:
    """Return package, executable and block of every node that is installed."""
    for package in sorted({d.name for d in importlib.metadata.distributions() if d.name.startswith("softrig_")}):
        for name in renamed.executables(package):
            try:
                yield package, name, load_block(package, name)
            except ScenarioError:  # the executable is a tool, not a node
                continue


@cache
def blocks() -> list[tuple[str, str, type[Block]]]:
    """List `executables`."""
    return list(executables())


def extreme(declaration: Declaration, chance: random.Random) -> object:
    """Return a value at or beyond a bound, or of another type."""
    default, low, high = declaration.default, declaration.lower, declaration.upper
    edges: list[float] = [bound for bound in (low, high) if bound is not None]
    if chance.random() < 0.6:  # stay within all bounds, so that the model's own checks decide
        inside = [math.nextafter(edge, 0.0) for edge in edges] + [n for n in NUMBERS if edges and low <= n <= high]
        if declaration.type is bool:
            return not default
        if declaration.type in (int, float) and inside and not isinstance(default, list | tuple):
            return declaration.type(chance.choice(inside))
    if isinstance(default, str) and chance.random() < 0.5:
        return chance.choice((default, default[:-1], default * 2, "x" * 20_000, "\x00", "\n", "é"))
    if isinstance(default, tuple | list):
        numbers = list(default)
        if numbers and chance.random() < 0.6:
            numbers[chance.randrange(len(numbers))] = chance.choice((*EXTREME, *edges))
            return numbers
        return chance.choice((numbers[:-1], numbers * 2, numbers * 3000, [0.0] * len(numbers)))
    if isinstance(default, bool):
        return chance.choice((not default, *EXTREME))
    if isinstance(default, int) and edges and chance.random() < 0.5:
        return int(chance.choice(edges))
    if isinstance(default, int | float) and chance.random() < 0.4:
        return type(default)(default * 10.0 ** chance.randint(-15, 15))
    return chance.choice((*EXTREME, *edges))


class FeederParams(BlockParams):
    """A period as long as that of the slowest node."""

    period: float = param(0.01, "period", "s", gt=0.0, le=86400.0)


def feeder(ports: list[Port], seed: int) -> type[Block]:
    """Make a block that publishes what another reads: zeros, safe values, large and small numbers."""

    class Feeder(Block[FeederParams]):
        OUTPUTS = tuple(ports)

        def update(self, x: object, t: int, **inputs: object) -> tuple:
            chance = random.Random(seed + t)
            results: dict = {}
            for port in self.OUTPUTS:
                size = 10.0 ** chance.randint(-6, 4)
                drawn = tuple(max(-most, min(most, chance.gauss(0, size))) for most in port.limits)
                values = port.safe if chance.random() < 0.3 else drawn
                results[port.name] = Sample(t, values) if port.delayed else values
            return x, results

    return Feeder


def attack(seed: int, directory: Path) -> None:
    """One executable with one to three extreme parameters: refused, broken with one line, or run with finite
    numbers.
    """
    chance = random.Random(seed)
    package, executable, block = chance.choice(blocks())
    known = declarations(block.Params)
    values = {d.name: extreme(d, chance) for d in chance.sample(known, min(len(known), chance.choice((1, 1, 2, 3))))}
    (directory / "case").write_text(f"{package} {executable} {values!r}"[:10_000])
    try:
        run_one(package, executable, block, values, seed)
    except (ScenarioError, RunError) as error:
        # The command line truncates a longer text, so the reason must be in the part that it prints.
        text = str(error)[:1000]
        if "victim" not in text:
            raise AssertionError(f"{executable}: the node is not named: {text[:300]}") from None
        if isinstance(error, ScenarioError) and not any(named(name, text) for name in values):
            raise AssertionError(f"{executable}: none of {', '.join(values)} is named: {text[:300]}") from None


def named(parameter: str, text: str) -> bool:
    """Return whether a parameter, or the last part of its dotted name, is a word of a message."""
    return any(re.search(rf"(?<!\w){re.escape(word)}(?!\w)", text) for word in (parameter, parameter.split(".")[-1]))


def run_one(package: str, executable: str, block: type[Block], values: dict, seed: int) -> None:
    """Run a block alone for a few of its periods, fed with numbers."""
    inputs = {p.topic: p for p in _inputs(block, values)}
    ports = [
        replace(p, name=f"out{i}", held=False, partial=False, sporadic=False) for i, p in enumerate(inputs.values())
    ]
    # A solver may take days for random parameters, so it gets a time limit.
    limit = {"limit": 20.0} if issubclass(block, Solver) else {}
    entries = {"victim": {"package": package, "executable": executable, "parameters": limit | values}}
    classes: dict[str, type[Block]] = {"victim": block}
    period = values.get("period", block.Params.model_fields["period"].default)
    if ports:
        entries["feeder"] = {"package": package, "executable": "feeder", "parameters": {"period": period}}
        classes["feeder"] = feeder(ports, seed)
    length = period if isinstance(period, float) and 1e-9 <= period <= 1e6 else 0.01
    about = {"name": "hostile", "title": "", "system": "", "source": "", "seed": seed % 2**31, "nodes": entries}
    rig = rig_of(Scenario.model_validate(about | {"duration": TICKS * length}), classes=classes)
    recording = Recording((t, p.msgtype) for t, p in rig.topics.items())
    run_inprocess(rig, seed, recording)


def _inputs(block: type[Block], values: dict) -> tuple[Port, ...]:
    from softrig_core import ParameterError
    from softrig_core.block.params import build

    try:
        return block.ports(build(block.Params, values))[0]
    except ParameterError:
        return ()  # the rig reports this error itself


if __name__ == "__main__":
    for number in map(int, sys.argv[1:]):
        attack(number, Path("/tmp"))
