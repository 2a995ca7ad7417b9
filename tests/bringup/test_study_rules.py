"""The small rules of studies, each computed independently: drawing, searching, caching, judging, labels and
refusals.
"""

import itertools
import json
import math
from types import SimpleNamespace

import numpy as np
import optuna
import pytest
from expected_text import on_paper, page_lines
from scipy import stats
from scipy.stats import qmc
from softrig_bringup.cli import make_parser
from softrig_bringup.page.html import page as make_page
from softrig_bringup.study import engine, options, page, pictures, table, work
from softrig_bringup.study.batch import Batch, Log, row_of
from softrig_bringup.study.definition import Distribution, Draws
from softrig_bringup.study.draw import Case, _values, cases, count, draw, size
from softrig_bringup.study.statistics import Statistics
from softrig_core import Run, RunError, ScenarioError, rig_of, simulate
from softrig_core.judge.expectation import Expectation
from test_study import study

X = "lag/state/x/position"


def row(number=0, *, figures=None, overrides=None, never=(), seed=0, case="", error=""):
    return {"number": number, "scenario": "lag", "case": case, "seed": seed, "overrides": overrides or {},
            "figures": figures or {}, "never": list(never), "passed": True, "error": error, "wall_s": 0.5}  # fmt: skip


# random draws ----------------------------------------------------------------------------------------------------

U = [0.0, 0.125, 0.5, 0.75, 0.999]


@pytest.mark.parametrize(
    ("distribution", "values"),
    [
        ({"uniform": [2.0, 4.0]}, [2.0, 2.25, 3.0, 3.5, 3.998]),
        ({"log_uniform": [0.01, 100.0]}, [10.0 ** (4.0 * u - 2.0) for u in U]),
        ({"normal": [5.0, 0.5]}, [5.0 + 0.5 * z for z in stats.norm.ppf([1e-12, *U[1:]])]),
        ({"integers": [1, 4]}, [1, 1, 3, 4, 4]),
        ({"integers": [3, 3]}, [3] * 5),
        ({"choice": ["x", 7, [1, 2]]}, ["x", "x", 7, [1, 2], [1, 2]]),
    ],
)
def test_a_number_of_the_unit_interval_maps_to_a_value_of_the_distribution(distribution, values):
    result = _values(Distribution.model_validate(distribution), np.array(U))
    assert result == (pytest.approx(values, rel=1e-12) if isinstance(values[0], float) else values)
    assert _values(Distribution.model_validate({"normal": [0.0, 1.0]}), np.array([1.0])) == pytest.approx(
        [-stats.norm.ppf(1e-12)], rel=1e-4
    )


def test_points_use_their_numbers_in_the_order_of_their_parameters():
    parameters = {"a": {"uniform": [0.0, 1.0]}, "v": {"uniform": [[0.0, 10.0, 0.0], [1.0, 20.0, 0.0]]},
                  "w": {"log_uniform": [[1.0, 1.0], [10.0, 100.0]]}, "i": {"integers": [0, 9]},
                  "one": {"normal": [[0.0], 1.0]}}  # fmt: skip
    draws = study(draws={"count": 3, "seed": 4, "method": "random", "parameters": parameters}).draws
    assert [size(d) for d in draws.parameters.values()] == [1, 3, 2, 1, 1]
    unit = np.random.default_rng(4).random((3, 8))
    for u, point in zip(unit, draw(draws), strict=True):
        assert list(point) == ["a", "v", "w", "i", "one"]
        assert (point["a"], point["i"]) == (u[0], int(10 * u[6]))
        assert point["v"] == [u[1], 10.0 + 10.0 * u[2], 0.0]
        assert point["w"] == pytest.approx([10.0 ** u[4], 100.0 ** u[5]])
        assert point["one"] == pytest.approx([stats.norm.ppf(u[7])])


@pytest.mark.parametrize(
    ("distribution", "text"),
    [
        ({}, "expected one of uniform, log_uniform, normal, integers, choice, got none"),
        ({"uniform": [0, 1], "choice": [1]}, "got uniform, choice"),
        ({"log_uniform": [0.0, 1.0]}, "log_uniform: expected bounds above 0"),
        ({"log_uniform": [[1.0, -1.0], [2.0, 2.0]]}, "log_uniform: expected bounds above 0"),
        ({"uniform": [[0, 0], [1, -1]]}, "uniform: expected a lower and an upper bound"),
        ({"uniform": [[0, 0], [1, 1, 1]]}, "uniform: expected a lower and an upper bound"),
        ({"uniform": [0.0, [1, 1]]}, "uniform: expected a lower and an upper bound"),
        ({"integers": [2, 1]}, "integers: expected a lower and an upper bound"),
    ],
)
def test_an_unknown_distribution_is_refused(distribution, text):
    with pytest.raises(ValueError, match=text):
        Distribution.model_validate(distribution)
    for fine in ({"uniform": [1, 1]}, {"integers": [2, 2]}, {"log_uniform": [1e-9, 1.0]}, {"normal": [5.0, 0.0]}):
        Distribution.model_validate(fine)


