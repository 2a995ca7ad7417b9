"""Hostile numbers and files: bounds of every parameter, set-ups that fail, absurd lengths, and a short campaign."""

import itertools
import math
import re
import sys
from pathlib import Path
from typing import Literal, get_args, get_origin

import pytest
from conftest import PATIENCE, make_scenario
from pydantic import BaseModel, ValidationError, model_validator
from softrig_bringup.cli import main
from softrig_bringup.falsify import definition as falsification
from softrig_bringup.study import definition as study
from softrig_bringup.verbs import golden
from softrig_core import (
    Block,
    BlockParams,
    ParameterError,
    RunError,
    ScenarioError,
    check_steps,
    load_scenario,
    number,
    param,
    rig_of,
)
from softrig_core.block.answer import admit
from softrig_core.block.params import LONGEST, Params, build, declarations
from softrig_core.judge import claims, expectation, requirement_entry
from softrig_core.rig.options import RunOptions
from softrig_core.scenario import changes, scenario
from softrig_core.verdict.figures import figures_of
from softrig_nodes.processes.domain import free_domain

sys.path.insert(0, str(Path(__file__).parents[1] / "campaign"))

import driver
import messages
from parameters import blocks

import bags


class SizeParams(BlockParams):
    """A size within whose bounds memory may run out, and numbers that overflow together."""

    a: float = param(1.0, "factor", gt=0.0)
    b: float = param(1.0, "exponent")
    names: tuple[str, ...] = param((), "names")
    text: str = param("", "text")


class Size(Block[SizeParams]):
    """Fails in set-up for some parameters."""

    def setup(self):
        self.x = self.p.a**self.p.b


def test_every_number_of_every_executable_has_bounds():
    for package, name, block in blocks():
        for d in declarations(block.Params):
            if d.type in (int, float):
                assert d.lower is not None, (package, name, d)
                assert d.upper is not None, (package, name, d)
                # A count sets an effort or a size, so it needs a smaller bound.
                count = d.type is int and not isinstance(d.default, tuple)
                assert abs(d.upper) <= (2**31 if count else 1e12), (package, name, d)
    assert all(d.upper is not None for d in declarations(RunOptions) if d.type in (int, float))


def refusal(model, values):
    """The message for values of parameters; with an unknown one added, so that nothing is set up."""
    with pytest.raises(ParameterError) as error:
        build(model, values | {"?": 0})
    return str(error.value)


def edges(model, prefix=""):
    """Name, bound, the direction out of it, and whether the bound itself is allowed, of every number of a model."""
    for name, field in model.model_fields.items():
        if isinstance(field.annotation, type) and issubclass(field.annotation, Params):
            yield from edges(field.annotation, f"{prefix}{name}.")
            continue
        whole = field.annotation is int
        for rule in field.metadata:
            for key, out in (("ge", -1), ("gt", -1), ("le", 1), ("lt", 1)):
                if hasattr(rule, key) and (whole or field.annotation is float):
                    yield prefix + name, getattr(rule, key), out, len(key) == 2 and key[1] == "e", whole


def test_every_bound_of_every_executable_holds_at_its_edge():
    """Accepted up to it, refused by name beyond, as declared; messages of checks over all parameters do not matter
    here.
    """
    models = {block.Params for _, _, block in blocks()} | {RunOptions}
    tried = 0
    for model, out in itertools.product(models, (-1, 1)):
        results = [edge for edge in edges(model) if edge[2] == out]

        def refused(sign, out=out, results=results, model=model):
            """Names refused for their range: so many steps beyond the bound, or NaN."""
            values = {
                name: bound
                if sign == 0
                else bound + sign * out
                if whole
                else math.nextafter(bound, sign * out * math.inf)
                for name, bound, _, _, whole in results
            }
            text = refusal(model, values)
            return set(re.findall(r"parameter ([^ ;]+) = [^;]*: input should be (?:greater|less) than", text))

        names = {edge[0] for edge in results}
        assert refused(1) == names, (model, out)
        assert refused(0) == {edge[0] for edge in results if not edge[3]}, (model, out)
        assert refused(-1) <= names - refused(0), (model, out)
        floats = {edge[0] for edge in results if not edge[4]}
        text = refusal(model, dict.fromkeys(floats, math.nan))
        assert floats == set(re.findall(r"parameter ([^ ;]+) = nan: ", text)), (model, out)
        tried += len(names)
    assert tried > 300
    assert RunOptions().duration == 0.0  # a node started by hand runs until it is stopped
    for values in ({"seed": 2**63 - 1}, {"seed": 126}, {"duration": 1e9, "timeout": 1e6}):
        assert build(RunOptions, values).model_dump().items() >= values.items()


