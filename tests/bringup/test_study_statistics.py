"""Statistics over the runs of a study, against scipy, closed forms and simulated coverage."""

import csv
import json
import math

import numpy as np
import pytest
from conftest import few
from expected_text import on_paper
from scipy import stats
from softrig_bringup.cli import main, make_parser
from softrig_bringup.study import estimate, pictures, tabled
from softrig_bringup.study.draw import count, drafts_of, draw, points_of
from softrig_bringup.study.engine import check_seeds
from softrig_bringup.study.estimate import Estimate
from softrig_bringup.study.options import study_of
from softrig_bringup.study.statistics import not_judged, statistics
from softrig_bringup.study.table import results
from softrig_core import ScenarioError
from test_study import folder, study  # noqa: F401  (a scenario `lag` in a folder of its own)

UNIFORM = {"uniform": [0.0, 1.0]}


def rows_of(definition, figure, cases=("",)):
    """Rows of a study by a formula of case, draw and seed, in numbered order."""
    seeds = definition.seeds or [0]
    points = draw(definition.draws) if definition.draws else [{}]
    of = [(c, k, point, seed) for c in cases for k, point in enumerate(points) for seed in seeds]
    for number, (case, k, point, seed) in enumerate(of):
        value = figure(case, k, point, seed)
        yield {"number": number, "scenario": "lag", "case": case, "seed": seed, "overrides": dict(point), "error": "",
               "figures": {"f": value if value is not None and math.isfinite(value) else None}, "missed": [],
               "never": ["f"] if value == math.inf else []}  # fmt: skip


def test_a_requirement_counts_in_the_runs_in_which_it_is_judged(folder):  # noqa: F811
    with (folder / "scenarios" / "lag.yaml").open("a") as file:
        file.write("shared: {x: lag/state/x/position}\nrequirements: {low: always x <= 1, high: always x >= 0.1}\n")
    rows, required = [*rows_of(definition := study(seeds=4), lambda *at: at[-1])], ["low", "high"]
    other = {"not_judged": required, "published_for": "pv_plant.N = 1"}
    one = statistics(definition, [rows[0], rows[1] | {"missed": required}, *(row | other for row in rows[2:])], {})
    assert [(s.requirement, s.held, s.n) for s in one.shares] == [(name, 1, 2) for name in required]
    none = [row | other for row in rows]
    assert statistics(definition, none, {}).shares == []
    text = f"not judged in 4 of 4 runs: {', '.join(required)}, published for pv_plant.N = 1 (--strict judges them)"
    assert not_judged(none) == text
    assert not_judged(rows) == ""


# single numbers ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("held", "n"), [(0, 5), (3, 5), (5, 5), (1, 40), (37, 40), (500, 1000)])
def test_a_share_has_the_interval_of_wilson(held, n):
    wanted = stats.binomtest(held, n).proportion_ci(0.95, method="wilson")
    assert estimate.share(held / n, n) == pytest.approx((held / n, wanted.low, wanted.high), abs=1e-12)


def test_a_mean_has_the_interval_of_student():
    values = np.random.default_rng(0).normal(3.0, 2.0, 12)
    wanted = stats.ttest_1samp(values, 0.0).confidence_interval(0.95)
    assert estimate.mean(values) == pytest.approx((values.mean(), wanted.low, wanted.high))


@pytest.mark.parametrize(("n", "q"), [(10, 0.5), (60, 0.5), (100, 0.05), (200, 0.95), (20, 0.05)])
def test_the_interval_of_a_quantile_covers_it_by_the_binomial_distribution(n, q):
    """Of sorted values 1 to n: the chance that the quantile lies between two of them is a sum of binomial terms."""
    value, low, high = estimate.quantile(np.arange(1.0, n + 1.0), q)
    below = 0 if math.isnan(low) else low  # an open end means that the interval covers all values beyond
    above = n + 1 if math.isnan(high) else high
    chance = stats.binom.pmf(range(int(below), int(above)), n, q).sum()
    assert chance >= 0.95 - 1e-9
    assert stats.binom.cdf(below - 1, n, q) <= 0.025
    assert stats.binom.sf(above - 1, n, q) <= 0.025
    assert value == pytest.approx(1.0 + q * (n - 1))


def test_an_event_that_never_happens_is_the_largest():
    result = estimate.quantile(np.array([math.inf] * 3 + [1.0, 2.0] * 20), 0.99)
    assert (result.value, result.high) == (math.inf, pytest.approx(math.nan, nan_ok=True))
    assert estimate.quantile(np.array([1.0] * 30 + [math.inf]), 0.5) == (1.0, 1.0, 1.0)


