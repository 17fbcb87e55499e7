#include "texture.h"

#include "law_parts.h"

#define FADE REAL(0.04)       /* s: of one texture into the next, and before samples run out */
#define TOUCH_FADE REAL(0.02) /* s: of a profile, at touch and lift */

void textures_init(textures_t *textures)
{
    for (uint32_t i = 0u; i < 2u; i++) {
        texture_t *texture = &textures->of[i];
        texture->number = TEXTURE_NONE;
        texture->timed = 0u;
        texture->written = 0u;
        texture->points = 0u;
        texture->filled = 0u;
    }
    textures->current = 0u;
    textures->weight = REAL(1.0);
    textures->touch = REAL(0.0);
    textures->finger = (finger_t){REAL(0.0), REAL(0.0), REAL(0.0), REAL(0.0), REAL(0.0), REAL(0.0), 0u};
}

texture_t *textures_next(textures_t *textures) { return &textures->of[1u - textures->current]; }

uint32_t texture_left(const texture_t *texture, uint32_t at)
{
    const uint32_t left = texture->written - (at - texture->began);
    return (left <= TEXTURE_RING) ? left : 0u; /* more: it wrapped, as `at` lies beyond the last sample */
}

void textures_replace(textures_t *textures, uint32_t began, uint32_t at_once)
{
    texture_t *next = textures_next(textures);
    next->began = began;
    next->supply = REAL(1.0);
    textures->of[textures->current].number = TEXTURE_NONE;
    textures->current = 1u - textures->current;
    textures->weight = (at_once != 0u) ? REAL(1.0) : REAL(0.0);
}

/* The texture in time at sample `at`; it fades out before the ring runs dry, and in again once it is filled. */
static real_t in_time(texture_t *texture, uint32_t at, real_t step, uint32_t *dry)
{
    if (texture->timed == 0u) {
        return REAL(0.0);
    }
    const uint32_t left = texture_left(texture, at);
    texture->supply = real_min(real_min(texture->supply + step, (real_t)left * step), REAL(1.0));
    if (texture->supply < REAL(1.0)) {
        *dry = 1u;
    }
    return (left > 0u) ? smooth(texture->supply) * (real_t)texture->ring[(at - texture->began) % TEXTURE_RING]
                       : REAL(0.0);
}

/* The profile at a position (m): cubic interpolation; the ends of the profile go on. */
static real_t along_surface(const texture_t *texture, real_t position)
{
    if (texture->points == 0u) {
        return REAL(0.0);
    }
    const real_t place =
        real_clip((position - texture->start) / texture->step, REAL(1.0), (real_t)(texture->points - 3u));
    const uint32_t i = (uint32_t)place;
    const real_t x = place - (real_t)i;
    const int16_t *p = &texture->profile[i - 1u];
    const real_t inner = (REAL(1.0) - x) * (real_t)p[1] + x * (real_t)p[2];
    const real_t outer = (REAL(2.0) - x) * (real_t)p[0] + (REAL(1.0) + x) * (real_t)p[3];
    const real_t sum = (x + REAL(1.0)) * (REAL(2.0) - x) / REAL(2.0) * inner - x * (REAL(1.0) - x) / REAL(6.0) * outer;
    return texture->scale * sum;
}

real_t textures_step(textures_t *textures, real_t position, uint32_t at, real_t rate, uint32_t *dry)
{
    const real_t lead = (real_t)LAW_LOOKAHEAD / rate;
    const real_t step = REAL(1.0) / (FADE * rate);
    finger_t *finger = &textures->finger;
    finger_track(finger, position, rate);
    const real_t there = /* of a lifted finger: where it was */
        finger->position + lead * (finger->velocity + REAL(0.5) * lead * finger->acceleration);
    const real_t change = ((finger->seen != 0u) ? REAL(1.0) : REAL(-1.0)) / (TOUCH_FADE * rate);
    textures->touch = real_clip(textures->touch + change, REAL(0.0), REAL(1.0));
    textures->weight = real_min(textures->weight + step, REAL(1.0));
    const real_t weight[2] = {smooth(textures->weight), REAL(1.0) - smooth(textures->weight)};
    real_t sum = REAL(0.0);
    for (uint32_t i = 0u; i < 2u; i++) {
        texture_t *texture = &textures->of[(textures->current + i) % 2u];
        if (weight[i] > REAL(0.0)) {
            const real_t surface = smooth(textures->touch) * along_surface(texture, there);
            sum += weight[i] * (in_time(texture, at, step, dry) + surface);
        }
    }
    return sum;
}
