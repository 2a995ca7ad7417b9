"""The queue's controllers, network and packets over random inputs, against independent code.

Sources: the second derivative of the queue by differences along the fluid equations on the page tcp_aqm; for packets
the rules that `run_until` begins with, played on lists.
"""

import heapq
import math
from random import Random

import numpy as np
import pytest
from helpers import near
from softrig_core import ByHand, Level
from softrig_core.block.params import build
from softrig_systems.tcp_aqm import figures
from softrig_systems.tcp_aqm.controller import AqmController
from softrig_systems.tcp_aqm.fluid_plant import TcpFluid
from softrig_systems.tcp_aqm.laws import LAWS, Gains, Measured, integral_gain
from softrig_systems.tcp_aqm.model import Bottleneck, equilibrium, phi, psi
from softrig_systems.tcp_aqm.packets import Agenda, Fifo, Inside, Rules, Sources, run_until, schedule
from softrig_systems.tcp_aqm.packets_plant import TcpPackets

MS = 1_000_000
GAINS = {"k1": 3.0, "k2": 40.0, "lam": 5.0, "l1": 2.0, "l2": 7.0, "k": 30.0, "kp": 1e-3, "ki": 2e-3, "bias": 0.1,
         "pid_gain": 4e-3, "pid_ti": 2.0, "pid_td": 0.3, "a": 1.5}  # fmt: skip


def sign(s, width):
    return min(max(s / width, -1.0), 1.0) if width else float((s > 0.0) - (s < 0.0))


def wanted(name, m, g, width):
    """Command and surface of a controller; for those that linearise, the wanted q''."""
    if name == "pi":
        return 0.1 + 1e-3 * m.e + 2e-3 * m.integral, 0.0
    if name == "pid":
        return 4e-3 * (m.e + m.integral / 2.0 + 0.3 * m.derivative), 0.0
    s, bend = 0.0, -4.5 * m.rate - 6.75 * m.e - 3.375 * m.integral  # (D + 1.5)^3 applied to the integral of e
    if name == "sspd":
        s = m.rate + 5.0 * m.e
        bend = -3.0 * s - 40.0 * sign(s, width) - 5.0 * m.rate
    if name == "sspid":
        s = m.rate + 2.0 * m.e + 7.0 * m.integral
        bend = -2.0 * m.rate - 7.0 * m.e - 30.0 * sign(s, width)
    return (bend - m.phi) / m.psi, s


@pytest.mark.parametrize("width", [0.0, 60.0])
@pytest.mark.parametrize("name", LAWS)
def test_each_law_bends_the_queue_by_its_formula(name, width):
    g, draw = build(Gains, {**GAINS, "boundary": width}), Random(name)
    for _ in range(30):
        m = Measured(
            *(draw.uniform(-20.0, 20.0) for _ in range(3)),
            draw.uniform(-900.0, -100.0),
            draw.uniform(-9.0, 9.0),
            draw.uniform(-2.0, 2.0),
        )
        assert LAWS[name](m, g) == near(wanted(name, m, g, width))
    share = integral_gain(name, g)
    moved = [LAWS[name](m._replace(integral=i), g) for i in (0.0, 1.0)]
    part = {"sspid": moved[1].s - moved[0].s, "robust": -(moved[1].u - moved[0].u) * m.psi}
    assert share == near(part.get(name, moved[1].u - moved[0].u))


def test_phi_and_psi_follow_from_the_equations_of_the_queue():
    """The second derivative of q by differences along the equations of the fluid."""
    draw = Random(2)
    for _ in range(10):
        w, R, w_R, R_R, p = (
            draw.uniform(*ends) for ends in ((5.0, 20.0), (0.2, 0.3), (5.0, 20.0), (0.2, 0.3), (0, 0.01))
        )
        N, C, h = 60.0, 3750.0, 1e-7
        w_later, R_later = w + h * (1.0 / R - w * w_R / (2.0 * R_R) * p), R + h * (N * w / R - C) / C
        bend = (N * w_later / R_later - N * w / R) / h
        assert phi(w, R, N, C) + psi(w, R, w_R, R_R, N) * p == pytest.approx(bend, rel=1e-3, abs=1.0)
        assert phi(w, R, N, C, printed=True) == near(phi(w, R, N, C) - N * (w - 1.0) / R**2)
    assert equilibrium(Bottleneck(N=50, C=1000.0, tau_p=0.1), 100.0) == near((0.2, 4.0, 0.125))


