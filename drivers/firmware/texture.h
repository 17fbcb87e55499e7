/*
 * Textures that are no sum of bands: samples in time, which the host streams into a ring ahead of play, and a profile
 * along the surface, a table that is read by cubic interpolation; as hapticrender/sampled_texture.py.  There are two of
 * them, so that one fades into the next.  Static memory: sizeof(textures_t), 64 kB with the sizes below.
 */
#ifndef TEXTURE_H
#define TEXTURE_H

#include "law.h"

#ifndef TEXTURE_RING
#define TEXTURE_RING 4096u   /* samples in time, a power of two */
#endif
#ifndef TEXTURE_POINTS
#define TEXTURE_POINTS 8192u /* of a profile */
#endif
#define TEXTURE_NONE UINT32_MAX

typedef struct {
    uint32_t number;               /* by which the host names it; TEXTURE_NONE: nothing more is taken */
    uint32_t timed;                /* 1: it has samples in time */
    uint32_t written;              /* samples ever written */
    uint32_t began;                /* sample of the board's clock at which its first one plays */
    uint32_t points, filled;       /* of the profile: in all, and received so far */
    uint32_t digest;               /* CRC-32 of what describes it and of the profile so far */
    real_t start, step, scale;     /* m, m, m per unit of the profile */
    real_t supply;                 /* 0..1: falls to 0 before the ring runs dry, and rises when it is filled again */
    float ring[TEXTURE_RING];      /* m; sample k at k % TEXTURE_RING */
    int16_t profile[TEXTURE_POINTS];
} texture_t;

typedef struct {
    texture_t of[2];
    uint32_t current;              /* which of them plays, or fades in */
    real_t weight;                 /* 0..1: how far it has faded in; the other one has the rest */
    real_t touch;                  /* 0..1: falls and rises with contact, a factor of profiles */
    finger_t finger;
} textures_t;

/* Clear both: nothing plays. */
void textures_init(textures_t *textures);

/* The one that does not play, to be described anew. */
texture_t *textures_next(textures_t *textures);

/* Samples that `texture` still holds from sample `at` of the board's clock on; 0 where it is dry. */
uint32_t texture_left(const texture_t *texture, uint32_t at);

/* Let the next one begin with sample `began` of the board's clock, faded into within 40 ms, or at once. */
void textures_replace(textures_t *textures, uint32_t began, uint32_t at_once);

/*
 * Advance by a sample: reference (m) at sample `at`, which lies LAW_LOOKAHEAD samples ahead of the finger's `position`
 * (m from the middle, NaN: no finger).  Sets `dry` where samples in time are missing, or are about to be.
 */
real_t textures_step(textures_t *textures, real_t position, uint32_t at, real_t rate, uint32_t *dry);

#endif
