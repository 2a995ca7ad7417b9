/* Preloaded: the system's clock as the file of FAKE_CLOCK steps it. The eight bytes there are nanoseconds ahead.
   Waits for an instant of that clock end as the kernel's would, looked at every 20 ms. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <pthread.h>
#include <semaphore.h>
#include <stdint.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/syscall.h>
#include <sys/time.h>
#include <time.h>
#include <unistd.h>

enum { NANO = 1000000000, SLICE = 20000000 };
static volatile int64_t *ahead;

static int64_t real(void) {
  struct timespec now;
  syscall(SYS_clock_gettime, CLOCK_REALTIME, &now);
  return now.tv_sec * (int64_t)NANO + now.tv_nsec;
}

static int64_t stepped(void) { return real() + (ahead ? *ahead : 0); }

static struct timespec spec(int64_t t) { return (struct timespec){t / NANO, t % NANO}; }

__attribute__((constructor)) static void begin(void) {
  const char *name = getenv("FAKE_CLOCK");
  int file = name ? open(name, O_RDONLY | O_CLOEXEC) : -1;
  if (file < 0) return;
  void *found = mmap(0, sizeof *ahead, PROT_READ, MAP_SHARED, file, 0);
  if (found != MAP_FAILED) ahead = found;
  close(file);
}

int clock_gettime(clockid_t clock, struct timespec *now) {
  if (clock != CLOCK_REALTIME && clock != CLOCK_REALTIME_COARSE) return syscall(SYS_clock_gettime, clock, now);
  *now = spec(stepped());
  return 0;
}

int gettimeofday(struct timeval *now, void *zone) {
  (void)zone;
  int64_t t = stepped();
  *now = (struct timeval){t / NANO, t % NANO / 1000};
  return 0;
}

time_t time(time_t *now) {
  time_t t = stepped() / NANO;
  return now ? *now = t : t;
}

/* An instant that is no time since 1970 is one of a condition that counts from the start of the machine. */
#define WAITING(CALL, OVER)                                                           \
  int64_t end = until->tv_sec * (int64_t)NANO + until->tv_nsec;                       \
  struct timespec slice = *until;                                                     \
  if (until->tv_sec < 1000000000) return CALL;                                        \
  for (;;) {                                                                          \
    int64_t left = end - stepped();                                                   \
    slice = spec(real() + (left < SLICE ? left : SLICE));                             \
    int status = CALL;                                                                \
    if (!(OVER) || stepped() >= end) return status;                                   \
  }

int pthread_cond_timedwait(pthread_cond_t *condition, pthread_mutex_t *mutex, const struct timespec *until) {
  static int (*of)(pthread_cond_t *, pthread_mutex_t *, const struct timespec *);
  if (!of) of = dlvsym(RTLD_NEXT, "pthread_cond_timedwait", "GLIBC_2.3.2");
  if (!of) of = dlsym(RTLD_NEXT, "pthread_cond_timedwait");
  WAITING(of(condition, mutex, &slice), status == ETIMEDOUT)
}

int pthread_mutex_timedlock(pthread_mutex_t *mutex, const struct timespec *until) {
  static int (*of)(pthread_mutex_t *, const struct timespec *);
  if (!of) of = dlsym(RTLD_NEXT, "pthread_mutex_timedlock");
  WAITING(of(mutex, &slice), status == ETIMEDOUT)
}

int sem_timedwait(sem_t *semaphore, const struct timespec *until) {
  static int (*of)(sem_t *, const struct timespec *);
  if (!of) of = dlsym(RTLD_NEXT, "sem_timedwait");
  WAITING(of(semaphore, &slice), status && errno == ETIMEDOUT)
}
