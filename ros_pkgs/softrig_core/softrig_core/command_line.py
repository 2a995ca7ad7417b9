"""Common parts of all command lines: every mistake is reported in one line that states what was expected."""

from __future__ import annotations

import argparse
import math
import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NoReturn

from .errors import ScenarioError, closest

#: What options that take ``NAME=VALUE`` are called, here or in another verb.
NAMING = {"set", "draw", "grid", "over", "param", "params", "parameter", "parameters", "range", "vary", "sweep"}


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
        try:  # Python alone takes 1_000 and the digits of other scripts
            value = self.kind(text) if text.isascii() and "_" not in text else math.nan
        except ValueError:
            value = math.nan
        if self.low <= value <= self.high and math.isfinite(value):
            return value
        noun = "a whole number" if self.kind is int else "a number"
        bound = f"of at least {self.low:g}" if math.isinf(self.high) else f"from {self.low:g} to {self.high:g}"
        raise argparse.ArgumentTypeError(f"expected {noun} {bound}, got {text!r}")


def named(text: str, option: str, form: str) -> tuple[str, str]:
    """Split the value of an option, ``NAME=...``; raise a ScenarioError with the expected form."""
    name, _, value = (part.strip() for part in text.partition("="))
    if not (name and value):
        raise ScenarioError(f"{option} {text!r}: expected NAME={form}")
    if name.endswith(":"):  # the syntax of ROS remapping
        raise ScenarioError(f"{option} {text!r}: expected {name[:-1]}={value}, without the colon of ros2")
    return name, value


def pair(text: str) -> str:
    """Return ``NAME=VALUE`` or ``NAME+=VALUE`` without spaces around its sign: type of an option that is so named."""
    return re.sub(r"\s*(\+?=)\s*", r"\1", text.strip(), count=1)


def repeated(parser: Any, name: str, metavar: str, text: str, kind: Callable[[str], Any] = str) -> None:
    """Declare an option that may be given several times, with a list of its values in their order."""
    parser.add_argument(name, action="append", type=kind, default=[], metavar=metavar, help=text)


def check_text(words: Iterable[str]) -> None:
    """Refuse names with bytes that are no text: bags, metrics, tables and pages record names.

    Raises
    ------
    ScenarioError
        Names the word.
    """
    for word in words:
        try:
            word.encode()
        except UnicodeEncodeError:
            raise ScenarioError(f"{word!a}: expected a name that is text in UTF-8; rename it") from None


def _half(value: object) -> bool:
    """Return whether an option of the form ``NAME=VALUE`` got a name alone, as in `--set a = 2`."""
    return isinstance(value, list) and any(isinstance(text, str) and not text.partition("=")[2] for text in value)


def without_ros(arguments: Sequence[str]) -> list[str]:
    """Remove ``--ros-args ... --``, which launch passes to every executable, also to a tool without a node."""
    remaining, ros = [], False
    for word in arguments:
        if word == "--ros-args" or (ros and word == "--"):
            ros = word == "--ros-args"
        elif not ros:
            remaining.append(word)
    return remaining


class Parser(argparse.ArgumentParser):
    """A parser whose errors are one line, with the nearest existing word for a misspelt one.

    A shell that completes a command line (argcomplete) is answered in place of parsing.

    Parameters
    ----------
    meant : mapping of str to str
        Words that users mistake for a subcommand, and the command that they mean.
    surplus : str
        What a second word in the place of the only positional one asks for.
    """

    def __init__(self, *args: Any, meant: Mapping[str, str] | None = None, surplus: str = "", **options: Any) -> None:
        super().__init__(*args, **options)
        self.meant, self.surplus = dict(meant or {}), surplus
        self._negative_number_matcher = re.compile(r"-\.?\d")  # pattern of Python 3.14; before it -1e-3 is an option

    def parse_args(self, args: Any = None, namespace: Any = None) -> Any:  # type: ignore[override]
        """Parse the arguments, or print completions of the word that the user is typing."""
        if "_ARGCOMPLETE" in os.environ:
            import argcomplete

            argcomplete.autocomplete(self, always_complete_options=False)  # and the process ends
        return super().parse_args(args, namespace)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> tuple[Any, list[str]]:
        """Parse, and refuse the rest here, where the options are known."""
        result, remaining = super().parse_known_args(args, namespace)
        if remaining:
            self.error(self._unexpected(result, remaining[0]))
        return result, remaining

    def _unexpected(self, result: argparse.Namespace, word: str) -> str:
        """Describe a word that no option accepts, and the likely intention."""
        from difflib import get_close_matches

        pairs = [a for a in self._actions if a.option_strings and "NAME=" in str(a.metavar)]
        named = " or ".join(a.option_strings[0] for a in pairs)
        if not word.startswith("-"):
            if any(_half(getattr(result, a.dest, None)) for a in pairs):
                return f"unexpected argument {word!r}; NAME=VALUE is one word, without spaces"
            if "=" in word and named:
                return f"unexpected argument {word!r}; each NAME=... has its own option before it, {named}"
            return f"unexpected argument {word!r}" + (f"; {self.surplus}" if self.surplus else "")
        name = word.partition("=")[0].lstrip("-")
        options = {o.lstrip("-"): o for a in self._actions for o in a.option_strings if o.startswith("--")}
        values = {c: a for a in self._actions if a.option_strings for c in a.choices or ()}
        near = get_close_matches(name, [o for o in options if len(name) > 1], 1)
        if name in values:
            near_text = f" (did you mean '{values[name].option_strings[0]} {name}'?)"
        elif named and (name in NAMING or not near):
            near_text = f"; parameters are named by {named}"
        else:
            near_text = f" (did you mean {options[near[0]]!r}?)" if near else ""
        return f"unexpected option {word!r}{near_text}"

    def error(self, message: str) -> NoReturn:
        """Raise the error that the command line turns into one line and status 2.

        Raises
        ------
        ScenarioError
        """
        wrong = re.match(r"argument (\S+): invalid choice: '(.*)' \(choose from (.*)\)", message)
        if wrong:
            known = [name.strip(" '") for name in wrong[3].split(",")]
            near = f" (did you mean `{self.meant[wrong[2]]}`?)" if wrong[2] in self.meant else closest(wrong[2], known)
            message = f"{wrong[1]} {wrong[2]!r} is unknown{near}; expected {', '.join(known)}"
        verb = self.prog.partition(" ")[2]
        prefix = f"{verb}: " if verb else ""
        raise ScenarioError(f"{prefix}{message}; `{self.prog} --help` shows what there is")


def export_parser(kind: str, description: str) -> Parser:
    """Create the parser of ``softrig export KIND``, whose first argument is a scenario."""
    parser = Parser(prog=f"softrig export {kind}", description=description)
    parser.add_argument("scenario", help="name or YAML file")
    return parser
