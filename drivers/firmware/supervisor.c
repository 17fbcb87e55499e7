/* Tests of the supervision and the fade-out; as hapticrender/control/supervisor_kernel.py. */
#include "supervisor.h"

#include <string.h>

#define ROOT2 REAL(1.4142135623730951)
#define INVALID_SHARE REAL(0.3)
#define MOST_KEPT 2u /* samples that are numbers, between two that are not */
#define REPEAT_FACTOR 5u /* times the longest repetition before: converters may hold their values */
#define BY_DRIVE REAL(6.0) /* energy of the residual over that of the force: in a fault the residual is the drive */
#define POWER REAL(0.6)
#define SLOW_POWER REAL(0.65)
#define SLOW_FORCE REAL(3.0)
#define RINGING_STEP REAL(0.4)
#define MOTION_SAMPLES 5u

void supervisor_init(supervisor_t *supervisor, const supervision_t *used, const design_t *played)
{
    (void)memset(supervisor, 0, sizeof(*supervisor));
    supervisor->p = used;
    supervisor->design = played;
    supervisor->sensed_bound = used->sensed_bound;
    supervisor->fade = REAL(1.0);
    supervisor->away = played->loss_time + 2u; /* no contact yet */
}

static uint32_t counted(uint32_t count, uint32_t holds) { return (holds != 0u) ? (count + 1u) : 0u; }

static uint32_t less_one(uint32_t count) { return (count > 0u) ? (count - 1u) : 0u; }

/* Whether a sensor has repeated a value for long while the drive moved. */
static uint32_t is_frozen(supervisor_t *s, uint32_t i, real_t value, real_t drive)
{
    const uint32_t most_usual = s->p->frozen_time;
    uint32_t least_time;
    if ((value < s->last[i]) || (value > s->last[i])) {
        s->longest[i] = (s->repeats[i] > s->longest[i]) ? s->repeats[i] : s->longest[i];
        s->last[i] = value;
        s->repeats[i] = 1u;
        s->least[i] = drive;
        s->most[i] = drive;
        return 0u;
    }
    s->repeats[i] += 1u;
    s->least[i] = real_min(s->least[i], drive);
    s->most[i] = real_max(s->most[i], drive);
    least_time = REPEAT_FACTOR * (((s->longest[i] > 0u) && (s->longest[i] < most_usual)) ? s->longest[i] : most_usual);
    least_time = (least_time > most_usual) ? least_time : most_usual;
    return ((s->repeats[i] >= least_time) && (s->most[i] - s->least[i] > s->p->frozen_drive)) ? 1u : 0u;
}

/* Whether samples have been no numbers for too long, with at most MOST_KEPT between them that are. */
static uint32_t is_broken(supervisor_t *s, uint32_t lost)
{
    if (lost == 0u) {
        s->kept += 1u;
        return 0u;
    }
    s->broken = ((s->kept <= MOST_KEPT) ? (s->broken + s->kept) : 0u) + 1u;
    s->kept = 0u;
    return (s->broken >= s->p->invalid_time) ? 1u : 0u;
}

static supervisor_cause_t cause_of(
    supervisor_t *s, uint32_t invalid, uint32_t frozen, uint32_t beyond, uint32_t broken)
{
    supervisor_cause_t cause = SUPERVISOR_FINE;
    uint32_t sensors = 0u;
    s->invalid += s->p->invalid_smoothing * (((invalid != 0u) ? REAL(1.0) : REAL(0.0)) - s->invalid);
    if ((broken != 0u) || ((invalid != 0u) && (s->invalid > INVALID_SHARE))) {
        cause = SUPERVISOR_INVALID;
        sensors = invalid;
    } else if (frozen != 0u) {
        cause = SUPERVISOR_FROZEN;
        sensors = frozen;
    }
    s->beyond_count = (beyond != 0u) ? (s->beyond_count + s->p->beyond_time) : less_one(s->beyond_count);
    if ((beyond != 0u) && (s->beyond_count > 2u * s->p->beyond_time)) {
        cause = SUPERVISOR_BEYOND;
        sensors = beyond;
    }
    if ((cause != SUPERVISOR_FINE) && (s->cause == SUPERVISOR_FINE)) {
        s->stopped_sensors = sensors;
    }
    return cause;
}

/* Convert a sample's sensors to coordinates, an invalid one (a bit of `which`) held; tests 1, 2 and 8 against the sum of
 * the drive. */
