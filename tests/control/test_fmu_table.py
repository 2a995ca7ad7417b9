"""Each item of modelDescription.xml and what softrig does with it: real files, read by FMPy; nothing is run."""

import re
import zipfile

import pytest

fmpy = pytest.importorskip("fmpy")
# ruff: noqa: E402
from softrig_control.fmu.description import conversion, describe
from softrig_control.fmu.mapping import mapped, start_values
from softrig_control.fmu.table import FMI
from softrig_core import ScenarioError

TWO = """<fmiModelDescription fmiVersion="2.0" modelName="m" guid="{g}">
<CoSimulation modelIdentifier="m" canGetAndSetFMUstate="true"/>
<UnitDefinitions><Unit name="degC"><BaseUnit K="1" offset="273.15"/><DisplayUnit name="degF" factor="1.8"/></Unit>
<Unit name="K"><BaseUnit K="1"/></Unit></UnitDefinitions>
<TypeDefinitions>
<SimpleType name="Difference"><Real unit="degC" relativeQuantity="true" min="-5" max="5"/></SimpleType>
<SimpleType name="Count"><Integer min="1" max="9"/></SimpleType>
<SimpleType name="Mode"><Enumeration><Item name="slow" value="1"/><Item name="fast" value="3"/></Enumeration>
</SimpleType>
</TypeDefinitions>
<DefaultExperiment startTime="0" stopTime="1"/>
<ModelVariables>
<ScalarVariable name="T" valueReference="0" causality="input"><Real unit="degC" start="20"/></ScalarVariable>
<ScalarVariable name="dT" valueReference="1" causality="input"><Real unit="degC" relativeQuantity="true" start="2"/>
</ScalarVariable>
<ScalarVariable name="declared" valueReference="2" causality="parameter" variability="tunable">
<Real declaredType="Difference" start="1"/></ScalarVariable>
<ScalarVariable name="own" valueReference="3" causality="parameter" variability="fixed">
<Real declaredType="Difference" max="9" relativeQuantity="false" start="1"/></ScalarVariable>
<ScalarVariable name="n" valueReference="4" causality="parameter" variability="fixed">
<Integer declaredType="Count" start="2"/></ScalarVariable>
<ScalarVariable name="mode" valueReference="5" causality="parameter" variability="fixed">
<Enumeration declaredType="Mode" start="1"/></ScalarVariable>
<ScalarVariable name="c" valueReference="6" causality="local" variability="constant"><Real start="3"/></ScalarVariable>
</ModelVariables><ModelStructure/></fmiModelDescription>"""
THREE = """<fmiModelDescription fmiVersion="3.0" modelName="m" instantiationToken="{g}">
<CoSimulation modelIdentifier="m"/>
<UnitDefinitions><Unit name="degC"><BaseUnit K="1" offset="273.15"/></Unit><Unit name="K"><BaseUnit K="1"/></Unit>
</UnitDefinitions>
<TypeDefinitions><Float64Type name="Difference" unit="degC" relativeQuantity="true" min="-5" max="5"/>
<Int32Type name="Count" min="1" max="9"/>
<EnumerationType name="Mode"><Item name="slow" value="1"/><Item name="fast" value="3"/></EnumerationType>
</TypeDefinitions>
<ModelVariables>
<Float64 name="T" valueReference="0" causality="input" unit="degC" start="20"><Alias name="other"/></Float64>
<Float64 name="dT" valueReference="1" causality="input" unit="degC" relativeQuantity="true" start="2"/>
<Float64 name="declared" valueReference="2" causality="parameter" variability="tunable" declaredType="Difference"
start="1"/>
<Float64 name="own" valueReference="3" causality="parameter" variability="fixed" declaredType="Difference" max="9"
relativeQuantity="false" start="1"/>
<Int32 name="n" valueReference="4" causality="parameter" variability="fixed" declaredType="Count" start="2"/>
<Enumeration name="mode" valueReference="5" causality="parameter" variability="fixed" declaredType="Mode" start="1"/>
<Float64 name="c" valueReference="6" causality="local" variability="constant" start="3"/>
<UInt8 name="small" valueReference="7" causality="parameter" variability="fixed" min="2" max="4" start="3"/>
<Clock name="tick" valueReference="8" causality="input" variability="discrete" intervalVariability="constant"
intervalDecimal="1"/>
</ModelVariables><ModelStructure/></fmiModelDescription>"""


@pytest.fixture(params=[TWO, THREE], ids=["2.0", "3.0"])
def prepared_unit(request):
    return request.param


