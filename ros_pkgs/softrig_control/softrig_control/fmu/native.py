"""A node of a scenario as an FMU without Python: its C, FMI 2.0 or 3.0 around it; ``softrig export fmu --native``."""

from __future__ import annotations

import re
import shutil
import subprocess
import tempfile
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from softrig_core import Rig, ScenarioError
from softrig_core.block.params import declarations, flatten
from softrig_core.export.c_files import Exported
from softrig_core.export.check import FLAGS, PATIENCE
from softrig_core.export.command import c_of
from softrig_core.export.golden import member_of
from softrig_core.export.kinds import identifier, one_line
from softrig_core.export.unit import literal
from softrig_core.rig.members import Member

from .slave import unit_definitions, variable

KINDS = {float: "REAL", int: "INTEGER", bool: "BOOLEAN"}
NAMES = {2: {"REAL": "Real", "INTEGER": "Integer", "BOOLEAN": "Boolean"},
         3: {"REAL": "Float64", "INTEGER": "Int64", "BOOLEAN": "Boolean"}}  # fmt: skip
ROWS, DRAWN = 2000, 500  # calls that determine the C forms
PROGRAMS = ("_replay.c", "_main.c")
HEADERS = {2: "fmi2", 3: "fmi3"}


@dataclass(frozen=True)
class Variable:
    """A variable of the FMU: its name, its kind, and its place in C."""

    name: str
    causality: str
    kind: str
    place: str
    start: Any
    unit: str
    doc: str
    low: float | None = None
    high: float | None = None
    flag: str = ""  # C flag of an optional input, which tells whether it has a value; empty for other inputs


def export_native(rig: Rig, node: str, folder: Path, start: Mapping[str, Sequence[float]], version: int) -> Path:
    """Write a node of a rig as an FMU for co-simulation that runs without Python.

    Parameters
    ----------
    node : str
        Its name.
    folder : Path
        The file ``NODE.fmu`` goes here.
    start : mapping of str to sequence of float
        First values of inputs, by port.
    version : int
        2 or 3, of the FMI.

    Returns
    -------
    Path
        Of the FMU: sources, and the library of this machine.

    Raises
    ------
    ScenarioError
        The node has no C, or the compiler refuses it.
    """
    import fmpy

    member, done = member_of(rig, node), c_of(rig, node, rows=ROWS, drawn=DRAWN)
    variables = _variables(member, done, start)
    sources = resources.files(__package__)
    headers = Path(fmpy.__file__).parent / "c-code"
    files = {n: t for n, t in done.files.items() if n.endswith((".h", ".c")) and not n.endswith(PROGRAMS)}
    files |= {p.name: p.read_text() for p in headers.glob(f"{HEADERS[version]}*.h")}
    files["native_model.c"] = (sources / "native_model.c").read_text()
    files["model.h"] = _model(member, done, variables)
    files["variables.h"] = _accessors(member, variables, start)
    wrapper = files[f"native_fmi{version}.c"] = (sources / f"native_fmi{version}.c").read_text()
    compiled = [f"native_fmi{version}.c", *(n for n in done.files if n.endswith(".c") and n in files)]
    if version == 3:
        files["fmi3_none.c"] = _none(files["fmi3Functions.h"], wrapper)
        compiled.append("fmi3_none.c")
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{node}.fmu"
    with tempfile.TemporaryDirectory(prefix="softrig_fmu_") as scratch:
        for name, text in files.items():
            Path(scratch, name).write_text(text, encoding="utf-8")
        library = _compiled(Path(scratch), done.name, compiled)
        binary = f"binaries/{fmpy.platform if version == 2 else fmpy.platform_tuple}/{done.name}.so"
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("modelDescription.xml", _described(rig, member, done, variables, version, compiled))
            if version == 3:
                archive.writestr("sources/buildDescription.xml", _built(done.name, compiled))
            for name, text in files.items():
                archive.writestr(f"sources/{name}", text)
            archive.write(library, binary)
    return path


def _compiled(folder: Path, name: str, files: Sequence[str]) -> Path:
    compiler = next((c for c in ("cc", "gcc", "clang") if shutil.which(c)), None)
    if compiler is None:
        raise ScenarioError("no C compiler was found (Debian: apt-get install gcc)")
    library = folder / f"{name}.so"
    command = [compiler, *(f for f in FLAGS if f != "-Werror"), "-shared", "-fPIC", "-o", library.name, *files, "-lm"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False, timeout=PATIENCE)
    if done.returncode:
        raise ScenarioError(f"{compiler} refuses the FMU of {name}: {done.stderr.strip()[:2000]}")
    return library


