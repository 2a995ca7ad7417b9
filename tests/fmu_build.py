"""Builds the FMUs of the tests from the C sources in fmu_sources, against the headers that FMPy ships."""

import math
import subprocess
import sys
import zipfile
from pathlib import Path
from xml.sax.saxutils import quoteattr

import fmpy
from softrig_drives.dc_motor.model import MotorConstants

SOURCES = Path(__file__).parent / "fmu_sources"
HEADERS = Path(fmpy.__file__).parent / "c-code"
# Name, causality, unit, start, and the type unless it is Real; in the order of the enumeration in the source.
MOTOR = (
    [("theta", "output", "rad"), ("w", "output", "rad/s"), ("i", "output", "A"), ("voltage", "input", "V", 0.0)]
    + [
        (name, "parameter", unit, getattr(MotorConstants(), name))
        for name, unit in (
            ("R", "Ohm"),
            ("L", "H"),
            ("J", "kg.m2"),
            ("b", "N.m.s/rad"),
            ("Kt", "N.m/A"),
            ("Ke", "V.s/rad"),
        )
    ]
    + [("torque", "output", "N.m"), ("fault", "parameter", "", 0.0)]
)
VARIABLES = {
    "motor": MOTOR,
    "ball": [("height", "output", "m"), ("v", "output", "m/s"), ("g", "parameter", "m/s2", 9.81),
             ("e", "parameter", "", 0.7), ("bounces", "output", "", None, "Integer")],
    "law": [("setpoint", "input", "rpm", 0.0), ("speed", "input", "rpm", 0.0), ("command", "output", "V"),
            ("kp", "parameter", "", 2.0), ("ki", "parameter", "", 10.0), ("limit", "parameter", "V", 12.0),
            ("z", "local", ""), ("enabled", "input", "", "true", "Boolean")],
    "mix": [("u", "input", "V", "0 0 0", None, (3,)), ("gain", "parameter", "", "1 2 3 4 5 6", None, (2, 3)),
            ("y", "output", "V", None, None, (2,)), ("bias", "tunable", "V", 0.0)],
    "strict": [("u", "input", "", 0.0), ("n", "input", "", 0, "Integer"), ("y", "output", ""),
               ("tolerance", "output", ""), ("mode", "local", ""), ("fault", "parameter", "", 0.0),
               ("pid", "output", "")],
}  # fmt: skip
STATES = {"motor": ("theta", "w", "i"), "ball": ("height", "v"), "law": (), "mix": (), "strict": ()}
RPM = '<BaseUnit rad="1" s="-1" factor="0.10471975511965977"/>'


def build_fmu(folder, model, version=2, platform=None, exchange=True):
    """Compile a model to an FMU; return its file. FMI 2.0 or 3.0, with both interfaces."""
    name = f"{model}{version}"
    library = folder / f"{name}.so"
    constants = [f"-D{k}_={v!r}" for k, v in MotorConstants().model_dump().items()]
    command = ["gcc", "-shared", "-fPIC", "-O1", "-ffp-contract=off", "-w", f"-I{HEADERS}", f'-DMODEL="{model}.c"']
    files = ["fmi2.c"] if version == 2 else ["fmi3.c", "fmi3_absent.c"]
    subprocess.run([*command, *constants, *(str(SOURCES / f) for f in files), "-lm", "-o", str(library)], check=True)
    path = folder / f"{name}.fmu"
    place = platform or (fmpy.platform if version == 2 else fmpy.platform_tuple)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", describe(model, version, exchange))
        archive.write(library, f"binaries/{place}/{name}.so")
    return path


def describe(model, version, exchange):
    units, variables = {}, []
    listed = [(*v, *(None,) * (6 - len(v))) for v in VARIABLES[model]]
    for n, (name, causality, unit, start, kind, dims) in enumerate(listed):
        k = sum(math.prod(v[5] or ()) for v in listed[:n])
        units[unit] = RPM if unit == "rpm" else ""
        own = f" unit={quoteattr(unit)}" if unit else ""
        own += "" if start is None else f' start="{start}"'
        fixed = {"parameter": ' variability="fixed"', "tunable": ' variability="tunable"'}.get(causality, "")
        causality = "parameter" if causality == "tunable" else causality
        size = "".join(f'<Dimension start="{d}"/>' for d in dims or ())
        if kind == "Integer" or kind == "Boolean":
            fixed = ' variability="discrete"'
        head = f'name="{name}" valueReference="{k}" causality="{causality}"{fixed}'
        if version == 2:
            variables.append(f"<ScalarVariable {head}><{kind or 'Real'}{own}/></ScalarVariable>")
        else:
            tag = {"Integer": "Int32", None: "Float64"}.get(kind, kind)
            variables.append(f"<{tag} {head}{own}>{size}</{tag}>")
    index = {v[0]: k for k, v in enumerate(listed)}
    if version == 2:  # FMI 2 identifies a state by its derivative
        for k, state in enumerate(STATES[model]):
            head = f'name="der({state})" valueReference="{100 + k}"'
            variables.append(f'<ScalarVariable {head}><Real derivative="{index[state] + 1}"/></ScalarVariable>')
    flags = 'canGetAndSetFMUstate="true" canSerializeFMUstate="true"'
    if version == 3:
        flags = flags.replace("state", "State").replace("FMUState", "FMUState")
    flags = f'modelIdentifier="{model}{version}" {flags}'
    interfaces = f'<CoSimulation canHandleVariableCommunicationStepSize="true" {flags}/>'
    if exchange:
        interfaces = f"<ModelExchange {flags}/>" + interfaces
    outputs = [sum(math.prod(v[5] or ()) for v in listed[:n]) for n, v in enumerate(listed) if v[1] == "output"]
    tag, token = ("guid", "2.0") if version == 2 else ("instantiationToken", "3.0")
    count = {"ball": 1}.get(model, 0)
    indicators = f' numberOfEventIndicators="{count}"' if version == 2 else ""
    if version == 2:
        structure = "".join(f'<Unknown index="{k + 1}"/>' for k in outputs)
        ders = "".join(f'<Unknown index="{len(listed) + k + 1}"/>' for k in range(len(STATES[model])))
        structure = f"<Outputs>{structure}</Outputs>" + (f"<Derivatives>{ders}</Derivatives>" if ders else "")
    else:
        structure = "".join(f'<Output valueReference="{k}"/>' for k in outputs)
    definitions = "".join(f"<Unit name={quoteattr(u)}>{base}</Unit>" for u, base in units.items() if u)
    experiment = '<DefaultExperiment tolerance="1e-9"/>' if model == "strict" else ""
    return (
        '<?xml version="1.0" encoding="UTF-8"?>'
        f'<fmiModelDescription fmiVersion="{token}" modelName="{model}" {tag}="{model}"{indicators}>'
        f"{interfaces}<UnitDefinitions>{definitions}</UnitDefinitions>"
        f"{experiment}<ModelVariables>{''.join(variables)}"
        f"</ModelVariables><ModelStructure>{structure}</ModelStructure></fmiModelDescription>"
    )


if __name__ == "__main__":
    print(*(build_fmu(Path(), name) for name in sys.argv[1:]), sep="\n")
