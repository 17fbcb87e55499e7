/* The finger's tracker and the bands: phases, fades, targets; as hapticrender/control/carriers.py. */
#include "law_parts.h"

#define REFRESH 64u                          /* samples between two looks at other bands */
#define TRACKER_POLE (TURN * REAL(60.0))     /* rad/s: triple pole, no lag under constant acceleration */
#define FASTEST REAL(10.0)                   /* m/s: a finger that moves faster has been put down elsewhere */

/* e^(2 pi j turns); the polynomials are those of hapticrender/mathx.py, good to 2.8e-15. */
void unit(real_t turns, real_t *re, real_t *im)
{
    static const real_t sine[8] = {
        REAL(6.283185307179585), REAL(-41.341702240398284), REAL(81.60524927557972), REAL(-76.70585968962543),
        REAL(42.05868995380649), REAL(-15.094506137312086), REAL(3.8173655924824907), REAL(-0.6925065068391115),
    };
    static const real_t cosine[8] = {
        REAL(0.9999999999999981), REAL(-19.739208802174744), REAL(64.93939402133272), REAL(-85.45681703563243),
        REAL(60.244630608149656), REAL(-26.425888742714854), REAL(7.896555728040881), REAL(-1.645223312598949),
    };
    real_t x = turns - real_rint(turns);
    const uint32_t far = (real_abs(x) > REAL(0.25)) ? 1u : 0u;
    if (far != 0u) {
        x = ((x > REAL(0.0)) ? REAL(0.5) : REAL(-0.5)) - x;
    }
    const real_t u = x * x;
    real_t s = sine[7];
    real_t c = cosine[7];
    for (uint32_t i = 7u; i > 0u; i--) {
        s = sine[i - 1u] + u * s;
        c = cosine[i - 1u] + u * c;
    }
    *re = (far != 0u) ? -c : c;
    *im = s * x;
}

void finger_track(finger_t *finger, real_t position, real_t rate)
{
    const real_t period = REAL(1.0) / rate;
    const real_t pole = TRACKER_POLE * period;
    const uint32_t was_seen = finger->seen;
    const uint32_t leapt =
        ((was_seen != 0u) && (real_abs(position - finger->position) * rate > FASTEST)) ? 1u : 0u;
    const uint32_t lost = ((leapt != 0u) || !(real_abs(position) <= FARTHEST)) ? 1u : 0u; /* NaN included */
    if (LAW_FRICTION != 0u) {
        const uint32_t moves = ((lost == 0u) && (was_seen != 0u)) ? 1u : 0u;
        const real_t moved = (moves != 0u) ? (real_abs(position - finger->position) * rate) : REAL(0.0);
        finger->speed = (leapt != 0u) ? REAL(0.0) : (finger->speed + pole * (moved - finger->speed));
        finger->smooth_speed =
            (leapt != 0u) ? REAL(0.0) : (finger->smooth_speed + pole * (finger->speed - finger->smooth_speed));
    }
    if (lost != 0u) {
        finger->acceleration = REAL(0.0);
        finger->seen = 0u;
        return;
    }
    finger->velocity = (was_seen != 0u) ? finger->velocity : REAL(0.0);
    const real_t predicted = ((was_seen != 0u) ? finger->smooth_position : position) + period * finger->velocity;
    const real_t innovation = position - predicted;
    finger->smooth_position = predicted + REAL(3.0) * pole * innovation;
    finger->velocity += period * finger->acceleration + REAL(3.0) * pole * TRACKER_POLE * innovation;
    finger->acceleration += pole * TRACKER_POLE * TRACKER_POLE * innovation;
    finger->position = position;
    finger->seen = 1u;
}

static uint32_t same_carrier(const band_t *a, const band_t *b)
{
    const uint32_t differ = ((a->frequency != b->frequency) || (a->wavenumber != b->wavenumber)) ? 1u : 0u;
    return ((differ == 0u) && !(a->phase != b->phase)) ? 1u : 0u;
}

