"""Data that softrig writes and reads again: what is accepted, and which messages name what is not."""

import json
import math
from dataclasses import FrozenInstanceError, dataclass, field
from typing import Any, Literal

import pytest
from softrig_core.data import KEPT, LEAST, NAME, Data, MisfitError


@dataclass(frozen=True)
class Part(Data):
    size: float
    colour: Literal["red", "green", "blue"] = "red"

    def __post_init__(self):
        if self.size > 9.0:
            raise ValueError(f"{self.size:g} is too much")


@dataclass(frozen=True, kw_only=True)
class Whole(Data):
    title: str
    passed: bool = field(metadata={NAME: "pass"})
    count: int = 0
    width: float | None = field(default=None, metadata={LEAST: 0.0})
    spans: tuple[tuple[float, float], ...] = ()
    report: tuple[int, str] = (0, "")
    parts: dict[str, Part] = field(default_factory=dict)
    listed: tuple[Part, ...] = ()
    more: Any = None
    aside: float = field(default=math.nan, metadata={KEPT: False})


FULL = {
    "title": "t", "pass": True, "count": 3, "width": 1, "spans": [[0, 1.5], [2, 3]], "report": [4, "r"],
    "parts": {"a": {"size": 2, "colour": "blue"}}, "listed": [{"size": 0.5}], "more": [1, {"x": None}],
}  # fmt: skip
LEAVES = {"title": "t", "pass": True}


def test_what_was_written_is_read_again():
    whole = Whole.read(FULL)
    assert (whole.passed, whole.spans, whole.report) == (True, ((0.0, 1.5), (2.0, 3.0)), (4, "r"))
    assert (type(whole.width), whole.parts["a"], whole.listed) == (float, Part(2.0, "blue"), (Part(0.5),))
    written = whole.plain()
    assert list(written) == [*FULL][:8] + ["more"]
    assert Whole.read(json.loads(json.dumps(written))).plain() == written
    assert Whole.read(whole) is whole
    assert Whole.read(LEAVES | {"unknown": 1}).plain() == Whole(title="t", passed=True).plain()
    with pytest.raises(FrozenInstanceError):
        whole.title = "u"


@pytest.mark.parametrize(
    ("raw", "message"),
    [
        ({"title": "t"}, "pass: field required"),
        ([], "input should be an object"),
        (LEAVES | {"title": 3}, "title: input should be a valid string"),
        (LEAVES | {"pass": 1}, "pass: input should be a valid boolean"),
        (LEAVES | {"count": True}, "count: input should be a valid integer"),
        (LEAVES | {"count": 1.5}, "count: input should be a valid integer"),
        (LEAVES | {"width": "2"}, "width: input should be a valid number"),
        (LEAVES | {"width": False}, "width: input should be a valid number"),
        (LEAVES | {"width": -0.5}, "width: input should be greater than or equal to 0"),
        (LEAVES | {"width": math.inf}, "width: input should be a finite number"),
        (LEAVES | {"width": 10**400}, "width: input should be a finite number"),
        (LEAVES | {"spans": [[0, 1], [2]]}, "spans.1: input should be a tuple of 2 values, not 1"),
        (LEAVES | {"spans": "ab"}, "spans: input should be a valid tuple"),
        (LEAVES | {"report": [1, 2]}, "report.1: input should be a valid string"),
        (LEAVES | {"parts": [1]}, "parts: input should be a valid dictionary"),
        (LEAVES | {"parts": {"a": {"size": "x"}}}, "parts.a.size: input should be a valid number"),
        (LEAVES | {"parts": {"a": {"size": 10}}}, "parts.a: value error, 10 is too much"),
        (LEAVES | {"listed": [{"size": 1}, {}]}, "listed.1.size: field required"),
        (LEAVES | {"listed": [3]}, "listed.0: input should be an object"),
        (
            LEAVES | {"listed": [{"size": 1, "colour": "x"}]},
            "listed.0.colour: input should be 'red', 'green' or 'blue'",
        ),
    ],
)
def test_what_does_not_fit_is_refused_with_its_place(raw, message):
    with pytest.raises(MisfitError) as error:
        Whole.read(raw)
    assert str(error.value) == message
