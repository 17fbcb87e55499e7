/*
 * Supervision of the law: stops the drive where the motion does not follow from it, as
 * hapticrender/control/supervisor_kernel.py, which has the tests, their conditions and their times.
 *
 * It takes the place of law_step: call supervisor_step instead.  State: sizeof(supervisor_t), static.
 */
#ifndef SUPERVISOR_H
#define SUPERVISOR_H

#include "gains.h"
#include "law.h"

#define SUPERVISOR_STOPPED 64u /* flag beside those of the law, as hapticrender.protocols.Flag */

typedef enum {
    SUPERVISOR_FINE,
    SUPERVISOR_INVALID,
    SUPERVISOR_FROZEN,
    SUPERVISOR_INCONSISTENT,
    SUPERVISOR_ACTIVE,
    SUPERVISOR_DRIVE,
    SUPERVISOR_RINGING,
    SUPERVISOR_OVERMOTION,
    SUPERVISOR_BEYOND,
    SUPERVISOR_SENSOR_GAIN,
    SUPERVISOR_ACTUATOR_GAIN,
    SUPERVISOR_SWAPPED
} supervisor_cause_t;

/* Settings, from `hapticrender export`; smoothing factors and fades are per sample, times in samples. */
typedef struct {
    real_t invalid_smoothing, frozen_drive, low, high, corner, top_gain, omega, energy_smoothing, power_smoothing;
    real_t drive_smoothing, ring_corner, ring_top_gain, ring_smoothing, lever, danger_motion, danger_drive, most_motion, most_drive;
    real_t large_drive, most_damping, sensed_bound, drive_limit, heat_smoothing, heat_gain, slow_smoothing, fade_out, fade_now;
    uint32_t invalid_time, frozen_time, inconsistent_time, active_time, drive_time, ring_time, ring_wait_time;
    uint32_t ring_stop_time, suspension_time, beyond_time, slow_time, limit_time;
    uint32_t modelled;  /* 1: motion and drive are compared */
    uint32_t damped;    /* 1: the inner damper is watched */
    uint32_t limited;   /* 1: the law's drive limit follows the heat */
    uint32_t compared;  /* 1: gains of sensors and actuators are compared */
    real_t mass[2][2], damping[2][2], stiffness[2][2]; /* kg, N s/m, N/m; 0 where a coordinate is locked */
    real_t bound[2][8]; /* of the residual's energy, per energy of q, v, a, dF in both coordinates */
    real_t noise[2];    /* N^2, of the residual's energy */
    real_t ringing[2];  /* N^2, of the damper's force; 0: no test */
    gain_settings_t gains;
} supervision_t;

extern const supervision_t supervision; /* in design.c */

/* Filter of the signals q (2) and F (2), and of the damper's force. */
typedef struct {
    real_t low[4], high[4], band[4], level[4];
    real_t value[4], rate[4], change[4]; /* filtered signal and its derivatives */
    real_t ring_band[4], ring_level[4];
} supervisor_filter_t;

typedef struct {
    const supervision_t *p;
    const design_t *design;
    supervisor_filter_t filter;
    gains_t gains;
    real_t forces[LAW_DELAY + 1][3]; /* N, N, A: forces and sum of the drive on their way */
    real_t force[2], input[4];
    real_t energy[12];               /* means of squares of q, v, a, dF, F, r in both coordinates */
    real_t power[2], ring_energy[2], limit_energy[2], slow[4];
    real_t drive_energy[LAW_CHANNELS], heat[LAW_CHANNELS];
    real_t last[LAW_SENSORS], least[LAW_SENSORS], most[LAW_SENSORS];
    real_t fade, fade_step, invalid, peak;
    real_t sensed_bound;             /* m: that of the settings, or a lower one */
    uint32_t repeats[LAW_SENSORS], longest[LAW_SENSORS];
    uint32_t inconsistent_count, active_count, drive_count, motion_count, ring_count, ring_wait_count, slow_count;
    uint32_t limit_count, contact_count;
    uint32_t kept, broken; /* samples; see is_broken */
    uint32_t beyond_count, suspended, at, started, away;
    uint32_t stopped_sensors; /* bit i: sensor i + 1, of an invalid, frozen, exceeding or wrong one; actuator */
    supervisor_cause_t cause;
} supervisor_t;

/* Set a supervisor to rest; the law is set to rest beside it, by law_init. */
void supervisor_init(supervisor_t *supervisor, const supervision_t *used, const design_t *played);

/* Advance the law by a sample, see law_step, and supervise it; a stop is permanent. */
uint32_t supervisor_step(
    supervisor_t *supervisor, law_t *law, const real_t sensed[], real_t position, real_t reference, real_t drive[]);

#endif