/* Start another carrier where the last one has faded out; it fades in from zero. */
static void take_over(band_state_t *band, real_t rate)
{
    if ((band->change < REAL(1.0)) || (same_carrier(&band->now, &band->next) != 0u)) {
        return;
    }
    band->now = band->next;
    band->turns = REAL(0.0);
    band->fade = REAL(0.0);
    band->omega = TURN * band->now.frequency;
    band->sweep = REAL(0.0);
    band->measured_re = REAL(0.0);
    band->measured_im = REAL(0.0);
    band->stale = 1u;
    band->active = ((band->now.re != REAL(0.0)) || (band->now.im != REAL(0.0))) ? 1u : 0u;
    unit(band->now.frequency / rate, &band->turn_re, &band->turn_im);
}

/* Glide to the amplitude that was last set, or to zero where the carrier is to be another one. */
static void glide(band_state_t *band, real_t step)
{
    if (band->change >= REAL(1.0)) {
        return;
    }
    const uint32_t stays = same_carrier(&band->now, &band->next);
    band->change = real_min(band->change + step, REAL(1.0));
    const real_t share = smooth(band->change);
    band->now.re = band->from_re + share * (((stays != 0u) ? band->next.re : REAL(0.0)) - band->from_re);
    band->now.im = band->from_im + share * (((stays != 0u) ? band->next.im : REAL(0.0)) - band->from_im);
}

static void advance_carrier(band_state_t *band, const law_t *law, uint32_t refresh)
{
    const uint32_t follows = (band->now.wavenumber > REAL(0.0)) ? 1u : 0u;
    if ((follows != 0u) || (refresh != 0u)) {
        const real_t position = (follows != 0u) ? law->finger.position : REAL(0.0);
        const real_t samples = (follows != 0u) ? REAL(1.0) : (real_t)REFRESH;
        unit(band->turns + band->now.wavenumber * position + band->now.phase, &band->carrier_re, &band->carrier_im);
        const real_t turns = band->turns + samples * band->now.frequency / law->design->rate;
        band->turns = turns - real_rint(turns);
    } else {
        const real_t re = band->carrier_re * band->turn_re - band->carrier_im * band->turn_im;
        band->carrier_im = band->carrier_re * band->turn_im + band->carrier_im * band->turn_re;
        band->carrier_re = re;
    }
}

/* Weight of the target, and the frequency of a band that follows the finger; it fades out at the range's ends. */
static real_t fade_band(band_state_t *band, const law_t *law)
{
    const design_t *d = law->design;
    if (!(band->now.wavenumber > REAL(0.0))) {
        band->fade = real_min(band->fade + d->fade_step, REAL(1.0));
        return smooth(band->fade);
    }
    const real_t hertz = band->now.frequency + band->now.wavenumber * law->finger.velocity;
    const real_t left = d->highest_edge - real_abs(hertz) / d->highest;
    band->omega = TURN * hertz;
    band->sweep = TURN * law->finger.acceleration * band->now.wavenumber;
    band->fade = real_clip(
        band->fade + ((law->finger.seen != 0u) ? d->fade_step : -d->fade_step), REAL(0.0), REAL(1.0));
    return smooth(band->fade) * smooth(left / (d->highest_edge - REAL(1.0)));
}

void bands_advance(law_t *law)
{
    const uint32_t refresh = ((law->sample % REFRESH) == 0u) ? 1u : 0u;
    for (uint32_t k = 0u; k < LAW_BANDS; k++) {
        band_state_t *band = &law->bands[k];
        if (band->active == 0u) {
            continue;
        }
        if (refresh != 0u) {
            take_over(band, law->design->rate);
        }
        glide(band, law->design->change_step);
        advance_carrier(band, law, refresh);
        const real_t weight = fade_band(band, law);
        band->target_re = weight * band->now.re;
        band->target_im = weight * band->now.im;
    }
}

