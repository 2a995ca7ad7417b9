"""Faults on links: what each does to messages, where a scenario puts them, and that all placements give the same."""

import math
import random
from itertools import pairwise

import numpy as np
import pytest
from conftest import differences, in_process, make_scenario
from hypothesis import given, strategies as st
from simulated import Discovery, SimulatedRig, World
from softrig_control.nodes.fault import Fault
from softrig_core import ByHand, ParameterError, RunError, Sample, ScenarioError, rig_of, simulate

MS = 1_000_000
BASIC = {"plant": "plant", "source": "source", "gain": "gain"}


def through(values, seed=0, *, toggles=(), fresh=None, **params):
    """The output of a fault at each tick of 10 ms for an input; None: silence."""
    about = {"topic_in": "a", "topic_out": "b", "channels": ("x",), "fields": ("position",), "period": 0.01}
    block = ByHand(Fault(name="fault", **{**about, **params}))
    block.reset(seed)
    now = [0]
    last = [0]
    block.block.ages = lambda name: now[0] - last[0]
    out = []
    for k, value in enumerate(values):
        now[0] = k * 10 * MS
        if fresh is None or fresh[k]:
            last[0] = now[0]
        sent = value if isinstance(value, tuple) else (float(value),)
        result = block.update(now[0], sent=sent, toggle=(1.0,) if k in toggles else (0.0,)).get("arrived")
        out.append(result if result is None or len(result) > 1 else result[0])
    return out


RAMP = [float(k) for k in range(10)]


@pytest.mark.parametrize(
    ("params", "expected"),
    [
        ({"kind": "offset", "value": (0.5,)}, [x + 0.5 for x in RAMP]),
        ({"kind": "scale", "value": (-2.0,), "start": 0.03}, [*RAMP[:3], *(-2 * x for x in RAMP[3:])]),
        ({"kind": "drift", "value": (100.0,), "start": 0.02, "stop": 0.05}, [0, 1, 2, 3 + 1.0, 4 + 2.0, 5, 6, 7, 8, 9]),
        ({"kind": "quantise", "value": (4.0,)}, [0, 0, 4, 4, 4, 4, 8, 8, 8, 8]),
        ({"kind": "saturate", "value": (6.0,), "lower": (2.0,)}, [2, 2, 2, 3, 4, 5, 6, 6, 6, 6]),
        ({"kind": "stuck", "start": 0.04, "stop": 0.08}, [0, 1, 2, 3, 4, 4, 4, 4, 8, 9]),
        ({"kind": "spike", "value": (9.0,), "every": 0.04, "lasts": 0.01}, [9, 1, 2, 3, 13, 5, 6, 7, 17, 9]),
        ({"kind": "repeat", "start": 0.02}, [0, 1, 1, 2, 3, 4, 5, 6, 7, 8]),
        ({"kind": "silence", "start": 0.03, "stop": 0.05}, [0, 1, 2, None, None, 5, 6, 7, 8, 9]),
        ({"kind": "delay", "delay": 0.025}, [None, None, None, 0, 1, 2, 3, 4, 5, 6]),
        ({"kind": "delay", "delay": 0.02, "start": 0.03, "stop": 0.06}, [0, 1, 2, None, None, 3, 6, 7, 8, 9]),
        ({"kind": "replace", "points": (5.0, 7.0), "span": 0.06, "start": 0.02}, [0, 1, 5, 5, 5, 7, 7, 7, 7, 7]),
        ({"kind": "add", "points": (0.0, 4.0), "span": 0.04, "linear": True}, [0, 2, 4, 6, 8, 9, 10, 11, 12, 13]),
        (
            {"kind": "replace", "points": (0.0, 4.0, 1.0), "span": 0.04, "linear": True},
            [0, 2, 4, 2.5, 1, 1, 1, 1, 1, 1],
        ),
        ({"kind": "loss", "probability": 1.0}, [None] * 10),
        ({"kind": "loss", "burst_begins": 1.0, "burst_ends": 0.5, "lost_in_burst": 0.0}, RAMP),
    ],
)
def test_each_kind_does_what_its_name_says(params, expected):
    assert through(RAMP, **params) == expected


