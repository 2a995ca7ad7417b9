"""The rules of a search for violations: which point is next, what a point means, and how a case is reduced."""

import math

import numpy as np
import pytest
from cmaes import CMA
from softrig_bringup.falsify.engine import _sizes, margin
from softrig_bringup.falsify.search import needs, search
from softrig_bringup.falsify.shrink import shrink
from softrig_bringup.falsify.space import Over, Space, parse
from softrig_bringup.study.work import LARGE
from softrig_core import Scenario

# options of the command ------------------------------------------------------------------------------------------


class Account:
    """The search as its page describes it, one point after the other."""

    def __init__(self, groups, budget, f, seed, enough):
        self.groups, self.size, self.budget, self.f, self.seed = groups, sum(groups), budget, f, seed
        self.enough, self.batches, self.known, self.best, self.least = enough, [], {}, None, math.inf

    def over(self):
        return len(self.asked()) >= self.budget or self.least < self.enough

    def asked(self):
        return [p for batch in self.batches for p in batch]

    def ask(self, points):
        """Measure a batch; points beyond the budget are not measured."""
        if points:
            points = points[: self.budget - len(self.asked())]
            self.batches.append(points)
        for p in points:
            self.known[p] = self.f(p)
            if self.known[p] < self.least:
                self.best, self.least = p, self.known[p]
        return [self.known[p] for p in points]

    def corners(self, rng, few):
        """All low, all high, each parameter alone, each coordinate alone if the budget allows, then random ones."""
        listed = [(0.0,) * self.size, (1.0,) * self.size]
        ends = [sum(self.groups[: k + 1]) for k in range(len(self.groups))]
        alone = [range(end - n, end) for end, n in zip(ends, self.groups, strict=True)]
        room = len(listed) + 2 * len(alone) + 2 * self.size <= few
        for those in [*alone, *([[k] for k in range(self.size)] if room else [])]:
            inside = [float(k in those) for k in range(self.size)]
            listed += [tuple(inside), tuple(1.0 - u for u in inside)]
        listed += [tuple(map(float, rng.integers(0, 2, self.size))) for _ in range(1000)]
        once = (
            [p for k, p in enumerate(listed) if p not in listed[:k]] if self.size < 5 else list(dict.fromkeys(listed))
        )
        while once and not self.over() and len(self.asked()) < few:
            self.ask(once[:4])
            once = once[4:]

    def evolve(self, size, until, spread=lambda p: p):
        """CMA-ES from the centre, then again from the best point with the next seed."""
        seed, mean = self.seed, np.full(size, 0.5)
        while not self.over() and len(self.asked()) < until:
            cma = CMA(mean, sigma=0.3, bounds=np.array([[0.0, 1.0]] * size), seed=seed)
            while not self.over() and len(self.asked()) < until and not cma.should_stop():
                points = [cma.ask() for _ in range(cma.population_size)]
                reported = self.ask([spread(tuple(map(float, p))) for p in points])
                if len(reported) < len(points):
                    return
                cma.tell([(p, 1e300 if math.isnan(m) else m) for p, m in zip(points, reported, strict=True)])
            seed += 1
            if len(self.best or ()) == size:
                mean = np.array(self.best)

    def climb(self, point):
        """Each coordinate at both ends, repeatedly until nothing improves; whether any point was new."""
        before, better = len(self.asked()), True
        if point not in self.known:
            self.ask([point])
        while better:
            better, best_point = False, point
            for i in range(self.size):
                ends = [
                    tuple(u if k == i else x for k, x in enumerate(best_point))
                    for u in (0.0, 1.0)
                    if best_point[i] != u
                ]
                new = [p for p in ends if p not in self.known]
                if new and self.over():
                    return len(self.asked()) > before
                self.ask(new)
                for p in ends:
                    now, then = self.known.get(p, math.nan), self.known.get(best_point, math.nan)
                    if now < then or (math.isnan(then) and not math.isnan(now)):
                        best_point, better = p, True
            point = best_point
        return len(self.asked()) > before

    def cmaes(self):
        rng, first = np.random.default_rng(self.seed), max(8, round(0.1 * self.budget))
        held = 1 < len(self.groups) < self.size
        self.corners(rng, 8 if held else first)
        self.at_corners = self.least
        if held:
            self.evolve(len(self.groups), first + round(0.1 * self.budget), self.constant)
        self.evolve(self.size, self.budget - round(0.25 * self.budget))
        start = self.best or (0.0,) * self.size
        while not self.over():
            everywhere = 2**self.size == sum(all(u in (0.0, 1.0) for u in p) for p in self.known)
            if not self.climb(start) and everywhere:
                self.seed += 1
                self.evolve(self.size, self.budget)
            start = tuple(map(float, rng.integers(0, 2, self.size)))
        return self

    def constant(self, point):
        return tuple(u for u, n in zip(point, self.groups, strict=True) for _ in range(n))


