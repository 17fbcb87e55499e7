/* The default method in blocks, tuned by hand: the same arithmetic on arrays of its own, for fixed carriers,
 * two coordinates, two channels, and a controller in quiet that no finger touches.  The rows R_* come
 * from native/__init__.py (-D). */
#include <math.h>

typedef double v __attribute__((vector_size(64)));
typedef double v_anywhere __attribute__((vector_size(64), aligned(8)));
typedef long mask __attribute__((vector_size(64)));
#define W 8
#define MOST 64 /* samples of a block */
#define MIN(a, b) ((a) < (b) ? (a) : (b))

typedef struct {
    double rate, block_rate, g, dc, dc_drift, lead, integral, back, leak, ramp;
    double fast_smoothing, slow_smoothing, fast_threshold, slow_threshold, limit, sensed_limit, step;
    double listen[2][2], speak[2][2], pattern[2], rounding[2][2];
} Numbers;

static const double S[] = {POLY_S}, C[] = {POLY_C};

static inline v pick(mask m, v a, v b) { return (v)(((mask)a & m) | ((mask)b & ~m)); }
static inline v least(v a, double b) { return pick(a < b, a, b - (v){}); }
static inline v most(v a, double b) { return pick(a > b, a, b - (v){}); }

static inline double total(v a) {
    double sum = 0;
    for (int i = 0; i < W; i++) sum += a[i];
    return sum;
}

static inline void unit(v turns, v *cosine, v *sine) {
    v x;
    for (int i = 0; i < 8; i++) x[i] = turns[i] - __builtin_rint(turns[i]);
    mask up = x > 0.25, down = x < -0.25, far = up | down;
    v y = (v)(((mask)(0.5 - x) & up) | ((mask)(-0.5 - x) & down) | ((mask)x & ~far));
    v u = y * y, u2 = u * u;
    v s = (S[0] + S[1] * u) + (S[2] + S[3] * u) * u2 + ((S[4] + S[5] * u) + (S[6] + S[7] * u) * u2) * (u2 * u2);
    v c = (C[0] + C[1] * u) + (C[2] + C[3] * u) * u2 + ((C[4] + C[5] * u) + (C[6] + C[7] * u) * u2) * (u2 * u2);
    *cosine = (v)(((mask)-c & far) | ((mask)c & ~far));
    *sine = s * y;
}

#define TURN(re, im) { v turned = re * turn - im * on; im = re * on + im * turn; re = turned; }