DRAFTS = {name: SimpleNamespace(filled=lambda seed=seed: SimpleNamespace(seed=seed)) for name, seed in
          (("lag", 5), ("other", 7))}  # fmt: skip


def test_runs_are_all_combinations_the_last_parameter_changes_fastest():
    definition = study(
        cases={"a": {"p": 1}, "b": {"scenario": "other", "g": 9}}, grid={"g": [1, 2], "h": [3, 4]},
        draws={"count": 2, "parameters": {"u": {"uniform": [0, 1]}}}, seeds=[4, 6],
    )  # fmt: skip
    points = draw(definition.draws)
    wanted = []
    for (case, scenario, own), (g, h), point, seed in itertools.product(
        (("a", "lag", {"p": 1}), ("b", "other", {"g": 9})), itertools.product((1, 2), (3, 4)), points, (4, 6)
    ):
        wanted.append(Case(len(wanted), scenario, case, own | {"g": g, "h": h} | point, seed))
    assert list(cases(definition, DRAFTS)) == wanted
    assert count(definition) == len(wanted) == 32
    plain = study(cases={"a": {}, "b": {"scenario": "other"}})
    assert [(c.case, c.seed, c.overrides) for c in cases(plain, DRAFTS)] == [("a", 5, {}), ("b", 7, {})]
    assert (count(plain), count(study())) == (2, 1)
    searched = study(search={"figure": "f", "count": 7, "parameters": {"u": {"uniform": [0, 1]}}}, seeds=3)
    assert count(searched) == 21


# the search ------------------------------------------------------------------------------------------------------

PARAMETERS = {"a.x": {"uniform": [0.0, 4.0]}, "a.l": {"log_uniform": [0.1, 10.0]}, "a.i": {"integers": [1, 5]},
              "a.c": {"choice": ["p", "q"]}}  # fmt: skip


@pytest.mark.parametrize("sampler", ["tpe", "random"])
@pytest.mark.parametrize("aim", ["minimise", "maximise"])
def test_a_search_asks_and_tells_as_optuna_called_directly(sampler, aim):
    """Batches of three, two seeds each, with their mean; a missing figure counts as the worst."""
    definition = study(
        search={"figure": "f", "count": 14, "batch": 3, "seed": 2, "sampler": sampler, "aim": aim,
                "parameters": PARAMETERS, "subject_to": {"g": "at most 2"}}, seeds=[4, 6], figures=["h"],
    )  # fmt: skip

    def figures(changes, seed):
        f = (changes["a.x"] - 1.0) ** 2 + math.log10(changes["a.l"]) ** 2 + seed / 10.0
        return {"f": None if changes["a.i"] == 5 else f, "g": changes["a.x"], "h": 0.0}

    asked, batches = [], []

    def rows(works):
        asked.extend(works)
        batches.append(len(works))
        return [row(figures=figures(w.case.overrides, w.case.seed)) for w in works]

    engine._search(definition, definition.search, SimpleNamespace(rows=rows), DRAFTS)
    assert batches == [6, 6, 6, 6, 4]
    assert [(w.case.number, w.case.seed, w.figures, w.runs) for w in asked] == [
        (k, (4, 6)[k % 2], ("h", "f", "g"), 28) for k in range(28)
    ]
    kinds = {"tpe": optuna.samplers.TPESampler, "random": optuna.samplers.RandomSampler}
    more = {"constant_liar": True} if sampler == "tpe" else {}
    by_hand = optuna.create_study(direction=f"{aim[:-3]}ize", sampler=kinds[sampler](seed=2, **more))
    of = optuna.distributions
    space = {"a.x": of.FloatDistribution(0.0, 4.0), "a.l": of.FloatDistribution(0.1, 10.0, log=True),
             "a.i": of.IntDistribution(1, 5), "a.c": of.CategoricalDistribution(["p", "q"])}  # fmt: skip
    wanted = []
    for start in range(0, 14, 3):
        trials = [by_hand.ask(space) for _ in range(min(3, 14 - start))]
        for trial in trials:
            both = [figures(trial.params, seed) for seed in (4, 6)]
            wanted += [trial.params] * 2
            mean = None if both[0]["f"] is None else (both[0]["f"] + both[1]["f"]) / 2.0
            trial.set_constraint("g", max(0.0, trial.params["a.x"] - 2.0))
            by_hand.tell(trial, mean if mean is not None else 1e300 if aim == "minimise" else -1e300)
    assert [w.case.overrides for w in asked] == wanted


