"""Structured text: an independent interpreter runs the printed text, and the result is compared with Python's golden
rows.
"""

import ctypes
import dataclasses
import itertools
import math
import random
import re
from importlib import resources
from xml.etree import ElementTree

import pytest
from hypothesis import given, strategies as st
from softrig_core import ScenarioError, rig_of
from softrig_core.export import st_files
from softrig_core.export.golden import member_of
from softrig_core.export.kinds import remark
from softrig_core.export.st_files import executed, main, st_of, written
from softrig_core.export.st_run import Program

LONG = [("dc_motor_fsfb", "fsfb_controller"), ("induction_dtc", "dtc_controller"), ("lsrm_fuzzy", "speed_controller")]
RULES = [("dc_motor_smc_b2", "dc_motor_smc"), *(pytest.param(*one, marks=pytest.mark.long) for one in LONG)]
TC6 = "{http://www.plcopen.org/xml/tc6_0201}"


def text_of(units, done):
    return written(units, done.name, "st")[f"{done.name}.st"]


@pytest.mark.parametrize(("scenario", "node"), RULES)
def test_the_text_computes_the_numbers_of_python(scenario, node):
    rig = rig_of(scenario)
    units, done = st_of(rig, node, rows=200, drawn=200)
    result = executed(text_of(units, done), done, member_of(rig, node))
    assert result.rows >= 400
    assert (result.differing, result.wrong_status) == (0, 0)


@pytest.fixture(scope="module")
def law():
    rig = rig_of("dc_motor_smc_b2")
    return rig, *st_of(rig, "dc_motor_smc", rows=100, drawn=100)


def test_another_law_and_a_forgotten_status_are_noticed(law):
    rig, units, done = law
    text, member = text_of(units, done), member_of(rig, "dc_motor_smc")
    changes = (" - p_w)", " + p_w)", "differing"), ("discarded := TRUE", "discarded := FALSE", "wrong_status")
    for old, new, what in changes:
        assert old in text
        assert getattr(executed(text.replace(old, new), done, member), what) > 0


def test_names_suit_a_case_insensitive_language(law):
    _, units, done = law
    text = text_of(units, done)
    names = [line.split(" : ")[0].strip() for line in text.splitlines() if " : " in line and " := " not in line]
    assert len(names) > 50
    assert not [n for n in names if "__" in n or n.endswith("_") or n.lower() in ("in", "out", "s", "r", "step")]
    assert {"state_shaft_velocity", "command_armature_effort", "has_reference"} <= set(names)
    assert "(* motor/command/armature/effort, V *)" in text


def test_files_of_twincat_and_plcopen_have_the_same_text(law):
    _, units, done = law
    own = written(units, done.name, "tcpou")
    block = ElementTree.fromstring(own["FB_dc_motor_smc.TcPOU"])
    assert block.find("POU").attrib["Name"] == "FB_dc_motor_smc"
    assert len(own) == len(units)
    body = block.find("POU/Implementation/ST").text
    assert body.strip() == "\n".join(units[-1].body).strip()
    project = ElementTree.fromstring(written(units, done.name, "plcopen")["dc_motor_smc.xml"])
    pous = project.findall(f"{TC6}types/{TC6}pous/{TC6}pou")
    assert [p.attrib["pouType"] for p in pous] == ["function"] * (len(pous) - 1) + ["functionBlock"]
    assert "".join(pous[-1].find(f"{TC6}body/{TC6}ST").itertext()).strip() == body.strip()
    inputs = [v.attrib["name"] for v in pous[-1].findall(f"{TC6}interface/{TC6}inputVars/{TC6}variable")]
    assert inputs[:3] == ["restart", "t_ns", "state_shaft_velocity"]
    assert written(units, done.name, "plcopen") == written(units, done.name, "plcopen")


@pytest.mark.long
def test_blark_reads_the_files_of_twincat(law, tmp_path):
    parse = pytest.importorskip("blark.parse")
    _, units, done = law
    for name, text in written(units, done.name, "tcpou").items():
        (tmp_path / name).write_text(text)
        assert [one.exception for one in parse.parse(tmp_path / name)] == [None]


@pytest.mark.parametrize(
    ("scenario", "node", "words"),
    [
        ("dc_motor_smc_b2", "dc_motor_plant", "for controllers"),
        ("dc_motor_smc_b2", "dc_motor_metrics", "of the type bytes"),
    ],
)
def test_a_construct_without_structured_text_is_refused_with_its_reason(scenario, node, words):
    with pytest.raises(ScenarioError, match=words):
        st_of(rig_of(scenario), node, rows=50, drawn=50)


def test_the_verb_writes_and_checks(tmp_path, capsys):
    assert main(["dc_motor_smc_b2", "dc_motor_smc", "--out", str(tmp_path), "--check"]) == 0
    assert "the numbers of Python" in capsys.readouterr().out
    assert (tmp_path / "dc_motor_smc.st").read_text().count("FUNCTION_BLOCK") == 2


LIBRARY = (resources.files(st_files.__package__) / "softrig.st").read_text()
ODD = [0.0, 0.5, 1.0, 1.5, 2.5, 7.25, 0.9999999999999999, 1e-310, 1e308, 4503599627370497.5, math.inf, math.nan]