@pytest.mark.parametrize(
    ("estimator", "draws", "true", "least"),
    few([
        (estimate.deviation, lambda rng: rng.normal(5.0, 2.0, 40), 2.0, 0.91),
        (estimate.deviation, lambda rng: rng.uniform(0.0, 1.0, 40), 12.0**-0.5, 0.91),
        # 0.90 in Bonett's table 1 for n = 100.
        (estimate.deviation, lambda rng: rng.exponential(1.0, 100), 1.0, 0.86),
        (estimate.difference, lambda rng: rng.normal(0.3, 1.0, 8), 0.3, 0.92),
        (estimate.difference, lambda rng: rng.exponential(1.0, 50), 1.0, 0.89),
        (lambda x: estimate.quantile(x, 0.5), lambda rng: rng.exponential(1.0, 30), math.log(2.0), 0.94),
        (lambda x: estimate.clustered(x, np.mean), lambda rng: rng.normal(0.0, 1.0, (30, 1)) + np.zeros(3), 0.0, 0.89),
    ], 3),
)  # fmt: skip
def test_intervals_have_their_stated_coverage(estimator, draws, true, least, monkeypatch):
    """200 samples; the bounds are three standard errors of such a simulation below the stated or published coverage."""
    monkeypatch.setattr(estimate, "RESAMPLES", 599)
    rng = np.random.default_rng(66)
    gathered = [estimator(draws(rng)) for _ in range(200)]
    covered = np.mean([low <= true <= high for _, low, high in gathered])
    assert least <= covered <= 0.99 + 0.01 * (estimator.__name__ == "<lambda>")


def test_the_interval_of_a_difference_is_that_of_scipys_bootstrap_for_many_pairs():
    pairs = np.random.default_rng(1).gamma(2.0, 1.0, 1500)
    plain = stats.bootstrap((pairs,), np.mean, n_resamples=4999, method="percentile", rng=np.random.default_rng(0),
                            batch=500).confidence_interval  # fmt: skip
    result = estimate.difference(pairs)
    assert result == pytest.approx((pairs.mean(), plain.low, plain.high), abs=0.005)
    assert estimate.difference(pairs) == result


def test_p_values_are_adjusted_by_holms_method():
    assert estimate.holm([0.01, 0.04, 0.03, math.nan, 0.02]) == pytest.approx(
        [0.04, 0.06, 0.06, math.nan, 0.06], nan_ok=True
    )
    assert estimate.holm([0.9, 0.6]) == [1.0, 1.0]


@pytest.mark.parametrize("width", [1.5, 0.3, 0.05])
def test_the_stated_number_of_runs_makes_an_interval_as_narrow_and_no_smaller_one_does(width):
    def of_mean(n):
        return 2.0 * stats.t.ppf(0.975, n - 1) * 0.7 / math.sqrt(n)

    def of_share(n):
        z = stats.norm.ppf(0.975)
        return 2.0 * z * math.sqrt(0.2 * 0.8 / n + z**2 / (4.0 * n**2)) / (1.0 + z**2 / n)

    for n, interval in ((estimate.runs_for_mean(0.7, width), of_mean), (estimate.runs_for_share(0.2, width), of_share)):
        assert interval(n) <= width
        assert n == 2 or interval(n - 1) > width


# over the runs ----------------------------------------------------------------------------------------------------


def test_sobol_indices_of_ishigamis_function_are_its_closed_form():
    """Ishigami and Homma, 1990: sin x1 + 7 sin^2 x2 + 0.1 x3^4 sin x1."""
    parameters = {f"n.x{k}": {"uniform": [-math.pi, math.pi]} for k in (1, 2, 3)}
    definition = study(draws={"count": 512, "seed": 1, "method": "sensitivity", "parameters": parameters})

    def ishigami(case, k, point, seed):
        x = list(point.values())
        return math.sin(x[0]) + 7.0 * math.sin(x[1]) ** 2 + 0.1 * x[2] ** 4 * math.sin(x[0])

    assert count(definition) == points_of(definition) == 512 * 5
    result = statistics(definition, list(rows_of(definition, ishigami)), {"f": "m"})
    a, b, pi4, pi8 = 7.0, 0.1, math.pi**4, math.pi**8
    variances = (0.5 * (1.0 + b * pi4 / 5.0) ** 2, a**2 / 8.0, 0.0), b**2 * pi8 * 8.0 / 225.0
    total = sum(variances[0]) + variances[1]
    first = [v / total for v in variances[0]]
    whole = [first[0] + variances[1] / total, first[1], variances[1] / total]
    assert [i.parameter for i in result.indices] == list(parameters)
    for index, alone, together in zip(result.indices, first, whole, strict=True):
        assert index.first.low < alone < index.first.high
        assert index.total.low < together < index.total.high
        assert index.first.value == pytest.approx(alone, abs=0.05)
        assert index.total.value == pytest.approx(together, abs=0.05)
        assert 0.0 < index.total.high - index.total.low < 0.3
    (line,) = result.lines
    assert line.n == 1024  # the mixed points are not independent, so they do not count
    assert line.mean.value == pytest.approx(3.5, abs=0.1)
    assert line.deviation.value == pytest.approx(math.sqrt(total), rel=0.03)