@pytest.mark.parametrize("distribution", [{"normal": [0.0, 1.0]}, {"uniform": [[0.0], [1.0]]}])
def test_a_search_varies_numbers_and_choices_only(distribution):
    with pytest.raises(ScenarioError, match=r"search: parameter a: expected uniform, log_uniform, integers or choice"):
        engine._optuna("a", Distribution.model_validate(distribution))


@pytest.mark.parametrize(
    ("value", "limits", "by"),
    [
        (1.5, {"at_most": 2.0}, 0.0), (2.5, {"at_most": 2.0}, 0.5), (1.5, {"at_least": 2.0}, 0.5),
        (2.5, {"expected": 2.0, "tolerance": 0.1}, 0.5), (2.05, {"expected": 2.0, "tolerance": 0.1}, 0.0),
        (math.inf, {"at_most": 2.0}, 1e300), (None, {"at_most": 2.0}, 1e300), (math.inf, {"at_least": 2.0}, 1e300),
    ],
)  # fmt: skip
def test_the_distance_of_a_figure_beyond_its_limits_is_as_expected(value, limits, by):
    result = row(figures={"f": value if value != math.inf else None}, never=["f"] if value == math.inf else [])
    assert engine.beyond(result, "f", Expectation.model_validate(limits)) == pytest.approx(by)


def test_a_folder_of_other_content_is_refused_with_the_changes(tmp_path):
    file = tmp_path / "study.json"
    current = {"grid": 1, "scenarios": {"a": 1, "b": 2}, "code": {"p": "x"}, "files": {"n": 1}}
    assert engine.same(current, file, "study") == json.dumps(current, indent=1) + "\n"
    file.write_text(engine.same(current, file, "study"))
    assert engine.same(current, file, "study")

    def why(recorded):
        file.write_text(recorded if isinstance(recorded, str) else json.dumps(recorded))
        with pytest.raises(engine.OtherContentError) as refused:
            engine.same(current, file, "study")
        head, tail = f"{tmp_path} holds another study", "; choose another --out, or remove it"
        assert str(refused.value).startswith(head)
        assert str(refused.value).endswith(tail)
        return str(refused.value)[len(head) : -len(tail)]

    assert why(current | {"grid": 2}) == ""
    assert why(current | {"scenarios": {"a": 1, "b": 3}}) == " (scenario b has changed)"
    assert why(current | {"scenarios": {"c": 1, "b": 2}}) == " (scenario a, c has changed)"
    assert why(current | {"code": {"p": "y"}}) == " (the code of p has changed)"
    assert why(current | {"files": {}}) == " (a file of n has changed)"
    assert why(current | {"scenarios": {}, "code": {}}) == " (scenario a, b has changed)"
    assert why({"grid": 1}) == why("no json") == why("[1]") == ""


# rows ------------------------------------------------------------------------------------------------------------


def case(number, k=1.0):
    return Case(number, "lag", "", {"gain.k": k}, 0)


def of_case(number, k=1.0):
    return row(number, overrides={"gain.k": k}, figures={"f": k})


@pytest.mark.parametrize(
    ("change", "right"),
    [
        ({}, True), ({"number": "0"}, False), ({"error": None}, False), ({"figures": {"f": "1"}}, False),
        ({"figures": {"f": None, "g": 1}}, True), ({"wall_s": 1}, True), ({"more": 1}, False), ({"never": "f"}, False),
        ({"passed": None}, True), ({"not_judged": "a"}, False),
        ({"signals": {}}, True), ({"signals": []}, False), ({"passed": 1}, False), ({"seed": 1.0}, False),
    ],
)  # fmt: skip
def test_a_row_has_its_keys_of_their_types(change, right):
    line = json.dumps(of_case(3) | change).encode()
    assert (row_of(line) is not None) == right
    lacking = of_case(3)
    del lacking["never"]  # a row of an older version lacks this key
    assert row_of(json.dumps(lacking).encode()) == lacking
    for key in lacking:
        assert row_of(json.dumps({k: v for k, v in lacking.items() if k != key}).encode()) is None
    assert row_of(b"{") is None


def test_a_log_lists_its_rows_and_refuses_a_number_with_other_parameters(tmp_path):
    log = Log(tmp_path / "rows", 3)
    log.add(of_case(1, 2.0))
    assert (len(log), log.knows(case(1, 2.0)), log.knows(case(0))) == (1, True, False)
    with pytest.raises(ScenarioError, match="rows: run 1 has other parameters than this search asks for"):
        log.knows(case(1, 3.0))
    log.close()
    again = Log(tmp_path / "rows", 3, [case(0), case(1, 2.0)])
    assert (len(again), again.passed_over, [r["number"] for r in again.rows()]) == (1, 0, [1])
    again.close()
    fewer = Log(tmp_path / "rows", 1)  # a study of one run has only number 0
    assert (len(fewer), fewer.passed_over, list(fewer.rows())) == (0, 1, [])
    fewer.close()


