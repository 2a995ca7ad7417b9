"""What an FMU declares and how softrig uses it: artificial descriptions, each answer and refusal as text."""

import sys
import zipfile
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest
from expected_text import check_expected
from softrig_control.fmu import description
from softrig_control.fmu.description import Description, Unit, Variable, conversion, describe, unpacked
from softrig_control.fmu.mapping import mapped, start_values
from softrig_control.fmu.nodes import _cell, _values
from softrig_core import ParameterError

BASES = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")


def base(factor=1.0, offset=0.0, **powers):
    return SimpleNamespace(factor=factor, offset=offset, **(dict.fromkeys(BASES, 0) | powers))


UNITS = {
    "N.m": base(kg=1, m=2, s=-2),
    "degC": base(K=1, offset=273.15),
    "rpm": base(rad=1, s=-1, factor=0.10471975511965977),
    "torque": base(kg=1, m=2, s=-2),
    "hour": base(s=1, factor=3600.0),
    "V": None,
    "N.m/rad2": None,
}


def scalar(name, kind="Real", causality="output", **about):
    plain = {
        "name": name,
        "valueReference": 0,
        "type": kind,
        "causality": causality,
        "variability": "continuous",
        "unit": None,
        "declaredType": None,
        "dimensions": (),
        "start": None,
        "min": None,
        "max": None,
    }
    return SimpleNamespace(**plain | about)


def sized(*sizes):
    return [SimpleNamespace(start=str(n), variable=None) for n in sizes]


def variables(three):
    real, whole = ("Float64", "Int32") if three else ("Real", "Integer")
    values = [
        scalar("u", real, "input", unit="V", start="1.5", min="-2", max="2"),
        scalar("w", real, unit="rpm"),
        scalar("torque", real, declaredType=SimpleNamespace(unit="torque"), unit=None),
        scalar("heat", real, "local", unit="degC", declaredType=SimpleNamespace(unit="V")),
        scalar("stiff", real, "parameter", unit="N.m/rad2", variability="tunable", start="3", min="0"),
        scalar("n", whole, "input", start="2", max="9"),
        scalar("on", "Boolean", "input", start="true"),
        scalar("mode", "Enumeration", "parameter", variability="fixed", start="1"),
        scalar("label", "String", "parameter", start="a b", min="0"),
        scalar("sum", real, "calculatedParameter"),
        scalar("time", real, "independent", unit="furlong"),
    ]
    if three:
        values += [
            scalar("A", real, "input", dimensions=sized(2, 3), start=["1", "2", "3", "4", "5", "6"], unit="hour"),
            scalar(
                "B", "UInt8", dimensions=[SimpleNamespace(start=None, variable=SimpleNamespace(start="2"))], start="7"
            ),
            scalar("tick", "Clock"),
            scalar("odd[1]", "Float32"),
        ]
    for k, one in enumerate(values):
        one.valueReference = 10 + k
    return values


@pytest.fixture
def fmu(monkeypatch, tmp_path):
    """Write an FMU with an artificial description that FMPy reads; return its file."""

    def make(version="2.0", name="made", files=("binaries/here/m.so",), **about):
        three = version.startswith("3")
        flags = SimpleNamespace(canGetAndSetFMUstate=True, canSerializeFMUstate=True)
        plain = {
            "fmiVersion": version,
            "coSimulation": flags,
            "modelExchange": None,
            "scheduledExecution": None,
            "unitDefinitions": [SimpleNamespace(name=k, baseUnit=v) for k, v in UNITS.items()],
            "modelVariables": variables(three),
        }
        fmpy = ModuleType("fmpy")
        fmpy.__spec__ = ModuleSpec("fmpy", None)
        fmpy.platform, fmpy.platform_tuple = ("there", "here") if three else ("here", "there")
        fmpy.read_model_description = lambda file, validate: SimpleNamespace(**plain | about)
        monkeypatch.setitem(sys.modules, "fmpy", fmpy)
        path = tmp_path / f"{name}.fmu"
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("modelDescription.xml", f"<fmiModelDescription fmiVersion = '{version}' />")
            for file in files:
                archive.writestr(file, b"0123456789")
        return path

    return make


