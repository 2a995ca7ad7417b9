"""Each swarm moves by its published rule: every candidate against plain loops written from the formulas."""

import inspect
import itertools
import math

import numpy as np
import pytest
from helpers import Transformer
from hypothesis import example, given, settings, strategies as st
from scipy.optimize import minimize_scalar
from softrig_optim.de import DifferentialEvolution
from softrig_optim.genetic import Genetic
from softrig_optim.load_line import CertifiedSearch, RampScan
from softrig_optim.perturb import PerturbObserve
from softrig_optim.pso import ParticleSwarm
from softrig_optim.scan import Scan
from softrig_optim.search import Search, run
from softrig_power.baselines.firefly import Firefly
from softrig_power.baselines.salp import ImprovedSalpSwarm, SalpSwarm
from softrig_power.baselines.whale import Whale
from softrig_power.baselines.wolf import GreyWolf

LOWER, UPPER = (0.5, 1.0, 0.2), (3.5, 2.2, 0.9)  # all different, so that a mix-up is detected


def steps(x):
    """A cost with many equal values, so that their order counts."""
    return float(round(2.0 * ((x[0] - 2.0) ** 2 + 3.0 * abs(x[1] - 1.9) + math.cos(20.0 * x[2]))))


class Rule:
    """The common part of the rules: the box, the random numbers as the search draws them, the record of evaluations."""

    def __init__(self, seed, n, iterations):
        self.rng, self.n, self.iterations, self.record = np.random.default_rng(seed), n, iterations, []
        self.x = [
            [a + (b - a) * u for a, b, u in zip(LOWER, UPPER, row, strict=True)]
            for row in self.rng.random((n, 3)).tolist()
        ]

    def cost(self, x):
        self.record.append(tuple(x))
        return steps(x)

    def all_costs(self):
        return [self.cost(x) for x in self.x]

    def inside(self, x):
        return [min(max(v, a), b) for v, a, b in zip(x, LOWER, UPPER, strict=True)]


def particles(rule, w=0.4, c1=1.2, c2=1.6):
    v = [[0.0] * 3 for _ in rule.x]
    own, own_costs = list(rule.x), rule.all_costs()
    for _ in range(rule.iterations):
        best = own[own_costs.index(min(own_costs))]
        r1, r2 = rule.rng.random((2, rule.n, 3)).tolist()
        for i, x in enumerate(rule.x):
            for j in range(3):
                v[i][j] = w * v[i][j] + c1 * r1[i][j] * (own[i][j] - x[j]) + c2 * r2[i][j] * (best[j] - x[j])
            rule.x[i] = rule.inside([a + b for a, b in zip(x, v[i], strict=True)])
        for i, cost in enumerate(rule.all_costs()):
            if cost < own_costs[i]:
                own[i], own_costs[i] = rule.x[i], cost


def evolution(rule, variant="rand1", f_min=0.2, f_max=0.8, cr=0.3):
    costs = rule.all_costs()
    for _ in range(rule.iterations):
        for i in range(rule.n):
            a, b, c = rule.rng.choice([k for k in range(rule.n) if k != i], 3, replace=False)
            base = rule.x[a] if variant == "rand1" else rule.x[costs.index(min(costs))]
            f = f_min + (f_max - f_min) * rule.rng.random()
            crossed = [u < cr for u in rule.rng.random(3).tolist()]
            always = rule.rng.integers(3)
            trial = [
                base[j] + f * (rule.x[b][j] - rule.x[c][j]) if crossed[j] or j == always else rule.x[i][j]
                for j in range(3)
            ]
            trial = rule.inside(trial)
            cost = rule.cost(trial)
            if cost <= costs[i]:
                rule.x[i], costs[i] = trial, cost


def fireflies(rule, all_pairs=False, beta0=2.0, alpha=0.6, gamma=1.0):
    costs = rule.all_costs()
    for _ in range(rule.iterations):
        for i, j in itertools.permutations(range(rule.n), 2):
            brighter = costs[j] < costs[i]
            if brighter:
                moved, partner = rule.x[i], rule.x[j]
                pull = beta0 * math.exp(-gamma * math.dist(moved, partner) ** 2)
                noise = rule.rng.random(3).tolist()
                rule.x[i] = rule.inside(
                    [h + pull * (t - h) + alpha * (e - 0.5) for h, t, e in zip(moved, partner, noise)]
                )
            if brighter or all_pairs:
                costs[i] = rule.cost(rule.x[i])


