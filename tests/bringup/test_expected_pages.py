"""The parts of pages in words: numbers, tables of one run and of several, papers, reports for machines."""

import math
import random
from dataclasses import replace
from types import SimpleNamespace
from xml.etree.ElementTree import tostring

import numpy as np
import pytest
from expected_text import check_expected, page_lines
from softrig_bringup.page.citations import Citation, _name, _plain, _publication, cited, listed, sources
from softrig_bringup.page.html import e, mark, picture, table
from softrig_bringup.page.junit import Case, Suite, write_reports
from softrig_bringup.page.wiring import Wiring, columns
from softrig_bringup.page.wording import accepted, difference, in_words, measured, measured_here, number, short, spans
from softrig_bringup.plots.curves import Curve
from softrig_bringup.report import apart, run_page, several
from softrig_bringup.report.record import RunRecord
from softrig_bringup.results.page import by_system, counts
from softrig_bringup.verbs.plot_verb import _table
from softrig_core import ScenarioError
from softrig_core.verdict.findings import Finding
from softrig_core.verdict.result import Result


def result(name="m", value=1.0, passed=True, **more):
    return Result(name=name, value=value, passed=passed, **more)


def lines(*elements):
    for element in elements:
        yield from ([element] if isinstance(element, str) else page_lines(tostring(element, "unicode", "html")))


def text(*elements):
    return " / ".join(lines(*elements))


# numbers --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("value", "as_written", "as_measured"),
    [
        (None, "–", ""),
        (0.0, "0", "0"),
        (-1.5, "−1.5", "-1.5"),
        (1.23456789012, "1.23456789", "1.23457"),
        (15459.0012, "15459.0012", "15459"),
        (-1e-12, "−1e−12", "-1e-12"),
    ],
)
def test_numbers_have_all_their_digits_and_measured_ones_six(value, as_written, as_measured):
    assert (number(value), short(value)) == (as_written, as_measured)


@pytest.mark.parametrize(
    ("value", "tolerance", "message"),
    [
        (1.23456789, None, "1.23457"),
        (-1.23456789, 0.0, "−1.23457"),
        (1.23456789, 0.1, "1.235"),  # rounded to a hundredth of the tolerance
        (1.23456789, 0.05, "1.2346"),
        (1.23456789, 1.0, "1.23"),
        (-123.456, 10.0, "−123.5"),
        (123.456, 100.0, "123"),
        (123456.0, 1e5, "123456"),
    ],
)
def test_a_measured_value_is_rounded_to_a_hundredth_of_its_tolerance(value, tolerance, message):
    assert measured(result(value=value, tolerance=tolerance)) == message


@pytest.mark.parametrize(
    ("error", "message", "text"),
    [
        ("never", "never", True),
        ("never <settles>", "never", True),
        ("holds by its conditions alone", "holds", True),
        ("violated by its conditions alone", "violated", True),
        ("holds by chance", "not measured", False),
        ("no sample", "not measured", False),
        ("", "not measured", False),
    ],
)
def test_the_text_in_place_of_a_missing_value_is_as_expected(error, message, text):
    none = result(value=None, passed=False, error=error)
    assert (in_words(none), measured(none), measured_here(none)) == (message, message, text)
    assert (in_words(result(error=error)), measured_here(result(error=error))) == ("", True)


@pytest.mark.parametrize(
    ("value", "published", "message"),
    [
        (1.1, 1.0, "+10.00 %"),
        (-1.1, -1.0, "−10.00 %"),
        (1.0, 3.0, "−66.67 %"),
        (-2.0, 4.0, "−150.00 %"),
        (0.25, 0.0, "+0.25"),
        (-0.12345, 0.0, "−0.123"),
        (None, 1.0, "–"),
        (1.0, None, "–"),
    ],
)
def test_the_distance_of_a_value_from_the_published_one_is_as_expected(value, published, message):
    assert difference(value, published) == message


