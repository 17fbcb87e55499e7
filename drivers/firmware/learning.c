/* Learning by a Kalman filter with the device's model behind it; as hapticrender/control/inverse_learning.py. */
#include "law_parts.h"

#include <string.h>

#define FARTHEST_LEVER REAL(2.0) /* no surface is longer */
#define UNREPORTED REAL(15e3)    /* N/m, of the coupling, for a finger whose place is not known yet: 12 N s/m or 10 g */
#define INNOVATIONS REAL(10.0)   /* weight of their mean square in `model_power`: a tenth of it is noise */
#define LONG_AGO 1000000000u     /* samples since the contact of a law at rest */
#ifdef REAL_DOUBLE
#define TERMS 10u                /* of the series of the exponential, whose rest is below a rounding: 0.5^11/11! */
#else
#define TERMS 7u
#endif
#define MOST_HALVINGS 30u        /* of its step, until it converges */
#define FINGER_HERTZ REAL(180.0) /* where the finger counts by its mass and damping */

/* Symmetric 2 x 2 matrices: the loaded device. */
typedef struct {
    real_t m00, m01, m11, c00, c01, c11, k00, k01, k11;
} loaded_t;

/* A positive number moved by a change that leaves it between 0.3 and 5 times what it was. */
static real_t corrected(real_t value, real_t change)
{
    return value + real_clip(change, REAL(-0.7) * value, REAL(4.0) * value);
}

/* A change of a coupling, within a fifth of rocking's own: determinants stay positive. */
static real_t coupled(real_t value, real_t change)
{
    return real_clip(change, REAL(-0.2) * value, REAL(0.2) * value);
}

/* The device with what was learned of it, and the finger by its mass and damping at 180 Hz. */
static loaded_t load_device(const learning_t *v, const design_t *d)
{
    const real_t *theta = v->theta;
    const real_t w = TURN * FINGER_HERTZ;
    const real_t turn = w / d->omega_n;
    const real_t pole = d->pole;
    const real_t low_re = pole * pole - w * w;
    const real_t low_im = REAL(2.0) * d->pole_damping * pole * w;
    const real_t over = REAL(1.0) / (low_re * low_re + low_im * low_im);
    const real_t a = theta[3] * pole * pole;
    const real_t b = theta[4] * pole * w;
    const real_t z_re = theta[0] - theta[2] * turn * turn + (a * low_re + b * low_im) * over;
    const real_t z_im = theta[1] * turn + (b * low_re - a * low_im) * over;
    const real_t touched = (real_t)v->contact;
    const real_t lightest = -real_min(REAL(2e-3), REAL(0.2) * d->mass[0][0]);
    const real_t mass = real_clip(-z_re / (w * w), lightest, REAL(10e-3)) * touched;
    const real_t damping = real_clip(z_im / w, REAL(0.0), REAL(12.0)) * touched;
    const real_t h = v->lever;
    const real_t per_c = REAL(1.0) / d->omega_n;
    const real_t per_m = per_c * per_c;
    loaded_t p;
    p.m00 = corrected(d->mass[0][0], per_m * theta[LAW_HEAVE + 2]) + mass;
    p.m01 = d->mass[0][1] + coupled(d->mass[1][1], per_m * theta[LAW_COUPLING + 2]) + h * mass;
    p.m11 = d->mass[1][1] + h * h * mass;
    p.c00 = corrected(d->damping[0][0], per_c * theta[LAW_HEAVE + 1]) + damping;
    p.c01 = d->damping[0][1] + coupled(d->damping[1][1], per_c * theta[LAW_COUPLING + 1]) + h * damping;
    p.c11 = corrected(d->damping[1][1], per_c * theta[LAW_HEAVE + 1]) + h * h * damping;
    p.k00 = corrected(d->stiffness[0][0], theta[LAW_HEAVE]);
    p.k01 = d->stiffness[0][1] + coupled(d->stiffness[1][1], theta[LAW_COUPLING]);
    p.k11 = corrected(d->stiffness[1][1], theta[LAW_HEAVE]);
    return p;
}