def test_cases_are_compared_draw_by_draw():
    """The draws decide nearly everything; the small advantage of the second law is found because both have the same
    draws.
    """
    noise = np.random.default_rng(3).normal(0.0, 0.01, (2, 60))
    definition = study(cases={"a": {}, "b": {}}, draws={"count": 60, "parameters": {"n.x": UNIFORM}})

    def figure(case, k, point, seed):
        return 10.0 * point["n.x"] + (0.02 if case == "b" else 0.0) + noise[int(case == "b"), k]

    rows = list(rows_of(definition, figure, "ab"))
    result = statistics(definition, rows, {"f": "s"})
    pairs = np.array([rows[60 + k]["figures"]["f"] - rows[k]["figures"]["f"] for k in range(60)])
    (d,) = result.differences
    assert (d.group, d.base, d.unit, d.n) == ("b", "a", "s", 60)
    assert d.difference.value == pytest.approx(pairs.mean())
    assert d.difference.low < 0.02 < d.difference.high < 0.03
    wanted = stats.binomtest(int((pairs < 0).sum()), 60).proportion_ci(method="wilson")
    assert d.smaller == pytest.approx(((pairs < 0).mean(), wanted.low, wanted.high))
    assert d.effect == pytest.approx(pairs.mean() / pairs.std(ddof=1))
    assert d.p == pytest.approx(stats.ttest_1samp(pairs, 0.0).pvalue)
    assert [(line.group, line.n, line.unit) for line in result.lines] == [("a", 60, "s"), ("b", 60, "s")]
    assert result.lines[1].mean.high - result.lines[1].mean.low > 30 * (d.difference.high - d.difference.low)


def test_an_event_that_never_happens_counts_in_the_shares_and_not_in_the_differences():
    definition = study(cases={"a": {}, "b": {}}, draws={"count": 8, "parameters": {"n.x": UNIFORM}})
    values = {"a": [1.0] * 8, "b": [math.inf, None, 1.0, 0.5, 0.5, 0.5, 2.0, math.inf]}
    result = statistics(definition, list(rows_of(definition, lambda case, k, point, seed: values[case][k], "ab")), {})
    (d,) = result.differences
    assert (d.n, d.difference.value) == (5, pytest.approx((0.0 - 1.5 + 1.0) / 5))
    assert d.smaller.value == pytest.approx(3.5 / 7)  # of the seven known pairs one is equal, which counts half
    b = result.lines[1]
    assert (b.n, b.lost, b.median.value) == (5, "2 of 8 never, 1 of 8 not measured", 1.0)


def test_seeds_of_a_draw_belong_together():
    """Five seeds that hardly differ are not five draws: the interval is that of the draws."""
    definition = study(seeds=5, draws={"count": 30, "method": "random", "parameters": {"n.x": UNIFORM}})
    rows = list(rows_of(definition, lambda case, k, point, seed: point["n.x"] + 1e-6 * seed))
    result = statistics(definition, rows, {})
    (line,) = result.lines
    singly = estimate.mean(np.array([rows[5 * k]["figures"]["f"] for k in range(30)]))
    assert line.n == 30
    assert line.mean == pytest.approx(singly, abs=1e-5)
    assert line.median.high - line.median.low > 0.1
    assert result.notes == [
        "n counts draws: the 5 seeds of a draw are not independent, and the intervals are those of draws"
    ]


