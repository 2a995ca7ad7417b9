"""The doc pages are true: generated parts are up to date, commands, links and examples work."""

import re
import shutil
from functools import cache
from importlib import import_module
from pathlib import Path

import pytest
from pages import drawn, generated as pages, names, numbers
from pages.drawn import rectifier_mpc
from pages.plots import animate
from ruamel.yaml import YAML
from softrig_bringup.cli import VERBS, main, make_parser
from softrig_bringup.study.definition import list_studies, make_study
from softrig_core import ScenarioError, figures_of, list_scenarios, load_scenario, rig_of, simulate
from softrig_nodes.processes.executables import find_executable

ROOT = Path(__file__).parents[2]
PAGES = sorted(p.relative_to(ROOT) for p in (*ROOT.glob("ros_pkgs/*/doc/**/*.md"),))
SYSTEMS = {
    "dc_motor_smc", "dc_motor_fsfb", "economic_dispatch", "fault_location", "gupfc", "induction_dtc", "lsrm_fuzzy",
    "manipulator_adsmc", "optimal_control_mvim", "pv_mppt", "pwa_delay", "rectifier_mpc", "rehab_impedance", "tcp_aqm",
}  # fmt: skip
GENERATED = [p for p in PAGES if "<!-- end -->" in (ROOT / p).read_text()]
WRITE = "run scripts/softrig docs pages {}"


def test_every_system_has_its_page():
    """With claims, scenarios and nodes from the code, and figures from runs."""
    assert {p.stem for p in GENERATED} >= SYSTEMS
    for page in (p for p in GENERATED if p.stem in SYSTEMS):
        text = (ROOT / page).read_text()
        assert all(f"<!-- {part}: " in text for part in ("nodes", "claims", "scenarios", "measured")), page


@pytest.mark.parametrize("page", GENERATED, ids=str)
def test_generated_parts_are_up_to_date(page):
    text = (ROOT / page).read_text()
    assert pages.generate(text) == text, WRITE.format(page)
    assert " | ? | " not in text, WRITE.format(f"--runs {page}")


@pytest.mark.parametrize("page", [Path("README.md"), *PAGES], ids=str)
def test_every_number_of_a_page_has_its_source_and_equals_it(page):
    assert pages.untrue((ROOT / page).read_text(), ROOT / page) == []


@pytest.mark.parametrize("page", [Path("README.md"), *PAGES], ids=str)
def test_rows_of_tables_have_as_many_cells_as_their_head(page):
    head, wrong = 0, []
    for number, line in enumerate((ROOT / page).read_text().splitlines(), 1):
        bars = len(re.findall(r"(?<!\\)\|", line)) if line.startswith("|") else 0
        head = bars if bars and not head else head if bars else 0
        wrong += [f"line {number}: {line}"] if bars != head else []
    assert not wrong, wrong


@pytest.mark.long
@pytest.mark.parametrize("page", [Path("README.md"), *PAGES], ids=str)
def test_published_measurements_are_up_to_date(page):
    text = (ROOT / page).read_text()
    assert pages.generate(text, runs=True) == text, WRITE.format(f"--runs {page}")
    assert pages.untrue(text, ROOT / page, runs=True) == []


def test_pictures_are_plot_entries_drawn_from_a_run(tmp_path, undrawn):
    page = tmp_path / "page.md"
    page.write_text("<!-- picture: dc_motor_smc_b2 2 -->\n<!-- end -->")
    assert pages.main([str(page)]) == 0
    title = load_scenario("dc_motor_smc_b2").plots[1].title
    assert f"![{title}](dc_motor_smc_b2_2.png)" in page.read_text()
    assert [p.name for p in tmp_path.iterdir()] == ["page.md"]  # runs need the option --runs
    assert pages.main(["--runs", str(page)]) == 0
    assert (tmp_path / "dc_motor_smc_b2_2.png").read_bytes().startswith(b"\x89PNG")
    with pytest.raises(ScenarioError, match="picture 9 of dc_motor_smc_b2: expected a plot entry from 1 to 5"):
        pages.generate("<!-- picture: dc_motor_smc_b2 9 -->\n<!-- end -->")


ANIMATIONS = {
    scenario[0]: (p, float(scenario[1]), float(scenario[2]))
    for p in PAGES
    for scenario in pages.ANIMATION.findall((ROOT / p).read_text())
}