def test_the_interval_of_accepted_values_is_written():
    assert accepted(result()) == ""
    assert accepted(result(expected=-2.0, tolerance=0.5)) == "−2 ± 0.5"
    assert accepted(result(expected=2.0)) == "2 ± 0"
    assert accepted(result(at_least=1.0, at_most=2.5)) == "≥ 1, ≤ 2.5"


def test_three_intervals_of_time_are_written_out():
    assert spans([]) == ""
    four = [(0.0, 1.0), (2.0, 2.0), (3.0, 4.5), (5.0, 6.25)]
    assert spans(four[:3]) == "from 0 to 1 s, at 2 s, from 3 to 4.5 s"
    assert spans([*four, (7.0, 8.0)]) == "from 0 to 1 s, at 2 s, from 3 to 4.5 s and 2 times more, to 8 s"


# one run --------------------------------------------------------------------------------------------------------------


def run(**more):
    about = {
        "scenario": "lag",
        "title": "A lag",
        "system": "lag",
        "source": "Nobody 2020",
        "mode": "inprocess",
        "seed": 3,
        "duration_s": 2.0,
        "ticks": 1234567,
        "wall_s": 0.5,
        "command": "softrig run lag",
        "metrics": [],
        "parameters": {"gain": {"k": 1.5}},
        "versions": {"python": "3.13", "commit": "a"},
        "code": {"softrig_core": "x"},
        "wiring": {"nodes": {"gain": {"executable": "p/gain", "period": 0.01}}},
    }
    return RunRecord.read(about | more)


ONE = result("rise", 1.05, expected=1.0, tolerance=0.1, unit="s")
OFF = result("drop", 1.25, False, expected=1.0, tolerance=0.1, unit="V")
RUNS = {
    "plain": {"metrics": [ONE, OFF]},
    "all pass": {"metrics": [ONE]},
    "nothing asked": {"metrics": [result("cost", 3.0)]},
    "no metrics": {},
    "broke": {"error": "gone", "reached_s": 0.5},
    "stopped": {"stopped": "stopped", "reached_s": 1.0, "metrics": [OFF]},
    "changed": {"changed": ["k 3"], "metrics": [OFF, result("late", None, False, at_most=1.0, error="no sample")]},
    "changed, nothing follows": {"changed": ["k 3"], "metrics": [OFF.not_judged("k = 2")]},
    "changed, some follows": {"changed": ["k 3"], "metrics": [OFF.not_judged("k = 2"), ONE]},
    "of no time": {"wall_s": 0.0, "reached_s": 1.0},
    "that did nothing": {"reached_s": 0.0},
}


def test_the_subtitle_of_a_run_is_as_expected():
    messages = []
    for name, more in RUNS.items():
        of = run(**more | {"metrics": [m.plain() for m in more.get("metrics", ())]})
        missed = [m.name for m in of.missed]
        messages += [
            f"{name}: {of.simulated_s:g} s, compared {of.compared}, missed {missed}",
            f"  {text(run_page._facts(of))}",
        ]
        messages += [f"  {line}" for line in lines(run_page.metrics(of))]
    check_expected("pages/facts", messages)


@pytest.mark.parametrize(
    ("value", "dot", "share"),
    [
        (1.0, 40.0, "+0"),
        (1.1, 66.0, "+100"),
        (0.9, 14.0, "−100"),
        (1.05, 53.0, "+50"),
        (1.14, 76.4, "+140"),
        (9.0, 76.4, "+8000"),
        (0.5, 3.6, "−500"),
    ],
)
def test_the_dot_of_a_gauge_is_in_its_band_or_beside_it(value, dot, share):
    """The band is 52 wide around 40, one tolerance to each side; the dot does not move beyond 1.4 tolerances."""
    drawn = run_page._gauge(result(value=value, passed=abs(value - 1) <= 0.1001, expected=1.0, tolerance=0.1))
    circle = drawn.find("circle")
    assert (float(circle.get("cx")), circle.get("class")) == (dot, "pass" if 14 <= dot <= 66 else "miss")
    assert drawn.find("title").text == f"{share} % of the tolerance"
    band = drawn.find("rect")
    assert (band.get("x"), band.get("width"), drawn.find("line").get("x1")) == ("14", "52", "40")


