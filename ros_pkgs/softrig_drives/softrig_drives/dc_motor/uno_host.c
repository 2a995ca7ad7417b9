/* An Arduino Uno under simavr with a DC motor at its pins: PWM, bridge, encoder, INA219. The motor is the exported
 * plant, stepped each 10 us with the mean of the voltage over that time.
 *
 * Standard input: times in ns (int64) up to which to run. Standard output, for each: ROW. With a file as second argument
 * it also writes time, voltage at the motor, current and speed each 10 us there.
 */
#include "dc_motor_plant.h"

#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include <simavr/avr_ioport.h>
#include <simavr/avr_twi.h>
#include <simavr/sim_avr.h>
#include <simavr/sim_elf.h>

#define HZ 16000000
#define SLOT 160 /* cycles of 10 us */
#define SLOT_NS 10000
#define GPIOR0 0x3E
#define TCCR1A 0x80
#define TCCR1B 0x81
#define OCR1A 0x88
#define PORTB 0x25
#define PORTD 0x2B
#define EIMSK 0x3D
#define TWO_PI 6.283185307179586

typedef struct {
    double theta, w, i;    /* of the motor */
    double applied;        /* what the PWM register stands for, V */
    double count, current; /* the encoder's count, and the current that the INA219 said last, A */
    double mean;           /* mean voltage at the motor since the row before, V */
    double longest;        /* cycles of the longest tick so far */
} row_t;

static avr_t *avr;
static int wire;
static avr_irq_t *pin_a, *pin_b, *twi_in;
static dc_motor_plant motor;
static dc_motor_plant_out shaft;
static int64_t slots;
static long edges; /* of the encoder, that the firmware has seen */
static double charge, measured;
static avr_cycle_count_t since, begun, longest;
static FILE *trace;

/* PWM ------------------------------------------------------------------------------------------------------------- */

static bool running, phase_correct;
static avr_cycle_count_t base; /* when the period under way began */
static uint16_t prescaler, level; /* `level` is the buffered OCR1A */

static avr_cycle_count_t period(void)
{
    return (avr_cycle_count_t)prescaler * (phase_correct ? 510u : 256u);
}

/* Cycles up to a phase of the period at which OC1A is high: ATmega328P data sheet, 16.9.3 and 16.9.4, not inverted. */
static avr_cycle_count_t high_until(avr_cycle_count_t phase)
{
    const avr_cycle_count_t n = (avr_cycle_count_t)level * prescaler;
    if (!phase_correct) {
        const avr_cycle_count_t end = n + prescaler; /* set at BOTTOM, cleared behind the match */
        return phase < end ? phase : end;
    }
    const avr_cycle_count_t rises = period() - n; /* cleared counting up, set counting down */
    return (phase < n ? phase : n) + (phase > rises ? phase - rises : 0);
}

static uint16_t word_at(uint16_t address)
{
    return (uint16_t)(avr->data[address] | (avr->data[address + 1] << 8));
}

/* Cycles since `since` in which OC1A was high; the buffered level changes between two periods. */
static double high_cycles(void)
{
    static const uint16_t of[8] = { 0, 1, 8, 64, 256, 1024, 0, 0 };
    const avr_cycle_count_t now = avr->cycle;
    avr_cycle_count_t high = 0, at = since;
    since = now;
    if (!running) {
        prescaler = of[avr->data[TCCR1B] & 7u];
        running = prescaler != 0 && (avr->data[TCCR1A] & 0xC0u) == 0x80u;
        phase_correct = (avr->data[TCCR1B] & 0x08u) == 0;
        base = now;
        level = word_at(OCR1A);
        return 0.0;
    }
    while (base + period() <= now) {
        high += high_until(period()) - high_until(at - base);
        base += period();
        at = base;
        level = word_at(OCR1A);
    }
    high += high_until(now - base) - high_until(at - base);
    return (double)high;
}

/* the motor ------------------------------------------------------------------------------------------------------- */

static double sign(void)
{
    const bool forwards = (avr->data[PORTD] & 0x80u) != 0, back = (avr->data[PORTB] & 1u) != 0;
    return (double)forwards - (double)back;
}

static void encoder(double theta)
{
    static const uint8_t phases[4] = { 0, 1, 3, 2 }; /* of B and A */
    const long now = (long)floor(theta * COUNTS_PER_REV / TWO_PI);
    if ((avr->data[EIMSK] & 3u) != 3u) {
        return; /* the firmware does not listen yet: the edges wait */
    }
    while (edges != now) {
        const uint8_t was = phases[edges & 3];
        edges += (now > edges) ? 1 : -1;
        const uint8_t is = phases[edges & 3];
        if ((was ^ is) & 1u) {
            avr_raise_irq(pin_a, is & 1u);
        } else {
            avr_raise_irq(pin_b, is >> 1);
        }
    }
}