def wolves(rule):
    pack = []
    for k in range(rule.iterations):
        pack = sorted(pack + list(zip(rule.all_costs(), rule.x, strict=True)), key=lambda wolf: wolf[0])[:3]
        a = 2.0 * (1.0 - k / rule.iterations)
        r1, r2 = rule.rng.random((2, rule.n, 3, 3)).tolist()
        rule.x = [
            rule.inside(
                [
                    sum(
                        pack[m][1][j] - (2.0 * a * r1[i][m][j] - a) * abs(2.0 * r2[i][m][j] * pack[m][1][j] - x[j])
                        for m in range(3)
                    )
                    / 3.0
                    for j in range(3)
                ]
            )
            for i, x in enumerate(rule.x)
        ]


def whales(rule):
    star, best = None, math.inf
    for k in range(rule.iterations + 1):
        for x, cost in zip(rule.x, rule.all_costs(), strict=True):
            if cost < best:
                star, best = x, cost
        a = 2.0 * (1.0 - k / rule.iterations)
        if k < rule.iterations:
            r1, r2, p, u = rule.rng.random((4, rule.n)).tolist()
            others = rule.rng.integers(rule.n, size=rule.n).tolist()
        moved = []
        for i, x in enumerate(rule.x):
            A, C, l = 2.0 * a * r1[i] - a, 2.0 * r2[i], 2.0 * u[i] - 1.0  # noqa: E741
            around = star if abs(A) < 1.0 else rule.x[others[i]]
            if p[i] < 0.5:
                new = [y - A * abs(C * y - z) for y, z in zip(around, x, strict=True)]
            else:
                new = [abs(y - z) * math.exp(l) * math.cos(2.0 * math.pi * l) + y for y, z in zip(star, x, strict=True)]
            moved.append(rule.inside(new))
        rule.x = moved


def salps(rule, c3_threshold=0.5, amplitude=3.2, decay=3.5, follow=lambda own, ahead: (own + ahead) / 2.0):
    food, best = None, math.inf
    for k in range(rule.iterations + 1):
        for x, cost in zip(rule.x, rule.all_costs(), strict=True):
            if cost < best:
                food, best = x, cost
        if k == rule.iterations:
            return
        c1 = amplitude * math.exp(-((decay * (k + 1) / rule.iterations) ** 2))
        c2, c3 = rule.rng.random((2, 3)).tolist()
        jump = [c1 * ((b - a) * u + a) for a, b, u in zip(LOWER, UPPER, c2, strict=True)]
        leader = [f + s if c >= c3_threshold else f - s for f, s, c in zip(food, jump, c3, strict=True)]
        rule.x = [rule.inside(leader), *rule.x[1:]]
        for i in range(1, rule.n):
            rule.x[i] = [follow(a, b) for a, b in zip(rule.x[i], rule.x[i - 1], strict=True)]


def improved_salps(rule, c3_threshold=0.5):
    salps(rule, c3_threshold, 2.3, 3.2, lambda own, ahead: 0.5 * math.sqrt(own * own + 3.0 * ahead * ahead))


def genes(rule, blend=0.5, mutation=0.1, step=0.1, elite=1):
    x, costs = rule.x, rule.all_costs()
    for _ in range(rule.iterations):
        best = sorted(range(rule.n), key=costs.__getitem__)[:elite]
        count = rule.n - elite
        drawn = rule.rng.integers(rule.n, size=(2, count, 2)).tolist()
        parents = [[x[a] if costs[a] <= costs[b] else x[b] for a, b in pairs] for pairs in drawn]
        share = [[(1.0 + 2.0 * blend) * u - blend for u in row] for row in rule.rng.random((count, 3)).tolist()]
        mutated = rule.rng.random((count, 3)).tolist()
        normal = rule.rng.standard_normal((count, 3)).tolist()
        rule.x = []
        for mother, father, s, m, z in zip(*parents, share, mutated, normal, strict=True):
            child = [a + q * (b - a) for a, b, q in zip(mother, father, s, strict=True)]
            jumps = [step * (b - a) * q for a, b, q in zip(LOWER, UPPER, z, strict=True)]
            rule.x.append(rule.inside([c + d if u < mutation else c for c, d, u in zip(child, jumps, m, strict=True)]))
        x, costs = [x[i] for i in best] + rule.x, [costs[i] for i in best] + rule.all_costs()


@pytest.mark.parametrize(
    ("algorithm", "rule", "settings"),
    [
        (ParticleSwarm, particles, {}),
        (ParticleSwarm, particles, {"w": 0.9, "c1": 0.7, "c2": 2.1}),
        (DifferentialEvolution, evolution, {}),
        (DifferentialEvolution, evolution, {"variant": "best1", "f_min": 0.6, "f_max": 1.3, "cr": 0.7}),
        (Firefly, fireflies, {"gamma": 1.7}),
        (Firefly, fireflies, {"all_pairs": True, "beta0": 1.1, "alpha": 0.2}),
        (GreyWolf, wolves, {}),
        (Whale, whales, {}),
        (SalpSwarm, salps, {}),
        (SalpSwarm, salps, {"c3_threshold": 0.9}),
        (ImprovedSalpSwarm, improved_salps, {}),
        (Genetic, genes, {}),
        (Genetic, genes, {"blend": 0.2, "mutation": 0.4, "step": 0.3, "elite": 3}),
    ],
)
@pytest.mark.parametrize(("n", "iterations"), [(6, 7), (11, 4)])
def test_each_candidate_follows_the_published_rule(algorithm, rule, settings, n, iterations):
    """The order of its random draws is not published; it is that of the search, which golden bags fix, too."""
    search = algorithm(LOWER, UPPER, 11, n_pop=n, n_iter=iterations, **settings)
    run(search, steps)
    expected = Rule(11, n, iterations)
    rule(expected, **settings)
    np.testing.assert_allclose([e.x for e in search.history], expected.record, rtol=1e-9)