def test_a_batch_runs_what_is_missing_and_returns_all_in_order(tmp_path, monkeypatch, capsys):
    ran, shown = [], []
    monkeypatch.setattr(
        "softrig_bringup.study.batch.run", lambda w: ran.append(w.case.number) or of_case(w.case.number)
    )
    log = Log(tmp_path / "rows", 5)
    log.add(of_case(2))
    batch = Batch("title", log, 1)
    batch._progress = SimpleNamespace(__enter__=None)

    class Bar:
        def __enter__(self):
            return lambda: shown.append(len(log))

        def __exit__(self, *error):
            shown.append("end")

    batch._progress = Bar()
    with batch:
        works = [work.Work(case(k)) for k in (3, 2, 0)]
        assert [r["number"] for r in batch.rows(works)] == [3, 2, 0]
        assert [r["number"] for r in batch.rows([work.Work(case(k)) for k in (0, 1)])] == [0, 1]
    assert ran == [3, 0, 1]
    assert len(shown) == 6  # finished runs of an earlier call are reported, too
    assert log._file.closed
    assert [r["number"] for r in log.rows()] == [2, 3, 0, 1]


def done(results, *, missed=(), signals=None, wanted=None):
    return SimpleNamespace(results=results, missed=missed, signals=signals or {}, wanted=wanted, published_for="R = 1")


def test_a_run_leaves_its_figures_in_its_row(monkeypatch):
    results = [SimpleNamespace(name=n, number=v, judged=n == "a", published_for="") for n, v in
               (("a", 1.5), ("b", math.inf), ("c", math.nan), ("d", -math.inf))]  # fmt: skip
    t = np.array([0.0, 0.1, 0.3, 0.4])
    ran = done(results, missed=results[:1], signals={"s": (t, 10.0 * t), "none": (t[:0], t[:0])})
    asked = {}
    monkeypatch.setattr(work, "simulate", lambda scenario, **keywords: asked.update(keywords, scenario=scenario) or ran)
    whole = work.run(work.Work(case(3, 2.0), 0.4, (), ("s", "none"), 5, 9))
    assert {k: whole[k] for k in ("number", "figures", "never", "missed", "passed", "error", "signals")} == {
        "number": 3, "figures": {"a": 1.5, "b": None, "c": None, "d": None}, "never": ["b"],
        "missed": ["a"], "passed": False,
        "error": "", "signals": {"s": {"end": 0.4, "x": [0.0, 1.0, 1.0, 3.0, 4.0]}, "none": {"end": 0.0, "x": []}},
    }  # fmt: skip
    assert whole["wall_s"] >= 0.0
    assert asked == {"scenario": "lag", "seed": 0, "duration": 0.4, "overrides": {"gain.k": 2.0}, "runs": 9,
                     "signals": ("s", "none"), "thorough": False}  # fmt: skip
    ran.missed = []
    some = work.run(work.Work(case(0), figures=("b", "a")))
    assert (some["figures"], some["passed"], "signals" in some) == ({"a": 1.5, "b": None}, True, False)
    assert not {"not_judged", "published_for"} & some.keys()
    results[0].judged, results[0].published_for = False, "R = 1"
    open_ = work.run(work.Work(case(0)))
    assert (open_["passed"], open_["not_judged"], open_["published_for"]) == (None, ["a"], "R = 1")
    assert ran.strict is False
    work.run(work.Work(case(0), strict=True))
    assert ran.strict is True
    with pytest.raises(ScenarioError, match="lag has no figure 'x'"):
        work.run(work.Work(case(0), figures=("x", "y")))


def test_a_broken_run_records_its_reason_and_bad_input_is_raised(monkeypatch):
    def breaks(error):
        def simulate(*_, **__):
            raise error

        monkeypatch.setattr(work, "simulate", simulate)

    breaks(RunError("gone"))
    result = work.run(work.Work(case(0), figures=("a",)))
    assert (result["error"], result["figures"], result["passed"]) == ("gone", {}, False)
    margins = work.run(work.Work(case(0), figures=("a",), margins=True))
    assert (margins["error"], margins["figures"]) == ("gone", {"a": None})
    breaks(ScenarioError("does not fit"))
    assert work.run(work.Work(case(0), figures=("a",), margins=True))["error"] == "does not fit"
    with pytest.raises(ScenarioError, match="does not fit"):
        work.run(work.Work(case(0)))


