/* The board as a Linux process: options, files, a pty with rate and faults of a serial line, a log, the core's HAL. */

#ifndef HOST_H
#define HOST_H

#include <stdio.h>

#include "board.h"

#define PROGRAM "board"
#define STEPS_MAX 1000u

/* --- files: the subset of TOML that limits and scripts use --- */

enum toml_kind { TOML_INTEGER, TOML_FLOAT, TOML_BOOLEAN, TOML_STRING };

struct toml_entry {
    unsigned table; /* 0: top level; n: the n-th [[step]] */
    enum toml_kind kind;
    double number;
    long long integer;
    bool boolean;
    char key[32], text[64], raw[64];
};

struct toml {
    struct toml_entry entries[4 * STEPS_MAX];
    size_t count;
    unsigned tables;
};

/* Prints one line on stderr (place, value, expected) and exits with status 2. */
_Noreturn void bad_input(const char *where, const char *value, const char *expected);
void toml_read(struct toml *toml, const char *path);
const struct toml_entry *toml_find(const struct toml *toml, unsigned table, const char *key);

void settings_default(struct board_config *config);
void settings_read(struct board_config *config, const char *path);

enum step_kind {
    STEP_SET,
    STEP_FLIP_BITS,
    STEP_DROP_BYTES,
    STEP_HANG,
    STEP_REPAIR,
    STEP_RESET,
    STEP_CLOSE,
    STEP_STOP_LOOP,  /* stops the main loop until the watchdog resets */
    STEP_STOP_TICK,  /* stops the safety tick until the watchdog resets */
    STEP_LATE_TICK,  /* delays the safety tick by a millisecond */
    STEP_STICK_GATE, /* freezes the gate's readback until repair */
    STEP_TRIGGER,    /* an edge at the trigger input */
    STEP_SILENCE_HEAD, /* the scan head returns no status until repair */
    STEP_FAIL_HEAD,    /* its status says that its power is not in order, until repair */
    STEP_STICK_MIRROR, /* mirror x stays where it is, until repair */
    STEP_SLOW_MIRROR,  /* mirror x arrives MIRROR_SLOW_US after a move, until repair */
    STEP_UNPLUG_MIRROR, /* the position output of mirror x is disconnected, until repair */
};

struct step {
    uint64_t at_us;
    enum step_kind kind;
    uint8_t input; /* INPUT_ bit */
    bool value;
    bool waits; /* for a signal, not for at_us */
    double rate;
};

struct script {
    struct step steps[STEPS_MAX];
    size_t count, next;
    struct step signalled[STEPS_MAX]; /* in the order of the file; each SIGUSR1 carries out the next one */
    size_t signalled_count, signalled_next;
    int signals_seen;
};

void script_read(struct script *script, const char *path);
const char *input_name(uint8_t bit);

/* --- log --- */

struct log {
    int fd;             /* -1: none */
    const char *failed; /* error of the last write, NULL if none */
};

void log_trace(struct log *log, const struct board_trace *event);
void log_input(struct log *log, uint64_t at_us, const char *name, bool value);
void log_trigger(struct log *log, uint64_t at_us, uint32_t count);
void log_port(struct log *log, uint64_t at_us, bool open);
void log_lease(struct log *log, uint64_t at_us, uint64_t until_us);

/* --- line --- */

#define OUT_MAX 262144u
#define READ_MAX 4096u

struct line_rate {
    double bytes_per_s, tokens;
    uint64_t at_us;
};

struct line {
    const char *path;
    int master;
    bool open, was_open, mid_frame;
    uint64_t closed_since_us;
    struct line_rate in, out;
    double drop_rate, flip_rate;
    bool hung;
    uint8_t output[OUT_MAX];
    size_t output_count;
};

/* Returns false and sets errno if no pty is available. */
bool line_open(struct line *line);
void line_close(struct line *line);
bool line_hung_up(const struct line *line);
/* Reads up to READ_MAX bytes at the line's rate; 0 if there are none. last: without rate limit. */
size_t line_read(struct line *line, uint8_t *to, uint64_t now_us, bool last);
void line_send(struct line *line, const uint8_t *frame, size_t n);
void line_discard_output(struct line *line);
void line_write(struct line *line, uint64_t now_us);
bool line_can_read(struct line *line, uint64_t now_us);

/* --- the port --- */

struct port {
    struct board board;
    struct board_config config;
    struct board_hal hal;
    struct line line;
    struct script script;
    struct log log;
    uint64_t started_ns, at_us, watchdog_fed_us, ticks_resume_us;
    uint64_t exit_when_closed_us; /* UINT64_MAX: never */
    uint8_t inputs;
    uint32_t triggers; /* edges so far */
    uint64_t trigger_us;
    uint16_t head; /* its status, 0: silent */
    uint16_t x, y, from_x, stuck_x;
    uint64_t moved_us;
    enum step_kind mirror_fault; /* STEP_SET: none */
    bool gate_on, readback_stuck, readback_value, loop_stopped, tick_stopped;
};

/* Runs until a signal, a long close of the port, or a log error; then disarms. */
void port_run(struct port *port);

#endif
