#!/usr/bin/env bash
# avr-gcc joins two interrupt routines of equal bodies into one that calls the other, whose end enables interrupts.
#
# Versions: gcc-avr 1:5.4.0+Atmel3.6.2-3, avr-libc 1:2.0.0+Atmel3.6.2-3, binutils-avr of Debian 12. Date: 2026-11-28, x86-64.
# Usual guess: ISR(INT0_vect) and ISR(INT1_vect) with the same statements are two routines, each runs with interrupts disabled.
# Behaviour: at -Os (-fipa-icf) one vector saves fourteen registers and calls the other vector, which ends with reti. Interrupts are
# enabled inside the first routine from there on, before its registers are restored, and it takes twice the cycles and stack.
# For a quadrature encoder on both external interrupts: write one routine and ISR_ALIASOF, or compile with -fno-ipa-icf.
#
# Output seen:
seen=$(
    cat <<'SEEN'
-Os: INT0 or INT1 calls the other one: 1, reti: 2
-Os -fno-ipa-icf: INT0 or INT1 calls the other one: 0, reti: 2
SEEN
)
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
apt-get download -qq gcc-avr=1:5.4.0+Atmel3.6.2-3 avr-libc=1:2.0.0+Atmel3.6.2-3 binutils-avr 2>/dev/null
for package in *.deb; do dpkg -x "$package" root; done
export PATH=$folder/root/usr/bin:$PATH
cat >encoder.c <<'PROGRAM'
#include <avr/interrupt.h>
volatile unsigned char count;
static inline void edge(void)
{
    if (PIND & 4) {
        count = count + 1;
        if (PIND & 8) { count = count + 3; }
    } else {
        count = count - 1;
        if (PINB & 1) { count = count ^ 5; }
    }
}
ISR(INT0_vect) { edge(); }
ISR(INT1_vect) { edge(); }
int main(void) { sei(); for (;;) { } }
PROGRAM
now=$(
    for flags in "-Os" "-Os -fno-ipa-icf"; do
        avr-gcc $flags -mmcu=atmega328p encoder.c -o encoder.elf
        text=$(avr-objdump -d encoder.elf)
        calls=$(grep -cE 'r?call.*<__vector_[12]>' <<<"$text" || true)
        echo "$flags: INT0 or INT1 calls the other one: $calls, reti: $(grep -c reti <<<"$text")"
    done
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
