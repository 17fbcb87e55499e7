/*
 * Measure the control law on a Cortex-M4 in QEMU, with -DSUPERVISED under its supervisor: a finger lands on the simulated
 * plate and slides; prints what a sample takes and the telemetry of the bands, a line each: a name and numbers.  Beside
 * it what the board takes more: to read and check a frame of 64 samples of a texture, and for a sample of two textures
 * of which one fades into the other.  With `-icount shift=6` an instruction is 64 ns, 1.6 counts of the timer of 40 ns.
 */
#include <string.h>

#include "frames.h"
#include "machine_m4.h"
#include "plate.h"
#include "supervisor.h"
#include "texture.h"

#ifndef SAMPLES
#define SAMPLES 3000u
#define LANDS 500u   /* sample at which the finger lands; the initial motion of a contact is learned for 0.16 s */
#endif
#define SPEED 0.08   /* m/s */
#define LOAD REAL(0.4) /* N */

static law_t law;
static supervisor_t supervisor;
static plate_t plate = PLATE_DEFAULT;

static __attribute__((noinline)) uint32_t measure_count(void) { return ~TIMER0_VALUE; }

/* A line of a name and numbers of magnitude below 4e6, with three digits after the point. */
static void print_line(const char *name, const double values[], uint32_t count)
{
    machine_print(name);
    for (uint32_t i = 0u; i < count; i++) {
        char text[16];
        char *at = text + sizeof(text) - 1u;
        uint32_t left = (uint32_t)((values[i] < 0.0 ? -values[i] : values[i]) * 1000.0 + 0.5);
        *at = '\0';
        for (uint32_t digit = 0u; (digit < 4u) || (left > 0u); digit++) {
            *--at = (char)('0' + (char)(left % 10u));
            left /= 10u;
            if (digit == 2u) {
                *--at = '.';
            }
        }
        machine_print((values[i] < 0.0) ? " -" : " ");
        machine_print(at);
    }
    machine_print("\n");
}

static void print_number(const char *name, double value) { print_line(name, &value, 1u); }

/* Count a thousand instructions, and none: shows that the machine counts instructions, and at what cost.  A function of
   its own, so that what stands around it does not change the count. */
static __attribute__((noinline)) uint32_t calibrate(void)
{
    const uint32_t start = measure_count();
    const uint32_t empty = measure_count() - start;
    const uint32_t first = measure_count();
    __asm__ volatile(".rept 1000\n nop\n .endr");
    print_number("nops", (double)(measure_count() - first - empty));
    return empty;
}

/* Noise of about 5 um rms and 50-500 Hz: a waveform where the scene has no bands. */
static real_t next_waveform(void)
{
    static uint32_t random = 1u;
    static real_t low = REAL(0.0);
    static real_t slow = REAL(0.0);
    random = random * 1664525u + 1013904223u;
    const real_t white = (real_t)(random >> 8) / REAL(16777216.0) - REAL(0.5);
    low += REAL(0.47) * (white * REAL(40e-6) - low);
    slow += REAL(0.06) * (low - slow);
    return low - slow;
}

static void print_telemetry(void)
{
    for (uint32_t k = 0u; k < design.bands_used; k++) {
        real_t target[2];
        real_t measured[2];
        law_target(&law, k, target);
        law_measured(&law, k, measured);
        const double row[5] = {(double)k, 1e6 * (double)target[0], 1e6 * (double)target[1], 1e6 * (double)measured[0],
                               1e6 * (double)measured[1]};
        print_line("band", row, 5u);
    }
}

static void measure_frame(uint32_t empty)
{
    static frame_reader reader;
    static frame incoming;
    uint8_t payload[141]; /* of SAMPLES */
    uint8_t wire[FRAME_WIRE];
    uint32_t good = 0u;
    for (size_t i = 0u; i < sizeof(payload); i++) {
        payload[i] = (uint8_t)(i + 1u);
    }
    const size_t count = frame_encode(1u, 1u, payload, sizeof(payload), wire);
    const uint32_t begin = measure_count();
    for (size_t i = 0u; i + 1u < count; i++) {
        good += (frame_read(&reader, wire[i], &incoming) == FRAME_GOOD) ? 1u : 0u;
    }
    const uint32_t start = measure_count(); /* the work of one sample, in which a frame ends */
    good += (frame_read(&reader, wire[count - 1u], &incoming) == FRAME_GOOD) ? 1u : 0u;
    good += crc32(incoming.payload, incoming.count, 0u) & 1u;
    print_number("frame", (double)(measure_count() - start - empty));
    print_number("byte", (double)(start - begin - empty) / (double)count);
    print_number("frames_read", (double)good);
}

static void measure_textures(uint32_t empty)
{
    static textures_t textures;
    uint32_t dry = 0u;
    textures_init(&textures);
    for (uint32_t i = 0u; i < 2u; i++) {
        texture_t *texture = &textures.of[i];
        texture->timed = 1u;
        texture->written = TEXTURE_RING;
        texture->points = TEXTURE_POINTS;
        texture->start = REAL(-0.057);
        texture->step = REAL(1.4e-5);
        texture->scale = REAL(1e-10);
    }
    textures.weight = REAL(0.0);
    const uint32_t start = measure_count();
    for (uint32_t n = 0u; n < 100u; n++) {
        (void)textures_step(&textures, REAL(0.01), n, design.rate, &dry);
    }
    print_number("textures", (double)(measure_count() - start - empty) / 100.0);
    print_number("textures_state", (double)sizeof(textures_t));
}

int main(void)
{
    double sums[3] = {0.0, 0.0, 0.0}; /* without a finger, while its contact is new, and later */
    uint32_t most = 0u;
    uint32_t flags = 0u;
    machine_start_timer();
    const uint32_t empty = calibrate();
    law_init(&law, &design);
    supervisor_init(&supervisor, &supervision, &design);
    for (uint32_t n = 0u; n < SAMPLES; n++) {
        real_t sensed[LAW_SENSORS];
        real_t drive[LAW_CHANNELS] = {REAL(0.0)};
        const real_t waveform = (design.bands_used == 0u) ? next_waveform() : REAL(0.0);
        const double position = (n < LANDS) ? NAN : (SPEED / (double)design.rate * (double)(n - LANDS) - 0.02);
        plate_sense(&plate, sensed);
        const uint32_t start = measure_count();
#ifdef SUPERVISED
        flags |= supervisor_step(&supervisor, &law, sensed, (real_t)position, waveform, drive);
#else
        flags |= law_step(&law, sensed, (real_t)position, waveform, drive);
#endif
        const uint32_t taken = measure_count() - start - empty;
        most = (taken > most) ? taken : most;
        sums[(n < LANDS) ? 0 : ((n < LANDS + design.initial_end) ? 1 : 2)] += (double)taken;
        plate_drive(&plate, drive);
        plate_advance(&plate, (real_t)position, LOAD);
    }
    print_number("free", sums[0] / LANDS);
    print_number("new", sums[1] / design.initial_end);
    print_number("touched", sums[2] / (SAMPLES - LANDS - design.initial_end));
    print_number("most", (double)most);
    print_number("flags", (double)flags);
    print_number("state", (double)sizeof(law_t));
    print_number("supervisor", (double)sizeof(supervisor_t));
    measure_frame(empty);
    measure_textures(empty);
    print_telemetry();
    return 0;
}
