/* Start of a Cortex-M under qemu: the replay program reads its rows and prints by semihosting. Written by hand, no CMSIS. */
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

extern uint8_t __data_start__[], __data_end__[], __data_load__[], __bss_start__[], __bss_end__[], __stack[];
extern void initialise_monitor_handles(void);
int main(int argc, char **argv);
void Reset_Handler(void);
void _init(void);
void _fini(void);

void _init(void) {}
void _fini(void) {}

void Reset_Handler(void)
{
    *(volatile uint32_t *)0xE000ED88u |= 0xFu << 20; /* CPACR: the floating-point unit is off after a reset */
    memcpy(__data_start__, __data_load__, (size_t)(__data_end__ - __data_start__));
    memset(__bss_start__, 0, (size_t)(__bss_end__ - __bss_start__));
    initialise_monitor_handles();
    exit(main(0, NULL));
}

__attribute__((section(".vectors"), used)) static const void *vectors[16] = {__stack, (void *)Reset_Handler};
