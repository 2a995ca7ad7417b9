/* The loop of induction_dtc by hand: converters with a random bit, direct torque control, speed control every 20th tick,
   one Runge-Kutta step of the machine; as one would write it in C.
   c: the numbers of `_drive_constants` in native.py, in their order. draws: random numbers in rows of 4096 a channel.
   rows: 20 numbers a tick, slow: 3 numbers every 20th tick; or NULL. Returns the speed at the end. */
#include <math.h>

enum { R_S, R_R, INV_L, R_BY_L, P, INV_J, B, H, Q, SHIFT, P_D, U_DC, RISE, KP, KI_TS, LIMIT, U_MAX, HALF_R_S, RAMP,
       FLUX, BAND, TORQUE_BAND, TARGET, TARGET_AT, LOAD, LOAD_AT, MAGNETISED, TRIP, VECTORS };

static double convert(const double *c, double i, double draw)
{
    double code = floor(i / c[Q] + c[SHIFT]);
    code = code < -512.0 ? -512.0 : code > 511.0 ? 511.0 : code;
    return (code + (draw < c[P_D] ? 1.0 : 0.0)) * c[Q];
}

static double torque(const double *c, double sa, double sb, double ia, double ib)
{
    return 1.5 * c[P] * (sa * ib - sb * ia);
}

static void slope(const double *c, const double *x, double ua, double ub, double load, double *d)
{
    double ia = (x[0] - x[2]) * c[INV_L], ib = (x[1] - x[3]) * c[INV_L];
    d[0] = ua - c[R_S] * ia;
    d[1] = ub - c[R_S] * ib;
    d[2] = c[R_R] * ia - c[R_BY_L] * x[2] - c[P] * x[4] * x[3];
    d[3] = c[R_R] * ib - c[R_BY_L] * x[3] + c[P] * x[4] * x[2];
    d[4] = (torque(c, x[0], x[1], ia, ib) - load - c[B] * x[4]) * c[INV_J];
    d[5] = x[4];
}

static int sector(double alpha, double beta)
{
    beta *= 1.7320508075688772;
    if (alpha > 0.0)
        return beta < -alpha ? 5 : beta < alpha ? 0 : 1;
    return beta > -alpha ? 2 : beta > alpha ? 3 : alpha < 0.0 ? 4 : 5;
}