@pytest.mark.parametrize("options", [{}, {"phi_form": "printed"}, {"anti_windup": True}])
@pytest.mark.parametrize("law", LAWS)
def test_the_controller_equals_its_law_on_an_independent_record(law, options):
    """Random states, references and rejections; the record is a list, read by linear interpolation."""
    made = {"N": 40, "C": 2000.0, "tau_p": 0.05, "q_max": 100.0, "history": 0.1, "period": 0.01, "set_point": 60.0}
    block = ByHand(AqmController(law=law, **made, **GAINS, **options))
    draw, integral, q_d, last, record, text = Random(law), 0.0, 60.0, None, [], ((0.0,), (0.0, 0.0, 0.0))
    g = block.block.p
    for k in range(150):
        w, q, R = draw.uniform(1.0, 9.0), draw.uniform(0.0, 100.0), draw.uniform(0.05, 0.12)
        asked = draw.choice((None, None, 30.0, 70.0, 0.0, 100.0))
        kind = draw.choice(("good", "good", "good", "good", "bad", "refused"))
        block.reports.clear()
        if kind == "refused":
            answer = block.refused(k * 10 * MS)
        else:
            w = 0.0 if kind == "bad" else w
            answer = block.update(
                k * 10 * MS, state=(w, q, R), reference=asked and (asked,) if asked != 0.0 else (0.0,)
            )
        if kind != "good":
            record += record[-1:]
            assert (answer["command"], answer["health"]) == text
            assert ("bad_state" in block.reports) is (kind == "bad")
            continue
        if asked is not None and asked != q_d:
            assert ("bad_reference" in block.reports) is (asked in (0.0, 100.0))
            if asked not in (0.0, 100.0):
                last, q_d = None if last is None else last + q_d - asked, asked
        record.append((w, R))
        assert ("deep" in block.reports) is (R > 0.1)
        ages = np.arange(len(record))[::-1] * 0.01
        w_R, R_R = (np.interp(min(R, 0.1), ages[::-1], [row[c] for row in reversed(record)]) for c in (0, 1))
        e = q - q_d
        m = Measured(e, 40.0 * w / R - 2000.0, phi(w, R, 40, 2000.0, printed="phi_form" in options),
                     psi(w, R, w_R, R_R, 40), 0.0 if last is None else (e - last) / 0.01, integral)  # fmt: skip
        u, s = wanted(law, m, g, 0.0)
        if not ((law == "robust" or options.get("anti_windup")) and ((u > 1.0 and e > 0.0) or (u < 0.0 and e < 0.0))):
            integral += e * 0.01
        last, drop = e, min(max(u, 0.0), 1.0)
        text = ((drop,), (s, integral, float(not 0.0 <= u <= 1.0)))
        assert answer == {"command": near(text[0]), "health": near(text[1])}
        text = answer["command"], answer["health"]


def test_the_controller_is_exact_at_its_limits():
    """A command of exactly 0 or 1 is not clipped; a state without a window is invalid, one without a queue is valid."""
    for bias, queue, way in ((1.0, 130.0, 10.0), (0.0, 110.0, -10.0)):
        block = ByHand(AqmController(law="pi", kp=0.0, ki=0.0, bias=bias, anti_windup=True))
        outputs = block.update(0, state=(9.0, queue, 0.2), reference=None)
        assert (outputs["command"], outputs["health"]) == ((bias,), near((0.0, way * 0.001, 0.0)))
    for state, outputs in (
        ((0.0, 9.0, 0.2), ["bad_state"]),
        ((9.0, 9.0, 0.0), ["bad_state"]),
        ((9.0, -1e-9, 0.2), ["bad_state"]),
        ((9.0, 0.0, 0.2), []),
        ((9.0, 9.0, 0.5), []),
        ((9.0, 9.0, 0.501), ["deep"]),
    ):
        block = ByHand(AqmController())
        block.update(0, state=state, reference=None)
        assert list(block.reports) == outputs
    block = ByHand(AqmController())
    block.update(0, state=(9.0, -2.0, 0.25), reference=None)
    assert block.reports["bad_state"][:2] == (
        Level.ERROR,
        "state window 9, queue -2, rtt 0.25: impossible, the last command is held",
    )


