/* A pty that passes bytes as a serial line does: at its pace, and with the faults a script puts in. */

#define _GNU_SOURCE

#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <stdlib.h>
#include <string.h>
#include <termios.h>
#include <unistd.h>

#include "host.h"

#define BURST_BYTES 64.0

bool line_make(struct line *line) {
    char temporary[4096];
    struct termios raw;
    snprintf(temporary, sizeof temporary, "%s.new", line->path);
    line->master = posix_openpt(O_RDWR | O_NOCTTY | O_CLOEXEC | O_NONBLOCK);
    if (line->master < 0 || grantpt(line->master) || unlockpt(line->master)) {
        return false;
    }
    const char *name = ptsname(line->master);
    int slave = name ? open(name, O_RDWR | O_NOCTTY | O_CLOEXEC) : -1;
    if (slave < 0) {
        return false;
    }
    tcgetattr(slave, &raw);
    cfmakeraw(&raw);
    tcsetattr(slave, TCSANOW, &raw);
    unlink(temporary);
    bool linked = symlink(name, temporary) == 0 && rename(temporary, line->path) == 0;
    close(slave); /* from here on a hang-up means that no host has the port open */
    return linked;
}

void line_close(struct line *line) {
    close(line->master);
    line->master = -1;
}

bool line_hung_up(const struct line *line) {
    struct pollfd look = {.fd = line->master, .events = POLLIN};
    return poll(&look, 1, 0) > 0 && look.revents & POLLHUP;
}

/* --- pace --- */

/* A late turn may catch up on what the line would have carried meanwhile, up to a whole read. */
static size_t allowed(struct pace *pace, uint64_t now_us) {
    pace->tokens += (double)(now_us - pace->at_us) * 1e-6 * pace->bytes_per_s;
    pace->tokens = pace->tokens > READ_MAX ? READ_MAX : pace->tokens;
    pace->at_us = now_us;
    return pace->tokens > 0 ? (size_t)pace->tokens : 0;
}

/* Nothing waits to pass: a line saves nothing up. */
static void idle(struct pace *pace) { pace->tokens = pace->tokens > BURST_BYTES ? BURST_BYTES : pace->tokens; }

bool line_may_read(struct line *line, uint64_t now_us) { return allowed(&line->in, now_us) > 0; }

/* --- faults --- */

static double chance(void) { return (double)random() / ((double)RAND_MAX + 1.0); }

static size_t carry(const struct line *line, uint8_t *bytes, size_t n) {
    size_t kept = 0;
    if (line->hung) {
        return 0;
    }
    for (size_t k = 0; k < n; k++) {
        if (line->drop_rate > 0 && chance() < line->drop_rate) {
            continue;
        }
        bytes[kept] = bytes[k];
        if (line->flip_rate > 0 && chance() < line->flip_rate) {
            bytes[kept] ^= (uint8_t)(1u << random() % 8);
        }
        kept++;
    }
    return kept;
}

/* --- bytes --- */

size_t line_read(struct line *line, uint8_t *to, uint64_t now_us, bool last) {
    size_t most = last ? READ_MAX : allowed(&line->in, now_us);
    if (most == 0) {
        return 0;
    }
    ssize_t n = read(line->master, to, most);
    if (n <= 0) {
        idle(&line->in);
        return 0; /* nothing there, or the host has just closed: the next look at the port tells */
    }
    line->in.tokens -= (double)n;
    if ((size_t)n < most) {
        idle(&line->in);
    }
    return carry(line, to, (size_t)n);
}

void line_send(struct line *line, const uint8_t *frame, size_t n) {
    if (line->waiting_count + n > OUT_MAX) {
        return; /* whole or not at all */
    }
    memcpy(line->waiting + line->waiting_count, frame, n);
    line->waiting_count += carry(line, line->waiting + line->waiting_count, n);
}

/* A frame that has begun to leave goes to its end. */
void line_forget(struct line *line) {
    const uint8_t *end = line->mid_frame ? memchr(line->waiting, 0, line->waiting_count) : NULL;
    line->waiting_count = end ? (size_t)(end - line->waiting) + 1 : 0;
}

void line_write(struct line *line, uint64_t now_us) {
    size_t most = allowed(&line->out, now_us);
    most = most < line->waiting_count ? most : line->waiting_count;
    if (line->waiting_count == 0) {
        idle(&line->out);
    }
    if (most == 0) {
        return;
    }
    ssize_t n = write(line->master, line->waiting, most);
    if (n <= 0) {
        return;
    }
    line->out.tokens -= (double)n;
    line->mid_frame = line->waiting[n - 1] != 0;
    line->waiting_count -= (size_t)n;
    memmove(line->waiting, line->waiting + n, line->waiting_count);
}
