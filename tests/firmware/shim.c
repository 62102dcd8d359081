/* Test shim of the core: a HAL of arrays and a clock under the test's control. */

#include <stdlib.h>
#include <string.h>

#include "core.h"

#define OUT_MAX (1u << 20)
#define TRACES_MAX (1u << 16)
#define EDGES_MAX (1u << 16)
#define ENTROPY_MAX 256u

struct edge {
    uint64_t at_us; /* time of the core's call, not the time that it logs */
    uint32_t on;
    uint32_t duty;
};

struct shim {
    struct board board;
    uint64_t now_us, fed_us;
    uint8_t inputs;
    uint8_t stuck, stuck_on, gate_on, indicator, relay, interrupted;
    uint16_t x, y, head; /* head: its status, 0: silent */
    uint16_t from_x, stuck_x;
    uint64_t moved_us;
    uint32_t mirror_fault; /* of MIRROR_FAULTS in measured_mirrors.py, from 1; 0: none */
    uint32_t triggers;
    uint64_t trigger_us;
    uint8_t out[OUT_MAX];
    size_t out_length;
    struct board_trace traces[TRACES_MAX];
    size_t traces_count;
    struct edge edges[EDGES_MAX];
    size_t edges_count;
    uint32_t entropy[ENTROPY_MAX];
    size_t entropy_at, entropy_count;
    struct board_hal hal;
    struct board_config config;
};

static void set_gate(void *context, bool on, uint16_t duty) {
    struct shim *s = context;
    if (s->gate_on != on && s->edges_count < EDGES_MAX) {
        s->edges[s->edges_count++] = (struct edge){s->now_us, on, duty};
    }
    s->gate_on = on;
}
static bool read_gate(void *context) {
    struct shim *s = context;
    return s->stuck ? s->stuck_on : s->gate_on;
}
static void move_mirrors(void *context, uint16_t x, uint16_t y) {
    struct shim *s = context;
    s->from_x = s->x;
    s->moved_us = s->now_us;
    s->x = x;
    s->y = y;
}
static uint8_t read_inputs(void *context) { return ((struct shim *)context)->inputs; }
static uint32_t read_triggers(void *context, uint64_t *last_us) {
    const struct shim *s = context;
    bool is_pending = s->triggers > 0 && s->now_us <= s->trigger_us; /* a tick at the very time of the edge misses it */
    *last_us = is_pending ? *last_us : s->trigger_us;
    return s->triggers - is_pending;
}
static bool read_head(void *context, uint16_t *status) {
    *status = ((struct shim *)context)->head;
    return *status != 0;
}
static uint16_t mirror_x(const struct shim *s) {
    return s->mirror_fault == 1 ? s->stuck_x : s->mirror_fault == 2 && s->now_us < s->moved_us + 20000 ? s->from_x : s->x;
}
static void read_position(void *context, int32_t *x, int32_t *y) {
    const struct shim *s = context;
    *x = s->mirror_fault == 3 ? 72000 : mirror_x(s);
    *y = s->y;
}
static void set_indicator(void *context, bool on) { ((struct shim *)context)->indicator = on; }
static void set_relay(void *context, bool closed) { ((struct shim *)context)->relay = closed; }
static uint32_t read_entropy(void *context) {
    struct shim *s = context;
    return s->entropy_count ? s->entropy[s->entropy_at++ % s->entropy_count] : 1;
}
static int16_t read_temperature_dc(void *context) {
    (void)context;
    return 250;
}
static void send(void *context, const uint8_t *frame, size_t length) {
    struct shim *s = context;
    if (s->out_length + length <= OUT_MAX) {
        memcpy(s->out + s->out_length, frame, length);
        s->out_length += length;
    }
}
static void discard_output(void *context) { ((struct shim *)context)->out_length = 0; }
static void feed_watchdog(void *context) {
    struct shim *s = context;
    s->fed_us = s->now_us;
}
/* An interrupt that has waited runs as soon as the main loop lets it. */
static void hold_tick(void *context, bool hold) {
    struct shim *s = context;
    if (s->interrupted && !hold) {
        board_tick(&s->board, s->now_us);
    }
}
static void trace(void *context, const struct board_trace *event) {
    struct shim *s = context;
    if (s->traces_count < TRACES_MAX) {
        s->traces[s->traces_count++] = *event;
    }
}

struct shim *shim_new(const uint8_t *limits, const uint8_t *uid, uint32_t cell_codes, uint32_t queue_points,
                      uint32_t cells, uint32_t window_pulses, uint32_t key_edge, uint32_t interface,
                      uint32_t feedback_codes) {
    struct shim *s = calloc(1, sizeof *s);
    s->head = 0xfdfdu;
    s->inputs = INPUT_INTERLOCK | INPUT_KEY;
    s->hal = (struct board_hal){.context = s,
                                .set_gate = set_gate,
                                .read_gate = read_gate,
                                .move_mirrors = move_mirrors,
                                .has_exact_widths = true,
                                .read_inputs = read_inputs,
                                .read_head = read_head,
                                .read_position = read_position,
                                .read_triggers = read_triggers,
                                .set_indicator = set_indicator,
                                .set_relay = set_relay,
                                .read_entropy = read_entropy,
                                .read_temperature_dc = read_temperature_dc,
                                .send = send,
                                .discard_output = discard_output,
                                .feed_watchdog = feed_watchdog,
                                .hold_tick = hold_tick,
                                .trace = trace};
    limits_decode(&s->config.limits, limits);
    memcpy(s->config.uid, uid, sizeof s->config.uid);
    s->config.firmware = 0x00010000u;
    s->config.cell_codes = (uint16_t)cell_codes;
    s->config.queue_points = (uint16_t)queue_points;
    s->config.cells = (uint16_t)cells;
    s->config.window_pulses = (uint16_t)window_pulses;
    s->config.key_edge = key_edge;
    s->config.interface = (uint8_t)interface;
    s->config.feedback_codes = (uint16_t)feedback_codes;
    return s;
}

