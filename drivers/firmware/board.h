/*
 * The board: bytes from the host become set-points, finger and commands; the law runs once a tick; telemetry goes back.
 *
 * docs/protocol.md has every frame.  A set-point acts only after a COMMIT whose digest is that of what the board holds;
 * every command carries a CRC-32 that starts from the session, beside the frame's CRC-16.  Without a keep-alive for
 * 80 ms, or without a beat of the application for the time of its watchdog, the drive fades out within 10 ms.  Static
 * memory: BOARD_BYTES of design.h, no heap, no recursion.
 */
#ifndef BOARD_H
#define BOARD_H

#include <stddef.h>
#include <stdint.h>

#include "frames.h"
#include "law.h"
#include "supervisor.h"
#include "texture.h"

enum {
    BOARD_VERSION = 6,
    BOARD_SILENCE_MS = 80,                        /* without a keep-alive (HEARTBEAT, FINGER): fade out */
    BOARD_FADE_MS = 10,
    BOARD_EXTRAPOLATE_MS = 50,                    /* a finger's position follows its velocity for so long, then holds */
    BOARD_FINGER_MS = 200,                        /* without a FINGER frame: no finger */
    BOARD_INVALID_MS = 10,                        /* of invalid samples: stop */
    BOARD_LINES = 64,                             /* of a multisine */
    BOARD_QUEUE = 1024,                           /* rows of drive on their way */
    BOARD_SEND = 4096                             /* bytes to the host on their way */
};

/* Kinds of frames. */
enum {
    KIND_HELLO = 0x01, KIND_HEARTBEAT, KIND_FINGER, KIND_SETPOINT, KIND_COMMIT, KIND_GAIN, KIND_LIMITS, KIND_START,
    KIND_STOP, KIND_LINE, KIND_IDENTIFY, KIND_DRIVE, KIND_TEXTURE, KIND_PROFILE, KIND_SAMPLES, KIND_PLAY,
    KIND_CAPABILITIES = 0x81, KIND_ACK, KIND_REFUSE, KIND_TELEMETRY, KIND_STREAM
};

/* Reasons of a refusal. */
enum {
    REASON_NONE, REASON_VERSION, REASON_CHECK, REASON_KIND, REASON_LENGTH, REASON_VALUE, REASON_DIGEST, REASON_STATE
};

typedef enum { BOARD_IDLE, BOARD_PLAYING, BOARD_IDENTIFYING, BOARD_DRIVING } board_state;

/* Why the board last came to rest. */
typedef enum {
    CAUSE_NONE, CAUSE_COMMAND, CAUSE_SILENCE, CAUSE_LIMIT, CAUSE_SENSOR, CAUSE_DONE, CAUSE_SESSION,
    CAUSE_APPLICATION,
    CAUSE_SUPERVISOR = 16                         /* and a supervisor_cause_t */
} board_cause;

#define BOARD_SENSED (design.learns != 0u ? LAW_SENSORS : 0u) /* sensors: in open loop none */

/* Flags beside those of the law, as hapticrender.protocols.Flag. */
#define BOARD_OVERRUN 8u
#define BOARD_STOPPED 64u

typedef struct {
    uint8_t channel;
    real_t amplitude;                             /* A */
    real_t turns, step;                           /* of its phase; a sample */
} line_t;

typedef struct {
    real_t position, velocity, load;              /* m (NaN: lifted), m/s, N */
    uint32_t written;                             /* us of the board's clock when the host wrote the frame */
    uint32_t offset;                              /* us: least lead of the board's clock over the host's */
    uint32_t known;                               /* 1: offset is known */
} finger_input_t;

