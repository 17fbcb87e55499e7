/* The paper's controller as one would first write it: a struct a band, libm for sine, cosine and angle, double. */
#include <complex.h>
#include <math.h>

typedef struct {
    double frequency, turns, amplitude, phasor_re, phasor_im;
    struct { double drive, re1, re2, im1, im2, amplitude1, amplitude2, theta1, theta2; } channel[2];
} Band;

static double section(const double *s, double *s1, double *s2, double x) {
    double y = s[0] * x + *s1;
    *s1 = s[1] * x - s[3] * y + *s2;
    *s2 = s[2] * x - s[4] * y;
    return y;
}

/* y and drive: (samples, 2); filter and law: b0 b1 b2 a1 a2 */
void naive_run(Band *bands, int count, double rate, const double *filter, const double *law,
               const double *y, double *drive, int samples) {
    for (int n = 0; n < samples; n++) {
        drive[2 * n] = drive[2 * n + 1] = 0.0;
        for (int k = 0; k < count; k++) {
            Band *band = &bands[k];
            double complex carrier = cexp(2.0 * M_PI * I * band->turns);
            band->turns += band->frequency / rate;
            band->turns -= floor(band->turns);
            for (int c = 0; c < 2; c++) {
                double complex u = 2.0 * y[2 * n + c] * conj(carrier);
                double re = section(filter, &band->channel[c].re1, &band->channel[c].re2, creal(u));
                double im = section(filter, &band->channel[c].im1, &band->channel[c].im2, cimag(u));
                double lag = atan2(im * band->phasor_re - re * band->phasor_im,
                                   re * band->phasor_re + im * band->phasor_im);
                if (lag > M_PI / 2) lag -= 2.0 * M_PI;
                double theta = section(law, &band->channel[c].theta1, &band->channel[c].theta2, -lag);
                double error = band->amplitude - sqrt(re * re + im * im);
                double command = fmax(law[0] * error + band->channel[c].amplitude1, 0.0);
                band->channel[c].amplitude1 = law[1] * error - law[3] * command + band->channel[c].amplitude2;
                band->channel[c].amplitude2 = law[2] * error - law[4] * command;
                double complex phasor = (band->phasor_re + I * band->phasor_im) * cexp(I * theta);
                drive[2 * n + c] += command * band->channel[c].drive * creal(phasor * carrier);
            }
        }
    }
}
