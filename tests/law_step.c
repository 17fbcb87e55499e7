/* The exported law as a step of the library (hapticrender.jit): the simulated plate and recorded samples drive it. */
#include <stddef.h>

#include "supervisor.h"

typedef struct {
    int64_t drive, inputs, noise, sensed, motion, position, waveform, target, flags; /* addresses */
} signals_t;

size_t law_size(void);
void law_start(int64_t state);
uint32_t law_limit(int64_t state, double limit);
uint32_t law_gain(int64_t state, double gain);
uint32_t law_bands(int64_t state, const double rows[], uint32_t count);
void law_envelope(int64_t state, uint32_t band, double envelopes[4]);
void law_covariance(int64_t state, double covariance[LAW_PARAMETERS * LAW_PARAMETERS]);
double law_differs(int64_t state);
int64_t law_rows(int64_t state, int64_t signals, int64_t start, int64_t count);
size_t supervised_size(void);
void supervised_start(int64_t state);
uint32_t supervised_cause(int64_t state);
int64_t supervised_rows(int64_t state, int64_t signals, int64_t start, int64_t count);

static law_t *at(int64_t state) { return (law_t *)(intptr_t)state; }

size_t law_size(void) { return sizeof(law_t); }

void law_start(int64_t state) { law_init(at(state), &design); }

uint32_t law_limit(int64_t state, double limit) { return law_set_drive_limit(at(state), (real_t)limit); }

uint32_t law_gain(int64_t state, double gain) { return law_set_gain(at(state), (real_t)gain); }

/* Rows: frequency, wavenumber, phase, re, im. */
uint32_t law_bands(int64_t state, const double rows[], uint32_t count)
{
    band_t bands[2 * LAW_BANDS];
    for (uint32_t k = 0u; k < count; k++) {
        const double *row = &rows[5u * k];
        const band_t band = {(real_t)row[0], (real_t)row[1], (real_t)row[2], (real_t)row[3], (real_t)row[4]};
        bands[k] = band;
    }
    return law_set_bands(at(state), bands, count);
}

/* Target and measured envelope of a band, re and im of each. */
void law_envelope(int64_t state, uint32_t band, double envelopes[4])
{
    real_t target[2];
    real_t measured[2];
    law_target(at(state), band, target);
    law_measured(at(state), band, measured);
    envelopes[0] = (double)target[0];
    envelopes[1] = (double)target[1];
    envelopes[2] = (double)measured[0];
    envelopes[3] = (double)measured[1];
}

double law_differs(int64_t state) { return (double)law_mismatch(at(state)); }

void law_covariance(int64_t state, double covariance[LAW_PARAMETERS * LAW_PARAMETERS])
{
    for (uint32_t i = 0u; i < LAW_PARAMETERS; i++) {
        for (uint32_t j = 0u; j < LAW_PARAMETERS; j++) {
            covariance[i * LAW_PARAMETERS + j] = (double)at(state)->learning.covariance[i][j];
        }
    }
}

typedef struct {
    law_t law; /* first: an address of both is that of the law */
    supervisor_t supervisor;
} supervised_t;

size_t supervised_size(void) { return sizeof(supervised_t); }

void supervised_start(int64_t state)
{
    law_start(state);
    supervisor_init(&((supervised_t *)(intptr_t)state)->supervisor, &supervision, &design);
}

uint32_t supervised_cause(int64_t state)
{
    return (uint32_t)((const supervised_t *)(intptr_t)state)->supervisor.cause;
}

static int64_t advance(law_t *law, supervisor_t *supervisor, int64_t signals, int64_t start, int64_t count)
{
    const signals_t *io = (const signals_t *)(intptr_t)signals;
    const double *sensed = (const double *)(intptr_t)io->sensed;
    const double *position = (const double *)(intptr_t)io->position;
    const double *waveform = (const double *)(intptr_t)io->waveform;
    double *drive = (double *)(intptr_t)io->drive;
    int64_t *flags = (int64_t *)(intptr_t)io->flags;
    for (int64_t n = start; n < start + count; n++) {
        const real_t x = (real_t)position[n];
        const real_t reference = (real_t)waveform[n];
        real_t y[LAW_SENSORS];
        real_t u[LAW_CHANNELS];
        for (int64_t i = 0; i < LAW_SENSORS; i++) {
            y[i] = (real_t)sensed[n * LAW_SENSORS + i];
        }
        flags[n] |= (int64_t)((supervisor != NULL) ? supervisor_step(supervisor, law, y, x, reference, u)
                                                   : law_step(law, y, x, reference, u));
        for (int64_t i = 0; i < LAW_CHANNELS; i++) {
            drive[n * LAW_CHANNELS + i] = (double)u[i];
        }
    }
    return 0;
}

/* Advance the law at the address `state` by rows `start` to `start + count - 1` of the signals. */
int64_t law_rows(int64_t state, int64_t signals, int64_t start, int64_t count)
{
    return advance(at(state), NULL, signals, start, count);
}

/* The same under supervision. */
int64_t supervised_rows(int64_t state, int64_t signals, int64_t start, int64_t count)
{
    supervised_t *both = (supervised_t *)(intptr_t)state;
    return advance(&both->law, &both->supervisor, signals, start, count);
}