def test_there_is_no_gauge_without_a_band():
    assert [run_page._gauge(m) for m in (result(), result(expected=1.0), result(expected=1.0, tolerance=0.0))] == [
        ""
    ] * 3
    assert run_page._gauge(result(value=None, expected=1.0, tolerance=0.1, error="never")) == ""


def test_figures_of_nodes_and_values_of_parameters_are_written_with_their_units():
    heads = {"cpu_s": "cpu (s)", "round_trip_p99_ms": "round trip p99 (ms)", "peak_mb": "peak (MB)", "ticks": "ticks",
             "late_ticks": "late ticks", "a_s_b": "a s b"}  # fmt: skip
    assert {name: run_page._heading(name) for name in heads} == heads
    assert [run_page._figure(v) for v in (None, 3, 0.12345, 12345.0)] == ["–", "3", "0.123", "1.23e+04"]
    cases = [(None, "s"), ("soft", ""), (2.5, "m^2"), ([1, 2.5], "V"), (True, ""), ("", "")]
    assert [run_page._value(v, u) for v, u in cases] == ["–", "soft", "2.5 m²", "[1, 2.5] V", "true", ""]
    status = {"t": 3.0, "ticks": 3, "cpu_s": 0.5, "state": "done", "reports": {}, "native": [1, ""]}
    assert run_page._plain(status) == {"ticks": 3, "cpu_s": 0.5}


@pytest.mark.parametrize(("n", "wide"), [(1, False), (6, True)])
def test_a_diagram_wider_than_a_phone_has_a_note_that_it_scrolls(n, wide):
    nodes = {
        f"node_{k}": {"executable": "p/node", "period": 0.01, "plant": k == n - 1, "outside": k == 0} for k in range(n)
    }
    wires = [
        {"topic": f"t{k}", "type": "T", "source": f"node_{k}", "readers": [f"node_{k + 1}"] if k < n - 1 else []}
        for k in range(n)
    ]
    actual, note = run_page._rig(run(wiring={"nodes": nodes, "wires": wires}))
    assert actual.get("class") == ("scroll wide" if wide else "scroll")
    message = (
        "The plant, shaded, owns time. Dashed: a node outside, its parameters unknown. A ring ends a topic that no node"
    )
    assert note.text.startswith(message)
    assert columns(Wiring()) == []
    (_, plain) = run_page._rig(run())
    assert not plain.text


# several --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(3))
def test_runs_in_one_picture_are_at_most_four_times_shorter_than_the_longest_of_them(seed):
    rng = random.Random(seed)
    ends = {k: rng.choice([0.25, 0.5, 1.0, 1.5, 4.0, 6.0, 16.0]) for k in range(8)}
    parts = several._lengths(ends)
    assert sorted(k for part in parts for k in part) == sorted(ends)
    assert all(part == sorted(part) for part in parts)
    longest = [max(ends[k] for k in part) for part in parts]
    assert longest == sorted(longest, reverse=True)
    for part, most in zip(parts, longest, strict=True):
        assert [k for k in ends if most / 4 <= ends[k] <= most] == part


def test_folders_are_named_by_the_part_of_their_path_that_distinguishes_them(tmp_path):
    paths = [tmp_path / p for p in ("a/x", "a/y", "b/x")]
    assert apart._tails(paths[:2]) == ["x", "y"]
    assert apart._tails(paths) == ["a/x", "a/y", "b/x"]
    assert apart._tails([paths[0], paths[0], paths[1]]) == ["x [1]", "x [2]", "y"]
    assert apart._tails([paths[0]]) == ["x"]


@pytest.mark.parametrize(
    ("message", "parted"),
    [
        ("law.k=3", ("law.k", "3")),
        ("k=a=b", ("k", "a=b")),
        ("duration 3", ("duration, s", "3")),
        ("seed 4", ("seed", "4")),
        ("law outside, its parameters unknown", ("law outside, its parameters unknown", "yes")),
    ],
)
def test_a_change_is_split_into_its_name_and_its_value(message, parted):
    assert apart._key_value(message) == parted


