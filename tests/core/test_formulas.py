"""Random formulas of the whole grammar, on random records, against the definition in plain loops.

The records end anywhere: within windows, before them, at their last tick. Numbers are missing, arithmetic is undefined,
signals come late. Compared with the loops: the margin of the whole record, and the live bounds after each of its ticks.
"""

import math
import random

import numpy as np
import pytest
from softrig_core import SECOND
from softrig_core.judge import one_pass
from softrig_core.judge.formula import outline, read
from softrig_core.judge.live import Live
from softrig_core.judge.robustness import NotJudged, Record, truth
from softrig_core.kit.jit import Jit

PERIOD = 0.1
DAILY, ALL = 150, 2000
KNOWN = {"x": None, "y": None, "fault": None, "level": 0.5}


def defined(function):
    """The distance of a comparison at an instant, NaN if it is undefined."""

    def distance(s):
        try:
            result = float(function(s))
        except (ValueError, ZeroDivisionError, OverflowError):
            return math.nan
        return result if math.isfinite(result) else math.nan

    return distance


def greater(a, b):
    return math.nan if math.isnan(a) or math.isnan(b) else max(a, b)


ATOMS = {
    "x > level": lambda s: s["x"] - 0.5,
    "y <= 0.25 * x": lambda s: 0.25 * s["x"] - s["y"],
    "abs(x - y) < 1": lambda s: 1.0 - abs(s["x"] - s["y"]),
    "max(x, y, -1) >= 0": lambda s: greater(greater(s["x"], s["y"]), -1.0),
    "x == level": lambda s: -abs(s["x"] - 0.5),
    "y != 0": lambda s: abs(s["y"]),
    "log(x) > 0": lambda s: math.log10(s["x"]),
    "sqrt(y) < 1 + ln(2)": lambda s: 1.0 + math.log(2.0) - math.sqrt(s["y"]),
    "x / floor(y) < 1": lambda s: 1.0 - s["x"] / math.floor(s["y"]),
    "exp(x * 400) > 1": lambda s: math.exp(s["x"] * 400.0) - 1.0,
    "x^2 % level < 0.25": lambda s: 0.25 - math.fmod(s["x"] ** 2, 0.5),
}
CONDITIONS = {
    "fault": lambda now, before: now > 0.5,
    "rising(fault)": lambda now, before: now > before,
    "falling(fault)": lambda now, before: now < before,
    "changed(fault)": lambda now, before: now != before,
}
PAST = ("once", "historically")


