/* What both versions of the FMI have in common: one node, its inputs, outputs and parameters, and steps of its period.
 * Included once, after model.h, which is written for the node. Written by hand for `softrig export fmu --native`.
 */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

typedef struct {
    uint64_t build; /* of whom the state is: bytes of another one are refused */
    node_t node;
    node_in_t in;
    node_out_t out;
    node_params_t params;
    int64_t k; /* tick that comes next */
} model_t;

#include "variables.h"

/* All that an instance is, beside whom it logs to: the FMU's state. */
typedef struct {
    model_t m;
    double start;
    bool ready;
} run_t;

/* Time of a tick, ns: the nearest whole number, as in softrig. */
static int64_t time_of(int64_t k)
{
    return (NS_DENOMINATOR == 1) ? (k * NS_NUMERATOR)
                                 : (((2 * k * NS_NUMERATOR) + NS_DENOMINATOR) / (2 * NS_DENOMINATOR));
}

static void model_begin(model_t *m)
{
    memset(m, 0, sizeof *m);
    m->build = BUILD;
    m->params = (node_params_t)NODE_PARAMS;
    node_init(&m->node, &m->params);
    model_start(m);
}

/* Go to the first tick at a start time; returns what is wrong, NULL: nothing. */
static const char *model_ready(model_t *m, double start)
{
    const double k = rint(start / PERIOD);
    if (!((k >= 0.0) && (fabs((k * PERIOD) - start) <= (1e-6 * PERIOD)))) {
        return "the start time is no whole number of periods";
    }
    m->k = (int64_t)k;
    node_init(&m->node, &m->params);
#if IS_PLANT
    return (node_outputs(&m->node, &m->out, time_of(m->k)) == SR_DONE) ? NULL : "the outputs cannot be computed";
#elif IS_SOURCE
    { /* a source has its first value before any step */
        const node_t kept = m->node;
        const int status = node_step(&m->node, &m->in, &m->out, time_of(m->k));
        m->node = kept;
        return (status == SR_DONE) ? NULL : "the first outputs cannot be computed";
    }
#else
    return NULL;
#endif
}

/* Move on by whole periods with the inputs held; returns what is wrong, NULL: nothing. A tick that fails changes nothing. */
static const char *model_step(model_t *m, double from, double size)
{
    const double count = rint(size / PERIOD);
    if (!((count >= 1.0) && (fabs((count * PERIOD) - size) <= (1e-6 * PERIOD)))) {
        return "the step is no whole number of periods";
    }
    if (!(fabs(((double)m->k * PERIOD) - from) <= (0.5 * PERIOD))) {
        return "the step does not begin where the last one ended";
    }
    if (!model_inside(m)) {
        return "an input is not finite or beyond its limit";
    }
    for (int64_t n = (int64_t)count; n > 0; n--) {
#if IS_PLANT
        const node_t before = m->node;
        if (node_advance(&m->node, &m->in, time_of(m->k)) != SR_DONE) {
            return "the node gave up: an error in Python";
        }
        if (node_outputs(&m->node, &m->out, time_of(m->k + 1)) != SR_DONE) {
            m->node = before;
            return "the node gave up: an error in Python";
        }
#else
        if (node_step(&m->node, &m->in, &m->out, time_of(m->k)) != SR_DONE) {
            return "the node gave up: an error in Python";
        }
#endif
        m->k++;
    }
    return NULL;
}

static void run_begin(run_t *r)
{
    model_begin(&r->m);
    r->start = 0.0;
    r->ready = false;
}

/* Copy the state, into memory that there is already or new one; NULL: there is none. */
static void *run_kept(const run_t *r, void *old)
{
    run_t *to = (old != NULL) ? old : calloc(1, sizeof *to);
    if (to != NULL) {
        *to = *r;
    }
    return to;
}

/* Make a state of bytes; returns what is wrong, NULL: nothing. */
static const char *run_read(const void *bytes, size_t size, void **kept)
{
    uint64_t build;
    if (size != sizeof(run_t)) {
        return "these bytes are no state of this FMU";
    }
    memcpy(&build, bytes, sizeof build); /* the first member of the first member */
    if (build != BUILD) {
        return "these bytes are the state of another build";
    }
    if (*kept == NULL) {
        *kept = calloc(1, sizeof(run_t));
    }
    if (*kept == NULL) {
        return "no memory";
    }
    memcpy(*kept, bytes, sizeof(run_t));
    return NULL;
}
