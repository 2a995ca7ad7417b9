#!/usr/bin/env bash
# python-control discretises a system with an integrator or a differentiator by 'matched' to one whose numerator is nan.
#
# Versions: control 0.10.2, numpy 2.4. Date: 2026-11-28, CPython 3.11, Debian 12, x86-64.
# Usual guess: matched poles and zeros of 1/(s (s + 2)): poles at 1 and exp(-2 T), the gain matched at another frequency, as the
# text books do for poles at the origin.
# Behaviour: the gain is matched at s = 0 only, where both gains are infinite (or zero): sample_system returns a system with the
# right denominator and the numerator nan, with a RuntimeWarning of numpy; str() of it then raises NameError (name 'nan').
# A position loop of a drive always has that integrator. 'zoh' and 'tustin' are right.
#
# Output seen:
seen=$(
    cat <<'SEEN'
1/(s + 2) by zoh: numerator [0.090635] denominator [ 1.       -0.818731]
1/(s + 2) by matched: numerator [0.090635] denominator [ 1.       -0.818731]
1/(s (s + 2)) by zoh: numerator [0.004683 0.004381] denominator [ 1.       -1.818731  0.818731]
1/(s (s + 2)) by matched: numerator [nan] denominator [ 1.       -1.818731  0.818731]
s/(s + 2) by zoh: numerator [ 1. -1.] denominator [ 1.       -0.818731]
s/(s + 2) by matched: numerator [nan nan] denominator [ 1.       -0.818731]
SEEN
)
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --no-compile --disable-pip-version-check control==0.10.2 numpy==2.4.6
now=$(
    venv/bin/python - 2>/dev/null <<'PROGRAM'
import control as ct
import numpy as np

for name, system in (
    ("1/(s + 2)", ct.tf([1], [1, 2])),
    ("1/(s (s + 2))", ct.tf([1], [1, 2, 0])),
    ("s/(s + 2)", ct.tf([1, 0], [1, 2])),
):
    for method in ("zoh", "matched"):
        sampled = ct.sample_system(system, 0.1, method)
        print(f"{name} by {method}: numerator", np.round(sampled.num[0][0], 6), "denominator", np.round(sampled.den[0][0], 6))
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
