/*
 * The board as a process: its serial line is a pseudo-terminal, its sensors and coils are those of a plate model, and
 * the finger is where the host sends it.
 *
 *   board LINK [--noise RMS] [--gain FIRST,SECOND[,SAMPLE]] [--log FILE] [--slow N] [--step]
 *
 * LINK becomes a symbolic link to the pseudo-terminal.  Paced by the clock, or by one that is N times as slow; with
 * --step by its standard input: a line
 * "SAMPLES BYTES" lets it run so many samples once it has received so many bytes in all, after which it writes
 * "SAMPLE BYTES", where it is and the bytes that it has sent in all.  FILE gets a line for whatever it executes.
 * --gain makes a sensor inverted (-1), dead (0), wrong or no number (nan), from SAMPLE on.
 */
#define _XOPEN_SOURCE 700

#include <errno.h>
#include <fcntl.h>
#include <inttypes.h>
#include <poll.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

#include "board.h"
#include "hardware.h"
#include "plate.h"

#define BURST 1000000L                            /* ns between two looks at the clock */

const uint32_t hardware_cycle_rate = 1000000000u;

static board_t board;
static plate_t plate = PLATE_DEFAULT;
static double gain[2] = {1.0, 1.0};               /* of the sensors */
static uint32_t failing;                          /* sample from which on they have it */
static int line = -1;                             /* master of the pseudo-terminal */
static double slower = 1.0;                       /* than the clock */
static int stepped;                               /* time comes from standard input */
static uint8_t received[65536];
static size_t received_in, received_out;
static uint64_t bytes_in, bytes_out;
static unsigned long granted;
static FILE *log_file;
static const char *link_path;
static volatile sig_atomic_t ended;

static void fail(const char *what)
{
    fprintf(stderr, "board: %s: %s\n", what, strerror(errno));
    exit(1);
}

uint32_t hardware_cycles(void)
{
    struct timespec now;
    (void)clock_gettime(CLOCK_MONOTONIC, &now);
    return (uint32_t)((uint64_t)now.tv_sec * 1000000000u + (uint64_t)now.tv_nsec);
}

static void take_bytes(void)
{
    if (received_out == received_in) {
        received_in = received_out = 0;
    }
    ssize_t count = read(line, received + received_in, sizeof received - received_in);
    if (count > 0) {
        received_in += (size_t)count;
        bytes_in += (uint64_t)count;
    }
}

/* Read the next grant of time, and the bytes that belong to it; 0 at the end of standard input. */
static int take_grant(void)
{
    uint64_t until;
    printf("%" PRIu32 " %" PRIu64 "\n", board.sample, bytes_out);
    (void)fflush(stdout);
    if (scanf("%lu %" SCNu64, &granted, &until) != 2) {
        return 0;
    }
    while (bytes_in < until) {
        struct pollfd readable = {line, POLLIN, 0};
        if (poll(&readable, 1, 1000) < 0 && errno != EINTR) {
            return 0;
        }
        take_bytes();
    }
    return 1;
}

static void wait_for_clock(void)
{
    static struct timespec due;
    static long ahead;                            /* ns that have been run beyond `due` */
    if (due.tv_sec == 0) {
        (void)clock_gettime(CLOCK_MONOTONIC, &due);
    }
    ahead += (long)(1e9 * slower / (double)design.rate);
    if (ahead >= BURST) {
        due.tv_nsec += ahead;
        ahead = 0;
        if (due.tv_nsec >= 1000000000L) {
            due.tv_nsec -= 1000000000L;
            due.tv_sec++;
        }
        (void)clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &due, NULL);
        take_bytes();
    }
}

uint32_t hardware_wait(void)
{
    plate_advance(&plate, board.position, board.finger.load);
    if (!stepped) {
        wait_for_clock();
        return ended ? 0u : 1u;
    }
    while (granted == 0u) {
        if (!take_grant()) {
            return 0u;
        }
    }
    granted--;
    return 1u;
}

void hardware_sense(real_t sensed[])
{
    plate_sense(&plate, sensed);
    for (uint32_t s = 0; s < LAW_SENSORS; s++) {
        sensed[s] *= board.sample >= failing ? (real_t)gain[s] : REAL(1.0);
    }
}

void hardware_drive(const real_t drive[]) { plate_drive(&plate, drive); }

size_t hardware_read(uint8_t bytes[], size_t most)
{
    size_t count = received_in - received_out < most ? received_in - received_out : most;
    memcpy(bytes, received + received_out, count);
    received_out += count;
    return count;
}

