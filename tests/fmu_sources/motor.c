/* A brushed DC motor, stepped exactly: x+ = exp(A h) x + ..., from the Taylor series of [[A, B], [0, 0]] h. */
#include <math.h>
#include <string.h>
enum { theta, w, i, voltage, R, L, J, b, Kt, Ke, torque, fault, N };
static const double initial[N] = {0, 0, 0, 0, R_, L_, J_, b_, Kt_, Ke_, 0, 0};
enum { NX = 3, NZ = 0 };

static void derivatives(const double *r, double *dx) {
    dx[0] = r[w];
    dx[1] = (r[Kt] * r[i] - r[b] * r[w]) / r[J];
    dx[2] = (r[voltage] - r[R] * r[i] - r[Ke] * r[w]) / r[L];
}
static void indicators(const double *r, double *z) {}
static void event(double *r) {}
static void outputs(double *r) { r[torque] = r[Kt] * r[i]; }

static int step(double *r, double t, double h) {
    double a[4][4] = {{0, 1, 0, 0},
                      {0, -r[b] / r[J], r[Kt] / r[J], 0},
                      {0, -r[Ke] / r[L], -r[R] / r[L], 1 / r[L]},
                      {0, 0, 0, 0}};
    double x[4] = {r[theta], r[w], r[i], r[voltage]};
    int pieces = 1 + (int)(h * fabs(a[2][2]) * 4); /* each with a norm well below one */
    if (r[fault] && t >= 0.5) {
        if (r[fault] == 1) *(volatile int *)0 = 1;
        if (r[fault] == 2) return 2;
        if (r[fault] == 3) r[voltage] = NAN, x[3] = NAN;
        if (r[fault] == 4) for (;;) ;
        if (r[fault] == 5) return 3;
    }
    for (int p = 0; p < pieces; p++) {
        double term[4], sum[4];
        memcpy(term, x, sizeof x);
        memcpy(sum, x, sizeof x);
        for (int k = 1; k < 30; k++) {
            double next[4];
            for (int m = 0; m < 4; m++) {
                next[m] = 0;
                for (int n = 0; n < 4; n++) next[m] += a[m][n] * term[n];
                next[m] *= h / pieces / k;
            }
            memcpy(term, next, sizeof next);
            for (int m = 0; m < 4; m++) sum[m] += term[m];
        }
        memcpy(x, sum, sizeof x);
    }
    r[theta] = x[0], r[w] = x[1], r[i] = x[2];
    return 0;
}
