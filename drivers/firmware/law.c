/* The control law's step; as hapticrender/control/inverse_kernel.py, with a block of one sample. */
#include "law_parts.h"

#include <string.h>

#define REVERSION 20u             /* samples between two steps of the parameters' reversion to their mean */
#define NOISE_SMOOTHING (REAL(4e-3) / REAL(0.3)) /* of the noise at the gate, over that of the mean square over 4 ms */
#define MOST_NOISE REAL(25.0)     /* of the stated one, as mean squares */
#define LARGEST_MOMENT REAL(1.0)  /* N, of the levelling: a hard press may tilt the device */
#define MOST_NEEDED REAL(20.0)    /* of the drive's limit; a reference that is scaled by more teaches nothing */
#define HUGE_NUMBER REAL(1e6)     /* A or N: no drive, no force */
#define SLOWEST REAL(0.1)         /* of the typical speed: a slower contact hardly modulates at all */
#define SCALED REAL(0.999)        /* a reference scaled by less is saturated */
#define LEAST_TARGET REAL(3e-3)   /* of the sensors' range: below it noise adds more than a wrong device model */

void law_init(law_t *law, const design_t *used)
{
    (void)memset(law, 0, sizeof(*law));
    law->design = used;
    law->drive_limit = used->drive_limit;
    law->gain = REAL(1.0);
    law->gain_to = REAL(1.0);
    law->gain_change = REAL(1.0);
    law->confidence = REAL(1.0);
    law->damper_scale = REAL(1.0);
    law->scale = REAL(1.0);
    law->smooth_scale = REAL(1.0);
    learning_init(law);
    (void)law_set_bands(law, used->bands, used->bands_used);
}

uint32_t law_set_gain(law_t *law, real_t gain)
{
    if (!((gain >= REAL(0.0)) && (gain <= REAL(1.0)))) { /* NaN included */
        return 0u;
    }
    law->gain_from = law->gain;
    law->gain_to = gain;
    law->gain_change = REAL(0.0);
    return 1u;
}

uint32_t law_set_drive_limit(law_t *law, real_t limit)
{
    if (!((limit > REAL(0.0)) && (limit <= law->design->drive_limit))) {
        return 0u;
    }
    law->drive_limit = limit;
    return 1u;
}

/* Convert the sensors' samples to coordinates; 1 where one is not finite, or at the end of its range. */
static uint32_t sense(law_t *law, const real_t sensed[], real_t coordinates[2])
{
    const design_t *d = law->design;
    uint32_t raised = 0u;
    coordinates[0] = REAL(0.0);
    coordinates[1] = REAL(0.0);
    for (uint32_t s = 0u; (s < LAW_SENSORS) && (d->learns != 0u); s++) {
        if (real_abs(sensed[s]) < d->sensor_limit) {
            coordinates[0] += d->coordinate_from_sensor[0][s] * sensed[s];
            coordinates[1] += d->coordinate_from_sensor[1][s] * sensed[s];
        } else { /* NaN included */
            raised |= LAW_NONFINITE | (isfinite(sensed[s]) ? LAW_SENSOR_CLIPPED : 0u);
        }
    }
    law->flags |= raised;
    return (raised != 0u) ? 1u : 0u;
}

static void glide_gain(law_t *law)
{
    if (law->gain_change < REAL(1.0)) {
        law->gain_change = real_min(law->gain_change + law->design->change_step, REAL(1.0));
        law->gain = law->gain_from + smooth(law->gain_change) * (law->gain_to - law->gain_from);
    }
}

/* Waveform as it is played: faded in and out with contact where it follows the finger. */
static real_t faded_waveform(law_t *law, real_t waveform)
{
    const design_t *d = law->design;
    const uint32_t always = ((d->spatial == 0u) && (LAW_FRICTION == 0u)) ? 1u : 0u;
    const uint32_t plays = ((law->learning.contact != 0u) || (always != 0u)) ? 1u : 0u;
    if (real_abs(waveform) <= d->sensor_limit) { /* else it is held */
        law->last_waveform = waveform;
    }
    law->fade = real_clip(law->fade + ((plays != 0u) ? d->fade_step : -d->fade_step), REAL(0.0), REAL(1.0));
    return law->last_waveform * smooth(law->fade);
}

