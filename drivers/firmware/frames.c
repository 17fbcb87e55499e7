#include "frames.h"

#include <string.h>

uint16_t crc16(const uint8_t *bytes, size_t count, uint16_t start)
{
    static const uint16_t table[16] = {            /* of four bits; one at a time they take six times as long */
        0x0000u, 0x1021u, 0x2042u, 0x3063u, 0x4084u, 0x50A5u, 0x60C6u, 0x70E7u,
        0x8108u, 0x9129u, 0xA14Au, 0xB16Bu, 0xC18Cu, 0xD1ADu, 0xE1CEu, 0xF1EFu};
    uint32_t crc = start;
    for (size_t i = 0; i < count; i++) {
        crc = (crc << 4 ^ table[(crc >> 12 ^ (uint32_t)bytes[i] >> 4) & 15u]) & 0xFFFFu;
        crc = (crc << 4 ^ table[(crc >> 12 ^ bytes[i]) & 15u]) & 0xFFFFu;
    }
    return (uint16_t)crc;
}

uint32_t crc32(const uint8_t *bytes, size_t count, uint32_t start)
{
    static const uint32_t table[16] = {
        0x00000000u, 0x1DB71064u, 0x3B6E20C8u, 0x26D930ACu, 0x76DC4190u, 0x6B6B51F4u, 0x4DB26158u, 0x5005713Cu,
        0xEDB88320u, 0xF00F9344u, 0xD6D6A3E8u, 0xCB61B38Cu, 0x9B64C2B0u, 0x86D3D2D4u, 0xA00AE278u, 0xBDBDF21Cu};
    uint32_t crc = ~start;
    for (size_t i = 0; i < count; i++) {
        crc = crc >> 4 ^ table[(crc ^ bytes[i]) & 15u];
        crc = crc >> 4 ^ table[(crc ^ (uint32_t)bytes[i] >> 4) & 15u];
    }
    return ~crc;
}

size_t cobs_encode(const uint8_t *from, size_t count, uint8_t *to)
{
    size_t code = 0, end = 1;                     /* places of the open group's code and of the next byte */
    for (size_t i = 0; i < count; i++) {
        if (from[i] != 0u) {
            to[end++] = from[i];
        }
        if (from[i] == 0u || (end - code == 255u && i + 1 < count)) {
            to[code] = (uint8_t)(end - code);
            code = end++;
        }
    }
    to[code] = (uint8_t)(end - code);
    return end;
}

size_t cobs_decode(const uint8_t *from, size_t count, uint8_t *to)
{
    size_t at = 0, end = 0;
    while (at < count) {
        size_t code = from[at];
        if (code == 0u || at + code > count) {
            return SIZE_MAX;
        }
        for (size_t i = 1; i < code; i++) {
            if (from[at + i] == 0u) {
                return SIZE_MAX;
            }
            to[end++] = from[at + i];
        }
        at += code;
        if (code < 255u && at < count) {
            to[end++] = 0u;
        }
    }
    return end;
}

size_t frame_encode(uint8_t kind, uint16_t sequence, const uint8_t *payload, size_t count, uint8_t *wire)
{
    uint8_t body[FRAME_BODY];
    uint8_t *at = put_u16(put_u8(body, kind), sequence);
    memcpy(at, payload, count);
    at = put_u16(at + count, crc16(body, FRAME_HEAD + count, 0xFFFFu));
    size_t length = cobs_encode(body, (size_t)(at - body), wire);
    wire[length] = 0u;
    return length + 1u;
}

static frame_status frame_decode(const frame_reader *reader, frame *into)
{
    uint8_t body[FRAME_WIRE];
    size_t count = cobs_decode(reader->bytes, reader->count, body);
    if (count == SIZE_MAX || count < FRAME_HEAD + FRAME_CRC || count > FRAME_BODY) {
        return FRAME_BAD;
    }
    count -= FRAME_CRC;
    if (get_u16(body + count) != crc16(body, count, 0xFFFFu)) {
        return FRAME_BAD;
    }
    into->kind = body[0];
    into->sequence = get_u16(body + 1);
    into->count = count - FRAME_HEAD;
    memcpy(into->payload, body + FRAME_HEAD, into->count);
    return FRAME_GOOD;
}

frame_status frame_read(frame_reader *reader, uint8_t byte, frame *into)
{
    if (byte != 0u) {
        if (reader->count < FRAME_WIRE) {
            reader->bytes[reader->count++] = byte;
        }
        return FRAME_NONE;
    }
    frame_status status = FRAME_NONE;             /* a delimiter after a delimiter: nothing between them */
    if (reader->count > 0u) {
        status = reader->count < FRAME_WIRE ? frame_decode(reader, into) : FRAME_BAD;
    }
    reader->count = 0u;
    return status;
}

uint8_t *put_u8(uint8_t *at, uint8_t value)
{
    at[0] = value;
    return at + 1;
}

uint8_t *put_u16(uint8_t *at, uint16_t value)
{
    at[0] = (uint8_t)(value & 0xFFu);
    at[1] = (uint8_t)(value >> 8);
    return at + 2;
}

uint8_t *put_u32(uint8_t *at, uint32_t value)
{
    return put_u16(put_u16(at, (uint16_t)(value & 0xFFFFu)), (uint16_t)(value >> 16));
}

uint8_t *put_f32(uint8_t *at, float value)
{
    uint32_t bits;
    memcpy(&bits, &value, sizeof bits);
    return put_u32(at, bits);
}

uint16_t get_u16(const uint8_t *at)
{
    return (uint16_t)(at[0] | (uint16_t)((uint16_t)at[1] << 8));
}

int16_t get_i16(const uint8_t *at)
{
    int32_t value = get_u16(at);
    return (int16_t)(value > INT16_MAX ? value - 65536 : value);
}

uint32_t get_u32(const uint8_t *at)
{
    return get_u16(at) | (uint32_t)get_u16(at + 2) << 16;
}

float get_f32(const uint8_t *at)
{
    float value;
    uint32_t bits = get_u32(at);
    memcpy(&value, &bits, sizeof value);
    return value;
}