@pytest.mark.parametrize(
    "params",
    [
        {"kind": "saturate", "value": (2.0,), "lower": (2.0,)},
        {"kind": "saturate", "value": (0.0,)},
        {"kind": "noise", "value": (0.0,)},
        {"start": 1.0, "stop": 1.0 + 1e-9},
        {"start": 1.0, "stop": 0.0},
        {"every": 1.0, "lasts": 0.99},
    ],
)
def test_numbers_at_the_limits_are_accepted(params):
    assert len(through([1.0], **params)) == 1


def test_only_the_selected_values_are_changed():
    two = {"channels": ("a", "b"), "fields": ("position", "velocity"), "kind": "offset"}
    assert through([(1.0, 2.0, 3.0, 4.0)], affects=("b",), value=(10.0,), **two) == [(1.0, 12.0, 3.0, 14.0)]
    assert through([(1.0, 2.0, 3.0, 4.0)], affects=("b/velocity", "a"), value=(1.0, 2.0, 3.0), **two) == [
        (3.0, 2.0, 6.0, 5.0)
    ]


def test_the_switch_turns_it_off_and_on_by_its_button():
    pressed = through([1.0] * 8, kind="offset", value=(1.0,), toggles=(2, 3, 6))
    assert pressed == [2.0, 2.0, 1.0, 1.0, 1.0, 1.0, 2.0, 2.0]
    assert through([1.0] * 4, kind="offset", active=False, toggles=(2,)) == [1.0, 1.0, 2.0, 2.0]
    half = ByHand(Fault(topic_in="a", topic_out="b", channels=("x",), fields=("position",)))
    half.block.ages = lambda name: 0
    messages = [half.update(k, sent=(1.0,), toggle=(x,))["arrived"] for k, x in enumerate((0.5, 0.51, 0.5))]
    assert messages == [(2.0,), (1.0,), (1.0,)]


def test_missing_messages_stay_missing():
    fresh = [True, False, True, False]
    assert through([1.0] * 4, kind="offset", fresh=fresh) == [2.0, None, 2.0, None]
    late = through([0.0, 0.0, 2.0, 2.0, 4.0, 4.0], kind="delay", delay=0.01, fresh=[True, False] * 3)
    assert late == [None, 0.0, None, 2.0, None, 4.0]


@given(st.integers(0, 2**31), st.integers(0, 4), st.integers(0, 5))
def test_late_messages_arrive_once_in_order_and_never_early(seed, delay, jitter):
    for overtaking in (True, False):
        out = through(range(60), seed, kind="delay", delay=delay / 100, jitter=jitter / 100, overtaking=overtaking)
        arrived = [(k, x) for k, x in enumerate(out) if x is not None]
        assert [x for _, x in arrived] == sorted({x for _, x in arrived})
        assert all(delay <= k - x <= delay + jitter for k, x in arrived) or not overtaking
        assert all(k - x >= delay for k, x in arrived)


def test_noise_and_losses_have_their_stated_statistics_and_repeat_by_seed():
    n = 4000
    noise = through([0.0] * n, 1, kind="noise", value=(0.3,))
    assert noise == through([0.0] * n, 1, kind="noise", value=(0.3,))
    assert noise != through([0.0] * n, 2, kind="noise", value=(0.3,))
    assert math.sqrt(sum(x * x for x in noise) / n) == pytest.approx(0.3, rel=0.05)
    lost = through([0.0] * n, kind="loss", probability=0.2).count(None)
    assert lost / n == pytest.approx(0.2, abs=0.03)
    bursts = through([0.0] * n, kind="loss", burst_begins=0.02, burst_ends=0.1)
    # On average a burst lasts 10 messages, and the next begins 50 messages after its end.
    share = bursts.count(None) / n
    assert share == pytest.approx(0.02 / (0.02 + 0.1), abs=0.05)
    begun = sum(a is not None and b is None for a, b in pairwise(bursts))
    assert bursts.count(None) / begun == pytest.approx(10.0, rel=0.35)


def test_the_start_time_does_not_shift_its_random_numbers():
    whole = through([0.0] * 20, kind="noise", value=(1.0,))
    half = through([0.0] * 20, kind="noise", value=(1.0,), start=0.1)
    assert half == [0.0] * 10 + whole[10:]