void shim_interrupt(struct shim *s, uint32_t interrupted) { s->interrupted = (uint8_t)interrupted; }

void shim_free(struct shim *s) { free(s); }

void shim_entropy(struct shim *s, const uint32_t *values, size_t count) {
    s->entropy_count = count < ENTROPY_MAX ? count : ENTROPY_MAX;
    memcpy(s->entropy, values, s->entropy_count * sizeof *values);
    s->entropy_at = 0;
}

void shim_init(struct shim *s, uint32_t cause, uint64_t now_us) {
    s->now_us = now_us;
    board_init(&s->board, &s->hal, &s->config, cause, now_us);
}

void shim_tick(struct shim *s, uint64_t now_us) {
    s->now_us = now_us;
    board_tick(&s->board, now_us);
}

/* Runs punctual ticks up to now_us. */
void shim_run(struct shim *s, uint64_t now_us) {
    while (s->now_us + BOARD_TICK_US < now_us) {
        shim_tick(s, s->now_us + BOARD_TICK_US);
    }
    shim_tick(s, now_us);
}

void shim_loop(struct shim *s, uint64_t now_us) {
    uint8_t interrupted = s->interrupted;
    s->now_us = now_us;
    s->interrupted = false; /* no ticks */
    board_receive(&s->board, NULL, 0, now_us);
    s->interrupted = interrupted;
}

void shim_receive(struct shim *s, const uint8_t *bytes, size_t n) { board_receive(&s->board, bytes, n, s->now_us); }
void shim_link_lost(struct shim *s) { board_on_link_lost(&s->board, s->now_us); }
void shim_trigger(struct shim *s, uint64_t at_us) {
    s->triggers++;
    s->trigger_us = at_us;
}
void shim_set_inputs(struct shim *s, uint32_t inputs) { s->inputs = (uint8_t)inputs; }
void shim_set_head(struct shim *s, uint32_t status) { s->head = (uint16_t)status; }
void shim_fault_mirror(struct shim *s, uint32_t fault) {
    s->stuck_x = s->from_x = mirror_x(s); /* slow from the next move on */
    s->mirror_fault = fault;
}
void shim_stick(struct shim *s, uint32_t stuck, uint32_t on) {
    s->stuck = (uint8_t)stuck;
    s->stuck_on = (uint8_t)on;
}

/* Copies and clears the bytes for the host; returns their number. */
size_t shim_take_output(struct shim *s, uint8_t *to) {
    size_t n = s->out_length;
    memcpy(to, s->out, n);
    s->out_length = 0;
    return n;
}
const struct board_trace *shim_traces(struct shim *s, size_t *count) {
    *count = s->traces_count;
    s->traces_count = 0;
    return s->traces;
}
const struct edge *shim_edges(struct shim *s, size_t *count) {
    *count = s->edges_count;
    return s->edges;
}
void shim_limits(const struct shim *s, uint8_t *to) { limits_encode(&s->board.limits, to); }

enum { GET_STATE, GET_FAULT, GET_GATE, GET_GATE_ON, GET_INDICATOR, GET_RELAY, GET_FED, GET_X, GET_Y,
       GET_CRC, GET_FORMAT, GET_FINGERPRINT };

/* FNV-1a hash of a board's state without error counters and partly received frames. */
static uint64_t fingerprint(const struct shim *s) {
    struct board *b = malloc(sizeof *b);
    memcpy(b, &s->board, sizeof *b);
    memset(&b->link.receiver, 0, sizeof b->link.receiver);
    b->loop_ran = false;
    b->guards.turn = 0;
    for (size_t k = 0; k < 4; k++) {
        b->guards.grids[k].swept = 0;
    }
    uint64_t hash = 14695981039346656037ull;
    for (size_t k = 0; k < sizeof *b; k++) {
        hash = (hash ^ ((const uint8_t *)b)[k]) * 1099511628211ull;
    }
    free(b);
    return hash;
}

uint64_t shim_get(const struct shim *s, uint32_t what) {
    switch (what) {
    case GET_STATE:
        return s->board.state;
    case GET_FAULT:
        return s->board.fault;
    case GET_GATE:
        return s->board.gate;
    case GET_GATE_ON:
        return s->gate_on;
    case GET_INDICATOR:
        return s->indicator;
    case GET_RELAY:
        return s->relay;
    case GET_FED:
        return s->fed_us;
    case GET_X:
        return s->x;
    case GET_Y:
        return s->y;
    case GET_CRC:
        return s->board.link.receiver.crc_errors;
    case GET_FORMAT:
        return s->board.link.receiver.format_errors;
    default:
        return fingerprint(s);
    }
}