def fmu(folder, text):
    path = folder / "m.fmu"
    place = fmpy.platform if 'fmiVersion="2.0"' in text else fmpy.platform_tuple
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", text)
        archive.writestr(f"binaries/{place}/m.so", b"")
    return describe(str(path))


def test_the_offset_of_a_unit_does_not_apply_to_a_difference(tmp_path, prepared_unit):
    """20 degC are 293.15 K; a difference of 2 degC is one of 2 K."""
    unit = fmu(tmp_path, prepared_unit)
    assert conversion(unit.variable("T"), "K") == (1.0, 273.15)
    assert conversion(unit.variable("dT"), "K") == (1.0, 0.0)
    assert conversion(unit.variable("declared"), "K") == (1.0, 0.0)  # its declared type has relativeQuantity set
    assert conversion(unit.variable("own"), "K") == (1.0, 273.15)  # the variable itself overrides its type
    ports, places = mapped(unit, ["a/b/position [K] = T", "a/c/position [K] = dT"], False)
    assert ports[0].safe == (293.15, 2.0)
    assert (places[1].into(3.0), places[0].into(300.15)) == (3.0, pytest.approx(27.0))


@pytest.mark.parametrize(
    ("entry", "value"),
    [("declared = 5", 5.0), ("own = 9", 9.0), ("n = 9", 9), ("mode = 3", 3), ("mode = fast", 3), ("mode = slow", 1)],
)
def test_values_within_the_bounds_of_a_variable_or_its_type(tmp_path, prepared_unit, entry, value):
    assert [result for _, result in start_values(fmu(tmp_path, prepared_unit), [entry])] == [value]


@pytest.mark.parametrize(
    ("entry", "why"),
    [
        ("declared = 5.1", "expected -5 to 5"),
        ("own = -5.1", "expected -5 to 9"),
        ("own = 9.1", "expected -5 to 9"),
        ("n = 0", "expected 1 to 9"),
        ("mode = 2", r"expected one of slow \(1\), fast \(3\)"),
        ("mode = quick", r"expected one of slow \(1\), fast \(3\)"),
        ("c = 4", "c is constant of m.fmu, it cannot be set"),
    ],
)
def test_values_outside_are_refused(tmp_path, prepared_unit, entry, why):
    with pytest.raises(ValueError, match=why):
        start_values(fmu(tmp_path, prepared_unit), [entry])


def test_bounds_of_unsigned_numbers_are_checked(tmp_path):
    """FMPy drops them."""
    with pytest.raises(ValueError, match="expected 2 to 4"):
        start_values(fmu(tmp_path, THREE), ["small = 5"])


def test_an_alias_is_a_name_of_its_variable(tmp_path):
    unit = fmu(tmp_path, THREE)
    assert unit.variable("other").reference == unit.variable("T").reference


@pytest.mark.parametrize(
    ("old", "new", "why"),
    [
        ("relativeQuantity", "relativQuantity", r"@relativQuantity is not part of .*@relativeQuantity'"),
        ("UnitDefinitions", "UnitDefinition", "UnitDefinition is not part of .*'UnitDefinitions'"),
        ("<ModelStructure/>", "<ModelStructure/><Rest/>", "Rest is not part of modelDescription.xml"),
    ],
)
def test_items_outside_the_standard_are_refused(tmp_path, prepared_unit, old, new, why):
    with pytest.raises(ScenarioError, match=why):
        fmu(tmp_path, prepared_unit.replace(old, new))


def test_items_without_effect_are_reported(tmp_path):
    assert fmu(tmp_path, TWO).notes == ()
    (note,) = fmu(tmp_path, TWO.replace('startTime="0"', 'startTime="3"')).notes
    assert note == "m.fmu: DefaultExperiment@startTime is ignored: a rig and its FMU begin at 0 s"
    text = THREE.replace('name="T"', 'name="T" clocks="8"')
    assert [n for n in fmu(tmp_path, text).notes if "clocks is ignored" in n]


def test_the_table_refuses_no_names_that_files_of_the_standard_use():
    assert {use for use, _ in FMI.table.values()} == {"used", "ignored"}


