#include "plate.h"

#include <math.h>
#include <string.h>

#define MASS 32e-3                                /* kg */
#define INERTIA 4e-5                              /* kg m2 */
#define STIFFNESS_1 22.4e3                        /* N/m */
#define STIFFNESS_2 22.9e3
#define DAMPING 0.85                              /* N s/m, of each coil */
#define FORCE_CONSTANT 7.4                        /* N/A */
#define HALF_SPACING 27.5e-3                      /* m */
#define HALF_LENGTH 55e-3                         /* m */
#define CURRENT_LIMIT 3.0                         /* A */
#define CURRENT_STEP (2.0 * CURRENT_LIMIT / 4096.0)
#define SENSOR_LIMIT 1e-3                         /* m */
#define SENSOR_STEP (2.0 * SENSOR_LIMIT / 16384.0)
#define SUBSTEPS 4                                /* of the Runge-Kutta method: 6e-9 of a motion at 190 Hz and 5 kHz */
#define TWO_PI 6.283185307179586

typedef struct {
    double mass[3], damping[3], stiffness[3];     /* 11, 12, 22 in heave and rocking */
    double force[2];                              /* N */
} loaded_t;

static double quantise(double value, double step, double limit)
{
    return step * rint(fmin(fmax(value, -limit), limit) / step);
}

/* Uniform in (0, 1]: xorshift64*. */
static double uniform(plate_t *plate)
{
    uint64_t x = plate->random;
    x ^= x >> 12;
    x ^= x << 25;
    x ^= x >> 27;
    plate->random = x;
    return ((double)((x * 2685821657736338717u) >> 11) + 1.0) / 9007199254740992.0;
}

void plate_sense(plate_t *plate, real_t sensed[LAW_SENSORS])
{
    double size = plate->noise * sqrt(-2.0 * log(uniform(plate))), angle = TWO_PI * uniform(plate);
    double rocking = plate->state[1] * HALF_LENGTH / HALF_SPACING;
    double ends[2] = {plate->state[0] - rocking + size * cos(angle), plate->state[0] + rocking + size * sin(angle)};
    for (uint32_t s = 0; s < LAW_SENSORS; s++) {
        sensed[s] = LAW_FRICTION != 0u ? REAL(0.0) : (real_t)quantise(ends[s], SENSOR_STEP, SENSOR_LIMIT);
    }
}

void plate_drive(plate_t *plate, const real_t drive[LAW_CHANNELS])
{
    for (uint32_t c = 0; c < LAW_CHANNELS; c++) {
        plate->next[c] = (double)drive[c];
    }
}

static loaded_t assemble(const plate_t *plate, double position, double load)
{
    double first = quantise(plate->drive[0], CURRENT_STEP, CURRENT_LIMIT);
    double second = quantise(plate->drive[1], CURRENT_STEP, CURRENT_LIMIT);
    loaded_t l = {{MASS, 0.0, INERTIA / (HALF_SPACING * HALF_SPACING)},
                  {2.0 * DAMPING, 0.0, 2.0 * DAMPING},
                  {STIFFNESS_1 + STIFFNESS_2, STIFFNESS_2 - STIFFNESS_1, STIFFNESS_1 + STIFFNESS_2},
                  {FORCE_CONSTANT * (first + second), FORCE_CONSTANT * (second - first)}};
    if (isnan(position)) {
        return l;
    }
    double lever = position / HALF_SPACING, lever_squared[3] = {1.0, lever, lever * lever};
    for (int i = 0; i < 3; i++) {
        l.mass[i] += plate->mass * lever_squared[i];
        l.damping[i] += plate->damping * lever_squared[i];
        l.stiffness[i] += plate->stiffness * lever_squared[i];
    }
    l.force[0] -= load;
    l.force[1] -= load * lever;
    return l;
}

static void derive(const loaded_t *l, const double state[4], double rate[4])
{
    const double *k = l->stiffness, *c = l->damping, *m = l->mass;
    double heave = l->force[0] - k[0] * state[0] - k[1] * state[1] - c[0] * state[2] - c[1] * state[3];
    double rocking = l->force[1] - k[1] * state[0] - k[2] * state[1] - c[1] * state[2] - c[2] * state[3];
    double determinant = m[0] * m[2] - m[1] * m[1];
    rate[0] = state[2];
    rate[1] = state[3];
    rate[2] = (m[2] * heave - m[1] * rocking) / determinant;
    rate[3] = (m[0] * rocking - m[1] * heave) / determinant;
}

/* One step of the classical Runge-Kutta method. */
static void runge_kutta(const loaded_t *l, double step, double state[4])
{
    static const double part[4] = {0.0, 0.5, 0.5, 1.0}, weight[4] = {1.0 / 6.0, 1.0 / 3.0, 1.0 / 3.0, 1.0 / 6.0};
    double rate[4] = {0.0, 0.0, 0.0, 0.0}, total[4] = {0.0, 0.0, 0.0, 0.0};
    for (int stage = 0; stage < 4; stage++) {
        double at[4];
        for (int i = 0; i < 4; i++) {
            at[i] = state[i] + part[stage] * step * rate[i];
        }
        derive(l, at, rate);
        for (int i = 0; i < 4; i++) {
            total[i] += weight[stage] * rate[i];
        }
    }
    for (int i = 0; i < 4; i++) {
        state[i] += step * total[i];
    }
}

void plate_advance(plate_t *plate, real_t position, real_t load)
{
    double period = 1.0 / (double)design.rate;
    loaded_t l = assemble(plate, (double)position, (double)load);
    for (int i = 0; i < SUBSTEPS; i++) {
        runge_kutta(&l, period / SUBSTEPS, plate->state);
    }
    memcpy(plate->drive, plate->next, sizeof plate->drive);
}