@pytest.mark.parametrize(
    ("params", "reason"),
    [
        ({"affects": ("y",)}, "affects 'y', but the link carries x/position"),
        ({"value": (1.0, 2.0)}, "value has 2 numbers, expected one, or one for each of 1 values"),
        ({"start": 1.0, "stop": 0.5}, "stop = 0.5 s is not after start = 1 s"),
        ({"start": 1.0, "stop": 1.0}, "stop = 1 s is not after start = 1 s"),
        ({"every": 1.0, "lasts": 1.0}, "lasts = 1 s: expected more than 0 and less than every = 1 s"),
        ({"kind": "quantise", "value": (-1.0,)}, "value = -1: expected at least 0 for quantise"),
        ({"kind": "invalid", "message": "std_msgs/msg/Bool"}, "kind invalid: a std_msgs/msg/Bool is true or false"),
        ({"message": "std_msgs/msg/Bool", "delayed": True}, "delayed: a std_msgs/msg/Bool has no stamp"),
        ({"value": ()}, "value has 0 numbers, expected one, or one for each of 1 values"),
        ({"lower": (0.0, 1.0)}, "lower has 2 numbers, expected one"),
        ({"every": 1.0}, "lasts = 0 s: expected more than 0 and less than every"),
        ({"lasts": 1.0}, "lasts needs every"),
        ({"kind": "noise", "value": (-1.0,)}, "expected at least 0 for noise"),
        ({"kind": "saturate", "value": (1.0,), "lower": (2.0,)}, "lower = 2 is above value = 1"),
        ({"kind": "nonsense"}, "kind"),
        ({"kind": "add"}, "points: needed for kind add"),
        ({"kind": "offset", "points": (1.0,)}, "points: not used for kind offset"),
        ({"probability": 1.5}, "probability"),
    ],
)
def test_impossible_numbers_are_refused(params, reason):
    with pytest.raises(ParameterError, match=reason):
        through([0.0], **params)


KINDS = ("offset", "scale", "drift", "noise", "quantise", "saturate", "stuck", "spike", "delay", "loss", "repeat",
         "silence", "add", "replace", "invalid")  # fmt: skip
SOME = (0.0, 0.02, 0.05)


def drawn_fault(kind, rng):
    """Parameters of a fault on a link of two values, 24 messages some of which are missing, and when it is switched."""

    def either():
        return rng.random() < 0.5

    start = rng.choice(SOME)
    p = {
        "kind": kind,
        "channels": ("a", "b"),
        "fields": ("position",),
        "start": start,
        "holds": either(),
        "active": rng.random() < 0.8,
    }
    p["affects"] = rng.choice([(), ("b",), ("b", "a")])
    count = len(p["affects"]) or 2
    p["value"] = tuple(rng.choice([0.0, 0.25, 1.5]) for _ in range(rng.choice([1, count])))
    if kind == "saturate" and either():
        p["lower"] = tuple(rng.choice([-0.5, 0.0]) for _ in range(rng.choice([1, count])))
    if kind in ("add", "replace"):
        p["points"] = tuple(rng.choice([0.0, 1.0, -2.0]) for _ in range(rng.randint(1, 4)))
        p["span"], p["linear"] = rng.choice([0.03, 0.08, 1.0]), either()
    if either():
        p["stop"] = start + 0.06
    if either():
        p["every"], p["lasts"] = 0.04, rng.choice([0.01, 0.02])
    p["probability"] = rng.choice([0.0, 0.5, 0.5, 1.0])
    if either():
        p["burst_begins"], p["burst_ends"], p["lost_in_burst"] = 0.5, 0.4, rng.choice([0.0, 0.6, 1.0])
    p["delay"], p["jitter"] = rng.choice([0.0, 0.015, 0.03]), rng.choice([0.0, 0.02])
    p["overtaking"] = either()
    values = [tuple(rng.randint(-8, 8) / 4.0 for _ in range(2)) for _ in range(24)]
    fresh = [True] + [rng.random() < 0.75 for _ in range(23)]
    return p, values, fresh, set(rng.sample(range(24), rng.choice([0, 0, 1, 2, 3])))


