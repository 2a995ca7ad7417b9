"""Two messages that belong together, field by field: numbers within tolerances, texts and lengths as they are."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from softrig_core import SECOND
from softrig_core.wire.cdr import NUMBER

from .block import Block, Bytes
from .layouts import Decoder, Template

JOINTS = {"sensor_msgs/msg/JointState": "name/", "trajectory_msgs/msg/JointTrajectory": "joint_names/"}
DURATION = "points/0/time_from_start/"

Groups = list[tuple[NDArray[np.intp], Template | None, Bytes]]
#: Gets a label and the values of both messages in many pairs, shape (n,) or (n, elements); None: it is not there.
Visit = Callable[[NDArray[np.intp], str, Any, Any], None]


def groups_of(decoder: Decoder | None, block: Block, rows: NDArray[np.intp]) -> Groups:
    """Return some messages of a block by shape; those that cannot be decoded one by one, without a template."""
    starts, size = block.at[rows], block.size[rows]
    if decoder is None:
        return [
            (np.array([k]), None, block.raw[a : a + n][None]) for k, (a, n) in enumerate(zip(starts, size, strict=True))
        ]
    result = decoder.groups(block.raw, starts, size)
    return [(chosen, layout if isinstance(layout, Template) else None, data) for chosen, layout, data in result]


def visit_pairs(msgtype: str, a: Groups, b: Groups, visit: Visit) -> None:
    """Show the fields of all pairs: row k of one belongs to row k of the other.

    Parameters
    ----------
    a, b
        From `groups_of`, each of all rows.
    visit : callable
        See `Visit`; called for each field of messages of like shapes.
    """
    for chosen_a, made_a, data_a in a:
        for chosen_b, made_b, data_b in b:
            rows, at_a, at_b = np.intersect1d(chosen_a, chosen_b, assume_unique=True, return_indices=True)
            if len(rows):
                _visit_group(msgtype, rows, made_a, data_a[at_a], made_b, data_b[at_b], visit)


def _visit_group(
    msgtype: str,
    rows: NDArray[np.intp],
    made_a: Template | None,
    data_a: Bytes,
    made_b: Template | None,
    data_b: Bytes,
    visit: Visit,
) -> None:
    if made_a is None or made_b is None:
        for k, a, b in zip(rows, data_a, data_b, strict=True):
            visit(np.array([k]), *bytes_that_differ(a.tobytes(), b.tobytes(), "bytes"))
        return
    fields_a, fields_b = (dict(_fields(msgtype, *side)) for side in ((made_a, data_a), (made_b, data_b)))
    for label in dict.fromkeys([*fields_a, *fields_b]):
        visit(rows, label, fields_a.get(label), fields_b.get(label))


def bytes_that_differ(a: bytes, b: bytes, label: str) -> tuple[str, list[str], list[str]]:
    """Return a label and eight bytes of either message from the first on that differs, as hexadecimal texts."""
    index = next((i for i, (p, q) in enumerate(zip(a, b, strict=False)) if p != q), min(len(a), len(b)))
    return label.format(at=index), [a[index : index + 8].hex()], [b[index : index + 8].hex()]


def _fields(msgtype: str, layout: Template, data: Bytes) -> Iterator[tuple[str, Any]]:
    """Return all that messages of a shape hold, but stamps: numbers, texts as lists, arrays too long for columns."""
    columned = {leaf.at for _, leaf, _ in layout.labels}
    blocks: dict[int, NDArray[Any]] = {}
    for label, leaf, k in layout.labels:
        if leaf.at not in blocks:
            result = layout.values(data, leaf)
            blocks[leaf.at] = result if leaf.kind in ("i8", "u8") else result.astype(np.float64)
        yield label, blocks[leaf.at][:, k]
    texts: dict[str, list[str]] = {}
    joints: list[list[str]] = []
    for leaf in layout.leaves:
        if leaf.text and leaf.path.startswith(JOINTS.get(msgtype, "/")):
            joints.append(layout.texts(data, leaf))
            texts["name"] = []
        elif leaf.text:
            _add_text(msgtype, texts, leaf.path, layout.texts(data, leaf))
        elif leaf.n and leaf.at not in columned and leaf.at not in (layout.stamp_at, layout.stamp_at + 4):
            if msgtype in JOINTS and leaf.path.startswith(DURATION):
                continue
            yield leaf.path, layout.values(data, leaf).astype(np.float64)
    if joints:
        texts["name"] = [_in_order(row) for row in zip(*joints, strict=True)]
    yield from texts.items()
    if msgtype == "trajectory_msgs/msg/JointTrajectory" and not any(
        x.startswith(DURATION) for x, _, _ in layout.labels
    ):
        ends = {leaf.path: layout.values(data, leaf)[:, 0] for leaf in layout.leaves if leaf.path.startswith(DURATION)}
        if ends:
            yield "time_from_start", ends[f"{DURATION}sec"] + ends[f"{DURATION}nanosec"] / SECOND


def _in_order(names: Sequence[str]) -> str:
    """Return the joints of a message in one order: their values are compared by name, unless a name occurs twice."""
    return ", ".join(sorted(names) if len(set(names)) == len(names) else names)


def _add_text(msgtype: str, texts: dict[str, list[str]], path: str, result: list[str]) -> None:
    """Name texts of the suite's own types as it does; the number of an array is no part of its label."""
    if path == "header/frame_id" and msgtype in FRAMED:
        texts["frame_id"] = result
    elif msgtype == "std_msgs/msg/Float64MultiArray":
        texts[path] = [text.partition(NUMBER)[0] for text in result]
    else:
        texts[path] = result


FRAMED = {
    *JOINTS,
    *(f"geometry_msgs/msg/{name}" for name in ("Vector3Stamped", "WrenchStamped", "PoseStamped")),
}