def _variables(member: Member, done: Exported, start: Mapping[str, Sequence[float]]) -> list[Variable]:
    result: list[Variable] = []
    for causality, ports in (("input", member.inputs), ("output", member.outputs)):
        for port in ports:
            topic = member.remap.get(port.topic, port.topic)
            first = start.get(port.name, port.safe)
            name, struct = identifier(port.name), "in" if causality == "input" else "out"
            for k, (label, unit) in enumerate(zip(port.labels, port.units, strict=True)):
                limit = port.limits[k] if causality == "input" else None
                result.append(
                    Variable(
                        variable(topic, label), causality, "REAL", f"m->{struct}.{name}[{k}]", first[k], unit,
                        f"{topic}/{label}", None if limit is None else -limit, limit,
                        f"m->in.has_{name}" if causality == "input" and port.held else "",
                    )
                )  # fmt: skip
    values = flatten(member.params)
    known = {d.name: d for d in declarations(type(member.params))}
    for name in done.settable:
        value, declaration = values[name], known.get(name)
        bounds = (declaration.lower, declaration.upper) if declaration is not None else (None, None)
        unit, doc = (declaration.unit or "", declaration.doc) if declaration is not None else ("", "")
        result.append(
            Variable(name, "parameter", KINDS[type(value)], f"m->params.{identifier(name)}", value, unit, doc, *bounds)
        )
    return result


def _model(member: Member, done: Exported, variables: Sequence[Variable]) -> str:
    """Return the header that describes the node to the wrappers."""
    n, period = done.name, member.schedule.period
    num, den = (period * 10**9).as_integer_ratio()
    digest = re.findall(r'_DIGEST "(\w+)"', done.files[f"{n}.h"])[0]
    plant = int(member.is_plant)
    macros = {
        "node_t": n, "node_in_t": f"{n}_in", "node_out_t": f"{n}_out", "node_params_t": f"{n}_params",
        "node_init": f"{n}_init", "NODE_PARAMS": f"{n.upper()}_PARAMS", "node_step": f"{n}_step",
        "node_outputs": f"{n}_outputs", "node_advance": f"{n}_advance",
        "PERIOD": repr(float(period)), "NS_NUMERATOR": f"INT64_C({num})", "NS_DENOMINATOR": f"INT64_C({den})",
        "IS_PLANT": plant, "IS_SOURCE": int(not plant and not member.inputs), "BUILD": f"UINT64_C(0x{digest})",
        "GUID": f'"{{{digest}}}"', "TIME": f"{len(variables)}u",
    }  # fmt: skip
    return "\n".join(
        [
            "/* What the wrapper knows of the node. Written by `softrig export fmu --native`. */",
            "#ifndef MODEL_H",
            "#define MODEL_H",
            f'#include "{n}.h"',
            *(f"#define {name} {text}" for name, text in macros.items()),
            "enum { KIND_REAL, KIND_INTEGER, KIND_BOOLEAN };",
            "#endif",
            "",
        ]
    )


def _accessors(member: Member, variables: Sequence[Variable], start: Mapping[str, Sequence[float]]) -> str:
    """Return the functions that read and write the variables of an instance."""
    begin = [f"    {v.place} = {literal(float(v.start))};" for v in variables if v.causality != "parameter"]
    begin += [f"    m->in.has_{identifier(p.name)} = true;" for p in member.inputs if p.held and p.name in start]
    checks = [
        f"({f'!{v.flag} || ' if v.flag else ''}(fabs({v.place}) <= {literal(float(v.high or 0.0))}))"
        for v in variables
        if v.causality == "input"
    ]
    gets = [f"    case {k}u: *x = (double){v.place}; return kind == KIND_{v.kind};" for k, v in enumerate(variables)]
    return "\n".join(
        [
            "/* Where the variables are. Written by `softrig export fmu --native`. */",
            "static void model_start(model_t *m)",
            "{",
            "    (void)m;",
            *begin,
            "}",
            "static bool model_inside(const model_t *m)",
            "{",
            "    (void)m;",
            f"    return {' && '.join(checks) or 'true'};",
            "}",
            "static bool model_get(const model_t *m, unsigned vr, int kind, double *x)",
            "{",
            "    switch (vr) {",
            *gets,
            "    default: (void)m; (void)kind; (void)x; return false;",
            "    }",
            "}",
            "static bool model_set(model_t *m, unsigned vr, int kind, double x, bool ready)",
            "{",
            "    (void)ready;",
            "    switch (vr) {",
            *_setters(variables),
            "    default: (void)m; (void)kind; (void)x; return false;",
            "    }",
            "}",
            "",
        ]
    )


def _setters(variables: Sequence[Variable]) -> list[str]:
    sets = []
    for k, v in enumerate(variables):
        if v.causality == "output":
            continue
        store = (
            f"{v.place} = x;"
            if v.kind == "REAL"
            else f"{v.place} = (x != 0.0);"
            if v.kind == "BOOLEAN"
            else (f"{v.place} = (int64_t)x;")
        )
        if v.causality == "parameter":
            low = "-INFINITY" if v.low is None else literal(float(v.low))
            high = "INFINITY" if v.high is None else literal(float(v.high))
            test = f"(kind != KIND_{v.kind}) || ready || !((x >= {low}) && (x <= {high}))"
        else:
            test = f"kind != KIND_{v.kind}"
        flag = f" {v.flag} = true;" if v.flag else ""
        sets.append(f"    case {k}u: if ({test}) {{ return false; }} {store}{flag} return true;")
    return sets