static supervisor_cause_t check_sensors(supervisor_t *s, const real_t sensed[], real_t drive, uint32_t *which)
{
    const design_t *d = s->design;
    uint32_t invalid = 0u;
    uint32_t frozen = 0u;
    uint32_t beyond = 0u;
    uint32_t lost = 0u;
    s->input[0] = REAL(0.0);
    s->input[1] = REAL(0.0);
    for (uint32_t i = 0u; i < LAW_SENSORS; i++) {
        const real_t size = real_abs(sensed[i]);
        if (!(size < d->sensor_limit)) { /* NaN included */
            invalid |= 1u << i;
            lost |= isfinite(sensed[i]) ? 0u : 1u;
        } else if (is_frozen(s, i, sensed[i], drive) != 0u) {
            frozen |= 1u << i;
        }
        if ((size < d->sensor_limit) && (size > s->sensed_bound)) {
            beyond |= 1u << i;
        }
        s->input[0] += d->coordinate_from_sensor[0][i] * s->last[i];
        s->input[1] += d->coordinate_from_sensor[1][i] * s->last[i];
    }
    *which = invalid;
    return cause_of(s, invalid, frozen, beyond, is_broken(s, lost));
}

/* Filter coordinates and forces; the state-variable low-pass gives a signal and its derivatives at once. */
static void filter_signals(supervisor_t *s)
{
    const supervision_t *p = s->p;
    supervisor_filter_t *f = &s->filter;
    for (uint32_t i = 0u; i < 4u; i++) {
        real_t step = p->low * (s->input[i] - f->low[i]);
        const real_t x = f->low[i] + step;
        f->low[i] = x + step;
        step = p->high * (x - f->high[i]);
        const real_t mean = f->high[i] + step;
        f->high[i] = mean + step;
        const real_t top = p->top_gain * (x - mean - f->level[i] - (p->corner + ROOT2) * f->band[i]);
        const real_t band = f->band[i] + p->corner * top;
        const real_t level = f->level[i] + p->corner * band;
        f->band[i] = band + p->corner * top;
        f->level[i] = level + p->corner * band;
        f->value[i] = level;
        f->rate[i] = p->omega * band;
        f->change[i] = p->omega * p->omega * top;
    }
}

static void mean(real_t *value, real_t smoothing, real_t sample) { *value += smoothing * (sample - *value); }

/* Test 4, slowly: whether heave has been driven on by what the model lacks for long, as no finger does. */
static uint32_t check_growth(supervisor_t *s, real_t residual)
{
    const supervision_t *p = s->p;
    const real_t force = s->filter.value[2];
    const real_t rate = s->filter.rate[0];
    mean(&s->slow[0], p->slow_smoothing, -residual * rate);
    mean(&s->slow[1], p->slow_smoothing, rate * rate);
    mean(&s->slow[2], p->slow_smoothing, force * force);
    mean(&s->slow[3], p->slow_smoothing, residual * residual);
    const real_t most = SLOW_POWER * SLOW_POWER * s->slow[1] * s->slow[2];
    const uint32_t driven = ((s->slow[0] > REAL(0.0)) && (s->slow[0] * s->slow[0] > most)) ? 1u : 0u;
    const uint32_t is_fault =
        ((s->slow[3] < BY_DRIVE * s->slow[2]) && (s->slow[2] > SLOW_FORCE * p->noise[0])) ? 1u : 0u;
    s->slow_count = counted(s->slow_count, driven & is_fault);
    return (s->slow_count >= p->slow_time) ? 1u : 0u;
}

/* Update the energies of a coordinate; returns the residual force, of which `change` is that of the drive. */
static real_t update_energies(supervisor_t *s, uint32_t i, real_t change)
{
    const supervision_t *p = s->p;
    const supervisor_filter_t *f = &s->filter;
    const real_t smoothing = p->energy_smoothing;
    real_t r = f->value[2u + i];
    for (uint32_t j = 0u; j < 2u; j++) {
        r -= p->mass[i][j] * f->change[j] + p->damping[i][j] * f->rate[j] + p->stiffness[i][j] * f->value[j];
    }
    mean(&s->energy[i], smoothing, f->value[i] * f->value[i]);
    mean(&s->energy[2u + i], smoothing, f->rate[i] * f->rate[i]);
    mean(&s->energy[4u + i], smoothing, f->change[i] * f->change[i]);
    mean(&s->energy[6u + i], smoothing, change * change);
    mean(&s->energy[8u + i], smoothing, f->value[2u + i] * f->value[2u + i]);
    mean(&s->energy[10u + i], smoothing, r * r);
    mean(&s->power[i], p->power_smoothing, -r * f->rate[i]);
    return r;
}

