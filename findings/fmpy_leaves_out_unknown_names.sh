#!/usr/bin/env bash
# FMPy leaves out inputs and outputs whose names the FMU does not have, and refuses only unknown start values.
#
# Versions: fmpy 0.3.28, pythonfmu 0.7.0 (PyPI). Date: 2026-11-29, CPython 3.11, Debian 12, x86-64.
# Usual guess: a misspelt input column, output or start value is an error, all three alike.
# Behaviour: an input column "U" beside the input "u" is not used, and the input stays at its start value (a line on the standard output
# says that "u" is missing). An output "Y" is not in the result. Neither raises. A start value "U" raises.
# For a comparison with FMPy, check the names of the result and of the input against the model description first.
#
# Output seen:
seen=$(
    cat <<'SEEN'
input column u | y at the end 7.0
Warning: missing input for variable "u"
input column U | y at the end 0.0
output y | columns time, y
output Y | columns time
start value u | set
start value U | The start values for the following variables could not be set: U
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


import numpy as np
from fmpy import simulate_fmu

build(", variability=Fmi2Variability.discrete")
for name in ("u", "U"):
    table = np.array([(0.0, 7.0), (1.0, 7.0)], dtype=[("time", float), (name, float)])
    result = simulate_fmu("Echo.fmu", input=table, stop_time=1.0, output_interval=0.5, output=["y"])
    print("input column", name, "| y at the end", result["y"][-1])
for name in ("y", "Y"):
    result = simulate_fmu("Echo.fmu", stop_time=1.0, output_interval=0.5, output=[name])
    print("output", name, "| columns", ", ".join(result.dtype.names))
for name in ("u", "U"):
    try:
        simulate_fmu("Echo.fmu", start_values={name: 1.0}, stop_time=1.0)
        print("start value", name, "| set")
    except Exception as error:
        print("start value", name, "|", error)
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
