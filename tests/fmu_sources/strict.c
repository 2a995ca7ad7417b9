/* What keeps to the letter of the FMI, and what does what no FMU should; y = u + n, n discrete. */
#include <signal.h>
#include <unistd.h>
enum { u, n, y, tolerance, mode, fault, pid, N };
static const double initial[N] = {0, 0, 0, -1, 0, 0, 0};
enum { NX = 0, NZ = 0 };
#define TOLERANCE(r, known, value) (r)[tolerance] = (known) ? (value) : -1
#define MODE(r, now) (r)[mode] = (now)
#define REFUSES(r, vr) ((vr) == n && (r)[mode] == 2) /* in continuous time */
#define ENDS(r) ((r)[fault] == 6)

static void derivatives(const double *r, double *dx) {}
static void indicators(const double *r, double *z) {}
static void event(double *r) {}
static void outputs(double *r) { r[y] = r[u] + r[n]; }

static int step(double *r, double t, double h) {
    if (r[fault] == 7)
        for (int k = 0; k < 1024; k++) close(k);
    if (r[fault] == 8) { /* a process that nobody knows: its parent has ended, its session is its own */
        int ends[2], found;
        pipe(ends);
        if (!fork()) {
            setsid();
            found = fork();
            if (!found) for (;;) pause();
            write(ends[1], &found, sizeof found);
            _exit(0);
        }
        read(ends[0], &found, sizeof found);
        r[pid] = found;
        r[fault] = 0;
    }
    return r[fault] == 6 ? 2 : 0;
}