MARGINS = {
    "valley": lambda p: sum((u - 0.3 - 0.05 * k) ** 2 for k, u in enumerate(p)),
    "corner": lambda p: sum(abs(u - (k % 3 == 0)) for k, u in enumerate(p)) - 0.5,
    "stairs": lambda p: float(math.floor(5.0 * math.sin(7.0 * sum(p)) + p[0])),
    "holes": lambda p: math.nan if sum(p) > 0.6 * len(p) else 1.0 - p[-1],
    "nowhere": lambda p: math.nan,
    "flat": lambda p: 1.0,
}


@pytest.mark.parametrize(
    ("groups", "name"),
    [
        *(([3, 2], name) for name in MARGINS),
        *(([2], name) for name in ("valley", "holes", "nowhere")),
        *((groups, name) for groups in ([1, 1], [1, 4, 1], [6]) for name in ("corner", "stairs")),
    ],
)
def test_the_search_measures_the_points_of_its_description(groups, name):
    """Corners, constant profiles, all coordinates, coordinate searches from corner to corner: the same points in the
    same batches.
    """
    for budget, seed, enough in ((47, 3, -math.inf), (73, 0, -0.4))[: 2 if len(groups) > 1 else 1]:
        wanted = Account(groups, budget, MARGINS[name], seed, enough).cmaes()
        batches = []

        def measure(points, batches=batches):
            batches.append(list(points))
            return [MARGINS[name](p) for p in points]

        match = search(groups, measure, budget, seed=seed, enough=enough)
        assert batches == wanted.batches
        assert (match.least, match.point, match.corners) == (wanted.least, wanted.best or (), wanted.at_corners)
        values = [math.inf if math.isnan(v := MARGINS[name](p)) else v for p in wanted.asked()]
        assert match.trace == np.minimum.accumulate(values).tolist()
        assert match.runs == len(values)


