"""The verb `set`: live parameters of running nodes, where ros2cli is not there."""

from __future__ import annotations

import argparse
import os
import re
from typing import Any

from softrig_core import ScenarioError
from softrig_core.guard import print_line
from softrig_core.scenario.yaml_file import read_yaml
from softrig_nodes.ros.remote import set_parameters


def set_values(options: argparse.Namespace) -> int:
    """Set parameters of running nodes, node by node; return the exit status: 1 if a node refuses."""
    wanted = _by_node(options.values)
    if options.domain is not None:
        os.environ["ROS_DOMAIN_ID"] = str(options.domain)
    refusals = set_parameters(wanted, options.wait)
    for text in refusals:
        print_line(f"set: {text}")
    return 1 if refusals else 0


def _parts(word: str) -> list[str]:
    """Split ``NODE.PARAM=VALUE``, as the options of other verbs have it."""
    match = re.fullmatch(r"([\w/]+\.[\w.]+)\s*=\s*(.+)", word, re.DOTALL)
    return [match[1], match[2]] if match else [word]


def _by_node(words: list[str]) -> dict[str, dict[str, Any]]:
    """Sort pairs of words by node, values read as YAML."""
    words = [part for word in words for part in _parts(word)]
    if len(words) % 2:
        raise ScenarioError(f"set: {words[-1]!r} has no value, expected NODE.PARAM VALUE")
    result: dict[str, dict[str, Any]] = {}
    for key, text in zip(words[::2], words[1::2], strict=True):
        node, _, parameter = key.partition(".")
        value = read_yaml(text, f"set {key}")
        if not node or not parameter:
            raise ScenarioError(f"set: {key!r}: expected NODE.PARAM")
        types = {type(x) for x in value} if isinstance(value, list) else {type(value)}
        if types == {int, float}:
            value, types = [float(x) for x in value], {float}
        if len(types) > 1 or not types <= {bool, int, float, str}:  # a ROS parameter has a list of one type
            raise ScenarioError(f"set {key}: {text!r} cannot be the value of a parameter")
        result.setdefault(node, {})[parameter] = value
    return result