def unit_words(unit):
    if unit is None:
        return "no unit"
    parts = " ".join(f"{n}^{p}" for n, p in unit.base)
    return f"{unit.name!r} = {unit.factor:.6g} x + {unit.offset:g} in {parts or '1'}"


def variable_words(v):
    size = f", {' x '.join(map(str, v.dims))} = {v.count} values" if v.dims else ""
    start = f"start {v.start!r}, {v.least} to {v.largest}"
    return f"{v.name} ({v.reference}): {v.kind or 'none'} {v.causality}{' tunable' * v.tunable}, {start}, " + (
        unit_words(v.unit) + size
    )


def port_words(port):
    kind, frame = port.msgtype.rpartition("/")[2], f" in {port.frame_id}" if port.frame_id else ""
    values = zip(port.labels, port.units, port.safe, strict=True)
    labels = ", ".join(f"{label} [{unit}] {safe:g}" for label, unit, safe in values)
    return f"{port.name}: {kind} on {port.topic}{frame}: {labels}"


def answers(result, entries, outward, **more):
    """One side of an FMU, or the reason why there is none."""
    yield f"  {'says' if outward else 'reads'} {'; '.join(entries)}{''.join(f', {k} {v}' for k, v in more.items())}"
    try:
        ports, places = mapped(result, entries, outward, **more)
    except ValueError as error:
        yield f"    refused: {error}"
        return
    yield from (f"    {port_words(port)}" for port in ports)
    for place in places:
        cell = " ".join(map(str, _cell(place.variable)))
        yield (
            f"    {place.variable.name} ({cell}) at {place.port}, {place.at}: 5 is {place.out(5.0):.6g} there, "
            f"5 there is {place.into(5.0):.6g}"
        )


ENTRIES = [
    (False, ("motor/command/arm/effort = u", " motor/command/rest/effort [mV]= n", "on/off/position=on")),
    (True, ("s/shaft/velocity = w", "s/shaft/effort = torque", "heat/now/position [K] = heat", "k/a/effort = stiff")),
    (True, ("s/shaft/velocity [rad/s] = w", "a/b/c/effort [mN m] = torque", "m/m/position = mode")),
    (True, ("v/x/vector = w", "v/z/vector [mN m] = torque"), {"frames": {"v": "base"}}),
    (True, ("v/x/vector [rad/s] = w", "v/w/vector = torque"), {"frames": {"v": "base"}}),
    (False, ("r/a/velocity = u", "r/b/position = n"), {"trajectories": ("r",)}),
    (True, ("r/a/acceleration = w", "r/b/acceleration = heat"), {"trajectories": ("r",)}),
    (False, ("r/a/effort = u",), {"trajectories": ("r",)}),
    (False, ("r/a/acceleration = u",)),
    (False, ("v/x/vector = u",)),
    (False, ("v/x/position = u",), {"frames": {"v": "base"}}),
    (False, ("v/q/vector = u",), {"frames": {"v": "base"}}),
    (False, ("a/b/effort = u",), {"trajectories": ("no topic",)}),
    (False, ("a/b/effort = u",), {"frames": {"": "base"}}),
    (True, ("a/b/effort = w", "a/c/velocity = heat")),
    (False, ("a/b/effort = u", "a/c/velocity = n")),
    (False, ("a/b/effort = u", "a/b/effort = n")),
    (False, ("a/b/effort = u", "a/b/velocity = u")),
    (True, ("a/b/effort = w", "a/b/velocity = w")),
    (False, ("a/b/effort = w",)),
    (True, ("a/b/effort = u",)),
    (True, ("a/b/effort = label",)),
    (True, ("a/b/effort [A] = torque",)),
    (True, ("a/b/push = w",)),
    (True, ("a/effort = w",)),
    (True, ("a/b/effort w",)),
    (True, ("a/b/effort = torqe",)),
    (True, ("a/b/effort = w[1]",)),
]
ARRAYS = [
    (False, ("a/b/effort = A[2,1]", "a/c/effort [min] = A[1,3]", "a/d/effort = u")),
    (True, ("a/b/effort = B[2]", "a/c/effort = odd[1]")),
    *((False, (f"a/b/effort = {name}",)) for name in ("A", "A[1]", "A[0,1]", "A[3,1]", "A[2,4]", "A[1,1,1]")),
    (True, ("a/b/effort = tick",)),
    (True, ("a/b/effort = C[1]",)),
]
STARTS = [
    ("u = 0.5", "stiff=7", "n = 3", "on = False", "mode = 2", "label = it = x", "heat = -1e3"),
    ("on = 1",),
    ("on = TRUE",),
    ("on = 2",),
    ("n = 2.5",),
    ("n = 9",),
    ("n = 10",),
    ("u = -2",),
    ("u = 2.01",),
    ("heat = inf",),
    ("heat = nan",),
    ("heat = warm",),
    ("heat",),
    ("sum = 1",),
    ("time = 1",),
    ("u = 1", "u = 1"),
    ("nothing = 1",),
]


