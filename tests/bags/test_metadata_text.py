"""The text of a bag's metadata equals that of ruamel.yaml, byte for byte, for any content."""

import json
from string import printable

from hypothesis import example, given, settings, strategies as st
from softrig_bags.content.topics import qos
from softrig_bags.files.yaml_text import _by_ruamel, qos_dicts, to_yaml

WORDS = st.one_of(
    st.text(max_size=9),
    st.text(printable, max_size=12),
    st.text("yYnNoOfFtTrRuUeE01.:-_+~=<>#&*!|'\"%@`[]{},?/\\x\n\t ", max_size=8),
    st.from_regex(r"[0-9:.eE+\-_]{1,10}", fullmatch=True),
    st.dictionaries(st.text(max_size=4), st.integers() | st.text(max_size=4), max_size=3).map(json.dumps),
)


@settings(max_examples=30)
@given(WORDS, WORDS)
@example("it's", "")
@example("'", "on")
@example("\x85", "1e5")
@example("\U0001f3fb", "2020-01-01")
@example("a\nb", "a\n\nb\n")
def test_metadata_is_equal_to_what_ruamel_writes(name, value):
    content = {
        "version": 9,
        "topics": [{"name": name, "offered": qos_dicts([qos(), qos(depth=1)])}],
        "none": [],
        "custom_data": {"k": value, name: "x"},
        "last": 0.5,
        "flag": False,
    }
    assert to_yaml(content) == _by_ruamel(content)


def test_most_metadata_needs_no_ruamel(monkeypatch):
    monkeypatch.setattr("softrig_bags.files.yaml_text._by_ruamel", None)
    assert to_yaml({"a": "on", "b": "", "c": '{"k": 1}', "d": qos_dicts([qos()])}).startswith("a: on\nb: ''\n")
