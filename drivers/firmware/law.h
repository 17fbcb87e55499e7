/*
 * The control law of hapticrender (method "inverse") for one plate: sample by sample, bands and a waveform.  For an
 * electroadhesive screen (LAW_FRICTION 1) it plays a waveform in open loop: the drive is an attraction in N, targets are
 * impulses in N s, whose derivative is the friction, and `law_carrier` turns the drive into the carrier's peak.
 *
 * It equals hapticrender/control/inverse_kernel.py with a block of one sample; docs/theory.md has the equations.
 * There is no heap, no recursion and no global variable but the constant `design`.  All state lies in `law_t`, whose
 * size is a compile-time constant: sizeof(law_t), fixed by the sizes that `hapticrender export` writes to design.h.
 * SI units throughout.  The functions are not reentrant: call all of them for one law from one thread or interrupt.
 */
#ifndef LAW_H
#define LAW_H

#include <stdint.h>

#include "design.h" /* LAW_BANDS, LAW_DELAY, LAW_COORDINATES, LAW_SENSORS, LAW_CHANNELS, LAW_DAMPER_TAPS, LAW_TAP_STRIDE, LAW_PAST */
#include "real.h"

#define LAW_FILTER_TAPS 12  /* of the derivatives' filters, 6 of them ahead */
/* LAW_DELAY: samples from a sensed one to the moment that its drive acts; `reference` of law_step is this far ahead: */
#define LAW_LOOKAHEAD (LAW_DELAY + LAW_FILTER_TAPS / 2)
#define LAW_BASIS 6         /* beta: r, r'/w_n, r''/w_n^2, r_p (r through the pair of poles), r_p'/w_p, D_00 r' T */
#define LAW_RING (LAW_BASIS + 2) /* basis and deviation force of a sample, until they act */

/* parameters of the Kalman filter: first of each set, and their number */
#define LAW_FINGER 0
#define LAW_HEAVE 5
#define LAW_COUPLING 9
#define LAW_LOAD 12
#define LAW_INITIAL 14
#define LAW_PARAMETERS 18
#define LAW_ROWS (LAW_PARAMETERS + 1) /* regressors psi_i, and dev_u */
#define LAW_OWN (LAW_LOAD - LAW_HEAVE) /* parameters of the device itself */

/* flags of a sample, as hapticrender.protocols.Flag */
#define LAW_SATURATED 1u      /* a drive channel was cut to its limit, or the reference is scaled down */
#define LAW_NONFINITE 2u      /* a number was not finite or out of range */
#define LAW_SENSOR_CLIPPED 4u /* a sensor was at the end of its range, or beyond */

/* Target Re(amplitude e^(j phi)) with phi = 2 pi (frequency t + wavenumber x + phase). */
typedef struct {
    real_t frequency;  /* Hz, >= 0 */
    real_t wavenumber; /* 1/m, >= 0; > 0: it follows the finger */
    real_t phase;      /* turns, -1..1 */
    real_t re, im;     /* m, amplitude */
} band_t;

#define LAW_MOST_WAVENUMBER REAL(1e5) /* 1/m */
#define LAW_MOST_PHASE REAL(1.0)      /* turns, either way */

