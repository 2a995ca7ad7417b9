// The law of pi.c with its integral in a static variable of a function, as authors of C++ write it.
#include "pi.h"
namespace { struct Law { REAL integral = 0; }; Law &law() { static Law one; return one; } }
extern "C" void pi_init(pi *s, const pi_params *p) { s->p = *p; s->integral = 0; s->ticks = 0; s->saturated = false; }
extern "C" int pi_step(pi *s, const pi_in *in, pi_out *out, int64_t) {
    REAL e = in->reference - in->speed, u = s->p.kp * e + law().integral;
    s->saturated = u > s->p.limit || u < -s->p.limit;
    if (!s->saturated) law().integral += s->p.ki * s->p.period * e;
    s->ticks++; out->voltage = s->saturated ? (u > 0 ? s->p.limit : -s->p.limit) : u; return 0; }
