#!/usr/bin/env bash
# SymPy's Mod becomes fmod in C and mod in Octave: an angle wrapped to -pi..pi comes out below -pi on the board.
#
# Versions: sympy 1.14.0. Date: 2026-11-29, CPython 3.11, Debian 12, x86-64.
# Usual guess: generated code computes what the expression does: Mod has the sign of its divisor, in every language.
# Behaviour: ccode and cxxcode print fmod, which has the sign of the dividend: for angles below -pi the generated C gives
# another result than SymPy, Python and the generated Octave, JavaScript, Rust and Julia, which take care of the sign. No
# warning.
#
# Output seen:
seen=$(
    cat <<'SEEN'
ccode: fmod(x + M_PI, 2*M_PI) - M_PI
cxxcode: std::fmod(x + M_PI, 2*M_PI) - M_PI
pycode: (x + math.pi) % (2*math.pi) - math.pi
octave_code: mod(x + pi, 2*pi) - pi
jscode: (((x + Math.PI) % (2*Math.PI)) + (2*Math.PI)) % (2*Math.PI) - Math.PI
julia_code: (x - 2 * pi * floor((x + pi) / (2 * pi)) + pi) - pi
angle  4.0: SymPy -2.2832, what the C code computes -2.2832
angle -3.0: SymPy -3.0000, what the C code computes -3.0000
angle -4.0: SymPy 2.2832, what the C code computes -4.0000
SEEN
)
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --no-compile --disable-pip-version-check sympy==1.14.0
now=$(
    venv/bin/python - <<'PROGRAM'
import math

import sympy

x = sympy.Symbol("x")
wrapped = sympy.Mod(x + sympy.pi, 2 * sympy.pi) - sympy.pi
for name in ("ccode", "cxxcode", "pycode", "octave_code", "jscode", "julia_code"):
    print(f"{name}: {getattr(sympy, name)(wrapped)}")
for angle in (4.0, -3.0, -4.0):
    exact, in_c = wrapped.subs(x, angle).evalf(5), math.fmod(angle + math.pi, 2 * math.pi) - math.pi
    print(f"angle {angle:4}: SymPy {exact}, what the C code computes {in_c:.4f}")
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