/* Whether the residual is more than finger, load, model and noise explain; whether a coordinate is driven by it. */
static void judge_energies(const supervisor_t *s, uint32_t *wrong, uint32_t *active)
{
    for (uint32_t i = 0u; i < 2u; i++) {
        const real_t *e = s->energy;
        const real_t power = s->power[i];
        const uint32_t by_drive = (e[10u + i] < BY_DRIVE * e[8u + i]) ? 1u : 0u;
        real_t bound = s->p->noise[i];
        for (uint32_t j = 0u; j < 8u; j++) {
            bound += s->p->bound[i][j] * e[j];
        }
        *wrong |= ((by_drive != 0u) && (e[10u + i] > bound)) ? 1u : 0u;
        const uint32_t driven =
            ((power > REAL(0.0)) && (power * power > POWER * POWER * e[8u + i] * e[2u + i])) ? 1u : 0u;
        *active |= by_drive & driven;
    }
}

/* Tests 3, 4 and 7: whether the motion follows from the drive. */
static supervisor_cause_t check_motion(supervisor_t *s)
{
    const supervision_t *p = s->p;
    const real_t last[2] = {s->filter.value[2], s->filter.value[3]};
    uint32_t wrong = 0u;
    uint32_t active = 0u;
    uint32_t grows = 0u;
    filter_signals(s);
    const real_t motion = real_abs(s->filter.value[0]) + p->lever * real_abs(s->filter.value[1]);
    const uint32_t danger = ((s->peak > p->danger_drive) || (motion > p->danger_motion)) ? 1u : 0u;
    for (uint32_t i = 0u; i < 2u; i++) {
        const real_t residual = update_energies(s, i, s->filter.value[2u + i] - last[i]);
        if (i == 0u) {
            grows = check_growth(s, residual);
        }
    }
    judge_energies(s, &wrong, &active);
    wrong &= ((danger != 0u) || (s->contact_count == 0u)) ? 1u : 0u; /* a contact that begins or ends is no fault */
    if (wrong != 0u) {
        s->inconsistent_count += (danger != 0u) ? 4u : 1u;
    } else {
        s->inconsistent_count = less_one(less_one(s->inconsistent_count));
    }
    s->active_count = counted(s->active_count, active & danger);
    s->motion_count = counted(s->motion_count, (motion > p->most_motion) ? 1u : 0u);
    if (s->motion_count >= MOTION_SAMPLES) {
        return SUPERVISOR_OVERMOTION;
    }
    if ((s->active_count >= p->active_time) || (grows != 0u)) {
        return SUPERVISOR_ACTIVE;
    }
    return (s->inconsistent_count >= p->inconsistent_time) ? SUPERVISOR_INCONSISTENT : SUPERVISOR_FINE;
}

/* Test 5, on the drive of the last sample. */
static uint32_t check_drive(supervisor_t *s, const real_t drive[])
{
    uint32_t large = 0u;
    s->peak = REAL(0.0);
    for (uint32_t i = 0u; i < LAW_CHANNELS; i++) {
        s->peak = real_max(s->peak, real_abs(drive[i]));
        mean(&s->drive_energy[i], s->p->drive_smoothing, drive[i] * drive[i]);
        large |= (s->drive_energy[i] > s->p->most_drive) ? 1u : 0u;
    }
    s->drive_count = counted(s->drive_count, large);
    return (s->drive_count > s->p->drive_time) ? 1u : 0u;
}

/* Damper's force beyond the ringing frequency: a high-pass of fourth order; whether its energy is too large. */
static uint32_t rings(supervisor_t *s, const law_t *law)
{
    const supervision_t *p = s->p;
    const real_t g = p->ring_corner;
    uint32_t over = 0u;
    for (uint32_t i = 0u; i < 2u; i++) {
        real_t top = law->damper_force[i];
        for (uint32_t j = i; j < 4u; j += 2u) {
            top = p->ring_top_gain * (top - s->filter.ring_level[j] - (g + ROOT2) * s->filter.ring_band[j]);
            const real_t band = s->filter.ring_band[j] + g * top;
            s->filter.ring_band[j] = band + g * top;
            s->filter.ring_level[j] += REAL(2.0) * g * band;
        }
        mean(&s->ring_energy[i], p->ring_smoothing, top * top);
        over |= ((s->ring_energy[i] > p->ringing[i]) && (p->ringing[i] > REAL(0.0))) ? 1u : 0u;
    }
    return over;
}