def by_hand(p, values, fresh, toggles, random, normal):
    """The output at each tick, by an implementation of the documentation of the parameters; times in ticks of 10 ms."""
    concerned = [("a", "b").index(name) for name in p["affects"]] or [0, 1]
    kind, n = p["kind"], len(concerned)
    amount = p["value"] * (n if len(p["value"]) == 1 else 1)
    lower = p.get("lower") or [-v for v in amount]
    lower = list(lower) * (n if len(lower) == 1 else 1)
    start, stop = round(p["start"] * 100), round(p.get("stop", 0.0) * 100) or math.inf
    every, lasts = round(p.get("every", 0.0) * 100), round(p.get("lasts", 0.0) * 100)
    on, burst, begun, stuck, before, last, newest, due_before = p["active"], False, None, None, None, (0.0, 0.0), -1, 0
    line, out, number = [], [], 0

    def changed(k, x, t):
        if k not in concerned:
            return x
        i = concerned.index(k)
        points = p.get("points", (0.0,))
        share = (t - start) / (p.get("span", 1.0) * 100)
        at = [j / max(len(points) - 1, 1) for j in range(len(points))]
        step = points[min(int(share * len(points) + 1e-9), len(points) - 1)]
        profile = float(np.interp(share, at, points)) if p.get("linear") else step
        return {
            "offset": x + amount[i],
            "spike": x + amount[i],
            "scale": x * amount[i],
            "drift": x + amount[i] * (t - begun) / 100.0,
            "noise": x + amount[i] * normal(n * number + i),
            "quantise": math.floor(x / amount[i] + 0.5) * amount[i] if amount[i] else x,
            "saturate": min(max(x, lower[i]), amount[i]),
            "stuck": stuck[k],
            "add": x + profile,
            "replace": profile,
            "invalid": math.nan,
        }[kind]

    for t, sent in enumerate(values):
        on ^= t in toggles and t - 1 not in toggles
        messages = None
        if fresh[t]:
            draw, turn = random(2 * number), random(2 * number + 1)
            if kind == "loss" and "burst_begins" in p:
                burst = turn >= p["burst_ends"] if burst else turn < p["burst_begins"]
            if not (on and start <= t < stop and (not every or (t - start) % every < lasts)):
                begun, messages, newest = None, sent, t
            else:
                if begun is None:
                    begun, stuck = t, sent
                chance = p["probability"] if "burst_begins" not in p else p["lost_in_burst"] if burst else 0.0
                if kind == "delay":
                    due = t + math.ceil(p["delay"] * 100 - 1e-9) + int(draw * (round(p["jitter"] * 100) + 1))
                    due_before = due if p["overtaking"] else max(due, due_before)
                    line.append((due_before, t, sent))
                elif kind == "repeat":
                    messages = before if before and draw < p["probability"] else sent
                elif kind in ("spike", "invalid") and draw >= p["probability"]:
                    messages = sent
                elif kind not in ("silence", "loss"):
                    messages = tuple(changed(k, x, t) for k, x in enumerate(sent))
                elif kind == "loss" and draw >= chance:
                    messages = sent
            before, number = sent, number + 1
        arrived = [entry for entry in line if entry[0] <= t]
        line = [entry for entry in line if entry[0] > t]
        if arrived and max(entry[1] for entry in arrived) > newest:
            _, newest, messages = max(arrived, key=lambda entry: entry[1])
        last = messages or last
        out.append(last if messages or p["holds"] else None)
    return out


@pytest.mark.parametrize("kind", KINDS)
def test_any_fault_does_what_its_parameters_say(kind):
    for seed in range(10):
        hold_fault(*drawn_fault(kind, random.Random(f"{kind}{seed}")), seed)


def hold_fault(p, values, fresh, toggles, seed):
    if p["kind"] == "saturate" and any(low > high for low, high in zip(*limits_of(p), strict=True)):
        return
    dice = ByHand(Fault(name="fault", topic_in="a", topic_out="b", **p))
    dice.reset(seed)
    expected = by_hand(p, values, fresh, toggles, dice.block.uniform, dice.block.standard_normal)
    result = through(values, seed, toggles=toggles, fresh=fresh, **p)
    assert [x is None for x in result] == [x is None for x in expected]
    messages = [(a, b) for a, b in zip(result, expected, strict=True) if a is not None]
    assert [a for a, _ in messages] == [pytest.approx(b, abs=1e-12, nan_ok=True) for _, b in messages]


