"""`ros2 run softrig_power locate`: the place of a fault and its confidence, from a COMTRADE file or a bag."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from softrig_bags.read import read_bag
from softrig_bags.write import write_bag
from softrig_core import ParameterError, Recording, RunError, ScenarioError, Signals, vector3
from softrig_core.block.params import build
from softrig_core.command_line import Number, named, without_ros
from softrig_core.guard import guarded
from softrig_core.wire.cdr import parse

from .line.line_file import line_data
from .method.confidence import ErrorBudget, conditions, confidence, describe
from .method.inception import inception, windowed
from .method.location import locate
from .method.objective import LocatorParams
from .records.comtrade_file import ComtradeFileError, read_comtrade
from .records.record import COLUMNS, GROUPS, TOPICS, Record, RecordError

# In ns. No simulated time reaches this, so later stamps are those of a wall clock.
EPOCH = 10**15


def main(arguments: Sequence[str] | None = None) -> int:
    """Read, locate, report; 0 when the fault has a position, 1 when not, 2 for input that cannot be used."""
    return guarded(lambda: _locate(sys.argv[1:] if arguments is None else arguments))


def _locate(arguments: Sequence[str]) -> int:
    options = _parser().parse_args(without_ros(arguments))
    try:
        # Bad parameters are refused before a large file is read.
        _params(options)
        late = (1e-6 * options.late[0], 1e-6 * options.late[1])
        record = read(options.source, [c for c in options.channels.split(",") if c], late)
        p, budget = _params(options, record.frequency), _budget(options, record.sync)
        if options.bag is not None:
            to_bag(record, options.bag)
        window = "as set by --window"
        if options.window is None:
            p, window = windowed(record, p), f"from the change at {inception(record, p.frequency):.6g} s"
    except (ParameterError, ComtradeFileError) as error:
        raise ScenarioError(str(error)) from None
    except RecordError as error:
        print(error, file=sys.stderr)
        return 1
    except KeyError as error:
        raise RunError(str(error.args[0])) from None
    location = locate(record, p)
    trust = confidence(record, p, location, budget) if location.x_km is not None else None
    print(describe(location, trust, p.line.length))
    print(conditions(record, p, window))
    if options.pictures is not None:
        from .pictures import objective, waveforms

        options.pictures.mkdir(parents=True, exist_ok=True)
        waveforms(record, p, options.pictures / "waveforms.png")
        objective(record, p, location, options.pictures / "objective.png", truth=options.truth)
    return 0 if location.x_km is not None else 1


def read(sources: Sequence[Path], channels: Sequence[str] = (), late: tuple[float, float] = (0.0, 0.0)) -> Record:
    """Read a record from a bag (its record, else its four streams) or from one or two COMTRADE files.

    The data of the ends are `late` (s) because of their clocks or filters; this delay is removed.
    """
    if len(sources) == 1 and sources[0].is_dir():
        recording = read_bag(sources[0])
        topic = recording.topics.get("line/record")
        if topic is not None and topic.data:
            values = np.array(parse(topic.msgtype, topic.data[-1]).fields["data"], dtype=np.float64)
            both = Record.from_table(values.reshape(-1, len(COLUMNS)))
            if late[0] == late[1]:
                return both
            return Record.from_ends(both.t - late[0], both.samples[:, :6], both.t - late[1], both.samples[:, 6:])
        first = min((t.times[0] for t in recording.topics.values() if t.times), default=0)
        epoch = first if first > EPOCH else 0  # stamps of a wall clock: t = 0 is the first of them
        return Record.from_signals(Signals(recording, epoch), late)
    return read_comtrade(sources, channels, late)


def to_bag(record: Record, path: Path) -> None:
    """Write a record as the bag that `line_plant` would have left: the four streams."""
    ports = [vector3(name, TOPICS[name], "abc", "V" if name[0] == "u" else "A") for name in GROUPS]
    recording = Recording((p.topic, p.msgtype) for p in ports)
    stamps = [round(t * 1e9) for t in record.t.tolist()]
    for k, port in enumerate(ports):
        encode = port.layout().encode
        for t, values in zip(stamps, record.group(port.name).tolist(), strict=True):
            recording.add(k, t, encode(t, tuple(values)))
    write_bag(path, recording)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="locate",
        description="Locate a line fault from records of both ends.",
        epilog="The line's data are required, by --line or all four by --set line.length=... --set line.r1=... --set "
        "line.l1=... --set line.c1=...",
    )
    parser.add_argument(
        "source",
        nargs="+",
        type=Path,
        metavar="FILE",
        help="a bag, a COMTRADE .cfg with both ends, or two: end S, end R",
    )
    parser.add_argument(
        "--line", metavar="FILE", help="YAML: length (km), r1 (ohm/km), l1 (H/km), c1 (F/km); or paper: Table I"
    )
    parser.add_argument(
        "--set", action="append", default=[], metavar="NAME=VALUE", help="parameters, see fault_locator"
    )
    parser.add_argument(
        "--error",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="uncertainties: sync_us, ratio, reactance, resistance",
    )
    parser.add_argument(
        "--window",
        nargs=2,
        type=Number(float, -1e9, 1e9),
        metavar=("START", "END"),
        help="s in the record; default: found from the fault's inception",
    )
    parser.add_argument(
        "--late",
        nargs=2,
        type=Number(float, -1e9, 1e9),
        default=[0.0, 0.0],
        metavar=("S", "R"),
        help="delay of each end's samples, us (filters, clocks); it is subtracted",
    )
    parser.add_argument("--channels", default="", metavar="A,B,...", help="the twelve COMTRADE channels, see the page")
    parser.add_argument("--bag", type=Path, metavar="DIR", help="also write the record as a bag")
    parser.add_argument("--pictures", type=Path, metavar="DIR", help="waveforms.png and objective.png go here")
    parser.add_argument("--truth", type=Number(float, 0, 1e5), metavar="KM", help="drawn into the picture")
    return parser


def _named(option: str, texts: Sequence[str]) -> dict[str, Any]:
    result: dict[str, Any] = {}
    for text in texts:
        name, value = named(text, option, "VALUE")
        if name in result:
            raise ScenarioError(f"{text!r}: {name} is {result[name]} already")
        result[name] = value
    return result


def _params(options: argparse.Namespace, frequency: float = 0.0) -> LocatorParams:
    """Return the locator's parameters; the recorders' frequency (Hz) unless another is given."""
    values = _named("--set", options.set)
    values |= line_data(options.line, values)
    if frequency > 0.0:
        values.setdefault("frequency", frequency)
    if options.window is not None:
        values |= {"window_start": options.window[0], "window_end": options.window[1]}
    return build(LocatorParams, values)  # type: ignore[return-value]


def _budget(options: argparse.Namespace, sync: float) -> ErrorBudget:
    """Return the error budget; the clocks' own account (s) where it is worse than the default."""
    values = _named("--error", options.error)
    if 1e6 * sync > ErrorBudget().sync_us:
        values.setdefault("sync_us", 1e6 * sync)
    return build(ErrorBudget, values)  # type: ignore[return-value]
