/* The same arithmetic as the library's polar passes, tuned by hand: bands in vector registers, three short passes over
 * a block of up to 64 samples with everything between them in L1, polynomials for sine, cosine and angle, sections in
 * powers of z - 1.  Compiled twice: -DSINGLE makes it float. */
#include <math.h>
#ifdef __AVX512DQ__
#include <immintrin.h>
#endif

#ifdef SINGLE
typedef float real;
#define W 16
#define NAME polar_single
#define RINT(x) __builtin_rintf(x)
#define TINY 1e-30f
#define AVX(name) _mm512_##name##_ps
#define MASK(name) _mm512_##name##_ps_mask
typedef int mask_element;
#else
typedef double real;
#define W 8
#define NAME polar_double
#define RINT(x) __builtin_rint(x)
#define TINY 1e-150
#define AVX(name) _mm512_##name##_pd
#define MASK(name) _mm512_##name##_pd_mask
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

typedef struct { real b0, b1, b2, a1, a2; } Section; /* b and a are those of powers of z - 1 */

static inline v all(real a) { return a - (v){}; }
#ifdef __AVX512DQ__
static inline v size(v a) { return AVX(andnot)(all(-0.0), a); }
static inline v larger_of(v a, v b) { return AVX(max)(a, b); }
static inline v larger_size(v a, v b) { return AVX(range)(a, b, 11); }
static inline v smaller_size(v a, v b) { return AVX(range)(a, b, 10); }
static inline v above(v a, v b, v yes, v no) { return AVX(mask_blend)(MASK(cmp)(a, b, _CMP_GT_OQ), no, yes); }
static inline v fraction(v a) { return AVX(reduce)(a, 8); }
#else
static inline v above(v a, v b, v yes, v no) {
    mask m = a > b;
    return (v)(((mask)yes & m) | ((mask)no & ~m));
}
static inline v size(v a) { return above(all(0), a, -a, a); }
static inline v larger_of(v a, v b) { return above(a, b, a, b); }
static inline v larger_size(v a, v b) { return larger_of(size(a), size(b)); }
static inline v smaller_size(v a, v b) { return above(size(b), size(a), size(a), size(b)); }
static inline v fraction(v a) {
    v r;
    for (int i = 0; i < W; i++) r[i] = a[i] - RINT(a[i]);
    return r;
}
#endif
static inline v with_sign(v a, v b) { return (v)((mask)a | ((mask)b & (mask)all(-0.0))); } /* of a >= 0 */

#ifdef SINGLE
static const real S[] = {POLY_S_SHORT}, C[] = {POLY_C_SHORT}, A[] = {POLY_A_SHORT}, R[] = {POLY_R_SHORT};
static const real O[] = {POLY_W_SHORT};
#else
static const real S[] = {POLY_S}, C[] = {POLY_C}, A[] = {POLY_A}, R[] = {POLY_R}, O[] = {POLY_W};
#endif
#define TERMS(x) ((int)(sizeof(x) / sizeof(*x)))

static inline v horner(const real *c, int terms, v u) {
    v p = all(c[terms - 1]);
    for (int i = terms - 2; i >= 0; i--) p = c[i] + u * p;
    return p;
}

static inline void unit(v turns, v *cosine, v *sine) {
    v x = fraction(turns), far = size(x), quarter = all(0.25);
    v folded = above(far, quarter, with_sign(all(0.5), x) - x, x), u = folded * folded;
    v c = horner(C, TERMS(C), u);
    *cosine = above(far, quarter, -c, c);
    *sine = folded * horner(S, TERMS(S), u);
}

static inline v cosine_of(v turns) {
    v x = fraction(turns);
    return horner(O, TERMS(O), x * x);
}

/* magnitude, and angle cut at 90 degrees */
static inline void polar(v im, v re, v *magnitude, v *angle) {
    const real eighth = 0.41421356237309503; /* tan(pi/8) */
    re += TINY;
    v larger = larger_size(im, re), smaller = smaller_size(im, re);
    v x = larger + eighth * smaller, t = (smaller - eighth * larger) / x, u = t * t;
    v p = (real)(M_PI / 8) + t * horner(A, TERMS(A), u);
    p = with_sign(above(larger, size(re), (real)M_PI_2 - p, p), im);
    *magnitude = x * horner(R, TERMS(R), u);
    *angle = above(all(0), re, -(real)M_PI - p, p);
}

static inline v low_pass(Section s, v *s1, v *s2, real gain, v x) {
    v y = gain * x + *s1, slow = 4 * gain * x + *s2;
    *s1 = *s1 + slow - s.a1 * y;
    *s2 = slow - s.a2 * y;
    return y;
}

