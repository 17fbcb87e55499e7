/* Tests of the gains of sensors and actuators; as hapticrender/control/gain_faults.py. */
#include "gains.h"

#include <string.h>

#include "design.h"

#define SENSOR 0u
#define ACTUATOR 1u
#define SWAP 2u /* of the changes */
#define STATE 0u /* models */
#define MOTION 1u
#define RESPONSE 2u
#define LEAST_INVERTED REAL(-1.6) /* gains of a sensor or an actuator that is inverted */
#define MOST_INVERTED REAL(-0.4)
#define LEAST_SWAPPED REAL(0.8) /* eta; less: a drive that bears more than 0.62 of the moment of a finger */
#define MOST_SWAPPED REAL(1.4)
#define DEAD REAL(0.25) /* of a sensor: a smaller magnitude is a fault, and a larger gain than this: */
#define MOST_GAIN REAL(2.0)
#define LIKELY REAL(9.0) /* variances: 3 sigma of a gain */
#define HEALTHY REAL(0.35) /* of a gain about 1: one that is neither that nor a fault says that no gain has changed */
#define UNEXPLAINED REAL(0.1) /* of the energy of the innovations */
#define UNEXPLAINED_INVERTED REAL(0.13)
#define CERTAIN REAL(25.0) /* variances: 5 sigma of a gain */
#define JUMP REAL(20.0)    /* variances: 4.5 sigma of an innovation */
#define WATCHED REAL(4.0)  /* variances: actuators are followed */
#define LARGE REAL(20.0)   /* and judged */

/* Advance a model by a sample, under the force that acts. */
static void advance_model(real_t model[6], const gain_settings_t *p, const real_t force[2])
{
    real_t after[4];
    for (uint32_t i = 0u; i < 4u; i++) {
        after[i] = p->step_force[i][0] * (force[0] + model[4]) + p->step_force[i][1] * (force[1] + model[5]);
        for (uint32_t j = 0u; j < 4u; j++) {
            after[i] += p->step_state[i][j] * model[j];
        }
    }
    (void)memcpy(model, after, sizeof(after));
}

/* Correct a model by the innovations of both sensors, times `sign`. */
static void correct_model(real_t model[6], const gain_settings_t *p, const real_t e[2], real_t sign)
{
    for (uint32_t i = 0u; i < 6u; i++) {
        model[i] += sign * (p->filter_gain[i][0] * e[0] + p->filter_gain[i][1] * e[1]);
    }
}

/* What sensor i shows of a model, over its noise. */
static real_t model_sensor(const real_t model[6], const gain_settings_t *p, uint32_t i)
{
    return p->sensor_from_coordinate[i][0] * model[0] + p->sensor_from_coordinate[i][1] * model[1];
}

/* Set the sums of a kind of gains, and the models behind its w, to zero. */
static void clear_sums(gains_t *s, uint32_t kind)
{
    (void)memset(s->weighted[kind], 0, sizeof(s->weighted[kind]));
    (void)memset(s->weights[kind], 0, sizeof(s->weights[kind]));
    (void)memset(s->models[RESPONSE + GAIN_CHANGES * kind], 0, GAIN_CHANGES * sizeof(s->models[0]));
}

static real_t product(const real_t a[2], const real_t b[2]) { return a[0] * b[0] + a[1] * b[1]; }

/* Add a sample of w, each of both sensors, to the sums; those of actuators are means. */
static void add_sums(gains_t *s, uint32_t kind, real_t smoothing, const real_t w[GAIN_CHANGES][2])
{
    const real_t kept = (kind == SENSOR) ? REAL(1.0) : (REAL(1.0) - smoothing);
    for (uint32_t i = 0u; i < GAIN_CHANGES; i++) {
        for (uint32_t j = i; j < GAIN_CHANGES; j++) {
            s->weights[kind][i][j] = kept * s->weights[kind][i][j] + smoothing * product(w[i], w[j]);
        }
        s->weighted[kind][i] = kept * s->weighted[kind][i] + smoothing * product(w[i], s->e);
    }
}

