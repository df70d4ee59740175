/* A machine whose clock is set, for every process that loads this: CLOCK_REALTIME and all that waits by it is shifted by
   the nanoseconds in the file CLOCK_OFFSET_FILE. Monotonic clocks go on as they are. */
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

#define SECOND 1000000000LL
static volatile int64_t *offset;

__attribute__((constructor)) static void open_offset(void) {
  const char *path = getenv("CLOCK_OFFSET_FILE");
  int file = path ? open(path, O_RDONLY | O_CLOEXEC) : -1;
  if (file < 0) return;
  void *page = mmap(NULL, sizeof(int64_t), PROT_READ, MAP_SHARED, file, 0);
  if (page != MAP_FAILED) offset = page;
  close(file);
}

static int64_t shift(void) { return offset ? *offset : 0; }

static void add(struct timespec *at, int64_t ns) {
  int64_t all = at->tv_sec * SECOND + at->tv_nsec + ns;
  at->tv_sec = all / SECOND;
  at->tv_nsec = all % SECOND;
}

/* An absolute time that a caller has made from a shifted clock, as the kernel knows it; small ones are monotonic. */
static struct timespec real(const struct timespec *asked) {
  struct timespec at = *asked;
  if (at.tv_sec > 500000000) add(&at, -shift());
  return at;
}

int clock_gettime(clockid_t id, struct timespec *at) {
  int answer = syscall(SYS_clock_gettime, id, at);
  if (answer == 0 && (id == CLOCK_REALTIME || id == CLOCK_REALTIME_COARSE)) add(at, shift());
  return answer;
}

int gettimeofday(struct timeval *restrict at, void *restrict zone) {
  struct timespec now;
  (void)zone;
  clock_gettime(CLOCK_REALTIME, &now);
  at->tv_sec = now.tv_sec;
  at->tv_usec = now.tv_nsec / 1000;
  return 0;
}

time_t time(time_t *out) {
  struct timespec now;
  clock_gettime(CLOCK_REALTIME, &now);
  if (out) *out = now.tv_sec;
  return now.tv_sec;
}

#define NEXT(name) static __typeof__(&name) next; if (!next) next = (__typeof__(&name))dlsym(RTLD_NEXT, #name)

int sem_timedwait(sem_t *restrict semaphore, const struct timespec *restrict until) {
  NEXT(sem_timedwait);
  struct timespec at = real(until);
  return next(semaphore, &at);
}

int pthread_mutex_timedlock(pthread_mutex_t *restrict mutex, const struct timespec *restrict until) {
  NEXT(pthread_mutex_timedlock);
  struct timespec at = real(until);
  return next(mutex, &at);
}

int pthread_cond_timedwait(pthread_cond_t *restrict cond, pthread_mutex_t *restrict mutex,
                           const struct timespec *restrict until) {
  static __typeof__(&pthread_cond_timedwait) next;
  if (!next) next = (__typeof__(next))dlvsym(RTLD_NEXT, "pthread_cond_timedwait", "GLIBC_2.3.2");
  if (!next) next = (__typeof__(next))dlsym(RTLD_NEXT, "pthread_cond_timedwait");
  struct timespec at = real(until);
  return next(cond, mutex, &at);
}

int clock_nanosleep(clockid_t id, int flags, const struct timespec *asked, struct timespec *left) {
  NEXT(clock_nanosleep);
  struct timespec at = (flags & TIMER_ABSTIME) && id == CLOCK_REALTIME ? real(asked) : *asked;
  return next(id, flags, &at, left);
}
