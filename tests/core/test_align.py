"""Two bags of different clocks or rates, compared signal by signal."""

import json

import numpy as np
import pytest
from softrig_bags.align import align
from softrig_bags.cli import main_compare
from softrig_bags.compare import Tolerance, compare
from softrig_bags.errors import BagError
from softrig_bags.read import EPOCH, signals
from softrig_bags.write import write_bag
from softrig_core import Recording
from softrig_core.wire.cdr import Layout

STATE = "sensor_msgs/msg/JointState"
LAYOUT = Layout(STATE, "", ["x", "y"], {"position": 2})
EPOCH_NS = 1_700_000_000_123_456_789


def bag(folder, function, period, *, epoch=0, left=False, until=4.0, topic="plant/state", begin=0.0):
    """A bag of one topic with two values, stamped from `epoch` on; `left`: the metadata has the epoch."""
    recording = Recording([(topic, STATE)])
    for k in range(round(begin / period), round(until / period) + 1):
        stamp = epoch + round(k * period * 1e9)
        recording.add(0, stamp, LAYOUT.encode(stamp, (float(function(k * period)), 1.0)))
    write_bag(folder, recording, custom_data={EPOCH: str(epoch)} if left else {})
    return signals(folder)


def wave(t):
    return 2.0 * np.sin(3.0 * t)


@pytest.mark.parametrize("left", [True, False])
def test_real_time_and_lockstep_are_aligned_automatically(tmp_path, capsys, left):
    a = bag(tmp_path / "a", wave, 0.01)
    b = bag(tmp_path / "b", lambda t: wave(t) + 0.001, 0.01, epoch=EPOCH_NS, left=left)
    assert compare(a, b).unrelated
    assert b["plant/state/x/position"].t[:2] == pytest.approx([0.0, 0.01], abs=1e-12)
    result = align(a, b)
    x, y = result.deviations
    assert (x.signal, y.signal) == ("plant/state/x/position", "plant/state/y/position")
    assert (x.largest, x.rms, x.shift) == (pytest.approx(1e-3), pytest.approx(1e-3), pytest.approx(0.0, abs=2e-3))
    assert x.peak == pytest.approx(2.0, rel=1e-3)
    assert (y.largest, y.rms, y.agrees) == (0.0, 0.0, True)
    assert result.span == (0.0, 4.0)
    assert main_compare([str(tmp_path / "a"), str(tmp_path / "b"), "--abs", "0.0011"]) == 0
    assert main_compare([str(tmp_path / "a"), str(tmp_path / "b"), "--abs", "0.0009"]) == 1
    assert "1 of 2 signals beyond their tolerance" in capsys.readouterr().out


@pytest.mark.parametrize("late", [0.0137, -0.2])
def test_the_time_shift_is_found(tmp_path, late):
    a = bag(tmp_path / "a", wave, 0.01)
    b = bag(tmp_path / "b", lambda t: wave(t - late), 0.01, epoch=EPOCH_NS)
    (x, y) = align(a, b).deviations
    assert x.shift == pytest.approx(late, abs=1e-4)
    assert x.shifted_rms < 2.0 * (3.0 * 0.01) ** 2 / 8.0 < 0.01 * x.rms  # error bound of linear interpolation
    assert ("late" if late > 0 else "early") in str(x)
    assert y.shift == 0.0  # a constant signal has no shift


@pytest.mark.parametrize(
    ("left", "epoch"),
    [
        ("9" * 19, 0),
        ("9223372036854775807", 2**63 - 1),
        ("1" + "0" * 19, 0),
        ("-5", 0),
        ("1.5", 0),
        ("", 0),
        ("0", 0),
        ("7", 7),
    ],
)  # fmt: skip
def test_an_epoch_is_an_integer_of_64_bits(tmp_path, left, epoch):
    """A bag stores such an integer; any other epoch is ignored, and times stay as they are."""
    recording = Recording([("plant/state", STATE)])
    recording.add(0, 5, LAYOUT.encode(5, (1.0, 1.0)))
    write_bag(tmp_path / "bag", recording, custom_data={EPOCH: left})
    read = signals(tmp_path / "bag")
    assert (read._epoch, read.from_start) == (epoch, True)


def test_the_start_is_that_of_the_first_compared_message(tmp_path):
    """A bag of another recorder begins with a topic that the other one lacks."""
    a = bag(tmp_path / "a", wave, 0.01)
    recording = Recording([("before", STATE), ("plant/state", STATE)])
    for topic, offset in ((0, 0.0), (1, 0.7)):
        for k in range(401):
            stamp = EPOCH_NS + round((k * 0.01 + offset) * 1e9)
            recording.add(topic, stamp, LAYOUT.encode(stamp, (float(wave(k * 0.01)), 1.0)))
    write_bag(tmp_path / "b", recording)
    result = align(a, signals(tmp_path / "b"))
    assert result.span == (0.0, pytest.approx(4.0))
    assert result.deviations[0].largest < 1e-6


@pytest.mark.parametrize("periods", [(0.01, 0.04), (0.04, 0.01)])
def test_different_rates_are_compared_at_the_samples_of_the_slower_one(tmp_path, periods, capsys):
    a = bag(tmp_path / "a", wave, periods[0])
    b = bag(tmp_path / "b", wave, periods[1])
    result = align(a, b)
    assert result.deviations[0].samples == 101
    assert result.deviations[0].largest < 1e-12
    # Compared message by message, most are missing.
    assert main_compare([str(tmp_path / "a"), str(tmp_path / "b")]) == 1
    assert main_compare([str(tmp_path / "a"), str(tmp_path / "b"), "--align", "--abs", "1e-12"]) == 0


def test_rates_without_common_samples_differ_only_by_interpolation(tmp_path):
    a = bag(tmp_path / "a", wave, 0.001)
    b = bag(tmp_path / "b", wave, 0.0317)
    x, _ = align(a, b).deviations
    assert 0.0 < x.largest < 2.0 * (3.0 * 0.001) ** 2 / 8.0 * 1.01  # largest curvature times step^2 / 8


def test_missing_topics_are_named_and_bags_without_a_common_time_refused(tmp_path):
    a = bag(tmp_path / "a", wave, 0.01)
    b = bag(tmp_path / "b", wave, 0.01, topic="other")
    with pytest.raises(BagError, match="no topic with messages in both"):
        align(a, b)
    later = bag(tmp_path / "later", wave, 0.01, begin=5.0, until=6.0)
    with pytest.raises(BagError, match="no time in common"):
        align(a, later)


def test_nan_does_not_agree(tmp_path):
    a = bag(tmp_path / "a", wave, 0.01)
    b = bag(tmp_path / "b", lambda t: np.nan if t == 1.0 else wave(t), 0.01, epoch=EPOCH_NS)
    result = align(a, b, default=Tolerance(absolute=1e9))
    assert not result.equal
    assert result.deviations[0].largest < 1e-12  # only instants at which both values are numbers are compared
    assert json.loads(result.to_json())["deviations"][0]["agrees"] is False


def test_a_bitwise_comparison_does_not_align(tmp_path, capsys):
    bag(tmp_path / "a", wave, 0.01)
    assert main_compare([str(tmp_path / "a"), str(tmp_path / "a"), "--align", "--bitwise"]) == 2
    assert "--align with --bitwise" in capsys.readouterr().err
