/* The linear motor's plant by hand, held voltages in, no load and no fault: Runge-Kutta of order 4, five steps a period.
   LANES such runs go side by side in one loop, so that the processor may overlap what does not wait for one another.
   g: tau, shift, G, L_u, c, h, w; c: limit, R, M, damping, step, steps. u: four voltages a tick. rows: flux linkages,
   position and speed after each, run beside run. */
#define _GNU_SOURCE
#include <math.h>

#ifndef LANES
#define LANES 1
#endif
#define EACH for (int l = 0; l < LANES; l++)

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
    double psi[LANES][4] = {0.0}, x[LANES] = {0.0}, v[LANES] = {0.0}, h = c[4];
    for (long n = 0; n < ticks; n++, u += 4, rows += 6 * LANES) {
        double turn[LANES][4];
        EACH for (int k = 0; k < 4; k++)
            turn[l][k] = tau * floor((x[l] - k * shift) / tau + 0.5);
        for (int s = 0; s < (int)c[5]; s++) {
            double rate[LANES][4] = {0.0}, sum[LANES][4] = {0.0}, at[LANES], pull[LANES];
            double x_rate[LANES] = {0.0}, v_rate[LANES] = {0.0}, x_sum[LANES] = {0.0}, v_sum[LANES] = {0.0};
            for (int stage = 0; stage < 4; stage++) {
                double ahead = stage == 0 ? 0.0 : stage == 3 ? h : 0.5 * h, weight = stage % 3 ? 2.0 : 1.0, i, f;
                EACH {
                    at[l] = x[l] + ahead * x_rate[l];
                    pull[l] = 0.0;
                    x_rate[l] = v[l] + ahead * v_rate[l];
                }
                for (int k = 0; k < 4; k++) EACH {
                    double flux = psi[l][k] + ahead * rate[l][k];
                    phase(flux, at[l], k, turn[l][k], &i, &f);
                    pull[l] += f;
                    rate[l][k] = u[k] - c[1] * i;
                    if (!(flux > 0.0 || rate[l][k] > 0.0))
                        rate[l][k] = 0.0;
                    sum[l][k] += weight * rate[l][k];
                }
                EACH {
                    v_rate[l] = (pull[l] - c[3] * x_rate[l]) / c[2];
                    x_sum[l] += weight * x_rate[l];
                    v_sum[l] += weight * v_rate[l];
                }
            }
            EACH {
                for (int k = 0; k < 4; k++) {
                    psi[l][k] += h / 6.0 * sum[l][k];
                    if (psi[l][k] < 0.0)
                        psi[l][k] = 0.0;
                }
                x[l] += h / 6.0 * x_sum[l];
                v[l] += h / 6.0 * v_sum[l];
            }
        }
        EACH {
            for (int k = 0; k < 4; k++)
                rows[6 * l + k] = psi[l][k];
            rows[6 * l + 4] = x[l], rows[6 * l + 5] = v[l];
        }
    }
}
