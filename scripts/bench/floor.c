/* The floor of punctuality: a loop that does nothing at each tick of a period, by absolute sleeps.
   Arguments: period in ns, number of ticks. Prints the share of late ticks, and p50 and p99 of the lateness in us. */
#define _GNU_SOURCE
#include <sched.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/prctl.h>
#include <time.h>

static long now(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec * 1000000000L + t.tv_nsec;
}

static int compare(const void *a, const void *b) {
    long x = *(const long *)a, y = *(const long *)b;
    return (x > y) - (x < y);
}

int main(int count, char **words) {
    if (count != 3) return 2;
    long period = atol(words[1]), ticks = atol(words[2]), late = 0, *by = malloc(ticks * sizeof *by);
    struct sched_param lowest = {1};
    prctl(PR_SET_TIMERSLACK, 1UL, 0, 0, 0);
    sched_setscheduler(0, SCHED_FIFO, &lowest); /* as the thread of native ticks: without it where it is not allowed */
    long start = now() + 1000000;
    for (long k = 0; k < ticks; k++) {
        long due = start + k * period;
        struct timespec until = {due / 1000000000L, due % 1000000000L};
        while (now() < due) clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &until, 0);
        by[k] = now() - due;
        late += by[k] >= period;
    }
    qsort(by, ticks, sizeof *by, compare);
    printf("%.6f %.3f %.3f\n", (double)late / ticks, by[ticks / 2] / 1e3, by[ticks * 99 / 100] / 1e3);
    return 0;
}