/* Whether a gain is that of a fault, with `rest` the share of the energy that it leaves unexplained. */
static uint32_t is_fault(uint32_t kind, real_t gain, real_t rest)
{
    const uint32_t changed = ((real_abs(gain) < DEAD) || (gain > MOST_GAIN)) ? 1u : 0u;
    if ((gain > LEAST_INVERTED) && (gain < MOST_INVERTED)) {
        return (rest < ((kind == SENSOR) ? UNEXPLAINED_INVERTED : UNEXPLAINED)) ? 1u : 0u;
    }
    return ((kind == SENSOR) && (rest < UNEXPLAINED)) ? changed : 0u;
}

/* Whether a swap explains the innovations, of variance `noise`, but for less than `rest` of their energy. */
static uint32_t is_swap(const gains_t *s, uint32_t kind, real_t noise, real_t rest)
{
    const real_t w = s->weights[kind][SWAP][SWAP];
    const real_t b = s->weighted[kind][SWAP];
    const real_t eta = b / (w + noise);
    const uint32_t near = ((eta > LEAST_SWAPPED) && (eta < MOST_SWAPPED)) ? 1u : 0u;
    const uint32_t certain = (eta * eta * (w + noise) > CERTAIN * noise) ? near : 0u;
    return (s->energy[kind] - REAL(2.0) * eta * b + eta * eta * w < rest) ? certain : 0u;
}

/* Find gains and swap, from innovations of variance `noise`: gains that are faults, as bits; whether it is a swap. */
static uint32_t judge_gains(const gains_t *s, uint32_t kind, real_t noise, uint32_t *swapped)
{
    const real_t energy = s->energy[kind];
    const real_t *b = s->weighted[kind];
    const real_t w00 = s->weights[kind][0][0];
    const real_t w01 = s->weights[kind][0][1];
    const real_t w11 = s->weights[kind][1][1];
    const real_t scale = REAL(1.0) / ((w00 + noise) * (w11 + noise) - w01 * w01);
    const real_t g[2] = {scale * ((w11 + noise) * b[0] - w01 * b[1]), scale * ((w00 + noise) * b[1] - w01 * b[0])};
    const real_t variance[2] = {scale * (w11 + noise) * noise, scale * (w00 + noise) * noise};
    real_t rest = energy - REAL(2.0) * product(g, b) + g[0] * g[0] * w00 + REAL(2.0) * g[0] * g[1] * w01
        + g[1] * g[1] * w11;
    uint32_t faults = 0u;
    uint32_t other = 0u;
    for (uint32_t j = 0u; j < 2u; j++) {
        if ((g[j] * g[j] > CERTAIN * variance[j]) && (is_fault(kind, REAL(1.0) + g[j], rest / energy) != 0u)) {
            faults |= 1u << j;
        } else if ((kind == SENSOR) && (g[j] * g[j] > LIKELY * variance[j]) && (real_abs(g[j]) > HEALTHY)) {
            other = 1u;
        }
    }
    if (other != 0u) { /* a hard press */
        faults = 0u;
    }
    if (faults == 0u) { /* a swap has to explain more than the gains do, where these are faults */
        rest = ((kind == SENSOR) ? UNEXPLAINED_INVERTED : UNEXPLAINED) * energy;
    }
    *swapped |= is_swap(s, kind, noise, rest);
    return faults;
}

/* Add a sample to a trial, and judge sensors at its end. */
static void follow_sensors(
    gains_t *s, const gain_settings_t *p, uint32_t invalid, const real_t force[2], gain_faults_t *faults)
{
    const real_t none[2] = {REAL(0.0), REAL(0.0)};
    const real_t shown[2] = {model_sensor(s->models[MOTION], p, 0u), model_sensor(s->models[MOTION], p, 1u)};
    real_t w[GAIN_CHANGES][2] = {
        {shown[0], REAL(0.0)}, {REAL(0.0), shown[1]}, {shown[1] - shown[0], shown[0] - shown[1]}};
    for (uint32_t j = 0u; j < GAIN_CHANGES; j++) {
        for (uint32_t i = 0u; i < 2u; i++) {
            w[j][i] -= model_sensor(s->models[RESPONSE + j], p, i);
            w[j][i] = ((invalid & (1u << i)) != 0u) ? REAL(0.0) : w[j][i];
        }
    }
    add_sums(s, SENSOR, REAL(1.0), (const real_t (*)[2])w);
    s->energy[SENSOR] += product(s->e, s->e);
    advance_model(s->models[MOTION], p, force);
    for (uint32_t j = 0u; j < GAIN_CHANGES; j++) {
        correct_model(s->models[RESPONSE + j], p, w[j], REAL(1.0));
        advance_model(s->models[RESPONSE + j], p, none);
    }
    s->left -= 1u;
    if (s->left == 0u) {
        faults->sensors = judge_gains(s, SENSOR, p->innovation, &faults->swapped);
    }
}

