#!/usr/bin/env bash
# blark.parse.parse_single_file reports a syntax error in a valid TwinCAT .TcPOU that blark.parse.parse reads.
#
# Versions: blark 0.8.3. Date: 2026-11-28, CPython 3.11, Debian 12, x86-64.
# Usual guess: parse_single_file(file) is parse(file) for one file.
# Behaviour: it joins declaration and implementation of the POU and parses them as one source, so the first statement of the
# body is an unexpected character. parse() yields both parts, each without an error.
# For a check in continuous integration: use parse(), and look at .exception of each result.
#
# Output seen:
seen=$(
    cat <<'SEEN'
parse_single_file: UnexpectedCharacters
parse: F/declaration NoneType
parse: F/implementation NoneType
SEEN
)
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --no-compile --disable-pip-version-check blark==0.8.3
cat >F.TcPOU <<'POU'
<?xml version="1.0" encoding="utf-8"?>
<TcPlcObject Version="1.1.0.1">
  <POU Name="F" Id="{11111111-1111-1111-1111-111111111111}" SpecialFunc="None">
    <Declaration><![CDATA[FUNCTION_BLOCK F
VAR_INPUT
    u : LREAL;
END_VAR
VAR_OUTPUT
    y : LREAL;
END_VAR
]]></Declaration>
    <Implementation>
      <ST><![CDATA[y := 2.0 * u;
]]></ST>
    </Implementation>
  </POU>
</TcPlcObject>
POU
now=$(
    venv/bin/python - <<'PROGRAM'
from blark.parse import parse, parse_single_file

print("parse_single_file:", type(parse_single_file("F.TcPOU").exception).__name__)
for part in parse("F.TcPOU"):
    print("parse:", part.identifier, type(part.exception).__name__)
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