/* Put the reference of the look-ahead into the window; find what the sensors should show of it now. */
static void take_reference(law_t *law, real_t waveform)
{
    glide_gain(law);
    const real_t value = (bands_ahead(law) + faded_waveform(law, waveform)) * law->gain * law->smooth_scale;
    for (uint32_t i = 0u; i + 1u < LAW_FILTER_TAPS; i++) {
        law->window[i] = law->window[i + 1u];
        law->sensor_window[i] = law->sensor_window[i + 1u];
    }
    law->window[LAW_FILTER_TAPS - 1] = value;
    law->sensor_window[LAW_FILTER_TAPS - 1] = law->delayed[law->at_delayed];
    law->delayed[law->at_delayed] = value;
    law->at_delayed = (law->at_delayed + 1u) % (uint32_t)LAW_DELAY;
    law->reference = REAL(0.0);
    for (uint32_t i = 0u; i < LAW_FILTER_TAPS; i++) {
        law->reference += law->design->sensor_filter[i] * law->sensor_window[i];
    }
}

/* Basis of the forces at the moment at which this sample's drive acts, and r' and r'' beside it. */
static void find_basis(law_t *law, real_t *rate, real_t *acceleration)
{
    const design_t *d = law->design;
    real_t r[4] = {REAL(0.0), REAL(0.0), REAL(0.0), REAL(0.0)}; /* derivatives of the reference */
    for (uint32_t i = 0u; i < LAW_FILTER_TAPS; i++) {
        for (uint32_t order = 0u; order < 4u; order++) {
            r[order] += d->filters[order][i] * law->window[i];
        }
    }
    if (LAW_FRICTION != 0u) { /* what has to be made is r + lag r', for the contact to follow r */
        const finger_t *finger = &law->finger;
        const real_t speed = real_max(REAL(2.0) * finger->speed - finger->smooth_speed, SLOWEST * d->typical_speed);
        for (uint32_t order = 0u; order < 3u; order++) {
            r[order] += d->contact_length / speed * r[order + 1u];
        }
    }
    real_t poles[2];
    for (uint32_t i = 0u; i < 2u; i++) {
        const real_t *step = d->pole_step[i];
        poles[i] = step[0] * law->poles[0] + step[1] * law->poles[1] + step[2] * law->basis[0] + step[3] * r[0];
    }
    law->poles[0] = poles[0];
    law->poles[1] = poles[1];
    law->basis[0] = r[0];
    law->basis[1] = r[1] / d->omega_n;
    law->basis[2] = r[2] / (d->omega_n * d->omega_n);
    law->basis[3] = d->pole * d->pole * poles[0];
    law->basis[4] = d->pole * poles[1];
    law->basis[5] = (d->mass[0][0] * r[3] + d->damping[0][0] * r[2] + d->stiffness[0][0] * r[1]) / d->rate;
    *rate = r[1];
    *acceleration = r[2];
}

/*
 * Set the gain of the inner damper: open after a contact, and while the deviation is more than noise; 1 where a deviation
 * opens a closed gate.
 */
static uint32_t open_gate(law_t *law, real_t deviation)
{
    const design_t *d = law->design;
    law->slow += d->high_pass_smoothing * (deviation - law->slow);
    const real_t above = deviation - law->slow;
    law->power += d->mean_square_smoothing * (above * above - law->power);
    const real_t *past = &law->past[0][law->at_past]; /* of the sample before, and earlier */
    const real_t second = deviation - REAL(2.0) * past[1] + past[2];
    law->noise += NOISE_SMOOTHING * d->mean_square_smoothing * (second * second / REAL(6.0) - law->noise);
    const real_t noise = real_max(d->gate_threshold, real_min(REAL(4.0) * law->noise, MOST_NOISE * d->gate_threshold));
    const uint32_t large = (law->power > noise) ? 1u : 0u;
    const uint32_t opens = ((large != 0u) && (law->fast_open <= REAL(0.0))) ? 1u : 0u;
    if ((large != 0u) && (law->fast_timer == 0u)) {
        law->fast_timer = 1u;
    }
    if (law->fast_timer > 0u) {
        law->fast_open = REAL(1.0);
        law->fast_timer--;
    } else {
        law->fast_open = real_max(law->fast_open - d->release, REAL(0.0));
    }
    law->damper_gain = law->damper_scale * (law->fast_open * d->damper_high);
    return opens;
}

