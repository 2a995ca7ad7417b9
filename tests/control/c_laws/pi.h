#ifndef PI_H
#define PI_H
#include <stdbool.h>
#include <stdint.h>
#ifndef REAL
#define REAL float
#endif
#ifdef __cplusplus
extern "C" {
#endif
typedef struct pi_params {
    REAL kp, ki, limit, period;
} pi_params;
typedef struct pi_in {
    REAL reference;
    REAL speed;
} pi_in;
typedef struct pi_out {
    REAL voltage;
} pi_out;
typedef struct pi {
    pi_params p;
    REAL integral;
    uint16_t ticks;
    bool saturated;
} pi;
void pi_init(pi *s, const pi_params *params);
int pi_step(pi *s, const pi_in *in, pi_out *out, int64_t t_ns);
#ifdef __cplusplus
}
#endif
#endif
