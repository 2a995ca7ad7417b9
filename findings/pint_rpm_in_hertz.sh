#!/usr/bin/env bash
# pint converts 60 rpm to 6.28 Hz and 1 Hz to 9.55 rpm; astropy and unyt refuse both.
#
# Versions: pint 0.25.3, unyt 3.2.0, astropy 8.0.2. Date: 2026-11-29, CPython 3.11, Debian 12, x86-64.
# Usual guess: 60 rpm are 1 Hz, or the conversion is refused.
# Behaviour: in pint the radian is the number 1 and a turn is 2 pi of it, a hertz is 1/s: a speed in rpm converted to Hz, or a
# stator frequency converted to rpm, is wrong by 2 pi without a warning. 1 Hz is equal to 1 rad/s. unyt and astropy keep the
# angle as a dimension and raise.
#
# Output seen:
seen=$(
    cat <<'SEEN'
pint: 60 rpm = 6.2832 Hz, 1 Hz = 9.5493 rpm, 1 Hz == 1 rad/s: True
unyt: UnitConversionError
astropy: UnitConversionError
SEEN
)
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --no-compile --disable-pip-version-check pint==0.25.3 unyt==3.2.0 astropy==8.0.2 numpy==2.4.6
now=$(
    venv/bin/python - <<'PROGRAM'
import astropy.units
import pint
import unyt

units = pint.UnitRegistry()
print("pint:", f"60 rpm = {(60 * units.rpm).to('Hz'):.4f~}, 1 Hz = {(1 * units.Hz).to('rpm'):.4f~},",
      f"1 Hz == 1 rad/s: {1 * units.Hz == 1 * units.rad / units.s}")
try:
    print("unyt:", unyt.unyt_quantity(60, "rpm").to("Hz"))
except unyt.exceptions.UnitConversionError as error:
    print("unyt:", type(error).__name__)
try:
    print("astropy:", (60 * astropy.units.cycle / astropy.units.min).to("Hz"))
except astropy.units.UnitConversionError as error:
    print("astropy:", type(error).__name__)
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
