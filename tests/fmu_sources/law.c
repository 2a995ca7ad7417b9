/* A sampled PI law with a limit, in the order of a period: error, command, integrator. */
enum { setpoint, speed, command, kp, ki, limit, z, enabled, N };
static const double initial[N] = {0, 0, 0, 2, 10, 12, 0, 1};
enum { NX = 0, NZ = 0 };

static void derivatives(const double *r, double *dx) {}
static void indicators(const double *r, double *q) {}
static void event(double *r) {}
static void outputs(double *r) {}

static int step(double *r, double t, double h) {
    double error = r[setpoint] - r[speed], u = r[kp] * error + r[z];
    r[command] = !r[enabled] ? 0 : u > r[limit] ? r[limit] : u < -r[limit] ? -r[limit] : u;
    if (u == r[command]) r[z] += r[ki] * error * h;
    return 0;
}
