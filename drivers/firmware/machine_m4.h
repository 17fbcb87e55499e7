/* What QEMU's machine mps2-an386 offers beside the processor. */
#ifndef MACHINE_M4_H
#define MACHINE_M4_H

#include <stdint.h>

void reset(void);
void machine_print(const char *text); /* to the emulator's console */
void machine_exit(int failed);        /* of the emulator */

#define MACHINE_HERTZ 25000000u /* of its timers */
#define TIMER0_CONTROL (*(volatile uint32_t *)0x40000000u)
#define TIMER0_VALUE (*(volatile uint32_t *)0x40000004u) /* counts down */
#define TIMER0_RELOAD (*(volatile uint32_t *)0x40000008u)
#define UART0_DATA (*(volatile uint32_t *)0x40004000u)
#define UART0_STATE (*(volatile uint32_t *)0x40004004u)
#define UART_FULL 1u     /* what was written last has not been sent */
#define UART_RECEIVED 2u /* a byte is waiting */
#define UART0_CONTROL (*(volatile uint32_t *)0x40004008u)
#define UART_ENABLE 3u   /* both ways */
#define UART0_DIVIDER (*(volatile uint32_t *)0x40004010u)

static inline void machine_start_timer(void)
{
    TIMER0_RELOAD = 0xFFFFFFFFu;
    TIMER0_VALUE = 0xFFFFFFFFu;
    TIMER0_CONTROL = 1u;
}

#endif