def test_after_a_link_of_acquisition_times_the_first_message_is_new_whatever_its_stamp():
    """Before it, the port has its initial value, without an age."""
    fault = ByHand(
        Fault(topic_in="a", topic_out="b", channels=("x",), fields=("position",), delayed=True, value=(4.0,))
    )
    age, messages = [None], []
    fault.block.ages = lambda name: age[0]
    for k, (received, sent) in enumerate(
        [(None, Sample(0, (9.0,))), (2, Sample(0, (1.0,))), (3, Sample(0, (1.0,))), (0, Sample(4, (2.0,)))]
    ):
        age[0] = received
        messages.append(fault.update(k * MS, sent=sent, toggle=None).get("arrived"))
    assert messages == [None, Sample(0, (5.0,)), None, Sample(4, (6.0,))]
    about = {"topic_in": "a", "topic_out": "b", "channels": ("x",), "fields": ("position",), "holds": True}
    for kind, first in (({}, (0.0,)), ({"delayed": True}, Sample(0, (0.0,))), ({"initial": (3.0,)}, (3.0,))):
        silent = ByHand(Fault(kind="silence", **about, **kind))
        silent.block.ages = lambda name: 0
        message = Sample(9, (1.0,)) if "delayed" in kind else (1.0,)
        # A silent link holds the message that it had delivered before.
        assert silent.update(9, sent=message, toggle=None) == {"arrived": first}


def limits_of(p):
    count = len(p["affects"]) or 2
    high = p["value"] * (count if len(p["value"]) == 1 else 1)
    low = p.get("lower", tuple(-x for x in high))
    return low * (count if len(low) == 1 else 1), high


def faulty(duration=0.3, nodes=BASIC, **faults):
    return rig_of(make_scenario(nodes, duration, faults=faults))


def test_a_fault_is_inserted_before_all_readers_or_one_and_the_recording_has_both_sides():
    rig = faulty(bias={"link": "lag/state", "kind": "offset", "channels": ["x/position"], "value": [0.25], "from": 0.1})
    run = simulate(rig)
    t, x = run.signals["lag/state/x/position"]
    _, seen = run.signals["lag/state/bias/x/position"]
    assert rig.topics["lag/state/bias"].units == rig.topics["lag/state"].units
    n = len(seen)
    assert list(seen - x[:n]) == pytest.approx([0.25 if s >= 0.1 - 1e-9 else 0.0 for s in t[:n]])
    _, r = run.signals["lag/reference/x/position"]
    _, u = run.signals["lag/command/u/effort"]
    assert list(u) == list(2.0 * (r - seen))  # the controller uses the faulty measurement of the same tick
    rig = faulty(nodes={**BASIC, "watcher": "watcher"}, bias={"link": "lag/state -> gain", "kind": "offset"})
    readers = {m.name: m.links["state"].source.name for m in rig.members if "state" in m.links}
    assert readers == {"gain": "bias", "watcher": "plant"}


def test_several_faults_on_a_link_follow_each_other():
    rig = faulty(
        a={"link": "lag/state -> gain", "kind": "offset", "value": [1.0]},
        b={"link": "lag/state -> gain", "kind": "scale", "value": [3.0]},
    )
    signals = simulate(rig).signals
    x, last = signals["lag/state/x/position"].x, signals["lag/state/b/x/position"].x
    assert list(last) == list(3.0 * (x[: len(last)] + 1.0))


def test_a_lost_message_is_a_held_value_with_its_age():
    rig = faulty(gone={"link": "lag/command", "kind": "silence", "from": 0.1})
    run = simulate(rig)
    t, u = run.signals["lag/command/u/effort"]
    applied = run.signals["lag/applied/u/effort"].x
    assert len(run.signals["lag/command/gone/u/effort"].t) == sum(t < 0.1 - 1e-9)
    held = u[sum(t < 0.1 - 1e-9) - 1]
    assert set(applied[12:]) == {held}


def test_an_outside_subscriber_that_cannot_receive_silence_gets_the_held_value():
    held = through(RAMP, kind="silence", start=0.03, stop=0.05, holds=True, initial=(7.0,))
    assert held == [0, 1, 2, 2, 2, 5, 6, 7, 8, 9]
    assert through([1.0] * 3, kind="delay", delay=0.02, holds=True, initial=(7.0,)) == [7.0, 7.0, 1.0]
    nodes = {**BASIC, "gain": {"executable": "gain", "external": True}}
    rig = faulty(nodes=nodes, gone={"link": "lag/state", "kind": "silence"})
    assert not next(m for m in rig.members if m.name == "gone").outputs[0].sporadic