/* Note the deviation of this sample, at both places of the ring. */
static void note_deviation(law_t *law, uint32_t coordinate, real_t deviation)
{
    law->past[coordinate][law->at_past] = deviation;
    law->past[coordinate][law->at_past + LAW_PAST] = deviation;
}

/* Force of the inner damper, F = -sum c_j dev[n - j s] within its limit, s the distance of its taps. */
static real_t damp(law_t *law, uint32_t coordinate, real_t deviation)
{
    const real_t *taps = law->design->taps[coordinate];
    const real_t *past = &law->past[coordinate][law->at_past];
    const real_t limit = law->design->damper_limit;
    real_t force = REAL(0.0);
    note_deviation(law, coordinate, deviation);
    if ((law->damper_gain > REAL(0.0)) || (law->damper_scale < REAL(1.0))) {
        for (uint32_t j = 0u; j < LAW_DAMPER_TAPS; j++) {
            force -= taps[j] * past[j * LAW_TAP_STRIDE];
        }
    }
    law->damper_force[coordinate] = force;
    return law->damper_gain * real_clip(force, -limit, limit);
}

/* Confidence in the sensors fades out within 20 ms while samples are invalid, and in again. */
static void update_confidence(law_t *law, uint32_t invalid)
{
    const real_t step = law->design->confidence_step;
    law->confidence = real_clip(law->confidence + ((invalid != 0u) ? -step : step), REAL(0.0), REAL(1.0));
}

/* Damp the last deviations once more, for want of others: sets the forces in both coordinates. */
static void hold_deviations(law_t *law, real_t force[2])
{
    for (uint32_t i = 0u; i < LAW_COORDINATES; i++) {
        force[i] = damp(law, i, law->past[i][law->at_past + 1u]);
    }
}

/* Learn from the deviations, and damp them: sets the forces in both coordinates. */
static void use_sensors(law_t *law, const real_t coordinates[2], uint32_t learns, real_t force[2])
{
    const design_t *d = law->design;
    const real_t error[2] = {
        coordinates[0] - d->pattern[0] * law->reference, coordinates[1] - d->pattern[1] * law->reference};
    if ((open_gate(law, error[0]) != 0u) && (law->learning.since > d->initial_end)) {
        learning_suspect_change(law);
    }
    if (learns != 0u) {
        learning_update(law, error);
    }
    for (uint32_t i = 0u; i < LAW_COORDINATES; i++) {
        force[i] = damp(law, i, error[i]);
    }
    bands_measure(law, coordinates[0]);
}

/* Force that the device, as it is modelled, takes for the reference. */
static void nominal_force(law_t *law, real_t force[2])
{
    const design_t *d = law->design;
    real_t rate;
    real_t acceleration;
    find_basis(law, &rate, &acceleration);
    real_t of[2][2]; /* symmetric */
    for (uint32_t i = 0u; i < 2u; i++) {
        for (uint32_t j = i; j < 2u; j++) {
            of[i][j] = d->stiffness[i][j] * law->basis[0] + d->damping[i][j] * rate + d->mass[i][j] * acceleration;
        }
    }
    force[0] = d->pattern[0] * of[0][0] + d->pattern[1] * of[0][1];
    force[1] = d->pattern[0] * of[0][1] + d->pattern[1] * of[1][1];
}

/* Mean squares over a second of the free device's nominal force in heave, and of what was learned beside it. */
static void update_powers(law_t *law, real_t nominal, real_t learned)
{
    const real_t smoothing = REAL(1.0) / law->design->rate;
    const real_t free = (law->learning.contact == 0u) ? REAL(1.0) : REAL(0.0);
    law->reference_power += smoothing * (free * law->reference * law->reference - law->reference_power);
    law->nominal_power += smoothing * (free * nominal * nominal - law->nominal_power);
    law->learned_power += smoothing * (free * learned * learned - law->learned_power);
}

