/* The same arithmetic as the library's polar kernel, tuned by hand: bands in vector registers, four short passes over a
 * block of up to 64 samples with everything between them in L1, polynomials for sine, cosine and angle.
 * Compiled twice: -DSINGLE makes it float with filters in powers of z - 1. */
#include <math.h>

#ifdef SINGLE
typedef float real;
#define W 16
#define NAME polar_single
#define RINT(x) __builtin_rintf(x)
typedef int mask_element;
#else
typedef double real;
#define W 8
#define NAME polar_double
#define RINT(x) __builtin_rint(x)
typedef long mask_element;
#endif
typedef real v __attribute__((vector_size(64)));
typedef mask_element mask __attribute__((vector_size(64)));
#define BLOCK 64

typedef struct {
    double frequency[W], turns[W];
    v amplitude, heading_re, heading_im;
    struct { v drive, re1, re2, im1, im2, amplitude1, amplitude2, theta1, theta2; } channel[2];
} Tile;

typedef struct { real b0, b1, b2, a1, a2; } Section;

static inline v pick(mask m, v a, v b) { return (v)(((mask)a & m) | ((mask)b & ~m)); }
static inline v size(v a) { return pick(a < 0, -a, a); }
static inline v all(real a) { return a - (v){}; }
static inline v nearest(v a) {
    v r;
    for (int i = 0; i < W; i++) r[i] = RINT(a[i]);
    return r;
}

static inline v section(Section s, v *s1, v *s2, v x) {
    v y = s.b0 * x + *s1;
#ifdef SINGLE
    v middle = *s1 + *s2 + s.b1 * x - s.a1 * y; /* here b and a are those of powers of z - 1 */
    *s2 = *s2 + s.b2 * x - s.a2 * y;
    *s1 = middle;
#else
    *s1 = s.b1 * x - s.a1 * y + *s2;
    *s2 = s.b2 * x - s.a2 * y;
#endif
    return y;
}

#ifdef SINGLE
static const real S[] = {POLY_S_SHORT}, C[] = {POLY_C_SHORT}, A[] = {POLY_A_SHORT}, R[] = {POLY_R_SHORT};
#else
static const real S[] = {POLY_S}, C[] = {POLY_C}, A[] = {POLY_A}, R[] = {POLY_R};
#endif

static inline void unit(v turns, v *cosine, v *sine) {
    v x = turns - nearest(turns);
    mask far = size(x) > (real)0.25;
    x = pick(far, pick(x > 0, all(0.5), all(-0.5)) - x, x);
    v u = x * x, u2 = u * u;
#ifdef SINGLE
    v s = S[0] + u * (S[1] + u * (S[2] + u * (S[3] + u * S[4])));
    v c = C[0] + u * (C[1] + u * (C[2] + u * (C[3] + u * C[4])));
#else
    v s = (S[0] + S[1] * u) + (S[2] + S[3] * u) * u2 + ((S[4] + S[5] * u) + (S[6] + S[7] * u) * u2) * (u2 * u2);
    v c = (C[0] + C[1] * u) + (C[2] + C[3] * u) * u2 + ((C[4] + C[5] * u) + (C[6] + C[7] * u) * u2) * (u2 * u2);
#endif
    *cosine = pick(far, -c, c);
    *sine = s * x;
}

static inline void polar(v im, v re, v *magnitude, v *angle) {
    v across = size(im), along = size(re);
    mask steep = across > along;
    v larger = pick(steep, across, along), smaller = pick(steep, along, across);
    v t = smaller / pick(larger > (real)1e-30, larger, all((real)1e-30));
    v u = t * t, u2 = u * u, u4 = u2 * u2;
    v p = (A[0] + A[1] * u) + (A[2] + A[3] * u) * u2 + ((A[4] + A[5] * u) + (A[6] + A[7] * u) * u2) * u4;
    v r = (R[0] + R[1] * u) + (R[2] + R[3] * u) * u2 + ((R[4] + R[5] * u) + (R[6] + R[7] * u) * u2) * u4;
#ifndef SINGLE
    p += ((A[8] + A[9] * u) + (A[10] + A[11] * u) * u2) * (u4 * u4);
    r += ((R[8] + R[9] * u) + (R[10] + R[11] * u) * u2) * (u4 * u4);
#endif
    p = t * p;
    p = pick(steep, (real)M_PI_2 - p, p);
    p = pick(re < 0, (real)M_PI - p, p);
    *magnitude = larger * r;
    *angle = pick(im < 0, -p, p);
}