void block_run(v *bands, v *loops, v *laws, v *helds, v *phases, const v *tables, const double *inverse, double *level,
          Numbers *n, int tiles, int block, const double *sensed, double *drive, int blocks) {
    const double period = 1 / n->block_rate;
    for (int b = 0; b < blocks; b++, sensed += 2 * block, drive += 2 * block) {
        double raw[2][MOST], error[2][MOST];
        double folded[2][MOST];
        v sum[MOST][2], heard_fast = {}, heard_slow = {};
        for (int t = 0; t < tiles; t++) { /* carriers, targets, and what is expected of the block */
            v *band = bands + R_BAND_ROWS * t, *held = helds + R_HELD_ROWS * t;
            const v *loop = loops + 2 * R_LOOP_ROWS * t;
            v *phase = phases + R_PHASE_ROWS * t;
            unit(phase[R_TURNS] + phase[R_TO_MIDDLE], &band[R_COS], &band[R_SIN]);
            for (int i = 0; i < W; i++) {
                double turns = phase[R_TURNS][i] + phase[R_TURNED][i];
                phase[R_TURNS][i] = turns - __builtin_floor(turns);
            }
            v live = band[R_LIVE], c = live * band[R_COS], s = live * band[R_SIN];
            v ramp = least(band[R_RAMP] + n->ramp, 1), weight = live * ramp * ramp * (3 - 2 * ramp);
            v re = weight * band[R_WANTED_RE], im = weight * band[R_WANTED_IM];
            band[R_COS] = c, band[R_SIN] = s, band[R_RAMP] = ramp, band[R_WEIGHT] = weight, band[R_SHARE] = live;
            band[R_DR_RE] = n->block_rate * (re - band[R_R_RE]);
            band[R_DR_IM] = n->block_rate * (im - band[R_R_IM]);
            band[R_SEEN_RE] = 0.5 * (re + band[R_R_RE]), band[R_SEEN_IM] = 0.5 * (im + band[R_R_IM]);
            band[R_R_RE] = re, band[R_R_IM] = im;
            for (int i = 0; i < 2; i++, loop += R_LOOP_ROWS) {
                v a = n->pattern[i] * band[R_SEEN_RE] + loop[R_E_RE];
                v z = n->pattern[i] * band[R_SEEN_IM] + loop[R_E_IM];
                held[2 * i] = a * c - z * s, held[2 * i + 1] = a * s + z * c;
            }
        }
        for (int m = 0; m < block; m++) sum[m][0] = sum[m][1] = (v){};
        for (int pair = 0; pair < tiles; pair += 2) {
            const v *table[2];
            v re[2], im[2], at[2], up[2];
            for (int k = 0; k < 2; k++) {
                int t = MIN(pair + k, tiles - 1);
                const v *held = helds + R_HELD_ROWS * t;
                double counts = pair + k < tiles;
                table[k] = tables + R_TABLE_ROWS * t;
                re[k] = counts * held[0], im[k] = counts * held[1], at[k] = counts * held[2], up[k] = counts * held[3];
            }
            for (int q = 0; q < block; q += R_GROUP) {
                for (int i = 0; i < R_PAIRS; i++) {
                    v *early = sum[q + R_PAIRS - 1 - i], *late = sum[q + R_PAIRS + i];
                    v c = table[0][4 * i], s = table[0][4 * i + 1], c2 = table[1][4 * i], s2 = table[1][4 * i + 1];
                    early[0] = early[0] + re[0] * c + re[1] * c2, late[0] = late[0] - im[0] * s - im[1] * s2;
                    early[1] = early[1] + at[0] * c + at[1] * c2, late[1] = late[1] - up[0] * s - up[1] * s2;
                }
                for (int k = 0; k < 2; k++) {
                    v turn = table[k][R_TURN_COS], on = table[k][R_TURN_SIN];
                    TURN(re[k], im[k])
                    TURN(at[k], up[k])
                }
            }
        }
        for (int c = 0; c < 2; c++) {
            for (int m = 0; m < block; m++) {
                double y = -level[c] - m * level[2 + c];
                for (int s = 0; s < 2; s++)
                    if (fabs(sensed[2 * m + s]) <= n->sensed_limit) y += n->listen[c][s] * sensed[2 * m + s];
                raw[c][m] = y;
            }
            for (int q = 0; q < block; q += R_GROUP)
                for (int i = 0; i < R_PAIRS; i++) {
                    int early = q + R_PAIRS - 1 - i, late = q + R_PAIRS + i;
                    double even = total(sum[early][c]), odd = total(sum[late][c]);
                    raw[c][early] -= even - odd, raw[c][late] -= even + odd;
                }
            for (int m = 0; m < block; m += 8) {
                v found[4] = {};
                for (int j = 0; j < m + 8; j += 4)
                    for (int i = 0; i < 4; i++) found[i] += raw[c][j + i] * *(v_anywhere *)(inverse + block + m - j - i);
                *(v_anywhere *)(error[c] + m) = (found[0] + found[1]) + (found[2] + found[3]);
            }
            double gained = 0, steeper = 0;
            for (int m = 0; m < block; m++) {
                gained += (n->dc + (block - 1 - m) * n->dc_drift) * error[c][m];
                steeper += n->dc_drift * error[c][m];
            }
            level[c] += block * level[2 + c] + gained;
            level[2 + c] += steeper;
            for (int q = 0; q < block; q += R_GROUP)
                for (int i = 0; i < R_PAIRS; i++) {
                    int early = q + R_PAIRS - 1 - i, late = q + R_PAIRS + i;
                    folded[c][early] = error[c][late] + error[c][early];
                    folded[c][late] = error[c][late] - error[c][early];
                }
        }
        for (int t = 0; t < tiles; t++) { /* what the residuals have in common with the carriers; loop; law */
            v *band = bands + R_BAND_ROWS * t, *held = helds + R_HELD_ROWS * t, *loop = loops + 2 * R_LOOP_ROWS * t;
            const v *table = tables + R_TABLE_ROWS * t, *law = laws + R_LAW_TILE_ROWS * t;
            v turn = table[R_TURN_COS], on = -table[R_TURN_SIN], a[4] = {}, cosine = band[R_COS], sine = band[R_SIN];
            for (int q = block - R_GROUP; q >= 0; q -= R_GROUP) {
                v even[2] = {}, odd[2] = {};
                for (int i = 0; i < R_PAIRS; i++)
                    for (int c = 0; c < 2; c++) {
                        even[c] += folded[c][q + R_PAIRS - 1 - i] * table[4 * i];
                        odd[c] += folded[c][q + R_PAIRS + i] * table[4 * i + 1];
                    }
                TURN(a[0], a[1])
                TURN(a[2], a[3])
                a[0] += even[0], a[1] -= odd[0], a[2] += even[1], a[3] -= odd[1];
            }
            v share = band[R_SHARE], fading = n->leak * (1 - share);
            for (int c = 0; c < 2; c++) {
                v *own = loop + R_LOOP_ROWS * c, fast2 = {}, slow2 = {};
                v found[2] = {a[2 * c] * cosine + a[2 * c + 1] * sine, a[2 * c + 1] * cosine - a[2 * c] * sine};
                for (int r = 0; r < 2; r++) {
                    v e = own[R_E_RE + r], x = own[R_V_RE + r], wanted = n->pattern[c] * band[R_R_RE + r];
                    v heard = e - x + (2.0 / block) * found[r];
                    e = (1 - period * fading) * e + share * n->g * found[r];
                    v slope = -n->integral * e - n->back * (x + wanted) - fading * x;
                    v steeper = n->pattern[c] * band[R_DR_RE + r];
                    x += period * slope;
                    own[R_E_RE + r] = e, own[R_V_RE + r] = x;
                    own[R_COMMAND_RE + r] = x + wanted + n->lead * steeper;
                    own[R_SLOPED_RE + r] = slope + steeper;
                    own[R_FAST_RE + r] += n->fast_smoothing * (heard - own[R_FAST_RE + r]);
                    own[R_SLOW_RE + r] += n->slow_smoothing * (own[R_FAST_RE + r] - own[R_SLOW_RE + r]);
                    fast2 += own[R_FAST_RE + r] * own[R_FAST_RE + r], slow2 += own[R_SLOW_RE + r] * own[R_SLOW_RE + r];
                }
                heard_fast += most(fast2 - n->fast_threshold, 0), heard_slow += most(slow2 - n->slow_threshold, 0);
            }
            for (int channel = 0; channel < 2; channel++, held += R_CHANNEL_ROWS) {
                v re = {}, im = {}, *now = held + 4;
                for (int c = 0; c < 2; c++)
                    for (int i = 0; i < 2; i++) {
                        const v *own = loop + R_LOOP_ROWS * i, *d = law + R_FIRST_LAW + R_LAW_ROWS * (2 * c + i);
                        v x = own[R_COMMAND_RE], y = own[R_COMMAND_IM], dx = own[R_SLOPED_RE], dy = own[R_SLOPED_IM];
                        re += n->speak[channel][c] * (d[0] * x - d[1] * y + d[2] * dx - d[3] * dy);
                        im += n->speak[channel][c] * (d[0] * y + d[1] * x + d[2] * dy + d[3] * dx);
                    }
                v last_re = now[R_NOW_RE], last_im = now[R_NOW_IM], step_re = re - last_re, step_im = im - last_im;
                now[R_NOW_RE] = re, now[R_NOW_IM] = im;
                now[R_FROM_RE] = last_re * cosine - last_im * sine, now[R_FROM_IM] = last_re * sine + last_im * cosine;
                now[R_STEP_RE] = step_re * cosine - step_im * sine, now[R_STEP_IM] = step_re * sine + step_im * cosine;
            }
        }
        for (int m = 0; m < block; m++) sum[m][0] = sum[m][1] = (v){};
        for (int t = 0; t < tiles; t++) {
            const v *held = helds + R_HELD_ROWS * t + 4, *table = tables + R_TABLE_ROWS * t;
            v turn = table[R_TURN_COS], on = table[R_TURN_SIN];
            v re[2], im[2], step_re[2], step_im[2];
            for (int c = 0; c < 2; c++, held += R_CHANNEL_ROWS) {
                re[c] = held[R_FROM_RE], im[c] = held[R_FROM_IM], step_re[c] = held[R_STEP_RE], step_im[c] = held[R_STEP_IM];
            }
            double ahead = (R_PAIRS + 0.5) / block;
            for (int q = 0; q < block; q += R_GROUP) {
                for (int c = 0; c < 2; c++) re[c] += ahead * step_re[c], im[c] += ahead * step_im[c];
                for (int i = 0; i < R_PAIRS; i++)
                    for (int c = 0; c < 2; c++) {
                        v *early = &sum[q + R_PAIRS - 1 - i][c], *late = &sum[q + R_PAIRS + i][c];
                        *early = *early + re[c] * table[4 * i] - step_im[c] * table[4 * i + 3];
                        *late = *late + step_re[c] * table[4 * i + 2] - im[c] * table[4 * i + 1];
                    }
                for (int c = 0; c < 2; c++) {
                    TURN(re[c], im[c])
                    TURN(step_re[c], step_im[c])
                }
                ahead = (double)R_GROUP / block;
            }
        }
        for (int c = 0; c < 2; c++)
            for (int q = 0; q < block; q += R_GROUP)
                for (int i = 0; i < R_PAIRS; i++) {
                    int early = q + R_PAIRS - 1 - i, late = q + R_PAIRS + i;
                    double even = total(sum[early][c]), odd = total(sum[late][c]);
                    drive[2 * early + c] = even - odd, drive[2 * late + c] = even + odd;
                }
        for (int m = 0; m < block; m++)
            for (int c = 0; c < 2; c++) {
                double shaped = (drive[2 * m + c] - n->rounding[1][c]) + 2 * n->rounding[0][c];
                double exact = n->step * __builtin_floor(shaped * (1 / n->step) + 0.5), off = shaped - exact;
                n->rounding[1][c] = n->rounding[0][c];
                n->rounding[0][c] = off < -n->step ? -n->step : off > n->step ? n->step : off;
                drive[2 * m + c] = exact < -n->limit ? -n->limit : exact > n->limit ? n->limit : exact;
            }
        if (total(heard_fast) + total(heard_slow) > 0) return; /* no longer quiet: leave the rest as it is */
    }
}