/* Rows of [A, B] T for coordinates and velocities; returns how often the step was halved for the series. */
static uint32_t assemble(real_t flow[4][6], const loaded_t *p, real_t rate)
{
    const real_t scale = REAL(1.0) / (p->m00 * p->m11 - p->m01 * p->m01);
    const real_t n00 = scale * p->m11;
    const real_t n01 = -scale * p->m01;
    const real_t n11 = scale * p->m00;
    real_t period = REAL(1.0) / rate;
    const real_t rates = p->c00 + real_abs(p->c01) + p->c11 + period * (p->k00 + real_abs(p->k01) + p->k11);
    real_t size = (real_abs(n00) + real_abs(n01) + real_abs(n11)) * rates * period; /* bounds the norm */
    uint32_t halvings = 0u;
    while ((size > REAL(0.5)) && (halvings < MOST_HALVINGS)) {
        size *= REAL(0.5);
        period *= REAL(0.5);
        halvings++;
    }
    const real_t inverse[2][2] = {{period * n00, period * n01}, {period * n01, period * n11}};
    for (uint32_t i = 0u; i < 2u; i++) {
        for (uint32_t j = 0u; j < 6u; j++) {
            flow[i][j] = (j == i + 2u) ? period : REAL(0.0);
        }
        const real_t near = inverse[i][0];
        const real_t far = inverse[i][1];
        flow[i + 2u][0] = -near * p->k00 - far * p->k01;
        flow[i + 2u][1] = -near * p->k01 - far * p->k11;
        flow[i + 2u][2] = -near * p->c00 - far * p->c01;
        flow[i + 2u][3] = -near * p->c01 - far * p->c11;
        flow[i + 2u][4] = near;
        flow[i + 2u][5] = far;
    }
    return halvings;
}

/* Rows from `first` on of out = scale left[:, :4] right, of 4 rows and 6 columns. */
static void multiply(real_t out[4][6], real_t left[4][6], real_t right[4][6], real_t scale, uint32_t first)
{
    for (uint32_t i = first; i < 4u; i++) {
        for (uint32_t j = 0u; j < 6u; j++) {
            real_t sum = REAL(0.0);
            for (uint32_t k = 0u; k < 4u; k++) {
                sum += left[i][k] * right[k][j];
            }
            out[i][j] = scale * sum;
        }
    }
}

/* Exact step of the loaded device over a sample. */
void learning_discretise(law_t *law)
{
    learning_t *v = &law->learning;
    const loaded_t loaded = load_device(v, law->design);
    real_t flow[4][6];
    real_t power[4][6];
    real_t next[4][6];
    const uint32_t halvings = assemble(flow, &loaded, law->design->rate);
    for (uint32_t i = 0u; i < 4u; i++) {
        for (uint32_t j = 0u; j < 6u; j++) {
            power[i][j] = flow[i][j];
            v->step[i][j] = flow[i][j] + ((i == j) ? REAL(1.0) : REAL(0.0));
        }
    }
    for (uint32_t term = 2u; term <= TERMS; term++) {
        const real_t scale = REAL(1.0) / (real_t)term;
        multiply(next, flow, power, scale, 2u);
        for (uint32_t j = 0u; j < 6u; j++) { /* what is left of the upper rows of A T: the velocities */
            next[0][j] = scale * flow[0][2] * power[2][j];
            next[1][j] = scale * flow[1][3] * power[3][j];
        }
        for (uint32_t i = 0u; i < 4u; i++) {
            for (uint32_t j = 0u; j < 6u; j++) {
                power[i][j] = next[i][j];
                v->step[i][j] += next[i][j];
            }
        }
    }
    for (uint32_t n = 0u; n < halvings; n++) { /* Phi(2 h) = Phi Phi, Gamma(2 h) = Phi Gamma + Gamma */
        multiply(next, v->step, v->step, REAL(1.0), 0u);
        for (uint32_t i = 0u; i < 4u; i++) {
            for (uint32_t j = 0u; j < 6u; j++) {
                v->step[i][j] = next[i][j] + ((j >= 4u) ? v->step[i][j] : REAL(0.0));
            }
        }
    }
}

