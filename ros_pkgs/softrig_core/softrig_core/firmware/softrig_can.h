/* Support of nodes on a CAN bus: signals of messages of 8 bytes, little-endian as in the DBC. C99. */
#ifndef SOFTRIG_CAN_H
#define SOFTRIG_CAN_H

#include <float.h>
#include <math.h>
#include <stdint.h>
#include <string.h>

/* A data frame of 8 bytes with an identifier of 11 bits. */
typedef struct {
    uint32_t id;
    uint8_t data[8];
} sr_can_frame;

static inline uint32_t sr_can_get(const uint8_t *data, unsigned at, unsigned bits)
{
    uint32_t value = 0u;
    for (unsigned i = 0u; i < bits; i++) {
        value |= (uint32_t)((data[(at + i) / 8u] >> ((at + i) % 8u)) & 1u) << i;
    }
    return value;
}

static inline void sr_can_put(uint8_t *data, unsigned at, unsigned bits, uint32_t value)
{
    for (unsigned i = 0u; i < bits; i++) {
        data[(at + i) / 8u] |= (uint8_t)(((value >> i) & 1u) << ((at + i) % 8u));
    }
}

/* A number in two's complement. */
static inline double sr_can_signed(uint32_t raw, unsigned bits)
{
    const double half = (double)(UINT32_C(1) << (bits - 1u));
    return ((double)raw < half) ? (double)raw : ((double)raw - (2.0 * half));
}

static inline double sr_can_float(uint32_t raw)
{
    float value;
    memcpy(&value, &raw, sizeof value);
    return (double)value;
}

/* Within a range, before it becomes a whole number: a cast of a number beyond it differs by processor. */
static inline double sr_can_limited(double x, double low, double high)
{
    return (x < low) ? low : ((x > high) ? high : x);
}

static inline uint32_t sr_can_of_float(double x)
{
    const float value = (float)sr_can_limited(x, -(double)FLT_MAX, (double)FLT_MAX);
    uint32_t raw;
    memcpy(&raw, &value, sizeof raw);
    return raw;
}

#endif
