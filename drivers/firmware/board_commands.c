/* Commands of the host: each is checked, done at most once, and acknowledged or refused with a reason. */
#include <string.h>

#include "board.h"
#include "hardware.h"

enum { CHECK = 4, HELLO_BYTES = 5, HEARTBEAT_BYTES = 8, FINGER_BYTES = 20 };
enum { SETPOINT_BYTES = 20, LINE_BYTES = 13, ROW_BYTES = 4 * LAW_CHANNELS };

#define MOST_POSITION 0.15f                       /* m from the middle, m/s, N: of any finger on a surface; */
#define MOST_VELOCITY 10.0f                       /* beyond them it is taken for lifted */
#define MOST_LOAD 20.0f

typedef uint8_t (*handler)(board_t *board, const frame *from);

/* CRC-32 of the session, the kind, the sequence and the payload before it: the last four bytes of every command. */
static int check_holds(const board_t *board, const frame *from)
{
    uint8_t head[7];
    size_t count = from->count - CHECK;
    uint32_t session = from->kind == KIND_HELLO ? 0u : board->session;
    (void)put_u16(put_u8(put_u32(head, session), from->kind), from->sequence);
    return get_u32(from->payload + count) == crc32(from->payload, count, crc32(head, sizeof head, 0u));
}

static uint8_t setpoint(board_t *board, const frame *from)
{
    uint32_t index = from->payload[0];
    if (index >= LAW_BANDS) {
        return REASON_VALUE;
    }
    memcpy(board->staged[index], from->payload + 1, SETPOINT_BYTES);
    return REASON_NONE;
}

static uint8_t commit(board_t *board, const frame *from)
{
    band_t bands[LAW_BANDS];
    uint32_t count = from->payload[0], spatial = count > 0u ? 1u : 0u;
    if (count > LAW_BANDS || (LAW_FRICTION != 0u && count > 0u)) {
        return REASON_VALUE;                      /* a screen plays waveforms only */
    }
    if (get_u32(from->payload + 1) != crc32(&board->staged[0][0], count * SETPOINT_BYTES, 0u)) {
        return REASON_DIGEST;
    }
    for (uint32_t i = 0; i < count; i++) {
        const uint8_t *at = board->staged[i];
        band_t band = {(real_t)get_f32(at), (real_t)get_f32(at + 4), (real_t)get_f32(at + 8),
                       (real_t)get_f32(at + 12), (real_t)get_f32(at + 16)};
        bands[i] = band;
        spatial = band.wavenumber > REAL(0.0) ? spatial : 0u;
    }
    if (law_set_bands(&board->law, bands, count) == 0u) {
        return REASON_VALUE;
    }
    memcpy(board->played.bands, bands, count * sizeof bands[0]);
    board->played.bands_used = count;
    board->played.spatial = spatial;
    board->committed = 1u;
    board->commits++;
    return REASON_NONE;
}

static uint8_t gain(board_t *board, const frame *from)
{
    real_t value = (real_t)get_f32(from->payload);
    if (law_set_gain(&board->law, value) == 0u) {
        return REASON_VALUE;
    }
    board->gain = value;
    return REASON_NONE;
}

static uint8_t limits(board_t *board, const frame *from)
{
    real_t peak = (real_t)get_f32(from->payload), rms = (real_t)get_f32(from->payload + 4);
    real_t time = (real_t)get_f32(from->payload + 8), displacement = (real_t)get_f32(from->payload + 12);
    real_t most = law_carrier(&design, design.drive_limit);
    if (!(peak > REAL(0.0) && peak <= (real_t)(float)most && rms > REAL(0.0) && rms <= peak &&
          time >= REAL(1e-3) && time <= REAL(1e3) && displacement > REAL(0.0))) {
        return REASON_VALUE;
    }
    board->peak = peak = real_min(peak, most);    /* the host has it as a float */
    board->rms = rms;
    board->displacement = board->supervisor.sensed_bound = real_min(displacement, supervision.sensed_bound);
    board->heating = real_min(REAL(1.0) / (time * board->played.rate), REAL(1.0));
    board_limit_law(board);
    return REASON_NONE;
}

