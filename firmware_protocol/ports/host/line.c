/* A pty that transmits like a serial line: at a limited rate, and with the faults of a script. */

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

bool line_open(struct line *line) {
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
    close(slave); /* from now on a hang-up means that no host has the port open */
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

/* --- rate --- */

/* A late iteration may catch up with what the line would have carried, up to one whole read. */
static size_t available_bytes(struct line_rate *line_rate, uint64_t now_us) {
    line_rate->tokens += (double)(now_us - line_rate->at_us) * 1e-6 * line_rate->bytes_per_s;
    line_rate->tokens = line_rate->tokens > READ_MAX ? READ_MAX : line_rate->tokens;
    line_rate->at_us = now_us;
    return line_rate->tokens > 0 ? (size_t)line_rate->tokens : 0;
}

/* An idle line does not accumulate credit beyond a burst. */
static void cap_credit(struct line_rate *rate) { rate->tokens = rate->tokens > BURST_BYTES ? BURST_BYTES : rate->tokens; }

bool line_can_read(struct line *line, uint64_t now_us) { return available_bytes(&line->in, now_us) > 0; }

/* --- faults --- */

static double random_unit(void) { return (double)random() / ((double)RAND_MAX + 1.0); }

static size_t apply_faults(const struct line *line, uint8_t *bytes, size_t n) {
    size_t received = 0;
    if (line->hung) {
        return 0;
    }
    for (size_t k = 0; k < n; k++) {
        if (line->drop_rate > 0 && random_unit() < line->drop_rate) {
            continue;
        }
        bytes[received] = bytes[k];
        if (line->flip_rate > 0 && random_unit() < line->flip_rate) {
            bytes[received] ^= (uint8_t)(1u << random() % 8);
        }
        received++;
    }
    return received;
}

/* --- bytes --- */

size_t line_read(struct line *line, uint8_t *to, uint64_t now_us, bool last) {
    size_t max_bytes = last ? READ_MAX : available_bytes(&line->in, now_us);
    if (max_bytes == 0) {
        return 0;
    }
    ssize_t n = read(line->master, to, max_bytes);
    if (n <= 0) {
        cap_credit(&line->in);
        return 0; /* empty, or the host has just closed the port, which the next poll reports */
    }
    line->in.tokens -= (double)n;
    if ((size_t)n < max_bytes) {
        cap_credit(&line->in);
    }
    return apply_faults(line, to, (size_t)n);
}

void line_send(struct line *line, const uint8_t *frame, size_t n) {
    if (line->output_count + n > OUT_MAX) {
        return; /* all of the frame or nothing */
    }
    memcpy(line->output + line->output_count, frame, n);
    line->output_count += apply_faults(line, line->output + line->output_count, n);
}

/* A partly sent frame is completed. */
void line_discard_output(struct line *line) {
    const uint8_t *end = line->mid_frame ? memchr(line->output, 0, line->output_count) : NULL;
    line->output_count = end ? (size_t)(end - line->output) + 1 : 0;
}

void line_write(struct line *line, uint64_t now_us) {
    size_t max_bytes = available_bytes(&line->out, now_us);
    max_bytes = max_bytes < line->output_count ? max_bytes : line->output_count;
    if (line->output_count == 0) {
        cap_credit(&line->out);
    }
    if (max_bytes == 0) {
        return;
    }
    ssize_t n = write(line->master, line->output, max_bytes);
    if (n <= 0) {
        return;
    }
    line->out.tokens -= (double)n;
    line->mid_frame = line->output[n - 1] != 0;
    line->output_count -= (size_t)n;
    memmove(line->output, line->output + n, line->output_count);
}
