#!/usr/bin/env bash
# canopen reads the limits of a signed EDS object as signed and its default as unsigned, and drops octal and hexadecimal
# defaults that it cannot read.
#
# Versions: canopen 2.4.1. Date: 2026-11-29, CPython 3.11, Debian 12, x86-64.
# Usual guess: DefaultValue=0xFFFB of an INTEGER16 is -5, as LowLimit=0xFFFB is; what cannot be read is an error.
# Behaviour: the limit is -5, the default 65531, which no node can send: reading it over SDO raises ValueError. 010 (octal 8 in
# CiA 306) and the bits of a REAL32 (0x3FC00000 is 1.5) leave no default at all, without a word; a node of this
# dictionary answers "resource not available".
#
# Output seen:
seen=$(
    cat <<'SEEN'
INTEGER16 -5: default -5, lowest -5, over SDO -5
INTEGER16 0xFFFB: default 65531, lowest -5, over SDO ValueError: Value does not fit in specified type
UNSIGNED8 010: default None, lowest None, over SDO SdoAbortedError: Code 0x060A0023, Resource not available
REAL32 0x3FC00000: default None, lowest None, over SDO SdoAbortedError: Code 0x060A0023, Resource not available
SEEN
)
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --no-compile --disable-pip-version-check canopen==2.4.1
now=$(
    venv/bin/python - <<'PROGRAM'
import canopen

HEAD = '''[DeviceInfo]
NrOfRXPDO=0
[MandatoryObjects]
SupportedObjects=1
1=0x1000
[1000]
ParameterName=Device type
ObjectType=0x7
DataType=0x0007
AccessType=ro
DefaultValue=0x00020192
PDOMapping=0
[ManufacturerObjects]
SupportedObjects=4
1=0x2000
2=0x2001
3=0x2002
4=0x2003
'''
TYPES = {"INTEGER16": "0x0003", "UNSIGNED8": "0x0005", "REAL32": "0x0008"}
ROWS = [("INTEGER16", "-5"), ("INTEGER16", "0xFFFB"), ("UNSIGNED8", "010"), ("REAL32", "0x3FC00000")]
with open("drive.eds", "w") as file:
    file.write(HEAD)
    for k, (kind, default) in enumerate(ROWS):
        limit = "LowLimit=0xFFFB\n" if kind == "INTEGER16" else ""
        file.write(f"[{2000 + k}]\nParameterName=p{k}\nObjectType=0x7\nDataType={TYPES[kind]}\nAccessType=rw\n")
        file.write(f"{limit}DefaultValue={default}\nPDOMapping=0\n")
node = canopen.LocalNode(5, "drive.eds")
for k, (kind, default) in enumerate(ROWS):
    variable = node.object_dictionary[0x2000 + k]
    try:
        answer = repr(node.sdo[0x2000 + k].raw)
    except Exception as error:
        answer = f"{type(error).__name__}: {error}"
    print(f"{kind} {default}: default {variable.default}, lowest {variable.min}, over SDO {answer}")
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
