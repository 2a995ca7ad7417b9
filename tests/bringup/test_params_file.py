"""Parameter files of ROS: names, wildcards, precedence and values as in rcl, which rclpy is asked for."""

import math
import random

import pytest
import rclpy
import yaml
from conftest import few
from rclpy.context import Context
from rclpy.node import Node
from softrig_bringup.options import run_options
from softrig_bringup.options.params_file import PARAMS_FILE, matches, params_of, read_sections
from softrig_core import ScenarioError

SPACES = ("", "left", "right", "left/deep")
NODES = ("law", "plant", "left")


def rcl(file, namespace):
    """The parameters that nodes of rclpy in a namespace read from a file; None if rcl refuses it."""
    context = Context()
    try:
        rclpy.init(args=["--ros-args", "--disable-rosout-logs", "--params-file", str(file)], context=context)
    except Exception:
        return None
    result = {}
    for name in NODES:
        node = Node(name, namespace=f"/{namespace}", context=context, start_parameter_services=False)
        result |= {f"{name}.{key}": [] if p.value is None else p.value for key, p in node._parameter_overrides.items()}
        node.destroy_node()
    rclpy.shutdown(context=context)
    return result


def softrig_values(file, namespace):
    try:
        return params_of(file, NODES, namespace)
    except ScenarioError as error:
        return {} if "no such node" in str(error) else None


PARTS = ("law", "plant", "left", "right", "deep", "*", "**")


def drawn(random):
    """A file with some sections, with dotted names, nested names and wildcards; keys of one level differ."""
    root = {}
    for number in range(random.randint(1, 5)):
        path = random.choices(PARTS, weights=(4, 2, 3, 2, 2, 2, 2), k=random.randint(1, 3))
        at = root
        while len(path) > 1 and random.random() < 0.5:
            size = random.randint(1, len(path) - 1)
            at = at.setdefault("/".join(path[:size]), {})
            path = path[size:]
        slash = "/" if at is root and random.random() < 0.5 else ""
        values = at.setdefault(slash + "/".join(path), {}).setdefault("ros__parameters", {})
        values[random.choice("kabc")] = number
        values.setdefault("n", {})[random.choice("xy")] = number + 0.5
    return yaml.safe_dump(root, sort_keys=False)


@pytest.mark.parametrize("seed", few(range(60), 20))
def test_random_files_are_resolved_as_rcl_does(tmp_path, seed):
    """Sixty files, each in one of four namespaces; a thousand of other seeds were compared once."""
    file = tmp_path / "p.yaml"
    generator = random.Random(seed)
    file.write_text(drawn(generator))
    namespace = generator.choice(SPACES)
    assert softrig_values(file, namespace) == rcl(file, namespace), file.read_text()


WORDS = (
    "1 +1 -1 010 0x10 0X1F 0b11 0o17 1_000 1e3 1E3 1.5 .5 5. 1.5.2 .nan .NaN nan .inf -.inf +.inf inf -inf Infinity "
    "1e400 99999999999999999999 true True tRue y Y yes YES n No on Off off 1:30 2024-01-01 1f 08 0x 1e +.5 '1' \"on\""
)


def test_words_become_the_values_that_rcl_makes_of_them(tmp_path):
    file = tmp_path / "p.yaml"
    lines = [f"    v{k}: {word}" for k, word in enumerate(WORDS.split())]
    file.write_text(
        "law:\n  ros__parameters:\n" + "\n".join(lines) + "\n    w: |\n      1\n    e: []\n    l: [yes, no]\n"
    )
    of_rcl, of_softrig = rcl(file, ""), softrig_values(file, "")
    assert [(k, type(v)) for k, v in of_softrig.items()] == [(k, type(v)) for k, v in of_rcl.items()]
    assert all(
        a == b or (math.isnan(a) and math.isnan(b)) for a, b in zip(of_softrig.values(), of_rcl.values(), strict=True)
    )


@pytest.mark.parametrize(
    "text",
    [
        "law: {ros__parameters: {k: [1, 2.5]}}", "law: {ros__parameters: {k: [1, a]}}", "law: {k: 1}",
        "law: {ros__parameters: {k: 1}, left: {ros__parameters: {k: 1}}}", "ros__parameters: {k: 1}",
        "law:\n", "law: {ros__parameters: 3}", "law: {ros__parameters: [1]}", "law: {ros__parameters: {k: [[1], [2]]}}",
        "a: {ros__parameters: &p {k: 1}}\nlaw: {ros__parameters: *p}", "/le*/law: {ros__parameters: {k: 1}}",
        "/***: {ros__parameters: {k: 1}}", "5: {ros__parameters: {k: 1}}", "left: {/law: {ros__parameters: {k: 1}}}",
        "A B: {ros__parameters: {k: 1}}", "law: {ros__parameters: {k: }}", "law/: {ros__parameters: {k: 1}}",
        "left//law: {ros__parameters: {k: 1}}", "law: {ros__parameters: {k: [null, 1]}}",
        "right/law: {ros__parameters: {k: 1, c: {}, b: 1}}",
    ],
)  # fmt: skip
def test_files_that_rcl_refuses_are_refused(tmp_path, text):
    file = tmp_path / "p.yaml"
    file.write_text(text)
    assert rcl(file, "") is None
    with pytest.raises(ScenarioError, match="params file"):
        read_sections(file)