def test_after_fifty_ticks_without_a_state_nothing_is_dropped_and_the_last_state_is_still_reported():
    block = ByHand(AqmController(law="pi"))
    last = block.update(0, state=(9.0, 130.0, 0.2), reference=None)
    messages = [block.refused(k) for k in range(60)]
    assert messages[:49] == [last] * 49
    assert messages[49:] == [{"command": (0.0,), "health": last["health"]}] * 11
    assert last["command"] != (0.0,)


def test_the_output_of_the_integral_is_kept_under_other_gains():
    for law, before, after, share in (
        ("sspid", {"l2": 4.0}, {"l2": 8.0}, 0.5),
        ("pi", {"ki": 2e-5}, {"ki": 1e-5}, 2.0),
        ("pi", {"ki": 2e-5}, {"ki": 0.0}, 1.0),
        ("pid", {"pid_ti": 2.0}, {"pid_ti": 4.0}, 2.0),
        ("robust", {"a": 2.0}, {"a": 1.0}, 8.0),
        ("sspd", {}, {"k1": 3.0}, 1.0),
    ):
        block = AqmController(law=law, **after)
        x = block.first()._replace(integral=6.0)
        assert block.go_on(x, AqmController(law=law, **before).p).integral == near(6.0 * share)


# the network -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("time", [0.0, 0.002, 0.003, 0.004, 0.0034])
def test_a_disturbance_acts_at_the_internal_step_nearest_to_its_time(time):
    for kind, place in (("sensor_offset", "state"), ("queue_jump", "truth")):
        made = {"period": 0.002, "h": 0.001, "w0": 1e-3, "w_min": 1e-3, "C": 100.0, "q0": 50.0, "q_max": 70.0}
        plant = ByHand(TcpFluid(**made, disturbance=kind, disturbance_time=time, disturbance_value=7.0))
        for k in range(4):
            queue = plant.outputs(k)[place][1]  # no flow sends yet, and meanwhile the link serves 0.8 packets
            assert queue == pytest.approx(57.0 if 2 * k >= round(time * 1e3) else 50.0, abs=0.9)
            plant.advance(k * 2 * MS, command=(0.0,))


def test_the_fluid_looks_back_one_round_trip():
    """The recent output, computed from an independent record of its earlier output."""
    plant, shown = ByHand(TcpFluid(w0=14.0, q0=100.0)), []
    for k in range(500):
        shown.append(plant.outputs(k)["truth"])
        plant.advance(k * MS, command=(0.008,))
    _window, queue, rtt, window_then, rtt_then, served = shown[-1]
    at = 499 - 1000.0 * rtt
    for channel, then in ((0, window_then), (2, rtt_then)):
        assert then == pytest.approx(np.interp(at, range(500), [row[channel] for row in shown]), rel=1e-6)
    assert rtt == near(queue / 3750.0 + 0.2)
    assert served == pytest.approx(0.499 * 3750.0, rel=1e-6)  # the queue never empties
    assert min(row[1] for row in shown) > 0.0
    assert shown[0] == near((14.0, 100.0, 0.2 + 100.0 / 3750.0, 14.0, 0.2 + 100.0 / 3750.0, 0.0))


def test_events_at_the_limits_are_accepted():
    for events, fits in (
        ((1.0, 3750.0, 0.2, 0.0), True),
        ((2000.0, 3750.0, 0.2, 0.0), True),
        ((2001.0, 3750.0, 0.2, 0.0), False),
        ((60.0, 3750.0, 0.92, 0.0), True),
        ((60.0, 3750.0, 0.921, 0.0), False),
        ((60.0, 3750.0, 0.004, 0.0), True),
        ((60.0, 3750.0, 0.0039, 0.0), False),
        ((0.4, 3750.0, 0.2, 0.0), False),
        ((60.0, 0.0, 0.2, 0.0), False),
    ):
        plant = TcpFluid()
        x = plant._happened(plant.first(), *events)
        flows, capacity, propagation, rate, _, seen = x.net
        assert ((flows, capacity, propagation, rate) == events) is fits
        assert seen == events
        assert list(plant.reports) == ([] if fits else ["impossible_event"])


