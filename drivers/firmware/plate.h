/* A small rigid plate on two coils with a sensor at each end of its glass, and a finger of one mass on it; for boards
   without hardware.  Parameters are the defaults of PlateParameters in hapticrender/plants/plate.py. */
#ifndef PLATE_H
#define PLATE_H

#include "law.h"

typedef struct {
    double mass, damping, stiffness;              /* kg, N s/m, N/m: of the finger, at the surface */
    double noise;                                 /* m rms, of a sensor */
    uint64_t random;                              /* state of the noise, not 0 */
    double state[4];                              /* heave, rocking (m at the coils), their rates (m/s) */
    double drive[2], next[2];                     /* A: that acts, and that acts from the next step on */
} plate_t;

#define PLATE_DEFAULT {4e-3, 1.5, 300.0, 1e-6, 1u, {0.0, 0.0, 0.0, 0.0}, {0.0, 0.0}, {0.0, 0.0}}

/* Read the sensors (m), with noise and resolution; a screen has none. */
void plate_sense(plate_t *plate, real_t sensed[LAW_SENSORS]);

/* Set the drive (A) that acts from the next step on. */
void plate_drive(plate_t *plate, const real_t drive[LAW_CHANNELS]);

/* Advance by a sample under the held drive and a finger at `position` (m from the middle, NaN: none) that presses with
   `load` (N); then the drive that was set acts. */
void plate_advance(plate_t *plate, real_t position, real_t load);

#endif
