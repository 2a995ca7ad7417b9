"""The motor behind a simulated Uno: peripherals against the data sheet, limits before casts, the paper's hardware."""

import math
import shutil
import struct
import subprocess

import pytest
from board_by_hand import UNO
from softrig_core import ScenarioError, simulate
from softrig_core.board.simavr import HEADER, compiled
from softrig_core.firmware.check import DEBIAN
from softrig_drives.dc_motor.uno import ROW, DcMotorUnoParams, built, firmware_files, simulator_of

pytestmark = pytest.mark.skipif(
    not (shutil.which("avr-gcc") and HEADER.is_file() and shutil.which("cc")),
    reason=f"needs an AVR compiler and simavr (Debian: {DEBIAN})",
)
SPEED = "motor/true_state/shaft/velocity"
P = DcMotorUnoParams()
BRIDGE = P.vmax - P.bridge_drop  # V, the highest voltage of the bridge


def rows(firmware, *times):
    """The output of the simulator at times in ms."""
    stamps = b"".join(struct.pack("<q", t * 1_000_000) for t in times)
    done = subprocess.run([simulator_of(P), firmware], input=stamps, capture_output=True, check=True, timeout=60)
    return list(ROW.iter_unpack(done.stdout))


def test_the_run_equals_that_of_the_digital_rig_and_repeats():
    first, again, digital = (
        simulate(name, duration=0.5) for name in ("dc_motor_smc_uno", "dc_motor_smc_uno", "dc_motor_smc_b1")
    )
    assert {k: t.data for k, t in first.recording.topics.items()} == {
        k: t.data for k, t in again.recording.topics.items()
    }
    speed, other = (r.signals[SPEED].x for r in (first, digital))
    # rad/s, the effect of one count on the speed.
    assert max(abs(a - b) for a, b in zip(speed, other, strict=True)) < 0.42
    assert max(speed) > 4.0
    assert simulate("dc_motor_smc_uno", duration=0.1).blocks["dc_motor_uno"].x.row[7] > 2000  # cycles of a tick


@pytest.mark.long
@pytest.mark.parametrize("name", UNO)
def test_the_hardware_section_of_the_paper_is_reproduced(name):
    run = simulate(name)
    assert [r.name for r in run.results if r.passed is not True and r.limited] == []


PWM = """
#include <avr/io.h>
#include <avr/sleep.h>
int main(void)
{
    DDRB = 3; DDRD = 0x80; PORTD = 0x80; EIMSK = 3;
    OCR1A = LEVEL;
    TCCR1A = (1 << COM1A1) | (1 << WGM10);
    TCCR1B = MODE | (1 << CS11) | (1 << CS10);
    for (;;) { }
}
"""


@pytest.mark.parametrize(
    ("mode", "level", "duty"),
    [
        ("(1 << WGM12)", 0, 1 / 256),  # ATmega328P data sheet, 16.9.3: OCR = 0 gives a narrow spike
        ("(1 << WGM12)", 127, 1 / 2),
        ("(1 << WGM12)", 255, 1.0),
        ("0", 0, 0.0),  # data sheet, 16.9.4: 0 gives a low output, TOP a high one
        ("0", 127, 127 / 255),
        ("0", 255, 1.0),
    ],
)
def test_pwm_has_the_duty_of_the_data_sheet(mode, level, duty):
    text = f"#define MODE {mode}\n#define LEVEL {level}\n{PWM}"
    whole = 51 if mode == "0" else 128  # ms: 25 periods of 510 steps of 4 us, or 125 periods of 256
    _, last = rows(built({"pwm.c": text}, "pwm"), 10, 10 + whole)
    assert last[6] == pytest.approx(duty * BRIDGE, abs=1e-3 * BRIDGE)


LAW = """
#ifndef LAW_H
#define LAW_H
#include "softrig_c.h"
typedef struct { uint8_t nothing; } law;
typedef struct { real_t state[1]; bool has_reference; real_t reference[1]; } law_in;
typedef struct { real_t command[1]; } law_out;
static void law_init(law *l, const void *p) { (void)l; (void)p; }
static int law_step(law *l, const law_in *in, law_out *out, int64_t t)
{
    (void)l; (void)in; (void)t;
    out->command[0] = VOLTAGE;
    return 0;
}
#endif
"""
VOLTAGES = {
    "-1 below": ("-13.0f", -1.0),
    "beyond": ("12.1f", 1.0),
    "far": ("1e30f", 1.0),
    "NaN": ("NAN", 0.0),
    "infinite": ("-INFINITY", -1.0),
    "half": ("6.0f", 128 / 255),
    "none": ("0.0f", 0.0),
}


@pytest.mark.parametrize(("voltage", "part"), VOLTAGES.values(), ids=VOLTAGES)
def test_a_voltage_is_limited_before_it_becomes_a_register(voltage, part, tmp_path):
    from importlib import resources

    support = (resources.files("softrig_core.export") / "softrig_c.h").read_text()
    lines = '#define SR_FLOAT\n#define LAW_HEADER "law.h"\n#define LAW law\n#define VMAX 12.0\n#define SET_POINT 1.0\n'
    lines += "#define LAW_IN law_in\n#define LAW_OUT law_out\n#define LAW_STEP law_step\n#define LAW_INIT law_init\n"
    lines += f"#define SPEED_PER_COUNT 1.0\n#define CURRENT_LSB 1.0\n#define VOLTAGE SR_REAL({voltage})\n"
    files = {"softrig_c.h": support, "law.h": LAW} | firmware_files(lines)
    (row,) = rows(built(files, "limits"), 5)
    assert row[3] == pytest.approx(part * BRIDGE)
    # Run the same lines on this machine.
    for name in ("softrig_c.h", "law.h", "uno_pwm.h"):
        (tmp_path / name).write_text(files[name])
    main = f'#include <stdio.h>\n{lines}#include "law.h"\n#include "uno_pwm.h"\n'
    main += 'int main(void) { printf("%d", pwm_of(VOLTAGE)); }\n'
    (tmp_path / "main.c").write_text(main)
    subprocess.run(["cc", "-std=c99", "-o", "main", "main.c", "-lm"], cwd=tmp_path, check=True, capture_output=True)
    printed = subprocess.run([tmp_path / "main"], capture_output=True, text=True, check=False).stdout
    assert int(printed) == round(part * 255)