def description_lines(fmu):
    for version in ("2.0", "3.0"):
        result = describe(str(fmu(version, f"made{version[0]}")))
        state = "keeps" if result.serialises else "does not keep"
        yield f"FMI {result.version}: {', '.join(result.interfaces)}, {state} its state"
        yield from (f"  {variable_words(v)}" for v in result.variables.values())
        for outward, entries, *more in ENTRIES if version == "2.0" else ARRAYS:
            yield from answers(result, entries, outward, **(more[0] if more else {}))
        for entries in (
            STARTS if version == "2.0" else [("A[1,2] = 20", "A[2,3] = 60", "u = 1"), ("A = 1",), ("B[2] = 9",)]
        ):
            yield f"  starts {'; '.join(entries)}"
            try:
                start = start_values(result, entries)
            except ValueError as error:
                yield f"    refused: {error}"
                continue
            yield from (f"    {kind} {reference}: {values}" for kind, reference, values in _values(start))
            yield from (f"    alone: {row}" for row in _values(start, {21}) if version == "3.0")


def test_a_description_and_its_interpretation_are_as_expected(fmu):
    check_expected("fmu/description", description_lines(fmu))


@pytest.mark.parametrize(
    ("about", "interfaces", "serialises"),
    [
        ({}, ("co_simulation",), True),
        ({"coSimulation": None}, (), False),
        (
            {
                "coSimulation": None,
                "modelExchange": SimpleNamespace(canGetAndSetFMUstate=True, canSerializeFMUstate=True),
            },
            ("model_exchange",),
            True,
        ),
        (
            {"modelExchange": SimpleNamespace(), "scheduledExecution": SimpleNamespace()},
            ("co_simulation", "model_exchange", "scheduled_execution"),
            True,
        ),
        (
            {"coSimulation": SimpleNamespace(canGetAndSetFMUstate=True, canSerializeFMUstate=False)},
            ("co_simulation",),
            False,
        ),
        (
            {"coSimulation": SimpleNamespace(canGetAndSetFMUstate=False, canSerializeFMUstate=True)},
            ("co_simulation",),
            False,
        ),
    ],
)
def test_interfaces_and_whether_a_state_can_be_saved_are_read(fmu, about, interfaces, serialises):
    result = describe(str(fmu(**about)))
    assert (result.interfaces, result.serialises) == (interfaces, serialises)


@pytest.mark.parametrize(
    ("version", "files", "text"),
    [
        (
            "2.0",
            ("binaries/win64/m.dll", "binaries/there/m.so", "sources/here/m.c"),
            "made.fmu has no binary for this machine, here; it has there, win64",
        ),
        ("3.0", ("binaries/there",), "made.fmu has no binary for this machine, here; it has none"),
        ("1.0", ("binaries/here/m.so",), "made.fmu is of FMI 1.0, expected 2.0 or 3.0"),
        ("2.1", ("binaries/here/m.so",), "made.fmu is of FMI 2.1, expected 2.0 or 3.0"),
        ("3.1", ("binaries/here/m.so",), "made.fmu is of FMI 3.1, expected 2.0 or 3.0"),
        ("3.0-beta.1", ("binaries/here/m.so",), ""),
        ("2.0", ("binaries/here/m.so", "a/" * 49 + "b"), ""),
        ("2.0", ("binaries/here/m.so", "a/" * 50 + "b"), "is 51 folders deep, expected at most 50"),
        ("2.0", ("a\\b",), "is not a path inside it"),
        ("2.0", ("c:b",), "'c:b' is not a path inside it"),
        ("2.0", ("/b",), "'/b' is not a path inside it"),
        ("2.0", ("a/../b",), "'a/../b' is not a path inside it"),
        ("2.0", ("a..b/c", "binaries/here/m.so"), ""),
    ],
)
def test_unusable_files_are_refused(fmu, version, files, text):
    path = fmu(version, files=files)
    if not text:
        assert describe(str(path)).version == version
        return
    with pytest.raises(ValueError, match=r"made\.fmu") as refused:
        describe(str(path))
    assert text in str(refused.value)