@pytest.mark.parametrize("name", ["floor", "ceil", "trunc", "rint", "fmod", "copysign", "hypot", "atan2"])
def test_the_library_has_the_functions_of_c(name):
    own, arity = Program(LIBRARY).scope[f"SR_{name.upper()}"], 1 if name in ("floor", "ceil", "trunc", "rint") else 2
    c = getattr(ctypes.CDLL("libm.so.6"), name)
    c.restype, c.argtypes = ctypes.c_double, [ctypes.c_double] * arity
    draw = random.Random(1)
    rows = list(itertools.product([sign * x for x in ODD for sign in (1.0, -1.0)], repeat=arity))
    rows += [tuple(draw.uniform(-1, 1) * 10.0 ** draw.uniform(-5, 15) for _ in range(arity)) for _ in range(300)]
    for row in rows:
        if name == "fmod" and math.inf > abs(row[0]) > 1e20 * abs(row[1]) > 0.0:
            continue  # the algorithm halves its argument, which takes long for such values
        result, wanted = own(*row), c(*row)
        if math.isnan(wanted):
            assert math.isnan(result), row
        else:
            assert result == pytest.approx(wanted, rel=1e-15, abs=0.0), row
            assert math.copysign(1.0, result) == math.copysign(1.0, wanted), row


BLOCK = """TYPE PAIR :
STRUCT
    a : LREAL;
    row : ARRAY [0..2] OF LINT;
END_STRUCT
END_TYPE
FUNCTION FILL : BOOL
VAR_IN_OUT
    whole : PAIR;
END_VAR
VAR_INPUT
    own : PAIR;
    p : POINTER TO LINT;
END_VAR
    whole.a := own.a;
    own.a := 7.0;
    p[1] := -7 / 2;
    p[2] := -7 MOD 2;
    RETURN;
    p[0] := 9;
END_FUNCTION
FUNCTION_BLOCK FB
VAR
    x : PAIR;
    y : PAIR;
    k : LINT := 3;
    ok : BOOL;
    q : LREAL;
END_VAR
    y.a := 2.0;
    x := y;
    y.a := 5.0;
    ok := FILL(whole := x, own := y, p := ADR(x.row));
    WHILE TRUE DO
        k := k - 1;
        IF (k = 1) AND NOT FALSE THEN
            EXIT;
        ELSIF k <> 2 THEN
            k := 100;
        END_IF
    END_WHILE
    q := -1.0 / 0.0;
END_FUNCTION_BLOCK
"""


def test_the_interpreter_follows_the_rules_of_the_language():
    program = Program(BLOCK)
    block = program.block()
    program.call(block)
    assert (block.x.a, block.y.a) == (5.0, 5.0)  # inputs by reference change, those by value do not
    assert block.x.row == [0, -3, -1]
    assert block.y.row == [0, 0, 0]
    assert (block.k, block.ok, block.q) == (1, False, -math.inf)
    with pytest.raises(ValueError, match="is not a statement"):
        Program(BLOCK.replace("q := -1.0 / 0.0;", "q := 1.0"))


EVIL = "*/ #error \"x\" /* \\ ??/\n#error '*//*' **/ ]]> *) (* (*) ???/ \x1b[31m \u202e {0} %s //\\"


def bare(text, begin, end):
    """Return a text without its comments, which end at the first end mark: they are not nested."""
    return re.sub(f"{re.escape(begin)}.*?{re.escape(end)}", "", text, flags=re.DOTALL)


def test_texts_of_a_user_stay_comments(law, monkeypatch):
    """A docstring, a topic or a unit that ended its comment would be code for anyone who compiles the export."""
    rig, units, done = law
    member = member_of(rig, "dc_motor_smc")
    monkeypatch.setattr(member.block_class, "__doc__", EVIL)
    outputs = [dataclasses.replace(p, topic=EVIL, units=(EVIL,) * p.size, limits=p.limits) for p in member.outputs]
    monkeypatch.setattr(st_files, "member_of", lambda *_: dataclasses.replace(member, outputs=tuple(outputs)))
    again, other = st_of(rig, "dc_motor_smc", rows=1, drawn=1)
    header = f"{done.name}.h"
    plain, evil = (re.sub(r'DIGEST "\w+"', "", bare(one.files[header], "/*", "*/")) for one in (done, other))
    assert (plain, "#error" in other.files[header]) == (evil, True)
    assert bare(text_of(again, other), "(*", "*)") == bare(text_of(units, done), "(*", "*)")
    for text in written(again, other.name, "tcpou").values():
        ElementTree.fromstring(text)


@given(st.text("*/()?\\ \n\x1b\u202ea"))
def test_no_remark_ends_its_comment(text):
    result = remark(text)
    assert not [pair for pair in ("*/", "/*", "*)", "(*", "??", "\\\n") if pair in f"{result}\n"]
    assert result.isprintable()
    letters = re.sub(r"[ \n\x1b\u202e]", "", text)
    assert result.replace(" ", "") == letters.rstrip("\\")


def test_an_index_before_a_comparison_does_not_end_the_data_of_twincat():
    line = "IF x[y[0]]>3 THEN"
    assert ElementTree.fromstring(f"<a><![CDATA[{st_files._data(line)}]]></a>").text == line