/* Set parameters back to their prior; nothing else is known of them. */
void learning_reset(law_t *law, uint32_t first, uint32_t last)
{
    learning_t *v = &law->learning;
    for (uint32_t i = first; i < last; i++) {
        v->theta[i] = law->design->prior[i];
        for (uint32_t j = 0u; j < LAW_PARAMETERS; j++) {
            const real_t prior = ((j >= first) && (j < last)) ? law->design->prior_covariance[i][j] : REAL(0.0);
            v->covariance[i][j] = prior;
            v->covariance[j][i] = prior;
        }
        for (uint32_t k = 0u; k < 4u; k++) {
            v->states[k][i] = REAL(0.0);
        }
    }
}

/* Note the device's own parameters (last row) and their covariance, and keep the last note. */
static void note_device(learning_t *v)
{
    for (uint32_t i = 0u; i < LAW_OWN; i++) {
        for (uint32_t j = 0u; j <= LAW_OWN; j++) {
            v->earlier[0][j][i] = v->earlier[1][j][i];
            v->earlier[1][j][i] =
                (j == LAW_OWN) ? v->theta[LAW_HEAVE + i] : v->covariance[LAW_HEAVE + j][LAW_HEAVE + i];
        }
    }
}

/* Start the regressors from rest, with the deviation of now as four more parameters. */
static void restart_regressors(law_t *law)
{
    learning_t *v = &law->learning;
    (void)memset(v->states, 0, sizeof(v->states));
    for (uint32_t k = 0u; k < 4u; k++) {
        v->states[k][LAW_INITIAL + k] = REAL(1.0);
        v->theta[LAW_INITIAL + k] = REAL(0.0);
        v->covariance[LAW_INITIAL + k][LAW_INITIAL + k] = law->design->initial_variance[k];
    }
}

/*
 * Set the device's own parameters, whose covariance with others is that of the prior, back to the earlier note: a
 * contact is reported after it happened.
 */
static void restore_device(law_t *law)
{
    learning_t *v = &law->learning;
    (void)memcpy(v->earlier[1], v->earlier[0], sizeof(v->earlier[1]));
    for (uint32_t i = 0u; i < LAW_OWN; i++) {
        v->theta[LAW_HEAVE + i] = v->earlier[0][LAW_OWN][i];
        (void)memcpy(&v->covariance[LAW_HEAVE + i][LAW_HEAVE], v->earlier[0][i], sizeof(v->earlier[0][i]));
    }
}

/*
 * Learn afresh, with the deviation of now as four more parameters.  The estimates stay, but for the device's own; the
 * covariance of all others returns to the prior.
 */
static void restart(law_t *law)
{
    learning_t *v = &law->learning;
    (void)memcpy(v->covariance, law->design->prior_covariance, sizeof(v->covariance));
    restore_device(law);
    restart_regressors(law);
}

/*
 * Learn at once from a deviation that no report explains: a touch and a lift are reported late.  An untouched device
 * counts as touched in the middle, until the report is due; of a finger that may have left all is uncertain alike.
 */
void learning_suspect_change(law_t *law)
{
    learning_t *v = &law->learning;
    const design_t *d = law->design;
    for (uint32_t i = LAW_LOAD; i < LAW_PARAMETERS; i++) {
        for (uint32_t j = 0u; j < LAW_PARAMETERS; j++) {
            v->covariance[i][j] = d->prior_covariance[i][j];
            v->covariance[j][i] = d->prior_covariance[i][j];
        }
    }
    if (v->contact != 0u) {
        v->since = d->relearning_delay;
        for (uint32_t i = LAW_FINGER; i < LAW_HEAVE; i++) {
            for (uint32_t j = LAW_FINGER; j < LAW_HEAVE; j++) {
                v->covariance[i][j] += v->theta[i] * v->theta[j];
            }
        }
    } else {
        v->contact = 1u;
        v->lever = REAL(0.0);
        v->away = -(int32_t)d->report_delay;
        v->since = d->learning_delay;
        for (uint32_t i = LAW_COUPLING; i < LAW_LOAD; i++) {
            v->covariance[i][i] += UNREPORTED * UNREPORTED;
        }
        v->covariance[LAW_LOAD + 1][LAW_LOAD + 1] = d->prior_covariance[LAW_LOAD][LAW_LOAD];
    }
    restart_regressors(law);
}