/* Everything that `hapticrender export` derives from a scene; see hapticrender/control/inverse_records.py. */
typedef struct {
    real_t rate;         /* Hz */
    uint32_t bands_used; /* of `bands` */
    uint32_t spatial;    /* 1: the whole texture follows the finger, and fades in and out with contact */
    uint32_t learns;     /* 1: the sensors are used; 0: open loop */
    real_t drive_limit;  /* A, of each channel */
    real_t drive_step;   /* A, resolution of the drive; 0: ideal */
    real_t sensor_limit; /* m, of each sensor; a larger sample is a fault */
    real_t highest, highest_edge; /* Hz, 1: where bands that follow the finger fade out */
    real_t measuring, measuring_dc;       /* gains of the observer of law_measured */
    band_t bands[LAW_BANDS];              /* those of the scene */
    /* device */
    real_t mass[2][2], damping[2][2], stiffness[2][2]; /* kg, N s/m, N/m, in heave and rocking (a theta) */
    real_t coordinate_from_sensor[2][LAW_SENSORS];
    real_t force_from_drive[2][LAW_CHANNELS]; /* N/A */
    real_t drive_from_force[LAW_CHANNELS][2]; /* A/N */
    real_t pattern[2];      /* pattern of the target over the coordinates */
    real_t lever_per_metre; /* 1/m: lever arm of a finger at x is this times x */
    /* friction, where LAW_FRICTION is 1: an attraction makes it, which goes with the square of a carrier's peak */
    real_t contact_length;              /* m, by which the friction lags behind the attraction */
    real_t typical_speed, least_speed;  /* m/s; a slower finger sticks */
    real_t bias, least, attraction;     /* N, N, N per square of the peak: sqrt(max(bias + drive, least) / attraction) */
    /* inner damper */
    real_t taps[2][LAW_DAMPER_TAPS]; /* N/m, LAW_TAP_STRIDE samples apart */
    real_t damper_limit;             /* N, in each coordinate, before its gain */
    real_t damper_high;              /* gain while it is open, 1 or 0 */
    real_t release;                  /* fall of the gain a sample */
    real_t gate_threshold, high_pass_smoothing, mean_square_smoothing; /* m^2 that opens it; a sample */
    uint32_t damper_time;            /* samples, after a contact */
    /* reference */
    real_t filters[4][LAW_FILTER_TAPS], sensor_filter[LAW_FILTER_TAPS];
    real_t pole_step[2][4];                    /* step of the pair of poles */
    real_t omega_n, pole, pole_damping;        /* w_n (rad/s), w_p (rad/s) and its damping ratio */
    real_t fade_step, change_step, confidence_step; /* a sample: of a start, of a change, of a sensor fault */
    real_t decay, scale_smoothing;             /* of the reference's scale, a sample */
    uint32_t hold;                             /* samples */
    /* learning */
    uint32_t learning_delay, relearning_delay, initial_end, report_delay, loss_time; /* samples */
    real_t noise[2], model_error, levelling_smoothing;    /* m^2; sigma_e^2's share of mean dev_u^2; a sample */
    real_t prior[LAW_PARAMETERS], reversion[LAW_PARAMETERS], initial_variance[4]; /* means; 1 - a_i */
    real_t prior_covariance[LAW_PARAMETERS][LAW_PARAMETERS];
} design_t;

extern const design_t design; /* in design.c */

typedef struct {
    band_t now;  /* what it plays; its amplitude glides */
    band_t next; /* what it was last set to */
    real_t from_re, from_im, change; /* amplitude at the last setting, 0..1 how far it has glided from there */
    real_t turns, omega, sweep, fade;
    real_t carrier_re, carrier_im, turn_re, turn_im, ahead_re, ahead_im;
    real_t target_re, target_im, measured_re, measured_im;
    uint32_t active; /* 0: no amplitude now or next */
    uint32_t stale;  /* 1: `ahead` is of another carrier */
} band_state_t;

typedef struct {
    real_t position, smooth_position, velocity, acceleration; /* m, m, m/s, m/s^2 */
    real_t speed, smooth_speed;                               /* m/s: magnitudes, where LAW_FRICTION is 1 */
    uint32_t seen;                                            /* 1: it touches */
} finger_t;

typedef struct {
    real_t theta[LAW_PARAMETERS];
    real_t covariance[LAW_PARAMETERS][LAW_PARAMETERS];
    real_t states[4][LAW_ROWS];
    real_t step[4][6]; /* [Phi, Gamma] of the loaded device over a sample */
    real_t earlier[2][LAW_OWN + 1][LAW_OWN]; /* the device's own covariance and parameters, 10-20 ms and 0-10 ms ago */
    real_t model_power[2];
    real_t lever;
    uint32_t contact, since; /* 0 or 1; samples */
    int32_t away;            /* samples without a position; below 0 until that of a suspected touch is due */
} learning_t;

