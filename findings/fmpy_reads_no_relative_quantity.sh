#!/usr/bin/env bash
# FMPy never reads relativeQuantity of a variable, nor min and max of unsigned FMI 3 variables.
#
# Versions: fmpy 0.3.32. Date: 2026-11-28, CPython 3.11, Debian 12, x86-64.
# Usual guess: read_model_description gives each attribute of the standard that its classes have a field for.
# Behaviour: relativeQuantity="true" at a variable comes back as None, so a temperature difference in degC looks like a
# temperature (273.15 K off once converted); of a declared type it is read. min and max of an UInt8 are None as well.
# For whoever converts units: read that attribute from the XML, or from the declared type.
#
# Output seen:
seen=$(
    cat <<'SEEN'
own | own attribute: None | of its type: None
declared | own attribute: None | of its type: True
unsigned | min None | max None
signed | min 3 | max 7
SEEN
)
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --no-compile --disable-pip-version-check fmpy==0.3.32
now=$(
    venv/bin/python - <<'PROGRAM'
import zipfile

from fmpy import read_model_description

TWO = """<fmiModelDescription fmiVersion="2.0" modelName="m" guid="g"><CoSimulation modelIdentifier="m"/>
<UnitDefinitions><Unit name="degC"><BaseUnit K="1" offset="273.15"/></Unit></UnitDefinitions>
<TypeDefinitions><SimpleType name="difference"><Real unit="degC" relativeQuantity="true"/></SimpleType></TypeDefinitions>
<ModelVariables><ScalarVariable name="own" valueReference="0"><Real unit="degC" relativeQuantity="true"/></ScalarVariable>
<ScalarVariable name="declared" valueReference="1"><Real declaredType="difference"/></ScalarVariable></ModelVariables>
<ModelStructure/></fmiModelDescription>"""
THREE = """<fmiModelDescription fmiVersion="3.0" modelName="m" instantiationToken="g"><CoSimulation modelIdentifier="m"/>
<ModelVariables><UInt8 name="unsigned" valueReference="1" min="3" max="7"/><Int8 name="signed" valueReference="2" min="3" max="7"/>
</ModelVariables><ModelStructure/></fmiModelDescription>"""
for text in (TWO, THREE):
    with zipfile.ZipFile("m.fmu", "w") as file:
        file.writestr("modelDescription.xml", text)
    for v in read_model_description("m.fmu", validate=False).modelVariables:
        if text is TWO:
            print(v.name, "| own attribute:", v.relativeQuantity, "| of its type:", v.declaredType and v.declaredType.relativeQuantity)
        else:
            print(v.name, "| min", v.min, "| max", v.max)
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
