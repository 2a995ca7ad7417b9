#!/usr/bin/env bash
# PythonFMU writes an Integer without a variability, which FMI 2.0 reads as continuous, and FMPy refuses the FMU.
#
# Versions: pythonfmu 0.7.0, fmpy 0.3.28 (PyPI). Date: 2026-11-29, CPython 3.11, Debian 12, x86-64.
# Usual guess: an Integer that is registered without a variability is discrete, as FMI 2.0 demands of all types but Real.
# Behaviour: modelDescription.xml has no variability for it, and the default of FMI 2.0 is "continuous" for every type. The FMU builds
# without a message; FMPy does not load it before variability=Fmi2Variability.discrete is given. A Real is accepted.
#
# Output seen:
seen=$(
    cat <<'SEEN'
given: nothing | written: nothing | FMPy: - The variable "count" (line 18) is of type Integer and must have variability != "continuous".
given: discrete | written: discrete | FMPy: read
SEEN
)
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --no-compile --disable-pip-version-check fmpy==0.3.28 pythonfmu==0.7.0
now=$(
    venv/bin/python - <<'PROGRAM'
import pathlib
import subprocess
import sys

MODEL = """from pythonfmu import Fmi2Causality, Fmi2Slave, Fmi2Variability, Integer, Real


class Echo(Fmi2Slave):
    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.u, self.y, self.count = 0.0, 0.0, 0
        self.register_variable(Real("u", causality=Fmi2Causality.input))
        self.register_variable(Real("y", causality=Fmi2Causality.output))
        self.register_variable(Integer("count", causality=Fmi2Causality.outputVARIABILITY))

    def do_step(self, current_time, step_size):
        self.y, self.count = self.u, self.count + 1
        return True
"""


def build(variability):
    pathlib.Path("echo.py").write_text(MODEL.replace("VARIABILITY", variability))
    subprocess.run([sys.executable, "-m", "pythonfmu", "build", "-f", "echo.py"], check=True, capture_output=True)


import re
import zipfile

from fmpy import read_model_description

for variability in ("", ", variability=Fmi2Variability.discrete"):
    build(variability)
    text = zipfile.ZipFile("Echo.fmu").read("modelDescription.xml").decode()
    line = re.search('<ScalarVariable name="count"[^>]*>', text).group()
    written = re.search('variability="([^"]*)"', line)
    print("given:", variability.rpartition(".")[2] or "nothing", "| written:", written.group(1) if written else "nothing", end=" | ")
    try:
        read_model_description("Echo.fmu")
        print("FMPy: read")
    except Exception as error:
        print("FMPy:", str(error).splitlines()[-1])
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