def test_parameters_are_split_into_their_leaves():
    results = dict(
        apart._leaves(
            "n",
            {
                "k": 1.5,
                "rule": "soft",
                "list": [1, 2],
                "of": [{"a": 1}, {"a": None}],
                "json": '{"b": [{"c": 2}]}',
                "no": "{x",
                "sized": "[1, 2]",
            },
        )
    )
    assert results == {
        "n.k": "1.5",
        "n.rule": "soft",
        "n.list": "[1, 2]",
        "n.of[0].a": "1",
        "n.of[1].a": "null",
        "n.json.b[0].c": "2",
        "n.no": "{x",
        "n.sized": "[1, 2]",
    }


def test_lists_of_runs_and_of_differences_are_limited():
    assert several._listed(list("abcdef")) == "a, b, c, d, e, f"
    assert several._listed(list("abcdefgh")) == "a, b, c, d, e, f and 2 more"
    for n, more in ((40, []), (41, ["And 1 more."]), (43, ["And 3 more."])):
        shown = list(several._differing({f"p{k}": ["1", "2"] for k in range(n)}, ["x", "y"]))
        assert len(shown[0].findall(".//tr")) == 1 + 40
        assert [p.text for p in shown[1:]] == more


def test_draws_are_named_by_the_common_part_of_their_names():
    runs = [run(seed=k) for k in range(4)]
    for named, actual in (
        (["a-1", "a-2", "a-3", "a-4"], ["a"] * 4),
        (["1", "2", "3", "4"], ["lag"] * 4),
        (["a", "a-2", "a-3", "a-4"], ["a"] * 4),
        (["run_1", "run_2", "run_3", "other"], ["lag"] * 4),
    ):
        assert several.groups(runs, named) == actual
    assert several.groups(runs[:2], ["a-1", "a-2"]) == ["a-1", "a-2"]  # a band needs at least three runs
    # The repeated run has no new seed, so these are no band.
    assert several.groups([*runs[:3], runs[0]], list("abcd")) == list("abcd")
    for more in ({"error": "x"}, {"stopped": "x"}, {"code": {}}, {"mode": "processes"}):
        assert several.groups([*runs[:2], run(seed=5, **more)], ["a-1", "a-2", "a-3"]) == ["a-1", "a-2", "a-3"]
    last = [run(seed=k, parameters={"gain": {"k": 2.0}}) for k in range(3)]
    assert several.groups([*runs[:3], *last], ["a-1", "a-2", "a-3", "b_1", "b_2", "b_3"]) == ["a"] * 3 + ["b"] * 3
    also = several.groups([*runs[:3], run(error="x")], ["a-1", "a-2", "a-3", "a"])
    assert also == ["a-1 and others"] * 3 + ["a"]


def metrics(n, **more):
    return [
        result(f"m_{k}", k + 0.5, k != 1, unit="m^2" if k < 2 else "", at_most=9.0, **more).plain() for k in range(n)
    ]


@pytest.mark.parametrize(
    ("name", "runs"),
    [
        ("beside", [{"metrics": metrics(3)}, {"metrics": metrics(2), "changed": ["k=2"]}, {"system": "other"}]),
        ("below", [{"metrics": metrics(9)}, {"metrics": metrics(9)}]),
        ("parted", [{"metrics": metrics(10)}] * 9),
        ("eight", [{"metrics": metrics(8)}] * 2),
        ("eight_runs", [{"metrics": metrics(9)}] * 8),
    ],
)
def test_figures_of_several_runs_are_side_by_side_as_expected(name, runs):
    records = [run(**more) for more in runs]
    named = [f"run {k}" for k in range(len(records))]
    check_expected(f"pages/side_{name}", lines(*several.side_by_side(records, named)))


