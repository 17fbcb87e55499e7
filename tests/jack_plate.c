/* A device behind a JACK client: x' = A x + B u, y = C x + D u, sample by sample, with white noise on its sensors.
 *
 * jack_plate CLIENT FILE: FILE holds four whole numbers (states, inputs, outputs, samples to record), the rms of the
 * noise in full scales, then A, B, C and D row by row.  Ports are in_1.. and out_1..  Commands on standard input:
 *   run N     go through N periods as fast as all clients can (freewheel)
 *   free ON   1: go through periods as fast as all clients can, until 0
 *   pace MS   wait in every period from now on, for `next` or so long: in freewheel all clients wait, and none is lost
 *   next      end the wait of this period, or of the coming one
 *   stall MS  sleep once inside a period: the server reports an overrun
 *   square N  square the last input, as a carrier does, and add N (a load)
 *   gain G Y N  multiply what is sensed, once N more periods are over and the first output is above Y, but not what is
 *             recorded as the truth
 *   count     print periods, overruns that JACK reported, and the time of the server in frames
 *   save FILE write what was recorded: float32, outputs without noise, then with it, a row a sample
 * The end of standard input ends it.
 */
#include <errno.h>
#include <jack/jack.h>
#include <semaphore.h>
#include <stdatomic.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

enum { MOST = 64 };

static int states, inputs, outputs;
static long length, recorded;
static double noise, load = -1.0, gain = 1.0, next_gain = 1.0, above = 1e9, a[MOST][MOST], b[MOST][MOST], c[MOST][MOST], d[MOST][MOST], x[MOST];
static float *record;
static jack_client_t *client;
static jack_port_t *in_port[MOST], *out_port[MOST];
static atomic_long periods, overruns, pace, stall, healthy;
static sem_t due;
static uint64_t seed = 88172645463325252u;

/* Sum of 12 uniform numbers: variance 1, peak 6. */
static double gauss(void) {
    double sum = -6.0;
    for (int i = 0; i < 12; i++) {
        seed ^= seed << 13;
        seed ^= seed >> 7;
        seed ^= seed << 17;
        sum += (double)(seed >> 11) / 9007199254740992.0;
    }
    return sum;
}

static void pause_ms(long milliseconds) {
    struct timespec time = {milliseconds / 1000, milliseconds % 1000 * 1000000};
    nanosleep(&time, NULL);
}

static void wait_until_due(long milliseconds) {
    struct timespec end;
    clock_gettime(CLOCK_REALTIME, &end);
    end.tv_nsec += milliseconds * 1000000;
    end.tv_sec += end.tv_nsec / 1000000000;
    end.tv_nsec %= 1000000000;
    while (sem_timedwait(&due, &end) && errno == EINTR) continue;
}

static double row(const double *matrix, const double *vector, int n) {
    double sum = 0.0;
    for (int i = 0; i < n; i++) sum += matrix[i] * vector[i];
    return sum;
}

static void sample(const double *u, double *y) {
    double next[MOST];
    for (int i = 0; i < outputs; i++) y[i] = row(c[i], x, states) + row(d[i], u, inputs);
    for (int i = 0; i < states; i++) next[i] = row(a[i], x, states) + row(b[i], u, inputs);
    memcpy(x, next, sizeof(double) * (size_t)states);
}

static int process(jack_nframes_t frames, void *unused) {
    float *in[MOST], *out[MOST];
    (void)unused;
    for (int i = 0; i < inputs; i++) in[i] = jack_port_get_buffer(in_port[i], frames);
    for (int i = 0; i < outputs; i++) out[i] = jack_port_get_buffer(out_port[i], frames);
    for (jack_nframes_t n = 0; n < frames; n++) {
        double u[MOST], y[MOST];
        for (int i = 0; i < inputs; i++) u[i] = in[i][n];
        if (load >= 0.0) u[inputs - 1] = u[inputs - 1] * u[inputs - 1] + load;
        sample(u, y);
        if (periods >= healthy && y[0] > above) gain = next_gain;
        for (int i = 0; i < outputs; i++) out[i][n] = (float)(gain * (y[i] + noise * gauss()));
        if (recorded < length) {
            for (int i = 0; i < outputs; i++) {
                record[2 * outputs * recorded + i] = (float)y[i];
                record[2 * outputs * recorded + outputs + i] = out[i][n];
            }
            recorded++;
        }
    }
    atomic_fetch_add(&periods, 1);
    long sleep = atomic_exchange(&stall, 0), wait = atomic_load(&pace);
    if (sleep) pause_ms(sleep);
    if (wait) wait_until_due(wait);
    return 0;
}