static avr_cycle_count_t slot(avr_t *core, avr_cycle_count_t when, void *param)
{
    (void)param;
    (void)core;
    const avr_cycle_count_t length = avr->cycle - since;
    const double part = length > 0 ? high_cycles() / (double)length : 0.0;
    const double v = part * sign() * (VMAX - BRIDGE_DROP);
    dc_motor_plant_in in;
    memset(&in, 0, sizeof in);
    in.command[0] = v;
    charge += v;
    dc_motor_plant_advance(&motor, &in, slots * SLOT_NS);
    slots++;
    dc_motor_plant_outputs(&motor, &shaft, slots * SLOT_NS);
    encoder(shaft.state[0]);
    if (trace != NULL) {
        fprintf(trace, "%.5f %.4f %.6f %.6f\n", (double)slots * 1e-5, v, shaft.sensors[1], shaft.state[1]);
    }
    return when + SLOT;
}

/* INA219 ---------------------------------------------------------------------------------------------------------- */

static void twi_message(struct avr_irq_t *irq, uint32_t value, void *param)
{
    static bool chosen;
    static uint8_t at;
    static uint16_t answer;
    avr_twi_msg_irq_t got;
    (void)irq;
    (void)param;
    got.u.v = value;
    if (got.u.twi.msg & TWI_COND_STOP) {
        chosen = false;
    }
    if (got.u.twi.msg & TWI_COND_START) {
        chosen = (got.u.twi.addr >> 1) == 0x40u;
        at = 0;
        if (chosen) {
            double raw = nearbyint(shaft.sensors[1] / CURRENT_LSB);
            const double most = CURRENT_LIMIT / CURRENT_LSB;
            raw = raw > most ? most : raw < -most ? -most : raw;
            answer = (uint16_t)(int16_t)raw;
            measured = raw * CURRENT_LSB;
            avr_raise_irq(twi_in, avr_twi_irq_msg(TWI_COND_ACK, got.u.twi.addr, 1));
        }
    }
    if (chosen && (got.u.twi.msg & TWI_COND_WRITE)) {
        avr_raise_irq(twi_in, avr_twi_irq_msg(TWI_COND_ACK, got.u.twi.addr, 1));
    }
    if (chosen && (got.u.twi.msg & TWI_COND_READ)) {
        const uint8_t byte = (uint8_t)(at == 0 ? answer >> 8 : answer & 0xFFu);
        at++;
        avr_raise_irq(twi_in, avr_twi_irq_msg(TWI_COND_READ, got.u.twi.addr, byte));
    }
}

/* running --------------------------------------------------------------------------------------------------------- */

static void mark(struct avr_t *core, avr_io_addr_t address, uint8_t value, void *param)
{
    (void)param;
    core->data[address] = value;
    if (value != 0u) {
        begun = core->cycle;
    } else if (core->cycle - begun > longest) {
        longest = core->cycle - begun;
    }
}

static void no_sleep(struct avr_t *core, avr_cycle_count_t cycles)
{
    (void)core;
    (void)cycles; /* the simulator need not wait for the wall's clock */
}

int main(int argc, char **argv)
{
    elf_firmware_t firmware;
    int64_t until;
    memset(&firmware, 0, sizeof firmware);
    wire = dup(1); /* libsimavr writes to standard output */
    dup2(2, 1);
    if (argc < 2 || elf_read_firmware(argv[1], &firmware) != 0) {
        fprintf(stderr, "cannot read the firmware\n");
        return 2;
    }
    trace = (argc > 2) ? fopen(argv[2], "w") : NULL;
    avr = avr_make_mcu_by_name("atmega328p");
    if (avr == NULL) {
        return 2;
    }
    avr_init(avr);
    avr->log = LOG_NONE;
    avr_load_firmware(avr, &firmware);
    avr->frequency = HZ;
    avr->sleep = no_sleep;
    pin_a = avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ('D'), IOPORT_IRQ_PIN2);
    pin_b = avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ('D'), IOPORT_IRQ_PIN3);
    twi_in = avr_io_getirq(avr, AVR_IOCTL_TWI_GETIRQ(0), TWI_IRQ_INPUT);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_TWI_GETIRQ(0), TWI_IRQ_OUTPUT), twi_message, NULL);
    avr_register_io_write(avr, GPIOR0, mark, NULL);
    dc_motor_plant_init(&motor, NULL);
    dc_motor_plant_outputs(&motor, &shaft, 0);
    avr_raise_irq(pin_a, 0);
    avr_raise_irq(pin_b, 0);
    avr_cycle_timer_register(avr, SLOT, slot, NULL);
    while (read(0, &until, sizeof until) == (ssize_t)sizeof until) {
        const int64_t from = slots;
        charge = 0.0;
        while (slots * SLOT_NS < until) {
            const int state = avr_run(avr);
            if (state == cpu_Done || state == cpu_Crashed) {
                fprintf(stderr, "the firmware has ended at cycle %llu, address %#x, state %d\n", (unsigned long long)avr->cycle, (unsigned)avr->pc, state);
                return 3;
            }
        }
        const row_t row = {
            .theta = shaft.state[0], .w = shaft.state[1], .i = shaft.sensors[1],
            .applied = sign() * word_at(OCR1A) / 255.0 * (VMAX - BRIDGE_DROP),
            .count = (double)edges, .current = measured,
            .mean = slots > from ? charge / (double)(slots - from) : 0.0, .longest = (double)longest,
        };
        if (write(wire, &row, sizeof row) != (ssize_t)sizeof row) {
            break;
        }
    }
    if (trace != NULL) {
        fclose(trace);
    }
    return 0;
}
