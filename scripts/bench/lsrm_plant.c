/* The linear motor's plant by hand, held voltages in, no load and no fault: Runge-Kutta of order 4, five steps a period.
   g: tau, shift, G, L_u, c, h, w; c: limit, R, M, damping, step, steps. u: four voltages a tick. rows: flux linkages,
   position and speed after each. */
#define _GNU_SOURCE
#include <math.h>

static double tau, shift, G, L_u, centre, half, w, two_w, flat, arc, half_G;

static inline void phase(double flux, double x, int k, double turn, double *i, double *f)
{
    *i = *f = 0.0;
    if (!(flux > 0.0))
        return;
    double z = x - k * shift, xi = z - turn, area, slope, sine, cosine;
    if (!(fabs(xi) < 0.499 * tau))
        xi = z - tau * floor(z / tau + 0.5);
    double offset = centre - fabs(xi), d = fabs(offset);
    z = d - half + w;
    if (z <= 0.0) {
        area = d, slope = G;
    } else if (z < two_w) {
        sincos(M_PI * z / two_w, &sine, &cosine);
        area = flat + 0.5 * (z + arc * sine), slope = half_G * (1.0 + cosine);
    } else {
        area = half, slope = 0.0;
    }
    *i = flux / (L_u + G * (half + copysign(area, offset)));
    *f = 0.5 * (xi <= 0.0 ? slope : -slope) * *i * *i;
}

void loop(long ticks, const double *g, const double *c, const double *u, double *rows)
{
    tau = g[0], shift = g[1], G = g[2], L_u = g[3], centre = g[4], half = g[5], w = g[6];
    two_w = 2.0 * w, flat = half - w, arc = 2.0 * w / M_PI, half_G = G * 0.5;
    double psi[4] = {0.0}, x = 0.0, v = 0.0, h = c[4];
    for (long n = 0; n < ticks; n++, u += 4, rows += 6) {
        double turn[4];
        for (int k = 0; k < 4; k++)
            turn[k] = tau * floor((x - k * shift) / tau + 0.5);
        for (int s = 0; s < (int)c[5]; s++) {
            double rate[4] = {0.0}, sum[4] = {0.0}, x_rate = 0.0, v_rate = 0.0, x_sum = 0.0, v_sum = 0.0;
            for (int stage = 0; stage < 4; stage++) {
                double ahead = stage == 0 ? 0.0 : stage == 3 ? h : 0.5 * h, weight = stage % 3 ? 2.0 : 1.0;
                double at = x + ahead * x_rate, pull = 0.0, i, f;
                x_rate = v + ahead * v_rate;
                for (int k = 0; k < 4; k++) {
                    double flux = psi[k] + ahead * rate[k];
                    phase(flux, at, k, turn[k], &i, &f);
                    pull += f;
                    rate[k] = u[k] - c[1] * i;
                    if (!(flux > 0.0 || rate[k] > 0.0))
                        rate[k] = 0.0;
                    sum[k] += weight * rate[k];
                }
                v_rate = (pull - c[3] * x_rate) / c[2];
                x_sum += weight * x_rate;
                v_sum += weight * v_rate;
            }
            for (int k = 0; k < 4; k++) {
                psi[k] += h / 6.0 * sum[k];
                if (psi[k] < 0.0)
                    psi[k] = 0.0;
            }
            x += h / 6.0 * x_sum;
            v += h / 6.0 * v_sum;
        }
        for (int k = 0; k < 4; k++)
            rows[k] = psi[k];
        rows[4] = x, rows[5] = v;
    }
}