/* The whole state; only law_* functions touch it. */
typedef struct law {
    const design_t *design;
    band_state_t bands[LAW_BANDS];
    finger_t finger;
    learning_t learning;
    real_t drive_limit;                       /* A */
    real_t gain, gain_from, gain_to, gain_change; /* of the reference: now, a change's ends, 0..1 how far it is */
    real_t fade, last_waveform;               /* of the waveform */
    real_t window[LAW_FILTER_TAPS], sensor_window[LAW_FILTER_TAPS], delayed[LAW_DELAY];
    real_t reference;                         /* m, what the sensors should show now */
    real_t basis[LAW_BASIS], poles[2];
    real_t ring[LAW_DELAY + 1][LAW_RING];
    real_t past[2][2 * LAW_PAST];             /* deviations, newest first from `at_past` on; a ring, held twice */
    real_t slow, power, noise, fast_open;     /* of the damper's gate */
    real_t damper_gain, damper_scale;         /* of the damper; the scale is a supervisor's */
    real_t damper_force[2];                   /* N, before its limit and gain */
    real_t moment, confidence;
    real_t peak, scale, smooth_scale;
    real_t shaper[2][LAW_CHANNELS];
    real_t measured_dc;
    real_t nominal_power, learned_power, reference_power; /* N^2, N^2, m^2: of law_mismatch */
    uint32_t hold_left, fast_timer;           /* samples */
    uint32_t at_delayed, at_ring, at_past;    /* places in `delayed`, `ring` and `past` */
    uint32_t sample;                          /* modulo 2^32 */
    uint32_t flags;                           /* of this sample */
} law_t;

/* Set a law to rest, with the bands of its design and a gain of 1. */
void law_init(law_t *law, const design_t *used);

/*
 * Take up other bands: 1, or 0 with nothing changed where `count` > LAW_BANDS or a number is out of range (frequency
 * > 0.4 rate, wavenumber or frequency < 0, magnitude > sensor_limit, not finite).  A band whose carrier stays glides to
 * its amplitude within 20 ms; any other fades out within 20 ms, and its successor fades in as at a start (50 ms).
 */
uint32_t law_set_bands(law_t *law, const band_t bands[], uint32_t count);

/* Set the gain of the reference, bands and waveform, faded over 20 ms: 1, or 0 where it is not within 0..1. */
uint32_t law_set_gain(law_t *law, real_t gain);

/* Lower the limit of the drive (A): 1, or 0 where it is not above 0 and at most that of the design. */
uint32_t law_set_drive_limit(law_t *law, real_t limit);

/*
 * Advance by a sample: from the sensors' samples (m) and the finger's position (m from the middle, NaN: no finger) to
 * the drive (A); returns flags.  `reference` is a waveform's value LAW_LOOKAHEAD samples ahead (m), played beside the
 * bands; 0 where there is none.
 */
uint32_t law_step(law_t *law, const real_t sensed[], real_t position, real_t reference, real_t drive[]);

/* Target and measured envelope (re, im; m) of a band < LAW_BANDS as of the last sample, at its carrier. */
void law_target(const law_t *law, uint32_t band, real_t envelope[2]);
void law_measured(const law_t *law, uint32_t band, real_t envelope[2]);

/*
 * Peak of the carrier (A or V, as exported) for a drive (N) of a friction device; the drive itself on a plate.
 */
real_t law_carrier(const design_t *used, real_t drive);

/* Force that was learned on the untouched device over that of its model, rms over about a second; 0: not known. */
real_t law_mismatch(const law_t *law);

/* Reference (m) of the last sample's sensing, before it is scaled down to the drive's limit. */
real_t law_reference(const law_t *law);

#endif
