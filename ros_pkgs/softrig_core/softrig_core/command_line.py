"""What all command lines share: every mistake is one line that says what was expected."""

from __future__ import annotations

import argparse
import math
import os
import re
from collections.abc import Sequence
from typing import Any, NoReturn

from .errors import ScenarioError, closest


class Number:
    """Type of an option that is a number within bounds.

    Parameters
    ----------
    kind : type
        `int` or `float`.
    low, high : float
        Bounds, both allowed; infinity and NaN are not.
    """

    def __init__(self, kind: type[int] | type[float], low: float, high: float = math.inf) -> None:
        self.kind, self.low, self.high = kind, low, high

    def __call__(self, text: str) -> float:
        """Read a number.

        Raises
        ------
        argparse.ArgumentTypeError
            Not a number, or beyond the bounds.
        """
        try:
            value = self.kind(text)
        except ValueError:
            value = math.nan
        if self.low <= value <= self.high and math.isfinite(value):
            return value
        what = "a whole number" if self.kind is int else "a number"
        bound = f"of at least {self.low:g}" if math.isinf(self.high) else f"from {self.low:g} to {self.high:g}"
        raise argparse.ArgumentTypeError(f"expected {what} {bound}, got {text!r}")


def named(text: str, option: str, form: str) -> tuple[str, str]:
    """Split what an option gives, ``NAME=...``; a ScenarioError says the form that is expected."""
    name, _, given = (part.strip() for part in text.partition("="))
    if not (name and given):
        raise ScenarioError(f"{option} {text!r}: expected NAME={form}")
    return name, given


def without_ros(arguments: Sequence[str]) -> list[str]:
    """Remove ``--ros-args ... --``, which launch passes to every executable, also to a tool without a node."""
    rest, ros = [], False
    for word in arguments:
        if word == "--ros-args" or (ros and word == "--"):
            ros = word == "--ros-args"
        elif not ros:
            rest.append(word)
    return rest


class Parser(argparse.ArgumentParser):
    """A parser whose errors are one line, with the nearest of what there is beside what was misspelt.

    A shell that completes a command line (argcomplete) is answered in place of parsing.
    """

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self._negative_number_matcher = re.compile(r"-\.?\d")  # of Python 3.14; before it -1e-3 is an option

    def parse_args(self, args: Any = None, namespace: Any = None) -> Any:  # type: ignore[override]
        """Parse, or say what the word may become that somebody is typing."""
        if "_ARGCOMPLETE" in os.environ:
            import argcomplete

            argcomplete.autocomplete(self, always_complete_options=False)  # and the process ends
        return super().parse_args(args, namespace)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> tuple[Any, list[str]]:
        """Parse, and refuse the rest here, where it is known which options there are."""
        found, rest = super().parse_known_args(args, namespace)
        if rest:
            options = [o for a in self._actions for o in a.option_strings]
            what = "option" if rest[0].startswith("-") else "argument"
            more = "; each NAME=... has its own option before it" if "=" in rest[0] and what == "argument" else ""
            if rest[0].startswith("=") or (
                what == "argument" and {"--set", "--grid"} & {*options} and "=" not in rest[0]
            ):
                more = "; NAME=VALUE is one word, without spaces"
            self.error(f"unexpected {what} {rest[0]!r}{closest(rest[0].partition('=')[0], options)}{more}")
        return found, rest

    def error(self, message: str) -> NoReturn:
        """Raise what the command line turns into one line and status 2.

        Raises
        ------
        ScenarioError
        """
        wrong = re.match(r"argument (\S+): invalid choice: '(.*)' \(choose from (.*)\)", message)
        if wrong:
            known = [name.strip(" '") for name in wrong[3].split(",")]
            message = f"{wrong[1]} {wrong[2]!r} is unknown{closest(wrong[2], known)}; expected {', '.join(known)}"
        verb = self.prog.partition(" ")[2]
        place = f"{verb}: " if verb else ""
        raise ScenarioError(f"{place}{message}; `{self.prog} --help` shows what there is")
