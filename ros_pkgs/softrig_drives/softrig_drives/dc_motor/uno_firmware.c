/* Speed control of a DC motor on an Arduino Uno (ATmega328P, 16 MHz), without the Arduino core.
 *
 * Each 10 ms: the encoder's count and the INA219's current go to the exported controller LAW, and its voltage to the
 * PWM of OC1A (pin 9) with the direction on pins 7 and 8, an L298 bridge. Encoder on pins 2 and 3, INA219 on A4, A5.
 */
#include LAW_HEADER
#include "uno_pwm.h"

#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/sleep.h>
#include <stddef.h>
#include <stdint.h>

#define INA219 0x40u
#define INA219_CURRENT 0x04u

static volatile int32_t count;
static volatile uint8_t due;
static LAW controller;

/* Quadrature: the count goes up where A leads B. */
static void edge(void)
{
    static uint8_t before;
    const uint8_t now = (uint8_t)((PIND >> 2) & 3u);
    static const int8_t moved[16] = { 0, 1, -1, 0, -1, 0, 0, 1, 1, 0, 0, -1, 0, -1, 1, 0 };
    count += moved[(uint8_t)((before << 2) | now)];
    before = now;
}

ISR(INT0_vect) { edge(); }
/* not a second body: avr-gcc 5.4 folds equal ones, and the first calls the second, whose reti enables interrupts */
ISR(INT1_vect, ISR_ALIASOF(INT0_vect));

ISR(TIMER2_COMPA_vect)
{
    static uint8_t ms;
    ms++;
    if (ms == 10u) {
        ms = 0;
        due = 1u;
    }
}

#ifdef HAS_CURRENT
static void twi(uint8_t control)
{
    TWCR = (uint8_t)((1u << TWINT) | (1u << TWEN) | control);
    while ((TWCR & (1u << TWINT)) == 0u) {
    }
}

static void twi_stop(void)
{
    TWCR = (uint8_t)((1u << TWINT) | (1u << TWEN) | (1u << TWSTO));
}

/* The current register of the INA219, in steps of its calibration. */
static int16_t current(void)
{
    uint16_t value;
    twi(1u << TWSTA);
    TWDR = (uint8_t)(INA219 << 1);
    twi(0);
    TWDR = INA219_CURRENT;
    twi(0);
    twi(1u << TWSTA);
    TWDR = (uint8_t)((INA219 << 1) | 1u);
    twi(0);
    twi(1u << TWEA);
    value = (uint16_t)((uint16_t)TWDR << 8);
    twi(0);
    value |= TWDR;
    twi_stop();
    return (int16_t)value;
}
#endif

static void drive(int16_t m)
{
    if (m > 0) {
        PORTB &= (uint8_t)~(1u << PB0);
        PORTD |= (uint8_t)(1u << PD7);
    } else if (m < 0) {
        PORTD &= (uint8_t)~(1u << PD7);
        PORTB |= (uint8_t)(1u << PB0);
    } else {
        PORTD &= (uint8_t)~(1u << PD7);
        PORTB &= (uint8_t)~(1u << PB0);
    }
    OCR1A = (uint16_t)((m < 0) ? -m : m);
}

static void tick(int32_t *before, int64_t t_ns)
{
    LAW_IN in = { 0 };
    LAW_OUT out;
    int32_t now;
    cli();
    now = count;
    sei();
    GPIOR0 = 1;
    in.state[0] = (real_t)(now - *before) * SR_REAL(SPEED_PER_COUNT);
    in.has_reference = true;
    in.reference[0] = SR_REAL(SET_POINT);
#ifdef HAS_CURRENT
    in.sensors[0] = (real_t)now;
    in.sensors[1] = (real_t)current() * SR_REAL(CURRENT_LSB);
#endif
    *before = now;
    drive((LAW_STEP(&controller, &in, &out, t_ns) == SR_DONE) ? pwm_of(out.command[0]) : 0);
    GPIOR0 = 0;
}

int main(void)
{
    int32_t before = 0;
    int64_t t_ns = 0;
    DDRB = (1u << PB0) | (1u << PB1);
    DDRD = (1u << PD7);
    TWBR = 12; /* 400 kHz */
    EICRA = (1u << ISC00) | (1u << ISC10); /* each edge of both channels */
    EIMSK = (1u << INT0) | (1u << INT1);
    TCCR2A = (1u << WGM21); /* 1 ms: 250 steps of 4 us */
    OCR2A = 249;
    TIMSK2 = (1u << OCIE2A);
    LAW_INIT(&controller, NULL);
    TCCR1A = (1u << COM1A1) | (1u << WGM10); /* PWM of 8 bits: phase correct 490 Hz, fast 977 Hz */
#ifdef PHASE_CORRECT
    TCCR1B = (1u << CS11) | (1u << CS10);
#else
    TCCR1B = (1u << WGM12) | (1u << CS11) | (1u << CS10);
#endif
    TCCR2B = (1u << CS22);
    sei();
    set_sleep_mode(SLEEP_MODE_IDLE);
    for (;;) {
        tick(&before, t_ns);
        t_ns += 10000000;
        cli();
        while (due == 0u) {
            sleep_enable();
            sei();
            sleep_cpu();
            sleep_disable();
            cli();
        }
        due = 0;
        sei();
    }
}