def test_the_differences_between_runs_are_as_expected():
    """A change that describes itself, an unnamed one, one of a node, an end, a version; and none."""
    two = {"gain": {"executable": "p/gain2", "period": 0.01, "outside": True}}
    pairs = {
        "nothing": [{}, {"versions": {"python": "3.13", "commit": "b", "run.lock": "c"}}],
        "the machine, of code that nobody knows": [
            {"code": {}},
            {"code": {}, "versions": {"python": "3.13", "commit": "b"}},
        ],
        "seed": [{}, {"seed": 4, "changed": ["seed 4"]}],
        "said": [{}, {"changed": ["gain.k=2"], "parameters": {"gain": {"k": 2.0, "j": 1}}}],
        "not said": [{}, {"parameters": {"gain": {"k": 2.0}}}],
        "node": [{}, {"wiring": {"nodes": two}, "parameters": {}}],
        "end": [{"error": "x"}, {"stopped": "stopped at 1 s", "changed": ["stopped at 1 s"]}],
        "length": [{}, {"duration_s": 3.0, "changed": ["duration 3"]}, {"mode": "processes"}],
        "code": [{}, {"code": {"softrig_core": "y", "mine": "z"}, "versions": {"python": "3.14"}}],
        "another scenario": [{}, {"scenario": "lag_slow", "parameters": {"gain": {"k": 9.0}}}],
    }
    messages = []
    for name, runs in pairs.items():
        messages.append(name)
        records = [run(**more) for more in runs]
        messages += [f"  {line}" for line in lines(*several.differences(records, ["a", "b", "c"][: len(runs)]))]
    check_expected("pages/differences", messages)


# tables, papers, reports ----------------------------------------------------------------------------------------------


def test_a_table_aligns_numbers_to_the_right_and_marks_missing_ones():
    actual = table(["a", "b", "c"], [["1", "2", "–"], [e("b", "x"), "–", ""]], " n")
    assert [c.get("class") for c in actual.iter("td")] == [None, "number", "none", None, "number none", None]
    assert [c.get("class") for c in actual.iter("th")] == [None, "number", None]
    assert [c.get("data-label") for c in actual.iter("td")] == list("abcabc")
    assert (
        text(e("p", "a", "b", e("i", "c"), "d", "e", e("i", "f"), title="", class_="x"))
        == "p.x /   'ab' /   i: c /   'de' /   i: f"
    )
    assert [text(mark(ok, "said")) for ok in (True, False)] == ["span.pass: ✓ said", "span.miss: ✗ said"]
    png = bytes(16) + (640).to_bytes(4, "big") + (48).to_bytes(4, "big")
    assert {k: picture(png, "t").get(k) for k in ("alt", "width", "height")} == {
        "alt": "t",
        "width": "640",
        "height": "48",
    }


def test_papers_are_printed_with_their_location():
    assert _name(["Ada", "King"], ["von", "Noël"]) == "A. K. von Noël"
    assert _plain("{A} B--C \\& D") == "A B–C & D"
    where = {"journal": "J", "booktitle": "B", "publisher": "P", "volume": "2", "number": "6", "pages": "1--9"}
    assert _publication(where) == "J 2(6), 1–9"
    assert _publication({k: where[k] for k in ("booktitle", "publisher", "volume")}) == "B 2"
    assert _publication({k: where[k] for k in ("publisher", "number")}) == "P (6)"
    assert _publication({}) == ""
    paper = Citation(key="k", authors=("A. B", "C. D"), title="T", year="2020", place="J 2", doi="10/x", bibtex="@x{k}")
    plain = replace(paper, doi="", place="")
    assert listed([paper, plain]) == [
        "- A. B, C. D: *T*. J 2, 2020. [doi:10/x](https://doi.org/10/x).",
        "- A. B, C. D: *T*. 2020. No DOI known.",
    ]
    shown = [tostring(p, "unicode") for p in sources([paper, plain])]
    assert shown[0] == '<p>A. B, C. D: <cite>T</cite>. J 2, 2020. <a href="https://doi.org/10/x">doi:10/x</a>.</p>'
    assert shown[2] == "<p>A. B, C. D: <cite>T</cite>. 2020. No DOI known.</p>"
    assert shown[1] == shown[3] == "<details><summary>BibTeX</summary><pre>@x{k}</pre></details>"