/* y and drive: (samples, 2), double; filter and law: b0 b1 b2 a1 a2, in powers of z - 1 for float */
void NAME(Tile *tiles, int count, double rate, const double *filter, const double *law,
          const double *y, double *drive, int samples) {
    Section low_pass = {filter[0], filter[1], filter[2], filter[3], filter[4]};
    Section loop = {law[0], law[1], law[2], law[3], law[4]};
    v cosine[BLOCK], sine[BLOCK], re[BLOCK], im[BLOCK], sum[2][BLOCK];
    for (int start = 0; start < samples; start += BLOCK) {
        int block = samples - start < BLOCK ? samples - start : BLOCK;
        for (int m = 0; m < block; m++) sum[0][m] = sum[1][m] = (v){};
        for (int t = 0; t < count; t++) {
            Tile *tile = &tiles[t];
            v c, s, turn_c, turn_s;
            for (int i = 0; i < W; i++) { /* seeded anew each block, in double */
                c[i] = cos(2 * M_PI * tile->turns[i]), s[i] = sin(2 * M_PI * tile->turns[i]);
                double step = tile->frequency[i] / rate;
                turn_c[i] = cos(2 * M_PI * step), turn_s[i] = sin(2 * M_PI * step);
                tile->turns[i] += step * block;
                tile->turns[i] -= floor(tile->turns[i]);
            }
            for (int m = 0; m < block; m++) {
                cosine[m] = c, sine[m] = s;
                v next = c * turn_c - s * turn_s;
                s = s * turn_c + c * turn_s;
                c = next;
            }
            v h_re = tile->heading_re, h_im = tile->heading_im, amount = tile->amplitude;
            for (int channel = 0; channel < 2; channel++) {
                v re1 = tile->channel[channel].re1, re2 = tile->channel[channel].re2;
                v im1 = tile->channel[channel].im1, im2 = tile->channel[channel].im2;
                for (int m = 0; m < block; m++) {
                    real twice = 2 * y[2 * (start + m) + channel];
                    re[m] = section(low_pass, &re1, &re2, twice * cosine[m]);
                    im[m] = section(low_pass, &im1, &im2, -twice * sine[m]);
                }
                tile->channel[channel].re1 = re1, tile->channel[channel].re2 = re2;
                tile->channel[channel].im1 = im1, tile->channel[channel].im2 = im2;
                for (int m = 0; m < block; m++) {
                    v magnitude, lag;
                    polar(im[m] * h_re - re[m] * h_im, re[m] * h_re + im[m] * h_im, &magnitude, &lag);
                    re[m] = amount - magnitude;
                    im[m] = pick(lag > (real)M_PI_2, lag - (real)(2 * M_PI), lag);
                }
                v theta1 = tile->channel[channel].theta1, theta2 = tile->channel[channel].theta2;
                v state1 = tile->channel[channel].amplitude1, state2 = tile->channel[channel].amplitude2;
                for (int m = 0; m < block; m++) {
                    im[m] = section(loop, &theta1, &theta2, -im[m]);
                    v error = re[m], command = loop.b0 * error + state1;
                    mask held = command < 0;
                    command = pick(held, (v){}, command);
#ifdef SINGLE
                    state1 = pick(held, -loop.b0 * error, state1), state2 = pick(held, (v){}, state2);
                    v middle = state1 + state2 + loop.b1 * error - loop.a1 * command;
                    state2 = state2 + loop.b2 * error - loop.a2 * command;
                    state1 = middle;
#else
                    state1 = loop.b1 * error - loop.a1 * command + state2;
                    state2 = loop.b2 * error - loop.a2 * command;
#endif
                    re[m] = command;
                }
                tile->channel[channel].theta1 = theta1, tile->channel[channel].theta2 = theta2;
                tile->channel[channel].amplitude1 = state1, tile->channel[channel].amplitude2 = state2;
                v gain = tile->channel[channel].drive;
                for (int m = 0; m < block; m++) {
                    v p, q;
                    unit(im[m] * (real)(0.5 / M_PI), &p, &q);
                    v carried = (h_re * p - h_im * q) * cosine[m] - (h_re * q + h_im * p) * sine[m];
                    sum[channel][m] += re[m] * gain * carried;
                }
            }
        }
        for (int m = 0; m < block; m++)
            for (int channel = 0; channel < 2; channel++) {
                double total = 0.0;
                for (int i = 0; i < W; i++) total += sum[channel][m][i];
                drive[2 * (start + m) + channel] = total;
            }
    }
}