/* Test 6: turn a ringing inner damper down to 0.4, then to 0; whether it rings all the same. */
static uint32_t check_ringing(supervisor_t *s, law_t *law)
{
    const supervision_t *p = s->p;
    if (!(law->damper_gain > REAL(0.0)) && !(law->damper_scale < REAL(1.0))) { /* off by its schedule */
        return 0u;
    }
    s->suspended = (s->peak > p->large_drive) ? p->suspension_time : less_one(s->suspended);
    const uint32_t over = rings(s, law);
    s->ring_wait_count = less_one(s->ring_wait_count);
    s->ring_count =
        counted(s->ring_count, ((over != 0u) && (s->suspended == 0u) && (s->ring_wait_count == 0u)) ? 1u : 0u);
    if ((law->damper_scale > REAL(0.0)) && (s->ring_count >= p->ring_time)) {
        law->damper_scale = (law->damper_scale < REAL(1.0)) ? REAL(0.0) : RINGING_STEP;
        s->ring_count = 0u;
        s->ring_wait_count = p->ring_wait_time;
    }
    return (s->ring_count >= p->ring_stop_time) ? 1u : 0u;
}

/* Test 4, by the damper: whether its force has been far beyond its limit for longer than in any contact. */
static uint32_t check_limit(supervisor_t *s, const law_t *law)
{
    uint32_t over = 0u;
    if (!(law->damper_gain > REAL(0.0))) {
        s->limit_energy[0] = REAL(0.0);
        s->limit_energy[1] = REAL(0.0);
        s->limit_count = 0u;
        return 0u;
    }
    for (uint32_t i = 0u; i < 2u; i++) {
        const real_t force = law->damper_gain * law->damper_force[i];
        mean(&s->limit_energy[i], s->p->ring_smoothing, force * force);
        over |= ((s->limit_energy[i] > s->p->most_damping) && (s->p->most_damping > REAL(0.0))) ? 1u : 0u;
    }
    s->limit_count = counted(s->limit_count, over);
    return (s->limit_count >= s->p->limit_time) ? 1u : 0u;
}

/* Limit of the drive that the heat, the mean of its square, leaves. */
static real_t limit_by_heat(const supervisor_t *s)
{
    real_t most = REAL(0.0);
    for (uint32_t i = 0u; i < LAW_CHANNELS; i++) {
        most = real_max(most, s->heat[i]);
    }
    return real_sqrt(real_max(s->p->drive_limit * s->p->drive_limit - s->p->heat_gain * most, REAL(0.0)));
}

/* Cut a sample's drive to the limit that its heat leaves, and pass the next sample's limit on to the law. */
static uint32_t limit_rms_drive(supervisor_t *s, law_t *law, real_t drive[])
{
    uint32_t flags = 0u;
    const real_t limit = limit_by_heat(s);
    for (uint32_t i = 0u; i < LAW_CHANNELS; i++) {
        flags |= (real_abs(drive[i]) > limit) ? LAW_SATURATED : 0u;
        drive[i] = real_clip(drive[i], -limit, limit);
        mean(&s->heat[i], s->p->heat_smoothing, drive[i] * drive[i]);
    }
    if (s->p->limited != 0u) {
        law->drive_limit = limit_by_heat(s);
    }
    return flags;
}

/* Tests 9 to 11: whether a sensor or an actuator has changed its gain, or two are swapped. */
static supervisor_cause_t compare_gains(supervisor_t *s, supervisor_cause_t cause, uint32_t invalid)
{
    gain_faults_t found = gains_check(&s->gains, &s->p->gains, s->last, invalid, s->force);
    for (uint32_t i = 0u; i < LAW_SENSORS; i++) {
        if (2u * s->repeats[i] > s->p->frozen_time) { /* that is for test 2 to find */
            found.sensors &= ~(1u << i);
            found.swapped = 0u;
        }
    }
    if ((cause != SUPERVISOR_FINE) || ((found.sensors | found.swapped | found.actuators) == 0u)) {
        return cause;
    }
    if (found.swapped != 0u) {
        s->stopped_sensors = 3u;
        return SUPERVISOR_SWAPPED;
    }
    s->stopped_sensors = (found.sensors != 0u) ? found.sensors : found.actuators;
    return (found.sensors != 0u) ? SUPERVISOR_SENSOR_GAIN : SUPERVISOR_ACTUATOR_GAIN;
}

