/* The log: one line of JSON per event, written immediately so that it survives any end of the process. */

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

static void write_gate(struct log *log, const struct board_trace *event) {
    char reason[40];
    if (event->is_point) {
        snprintf(reason, sizeof reason, "point %" PRIu32 "%s", event->index, event->on ? "" : " done");
    } else {
        snprintf(reason, sizeof reason, "%s", event->reason ? REASONS[event->reason] : "reset");
    }
    write_line(log, event->at_us, "gate", "\"on\": %s, \"reason\": \"%s\"", json_boolean(event->on), reason);
}

void log_trace(struct log *log, const struct board_trace *event) {
    switch (event->kind) {
    case TRACE_GATE:
        write_gate(log, event);
        break;
    case TRACE_STATE:
        write_line(log, event->at_us, "state", "\"state\": \"%s\", \"before\": \"%s\", \"reason\": \"%s\"",
                   STATES[event->state], STATES[event->before], REASONS[event->reason]);
        break;
    case TRACE_FAULT:
        write_line(log, event->at_us, "fault", "\"fault\": \"%s\"", FAULTS[event->fault]);
        break;
    case TRACE_PULSE:
        write_line(log, event->at_us, "pulse",
                   "\"index\": %" PRIu32 ", \"x\": %u, \"y\": %u, \"duty\": %u, \"on_us\": %" PRIu64
                   ", \"off_us\": %" PRIu64,
                   event->index, event->x, event->y, event->duty, event->on_us, event->off_us);
        break;
    case TRACE_RX_ERROR:
        write_line(log, event->at_us, "rx_error", "\"bad_frames\": %" PRIu32, event->index);
        break;
    }
}

void log_input(struct log *log, uint64_t at_us, const char *name, bool value) {
    write_line(log, at_us, "input", "\"input\": \"%s\", \"value\": %s", name, json_boolean(value));
}

void log_trigger(struct log *log, uint64_t at_us, uint32_t count) {
    write_line(log, at_us, "trigger", "\"count\": %" PRIu32, count);
}

void log_port(struct log *log, uint64_t at_us, bool open) {
    write_line(log, at_us, "port", "\"open\": %s", json_boolean(open));
}

void log_lease(struct log *log, uint64_t at_us, uint64_t until_us) {
    write_line(log, at_us, "lease", "\"until_us\": %" PRIu64, until_us);
}
