/* What a board has to bring: six functions and the speed of its cycle counter.  hardware_posix.c fills them in for a
   process behind a pseudo-terminal with a plate model inside. */
#ifndef HARDWARE_H
#define HARDWARE_H

#include <stddef.h>
#include <stdint.h>

#include "real.h"

extern const uint32_t hardware_cycle_rate;        /* Hz of hardware_cycles */

/* Counter of cycles; wraps. */
uint32_t hardware_cycles(void);

/* Wait for the next tick of the sample timer.  Return the ticks since the last call: 1, more where some were missed,
   0 to end the program. */
uint32_t hardware_wait(void);

/* Sample every sensor (m) now, at the start of the interval. */
void hardware_sense(real_t sensed[]);

/* Hand over the drive (A, finite, within the limits) that acts from the next tick on. */
void hardware_drive(const real_t drive[]);

/* Take at most `most` bytes that have arrived from the host; never waits.  Return how many. */
size_t hardware_read(uint8_t bytes[], size_t most);

/* Send bytes to the host as far as they can be taken at once; never waits.  Return how many. */
size_t hardware_write(const uint8_t bytes[], size_t count);

#endif
