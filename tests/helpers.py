"""Helpers of tests in several folders."""

import argparse
import math
from pathlib import Path

import numpy as np
import pytest
from softrig_core import RunError
from softrig_core.renamed import executables
from softrig_core.rig.installed import load_block


class Transformer:
    """An ideal transformer as the matching: the source sees R = load / d^2."""

    def load(self, command, seen):
        return seen * command**2

    def command(self, seen, load):
        return math.sqrt(load / seen)


def near(expected):
    return pytest.approx(expected, rel=1e-9, abs=1e-9)


def outcome(function, *arguments, **words):
    """The result of a function, or the line of its error."""
    try:
        return repr(function(*arguments, **words))
    except (RunError, ValueError, TypeError, KeyError, argparse.ArgumentTypeError) as error:
        return f"{type(error).__name__}: {error}"


def interpreted(monkeypatch, module, *names):
    """Have Python run compiled functions of a module: their compilation does not pay for a few calls."""
    for name in names:
        monkeypatch.setattr(module, name, getattr(module, name).py_func)
    return module


def two_port(series, shunt, length):
    """Admittance (2, 2) of a line with distributed impedance and admittance per km."""
    k, z = np.sqrt(series * shunt) * length, np.sqrt(series / shunt)
    return np.array([[1 / np.tanh(k), -1 / np.sinh(k)], [-1 / np.sinh(k), 1 / np.tanh(k)]]) / z


def blocks(defaults=True):
    """Yield (package, executable, class) of all blocks, or of those whose parameters all have defaults."""
    for file in sorted(Path(__file__).parents[1].glob("ros_pkgs/*/setup.cfg")):
        for name in executables(file.parent.name):
            try:
                block = load_block(file.parent.name, name)
                if defaults:
                    block.Params()
            except ValueError:  # an executable that is a tool, or a block without defaults
                continue
            yield file.parent.name, name, block
