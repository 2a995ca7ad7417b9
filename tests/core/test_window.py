"""The messages that an observer keeps, against a list: one by one or in batches, in blocks of the smallest size."""

import random

import numpy as np
import pytest
from softrig_core import joint_state, scalars
from softrig_core.block.answer import ReceivedMessages
from softrig_core.block.port import Sample
from softrig_core.verdict import watch
from softrig_core.verdict.watch import EVER, Kept, Seen, left_behind, packed, row_of


class Listed:
    """All new messages, and the start of the window, which never goes back."""

    def __init__(self):
        self.rows, self.since = [], EVER

    def take(self, stamp, values, t, reach):
        self.since = max(self.since, t - reach)
        if not self.rows or stamp > self.rows[-1][0]:
            self.rows.append((stamp, values))

    def inside(self):
        return [row for row in self.rows if row[0] >= self.since]


def rows_of(kept, size):
    stamps = kept.stamps(size)
    columns = [kept.column(size, k, len(stamps)) for k in range(size)]
    assert all(column.flags.c_contiguous for column in columns)
    return list(zip(stamps.tolist(), zip(*(column.tolist() for column in columns), strict=True), strict=True))


def same(kept, listed, size):
    assert rows_of(kept, size) == listed.inside()
    assert kept.forgot == (len(listed.inside()) < len(listed.rows))
    assert kept.stamp == (listed.rows[-1][0] if listed.rows else EVER)
    assert kept.since == listed.since


@pytest.mark.parametrize("seed", range(8))
def test_a_window_has_the_newest_messages_of_a_list(monkeypatch, seed):
    """Stamps that repeat or go back, a window that is lengthened and shortened, both ways in turn."""
    rng = random.Random(seed)
    size = rng.choice([1, 2, 3])
    monkeypatch.setattr(watch, "SOME", rng.choice([1, 40, 100]))
    monkeypatch.setattr(watch, "MANY", rng.choice([1, 100, 300]))
    kept, listed, t, row = Kept(), Listed(), 0, row_of(size)
    same(kept, listed, size)
    for _ in range(40):
        reach = rng.choice([5, 30, 200])
        if rng.random() < 0.5:
            t += rng.randint(0, 6)
            stamp = t - rng.choice([0, 0, 1, 9])
            values = tuple(rng.uniform(-1.0, 1.0) for _ in range(size))
            kept = kept.with_message(row, stamp, Sample(stamp, values) if rng.random() < 0.3 else values, t, reach)
            listed.take(stamp, values, t, reach)
        else:
            stamps = sorted(rng.sample(range(t + 1, t + 60), rng.choice([0, 1, 3, 20])))
            messages = [(s, tuple(rng.uniform(-1.0, 1.0) for _ in range(size))) for s in stamps]
            t += 60
            begun = kept.stamp != EVER
            pieces = (
                ReceivedMessages(np.array(stamps), np.array([v for _, v in messages]))
                if rng.random() < 0.5 and stamps
                else messages
            )
            kept = kept.with_messages(pieces, t, reach)
            for stamp, values in messages:
                listed.take(stamp, values, t, reach)
            if begun:
                listed.take(listed.rows[-1][0], (), t, reach)  # the window moves without a new sample
        same(kept, listed, size)


def test_messages_as_bytes_are_kept():
    assert packed([(3, (1.0, 2.0)), (5, (4.0, 8.0))]) == row_of(2).pack(3, 1.0, 2.0) + row_of(2).pack(5, 4.0, 8.0)
    assert packed(ReceivedMessages(np.array([3]), np.array([[1.0]]))) == row_of(1).pack(3, 1.0)


STATE = joint_state("state", "cart/state", ["x"], position=["m"], velocity=["m/s"])
FLAGS = scalars("flags", "flags", {"on": "", "off": ""})


def test_the_kept_messages_are_read_as_signals():
    one = (
        Kept()
        .with_message(row_of(2), 1_000_000_000, (0.5, -1.0), 0, 1 << 40)
        .with_message(row_of(2), 1_500_000_000, (2.0, 3.0), 0, 1 << 40)
    )
    seen = Seen({"state": STATE, "flags": FLAGS}, {"state": one, "flags": Kept()})
    names = ["cart/state/x/position", "cart/state/x/velocity", *(f"flags/{label}" for label in FLAGS.labels)]
    assert (list(seen), len(seen)) == (names, 4)
    assert [column.tolist() for column in seen[names[1]]] == [[1.0, 1.5], [-1.0, 3.0]]
    assert [column.tolist() for column in seen[names[0]]] == [[1.0, 1.5], [0.5, 2.0]]
    assert [column.tolist() for column in seen[names[2]]] == [[], []]
    for name in ("cart/state/y/position", "cart/state", "cart", "flag/on", ""):
        with pytest.raises(KeyError):
            seen[name]
    assert [seen.topic(name) for name in (names[0], names[3], "elsewhere/x")] == ["cart/state", "flags", ""]


def test_a_step_before_the_kept_messages_is_dropped():
    """A step is a change of a value; without a change the first kept message counts as the step, if there is one."""

    def seen(**rows):
        kept = {name: Kept() for name in ("state", "flags")}
        for name, values in rows.items():
            for k, x in enumerate(values):
                kept[name] = kept[name].with_message(row_of(2), (k + 1) * 10**9, (x, x), 0, 1 << 40)
        return Seen({"state": STATE, "flags": FLAGS}, kept)

    x, on = "cart/state/x/position", "flags/" + FLAGS.labels[0]
    still, steps = [1.0, 1.0, 1.0], [1.0, 1.0, 2.0]
    for state, flags, forgot, expected in (
        (still, still, {"cart/state", "flags"}, True),
        (still, still, {"flags"}, False),
        (steps, still, {"cart/state", "flags"}, False),
        (still, steps, {"cart/state", "flags"}, False),
    ):
        assert left_behind(f"{x}, {on}", seen(state=state, flags=flags), forgot) == expected
    assert left_behind(x, seen(state=still), {"cart/state"})
    assert not left_behind(x, seen(state=steps), {"cart/state"})