/* Add a sample to the means, and judge actuators. */
static void follow_actuators(
    gains_t *s, const gain_settings_t *p, uint32_t invalid, const real_t force[2], gain_faults_t *faults)
{
    real_t(*const models)[6] = &s->models[RESPONSE + GAIN_CHANGES];
    real_t w[GAIN_CHANGES][2];
    for (uint32_t j = 0u; j < GAIN_CHANGES; j++) {
        for (uint32_t i = 0u; i < 2u; i++) {
            w[j][i] = ((invalid & (1u << i)) != 0u) ? REAL(0.0) : model_sensor(models[j], p, i);
        }
    }
    if (s->watched > p->duration / 2u) { /* by then w no longer depends on where it began */
        add_sums(s, ACTUATOR, p->window_smoothing, (const real_t (*)[2])w);
    }
    for (uint32_t j = 0u; j < GAIN_CHANGES; j++) {
        const real_t own[2] = {product(p->force_of_actuator[j][0], force), product(p->force_of_actuator[j][1], force)};
        correct_model(models[j], p, w[j], REAL(-1.0));
        advance_model(models[j], p, own);
    }
    if ((2u * s->watched > 3u * p->duration) && (s->energy[ACTUATOR] > LARGE * p->innovation)) {
        faults->actuators = judge_gains(s, ACTUATOR, p->window_smoothing * p->innovation, &faults->swapped);
    }
}

/* Find the innovations and their mean squares; whether one has jumped.  An invalid sample has none. */
static uint32_t note_innovations(gains_t *s, const gain_settings_t *p, const real_t sensed[], uint32_t invalid)
{
    uint32_t jump = 0u;
    for (uint32_t i = 0u; i < (uint32_t)LAW_SENSORS; i++) {
        s->e[i] = REAL(0.0);
        if ((invalid & (1u << i)) != 0u) {
            continue;
        }
        s->e[i] = p->scale * sensed[i] - model_sensor(s->models[STATE], p, i);
        const real_t square = s->e[i] * s->e[i];
        jump |= (square > JUMP * ((s->mean[i] > p->innovation) ? s->mean[i] : p->innovation)) ? 1u : 0u;
        s->mean[i] += p->mean_smoothing * (square - s->mean[i]);
    }
    s->energy[ACTUATOR] += p->window_smoothing * (product(s->e, s->e) - s->energy[ACTUATOR]);
    return jump;
}

gain_faults_t gains_check(
    gains_t *s, const gain_settings_t *p, const real_t sensed[], uint32_t invalid, const real_t force[2])
{
    gain_faults_t faults = {0u, 0u, 0u};
    const uint32_t jump = note_innovations(s, p, sensed, invalid);
    if ((jump != 0u) && (s->left == 0u)) {
        clear_sums(s, SENSOR);
        s->left = p->duration;
        s->energy[SENSOR] = REAL(0.0);
        (void)memcpy(s->models[MOTION], s->models[STATE], sizeof(s->models[MOTION]));
    }
    if (s->left > 0u) {
        follow_sensors(s, p, invalid, force, &faults);
    }
    if (s->energy[ACTUATOR] > WATCHED * p->innovation) {
        s->watched += 1u;
        follow_actuators(s, p, invalid, force, &faults);
    } else if (s->watched != 0u) {
        clear_sums(s, ACTUATOR);
        s->watched = 0u;
    }
    correct_model(s->models[STATE], p, s->e, REAL(1.0));
    advance_model(s->models[STATE], p, force);
    faults.swapped = (LAW_SENSORS == 2u) ? faults.swapped : 0u;
    return faults;
}
