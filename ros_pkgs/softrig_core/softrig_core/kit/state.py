"""Named states whose names depend on parameters."""

from __future__ import annotations

import keyword
import re
from collections import namedtuple
from collections.abc import Iterable
from functools import cache
from typing import Any


def state_type(*groups: tuple[str, Iterable[str]]) -> Any:
    """Return the type of a state, a named tuple.

    Parameters
    ----------
    *groups : (prefix, names)
        One group a quantity: ``("q", ("hip", "knee")), ("v", ("hip", "knee"))`` names the fields q_hip, q_knee, v_hip,
        v_knee. With an empty prefix the names are used alone. A character that a name may not contain becomes ``_``. A
        name that is still invalid gets the prefix ``x_``.
    """
    return _state_type(tuple(_field(f"{p}_{n}" if p else n) for p, names in groups for n in names))


def _field(name: str) -> str:
    name = re.sub(r"\W", "_", name)
    return name if name[:1].isalpha() and not keyword.iskeyword(name) else f"x_{name}"


@cache
def _state_type(names: tuple[str, ...]) -> Any:
    result: Any = namedtuple("State", names)  # type: ignore[misc]

    def reduced(self: Any) -> Any:
        return _state, (names, tuple(self))

    setattr(result, "__reduce__", reduced)  # noqa: B010 - another process makes the type again
    return result


def _state(names: tuple[str, ...], values: tuple[Any, ...]) -> Any:
    return _state_type(names)(*values)
