/* What the parts of the law call of each other; law.h is the interface. */
#ifndef LAW_PARTS_H
#define LAW_PARTS_H

#include "law.h"

#define TURN REAL(6.283185307179586)
#define LEARNING_REFRESH 25u /* samples between two discretisations of the loaded device */
#define FARTHEST REAL(1e3) /* m: a position or a waveform beyond it is no number to work with */

/* Third-order step x^2 (3 - 2 x) from 0 to 1, x cut to that range. */
static inline real_t smooth(real_t x)
{
    const real_t y = real_clip(x, REAL(0.0), REAL(1.0));
    return y * y * (REAL(3.0) - REAL(2.0) * y);
}

/* carriers.c */
void unit(real_t turns, real_t *re, real_t *im);
void finger_track(finger_t *finger, real_t position, real_t rate);
void bands_advance(law_t *law);
real_t bands_ahead(law_t *law);
void bands_measure(law_t *law, real_t displacement);

/* learning.c */
void learning_init(law_t *law);
void learning_reset(law_t *law, uint32_t first, uint32_t last);
void learning_reset_all(law_t *law);
uint32_t learning_follow_contact(law_t *law);
void learning_suspect_change(law_t *law);
void learning_update(law_t *law, const real_t error[2]);
void learning_revert(law_t *law);
void learning_discretise(law_t *law);
void learning_force(const law_t *law, real_t force[2]);
void learning_advance(law_t *law, const real_t acting[LAW_RING]);

#endif
