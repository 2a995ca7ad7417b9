#!/usr/bin/env bash
# Two cached functions of one numba factory, compiled by two processes, become one function for whoever calls both.
#
# Versions: numba 0.68.1, numpy 2.4.6. Date: 2026-11-29, CPython 3.11, Debian 12, x86-64.
# Usual guess: a closure's constants are part of its key in the cache, so left(x) is 2 x and right(x) is 5 x wherever they are
# called.
# Behaviour: the key holds the constants, and each function called from Python is right. The names of the compiled symbols hold
# only the function's name and a count within the process that compiled it. Functions of one factory that two processes compiled
# as their first have equal symbols; when a third process loads both from the cache and a compiled function calls them, the linker
# takes one of them for both. No error, no warning: both(1.0) has a wrong number. It needs separate processes (workers, tests in
# parallel); one process that compiles both counts on. Remedy: give each function a __qualname__ of its own.
#
# Output seen:
seen=$(
    cat <<'SEEN'
compiled alone: 2.0
compiled alone: 5.0
both(1.0): (2.0, 2.0) - left and right called from Python: 2.0 5.0
SEEN
)
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --no-compile --disable-pip-version-check numba==0.68.1 numpy==2.4.6
now=$(
    PYTHONPATH=. venv/bin/python - <<'PROGRAM'
import pathlib
import subprocess
import sys

pathlib.Path("laws.py").write_text("""
import numba


def law(gain):
    @numba.njit(cache=True)
    def step(x):
        return gain * x

    return step
""")
one = "import sys, laws; print('compiled alone:', laws.law(float(sys.argv[1]))(1.0), flush=True)"
two = """
import numba, laws

left, right = laws.law(2.0), laws.law(5.0)


@numba.njit
def both(x):
    return left(x), right(x)


print("both(1.0):", both(1.0), "- left and right called from Python:", left(1.0), right(1.0))
"""
for gain in ("2", "5"):
    subprocess.run([sys.executable, "-c", one, gain], check=True)
subprocess.run([sys.executable, "-c", two], check=True)
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