@pytest.mark.long
def test_every_live_number_can_be_set_up_at_the_edges_of_its_range():
    """Each value that a range accepts is set up, or refused with a message, and never raises an arithmetic error."""
    tried, wrong = 0, []
    for block in {block for _, _, block in blocks()}:
        for d in declarations(block.Params):
            if not d.live or d.type not in (int, float):
                continue
            for edge in dict.fromkeys((d.lower, d.upper, *((5e-324, 1e-160) if d.type is float else ()))):
                value = (edge,) * len(d.default) if isinstance(d.default, tuple) else edge
                try:
                    block(**{d.name: value})
                except ParameterError as error:
                    wrong += [(block, d.name, edge, str(error))] if "Error: " in str(error) else []
                tried += 1
    assert wrong == []
    assert tried > 1000


def numbers(model, prefix=""):
    """Name of every number and every list of numbers of a model, with the declaration of its type."""
    for name, field in model.model_fields.items():
        if isinstance(field.annotation, type) and issubclass(field.annotation, Params):
            yield from numbers(field.annotation, f"{prefix}{name}.")
        elif set(re.findall(r"\b(?:float|int|bool)\b", str(field.annotation))) in ({"float"}, {"int"}):
            yield prefix + name, str(field.annotation)


def test_true_is_not_a_number_for_any_parameter_of_any_executable():
    """Alone and in a list; an integer is accepted for a float, and a switch still accepts true."""
    tried = 0
    for model in {block.Params for _, _, block in blocks()} | {RunOptions}:
        lists = {name for name, kind in numbers(model) if "tuple" in kind}
        wanted = {name: [1, True] if name in lists else True for name, _ in numbers(model)}
        text = refusal(model, wanted)
        for name, value in wanted.items():
            # The message names the range or the size.
            other = rf"parameter {re.escape(name)}(?: = {re.escape(str(value))}: |\.\d)"
            assert re.search(other, text), (model, name)
        ones = {name: [1] if name in lists else 1 for name in wanted}
        assert "not true or false" not in refusal(model, ones)
        tried += len(wanted)
    assert tried > 500
    text = refusal(RunOptions, {"pace": True})
    assert "parameter pace = True: expected a number, not true or false" in text
    assert build(RunOptions, {"paused": True, "pace": 1}).model_dump().items() >= {"paused": True, "pace": 1.0}.items()


@pytest.mark.parametrize("what", ["duration", "timeout", "seed", "clock", "changes", "expect", "claims", "figures"])
def test_true_is_not_a_number_in_a_scenario_either(what, tmp_path):
    entries = {
        "changes": "[{at: true, set: {dc_motor_smc.delta: 3.0}}]",
        "expect": "{rise_time: {expected: true}}",
        "claims": "{rise_time: {published: true, verdict: reproduced}}",
        "figures": "{rise_time: {arguments: {signal: $speed, start: true}}}",
    }
    path = tmp_path / "mine.yaml"
    path.write_text(f"title: Mine\nextends: dc_motor_smc_b2\n{what}: {entries.get(what, 'true')}\n")
    with pytest.raises(ScenarioError, match="expected a number, not true or false"):
        figures_of(rig_of(load_scenario(str(path))))


def test_every_choice_of_every_executable_names_its_words():
    tried = 0
    for model in {block.Params for _, _, block in blocks()}:
        for name, field in model.model_fields.items():
            if get_origin(field.annotation) is Literal:
                words = f"parameter {name} = 'nonsense': input should be {get_args(field.annotation)[0]!r}"
                assert words in refusal(model, {name: "nonsense"}), (model, name)
                tried += 1
    assert tried > 30


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"a": 1e13}, r"parameter a = 10000000000000\.0: expected at most 1e\+12 in magnitude"),
        ({"b": -1e300}, r"parameter b = -1e\+300: expected at most"),
        ({"a": 10**400}, "parameter a = 1000"),
        ({"period": 1e300}, r"parameter period = 1e\+300: input should be less than or equal to 100"),
        ({"period": 1e-12}, "parameter period = 1e-12: expected at least 1e-9"),
        ({"names": ["x"] * (LONGEST + 1)}, "expected at most 10000 values"),
        ({"text": "x" * (LONGEST + 1)}, r"parameter text = 'xxx.*\.\.\.: expected at most 10000 characters"),
    ],
)
def test_absurd_numbers_and_sizes_are_refused(values, text):
    with pytest.raises(ParameterError, match=text) as error:
        build(SizeParams, values)
    assert len(str(error.value)) < 250


