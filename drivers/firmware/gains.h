/*
 * Supervision of gains: whether a sensor shows, or an actuator gives, a multiple of what it did a moment before, as
 * hapticrender/control/gains.py, which has the equations.
 *
 * Index of an array of two: of sensors, or of actuators; of the outer one: sensors, actuators.
 */
#ifndef GAINS_H
#define GAINS_H

#include <stdint.h>

#include "real.h"

/* Settings, from `hapticrender export`; poles are per sample. */
typedef struct {
    real_t scale, innovation, mean_pole, window_pole; /* 1/m; 1 */
    uint32_t duration;                                /* samples of a trial */
    real_t step_state[4][4], step_force[4][2];        /* of coordinates and their rates, with the force held */
    real_t filter_gain[6][2];                         /* of these and of the force that wanders, per innovation */
    real_t sensor_from_coordinate[2][2];
    real_t force_of_actuator[2][2][2];
} gain_settings_t;

typedef struct {
    real_t models[6][6]; /* the filter's state, p, xi_1, xi_2, zeta_1, zeta_2 */
    real_t e[2], mean[2];
    real_t energy[2], weights[2][2][2], weighted[2][2];
    uint32_t left, watched;
} gains_t;

/*
 * Compare a sample's sensors with the motion that device and force (N, N, from this sample on) give; returns the
 * sensors whose gain has changed, as bits, and in `inverted` the actuators that are.
 */
uint32_t gains_check(
    gains_t *gains, const gain_settings_t *used, const real_t sensed[], const real_t force[2], uint32_t *inverted);

#endif