def test_margins_are_of_requirements_and_of_figures_with_a_bound(monkeypatch):
    """For a figure: how far it is inside its bound; a distance beyond all numbers counts as infinity."""
    numbers = {"req": 0.25, "both": 0.5, "fig": 3.0, "far": math.inf, "lost": math.nan}
    expect = {"both": Expectation(at_most=9.0), "fig": Expectation(at_most=2.5), "far": Expectation(at_least=1.0)}
    scenario = SimpleNamespace(expect=expect, requirements={"req": 1, "both": 1})
    evaluated = []

    def evaluate(rig, signals, wanted):
        evaluated.append([f.name for f in wanted])
        return [SimpleNamespace(name=n, number=v, error=f"why {n}") for n, v in numbers.items()]

    monkeypatch.setattr(work, "evaluate", evaluate)
    ran = done([], wanted=[SimpleNamespace(name=n) for n in (*numbers, "other")])
    ran.rig = SimpleNamespace(scenario=scenario)
    result = work._margins(ran, ("req", "both", "fig", "far"))
    assert result == {"figures": {"req": 0.25, "both": 0.5, "fig": -0.5, "far": 1e300}, "passed": False, "error": ""}
    assert evaluated == [["req", "both", "fig", "far"]]
    assert work._margins(ran, ("req", "far"))["passed"] is True
    numbers["req"] = 0.0
    assert work._margins(ran, ("req",))["passed"] is True
    lost = work._margins(ran, ("req", "lost", "both"))
    assert (lost["figures"]["lost"], lost["passed"], lost["error"]) == (None, False, "lost: why lost")


@pytest.mark.parametrize(
    ("values", "text"),
    [([1.0, 2.0], ""), ([1.0, math.inf], "1 of 2 never"), ([math.nan] * 3, "3 of 3 not measured"),
     ([math.inf, math.nan, math.nan, 1.0], "1 of 4 never, 2 of 4 not measured"), ([-math.inf], "")],
)  # fmt: skip
def test_runs_without_a_value_are_counted(values, text):
    assert work.absent(values) == text


# tables ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("values", "column"),
    [([1, 2.5, None], [1.0, 2.5, None]), (["a", None], ["a", None]), ([True, False], [True, False]),
     ([True, 1], ["true", "1"]), ([[1, 2], None], ["[1, 2]", None]), (["a", 1], ['"a"', "1"]), ([None], [None])],
)  # fmt: skip
def test_a_column_has_numbers_texts_or_flags_or_is_reported(values, column):
    result = table._column(values)
    assert result == column
    assert [type(v) for v in result] == [type(v) for v in column]


def test_each_statistic_is_computed_as_named():
    rows = [row(k, figures={"f": v}, overrides={"p": k % 2}, seed=k, case="ab"[k % 2]) for k, v in
            enumerate([4.0, 1.0, 3.0, 9.0, 8.0])]  # fmt: skip

    def value(rows=rows, **keys):
        return table.summarise(rows, study(summaries={"s": {"figure": "f"} | keys}).summaries["s"])

    computed = {
        name: value(statistic=name) for name in ("mean", "median", "min", "max", "sum", "count", "quantile", "std")
    }
    assert computed == {"mean": 5.0, "median": 4.0, "min": 1.0, "max": 9.0, "sum": 25.0, "count": 5.0, "quantile": 4.0,
                    "std": pytest.approx(math.sqrt((1 + 16 + 4 + 16 + 9) / 5))}  # fmt: skip
    assert value(statistic="quantile", q=1.0) == 9.0
    assert value(statistic="quantile", q=0.125) == 2.0
    assert value(statistic="share", of="at least 3") == 0.8
    where = ({"p": 1}, {"case": "a", "p": 0}, {"seed": 2}, {"scenario": "lag"})
    assert [value(where=w, statistic="sum") for w in where] == [10.0, 15.0, 3.0, 25.0]
    assert (value(rows=[], statistic="count"), math.isnan(value(rows=[], statistic="share", of="at most 1"))) == (
        0.0,
        True,
    )
    lost = [*rows, row(9)]
    assert [math.isnan(value(lost, statistic=name)) for name in ("mean", "max", "median")] == [True] * 3
    assert (value(lost, statistic="count"), value(lost, statistic="share", of="at least 3")) == (6.0, 4.0 / 6.0)


def test_summaries_are_compared_with_expected_and_published_values():
    about = {"figure": "f", "statistic": "max"}
    claim = {"where": "Table I", "verdict": "reproduced", "published": 2.0}
    definition = study(
        summaries={"a": about, "b": about, "c": {"figure": "g"}}, expect={"a": "at most 1", "c": "at most 9"},
        claims={"a": claim, "other": claim | {"figure": "b", "published": 7.0}},
    )  # fmt: skip
    results = {r.name: r for r in table.results(definition, [row(figures={"f": 2.0})], {"f": "s"})}
    assert {n: (r.value, r.published, r.passed, r.error) for n, r in results.items()} == {
        "a": (2.0, 2.0, False, ""), "b": (2.0, 7.0, True, ""), "c": (None, None, False, "the result is nan"),
    }  # fmt: skip
    assert [r.unit for r in results.values()] == ["s", "s", ""]
    assert (results["a"].at_most, results["b"].at_most) == (1.0, None)
    held = {f.key: f.holds for f in table.claims(definition, list(results.values()))}
    assert held == {"a": True, "other": False}


