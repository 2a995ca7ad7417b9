/* PI with anti-windup by clamping, written by hand in single precision; -DFAULT=... breaks it in one way. */
#include "pi.h"
#include <fenv.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <unistd.h>

#define STATIC 1
#define RANDOM 2
#define CRASH 3
#define GIVES_UP 4
#define NOT_A_NUMBER 5
#define CONSTANT 6
#define OVERFLOW 7
#define HANG 8
#define ABORT 9
#define RECURSE 10
#define HEAP 11
#define EXIT 12
#define ROUNDING 13
#define PRINTS 14
#define CLOSES 15
#define FORKS 16
#ifndef FAULT
#define FAULT 0
#endif

void pi_init(pi *s, const pi_params *params)
{
    s->p = *params;
    s->integral = 0;
}

#if FAULT == STATIC
static REAL integral;
#define INTEGRAL integral
#else
#define INTEGRAL s->integral
#endif

static int deeper(volatile int *n) { volatile char room[4096]; room[0] = (char)*n; *n += 1; return deeper(n) + room[0]; }

int pi_step(pi *s, const pi_in *in, pi_out *out, int64_t t_ns)
{
    REAL e = in->reference - in->speed;
    REAL u = s->p.kp * e + INTEGRAL;
    s->saturated = u > s->p.limit || u < -s->p.limit;
    if (!s->saturated) {
        INTEGRAL += s->p.ki * s->p.period * e;
    }
    s->ticks++;
    out->voltage = s->saturated ? (u > 0 ? s->p.limit : -s->p.limit) : u;
    if (FAULT == RANDOM) out->voltage += (float)rand() / (float)RAND_MAX;
    if (t_ns >= 200000000) {
        if (FAULT == CRASH) *(volatile int *)8 = 1;
        if (FAULT == ABORT) abort();
        if (FAULT == RECURSE) { volatile int n = 0; return deeper(&n); }
        if (FAULT == GIVES_UP) { out->voltage = 0; return 1; }
        if (FAULT == NOT_A_NUMBER) out->voltage = NAN;
        if (FAULT == CONSTANT) s->p.kp = 2.0f;
        if (FAULT == HANG) for (;;) { }
        if (FAULT == EXIT) exit(0);
        if (FAULT == ROUNDING) fesetround(FE_UPWARD);
        if (FAULT == PRINTS) for (int k = 0; k < 20000; k++) fprintf(stderr, "tick %d\n", k);
        if (FAULT == CLOSES) { for (int k = 3; k < 256; k++) close(k); pause(); }
        if (FAULT == FORKS) { if (fork() == 0) sleep(100); exit(7); }
    }
    return 0;
}
