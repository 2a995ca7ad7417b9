"""The content of scenario files and its interpretation, also as expected text (`tests/expected`).

Source: the page scenario_file, as naive models of its rules.
"""

import itertools
import json
import random
import re
from pathlib import Path
from types import SimpleNamespace

import pytest
from expected_text import check_expected
from helpers import outcome
from softrig_core import Port, ScenarioError, array, joint_state, load_scenario, number, param, scalars
from softrig_core.block.block import Block
from softrig_core.block.params import BlockParams
from softrig_core.scenario.changes import ChangeEntry, script
from softrig_core.scenario.faults import FaultEntry, insert
from softrig_core.scenario.node_parameters import NodeParameters
from softrig_core.scenario.places import place
from softrig_core.scenario.port_text import ports_of, ports_text, reader
from softrig_core.scenario.references import fill, fill_parameters, parameter_of, pick
from softrig_core.scenario.scenario import Draft, Scenario
from softrig_core.scenario.scenario_file import inherit, list_scenarios, locate, merge, names, resolve
from softrig_core.scenario.yaml_file import DEPTH, NODES, SIZE, read_mapping, read_yaml, write_yaml

# YAML -----------------------------------------------------------------------------------------------------------------

SCALARS = """
1 -1 +7 007 0x1F 0o17 1e-5 1.5e3 .5 -.5 5. 1_000 0b1 1:30 .inf -.Inf +.INF .nan .NaN true True TRUE false tRue on off
yes no y null Null NULL ~ nUll word '1' "true" 2026-11-26 << = - -- 1-2 0x 0o8 e5 1e5 +1.e+2 .e5
"""


def test_words_and_numbers_are_those_of_yaml_1_2():
    lines = []
    for word in SCALARS.split():
        lines.append(f"{word}: {outcome(read_yaml, f'- {word}', 'here')[1:-1]}")
    check_expected("yaml", lines)


def nested(depth):
    return "[" * depth + "]" * depth