static int count_overrun(void *unused) {
    (void)unused;
    atomic_fetch_add(&overruns, 1);
    return 0;
}

static void read_matrix(FILE *file, double matrix[MOST][MOST], int rows, int columns) {
    for (int i = 0; i < rows; i++)
        for (int j = 0; j < columns; j++)
            if (fscanf(file, "%lf", &matrix[i][j]) != 1) exit(3);
}

static void read_system(const char *name) {
    FILE *file = fopen(name, "r");
    if (!file || fscanf(file, "%d %d %d %ld %lf", &states, &inputs, &outputs, &length, &noise) != 5) exit(3);
    if (states > MOST || inputs > MOST || outputs > MOST) exit(3);
    read_matrix(file, a, states, states);
    read_matrix(file, b, states, inputs);
    read_matrix(file, c, outputs, states);
    read_matrix(file, d, outputs, inputs);
    fclose(file);
    record = calloc((size_t)(2 * outputs * length + 1), sizeof(float));
    if (!record) exit(3);
}

static void save(const char *name) {
    FILE *file = fopen(name, "wb");
    if (!file) exit(3);
    fwrite(record, sizeof(float), (size_t)(2 * outputs * recorded), file);
    fclose(file);
}

static void run(long count) {
    long end = atomic_load(&periods) + count;
    jack_set_freewheel(client, 1);
    while (atomic_load(&periods) < end) pause_ms(1);
    jack_set_freewheel(client, 0);
}

static void obey(char *line) {
    long number = 0;
    double factor, level;
    char name[4096];
    sscanf(line, "square %lf", &load);
    if (sscanf(line, "gain %lf %lf %ld", &factor, &level, &number) == 3) {
        atomic_store(&healthy, atomic_load(&periods) + number);  /* before what waits for it */
        next_gain = factor, above = level;
    }
    if (sscanf(line, "run %ld", &number) == 1) run(number);
    if (sscanf(line, "free %ld", &number) == 1) jack_set_freewheel(client, (int)number);
    if (sscanf(line, "pace %ld", &number) == 1) atomic_store(&pace, number);
    if (!strcmp(line, "next\n")) sem_post(&due);
    if (sscanf(line, "stall %ld", &number) == 1) atomic_store(&stall, number);
    if (sscanf(line, "save %4095[^\n]", name) == 1) save(name);
    printf("%ld %ld %u\n", atomic_load(&periods), atomic_load(&overruns), jack_frame_time(client));
    fflush(stdout);
}

int main(int argc, char **argv) {
    char line[4352], name[32];
    if (argc != 3 || sem_init(&due, 0, 0)) return 2;
    read_system(argv[2]);
    client = jack_client_open(argv[1], JackNoStartServer, NULL);
    if (!client) return 4;
    for (int i = 0; i < inputs; i++) {
        snprintf(name, sizeof name, "in_%d", i + 1);
        in_port[i] = jack_port_register(client, name, JACK_DEFAULT_AUDIO_TYPE, JackPortIsInput, 0);
    }
    for (int i = 0; i < outputs; i++) {
        snprintf(name, sizeof name, "out_%d", i + 1);
        out_port[i] = jack_port_register(client, name, JACK_DEFAULT_AUDIO_TYPE, JackPortIsOutput, 0);
    }
    jack_set_process_callback(client, process, NULL);
    jack_set_xrun_callback(client, count_overrun, NULL);
    if (jack_activate(client)) return 5;
    printf("ready\n");
    fflush(stdout);
    while (fgets(line, sizeof line, stdin)) obey(line);
    jack_client_close(client);
    return 0;
}
