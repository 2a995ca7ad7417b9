/* A bouncing ball: flights are parabolas, bounces are found in them exactly. */
#include <math.h>
enum { height, v, g, e, bounces, N };
static const double initial[N] = {1, 0, 9.81, 0.7, 0};
enum { NX = 2, NZ = 1 };

static void derivatives(const double *r, double *dx) {
    dx[0] = r[v];
    dx[1] = -r[g];
}
static void indicators(const double *r, double *z) { z[0] = r[height]; }
static void event(double *r) {
    if (r[height] <= 0 && r[v] < 0) r[height] = 0, r[v] *= -r[e], r[bounces] += 1;
}
static void outputs(double *r) {}

static int step(double *r, double t, double h) {
    for (;;) {
        double until = (r[v] + sqrt(r[v] * r[v] + 2 * r[g] * r[height])) / r[g];
        if (until > h || until < 1e-9) break;
        r[v] = -r[e] * (r[v] - r[g] * until);
        r[height] = 0;
        r[bounces] += 1;
        h -= until;
    }
    r[height] += h * (r[v] - r[g] * h / 2);
    r[v] -= r[g] * h;
    return 0;
}