def test_invalid_or_excessive_yaml_is_refused_as_expected():
    few = "a: &a [" + ",".join("1" * 99) + "]\n"
    cases = {
        "nothing": "",
        "as deep as may be": nested(DEPTH),
        "too deep": nested(DEPTH + 1),
        "deep in turn": f"[{nested(DEPTH - 1)}, {nested(DEPTH - 1)}]",
        "a key twice": "a: 1\nb: {c: 1, c: 2}\n",
        "a key twice in one line": "{c: 1, c: 2}",
        "a key that is a list": "? [1]\n: 2\n",
        "a key twice as 1 and 0x1": "1: a\n0x1: b\n",
        "two merges": "a: &a {x: 1}\nb:\n  <<: *a\n  <<: {x: 2}\n",
        "a number of YAML 1.1 and 1.2": "a: 1\nb: -010\n",
        "a decimal comma in braces": "a: {x: 1,5, y: 2}\n",
        "no value in braces": "a: {x: null, y: , z: 2}\n",
        "a control character": 'a: 1\nb: "\\e[31m"\n',
        "merged keys": "a: &a {x: 1, y: 2}\nb: {<<: *a, y: 3}\n",
        "two merged": "a: &a {x: 1}\nc: &c {z: 2}\nb: {<<: [*a, *c], y: 3}\n",
        "an alias in its own anchor": "a: &a [*a]\n",
        "an alias of nothing": "a: *b\n",
        "no end": "a: [1,\n2\n",
        "a tag": "!!python/object:os.system {}",
        "an odd character": "a: \x01",
        "as many values as may be": few
        + "b: ["
        + ",".join(["*a"] * ((NODES - 104) // 100))
        + ("," + ",".join("1" * ((NODES - 104) % 100)) if (NODES - 104) % 100 else "")
        + "]\n",
        "two documents": "--- a\n--- b\n",
        "a long line": "a: " + "x" * 300 + ": y",
    }
    lines = []
    for name, text in cases.items():
        result = outcome(read_yaml, text, "here.yaml")
        if name in ("no end", "an odd character", "two documents", "a long line", "an alias of nothing"):
            result = result.partition("YAML: ")[0]  # drop the words of the YAML library
        lines.append(f"{name}: {result if len(result) < 300 else 'much'}")
    more = cases["as many values as may be"][:-2] + ",1]\n"
    lines.append(f"one more: {outcome(read_yaml, more, 'here.yaml')}")
    lines += [f"{n} characters: {outcome(read_yaml, '#' * n, 'here.yaml')}" for n in (SIZE, SIZE + 1)]
    check_expected("yaml_errors", lines)


def test_a_mapping_is_read_from_a_file_in_utf_8(tmp_path):
    file = tmp_path / "a.yaml"
    for content, reported in {
        "ä: 1\n".encode(): "{'ä': 1}",
        b"\xff: 1\n": "ScenarioError: a.yaml: not valid YAML: 'utf-8' codec can't decode byte 0xff in position 0: "
        "invalid start byte",
        b"[1]\n": "ScenarioError: a.yaml: expected a mapping of keys, got list",
        b"": "ScenarioError: a.yaml: expected a mapping of keys, got NoneType",
    }.items():
        file.write_bytes(content)
        assert outcome(read_mapping, file) == reported


@pytest.mark.parametrize("seed", range(3))
def test_plain_data_is_read_back_as_written(seed):
    rng = random.Random(seed)

    def data(depth):
        kind = rng.choice(["number", "whole", "word", "truth", "none"] + ["list", "mapping"] * 2 * (depth > 0))
        if kind == "list":
            return [data(depth - 1) for _ in range(rng.randrange(4))]
        if kind == "mapping":
            return {rng.choice("abcdefgh") * rng.randint(1, 3): data(depth - 1) for _ in range(rng.randrange(4))}
        return {
            "number": rng.gauss(0, 1e3),
            "whole": rng.randrange(-99, 99),
            "word": rng.choice(["on", "a b", "null", "1e5", "0x1"]),
            "truth": rng.random() < 0.5,
            "none": None,
        }[kind]

    for _ in range(40):
        wanted = data(3)
        assert read_yaml(json.dumps(wanted), "x") == wanted


# what overrides what
# --------------------------------------------------------------------------------------------------


def flat(data, above=()):
    """A mapping as its leaves by the keys that lead to them; an empty one is returned unchanged."""
    if isinstance(data, dict) and data:
        return {k: v for key, one in data.items() for k, v in flat(one, (*above, key)).items()}
    return {above: data}


@pytest.mark.parametrize("seed", range(4))
def test_a_mapping_laid_over_another_replaces_its_leaves(seed):
    """The result has the leaves of the upper mapping, and those of the lower one below no key that the upper one has or
    removes.
    """
    rng = random.Random(seed)

    def tree(depth, none):
        return {
            k: tree(depth - 1, none)
            if depth and rng.random() < 0.5
            else None
            if rng.random() < none
            else rng.randrange(9)
            for k in rng.sample("abc", rng.randint(1, 3))
        }

    for _ in range(60):
        lower, upper = tree(2, 0.0), tree(2, 0.3)
        before = json.dumps([lower, upper])
        over = flat(upper)
        kept = {
            path: v
            for path, v in flat(lower).items()
            if not any(path[: len(p)] == p or p[: len(path)] == path for p in over)
        }
        wanted = kept | {p: v for p, v in over.items() if v is not None}
        assert {p: v for p, v in flat(merge(lower, upper)).items() if v != {}} == wanted
        assert json.dumps([lower, upper]) == before


def test_inherited_and_not_inherited_keys_are_as_expected():
    base = {
        "title": "T",
        "expect": {"a": 1},
        "requirements": {"r": 1},
        "claims": {"c": 1},
        "nodes": {
            "p": {"executable": "x", "parameters": {"g": 1}, "remap": {"a": "b"}},
            "q": {"executable": "y", "parameters": {"h": 2}},
        },
        "figures": {"f": {"function": "peak", "arguments": {"s": 1}, "unit": "m", "since": 2, "label": "l"}},
    }
    lines = [
        f"{change}: {outcome(inherit, base, change)}"
        for change in (
            {},
            {"title": "U", "expect": {"b": 2}},
            {"nodes": {"p": {"executable": "z"}}},
            {"nodes": {"p": {"executable": "x", "parameters": {"k": 3}}, "q": None}},
            {"figures": {"f": {"function": "mean"}}},
            {"figures": {"f": {"unit": "s"}, "g": 1}},
            {"nodes": 5},
            {"nodes": {"p": 5}},
            5,
        )
    ]
    shared = {
        "own": {"a": 1, "b": {"c": "$deep"}},
        "deep": [2, "$$x", "$node.k"],
        "key": "k",
        "loop": "$pool",
        "pool": ["$loop"],
    }
    for value in (
        "$own",
        {"$key": "$deep"},
        ["x", 1.5, True, None, ("$key",)],
        "$none",
        "$loop",
        "$$own",
        "$a.b",
        "pre $own",
    ):
        lines.append(f"{value}: {outcome(fill, value, shared)}")
    lines.append(f"nothing is shared: {outcome(fill, '$x', {})}")
    over = merge(merge({"p": "$own"}, {"p": {"a": 2}}), {"p": {"b": {"d": 3}}})
    lines.append(f"over a reference: {over} is {outcome(fill, over, shared)}")
    values = {"k": 1.5, "times": [1.0, 2.0], "motors.one": 3, "motors.two.x": 4}
    for name in ("k", "times", "times.1", "times.2", "times.x", "motors", "motors.two", "none", "k.0.0"):
        lines.append(f"pick {name}: {outcome(pick, values, name)}")
    for value in ("$node.k", "$$x", "$x", "x", ["$n.a.b", {"k": "$n.b"}], ("$n.c",), 5):
        lines.append(f"{value}: {outcome(fill_parameters, value, lambda *names: names)}")
    params = {"p": Some(), "q": Some(gain=3.0)}
    for node, name in (("q", "gain"), ("p", "gains"), ("r", "gain"), ("p", "row.1")):
        lines.append(f"${node}.{name}: {outcome(parameter_of, 'here: ', params, params.__getitem__, node, name)}")
    check_expected("inherited", lines)


class Some(BlockParams):
    gain: float = param(1.0, "a gain", ge=0.0, live=True)
    size: int = param(2, "a size")
    row: tuple[float, ...] = param((1.0, 2.0), "a row", live=True)


class Law(Block[Some]):
    INPUTS = (joint_state("state", "state", ["x"], position="m"),)
    OUTPUTS = (joint_state("command", "command", ["u"], effort="N"),)


def test_changes_are_passed_to_their_nodes_in_order_of_time():
    def member(name, **more):
        about = {
            "package": "p",
            "executable": "e",
            "block_class": Law,
            "params": Some(),
            "external": False,
            "changes": (),
        }
        return SimpleNamespace(name=name, **about | more)

    lines = []
    for entries in (
        [(0.5, {"a.gain": 2.0, "b.gain": "$a.gain"}), (0.25, {"a.gain": 3.0})],
        [(0.5, {"a.gain": 2.0}), (0.5, {"a.row": [3.0]})],
        [(0.5, {"fault.from": 0.25, "fault.to": 1.0})],
        [(0.5, {"a.from": 0.25})],
        [(0.5, {"aa.gain": 2.0})],
        [(0.5, {"a": 2.0})],
        [(0.5, {"a.gain": -1.0})],
        [(0.5, {"a.size": 3})],
        [(0.5, {"a.period": 3.0})],
        [(0.5, {"out.gain": 2.0})],
        [(0.5, {"a.gain": "$c.gain"})],
        [(1e-9, {"a.gain": 0.0})],
    ):
        members = [
            member("a"),
            member("b"),
            member("fault", package="softrig_control", executable="fault"),
            member("out", external=True),
        ]
        reported = outcome(script, "here", [ChangeEntry(at=at, set=values) for at, values in entries], members)
        lines.append(f"{entries}: {reported if reported != 'None' else ''}")
        lines += [f"  {m.name}: {list(m.changes)}" for m in members if m.changes]
    check_expected("changes", lines)


# faults, ports as text ------------------------------------------------------------------------------------------------


def test_faults_are_inserted_between_a_publisher_and_its_subscribers():
    signal = scalars("signal", "motor/state", {"x": "m"})
    push = array("push", "motor/push", {"k": 2}, "N", delayed=True, limits=(3.0, 4.0))
    ports = {
        "plant": ((push,), (signal,)),
        "law": ((signal,), (push,)),
        "watcher": ((signal.renamed("motor/state"), push), ()),
    }
    nodes = {
        "plant": {"package": "p", "executable": "plant", "parameters": {}, "remap": {}, "external": False},
        "law": {
            "package": "p",
            "executable": "law",
            "parameters": {},
            "remap": {"my/state": "motor/state"},
            "external": False,
        },
        "watcher": {"package": "p", "executable": "w", "parameters": {}, "remap": {}, "external": True},
    }
    params = {"plant": BlockParams(period=0.25), "law": BlockParams(period=0.5)}
    lines = []
    for faults in (
        {"noisy": ("motor/state", {"kind": "noise"})},
        {"noisy": ("motor/state ->  law", {"kind": "noise", "from": 1.0, "to": 2.0, "channels": ["x"]})},
        {"one": ("motor/state", {}), "two": ("motor/state -> law", {}), "three": ("motor/push", {"period": 9.0})},
        {"two": ("motor/state -> law", {}), "one": ("motor/state", {})},
        {"one": ("motor/push->plant", {"holds": False})},
        {"bag": ("motor/state", {})},
        {"law": ("motor/state", {})},
        {"noisy": ("motor/sate", {})},
        {"noisy": ("motor/state -> plant", {})},
        {"noisy": ("motor/state", {"units": ["m"]})},
    ):
        entries = {name: FaultEntry(link=link, **keys) for name, (link, keys) in faults.items()}
        try:
            result = insert("here", entries, nodes, ports, params)
        except ScenarioError as error:
            lines.append(f"{faults}: {error}")
            continue
        lines.append(f"{faults}:")
        for name, entry in result.items():
            lines.append(f"  {name}: {entry if name not in nodes else entry['remap']}")
        assert nodes["law"]["remap"] == {"my/state": "motor/state"}
    lines += [
        f"{link!r}: {outcome(FaultEntry, link=link)[:60]!r}".replace("\\n", " ")
        for link in (" a/b -> c ", "a b", "a -> b -> c", "")
    ]
    check_expected("faults", lines)


def test_ports_are_restored_from_their_text():
    for port in (
        joint_state("a", "t", ["x", "y"], position="m", velocity=["m/s", "1"], limits=(1.0,) * 4, held=True),
        array("a", "t", {"row": 2, "column": 3}, "m", safe=(1.0,) * 6, unchecked=True, sporadic=True),
        number("a", "t", "V"),
    ):
        text = ports_text([port, port.renamed("b")])
        assert ports_of(text) == (port, port.renamed("b"))
        assert set(json.loads(text)[0]) == {"name", "topic", "msgtype", "fields", "units", "safe", "limits"} | {
            f for f in ("channels", "held", "unchecked", "sporadic", "dims") if getattr(port, f)
        }
        read = reader(port, "r")
        assert (read.name, read.held, read.sporadic, read.unchecked, read.safe) == (
            "r",
            False,
            False,
            False,
            (0.0,) * port.size,
        )
        assert reader(port, "r", True).held
    for text in ("{", "[1]", '[{"nme": 1}]', "5", '[{"name": "a", "topic": "t", "msgtype": "none", "units": ["m"]}]'):
        with pytest.raises(ValueError, match=r"^ports: .*; expected a JSON list of ports$"):
            ports_of(text)
    assert isinstance(ports_of("[]"), tuple)
    assert issubclass(Port, object)


# files ----------------------------------------------------------------------------------------------------------------

BASE = """title: T
system: s
source: S
duration: 1.0
nodes:
  plant:
    package: p
    executable: e
    parameters:
      gain: 1.0
      file: beside.csv
plots:
- {title: one, signals: {a: b}}
-
  title: two
  signals: {a: b}
variants:
  fast:
    title: F
    nodes:
      plant: {parameters: {gain: 5.0}}
  40: {title: V}
"""
CHILD = """extends: base_fast
nodes:
  plant:
    parameters: {limit: 3.0}
variants:
  low: {duration: 2.0}
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    for name, text in {
        "one/base": BASE,
        "one/child": CHILD,
        "two/base": "title: other\n",
        "two/base_fast": BASE.replace("title: T", "title: own file"),
        "two/more": "extends: base_40\n",
    }.items():
        path = tmp_path / f"{name}.yaml"
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
    (tmp_path / "one/beside.csv").write_text("1\n")
    monkeypatch.setenv("SOFTRIG_SCENARIOS", f"{tmp_path / 'one'}:{tmp_path / 'none'}:{tmp_path / 'two'}")
    monkeypatch.setenv("AMENT_PREFIX_PATH", "")
    return tmp_path


def test_files_and_their_variants_are_found(folder):
    short = {name: str(path.relative_to(folder)) for name, path in list_scenarios().items()}
    assert short == {
        "base": "one/base.yaml",
        "base_fast": "one/base.yaml",
        "base_40": "one/base.yaml",
        "base_fast_fast": "two/base_fast.yaml",
        "base_fast_40": "two/base_fast.yaml",
        "child": "one/child.yaml",
        "child_low": "one/child.yaml",
        "more": "two/more.yaml",
    }
    assert list(names(folder / "one/base.yaml")) == ["base", "base_fast", "base_40"]
    for name, path in short.items():
        assert locate(name) == (name, folder / path)
    assert locate(str(folder / "two/base_fast.yaml")) == ("base_fast", folder / "two/base_fast.yaml")
    low = resolve("child_low", folder / "one/child.yaml")
    assert (low["title"], low["duration"]) == ("F", 2.0)
    assert low["nodes"]["plant"]["parameters"] == {"gain": 5.0, "limit": 3.0, "file": str(folder / "one/beside.csv")}
    assert resolve("more", folder / "two/more.yaml")["title"] == "V"  # the first folder with the file wins
    broken: list[ScenarioError] = []
    (folder / "one/broken.yaml").write_text("variants: {a b: {}}\n")
    assert "broken" not in {n for n in list_scenarios(broken) if n != "broken"}
    lines = [str(e) for e in broken] + [outcome(list_scenarios)]
    (folder / "one/broken.yaml").unlink()
    (folder / "one/loop.yaml").write_text("extends: pool\n")
    (folder / "one/pool.yaml").write_text("extends: loop\n")
    (folder / "one/list.yaml").write_text("extends: [base]\n")
    for name in ("bas", "child_lo", "none.yaml", "one/none", "loop", "list"):
        reported = outcome(lambda name=name: resolve(*locate(name)))
        lines.append(f"{name}: {reported}")
    check_expected("scenario_files", [line.replace(str(folder), "HERE") for line in lines])


def test_the_place_of_a_key_is_found(folder):
    base, child = folder / "one/base.yaml", folder / "one/child.yaml"
    lines = BASE.splitlines()
    for keys in (
        ("title",),
        ("nodes",),
        ("nodes", "plant"),
        ("nodes", "plant", "parameters", "gain"),
        ("plots",),
        ("plots", 0),
        ("plots", 1),
        ("plots", 1, "signals"),
        ("plots", 1, "signals", "a"),
    ):
        depth = sum(isinstance(k, str) for k in keys)
        line = int(place("base", base, keys).removeprefix("base.yaml, line "))
        last = [k for k in keys if isinstance(k, str)][-1]
        assert last in lines[line - 1] or isinstance(keys[-1], int), (keys, line, depth)
    cases = [
        ("base", base, ("plots", 0)),
        ("base", base, ("plots", 1)),
        ("base", base, ("plots", 2)),
        ("base", base, ("none",)),
        ("base", base, ("nodes", "plant", "none", "deep")),
        ("base_fast", base, ("title",)),
        ("base_fast", base, ("nodes", "plant", "parameters", "gain")),
        ("base_fast", base, ("nodes", "plant", "executable")),
        ("base_40", base, ("title",)),
        ("child", child, ("title",)),
        ("child", child, ("nodes", "plant", "parameters", "limit")),
        ("child", child, ("nodes", "plant", "parameters", "gain")),
        ("child_low", child, ("duration",)),
        ("child_low", child, ("plots", 1)),
        ("child_low", child, ("none",)),
    ]
    check_expected(
        "places", [f"{name} {'.'.join(map(str, keys))}: {place(name, path, keys)}" for name, path, keys in cases]
    )


def test_a_file_that_has_changed_is_read_again(folder):
    assert load_scenario("base").title == "T"
    (folder / "one/base.yaml").write_text(BASE.replace("title: T", "title: changed"))
    assert load_scenario("base").title == "changed"
    (folder / "one/base.yaml").write_text("#" * (SIZE + 1))
    assert outcome(load_scenario, "base") == f"ScenarioError: base.yaml: {SIZE + 1} bytes, expected at most {SIZE}"
    assert list(itertools.islice(names(folder / "two/base.yaml"), 3)) == ["base"]


def test_forbidden_and_overriding_keys_of_a_scenario_are_as_expected():
    node = {"package": "p", "executable": "e"}
    whole = {
        "name": "here",
        "title": "T",
        "system": "s",
        "source": "S",
        "duration": 1.0,
        "nodes": {"a": node, "b": node},
    }
    claim = {"where": "Table 1", "verdict": "reproduced", "published": 1.0}
    more = whole | {
        "shared": {"gain": 1.0, "motor": {"R": 1.0, "L": 2.0}},
        "faults": {"noisy": {"link": "x", "kind": "noise"}},
        "figures": {"peak": {"function": "maximum"}},
    }
    lines = []
    for keys in (
        {},
        {"containers": [["a"], ["b"]]},
        {"containers": [["a", "a"]]},
        {"containers": [["a"], ["c"]]},
        {"trips": ["a", "c"]},
        {"trips": ["b"]},
        {"expect": {"peak": {"equals": 1.0}}},
        {"claims": {"peak": claim}},
        {"claims": {"peak": claim}, "figures": {"peak": {}}},
        {"claims": {"peak": claim | {"verdict": "not_checkable", "reason": "r"}}},
        {"claims": {"x": claim | {"figure": "other.peak"}}},
        {"requirements": {"peak": "always x > 0"}, "figures": {"peak": {}}},
        {"nodes": {}},
        {"nodes": {"9a": node}},
        {"nodes": {"a": node | {"remap": {"x": "a b"}}}},
        {"faults": None, "figures": None, "shared": None},
        {"duration": 0.0},
        {"seed": 2**63},
        {"record": "some"},
    ):
        reported = outcome(Scenario.model_validate, whole | keys)
        first = re.search(r"^  (.*?) \[type=", reported, re.MULTILINE)
        lines.append(f"{keys}: {first[1] if first else 'a scenario'}")
    scenario = Scenario.model_validate(more)
    for overrides in (
        {"a.gain": 2.0, "b.deep.k": 3},
        {"noisy.from": 1.0},
        {"noisy.kind": "loss"},
        {"c.gain": 2.0},
        {"a": 2.0},
        {"aa.gain": 1.0},
    ):
        try:
            new = scenario.changed(overrides=overrides)
        except ScenarioError as error:
            lines.append(f"{overrides}: {error}")
            continue
        lines.append(f"{overrides}: {[n.parameters for n in new.nodes.values()]} {new.faults['noisy'].parameters}")
    assert scenario.changed() == scenario
    assert scenario.changed(duration=2.0).duration == 2.0
    lines.append(outcome(scenario.changed, duration=-1.0))
    lines.append(outcome(scenario.having, titel="x"))
    for overrides in ({"gain": 2.0}, {"motor.R": 5.0}, {"motor": 5.0}, {"gains": 2.0}, {"c.k": 1}, {"a.k": 2}):
        draft = Draft("here", Path("here.yaml"), {k: v for k, v in more.items() if k != "name"})
        result = outcome(lambda d=draft, o=overrides: d.filled(o).shared)
        lines.append(f"{overrides} of a draft: {result}")
        assert draft.raw["shared"] == more["shared"]
    check_expected("scenarios", lines)
    claims = {
        "one": claim,
        "two": claim | {"figure": "peak"},
        "three": claim | {"verdict": "not_checkable", "reason": "r"},
        "four": claim | {"figure": "other.peak"},
        "five": {"where": "w", "verdict": "reproduced", "below": "six", "figure": "peak", "text": "t"},
    }
    known = Scenario.model_validate(more | {"claims": claims, "figures": {k: {} for k in ("one", "peak", "six")}})
    assert known.claimed() == ["one", "peak", "peak", "six"]
    assert (known.written("title"), known.written_in(None) is known) == ("", True)


def test_parameters_of_nodes_may_refer_to_those_of_others():
    def parameters(**nodes):
        entries = {name: {"package": "p", "executable": "e", "parameters": values} for name, values in nodes.items()}
        about = {"name": "here", "title": "T", "system": "s", "source": "S", "duration": 1.0, "nodes": entries}
        return NodeParameters(Scenario.model_validate(about), dict.fromkeys(nodes, Law))

    result = parameters(
        a={"gain": "$b.size", "row": ["$b.row.1", 3.0]}, b={"size": 4, "row": [1.0, "$c.gain"]}, c={"gain": 7.0}
    )
    assert (result("a").gain, result("a").row, result("b").row) == (4.0, (7.0, 3.0), (1.0, 7.0))
    assert result("a") is result("a")
    for nodes, reported in (
        ({"a": {"gain": "$a.size"}}, "here: node a: its parameters refer to themselves: a -> a"),
        (
            {"a": {"gain": "$b.gain"}, "b": {"gain": "$a.gain"}},
            "here: node a: its parameters refer to themselves: a -> b -> a",
        ),
        ({"a": {"gain": "$c.gain"}}, "here: node a: $c.gain: the nodes are a"),
        ({"a": {"gain": "$b.gian"}, "b": {}}, "here: node a: $b.gian: b has period, gain, size, row"),
        ({"a": {"gain": -1.0}}, "here: node a: parameter gain = -1.0: input should be greater than or equal to 0"),
    ):
        with pytest.raises(ScenarioError) as error:
            parameters(**nodes)("a")
        assert str(error.value) == reported


@pytest.mark.parametrize(
    "text", ["1e5", "0o17", "-1e3", ".5e3", "1_000", "on", "1:30", "2026-11-26", "~", "<<", "é: x"]
)
def test_a_text_that_is_written_is_read_as_that_text(text):
    """YAML 1.1 writes 1e5 without quotes, for it is a text there; the reader takes it for a number."""
    content = {"v": text, text: [text, 1e5, 1e-5, 0x1F]}
    assert read_yaml(write_yaml(content), "x") == content