def test_an_fmu_is_unpacked_once_and_refused_beyond_its_limits(fmu, tmp_path, monkeypatch):
    monkeypatch.setattr(description, "cache_folder", lambda: tmp_path / "cache")
    path = fmu()
    with zipfile.ZipFile(path) as archive:
        size = sum(entry.file_size for entry in archive.infolist())
    monkeypatch.setattr(description, "LARGEST", size)
    folder = unpacked(path)
    assert folder.parent == tmp_path / "cache" / "fmu"
    assert len(folder.name) == 32
    assert (folder / "binaries/here/m.so").read_bytes() == b"0123456789"
    assert [*folder.parent.iterdir()] == [folder]
    (folder / "kept").touch()
    assert unpacked(path) == folder
    assert (folder / "kept").exists()
    (other := Path(tmp_path, "other.fmu")).write_bytes(fmu(name="another").read_bytes() + b"\0")
    monkeypatch.setattr(description, "LARGEST", size - 1)
    with pytest.raises(
        ParameterError, match=r"^parameter fmu = '.*other\.fmu' cannot be unpacked: 0 MB of content, exp"
    ):
        unpacked(other)
    (torn := tmp_path / "torn.fmu").write_bytes(b"PK")
    with pytest.raises(ParameterError, match=r"torn\.fmu' cannot be unpacked: File is not a zip file"):
        unpacked(torn)
    assert [*folder.parent.iterdir()] == [folder]


def test_an_array_has_a_start_value_for_each_element_or_one_for_all():
    def starts(kind, start, dims=(3,)):
        return Variable("x", 0, kind, "input", start, None, None, None, False, dims).starts()

    assert starts("Float64", "1 2.5 3") == [1.0, 2.5, 3.0]
    assert starts("Float32", None) == [0.0] * 3
    assert [starts("Int8", "4"), starts("Int8", "4", ())] == [[4] * 3, [4]]
    assert starts("Boolean", "true 1 false") == [True, True, False]
    assert [type(x) for x in starts("Real", "1") + starts("Integer", "1")] == [float] * 3 + [int] * 3


def test_units_are_converted_by_factor_and_offset():
    def variable(unit):
        return Variable("x", 0, "Real", "output", None, None, None, unit)

    celsius = Unit("degC", 1.0, 273.15, (("K", 1),))
    fahrenheit = Unit("degF", 5 / 9, 459.67 * 5 / 9, (("K", 1),))
    assert conversion(variable(fahrenheit), "K") == pytest.approx((5 / 9, 459.67 * 5 / 9))
    assert conversion(variable(celsius), "mK") == pytest.approx((1e3, 273.15e3))
    for wanted in ("", "degC"):
        assert conversion(variable(celsius), wanted) == (1.0, 0.0)
    assert conversion(variable(None), "V") == (1.0, 0.0)
    assert conversion(variable(Unit.of("mV")), "V") == (1e-3, 0.0)


def test_many_variables_are_named_by_the_first_thirty(tmp_path):
    def refused(count):
        known = {f"x{k}": Variable(f"x{k}", k, "Real", "input", None, None, None, None) for k in range(count)}
        with pytest.raises(ValueError, match="has no variable 'q'") as result:
            Description(tmp_path / "many.fmu", "2.0", (), False, known, "").variable("q")
        return str(result.value)

    assert refused(30).endswith("it has " + ", ".join(f"x{k}" for k in range(30)))
    assert refused(31).endswith("x28, x29 and 1 more")
