/* The log: a line of JSON for each event, written at once, so that it is there whatever ends the process. */

#include <errno.h>
#include <inttypes.h>
#include <stdarg.h>
#include <string.h>
#include <unistd.h>

#include "host.h"

static const char *const STATES[STATE_COUNT] = STATE_NAMES;
static const char *const FAULTS[FAULT_COUNT] = FAULT_NAMES;
static const char *const REASONS[REASON_COUNT] = REASON_NAMES;

static const char *json_boolean(bool value) { return value ? "true" : "false"; }

__attribute__((format(printf, 4, 5))) static void write_line(struct log *log, uint64_t at_us, const char *event,
                                                             const char *format, ...) {
    char line[400];
    va_list arguments;
    if (log->fd < 0) {
        return;
    }
    int n = snprintf(line, sizeof line, "{\"t_us\": %" PRIu64 ", \"event\": \"%s\", ", at_us, event);
    va_start(arguments, format);
    n += vsnprintf(line + n, sizeof line - (size_t)n, format, arguments);
    va_end(arguments);
    n += snprintf(line + n, sizeof line - (size_t)n, "}\n");
    ssize_t written;
    do {
        errno = 0;
        written = write(log->fd, line, (size_t)n);
    } while (written < 0 && errno == EINTR);
    if (written != n) {
        log->failed = errno ? strerror(errno) : "no room";
        log->fd = -1;
    }
}

static void write_gate(struct log *log, const struct board_trace *what) {
    char reason[40];
    if (what->is_point) {
        snprintf(reason, sizeof reason, "point %" PRIu32 "%s", what->index, what->on ? "" : " done");
    } else {
        snprintf(reason, sizeof reason, "%s", what->reason ? REASONS[what->reason] : "reset");
    }
    write_line(log, what->at_us, "gate", "\"on\": %s, \"reason\": \"%s\"", json_boolean(what->on), reason);
}

void log_trace(struct log *log, const struct board_trace *what) {
    switch (what->kind) {
    case TRACE_GATE:
        write_gate(log, what);
        break;
    case TRACE_STATE:
        write_line(log, what->at_us, "state", "\"state\": \"%s\", \"before\": \"%s\", \"reason\": \"%s\"",
                   STATES[what->state], STATES[what->before], REASONS[what->reason]);
        break;
    case TRACE_FAULT:
        write_line(log, what->at_us, "fault", "\"fault\": \"%s\"", FAULTS[what->fault]);
        break;
    case TRACE_PULSE:
        write_line(log, what->at_us, "pulse",
                   "\"index\": %" PRIu32 ", \"x\": %u, \"y\": %u, \"duty\": %u, \"on_us\": %" PRIu64
                   ", \"off_us\": %" PRIu64,
                   what->index, what->x, what->y, what->duty, what->on_us, what->off_us);
        break;
    case TRACE_RX_ERROR:
        write_line(log, what->at_us, "rx_error", "\"bad_frames\": %" PRIu32, what->index);
        break;
    }
}

void log_input(struct log *log, uint64_t at_us, const char *name, bool value) {
    write_line(log, at_us, "input", "\"input\": \"%s\", \"value\": %s", name, json_boolean(value));
}

void log_port(struct log *log, uint64_t at_us, bool open) {
    write_line(log, at_us, "port", "\"open\": %s", json_boolean(open));
}