def _described(
    rig: Rig, member: Member, done: Exported, variables: Sequence[Variable], version: int, files: Sequence[str]
) -> bytes:
    """Return the modelDescription.xml."""
    digest = re.findall(r'_DIGEST "(\w+)"', done.files[f"{done.name}.h"])[0]
    token = {2: "guid", 3: "instantiationToken"}[version]
    doc = one_line((member.block_class.__doc__ or "").split("\n\n")[0])
    root = Element(
        "fmiModelDescription",
        {
            "fmiVersion": f"{version}.0", "modelName": member.name, token: f"{{{digest}}}", "description": doc,
            "generationTool": "softrig", "variableNamingConvention": "structured",
        },
    )  # fmt: skip
    can = {"canHandleVariableCommunicationStepSize": "true", "modelIdentifier": done.name}
    simulation = Element("CoSimulation", can)
    names = {2: ("canGetAndSetFMUstate", "canSerializeFMUstate"), 3: ("canGetAndSetFMUState", "canSerializeFMUState")}
    simulation.attrib |= dict.fromkeys(names[version], "true")
    if version == 2:
        root.append(simulation)
        sources = SubElement(simulation, "SourceFiles")
        for name in files:
            SubElement(sources, "File", name=name)
    else:
        simulation.set("fixedInternalStepSize", repr(float(member.schedule.period)))
    root.extend(unit_definitions({v.unit for v in variables if v.unit not in ("", "1")}))
    if version == 3:
        root.insert(0, simulation)
    experiment = {"startTime": "0.0", "stepSize": repr(float(member.schedule.period))}
    if rig.scenario.duration:
        experiment["stopTime"] = repr(float(rig.scenario.duration))
    SubElement(root, "DefaultExperiment", experiment)
    listed = SubElement(root, "ModelVariables")
    for k, v in enumerate(variables):
        _variable(listed, k, v, version, bool(member.is_plant or not member.inputs))
    if version == 3:
        SubElement(listed, "Float64", name="time", valueReference=str(len(variables)), causality="independent",
                   variability="continuous")  # fmt: skip
    structure = SubElement(root, "ModelStructure")
    outputs = [k for k, v in enumerate(variables) if v.causality == "output"]
    if version == 2:
        for tag in ("Outputs", "InitialUnknowns") if outputs else ():
            element = SubElement(structure, tag)
            for k in outputs:
                SubElement(element, "Unknown", index=str(k + 1))
    else:
        for tag in ("Output", "InitialUnknown"):
            for k in outputs:
                SubElement(structure, tag, valueReference=str(k))
    indent(root)
    return b'<?xml version="1.0" encoding="UTF-8"?>\n' + tostring(root, encoding="utf-8") + b"\n"


def _variable(listed: Element, k: int, v: Variable, version: int, computed: bool) -> None:
    bounds = {"min": v.low, "max": v.high}
    number = int if v.kind == "INTEGER" else float
    about = {key: repr(number(x)) for key, x in bounds.items() if x is not None and abs(x) < float("inf")}
    if v.kind == "REAL" and v.unit not in ("", "1"):
        about["unit"] = v.unit
    if v.causality != "output":
        about["start"] = str(v.start).lower() if v.kind == "BOOLEAN" else repr(v.start)
    variability = {"parameter": "fixed"}.get(v.causality, "discrete" if v.kind != "REAL" else "continuous")
    head = {"name": v.name, "valueReference": str(k), "causality": v.causality, "variability": variability}
    if v.doc:
        head["description"] = one_line(v.doc)
    if v.causality == "output":
        head["initial"] = "calculated"
    if version == 2:
        SubElement(SubElement(listed, "ScalarVariable", head), NAMES[2][v.kind], about)
    else:
        SubElement(listed, NAMES[3][v.kind], head | about)


def _built(name: str, files: Sequence[str]) -> bytes:
    root = Element("fmiBuildDescription", fmiVersion="3.0")
    build = SubElement(root, "BuildConfiguration", modelIdentifier=name)
    sources = SubElement(build, "SourceFileSet", language="C99", compilerOptions="-ffp-contract=off")
    for file in files:
        SubElement(sources, "SourceFile", name=file)
    indent(root)
    return b'<?xml version="1.0" encoding="UTF-8"?>\n' + tostring(root, encoding="utf-8") + b"\n"


def _none(header: str, wrapper: str) -> str:
    """Return the functions that each FMU of FMI 3.0 exports and that one of this kind has no use for."""
    defined = set(re.findall(r"\bfmi3\w+(?=\()", wrapper)) | {
        f"fmi3{verb}{kind}" for verb in ("Get", "Set") for kind in ("Float64", "Int64", "Boolean")
    }
    names = [n for n in re.findall(r"FMI3_Export \w+ +(fmi3\w+);", header) if n not in defined]
    lines = [f"int {name}(void);\nint {name}(void) {{ return 3; }}" for name in names]
    return "\n".join(
        ["/* Functions of FMI 3.0 that are an error here, whatever they are given (3: fmi3Error). */", *lines, ""]
    )
