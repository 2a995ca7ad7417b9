"""The words of the command line: each verb with all of its options, as `tests/expected/words.txt` has them."""

import argparse

from softrig_bringup.cli import make_parser
from softrig_core.command_line import Number
from told import check_told

KINDS = {argparse._StoreAction: "", argparse._StoreTrueAction: "switch", argparse._AppendAction: "several"}


def kind(of):
    """What is read: a number with its bounds, or the name of what reads it."""
    if isinstance(of, Number):
        return f"{of.kind.__name__} from {of.low:g} to {of.high:g}"
    return getattr(of, "__name__", "str")


def words(parser, verb, under=()):
    """A verb and its options, a line each: how it is said, what is read, how often, what it is without."""
    beside = {k: v for k, v in parser._defaults.items() if k != "verb"}
    called = parser._defaults.get("verb")
    yield " ".join([verb, *([f"calls {called.args[0]}"] if called else []), *(f"{k}={v!r}" for k, v in beside.items())])
    together = {a.dest: k for k, g in enumerate(parser._mutually_exclusive_groups, 1) for a in g._group_actions}
    for a in parser._actions:
        if isinstance(a, argparse._SubParsersAction):
            yield f"  {a.metavar}{'' if a.required else ', or nothing'}"
            for name, sub in a.choices.items():
                yield from (f"    {line}" for line in words(sub, name))
        elif not isinstance(a, argparse._HelpAction):
            said = [" ".join(a.option_strings) or a.dest, KINDS.get(type(a), type(a).__name__), kind(a.type)]
            said += (
                [f"into {a.dest}"] if a.option_strings and a.option_strings[-1][2:].replace("-", "_") != a.dest else []
            )
            said += [f"one of {' '.join(a.choices)}"] if a.choices else []
            said += [f"times {a.nargs}"] if a.nargs not in (None, 0) else []
            said += [f"alone {a.const!r}"] if a.nargs == "?" and a.const is not None else []
            said += [f"else {a.default}"] if a.default not in (None, False, argparse.SUPPRESS) else []
            said += ["not said otherwise"] if a.default is argparse.SUPPRESS else []
            said += ["wanted"] if a.required and a.option_strings else []
            said += [f"alone of {together[a.dest]}"] if a.dest in together else []
            yield f"  {', '.join(filter(None, said))}"


def test_all_verbs_and_options_are_as_told():
    check_told("words", words(make_parser(), "softrig"))