@pytest.mark.parametrize(("budget", "alone"), [(160, True), (150, False)])
def test_each_coordinate_is_tried_alone_if_a_tenth_of_the_budget_is_enough(budget, alone):
    """For six coordinates: all low, all high, and then sixteen points for each one alone."""
    asked = []
    search([6], lambda points: asked.extend(points) or [1.0 - len(asked) // 12] * len(points), budget, enough=0.0)
    assert asked[:2] == [(0.0,) * 6, (1.0,) * 6]
    first = [tuple(float(k == j) for k in range(6)) for j in range(6)]
    assert ([p for p in asked[2:12:2] if p in first] == first[:5]) == alone


@pytest.mark.parametrize(("margin", "runs"), [(0.0, 30), (-1e-300, 4)])
def test_a_margin_of_exactly_zero_is_not_a_violation_of_the_search(margin, runs):
    assert search([3], lambda points: [margin] * len(points), 30, enough=0.0).runs == runs


def test_a_random_search_measures_four_points_at_a_time():
    asked = []
    match = search([2, 1], lambda points: asked.append(points) or [p[0] for p in points], 10, seed=5, sampler="random")
    drawn = [tuple(p) for p in np.random.default_rng(5).random((12, 3)).tolist()]
    assert asked == [drawn[:4], drawn[4:8], drawn[8:10]]
    assert match.corners == math.inf


def test_a_sampler_needs_a_package_or_none():
    entries = {(s, n): needs(s, n) for s in ("cmaes", "tpe", "random") for n in (1, 2, 9)}
    assert entries == {
        ("cmaes", 1): "optuna", ("cmaes", 2): "cmaes", ("cmaes", 9): "cmaes",
        **{("tpe", n): "optuna" for n in (1, 2, 9)}, **{("random", n): "" for n in (1, 2, 9)},
    }  # fmt: skip


def test_for_one_number_optunas_estimator_proposes_four_points_at_a_time():
    import optuna

    asked = []

    def measure(points):
        asked.append(points)
        return [math.nan if p[0] > 0.8 else (p[0] - 0.3) ** 2 for p in points]

    search([1], measure, 24, seed=7)
    corners, *remaining = list(asked)
    assert corners == [(0.0,), (1.0,)]  # one parameter has only two corners
    for seed, batches in (
        (7, remaining[:4]),
        (8, remaining[4:]),
    ):  # TPE uses up to three quarters of the budget and restarts because no corner remains
        study = optuna.create_study(sampler=optuna.samplers.TPESampler(seed=seed, constant_liar=True))
        for batch in batches:
            trials = [study.ask({"u000": optuna.distributions.FloatDistribution(0.0, 1.0)}) for _ in range(4)]
            points = [(t.params["u000"],) for t in trials]
            assert batch == points[: len(batch)]
            for trial, m in zip(trials, measure(points), strict=True):
                study.tell(trial, 1e300 if math.isnan(m) else m)
    assert list(map(len, remaining)) == [4, 4, 4, 4, 4, 2]


# what a point means ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("-1..3", {-0.5: -1.0, 0.0: -1.0, 0.25: 0.0, 0.5: 1.0, 1.0: 3.0, 1.5: 3.0}),
        ("log 0.01..100", {0.0: 0.01, 0.25: 0.1, 0.5: 1.0, 0.75: 10.0, 1.0: 100.0}),
        ("2..2", {0.0: 2.0, 0.3: 2.0, 1.0: 2.0}),
        ("0.1..0.7", {0.0: 0.1, 1.0: 0.7}),
    ],
)
def test_a_number_of_the_unit_interval_maps_to_the_range_and_back(text, values):
    over = parse("node.k", text)
    for u, value in values.items():
        assert over.value(u) == (value if u in (0.0, 1.0) else pytest.approx(value, rel=1e-12, abs=1e-12))
        if over.low < over.high:
            assert over.place(value) == pytest.approx(min(max(u, 0.0), 1.0), abs=1e-12)
    assert parse("node.k", "2..2").place(2.0) == 0.0


def test_a_range_names_its_parameter():
    number, vector, course, added = (
        parse(*words)
        for words in (("n.k", "1..2"), (" n.v ", "1..2*3"), ("a/b/c", "log 1..2*4"), ("a/b/c + ", "-1..2~5"))
    )
    assert [
        (o.key, o.on_signal, o.adds, o.size, o.count, o.log, o.linear) for o in (number, vector, course, added)
    ] == [
        ("n.k", False, False, 1, 0, False, False),
        ("n.v", False, False, 3, 3, False, False),
        ("a/b/c", True, False, 4, 4, True, False),
        ("a/b/c", True, True, 5, 5, False, True),
    ]


def of(*overs, nominal=(), whole=(), faults=None, plots=()):
    """A space of a scenario that nothing runs."""
    targets = tuple("profile_0.points" if o.on_signal else o.key for o in overs)
    whole = whole or (False,) * len(overs)
    scenario = Scenario.model_validate(
        {"name": "s", "title": "s", "system": "s", "source": "", "duration": 1.0, "faults": faults or {},
         "nodes": {"n": {"package": "p", "executable": "e"}}, "plots": list(plots)}
    )  # fmt: skip
    return Space(scenario, overs, targets, tuple(nominal) or (None,) * len(overs), tuple(whole))


def test_a_point_of_the_cube_sets_its_coordinates_in_their_order():
    overs = (Over(0.0, 10.0, key="n.k"), Over(-1.0, 1.0, count=3, key="n.v"), Over(1.0, 4.0, key="n.i"),
             Over(1.0, 4.0, count=1, key="n.one"))  # fmt: skip
    space = of(*overs, whole=(False, False, True, True))
    assert space.size == 6
    assert space.names() == ["n.k", "n.v.0", "n.v.1", "n.v.2", "n.i", "n.one.0"]
    assert space.overrides([0.25, 0.0, 0.5, 1.0, 0.4, 0.1]) == {
        "n.k": 2.5, "n.v": [-1.0, 0.0, 1.0], "n.i": 2, "n.one": [1],
    }  # fmt: skip
    assert isinstance(space.overrides([0.0] * 6)["n.i"], int)


