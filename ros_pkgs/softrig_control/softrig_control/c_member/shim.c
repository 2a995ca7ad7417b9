/* Calls NODE_init, NODE_step, NODE_outputs and NODE_advance of a user's library with numbers alone.
 *
 * layout.h is made of the user's header. It has the types, and functions that copy numbers into a struct and out of it.
 * Compiled twice: as a library (a signal in the user's code ends the call, not the process), and as a program with
 * SR_PROGRAM, which a run has for itself where the library hides state or is not trusted.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <setjmp.h>
#include <signal.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/prctl.h>
#include <unistd.h>

/* what a call answers in its first number: 0, the status of the user's function, or one of these */
#define SR_SIGNAL 1000000.0   /* plus the number of the signal */
#define SR_RANGE 2000000.0    /* plus the place of a number that its type in C does not hold */
#define SR_CONSTANT 3000000.0 /* the call has changed a member that holds constants */
#define SR_MODE 4000000.0     /* the call has left another rounding mode, or one that flushes subnormal numbers */

#include "layout.h"

/* The mode in which the processor computes belongs to all code of the thread: what a library leaves is undone. */
#if defined(__x86_64__)
static unsigned sr_mode(void) { return __builtin_ia32_stmxcsr() & 0xFFC0u; } /* without the flags of what has happened */
static void sr_restore(unsigned mode) { __builtin_ia32_ldmxcsr(mode); }
#elif defined(__aarch64__)
static uint64_t sr_mode(void)
{
    uint64_t mode;
    __asm__ volatile("mrs %0, fpcr" : "=r"(mode));
    return mode;
}
static void sr_restore(uint64_t mode) { __asm__ volatile("msr fpcr, %0" : : "r"(mode)); }
#else
#include <fenv.h>
static int sr_mode(void) { return fegetround(); }
static void sr_restore(int mode) { fesetround(mode); }
#endif

static __thread sigjmp_buf *sr_back;
static __thread char sr_stack[65536]; /* of the handler: the user's may be what has run out */
static __thread int sr_has_stack;
static const int sr_signals[] = {SIGSEGV, SIGBUS, SIGFPE, SIGILL, SIGABRT};
static struct sigaction sr_before[65];

static void sr_caught(int signal, siginfo_t *info, void *context)
{
    (void)info;
    (void)context;
    if (sr_back != NULL) {
        siglongjmp(*sr_back, signal);
    }
    sigaction(signal, &sr_before[signal], NULL); /* not ours: whoever was there before gets it */
    if (signal == SIGABRT) {
        raise(signal);
    }
}

static void sr_watch(void)
{
    struct sigaction action;
    memset(&action, 0, sizeof action);
    action.sa_sigaction = sr_caught;
    action.sa_flags = SA_SIGINFO | SA_ONSTACK | SA_NODEFER;
    for (unsigned k = 0; k < sizeof sr_signals / sizeof *sr_signals; k++) {
        sigaction(sr_signals[k], &action, &sr_before[sr_signals[k]]);
    }
}

static void sr_enter(void)
{
    if (!sr_has_stack) {
        stack_t now;
        sr_has_stack = 1;
        if (sigaltstack(NULL, &now) == 0 && (now.ss_flags & SS_DISABLE) != 0) {
            stack_t mine;
            memset(&mine, 0, sizeof mine);
            mine.ss_sp = sr_stack;
            mine.ss_size = sizeof sr_stack;
            sigaltstack(&mine, NULL);
        }
    }
}

/* Find the functions of the user's library; NULL, or the name of what it lacks, or of why it cannot be loaded. */
const char *sr_load(const char *library, int watch)
{
    const __typeof__(sr_mode()) mode = sr_mode();
    void *found = dlopen(library, RTLD_NOW | RTLD_LOCAL);
    sr_restore(mode); /* a library that is linked with -ffast-math sets it when it is loaded */
    if (found == NULL) {
        return dlerror();
    }
    if (watch) {
        sr_watch();
    }
    return sr_bind(found);
}

long sr_size(void) { return (long)sizeof(SR_STATE); }

/* Fill a state by NODE_init: numbers of the parameters in, numbers of the state out. */
double sr_init(void *place, const double *params, double *state)
{
    const __typeof__(sr_mode()) mode = sr_mode();
    sigjmp_buf back;
    int signal;
    sr_enter();
    memset(place, 0, sizeof(SR_STATE));
    signal = sigsetjmp(back, 0);
    if (signal != 0) {
        sr_back = NULL;
        sr_restore(mode);
        return SR_SIGNAL + signal;
    }
    sr_back = &back;
    double status = sr_call_init(place, params);
    sr_back = NULL;
    if (sr_mode() != mode) {
        sr_restore(mode);
        status = SR_MODE;
    }
    return status == 0.0 ? sr_take_state(place, state) : status;
}

/* Each call has the form of CasADi's functions, which native code calls by their address: tables of inputs and of
 * outputs. Inputs: place of the state that NODE_init has filled, t in ns, the state, the node's inputs. Outputs:
 * status, the state, the node's outputs. */