/* Reset what belongs to a contact when one begins or ends, and learn afresh; 1 where there is something to learn. */
uint32_t learning_follow_contact(law_t *law)
{
    learning_t *v = &law->learning;
    const design_t *d = law->design;
    const uint32_t sticks = ((LAW_FRICTION != 0u) && (law->finger.speed < d->least_speed)) ? 1u : 0u;
    uint32_t touching = (sticks != 0u) ? 0u : law->finger.seen;
    if (law->finger.seen != 0u) {
        v->lever = real_clip(d->lever_per_metre * law->finger.position, -FARTHEST_LEVER, FARTHEST_LEVER);
    }
    v->since += (v->since < UINT32_MAX) ? 1u : 0u;
    const uint32_t suspected = (v->away < 0) ? 1u : 0u;
    v->away = (touching != 0u) ? 0 : (v->away + ((v->away < INT32_MAX) ? 1 : 0));
    if ((suspected != 0u) && (touching != 0u)) { /* what was learned of the finger stays */
        v->since = 0u;
        law->fast_timer = d->damper_time;
        learning_reset(law, LAW_HEAVE, LAW_LOAD);
        restore_device(law);
    }
    const int32_t most = (suspected != 0u) ? 0 : (int32_t)d->loss_time;
    if ((v->contact != 0u) && (v->away < most)) { /* a position that is missing for so short is no lift-off */
        touching = 1u;
    }
    if (touching != v->contact) {
        v->contact = touching;
        v->since = 0u;
        learning_reset(law, LAW_FINGER, LAW_HEAVE);
        learning_reset(law, LAW_LOAD, LAW_PARAMETERS);
        law->fast_timer = d->damper_time;
        if ((law->sample % LEARNING_REFRESH) != 0u) { /* else it is due in this sample anyway */
            learning_discretise(law);
        }
    } else if ((v->since == d->learning_delay) || (v->since == d->relearning_delay)) {
        restart(law);
    } else if (v->since == d->initial_end) {
        learning_reset(law, LAW_INITIAL, LAW_PARAMETERS);
    } else if ((v->since > d->initial_end) && ((law->sample % d->report_delay) == 0u)) {
        note_device(v);
    }
    return (v->since >= d->learning_delay) ? 1u : 0u;
}

/*
 * First of the parameters that anything can be learned of now, and the one behind the last: those of the finger and of
 * the initial motion have no regressor, and no covariance with others, while there is neither.
 */
static uint32_t first_active(const learning_t *v) { return (v->contact != 0u) ? LAW_FINGER : LAW_HEAVE; }

static uint32_t end_active(const law_t *law)
{
    const uint32_t since = law->learning.since;
    const design_t *d = law->design;
    return ((since >= d->learning_delay) && (since < d->initial_end)) ? LAW_PARAMETERS : LAW_INITIAL;
}

/* Sum of the products of two rows' entries `first` to `end - 1`. */
static real_t dot(const real_t a[], const real_t b[], uint32_t first, uint32_t end)
{
    real_t sum = REAL(0.0);
    for (uint32_t i = first; i < end; i++) {
        sum += a[i] * b[i];
    }
    return sum;
}