/* Rocking force that slowly levels the device under the load: a moving finger would else tilt it to and fro. */
static real_t levelling_force(law_t *law)
{
    const learning_t *v = &law->learning;
    const real_t moment = v->lever * v->theta[LAW_LOAD] + v->theta[LAW_LOAD + 1];
    const real_t target = (v->contact != 0u) ? real_clip(moment, -LARGEST_MOMENT, LARGEST_MOMENT) : REAL(0.0);
    law->moment += law->design->levelling_smoothing * (target - law->moment);
    return law->moment;
}

/* Start afresh from the prior, with nothing learned: a number got out of hand. */
static void recover(law_t *law)
{
    learning_reset_all(law);
    law->moment = REAL(0.0);
    law->slow = REAL(0.0);
    law->power = REAL(0.0);
    law->nominal_power = REAL(0.0);
    law->learned_power = REAL(0.0);
    law->peak = REAL(0.0);
    law->scale = REAL(1.0);
    law->smooth_scale = REAL(1.0);
    (void)memset(law->poles, 0, sizeof(law->poles));
    (void)memset(law->shaper, 0, sizeof(law->shaper));
    (void)memset(law->past, 0, sizeof(law->past));
    law->measured_dc = REAL(0.0);
}

/* Round a drive to the converter's steps, the rounding noise shaped by (1 - 1/z)^2. */
static real_t shape_noise(law_t *law, real_t exact, uint32_t channel)
{
    const real_t step = law->design->drive_step;
    const real_t last = law->shaper[0][channel];
    const real_t shaped = exact + (REAL(2.0) * last - law->shaper[1][channel]);
    const real_t rounded = step * real_rint(shaped / step);
    law->shaper[1][channel] = last;
    law->shaper[0][channel] = real_clip(shaped - rounded, -step, step);
    return rounded;
}

/*
 * Scale the reference so that the drive stays within its limit; `needed` is that of the whole reference, over it.  The
 * largest need is held for a while and then falls; two poles smooth the scale, so that it makes no edges.
 */
static void scale_reference(law_t *law, real_t needed)
{
    const design_t *d = law->design;
    const uint32_t expired = (law->hold_left == 0u) ? 1u : 0u;
    law->hold_left -= (expired != 0u) ? 0u : 1u;
    if (needed >= REAL(0.98) * law->peak) {
        law->peak = real_min(real_max(law->peak, needed), MOST_NEEDED);
        law->hold_left = d->hold;
    } else if (expired != 0u) {
        law->peak *= d->decay;
    }
    law->scale += d->scale_smoothing * (REAL(1.0) / real_max(law->peak, REAL(1.0)) - law->scale);
    law->smooth_scale += d->scale_smoothing * (law->scale - law->smooth_scale);
}

/* Drive of a channel for the forces, rounded and inside the limit; raises `most`, the largest need over the limit. */
static real_t drive_of(law_t *law, uint32_t channel, const real_t force[2], real_t *most)
{
    const design_t *d = law->design;
    real_t exact =
        law->confidence * (d->drive_from_force[channel][0] * force[0] + d->drive_from_force[channel][1] * force[1]);
    if (!(real_abs(exact) < HUGE_NUMBER)) { /* NaN included */
        exact = REAL(0.0);
        law->flags |= LAW_NONFINITE;
        recover(law);
    }
    *most = real_max(*most, real_abs(exact) / law->drive_limit);
    if (!(law->confidence > REAL(0.0))) {
        law->shaper[0][channel] = REAL(0.0);
        law->shaper[1][channel] = REAL(0.0);
        exact = REAL(0.0);
    } else if (d->drive_step > REAL(0.0)) {
        exact = shape_noise(law, exact, channel);
    }
    return real_clip(exact, -law->drive_limit, law->drive_limit);
}