double loop(long ticks, const double *c, const double *draws, double *rows, double *slow)
{
    static const int table[2][3][6] = {{{7, 0, 7, 0, 7, 0}, {3, 4, 5, 6, 1, 2}, {5, 6, 1, 2, 3, 4}},
                                       {{0, 7, 0, 7, 0, 7}, {2, 3, 4, 5, 6, 1}, {6, 1, 2, 3, 4, 5}}};
    const double *legs = c + VECTORS, *unit = legs + 24; /* legs of the 8 vectors, then their voltages as parts of U_dc */
    double x[6] = {0}, psi_a = 0.0, psi_b = 0.0, last_a = 0.0, last_b = 0.0, integral = 0.0, reference = 0.0;
    double asked = 0.0, load = 0.0, period = floor(c[H] * 1e9 + 0.5);
    int vector = 0, increase = 1, more = 0, clipped_a = 0, clipped_b = 0, fault = 0;
    for (long k = 0; k < ticks; k++) {
        double t = k * period / 1e9; /* s, as the nearest number to whole ns */
        double ia = (x[0] - x[2]) * c[INV_L], ib = (x[1] - x[3]) * c[INV_L], T = torque(c, x[0], x[1], ia, ib);
        double b = -0.5 * ia + 0.8660254037844386 * ib, cc = 0.0 - ia - b;
        const double *bits = draws + 2 * (k / 4096) * 4096 + k % 4096;
        double ya = convert(c, ia, bits[0]), yb = convert(c, b, bits[4096]);
        if (k % 20 == 0) {
            double target = t >= c[TARGET_AT] ? c[TARGET] : 0.0, step = target - reference;
            reference += step < -c[RISE] ? -c[RISE] : step > c[RISE] ? c[RISE] : step;
            double error = reference - x[4], u = c[KP] * error + integral;
            if (fabs(u) <= c[LIMIT] || u * error <= 0.0)
                integral += c[KI_TS] * error;
            asked = u < -c[U_MAX] ? -c[U_MAX] : u > c[U_MAX] ? c[U_MAX] : u;
            load = t >= c[LOAD_AT] ? c[LOAD] : 0.0;
            if (slow)
                slow[k / 20 * 3] = target, slow[k / 20 * 3 + 1] = asked, slow[k / 20 * 3 + 2] = load;
        }
        double now_a = ya, now_b = (ya + 2.0 * yb) / 1.7320508075688772;
        if (k) {
            psi_a += c[H] * (unit[2 * vector] * c[U_DC] - c[HALF_R_S] * (last_a + now_a));
            psi_b += c[H] * (unit[2 * vector + 1] * c[U_DC] - c[HALF_R_S] * (last_b + now_b));
        }
        last_a = now_a, last_b = now_b;
        double found = 1.5 * c[P] * (psi_a * now_b - psi_b * now_a), size = sqrt(psi_a * psi_a + psi_b * psi_b);
        if (t < c[MAGNETISED]) {
            double part = t / c[RAMP], error = (part < 1.0 ? part : 1.0) * c[FLUX] - size;
            increase = error > c[BAND] ? 1 : error < -c[BAND] ? 0 : increase;
            vector = increase;
        } else {
            double error = c[FLUX] - size, wanted = asked - found;
            increase = error > c[BAND] ? 1 : error < -c[BAND] ? 0 : increase;
            more = wanted > c[TORQUE_BAND] ? 1 : wanted < -c[TORQUE_BAND] ? -1 : more * wanted <= 0.0 ? 0 : more;
            vector = table[increase][more < 0 ? 2 : more][sector(psi_a, psi_b)];
        }
        if (rows) {
            double *row = rows + 20 * k;
            row[0] = x[5], row[1] = x[4], row[2] = T, row[3] = ia, row[4] = b, row[5] = cc, row[6] = ya, row[7] = yb;
            row[8] = -ya - yb, row[9] = x[0], row[10] = x[1], row[11] = 0.0, row[12] = c[U_DC];
            row[13] = legs[3 * vector], row[14] = legs[3 * vector + 1], row[15] = legs[3 * vector + 2];
            row[16] = psi_a, row[17] = psi_b, row[18] = 0.0, row[19] = found;
        }
        double ua = fault ? 0.0 : unit[2 * vector] * c[U_DC], ub = fault ? 0.0 : unit[2 * vector + 1] * c[U_DC];
        double k1[6], k2[6], k3[6], k4[6], y[6];
        slope(c, x, ua, ub, load, k1);
        for (int j = 0; j < 6; j++)
            y[j] = x[j] + 0.5 * c[H] * k1[j];
        slope(c, y, ua, ub, load, k2);
        for (int j = 0; j < 6; j++)
            y[j] = x[j] + 0.5 * c[H] * k2[j];
        slope(c, y, ua, ub, load, k3);
        for (int j = 0; j < 6; j++)
            y[j] = x[j] + c[H] * k3[j];
        slope(c, y, ua, ub, load, k4);
        for (int j = 0; j < 6; j++)
            x[j] += c[H] / 6.0 * (k1[j] + 2.0 * k2[j] + 2.0 * k3[j] + k4[j]);
        ia = (x[0] - x[2]) * c[INV_L], ib = (x[1] - x[3]) * c[INV_L];
        b = -0.5 * ia + 0.8660254037844386 * ib, cc = 0.0 - ia - b;
        double code_a = ia / c[Q] + c[SHIFT], code_b = b / c[Q] + c[SHIFT];
        clipped_a = code_a >= -512.0 && code_a < 512.0 ? 0 : clipped_a + 1;
        clipped_b = code_b >= -512.0 && code_b < 512.0 ? 0 : clipped_b + 1;
        if (clipped_a > 10 || clipped_b > 10)
            return NAN; /* it would report */
        fault = fault || !(fabs(ia) <= c[TRIP] && fabs(b) <= c[TRIP] && fabs(cc) <= c[TRIP]);
    }
    return x[4];
}