/* All tests of a sample; returns what failed first. */
static supervisor_cause_t check(supervisor_t *s, law_t *law, const real_t sensed[], const real_t drive[])
{
    uint32_t invalid = 0u;
    supervisor_cause_t cause = check_sensors(s, sensed, s->forces[s->at][2], &invalid);
    if ((check_drive(s, drive) != 0u) && (cause == SUPERVISOR_FINE)) {
        cause = SUPERVISOR_DRIVE;
    }
    if (s->p->modelled == 0u) {
        return cause;
    }
    if (s->started == 0u) { /* a steady load is no motion */
        (void)memcpy(s->filter.low, s->input, sizeof(s->filter.low));
        (void)memcpy(s->filter.high, s->input, sizeof(s->filter.high));
        for (uint32_t i = 0u; i < 2u; i++) {
            s->gains.models[0][i] = s->input[i];
            s->gains.models[0][4u + i] =
                s->p->stiffness[i][0] * s->input[0] + s->p->stiffness[i][1] * s->input[1];
        }
        s->started = 1u;
    }
    const supervisor_cause_t found = check_motion(s);
    cause = ((cause == SUPERVISOR_FINE) || (found == SUPERVISOR_OVERMOTION)) ? found : cause;
    if ((s->p->damped != 0u) && (check_ringing(s, law) != 0u) && (cause == SUPERVISOR_FINE)) {
        cause = SUPERVISOR_RINGING;
    }
    if ((s->p->damped != 0u) && (check_limit(s, law) != 0u) && (cause == SUPERVISOR_FINE)) {
        cause = SUPERVISOR_ACTIVE;
    }
    if ((s->p->compared != 0u) && (s->cause == SUPERVISOR_FINE)) {
        cause = compare_gains(s, cause, invalid);
    }
    return cause;
}

/* Count the time since a contact began or ended; a single position that is missing is no lift-off. */
static void note_contact(supervisor_t *s, uint32_t touched)
{
    const uint32_t loss = (s->design->loss_time > 0u) ? s->design->loss_time : 1u;
    const uint32_t away = (touched != 0u) ? 0u : ((s->away <= loss) ? (s->away + 1u) : s->away);
    const uint32_t begins = ((away == 0u) && (s->away >= loss)) ? 1u : 0u;
    s->contact_count = ((begins != 0u) || (away == loss)) ? s->p->drive_time : less_one(s->contact_count);
    s->away = away;
}

uint32_t supervisor_step(
    supervisor_t *supervisor, law_t *law, const real_t sensed[], real_t position, real_t reference, real_t drive[])
{
    supervisor_t *s = supervisor;
    uint32_t flags = 0u;
    (void)memset(drive, 0, LAW_CHANNELS * sizeof(drive[0]));
    if (s->fade > REAL(0.0)) {
        flags = law_step(law, sensed, position, reference, drive);
    }
    const uint32_t later = (s->at > 0u) ? (s->at - 1u) : (uint32_t)LAW_DELAY; /* when this sample's drive acts */
    for (uint32_t i = 0u; i < 2u; i++) {
        s->input[2u + i] = REAL(0.5) * (s->force[i] + s->forces[s->at][i]);
        s->force[i] = s->forces[s->at][i];
    }
    note_contact(s, isfinite(position) ? 1u : 0u);
    const supervisor_cause_t cause = check(s, law, sensed, drive);
    s->cause = (s->cause == SUPERVISOR_FINE) ? cause : s->cause;
    if (s->cause != SUPERVISOR_FINE) {
        s->fade_step = real_max(s->fade_step, (cause == SUPERVISOR_OVERMOTION) ? s->p->fade_now : s->p->fade_out);
        s->fade = real_max(s->fade - s->fade_step, REAL(0.0));
        flags |= SUPERVISOR_STOPPED;
    }
    if (s->p->heat_smoothing > REAL(0.0)) {
        flags |= limit_rms_drive(s, law, drive);
    }
    real_t *sent = s->forces[later];
    (void)memset(sent, 0, sizeof(s->forces[later]));
    for (uint32_t i = 0u; i < LAW_CHANNELS; i++) {
        drive[i] *= s->fade;
        sent[0] += s->design->force_from_drive[0][i] * drive[i];
        sent[1] += s->design->force_from_drive[1][i] * drive[i];
        sent[2] += drive[i];
    }
    s->at = (s->at + 1u) % (uint32_t)(LAW_DELAY + 1);
    return flags;
}
