"""Lists of the parts of scenarios: signals, parameters, figure functions."""

from __future__ import annotations

import inspect

from softrig_core import rig_of
from softrig_core.block.params import LARGEST, declarations, flatten
from softrig_core.guard import plain
from softrig_core.judge.registry import find, registered
from softrig_core.rig.members import signal_units
from softrig_core.wire.signals import short_name


def list_figures(name: str) -> int:
    """Print the figure functions that scenarios may name, or the documentation of one of them."""
    if name:
        function = find(name)
        print(f"{name}{inspect.signature(function)}\n\n{inspect.getdoc(function) or ''}\n")
        print(f"unit: {getattr(function, 'unit', None) or 'as in the scenario'}")
        return 0
    for figure in registered():
        first = (inspect.getdoc(find(figure)) or "").partition("\n")[0]
        print(f"{figure}\t{getattr(find(figure), 'unit', None) or ''}\t{first}")
    return 0


def list_signals(scenario: str) -> int:
    """Print the signals of a scenario: name, unit, publisher and readers.

    If a topic has only one field, the field is left out of the name, as is allowed wherever a signal is named.
    """
    rig = rig_of(scenario)
    units = signal_units(rig)
    source = {p.topic: (m, p) for m in rig.members for p in m.outputs}
    for topic, port in rig.topics.items():
        labels = [f"{topic}/{label}" for label in port.labels]
        for label in labels:
            member, declared = source.get(topic, (None, port))
            readers = ", ".join(m.name for m, _ in rig.readers(member, declared)) if member else ""
            text = f"{member.name if member else 'outside'} -> {readers or '-'}"
            print(f"{short_name(label, units)}\t{units[label] or '1'}\t{port.msgtype.replace('/msg/', '/')}\t{text}")
    return 0


def list_parameters(scenario: str) -> int:
    """Print the parameters of a scenario's nodes: name as in --set, value, unit, bounds, live, description."""
    for member in rig_of(scenario).members:
        values = flatten(member.params)
        for d in declarations(type(member.params)):
            low, high = (f"{x:g}" if x is not None and abs(x) < LARGEST else "" for x in (d.lower, d.upper))
            bounds = f"{low}..{high}" if low or high else ""
            cells = [f"{member.name}.{d.name}", values[d.name], d.unit or "1", bounds, "live" if d.live else "", d.doc]
            print(plain("\t".join(map(str, cells))))
    return 0