size_t hardware_write(const uint8_t bytes[], size_t count)
{
    ssize_t taken = write(line, bytes, count);
    if (taken < 0) {
        return 0;
    }
    bytes_out += (uint64_t)taken;
    return (size_t)taken;
}

/* Log what has changed in this tick: set-points, gain, state, and whether anything drives. */
static void log_tick(void)
{
    static uint32_t commits;
    static board_state state;
    static int driven;
    static real_t last_gain = REAL(1.0);
    if (board.commits != commits) {
        commits = board.commits;
        fprintf(log_file, "%" PRIu32 " commit %" PRIu32, board.sample, board.played.bands_used);
        for (uint32_t i = 0; i < board.played.bands_used; i++) {
            const band_t *b = &board.played.bands[i];
            fprintf(log_file, " %.9g %.9g %.9g %.9g %.9g", (double)b->frequency, (double)b->wavenumber,
                    (double)b->phase, (double)b->re, (double)b->im);
        }
        fprintf(log_file, "\n");
    }
    if (board.gain < last_gain || board.gain > last_gain) {
        last_gain = board.gain;
        fprintf(log_file, "%" PRIu32 " gain %.9g\n", board.sample, (double)last_gain);
    }
    if (board.state != state) {
        state = board.state;
        fprintf(log_file, "%" PRIu32 " state %d %d\n", board.sample, (int)state, (int)board.cause);
    }
    int drives = plate.next[0] < 0.0 || plate.next[0] > 0.0 || plate.next[1] < 0.0 || plate.next[1] > 0.0;
    if (drives != driven) {
        driven = drives;
        fprintf(log_file, "%" PRIu32 " drives %d\n", board.sample, driven);
    }
    (void)fflush(log_file);
}

static void open_line(void)
{
    struct termios settings;
    char target[256];
    line = posix_openpt(O_RDWR | O_NOCTTY);
    if (line < 0 || grantpt(line) != 0 || unlockpt(line) != 0) {
        fail("no pseudo-terminal");
    }
    (void)snprintf(target, sizeof target, "%s", ptsname(line));
    int other = open(target, O_RDWR | O_NOCTTY);  /* stays open: without a host the line is there, as a cable is */
    if (other < 0 || tcgetattr(other, &settings) != 0) {
        fail(target);
    }
    settings.c_iflag = settings.c_oflag = settings.c_lflag = 0;
    settings.c_cflag = CS8 | CREAD | CLOCAL;
    settings.c_cc[VMIN] = 1;
    settings.c_cc[VTIME] = 0;
    if (tcsetattr(other, TCSANOW, &settings) != 0 || fcntl(line, F_SETFL, O_NONBLOCK) != 0) {
        fail(target);
    }
    (void)unlink(link_path);
    if (symlink(target, link_path) != 0) {
        fail(link_path);
    }
}

static void take_option(const char *name, const char *value)
{
    if (strcmp(name, "--gain") == 0 && sscanf(value, "%lf,%lf,%" SCNu32, &gain[0], &gain[1], &failing) >= 2) {
        return;
    }
    if (strcmp(name, "--noise") == 0 && sscanf(value, "%lf", &plate.noise) == 1) {
        return;
    }
    if (strcmp(name, "--slow") == 0 && sscanf(value, "%lf", &slower) == 1 && slower >= 1.0 && slower <= 1000.0) {
        return;
    }
    if (strcmp(name, "--log") == 0 && (log_file = fopen(value, "w")) != NULL) {
        return;
    }
    fprintf(stderr, "board: option %s %s: see the head of hardware_posix.c\n", name, value);
    exit(2);
}

static void end(int number)
{
    (void)number;
    ended = 1;
}

int main(int argc, char **argv)
{
    struct sigaction action;
    if (argc < 2) {
        fprintf(stderr, "usage: board LINK [--noise RMS] [--gain FIRST,SECOND[,SAMPLE]] [--log FILE] [--slow N] [--step]\n");
        return 2;
    }
    link_path = argv[1];
    for (int i = 2; i < argc; i++) {
        if (strcmp(argv[i], "--step") == 0) {
            stepped = 1;
        } else {
            take_option(argv[i], i + 1 < argc ? argv[i + 1] : "");
            i++;
        }
    }
    memset(&action, 0, sizeof action);
    action.sa_handler = end;
    (void)sigaction(SIGTERM, &action, NULL);
    (void)sigaction(SIGINT, &action, NULL);
    board_init(&board);
    open_line();
    for (uint32_t ticks = hardware_wait(); ticks > 0u; ticks = hardware_wait()) {
        board_tick(&board, ticks);
        if (log_file != NULL) {
            log_tick();
        }
    }
    (void)unlink(link_path);
    return 0;
}
