"""The link block: delay, jitter, loss and quantisation on any message of any rig, with the original stamps."""

import random
from bisect import insort

import pytest
from conftest import in_process
from hypothesis import given, settings, strategies as st
from softrig_control.nodes.delay import BLOCK, FieldbusDelay, Line, whole_periods
from softrig_core import ByHand, Level, Sample, Scenario, ScenarioError, Signals, load_scenario, rig_of

PERIOD = 10_000_000


def pass_through(link, ticks=200, seed=0, data=lambda k: (float(k), -float(k))):
    link.reset(seed)
    return [link.update(k * PERIOD, sent=Sample(k * PERIOD, data(k)))["arrived"] for k in range(ticks)]


@given(delay=st.integers(0, 30))
@settings(max_examples=10, deadline=None)
def test_a_sample_arrives_whole_periods_later_under_its_own_stamp(delay):
    arrived = pass_through(ByHand(FieldbusDelay(delay=0.01 * delay)), 60)
    for k, sample in enumerate(arrived):
        j = max(0, k - delay)  # before the first arrival, the initial sample under its own stamp
        assert sample == Sample(j * PERIOD, (float(j), -float(j)))


def test_a_delay_between_periods_is_rounded_up_and_reported():
    link = ByHand(FieldbusDelay(delay=0.071))
    assert pass_through(link) == pass_through(ByHand(FieldbusDelay(delay=0.08)))
    assert link.reports["delay"][0] == Level.WARN
    assert "rounded up to 8 and 0 periods" in link.reports["delay"][1]


@pytest.mark.parametrize(
    ("time", "expected"),
    [
        (0.0, (0, False)),
        (1.0 - 0.95e-9, (1, False)),
        (1.0 - 1.05e-9, (1, True)),
        (1.0 + 0.95e-9, (1, False)),
        (1.0 + 1.05e-9, (2, True)),
        (0.5, (1, True)),
        (1000.0 - 0.95e-6, (1000, False)),
        (1000.0 - 1.05e-6, (1000, True)),
        (1000.0 + 0.5e-9, (1000, False)),
    ],
)
def test_a_time_is_whole_periods_within_a_billionth(time, expected):
    assert whole_periods(time, 1.0) == whole_periods(time / 4.0, 0.25) == expected