/* Write the drive; what of it is not the nominal force goes into the ring with the basis. */
static void play(law_t *law, const real_t force[2], const real_t nominal[2], real_t drive[])
{
    const design_t *d = law->design;
    real_t *entry = law->ring[law->at_ring];
    real_t played[2] = {REAL(0.0), REAL(0.0)};
    real_t most = REAL(0.0);
    for (uint32_t i = 0u; i < LAW_CHANNELS; i++) {
        drive[i] = drive_of(law, i, force, &most);
        played[0] += d->force_from_drive[0][i] * drive[i];
        played[1] += d->force_from_drive[1][i] * drive[i];
    }
    if ((most > REAL(1.0)) || (law->smooth_scale < SCALED)) {
        law->flags |= LAW_SATURATED;
    }
    scale_reference(law, most / law->smooth_scale);
    const uint32_t sane = (real_abs(nominal[0]) + real_abs(nominal[1]) < HUGE_NUMBER) ? 1u : 0u;
    (void)memcpy(entry, law->basis, sizeof(law->basis));
    entry[LAW_BASIS] = (sane != 0u) ? (played[0] - nominal[0]) : REAL(0.0);
    entry[LAW_BASIS + 1] = (sane != 0u) ? (played[1] - nominal[1]) : REAL(0.0);
    law->at_ring = (law->at_ring + 1u) % (uint32_t)(LAW_DELAY + 1);
}

uint32_t law_step(law_t *law, const real_t sensed[], real_t position, real_t reference, real_t drive[])
{
    real_t coordinates[2];
    real_t force[2] = {REAL(0.0), REAL(0.0)};
    real_t nominal[2];
    real_t learned[2];
    law->flags = ((real_abs(position) > FARTHEST) || !(real_abs(reference) <= FARTHEST)) ? LAW_NONFINITE : 0u;
    const uint32_t invalid = sense(law, sensed, coordinates);
    finger_track(&law->finger, position, law->design->rate);
    bands_advance(law);
    const uint32_t learns = learning_follow_contact(law);
    take_reference(law, reference);
    law->at_past = (law->at_past + LAW_PAST - 1u) % LAW_PAST;
    update_confidence(law, invalid);
    if (!(law->confidence > REAL(0.0))) {
        learning_reset(law, 0u, LAW_PARAMETERS);
        note_deviation(law, 0u, REAL(0.0));
        note_deviation(law, 1u, REAL(0.0));
    } else if (law->design->learns == 0u) {
        /* open loop */
    } else if (invalid != 0u) {
        hold_deviations(law, force);
    } else {
        use_sensors(law, coordinates, learns, force);
    }
    if ((law->sample % REVERSION) == 0u) {
        learning_revert(law);
    }
    if ((law->sample % LEARNING_REFRESH) == 0u) {
        learning_discretise(law);
    }
    nominal_force(law, nominal);
    learning_force(law, learned);
    update_powers(law, nominal[0], learned[0]);
    force[0] += nominal[0] + learned[0];
    force[1] += nominal[1] + learned[1] + levelling_force(law);
    play(law, force, nominal, drive);
    learning_advance(law, law->ring[law->at_ring]); /* what was computed LAW_DELAY samples ago acts now */
    law->sample++;
    return law->flags;
}

real_t law_carrier(const design_t *used, real_t drive)
{
    return (LAW_FRICTION != 0u) ? real_sqrt(real_max(used->bias + drive, used->least) / used->attraction) : drive;
}

real_t law_mismatch(const law_t *law)
{
    const design_t *d = law->design;
    const real_t least = LEAST_TARGET * d->sensor_limit;
    const uint32_t settled = (real_min((real_t)law->sample, (real_t)law->learning.since) >= d->rate) ? 1u : 0u;
    const uint32_t free = ((law->learning.contact == 0u) && (d->learns != 0u)) ? 1u : 0u;
    const uint32_t moves = ((law->nominal_power > REAL(0.0)) && (REAL(2.0) * law->reference_power > least * least)) ? 1u : 0u;
    const uint32_t known = ((settled + free + moves == 3u) && (law->smooth_scale > SCALED)) ? 1u : 0u;
    return (known != 0u) ? real_sqrt(law->learned_power / law->nominal_power) : REAL(0.0);
}

real_t law_reference(const law_t *law) { return law->reference / law->smooth_scale; }