def test_defaults_are_as_published():
    """Defaults of all searches, from [1] as their pages say."""
    entries = {
        kind.__name__: {
            name: p.default
            for name, p in inspect.signature(kind).parameters.items()
            if p.default is not p.empty and name not in inspect.signature(Search).parameters
        }
        for kind in (
            ParticleSwarm,
            DifferentialEvolution,
            Firefly,
            GreyWolf,
            Whale,
            SalpSwarm,
            Genetic,
            PerturbObserve,
            Scan,
            CertifiedSearch,
            RampScan,
        )
    }
    assert entries == {
        "ParticleSwarm": {"n_pop": 4, "n_iter": 10, "w": 0.4, "c1": 1.2, "c2": 1.6},
        "DifferentialEvolution": {"n_pop": 4, "n_iter": 10, "variant": "rand1", "f_min": 0.2, "f_max": 0.8, "cr": 0.3},
        "Firefly": {"n_pop": 4, "n_iter": 6, "all_pairs": False, "beta0": 2.0, "alpha": 0.6, "gamma": 1.0},
        "GreyWolf": {"n_pop": 4, "n_iter": 10},
        "Whale": {"n_pop": 4, "n_iter": 10},
        "SalpSwarm": {"n_pop": 4, "n_iter": 10, "c3_threshold": 0.5},
        "Genetic": {"n_pop": 20, "n_iter": 10, "blend": 0.5, "mutation": 0.1, "step": 0.1, "elite": 1},
        "PerturbObserve": {"step": 0.005, "initial": None},
        "Scan": {"n_grid": 20, "tolerance": 1e-3},
        "CertifiedSearch": {"eps": 0.01, "n_iter": 60, "transients": False, "corrections": 3},
        "RampScan": {"n_ramp": 120, "corrections": 4},
    }
    assert {kind: kind([0.1], [0.9]).rng.random() for kind in (ParticleSwarm, Scan, PerturbObserve)} == {
        ParticleSwarm: np.random.default_rng(0).random(5)[4],  # the number after those for a population of four
        Scan: np.random.default_rng(0).random(),
        PerturbObserve: np.random.default_rng(0).random(),
    }


SHAPES = {
    "smooth": lambda a, b: lambda x: math.cos(a * x) + 0.3 * b * x,
    "kinked": lambda a, b: lambda x: abs(x - 0.3 * a) + b * abs(x - 1.1),
    "stairs": lambda a, b: lambda x: math.floor(a * (x - b) ** 2),
    # Rounding makes many of its values equal.
    "roots": lambda a, b: lambda x: round(3.0 * a * (math.sqrt(abs(x - b)) - 0.2 * x)),
    "fine roots": lambda a, b: lambda x: round(90.0 * a * (math.sqrt(abs(x - b)) - 0.1 * x)),
    "flat": lambda a, b: lambda x: a,
    "falling": lambda a, b: lambda x: -a * x**3 - b * x,
    "narrow": lambda a, b: lambda x: -math.exp(-((20.0 * (x - 0.1 * a)) ** 2)) + 0.01 * b * x,
}


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("low", [-1.7, 0.2])
def test_a_scan_looks_where_scipy_does(shape, low):
    """The grid, then each evaluation of scipy's bounded search in the two cells beside the best, over many curves."""
    for a, b, tolerance in itertools.product((0.7, 3.1, 9.0), (-0.8, 0.4), (1e-2, 1e-5)):
        f = SHAPES[shape](a, b)
        search = Scan([low], [low + 2.5], n_grid=6, tolerance=tolerance)
        run(search, lambda x, f=f: f(x[0]))
        grid = np.linspace(low, low + 2.5, 6).tolist()
        k = int(np.argmin([f(x) for x in grid]))
        seen = []
        minimize_scalar(
            lambda x, f=f, seen=seen: (seen.append(float(x)), f(float(x)))[1],
            bounds=(grid[max(k - 1, 0)], grid[min(k + 1, 5)]),
            method="bounded",
            options={"xatol": tolerance},
        )
        assert [e.x[0] for e in search.history] == [*grid, *seen]
        assert search.iteration == len(seen)


