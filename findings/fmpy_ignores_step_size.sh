#!/usr/bin/env bash
# FMPy ignores step_size for co-simulation: simulate_fmu(step_size=0.3) makes 900 steps of 1 ms in 0.9 s.
#
# Versions: fmpy 0.3.32 (FMU built by pythonfmu 0.7.0). Date: 2026-11-28, CPython 3.11, Debian 12, x86-64.
# Usual guess: step_size is the communication step of a co-simulation FMU.
# Behaviour: for FMUs of kind co-simulation the communication step is output_interval (a 500th to a 1000th of the whole time if it is not
# given); step_size is for model exchange with Euler only, and is accepted and ignored without a word.
# For a controller inside an FMU: its period is wrong by whatever the duration is divided by.
#
# Output seen:
seen=$(
    cat <<'SEEN'
{'step_size': 0.3} steps in 0.9 s: 900
{'output_interval': 0.3} steps in 0.9 s: 3
{'step_size': 0.1, 'output_interval': 0.3} steps in 0.9 s: 3
SEEN
)
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --no-compile --disable-pip-version-check fmpy==0.3.32 pythonfmu==0.7.0
now=$(
    venv/bin/python - <<'PROGRAM'
import contextlib
import io
from pathlib import Path

import fmpy
from pythonfmu.builder import FmuBuilder

Path("Counter.py").write_text("""
from pythonfmu import Fmi2Slave, Fmi2Causality, Real
class Counter(Fmi2Slave):
    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.steps = 0.0
        self.register_variable(Real("steps", causality=Fmi2Causality.output))
    def do_step(self, time, step):
        self.steps += 1
        return True
""")
with contextlib.redirect_stdout(io.StringIO()):
    FmuBuilder.build_FMU("Counter.py")
for options in ({"step_size": 0.3}, {"output_interval": 0.3}, {"step_size": 0.1, "output_interval": 0.3}):
    print(options, "steps in 0.9 s:", int(fmpy.simulate_fmu("Counter.fmu", stop_time=0.9, **options)["steps"][-1]))
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
