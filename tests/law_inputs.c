/*
 * Play a law, and a supervised one, whatever its inputs are: sensors, positions, waveforms and set-points that are drawn at random, huge, or no
 * numbers.  Prints the samples played; status 1 where a drive is not finite or beyond its limit.
 */
#include <stdio.h>

#include "supervisor.h"

#define SAMPLES 60000u
#define STOPPED_FOR 300u /* samples, before it starts again */

static law_t law, supervised;
static supervisor_t supervisor;
static uint32_t random_state = 12345u;

static uint32_t draw(uint32_t below)
{
    random_state = random_state * 1664525u + 1013904223u;
    return (random_state >> 16) % below;
}

/* Mostly of magnitude `size`; once in a while what no sensor should give. */
static real_t draw_number(real_t size, uint32_t bad_in)
{
    const real_t bad[8] = {
        (real_t)NAN, (real_t)INFINITY, -(real_t)INFINITY, REAL(1e30), REAL(-1e30), REAL(1e-38), REAL(-1e3), REAL(2e3)};
    const real_t good = size * ((real_t)draw(2001u) / REAL(1000.0) - REAL(1.0));
    return (draw(bad_in) == 0u) ? bad[draw(8u)] : good;
}

static void set_something(void)
{
    band_t bands[LAW_BANDS];
    const uint32_t count = draw(LAW_BANDS + 1u);
    for (uint32_t k = 0u; k < count; k++) {
        const uint32_t follows = draw(2u);
        bands[k].frequency = (follows != 0u) ? REAL(0.0) : real_abs(draw_number(REAL(400.0), 50u));
        bands[k].wavenumber = (follows != 0u) ? real_abs(draw_number(REAL(2e3), 50u)) : REAL(0.0);
        bands[k].phase = draw_number(REAL(1.0), 50u);
        bands[k].re = draw_number(REAL(20e-6), 50u);
        bands[k].im = draw_number(REAL(20e-6), 50u);
    }
    (void)law_set_bands(&law, bands, count);
    (void)law_set_gain(&law, draw_number(REAL(1.2), 10u));
}

static uint32_t beyond(const real_t drive[])
{
    uint32_t count = 0u;
    for (uint32_t i = 0u; i < LAW_CHANNELS; i++) {
        count += (real_abs(drive[i]) <= design.drive_limit) ? 0u : 1u;
    }
    return count;
}

static void start_supervised(void)
{
    law_init(&supervised, &design);
    supervisor_init(&supervisor, &supervision, &design);
}

int main(void)
{
    uint32_t bad = 0u;
    uint32_t stopped = 0u;
    real_t position = REAL(0.0);
    law_init(&law, &design);
    start_supervised();
    for (uint32_t n = 0u; n < SAMPLES; n++) {
        real_t drive[LAW_CHANNELS];
        real_t sensed[LAW_SENSORS];
        const uint32_t faulty = ((n / 5000u) % 2u != 0u) ? 20u : 65521u;
        for (uint32_t i = 0u; i < LAW_SENSORS; i++) {
            sensed[i] = draw_number(REAL(1.1e-3), faulty);
        }
        if (draw(200u) == 0u) {
            position = draw_number(REAL(0.05), 4u);
        }
        if (draw(500u) == 0u) {
            set_something();
        }
        const real_t waveform = draw_number(REAL(1e-4), faulty);
        (void)law_step(&law, sensed, position, waveform, drive);
        bad += beyond(drive);
        (void)supervisor_step(&supervisor, &supervised, sensed, position, waveform, drive);
        bad += beyond(drive);
        stopped += (supervisor.cause != SUPERVISOR_FINE) ? 1u : 0u;
        if (stopped > STOPPED_FOR) {
            start_supervised();
            stopped = 0u;
        }
    }
    (void)printf("%u\n", (unsigned int)SAMPLES);
    return (bad != 0u) ? 1 : 0;
}
