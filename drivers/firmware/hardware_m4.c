/*
 * The board on a bare Cortex-M4, as QEMU emulates it (mps2-an386): its serial line is the machine's first UART, its
 * sensors and coils are those of a plate model, and the finger is where the host sends it.
 */
#include "board.h"
#include "hardware.h"
#include "machine_m4.h"
#include "plate.h"

#if LAW_CHANNELS != 2 && !LAW_FRICTION
#error "the plate model has two coils: write the functions of hardware.h for another device"
#endif

#define TICK (MACHINE_HERTZ / (uint32_t)design.rate)

const uint32_t hardware_cycle_rate = MACHINE_HERTZ;

static board_t board;
static plate_t plate = PLATE_DEFAULT;

uint32_t hardware_cycles(void) { return ~TIMER0_VALUE; }

/* At least a tick of the timer; an emulated plate takes longer, which the board's own clock does not see. */
uint32_t hardware_wait(void)
{
    static uint32_t last;
    plate_advance(&plate, board.position, board.finger.load);
    while (hardware_cycles() - last < TICK) {
    }
    last = hardware_cycles();
    return 1u;
}

void hardware_sense(real_t sensed[]) { plate_sense(&plate, sensed); }

void hardware_drive(const real_t drive[]) { plate_drive(&plate, drive); }

size_t hardware_read(uint8_t bytes[], size_t most)
{
    size_t count = 0u;
    while ((count < most) && ((UART0_STATE & UART_RECEIVED) != 0u)) {
        bytes[count++] = (uint8_t)UART0_DATA;
    }
    return count;
}

size_t hardware_write(const uint8_t bytes[], size_t count)
{
    size_t written = 0u;
    while ((written < count) && ((UART0_STATE & UART_FULL) == 0u)) {
        UART0_DATA = bytes[written++];
    }
    return written;
}

int main(void)
{
    machine_start_timer();
    UART0_DIVIDER = 16u;
    UART0_CONTROL = UART_ENABLE;
    board_init(&board);
    for (;;) {
        board_tick(&board, hardware_wait());
    }
}
