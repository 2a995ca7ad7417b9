#!/usr/bin/env bash
# simavr sends a byte of 8N1 in eleven bit times, and doubles the rate of U2X0 only if that bit is set before UBRR0.
#
# Versions: simavr, libsimavr2 1.6+dfsg-3, gcc-avr 1:5.4.0+Atmel3.6.2-3, avr-libc 1:2.0.0+Atmel3.6.2-3 of Debian 12.
# Date: 2026-11-29, x86-64.
# Usual guess: a start bit, eight bits and a stop bit are ten bit times of 16 (UBRR0 + 1) cycles, or of 8 (UBRR0 + 1) with
# U2X0, whatever is written first (ATmega328P data sheet, section 19).
# Behaviour: bytes follow one another after 11.0 bit times. With U2X0 set behind UBRR0 it is 22: the rate stays as it was. Time a
# link of a simulated board on the chip's data, not on the simulator: it is a tenth too slow.
#
# Output seen:
seen=$(
    cat <<'SEEN'
U2X0 clear: 11.0 bit times a byte
U2X0 set, then UBRR0: 11.0 bit times a byte
UBRR0, then U2X0 set: 22.0 bit times a byte
SEEN
)
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
apt-get download -qq simavr=1.6+dfsg-3 libsimavr2=1.6+dfsg-3 libelf1 zlib1g \
    gcc-avr=1:5.4.0+Atmel3.6.2-3 avr-libc=1:2.0.0+Atmel3.6.2-3 binutils-avr 2>/dev/null
for package in *.deb; do dpkg -x "$package" root; done
export PATH=$folder/root/usr/bin:$PATH LD_LIBRARY_PATH=$folder/root/usr/lib/x86_64-linux-gnu
cat >uart.c <<'PROGRAM'
#include <avr/io.h>
#include <stdint.h>
static void put(char c) { while (!(UCSR0A & (1 << UDRE0))) { } UDR0 = c; }
static void number(uint32_t n) { if (n >= 10) { number(n / 10); } put('0' + n % 10); }
/* counts of the timer (64 cycles) that 16 bytes take behind two that fill the shift register and the buffer */
static uint16_t bytes(void)
{
    put('.'); put('.');
    while (!(UCSR0A & (1 << UDRE0))) { }
    TCNT1 = 0;
    for (uint8_t k = 0; k < 16; k++) { put('.'); while (!(UCSR0A & (1 << UDRE0))) { } }
    return TCNT1;
}
int main(void)
{
    static const uint16_t bit[3] = {16 * 104, 8 * 104, 8 * 52}; /* cycles */
    uint16_t counts[3];
    TCCR1B = 3;
    UCSR0C = 3 << UCSZ00;
    UCSR0B = 1 << TXEN0;
    UCSR0A = 0; UBRR0 = 103; counts[0] = bytes();
    UCSR0A = 1 << U2X0; UBRR0 = 103; counts[1] = bytes();
    UCSR0A = 0; UBRR0 = 51; UCSR0A = 1 << U2X0; counts[2] = bytes();
    for (uint8_t k = 0; k < 3; k++) { put('\n'); number(counts[k] * 640ul / bit[k] / 16); }
    put('\n');
    for (;;) { }
}
PROGRAM
avr-gcc -Os -mmcu=atmega328p uart.c -o uart.elf
now=$(
    { timeout 20 simavr -m atmega328p -f 16000000 uart.elf 2>&1 || true; } |
        sed -E 's/\x1b\[[0-9]+m//g' | grep -aoE '^[0-9]+' |
        paste - <(printf '%s\n' "U2X0 clear" "U2X0 set, then UBRR0" "UBRR0, then U2X0 set") |
        awk -F'\t' '{ printf "%s: %.1f bit times a byte\n", $2, $1 / 10 }'
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