@pytest.mark.parametrize("draws", [{}, {"draws": {"count": 4, "method": "random", "parameters": {"n.x": UNIFORM}}}])
def test_seeds_that_change_nothing_are_one_run(draws):
    definition = study(seeds=40, **draws)
    result = statistics(definition, list(rows_of(definition, lambda case, k, point, seed: 1.0 + k)), {})
    assert [line.n for line in result.lines] == ([4] if draws else [])
    assert result.notes[0] == "the 40 seeds give the same run: no random number affects a figure"
    only = statistics(
        study(seeds=3, cases={"a": {}, "b": {}}),
        list(rows_of(study(seeds=3), lambda case, k, point, seed: seed if case == "b" else 1.0, "ab")),
        {},
    )
    assert [(line.group, line.n) for line in only.lines] == [("b", 3)]
    assert only.notes[0].startswith("the 3 seeds of a give the same run")


def test_each_grid_point_is_a_separate_sample():
    definition = study(grid={"n.k": [0.01, 0.010001]}, seeds=4)
    rows = [
        row | {"overrides": {"n.k": k}, "number": 4 * j + row["seed"]}
        for j, k in enumerate((0.01, 0.010001))
        for row in rows_of(definition, lambda c, j, p, seed, k=k: k + seed)
    ]
    result = statistics(definition, rows, {})
    assert [(line.group, line.n) for line in result.lines] == [("k 0.01", 4), ("k 0.010001", 4)]
    # One run of each case is no sample.
    assert statistics(study(grid={"n.k": [1, 2]}), [rows[0], rows[4]], {}).lines == []


def test_a_summary_without_a_case_is_made_for_each_case():
    definition = study(
        cases={"a": {}, "b": {}},
        summaries={"m": {"figure": "f"}, "of_b": {"figure": "f", "where": {"case": "b"}}},
        expect={"m": "at most 2"},
    )
    rows = [*rows_of(definition, lambda case, k, point, seed: 1.0 if case == "a" else 5.0, "ab")]
    result = results(definition, rows, {"f": "m/s"})
    assert [(r.name, r.value, r.passed, r.unit) for r in result] == [
        ("m (a)", 1.0, True, "m/s"), ("m (b)", 5.0, False, "m/s"), ("of_b", 5.0, True, "m/s"),
    ]  # fmt: skip
    claim = {"m": {"published": 1.0, "where": "Table I", "verdict": "reproduced"}}
    with pytest.raises(ScenarioError, match=r"claims: m has 2 cases; choose one by where: \{case: ...\}"):
        study(cases={"a": {}, "b": {}}, summaries={"m": {"figure": "f"}}, claims=claim)


def test_a_map_is_drawn_for_each_case():
    rows = [
        row | {"overrides": {"n.x": 1.0 * i, "n.y": 1.0 * j}, "case": case, "figures": {"f": 10.0 * (case == "b") + i}}
        for case in "ab"
        for i in range(3)
        for j in range(3)
        for row in rows_of(study(), lambda *of: 0.0)
    ]
    figure = on_paper(pictures._map(rows, ["n.x", "n.y"], "f", {"f": "s"}))
    maps = [ax.collections[0] for ax in figure.axes[:2]]
    assert [ax.get_title(loc="left") for ax in figure.axes[:2]] == ["a, 9 runs", "b, 9 runs"]
    assert [m.get_array().max() for m in maps] == [2.0, 12.0]
    assert {m.get_clim() for m in maps} == {(0.0, 12.0)}


@pytest.mark.parametrize(
    ("result", "text"),
    [
        (Estimate(0.71234, 0.70123, 0.72345), "0.712 [0.701, 0.723]"),
        (Estimate(1234.5, 1200.0, 1300.0), "1234 [1200, 1300]"),
        (Estimate(1.0, 1.0, 1.0), "1 [1, 1]"), (Estimate(5.0), "5"), (Estimate(math.nan), "–"),
        (Estimate(math.inf), "never"), (Estimate(0.5, math.nan, 0.6), "0.50 [–, 0.60]"),
        (Estimate(2.0, 1.0, math.inf), "2.0 [1.0, never]"),
        (Estimate(1.5e-9, 1.4e-9, 1.6e-9), "1.50e-09 [1.40e-09, 1.60e-09]"),
        (Estimate(0.0, -1e-9, 1e-9), "0 [-1.0e-09, 1.0e-09]"),
    ],
)  # fmt: skip
def test_an_estimate_is_rounded_to_its_interval(result, text):
    assert tabled.written_estimate(result) == text


# the command ------------------------------------------------------------------------------------------------------