# the page --------------------------------------------------------------------------------------------------------


def test_the_best_candidate_has_all_its_seeds_within_the_limits():
    settings = {"figure": "f", "count": 4, "subject_to": {"g": "at most 2"}, "parameters": {"a": {"uniform": [0, 1]}}}
    values = [(0.1, 0.1, 3.0), (0.4, 0.6, 2.0), (0.3, 0.5, 1.0), (0.2, None, 1.0), (0.9, 0.8, 1.0)]
    rows = [row(2 * k + j, figures={"f": v[j], "g": v[2]}, seed=j) for k, v in enumerate(values) for j in range(2)]
    for aim, numbers in (("minimise", [4, 5]), ("maximise", [8, 9])):
        result = page.best(study(search=settings | {"aim": aim}, seeds=2), rows)
        assert [r["number"] for r in result] == numbers
    # One seed of the third run is missing.
    assert [r["number"] for r in page.best(study(search=settings, seeds=2), rows[:5])] == [2, 3]
    assert page.best(study(search=settings | {"subject_to": {"g": "at most 0"}}, seeds=2), rows) == []
    assert page.best(study(), rows) == []


def test_a_figure_is_printed_or_the_reason_why_it_has_no_value():
    rows = [row(figures={"f": 1.23456789}), row(never=["f"]), row(), row(error="gone")]
    assert [page._figure(r, "f") for r in rows] == ["1.23457", "never", "–", ""]
    assert page._figures_of(rows[:1], "f") == "1.23457"
    assert page._figures_of([*rows, row(figures={"f": 3.0})], "f") == "mean 2.11728, 1 of 5 never, 2 of 5 not measured"
    assert page._figures_of(rows[1:3], "f") == "1 of 2 never, 1 of 2 not measured"
    assert [page._cell(v) for v in (1.0, 0.123456789, True, "x", [1, 2], None)] == [
        "1", "0.123457", "True", "x", "[1, 2]", "–",
    ]  # fmt: skip
    assert (page._heading("rise_time", "s"), page._heading("share", "")) == ("rise time (s)", "share")


def test_a_run_is_labelled_by_its_changes():
    drawn = study(draws={"count": 1, "parameters": {"b.y": {"uniform": [0, 1]}}}, grid={"a.x": [1]})
    result = row(case="one", overrides={"a.x": 1, "b.y": 0.123456, "c.z": "w"})
    assert page._changes(drawn, result) == "one, x 1, y 0.1235, z w"
    assert table.label(drawn, result) == "one, x 1"
    gridded = study(grid={"a.x": [1], "b.y": [2]})
    assert page._changes(gridded, result) == table.label(gridded, result) == "one, x 1, y 0.123456"
    assert table.label(study(), row(overrides={"a.x": 1})) == "all runs"
    assert page._changes(study(search={"figure": "f", "count": 1, "parameters": {"a": {"uniform": [0, 1]}}}),
                         row(overrides={"a.x": [1, 2]})) == "x [1, 2]"  # fmt: skip


def test_signals_and_figures_to_draw_are_selected():
    rows = [row(figures={"a": None, "b": 1.0}, overrides={"n.x": 1, "n.s": "t", "n.c": 2, "n.f": True})]
    rows.append(row(figures={"a": None, "c": 1.0, "d": None}, never=["d"],
                    overrides={"n.x": 2.5, "n.s": 1, "n.c": 2, "n.f": False}))  # fmt: skip
    assert pictures.chosen(study(), rows) == ["b", "c", "d"]
    assert pictures.chosen(study(figures=["c", "a"], summaries={"s": {"figure": "b"}}), rows) == ["c", "b"]
    many = [row(figures={f"f{k}": 1.0 for k in range(9)})]
    assert pictures.chosen(study(), many) == [f"f{k}" for k in range(6)]
    assert pictures.numeric(rows) == ["n.x"]


@pytest.mark.parametrize(
    ("values", "middle"),
    [([1.0, 3.0], 2.0), ([1.0, math.inf, math.inf], math.nan), ([1.0, 2.0, math.inf], 2.0), ([math.nan, 4.0], 4.0),
     ([math.nan], math.nan), ([1.0, math.inf], math.nan)],
)  # fmt: skip
def test_a_median_counts_an_event_that_never_happens_as_the_largest(values, middle):
    assert pictures._median(np.array(values)) == pytest.approx(middle, nan_ok=True)