/* y and drive: (samples, 2), double; filter and law: b0 b1 b2 a1 a2 in powers of z - 1, zeros at -1, law a pole at 1 */
void NAME(Tile *tiles, int count, double rate, const double *filter, const double *law,
          const double *y, double *drive, int samples) {
    Section section = {filter[0], filter[1], filter[2], filter[3], filter[4]};
    Section loop = {law[0], law[1], law[2], law[3], law[4]};
    const real turn = loop.b0 * (real)(0.5 / M_PI);
    v wish[BLOCK], re[2][BLOCK], im[2][BLOCK], sum[2][BLOCK];
    real gain[2][BLOCK];
    for (int start = 0; start < samples; start += BLOCK) {
        int block = samples - start < BLOCK ? samples - start : BLOCK;
        for (int m = 0; m < block; m++)
            for (int k = 0; k < 2; k++) sum[k][m] = (v){}, gain[k][m] = 2 * section.b0 * (real)y[2 * (start + m) + k];
        for (int t = 0; t < count; t++) {
            Tile *tile = &tiles[t];
            v c, s, turn_c, turn_s, angle, step, first, h_re = tile->heading_re, h_im = tile->heading_im;
            for (int i = 0; i < W; i++) { /* seeded anew each block, from double */
                double turns = tile->turns[i], advance = tile->frequency[i] / rate;
                first[i] = turns, step[i] = advance;
                turns += advance * block;
                tile->turns[i] = turns - floor(turns);
            }
            unit(first, &c, &s);
            unit(step, &turn_c, &turn_s);
            v seed = c * h_re - s * h_im;
            s = s * h_re + c * h_im, c = seed;
            polar(h_im, h_re, &seed, &angle);
            first += angle * (real)(0.5 / M_PI);
            v a1 = tile->channel[0].re1, a2 = tile->channel[0].re2;
            v b1 = tile->channel[0].im1, b2 = tile->channel[0].im2;
            v e1 = tile->channel[1].re1, e2 = tile->channel[1].re2;
            v f1 = tile->channel[1].im1, f2 = tile->channel[1].im2;
            for (int m = 0; m < block; m++) {
                wish[m] = first + (real)m * step;
                re[0][m] = low_pass(section, &a1, &a2, gain[0][m], c);
                im[0][m] = low_pass(section, &b1, &b2, -gain[0][m], s);
                re[1][m] = low_pass(section, &e1, &e2, gain[1][m], c);
                im[1][m] = low_pass(section, &f1, &f2, -gain[1][m], s);
                v next = c * turn_c - s * turn_s;
                s = s * turn_c + c * turn_s;
                c = next;
            }
            tile->channel[0].re1 = a1, tile->channel[0].re2 = a2, tile->channel[0].im1 = b1, tile->channel[0].im2 = b2;
            tile->channel[1].re1 = e1, tile->channel[1].re2 = e2, tile->channel[1].im1 = f1, tile->channel[1].im2 = f2;
            v amount = tile->amplitude;
            for (int k = 0; k < 2; k++)
                for (int m = 0; m < block; m++) {
                    v magnitude;
                    polar(im[k][m], re[k][m], &magnitude, &im[k][m]);
                    re[k][m] = amount - magnitude;
                }
            v state1[2], state2[2], theta1[2], theta2[2], strength[2];
            for (int k = 0; k < 2; k++) {
                state1[k] = tile->channel[k].amplitude1, state2[k] = tile->channel[k].amplitude2;
                theta1[k] = tile->channel[k].theta1, theta2[k] = tile->channel[k].theta2;
                strength[k] = loop.b0 * tile->channel[k].drive;
            }
            for (int m = 0; m < block; m++)
                for (int k = 0; k < 2; k++) {
                    v error = re[k][m], lag = im[k][m], free = error + state1[k], slow = 4 * error + state2[k];
                    v command = larger_of(free, all(0)), held = command - free;
                    state1[k] = 2 * held + (state1[k] + slow - loop.a1 * command);
                    state2[k] = slow + held;
                    v theta = lag + theta1[k], drift = 4 * lag + theta2[k];
                    theta1[k] = theta1[k] + drift - loop.a1 * theta;
                    theta2[k] = drift;
                    sum[k][m] += strength[k] * command * cosine_of(wish[m] - turn * theta);
                }
            for (int k = 0; k < 2; k++) {
                tile->channel[k].amplitude1 = state1[k], tile->channel[k].amplitude2 = state2[k];
                tile->channel[k].theta1 = theta1[k], tile->channel[k].theta2 = theta2[k];
            }
        }
        for (int m = 0; m < block; m++)
            for (int k = 0; k < 2; k++) {
                double total = 0.0;
                for (int i = 0; i < W; i++) total += sum[k][m][i];
                drive[2 * (start + m) + k] = total;
            }
    }
}
