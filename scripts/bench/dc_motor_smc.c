/* The loop of dc_motor_smc by hand: exact steps of the motor under the sliding mode law, as one would write it in C.
   c: Kt, counts a rad, wd_i, wd_w, c, K/gain, w gain, wd gain, delta, reference, load, then the 12 numbers of a step.
   rows: six numbers a tick, or NULL. Returns the speed at the end. */
#include <math.h>

double loop(long ticks, const double *c, double *rows)
{
    const double *a = c + 11;
    double theta = 0.0, w = 0.0, i = 0.0, r = c[9], load = c[10];
    for (long k = 0; k < ticks; k++) {
        double wd = c[2] * i - c[3] * w;
        double s = c[4] * (r - w) - wd;
        double u = c[6] * w + c[7] * wd + c[5] * (s != 0.0 ? s / (fabs(s) + c[8]) : 0.0);
        if (rows) {
            double *row = rows + 6 * k;
            row[0] = theta, row[1] = w, row[2] = c[0] * i, row[3] = floor(theta * c[1]), row[4] = i, row[5] = u;
        }
        theta += a[0] * w + a[1] * i + a[2] * u + a[9] * load;
        double next = a[3] * w + a[4] * i + a[5] * u + a[10] * load;
        i = a[6] * w + a[7] * i + a[8] * u + a[11] * load;
        w = next;
    }
    return w;
}