static uint8_t start(board_t *board, const frame *from)
{
    if (board->state != BOARD_IDLE || board->committed == 0u) {
        return REASON_STATE;
    }
    board->stride = get_u16(from->payload);
    board->period = get_u16(from->payload + 2);
    board->unattended = 0;
    board->textures.of[board->textures.current].began = board->sample;
    board_begin(board, BOARD_PLAYING);
    return REASON_NONE;
}

static uint8_t stop(board_t *board, const frame *from)
{
    (void)from;
    board_stop(board, CAUSE_COMMAND);
    return REASON_NONE;
}

static uint8_t line(board_t *board, const frame *from)
{
    uint32_t index = from->payload[0];
    const uint8_t *at = from->payload + 1;
    line_t new_line = {at[0], (real_t)get_f32(at + 5), (real_t)get_f32(at + 9), (real_t)get_f32(at + 1)};
    real_t frequency = new_line.step;
    if (board->state != BOARD_IDLE) {
        return REASON_STATE;
    }
    if (index >= BOARD_LINES || new_line.channel >= LAW_CHANNELS || !isfinite(new_line.amplitude) ||
        !(new_line.turns >= REAL(0.0) && new_line.turns < REAL(1.0)) ||
        !(frequency >= REAL(0.0) && frequency < REAL(0.5) * board->played.rate)) {
        return REASON_VALUE;
    }
    new_line.step = frequency / board->played.rate;
    memcpy(board->line_bytes[index], at, LINE_BYTES);
    board->lines[index] = new_line;
    return REASON_NONE;
}

static uint8_t identify(board_t *board, const frame *from)
{
    uint32_t lines = from->payload[0];
    if (board->state != BOARD_IDLE) {
        return REASON_STATE;
    }
    if (lines > BOARD_LINES) {
        return REASON_VALUE;
    }
    if (get_u32(from->payload + 7) != crc32(&board->line_bytes[0][0], lines * LINE_BYTES, 0u)) {
        return REASON_DIGEST;
    }
    board->lines_used = lines;
    board->remaining = get_u32(from->payload + 1);
    board->stride = get_u16(from->payload + 5);
    board_begin(board, lines > 0u ? BOARD_IDENTIFYING : BOARD_DRIVING);
    board->queue_out = board->queue_in = 0;
    return REASON_NONE;
}

static uint8_t drive(board_t *board, const frame *from)
{
    size_t rows = (from->count - 4u) / ROW_BYTES;
    if (board->state != BOARD_DRIVING || get_u32(from->payload) != board->queue_in ||
        board->queue_in - board->queue_out + rows > BOARD_QUEUE) {
        return REASON_STATE;
    }
    for (size_t row = 0; row < rows; row++) {
        float *to = board->queue[board->queue_in++ % BOARD_QUEUE];
        for (uint32_t c = 0; c < LAW_CHANNELS; c++) {
            to[c] = get_f32(from->payload + 4u + row * ROW_BYTES + 4u * c);
        }
    }
    return REASON_NONE;
}

/* Return the age of a keep-alive (us) by the host's clock: the least difference of the clocks is taken for their offset,
   and may grow by 1 us a frame, 100 ppm at 100 frames a second, so that it follows a host's clock that is slow. */
static uint32_t take_time(board_t *board, uint32_t host)
{
    finger_input_t *finger = &board->finger;
    uint32_t lead = board_time(board) - host;
    int32_t later = (int32_t)(lead - finger->offset);
    if (finger->known == 0u || later < 0) {
        finger->offset = lead;
    } else if (later > 0) {
        finger->offset++;
    }
    finger->known = 1u;
    board->echo = host;
    return lead - finger->offset;
}