@pytest.mark.parametrize(("share", "grid"), [(4, True), (5, False)])
def test_a_map_is_a_grid_if_a_quarter_of_its_cells_is_known(share, grid):
    rows = [row(k, figures={"f": 1.0 * k}, overrides={"x": 1.0 * k, "y": 1.0 * k}) for k in range(share)]
    ax = on_paper(pictures._map(rows, ["x", "y"], "f", {})).axes[0]
    assert (type(ax.collections[0]).__name__ == "QuadMesh") == grid


@pytest.mark.parametrize("seeds", [1, 2, 3])
def test_a_band_over_a_parameter_is_explained(seeds):
    rows = [row(figures={"f": 1.0 * k}, overrides={"x": 1.0 * (k % 2)}, seed=k) for k in range(2 * seeds)]
    for banded in (True, False):
        figure = on_paper(pictures._over(rows, "x", ["f"], {}, banded=banded))
        text = "" if figure._supxlabel is None else figure._supxlabel.get_text()
        assert text.endswith(f"band: least to greatest of up to {seeds} runs" if banded and seeds > 1 else "")
        assert bool(text) == (banded and seeds > 1)


def test_in_parallel_coordinates_the_best_is_drawn_last():
    settings = {"figure": "f", "count": 3, "parameters": {"x": {"uniform": [0, 1]}}}
    rows = [row(k, figures={"f": f}, overrides={"x": x}) for k, (f, x) in
            enumerate([(3.0, 0.0), (1.0, 0.5), (2.0, 1.0), (1.0, 0.25), (None, 0.75)])]  # fmt: skip
    for aim, last in (("minimise", [0.5, 0.0]), ("maximise", [0.0, 1.0])):
        (ax,) = on_paper(pictures._parallel(study(search=settings | {"aim": aim}).search, rows)).axes
        assert len(ax.lines) == 4
        assert ax.lines[-1].get_ydata() == pytest.approx(last)  # of equal values the first counts
        assert [line.get_alpha() for line in ax.lines] == pytest.approx([0.2, 0.4, 0.6, 0.8])
        assert [t.get_text() for t in ax.get_xticklabels()] == ["x\n0 to 1", "f\n1 to 3"]


@pytest.mark.parametrize("seeds", [1, 3])
def test_bands_show_at_most_six_groups_up_to_their_common_end(seeds):
    """One of the seeds broke off before its first sample, another one half-way."""
    definition = study(cases={name: {} for name in "abcdefg"}, signals=["s"], samples=5, seeds=seeds)
    rows = [row(case=name, seed=k) | {"signals": {"s": {"end": 2.0, "x": [k + 1.0 * j for j in range(5)]}}}
            for name in "abcdefg" for k in range(seeds)]  # fmt: skip
    rows += [row(case="a") | {"signals": {"s": kept}} for kept in ({"end": 0.0, "x": []}, {"end": 1.0, "x": [1.0]})]
    rows.append(row(case="b"))
    ((title, figure),) = pictures._bands(definition, rows, {"s": "V"})
    figure = on_paper(figure)
    (ax,) = figure.axes
    more = ": median of 3, 10 % to 90 %" if seeds > 1 else ""
    assert title == "Signal s"
    assert [line.get_label() for line in ax.lines] == [f"{name}{more}" for name in "abcdef"]
    assert ax.lines[0].get_xydata().tolist() == [[0.5 * j, (1.0 if seeds > 1 else 0.0) + j] for j in range(5)]
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("Time, s", "Voltage, V")
    areas = [part.get_paths()[0].get_extents().extents for part in ax.collections]
    assert len(areas) == (6 if seeds > 1 else 0)
    # The 10 % and 90 % quantiles of three values lie a fifth of the way to the middle one.
    assert all(area == pytest.approx((0.0, 0.2, 2.0, 5.8)) for area in areas)


@pytest.fixture
def page_of(monkeypatch):
    """The lines of a page with some rows."""
    monkeypatch.setattr(page, "load_scenario", lambda name: SimpleNamespace(cites=()))

    def lines(rows, held=(), **keys):
        body = page.body_of(study(**keys), rows, [], held, Statistics(), [], {"f": "s"})
        return [line.strip() for line in page_lines(make_page("t", body))]

    return lines


@pytest.mark.parametrize("verdict", ["reproduced", "not_checkable"])
def test_a_verdict_is_in_words_or_a_mark_if_it_does_not_hold(page_of, verdict):
    about = {"text": "It does.", "where": "Table I", "published": 2.0, "asked": "within 5 %", "measured_text": "2.1",
             "verdict": verdict, "reason": "so"}  # fmt: skip
    for holds, word in ((True, verdict.replace("_", " ")), (False, f"✗ {verdict}: not borne out")):
        lines = page_of([], [SimpleNamespace(holds=holds, **about)])
        assert any(word in line for line in lines)
        assert sum("✗" in line for line in lines) == (not holds)


