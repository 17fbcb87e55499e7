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

#endif
