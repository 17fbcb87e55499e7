/* Start of a bare Cortex-M4 with its floating-point unit, in QEMU; the C library is used without its own start. */
#include "machine_m4.h"

extern uint32_t data_load[], data_start[], data_end[], bss_start[], bss_end[], stack_end[]; /* of m4.ld */
int main(void);

#define CPACR (*(volatile uint32_t *)0xE000ED88u) /* coprocessor access control */
#define FPU_FULL_ACCESS (0xFu << 20)
#define SYS_WRITE0 0x04u
#define SYS_EXIT 0x18u
#define STOPPED_BY_ERROR 0x20023u     /* ADP_Stopped_RunTimeErrorUnknown */
#define STOPPED_BY_END 0x20026u       /* ADP_Stopped_ApplicationExit */

/* Request a service of the emulator (Arm's semihosting). */
static void request(uint32_t service, uintptr_t argument)
{
    register uint32_t r0 __asm__("r0") = service;
    register uintptr_t r1 __asm__("r1") = argument;
    __asm__ volatile("bkpt 0xAB" : "+r"(r0) : "r"(r1) : "memory");
}

void machine_print(const char *text) { request(SYS_WRITE0, (uintptr_t)text); }

void machine_exit(int failed)
{
    request(SYS_EXIT, (failed != 0) ? STOPPED_BY_ERROR : STOPPED_BY_END);
    for (;;) {
    }
}

static void fault(void)
{
    machine_print("fault\n");
    machine_exit(1);
}

void reset(void)
{
    CPACR |= FPU_FULL_ACCESS;
    __asm__ volatile("dsb\n isb");
    for (uint32_t i = 0u; &data_start[i] < data_end; i++) {
        data_start[i] = data_load[i];
    }
    for (uint32_t *at = bss_start; at < bss_end; at++) {
        *at = 0u;
    }
    machine_exit(main());
}

/* Initial stack, reset, and the faults; no interrupt is used. */
typedef union {
    void (*handler)(void);
    uint32_t *stack;
} vector_t;
__attribute__((section(".vectors"), used)) static const vector_t vectors[16] = {
    {.stack = stack_end}, {.handler = reset}, {.handler = fault}, {.handler = fault},
    {.handler = fault},   {.handler = fault}, {.handler = fault},
};
