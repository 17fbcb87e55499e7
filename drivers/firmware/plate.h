/* A small rigid plate on two coils with a sensor at each end of its glass, and a finger of one mass on it; for boards
   without hardware.  Parameters are the defaults of PlateParameters in hapticrender/plants/plate.py. */
#ifndef PLATE_H
#define PLATE_H

#include <stdint.h>

typedef struct {
    double mass, damping, stiffness;              /* kg, N s/m, N/m: of the finger, at the surface */
    double noise;                                 /* m rms, of a sensor */
    uint64_t random;                              /* state of the noise, not 0 */
    double state[4];                              /* heave, rocking (m at the coils), their rates (m/s) */
} plate_t;

/* Read both sensors (m), with noise and resolution. */
void plate_sense(plate_t *plate, double sensed[2]);

/* Advance by `period` (s) under held currents (A) and a finger at `position` (m from the middle, NaN: none) that
   presses with `load` (N). */
void plate_advance(plate_t *plate, double period, const double current[2], double position, double load);

#endif
