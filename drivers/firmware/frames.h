/* Frames of the wire protocol (docs/protocol.md): COBS, CRC-16, little-endian fields.  C99, no heap, no state but the
   reader's. */
#ifndef FRAMES_H
#define FRAMES_H

#include <stddef.h>
#include <stdint.h>

enum {
    FRAME_HEAD = 3,                               /* kind, sequence */
    FRAME_CRC = 2,
    FRAME_BODY = 254,                             /* head, payload and CRC: one COBS group at most */
    FRAME_PAYLOAD = FRAME_BODY - FRAME_HEAD - FRAME_CRC,
    FRAME_WIRE = FRAME_BODY + 2                   /* with COBS code and delimiter */
};

typedef enum { FRAME_NONE, FRAME_GOOD, FRAME_BAD } frame_status;

typedef struct {
    uint8_t kind;
    uint16_t sequence;
    size_t count;                                 /* bytes of payload */
    uint8_t payload[FRAME_PAYLOAD];
} frame;

typedef struct {
    uint8_t bytes[FRAME_WIRE];
    size_t count;                                 /* FRAME_WIRE: too long, skip to the delimiter */
} frame_reader;

uint16_t crc16(const uint8_t *bytes, size_t count, uint16_t start);   /* polynomial 0x1021, as binascii.crc_hqx */
uint32_t crc32(const uint8_t *bytes, size_t count, uint32_t start);   /* as binascii.crc32 */

/* COBS without the delimiter; `to` holds count + count/254 + 1 bytes.  Return the bytes written. */
size_t cobs_encode(const uint8_t *from, size_t count, uint8_t *to);
/* Return the bytes written, at most count - 1, or SIZE_MAX where the code is malformed. */
size_t cobs_decode(const uint8_t *from, size_t count, uint8_t *to);

/* Write a frame with its delimiter to `wire` (FRAME_WIRE bytes); count <= FRAME_PAYLOAD.  Return its length. */
size_t frame_encode(uint8_t kind, uint16_t sequence, const uint8_t *payload, size_t count, uint8_t *wire);
/* Take a byte; FRAME_GOOD: `into` holds a frame, FRAME_BAD: one was malformed or its CRC was wrong. */
frame_status frame_read(frame_reader *reader, uint8_t byte, frame *into);

/* Write a field at `at` and return the place behind it. */
uint8_t *put_u8(uint8_t *at, uint8_t value);
uint8_t *put_u16(uint8_t *at, uint16_t value);
uint8_t *put_u32(uint8_t *at, uint32_t value);
uint8_t *put_f32(uint8_t *at, float value);
uint16_t get_u16(const uint8_t *at);
int16_t get_i16(const uint8_t *at);
uint32_t get_u32(const uint8_t *at);
float get_f32(const uint8_t *at);

#endif