@pytest.mark.parametrize("word", ["null", "~", "Null"])
def test_null_is_refused_as_a_node_refuses_it(tmp_path, word):
    """rcl makes a text of it, which a node does not accept as a number."""
    file = tmp_path / "p.yaml"
    file.write_text(f"law: {{ros__parameters: {{k: {word}}}}}")
    assert rcl(file, "") == {"law.k": word}
    with pytest.raises(ScenarioError, match="k is null: a node refuses it"):
        params_of(file, NODES)


MISREAD = [  # texts that rcl 9.2 reads differently from YAML, so softrig refuses them with the reason
    ("/left: {plant/x: {ros__parameters: {k: 1}}, ros__parameters: {k: 2}}", {"plant.k": 2}, "rcl misreads"),
    ("/left: {plant/: {}, ros__parameters: {k: 2}}", {"plant.k": 2}, "rcl misreads"),
    ("law: {ros__parameters: {k: !!str 1}}", {}, "has the tag tag:yaml.org,2002:str"),
    ("/left/law: {ros__parameters: {k: [[1]]}}", {"law.k": [1]}, "a list of lists"),
]


@pytest.mark.parametrize(("text", "used", "reason"), MISREAD)
def test_values_that_rcl_misreads_are_refused(tmp_path, text, used, reason):
    file = tmp_path / "p.yaml"
    file.write_text(text)
    assert rcl(file, "left") == used
    with pytest.raises(ScenarioError, match=reason):
        params_of(file, NODES, "left")


def test_a_value_that_no_node_accepts_is_skipped_if_it_is_for_another_node(tmp_path):
    file = tmp_path / "p.yaml"
    file.write_text("/right/law: {ros__parameters: {k: null, c: [null]}}\nleft/law: {ros__parameters: {k: 2}}")
    assert softrig_values(file, "left") == rcl(file, "left") == {"law.k": 2}


def test_sections_of_other_nodes_are_skipped_and_reported(tmp_path, capfd):
    file = tmp_path / "p.yaml"
    file.write_text("/left/law: {ros__parameters: {k: 2.0}}\n/right/law: {ros__parameters: {k: 9.0}}")
    assert params_of(file, NODES, "left") == {"law.k": 2.0}
    assert params_of(file, NODES, "/right/") == {"law.k": 9.0}
    printed = capfd.readouterr().err.splitlines()
    assert printed[0].endswith("ignored entries of nodes that this rig does not have: /right/law")
    assert printed[1].endswith("ignored entries of nodes that this rig does not have: /left/law")
    with pytest.raises(ScenarioError, match=r"no such node .of another namespace: --namespace NS"):
        params_of(file, NODES)


def test_a_wildcard_sets_the_parameters_that_each_node_has(tmp_path):
    file = tmp_path / "p.yaml"
    file.write_text("/**: {ros__parameters: {k: 1, use_sim_time: true}}")
    assert params_of(file, NODES, has=lambda node, name: node == "law") == {"law.k": 1}
    with pytest.raises(ScenarioError, match=r"/\*\*: none of its nodes has a parameter 'k'"):
        params_of(file, NODES, has=lambda node, name: False)


def test_a_run_and_a_launch_with_a_namespace_use_their_own_section(tmp_path):
    file = tmp_path / "two.yaml"
    file.write_text(
        "/left/dc_motor_smc: {ros__parameters: {delta: 0.5}}\n/right/*: {ros__parameters: {delta: 9.0, period: 0.01}}\n"
    )
    for namespace, delta in (("left", 0.5), ("/right", 9.0)):
        words = ["dc_motor_smc_b2", "--params-file", str(file), "--namespace", namespace]
        options = run_options.Again().parse_args(words)
        assert run_options.scenario_of(options).nodes["dc_motor_smc"].parameters["delta"] == delta
        again = run_options.Again().parse_args(run_options.repeat(options))
        assert (again.namespace, again.params_file) == (namespace, file)
    with pytest.raises(ScenarioError, match="no such node"):
        run_options.scenario_of(run_options.Again().parse_args(words[:3]))


@pytest.mark.parametrize(
    ("pattern", "name", "is_meant"),
    [("/**", "/a", True), ("/*", "/a/b", False), ("/a/**", "/a", True), ("/**/a", "/a", True), ("/a.b", "/axb", False)],
)
def test_patterns_match_as_in_rcl(pattern, name, is_meant):
    assert matches(pattern, name) is is_meant


def test_parameters_of_every_node_are_left_out_as_the_table_says(tmp_path):
    file = tmp_path / "p.yaml"
    ignored = [name for name, (use, _) in PARAMS_FILE.table.items() if use == "ignored"]
    assert len(ignored) == 4
    file.write_text(yaml.safe_dump({"law": {"ros__parameters": {"k": 1, **{name: {"x": 1} for name in ignored}}}}))
    assert params_of(file, NODES) == {"law.k": 1}


def test_another_length_changes_only_that():
    """A changed run is judged as a changed one, and what the options leave alone is not validated again."""
    words = ["dc_motor_smc", "--set", "dc_motor_smc.delta=20", "--external", "dc_motor_plant"]
    before = run_options.scenario_of(run_options.Again().parse_args(words[:3]))
    after = run_options.scenario_of(run_options.Again().parse_args([*words, "--duration", "0.5", "--seed", "7"]))
    assert (after.duration, after.seed, after.nodes["dc_motor_plant"].external) == (0.5, 7, True)
    assert after.changed_from == before.changed_from == {"dc_motor_smc.delta": None}
    assert after.nodes | {"dc_motor_plant": None} == before.nodes | {"dc_motor_plant": None}
    with pytest.raises(ScenarioError, match="--external motor: no such node"):
        run_options.scenario_of(run_options.Again().parse_args([*words[:1], "--external", "motor"]))