#define SR_CALL(name, with_in, with_out, moves, call)                                                                 \
    int name(const double **arg, double **res, long long *iw, double *w, long long mem)                                \
    {                                                                                                                  \
        const double *v = arg[0];                                                                                      \
        double *r = res[0], status;                                                                                    \
        const SR_STATE *first = (const SR_STATE *)(uintptr_t)v[0];                                                     \
        int64_t t_ns = (int64_t)v[1];                                                                                  \
        const __typeof__(sr_mode()) mode = sr_mode();                                                                  \
        SR_STATE s;                                                                                                    \
        SR_IN in;                                                                                                      \
        SR_OUT out;                                                                                                    \
        sigjmp_buf back;                                                                                               \
        int signal;                                                                                                    \
        memcpy(&s, first, sizeof s);                                                                                   \
        (void)iw;                                                                                                      \
        (void)w;                                                                                                       \
        (void)mem;                                                                                                     \
        memset(&in, 0, sizeof in);                                                                                     \
        memset(&out, 0, sizeof out);                                                                                   \
        memset(r, 0, sizeof(double) * (1 + ((moves) ? SR_STATES : 0) + ((with_out) ? SR_OUTS : 0)));                    \
        status = sr_put_state(&s, v + 2);                                                                              \
        if (with_in) {                                                                                                 \
            sr_put_in(&in, v + 2 + SR_STATES);                                                                         \
        }                                                                                                              \
        if (status != 0.0) {                                                                                           \
            r[0] = status;                                                                                             \
            return 0;                                                                                                  \
        }                                                                                                              \
        sr_enter();                                                                                                    \
        signal = sigsetjmp(back, 0);                                                                                   \
        if (signal != 0) {                                                                                             \
            sr_back = NULL;                                                                                            \
            sr_restore(mode);                                                                                          \
            r[0] = SR_SIGNAL + signal;                                                                                 \
            return 0;                                                                                                  \
        }                                                                                                              \
        sr_back = &back;                                                                                               \
        status = call;                                                                                                 \
        sr_back = NULL;                                                                                                \
        if (sr_mode() != mode) {                                                                                       \
            sr_restore(mode);                                                                                          \
            status = SR_MODE;                                                                                          \
        }                                                                                                              \
        if (status == 0.0 && !sr_same_constants(first, &s)) {                                                          \
            status = SR_CONSTANT;                                                                                      \
        }                                                                                                              \
        if (status == 0.0 && (moves)) {                                                                                \
            status = sr_take_state(&s, r + 1);                                                                         \
        }                                                                                                              \
        if (with_out) {                                                                                                \
            sr_take_out(&out, r + 1 + ((moves) ? SR_STATES : 0));                                                      \
        }                                                                                                              \
        r[0] = status;                                                                                                 \
        return 0;                                                                                                      \
    }

SR_CALLS

#ifdef SR_PROGRAM
/* Answers requests on one pair of pipes: which function, its numbers; then its outputs. NODE_init is number -1. */
static int whole(int descriptor, void *bytes, size_t size, int writing)
{
    char *at = bytes;
    while (size > 0) {
        ssize_t done = writing ? write(descriptor, at, size) : read(descriptor, at, size);
        if (done < 0 && errno == EINTR) {
            continue;
        }
        if (done <= 0) {
            return 0;
        }
        at += done;
        size -= (size_t)done;
    }
    return 1;
}

int main(int argc, char **argv)
{
    static double arguments[4 + SR_STATES + SR_INS + SR_PARAMS], results[2 + SR_STATES + SR_OUTS];
    const double *arg[1] = {arguments};
    double *res[1] = {results};
    int reading, writing, which;
    const char *wrong;
    void *place = calloc(1, sizeof(SR_STATE));
    if (argc != 4 || place == NULL) {
        return 2;
    }
    prctl(PR_SET_PDEATHSIG, SIGKILL);
    reading = atoi(argv[2]);
    writing = atoi(argv[3]);
    if ((wrong = sr_load(argv[1], 0)) != NULL) {
        fprintf(stderr, "%s\n", wrong);
        return 2;
    }
    while (whole(reading, &which, sizeof which, 0)) {
        size_t count;
        if (which < 0) {
            if (!whole(reading, arguments, sizeof(double) * SR_PARAMS, 0)) {
                return 0;
            }
            results[0] = sr_init(place, arguments, results + 1);
            count = 1 + SR_STATES;
        } else {
            if (!whole(reading, arguments, sizeof(double) * (size_t)sr_counts[which][0], 0)) {
                return 0;
            }
            arguments[0] = (double)(uintptr_t)place;
            sr_functions[which](arg, res, NULL, NULL, 0);
            count = (size_t)sr_counts[which][1];
        }
        if (!whole(writing, results, sizeof(double) * count, 1)) {
            return 0;
        }
    }
    return 0;
}
#endif