class LoadLine:
    """What both searches along the load line do with a measurement, and at their end."""

    def __init__(self, samples, corrections):
        self.samples, self.corrections = iter(samples), corrections
        self.load, self.best, self.commands, self.seen = None, (0.0, 0.0), [], []

    def measure(self, d):
        self.commands.append(d)
        v, i = next(self.samples)
        self.seen.append((v, i))
        if v > 0.0 and i > 0.0:
            self.load = v / i * d * d
            self.best = max(self.best, (v, i), key=lambda at: at[0] * at[1])

    def towards(self, v, i):
        return 1.25 if self.load is None else min(max(math.sqrt(self.load / (v / i)), 0.5), 2.0)

    def end(self):
        v, i = self.best
        if v * i == 0.0:
            return None
        for _ in range(self.corrections):
            self.measure(self.towards(v, i))
        return self.towards(v, i)

    def certified(self, eps, n_iter):
        for d in (1.25, 0.5, 2.0):
            self.measure(d)
        for _ in range(n_iter):
            row = sorted(self.seen)
            boxes = [v * i if v > 0.0 and i > 0.0 else 0.0 for (v, _), (_, i) in zip(row[1:], row, strict=False)]
            k = boxes.index(max(boxes))
            if boxes[k] <= (1.0 + eps) * self.best[0] * self.best[1]:
                break
            self.measure(self.towards(row[k + 1][0], row[k][1]))
        return self.end()

    def ramp(self, n_ramp):
        for k in range(n_ramp):
            self.measure(0.5 + 1.5 * k / (n_ramp - 1))
        return self.end()


QUARTERS = st.integers(-1, 12).map(lambda n: n / 4.0)


@given(st.lists(st.tuples(QUARTERS, QUARTERS), min_size=40, max_size=40), st.integers(0, 3), st.booleans())
@settings(max_examples=40, deadline=None, derandomize=True)
@example([(0.0, 0.0)] * 40, 2, True)
@example([(2.0, 1.0), (1.0, 2.0), (3.0, 0.25)] + [(2.0, 1.0)] * 37, 2, True)
# Of equal candidates the first one is the best.
@example([(2.0, 1.0), (1.0, 2.0), (3.0, 0.25)] + [(0.5, 0.5)] * 37, 2, True)
def test_searches_along_the_load_line_follow_their_rule(samples, corrections, gap):
    """For any measurements, also impossible ones: the commands, the best, and what is proven when."""
    settings_of = {CertifiedSearch: {"eps": 0.5 if gap else 0.0, "n_iter": 9}, RampScan: {"n_ramp": 7}}
    for kind, reported in settings_of.items():
        rule = LoadLine(samples, corrections)
        last = rule.certified(**reported) if kind is CertifiedSearch else rule.ramp(**reported)
        search = kind([0.5], [2.0], matching=Transformer(), corrections=corrections, **reported)
        for k, d in enumerate(rule.commands):
            assert search.settle == (kind is CertifiedSearch or k >= 7)
            assert search.ask() == (pytest.approx(d, rel=1e-12),)
            search.tell(samples[k][0] * samples[k][1], samples[k])
            if kind is CertifiedSearch:
                check_bound(search, rule.seen[: k + 1], reported["eps"])
        assert search.done
        assert (search.peak, search.expected) == (rule.best, rule.best[0] * rule.best[1])
        assert search.result == (search.best.x if last is None else (pytest.approx(last, rel=1e-12),))


def check_bound(search, seen, eps):
    """Check that nothing is proven before the third measurement, nor where the current rises with the voltage by more
    than the gap.
    """
    row, best = sorted(seen[: max(3, search.iteration + 3)]), search.expected
    rises = any((j - i) * w > eps * best for (_, i), (w, j) in itertools.combinations(row, 2) if w > 0.0)
    if len(seen) < 3 or rises:
        assert search.bound is None
    else:
        boxes = [v * i if v > 0.0 and i > 0.0 else 0.0 for (v, _), (_, i) in zip(row[1:], row, strict=False)]
        assert search.bound == max([best, *boxes])
    assert search.gap == eps


def test_samples_on_the_way_to_a_command_are_used():
    search = CertifiedSearch([0.5], [2.0], matching=Transformer(), transients=True)
    assert (search.watches, CertifiedSearch([0.5], [2.0], matching=Transformer()).watches) == (True, False)
    search.watch((4.0, 1.5))
    assert (search.peak, search.bound) == ((4.0, 1.5), None)
    for sample in ((3.0, 2.0), (1.0, 3.0), (5.0, 1.0)):
        search.tell(sample[0] * sample[1], sample)
    assert search.bound == 9.0  # from 3 V and 3 A; if the passed samples did not count, from 5 V and 2 A
