/*
 * Supervision of gains: whether a sensor shows, or an actuator gives, a multiple of what it did, or another's, as
 * hapticrender/control/gain_faults.py, which has the equations.
 *
 * Index of an array of two: of sensors, or of actuators; of the outer one: sensors, actuators.  Of an array of
 * GAIN_CHANGES: of the one, of the other, and a swap of the two.
 */
#ifndef GAINS_H
#define GAINS_H

#include <stdint.h>

#include "real.h"

#define GAIN_CHANGES 3u

/* Settings, from `hapticrender export`; smoothing factors are per sample. */
typedef struct {
    real_t scale, innovation, mean_smoothing, window_smoothing; /* 1/m; 1 */
    uint32_t duration;                                /* samples of a trial */
    real_t step_state[4][4], step_force[4][2];        /* of coordinates and their rates, with the force held */
    real_t filter_gain[6][2];                         /* of these and of the force that wanders, per innovation */
    real_t sensor_from_coordinate[2][2];
    real_t force_of_actuator[GAIN_CHANGES][2][2]; /* per force; swap: swapped less these, or 0 */
} gain_settings_t;

typedef struct {
    real_t models[2u + 2u * GAIN_CHANGES][6]; /* the filter's state, p, xi_1, xi_2, xi_3, zeta_1, zeta_2, zeta_3 */
    real_t e[2], mean[2];
    real_t energy[2], weights[2][GAIN_CHANGES][GAIN_CHANGES], weighted[2][GAIN_CHANGES];
    uint32_t left, watched;
} gains_t;

/* What has changed: sensors whose gain has, and actuators that are inverted, as bits; whether two are swapped. */
typedef struct {
    uint32_t sensors, actuators, swapped;
} gain_faults_t;

/* Compare a sample's sensors, but those that are invalid (bits), with the motion that device and force (N, N, from this
 * sample on) give. */
gain_faults_t gains_check(
    gains_t *s, const gain_settings_t *p, const real_t sensed[], uint32_t invalid, const real_t force[2]);

#endif