# packets ---------------------------------------------------------------------------------------------------------

START, ACK, LOSS, SERVICE, CROSS = range(5)


class Naive:
    """Sources, queue and events as lists, by the rules in the docstring of `run_until`."""

    def __init__(self, windows, propagation, starts):
        n = len(windows)
        self.windows, self.propagation, self.way, self.halved = list(windows), propagation, [0] * n, [-1.0] * n
        self.events, self.queue, self.served, self.lost, self.drawn, self.crossing = [], [], 0, 0, 0, False
        for flow, t in enumerate(starts):
            self.later(t, START, flow)

    def later(self, t, kind, *about):
        heapq.heappush(self.events, (t, kind, about))

    def arrive(self, now, packet, rules):
        if len(self.queue) >= rules.room:
            self.lost += 1
            return False
        self.queue.append(packet)
        if len(self.queue) == 1:
            self.later(now + 1.0 / rules.C, SERVICE)
        return True

    def run(self, end, rules, rng):
        if rules.rate > 0.0 and not self.crossing:
            self.crossing = True
            self.later(end, CROSS)
        while self.events and self.events[0][0] <= end:
            now, kind, about = heapq.heappop(self.events)
            if kind == SERVICE:
                flow, marked, sent = self.queue.pop(0)
                self.served += 1
                if self.queue:
                    self.later(now + 1.0 / rules.C, SERVICE)
                if flow is not None:
                    self.later(now + self.propagation[flow], ACK, flow, marked, sent)
            elif kind == CROSS:
                self.crossing = rules.rate > 0.0
                if self.crossing:
                    self.arrive(now, (None, False, 0.0), rules)
                    self.later(now + 1.0 / rules.rate, CROSS)
            else:
                self.answer(now, kind, *about, rules=rules, rng=rng)

    def answer(self, now, kind, flow, marked=False, sent=0.0, *, rules, rng):
        if kind != START:
            self.way[flow] -= 1
            if not marked:
                self.windows[flow] = min(self.windows[flow] + 1.0 / self.windows[flow], rules.w_max)
            elif sent >= self.halved[flow]:
                self.windows[flow], self.halved[flow] = max(self.windows[flow] / 2.0, rules.w_min), now
        while self.way[flow] < math.floor(self.windows[flow]):
            self.way[flow] += 1
            self.drawn += 1
            hit = rng.random() < rules.p
            lost = (rules.drop and hit) or not self.arrive(now, (flow, hit, now), rules)
            if rules.drop and hit:
                self.lost += 1
            if lost:
                self.later(now + self.propagation[flow], LOSS, flow, True, now)


@pytest.mark.parametrize("drop", [False, True])
def test_packets_follow_their_rules(drop):
    """Four flows on a short queue, with unowned traffic for a while; every count after every period."""
    n, room = 4, 12
    rng = np.random.default_rng(3)
    windows, propagation, starts = [1.0, 3.0, 9.0, 2.0], (0.05 + 0.03 * rng.random(n)).tolist(), rng.random(n) * 0.05
    size = 400
    inside = Inside(
        Sources(
            np.array(windows),
            np.zeros(n, np.int64),
            np.array(propagation),
            np.full(n, -1.0),
            np.ones(n, np.int64),
            np.ones(n),
        ),
        Agenda(np.zeros(size), *(np.zeros(size, np.int64) for _ in range(3)), np.zeros(size)),
        Fifo(np.zeros(room + 1, np.int64), np.zeros(room + 1, np.int64), np.zeros(room + 1)),
        np.zeros(8, np.int64),
    )
    for flow, t in enumerate(starts):
        schedule(inside.agenda, inside.counts, float(t), START, flow, 0, 0.0)
    naive = Naive(windows, propagation, starts.tolist())
    own, reference = np.random.default_rng(5), np.random.default_rng(5)
    for k in range(1, 90):  # stops where two events of a flow coincide, whose order is not specified
        rules = Rules(0.02, 333.0 if 30 < k < 60 else 0.0, 987.0, room, 1.0, 20.0, drop)
        run_until(k * 0.01, rules, own, inside)
        naive.run(k * 0.01, rules, reference)
        events, most, _, waiting, served, lost, crossing, drawn = inside.counts.tolist()
        assert inside.sources.window.tolist() == near(naive.windows)
        assert inside.sources.on_the_way.tolist() == naive.way
        assert (events, waiting, served, lost, crossing, drawn) == (
            len(naive.events),
            len(naive.queue),
            naive.served,
            naive.lost,
            naive.crossing,
            naive.drawn,
        )
        assert most >= events
    assert lost > (8 if drop else 0)
    assert max(naive.windows) <= 20.0


