/* The exported law as a step of the library (hapticrender.jit): the simulated plate and recorded samples drive it. */
#include <stddef.h>

#include "law.h"

typedef struct {
    int64_t drive, inputs, noise, sensed, motion, position, waveform, target, flags; /* addresses */
} signals_t;

size_t law_size(void) { return sizeof(law_t); }

/* Advance the law at the address `state` by rows `start` to `start + count - 1` of the signals. */
int64_t law_rows(int64_t state, int64_t signals, int64_t start, int64_t count)
{
    law_t *law = (law_t *)(intptr_t)state;
    const signals_t *io = (const signals_t *)(intptr_t)signals;
    const double *sensed = (const double *)(intptr_t)io->sensed;
    const double *position = (const double *)(intptr_t)io->position;
    const double *waveform = (const double *)(intptr_t)io->waveform;
    double *drive = (double *)(intptr_t)io->drive;
    int64_t *flags = (int64_t *)(intptr_t)io->flags;
    for (int64_t n = start; n < start + count; n++) {
        real_t y[LAW_SENSORS];
        real_t u[LAW_CHANNELS];
        for (int64_t i = 0; i < LAW_SENSORS; i++) {
            y[i] = (real_t)sensed[n * LAW_SENSORS + i];
        }
        flags[n] |= (int64_t)law_step(law, y, (real_t)position[n], REAL(0.0), (real_t)waveform[n], u);
        for (int64_t i = 0; i < LAW_CHANNELS; i++) {
            drive[n * LAW_CHANNELS + i] = (double)u[i];
        }
    }
    return 0;
}