/* Gains of both coordinates before either is used: the covariance times their regressors, in one pass over it. */
static void project(const learning_t *v, uint32_t first, uint32_t end, real_t gain[2][LAW_PARAMETERS])
{
    for (uint32_t i = first; i < end; i++) {
        const real_t *row = v->covariance[i];
        real_t heave = REAL(0.0);
        real_t rocking = REAL(0.0);
        for (uint32_t j = first; j < end; j++) {
            heave += row[j] * v->states[0][j];
            rocking += row[j] * v->states[1][j];
        }
        gain[0][i] = heave;
        gain[1][i] = rocking;
    }
}

/* Subtract what both coordinates explain; the covariance stays symmetric to the last bit. */
static void shrink(learning_t *v, uint32_t first, uint32_t end, real_t gain[2][LAW_PARAMETERS], const real_t precision[2])
{
    for (uint32_t i = first; i < end; i++) {
        const real_t heave = gain[0][i] * precision[0];
        const real_t rocking = gain[1][i] * precision[1];
        for (uint32_t j = i; j < end; j++) {
            const real_t left = v->covariance[i][j] - heave * gain[0][j] - rocking * gain[1][j];
            v->covariance[i][j] = left;
            v->covariance[j][i] = left;
        }
    }
}

/*
 * Update the parameters by the sensed deviations from the reference: a step of the Kalman filter by each coordinate,
 * one after the other; the gain of the second is what the first has left of it.
 */
void learning_update(law_t *law, const real_t error[2])
{
    learning_t *v = &law->learning;
    const design_t *d = law->design;
    const uint32_t first = first_active(v);
    const uint32_t end = end_active(law);
    real_t gain[2][LAW_PARAMETERS];
    real_t precision[2] = {REAL(0.0), REAL(0.0)};
    project(v, first, end, gain);
    for (uint32_t c = 0u; c < LAW_COORDINATES; c++) {
        const real_t *states = v->states[c];
        const real_t explained = states[LAW_PARAMETERS];
        if (c > 0u) {
            const real_t share = dot(states, gain[0], first, end) * precision[0];
            for (uint32_t i = first; i < end; i++) {
                gain[1][i] -= share * gain[0][i];
            }
        }
        const real_t innovation = error[c] - explained + dot(states, v->theta, first, end);
        const real_t square = explained * explained + INNOVATIONS * innovation * innovation;
        v->model_power[c] += d->mean_square_smoothing * (square - v->model_power[c]);
        const real_t scatter = d->noise[c] + d->model_error * v->model_power[c] + dot(gain[c], states, first, end);
        precision[c] = REAL(1.0) / scatter;
        for (uint32_t i = first; i < end; i++) {
            v->theta[i] -= gain[c][i] * precision[c] * innovation;
        }
    }
    shrink(v, first, end, gain, precision);
}

/* Move the parameters and their covariance a step back towards the prior; by 1 - a, as 1 - 1e-8 is 1 in float. */
void learning_revert(law_t *law)
{
    learning_t *v = &law->learning;
    const design_t *d = law->design;
    const uint32_t end = end_active(law);
    for (uint32_t i = 0u; i < end; i++) {
        v->theta[i] += d->reversion[i] * (d->prior[i] - v->theta[i]);
        for (uint32_t j = i; j < end; j++) {
            const real_t share = d->reversion[i] + d->reversion[j] - d->reversion[i] * d->reversion[j];
            const real_t found = v->covariance[i][j] + share * (d->prior_covariance[i][j] - v->covariance[i][j]);
            v->covariance[i][j] = found;
            v->covariance[j][i] = found;
        }
    }
}

/* Forces in heave and rocking that play what was learned of finger and device. */
void learning_force(const law_t *law, real_t force[2])
{
    const learning_t *v = &law->learning;
    const real_t *pattern = law->design->pattern;
    real_t finger = REAL(0.0);
    real_t heave = v->theta[LAW_HEAVE + 3] * law->basis[5];
    real_t rocking = REAL(0.0);
    for (uint32_t i = 0u; i < 5u; i++) {
        finger += v->theta[LAW_FINGER + i] * law->basis[i];
    }
    for (uint32_t i = 0u; i < 3u; i++) {
        heave += v->theta[LAW_HEAVE + i] * law->basis[i];
        rocking += v->theta[LAW_COUPLING + i] * law->basis[i];
    }
    finger *= (real_t)v->contact * (pattern[0] + v->lever * pattern[1]);
    force[0] = finger + pattern[0] * heave;
    force[1] = v->lever * finger + rocking;
}