/* Sum of the bands' targets at the end of the look-ahead; of a lifted finger's the turn stays. */
real_t bands_ahead(law_t *law)
{
    const real_t lead = (real_t)LAW_LOOKAHEAD / law->design->rate;
    real_t sum = REAL(0.0);
    for (uint32_t k = 0u; k < LAW_BANDS; k++) {
        band_state_t *band = &law->bands[k];
        if (band->active == 0u) {
            continue;
        }
        if ((band->stale != 0u) || ((band->now.wavenumber > REAL(0.0)) && (law->finger.seen != 0u))) {
            const real_t turns = (lead / TURN) * (band->omega + (REAL(0.5) * lead) * band->sweep);
            unit(turns, &band->ahead_re, &band->ahead_im);
            band->stale = 0u;
        }
        const real_t re = band->target_re * band->ahead_re - band->target_im * band->ahead_im;
        const real_t im = band->target_re * band->ahead_im + band->target_im * band->ahead_re;
        sum += re * band->carrier_re - im * band->carrier_im;
    }
    return sum;
}

/* Update the measured envelopes: an observer whose bands and offset together make up the displacement. */
void bands_measure(law_t *law, real_t displacement)
{
    real_t residual = displacement - law->measured_dc;
    for (uint32_t k = 0u; k < LAW_BANDS; k++) {
        const band_state_t *band = &law->bands[k];
        residual -= band->measured_re * band->carrier_re - band->measured_im * band->carrier_im;
    } /* 0 of a band that is not active */
    law->measured_dc += law->design->measuring_dc * residual;
    const real_t share = law->design->measuring * residual;
    for (uint32_t k = 0u; k < LAW_BANDS; k++) {
        band_state_t *band = &law->bands[k];
        if (band->active != 0u) {
            band->measured_re += share * band->carrier_re;
            band->measured_im -= share * band->carrier_im;
        }
    }
}

static uint32_t sane(const band_t *band, const design_t *d)
{
    const real_t size = band->re * band->re + band->im * band->im;
    const uint32_t frequency =
        ((band->frequency >= REAL(0.0)) && (band->frequency <= REAL(0.4) * d->rate)) ? 1u : 0u;
    const uint32_t wavenumber =
        ((band->wavenumber >= REAL(0.0)) && (band->wavenumber <= LAW_MOST_WAVENUMBER)) ? 1u : 0u;
    const uint32_t phase = (real_abs(band->phase) <= LAW_MOST_PHASE) ? 1u : 0u;
    return ((frequency & wavenumber & phase) != 0u) && (size <= d->sensor_limit * d->sensor_limit) ? 1u : 0u;
}

static void set_band(band_state_t *band, const band_t *next)
{
    const uint32_t silent = ((next->re == REAL(0.0)) && (next->im == REAL(0.0))) ? 1u : 0u;
    if ((silent != 0u) && (band->active == 0u)) {
        return;
    }
    band->next = *next;
    band->from_re = band->now.re;
    band->from_im = band->now.im;
    band->change = (band->active != 0u) ? REAL(0.0) : REAL(1.0);
    band->active = 1u;
}

uint32_t law_set_bands(law_t *law, const band_t bands[], uint32_t count)
{
    static const band_t nothing = {REAL(0.0), REAL(0.0), REAL(0.0), REAL(0.0), REAL(0.0)};
    if (count > LAW_BANDS) {
        return 0u;
    }
    for (uint32_t k = 0u; k < count; k++) {
        if (sane(&bands[k], law->design) == 0u) {
            return 0u;
        }
    }
    for (uint32_t k = 0u; k < LAW_BANDS; k++) {
        set_band(&law->bands[k], (k < count) ? &bands[k] : &nothing);
    }
    return 1u;
}

void law_target(const law_t *law, uint32_t band, real_t envelope[2])
{
    envelope[0] = law->bands[band].target_re;
    envelope[1] = law->bands[band].target_im;
}

void law_measured(const law_t *law, uint32_t band, real_t envelope[2])
{
    envelope[0] = law->bands[band].measured_re;
    envelope[1] = law->bands[band].measured_im;
}
