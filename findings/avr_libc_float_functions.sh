#!/usr/bin/env bash
# avr-libc's pow of whole numbers is not whole, and its exp is off by some sixty units in the last place.
#
# Versions: gcc-avr 1:5.4.0+Atmel3.6.2-3, avr-libc 1:2.0.0+Atmel3.6.2-3, simavr 1.6+dfsg-3 (Debian 12). Date: 2026-11-28, x86-64.
# Usual guess: single precision functions of an Arduino's C library are within one unit in the last place, and pow(-2, 3) is -8.
# Behaviour: pow is exp(y log(x)) in single precision: pow(-2, 3) is -7.99999809, pow(10, 3) is 999.999817, so
# (int)pow(10, 3) is 999. exp(80) is wrong by 5e-6 of its value, exp(-80) likewise. exp(1) and sin(0.5) are right to 1 ulp.
# For a control law on a board: write x * x * x; a fuzzy set or a filter with exp has other bits than on the PC.
#
# Output seen (rows: ATmega328P in simavr; the host's double, rounded to float; distance in units in the last place):
seen=$(
    cat <<'SEEN'
pow(-2, 3) -7.99999809 for -8, 4 ulp
pow(10, 3) 999.999817 for 1000, 3 ulp
pow(5, 2)  24.9999981 for 25, 1 ulp
exp(1)     2.71828175 for 2.71828175, 0 ulp
exp(80)    5.54059475e+34 for 5.54062248e+34, 56 ulp
exp(-80)   1.80486037e-35 for 1.80485133e-35, 63 ulp
sin(0.5)   0.47942552 for 0.47942555, 1 ulp
SEEN
)
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
apt-get download -qq gcc-avr=1:5.4.0+Atmel3.6.2-3 avr-libc=1:2.0.0+Atmel3.6.2-3 binutils-avr simavr=1.6+dfsg-3 libsimavr2=1.6+dfsg-3 libelf1 2>/dev/null
for package in *.deb; do dpkg -x "$package" root; done
export PATH=$folder/root/usr/bin:$PATH LD_LIBRARY_PATH=$folder/root/usr/lib/x86_64-linux-gnu
cat >board.c <<'PROGRAM'
#include <avr/io.h>
#include <avr/sleep.h>
#include <avr/interrupt.h>
#include <math.h>
#include <stdint.h>
static void put(char c) { while (!(UCSR0A & (1 << UDRE0))) { } UDR0 = c; }
static void show(float x)
{
    union { float f; uint32_t u; } bits = { x };
    for (int8_t i = 28; i >= 0; i -= 4) { put("0123456789abcdef"[(bits.u >> i) & 15]); }
    put('\n');
}
int main(void)
{
    volatile float x, y;
    UBRR0 = 0;
    UCSR0B = 1 << TXEN0;
    x = -2; y = 3; show(pow(x, y));
    x = 10; y = 3; show(pow(x, y));
    x = 5; y = 2; show(pow(x, y));
    x = 1; show(exp(x));
    x = 80; show(exp(x));
    x = -80; show(exp(x));
    x = 0.5; show(sin(x));
    cli();
    sleep_mode();
    return 0;
}
PROGRAM
avr-gcc -mmcu=atmega328p -DF_CPU=16000000UL -O1 -o board.elf board.c -lm
timeout 60 simavr -m atmega328p -f 16000000 board.elf >raw 2>&1 || true
now=$(
    python3 - <<'PROGRAM'
import math
import re
import struct

words = re.findall(r"\b([0-9a-f]{8})\b", re.sub(r"\x1b\[[0-9;]*m", "", open("raw").read()))
exact = {"pow(-2, 3)": -8.0, "pow(10, 3)": 1000.0, "pow(5, 2)": 25.0, "exp(1)": math.exp(1), "exp(80)": math.exp(80),
         "exp(-80)": math.exp(-80), "sin(0.5)": math.sin(0.5)}
for (name, value), word in zip(exact.items(), words, strict=True):
    got, wanted = int(word, 16), struct.unpack("<I", struct.pack("<f", value))[0]
    print(f"{name:10} {struct.unpack('<f', struct.pack('<I', got))[0]:.9g} for {struct.unpack('<f', struct.pack('<I', wanted))[0]:.9g}, {abs(got - wanted)} ulp")
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