def test_a_study_of_two_laws_reports_all_of_this_by_default(folder, capsys):  # noqa: F811
    words = ["study", "lag", "--against", "plant.gain=2.0", "--draw", "gain.k=1..2", "--draws", "6", "--subject-to",
             "last <= 0.1", "--width", "last=0.001", "--duration", "0.1", "--workers", "1", "--out", "out"]  # fmt: skip
    assert main(words) == 0
    out = capsys.readouterr().out
    for text in ("Statistics, 95 % intervals", "last <= 0.1", "Differences at the same draws and seeds",
                 "a width of 0.001 needs some", "plant.gain=2.0"):  # fmt: skip
        assert text in out
    content = json.loads((folder / "out" / "summaries.json").read_text())
    assert [(d["group"], d["base"], d["n"]) for d in content["differences"]] == [("plant.gain=2.0", "lag", 6)]
    with (folder / "out" / "table.csv").open() as file:
        last = [float(row["figure.last"]) for row in csv.DictReader(file)]
    assert content["differences"][0]["difference"]["value"] == pytest.approx(np.mean(last[6:]) - np.mean(last[:6]))
    assert [(s["group"], s["held"]) for s in content["shares"]] == [
        ("lag", sum(v <= 0.1 for v in last[:6])), ("plant.gain=2.0", sum(v <= 0.1 for v in last[6:])),
    ]  # fmt: skip
    assert "mean difference" in (folder / "out" / "report.html").read_text()
    assert main([*words[:-1], "other", "--width", "lost=1"]) == 2
    assert "--width lost: nothing of that name is estimated" in capsys.readouterr().err


def test_seeds_of_a_rig_without_random_numbers_are_refused_unless_forced(folder, capsys):  # noqa: F811
    words = ["study", "lag", "--seeds", "3", "--duration", "0.05", "--workers", "1", "--out", "out"]
    assert main(words) == 2
    assert "lag: 3 seeds give the same run, as no random number affects" in capsys.readouterr().err
    assert not (folder / "out").exists()
    assert main([*words, "--force"]) == 0
    assert "the 3 seeds give the same run" in capsys.readouterr().out
    noisy = (folder / "scenarios" / "lag.yaml").read_text()
    noisy += "faults: {noise: {link: lag/state, kind: noise, channels: [x], value: [0.02]}}\n"
    (folder / "scenarios" / "noisy.yaml").write_text(noisy)
    # One of the scenarios draws random numbers.
    for drawing in ({"scenario": "noisy"}, {"cases": {"a": {}, "b": {"scenario": "noisy"}}}):
        definition = study(seeds=3, duration=0.05, **drawing)
        check_seeds(definition, drafts_of(definition))


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (
            "--draw gain.k=1..2 --method sobol --draws 100",
            "sobol: expected a power of two, as 64 or 128, got 100 draws",
        ),
        ("--draw gain.k=1..2 --sensitivity --draws 3", "sensitivity: expected a power of two, as 2 or 4, got 3 draws"),
        ("--sensitivity", "--sensitivity: of what --draw names"),
        ("--search last --draw gain.k=1..2 --against lag_breaks", "search: can be combined with seeds"),
        ("--search last --draw gain.k=1..2 --sensitivity", "--sensitivity: goes with no --search"),
        ("--against lag", "--against lag: it is the scenario itself"),
    ],
)
def test_contradictory_requests_are_refused(words, text):
    with pytest.raises(ScenarioError, match=text):
        study_of(make_parser().parse_args(["study", "lag", *words.split()]))


def test_for_few_pairs_the_interval_is_students():
    """The bootstrap covers 0.75 of three normal pairs, 0.92 of five; from ten on both have their stated coverage."""
    for n in (2, 3, 9):
        pairs = np.random.default_rng(n).normal(1.0, 2.0, n)
        wanted = stats.ttest_1samp(pairs, 0.0).confidence_interval(0.95)
        assert estimate.difference(pairs) == pytest.approx((pairs.mean(), wanted.low, wanted.high))
    wide = np.random.default_rng(3).normal(1.0, 2.0, 10)
    wanted = stats.ttest_1samp(wide, 0.0).confidence_interval(0.95)
    assert estimate.difference(wide).low != wanted.low
    assert estimate.difference(wide) == pytest.approx((wide.mean(), wanted.low, wanted.high), abs=0.4)


def test_a_parameter_that_only_some_cases_set_has_no_axis():
    """Two values of a parameter against the unchanged scenario, which does not set it: nothing is drawn over it."""
    rows = [{"overrides": {"p.R": r} | ({"c.k": k} if k else {})} for k in (0, 1, 2) for r in (0.1, 0.2)]
    assert pictures.numeric(rows) == ["p.R"]
    assert pictures.numeric(rows[2:]) == ["p.R", "c.k"]
