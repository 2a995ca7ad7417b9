/* Support of the C code that softrig exports: number type, Python's division, tables. C99, no dynamic memory.
 *
 * Compile with -ffp-contract=off: a fused multiply-add rounds once where the golden rows round twice.
 * Define SR_FLOAT for single precision.
 */
#ifndef SOFTRIG_C_H
#define SOFTRIG_C_H

#include <math.h>
#include <stdbool.h>
#include <stdint.h>

#ifdef SR_FLOAT
typedef float real_t;
#define SR_MATH(name) name##f
#else
typedef double real_t;
#define SR_MATH(name) name
#endif

#define SR_REAL(x) ((real_t)(x))
#define SR_NAN ((real_t)NAN)
#define SR_INFINITY ((real_t)INFINITY)
#define SR_DONE 0    /* the tick is answered */
#define SR_GAVE_UP 1 /* an error in Python: the state is as before the call, the outputs are the safe values */

#ifndef SR_TABLE /* constant tables; avr-gcc keeps `const` data in RAM unless it is told otherwise, in GNU C only */
#if defined(__AVR__) && !defined(__cplusplus) && !defined(__STRICT_ANSI__)
#define SR_TABLE const __flash
#else
#define SR_TABLE const
#endif
#endif

/* Conditions that are rarely and mostly true: the processor need not jump in the usual course of a tick. */
#ifdef __GNUC__
#define SR_RARELY(x) __builtin_expect((x), 0)
#define SR_MOSTLY(x) __builtin_expect((x), 1)
#else
#define SR_RARELY(x) (x)
#define SR_MOSTLY(x) (x)
#endif

static inline bool sr_isfinite(real_t x) { return (x - x) == SR_REAL(0); }
static inline bool sr_isnan(real_t x) { return x != x; }
static inline bool sr_isinf(real_t x) { return !sr_isnan(x) && !sr_isfinite(x); }

/* To a whole number; what has none is the smallest one, as on x86-64: C leaves it open, and processors differ. */
static inline int64_t sr_int(real_t x)
{
    return ((x > SR_REAL(-9.2e18)) && (x < SR_REAL(9.2e18))) ? (int64_t)x : INT64_MIN;
}

/* math.floor; quicker than floor() where a processor has no instruction for it. */
static inline int64_t sr_floor_int(real_t x)
{
    const int64_t i = sr_int(x);
    return ((i != INT64_MIN) && ((real_t)i > x)) ? (i - 1) : i;
}

/* Python's x % y and x // y: the remainder has the sign of y (CPython's float_divmod). */
static inline real_t sr_mod_real(real_t x, real_t y)
{
    real_t m = SR_MATH(fmod)(x, y);
    if (m != SR_REAL(0)) {
        if ((y < SR_REAL(0)) != (m < SR_REAL(0))) {
            m += y;
        }
    } else {
        m = (y < SR_REAL(0)) ? -SR_REAL(0) : SR_REAL(0);
    }
    return m;
}

static inline real_t sr_floor_div_real(real_t x, real_t y)
{
    real_t m = SR_MATH(fmod)(x, y);
    real_t d = (x - m) / y;
    real_t f;
    if ((m != SR_REAL(0)) && ((y < SR_REAL(0)) != (m < SR_REAL(0)))) {
        d -= SR_REAL(1);
    }
    if (d != SR_REAL(0)) {
        f = SR_MATH(floor)(d);
        if ((d - f) > SR_REAL(0.5)) {
            f += SR_REAL(1);
        }
    } else {
        f = SR_MATH(copysign)(SR_REAL(0), x / y);
    }
    return f;
}

/* A quotient of complex numbers as CPython 3.13 computes it (Smith 1962), which depends on the larger part of the divisor. */
static inline real_t sr_c_quot_real(real_t a, real_t b, real_t c, real_t d)
{
    const bool first = (SR_MATH(fabs)(c) >= SR_MATH(fabs)(d));
    const real_t ratio = first ? (d / c) : (c / d);
    const real_t denominator = first ? (c + (d * ratio)) : ((c * ratio) + d);
    return (first ? (a + (b * ratio)) : ((a * ratio) + b)) / denominator;
}

static inline real_t sr_c_quot_imag(real_t a, real_t b, real_t c, real_t d)
{
    const bool first = (SR_MATH(fabs)(c) >= SR_MATH(fabs)(d));
    const real_t ratio = first ? (d / c) : (c / d);
    const real_t denominator = first ? (c + (d * ratio)) : ((c * ratio) + d);
    return (first ? (b - (a * ratio)) : ((b * ratio) - a)) / denominator;
}

static inline int64_t sr_mod_int(int64_t x, int64_t y)
{
    int64_t m = x % y;
    return ((m != 0) && ((m < 0) != (y < 0))) ? (m + y) : m;
}

static inline int64_t sr_floor_div_int(int64_t x, int64_t y)
{
    int64_t d = x / y;
    return (((x % y) != 0) && ((x < 0) != (y < 0))) ? (d - 1) : d;
}

#endif
