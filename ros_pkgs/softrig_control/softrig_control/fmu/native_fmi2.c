/* FMI 2.0 for co-simulation around one node; see native_model.c. */
#include "fmi2Functions.h"
#include "model.h"
#include "native_model.c"

typedef struct {
    run_t r;
    fmi2CallbackFunctions back;
    char name[128];
} instance_t;

static fmi2Status failed(const instance_t *s, const char *why)
{
    if (s->back.logger != NULL) {
        s->back.logger(s->back.componentEnvironment, s->name, fmi2Error, "error", "%s", why);
    }
    return fmi2Error;
}

const char *fmi2GetTypesPlatform(void) { return fmi2TypesPlatform; }
const char *fmi2GetVersion(void) { return fmi2Version; }
fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean on, size_t n, const fmi2String names[])
{
    (void)c; (void)on; (void)n; (void)names;
    return fmi2OK;
}
fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String place,
                              const fmi2CallbackFunctions *back, fmi2Boolean visible, fmi2Boolean on)
{
    instance_t *s = ((type == fmi2CoSimulation) && (guid != NULL) && (strcmp(guid, GUID) == 0)) ? calloc(1, sizeof *s) : NULL;
    (void)place; (void)visible; (void)on;
    if (s != NULL) {
        s->back = *back;
        (void)snprintf(s->name, sizeof s->name, "%s", (name != NULL) ? name : "");
        run_begin(&s->r);
    }
    return s;
}
void fmi2FreeInstance(fmi2Component c) { free(c); }
fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean known, fmi2Real tolerance, fmi2Real start, fmi2Boolean stops, fmi2Real stop)
{
    (void)known; (void)tolerance; (void)stops; (void)stop;
    ((instance_t *)c)->r.start = start;
    return fmi2OK;
}
fmi2Status fmi2EnterInitializationMode(fmi2Component c) { (void)c; return fmi2OK; }
fmi2Status fmi2ExitInitializationMode(fmi2Component c)
{
    instance_t *s = c;
    const char *why = model_ready(&s->r.m, s->r.start);
    s->r.ready = (why == NULL);
    return s->r.ready ? fmi2OK : failed(s, why);
}
fmi2Status fmi2Terminate(fmi2Component c) { (void)c; return fmi2OK; }
fmi2Status fmi2Reset(fmi2Component c)
{
    instance_t *s = c;
    run_begin(&s->r);
    return fmi2OK;
}

#define GET(NAME, TYPE, KIND)                                                                                           \
    fmi2Status fmi2Get##NAME(fmi2Component c, const fmi2ValueReference vr[], size_t n, TYPE x[])                        \
    {                                                                                                                   \
        for (size_t k = 0; k < n; k++) {                                                                                \
            double value;                                                                                               \
            if (!model_get(&((instance_t *)c)->r.m, vr[k], KIND, &value)) {                                               \
                return failed(c, "no variable of this type has that value reference");                                  \
            }                                                                                                           \
            x[k] = (TYPE)value;                                                                                         \
        }                                                                                                               \
        return fmi2OK;                                                                                                  \
    }
#define SET(NAME, TYPE, KIND)                                                                                           \
    fmi2Status fmi2Set##NAME(fmi2Component c, const fmi2ValueReference vr[], size_t n, const TYPE x[])                  \
    {                                                                                                                   \
        for (size_t k = 0; k < n; k++) {                                                                                \
            if (!model_set(&((instance_t *)c)->r.m, vr[k], KIND, (double)x[k], ((instance_t *)c)->r.ready)) {               \
                return failed(c, "no variable that can be set now has that type and value reference");                  \
            }                                                                                                           \
        }                                                                                                               \
        return fmi2OK;                                                                                                  \
    }
GET(Real, fmi2Real, KIND_REAL)
GET(Integer, fmi2Integer, KIND_INTEGER)
GET(Boolean, fmi2Boolean, KIND_BOOLEAN)
SET(Real, fmi2Real, KIND_REAL)
SET(Integer, fmi2Integer, KIND_INTEGER)
SET(Boolean, fmi2Boolean, KIND_BOOLEAN)
fmi2Status fmi2GetString(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2String x[])
{
    (void)vr; (void)x;
    return (n == 0) ? fmi2OK : failed(c, "there are no texts");
}
fmi2Status fmi2SetString(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2String x[])
{
    (void)vr; (void)x;
    return (n == 0) ? fmi2OK : failed(c, "there are no texts");
}

fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *kept)
{
    *kept = run_kept(&((const instance_t *)c)->r, *kept);
    return (*kept != NULL) ? fmi2OK : failed(c, "no memory");
}
fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate kept)
{
    ((instance_t *)c)->r = *(const run_t *)kept;
    return fmi2OK;
}
fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *kept)
{
    (void)c;
    free(*kept);
    *kept = NULL;
    return fmi2OK;
}
fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate kept, size_t *size)
{
    (void)c; (void)kept;
    *size = sizeof(run_t);
    return fmi2OK;
}
fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate kept, fmi2Byte bytes[], size_t size)
{
    if (size < sizeof(run_t)) {
        return failed(c, "the state has more bytes");
    }
    memcpy(bytes, kept, sizeof(run_t));
    return fmi2OK;
}
fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte bytes[], size_t size, fmi2FMUstate *kept)
{
    const char *why = run_read(bytes, size, kept);
    return (why == NULL) ? fmi2OK : failed(c, why);
}
fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference a[], size_t n, const fmi2ValueReference b[],
                                        size_t m, const fmi2Real d[], fmi2Real y[])
{
    (void)a; (void)n; (void)b; (void)m; (void)d; (void)y;
    return failed(c, "there are no directional derivatives");
}
fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2Integer order[], const fmi2Real x[])
{
    (void)vr; (void)n; (void)order; (void)x;
    return failed(c, "inputs are held");
}
fmi2Status fmi2GetRealOutputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2Integer order[], fmi2Real x[])
{
    (void)vr; (void)n; (void)order; (void)x;
    return failed(c, "outputs have no derivatives");
}
fmi2Status fmi2DoStep(fmi2Component c, fmi2Real from, fmi2Real size, fmi2Boolean no)
{
    instance_t *s = c;
    const char *why = s->r.ready ? model_step(&s->r.m, from, size) : "it is not initialised";
    (void)no;
    return (why == NULL) ? fmi2OK : failed(s, why);
}
fmi2Status fmi2CancelStep(fmi2Component c) { return failed(c, "no step is under way"); }
#define STATUS(NAME, TYPE)                                                                                              \
    fmi2Status fmi2Get##NAME##Status(fmi2Component c, const fmi2StatusKind kind, TYPE *x)                               \
    {                                                                                                                   \
        (void)kind; (void)x;                                                                                            \
        return failed(c, "no step is under way");                                                                       \
    }
STATUS(, fmi2Status)
STATUS(Real, fmi2Real)
STATUS(Integer, fmi2Integer)
STATUS(Boolean, fmi2Boolean)
STATUS(String, fmi2String)
