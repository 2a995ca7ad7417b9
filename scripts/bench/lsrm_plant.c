/* The linear motor's plant by hand, held voltages in, no load and no fault: Runge-Kutta of order 4, five steps a period.
   LANES such runs go side by side in one loop, a stage of one after that of another, so that the processor may overlap
   what does not wait for one another. g: tau, shift, G, L_u, c, h, w; c: limit, R, M, damping, step, steps.
   u: four voltages a tick. rows: flux linkages, position and speed after each, run beside run. */
#define _GNU_SOURCE
#include <math.h>

#ifndef LANES
#define LANES 1
#endif
#define EACH for (struct lane *l = lanes; l < lanes + LANES; l++)

static double tau, shift, G, L_u, centre, half, w, two_w, flat, arc, half_G, R, M, damping;

struct lane {
    double psi[4], x, v, turn[4], rate[4], sum[4], x_rate, v_rate, x_sum, v_sum;
    int on[4]; /* the others stay without current */
};

static inline __attribute__((always_inline)) void charged(double flux, double u, double x, double turn, double *rate,
                                                          double *pull)
{
    double xi = x - turn, area, slope, sine, cosine;
    if (!(flux > 0.0)) {
        *rate = u > 0.0 ? u : 0.0;
        return;
    }
    if (!(fabs(xi) < 0.499 * tau))
        xi = x - tau * floor(x / tau + 0.5);
    double offset = centre - fabs(xi), d = fabs(offset), z = d - half + w;
    if (z <= 0.0) {
        area = d, slope = G;
    } else if (z < two_w) {
        sincos(M_PI * z / two_w, &sine, &cosine);
        area = flat + 0.5 * (z + arc * sine), slope = half_G * (1.0 + cosine);
    } else {
        area = half, slope = 0.0;
    }
    double i = flux / (L_u + G * (half + copysign(area, offset)));
    *pull += 0.5 * (xi <= 0.0 ? slope : -slope) * i * i;
    *rate = u - R * i;
}

static inline __attribute__((always_inline)) void stage(struct lane *l, const double *u, double ahead, double weight)
{
    double at = l->x + ahead * l->x_rate, pull = 0.0;
    l->x_rate = l->v + ahead * l->v_rate;
#pragma GCC unroll 4
    for (int k = 0; k < 4; k++)
        if (l->on[k]) {
            charged(l->psi[k] + ahead * l->rate[k], u[k], at - k * shift, l->turn[k], &l->rate[k], &pull);
            l->sum[k] += weight * l->rate[k];
        }
    l->v_rate = (pull - damping * l->x_rate) / M;
    l->x_sum += weight * l->x_rate;
    l->v_sum += weight * l->v_rate;
}

void loop(long ticks, const double *g, const double *c, const double *u, double *rows)
{
    tau = g[0], shift = g[1], G = g[2], L_u = g[3], centre = g[4], half = g[5], w = g[6];
    two_w = 2.0 * w, flat = half - w, arc = 2.0 * w / M_PI, half_G = G * 0.5;
    R = c[1], M = c[2], damping = c[3];
    struct lane lanes[LANES] = {0};
    double h = c[4], sixth = h / 6.0;
    for (long n = 0; n < ticks; n++, u += 4) {
        EACH for (int k = 0; k < 4; k++) {
            l->turn[k] = tau * floor((l->x - k * shift) / tau + 0.5);
            l->on[k] = l->psi[k] > 0.0 || u[k] > 0.0;
        }
        for (int s = 0; s < (int)c[5]; s++) {
            EACH {
                for (int k = 0; k < 4; k++)
                    l->rate[k] = l->sum[k] = 0.0;
                l->x_rate = l->v_rate = l->x_sum = l->v_sum = 0.0;
            }
            EACH stage(l, u, 0.0, 1.0);
            EACH stage(l, u, 0.5 * h, 2.0);
            EACH stage(l, u, 0.5 * h, 2.0);
            EACH stage(l, u, h, 1.0);
            EACH {
                for (int k = 0; k < 4; k++)
                    l->psi[k] = fmax(l->psi[k] + sixth * l->sum[k], 0.0);
                l->x += sixth * l->x_sum;
                l->v += sixth * l->v_sum;
            }
        }
        EACH {
            for (int k = 0; k < 4; k++)
                *rows++ = l->psi[k];
            *rows++ = l->x, *rows++ = l->v;
        }
    }
}