@pytest.mark.parametrize("most", [2, 3])
def test_a_page_lists_the_first_runs_and_notes_that_there_are_more(page_of, monkeypatch, most):
    monkeypatch.setattr(page, "LONGEST", most)
    lines = page_of([row(k, figures={"f": 1.0 * k}) for k in range(3)])
    assert sum(line.startswith(tuple(f"tr: {k} |" for k in range(3))) for line in lines) == most
    note = "table.parquet and table.csv have every run with the command that repeats it."
    assert f"p.note: {'The first 2 of 3 runs. ' if most == 2 else ''}{note}" in lines
    heads = next(line for line in lines if line.startswith("tr: Run"))
    assert heads.split(" | ")[-1].endswith("f (s)")
    broken = page_of([row(0, figures={"f": 1.0}), row(1, error="gone")])
    assert next(line for line in broken if line.startswith("tr: Run")).endswith("| Broke")
    assert any(line.endswith("| gone") for line in broken)


# the command line ------------------------------------------------------------------------------------------------


def changes(words):
    return options._changes(make_parser().parse_args(["study", "lag", *words.split()]))


@pytest.mark.parametrize(
    ("words", "result"),
    [
        ("", {}),
        ("--seeds 3 --duration 0.5 --figures a b --signals s", {"seeds": 3, "duration": 0.5, "figures": ["a", "b"],
                                                                 "signals": ["s"]}),
        ("--grid a.x=1,2 --grid a.y=0:1:0.5", {"grid": {"a.x": [1, 2], "a.y": [0.0, 0.5, 1.0]}}),
        ("--draw a.x=1..2 --draws 7 --method random",
         {"draws": {"count": 7, "method": "random", "parameters": {"a.x": {"uniform": [1.0, 2.0]}}}}),
        ("--search f --draw a.x=1..2*2 --draws 9 --subject-to g<=5 --subject-to h>=-1e-3",
         {"search": {"figure": "f", "aim": "minimise", "count": 9,
                     "parameters": {"a.x": {"uniform": [[1.0, 1.0], [2.0, 2.0]]}},
                     "subject_to": {"g": "at most 5", "h": "at least -1e-3"}}}),
    ],
)  # fmt: skip
def test_options_of_a_study_are_its_keys(words, result):
    assert changes(words) == result


@pytest.mark.parametrize(
    ("words", "text"),
    [
        ("--search f --subject-to g=5", "--subject-to 'g=5': expected FIGURE <= NUMBER or FIGURE >= NUMBER"),
        ("--draw a.x=1..2~3", "a.x=1..2~3: a parameter has no time profile, expected LOW..HIGH*N for a list"),
    ],
)
def test_options_that_do_not_fit_are_refused(words, text):
    with pytest.raises(ScenarioError) as refused:
        changes(words)
    assert str(refused.value) == text


@pytest.mark.parametrize(("count", "dimensions", "seed"), [(1, 1, 0), (7, 3, 4)])
def test_a_latin_hypercube_is_that_of_scipy(count, dimensions, seed):
    parameters = {f"a.p{k}": {"uniform": [0.0, 1.0]} for k in range(dimensions)}
    points = draw(Draws(count=count, seed=seed, parameters=parameters))
    wanted = qmc.LatinHypercube(dimensions, rng=np.random.default_rng(seed)).random(count)
    assert [list(point.values()) for point in points] == wanted.tolist()


@pytest.mark.parametrize(
    ("left", "foreign", "begins", "ends"),
    [(math.inf, False, True, True), (-1.0, False, True, False), (math.inf, True, False, False)],
)
def test_a_first_run_before_workers_are_copied_ends_when_much_of_it_is_left(left, foreign, begins, ends, monkeypatch):
    seen = []

    def simulated(*arguments, progress, **keywords):
        run = simulate(*arguments, progress=lambda t: (seen.append(t), progress(t)), **keywords)
        seen.append(run)
        return run

    monkeypatch.setattr(work, "simulate", simulated)
    monkeypatch.setattr(work, "LEFT", left)
    # External code can crash the process, so its rigs are warmed up in a worker.
    monkeypatch.setattr(work, "is_foreign", lambda block: foreign)
    work.warm(rig_of("dc_motor_smc", duration=0.1), work.Work(Case(0, "dc_motor_smc", "", {}, 1)))
    # A native run reports its progress less often than a run in Python.
    assert (bool(seen), any(isinstance(x, Run) for x in seen)) == (begins, ends)
    assert left > 0.0 or len(seen) == 3
