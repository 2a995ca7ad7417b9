"""The pages of the systems have one order of headings, begin with three sentences and a picture, and typeset
formulas.
"""

import re

import pytest
from docs.outline import SYSTEMS, pages
from docutils.utils.math.latex2mathml import tex2mathml
from softrig_core import list_scenarios
from softrig_core.run.expand import rig_of

ORDER = ["Try it", "The model", "Corrections of the paper", "Published and measured", "What you can change and see",
         "Speed", "References"]  # fmt: skip
LONG = 30  # rows; a longer table is folded
_FENCED = re.compile(r"^```.*?^```$", re.S | re.M)
_COMMENT = re.compile(r"<!--.*?-->", re.S)


def _parsed(value):
    return float(value) if re.fullmatch(r"[+-]?\d+(\.\d*)?", value) else value


def parts(name):
    """Text of a page by heading; the text before the first heading has an empty name."""
    text = pages()[name].read_text()
    bare = _FENCED.sub(lambda m: re.sub("^#", " ", m[0], flags=re.M), text)
    result = re.split(r"^## (.+)\n", bare, flags=re.M)
    return {"": result[0]} | dict(zip(result[1::2], result[2::2], strict=True))


@pytest.mark.parametrize("name", SYSTEMS)
def test_a_page_has_its_parts_in_their_order(name):
    result = parts(name)
    assert list(result)[1:] == ORDER
    lead, trying, model, corrected, measured, changing, speed, sources = result.values()
    assert re.search(r"^!\[.+\]\(\w+\.(png|svg|gif|webp)\)$", lead, re.M)
    prose = " ".join(_COMMENT.sub("", re.sub(r"^[#!].*$", "", lead, flags=re.M)).split())
    assert len(re.findall(r"[.!?](?= [A-Z]|$)", prose)) in range(3, 9), prose
    (command,) = re.findall(r"\A\n    (.+)\n\n", trying)
    scenario = re.fullmatch(r"scripts/softrig run (\w+) --mode inprocess(?: +# .+)?", command)
    assert scenario, command
    assert scenario[1] in list_scenarios()
    assert "```math" in model
    assert re.search(r"^(- |\| )", corrected, re.M)
    assert "<!-- claims: " in measured
    assert "<!-- measured: " in measured
    assert "<!-- scenarios: " in changing
    assert "<!-- nodes: " in changing
    assert re.search(r"\d (s|ms|us)\b", speed)
    assert "<!-- sources: " in sources


def test_parameters_that_a_page_proposes_can_be_set():
    tried = []
    for name in SYSTEMS:
        result = parts(name)
        scenario = re.search(r"softrig run (\w+)", result["Try it"])[1]
        for key, value in re.findall(r"`--set ([\w.]+)=([\w.+-]+)`", result["What you can change and see"]):
            if value != "...":
                rig = rig_of(scenario, overrides={key: _parsed(value)})
                tried.append((rig.scenario.name, key))
    assert len(tried) > len(SYSTEMS) / 2, tried


@pytest.mark.parametrize("name", sorted(name for name, page in pages().items() if page.suffix == ".md"))
def test_formulas_can_be_typeset_and_long_tables_fold(name):
    text = _COMMENT.sub("", pages()[name].read_text())
    for formula in re.findall(r"^```math\n(.*?)^```$", text, re.S | re.M):
        tex2mathml(formula, as_block=True)
    for formula in re.findall(r"\$`([^`]+)`\$", text):
        tex2mathml(formula, as_block=False)
    open_ = re.sub(r"^<details>.*?^</details>$", "", text, flags=re.S | re.M)
    for table in re.findall(r"(?:^\|.*\n)+", open_, re.M):
        assert table.count("\n") - 2 < LONG, table.splitlines()[0]
    assert text.count("<details>\n<summary>") == text.count("</details>\n") == text.count("<details>")