def test_a_failing_set_up_names_its_parameters():
    with pytest.raises(ParameterError, match=r"set-up failed with a = 1000000000000\.0, b = 1000000\.0: OverflowError"):
        Size(a=1e12, b=1e6)
    scenario = make_scenario({"plant": {"executable": "plant", "parameters": {}}})
    rig = rig_of(scenario, classes={"plant": Size}, overrides={"plant.a": 1e12, "plant.b": 1e6})
    member = next(m for m in rig.members if m.name == "plant")
    with pytest.raises(ScenarioError, match=r"node plant: set-up failed with a = 1000000000000\.0, b = 1000000\.0"):
        member.block(0)


def test_a_contradiction_names_its_parameters():
    class Pair(BlockParams):
        low: float = param(0.0, "low")
        high: float = param(1.0, "high")

        @model_validator(mode="after")
        def _order(self):
            if self.high - self.low <= 0.0:
                raise ValueError("the range is empty")
            return self

    with pytest.raises(ParameterError, match=r"^parameters: the range is empty \(with low = 2\.0\)$"):
        build(Pair, {"low": 2.0})


def test_a_parameter_is_named_as_a_word_and_a_check_may_divide_by_zero():
    class Line(BlockParams):
        f: float = param(1.0, "factor")
        x: float = param(1.0, "reactance")

        @model_validator(mode="after")
        def _possible(self):
            if self.f < 0.0:
                raise ValueError("half of it is missing")
            1.0 / (self.f * self.x)
            return self

    with pytest.raises(ParameterError, match=r"^parameters: half of it is missing \(with f = -1\.0\)$"):
        build(Line, {"f": -1.0})
    with pytest.raises(ParameterError, match=r"division by zero \(with f = 1e-200, x = 1e-200\)$"):
        build(Line, {"f": 1e-200, "x": 1e-200})


def test_elements_of_a_list_have_bounds():
    class Rules(BlockParams):
        rules: tuple[int, ...] = param((0, 1), "rules", each=(-3, 3))

    assert build(Rules, {"rules": [3, -3]}).rules == (3, -3)
    with pytest.raises(ParameterError, match=r"parameter rules = .*: expected -3 to 3, got 4"):
        build(Rules, {"rules": [0, 4]})


def test_a_set_up_without_memory_names_its_parameters_too():
    class Greedy(Block[SizeParams]):
        def setup(self):
            raise MemoryError

    with pytest.raises(ParameterError, match=r"set-up failed with a = 2\.0: MemoryError"):
        Greedy(a=2.0)


def test_a_period_with_too_many_steps_is_refused():
    check_steps(0.01, 1e-6, "step")
    with pytest.raises(ValueError, match=r"takes 1e\+11 steps of step = 1e-13 s, expected at most 100000"):
        check_steps(0.01, 1e-13, "step")


@pytest.mark.parametrize(("duration", "text"), [(1e300, "duration"), (1e8, "expected at most 1e")])
def test_absurd_lengths_are_refused(duration, text):
    with pytest.raises(ValueError, match=text):
        rig_of(make_scenario({"plant": "plant", "source": "source", "gain": "gain"}, duration=duration))


LONG = "x" * 5000


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (f"extends: {LONG}", "h.yaml: extends 'xxx"),
        (f"{{extends: dc_motor_smc_b2, nodes: {{dc_motor_smc: {{executable: {LONG}}}}}}}", "has no executable 'xxx"),
        (f"{{extends: dc_motor_smc_b2, nodes: {{dc_motor_smc: {{package: {LONG}}}}}}}", "package 'xxx"),
        (f"{{extends: manipulator_adsmc, nodes: {{manipulator_plant: {{parameters: {{urdf: {LONG}}}}}}}}}", "urdf"),
    ],
    ids=["scenario", "executable", "package", "file"],
)
def test_names_longer_than_any_file_name_are_unknown(text, message, tmp_path):
    path = tmp_path / "h.yaml"
    path.write_text(text)
    with pytest.raises(ScenarioError, match=message):
        rig_of(load_scenario(str(path)))


@pytest.mark.parametrize(
    "command",
    [
        ["run", LONG],
        ["run", f"{LONG}.yaml"],
        ["report", LONG],
        ["study", LONG],
        ["node", "softrig_power", "locate", LONG],
    ],
)
def test_arguments_longer_than_any_file_name_are_bad_input(command, capsys):
    assert main(command) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


FILES = (changes, claims, expectation, golden, requirement_entry, scenario, study, falsification)


def written():
    """Models of the files that people write."""
    for module in FILES:
        for model in vars(module).values():
            if isinstance(model, type) and issubclass(model, BaseModel) and model.__module__ == module.__name__:
                yield model