def test_marks_halve_windows_from_the_start_on():
    plant = ByHand(TcpPackets(N=3, w0=8.0, C=1e4))
    for k in range(50):
        plant.advance(k * 10 * MS, command=(1.0,))
    assert plant.outputs(0)["truth"][0] <= 4.0


def test_traffic_is_a_value():
    """Continuing from it changes a copy; two are equal if all packets in flight are."""
    plant = TcpPackets(N=3, q0=4.0, w0=2.0)
    plant.reset(1)
    x = plant.first()
    assert plant.outputs(x, 0)["truth"][:2] == (2.0, 4.0)
    ahead = plant.advance(x, 0, command=(0.1,))
    assert x.traffic != ahead.traffic
    assert ahead.traffic == plant.advance(x, 0, command=(0.1,)).traffic
    assert x.traffic != "traffic"
    spread = x.traffic.inside.sources.propagation / 0.2
    assert spread.size == 6  # with room for twice the flows
    assert (spread.min() >= 0.95, spread.max() <= 1.05, np.ptp(spread) > 0.02) == (True, True, True)
    slower = plant.changed(x, x.net._replace(flows=5, propagation=0.4))
    assert slower.traffic.inside.sources.propagation == near(0.4 * spread)
    assert slower.traffic.inside.sources.active.tolist() == [1, 1, 1, 1, 1, 0]
    assert slower.traffic.inside.sources.window.tolist()[3:5] == [1.0, 1.0]
    fewer = plant.changed(slower, x.net._replace(flows=2))
    assert fewer.traffic.inside.sources.active.tolist() == [1, 1, 0, 0, 0, 0]
    # The jump fills the queue up to its limit of 300; four packets were in it.
    assert plant.jumped(x, 300.0).traffic.inside.counts[3] == 300
    assert plant.jumped(x, 300.0).traffic.inside.counts[5] == 4


# figures ---------------------------------------------------------------------------------------------------------


def test_figures_of_the_queue_are_loops_over_its_samples():
    t = np.arange(101) * 0.1
    x = np.sin(t) * 3.0 + 14.0
    queue = np.where(t < 5.0 - 1e-9, 100.0, 150.0)
    signals = {"w": (t, x), "q": (t, queue), "network/truth/served/position": (t, 50.0 + 3000.0 * t)}
    late = x[50:]  # the last five seconds including their first sample
    mean = sum(late) / len(late)
    assert figures.deviation(signals, "w") == near(math.sqrt(sum((v - mean) ** 2 for v in late) / len(late)))
    assert figures.deviation(signals, "w", last=0.0) == 0.0
    assert figures.utilisation(signals, capacity=3750.0) == near(0.8)
    network = {"N": 60, "C": 3750.0, "tau_p": 0.2}
    held = figures.mean_square_window(signals, "w", queue=120.0, **network)
    assert held == pytest.approx(sum((v - 14.5) ** 2 for v in x) / len(x), rel=0.03)
    windows = [(q / 3750.0 + 0.2) * 3750.0 / 60.0 for q in queue]
    asked = figures.mean_square_window(signals, "w", queue="q", **network)
    assert asked == pytest.approx(sum((v - w) ** 2 for v, w in zip(x, windows, strict=True)) / len(x), rel=0.03)