typedef struct {
    uint64_t clock;                               /* us since reset, times 65536; first: the only one of 8 bytes */
    law_t law;
    supervisor_t supervisor;
    design_t played;                              /* the design, with the bands in use */
    board_state state;
    uint32_t cause;                               /* a board_cause, or CAUSE_SUPERVISOR and the supervisor's */
    uint32_t sample;                              /* since reset; wraps */
    uint32_t clock_step;
    uint32_t nonce, session;                      /* the host's number, and what the board made of it; 0: no host */
    uint16_t commanded, kept_alive, next;         /* sequence of the last command, the last keep-alive, the next out */
    uint8_t replied[FRAME_WIRE];                  /* to the last command */
    size_t replied_count;
    uint32_t quiet;                               /* samples since the last keep-alive */
    uint32_t beat, unattended, watchdog;          /* of the application: last beat; samples since; most, 0: any */
    uint32_t echo;                                /* us: host's time of the last keep-alive */
    uint32_t bad, refused, dropped;               /* frames: malformed; refused; not sent as the line was full */
    finger_input_t finger;
    uint8_t staged[LAW_BANDS][20];                /* set-points as received, until COMMIT */
    uint32_t commits;                             /* COMMITs executed; the bands in use are `played.bands` */
    uint32_t committed;                           /* 1: this session has set-points */
    real_t gain;
    real_t peak, rms, heating, heat;              /* A, A, smoothing factor, A^2 */
    real_t displacement;                          /* m: bound of a sensor */
    real_t fade, fade_step, fade_to;
    uint32_t invalid;                             /* samples in a row */
    line_t lines[BOARD_LINES];
    uint8_t line_bytes[BOARD_LINES][13];
    uint32_t lines_used, remaining;               /* of a multisine; samples to its end */
    float queue[BOARD_QUEUE][LAW_CHANNELS];
    uint32_t queue_in, queue_out;                 /* rows ever written, ever played */
    uint32_t stride, period;                      /* samples between rows of the stream, between telemetry; 0: none */
    uint32_t cycles_most, cycles_sum, cycles_count;
    uint32_t flags, flags_seen;                   /* of the sample, since the last telemetry */
    real_t position;                              /* m, of the finger in this sample; NaN: lifted */
    real_t sensed[LAW_SENSORS], drive[LAW_CHANNELS], acting[LAW_CHANNELS]; /* m; A: for the next interval; in this */
    uint8_t stream[FRAME_PAYLOAD];
    size_t stream_count;
    frame_reader reader;
    frame incoming;
    uint8_t sending[BOARD_SEND];
    size_t sending_in, sending_out;
    textures_t textures;                          /* last, as they are large */
} board_t;

/* Does not compile where a board takes more than design.h states; pointers and size_t of 8 bytes, and double, may. */
typedef char board_bytes_hold[sizeof(board_t) <= BOARD_BYTES * (sizeof(real_t) / 4u) + 16u * (sizeof(void *) - 4u)
                                  ? 1 : -1];

/* Set the board to rest, as after a reset. */
void board_init(board_t *board);

/* Do the work of a tick: read the host, sense, run the law, drive, answer.  `ticks` is what hardware_wait returned. */
void board_tick(board_t *board, uint32_t ticks);

/* Between the files of the board; `from` is a command without its check value. */
uint32_t board_time(const board_t *board);                      /* us since reset; wraps */
uint32_t board_samples_of(const board_t *board, uint32_t milliseconds);
void board_defaults(board_t *board);                            /* gain and limits of the design */
void board_limit_law(board_t *board);
void board_begin(board_t *board, board_state state);            /* a run, from rest */
void board_stop(board_t *board, uint32_t cause);                /* fade out, unless at rest */
void board_command(board_t *board, frame *from);                /* board_commands.c; `from` with its check value */
void board_send(board_t *board, uint8_t kind, uint16_t sequence, const uint8_t *payload, size_t count);
uint8_t board_texture(board_t *board, const frame *from);       /* board_textures.c: a reason, or none */
uint8_t board_profile(board_t *board, const frame *from);
uint8_t board_samples(board_t *board, const frame *from);
uint8_t board_play(board_t *board, const frame *from);
void board_telemetry(board_t *board);                           /* board_telemetry.c */
void board_stream(board_t *board);
void board_flush(board_t *board);

#endif
