/* What the board sends: telemetry, streamed samples, and the bytes on their way. */
#include "board.h"
#include "hardware.h"

enum { TELEMETRY_BANDS = 11, ROW = 4 * (LAW_CHANNELS + LAW_SENSORS + 3) + 2, STREAM_HEAD = 6 };

void board_send(board_t *board, uint8_t kind, uint16_t sequence, const uint8_t *payload, size_t count)
{
    uint8_t wire[FRAME_WIRE];
    size_t length = frame_encode(kind, sequence, payload, count, wire);
    if (board->sending_in - board->sending_out + length > BOARD_SEND) {
        board->dropped++;
        return;
    }
    for (size_t i = 0; i < length; i++) {
        board->sending[board->sending_in++ % BOARD_SEND] = wire[i];
    }
}

void board_flush(board_t *board)
{
    while (board->sending_in != board->sending_out) {
        size_t at = board->sending_out % BOARD_SEND;
        size_t count = board->sending_in - board->sending_out;
        if (count > BOARD_SEND - at) {
            count = BOARD_SEND - at;
        }
        size_t taken = hardware_write(board->sending + at, count);
        board->sending_out += taken;
        if (taken < count) {
            return;
        }
    }
}

static uint8_t *put_band(const board_t *board, uint8_t *at, uint32_t band)
{
    real_t envelope[2];
    law_target(&board->law, band, envelope);
    at = put_f32(put_f32(at, (float)(board->gain * envelope[0])), (float)(board->gain * envelope[1]));
    law_measured(&board->law, band, envelope);
    return put_f32(put_f32(at, (float)envelope[0]), (float)envelope[1]);
}

static void telemetry_from(board_t *board, uint32_t first, uint32_t bands)
{
    uint8_t payload[FRAME_PAYLOAD];
    uint32_t mean = board->cycles_count > 0u ? board->cycles_sum / board->cycles_count : 0u;
    uint8_t *at = put_u32(put_u32(payload, board->sample), board_time(board));
    at = put_u32(put_u32(at, board->echo), board->session);
    at = put_u8(put_u8(at, (uint8_t)board->state), (uint8_t)board->cause);
    at = put_u16(at, (uint16_t)board->flags_seen);
    at = put_u32(put_u32(at, mean), board->cycles_most);
    at = put_u32(put_u32(put_u32(at, board->bad), board->refused), board->dropped);
    at = put_u32(put_f32(at, (float)board->position), board->commits);
    at = put_f32(put_f32(at, (float)law_mismatch(&board->law)), (float)board->law.damper_scale);
    at = put_u8(put_u8(at, (uint8_t)first), (uint8_t)bands);
    for (uint32_t band = first; band < bands && band < first + TELEMETRY_BANDS; band++) {
        at = put_band(board, at, band);
    }
    board_send(board, KIND_TELEMETRY, board->next++, payload, (size_t)(at - payload));
}

void board_telemetry(board_t *board)
{
    uint32_t bands = board->state == BOARD_PLAYING ? board->played.bands_used : 0u;
    uint32_t first = 0;
    do {
        telemetry_from(board, first, bands);
        first += TELEMETRY_BANDS;
    } while (first < bands);
    board->flags_seen = 0;
    board->cycles_most = board->cycles_sum = board->cycles_count = 0;
}

static void send_stream(board_t *board)
{
    if (board->stream_count > 0u) {
        board_send(board, KIND_STREAM, board->next++, board->stream, board->stream_count);
        board->stream_count = 0;
    }
}

void board_stream(board_t *board)
{
    int waits = board->state == BOARD_DRIVING && board->queue_in == 0u;
    if (board->stride == 0u || board->state == BOARD_IDLE || waits) {
        send_stream(board);
        return;
    }
    if (board->sample % board->stride != 0u) {
        return;
    }
    uint8_t *at = board->stream + board->stream_count;
    if (board->stream_count == 0u) {
        at = put_u16(put_u32(at, board->sample), (uint16_t)board->stride);
    }
    for (uint32_t c = 0; c < LAW_CHANNELS; c++) {
        at = put_f32(at, (float)board->acting[c]);
    }
    for (uint32_t s = 0; s < BOARD_SENSED; s++) {
        at = put_f32(at, (float)board->sensed[s]);
    }
    at = put_f32(put_f32(at, (float)board->position), (float)board->finger.load);
    at = put_f32(at, board->state == BOARD_PLAYING ? (float)law_reference(&board->law) : 0.0F);
    at = put_u16(at, (uint16_t)board->flags);
    board->stream_count = (size_t)(at - board->stream);
    if (board->stream_count + ROW > FRAME_PAYLOAD) {
        send_stream(board);
    }
}
