/* FMI 2.0 around a model; MODEL is its file. Value references count the entries of its numbers. */
#include <stdlib.h>
#include "fmi2Functions.h"
#include MODEL
typedef struct { double r[N]; fmi2CallbackLogger log; } Unit;
#ifndef TOLERANCE
#define TOLERANCE(r, known, value)
#define MODE(r, now) /* 1: events, 2: continuous time */
#define REFUSES(r, vr) 0
#define ENDS(r) 0
#endif
#define EACH for (size_t k = 0; k < n; k++)
#define REFS fmi2Component c, const fmi2ValueReference vr[], size_t n

const char *fmi2GetTypesPlatform(void) { return fmi2TypesPlatform; }
const char *fmi2GetVersion(void) { return fmi2Version; }
fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean on, size_t n, const fmi2String names[]) { return fmi2OK; }
fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String place,
                              const fmi2CallbackFunctions *back, fmi2Boolean visible, fmi2Boolean on) {
    Unit *u = calloc(1, sizeof *u);
    for (int k = 0; k < N; k++) u->r[k] = initial[k];
    u->log = back->logger;
    return u;
}
void fmi2FreeInstance(fmi2Component c) { free(c); }
fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean d, fmi2Real tol, fmi2Real a, fmi2Boolean s, fmi2Real b) {
    TOLERANCE(((Unit *)c)->r, d, tol);
    return fmi2OK;
}
fmi2Status fmi2EnterInitializationMode(fmi2Component c) { return fmi2OK; }
fmi2Status fmi2ExitInitializationMode(fmi2Component c) { return fmi2OK; }
fmi2Status fmi2Terminate(fmi2Component c) { return fmi2OK; }
fmi2Status fmi2Reset(fmi2Component c) { for (int k = 0; k < N; k++) ((Unit *)c)->r[k] = initial[k]; return fmi2OK; }
#define GET(T, X) { outputs(((Unit *)c)->r); EACH x[k] = ((Unit *)c)->r[vr[k]]; return fmi2OK; }
#define SET { EACH { if (REFUSES(((Unit *)c)->r, vr[k])) return fmi2Error; ((Unit *)c)->r[vr[k]] = x[k]; } return fmi2OK; }
fmi2Status fmi2GetReal(REFS, fmi2Real x[]) GET(r, x)
fmi2Status fmi2GetInteger(REFS, fmi2Integer x[]) GET(r, x)
fmi2Status fmi2GetBoolean(REFS, fmi2Boolean x[]) GET(r, x)
fmi2Status fmi2GetString(REFS, fmi2String x[]) { return fmi2Error; }
fmi2Status fmi2SetReal(REFS, const fmi2Real x[]) SET
fmi2Status fmi2SetInteger(REFS, const fmi2Integer x[]) SET
fmi2Status fmi2SetBoolean(REFS, const fmi2Boolean x[]) SET
fmi2Status fmi2SetString(REFS, const fmi2String x[]) { return fmi2Error; }
fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *s) { *s = malloc(sizeof(Unit)); *(Unit *)*s = *(Unit *)c; return fmi2OK; }
fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate s) { *(Unit *)c = *(Unit *)s; return fmi2OK; }
fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *s) { free(*s); *s = NULL; return fmi2OK; }
fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate s, size_t *n) { *n = sizeof(double) * N; return fmi2OK; }
fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate s, fmi2Byte out[], size_t n) {
    for (size_t k = 0; k < n; k++) out[k] = ((char *)((Unit *)s)->r)[k];
    return fmi2OK;
}
fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte in[], size_t n, fmi2FMUstate *s) {
    fmi2GetFMUstate(c, s);
    for (size_t k = 0; k < n; k++) ((char *)((Unit *)*s)->r)[k] = in[k];
    return fmi2OK;
}
fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference a[], size_t n, const fmi2ValueReference b[],
                                        size_t m, const fmi2Real d[], fmi2Real y[]) { return fmi2Error; }
/* co-simulation */
fmi2Status fmi2SetRealInputDerivatives(REFS, const fmi2Integer o[], const fmi2Real x[]) { return fmi2Error; }
fmi2Status fmi2GetRealOutputDerivatives(REFS, const fmi2Integer o[], fmi2Real x[]) { return fmi2Error; }
fmi2Status fmi2DoStep(fmi2Component c, fmi2Real t, fmi2Real h, fmi2Boolean no) {
    Unit *u = c;
    int status = step(u->r, t, h);
    if (status) u->log(NULL, "unit", status, "step", "the step is too hard for me");
    return status;
}
fmi2Status fmi2CancelStep(fmi2Component c) { return fmi2Error; }
fmi2Status fmi2GetStatus(fmi2Component c, const fmi2StatusKind k, fmi2Status *x) { return fmi2Error; }
fmi2Status fmi2GetRealStatus(fmi2Component c, const fmi2StatusKind k, fmi2Real *x) { *x = 0.25; return fmi2OK; }
fmi2Status fmi2GetIntegerStatus(fmi2Component c, const fmi2StatusKind k, fmi2Integer *x) { return fmi2Error; }
fmi2Status fmi2GetBooleanStatus(fmi2Component c, const fmi2StatusKind k, fmi2Boolean *x) { *x = k == fmi2Terminated && ENDS(((Unit *)c)->r); return fmi2OK; }
fmi2Status fmi2GetStringStatus(fmi2Component c, const fmi2StatusKind k, fmi2String *x) { return fmi2Error; }
/* model exchange: the continuous states are the first of the numbers */
fmi2Status fmi2EnterEventMode(fmi2Component c) { MODE(((Unit *)c)->r, 1); return fmi2OK; }
fmi2Status fmi2NewDiscreteStates(fmi2Component c, fmi2EventInfo *info) {
    event(((Unit *)c)->r);
    info->newDiscreteStatesNeeded = info->terminateSimulation = info->nextEventTimeDefined = fmi2False;
    return fmi2OK;
}
fmi2Status fmi2EnterContinuousTimeMode(fmi2Component c) { MODE(((Unit *)c)->r, 2); return fmi2OK; }
fmi2Status fmi2CompletedIntegratorStep(fmi2Component c, fmi2Boolean no, fmi2Boolean *enter, fmi2Boolean *end) {
    *enter = *end = fmi2False;
    return fmi2OK;
}
fmi2Status fmi2SetTime(fmi2Component c, fmi2Real t) { return fmi2OK; }
fmi2Status fmi2SetContinuousStates(fmi2Component c, const fmi2Real x[], size_t n) { EACH ((Unit *)c)->r[k] = x[k]; return fmi2OK; }
fmi2Status fmi2GetDerivatives(fmi2Component c, fmi2Real dx[], size_t n) { derivatives(((Unit *)c)->r, dx); return fmi2OK; }
fmi2Status fmi2GetEventIndicators(fmi2Component c, fmi2Real z[], size_t n) { indicators(((Unit *)c)->r, z); return fmi2OK; }
fmi2Status fmi2GetContinuousStates(fmi2Component c, fmi2Real x[], size_t n) { EACH x[k] = ((Unit *)c)->r[k]; return fmi2OK; }
fmi2Status fmi2GetNominalsOfContinuousStates(fmi2Component c, fmi2Real x[], size_t n) { EACH x[k] = 1; return fmi2OK; }
