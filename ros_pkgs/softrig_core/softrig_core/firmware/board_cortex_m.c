/* @NODE@ behind the link of softrig on a Cortex-M, without CMSIS: start-up, one serial port, SysTick.
 *
 * The port is the first CMSDK UART of Arm's MPS2 boards, which qemu has. On another board replace the three functions
 * `port_...` and the memory in board.ld. Written by `softrig export cortex-m`.
 */
#include "@NODE@_link.h"

#include <stddef.h>

#define REGISTER(address) (*(volatile uint32_t *)(address))

/* the serial port ------------------------------------------------------------------------------------------------- */

#define UART 0x40004000u
#define CLOCK 25000000u

static void port_init(void)
{
    REGISTER(UART + 0x10u) = CLOCK / @BAUD@u;
    REGISTER(UART + 0x08u) = 3u; /* send and receive */
}

static bool port_take(uint8_t *byte)
{
    if ((REGISTER(UART + 0x04u) & 2u) == 0u) {
        return false;
    }
    *byte = (uint8_t)REGISTER(UART);
    return true;
}

static void port_put(uint8_t byte)
{
    while ((REGISTER(UART + 0x04u) & 1u) != 0u) {
    }
    REGISTER(UART) = byte;
}

/* the core -------------------------------------------------------------------------------------------------------- */

static @NODE@_link board;

/* SysTick counts 24 bits down with the core's clock: steps up to 16.7 million ticks can be measured. */
static uint32_t ticks;
static uint32_t before;

static uint32_t now(void)
{
    const uint32_t value = REGISTER(0xE000E018u);
    ticks += (before - value) & 0xFFFFFFu;
    before = value;
    return ticks;
}

int main(void)
{
    REGISTER(0xE000E014u) = 0xFFFFFFu;
    REGISTER(0xE000E018u) = 0u;
    REGISTER(0xE000E010u) = 5u;
    port_init();
    @NODE@_link_init(&board, port_put, now);
    for (;;) {
        uint8_t byte;
        if (port_take(&byte)) {
            @NODE@_link_take(&board, byte);
        }
    }
}

extern uint32_t _data, _data_end, _data_load, _bss, _bss_end, _stack;
void reset_handler(void);
void fault_handler(void);

void reset_handler(void)
{
    uint32_t *from = &_data_load;
#if defined(__ARM_FP)
    REGISTER(0xE000ED88u) |= 0xF00000u; /* the FPU is off after a reset */
    __asm volatile("dsb\n\tisb");
#endif
    for (uint32_t *to = &_data; to < &_data_end; to++) {
        *to = *from++;
    }
    for (uint32_t *to = &_bss; to < &_bss_end; to++) {
        *to = 0;
    }
    (void)main();
    fault_handler();
}

void fault_handler(void)
{
    for (;;) {
    }
}

__attribute__((section(".vectors"), used)) static const void *const vectors[16] = {
    &_stack,       reset_handler, fault_handler, fault_handler, fault_handler, fault_handler,
    fault_handler, 0,             0,             0,             0,             fault_handler,
    fault_handler, 0,             fault_handler, fault_handler,
};
