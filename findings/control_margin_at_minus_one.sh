#!/usr/bin/env bash
# python-control reports an infinite gain margin for a sampled loop that becomes unstable at z = -1.
#
# Versions: control 0.10.2, numpy 2.4. Date: 2026-11-28, CPython 3.11, Debian 12, x86-64.
# Usual guess: stability_margins() of a discrete-time loop finds every gain at which a closed-loop pole reaches the
# unit circle, so G = 0.1/(z - 0.9) has gain margin 19, where the pole 0.9 - 0.1 k reaches -1.
# Behaviour: the crossing at the Nyquist frequency, where the locus meets the real axis at its end, is not counted: the
# margin is inf, while the closed loop with gain 20 has its pole at -1.1. Loops that cross elsewhere are right.
# For a drive: a sampled loop of first order looks as if its gain could grow without limit.
#
# Output seen:
seen=$(
    cat <<'SEEN'
gain margin inf margin() inf
gain 18: closed-loop pole [-0.9]
gain 20: closed-loop pole [-1.1]
SEEN
)
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --no-compile --disable-pip-version-check control==0.10.2
now=$(
    venv/bin/python - <<'PROGRAM'
import control as ct
import numpy as np

loop = ct.tf([0.1], [1, -0.9], 1.0)
print("gain margin", ct.stability_margins(loop)[0], "margin()", ct.margin(loop)[0])
for gain in (18, 20):
    print(f"gain {gain}: closed-loop pole", np.round(ct.poles(ct.feedback(gain * loop)).real, 6))
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