# made small ------------------------------------------------------------------------------------------------------


def tried(space, overrides, violates=lambda changes: False, budget=1000):
    """The tried values in order, and the remaining ones."""
    seen = []

    def asked(case):
        seen.append((tuple(case[0].faults), case[1]))
        return violates(case[1])

    case, runs = shrink(space, overrides, asked, budget)
    assert runs == len(seen)
    return seen, case


def test_steps_are_tried_equal_to_their_neighbours_then_at_zero():
    course = Over(-1.0, 4.0, count=5, key="a/b/c", adds=True)
    seen, (_, left) = tried(of(course), {"profile_0.points": [1.0, 2.0, 2.0, 0.0, 3.0]})
    assert [changes["profile_0.points"] for _, changes in seen] == [
        # Each of the first two levels takes the value of the other.
        [1.0, 1.0, 1.0, 0.0, 3.0], [2.0, 2.0, 2.0, 0.0, 3.0],
        [1.0, 2.0, 2.0, 2.0, 3.0], [1.0, 0.0, 0.0, 0.0, 3.0],
        [1.0, 2.0, 2.0, 0.0, 0.0], [1.0, 2.0, 2.0, 3.0, 3.0],
        [0.0, 2.0, 2.0, 0.0, 3.0], [1.0, 0.0, 2.0, 0.0, 3.0], [1.0, 2.0, 0.0, 0.0, 3.0], [1.0, 2.0, 2.0, 0.0, 0.0],
    ]  # fmt: skip
    assert left == {"profile_0.points": [1.0, 2.0, 2.0, 0.0, 3.0]}


@pytest.mark.parametrize(
    ("over", "zeros"),
    [
        (Over(-1.0, 4.0, count=2, key="a/b/c", adds=True), [[0.0, 3.0], [2.0, 0.0]]),
        (Over(0.0, 4.0, count=2, key="a/b/c", adds=True), [[0.0, 3.0], [2.0, 0.0]]),
        (Over(-4.0, 0.0, count=2, key="a/b/c", adds=True), [[0.0, 3.0], [2.0, 0.0]]),
        (Over(1.0, 4.0, count=2, key="a/b/c", adds=True), []),  # zero is outside of its range
        (Over(-4.0, -1.0, count=2, key="a/b/c", adds=True), []),
        # A fault that replaces a signal has an effect even with the value zero.
        (Over(-1.0, 4.0, count=2, key="a/b/c"), []),
    ],
)
def test_only_values_inside_the_range_are_tried(over, zeros):
    seen, _ = tried(of(over), {"profile_0.points": [2.0, 3.0]})
    assert [changes["profile_0.points"] for _, changes in seen] == [[2.0, 2.0], [3.0, 3.0], *zeros]


def test_a_violation_of_level_steps_stays_level():
    """At least four of five steps must be two or more: one is free, the others need one level."""
    course = Over(0.0, 4.0, count=5, key="a/b/c")
    _, (_, left) = tried(
        of(course), {"profile_0.points": [1.0, 4.0, 2.0, 3.0, 4.0]},
        lambda changes: sum(x >= 2.0 for x in changes["profile_0.points"]) >= 4,
    )  # fmt: skip
    assert left["profile_0.points"] == [4.0] * 5


