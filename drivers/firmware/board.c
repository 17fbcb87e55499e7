#include "board.h"

#include <string.h>

#include "hardware.h"

#define TWO_PI REAL(6.28318530717958648)
#define MICROSECOND REAL(1e-6)
#define APPROACH REAL(10e-3)                      /* s */
#define LARGEST_STEP REAL(5e-3)                   /* m */
#ifdef REAL_DOUBLE
#define real_cos cos
#else
#define real_cos cosf
#endif

uint32_t board_samples_of(const board_t *board, uint32_t milliseconds)
{
    return (uint32_t)((real_t)milliseconds * REAL(1e-3) * board->played.rate);
}

uint32_t board_time(const board_t *board)
{
    return (uint32_t)(board->clock >> 16);
}

void board_init(board_t *board)
{
    memset(board, 0, sizeof *board);
    board->played = design;
    board->clock_step = (uint32_t)(REAL(65536e6) / design.rate + REAL(0.5));
    board_defaults(board);
    law_init(&board->law, &board->played);
    textures_init(&board->textures);
    board->finger.position = board->position = (real_t)NAN;
    board->quiet = board_samples_of(board, BOARD_SILENCE_MS);
}

void board_defaults(board_t *board)
{
    board->gain = REAL(1.0);
    board->peak = board->rms = law_carrier(&design, design.drive_limit);
    board->heating = REAL(1.0) / design.rate;
    board->displacement = supervision.sensed_bound;
}

void board_limit_law(board_t *board)
{
    if (LAW_FRICTION == 0u) {                     /* the drive of a friction device is an attraction, of its own limit */
        (void)law_set_drive_limit(&board->law, board->peak);
    }
}

void board_begin(board_t *board, board_state state)
{
    law_init(&board->law, &board->played);
    supervisor_init(&board->supervisor, &supervision, &board->played);
    board->supervisor.sensed_bound = board->displacement;
    board_limit_law(board);
    (void)law_set_gain(&board->law, board->gain);
    board->state = state;
    board->cause = CAUSE_NONE;
    board->fade = REAL(0.0);
    if (state == BOARD_PLAYING && LAW_FRICTION == 0u) {
        board->fade = REAL(1.0);                  /* the law fades in by itself; a carrier has a bias */
    }
    board->flags_seen = 0;                        /* of the run before */
    board->fade_to = REAL(1.0);
    board->fade_step = REAL(1000.0) / ((real_t)BOARD_FADE_MS * board->played.rate);
    board->heat = REAL(0.0);
    board->invalid = 0;
    board->stream_count = 0;
}

void board_stop(board_t *board, uint32_t cause)
{
    if (board->state != BOARD_IDLE && board->fade_to > REAL(0.0)) {
        board->fade_to = REAL(0.0);
        board->cause = cause;
    }
}

/* Position of the finger now: along its velocity for a while, then held, then lifted.  Between FINGER frames it follows
   the velocity, and approaches the latest position within 10 ms, so that a frame makes no step. */
static void place_finger(board_t *board)
{
    finger_input_t *finger = &board->finger;
    uint32_t age = board_time(board) - finger->written;
    if (age > 1000u * BOARD_FINGER_MS) {
        finger->position = (real_t)NAN;
    }
    int moves = age <= 1000u * BOARD_EXTRAPOLATE_MS;
    if (!moves) {
        age = 1000u * BOARD_EXTRAPOLATE_MS;
    }
    real_t period = REAL(1.0) / board->played.rate, velocity = moves ? finger->velocity : REAL(0.0);
    real_t now = finger->position + finger->velocity * (real_t)age * MICROSECOND;
    real_t off = now - (board->position + velocity * period);
    if (real_abs(off) < LARGEST_STEP) {
        board->position += velocity * period + off * period / APPROACH;
    } else {                                      /* NaN included: it touches, lifts, or is elsewhere */
        board->position = now;
    }
}

static void play_multisine(board_t *board)
{
    for (uint32_t i = 0; i < board->lines_used; i++) {
        line_t *line = &board->lines[i];
        board->drive[line->channel] += line->amplitude * real_cos(TWO_PI * line->turns);
        line->turns += line->step;
        line->turns -= line->turns >= REAL(1.0) ? REAL(1.0) : REAL(0.0);
    }
    if (board->remaining > 0u) {
        board->remaining--;
    } else {
        board_stop(board, CAUSE_DONE);
    }
}

static void play_queue(board_t *board)
{
    if (board->queue_in == board->queue_out) {
        board->flags |= board->queue_in > 0u ? BOARD_OVERRUN : 0u;
        return;
    }
    const float *row = board->queue[board->queue_out++ % BOARD_QUEUE];
    for (uint32_t c = 0; c < LAW_CHANNELS; c++) {
        board->drive[c] = (real_t)row[c];
    }
}

