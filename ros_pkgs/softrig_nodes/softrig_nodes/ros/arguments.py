"""ROS arguments of a node: those that rcl refuses are reported in one line with the expected form."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from rclpy.exceptions import NameValidationException, ParameterException
from rclpy.logging import LoggingSeverity, set_logger_level
from rclpy.utilities import remove_ros_args

FLAGS = "-p NAME:=VALUE, -r FROM:=TO, --params-file FILE, --log-level LEVEL, --enclave PATH"
_PLACE = re.compile(r", at /\S+:\d+")  # place in rcl's source, one for each caller
# Parts of a message that do not state the expected form.
_LEXER = re.compile(r"\.? Error: (error not set|Expected lexeme|Expecting token).*")
_PREFIX = re.compile(r"^(Failed to parse ROS arguments|failed to initialize rcl|error creating node): ")
# The first match counts. The texts of rcl and rmw do not state the expected form, or name another rule.
_FORMS = {
    "remap rule: '-r __ns:": "expected __ns:=/NAMESPACE, which begins with a slash",
    "remap rule": "expected FROM:=TO or __node:=NAME, names of letters, digits and _ that begin with no digit",
    "parameter override rule": "expected NAME:=VALUE without spaces, the value as in YAML",
}


@contextmanager
def plain_errors() -> Iterator[None]:
    """Raise errors of rclpy about arguments and names as a ValueError with one line.

    Raises
    ------
    ValueError
        An argument is unknown or has another form, or a name is none.
    """
    with warnings.catch_warnings():
        # Before the error itself rclpy warns that it cannot clean up a half-created node.
        warnings.simplefilter("ignore", RuntimeWarning)
        try:
            yield
        except (RuntimeError, NameValidationException, ParameterException, UnicodeEncodeError) as error:
            raise ValueError(_reason(error)) from error


def non_ros_arguments(argv: Sequence[str]) -> list[str]:
    """Return the arguments after the first that are not ROS arguments.

    Raises
    ------
    ValueError
        One of ROS's arguments is invalid.
    """
    # Otherwise rcl also logs the error that is raised here.
    set_logger_level("rcl", LoggingSeverity.FATAL)
    try:
        with plain_errors():
            return list(remove_ros_args(list(argv))[1:])
    finally:
        set_logger_level("rcl", LoggingSeverity.UNSET)


def _reason(error: Exception) -> str:
    if isinstance(error, UnicodeEncodeError):
        return f"argument {error.object!a}: expected text in UTF-8"
    text = _PREFIX.sub("", _PLACE.sub("", " ".join(str(error).split())))
    if type(error).__name__ == "UnknownROSArgsError":
        return f"unknown ROS arguments {text}: expected {FLAGS}"
    # rmw_fastrtps 8.4 reports the rule with the same number for the name of a node, which does not apply here.
    if "invalid node namespace" in text:
        return "invalid namespace: expected __ns:=/NAME or /NAME/NAME, no slash at the end, at most 245 characters"
    if _LEXER.search(text):
        form = next((form for kind, form in _FORMS.items() if kind in text), f"expected {FLAGS}")
        return f"{_LEXER.sub('', text)}: {form}"
    return text
