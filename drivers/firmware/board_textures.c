/* Commands of textures that are no sum of bands: description, profile, samples, and when to play them. */
#include "board.h"

enum { PROFILE_HEAD = 2, SAMPLES_HEAD = 9, LEAST_POINTS = 4 };

uint8_t board_texture(board_t *board, const frame *from)
{
    uint32_t points = get_u16(from->payload + 2);
    real_t start = (real_t)get_f32(from->payload + 4), step = (real_t)get_f32(from->payload + 8);
    real_t scale = (real_t)get_f32(from->payload + 12), largest = design.sensor_limit / (real_t)INT16_MAX;
    int table = points >= LEAST_POINTS && points <= TEXTURE_POINTS && isfinite(start) && step > REAL(0.0) &&
                isfinite(step) && real_abs(scale) <= largest;
    if (board->textures.weight < REAL(1.0) || (board->state != BOARD_IDLE && board->fade_to == REAL(0.0))) {
        return REASON_STATE;                      /* the one that is to be replaced fades out */
    }
    if (from->payload[1] > 1u || (points > 0u && !table)) {
        return REASON_VALUE;
    }
    texture_t *next = textures_next(&board->textures);
    next->number = from->payload[0];
    next->timed = from->payload[1];
    next->written = next->filled = 0;
    next->points = points;
    next->start = start;
    next->step = step;
    next->scale = scale;
    next->digest = crc32(from->payload, from->count, 0u);
    return REASON_NONE;
}

uint8_t board_profile(board_t *board, const frame *from)
{
    texture_t *next = textures_next(&board->textures);
    uint32_t points = (uint32_t)(from->count - PROFILE_HEAD) / 2u;
    if (get_u16(from->payload) != next->filled || next->filled + points > next->points) {
        return REASON_STATE;
    }
    for (uint32_t i = 0; i < points; i++) {
        next->profile[next->filled++] = get_i16(from->payload + PROFILE_HEAD + 2u * i);
    }
    next->digest = crc32(from->payload + PROFILE_HEAD, from->count - PROFILE_HEAD, next->digest);
    return REASON_NONE;
}

static texture_t *texture_of(board_t *board, uint32_t number)
{
    for (uint32_t i = 0; i < 2u; i++) {
        if (board->textures.of[i].number == number && board->textures.of[i].timed == 1u) {
            return &board->textures.of[i];
        }
    }
    return NULL;
}

uint8_t board_samples(board_t *board, const frame *from)
{
    texture_t *to = texture_of(board, from->payload[0]);
    uint32_t samples = (uint32_t)(from->count - SAMPLES_HEAD) / 2u;
    real_t scale = (real_t)get_f32(from->payload + 5);
    if (!(real_abs(scale) <= design.sensor_limit / (real_t)INT16_MAX)) {
        return REASON_VALUE;
    }
    if (to == NULL || to->written - get_u32(from->payload + 1) > TEXTURE_RING) {
        return REASON_STATE;                      /* neither the next ones, nor in place of some in the ring */
    }
    uint32_t next = get_u32(from->payload + 1), back = to->written - next;
    int plays = board->state != BOARD_IDLE && to == &board->textures.of[board->textures.current];
    uint32_t held = plays ? texture_left(to, board->sample + LAW_LOOKAHEAD) : to->written; /* not yet read */
    if (held + samples > TEXTURE_RING + back) {
        return REASON_STATE;
    }
    for (uint32_t i = 0; i < samples; i++) {
        to->ring[(next + i) % TEXTURE_RING] = (float)(scale * (real_t)get_i16(from->payload + SAMPLES_HEAD + 2u * i));
    }
    to->written += samples > back ? samples - back : 0u;
    return REASON_NONE;
}

uint8_t board_play(board_t *board, const frame *from)
{
    texture_t *next = textures_next(&board->textures);
    if (next->number == TEXTURE_NONE || next->filled != next->points || (next->timed == 1u && next->written == 0u)) {
        return REASON_STATE;
    }
    if (get_u32(from->payload) != next->digest) {
        return REASON_DIGEST;
    }
    textures_replace(&board->textures, board->sample + LAW_LOOKAHEAD, board->state == BOARD_IDLE);
    return REASON_NONE;
}