def ages(link, seed=0, ticks=2000):
    return [k - s.stamp // PERIOD for k, s in enumerate(pass_through(link, ticks, seed))][100:]


def test_jitter_is_uniform_over_whole_periods_and_keeps_the_newest():
    link = ByHand(FieldbusDelay(name="link", delay=0.06, jitter=0.04))
    result = ages(link, ticks=20_000)
    assert min(result) == 6
    # The age is 6 periods if the sample sent 6 periods ago had no extra delay, 7 if the one sent 7 periods ago had at
    # most one, and so on.
    expected = {6: 0.2, 7: 0.8 * 0.4, 8: 0.8 * 0.6 * 0.6, 9: 0.8 * 0.6 * 0.4 * 0.8, 10: 0.8 * 0.6 * 0.4 * 0.2}
    for age, share in expected.items():
        assert result.count(age) / len(result) == pytest.approx(share, abs=0.015)
    assert sum(result.count(age) for age in expected) == len(result)


@pytest.mark.parametrize("spread", [0, 3, 300])
def test_a_long_line_is_a_sorted_list(spread):
    """Compared with one list: in order, nearly so (stamps, too), random; over many blocks; and in native code."""
    rng, line, plain = random.Random(spread), Line(1), []
    row = line.native()
    for t in range(3000):
        due = t + 400 + rng.randint(0, spread)
        if row.end == len(row.dues):  # if the queue is full, native code leaves the tick to Python
            row = row.python().native()
        stamp, message = t ^ (spread > 0), (float(t),)
        line, row = line.put(due, stamp, message), row.put(due, stamp, message)
        insort(plain, (due, stamp, message))
        line, *result = line.pop_arrived(t, t - 500, ())
        row, *same = row.pop_arrived(t, t - 500, ())
        arrived = [x for x in plain if x[0] <= t]
        plain = plain[len(arrived) :]
        late = [[stamp, message] for _, stamp, message in arrived if stamp >= t - 500]
        assert result == same == max(late, default=[t - 500, ()])
    assert repr(line) == f"Line(1, {tuple(plain)})"
    assert line == row.python() == line.native().python()
    assert line != line.put(t, t, (0.0,))
    assert len(plain) > 4 * BLOCK
    assert line.numbers().tolist() == [message[0] for _, _, message in plain]
    assert line.with_numbers(line.numbers()) == line != line.with_numbers(line.numbers() + 1.0)


def test_messages_of_several_values_are_delayed_as_one_row():
    line, messages = Line(3), [(30, 3, (1.0, 2.0, 3.0)), (10, 1, (4.0, 5.0, 6.0)), (20, 2, (7.0, 8.0, 9.0))]
    for message in messages:
        line = line.put(*message)
    row = line.native()
    assert row.python() == line
    for t, since, result in (
        (5, 0, (0, ())),
        (10, 0, messages[1][1:]),
        (25, 0, messages[2][1:]),
        (25, 3, (3, ())),
        (30, 3, messages[0][1:]),
    ):
        left, *text = line.pop_arrived(t, since, ())
        native, *same = row.pop_arrived(t, since, ())
        assert text == same == [*result]
        assert native.python() == left
    assert line.numbers().tolist() == [4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 1.0, 2.0, 3.0]
    for nothing in (Line(3), Line(3).native(), line.pop_arrived(30, 0, ())[0].native()):
        left, *text = nothing.pop_arrived(99, 0, ())
        assert text == [0, ()]
        assert (left.python() if not isinstance(nothing, Line) else left) == Line(3)
        if not isinstance(nothing, Line):
            assert left.begin == left.end


def test_stamps_never_decrease():
    stamps = [s.stamp for s in pass_through(ByHand(FieldbusDelay(name="link", delay=0.01, jitter=0.2)), 500)]
    assert stamps == sorted(stamps)


def test_a_lost_sample_leaves_the_previous_one():
    result = ages(ByHand(FieldbusDelay(name="link", delay=0.02, loss=0.3)), ticks=20_000)
    assert result.count(2) / len(result) == pytest.approx(0.7, abs=0.01)
    assert result.count(3) / len(result) == pytest.approx(0.3 * 0.7, abs=0.01)


def test_random_numbers_depend_only_on_seed_and_name():
    def make(name, **options):
        return ByHand(FieldbusDelay(name=name, delay=0.02, **options))

    link = make("link", jitter=0.05)
    result = ages(link, seed=3)
    assert ages(link, seed=4) != result
    assert ages(link, seed=3) == result  # a reset clears the queue
    assert ages(make("other", jitter=0.05), seed=3) != result


def test_values_are_rounded_to_their_steps():
    link = ByHand(FieldbusDelay(delay=0.0, quantum=(0.5, 0.0)))
    arrived = pass_through(link, 4, data=lambda k: (0.3 * k - 0.5, 0.3 * k))
    assert [s.data[0] for s in arrived] == [-0.5, 0.0, 0.0, 0.5]
    assert [s.data[1] for s in arrived] == pytest.approx([0.0, 0.3, 0.6, 0.9])


def test_samples_of_a_slow_sender_are_not_sent_twice():
    link = ByHand(FieldbusDelay(name="link", delay=0.03, loss=0.5))
    link.reset(0)
    stamps = []
    for k in range(400):
        j = k - k % 10
        stamps.append(link.update(k * PERIOD, sent=Sample(j * PERIOD, (float(j), 0.0)))["arrived"].stamp // PERIOD)
    changes = [k for k in range(1, 400) if stamps[k] != stamps[k - 1]]
    assert all(k % 10 == 3 for k in changes)
    assert 10 < len(changes) < 30  # the link loses half of the forty messages, with all their repetitions
    assert not link.reports  # a repeated message does not count as late


def test_out_of_order_input_is_dropped_and_reported():
    link = ByHand(FieldbusDelay(delay=0.0))
    link.update(0, sent=Sample(5, (1.0, 0.0)))
    assert link.update(PERIOD, sent=Sample(4, (2.0, 0.0)))["arrived"] == Sample(5, (1.0, 0.0))
    assert link.reports["order"][0] == Level.WARN


MESSAGES = {
    "sensor_msgs/msg/JointState": {"channels": ("a", "b"), "fields": ("position", "effort")},
    "trajectory_msgs/msg/JointTrajectory": {"channels": ("a",), "fields": ("position", "acceleration")},
    "geometry_msgs/msg/Vector3Stamped": {"frame_id": "abc"},
    "geometry_msgs/msg/WrenchStamped": {"frame_id": "tool"},
}


@pytest.mark.parametrize("message", MESSAGES)
@pytest.mark.parametrize("restamp", [False, True])
def test_every_message_type_has_ports(message, restamp):
    link = ByHand(FieldbusDelay(message=message, restamp=restamp, delay=0.01, **MESSAGES[message]))
    (sent,), (arrived,) = FieldbusDelay.ports(link.block.p)
    assert sent.layout().msgtype == arrived.layout().msgtype == message
    assert (sent.topic, arrived.topic) == ("axis/state", "axis/feedback")
    assert sent.labels == arrived.labels
    assert sent.delayed
    assert arrived.delayed != restamp
    values = tuple(map(float, range(sent.size)))
    encoded = arrived.layout().encode(7, values)
    assert arrived.layout().decode(encoded) == (7, values)
    answer = link.update(0, sent=Sample(0, values))["arrived"]
    assert answer == (values if restamp else Sample(0, values))


def with_link(name, receiver, port_topic, duration, **parameters):
    """The scenario with a link inserted before one input of a node, nothing else changed."""
    base = load_scenario(name)
    nodes = {n: e.model_dump() for n, e in base.nodes.items()}
    late = f"{port_topic}_late"
    nodes["link"] = {
        "package": "softrig_control",
        "executable": "fieldbus_delay",
        "parameters": {"topic_in": port_topic, "topic_out": late} | parameters,
    }
    nodes[receiver]["remap"] = nodes[receiver]["remap"] | {port_topic: late}
    return Scenario.model_validate(base.model_dump() | {"nodes": nodes, "duration": duration})


COMMAND = {"channels": ["armature"], "fields": ["effort"], "restamp": True, "initial": [0.0]}


def test_a_link_before_a_plants_command_delays_it():
    late = with_link("dc_motor_fsfb", "dc_axis_plant", "axis/command", 1.0, delay=0.03, **COMMAND)
    signals = Signals(in_process(rig_of(late)))
    t, sent = signals["axis/command/armature/effort"]
    arrived = signals["axis/command_late/armature/effort"].x
    assert (arrived[3:] == sent[:-3]).all()
    assert not arrived[:3].any()
    assert (signals.table("axis/command_late").stamp == t).all()
    y = signals["axis/true_state/axis/position"].x
    first = int(sent.nonzero()[0][0])
    assert not y[: first + 4].any()
    assert y[first + 4] != 0.0


def test_a_link_works_in_another_rig_without_a_link():
    name, topic = "dc_motor_smc_b2", "motor/state"
    rig = rig_of(name)
    member = next(m for m in rig.members if m.name == "dc_motor_smc")
    port = next(p for p in member.inputs if p.topic == topic)
    options = {"channels": list(port.channels), "fields": list(port.fields), "period": member.params.period}
    late = with_link(name, "dc_motor_smc", topic, 0.5, delay=0.02, restamp=True, **options)
    signals = Signals(in_process(rig_of(late)))
    label = f"{port.channels[0]}/{port.fields[0]}"
    periods = round(0.02 / member.params.period)
    arrived = signals[f"{topic}_late/{label}"].x
    assert (arrived[periods:] == signals[f"{topic}/{label}"].x[: len(arrived) - periods]).all()
    with pytest.raises(ScenarioError, match="its stamps are acquisition times, but the input pairs by stamp"):
        rig_of(with_link(name, "dc_motor_smc", topic, 0.5, **options))


def test_two_links_in_a_row_add_up():
    late = with_link("dc_motor_fsfb", "fsfb_controller", "axis/feedback", 1.0, delay=0.03)
    table = Signals(in_process(rig_of(late))).table("axis/feedback_late")
    assert table.t[11:] - table.stamp[11:] == pytest.approx(0.11)
