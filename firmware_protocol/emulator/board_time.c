/* A computer whose monotonic clock is a board's: preloaded into a program, it answers clock_gettime from the file that BOARD_TIME
   names, 8 bytes of nanoseconds that the board's process writes, and lets each wait with a time-out last by that clock.

   A wait ends with its event at once, and with its time-out within WAIT_NS of the computer's time. Unix time is the computer's. */

#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <pthread.h>
#include <semaphore.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/mman.h>
#include <sys/select.h>
#include <time.h>
#include <unistd.h>

#define WAIT_NS 1000000L
#define WAIT_MS 1
#define SECOND_NS 1000000000L
#define UNIX_TIME_S 1000000000L /* what is later is Unix time; a monotonic clock is not that old */

static const volatile uint64_t *board_ns;

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))

__attribute__((constructor)) static void open_time(void) {
    int file = open(getenv("BOARD_TIME"), O_RDONLY | O_CLOEXEC);
    board_ns = mmap(NULL, sizeof *board_ns, PROT_READ, MAP_SHARED, file, 0);
    if (board_ns == MAP_FAILED) {
        abort();
    }
    close(file);
}

static int is_monotonic(clockid_t clock) {
    return clock == CLOCK_MONOTONIC || clock == CLOCK_MONOTONIC_RAW || clock == CLOCK_MONOTONIC_COARSE || clock == CLOCK_BOOTTIME;
}

static struct timespec to_timespec(uint64_t ns) {
    return (struct timespec){(time_t)(ns / SECOND_NS), (long)(ns % SECOND_NS)};
}

static uint64_t to_ns(const struct timespec *time) { return (uint64_t)time->tv_sec * SECOND_NS + (uint64_t)time->tv_nsec; }

/* The computer's time at which a wait looks at the board's again. */
static struct timespec next_look(void) {
    struct timespec now;
    REAL(clock_gettime)(CLOCK_MONOTONIC, &now);
    return to_timespec(to_ns(&now) + WAIT_NS);
}

int clock_gettime(clockid_t clock, struct timespec *time) {
    if (!is_monotonic(clock)) {
        return REAL(clock_gettime)(clock, time);
    }
    *time = to_timespec(*board_ns);
    return 0;
}

static int sleep_until(uint64_t until_ns) {
    while (*board_ns < until_ns) {
        struct timespec look = to_timespec(WAIT_NS);
        if (REAL(nanosleep)(&look, NULL) != 0) {
            return errno;
        }
    }
    return 0;
}

int clock_nanosleep(clockid_t clock, int flags, const struct timespec *time, struct timespec *left) {
    if (!is_monotonic(clock)) {
        return REAL(clock_nanosleep)(clock, flags, time, left);
    }
    return sleep_until(to_ns(time) + (flags & TIMER_ABSTIME ? 0 : *board_ns));
}

int nanosleep(const struct timespec *time, struct timespec *left) {
    int error = sleep_until(*board_ns + to_ns(time));
    if (error && left) {
        *left = to_timespec(0);
    }
    errno = error;
    return error ? -1 : 0;
}

int poll(struct pollfd *files, nfds_t count, int timeout_ms) {
    uint64_t until_ns = *board_ns + (uint64_t)timeout_ms * 1000000u;
    for (;;) {
        int ready = REAL(poll)(files, count, timeout_ms > 0 ? WAIT_MS : timeout_ms);
        if (ready != 0 || timeout_ms <= 0 || *board_ns >= until_ns) {
            return ready;
        }
    }
}

int epoll_wait(int epoll, struct epoll_event *events, int count, int timeout_ms) {
    uint64_t until_ns = *board_ns + (uint64_t)timeout_ms * 1000000u;
    for (;;) {
        int ready = REAL(epoll_wait)(epoll, events, count, timeout_ms > 0 ? WAIT_MS : timeout_ms);
        if (ready != 0 || timeout_ms <= 0 || *board_ns >= until_ns) {
            return ready;
        }
    }
}

static fd_set copy_of(const fd_set *set) {
    fd_set copy;
    FD_ZERO(&copy);
    return set ? *set : copy;
}

int select(int count, fd_set *reads, fd_set *writes, fd_set *others, struct timeval *timeout) {
    if (!timeout) {
        return REAL(select)(count, reads, writes, others, timeout);
    }
    fd_set requested[3] = {copy_of(reads), copy_of(writes), copy_of(others)};
    fd_set *sets[3] = {reads, writes, others};
    uint64_t until_ns = *board_ns + (uint64_t)timeout->tv_sec * SECOND_NS + (uint64_t)timeout->tv_usec * 1000u;
    for (;;) {
        int is_over = *board_ns >= until_ns;
        struct timeval look = {0, is_over ? 0 : WAIT_NS / 1000};
        for (int k = 0; k < 3; k++) {
            if (sets[k]) {
                *sets[k] = requested[k];
            }
        }
        int ready = REAL(select)(count, reads, writes, others, &look);
        if (ready != 0 || is_over) {
            return ready;
        }
    }
}

int sem_clockwait(sem_t *semaphore, clockid_t clock, const struct timespec *until) {
    if (!is_monotonic(clock)) {
        return REAL(sem_clockwait)(semaphore, clock, until);
    }
    for (;;) {
        int is_over = *board_ns >= to_ns(until);
        struct timespec look = next_look();
        if (REAL(sem_clockwait)(semaphore, CLOCK_MONOTONIC, &look) == 0) {
            return 0;
        }
        if (errno != ETIMEDOUT || is_over) {
            return -1;
        }
    }
}

static int wait_for_condition(pthread_cond_t *condition, pthread_mutex_t *mutex, const struct timespec *until) {
    int is_over = *board_ns >= to_ns(until);
    struct timespec look = next_look();
    int error = REAL(pthread_cond_clockwait)(condition, mutex, CLOCK_MONOTONIC, &look);
    return error == ETIMEDOUT && !is_over ? 0 : error; /* a spurious wake-up, which every caller expects */
}

int pthread_cond_clockwait(pthread_cond_t *condition, pthread_mutex_t *mutex, clockid_t clock, const struct timespec *until) {
    return is_monotonic(clock) ? wait_for_condition(condition, mutex, until)
                               : REAL(pthread_cond_clockwait)(condition, mutex, clock, until);
}

int pthread_cond_timedwait(pthread_cond_t *condition, pthread_mutex_t *mutex, const struct timespec *until) {
    return until->tv_sec < UNIX_TIME_S ? wait_for_condition(condition, mutex, until)
                                       : REAL(pthread_cond_timedwait)(condition, mutex, until);
}