# Each daily film shows another kind of plant. A change of the drawing code shows in every film, and golden bags
# detect a change of the run.
DAILY = ("manipulator_adsmc",)


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=() if n.startswith(DAILY) else pytest.mark.long) for n in ANIMATIONS]
)
def test_animations_of_pages_are_as_the_code_draws_them(name, tmp_path):
    page, start, end = ANIMATIONS[name]
    animate(name, start, end, tmp_path)
    held = ROOT / page.parent / f"{name}.svg"
    assert (tmp_path / held.name).read_text() == held.read_text(), WRITE.format(f"--runs {page}")
    assert held.stat().st_size < 2e6


def test_both_robots_the_lsrm_and_the_flux_move_on_their_pages():
    moving = {"manipulator_adsmc", "rehab_impedance", "lsrm_fuzzy", "induction_dtc"}
    assert {page.stem for page, *_ in ANIMATIONS.values()} >= moving


def test_pictures_without_a_plot_entry_are_drawn_beside_their_page(tmp_path, monkeypatch):
    assert {name.removesuffix("_uno") for name in drawn.PAGES} - {"house", "first_run"} < SYSTEMS
    monkeypatch.setattr(rectifier_mpc, "PICTURES", {"current": lambda figure: figure.text(0.5, 0.5, "i")})
    page = tmp_path / "rectifier_mpc.md"
    page.write_text("# Rectifier")
    assert pages.main(["--pictures", str(page)]) == 0
    assert (tmp_path / "rectifier_mpc_current.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.long
@pytest.mark.parametrize("name", drawn.PAGES)
def test_the_pictures_of_a_page_are_drawn_by_its_module(tmp_path, name):
    import_module(f"pages.drawn.{name}").draw(tmp_path)
    (page,) = (ROOT / p for p in PAGES if p.stem == name.removesuffix("_uno"))
    assert {p.name for p in tmp_path.iterdir()} <= set(re.findall(r"\((\w+\.(?:png|svg))\)", page.read_text()))


def test_the_first_picture_moves_for_six_seconds_and_ends_in_a_run_that_repeats():
    """On light and dark background, without external resources, and in a small file."""
    readme = (ROOT / "README.md").read_text()
    picture = ROOT / re.search(r"!\[[^\]]{40,}\]\((\S+)\)", readme)[1]
    text = picture.read_text()
    assert picture.stat().st_size < 300e3
    assert {float(s) for s in re.findall(r'dur="([\d.]+)s"', text)} <= {6.0, 6.05}
    assert "prefers-color-scheme:dark" in text
    assert not re.search(r"(?:href|src|url)\s*[=(]\s*[\"']?(?!#|url)(?:https?:)?//", text)
    assert re.findall(r">([^<]+)</text>", text)[-1].startswith(
        "softrig: repeats rehab_impedance_r5.softrig.zip number for number"
    )


def test_measured_figures_are_those_of_a_run(monkeypatch):
    run = simulate("dc_motor_smc_b2")
    monkeypatch.setattr(pages, "simulate", lambda name: run)
    page = "<!-- measured: rise_time of dc_motor_smc_b2 -->\n<!-- end -->"
    assert pages.generate(page) == page  # runs need the option --runs
    row = pages.generate(page, runs=True).splitlines()[4]
    assert row.split(" | ")[0] == "| `dc_motor_smc_b2`"
    assert float(row.split(" | ")[2].split()[0]) == pytest.approx(run.figures["rise_time"], rel=1e-4)


def test_measured_values_of_claims_stay_until_runs_are_requested(monkeypatch):
    monkeypatch.setattr(pages, "results", lambda name: simulate_once(name).results)
    simulate_once = cache(simulate)
    page = "<!-- claims: dc_motor_smc_b1 -->\n<!-- end -->"
    without = pages.generate(page)
    row = without.splitlines()[7]
    assert row.split(" | ")[3] == "?"
    measured = pages.generate(page, runs=True)
    share = simulate_once("dc_motor_smc_b1").figures["overshoot"]
    assert float(measured.splitlines()[7].split(" | ")[3].split()[0]) == pytest.approx(share, rel=1e-4)
    assert pages.generate(measured) == measured


def test_numbers_without_source_and_wrong_ones_are_reported(tmp_path):
    (tmp_path / "test_here.py").write_text(
        "def test_one():\n    assert 1153 == 2.5\n\n\ndef test_two():\n    assert 7.25\n\n\nTABLE = {1: 7250.0}\n"
    )
    template = """# Motor
It rises in 0.607 s, {} later than 10 V `12.345` in [b](x123.45), in all 1,153 s and 1.005e-4; 347 V; 3.927; 42.1.

    scripts/softrig run 99.999

<!-- numbers
{}
-->
## Next
<!-- measured: rise_time of dc_motor_smc -->

| scenario | | rise time |
|---|---|---|
| `dc_motor_smc` | t | 0.60695 s |

<!-- end -->
"""
    ties = {"0.607": "dc_motor_smc.rise_time", "1,153": "test_here.py::test_one", "1.005e-4": "paper Table 1",
            "347": "1 * rectifier_mpc.v_min", "3.927": "= 5*pi/4", "42.1": "bench gupfc"}  # fmt: skip

    def problems(extra="", run=None, **changed):
        lines = (f"{n}: {s}" for n, s in (ties | changed).items() if s)
        return [
            f.removeprefix("Motor: ") for f in numbers.faults(template.format(extra, "\n".join(lines)), tmp_path, run)
        ]

    assert problems() == []
    assert problems("1.23 s") == ["1.23 has no source"]
    assert problems("0.12 s of 1200") == []  # numbers with few digits need no source
    assert problems("\n```yaml\n# a.yaml\nx: 1.234\n```") == []  # a comment that begins in a code block ends with it
    assert problems(**{"0.607": ""}) == ["0.607 has no source"]  # a measured value still needs a source
    assert problems(**{"3.14": "= pi"}) == ["3.14 is not in this section"]
    assert problems("0.608", **{"0.608": "dc_motor_smc.rise_time"}) == ["0.608: the table has 0.60695"]
    assert problems("0.61", **{"0.61": "dc_motor_smc.rise_time"}) == []
    assert problems(run={"dc_motor_smc": {"rise_time": 0.6}, "rectifier_mpc": {"v_min": 347.4}}.get) == [
        "0.607: a run gives 0.6"
    ]
    assert "expects" in problems("0.350", **{"0.350": "1e-3 * rectifier_mpc.v_min"})[0]
    assert problems("0.347", **{"0.347": "1e-3 * rectifier_mpc.v_min"}) == []
    assert problems(**{"0.607": "dc_motor_smc.rise"}) == ["0.607: dc_motor_smc has no figure rise"]
    assert problems(**{"0.607": "dc_motor.rise_time"}) == ["0.607: no scenario or study dc_motor"]
    assert (
        problems("7.25", **{"7.25": "test_here.py::test_two"})
        == problems("7.25", **{"7.25": "1e-3 * test_here.py::TABLE"})
        == []
    )
    table = "<!-- measured: v_min of rectifier_mpc -->\n\n| `rectifier_mpc` | t | 346.2 V |\n<!-- end -->\n"
    lines = "\n".join(f"{n}: {s}" for n, s in ties.items())
    assert list(numbers.faults(template.format("", lines), tmp_path, None, table)) == [
        "Motor: 347: the table has 346.2"
    ]
    for source in (
        "test_here.py::test_one",
        "test_none.py::test_two",
        "test_here.py",
        "= 7.26",
        "scenario gupfc",
        "paper",
        "somewhere",
    ):
        assert problems("7.25", **{"7.25": source})[0].startswith("7.25: "), source
    assert problems("9.87", rest="bench gupfc") == []
    assert problems("9.87", rest="paper Table 1") == ["'rest' is no number"]
    assert problems("0.0166667 and 1.5", **{"1.5": "scenario gupfc", "0.0166667": "= 1/60"}) == []


def test_the_page_of_names_has_exactly_all_nodes_and_commands():
    assert set(names.NODES) == set(names.blocks())
    assert set(names.VERBS) == VERBS


def test_a_stale_page_is_reported_and_updated(tmp_path, capsys):
    source = next(ROOT / page for page in GENERATED if "| `period` |" in (ROOT / page).read_text())
    (tmp_path / "tests").symlink_to(ROOT / "tests")  # numbers on the page cite tests as their source
    page = tmp_path / "page.md"
    page.write_text(source.read_text().replace("| `period` |", "| `periode` |", 1))
    assert pages.main([str(page), "--check"]) == 1
    assert "is not as the code says" in capsys.readouterr().out
    assert pages.main([str(page)]) == 0
    assert page.read_text() == source.read_text()


def test_every_package_of_a_set_up_is_listed_under_its_licence():
    rows = (ROOT / "ros_pkgs/softrig_bringup/doc/licences.md").read_text().partition("<!-- end -->")[0]
    entries = {
        name: row.split("|")[1].strip()
        for row in rows.splitlines()
        if row.startswith("| ")
        for name in row.split("|")[2].strip().split(", ")
    }
    lock = (ROOT / "scripts/locks/run.lock").read_text()
    # packages installed on every machine
    assert set(re.findall(r"^([\w.-]+)==\S+ \\$", lock, re.M)) <= entries.keys()
    assert entries["casadi"] == "LGPL-3.0-or-later"


@cache
def listed():
    """Verbs, scenarios and studies."""
    return set(make_parser()._subparsers._group_actions[0].choices), set(list_scenarios()), set(list_studies())


@pytest.mark.parametrize("page", [Path("README.md"), *PAGES], ids=str)
def test_commands_and_links_of_a_page_exist(page):
    text = (ROOT / page).read_text()
    verbs, names, studies = listed()
    for verb, remaining in re.findall(r"^    scripts/softrig (\w+)([^#\n]*)", text, re.M):
        assert verb in verbs, verb
        word = remaining.split()[0] if remaining.split() else ""
        if verb == "run" and word != "--like":
            assert word in names, remaining
        if verb == "study":
            assert word in names | studies, remaining
        if verb == "node":
            assert find_executable(*remaining.split()[:2])
    for link in re.findall(r"\]\(([^)\s#]+)\)", text):
        assert link.startswith("http") or (ROOT / page).parent.joinpath(link).exists(), link


@pytest.mark.parametrize("page", [Path("README.md"), *PAGES], ids=str)
def test_links_to_headings_of_a_page_are_valid(page):
    text = (ROOT / page).read_text()
    for target, anchor in re.findall(r"\]\(([^)\s#]*)#([^)\s]+)\)", text):
        if not target.startswith("http"):
            target_text = (ROOT / page).parent.joinpath(target).read_text() if target else text
            headings = [
                re.sub(r"[^\w\- ]", "", h.lower()).replace(" ", "-") for h in re.findall(r"^#+ (.*)", target_text, re.M)
            ]
            assert anchor in headings, anchor


def test_the_worked_example_of_the_scenario_file_runs(tmp_path, monkeypatch):
    text = (ROOT / "ros_pkgs/softrig_bringup/doc/scenario_file.md").read_text()
    example = text[text.index("## From an empty file") : text.index("## Keys")]
    parts = re.findall(r"```yaml\n(.*?)```", example, re.S)
    assert len(parts) == 5
    file = tmp_path / "mine.yaml"
    monkeypatch.chdir(tmp_path)
    for k in range(1, len(parts) + 1):  # the example works after every step
        file.write_text("".join(parts[:k]))
        assert main(["run", "mine.yaml", "--mode", "inprocess", "--no-plots", "--no-record"]) == 0, parts[k - 1]
    monkeypatch.setenv("SOFTRIG_SCENARIOS", str(tmp_path))
    assert simulate("mine_soft").missed == []
    shutil.rmtree(tmp_path / "runs")


def test_every_key_of_the_scenario_file_is_on_its_page():
    from softrig_core import Scenario
    from softrig_core.judge.claims import Claim
    from softrig_core.scenario.scenario import NodeEntry, PlotEntry

    text = (ROOT / "ros_pkgs/softrig_bringup/doc/scenario_file.md").read_text()
    for model in (Scenario, NodeEntry, PlotEntry, Claim):
        for key in model.model_fields:
            assert key == "name" or f"`{key}`" in text or f"`{key}:" in text, key


def test_the_study_of_the_page_is_valid():
    text = (ROOT / "ros_pkgs/softrig_bringup/doc/studies.md").read_text()
    (example,) = re.findall(r"```yaml\n(.*?)```", text, re.S)
    study = make_study({"name": "example", **YAML(typ="safe").load(example)})
    figures_of(rig_of(study.scenario))


def test_the_first_example_in_python_states_its_output():
    text = (ROOT / "README.md").read_text()
    code = next(c for c in re.findall(r"```python\n(.*?)```", text, re.S) if "simulate" in c)
    stated = re.search(r"# ([\d.]+)\.\.\.", code)[1]
    printed = []
    exec(code, {"print": printed.append})
    assert repr(printed[0]).startswith(stated)
