/* FMI 3.0 for co-simulation around one node; see native_model.c. */
#include "fmi3Functions.h"
#include "model.h"
#include "native_model.c"

typedef struct {
    run_t r;
    fmi3InstanceEnvironment environment;
    fmi3LogMessageCallback log;
} instance_t;

static fmi3Status failed(const instance_t *s, const char *why)
{
    if (s->log != NULL) {
        s->log(s->environment, fmi3Error, "error", why);
    }
    return fmi3Error;
}

const char *fmi3GetVersion(void) { return fmi3Version; }
fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String place, fmi3Boolean visible, fmi3Boolean on,
                                         fmi3Boolean events, fmi3Boolean early, const fmi3ValueReference vr[], size_t n,
                                         fmi3InstanceEnvironment environment, fmi3LogMessageCallback log,
                                         fmi3IntermediateUpdateCallback update)
{
    instance_t *s = ((token != NULL) && (strcmp(token, GUID) == 0) && !events && (n == 0)) ? calloc(1, sizeof *s) : NULL;
    (void)name; (void)place; (void)visible; (void)on; (void)early; (void)vr; (void)update;
    if (s != NULL) {
        s->environment = environment;
        s->log = log;
        run_begin(&s->r);
    }
    return s;
}
fmi3Instance fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String place, fmi3Boolean visible, fmi3Boolean on,
                                          fmi3InstanceEnvironment environment, fmi3LogMessageCallback log)
{
    (void)name; (void)token; (void)place; (void)visible; (void)on; (void)environment; (void)log;
    return NULL;
}
void fmi3FreeInstance(fmi3Instance c) { free(c); }
fmi3Status fmi3SetDebugLogging(fmi3Instance c, fmi3Boolean on, size_t n, const fmi3String names[])
{
    (void)c; (void)on; (void)n; (void)names;
    return fmi3OK;
}
fmi3Status fmi3EnterInitializationMode(fmi3Instance c, fmi3Boolean known, fmi3Float64 tolerance, fmi3Float64 start, fmi3Boolean stops,
                                       fmi3Float64 stop)
{
    (void)known; (void)tolerance; (void)stops; (void)stop;
    ((instance_t *)c)->r.start = start;
    return fmi3OK;
}
fmi3Status fmi3ExitInitializationMode(fmi3Instance c)
{
    instance_t *s = c;
    const char *why = model_ready(&s->r.m, s->r.start);
    s->r.ready = (why == NULL);
    return s->r.ready ? fmi3OK : failed(s, why);
}
fmi3Status fmi3EnterStepMode(fmi3Instance c) { (void)c; return fmi3OK; }
fmi3Status fmi3EnterEventMode(fmi3Instance c) { return failed(c, "there are no events"); }
fmi3Status fmi3Terminate(fmi3Instance c) { (void)c; return fmi3OK; }
fmi3Status fmi3Reset(fmi3Instance c)
{
    instance_t *s = c;
    run_begin(&s->r);
    return fmi3OK;
}

#define GET(NAME, KIND)                                                                                                 \
    fmi3Status fmi3Get##NAME(fmi3Instance c, const fmi3ValueReference vr[], size_t n, fmi3##NAME x[], size_t count)     \
    {                                                                                                                   \
        const instance_t *s = c;                                                                                        \
        for (size_t k = 0; k < n; k++) {                                                                                \
            double value = (double)time_of(s->r.m.k) * 1e-9;                                                              \
            if ((count != n) || (((vr[k] != TIME) || (KIND != KIND_REAL)) && !model_get(&s->r.m, vr[k], KIND, &value))) { \
                return failed(s, "no variable of this type has that value reference");                                  \
            }                                                                                                           \
            x[k] = (fmi3##NAME)value;                                                                                   \
        }                                                                                                               \
        return fmi3OK;                                                                                                  \
    }
#define SET(NAME, KIND)                                                                                                 \
    fmi3Status fmi3Set##NAME(fmi3Instance c, const fmi3ValueReference vr[], size_t n, const fmi3##NAME x[], size_t count) \
    {                                                                                                                   \
        instance_t *s = c;                                                                                              \
        for (size_t k = 0; k < n; k++) {                                                                                \
            if ((count != n) || !model_set(&s->r.m, vr[k], KIND, (double)x[k], s->r.ready)) {                               \
                return failed(s, "no variable that can be set now has that type and value reference");                  \
            }                                                                                                           \
        }                                                                                                               \
        return fmi3OK;                                                                                                  \
    }
GET(Float64, KIND_REAL)
GET(Int64, KIND_INTEGER)
GET(Boolean, KIND_BOOLEAN)
SET(Float64, KIND_REAL)
SET(Int64, KIND_INTEGER)
SET(Boolean, KIND_BOOLEAN)

fmi3Status fmi3GetFMUState(fmi3Instance c, fmi3FMUState *kept)
{
    *kept = run_kept(&((const instance_t *)c)->r, *kept);
    return (*kept != NULL) ? fmi3OK : failed(c, "no memory");
}
fmi3Status fmi3SetFMUState(fmi3Instance c, fmi3FMUState kept)
{
    ((instance_t *)c)->r = *(const run_t *)kept;
    return fmi3OK;
}
fmi3Status fmi3FreeFMUState(fmi3Instance c, fmi3FMUState *kept)
{
    (void)c;
    free(*kept);
    *kept = NULL;
    return fmi3OK;
}
fmi3Status fmi3SerializedFMUStateSize(fmi3Instance c, fmi3FMUState kept, size_t *size)
{
    (void)c; (void)kept;
    *size = sizeof(run_t);
    return fmi3OK;
}
fmi3Status fmi3SerializeFMUState(fmi3Instance c, fmi3FMUState kept, fmi3Byte bytes[], size_t size)
{
    if (size < sizeof(run_t)) {
        return failed(c, "the state has more bytes");
    }
    memcpy(bytes, kept, sizeof(run_t));
    return fmi3OK;
}
fmi3Status fmi3DeserializeFMUState(fmi3Instance c, const fmi3Byte bytes[], size_t size, fmi3FMUState *kept)
{
    const char *why = run_read(bytes, size, kept);
    return (why == NULL) ? fmi3OK : failed(c, why);
}
fmi3Status fmi3DoStep(fmi3Instance c, fmi3Float64 from, fmi3Float64 size, fmi3Boolean no, fmi3Boolean *event, fmi3Boolean *end,
                      fmi3Boolean *early, fmi3Float64 *last)
{
    instance_t *s = c;
    const char *why = s->r.ready ? model_step(&s->r.m, from, size) : "it is not initialised";
    (void)no;
    *event = fmi3False;
    *end = fmi3False;
    *early = fmi3False;
    *last = (double)time_of(s->r.m.k) * 1e-9;
    return (why == NULL) ? fmi3OK : failed(s, why);
}
