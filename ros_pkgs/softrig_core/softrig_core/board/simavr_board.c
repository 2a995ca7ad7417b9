/* A board with an AVR under simavr: its first serial port is this program's standard input and output.
 *
 * At the end (standard input closes) it writes to standard error, as JSON, the cycles of the longest step that the
 * firmware marked in GPIOR0, the lowest stack pointer and the cycles that it ran.
 */
#include <poll.h>
#include <signal.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include <simavr/avr_uart.h>
#include <simavr/sim_avr.h>
#include <simavr/sim_elf.h>

#define GPIOR0 0x3E
#define UCSR0B 0xC1 /* of an ATmega328P, with RXEN0 */
#define RXEN0 0x10
#define SLICE 400        /* cycles between two looks at the input */
#define AFTER 4000       /* cycles after the end of an answer: then the firmware can only wait */
#define SILENCE 4000000  /* cycles without a byte in either direction, likewise */

static uint8_t in[65536], out[4096];
static size_t in_at, in_end, out_end;
static bool may_send = true;
static avr_cycle_count_t last, frame_end, begun, longest;
static avr_t *avr;
static int wire;

static void flush_out(void)
{
    size_t at = 0;
    while (at < out_end) {
        ssize_t n = write(wire, out + at, out_end - at);
        if (n <= 0) {
            exit(0);
        }
        at += (size_t)n;
    }
    out_end = 0;
}

static void byte_out(struct avr_irq_t *irq, uint32_t value, void *param)
{
    (void)irq;
    (void)param;
    out[out_end++] = (uint8_t)value;
    last = avr->cycle;
    if (value == 0u || out_end == sizeof out) {
        flush_out();
        frame_end = avr->cycle;
    }
}

static void xon(struct avr_irq_t *irq, uint32_t value, void *param)
{
    (void)irq;
    (void)value;
    (void)param;
    may_send = true;
}

static void xoff(struct avr_irq_t *irq, uint32_t value, void *param)
{
    (void)irq;
    (void)value;
    (void)param;
    may_send = false;
}

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

int main(int argc, char **argv)
{
    elf_firmware_t firmware;
    memset(&firmware, 0, sizeof firmware);
    wire = dup(1); /* libsimavr writes to standard output */
    dup2(2, 1);
    signal(SIGPIPE, SIG_IGN);
    if (argc < 2 || elf_read_firmware(argv[1], &firmware) != 0) {
        fprintf(stderr, "cannot read the firmware\n");
        return 2;
    }
    if (firmware.mmcu[0] == 0) {
        strcpy(firmware.mmcu, "atmega328p");
    }
    if (firmware.frequency == 0) {
        firmware.frequency = 16000000;
    }
    avr = avr_make_mcu_by_name(firmware.mmcu);
    if (avr == NULL) {
        fprintf(stderr, "simavr does not know %s\n", firmware.mmcu);
        return 2;
    }
    const bool uno = strncmp(firmware.mmcu, "atmega328", 9) == 0;
    avr_init(avr);
    avr->log = LOG_NONE;
    avr_load_firmware(avr, &firmware);
    avr->frequency = firmware.frequency;
    uint32_t flags = 0;
    avr_ioctl(avr, AVR_IOCTL_UART_SET_FLAGS('0'), &flags);
    avr_irq_t *input = avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_INPUT);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUTPUT), byte_out, NULL);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUT_XON), xon, NULL);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUT_XOFF), xoff, NULL);
    avr_register_io_write(avr, GPIOR0, mark, NULL);
    uint32_t lowest = UINT32_MAX;
    for (;;) {
        const avr_cycle_count_t until = avr->cycle + SLICE;
        int state = cpu_Running;
        while (avr->cycle < until) {
            state = avr_run(avr);
            if (state == cpu_Done || state == cpu_Crashed) {
                fprintf(stderr, "the firmware has ended\n");
                return 3;
            }
            const uint32_t sp = avr->data[R_SPL] | ((uint32_t)avr->data[R_SPH] << 8);
            lowest = (sp != 0u && sp < lowest) ? sp : lowest;
        }
        /* what comes before the firmware has set up its port is lost on a board; here it waits */
        const bool hears = !uno || (avr->data[UCSR0B] & RXEN0) != 0;
        while (hears && may_send && in_at < in_end) {
            avr_raise_irq(input, in[in_at++]);
            last = avr->cycle;
        }
        if (in_at == in_end) {
            const bool waits = (frame_end == last && avr->cycle - last > AFTER) || avr->cycle - last > SILENCE;
            struct pollfd look = { .fd = 0, .events = POLLIN, .revents = 0 };
            if (waits && out_end != 0) {
                flush_out();
            }
            if (poll(&look, 1, waits ? -1 : 0) > 0) {
                const ssize_t n = read(0, in, sizeof in);
                if (n <= 0) {
                    break;
                }
                in_at = 0;
                in_end = (size_t)n;
                last = avr->cycle;
            }
        }
    }
    fprintf(stderr, "{\"cycles\": %llu, \"lowest\": %lu, \"ran\": %llu}\n", (unsigned long long)longest,
            (unsigned long)lowest, (unsigned long long)avr->cycle);
    return 0;
}