/* Inputs of the regressors: forces in heave and rocking per unit of each parameter; `acting` is an entry of the ring. */
static void set_inputs(const law_t *law, const real_t acting[LAW_RING], real_t heave[], real_t rocking[])
{
    const learning_t *v = &law->learning;
    const real_t *pattern = law->design->pattern;
    const real_t touched = (real_t)v->contact;
    const real_t along = touched * (pattern[0] + v->lever * pattern[1]);
    for (uint32_t i = 0u; i < LAW_ROWS; i++) {
        heave[i] = REAL(0.0);
        rocking[i] = REAL(0.0);
    }
    for (uint32_t i = 0u; i < 5u; i++) {
        heave[LAW_FINGER + i] = along * acting[i];
        rocking[LAW_FINGER + i] = along * v->lever * acting[i];
    }
    for (uint32_t i = 0u; i < 3u; i++) {
        heave[LAW_HEAVE + i] = pattern[0] * acting[i];
        rocking[LAW_COUPLING + i] = acting[i];
    }
    heave[LAW_HEAVE + 3] = pattern[0] * acting[5];
    heave[LAW_LOAD] = REAL(1.0);
    rocking[LAW_LOAD] = touched * v->lever;
    rocking[LAW_LOAD + 1] = REAL(1.0);
    heave[LAW_PARAMETERS] = acting[LAW_BASIS];
    rocking[LAW_PARAMETERS] = acting[LAW_BASIS + 1];
}

/* A row of [Phi, Gamma] times states and forces. */
static inline real_t row_times(const real_t row[6], const real_t x[4], real_t heave, real_t rocking)
{
    return row[4] * heave + row[5] * rocking + row[0] * x[0] + row[1] * x[1] + row[2] * x[2] + row[3] * x[3];
}

/* Advance the regressors by a sample, under the basis and the deviation force that act in it. */
void learning_advance(law_t *law, const real_t acting[LAW_RING])
{
    learning_t *v = &law->learning;
    real_t heave[LAW_ROWS];
    real_t rocking[LAW_ROWS];
    real_t step[4][6]; /* a copy, which stays in registers */
    const uint32_t end = end_active(law);
    set_inputs(law, acting, heave, rocking);
    (void)memcpy(step, v->step, sizeof(step));
    for (uint32_t n = first_active(v); n <= end; n++) {
        const uint32_t i = (n < end) ? n : (uint32_t)LAW_PARAMETERS; /* dev_u comes last */
        const real_t x[4] = {v->states[0][i], v->states[1][i], v->states[2][i], v->states[3][i]};
        v->states[0][i] = row_times(step[0], x, heave[i], rocking[i]);
        v->states[1][i] = row_times(step[1], x, heave[i], rocking[i]);
        v->states[2][i] = row_times(step[2], x, heave[i], rocking[i]);
        v->states[3][i] = row_times(step[3], x, heave[i], rocking[i]);
    }
}

/* Reset all that was learned, and what was noted. */
void learning_reset_all(law_t *law)
{
    learning_t *v = &law->learning;
    learning_reset(law, 0u, LAW_PARAMETERS);
    note_device(v);
    note_device(v);
    for (uint32_t k = 0u; k < 4u; k++) {
        v->states[k][LAW_PARAMETERS] = REAL(0.0);
    }
    v->model_power[0] = REAL(0.0);
    v->model_power[1] = REAL(0.0);
    learning_discretise(law);
}

void learning_init(law_t *law)
{
    law->learning.since = LONG_AGO;
    learning_reset_all(law);
}