def test_the_first_of_two_bibtex_entries_with_one_key_is_used_and_a_wrong_file_is_named(tmp_path, monkeypatch):
    entry = "@book{{k, author = {{Noël, Ada}}, title = {{{}}}, year = 2020, publisher = {{P}}}}\n"
    folders = [tmp_path / name for name in ("one", "two", "none")]
    for folder in folders[:2]:
        folder.mkdir()
        (folder / "references.bib").write_text(entry.format(folder.name), encoding="utf-8")
    monkeypatch.setattr("softrig_bringup.page.citations.scenario_folders", lambda: iter(folders))
    assert cited(()) == ()
    (actual,) = cited(["k"])
    assert (actual.title, actual.authors, actual.place, actual.year, actual.doi) == (
        "one",
        ("A. Noël",),
        "P",
        "2020",
        "",
    )
    assert actual.bibtex.startswith("@book{k,")
    with pytest.raises(
        ScenarioError, match=r"cites: no entry 'kk' in any references.bib beside scenarios \(did you mean 'k'"
    ):
        cited(["k", "kk"])
    (folders[1] / "references.bib").write_text("@book{k, title = {T}}\n")
    with pytest.raises(ScenarioError, match=r"two/references.bib: k: no author, year$"):
        cited(["k"])
    (folders[1] / "references.bib").write_text("\n@book{k, title = {T}\n")
    with pytest.raises(ScenarioError, match=r"two/references.bib: line 2: "):
        cited(["k"])


def test_a_report_for_machines_is_as_expected(tmp_path):
    suites = [
        Suite("good", 1.5, [Case("a", text="1 V"), Case("b"), Case("c", "missed\x1b", "2 V")]),
        Suite("broke\x00", 0.25, [Case("a")], "gone"),
        Suite("empty", 0.125),
    ]
    write_reports(tmp_path / "x.xml", suites, tmp_path / "x.json", [{"a": 1}])
    check_expected(
        "pages/junit", [*(tmp_path / "x.xml").read_text().splitlines(), *(tmp_path / "x.json").read_text().splitlines()]
    )
    write_reports(None, suites, None, [])
    assert sorted(p.name for p in tmp_path.iterdir()) == ["x.json", "x.xml"]


def test_curves_as_csv_have_one_row_for_each_time():
    t = np.array([0.0, 0.5, 1.0])
    curves = [Curve("a", "V", t, t + 1, signal="x/a"), Curve("a - b", "", t[1:], -t[1:])]
    source = SimpleNamespace(short=lambda name: f"short {name}" if name else "")
    assert _table(curves, source).split() == [
        "t",
        "(s),short",
        "x/a",
        "(V),a",
        "-",
        "b",
        "(1)",
        "0.0,1.0,",
        "0.5,1.5,-0.5",
        "1.0,2.0,-1.0",
    ]


def finding(scenario, key, verdict="reproduced", holds=True, **more):
    return Finding(scenario=scenario, key=key, text=key, where="W", verdict=verdict, holds=holds, **more)


def test_claims_are_counted_once_and_by_system():
    rows = [
        finding("b_1", "x"),
        finding("a_1", "y", "not_checkable"),
        finding("b_1", "x"),
        finding("b_2", "z", holds=False),
    ]
    assert counts(rows[:2]) == "2 claims: 1 reproduced, 1 not checkable; every verdict holds"
    assert counts(rows) == "3 claims in 4 rows: 2 reproduced, 1 not checkable; 1 verdicts are not borne out"
    scenarios = [SimpleNamespace(name=n, system=n[0]) for n in ("b_1", "b_2", "a_1")]
    results = [
        (system, [s.name for s in named], [r.key for r in group]) for system, named, group in by_system(scenarios, rows)
    ]
    assert results == [("a", ["a_1"], ["y"]), ("b", ["b_1", "b_2"], ["x", "x", "z"])]
    assert math.isnan(result().number)