static void keep_alive(board_t *board, const frame *from)
{
    if (board->finger.known != 0u && (int16_t)(uint16_t)(from->sequence - board->kept_alive) <= 0) {
        return;                                   /* a copy, or late */
    }
    board->kept_alive = from->sequence;
    if (take_time(board, get_u32(from->payload)) < 1000u * BOARD_SILENCE_MS) {
        board->quiet = 0;                         /* an older one has waited in a full line */
        board->unattended = get_u16(from->payload + 4) != board->beat ? 0u : board->unattended;
        board->beat = get_u16(from->payload + 4);
        board->watchdog = board_samples_of(board, get_u16(from->payload + 6));
    }
    if (from->kind == KIND_FINGER) {
        float position = get_f32(from->payload + 8), velocity = get_f32(from->payload + 12);
        float load = get_f32(from->payload + 16);
        int possible = fabsf(position) <= MOST_POSITION && fabsf(velocity) <= MOST_VELOCITY && load >= 0.0f &&
                       load <= MOST_LOAD;         /* and no NaN */
        board->finger.written = get_u32(from->payload) + board->finger.offset;
        board->finger.position = possible ? (real_t)position : (real_t)NAN;
        board->finger.velocity = possible ? (real_t)velocity : REAL(0.0);
        board->finger.load = possible ? (real_t)load : REAL(0.0);
    }
}

static void reply(board_t *board, uint8_t kind, uint16_t sequence, const uint8_t *payload, size_t count)
{
    board->replied_count = count;
    board->replied[0] = kind;
    memcpy(board->replied + 1, payload, count);
    board->commanded = sequence;
    board_send(board, kind, sequence, payload, count);
}

/* Refuse a frame that is no command of this session; the last command's reply stays. */
static void refuse(board_t *board, const frame *from, uint8_t reason)
{
    uint8_t payload[6];
    (void)put_u32(put_u8(put_u8(payload, from->kind), reason), board->sample);
    board->refused++;
    board_send(board, KIND_REFUSE, from->sequence, payload, sizeof payload);
}

/* A new host begins at rest, with its own set-points only.  The session is made of its number and the board's clock:
   what was recorded in another session is refused in this one. */
static void begin_session(board_t *board, uint32_t nonce)
{
    uint8_t numbers[8];
    board_stop(board, CAUSE_SESSION);
    (void)put_u32(put_u32(numbers, nonce), board->sample);
    board->nonce = nonce;
    board->session = crc32(numbers, sizeof numbers, 0u) | 1u;
    board->committed = 0u;
    board->finger.known = 0u;
    board->watchdog = 0;
    board->finger.position = (real_t)NAN;
    board->period = (uint32_t)(board->played.rate * REAL(0.1));
    board_defaults(board);
    if (board->state == BOARD_IDLE) {
        textures_init(&board->textures);
    }
}

/* Return the reason why it is refused, or none; another version's may be of another length. */
static uint8_t hello(board_t *board, const frame *from)
{
    uint8_t payload[FRAME_PAYLOAD];
    if (from->count > 0u && from->payload[0] != BOARD_VERSION) {
        return REASON_VERSION;
    }
    if (from->count != HELLO_BYTES) {
        return REASON_LENGTH;
    }
    uint32_t nonce = get_u32(from->payload + 1);
    if (nonce == 0u) {
        return REASON_VALUE;
    }
    int late = nonce == board->nonce && (int16_t)(uint16_t)(from->sequence - board->commanded) < 0;
    if (late) {
        return REASON_NONE;
    }
    if (nonce != board->nonce) {
        begin_session(board, nonce);
    }
    uint8_t *at = put_u32(put_u32(put_u8(payload, BOARD_VERSION), board->nonce), board->session);
    at = put_f32(put_f32(at, (float)design.rate), (float)law_carrier(&design, design.drive_limit));
    at = put_f32(at, (float)design.sensor_limit);
    at = put_u32(at, hardware_cycle_rate);
    at = put_u16(put_u16(at, LAW_DELAY), BOARD_QUEUE);
    at = put_u8(put_u8(at, LAW_CHANNELS), (uint8_t)BOARD_SENSED);
    at = put_u8(put_u8(at, LAW_BANDS), BOARD_LINES);
    at = put_u8(at, BOARD_SILENCE_MS + BOARD_FADE_MS);
    at = put_u8(put_u16(put_u16(at, TEXTURE_RING), TEXTURE_POINTS), LAW_LOOKAHEAD);
    at = put_u8(at, LAW_FRICTION);
    reply(board, KIND_CAPABILITIES, from->sequence, payload, (size_t)(at - payload));
    return REASON_NONE;
}