def draw(rng, leaves):
    """A formula as nested tuples; intervals in ticks, None without end; some are between two ticks."""
    if leaves <= 1 and rng.random() < 0.6:
        return ("atom", rng.choice([*ATOMS] * 2 + [*CONDITIONS]))
    kind = rng.choice(["not", "and", "or", "->", "always", "eventually", "once", "historically", "until", "since"])
    if kind == "not":
        return kind, draw(rng, leaves - 1)
    low = rng.choice([0, 0, 1, 2])
    window = (low, None if rng.random() < 0.25 else low + rng.choice([0, 1, 2, 4]))
    if rng.random() < 0.1:
        window = (low + 0.2, low + 0.7)
    if kind in ("and", "or", "->"):
        return kind, draw(rng, leaves // 2), draw(rng, leaves // 2)
    if kind in ("until", "since"):
        return kind, window, draw(rng, leaves // 2), draw(rng, leaves // 2)
    return kind, window, draw(rng, leaves - 1)


def write(tree):
    kind, *parts = tree
    if kind == "atom":
        return parts[0]
    if kind == "not":
        return f"not ({write(parts[0])})"
    if kind in ("and", "or", "->"):
        return f"(({write(parts[0])}) {kind} ({write(parts[1])}))"
    low, high = parts[0]
    window = "" if high is None and low == 0 else f"[{low / 10:g}, {'inf' if high is None else f'{high / 10:g}'}]"
    if kind in ("until", "since"):
        return f"(({write(parts[1])}) {kind}{window} ({write(parts[2])}))"
    return f"({kind}{window} ({write(parts[1])}))"


class Loops:
    """The definition: the least (0) or greatest (1) margin over all continuations of the record and all values of what
    is undefined.
    """

    def __init__(self, samples, first, ended):
        self.samples, self.first, self.ended, self.known = samples, first, ended, {}

    def at(self, tree, k, arrived, lost):
        key = id(tree), k, arrived, lost
        if key not in self.known:
            self.known[key] = self.measured(tree, k, arrived, lost)
        return self.known[key]

    def atom(self, text, k, lost):
        now = self.samples[k]
        if text in CONDITIONS:
            before = self.samples[max(k - 1, 0)]
            unsure = math.isnan(now["fault"]) or (text != "fault" and math.isnan(before["fault"]))
            value = math.nan if unsure else math.inf if CONDITIONS[text](now["fault"], before["fault"]) else -math.inf
        elif any(name in text.replace("max", "").replace("exp", "") and k < self.first[name] for name in ("x", "y")):
            return -math.inf
        else:
            value = defined(ATOMS[text])(now)
        return value if not math.isnan(value) else math.inf if lost else -math.inf

    def measured(self, tree, k, arrived, lost):
        kind, *parts = tree
        unknown = math.inf if arrived else -math.inf
        n = len(self.samples)
        if kind == "atom":
            return self.atom(parts[0], k, lost)
        if kind == "not":
            return -self.at(parts[0], k, 1 - arrived, 1 - lost)
        if kind in ("and", "or", "->"):
            a = -self.at(parts[0], k, 1 - arrived, 1 - lost) if kind == "->" else self.at(parts[0], k, arrived, lost)
            b = self.at(parts[1], k, arrived, lost)
            return min(a, b) if kind == "and" else max(a, b)
        (low, high), *inner = parts
        if kind in (*PAST, "since"):
            window = range(0 if high is None else max(0, math.ceil(k - high)), math.floor(k - low) + 1)
            if kind == "since":
                held = {
                    i: min((self.at(inner[0], j, arrived, lost) for j in range(i + 1, k + 1)), default=math.inf)
                    for i in window
                }
                return max((min(self.at(inner[1], i, arrived, lost), held[i]) for i in window), default=-math.inf)
            values = [self.at(inner[0], i, arrived, lost) for i in window]
            return min(values, default=math.inf) if kind == "historically" else max(values, default=-math.inf)
        # At the end of a record, only what is known and decided counts.
        if high is None and self.ended and k + low < n:
            beyond, used = False, (1 if kind == "always" else 0)
        else:
            # In a live run the next instant can be any time after the last one.
            last = n - (0.0 if self.ended else 0.999)
            beyond, used = high is None or k + high >= last, arrived
        window = range(math.ceil(k + low), n if high is None else min(n, math.floor(k + high) + 1))
        if kind == "until":
            results = [
                min([self.at(inner[1], i, used, lost)] + [self.at(inner[0], j, used, lost) for j in range(k, i)])
                for i in window
            ]
            if beyond:
                results.append(min([unknown] + [self.at(inner[0], j, used, lost) for j in range(k, n)]))
            return max(results, default=-math.inf)
        values = [self.at(inner[0], i, used, lost) for i in window] + ([unknown] if beyond else [])
        return min(values, default=math.inf) if kind == "always" else max(values, default=-math.inf)

    def window(self, tree, k):
        """Instants of the record that an operator without `until` or `since` considers."""
        kind, (low, high), _ = tree
        n = len(self.samples)
        if kind in PAST:
            return range(0 if high is None else max(0, math.ceil(k - high)), math.floor(k - low) + 1)
        return range(math.ceil(k + low), n if high is None else min(n, math.floor(k + high) + 1))

    def decides(self, tree, k, arrived, lost):
        """The instant whose comparison gives a bound of an ended record: the first side, the first of equals."""
        kind, *parts = tree
        if kind == "not":
            return self.decides(parts[0], k, 1 - arrived, 1 - lost)
        if kind in ("and", "or", "->"):
            first = (1 - arrived, 1 - lost) if kind == "->" else (arrived, lost)
            a, b = self.at(parts[0], k, *first), self.at(parts[1], k, arrived, lost)
            if a <= b if kind == "and" else (-a if kind == "->" else a) >= b:
                return self.decides(parts[0], k, *first)
            return self.decides(parts[1], k, arrived, lost)
        if kind in ("atom", "until", "since"):
            return k
        window = self.window(tree, k)
        if not window:
            return k
        if kind not in PAST and parts[0][1] is None:
            arrived = 1 if kind == "always" else 0
        pick = min if kind in ("always", "historically") else max
        at = pick(window, key=lambda i: self.at(parts[1], i, arrived, lost))
        return self.decides(parts[1], at, arrived, lost)

    def violated(self, tree):
        """First and last instants of the spans in which what must always hold certainly does not."""
        if tree[0] == "and":
            return sorted(span for part in tree[1:] for span in self.violated(part))
        if tree[0] != "always":
            return []
        bad = [k for k in self.window(tree, 0) if self.at(tree[2], k, 1, 1) < 0.0]
        begins = [k for k in bad if k - 1 not in bad]
        return [(a, b) for a, b in zip(begins, [k for k in bad if k + 1 not in bad], strict=True)]

    def open_from(self, tree):
        """First instant at which the condition of an outermost operator without end may hold or not."""
        kind, *parts = tree
        if kind in ("not", "and", "or", "->"):
            return min(self.open_from(part) for part in parts)
        if kind not in ("always", "eventually") or parts[0][1] is not None:
            return math.inf
        still = (k for k in self.window(tree, 0) if self.at(parts[1], k, 0, 0) < 0.0 <= self.at(parts[1], k, 1, 1))
        return next(still, math.inf)

    def undefined(self, tree):
        """Instants at which a comparison has no number."""
        if tree[0] == "atom":
            return {k for k in range(len(self.samples)) if self.atom(tree[1], k, 0) != self.atom(tree[1], k, 1)}
        return set().union(*(self.undefined(part) for part in tree[1:] if isinstance(part[0], str)))

    def not_judged(self, tree):
        """The reason why it may hold or not."""
        lost, n = sorted(self.undefined(tree)), len(self.samples)
        if lost and any(self.at(tree, 0, arrived, 0) != self.at(tree, 0, arrived, 1) for arrived in (0, 1)):
            on = len(lost) == n - lost[0]
            when = f"from t = {lost[0] / 10:.6g} s on" if on else f"at t = {lost[0] / 10:.6g} s"
            return f"not judged: undefined {when} (no number, a division by zero or a function beyond its domain)"
        return (
            f"not judged: the record ends at {(n - 1) / 10:.6g} s, the requirement's last window at "
            f"{farthest(tree) / 10:.6g} s"
        )


def farthest(tree):
    """How far ahead a formula looks, ticks."""
    kind, *parts = tree
    if kind == "atom":
        return 0.0
    below = max(farthest(part) for part in parts if isinstance(part[0], str))
    if kind in ("always", "eventually", "until"):
        below += parts[0][0] if parts[0][1] is None else parts[0][1]
    return below


def drawn(seed):
    """A formula with its text, the samples of a record, and the first tick of each signal."""
    rng = random.Random(seed)
    end = rng.choice([None, None, 0, 3, 6])
    tree = (rng.choice(["always", "eventually"]), (0, end), draw(rng, rng.choice([1, 3, 6])))
    if rng.random() < 0.2:
        tree = ("and", tree, ("always", (rng.choice([0, 0, 2]), None), draw(rng, 1)))
    n = rng.choice([1, 2, 3, 5, 8, 13])
    missing = rng.choice([0.0, 0.0, 0.0, 0.15])

    def value():
        return (
            math.nan if rng.random() < missing else rng.choice([rng.uniform(-1.5, 1.5), rng.uniform(0.3, 2), 0.0, 0.5])
        )

    samples = [
        {"x": value(), "y": value(), "fault": math.nan if rng.random() < missing else rng.choice([0.0, 1.0])}
        for _ in range(n)
    ]
    first = {"x": 0, "y": rng.choice([0, 0, 0, 2]), "fault": 0}
    return tree, samples, first


def columns(samples, first, conditions, n):
    x = {name: np.array([s[name] for s in samples[:n]]) for name in ("x", "y")}
    fault = np.array([s["fault"] for s in samples[:n]])
    before = np.concatenate((fault[:1], fault[:-1]))
    truths = {name: truth(condition, fault, before) for name, condition in conditions.items()}
    return x, truths, {name: np.arange(n) < first[name] for name in x}


def hold(seed):
    tree, samples, first = drawn(seed)
    text = write(tree)
    parsed, conditions = read(text, KNOWN)
    times = np.array([round(k * PERIOD * SECOND) for k in range(len(samples))], dtype=np.float64)
    x, truths, late = columns(samples, first, conditions, len(samples))
    after = round(len(samples) * PERIOD * SECOND)
    record = Record(times, x, truths=truths, late=late, after=after)
    loops = Loops(samples, first, ended=True)
    least, greatest = loops.at(tree, 0, 0, 0), loops.at(tree, 0, 1, 1)
    about = f"{seed}: {text}"
    assert record.bounds(parsed)[0, 0, 0] == pytest.approx(least, abs=1e-12), about
    assert record.bounds(parsed)[1, 1, 0] == pytest.approx(greatest, abs=1e-12), about
    if least < 0.0 <= greatest:
        with pytest.raises(NotJudged) as why:
            record.margin(parsed)
        assert str(why.value) == loops.not_judged(tree), about
        verdict = None
    else:
        margin = record.margin(parsed)
        assert margin.value == pytest.approx(greatest if greatest < 0.0 else least, abs=1e-12), about
        at = loops.decides(tree, 0, *((1, 1) if greatest < 0.0 else (0, 0)))
        spans = (loops.violated(tree) or [(at, at)]) if greatest < 0.0 else []
        lost = loops.undefined(tree)
        opened = min(lost) if lost and least != greatest else loops.open_from(tree)
        opened = opened if least == greatest else min(opened, len(samples) - 1)
        assert (margin.at, margin.bounds) == (at / 10, pytest.approx((least, greatest), abs=1e-12)), about
        assert (margin.violated, margin.open_from) == (tuple((a / 10, b / 10) for a, b in spans), opened / 10), about
        verdict = margin.value >= 0.0
    live, passed = Live(parsed), []
    opened = live.first()
    for n in range(1, len(samples) + 1):
        row = ({name: column[n - 1] for name, column in group.items()} for group in (x, truths, late))
        opened = live.push(opened, times[n - 1], *row)
        result, loops = live.bounds(opened), Loops(samples[:n], first, ended=False)
        expected = loops.at(tree, 0, 0, 0), loops.at(tree, 0, 1, 1)
        assert result == pytest.approx(expected, abs=1e-12), (about, n)
        assert not passed or (result[0] >= passed[-1][0] and result[1] <= passed[-1][1]), (about, n)
        assert not passed or not passed[-1][2] or passed[-1][:2] == result, (about, n)
        passed.append((*result, live.decided(opened)))
    return verdict


@pytest.mark.parametrize("text", ["always(x > 0)", "always[0, 1](x > 0)", "x > 0 and eventually(x > 0)"])
def test_during_a_run_the_first_instant_counts(text):
    live = Live(read(text, KNOWN)[0])
    opened = live.push(live.first(), 0.0, {"x": -2.0}, {}, {"x": False})
    assert live.bounds(opened)[1] == -2.0
    opened = live.push(opened, 2e9, {"x": 5.0}, {}, {"x": False})
    assert live.bounds(opened)[1] == -2.0


@pytest.mark.parametrize(
    ("text", "value"),
    [("x > 1 until y > 0", -1.0), ("x > 1 until[0, 1] y > -3", 2.0), ("always (y > -3 since x > 1)", 2.0)],
)
def test_operators_with_two_formulas_are_measured_in_a_record_of_one_sample(text, value):
    record = Record(np.zeros(1), {"x": np.array([3.0]), "y": np.array([-1.0])})
    assert record.margin(read(text, {"x": None, "y": None})[0]).value == value


def test_random_formulas_are_measured_as_defined():
    verdicts = [hold(seed) for seed in range(DAILY)]
    for each in (True, False, None):  # the drawn formulas have all three verdicts
        assert verdicts.count(each) > DAILY / 20


@pytest.mark.long
@pytest.mark.parametrize("share", range(10))
def test_all_random_formulas_are_measured_as_defined(share):
    for seed in range(share, ALL, 10):
        hold(seed)


ONE_PASS = ["always abs(x) <= 2", "always[0.1, inf] abs(x - y) <= 0.01 * abs(y) + level",
            "always (x*x + y*y <= (level + 1)^2 and x*x + y*y >= (level - 2)^2)", "eventually[0.1, 0.6] x >= level",
            "always (fault -> y < 2)", "always not (x == y)", "always max(abs(x), abs(y)) <= level",
            "eventually min(x, y) / x > 2", "always (sqrt(x) < level or y != x)", "always[0.4, 0.6] x < level",
            "always 1 <= level"]  # fmt: skip


@pytest.fixture(scope="module")
def interpreted():
    """Read the instructions in Python, in blocks of seven samples."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(one_pass, "BLOCK", 7)
        patch.setattr(one_pass, "SPANS", 3)
        plain = Jit(one_pass.extreme.py_func).straight()
        plain.pays = lambda *arguments: True
        patch.setattr(one_pass, "extreme", plain)
        yield


def both(formula, rng, size):
    """Return the results of one pass and of the reference for a random record: a margin, or why there is none."""
    times, y = np.arange(size) * PERIOD * SECOND, rng.normal(size=size)
    x = rng.normal(size=size) * rng.choice([0.1, 1.0, 3.0])
    kind = rng.integers(5)
    if kind == 0:
        x[rng.integers(size)] = rng.choice([math.nan, math.inf, 0.0])
    elif kind == 1:
        x, y = np.round(x), np.round(y)
    known = {**KNOWN, "level": float(rng.choice([0.5, 2.0, 5.0]))}
    tree = outline(formula, known).tree
    truths = {"_true__fault": np.where(rng.random(size) > 0.5, math.inf, -math.inf)}
    record = Record(times, {**known, "x": x, "y": y}, truths=truths, after=size * PERIOD * SECOND)
    results = []
    for native in (one_pass.OnePass(tree), None):
        try:
            with np.errstate(all="ignore"):
                results.append(repr(record.margin(tree, native)))
        except NotJudged as reason:
            results.append(str(reason))
    return results


@pytest.mark.parametrize("formula", ONE_PASS)
@pytest.mark.usefixtures("interpreted")
def test_one_pass_is_the_reference_in_value_instant_and_spans(formula):
    rng = np.random.default_rng(3)
    for _ in range(12):
        one, other = both(formula, rng, int(rng.integers(1, 30)))
        assert one == other


@pytest.mark.long
@pytest.mark.parametrize("formula", ONE_PASS)
def test_one_pass_natively_is_the_reference(formula, monkeypatch):
    monkeypatch.setattr(one_pass.extreme, "pays", lambda *arguments: True)
    rng = np.random.default_rng(4)
    for _ in range(50):
        one, other = both(formula, rng, int(rng.integers(1, 3000)))
        assert one == other


def test_one_pass_returns_the_margin_without_the_reference_method(interpreted):
    x = np.array([3.0, -1.0, -2.0, 4.0, -5.0])
    least = one_pass.OnePass(outline("always x >= 0", KNOWN).tree)
    assert least({"x": x}, least.constants({}), 0, 4) == (-5.0, 4, [(1, 2), (4, 4)])
    greatest = one_pass.OnePass(outline("eventually[0, 1] x >= level", KNOWN).tree)
    assert greatest({"x": x}, greatest.constants({"level": 0.5}), 1, 3)[:2] == (3.5, 3)


@pytest.mark.parametrize("formula", ["always (x > 0 -> eventually[0, 1] y > 0)", "always x^2 < 1", "x < 1 until y > 0"])
def test_other_forms_have_no_instructions(formula):
    with pytest.raises(LookupError):
        one_pass.OnePass(outline(formula, KNOWN).tree)