static void compute_drive(board_t *board)
{
    for (uint32_t c = 0; c < LAW_CHANNELS; c++) {
        board->acting[c] = board->drive[c];
        board->drive[c] = REAL(0.0);
    }
    if (board->state == BOARD_PLAYING) {
        uint32_t dry = 0;
        real_t reference = textures_step(&board->textures, board->position, board->sample + LAW_LOOKAHEAD,
                                         board->played.rate, &dry);
        board->flags |= dry != 0u ? BOARD_OVERRUN : 0u;
        board->flags |= design.learns == 0u
            ? law_step(&board->law, board->sensed, board->position, reference, board->drive)
            : supervisor_step(&board->supervisor, &board->law, board->sensed, board->position, reference, board->drive);
        for (uint32_t c = 0; c < LAW_CHANNELS; c++) {
            board->drive[c] = law_carrier(&design, board->drive[c]);
        }
        if (board->supervisor.cause != SUPERVISOR_FINE) {
            board_stop(board, CAUSE_SUPERVISOR + (uint32_t)board->supervisor.cause);
        }
    } else if (board->state == BOARD_IDENTIFYING) {
        play_multisine(board);
    } else if (board->state == BOARD_DRIVING) {
        play_queue(board);
    }
}

/* Cut the drive to its peak, and stop where its mean square or the sensors are out of bounds. */
static void guard(board_t *board)
{
    real_t largest = REAL(0.0);
    for (uint32_t c = 0; c < LAW_CHANNELS; c++) {
        real_t drive = isfinite(board->drive[c]) ? board->drive[c] : REAL(0.0);
        if (real_abs(drive) > board->peak) {
            board->flags |= LAW_SATURATED;
        }
        board->drive[c] = board->fade * real_clip(drive, -board->peak, board->peak);
        largest = real_max(largest, board->drive[c] * board->drive[c]);
    }
    board->heat += board->heating * (largest - board->heat);
    if (board->heat > board->rms * board->rms) {
        board_stop(board, CAUSE_LIMIT);
    }
    int valid = 1;
    for (uint32_t s = 0; s < LAW_SENSORS; s++) {
        valid = valid && isfinite(board->sensed[s]) && real_abs(board->sensed[s]) < board->played.sensor_limit;
    }
    board->invalid = valid ? 0u : board->invalid + 1u;
    if (board->invalid > board_samples_of(board, BOARD_INVALID_MS)) {
        board_stop(board, CAUSE_SENSOR);
    }
}

static void advance_fade(board_t *board)
{
    if (board->state == BOARD_IDLE) {
        return;
    }
    if (board->fade < board->fade_to) {
        board->fade = real_min(board->fade + board->fade_step, board->fade_to);
    } else if (board->fade > board->fade_to) {
        board->fade = real_max(board->fade - board->fade_step, board->fade_to);
    }
    if (board->fade_to == REAL(0.0)) {
        if (board->cause != CAUSE_COMMAND && board->cause != CAUSE_DONE) {
            board->flags |= BOARD_STOPPED;
        }
        if (board->fade == REAL(0.0)) {
            board->state = BOARD_IDLE;
            textures_init(&board->textures);
            board_telemetry(board);
        }
    }
}

static void read_host(board_t *board)
{
    uint8_t bytes[64];
    size_t count = hardware_read(bytes, sizeof bytes);
    for (size_t i = 0; i < count; i++) {
        frame_status status = frame_read(&board->reader, bytes[i], &board->incoming);
        if (status == FRAME_GOOD) {
            board_command(board, &board->incoming);
        } else if (status == FRAME_BAD) {
            board->bad++;
        }
    }
    if (board->quiet > board_samples_of(board, BOARD_SILENCE_MS)) {
        board_stop(board, CAUSE_SILENCE);
    }
    if (board->state == BOARD_PLAYING && board->watchdog > 0u && board->unattended > board->watchdog) {
        board_stop(board, CAUSE_APPLICATION);
    }
}

static void count_cycles(board_t *board, uint32_t used)
{
    board->cycles_sum += used;
    board->cycles_count++;
    if (used > board->cycles_most) {
        board->cycles_most = used;
    }
}

void board_tick(board_t *board, uint32_t ticks)
{
    uint32_t start = hardware_cycles();
    board->flags = ticks > 1u ? BOARD_OVERRUN : 0u;
    hardware_sense(board->sensed);
    read_host(board);
    place_finger(board);
    compute_drive(board);
    guard(board);
    advance_fade(board);
    hardware_drive(board->drive);
    board_stream(board);
    board->flags_seen |= board->flags;
    if (board->period > 0u && board->sample % board->period == 0u) {
        board_telemetry(board);
    }
    board_flush(board);
    board->sample += ticks;
    board->clock += (uint64_t)ticks * board->clock_step;
    board->quiet += board->quiet < UINT32_MAX - ticks ? ticks : 0u;
    board->unattended += board->unattended < UINT32_MAX - ticks ? ticks : 0u;
    count_cycles(board, hardware_cycles() - start);
}