/* Commands with a reply, the bytes of their payload, and of the rows that follow it, 0: none. */
static const struct {
    uint8_t kind;
    size_t count, row;
    handler handle;
} commands[] = {
    {KIND_SETPOINT, 1 + SETPOINT_BYTES, 0, setpoint}, {KIND_COMMIT, 5, 0, commit}, {KIND_GAIN, 4, 0, gain},
    {KIND_LIMITS, 16, 0, limits}, {KIND_START, 4, 0, start}, {KIND_STOP, 0, 0, stop},
    {KIND_LINE, 1 + LINE_BYTES, 0, line}, {KIND_IDENTIFY, 11, 0, identify}, {KIND_DRIVE, 4, ROW_BYTES, drive},
    {KIND_TEXTURE, 16, 0, board_texture}, {KIND_PROFILE, 2, 2, board_profile}, {KIND_SAMPLES, 9, 2, board_samples},
    {KIND_PLAY, 4, 0, board_play},
};

/* Do a command; return the reason why it is refused, or none. */
static uint8_t execute(board_t *board, const frame *from)
{
    for (size_t i = 0; i < sizeof commands / sizeof commands[0]; i++) {
        if (commands[i].kind == from->kind) {
            size_t least = commands[i].count, row = commands[i].row, count = from->count;
            int fits = count == least || (row > 0u && count > least && (count - least) % row == 0u);
            return fits ? commands[i].handle(board, from) : (uint8_t)REASON_LENGTH;
        }
    }
    return REASON_KIND;
}

static void answer(board_t *board, const frame *from)
{
    int16_t later = (int16_t)(uint16_t)(from->sequence - board->commanded);
    if (later == 0) {                             /* the reply was lost: it is sent again, and nothing done again */
        board_send(board, board->replied[0], from->sequence, board->replied + 1, board->replied_count);
    } else if (later > 0) {
        uint8_t reason = execute(board, from), payload[6];
        uint8_t *at = put_u8(payload, from->kind);
        at = put_u32(reason == REASON_NONE ? at : put_u8(at, reason), board->sample);
        board->refused += reason == REASON_NONE ? 0u : 1u;
        reply(board, reason == REASON_NONE ? KIND_ACK : KIND_REFUSE, from->sequence, payload, (size_t)(at - payload));
    }
}

void board_command(board_t *board, frame *from)
{
    if (from->count < CHECK || !check_holds(board, from)) {
        refuse(board, from, REASON_CHECK);
        return;
    }
    from->count -= CHECK;
    uint8_t reason = REASON_NONE;
    if (from->kind == KIND_HELLO) {
        reason = hello(board, from);
    } else if (board->session == 0u) {
        reason = REASON_CHECK;
    } else if (from->kind != KIND_HEARTBEAT && from->kind != KIND_FINGER) {
        answer(board, from);
    } else if (from->count != (from->kind == KIND_FINGER ? FINGER_BYTES : HEARTBEAT_BYTES)) {
        reason = REASON_LENGTH;
    } else {
        keep_alive(board, from);
    }
    if (reason != REASON_NONE) {
        refuse(board, from, reason);
    }
}
