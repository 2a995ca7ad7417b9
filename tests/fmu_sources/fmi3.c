/* FMI 3.0 around a model; MODEL is its file. Value references count the entries of its numbers. */
#include <stdlib.h>
#include "fmi3Functions.h"
#include MODEL
typedef struct { double r[N]; fmi3LogMessageCallback log; } Unit;
#ifndef WIDTH
#define WIDTH(v) 1 /* values of a variable: those of an array stand one after the other */
#endif
#ifndef TOLERANCE
#define TOLERANCE(r, known, value)
#define MODE(r, now) /* 1: events, 2: continuous time */
#define REFUSES(r, vr) 0
#define ENDS(r) 0
#endif
#define EACH for (size_t k = 0; k < n; k++)
#define REFS fmi3Instance c, const fmi3ValueReference vr[], size_t n

const char *fmi3GetVersion(void) { return fmi3Version; }
static fmi3Instance make(fmi3LogMessageCallback log) {
    Unit *u = calloc(1, sizeof *u);
    for (int k = 0; k < N; k++) u->r[k] = initial[k];
    u->log = log;
    return u;
}
fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String place, fmi3Boolean visible, fmi3Boolean on,
    fmi3Boolean events, fmi3Boolean early, const fmi3ValueReference vr[], size_t n, fmi3InstanceEnvironment env,
    fmi3LogMessageCallback log, fmi3IntermediateUpdateCallback update) { return make(log); }
fmi3Instance fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String place, fmi3Boolean visible, fmi3Boolean on,
    fmi3InstanceEnvironment env, fmi3LogMessageCallback log) { return make(log); }
void fmi3FreeInstance(fmi3Instance c) { free(c); }
fmi3Status fmi3EnterInitializationMode(fmi3Instance c, fmi3Boolean d, fmi3Float64 tol, fmi3Float64 a, fmi3Boolean s, fmi3Float64 b) {
    TOLERANCE(((Unit *)c)->r, d, tol);
    return fmi3OK;
}
fmi3Status fmi3ExitInitializationMode(fmi3Instance c) { return fmi3OK; }
fmi3Status fmi3EnterEventMode(fmi3Instance c) { MODE(((Unit *)c)->r, 1); return fmi3OK; }
fmi3Status fmi3Terminate(fmi3Instance c) { return fmi3OK; }
fmi3Status fmi3Reset(fmi3Instance c) { return fmi3OK; }
#define GET(NAME, TYPE) fmi3Status fmi3Get##NAME(REFS, TYPE x[], size_t m) \
    { size_t j = 0; outputs(((Unit *)c)->r); EACH for (int q = 0; q < WIDTH(vr[k]); q++) x[j++] = ((Unit *)c)->r[vr[k] + q]; return fmi3OK; }
#define SET(NAME, TYPE) fmi3Status fmi3Set##NAME(REFS, const TYPE x[], size_t m) \
    { size_t j = 0; EACH { if (REFUSES(((Unit *)c)->r, vr[k])) return fmi3Error; \
      for (int q = 0; q < WIDTH(vr[k]); q++) ((Unit *)c)->r[vr[k] + q] = x[j++]; } return fmi3OK; }
#define BOTH(NAME) GET(NAME, fmi3##NAME) SET(NAME, fmi3##NAME)
BOTH(Float64) BOTH(Float32) BOTH(Int32) BOTH(Int64) BOTH(UInt8) BOTH(Boolean)
fmi3Status fmi3GetFMUState(fmi3Instance c, fmi3FMUState *s) { *s = malloc(sizeof(Unit)); *(Unit *)*s = *(Unit *)c; return fmi3OK; }
fmi3Status fmi3SetFMUState(fmi3Instance c, fmi3FMUState s) { *(Unit *)c = *(Unit *)s; return fmi3OK; }
fmi3Status fmi3FreeFMUState(fmi3Instance c, fmi3FMUState *s) { free(*s); *s = NULL; return fmi3OK; }
fmi3Status fmi3SerializedFMUStateSize(fmi3Instance c, fmi3FMUState s, size_t *n) { *n = sizeof(double) * N; return fmi3OK; }
fmi3Status fmi3SerializeFMUState(fmi3Instance c, fmi3FMUState s, fmi3Byte out[], size_t n) {
    for (size_t k = 0; k < n; k++) out[k] = ((char *)((Unit *)s)->r)[k];
    return fmi3OK;
}
fmi3Status fmi3DeserializeFMUState(fmi3Instance c, const fmi3Byte in[], size_t n, fmi3FMUState *s) {
    fmi3GetFMUState(c, s);
    for (size_t k = 0; k < n; k++) ((char *)((Unit *)*s)->r)[k] = in[k];
    return fmi3OK;
}
fmi3Status fmi3EnterStepMode(fmi3Instance c) { return fmi3OK; }
fmi3Status fmi3DoStep(fmi3Instance c, fmi3Float64 t, fmi3Float64 h, fmi3Boolean no, fmi3Boolean *event, fmi3Boolean *end,
                      fmi3Boolean *early, fmi3Float64 *last) {
    Unit *u = c;
    int status = step(u->r, t, h);
    if (ENDS(u->r)) status = 0; /* FMI 3.0 has a flag for it */
    if (status) u->log(NULL, status, "step", "the step is too hard for me");
    *event = *early = fmi3False;
    *end = ENDS(u->r);
    *last = t + h;
    return status;
}
/* model exchange: the continuous states are the first of the numbers */
fmi3Status fmi3EnterContinuousTimeMode(fmi3Instance c) { MODE(((Unit *)c)->r, 2); return fmi3OK; }
fmi3Status fmi3UpdateDiscreteStates(fmi3Instance c, fmi3Boolean *more, fmi3Boolean *end, fmi3Boolean *nominals, fmi3Boolean *values,
                                    fmi3Boolean *defined, fmi3Float64 *next) {
    event(((Unit *)c)->r);
    *more = *end = *nominals = *values = *defined = fmi3False;
    return fmi3OK;
}
fmi3Status fmi3CompletedIntegratorStep(fmi3Instance c, fmi3Boolean no, fmi3Boolean *enter, fmi3Boolean *end) {
    *enter = *end = fmi3False;
    return fmi3OK;
}
fmi3Status fmi3SetTime(fmi3Instance c, fmi3Float64 t) { return fmi3OK; }
fmi3Status fmi3SetContinuousStates(fmi3Instance c, const fmi3Float64 x[], size_t n) { EACH ((Unit *)c)->r[k] = x[k]; return fmi3OK; }
fmi3Status fmi3GetContinuousStateDerivatives(fmi3Instance c, fmi3Float64 dx[], size_t n) { derivatives(((Unit *)c)->r, dx); return fmi3OK; }
fmi3Status fmi3GetEventIndicators(fmi3Instance c, fmi3Float64 z[], size_t n) { indicators(((Unit *)c)->r, z); return fmi3OK; }
fmi3Status fmi3GetContinuousStates(fmi3Instance c, fmi3Float64 x[], size_t n) { EACH x[k] = ((Unit *)c)->r[k]; return fmi3OK; }
fmi3Status fmi3GetNumberOfEventIndicators(fmi3Instance c, size_t *n) { *n = NZ; return fmi3OK; }
fmi3Status fmi3GetNumberOfContinuousStates(fmi3Instance c, size_t *n) { *n = NX; return fmi3OK; }