def test_a_controller_with_other_ports_is_refused():
    with pytest.raises(ScenarioError, match="cannot run on the Uno of this rig: expected the inputs state, reference"):
        simulate(
            "dc_motor_smc_uno",
            duration=0.1,
            overrides={"dc_motor_uno.scenario": "induction_dtc", "dc_motor_uno.controller": "speed_controller"},
        )


def test_the_speed_follows_from_the_counts_of_the_encoder():
    run = simulate("dc_motor_smc_uno_soft", duration=1.0)
    theta = run.signals["motor/true_state/shaft/position"].x
    count = run.signals["motor/sensors/encoder_count/position"].x
    assert [math.floor(a * P.counts_per_rev / math.tau) for a in theta] == list(count)
    assert count[-1] > 1000


# Runs the firmware until it sets GPIOR0, and prints GPIOR1 and GPIOR2. Argument 2 is the voltage at pin A0 in mV.
PROBE = """
#include <stdio.h>
#include <stdlib.h>
#include <simavr/avr_adc.h>
#include <simavr/sim_avr.h>
#include <simavr/sim_elf.h>
static void silent(avr_t *avr, const int level, const char *format, va_list given)
{
    (void)avr; (void)level; (void)format; (void)given;
}
int main(int argc, char **argv)
{
    static elf_firmware_t firmware;
    avr_t *avr = avr_make_mcu_by_name("atmega328p");
    if (argc != 3 || avr == NULL) { return 2; }
    avr_global_logger_set(silent);
    if (elf_read_firmware(argv[1], &firmware) != 0) { return 2; }
    avr_init(avr);
    avr->frequency = 16000000;
    avr_load_firmware(avr, &firmware);
    avr->vcc = avr->avcc = avr->aref = 5000;
    avr_raise_irq(avr_io_getirq(avr, AVR_IOCTL_ADC_GETIRQ, 0), (uint32_t)atoi(argv[2]));
    while (avr->data[0x3E] == 0 && avr->cycle < 16000000) { avr_run(avr); }
    printf("%d", avr->data[0x4A] | (avr->data[0x4B] << 8));
    return avr->data[0x3E] == 0;
}
"""
ADC = """
#include <avr/io.h>
static void convert(void) { ADCSRA |= 1 << ADSC; while (ADCSRA & (1 << ADSC)) { } }
int main(void)
{
    TCCR1B = 1 << CS10;
    ADMUX = 1 << REFS0; ADCSRA = (1 << ADEN) | 7; /* AVcc, a clock in 128 */
    convert();
    const uint16_t begin = TCNT1;
    convert();
    const uint16_t took = TCNT1 - begin, found = ADC, said = TOOK ? took : found;
    GPIOR1 = said & 255; GPIOR2 = said >> 8; GPIOR0 = 1;
    for (;;) { }
}
"""
UART = """
#include <avr/io.h>
static void send(uint8_t byte) { while (!(UCSR0A & (1 << UDRE0))) { } UDR0 = byte; }
int main(void)
{
    TCCR1B = 1 << CS11; /* a count is 8 cycles */
    UCSR0A = DOUBLE << U2X0; UBRR0 = DIVISOR; UCSR0C = 3 << UCSZ00; UCSR0B = 1 << TXEN0;
    for (uint8_t k = 0; k < 4; k++) { send(k); }
    const uint16_t begin = TCNT1;
    for (uint8_t k = 0; k < 16; k++) { send(k); }
    const uint16_t took = TCNT1 - begin;
    GPIOR1 = took & 255; GPIOR2 = took >> 8; GPIOR0 = 1;
    for (;;) { }
}
"""


def probed(text, millivolts=0):
    host = compiled({"main.c": PROBE}, ["-lsimavr", "-lelf"], "simavr_probe", DEBIAN)
    command = [host, built({"probe.c": text}, "probe"), str(millivolts)]
    return int(subprocess.run(command, capture_output=True, text=True, check=True, timeout=60).stdout)


def test_the_adc_has_the_codes_and_the_time_of_the_data_sheet():
    for millivolts in (0, 5, 1250, 2500, 3300, 4990, 5000):
        code = min(1024 * millivolts // 5000, 1023)  # data sheet, 24.7, has 1024; simavr multiplies by 1023
        assert code - 1 <= probed(f"#define TOOK 0\n{ADC}", millivolts) <= code
    # Table 24-1 has 13 ADC clocks; the polling loop adds some cycles.
    assert probed(f"#define TOOK 1\n{ADC}") == pytest.approx(13 * 128, abs=24)


@pytest.mark.parametrize(("double", "divisor"), [(1, 16), (0, 8), (0, 103)])
def test_a_byte_takes_eleven_bits_in_simavr_and_ten_by_the_data_sheet(double, divisor):
    bit = (divisor + 1) * (8 if double else 16)  # cycles of a bit; data sheet, table 20-1
    elapsed = probed(f"#define DOUBLE {double}\n#define DIVISOR {divisor}\n{UART}") * 8 / 16
    # simavr uses 11 bits; a start, eight data and a stop bit are 10.
    assert elapsed == pytest.approx(11 * bit, rel=0.01)