@pytest.mark.parametrize(
    ("over", "nominal", "worst", "whole", "limit", "left"),
    [
        (Over(0.0, 8.0, key="n.k"), 0.0, 8.0, False, 3.0, 3.0),
        (Over(0.0, 8.0, key="n.k"), 8.0, 0.0, False, 3.0, 3.0),
        (Over(0.0, 8.0, key="n.k"), 2.0, 8.0, False, -1.0, None),  # the nominal value violates the requirement too
        (Over(0.01, 100.0, log=True, key="n.k"), 0.01, 100.0, False, 0.1, 0.1),
        (Over(1.0, 9.0, log=True, key="n.k"), 0.0, 9.0, False, 3.0, 3.0),  # the nominal value has no logarithm
        (Over(0.0, 50.0, key="n.k"), 0, 50, True, 17, 17),
        (Over(0.0, 8.0, count=2, key="n.v"), [0.0, 4.0], [8.0, 7.0], False, 3.0, [3.0, 5.125]),
        # A list of another length is not changed.
        (Over(0.0, 8.0, count=2, key="n.v"), [0.0], [8.0, 7.0], False, 3.0, [8.0, 7.0]),
    ],
)  # fmt: skip
def test_a_parameter_is_moved_back_as_far_as_the_violation_lasts(over, nominal, worst, whole, limit, left):
    def first(changes):
        value = changes.get(over.key, nominal)
        return value[0] if isinstance(value, list) else value

    up = first({over.key: worst}) > first({})

    def violates(changes):
        value = changes.get(over.key, nominal)
        level = isinstance(value, list) and value == value[:1] * 2
        return not level and (first(changes) >= limit if up else first(changes) <= limit)

    seen, (_, result) = tried(of(over, nominal=(nominal,), whole=(whole,)), {over.key: worst}, violates)
    assert seen[0][1] == {}  # the first run is the unchanged scenario
    if left is None:
        assert result == {}
    elif whole or left == worst:
        assert result == {over.key: left}
    else:
        distance = np.abs(np.array(result[over.key]) - left) / np.abs(np.subtract(worst, nominal))
        # One step of the bisection in log scale is a factor 10^(4 / 4096), here up to 9.3 times as far.
        assert (distance <= 1.0 / 4096.0 * (9.3 if over.log and nominal else 1.0)).all()
        assert violates(result)


def test_the_interval_is_halved_twelve_times_or_until_the_budget_ends():
    space = of(Over(0.0, 1.0, key="n.k"), nominal=(0.0,))
    seen, (_, left) = tried(space, {"n.k": 1.0})
    assert [changes.get("n.k") for _, changes in seen] == [None, *(1.0 - 0.5**k for k in range(1, 13))]
    assert left == {"n.k": 1.0}
    seen, (_, left) = tried(space, {"n.k": 1.0}, lambda changes: changes.get("n.k", 0.0) >= 0.1, budget=3)
    assert ([changes.get("n.k") for _, changes in seen], left) == ([None, 0.5, 0.25], {"n.k": 0.25})


def test_faults_are_removed_with_their_parameters_and_their_pictures():
    faults = {name: {"link": f"{topic} -> law", "kind": "noise", "value": [0.1]} for name, topic in
              (("noise", "m/state"), ("noise_2", "m/state"), ("late", "m/command"))}  # fmt: skip
    signals = ("m/state/x", "m/state/noise/x", "m/state/noise_2/x", "m/command/late/u")
    plots = [{"title": "Both", "signals": dict.fromkeys(signals, "")}, {"title": "One", "signals": {signals[1]: ""}}]
    space = of(Over(0.0, 1.0, key="noise.value"), nominal=(0.1,), faults=faults, plots=plots)
    changes = {"noise.value": 0.7, "noise_2.value": 0.5}
    seen, (scenario, left) = tried(space, changes, lambda changes: "noise_2.value" in changes)
    assert [(list(present), list(changed)) for present, changed in seen] == [
        (["noise_2", "late"], ["noise_2.value"]),
        (["late"], []),
        (["noise_2"], ["noise_2.value"]),
        ([], []),
    ]
    assert (list(scenario.faults), left) == (["noise_2"], {"noise_2.value": 0.5})
    assert [(p.title, list(p.signals)) for p in scenario.plots] == [("Both", ["m/state/x", "m/state/noise_2/x"])]


# margins ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("nominal", "sizes"),
    [
        ({"a": 4.0}, {"a": 1.0}),
        ({"a": 4.0, "b": -0.5, "c": 0.0, "d": None, "e": LARGE, "f": -LARGE, "g": 1e299},
         {"a": 4.0, "b": 0.5, "c": 1.0, "d": 1.0, "e": 1.0, "f": 1.0, "g": 1e299}),
    ],
)  # fmt: skip
def test_margins_are_scaled_by_their_size_without_changes(nominal, sizes):
    assert _sizes(nominal) == sizes


def test_the_least_of_several_margins_counts_and_a_missing_one_leaves_none():
    sizes = {"a": 4.0, "b": 0.5}
    assert margin({"a": 1.0, "b": 0.5}, sizes) == 0.25
    assert margin({"a": 8.0, "b": 0.5}, sizes) == 1.0
    assert math.isnan(margin({"a": 8.0, "b": None}, sizes))