def test_no_number_in_a_users_file_may_be_nan_or_infinite():
    """YAML has both: each field is tried by itself, whatever else its model lacks."""

    def refused(model, name, value):
        try:
            model.model_validate({name: value})
        except ValidationError as error:
            return any(e["loc"][:1] == (name,) for e in error.errors())
        return False

    asked = [
        (model, name)
        for model in written()
        for name in model.model_fields
        if any(not refused(model, name, value) for value in (0.0, 0.5, 2.0))
    ]
    assert {model.__module__ for model, _ in asked} >= {m.__name__ for m in FILES}
    for value in (math.inf, -math.inf, math.nan):
        assert [(m.__name__, name) for m, name in asked if not refused(m, name, value)] == []


def test_an_answer_that_is_not_a_row_of_numbers_is_an_error_of_the_node():
    port = number("x", "x", "m")
    for wrong in (5.0, None, ("a",), (1j,), [[1.0]], (10**400,), ("1.0",), "1", b"1", (b"1",)):
        with pytest.raises(RunError, match="law: x is not a sequence of numbers at t = 0 s"):
            admit({"x": wrong}, port, "law", 0)


@pytest.mark.parametrize("attack", [bags.attack, messages.attack], ids=["bags", "messages"])
def test_damage_is_refused_or_does_not_matter(attack, tmp_path):
    for seed in range(1, 4):
        (tmp_path / f"{seed}").mkdir()
        attack(seed, tmp_path / f"{seed}")


@pytest.mark.long
@pytest.mark.parametrize(
    ("areas", "number"),
    [
        (("parameters", "scenarios"), 1),  # these cases may request all memory, so they run in processes of their own
        (("bags", "messages", "parameters", "scenarios"), 12),
    ],
)
def test_a_short_campaign_passes(areas, number):
    table = driver.campaign(dict.fromkeys(areas, number), 1, PATIENCE, None, 2)
    assert sum(row[0] for row in table.values()) == number * len(areas)
    assert {area: row[2] for area, row in table.items()} == {area: [] for area in table}


@pytest.mark.long
@pytest.mark.processes
@pytest.mark.timeout(3600)
def test_a_campaign_over_the_real_middleware_passes():
    table = driver.campaign({"environments": 20, "kills": 10, "nodes": 30, "starts": 5}, 1, 3000.0, None, 1)
    assert {area: row[2] for area, row in table.items()} == {area: [] for area in table}


@pytest.mark.processes
def test_a_parameter_of_an_unknown_type_is_refused_and_the_node_lives_on():
    import rclpy
    from rcl_interfaces.msg import Parameter, ParameterValue
    from rcl_interfaces.srv import SetParameters
    from rclpy.context import Context
    from rclpy.executors import SingleThreadedExecutor
    from softrig_nodes.ros.ros import ServingNode

    with free_domain() as domain:
        context = Context()
        rclpy.init(context=context, domain_id=domain)
        node = ServingNode("node", context=context)
        node.declare_parameter("x", 1.0)
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(node)
        client = node.create_client(SetParameters, "/node/set_parameters")
        try:
            assert client.wait_for_service(30.0)
            for _ in range(2):
                request = SetParameters.Request(parameters=[Parameter(name="x", value=ParameterValue(type=77))])
                future = client.call_async(request)
                executor.spin_until_future_complete(future, 30.0)
                (result,) = future.result().results
                assert (result.successful, "77" in result.reason) == (False, True), result.reason
        finally:
            executor.shutdown()
            node.destroy_node()
            rclpy.shutdown(context=context)


def test_every_bound_that_a_node_declares_holds_at_its_edge():
    """For live parameters: the range that ROS checks before the block has the bounds of the block."""
    import rclpy
    from rclpy.context import Context
    from rclpy.node import Node
    from rclpy.parameter import Parameter
    from softrig_nodes.ros.messages import range_descriptor

    with free_domain() as domain:
        context = Context()
        rclpy.init(context=context, domain_id=domain)
        node = Node("edges", context=context, enable_rosout=False, start_parameter_services=False)
        try:
            tried = 0
            for number_, model in enumerate({block.Params for _, _, block in blocks()}):
                for d in declarations(model):
                    if not d.live or d.type not in (int, float) or isinstance(d.default, tuple):
                        continue
                    name = f"m{number_}.{d.name}"
                    node.declare_parameter(name, d.default, range_descriptor(d))
                    for bound, out in ((d.lower, -1), (d.upper, 1)):
                        beyond = d.type(bound + out * max(1.0, 0.01 * abs(bound)))
                        for value, used in ((d.type(bound), True), (beyond, False)):
                            result = node.set_parameters([Parameter(name, value=value)])[0]
                            assert result.successful is used, (model, d.name, value, result.reason)
                        tried += 1
            assert tried > 100
        finally:
            node.destroy_node()
            rclpy.shutdown(context=context)