@pytest.mark.parametrize(
    ("model", "old", "new", "text"),
    [
        (TWO, 'name="dT"', 'name="T"', "m.fmu: two variables are called 'T'"),
        (TWO, '<Unit name="K">', '<Unit name="degC">', "m.fmu: two units are called 'degC'"),
        (TWO, 'start="20"', 'start="20,5"', "m.fmu: variable 'T': start = '20,5', expected a number"),
        (TWO, 'start="20"', 'start="1_000"', "m.fmu: variable 'T': start = '1_000', expected a number"),
        (TWO, 'start="20"', 'start="NaN"', "m.fmu: variable 'T': start = 'NaN', expected a number"),
        (TWO, 'start="20"', 'start="1 2"', "m.fmu: variable 'T': 2 start values, expected one or 1"),
        (TWO, 'max="9" rel', 'max="nine" rel', "m.fmu: variable 'own': max = 'nine', expected a number"),
        (TWO, 'start="2"/></ScalarV', 'start="2.5"/></ScalarV', "m.fmu: variable 'n': start = '2.5', expected a whole"),
        (TWO, 'offset="273.15"', 'offset="nan"', "m.fmu: unit 'degC': offset = 'nan', expected a number"),
        (TWO, 'offset="273.15"', 'offset="x"', "cannot be read as an FMU: ValueError: could not convert"),
        (TWO, 'offset="273.15"', 'factor="0"', "m.fmu: unit 'degC': factor 0 and offset 0, expected a factor above 0"),
        (TWO, 'min="-5" max="5"', 'min="5" max="-5"', "m.fmu: variable 'declared': min = 5 is above max = -5"),
        (THREE, '<Alias name="other"/>', '<Dimension start="0"/>', "an array of 0 values, expected 1 to 10000"),
        (THREE, '<Alias name="other"/>', '<Dimension start="99999999"/>', "an array of 99999999 values, expected 1 to"),
        (
            THREE,
            'start="20"><Alias name="other"/>',
            'start="1 2"><Dimension start="3"/>',
            "2 start values, expected one",
        ),
        (THREE, 'name="dT"', 'name="T"', "m.fmu: two variables are called 'T'"),
    ],
    ids=lambda part: "" if "\n" in part else part[:30],
)
def test_a_description_that_contradicts_itself_is_refused_by_name(tmp_path, model, old, new, text):
    """Duplicates, invalid numbers, factors of zero: tools export them, and each would give a wrong number."""
    assert old in model
    with pytest.raises(ValueError, match=re.escape(text)):
        fmu(tmp_path, model.replace(old, new, 1))


def test_a_unit_with_a_different_meaning_here_must_be_declared(tmp_path):
    """An FMU may call minutes m: 2 of them are 120 s, and never 2 metres."""
    minutes = '<Unit name="m"><BaseUnit s="1" factor="60"/></Unit>'
    text = TWO.replace('<Unit name="K">', minutes + '<Unit name="K">').replace('unit="degC" start="20"', 'unit="m"')
    result = fmu(tmp_path, text)
    with pytest.raises(ValueError, match=r"T is in 'm', which the FMU defines as 60 s and softrig does not"):
        mapped(result, ["clock/a/position = T"], False)
    with pytest.raises(ValueError, match="another quantity"):
        mapped(result, ["clock/a/position [m] = T"], False)
    (place,) = mapped(result, ["clock/a/position [s] = T"], False).places
    assert place.into(120.0) == 2.0


def test_the_size_of_an_array_cannot_be_set(tmp_path):
    """Its values are counted before the FMU runs."""
    size = '<UInt64 name="size" valueReference="9" causality="structuralParameter" variability="fixed" start="2"/>'
    result = fmu(tmp_path, THREE.replace("<Clock", size + "<Clock"))
    with pytest.raises(ValueError, match=r"size is structuralParameter of m\.fmu, it cannot be set"):
        start_values(result, ["size = 3"])


def test_an_fmu_that_is_unpacked_or_packed_with_its_folder_is_refused_with_how_to_pack_it(tmp_path):
    (tmp_path / "modelDescription.xml").write_text(TWO)
    with pytest.raises(ValueError, match=r"is an unpacked FMU, expected the file: `cd .* && zip -r"):
        describe(str(tmp_path))
    with zipfile.ZipFile(tmp_path / "m.fmu", "w") as archive:
        archive.writestr("m/modelDescription.xml", TWO)
    with pytest.raises(ValueError, match=r"as m/modelDescription\.xml; zip the content of that folder"):
        describe(str(tmp_path / "m.fmu"))


def test_a_start_value_that_no_message_can_carry_is_refused(tmp_path):
    result = fmu(tmp_path, TWO.replace('start="20"', 'start="INF"'))
    with pytest.raises(ValueError, match="T starts at inf, which no message carries"):
        mapped(result, ["a/b/position = T"], False)