def test_messages_that_no_subscriber_accepts_are_rejected_by_each_separately():
    fault = {"link": "lag/state", "kind": "invalid", "every": 0.05, "lasts": 0.01}
    rig = faulty(nodes={**BASIC, "watcher": "watcher"}, bad=fault)
    run = simulate(rig)
    text = run.signals["lag/state/bad/x/position"].x
    u = run.signals["lag/command/u/effort"].x
    r = run.signals["lag/reference/x/position"].x
    bad = np.isnan(text)
    assert list(np.flatnonzero(bad)) == list(range(0, len(text), 5))
    assert list(u[~bad]) == list(2.0 * (r - text)[~bad])
    held = np.flatnonzero(bad)[1:]
    assert list(u[held]) == list(u[held - 1])  # the controller repeats its last answer
    assert run.blocks["gain"].reports["refused state"][2] == bad.sum()
    with pytest.raises(RunError, match=r"plant refuses lag/command/bad at t = 0.1 s: u/effort is nan"):
        simulate(faulty(bad={"link": "lag/command", "kind": "invalid", "from": 0.1}))


@pytest.mark.parametrize("seed", range(6))
def test_nodes_reject_it_as_blocks_in_process_do(seed):
    rig = faulty(bad={"link": "lag/state -> gain", "kind": "invalid", "probability": 0.3})
    rng = random.Random(seed)
    world = World(lambda *_: rng.randrange(1_000, 5 * MS))
    Discovery(world, rng)
    run = SimulatedRig(rig, world, "lockstep", after=lambda name: rng.randrange(50 * MS), start_timeout=0.0)
    run.run(100.0)
    assert {n: (a.state, a.error) for n, a in run.adapters.items()} == dict.fromkeys(run.adapters, ("done", None))
    assert differences(in_process(rig), run.recording) == []
    (refused,) = [i.refused for i in run.adapters["gain"].inputs if i.name == "state"]
    assert refused == sum(np.isnan(simulate(rig).signals["lag/state/bad/x/position"].x))


def test_with_faults_only_the_seed_decides():
    faults = {"noise": {"link": "lag/state -> gain", "kind": "noise", "value": [0.1]}}
    one, same, other = (in_process(faulty(**faults), seed) for seed in (3, 3, 4))
    assert differences(one, same) == []
    assert differences(one, other) != []


@pytest.mark.parametrize(
    ("fault", "reason"),
    [
        ({"link": "lag/stat"}, r"no node publishes 'lag/stat' \(did you mean 'lag/state'\?\)"),
        ({"link": "lag/state -> source"}, "source does not subscribe to lag/state; its subscribers are gain"),
        ({"link": "lag/applied"}, "no node acts on lag/applied, so a fault there would change nothing"),
        ({"link": "lag/state", "kind": "noise", "value": [1, 2, 3]}, "node it: .*value has 3 numbers"),
        ({"link": "lag/state", "knd": "noise"}, "parameter knd is unknown .did you mean 'kind'"),
        ({"link": "lag/state", "message": "x"}, "message is set by the link"),
        ({"link": "lag state"}, "pattern"),
    ],
)
def test_an_impossible_fault_is_refused_in_one_line(fault, reason):
    with pytest.raises((ScenarioError, ValueError), match=reason):
        faulty(it=fault)
    for name in ("bag", "log"):
        with pytest.raises(ScenarioError, match=f"fault {name}: a run's folder has a {name} of its own"):
            faulty(**{name: {"link": "lag/state"}})
    for name in ("__proto__", "a__b"):  # ROS refuses these names of nodes
        with pytest.raises(ValueError, match="pattern"):
            faulty(**{name: {"link": "lag/state"}})
    with pytest.raises(ScenarioError, match="that is the name of a node"):
        faulty(plant={"link": "lag/state"})


def test_the_numbers_of_a_fault_are_set_like_any_parameter(tmp_path):
    from softrig_core import load_scenario

    file = tmp_path / "mine.yaml"
    noise = "{link: motor/sensors, kind: noise, channels: [current_a], value: [0.2], from: 1}"
    file.write_text(f"extends: dc_motor_smc_b2\ntitle: mine\nfaults: {{noise: {noise}}}\n")
    rig = rig_of(load_scenario(str(file), {"noise.value": [0.5], "noise.from": 2.0}))
    noise = next(m for m in rig.members if m.name == "noise")
    assert (noise.params.value, noise.params.start) == ((0.5,), 2.0)
    again = rig_of(rig, duration=0.5, overrides={"noise.value": [0.1]})
    assert next(m for m in again.members if m.name == "noise").params.value == (0.1,)
    with pytest.raises(ScenarioError, match="did you mean 'noise'"):
        load_scenario(str(file), {"nose.value": [0.5]})
